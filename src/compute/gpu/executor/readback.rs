//! Asynchronous readback of vertices: a stream of its own copies them to the host while the next step runs.
//!
//! ```text
//! step k   [copy in][kernels]
//! copy k                     [copy out      ]
//! step k+1                   [copy in][kernels]      into the other output set
//! ```
//! OpenGL's buffers cannot be double-buffered. They are first copied to a back buffer on the device, which takes a
//! small part of the readback time; the next step may overwrite them after that copy. Displacements and boxes exist
//! once on the device, so their copies are synchronous.
//!
//! Streams, events and memory are allocated on the first fetch.

use std::sync::Arc;

use cudarc::driver::{CudaEvent, CudaStream, result};

use super::interop::MapAccess;
use super::output::{OutputAccess, OutputBuffers};
use super::pinned_surface::{PinnedSurface, SurfaceLengths};
use crate::gpu::launch::cleanup::WaitForStream;
use crate::gpu::launch::error::cuda_error;
use crate::gpu::launch::{Device, DeviceBuffer};
use modalcast_model::deform::{DeformedSurface, VertexReadback};
use modalcast_model::error::{Error, Result};
use modalcast_model::scene::BoundingBox;

const STAGE: &str = "fetch";

/// Unused host slots that are kept for later readbacks.
const MAX_SPARE_SLOTS: usize = 3;

/// The copy stream, and the host slots that it fills.
#[derive(Debug, Default)]
pub(super) struct ReadbackPool {
    stream: Option<Arc<CudaStream>>,
    slots: Vec<ReadbackSlot>,
    /// Number of copies started.
    started: u64,
    /// Per output set, the end of the last copy from it. With OpenGL's buffers: the end of the last copy from the back
    /// buffer.
    read_done: Vec<CudaEvent>,
    /// Only with OpenGL's buffers.
    back: Option<BackBuffer>,
}

/// Copy of OpenGL's buffers on the device.
#[derive(Debug)]
struct BackBuffer {
    /// Positions and normals; each is allocated on its first use.
    parts: [Option<DeviceBuffer>; 2],
    /// End of the last copy into it.
    filled: CudaEvent,
}

/// A host slot: the memory of one readback.
#[derive(Debug)]
struct ReadbackSlot {
    /// The slot is free while it has the only reference to the surface.
    surface: PinnedSurface,
    /// End of the last copy into it.
    ready: CudaEvent,
    lengths: SurfaceLengths,
    /// Sequence number of that copy.
    age: u64,
    /// Number of that copy's readback in `OutputRing`, if it read an output set.
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
    pub after: &'a CudaEvent,
}

/// Attributes that exist once on the device. Their copies are complete when a readback starts.
pub(super) struct SynchronousLists<'a> {
    /// Empty unless displacements are wanted.
    pub displacements: &'a mut [f32],
    pub boxes: &'a mut Vec<BoundingBox>,
}

/// Where a readback of an output set reads.
#[derive(Debug, Clone, Copy)]
struct ReadbackSource {
    positions: u64,
    normals: u64,
}

impl ReadbackPool {
    /// Starts the copy of the wanted positions and normals. Meanwhile `copy_rest` fills the other lists. When it fails
    /// or panics, the copy has ended before this returns.
    pub(super) fn start(
        &mut self,
        device: &Device,
        output: &mut OutputBuffers,
        request: ReadbackRequest<'_>,
        copy_rest: impl FnOnce(SynchronousLists<'_>) -> Result<()>,
    ) -> Result<VertexReadback> {
        let _current = device.enter()?;
        let at = self.acquire_slot(device, request.lengths)?;
        self.started += 1;
        (self.slots[at].age, self.slots[at].read_id) = (self.started, request.read_id);
        let reads_output = request.read_id.is_some();
        let source = if reads_output { Some(self.prepare_source(device, output, &request)?) } else { None };
        let slot = &mut self.slots[at];
        let lists = slot.surface.lists()?;
        lists.boxes.clear();
        // While the device writes positions and normals, no reference to their numbers exists: `lists` is not used for
        // them again, and the surface is given out only by `wait`.
        let pending = match (source, &self.stream) {
            (Some(source), Some(own)) => {
                let guard = WaitForStream::new(own);
                for (from, to) in [(source.positions, lists.positions), (source.normals, lists.normals)] {
                    // SAFETY: the outputs have the bytes of the plan, and each list has that length or is empty. The
                    // slot keeps the lists. It is dropped or used again only after its event, which is recorded below,
                    // has completed, or the stream is synchronized; until then the guard waits.
                    unsafe { copy(from, to, own) }?;
                }
                slot.ready.record(own).map_err(cuda_error(STAGE))?;
                self.read_done[request.set].record(own).map_err(cuda_error(STAGE))?;
                Some(guard)
            }
            _ => None,
        };
        copy_rest(SynchronousLists { displacements: lists.displacements, boxes: lists.boxes })?;
        if let Some(guard) = pending {
            guard.disarm();
        }
        let surface = Arc::clone(slot.surface.surface());
        Ok(if reads_output { VertexReadback::pending(surface) } else { VertexReadback::ready(surface) })
    }

    /// Makes the copy stream wait for the step that wrote an output set. Returns the addresses to read.
    fn prepare_source(
        &mut self,
        device: &Device,
        output: &mut OutputBuffers,
        request: &ReadbackRequest<'_>,
    ) -> Result<ReadbackSource> {
        let fail = cuda_error(STAGE);
        let own = match &self.stream {
            Some(stream) => Arc::clone(stream),
            None => Arc::clone(self.stream.insert(device.context().new_stream().map_err(&fail)?)),
        };
        while self.read_done.len() <= request.set {
            self.read_done.push(device.context().new_event(None).map_err(&fail)?);
        }
        if output.is_shared() {
            return self.fill_back_buffer(device, output, request, &own);
        }
        own.wait(request.after).map_err(&fail)?;
        // The sets live until the deformer is dropped, which waits for the copies first.
        let from = output.owned_addresses(request.set)?;
        Ok(ReadbackSource { positions: from.positions, normals: from.normals })
    }

    /// Copies OpenGL's buffers to the back buffer and makes `own` wait for that copy. Returns the addresses of the
    /// copies.
    fn fill_back_buffer(
        &mut self,
        device: &Device,
        output: &mut OutputBuffers,
        request: &ReadbackRequest<'_>,
        own: &CudaStream,
    ) -> Result<ReadbackSource> {
        let bytes = [request.lengths.positions, request.lengths.normals].map(|length| 4 * length);
        self.wait_for_reads(device, request.set)?;
        let back = match &mut self.back {
            Some(back) => back,
            none => none.insert(BackBuffer {
                parts: [None, None],
                filled: device.context().new_event(None).map_err(cuda_error(STAGE))?,
            }),
        };
        let mut to = [0; 2];
        for ((part, bytes), to) in back.parts.iter_mut().zip(bytes).zip(&mut to).filter(|((_, bytes), _)| *bytes > 0) {
            *to = match part {
                Some(part) => part.address(),
                none => none.insert(DeviceBuffer::zeroed(device, bytes as u64)?).address(),
            };
        }
        output.with_addresses(device, OutputAccess { set: request.set, access: MapAccess::Read }, |from| {
            let copies = [from.positions, from.normals].into_iter().zip(to).zip(bytes);
            for ((from, to), bytes) in copies.filter(|(_, bytes)| *bytes > 0) {
                // SAFETY: outputs and back buffer have the bytes of the plan for each wanted list. Both live until the
                // stream is synchronized.
                unsafe { result::memcpy_dtod_async(to, from, bytes, device.stream().cu_stream()) }
                    .map_err(cuda_error(STAGE))?;
            }
            Ok(())
        })?;
        back.filled.record(device.stream()).map_err(cuda_error(STAGE))?;
        own.wait(&back.filled).map_err(cuda_error(STAGE))?;
        let [positions, normals] = to;
        Ok(ReadbackSource { positions, normals })
    }

    /// Waits for a copy. Returns its surface and the number of its readback.
    pub(super) fn wait(&self, readback: &VertexReadback) -> Result<(Arc<DeformedSurface>, Option<u64>)> {
        let own = self.slots.iter().find(|slot| readback.is_of(slot.surface.surface()));
        let stranger = || Error::Fault { stage: STAGE, reason: "not a fetch of this deformer".into() };
        let slot = own.ok_or_else(stranger)?;
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
            // The device's own stream reports the same fault.
            stream.synchronize().ok();
        }
    }

    /// A free slot with these list lengths. Frees the oldest free slots beyond [`MAX_SPARE_SLOTS`], of any lengths, whose copies
    /// have ended.
    fn acquire_slot(&mut self, device: &Device, lengths: SurfaceLengths) -> Result<usize> {
        let is_free = |slot: &ReadbackSlot| slot.surface.is_unused();
        let mut ages: Vec<u64> = self.slots.iter().filter(|slot| is_free(slot)).map(|slot| slot.age).collect();
        ages.sort_unstable();
        let oldest = ages.len().checked_sub(MAX_SPARE_SLOTS).map_or(0, |beyond| ages[beyond]);
        self.slots.retain(|slot| !is_free(slot) || slot.age >= oldest || !slot.ready.is_complete());
        // Take the slot with the oldest copy: that copy has most likely ended.
        let free = self.slots.iter().enumerate().filter(|(_, slot)| is_free(slot) && slot.lengths == lengths);
        if let Some((at, _)) = free.min_by_key(|(_, slot)| slot.age) {
            return Ok(at);
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
        Ok(Self { surface, ready, lengths, age: 0, read_id: None })
    }
}

/// Starts a device-to-host copy.
///
/// # Safety
/// `from` is the address of at least as many bytes of device memory as `to` has, and `to` is not accessed before the
/// stream has completed the copy.
unsafe fn copy(from: u64, to: &mut [f32], stream: &CudaStream) -> Result<()> {
    if to.is_empty() {
        return Ok(());
    }
    // SAFETY: the caller guarantees both conditions.
    unsafe { result::memcpy_dtoh_async(to, from, stream.cu_stream()) }.map_err(cuda_error(STAGE))
}
