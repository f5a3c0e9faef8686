//! Time integrators of reduced equations of motion, and their reports of steps.
//!
//! [`ModalOscillators`] integrates linear modes exactly. [`ImplicitIntegrator`](crate::implicit::ImplicitIntegrator)
//! integrates forces that are cubic in q.

use nalgebra::DVector;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use crate::error::Result;
use crate::oscillator::{ModeState, Oscillator};
use crate::parameters::{ModalParameters, ModeParameters};
use crate::saved_state::{check_vector, number_bits, vector_bits};

/// Maximum number of modes that a remark names.
const MAX_NAMED_MODES: usize = 8;

/// Advances a system by steps of one size.
pub trait Integrator {
    /// Advances `state` by one step under a load that changes linearly from its start to its end. An error leaves the
    /// state as it is.
    ///
    /// # Errors
    /// `NotConverged` if the equations of the step have no solution that the integrator finds.
    fn advance(&self, state: &mut MotionState, load: LoadChange<'_>) -> Result<StepReport>;

    /// Seconds per step.
    fn dt(&self) -> f64;
}

/// Coordinates and velocities at one time.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MotionState {
    #[serde(with = "vector_bits")]
    pub q: DVector<f64>,
    #[serde(with = "vector_bits")]
    pub v: DVector<f64>,
    /// The number of sub-steps that the next step tries first, at least 1.
    pub sub_steps: u32,
}

impl MotionState {
    /// The state at `q` without velocity.
    pub fn resting(q: DVector<f64>) -> Self {
        Self { v: DVector::zeros(q.len()), q, sub_steps: 1 }
    }

    /// Checks a state of `count` coordinates that was read from a checkpoint.
    ///
    /// # Errors
    /// `Invalid` if a vector has another length, or a number is not finite.
    pub(crate) fn check(&self, count: usize) -> Result<()> {
        check_vector("q", &self.q, count)?;
        check_vector("v", &self.v, count)
    }
}

/// The load at the start and at the end of a step. It changes linearly in between.
#[derive(Debug, Clone, Copy)]
pub struct LoadChange<'a> {
    pub start: &'a DVector<f64>,
    pub end: &'a DVector<f64>,
}

impl LoadChange<'_> {
    /// The load at a fraction of the step, 0 to 1.
    pub fn at(&self, fraction: f64) -> DVector<f64> {
        self.start * (1.0 - fraction) + self.end * fraction
    }
}

/// What an integrator did in one step.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct StepReport {
    /// Number of sub-steps of the accepted solution.
    pub sub_steps: u32,
    /// Number of Newton iterations, with those of rejected sub-steps.
    pub iterations: u32,
    /// Number of times that the step was repeated with smaller sub-steps.
    pub rejections: u32,
    /// Largest residual of the equations of motion in an accepted sub-step, relative to the largest term.
    pub residual: f64,
    /// Estimated error of the displacement, in diagonals of the scene's rest bounds.
    pub error: f64,
    /// Whether `error` exceeds the tolerance with the largest number of sub-steps.
    pub is_limited: bool,
}

/// Totals of all steps of a run.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct IntegratorTotals {
    pub steps: u64,
    pub sub_steps: u64,
    pub max_sub_steps: u32,
    pub iterations: u64,
    pub rejections: u64,
    #[serde(with = "number_bits")]
    pub max_residual: f64,
    #[serde(with = "number_bits")]
    pub max_error: f64,
    /// Number of steps whose estimated error exceeds the tolerance.
    pub limited_steps: u64,
}

impl IntegratorTotals {
    /// Adds a step.
    pub fn add(&mut self, report: &StepReport) {
        self.steps += 1;
        self.sub_steps += u64::from(report.sub_steps);
        self.max_sub_steps = self.max_sub_steps.max(report.sub_steps);
        self.iterations += u64::from(report.iterations);
        self.rejections += u64::from(report.rejections);
        self.max_residual = self.max_residual.max(report.residual);
        self.max_error = self.max_error.max(report.error);
        self.limited_steps += u64::from(report.is_limited);
    }

    /// The totals as JSON.
    pub fn to_json(&self) -> Value {
        json!({
            "steps": self.steps,
            "sub_steps": self.sub_steps,
            "max_sub_steps": self.max_sub_steps,
            "iterations": self.iterations,
            "rejections": self.rejections,
            "max_residual": self.max_residual,
            "max_error_of_diagonal": self.max_error,
            "steps_above_tolerance": self.limited_steps,
        })
    }
}

/// Independent linear modes, each integrated exactly. A mode without parameters does not move.
pub struct ModalOscillators {
    oscillators: Vec<Oscillator>,
    dt: f64,
}

impl ModalOscillators {
    /// Creates one oscillator per coordinate, for steps of `dt` seconds.
    ///
    /// # Errors
    /// `Invalid` if the step is not positive.
    pub fn new(parameters: &ModalParameters, dt: f64) -> Result<Self> {
        let create_oscillator = |mode: &Option<ModeParameters>| match mode {
            Some(ModeParameters { eigenvalue, damping_ratio }) => Oscillator::new(*eigenvalue, *damping_ratio, dt),
            None => Ok(Oscillator::new_fixed()),
        };
        Ok(Self { oscillators: parameters.modes.iter().map(create_oscillator).collect::<Result<_>>()?, dt })
    }

    /// Per coordinate: 1 / omega^2; 0 for a mode that does not move.
    pub fn compliances(&self) -> Vec<f64> {
        self.oscillators.iter().map(Oscillator::compliance).collect()
    }
}

impl Integrator for ModalOscillators {
    fn advance(&self, state: &mut MotionState, load: LoadChange<'_>) -> Result<StepReport> {
        for (mode, oscillator) in self.oscillators.iter().enumerate() {
            let start = ModeState { q: state.q[mode], v: state.v[mode] };
            let end = oscillator.advance(start, load.start[mode], load.end[mode]);
            (state.q[mode], state.v[mode]) = (end.q, end.v);
        }
        Ok(StepReport { sub_steps: 1, ..StepReport::default() })
    }

    fn dt(&self) -> f64 {
        self.dt
    }
}

/// A remark on modes that steps of `dt` seconds do not resolve: those above the Nyquist frequency. `modes` has names and
/// frequencies in hertz.
pub fn nyquist_remark(modes: impl IntoIterator<Item = (String, f64)>, dt: f64) -> Option<String> {
    let nyquist_frequency = 0.5 / dt;
    let fast_modes: Vec<_> = modes.into_iter().filter(|(_, hertz)| *hertz > nyquist_frequency).collect();
    let highest = fast_modes.iter().map(|(_, hertz)| *hertz).max_by(f64::total_cmp)?;
    let mut names: Vec<String> =
        fast_modes.iter().take(MAX_NAMED_MODES).map(|(name, hertz)| format!("{name} ({hertz:.4} Hz)")).collect();
    if fast_modes.len() > names.len() {
        names.push(format!("and {} more", fast_modes.len() - names.len()));
    }
    Some(format!(
        "modes above the Nyquist frequency of the steps, {nyquist_frequency:.4} Hz, are not seen as vibrations ({}; steps \
         below {:.3e} s show them): {}",
        fast_modes.len(),
        0.5 / highest,
        names.join(", ")
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn modes_above_the_nyquist_frequency_are_named() {
        let modes = |count: usize| (0..count).map(|mode| (format!("q[{mode}]"), 10.0 * (mode + 1) as f64));
        let remark = nyquist_remark(modes(4), 1.0 / 60.0).expect("a remark");
        assert!(remark.contains("30.0000 Hz") && remark.ends_with("show them): q[3] (40.0000 Hz)"), "{remark}");
        assert!(nyquist_remark(modes(20), 1.0 / 60.0).expect("a remark").contains("and 9 more"));
        assert_eq!(nyquist_remark(modes(4), 1.0 / 600.0), None);
    }
}
