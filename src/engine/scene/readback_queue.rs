//! Device-to-host readbacks in flight. Vertices are read back while the next step is computed; frames are drawn and
//! read back while the next step is computed and its own frames are submitted. Readbacks are delivered in order as they
//! complete. In the diagrams `read` is the transfer of the pixels to host-readable memory.
//!
//! A deformer with its own vertex memory computes concurrently with the frames in flight:
//!
//! ```text
//! deformer  [deform k+1  ]          [deform k+2  ]
//! OpenGL    [draw k][read k][upload][draw k+1][read k+1][upload]
//! ```
//!
//! A deformer that writes into OpenGL buffers does not: mapping them is ordered after all OpenGL commands issued before
//! (`gpu::interop`), including the readback of frame k. Only the host's work overlaps. Step k+1 is recorded and
//! submitted while frame k is drawn, and starts on the device as soon as frame k is read. Frame k is copied out,
//! encoded and sent while frame k+1 is drawn.
//!
//! ```text
//! device    [draw k][read k][deform k+1] [draw k+1][read k+1][deform k+2]
//! host      [submit k+1]                 [submit k+2]
//! frame k                                [copy out, encode, send]
//! ```

use std::sync::Arc;

use super::actor::{CompletedStep, SceneActor, acknowledge};
use super::output_delivery::stage_times_of_passes;
use super::subscriber::{SendPermit, Subscriber};
use crate::engine::device::command::TimedVertices;
use crate::engine::device::handle::PendingReply;
use crate::engine::output::step_output::{FrameOutput, OutputBody, OutputSpec, StepId, StepOutput};
use crate::telemetry::{Stage, StageTimes};
use modalcast_model::error::Result;
use modalcast_model::scene::{Camera, FloatingOrigins, FrameSize};
use modalcast_render::{FrameImage, MAX_FRAMES_IN_FLIGHT};

/// A device-to-host readback in flight and its subscribers.
pub(in crate::engine) struct PendingReadback {
    readback: Readback,
    /// The scene's step count when the readback was started.
    pub count: u64,
    step: StepId,
    stages: StageTimes,
    origins: Option<Arc<FloatingOrigins>>,
    /// A reserved slot per subscriber, and the number of steps that the subscriber skipped.
    permits: Vec<(SendPermit, u64)>,
    /// The step's acknowledgement, attached to the last readback of the step and sent after it.
    pub done: Option<CompletedStep>,
}

/// The pending result of a readback.
pub(in crate::engine) enum Readback {
    Vertices(PendingReply<TimedVertices>),
    Frame(OutputSpec, PendingReply<FrameImage>),
}

impl Readback {
    fn is_frame_of(&self, wanted: &OutputSpec) -> bool {
        matches!(self, Self::Frame(spec, _) if spec == wanted)
    }

    /// Waits for the result; returns it with its stage times. Cancel-safe.
    async fn recv(&mut self) -> Result<(OutputBody, StageTimes)> {
        match self {
            Self::Vertices(copying) => {
                let (surface, ms) = copying.recv().await?;
                Ok((OutputBody::Vertices(surface), vec![(Stage::Copy, ms)]))
            }
            Self::Frame(_, drawing) => {
                let image = drawing.recv().await?;
                let stages = stage_times_of_passes(&image.passes);
                Ok((OutputBody::Frame(Arc::new(image.into())), stages))
            }
        }
    }
}

impl SceneActor {
    /// A readback of the current step that was just started.
    pub(in crate::engine) fn new_readback(
        &self,
        readback: Readback,
        permits: Vec<(SendPermit, u64)>,
    ) -> PendingReadback {
        PendingReadback {
            readback,
            count: self.count,
            step: StepId::of(&self.state),
            stages: self.stages.clone(),
            origins: self.state.origins.clone(),
            permits,
            done: None,
        }
    }

    /// Subscribes a viewer with capacity to a frame of the current step that is delivered asynchronously: a frame of
    /// the same view in flight for another viewer, else a new frame, unless [`MAX_FRAMES_IN_FLIGHT`] were begun already.
    /// `begun` holds frames of this step that are not in the queue of readbacks yet. Returns whether the viewer gets a
    /// frame.
    pub(in crate::engine) fn begin_frame(
        &mut self,
        subscriber: &mut Subscriber,
        begun: &mut Vec<PendingReadback>,
    ) -> bool {
        let Some((camera, size)) = subscriber.spec.frame() else { return false };
        if subscriber.delivered_count == self.count || !subscriber.has_credit() {
            return false;
        }
        let count = self.count;
        let of_view =
            |pending: &&mut PendingReadback| pending.count == count && pending.readback.is_frame_of(&subscriber.spec);
        if let Some(shared) = self.in_flight.iter_mut().chain(begun.iter_mut()).find(of_view) {
            let skipped = subscriber.mark_delivered(count);
            shared.permits.push((subscriber.take_permit(), skipped));
            return true;
        }
        if begun.len() >= MAX_FRAMES_IN_FLIGHT {
            return false;
        }
        let skipped = subscriber.mark_delivered(count);
        let drawing = self.services.device_handle.begin_draw(self.id, camera, size);
        begun.push(
            self.new_readback(Readback::Frame(subscriber.spec, drawing), vec![(subscriber.take_permit(), skipped)]),
        );
        true
    }

    /// Waits for the oldest readback in flight and delivers it. Cancel-safe.
    pub(in crate::engine) async fn deliver_oldest_readback(&mut self) {
        let Some(pending) = self.in_flight.front_mut() else { return };
        let result = pending.readback.recv().await;
        let Some(PendingReadback { step, stages, origins, permits, done, .. }) = self.in_flight.pop_front() else {
            return;
        };
        for (permit, skipped) in permits {
            let (before, origins) = (stages.clone(), origins.clone());
            let output = result.clone().map(|(body, own)| {
                let stages = before.into_iter().chain(own).collect();
                StepOutput { step, skipped, stages, origins, body }
            });
            permit.send(output);
        }
        self.subscribers.retain(|subscriber| !subscriber.is_closed());
        acknowledge(done);
    }

    /// Delivers all readbacks of steps whose count is below `count`.
    pub(in crate::engine) async fn flush_readbacks_before(&mut self, count: u64) {
        while self.in_flight.front().is_some_and(|pending| pending.count < count) {
            self.deliver_oldest_readback().await;
        }
    }

    /// Delivers all readbacks in flight.
    pub(in crate::engine) async fn flush_readbacks(&mut self) {
        self.flush_readbacks_before(u64::MAX).await;
    }

    /// Delivers readbacks until no vertices are in flight. The submission of the next step does not wait for vertices,
    /// but its results must not overtake them.
    pub(in crate::engine) async fn flush_vertex_readbacks(&mut self) {
        while self.in_flight.iter().any(|pending| matches!(pending.readback, Readback::Vertices(_))) {
            self.deliver_oldest_readback().await;
        }
    }

    /// Delivers readbacks until none is in flight for `subscriber`, so that the viewer can then be served synchronously.
    pub(in crate::engine) async fn flush_readbacks_for(&mut self, subscriber: &Subscriber) {
        while self
            .in_flight
            .iter()
            .any(|pending| pending.permits.iter().any(|(permit, _)| permit.belongs_to(subscriber)))
        {
            self.deliver_oldest_readback().await;
        }
    }
}

impl OutputSpec {
    /// Camera and size in pixels of a color frame; `None` for other views.
    const fn frame(&self) -> Option<(Camera, FrameSize)> {
        match *self {
            Self::Frame { camera, size, frame_output: FrameOutput::Color } => Some((camera, size)),
            _ => None,
        }
    }
}
