//! The command loop of the device thread: executes commands and decides in which order it answers them.
//!
//! Frames, picks and vertex readbacks are answered asynchronously, each type from its own bounded queue
//! ([`InFlightQueue`]). The loop polls readbacks that were started before a command, not those that the command starts;
//! they overlap with the next command. AOVs are read back while their command is executed, because the renderer has no
//! asynchronous readback for them, so no AOV is ever in flight.
//!
//! Frames pass through the renderer's ring buffer. The loop submits a frame, executes the commands after it, and
//! answers the frame once the device has drawn it, or before the next submission when every ring slot is in flight. Two
//! dedicated threads copy the pixels, so that the next command does not wait for the copy. They are separate from
//! rayon's global thread pool because a long job in that pool, such as building a scene, would delay the copies. A
//! delayed copy occupies its ring slot and so delays the frames of all scenes.
//!
//! # Failures
//! A panic in a command, in a poll or in a copy costs that command: its reply channel is dropped, so its caller gets an
//! error, and the loop continues. After the first `Error::DeviceLost` the loop refuses every command with that error
//! except `UnloadScene`.

use std::collections::HashMap;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::time::{Duration, Instant};

use rayon::{ThreadPool, ThreadPoolBuilder};
use tokio::sync::mpsc;

use super::command::{Command, Reply, SceneId, TimedVertices};
use super::context::{DeviceContext, EngineInfo, PendingDraw};
use super::device_loss::DeviceLossSender;
use super::in_flight::{InFlight, InFlightQueue, Pollable};
use super::loaded_scene::LoadedScene;
use crate::telemetry::ms_since;
use modalcast_model::deform::{VertexAttributes, VertexReadback};
use modalcast_model::error::{Result, fault_in};
use modalcast_model::scene::{Camera, FrameSize, PixelRect};
use modalcast_render::{FrameImage, MAX_FRAMES_IN_FLIGHT, PendingPick, PickHit};

/// How long the thread waits for a frame before it polls the command queue again.
const POLL_INTERVAL: Duration = Duration::from_micros(100);
/// Threads that copy pixels.
const COPY_THREADS: usize = 2;
/// Picks in flight. A further pick first waits for the oldest one.
const MAX_PICKS_IN_FLIGHT: usize = 16;
/// Vertex readbacks in flight: one that was started by the last command, and one by the command before it.
const MAX_VERTEX_READBACKS_IN_FLIGHT: usize = 2;

/// State owned by the device thread: the device context, the loaded scenes and the readbacks in flight.
pub(super) struct DeviceLoop {
    context: DeviceContext,
    loss: DeviceLossSender,
    copy_pool: ThreadPool,
    scenes: HashMap<SceneId, LoadedScene>,
    vertices: InFlightQueue<PendingVertices, TimedVertices>,
    picks: InFlightQueue<PendingPick, Vec<PickHit>>,
    frames: InFlightQueue<PendingDraw, FrameImage>,
}

/// A vertex readback in flight.
struct PendingVertices {
    id: SceneId,
    readback: VertexReadback,
    begin: Instant,
}

impl Pollable for PendingPick {
    /// Ignores `limit`, because a pick can only be polled.
    fn is_ready_within(&self, _limit: Duration) -> bool {
        self.is_ready()
    }
}

impl Pollable for PendingDraw {
    fn is_ready_within(&self, limit: Duration) -> bool {
        Self::is_ready_within(self, limit)
    }
}

/// Calls `act` and catches its panic. The panicking command drops its reply channel, so its caller gets an error.
fn catch_panic(act: impl FnOnce()) {
    if catch_unwind(AssertUnwindSafe(act)).is_err() {
        tracing::error!("a command panicked on the device thread");
    }
}

/// Sends an answer and drops it if the caller no longer waits.
fn answer<T>(reply: Reply<T>, result: Result<T>) {
    reply.send(result).ok();
}

impl DeviceLoop {
    /// Starts the threads that copy pixels.
    ///
    /// # Errors
    /// `Fault` when the threads cannot be started.
    pub(super) fn new(context: DeviceContext, loss: DeviceLossSender) -> Result<Self> {
        let copy_pool =
            ThreadPoolBuilder::new().num_threads(COPY_THREADS).thread_name(|index| format!("pixels {index}"));
        Ok(Self {
            context,
            loss,
            copy_pool: copy_pool.build().map_err(fault_in("threads that copy pixels"))?,
            scenes: HashMap::new(),
            vertices: InFlightQueue::new(MAX_VERTEX_READBACKS_IN_FLIGHT),
            picks: InFlightQueue::new(MAX_PICKS_IN_FLIGHT),
            frames: InFlightQueue::new(MAX_FRAMES_IN_FLIGHT),
        })
    }

    /// The backend that deforms and the renderer that draws.
    pub(super) const fn info(&self) -> &EngineInfo {
        self.context.info()
    }

    /// Executes commands until `Quit` arrives or every sender is dropped, then unloads all scenes.
    pub(super) fn run(mut self, mut inbox: mpsc::Receiver<Command>) {
        while let Some(command) = self.next_command(&mut inbox) {
            if matches!(command, Command::Quit) {
                break;
            }
            let older_vertices = self.vertices.len();
            catch_panic(|| self.execute(command));
            for _ in 0..older_vertices {
                catch_panic(|| self.finish_oldest_vertices());
            }
            while self.picks.is_oldest_ready(Duration::ZERO) {
                catch_panic(|| self.finish_oldest_pick());
            }
            while self.frames.is_oldest_ready(Duration::ZERO) {
                catch_panic(|| self.finish_oldest_frame());
            }
        }
        self.vertices.clear();
        self.picks.clear();
        self.frames.clear();
        for (_, scene) in self.scenes.drain() {
            catch_panic(|| self.context.unload_scene(scene));
        }
    }

    /// The next command. While the command queue is empty, waits for readbacks in flight and answers them.
    fn next_command(&mut self, inbox: &mut mpsc::Receiver<Command>) -> Option<Command> {
        while !(self.vertices.is_empty() && self.picks.is_empty() && self.frames.is_empty()) {
            match inbox.try_recv() {
                Ok(command) => return Some(command),
                Err(_) => catch_panic(|| self.finish_one()),
            }
        }
        inbox.blocking_recv()
    }

    fn execute(&mut self, command: Command) {
        if let Some(error) = self.loss.error().filter(|_| !matches!(command, Command::UnloadScene { .. })) {
            return command.refuse(error);
        }
        match command {
            Command::LoadScene { id, scene, backends, reply } => {
                let loaded = self.loss.note(self.context.load_scene(&scene, backends)).map(|scene| {
                    self.scenes.insert(id, scene);
                });
                // If the caller has gone, no `UnloadScene` will follow.
                if reply.send(loaded).is_err() {
                    self.unload(id);
                }
            }
            Command::Deform { id, state, reply } => {
                let deformed = self.scene(id).and_then(|scene| scene.deform_shared(&state));
                answer(reply, self.loss.note(deformed));
            }
            Command::UnloadScene { id, reply } => {
                self.unload(id);
                answer(reply, Ok(()));
            }
            Command::Draw { id, camera, size, reply } if !reply.is_closed() => self.draw(id, camera, size, reply),
            Command::RenderAov { id, camera, size, frame_output, reply } if !reply.is_closed() => {
                let Self { context, scenes, .. } = self;
                let aov = find(scenes, id).and_then(|scene| context.render_aov(scene, &camera, size, frame_output));
                answer(reply, self.loss.note(aov));
            }
            Command::Pick { id, camera, picture, rectangle, reply } if !reply.is_closed() => {
                self.pick(id, camera, picture, rectangle, reply);
            }
            Command::ReadVertices { id, wanted, reply } if !reply.is_closed() => self.read_vertices(id, wanted, reply),
            // The caller no longer waits, so the work is skipped.
            Command::Draw { .. }
            | Command::RenderAov { .. }
            | Command::Pick { .. }
            | Command::ReadVertices { .. }
            | Command::Quit => {}
        }
    }

    fn unload(&mut self, id: SceneId) {
        if let Some(scene) = self.scenes.remove(&id) {
            self.context.unload_scene(scene);
        }
    }

    /// Submits a frame. Waits for the oldest frame first if the ring is full.
    fn draw(&mut self, id: SceneId, camera: Camera, size: FrameSize, reply: Reply<FrameImage>) {
        while self.frames.is_full() {
            self.finish_oldest_frame();
        }
        let Self { context, scenes, .. } = self;
        let drawing = find(scenes, id).and_then(|scene| context.begin_draw(scene, &camera, size));
        match self.loss.note(drawing) {
            Ok(drawing) => self.frames.push(drawing, reply),
            Err(error) => answer(reply, Err(error)),
        }
    }

    /// Submits a pick. Waits for the oldest pick first if the queue is full.
    fn pick(
        &mut self,
        id: SceneId,
        camera: Camera,
        picture: FrameSize,
        rectangle: PixelRect,
        reply: Reply<Vec<PickHit>>,
    ) {
        while self.picks.is_full() {
            self.finish_oldest_pick();
        }
        let Self { context, scenes, .. } = self;
        let pick = find(scenes, id).and_then(|scene| context.begin_pick(scene, &camera, picture, rectangle));
        match self.loss.note(pick) {
            Ok(pick) => self.picks.push(pick, reply),
            Err(error) => answer(reply, Err(error)),
        }
    }

    /// Starts a vertex readback; answers immediately if the vertices are already in host memory.
    fn read_vertices(&mut self, id: SceneId, wanted: VertexAttributes, reply: Reply<TimedVertices>) {
        while self.vertices.is_full() {
            self.finish_oldest_vertices();
        }
        let begin = Instant::now();
        let readback = self.scene(id).and_then(|scene| scene.readback(wanted));
        match self.loss.note(readback) {
            Ok(readback) if readback.is_ready() => {
                self.finish_vertices(InFlight { pending: PendingVertices { id, readback, begin }, reply });
            }
            Ok(readback) => self.vertices.push(PendingVertices { id, readback, begin }, reply),
            Err(error) => answer(reply, Err(error)),
        }
    }

    /// Answers one readback in flight, or waits for a frame for at most [`POLL_INTERVAL`].
    fn finish_one(&mut self) {
        if !self.vertices.is_empty() {
            self.finish_oldest_vertices();
        } else if self.picks.is_oldest_ready(Duration::ZERO) {
            self.finish_oldest_pick();
        } else if self.frames.is_oldest_ready(POLL_INTERVAL) {
            self.finish_oldest_frame();
        } else if self.frames.is_empty() {
            self.finish_oldest_pick();
        }
    }

    /// Waits for the oldest pick in flight and answers it.
    fn finish_oldest_pick(&mut self) {
        let Some(InFlight { pending, reply }) = self.picks.pop_oldest() else { return };
        let hits = self.context.finish_pick(pending);
        answer(reply, self.loss.note(hits));
    }

    /// Waits for the oldest frame in flight; a copy thread then copies and sends its pixels.
    fn finish_oldest_frame(&mut self) {
        let Some(InFlight { pending, reply }) = self.frames.pop_oldest() else { return };
        if reply.is_closed() {
            return; // The caller no longer waits.
        }
        let pixels = self.context.finish_draw(pending);
        match self.loss.note(pixels) {
            Ok(pixels) => self.copy_pool.spawn(move || catch_panic(|| answer(reply, Ok(pixels.into_image())))),
            Err(error) => answer(reply, Err(error)),
        }
    }

    /// Waits for the oldest vertex readback in flight and answers it.
    fn finish_oldest_vertices(&mut self) {
        if let Some(oldest) = self.vertices.pop_oldest() {
            self.finish_vertices(oldest);
        }
    }

    fn finish_vertices(&mut self, readback: InFlight<PendingVertices, TimedVertices>) {
        let InFlight { pending: PendingVertices { id, readback, begin }, reply } = readback;
        let surface = self.scene(id).and_then(|scene| scene.wait_readback(&readback));
        answer(reply, self.loss.note(surface).map(|surface| (surface, ms_since(begin))));
    }

    fn scene(&mut self, id: SceneId) -> Result<&mut LoadedScene> {
        find(&mut self.scenes, id)
    }
}

fn find(scenes: &mut HashMap<SceneId, LoadedScene>, id: SceneId) -> Result<&mut LoadedScene> {
    scenes.get_mut(&id).ok_or_else(|| fault_in("device")(format!("scene {id} is not loaded")))
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::super::handle::{DeviceHandle, DeviceThread};
    use super::*;
    use crate::engine::testing::{self, FaultyDeformer, InjectedFault};
    use modalcast_model::backend_settings::BackendSettings;
    use modalcast_model::error::Error;
    use modalcast_model::scene::{Scene, SceneState};

    const FAULTY: SceneId = 1;
    const CONTROL: SceneId = 2;
    const POSITIONS: VertexAttributes =
        VertexAttributes { positions: true, normals: false, displacements: false, boxes: false };

    /// A device thread with two loaded scenes.
    async fn two_scenes() -> (DeviceHandle, Arc<Scene>) {
        let open = || DeviceContext::with_deformer(FaultyDeformer::boxed);
        let handle = DeviceThread::start(2, open).await.expect("starts").handle;
        let scene = testing::two_strips();
        for id in [FAULTY, CONTROL] {
            handle.load_scene(id, &scene, BackendSettings::default()).await.expect("loads");
        }
        (handle, scene)
    }

    fn state(scene: &Scene, q: f32) -> Arc<SceneState> {
        let mut state = SceneState::rest(scene);
        state.q[0] = q;
        Arc::new(state)
    }

    /// Deforms to `q` and returns the first positions.
    async fn positions(handle: &DeviceHandle, id: SceneId, state: &Arc<SceneState>) -> Result<Vec<f32>> {
        handle.deform(id, state).wait().await?;
        handle.read_vertices(id, POSITIONS).wait().await.map(|(surface, _)| surface.positions.clone())
    }

    #[tokio::test]
    async fn panicking_command_costs_only_that_command() {
        use InjectedFault::{PanicInDeform, PanicInReadback, PanicInWait};
        for fault in [PanicInDeform, PanicInReadback, PanicInWait] {
            let (handle, scene) = two_scenes().await;
            let good = state(&scene, 0.5);
            let before = positions(&handle, FAULTY, &good).await.expect("deforms");
            let error = positions(&handle, FAULTY, &state(&scene, fault.q())).await.expect_err("panics");
            assert!(matches!(&error, Error::Fault { reason, .. } if reason.contains("panicked")), "{fault:?}: {error}");
            let control = positions(&handle, CONTROL, &good).await;
            assert_eq!(control.as_ref(), Ok(&before), "{fault:?}: the other scene goes on");
            if fault == PanicInDeform {
                // The state before the panic was restored.
                let after = handle.read_vertices(FAULTY, POSITIONS).wait().await.expect("reads").0;
                assert_eq!(after.positions, before);
            }
            assert_eq!(positions(&handle, FAULTY, &good).await.as_ref(), Ok(&before), "{fault:?}: the scene goes on");
        }
    }

    #[tokio::test]
    async fn lost_device_refuses_every_later_command() {
        let (handle, scene) = two_scenes().await;
        let good = state(&scene, 0.5);
        positions(&handle, CONTROL, &good).await.expect("control: the device works");
        assert_eq!(handle.loss().error(), None);
        let lost = positions(&handle, FAULTY, &state(&scene, InjectedFault::DeviceLost.q())).await;
        assert_eq!(lost, Err(testing::device_lost()));
        assert_eq!(handle.loss().wait().await, testing::device_lost());
        assert_eq!(positions(&handle, CONTROL, &good).await, Err(testing::device_lost()));
        assert_eq!(handle.load_scene(3, &scene, BackendSettings::default()).await, Err(testing::device_lost()));
        handle.unload_scene(CONTROL).await.expect("scenes are freed all the same");
    }
}
