//! The deformer of the `cuda` backend: a step is one graph of copies and kernels. The graph also reads back the bounds
//! of the step.
//!
//! Steps are double-buffered. A step can be submitted while the previous step is in flight: the host writes the values
//! of the new step while the previous step runs. The host can also fetch the vertices of a step while the next step
//! runs. The next step then writes another output set (buffers of positions, normals and tangents).
//!
//! If OpenGL draws every step and the next state is known, two steps are submitted at once, because each change of the GPU
//! between the contexts of OpenGL and CUDA takes 0.2 ms. The second one, the step ahead, is shown when its state is deformed.

use std::collections::VecDeque;
use std::rc::Rc;
use std::sync::Arc;
use std::time::Instant;

use super::inputs::StepInputs;
use super::launchers::apply::ApplyKernel;
use super::launchers::bounds::BoundsKernel;
use super::launchers::deform::{DeformKernel, PositionKernels};
use super::launchers::normals::NormalsKernel;
use super::output::{OutputAddresses, OutputBuffers, output_sizes};
use super::output_ring::{OutputRing, StepTarget};
use super::pinned_surface::{PinnedSurface, SurfaceLengths};
use super::readback::{ReadbackPool, ReadbackRequest, SynchronousLists};
use super::step_slot::{StepKernels, StepKind, StepSlot};
use super::views::DeviceVertices;
use crate::gpu::launch::cleanup::WaitForStream;
use crate::gpu::launch::error::cuda_error;
use crate::gpu::launch::{Device, DeviceBuffer, KernelKind};
use crate::gpu::tables::change_list::{ChangeListLengths, ChangedDomains, max_changed_domains};
use crate::gpu::tables::device_tables::{CudaDeformerOptions, DeviceTables};
use crate::gpu::tables::layout::StepHeader;
use crate::gpu::tables::plan::{BufferRole, DeformPlan, plan_from_tables};
use modalcast_model::deform::{
    Backend, DeformSummary, DeformedSurface, Deformer, SharedStep, VertexAttributes, VertexReadback,
};
use modalcast_model::error::{Error, Result, fault};
use modalcast_model::raster::GlVertexBuffers;
use modalcast_model::scene::{DirtyDomains, FloatingOrigins, Scene, SceneState};
use modalcast_model::shared_memory::SharedPositions;

/// Maximum number of steps in flight.
pub const MAX_STEPS_IN_FLIGHT: usize = 2;

/// A submitted step.
#[derive(Debug, Clone, Copy)]
struct StepInFlight {
    /// Index in [`CudaDeformer::step_slots`].
    slot: usize,
    submitted: Instant,
    /// Milliseconds of the host's work before the step could begin on the device. `None` if the last step was not
    /// drawn, so that the step does not wait for frames of OpenGL.
    ms_before_begin: Option<f64>,
}

/// The CUDA deformer of one scene. It stays on the thread that created it, which owns the OpenGL context.
///
/// Dropping it waits for all steps and copies before any memory that they use is released.
pub struct CudaDeformer {
    /// Memory and graphs of the steps in flight; at most [`MAX_STEPS_IN_FLIGHT`].
    step_slots: Vec<StepSlot>,
    device: Arc<Device>,
    plan: DeformPlan,
    kernels: StepKernels,
    inputs: StepInputs,
    output: OutputBuffers,
    /// u, if displacements are an output of the scene. One buffer is sufficient for all output sets, because
    /// displacements are read before the next step is submitted. The same holds for the boxes of domains
    /// ([`BoundsKernel::boxes`]).
    displacements: Option<DeviceBuffer>,
    output_ring: OutputRing,
    /// Steps in flight, oldest first.
    in_flight: VecDeque<StepInFlight>,
    /// Index in `step_slots` of the step that is shown.
    shown_slot: usize,
    /// The origins of the step that is shown.
    shown_origins: Option<Arc<FloatingOrigins>>,
    /// The state that probably follows the next one.
    announced: Option<Arc<SceneState>>,
    /// The state of the newest step in flight, if that is a step ahead.
    ahead: Option<Arc<SceneState>>,
    /// Number of steps that were started, including steps ahead.
    started_steps: u64,
    readbacks: ReadbackPool,
    /// The readback of the last step and the attributes it copies; `None` after the next step is submitted.
    readback: Option<(VertexAttributes, VertexReadback)>,
    surface: PinnedSurface,
    /// Attributes of `surface` that show the last step.
    host_attributes: VertexAttributes,
    /// Whether OpenGL's buffers contain the vertices of the last step.
    gl_buffers_are_current: bool,
    /// Whether [`Deformer::fill_gl_buffers`] was called after the last step. The next step then also fills OpenGL's
    /// buffers.
    is_drawn: bool,
}

/// The parts of a deformer that need neither OpenGL nor the thread of the deformer: compiled kernels and uploaded
/// tables. Compiling takes hundreds of milliseconds and the upload of U can take longer, so another thread prepares a
/// scene while the device thread executes the steps of other scenes.
pub struct PreparedDeformer {
    device: Arc<Device>,
    plan: DeformPlan,
    kernels: StepKernels,
    inputs: StepInputs,
    displacements: Option<DeviceBuffer>,
    max_changed_domains: usize,
}

impl PreparedDeformer {
    /// Compiles the kernels of a scene and uploads its tables. Any thread may call this. The work has a stream of its
    /// own, and is complete when this returns.
    ///
    /// # Errors
    /// `Fault` when the device fails; `Unavailable` when NVRTC is missing or the device's memory is too small.
    pub fn new(device: &Arc<Device>, scene: &Arc<Scene>, options: CudaDeformerOptions) -> Result<Self> {
        let tables = DeviceTables::new(scene, options);
        let plan = plan_from_tables(scene, &tables);
        let upload_device = device.with_own_stream()?;
        let _current = upload_device.enter()?;
        check_memory(&upload_device, &plan)?;
        let normals = plan.kernel(KernelKind::Normals);
        let normals = normals.map(|kernel| NormalsKernel::new(&upload_device, scene, &tables, kernel)).transpose()?;
        let kernels =
            PositionKernels { deform: plan.require_kernel(KernelKind::Deform)?, batch: plan.kernel(KernelKind::Batch) };
        let deform = DeformKernel::new(&upload_device, scene, kernels, tables)?;
        let apply = plan.kernel(KernelKind::Apply);
        let bounds = plan.require_kernel(KernelKind::Bounds)?;
        let kernels = StepKernels {
            bounds: BoundsKernel::new(&upload_device, bounds, options.bounding_axes, &deform)?,
            normals,
            apply: apply.map(|apply| ApplyKernel::new(&upload_device, deform.packer(), apply)).transpose()?,
            deform,
        };
        let inputs = StepInputs::new(&upload_device, kernels.deform.packer())?;
        let displacements = match plan.bytes(BufferRole::Displacements) {
            0 => None,
            bytes => Some(DeviceBuffer::zeroed(&upload_device, bytes)?),
        };
        upload_device.synchronize("upload")?;
        let max_changed_domains = max_changed_domains(scene);
        Ok(Self { device: Arc::clone(device), plan, kernels, inputs, displacements, max_changed_domains })
    }
}

impl CudaDeformer {
    /// Uploads a scene to the device. Drawn steps are copied to `gl_buffers` on the device if the driver can register
    /// them.
    ///
    /// # Errors
    /// Those of [`PreparedDeformer::new`] and [`Self::from_prepared`].
    pub fn new(
        device: &Arc<Device>,
        scene: &Arc<Scene>,
        gl_buffers: Option<GlVertexBuffers>,
        options: CudaDeformerOptions,
    ) -> Result<Self> {
        Self::from_prepared(PreparedDeformer::new(device, scene, options)?, gl_buffers)
    }

    /// Completes a prepared deformer with its output buffers. Drawn steps are copied to `gl_buffers` on the device if
    /// the driver can register them.
    ///
    /// # Errors
    /// `Fault` when the device fails or its memory is too small.
    pub fn from_prepared(prepared: PreparedDeformer, gl_buffers: Option<GlVertexBuffers>) -> Result<Self> {
        let PreparedDeformer { device, plan, kernels, inputs, displacements, max_changed_domains } = prepared;
        let _current = device.enter()?;
        let output = OutputBuffers::new(&device, &plan, gl_buffers)?;
        Ok(Self {
            step_slots: vec![StepSlot::new(&device, &kernels, &inputs)?],
            output_ring: OutputRing::new(output.max_sets(), max_changed_domains),
            inputs,
            kernels,
            output,
            displacements,
            in_flight: VecDeque::new(),
            shown_slot: 0,
            shown_origins: None,
            announced: None,
            ahead: None,
            started_steps: 0,
            readbacks: ReadbackPool::default(),
            readback: None,
            surface: PinnedSurface::empty(),
            // Before the first step there is nothing to copy to the host.
            host_attributes: VertexAttributes::ALL,
            gl_buffers_are_current: false,
            is_drawn: false,
            device,
            plan,
        })
    }

    /// The compiled kernels and allocated buffers. The plan excludes memory that is allocated on demand. The first
    /// fetch of vertices concurrently with a step allocates the second output set. The second step slot is allocated
    /// when two steps are in flight.
    pub const fn plan(&self) -> &DeformPlan {
        &self.plan
    }

    /// Number of allocated output sets: two after vertices were fetched concurrently with a step, else one.
    pub fn outputs(&self) -> usize {
        self.output.count()
    }

    /// Starts a step without waiting for the steps in flight. [`Self::finish`] waits for the oldest step.
    ///
    /// # Errors
    /// `Busy` when [`MAX_STEPS_IN_FLIGHT`] steps are already in flight; `Fault` of the device, after which no step is
    /// in flight.
    pub fn submit(&mut self, state: &SceneState) -> Result<()> {
        if self.in_flight.len() == MAX_STEPS_IN_FLIGHT {
            return Err(Error::Busy { queue: "steps in flight", limit: MAX_STEPS_IN_FLIGHT });
        }
        if self.ahead.is_some() {
            // The state of the step ahead is not the one that is deformed.
            self.invalidate();
        }
        self.host_attributes = VertexAttributes::default();
        self.readback = None;
        let submitted = Instant::now();
        // If a panic unwinds from `start`, the step may run although it is not in `in_flight`: wait for it.
        let guard = WaitForStream::new(self.device.stream());
        let was_drawn = std::mem::take(&mut self.is_drawn);
        let step = self.start(state, submitted, was_drawn, false).inspect_err(|_| self.invalidate())?;
        if let Some(step) = step {
            self.shown_slot = step.slot;
            self.shown_origins = state.origins.clone();
            self.in_flight.push_back(step);
        }
        guard.disarm();
        Ok(())
    }

    /// Starts a step ahead, which follows the step that [`Self::submit`] has started. Does nothing if no output is free.
    fn submit_ahead(&mut self, state: &Arc<SceneState>) -> Result<()> {
        let guard = WaitForStream::new(self.device.stream());
        if let Some(step) = self.start(state, Instant::now(), true, true).inspect_err(|_| self.invalidate())? {
            self.in_flight.push_back(step);
            self.ahead = Some(Arc::clone(state));
        }
        guard.disarm();
        Ok(())
    }

    /// Waits for a step. `None` if its output is not in shared memory.
    fn shared_step(
        &mut self,
        output: Option<usize>,
        slot: usize,
        step: u64,
        origins: Option<Arc<FloatingOrigins>>,
    ) -> Result<Option<SharedStep>> {
        let range = output.and_then(|set| self.output.shared_positions(&self.device, set));
        let Some(range) = range else { return Ok(None) };
        let (bounds, oriented_bounds) = self.step_slots[slot].wait().inspect_err(|_| self.invalidate())?;
        let positions = SharedPositions { range: Rc::new(range), step };
        Ok(Some(SharedStep { positions, bounds, oriented_bounds, origins }))
    }

    /// Whether a step ahead leaves everything that readers of the shown step read: the device has one buffer each for
    /// displacements and boxes.
    fn supports_steps_ahead(&self) -> bool {
        !self.output.maps_gl_buffers() && self.displacements.is_none() && self.kernels.bounds.boxes.is_none()
    }

    /// Waits for the oldest step in flight.
    ///
    /// # Errors
    /// `Fault` when no step is in flight, or of the device. Afterwards no step is in flight.
    pub fn finish(&mut self) -> Result<DeformSummary> {
        let missing_step = || Error::Fault { stage: "deform", reason: "expected a step in flight, got none".into() };
        let StepInFlight { slot, submitted, ms_before_begin } = self.in_flight.pop_front().ok_or_else(missing_step)?;
        let (bounds, oriented_bounds) = self.step_slots[slot].wait().inspect_err(|_| self.invalidate())?;
        let ms = match ms_before_begin {
            None => submitted.elapsed().as_secs_f64() * 1e3,
            Some(ms_before_begin) => {
                ms_before_begin + self.step_slots[slot].ms_since_begin().inspect_err(|_| self.invalidate())?
            }
        };
        Ok(DeformSummary { bounds, oriented_bounds, ms })
    }

    /// Waits for all steps in flight up to the one that is shown.
    fn finish_shown(&mut self) -> Result<DeformSummary> {
        loop {
            let summary = self.finish()?;
            if self.in_flight.len() == usize::from(self.ahead.is_some()) {
                return Ok(summary);
            }
        }
    }

    /// The vertices of the shown step on the device. Work on the device's stream that reads them is ordered after the
    /// step, and before later steps.
    ///
    /// # Errors
    /// `Fault` when there was no step.
    pub fn device_vertices(&self) -> Result<DeviceVertices<'_>> {
        let no_step = || Error::Fault { stage: "vertices", reason: "expected a deformed step, got none".into() };
        let ranges = self.output.ranges(self.output_ring.shown_output().ok_or_else(no_step)?);
        // SAFETY: the ranges are those of an output set, which exists as long as the deformer. A deformer waits for the
        // stream before it releases them.
        Ok(unsafe { DeviceVertices::from_ranges(ranges, self.device.stream()) })
    }

    /// Starts the graph of the last full step again, to measure its time.
    ///
    /// # Errors
    /// `Fault` when there was no step, or when the device fails.
    pub fn replay(&self) -> Result<()> {
        if self.output_ring.shown_output().is_none() {
            return Err(Error::Fault { stage: "replay", reason: "expected a deformed step, got none".into() });
        }
        self.step_slots[self.shown_slot].launch(StepKind::Full)
    }

    /// Writes the values of a step and starts its graph. If the last step was drawn, also fills OpenGL's mapped buffers.
    /// `None` for a step ahead if no output is free.
    fn start(
        &mut self,
        state: &SceneState,
        submitted: Instant,
        was_drawn: bool,
        is_ahead: bool,
    ) -> Result<Option<StepInFlight>> {
        let fills_gl_buffers = was_drawn && self.output.maps_gl_buffers();
        self.gl_buffers_are_current = false;
        let _current = self.device.enter()?;
        for set in 0..self.output.count() {
            self.output_ring.set_read_by_gl(set, self.output.is_read_by_gl(set));
        }
        let next_output = if is_ahead { self.output_ring.ahead_output() } else { Some(self.output_ring.next_output()) };
        let Some(set) = next_output else { return Ok(None) };
        match self.output.ensure_set(&self.device, &self.plan, set) {
            Ok(()) => {}
            Err(lost @ Error::DeviceLost { .. }) => return Err(lost),
            Err(error) => {
                tracing::warn!(%error, "no memory for a second output: steps wait until the vertices are read");
                self.output_ring.forbid_more_outputs();
            }
        }
        let slot_index = self.acquire_step_slot()?;
        let target = match is_ahead {
            true => self.output_ring.begin_step_ahead(state),
            false => Some(self.output_ring.begin_step(state)),
        };
        let Some(target) = target else { return Ok(None) };
        let Self { step_slots, kernels, inputs, .. } = self;
        let step_slot = &mut step_slots[slot_index];
        // The lengths of the lists of a partial step, `None` for a full step. `changed` are the domains that this step
        // changes. `outdated` are the domains that earlier steps changed while they wrote the other output.
        let list_lengths =
            match (&target.dirty_domains, &state.dirty_domains, &mut step_slot.change_list, &mut kernels.apply) {
                (Some(outdated), DirtyDomains::Some(changed), Some(list), Some(apply)) => {
                    apply.write(list, kernels.deform.packer(), state, ChangedDomains { changed, outdated })?
                }
                _ => None,
            };
        let last_full_step = self.output_ring.update_last_full_step(list_lengths.is_none());
        let header = header(&target, list_lengths, last_full_step);
        if target.is_being_read {
            self.readbacks.wait_for_reads(&self.device, target.output)?;
        }
        let wait_begin = Instant::now();
        self.output.wait_for_gl(target.output)?;
        let wait_for_gl = wait_begin.elapsed();
        let OutputAddresses { positions, normals, tangents } = self.output.addresses(target.output);
        let displacements = self.displacements.as_ref().map_or(0, DeviceBuffer::address);
        let header = StepHeader { positions, normals, tangents, displacements, ..header };
        match list_lengths {
            Some(_) => StepInputs::write_header(&mut step_slot.values, &header)?,
            None => inputs.write(&mut step_slot.values, &header, state)?,
        }
        let step_kind = if list_lengths.is_some() { StepKind::Partial } else { StepKind::Full };
        let ms_before_begin = was_drawn.then(|| submitted.elapsed().saturating_sub(wait_for_gl).as_secs_f64() * 1e3);
        if fills_gl_buffers {
            let (device, stream) = (&self.device, self.device.stream());
            self.output.copy_to_gl_after(device, target.output, || {
                step_slot.record_begin(device)?;
                step_slot.launch(step_kind)?;
                step_slot.done.record(stream).map_err(cuda_error("deform"))
            })?;
        } else {
            if was_drawn {
                step_slot.record_begin(&self.device)?;
            }
            step_slot.launch(step_kind)?;
            step_slot.done.record(self.device.stream()).map_err(cuda_error("deform"))?;
        }
        self.gl_buffers_are_current = fills_gl_buffers;
        self.output_ring.end_step(state);
        self.started_steps += 1;
        Ok(Some(StepInFlight { slot: slot_index, submitted, ms_before_begin }))
    }

    /// Returns a step slot whose step has ended; allocates one if all are in flight.
    fn acquire_step_slot(&mut self) -> Result<usize> {
        let is_free = |slot: &usize| self.in_flight.iter().all(|step| step.slot != *slot);
        if let Some(slot) = (0..self.step_slots.len()).find(is_free) {
            return Ok(slot);
        }
        self.step_slots.push(StepSlot::new(&self.device, &self.kernels, &self.inputs)?);
        Ok(self.step_slots.len() - 1)
    }

    /// Waits for all steps in flight, and marks all outputs and the values on the device as invalid. This also happens
    /// after a failed step.
    pub fn invalidate(&mut self) {
        // The error of the failed step is already reported.
        self.device.stream().synchronize().ok();
        self.readbacks.synchronize();
        self.in_flight.clear();
        self.ahead = None;
        self.gl_buffers_are_current = false;
        self.readback = None;
        self.output_ring.invalidate();
    }

    /// Starts a readback of the last step.
    fn start_readback(&mut self, attributes: VertexAttributes) -> Result<VertexReadback> {
        let missing_step = || Error::Fault { stage: "fetch", reason: "expected a deformed step, got none".into() };
        let set = self.output_ring.shown_output().ok_or_else(missing_step)?;
        let length =
            |is_requested: bool, role: BufferRole| if is_requested { self.plan.bytes(role) as usize / 4 } else { 0 };
        let lengths = SurfaceLengths {
            positions: length(attributes.positions, BufferRole::Positions),
            normals: length(attributes.normals, BufferRole::Normals),
            tangents: 0,
            displacements: length(attributes.displacements, BufferRole::Displacements),
        };
        // A readback of displacements and boxes does not read the output set, so it need not delay a step that writes
        // the set.
        let reads_output = lengths.positions + lengths.normals > 0;
        let read_id = reads_output.then(|| self.output_ring.begin_read());
        let request = ReadbackRequest { set, lengths, read_id, step_done: &self.step_slots[self.shown_slot].done };
        let Self { device, kernels, displacements, readbacks, output, .. } = self;
        readbacks.start(device, output, request, |lists: SynchronousLists<'_>| {
            if let Some(buffer) = displacements.as_ref() {
                buffer.read(device, 0, lists.displacements)?;
            }
            match &mut kernels.bounds.boxes {
                Some(boxes) if attributes.boxes => boxes.read(device, lists.boxes),
                _ => Ok(()),
            }
        })
    }

    /// Copies the requested attributes of the last step to `surface`, except those that were copied before.
    fn download_attributes(&mut self, attributes: VertexAttributes) -> Result<()> {
        let host_attributes = self.host_attributes;
        if (attributes.positions || attributes.normals)
            && !host_attributes.contains(VertexAttributes::POSITIONS_AND_NORMALS)
        {
            self.download_vertices()?;
            self.host_attributes = self.host_attributes.union(VertexAttributes::POSITIONS_AND_NORMALS);
        }
        if attributes.displacements && !host_attributes.displacements {
            self.download_displacements()?;
            self.host_attributes.displacements = true;
        }
        if attributes.boxes && !host_attributes.boxes {
            if let Some(boxes) = &mut self.kernels.bounds.boxes {
                boxes.read(&self.device, self.surface.lists()?.boxes)?;
            }
            self.host_attributes.boxes = true;
        }
        Ok(())
    }

    fn download_displacements(&mut self) -> Result<()> {
        let Some(buffer) = &self.displacements else { return Ok(()) };
        let displacements = self.plan.bytes(BufferRole::Displacements) as usize / 4;
        self.surface.allocate(&self.device, SurfaceLengths { displacements, ..SurfaceLengths::default() })?;
        buffer.read(&self.device, 0, self.surface.lists()?.displacements)
    }

    fn download_vertices(&mut self) -> Result<()> {
        let missing_step = || Error::Fault { stage: "download", reason: "expected a deformed step, got none".into() };
        let set = self.output_ring.shown_output().ok_or_else(missing_step)?;
        let [positions, normals, tangents] = output_sizes(&self.plan).map(|bytes| bytes as usize / 4);
        let lengths = SurfaceLengths { positions, normals, tangents, displacements: 0 };
        self.surface.allocate(&self.device, lengths)?;
        self.output.read(&self.device, set, self.surface.lists()?)
    }
}

/// The header of a step, without the addresses of its outputs. The kernels compute the domains that changed after
/// `output_step`. In a full step, `output_step` is 0, which is before all changes.
fn header(target: &StepTarget, list_lengths: Option<ChangeListLengths>, last_full_step: u32) -> StepHeader {
    let lengths = list_lengths.unwrap_or_default();
    StepHeader {
        output_step: if list_lengths.is_some() { target.shown_step } else { 0 },
        last_full_step,
        step: target.step,
        change_count: lengths.change_count,
        dirty_tile_count: lengths.dirty_tile_count,
        ..StepHeader::default()
    }
}

impl Deformer for CudaDeformer {
    fn backend(&self) -> Backend {
        Backend::Cuda
    }

    /// Also waits for all steps that are in flight. Computes the announced state, too, if the last step was drawn, so that
    /// the device computes both in one turn.
    fn deform(&mut self, state: &SceneState) -> Result<DeformSummary> {
        let announced = self.announced.take();
        // An address identifies a state, because the deformer shares the state of the step ahead.
        if self.ahead.take_if(|ahead| std::ptr::eq(Arc::as_ptr(ahead), state)).is_some() {
            self.output_ring.show_step_ahead();
            self.shown_origins = state.origins.clone();
            self.host_attributes = VertexAttributes::default();
            self.readback = None;
            (self.gl_buffers_are_current, self.is_drawn) = (false, false);
            self.shown_slot = self.in_flight.back().map_or(self.shown_slot, |step| step.slot);
            return self.finish_shown();
        }
        while self.in_flight.len() == MAX_STEPS_IN_FLIGHT {
            self.finish()?;
        }
        let is_drawn = self.is_drawn;
        self.submit(state)?;
        if let Some(next) = announced.filter(|_| is_drawn && self.in_flight.len() == 1 && self.supports_steps_ahead()) {
            self.submit_ahead(&next)?;
        }
        self.finish_shown()
    }

    fn announce(&mut self, following: &Arc<SceneState>) {
        self.announced = Some(Arc::clone(following));
    }

    fn shared_steps(&mut self) -> Result<Vec<SharedStep>> {
        let output = self.output_ring.shown_output();
        let shown_step = self.started_steps - u64::from(self.ahead.is_some());
        let Some(shown) = self.shared_step(output, self.shown_slot, shown_step, self.shown_origins.clone())? else {
            return Ok(Vec::new());
        };
        let ahead = match (self.ahead.clone(), self.in_flight.back().copied()) {
            (Some(state), Some(step)) => {
                let output = self.output_ring.newest_output();
                self.shared_step(output, step.slot, self.started_steps, state.origins.clone())?
            }
            _ => None,
        };
        Ok(std::iter::once(shown).chain(ahead).collect())
    }

    fn fills_gl_buffers(&self) -> bool {
        self.output.has_gl_buffers()
    }

    fn fill_gl_buffers(&mut self) -> Result<()> {
        let missing_step = || Error::Fault { stage: "interop", reason: "expected a deformed step, got none".into() };
        let set = self.output_ring.shown_output().ok_or_else(missing_step)?;
        if !self.gl_buffers_are_current {
            if self.output.maps_gl_buffers() {
                self.output.copy_to_gl_after(&self.device, set, || Ok(()))?;
            } else if self.output.has_gl_buffers() {
                // OpenGL's commands are not ordered with those of CUDA.
                self.step_slots[self.shown_slot].done.synchronize().map_err(cuda_error("interop"))?;
                self.output.copy_by_gl(set)?;
            } else {
                return Err(fault("interop", "expected OpenGL buffers that the device can fill, got none"));
            }
        }
        (self.gl_buffers_are_current, self.is_drawn) = (true, true);
        Ok(())
    }

    fn surface(&mut self) -> Result<&DeformedSurface> {
        self.surface_with(VertexAttributes::ALL)
    }

    fn surface_with(&mut self, attributes: VertexAttributes) -> Result<&DeformedSurface> {
        self.download_attributes(attributes)?;
        Ok(self.surface.surface())
    }

    /// Copies positions and normals concurrently with the next step. The copies of displacements and boxes, of which
    /// the device has only one buffer each, are complete when this returns.
    fn readback(&mut self, attributes: VertexAttributes) -> Result<VertexReadback> {
        if let Some((_, readback)) = self.readback.as_ref().filter(|(copied, _)| copied.contains(attributes)) {
            return Ok(readback.clone());
        }
        let readback = self.start_readback(attributes)?;
        self.readback = Some((attributes, readback.clone()));
        Ok(readback)
    }

    fn wait_readback(&mut self, readback: &VertexReadback) -> Result<Arc<DeformedSurface>> {
        let (surface, read_id) = self.readbacks.wait(readback)?;
        if let Some(read_id) = read_id {
            self.output_ring.end_read(read_id);
        }
        Ok(surface)
    }
}

impl Drop for CudaDeformer {
    fn drop(&mut self) {
        // Wait, because the device uses memory that is freed next. After a fault the call fails, but then no kernel
        // runs.
        self.device.stream().synchronize().ok();
        self.readbacks.synchronize();
    }
}

/// Rejects a scene that does not fit into the device's free memory. Does not wait for the device's stream, which
/// another thread may be capturing.
fn check_memory(device: &Device, plan: &DeformPlan) -> Result<()> {
    let (free, _) = device.memory()?;
    if plan.total_bytes() <= free as u64 {
        return Ok(());
    }
    let reason = format!("expected {} free bytes on {}, got {free}", plan.total_bytes(), device.name());
    Err(Error::Unavailable { what: "GPU memory", reason, remedy: "Close other scenes or other programs".into() })
}
