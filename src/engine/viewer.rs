//! A subscription to a scene: the scene's end ([`Viewer`]) and the reply stream's end ([`Feed`]) of a bounded channel
//! with credit-based flow control. A feed buffers at most two results. With [`Delivery::Latest`] a result is produced
//! only when the feed is polled.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::Instant;

use tokio::sync::{Notify, mpsc, watch};

use super::frame_encoder::ColorFrame;
use super::picked::Picked;
use crate::frame::Legend;
use crate::telemetry::StageTimes;
use modalcast_model::deform::{Surface, Wanted};
use modalcast_model::error::{Error, Result, during};
use modalcast_model::scene::{Camera, Cells, Rectangle, State};
use modalcast_render::Survey;

/// Results that a lossless subscriber may leave unread before it blocks the writer.
const AHEAD: usize = 2;

/// Which steps a subscriber receives.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Delivery {
    /// Every step from the next one on, in order. A slow subscriber blocks a lossless writer; under a `Latest` writer
    /// it skips steps.
    Lossless,
    /// The newest step, starting with the current one if the scene has had a step.
    Latest,
}

/// The result that a subscriber requests of a step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum View {
    Frame {
        camera: Camera,
        width: u32,
        height: u32,
        showing: Showing,
    },
    Vertices(Wanted),
    /// The surface points at the pixels of a rectangle in a picture of this size in pixels.
    Pick {
        camera: Camera,
        picture: [u32; 2],
        rectangle: Rectangle,
    },
}

/// The quantity that a frame shows.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub enum Showing {
    #[default]
    Colour,
    /// See [`modalcast_render::Field`].
    Depth,
    Domains,
    Normals,
    /// |u| as a color map. `largest` is the value at its bright end in meters; 0 fits the scale to each frame.
    Displacement {
        largest: f64,
    },
    /// One column of U as a color map, in meters per unit of its coordinate; `largest` as above.
    Mode {
        mode: u32,
        largest: f64,
    },
}

/// Identifies a step. Step numbers are unique within one run; each writer starts a new run.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StepName {
    /// 0 before the scene's first step.
    pub run: u64,
    pub number: u64,
    /// Simulation time in seconds.
    pub time: f64,
}

impl StepName {
    pub(super) const fn of(state: &State) -> Self {
        Self { run: state.run, number: state.step, time: state.time }
    }
}

/// The content of a result.
#[derive(Debug, Clone)]
pub enum Body {
    Frame(Arc<ColorFrame>),
    Vertices(Arc<Surface>),
    /// Values instead of colors; to be shown as a color map if a legend is present.
    Survey(Survey, Option<Legend>),
    Picked(Vec<Picked>),
}

/// The result of one view of one step.
#[derive(Debug, Clone)]
pub struct Shown {
    pub step: StepName,
    /// Steps that this subscriber skipped since its last result.
    pub skipped: u64,
    pub stages: StageTimes,
    /// The cells that the vertices are relative to; `None` if all are relative to the scene's origin.
    pub cells: Option<Arc<Cells>>,
    pub body: Body,
}

/// Why a feed ends. `now` aborts a reply that is being sent.
#[derive(Debug, Clone)]
struct End {
    error: Error,
    now: bool,
}

/// The scene's end of a subscription.
#[derive(Debug)]
pub(super) struct Viewer {
    pub view: View,
    pub delivery: Delivery,
    /// The scene's step count at this viewer's last result.
    pub seen: u64,
    /// When this viewer began to block the writer.
    pub stalled: Option<Instant>,
    credits: Arc<AtomicUsize>,
    items: mpsc::Sender<Result<Shown>>,
    /// Whether it has received an error, which ends the feed.
    over: Arc<AtomicBool>,
    end: watch::Sender<Option<End>>,
}

/// A permit to send one result to a viewer; it consumes one credit.
#[derive(Debug)]
pub(super) struct Claim {
    items: mpsc::Sender<Result<Shown>>,
    over: Arc<AtomicBool>,
}

impl Claim {
    /// Sends a result; an error ends the feed. Returns false when the viewer is to be dropped.
    pub(super) fn deliver(self, shown: Result<Shown>) -> bool {
        let lives = shown.is_ok();
        if !lives {
            self.over.store(true, Ordering::Release);
        }
        // The channel has capacity for every credit, so this fails only if the feed was dropped or received an error.
        self.items.try_send(shown).is_ok() && lives
    }

    /// Whether the permit belongs to this viewer.
    pub(super) fn is_of(&self, viewer: &Viewer) -> bool {
        self.items.same_channel(&viewer.items)
    }
}

impl Viewer {
    /// Whether the viewer has a credit for a further result.
    pub(super) fn has_room(&self) -> bool {
        self.credits.load(Ordering::Acquire) > 0
    }

    /// Whether the feed was dropped or has received a final error.
    pub(super) fn is_gone(&self) -> bool {
        self.items.is_closed() || self.over.load(Ordering::Acquire)
    }

    /// Records that the viewer receives step number `count` of the scene. Returns how many steps it skipped.
    pub(super) fn see(&mut self, count: u64) -> u64 {
        let skipped = count - self.seen - 1;
        self.seen = count;
        self.stalled = None;
        skipped
    }

    /// Consumes one credit for a result that is sent now or later.
    pub(super) fn claim(&self) -> Claim {
        self.credits.fetch_sub(1, Ordering::AcqRel);
        Claim { items: self.items.clone(), over: Arc::clone(&self.over) }
    }

    /// Ends the feed after its buffered results.
    pub(super) fn end(&self, error: Error) {
        self.end.send_replace(Some(End { error, now: false }));
    }

    /// Ends the feed immediately; see [`Feed::cut_off`].
    pub(super) fn cut_off(&self, error: Error) {
        self.end.send_replace(Some(End { error, now: true }));
    }
}

/// The reply stream's end of a subscription.
#[derive(Debug)]
pub struct Feed {
    delivery: Delivery,
    asked: bool,
    credits: Arc<AtomicUsize>,
    items: mpsc::Receiver<Result<Shown>>,
    end: watch::Receiver<Option<End>>,
    scene: Arc<Notify>,
}

impl Feed {
    /// Creates both ends of a subscription. `scene` is notified whenever the feed grants a credit.
    pub(super) fn new(view: View, delivery: Delivery, scene: Arc<Notify>) -> (Viewer, Self) {
        let ahead = if delivery == Delivery::Lossless { AHEAD } else { 0 };
        let credits = Arc::new(AtomicUsize::new(ahead));
        let (items, inbox) = mpsc::channel(AHEAD);
        let (end, ended) = watch::channel(None);
        let (credit, over) = (Arc::clone(&credits), Arc::default());
        let viewer = Viewer { view, delivery, seen: 0, stalled: None, credits: credit, items, over, end };
        (viewer, Self { delivery, asked: false, credits, items: inbox, end: ended, scene })
    }

    /// Which steps the feed receives.
    pub(super) const fn delivery(&self) -> Delivery {
        self.delivery
    }

    /// The next result. Cancel-safe.
    ///
    /// # Errors
    /// The reason for which the feed has ended.
    pub async fn next(&mut self) -> Result<Shown> {
        if self.delivery == Delivery::Latest && !self.asked {
            self.asked = true;
            self.allow_one();
        }
        let item = self.items.recv().await;
        self.asked = false;
        if self.delivery == Delivery::Lossless {
            self.allow_one();
        }
        item.unwrap_or_else(|| Err(self.reason()))
    }

    /// Waits until the feed is cut off.
    pub async fn cut_off(&self) -> Error {
        let mut end = self.end.clone();
        let is_cut = |end: &Option<End>| end.as_ref().is_some_and(|end| end.now);
        match end.wait_for(is_cut).await.map(|end| end.clone()) {
            Ok(Some(end)) => end.error,
            // The scene has ended without a cut-off, so buffered results may still be read.
            _ => std::future::pending().await,
        }
    }

    fn allow_one(&self) {
        self.credits.fetch_add(1, Ordering::AcqRel);
        self.scene.notify_one();
    }

    fn reason(&self) -> Error {
        let end = self.end.borrow();
        end.as_ref().map_or_else(|| during("scene")("it stopped"), |end| end.error.clone())
    }
}

impl Drop for Feed {
    fn drop(&mut self) {
        // This feed may be the one that blocks the scene's writer.
        self.items.close();
        self.scene.notify_one();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shown(number: u64) -> Result<Shown> {
        let step = StepName { run: 1, number, time: 0.0 };
        Ok(Shown { step, skipped: 0, stages: vec![], cells: None, body: Body::Vertices(Arc::default()) })
    }

    #[tokio::test]
    async fn a_lossless_viewer_has_room_for_two_and_gets_more_as_it_reads() {
        let (viewer, mut feed) = Feed::new(View::Vertices(Wanted::VERTICES), Delivery::Lossless, Arc::default());
        for number in 1..=2 {
            assert!(viewer.has_room() && viewer.claim().deliver(shown(number)));
        }
        assert!(!viewer.has_room());
        assert_eq!(feed.next().await.expect("the first").step.number, 1);
        assert!(viewer.has_room());
    }

    #[tokio::test]
    async fn a_latest_viewer_has_room_only_while_it_asks_and_asks_once() {
        let (viewer, mut feed) = Feed::new(View::Vertices(Wanted::VERTICES), Delivery::Latest, Arc::default());
        assert!(!viewer.has_room());
        for _ in 0..3 {
            let given_up = tokio::time::timeout(std::time::Duration::ZERO, feed.next()).await;
            assert!(given_up.is_err());
        }
        assert!(viewer.has_room() && viewer.claim().deliver(shown(4)) && !viewer.has_room());
        assert_eq!(feed.next().await.expect("the newest").step.number, 4);
    }

    #[tokio::test]
    async fn an_end_is_told_after_what_is_held_and_a_cut_at_once() {
        let (viewer, mut feed) = Feed::new(View::Vertices(Wanted::VERTICES), Delivery::Lossless, Arc::default());
        viewer.claim().deliver(shown(1));
        let error = Error::NotFound { what: "scene", given: "gone".into() };
        viewer.end(error.clone());
        drop(viewer);
        assert!(feed.next().await.is_ok());
        assert_eq!(feed.next().await.expect_err("the end"), error);

        let (viewer, feed) = Feed::new(View::Vertices(Wanted::VERTICES), Delivery::Lossless, Arc::default());
        viewer.cut_off(error.clone());
        drop(viewer);
        assert_eq!(feed.cut_off().await, error);
    }
}
