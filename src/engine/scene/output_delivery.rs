//! Delivers the scene's current step: to single requests whose step has been reached, and to viewers that have not
//! received the step yet.

use std::mem;
use std::sync::Arc;
use std::time::Instant;

use super::actor::{CachedVertices, SceneActor};
use super::readback_queue::Readback;
use super::subscriber::{Delivery, Subscriber};
use crate::engine::output::pick_result::with_transforms;
use crate::engine::output::step_output::{FrameOutput, OutputBody, OutputSpec, StepId, StepOutput};
use crate::telemetry::{Stage, StageTimes};
use modalcast_model::deform::{DeformedSurface, VertexAttributes};
use modalcast_model::error::{Error, Result};

impl SceneActor {
    /// Answers every request whose step has been reached or passed; drops requests whose caller no longer waits.
    pub(in crate::engine) async fn answer_requests(&mut self) {
        for request in mem::take(&mut self.pending_requests) {
            if request.reply.is_closed() {
                continue;
            }
            let answer = match self.is_ready(request.selector) {
                Ok(true) => self.produce_output(&request.spec, 0, VertexAttributes::default()).await,
                Ok(false) => {
                    self.pending_requests.push(request);
                    continue;
                }
                Err(error) => Err(error),
            };
            request.reply.send(answer).ok(); // Fails only if the caller no longer waits.
        }
    }

    /// Delivers the current step to every viewer with capacity. While `applies_back_pressure` is true, a lossless viewer without
    /// capacity blocks the writer (back-pressure) and is cut off after `Config::stall_timeout`. If another step is queued,
    /// vertices and at most [`modalcast_render::MAX_FRAMES_IN_FLIGHT`] frames are only started here; they are delivered
    /// while that step is computed.
    pub(in crate::engine) async fn serve_subscribers(&mut self, applies_back_pressure: bool) {
        let subscribers = mem::take(&mut self.subscribers);
        let wanted = self.combined_attributes(&subscribers);
        let overlaps_next_step = self.has_queued_step();
        let copied = overlaps_next_step && !self.cached_attributes().contains(wanted);
        let (mut readers, mut frames, mut drawn) = (Vec::new(), Vec::new(), Vec::new());
        for mut subscriber in subscribers {
            if subscriber.is_closed() {
                continue;
            }
            // The viewer may have gained capacity after `wanted` was computed, so its own attributes are checked again.
            if copied && self.attributes_for(&subscriber).is_some_and(|own| wanted.contains(own)) {
                let skipped = subscriber.mark_delivered(self.count);
                readers.push((subscriber.take_permit(), skipped));
            } else {
                let is_begun = overlaps_next_step && self.begin_frame(&mut subscriber, &mut frames);
                if !is_begun
                    && !self.serve_subscriber(&mut subscriber, applies_back_pressure, (wanted, &mut drawn)).await
                {
                    continue;
                }
            }
            self.subscribers.push(subscriber);
        }
        if !readers.is_empty() {
            let copying = self.services.device_handle.read_vertices(self.id, wanted);
            self.in_flight.push_back(self.new_readback(Readback::Vertices(copying), readers));
        }
        self.in_flight.extend(frames);
    }

    /// The vertex attributes that a viewer requests of the current step; `None` if it has no capacity or has received
    /// it.
    fn attributes_for(&self, subscriber: &Subscriber) -> Option<VertexAttributes> {
        match subscriber.spec {
            OutputSpec::Vertices(wanted) if subscriber.delivered_count < self.count && subscriber.has_credit() => {
                Some(wanted)
            }
            _ => None,
        }
    }

    /// The union of the vertex attributes that all viewers request, so that one copy serves them all.
    fn combined_attributes(&self, subscribers: &[Subscriber]) -> VertexAttributes {
        let open = subscribers.iter().filter(|subscriber| !subscriber.is_closed());
        open.filter_map(|subscriber| self.attributes_for(subscriber))
            .fold(VertexAttributes::default(), VertexAttributes::union)
    }

    /// Delivers the current step to one viewer and waits for it. Returns false when the viewer is to be dropped.
    /// `others` are the vertex attributes that all viewers request. `drawn` holds the frames of this step that were
    /// drawn for earlier viewers; viewers with the same view share them.
    async fn serve_subscriber(
        &mut self,
        subscriber: &mut Subscriber,
        applies_back_pressure: bool,
        (others, drawn): (VertexAttributes, &mut Vec<(OutputSpec, StepOutput)>),
    ) -> bool {
        if subscriber.delivered_count == self.count {
            return true;
        }
        // Wait for the viewer's readbacks in flight only if it has capacity for a further result.
        if subscriber.has_credit() {
            self.flush_readbacks_for(subscriber).await;
            let skipped = subscriber.mark_delivered(self.count);
            let shared = drawn.iter().find(|(spec, _)| *spec == subscriber.spec);
            let output = match shared {
                Some((_, output)) => Ok(StepOutput { skipped, ..output.clone() }),
                None => self.produce_output(&subscriber.spec, skipped, others).await,
            };
            if let (None, Ok(output @ StepOutput { body: OutputBody::Frame(_), .. })) = (shared, &output) {
                drawn.push((subscriber.spec, output.clone()));
            }
            return subscriber.take_permit().send(output);
        }
        if !(applies_back_pressure && subscriber.delivery == Delivery::Lossless) {
            subscriber.stalled_since = None;
            return true;
        }
        let since = *subscriber.stalled_since.get_or_insert_with(Instant::now);
        let is_within_timeout = since.elapsed() < self.services.config.stall_timeout;
        if !is_within_timeout {
            let seconds = self.services.config.stall_timeout.as_secs();
            tracing::warn!(scene = self.name, seconds, "a lossless subscriber did not read and is cut off");
            subscriber.disconnect(Error::Busy { queue: "this lossless subscriber, which did not read,", limit: 2 });
        }
        is_within_timeout
    }

    /// Draws, picks or copies the current step. A copy also covers the attributes in `others`.
    async fn produce_output(
        &mut self,
        spec: &OutputSpec,
        skipped: u64,
        others: VertexAttributes,
    ) -> Result<StepOutput> {
        let mut stages = self.stages.clone();
        let body = match *spec {
            OutputSpec::Frame { camera, size, frame_output: FrameOutput::Color } => {
                let image = self.services.device_handle.begin_draw(self.id, camera, size).wait().await?;
                stages.extend(stage_times_of_passes(&image.passes));
                OutputBody::Frame(Arc::new(image.into()))
            }
            OutputSpec::Frame { camera, size, frame_output } => {
                let (survey, legend) =
                    self.services.device_handle.render_aov(self.id, camera, size, frame_output).await?;
                stages.extend(stage_times_of_passes(&survey.passes));
                OutputBody::Aov(survey, legend)
            }
            OutputSpec::Pick { camera, picture, rectangle } => {
                let hits = self.services.device_handle.pick(self.id, camera, picture, rectangle).await?;
                OutputBody::Pick(with_transforms(&self.state, &self.scene, hits))
            }
            OutputSpec::Vertices(wanted) => {
                let (surface, copy_ms) = self.vertices((wanted, others)).await?;
                stages.push((Stage::Copy, copy_ms));
                OutputBody::Vertices(surface)
            }
        };
        Ok(StepOutput { step: StepId::of(&self.state), skipped, stages, origins: self.state.origins.clone(), body })
    }

    /// The attributes of the current vertices that are cached in host memory.
    fn cached_attributes(&self) -> VertexAttributes {
        self.surface.as_ref().map_or(VertexAttributes::default(), |held| held.parts)
    }

    /// The current vertices with at least the wanted attributes, and the copy's duration in milliseconds. They are
    /// copied from the device once per step unless a later request needs further attributes.
    async fn vertices(
        &mut self,
        (wanted, others): (VertexAttributes, VertexAttributes),
    ) -> Result<(Arc<DeformedSurface>, f64)> {
        let cached = self.cached_attributes();
        if let Some(held) = self.surface.as_ref().filter(|_| cached.contains(wanted)) {
            return Ok((Arc::clone(&held.surface), held.ms));
        }
        // The cached attributes are copied again, so that alternating readers do not evict each other's attributes.
        let parts = cached.union(wanted).union(others);
        let (surface, ms) = self.services.device_handle.read_vertices(self.id, parts).wait().await?;
        self.surface = Some(CachedVertices { surface: Arc::clone(&surface), parts, ms });
        Ok((surface, ms))
    }
}

/// The passes of a frame that are stages. The renderer's pass "encode" converts linear light to sRGB bytes and is not
/// [`Stage::Encode`], which is the PNG encoding.
pub(in crate::engine) fn stage_times_of_passes(passes: &[(&'static str, f64)]) -> StageTimes {
    let stage = |name: &str| Stage::from_name(name).filter(|stage| *stage != Stage::Encode);
    passes.iter().filter_map(|(name, ms)| Some((stage(name)?, *ms))).collect()
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use tokio::sync::{Notify, mpsc};
    use tokio::time::timeout;

    use super::super::actor::{ActorParams, SceneServices};
    use super::super::subscriber::Subscription;
    use super::*;
    use crate::config::Config;
    use crate::engine::device::command::{Command, Reply};
    use crate::engine::device::handle::DeviceHandle;
    use crate::engine::storage::checkpoint_store::CheckpointStore;
    use crate::engine::testing;
    use modalcast_model::scene::{Camera, FrameSize, SceneState};
    use modalcast_render::{FrameImage, RasterBackends};

    /// A scene at its first step, and the receiver of its device commands.
    fn scene(folder: &std::path::Path) -> (SceneActor, mpsc::Receiver<Command>) {
        let scene = testing::two_strips();
        let state = Arc::new(SceneState { run: 1, step: 1, ..SceneState::rest(&scene) });
        let (device_handle, device) = DeviceHandle::mock();
        let checkpoints = Arc::new(CheckpointStore::start(folder.to_owned()).expect("starts"));
        let services = SceneServices { device_handle, checkpoints, config: Arc::new(Config::default()) };
        let params = ActorParams { name: "strips".into(), id: 1, scene, state, wake: Arc::new(Notify::new()) };
        (SceneActor::new(params, services).0, device)
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
                passes: vec![],
                raster_backends: RasterBackends::default(),
            }))
            .expect("somebody waits");
    }

    /// Delivers the second step to a viewer whose frame of the first step is in flight, then to a viewer with capacity.
    /// Returns the width of the frame that is requested before the frame in flight completes, if any, and the widths
    /// and steps that both viewers receive.
    async fn served(delivery: Delivery) -> (Option<u32>, Vec<(u32, u64)>) {
        let folder = tempfile::tempdir().expect("a folder");
        let (mut scene_actor, mut device) = scene(folder.path());
        let ((mut slow, mut slow_feed), (fast, mut fast_feed)) =
            (subscriber(delivery, 16), subscriber(Delivery::Lossless, 24));
        // Polling grants a `Latest` feed one credit; a lossless feed has credits from the start.
        timeout(Duration::ZERO, slow_feed.next()).await.expect_err("nothing yet");
        let mut begun = Vec::new();
        assert!(scene_actor.begin_frame(&mut slow, &mut begun));
        scene_actor.in_flight.extend(begun);
        let first = asked(&mut device, 10_000).await.expect("the first frame");
        (scene_actor.count, scene_actor.subscribers) = (2, vec![slow, fast]);
        let state = SceneState { step: 2, ..SceneState::clone(&scene_actor.state) };
        scene_actor.state = Arc::new(state);
        let serving = async {
            scene_actor.serve_subscribers(false).await;
            scene_actor.flush_readbacks().await;
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
        let folder = tempfile::tempdir().expect("a folder");
        let (mut scene_actor, mut device) = scene(folder.path());
        let (subscribers, feeds): (Vec<_>, Vec<_>) =
            [16, 24, 16].map(|width| subscriber(Delivery::Lossless, width)).into_iter().unzip();
        (scene_actor.count, scene_actor.subscribers) = (1, subscribers);
        let serving = async {
            if has_next {
                let mut begun = Vec::new();
                let mut subscribers = mem::take(&mut scene_actor.subscribers);
                assert!(subscribers.iter_mut().all(|subscriber| scene_actor.begin_frame(subscriber, &mut begun)));
                scene_actor.in_flight.extend(begun);
                scene_actor.subscribers = subscribers;
            } else {
                scene_actor.serve_subscribers(false).await;
            }
            scene_actor.flush_readbacks().await;
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
