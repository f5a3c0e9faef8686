//! Reads every size and offset that host and device share from the device itself, to compare them with the host's.

use cudarc::driver::{LaunchConfig, PushKernelArg as _};

use super::device::Device;
use super::layout::{layout_constants, layout_kernel_source};
use super::memory::{address, alloc_zeroed, download};
use modalcast_model::error::{Result, fault_in};

/// The device's values of [`layout_constants`], in the same order.
///
/// # Errors
/// `Unavailable` when NVRTC is missing; `Fault` when the device fails.
pub fn device_layout_values(device: &Device) -> Result<Vec<u32>> {
    let function = device.function("layout_values", &layout_kernel_source(), &[])?;
    let mut values = vec![0_u32; layout_constants().len()];
    let buffer = alloc_zeroed(device, size_of_val(values.as_slice()) as u64)?;
    let to = address(device, &buffer);
    let config = LaunchConfig { grid_dim: (1, 1, 1), block_dim: (1, 1, 1), shared_mem_bytes: 0 };
    let mut launch = device.stream().launch_builder(&function);
    // SAFETY: the kernel's only argument is the address of as many words as there are agreements.
    unsafe { launch.arg(&to).launch(config) }.map_err(fault_in("report"))?;
    // SAFETY: the buffer has the bytes of `values`.
    unsafe { download(device, to, &mut values) }?;
    Ok(values)
}
