//! A ring slot: the memory of one step in flight. It holds the input values and lists, the pinned memory for the bounds
//! that are read back, and the graphs that refer to this memory. A second slot is made when a step is submitted before
//! the previous one has ended.

use std::sync::Arc;

use cudarc::driver::sys::{CUevent_flags, CUgraphInstantiate_flags, CUstreamCaptureMode};
use cudarc::driver::{CudaEvent, CudaGraph, PinnedHostSlice, result};

use super::apply::{Apply, List};
use super::bounds::{Bounds, bounds_of, light_of};
use super::deform::Deform;
use super::device::Device;
use super::inputs::{Inputs, Pinned};
use super::layout::Header;
use super::normals::Normals;
use modalcast_model::error::{Error, Result, during};
use modalcast_model::scene::LightBounds;

/// The kernels of a scene.
#[derive(Debug)]
pub(super) struct Kernels {
    pub deform: Deform,
    pub bounds: Bounds,
    /// Only in a scene whose normals follow the surface.
    pub normals: Option<Normals>,
    /// Only in a scene that can have partial steps.
    pub apply: Option<Apply>,
}

/// Pinned memory of a step, and its graphs.
pub(super) struct Flight {
    // First, so dropped first: the graphs refer to the memory of the fields below.
    whole: CudaGraph,
    /// Graph of a partial step.
    some: Option<CudaGraph>,
    pub values: Pinned,
    pub list: Option<List>,
    answer: PinnedHostSlice<u32>,
    /// Recorded after each step.
    pub done: CudaEvent,
    /// Only with OpenGL's buffers: recorded after each mapping, which waits for frames in flight.
    mapped: Option<CudaEvent>,
    /// Host milliseconds of the step before it requested the mapping.
    pub before_ms: f64,
}

impl Flight {
    /// `is_timed`: measure the time of steps on the device, from the end of the mapping.
    pub(super) fn new(device: &Device, kernels: &Kernels, inputs: &Inputs, is_timed: bool) -> Result<Self> {
        let mut values = inputs.pinned(device)?;
        let mut list = kernels.apply.as_ref().map(|apply| apply.list(device)).transpose()?;
        // SAFETY: the memory is uninitialized; the copy at the end of every graph writes it before it is read.
        let answer = unsafe { device.context().alloc_pinned_with_flags(kernels.bounds.words(), 0) };
        let mut answer = answer.map_err(during("allocate"))?;
        let parts = (kernels, inputs);
        let whole = capture(device, || start(device, parts, (&mut values, None), &mut answer))?;
        let some = match &mut list {
            Some(list) => Some(capture(device, || start(device, parts, (&mut values, Some(list)), &mut answer))?),
            None => None,
        };
        let event = |flags| device.context().new_event(flags).map_err(during("allocate"));
        let flags = is_timed.then_some(CUevent_flags::CU_EVENT_DEFAULT);
        let (mapped, done) = (flags.map(|flags| event(Some(flags))).transpose()?, event(flags)?);
        Ok(Self { whole, some, values, list, answer, done, mapped, before_ms: 0.0 })
    }

    /// Records on the stream that the mapping has ended, after which the step may write its outputs.
    pub(super) fn mark_mapped(&self, device: &Device) -> Result<()> {
        match &self.mapped {
            Some(mapped) => mapped.record(device.stream()).map_err(during("deform")),
            None => Ok(()),
        }
    }

    /// Milliseconds of a step that has ended, without the wait for frames; `None` if steps are not timed. Host work
    /// after the mapping counts only as far as the device waited for it.
    pub(super) fn own_ms(&self) -> Result<Option<f64>> {
        let Some(mapped) = &self.mapped else { return Ok(None) };
        let ms = mapped.elapsed_ms(&self.done).map_err(during("deform"))?;
        Ok(Some(self.before_ms + f64::from(ms)))
    }

    /// Starts the step's graph on the device's stream; its values are already written. `some`: the graph of a partial
    /// step.
    pub(super) fn launch(&self, some: bool) -> Result<()> {
        let graph = if some { self.some.as_ref() } else { Some(&self.whole) };
        let missing = || Error::Fault { stage: "deform", reason: "no graph was captured".into() };
        graph.ok_or_else(missing)?.launch().map_err(during("deform"))
    }

    /// Waits for the end of the step. Returns its bounds, and its bounds in light space if the scene has a shadow.
    pub(super) fn wait(&self) -> Result<(modalcast_model::scene::Bounds, Option<LightBounds>)> {
        self.done.synchronize().map_err(during("deform"))?;
        let keys = self.answer.as_slice().map_err(during("deform"))?;
        Ok((bounds_of(keys), light_of(keys)))
    }
}

/// Captures the work that `start` submits to the stream as a graph.
fn capture(device: &Device, start: impl FnOnce() -> Result<()>) -> Result<CudaGraph> {
    let fail = during("capture");
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
    (kernels, inputs): (&Kernels, &Inputs),
    (values, list): (&mut Pinned, Option<&mut List>),
    answer: &mut PinnedHostSlice<u32>,
) -> Result<()> {
    let places = inputs.values(device);
    inputs.send(device, values, list.is_some().then_some(size_of::<Header>()))?;
    match (list, &kernels.apply) {
        (Some(list), Some(apply)) => {
            apply.launch(device, list, places, kernels.deform.list(device))?;
            kernels.deform.launch_listed(device, places)?;
        }
        _ => kernels.deform.launch(device, places)?,
    }
    kernels.bounds.launch(device, places, kernels.deform.boxes(device))?;
    kernels.normals.as_ref().map_or(Ok(()), |normals| normals.launch(device, places))?;
    let bounds = places.header + std::mem::offset_of!(Header, bounds) as u64;
    let answer = answer.as_mut_slice().map_err(during("capture"))?;
    // SAFETY: the header has twelve words of bounds and `answer` at most as many. The host waits for the step before it
    // reads `answer`.
    unsafe { result::memcpy_dtoh_async(answer, bounds, device.stream().cu_stream()) }.map_err(during("capture"))
}
