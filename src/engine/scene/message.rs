//! Messages from the handle of a scene to its actor.

use tokio::sync::oneshot;

use super::step_queue::{Policy, WriterLease};
use super::subscriber::Subscriber;
use crate::engine::output::step_output::{OutputSpec, StepOutput};
use modalcast_model::error::{Error, Result};

/// The step that a single request asks for. Step numbers refer to the current run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum StepSelector {
    Current,
    /// The step with this number.
    Exact(u64),
    /// The current step, as soon as its number is at least this one.
    Minimum(u64),
}

/// A single request that is waiting for its step.
#[derive(Debug)]
pub(super) struct StepRequest {
    pub selector: StepSelector,
    pub spec: OutputSpec,
    pub reply: oneshot::Sender<Result<StepOutput>>,
}

/// The writer lease and the run that it begins.
#[derive(Debug)]
pub(super) struct AcquiredLease {
    pub lease: WriterLease,
    /// The writer is the scene's `run`-th writer, counted from 1.
    pub run: u64,
}

/// A message to a scene's actor. The mailbox is bounded. When it is full, `Stop` waits for capacity and every other
/// message is answered with `Busy`.
pub(super) enum Message {
    AcquireWriter {
        peer: String,
        policy: Policy,
        window: u32,
        reply: oneshot::Sender<Result<AcquiredLease>>,
    },
    Subscribe {
        subscriber: Subscriber,
        reply: oneshot::Sender<Result<()>>,
    },
    Request(StepRequest),
    Stop {
        error: Error,
        /// Notified after the scene is freed.
        done: oneshot::Sender<()>,
    },
    /// Makes the actor panic.
    #[cfg(test)]
    Panic,
}
