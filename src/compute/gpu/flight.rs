//! What one step under way has of its own: its values and lists on their way in, its answer, and the graphs that name
//! that memory. A second one is made for a step that is submitted before the one before it has ended.

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
    /// Of a scene whose normals follow the surface.
    pub normals: Option<Normals>,
    /// Of a scene whose steps may change few domains.
    pub apply: Option<Apply>,
}

/// Pinned memory of a step, and its graphs.
pub(super) struct Flight {
    // Graphs first: they name the memory of all that follows.
    whole: CudaGraph,
    /// Of a list of changed domains.
    some: Option<CudaGraph>,
    pub values: Pinned,
    pub list: Option<List>,
    answer: PinnedHostSlice<u32>,
    /// Recorded behind each step.
    pub done: CudaEvent,
    /// With OpenGL's buffers, recorded behind each mapping, which waits for frames.
    mapped: Option<CudaEvent>,
    /// Host milliseconds of the step before it asked for the mapping.
    pub before_ms: f64,
}

impl Flight {
    /// `is_timed`: on the device, from behind the mapping on.
    pub(super) fn new(device: &Device, kernels: &Kernels, inputs: &Inputs, is_timed: bool) -> Result<Self> {
        let mut values = inputs.pinned(device)?;
        let mut list = kernels.apply.as_ref().map(|apply| apply.list(device)).transpose()?;
        // SAFETY: the memory is written by the copy that ends every graph before anyone looks.
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

    /// Marks on the stream that the step's outputs may be written from here on.
    pub(super) fn mark_mapped(&self, device: &Device) -> Result<()> {
        match &self.mapped {
            Some(mapped) => mapped.record(device.stream()).map_err(during("deform")),
            None => Ok(()),
        }
    }

    /// Milliseconds of a step that was waited for, without the wait for frames; none where that is not timed. The host's
    /// work behind the mapping counts as far as the device had to wait for it.
    pub(super) fn own_ms(&self) -> Result<Option<f64>> {
        let Some(mapped) = &self.mapped else { return Ok(None) };
        let ms = mapped.elapsed_ms(&self.done).map_err(during("deform"))?;
        Ok(Some(self.before_ms + f64::from(ms)))
    }

    /// Starts the step's graph on the device's stream; its values are written. `some`: of the list.
    pub(super) fn launch(&self, some: bool) -> Result<()> {
        let graph = if some { self.some.as_ref() } else { Some(&self.whole) };
        let missing = || Error::Fault { stage: "deform", reason: "no graph was captured".into() };
        graph.ok_or_else(missing)?.launch().map_err(during("deform"))
    }

    /// Waits for the end of the step, and returns its bounds, in light space too where the scene has a shadow.
    pub(super) fn wait(&self) -> Result<(modalcast_model::scene::Bounds, Option<LightBounds>)> {
        self.done.synchronize().map_err(during("deform"))?;
        let keys = self.answer.as_slice().map_err(during("deform"))?;
        Ok((bounds_of(keys), light_of(keys)))
    }
}

/// What `start` puts on the stream, as a graph.
fn capture(device: &Device, start: impl FnOnce() -> Result<()>) -> Result<CudaGraph> {
    let fail = during("capture");
    let stream = Arc::clone(device.stream());
    // Relaxed: a look at pinned memory asks the driver whether it is in use, which stricter modes refuse.
    stream.begin_capture(CUstreamCaptureMode::CU_STREAM_CAPTURE_MODE_RELAXED).map_err(&fail)?;
    let started = start();
    // The capture ends whatever happened, or the stream would stay in it.
    let graph = stream.end_capture(CUgraphInstantiate_flags::CUDA_GRAPH_INSTANTIATE_FLAG_AUTO_FREE_ON_LAUNCH);
    started?;
    let empty = || Error::Fault { stage: "capture", reason: "the graph is empty".into() };
    graph.map_err(&fail)?.ok_or_else(empty)
}

/// A step: copies in, kernels, the bounds out.
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
    // SAFETY: the header has twelve words of bounds, `answer` no more, and the step is waited for before they are read.
    unsafe { result::memcpy_dtoh_async(answer, bounds, device.stream().cu_stream()) }.map_err(during("capture"))
}
