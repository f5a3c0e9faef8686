//! Checks of a report: orders, conserved energies, controls, references and frequencies.

use std::f64::consts::TAU;

use super::method::{AVERAGE_VECTOR_FIELD, Method};
use super::reference::ReferenceSummary;
use super::row::{Expectation, IntegrationRow, MotionErrors};
use super::solid_modes::SolidRow;

/// Largest difference of an observed order from the theory, where the step is small enough for the theory to apply.
const ORDER_TOLERANCE: f64 = 0.2;
/// Largest error of the fastest mode over the run, by the leading term of the theory, for which orders are compared.
const MAX_LEADING_TERM: f64 = 0.2;
/// Largest relative error of a conserved energy.
const ENERGY_TOLERANCE: f64 = 1e-9;
/// Largest error of the exact integrator. A phase of 6e7 radians has a rounding error of 1e-8.
const EXACT_TOLERANCE: f64 = 1e-6;
/// Smallest error of a negative control.
const MIN_CONTROL_ERROR: f64 = 0.1;
/// Largest change of a reference by halving its step.
const REFERENCE_TOLERANCE: f64 = 1e-6;
/// Largest error of a frequency with the largest number of freedoms.
const FREQUENCY_TOLERANCE: f64 = 0.005;

/// Expectations that are not met, each as `case: system: reason`.
pub(super) fn failures(rows: &[IntegrationRow], references: &[ReferenceSummary], solids: &[SolidRow]) -> Vec<String> {
    let mut failures: Vec<String> = rows.iter().flat_map(row_failures).collect();
    failures.extend(references.iter().filter_map(reference_failure));
    let most_freedoms = solids.iter().map(|row| row.freedom_limit).max().unwrap_or(0);
    failures.extend(solids.iter().filter_map(|row| solid_failure(row, row.freedom_limit == most_freedoms)));
    failures
}

fn row_failures(row: &IntegrationRow) -> Vec<String> {
    let mut reasons = match (&row.failure, row.errors, row.expectation) {
        (Some(_), _, Expectation::Failure) => vec![],
        (Some(failure), ..) => vec![failure.clone()],
        (None, _, Expectation::Failure) => vec!["expected an error, got a motion".into()],
        (None, None, _) => vec!["expected errors, got none".into()],
        (None, Some(errors), _) => error_failures(row, &errors),
    };
    if let Some(reason) = order_failure(row) {
        reasons.push(reason);
    }
    let name = format!("{}: {}: {}, dt {:e} s", row.case, row.system, row.method, row.dt_seconds);
    reasons.into_iter().map(|reason| format!("{name}: {reason}")).collect()
}

fn error_failures(row: &IntegrationRow, errors: &MotionErrors) -> Vec<String> {
    let error = errors.displacement;
    let is_control = row.expectation == Expectation::LargeError;
    let is_exact = row.method == Method::Exact.name() && !is_control;
    let energy = errors.energy.filter(|_| row.conserves_energy).unwrap_or(0.0);
    // NaN meets no expectation.
    let checks = [
        (error.is_finite(), format!("expected a finite displacement, got an error of {error}")),
        (
            !is_control || error >= MIN_CONTROL_ERROR,
            format!("expected an error of at least {MIN_CONTROL_ERROR}, got {error:.1e}"),
        ),
        (
            !is_exact || error <= EXACT_TOLERANCE,
            format!("expected an error of at most {EXACT_TOLERANCE:e}, got {error:.1e}"),
        ),
        (energy <= ENERGY_TOLERANCE, format!("expected an energy within {ENERGY_TOLERANCE:e}, got {energy:.1e}")),
    ];
    checks.into_iter().filter(|(is_met, _)| !is_met).map(|(_, reason)| reason).collect()
}

/// Compares orders where [`leading_term`] is small.
fn order_failure(row: &IntegrationRow) -> Option<String> {
    let (observed, theory) = row.observed_order.zip(row.theoretical_order)?;
    let is_compared = row.expectation == Expectation::Candidate && leading_term(row) <= MAX_LEADING_TERM;
    let is_met = (observed - theory).abs() <= ORDER_TOLERANCE;
    (is_compared && !is_met).then(|| format!("expected the order {theory}, got {observed:.2}"))
}

/// The error of the fastest linear mode at the end, by the leading term of the theory: of the phase in radians for the
/// average vector field method, (omega dt)^2 / 12 per radian; of the amplitude for backward Euler, omega dt / 2 per
/// radian.
pub(super) fn leading_term(row: &IntegrationRow) -> f64 {
    let omega = TAU * row.highest_hertz;
    let radians = omega * row.duration();
    let step = omega * row.dt_seconds;
    if row.method == AVERAGE_VECTOR_FIELD.name() { radians * step * step / 12.0 } else { radians * step / 2.0 }
}

fn reference_failure(reference: &ReferenceSummary) -> Option<String> {
    let change = reference.change_by_halving;
    let is_met = change <= REFERENCE_TOLERANCE;
    (!is_met).then(|| {
        format!(
            "{}: {}: expected a reference that halving its step changes by at most {REFERENCE_TOLERANCE:e}, got {change:.1e}",
            reference.case, reference.system
        )
    })
}

fn solid_failure(row: &SolidRow, has_most_freedoms: bool) -> Option<String> {
    let name = format!("{} with {} freedoms", row.solid, row.freedom_limit);
    if let Some(failure) = &row.failure {
        return Some(format!("{name}: {failure}"));
    }
    let worst = row.worst_error.unwrap_or(f64::NAN);
    let is_met = worst <= FREQUENCY_TOLERANCE;
    (has_most_freedoms && !is_met)
        .then(|| format!("{name}: expected frequencies within {FREQUENCY_TOLERANCE}, got {worst:.1e}"))
}
