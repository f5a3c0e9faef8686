//! The command loop of the device thread: executes commands and decides in which order it answers them.
//!
//! Scenes are served by deficit round-robin ([`super::fair_queue`]). The commands of a scene are executed in their
//! order, so a frame shows the step before it, and a step waits for the frames before it.
//!
//! A frame or AOV (arbitrary output variable: depth, normals and others) that may take long is drawn in several draw
//! steps, each of which submits a part of its drawing commands: a range of triangles, or a band of rows. (Draw steps are
//! unrelated to the steps of the simulation.) Other scenes are served between the draw steps ([`PartialOutput`]). The
//! commands of its own scene wait until the last draw step is submitted. A draw step is submitted when the device has
//! finished the one before it, of any scene, so the commands of other scenes never wait for more than one draw step. The
//! size of a draw step follows from the time of the one before it: about 50 ms on hardware, and 500 ms on a software
//! renderer. An output may take long if it is the first of its kind and size in its scene, or if such outputs took longer
//! than a draw step. Outputs above a number of samples ([`modalcast_render::Renderer::set_max_band_samples`]) are large:
//! only one of them is drawn at a time, because each needs its own images.
//!
//! Another thread prepares the deformer of a scene before the scene is loaded: it compiles the kernels and uploads the
//! tables. The OpenGL buffers of a scene are created by its first output, or, with CUDA, when the scene is loaded.
//! Before the buffers, its textures are uploaded and its programs compiled in several parts, between which other scenes
//! are served. Other threads compute the mipmap levels, and if the driver can, compile the programs.
//!
//! An output whose caller no longer waits ends after its present draw step. On a software renderer, each pass of an
//! output is a draw step.
//!
//! Frames, picks and vertex readbacks are answered asynchronously, each type from its own bounded queue
//! ([`InFlightQueue`]). After each command the loop waits for the vertex readbacks that were started before this
//! command and answers them. It also answers the picks and frames that are ready. Readbacks that the command starts
//! overlap with the next command. AOVs are never in flight: the renderer has no asynchronous readback for them.
//!
//! Frames pass through the renderer's ring buffer. The loop submits a frame, executes the commands after it, and
//! answers the frame once the device has drawn it, or before the next submission when every ring slot is in flight. Two
//! dedicated threads copy the pixels, so that the next command does not wait for the copy. They are separate from
//! rayon's global thread pool because a long job in that pool, such as building a scene, would delay the copies. A
//! delayed copy occupies its ring slot and so delays the frames of all scenes.
//!
//! If CUDA encodes frames as PNG, a frame that is drawn waits for the next deformation, or until no frame is being
//! drawn: each change of the GPU between the contexts of OpenGL and CUDA takes 0.2 ms.
//!
//! # Failures
//! A panic in a command, in a poll or in a copy drops the reply channel of that command, so its caller gets an error.
//! The loop continues. After the loss of the renderer, and after a step that has failed on the device, the renderer is
//! opened and all scenes are loaded again ([`recovery`]). After the first `Error::DeviceLost` the loop
//! answers every command with that error, except `UnloadScene`. A call that does not return is noticed by the watchdog
//! ([`super::watchdog`]).

mod outputs;
mod recovery;

use std::collections::HashMap;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::time::{Duration, Instant};

use rayon::{ThreadPool, ThreadPoolBuilder};

use super::command::{Command, Reply, SceneId};
use super::command_queue::{CommandQueue, TakenWork, Work};
use super::context::{DeformerPreparer, DeviceContext, EngineInfo};
use super::device_loss::DeviceLossSender;
use super::in_flight::{InFlight, InFlightQueue, Pollable};
use super::loaded_scene::LoadedScene;
use super::loaded_worlds::LoadedWorlds;
use super::partial_output::{Charge, PartialOutput};
use super::recovery_limit::RecoveryLimit;
use super::watchdog::WorkClock;
use super::work_owners::WorkOwners;
use crate::engine::output::output_spec::PictureSpec;
use crate::engine::output::rendered_picture::RenderedPicture;
use crate::engine::output::step_vertices::StepVertices;
use crate::telemetry::ms_since;
use modalcast_model::backend_settings::BackendSettings;
use modalcast_model::deform::{VertexAttributes, VertexReadback};
use modalcast_model::error::{Error, Result, fault, fault_in};
use modalcast_render::{MAX_FRAMES_IN_FLIGHT, PendingFrame, PendingPick, PickHit};

/// How long the thread waits for a frame of a software renderer before it checks the command queue again.
const SOFTWARE_POLL_INTERVAL: Duration = Duration::from_micros(100);
/// [`SOFTWARE_POLL_INTERVAL`] of hardware, which is idle while a command waits.
const HARDWARE_POLL_INTERVAL: Duration = Duration::from_micros(20);
/// Work of at least this many milliseconds is logged, because the other scenes wait for it.
const LONG_WORK_MS: f64 = 10.0;
/// Time after which the memory of a render target that no frame uses is freed.
const TARGET_LIFETIME: Duration = Duration::from_secs(10);
/// Time between two searches for unused render targets.
const TARGET_CHECK_INTERVAL: Duration = Duration::from_secs(1);
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
    queue: Arc<CommandQueue>,
    /// Threads that copy pixels of frames.
    copy_pool: ThreadPool,
    clock: Arc<WorkClock>,
    owners: Arc<WorkOwners>,
    recoveries: RecoveryLimit,
    scenes: HashMap<SceneId, LoadedScene>,
    worlds: HashMap<SceneId, LoadedWorlds>,
    /// The settings of the loaded scenes, to load them again.
    backends: HashMap<SceneId, BackendSettings>,
    /// Outputs with further draw steps. The queue of their scene begins with [`Work::Continue`].
    partial_outputs: HashMap<SceneId, PartialOutput>,
    vertices: InFlightQueue<PendingVertices, Arc<StepVertices>>,
    picks: InFlightQueue<PendingPick, Vec<PickHit>>,
    frames: InFlightQueue<PendingFrame, Arc<RenderedPicture>>,
    poll_interval: Duration,
    /// When the targets were last checked.
    last_target_check: Instant,
}

/// A vertex readback in flight.
struct PendingVertices {
    readback: VertexReadback,
    /// When the readback was started.
    start: Instant,
}

impl Pollable for PendingPick {
    /// Ignores `limit`, because a pick can only be polled.
    fn is_ready_within(&self, _limit: Duration) -> bool {
        self.is_ready()
    }
}

impl Pollable for PendingFrame {
    fn is_ready_within(&self, limit: Duration) -> bool {
        self.is_ready_within(limit)
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
    reply.send(result);
}

impl DeviceLoop {
    /// Starts the threads that copy pixels.
    ///
    /// # Errors
    /// `Fault` when the threads cannot be started.
    pub(super) fn new(
        context: DeviceContext,
        loss: DeviceLossSender,
        queue: Arc<CommandQueue>,
        clock: Arc<WorkClock>,
        owners: Arc<WorkOwners>,
    ) -> Result<Self> {
        let copy_pool =
            ThreadPoolBuilder::new().num_threads(COPY_THREADS).thread_name(|index| format!("pixels {index}"));
        let is_hardware = context.info().renderer.as_ref().is_ok_and(|renderer| !renderer.software);
        Ok(Self {
            context,
            loss,
            queue,
            copy_pool: copy_pool.build().map_err(fault_in("threads that copy pixels"))?,
            clock,
            owners,
            recoveries: RecoveryLimit::default(),
            scenes: HashMap::new(),
            worlds: HashMap::new(),
            backends: HashMap::new(),
            partial_outputs: HashMap::new(),
            vertices: InFlightQueue::new(MAX_VERTEX_READBACKS_IN_FLIGHT),
            picks: InFlightQueue::new(MAX_PICKS_IN_FLIGHT),
            frames: InFlightQueue::new(MAX_FRAMES_IN_FLIGHT),
            poll_interval: if is_hardware { HARDWARE_POLL_INTERVAL } else { SOFTWARE_POLL_INTERVAL },
            last_target_check: Instant::now(),
        })
    }

    /// Prepares deformers for the context.
    pub(super) fn deformer_preparer(&self) -> DeformerPreparer {
        self.context.deformer_preparer()
    }

    /// The backend and the renderer in use.
    pub(super) const fn info(&self) -> &EngineInfo {
        self.context.info()
    }

    /// Executes commands until the queue is closed and empty.
    pub(super) fn run(mut self) {
        while self.run_next() {}
    }

    /// Executes the next command, or the next draw step of an output, and answers readbacks. Returns false if the queue
    /// is closed and empty.
    pub(super) fn run_next(&mut self) -> bool {
        let Some(taken) = self.next_work() else { return false };
        let clock = Arc::clone(&self.clock);
        clock.measure(|| self.run_taken(taken));
        true
    }

    /// Executes the work, answers readbacks, and recovers from errors.
    fn run_taken(&mut self, taken: TakenWork) {
        self.free_in_flight_slot(&taken.work);
        let older_readback_count = self.vertices.len();
        let (begin, scene, class) = (Instant::now(), taken.account, taken.class);
        self.run_caught_for(scene, |this| this.run_work(taken));
        let ms = ms_since(begin);
        if ms >= LONG_WORK_MS {
            tracing::debug!(scene, work = class.kind, ms, "other scenes waited for the device thread");
        }
        for _ in 0..older_readback_count {
            self.finish_oldest_vertices();
        }
        while self.picks.is_oldest_ready(Duration::ZERO) {
            self.finish_oldest_pick();
        }
        while self.frames.is_oldest_ready(Duration::ZERO) {
            self.finish_oldest_frame();
        }
        self.free_unused_targets();
        self.recover();
    }

    /// Runs work of a scene, catches its panic, and lets the crash log name the scene if the work ends the process.
    fn run_caught_for(&mut self, id: SceneId, work: impl FnOnce(&mut Self)) {
        let owners = Arc::clone(&self.owners);
        owners.run_on_device(id, || run_caught(|| work(self)));
    }

    /// Frees the memory of render targets that no frame has used for [`TARGET_LIFETIME`].
    fn free_unused_targets(&mut self) {
        if self.context.has_targets() && self.last_target_check.elapsed() >= TARGET_CHECK_INTERVAL {
            self.last_target_check = Instant::now();
            run_caught(|| self.context.free_unused_targets(self.scenes.values(), TARGET_LIFETIME));
        }
    }

    /// Takes the next work. While no work can run, answers readbacks in flight.
    fn next_work(&mut self) -> Option<TakenWork> {
        loop {
            // Polled before the queue is locked. A draw step waits for those of all scenes, so that a command never
            // waits for more than one.
            let busy: Vec<SceneId> = self.busy_outputs().map(|(id, _)| *id).collect();
            let is_drawing = |id: &SceneId| self.partial_outputs.get(id).is_some_and(PartialOutput::draws);
            let is_device_busy = busy.iter().any(is_drawing);
            let has_large_output = self.partial_outputs.values().any(PartialOutput::is_large);
            let can_run = |id: SceneId, work: &Work| match work {
                // An output that has failed between its steps has nothing to continue.
                Work::Continue => !(busy.contains(&id) || is_device_busy && is_drawing(&id)),
                Work::Command(command) | Work::Prepared(command) => {
                    !(has_large_output && self.is_large_output(id, command))
                }
            };
            if let Some(taken) = self.queue.take(can_run) {
                return Some(taken);
            }
            if !(self.vertices.is_empty() && self.picks.is_empty() && self.frames.is_empty()) {
                let clock = Arc::clone(&self.clock);
                clock.measure(|| {
                    self.start_encodings_if_idle();
                    run_caught(|| self.finish_one());
                    self.recover();
                });
            } else if let Some((_, output)) = self.busy_outputs().next() {
                output.is_ready_within(self.poll_interval);
            } else {
                self.free_unused_targets();
                if !self.queue.wait(self.context.has_targets().then_some(TARGET_CHECK_INTERVAL)) {
                    return None;
                }
            }
        }
    }

    /// The outputs whose last draw step is not finished.
    fn busy_outputs(&self) -> impl Iterator<Item = (&SceneId, &PartialOutput)> {
        self.partial_outputs.iter().filter(|(_, output)| !output.is_ready_within(Duration::ZERO))
    }

    /// Whether a command draws an output in several draw steps.
    fn is_large_output(&self, id: SceneId, command: &Command) -> bool {
        match command {
            Command::Draw { picture: PictureSpec { size, .. }, .. } => {
                self.scenes.get(&id).is_some_and(|scene| self.context.is_divided(scene, *size))
            }
            _ => false,
        }
    }

    /// Waits for a slot for the readback that the work may start. This wait is not part of the cost of the work.
    fn free_in_flight_slot(&mut self, work: &Work) {
        match work {
            Work::Command(Command::Draw { .. }) | Work::Prepared(Command::Draw { .. }) | Work::Continue => {
                while self.frames.is_full() {
                    self.finish_oldest_frame();
                }
            }
            Work::Command(Command::Pick { .. }) | Work::Prepared(Command::Pick { .. }) => {
                while self.picks.is_full() {
                    self.finish_oldest_pick();
                }
            }
            Work::Command(Command::ReadVertices { .. }) => {
                while self.vertices.is_full() {
                    self.finish_oldest_vertices();
                }
            }
            Work::Command(_) | Work::Prepared(_) => {}
        }
    }

    /// Executes a command or the next draw step of an output, and charges its scene the time.
    fn run_work(&mut self, taken: TakenWork) {
        let begin = Instant::now();
        let taken = match self.prepare(taken) {
            Some(taken) => taken,
            None => return,
        };
        let TakenWork { account: id, class, charged_ms, work, .. } = taken;
        match work {
            Work::Command(command) | Work::Prepared(command) if command.is_cancelled() => drop(command),
            // The costs of outputs are recorded when they are finished.
            Work::Command(command @ Command::Draw { .. }) | Work::Prepared(command @ Command::Draw { .. }) => {
                return self.begin_output(command, Charge::new(class, charged_ms));
            }
            Work::Command(command) | Work::Prepared(command) => self.execute(command),
            Work::Continue => {
                if let Some(mut output) = self.partial_outputs.remove(&id) {
                    self.queue.charge(id, output.take_device_ms());
                    self.continue_output(id, output);
                }
            }
        }
        self.queue.record_cost(id, class, charged_ms, ms_since(begin));
    }

    fn execute(&mut self, command: Command) {
        if let Some(error) = self.loss.error().filter(|_| !matches!(command, Command::UnloadScene { .. })) {
            return command.reply_error(error);
        }
        match command {
            Command::LoadScene { id, scene, deformer, backends, reply } => {
                let loaded_scene =
                    deformer.and_then(|deformer| self.context.load_prepared(&scene, deformer, backends.raster));
                let result = self.loss.record_loss(loaded_scene).map(|scene| self.insert_scene(id, scene, backends));
                // If the caller no longer waits, no `UnloadScene` will follow.
                if !reply.send(result) {
                    self.unload(id);
                }
            }
            Command::Deform { id, state, following, reply } => {
                // The GPU changes to the context of CUDA once for encodings and deformation.
                self.context.start_encodings();
                let Self { scenes, loss, .. } = self;
                let deformed = find_scene(scenes, id).and_then(|scene| {
                    following.iter().for_each(|following| scene.announce(following));
                    loss.record_step(scene.deform_shared(&state))
                });
                answer(reply, deformed);
            }
            Command::LoadWorlds { id, worlds, domains, prepared, reply } => {
                let loaded = prepared.and_then(|prepared| LoadedWorlds::new(&worlds, domains, prepared));
                let result = self.loss.record_loss(loaded).map(|loaded| drop(self.worlds.insert(id, loaded)));
                if !reply.send(result) {
                    self.unload(id);
                }
            }
            Command::ExportRing { id, slot_count, format, views, reply } => {
                let worlds = self.worlds.get_mut(&id).ok_or_else(|| not_loaded(id));
                let exported = worlds.and_then(|worlds| worlds.export_ring(slot_count, &format, views));
                answer(reply, self.loss.record_loss(exported).map(Arc::new));
            }
            Command::DrawViews { id, request, reply } => {
                let worlds = self.worlds.get_mut(&id).ok_or_else(|| not_loaded(id));
                let drawn = worlds.and_then(|worlds| worlds.draw(&request));
                answer(reply, self.loss.record_loss(drawn).map(Arc::new));
            }
            Command::UnloadScene { id, reply } => {
                self.unload(id);
                answer(reply, Ok(()));
            }
            Command::Pick { .. } => self.pick(command),
            Command::ReadVertices { id, attributes, reply } => self.read_vertices(id, attributes, reply),
            Command::Draw { .. } => {}
        }
    }

    fn insert_scene(&mut self, id: SceneId, scene: LoadedScene, backends: BackendSettings) {
        self.scenes.insert(id, scene);
        self.backends.insert(id, backends);
    }

    fn unload(&mut self, id: SceneId) {
        self.backends.remove(&id);
        if let Some(scene) = self.scenes.remove(&id) {
            self.context.unload_scene(scene);
        }
        if self.worlds.remove(&id).is_some() {
            self.context.wait_for_freed_memory();
        }
        self.queue.forget(id);
    }

    /// Submits a pick.
    fn pick(&mut self, command: Command) {
        let Command::Pick { id, camera, picture, rectangle, reply } = command else { return };
        let Self { context, scenes, .. } = self;
        let pending_pick = find_scene(scenes, id).and_then(|scene| {
            let camera = camera.resolve(scene.scene(), scene.current_state(), picture).camera;
            context.begin_pick(scene, &camera, picture, rectangle)
        });
        match self.loss.record_loss(pending_pick) {
            Ok(pending) => self.picks.push(InFlight { id, pending, charge: None, reply }),
            Err(error) => answer(reply, Err(error)),
        }
    }

    /// Starts a vertex readback; answers immediately if the vertices are already in host memory.
    fn read_vertices(&mut self, id: SceneId, attributes: VertexAttributes, reply: Reply<Arc<StepVertices>>) {
        let start = Instant::now();
        let readback = self.scene(id).and_then(|scene| scene.readback(attributes));
        match self.loss.record_loss(readback) {
            Ok(readback) => {
                let is_ready = readback.is_ready();
                let readback = InFlight { id, pending: PendingVertices { readback, start }, charge: None, reply };
                if is_ready { self.finish_vertices(readback) } else { self.vertices.push(readback) }
            }
            Err(error) => answer(reply, Err(error)),
        }
    }

    /// Answers one readback in flight. Waits for vertices, or for a pick if no frame is in flight. Waits for a frame
    /// for at most the poll interval, and answers nothing if the frame is not ready by then.
    fn finish_one(&mut self) {
        if !self.vertices.is_empty() {
            self.finish_oldest_vertices();
        } else if self.picks.is_oldest_ready(Duration::ZERO) {
            self.finish_oldest_pick();
        } else if self.frames.is_oldest_ready(self.poll_interval) {
            self.finish_oldest_frame();
        } else if self.frames.is_empty() {
            self.finish_oldest_pick();
        }
    }

    /// Starts to encode frames if OpenGL draws no other frame, because the next deformation may be far away.
    fn start_encodings_if_idle(&self) {
        if self.context.encodes_on_cuda()
            && self.partial_outputs.is_empty()
            && self.frames.newest().is_none_or(PendingFrame::is_drawn)
        {
            self.context.start_encodings();
        }
    }

    /// Waits for the oldest pick in flight and answers it.
    fn finish_oldest_pick(&mut self) {
        let Some(InFlight { id, pending: pick, reply, .. }) = self.picks.pop_oldest() else { return };
        self.run_caught_for(id, |this| {
            let hits = this.context.finish_pick(pick);
            answer(reply, this.loss.record_loss(hits));
        });
    }

    /// Waits for the oldest frame in flight; a copy thread then copies its pixels if necessary, and sends them.
    fn finish_oldest_frame(&mut self) {
        let Some(frame) = self.frames.pop_oldest() else { return };
        if !frame.reply.is_closed() {
            self.run_caught_for(frame.id, |this| this.finish_frame(frame));
        }
    }

    fn finish_frame(&mut self, frame: InFlight<PendingFrame, Arc<RenderedPicture>>) {
        let InFlight { id, pending, charge, reply } = frame;
        let pixels = self.context.finish_draw(pending);
        if let (Ok(pixels), Some(charge)) = (&pixels, charge) {
            // A GPU takes longer to draw a frame than the device thread takes to submit it.
            self.record_output_cost(id, charge, charge.spent_ms.max(pixels.times().drawing_ms()));
        }
        match self.loss.record_loss(pixels) {
            Ok(pixels) => self.copy_pool.spawn(move || {
                run_caught(|| answer(reply, Ok(Arc::new(RenderedPicture::from(pixels.into_shared_image())))));
            }),
            Err(error) => answer(reply, Err(error)),
        }
    }

    /// Waits for the oldest vertex readback in flight and answers it.
    fn finish_oldest_vertices(&mut self) {
        if let Some(oldest) = self.vertices.pop_oldest() {
            self.run_caught_for(oldest.id, |this| this.finish_vertices(oldest));
        }
    }

    fn finish_vertices(&mut self, readback: InFlight<PendingVertices, Arc<StepVertices>>) {
        let InFlight { id, pending: PendingVertices { readback, start }, reply, .. } = readback;
        let surface = self.scene(id).and_then(|scene| scene.wait_readback(&readback));
        let vertices = self.loss.record_loss(surface);
        answer(reply, vertices.map(|surface| Arc::new(StepVertices::new(surface, ms_since(start)))));
    }

    fn scene(&mut self, id: SceneId) -> Result<&mut LoadedScene> {
        find_scene(&mut self.scenes, id)
    }
}

#[cfg(test)]
impl DeviceLoop {
    /// Sets the time and the samples of a piece of a long output.
    pub(super) fn set_piece_limits(&mut self, target_ms: f64, max_samples: u64) {
        self.context.set_piece_limits(target_ms, max_samples);
    }

    /// The scene of the large output that is being drawn.
    pub(super) fn partial_scene(&self) -> Option<SceneId> {
        self.partial_outputs.iter().find(|(_, output)| output.is_large()).map(|(id, _)| *id)
    }
}

impl Drop for DeviceLoop {
    /// Drops all commands and outputs, so that their callers get an error, and unloads all scenes.
    fn drop(&mut self) {
        self.queue.clear();
        self.partial_outputs.clear();
        self.vertices.clear();
        self.picks.clear();
        self.frames.clear();
        let scenes: Vec<LoadedScene> = self.scenes.drain().map(|(_, scene)| scene).collect();
        for scene in scenes {
            run_caught(|| self.context.unload_scene(scene));
        }
        run_caught(|| self.worlds.clear());
    }
}

fn find_scene(scenes: &mut HashMap<SceneId, LoadedScene>, id: SceneId) -> Result<&mut LoadedScene> {
    scenes.get_mut(&id).ok_or_else(|| not_loaded(id))
}

fn not_loaded(id: SceneId) -> Error {
    fault("device", format!("scene {id} is not loaded"))
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::sync::atomic::{AtomicBool, Ordering};

    use super::super::handle::{DeviceHandle, DeviceThread};
    use super::*;
    use crate::engine::testing::{self, FaultyDeformer, InjectedFault};
    use crate::hang_guard::HANG_GUARD;
    use modalcast_model::deform::Deformer;
    use modalcast_model::scene::{Scene, SceneState};

    const FAULTY_SCENE: SceneId = 1;
    const CONTROL_SCENE: SceneId = 2;
    /// Longer than any work of these tests on a busy machine.
    const WORK_LIMIT: Duration = Duration::from_secs(600);
    const POSITIONS: VertexAttributes =
        VertexAttributes { positions: true, normals: false, displacements: false, boxes: false };

    /// Starts a device thread whose deformer injects faults, and loads two scenes.
    async fn start_with_two_scenes() -> (DeviceHandle, Arc<Scene>) {
        let open_device = || DeviceContext::with_deformer(FaultyDeformer::boxed);
        let handle = DeviceThread::start(open_device, WORK_LIMIT, WorkOwners::new(None))
            .await
            .expect("expected a device thread")
            .handle;
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
        handle.deform(id, state, None).wait().await?;
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

    /// Whether deformers of `create_when_open` wait.
    static IS_GATE_CLOSED: AtomicBool = AtomicBool::new(false);

    /// Creates a deformer when the gate is open, at the latest after [`HANG_GUARD`], so that a failed test ends.
    fn create_when_open(scene: &Arc<Scene>) -> Box<dyn Deformer + Send> {
        let limit = Instant::now() + HANG_GUARD;
        while IS_GATE_CLOSED.load(Ordering::Relaxed) && Instant::now() < limit {
            std::thread::sleep(Duration::from_millis(1));
        }
        FaultyDeformer::boxed(scene)
    }

    #[tokio::test]
    async fn scenes_are_served_while_another_deformer_is_prepared() {
        let open_device = || DeviceContext::with_deformer(create_when_open);
        let handle = DeviceThread::start(open_device, WORK_LIMIT, WorkOwners::new(None))
            .await
            .expect("expected a device thread")
            .handle;
        let scene = testing::two_strips();
        handle.load_scene(CONTROL_SCENE, &scene, BackendSettings::default()).await.expect("expected a loaded scene");
        IS_GATE_CLOSED.store(true, Ordering::Relaxed);
        let (slow_handle, slow_scene) = (handle.clone(), Arc::clone(&scene));
        let load =
            tokio::spawn(async move { slow_handle.load_scene(3, &slow_scene, BackendSettings::default()).await });
        let state = state_with_q(&scene, 0.5);
        let served = deform_and_read(&handle, CONTROL_SCENE, &state);
        tokio::time::timeout(HANG_GUARD, served)
            .await
            .expect("expected no wait for the other scene")
            .expect("expected positions");
        assert!(!load.is_finished(), "control: expected a load that waits");
        IS_GATE_CLOSED.store(false, Ordering::Relaxed);
        load.await.expect("expected no panic").expect("expected a loaded scene");
        deform_and_read(&handle, 3, &state).await.expect("expected positions of the loaded scene");
    }

    #[tokio::test]
    async fn scenes_keep_their_states_after_loss_of_renderer() {
        check_recovery(InjectedFault::RendererLost, testing::renderer_lost_error()).await;
    }

    #[tokio::test]
    async fn scenes_keep_their_states_after_failed_step() {
        check_recovery(InjectedFault::Fault, testing::fault_error()).await;
    }

    /// Checks that a step with the fault fails, and that the state of no scene changes.
    async fn check_recovery(fault: InjectedFault, expected_error: Error) {
        let (handle, scene) = start_with_two_scenes().await;
        let [state, other_state] = [0.5, 0.25].map(|q| state_with_q(&scene, q));
        let expected = deform_and_read(&handle, FAULTY_SCENE, &state).await.expect("expected positions");
        let other_expected = deform_and_read(&handle, CONTROL_SCENE, &other_state).await.expect("expected positions");
        assert_ne!(expected, other_expected, "control: expected states with different positions");
        let mut loss = handle.loss().clone();
        let faulty_state = state_with_q(&scene, fault.q());
        let error = deform_and_read(&handle, FAULTY_SCENE, &faulty_state).await;
        assert_eq!(error, Err(expected_error));
        loss.changed().await;
        for (id, expected) in [(FAULTY_SCENE, &expected), (CONTROL_SCENE, &other_expected)] {
            let vertices = handle.read_vertices(id, POSITIONS).wait().await.expect("expected vertices");
            assert_eq!(&vertices.surface.positions, expected, "scene {id}: expected the state before the loss");
        }
        assert!(loss.is_working());
        assert_eq!(handle.loss().error(), None);
        assert_eq!(deform_and_read(&handle, FAULTY_SCENE, &other_state).await, Ok(other_expected));
    }

    #[tokio::test]
    async fn too_many_recoveries_are_a_lost_device() {
        for fault in [InjectedFault::RendererLost, InjectedFault::Fault] {
            let (handle, scene) = start_with_two_scenes().await;
            let faulty_state = state_with_q(&scene, fault.q());
            let mut failures = 0;
            while handle.loss().error().is_none() {
                deform_and_read(&handle, FAULTY_SCENE, &faulty_state).await.expect_err("expected the fault");
                failures += 1;
                assert!(failures < 10, "{fault:?}: expected a limit on the number of recoveries");
            }
            assert!(failures > 1, "{fault:?}: expected a recovery from the first one");
        }
    }

    #[tokio::test]
    async fn device_that_does_not_answer_is_lost() {
        let open_device = || DeviceContext::with_deformer(FaultyDeformer::boxed);
        let limit = Duration::from_secs(5);
        let handle = DeviceThread::start(open_device, limit, WorkOwners::new(None))
            .await
            .expect("expected a device thread")
            .handle;
        let scene = testing::two_strips();
        handle.load_scene(FAULTY_SCENE, &scene, BackendSettings::default()).await.expect("expected a loaded scene");
        let faulty_state = state_with_q(&scene, InjectedFault::Endless.q());
        let error = deform_and_read(&handle, FAULTY_SCENE, &faulty_state).await.expect_err("expected the loss");
        assert!(matches!(error, Error::DeviceLost { stage: "device", .. }), "{error}");
        // The thread never answers this command.
        let error = handle.read_vertices(FAULTY_SCENE, POSITIONS).wait().await.expect_err("expected the loss");
        assert!(matches!(error, Error::DeviceLost { .. }), "{error}");
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
