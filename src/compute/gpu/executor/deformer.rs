//! The deformer of the `cuda` backend: a step is one graph of copies and kernels, and its bounds are read back with it.
//!
//! Steps are double-buffered. A step can be submitted while the previous one is in flight: the host writes its values
//! while the previous step runs. The host can also fetch the vertices of a step while the next step runs: the next step
//! then writes another output set.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Instant;

use super::inputs::StepInputs;
use super::interop::MapAccess;
use super::launchers::apply::ApplyKernel;
use super::launchers::bounds::BoundsKernel;
use super::launchers::deform::{DeformKernel, PositionKernels};
use super::launchers::normals::NormalsKernel;
use super::output::{OutputAccess, OutputBuffers, output_sizes};
use super::output_ring::{OutputRing, StepTarget};
use super::pinned_surface::{PinnedSurface, SurfaceLengths};
use super::readback::{ReadbackPool, ReadbackRequest, SynchronousLists};
use super::step_slot::{StepKernels, StepKind, StepSlot};
use crate::gpu::launch::cleanup::WaitForStream;
use crate::gpu::launch::error::cuda_error;
use crate::gpu::launch::{Device, DeviceBuffer, KernelKind};
use crate::gpu::tables::change_list::{ChangeListLengths, ChangedDomains, max_changed_domains};
use crate::gpu::tables::device_tables::{CudaDeformerOptions, DeviceTables};
use crate::gpu::tables::layout::Header;
use crate::gpu::tables::plan::{BufferRole, DeformPlan, plan_from_tables};
use modalcast_model::deform::{Backend, DeformSummary, DeformedSurface, Deformer, VertexAttributes, VertexReadback};
use modalcast_model::error::{Error, Result};
use modalcast_model::raster::GlVertexBuffers;
use modalcast_model::scene::{DirtyDomains, Scene, SceneState};

/// Maximum number of steps in flight.
pub const MAX_STEPS_IN_FLIGHT: usize = 2;

/// The CUDA deformer of one scene. It stays on the thread that created it, which owns the OpenGL context.
///
/// Dropping it waits for all steps and copies before any memory that they use is released.
pub struct CudaDeformer {
    step_slots: Vec<StepSlot>,
    device: Arc<Device>,
    plan: DeformPlan,
    kernels: StepKernels,
    inputs: StepInputs,
    output: OutputBuffers,
    /// u, if the scene keeps displacements. All output sets share this buffer, and also the boxes, because both are
    /// read before the next step is submitted.
    displacements: Option<DeviceBuffer>,
    output_ring: OutputRing,
    /// Steps in flight, oldest first: ring slot and time of submission.
    in_flight: VecDeque<(usize, Instant)>,
    /// Ring slot of the last step.
    last: usize,
    readbacks: ReadbackPool,
    /// The last step's fetch and the attributes it copies; `None` after the next step is submitted.
    readback: Option<(VertexAttributes, VertexReadback)>,
    surface: PinnedSurface,
    /// Attributes of `surface` that are up to date with the device.
    host_attributes: VertexAttributes,
}

impl CudaDeformer {
    /// Packs a scene onto the device. With `gl`, steps write directly into those buffers when the driver allows it.
    ///
    /// # Errors
    /// `Fault` when the device refuses; `Unavailable` when NVRTC is missing or the device's memory is too small.
    pub fn new(
        device: &Arc<Device>,
        scene: &Arc<Scene>,
        gl: Option<GlVertexBuffers>,
        options: CudaDeformerOptions,
    ) -> Result<Self> {
        let tables = DeviceTables::new(scene, options);
        let plan = plan_from_tables(scene, &tables);
        let _current = device.enter()?;
        check_memory(device, &plan)?;
        let normals = plan.kernel(KernelKind::Normals);
        let normals = normals.map(|kernel| NormalsKernel::new(device, scene, &tables, kernel)).transpose()?;
        let kernels =
            PositionKernels { deform: plan.require_kernel(KernelKind::Deform)?, batch: plan.kernel(KernelKind::Batch) };
        let deform = DeformKernel::new(device, scene, kernels, tables)?;
        let apply = plan.kernel(KernelKind::Apply);
        let kernels = StepKernels {
            bounds: BoundsKernel::new(
                device,
                plan.require_kernel(KernelKind::Bounds)?,
                options.bounding_axes,
                &deform,
            )?,
            normals,
            apply: apply.map(|apply| ApplyKernel::new(device, deform.packing(), apply)).transpose()?,
            deform,
        };
        let output = OutputBuffers::new(device, &plan, gl)?;
        let inputs = StepInputs::new(device, kernels.deform.packing())?;
        Ok(Self {
            step_slots: vec![StepSlot::new(device, &kernels, &inputs, output.is_shared())?],
            output_ring: OutputRing::new(output.max_sets(), max_changed_domains(scene)),
            inputs,
            kernels,
            output,
            displacements: match plan.bytes(BufferRole::Displacements) {
                0 => None,
                bytes => Some(DeviceBuffer::zeroed(device, bytes)?),
            },
            in_flight: VecDeque::new(),
            last: 0,
            readbacks: ReadbackPool::default(),
            readback: None,
            surface: PinnedSurface::empty(),
            host_attributes: VertexAttributes::ALL,
            device: Arc::clone(device),
            plan,
        })
    }

    /// The compiled kernels and allocated buffers. The plan does not count the second output set, which is allocated
    /// when vertices are fetched concurrently with a step, nor the second ring slot of pinned memory, which is
    /// allocated when a step is submitted while another is in flight.
    pub const fn plan(&self) -> &DeformPlan {
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

    /// Starts a step without waiting for the steps in flight, of which there may be [`MAX_STEPS_IN_FLIGHT`] with this one.
    /// [`Self::finish`] waits for the oldest.
    ///
    /// # Errors
    /// `Busy` when [`MAX_STEPS_IN_FLIGHT`] steps are in flight; `Fault` of the device, after which no step is in flight.
    pub fn submit(&mut self, state: &SceneState) -> Result<()> {
        if self.in_flight.len() == MAX_STEPS_IN_FLIGHT {
            return Err(Error::Busy { queue: "steps under way", limit: MAX_STEPS_IN_FLIGHT });
        }
        self.host_attributes = VertexAttributes::default();
        self.readback = None;
        let begin = Instant::now();
        // If a panic unwinds from `start`, the step may run although it is not in `in_flight`: wait for it.
        let guard = WaitForStream::new(self.device.stream());
        let started = self.start(state, begin).inspect_err(|_| self.invalidate())?;
        self.in_flight.push_back((started, begin));
        self.last = started;
        guard.disarm();
        Ok(())
    }

    /// Waits for the oldest step in flight.
    ///
    /// # Errors
    /// `Fault` of the device, after which no step is in flight. Also `Fault` when no step was in flight.
    pub fn finish(&mut self) -> Result<DeformSummary> {
        let none = || Error::Fault { stage: "deform", reason: "no step is under way".into() };
        let (step_slot, begin) = self.in_flight.pop_front().ok_or_else(none)?;
        let (bounds, oriented_bounds) = self.step_slots[step_slot].wait().inspect_err(|_| self.invalidate())?;
        let whole = begin.elapsed().as_secs_f64() * 1e3;
        let own = self.step_slots[step_slot].device_ms().inspect_err(|_| self.invalidate())?;
        Ok(DeformSummary { bounds, oriented_bounds, ms: own.unwrap_or(whole) })
    }

    /// Starts the graph of the last full step again, to measure the graph alone.
    ///
    /// # Errors
    /// `Fault` when the outputs are OpenGL's buffers, which are not mapped here, when no step was deformed, or when the
    /// device fails.
    pub fn replay(&self) -> Result<()> {
        if self.output.is_shared() || self.output_ring.shown().is_none() {
            let reason = "expected a deformed step in buffers of the deformer".into();
            return Err(Error::Fault { stage: "replay", reason });
        }
        self.step_slots[self.last].launch(StepKind::Full)
    }

    /// Writes the values of a step and starts its graph. Returns the ring slot. `begin`: time of submission.
    fn start(&mut self, state: &SceneState, begin: Instant) -> Result<usize> {
        let _current = self.device.enter()?;
        let set = self.output_ring.next_output();
        match self.output.ensure_set(&self.device, &self.plan, set) {
            Ok(()) => {}
            Err(lost @ Error::DeviceLost { .. }) => return Err(lost),
            Err(error) => {
                tracing::warn!(%error, "no memory for a second output: steps wait until the vertices are read");
                self.output_ring.forbid_more_outputs();
            }
        }
        let at = self.acquire_step_slot()?;
        let turn = self.output_ring.begin(state);
        let Self { step_slots, kernels, inputs, .. } = self;
        let step_slot = &mut step_slots[at];
        let some = match (&turn.dirty_domains, &state.changed, &mut step_slot.list, &mut kernels.apply) {
            (Some(outdated), DirtyDomains::Some(changed), Some(list), Some(apply)) => {
                apply.write(list, kernels.deform.packing(), state, ChangedDomains { changed, outdated })?
            }
            _ => None,
        };
        let header = header(&turn, some, self.output_ring.last_full_step(some.is_none()));
        // Shared OpenGL buffers are copied to the back buffer on this same stream, so the step is already ordered after
        // it.
        if turn.is_being_read && !self.output.is_shared() {
            self.readbacks.wait_for_reads(&self.device, turn.output)?;
        }
        // `normals` and the boxes read the positions again, so the driver must not discard them.
        let keep = some.is_some() || kernels.normals.is_some() || kernels.bounds.boxes.is_some();
        let displacements = self.displacements.as_ref().map_or(0, DeviceBuffer::address);
        let header = Header { displacements, ..header };
        let access = if keep { MapAccess::ReadWrite } else { MapAccess::WriteDiscard };
        step_slot.host_ms = begin.elapsed().as_secs_f64() * 1e3;
        self.output.with_addresses(&self.device, OutputAccess { set: turn.output, access }, |to| {
            step_slot.record_mapped(&self.device)?;
            let header = Header { positions: to.positions, normals: to.normals, tangents: to.tangents, ..header };
            match some {
                Some(_) => StepInputs::write_header(&mut step_slot.values, &header)?,
                None => inputs.write(&mut step_slot.values, &header, state)?,
            }
            step_slot.launch(if some.is_some() { StepKind::Partial } else { StepKind::Full })
        })?;
        step_slot.done.record(self.device.stream()).map_err(cuda_error("deform"))?;
        self.output_ring.end(state);
        Ok(at)
    }

    /// A ring slot whose step has ended; allocates one if all are in flight.
    fn acquire_step_slot(&mut self) -> Result<usize> {
        let is_free = |at: &usize| self.in_flight.iter().all(|(step_slot, _)| step_slot != at);
        if let Some(at) = (0..self.step_slots.len()).find(is_free) {
            return Ok(at);
        }
        self.step_slots.push(StepSlot::new(&self.device, &self.kernels, &self.inputs, self.output.is_shared())?);
        Ok(self.step_slots.len() - 1)
    }

    /// Waits for all steps in flight, whose inputs the next step would overwrite, and marks all outputs and the values
    /// on the device as invalid. Every failed step does the same.
    pub fn invalidate(&mut self) {
        // The step has already failed, so a second error adds nothing.
        self.device.stream().synchronize().ok();
        self.readbacks.synchronize();
        self.in_flight.clear();
        self.readback = None;
        self.output_ring.invalidate();
    }

    fn request(&mut self, wanted: VertexAttributes) -> Result<VertexReadback> {
        let nothing = || Error::Fault { stage: "fetch", reason: "no step was deformed".into() };
        let set = self.output_ring.shown().ok_or_else(nothing)?;
        let length = |wanted: bool, role: BufferRole| if wanted { self.plan.bytes(role) as usize / 4 } else { 0 };
        let lengths = SurfaceLengths {
            positions: length(wanted.positions, BufferRole::Positions),
            normals: length(wanted.normals, BufferRole::Normals),
            tangents: 0,
            displacements: length(wanted.displacements, BufferRole::Displacements),
        };
        // Other attributes do not need the output set, which remains free for the next step.
        let reads_output = lengths.positions + lengths.normals > 0;
        let read_id = reads_output.then(|| self.output_ring.begin_read());
        let request = ReadbackRequest { set, lengths, read_id, after: &self.step_slots[self.last].done };
        let Self { device, kernels, displacements, readbacks, output, .. } = self;
        readbacks.start(device, output, request, |lists: SynchronousLists<'_>| {
            if let Some(buffer) = displacements.as_ref() {
                buffer.read(device, 0, lists.displacements)?;
            }
            match &mut kernels.bounds.boxes {
                Some(boxes) if wanted.boxes => boxes.read(device, lists.boxes),
                _ => Ok(()),
            }
        })
    }

    /// Copies the wanted attributes that are not yet up to date in `surface`.
    fn download_attributes(&mut self, wanted: VertexAttributes) -> Result<()> {
        let host_attributes = self.host_attributes;
        if (wanted.positions || wanted.normals) && !host_attributes.contains(VertexAttributes::VERTICES) {
            self.download_vertices()?;
            self.host_attributes = self.host_attributes.union(VertexAttributes::VERTICES);
        }
        if wanted.displacements && !host_attributes.displacements {
            self.download_displacements()?;
            self.host_attributes.displacements = true;
        }
        if wanted.boxes && !host_attributes.boxes {
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
        let nothing = || Error::Fault { stage: "download", reason: "no step was deformed".into() };
        let set = self.output_ring.shown().ok_or_else(nothing)?;
        let [positions, normals, tangents] = output_sizes(&self.plan).map(|bytes| bytes as usize / 4);
        let lengths = SurfaceLengths { positions, normals, tangents, displacements: 0 };
        self.surface.allocate(&self.device, lengths)?;
        self.output.read(&self.device, set, self.surface.lists()?)
    }
}

/// The header of a step, without the addresses of its outputs.
fn header(turn: &StepTarget, some: Option<ChangeListLengths>, last_full_step: u32) -> Header {
    let lengths = some.unwrap_or_default();
    Header {
        output_step: if some.is_some() { turn.shown } else { 0 },
        last_full_step,
        step: turn.step,
        changed: lengths.changed,
        dirty_tiles: lengths.dirty_tiles,
        ..Header::default()
    }
}

impl Deformer for CudaDeformer {
    fn backend(&self) -> Backend {
        Backend::Cuda
    }

    /// Also waits for the steps that were submitted before.
    fn deform(&mut self, state: &SceneState) -> Result<DeformSummary> {
        while self.in_flight.len() == MAX_STEPS_IN_FLIGHT {
            self.finish()?;
        }
        self.submit(state)?;
        loop {
            let deformed = self.finish()?;
            if self.in_flight.is_empty() {
                return Ok(deformed);
            }
        }
    }

    fn shares_buffers(&self) -> bool {
        self.output.is_shared()
    }

    fn surface(&mut self) -> Result<&DeformedSurface> {
        self.read(VertexAttributes::ALL)
    }

    fn read(&mut self, wanted: VertexAttributes) -> Result<&DeformedSurface> {
        self.download_attributes(wanted)?;
        Ok(self.surface.surface())
    }

    /// Positions and normals are copied concurrently with the next step. Displacements and boxes exist once on the
    /// device, so their copy is complete when this returns.
    fn readback(&mut self, wanted: VertexAttributes) -> Result<VertexReadback> {
        if let Some((_, readback)) = self.readback.as_ref().filter(|(there, _)| there.contains(wanted)) {
            return Ok(readback.clone());
        }
        let readback = self.request(wanted)?;
        self.readback = Some((wanted, readback.clone()));
        Ok(readback)
    }

    fn wait_readback(&mut self, readback: &VertexReadback) -> Result<Arc<DeformedSurface>> {
        let (surface, number) = self.readbacks.wait(readback)?;
        if let Some(number) = number {
            self.output_ring.end_read(number);
        }
        Ok(surface)
    }
}

impl Drop for CudaDeformer {
    fn drop(&mut self) {
        // The device must not use memory that is about to be freed. After a fault the call fails, and no kernel runs.
        self.device.stream().synchronize().ok();
        self.readbacks.synchronize();
    }
}

/// Refuses a scene that cannot fit before any part of it is uploaded.
fn check_memory(device: &Device, plan: &DeformPlan) -> Result<()> {
    // Frees are stream-ordered: synchronize, so that memory freed by other scenes counts as free.
    device.synchronize("device")?;
    let (free, _) = device.memory()?;
    if plan.total_bytes() <= free as u64 {
        return Ok(());
    }
    let reason = format!("the scene needs {} bytes, {free} are free on {}", plan.total_bytes(), device.name());
    Err(Error::Unavailable { what: "GPU memory", reason, remedy: "Close other scenes or other programs".into() })
}
