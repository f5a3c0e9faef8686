//! Motions of a scene: seeded random states, synthetic trajectories, and recorded ones.
//!
//! A physics process computes in f64 and sends f32, so the truth here is f64 and a state is its rounding.

use std::f64::consts::TAU;
use std::sync::Arc;

use fastrand::Rng;
use nalgebra::{Matrix3, Rotation3, Vector3};
use rayon::prelude::*;

use super::exact_state::ExactState;
use super::recorded_trajectory::RecordedTrajectory;
use super::workloads::Workload;
use modalcast_model::scene::Scene;

/// Standard deviation of the first mode's largest displacement component, as a fraction of its domain's diagonal.
const SHARE: f64 = 0.05;
/// Limits of a domain's random rotation and translation about its placement: radians, and a fraction of its diagonal.
const TURN: f64 = 0.2;
const SHIFT: f64 = 0.05;
/// Number of steps of a synthetic trajectory, time between them in seconds, and frequency of the slowest mode in hertz.
const STEPS: usize = 24;
const DT: f64 = 1.0 / 60.0;
const SLOWEST: f64 = 1.0;

/// All motions of one load.
#[derive(Debug, Clone)]
pub struct WorkloadMotion {
    scene: Arc<Scene>,
    paired: bool,
    /// Per packed coordinate: standard deviation, and frequency relative to the domain's slowest mode.
    spread: Vec<(f64, f64)>,
    record: Option<RecordedTrajectory>,
}

impl WorkloadMotion {
    /// Motions for a load. Amplitudes decrease with frequency as those of a stiff object do: from the eigenvalues where
    /// the scene has them, otherwise as 1 / j.
    pub fn new(load: &Workload, record: Option<RecordedTrajectory>) -> Self {
        let scene = &load.scene;
        let mut spread = vec![(0.0, 1.0); scene.layout.coordinates];
        let parts: Vec<_> = (0..scene.domains.len()).into_par_iter().map(|domain| spread_of(scene, domain)).collect();
        for (slot, part) in scene.layout.domains.iter().zip(parts) {
            spread[slot.first_q..][..part.len()].copy_from_slice(&part);
        }
        Self { scene: Arc::clone(scene), paired: load.paired, spread, record }
    }

    /// The random state of a seed: Gaussian coordinates and small rigid motions. Odd seeds nearly cancel: in pairs
    /// where modes are paired, otherwise in one random row per domain, where the mode with the largest entry cancels
    /// the sum of all others.
    pub fn seed(&self, seed: usize) -> ExactState {
        let mut rng = Rng::with_seed(0x5EED ^ (seed as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15));
        let mut q: Vec<f64> = self.spread.iter().map(|(spread, _)| spread * gauss(&mut rng)).collect();
        if seed % 2 == 1 {
            self.cancel(&mut q, &mut rng);
        }
        let transform_roots = self.scene.transform_roots.domains();
        let transforms = transform_roots.map(|domain| self.moved(domain as usize, &mut rng)).collect();
        ExactState { q, transforms }
    }

    /// Number of steps of the trajectory.
    pub fn steps(&self) -> usize {
        self.record.as_ref().map_or(STEPS, RecordedTrajectory::steps)
    }

    /// Whether the trajectory was recorded.
    pub const fn is_recorded(&self) -> bool {
        self.record.is_some()
    }

    /// A step of the trajectory: the recorded one, otherwise independent oscillations of all modes.
    pub fn step(&self, step: usize) -> ExactState {
        if let Some(record) = &self.record {
            return record.step(&self.scene, step);
        }
        let time = step as f64 * DT;
        let mut rng = Rng::with_seed(0x7EA7);
        let mut swing = |(spread, ratio): &(f64, f64)| {
            let (size, phase) = (spread * gauss(&mut rng), TAU * rng.f64());
            size * (TAU * SLOWEST * ratio * time + phase).cos()
        };
        let q = self.spread.iter().map(&mut swing).collect();
        let turn = |domain: u32| {
            let (phase, domain) = (f64::from(domain), domain as usize);
            let axis = Vector3::new(phase.sin(), 1.0, phase.cos()) * (TURN * (TAU * SLOWEST * time + phase).sin());
            place(&self.scene, domain, &Rotation3::new(axis * 0.5).into_inner(), &Vector3::zeros())
        };
        ExactState { q, transforms: self.scene.transform_roots.domains().map(turn).collect() }
    }

    fn moved(&self, domain: usize, rng: &mut Rng) -> [f64; 12] {
        let mut any = |most: f64| Vector3::from_fn(|_, _| most * (2.0 * rng.f64() - 1.0) / 3f64.sqrt());
        let (turn, shift) = (any(TURN), any(SHIFT * diagonal(&self.scene, domain)));
        place(&self.scene, domain, &Rotation3::new(turn).into_inner(), &shift)
    }

    fn cancel(&self, q: &mut [f64], rng: &mut Rng) {
        for (domain, slot) in self.scene.layout.domains.iter().enumerate() {
            let own = &mut q[slot.first_q..][..slot.rank];
            if self.paired {
                own.chunks_exact_mut(2).for_each(|pair| pair[1] = -pair[0]);
            } else if slot.rank > 1 {
                let modes = &self.scene.shape_of(domain).modes;
                let row = rng.usize(0..3 * slot.vertices);
                let entry = |mode: usize| f64::from(modes.entry(row / 3, row % 3, mode));
                let largest = (0..slot.rank).max_by(|a, b| entry(*a).abs().total_cmp(&entry(*b).abs())).unwrap_or(0);
                let others: f64 =
                    (0..slot.rank).filter(|mode| *mode != largest).map(|mode| entry(mode) * own[mode]).sum();
                // A row of zeros, as of a clamped vertex, cancels already.
                if entry(largest) != 0.0 {
                    own[largest] = -others / entry(largest);
                }
            }
        }
    }
}

/// Standard deviation and relative frequency of each mode of a domain.
fn spread_of(scene: &Scene, domain: usize) -> Vec<(f64, f64)> {
    let (modes, known) = (&scene.shape_of(domain).modes, &scene.domains[domain].metadata.eigenvalues);
    let slowest = known.first().copied().filter(|value| *value > 0.0 && known.len() == modes.rank());
    let reach = SHARE * diagonal(scene, domain);
    let one = |mode: usize| {
        let ratio = slowest.map_or((mode + 1) as f64, |slowest| (known[mode] / slowest).max(1.0).sqrt());
        let largest = modes.column(mode).iter().fold(0.0_f32, |largest, entry| largest.max(entry.abs()));
        // The coordinate of a mode without displacement is arbitrary.
        let size = if largest > 0.0 { reach / f64::from(largest) } else { 1.0 };
        (size / ratio, ratio)
    };
    (0..modes.rank()).map(one).collect()
}

/// Diagonal of a domain at rest, in scene units.
fn diagonal(scene: &Scene, domain: usize) -> f64 {
    let mut bounds = modalcast_model::scene::BoundingBox::EMPTY;
    scene.shape_of(domain).mesh.rest_positions().iter().for_each(|position| bounds.include(position.map(f64::from)));
    bounds.diagonal()
}

/// The placement of a domain, rotated in its own frame and translated in world space.
fn place(scene: &Scene, domain: usize, turn: &Matrix3<f64>, shift: &Vector3<f64>) -> [f64; 12] {
    let placement = scene.domains[domain].placement;
    let (linear, translation) = (placement.linear() * turn, placement.translation() + shift);
    std::array::from_fn(|at| match (at / 4, at % 4) {
        (row, 3) => translation[row],
        (row, column) => linear[(row, column)],
    })
}

/// A standard normal number (Box and Muller).
fn gauss(rng: &mut Rng) -> f64 {
    (-2.0 * (1.0 - rng.f64()).ln()).sqrt() * (TAU * rng.f64()).cos()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::workloads::{Size, WorkloadKind};

    fn motion(kind: WorkloadKind) -> WorkloadMotion {
        WorkloadMotion::new(&kind.build(Size::Quick).expect("built"), None)
    }

    #[test]
    fn gaussians_have_mean_0_and_deviation_1() {
        let mut rng = Rng::with_seed(1);
        let draws: Vec<f64> = (0..20_000).map(|_| gauss(&mut rng)).collect();
        let mean = draws.iter().sum::<f64>() / 2e4;
        let square = draws.iter().map(|draw| draw * draw).sum::<f64>() / 2e4;
        assert!(mean.abs() < 0.03 && (square - 1.0).abs() < 0.05, "{mean} {square}");
    }

    #[test]
    fn seeds_are_deterministic_and_not_representable_in_f32() {
        let motion = motion(WorkloadKind::ManyDomains);
        assert_eq!(motion.seed(3), motion.seed(3));
        assert_ne!(motion.seed(3), motion.seed(5));
        let truth = motion.seed(0);
        assert_ne!(ExactState::of(&truth.state()), truth, "rounding shows");
        assert!(truth.state().transforms.iter().all(|transform| transform.is_similarity()));
    }

    #[test]
    fn only_odd_seeds_cancel_in_one_row() {
        let motion = motion(WorkloadKind::Single { power: 10, rank: 10 });
        let modes = &motion.scene.shapes[0].modes;
        let condition = |seed: usize| {
            let q = motion.seed(seed).q;
            let row = |row: usize| {
                let terms = (0..10).map(|mode| f64::from(modes.entry(row / 3, row % 3, mode)) * q[mode]);
                terms.clone().map(f64::abs).sum::<f64>() / terms.sum::<f64>().abs()
            };
            (0..3 * modes.vertices()).map(row).fold(0.0, f64::max)
        };
        assert!(condition(1) > 1e12, "{}", condition(1));
        assert!(condition(0) < 1e6, "{}", condition(0));
    }

    #[test]
    fn slow_modes_are_large_and_steps_are_close() {
        let motion = motion(WorkloadKind::OneDomain { dressed: false });
        assert!(motion.spread[0].0 > 10.0 * motion.spread[31].0);
        let [first, second] = [0, 1].map(|step| motion.step(step));
        assert_ne!(first, second);
        let largest = motion.spread[0].0;
        assert!((first.q[0] - second.q[0]).abs() < largest);
        assert_eq!(motion.steps(), STEPS);
    }
}
