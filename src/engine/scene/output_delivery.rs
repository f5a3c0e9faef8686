//! Delivery of a scene's outputs: to single requests whose step has been reached, and to subscribers that have not
//! received the current step yet. A subscriber receives one result per credit ([`super::subscriber`]).

use std::cmp::Ordering;
use std::collections::VecDeque;
use std::mem;
use std::sync::Arc;
use std::time::{Duration, Instant};

use super::current_step::CurrentStep;
use super::delivery::Delivery;
use super::frame_stream::CameraState;
use super::message::{StepRequest, StepSelector};
use super::readback_queue::{PendingFrames, PendingReadback, PictureRecipient, ReadbackQueue, Recipient};
use super::step_queue::CompletedStep;
use super::subscriber::{LOSSLESS_CREDITS, Subscriber};
use crate::config::Config;
use crate::engine::device::command::{CopiedVertices, SceneId};
use crate::engine::device::handle::{DeviceHandle, PendingReply};
use crate::engine::output::pick_result::with_transforms;
use crate::engine::output::rendered_picture::RenderedPicture;
use crate::engine::output::step_output::{FrameOutput, OutputBody, OutputSpec, PictureSpec, StepFrames, StepOutput};
use crate::engine::output::step_vertices::StepVertices;
use crate::telemetry::Stage;
use modalcast_model::deform::VertexAttributes;
use modalcast_model::error::{Error, Result};
use modalcast_model::scene::Scene;
use modalcast_render::MAX_FRAMES_IN_FLIGHT;

/// Owns the subscribers and the single requests of one scene, and the readbacks in flight for them.
pub(super) struct OutputDelivery {
    subscribers: Vec<Subscriber>,
    requests: Vec<StepRequest>,
    max_subscribers: usize,
    max_pending_requests: usize,
    producer: OutputProducer,
}

/// How the current step is delivered to subscribers.
#[derive(Debug, Clone, Copy)]
pub(super) struct DeliveryMode {
    /// A lossless subscriber without a credit blocks the writer. It is disconnected after `Config::stall_timeout`.
    pub applies_back_pressure: bool,
    /// Another step is queued. Readbacks of vertices are only started now, and are delivered while the queued step is
    /// computed. Readbacks of frames are always only started.
    pub overlaps_next_step: bool,
}

impl OutputDelivery {
    pub(super) fn new(scene_on_device: SceneOnDevice, device: DeviceHandle, config: &Config) -> Self {
        Self {
            subscribers: Vec::new(),
            requests: Vec::new(),
            max_subscribers: config.max_subscribers,
            max_pending_requests: config.max_pending_requests,
            producer: OutputProducer {
                scene_on_device,
                device,
                stall_timeout: config.stall_timeout,
                readbacks: ReadbackQueue::default(),
                cached_vertices: None,
            },
        }
    }

    /// Adds a subscriber. With [`Delivery::Latest`] it receives the current step unless the scene has had no step.
    ///
    /// # Errors
    /// `LimitReached` when the scene has too many subscribers.
    pub(super) fn add_subscriber(&mut self, mut subscriber: Subscriber, current: &CurrentStep) -> Result<()> {
        self.drop_closed_subscribers();
        let limit = self.max_subscribers;
        if self.subscribers.len() >= limit {
            return Err(Error::LimitReached { objects: "subscribers of one scene", limit });
        }
        let receives_current = subscriber.delivery == Delivery::Latest && current.state.run > 0;
        // Counts as if the subscriber had received the step before its first one.
        subscriber.delivered_step_count =
            if receives_current { current.step_count.saturating_sub(1) } else { current.step_count };
        self.subscribers.push(subscriber);
        Ok(())
    }

    /// Adds a request. Answers it with `Busy` when too many requests wait.
    pub(super) fn add_request(&mut self, request: StepRequest) {
        self.requests.retain(|request| !request.reply.is_closed());
        let limit = self.max_pending_requests;
        if self.requests.len() < limit {
            self.requests.push(request);
        } else {
            let queue_full = Error::Busy { queue: "requests that wait for a step", limit };
            request.reply.send(Err(queue_full)).ok(); // Fails only if the caller no longer waits.
        }
    }

    /// Whether a lossless subscriber has not received the current step.
    pub(super) fn has_unserved_lossless(&self, current: &CurrentStep) -> bool {
        let lacks_current_step = |subscriber: &Subscriber| {
            subscriber.delivery == Delivery::Lossless && subscriber.delivered_step_count < current.step_count
        };
        self.subscribers.iter().any(lacks_current_step)
    }

    /// Deadline at which the subscriber that has blocked the writer for the longest time is disconnected.
    pub(super) fn next_stall_deadline(&self) -> Option<Instant> {
        let earliest_stall = self.subscribers.iter().filter_map(|subscriber| subscriber.stalled_since).min()?;
        Some(earliest_stall + self.producer.stall_timeout)
    }

    /// Answers every request whose step has been reached or passed. Drops requests whose caller no longer waits. `run`
    /// is the run of the latest writer.
    pub(super) async fn answer_requests(&mut self, current: &CurrentStep, run: u64) {
        for mut request in mem::take(&mut self.requests) {
            if request.reply.is_closed() {
                continue;
            }
            let answer = match self.producer.is_reached(request.selector, current, run) {
                Ok(true) => tokio::select! {
                    biased;
                    answer = self.producer.produce(&request.spec, current, VertexAttributes::default()) => answer,
                    // The caller no longer waits. Dropping the production cancels its commands to the device.
                    () = request.reply.closed() => continue,
                },
                Ok(false) => {
                    self.requests.push(request);
                    continue;
                }
                Err(error) => Err(error),
            };
            request.reply.send(answer).ok(); // Fails only if the caller no longer waits.
        }
    }

    /// Delivers the current step to every subscriber with a credit. Subscribers with equal pictures share one drawing,
    /// and subscribers to vertices share one copy.
    pub(super) async fn serve_subscribers(&mut self, current: &CurrentStep, mode: DeliveryMode) {
        let attributes = self.combined_attributes(current);
        let starts_shared_copy = mode.overlaps_next_step && !self.producer.cached_attributes().contains(attributes);
        let mut round = DeliveryRound {
            current,
            mode,
            attributes,
            starts_shared_copy,
            vertex_recipients: Vec::new(),
            started_pictures: VecDeque::new(),
            drawn_pictures: Vec::new(),
        };
        let mut index = 0;
        while let Some(subscriber) = self.subscribers.get_mut(index) {
            if !subscriber.is_closed() && self.producer.serve(subscriber, &mut round).await {
                index += 1;
            } else {
                self.subscribers.remove(index);
            }
        }
        let DeliveryRound { vertex_recipients, started_pictures, .. } = round;
        if !vertex_recipients.is_empty() {
            let reply = self.producer.device.read_vertices(self.producer.scene_on_device.id, attributes);
            self.producer.readbacks.push(PendingReadback::of_vertices(current, reply, vertex_recipients));
        }
        started_pictures.into_iter().for_each(|picture| self.producer.readbacks.push(picture));
        self.drop_closed_subscribers();
    }

    /// Delivers all readbacks in flight.
    pub(super) async fn flush(&mut self) {
        self.producer.readbacks.flush().await;
        self.drop_closed_subscribers();
    }

    /// Delivers readbacks until the device answers `pending_reply`, which is the next step. Afterwards only frames of
    /// the step in `current` may be in flight.
    pub(super) async fn deliver_during<T>(
        &mut self,
        pending_reply: &mut PendingReply<T>,
        current: &CurrentStep,
    ) -> Result<T> {
        let readbacks = &mut self.producer.readbacks;
        readbacks.flush_vertices().await;
        let result = loop {
            tokio::select! {
                biased;
                result = pending_reply.recv() => break result,
                () = readbacks.deliver_oldest(), if !readbacks.is_empty() => {}
            }
        };
        readbacks.flush_before(current.step_count).await;
        self.drop_closed_subscribers();
        result
    }

    /// Acknowledges the current step after its last readback in flight, or now if it has none.
    pub(super) async fn acknowledge(&mut self, current: &CurrentStep, step: CompletedStep) {
        if let Some(step) = self.producer.readbacks.attach_acknowledgement(current.step_count, step) {
            self.flush().await;
            step.acknowledge();
        }
    }

    /// Drops the cached vertices of the previous step.
    pub(super) fn drop_cached_vertices(&mut self) {
        self.producer.cached_vertices = None;
    }

    /// Ends every subscription and every request with `error`.
    pub(super) fn end(self, error: &Error) {
        self.subscribers.iter().for_each(|subscriber| subscriber.end(error.clone()));
        for request in self.requests {
            request.reply.send(Err(error.clone())).ok(); // Fails only if the caller no longer waits.
        }
    }

    /// The union of the vertex attributes that all subscribers request, so that one copy serves them all.
    fn combined_attributes(&self, current: &CurrentStep) -> VertexAttributes {
        let open_subscribers = self.subscribers.iter().filter(|subscriber| !subscriber.is_closed());
        open_subscribers
            .filter_map(|subscriber| attributes_for(subscriber, current))
            .fold(VertexAttributes::default(), VertexAttributes::union)
    }

    fn drop_closed_subscribers(&mut self) {
        self.subscribers.retain(|subscriber| !subscriber.is_closed());
    }
}

/// The vertex attributes that a subscriber requests of the current step. `None` if it has no credit or has received the
/// step.
fn attributes_for(subscriber: &Subscriber, current: &CurrentStep) -> Option<VertexAttributes> {
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
struct DeliveryRound<'a> {
    current: &'a CurrentStep,
    mode: DeliveryMode,
    /// Union of the vertex attributes that all subscribers request.
    attributes: VertexAttributes,
    /// Whether the round ends by starting one copy of `attributes` for all `vertex_recipients`.
    starts_shared_copy: bool,
    vertex_recipients: Vec<Recipient>,
    /// Pictures that this round started and that are in flight, oldest first; at most [`MAX_FRAMES_IN_FLIGHT`].
    started_pictures: VecDeque<PendingReadback>,
    /// Pictures that this round has drawn. Later subscribers with an equal picture receive the same pixels.
    drawn_pictures: Vec<(PictureSpec, Arc<RenderedPicture>)>,
}

/// Identifies a scene that is loaded on the device.
pub(super) struct SceneOnDevice {
    pub name: String,
    pub id: SceneId,
    pub scene: Arc<Scene>,
}

/// Produces outputs of the current step: draws, picks and copies. Owns the readbacks in flight.
struct OutputProducer {
    scene_on_device: SceneOnDevice,
    device: DeviceHandle,
    stall_timeout: Duration,
    readbacks: ReadbackQueue,
    /// Vertices of the current step in host memory, cached for later requests and subscribers.
    cached_vertices: Option<CachedVertices>,
}

/// Vertices in host memory.
#[derive(Debug, Clone)]
struct CachedVertices {
    vertices: Arc<StepVertices>,
    /// The attributes that `vertices` contains.
    attributes: VertexAttributes,
    /// Duration of the copy in milliseconds.
    copy_ms: f64,
}

impl OutputProducer {
    /// Delivers the current step to one subscriber, or starts the delivery. Returns false if the subscriber must be
    /// dropped.
    async fn serve(&mut self, subscriber: &mut Subscriber, round: &mut DeliveryRound<'_>) -> bool {
        let is_new_step = subscriber.delivered_step_count < round.current.step_count;
        // The frame of a queued step will show a moved camera, too.
        let redraws = !round.mode.overlaps_next_step && subscriber.has_moved_camera();
        if !is_new_step && !redraws {
            return true;
        }
        if !subscriber.has_credit() {
            return !is_new_step || self.check_stall(subscriber, round.mode);
        }
        // `round.attributes` lacks the attributes of a subscriber that received its credit after the round had begun.
        let is_covered = |attributes: VertexAttributes| round.attributes.contains(attributes);
        if round.starts_shared_copy && attributes_for(subscriber, round.current).is_some_and(is_covered) {
            round.vertex_recipients.push(Recipient::take_credit_of(subscriber, round.current));
            return true;
        }
        if let Some(cameras) = subscriber.take_pictures() {
            self.start_frames(subscriber, &cameras, round).await;
            return true;
        }
        self.serve_now(subscriber, round).await
    }

    /// Starts the pictures of the current step for one subscriber, which receives them when the last one is there. Color
    /// pictures are delivered asynchronously; all others are there when this returns.
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
    /// [`MAX_FRAMES_IN_FLIGHT`] color pictures are in flight; a further one waits for the oldest.
    async fn start_picture(&mut self, spec: &PictureSpec, recipient: PictureRecipient, round: &mut DeliveryRound<'_>) {
        let step_count = round.current.step_count;
        if let Some((_, picture)) = round.drawn_pictures.iter().find(|(drawn_spec, _)| drawn_spec == spec) {
            return recipient.receive(Ok(Arc::clone(picture)));
        }
        let recipients_of_equal = self
            .readbacks
            .iter_mut()
            .chain(&mut round.started_pictures)
            .find_map(|pending| pending.recipients_of(step_count, spec));
        if let Some(recipients) = recipients_of_equal {
            return recipients.push(recipient);
        }
        if spec.output == FrameOutput::Color {
            if round.started_pictures.len() >= MAX_FRAMES_IN_FLIGHT
                && let Some(oldest) = round.started_pictures.pop_front()
            {
                self.readbacks.flush_before(step_count).await;
                round.drawn_pictures.extend(oldest.deliver().await);
            }
            let reply = self.device.begin_draw(self.scene_on_device.id, spec.camera, spec.size);
            round.started_pictures.push_back(PendingReadback::of_picture(round.current, *spec, reply, recipient));
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

    /// Draws, picks, copies or shares the current step. A copy also includes `other_attributes`, which other subscribers
    /// request.
    async fn produce(
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
        let (id, PictureSpec { camera, size, output }) = (self.scene_on_device.id, *picture);
        if output == FrameOutput::Color {
            return self.device.begin_draw(id, camera, size).wait().await.map(RenderedPicture::from);
        }
        let (image, legend) = self.device.render_aov(id, camera, size, output).await?;
        Ok(RenderedPicture::from_aov(image, legend))
    }

    /// Whether a request can be answered now. `run` is the run of the latest writer.
    ///
    /// # Errors
    /// `StepPassed` when the scene has passed the requested exact step.
    fn is_reached(&self, selector: StepSelector, current: &CurrentStep, run: u64) -> Result<bool> {
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
    fn cached_attributes(&self) -> VertexAttributes {
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

#[cfg(test)]
mod tests {
    use tokio::sync::{mpsc, oneshot};
    use tokio::time::timeout;

    use super::super::subscriber::Subscription;
    use super::*;
    use crate::engine::device::command::{Command, Reply};
    use crate::engine::testing;
    use modalcast_model::scene::{Camera, FrameSize, SceneState};
    use modalcast_render::{FrameImage, RasterBackends};

    const WITHOUT_NEXT_STEP: DeliveryMode = DeliveryMode { applies_back_pressure: false, overlaps_next_step: false };
    const WITH_NEXT_STEP: DeliveryMode = DeliveryMode { overlaps_next_step: true, ..WITHOUT_NEXT_STEP };

    /// A frame that a subscriber of a test has received.
    #[derive(Debug, PartialEq)]
    struct ReceivedFrame {
        width: u32,
        step: u64,
    }

    /// A frame that was requested from the device.
    struct DrawRequest {
        width: u32,
        reply: Reply<FrameImage>,
    }

    /// Creates the delivery of a scene to some subscribers, and the receiver of its device commands.
    fn delivery_to(subscribers: Vec<Subscriber>) -> (OutputDelivery, mpsc::Receiver<Command>) {
        let (device, commands) = DeviceHandle::mock();
        let scene = SceneOnDevice { name: "strips".into(), id: 1, scene: testing::two_strips() };
        let delivery = OutputDelivery::new(scene, device, &Config::default());
        (OutputDelivery { subscribers, ..delivery }, commands)
    }

    /// A current step. `number` is both its step number and the scene's step count.
    fn current_step(number: u64) -> CurrentStep {
        let state = SceneState { run: 1, step: number, ..SceneState::rest(&testing::two_strips()) };
        CurrentStep { state: Arc::new(state), step_count: number, stages: Vec::new() }
    }

    /// Subscribes to frames of this width in pixels.
    fn subscribe(delivery: Delivery, width: u32) -> (Subscriber, Subscription) {
        let camera = Camera::fit_to_scene(&testing::two_strips(), width, 8);
        Subscription::new(
            OutputSpec::Frames(
                [PictureSpec { camera, size: FrameSize::new(width, 8), output: FrameOutput::Color }].into(),
            ),
            delivery.into(),
            Arc::default(),
        )
    }

    /// Returns the next frame that is requested from the device within `ms` milliseconds.
    async fn next_draw_request(device: &mut mpsc::Receiver<Command>, ms: u64) -> Option<DrawRequest> {
        match timeout(Duration::from_millis(ms), device.recv()).await.ok()?? {
            Command::Draw { size, reply, .. } => Some(DrawRequest { width: size.width, reply }),
            _ => None,
        }
    }

    fn answer(DrawRequest { width, reply }: DrawRequest) {
        reply
            .send(Ok(FrameImage {
                width,
                height: 8,
                rgba: vec![],
                times: modalcast_render::FrameTimes::default(),
                raster_backends: RasterBackends::default(),
            }))
            .expect("expected a caller that waits");
    }

    /// Outcome of [`serve_slow_and_fast`].
    struct ServedFrames {
        /// Width of the frame that is requested while the first frame is still in flight.
        early_frame_width: Option<u32>,
        /// First the frames of the slow subscriber, then the frames of the fast subscriber.
        received: Vec<ReceivedFrame>,
    }

    /// Delivers the second step to a slow subscriber (width 16), whose frame of the first step is in flight, and to a
    /// fast subscriber (width 24), which has credits.
    async fn serve_slow_and_fast(slow_delivery: Delivery) -> ServedFrames {
        let (slow_subscriber, mut slow_subscription) = subscribe(slow_delivery, 16);
        let (fast_subscriber, mut fast_subscription) = subscribe(Delivery::Lossless, 24);
        // Polling grants a `Latest` subscription one credit. A lossless subscription has credits from the start.
        timeout(Duration::ZERO, slow_subscription.next()).await.expect_err("expected no frame yet");
        let (mut delivery, mut device) = delivery_to(vec![slow_subscriber]);
        delivery.serve_subscribers(&current_step(1), WITH_NEXT_STEP).await;
        // The request must arrive, so the timeout is long. The timeouts below are short, because no request may arrive.
        let first_request = next_draw_request(&mut device, 10_000).await.expect("expected the first frame");
        delivery.subscribers.push(fast_subscriber);
        let second_step = current_step(2);
        let deliver = async {
            delivery.serve_subscribers(&second_step, WITHOUT_NEXT_STEP).await;
            delivery.flush().await;
        };
        let draw = async {
            let early_request = next_draw_request(&mut device, 500).await;
            let early_frame_width = early_request.as_ref().map(|request| request.width);
            answer(first_request);
            early_request.into_iter().for_each(answer);
            while let Some(request) = next_draw_request(&mut device, 500).await {
                answer(request);
            }
            early_frame_width
        };
        let ((), early_frame_width) = tokio::join!(deliver, draw);
        let mut received = Vec::new();
        for subscription in [&mut slow_subscription, &mut fast_subscription] {
            while let Ok(Ok(StepOutput { step, body: OutputBody::Frames(frames), .. })) =
                timeout(Duration::ZERO, subscription.next()).await
            {
                received.push(ReceivedFrame { width: frames.pictures[0].width, step: step.number });
            }
        }
        ServedFrames { early_frame_width, received }
    }

    #[tokio::test]
    async fn subscriber_without_credit_delays_no_other_subscriber() {
        let served = serve_slow_and_fast(Delivery::Latest).await;
        assert_eq!(served.early_frame_width, Some(24));
        assert_eq!(served.received, [ReceivedFrame { width: 16, step: 1 }, ReceivedFrame { width: 24, step: 2 }]);
    }

    #[tokio::test]
    async fn lossless_subscriber_receives_its_frames_in_order() {
        let served = serve_slow_and_fast(Delivery::Lossless).await;
        // The slow subscriber is served first. Its second frame is requested while its first one is in flight.
        assert_eq!(served.early_frame_width, Some(16));
        let expected = [(16, 1), (16, 2), (24, 2)].map(|(width, step)| ReceivedFrame { width, step });
        assert_eq!(served.received, expected);
    }

    /// Outcome of [`serve_three_subscribers`].
    #[derive(Debug, PartialEq)]
    struct SharedFrames {
        drawn_count: usize,
        received_widths: Vec<u32>,
    }

    /// Delivers a step to three subscribers, of which the first and the third have the same view.
    async fn serve_three_subscribers(mode: DeliveryMode) -> SharedFrames {
        let (subscribers, subscriptions): (Vec<_>, Vec<_>) =
            [16, 24, 16].map(|width| subscribe(Delivery::Lossless, width)).into_iter().unzip();
        let (mut delivery, mut device) = delivery_to(subscribers);
        let step = current_step(1);
        let deliver = async {
            delivery.serve_subscribers(&step, mode).await;
            delivery.flush().await;
        };
        let draw = async {
            let mut drawn_count = 0;
            while let Some(request) = next_draw_request(&mut device, 500).await {
                answer(request);
                drawn_count += 1;
            }
            drawn_count
        };
        let ((), drawn_count) = tokio::join!(deliver, draw);
        let mut received_widths = Vec::new();
        for mut subscription in subscriptions {
            let output = timeout(Duration::from_secs(10), subscription.next()).await.expect("expected a frame in time");
            let Ok(StepOutput { body: OutputBody::Frames(frames), .. }) = output else { panic!("expected frames") };
            received_widths.push(frames.pictures[0].width);
        }
        SharedFrames { drawn_count, received_widths }
    }

    /// A camera that moves after the frame of the current step is drawn again, unless another step is queued.
    #[tokio::test]
    async fn moved_camera_redraws_the_step_if_no_step_is_queued() {
        for (mode, is_redrawn) in [(WITHOUT_NEXT_STEP, true), (WITH_NEXT_STEP, false)] {
            let (subscriber, mut subscription) = subscribe(Delivery::Lossless, 16);
            let cameras = subscription.cameras().expect("expected the cameras of frames").clone();
            let (mut delivery, mut device) = delivery_to(vec![subscriber]);
            let step = current_step(1);
            for (camera_version, is_drawn) in [(0, true), (3, is_redrawn)] {
                while camera_version > 0 && cameras.move_cameras(&[]) < camera_version {}
                delivery.serve_subscribers(&step, mode).await;
                let request = next_draw_request(&mut device, if is_drawn { 10_000 } else { 100 }).await;
                assert_eq!(request.is_some(), is_drawn, "{mode:?}, version {camera_version}");
                let Some(request) = request else { continue };
                answer(request);
                delivery.flush().await;
                let output = subscription.next().await.expect("expected frames");
                let OutputBody::Frames(frames) = output.body else { panic!("expected frames") };
                let received = (output.step.number, output.skipped, frames.camera_version);
                assert_eq!(received, (1, 0, camera_version), "{mode:?}");
            }
        }
    }

    #[tokio::test]
    async fn cancelled_request_cancels_its_frame() {
        let (mut delivery, mut device) = delivery_to(Vec::new());
        let (subscriber, _subscription) = subscribe(Delivery::Lossless, 16);
        let (reply, answer) = oneshot::channel();
        delivery.add_request(StepRequest { selector: StepSelector::Current, spec: subscriber.spec, reply });
        let step = current_step(1);
        let cancel = async {
            let mut request = next_draw_request(&mut device, 10_000).await.expect("expected a frame");
            assert!(!request.reply.is_closed(), "expected a caller that waits");
            drop(answer);
            request.reply.closed().await;
        };
        let both = async { tokio::join!(delivery.answer_requests(&step, 1), cancel) };
        timeout(Duration::from_secs(10), both).await.expect("expected the cancellation in time");
    }

    /// The frame of the second subscriber is cancelled while the first one is being drawn.
    #[tokio::test]
    async fn dropped_subscription_cancels_its_frame_at_once() {
        let (first_subscriber, mut first_subscription) = subscribe(Delivery::Lossless, 16);
        let (second_subscriber, second_subscription) = subscribe(Delivery::Lossless, 24);
        let (mut delivery, mut device) = delivery_to(vec![first_subscriber, second_subscriber]);
        delivery.serve_subscribers(&current_step(1), WITHOUT_NEXT_STEP).await;
        let cancel = async {
            let first_request = next_draw_request(&mut device, 10_000).await.expect("expected the first frame");
            let mut second_request = next_draw_request(&mut device, 10_000).await.expect("expected the second frame");
            assert!(!second_request.reply.is_closed(), "expected a subscriber that waits");
            drop(second_subscription);
            second_request.reply.closed().await;
            answer(first_request);
        };
        let both = async { tokio::join!(delivery.flush(), cancel) };
        timeout(Duration::from_secs(10), both).await.expect("expected the cancellation in time");
        first_subscription.next().await.expect("expected the frame of the first subscriber");
        assert_eq!(delivery.subscribers.len(), 1);
    }

    #[tokio::test]
    async fn subscribers_with_the_same_view_share_one_frame() {
        for mode in [WITHOUT_NEXT_STEP, WITH_NEXT_STEP] {
            let expected = SharedFrames { drawn_count: 2, received_widths: vec![16, 24, 16] };
            assert_eq!(serve_three_subscribers(mode).await, expected, "{mode:?}");
        }
    }
}
