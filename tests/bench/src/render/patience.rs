//! How long the steps of a moving scene may take: after two of them it is known what all would.

use std::time::{Duration, Instant};

/// What all steps of a moving scene may take, their references and the frames of each variant by themselves.
pub(super) const PATIENCE: Duration = Duration::from_secs(60);

/// The steps of one stretch of work, timed as they are done.
pub(super) struct Patience {
    budget: Duration,
    steps: usize,
    begin: Instant,
    /// What the first step took, which prepares what the others use.
    first: Option<Duration>,
    done: usize,
}

impl Patience {
    /// Begins to count.
    pub(super) fn new(budget: Duration, steps: usize) -> Self {
        Self { budget, steps, begin: Instant::now(), first: None, done: 0 }
    }

    /// Counts a step that was done. After the second, says why when all of them would take too long.
    pub(super) fn tick(&mut self, what: &str) -> Option<String> {
        let elapsed = self.begin.elapsed();
        self.done += 1;
        let first = *self.first.get_or_insert(elapsed);
        let rest = self.steps.saturating_sub(1) as u32;
        // Only once: what has begun well is carried to its end.
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
    fn work_that_fits_goes_on_and_work_that_does_not_is_told_after_two_steps_with_its_numbers() {
        let mut long = Patience::new(Duration::from_secs(1000), 60);
        assert!((0..60).all(|_| long.tick("frames").is_none()));
        let mut short = Patience::new(Duration::from_millis(50), 60);
        assert_eq!(short.tick("frames"), None, "one step says too little");
        std::thread::sleep(Duration::from_millis(5));
        let why = short.tick("frames").expect("59 times 5 ms are more than 50");
        assert!(why.starts_with("frames of 60 steps would take"), "{why}");
    }
}
