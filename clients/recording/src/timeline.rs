//! The times of states in a recording.

use modalcast_client::StepId;

/// The largest time in nanoseconds. Readers can store it as a signed number.
const MAX_TIME: u64 = i64::MAX as u64;

/// Maps steps to nanoseconds since the first one. The result never decreases.
#[derive(Debug, Default)]
pub(crate) struct Timeline {
    last_step: Option<StepId>,
    /// Simulation time in seconds of the step at `base`.
    base_time: f64,
    /// Time of this step in the recording, in nanoseconds. Later times are relative to it until a new run begins or the
    /// simulation time decreases.
    base: u64,
    /// Nanoseconds of the last step.
    last: u64,
}

impl Timeline {
    /// The time of the next step.
    pub(crate) fn time_of(&mut self, step: &StepId) -> u64 {
        let continues = self.last_step.is_some_and(|last| last.run == step.run && last.time <= step.time);
        if !continues {
            (self.base_time, self.base) = (step.time, self.last);
        }
        // The conversion saturates, and maps NaN to 0.
        let elapsed = ((step.time - self.base_time) * 1e9).round() as u64;
        self.last_step = Some(*step);
        self.last = self.base.saturating_add(elapsed).min(MAX_TIME).max(self.last);
        self.last
    }

    /// The time of the last step.
    pub(crate) const fn last(&self) -> u64 {
        self.last
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_continue_at_new_runs_and_never_decrease() {
        let mut timeline = Timeline::default();
        let steps = [
            (1, 10.0, 0),
            (1, 10.5, 500_000_000),
            // The simulation time is reset, then run 2 begins.
            (1, 0.0, 500_000_000),
            (1, 0.25, 750_000_000),
            (2, 100.0, 750_000_000),
            (2, 100.0, 750_000_000),
            (2, 101.0, 1_750_000_000),
            (2, f64::MAX, MAX_TIME),
            (2, f64::NAN, MAX_TIME),
            (3, -f64::MAX, MAX_TIME),
        ];
        for (index, (run, time, expected)) in steps.into_iter().enumerate() {
            let step = StepId { run, number: index as u64, time };
            assert_eq!(timeline.time_of(&step), expected, "step {index}");
        }
        assert_eq!(timeline.last(), MAX_TIME);
    }
}
