//! Measures the time for which the server itself prepares the results of a subscription. A client is not responsible for
//! this time when the writer waits for its subscription.

use std::sync::Mutex;
use std::time::{Duration, Instant};

use crate::engine::lock::lock;

/// The time of the work for one subscription. The reply stream runs the work, and the scene reads the time.
#[derive(Debug, Default)]
pub struct WorkTimer(Mutex<Work>);

#[derive(Debug, Clone, Copy, Default)]
struct Work {
    /// The time of all work that has ended.
    finished: Duration,
    /// When the work in progress began.
    begun_at: Option<Instant>,
}

impl WorkTimer {
    /// Runs work for the subscription: waiting for a result, drawing, encoding. One work runs at a time.
    pub async fn measure<T>(&self, work: impl Future<Output = T>) -> T {
        lock(&self.0).begun_at = Some(Instant::now());
        let _end = EndOnDrop(self);
        work.await
    }

    /// Whether work is in progress.
    pub(super) fn is_running(&self) -> bool {
        lock(&self.0).begun_at.is_some()
    }

    /// The time of all work until `now`.
    pub(super) fn total(&self, now: Instant) -> Duration {
        let Work { finished, begun_at } = *lock(&self.0);
        finished + begun_at.map_or(Duration::ZERO, |begun_at| now.saturating_duration_since(begun_at))
    }
}

/// Ends work that is completed or canceled.
struct EndOnDrop<'a>(&'a WorkTimer);

impl Drop for EndOnDrop<'_> {
    fn drop(&mut self) {
        let mut work = lock(&self.0.0);
        let time = work.begun_at.take().map(|begun_at| begun_at.elapsed());
        work.finished += time.unwrap_or_default();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn only_time_of_work_counts() {
        let timer = WorkTimer::default();
        let (begin, later) = (Instant::now(), Instant::now() + Duration::from_secs(100));
        assert_eq!((timer.total(later), timer.is_running()), (Duration::ZERO, false));
        let in_progress = timer.measure(async { (timer.is_running(), timer.total(later)) }).await;
        assert!(in_progress.0 && in_progress.1 > Duration::from_secs(90), "{in_progress:?}");
        assert!(!timer.is_running() && timer.total(later) <= begin.elapsed());
    }

    #[tokio::test]
    async fn canceled_work_ends() {
        let timer = WorkTimer::default();
        let work = timer.measure(std::future::pending::<()>());
        tokio::time::timeout(Duration::from_millis(1), work).await.expect_err("expected endless work");
        assert!(!timer.is_running() && timer.total(Instant::now()) > Duration::ZERO);
    }
}
