//! When something last made progress.

use std::sync::LazyLock;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;

/// The time 0 of all time stamps.
static EPOCH: LazyLock<Instant> = LazyLock::new(Instant::now);

/// Nanoseconds since the first call, plus 1.
pub(super) fn now() -> u64 {
    u64::try_from(EPOCH.elapsed().as_nanos()).unwrap_or(u64::MAX).saturating_add(1)
}

/// The time of the last progress. It is atomic, so that steps and frames record their progress without a lock.
#[derive(Debug, Default)]
pub(super) struct Progress {
    /// 0 before the first progress.
    time: AtomicU64,
}

impl Progress {
    pub(super) fn mark(&self) {
        self.time.store(now(), Ordering::Relaxed);
    }

    /// `None` before the first progress.
    pub(super) fn last(&self) -> Option<u64> {
        Some(self.time.load(Ordering::Relaxed)).filter(|time| *time > 0)
    }
}
