//! The watchdog of the device thread. A call to a driver that does not return, for example because of a kernel that does
//! not end, cannot be interrupted. The watchdog then reports the loss of the device, so that no caller waits for ever and
//! the process ends.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Weak};
use std::time::{Duration, Instant};

use super::device_loss::DeviceLossSender;
use modalcast_model::error::{Error, Result, fault_in};

/// The time since when the device thread executes its present work.
#[derive(Debug)]
pub(super) struct WorkClock {
    start: Instant,
    /// Microseconds after `start` at which the present work has begun; [`Self::IDLE`] if there is none.
    begin: AtomicU64,
}

impl WorkClock {
    const IDLE: u64 = u64::MAX;

    pub(super) fn new() -> Arc<Self> {
        Arc::new(Self { start: Instant::now(), begin: AtomicU64::new(Self::IDLE) })
    }

    /// Runs work of the device thread, which must not panic.
    pub(super) fn measure<T>(&self, work: impl FnOnce() -> T) -> T {
        self.begin.store(self.start.elapsed().as_micros() as u64, Ordering::Relaxed);
        let result = work();
        self.begin.store(Self::IDLE, Ordering::Relaxed);
        result
    }

    /// How long the present work has been executed; zero if there is none.
    fn busy_time(&self) -> Duration {
        match self.begin.load(Ordering::Relaxed) {
            Self::IDLE => Duration::ZERO,
            begin => self.start.elapsed().saturating_sub(Duration::from_micros(begin)),
        }
    }
}

/// Starts the watchdog. It reports a loss when one piece of work takes longer than `limit`, and ends with the clock.
///
/// # Errors
/// `Fault` when the thread cannot be started.
pub(super) fn start(clock: &Arc<WorkClock>, limit: Duration, loss: DeviceLossSender) -> Result<()> {
    let clock = Arc::downgrade(clock);
    let watch = move || {
        // Work that begins later cannot be overdue before the limit has passed again, so that one check per limit is exact.
        while let Some(busy_time) = clock.upgrade().as_deref().map(WorkClock::busy_time) {
            if busy_time >= limit {
                let reason = format!("expected an answer of the device within {} ms, got none", limit.as_millis());
                return loss.record(&Error::DeviceLost { stage: "device", reason });
            }
            sleep_while_alive(&clock, limit - busy_time);
        }
    };
    std::thread::Builder::new()
        .name("device watchdog".into())
        .spawn(watch)
        .map(drop)
        .map_err(fault_in("device watchdog"))
}

/// Sleeps, but ends soon after the clock is dropped.
fn sleep_while_alive(clock: &Weak<WorkClock>, duration: Duration) {
    const STEP: Duration = Duration::from_secs(1);
    let end = Instant::now() + duration;
    while let Some(rest) = end.checked_duration_since(Instant::now()).filter(|_| clock.strong_count() > 0) {
        std::thread::sleep(rest.min(STEP));
    }
}
