//! The deformer `cuda`: a step is one graph of copies and kernels, and the bounds come back with it.

use std::sync::Arc;
use std::time::Instant;

use cudarc::driver::sys::{CUgraphInstantiate_flags, CUstreamCaptureMode};
use cudarc::driver::{CudaGraph, CudaSlice, PinnedHostSlice, result};

use super::GlBuffers;
use super::apply::{Apply, Lengths};
use super::bounds::{Bounds, bounds_of};
use super::deform::Deform;
use super::device::Device;
use super::inputs::Inputs;
use super::layout::Header;
use super::memory::{PageLock, address, download, room};
use super::normals::Normals;
use super::output::{Output, sizes};
use super::plan::{Launch, Plan, Role, plan};
use crate::deform::{Backend, Deformed, Deformer, Surface, Wanted};
use crate::error::{Error, Result, during};
use crate::scene::{Changed, Scene, State};

/// The CUDA deformer of one scene. Lives and dies on the thread that owns the OpenGL context, and before the buffers
/// that it shares.
pub struct CudaDeformer {
    // Graphs first: they name the memory of all that follows.
    whole: Option<CudaGraph>,
    some: Option<CudaGraph>,
    device: Arc<Device>,
    plan: Plan,
    kernels: Kernels,
    inputs: Inputs,
    answer: PinnedHostSlice<u32>,
    output: Output,
    /// u, of a scene that keeps it.
    displacements: Option<CudaSlice<u8>>,
    steps: Steps,
    // Declared before `surface`, so dropped before it: the locks are on its memory.
    locks: Vec<PageLock>,
    surface: Surface,
    /// What of `surface` is what the device holds.
    fresh: Wanted,
}

#[derive(Debug)]
struct Kernels {
    deform: Deform,
    bounds: Bounds,
    /// Of a scene whose normals follow the surface.
    normals: Option<Normals>,
    apply: Apply,
}

/// Which step the output shows.
#[derive(Debug, Clone, Copy, Default)]
struct Steps {
    /// The last step that was begun.
    begun: u32,
    /// The last one that ended well, and the state's serial number then; 0 when the output shows nothing whole.
    shown: u32,
    serial: u64,
    /// The last step that changed all domains.
    everything: u32,
}

impl CudaDeformer {
    /// Packs a scene onto the device. With `gl`, output goes straight into those buffers when the driver allows it.
    ///
    /// # Errors
    /// `Fault` when the device refuses; `Unavailable` when NVRTC is missing or the device's memory is too small.
    pub fn new(device: &Arc<Device>, scene: &Arc<Scene>, gl: Option<GlBuffers>) -> Result<Self> {
        let plan = plan(scene);
        device.context().bind_to_thread().map_err(during("device"))?;
        check_memory(device, &plan)?;
        let deform = Deform::new(device, scene, plan.needed(Launch::Deform)?)?;
        let kernels = Kernels {
            bounds: Bounds::new(device, plan.needed(Launch::Bounds)?, deform.pieces())?,
            normals: plan.kernel(Launch::Normals).map(|normals| Normals::new(device, scene, normals)).transpose()?,
            apply: Apply::new(device, deform.packing(), plan.needed(Launch::Apply)?)?,
            deform,
        };
        // SAFETY: the memory is written by the copy that ends every graph before anyone looks.
        let answer = unsafe { device.context().alloc_pinned_with_flags(6, 0) }.map_err(during("allocate"))?;
        let mut deformer = Self {
            whole: None,
            some: None,
            inputs: Inputs::new(device, kernels.deform.packing())?,
            kernels,
            answer,
            output: Output::new(device, &plan, gl)?,
            displacements: match plan.bytes(Role::Displacements) {
                0 => None,
                bytes => Some(room(device, bytes)?),
            },
            steps: Steps::default(),
            locks: Vec::new(),
            surface: Surface::default(),
            fresh: Wanted::ALL,
            device: Arc::clone(device),
            plan,
        };
        // Tables were copied from memory that is gone by now; wait here, so that a fault of theirs shows here.
        deformer.device.stream().synchronize().map_err(during("upload"))?;
        deformer.whole = Some(deformer.capture(false)?);
        deformer.some = Some(deformer.capture(true)?);
        Ok(deformer)
    }

    /// What it compiled and allocated.
    pub const fn plan(&self) -> &Plan {
        &self.plan
    }

    /// How far the modes that were left out may have moved a vertex in the last step, scene units.
    pub fn truncation_bound(&self) -> f64 {
        self.inputs.truncation_bound()
    }

    /// A step as a graph: copies in, kernels, the bounds out. `some`: of a list of changed domains.
    fn capture(&mut self, some: bool) -> Result<CudaGraph> {
        let fail = during("capture");
        let stream = Arc::clone(self.device.stream());
        // Relaxed: a look at pinned memory asks the driver whether it is in use, which stricter modes refuse.
        stream.begin_capture(CUstreamCaptureMode::CU_STREAM_CAPTURE_MODE_RELAXED).map_err(&fail)?;
        let started = self.start(some);
        // The capture ends whatever happened, or the stream would stay in it.
        let graph = stream.end_capture(CUgraphInstantiate_flags::CUDA_GRAPH_INSTANTIATE_FLAG_AUTO_FREE_ON_LAUNCH);
        started?;
        let empty = || Error::Fault { stage: "capture", reason: "the graph is empty".into() };
        graph.map_err(&fail)?.ok_or_else(empty)
    }

    fn start(&mut self, some: bool) -> Result<()> {
        let Self { device, kernels, inputs, .. } = self;
        let values = inputs.values(device);
        inputs.send(device, some.then_some(size_of::<Header>()))?;
        if some {
            kernels.apply.launch(device, values, kernels.deform.list(device))?;
            kernels.deform.launch_listed(device, values)?;
        } else {
            kernels.deform.launch(device, values)?;
        }
        kernels.bounds.launch(device, values, kernels.deform.boxes(device))?;
        kernels.normals.as_ref().map_or(Ok(()), |normals| normals.launch(device, values))?;
        let bounds = values.header + std::mem::offset_of!(Header, bounds) as u64;
        let answer = self.answer.as_mut_slice().map_err(during("capture"))?;
        // SAFETY: the header has six words of bounds, so has `answer`, and the deformer waits for the stream before it
        // reads them.
        unsafe { result::memcpy_dtoh_async(answer, bounds, device.stream().cu_stream()) }.map_err(during("capture"))
    }

    fn run(&mut self, state: &State) -> Result<crate::scene::Bounds> {
        let steps = &mut self.steps;
        let changed = match &state.changed {
            Changed::Some(list) if state.serial == steps.serial + 1 => Some(list.as_slice()),
            _ => None,
        };
        if steps.begun == u32::MAX {
            // Old stamps then look new, which costs work once and is never wrong.
            *steps = Steps::default();
        }
        steps.begun += 1;
        let some: Option<Lengths> = match changed {
            Some(list) if steps.shown > 0 => self.kernels.apply.write(self.kernels.deform.packing(), state, list)?,
            _ => None,
        };
        if some.is_none() {
            steps.everything = steps.begun;
        }
        let lengths = some.unwrap_or_default();
        let header = Header {
            since: if some.is_some() { steps.shown } else { 0 },
            everything: steps.everything,
            step: steps.begun,
            changed: lengths.changed,
            stale: lengths.stale,
            ..Header::default()
        };
        steps.shown = 0;
        let graph = if some.is_some() { &self.some } else { &self.whole };
        let inputs = &mut self.inputs;
        // Normals that follow the surface read its positions again, and so do boxes.
        let keep = some.is_some() || self.kernels.normals.is_some() || self.kernels.bounds.boxes.is_some();
        let displacements = self.displacements.as_ref().map_or(0, |buffer| address(&self.device, buffer));
        let header = Header { displacements, ..header };
        self.output.write(&self.device, keep, |to| {
            let header = Header { positions: to.positions, normals: to.normals, tangents: to.tangents, ..header };
            match some {
                Some(_) => inputs.write_header(&header)?,
                None => inputs.write(&header, state)?,
            }
            let missing = || Error::Fault { stage: "deform", reason: "no graph was captured".into() };
            graph.as_ref().ok_or_else(missing)?.launch().map_err(during("deform"))
        })?;
        self.device.stream().synchronize().map_err(during("deform"))?;
        self.steps.shown = self.steps.begun;
        self.steps.serial = state.serial;
        Ok(bounds_of(self.answer.as_slice().map_err(during("deform"))?))
    }

    /// Copies what of the output is wanted and not there yet.
    fn fetch(&mut self, wanted: Wanted) -> Result<()> {
        let fresh = self.fresh;
        if (wanted.positions || wanted.normals) && !fresh.covers(Wanted::VERTICES) {
            self.fetch_vertices()?;
            self.fresh = self.fresh.or(Wanted::VERTICES);
        }
        if wanted.displacements && !fresh.displacements {
            self.fetch_displacements()?;
            self.fresh.displacements = true;
        }
        if wanted.boxes && !fresh.boxes {
            if let Some(boxes) = &mut self.kernels.bounds.boxes {
                boxes.read(&self.device, &mut self.surface.boxes)?;
            }
            self.fresh.boxes = true;
        }
        Ok(())
    }

    fn fetch_displacements(&mut self) -> Result<()> {
        let Some(buffer) = &self.displacements else { return Ok(()) };
        let list = &mut self.surface.displacements;
        if list.is_empty() {
            list.resize(self.plan.bytes(Role::Displacements) as usize / 4, 0.0);
            // SAFETY: the list never changes its length again, and the locks are dropped before it.
            self.locks.extend(unsafe { PageLock::new(&self.device, list) });
        }
        // SAFETY: the buffer has the bytes of the plan, and the list was made from the same number.
        unsafe { download(&self.device, address(&self.device, buffer), list) }
    }

    fn fetch_vertices(&mut self) -> Result<()> {
        let [positions, normals, tangents] = sizes(&self.plan).map(|bytes| bytes as usize / 4);
        if self.surface.positions.is_empty() {
            let Surface { positions: first, normals: second, tangents: third, .. } = &mut self.surface;
            for (list, length) in [(first, positions), (second, normals), (third, tangents)] {
                list.resize(length, 0.0);
                // SAFETY: the list never changes its length again, and the locks are dropped before it.
                self.locks.extend(unsafe { PageLock::new(&self.device, list) });
            }
        }
        self.output.read(&self.device, &mut self.surface)
    }
}

impl Deformer for CudaDeformer {
    fn backend(&self) -> Backend {
        Backend::Cuda
    }

    fn deform(&mut self, state: &State) -> Result<Deformed> {
        let begin = Instant::now();
        self.fresh = Wanted::default();
        let bounds = self.run(state).inspect_err(|_| {
            // Copies may be in flight that read what the next step overwrites. Their own failure adds nothing.
            self.device.stream().synchronize().ok();
        })?;
        Ok(Deformed { bounds, ms: begin.elapsed().as_secs_f64() * 1e3 })
    }

    fn shares_buffers(&self) -> bool {
        self.output.is_shared()
    }

    fn surface(&mut self) -> Result<&Surface> {
        self.read(Wanted::ALL)
    }

    fn read(&mut self, wanted: Wanted) -> Result<&Surface> {
        self.fetch(wanted)?;
        Ok(&self.surface)
    }
}

impl Drop for CudaDeformer {
    fn drop(&mut self) {
        // Nothing may be freed that the device still uses. After a fault the answer is an error, and nothing runs.
        self.device.stream().synchronize().ok();
    }
}

/// Refuses a scene that cannot fit before half of it is there.
fn check_memory(device: &Device, plan: &Plan) -> Result<()> {
    // What other scenes freed is given back when the stream has come to it.
    device.stream().synchronize().map_err(during("device"))?;
    let (free, _) = device.memory()?;
    if plan.total_bytes() <= free as u64 {
        return Ok(());
    }
    let reason = format!("the scene needs {} bytes, {free} are free on {}", plan.total_bytes(), device.name());
    Err(Error::Unavailable { what: "GPU memory", reason, remedy: "Close other scenes or other programs".into() })
}
