//! What is late: vertices that leave the device while the next step is computed, and frames that are drawn and brought back
//! while the next step is computed and its own frames are begun. Each is handed over, in order, as it arrives. `read` is the
//! way of the pixels to memory that the host reads.
//!
//! A deformer with vertices of its own computes beside the frames that are under way:
//!
//! ```text
//! deformer  [deform k+1  ]          [deform k+2  ]
//! OpenGL    [draw k][read k][upload][draw k+1][read k+1][upload]
//! ```
//!
//! One that writes into OpenGL's buffers does not: to map them waits for all that OpenGL was told before (`gpu::interop`),
//! and so for reading frame k too. What overlaps is the host's part. Step k+1 is written and given to the device while
//! frame k is drawn, and begins as soon as that is read; frame k is copied out, encoded and sent while frame k+1 is drawn.
//!
//! ```text
//! device    [draw k][read k][deform k+1] [draw k+1][read k+1][deform k+2]
//! host      [give k+1 ]                  [give k+2 ]
//! frame k                                [copy out, encode, send]
//! ```

use std::sync::Arc;

use super::command::Copied;
use super::conductor::{Conductor, Done, acknowledge};
use super::show::known;
use super::viewer::{Body, Claim, Shown, StepName, View, Viewer};
use super::worker::Asked;
use crate::telemetry::{Stage, StageTimes};
use modalcast_model::error::Result;
use modalcast_model::scene::Cells;
use modalcast_render::{FRAMES_UNDER_WAY, Image};

/// Something of a step that leaves the device, and who waits for it.
pub(super) struct Late {
    leaving: Leaving,
    /// How many steps the scene had counted then.
    pub count: u64,
    step: StepName,
    stages: StageTimes,
    cells: Option<Arc<Cells>>,
    /// With the steps that each has missed.
    claims: Vec<(Claim, u64)>,
    /// The step's acknowledgement, which comes after all that is late of it: with the last.
    pub done: Option<Done>,
}

pub(super) enum Leaving {
    Vertices(Asked<Copied>),
    Frame(View, Asked<Image>),
}

impl Leaving {
    fn is_frame_of(&self, wanted: &View) -> bool {
        matches!(self, Self::Frame(view, _) if view == wanted)
    }

    /// Waits until it is there, with the stages that this took. Safe to drop while it waits.
    async fn there(&mut self) -> Result<(Body, StageTimes)> {
        match self {
            Self::Vertices(copying) => {
                let (surface, ms) = copying.there().await?;
                Ok((Body::Vertices(surface), vec![(Stage::Copy, ms)]))
            }
            Self::Frame(_, drawing) => {
                let image = drawing.there().await?;
                let stages = known(&image.passes);
                Ok((Body::Frame(Arc::new(image.into())), stages))
            }
        }
    }
}

impl Conductor {
    /// Something of the current step that was begun just now.
    pub(super) fn late(&self, leaving: Leaving, claims: Vec<(Claim, u64)>) -> Late {
        Late {
            leaving,
            count: self.count,
            step: StepName::of(&self.state),
            stages: self.stages.clone(),
            cells: self.state.cells.clone(),
            claims,
            done: None,
        }
    }

    /// Gives a viewer with room its frame of the current step late: one of its view that was begun for another viewer, else one
    /// that begins now, unless too many others have. `begun` are the frames of this step that are not in the queue yet. Returns
    /// whether the viewer gets one.
    pub(super) fn begin_frame(&mut self, viewer: &mut Viewer, begun: &mut Vec<Late>) -> bool {
        let Some((camera, size)) = viewer.view.frame() else { return false };
        if viewer.seen == self.count || !viewer.has_room() {
            return false;
        }
        let count = self.count;
        let of_view = |late: &&mut Late| late.count == count && late.leaving.is_frame_of(&viewer.view);
        if let Some(shared) = self.late.iter_mut().chain(begun.iter_mut()).find(of_view) {
            let skipped = viewer.see(count);
            shared.claims.push((viewer.claim(), skipped));
            return true;
        }
        if begun.len() >= FRAMES_UNDER_WAY {
            return false;
        }
        let skipped = viewer.see(count);
        let drawing = self.means.worker.begin_draw(self.id, camera, size);
        begun.push(self.late(Leaving::Frame(viewer.view, drawing), vec![(viewer.claim(), skipped)]));
        true
    }

    /// Waits for what is late for the longest, and hands it over. Safe to drop while it waits.
    pub(super) async fn settle_oldest(&mut self) {
        let Some(late) = self.late.front_mut() else { return };
        let there = late.leaving.there().await;
        let Some(Late { step, stages, cells, claims, done, .. }) = self.late.pop_front() else { return };
        for (claim, skipped) in claims {
            let (before, cells) = (stages.clone(), cells.clone());
            let shown = there.clone().map(|(body, own)| {
                let stages = before.into_iter().chain(own).collect();
                Shown { step, skipped, stages, cells, body }
            });
            claim.deliver(shown);
        }
        self.viewers.retain(|viewer| !viewer.is_gone());
        acknowledge(done);
    }

    /// Hands over all that is late of steps before this one.
    pub(super) async fn settle_before(&mut self, count: u64) {
        while self.late.front().is_some_and(|late| late.count < count) {
            self.settle_oldest().await;
        }
    }

    /// Hands over all that is late.
    pub(super) async fn settle(&mut self) {
        self.settle_before(u64::MAX).await;
    }

    /// Hands over vertices, which the next step was not to wait for and nothing after it is to overtake.
    pub(super) async fn settle_vertices(&mut self) {
        while self.late.iter().any(|late| matches!(late.leaving, Leaving::Vertices(_))) {
            self.settle_oldest().await;
        }
    }

    /// Hands over what is late for a viewer, so that it can be served at once.
    pub(super) async fn settle_for(&mut self, viewer: &Viewer) {
        while self.late.iter().any(|late| late.claims.iter().any(|(claim, _)| claim.is_of(viewer))) {
            self.settle_oldest().await;
        }
    }
}

impl View {
    /// Camera and size of a frame of colours.
    const fn frame(&self) -> Option<(modalcast_model::scene::Camera, (u32, u32))> {
        match *self {
            Self::Frame { camera, width, height, showing: super::viewer::Showing::Colour } => {
                Some((camera, (width, height)))
            }
            _ => None,
        }
    }
}
