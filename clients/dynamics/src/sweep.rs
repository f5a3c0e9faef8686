//! Kinematic motion for scenes without known physics. In every domain, one mode after another performs one period of a
//! sine. At its peak, the most displaced sample moves by a given fraction of the diagonal of the scene's rest bounds. A
//! scene without coordinates rocks about the center of its base.

use std::f64::consts::TAU;

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use crate::affine::AffineTransform;
use crate::checkpoint::RunIdentity;
use crate::error::Result;
use crate::model::Model;
use crate::run::{Report, Scenario, aliasing_remark};
use crate::saved_state::{from_json, number_bits, to_json};
use crate::step_values::StepValues;

/// Amplitude of a rocking scene, in radians.
const ROCKING_ANGLE: f64 = 0.05;

/// Period of a rocking scene, in seconds.
const ROCKING_PERIOD: f64 = 2.0;

/// Settings of the sweep scenario.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SweepOptions {
    /// Seconds per step.
    pub dt: f64,
    /// Number of steps; `None` for an unlimited run.
    pub steps: Option<u64>,
    /// The largest displacement as a fraction of the diagonal of the scene's rest bounds.
    pub displacement_fraction: f64,
}

/// The sweep scenario.
pub struct SweepScenario {
    model: Model,
    options: SweepOptions,
    /// Duration of the sine of each coordinate, in steps.
    steps_per_coordinate: u64,
    /// Per coordinate: the value at which the largest displacement is `displacement_fraction`.
    amplitudes: Vec<f64>,
    /// The step that the next call of `compute_next_step` computes.
    next_step: u64,
    /// Largest displacement so far, in scene units.
    peak_displacement: f64,
}

impl SweepScenario {
    /// Computes the amplitudes.
    pub fn new(model: Model, options: SweepOptions) -> Self {
        let target_displacement = options.displacement_fraction * model.diagonal();
        // Per coordinate: the maximum over all domains that share the coordinate.
        let mut displacements_per_unit = vec![0.0_f64; model.coordinate_count];
        for domain in &model.domains {
            let displacements = &mut displacements_per_unit[domain.first_coordinate..][..domain.rank];
            for (mode, displacement) in displacements.iter_mut().enumerate() {
                *displacement = displacement.max(domain.displacement_per_unit(mode));
            }
        }
        let amplitude = |displacement: f64| if displacement > 0.0 { target_displacement / displacement } else { 0.0 };
        let amplitudes = displacements_per_unit.into_iter().map(amplitude).collect();
        // A run of known length gives each mode the same number of steps, but at most one second. In an unlimited run,
        // each mode takes one second.
        let max_rank = model.domains.iter().map(|domain| domain.rank as u64).max().unwrap_or(0).max(1);
        let steps_per_second = (1.0 / options.dt).clamp(1.0, 1e6) as u64;
        let steps_per_coordinate = options.steps.map_or(steps_per_second, |steps| steps / max_rank);
        let steps_per_coordinate = steps_per_coordinate.clamp(1, steps_per_second.max(1));
        Self { model, options, steps_per_coordinate, amplitudes, next_step: 0, peak_displacement: 0.0 }
    }

    /// The sine of a coordinate at `coordinate_step` (0 to `steps_per_coordinate` - 1), divided by its largest value at
    /// any step. The sine is evaluated in the middle of each step. With one step per coordinate, the sine is 0 in the
    /// middle of that step, and the result is 1 by definition.
    fn normalized_sine(&self, coordinate_step: u64) -> f64 {
        let sine_at = |step: u64| (TAU * (step as f64 + 0.5) / self.steps_per_coordinate as f64).sin();
        let max_sine = (0..self.steps_per_coordinate).map(sine_at).fold(0.0, f64::max);
        if max_sine > 1e-6 { sine_at(coordinate_step) / max_sine } else { 1.0 }
    }

    /// The coordinates of the scene at a step. All domains move at the same time; a domain with fewer modes than others
    /// starts again with its first one.
    fn compute_coordinates(&self, step: u64) -> Vec<f32> {
        let mode = step / self.steps_per_coordinate;
        let sine = self.normalized_sine(step % self.steps_per_coordinate);
        let mut q = vec![0.0; self.model.coordinate_count];
        for domain in self.model.domains.iter().filter(|domain| domain.owns_q && domain.rank > 0) {
            let coordinate = domain.first_coordinate + (mode % domain.rank as u64) as usize;
            q[coordinate] = (self.amplitudes[coordinate] * sine) as f32;
        }
        q
    }

    /// The rigid transform of the whole scene. It is the identity if the scene has coordinates.
    fn rocking_transform(&self, time: f64) -> AffineTransform {
        if self.model.coordinate_count > 0 {
            return AffineTransform::identity();
        }
        let model = &self.model;
        let center = 0.5 * (model.bounds_min + model.bounds_max);
        let extent = (model.bounds_max - model.bounds_min).dot(&model.up);
        let base: Vector3<f64> = center - model.up * (0.5 * extent);
        let angle = ROCKING_ANGLE * (TAU * time / ROCKING_PERIOD).sin();
        AffineTransform::rotation_about(&model.ground_axes().short_axis, angle, &base)
    }
}

/// The state of a sweep in a checkpoint. The motion is a function of the step.
#[derive(Serialize, Deserialize)]
struct SavedSweep {
    #[serde(with = "number_bits")]
    peak_displacement: f64,
}

impl Scenario for SweepScenario {
    fn model(&self) -> &Model {
        &self.model
    }

    fn identity(&self) -> RunIdentity {
        RunIdentity::default()
            .with("motion", "sweep")
            .with_number("--share", self.options.displacement_fraction)
            .with("steps per mode (by --seconds or --steps)", self.steps_per_coordinate)
    }

    fn save(&self) -> Result<Value> {
        to_json(&SavedSweep { peak_displacement: self.peak_displacement })
    }

    fn restore(&mut self, next_step: u64, state: Value) -> Result<()> {
        let SavedSweep { peak_displacement } = from_json(state)?;
        (self.next_step, self.peak_displacement) = (next_step, peak_displacement);
        Ok(())
    }

    fn compute_next_step(&mut self, values: &mut StepValues) -> Result<()> {
        let rocking = self.rocking_transform(self.next_step as f64 * self.options.dt);
        values.q = self.compute_coordinates(self.next_step);
        let domains = self.model.domains.iter();
        values.transforms = domains.map(|domain| rocking.compose(&domain.placement).to_row_major()).collect();
        let q: Vec<f64> = values.q.iter().map(|coordinate| f64::from(*coordinate)).collect();
        let world_from_domain: Vec<AffineTransform> =
            values.transforms.iter().map(AffineTransform::from_row_major).collect();
        self.peak_displacement = self.peak_displacement.max(self.model.max_displacement(&q, &world_from_domain));
        self.next_step += 1;
        Ok(())
    }

    fn remarks(&self) -> Vec<String> {
        let rocks = self.model.coordinate_count == 0;
        rocks.then(|| aliasing_remark("the rocking", ROCKING_PERIOD, self.options.dt)).flatten().into_iter().collect()
    }

    fn report(&self) -> Report {
        let motion_description = match self.model.coordinate_count {
            0 => format!(
                "no coordinates: the scene rocks by {ROCKING_ANGLE} rad about its base every {ROCKING_PERIOD} s"
            ),
            _ => format!(
                "in every domain one mode after another as a sine, {} of the diagonal at its peak",
                self.options.displacement_fraction
            ),
        };
        let peak_displacement_fraction = self.peak_displacement / self.model.diagonal();
        Report::from_iter([
            ("load".to_owned(), json!(motion_description)),
            ("peak_of_diagonal".to_owned(), json!(peak_displacement_fraction)),
        ])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::hierarchy::tests::four_domain_model;

    fn peak_displacement_fraction(sweep: &SweepScenario) -> f64 {
        sweep.peak_displacement / sweep.model.diagonal()
    }

    #[test]
    fn every_coordinate_reaches_its_amplitude() {
        let options = SweepOptions { dt: 1.0 / 60.0, steps: Some(60), displacement_fraction: 0.06 };
        let mut sweep = SweepScenario::new(four_domain_model(), options);
        let mut peaks = [0.0_f32; 6];
        for _ in 0..60 {
            let mut values = StepValues::default();
            sweep.compute_next_step(&mut values).expect("the next step");
            peaks.iter_mut().zip(values.q).for_each(|(peak, coordinate)| *peak = peak.max(coordinate));
        }
        for (peak, amplitude) in peaks.iter().zip(&sweep.amplitudes) {
            assert!((f64::from(*peak) / amplitude - 1.0).abs() <= 1e-6, "expected {amplitude}, got {peak}");
        }
        let fraction = peak_displacement_fraction(&sweep);
        assert!((fraction - 0.06).abs() <= 1e-6, "{fraction}");
    }

    #[test]
    fn single_step_reaches_the_full_displacement() {
        let options = SweepOptions { dt: 1.0, steps: Some(1), displacement_fraction: 0.06 };
        let mut sweep = SweepScenario::new(four_domain_model(), options);
        sweep.compute_next_step(&mut StepValues::default()).expect("the first step");
        let fraction = peak_displacement_fraction(&sweep);
        assert!((fraction - 0.06).abs() <= 1e-6, "{fraction}");
    }

    #[test]
    fn rigid_scene_rocks_about_its_base() {
        let mut model = four_domain_model();
        model.domains.iter_mut().for_each(|domain| (domain.rank, domain.first_coordinate) = (0, 0));
        model.coordinate_count = 0;
        let options = SweepOptions { dt: 0.5, steps: None, displacement_fraction: 0.06 };
        let mut sweep = SweepScenario::new(model, options);
        let mut values = StepValues::default();
        // The second step is at 0.5 s: a quarter of the period, where the angle is largest.
        (0..2).for_each(|_| sweep.compute_next_step(&mut values).expect("the next step"));
        let first_transform = AffineTransform::from_row_major(&values.transforms[0]);
        let model = &sweep.model;
        let base = 0.5 * (model.bounds_min + model.bounds_max) - model.up * (0.5 * model.height());
        assert!((first_transform.apply(&base) - base).norm() <= 1e-6);
        assert!(peak_displacement_fraction(&sweep) > 0.01);
    }
}
