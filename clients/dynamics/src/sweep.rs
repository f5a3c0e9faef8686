//! Kinematic motion for scenes without known physics. Each coordinate in turn follows a sine whose crest displaces a
//! sample by a given share of the diagonal. A scene without coordinates rocks about the center of its base.

use std::f64::consts::TAU;

use nalgebra::Vector3;
use serde_json::json;

use crate::affine::Affine;
use crate::error::Result;
use crate::model::{DomainModel, Model};
use crate::run::{Motion, Scenario, ScenarioReport};

/// Amplitude, in radians, and period, in seconds, of a rocking scene.
const ROCKING_ANGLE: f64 = 0.05;
const PERIOD: f64 = 2.0;

/// Settings of the sweep.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Options {
    /// Seconds per step.
    pub dt: f64,
    /// Number of steps; `None` for an unlimited run.
    pub steps: Option<u64>,
    /// The largest displacement as a share of the diagonal.
    pub share: f64,
}

/// The sweep scenario.
pub struct Sweep {
    model: Model,
    options: Options,
    /// Number of steps that each coordinate moves before the next one.
    steps_per_coordinate: u64,
    /// Per coordinate: the value that displaces a sample by the requested share.
    amplitudes: Vec<f64>,
    /// The step of the next motion.
    next: u64,
    peak: f64,
}

impl Sweep {
    /// Computes the amplitudes.
    pub fn new(model: Model, options: Options) -> Self {
        let wanted = options.share * model.diagonal();
        let mut largest = vec![0.0_f64; model.coordinates];
        for part in &model.parts {
            for (mode, largest) in largest[part.first..][..part.rank].iter_mut().enumerate() {
                *largest = largest.max(displacement_per_unit(part, mode));
            }
        }
        let amplitude =
            |displacement_per_unit: f64| if displacement_per_unit > 0.0 { wanted / displacement_per_unit } else { 0.0 };
        let amplitudes = largest.into_iter().map(amplitude).collect();
        let turns = model.parts.iter().map(|part| part.rank as u64).max().unwrap_or(0).max(1);
        let second = (1.0 / options.dt).clamp(1.0, 1e6) as u64;
        let steps_per_coordinate = options.steps.map_or(second, |steps| steps / turns).clamp(1, second.max(1));
        Self { model, options, steps_per_coordinate, amplitudes, next: 0, peak: 0.0 }
    }

    /// The sine at a step within a turn, scaled so that its largest value at a step is 1.
    fn wave(&self, step: u64) -> f64 {
        let at = |step: u64| (TAU * (step as f64 + 0.5) / self.steps_per_coordinate as f64).sin();
        let crest = (0..self.steps_per_coordinate).map(at).fold(0.0, f64::max);
        if crest > 1e-6 { at(step) / crest } else { 1.0 }
    }

    fn coordinates(&self, number: u64) -> Vec<f32> {
        let (turn, wave) = (number / self.steps_per_coordinate, self.wave(number % self.steps_per_coordinate));
        let mut q = vec![0.0; self.model.coordinates];
        for part in self.model.parts.iter().filter(|part| part.owns_q && part.rank > 0) {
            let at = part.first + (turn % part.rank as u64) as usize;
            q[at] = (self.amplitudes[at] * wave) as f32;
        }
        q
    }

    /// The rigid motion of the whole scene; the identity if the scene has coordinates.
    fn rocking(&self, time: f64) -> Affine {
        if self.model.coordinates > 0 {
            return Affine::identity();
        }
        let (model, (_, axis)) = (&self.model, self.model.ground_axes());
        let middle = 0.5 * (model.low + model.high);
        let base: Vector3<f64> = middle - model.up * (0.5 * model.height());
        Affine::rotation_about(&axis, ROCKING_ANGLE * (TAU * time / PERIOD).sin(), &base)
    }
}

impl Scenario for Sweep {
    fn model(&self) -> &Model {
        &self.model
    }

    fn next_motion(&mut self, motion: &mut Motion) -> Result<()> {
        let rocking = self.rocking(self.next as f64 * self.options.dt);
        motion.q = self.coordinates(self.next);
        motion.transforms = self.model.parts.iter().map(|part| rocking.compose(&part.placement).entries()).collect();
        let q: Vec<f64> = motion.q.iter().map(|number| f64::from(*number)).collect();
        let world: Vec<Affine> = motion.transforms.iter().map(Affine::from_entries).collect();
        self.peak = self.peak.max(self.model.peak(&q, &world));
        self.next += 1;
        Ok(())
    }

    fn report(&self) -> ScenarioReport {
        let load = match self.model.coordinates {
            0 => format!("no coordinates: the scene rocks by {ROCKING_ANGLE} rad about its base every {PERIOD} s"),
            _ => format!("every coordinate in turn as a sine, {} of the diagonal at its crest", self.options.share),
        };
        let peak = self.peak / self.model.diagonal();
        ScenarioReport::from_iter([("load".to_owned(), json!(load)), ("peak_of_diagonal".to_owned(), json!(peak))])
    }
}

/// The largest displacement of a sample per unit of a coordinate, in world axes.
fn displacement_per_unit(part: &DomainModel, mode: usize) -> f64 {
    let world = |column: Vector3<f64>| (part.placement.linear * column).norm();
    part.samples.iter().map(|sample| world(sample.column(mode, part.rank))).fold(0.0, f64::max)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::hierarchy::tests::plant;

    #[test]
    fn every_coordinate_reaches_its_amplitude_once_per_round() {
        let options = Options { dt: 1.0 / 60.0, steps: Some(60), share: 0.06 };
        let mut sweep = Sweep::new(plant(), options);
        let mut shown = [0.0_f32; 6];
        for _ in 0..60 {
            let mut motion = Motion::default();
            sweep.next_motion(&mut motion).expect("moves");
            shown.iter_mut().zip(motion.q).for_each(|(most, now)| *most = most.max(now));
        }
        for (most, amplitude) in shown.iter().zip(&sweep.amplitudes) {
            assert!((f64::from(*most) / amplitude - 1.0).abs() <= 1e-6, "{most} of {amplitude}");
        }
        assert!((sweep.peak / sweep.model.diagonal() - 0.06).abs() <= 1e-6, "{}", sweep.peak);
    }

    #[test]
    fn fewer_steps_than_coordinates_still_reach_the_full_share() {
        let mut sweep = Sweep::new(plant(), Options { dt: 1.0, steps: Some(1), share: 0.06 });
        sweep.next_motion(&mut Motion::default()).expect("moves");
        assert!((sweep.peak / sweep.model.diagonal() - 0.06).abs() <= 1e-6, "{}", sweep.peak);
    }

    #[test]
    fn rigid_scene_rocks_about_its_base() {
        let mut model = plant();
        model.parts.iter_mut().for_each(|part| (part.rank, part.first) = (0, 0));
        model.coordinates = 0;
        let mut sweep = Sweep::new(model, Options { dt: 0.5, steps: None, share: 0.06 });
        let mut motion = Motion::default();
        (0..2).for_each(|_| sweep.next_motion(&mut motion).expect("moves"));
        let turned = Affine::from_entries(&motion.transforms[0]);
        let base = 0.5 * (sweep.model.low + sweep.model.high) - sweep.model.up * (0.5 * sweep.model.height());
        assert!((turned.apply(&base) - base).norm() <= 1e-6);
        assert!(sweep.peak > 0.01 * sweep.model.diagonal());
    }
}
