//! A subscription to a scene: a bounded channel with credit-based flow control. The scene owns the [`Subscriber`],
//! which sends results. The reply stream owns the [`Subscription`], which receives them and grants credits.
//!
//! A credit permits the scene to send one more result. The channel buffers at most two results. With
//! [`Delivery::Latest`], [`Subscription::next`] grants a credit when it is polled, so a result is produced only then.
//! A limit on the rate delays this credit, so nothing is drawn or copied that is not sent.
//! If the future of `next` is dropped, the next call returns the result that the dropped future has requested, even if
//! the scene has completed a later step since.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use tokio::sync::{Notify, mpsc, watch};

use super::delivery::{Delivery, StreamDelivery};
use super::frame_stream::{CameraControl, CameraState};
use super::stall_budget::StallTime;
use super::work_timer::WorkTimer;
use crate::admission::{Account, Permit};
use crate::engine::lock::lock;
use crate::engine::output::output_spec::{OutputSpec, PictureContent};
use crate::engine::output::step_output::StepOutput;
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

/// The beginning of a wait of the writer for a subscriber.
#[derive(Debug, Clone, Copy)]
struct StallStart {
    begun_at: Instant,
    /// The time for which the server has worked for the subscription until then.
    work: Duration,
}

/// The sender of a subscription, owned by the scene.
#[derive(Debug)]
pub(in crate::engine) struct Subscriber {
    pub spec: OutputSpec,
    pub delivery: Delivery,
    /// The scene's step count at this subscriber's last result.
    pub delivered_step_count: u64,
    /// The client of the subscription.
    pub account: Account,
    /// How long the writer has waited for this client.
    pub(super) stall_time: StallTime,
    /// Set while the writer waits for this subscriber.
    stall_start: Option<StallStart>,
    work_timer: Arc<WorkTimer>,
    /// The pictures with their present cameras; `None` for other outputs than frames.
    cameras: Option<watch::Receiver<CameraState>>,
    /// The version of the cameras in this subscriber's last result.
    delivered_camera_version: u64,
    /// The forms in which the subscription reads color pictures.
    content: Arc<Mutex<PictureContent>>,
    /// Number of results that may be sent now. The subscription grants credits.
    credits: Arc<AtomicUsize>,
    results: mpsc::Sender<StepOutput>,
    end: watch::Sender<Option<EndReason>>,
}

impl Subscriber {
    /// Whether the subscriber has a credit for a further result.
    pub(in crate::engine) fn has_credit(&self) -> bool {
        self.credits.load(Ordering::Acquire) > 0
    }

    /// The forms in which color pictures are read; `None` for other outputs than frames.
    pub(in crate::engine) fn content(&self) -> Option<PictureContent> {
        self.cameras.as_ref().map(|_| *lock(&self.content))
    }

    /// Whether the subscription was dropped.
    pub(in crate::engine) fn is_closed(&self) -> bool {
        self.results.is_closed()
    }

    /// Whether this is a lossless subscriber that has not received the scene's `step_count`-th step.
    pub(in crate::engine) fn lacks_step(&self, step_count: u64) -> bool {
        self.delivery == Delivery::Lossless && self.delivered_step_count < step_count
    }

    /// Whether the subscriber waits for its client, not for the server's own work.
    pub(in crate::engine) fn waits_for_client(&self) -> bool {
        !self.work_timer.is_running()
    }

    /// Marks the beginning of a wait of the writer for this subscriber.
    pub(in crate::engine) fn begin_stall(&mut self, now: Instant) {
        self.stall_start = Some(StallStart { begun_at: now, work: self.work_timer.total(now) });
    }

    /// Ends a wait of the writer for this subscriber. Returns its time without the server's own work, or `None` if the
    /// writer did not wait.
    pub(in crate::engine) fn end_stall(&mut self, now: Instant) -> Option<Duration> {
        let StallStart { begun_at, work } = self.stall_start.take()?;
        let work = self.work_timer.total(now).saturating_sub(work);
        Some(now.saturating_duration_since(begun_at).saturating_sub(work))
    }

    /// Waits until the subscription is dropped. Cancel-safe.
    pub(in crate::engine) async fn closed(&self) {
        self.results.closed().await;
    }

    /// Whether a camera has moved since the last result.
    pub(in crate::engine) fn has_moved_camera(&self) -> bool {
        let is_newer =
            |cameras: &watch::Receiver<CameraState>| cameras.borrow().camera_version > self.delivered_camera_version;
        self.cameras.as_ref().is_some_and(is_newer)
    }

    /// The pictures with their present cameras, whose version is recorded as delivered. `None` for other outputs than
    /// frames.
    pub(in crate::engine) fn take_pictures(&mut self) -> Option<CameraState> {
        let state = self.cameras.as_ref()?.borrow().clone();
        self.delivered_camera_version = state.camera_version;
        Some(state)
    }

    /// Records the delivery of the scene's `step_count`-th step. Returns how many steps the subscriber has skipped. A
    /// step may be delivered again with moved cameras.
    pub(in crate::engine) fn mark_delivered(&mut self, step_count: u64) -> u64 {
        let skipped = (step_count - self.delivered_step_count).saturating_sub(1);
        self.delivered_step_count = step_count;
        skipped
    }

    /// Sends a result, which consumes one credit. Returns false if the subscriber must be dropped.
    pub(in crate::engine) fn send(&self, output: StepOutput) -> bool {
        self.credits.fetch_sub(1, Ordering::AcqRel);
        // The channel has capacity for every credit, so this fails only if the subscription was dropped.
        self.results.try_send(output).is_ok()
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
    delivery: StreamDelivery,
    cameras: Option<CameraControl>,
    /// Whether a `Latest` subscription has granted a credit whose result was not received yet.
    has_granted_credit: bool,
    rate_limiter: Option<RateLimiter>,
    content: Arc<Mutex<PictureContent>>,
    work_timer: Arc<WorkTimer>,
    credits: Arc<AtomicUsize>,
    results: mpsc::Receiver<StepOutput>,
    end: watch::Receiver<Option<EndReason>>,
    permit: Permit,
    /// Wakes the scene: a credit was granted or the subscription was dropped.
    scene_wake: Arc<Notify>,
}

impl Subscription {
    /// Creates both ends of a subscription. `scene_wake` is notified whenever the subscription grants a credit.
    pub(in crate::engine) fn new(
        permit: Permit,
        spec: OutputSpec,
        delivery: StreamDelivery,
        scene_wake: Arc<Notify>,
    ) -> (Subscriber, Self) {
        let initial_credits = if delivery.delivery() == Delivery::Lossless { LOSSLESS_CREDITS } else { 0 };
        let credits = Arc::new(AtomicUsize::new(initial_credits));
        let content = Arc::new(Mutex::new(PictureContent::PIXELS));
        let work_timer = Arc::new(WorkTimer::default());
        let (result_sender, results) = mpsc::channel(LOSSLESS_CREDITS);
        let (end_sender, end) = watch::channel(None);
        let cameras = match &spec {
            OutputSpec::Frames(pictures) => Some(CameraControl::new(Arc::clone(pictures), Arc::clone(&scene_wake))),
            _ => None,
        };
        let subscriber = Subscriber {
            spec,
            delivery: delivery.delivery(),
            delivered_step_count: 0,
            account: permit.handle().account(),
            stall_time: StallTime::new(Duration::ZERO, Instant::now()),
            stall_start: None,
            work_timer: Arc::clone(&work_timer),
            cameras: cameras.as_ref().map(CameraControl::receiver),
            delivered_camera_version: 0,
            content: Arc::clone(&content),
            credits: Arc::clone(&credits),
            results: result_sender,
            end: end_sender,
        };
        let rate_limiter =
            delivery.min_interval().map(|interval| RateLimiter { interval, next_credit: Instant::now() });
        let has_granted_credit = false;
        let subscription = Self {
            delivery,
            cameras,
            has_granted_credit,
            rate_limiter,
            content,
            work_timer,
            credits,
            results,
            end,
            permit,
            scene_wake,
        };
        (subscriber, subscription)
    }

    /// Tells the scene in which forms color pictures are read: pixels until the first call. A picture that was started
    /// before has the former content.
    pub(in crate::engine) fn set_content(&self, content: PictureContent) {
        *lock(&self.content) = content;
    }

    /// Which steps the subscription receives, and the limit on their rate.
    pub const fn delivery(&self) -> StreamDelivery {
        self.delivery
    }

    /// Measures the server's own work on the results. All other time between two results counts as time of the client.
    pub const fn work_timer(&self) -> &Arc<WorkTimer> {
        &self.work_timer
    }

    /// Moves the cameras of a subscription to frames; `None` for other outputs.
    pub const fn cameras(&self) -> Option<&CameraControl> {
        self.cameras.as_ref()
    }

    /// Waits for the next result. Cancel-safe.
    ///
    /// # Errors
    /// The error with which the subscription has ended; `Preempted`.
    pub async fn next(&mut self) -> Result<StepOutput> {
        let preempted = self.permit.handle().preempted();
        tokio::select! {
            biased;
            error = preempted => Err(error),
            result = self.receive() => result,
        }
    }

    async fn receive(&mut self) -> Result<StepOutput> {
        let result = match self.delivery.delivery() {
            Delivery::Lossless => {
                let result = self.results.recv().await;
                self.grant_credit();
                result
            }
            Delivery::Latest => self.receive_latest().await,
        };
        let result = result.ok_or_else(|| self.end_error())?;
        self.permit.handle().mark_progress();
        Ok(result)
    }

    /// Grants a credit, if necessary after a wait for the rate limit, and waits for its result. `None` if the
    /// subscription has ended. Cancel-safe.
    async fn receive_latest(&mut self) -> Option<StepOutput> {
        if !self.has_granted_credit {
            tokio::select! {
                biased;
                () = wait_for_credit(self.rate_limiter.as_ref()) => {}
                // The subscription may end during the wait. Without a credit, no other result arrives.
                end = self.results.recv() => return end,
            }
            self.has_granted_credit = true;
            self.grant_credit();
        }
        let result = self.results.recv().await;
        self.has_granted_credit = false;
        if let Some(rate_limiter) = &mut self.rate_limiter {
            rate_limiter.record_result(Instant::now());
        }
        result
    }

    /// Waits until the subscription is preempted or the scene disconnects the subscriber, and returns the reason. Pends
    /// forever if the subscription ends in another way.
    pub fn disconnected(&self) -> impl Future<Output = Error> + Send + use<> {
        let preempted = self.permit.handle().preempted();
        let mut end_receiver = self.end.clone();
        let is_immediate = |end: &Option<EndReason>| end.as_ref().is_some_and(|end| end.is_immediate);
        let disconnected = async move {
            match end_receiver.wait_for(is_immediate).await.map(|end| end.clone()) {
                Ok(Some(end)) => end.error,
                // The scene has ended without disconnecting the subscriber, so buffered results may still be read.
                _ => std::future::pending().await,
            }
        };
        async move {
            tokio::select! {
                error = disconnected => error,
                error = preempted => error,
            }
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

/// Limits the rate of the credits of a `Latest` subscription.
#[derive(Debug)]
struct RateLimiter {
    /// Time between two credits at the maximum rate.
    interval: Duration,
    /// When the next credit may be granted.
    next_credit: Instant,
}

impl RateLimiter {
    /// Schedules the next credit. Credits are granted at multiples of `interval` after a start time, so that the time
    /// from a credit to its result does not reduce the rate. If a result arrives more than one interval after its
    /// credit, its arrival is the new start time.
    fn record_result(&mut self, received_at: Instant) {
        let is_on_grid = received_at.saturating_duration_since(self.next_credit) <= self.interval;
        self.next_credit = if is_on_grid { self.next_credit } else { received_at } + self.interval;
    }
}

async fn wait_for_credit(rate_limiter: Option<&RateLimiter>) {
    if let Some(rate_limiter) = rate_limiter {
        tokio::time::sleep_until(rate_limiter.next_credit.into()).await;
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
    use crate::admission::Limit;
    use crate::engine::device::handle::PendingReply;
    use crate::engine::output::step_output::{OutputBody, StepId};
    use modalcast_model::deform::VertexAttributes;

    fn output(number: u64) -> StepOutput {
        let step = StepId { run: 1, number, time: 0.0 };
        let body = OutputBody::Vertices(Arc::new(PendingReply::answered(Arc::default())));
        StepOutput { step, skipped: 0, stages: vec![], origins: None, body }
    }

    fn subscribe(delivery: impl Into<StreamDelivery>) -> (Subscriber, Subscription) {
        let spec = OutputSpec::Vertices(VertexAttributes::POSITIONS_AND_NORMALS);
        Subscription::new(Permit::for_test(Limit::SUBSCRIPTIONS), spec, delivery.into(), Arc::default())
    }

    /// A limit that a test never reaches: one result in 1000 s.
    fn slow_delivery() -> StreamDelivery {
        StreamDelivery::new(Delivery::Latest, 1e-3).expect("expected a valid limit")
    }

    #[tokio::test]
    async fn lossless_subscription_grants_one_credit_per_result() {
        let (subscriber, mut subscription) = subscribe(Delivery::Lossless);
        for number in 1..=2 {
            assert!(subscriber.has_credit() && subscriber.send(output(number)));
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
        assert!(subscriber.has_credit() && subscriber.send(output(4)) && !subscriber.has_credit());
        assert_eq!(subscription.next().await.expect("expected the sent result").step.number, 4);
    }

    #[tokio::test]
    async fn rate_limit_delays_the_credit_after_a_result() {
        for (delivery, grants_second_credit) in [(slow_delivery(), false), (Delivery::Latest.into(), true)] {
            let (subscriber, mut subscription) = subscribe(delivery);
            for (number, grants_credit) in [(1, true), (2, grants_second_credit)] {
                tokio::time::timeout(Duration::ZERO, subscription.next()).await.expect_err("expected no result yet");
                assert_eq!(subscriber.has_credit(), grants_credit, "{delivery:?}, result {number}");
                if grants_credit {
                    subscriber.send(output(number));
                    subscription.next().await.expect("expected the sent result");
                }
            }
        }
    }

    #[tokio::test]
    async fn end_is_reported_while_the_rate_limit_delays_a_credit() {
        let (subscriber, mut subscription) = subscribe(slow_delivery());
        tokio::time::timeout(Duration::ZERO, subscription.next()).await.expect_err("expected no result yet");
        subscriber.send(output(1));
        subscription.next().await.expect("expected the sent result");
        let error = Error::NotFound { what: "scene", given: "'closed'".into() };
        subscriber.end(error.clone());
        drop(subscriber);
        let end = tokio::time::timeout(crate::hang_guard::HANG_GUARD, subscription.next()).await;
        assert_eq!(end.expect("expected the end before the next credit").expect_err("expected the end"), error);
    }

    #[test]
    fn credits_keep_their_grid_until_a_result_is_late() {
        let (start, interval) = (Instant::now(), Duration::from_millis(100));
        let at = |ms| start + Duration::from_millis(ms);
        let mut rate_limiter = RateLimiter { interval, next_credit: start };
        for (received_ms, next_credit_ms) in [(30, 100), (200, 200), (301, 401), (401, 501), (600, 601)] {
            rate_limiter.record_result(at(received_ms));
            assert_eq!(rate_limiter.next_credit, at(next_credit_ms), "result after {received_ms} ms");
        }
    }

    #[tokio::test]
    async fn end_comes_after_buffered_results() {
        let (subscriber, mut subscription) = subscribe(Delivery::Lossless);
        subscriber.send(output(1));
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
