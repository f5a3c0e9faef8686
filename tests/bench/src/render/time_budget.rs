//! Time budget for the steps of a moving scene. The total is extrapolated after two steps.

use std::time::{Duration, Instant};

/// Time budget of all steps of a moving scene; references and the frames of each variant have one budget each.
pub(super) const STEP_TIME_BUDGET: Duration = Duration::from_secs(60);

/// Timer of a sequence of steps with a budget.
pub(super) struct TimeBudget {
    budget: Duration,
    steps: usize,
    begin: Instant,
    /// Time of the first step, which includes preparations that the other steps reuse.
    first: Option<Duration>,
    done: usize,
}

impl TimeBudget {
    /// Starts the timer.
    pub(super) fn new(budget: Duration, steps: usize) -> Self {
        Self { budget, steps, begin: Instant::now(), first: None, done: 0 }
    }

    /// Counts a finished step. After the second one, returns a reason to stop if all steps would exceed the budget.
    pub(super) fn tick(&mut self, what: &str) -> Option<String> {
        let elapsed = self.begin.elapsed();
        self.done += 1;
        let first = *self.first.get_or_insert(elapsed);
        let rest = self.steps.saturating_sub(1) as u32;
        // Decide only once, so that work that continues runs to its end.
        let all = (self.done == 2).then(|| first + (elapsed - first) * rest)?;
        (all > self.budget).then(|| {
            let (all, budget) = (all.as_secs_f64(), self.budget.as_secs_f64());
            format!("{what} of {} steps would take {all:.0} s, more than the {budget:.0} s that they may", self.steps)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stops_after_two_steps_if_budget_would_be_exceeded() {
        let mut long = TimeBudget::new(Duration::from_secs(1000), 60);
        assert!((0..60).all(|_| long.tick("frames").is_none()));
        let mut short = TimeBudget::new(Duration::from_millis(50), 60);
        assert_eq!(short.tick("frames"), None, "one step says too little");
        std::thread::sleep(Duration::from_millis(5));
        let why = short.tick("frames").expect("59 times 5 ms are more than 50");
        assert!(why.starts_with("frames of 60 steps would take"), "{why}");
    }
}
