//! The CUDA backend, in three tiers: `launch` (access to the device), `tables` (tables and plan of a scene, computed by
//! pure functions on the host) and `executor` (deformer and rasterizer).
//!
//! The kernels are in `kernels/*.cu`. NVRTC compiles them at run time for the present device, with only the features
//! that the scene uses ([`plan()`]). A disk cache keeps the machine code. A step is one CUDA graph: a host-to-device
//! copy, at most four kernel launches for any number of domains, and a readback of the bounds. A step that is drawn is
//! copied to OpenGL's buffers on the device if the driver can share them.
//!
//! ```text
//! inputs -> [apply or batch] -> deform -> bounds -> [normals] -> readback of the bounds
//! ```
//! `deform` computes positions, and `bounds` the bounding box of all positions. A partial step, which changes few
//! domains, first launches `apply`, which copies the changed values. A full step launches `batch` if the scene has
//! domains that share a large U; `batch` computes these domains instead of `deform`. `normals` is launched if normals
//! follow the deformed surface.
//!
//! The server uses this module. Programs that measure single kernels also use [`launch`], [`launchers`] and
//! [`step_input`].

#[cfg(test)]
mod device_tests;
mod executor;
#[cfg(test)]
mod kernel_tests;
pub mod launch;
mod tables;

pub use executor::png::{DevicePicture, EncodedPng, PendingPng, PngEncoder};
pub use executor::raster::{CudaRasterizer, RasterGranularity, RasterVariant};
pub use executor::view_ring::{ViewArrayLayout, ViewRing};
pub use executor::views::{CudaViewRenderer, DeviceVertices, DeviceViews};
pub use executor::{
    CudaDeformer, CudaPictureMemory, MAX_STEPS_IN_FLIGHT, PinnedArray, PinnedPool, PreparedDeformer,
    device_layout_values,
};
#[cfg(any(test, feature = "testing"))]
pub use launch::{CAPABILITIES, CompiledVariant, assert_compiles};
pub use launch::{Device, DeviceInfo, KernelDescriptor, KernelKind, Probe, probe};
pub use tables::device_tables::CudaDeformerOptions;
pub use tables::layout::{LayoutConstant, layout_constants};
pub use tables::plan::{BufferDescriptor, BufferRole, DeformPlan, OmittedFeature, plan};
pub use tables::png_plan::PngChannels;

/// The launchers of the kernels, for programs that measure single kernels. The launch functions are unsafe, because the
/// kernels write to the addresses in the step's [`StepHeader`](step_input::StepHeader), which nothing checks.
pub mod launchers {
    pub use super::executor::launchers::apply::{ApplyKernel, ChangeListBuffer};
    pub use super::executor::launchers::bounds::BoundsKernel;
    pub use super::executor::launchers::deform::{DeformKernel, PositionKernels};
    pub use super::executor::launchers::normals::NormalsKernel;
    pub use super::executor::raster::{RasterFunctions, RasterPass, RasterPipeline, check_cut_outs, check_mesh};
    pub use super::tables::change_list::{ChangeListLengths, ChangedDomains};
    pub use super::tables::device_tables::DeviceTables;
    pub use super::tables::kernels::storage_define;
    pub use super::tables::plan::plan_from_tables;
}

/// The input values of a step, for programs that measure their upload.
pub mod step_input {
    pub use super::executor::inputs::{InputPart, StagingBuffer, StepInputs};
    pub use super::tables::input_packing::InputPacker;
    pub use super::tables::layout::StepHeader;
    pub use super::tables::staging::{PARALLEL_THRESHOLD, parallel_copy};
}
