//! The command loop of the device thread: executes commands and decides in which order it answers them.
//!
//! Frames pass through the renderer's ring buffer. The loop submits a frame, executes the commands after it, and
//! answers the frame once the device has drawn it, or before the next submission when every ring slot is in flight. Two
//! dedicated threads copy the pixels, so that the next command does not wait for the copy. They are separate from
//! rayon's global thread pool because a long job in that pool, such as building a scene, would delay the copies. A
//! delayed copy occupies its ring slot and so delays the frames of all scenes.

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

/// How long the thread waits for a frame before it polls the command queue again.
const SLICE: Duration = Duration::from_micros(100);
/// Threads that copy pixels.
const COPIERS: usize = 2;

/// State owned by the device thread: the device context, the loaded scenes and the readbacks in flight.
pub(super) struct Desk {
    workbench: Workbench,
    copiers: ThreadPool,
    scenes: HashMap<SceneId, Staged>,
    /// Vertex readbacks in flight, oldest first.
    arriving: VecDeque<Arriving>,
    /// Picks in flight, oldest first.
    picks: VecDeque<(Pick, Reply<Vec<Hit>>)>,
    /// Frames in flight, oldest first; at most [`FRAMES_UNDER_WAY`].
    frames: VecDeque<(Drawing, Reply<Image>)>,
}

/// A vertex readback in flight.
struct Arriving {
    id: SceneId,
    fetch: Fetch,
    begin: Instant,
    reply: Reply<Copied>,
}

/// Executes commands until `Quit` arrives or every sender is dropped.
pub(super) fn work(mut desk: Desk, mut inbox: mpsc::Receiver<Command>) {
    while let Some(command) = next(&mut desk, &mut inbox) {
        if matches!(command, Command::Quit) {
            break;
        }
        // Wait for readbacks that were started before this command. Readbacks that it starts overlap with the next one.
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

/// The next command. While the queue is empty, waits for readbacks in flight and answers them.
fn next(desk: &mut Desk, inbox: &mut mpsc::Receiver<Command>) -> Option<Command> {
    while !(desk.arriving.is_empty() && desk.picks.is_empty() && desk.frames.is_empty()) {
        match inbox.try_recv() {
            Ok(command) => return Some(command),
            Err(_) => guarded(|| desk.attend()),
        }
    }
    inbox.blocking_recv()
}

/// Catches a panic of one command. The panicking command drops its reply channel, so its caller gets an error; the
/// thread continues with the next command.
fn guarded(act: impl FnOnce()) {
    if catch_unwind(AssertUnwindSafe(act)).is_err() {
        tracing::error!("a command panicked on the device thread");
    }
}

impl Desk {
    /// Starts the threads that copy pixels.
    ///
    /// # Errors
    /// `Fault` when the threads cannot be started.
    pub(super) fn new(workbench: Workbench) -> Result<Self> {
        let copiers = ThreadPoolBuilder::new().num_threads(COPIERS).thread_name(|index| format!("pixels {index}"));
        let copiers = copiers.build().map_err(during("threads that copy pixels"))?;
        let (arriving, picks, frames) = (VecDeque::new(), VecDeque::new(), VecDeque::new());
        Ok(Self { workbench, copiers, scenes: HashMap::new(), arriving, picks, frames })
    }

    /// The backend that deforms and the renderer that draws.
    pub(super) const fn info(&self) -> &Info {
        self.workbench.info()
    }

    fn obey(&mut self, command: Command) {
        let Self { workbench, scenes, .. } = self;
        // A failed send below means that the caller no longer waits; its reply is dropped.
        match command {
            Command::Stage { id, scene, reply } => {
                let staged = workbench.stage(&scene).map(|staged| scenes.insert(id, staged));
                // The caller has gone, so no `Unstage` would ever follow.
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
            // The caller no longer waits, so the work is skipped.
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

    /// Submits a frame. Waits for the oldest frame first if the ring is full.
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
                reply.send(Err(error)).ok(); // Fails only if the caller no longer waits.
            }
        }
    }

    /// Starts a vertex readback; answers immediately if the vertices are already in host memory.
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

    /// Answers one readback in flight, or waits for a frame for at most [`SLICE`].
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

    /// Waits for the oldest pick in flight and answers it.
    fn answer_pick(&mut self) {
        let Some((pick, reply)) = self.picks.pop_front() else { return };
        reply.send(self.workbench.finish_pick(pick)).ok(); // As above.
    }

    /// Waits for the oldest frame in flight; a copy thread then copies and sends its pixels.
    fn answer_frame(&mut self) {
        let Some((drawing, reply)) = self.frames.pop_front() else { return };
        if reply.is_closed() {
            return; // The caller no longer waits.
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

    /// Waits for the oldest vertex readback in flight and answers it.
    fn hand_over(&mut self) {
        let Some(Arriving { id, fetch, begin, reply }) = self.arriving.pop_front() else { return };
        let surface = find(&mut self.scenes, id).and_then(|staged| staged.fetched(&fetch));
        reply.send(surface.map(|surface| (surface, ms_since(begin)))).ok(); // As above.
    }
}

fn find(scenes: &mut HashMap<SceneId, Staged>, id: SceneId) -> Result<&mut Staged> {
    scenes.get_mut(&id).ok_or_else(|| during("device")(format!("scene {id} is not staged")))
}
