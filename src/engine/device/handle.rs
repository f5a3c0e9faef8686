//! Handle to the device thread. The thread receives commands (`command`) from a bounded queue, owns the device context
//! and every loaded scene (`device_loop`), and answers each command at most once. Vertices, picks and frames are
//! answered asynchronously: their readback overlaps with the commands after them.

use std::sync::Arc;

use tokio::sync::mpsc::error::TrySendError;
use tokio::sync::{mpsc, oneshot};

use super::command::{Command, CopiedVertices, Reply, SceneId};
use super::context::{DeviceContext, EngineInfo};
use super::device_loop::DeviceLoop;
use super::device_loss::{DeviceLoss, device_loss_channel};
use crate::engine::output::step_output::FrameOutput;
use crate::frame::Legend;
use modalcast_model::backend_settings::BackendSettings;
use modalcast_model::deform::{DeformSummary, VertexAttributes};
use modalcast_model::error::{Error, Result, fault, fault_in};
use modalcast_model::scene::{Camera, FrameSize, PixelRect, Scene, SceneState};
use modalcast_render::{AovImage, FrameImage, MAX_FRAMES_IN_FLIGHT, PickHit};

/// Sends commands to the device thread. The thread ends when the last clone is dropped.
#[derive(Debug, Clone)]
pub(in crate::engine) struct DeviceHandle {
    commands: mpsc::Sender<Command>,
    /// Capacity of the command queue, for errors.
    capacity: usize,
    loss: DeviceLoss,
}

/// A running device thread.
pub(in crate::engine) struct DeviceThread {
    pub handle: DeviceHandle,
    pub info: EngineInfo,
    pub thread: std::thread::JoinHandle<()>,
}

impl DeviceThread {
    /// Starts the thread for up to `open_scenes` scenes. Returns when `open_device` has opened the devices.
    ///
    /// # Errors
    /// The errors of `open_device`; `Fault` when a thread cannot be started.
    pub(in crate::engine) async fn start(
        open_scenes: usize,
        open_device: impl FnOnce() -> Result<DeviceContext> + Send + 'static,
    ) -> Result<Self> {
        // A scene queues at most MAX_FRAMES_IN_FLIGHT frames and 3 other commands: a vertex readback, the next step and
        // the command that loads the scene. 8 further commands are a reserve. So the queue is full only if more than
        // `open_scenes` scenes use the device.
        let capacity = (3 + MAX_FRAMES_IN_FLIGHT) * open_scenes + 8;
        let (commands, inbox) = mpsc::channel(capacity);
        let (info_sender, info_receiver) = oneshot::channel();
        let (loss_sender, loss) = device_loss_channel();
        let thread = std::thread::Builder::new()
            .name("device".into())
            .spawn(move || match open_device().and_then(|context| DeviceLoop::new(context, loss_sender)) {
                Ok(device_loop) => {
                    // Fails only if the caller no longer waits. The queue is then closed and `run` returns.
                    info_sender.send(Ok(device_loop.info().clone())).ok();
                    device_loop.run(inbox);
                }
                Err(error) => {
                    info_sender.send(Err(error)).ok(); // Fails only if the caller no longer waits.
                }
            })
            .map_err(fault_in("device thread"))?;
        let info = info_receiver.await.map_err(|_| no_answer_error())??;
        Ok(Self { handle: DeviceHandle { commands, capacity, loss }, info, thread })
    }
}

impl DeviceHandle {
    /// A handle for tests that answer the commands themselves, and the receiver of the commands.
    #[cfg(test)]
    pub(in crate::engine) fn mock() -> (Self, mpsc::Receiver<Command>) {
        let (commands, inbox) = mpsc::channel(16);
        (Self { commands, capacity: 16, loss: device_loss_channel().1 }, inbox)
    }

    /// The observer of a device loss.
    pub(in crate::engine) const fn loss(&self) -> &DeviceLoss {
        &self.loss
    }

    pub(in crate::engine) async fn load_scene(
        &self,
        id: SceneId,
        scene: &Arc<Scene>,
        backends: BackendSettings,
    ) -> Result<()> {
        let scene = Arc::clone(scene);
        self.call(|reply| Command::LoadScene { id, scene, backends, reply }).await
    }

    /// Starts deforming a scene to a state.
    pub(in crate::engine) fn deform(&self, id: SceneId, state: &Arc<SceneState>) -> PendingReply<DeformSummary> {
        let state = Arc::clone(state);
        self.submit(|reply| Command::Deform { id, state, reply })
    }

    /// Starts drawing the last deformation. Later commands do not affect the frame.
    pub(in crate::engine) fn begin_draw(
        &self,
        id: SceneId,
        camera: Camera,
        size: FrameSize,
    ) -> PendingReply<FrameImage> {
        self.submit(|reply| Command::Draw { id, camera, size, reply })
    }

    pub(in crate::engine) async fn render_aov(
        &self,
        id: SceneId,
        camera: Camera,
        size: FrameSize,
        frame_output: FrameOutput,
    ) -> Result<(AovImage, Option<Legend>)> {
        self.call(|reply| Command::RenderAov { id, camera, size, frame_output, reply }).await
    }

    pub(in crate::engine) async fn pick(
        &self,
        id: SceneId,
        camera: Camera,
        picture: FrameSize,
        rectangle: PixelRect,
    ) -> Result<Vec<PickHit>> {
        self.call(|reply| Command::Pick { id, camera, picture, rectangle, reply }).await
    }

    /// Starts copying attributes of the last deformation. Later commands do not affect the copy.
    pub(in crate::engine) fn read_vertices(
        &self,
        id: SceneId,
        attributes: VertexAttributes,
    ) -> PendingReply<CopiedVertices> {
        self.submit(|reply| Command::ReadVertices { id, attributes, reply })
    }

    /// Unloads a scene. Waits for queue capacity, so that a full queue never leaves a scene on the device.
    pub(in crate::engine) async fn unload_scene(&self, id: SceneId) -> Result<()> {
        let (reply, answer) = oneshot::channel();
        self.commands.send(Command::UnloadScene { id, reply }).await.map_err(|_| no_answer_error())?;
        answer.await.map_err(|_| no_answer_error())?
    }

    /// Ends the thread after the commands already queued. Blocks until the queue has capacity, so it must not be called
    /// on a runtime thread.
    pub(in crate::engine) fn quit(&self) {
        // A closed queue means that the thread has ended.
        self.commands.blocking_send(Command::Quit).ok();
    }

    async fn call<T>(&self, create_command: impl FnOnce(Reply<T>) -> Command) -> Result<T> {
        self.submit(create_command).wait().await
    }

    /// Sends a command; the caller awaits the answer later.
    fn submit<T>(&self, create_command: impl FnOnce(Reply<T>) -> Command) -> PendingReply<T> {
        let (reply, answer) = oneshot::channel();
        PendingReply(match self.commands.try_send(create_command(reply)) {
            Ok(()) => Ok(answer),
            Err(TrySendError::Full(_)) => Err(Error::Busy { queue: "device", limit: self.capacity }),
            Err(TrySendError::Closed(_)) => Err(no_answer_error()),
        })
    }
}

/// The pending answer to a command that was sent to the device thread.
#[derive(Debug)]
pub(in crate::engine) struct PendingReply<T>(Result<oneshot::Receiver<Result<T>>>);

impl<T> PendingReply<T> {
    pub(in crate::engine) async fn wait(mut self) -> Result<T> {
        self.recv().await
    }

    /// [`Self::wait`], but cancel-safe. Must not be called again after it has returned.
    pub(in crate::engine) async fn recv(&mut self) -> Result<T> {
        match &mut self.0 {
            Ok(answer) => answer.await.map_err(|_| no_answer_error())?,
            Err(error) => Err(error.clone()),
        }
    }
}

/// The error for a dropped reply channel.
fn no_answer_error() -> Error {
    fault("device", "the command panicked or the device thread has ended")
}
