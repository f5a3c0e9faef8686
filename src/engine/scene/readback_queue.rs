//! Device-to-host readbacks in flight. Vertices are read back while the next step is computed. Frames are drawn and
//! read back while the next step is computed and the frames of the next step are submitted. Readbacks are delivered in
//! the order in which they were started. In the diagrams, `k` is the number of a step, `read` is the transfer of the
//! pixels to host-readable memory, and `upload` is the copy of the new vertices into OpenGL buffers.
//!
//! A deformer whose vertices are uploaded computes concurrently with the frames in flight:
//!
//! ```text
//! deformer  [deform k+1  ]          [deform k+2  ]
//! OpenGL    [draw k][read k][upload][draw k+1][read k+1][upload]
//! ```
//!
//! If OpenGL and CUDA share memory, CUDA deforms steps while OpenGL draws earlier frames, and its copy engine reads the
//! frames before them. CUDA deforms two steps at once if the second one is queued, because the GPU needs 0.2 ms for each
//! change between the contexts of OpenGL and CUDA. OpenGL copies the vertices of a step at the beginning of its frame, so
//! that four sets of vertices are sufficient.
//!
//! ```text
//! OpenGL       [draw k][draw k+1]                [draw k+2][draw k+3]
//! CUDA                           [deform k+2, k+3]                   [deform k+4, k+5]
//! copy engine          [read k]  [read k+1]                [read k+2][read k+3]
//! ```
//!
//! If CUDA maps OpenGL's buffers instead, a step and the copy of its vertices are submitted together while every step
//! is drawn. Both wait for all earlier OpenGL commands, including the readback of frame k, so only the host's work
//! overlaps. Frame k is copied out, encoded and sent while frame k+1 is drawn.
//!
//! ```text
//! device    [draw k][read k][deform k+1, copy] [draw k+1][read k+1][deform k+2, copy]
//! host      [submit k+1]                       [submit k+2]
//! frame k                                      [copy out, encode, send]
//! ```

use std::collections::VecDeque;
use std::future::poll_fn;
use std::pin::Pin;
use std::sync::{Arc, Mutex};
use std::task::Poll;

use super::current_step::CurrentStep;
use super::frame_stream::CameraState;
use super::step_queue::CompletedStep;
use super::subscriber::{SendPermit, Subscriber};
use crate::engine::device::command::CopiedVertices;
use crate::engine::device::handle::PendingReply;
use crate::engine::lock::lock;
use crate::engine::output::rendered_picture::RenderedPicture;
use crate::engine::output::step_output::{OutputBody, PictureContent, PictureSpec, StepFrames, StepId, StepOutput};
use crate::engine::output::step_vertices::StepVertices;
use crate::telemetry::{Stage, StageTimes};
use modalcast_model::deform::VertexAttributes;
use modalcast_model::error::Result;
use modalcast_model::scene::FloatingOrigins;
use modalcast_render::{FrameImage, FramePixels};

/// A subscriber that waits for one result of the current step.
#[derive(Debug)]
pub(super) struct Recipient {
    permit: SendPermit,
    step: StepId,
    /// Steps that the subscriber skipped since its last result.
    skipped: u64,
    /// Stage times up to the deformation.
    stages: StageTimes,
    origins: Option<Arc<FloatingOrigins>>,
}

impl Recipient {
    /// Takes one of the subscriber's credits, each of which permits one result, and marks the current step as delivered
    /// to it.
    pub(super) fn take_credit_of(subscriber: &mut Subscriber, current: &CurrentStep) -> Self {
        Self {
            skipped: subscriber.mark_delivered(current.step_count),
            permit: subscriber.take_permit(),
            step: current.id(),
            stages: current.stages.clone(),
            origins: current.state.origins.clone(),
        }
    }

    /// Sends the result with the stage times of the readback. An error ends the subscription.
    fn send(self, result: Result<(OutputBody, StageTimes)>) {
        let Self { permit, step, skipped, mut stages, origins } = self;
        permit.send(result.map(|(body, readback_stages)| {
            stages.extend(readback_stages);
            StepOutput { step, skipped, stages, origins, body }
        }));
    }
}

/// The pictures of one step for one subscriber. They are sent together as soon as the last one is there.
#[derive(Debug, Clone)]
pub(super) struct PendingFrames(Arc<Mutex<CollectedPictures>>);

#[derive(Debug)]
struct CollectedPictures {
    /// `None` after the pictures or an error were sent.
    recipient: Option<Recipient>,
    /// In the order of the request; `None` for a picture that is not there yet.
    pictures: Vec<Option<Arc<RenderedPicture>>>,
    camera_version: u64,
}

impl PendingFrames {
    /// Frames of the pictures in `cameras`, none of which is there yet.
    pub(super) fn new(recipient: Recipient, cameras: &CameraState) -> Self {
        let CameraState { pictures, camera_version } = cameras;
        let collected = CollectedPictures {
            recipient: Some(recipient),
            pictures: vec![None; pictures.len()],
            camera_version: *camera_version,
        };
        Self(Arc::new(Mutex::new(collected)))
    }

    /// The part of these frames that receives the picture at an index.
    pub(super) fn picture(&self, index: usize) -> PictureRecipient {
        PictureRecipient { frames: self.clone(), index }
    }
}

/// A part of [`PendingFrames`].
#[derive(Debug)]
pub(super) struct PictureRecipient {
    frames: PendingFrames,
    index: usize,
}

impl PictureRecipient {
    /// Adds the picture, and sends all pictures if it is the last one. Sends an error at once.
    pub(super) fn receive(self, picture: Result<Arc<RenderedPicture>>) {
        let mut collected = lock(&self.frames.0);
        let frames = match picture {
            Ok(picture) => {
                collected.pictures[self.index] = Some(picture);
                collected.pictures.iter().cloned().collect::<Option<Vec<_>>>().map(Ok)
            }
            Err(error) => Some(Err(error)),
        };
        if let Some(frames) = frames
            && let Some(recipient) = collected.recipient.take()
        {
            let camera_version = collected.camera_version;
            recipient
                .send(frames.map(|pictures| (OutputBody::Frames(StepFrames { pictures, camera_version }), Vec::new())));
        }
    }

    fn is_for(&self, subscriber: &Subscriber) -> bool {
        lock(&self.frames.0).recipient.as_ref().is_some_and(|recipient| recipient.permit.belongs_to(subscriber))
    }

    /// Waits until the subscriber no longer waits for the pictures.
    pub(super) fn cancelled(&self) -> impl Future<Output = ()> + Send + use<> {
        // Without a recipient, an error was sent instead of the pictures.
        let closed = lock(&self.frames.0).recipient.as_ref().map(|recipient| recipient.permit.closed());
        async {
            if let Some(closed) = closed {
                closed.await;
            }
        }
    }
}

/// The answer of the device to a readback, and the recipients of the answer.
struct InFlight<T, R> {
    reply: PendingReply<T>,
    /// The answer, once it is there.
    answer: Option<Result<T>>,
    recipients: Vec<R>,
}

impl<T, R> InFlight<T, R> {
    const fn new(reply: PendingReply<T>, recipients: Vec<R>) -> Self {
        Self { reply, answer: None, recipients }
    }

    /// Waits for the answer. Cancel-safe.
    async fn wait(&mut self) {
        if self.answer.is_none() {
            self.answer = Some(self.reply.recv().await);
        }
    }
}

enum Readback {
    Vertices(VertexAttributes, InFlight<CopiedVertices, Recipient>),
    Picture(Box<PictureSpec>, InFlight<FrameImage<FramePixels>, PictureRecipient>),
    /// No recipient waits any longer, so the command to the device is cancelled.
    Cancelled,
}

/// A readback in flight.
pub(super) struct PendingReadback {
    readback: Readback,
    /// The forms in which a color picture is read.
    content: PictureContent,
    /// The scene's step count when the readback was started.
    step_count: u64,
    /// The step that is acknowledged after this readback, if this is the last readback of the step.
    step_to_acknowledge: Option<CompletedStep>,
}

impl PendingReadback {
    /// A copy of the current step's vertices with these attributes that was just started.
    pub(super) fn of_vertices(
        current: &CurrentStep,
        attributes: VertexAttributes,
        reply: PendingReply<CopiedVertices>,
        recipients: Vec<Recipient>,
    ) -> Self {
        Self::new(current, Readback::Vertices(attributes, InFlight::new(reply, recipients)))
    }

    /// A color picture of the current step whose drawing was just started.
    pub(super) fn of_picture(
        current: &CurrentStep,
        spec: PictureSpec,
        content: PictureContent,
        reply: PendingReply<FrameImage<FramePixels>>,
        recipient: PictureRecipient,
    ) -> Self {
        let readback = Readback::Picture(Box::new(spec), InFlight::new(reply, vec![recipient]));
        Self { content, ..Self::new(current, readback) }
    }

    const fn new(current: &CurrentStep, readback: Readback) -> Self {
        let content = PictureContent::PIXELS;
        Self { readback, content, step_count: current.step_count, step_to_acknowledge: None }
    }

    /// The recipients of this picture of the scene's `step_count`-th step; `None` if this is another readback, or if it
    /// lacks content.
    pub(super) fn recipients_of(
        &mut self,
        step_count: u64,
        picture: &PictureSpec,
        content: PictureContent,
    ) -> Option<&mut Vec<PictureRecipient>> {
        let has_content = self.content.can_serve(content);
        match &mut self.readback {
            Readback::Picture(spec, in_flight)
                if has_content && self.step_count == step_count && **spec == *picture =>
            {
                Some(&mut in_flight.recipients)
            }
            _ => None,
        }
    }

    /// The recipients of this copy of the vertices of the scene's `step_count`-th step; `None` if this is another
    /// readback, or if it lacks attributes.
    pub(super) fn recipients_of_vertices(
        &mut self,
        step_count: u64,
        attributes: VertexAttributes,
    ) -> Option<&mut Vec<Recipient>> {
        match &mut self.readback {
            Readback::Vertices(copied, in_flight) if self.step_count == step_count && copied.contains(attributes) => {
                Some(&mut in_flight.recipients)
            }
            _ => None,
        }
    }

    /// Waits for the answer of the device, or until no recipient waits any longer. Cancel-safe.
    async fn wait(&mut self) {
        let cancelled = self.cancelled();
        tokio::select! {
            biased;
            () = self.wait_for_answer() => {}
            () = cancelled => self.readback = Readback::Cancelled,
        }
    }

    /// Waits for the answer of the device. Cancel-safe.
    async fn wait_for_answer(&mut self) {
        match &mut self.readback {
            Readback::Vertices(_, in_flight) => in_flight.wait().await,
            Readback::Picture(_, in_flight) => in_flight.wait().await,
            Readback::Cancelled => {}
        }
    }

    /// Waits until no recipient waits any longer.
    fn cancelled(&self) -> impl Future<Output = ()> + Send + use<> {
        let mut cancellations: Vec<Cancellation> = Vec::new();
        match &self.readback {
            Readback::Vertices(_, in_flight) => {
                cancellations.extend(in_flight.recipients.iter().map(|recipient| boxed(recipient.permit.closed())));
            }
            Readback::Picture(_, in_flight) => {
                cancellations.extend(in_flight.recipients.iter().map(|recipient| boxed(recipient.cancelled())));
            }
            Readback::Cancelled => {}
        }
        async {
            for cancellation in cancellations {
                cancellation.await;
            }
        }
    }

    /// Sends the answer, which must be there, to all recipients. Returns the picture, if it is one.
    fn send(self) -> Option<(PictureSpec, Arc<RenderedPicture>)> {
        let picture = match self.readback {
            Readback::Vertices(_, InFlight { answer, recipients, .. }) => {
                let vertices = answer?.map(|CopiedVertices { surface, copy_ms }| {
                    (OutputBody::Vertices(Arc::new(StepVertices::new(surface))), vec![(Stage::Copy, copy_ms)])
                });
                recipients.into_iter().for_each(|recipient| recipient.send(vertices.clone()));
                None
            }
            Readback::Picture(spec, InFlight { answer, recipients, .. }) => {
                let picture = answer?.map(|image| Arc::new(RenderedPicture::from(image)));
                recipients.into_iter().for_each(|recipient| recipient.receive(picture.clone()));
                picture.ok().map(|picture| (*spec, picture))
            }
            Readback::Cancelled => None,
        };
        if let Some(step) = self.step_to_acknowledge {
            step.acknowledge();
        }
        picture
    }

    /// Waits for the answer of the device and sends it to all recipients. Returns the picture, if it is one.
    pub(super) async fn deliver(mut self) -> Option<(PictureSpec, Arc<RenderedPicture>)> {
        self.wait().await;
        self.send()
    }

    fn is_for(&self, subscriber: &Subscriber) -> bool {
        match &self.readback {
            Readback::Vertices(_, in_flight) => {
                in_flight.recipients.iter().any(|recipient| recipient.permit.belongs_to(subscriber))
            }
            Readback::Picture(_, in_flight) => {
                in_flight.recipients.iter().any(|recipient| recipient.is_for(subscriber))
            }
            Readback::Cancelled => false,
        }
    }
}

/// Completes when a recipient no longer waits.
type Cancellation = Pin<Box<dyn Future<Output = ()> + Send>>;

fn boxed(cancellation: impl Future<Output = ()> + Send + 'static) -> Cancellation {
    Box::pin(cancellation)
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

    /// Whether a readback is in flight for this subscriber.
    pub(super) fn has_any_for(&self, subscriber: &Subscriber) -> bool {
        self.pending.iter().any(|pending| pending.is_for(subscriber))
    }

    /// Number of readbacks in flight of the scene's `step_count`-th step.
    pub(super) fn count_of(&self, step_count: u64) -> usize {
        self.pending.iter().filter(|pending| pending.step_count == step_count).count()
    }

    pub(super) fn push(&mut self, readback: PendingReadback) {
        self.pending.push_back(readback);
    }

    pub(super) fn iter_mut(&mut self) -> impl Iterator<Item = &mut PendingReadback> {
        self.pending.iter_mut()
    }

    /// Attaches the acknowledgment of a step to its last readback in flight. Returns the step if it has no readback in
    /// flight.
    pub(super) fn attach_acknowledgment(&mut self, step_count: u64, step: CompletedStep) -> Option<CompletedStep> {
        match self.pending.back_mut().filter(|newest| newest.step_count == step_count) {
            Some(newest) => {
                newest.step_to_acknowledge = Some(step);
                None
            }
            None => Some(step),
        }
    }

    /// Waits for the oldest readback and delivers it. Meanwhile cancels later readbacks for which no recipient waits
    /// any longer. Cancel-safe.
    pub(super) async fn deliver_oldest(&mut self) {
        loop {
            let later_cancelled = self.later_cancelled();
            let Some(oldest) = self.pending.front_mut() else { return };
            tokio::select! {
                biased;
                () = oldest.wait() => break,
                index = later_cancelled => self.cancel(index),
            }
        }
        if let Some(oldest) = self.pending.pop_front() {
            oldest.send();
        }
    }

    /// Waits until no recipient waits any longer for one of the readbacks after the oldest. Returns its index.
    fn later_cancelled(&self) -> impl Future<Output = usize> + Send + use<> {
        let is_active = |(_, pending): &(usize, &PendingReadback)| !matches!(pending.readback, Readback::Cancelled);
        let later = self.pending.iter().enumerate().skip(1).filter(is_active);
        let mut cancellations: Vec<(usize, Cancellation)> =
            later.map(|(index, pending)| (index, boxed(pending.cancelled()))).collect();
        poll_fn(move |context| {
            let mut cancellations = cancellations.iter_mut();
            let index = cancellations
                .find_map(|(index, cancellation)| cancellation.as_mut().poll(context).is_ready().then_some(*index));
            index.map_or(Poll::Pending, Poll::Ready)
        })
    }

    /// Cancels a readback: drops its command to the device. A readback with an acknowledgment keeps its place in the
    /// order of the acknowledgments.
    fn cancel(&mut self, index: usize) {
        match self.pending.get_mut(index) {
            Some(pending) if pending.step_to_acknowledge.is_some() => pending.readback = Readback::Cancelled,
            _ => {
                self.pending.remove(index);
            }
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
        while self.pending.iter().any(|pending| matches!(pending.readback, Readback::Vertices(..))) {
            self.deliver_oldest().await;
        }
    }

    /// Delivers readbacks until none is in flight for `subscriber`, so that it can then be served synchronously.
    pub(super) async fn flush_for(&mut self, subscriber: &Subscriber) {
        while self.has_any_for(subscriber) {
            self.deliver_oldest().await;
        }
    }
}
