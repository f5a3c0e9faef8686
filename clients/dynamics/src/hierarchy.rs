//! Transforms of a hierarchy of domains. They keep every joint closed: a child stays attached to certain vertices of
//! its parent, the attachment vertices. The transform T of a child is the product of three transforms: its parent's T,
//! the rigid transform that best fits the displacement U q of the attachment vertices, and `parent_from_child` at rest.

use crate::affine::AffineTransform;
use crate::attachments::Attachments;
use crate::model::Model;

/// Computes `world_from_domain` of every domain at the coordinates `q` of the scene. `local_transforms` has an optional
/// motion of each domain within its own frame, for example the rotation of a leaf about its stalk. The list may be
/// shorter than the list of domains. A domain that follows another one has no motion of its own.
pub fn compute_transforms(
    model: &Model,
    q: &[f64],
    local_transforms: &[Option<AffineTransform>],
) -> Vec<AffineTransform> {
    compose_transforms(model, &Attachments::new(model).deform(model, q), local_transforms)
}

/// As [`compute_transforms`]. `attachments` is the result of [`Attachments::deform`]: per domain, its transform relative
/// to its deformed parent, or its placement in the world if it has no parent.
pub fn compose_transforms(
    model: &Model,
    attachments: &[AffineTransform],
    local_transforms: &[Option<AffineTransform>],
) -> Vec<AffineTransform> {
    let mut world_from_domain: Vec<AffineTransform> = Vec::with_capacity(model.domains.len());
    for (index, (domain, attachment)) in model.domains.iter().zip(attachments).enumerate() {
        if let Some(follow) = &domain.follow {
            let follower = world_from_domain[follow.leader].compose(&follow.leader_from_follower);
            world_from_domain.push(follower);
            continue;
        }
        let world_from_attached = match &domain.joint {
            None => *attachment,
            Some(joint) => world_from_domain[joint.parent].compose(attachment),
        };
        let local_transform = local_transforms.get(index).and_then(Option::as_ref);
        world_from_domain.push(local_transform.map_or(world_from_attached, |local| world_from_attached.compose(local)));
    }
    world_from_domain
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::joint_gap::tests::measure_gap;
    use crate::model::{DomainModel, Joint, Sample};
    use nalgebra::{Matrix3, Vector3};
    use std::collections::BTreeMap;

    /// A beam of length 1 along y with two modes: bending along x and z, with sections that rotate with the slope.
    fn beam(radius: f64, joint: Option<Joint>, placement: AffineTransform, first_coordinate: usize) -> DomainModel {
        let mut samples = vec![];
        for section in 0..5 {
            let y = f64::from(section) / 4.0;
            for vertex in 0..6 {
                let angle = f64::from(vertex) * std::f64::consts::PI / 3.0;
                let (x, z) = (radius * angle.cos(), radius * angle.sin());
                // Three rows (x, y, z) of two modes. Per unit of q, a section moves sideways by y^2, which is 1 at the
                // tip. The section rotates by the slope 2 y, which moves its vertices along y.
                let mode_rows = vec![y * y, 0.0, -2.0 * y * x, -2.0 * y * z, 0.0, y * y];
                samples.push(Sample { rest_position: Vector3::new(x, y, z), mode_rows, part: 0 });
            }
        }
        let surface_sample_count = samples.len();
        // The base sample, at the origin.
        samples.push(Sample { rest_position: Vector3::zeros(), mode_rows: vec![0.0; 6], part: 0 });
        DomainModel {
            name: "beam".into(),
            rank: 2,
            first_coordinate,
            owns_q: true,
            placement,
            joint,
            follow: None,
            eigenvalues: vec![30.0, 35.0],
            inertia: None,
            notes: BTreeMap::new(),
            area: radius,
            part_count: 1,
            diagonal: 1.0,
            samples,
            surface_sample_count,
            base_sample: Some(surface_sample_count),
        }
    }

    /// A trunk, a branch, a twig and a rigid leaf. Branch, twig and leaf are each tilted and attached to the top
    /// section of the previous domain. Trunk, branch and twig have two coordinates each.
    pub(crate) fn four_domain_model() -> Model {
        let tilt = AffineTransform::rotation_about(&Vector3::z(), -0.9, &Vector3::zeros());
        let parent_from_child = AffineTransform { translation: Vector3::y(), ..tilt };
        // The last of the five sections has the vertices 24 to 29.
        let joint = |parent| Some(Joint { parent, parent_from_child, attachment_samples: (24..30).collect() });
        let mut domains = vec![beam(0.05, None, AffineTransform::identity(), 0)];
        for parent in 0..2 {
            let placement = domains[parent].placement.compose(&parent_from_child);
            domains.push(beam(0.03, joint(parent), placement, 2 * (parent + 1)));
        }
        let placement = domains[2].placement.compose(&parent_from_child);
        let mut leaf = beam(0.01, joint(2), placement, 6);
        (leaf.rank, leaf.eigenvalues) = (0, vec![]);
        leaf.samples.iter_mut().for_each(|sample| sample.mode_rows.clear());
        domains.push(leaf);
        Model {
            scene: "four_domain_model".into(),
            domains,
            coordinate_count: 6,
            unit: 1.0,
            up: Vector3::y(),
            bounds_min: Vector3::new(-0.1, 0.0, -0.1),
            bounds_max: Vector3::new(2.5, 1.7, 0.1),
        }
    }

    #[test]
    fn domains_at_rest_have_their_placement() {
        let model = four_domain_model();
        for (domain, transform) in model.domains.iter().zip(compute_transforms(&model, &[0.0; 6], &[])) {
            assert!((transform.linear - domain.placement.linear).abs().max() <= 1e-12);
            assert!((transform.translation - domain.placement.translation).norm() <= 1e-12);
        }
    }

    #[test]
    fn children_follow_their_parents_and_joints_stay_closed() {
        let model = four_domain_model();
        for q in [[0.1, 0.05, -0.08, 0.1, 0.1, -0.1], [-0.12, 0.0, 0.1, 0.1, -0.05, 0.1]] {
            let world_from_domain = compute_transforms(&model, &q, &[]);
            // A small gap remains, because the fitted transform is rigid, but a linear mode stretches rotated sections.
            let gap = measure_gap(&model, &q, &world_from_domain);
            assert!(gap <= 1e-3 * model.diagonal(), "gap {gap}, diagonal {}", model.diagonal());
            for transform in &world_from_domain {
                assert!((transform.linear.transpose() * transform.linear - Matrix3::identity()).abs().max() <= 1e-9);
            }
            let displacement = model.max_displacement(&q, &world_from_domain);
            assert!(displacement > 0.05, "expected a displacement above 0.05, got {displacement}");
            // Negative control: children that do not follow their parents open the joints.
            let placements: Vec<_> = model.domains.iter().map(|domain| domain.placement).collect();
            assert!(measure_gap(&model, &q, &placements) > 1e-2 * model.diagonal());
        }
    }

    #[test]
    fn rigid_domain_that_rotates_about_its_base_stays_attached() {
        let model = four_domain_model();
        let max_gap = |leaf_transform: AffineTransform| {
            let world_from_domain = compute_transforms(&model, &[0.05; 6], &[None, None, None, Some(leaf_transform)]);
            measure_gap(&model, &[0.05; 6], &world_from_domain)
        };
        let rotation = AffineTransform::rotation_about(&Vector3::x(), 0.3, &Vector3::zeros());
        assert!(max_gap(rotation) <= 1e-3 * model.diagonal());
        let detached = AffineTransform { translation: Vector3::new(0.0, 0.1, 0.0), ..rotation };
        assert!(max_gap(detached) > 1e-3 * model.diagonal());
    }
}
