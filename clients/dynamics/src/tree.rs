//! A tree that sways in the wind. Each mode is an exact oscillator. Its force is U^T times the wind pressure on sampled
//! vertices, plus the forces of child parts at their joints. The hierarchy gives the transforms.
//!
//! The load is calibrated to a given sway. A calibration run first applies the same wind at unit strength; the modes
//! are linear, so their response scales with the strength. The strength is then chosen so that the peak of the crown's
//! mean displacement is the requested share of the height. The bending of each branch is limited to a share of its
//! extent, because linear modes do not represent large bending.

use nalgebra::Vector3;
use serde_json::json;

use crate::affine::Affine;
use crate::error::{Result, invalid};
use crate::hierarchy::{JointGapMeter, transforms};
use crate::model::{DomainModel, Model};
use crate::oscillator::{Oscillator, State};
use crate::run::{Motion, Scenario, ScenarioReport};
use crate::wind::Wind;

/// The largest bending of a branch, and of the trunk, as a share of its extent.
const MAX_BRANCH_BENDING: f64 = 0.05;
const MAX_TRUNK_BENDING: f64 = 0.2;

/// Scale of the rotation of a rigid leaf about its base, in radians.
const FLUTTER_ANGLE: f64 = 0.15;

/// Damping ratio of parts without a note `damping_ratio`.
const DEFAULT_DAMPING_RATIO: f64 = 0.03;

/// Settings of the wind.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Options {
    /// Seconds per step.
    pub dt: f64,
    /// Number of steps; `None` for an unlimited run.
    pub steps: Option<u64>,
    /// Peak displacement of the crown at wind 1, as a share of the height.
    pub sway: f64,
    pub wind: f64,
    /// Direction that the wind blows to, in radians about the up axis from the first horizontal axis (x, or y if x is
    /// up).
    pub direction: f64,
    pub seed: u64,
}

/// Reduced loads of one part, per unit of wind pressure and of force of its children.
struct WindLoad {
    /// Per mode: U^T times a unit pressure along and across the wind.
    along: Vec<f64>,
    across: Vec<f64>,
    /// 3 x r of the parent: the mean rows of the parent's U at the joint, in world axes; empty without a parent.
    joint_modes: Vec<f64>,
    /// Downwind distance of the part, in scene units.
    distance: f64,
}

/// The tree scenario.
pub struct TreeScenario {
    model: Model,
    wind: Wind,
    options: Options,
    modes: Vec<Oscillator>,
    loads: Vec<WindLoad>,
    gains: Vec<f64>,
    /// States and forces at step `next`, the step of the next motion.
    states: Vec<State>,
    forces: Vec<f64>,
    next: u64,
    /// Part and sample index of the highest sample of each part that reaches the crown.
    crown: Vec<(usize, usize)>,
    gauge: JointGapMeter,
    calibrated_sway: f64,
    sway: f64,
    peak: f64,
    gap: f64,
}

impl TreeScenario {
    /// Calibrates the wind for the tree.
    ///
    /// # Errors
    /// `Invalid` if the scene has no eigenvalues, or an eigenvalue, a damping ratio or the step is out of range.
    pub fn new(model: Model, options: Options) -> Result<Self> {
        if model.parts.iter().all(|part| part.eigenvalues.is_empty()) {
            let given = format!("{} domains without any; try the sweep", model.parts.len());
            return Err(invalid("scene.eigenvalues", "a domain whose modes have eigenvalues", given));
        }
        let along = model.horizontal_direction(options.direction);
        let wind =
            Wind { seed: options.seed, along, across: model.up.cross(&along), delay_per_length: 0.25 / model.height() };
        let modes = oscillators(&model, options.dt)?;
        let loads = model.parts.iter().map(|part| load(&model, part, &wind)).collect();
        let mut sway = Self {
            wind,
            options,
            modes,
            loads,
            gains: vec![1.0; model.parts.len()],
            states: vec![State::default(); model.coordinates],
            forces: vec![0.0; model.coordinates],
            next: 0,
            crown: crown(&model),
            gauge: JointGapMeter::new(&model),
            calibrated_sway: 0.0,
            sway: 0.0,
            peak: 0.0,
            gap: 0.0,
            model,
        };
        sway.calibrate();
        Ok(sway)
    }

    /// Advances every mode by one step at unit strength.
    fn advance(&mut self) {
        let after = self.force(self.options.dt * (self.next + 1) as f64);
        for (index, state) in self.states.iter_mut().enumerate() {
            *state = self.modes[index].advance(*state, self.forces[index], after[index]);
        }
        self.forces = after;
        self.next += 1;
    }

    /// Generalized forces at a time in seconds. Children follow their parents, so the reverse order accumulates the
    /// forces of all descendants.
    fn force(&self, time: f64) -> Vec<f64> {
        let mut force = vec![0.0; self.model.coordinates];
        let mut pull = vec![Vector3::zeros(); self.model.parts.len()];
        for (index, part) in self.model.parts.iter().enumerate().rev() {
            let load = &self.loads[index];
            let (along, across) = self.wind.pressure(time, index, load.distance);
            for mode in 0..part.rank {
                force[part.first + mode] += along * load.along[mode] + across * load.across[mode];
            }
            pull[index] += (self.wind.along * along + self.wind.across * across) * part.area;
            let Some(joint) = &part.joint else { continue };
            let (parent, down) = (&self.model.parts[joint.parent], pull[index]);
            for (component, row) in load.joint_modes.chunks_exact(parent.rank.max(1)).enumerate() {
                for (mode, entry) in row.iter().enumerate() {
                    force[parent.first + mode] += entry * down[component];
                }
            }
            pull[joint.parent] += down;
        }
        force
    }

    /// Coordinates: the response to unit wind times the gain of each part, rounded to f32.
    fn coordinates(&self, states: &[f64], gains: &[f64]) -> Vec<f64> {
        let mut q = vec![0.0; self.model.coordinates];
        for (part, gain) in self.model.parts.iter().zip(gains) {
            for at in part.first..part.first + part.rank {
                q[at] = f64::from((states[at] * gain) as f32);
            }
        }
        q
    }

    /// Runs at unit strength, sets the gains from the response, and resets the state.
    fn calibrate(&mut self) {
        let most = (20.0 / self.options.dt).clamp(60.0, 1200.0) as u64;
        let steps = self.options.steps.map_or(most, |steps| steps.saturating_sub(1).clamp(1, most));
        // Limit the stored states of this run to 64 MiB.
        let stride = (steps * self.model.coordinates as u64 * 8).div_ceil(64 << 20).max(1);
        let mut bending = vec![0.0_f64; self.model.parts.len()];
        let mut rehearsed = vec![];
        for step in 0..steps {
            self.advance();
            let q: Vec<f64> = self.states.iter().map(|state| state.q).collect();
            let own: Vec<f64> = self.model.parts.iter().map(|part| elastic_displacement(part, part.q(&q))).collect();
            let trunk: f64 =
                self.model.parts.iter().zip(&own).filter(|(part, _)| part.joint.is_none()).map(|(_, own)| own).sum();
            bending.iter_mut().zip(own).for_each(|(most, now)| *most = most.max(now));
            if step % stride == 0 {
                rehearsed.push((trunk, q));
            }
        }
        rehearsed.sort_by(|a, b| b.0.total_cmp(&a.0));
        rehearsed.truncate(24);
        let states: Vec<Vec<f64>> = rehearsed.into_iter().map(|(_, q)| q).collect();
        (self.gains, self.calibrated_sway) = self.find_gains(&bending, &states);
        self.states.fill(State::default());
        self.forces.fill(0.0);
        self.next = 0;
    }

    /// The gains with which the crown peaks at the requested share of the height, or the largest that the limits allow,
    /// and the share that they reach.
    fn find_gains(&self, bending: &[f64], states: &[Vec<f64>]) -> (Vec<f64>, f64) {
        let gains = |strength: f64| -> Vec<f64> { self.limit_gains(strength, bending) };
        let reached = |strength: f64| {
            let gains = gains(strength);
            let of = |q: &Vec<f64>| self.crown_at(&self.coordinates(q, &gains));
            states.iter().map(of).fold(0.0, f64::max)
        };
        let wanted = self.options.sway * self.options.wind;
        let mut high = self.max_strength(bending);
        let asked = wanted > 0.0 && high > 0.0;
        if !asked {
            return (vec![0.0; bending.len()], 0.0);
        }
        if reached(high) > wanted {
            let mut low = 0.0;
            for _ in 0..24 {
                let middle = 0.5 * (low + high);
                if reached(middle) > wanted { high = middle } else { low = middle }
            }
        }
        (gains(high), reached(high))
    }

    /// The gain of each part: `strength`, reduced for branches that would exceed their bending limit.
    fn limit_gains(&self, strength: f64, bending: &[f64]) -> Vec<f64> {
        let limit = |(part, bending): (&DomainModel, &f64)| match (&part.joint, *bending > 0.0) {
            (Some(_), true) => strength.min(self.share(MAX_BRANCH_BENDING) * part.extent / bending),
            _ => strength,
        };
        self.model.parts.iter().zip(bending).map(limit).collect()
    }

    /// The strength at which the trunk reaches its bending limit; without a deforming trunk, the strength at which all
    /// branches have reached theirs.
    fn max_strength(&self, bending: &[f64]) -> f64 {
        let parts = || self.model.parts.iter().zip(bending).filter(|(_, bending)| **bending > 0.0);
        let roots = parts().filter(|(part, _)| part.joint.is_none());
        let strength =
            roots.map(|(part, bending)| self.share(MAX_TRUNK_BENDING) * part.extent / bending).fold(f64::MAX, f64::min);
        if strength < f64::MAX {
            return strength;
        }
        parts().map(|(part, bending)| self.share(MAX_BRANCH_BENDING) * part.extent / bending).fold(0.0, f64::max)
    }

    /// A bending limit scaled by the wind. The scale is at most 2.5, because linear modes do not represent larger
    /// bending.
    fn share(&self, limit: f64) -> f64 {
        limit * self.options.wind.clamp(0.0, 2.5)
    }

    /// The mean displacement of the crown as a share of the height.
    fn crown_at(&self, q: &[f64]) -> f64 {
        self.crown_in(q, &transforms(&self.model, q, &[]))
    }

    fn crown_in(&self, q: &[f64], world: &[Affine]) -> f64 {
        let moved = |(index, place): &(usize, usize)| {
            let (part, pose) = (&self.model.parts[*index], &world[*index]);
            let sample = &part.samples[*place];
            pose.apply(&sample.deformed_position(part.q(q))) - part.placement.apply(&sample.rest)
        };
        let sum: Vector3<f64> = self.crown.iter().map(moved).sum();
        sum.norm() / (self.crown.len().max(1) as f64 * self.model.height())
    }

    /// Small rotations of rigid leaves about their bases, at a time in seconds.
    fn flutter(&self, time: f64) -> Vec<Option<Affine>> {
        let mut carries = vec![false; self.model.parts.len()];
        self.model.parts.iter().filter_map(|part| part.joint.as_ref()).for_each(|joint| carries[joint.parent] = true);
        let strength = FLUTTER_ANGLE * self.options.wind.clamp(0.0, 2.0);
        let turn = |(index, part): (usize, &DomainModel)| {
            let leaf = part.rank == 0 && part.joint.is_some() && !carries[index] && strength > 0.0;
            leaf.then(|| {
                let (push, _) = self.wind.pressure(time, index, self.loads[index].distance);
                let axis = part.placement.linear.transpose() * self.wind.across;
                let angle = strength * (0.5 * push + 0.5 * push.abs() * self.wind.turbulence(time, index, 1));
                Affine::rotation_about(&axis, angle, &Vector3::zeros())
            })
        };
        self.model.parts.iter().enumerate().map(turn).collect()
    }
}

impl Scenario for TreeScenario {
    fn model(&self) -> &Model {
        &self.model
    }

    fn next_motion(&mut self, motion: &mut Motion) -> Result<()> {
        let states: Vec<f64> = self.states.iter().map(|state| state.q).collect();
        let q = self.coordinates(&states, &self.gains);
        let world = transforms(&self.model, &q, &self.flutter(self.options.dt * self.next as f64));
        if !q.iter().all(|number| number.is_finite()) {
            return Err(invalid("q", "finite numbers", "an overflow of the motion"));
        }
        motion.q = q.iter().map(|number| *number as f32).collect();
        motion.transforms = world.iter().map(Affine::entries).collect();
        // Measure the reported values on the transforms as sent, rounded to f32.
        let sent: Vec<Affine> = motion.transforms.iter().map(Affine::from_entries).collect();
        self.sway = self.sway.max(self.crown_in(&q, &sent));
        self.peak = self.peak.max(self.model.peak(&q, &sent));
        self.gap = self.gap.max(self.gauge.gap(&self.model, &q, &sent));
        self.advance();
        Ok(())
    }

    fn report(&self) -> ScenarioReport {
        let wind = self.options.wind;
        let load = format!(
            "wind {wind} on all surfaces, calibrated to a crown sway of {:.3} of the height in a rehearsal; branches bend \
             by at most {:.3} of their extent",
            self.calibrated_sway,
            self.share(MAX_BRANCH_BENDING),
        );
        ScenarioReport::from_iter([
            ("load".to_owned(), json!(load)),
            ("crown_sway_of_height".to_owned(), json!(self.sway)),
            ("peak_of_height".to_owned(), json!(self.peak / self.model.height())),
            ("peak_of_diagonal".to_owned(), json!(self.peak / self.model.diagonal())),
            ("joint_gap_max".to_owned(), json!(self.gap)),
            ("joint_gap_of_diagonal".to_owned(), json!(self.gap / self.model.diagonal())),
        ])
    }
}

/// One oscillator per coordinate. Modes without stiffness would drift in any wind, so they are held.
fn oscillators(model: &Model, dt: f64) -> Result<Vec<Oscillator>> {
    let mut modes = vec![Oscillator::new_fixed(); model.coordinates];
    for part in model.parts.iter().filter(|part| part.owns_q) {
        let damping = part.note("damping_ratio").unwrap_or(DEFAULT_DAMPING_RATIO);
        for (mode, eigenvalue) in part.eigenvalues.iter().enumerate().filter(|(_, value)| **value > 0.0) {
            modes[part.first + mode] = Oscillator::new(*eigenvalue, damping, dt)?;
        }
    }
    Ok(modes)
}

fn load(model: &Model, part: &DomainModel, wind: &Wind) -> WindLoad {
    let surface_samples = &part.samples[..part.surface_samples];
    let share = part.area / surface_samples.len().max(1) as f64;
    let push = |direction: &Vector3<f64>| {
        let local = part.placement.linear.transpose() * direction;
        let of =
            |mode| surface_samples.iter().map(|sample| sample.column(mode, part.rank).dot(&local)).sum::<f64>() * share;
        (0..part.rank).map(of).collect::<Vec<f64>>()
    };
    let center =
        surface_samples.iter().map(|sample| sample.rest).sum::<Vector3<f64>>() / surface_samples.len().max(1) as f64;
    let distance = (part.placement.apply(&center) - model.low).dot(&wind.along);
    let joint_modes = part.joint.as_ref().map_or(vec![], |joint| {
        let parent = &model.parts[joint.parent];
        let ring = joint.ring.iter().map(|place| &parent.samples[*place]);
        let (count, turn) = (joint.ring.len().max(1) as f64, parent.placement.linear);
        let mean =
            |mode: usize| ring.clone().map(|sample| sample.column(mode, parent.rank)).sum::<Vector3<f64>>() / count;
        let columns: Vec<Vector3<f64>> = (0..parent.rank).map(|mode| turn * mean(mode)).collect();
        (0..3).flat_map(|component| columns.iter().map(move |column| column[component])).collect()
    });
    WindLoad { along: push(&wind.along), across: push(&wind.across), joint_modes, distance }
}

/// The largest elastic displacement of a part's evenly spread samples, in scene units.
fn elastic_displacement(part: &DomainModel, q: &[f64]) -> f64 {
    part.samples[..part.surface_samples].iter().map(|sample| sample.displacement(q).norm()).fold(0.0, f64::max)
}

/// Per part the highest of its evenly spread samples, if it is in the top quarter of the scene.
fn crown(model: &Model) -> Vec<(usize, usize)> {
    let level = model.low.dot(&model.up) + 0.75 * model.height();
    let highest = |(index, part): (usize, &DomainModel)| {
        let height = |place: &usize| part.placement.apply(&part.samples[*place].rest).dot(&model.up);
        let place = (0..part.surface_samples).max_by(|a, b| height(a).total_cmp(&height(b)))?;
        (height(&place) >= level).then_some((index, place))
    };
    model.parts.iter().enumerate().filter_map(highest).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::hierarchy::tests::plant;

    fn blown(options: Options) -> (TreeScenario, Vec<Motion>) {
        let mut sway = TreeScenario::new(plant(), options).expect("valid");
        let motion = |_| {
            let mut motion = Motion::default();
            sway.next_motion(&mut motion).expect("finite");
            motion
        };
        let motions = (0..options.steps.unwrap_or(60)).map(motion).collect();
        (sway, motions)
    }

    const CALM: Options = Options { dt: 1.0 / 60.0, steps: Some(60), sway: 0.05, wind: 1.0, direction: 0.4, seed: 7 };

    #[test]
    fn crown_sways_as_calibrated_and_joints_stay_closed() {
        for (dt, steps) in [(1.0 / 60.0, 60), (1.0 / 60.0, 600), (1.0 / 30.0, 90), (0.5, 40)] {
            let (sway, motions) = blown(Options { dt, steps: Some(steps), ..CALM });
            assert!((0.03..=0.08).contains(&sway.sway), "dt {dt}, {steps} steps: {}", sway.sway);
            assert!(sway.gap <= 1e-3 * sway.model.diagonal(), "{}", sway.gap);
            assert!(motions[0].q.iter().all(|number| *number == 0.0));
            assert_eq!(motions[9].transforms.len(), 4);
        }
    }

    #[test]
    fn without_wind_nothing_moves_and_more_wind_moves_more() {
        let (still, _) = blown(Options { wind: 0.0, ..CALM });
        assert!(still.peak <= 1e-6, "{}", still.peak);
        let (half, _) = blown(Options { wind: 0.5, ..CALM });
        let (full, _) = blown(CALM);
        assert!(half.sway < 0.7 * full.sway && half.sway > 0.01, "{} {}", half.sway, full.sway);
    }

    #[test]
    fn stays_bounded_far_beyond_the_explicit_step_limit() {
        let mut model = plant();
        let square = |hertz: f64| (2.0 * std::f64::consts::PI * hertz).powi(2);
        for (part, hertz) in model.parts.iter_mut().zip([[0.1, 1.0], [30.0, 1e3], [1e4, 1e5], [0.0, 0.0]]) {
            part.eigenvalues = if part.rank > 0 { hertz.map(square).to_vec() } else { vec![] };
        }
        for dt in [1.0 / 60.0, 1.0, 10.0] {
            let options = Options { dt, steps: Some(400), ..CALM };
            let mut sway = TreeScenario::new(model.clone(), options).expect("valid");
            let mut motion = Motion::default();
            for _ in 0..400 {
                sway.next_motion(&mut motion).expect("finite");
            }
            assert!(sway.peak <= 0.5 * sway.model.diagonal() && sway.sway > 0.0, "dt {dt}: {}", sway.peak);
        }
    }

    #[test]
    fn the_same_seed_gives_the_same_motion() {
        let (first, second) = (blown(CALM).1, blown(CALM).1);
        let other = blown(Options { seed: 8, ..CALM }).1;
        assert!(first == second && first != other);
    }
}
