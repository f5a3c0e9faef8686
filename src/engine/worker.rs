//! Handle to the device thread, which receives commands (`command`) from a bounded queue, owns the device context and
//! every loaded scene (`desk`), and answers each command at most once. Vertices, picks and frames are answered
//! asynchronously: their readback overlaps with the commands after them.

use std::sync::Arc;

use tokio::sync::mpsc::error::TrySendError;
use tokio::sync::{mpsc, oneshot};

use super::command::{Command, Copied, Reply, SceneId};
use super::desk::{Desk, work};
use super::viewer::Showing;
use super::workbench::{Info, Workbench};
use crate::config::Config;
use crate::frame::Legend;
use modalcast_model::deform::{Deformed, Wanted};
use modalcast_model::error::{Error, Result, during};
use modalcast_model::scene::{Camera, Rectangle, Scene, State};
use modalcast_render::{FRAMES_UNDER_WAY, Hit, Image, Survey};

/// Sends commands to the device thread. The thread ends when the last clone is dropped.
#[derive(Debug, Clone)]
pub(super) struct Worker {
    commands: mpsc::Sender<Command>,
    limit: usize,
}

impl Worker {
    /// Starts the thread and waits until it has opened its devices.
    ///
    /// # Errors
    /// `Unavailable` when the requested backend cannot be opened, `Fault` when a thread cannot be started.
    pub(super) async fn start(config: &Arc<Config>) -> Result<(Self, Info, std::thread::JoinHandle<()>)> {
        // A scene queues at most FRAMES_UNDER_WAY frames, one copy and the next step, and an opening queues one command
        // more. The queue is therefore full only when scenes are opened faster than the limit on open scenes allows.
        let limit = (3 + FRAMES_UNDER_WAY) * config.open_scenes + 8;
        let (commands, inbox) = mpsc::channel(limit);
        let (tell, told) = oneshot::channel();
        let config = Arc::clone(config);
        let thread = std::thread::Builder::new()
            .name("device".into())
            .spawn(move || match Workbench::open(&config).and_then(Desk::new) {
                Ok(desk) => {
                    tell.send(Ok(desk.info().clone())).ok(); // Fails if the caller has gone; the queue is closed then.
                    work(desk, inbox);
                }
                Err(error) => {
                    tell.send(Err(error)).ok(); // As above.
                }
            })
            .map_err(during("device thread"))?;
        let info = told.await.map_err(|_| gone())??;
        Ok((Self { commands, limit }, info, thread))
    }

    /// A handle for tests that play the device thread, and the receiver of its commands.
    #[cfg(test)]
    pub(super) fn played() -> (Self, mpsc::Receiver<Command>) {
        let (commands, inbox) = mpsc::channel(16);
        (Self { commands, limit: 16 }, inbox)
    }

    pub(super) async fn stage(&self, id: SceneId, scene: &Arc<Scene>) -> Result<()> {
        let scene = Arc::clone(scene);
        self.ask(|reply| Command::Stage { id, scene, reply }).await
    }

    /// Starts deforming a scene to a state.
    pub(super) fn deform(&self, id: SceneId, state: &Arc<State>) -> Asked<Deformed> {
        let state = Arc::clone(state);
        self.begin(|reply| Command::Deform { id, state, reply })
    }

    /// Starts drawing the last deformation. Later commands do not affect the frame.
    pub(super) fn begin_draw(&self, id: SceneId, camera: Camera, size: (u32, u32)) -> Asked<Image> {
        self.begin(|reply| Command::Draw { id, camera, size, reply })
    }

    pub(super) async fn survey(
        &self,
        id: SceneId,
        camera: Camera,
        size: [u32; 2],
        showing: Showing,
    ) -> Result<(Survey, Option<Legend>)> {
        self.ask(|reply| Command::Survey { id, camera, size, showing, reply }).await
    }

    pub(super) async fn pick(
        &self,
        id: SceneId,
        camera: Camera,
        picture: [u32; 2],
        rectangle: Rectangle,
    ) -> Result<Vec<Hit>> {
        self.ask(|reply| Command::Pick { id, camera, picture, rectangle, reply }).await
    }

    /// Starts copying the wanted attributes of the last deformation. Later commands do not affect the copy.
    pub(super) fn copy(&self, id: SceneId, wanted: Wanted) -> Asked<Copied> {
        self.begin(|reply| Command::Copy { id, wanted, reply })
    }

    /// Waits for queue capacity, so that a scene never remains on the device because the queue was full.
    pub(super) async fn unstage(&self, id: SceneId) -> Result<()> {
        let (reply, answer) = oneshot::channel();
        self.commands.send(Command::Unstage { id, reply }).await.map_err(|_| gone())?;
        answer.await.map_err(|_| gone())?
    }

    /// Ends the thread after the commands already queued. Blocks until the queue has capacity, so it must not be called
    /// on a runtime thread.
    pub(super) fn quit(&self) {
        // A closed queue means that the thread has ended.
        self.commands.blocking_send(Command::Quit).ok();
    }

    async fn ask<T>(&self, make: impl FnOnce(Reply<T>) -> Command) -> Result<T> {
        self.begin(make).wait().await
    }

    /// Sends a command; the caller awaits the answer later.
    fn begin<T>(&self, make: impl FnOnce(Reply<T>) -> Command) -> Asked<T> {
        let (reply, answer) = oneshot::channel();
        Asked(match self.commands.try_send(make(reply)) {
            Ok(()) => Ok(answer),
            Err(TrySendError::Full(_)) => Err(Error::Busy { queue: "device", limit: self.limit }),
            Err(TrySendError::Closed(_)) => Err(gone()),
        })
    }
}

/// The pending answer to a command that was sent to the device thread.
#[derive(Debug)]
pub(super) struct Asked<T>(Result<oneshot::Receiver<Result<T>>>);

impl<T> Asked<T> {
    pub(super) async fn wait(mut self) -> Result<T> {
        self.there().await
    }

    /// As [`Self::wait`], but cancel-safe. Must not be called again after it has returned.
    pub(super) async fn there(&mut self) -> Result<T> {
        match &mut self.0 {
            Ok(answer) => answer.await.map_err(|_| gone())?,
            Err(error) => Err(error.clone()),
        }
    }
}

/// The error for a dropped reply channel: the command panicked or the thread has ended.
fn gone() -> Error {
    during("device")("the device thread gave no answer")
}
