//! What the device thread does with commands, and in which order it answers them.
//!
//! Frames go through the renderer's ring: one is begun, the commands after it are obeyed, and it is answered once the device
//! has drawn it, or before a further one when as many are under way as the ring has places. Its pixels are copied by two
//! threads of the desk's own, so that the device's next command does not wait for that. They are not those that all work
//! shares: a long job there, such as growing a scene, would keep the copies waiting, and the ring's places with them, and
//! so the frames of all scenes.

use std::collections::{HashMap, VecDeque};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::time::{Duration, Instant};

use rayon::{ThreadPool, ThreadPoolBuilder};
use tokio::sync::mpsc;

use super::command::{Command, Copied, Reply, SceneId};
use super::staged::Staged;
use super::workbench::{Drawing, Info, Workbench};
use crate::telemetry::ms_since;
use modalcast_model::deform::{Fetch, Wanted};
use modalcast_model::error::{Result, during};
use modalcast_model::scene::Camera;
use modalcast_render::{FRAMES_UNDER_WAY, Hit, Image, Pick};

/// How long the thread waits for a frame before it looks for a command again.
const SLICE: Duration = Duration::from_micros(100);
/// Threads that copy pixels.
const COPIERS: usize = 2;

/// The device thread's own.
pub(super) struct Desk {
    workbench: Workbench,
    copiers: ThreadPool,
    scenes: HashMap<SceneId, Staged>,
    /// Vertices on their way, oldest first.
    arriving: VecDeque<Arriving>,
    /// Picks on their way, likewise.
    picks: VecDeque<(Pick, Reply<Vec<Hit>>)>,
    /// Frames on their way, likewise: as many as the ring has places.
    frames: VecDeque<(Drawing, Reply<Image>)>,
}

struct Arriving {
    id: SceneId,
    fetch: Fetch,
    begin: Instant,
    reply: Reply<Copied>,
}

/// Obeys commands until one ends the thread or nobody can give any.
pub(super) fn work(mut desk: Desk, mut inbox: mpsc::Receiver<Command>) {
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
        while desk.frames.front().is_some_and(|(drawing, _)| drawing.is_ready_within(Duration::ZERO)) {
            guarded(|| desk.answer_frame());
        }
    }
    desk.arriving.clear();
    desk.picks.clear();
    desk.frames.clear();
    for (_, staged) in desk.scenes.drain() {
        desk.workbench.unstage(staged);
    }
}

/// The next command. While there is none, what is on its way is waited for and answered.
fn next(desk: &mut Desk, inbox: &mut mpsc::Receiver<Command>) -> Option<Command> {
    while !(desk.arriving.is_empty() && desk.picks.is_empty() && desk.frames.is_empty()) {
        match inbox.try_recv() {
            Ok(command) => return Some(command),
            Err(_) => guarded(|| desk.attend()),
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
    /// Starts the threads that copy.
    pub(super) fn new(workbench: Workbench) -> Result<Self> {
        let copiers = ThreadPoolBuilder::new().num_threads(COPIERS).thread_name(|index| format!("pixels {index}"));
        let copiers = copiers.build().map_err(during("threads that copy pixels"))?;
        let (arriving, picks, frames) = (VecDeque::new(), VecDeque::new(), VecDeque::new());
        Ok(Self { workbench, copiers, scenes: HashMap::new(), arriving, picks, frames })
    }

    /// What deforms and what draws.
    pub(super) const fn info(&self) -> &Info {
        self.workbench.info()
    }

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
            Command::Draw { id, camera, size, reply } if !reply.is_closed() => self.draw((id, camera, size), reply),
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

    /// Begins a frame, after the oldest was waited for where the ring is full.
    fn draw(&mut self, (id, camera, (width, height)): (SceneId, Camera, (u32, u32)), reply: Reply<Image>) {
        while self.frames.len() >= FRAMES_UNDER_WAY {
            self.answer_frame();
        }
        let workbench = &mut self.workbench;
        let drawing =
            find(&mut self.scenes, id).and_then(|staged| workbench.begin_draw(staged, &camera, width, height));
        match drawing {
            Ok(drawing) => self.frames.push_back((drawing, reply)),
            Err(error) => {
                reply.send(Err(error)).ok(); // The asker has gone, and its answer goes with it.
            }
        }
    }

    /// Begins to copy; what is there at once is handed over at once.
    fn copy(&mut self, (id, wanted): (SceneId, Wanted), reply: Reply<Copied>) {
        let begin = Instant::now();
        match find(&mut self.scenes, id).and_then(|staged| staged.fetch(wanted)) {
            Ok(fetch) => {
                let is_ready = fetch.is_ready();
                self.arriving.push_back(Arriving { id, fetch, begin, reply });
                if is_ready {
                    self.arriving.rotate_right(1);
                    self.hand_over();
                }
            }
            Err(error) => {
                reply.send(Err(error)).ok(); // As above.
            }
        }
    }

    /// Answers one thing that is on its way, or waits for it a little.
    fn attend(&mut self) {
        if !self.arriving.is_empty() {
            return self.hand_over();
        }
        match (self.picks.front(), self.frames.front()) {
            (Some((pick, _)), _) if pick.is_ready() => self.answer_pick(),
            (_, Some((drawing, _))) if drawing.is_ready_within(SLICE) => self.answer_frame(),
            (Some(_), None) => self.answer_pick(),
            _ => {}
        }
    }

    /// Waits for the pick that has been under way for the longest.
    fn answer_pick(&mut self) {
        let Some((pick, reply)) = self.picks.pop_front() else { return };
        reply.send(self.workbench.finish_pick(pick)).ok(); // As above.
    }

    /// Waits for the frame that has been under way for the longest, and lets another thread copy and send its pixels.
    fn answer_frame(&mut self) {
        let Some((drawing, reply)) = self.frames.pop_front() else { return };
        if reply.is_closed() {
            return; // Nobody waits for it.
        }
        match self.workbench.finish_draw(drawing) {
            Ok(pixels) => self.copiers.spawn(move || {
                guarded(|| {
                    reply.send(Ok(pixels.into_image())).ok(); // As above.
                });
            }),
            Err(error) => {
                reply.send(Err(error)).ok(); // As above.
            }
        }
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
