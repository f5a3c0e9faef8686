//! Commands to the device thread.

use std::sync::Arc;

use tokio::sync::oneshot;

use crate::engine::output::step_output::FrameOutput;
use crate::frame::Legend;
use modalcast_model::backend_settings::BackendSettings;
use modalcast_model::deform::{DeformSummary, DeformedSurface, VertexAttributes};
use modalcast_model::error::{Error, Result};
use modalcast_model::scene::{Camera, FrameSize, PixelRect, Scene, SceneState};
use modalcast_render::{AovImage, FrameImage, PickHit};

/// Identifies a loaded scene on the device thread.
pub(in crate::engine) type SceneId = u64;

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
        backends: BackendSettings,
        reply: Reply<()>,
    },
    Deform {
        id: SceneId,
        state: Arc<SceneState>,
        reply: Reply<DeformSummary>,
    },
    Draw {
        id: SceneId,
        camera: Camera,
        size: FrameSize,
        reply: Reply<FrameImage>,
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
    /// Ends the thread.
    Quit,
}

impl Command {
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
            Self::Quit => None,
        };
    }
}
