//! References of motions without a closed form: the classical Runge-Kutta method of fourth order with steps so small that
//! halving them changes nothing that matters.

use nalgebra::{DMatrix, DVector};
use serde::Serialize;

use super::method::System;
use super::row::{MotionErrors, larger};
use super::run::Motion;
use modalcast_dynamics::integrator::MotionState;
use modalcast_dynamics::reduced_system::ReducedSystem;

/// The largest change by halving the step, relative to the largest displacement, below which the step is not halved
/// again.
const TOLERANCE: f64 = 1e-8;
/// Maximum number of halvings.
const MAX_HALVINGS: u32 = 7;
/// Radians of the fastest linear mode per first step. Steps above 2.8 are unstable.
const FIRST_STEP_RADIANS: f64 = 0.5;

/// Maps coordinates to displacements.
#[derive(Debug, Clone)]
pub(super) struct Displacements {
    /// Three rows per vertex, one column per coordinate.
    pub(super) modes: DMatrix<f64>,
}

impl Displacements {
    /// Every coordinate is a displacement of its own.
    pub(super) fn of_coordinates(rank: usize) -> Self {
        let entry = |row, coordinate| if row == 3 * coordinate { 1.0 } else { 0.0 };
        Self { modes: DMatrix::from_fn(3 * rank, rank, entry) }
    }

    /// The largest length of a displacement.
    pub(super) fn largest(&self, q: &DVector<f64>) -> f64 {
        let displacements = &self.modes * q;
        displacements.as_slice().chunks_exact(3).map(length).fold(0.0, larger)
    }

    /// Per coordinate: the largest displacement by a unit.
    pub(super) fn per_unit(&self) -> Vec<f64> {
        let largest_of =
            |column: usize| self.modes.column(column).as_slice().chunks_exact(3).map(length).fold(0.0, larger);
        (0..self.modes.ncols()).map(largest_of).collect()
    }
}

fn length(vector: &[f64]) -> f64 {
    vector.iter().map(|component| component * component).sum::<f64>().sqrt()
}

/// How a reference was computed.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ReferenceSummary {
    pub case: &'static str,
    pub system: String,
    pub dt_seconds: f64,
    /// The largest change of a displacement by the last halving of the step, relative to the largest displacement. The
    /// error of the fourth-order method is about 15 times smaller.
    pub change_by_halving: f64,
}

/// A motion at the sample times.
#[derive(Debug, Clone)]
pub(super) struct Reference {
    pub(super) samples: Vec<MotionState>,
    pub(super) summary: ReferenceSummary,
    /// The largest displacement.
    scale: f64,
}

impl Reference {
    /// Integrates a motion.
    pub(super) fn integrate(
        (case, name): (&'static str, &str),
        system: &System,
        motion: &Motion,
        displacements: &Displacements,
    ) -> Self {
        let reduced_system = system.reduced_system();
        let interval = motion.dt * motion.steps_per_sample as f64;
        let omega = std::f64::consts::TAU * system.highest_hertz();
        let mut division = (interval * omega / FIRST_STEP_RADIANS).ceil().max(1.0) as u64;
        let mut samples = integrate(&reduced_system, motion, division);
        let mut change = f64::INFINITY;
        let mut scale = 0.0;
        for _ in 0..MAX_HALVINGS {
            division *= 2;
            let finer = integrate(&reduced_system, motion, division);
            scale = finer.iter().map(|state| displacements.largest(&state.q)).fold(0.0, larger);
            let pairs = samples.iter().zip(&finer);
            change = pairs.map(|(a, b)| displacements.largest(&(&a.q - &b.q))).fold(0.0, larger) / scale;
            samples = finer;
            if change <= TOLERANCE {
                break;
            }
        }
        let dt_seconds = interval / division as f64;
        let summary = ReferenceSummary { case, system: name.to_owned(), dt_seconds, change_by_halving: change };
        Self { samples, summary, scale }
    }

    /// Errors of samples. The energy of a system without damping and load is that of the start.
    pub(super) fn errors(
        &self,
        system: &System,
        motion: &Motion,
        displacements: &Displacements,
        samples: &[MotionState],
    ) -> MotionErrors {
        let reduced_system = system.reduced_system();
        let start_energy = reduced_system.energy(&motion.start);
        let is_conservative = system.is_undamped() && motion.load.norm() == 0.0;
        let (mut displacement, mut energy) = (0.0, 0.0);
        for (sample, exact) in samples.iter().zip(&self.samples) {
            displacement = larger(displacement, displacements.largest(&(&sample.q - &exact.q)) / self.scale);
            let exact_energy = if is_conservative { start_energy } else { reduced_system.energy(exact) };
            energy = larger(energy, ((reduced_system.energy(sample) - exact_energy) / start_energy).abs());
        }
        // A motion that begins at rest has no energy to compare with.
        MotionErrors { displacement, energy: energy.is_finite().then_some(energy), ..MotionErrors::default() }
    }
}

/// The states at the sample times, with `division` steps between samples.
fn integrate(system: &ReducedSystem, motion: &Motion, division: u64) -> Vec<MotionState> {
    let h = motion.dt * motion.steps_per_sample as f64 / division as f64;
    let acceleration =
        |q: &DVector<f64>, v: &DVector<f64>| &motion.load - system.evaluate(q).force - system.damping() * v;
    let (mut q, mut v) = (motion.start.q.clone(), motion.start.v.clone());
    let mut samples = Vec::with_capacity(motion.samples as usize);
    for _ in 0..motion.samples {
        for _ in 0..division {
            let (v1, a1) = (v.clone(), acceleration(&q, &v));
            let v2 = &v + &a1 * (h / 2.0);
            let a2 = acceleration(&(&q + &v1 * (h / 2.0)), &v2);
            let v3 = &v + &a2 * (h / 2.0);
            let a3 = acceleration(&(&q + &v2 * (h / 2.0)), &v3);
            let v4 = &v + &a3 * h;
            let a4 = acceleration(&(&q + &v3 * h), &v4);
            q += (v1 + (v2 + v3) * 2.0 + v4) * (h / 6.0);
            v += (a1 + (a2 + a3) * 2.0 + a4) * (h / 6.0);
        }
        samples.push(MotionState { v: v.clone(), ..MotionState::resting(q.clone()) });
    }
    samples
}
