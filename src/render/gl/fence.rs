//! A mark in the stream of commands that the host may ask for, or wait for, later.

use std::rc::Rc;
use std::time::{Duration, Instant};

use glow::HasContext as _;

use super::Gl;
use crate::error::{Result, during};

/// All commands that were given before it was made.
#[derive(Debug)]
pub(in crate::render) struct Fence {
    gl: Rc<Gl>,
    name: glow::Fence,
}

impl Gl {
    /// A fence behind all commands so far, which are sent on their way.
    pub(in crate::render) fn fence(self: &Rc<Self>, stage: &'static str) -> Result<Fence> {
        let gl = self.on();
        // SAFETY: a fresh fence, owned by the value that is returned.
        let name = unsafe {
            let name = gl.fence_sync(glow::SYNC_GPU_COMMANDS_COMPLETE, 0).map_err(during(stage))?;
            gl.flush();
            name
        };
        Ok(Fence { gl: Rc::clone(self), name })
    }
}

impl Fence {
    /// Whether the commands are done, or will never be: then [`Self::wait`] says why.
    pub(in crate::render) fn is_over(&self) -> bool {
        self.is_over_within(Duration::ZERO)
    }

    /// The same after waiting for them, at most so long.
    pub(in crate::render) fn is_over_within(&self, limit: Duration) -> bool {
        self.state(limit) != glow::TIMEOUT_EXPIRED
    }

    /// Waits until the commands are done.
    ///
    /// # Errors
    /// `Fault` of `stage` when the device did not finish within `limit` or was lost.
    pub(in crate::render) fn wait(&self, stage: &'static str, limit: Duration) -> Result<()> {
        let begin = Instant::now();
        loop {
            match self.state(limit.saturating_sub(begin.elapsed())) {
                glow::ALREADY_SIGNALED | glow::CONDITION_SATISFIED => return Ok(()),
                glow::TIMEOUT_EXPIRED if begin.elapsed() < limit => {}
                glow::TIMEOUT_EXPIRED => {
                    return Err(during(stage)(format!("the device did not finish within {limit:?}")));
                }
                _ => return Err(during(stage)("the device was lost")),
            }
        }
    }

    /// What OpenGL says of it after at most this time, or a second.
    fn state(&self, limit: Duration) -> u32 {
        // A second fits glow's 32-bit nanoseconds.
        let slice = limit.min(Duration::from_secs(1)).as_nanos() as i32;
        // SAFETY: the fence lives as long as this value.
        unsafe { self.gl.on().client_wait_sync(self.name, glow::SYNC_FLUSH_COMMANDS_BIT, slice) }
    }
}

impl Drop for Fence {
    fn drop(&mut self) {
        // SAFETY: the name is ours alone and is not used after this.
        unsafe { self.gl.on().delete_sync(self.name) }
    }
}
