//! The scene actor: one task per scene that serializes all operations on the scene. It deforms a step, delivers the
//! step to subscribers and single requests, and then acknowledges it to the writer. The next step is computed while
//! vertices and frames of the previous one are still being read back from the device (`late`). The task awaits the
//! device but never a client.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Instant;

use tokio::sync::{Notify, mpsc, oneshot, watch};

use super::command::SceneId;
use super::keep::Keeper;
use super::lane::{Lane, Place, Policy, Waiting};
use super::late::Late;
use super::viewer::{Delivery, Shown, StepName, View, Viewer};
use super::worker::Worker;
use crate::config::Config;
use crate::telemetry::{Stage, StageTimes};
use modalcast_model::deform::{Surface, Wanted};
use modalcast_model::error::{Error, Result};
use modalcast_model::scene::{Scene, State};

/// The step that a single request asks for. Numbers refer to the current run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Which {
    Current,
    Exact(u64),
    Minimum(u64),
}

/// A single request that is waiting for its step.
#[derive(Debug)]
pub(super) struct Ask {
    pub which: Which,
    pub view: View,
    pub reply: oneshot::Sender<Result<Shown>>,
}

/// A message to a scene's task. The mailbox is bounded: a request that finds it full fails with `Busy`; `Stop` waits
/// for capacity.
pub(super) enum Message {
    Drive { who: String, policy: Policy, window: u32, reply: oneshot::Sender<Result<(Place, u64)>> },
    Watch { viewer: Viewer, reply: oneshot::Sender<Result<()>> },
    Ask(Ask),
    Stop { error: Error, done: oneshot::Sender<()> },
}

/// Services that all scenes share.
#[derive(Debug, Clone)]
pub(super) struct Means {
    pub worker: Worker,
    pub keeper: Arc<Keeper>,
    pub config: Arc<Config>,
}

/// The current writer of a scene.
struct Writer {
    lane: Arc<Lane>,
    who: String,
    since: Instant,
}

/// A completed step that is not acknowledged yet.
pub(super) struct Done {
    lane: Arc<Lane>,
    step: u64,
    stages: StageTimes,
}

/// The state machine of one open scene.
pub(super) struct Conductor {
    pub(super) name: String,
    pub(super) id: SceneId,
    pub(super) scene: Arc<Scene>,
    pub(super) means: Means,
    pub(super) state: Arc<State>,
    /// The run of the latest writer; 0 before the first writer.
    run: u64,
    /// Number of steps applied to the scene, merged ones included.
    pub(super) count: u64,
    writer: Option<Writer>,
    pub(super) viewers: Vec<Viewer>,
    pub(super) asks: Vec<Ask>,
    /// A completed step that is not yet delivered to every lossless viewer.
    pending: Option<(Arc<Lane>, u64)>,
    /// Stage times of the current step up to the end of its deformation.
    pub(super) stages: StageTimes,
    /// Readbacks in flight, oldest first: those of the current step, and frames of the step before it.
    pub(super) late: VecDeque<Late>,
    /// Vertex attributes of the current step that a single copy brought to the host, cached for later readers.
    pub(super) surface: Option<Held>,
    last_step: watch::Sender<Option<StepName>>,
    wake: Arc<Notify>,
}

/// Vertices in host memory.
#[derive(Debug, Clone)]
pub(super) struct Held {
    pub surface: Arc<Surface>,
    /// The attributes that `surface` contains.
    pub parts: Wanted,
    /// Duration of the copy in milliseconds.
    pub ms: f64,
}

/// Initial values of a scene's task.
pub(super) struct Beginning {
    pub name: String,
    pub id: SceneId,
    pub scene: Arc<Scene>,
    pub state: Arc<State>,
    pub wake: Arc<Notify>,
}

impl Conductor {
    /// The task of a scene that is loaded on the device and deformed to `beginning.state`. Also returns the channel
    /// that carries the last completed step.
    pub(super) fn new(beginning: Beginning, means: Means) -> (Self, watch::Receiver<Option<StepName>>) {
        let Beginning { name, id, scene, state, wake } = beginning;
        let has_step = state.run > 0;
        let (last_step, told) = watch::channel(has_step.then(|| StepName::of(&state)));
        let conductor = Self {
            name,
            id,
            scene,
            means,
            run: state.run,
            state,
            count: u64::from(has_step),
            writer: None,
            viewers: Vec::new(),
            asks: Vec::new(),
            pending: None,
            stages: Vec::new(),
            late: VecDeque::new(),
            surface: None,
            last_step,
            wake,
        };
        (conductor, told)
    }

    /// Runs until it receives `Stop` or every sender of the mailbox is dropped.
    pub(super) async fn conduct(mut self, mut mailbox: mpsc::Receiver<Message>) {
        let (error, done) = loop {
            self.tend().await;
            let stall = self.next_stall();
            tokio::select! {
                // Biased, so that a request sent before a step is registered when the step completes. Each iteration
                // calls `tend`, so messages do not starve steps.
                biased;
                message = mailbox.recv() => match message {
                    Some(Message::Stop { error, done }) => break (error, Some(done)),
                    Some(message) => self.receive(message),
                    None => break (stopped(), None),
                },
                () = self.wake.notified() => {}
                () = sleep_until(stall) => {}
            }
        };
        self.end(error).await;
        drop(mailbox);
        if let Some(done) = done {
            done.send(()).ok(); // Fails only if the caller no longer waits.
        }
    }

    /// Delivers everything that can be delivered now and computes at most one step.
    async fn tend(&mut self) {
        self.answer_asks().await;
        let holds_back = self.holds_back();
        self.serve_viewers(holds_back).await;
        if self.is_held() {
            return self.settle().await;
        }
        let done = self.pending.take().map(|(lane, step)| Done { lane, step, stages: self.stages.clone() });
        match self.late.back_mut().filter(|late| late.count == self.count) {
            // Acknowledge the step after its last readback in flight.
            Some(late) => late.done = done.or(late.done.take()),
            None => {
                self.settle().await;
                acknowledge(done);
            }
        }
        if self.writer.as_ref().is_some_and(|writer| writer.lane.is_closed()) {
            self.writer = None;
        }
        let lane = self.writer.as_ref().map(|writer| Arc::clone(&writer.lane));
        match lane.and_then(|lane| Some((lane.take()?, lane))) {
            Some((waiting, lane)) => {
                self.step(lane, waiting).await;
                // There may be more work; handle waiting messages first.
                self.wake.notify_one();
            }
            None => self.settle().await,
        }
    }

    /// Computes the next step while readbacks are in flight. When this returns, only frames of the step before it may
    /// still be in flight.
    async fn step(&mut self, lane: Arc<Lane>, waiting: Waiting) {
        let mut stages = waiting.stages();
        let number = waiting.update.number;
        let mut next = State::clone(&self.state);
        next.run = self.run;
        next.apply(&self.scene, &waiting.update);
        let next = Arc::new(next);
        let mut deforming = self.means.worker.deform(self.id, &next);
        self.settle_vertices().await;
        let deformed = loop {
            tokio::select! {
                biased;
                deformed = deforming.there() => break deformed,
                () = self.settle_oldest(), if !self.late.is_empty() => {}
            }
        };
        self.settle_before(self.count).await;
        match deformed {
            Ok(deformed) => {
                stages.push((Stage::Deform, deformed.ms));
                self.stages = stages;
                self.means.keeper.note(&self.name, &next);
                self.last_step.send_replace(Some(StepName::of(&next)));
                self.state = next;
                self.surface = None;
                self.count += 1 + waiting.merged;
                self.pending = Some((lane, number));
            }
            Err(error) => {
                // Reports are ordered, so the acknowledgements of earlier steps come first.
                self.settle().await;
                lane.report(number, Err(error));
            }
        }
    }

    fn receive(&mut self, message: Message) {
        // A failed send below means that the caller no longer waits; its reply is dropped.
        match message {
            Message::Drive { who, policy, window, reply } => {
                reply.send(self.admit(who, policy, window)).ok();
            }
            Message::Watch { viewer, reply } => {
                reply.send(self.seat(viewer)).ok();
            }
            Message::Ask(ask) => {
                self.asks.retain(|ask| !ask.reply.is_closed());
                let limit = self.means.config.waiting;
                if self.asks.len() < limit {
                    self.asks.push(ask);
                } else {
                    ask.reply.send(Err(Error::Busy { queue: "requests that wait for a step", limit })).ok();
                }
            }
            // Handled in `conduct`.
            Message::Stop { .. } => {}
        }
    }

    /// Admits one writer at a time; a writer whose queue is closed is replaced.
    fn admit(&mut self, who: String, policy: Policy, window: u32) -> Result<(Place, u64)> {
        if let Some(writer) = self.writer.as_ref().filter(|writer| !writer.lane.is_closed()) {
            let seconds = writer.since.elapsed().as_secs();
            let holder = format!("{} has driven run {} for {seconds} s", writer.who, self.run);
            return Err(Error::Taken { what: "the writer's place of the scene", holder });
        }
        self.run += 1;
        let lane = Arc::new(Lane::new(policy, window, Arc::clone(&self.wake)));
        self.writer = Some(Writer { lane: Arc::clone(&lane), who, since: Instant::now() });
        Ok((Place(lane), self.run))
    }

    fn seat(&mut self, mut viewer: Viewer) -> Result<()> {
        self.viewers.retain(|viewer| !viewer.is_gone());
        let limit = self.means.config.subscribers;
        if self.viewers.len() >= limit {
            return Err(Error::Busy { queue: "subscribers of the scene", limit });
        }
        let shows_current = viewer.delivery == Delivery::Latest && self.state.run > 0;
        viewer.seen = if shows_current { self.count.saturating_sub(1) } else { self.count };
        self.viewers.push(viewer);
        Ok(())
    }

    /// Whether another step is queued. If so, readbacks of the current step are only begun and overlap with computing
    /// it.
    pub(super) fn has_next(&self) -> bool {
        self.writer.as_ref().is_some_and(|writer| !writer.lane.is_closed() && writer.lane.has_waiting())
    }

    /// Whether lossless viewers exert back-pressure: only if the pending step's writer is lossless and still connected.
    fn holds_back(&self) -> bool {
        self.pending.as_ref().is_some_and(|(lane, _)| lane.policy() == Policy::Lossless && !lane.is_closed())
    }

    fn is_held(&self) -> bool {
        let owes = |viewer: &Viewer| viewer.delivery == Delivery::Lossless && viewer.seen < self.count;
        self.holds_back() && self.viewers.iter().any(owes)
    }

    /// Deadline at which the viewer that has blocked the writer for the longest is cut off.
    fn next_stall(&self) -> Option<Instant> {
        let first = self.viewers.iter().filter_map(|viewer| viewer.stalled).min()?;
        Some(first + self.means.config.stall)
    }

    /// Whether a request can be answered now.
    ///
    /// # Errors
    /// `Gone` when the scene has passed the exact step that is asked for.
    pub(super) fn is_ready(&self, which: Which) -> Result<bool> {
        let of_this_run = self.state.run == self.run && self.run > 0;
        let here = of_this_run.then_some(self.state.step);
        match (which, here) {
            (Which::Current, _) => Ok(true),
            (Which::Exact(want), Some(here)) if here > want => Err(Error::Gone {
                what: "exact_step",
                expected: format!("{here}, the step that scene '{}' shows, or a later one", self.name),
                given: want.to_string(),
            }),
            (Which::Exact(want), Some(here)) => Ok(here == want),
            (Which::Minimum(want), Some(here)) => Ok(here >= want),
            (Which::Exact(_) | Which::Minimum(_), None) => Ok(false),
        }
    }

    async fn end(mut self, error: Error) {
        self.settle().await;
        if let Some(writer) = &self.writer {
            if let Some((lane, step)) = self.pending.take() {
                lane.report(step, Ok(self.stages.clone()));
            }
            writer.lane.end(error.clone());
        }
        self.viewers.iter().for_each(|viewer| viewer.end(error.clone()));
        self.viewers.clear();
        for ask in self.asks.drain(..) {
            ask.reply.send(Err(error.clone())).ok(); // Fails only if the caller no longer waits.
        }
        // Fails only if the device thread has ended, which frees the scene too.
        self.means.worker.unstage(self.id).await.ok();
    }
}

pub(super) fn acknowledge(done: Option<Done>) {
    if let Some(Done { lane, step, stages }) = done {
        lane.report(step, Ok(stages));
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
