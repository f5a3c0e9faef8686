//! Extreme steps, eigenvalues and loads. A method that fails states its error in its row.

use std::f64::consts::TAU;

use nalgebra::DVector;

use super::method::{AVERAGE_VECTOR_FIELD, BACKWARD_EULER, Method, QuarticPotential, System};
use super::oscillators::{DEFAULT_TOLERANCE, ReleasedMode};
use super::reference::{Displacements, Reference, ReferenceSummary};
use super::row::{Expectation, IntegrationRow, Label, Measured, MotionErrors, larger, measure_rows};
use super::run::Motion;
use modalcast_dynamics::Result;
use modalcast_dynamics::implicit::ImplicitMethod;
use modalcast_dynamics::integrator::MotionState;
use modalcast_dynamics::vega::VegaSettings;

pub(super) const CASE: &str = "extremes";

const ADAPTIVE: Method = Method::Adaptive(ImplicitMethod::AverageVectorField, DEFAULT_TOLERANCE);
const ALL: [Method; 4] = [Method::Exact, AVERAGE_VECTOR_FIELD, ADAPTIVE, BACKWARD_EULER];

/// (1 Hz)^2 as an eigenvalue.
const ONE_HERTZ: f64 = TAU * TAU;

/// An extreme case.
struct Extreme {
    name: &'static str,
    system: System,
    motion: Motion,
    methods: Vec<(Method, Expectation)>,
    exact: Exact,
}

/// What the errors are relative to.
enum Exact {
    /// Linear modes that are released at q = 1, or that move with the velocity 1 if their eigenvalue is 0.
    ClosedForm,
    RungeKutta,
    /// There is no motion to compare with.
    Unknown,
}

/// Measures all cases.
///
/// # Errors
/// None are expected for these systems.
pub(super) fn measure() -> Result<(Vec<IntegrationRow>, Vec<ReferenceSummary>)> {
    let (mut rows, mut references) = (Vec::new(), Vec::new());
    for extreme in all()? {
        let displacements = Displacements::of_coordinates(extreme.system.rank());
        let Extreme { name, system, motion, .. } = &extreme;
        let reference = matches!(extreme.exact, Exact::RungeKutta)
            .then(|| Reference::integrate((CASE, name), system, motion, &displacements));
        for (method, expectation) in &extreme.methods {
            let label = Label { case: CASE, expectation: *expectation, method: *method, system };
            rows.extend(measure_rows(&label, name, motion, |samples| {
                let errors = match (&reference, &extreme.exact) {
                    (Some(reference), _) => reference.errors(system, motion, &displacements, samples),
                    (None, Exact::ClosedForm) => linear_errors(&extreme, samples),
                    (None, _) => MotionErrors::default(),
                };
                Measured::of_system(name, errors)
            }));
        }
        references.extend(reference.map(|reference| reference.summary));
    }
    Ok((rows, references))
}

/// Errors against the closed form.
fn linear_errors(extreme: &Extreme, samples: &[MotionState]) -> MotionErrors {
    let eigenvalues = extreme.system.force.rest_stiffness().diagonal();
    let exact_q = |mode: usize, time: f64| match eigenvalues[mode] {
        0.0 => time,
        eigenvalue => ReleasedMode::new(eigenvalue, 0.0).at(time).q,
    };
    let (mut error, mut largest) = (0.0, 0.0);
    for (index, sample) in samples.iter().enumerate() {
        let exact = DVector::from_fn(eigenvalues.len(), |mode, _| exact_q(mode, extreme.motion.sample_time(index)));
        error = larger(error, (&sample.q - &exact).amax());
        largest = f64::max(largest, exact.amax());
    }
    MotionErrors { displacement: error / largest, ..MotionErrors::default() }
}

/// A motion with `steps` steps of `dt` seconds and at most 100 samples.
fn motion(start: MotionState, load: &[f64], dt: f64, steps: u64) -> Motion {
    let samples = steps.min(100);
    Motion { start, load: DVector::from_column_slice(load), dt, steps_per_sample: steps / samples, samples }
}

fn finite(methods: &[Method]) -> Vec<(Method, Expectation)> {
    methods.iter().map(|method| (*method, Expectation::Finite)).collect()
}

/// The Duffing oscillator with the force `eigenvalue q + cubic q^3`.
fn duffing(eigenvalue: f64, cubic: f64) -> Result<System> {
    let potential = QuarticPotential { coefficient: cubic, weights: vec![(0, 1.0)] };
    System::with_quartic_potentials(&[eigenvalue], &[potential], VegaSettings::default())
}

fn all() -> Result<Vec<Extreme>> {
    let resting = |q: &[f64]| MotionState::resting(DVector::from_column_slice(q));
    let two_modes = System::of_modes(&[ONE_HERTZ, ONE_HERTZ * 1e12], VegaSettings::default())?;
    let linear = |name, dt, steps| Extreme {
        name,
        system: two_modes.clone(),
        motion: motion(resting(&[1.0, 1.0]), &[0.0, 0.0], dt, steps),
        methods: finite(&ALL),
        exact: Exact::ClosedForm,
    };
    let cubic =
        |name, system, motion| Extreme { name, system, motion, methods: finite(&ALL[1..]), exact: Exact::RungeKutta };
    let mut cases = vec![
        linear("1 Hz and 1 MHz, steps of 1 ns", 1e-9, 1000),
        linear("1 Hz and 1 MHz, steps of 10 s", 10.0, 100),
        Extreme {
            name: "eigenvalue 0 with a velocity",
            system: System::of_modes(&[0.0, ONE_HERTZ], VegaSettings::default())?,
            motion: motion(
                MotionState { v: DVector::from_column_slice(&[1.0, 0.0]), ..resting(&[0.0, 1.0]) },
                &[0.0, 0.0],
                1.0 / 60.0,
                600,
            ),
            methods: finite(&ALL),
            exact: Exact::ClosedForm,
        },
        cubic("Duffing, steps of 1 ns", duffing(ONE_HERTZ, ONE_HERTZ)?, motion(resting(&[1.0]), &[0.0], 1e-9, 1000)),
        cubic("Duffing, steps of 10 s", duffing(ONE_HERTZ, ONE_HERTZ)?, motion(resting(&[1.0]), &[0.0], 10.0, 4)),
        // The linear deflection is ten times that at which the stiffness doubles.
        cubic(
            "load that stretches ten times",
            duffing(ONE_HERTZ, ONE_HERTZ)?,
            motion(resting(&[0.0]), &[10.0 * ONE_HERTZ], 1.0 / 60.0, 120),
        ),
        // Two wells at q = -1 and 1.
        cubic(
            "negative eigenvalue with a cubic force",
            duffing(-ONE_HERTZ, ONE_HERTZ)?,
            motion(resting(&[0.1]), &[0.0], 1.0 / 60.0, 240),
        ),
    ];
    if let Some(negative) = cases.last_mut() {
        negative.methods.push((Method::Exact, Expectation::Failure));
    }
    // Beyond the barrier of the potential, the motion reaches infinity in a finite time.
    cases.push(Extreme {
        name: "softening force without a barrier",
        system: duffing(ONE_HERTZ, -ONE_HERTZ)?,
        motion: motion(MotionState { v: DVector::from_element(1, 300.0), ..resting(&[0.0]) }, &[0.0], 0.5, 10),
        methods: vec![(AVERAGE_VECTOR_FIELD, Expectation::Failure), (ADAPTIVE, Expectation::Failure)],
        exact: Exact::Unknown,
    });
    Ok(cases)
}
