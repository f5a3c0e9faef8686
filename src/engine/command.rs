//! What the device thread can be asked for.

use std::sync::Arc;

use tokio::sync::oneshot;

use super::viewer::Showing;
use crate::frame::Legend;
use modalcast_model::deform::{Deformed, Surface, Wanted};
use modalcast_model::error::Result;
use modalcast_model::scene::{Camera, Rectangle, Scene, State};
use modalcast_render::{Hit, Image, Survey};

/// Names a staged scene on the device thread.
pub(super) type SceneId = u64;

pub(super) type Reply<T> = oneshot::Sender<Result<T>>;

/// Vertices and the milliseconds until they were there.
pub(super) type Copied = (Arc<Surface>, f64);

/// A question to the device thread, and where its answer goes.
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
    /// A frame of numbers, with the legend of a colour map.
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
    /// Brings what is wanted to the host, beside the command after it.
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
