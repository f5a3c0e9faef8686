//! Transforms of a hierarchy of parts that keep every joint closed. The transform T of a child is the product of its
//! parent's T, the rigid motion that best fits the displacement U q of the parent's ring of attachment vertices, and
//! the attachment frame at rest.

use nalgebra::Vector3;

use crate::affine::{Affine, rigid_motion};
use crate::model::{DomainModel, Joint, Model};

/// `world_from_domain` of every part at coordinates `q`. `local` moves a part within its own frame, for example a leaf
/// that rotates about its stalk; parts without an entry do not move in their frame.
pub fn transforms(model: &Model, q: &[f64], local: &[Option<Affine>]) -> Vec<Affine> {
    let mut world: Vec<Affine> = Vec::with_capacity(model.parts.len());
    for (index, part) in model.parts.iter().enumerate() {
        let placed = match &part.joint {
            None => part.placement,
            Some(joint) => world[joint.parent].compose(&attachment_transform(&model.parts[joint.parent], joint, q)),
        };
        let moved = local.get(index).and_then(Option::as_ref).map(|local| placed.compose(local));
        world.push(moved.unwrap_or(placed));
    }
    world
}

/// `parent_from_child` after the rigid motion of the parent's ring.
fn attachment_transform(parent: &DomainModel, joint: &Joint, q: &[f64]) -> Affine {
    if parent.rank == 0 || joint.ring.is_empty() {
        return joint.frame;
    }
    let q = parent.q(q);
    let rest: Vec<_> = joint.ring.iter().map(|place| parent.samples[*place].rest).collect();
    let now: Vec<_> = joint.ring.iter().map(|place| parent.samples[*place].deformed_position(q)).collect();
    rigid_motion(&rest, &now).compose(&joint.frame)
}

/// Measures how far joints open: compares the distances between a child's base vertex and the vertices of its parent's
/// ring with those at rest. The measurement is independent of how the transforms are computed.
#[derive(Debug, Clone)]
pub struct JointGapMeter {
    rest: Vec<Vec<f64>>,
}

impl JointGapMeter {
    /// Computes the distances at rest, with the placement of each part.
    pub fn new(model: &Model) -> Self {
        let world: Vec<_> = model.parts.iter().map(|part| part.placement).collect();
        let q = vec![0.0; model.coordinates];
        Self { rest: joint_distances(model, &q, &world) }
    }

    /// The largest opening of a joint, in scene units.
    pub fn gap(&self, model: &Model, q: &[f64], world: &[Affine]) -> f64 {
        let now = joint_distances(model, q, world);
        let pairs = now.iter().flatten().zip(self.rest.iter().flatten());
        pairs.map(|(now, rest)| (now - rest).abs()).fold(0.0, f64::max)
    }
}

/// Per part: the distances between its base and its parent's ring. Without a ring: the distance between its base and
/// the place given by its attachment frame.
fn joint_distances(model: &Model, q: &[f64], world: &[Affine]) -> Vec<Vec<f64>> {
    let of = |(part, pose): (&DomainModel, &Affine)| {
        let Some(joint) = &part.joint else { return vec![] };
        let (parent, above) = (&model.parts[joint.parent], &world[joint.parent]);
        let still = part.base.map_or(Vector3::zeros(), |base| part.samples[base].rest);
        let base = part.base.map_or(still, |base| part.samples[base].deformed_position(part.q(q)));
        let base = pose.apply(&base);
        if parent.rank == 0 || joint.ring.is_empty() {
            return vec![(base - above.compose(&joint.frame).apply(&still)).norm()];
        }
        let ring = joint.ring.iter().map(|place| above.apply(&parent.samples[*place].deformed_position(parent.q(q))));
        ring.map(|place| (place - base).norm()).collect()
    };
    model.parts.iter().zip(world).map(of).collect()
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::model::Sample;
    use nalgebra::Matrix3;
    use std::collections::BTreeMap;

    /// A part of length 1 along y with two modes: beam bending along x and z, with sections that rotate with the slope.
    fn stem(radius: f64, joint: Option<Joint>, placement: Affine, first: usize) -> DomainModel {
        let mut samples = vec![];
        for level in 0..5 {
            let y = f64::from(level) / 4.0;
            for corner in 0..6 {
                let angle = f64::from(corner) * std::f64::consts::PI / 3.0;
                let (x, z) = (radius * angle.cos(), radius * angle.sin());
                // Tip displacement 1 per unit of q: y^2 sideways, with slope 2 y.
                let rows = vec![y * y, 0.0, -2.0 * y * x, -2.0 * y * z, 0.0, y * y];
                samples.push(Sample { rest: Vector3::new(x, y, z), rows });
            }
        }
        let (surface_samples, extent) = (samples.len(), 1.0);
        samples.push(Sample { rest: Vector3::zeros(), rows: vec![0.0; 6] });
        DomainModel {
            name: "stem".into(),
            rank: 2,
            first,
            owns_q: true,
            placement,
            joint,
            eigenvalues: vec![30.0, 35.0],
            notes: BTreeMap::new(),
            area: radius,
            extent,
            samples,
            surface_samples,
            base: Some(surface_samples),
        }
    }

    /// A trunk, a tilted branch at its top ring, a twig at the branch's top ring, and a rigid leaf on the twig.
    pub(crate) fn plant() -> Model {
        let tilt = Affine::rotation_about(&Vector3::z(), -0.9, &Vector3::zeros());
        let frame = Affine { translation: Vector3::y(), ..tilt };
        let top = || (24..30).collect::<Vec<_>>();
        let joint = |parent| Some(Joint { parent, frame, ring: top() });
        let mut parts = vec![stem(0.05, None, Affine::identity(), 0)];
        for above in 0..2 {
            let placement = parts[above].placement.compose(&frame);
            parts.push(stem(0.03, joint(above), placement, 2 * (above + 1)));
        }
        let placement = parts[2].placement.compose(&frame);
        let mut leaf = stem(0.01, joint(2), placement, 6);
        (leaf.rank, leaf.eigenvalues) = (0, vec![]);
        leaf.samples.iter_mut().for_each(|sample| sample.rows.clear());
        parts.push(leaf);
        let (low, high) = (Vector3::new(-0.1, 0.0, -0.1), Vector3::new(2.5, 1.7, 0.1));
        Model { scene: "plant".into(), parts, coordinates: 6, up: Vector3::y(), low, high }
    }

    #[test]
    fn parts_at_rest_have_their_placement() {
        let model = plant();
        for (part, pose) in model.parts.iter().zip(transforms(&model, &[0.0; 6], &[])) {
            assert!((pose.linear - part.placement.linear).abs().max() <= 1e-12);
            assert!((pose.translation - part.placement.translation).norm() <= 1e-12);
        }
    }

    #[test]
    fn children_follow_their_parents_and_joints_stay_closed() {
        let model = plant();
        let gauge = JointGapMeter::new(&model);
        for q in [[0.1, 0.05, -0.08, 0.1, 0.1, -0.1], [-0.12, 0.0, 0.1, 0.1, -0.05, 0.1]] {
            let world = transforms(&model, &q, &[]);
            let gap = gauge.gap(&model, &q, &world);
            assert!(gap <= 1e-3 * model.diagonal(), "{gap} of {}", model.diagonal());
            for pose in &world {
                assert!((pose.linear.transpose() * pose.linear - Matrix3::identity()).abs().max() <= 1e-9);
            }
            let tip = model.peak(&q, &world);
            assert!(tip > 0.05, "the plant hardly moves: {tip}");
            // Negative control: children that do not follow leave a gap that the gauge detects.
            let still: Vec<_> = model.parts.iter().map(|part| part.placement).collect();
            assert!(gauge.gap(&model, &q, &still) > 1e-2 * model.diagonal());
        }
    }

    #[test]
    fn rigid_part_that_rotates_about_its_base_stays_attached() {
        let model = plant();
        let gauge = JointGapMeter::new(&model);
        let turn = Affine::rotation_about(&Vector3::x(), 0.3, &Vector3::zeros());
        let world = transforms(&model, &[0.05; 6], &[None, None, None, Some(turn)]);
        assert!(gauge.gap(&model, &[0.05; 6], &world) <= 1e-3 * model.diagonal());
        let away = Affine { translation: Vector3::new(0.0, 0.1, 0.0), ..turn };
        let world = transforms(&model, &[0.05; 6], &[None, None, None, Some(away)]);
        assert!(gauge.gap(&model, &[0.05; 6], &world) > 1e-3 * model.diagonal());
    }
}
