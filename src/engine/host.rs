//! Handle to one open scene: its immutable description and a sender to the bounded mailbox of its task.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use tokio::sync::mpsc::error::TrySendError;
use tokio::sync::{Notify, mpsc, oneshot, watch};

use super::command::SceneId;
use super::conductor::{Ask, Beginning, Conductor, Means, Message, Which};
use super::lane::{Place, Policy, Report, Waiting};
use super::ledger::Origin;
use super::viewer::{Delivery, Feed, Shown, StepName, View};
use crate::telemetry::ms_since;
use modalcast_model::error::{Error, Result, invalid};
use modalcast_model::scene::{RawUpdate, Scene, State, Update};

/// Capacity of a scene's mailbox in messages.
const MAILBOX: usize = 128;

/// Handle to an open scene.
#[derive(Debug)]
pub struct Host {
    pub name: String,
    pub origin: Origin,
    pub scene: Arc<Scene>,
    /// The reason why no frame can be drawn; `None` if frames can be drawn.
    no_frames: Option<Error>,
    largest_window: u32,
    mailbox: mpsc::Sender<Message>,
    last_step: watch::Receiver<Option<StepName>>,
    wake: Arc<Notify>,
    closing: AtomicBool,
}

/// Arguments of [`Host::open`].
pub(super) struct Opening {
    pub name: String,
    pub origin: Origin,
    pub scene: Arc<Scene>,
    pub id: SceneId,
    /// The state restored from a checkpoint, if there is one.
    pub state: Option<State>,
    pub no_frames: Option<Error>,
}

impl Host {
    /// Loads a scene onto the device, restores its state and starts its task. An unusable restored state is logged and
    /// replaced by the rest state.
    ///
    /// # Errors
    /// `Fault` of the device, `Invalid` when the rest state overflows, `Busy` when the command queue is full.
    pub(super) async fn open(opening: Opening, means: Means) -> Result<Self> {
        let Opening { name, origin, scene, id, state, no_frames } = opening;
        means.worker.stage(id, &scene).await?;
        let state = match state.map(Arc::new) {
            Some(state) => match means.worker.deform(id, &state).wait().await {
                Ok(_) => state,
                Err(error) => {
                    tracing::warn!(scene = name, %error, "the kept step is not usable; the scene begins at rest");
                    Arc::new(State::rest(&scene))
                }
            },
            None => Arc::new(State::rest(&scene)),
        };
        let wake = Arc::new(Notify::new());
        let largest_window = means.config.largest_window;
        let beginning = Beginning { name: name.clone(), id, scene: Arc::clone(&scene), state, wake: Arc::clone(&wake) };
        let (conductor, last_step) = Conductor::new(beginning, means);
        let (mailbox, inbox) = mpsc::channel(MAILBOX);
        tokio::spawn(conductor.conduct(inbox));
        let closing = AtomicBool::new(false);
        Ok(Self { name, origin, scene, no_frames, largest_window, mailbox, last_step, wake, closing })
    }

    /// The last completed step, if there is one.
    pub fn last_step(&self) -> Option<StepName> {
        *self.last_step.borrow()
    }

    /// Acquires the writer lease. The window is clamped to 1 through the configured limit.
    ///
    /// # Errors
    /// `Taken` naming the current writer and how long it has held the lease; `NotFound` when the scene is closed;
    /// `Busy` when the mailbox is full.
    pub async fn drive(&self, who: String, policy: Policy, window: u32) -> Result<Drive> {
        let window = window.clamp(1, self.largest_window);
        let (place, run) = self.tell(|reply| Message::Drive { who, policy, window, reply }).await?;
        tracing::info!(scene = self.name, run, ?policy, "driven by a new writer");
        Ok(Drive { place, scene: Arc::clone(&self.scene), run, window, policy, last: None })
    }

    /// Subscribes to the scene's steps. The subscription is active when this returns.
    ///
    /// # Errors
    /// `Unavailable` when frames are requested and there is no renderer; `Busy` when there are too many subscribers or
    /// the mailbox is full; `NotFound` when the scene is closed.
    pub async fn watch(&self, view: View, delivery: Delivery) -> Result<Feed> {
        self.check_view(&view)?;
        let (viewer, feed) = Feed::new(view, delivery, Arc::clone(&self.wake));
        self.tell(|reply| Message::Watch { viewer, reply }).await?;
        Ok(feed)
    }

    /// Waits for a step and returns a result of it. Dropping the future cancels the request before it is drawn.
    ///
    /// # Errors
    /// `Gone` when the exact step has passed; `Unavailable` when there is no renderer; `Busy` when too many requests
    /// wait; `NotFound` when the scene is closed.
    pub async fn show(&self, which: Which, view: View) -> Result<Shown> {
        self.check_view(&view)?;
        self.tell(|reply| Message::Ask(Ask { which, view, reply })).await
    }

    /// Ends every stream of the scene with `error` and frees the scene. Returns after the scene is freed.
    pub(super) async fn stop(&self, error: Error) {
        self.closing.store(true, Ordering::Release);
        let (done, stopped) = oneshot::channel();
        // A closed mailbox means that the scene's task has already ended.
        if self.mailbox.send(Message::Stop { error, done }).await.is_ok() {
            stopped.await.ok();
        }
    }

    /// Whether [`Self::stop`] was called.
    pub(super) fn is_closing(&self) -> bool {
        self.closing.load(Ordering::Acquire)
    }

    fn check_view(&self, view: &View) -> Result<()> {
        match (view, &self.no_frames) {
            (View::Frame { .. } | View::Pick { .. }, Some(error)) => Err(error.clone()),
            _ => Ok(()),
        }
    }

    async fn tell<T>(&self, make: impl FnOnce(oneshot::Sender<Result<T>>) -> Message) -> Result<T> {
        let gone = || Error::NotFound { what: "scene", given: format!("'{}', which was closed", self.name) };
        let (reply, answer) = oneshot::channel();
        match self.mailbox.try_send(make(reply)) {
            Ok(()) => answer.await.map_err(|_| gone())?,
            Err(TrySendError::Full(_)) => Err(Error::Busy { queue: "requests to the scene", limit: MAILBOX }),
            Err(TrySendError::Closed(_)) => Err(gone()),
        }
    }
}

/// The writer's handle to a scene. Dropping it releases the writer lease.
#[derive(Debug)]
pub struct Drive {
    place: Place,
    scene: Arc<Scene>,
    /// Number of this writer among the scene's writers, from 1.
    pub run: u64,
    /// Steps that may be unacknowledged at a time.
    pub window: u32,
    pub policy: Policy,
    last: Option<u64>,
}

impl Drive {
    /// Checks and queues a step. A rejected step has no effect.
    ///
    /// # Errors
    /// `Invalid` with field, expected and given for a malformed step or one beyond the window; or the error with which
    /// the server ended the stream.
    pub fn step(&mut self, raw: &RawUpdate) -> Result<()> {
        let begin = Instant::now();
        if let Some(last) = self.last.filter(|last| raw.number <= *last) {
            return Err(invalid("step.number", format!("a number above {last}"), raw.number));
        }
        let update = Update::parse(&self.scene, raw)?;
        self.place.0.offer(Waiting::new(update, ms_since(begin)))?;
        self.last = Some(raw.number);
        Ok(())
    }

    /// Waits for the next report. Cancel-safe.
    ///
    /// # Errors
    /// The error with which the server ended the stream, after all reports.
    pub async fn next_report(&self) -> Result<Report> {
        self.place.0.next_report().await
    }

    /// Whether every accepted step is reported and every report is taken.
    pub fn is_drained(&self) -> bool {
        self.place.0.is_drained()
    }

    /// Whether the server has ended the stream.
    pub fn is_ended(&self) -> bool {
        self.place.0.is_closed()
    }
}
