//! Ring of staging buffers for the readback of frames of one form; it grows on demand to [`FRAMES_UNDER_WAY`] buffers.

use std::cell::{Cell, RefCell};
use std::collections::VecDeque;
use std::rc::Rc;
use std::time::Duration;

use super::gl::{Gl, Staging};
use modalcast_model::error::{Error, Result};

/// Maximum number of frames of one form in flight.
pub const FRAMES_UNDER_WAY: usize = 3;

/// The staging buffers of one form.
#[derive(Debug)]
pub(super) struct Ring {
    gl: Rc<Gl>,
    bytes: u64,
    made: Cell<usize>,
    /// Buffers without a frame in flight, in the order in which they were returned. Readers may still copy from some.
    free: RefCell<VecDeque<Staging>>,
}

/// Staging buffer of one frame. Dropping the slot returns the buffer to the ring.
#[derive(Debug)]
pub(super) struct Slot {
    ring: Rc<Ring>,
    staging: Option<Staging>,
}

impl Ring {
    pub(super) fn new(gl: &Rc<Gl>, bytes: u64) -> Rc<Self> {
        Rc::new(Self { gl: Rc::clone(gl), bytes, made: Cell::new(0), free: RefCell::default() })
    }

    /// Takes a staging buffer for a frame; creates one when all existing ones are in use. When the ring is full, this
    /// waits at most `limit` for the oldest buffer that is only being copied from.
    ///
    /// # Errors
    /// `Busy` when all buffers have frames in flight or the reader exceeds `limit`; `Fault` of OpenGL.
    pub(super) fn take(self: &Rc<Self>, limit: Duration) -> Result<Slot> {
        let slot = |staging: Staging| Slot { ring: Rc::clone(self), staging: Some(staging) };
        let free = self.free.borrow().iter().position(|staging| staging.is_read(Duration::ZERO));
        if let Some(staging) = free.and_then(|at| self.free.borrow_mut().remove(at)) {
            return Ok(slot(staging));
        }
        if self.made.get() < FRAMES_UNDER_WAY {
            let staging = self.gl.staging(self.bytes)?;
            self.made.set(self.made.get() + 1);
            return Ok(slot(staging));
        }
        let is_read = self.free.borrow().front().is_some_and(|staging| staging.is_read(limit));
        let read = if is_read { self.free.borrow_mut().pop_front() } else { None };
        read.map(slot).ok_or(Error::Busy { queue: "frames under way", limit: FRAMES_UNDER_WAY })
    }

    /// Number of buffers in the ring.
    #[cfg(test)]
    pub(super) fn count(&self) -> usize {
        self.made.get()
    }
}

impl Slot {
    /// The staging buffer.
    pub(super) fn staging(&self) -> Option<&Staging> {
        self.staging.as_ref()
    }
}

impl Drop for Slot {
    fn drop(&mut self) {
        // An abandoned frame may still write it; so will the next frame, which is later in the command stream.
        self.ring.free.borrow_mut().extend(self.staging.take());
    }
}
