//! A subscription to a scene: the scene's end ([`Subscriber`]) and the reply stream's end ([`Subscription`]) of a bounded channel
//! with credit-based flow control. A feed buffers at most two results. With [`Delivery::Latest`] a result is produced
//! only when the feed is polled. If the future of that poll is dropped, the next poll returns the result that the first
//! one requested, even if the scene shows a later step by then.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::Instant;

use tokio::sync::{Notify, mpsc, watch};

use crate::engine::output::step_output::{OutputSpec, StepOutput};
use modalcast_model::error::{Error, Result, fault_in};

/// Results that a lossless subscriber may leave unread before it blocks the writer.
const LOSSLESS_CREDITS: usize = 2;

/// Which steps a subscriber receives.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Delivery {
    /// Every step from the next one on, in order. A slow subscriber blocks a lossless writer; under a `Latest` writer
    /// it skips steps.
    Lossless,
    /// The newest step, starting with the current one if the scene has had a step.
    Latest,
}

/// Why a feed ends. `immediate` aborts a reply that is being sent.
#[derive(Debug, Clone)]
struct EndReason {
    error: Error,
    immediate: bool,
}

/// The scene's end of a subscription.
#[derive(Debug)]
pub(in crate::engine) struct Subscriber {
    pub spec: OutputSpec,
    pub delivery: Delivery,
    /// The scene's step count at this viewer's last result.
    pub delivered_count: u64,
    /// When this viewer began to block the writer.
    pub stalled_since: Option<Instant>,
    credits: Arc<AtomicUsize>,
    items: mpsc::Sender<Result<StepOutput>>,
    /// Whether it has received an error, which ends the feed.
    error_sent: Arc<AtomicBool>,
    end: watch::Sender<Option<EndReason>>,
}

/// A permit to send one result to a viewer; it consumes one credit.
#[derive(Debug)]
pub(in crate::engine) struct SendPermit {
    items: mpsc::Sender<Result<StepOutput>>,
    error_sent: Arc<AtomicBool>,
}

impl SendPermit {
    /// Sends a result; an error ends the feed. Returns false when the viewer is to be dropped.
    pub(in crate::engine) fn send(self, output: Result<StepOutput>) -> bool {
        let lives = output.is_ok();
        if !lives {
            self.error_sent.store(true, Ordering::Release);
        }
        // The channel has capacity for every credit, so this fails only if the feed was dropped or received an error.
        self.items.try_send(output).is_ok() && lives
    }

    /// Whether the permit belongs to this viewer.
    pub(in crate::engine) fn belongs_to(&self, subscriber: &Subscriber) -> bool {
        self.items.same_channel(&subscriber.items)
    }
}

impl Subscriber {
    /// Whether the viewer has a credit for a further result.
    pub(in crate::engine) fn has_credit(&self) -> bool {
        self.credits.load(Ordering::Acquire) > 0
    }

    /// Whether the feed was dropped or has received a final error.
    pub(in crate::engine) fn is_closed(&self) -> bool {
        self.items.is_closed() || self.error_sent.load(Ordering::Acquire)
    }

    /// Records that the viewer receives step number `count` of the scene. Returns how many steps it skipped.
    pub(in crate::engine) fn mark_delivered(&mut self, count: u64) -> u64 {
        let skipped = count - self.delivered_count - 1;
        self.delivered_count = count;
        self.stalled_since = None;
        skipped
    }

    /// Consumes one credit for a result that is sent now or later.
    pub(in crate::engine) fn take_permit(&self) -> SendPermit {
        self.credits.fetch_sub(1, Ordering::AcqRel);
        SendPermit { items: self.items.clone(), error_sent: Arc::clone(&self.error_sent) }
    }

    /// Ends the feed after its buffered results.
    pub(in crate::engine) fn end(&self, error: Error) {
        self.end.send_replace(Some(EndReason { error, immediate: false }));
    }

    /// Ends the feed immediately; see [`Subscription::cut_off`].
    pub(in crate::engine) fn disconnect(&self, error: Error) {
        self.end.send_replace(Some(EndReason { error, immediate: true }));
    }
}

/// The reply stream's end of a subscription.
#[derive(Debug)]
pub struct Subscription {
    delivery: Delivery,
    credit_requested: bool,
    credits: Arc<AtomicUsize>,
    items: mpsc::Receiver<Result<StepOutput>>,
    end: watch::Receiver<Option<EndReason>>,
    scene: Arc<Notify>,
}

impl Subscription {
    /// Creates both ends of a subscription. `scene` is notified whenever the feed grants a credit.
    pub(in crate::engine) fn new(spec: OutputSpec, delivery: Delivery, scene: Arc<Notify>) -> (Subscriber, Self) {
        let ahead = if delivery == Delivery::Lossless { LOSSLESS_CREDITS } else { 0 };
        let credits = Arc::new(AtomicUsize::new(ahead));
        let (items, inbox) = mpsc::channel(LOSSLESS_CREDITS);
        let (end, ended) = watch::channel(None);
        let (credit, error_sent) = (Arc::clone(&credits), Arc::default());
        let subscriber = Subscriber {
            spec,
            delivery,
            delivered_count: 0,
            stalled_since: None,
            credits: credit,
            items,
            error_sent,
            end,
        };
        (subscriber, Self { delivery, credit_requested: false, credits, items: inbox, end: ended, scene })
    }

    /// Which steps the feed receives.
    pub(in crate::engine) const fn delivery(&self) -> Delivery {
        self.delivery
    }

    /// The next result. Cancel-safe.
    ///
    /// # Errors
    /// The reason for which the feed has ended.
    pub async fn next(&mut self) -> Result<StepOutput> {
        if self.delivery == Delivery::Latest && !self.credit_requested {
            self.credit_requested = true;
            self.add_credit();
        }
        let item = self.items.recv().await;
        self.credit_requested = false;
        if self.delivery == Delivery::Lossless {
            self.add_credit();
        }
        item.unwrap_or_else(|| Err(self.reason()))
    }

    /// Waits until the feed is cut off.
    pub async fn disconnected(&self) -> Error {
        let mut end = self.end.clone();
        let is_cut = |end: &Option<EndReason>| end.as_ref().is_some_and(|end| end.immediate);
        match end.wait_for(is_cut).await.map(|end| end.clone()) {
            Ok(Some(end)) => end.error,
            // The scene has ended without a cut-off, so buffered results may still be read.
            _ => std::future::pending().await,
        }
    }

    fn add_credit(&self) {
        self.credits.fetch_add(1, Ordering::AcqRel);
        self.scene.notify_one();
    }

    fn reason(&self) -> Error {
        let end = self.end.borrow();
        end.as_ref().map_or_else(|| fault_in("scene")("it stopped"), |end| end.error.clone())
    }
}

impl Drop for Subscription {
    fn drop(&mut self) {
        // This feed may be the one that blocks the scene's writer.
        self.items.close();
        self.scene.notify_one();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::output::step_output::{OutputBody, StepId};
    use modalcast_model::deform::VertexAttributes;

    fn output(number: u64) -> Result<StepOutput> {
        let step = StepId { run: 1, number, time: 0.0 };
        Ok(StepOutput { step, skipped: 0, stages: vec![], origins: None, body: OutputBody::Vertices(Arc::default()) })
    }

    #[tokio::test]
    async fn a_lossless_viewer_has_room_for_two_and_gets_more_as_it_reads() {
        let (subscriber, mut subscription) =
            Subscription::new(OutputSpec::Vertices(VertexAttributes::VERTICES), Delivery::Lossless, Arc::default());
        for number in 1..=2 {
            assert!(subscriber.has_credit() && subscriber.take_permit().send(output(number)));
        }
        assert!(!subscriber.has_credit());
        assert_eq!(subscription.next().await.expect("the first").step.number, 1);
        assert!(subscriber.has_credit());
    }

    #[tokio::test]
    async fn a_latest_viewer_has_room_only_while_it_asks_and_asks_once() {
        let (subscriber, mut subscription) =
            Subscription::new(OutputSpec::Vertices(VertexAttributes::VERTICES), Delivery::Latest, Arc::default());
        assert!(!subscriber.has_credit());
        for _ in 0..3 {
            let given_up = tokio::time::timeout(std::time::Duration::ZERO, subscription.next()).await;
            assert!(given_up.is_err());
        }
        assert!(subscriber.has_credit() && subscriber.take_permit().send(output(4)) && !subscriber.has_credit());
        assert_eq!(subscription.next().await.expect("the newest").step.number, 4);
    }

    #[tokio::test]
    async fn an_end_is_told_after_what_is_held_and_a_cut_at_once() {
        let (subscriber, mut subscription) =
            Subscription::new(OutputSpec::Vertices(VertexAttributes::VERTICES), Delivery::Lossless, Arc::default());
        subscriber.take_permit().send(output(1));
        let error = Error::NotFound { what: "scene", given: "gone".into() };
        subscriber.end(error.clone());
        drop(subscriber);
        assert!(subscription.next().await.is_ok());
        assert_eq!(subscription.next().await.expect_err("the end"), error);

        let (subscriber, subscription) =
            Subscription::new(OutputSpec::Vertices(VertexAttributes::VERTICES), Delivery::Lossless, Arc::default());
        subscriber.disconnect(error.clone());
        drop(subscriber);
        assert_eq!(subscription.disconnected().await, error);
    }
}
