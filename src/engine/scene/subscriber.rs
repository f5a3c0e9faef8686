//! A subscription to a scene: a bounded channel with credit-based flow control. The scene owns the [`Subscriber`],
//! which sends results. The reply stream owns the [`Subscription`], which receives them and grants credits.
//!
//! A credit permits the scene to send one more result. The channel buffers at most two results. With
//! [`Delivery::Latest`], [`Subscription::next`] grants a credit when it is polled, so a result is produced only then.
//! If the future of `next` is dropped, the next call returns the result that the dropped future has requested, even if
//! the scene has completed a later step since. [`Subscription::with_min_interval`] delays the credit.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use tokio::sync::{Notify, mpsc, watch};

use super::delivery::Delivery;
use crate::engine::output::step_output::{OutputSpec, StepOutput};
use modalcast_model::error::{Error, Result, fault};

/// Number of results that a lossless subscriber may leave unread before it blocks the writer. Also the capacity of the
/// channel.
pub(super) const LOSSLESS_CREDITS: usize = 2;

/// Why a subscription ends.
#[derive(Debug, Clone)]
struct EndReason {
    error: Error,
    /// Whether a reply that is being sent is aborted.
    is_immediate: bool,
}

/// The sender of a subscription, owned by the scene.
#[derive(Debug)]
pub(in crate::engine) struct Subscriber {
    pub spec: OutputSpec,
    pub delivery: Delivery,
    /// The scene's step count at this subscriber's last result.
    pub delivered_step_count: u64,
    /// When this subscriber began to block the writer.
    pub stalled_since: Option<Instant>,
    /// Number of results that may be sent now. The subscription grants credits.
    credits: Arc<AtomicUsize>,
    results: mpsc::Sender<Result<StepOutput>>,
    /// Whether an error was sent, which ends the subscription.
    is_error_sent: Arc<AtomicBool>,
    end: watch::Sender<Option<EndReason>>,
}

/// A permit to send one result to a subscriber. It has consumed one credit.
#[derive(Debug)]
pub(in crate::engine) struct SendPermit {
    results: mpsc::Sender<Result<StepOutput>>,
    is_error_sent: Arc<AtomicBool>,
}

impl SendPermit {
    /// Sends a result. An error ends the subscription. Returns false if the subscriber must be dropped.
    pub(in crate::engine) fn send(self, output: Result<StepOutput>) -> bool {
        let is_output = output.is_ok();
        if !is_output {
            self.is_error_sent.store(true, Ordering::Release);
        }
        // The channel has capacity for every credit, so this fails only if the subscription was dropped or has ended.
        self.results.try_send(output).is_ok() && is_output
    }

    /// Whether the permit belongs to this subscriber.
    pub(in crate::engine) fn belongs_to(&self, subscriber: &Subscriber) -> bool {
        self.results.same_channel(&subscriber.results)
    }
}

impl Subscriber {
    /// Whether the subscriber has a credit for a further result.
    pub(in crate::engine) fn has_credit(&self) -> bool {
        self.credits.load(Ordering::Acquire) > 0
    }

    /// Whether the subscription was dropped or an error was sent.
    pub(in crate::engine) fn is_closed(&self) -> bool {
        self.results.is_closed() || self.is_error_sent.load(Ordering::Acquire)
    }

    /// Records the delivery of the scene's `step_count`-th step. Returns how many steps the subscriber has skipped.
    pub(in crate::engine) fn mark_delivered(&mut self, step_count: u64) -> u64 {
        let skipped = step_count - self.delivered_step_count - 1;
        self.delivered_step_count = step_count;
        self.stalled_since = None;
        skipped
    }

    /// Consumes one credit for a result that is sent now or later.
    pub(in crate::engine) fn take_permit(&self) -> SendPermit {
        self.credits.fetch_sub(1, Ordering::AcqRel);
        SendPermit { results: self.results.clone(), is_error_sent: Arc::clone(&self.is_error_sent) }
    }

    /// Ends the subscription after its buffered results.
    pub(in crate::engine) fn end(&self, error: Error) {
        self.end.send_replace(Some(EndReason { error, is_immediate: false }));
    }

    /// Ends the subscription immediately; see [`Subscription::disconnected`].
    pub(in crate::engine) fn disconnect(&self, error: Error) {
        self.end.send_replace(Some(EndReason { error, is_immediate: true }));
    }
}

/// The receiver of a subscription, owned by a reply stream.
#[derive(Debug)]
pub struct Subscription {
    delivery: Delivery,
    /// Whether a `Latest` subscription has granted a credit whose result was not received yet.
    has_granted_credit: bool,
    /// Minimum time between a result and the credit for the next one.
    min_interval: Duration,
    /// Earliest time of the next credit of a `Latest` subscription; `None` if it may be granted at once.
    next_credit_at: Option<Instant>,
    credits: Arc<AtomicUsize>,
    results: mpsc::Receiver<Result<StepOutput>>,
    end: watch::Receiver<Option<EndReason>>,
    /// Wakes the scene: a credit was granted or the subscription was dropped.
    scene_wake: Arc<Notify>,
}

impl Subscription {
    /// Creates both ends of a subscription. `scene_wake` is notified whenever the subscription grants a credit.
    pub(in crate::engine) fn new(spec: OutputSpec, delivery: Delivery, scene_wake: Arc<Notify>) -> (Subscriber, Self) {
        let initial_credits = if delivery == Delivery::Lossless { LOSSLESS_CREDITS } else { 0 };
        let credits = Arc::new(AtomicUsize::new(initial_credits));
        let (result_sender, results) = mpsc::channel(LOSSLESS_CREDITS);
        let (end_sender, end) = watch::channel(None);
        let subscriber = Subscriber {
            spec,
            delivery,
            delivered_step_count: 0,
            stalled_since: None,
            credits: Arc::clone(&credits),
            results: result_sender,
            is_error_sent: Arc::default(),
            end: end_sender,
        };
        let subscription = Self {
            delivery,
            has_granted_credit: false,
            min_interval: Duration::ZERO,
            next_credit_at: None,
            credits,
            results,
            end,
            scene_wake,
        };
        (subscriber, subscription)
    }

    /// Limits the rate of a [`Delivery::Latest`] subscription: the credit for a result is granted at the earliest this
    /// time after the previous result. No effect on a lossless one.
    #[must_use]
    pub fn with_min_interval(mut self, min_interval: Duration) -> Self {
        self.min_interval = min_interval;
        self
    }

    /// Which steps the subscription receives.
    pub(in crate::engine) const fn delivery(&self) -> Delivery {
        self.delivery
    }

    /// Waits for the next result. Cancel-safe.
    ///
    /// # Errors
    /// The error with which the subscription has ended.
    pub async fn next(&mut self) -> Result<StepOutput> {
        if self.delivery == Delivery::Latest && !self.has_granted_credit {
            if let Some(next_credit_at) = self.next_credit_at {
                self.sleep_until(next_credit_at).await?;
            }
            self.has_granted_credit = true;
            self.grant_credit();
        }
        let result = self.results.recv().await;
        self.has_granted_credit = false;
        if self.delivery == Delivery::Lossless {
            self.grant_credit();
        } else if !self.min_interval.is_zero() {
            self.next_credit_at = Instant::now().checked_add(self.min_interval);
        }
        result.unwrap_or_else(|| Err(self.end_error()))
    }

    /// Waits until the scene disconnects the subscriber, and returns the reason. Pends forever if the subscription ends
    /// in another way.
    pub async fn disconnected(&self) -> Error {
        let mut end_receiver = self.end.clone();
        let is_immediate = |end: &Option<EndReason>| end.as_ref().is_some_and(|end| end.is_immediate);
        match end_receiver.wait_for(is_immediate).await.map(|end| end.clone()) {
            Ok(Some(end)) => end.error,
            // The scene has ended without disconnecting the subscriber, so buffered results may still be read.
            _ => std::future::pending().await,
        }
    }

    /// Waits for a time. Cancel-safe.
    ///
    /// # Errors
    /// The error with which the subscription ends in the meantime.
    async fn sleep_until(&mut self, time: Instant) -> Result<()> {
        tokio::select! {
            () = tokio::time::sleep_until(time.into()) => Ok(()),
            // No credit is granted, so no result arrives.
            _ = self.results.recv() => Err(self.end_error()),
        }
    }

    fn grant_credit(&self) {
        self.credits.fetch_add(1, Ordering::AcqRel);
        self.scene_wake.notify_one();
    }

    fn end_error(&self) -> Error {
        let end = self.end.borrow();
        end.as_ref().map_or_else(|| fault("scene", "the scene ended without an error"), |end| end.error.clone())
    }
}

impl Drop for Subscription {
    fn drop(&mut self) {
        // This subscription may have blocked the scene's writer.
        self.results.close();
        self.scene_wake.notify_one();
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

    fn subscribe(delivery: Delivery) -> (Subscriber, Subscription) {
        Subscription::new(OutputSpec::Vertices(VertexAttributes::POSITIONS_AND_NORMALS), delivery, Arc::default())
    }

    #[tokio::test]
    async fn lossless_subscription_grants_one_credit_per_result() {
        let (subscriber, mut subscription) = subscribe(Delivery::Lossless);
        for number in 1..=2 {
            assert!(subscriber.has_credit() && subscriber.take_permit().send(output(number)));
        }
        assert!(!subscriber.has_credit());
        assert_eq!(subscription.next().await.expect("expected the first result").step.number, 1);
        assert!(subscriber.has_credit());
    }

    #[tokio::test]
    async fn latest_subscription_grants_one_credit_when_polled() {
        let (subscriber, mut subscription) = subscribe(Delivery::Latest);
        assert!(!subscriber.has_credit());
        for _ in 0..3 {
            let result = tokio::time::timeout(std::time::Duration::ZERO, subscription.next()).await;
            assert!(result.is_err(), "expected no result yet");
        }
        assert!(subscriber.has_credit() && subscriber.take_permit().send(output(4)) && !subscriber.has_credit());
        assert_eq!(subscription.next().await.expect("expected the sent result").step.number, 4);
    }

    #[tokio::test]
    async fn end_comes_after_buffered_results() {
        let (subscriber, mut subscription) = subscribe(Delivery::Lossless);
        subscriber.take_permit().send(output(1));
        let error = Error::NotFound { what: "scene", given: "'closed'".into() };
        subscriber.end(error.clone());
        drop(subscriber);
        assert!(subscription.next().await.is_ok());
        assert_eq!(subscription.next().await.expect_err("expected the end"), error);
    }

    #[tokio::test]
    async fn disconnection_is_reported_immediately() {
        let (subscriber, subscription) = subscribe(Delivery::Lossless);
        let error = Error::Busy { queue: "queue of unread results", limit: LOSSLESS_CREDITS };
        subscriber.disconnect(error.clone());
        drop(subscriber);
        assert_eq!(subscription.disconnected().await, error);
    }
}
