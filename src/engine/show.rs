//! Shows the scene's current step: to requests whose step is there, and to viewers that have not seen it.

use std::mem;
use std::sync::Arc;
use std::time::Instant;

use super::conductor::{Conductor, Copied};
use super::viewer::{Body, Delivery, Shown, StepName, View, Viewer};
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
                Ok(true) => self.show(&ask.view, 0).await,
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
    /// writer while `holds_back`, and is cut off when it does so for too long.
    pub(super) async fn serve_viewers(&mut self, holds_back: bool) {
        for mut viewer in mem::take(&mut self.viewers) {
            if !viewer.is_gone() && self.serve(&mut viewer, holds_back).await {
                self.viewers.push(viewer);
            }
        }
    }

    /// False when the viewer is to be dropped.
    async fn serve(&mut self, viewer: &mut Viewer, holds_back: bool) -> bool {
        if viewer.seen == self.count {
            return true;
        }
        if viewer.has_room() {
            let skipped = self.count - viewer.seen - 1;
            viewer.seen = self.count;
            viewer.stalled = None;
            let shown = self.show(&viewer.view, skipped).await;
            return viewer.deliver(shown);
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

    /// Draws or copies the current step.
    async fn show(&mut self, view: &View, skipped: u64) -> Result<Shown> {
        let mut stages = self.stages.clone();
        let body = match *view {
            View::Frame { camera, width, height } => {
                let image = self.means.worker.draw(self.id, camera, (width, height)).await?;
                stages.extend(known(&image.passes));
                Body::Frame(image)
            }
            View::Vertices(wanted) => {
                let (surface, copy_ms) = self.vertices(wanted).await?;
                stages.push((Stage::Copy, copy_ms));
                Body::Vertices(surface)
            }
        };
        Ok(Shown { step: StepName::of(&self.state), skipped, stages, cells: self.state.cells.clone(), body })
    }

    /// What is wanted of the current vertices, each part of them copied from the device at most once per step.
    async fn vertices(&mut self, wanted: Wanted) -> Result<(Arc<Surface>, f64)> {
        let there = self.surface.as_ref().map_or(Wanted::default(), |copy| copy.parts);
        if let Some(copy) = self.surface.as_ref().filter(|_| there.covers(wanted)) {
            return Ok((Arc::clone(&copy.surface), copy.ms));
        }
        // The device's own copy in host memory has what was there before, so taking it again costs no transfer.
        let parts = there.or(wanted);
        let (surface, ms) = self.means.worker.copy(self.id, parts).await?;
        self.surface = Some(Copied { surface: Arc::clone(&surface), parts, ms });
        Ok((surface, ms))
    }
}

fn known(passes: &[(&'static str, f64)]) -> StageTimes {
    passes.iter().filter_map(|(name, ms)| Some((Stage::named(name)?, *ms))).collect()
}
