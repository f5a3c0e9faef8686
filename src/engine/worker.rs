//! The device thread: takes commands from a bounded queue, owns the workbench and every staged scene, answers each
//! command once. Vertices are answered late: they leave the device while the command after theirs is obeyed.

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
use crate::deform::{Deformed, Fetch, Surface, Wanted};
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
    /// Brings what is wanted to the host, beside the command after it; the second value is the milliseconds until it was
    /// there.
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

/// The way to the device thread. The thread ends when the last one of these is gone.
#[derive(Debug, Clone)]
pub(super) struct Worker {
    commands: mpsc::Sender<Command>,
    limit: usize,
}

impl Worker {
    /// Starts the thread and waits until it has opened its devices.
    pub(super) async fn start(config: &Arc<Config>) -> Result<(Self, Info, std::thread::JoinHandle<()>)> {
        // Each scene has at most two commands under way, a copy and the step after it, and each opening one more; so
        // nobody is turned away by a full queue unless scenes are opened faster than the limit of open scenes allows.
        let limit = 3 * config.open_scenes + 8;
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

    /// Begins to deform.
    pub(super) fn deform(&self, id: SceneId, state: &Arc<State>) -> Asked<Deformed> {
        let state = Arc::clone(state);
        self.begin(|reply| Command::Deform { id, state, reply })
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

/// Vertices and the milliseconds until they were there.
pub(super) type Copied = (Arc<Surface>, f64);

/// What the device thread was asked for, in the order in which it was asked.
#[derive(Debug)]
pub(super) struct Asked<T>(Result<oneshot::Receiver<Result<T>>>);

impl<T> Asked<T> {
    pub(super) async fn wait(self) -> Result<T> {
        self.0?.await.map_err(|_| gone())?
    }
}

/// A dropped reply means that the command panicked or that the thread has ended.
fn gone() -> Error {
    during("device")("the device thread gave no answer")
}

/// The device thread's own.
struct Desk {
    workbench: Workbench,
    scenes: HashMap<SceneId, Staged>,
    /// Vertices on their way, oldest first.
    arriving: VecDeque<Arriving>,
    /// Picks on their way, likewise.
    picks: VecDeque<(Pick, Reply<Vec<Hit>>)>,
}

struct Arriving {
    id: SceneId,
    fetch: Fetch,
    begin: Instant,
    reply: Reply<Copied>,
}

fn work(workbench: Workbench, mut inbox: mpsc::Receiver<Command>) {
    let (arriving, picks) = (VecDeque::new(), VecDeque::new());
    let mut desk = Desk { workbench, scenes: HashMap::new(), arriving, picks };
    while let Some(command) = next(&mut desk, &mut inbox) {
        if matches!(command, Command::Quit) {
            break;
        }
        // They have had one command's time to arrive in; those that this one begins will have the next one's.
        let arriving = desk.arriving.len();
        guarded(|| desk.obey(command));
        for _ in 0..arriving {
            guarded(|| desk.hand_over());
        }
        while desk.picks.front().is_some_and(|(pick, _)| pick.is_ready()) {
            guarded(|| desk.answer_pick());
        }
    }
    desk.arriving.clear();
    desk.picks.clear();
    for (_, staged) in desk.scenes.drain() {
        desk.workbench.unstage(staged);
    }
}

/// The next command. While there is none, vertices are handed over and picks answered.
fn next(desk: &mut Desk, inbox: &mut mpsc::Receiver<Command>) -> Option<Command> {
    while !desk.arriving.is_empty() || !desk.picks.is_empty() {
        match inbox.try_recv() {
            Ok(command) => return Some(command),
            Err(_) if desk.arriving.is_empty() => guarded(|| desk.answer_pick()),
            Err(_) => guarded(|| desk.hand_over()),
        }
    }
    inbox.blocking_recv()
}

/// A panic costs the one command whose reply it drops; the thread and all scenes live on.
fn guarded(act: impl FnOnce()) {
    if catch_unwind(AssertUnwindSafe(act)).is_err() {
        tracing::error!("a command panicked on the device thread");
    }
}

impl Desk {
    fn obey(&mut self, command: Command) {
        let Self { workbench, scenes, .. } = self;
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
                let pick = |staged| workbench.begin_pick(staged, &camera, picture, rectangle);
                match find(scenes, id).and_then(pick) {
                    Ok(pick) => self.picks.push_back((pick, reply)),
                    Err(error) => {
                        reply.send(Err(error)).ok();
                    }
                }
            }
            Command::Copy { id, wanted, reply } if !reply.is_closed() => self.copy((id, wanted), reply),
            // Whoever asked has given up waiting: nothing is made.
            Command::Draw { .. }
            | Command::Survey { .. }
            | Command::Pick { .. }
            | Command::Copy { .. }
            | Command::Quit => {}
            Command::Unstage { id, reply } => {
                if let Some(staged) = scenes.remove(&id) {
                    workbench.unstage(staged);
                }
                reply.send(Ok(())).ok();
            }
        }
    }

    /// Begins to copy; what is there at once is handed over at once.
    fn copy(&mut self, (id, wanted): (SceneId, Wanted), reply: Reply<Copied>) {
        let begin = Instant::now();
        match find(&mut self.scenes, id).and_then(|staged| staged.fetch(wanted)) {
            Ok(fetch) => {
                let is_there = fetch.is_there();
                self.arriving.push_back(Arriving { id, fetch, begin, reply });
                if is_there {
                    self.arriving.rotate_right(1);
                    self.hand_over();
                }
            }
            Err(error) => {
                reply.send(Err(error)).ok(); // The asker has gone, and its answer goes with it.
            }
        }
    }

    /// Waits for the pick that has been under way for the longest.
    fn answer_pick(&mut self) {
        let Some((pick, reply)) = self.picks.pop_front() else { return };
        reply.send(self.workbench.finish_pick(pick)).ok(); // As above.
    }

    /// Waits for the vertices that have been under way for the longest.
    fn hand_over(&mut self) {
        let Some(Arriving { id, fetch, begin, reply }) = self.arriving.pop_front() else { return };
        let surface = find(&mut self.scenes, id).and_then(|staged| staged.fetched(&fetch));
        reply.send(surface.map(|surface| (surface, ms_since(begin)))).ok(); // As above.
    }
}

fn find(scenes: &mut HashMap<SceneId, Staged>, id: SceneId) -> Result<&mut Staged> {
    scenes.get_mut(&id).ok_or_else(|| during("device")(format!("scene {id} is not staged")))
}
