//! Programmatic dependent launch (`kernels/dependent_launch.cuh`): a kernel may be scheduled while the previous kernel ends, which
//! hides its launch latency. The kernel itself waits for the previous kernel before it accesses memory.

use std::ffi::c_void;

use cudarc::driver::{CudaFunction, LaunchConfig, sys};

use super::device::Device;
use modalcast_model::error::{Result, fault_in};

/// First compute capability with programmatic dependent launch.
const MIN_PDL_CAPABILITY: (i32, i32) = (9, 0);

/// Launches `function` on the device's stream.
///
/// # Safety
/// `args` is the kernel's only argument, its addresses are valid for the kernel, and the kernel calls `wait_on_dependent_grids`
/// before it accesses memory.
pub(super) unsafe fn launch<T>(device: &Device, function: &CudaFunction, config: LaunchConfig, args: &T) -> Result<()> {
    let serialise = sys::CUlaunchAttributeID::CU_LAUNCH_ATTRIBUTE_PROGRAMMATIC_STREAM_SERIALIZATION;
    let value = sys::CUlaunchAttributeValue { programmaticStreamSerializationAllowed: 1 };
    let mut attribute = sys::CUlaunchAttribute { id: serialise, pad: [0; 4], value };
    let config = sys::CUlaunchConfig {
        gridDimX: config.grid_dim.0,
        gridDimY: config.grid_dim.1,
        gridDimZ: config.grid_dim.2,
        blockDimX: config.block_dim.0,
        blockDimY: config.block_dim.1,
        blockDimZ: config.block_dim.2,
        sharedMemBytes: config.shared_mem_bytes,
        hStream: device.stream().cu_stream(),
        attrs: &mut attribute,
        numAttrs: u32::from(device.capability() >= MIN_PDL_CAPABILITY),
    };
    let mut pointers = [std::ptr::from_ref(args).cast_mut().cast::<c_void>()];
    // SAFETY: the attribute and the argument outlive the call, which copies both; the caller guarantees the rest.
    unsafe {
        sys::cuLaunchKernelEx(&config, function.cu_function(), pointers.as_mut_ptr(), std::ptr::null_mut()).result()
    }
    .map_err(fault_in("launch"))
}
