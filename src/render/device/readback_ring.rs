//! Ring of readback slots of one render target. A slot has the memory in which the pixels of a frame leave the device.
//! It grows on demand.

use std::cell::{Cell, RefCell};
use std::collections::VecDeque;
use std::rc::Rc;
use std::time::{Duration, Instant};

use super::gl::{Buffer, Fence, Gl, PictureBuffer, ReadbackView, StagingBuffer};
use modalcast_model::error::{Error, Result};
use modalcast_model::shared_memory::{PictureMemory, PngRequest};

/// Maximum number of frames of one render target in flight.
pub const MAX_FRAMES_IN_FLIGHT: usize = 3;

/// Maximum number of shared pictures of one render target. Readers may hold those that are not in flight. If fewer than
/// [`MAX_FRAMES_IN_FLIGHT`] are left for the next frames, readers copy the pixels instead of holding them.
const MAX_PICTURES: usize = 8;

/// The readback slots of one render target.
#[derive(Debug)]
pub(crate) struct ReadbackRing {
    gl: Rc<Gl>,
    /// Size of each slot in bytes.
    bytes: u64,
    /// Allocates shared pictures. `None`: OpenGL copies the pixels to staging buffers.
    picture_memory: RefCell<Option<Rc<dyn PictureMemory>>>,
    /// Number of allocated slots.
    allocated: Cell<usize>,
    /// Number of slots of frames in flight.
    in_flight: Cell<usize>,
    /// Slots without a frame in flight, in the order in which they were returned. Readers may still read from some.
    free: RefCell<VecDeque<SlotMemory>>,
}

/// Memory in which the pixels of a frame leave the device.
#[derive(Debug)]
enum SlotMemory {
    /// OpenGL copies the pixels.
    Staging(StagingBuffer),
    /// OpenGL writes the pixels, and another API copies them to the host.
    Picture(PictureBuffer),
}

/// The readback slot of one frame. Dropping it returns the memory to the ring.
#[derive(Debug)]
pub(crate) struct ReadbackSlot {
    readback_ring: Rc<ReadbackRing>,
    memory: Option<SlotMemory>,
}

impl ReadbackRing {
    /// A ring without slots. With `picture_memory`, its slots are shared pictures.
    pub(crate) fn new(gl: &Rc<Gl>, bytes: u64, picture_memory: Option<Rc<dyn PictureMemory>>) -> Rc<Self> {
        Rc::new(Self {
            gl: Rc::clone(gl),
            bytes,
            picture_memory: RefCell::new(picture_memory),
            allocated: Cell::new(0),
            in_flight: Cell::new(0),
            free: RefCell::default(),
        })
    }

    /// Takes a free slot for a frame, or allocates one. If all slots are in use, waits at most `limit` for the reader
    /// of the oldest slot without a frame in flight. A reader is a thread that reads pixels.
    ///
    /// # Errors
    /// `Busy` when [`MAX_FRAMES_IN_FLIGHT`] frames are in flight or the reader exceeds `limit`; `Fault` of OpenGL.
    pub(crate) fn acquire(self: &Rc<Self>, limit: Duration) -> Result<ReadbackSlot> {
        let busy = Error::Busy { queue: "frames in flight", limit: MAX_FRAMES_IN_FLIGHT };
        if self.in_flight.get() >= MAX_FRAMES_IN_FLIGHT {
            return Err(busy);
        }
        let free_index = self.free.borrow().iter().position(|memory| memory.is_read(Duration::ZERO));
        if let Some(memory) = free_index.and_then(|index| self.free.borrow_mut().remove(index)) {
            return Ok(self.slot(memory));
        }
        if self.allocated.get() < self.capacity() {
            let memory = self.allocate()?;
            self.allocated.set(self.allocated.get() + 1);
            return Ok(self.slot(memory));
        }
        let is_front_read = self.free.borrow().front().is_some_and(|memory| memory.is_read(limit));
        let oldest = if is_front_read { self.free.borrow_mut().pop_front() } else { None };
        oldest.map(|memory| self.slot(memory)).ok_or(busy)
    }

    fn slot(self: &Rc<Self>, memory: SlotMemory) -> ReadbackSlot {
        self.in_flight.set(self.in_flight.get() + 1);
        ReadbackSlot { readback_ring: Rc::clone(self), memory: Some(memory) }
    }

    /// Allocates the memory of a slot. If a picture cannot be shared, this and all later slots are staging buffers.
    fn allocate(&self) -> Result<SlotMemory> {
        let picture_memory = self.picture_memory.borrow().clone();
        if let Some(picture_memory) = picture_memory {
            match PictureBuffer::new(&self.gl, picture_memory.as_ref(), self.bytes) {
                Ok(picture) => return Ok(SlotMemory::Picture(picture)),
                Err(lost) if lost.is_loss() => return Err(lost),
                Err(error) => {
                    tracing::warn!(%error, "OpenGL copies the pixels: no memory that CUDA and OpenGL share");
                    self.picture_memory.replace(None);
                }
            }
        }
        self.gl.staging(self.bytes).map(SlotMemory::Staging)
    }

    fn capacity(&self) -> usize {
        if self.picture_memory.borrow().is_some() { MAX_PICTURES } else { MAX_FRAMES_IN_FLIGHT }
    }

    /// Whether as many slots as can be in flight are free or not allocated yet.
    fn has_spare_slots(&self) -> bool {
        let free = self.free.borrow().iter().filter(|memory| memory.is_read(Duration::ZERO)).count();
        free + self.capacity().saturating_sub(self.allocated.get()) >= MAX_FRAMES_IN_FLIGHT
    }

    /// A ring of as many emulated pictures as a ring of shared pictures has at most.
    #[cfg(test)]
    pub(crate) fn of_emulated_pictures(gl: &Rc<Gl>, bytes: u64) -> Rc<Self> {
        let pictures = (0..MAX_PICTURES).map(|_| SlotMemory::Picture(PictureBuffer::emulated(gl, bytes)));
        let ring = Self::new(gl, bytes, None);
        ring.free.borrow_mut().extend(pictures);
        ring.allocated.set(MAX_PICTURES);
        ring
    }

    /// Number of slots in the ring.
    #[cfg(test)]
    pub(crate) fn count(&self) -> usize {
        self.allocated.get()
    }
}

impl SlotMemory {
    /// Waits at most `limit` for the reader and returns whether it is done.
    fn is_read(&self, limit: Duration) -> bool {
        match self {
            Self::Staging(staging) => staging.is_read(limit),
            Self::Picture(picture) => picture.is_read(limit),
        }
    }
}

impl ReadbackSlot {
    /// The staging buffer into which OpenGL copies the pixels; `None` if the frame is drawn into a shared picture.
    pub(crate) fn staging(&self) -> Option<&Buffer> {
        match self.memory.as_ref()? {
            SlotMemory::Staging(staging) => Some(&staging.buffer),
            SlotMemory::Picture(_) => None,
        }
    }

    /// The shared picture into which OpenGL writes the pixels.
    pub(crate) fn picture(&self) -> Option<&Buffer> {
        match self.memory.as_ref()? {
            SlotMemory::Staging(_) => None,
            SlotMemory::Picture(picture) => Some(&picture.buffer),
        }
    }

    /// Requests the PNG file of the frame in addition to or instead of its pixels. Without effect on a staging buffer.
    pub(crate) fn request_png(&self, request: PngRequest) {
        if let Some(SlotMemory::Picture(picture)) = &self.memory {
            picture.request_png(request);
        }
    }

    /// Whether [`Self::view`] would return without waiting, after waiting at most `limit`. `fence` follows the last
    /// command that writes the pixels. Starts the copy of a shared picture once the fence is signaled.
    pub(crate) fn is_ready_within(&self, fence: &Fence, limit: Duration) -> bool {
        let begin = Instant::now();
        if !fence.is_done_within(limit) {
            return false;
        }
        match &self.memory {
            Some(SlotMemory::Picture(picture)) => picture.is_copied_within(limit.saturating_sub(begin.elapsed())),
            _ => true,
        }
    }

    /// The bytes of the slot. The caller has waited for the fence after the last command that writes them.
    ///
    /// # Errors
    /// `Fault` when the bytes cannot be copied or mapped.
    pub(crate) fn view(&self) -> Result<Option<ReadbackView>> {
        let bytes = self.readback_ring.bytes as usize;
        match &self.memory {
            Some(SlotMemory::Staging(staging)) => staging.view(bytes).map(Some),
            Some(SlotMemory::Picture(picture)) => picture.view(bytes, self.readback_ring.has_spare_slots()).map(Some),
            None => Ok(None),
        }
    }
}

impl Drop for ReadbackSlot {
    fn drop(&mut self) {
        let ring = &self.readback_ring;
        ring.in_flight.set(ring.in_flight.get().saturating_sub(1));
        // The commands of an abandoned frame may still write the memory. The next frame writes it later in the same
        // command stream, so this is safe.
        ring.free.borrow_mut().extend(self.memory.take());
    }
}
