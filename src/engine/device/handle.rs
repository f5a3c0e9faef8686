//! Handle to the device thread. The thread takes commands (`command`) from a bounded queue of each scene
//! (`command_queue`), owns the device context and every loaded scene (`device_loop`), and answers each command at most
//! once. Vertices, picks and frames are answered asynchronously: their readback overlaps with the commands after them.

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::{oneshot, watch};

use super::command::{Command, CommandEnd, Reply, SceneId};
use super::command_queue::{CancelGuard, CommandQueue};
use super::context::{DeformerPreparer, DeviceContext, EngineInfo};
use super::device_loop::DeviceLoop;
use super::device_loss::{DeviceLoss, device_loss_channel};
use super::loaded_worlds::{DrawnViews, ExportedSlots, PreparedWorlds, ViewRequest};
use super::watchdog::{self, WorkClock};
use super::work_owners::WorkOwners;
use crate::engine::blocking::run_blocking;
use crate::engine::output::output_spec::{PictureContent, PictureSpec};
use crate::engine::output::rendered_picture::RenderedPicture;
use crate::engine::output::step_vertices::StepVertices;
use modalcast_model::backend_settings::BackendSettings;
use modalcast_model::deform::{DeformSummary, VertexAttributes};
use modalcast_model::error::{Error, Result, fault, fault_in};
use modalcast_model::scene::{CameraSource, FrameSize, PixelRect, Scene, SceneState};
use modalcast_model::views::{ViewFormat, ViewScene};
use modalcast_render::PickHit;

/// Sends commands to the device thread. The thread ends when the last clone is dropped.
#[derive(Debug, Clone)]
pub(in crate::engine) struct DeviceHandle {
    commands: Arc<CommandSender>,
    loss: DeviceLoss,
    preparer: DeformerPreparer,
    owners: Arc<WorkOwners>,
}

/// Closes the queue when the last handle is dropped.
#[derive(Debug)]
struct CommandSender(Arc<CommandQueue>);

impl Drop for CommandSender {
    fn drop(&mut self) {
        self.0.close();
    }
}

/// A running device thread.
pub(in crate::engine) struct DeviceThread {
    pub handle: DeviceHandle,
    pub info: EngineInfo,
    pub thread: std::thread::JoinHandle<()>,
}

impl DeviceThread {
    /// Starts the thread. Returns when `open_device` has opened the devices. The device is lost when one piece of work
    /// takes longer than `work_limit`. `owners` records the scene of this work.
    ///
    /// # Errors
    /// The errors of `open_device`; `Fault` when a thread cannot be started.
    pub(in crate::engine) async fn start(
        open_device: impl FnOnce() -> Result<DeviceContext> + Send + 'static,
        work_limit: Duration,
        owners: Arc<WorkOwners>,
    ) -> Result<Self> {
        let queue = CommandQueue::new();
        let commands = Arc::new(CommandSender(Arc::clone(&queue)));
        let (info_sender, info_receiver) = oneshot::channel();
        let (loss_sender, loss) = device_loss_channel();
        let clock = WorkClock::new();
        watchdog::start(&clock, work_limit, loss_sender.clone(), Arc::clone(&owners))?;
        let loop_owners = Arc::clone(&owners);
        let thread = std::thread::Builder::new()
            .name("device".into())
            .spawn(move || {
                match open_device().and_then(|context| DeviceLoop::new(context, loss_sender, queue, clock, loop_owners))
                {
                    Ok(device_loop) => {
                        // Fails only if the caller no longer waits. The queue is then closed and `run` returns.
                        info_sender.send(Ok((device_loop.info().clone(), device_loop.deformer_preparer()))).ok();
                        device_loop.run();
                    }
                    Err(error) => {
                        info_sender.send(Err(error)).ok(); // Fails only if the caller no longer waits.
                    }
                }
            })
            .map_err(fault_in("device thread"))?;
        let (info, preparer) = info_receiver.await.map_err(|_| no_answer_error())??;
        Ok(Self { handle: DeviceHandle { commands, loss, preparer, owners }, info, thread })
    }
}

impl DeviceHandle {
    /// A handle for tests that answer the commands themselves, and the receiver of the commands.
    #[cfg(test)]
    pub(in crate::engine) fn mock() -> (Self, tokio::sync::mpsc::Receiver<Command>) {
        use super::command_queue::Work;
        let queue = CommandQueue::new();
        let (sender, inbox) = tokio::sync::mpsc::channel(16);
        let handle = Self {
            commands: Arc::new(CommandSender(Arc::clone(&queue))),
            loss: device_loss_channel().1,
            preparer: DeformerPreparer::reference(),
            owners: WorkOwners::new(None),
        };
        // Ends when the handle or the receiver is dropped.
        std::thread::spawn(move || {
            while queue.wait(None) {
                let Some(taken) = queue.take(|_, _| true) else { continue };
                let (Work::Command(command) | Work::Prepared(command)) = taken.work else { continue };
                if sender.blocking_send(command).is_err() {
                    return queue.clear();
                }
            }
        });
        (handle, inbox)
    }

    /// A handle for tests that run the device loop themselves.
    #[cfg(test)]
    pub(super) fn of_queue(queue: &Arc<CommandQueue>, loss: DeviceLoss) -> Self {
        let (commands, preparer) = (Arc::new(CommandSender(Arc::clone(queue))), DeformerPreparer::reference());
        Self { commands, loss, preparer, owners: WorkOwners::new(None) }
    }

    /// The observer of a device loss.
    pub(in crate::engine) const fn loss(&self) -> &DeviceLoss {
        &self.loss
    }

    /// Names a scene that will be loaded, so that the crash log can name it.
    pub(in crate::engine) fn name_scene(&self, id: SceneId, name: &str) {
        self.owners.insert(id, name);
    }

    /// Prepares the deformer of a scene on another thread, and then loads the scene on the device thread.
    pub(in crate::engine) async fn load_scene(
        &self,
        id: SceneId,
        scene: &Arc<Scene>,
        backends: BackendSettings,
    ) -> Result<()> {
        let (preparer, prepared_scene) = (self.preparer.clone(), Arc::clone(scene));
        let owners = Arc::clone(&self.owners);
        let prepare = move || owners.run(id, || preparer.prepare(&prepared_scene, backends.batches));
        let deformer = run_blocking("load", prepare).await;
        let scene = Arc::clone(scene);
        let loaded = self.call(|reply| Command::LoadScene { id, scene, deformer, backends, reply }).await;
        if loaded.is_err() {
            self.owners.remove(id);
        }
        loaded
    }

    /// Prepares worlds on another thread, and then loads them on the device thread. `domains`: number of domains of one
    /// world. `views`: the static data of their views.
    pub(in crate::engine) async fn load_worlds(
        &self,
        id: SceneId,
        worlds: &Arc<Scene>,
        domains: usize,
        views: ViewScene,
    ) -> Result<()> {
        let (preparer, prepared_worlds, owners) = (self.preparer.clone(), Arc::clone(worlds), Arc::clone(&self.owners));
        let prepare = move || owners.run(id, || PreparedWorlds::new(&preparer, &prepared_worlds, views));
        let prepared = run_blocking("load", prepare).await;
        let worlds = Arc::clone(worlds);
        self.call(|reply| Command::LoadWorlds { id, worlds, domains, prepared, reply }).await
    }

    /// Allocates exported device memory for the views of worlds.
    pub(in crate::engine) async fn export_ring(
        &self,
        id: SceneId,
        slot_count: usize,
        format: ViewFormat,
        views: usize,
    ) -> Result<Arc<ExportedSlots>> {
        self.call(|reply| Command::ExportRing { id, slot_count, format, views, reply }).await
    }

    /// Starts deforming worlds and drawing views of them.
    pub(in crate::engine) fn draw_views(&self, id: SceneId, request: ViewRequest) -> PendingReply<Arc<DrawnViews>> {
        self.submit(|reply| Command::DrawViews { id, request, reply })
    }

    /// Starts deforming a scene to a state. `following` is the state that the writer has already sent after it.
    pub(in crate::engine) fn deform(
        &self,
        id: SceneId,
        state: &Arc<SceneState>,
        following: Option<Arc<SceneState>>,
    ) -> PendingReply<DeformSummary> {
        let state = Arc::clone(state);
        self.submit(|reply| Command::Deform { id, state, following, reply })
    }

    /// Starts drawing a picture of the last deformation. Later commands do not affect it.
    pub(in crate::engine) fn draw(
        &self,
        id: SceneId,
        picture: PictureSpec,
        content: PictureContent,
    ) -> PendingReply<Arc<RenderedPicture>> {
        self.submit(|reply| Command::Draw { id, picture, content, reply })
    }

    /// Starts finding the surface points of the last deformation at the pixels of a rectangle.
    pub(in crate::engine) fn pick(
        &self,
        id: SceneId,
        camera: CameraSource,
        picture: FrameSize,
        rectangle: PixelRect,
    ) -> PendingReply<Vec<PickHit>> {
        self.submit(|reply| Command::Pick { id, camera, picture, rectangle, reply })
    }

    /// Starts copying attributes of the last deformation. Later commands do not affect the copy.
    pub(in crate::engine) fn read_vertices(
        &self,
        id: SceneId,
        attributes: VertexAttributes,
    ) -> PendingReply<Arc<StepVertices>> {
        self.submit(|reply| Command::ReadVertices { id, attributes, reply })
    }

    /// Unloads a scene or worlds. A full queue accepts this command, too.
    pub(in crate::engine) async fn unload_scene(&self, id: SceneId) -> Result<()> {
        let unloaded = self.call(|reply| Command::UnloadScene { id, reply }).await;
        self.owners.remove(id);
        match unloaded {
            // The end of the process frees the memory of a lost device.
            Err(Error::DeviceLost { .. }) => Ok(()),
            result => result,
        }
    }

    /// Ends the thread after the commands already queued.
    pub(in crate::engine) fn quit(&self) {
        self.commands.0.close();
    }

    async fn call<T: Clone>(&self, create_command: impl FnOnce(Reply<T>) -> Command) -> Result<T> {
        self.submit(create_command).wait().await
    }

    /// Sends a command; the caller awaits the answer later.
    fn submit<T>(&self, create_command: impl FnOnce(Reply<T>) -> Command) -> PendingReply<T> {
        let (reply, answer, end) = Reply::channel();
        let loss = self.loss.clone();
        match self.commands.0.push(create_command(reply)) {
            Ok(cancel_guard) => PendingReply { answer: Ok(answer), end: Some(end), loss, _cancel_guard: cancel_guard },
            Err(error) => {
                let answer = Err(error.unwrap_or_else(no_answer_error));
                PendingReply { answer, end: None, loss, _cancel_guard: None }
            }
        }
    }
}

/// The pending answer to a command that was sent to the device thread. Readers can share it. Dropping it cancels the
/// command, unless the command changes the scene. A queued command then leaves the queue at once, and a frame that is
/// being drawn ends after its present pass.
#[derive(Debug)]
pub struct PendingReply<T> {
    // Dropped before the guard, so that the device thread sees the cancellation if it has just taken the command.
    answer: Result<watch::Receiver<Option<Result<T>>>>,
    /// `None` if the command was rejected, or if the end was taken.
    end: Option<CommandEnd>,
    loss: DeviceLoss,
    _cancel_guard: Option<CancelGuard>,
}

impl<T: Clone> PendingReply<T> {
    /// An answer that is already there.
    #[cfg(test)]
    pub(in crate::engine) fn answered(answer: T) -> Self {
        let (_, receiver) = watch::channel(Some(Ok(answer)));
        Self { answer: Ok(receiver), end: None, loss: device_loss_channel().1, _cancel_guard: None }
    }

    /// Takes the end of the command, with which one can wait for the command without its answer.
    pub(in crate::engine) const fn take_end(&mut self) -> Option<CommandEnd> {
        self.end.take()
    }

    /// Whether the answer is an error, or never comes.
    pub(in crate::engine) fn has_failed(&self) -> bool {
        self.answer.as_ref().map_or(true, |receiver| match &*receiver.borrow() {
            Some(answer) => answer.is_err(),
            None => receiver.has_changed().is_err(),
        })
    }

    /// Waits for the answer. Cancel-safe.
    ///
    /// # Errors
    /// The error of the command; `Busy` if the queue has rejected it; `DeviceLost`.
    pub async fn wait(&self) -> Result<T> {
        let mut receiver = self.answer.clone()?;
        let answer = async { receiver.wait_for(Option::is_some).await.ok().and_then(|answer| answer.clone()) };
        tokio::select! {
            biased;
            answer = answer => answer.unwrap_or_else(|| Err(no_answer_error())),
            // A device thread in a call that does not return answers no command.
            error = self.loss.wait() => Err(error),
        }
    }
}

/// The error for a dropped reply channel.
fn no_answer_error() -> Error {
    fault("device", "the command panicked or the device thread has ended")
}
