//! The command loop of the device thread: executes commands and decides in which order it answers them.
//!
//! Frames, picks and vertex readbacks are answered asynchronously, each type from its own bounded queue
//! ([`InFlightQueue`]). After each command the loop waits for the vertex readbacks that were started before this
//! command and answers them. It also answers the picks and frames that are ready. Readbacks that the command starts
//! overlap with the next command. AOVs (arbitrary output variables: depth, normals and others) are never in flight:
//! the renderer has no asynchronous readback for them.
//!
//! Frames pass through the renderer's ring buffer. The loop submits a frame, executes the commands after it, and
//! answers the frame once the device has drawn it, or before the next submission when every ring slot is in flight. Two
//! dedicated threads copy the pixels, so that the next command does not wait for the copy. They are separate from
//! rayon's global thread pool because a long job in that pool, such as building a scene, would delay the copies. A
//! delayed copy occupies its ring slot and so delays the frames of all scenes.
//!
//! # Failures
//! A panic in a command, in a poll or in a copy drops the reply channel of that command, so its caller gets an error.
//! The loop continues. After the first `Error::DeviceLost` the loop answers every command with that error, except
//! `UnloadScene`.

use std::collections::HashMap;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::time::{Duration, Instant};

use rayon::{ThreadPool, ThreadPoolBuilder};
use tokio::sync::mpsc;

use super::command::{Command, CopiedVertices, Reply, SceneId};
use super::context::{DeviceContext, EngineInfo, PendingDraw};
use super::device_loss::DeviceLossSender;
use super::in_flight::{InFlight, InFlightQueue, Pollable};
use super::loaded_scene::LoadedScene;
use crate::telemetry::ms_since;
use modalcast_model::deform::{VertexAttributes, VertexReadback};
use modalcast_model::error::{Result, fault, fault_in};
use modalcast_model::scene::{Camera, FrameSize, PixelRect};
use modalcast_render::{FrameImage, MAX_FRAMES_IN_FLIGHT, PendingPick, PickHit};

/// How long the thread waits for a frame before it checks the command queue again.
const POLL_INTERVAL: Duration = Duration::from_micros(100);
/// Number of threads that copy pixels.
const COPY_THREADS: usize = 2;
/// Maximum number of picks in flight. A further pick first waits for the oldest one.
const MAX_PICKS_IN_FLIGHT: usize = 16;
/// Maximum number of vertex readbacks in flight: one of the current command, and one of the command before it.
const MAX_VERTEX_READBACKS_IN_FLIGHT: usize = 2;

/// State owned by the device thread: the device context, the loaded scenes and the readbacks in flight.
pub(super) struct DeviceLoop {
    context: DeviceContext,
    /// Records the loss of the device.
    loss: DeviceLossSender,
    /// Threads that copy pixels of frames.
    copy_pool: ThreadPool,
    scenes: HashMap<SceneId, LoadedScene>,
    vertices: InFlightQueue<PendingVertices, CopiedVertices>,
    picks: InFlightQueue<PendingPick, Vec<PickHit>>,
    frames: InFlightQueue<PendingDraw, FrameImage>,
}

/// A vertex readback in flight.
struct PendingVertices {
    id: SceneId,
    readback: VertexReadback,
    start: Instant,
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

/// Runs part of a command and catches its panic. The panic drops the command's reply channel, so its caller gets an
/// error.
fn run_caught(work: impl FnOnce()) {
    if catch_unwind(AssertUnwindSafe(work)).is_err() {
        tracing::error!("a command panicked on the device thread");
    }
}

/// Sends an answer. Drops it if the caller no longer waits.
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

    /// The backend and the renderer in use.
    pub(super) const fn info(&self) -> &EngineInfo {
        self.context.info()
    }

    /// Executes commands until `Quit` arrives or every sender is dropped, then unloads all scenes.
    pub(super) fn run(mut self, mut inbox: mpsc::Receiver<Command>) {
        while let Some(command) = self.next_command(&mut inbox) {
            if matches!(command, Command::Quit) {
                break;
            }
            let older_readback_count = self.vertices.len();
            run_caught(|| self.execute(command));
            for _ in 0..older_readback_count {
                run_caught(|| self.finish_oldest_vertices());
            }
            while self.picks.is_oldest_ready(Duration::ZERO) {
                run_caught(|| self.finish_oldest_pick());
            }
            while self.frames.is_oldest_ready(Duration::ZERO) {
                run_caught(|| self.finish_oldest_frame());
            }
        }
        self.vertices.clear();
        self.picks.clear();
        self.frames.clear();
        for (_, scene) in self.scenes.drain() {
            run_caught(|| self.context.unload_scene(scene));
        }
    }

    /// Returns the next command. While the command queue is empty, answers readbacks in flight.
    fn next_command(&mut self, inbox: &mut mpsc::Receiver<Command>) -> Option<Command> {
        while !(self.vertices.is_empty() && self.picks.is_empty() && self.frames.is_empty()) {
            match inbox.try_recv() {
                Ok(command) => return Some(command),
                Err(_) => run_caught(|| self.finish_one()),
            }
        }
        inbox.blocking_recv()
    }

    fn execute(&mut self, command: Command) {
        if let Some(error) = self.loss.error().filter(|_| !matches!(command, Command::UnloadScene { .. })) {
            return command.reply_error(error);
        }
        match command {
            Command::LoadScene { id, scene, backends, reply } => {
                let result = self.loss.record_loss(self.context.load_scene(&scene, backends)).map(|scene| {
                    self.scenes.insert(id, scene);
                });
                // If the caller no longer waits, no `UnloadScene` will follow.
                if reply.send(result).is_err() {
                    self.unload(id);
                }
            }
            Command::Deform { id, state, reply } => {
                let deformed = self.scene(id).and_then(|scene| scene.deform_shared(&state));
                answer(reply, self.loss.record_loss(deformed));
            }
            Command::UnloadScene { id, reply } => {
                self.unload(id);
                answer(reply, Ok(()));
            }
            Command::Draw { id, camera, size, reply } if !reply.is_closed() => self.draw(id, camera, size, reply),
            Command::RenderAov { id, camera, size, frame_output, reply } if !reply.is_closed() => {
                let Self { context, scenes, .. } = self;
                let aov =
                    find_scene(scenes, id).and_then(|scene| context.render_aov(scene, &camera, size, frame_output));
                answer(reply, self.loss.record_loss(aov));
            }
            Command::Pick { id, camera, picture, rectangle, reply } if !reply.is_closed() => {
                self.pick(id, camera, picture, rectangle, reply);
            }
            Command::ReadVertices { id, attributes, reply } if !reply.is_closed() => {
                self.read_vertices(id, attributes, reply)
            }
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

    /// Submits a frame. Waits for the oldest frame first if every slot of the ring buffer is in flight.
    fn draw(&mut self, id: SceneId, camera: Camera, size: FrameSize, reply: Reply<FrameImage>) {
        while self.frames.is_full() {
            self.finish_oldest_frame();
        }
        let Self { context, scenes, .. } = self;
        let pending_draw = find_scene(scenes, id).and_then(|scene| context.begin_draw(scene, &camera, size));
        match self.loss.record_loss(pending_draw) {
            Ok(pending_draw) => self.frames.push(pending_draw, reply),
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
        let pending_pick =
            find_scene(scenes, id).and_then(|scene| context.begin_pick(scene, &camera, picture, rectangle));
        match self.loss.record_loss(pending_pick) {
            Ok(pending_pick) => self.picks.push(pending_pick, reply),
            Err(error) => answer(reply, Err(error)),
        }
    }

    /// Starts a vertex readback; answers immediately if the vertices are already in host memory.
    fn read_vertices(&mut self, id: SceneId, attributes: VertexAttributes, reply: Reply<CopiedVertices>) {
        while self.vertices.is_full() {
            self.finish_oldest_vertices();
        }
        let start = Instant::now();
        let readback = self.scene(id).and_then(|scene| scene.readback(attributes));
        match self.loss.record_loss(readback) {
            Ok(readback) if readback.is_ready() => {
                self.finish_vertices(InFlight { pending: PendingVertices { id, readback, start }, reply });
            }
            Ok(readback) => self.vertices.push(PendingVertices { id, readback, start }, reply),
            Err(error) => answer(reply, Err(error)),
        }
    }

    /// Answers one readback in flight. Waits for vertices, or for a pick if no frame is in flight. Waits for a frame
    /// for at most [`POLL_INTERVAL`], and answers nothing if the frame is not ready by then.
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
        answer(reply, self.loss.record_loss(hits));
    }

    /// Waits for the oldest frame in flight; a copy thread then copies and sends its pixels.
    fn finish_oldest_frame(&mut self) {
        let Some(InFlight { pending, reply }) = self.frames.pop_oldest() else { return };
        if reply.is_closed() {
            return; // The caller no longer waits.
        }
        let pixels = self.context.finish_draw(pending);
        match self.loss.record_loss(pixels) {
            Ok(pixels) => self.copy_pool.spawn(move || run_caught(|| answer(reply, Ok(pixels.into_image())))),
            Err(error) => answer(reply, Err(error)),
        }
    }

    /// Waits for the oldest vertex readback in flight and answers it.
    fn finish_oldest_vertices(&mut self) {
        if let Some(oldest) = self.vertices.pop_oldest() {
            self.finish_vertices(oldest);
        }
    }

    fn finish_vertices(&mut self, readback: InFlight<PendingVertices, CopiedVertices>) {
        let InFlight { pending: PendingVertices { id, readback, start }, reply } = readback;
        let surface = self.scene(id).and_then(|scene| scene.wait_readback(&readback));
        let vertices = self.loss.record_loss(surface);
        answer(reply, vertices.map(|surface| CopiedVertices { surface, copy_ms: ms_since(start) }));
    }

    fn scene(&mut self, id: SceneId) -> Result<&mut LoadedScene> {
        find_scene(&mut self.scenes, id)
    }
}

fn find_scene(scenes: &mut HashMap<SceneId, LoadedScene>, id: SceneId) -> Result<&mut LoadedScene> {
    scenes.get_mut(&id).ok_or_else(|| fault("device", format!("scene {id} is not loaded")))
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

    const FAULTY_SCENE: SceneId = 1;
    const CONTROL_SCENE: SceneId = 2;
    const POSITIONS: VertexAttributes =
        VertexAttributes { positions: true, normals: false, displacements: false, boxes: false };

    /// Starts a device thread whose deformer injects faults, and loads two scenes.
    async fn start_with_two_scenes() -> (DeviceHandle, Arc<Scene>) {
        let open_device = || DeviceContext::with_deformer(FaultyDeformer::boxed);
        let handle = DeviceThread::start(2, open_device).await.expect("expected a device thread").handle;
        let scene = testing::two_strips();
        for id in [FAULTY_SCENE, CONTROL_SCENE] {
            handle.load_scene(id, &scene, BackendSettings::default()).await.expect("expected a loaded scene");
        }
        (handle, scene)
    }

    /// A state whose first coordinate is `q`.
    fn state_with_q(scene: &Scene, q: f32) -> Arc<SceneState> {
        let mut state = SceneState::rest(scene);
        state.q[0] = q;
        Arc::new(state)
    }

    /// Deforms a scene to a state and reads the positions.
    async fn deform_and_read(handle: &DeviceHandle, id: SceneId, state: &Arc<SceneState>) -> Result<Vec<f32>> {
        handle.deform(id, state).wait().await?;
        handle.read_vertices(id, POSITIONS).wait().await.map(|vertices| vertices.surface.positions.clone())
    }

    #[tokio::test]
    async fn panicking_command_fails_only_itself() {
        use InjectedFault::{PanicInDeform, PanicInReadback, PanicInWait};
        for fault in [PanicInDeform, PanicInReadback, PanicInWait] {
            let (handle, scene) = start_with_two_scenes().await;
            let valid_state = state_with_q(&scene, 0.5);
            let expected = deform_and_read(&handle, FAULTY_SCENE, &valid_state).await.expect("expected positions");
            let faulty_state = state_with_q(&scene, fault.q());
            let error = deform_and_read(&handle, FAULTY_SCENE, &faulty_state).await.expect_err("expected the panic");
            assert!(matches!(&error, Error::Fault { reason, .. } if reason.contains("panicked")), "{fault:?}: {error}");
            let control = deform_and_read(&handle, CONTROL_SCENE, &valid_state).await;
            assert_eq!(control.as_ref(), Ok(&expected), "{fault:?}: expected the control scene to continue");
            if fault == PanicInDeform {
                // The state before the panic was restored.
                let restored = handle.read_vertices(FAULTY_SCENE, POSITIONS).wait().await.expect("expected vertices");
                assert_eq!(restored.surface.positions, expected);
            }
            let positions = deform_and_read(&handle, FAULTY_SCENE, &valid_state).await;
            assert_eq!(positions.as_ref(), Ok(&expected), "{fault:?}: expected the faulty scene to continue");
        }
    }

    #[tokio::test]
    async fn lost_device_fails_every_later_command() {
        let (handle, scene) = start_with_two_scenes().await;
        let valid_state = state_with_q(&scene, 0.5);
        deform_and_read(&handle, CONTROL_SCENE, &valid_state).await.expect("control: expected positions");
        assert_eq!(handle.loss().error(), None);
        let loss = testing::device_lost_error();
        let faulty_state = state_with_q(&scene, InjectedFault::DeviceLost.q());
        assert_eq!(deform_and_read(&handle, FAULTY_SCENE, &faulty_state).await, Err(loss.clone()));
        assert_eq!(handle.loss().wait().await, loss);
        assert_eq!(deform_and_read(&handle, CONTROL_SCENE, &valid_state).await, Err(loss.clone()));
        assert_eq!(handle.load_scene(3, &scene, BackendSettings::default()).await, Err(loss));
        handle.unload_scene(CONTROL_SCENE).await.expect("expected to unload a scene after the loss");
    }
}
