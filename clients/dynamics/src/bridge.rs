//! A span under a pulsating load: reduced StVK forces, integrated by implicit Newmark.
//!
//! The load acts on the middle of the span and is spread evenly over the samples there. Its strength is calibrated so
//! that the deflection at equilibrium is a given share of the diagonal. The run starts at that equilibrium, and the
//! load then pulsates as (1 + cos) / 2.

use std::f64::consts::TAU;

use nalgebra::{DVector, Vector3};
use serde_json::json;

use crate::affine::Affine;
use crate::cubic::ReducedForce;
use crate::error::{Result, invalid};
use crate::model::{DomainModel, Model};
use crate::newmark::{LoadChange, NewmarkState, ReducedSystem};
use crate::run::{Motion, Scenario, ScenarioReport};
use crate::vega::VegaSettings;

/// Settings of the load.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Options {
    /// Seconds per step.
    pub dt: f64,
    /// Deflection at equilibrium as a share of the diagonal.
    pub deflection: f64,
    /// Period of the load in seconds.
    pub period: f64,
    pub load_direction: LoadDirection,
}

/// Direction of the load.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LoadDirection {
    /// Like a wind: across the span, with an upward component of 0.3 times the horizontal one.
    Across,
    /// Like a weight. A span close to the ground then moves below the ground plane of a picture.
    Down,
    Up,
}

/// The bridge scenario.
pub struct Bridge {
    model: Model,
    system: ReducedSystem,
    options: Options,
    /// Index of the deforming part.
    part: usize,
    /// The full reduced load.
    load: DVector<f64>,
    /// The state at step `next`, the step of the next motion.
    motion: NewmarkState,
    next: u64,
    strength: f64,
    static_deflection: f64,
    peak: f64,
}

impl Bridge {
    /// Calibrates the load for the span.
    ///
    /// # Errors
    /// `Invalid` if no part has the rank of the forces, the stiffness is not positive definite, or the load cannot
    /// deform the part.
    pub fn new(model: Model, force: ReducedForce, settings: &VegaSettings, options: Options) -> Result<Self> {
        let rank = force.rank();
        let part = model.parts.iter().position(|part| part.owns_q && part.rank == rank);
        let ranks = || format!("{:?}", model.parts.iter().map(|part| part.rank).collect::<Vec<_>>());
        let part = part.ok_or_else(|| invalid("scene", format!("a domain of rank {rank}"), ranks()))?;
        let system = ReducedSystem::new(force, settings)?;
        let direction = pull(&model, &model.parts[part], options.load_direction)?;
        let wanted = options.deflection * model.diagonal();
        let (strength, q) = calibrate(&system, &model.parts[part], &direction, wanted)?;
        let load = direction * strength;
        let static_deflection = deflection(&model.parts[part], &q) / model.diagonal();
        let motion = system.static_state(q);
        Ok(Self { model, system, options, part, load, motion, next: 0, strength, static_deflection, peak: 0.0 })
    }

    /// Integrates the state to the next step.
    fn advance(&mut self) {
        let (before, after) = (self.load(self.next), self.load(self.next + 1));
        let load = LoadChange { before: &before, after: &after };
        self.motion = self.system.step(&self.motion, self.options.dt, load);
        self.next += 1;
    }

    /// The reduced load at a step.
    fn load(&self, step: u64) -> DVector<f64> {
        let time = step as f64 * self.options.dt;
        &self.load * (0.5 + 0.5 * (TAU * time / self.options.period).cos())
    }
}

impl Scenario for Bridge {
    fn model(&self) -> &Model {
        &self.model
    }

    fn next_motion(&mut self, motion: &mut Motion) -> Result<()> {
        let part = &self.model.parts[self.part];
        motion.q = vec![0.0; self.model.coordinates];
        for (place, number) in motion.q[part.first..].iter_mut().zip(self.motion.q.iter()) {
            *place = *number as f32;
        }
        motion.transforms = self.model.parts.iter().map(|part| part.placement.entries()).collect();
        let q: Vec<f64> = motion.q.iter().map(|number| f64::from(*number)).collect();
        let world: Vec<Affine> = motion.transforms.iter().map(Affine::from_entries).collect();
        self.peak = self.peak.max(self.model.peak(&q, &world));
        self.advance();
        Ok(())
    }

    fn report(&self) -> ScenarioReport {
        let load = format!(
            "a force of {:.4} (reduced mass 1) on the middle tenth of the span, {}, pulsating every {} s; it holds the \
             span at {:.4} of the diagonal, where the run begins",
            self.strength,
            self.options.load_direction.words(),
            self.options.period,
            self.static_deflection,
        );
        ScenarioReport::from_iter([
            ("load".to_owned(), json!(load)),
            ("deflection_of_diagonal".to_owned(), json!(self.static_deflection)),
            ("peak_of_diagonal".to_owned(), json!(self.peak / self.model.diagonal())),
            ("frequencies_hz".to_owned(), json!(self.system.frequencies())),
        ])
    }
}

impl LoadDirection {
    const fn words(self) -> &'static str {
        match self {
            Self::Across => "across it with a lift of 0.3",
            Self::Down => "downwards",
            Self::Up => "upwards",
        }
    }

    fn direction(self, model: &Model) -> Vector3<f64> {
        match self {
            Self::Across => (model.ground_axes().1 + 0.3 * model.up).normalize(),
            Self::Down => -model.up,
            Self::Up => model.up,
        }
    }
}

/// U^T times a unit force, spread over the middle tenth of the longer horizontal axis, or over the whole part if the
/// middle tenth cannot move.
fn pull(model: &Model, part: &DomainModel, load_direction: LoadDirection) -> Result<DVector<f64>> {
    let (axis, _) = model.ground_axes();
    let along = |rest: &Vector3<f64>| part.placement.apply(rest).dot(&axis);
    let places = || part.samples.iter().map(|sample| along(&sample.rest));
    let (low, high) = places().fold((f64::MAX, f64::MIN), |(low, high), at| (low.min(at), high.max(at)));
    let push = part.placement.linear.transpose() * load_direction.direction(model);
    let of = |near: f64| {
        let near = |at: f64| (at - 0.5 * (low + high)).abs() <= near * (high - low);
        let chosen: Vec<_> = part.samples.iter().filter(|sample| near(along(&sample.rest))).collect();
        let sum = |mode| chosen.iter().map(|sample| sample.column(mode, part.rank).dot(&push)).sum::<f64>();
        DVector::from_fn(part.rank, |mode, _| sum(mode) / chosen.len().max(1) as f64)
    };
    let force = Some(of(0.05)).filter(|force| force.norm() > 0.0).unwrap_or_else(|| of(1.0));
    if force.norm() > 0.0 { Ok(force) } else { Err(invalid("scene", "a part that a load can bend", &part.name)) }
}

/// The largest displacement of a part's samples, in scene units.
fn deflection(part: &DomainModel, q: &DVector<f64>) -> f64 {
    part.samples.iter().map(|sample| sample.displacement(q.as_slice()).norm()).fold(0.0, f64::max)
}

/// The strength of a load with the deflection `wanted` at equilibrium, and that equilibrium. The load is increased in
/// steps, each solved from the previous equilibrium, and then bisected.
fn calibrate(
    system: &ReducedSystem,
    part: &DomainModel,
    direction: &DVector<f64>,
    wanted: f64,
) -> Result<(f64, DVector<f64>)> {
    let rest = DVector::zeros(system.rank());
    // The response to a tiny load is linear; extrapolate from it to a tenth of the wanted deflection.
    let tiny = 1e-6 * direction.norm().recip();
    let answer = deflection(part, &system.equilibrium(&(direction * tiny), &rest));
    if !(answer > 0.0 && answer.is_finite()) {
        return Err(invalid("load", "a deflection", answer));
    }
    let (mut low, mut high) = (0.0, 0.1 * wanted / answer * tiny);
    let (mut below, mut above) = (rest.clone(), rest);
    for _ in 0..60 {
        above = system.equilibrium(&(direction * high), &below);
        if deflection(part, &above) >= wanted {
            break;
        }
        (low, below) = (high, above.clone());
        high *= 1.3;
    }
    for _ in 0..40 {
        let middle = 0.5 * (low + high);
        let q = system.equilibrium(&(direction * middle), &below);
        if deflection(part, &q) >= wanted { (high, above) = (middle, q) } else { (low, below) = (middle, q) }
    }
    Ok((high, above))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cubic::tests::chain;
    use crate::hierarchy::tests::plant;

    /// A bridge with a part of two modes and a force of two coordinates.
    fn span(options: Options) -> Bridge {
        Bridge::new(plant(), chain(&[40.0, 90.0], 30.0, 4.0), &VegaSettings::default(), options).expect("valid")
    }

    const OPTIONS: Options =
        Options { dt: 1.0 / 60.0, deflection: 0.03, period: 2.0, load_direction: LoadDirection::Across };

    #[test]
    fn run_starts_at_the_requested_deflection_and_moves() {
        let mut bridge = span(OPTIONS);
        assert!((bridge.static_deflection - 0.03).abs() <= 1e-6, "{}", bridge.static_deflection);
        let (mut first, mut later) = (Motion::default(), Motion::default());
        bridge.next_motion(&mut first).expect("moves");
        assert!(bridge.peak / bridge.model.diagonal() >= 0.0299);
        (0..40).for_each(|_| bridge.next_motion(&mut later).expect("moves"));
        assert!(first.q != later.q && first.transforms == later.transforms);
        assert!(bridge.peak / bridge.model.diagonal() < 0.2);
    }

    #[test]
    fn force_of_another_rank_is_refused_with_the_available_ranks() {
        let force = chain(&[1.0, 2.0, 3.0], 0.0, 0.0);
        let refusal =
            Bridge::new(plant(), force, &VegaSettings::default(), OPTIONS).err().expect("refused").to_string();
        assert!(refusal.contains("rank 3") && refusal.contains("[2, 2, 2, 0]"), "{refusal}");
    }
}
