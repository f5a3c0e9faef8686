//! Runs an integrator over a motion: its states at sample times, its work and its time.

use std::time::Instant;

use nalgebra::DVector;

use super::work::Work;
use crate::timing::Timing;
use modalcast_dynamics::integrator::{Integrator, IntegratorTotals, LoadChange, MotionState};

/// Seconds after which a run is not repeated.
const TIME_BUDGET_S: f64 = if cfg!(test) { 0.0 } else { 0.03 };
/// Largest number of runs of which the median time is taken.
const MAX_REPETITIONS: usize = 20;

/// A start, a constant load and times.
#[derive(Debug, Clone)]
pub(super) struct Motion {
    pub(super) start: MotionState,
    pub(super) load: DVector<f64>,
    /// Seconds per step.
    pub(super) dt: f64,
    pub(super) steps_per_sample: u64,
    /// Number of samples after the start.
    pub(super) samples: u64,
}

impl Motion {
    pub(super) const fn steps(&self) -> u64 {
        self.steps_per_sample * self.samples
    }

    /// The time of the sample with an index from 0. The first one is after `steps_per_sample` steps.
    pub(super) fn sample_time(&self, index: usize) -> f64 {
        self.dt * self.steps_per_sample as f64 * (index + 1) as f64
    }
}

/// Result of a run.
pub(super) struct Run {
    /// The states at the sample times.
    pub(super) samples: Vec<MotionState>,
    pub(super) work: Work,
    /// Time of a step, microseconds of one thread by the wall clock. The median and quartiles are those of mean times
    /// of whole runs.
    pub(super) timing: Option<Timing>,
}

/// Runs `integrator` at least once.
///
/// # Errors
/// The text of the integrator's error, with the step.
pub(super) fn run(integrator: &dyn Integrator, motion: &Motion) -> Result<Run, String> {
    let (started, mut times) = (Instant::now(), Vec::new());
    let (mut samples, mut totals) = (Vec::new(), IntegratorTotals::default());
    while times.is_empty() || (times.len() < MAX_REPETITIONS && started.elapsed().as_secs_f64() < TIME_BUDGET_S) {
        let run_start = Instant::now();
        (samples, totals) = run_once(integrator, motion)?;
        times.push(run_start.elapsed().as_secs_f64() * 1e6 / motion.steps() as f64);
    }
    Ok(Run { samples, work: Work::of(&totals), timing: Timing::of(times) })
}

fn run_once(integrator: &dyn Integrator, motion: &Motion) -> Result<(Vec<MotionState>, IntegratorTotals), String> {
    let load = LoadChange { start: &motion.load, end: &motion.load };
    let (mut state, mut totals) = (motion.start.clone(), IntegratorTotals::default());
    let mut samples = Vec::with_capacity(motion.samples as usize);
    for step in 1..=motion.steps() {
        let report = integrator.advance(&mut state, load).map_err(|error| format!("step {step}: {error}"))?;
        totals.add(&report);
        if step % motion.steps_per_sample == 0 {
            samples.push(state.clone());
        }
    }
    Ok((samples, totals))
}
