//! Motions of a scene: seeded random states, and a synthetic or recorded trajectory.
//!
//! Exact states are f64, because a physics process computes in f64. The server receives them rounded to f32.

use std::f64::consts::TAU;
use std::sync::Arc;

use fastrand::Rng;
use nalgebra::{Matrix3, Rotation3, Vector3};
use rayon::prelude::*;

use super::exact_state::ExactState;
use super::recorded_trajectory::RecordedTrajectory;
use super::workloads::Workload;
use modalcast_model::scene::Scene;

/// Largest displacement along an axis by the first mode at one standard deviation, as a fraction of the domain's
/// diagonal.
const RELATIVE_AMPLITUDE: f64 = 0.05;
/// Limit of a domain's random rotation about its placement, radians.
const MAX_ROTATION: f64 = 0.2;
/// Limit of a domain's random translation from its placement, as a fraction of the domain's diagonal.
const MAX_RELATIVE_SHIFT: f64 = 0.05;
/// Limit of the standard deviation of a coordinate. A mode whose largest entry is denormal would otherwise need
/// coordinates that overflow in f32, whose largest number is 3.4e38.
const MAX_DEVIATION: f64 = 1e30;
/// Steps of a synthetic trajectory.
const TRAJECTORY_STEPS: usize = 24;
/// Seconds between steps.
const DT: f64 = 1.0 / 60.0;
/// Frequency of the slowest mode of a synthetic trajectory, and of the rotation of its domains.
const SLOWEST_MODE_HZ: f64 = 1.0;

/// All motions of one workload.
#[derive(Debug, Clone)]
pub struct WorkloadMotion {
    scene: Arc<Scene>,
    /// As [`Workload::has_cancelling_mode_pairs`].
    has_cancelling_mode_pairs: bool,
    /// One entry per packed coordinate.
    spreads: Vec<ModeSpread>,
    recorded_trajectory: Option<RecordedTrajectory>,
}

/// Distribution of one modal coordinate.
#[derive(Debug, Clone, Copy)]
struct ModeSpread {
    /// Standard deviation of the coordinate.
    deviation: f64,
    /// Frequency divided by that of the domain's first mode, at least 1.
    relative_frequency: f64,
}

impl WorkloadMotion {
    /// Motions of a workload. As in a stiff object, amplitudes are inversely proportional to frequencies. Frequencies
    /// follow from the eigenvalues. Without eigenvalues, the frequency of mode j (from 1) is proportional to j.
    pub fn new(workload: &Workload, recorded_trajectory: Option<RecordedTrajectory>) -> Self {
        let scene = &workload.scene;
        let mut spreads = vec![ModeSpread { deviation: 0.0, relative_frequency: 1.0 }; scene.layout.coordinates];
        let domain_spreads: Vec<_> =
            (0..scene.domains.len()).into_par_iter().map(|domain| mode_spreads(scene, domain)).collect();
        for (domain_layout, domain_spreads) in scene.layout.domains.iter().zip(domain_spreads) {
            spreads[domain_layout.first_q..][..domain_spreads.len()].copy_from_slice(&domain_spreads);
        }
        Self {
            scene: Arc::clone(scene),
            has_cancelling_mode_pairs: workload.has_cancelling_mode_pairs,
            spreads,
            recorded_trajectory,
        }
    }

    /// The random state of a seed: Gaussian coordinates and small rigid motions. With odd seeds, the terms of U q
    /// nearly cancel in all rows of U if the workload has cancelling mode pairs, otherwise in one random row per
    /// domain. Cancellation amplifies rounding errors.
    pub fn random_state(&self, seed: usize) -> ExactState {
        // The odd multiplier is 2^64 divided by the golden ratio. It turns consecutive seeds into distant ones.
        let mut rng = Rng::with_seed(0x5EED ^ (seed as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15));
        let mut q: Vec<f64> = self.spreads.iter().map(|spread| spread.deviation * random_normal(&mut rng)).collect();
        if seed % 2 == 1 {
            self.cancel_displacements(&mut q, &mut rng);
        }
        let transform_roots = self.scene.transform_roots.domains();
        let transforms = transform_roots.map(|domain| self.random_transform(domain as usize, &mut rng)).collect();
        ExactState { q, transforms }
    }

    /// Number of steps of the trajectory.
    pub fn steps(&self) -> usize {
        self.recorded_trajectory.as_ref().map_or(TRAJECTORY_STEPS, RecordedTrajectory::steps)
    }

    /// Whether the trajectory was recorded.
    pub const fn is_recorded(&self) -> bool {
        self.recorded_trajectory.is_some()
    }

    /// A step of the trajectory: the recorded one, otherwise independent oscillations of all modes.
    pub fn trajectory_state(&self, step: usize) -> ExactState {
        if let Some(trajectory) = &self.recorded_trajectory {
            return trajectory.step(&self.scene, step);
        }
        let time = step as f64 * DT;
        // All steps use the same amplitudes and phases, and hence the same seed.
        let mut rng = Rng::with_seed(0x7EA7);
        let oscillation = |spread: &ModeSpread| {
            let (amplitude, phase) = (spread.deviation * random_normal(&mut rng), TAU * rng.f64());
            amplitude * (TAU * SLOWEST_MODE_HZ * spread.relative_frequency * time + phase).cos()
        };
        let q = self.spreads.iter().map(oscillation).collect();
        let transform = |domain: u32| {
            // The index of a domain, as an angle in radians, gives each domain its own phase and axis.
            let (phase, domain) = (f64::from(domain), domain as usize);
            let angle = MAX_ROTATION * (TAU * SLOWEST_MODE_HZ * time + phase).sin();
            // The vector has the length sqrt(2). The factor 0.5 below keeps the rotation within MAX_ROTATION.
            let axis_angle = Vector3::new(phase.sin(), 1.0, phase.cos()) * angle;
            move_placement(&self.scene, domain, &Rotation3::new(axis_angle * 0.5).into_inner(), &Vector3::zeros())
        };
        ExactState { q, transforms: self.scene.transform_roots.domains().map(transform).collect() }
    }

    /// A random transform of a domain near its placement.
    fn random_transform(&self, domain: usize, rng: &mut Rng) -> [f64; 12] {
        // Components of at most max_length / sqrt(3) keep the length within max_length.
        let mut random_vector =
            |max_length: f64| Vector3::from_fn(|_, _| max_length * (2.0 * rng.f64() - 1.0) / 3f64.sqrt());
        let axis_angle = random_vector(MAX_ROTATION);
        let translation = random_vector(MAX_RELATIVE_SHIFT * diagonal(&self.scene, domain));
        move_placement(&self.scene, domain, &Rotation3::new(axis_angle).into_inner(), &translation)
    }

    /// Changes coordinates so that the terms of U q nearly cancel, as described at [`Self::random_state`].
    fn cancel_displacements(&self, q: &mut [f64], rng: &mut Rng) {
        for (domain, domain_layout) in self.scene.layout.domains.iter().enumerate() {
            let domain_q = &mut q[domain_layout.first_q..][..domain_layout.rank];
            if self.has_cancelling_mode_pairs {
                domain_q.chunks_exact_mut(2).for_each(|pair| pair[1] = -pair[0]);
            } else if domain_layout.rank > 1 {
                let modes = &self.scene.shape_of(domain).modes;
                let row = rng.usize(0..3 * domain_layout.vertices);
                let entry = |mode: usize| f64::from(modes.entry(row / 3, row % 3, mode));
                let largest_mode = (0..domain_layout.rank)
                    .max_by(|first, second| entry(*first).abs().total_cmp(&entry(*second).abs()))
                    .unwrap_or(0);
                // The mode with the largest entry of the row cancels the sum of the other terms.
                let remaining_displacement: f64 = (0..domain_layout.rank)
                    .filter(|mode| *mode != largest_mode)
                    .map(|mode| entry(mode) * domain_q[mode])
                    .sum();
                // A row of zeros, as of a clamped vertex, cancels already.
                if entry(largest_mode) != 0.0 {
                    domain_q[largest_mode] = -remaining_displacement / entry(largest_mode);
                }
            }
        }
    }
}

/// The distribution of each coordinate of a domain.
fn mode_spreads(scene: &Scene, domain: usize) -> Vec<ModeSpread> {
    let (modes, eigenvalues) = (&scene.shape_of(domain).modes, &scene.domains[domain].metadata.eigenvalues);
    // Present if the first eigenvalue is positive and every mode has an eigenvalue.
    let first_eigenvalue =
        eigenvalues.first().copied().filter(|value| *value > 0.0 && eigenvalues.len() == modes.rank());
    let amplitude = RELATIVE_AMPLITUDE * diagonal(scene, domain);
    let mode_spread = |mode: usize| {
        // An eigenvalue is the square of an angular frequency.
        let relative_frequency = first_eigenvalue
            .map_or((mode + 1) as f64, |first_eigenvalue| (eigenvalues[mode] / first_eigenvalue).max(1.0).sqrt());
        let max_entry = modes.column(mode).iter().fold(0.0_f32, |max, entry| max.max(entry.abs()));
        // The coordinate of a mode without displacement is arbitrary.
        let deviation = if max_entry > 0.0 { (amplitude / f64::from(max_entry)).min(MAX_DEVIATION) } else { 1.0 };
        ModeSpread { deviation: deviation / relative_frequency, relative_frequency }
    };
    (0..modes.rank()).map(mode_spread).collect()
}

/// Diagonal of a domain at rest, in scene units.
fn diagonal(scene: &Scene, domain: usize) -> f64 {
    let mut bounds = modalcast_model::scene::BoundingBox::EMPTY;
    scene.shape_of(domain).mesh.rest_positions().iter().for_each(|position| bounds.include(position.map(f64::from)));
    bounds.diagonal()
}

/// The placement of a domain, rotated in its own frame and translated in world space; three rows of four.
fn move_placement(scene: &Scene, domain: usize, rotation: &Matrix3<f64>, translation: &Vector3<f64>) -> [f64; 12] {
    let placement = scene.domains[domain].placement;
    let (linear, position) = (placement.linear() * rotation, placement.translation() + translation);
    std::array::from_fn(|entry| match (entry / 4, entry % 4) {
        (row, 3) => position[row],
        (row, column) => linear[(row, column)],
    })
}

/// A standard normal number, by the Box-Muller transform.
fn random_normal(rng: &mut Rng) -> f64 {
    (-2.0 * (1.0 - rng.f64()).ln()).sqrt() * (TAU * rng.f64()).cos()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing;
    use crate::workloads::{Size, WorkloadKind};

    fn motion(kind: WorkloadKind) -> WorkloadMotion {
        WorkloadMotion::new(&kind.build(Size::Quick).expect("a workload"), None)
    }

    #[test]
    fn gaussians_have_mean_0_and_deviation_1() {
        let mut rng = Rng::with_seed(1);
        let draws: Vec<f64> = (0..20_000).map(|_| random_normal(&mut rng)).collect();
        let mean = draws.iter().sum::<f64>() / 2e4;
        let variance = draws.iter().map(|draw| draw * draw).sum::<f64>() / 2e4;
        // The standard errors are 1 / sqrt(20,000) = 0.007 for the mean and sqrt(2 / 20,000) = 0.01 for the variance.
        // The limits are more than four times as large.
        assert!(mean.abs() < 0.03 && (variance - 1.0).abs() < 0.05, "mean {mean}, variance {variance}");
    }

    #[test]
    fn random_states_are_deterministic_and_not_exact_in_f32() {
        let motion = motion(WorkloadKind::ManyDomains);
        assert_eq!(motion.random_state(3), motion.random_state(3));
        assert_ne!(motion.random_state(3), motion.random_state(5));
        let exact_state = motion.random_state(0);
        assert_ne!(ExactState::of(&exact_state.state()), exact_state, "expected a difference by rounding to f32");
        assert!(exact_state.state().transforms.iter().all(|transform| transform.is_similarity()));
    }

    #[test]
    fn only_odd_seeds_cancel_in_one_row() {
        let motion = motion(WorkloadKind::Single { power: 10, rank: 10 });
        let modes = &motion.scene.shapes[0].modes;
        let max_condition = |seed: usize| {
            let q = motion.random_state(seed).q;
            let row_condition = |row: usize| {
                let terms = (0..10).map(|mode| f64::from(modes.entry(row / 3, row % 3, mode)) * q[mode]);
                terms.clone().map(f64::abs).sum::<f64>() / terms.sum::<f64>().abs()
            };
            (0..3 * modes.vertices()).map(row_condition).fold(0.0, f64::max)
        };
        // A sum of f64 that cancels leaves only rounding errors of about 1e-16.
        assert!(max_condition(1) > 1e12, "expected a row that cancels, got condition {}", max_condition(1));
        assert!(max_condition(0) < 1e6, "expected no row that cancels, got condition {}", max_condition(0));
    }

    #[test]
    fn coordinates_of_denormal_modes_are_finite_in_f32() {
        let workload = testing::with_denormal_modes(&WorkloadKind::Single { power: 6, rank: 4 });
        let motion = WorkloadMotion::new(&workload, None);
        for exact_state in
            (0..6).map(|seed| motion.random_state(seed)).chain((0..4).map(|step| motion.trajectory_state(step)))
        {
            let q = exact_state.state().q;
            assert!(q.iter().all(|coordinate| coordinate.is_finite() && *coordinate != 0.0), "{q:?}");
        }
    }

    #[test]
    fn slow_modes_are_large_and_consecutive_steps_are_close() {
        let motion = motion(WorkloadKind::OneDomain { has_normal_map: false });
        // Without eigenvalues, the frequency of the last of 32 modes is 32 times that of the first.
        assert!(motion.spreads[0].deviation > 10.0 * motion.spreads[31].deviation);
        let [first_state, second_state] = [0, 1].map(|step| motion.trajectory_state(step));
        assert_ne!(first_state, second_state);
        assert!((first_state.q[0] - second_state.q[0]).abs() < motion.spreads[0].deviation);
        assert_eq!(motion.steps(), TRAJECTORY_STEPS);
    }
}
