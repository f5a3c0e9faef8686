//! Ring of staging buffers for the readback of frames of one form; it grows on demand to [`MAX_FRAMES_IN_FLIGHT`] buffers.

use std::cell::{Cell, RefCell};
use std::collections::VecDeque;
use std::rc::Rc;
use std::time::Duration;

use super::gl::{Gl, StagingBuffer};
use modalcast_model::error::{Error, Result};

/// Maximum number of frames of one form in flight.
pub const MAX_FRAMES_IN_FLIGHT: usize = 3;

/// The staging buffers of one form.
#[derive(Debug)]
pub(crate) struct ReadbackRing {
    gl: Rc<Gl>,
    bytes: u64,
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

    /// Takes a staging buffer for a frame; creates one when all existing ones are in use. When the ring is full, this
    /// waits at most `limit` for the oldest buffer that is only being copied from.
    ///
    /// # Errors
    /// `Busy` when all buffers have frames in flight or the reader exceeds `limit`; `Fault` of OpenGL.
    pub(crate) fn acquire(self: &Rc<Self>, limit: Duration) -> Result<ReadbackSlot> {
        let slot = |staging: StagingBuffer| ReadbackSlot { readback_ring: Rc::clone(self), staging: Some(staging) };
        let free = self.free.borrow().iter().position(|staging| staging.is_read(Duration::ZERO));
        if let Some(staging) = free.and_then(|at| self.free.borrow_mut().remove(at)) {
            return Ok(slot(staging));
        }
        if self.allocated.get() < MAX_FRAMES_IN_FLIGHT {
            let staging = self.gl.staging(self.bytes)?;
            self.allocated.set(self.allocated.get() + 1);
            return Ok(slot(staging));
        }
        let is_read = self.free.borrow().front().is_some_and(|staging| staging.is_read(limit));
        let read = if is_read { self.free.borrow_mut().pop_front() } else { None };
        read.map(slot).ok_or(Error::Busy { queue: "frames in flight", limit: MAX_FRAMES_IN_FLIGHT })
    }

    /// Number of buffers in the ring.
    #[cfg(test)]
    pub(crate) fn count(&self) -> usize {
        self.allocated.get()
    }
}

impl ReadbackSlot {
    /// The staging buffer.
    pub(crate) fn staging(&self) -> Option<&StagingBuffer> {
        self.staging.as_ref()
    }
}

impl Drop for ReadbackSlot {
    fn drop(&mut self) {
        // An abandoned frame may still write it; so will the next frame, which is later in the command stream.
        self.readback_ring.free.borrow_mut().extend(self.staging.take());
    }
}
