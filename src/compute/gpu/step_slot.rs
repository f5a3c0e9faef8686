//! A ring slot: the memory of one step in flight. It holds the input values and lists, the pinned memory for the bounds
//! that are read back, and the graphs that refer to this memory. A second slot is made when a step is submitted before
//! the previous one has ended.

use std::sync::Arc;

use cudarc::driver::sys::{CUevent_flags, CUgraphInstantiate_flags, CUstreamCaptureMode};
use cudarc::driver::{CudaEvent, CudaGraph, PinnedHostSlice, result};

use super::apply::{ApplyKernel, ChangeListBuffer};
use super::bounds::{BoundsKernel, bounds_from_keys, light_bounds_from_keys};
use super::deform::DeformKernel;
use super::device::Device;
use super::inputs::{StagingBuffer, StepInputs};
use super::layout::Header;
use super::normals::NormalsKernel;
use modalcast_model::error::{Error, Result, fault_in};
use modalcast_model::scene::LightSpaceBox;

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

/// Pinned memory of a step, and its graphs.
pub(super) struct StepSlot {
    // First, so dropped first: the graphs refer to the memory of the fields below.
    full_graph: CudaGraph,
    /// Graph of a partial step.
    change_list_graph: Option<CudaGraph>,
    pub values: StagingBuffer,
    pub list: Option<ChangeListBuffer>,
    bounds_keys: PinnedHostSlice<u32>,
    /// Recorded after each step.
    pub done: CudaEvent,
    /// Only with OpenGL's buffers: recorded after each mapping, which waits for frames in flight.
    mapped_event: Option<CudaEvent>,
    /// Host milliseconds of the step before it requested the mapping.
    pub host_ms: f64,
}

impl StepSlot {
    /// `is_timed`: measure the time of steps on the device, from the end of the mapping.
    pub(super) fn new(device: &Device, kernels: &StepKernels, inputs: &StepInputs, is_timed: bool) -> Result<Self> {
        let mut values = inputs.staging(device)?;
        let mut list = kernels.apply.as_ref().map(|apply| apply.list(device)).transpose()?;
        // SAFETY: the memory is uninitialized; the copy at the end of every graph writes it before it is read.
        let bounds_keys = unsafe { device.context().alloc_pinned_with_flags(kernels.bounds.words(), 0) };
        let mut bounds_keys = bounds_keys.map_err(fault_in("allocate"))?;
        let parts = (kernels, inputs);
        let full_graph = capture(device, || start(device, parts, (&mut values, None), &mut bounds_keys))?;
        let change_list_graph = match &mut list {
            Some(list) => Some(capture(device, || start(device, parts, (&mut values, Some(list)), &mut bounds_keys))?),
            None => None,
        };
        let event = |flags| device.context().new_event(flags).map_err(fault_in("allocate"));
        let flags = is_timed.then_some(CUevent_flags::CU_EVENT_DEFAULT);
        let (mapped_event, done) = (flags.map(|flags| event(Some(flags))).transpose()?, event(flags)?);
        Ok(Self { full_graph, change_list_graph, values, list, bounds_keys, done, mapped_event, host_ms: 0.0 })
    }

    /// Records on the stream that the mapping has ended, after which the step may write its outputs.
    pub(super) fn record_mapped(&self, device: &Device) -> Result<()> {
        match &self.mapped_event {
            Some(mapped_event) => mapped_event.record(device.stream()).map_err(fault_in("deform")),
            None => Ok(()),
        }
    }

    /// Milliseconds of a step that has ended, without the wait for frames; `None` if steps are not timed. Host work
    /// after the mapping counts only as far as the device waited for it.
    pub(super) fn device_ms(&self) -> Result<Option<f64>> {
        let Some(mapped_event) = &self.mapped_event else { return Ok(None) };
        let ms = mapped_event.elapsed_ms(&self.done).map_err(fault_in("deform"))?;
        Ok(Some(self.host_ms + f64::from(ms)))
    }

    /// Starts the step's graph on the device's stream; its values are already written. `change_list_graph`: the graph of a partial
    /// step.
    pub(super) fn launch(&self, change_list_graph: bool) -> Result<()> {
        let graph = if change_list_graph { self.change_list_graph.as_ref() } else { Some(&self.full_graph) };
        let missing = || Error::Fault { stage: "deform", reason: "no graph was captured".into() };
        graph.ok_or_else(missing)?.launch().map_err(fault_in("deform"))
    }

    /// Waits for the end of the step. Returns its bounds, and its bounds in light space if the scene has a shadow.
    pub(super) fn wait(&self) -> Result<(modalcast_model::scene::Bounds, Option<LightSpaceBox>)> {
        self.done.synchronize().map_err(fault_in("deform"))?;
        let keys = self.bounds_keys.as_slice().map_err(fault_in("deform"))?;
        Ok((bounds_from_keys(keys), light_bounds_from_keys(keys)))
    }
}

/// Captures the work that `start` submits to the stream as a graph.
fn capture(device: &Device, start: impl FnOnce() -> Result<()>) -> Result<CudaGraph> {
    let fail = fault_in("capture");
    let stream = Arc::clone(device.stream());
    // Relaxed: access to pinned memory asks the driver whether it is in use, which stricter modes forbid.
    stream.begin_capture(CUstreamCaptureMode::CU_STREAM_CAPTURE_MODE_RELAXED).map_err(&fail)?;
    let started = start();
    // End the capture even after an error; otherwise the stream would remain in capture mode.
    let graph = stream.end_capture(CUgraphInstantiate_flags::CUDA_GRAPH_INSTANTIATE_FLAG_AUTO_FREE_ON_LAUNCH);
    started?;
    let empty = || Error::Fault { stage: "capture", reason: "the graph is empty".into() };
    graph.map_err(&fail)?.ok_or_else(empty)
}

/// Submits a step: upload, kernels, readback of the bounds.
fn start(
    device: &Device,
    (kernels, inputs): (&StepKernels, &StepInputs),
    (values, list): (&mut StagingBuffer, Option<&mut ChangeListBuffer>),
    bounds_keys: &mut PinnedHostSlice<u32>,
) -> Result<()> {
    let places = inputs.values(device);
    inputs.send(device, values, list.is_some().then_some(size_of::<Header>()))?;
    match (list, &kernels.apply) {
        (Some(list), Some(apply)) => {
            apply.launch(device, list, places, kernels.deform.list(device))?;
            kernels.deform.launch_tile_list(device, places)?;
        }
        _ => kernels.deform.launch(device, places)?,
    }
    kernels.bounds.launch(device, places, kernels.deform.boxes(device))?;
    kernels.normals.as_ref().map_or(Ok(()), |normals| normals.launch(device, places))?;
    let bounds = places.header + std::mem::offset_of!(Header, bounds) as u64;
    let bounds_keys = bounds_keys.as_mut_slice().map_err(fault_in("capture"))?;
    // SAFETY: the header has twelve words of bounds and `bounds_keys` at most as many. The host waits for the step before it
    // reads `bounds_keys`.
    unsafe { result::memcpy_dtoh_async(bounds_keys, bounds, device.stream().cu_stream()) }.map_err(fault_in("capture"))
}
