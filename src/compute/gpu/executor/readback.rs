//! Asynchronous readback of vertices: a separate stream copies them to the host while the next step runs.
//!
//! ```text
//! step k   [copy in][kernels]
//! copy k                     [copy out      ]
//! step k+1                   [copy in][kernels]      into the other output set
//! ```
//! There is only one device buffer for displacements and one for boxes, so their copies are synchronous.
//!
//! Streams, events and memory are allocated on the first fetch.

use std::sync::Arc;

use cudarc::driver::{CudaEvent, CudaStream, result};

use super::output::{OutputAddresses, OutputBuffers};
use super::pinned_surface::{PinnedSurface, SurfaceLengths};
use crate::gpu::launch::Device;
use crate::gpu::launch::cleanup::WaitForStream;
use crate::gpu::launch::error::cuda_error;
use modalcast_model::deform::{DeformedSurface, VertexReadback};
use modalcast_model::error::{Error, Result};
use modalcast_model::scene::BoundingBox;

const STAGE: &str = "fetch";

/// Maximum number of free host slots that are kept for later readbacks.
const MAX_SPARE_SLOTS: usize = 3;

/// The copy stream, and the host slots that it fills.
#[derive(Debug, Default)]
pub(super) struct ReadbackPool {
    stream: Option<Arc<CudaStream>>,
    slots: Vec<ReadbackSlot>,
    /// Number of copies started.
    started_copies: u64,
    /// Per output set, the end of the last copy from it.
    read_done: Vec<CudaEvent>,
}

/// A host slot: the memory of one readback.
#[derive(Debug)]
struct ReadbackSlot {
    /// The slot is free while it has the only reference to the surface.
    surface: PinnedSurface,
    /// End of the last copy into the surface.
    ready: CudaEvent,
    lengths: SurfaceLengths,
    /// Sequence number of the last copy.
    copy_number: u64,
    /// Number of the last readback in `OutputRing`, if it read an output set.
    read_id: Option<u64>,
}

/// A copy to start.
#[derive(Debug, Clone, Copy)]
pub(super) struct ReadbackRequest<'a> {
    /// The output set to read.
    pub set: usize,
    pub lengths: SurfaceLengths,
    /// Number of the readback in `OutputRing`, if an output set is read.
    pub read_id: Option<u64>,
    /// End of the step that wrote the output set.
    pub step_done: &'a CudaEvent,
}

/// Lists of attributes that are copied synchronously, because the device has only one buffer of each.
pub(super) struct SynchronousLists<'a> {
    /// Empty unless displacements are requested.
    pub displacements: &'a mut [f32],
    pub boxes: &'a mut Vec<BoundingBox>,
}

impl ReadbackPool {
    /// Starts the copy of the requested positions and normals. Meanwhile `copy_other_lists` fills the other lists. The
    /// copy has ended after an error or a panic, also of `copy_other_lists`.
    pub(super) fn start(
        &mut self,
        device: &Device,
        output: &OutputBuffers,
        request: ReadbackRequest<'_>,
        copy_other_lists: impl FnOnce(SynchronousLists<'_>) -> Result<()>,
    ) -> Result<VertexReadback> {
        let _current = device.enter()?;
        let slot_index = self.acquire_slot(device, request.lengths)?;
        self.started_copies += 1;
        (self.slots[slot_index].copy_number, self.slots[slot_index].read_id) = (self.started_copies, request.read_id);
        let reads_output = request.read_id.is_some();
        let source = if reads_output { Some(self.prepare_source(device, output, &request)?) } else { None };
        let slot = &mut self.slots[slot_index];
        let lists = slot.surface.lists()?;
        lists.boxes.clear();
        // While the device writes positions and normals, no reference to these lists exists: `lists` is not used for
        // them again, and readers get the surface from `wait`.
        let stream_guard = match (source, &self.stream) {
            (Some(source), Some(copy_stream)) => {
                let guard = WaitForStream::new(copy_stream);
                for (source_address, target) in [(source.positions, lists.positions), (source.normals, lists.normals)] {
                    // SAFETY: the outputs have the bytes of the plan, and each list has that length or is empty. The
                    // slot owns the lists. It is dropped or reused only after its event `ready` has completed or the
                    // stream is synchronized. If this fails before the event is recorded, the guard synchronizes the
                    // stream.
                    unsafe { copy(source_address, target, copy_stream) }?;
                }
                slot.ready.record(copy_stream).map_err(cuda_error(STAGE))?;
                self.read_done[request.set].record(copy_stream).map_err(cuda_error(STAGE))?;
                Some(guard)
            }
            _ => None,
        };
        copy_other_lists(SynchronousLists { displacements: lists.displacements, boxes: lists.boxes })?;
        if let Some(guard) = stream_guard {
            guard.disarm();
        }
        let surface = Arc::clone(slot.surface.surface());
        Ok(if reads_output { VertexReadback::pending(surface) } else { VertexReadback::ready(surface) })
    }

    /// Makes the copy stream wait for the step that wrote the output set. Returns the addresses to read.
    fn prepare_source(
        &mut self,
        device: &Device,
        output: &OutputBuffers,
        request: &ReadbackRequest<'_>,
    ) -> Result<OutputAddresses> {
        let to_fault = cuda_error(STAGE);
        let copy_stream = match &self.stream {
            Some(stream) => Arc::clone(stream),
            None => Arc::clone(self.stream.insert(device.context().new_stream().map_err(&to_fault)?)),
        };
        while self.read_done.len() <= request.set {
            self.read_done.push(device.context().new_event(None).map_err(&to_fault)?);
        }
        copy_stream.wait(request.step_done).map_err(&to_fault)?;
        // The sets live until the deformer is dropped, which waits for the copies first.
        Ok(output.addresses(request.set))
    }

    /// Waits for a copy. Returns its surface and the number of its readback.
    pub(super) fn wait(&self, readback: &VertexReadback) -> Result<(Arc<DeformedSurface>, Option<u64>)> {
        let slot = self.slots.iter().find(|slot| readback.writes_to(slot.surface.surface()));
        let unknown_readback = || Error::Fault { stage: STAGE, reason: "expected a readback of this deformer".into() };
        let slot = slot.ok_or_else(unknown_readback)?;
        slot.ready.synchronize().map_err(cuda_error(STAGE))?;
        Ok((Arc::clone(slot.surface.surface()), slot.read_id))
    }

    /// Makes the device's stream wait for the last copy from an output set.
    pub(super) fn wait_for_reads(&self, device: &Device, set: usize) -> Result<()> {
        match self.read_done.get(set) {
            Some(end) => device.stream().wait(end).map_err(cuda_error(STAGE)),
            None => Ok(()),
        }
    }

    /// Waits for all copies.
    pub(super) fn synchronize(&self) {
        if let Some(stream) = &self.stream {
            // The stream of the device reports the same fault.
            stream.synchronize().ok();
        }
    }

    /// Returns a free slot with these list lengths; allocates one if there is none. Drops the oldest free slots beyond
    /// [`MAX_SPARE_SLOTS`] whose copies have ended.
    fn acquire_slot(&mut self, device: &Device, lengths: SurfaceLengths) -> Result<usize> {
        let is_free = |slot: &ReadbackSlot| slot.surface.is_unused();
        let mut copy_numbers: Vec<u64> =
            self.slots.iter().filter(|slot| is_free(slot)).map(|slot| slot.copy_number).collect();
        copy_numbers.sort_unstable();
        // The copy number of the oldest free slot to keep.
        let oldest_kept = copy_numbers.len().checked_sub(MAX_SPARE_SLOTS).map_or(0, |excess| copy_numbers[excess]);
        self.slots.retain(|slot| !is_free(slot) || slot.copy_number >= oldest_kept || !slot.ready.is_complete());
        // Take the slot with the oldest copy, because that copy has most likely ended.
        let matching_slots = self.slots.iter().enumerate().filter(|(_, slot)| is_free(slot) && slot.lengths == lengths);
        if let Some((slot_index, _)) = matching_slots.min_by_key(|(_, slot)| slot.copy_number) {
            return Ok(slot_index);
        }
        self.slots.push(ReadbackSlot::new(device, lengths)?);
        Ok(self.slots.len() - 1)
    }
}

impl ReadbackSlot {
    fn new(device: &Device, lengths: SurfaceLengths) -> Result<Self> {
        let ready = device.context().new_event(None).map_err(cuda_error(STAGE))?;
        let mut surface = PinnedSurface::empty();
        surface.allocate(device, lengths)?;
        Ok(Self { surface, ready, lengths, copy_number: 0, read_id: None })
    }
}

/// Starts a device-to-host copy.
///
/// # Safety
/// `source` is the address of at least as many bytes of device memory as `target` has, and `target` is not accessed
/// before the stream has completed the copy.
unsafe fn copy(source: u64, target: &mut [f32], stream: &CudaStream) -> Result<()> {
    if target.is_empty() {
        return Ok(());
    }
    // SAFETY: the caller guarantees both conditions.
    unsafe { result::memcpy_dtoh_async(target, source, stream.cu_stream()) }.map_err(cuda_error(STAGE))
}
