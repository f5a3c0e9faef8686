//! `parent_from_child` of every domain as a function of q. The correlation of deformed and rest positions, from which
//! Kabsch's method fits a rigid transform, is linear in the deformed positions and therefore in q. It is precomputed
//! per mode. A step then costs 12 r multiplications per joint (for each of the r modes, 3 for the mean and 9 for the
//! correlation) and one `nearest_rotation`, however many attachment vertices the joint has.

use nalgebra::{Matrix3, Vector3, Vector6};
use rayon::prelude::*;

use crate::affine::{AffineTransform, MIN_RELATIVE_SPREAD, nearest_rotation};
use crate::model::{DomainModel, Joint, MIN_DOMAINS_PER_THREAD, Model, Sample};
use crate::wrench::stack;

/// The attachments of all domains of a model.
pub struct Attachments {
    /// Per domain; `None` without a parent, or if the parent's modes do not move the joint.
    fits: Vec<Option<AttachmentFit>>,
}

/// The rigid transform that best maps the rest positions of a joint's attachment vertices to their deformed positions,
/// as a function of the parent's q.
struct AttachmentFit {
    rest_mean: Vector3<f64>,
    /// At rest.
    rest_moments: Moments,
    /// Per mode: the change per unit of the coordinate.
    mode_moments: Vec<Moments>,
}

/// The mean of vectors at the attachment vertices, and the sum of their outer products with the rest positions relative
/// to the mean rest position.
#[derive(Clone, Copy)]
struct Moments {
    mean: Vector3<f64>,
    correlation: Matrix3<f64>,
}

impl Attachments {
    /// Precomputes the fits of all joints.
    pub fn new(model: &Model) -> Self {
        let fit = |domain: &DomainModel| {
            let joint = domain.joint.as_ref()?;
            AttachmentFit::new(&model.domains[joint.parent], joint)
        };
        Self { fits: model.domains.iter().map(fit).collect() }
    }

    /// `parent_from_child` of every domain at the coordinates `q` of the scene: its value at rest, moved by the rigid
    /// transform that fits the displacement of the parent's attachment vertices. For a domain without a parent this is
    /// its placement in the world.
    pub fn deform(&self, model: &Model, q: &[f64]) -> Vec<AffineTransform> {
        let attachment = |(domain, fit): (&DomainModel, &Option<AttachmentFit>)| match (&domain.joint, fit) {
            (None, _) => domain.placement,
            (Some(joint), None) => joint.parent_from_child,
            (Some(joint), Some(fit)) => {
                fit.rigid_transform(model.domains[joint.parent].q(q)).compose(&joint.parent_from_child)
            }
        };
        let domains = model.domains.par_iter().with_min_len(MIN_DOMAINS_PER_THREAD);
        domains.zip(&self.fits).map(attachment).collect()
    }
}

impl AttachmentFit {
    fn new(parent: &DomainModel, joint: &Joint) -> Option<Self> {
        if parent.rank == 0 || joint.attachment_samples.is_empty() {
            return None;
        }
        let samples: Vec<&Sample> = joint.attachment_samples.iter().map(|index| &parent.samples[*index]).collect();
        let mean = |vectors: &[Vector3<f64>]| vectors.iter().sum::<Vector3<f64>>() / vectors.len() as f64;
        let rest_positions: Vec<Vector3<f64>> = samples.iter().map(|sample| sample.rest_position).collect();
        let rest_mean = mean(&rest_positions);
        let moments = |vectors: Vec<Vector3<f64>>| {
            let vector_mean = mean(&vectors);
            let outer_product = |(vector, rest_position): (&Vector3<f64>, &Vector3<f64>)| {
                (vector - vector_mean) * (rest_position - rest_mean).transpose()
            };
            Moments { mean: vector_mean, correlation: vectors.iter().zip(&rest_positions).map(outer_product).sum() }
        };
        let column = |mode: usize| samples.iter().map(|sample| sample.column(mode, parent.rank)).collect();
        let mode_moments = (0..parent.rank).map(|mode| moments(column(mode))).collect();
        Some(Self { rest_mean, rest_moments: moments(rest_positions.clone()), mode_moments })
    }

    /// The rigid transform with the least squared error (Kabsch 1976), at the coordinates `q` of the parent. Fewer than
    /// three vertices, or collinear ones, do not determine the rotation. In this case, the result is the translation of
    /// the mean.
    fn rigid_transform(&self, q: &[f64]) -> AffineTransform {
        let Moments { mut mean, mut correlation } = self.rest_moments;
        for (coordinate, moments) in q.iter().zip(&self.mode_moments) {
            mean += moments.mean * *coordinate;
            correlation += moments.correlation * *coordinate;
        }
        let rotation = nearest_rotation(&correlation);
        AffineTransform { linear: rotation, translation: mean - rotation * self.rest_mean }
    }

    /// Per mode: the derivative of [`Self::rigid_transform`] at rest.
    ///
    /// With the correlation C at rest and its change B, the rotation vector w solves (tr(C) I - C) w = b, where b is
    /// twice the axial vector of B: the sum of the moments of the displacements about the mean.
    fn rates_at_rest(&self) -> Vec<RigidRate> {
        let correlation = &self.rest_moments.correlation;
        let mut spreads: Vec<f64> = correlation.symmetric_eigenvalues().iter().copied().collect();
        spreads.sort_by(f64::total_cmp);
        let is_determined = spreads[2].is_normal() && spreads[1] > MIN_RELATIVE_SPREAD * spreads[2];
        let inverse = (Matrix3::identity() * correlation.trace() - correlation).try_inverse();
        let inverse = inverse.filter(|_| is_determined).unwrap_or_else(Matrix3::zeros);
        let rate = |moments: &Moments| {
            let b = &moments.correlation;
            let moment = Vector3::new(b[(2, 1)] - b[(1, 2)], b[(0, 2)] - b[(2, 0)], b[(1, 0)] - b[(0, 1)]);
            RigidRate { center: self.rest_mean, center_velocity: moments.mean, angular_velocity: inverse * moment }
        };
        self.mode_moments.iter().map(rate).collect()
    }
}

/// Bounds of the distance between the attachment vertices of a joint and their fitted rigid motion.
#[derive(Debug, Clone)]
pub(crate) struct SectionBounds {
    /// Per mode of the parent.
    modes: Vec<SectionRate>,
    /// The largest distance of an attachment vertex from their mean at rest.
    radius: f64,
}

/// The motion of the attachment vertices per unit rate of a coordinate.
#[derive(Debug, Clone, Copy)]
struct SectionRate {
    angular_velocity: Vector3<f64>,
    /// The largest difference of a vertex's velocity from that of the rigid motion.
    residual: f64,
}

impl SectionBounds {
    /// `None` if the parent's modes do not move the joint.
    pub(crate) fn new(parent: &DomainModel, joint: &Joint) -> Option<Self> {
        let fit = AttachmentFit::new(parent, joint)?;
        let samples = || joint.attachment_samples.iter().map(|index| &parent.samples[*index]);
        let rate = |(mode, rate): (usize, RigidRate)| {
            let RigidRate { center, center_velocity, angular_velocity } = rate;
            let difference = |sample: &Sample| {
                let rigid_velocity = center_velocity + angular_velocity.cross(&(sample.rest_position - center));
                (sample.column(mode, parent.rank) - rigid_velocity).norm()
            };
            SectionRate { angular_velocity, residual: samples().map(difference).fold(0.0, f64::max) }
        };
        let modes = fit.rates_at_rest().into_iter().enumerate().map(rate).collect();
        let distance = |sample: &Sample| (sample.rest_position - fit.rest_mean).norm();
        Some(Self { modes, radius: samples().map(distance).fold(0.0, f64::max) })
    }

    /// A bound at the coordinates `q` of the parent, at which the fit has this rotation: the distance of each vertex from
    /// the linear rigid motion, and the distance of the linear from the finite rotation.
    pub(crate) fn distance(&self, q: &[f64], rotation: &Matrix3<f64>) -> f64 {
        let (mut angle, mut residual) = (Vector3::zeros(), 0.0);
        for (coordinate, mode) in q.iter().zip(&self.modes) {
            angle += mode.angular_velocity * *coordinate;
            residual += mode.residual * coordinate.abs();
        }
        let nonlinear = (rotation - Matrix3::identity() - angle.cross_matrix()).norm();
        residual + nonlinear * self.radius
    }
}

/// The velocity of a rigid body per unit rate of a coordinate.
struct RigidRate {
    center: Vector3<f64>,
    center_velocity: Vector3<f64>,
    angular_velocity: Vector3<f64>,
}

/// Per mode of the parent: the small motion of a joint's frame per unit of the coordinate, in world axes at rest: the
/// translation of the child's origin, then the rotation vector. It is the derivative of the drawn transform of the
/// child. Empty if the parent's modes do not move the joint.
pub(crate) fn joint_modes(parent: &DomainModel, joint: &Joint) -> Vec<Vector6<f64>> {
    let Some(fit) = AttachmentFit::new(parent, joint) else { return vec![] };
    let origin = &joint.parent_from_child.translation;
    let (linear, rotation) = (&parent.placement.linear, nearest_rotation(&parent.placement.linear));
    let world_motion = |rate: RigidRate| {
        let velocity = linear * (rate.center_velocity + rate.angular_velocity.cross(&(origin - rate.center)));
        let angular_velocity = rotation * rate.angular_velocity;
        stack(&velocity, &angular_velocity)
    };
    fit.rates_at_rest().into_iter().map(world_motion).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::affine::fit_rigid_transform;
    use crate::hierarchy::tests::four_domain_model;

    #[test]
    fn fit_equals_the_fit_of_the_deformed_vertices() {
        let model = four_domain_model();
        let attachments = Attachments::new(&model);
        for amplitude in [0.0, 1e-9, 0.3, 1.0, 1e4] {
            let q: Vec<f64> = (0..model.coordinate_count).map(|index| amplitude * (1.0 + index as f64).sin()).collect();
            for (domain, attachment) in model.domains.iter().zip(attachments.deform(&model, &q)) {
                let Some(joint) = &domain.joint else {
                    assert_eq!(attachment, domain.placement);
                    continue;
                };
                let parent = &model.domains[joint.parent];
                let samples = || joint.attachment_samples.iter().map(|index| &parent.samples[*index]);
                let rest: Vec<_> = samples().map(|sample| sample.rest_position).collect();
                let current: Vec<_> = samples().map(|sample| sample.deformed_position(parent.q(&q))).collect();
                let expected = fit_rigid_transform(&rest, &current).compose(&joint.parent_from_child);
                let scale = amplitude.max(1.0);
                assert!((attachment.linear - expected.linear).abs().max() <= 1e-11, "{amplitude}: {}", domain.name);
                assert!((attachment.translation - expected.translation).norm() <= 1e-11 * scale, "{amplitude}");
            }
        }
    }
}
