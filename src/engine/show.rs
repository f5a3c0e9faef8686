//! Shows the scene's current step: to requests whose step is there, and to viewers that have not seen it.

use std::mem;
use std::sync::Arc;
use std::time::Instant;

use super::conductor::{Conductor, Done};
use super::viewer::{Body, Delivery, Shown, StepName, View, Viewer};
use super::worker::{Asked, Copied};
use crate::deform::Surface;
use crate::error::{Error, Result};
use crate::scene::Cells;
use crate::telemetry::{Stage, StageTimes};

/// Vertices of a step that leave the device while the next step is computed, and who waits for them.
pub(super) struct Late {
    copying: Asked<Copied>,
    /// What is shown with them; `skipped` is each viewer's own.
    step: StepName,
    stages: StageTimes,
    cells: Option<Arc<Cells>>,
    /// With the steps that each has missed.
    viewers: Vec<(Viewer, u64)>,
    /// The step's acknowledgement, which comes after its vertices.
    pub done: Option<Done>,
}

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
    /// writer while `holds_back`, and is cut off when it does so for too long. While a next step waits, vertices are only
    /// begun: they are returned, and come to [`Self::deliver`] once that step is under way.
    pub(super) async fn serve_viewers(&mut self, holds_back: bool) -> Option<Late> {
        let mut late: Vec<(Viewer, u64)> = Vec::new();
        let beside = self.has_next() && self.surface.is_none();
        for mut viewer in mem::take(&mut self.viewers) {
            if viewer.is_gone() {
                continue;
            }
            if beside && viewer.view == View::Vertices && viewer.seen < self.count && viewer.has_room() {
                let skipped = self.see(&mut viewer);
                late.push((viewer, skipped));
            } else if self.serve(&mut viewer, holds_back).await {
                self.viewers.push(viewer);
            }
        }
        (!late.is_empty()).then(|| Late {
            copying: self.means.worker.copy(self.id),
            step: StepName::of(&self.state),
            stages: self.stages.clone(),
            cells: self.state.cells.clone(),
            viewers: late,
            done: None,
        })
    }

    /// Waits for vertices that were begun and hands them over; returns what is to be acknowledged then.
    pub(super) async fn deliver(&mut self, late: Late) -> Option<Done> {
        let Late { copying, step, mut stages, cells, viewers, done } = late;
        let copied = copying.wait().await.map(|(surface, copy_ms)| {
            stages.push((Stage::Copy, copy_ms));
            surface
        });
        for (viewer, skipped) in viewers {
            let body = copied.clone().map(Body::Vertices);
            let (stages, cells) = (stages.clone(), cells.clone());
            if viewer.deliver(body.map(|body| Shown { step, skipped, stages, cells, body })) {
                self.viewers.push(viewer);
            }
        }
        done
    }

    /// Notes that a viewer gets the current step; how many it has missed.
    fn see(&self, viewer: &mut Viewer) -> u64 {
        let skipped = self.count - viewer.seen - 1;
        viewer.seen = self.count;
        viewer.stalled = None;
        skipped
    }

    /// False when the viewer is to be dropped.
    async fn serve(&mut self, viewer: &mut Viewer, holds_back: bool) -> bool {
        if viewer.seen == self.count {
            return true;
        }
        if viewer.has_room() {
            let skipped = self.see(viewer);
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
            View::Vertices => {
                let (surface, copy_ms) = self.vertices().await?;
                stages.push((Stage::Copy, copy_ms));
                Body::Vertices(surface)
            }
        };
        Ok(Shown { step: StepName::of(&self.state), skipped, stages, cells: self.state.cells.clone(), body })
    }

    /// The current vertices, copied from the device at most once per step.
    async fn vertices(&mut self) -> Result<(Arc<Surface>, f64)> {
        if let Some((surface, copy_ms)) = &self.surface {
            return Ok((Arc::clone(surface), *copy_ms));
        }
        let copied = self.means.worker.copy(self.id).wait().await?;
        self.surface = Some(copied.clone());
        Ok(copied)
    }
}

fn known(passes: &[(&'static str, f64)]) -> StageTimes {
    passes.iter().filter_map(|(name, ms)| Some((Stage::named(name)?, *ms))).collect()
}
