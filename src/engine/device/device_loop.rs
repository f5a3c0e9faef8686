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

use super::command::{Command, Reply, SceneId, TimedVertices};
use super::context::{DeviceContext, EngineInfo, PendingDraw};
use super::loaded_scene::LoadedScene;
use crate::telemetry::ms_since;
use modalcast_model::deform::{VertexAttributes, VertexReadback};
use modalcast_model::error::{Result, fault_in};
use modalcast_model::scene::{Camera, FrameSize};
use modalcast_render::{FrameImage, MAX_FRAMES_IN_FLIGHT, PendingPick, PickHit};

/// How long the thread waits for a frame before it polls the command queue again.
const POLL_INTERVAL: Duration = Duration::from_micros(100);
/// Threads that copy pixels.
const COPY_THREADS: usize = 2;

/// State owned by the device thread: the device context, the loaded scenes and the readbacks in flight.
pub(in crate::engine) struct DeviceLoop {
    device_context: DeviceContext,
    copy_pool: ThreadPool,
    scenes: HashMap<SceneId, LoadedScene>,
    /// Vertex readbacks in flight, oldest first.
    pending_vertices: VecDeque<PendingVertices>,
    /// Picks in flight, oldest first.
    picks: VecDeque<(PendingPick, Reply<Vec<PickHit>>)>,
    /// Frames in flight, oldest first; at most [`MAX_FRAMES_IN_FLIGHT`].
    frames: VecDeque<(PendingDraw, Reply<FrameImage>)>,
}

/// A vertex readback in flight.
struct PendingVertices {
    id: SceneId,
    readback: VertexReadback,
    begin: Instant,
    reply: Reply<TimedVertices>,
}

/// Executes commands until `Quit` arrives or every sender is dropped.
pub(in crate::engine) fn run_device_loop(mut device_loop: DeviceLoop, mut inbox: mpsc::Receiver<Command>) {
    while let Some(command) = next(&mut device_loop, &mut inbox) {
        if matches!(command, Command::Quit) {
            break;
        }
        // Wait for readbacks that were started before this command. Readbacks that it starts overlap with the next one.
        let pending_vertices = device_loop.pending_vertices.len();
        catch_panic(|| device_loop.execute(command));
        for _ in 0..pending_vertices {
            catch_panic(|| device_loop.finish_oldest_vertices());
        }
        while device_loop.picks.front().is_some_and(|(pick, _)| pick.is_ready()) {
            catch_panic(|| device_loop.finish_oldest_pick());
        }
        while device_loop.frames.front().is_some_and(|(drawing, _)| drawing.is_ready_within(Duration::ZERO)) {
            catch_panic(|| device_loop.finish_oldest_frame());
        }
    }
    device_loop.pending_vertices.clear();
    device_loop.picks.clear();
    device_loop.frames.clear();
    for (_, loaded_scene) in device_loop.scenes.drain() {
        device_loop.device_context.unload_scene(loaded_scene);
    }
}

/// The next command. While the queue is empty, waits for readbacks in flight and answers them.
fn next(device_loop: &mut DeviceLoop, inbox: &mut mpsc::Receiver<Command>) -> Option<Command> {
    while !(device_loop.pending_vertices.is_empty() && device_loop.picks.is_empty() && device_loop.frames.is_empty()) {
        match inbox.try_recv() {
            Ok(command) => return Some(command),
            Err(_) => catch_panic(|| device_loop.poll_pending()),
        }
    }
    inbox.blocking_recv()
}

/// Catches a panic of one command. The panicking command drops its reply channel, so its caller gets an error; the
/// thread continues with the next command.
fn catch_panic(act: impl FnOnce()) {
    if catch_unwind(AssertUnwindSafe(act)).is_err() {
        tracing::error!("a command panicked on the device thread");
    }
}

impl DeviceLoop {
    /// Starts the threads that copy pixels.
    ///
    /// # Errors
    /// `Fault` when the threads cannot be started.
    pub(in crate::engine) fn new(device_context: DeviceContext) -> Result<Self> {
        let copy_pool =
            ThreadPoolBuilder::new().num_threads(COPY_THREADS).thread_name(|index| format!("pixels {index}"));
        let copy_pool = copy_pool.build().map_err(fault_in("threads that copy pixels"))?;
        let (pending_vertices, picks, frames) = (VecDeque::new(), VecDeque::new(), VecDeque::new());
        Ok(Self { device_context, copy_pool, scenes: HashMap::new(), pending_vertices, picks, frames })
    }

    /// The backend that deforms and the renderer that draws.
    pub(in crate::engine) const fn info(&self) -> &EngineInfo {
        self.device_context.info()
    }

    fn execute(&mut self, command: Command) {
        let Self { device_context, scenes, .. } = self;
        // A failed send below means that the caller no longer waits; its reply is dropped.
        match command {
            Command::LoadScene { id, scene, backends, reply } => {
                let loaded_scene =
                    device_context.load_scene(&scene, backends).map(|loaded_scene| scenes.insert(id, loaded_scene));
                // The caller has gone, so no `UnloadScene` would ever follow.
                if reply.send(loaded_scene.map(|_| ())).is_err()
                    && let Some(loaded_scene) = scenes.remove(&id)
                {
                    device_context.unload_scene(loaded_scene);
                }
            }
            Command::Deform { id, state, reply } => {
                reply.send(find(scenes, id).and_then(|loaded_scene| loaded_scene.deform_shared(&state))).ok();
            }
            Command::Draw { id, camera, size, reply } if !reply.is_closed() => self.draw(id, camera, size, reply),
            Command::RenderAov { id, camera, size, frame_output, reply } if !reply.is_closed() => {
                reply
                    .send(
                        find(scenes, id).and_then(|loaded_scene| {
                            device_context.render_aov(loaded_scene, &camera, size, frame_output)
                        }),
                    )
                    .ok();
            }
            Command::Pick { id, camera, picture, rectangle, reply } if !reply.is_closed() => {
                let pick = |loaded_scene| device_context.begin_pick(loaded_scene, &camera, picture, rectangle);
                match find(scenes, id).and_then(pick) {
                    Ok(pick) => self.picks.push_back((pick, reply)),
                    Err(error) => {
                        reply.send(Err(error)).ok();
                    }
                }
            }
            Command::ReadVertices { id, wanted, reply } if !reply.is_closed() => {
                self.begin_vertex_readback(id, wanted, reply)
            }
            // The caller no longer waits, so the work is skipped.
            Command::Draw { .. }
            | Command::RenderAov { .. }
            | Command::Pick { .. }
            | Command::ReadVertices { .. }
            | Command::Quit => {}
            Command::UnloadScene { id, reply } => {
                if let Some(loaded_scene) = scenes.remove(&id) {
                    device_context.unload_scene(loaded_scene);
                }
                reply.send(Ok(())).ok();
            }
        }
    }

    /// Submits a frame. Waits for the oldest frame first if the ring is full.
    fn draw(&mut self, id: SceneId, camera: Camera, size: FrameSize, reply: Reply<FrameImage>) {
        while self.frames.len() >= MAX_FRAMES_IN_FLIGHT {
            self.finish_oldest_frame();
        }
        let device_context = &mut self.device_context;
        let drawing =
            find(&mut self.scenes, id).and_then(|loaded_scene| device_context.begin_draw(loaded_scene, &camera, size));
        match drawing {
            Ok(drawing) => self.frames.push_back((drawing, reply)),
            Err(error) => {
                reply.send(Err(error)).ok(); // Fails only if the caller no longer waits.
            }
        }
    }

    /// Starts a vertex readback; answers immediately if the vertices are already in host memory.
    fn begin_vertex_readback(&mut self, id: SceneId, wanted: VertexAttributes, reply: Reply<TimedVertices>) {
        let begin = Instant::now();
        match find(&mut self.scenes, id).and_then(|loaded_scene| loaded_scene.readback(wanted)) {
            Ok(readback) => {
                let is_ready = readback.is_ready();
                self.pending_vertices.push_back(PendingVertices { id, readback, begin, reply });
                if is_ready {
                    self.pending_vertices.rotate_right(1);
                    self.finish_oldest_vertices();
                }
            }
            Err(error) => {
                reply.send(Err(error)).ok(); // As above.
            }
        }
    }

    /// Answers one readback in flight, or waits for a frame for at most [`POLL_INTERVAL`].
    fn poll_pending(&mut self) {
        if !self.pending_vertices.is_empty() {
            return self.finish_oldest_vertices();
        }
        match (self.picks.front(), self.frames.front()) {
            (Some((pick, _)), _) if pick.is_ready() => self.finish_oldest_pick(),
            (_, Some((drawing, _))) if drawing.is_ready_within(POLL_INTERVAL) => self.finish_oldest_frame(),
            (Some(_), None) => self.finish_oldest_pick(),
            _ => {}
        }
    }

    /// Waits for the oldest pick in flight and answers it.
    fn finish_oldest_pick(&mut self) {
        let Some((pick, reply)) = self.picks.pop_front() else { return };
        reply.send(self.device_context.finish_pick(pick)).ok(); // As above.
    }

    /// Waits for the oldest frame in flight; a copy thread then copies and sends its pixels.
    fn finish_oldest_frame(&mut self) {
        let Some((drawing, reply)) = self.frames.pop_front() else { return };
        if reply.is_closed() {
            return; // The caller no longer waits.
        }
        match self.device_context.finish_draw(drawing) {
            Ok(pixels) => self.copy_pool.spawn(move || {
                catch_panic(|| {
                    reply.send(Ok(pixels.into_image())).ok(); // As above.
                });
            }),
            Err(error) => {
                reply.send(Err(error)).ok(); // As above.
            }
        }
    }

    /// Waits for the oldest vertex readback in flight and answers it.
    fn finish_oldest_vertices(&mut self) {
        let Some(PendingVertices { id, readback, begin, reply }) = self.pending_vertices.pop_front() else { return };
        let surface = find(&mut self.scenes, id).and_then(|loaded_scene| loaded_scene.wait_readback(&readback));
        reply.send(surface.map(|surface| (surface, ms_since(begin)))).ok(); // As above.
    }
}

fn find(scenes: &mut HashMap<SceneId, LoadedScene>, id: SceneId) -> Result<&mut LoadedScene> {
    scenes.get_mut(&id).ok_or_else(|| fault_in("device")(format!("scene {id} is not staged")))
}
