//! Commands to the device thread.

use std::sync::Arc;

use tokio::sync::oneshot;

use super::viewer::Showing;
use crate::frame::Legend;
use modalcast_model::deform::{Deformed, Surface, Wanted};
use modalcast_model::error::Result;
use modalcast_model::scene::{Camera, Rectangle, Scene, State};
use modalcast_render::{Hit, Image, Survey};

/// Identifies a loaded scene on the device thread.
pub(super) type SceneId = u64;

/// The channel that carries a command's answer.
pub(super) type Reply<T> = oneshot::Sender<Result<T>>;

/// Vertices in host memory, and the milliseconds from the start of the copy to its completion.
pub(super) type Copied = (Arc<Surface>, f64);

/// A command to the device thread with the channel for its answer.
pub(super) enum Command {
    Stage {
        id: SceneId,
        scene: Arc<Scene>,
        reply: Reply<()>,
    },
    Deform {
        id: SceneId,
        state: Arc<State>,
        reply: Reply<Deformed>,
    },
    Draw {
        id: SceneId,
        camera: Camera,
        size: (u32, u32),
        reply: Reply<Image>,
    },
    /// Renders an AOV (arbitrary output variable): values instead of colors, with a legend if they form a color map.
    Survey {
        id: SceneId,
        camera: Camera,
        size: [u32; 2],
        showing: Showing,
        reply: Reply<(Survey, Option<Legend>)>,
    },
    Pick {
        id: SceneId,
        camera: Camera,
        picture: [u32; 2],
        rectangle: Rectangle,
        reply: Reply<Vec<Hit>>,
    },
    /// Copies the wanted vertex attributes to the host. The copy overlaps with the commands after it.
    Copy {
        id: SceneId,
        wanted: Wanted,
        reply: Reply<Copied>,
    },
    Unstage {
        id: SceneId,
        reply: Reply<()>,
    },
    /// Ends the thread.
    Quit,
}
