//! Shows the scene's current step: to requests whose step is there, and to viewers that have not seen it.

use std::mem;
use std::sync::Arc;
use std::time::Instant;

use super::conductor::{Conductor, Held};
use super::late::Leaving;
use super::picked::with_transforms;
use super::viewer::{Body, Delivery, Showing, Shown, StepName, View, Viewer};
use crate::deform::{Surface, Wanted};
use crate::error::{Error, Result};
use crate::telemetry::{Stage, StageTimes};

impl Conductor {
    /// Answers every request whose step is there or gone; forgets those that nobody waits for.
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
            ask.reply.send(answer).ok(); // The asker has gone, and its answer goes with it.
        }
    }

    /// Gives the current step to every viewer that has room for it. A lossless viewer without room holds back the
    /// writer while `holds_back`, and is cut off when it does so for too long. While a next step waits, vertices and a few
    /// frames are only begun: they are late, and handed over once that step is under way.
    pub(super) async fn serve_viewers(&mut self, holds_back: bool) {
        let viewers = mem::take(&mut self.viewers);
        let wanted = self.wanted(&viewers);
        let beside = self.has_next();
        let copied = beside && !self.there().covers(wanted);
        let (mut readers, mut frames) = (Vec::new(), Vec::new());
        for mut viewer in viewers {
            if viewer.is_gone() {
                continue;
            }
            // Room may have come only now.
            if copied && self.wants(&viewer).is_some_and(|own| wanted.covers(own)) {
                let skipped = self.see(&mut viewer);
                readers.push((viewer.claim(), skipped));
            } else if let Some(frame) =
                Some(frames.len()).filter(|_| beside).and_then(|begun| self.begin_frame(&mut viewer, begun))
            {
                frames.push(frame);
            } else {
                self.settle_for(&viewer).await;
                if !self.serve(&mut viewer, holds_back, wanted).await {
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

    /// What a viewer that has room for the current step wants of its vertices.
    fn wants(&self, viewer: &Viewer) -> Option<Wanted> {
        match viewer.view {
            View::Vertices(wanted) if viewer.seen < self.count && viewer.has_room() => Some(wanted),
            _ => None,
        }
    }

    /// What all of them together want, so that one copy serves them.
    fn wanted(&self, viewers: &[Viewer]) -> Wanted {
        let there = viewers.iter().filter(|viewer| !viewer.is_gone());
        there.filter_map(|viewer| self.wants(viewer)).fold(Wanted::default(), Wanted::or)
    }

    /// Notes that a viewer gets the current step; how many it has missed.
    pub(super) fn see(&self, viewer: &mut Viewer) -> u64 {
        let skipped = self.count - viewer.seen - 1;
        viewer.seen = self.count;
        viewer.stalled = None;
        skipped
    }

    /// False when the viewer is to be dropped. `others`: what all viewers want of the vertices.
    async fn serve(&mut self, viewer: &mut Viewer, holds_back: bool, others: Wanted) -> bool {
        if viewer.seen == self.count {
            return true;
        }
        if viewer.has_room() {
            let skipped = self.see(viewer);
            let shown = self.show(&viewer.view, skipped, others).await;
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

    /// Draws or copies the current step; a copy is of what others want too.
    async fn show(&mut self, view: &View, skipped: u64, others: Wanted) -> Result<Shown> {
        let mut stages = self.stages.clone();
        let body = match *view {
            View::Frame { camera, width, height, showing: Showing::Colour } => {
                let image = self.means.worker.begin_draw(self.id, camera, (width, height)).wait().await?;
                stages.extend(known(&image.passes));
                Body::Frame(image)
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

    /// What of the current vertices was copied.
    fn there(&self) -> Wanted {
        self.surface.as_ref().map_or(Wanted::default(), |held| held.parts)
    }

    /// What is wanted of the current vertices, copied from the device once per step unless somebody then asks for more.
    async fn vertices(&mut self, (wanted, others): (Wanted, Wanted)) -> Result<(Arc<Surface>, f64)> {
        let there = self.there();
        if let Some(held) = self.surface.as_ref().filter(|_| there.covers(wanted)) {
            return Ok((Arc::clone(&held.surface), held.ms));
        }
        // What was there before comes again, so that readers in turn do not drive each other out.
        let parts = there.or(wanted).or(others);
        let (surface, ms) = self.means.worker.copy(self.id, parts).wait().await?;
        self.surface = Some(Held { surface: Arc::clone(&surface), parts, ms });
        Ok((surface, ms))
    }
}

/// The stages among the passes of a picture. Its pass "encode" makes bytes of light, and is part of the stage that draws;
/// the stage of that name comes later.
pub(super) fn known(passes: &[(&'static str, f64)]) -> StageTimes {
    let stage = |name: &str| Stage::named(name).filter(|stage| *stage != Stage::Encode);
    passes.iter().filter_map(|(name, ms)| Some((stage(name)?, *ms))).collect()
}
