//! Linear modes against their closed form: each one alone, and ten modes from 1 mHz to 1 MHz in one system.

use std::f64::consts::TAU;

use nalgebra::{Complex, DVector};

use super::method::{AVERAGE_VECTOR_FIELD, BACKWARD_EULER, Method, System};
use super::row::{
    Expectation, IntegrationRow, Label, Measured, MotionErrors, larger, measure_rows, set_observed_orders,
};
use super::run::Motion;
use crate::workloads::Size;
use modalcast_dynamics::Result;
use modalcast_dynamics::implicit::ImplicitMethod;
use modalcast_dynamics::integrator::MotionState;
use modalcast_dynamics::oscillator::ModeState;
use modalcast_dynamics::vega::VegaSettings;

/// Name of the cases of single modes and of ten modes in one system.
pub(super) const SINGLE_MODES: &str = "oscillators";
pub(super) const STIFF_SYSTEM: &str = "stiff system";

/// Frequencies of the modes that are integrated alone.
const SINGLE_HERTZ: [f64; 4] = [1e-3, 1.0, 1e3, 1e6];
/// Damping ratios of these modes.
const DAMPING_RATIOS: [f64; 2] = [0.0, 0.02];
/// Periods of a mode that is integrated alone.
pub(super) const PERIODS: u64 = 4;
/// Samples per period, and steps per period of the largest step.
const MIN_STEPS_PER_PERIOD: u64 = 8;

/// Modes of the stiff system: powers of ten, hertz.
const STIFF_EXPONENTS: std::ops::RangeInclusive<i32> = -3..=6;
/// Largest step of the stiff system, that of `modalcast-sim`. The samples are a second apart.
const STIFF_DT: f64 = 1.0 / 60.0;
/// The stiffness coefficient that damps the mode of 1 MHz with a ratio of 0.02.
const STIFF_DAMPING: f64 = 2.0 * 0.02 / (TAU * 1e6);

/// The tolerance of the bridge in `modalcast-sim`, diagonals.
pub(super) const DEFAULT_TOLERANCE: f64 = 1e-5;

/// Methods that are measured with all steps, and those that divide large steps.
const FIXED_METHODS: [Method; 3] = [Method::Exact, AVERAGE_VECTOR_FIELD, BACKWARD_EULER];
const ADAPTIVE_METHODS: [Method; 2] = [
    Method::Adaptive(ImplicitMethod::AverageVectorField, DEFAULT_TOLERANCE),
    Method::Adaptive(ImplicitMethod::BackwardEuler, DEFAULT_TOLERANCE),
];

/// Free motion of an underdamped mode, released at q = 1.
#[derive(Debug, Clone, Copy)]
pub(super) struct ReleasedMode {
    eigenvalue: f64,
    /// Damping ratio times omega, 1/s.
    decay_rate: f64,
    /// Angular frequency of the damped mode.
    damped_omega: f64,
}

impl ReleasedMode {
    pub(super) fn new(eigenvalue: f64, damping_ratio: f64) -> Self {
        let omega = eigenvalue.sqrt();
        let damped_omega = omega * ((1.0 - damping_ratio) * (1.0 + damping_ratio)).sqrt();
        Self { eigenvalue, decay_rate: damping_ratio * omega, damped_omega }
    }

    /// The state at a time in seconds.
    pub(super) fn at(&self, time: f64) -> ModeState {
        let (sine, cosine) = (self.damped_omega * time).sin_cos();
        let decay = (-self.decay_rate * time).exp();
        let q = decay * (cosine + self.decay_rate / self.damped_omega * sine);
        ModeState { q, v: -decay * self.eigenvalue / self.damped_omega * sine }
    }

    fn energy(&self, state: ModeState) -> f64 {
        0.5 * (state.v * state.v + self.eigenvalue * state.q * state.q)
    }

    /// The complex number whose real part is q and whose angle increases by the damped frequency times the time.
    fn phasor(&self, state: ModeState) -> Complex<f64> {
        Complex::new(state.q, -(state.v + self.decay_rate * state.q) / self.damped_omega)
    }

    /// Errors of states at some times. That of the displacement is the distance of the complex numbers: the largest error
    /// of q within a period around each time, whether q or its velocity is 0 at that time.
    pub(super) fn errors(&self, states: &[(f64, ModeState)]) -> MotionErrors {
        let largest = |error: &dyn Fn(f64, ModeState) -> f64| {
            states.iter().map(|(time, state)| error(*time, *state)).fold(0.0, larger)
        };
        let start_energy = 0.5 * self.eigenvalue;
        let phase = states.last().and_then(|(time, state)| {
            let (exact, phasor) = (self.phasor(self.at(*time)), self.phasor(*state));
            // A decayed motion has no phase.
            let has_phase = exact.norm() > 1e-12 && phasor.norm() > 1e-12;
            has_phase.then(|| (phasor * exact.conj()).arg().abs())
        });
        MotionErrors {
            displacement: largest(&|time, state| (self.phasor(state) - self.phasor(self.at(time))).norm()),
            phase_radians: phase,
            energy: Some(largest(&|time, state| {
                (self.energy(state) - self.energy(self.at(time))).abs() / start_energy
            })),
            ..MotionErrors::default()
        }
    }
}

/// The states of one coordinate.
fn mode_states(motion: &Motion, samples: &[MotionState], mode: usize) -> Vec<(f64, ModeState)> {
    let state = |(index, sample): (usize, &MotionState)| {
        (motion.sample_time(index), ModeState { q: sample.q[mode], v: sample.v[mode] })
    };
    samples.iter().enumerate().map(state).collect()
}

/// Methods and divisors of the largest step: the divisions of the fixed methods are 1, `factor`, `factor`^2 and so on, those
/// of the adaptive methods the first `adaptive_count` of these.
fn list_runs(factor: u64, fixed_count: u32, adaptive_count: u32) -> Vec<(Method, u64)> {
    let runs_of = |method: &Method, count: u32| {
        let method = *method;
        (0..count).map(move |exponent| (method, factor.pow(exponent)))
    };
    let fixed = FIXED_METHODS.iter().flat_map(|method| runs_of(method, fixed_count));
    fixed.chain(ADAPTIVE_METHODS.iter().flat_map(|method| runs_of(method, adaptive_count))).collect()
}

/// Measures modes that are integrated alone, with steps from 1/8 of their period.
///
/// # Errors
/// None are expected for these systems.
pub(super) fn measure_single_modes(size: Size) -> Result<Vec<IntegrationRow>> {
    let (fixed_count, adaptive_count) = if size == Size::Full { (8, 3) } else { (7, 1) };
    let mut rows = Vec::new();
    for hertz in SINGLE_HERTZ {
        for damping_ratio in DAMPING_RATIOS {
            let omega = TAU * hertz;
            let settings = VegaSettings { damping_mass: 2.0 * damping_ratio * omega, ..VegaSettings::default() };
            let system = System::of_modes(&[omega * omega], settings)?;
            let mode = ReleasedMode::new(omega * omega, damping_ratio);
            let name = format!("{}, {}", format_hertz(hertz), format_damping(damping_ratio));
            for (method, steps_per_sample) in list_runs(2, fixed_count, adaptive_count) {
                let label = Label { case: SINGLE_MODES, expectation: Expectation::Candidate, method, system: &system };
                let motion = Motion {
                    start: MotionState::resting(DVector::from_element(1, 1.0)),
                    load: DVector::zeros(1),
                    dt: 1.0 / (hertz * (MIN_STEPS_PER_PERIOD * steps_per_sample) as f64),
                    steps_per_sample,
                    samples: PERIODS * MIN_STEPS_PER_PERIOD,
                };
                rows.extend(measure_rows(&label, &name, &motion, |samples| {
                    let errors = mode.errors(&mode_states(&motion, samples, 0));
                    vec![Measured { system: name.clone(), mode_hertz: Some(hertz), errors }]
                }));
            }
        }
    }
    set_observed_orders(&mut rows);
    Ok(rows)
}

/// Measures ten modes in one system. A row has the errors of one mode and the time of the system.
///
/// # Errors
/// None are expected for these systems.
pub(super) fn measure_stiff_system(size: Size) -> Result<Vec<IntegrationRow>> {
    let hertz: Vec<f64> = STIFF_EXPONENTS.map(|exponent| 10_f64.powi(exponent)).collect();
    let eigenvalues: Vec<f64> = hertz.iter().map(|hertz| (TAU * hertz).powi(2)).collect();
    let (fixed_count, seconds) = if size == Size::Full { (3, 10) } else { (2, 2) };
    let mut rows = Vec::new();
    for (damping_stiffness, damping_name) in [(0.0, "undamped"), (STIFF_DAMPING, "damped by stiffness")] {
        let settings = VegaSettings { damping_stiffness, ..VegaSettings::default() };
        let system = System::of_modes(&eigenvalues, settings)?;
        for (method, divisor) in list_runs(4, fixed_count, 1) {
            let label = Label { case: STIFF_SYSTEM, expectation: Expectation::Finite, method, system: &system };
            let motion = Motion {
                start: MotionState::resting(DVector::from_element(hertz.len(), 1.0)),
                load: DVector::zeros(hertz.len()),
                dt: STIFF_DT / divisor as f64,
                steps_per_sample: 60 * divisor,
                samples: seconds,
            };
            rows.extend(measure_rows(&label, &format!("ten modes, {damping_name}"), &motion, |samples| {
                let mode_errors = |(index, hertz): (usize, &f64)| {
                    let omega = TAU * hertz;
                    let mode = ReleasedMode::new(omega * omega, 0.5 * damping_stiffness * omega);
                    Measured {
                        system: format!("{} of ten modes, {damping_name}", format_hertz(*hertz)),
                        mode_hertz: Some(*hertz),
                        errors: mode.errors(&mode_states(&motion, samples, index)),
                    }
                };
                hertz.iter().enumerate().map(mode_errors).collect()
            }));
        }
    }
    Ok(rows)
}

/// A frequency with its unit.
pub(super) fn format_hertz(hertz: f64) -> String {
    match hertz {
        hertz if hertz < 0.999 => format!("{:.3} Hz", hertz),
        hertz if hertz < 999.0 => format!("{hertz:.0} Hz"),
        hertz if hertz < 999e3 => format!("{:.0} kHz", hertz / 1e3),
        hertz => format!("{:.0} MHz", hertz / 1e6),
    }
}

pub(super) fn format_damping(damping_ratio: f64) -> String {
    if damping_ratio == 0.0 { "undamped".into() } else { format!("damping ratio {damping_ratio}") }
}
