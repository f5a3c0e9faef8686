//! The deformer of the `cuda` backend: a step is one graph of copies and kernels, and its bounds are read back with it.
//!
//! Steps are double-buffered. A step can be submitted while the previous one is in flight: the host writes its values
//! while the previous step runs. The host can also fetch the vertices of a step while the next step runs: the next step
//! then writes another output set.

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

/// Maximum number of steps in flight.
pub const MOST_UNDER_WAY: usize = 2;

/// The CUDA deformer of one scene. Create and drop it on the thread that owns the OpenGL context, and drop it before
/// the OpenGL buffers that it shares.
pub struct CudaDeformer {
    // First, so dropped first: the graphs refer to the memory of the fields below.
    flights: Vec<Flight>,
    device: Arc<Device>,
    plan: Plan,
    kernels: Kernels,
    inputs: Inputs,
    output: Output,
    /// u, if the scene keeps displacements. All output sets share this buffer, and also the boxes, because both are
    /// read before the next step is submitted.
    displacements: Option<CudaSlice<u8>>,
    rotation: Rotation,
    /// Steps in flight, oldest first: ring slot and time of submission.
    under_way: VecDeque<(usize, Instant)>,
    /// Ring slot of the last step.
    last: usize,
    fetches: Fetches,
    /// The last step's fetch and the attributes it copies; `None` after the next step is submitted.
    fetch: Option<(Wanted, Fetch)>,
    // Declared before `surface`, so dropped before it: the locks refer to its memory.
    locks: Vec<PageLock>,
    surface: Surface,
    /// Attributes of `surface` that are up to date with the device.
    fresh: Wanted,
}

impl CudaDeformer {
    /// Packs a scene onto the device. With `gl`, steps write directly into those buffers when the driver allows it.
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
        // The tables were copied from temporary host memory. Wait here, so that an upload error is reported here.
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

    /// The compiled kernels and allocated buffers. The plan does not count the second output set, which is allocated
    /// when vertices are fetched concurrently with a step, nor the second ring slot of pinned memory, which is
    /// allocated when a step is submitted while another is in flight.
    pub const fn plan(&self) -> &Plan {
        &self.plan
    }

    /// Number of output sets: two after vertices were fetched concurrently with a step.
    pub fn outputs(&self) -> usize {
        self.output.count()
    }

    /// Bound of the displacement that the truncated modes cause at any vertex in the last step, scene units.
    pub fn truncation_bound(&self) -> f64 {
        self.inputs.truncation_bound()
    }

    /// Starts a step without waiting for the steps in flight, of which there may be [`MOST_UNDER_WAY`] with this one.
    /// [`Self::finish`] waits for the oldest.
    ///
    /// # Errors
    /// `Busy` when [`MOST_UNDER_WAY`] steps are in flight; `Fault` of the device, after which no step is in flight.
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

    /// Waits for the oldest step in flight.
    ///
    /// # Errors
    /// `Fault` of the device, after which no step is in flight. Also `Fault` when no step was in flight.
    pub fn finish(&mut self) -> Result<Deformed> {
        let none = || Error::Fault { stage: "deform", reason: "no step is under way".into() };
        let (flight, begin) = self.under_way.pop_front().ok_or_else(none)?;
        let (bounds, light) = self.flights[flight].wait().inspect_err(|_| self.forget())?;
        let whole = begin.elapsed().as_secs_f64() * 1e3;
        let own = self.flights[flight].own_ms().inspect_err(|_| self.forget())?;
        Ok(Deformed { bounds, light, ms: own.unwrap_or(whole) })
    }

    /// Starts the graph of the last full step again, to measure the graph alone. Only for outputs that the deformer
    /// owns: shared OpenGL buffers are not mapped here.
    pub fn replay(&self) -> Result<()> {
        self.flights[self.last].launch(false)
    }

    /// Writes the values of a step and starts its graph. Returns the ring slot. `begin`: time of submission.
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
        // Shared OpenGL buffers are copied to the back buffer on this same stream, so the step is already ordered after
        // it.
        if turn.is_read && !self.output.is_shared() {
            self.fetches.let_pass(&self.device, turn.output)?;
        }
        // `normals` and the boxes read the positions again, so the driver must not discard them.
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

    /// A ring slot whose step has ended; allocates one if all are in flight.
    fn free_flight(&mut self) -> Result<usize> {
        let is_free = |at: &usize| self.under_way.iter().all(|(flight, _)| flight != at);
        if let Some(at) = (0..self.flights.len()).find(is_free) {
            return Ok(at);
        }
        self.flights.push(Flight::new(&self.device, &self.kernels, &self.inputs, self.output.is_shared())?);
        Ok(self.flights.len() - 1)
    }

    /// Waits for all steps in flight, whose inputs the next step would overwrite, and marks all outputs and the values
    /// on the device as invalid. Every failed step does the same.
    pub fn forget(&mut self) {
        // The step has already failed, so a second error adds nothing.
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
        // Other attributes do not need the output set, which remains free for the next step.
        let reading = lengths.are_of_output().then(|| self.rotation.read());
        let order = Order { set, lengths, reading, after: &self.flights[self.last].done };
        let Self { device, kernels, displacements, fetches, output, .. } = self;
        let copy_kept = |surface: &mut Surface| {
            if let Some(buffer) = displacements.as_ref() {
                // SAFETY: the buffer has the bytes of the plan, and the list has that length or is empty.
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

    /// Copies the wanted attributes that are not yet up to date in `surface`.
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
            // SAFETY: the length of the list never changes again, and the locks are dropped before it.
            self.locks.extend(unsafe { PageLock::new(&self.device, list) });
        }
        // SAFETY: the buffer has the bytes of the plan, from which the list has its length.
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
                // SAFETY: the length of the list never changes again, and the locks are dropped before it.
                self.locks.extend(unsafe { PageLock::new(&self.device, list) });
            }
        }
        self.output.read(&self.device, set, &mut self.surface)
    }
}

/// The header of a step, without the addresses of its outputs.
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

    /// Also waits for the steps that were submitted before.
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

    /// Positions and normals are copied concurrently with the next step. Displacements and boxes exist once on the
    /// device, so their copy is complete when this returns.
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
        // The device must not use memory that is about to be freed. After a fault the call fails, and no kernel runs.
        self.device.stream().synchronize().ok();
        self.fetches.synchronize();
    }
}

/// Refuses a scene that cannot fit before any part of it is uploaded.
fn check_memory(device: &Device, plan: &Plan) -> Result<()> {
    // Frees are stream-ordered: synchronize, so that memory freed by other scenes counts as free.
    device.stream().synchronize().map_err(during("device"))?;
    let (free, _) = device.memory()?;
    if plan.total_bytes() <= free as u64 {
        return Ok(());
    }
    let reason = format!("the scene needs {} bytes, {free} are free on {}", plan.total_bytes(), device.name());
    Err(Error::Unavailable { what: "GPU memory", reason, remedy: "Close other scenes or other programs".into() })
}
