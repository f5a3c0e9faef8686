//! Shows the scene's current step: to requests whose step is there, and to viewers that have not seen it.

use std::mem;
use std::sync::Arc;
use std::time::Instant;

use super::conductor::Conductor;
use super::picked::with_transforms;
use super::viewer::{Body, Delivery, Showing, Shown, StepName, View, Viewer};
use crate::deform::Surface;
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
            View::Frame { camera, width, height, showing: Showing::Colour } => {
                let image = self.means.worker.draw(self.id, camera, (width, height)).await?;
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
                Body::Picked(with_transforms(&self.state, hits))
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
        let copied = self.means.worker.copy(self.id).await?;
        self.surface = Some(copied.clone());
        Ok(copied)
    }
}

fn known(passes: &[(&'static str, f64)]) -> StageTimes {
    passes.iter().filter_map(|(name, ms)| Some((Stage::named(name)?, *ms))).collect()
}
