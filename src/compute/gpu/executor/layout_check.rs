//! Reads the device's values of all sizes and offsets that host and device share, to compare them with the host's.

use cudarc::driver::LaunchConfig;

use crate::gpu::launch::{Device, DeviceBuffer, LaunchOrder, launch_kernel};
use crate::gpu::tables::layout::{layout_constants, layout_kernel_source};
use modalcast_model::error::Result;

/// The device's values of [`layout_constants`], in the same order.
///
/// # Errors
/// `Unavailable` when NVRTC is missing; `Fault` when the device fails.
pub fn device_layout_values(device: &Device) -> Result<Vec<u32>> {
    let function = device.function("layout_values", &layout_kernel_source(), &[])?;
    let mut values = vec![0_u32; layout_constants().len()];
    let buffer = DeviceBuffer::zeroed(device, size_of_val(values.as_slice()) as u64)?;
    let config = LaunchConfig { grid_dim: (1, 1, 1), block_dim: (1, 1, 1), shared_mem_bytes: 0 };
    // SAFETY: the kernel's only argument is the address of as many words as there are constants, in a live buffer.
    unsafe { launch_kernel(device, &function, config, LaunchOrder::Serial, &buffer.address()) }?;
    buffer.read(device, 0, &mut values)?;
    Ok(values)
}
