//! One subscriber of a scene: its side in the scene ([`Viewer`]) and its side in the reply stream ([`Feed`]). A feed
//! holds at most two pictures; `latest` ones are made only when the feed asks for them.

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

/// How many pictures a lossless subscriber may be behind before it holds back the writer.
const AHEAD: usize = 2;

/// Which steps a subscriber gets.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Delivery {
    /// Every step from the next one on, in order; being slow holds back a lossless writer.
    Lossless,
    /// The newest step, beginning with the current one if there was any.
    Latest,
}

/// What a subscriber wants to see of a step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum View {
    Frame {
        camera: Camera,
        width: u32,
        height: u32,
        showing: Showing,
    },
    Vertices(Wanted),
    /// What a small rectangle of a picture of this size shows.
    Pick {
        camera: Camera,
        picture: [u32; 2],
        rectangle: Rectangle,
    },
}

/// What of a step a frame shows.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub enum Showing {
    #[default]
    Colour,
    /// See [`modalcast_render::Field`].
    Depth,
    Domains,
    Normals,
    /// |u| as a colour map; `largest` metres at its bright end, or 0 for a scale that is fitted to each frame.
    Displacement {
        largest: f64,
    },
    /// One column of U as a colour map, in metres per unit of its coordinate; `largest` as above.
    Mode {
        mode: u32,
        largest: f64,
    },
}

/// A step by name: numbers belong to one run of one writer.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StepName {
    /// 0 before the first step of all.
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

/// What a step looks like.
#[derive(Debug, Clone)]
pub enum Body {
    Frame(Arc<ColorFrame>),
    Vertices(Arc<Surface>),
    /// Numbers in place of colours; a colour map of them when there is a legend.
    Survey(Survey, Option<Legend>),
    Picked(Vec<Picked>),
}

/// A view of one step.
#[derive(Debug, Clone)]
pub struct Shown {
    pub step: StepName,
    /// Steps passed over since this subscriber's last one.
    pub skipped: u64,
    pub stages: StageTimes,
    /// What vertices are relative to, when that is not the scene's origin for all.
    pub cells: Option<Arc<Cells>>,
    pub body: Body,
}

/// Why a feed ends, and whether even a reply under way is broken off.
#[derive(Debug, Clone)]
struct End {
    error: Error,
    now: bool,
}

/// The scene's side.
#[derive(Debug)]
pub(super) struct Viewer {
    pub view: View,
    pub delivery: Delivery,
    /// How many steps the scene had counted at this viewer's last one.
    pub seen: u64,
    /// Since when it holds back the writer.
    pub stalled: Option<Instant>,
    credits: Arc<AtomicUsize>,
    items: mpsc::Sender<Result<Shown>>,
    /// Whether it was given a refusal.
    over: Arc<AtomicBool>,
    end: watch::Sender<Option<End>>,
}

/// A viewer's room for one picture.
#[derive(Debug)]
pub(super) struct Claim {
    items: mpsc::Sender<Result<Shown>>,
    over: Arc<AtomicBool>,
}

impl Claim {
    /// Hands over a picture; a refusal ends the feed. False when the viewer is to be dropped.
    pub(super) fn deliver(self, shown: Result<Shown>) -> bool {
        let lives = shown.is_ok();
        if !lives {
            self.over.store(true, Ordering::Release);
        }
        // There is room for every credit, so this fails only when the other side has gone, or was refused before.
        self.items.try_send(shown).is_ok() && lives
    }

    /// Whether it is this viewer's.
    pub(super) fn is_of(&self, viewer: &Viewer) -> bool {
        self.items.same_channel(&viewer.items)
    }
}

impl Viewer {
    /// Whether it can take a picture now.
    pub(super) fn has_room(&self) -> bool {
        self.credits.load(Ordering::Acquire) > 0
    }

    /// Whether the other side has gone, or was told why it gets no more.
    pub(super) fn is_gone(&self) -> bool {
        self.items.is_closed() || self.over.load(Ordering::Acquire)
    }

    /// Notes that it gets the newest of `count` steps; how many it has missed.
    pub(super) fn see(&mut self, count: u64) -> u64 {
        let skipped = count - self.seen - 1;
        self.seen = count;
        self.stalled = None;
        skipped
    }

    /// Takes the room for one picture, which comes now or later.
    pub(super) fn claim(&self) -> Claim {
        self.credits.fetch_sub(1, Ordering::AcqRel);
        Claim { items: self.items.clone(), over: Arc::clone(&self.over) }
    }

    /// Ends the feed after what it holds.
    pub(super) fn end(&self, error: Error) {
        self.end.send_replace(Some(End { error, now: false }));
    }

    /// Ends the feed at once.
    pub(super) fn cut_off(&self, error: Error) {
        self.end.send_replace(Some(End { error, now: true }));
    }
}

/// The reply stream's side.
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
    /// Both sides of a subscription; `scene` is woken when the feed wants more.
    pub(super) fn new(view: View, delivery: Delivery, scene: Arc<Notify>) -> (Viewer, Self) {
        let ahead = if delivery == Delivery::Lossless { AHEAD } else { 0 };
        let credits = Arc::new(AtomicUsize::new(ahead));
        let (items, inbox) = mpsc::channel(AHEAD);
        let (end, ended) = watch::channel(None);
        let (credit, over) = (Arc::clone(&credits), Arc::default());
        let viewer = Viewer { view, delivery, seen: 0, stalled: None, credits: credit, items, over, end };
        (viewer, Self { delivery, asked: false, credits, items: inbox, end: ended, scene })
    }

    /// Which steps it gets.
    pub(super) const fn delivery(&self) -> Delivery {
        self.delivery
    }

    /// The next picture. Safe to drop while it waits.
    ///
    /// # Errors
    /// Why the feed has ended.
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
            // The scene has ended without a cut: what the feed holds may still be read.
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
        // The scene may be waiting for this very feed.
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
