//! Messages from the handle of a scene to its actor.

use tokio::sync::oneshot;

use super::lease::{AcquiredLease, LeaseRequest};
use super::subscriber::Subscriber;
use crate::engine::output::output_spec::OutputSpec;
use crate::engine::output::step_output::StepOutput;
use modalcast_model::error::{Error, Result};

/// The step that a single request asks for. A run is the sequence of steps from one writer; run 0 selects that of the
/// latest writer. All steps of a later run come after those of an earlier one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum StepSelector {
    Current,
    /// The step with this run and number.
    Exact {
        run: u64,
        number: u64,
    },
    /// The first current step that has at least this run and number.
    Minimum {
        run: u64,
        number: u64,
    },
}

/// A single request that is waiting for its step.
#[derive(Debug)]
pub(super) struct StepRequest {
    pub selector: StepSelector,
    pub spec: OutputSpec,
    pub reply: oneshot::Sender<Result<StepOutput>>,
}

/// A message to a scene's actor. The mailbox is bounded. When it is full, `Stop` waits for capacity and every other
/// message is answered with `Busy`.
pub(super) enum Message {
    AcquireWriter {
        request: LeaseRequest,
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
