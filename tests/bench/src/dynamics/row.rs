//! A row of the report: one method with one step on one system.

use serde::Serialize;

use super::method::{Method, System};
use super::run::{Motion, run};
use super::work::Work;
use crate::timing::Timing;
use modalcast_dynamics::integrator::{Integrator, MotionState};

/// Errors below this value are rounding errors, from which no order follows.
const ROUNDING_ERROR: f64 = 1e-11;

/// What a row must show.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Expectation {
    /// The row takes part in the checks of orders and in the recommendation.
    Candidate,
    /// An extreme case: all errors are finite.
    Finite,
    /// A negative control: the error is large.
    LargeError,
    /// An input that the method rejects or does not solve.
    Failure,
}

/// Results of one method with one step on one system.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct IntegrationRow {
    /// The section of the report.
    pub case: &'static str,
    /// The system, or the mode of a system that the errors are of.
    pub system: String,
    /// Frequency of the mode that the errors are of; `None` if they are of the whole system.
    pub mode_hertz: Option<f64>,
    pub method: String,
    /// Number of coordinates that are integrated together.
    pub coordinates: usize,
    /// Highest frequency of the linear system.
    pub highest_hertz: f64,
    /// Whether the exact motion has a constant energy, and the method conserves it.
    pub conserves_energy: bool,
    pub dt_seconds: f64,
    pub steps: u64,
    pub expectation: Expectation,
    /// `None` if the run failed.
    pub errors: Option<MotionErrors>,
    /// By the displacement errors of this row and of the one with the next larger step.
    pub observed_order: Option<f64>,
    pub theoretical_order: Option<f64>,
    /// Time of a step.
    pub timing: Option<Timing>,
    /// Median time of the whole run.
    pub run_us: Option<f64>,
    pub work: Option<Work>,
    /// Why the run failed.
    pub failure: Option<String>,
}

/// Errors of a motion at all sample times.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct MotionErrors {
    /// Largest error of a displacement, relative to the largest displacement of the reference. For a beam, against the
    /// exact motion of the same modes.
    pub displacement: f64,
    /// Error of the phase of an oscillator at the end, 0 to pi.
    pub phase_radians: Option<f64>,
    /// Largest error of the energy, relative to the energy at the start.
    pub energy: Option<f64>,
    /// Error by the modes of a beam that are left out, without errors of time.
    pub truncation: Option<f64>,
    /// Error of a beam against the exact motion of all modes.
    pub total: Option<f64>,
}

impl MotionErrors {
    /// The error that a user sees.
    pub fn visible_error(&self) -> f64 {
        self.total.unwrap_or(self.displacement)
    }
}

impl IntegrationRow {
    /// Milliseconds per second of motion.
    pub fn ms_per_second(&self) -> Option<f64> {
        Some(self.run_us? / 1e3 / self.duration())
    }

    /// Simulated seconds.
    pub fn duration(&self) -> f64 {
        self.dt_seconds * self.steps as f64
    }

    /// The mean sub-step in seconds; the step if the run failed.
    pub fn mean_sub_step(&self) -> f64 {
        self.work.map_or(self.dt_seconds, |work| self.duration() / work.sub_steps.max(1) as f64)
    }
}

/// Errors of a system, or of one of its modes.
pub(super) struct Measured {
    pub(super) system: String,
    pub(super) mode_hertz: Option<f64>,
    pub(super) errors: MotionErrors,
}

impl Measured {
    /// Errors of a whole system.
    pub(super) fn of_system(name: &str, errors: MotionErrors) -> Vec<Self> {
        vec![Self { system: name.to_owned(), mode_hertz: None, errors }]
    }
}

/// The place of a row in the report.
pub(super) struct Label<'a> {
    pub(super) case: &'static str,
    pub(super) expectation: Expectation,
    pub(super) method: Method,
    pub(super) system: &'a System,
}

/// Runs a method. `measure` returns the errors of the samples; each element is a row. A run that fails has one row, with
/// `name`.
pub(super) fn measure_rows(
    label: &Label<'_>,
    name: &str,
    motion: &Motion,
    measure: impl Fn(&[MotionState]) -> Vec<Measured>,
) -> Vec<IntegrationRow> {
    let integrator = label.system.create_integrator(label.method, motion.dt).map_err(|error| error.to_string());
    rows_of_integrator(label, name, motion, integrator, measure)
}

/// As [`measure_rows`], with an integrator that claims to be the method of the label.
pub(super) fn rows_of_integrator(
    label: &Label<'_>,
    name: &str,
    motion: &Motion,
    integrator: Result<Box<dyn Integrator>, String>,
    measure: impl Fn(&[MotionState]) -> Vec<Measured>,
) -> Vec<IntegrationRow> {
    let Label { case, expectation, method, system } = *label;
    let is_conservative = system.is_undamped() && motion.load.norm() == 0.0;
    let row = IntegrationRow {
        case,
        system: name.to_owned(),
        mode_hertz: None,
        method: method.name(),
        coordinates: system.rank(),
        highest_hertz: system.highest_hertz(),
        conserves_energy: is_conservative && method.conserves_energy(),
        dt_seconds: motion.dt,
        steps: motion.steps(),
        expectation,
        errors: None,
        observed_order: None,
        theoretical_order: method.order(),
        timing: None,
        run_us: None,
        work: None,
        failure: None,
    };
    match integrator.and_then(|integrator| run(integrator.as_ref(), motion)) {
        Err(failure) => vec![IntegrationRow { failure: Some(failure), ..row }],
        Ok(run) => {
            let rows = measure(&run.samples).into_iter().map(|measured| IntegrationRow {
                system: measured.system,
                mode_hertz: measured.mode_hertz,
                errors: Some(measured.errors),
                timing: run.timing,
                run_us: run.timing.map(|timing| timing.median_us * motion.steps() as f64),
                work: Some(run.work),
                ..row.clone()
            });
            rows.collect()
        }
    }
}

/// Sets the observed orders of rows of one case. Rows of one system and method are a series by descending step.
pub(super) fn set_observed_orders(rows: &mut [IntegrationRow]) {
    for index in 0..rows.len() {
        let row = &rows[index];
        let is_larger = |other: &&IntegrationRow| {
            other.system == row.system && other.method == row.method && other.dt_seconds > row.dt_seconds
        };
        let previous = rows
            .iter()
            .filter(is_larger)
            .min_by(|a, b| a.dt_seconds.total_cmp(&b.dt_seconds))
            .filter(|_| row.theoretical_order.is_some());
        let order = previous.and_then(|previous| {
            let (errors, dts) = ([previous, row].map(|row| row.errors), [previous.dt_seconds, row.dt_seconds]);
            observed_order([errors[0]?.displacement, errors[1]?.displacement], dts)
        });
        rows[index].observed_order = order;
    }
}

/// The order p for which the errors are proportional to dt^p. `None` if an error is a rounding error or not finite.
fn observed_order(errors: [f64; 2], dts: [f64; 2]) -> Option<f64> {
    let is_usable = errors.iter().all(|error| *error > ROUNDING_ERROR && error.is_finite());
    is_usable.then(|| (errors[0] / errors[1]).ln() / (dts[0] / dts[1]).ln())
}

/// The larger number, or NaN if one of them is NaN.
pub(super) fn larger(a: f64, b: f64) -> f64 {
    if a.is_nan() || a >= b { a } else { b }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn order_is_that_of_a_power_law() {
        assert!(observed_order([4e-3, 1e-3], [0.2, 0.1]).is_some_and(|order| (order - 2.0).abs() < 1e-12));
        assert!(observed_order([8e-3, 1e-3], [0.4, 0.1]).is_some_and(|order| (order - 1.5).abs() < 1e-12));
        assert_eq!(observed_order([1e-3, 1e-3], [0.2, 0.1]), Some(0.0));
        assert_eq!(observed_order([1e-3, 1e-12], [0.2, 0.1]), None);
        assert_eq!(observed_order([f64::NAN, 1e-3], [0.2, 0.1]), None);
    }
}
