//! Handle to one open scene: the immutable description of the scene, and a sender to the bounded mailbox of its task.

use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};

use tokio::sync::mpsc::error::TrySendError;
use tokio::sync::{Notify, OnceCell, mpsc, oneshot, watch};

use super::actor::{ActorParams, SceneActor, SceneServices};
use super::current_writer::{CurrentWriter, CurrentWriterEntry};
use super::delivery::{Delivery, StreamDelivery};
use super::forces::{ForceChannel, ForceReceipt, ForceUpdate};
use super::lease::{AcquiredLease, InitialState, LeaseRequest, LeaseToken, WriterLease};
use super::message::{Message, StepRequest, StepSelector};
use super::step_queue::{Overflow, QueuedStep, StepReport};
use super::subscriber::Subscription;
use crate::admission::{Account, Limit, PermitPool};
use crate::engine::blocking::run_blocking;
use crate::engine::content::ContentHashes;
use crate::engine::device::command::SceneId;
use crate::engine::output::output_spec::OutputSpec;
use crate::engine::output::step_output::{StepId, StepOutput};
use crate::engine::scene_memory::SceneMemory;
use crate::engine::scene_not_open;
use crate::engine::storage::checkpoint_store::SceneCheckpoints;
use crate::engine::storage::provenance::SceneProvenance;
use crate::engine::storage::scene_record::{SceneAccess, SceneRight, SharedAccess};
use crate::identity::Principal;
use crate::telemetry::ms_since;
use modalcast_model::backend_settings::BackendSettings;
use modalcast_model::error::{Error, Result, invalid};
use modalcast_model::scene::{RawStepUpdate, Scene, SceneState, StepUpdate};

/// Bytes of a step up to which the network's thread validates it itself.
const INLINE_STEP_BYTES: usize = 128 << 10;

/// Capacity of a scene's mailbox in messages.
const MAILBOX_CAPACITY: usize = 128;

/// Handle to an open scene.
#[derive(Debug)]
pub struct SceneHandle {
    pub name: String,
    pub provenance: SceneProvenance,
    access: SharedAccess,
    pub scene: Arc<Scene>,
    id: SceneId,
    /// The reason why no frame can be drawn. `None` if frames can be drawn.
    frames_unavailable: Option<Error>,
    /// Limit on the steps that a writer may leave unacknowledged.
    max_window: u32,
    mailbox: mpsc::Sender<Message>,
    /// The state of the last completed step, or the rest state.
    current_state: watch::Receiver<Arc<SceneState>>,
    subscriptions: PermitPool,
    waiting_requests: PermitPool,
    writer: CurrentWriter,
    /// Created when forces are applied or read for the first time.
    forces: OnceLock<Arc<ForceChannel>>,
    /// Wakes the actor when a subscription grants a credit, which permits one more result, or is dropped.
    wake: Arc<Notify>,
    /// The error of [`Self::stop`], if it was called.
    stop_error: OnceLock<Error>,
    /// The error with which the scene has failed.
    failure: Arc<OnceLock<Error>>,
    /// Computed when a client first asks for them.
    content_hashes: OnceCell<Arc<ContentHashes>>,
    checkpoints: SceneCheckpoints,
}

/// Arguments of [`SceneHandle::open`].
pub(in crate::engine) struct OpenParams {
    pub name: String,
    pub provenance: SceneProvenance,
    pub access: SharedAccess,
    pub scene: Arc<Scene>,
    pub backends: BackendSettings,
    pub id: SceneId,
    /// Called when the scene has failed.
    pub on_failure: Box<dyn FnOnce() + Send>,
    /// The state restored from a checkpoint, if there is one.
    pub state: Option<SceneState>,
    pub frames_unavailable: Option<Error>,
    /// Reserved until the device has unloaded the scene.
    pub memory: SceneMemory,
}

impl SceneHandle {
    /// Loads a scene onto the device, restores its state and starts its task. An unusable restored state is logged and
    /// replaced by the rest state.
    ///
    /// # Errors
    /// `Fault` of the device, `Invalid` when the rest state overflows, `Busy` when the command queue is full.
    pub(in crate::engine) async fn open(params: OpenParams, services: SceneServices) -> Result<Self> {
        let OpenParams { name, provenance, access, scene, backends, id, on_failure, state, frames_unavailable, memory } =
            params;
        services.device.name_scene(id, &name);
        services.device.load_scene(id, &scene, backends).await?;
        let state = match state.map(Arc::new) {
            Some(state) => match services.device.deform(id, &state, None).wait().await {
                Ok(_) => state,
                Err(error) => {
                    tracing::warn!(scene = name, %error, "the checkpoint is not usable; the scene starts at rest");
                    Arc::new(SceneState::rest(&scene))
                }
            },
            None => Arc::new(SceneState::rest(&scene)),
        };
        let wake = Arc::new(Notify::new());
        let max_window = services.config.max_window;
        let (admission, config) = (&services.admission, &services.config);
        let subscriptions = admission.pool_of_scene(Limit::SUBSCRIPTIONS, config.max_subscribers, &name);
        let waiting_requests = admission.pool_of_scene(Limit::WAITING_REQUESTS, config.max_pending_requests, &name);
        let failure = Arc::new(OnceLock::new());
        let checkpoints = SceneCheckpoints::new(Arc::clone(&services.checkpoints), name.clone());
        let (state_sender, current_state) = watch::channel(Arc::clone(&state));
        let actor = ActorParams {
            name: name.clone(),
            id,
            scene: Arc::clone(&scene),
            state,
            wake: Arc::clone(&wake),
            current_state: state_sender,
            failure: Arc::clone(&failure),
            on_failure,
            memory,
        };
        let (mailbox, inbox) = mpsc::channel(MAILBOX_CAPACITY);
        tokio::spawn(SceneActor::new(actor, services).run(inbox));
        Ok(Self {
            name,
            provenance,
            access,
            scene,
            id,
            frames_unavailable,
            max_window,
            mailbox,
            current_state,
            subscriptions,
            waiting_requests,
            writer: CurrentWriter::default(),
            forces: OnceLock::new(),
            wake,
            stop_error: OnceLock::new(),
            failure,
            content_hashes: OnceCell::new(),
            checkpoints,
        })
    }

    /// The hashes of the scene's arrays and textures. The first call computes them on the blocking pool; later and
    /// concurrent calls share the result.
    ///
    /// # Errors
    /// `Fault` when the computation panics.
    pub async fn content_hashes(&self) -> Result<Arc<ContentHashes>> {
        let compute = || {
            let scene = Arc::clone(&self.scene);
            run_blocking("hash", move || Ok(Arc::new(ContentHashes::of_scene(&scene))))
        };
        self.content_hashes.get_or_try_init(compute).await.cloned()
    }

    /// Who may use the scene.
    pub fn access(&self) -> SceneAccess {
        self.access.borrow().clone()
    }

    /// Waits until a principal no longer has a right to the scene, and returns the error. Cancel-safe. The future does not
    /// keep the scene open.
    pub fn right_ended(
        &self,
        principal: &Arc<Principal>,
        right: SceneRight,
    ) -> impl Future<Output = Error> + Send + use<> {
        let (mut access, principal, name) = (self.access.subscribe(), Arc::clone(principal), self.name.clone());
        async move {
            loop {
                if let Err(error) = access.borrow_and_update().check(&name, &principal, right) {
                    return error;
                }
                if access.changed().await.is_err() {
                    // The scene is closed, which ends its streams.
                    std::future::pending::<()>().await;
                }
            }
        }
    }

    /// Waits until the scene is closed, and returns the error. Cancel-safe. The future does not keep the scene open.
    pub fn closed(&self) -> impl Future<Output = Error> + Send + use<> {
        let (mut access, name) = (self.access.subscribe(), self.name.clone());
        async move {
            // The scene owns the sender.
            while access.changed().await.is_ok() {}
            scene_not_open(&name)
        }
    }

    /// The last completed step, if there is one.
    pub fn last_step(&self) -> Option<StepId> {
        let state = self.current_state.borrow();
        (state.run > 0).then(|| StepId::of(&state))
    }

    /// The newest step that survives a crash of the server and a power loss. `None` before the first one.
    pub fn durable_step(&self) -> Option<StepId> {
        let durable = self.checkpoints.durable_step().filter(|durable| durable.run > 0)?;
        Some(StepId { run: durable.run, number: durable.number, time: durable.time })
    }

    /// Acquires the writer lease. `peer` is the address of the client, for the log. The window (number of steps that
    /// may be unacknowledged) is clamped to the range from 1 to the configured limit.
    ///
    /// # Errors
    /// `LeaseTaken` with the run of the current writer and how long it has held the lease; `NotFound` when the scene is
    /// closed; `Busy` when the mailbox is full; `Fault` when the run cannot be written to disk.
    pub async fn drive(&self, peer: &str, request: LeaseRequest) -> Result<WriterSession> {
        let request = LeaseRequest { window: request.window.clamp(1, self.max_window), ..request };
        let (delivery, window, account) = (request.delivery, request.window, request.account.clone());
        let AcquiredLease { lease, token, run, initial_state } =
            self.call(|reply| Message::AcquireWriter { request, reply }).await?;
        let principal = account.principal_name();
        tracing::info!(scene = self.name, run, principal, peer, ?delivery, ?initial_state, "driven by a new writer");
        let (scene, checkpoints) = (Arc::clone(&self.scene), self.checkpoints.clone());
        let entry = self.writer.record(run, account);
        Ok(WriterSession {
            lease,
            _entry: entry,
            scene,
            run,
            window,
            token,
            initial_state,
            last_number: None,
            checkpoints,
        })
    }

    /// The client that drives the scene.
    pub fn writer(&self) -> Option<Account> {
        self.writer.account()
    }

    /// Returns the scene to its rest state, for a client: acquires the writer lease, completes one step and releases the
    /// lease. With `takes_over` it replaces the present writer. Returns the completed step.
    ///
    /// # Errors
    /// Those of [`Self::drive`] and of the step.
    pub async fn reset(&self, peer: &str, account: &Account, takes_over: bool) -> Result<StepId> {
        let request = LeaseRequest {
            account: account.clone(),
            // Does not wait for lossless readers, so that a stalled one cannot block the call.
            delivery: Delivery::Latest,
            overflow: Overflow::Block,
            window: 1,
            // Not used by a writer that does not wait.
            stall_budget: Duration::ZERO,
            token: None,
            takes_over,
            initial_state: Some(InitialState::Reset),
        };
        let mut writer = self.drive(peer, request).await?;
        writer.push_step(RawStepUpdate::default()).await?;
        match writer.next_report().await? {
            StepReport::Done { step, .. } => Ok(StepId { run: writer.run, number: step, time: 0.0 }),
            StepReport::Rejected { error, .. } => Err(error),
        }
    }

    /// Subscribes to the scene's steps. The subscription is active when this returns, and counts to `account`.
    ///
    /// # Errors
    /// `Unavailable` when frames are requested and there is no renderer; `LimitReached` when the client has its share of
    /// the subscriptions; `Busy` when the mailbox is full; `NotFound` when the scene is closed.
    pub async fn subscribe(
        &self,
        account: &Account,
        spec: OutputSpec,
        delivery: impl Into<StreamDelivery>,
    ) -> Result<Subscription> {
        self.check_spec(&spec)?;
        let permit = self.subscriptions.acquire(account)?;
        let (subscriber, subscription) = Subscription::new(permit, spec, delivery.into(), Arc::clone(&self.wake));
        self.call(|reply| Message::Subscribe { subscriber, reply }).await?;
        Ok(subscription)
    }

    /// Number of frame, vertex and state streams.
    pub fn subscription_count(&self) -> usize {
        self.subscriptions.held()
    }

    /// Number of requests that wait for a step or its output.
    pub fn waiting_request_count(&self) -> usize {
        self.waiting_requests.held()
    }

    /// Waits for a step and returns an output of it. The request counts to `account`. Dropping the future cancels the
    /// request unless its output is already being produced.
    ///
    /// # Errors
    /// `StepPassed` when the exact step has passed; `Unavailable` when there is no renderer; `Busy` when the client has its
    /// share of the requests that wait; `Preempted`; `NotFound` when the scene is closed.
    pub async fn request_output(
        &self,
        account: &Account,
        selector: StepSelector,
        spec: OutputSpec,
    ) -> Result<StepOutput> {
        self.check_spec(&spec)?;
        let busy = |limit| Error::Busy { queue: "requests that wait for a step", limit };
        let permit = self.waiting_requests.acquire(account).map_err(|_| busy(self.waiting_requests.total()))?;
        tokio::select! {
            biased;
            error = permit.handle().preempted() => Err(error),
            output = self.call(|reply| Message::Request(StepRequest { selector, spec, reply })) => output,
        }
    }

    /// Sets all forces of an owner. The scene's task is not involved.
    ///
    /// # Errors
    /// `LimitReached` when too many owners have forces.
    pub fn apply_forces(&self, update: &ForceUpdate) -> Result<ForceReceipt> {
        self.force_channel().apply(update)
    }

    /// Reports to viewers why nothing receives the forces any more, until another physics process does.
    pub fn set_receiver_error(&self, message: &str) {
        self.force_channel().set_receiver_error(message);
    }

    pub(super) fn force_channel(&self) -> &Arc<ForceChannel> {
        self.forces.get_or_init(Arc::default)
    }

    /// A receiver of the state of every completed step. Its initial value is the present state.
    pub(super) fn watch_state(&self) -> watch::Receiver<Arc<SceneState>> {
        self.current_state.clone()
    }

    /// Waits until the scene has ended and returns the error. Cancel-safe.
    pub(super) async fn ended(&self) -> Error {
        self.mailbox.closed().await;
        self.end_error()
    }

    /// Ends every stream of the scene with `error` and frees the scene. Returns after the scene is freed.
    pub(in crate::engine) async fn stop(&self, error: Error) {
        self.stop_error.set(error.clone()).ok(); // The error of the first call remains.
        let (done, stopped) = oneshot::channel();
        // A closed mailbox means that the scene's task has already ended.
        if self.mailbox.send(Message::Stop { error, done }).await.is_ok() {
            stopped.await.ok();
        }
    }

    /// Whether [`Self::stop`] was called or the scene has failed.
    pub(in crate::engine) fn is_closing(&self) -> bool {
        self.stop_error.get().is_some() || self.failure().is_some()
    }

    fn check_spec(&self, spec: &OutputSpec) -> Result<()> {
        match (spec, &self.frames_unavailable) {
            (OutputSpec::Frames(_) | OutputSpec::Pick { .. }, Some(error)) => Err(error.clone()),
            _ => Ok(()),
        }
    }

    /// The error with which the scene has failed. `None` if it has not failed.
    pub(in crate::engine) fn failure(&self) -> Option<&Error> {
        self.failure.get()
    }

    pub(in crate::engine) const fn id(&self) -> SceneId {
        self.id
    }

    /// Makes the actor panic.
    #[cfg(test)]
    pub(in crate::engine) async fn inject_panic(&self) {
        self.mailbox.send(Message::Panic).await.ok();
    }

    /// Sends a message to the actor and waits for the reply.
    async fn call<T>(&self, create_message: impl FnOnce(oneshot::Sender<Result<T>>) -> Message) -> Result<T> {
        let (reply, answer) = oneshot::channel();
        match self.mailbox.try_send(create_message(reply)) {
            Ok(()) => match answer.await {
                Ok(answer) => answer,
                Err(_) => {
                    // The actor has ended. It publishes the reason before it closes the mailbox.
                    self.mailbox.closed().await;
                    Err(self.end_error())
                }
            },
            Err(TrySendError::Full(_)) => Err(Error::Busy { queue: "requests to the scene", limit: MAILBOX_CAPACITY }),
            Err(TrySendError::Closed(_)) => Err(self.end_error()),
        }
    }

    /// The error of calls after the actor has ended.
    fn end_error(&self) -> Error {
        let scene_closed = || Error::NotFound { what: "scene", given: format!("closed scene '{}'", self.name) };
        self.failure().or_else(|| self.stop_error.get()).cloned().unwrap_or_else(scene_closed)
    }
}

/// The writer's handle to a scene. Dropping it releases the writer lease.
#[derive(Debug)]
pub struct WriterSession {
    lease: WriterLease,
    _entry: CurrentWriterEntry,
    scene: Arc<Scene>,
    /// The run of this writer: the number of its sequence of steps. Later writers of the server have larger runs.
    pub run: u64,
    /// Maximum number of unacknowledged steps.
    pub window: u32,
    pub token: LeaseToken,
    /// The state that the first step changes.
    pub initial_state: InitialState,
    /// Number of the last accepted step.
    last_number: Option<u64>,
    checkpoints: SceneCheckpoints,
}

impl WriterSession {
    /// Validates and queues a step. A rejected step has no effect. A large step is validated on another thread, because it
    /// takes milliseconds.
    ///
    /// # Errors
    /// `Invalid` for a malformed step; `WindowFull` for a step beyond the window; the error with which the server ended
    /// the stream.
    pub async fn push_step(&mut self, raw: RawStepUpdate) -> Result<()> {
        let begin = Instant::now();
        if let Some(last_number) = self.last_number.filter(|last_number| raw.number <= *last_number) {
            return Err(invalid("step.number", format!("a number above {last_number}"), raw.number));
        }
        let number = raw.number;
        let update = if raw.q.len() + raw.transforms.len() > INLINE_STEP_BYTES {
            let scene = Arc::clone(&self.scene);
            run_blocking("step", move || StepUpdate::parse(&scene, &raw)).await?
        } else {
            StepUpdate::parse(&self.scene, &raw)?
        };
        self.lease.step_queue.push(QueuedStep::new(update, ms_since(begin)))?;
        self.last_number = Some(number);
        Ok(())
    }

    /// Number of the newest step of this run that survives a crash of the server and a power loss.
    pub fn durable_step(&self) -> Option<u64> {
        let durable = self.checkpoints.durable_step()?;
        (durable.run == self.run).then_some(durable.number)
    }

    /// Whether the writer may read another step now. If not, it may after the next report.
    pub fn may_read_step(&self) -> bool {
        self.lease.step_queue.may_read_step()
    }

    /// Waits for the next report. Cancel-safe.
    ///
    /// # Errors
    /// The error with which the server ended the stream, after all reports.
    pub async fn next_report(&self) -> Result<StepReport> {
        self.lease.step_queue.next_report().await
    }

    /// Whether every accepted step is reported and every report is taken.
    pub fn is_drained(&self) -> bool {
        self.lease.step_queue.is_drained()
    }
}
