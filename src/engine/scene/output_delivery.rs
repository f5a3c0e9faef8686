//! Delivery of a scene's outputs: to single requests whose step has been reached, and to subscribers that have not
//! received the current step yet.

use std::mem;
use std::sync::Arc;
use std::time::{Duration, Instant};

use super::current_step::CurrentStep;
use super::message::{StepRequest, StepSelector};
use super::readback_queue::{PendingReadback, Readback, ReadbackQueue, Recipient};
use super::step_queue::CompletedStep;
use super::subscriber::{Delivery, Subscriber};
use crate::config::Config;
use crate::engine::device::command::SceneId;
use crate::engine::device::handle::{DeviceHandle, PendingReply};
use crate::engine::output::pick_result::with_transforms;
use crate::engine::output::step_output::{FrameOutput, OutputBody, OutputSpec, StepOutput, stage_times};
use crate::telemetry::Stage;
use modalcast_model::deform::{DeformedSurface, VertexAttributes};
use modalcast_model::error::{Error, Result};
use modalcast_model::scene::Scene;
use modalcast_render::MAX_FRAMES_IN_FLIGHT;

/// Owns everything that waits for outputs of one scene: subscribers, single requests, and the readbacks in flight.
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
    /// A lossless subscriber without capacity blocks the writer and is cut off after `Config::stall_timeout`.
    pub applies_back_pressure: bool,
    /// Another step is queued: vertices and at most [`MAX_FRAMES_IN_FLIGHT`] frames are only started; they are delivered
    /// while that step is computed.
    pub overlaps_next_step: bool,
}

impl OutputDelivery {
    pub(super) fn new(scene: SceneOnDevice, device: DeviceHandle, config: &Config) -> Self {
        Self {
            subscribers: Vec::new(),
            requests: Vec::new(),
            max_subscribers: config.max_subscribers,
            max_pending_requests: config.max_pending_requests,
            producer: OutputProducer {
                scene,
                device,
                stall_timeout: config.stall_timeout,
                readbacks: ReadbackQueue::default(),
                cached: None,
            },
        }
    }

    /// Adds a subscriber. With [`Delivery::Latest`] it receives the current step if the scene has had one.
    ///
    /// # Errors
    /// `Busy` when the scene has too many subscribers.
    pub(super) fn add_subscriber(&mut self, mut subscriber: Subscriber, current: &CurrentStep) -> Result<()> {
        self.drop_closed();
        let limit = self.max_subscribers;
        if self.subscribers.len() >= limit {
            return Err(Error::Busy { queue: "subscribers of the scene", limit });
        }
        let shows_current = subscriber.delivery == Delivery::Latest && current.state.run > 0;
        subscriber.delivered_count = if shows_current { current.count.saturating_sub(1) } else { current.count };
        self.subscribers.push(subscriber);
        Ok(())
    }

    /// Adds a request; answers it with `Busy` when too many requests wait.
    pub(super) fn add_request(&mut self, request: StepRequest) {
        self.requests.retain(|request| !request.reply.is_closed());
        let limit = self.max_pending_requests;
        if self.requests.len() < limit {
            self.requests.push(request);
        } else {
            let full = Error::Busy { queue: "requests that wait for a step", limit };
            request.reply.send(Err(full)).ok(); // Fails only if the caller no longer waits.
        }
    }

    /// Whether a lossless subscriber has not received the current step.
    pub(super) fn owes_lossless(&self, current: &CurrentStep) -> bool {
        let owes = |subscriber: &Subscriber| {
            subscriber.delivery == Delivery::Lossless && subscriber.delivered_count < current.count
        };
        self.subscribers.iter().any(owes)
    }

    /// Deadline at which the subscriber that has blocked the writer for the longest is cut off.
    pub(super) fn next_stall_deadline(&self) -> Option<Instant> {
        let first = self.subscribers.iter().filter_map(|subscriber| subscriber.stalled_since).min()?;
        Some(first + self.producer.stall_timeout)
    }

    /// Answers every request whose step has been reached or passed; drops requests whose caller no longer waits. `run`
    /// is the run of the latest writer.
    pub(super) async fn answer_requests(&mut self, current: &CurrentStep, run: u64) {
        for request in mem::take(&mut self.requests) {
            if request.reply.is_closed() {
                continue;
            }
            let answer = match self.producer.is_reached(request.selector, current, run) {
                Ok(true) => self.producer.produce(&request.spec, current, VertexAttributes::default()).await,
                Ok(false) => {
                    self.requests.push(request);
                    continue;
                }
                Err(error) => Err(error),
            };
            request.reply.send(answer).ok(); // Fails only if the caller no longer waits.
        }
    }

    /// Delivers the current step to every subscriber with capacity. Subscribers of the same view share one frame, and
    /// readers of vertices share one copy.
    pub(super) async fn serve_subscribers(&mut self, current: &CurrentStep, mode: DeliveryMode) {
        let wanted = self.combined_attributes(current);
        let starts_copy = mode.overlaps_next_step && !self.producer.cached_attributes().contains(wanted);
        let mut round = DeliveryRound {
            current,
            mode,
            wanted,
            starts_copy,
            readers: Vec::new(),
            started_frames: Vec::new(),
            drawn_frames: Vec::new(),
        };
        let mut at = 0;
        while let Some(subscriber) = self.subscribers.get_mut(at) {
            if !subscriber.is_closed() && self.producer.serve(subscriber, &mut round).await {
                at += 1;
            } else {
                self.subscribers.remove(at);
            }
        }
        let DeliveryRound { readers, started_frames, .. } = round;
        if !readers.is_empty() {
            let copying = self.producer.device.read_vertices(self.producer.scene.id, wanted);
            self.producer.readbacks.push(PendingReadback::new(current, Readback::Vertices(copying), readers));
        }
        started_frames.into_iter().for_each(|frame| self.producer.readbacks.push(frame));
        self.drop_closed();
    }

    /// Delivers all readbacks in flight.
    pub(super) async fn flush(&mut self) {
        self.producer.readbacks.flush().await;
        self.drop_closed();
    }

    /// Waits for the device to compute the next step and delivers readbacks meanwhile. Afterwards at most frames of the
    /// current step are in flight.
    pub(super) async fn deliver_during<T>(&mut self, next: &mut PendingReply<T>, current: &CurrentStep) -> Result<T> {
        let readbacks = &mut self.producer.readbacks;
        readbacks.flush_vertices().await;
        let computed = loop {
            tokio::select! {
                biased;
                computed = next.recv() => break computed,
                () = readbacks.deliver_oldest(), if !readbacks.is_empty() => {}
            }
        };
        readbacks.flush_before(current.count).await;
        self.drop_closed();
        computed
    }

    /// Acknowledges the current step after its last readback in flight.
    pub(super) async fn acknowledge(&mut self, current: &CurrentStep, step: CompletedStep) {
        if let Some(step) = self.producer.readbacks.attach(current.count, step) {
            self.flush().await;
            step.acknowledge();
        }
    }

    /// Forgets what was cached of the previous step.
    pub(super) fn begin_step(&mut self) {
        self.producer.cached = None;
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
        let open = self.subscribers.iter().filter(|subscriber| !subscriber.is_closed());
        open.filter_map(|subscriber| attributes_for(subscriber, current))
            .fold(VertexAttributes::default(), VertexAttributes::union)
    }

    fn drop_closed(&mut self) {
        self.subscribers.retain(|subscriber| !subscriber.is_closed());
    }
}

/// The vertex attributes that a subscriber requests of the current step; `None` if it has no capacity or has received
/// it.
fn attributes_for(subscriber: &Subscriber, current: &CurrentStep) -> Option<VertexAttributes> {
    match subscriber.spec {
        OutputSpec::Vertices(wanted) if subscriber.delivered_count < current.count && subscriber.has_credit() => {
            Some(wanted)
        }
        _ => None,
    }
}

/// One round over all subscribers of a scene.
struct DeliveryRound<'a> {
    current: &'a CurrentStep,
    mode: DeliveryMode,
    /// Vertex attributes that all subscribers request.
    wanted: VertexAttributes,
    /// Whether one copy of `wanted` is started for all readers at the end of the round.
    starts_copy: bool,
    readers: Vec<Recipient>,
    /// Frames that this round started.
    started_frames: Vec<PendingReadback>,
    /// Frames that this round has drawn and delivered; subscribers with the same view share them.
    drawn_frames: Vec<(OutputSpec, StepOutput)>,
}

/// A scene that is loaded on the device.
pub(super) struct SceneOnDevice {
    pub name: String,
    pub id: SceneId,
    pub scene: Arc<Scene>,
}

/// Produces outputs of the current step: draws, picks and copies. Owns the readbacks in flight.
struct OutputProducer {
    scene: SceneOnDevice,
    device: DeviceHandle,
    stall_timeout: Duration,
    readbacks: ReadbackQueue,
    /// Vertices of the current step that a single copy brought to the host, cached for later readers.
    cached: Option<CachedVertices>,
}

/// Vertices in host memory.
#[derive(Debug, Clone)]
struct CachedVertices {
    surface: Arc<DeformedSurface>,
    /// The attributes that `surface` contains.
    attributes: VertexAttributes,
    /// Duration of the copy in milliseconds.
    ms: f64,
}

impl OutputProducer {
    /// Delivers the current step to one subscriber, or starts the delivery. Returns false when the subscriber is to be
    /// dropped.
    async fn serve(&mut self, subscriber: &mut Subscriber, round: &mut DeliveryRound<'_>) -> bool {
        // The subscriber may have gained capacity after `wanted` was computed, so its attributes are checked again.
        let is_reader = |own: VertexAttributes| round.wanted.contains(own);
        if round.starts_copy && attributes_for(subscriber, round.current).is_some_and(is_reader) {
            round.readers.push(Recipient::of(subscriber, round.current.count));
            return true;
        }
        if round.mode.overlaps_next_step && self.start_frame(subscriber, round) {
            return true;
        }
        self.serve_now(subscriber, round).await
    }

    /// Subscribes a subscriber with capacity to a frame of the current step that is delivered asynchronously: a frame of
    /// the same view in flight for another subscriber, else a new frame, unless the round has started
    /// [`MAX_FRAMES_IN_FLIGHT`] already. Returns whether the subscriber gets a frame.
    fn start_frame(&mut self, subscriber: &mut Subscriber, round: &mut DeliveryRound<'_>) -> bool {
        let OutputSpec::Frame { camera, size, frame_output: FrameOutput::Color } = subscriber.spec else {
            return false;
        };
        let count = round.current.count;
        if subscriber.delivered_count == count || !subscriber.has_credit() {
            return false;
        }
        let is_shared = |pending: &&mut PendingReadback| pending.is_frame_of(count, &subscriber.spec);
        if let Some(shared) = self.readbacks.iter_mut().chain(&mut round.started_frames).find(is_shared) {
            shared.add_recipient(Recipient::of(subscriber, count));
            return true;
        }
        if round.started_frames.len() >= MAX_FRAMES_IN_FLIGHT {
            return false;
        }
        let drawing = self.device.begin_draw(self.scene.id, camera, size);
        let readback = Readback::Frame(subscriber.spec, drawing);
        let recipients = vec![Recipient::of(subscriber, count)];
        round.started_frames.push(PendingReadback::new(round.current, readback, recipients));
        true
    }

    /// Delivers the current step to one subscriber and waits for it. Returns false when the subscriber is to be dropped.
    async fn serve_now(&mut self, subscriber: &mut Subscriber, round: &mut DeliveryRound<'_>) -> bool {
        let current = round.current;
        if subscriber.delivered_count == current.count {
            return true;
        }
        if !subscriber.has_credit() {
            return self.check_stall(subscriber, round.mode);
        }
        // Readbacks in flight for the subscriber come first.
        self.readbacks.flush_for(subscriber).await;
        let skipped = subscriber.mark_delivered(current.count);
        let shared = round.drawn_frames.iter().find(|(spec, _)| *spec == subscriber.spec);
        let output = match shared {
            Some((_, output)) => Ok(output.clone()),
            None => self.produce(&subscriber.spec, current, round.wanted).await,
        };
        if let (None, Ok(output @ StepOutput { body: OutputBody::Frame(_), .. })) = (shared, &output) {
            round.drawn_frames.push((subscriber.spec, output.clone()));
        }
        subscriber.take_permit().send(output.map(|output| StepOutput { skipped, ..output }))
    }

    /// Measures for how long a subscriber without capacity has blocked the writer. Returns false when it is cut off.
    fn check_stall(&self, subscriber: &mut Subscriber, mode: DeliveryMode) -> bool {
        if !(mode.applies_back_pressure && subscriber.delivery == Delivery::Lossless) {
            subscriber.stalled_since = None;
            return true;
        }
        let since = *subscriber.stalled_since.get_or_insert_with(Instant::now);
        let is_within_timeout = since.elapsed() < self.stall_timeout;
        if !is_within_timeout {
            let (scene, seconds) = (&self.scene.name, self.stall_timeout.as_secs());
            tracing::warn!(scene, seconds, "a lossless subscriber did not read and is cut off");
            subscriber.disconnect(Error::Busy { queue: "this lossless subscriber, which did not read,", limit: 2 });
        }
        is_within_timeout
    }

    /// Draws, picks or copies the current step. A copy also covers the attributes in `others`.
    async fn produce(
        &mut self,
        spec: &OutputSpec,
        current: &CurrentStep,
        others: VertexAttributes,
    ) -> Result<StepOutput> {
        let mut stages = current.stages.clone();
        let (id, device) = (self.scene.id, &self.device);
        let body = match *spec {
            OutputSpec::Frame { camera, size, frame_output: FrameOutput::Color } => {
                let image = device.begin_draw(id, camera, size).wait().await?;
                stages.extend(stage_times(&image.times));
                OutputBody::Frame(Arc::new(image.into()))
            }
            OutputSpec::Frame { camera, size, frame_output } => {
                let (aov, legend) = device.render_aov(id, camera, size, frame_output).await?;
                stages.extend(stage_times(&aov.times));
                OutputBody::Aov(aov, legend)
            }
            OutputSpec::Pick { camera, picture, rectangle } => {
                let hits = device.pick(id, camera, picture, rectangle).await?;
                OutputBody::Pick(with_transforms(&current.state, &self.scene.scene, hits))
            }
            OutputSpec::Vertices(wanted) => {
                let CachedVertices { surface, ms, .. } = self.vertices(wanted, others).await?;
                stages.push((Stage::Copy, ms));
                OutputBody::Vertices(surface)
            }
        };
        Ok(StepOutput { step: current.id(), skipped: 0, stages, origins: current.state.origins.clone(), body })
    }

    /// Whether a request can be answered now. `run` is the run of the latest writer.
    ///
    /// # Errors
    /// `Gone` when the scene has passed the exact step that is asked for.
    fn is_reached(&self, selector: StepSelector, current: &CurrentStep, run: u64) -> Result<bool> {
        let is_of_this_run = current.state.run == run && run > 0;
        let here = is_of_this_run.then_some(current.state.step);
        match (selector, here) {
            (StepSelector::Current, _) => Ok(true),
            (StepSelector::Exact(want), Some(here)) if here > want => Err(Error::Gone {
                what: "exact_step",
                expected: format!("{here}, the step that scene '{}' shows, or a later one", self.scene.name),
                given: want.to_string(),
            }),
            (StepSelector::Exact(want), Some(here)) => Ok(here == want),
            (StepSelector::Minimum(want), Some(here)) => Ok(here >= want),
            (StepSelector::Exact(_) | StepSelector::Minimum(_), None) => Ok(false),
        }
    }

    /// The attributes of the current vertices that are cached in host memory.
    fn cached_attributes(&self) -> VertexAttributes {
        self.cached.as_ref().map_or(VertexAttributes::default(), |cached| cached.attributes)
    }

    /// The current vertices with at least the wanted attributes. They are copied from the device once per step unless a
    /// later request needs further attributes; a copy also covers `others`.
    async fn vertices(&mut self, wanted: VertexAttributes, others: VertexAttributes) -> Result<CachedVertices> {
        if let Some(cached) = self.cached.as_ref().filter(|cached| cached.attributes.contains(wanted)) {
            return Ok(cached.clone());
        }
        // The cached attributes are copied again, so that alternating readers do not evict each other's attributes.
        let attributes = self.cached_attributes().union(wanted).union(others);
        let (surface, ms) = self.device.read_vertices(self.scene.id, attributes).wait().await?;
        Ok(self.cached.insert(CachedVertices { surface, attributes, ms }).clone())
    }
}

#[cfg(test)]
mod tests {
    use tokio::sync::mpsc;
    use tokio::time::timeout;

    use super::super::subscriber::Subscription;
    use super::*;
    use crate::engine::device::command::{Command, Reply};
    use crate::engine::testing;
    use modalcast_model::scene::{Camera, FrameSize, SceneState};
    use modalcast_render::{FrameImage, RasterBackends};

    const ALONE: DeliveryMode = DeliveryMode { applies_back_pressure: false, overlaps_next_step: false };
    const OVERLAPPED: DeliveryMode = DeliveryMode { overlaps_next_step: true, ..ALONE };

    /// The delivery of a scene to some subscribers, and the receiver of its device commands.
    fn delivery_to(subscribers: Vec<Subscriber>) -> (OutputDelivery, mpsc::Receiver<Command>) {
        let (device, commands) = DeviceHandle::mock();
        let scene = SceneOnDevice { name: "strips".into(), id: 1, scene: testing::two_strips() };
        let delivery = OutputDelivery::new(scene, device, &Config::default());
        (OutputDelivery { subscribers, ..delivery }, commands)
    }

    /// The scene's step with this number, which is also its count.
    fn current(step: u64) -> CurrentStep {
        let state = SceneState { run: 1, step, ..SceneState::rest(&testing::two_strips()) };
        CurrentStep { state: Arc::new(state), count: step, stages: Vec::new() }
    }

    /// A subscriber to frames of this width in pixels.
    fn subscriber(delivery: Delivery, width: u32) -> (Subscriber, Subscription) {
        let camera = Camera::fit_to_scene(&testing::two_strips(), width, 8);
        Subscription::new(
            OutputSpec::Frame { camera, size: FrameSize::new(width, 8), frame_output: FrameOutput::Color },
            delivery,
            Arc::default(),
        )
    }

    /// The next frame that is requested from the device within `ms` milliseconds: its width and its reply channel.
    async fn asked(device: &mut mpsc::Receiver<Command>, ms: u64) -> Option<(u32, Reply<FrameImage>)> {
        match timeout(Duration::from_millis(ms), device.recv()).await.ok()?? {
            Command::Draw { size, reply, .. } => Some((size.width, reply)),
            _ => None,
        }
    }

    fn answer((width, reply): (u32, Reply<FrameImage>)) {
        reply
            .send(Ok(FrameImage {
                width,
                height: 8,
                rgba: vec![],
                times: modalcast_render::FrameTimes::default(),
                raster_backends: RasterBackends::default(),
            }))
            .expect("somebody waits");
    }

    /// Delivers the second step to a viewer whose frame of the first step is in flight, then to a viewer with capacity.
    /// Returns the width of the frame that is requested before the frame in flight completes, if any, and the widths
    /// and steps that both viewers receive.
    async fn served(delivery: Delivery) -> (Option<u32>, Vec<(u32, u64)>) {
        let ((slow, mut slow_feed), (fast, mut fast_feed)) =
            (subscriber(delivery, 16), subscriber(Delivery::Lossless, 24));
        // Polling grants a `Latest` feed one credit; a lossless feed has credits from the start.
        timeout(Duration::ZERO, slow_feed.next()).await.expect_err("nothing yet");
        let (mut delivery, mut device) = delivery_to(vec![slow]);
        delivery.serve_subscribers(&current(1), OVERLAPPED).await;
        let first = asked(&mut device, 10_000).await.expect("the first frame");
        delivery.subscribers.push(fast);
        let second = current(2);
        let serving = async {
            delivery.serve_subscribers(&second, ALONE).await;
            delivery.flush().await;
        };
        let playing = async {
            let before = asked(&mut device, 500).await;
            let soon = before.as_ref().map(|(width, _)| *width);
            answer(first);
            before.into_iter().for_each(answer);
            while let Some(next) = asked(&mut device, 500).await {
                answer(next);
            }
            soon
        };
        let (_, soon) = tokio::join!(serving, playing);
        let mut got = Vec::new();
        for subscription in [&mut slow_feed, &mut fast_feed] {
            while let Ok(Ok(StepOutput { step, body: OutputBody::Frame(image), .. })) =
                timeout(Duration::ZERO, subscription.next()).await
            {
                got.push((image.width, step.number));
            }
        }
        (soon, got)
    }

    #[tokio::test]
    async fn a_viewer_whose_frame_is_late_and_who_has_no_room_keeps_nobody_waiting() {
        assert_eq!(served(Delivery::Latest).await, (Some(24), vec![(16, 1), (24, 2)]));
    }

    /// Delivers a step to three viewers, two of which share a view. Returns how many frames the device draws and the
    /// widths that the viewers receive.
    async fn drawn_for_three(has_next: bool) -> (usize, Vec<u32>) {
        let (subscribers, feeds): (Vec<_>, Vec<_>) =
            [16, 24, 16].map(|width| subscriber(Delivery::Lossless, width)).into_iter().unzip();
        let (mut delivery, mut device) = delivery_to(subscribers);
        let first = current(1);
        let serving = async {
            delivery.serve_subscribers(&first, if has_next { OVERLAPPED } else { ALONE }).await;
            delivery.flush().await;
        };
        let drawing = async {
            let mut drawn = 0;
            while let Some(frame) = asked(&mut device, 500).await {
                answer(frame);
                drawn += 1;
            }
            drawn
        };
        let ((), drawn) = tokio::join!(serving, drawing);
        let mut got = Vec::new();
        for mut subscription in feeds {
            let next = timeout(Duration::from_secs(10), subscription.next()).await.expect("a frame");
            let Ok(StepOutput { body: OutputBody::Frame(frame), .. }) = next else { panic!("a frame") };
            got.push(frame.width);
        }
        (drawn, got)
    }

    #[tokio::test]
    async fn viewers_of_one_view_share_one_drawing_of_a_step() {
        for has_next in [false, true] {
            assert_eq!(drawn_for_three(has_next).await, (2, vec![16, 24, 16]), "a step waits: {has_next}");
        }
    }

    #[tokio::test]
    async fn a_viewer_who_has_room_gets_what_is_late_first() {
        let (soon, got) = served(Delivery::Lossless).await;
        assert_eq!((soon, got), (None, vec![(16, 1), (16, 2), (24, 2)]));
    }
}
