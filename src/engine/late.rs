//! Device-to-host readbacks in flight. Vertices are read back while the next step is computed; frames are drawn and
//! read back while the next step is computed and its own frames are submitted. Readbacks are delivered in order as they
//! complete. In the diagrams `read` is the transfer of the pixels to host-readable memory.
//!
//! A deformer with its own vertex memory computes concurrently with the frames in flight:
//!
//! ```text
//! deformer  [deform k+1  ]          [deform k+2  ]
//! OpenGL    [draw k][read k][upload][draw k+1][read k+1][upload]
//! ```
//!
//! A deformer that writes into OpenGL buffers does not: mapping them is ordered after all OpenGL commands issued before
//! (`gpu::interop`), including the readback of frame k. Only the host's work overlaps. Step k+1 is recorded and
//! submitted while frame k is drawn, and starts on the device as soon as frame k is read. Frame k is copied out,
//! encoded and sent while frame k+1 is drawn.
//!
//! ```text
//! device    [draw k][read k][deform k+1] [draw k+1][read k+1][deform k+2]
//! host      [submit k+1]                 [submit k+2]
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

/// A device-to-host readback in flight and its subscribers.
pub(super) struct Late {
    leaving: Leaving,
    /// The scene's step count when the readback was started.
    pub count: u64,
    step: StepName,
    stages: StageTimes,
    cells: Option<Arc<Cells>>,
    /// A reserved slot per subscriber, and the number of steps that the subscriber skipped.
    claims: Vec<(Claim, u64)>,
    /// The step's acknowledgement, attached to the last readback of the step and sent after it.
    pub done: Option<Done>,
}

/// The pending result of a readback.
pub(super) enum Leaving {
    Vertices(Asked<Copied>),
    Frame(View, Asked<Image>),
}

impl Leaving {
    fn is_frame_of(&self, wanted: &View) -> bool {
        matches!(self, Self::Frame(view, _) if view == wanted)
    }

    /// Waits for the result; returns it with its stage times. Cancel-safe.
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
    /// A readback of the current step that was just started.
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

    /// Subscribes a viewer with capacity to a frame of the current step that is delivered asynchronously: a frame of
    /// the same view in flight for another viewer, else a new frame, unless [`FRAMES_UNDER_WAY`] were begun already.
    /// `begun` holds frames of this step that are not in the queue of readbacks yet. Returns whether the viewer gets a
    /// frame.
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

    /// Waits for the oldest readback in flight and delivers it. Cancel-safe.
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

    /// Delivers all readbacks of steps whose count is below `count`.
    pub(super) async fn settle_before(&mut self, count: u64) {
        while self.late.front().is_some_and(|late| late.count < count) {
            self.settle_oldest().await;
        }
    }

    /// Delivers all readbacks in flight.
    pub(super) async fn settle(&mut self) {
        self.settle_before(u64::MAX).await;
    }

    /// Delivers readbacks until no vertices are in flight. The submission of the next step does not wait for vertices,
    /// but its results must not overtake them.
    pub(super) async fn settle_vertices(&mut self) {
        while self.late.iter().any(|late| matches!(late.leaving, Leaving::Vertices(_))) {
            self.settle_oldest().await;
        }
    }

    /// Delivers readbacks until none is in flight for `viewer`, so that the viewer can then be served synchronously.
    pub(super) async fn settle_for(&mut self, viewer: &Viewer) {
        while self.late.iter().any(|late| late.claims.iter().any(|(claim, _)| claim.is_of(viewer))) {
            self.settle_oldest().await;
        }
    }
}

impl View {
    /// Camera and size in pixels of a color frame; `None` for other views.
    const fn frame(&self) -> Option<(modalcast_model::scene::Camera, (u32, u32))> {
        match *self {
            Self::Frame { camera, width, height, showing: super::viewer::Showing::Colour } => {
                Some((camera, (width, height)))
            }
            _ => None,
        }
    }
}
