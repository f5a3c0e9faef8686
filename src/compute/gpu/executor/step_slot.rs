//! A step slot: the memory of one step in flight. It holds the input values and lists, the pinned memory for the bounds
//! that are read back, and the graphs that refer to this memory. A second slot is allocated when a step is submitted
//! before the previous one has ended.

use cudarc::driver::sys::CUevent_flags;
use cudarc::driver::{CudaEvent, CudaGraph, result};

use super::inputs::{InputPart, StagingBuffer, StepInputs};
use super::launchers::apply::{ApplyKernel, ChangeListBuffer};
use super::launchers::bounds::BoundsKernel;
use super::launchers::deform::DeformKernel;
use super::launchers::normals::NormalsKernel;
use crate::gpu::launch::error::cuda_error;
use crate::gpu::launch::{Device, PinnedBuffer, PinnedUse, capture};
use crate::gpu::tables::box_keys::{bounds_from_keys, oriented_bounds_from_keys};
use crate::gpu::tables::layout::StepHeader;
use modalcast_model::error::{Error, Result};
use modalcast_model::fault_injection::{self, InjectionPoint};
use modalcast_model::scene::{BoundingBox, OrientedBounds};

/// The kernels of a scene.
#[derive(Debug)]
pub(super) struct StepKernels {
    pub deform: DeformKernel,
    pub bounds: BoundsKernel,
    /// Only in a scene whose normals follow the surface.
    pub normals: Option<NormalsKernel>,
    /// Only in a scene that can have partial steps.
    pub apply: Option<ApplyKernel>,
}

/// Pinned memory of a step, and its graphs. The graphs refer to this memory and to the buffers of the deformer. Only
/// the deformer launches them. It owns all of this memory and waits for its steps before it drops anything. An idle
/// graph accesses no memory, so the order in which the fields are dropped does not matter.
pub(super) struct StepSlot {
    full_graph: CudaGraph,
    /// Graph of a partial step.
    partial_graph: Option<CudaGraph>,
    pub values: StagingBuffer,
    /// Only in a scene that can have partial steps.
    pub change_list: Option<ChangeListBuffer>,
    /// The bounds that the step reads back, as unsigned integers that compare like the floats (`box_keys`).
    bounds_keys: PinnedBuffer<u32>,
    /// End of the last step.
    pub done: CudaEvent,
    /// Begin of the last step on the device. Recorded by [`Self::record_begin`] only for steps that may wait for frames
    /// of OpenGL.
    begin_event: Option<CudaEvent>,
}

impl StepSlot {
    /// Allocates the memory and captures the graphs.
    pub(super) fn new(device: &Device, kernels: &StepKernels, inputs: &StepInputs) -> Result<Self> {
        let values = inputs.allocate_staging(device)?;
        let change_list = kernels.apply.as_ref().map(|apply| apply.allocate_list(device)).transpose()?;
        let mut bounds_keys = PinnedBuffer::zeroed(device, kernels.bounds.words(), PinnedUse::FromDevice)?;
        let mut submission = StepSubmission { kernels, inputs, values: &values, bounds_keys: &mut bounds_keys };
        let full_graph = capture(device, || submission.submit(device, None))?;
        let partial_graph = change_list
            .as_ref()
            .map(|change_list| capture(device, || submission.submit(device, Some(change_list))))
            .transpose()?;
        let done = new_timed_event(device)?;
        Ok(Self { full_graph, partial_graph, values, change_list, bounds_keys, done, begin_event: None })
    }

    /// Records on the stream that the device begins the step. The device may first complete or interrupt frames of
    /// OpenGL.
    pub(super) fn record_begin(&mut self, device: &Device) -> Result<()> {
        let event = match self.begin_event.take() {
            Some(event) => event,
            None => new_timed_event(device)?,
        };
        event.record(device.stream()).map_err(cuda_error("deform"))?;
        self.begin_event = Some(event);
        Ok(())
    }

    /// Milliseconds from [`Self::record_begin`] of the last step to the end of this step, which has ended. The host's
    /// work in between counts only as far as the device waits for it.
    ///
    /// # Errors
    /// `Fault` without [`Self::record_begin`], or when the device fails.
    pub(super) fn ms_since_begin(&self) -> Result<f64> {
        let missing_event = || Error::Fault { stage: "deform", reason: "expected a recorded begin, got none".into() };
        let begin_event = self.begin_event.as_ref().ok_or_else(missing_event)?;
        begin_event.elapsed_ms(&self.done).map(f64::from).map_err(cuda_error("deform"))
    }

    /// Starts the graph of a full or partial step on the device's stream. The caller has written the values.
    pub(super) fn launch(&self, kind: StepKind) -> Result<()> {
        let graph = match kind {
            StepKind::Full => Some(&self.full_graph),
            StepKind::Partial => self.partial_graph.as_ref(),
        };
        let missing_graph = || Error::Fault { stage: "deform", reason: "expected a captured graph, got none".into() };
        fault_injection::check(InjectionPoint::Launch)?;
        graph.ok_or_else(missing_graph)?.launch().map_err(cuda_error("deform"))
    }

    /// Waits for the end of the step. Returns its bounds, and those along the bounding axes if the deformer has axes.
    pub(super) fn wait(&self) -> Result<(BoundingBox, Option<OrientedBounds>)> {
        self.done.synchronize().map_err(cuda_error("deform"))?;
        let keys = self.bounds_keys.as_slice()?;
        Ok((bounds_from_keys(keys), oriented_bounds_from_keys(keys)))
    }
}

/// An event that records when it is reached.
fn new_timed_event(device: &Device) -> Result<CudaEvent> {
    device.context().new_event(Some(CUevent_flags::CU_EVENT_DEFAULT)).map_err(cuda_error("allocate"))
}

/// Whether a step computes all domains, or those of its change list.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum StepKind {
    Full,
    Partial,
}

/// The work of a step and the memory that it uses.
struct StepSubmission<'a> {
    kernels: &'a StepKernels,
    inputs: &'a StepInputs,
    values: &'a StagingBuffer,
    bounds_keys: &'a mut PinnedBuffer<u32>,
}

impl StepSubmission<'_> {
    /// Submits a step: upload, kernels and readback of the bounds. A partial step has a change list.
    fn submit(&mut self, device: &Device, change_list: Option<&ChangeListBuffer>) -> Result<()> {
        let Self { kernels, inputs, values, bounds_keys } = self;
        let input_part = if change_list.is_some() { InputPart::Header } else { InputPart::All };
        // SAFETY: the work is captured in a graph. The deformer owns the graph, the kernels, the inputs and the pinned
        // memory, all for one scene. Before each launch it writes valid lists and a header, whose addresses are those of
        // outputs as large as the plan requires. It waits for the launch before it writes or drops the memory.
        unsafe {
            inputs.send(device, values, input_part)?;
            match (change_list, &kernels.apply) {
                (Some(change_list), Some(apply)) => {
                    apply.launch(device, change_list, inputs, &kernels.deform)?;
                    kernels.deform.launch_tile_list(device, inputs)?;
                }
                _ => kernels.deform.launch(device, inputs)?,
            }
            kernels.bounds.launch(device, inputs, &kernels.deform)?;
            kernels.normals.as_ref().map_or(Ok(()), |normals| normals.launch(device, inputs))?;
        }
        let bounds_address = inputs.addresses().header + std::mem::offset_of!(StepHeader, bounds) as u64;
        let keys = bounds_keys.as_mut_slice()?;
        // SAFETY: the header has twelve words of bounds and `keys` at most as many. The deformer waits for the step
        // before it reads or drops them.
        unsafe { result::memcpy_dtoh_async(keys, bounds_address, device.stream().cu_stream()) }
            .map_err(cuda_error("capture"))
    }
}
