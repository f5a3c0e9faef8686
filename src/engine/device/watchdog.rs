//! The watchdog of the device thread. A call to a driver that does not return, for example because of a kernel that does
//! not end, cannot be interrupted. The watchdog then reports the loss of the device, so that no caller waits for ever and
//! the process ends.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Weak};
use std::time::{Duration, Instant};

use super::device_loss::DeviceLossSender;
use super::work_owners::WorkOwners;
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

/// Starts the watchdog. It reports a loss when one piece of work takes longer than `limit`, records the scene that owns the
/// work, and ends with the clock.
///
/// # Errors
/// `Fault` when the thread cannot be started.
pub(super) fn start(
    clock: &Arc<WorkClock>,
    limit: Duration,
    loss: DeviceLossSender,
    owners: Arc<WorkOwners>,
) -> Result<()> {
    let clock = Arc::downgrade(clock);
    let watch = move || {
        let mut last_delay = Instant::now();
        // Work that begins later cannot be overdue before the limit has passed again, so that one check per limit is exact.
        while let Some(busy_time) = clock.upgrade().as_deref().map(WorkClock::busy_time) {
            if busy_time >= limit {
                // A machine that delays the watchdog or lacks memory delays the work, too. This is no fault of the scene.
                if last_delay.elapsed() >= busy_time && !is_memory_short() {
                    owners.record_hang();
                }
                let reason = format!("expected an answer of the device within {} ms, got none", limit.as_millis());
                return loss.record(&Error::DeviceLost { stage: "device", reason });
            }
            if sleep_while_alive(&clock, limit - busy_time) {
                last_delay = Instant::now();
            }
        }
    };
    std::thread::Builder::new()
        .name("device watchdog".into())
        .spawn(watch)
        .map(drop)
        .map_err(fault_in("device watchdog"))
}

/// Sleeps, but ends soon after the clock is dropped. Returns whether the thread was delayed, for example because the
/// process was stopped.
fn sleep_while_alive(clock: &Weak<WorkClock>, duration: Duration) -> bool {
    const STEP: Duration = Duration::from_secs(1);
    /// Longer than any delay of a busy machine.
    const MAX_DELAY: Duration = Duration::from_secs(2);
    let end = Instant::now() + duration;
    let mut is_delayed = false;
    while let Some(rest) = end.checked_duration_since(Instant::now()).filter(|_| clock.strong_count() > 0) {
        let (begin, step) = (Instant::now(), rest.min(STEP));
        std::thread::sleep(step);
        is_delayed |= begin.elapsed() > step + MAX_DELAY;
    }
    is_delayed
}

/// Whether the processes of the machine waited for memory for more than a tenth of the last minute.
fn is_memory_short() -> bool {
    const MAX_PERCENT: f64 = 10.0;
    // Not every kernel has this file.
    let text = std::fs::read_to_string("/proc/pressure/memory").unwrap_or_default();
    waiting_percent(&text).is_some_and(|percent| percent > MAX_PERCENT)
}

/// The share of the last minute in which at least one process waited, in percent, of a file in `/proc/pressure`.
fn waiting_percent(pressure: &str) -> Option<f64> {
    let some = pressure.lines().find(|line| line.starts_with("some "))?;
    some.split(' ').find_map(|word| word.strip_prefix("avg60="))?.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn share_of_waiting_processes_is_read() {
        let line = |kind: &str, share: f64| format!("{kind} avg10=1.00 avg60={share:.2} avg300=3.00 total=4\n");
        assert_eq!(waiting_percent(&(line("full", 1.0) + &line("some", 12.5))), Some(12.5));
        assert_eq!(waiting_percent(""), None);
    }
}
