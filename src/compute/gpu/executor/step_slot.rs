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
    /// The bounds that the step reads back, as unsigned integers in the order of the floats (`box_keys`).
    bounds_keys: PinnedBuffer<u32>,
    /// End of the last step.
    pub done: CudaEvent,
    /// Recorded when the last step's map of OpenGL's buffers is complete. The map waits for frames in flight. Only with
    /// OpenGL's buffers.
    mapped_event: Option<CudaEvent>,
    /// Host time of the step before it requested the map, in milliseconds.
    pub host_ms: f64,
}

impl StepSlot {
    /// If `is_timed` is set, the device measures the time of a step from the moment when OpenGL's buffers are mapped.
    pub(super) fn new(device: &Device, kernels: &StepKernels, inputs: &StepInputs, is_timed: bool) -> Result<Self> {
        let values = inputs.allocate_staging(device)?;
        let change_list = kernels.apply.as_ref().map(|apply| apply.allocate_list(device)).transpose()?;
        let mut bounds_keys = PinnedBuffer::zeroed(device, kernels.bounds.words(), PinnedUse::FromDevice)?;
        let mut submission = StepSubmission { kernels, inputs, values: &values, bounds_keys: &mut bounds_keys };
        let full_graph = capture(device, || submission.submit(device, None))?;
        let partial_graph = change_list
            .as_ref()
            .map(|change_list| capture(device, || submission.submit(device, Some(change_list))))
            .transpose()?;
        let new_event = |flags| device.context().new_event(flags).map_err(cuda_error("allocate"));
        let flags = is_timed.then_some(CUevent_flags::CU_EVENT_DEFAULT);
        let (mapped_event, done) = (flags.map(|flags| new_event(Some(flags))).transpose()?, new_event(flags)?);
        Ok(Self { full_graph, partial_graph, values, change_list, bounds_keys, done, mapped_event, host_ms: 0.0 })
    }

    /// Records on the stream that the outputs are mapped and the step may write them.
    pub(super) fn record_mapped(&self, device: &Device) -> Result<()> {
        match &self.mapped_event {
            Some(mapped_event) => mapped_event.record(device.stream()).map_err(cuda_error("deform")),
            None => Ok(()),
        }
    }

    /// Time of a step that has ended, in milliseconds, without the wait for frames in flight; `None` if steps are not
    /// timed. It is the host's time before the map plus the device's time after the map. The host's work after the map
    /// counts only as far as the device waits for it.
    pub(super) fn device_ms(&self) -> Result<Option<f64>> {
        let Some(mapped_event) = &self.mapped_event else { return Ok(None) };
        let ms = mapped_event.elapsed_ms(&self.done).map_err(cuda_error("deform"))?;
        Ok(Some(self.host_ms + f64::from(ms)))
    }

    /// Starts the graph of a full or partial step on the device's stream. The caller has written the values.
    pub(super) fn launch(&self, kind: StepKind) -> Result<()> {
        let graph = match kind {
            StepKind::Full => Some(&self.full_graph),
            StepKind::Partial => self.partial_graph.as_ref(),
        };
        let missing_graph = || Error::Fault { stage: "deform", reason: "expected a captured graph, got none".into() };
        graph.ok_or_else(missing_graph)?.launch().map_err(cuda_error("deform"))
    }

    /// Waits for the end of the step. Returns its bounds, and those along the bounding axes if the deformer has axes.
    pub(super) fn wait(&self) -> Result<(BoundingBox, Option<OrientedBounds>)> {
        self.done.synchronize().map_err(cuda_error("deform"))?;
        let keys = self.bounds_keys.as_slice()?;
        Ok((bounds_from_keys(keys), oriented_bounds_from_keys(keys)))
    }
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
        // memory, all for one scene. It writes a header with the addresses of outputs of the plan's sizes, and valid
        // lists, before each launch, and waits for the launch before it writes or drops the memory.
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
