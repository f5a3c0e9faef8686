//! The largest displacement of a scene's samples over a run. A bound per domain decides whether its samples are visited,
//! because after the first gusts few domains move farther than before.

use nalgebra::Vector3;
use rayon::prelude::*;

use crate::affine::AffineTransform;
use crate::model::{DomainModel, MIN_DOMAINS_PER_THREAD, Model, Sample};

/// Bounds are larger by this fraction, which exceeds their rounding errors.
const ROUNDING: f64 = 1e-9;

/// Measures displacements from rest.
#[derive(Debug, Clone)]
pub struct DisplacementMeter {
    /// Per domain.
    spheres: Vec<SampleSphere>,
    /// Per domain and mode: the largest displacement of a surface sample per unit of the coordinate, in the frame of the
    /// domain.
    displacements_per_unit: Vec<f64>,
}

/// A sphere around the surface samples of a domain at rest, in the frame of the domain.
#[derive(Debug, Clone)]
struct SampleSphere {
    center: Vector3<f64>,
    radius: f64,
    /// Index of the domain's first entry in `displacements_per_unit`.
    first_mode: usize,
}

impl DisplacementMeter {
    /// Computes the bounds of all domains.
    pub fn new(model: &Model) -> Self {
        let mut displacements_per_unit = vec![];
        let mut sphere =
            |domain: &DomainModel| {
                let first_mode = displacements_per_unit.len();
                let samples = domain.surface_samples();
                displacements_per_unit.extend((0..domain.rank).map(|mode| {
                    samples.iter().map(|sample| sample.column(mode, domain.rank).norm()).fold(0.0, f64::max)
                }));
                let sum: Vector3<f64> = samples.iter().map(|sample| sample.rest_position).sum();
                let center = sum / samples.len().max(1) as f64;
                let distances = samples.iter().map(|sample| (sample.rest_position - center).norm());
                SampleSphere { center, radius: distances.fold(0.0, f64::max), first_mode }
            };
        let spheres = model.domains.iter().map(&mut sphere).collect();
        Self { spheres, displacements_per_unit }
    }

    /// The largest displacement from rest of a domain's origin or of a surface sample, in scene units, or `floor` if it
    /// is larger. `world_from_domain` has one transform per domain.
    pub fn max_displacement(&self, model: &Model, q: &[f64], world_from_domain: &[AffineTransform], floor: f64) -> f64 {
        let domains = (0..model.domains.len()).into_par_iter().with_min_len(MIN_DOMAINS_PER_THREAD);
        let add_domain = |largest: f64, index: usize| {
            let (domain, transform) = (&model.domains[index], &world_from_domain[index]);
            let origin_displacement = (transform.translation - domain.placement.translation).norm();
            let largest = largest.max(origin_displacement);
            if self.bound(index, domain, domain.q(q), transform) <= largest {
                return largest;
            }
            let displacement = |sample: &Sample| {
                let current = transform.apply(&sample.deformed_position(domain.q(q)));
                (current - domain.placement.apply(&sample.rest_position)).norm()
            };
            domain.surface_samples().iter().map(displacement).fold(largest, f64::max)
        };
        domains.fold(|| floor, add_domain).reduce(|| floor, f64::max)
    }

    /// A bound of the displacements of the domain's surface samples: that of a rigid motion of their sphere, and the sum
    /// over all modes. Infinite or not a number if the motion is.
    fn bound(&self, index: usize, domain: &DomainModel, q: &[f64], transform: &AffineTransform) -> f64 {
        let SampleSphere { center, radius, first_mode } = &self.spheres[index];
        let displacements_per_unit = &self.displacements_per_unit[*first_mode..];
        let elastic: f64 = q.iter().zip(displacements_per_unit).map(|(q, per_unit)| q.abs() * per_unit).sum();
        let center_displacement = (transform.apply(center) - domain.placement.apply(center)).norm();
        // The Frobenius norm of a matrix is at least its largest stretch.
        let rotation = (transform.linear - domain.placement.linear).norm() * radius;
        (1.0 + ROUNDING) * (center_displacement + rotation + transform.linear.norm() * elastic)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::coupled::testing::{Random, random_plant};
    use crate::hierarchy::compute_transforms;

    #[test]
    fn largest_displacement_is_that_of_all_samples() {
        for seed in 0..20 {
            let model = random_plant(30, seed);
            let meter = DisplacementMeter::new(&model);
            let mut random = Random::new(seed);
            let mut floor = 0.0;
            // Smaller and larger motions than before.
            for amplitude in [1e-6, 1e-2, 1e-3, 0.1, 0.1, 2.0] {
                let q: Vec<f64> = (0..model.coordinate_count).map(|_| amplitude * random.next()).collect();
                let transforms = compute_transforms(&model, &q, &[]);
                let expected = model.max_displacement(&q, &transforms);
                assert_eq!(meter.max_displacement(&model, &q, &transforms, 0.0), expected, "{seed} {amplitude}");
                assert_eq!(meter.max_displacement(&model, &q, &transforms, floor), expected.max(floor));
                floor = expected.max(floor);
            }
        }
    }

    /// Most domains of a motion far below the floor are not visited: their samples could be anywhere.
    #[test]
    fn samples_of_small_motions_are_not_visited() {
        let model = random_plant(30, 3);
        let meter = DisplacementMeter::new(&model);
        let q = vec![1e-3; model.coordinate_count];
        let transforms = compute_transforms(&model, &q, &[]);
        let largest = model.max_displacement(&q, &transforms);
        let mut moved = model;
        moved.domains.iter_mut().flat_map(|domain| &mut domain.samples).for_each(|sample| sample.mode_rows.fill(1e9));
        assert_eq!(meter.max_displacement(&moved, &q, &transforms, 10.0 * largest), 10.0 * largest);
        assert!(meter.max_displacement(&moved, &q, &transforms, 0.0) > 1e3 * largest, "control");
    }
}
