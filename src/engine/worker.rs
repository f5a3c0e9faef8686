//! The device thread: takes commands from a bounded queue, owns the workbench and every staged scene, answers each
//! command once.

use std::collections::{HashMap, VecDeque};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::time::Instant;

use tokio::sync::mpsc::error::TrySendError;
use tokio::sync::{mpsc, oneshot};

use super::staged::Staged;
use super::viewer::Showing;
use super::workbench::{Info, Workbench};
use crate::config::Config;
use crate::deform::{Deformed, Surface};
use crate::error::{Error, Result, during};
use crate::frame::Legend;
use crate::render::{Hit, Image, Pick, Survey};
use crate::scene::{Camera, Rectangle, Scene, State};
use crate::telemetry::ms_since;

/// Names a staged scene on the device thread.
pub(super) type SceneId = u64;

type Reply<T> = oneshot::Sender<Result<T>>;

/// What the device thread can be asked for.
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
    /// Copies positions and normals out; the second value is its milliseconds.
    Copy {
        id: SceneId,
        reply: Reply<(Arc<Surface>, f64)>,
    },
    Unstage {
        id: SceneId,
        reply: Reply<()>,
    },
    /// Ends the thread.
    Quit,
}

/// The way to the device thread. The thread ends when the last one of these is gone.
#[derive(Debug, Clone)]
pub(super) struct Worker {
    commands: mpsc::Sender<Command>,
    limit: usize,
}

impl Worker {
    /// Starts the thread and waits until it has opened its devices.
    pub(super) async fn start(config: &Arc<Config>) -> Result<(Self, Info, std::thread::JoinHandle<()>)> {
        // Each scene has at most one command under way, and each opening one more; so nobody is turned away by a full
        // queue unless scenes are opened faster than the limit of open scenes allows.
        let limit = 2 * config.open_scenes + 8;
        let (commands, inbox) = mpsc::channel(limit);
        let (tell, told) = oneshot::channel();
        let config = Arc::clone(config);
        let thread = std::thread::Builder::new()
            .name("device".into())
            .spawn(move || match Workbench::open(&config) {
                Ok(workbench) => {
                    tell.send(Ok(workbench.info().clone())).ok(); // The starter has gone; the queue is closed then too.
                    work(workbench, inbox);
                }
                Err(error) => {
                    tell.send(Err(error)).ok(); // As above.
                }
            })
            .map_err(during("device thread"))?;
        let info = told.await.map_err(|_| gone())??;
        Ok((Self { commands, limit }, info, thread))
    }

    pub(super) async fn stage(&self, id: SceneId, scene: &Arc<Scene>) -> Result<()> {
        let scene = Arc::clone(scene);
        self.ask(|reply| Command::Stage { id, scene, reply }).await
    }

    pub(super) async fn deform(&self, id: SceneId, state: &Arc<State>) -> Result<Deformed> {
        let state = Arc::clone(state);
        self.ask(|reply| Command::Deform { id, state, reply }).await
    }

    pub(super) async fn draw(&self, id: SceneId, camera: Camera, size: (u32, u32)) -> Result<Image> {
        self.ask(|reply| Command::Draw { id, camera, size, reply }).await
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

    pub(super) async fn copy(&self, id: SceneId) -> Result<(Arc<Surface>, f64)> {
        self.ask(|reply| Command::Copy { id, reply }).await
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
        let (reply, answer) = oneshot::channel();
        match self.commands.try_send(make(reply)) {
            Ok(()) => answer.await.map_err(|_| gone())?,
            Err(TrySendError::Full(_)) => Err(Error::Busy { queue: "device", limit: self.limit }),
            Err(TrySendError::Closed(_)) => Err(gone()),
        }
    }
}

/// A dropped reply means that the command panicked or that the thread has ended.
fn gone() -> Error {
    during("device")("the device thread gave no answer")
}

fn work(mut workbench: Workbench, mut inbox: mpsc::Receiver<Command>) {
    let mut scenes = HashMap::new();
    let mut picks = VecDeque::new();
    loop {
        // Picks that are on their way are waited for only when there is nothing else to do.
        let command = match picks.is_empty() {
            true => inbox.blocking_recv(),
            false => inbox.try_recv().ok(),
        };
        let idle = command.is_none();
        if matches!(command, Some(Command::Quit)) || (idle && picks.is_empty()) {
            break;
        }
        // A panic below costs the one command whose reply it drops; the thread and all scenes live on.
        let outcome = catch_unwind(AssertUnwindSafe(|| {
            if let Some(command) = command {
                obey(&mut workbench, (&mut scenes, &mut picks), command);
            }
            while picks.front().is_some_and(|(pick, _): &(Pick, _)| idle || pick.is_ready()) {
                let Some((pick, reply)) = picks.pop_front() else { break };
                reply.send(workbench.finish_pick(pick)).ok(); // The asker has gone, and its answer goes with it.
            }
        }));
        if outcome.is_err() {
            tracing::error!("a command panicked on the device thread");
        }
    }
    for (_, staged) in scenes.drain() {
        workbench.unstage(staged);
    }
}

/// Picks on their way, and who waits for them.
type Picks = VecDeque<(Pick, Reply<Vec<Hit>>)>;

fn obey(workbench: &mut Workbench, (scenes, picks): (&mut HashMap<SceneId, Staged>, &mut Picks), command: Command) {
    // Every ignored result below means: the asker has gone, and its answer goes with it.
    match command {
        Command::Stage { id, scene, reply } => {
            let staged = workbench.stage(&scene).map(|staged| scenes.insert(id, staged));
            // Nobody would ever put away a scene that nobody waits for.
            if reply.send(staged.map(|_| ())).is_err()
                && let Some(staged) = scenes.remove(&id)
            {
                workbench.unstage(staged);
            }
        }
        Command::Deform { id, state, reply } => {
            reply.send(find(scenes, id).and_then(|staged| staged.deform_shared(&state))).ok();
        }
        Command::Draw { id, camera, size: (width, height), reply } if !reply.is_closed() => {
            let drawn = find(scenes, id).and_then(|staged| workbench.draw(staged, &camera, width, height));
            reply.send(drawn).ok();
        }
        Command::Survey { id, camera, size, showing, reply } if !reply.is_closed() => {
            reply.send(find(scenes, id).and_then(|staged| workbench.survey(staged, &camera, size, showing))).ok();
        }
        Command::Pick { id, camera, picture, rectangle, reply } if !reply.is_closed() => {
            let begun = find(scenes, id).and_then(|staged| workbench.begin_pick(staged, &camera, picture, rectangle));
            match begun {
                Ok(pick) => picks.push_back((pick, reply)),
                Err(error) => {
                    reply.send(Err(error)).ok();
                }
            }
        }
        Command::Copy { id, reply } if !reply.is_closed() => {
            reply.send(find(scenes, id).and_then(copy)).ok();
        }
        // Whoever asked has given up waiting: the picture is not made.
        Command::Draw { .. } | Command::Survey { .. } | Command::Pick { .. } | Command::Copy { .. } | Command::Quit => {
        }
        Command::Unstage { id, reply } => {
            if let Some(staged) = scenes.remove(&id) {
                workbench.unstage(staged);
            }
            reply.send(Ok(())).ok();
        }
    }
}

fn copy(staged: &mut Staged) -> Result<(Arc<Surface>, f64)> {
    let begin = Instant::now();
    let surface = staged.surface()?;
    // Tangents are for the renderer alone and stay here.
    let copy = Surface { positions: surface.positions.clone(), normals: surface.normals.clone(), tangents: Vec::new() };
    Ok((Arc::new(copy), ms_since(begin)))
}

fn find(scenes: &mut HashMap<SceneId, Staged>, id: SceneId) -> Result<&mut Staged> {
    scenes.get_mut(&id).ok_or_else(|| during("device")(format!("scene {id} is not staged")))
}
