//! The device thread: takes commands (`command`) from a bounded queue, owns the workbench and every staged scene (`desk`),
//! answers each command once. Vertices, picks and frames are answered late: they leave the device while commands after
//! theirs are obeyed.

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

/// The way to the device thread. The thread ends when the last one of these is gone.
#[derive(Debug, Clone)]
pub(super) struct Worker {
    commands: mpsc::Sender<Command>,
    limit: usize,
}

impl Worker {
    /// Starts the thread and waits until it has opened its devices.
    pub(super) async fn start(config: &Arc<Config>) -> Result<(Self, Info, std::thread::JoinHandle<()>)> {
        // Each scene has at most a few frames, a copy and the step after them under way, and each opening one more; so
        // nobody is turned away by a full queue unless scenes are opened faster than the limit of open scenes allows.
        let limit = (3 + FRAMES_UNDER_WAY) * config.open_scenes + 8;
        let (commands, inbox) = mpsc::channel(limit);
        let (tell, told) = oneshot::channel();
        let config = Arc::clone(config);
        let thread = std::thread::Builder::new()
            .name("device".into())
            .spawn(move || match Workbench::open(&config).and_then(Desk::new) {
                Ok(desk) => {
                    tell.send(Ok(desk.info().clone())).ok(); // The starter has gone; the queue is closed then too.
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

    /// The way to somebody who plays the device, and the commands that he is given.
    #[cfg(test)]
    pub(super) fn played() -> (Self, mpsc::Receiver<Command>) {
        let (commands, inbox) = mpsc::channel(16);
        (Self { commands, limit: 16 }, inbox)
    }

    pub(super) async fn stage(&self, id: SceneId, scene: &Arc<Scene>) -> Result<()> {
        let scene = Arc::clone(scene);
        self.ask(|reply| Command::Stage { id, scene, reply }).await
    }

    /// Begins to deform.
    pub(super) fn deform(&self, id: SceneId, state: &Arc<State>) -> Asked<Deformed> {
        let state = Arc::clone(state);
        self.begin(|reply| Command::Deform { id, state, reply })
    }

    /// Begins to draw what was deformed last, whatever is asked of the scene next.
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

    /// Begins to copy what is wanted of the last deformation, whatever is asked of the scene next.
    pub(super) fn copy(&self, id: SceneId, wanted: Wanted) -> Asked<Copied> {
        self.begin(|reply| Command::Copy { id, wanted, reply })
    }

    /// Waits for room: a scene must never stay on the device because the queue was full.
    pub(super) async fn unstage(&self, id: SceneId) -> Result<()> {
        let (reply, answer) = oneshot::channel();
        self.commands.send(Command::Unstage { id, reply }).await.map_err(|_| gone())?;
        answer.await.map_err(|_| gone())?
    }

    /// Ends the thread after the commands before. Waits for room; not to be called where waiting is not allowed.
    pub(super) fn quit(&self) {
        // A closed queue means that the thread has ended.
        self.commands.blocking_send(Command::Quit).ok();
    }

    async fn ask<T>(&self, make: impl FnOnce(Reply<T>) -> Command) -> Result<T> {
        self.begin(make).wait().await
    }

    /// Sends a command whose answer is waited for later.
    fn begin<T>(&self, make: impl FnOnce(Reply<T>) -> Command) -> Asked<T> {
        let (reply, answer) = oneshot::channel();
        Asked(match self.commands.try_send(make(reply)) {
            Ok(()) => Ok(answer),
            Err(TrySendError::Full(_)) => Err(Error::Busy { queue: "device", limit: self.limit }),
            Err(TrySendError::Closed(_)) => Err(gone()),
        })
    }
}

/// What the device thread was asked for, in the order in which it was asked.
#[derive(Debug)]
pub(super) struct Asked<T>(Result<oneshot::Receiver<Result<T>>>);

impl<T> Asked<T> {
    pub(super) async fn wait(mut self) -> Result<T> {
        self.there().await
    }

    /// The same, safe to drop while it waits; not to be asked again once it has answered.
    pub(super) async fn there(&mut self) -> Result<T> {
        match &mut self.0 {
            Ok(answer) => answer.await.map_err(|_| gone())?,
            Err(error) => Err(error.clone()),
        }
    }
}

/// A dropped reply means that the command panicked or that the thread has ended.
fn gone() -> Error {
    during("device")("the device thread gave no answer")
}
