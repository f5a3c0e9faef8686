//! Ring of staging buffers for the readback of the frames of one render target. It grows on demand to
//! [`MAX_FRAMES_IN_FLIGHT`] buffers.

use std::cell::{Cell, RefCell};
use std::collections::VecDeque;
use std::rc::Rc;
use std::time::Duration;

use super::gl::{Gl, StagingBuffer};
use modalcast_model::error::{Error, Result};

/// Maximum number of frames of one render target in flight.
pub const MAX_FRAMES_IN_FLIGHT: usize = 3;

/// The staging buffers of one render target.
#[derive(Debug)]
pub(crate) struct ReadbackRing {
    gl: Rc<Gl>,
    /// Size of each buffer in bytes.
    bytes: u64,
    /// Number of allocated buffers.
    allocated: Cell<usize>,
    /// Buffers without a frame in flight, in the order in which they were returned. Readers may still copy from some.
    free: RefCell<VecDeque<StagingBuffer>>,
}

/// Staging buffer of one frame. Dropping the slot returns the buffer to the ring.
#[derive(Debug)]
pub(crate) struct ReadbackSlot {
    readback_ring: Rc<ReadbackRing>,
    staging: Option<StagingBuffer>,
}

impl ReadbackRing {
    pub(crate) fn new(gl: &Rc<Gl>, bytes: u64) -> Rc<Self> {
        Rc::new(Self { gl: Rc::clone(gl), bytes, allocated: Cell::new(0), free: RefCell::default() })
    }

    /// Takes a free staging buffer for a frame, or allocates one. If all buffers are in use, waits at most `limit` for
    /// the reader of the oldest buffer without a frame in flight. A reader is a thread that copies pixels.
    ///
    /// # Errors
    /// `Busy` when all buffers have frames in flight or the reader exceeds `limit`; `Fault` of OpenGL.
    pub(crate) fn acquire(self: &Rc<Self>, limit: Duration) -> Result<ReadbackSlot> {
        let slot = |staging: StagingBuffer| ReadbackSlot { readback_ring: Rc::clone(self), staging: Some(staging) };
        let free_index = self.free.borrow().iter().position(|staging| staging.is_read(Duration::ZERO));
        if let Some(staging) = free_index.and_then(|index| self.free.borrow_mut().remove(index)) {
            return Ok(slot(staging));
        }
        if self.allocated.get() < MAX_FRAMES_IN_FLIGHT {
            let staging = self.gl.staging(self.bytes)?;
            self.allocated.set(self.allocated.get() + 1);
            return Ok(slot(staging));
        }
        let is_front_read = self.free.borrow().front().is_some_and(|staging| staging.is_read(limit));
        let oldest = if is_front_read { self.free.borrow_mut().pop_front() } else { None };
        oldest.map(slot).ok_or(Error::Busy { queue: "frames in flight", limit: MAX_FRAMES_IN_FLIGHT })
    }

    /// Number of buffers in the ring.
    #[cfg(test)]
    pub(crate) fn count(&self) -> usize {
        self.allocated.get()
    }
}

impl ReadbackSlot {
    /// The staging buffer; present until the slot is dropped.
    pub(crate) fn staging(&self) -> Option<&StagingBuffer> {
        self.staging.as_ref()
    }
}

impl Drop for ReadbackSlot {
    fn drop(&mut self) {
        // The commands of an abandoned frame may still write the buffer. The next frame writes it later in the same
        // command stream, so this is safe.
        self.readback_ring.free.borrow_mut().extend(self.staging.take());
    }
}
