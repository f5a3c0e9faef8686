//! Delivers the scene's current step: to single requests whose step has been reached, and to viewers that have not
//! received the step yet.

use std::mem;
use std::sync::Arc;
use std::time::Instant;

use super::conductor::{Conductor, Held};
use super::late::Leaving;
use super::picked::with_transforms;
use super::viewer::{Body, Delivery, Showing, Shown, StepName, View, Viewer};
use crate::telemetry::{Stage, StageTimes};
use modalcast_model::deform::{Surface, Wanted};
use modalcast_model::error::{Error, Result};

impl Conductor {
    /// Answers every request whose step has been reached or passed; drops requests whose caller no longer waits.
    pub(super) async fn answer_asks(&mut self) {
        for ask in mem::take(&mut self.asks) {
            if ask.reply.is_closed() {
                continue;
            }
            let answer = match self.is_ready(ask.which) {
                Ok(true) => self.show(&ask.view, 0, Wanted::default()).await,
                Ok(false) => {
                    self.asks.push(ask);
                    continue;
                }
                Err(error) => Err(error),
            };
            ask.reply.send(answer).ok(); // Fails only if the caller no longer waits.
        }
    }

    /// Delivers the current step to every viewer with capacity. While `holds_back` is true, a lossless viewer without
    /// capacity blocks the writer (back-pressure) and is cut off after `Config::stall`. If another step is queued,
    /// vertices and at most [`modalcast_render::FRAMES_UNDER_WAY`] frames are only started here; they are delivered
    /// while that step is computed.
    pub(super) async fn serve_viewers(&mut self, holds_back: bool) {
        let viewers = mem::take(&mut self.viewers);
        let wanted = self.wanted(&viewers);
        let beside = self.has_next();
        let copied = beside && !self.there().covers(wanted);
        let (mut readers, mut frames, mut drawn) = (Vec::new(), Vec::new(), Vec::new());
        for mut viewer in viewers {
            if viewer.is_gone() {
                continue;
            }
            // The viewer may have gained capacity after `wanted` was computed, so its own attributes are checked again.
            if copied && self.wants(&viewer).is_some_and(|own| wanted.covers(own)) {
                let skipped = viewer.see(self.count);
                readers.push((viewer.claim(), skipped));
            } else {
                let is_begun = beside && self.begin_frame(&mut viewer, &mut frames);
                if !is_begun && !self.serve(&mut viewer, holds_back, (wanted, &mut drawn)).await {
                    continue;
                }
            }
            self.viewers.push(viewer);
        }
        if !readers.is_empty() {
            let copying = self.means.worker.copy(self.id, wanted);
            self.late.push_back(self.late(Leaving::Vertices(copying), readers));
        }
        self.late.extend(frames);
    }

    /// The vertex attributes that a viewer requests of the current step; `None` if it has no capacity or has received
    /// it.
    fn wants(&self, viewer: &Viewer) -> Option<Wanted> {
        match viewer.view {
            View::Vertices(wanted) if viewer.seen < self.count && viewer.has_room() => Some(wanted),
            _ => None,
        }
    }

    /// The union of the vertex attributes that all viewers request, so that one copy serves them all.
    fn wanted(&self, viewers: &[Viewer]) -> Wanted {
        let there = viewers.iter().filter(|viewer| !viewer.is_gone());
        there.filter_map(|viewer| self.wants(viewer)).fold(Wanted::default(), Wanted::or)
    }

    /// Delivers the current step to one viewer and waits for it. Returns false when the viewer is to be dropped.
    /// `others` are the vertex attributes that all viewers request. `drawn` holds the frames of this step that were
    /// drawn for earlier viewers; viewers with the same view share them.
    async fn serve(
        &mut self,
        viewer: &mut Viewer,
        holds_back: bool,
        (others, drawn): (Wanted, &mut Vec<(View, Shown)>),
    ) -> bool {
        if viewer.seen == self.count {
            return true;
        }
        // Wait for the viewer's readbacks in flight only if it has capacity for a further result.
        if viewer.has_room() {
            self.settle_for(viewer).await;
            let skipped = viewer.see(self.count);
            let shared = drawn.iter().find(|(view, _)| *view == viewer.view);
            let shown = match shared {
                Some((_, shown)) => Ok(Shown { skipped, ..shown.clone() }),
                None => self.show(&viewer.view, skipped, others).await,
            };
            if let (None, Ok(shown @ Shown { body: Body::Frame(_), .. })) = (shared, &shown) {
                drawn.push((viewer.view, shown.clone()));
            }
            return viewer.claim().deliver(shown);
        }
        if !(holds_back && viewer.delivery == Delivery::Lossless) {
            viewer.stalled = None;
            return true;
        }
        let since = *viewer.stalled.get_or_insert_with(Instant::now);
        let is_patient = since.elapsed() < self.means.config.stall;
        if !is_patient {
            let seconds = self.means.config.stall.as_secs();
            tracing::warn!(scene = self.name, seconds, "a lossless subscriber did not read and is cut off");
            viewer.cut_off(Error::Busy { queue: "this lossless subscriber, which did not read,", limit: 2 });
        }
        is_patient
    }

    /// Draws, picks or copies the current step. A copy also covers the attributes in `others`.
    async fn show(&mut self, view: &View, skipped: u64, others: Wanted) -> Result<Shown> {
        let mut stages = self.stages.clone();
        let body = match *view {
            View::Frame { camera, width, height, showing: Showing::Colour } => {
                let image = self.means.worker.begin_draw(self.id, camera, (width, height)).wait().await?;
                stages.extend(known(&image.passes));
                Body::Frame(Arc::new(image.into()))
            }
            View::Frame { camera, width, height, showing } => {
                let (survey, legend) = self.means.worker.survey(self.id, camera, [width, height], showing).await?;
                stages.extend(known(&survey.passes));
                Body::Survey(survey, legend)
            }
            View::Pick { camera, picture, rectangle } => {
                let hits = self.means.worker.pick(self.id, camera, picture, rectangle).await?;
                Body::Picked(with_transforms(&self.state, &self.scene, hits))
            }
            View::Vertices(wanted) => {
                let (surface, copy_ms) = self.vertices((wanted, others)).await?;
                stages.push((Stage::Copy, copy_ms));
                Body::Vertices(surface)
            }
        };
        Ok(Shown { step: StepName::of(&self.state), skipped, stages, cells: self.state.cells.clone(), body })
    }

    /// The attributes of the current vertices that are cached in host memory.
    fn there(&self) -> Wanted {
        self.surface.as_ref().map_or(Wanted::default(), |held| held.parts)
    }

    /// The current vertices with at least the wanted attributes, and the copy's duration in milliseconds. They are
    /// copied from the device once per step unless a later request needs further attributes.
    async fn vertices(&mut self, (wanted, others): (Wanted, Wanted)) -> Result<(Arc<Surface>, f64)> {
        let there = self.there();
        if let Some(held) = self.surface.as_ref().filter(|_| there.covers(wanted)) {
            return Ok((Arc::clone(&held.surface), held.ms));
        }
        // The cached attributes are copied again, so that alternating readers do not evict each other's attributes.
        let parts = there.or(wanted).or(others);
        let (surface, ms) = self.means.worker.copy(self.id, parts).wait().await?;
        self.surface = Some(Held { surface: Arc::clone(&surface), parts, ms });
        Ok((surface, ms))
    }
}

/// The passes of a frame that are stages. The renderer's pass "encode" converts linear light to sRGB bytes and is not
/// [`Stage::Encode`], which is the PNG encoding.
pub(super) fn known(passes: &[(&'static str, f64)]) -> StageTimes {
    let stage = |name: &str| Stage::named(name).filter(|stage| *stage != Stage::Encode);
    passes.iter().filter_map(|(name, ms)| Some((stage(name)?, *ms))).collect()
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use tokio::sync::{Notify, mpsc};
    use tokio::time::timeout;

    use super::super::command::{Command, Reply};
    use super::super::conductor::{Beginning, Means};
    use super::super::keep::Keeper;
    use super::super::viewer::Feed;
    use super::super::{testing, worker::Worker};
    use super::*;
    use crate::config::Config;
    use modalcast_model::scene::{Camera, State};
    use modalcast_render::{Image, Paths};

    /// A scene at its first step, and the receiver of its device commands.
    fn scene(folder: &std::path::Path) -> (Conductor, mpsc::Receiver<Command>) {
        let scene = testing::two_strips();
        let state = Arc::new(State { run: 1, step: 1, ..State::rest(&scene) });
        let (worker, device) = Worker::played();
        let keeper = Arc::new(Keeper::start(folder.to_owned()).expect("starts"));
        let means = Means { worker, keeper, config: Arc::new(Config::default()) };
        let beginning = Beginning { name: "strips".into(), id: 1, scene, state, wake: Arc::new(Notify::new()) };
        (Conductor::new(beginning, means).0, device)
    }

    /// A subscriber to frames of this width in pixels.
    fn viewer(delivery: Delivery, width: u32) -> (Viewer, Feed) {
        let camera = Camera::framing(&testing::two_strips(), width, 8);
        Feed::new(View::Frame { camera, width, height: 8, showing: Showing::Colour }, delivery, Arc::default())
    }

    /// The next frame that is requested from the device within `ms` milliseconds: its width and its reply channel.
    async fn asked(device: &mut mpsc::Receiver<Command>, ms: u64) -> Option<(u32, Reply<Image>)> {
        match timeout(Duration::from_millis(ms), device.recv()).await.ok()?? {
            Command::Draw { size, reply, .. } => Some((size.0, reply)),
            _ => None,
        }
    }

    fn answer((width, reply): (u32, Reply<Image>)) {
        reply
            .send(Ok(Image { width, height: 8, rgba: vec![], passes: vec![], paths: Paths::default() }))
            .expect("somebody waits");
    }

    /// Delivers the second step to a viewer whose frame of the first step is in flight, then to a viewer with capacity.
    /// Returns the width of the frame that is requested before the frame in flight completes, if any, and the widths
    /// and steps that both viewers receive.
    async fn served(late: Delivery) -> (Option<u32>, Vec<(u32, u64)>) {
        let folder = tempfile::tempdir().expect("a folder");
        let (mut conductor, mut device) = scene(folder.path());
        let ((mut slow, mut slow_feed), (fast, mut fast_feed)) = (viewer(late, 16), viewer(Delivery::Lossless, 24));
        // Polling grants a `Latest` feed one credit; a lossless feed has credits from the start.
        timeout(Duration::ZERO, slow_feed.next()).await.expect_err("nothing yet");
        let mut begun = Vec::new();
        assert!(conductor.begin_frame(&mut slow, &mut begun));
        conductor.late.extend(begun);
        let first = asked(&mut device, 10_000).await.expect("the first frame");
        (conductor.count, conductor.viewers) = (2, vec![slow, fast]);
        let state = State { step: 2, ..State::clone(&conductor.state) };
        conductor.state = Arc::new(state);
        let serving = async {
            conductor.serve_viewers(false).await;
            conductor.settle().await;
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
        for feed in [&mut slow_feed, &mut fast_feed] {
            while let Ok(Ok(Shown { step, body: Body::Frame(image), .. })) = timeout(Duration::ZERO, feed.next()).await
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
        let (mut conductor, mut device) = scene(folder.path());
        let (viewers, feeds): (Vec<_>, Vec<_>) =
            [16, 24, 16].map(|width| viewer(Delivery::Lossless, width)).into_iter().unzip();
        (conductor.count, conductor.viewers) = (1, viewers);
        let serving = async {
            if has_next {
                let mut begun = Vec::new();
                let mut viewers = mem::take(&mut conductor.viewers);
                assert!(viewers.iter_mut().all(|viewer| conductor.begin_frame(viewer, &mut begun)));
                conductor.late.extend(begun);
                conductor.viewers = viewers;
            } else {
                conductor.serve_viewers(false).await;
            }
            conductor.settle().await;
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
        for mut feed in feeds {
            let next = timeout(Duration::from_secs(10), feed.next()).await.expect("a frame");
            let Ok(Shown { body: Body::Frame(frame), .. }) = next else { panic!("a frame") };
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
