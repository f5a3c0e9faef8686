//! A cantilever beam whose tip is loaded suddenly, against the modal series of Euler and Bernoulli.
//!
//! With the roots x_n of cos x cosh x = -1, the mode n of a beam with length L, bending stiffness EI and mass m has the
//! angular frequency x_n^2 sqrt(EI / (m L^3)). Its mass-normalized shape is 2 / sqrt(m) at the tip (up to its sign), so a
//! force F at the tip moves the tip by the sum of 4 F / (m omega_n^2) (1 - cos(omega_n t)).
//!
//! The error against the series of the same modes is that of the time integration. The difference of both series is that
//! of the truncation.

use nalgebra::DVector;

use super::method::{AVERAGE_VECTOR_FIELD, BACKWARD_EULER, Method, System};
use super::row::{
    Expectation, IntegrationRow, Label, Measured, MotionErrors, larger, measure_rows, set_observed_orders,
};
use super::run::Motion;
use crate::workloads::Size;
use modalcast_dynamics::Result;
use modalcast_dynamics::integrator::MotionState;
use modalcast_dynamics::vega::VegaSettings;

pub(super) const CASE: &str = "beam";

/// Methods that are measured with fixed steps.
const METHODS: [Method; 3] = [Method::Exact, AVERAGE_VECTOR_FIELD, BACKWARD_EULER];
/// Numbers of modes.
const MODE_COUNTS: [usize; 5] = [1, 2, 5, 10, 20];
/// Modes of the reference. The rest of the series is below 1e-10 of the deflection at rest.
const REFERENCE_MODES: usize = 1000;
/// Samples per second, of one second. The largest step is the time between samples.
const SAMPLES: u64 = 30;

/// A steel beam of 1 m with a section of 20 x 10 mm, which bends about the axis of the larger side. Its first frequency
/// is 8.15 Hz.
const LENGTH: f64 = 1.0;
const WIDTH: f64 = 0.02;
const HEIGHT: f64 = 0.01;
const YOUNGS_MODULUS: f64 = 200e9;
const DENSITY: f64 = 7850.0;
/// Newtons.
const FORCE: f64 = 1.0;

/// The description of the beam, for the report.
pub(super) const DESCRIPTION: &str = "Euler-Bernoulli cantilever of steel, 1 m x 20 mm x 10 mm, first frequency 8.15 Hz; \
a force at the tip that begins suddenly; 1 s; errors of the tip relative to its deflection at rest";

/// Modes of the beam, as (eigenvalue, displacement of the tip per unit of the coordinate).
#[derive(Debug, Clone)]
struct Beam {
    eigenvalues: Vec<f64>,
    /// The same for all modes, 1 / sqrt(kg).
    tip_entry: f64,
}

impl Beam {
    fn new(mode_count: usize) -> Self {
        let mass = DENSITY * WIDTH * HEIGHT * LENGTH;
        let bending_stiffness = YOUNGS_MODULUS * WIDTH * HEIGHT.powi(3) / 12.0;
        let eigenvalue = |mode: usize| root(mode).powi(4) * bending_stiffness / (mass * LENGTH.powi(3));
        Self { eigenvalues: (1..=mode_count).map(eigenvalue).collect(), tip_entry: 2.0 / mass.sqrt() }
    }

    /// The deflection of the tip at rest by the beam's theory, with all modes.
    fn static_deflection() -> f64 {
        let bending_stiffness = YOUNGS_MODULUS * WIDTH * HEIGHT.powi(3) / 12.0;
        FORCE * LENGTH.powi(3) / (3.0 * bending_stiffness)
    }

    /// The displacement of the tip by the first modes at a time.
    fn tip(&self, mode_count: usize, time: f64) -> f64 {
        let term = |eigenvalue: &f64| (1.0 - (eigenvalue.sqrt() * time).cos()) / eigenvalue;
        // The smallest terms first, for a small rounding error.
        let sum: f64 = self.eigenvalues[..mode_count].iter().rev().map(term).sum();
        FORCE * self.tip_entry * self.tip_entry * sum
    }
}

/// The root of cos x + 1 / cosh x with a number from 1, by Newton's method.
fn root(number: usize) -> f64 {
    let mut x = (number as f64 - 0.5) * std::f64::consts::PI;
    // The first root begins 0.3 from its solution, the others nearer.
    for _ in 0..12 {
        let value = x.cos() + x.cosh().recip();
        let slope = -x.sin() - x.tanh() / x.cosh();
        x -= value / slope;
    }
    x
}

/// Measures all methods, numbers of modes and steps.
///
/// # Errors
/// None are expected for these systems.
pub(super) fn measure(size: Size) -> Result<Vec<IntegrationRow>> {
    let beam = Beam::new(REFERENCE_MODES);
    let deflection = Beam::static_deflection();
    let (halvings, mode_counts) = match size {
        Size::Full => (9, &MODE_COUNTS[..]),
        Size::Quick => (6, &MODE_COUNTS[..4]),
    };
    let mut rows = Vec::new();
    for mode_count in mode_counts.iter().copied() {
        let system = System::of_modes(&beam.eigenvalues[..mode_count], VegaSettings::default())?;
        let name = format!("{mode_count} modes");
        for method in METHODS {
            let label = Label { case: CASE, expectation: Expectation::Candidate, method, system: &system };
            for steps_per_sample in (0..halvings).map(|halving| 1_u64 << halving) {
                let motion = Motion {
                    start: MotionState::resting(DVector::zeros(mode_count)),
                    load: DVector::from_element(mode_count, FORCE * beam.tip_entry),
                    dt: 1.0 / (SAMPLES * steps_per_sample) as f64,
                    steps_per_sample,
                    samples: SAMPLES,
                };
                rows.extend(measure_rows(&label, &name, &motion, |samples| {
                    Measured::of_system(&name, tip_errors(&beam, deflection, &motion, samples))
                }));
            }
        }
    }
    set_observed_orders(&mut rows);
    Ok(rows)
}

/// The errors of the tip.
fn tip_errors(beam: &Beam, deflection: f64, motion: &Motion, samples: &[MotionState]) -> MotionErrors {
    let mut errors = [0.0; 3];
    for (index, sample) in samples.iter().enumerate() {
        let time = motion.sample_time(index);
        let tip = beam.tip_entry * sample.q.sum();
        let (same_modes, all_modes) = (beam.tip(sample.q.len(), time), beam.tip(REFERENCE_MODES, time));
        let differences = [tip - same_modes, same_modes - all_modes, tip - all_modes];
        for (error, difference) in errors.iter_mut().zip(differences) {
            *error = larger(*error, difference.abs() / deflection);
        }
    }
    let [displacement, truncation, total] = errors;
    MotionErrors { displacement, truncation: Some(truncation), total: Some(total), ..MotionErrors::default() }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The roots of Blevins, Formulas for Natural Frequency and Mode Shape, and the sum of their -4th powers, 1/12.
    #[test]
    fn roots_and_static_deflection_are_those_of_the_theory() {
        for (number, expected) in [(1, 1.875_104_07), (2, 4.694_091_13), (3, 7.854_757_44), (20, 61.261_056_75)] {
            assert!((root(number) - expected).abs() < 1e-7, "{number}: {}", root(number));
        }
        let beam = Beam::new(REFERENCE_MODES);
        let compliance: f64 = beam.eigenvalues.iter().map(|eigenvalue| eigenvalue.recip()).sum();
        let deflection = FORCE * beam.tip_entry.powi(2) * compliance;
        assert!((deflection / Beam::static_deflection() - 1.0).abs() < 1e-10, "{deflection}");
        assert!((beam.eigenvalues[0].sqrt() / std::f64::consts::TAU - 8.15).abs() < 0.005);
    }
}
