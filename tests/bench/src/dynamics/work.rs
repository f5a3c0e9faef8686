//! The work of an integrator in a run.

use serde::Serialize;

use modalcast_dynamics::integrator::IntegratorTotals;

/// The work of an integrator.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Work {
    pub sub_steps: u64,
    pub max_sub_steps: u32,
    /// Newton iterations, with those of rejected sub-steps.
    pub iterations: u64,
    pub rejections: u64,
    /// Steps whose estimated error exceeds the tolerance with the largest number of sub-steps.
    pub limited_steps: u64,
    /// Largest residual of the equations of motion, relative to the largest term.
    pub max_residual: f64,
}

impl Work {
    pub(super) const fn of(totals: &IntegratorTotals) -> Self {
        Self {
            sub_steps: totals.sub_steps,
            max_sub_steps: totals.max_sub_steps,
            iterations: totals.iterations,
            rejections: totals.rejections,
            limited_steps: totals.limited_steps,
            max_residual: totals.max_residual,
        }
    }
}
