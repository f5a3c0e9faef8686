//! Reads every size and offset that host and device share from the device itself, to compare them with the host's.

use cudarc::driver::{LaunchConfig, PushKernelArg as _};

use super::device::Device;
use super::layout::{agreements, report_source};
use super::memory::{address, download, room};
use modalcast_model::error::{Result, during};

/// The device's values of [`agreements`], in the same order.
///
/// # Errors
/// `Unavailable` when NVRTC is missing; `Fault` when the device fails.
pub fn device_values(device: &Device) -> Result<Vec<u32>> {
    let function = device.function("report", &report_source(), &[])?;
    let mut values = vec![0_u32; agreements().len()];
    let buffer = room(device, size_of_val(values.as_slice()) as u64)?;
    let to = address(device, &buffer);
    let config = LaunchConfig { grid_dim: (1, 1, 1), block_dim: (1, 1, 1), shared_mem_bytes: 0 };
    let mut launch = device.stream().launch_builder(&function);
    // SAFETY: the kernel's only argument is the address of as many words as there are agreements.
    unsafe { launch.arg(&to).launch(config) }.map_err(during("report"))?;
    // SAFETY: the buffer has the bytes of `values`.
    unsafe { download(device, to, &mut values) }?;
    Ok(values)
}
