//! Stops a run before it sends a step that is not finite or far out of range, and names what has diverged.

use nalgebra::Vector3;

use crate::affine::AffineTransform;
use crate::error::{Error, Result};
use crate::model::{DomainModel, Model};
use crate::step_values::StepValues;

/// Largest displacement of a vertex, in diagonals of the scene's rest bounds. Linear modes are inaccurate already at
/// much smaller displacements, and all scenarios stay below one diagonal unless viewers push hard.
const MAX_DISPLACEMENT: f64 = 10.0;

/// Checks the steps of a scene.
pub struct DivergenceCheck {
    /// Per coordinate: the largest displacement of a sample per unit of the coordinate, in diagonals.
    displacements_per_unit: Vec<f64>,
    /// Per domain: the center of the scene's rest bounds, in the frame of the domain. `None` for a singular placement.
    local_centers: Vec<Option<Vector3<f64>>>,
    center: Vector3<f64>,
    diagonal: f64,
}

impl DivergenceCheck {
    /// Creates the check of a scene.
    pub fn new(model: &Model) -> Self {
        let center = 0.5 * (model.bounds_min + model.bounds_max);
        let local_center = |domain: &DomainModel| {
            let AffineTransform { linear, translation } = &domain.placement;
            linear.try_inverse().map(|inverse| inverse * (center - translation))
        };
        let local_centers = model.domains.iter().map(local_center).collect();
        let displacements_per_unit = model.displacements_per_unit();
        Self { displacements_per_unit, local_centers, center, diagonal: model.diagonal() }
    }

    /// Checks the values of a step at `time` seconds.
    ///
    /// # Errors
    /// `Diverged` if a number is not finite, or a displacement exceeds `MAX_DISPLACEMENT`. Two
    /// displacements are compared with it: per domain, the sum of the largest displacements of its modes, and the
    /// distance between the center of the scene and its image under the transform of the domain.
    pub fn check(&self, model: &Model, step: u64, time: f64, values: &StepValues) -> Result<()> {
        let diverged = |subject: String, given: String| {
            let expected = format!("a displacement of at most {MAX_DISPLACEMENT} diagonals of the scene");
            Error::Diverged { step, time, subject, expected, given }
        };
        for (domain, transform) in model.domains.iter().zip(&values.transforms) {
            let range = domain.first_coordinate..domain.first_coordinate + domain.rank;
            let q = &values.q[range.clone()];
            let displacements: Vec<f64> = q
                .iter()
                .zip(&self.displacements_per_unit[range])
                .map(|(q, displacement_per_unit)| f64::from(q.abs()) * displacement_per_unit)
                .collect();
            if let Some(mode) = q.iter().position(|coordinate| !coordinate.is_finite()) {
                return Err(diverged(format!("q[{mode}] of '{}'", domain.name), q[mode].to_string()));
            }
            if displacements.iter().sum::<f64>() > MAX_DISPLACEMENT {
                let largest = (0..domain.rank).max_by(|a, b| displacements[*a].total_cmp(&displacements[*b]));
                let mode = largest.unwrap_or(0);
                let sum: f64 = displacements.iter().sum();
                let given = format!("{sum:.3e} for all modes, {:.3e} for this one, q {}", displacements[mode], q[mode]);
                return Err(diverged(format!("q[{mode}] of '{}'", domain.name), given));
            }
            if let Some(entry) = transform.iter().find(|entry| !entry.is_finite()) {
                return Err(diverged(format!("the transform of '{}'", domain.name), entry.to_string()));
            }
        }
        for ((domain, transform), local_center) in model.domains.iter().zip(&values.transforms).zip(&self.local_centers)
        {
            let Some(local_center) = local_center else { continue };
            let current = AffineTransform::from_row_major(transform).apply(local_center);
            let displacement = (current - self.center).norm() / self.diagonal;
            if displacement > MAX_DISPLACEMENT {
                let given = format!("a displacement of {displacement:.3e} diagonals");
                return Err(diverged(format!("the transform of '{}'", domain.name), given));
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::hierarchy::compute_transforms;
    use crate::hierarchy::tests::four_domain_model;

    fn values(q: [f32; 6]) -> StepValues {
        let model = four_domain_model();
        let wide_q = q.map(f64::from);
        let transforms = compute_transforms(&model, &wide_q, &[]);
        StepValues { q: q.to_vec(), transforms: transforms.iter().map(|transform| transform.to_row_major()).collect() }
    }

    fn check(values: &StepValues) -> Result<()> {
        let model = four_domain_model();
        DivergenceCheck::new(&model).check(&model, 12, 0.25, values)
    }

    #[test]
    fn steps_in_range_pass() {
        for q in [[0.0; 6], [0.1, -0.2, 0.3, 0.0, 0.1, -0.1]] {
            check(&values(q)).expect("a valid step");
        }
    }

    #[test]
    fn divergence_names_the_coordinate_or_transform() {
        for number in [f32::NAN, f32::INFINITY, 1e6, -1e30] {
            let mut diverged = values([0.1; 6]);
            diverged.q[3] = number;
            let error = check(&diverged).expect_err("a diverged coordinate").to_string();
            assert!(error.contains("q[1] of 'beam'") && error.contains("step 12 (0.25 s)"), "{error}");
            let mut diverged = values([0.1; 6]);
            diverged.transforms[3][7] = number;
            let error = check(&diverged).expect_err("a diverged transform").to_string();
            assert!(error.contains("transform of 'beam'"), "{error}");
        }
    }

    /// The origin of a domain may be far from its vertices.
    #[test]
    fn rotation_of_a_domain_with_a_distant_origin_passes() {
        let mut model = four_domain_model();
        let offset = Vector3::new(1e4, 0.0, 0.0);
        (model.bounds_min, model.bounds_max) = (model.bounds_min + offset, model.bounds_max + offset);
        let center = 0.5 * (model.bounds_min + model.bounds_max);
        let rotation = AffineTransform::rotation_about(&Vector3::y(), 0.05, &center);
        let transforms: Vec<_> =
            model.domains.iter().map(|domain| rotation.compose(&domain.placement).to_row_major()).collect();
        // Control: the translation alone would exceed the limit.
        assert!((rotation.translation.norm()) > MAX_DISPLACEMENT * model.diagonal());
        let values = StepValues { q: vec![0.0; 6], transforms };
        DivergenceCheck::new(&model).check(&model, 0, 0.0, &values).expect("a valid step");
    }
}
