//! Descriptors of kernels, and their launch.

use std::ffi::c_void;

use bytemuck::Pod;
use cudarc::driver::{CudaFunction, LaunchConfig, sys};
use serde::Serialize;

use super::device::Device;
use super::error::cuda_error;
use modalcast_model::error::Result;
use modalcast_model::fault_injection::{self, InjectionPoint};

/// First compute capability with programmatic dependent launch (PDL).
const MIN_PDL_CAPABILITY: (i32, i32) = (9, 0);

/// A kernel source file and the macros that enable its optional features.
#[derive(Debug)]
pub(crate) struct KernelSource {
    pub name: &'static str,
    pub source: &'static str,
    pub features: &'static [&'static str],
}

/// Purpose of a kernel launch.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum KernelKind {
    /// Full steps only: computes domains that share a U in groups, and reads U once per group. Only in scenes with such
    /// domains.
    Batch,
    /// Positions of all domains that `Batch` does not compute, and rigid normals.
    Deform,
    /// Bounding box of all positions.
    Bounds,
    /// Normals that follow the surface.
    Normals,
    /// Partial steps only, before all other launches: copies the changed values. Only in scenes that can have partial
    /// steps.
    Apply,
}

/// A kernel as compiled for one scene; launched at most once per step.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct KernelDescriptor {
    pub kind: KernelKind,
    pub name: &'static str,
    /// Macros that enable optional features.
    pub defines: Vec<&'static str>,
    pub blocks: u32,
    pub threads: u32,
    #[serde(skip)]
    pub(crate) source: KernelText,
}

impl KernelDescriptor {
    /// The planned grid, without dynamic shared memory.
    pub(crate) const fn config(&self) -> LaunchConfig {
        LaunchConfig { grid_dim: (self.blocks, 1, 1), block_dim: (self.threads, 1, 1), shared_mem_bytes: 0 }
    }

    /// The compiled function.
    ///
    /// # Errors
    /// As [`Device::function`].
    pub(crate) fn compile(&self, device: &Device) -> Result<CudaFunction> {
        device.function(self.name, self.source.0, &self.defines)
    }
}

/// The text of a kernel source file; `Debug` prints only its length.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) struct KernelText(pub(crate) &'static str);

impl std::fmt::Debug for KernelText {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(formatter, "{} bytes", self.0.len())
    }
}

/// Earliest start of a kernel, relative to the previous kernel of the stream.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LaunchOrder {
    /// The kernel starts when the previous one has ended.
    Serial,
    /// Programmatic dependent launch (`kernels/dependent_launch.cuh`): the kernel may be scheduled while the previous
    /// one ends, which hides its launch latency. The kernel itself waits for the previous one by
    /// `wait_for_prerequisite_grids`. Devices below capability 9.0 launch serially.
    Dependent,
}

/// Launches `function` on the device's stream. `args` is its only argument.
///
/// # Safety
/// The kernel has one argument, a struct with the layout of `T`. Each address in it refers to device or pinned memory
/// of at least the size that the kernel accesses, which exists until the kernel has ended. A kernel that is launched
/// with [`LaunchOrder::Dependent`] calls `wait_for_prerequisite_grids` before it accesses memory.
///
/// # Errors
/// `Fault` when the driver refuses the launch.
pub unsafe fn launch_kernel<T: Pod>(
    device: &Device,
    function: &CudaFunction,
    config: LaunchConfig,
    order: LaunchOrder,
    args: &T,
) -> Result<()> {
    let _current = device.enter()?;
    fault_injection::check(InjectionPoint::Launch)?;
    let id = sys::CUlaunchAttributeID::CU_LAUNCH_ATTRIBUTE_PROGRAMMATIC_STREAM_SERIALIZATION;
    let value = sys::CUlaunchAttributeValue { programmaticStreamSerializationAllowed: 1 };
    let mut attribute = sys::CUlaunchAttribute { id, pad: [0; 4], value };
    let is_dependent = order == LaunchOrder::Dependent && device.capability() >= MIN_PDL_CAPABILITY;
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
        numAttrs: u32::from(is_dependent),
    };
    let mut argument_pointers = [std::ptr::from_ref(args).cast_mut().cast::<c_void>()];
    // SAFETY: the attribute and the argument outlive the call, which copies both; the caller guarantees the rest.
    unsafe {
        sys::cuLaunchKernelEx(&config, function.cu_function(), argument_pointers.as_mut_ptr(), std::ptr::null_mut())
            .result()
    }
    .map_err(cuda_error("launch"))
}
