//! Time budget for the steps of a moving scene. The total is extrapolated after two steps.

use std::time::{Duration, Instant};

/// Time budget of all steps of a moving scene; references and the frames of each variant have one budget each.
pub(super) const STEP_TIME_BUDGET: Duration = Duration::from_secs(60);

/// Timer that stops a sequence of steps if the sequence would exceed its budget.
pub(super) struct TimeBudget {
    budget: Duration,
    steps: usize,
    begin: Instant,
    /// Time of the first step, which includes preparations that the other steps reuse.
    first_step: Option<Duration>,
    finished_steps: usize,
}

impl TimeBudget {
    /// Starts the timer.
    pub(super) fn new(budget: Duration, steps: usize) -> Self {
        Self { budget, steps, begin: Instant::now(), first_step: None, finished_steps: 0 }
    }

    /// Counts a finished step. After the second step, returns a reason to stop if all steps would exceed the budget.
    /// `work` names the timed work in the message.
    pub(super) fn finish_step(&mut self, work: &str) -> Option<String> {
        let elapsed = self.begin.elapsed();
        self.finished_steps += 1;
        let first_step = *self.first_step.get_or_insert(elapsed);
        let remaining_steps = self.steps.saturating_sub(1) as u32;
        // Decide only once: a sequence that continues after the second step runs to its end.
        let total = (self.finished_steps == 2).then(|| first_step + (elapsed - first_step) * remaining_steps)?;
        (total > self.budget).then(|| {
            let (total, budget) = (total.as_secs_f64(), self.budget.as_secs_f64());
            format!("expected {work} of {} steps in at most {budget:.0} s, would take {total:.0} s", self.steps)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stops_after_two_steps_if_budget_would_be_exceeded() {
        let mut large_budget = TimeBudget::new(Duration::from_secs(1000), 60);
        assert!((0..60).all(|_| large_budget.finish_step("frames").is_none()));
        let mut small_budget = TimeBudget::new(Duration::from_millis(50), 60);
        assert_eq!(small_budget.finish_step("frames"), None, "the first step does not decide");
        std::thread::sleep(Duration::from_millis(5));
        let reason = small_budget.finish_step("frames").expect("a reason to stop: 59 steps of 5 ms exceed 50 ms");
        assert!(reason.starts_with("expected frames of 60 steps in at most"), "{reason}");
    }
}
