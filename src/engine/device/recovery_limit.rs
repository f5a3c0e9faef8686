//! Limit on how often the renderer is opened and all scenes are loaded again.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

/// Maximum number of recoveries within [`RECOVERY_PERIOD`]. After more of them the device is lost, so that a frame or a step
/// that always causes one does not occupy the server for ever.
pub(super) const MAX_RECOVERIES: usize = 3;
pub(super) const RECOVERY_PERIOD: Duration = Duration::from_secs(60);

/// Limits the number of recoveries.
#[derive(Debug, Default)]
pub(super) struct RecoveryLimit {
    /// When a recovery was needed, oldest first.
    losses: VecDeque<Instant>,
}

impl RecoveryLimit {
    /// Counts a loss or a failed step. Returns whether a recovery is permitted.
    pub(super) fn admits(&mut self, now: Instant) -> bool {
        self.losses.retain(|loss| now.duration_since(*loss) < RECOVERY_PERIOD);
        self.losses.push_back(now);
        self.losses.len() <= MAX_RECOVERIES
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn recoveries_are_limited_within_the_period() {
        let (mut limit, start) = (RecoveryLimit::default(), Instant::now());
        let admitted: Vec<bool> = (0..5).map(|second| limit.admits(start + Duration::from_secs(second))).collect();
        assert_eq!(admitted, [true, true, true, false, false]);
        assert!(limit.admits(start + 2 * RECOVERY_PERIOD), "expected older losses to be forgotten");
    }
}
