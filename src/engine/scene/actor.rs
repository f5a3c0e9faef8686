//! The scene actor: one task per scene that serializes all operations on the scene. It deforms a step, delivers the
//! step to subscribers and single requests, and then acknowledges it to the writer. The next step is computed while
//! vertices and frames of the previous one are still being read back from the device (`in_flight`). The task awaits the
//! device but never a client.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Instant;

use tokio::sync::{Notify, mpsc, oneshot, watch};

use super::readback_queue::PendingReadback;
use super::step_queue::{Policy, QueuedStep, StepQueue, WriterLease};
use super::subscriber::{Delivery, Subscriber};
use crate::config::Config;
use crate::engine::device::command::SceneId;
use crate::engine::device::handle::DeviceHandle;
use crate::engine::output::step_output::{OutputSpec, StepId, StepOutput};
use crate::engine::storage::checkpoint_store::CheckpointStore;
use crate::telemetry::{Stage, StageTimes};
use modalcast_model::deform::{DeformedSurface, VertexAttributes};
use modalcast_model::error::{Error, Result};
use modalcast_model::scene::{Scene, SceneState};

/// The step that a single request asks for. Numbers refer to the current run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum StepSelector {
    Current,
    Exact(u64),
    Minimum(u64),
}

/// A single request that is waiting for its step.
#[derive(Debug)]
pub(in crate::engine) struct StepRequest {
    pub selector: StepSelector,
    pub spec: OutputSpec,
    pub reply: oneshot::Sender<Result<StepOutput>>,
}

/// A message to a scene's task. The mailbox is bounded: a request that finds it full fails with `Busy`; `Stop` waits
/// for capacity.
pub(in crate::engine) enum Message {
    AcquireWriter { peer: String, policy: Policy, window: u32, reply: oneshot::Sender<Result<(WriterLease, u64)>> },
    Subscribe { subscriber: Subscriber, reply: oneshot::Sender<Result<()>> },
    Request(StepRequest),
    Stop { error: Error, done: oneshot::Sender<()> },
}

/// Services that all scenes share.
#[derive(Debug, Clone)]
pub(in crate::engine) struct SceneServices {
    pub device_handle: DeviceHandle,
    pub checkpoints: Arc<CheckpointStore>,
    pub config: Arc<Config>,
}

/// The current writer of a scene.
struct Writer {
    step_queue: Arc<StepQueue>,
    peer: String,
    since: Instant,
}

/// A completed step that is not acknowledged yet.
pub(in crate::engine) struct CompletedStep {
    step_queue: Arc<StepQueue>,
    step: u64,
    stages: StageTimes,
}

/// The state machine of one open scene.
pub(in crate::engine) struct SceneActor {
    pub(in crate::engine) name: String,
    pub(in crate::engine) id: SceneId,
    pub(in crate::engine) scene: Arc<Scene>,
    pub(in crate::engine) services: SceneServices,
    pub(in crate::engine) state: Arc<SceneState>,
    /// The run of the latest writer; 0 before the first writer.
    run: u64,
    /// Number of steps applied to the scene, merged ones included.
    pub(in crate::engine) count: u64,
    writer: Option<Writer>,
    pub(in crate::engine) subscribers: Vec<Subscriber>,
    pub(in crate::engine) pending_requests: Vec<StepRequest>,
    /// A completed step that is not yet delivered to every lossless viewer.
    undelivered: Option<(Arc<StepQueue>, u64)>,
    /// Stage times of the current step up to the end of its deformation.
    pub(in crate::engine) stages: StageTimes,
    /// Readbacks in flight, oldest first: those of the current step, and frames of the step before it.
    pub(in crate::engine) in_flight: VecDeque<PendingReadback>,
    /// Vertex attributes of the current step that a single copy brought to the host, cached for later readers.
    pub(in crate::engine) surface: Option<CachedVertices>,
    last_step: watch::Sender<Option<StepId>>,
    wake: Arc<Notify>,
}

/// Vertices in host memory.
#[derive(Debug, Clone)]
pub(in crate::engine) struct CachedVertices {
    pub surface: Arc<DeformedSurface>,
    /// The attributes that `surface` contains.
    pub parts: VertexAttributes,
    /// Duration of the copy in milliseconds.
    pub ms: f64,
}

/// Initial values of a scene's task.
pub(in crate::engine) struct ActorParams {
    pub name: String,
    pub id: SceneId,
    pub scene: Arc<Scene>,
    pub state: Arc<SceneState>,
    pub wake: Arc<Notify>,
}

impl SceneActor {
    /// The task of a scene that is loaded on the device and deformed to `params.state`. Also returns the channel
    /// that carries the last completed step.
    pub(in crate::engine) fn new(
        params: ActorParams,
        services: SceneServices,
    ) -> (Self, watch::Receiver<Option<StepId>>) {
        let ActorParams { name, id, scene, state, wake } = params;
        let has_step = state.run > 0;
        let (last_step, last_step_receiver) = watch::channel(has_step.then(|| StepId::of(&state)));
        let scene_actor = Self {
            name,
            id,
            scene,
            services,
            run: state.run,
            state,
            count: u64::from(has_step),
            writer: None,
            subscribers: Vec::new(),
            pending_requests: Vec::new(),
            undelivered: None,
            stages: Vec::new(),
            in_flight: VecDeque::new(),
            surface: None,
            last_step,
            wake,
        };
        (scene_actor, last_step_receiver)
    }

    /// Runs until it receives `Stop` or every sender of the mailbox is dropped.
    pub(in crate::engine) async fn run_until_stopped(mut self, mut mailbox: mpsc::Receiver<Message>) {
        let (error, done) = loop {
            self.advance().await;
            let stall_timeout = self.next_stall_deadline();
            tokio::select! {
                // Biased, so that a request sent before a step is registered when the step completes. Each iteration
                // calls `advance`, so messages do not starve steps.
                biased;
                message = mailbox.recv() => match message {
                    Some(Message::Stop { error, done }) => break (error, Some(done)),
                    Some(message) => self.receive(message),
                    None => break (stopped(), None),
                },
                () = self.wake.notified() => {}
                () = sleep_until(stall_timeout) => {}
            }
        };
        self.end(error).await;
        drop(mailbox);
        if let Some(done) = done {
            done.send(()).ok(); // Fails only if the caller no longer waits.
        }
    }

    /// Delivers everything that can be delivered now and computes at most one step.
    async fn advance(&mut self) {
        self.answer_requests().await;
        let applies_back_pressure = self.applies_back_pressure();
        self.serve_subscribers(applies_back_pressure).await;
        if self.is_blocked() {
            return self.flush_readbacks().await;
        }
        let done = self.undelivered.take().map(|(step_queue, step)| CompletedStep {
            step_queue,
            step,
            stages: self.stages.clone(),
        });
        match self.in_flight.back_mut().filter(|pending| pending.count == self.count) {
            // Acknowledge the step after its last readback in flight.
            Some(pending) => pending.done = done.or(pending.done.take()),
            None => {
                self.flush_readbacks().await;
                acknowledge(done);
            }
        }
        if self.writer.as_ref().is_some_and(|writer| writer.step_queue.is_closed()) {
            self.writer = None;
        }
        let step_queue = self.writer.as_ref().map(|writer| Arc::clone(&writer.step_queue));
        match step_queue.and_then(|step_queue| Some((step_queue.take()?, step_queue))) {
            Some((queued, step_queue)) => {
                self.step(step_queue, queued).await;
                // There may be more work; handle waiting messages first.
                self.wake.notify_one();
            }
            None => self.flush_readbacks().await,
        }
    }

    /// Computes the next step while readbacks are in flight. When this returns, only frames of the step before it may
    /// still be in flight.
    async fn step(&mut self, step_queue: Arc<StepQueue>, queued: QueuedStep) {
        let mut stages = queued.stages();
        let number = queued.update.number;
        let mut next = SceneState::clone(&self.state);
        next.run = self.run;
        next.apply(&self.scene, &queued.update);
        let next = Arc::new(next);
        let mut deforming = self.services.device_handle.deform(self.id, &next);
        self.flush_vertex_readbacks().await;
        let deformed = loop {
            tokio::select! {
                biased;
                deformed = deforming.recv() => break deformed,
                () = self.deliver_oldest_readback(), if !self.in_flight.is_empty() => {}
            }
        };
        self.flush_readbacks_before(self.count).await;
        match deformed {
            Ok(deformed) => {
                stages.push((Stage::Deform, deformed.ms));
                self.stages = stages;
                self.services.checkpoints.enqueue(&self.name, &next);
                self.last_step.send_replace(Some(StepId::of(&next)));
                self.state = next;
                self.surface = None;
                self.count += 1 + queued.merged;
                self.undelivered = Some((step_queue, number));
            }
            Err(error) => {
                // Reports are ordered, so the acknowledgements of earlier steps come first.
                self.flush_readbacks().await;
                step_queue.report(number, Err(error));
            }
        }
    }

    fn receive(&mut self, message: Message) {
        // A failed send below means that the caller no longer waits; its reply is dropped.
        match message {
            Message::AcquireWriter { peer, policy, window, reply } => {
                reply.send(self.acquire_writer(peer, policy, window)).ok();
            }
            Message::Subscribe { subscriber, reply } => {
                reply.send(self.add_subscriber(subscriber)).ok();
            }
            Message::Request(request) => {
                self.pending_requests.retain(|request| !request.reply.is_closed());
                let limit = self.services.config.max_pending_requests;
                if self.pending_requests.len() < limit {
                    self.pending_requests.push(request);
                } else {
                    request.reply.send(Err(Error::Busy { queue: "requests that wait for a step", limit })).ok();
                }
            }
            // Handled in `run_until_stopped`.
            Message::Stop { .. } => {}
        }
    }

    /// Admits one writer at a time; a writer whose queue is closed is replaced.
    fn acquire_writer(&mut self, peer: String, policy: Policy, window: u32) -> Result<(WriterLease, u64)> {
        if let Some(writer) = self.writer.as_ref().filter(|writer| !writer.step_queue.is_closed()) {
            let seconds = writer.since.elapsed().as_secs();
            let holder = format!("{} has driven run {} for {seconds} s", writer.peer, self.run);
            return Err(Error::Taken { what: "the writer's place of the scene", holder });
        }
        self.run += 1;
        let step_queue = Arc::new(StepQueue::new(policy, window, Arc::clone(&self.wake)));
        self.writer = Some(Writer { step_queue: Arc::clone(&step_queue), peer, since: Instant::now() });
        Ok((WriterLease(step_queue), self.run))
    }

    fn add_subscriber(&mut self, mut subscriber: Subscriber) -> Result<()> {
        self.subscribers.retain(|subscriber| !subscriber.is_closed());
        let limit = self.services.config.max_subscribers;
        if self.subscribers.len() >= limit {
            return Err(Error::Busy { queue: "subscribers of the scene", limit });
        }
        let shows_current = subscriber.delivery == Delivery::Latest && self.state.run > 0;
        subscriber.delivered_count = if shows_current { self.count.saturating_sub(1) } else { self.count };
        self.subscribers.push(subscriber);
        Ok(())
    }

    /// Whether another step is queued. If so, readbacks of the current step are only begun and overlap with computing
    /// it.
    pub(in crate::engine) fn has_queued_step(&self) -> bool {
        self.writer.as_ref().is_some_and(|writer| !writer.step_queue.is_closed() && writer.step_queue.has_queued())
    }

    /// Whether lossless viewers exert back-pressure: only if the pending step's writer is lossless and still connected.
    fn applies_back_pressure(&self) -> bool {
        self.undelivered
            .as_ref()
            .is_some_and(|(step_queue, _)| step_queue.policy() == Policy::Lossless && !step_queue.is_closed())
    }

    fn is_blocked(&self) -> bool {
        let owes = |subscriber: &Subscriber| {
            subscriber.delivery == Delivery::Lossless && subscriber.delivered_count < self.count
        };
        self.applies_back_pressure() && self.subscribers.iter().any(owes)
    }

    /// Deadline at which the viewer that has blocked the writer for the longest is cut off.
    fn next_stall_deadline(&self) -> Option<Instant> {
        let first = self.subscribers.iter().filter_map(|subscriber| subscriber.stalled_since).min()?;
        Some(first + self.services.config.stall_timeout)
    }

    /// Whether a request can be answered now.
    ///
    /// # Errors
    /// `Gone` when the scene has passed the exact step that is asked for.
    pub(in crate::engine) fn is_ready(&self, selector: StepSelector) -> Result<bool> {
        let of_this_run = self.state.run == self.run && self.run > 0;
        let here = of_this_run.then_some(self.state.step);
        match (selector, here) {
            (StepSelector::Current, _) => Ok(true),
            (StepSelector::Exact(want), Some(here)) if here > want => Err(Error::Gone {
                what: "exact_step",
                expected: format!("{here}, the step that scene '{}' shows, or a later one", self.name),
                given: want.to_string(),
            }),
            (StepSelector::Exact(want), Some(here)) => Ok(here == want),
            (StepSelector::Minimum(want), Some(here)) => Ok(here >= want),
            (StepSelector::Exact(_) | StepSelector::Minimum(_), None) => Ok(false),
        }
    }

    async fn end(mut self, error: Error) {
        self.flush_readbacks().await;
        if let Some(writer) = &self.writer {
            if let Some((step_queue, step)) = self.undelivered.take() {
                step_queue.report(step, Ok(self.stages.clone()));
            }
            writer.step_queue.end(error.clone());
        }
        self.subscribers.iter().for_each(|subscriber| subscriber.end(error.clone()));
        self.subscribers.clear();
        for request in self.pending_requests.drain(..) {
            request.reply.send(Err(error.clone())).ok(); // Fails only if the caller no longer waits.
        }
        // Fails only if the device thread has ended, which frees the scene too.
        self.services.device_handle.unload_scene(self.id).await.ok();
    }
}

pub(in crate::engine) fn acknowledge(done: Option<CompletedStep>) {
    if let Some(CompletedStep { step_queue, step, stages }) = done {
        step_queue.report(step, Ok(stages));
    }
}

fn stopped() -> Error {
    Error::Unavailable { what: "scene", reason: "the server stops".into(), remedy: "Try again later".into() }
}

async fn sleep_until(when: Option<Instant>) {
    match when {
        Some(when) => tokio::time::sleep_until(when.into()).await,
        None => std::future::pending().await,
    }
}
