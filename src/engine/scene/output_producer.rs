//! Produces the outputs of a scene's current step: draws, picks and copies, and delivers them to one subscriber at a
//! time.

use std::cmp::Ordering;
use std::collections::VecDeque;
use std::sync::Arc;
use std::time::{Duration, Instant};

use super::current_step::CurrentStep;
use super::delivery::Delivery;
use super::frame_stream::CameraState;
use super::message::StepSelector;
use super::readback_queue::{PendingFrames, PendingReadback, PictureRecipient, ReadbackQueue, Recipient};
use super::subscriber::{LOSSLESS_CREDITS, Subscriber};
use crate::engine::device::command::{CopiedVertices, SceneId};
use crate::engine::device::handle::DeviceHandle;
use crate::engine::output::pick_result::with_transforms;
use crate::engine::output::rendered_picture::RenderedPicture;
use crate::engine::output::step_output::{
    FrameOutput, OutputBody, OutputSpec, PictureContent, PictureSpec, StepFrames, StepOutput,
};
use crate::engine::output::step_vertices::StepVertices;
use crate::telemetry::Stage;
use modalcast_model::deform::VertexAttributes;
use modalcast_model::error::{Error, Result};
use modalcast_model::scene::Scene;
use modalcast_render::MAX_FRAMES_IN_FLIGHT;

/// How the current step is delivered to subscribers.
#[derive(Debug, Clone, Copy)]
pub(super) struct DeliveryMode {
    /// A lossless subscriber without a credit, which permits one result, blocks the writer. It is disconnected after
    /// `Config::stall_timeout`.
    pub applies_back_pressure: bool,
    /// Whether another step is queued. If so, readbacks of vertices are started without waiting for them, and are
    /// delivered while the queued step is computed. Readbacks of frames are started in this way in any case.
    pub overlaps_next_step: bool,
}

/// The vertex attributes that a subscriber requests of the current step. `None` if it has no credit or has received the
/// step.
pub(super) fn attributes_for(subscriber: &Subscriber, current: &CurrentStep) -> Option<VertexAttributes> {
    match subscriber.spec {
        OutputSpec::Vertices(attributes)
            if subscriber.delivered_step_count < current.step_count && subscriber.has_credit() =>
        {
            Some(attributes)
        }
        _ => None,
    }
}

/// The state of one delivery of the current step to all subscribers.
pub(super) struct DeliveryRound<'a> {
    pub(super) current: &'a CurrentStep,
    pub(super) mode: DeliveryMode,
    /// Union of the vertex attributes that all subscribers request.
    pub(super) attributes: VertexAttributes,
    /// Whether the round ends by starting one copy of `attributes` for all `vertex_recipients`.
    pub(super) starts_shared_copy: bool,
    /// The forms in which all subscribers together read color pictures.
    pub(super) content: PictureContent,
    /// The subscribers that wait for that copy.
    pub(super) vertex_recipients: Vec<Recipient>,
    /// Pictures that this round started and that are in flight, oldest first; at most [`MAX_FRAMES_IN_FLIGHT`].
    pub(super) started_pictures: VecDeque<PendingReadback>,
    /// Pictures that this round has drawn. Later subscribers with an equal picture receive the same pixels.
    pub(super) drawn_pictures: Vec<(PictureSpec, Arc<RenderedPicture>)>,
}

/// Identifies a scene that is loaded on the device.
pub(super) struct SceneOnDevice {
    pub name: String,
    pub id: SceneId,
    pub scene: Arc<Scene>,
}

/// Produces outputs of the current step: draws, picks and copies. Owns the readbacks in flight.
pub(super) struct OutputProducer {
    pub(super) scene_on_device: SceneOnDevice,
    pub(super) device: DeviceHandle,
    pub(super) stall_timeout: Duration,
    pub(super) readbacks: ReadbackQueue,
    /// Vertices of the current step in host memory, cached for later requests and subscribers.
    pub(super) cached_vertices: Option<CachedVertices>,
}

/// Vertices in host memory.
#[derive(Debug, Clone)]
pub(super) struct CachedVertices {
    vertices: Arc<StepVertices>,
    /// The attributes that `vertices` contains.
    attributes: VertexAttributes,
    /// Duration of the copy in milliseconds.
    copy_ms: f64,
}

impl OutputProducer {
    pub(super) fn new(scene_on_device: SceneOnDevice, device: DeviceHandle, stall_timeout: Duration) -> Self {
        Self { scene_on_device, device, stall_timeout, readbacks: ReadbackQueue::default(), cached_vertices: None }
    }

    /// Delivers the current step to one subscriber, or starts the delivery. Returns false if the subscriber must be
    /// dropped.
    pub(super) async fn serve(&mut self, subscriber: &mut Subscriber, round: &mut DeliveryRound<'_>) -> bool {
        let is_new_step = subscriber.delivered_step_count < round.current.step_count;
        // The frame of a queued step will show a moved camera, too. While an earlier frame of the subscriber is in
        // flight, a frame with the moved camera could arrive before it; the credit of the earlier one wakes the scene.
        let redraws =
            !round.mode.overlaps_next_step && subscriber.has_moved_camera() && !self.readbacks.has_any_for(subscriber);
        if !is_new_step && !redraws {
            return true;
        }
        if !subscriber.has_credit() {
            return !is_new_step || self.check_stall(subscriber, round.mode);
        }
        let current = round.current;
        if let Some(attributes) = attributes_for(subscriber, current)
            && let Some(recipients) = self.recipients_of_shared_copy(attributes, round)
        {
            recipients.push(Recipient::take_credit_of(subscriber, current));
            return true;
        }
        if let Some(cameras) = subscriber.take_pictures() {
            self.start_frames(subscriber, &cameras, round).await;
            return true;
        }
        self.serve_now(subscriber, round).await
    }

    /// The recipients of a copy with these attributes: of a copy in flight, or of the one that the round will start.
    fn recipients_of_shared_copy<'a>(
        &'a mut self,
        attributes: VertexAttributes,
        round: &'a mut DeliveryRound<'_>,
    ) -> Option<&'a mut Vec<Recipient>> {
        let step_count = round.current.step_count;
        // `round.attributes` lacks the attributes of a subscriber that received its credit after the round had begun.
        let is_covered = round.starts_shared_copy && round.attributes.contains(attributes);
        self.readbacks
            .iter_mut()
            .find_map(|pending| pending.recipients_of_vertices(step_count, attributes))
            .or_else(|| is_covered.then_some(&mut round.vertex_recipients))
    }

    /// Starts the pictures of the current step for one subscriber, which receives them when the last one is there.
    /// Color pictures are delivered asynchronously; all others are there when this returns.
    async fn start_frames(
        &mut self,
        subscriber: &mut Subscriber,
        cameras: &CameraState,
        round: &mut DeliveryRound<'_>,
    ) {
        if cameras.pictures.iter().all(|picture| picture.output != FrameOutput::Color) {
            // Results arrive in the order of the steps, and the result of this step is not delivered asynchronously.
            self.readbacks.flush_for(subscriber).await;
        }
        let frames = PendingFrames::new(Recipient::take_credit_of(subscriber, round.current), cameras);
        for (index, picture) in cameras.pictures.iter().enumerate() {
            self.start_picture(picture, frames.picture(index), round).await;
        }
    }

    /// Draws a picture of the current step for a recipient. An equal picture of another recipient is shared. At most
    /// [`MAX_FRAMES_IN_FLIGHT`] color pictures of a step are in flight, also of several rounds; a further one waits for
    /// the oldest.
    async fn start_picture(&mut self, spec: &PictureSpec, recipient: PictureRecipient, round: &mut DeliveryRound<'_>) {
        let step_count = round.current.step_count;
        if let Some((_, picture)) = round.drawn_pictures.iter().find(|(drawn_spec, _)| drawn_spec == spec) {
            return recipient.receive(Ok(Arc::clone(picture)));
        }
        let recipients_of_equal = self
            .readbacks
            .iter_mut()
            .chain(&mut round.started_pictures)
            .find_map(|pending| pending.recipients_of(step_count, spec, round.content));
        if let Some(recipients) = recipients_of_equal {
            return recipients.push(recipient);
        }
        if spec.output == FrameOutput::Color {
            while self.readbacks.count_of(step_count) + round.started_pictures.len() >= MAX_FRAMES_IN_FLIGHT {
                self.readbacks.flush_before(step_count).await;
                if !self.readbacks.is_empty() {
                    self.readbacks.deliver_oldest().await;
                } else if let Some(oldest) = round.started_pictures.pop_front() {
                    round.drawn_pictures.extend(oldest.deliver().await);
                }
            }
            let content = round.content;
            let reply = self.device.begin_draw(self.scene_on_device.id, spec.camera, spec.size, spec.style, content);
            let pending = PendingReadback::of_picture(round.current, *spec, content, reply, recipient);
            round.started_pictures.push_back(pending);
            return;
        }
        let picture = tokio::select! {
            biased;
            picture = self.draw(spec) => picture.map(Arc::new),
            // The subscriber no longer waits. Dropping the drawing cancels it on the device.
            () = recipient.cancelled() => return,
        };
        round.drawn_pictures.extend(picture.iter().map(|picture| (*spec, Arc::clone(picture))));
        recipient.receive(picture);
    }

    /// Produces the current step for one subscriber with a credit and delivers it. Returns false if the subscriber must
    /// be dropped.
    async fn serve_now(&mut self, subscriber: &mut Subscriber, round: &DeliveryRound<'_>) -> bool {
        // Results arrive in the order of the steps, so deliver the subscriber's readbacks in flight first.
        self.readbacks.flush_for(subscriber).await;
        let skipped = subscriber.mark_delivered(round.current.step_count);
        let output = tokio::select! {
            biased;
            output = self.produce(&subscriber.spec, round.current, round.attributes) => output,
            // The subscriber no longer waits. Dropping the production cancels its commands to the device.
            () = subscriber.closed() => return false,
        };
        subscriber.take_permit().send(output.map(|output| StepOutput { skipped, ..output }))
    }

    /// Disconnects a subscriber without a credit that has blocked the writer for too long. Returns false in that case.
    fn check_stall(&self, subscriber: &mut Subscriber, mode: DeliveryMode) -> bool {
        if !(mode.applies_back_pressure && subscriber.delivery == Delivery::Lossless) {
            subscriber.stalled_since = None;
            return true;
        }
        let stalled_since = *subscriber.stalled_since.get_or_insert_with(Instant::now);
        let is_within_timeout = stalled_since.elapsed() < self.stall_timeout;
        if !is_within_timeout {
            let (scene, seconds) = (&self.scene_on_device.name, self.stall_timeout.as_secs());
            tracing::warn!(scene, seconds, "a lossless subscriber did not read and is disconnected");
            let error = Error::SlowReader { queue: "queue of results of this subscriber", limit: LOSSLESS_CREDITS };
            subscriber.disconnect(error);
        }
        is_within_timeout
    }

    /// Draws, picks, copies or shares the current step. A copy also includes `other_attributes`, which other
    /// subscribers request.
    pub(super) async fn produce(
        &mut self,
        spec: &OutputSpec,
        current: &CurrentStep,
        other_attributes: VertexAttributes,
    ) -> Result<StepOutput> {
        let mut stages = current.stages.clone();
        let body = match spec {
            OutputSpec::Frames(pictures) => {
                OutputBody::Frames(StepFrames { pictures: self.draw_all(pictures).await?, camera_version: 0 })
            }
            OutputSpec::Pick { camera, picture, rectangle } => {
                let hits = self.device.pick(self.scene_on_device.id, *camera, *picture, *rectangle).await?;
                OutputBody::Pick(with_transforms(&current.state, &self.scene_on_device.scene, hits))
            }
            OutputSpec::Vertices(attributes) => {
                let CachedVertices { vertices, copy_ms, .. } =
                    self.copy_vertices(*attributes, other_attributes).await?;
                stages.push((Stage::Copy, copy_ms));
                OutputBody::Vertices(vertices)
            }
            OutputSpec::State => OutputBody::State(Arc::clone(&current.state)),
        };
        Ok(StepOutput { step: current.id(), skipped: 0, stages, origins: current.state.origins.clone(), body })
    }

    /// Draws pictures of the current step. Equal pictures are drawn once.
    async fn draw_all(&self, pictures: &[PictureSpec]) -> Result<Vec<Arc<RenderedPicture>>> {
        let mut drawn = Vec::with_capacity(pictures.len());
        for (index, picture) in pictures.iter().enumerate() {
            drawn.push(match pictures[..index].iter().position(|earlier| earlier == picture) {
                Some(equal) => Arc::clone(&drawn[equal]),
                None => Arc::new(self.draw(picture).await?),
            });
        }
        Ok(drawn)
    }

    /// Draws a picture of the current step.
    async fn draw(&self, picture: &PictureSpec) -> Result<RenderedPicture> {
        let (id, PictureSpec { camera, size, output, style }) = (self.scene_on_device.id, *picture);
        if output == FrameOutput::Color {
            let content = PictureContent::PIXELS;
            return self.device.begin_draw(id, camera, size, style, content).wait().await.map(RenderedPicture::from);
        }
        let (image, legend) = self.device.render_aov(id, camera, size, output).await?;
        Ok(RenderedPicture::from_aov(image, legend))
    }

    /// Whether a request can be answered now. `run` is the run of the latest writer.
    ///
    /// # Errors
    /// `StepPassed` when the scene has passed the requested exact step.
    pub(super) fn is_reached(&self, selector: StepSelector, current: &CurrentStep, run: u64) -> Result<bool> {
        let current_step = (current.state.run > 0).then_some((current.state.run, current.state.step));
        let compare = |requested_run: u64, number: u64| {
            let requested_run = if requested_run == 0 { run } else { requested_run };
            // Before the first step every requested step is in the future.
            current_step.map_or(Ordering::Less, |current_step| current_step.cmp(&(requested_run, number)))
        };
        match selector {
            StepSelector::Current => Ok(true),
            StepSelector::Minimum { run, number } => Ok(compare(run, number) != Ordering::Less),
            StepSelector::Exact { run, number } => match compare(run, number) {
                Ordering::Less => Ok(false),
                Ordering::Equal => Ok(true),
                Ordering::Greater => {
                    let (name, state) = (&self.scene_on_device.name, &current.state);
                    let expected =
                        format!("run {}, step {} (the current one of scene '{name}') or later", state.run, state.step);
                    Err(Error::StepPassed { field: "step.exact", expected, given: number.to_string() })
                }
            },
        }
    }

    /// The attributes of the current vertices that are cached in host memory.
    pub(super) fn cached_attributes(&self) -> VertexAttributes {
        self.cached_vertices.as_ref().map_or(VertexAttributes::default(), |cached| cached.attributes)
    }

    /// Returns the current vertices with at least the given attributes. They are copied from the device once per step
    /// unless a later request needs further attributes. A copy also includes `other_attributes`.
    async fn copy_vertices(
        &mut self,
        attributes: VertexAttributes,
        other_attributes: VertexAttributes,
    ) -> Result<CachedVertices> {
        if let Some(cached) = self.cached_vertices.as_ref().filter(|cached| cached.attributes.contains(attributes)) {
            return Ok(cached.clone());
        }
        // The cached attributes are copied again, so that alternating readers do not evict each other's attributes.
        let copied_attributes = self.cached_attributes().union(attributes).union(other_attributes);
        let CopiedVertices { surface, copy_ms } =
            self.device.read_vertices(self.scene_on_device.id, copied_attributes).wait().await?;
        let vertices = Arc::new(StepVertices::new(surface));
        let copied = CachedVertices { vertices, attributes: copied_attributes, copy_ms };
        Ok(self.cached_vertices.insert(copied).clone())
    }
}
