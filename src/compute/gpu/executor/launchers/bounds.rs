//! Launches `kernels/bounds.cu`, which reduces the boxes of `deform` to the bounds of all positions. It also computes
//! the bounds along the bounding axes of the deformer if it has any, and the box of each domain if the scene keeps
//! boxes.

use cudarc::driver::{CudaFunction, LaunchConfig};

use super::deform::DeformKernel;
use super::domain_boxes::DomainBoxes;
use crate::gpu::executor::inputs::StepInputs;
use crate::gpu::launch::{Device, KernelDescriptor, LaunchOrder, launch_kernel};
use crate::gpu::tables::box_keys::axes_to_f32;
use crate::gpu::tables::layout::BoundsArgs;
use modalcast_model::deform::BoundingAxes;
use modalcast_model::error::Result;

/// The kernel and its buffers.
#[derive(Debug)]
pub struct BoundsKernel {
    function: CudaFunction,
    config: LaunchConfig,
    /// Axes of the second box of the result; `None` if the result has one box.
    axes: Option<BoundingAxes>,
    /// Only in a scene that keeps boxes.
    pub(crate) boxes: Option<DomainBoxes>,
}

impl BoundsKernel {
    /// Compiles the kernel. If `deform` has segments of domains, the kernel also computes a box of each domain.
    ///
    /// # Errors
    /// As [`Device::function`]; `Fault` when the device has not enough memory.
    pub fn new(
        device: &Device,
        kernel: &KernelDescriptor,
        axes: Option<BoundingAxes>,
        deform: &DeformKernel,
    ) -> Result<Self> {
        Ok(Self {
            function: kernel.compile(device)?,
            config: kernel.config(),
            axes,
            boxes: deform.segments().map(|segments| DomainBoxes::new(device, segments)).transpose()?,
        })
    }

    /// The compiled function, for reports.
    pub const fn function(&self) -> &CudaFunction {
        &self.function
    }

    /// Number of words of the result: six keys per box.
    pub(crate) const fn words(&self) -> usize {
        if self.axes.is_some() { 12 } else { 6 }
    }

    /// Starts the kernel on the boxes of `deform`; it writes its result into the header among the values of `inputs`.
    ///
    /// # Safety
    /// `inputs` and `deform` are those of one scene, that of this launcher. The header has the address of positions of
    /// this scene if it keeps boxes. All of them exist until the kernel has ended.
    ///
    /// # Errors
    /// `Fault` when the device fails.
    pub unsafe fn launch(&self, device: &Device, inputs: &StepInputs, deform: &DeformKernel) -> Result<()> {
        let (values, warp_boxes) = (inputs.addresses(), deform.boxes());
        let segment_addresses = self.boxes.as_ref().map(DomainBoxes::addresses).unwrap_or_default();
        let args = BoundsArgs {
            header: values.header,
            boxes: warp_boxes.address,
            segments: segment_addresses.segments,
            change_steps: values.change_steps,
            segment_boxes: segment_addresses.boxes,
            box_count: warp_boxes.count,
            segment_count: segment_addresses.count,
            bounding_axes: axes_to_f32(self.axes),
            reserved: 0,
        };
        // SAFETY: the kernel's only argument is a `BoundsArgs`. `boxes` has six words for each of `box_count` boxes,
        // and `segment_boxes` has six for each segment. Segments refer to boxes, vertices and domains of the same
        // scene. The kernel calls `wait_for_prerequisite_grids` before it accesses memory.
        unsafe { launch_kernel(device, &self.function, self.config, LaunchOrder::Dependent, &args) }
    }
}
