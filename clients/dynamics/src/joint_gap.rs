//! The opening of joints: by how much the distances between a child's base vertex and the attachment vertices of its
//! parent differ from their values at rest. The base vertex is the child's vertex nearest to the child's origin.

use nalgebra::{Matrix3, Vector3};
use rayon::prelude::*;

use crate::affine::AffineTransform;
use crate::attachments::SectionBounds;
use crate::model::{DomainModel, Joint, MIN_DOMAINS_PER_THREAD, Model, Sample};

/// Largest deviation of a placement's entries from those of a rotation for which [`JointBound`] holds.
const ROTATION_TOLERANCE: f64 = 1e-6;

/// Rounding errors of transforms in f32, as a fraction of their entries; several entries are added.
const ROUNDING: f64 = 8.0 * f32::EPSILON as f64;

/// Measures how far joints open.
#[derive(Debug, Clone)]
pub struct JointGapMeter {
    /// Per domain.
    joints: Vec<Option<JointDistances>>,
    /// The largest coordinate of the scene, in scene units.
    extent: f64,
}

/// A joint at rest.
#[derive(Debug, Clone)]
struct JointDistances {
    /// Distances between the base vertex and each attachment vertex of the parent. If the parent has no modes or no
    /// attachment vertices, one distance: between the base vertex and its position according to `parent_from_child`.
    rest_distances: Vec<f64>,
    bound: Option<JointBound>,
}

/// A bound of the opening of a joint. The fitted motion of the attachment vertices is rigid, and would leave all
/// distances as they are; the opening is at most the distance of the attachment vertices from the fitted motion, and the
/// displacement of the base vertex by the modes of the child.
#[derive(Debug, Clone)]
struct JointBound {
    section: SectionBounds,
    /// Inverse of the linear part of `parent_from_child` at rest.
    child_from_parent: Matrix3<f64>,
    /// Per mode of the child: the displacement of its base vertex per unit of the coordinate.
    base_displacements: Vec<f64>,
}

impl JointGapMeter {
    /// Computes the distances at rest, with the placement of each domain.
    pub fn new(model: &Model) -> Self {
        let placements: Vec<_> = model.domains.iter().map(|domain| domain.placement).collect();
        let q = vec![0.0; model.coordinate_count];
        let joint = |(index, domain): (usize, &DomainModel)| {
            let joint = domain.joint.as_ref()?;
            let mut rest_distances = vec![];
            visit_distances(model, index, joint, &q, &placements, |distance| rest_distances.push(distance));
            Some(JointDistances { rest_distances, bound: JointBound::new(model, domain, joint) })
        };
        let joints = model.domains.iter().enumerate().map(joint).collect();
        Self { joints, extent: model.bounds_min.amax().max(model.bounds_max.amax()) }
    }

    /// The largest opening of a joint in scene units, or `floor` if it is larger. `attachments` are those of
    /// [`Attachments::deform`](crate::attachments::Attachments::deform) at `q`, of which `world_from_domain` is composed.
    /// A bound decides whether the vertices of a joint are visited.
    pub fn max_gap(
        &self,
        model: &Model,
        q: &[f64],
        attachments: &[AffineTransform],
        world_from_domain: &[AffineTransform],
        floor: f64,
    ) -> f64 {
        let add_joint = |largest: f64, index: usize| {
            let (Some(distances), Some(joint)) = (&self.joints[index], &model.domains[index].joint) else {
                return largest;
            };
            let rounding = ROUNDING * (self.extent + world_from_domain[index].translation.amax());
            let bound = distances.bound.as_ref().map_or(f64::INFINITY, |bound| {
                let (parent, child) = (&model.domains[joint.parent], &model.domains[index]);
                rounding + bound.of(parent.q(q), child.q(q), &attachments[index].linear)
            });
            if bound <= largest {
                return largest;
            }
            let (mut largest, mut rest_distances) = (largest, distances.rest_distances.iter());
            visit_distances(model, index, joint, q, world_from_domain, |distance| {
                let rest_distance = rest_distances.next().unwrap_or(&distance);
                largest = largest.max((distance - rest_distance).abs());
            });
            largest
        };
        let joints = (0..model.domains.len()).into_par_iter().with_min_len(MIN_DOMAINS_PER_THREAD);
        joints.fold(|| floor, add_joint).reduce(|| floor, f64::max)
    }
}

impl JointBound {
    /// `None` if the parent's modes do not move the joint, or if a placement changes distances.
    fn new(model: &Model, child: &DomainModel, joint: &Joint) -> Option<Self> {
        let parent = &model.domains[joint.parent];
        let is_rotation =
            |linear: &Matrix3<f64>| (linear.transpose() * linear - Matrix3::identity()).amax() <= ROTATION_TOLERANCE;
        if !(is_rotation(&parent.placement.linear) && is_rotation(&joint.parent_from_child.linear)) {
            return None;
        }
        let base_sample = child.base_sample.map(|index| &child.samples[index]);
        let base_displacement = |mode: usize| base_sample.map_or(0.0, |sample| sample.column(mode, child.rank).norm());
        Some(Self {
            section: SectionBounds::new(parent, joint)?,
            child_from_parent: joint.parent_from_child.linear.try_inverse()?,
            base_displacements: (0..child.rank).map(base_displacement).collect(),
        })
    }

    /// The bound at the coordinates of the parent and of the child. `attachment` is the linear part of the deformed
    /// `parent_from_child`.
    fn of(&self, parent_q: &[f64], child_q: &[f64], attachment: &Matrix3<f64>) -> f64 {
        let base: f64 = child_q.iter().zip(&self.base_displacements).map(|(q, per_unit)| q.abs() * per_unit).sum();
        let distance = self.section.distance(parent_q, &(attachment * self.child_from_parent));
        // Placements that are rotations up to a tolerance.
        (1.0 + 10.0 * ROTATION_TOLERANCE) * (base + distance)
    }
}

/// Calls `visit` with the distances of a joint between the base vertex and the attachment vertices.
fn visit_distances(
    model: &Model,
    index: usize,
    joint: &Joint,
    q: &[f64],
    world_from_domain: &[AffineTransform],
    mut visit: impl FnMut(f64),
) {
    let (domain, transform) = (&model.domains[index], &world_from_domain[index]);
    let (parent, world_from_parent) = (&model.domains[joint.parent], &world_from_domain[joint.parent]);
    let base_sample = domain.base_sample.map(|index| &domain.samples[index]);
    let rest_base_position = base_sample.map_or(Vector3::zeros(), |sample| sample.rest_position);
    let base_position =
        transform.apply(&base_sample.map_or(rest_base_position, |sample| sample.deformed_position(domain.q(q))));
    if parent.rank == 0 || joint.attachment_samples.is_empty() {
        let attached_base_position = world_from_parent.compose(&joint.parent_from_child).apply(&rest_base_position);
        visit((base_position - attached_base_position).norm());
        return;
    }
    let distance =
        |sample: &Sample| (world_from_parent.apply(&sample.deformed_position(parent.q(q))) - base_position).norm();
    joint.attachment_samples.iter().for_each(|sample| visit(distance(&parent.samples[*sample])));
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::attachments::Attachments;
    use crate::coupled::testing::{Random, random_plant};
    use crate::hierarchy::compose_transforms;

    /// The largest opening of a joint, from all vertices.
    pub(crate) fn measure_gap(model: &Model, q: &[f64], world_from_domain: &[AffineTransform]) -> f64 {
        let meter = JointGapMeter::new(model);
        let mut largest = 0.0_f64;
        for (index, domain) in model.domains.iter().enumerate() {
            let (Some(joint), Some(distances)) = (&domain.joint, &meter.joints[index]) else { continue };
            let mut rest_distances = distances.rest_distances.iter();
            visit_distances(model, index, joint, q, world_from_domain, |distance| {
                largest = largest.max((distance - rest_distances.next().expect("a distance at rest")).abs());
            });
        }
        largest
    }

    /// Transforms as the server receives them.
    fn rounded(transforms: &[AffineTransform]) -> Vec<AffineTransform> {
        transforms.iter().map(|transform| AffineTransform::from_row_major(&transform.to_row_major())).collect()
    }

    #[test]
    fn largest_gap_is_that_of_all_joints() {
        for seed in 0..20 {
            let model = random_plant(30, seed);
            let (meter, attachments) = (JointGapMeter::new(&model), Attachments::new(&model));
            assert!(
                meter.joints.iter().flatten().all(|joint| joint.bound.is_some() || joint.rest_distances.len() == 1)
            );
            let mut random = Random::new(seed);
            let mut floor = 0.0;
            for amplitude in [1e-6, 1e-2, 1e-3, 0.1, 0.1, 2.0] {
                let q: Vec<f64> = (0..model.coordinate_count).map(|_| amplitude * random.next()).collect();
                let deformed = attachments.deform(&model, &q);
                let transforms = rounded(&compose_transforms(&model, &deformed, &[]));
                let expected = measure_gap(&model, &q, &transforms);
                assert_eq!(meter.max_gap(&model, &q, &deformed, &transforms, 0.0), expected, "{seed} {amplitude}");
                assert_eq!(meter.max_gap(&model, &q, &deformed, &transforms, floor), expected.max(floor));
                floor = expected.max(floor);
            }
        }
    }

    /// The bound of every joint is at least its opening, and a joint far below the floor is not visited.
    #[test]
    fn bounds_exceed_gaps_and_are_not_loose() {
        let model = random_plant(30, 5);
        let (meter, attachments) = (JointGapMeter::new(&model), Attachments::new(&model));
        let mut random = Random::new(5);
        for amplitude in [1e-3, 1e-2, 0.1] {
            let q: Vec<f64> = (0..model.coordinate_count).map(|_| amplitude * random.next()).collect();
            let deformed = attachments.deform(&model, &q);
            let transforms = compose_transforms(&model, &deformed, &[]);
            let (mut bounds, mut gaps) = (vec![], vec![]);
            for (index, domain) in model.domains.iter().enumerate() {
                let (Some(joint), Some(distances)) = (&domain.joint, &meter.joints[index]) else { continue };
                let Some(bound) = &distances.bound else { continue };
                let (parent, mut gap) = (&model.domains[joint.parent], 0.0_f64);
                let mut rest_distances = distances.rest_distances.iter();
                visit_distances(&model, index, joint, &q, &transforms, |distance| {
                    gap = gap.max((distance - rest_distances.next().expect("a distance at rest")).abs());
                });
                bounds.push(bound.of(parent.q(&q), domain.q(&q), &deformed[index].linear));
                gaps.push(gap);
            }
            assert!(gaps.iter().zip(&bounds).all(|(gap, bound)| *gap <= bound + 1e-12), "{gaps:?} {bounds:?}");
            let largest = |numbers: &[f64]| numbers.iter().copied().fold(0.0, f64::max);
            assert!(largest(&bounds) <= 10.0 * largest(&gaps), "{gaps:?} {bounds:?}");
        }
    }
}
