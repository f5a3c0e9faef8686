//! Launches `kernels/bounds.cu`, which reduces the boxes that `deform` writes to the bounds of all positions. If the
//! deformer has bounding axes, the kernel also computes the bounds along these axes. If the scene has the feature
//! `boxes`, the kernel also computes the box of each domain, from segments (parts of domains). Bounds and boxes are six
//! keys: order-preserving integers of the sides (`tables::box_keys`).

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
    /// Axes of the second box of the result, in addition to the world's axes; `None` if the result has one box.
    axes: Option<BoundingAxes>,
    /// The box of each domain; only in a scene with the feature `boxes`.
    pub(crate) boxes: Option<DomainBoxes>,
}

impl BoundsKernel {
    /// Compiles the kernel and, if `deform` has segments of domains, allocates their boxes.
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

    /// Number of 32-bit words of the result: six keys for the bounds along the world's axes, and six for those along
    /// the bounding axes.
    pub(crate) const fn words(&self) -> usize {
        if self.axes.is_some() { 12 } else { 6 }
    }

    /// Starts the kernel on the boxes of `deform`. The kernel writes its result into the header in `inputs`.
    ///
    /// # Safety
    /// `inputs` and `deform` belong to the scene of this launcher. With the feature `boxes`, the header has the
    /// address of its positions. `inputs`, `deform` and the positions exist until the kernel has ended.
    ///
    /// # Errors
    /// `Fault` when the device fails.
    pub unsafe fn launch(&self, device: &Device, inputs: &StepInputs, deform: &DeformKernel) -> Result<()> {
        let (values, tile_boxes) = (inputs.addresses(), deform.boxes());
        let segment_addresses = self.boxes.as_ref().map(DomainBoxes::addresses).unwrap_or_default();
        let args = BoundsArgs {
            header: values.header,
            boxes: tile_boxes.address,
            segments: segment_addresses.segments,
            change_steps: values.change_steps,
            segment_boxes: segment_addresses.boxes,
            box_count: tile_boxes.count,
            segment_count: segment_addresses.count,
            bounding_axes: axes_to_f32(self.axes),
            reserved: 0,
        };
        // SAFETY: the kernel's only argument is a `BoundsArgs`. `boxes` has six words for each of `box_count` boxes,
        // and `segment_boxes` has six words for each segment. Segments refer to boxes, vertices and domains of the same
        // scene. The kernel calls `wait_for_prerequisite_grids` before it accesses memory.
        unsafe { launch_kernel(device, &self.function, self.config, LaunchOrder::Dependent, &args) }
    }
}
