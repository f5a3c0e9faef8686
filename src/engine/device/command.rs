//! Commands to the device thread.

use std::sync::Arc;

use tokio::sync::oneshot;

use super::context::PreparedDeformer;
use crate::engine::output::step_output::{FrameOutput, PictureContent};
use crate::frame::Legend;
use modalcast_model::backend_settings::BackendSettings;
use modalcast_model::deform::{DeformSummary, DeformedSurface, VertexAttributes};
use modalcast_model::error::{Error, Result};
use modalcast_model::scene::{Camera, FrameSize, FrameStyle, PixelRect, Scene, SceneState};
use modalcast_render::{AovImage, FrameImage, FramePixels, PickHit};

/// Identifies a loaded scene on the device thread.
pub(in crate::engine) type SceneId = u64;

/// Work whose costs are similar: of one kind, with sizes that differ by less than a factor of two.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) struct CostClass {
    pub kind: &'static str,
    /// Binary logarithm of the number of pixels, rounded down; 0 for work without pixels.
    pub size_class: u32,
}

/// The channel that carries a command's answer.
pub(in crate::engine) type Reply<T> = oneshot::Sender<Result<T>>;

/// Vertices in host memory.
#[derive(Debug, Clone)]
pub(in crate::engine) struct CopiedVertices {
    pub surface: Arc<DeformedSurface>,
    /// Milliseconds from the start of the copy to its completion.
    pub copy_ms: f64,
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
        /// The state that will probably be deformed next.
        next: Option<Arc<SceneState>>,
        reply: Reply<DeformSummary>,
    },
    Draw {
        id: SceneId,
        camera: Camera,
        size: FrameSize,
        style: FrameStyle,
        content: PictureContent,
        reply: Reply<FrameImage<FramePixels>>,
    },
    /// Renders an AOV (arbitrary output variable): values instead of colors, with a legend if they form a color map.
    RenderAov {
        id: SceneId,
        camera: Camera,
        size: FrameSize,
        frame_output: FrameOutput,
        reply: Reply<(AovImage, Option<Legend>)>,
    },
    /// Finds the surface points at the pixels of a rectangle.
    Pick {
        id: SceneId,
        camera: Camera,
        /// Size of the picture that contains the rectangle.
        picture: FrameSize,
        rectangle: PixelRect,
        reply: Reply<Vec<PickHit>>,
    },
    /// Copies vertex attributes to the host. The copy overlaps with the commands after it.
    ReadVertices {
        id: SceneId,
        attributes: VertexAttributes,
        reply: Reply<CopiedVertices>,
    },
    UnloadScene {
        id: SceneId,
        reply: Reply<()>,
    },
}

impl Command {
    /// The scene that the command is for. Commands of a scene are executed in their order.
    pub(super) const fn scene(&self) -> SceneId {
        match self {
            Self::LoadScene { id, .. }
            | Self::Deform { id, .. }
            | Self::Draw { id, .. }
            | Self::RenderAov { id, .. }
            | Self::Pick { id, .. }
            | Self::ReadVertices { id, .. }
            | Self::UnloadScene { id, .. } => *id,
        }
    }

    /// Commands of one class and scene take a similar time.
    pub(super) fn cost_class(&self) -> CostClass {
        let of_kind = |kind: &'static str| CostClass { kind, size_class: 0 };
        match self {
            Self::LoadScene { .. } => of_kind("load"),
            Self::Deform { .. } => of_kind("deform"),
            Self::Draw { size, .. } => CostClass { kind: "draw", size_class: size_class(*size) },
            Self::RenderAov { size, .. } => CostClass { kind: "aov", size_class: size_class(*size) },
            Self::Pick { .. } => of_kind("pick"),
            Self::ReadVertices { .. } => of_kind("vertices"),
            Self::UnloadScene { .. } => of_kind("unload"),
        }
    }

    /// Whether the command counts against the limit on queued commands. An unloading is always accepted, so that no
    /// scene stays on the device.
    pub(super) const fn is_bounded(&self) -> bool {
        !matches!(self, Self::UnloadScene { .. })
    }

    /// Whether the command leaves the queue when its caller no longer waits. The other commands change the scene.
    pub(super) const fn is_cancellable(&self) -> bool {
        matches!(self, Self::Draw { .. } | Self::RenderAov { .. } | Self::Pick { .. } | Self::ReadVertices { .. })
    }

    /// Whether the caller of a command that does not change the scene no longer waits.
    pub(super) fn is_cancelled(&self) -> bool {
        match self {
            Self::Draw { reply, .. } => reply.is_closed(),
            Self::RenderAov { reply, .. } => reply.is_closed(),
            Self::Pick { reply, .. } => reply.is_closed(),
            Self::ReadVertices { reply, .. } => reply.is_closed(),
            Self::LoadScene { .. } | Self::Deform { .. } | Self::UnloadScene { .. } => false,
        }
    }

    /// Answers the command with an error instead of executing it.
    pub(super) fn reply_error(self, error: Error) {
        // A failed send means that the caller no longer waits. `map_err(drop)` gives all arms the same type.
        match self {
            Self::LoadScene { reply, .. } | Self::UnloadScene { reply, .. } => reply.send(Err(error)).ok(),
            Self::Deform { reply, .. } => reply.send(Err(error)).map_err(drop).ok(),
            Self::Draw { reply, .. } => reply.send(Err(error)).map_err(drop).ok(),
            Self::RenderAov { reply, .. } => reply.send(Err(error)).map_err(drop).ok(),
            Self::Pick { reply, .. } => reply.send(Err(error)).map_err(drop).ok(),
            Self::ReadVertices { reply, .. } => reply.send(Err(error)).map_err(drop).ok(),
        };
    }
}

/// Binary logarithm of the number of pixels, rounded down.
fn size_class(size: FrameSize) -> u32 {
    (u64::from(size.width) * u64::from(size.height)).checked_ilog2().unwrap_or(0)
}
