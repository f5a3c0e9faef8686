//! An output of which some draw steps are not submitted to the device yet. A large output, or the first frame of a
//! scene, is drawn in several draw steps, between which the device thread serves other scenes. (Draw steps are
//! unrelated to the steps of the simulation.) The commands of its own scene wait until all draw steps are submitted, so
//! the vertices and the buffers of the scene do not change between them.

use std::sync::Arc;
use std::time::Duration;

use super::command::Reply;
use super::context::{DeviceContext, PartialAovDraw};
use super::fair_queue::CostClass;
use super::loaded_scene::LoadedScene;
use crate::engine::output::output_spec::PictureContent;
use crate::engine::output::rendered_picture::RenderedPicture;
use modalcast_model::error::{Error, Result};
use modalcast_render::{PartialFrame, ScenePreparation};

/// Device time of an output.
#[derive(Debug, Clone, Copy)]
pub(super) struct Charge {
    /// Class of the command.
    pub class: CostClass,
    /// Milliseconds that the scene was charged for the command.
    pub charged_ms: f64,
    /// Milliseconds of all draw steps so far: the time of the device thread, or of the device if that is longer. Only
    /// the time of the device thread is known of the last draw step, and of those without breaks.
    pub spent_ms: f64,
    /// Milliseconds that the device thread has spent on the last draw step.
    pub last_submit_ms: f64,
    /// Whether the cost of the command itself, which is the cost of the first draw step, was recorded in the queue.
    /// Later draw steps are charged to a class of their own.
    pub is_recorded: bool,
}

impl Charge {
    /// The costs of a command before its first draw step.
    pub(super) const fn new(class: CostClass, charged_ms: f64) -> Self {
        Self { class, charged_ms, spent_ms: 0.0, last_submit_ms: 0.0, is_recorded: false }
    }
}

/// An output, the channel for its answer, and its costs.
pub(super) struct PartialOutput {
    pub kind: PartialKind,
    /// What the readers of a frame need.
    pub content: PictureContent,
    /// `None` for a preparation, which has no readers.
    pub reply: Option<Reply<Arc<RenderedPicture>>>,
    pub charge: Charge,
}

#[expect(clippy::large_enum_variant, reason = "there is at most one per scene, and most are frames")]
pub(super) enum PartialKind {
    Frame(PartialFrame),
    Aov(PartialAovDraw),
    /// The textures and programs of the scene, which the next command of the scene needs.
    Preparation(ScenePreparation),
}

impl PartialOutput {
    /// Whether the caller no longer waits. The output is then dropped instead of continued.
    pub(super) fn is_cancelled(&self) -> bool {
        self.reply.as_ref().is_some_and(Reply::is_closed)
    }

    pub(super) fn is_submitted(&self) -> bool {
        match &self.kind {
            PartialKind::Frame(frame) => frame.is_submitted(),
            PartialKind::Aov(draw) => draw.aov.is_submitted(),
            PartialKind::Preparation(preparation) => preparation.is_finished(),
        }
    }

    /// Whether the output is large, so that no other large output is drawn at the same time.
    pub(super) const fn is_large(&self) -> bool {
        match &self.kind {
            PartialKind::Frame(frame) => frame.is_divided(),
            PartialKind::Aov(draw) => draw.aov.is_divided(),
            PartialKind::Preparation(_) => false,
        }
    }

    /// Whether the output draws on the device. A preparation does not: the driver compiles programs in other threads.
    pub(super) const fn draws(&self) -> bool {
        !matches!(self.kind, PartialKind::Preparation(_))
    }

    /// Whether other scenes are served between the draw steps.
    pub(super) const fn has_breaks(&self) -> bool {
        match &self.kind {
            PartialKind::Frame(frame) => frame.has_breaks(),
            PartialKind::Aov(draw) => draw.aov.has_breaks(),
            PartialKind::Preparation(_) => true,
        }
    }

    /// Waits at most `limit` for the draw step that was submitted last. Returns whether the device has finished it.
    pub(super) fn is_ready_within(&self, limit: Duration) -> bool {
        match &self.kind {
            PartialKind::Frame(frame) => frame.is_ready_within(limit),
            PartialKind::Aov(draw) => draw.aov.is_ready_within(limit),
            // A preparation can only be polled.
            PartialKind::Preparation(preparation) => {
                let is_ready = preparation.is_ready();
                if !is_ready {
                    std::thread::sleep(limit);
                }
                is_ready
            }
        }
    }

    /// Milliseconds that the device took for the last draw step. Waits for the draw step.
    fn last_step_ms(&self) -> f64 {
        match &self.kind {
            PartialKind::Frame(frame) => frame.last_step_ms(),
            PartialKind::Aov(draw) => draw.aov.last_step_ms(),
            PartialKind::Preparation(_) => 0.0,
        }
    }

    /// Adds the device time of the last draw step to the costs. Returns the milliseconds beyond those of the device
    /// thread, which its scene was charged already.
    pub(super) fn take_device_ms(&mut self) -> f64 {
        let device_ms = (self.last_step_ms() - self.charge.last_submit_ms).max(0.0);
        self.charge.spent_ms += device_ms;
        device_ms
    }

    /// Class of the draw steps after the first.
    pub(super) fn step_class(&self) -> CostClass {
        let kind = match self.kind {
            PartialKind::Frame(_) => "draw step",
            PartialKind::Aov(_) => "aov step",
            PartialKind::Preparation(_) => "load step",
        };
        CostClass { kind, ..self.charge.class }
    }

    /// Answers the output with an error instead of finishing it. After a preparation, the next command of the scene
    /// prepares the scene again, and returns the error.
    pub(super) fn reply_error(self, error: Error) {
        if let Some(reply) = self.reply {
            reply.send(Err(error));
        }
    }

    /// Submits the next draw step. `scene` is the loaded scene, or the error if it is not loaded.
    ///
    /// # Errors
    /// `Fault` of OpenGL. The output must then be dropped.
    pub(super) fn submit_step(&mut self, context: &mut DeviceContext, scene: Result<&LoadedScene>) -> Result<()> {
        match &mut self.kind {
            PartialKind::Frame(frame) => context.submit_draw_step(scene?, frame),
            PartialKind::Aov(draw) => context.submit_aov_piece(scene?, draw),
            PartialKind::Preparation(preparation) => context.prepare_step(preparation),
        }
    }
}
