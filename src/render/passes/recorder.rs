//! Inputs that all passes of a frame share, and the recorder of passes.

use std::rc::Rc;

use super::accesses::{barrier_before, barrier_within};
use crate::device::gl::{Buffer, Gl, Program};
use crate::pass::Pass;
use crate::resources::programs::SampleCountPrograms;
use crate::resources::scene_buffers::SceneBuffers;
use crate::resources::target::RenderTarget;
use crate::types::{FrameParams, FrameStats};
use modalcast_model::error::Result;

/// The inputs of the passes of a frame.
#[derive(Debug, Clone, Copy)]
pub(crate) struct FrameContext<'a> {
    pub(crate) buffers: &'a SceneBuffers,
    pub(crate) target: &'a RenderTarget,
    pub(crate) programs: &'a SampleCountPrograms,
    /// Encodes the frame, with its antialiasing.
    pub(crate) encode: &'a Program,
    pub(crate) params: &'a FrameParams,
    /// Whether the frame is drawn in pieces.
    pub(crate) has_pieces: bool,
    /// The shared picture of the frame; `None` if the encode pass writes the readback source of the target.
    pub(crate) picture: Option<&'a Buffer>,
}

/// Issues the barriers of passes, checks for errors, and collects statistics.
#[derive(Debug)]
pub(crate) struct PassRecorder<'a> {
    pub(crate) gl: &'a Rc<Gl>,
    pub(crate) stats: &'a mut FrameStats,
}

impl PassRecorder<'_> {
    /// Issues the barrier of a pass before its first command.
    pub(super) fn begin(&self, pass: Pass) {
        self.gl.barrier(barrier_before(pass));
    }

    /// Issues the barrier between two commands of a pass, if the second uses outputs of the first.
    pub(super) fn barrier_within_pass(&self, pass: Pass) {
        self.gl.barrier(barrier_within(pass));
    }

    /// Adds a pass to the statistics as executed.
    ///
    /// # Errors
    /// `Fault` of the pass if OpenGL reported an error.
    pub(super) fn finish(&mut self, pass: Pass) -> Result<()> {
        self.add_to_stats(pass);
        self.check(pass)
    }

    /// Adds a pass to the statistics as executed. A pass that is recorded band by band is added once.
    pub(super) fn add_to_stats(&mut self, pass: Pass) {
        if !self.stats.passes.contains(&pass) {
            self.stats.passes.push(pass);
        }
    }

    /// Fails if OpenGL reported an error in a pass.
    ///
    /// # Errors
    /// `Fault` of the pass.
    pub(super) fn check(&self, pass: Pass) -> Result<()> {
        self.gl.check(pass.name())
    }
}
