//! The scene actor: one task per scene that serializes all operations on the scene. It owns three objects: the queue of
//! steps from the writer ([`StepQueue`]), the delivery of outputs ([`OutputDelivery`]) and the checkpoints of the scene
//! ([`SceneCheckpoints`]). The task awaits the device for steps, but never a client. It starts outputs, and their readers
//! wait for the device ([`OutputBody`](crate::engine::OutputBody)).
//!
//! # State machine
//! [`StepPhase`] is the state of the actor while it runs:
//!
//! ```text
//!           begin_step             finish_step, accepted
//!   Idle --------------> Deforming ---------------------> Delivering
//!    ^                       |                                |
//!    |                       | finish_step, rejected          | acknowledge
//!    +-----------------------+--------------------------------+
//! ```
//!
//! | state | meaning | ends when |
//! |---|---|---|
//! | `Idle` | no step is in progress | the writer has queued a step |
//! | `Deforming` | the device computes the step and finishes outputs of the previous one, messages wait | the device answers |
//! | `Delivering` | the step is the current one, its writer waits for the acknowledgment | the outputs of every lossless subscriber are started ([`StallBudget`](super::stall_budget) limits the wait), or the writer is not lossless or has disconnected |
//!
//! Single requests and subscribers are served in `Idle` and in `Delivering`. In every state the actor ends, and
//! [`SceneActor::close`] consumes it, when
//! - it receives `Stop` or every sender of the mailbox is dropped: outputs in flight are finished first;
//! - the device is lost: the scene fails with `DeviceLost`;
//! - the actor's code panics: the scene fails with a `Fault`.
//!
//! A failed scene is first removed from the registry. Then its writer, subscribers and requests get the error, and the
//! device unloads the scene. Other scenes continue.

use std::mem;
use std::sync::{Arc, OnceLock};
use std::time::Instant;

use tokio::sync::{Notify, mpsc, oneshot, watch};

use super::current_step::CurrentStep;
use super::lease::{AcquiredLease, InitialState, LeaseRequest, LeaseToken, WriterLease};
use super::message::Message;
use super::output_delivery::OutputDelivery;
use super::output_producer::{DeliveryMode, SceneOnDevice};
use super::step_queue::{CompletedStep, QueuedStep, StepQueue};
use crate::admission::Admission;
use crate::config::ValidatedConfig;
use crate::engine::blocking::run_blocking;
use crate::engine::catch_unwind::catch_unwind_async;
use crate::engine::device::command::SceneId;
use crate::engine::device::handle::{DeviceHandle, PendingReply};
use crate::engine::scene_memory::SceneMemory;
use crate::engine::storage::checkpoint_store::{CheckpointStore, SceneCheckpoints};
use crate::engine::storage::run_counter::RunCounter;
use crate::telemetry::{Stage, StageTimes};
use modalcast_model::deform::DeformSummary;
use modalcast_model::error::{Error, Result, fault};
use modalcast_model::scene::{Scene, SceneState, StatePool, StepUpdate};

/// Services that all scenes share.
#[derive(Debug, Clone)]
pub(in crate::engine) struct SceneServices {
    pub device: DeviceHandle,
    pub checkpoints: Arc<CheckpointStore>,
    pub run_counter: Arc<RunCounter>,
    pub config: Arc<ValidatedConfig>,
    pub admission: Admission,
}

/// Arguments of [`SceneActor::new`]: a scene that is loaded on the device and deformed to `state`.
pub(super) struct ActorParams {
    pub name: String,
    pub id: SceneId,
    pub scene: Arc<Scene>,
    pub state: Arc<SceneState>,
    /// Wakes the actor: a step is queued, the writer has disconnected, or a subscriber has capacity.
    pub wake: Arc<Notify>,
    /// Receives the state of every completed step.
    pub current_state: watch::Sender<Arc<SceneState>>,
    /// Receives the error with which the scene fails.
    pub failure: Arc<OnceLock<Error>>,
    /// Called when the scene has failed.
    pub on_failure: Box<dyn FnOnce() + Send>,
    /// Reserved until the device has unloaded the scene.
    pub memory: SceneMemory,
}

/// Identifies a writer across connections.
#[derive(Debug, Clone, PartialEq, Eq)]
struct WriterId {
    principal: Option<Arc<str>>,
    token: LeaseToken,
}

/// The current writer of a scene.
struct Writer {
    step_queue: Arc<StepQueue>,
    id: WriterId,
    acquired_at: Instant,
}

/// A step that the device is computing.
struct DeformingStep {
    step_queue: Arc<StepQueue>,
    /// Number of older steps that were merged into this one.
    merged: u64,
    stages: StageTimes,
    state: Arc<SceneState>,
    pending_summary: PendingReply<DeformSummary>,
}

/// The step after the one that the device is computing. Its state is known, so the device can compute both at once.
struct NextStep {
    step_queue: Arc<StepQueue>,
    queued_step: QueuedStep,
    /// The state before the step.
    base: Arc<SceneState>,
    state: Arc<SceneState>,
}

/// Progress of the step that the actor works on; see the module's documentation.
#[derive(Default)]
enum StepPhase {
    #[default]
    Idle,
    Deforming(DeformingStep),
    Delivering(CompletedStep),
}

/// Why an actor ends.
enum ActorEnd {
    /// `Stop` was received, or every sender of the mailbox is dropped.
    Stopped {
        error: Error,
        done: Option<oneshot::Sender<()>>,
    },
    DeviceLost(Error),
    Panicked(Error),
}

/// The state machine of one open scene.
pub(super) struct SceneActor {
    name: String,
    id: SceneId,
    scene: Arc<Scene>,
    device: DeviceHandle,
    run_counter: Arc<RunCounter>,
    /// The run of the latest writer: the number of its sequence of steps. 0 before the first writer.
    run: u64,
    /// Whether the next step starts from the rest state instead of the current one.
    starts_from_rest: bool,
    writer: Option<Writer>,
    /// The latest writer, whether it is still connected or not.
    last_writer: Option<WriterId>,
    phase: StepPhase,
    /// A step that was taken from the queue of the writer early.
    next_step: Option<NextStep>,
    current: CurrentStep,
    states: StatePool,
    delivery: OutputDelivery,
    checkpoints: SceneCheckpoints,
    current_state: watch::Sender<Arc<SceneState>>,
    /// See [`ActorParams::wake`].
    wake: Arc<Notify>,
    failure: Arc<OnceLock<Error>>,
    on_failure: Box<dyn FnOnce() + Send>,
    memory: SceneMemory,
}

impl SceneActor {
    pub(super) fn new(params: ActorParams, services: SceneServices) -> Self {
        let ActorParams { name, id, scene, state, wake, current_state, failure, on_failure, memory } = params;
        let SceneServices { device, checkpoints, run_counter, config, .. } = services;
        let scene_on_device = SceneOnDevice { name: name.clone(), id };
        Self {
            delivery: OutputDelivery::new(scene_on_device, device.clone(), &config),
            checkpoints: SceneCheckpoints::new(checkpoints, name.clone()),
            name,
            id,
            scene,
            device,
            run_counter,
            run: state.run,
            starts_from_rest: false,
            writer: None,
            last_writer: None,
            phase: StepPhase::Idle,
            next_step: None,
            current: CurrentStep::of_opened_scene(state),
            states: StatePool::default(),
            current_state,
            wake,
            failure,
            on_failure,
            memory,
        }
    }

    /// Runs until the scene is stopped or fails, then frees it.
    pub(super) async fn run(mut self, mut mailbox: mpsc::Receiver<Message>) {
        let end = catch_unwind_async(self.serve(&mut mailbox)).await.unwrap_or_else(|_| {
            tracing::error!(scene = self.name, "the task of the scene panicked; the scene is closed");
            ActorEnd::Panicked(fault("scene", "the task of the scene panicked. Open the scene again"))
        });
        self.close(end, mailbox).await;
    }

    async fn serve(&mut self, mailbox: &mut mpsc::Receiver<Message>) -> ActorEnd {
        loop {
            self.advance().await;
            let stall_check = self.delivery.next_stall_check();
            tokio::select! {
                // Biased, so that a request sent before a step is registered when the step completes. Each iteration
                // calls `advance`, so messages do not starve steps.
                biased;
                error = self.device.loss().wait() => return ActorEnd::DeviceLost(error),
                message = mailbox.recv() => match message {
                    Some(Message::Stop { error, done }) => return ActorEnd::Stopped { error, done: Some(done) },
                    Some(message) => self.receive(message).await,
                    None => return ActorEnd::Stopped { error: Error::ShuttingDown, done: None },
                },
                () = self.wake.notified() => {}
                () = self.delivery.finish_oldest_output(), if self.delivery.has_outputs_in_flight() => {}
                () = sleep_until(stall_check) => {}
            }
        }
    }

    /// Starts all outputs that can be started now and computes at most one step.
    async fn advance(&mut self) {
        self.delivery.charge_stall(Instant::now());
        self.delivery.answer_requests(&self.current, self.run).await;
        let mode = DeliveryMode { overlaps_next_step: self.has_queued_step() };
        self.delivery.serve_subscribers(&self.current, mode).await;
        if self.applies_back_pressure() && self.delivery.blocks_writer(&self.current, Instant::now()) {
            return;
        }
        self.acknowledge();
        if self.writer.as_ref().is_some_and(|writer| writer.step_queue.is_closed()) {
            self.writer = None;
        }
        if self.begin_step() {
            self.finish_step().await;
            // More steps may be queued. Handle waiting messages first.
            self.wake.notify_one();
        }
    }

    /// `Delivering` to `Idle`: the step is acknowledged after its last output in flight.
    fn acknowledge(&mut self) {
        if let StepPhase::Delivering(step) = mem::take(&mut self.phase) {
            self.delivery.acknowledge(step);
        }
    }

    /// `Idle` to `Deforming`, if the writer has queued a step. Returns whether a step was started.
    fn begin_step(&mut self) -> bool {
        let Some(writer) = &self.writer else {
            self.next_step = None;
            return false;
        };
        let step_queue = Arc::clone(&writer.step_queue);
        // The steps of an earlier writer are dropped.
        let next_step = self.next_step.take().filter(|next_step| Arc::ptr_eq(&next_step.step_queue, &step_queue));
        let (queued_step, state) = match next_step {
            Some(NextStep { queued_step, base, state, .. }) => {
                // The step before it may have been rejected.
                let is_base_current = Arc::ptr_eq(&base, &self.current.state) && !self.starts_from_rest;
                (Some(queued_step), is_base_current.then_some(state))
            }
            None => (step_queue.take(), None),
        };
        let Some(queued_step) = queued_step else { return false };
        // Ends the time in the queue, so before the states are computed.
        let stages = queued_step.stages();
        let current = Arc::clone(&self.current.state);
        let state = match state {
            Some(state) => state,
            None if self.starts_from_rest => {
                Arc::new(state_from_rest(&self.scene, &current, self.run, &queued_step.update))
            }
            None => self.state_after(&current, &queued_step),
        };
        self.next_step = step_queue.take_early().map(|next| NextStep {
            step_queue: Arc::clone(&step_queue),
            base: Arc::clone(&state),
            state: self.state_after(&state, &next),
            queued_step: next,
        });
        let following = self.next_step.as_ref().map(|next_step| Arc::clone(&next_step.state));
        let merged = queued_step.merged;
        let pending_summary = self.device.deform(self.id, &state, following);
        self.phase = StepPhase::Deforming(DeformingStep { step_queue, merged, stages, state, pending_summary });
        true
    }

    /// The state after a step of the present run that changes `base`.
    fn state_after(&mut self, base: &Arc<SceneState>, step: &QueuedStep) -> Arc<SceneState> {
        self.states.apply(&self.scene, base, self.run, &step.update)
    }

    /// `Deforming` to `Delivering`, or to `Idle` if the device rejects the step.
    async fn finish_step(&mut self) {
        let StepPhase::Deforming(step) = &self.phase else { return };
        let deformed = self.delivery.wait_for_step(&step.pending_summary, &self.current).await;
        let StepPhase::Deforming(step) = mem::take(&mut self.phase) else { return };
        let DeformingStep { step_queue, merged, mut stages, state, .. } = step;
        match deformed {
            Ok(deformed) => {
                stages.push((Stage::Deform, deformed.ms));
                self.starts_from_rest = false;
                self.checkpoints.save(&state);
                self.current_state.send_replace(Arc::clone(&state));
                self.current = CurrentStep { state, step_count: self.current.step_count + 1 + merged, stages };
                self.delivery.begin_step();
                self.phase = StepPhase::Delivering(CompletedStep::new(step_queue, self.current.stages.clone()));
            }
            Err(error) => {
                // Reports have the order of the steps, so deliver the acknowledgments of earlier steps first.
                self.delivery.finish_outputs().await;
                step_queue.report(Err(error));
            }
        }
    }

    async fn receive(&mut self, message: Message) {
        // A failed `send` below means that the caller no longer waits.
        match message {
            Message::AcquireWriter { request, reply } => {
                reply.send(self.acquire_writer(request).await).ok();
            }
            Message::Subscribe { subscriber, reply } => {
                self.delivery.add_subscriber(subscriber, &self.current);
                reply.send(Ok(())).ok();
            }
            Message::Request(request) => self.delivery.add_request(request),
            // Handled in `serve`.
            Message::Stop { .. } => {}
            #[cfg(test)]
            Message::Panic => panic!("injected into the scene actor"),
        }
    }

    /// Admits one writer at a time. A new writer replaces the present one if the queue of the present one is closed, if
    /// both have the same principal and token, or if the new writer requests the takeover.
    ///
    /// # Errors
    /// `LeaseTaken`; `Fault` when the run or the token cannot be created. The present writer then keeps the lease.
    async fn acquire_writer(&mut self, request: LeaseRequest) -> Result<AcquiredLease> {
        let LeaseRequest { account, delivery, overflow, window, stall_budget, token, takes_over, initial_state } =
            request;
        let id = WriterId { principal: account.principal, token: token.map_or_else(LeaseToken::random, Ok)? };
        let present_writer = self.writer.as_ref().filter(|writer| !writer.step_queue.is_closed());
        if let Some(writer) = present_writer
            && !takes_over
            && id != writer.id
        {
            return Err(Error::LeaseTaken { run: self.run, seconds: writer.acquired_at.elapsed().as_secs() });
        }
        let run_counter = Arc::clone(&self.run_counter);
        let run = run_blocking("counter of runs", move || run_counter.next()).await?;
        if let Some(writer) = &self.writer {
            writer.step_queue.end(Error::LeaseLost { run });
        }
        self.run = run;
        let is_resumed = self.last_writer.as_ref() == Some(&id);
        self.starts_from_rest = match initial_state {
            Some(initial_state) => initial_state == InitialState::Reset,
            // A resumed run that has not sent a step yet begins as it would have without the interruption.
            None => !is_resumed || self.starts_from_rest,
        };
        let initial_state = if self.starts_from_rest { InitialState::Reset } else { InitialState::Keep };
        self.last_writer = Some(id.clone());
        let step_queue = Arc::new(StepQueue::new(delivery, overflow, window, Arc::clone(&self.wake)));
        let (acquired_at, lease) = (Instant::now(), WriterLease { step_queue: Arc::clone(&step_queue) });
        self.delivery.reset_stall_budget(stall_budget, acquired_at);
        let token = id.token.clone();
        self.writer = Some(Writer { step_queue, id, acquired_at });
        Ok(AcquiredLease { lease, token, run, initial_state })
    }

    /// Whether another step is queued.
    fn has_queued_step(&self) -> bool {
        let has_next = |step_queue: &Arc<StepQueue>| {
            step_queue.has_queued()
                || self.next_step.as_ref().is_some_and(|next_step| Arc::ptr_eq(&next_step.step_queue, step_queue))
        };
        self.writer.as_ref().is_some_and(|writer| !writer.step_queue.is_closed() && has_next(&writer.step_queue))
    }

    /// Whether lossless subscribers may block the writer: only if the writer of the completed step is lossless and
    /// still connected.
    fn applies_back_pressure(&self) -> bool {
        matches!(&self.phase, StepPhase::Delivering(step) if step.applies_back_pressure())
    }

    /// Ends all streams and requests with the error of `end`. Frees the scene on the device.
    async fn close(mut self, end: ActorEnd, mailbox: mpsc::Receiver<Message>) {
        let (error, done) = match end {
            ActorEnd::Stopped { error, done } => {
                self.delivery.finish_outputs().await;
                (error, done)
            }
            ActorEnd::DeviceLost(error) => {
                self.fail(&error);
                self.delivery.finish_outputs().await;
                (error, None)
            }
            ActorEnd::Panicked(error) => {
                self.fail(&error);
                (error, None)
            }
        };
        let Self { writer, phase, delivery, device, id, memory, .. } = self;
        if let StepPhase::Delivering(step) = phase {
            step.acknowledge();
        }
        if let Some(writer) = writer {
            writer.step_queue.end(error.clone());
        }
        delivery.end(&error);
        // Fails only if the device thread has ended, which frees the scene too.
        device.unload_scene(id).await.ok();
        drop(memory);
        drop(mailbox);
        if let Some(done) = done {
            done.send(()).ok(); // Fails only if the caller no longer waits.
        }
    }

    /// Publishes the error with which the scene fails. Calls `on_failure`.
    fn fail(&mut self, error: &Error) {
        self.failure.set(error.clone()).ok(); // A scene fails once.
        mem::replace(&mut self.on_failure, Box::new(|| {}))();
    }
}

/// The state after a step that changes the rest state instead of `current`. The device shows `current`, which may differ
/// from rest in every domain.
fn state_from_rest(scene: &Scene, current: &SceneState, run: u64, update: &StepUpdate) -> SceneState {
    let mut state = SceneState { run, serial: current.serial, ..SceneState::rest(scene) };
    state.apply(scene, update);
    state.mark_all_dirty();
    state
}

async fn sleep_until(deadline: Option<Instant>) {
    match deadline {
        Some(deadline) => tokio::time::sleep_until(deadline.into()).await,
        None => std::future::pending().await,
    }
}

#[cfg(test)]
mod tests;
