//! The buffers through which frames of one form come back: as many as were ever under way at once, three at most.

use std::cell::{Cell, RefCell};
use std::collections::VecDeque;
use std::rc::Rc;
use std::time::Duration;

use super::gl::{Gl, Staging};
use modalcast_model::error::{Error, Result};

/// Frames of one form that may be under way at once.
pub const FRAMES_UNDER_WAY: usize = 3;

/// The staging buffers of one form.
#[derive(Debug)]
pub(super) struct Ring {
    gl: Rc<Gl>,
    bytes: u64,
    made: Cell<usize>,
    /// Of no frame under way, in the order in which they were given back. Some may still be read.
    free: RefCell<VecDeque<Staging>>,
}

/// A staging buffer of one frame; it goes back when this is dropped.
#[derive(Debug)]
pub(super) struct Slot {
    ring: Rc<Ring>,
    staging: Option<Staging>,
}

impl Ring {
    pub(super) fn new(gl: &Rc<Gl>, bytes: u64) -> Rc<Self> {
        Rc::new(Self { gl: Rc::clone(gl), bytes, made: Cell::new(0), free: RefCell::default() })
    }

    /// A buffer for one more frame; made when all there are are in use. Where there can be no more, this waits for those
    /// that are only being copied from, at most `limit`.
    ///
    /// # Errors
    /// `Busy` when so many frames are under way; `Fault` of OpenGL.
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

    /// Buffers that there are.
    #[cfg(test)]
    pub(super) fn count(&self) -> usize {
        self.made.get()
    }
}

impl Slot {
    /// The buffer.
    pub(super) fn staging(&self) -> Option<&Staging> {
        self.staging.as_ref()
    }
}

impl Drop for Slot {
    fn drop(&mut self) {
        // A frame that nobody waited for may still write it: so does the next one, after it in the order of commands.
        self.ring.free.borrow_mut().extend(self.staging.take());
    }
}
