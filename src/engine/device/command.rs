//! Commands to the device thread.

use std::sync::Arc;

use tokio::sync::{oneshot, watch};

use super::context::PreparedDeformer;
use super::fair_queue::CostClass;
use super::loaded_worlds::{DrawnViews, ExportedSlots, PreparedWorlds, ViewRequest};
use crate::engine::output::output_spec::{FrameOutput, PictureContent, PictureSpec};
use crate::engine::output::rendered_picture::RenderedPicture;
use crate::engine::output::step_vertices::StepVertices;
use modalcast_model::backend_settings::BackendSettings;
use modalcast_model::deform::{DeformSummary, VertexAttributes};
use modalcast_model::error::{Error, Result};
use modalcast_model::scene::{CameraSource, FrameSize, PixelRect, Scene, SceneState};
use modalcast_model::views::ViewFormat;
use modalcast_render::PickHit;

/// Identifies a loaded scene on the device thread.
pub(in crate::engine) type SceneId = u64;

/// The channel that carries a command's answer. Several readers can wait for it.
#[derive(Debug)]
pub(in crate::engine) struct Reply<T> {
    /// `None` until the answer is sent.
    answer: watch::Sender<Option<Result<T>>>,
    /// Dropped after the answer. The task of the scene then knows that the command has ended.
    _end: oneshot::Sender<()>,
}

/// The end of a command: an error once the command is answered or dropped.
pub(in crate::engine) type CommandEnd = oneshot::Receiver<()>;

impl<T> Reply<T> {
    /// A channel, with the receivers of the answer and of the end.
    pub(super) fn channel() -> (Self, watch::Receiver<Option<Result<T>>>, CommandEnd) {
        let (answer, answer_receiver) = watch::channel(None);
        let (end, end_receiver) = oneshot::channel();
        (Self { answer, _end: end }, answer_receiver, end_receiver)
    }

    /// Sends the answer. Returns false if no reader waits any longer.
    pub(in crate::engine) fn send(self, answer: Result<T>) -> bool {
        self.answer.send(Some(answer)).is_ok()
    }

    /// Whether no reader waits any longer.
    pub(in crate::engine) fn is_closed(&self) -> bool {
        self.answer.is_closed()
    }

    /// Waits until no reader waits any longer.
    #[cfg(test)]
    pub(in crate::engine) async fn closed(&self) {
        self.answer.closed().await;
    }
}

/// A command to the device thread with the channel for its answer.
pub(in crate::engine) enum Command {
    LoadScene {
        id: SceneId,
        scene: Arc<Scene>,
        /// The prepared deformer, or the error of its preparation.
        deformer: Result<PreparedDeformer>,
        backends: BackendSettings,
        reply: Reply<()>,
    },
    Deform {
        id: SceneId,
        state: Arc<SceneState>,
        /// The state that the writer has already sent after this one.
        following: Option<Arc<SceneState>>,
        reply: Reply<DeformSummary>,
    },
    /// Draws a picture of the last deformation: colors, or an AOV (arbitrary output variable, such as depth).
    Draw { id: SceneId, picture: PictureSpec, content: PictureContent, reply: Reply<Arc<RenderedPicture>> },
    /// Finds the surface points at the pixels of a rectangle.
    Pick {
        id: SceneId,
        camera: CameraSource,
        /// Size of the picture that contains the rectangle.
        picture: FrameSize,
        rectangle: PixelRect,
        reply: Reply<Vec<PickHit>>,
    },
    /// Copies vertex attributes to the host. The copy overlaps with the commands after it.
    ReadVertices { id: SceneId, attributes: VertexAttributes, reply: Reply<Arc<StepVertices>> },
    /// Loads the worlds of a batch of small views, which belong to no scene on the device.
    LoadWorlds {
        id: SceneId,
        /// All worlds as one scene.
        worlds: Arc<Scene>,
        /// Number of domains of one world.
        domains: usize,
        prepared: Result<PreparedWorlds>,
        reply: Reply<()>,
    },
    /// Allocates exported device memory for the views of worlds.
    ExportRing { id: SceneId, slot_count: usize, format: ViewFormat, views: usize, reply: Reply<Arc<ExportedSlots>> },
    /// Deforms worlds and draws views of them.
    DrawViews { id: SceneId, request: ViewRequest, reply: Reply<Arc<DrawnViews>> },
    /// Unloads a scene or worlds.
    UnloadScene { id: SceneId, reply: Reply<()> },
}

impl Command {
    /// The scene that the command is for. Commands of a scene are executed in their order.
    pub(super) const fn scene(&self) -> SceneId {
        match self {
            Self::LoadScene { id, .. }
            | Self::Deform { id, .. }
            | Self::Draw { id, .. }
            | Self::Pick { id, .. }
            | Self::ReadVertices { id, .. }
            | Self::LoadWorlds { id, .. }
            | Self::ExportRing { id, .. }
            | Self::DrawViews { id, .. }
            | Self::UnloadScene { id, .. } => *id,
        }
    }

    /// Commands of one class and scene take a similar time.
    pub(super) fn cost_class(&self) -> CostClass {
        let of_kind = |kind: &'static str| CostClass { kind, size_class: 0 };
        match self {
            Self::LoadScene { .. } => of_kind("load"),
            Self::Deform { .. } => of_kind("deform"),
            Self::Draw { picture: PictureSpec { output, size, .. }, .. } => {
                let kind = if *output == FrameOutput::Color { "draw" } else { "aov" };
                CostClass { kind, size_class: size_class(*size) }
            }
            Self::Pick { .. } => of_kind("pick"),
            Self::ReadVertices { .. } => of_kind("vertices"),
            Self::LoadWorlds { .. } => of_kind("load worlds"),
            Self::ExportRing { .. } => of_kind("export"),
            Self::DrawViews { request, .. } => {
                CostClass { kind: "views", size_class: request.views.len().checked_ilog2().unwrap_or(0) }
            }
            Self::UnloadScene { .. } => of_kind("unload"),
        }
    }

    /// Whether the command counts against the limit on queued commands. An unloading is always accepted, so that no
    /// scene stays on the device.
    pub(super) const fn is_bounded(&self) -> bool {
        !matches!(self, Self::UnloadScene { .. })
    }

    /// Whether the command leaves the queue when its caller no longer waits. The other commands change what later commands
    /// see.
    pub(super) const fn is_cancellable(&self) -> bool {
        matches!(self, Self::Draw { .. } | Self::Pick { .. } | Self::ReadVertices { .. } | Self::DrawViews { .. })
    }

    /// Whether the caller of a command that does not change the scene no longer waits.
    pub(super) fn is_cancelled(&self) -> bool {
        match self {
            Self::Draw { reply, .. } => reply.is_closed(),
            Self::Pick { reply, .. } => reply.is_closed(),
            Self::ReadVertices { reply, .. } => reply.is_closed(),
            Self::DrawViews { reply, .. } => reply.is_closed(),
            Self::LoadScene { .. }
            | Self::LoadWorlds { .. }
            | Self::ExportRing { .. }
            | Self::Deform { .. }
            | Self::UnloadScene { .. } => false,
        }
    }

    /// Answers the command with an error instead of executing it.
    pub(super) fn reply_error(self, error: Error) {
        match self {
            Self::LoadScene { reply, .. } | Self::LoadWorlds { reply, .. } | Self::UnloadScene { reply, .. } => {
                reply.send(Err(error))
            }
            Self::Deform { reply, .. } => reply.send(Err(error)),
            Self::Draw { reply, .. } => reply.send(Err(error)),
            Self::Pick { reply, .. } => reply.send(Err(error)),
            Self::ReadVertices { reply, .. } => reply.send(Err(error)),
            Self::ExportRing { reply, .. } => reply.send(Err(error)),
            Self::DrawViews { reply, .. } => reply.send(Err(error)),
        };
    }
}

/// Binary logarithm of the number of pixels, rounded down.
fn size_class(size: FrameSize) -> u32 {
    (u64::from(size.width) * u64::from(size.height)).checked_ilog2().unwrap_or(0)
}
