//! The deformer `cuda`: a step is one graph of copies and kernels, and the bounds come back with it.
//!
//! A step can be submitted before the one before it has ended: its values are then written while that one runs. And the
//! host can fetch the vertices of a step while the next runs: that one then writes another output.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Instant;

use cudarc::driver::CudaSlice;

use super::GlBuffers;
use super::apply::{Apply, Lengths, most_domains};
use super::bounds::Bounds;
use super::deform::Deform;
use super::device::Device;
use super::fetch::{Fetches, Lists, Order};
use super::flight::{Flight, Kernels};
use super::inputs::Inputs;
use super::interop::Access;
use super::layout::Header;
use super::memory::{PageLock, address, download, room};
use super::normals::Normals;
use super::output::{Output, Use, sizes};
use super::plan::{Launch, Plan, Role, Tables, plan_of};
use super::rotation::{Rotation, Turn};
use modalcast_model::deform::{Backend, Deformed, Deformer, Fetch, Surface, Wanted};
use modalcast_model::error::{Error, Result, during};
use modalcast_model::scene::{Changed, Scene, State};

/// Steps that may be under way at once.
pub const MOST_UNDER_WAY: usize = 2;

/// The CUDA deformer of one scene. Lives and dies on the thread that owns the OpenGL context, and before the buffers
/// that it shares.
pub struct CudaDeformer {
    // Their graphs name the memory of all that follows.
    flights: Vec<Flight>,
    device: Arc<Device>,
    plan: Plan,
    kernels: Kernels,
    inputs: Inputs,
    output: Output,
    /// u, of a scene that keeps it. One for all outputs, and so are boxes: both are read before the next step is submitted.
    displacements: Option<CudaSlice<u8>>,
    rotation: Rotation,
    /// Oldest first: the flight, and when its step was submitted.
    under_way: VecDeque<(usize, Instant)>,
    /// The flight of the last step.
    last: usize,
    fetches: Fetches,
    /// The last step's and what of it is fetched, until the next is submitted.
    fetch: Option<(Wanted, Fetch)>,
    // Declared before `surface`, so dropped before it: the locks are on its memory.
    locks: Vec<PageLock>,
    surface: Surface,
    /// What of `surface` is what the device holds.
    fresh: Wanted,
}

impl CudaDeformer {
    /// Packs a scene onto the device. With `gl`, output goes straight into those buffers when the driver allows it.
    ///
    /// # Errors
    /// `Fault` when the device refuses; `Unavailable` when NVRTC is missing or the device's memory is too small.
    pub fn new(device: &Arc<Device>, scene: &Arc<Scene>, gl: Option<GlBuffers>) -> Result<Self> {
        let tables = Tables::new(scene);
        let plan = plan_of(scene, &tables);
        device.context().bind_to_thread().map_err(during("device"))?;
        check_memory(device, &plan)?;
        let deform = Deform::new(device, scene, (plan.needed(Launch::Deform)?, plan.kernel(Launch::Batch)), tables)?;
        let apply = plan.kernel(Launch::Apply);
        let kernels = Kernels {
            bounds: Bounds::new(device, scene, plan.needed(Launch::Bounds)?, deform.pieces())?,
            normals: plan.kernel(Launch::Normals).map(|normals| Normals::new(device, scene, normals)).transpose()?,
            apply: apply.map(|apply| Apply::new(device, deform.packing(), apply)).transpose()?,
            deform,
        };
        let output = Output::new(device, &plan, gl)?;
        let inputs = Inputs::new(device, kernels.deform.packing())?;
        // Tables were copied from memory that is gone by now; wait here, so that a fault of theirs shows here.
        device.stream().synchronize().map_err(during("upload"))?;
        Ok(Self {
            flights: vec![Flight::new(device, &kernels, &inputs, output.is_shared())?],
            rotation: Rotation::new(output.most(), most_domains(scene)),
            inputs,
            kernels,
            output,
            displacements: match plan.bytes(Role::Displacements) {
                0 => None,
                bytes => Some(room(device, bytes)?),
            },
            under_way: VecDeque::new(),
            last: 0,
            fetches: Fetches::default(),
            fetch: None,
            locks: Vec::new(),
            surface: Surface::default(),
            fresh: Wanted::ALL,
            device: Arc::clone(device),
            plan,
        })
    }

    /// What it compiled and allocated. A second output comes once vertices are fetched beside a step, and a second set of
    /// pinned memory once a step is submitted beside another.
    pub const fn plan(&self) -> &Plan {
        &self.plan
    }

    /// Outputs that there are: two once vertices were fetched beside a step.
    pub fn outputs(&self) -> usize {
        self.output.count()
    }

    /// How far the modes that were left out may have moved a vertex in the last step, scene units.
    pub fn truncation_bound(&self) -> f64 {
        self.inputs.truncation_bound()
    }

    /// Starts a step, whatever is still under way: at most [`MOST_UNDER_WAY`] with it. [`Self::finish`] waits for the
    /// oldest.
    ///
    /// # Errors
    /// `Busy` when so many are under way; `Fault` of the device, after which none is.
    pub fn submit(&mut self, state: &State) -> Result<()> {
        if self.under_way.len() == MOST_UNDER_WAY {
            return Err(Error::Busy { queue: "steps under way", limit: MOST_UNDER_WAY });
        }
        self.fresh = Wanted::default();
        self.fetch = None;
        let begin = Instant::now();
        let started = self.start(state, begin).inspect_err(|_| self.forget())?;
        self.under_way.push_back((started, begin));
        self.last = started;
        Ok(())
    }

    /// Waits for the oldest step that was submitted.
    ///
    /// # Errors
    /// `Fault` of the device, after which no step is under way; also when none was.
    pub fn finish(&mut self) -> Result<Deformed> {
        let none = || Error::Fault { stage: "deform", reason: "no step is under way".into() };
        let (flight, begin) = self.under_way.pop_front().ok_or_else(none)?;
        let (bounds, light) = self.flights[flight].wait().inspect_err(|_| self.forget())?;
        let whole = begin.elapsed().as_secs_f64() * 1e3;
        let own = self.flights[flight].own_ms().inspect_err(|_| self.forget())?;
        Ok(Deformed { bounds, light, ms: own.unwrap_or(whole) })
    }

    /// Starts the whole graph of the last step once more, for measuring it alone: outputs of our own stay where they are.
    pub fn replay(&self) -> Result<()> {
        self.flights[self.last].launch(false)
    }

    /// Writes a step's values and starts its graph; the flight that it took. `begin`: when the step was submitted.
    fn start(&mut self, state: &State, begin: Instant) -> Result<usize> {
        let set = self.rotation.next_output();
        if let Err(error) = self.output.ensure(&self.device, &self.plan, set) {
            tracing::warn!(%error, "no room for a second output: steps wait until the vertices before them are read");
            self.rotation.stay();
        }
        let at = self.free_flight()?;
        let turn = self.rotation.begin(state);
        let Self { flights, kernels, inputs, .. } = self;
        let flight = &mut flights[at];
        let some = match (&turn.behind, &state.changed, &mut flight.list, &mut kernels.apply) {
            (Some(behind), Changed::Some(changed), Some(list), Some(apply)) => {
                apply.write(list, kernels.deform.packing(), state, (changed, behind))?
            }
            _ => None,
        };
        let header = header(&turn, some, self.rotation.everything(some.is_none()));
        // OpenGL's buffers were copied aside on this very stream.
        if turn.is_read && !self.output.is_shared() {
            self.fetches.let_pass(&self.device, turn.output)?;
        }
        // Normals that follow the surface read its positions again, and so do boxes.
        let keep = some.is_some() || kernels.normals.is_some() || kernels.bounds.boxes.is_some();
        let displacements = self.displacements.as_ref().map_or(0, |buffer| address(&self.device, buffer));
        let header = Header { displacements, ..header };
        let access = if keep { Access::WriteSome } else { Access::WriteAll };
        flight.before_ms = begin.elapsed().as_secs_f64() * 1e3;
        self.output.with(&self.device, Use { set: turn.output, access }, |to| {
            flight.mark_mapped(&self.device)?;
            let header = Header { positions: to.positions, normals: to.normals, tangents: to.tangents, ..header };
            match some {
                Some(_) => Inputs::write_header(&mut flight.values, &header)?,
                None => inputs.write(&mut flight.values, &header, state)?,
            }
            flight.launch(some.is_some())
        })?;
        flight.done.record(self.device.stream()).map_err(during("deform"))?;
        self.rotation.end(state);
        Ok(at)
    }

    /// A flight whose step has ended; made if all there are are under way.
    fn free_flight(&mut self) -> Result<usize> {
        let is_free = |at: &usize| self.under_way.iter().all(|(flight, _)| flight != at);
        if let Some(at) = (0..self.flights.len()).find(is_free) {
            return Ok(at);
        }
        self.flights.push(Flight::new(&self.device, &self.kernels, &self.inputs, self.output.is_shared())?);
        Ok(self.flights.len() - 1)
    }

    /// Waits for what is under way, because the next step overwrites what it reads, and takes no output and no value on
    /// the device for whole. So does every step that fails.
    pub fn forget(&mut self) {
        // Failures of their own add nothing.
        self.device.stream().synchronize().ok();
        self.fetches.synchronize();
        self.under_way.clear();
        self.fetch = None;
        self.rotation.forget();
    }

    fn order(&mut self, wanted: Wanted) -> Result<Fetch> {
        let nothing = || Error::Fault { stage: "fetch", reason: "no step was deformed".into() };
        let set = self.rotation.shown().ok_or_else(nothing)?;
        let length = |wanted: bool, role: Role| if wanted { self.plan.bytes(role) as usize / 4 } else { 0 };
        let lengths = Lists {
            positions: length(wanted.positions, Role::Positions),
            normals: length(wanted.normals, Role::Normals),
            displacements: length(wanted.displacements, Role::Displacements),
        };
        // What else is wanted leaves the output free for the next step.
        let reading = lengths.are_of_output().then(|| self.rotation.read());
        let order = Order { set, lengths, reading, after: &self.flights[self.last].done };
        let Self { device, kernels, displacements, fetches, output, .. } = self;
        let copy_kept = |surface: &mut Surface| {
            if let Some(buffer) = displacements.as_ref() {
                // SAFETY: the buffer has the bytes of the plan, and the list has that length or none.
                unsafe { download(device, address(device, buffer), &mut surface.displacements) }?;
            }
            match &mut kernels.bounds.boxes {
                Some(boxes) if wanted.boxes => boxes.read(device, &mut surface.boxes),
                _ => Ok(()),
            }
        };
        let begun = fetches.start(device, output, order, copy_kept);
        begun.inspect_err(|_| self.fetches.synchronize())
    }

    /// Copies what of the output is wanted and not in `surface` yet.
    fn bring(&mut self, wanted: Wanted) -> Result<()> {
        let fresh = self.fresh;
        if (wanted.positions || wanted.normals) && !fresh.covers(Wanted::VERTICES) {
            self.bring_vertices()?;
            self.fresh = self.fresh.or(Wanted::VERTICES);
        }
        if wanted.displacements && !fresh.displacements {
            self.bring_displacements()?;
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

    fn bring_displacements(&mut self) -> Result<()> {
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

    fn bring_vertices(&mut self) -> Result<()> {
        let nothing = || Error::Fault { stage: "download", reason: "no step was deformed".into() };
        let set = self.rotation.shown().ok_or_else(nothing)?;
        let [positions, normals, tangents] = sizes(&self.plan).map(|bytes| bytes as usize / 4);
        if self.surface.positions.is_empty() {
            let Surface { positions: first, normals: second, tangents: third, .. } = &mut self.surface;
            for (list, length) in [(first, positions), (second, normals), (third, tangents)] {
                list.resize(length, 0.0);
                // SAFETY: the list never changes its length again, and the locks are dropped before it.
                self.locks.extend(unsafe { PageLock::new(&self.device, list) });
            }
        }
        self.output.read(&self.device, set, &mut self.surface)
    }
}

/// The header of a step, but for where its outputs lie.
fn header(turn: &Turn, some: Option<Lengths>, everything: u32) -> Header {
    let lengths = some.unwrap_or_default();
    Header {
        since: if some.is_some() { turn.shown } else { 0 },
        everything,
        step: turn.step,
        changed: lengths.changed,
        stale: lengths.stale,
        ..Header::default()
    }
}

impl Deformer for CudaDeformer {
    fn backend(&self) -> Backend {
        Backend::Cuda
    }

    /// Waits for the steps that were submitted before, too.
    fn deform(&mut self, state: &State) -> Result<Deformed> {
        while self.under_way.len() == MOST_UNDER_WAY {
            self.finish()?;
        }
        self.submit(state)?;
        loop {
            let deformed = self.finish()?;
            if self.under_way.is_empty() {
                return Ok(deformed);
            }
        }
    }

    fn shares_buffers(&self) -> bool {
        self.output.is_shared()
    }

    fn surface(&mut self) -> Result<&Surface> {
        self.read(Wanted::ALL)
    }

    fn read(&mut self, wanted: Wanted) -> Result<&Surface> {
        self.bring(wanted)?;
        Ok(&self.surface)
    }

    /// Positions and normals travel beside the next step. Displacements and boxes, of which the device has but one, are
    /// there when this returns.
    fn fetch(&mut self, wanted: Wanted) -> Result<Fetch> {
        if let Some((_, fetch)) = self.fetch.as_ref().filter(|(there, _)| there.covers(wanted)) {
            return Ok(fetch.clone());
        }
        let fetch = self.order(wanted)?;
        self.fetch = Some((wanted, fetch.clone()));
        Ok(fetch)
    }

    fn fetched(&mut self, fetch: &Fetch) -> Result<Arc<Surface>> {
        let (surface, number) = self.fetches.wait(fetch)?;
        if let Some(number) = number {
            self.rotation.has_read(number);
        }
        Ok(surface)
    }
}

impl Drop for CudaDeformer {
    fn drop(&mut self) {
        // Nothing may be freed that the device still uses. After a fault the answer is an error, and nothing runs.
        self.device.stream().synchronize().ok();
        self.fetches.synchronize();
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
