//! Device-to-host readbacks in flight. Vertices are read back while the next step is computed. Frames are drawn and
//! read back while the next step is computed and the frames of the next step are submitted. Readbacks are delivered in
//! the order in which they were started. In the diagrams, `k` is the number of a step, `read` is the transfer of the
//! pixels to host-readable memory, and `upload` is the copy of the new vertices into OpenGL buffers.
//!
//! Deformers have their own vertex memory, so they compute concurrently with the frames in flight. `upload` is ordered
//! after the readback of frame k. Frame k is copied out, encoded and sent while frame k+1 is drawn.
//!
//! ```text
//! deformer  [deform k+1  ]          [deform k+2  ]
//! OpenGL    [draw k][read k][upload][draw k+1][read k+1][upload]
//! frame k                           [copy out, encode, send]
//! ```

use std::collections::VecDeque;
use std::sync::Arc;

use super::current_step::CurrentStep;
use super::step_queue::CompletedStep;
use super::subscriber::{SendPermit, Subscriber};
use crate::engine::device::command::CopiedVertices;
use crate::engine::device::handle::PendingReply;
use crate::engine::output::step_output::{OutputBody, OutputSpec, StepId, StepOutput, stage_times};
use crate::telemetry::{Stage, StageTimes};
use modalcast_model::error::Result;
use modalcast_model::scene::FloatingOrigins;
use modalcast_render::FrameImage;

/// The pending result of a readback.
pub(super) enum Readback {
    Vertices(PendingReply<CopiedVertices>),
    Frame(OutputSpec, PendingReply<FrameImage>),
}

impl Readback {
    /// Waits for the result; returns it with its stage times. Cancel-safe.
    async fn recv(&mut self) -> Result<(OutputBody, StageTimes)> {
        match self {
            Self::Vertices(pending_vertices) => {
                let CopiedVertices { surface, copy_ms } = pending_vertices.recv().await?;
                Ok((OutputBody::Vertices(surface), vec![(Stage::Copy, copy_ms)]))
            }
            Self::Frame(_, pending_image) => {
                let image = pending_image.recv().await?;
                let stages = stage_times(&image.times);
                Ok((OutputBody::Frame(Arc::new(image.into())), stages))
            }
        }
    }
}

/// A subscriber of a readback in flight.
#[derive(Debug)]
pub(super) struct Recipient {
    permit: SendPermit,
    /// Steps that the subscriber skipped since its last result.
    skipped: u64,
}

impl Recipient {
    /// Takes one of the subscriber's credits, and marks the scene's `step_count`-th step as delivered to it.
    pub(super) fn take_credit_of(subscriber: &mut Subscriber, step_count: u64) -> Self {
        Self { skipped: subscriber.mark_delivered(step_count), permit: subscriber.take_permit() }
    }
}

/// A device-to-host readback in flight and its subscribers.
pub(super) struct PendingReadback {
    readback: Readback,
    /// The scene's step count when the readback was started.
    step_count: u64,
    step: StepId,
    stages: StageTimes,
    origins: Option<Arc<FloatingOrigins>>,
    recipients: Vec<Recipient>,
    /// The step that is acknowledged after this readback, if this is the last readback of the step.
    step_to_acknowledge: Option<CompletedStep>,
}

impl PendingReadback {
    /// A readback of the current step that was just started.
    pub(super) fn new(current: &CurrentStep, readback: Readback, recipients: Vec<Recipient>) -> Self {
        Self {
            readback,
            step_count: current.step_count,
            step: current.id(),
            stages: current.stages.clone(),
            origins: current.state.origins.clone(),
            recipients,
            step_to_acknowledge: None,
        }
    }

    /// Whether this is a color frame of the view in the scene's `step_count`-th step.
    pub(super) fn is_frame_of(&self, step_count: u64, view: &OutputSpec) -> bool {
        self.step_count == step_count && matches!(&self.readback, Readback::Frame(spec, _) if spec == view)
    }

    pub(super) fn add_recipient(&mut self, recipient: Recipient) {
        self.recipients.push(recipient);
    }

    fn is_for(&self, subscriber: &Subscriber) -> bool {
        self.recipients.iter().any(|recipient| recipient.permit.belongs_to(subscriber))
    }
}

/// Readbacks in flight, oldest first: those of the current step, and frames of the step before it.
#[derive(Default)]
pub(super) struct ReadbackQueue {
    pending: VecDeque<PendingReadback>,
}

impl ReadbackQueue {
    pub(super) fn is_empty(&self) -> bool {
        self.pending.is_empty()
    }

    pub(super) fn push(&mut self, readback: PendingReadback) {
        self.pending.push_back(readback);
    }

    pub(super) fn iter_mut(&mut self) -> impl Iterator<Item = &mut PendingReadback> {
        self.pending.iter_mut()
    }

    /// Attaches the acknowledgement of a step to its last readback in flight. Returns the step if it has no readback in
    /// flight.
    pub(super) fn attach_acknowledgement(&mut self, step_count: u64, step: CompletedStep) -> Option<CompletedStep> {
        match self.pending.back_mut().filter(|newest| newest.step_count == step_count) {
            Some(newest) => {
                newest.step_to_acknowledge = Some(step);
                None
            }
            None => Some(step),
        }
    }

    /// Waits for the oldest readback and delivers it. Cancel-safe.
    pub(super) async fn deliver_oldest(&mut self) {
        let Some(oldest) = self.pending.front_mut() else { return };
        let result = oldest.readback.recv().await;
        let Some(PendingReadback { step, stages, origins, recipients, step_to_acknowledge, .. }) =
            self.pending.pop_front()
        else {
            return;
        };
        for Recipient { permit, skipped } in recipients {
            let (step_stages, origins) = (stages.clone(), origins.clone());
            let output = result.clone().map(|(body, readback_stages)| {
                let stages = step_stages.into_iter().chain(readback_stages).collect();
                StepOutput { step, skipped, stages, origins, body }
            });
            permit.send(output);
        }
        if let Some(step) = step_to_acknowledge {
            step.acknowledge();
        }
    }

    /// Delivers all readbacks of the steps before the scene's `step_count`-th step.
    pub(super) async fn flush_before(&mut self, step_count: u64) {
        while self.pending.front().is_some_and(|pending| pending.step_count < step_count) {
            self.deliver_oldest().await;
        }
    }

    /// Delivers all readbacks.
    pub(super) async fn flush(&mut self) {
        self.flush_before(u64::MAX).await;
    }

    /// Delivers readbacks until no vertices are in flight, so that the results of the next step, which is already
    /// submitted, cannot overtake these vertices.
    pub(super) async fn flush_vertices(&mut self) {
        while self.pending.iter().any(|pending| matches!(pending.readback, Readback::Vertices(_))) {
            self.deliver_oldest().await;
        }
    }

    /// Delivers readbacks until none is in flight for `subscriber`, so that it can then be served synchronously.
    pub(super) async fn flush_for(&mut self, subscriber: &Subscriber) {
        while self.pending.iter().any(|pending| pending.is_for(subscriber)) {
            self.deliver_oldest().await;
        }
    }
}
