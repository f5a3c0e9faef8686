//! The static response of coupled domains: the limit of a step for dt to infinity, in which only the stiffness remains.
//! The stiffness is diagonal in q, because the elastic energy of a domain does not depend on the motion of its frame.

use nalgebra::{Vector3, Vector6};

use super::joints::JointTree;
use crate::error::Result;
use crate::loads::DomainLoads;
use crate::model::{DomainModel, Model, Sample};
use crate::parameters::{ModalParameters, ModeParameters};
use crate::viewer_forces::force_scale;
use crate::wrench::split;

/// Largest displacement U q in a domain under the forces of viewers at rest, as a fraction of the domain's diagonal: the
/// sum over its modes. At half the length, the linear modes of a beam are off by 29 %.
const MAX_DOMAIN_BENDING: f64 = 0.5;

/// The static equations of a scene.
pub struct StaticSystem {
    tree: JointTree,
    /// Per coordinate: 1 / omega^2; 0 for a mode that is held still.
    compliances: Vec<f64>,
    /// Per coordinate: the largest displacement of a sample of its domain or of a descendant per unit of the coordinate,
    /// in diagonals of the scene's rest bounds.
    displacements_per_unit: Vec<f64>,
    /// Per domain and mode: the largest displacement of a sample of the domain per unit of the coordinate, in diagonals
    /// of the domain's bounds.
    bending_per_unit: Vec<Vec<f64>>,
}

/// A scene at rest under loads.
#[derive(Debug, Clone, PartialEq)]
pub struct StaticResponse {
    pub q: Vec<f64>,
    /// Per domain: the motion of its frame in world axes, the translation of its origin and the rotation vector.
    frames: Vec<Vector6<f64>>,
}

impl StaticSystem {
    /// Creates the equations of a scene.
    ///
    /// # Errors
    /// Those of [`JointTree::new`].
    pub fn new(model: &Model, parameters: &ModalParameters) -> Result<Self> {
        let compliance = |mode: &Option<ModeParameters>| mode.map_or(0.0, |mode| mode.eigenvalue.recip());
        let tree = JointTree::new(model)?;
        let mut displacements_per_unit = model.displacements_per_unit();
        for (coordinate, lever) in tree.levers(model).into_iter().enumerate() {
            let displacement = &mut displacements_per_unit[coordinate];
            *displacement = displacement.max(lever / model.diagonal());
        }
        let bending = |domain: &DomainModel| {
            // A domain without extent has no limit.
            let scale = if domain.diagonal > 0.0 { domain.diagonal.recip() } else { 0.0 };
            (0..domain.rank).map(|mode| scale * domain.displacement_per_unit(mode)).collect()
        };
        Ok(Self {
            tree,
            compliances: parameters.modes.iter().map(compliance).collect(),
            displacements_per_unit,
            bending_per_unit: model.domains.iter().map(bending).collect(),
        })
    }

    /// The joints of the scene.
    pub const fn joints(&self) -> &JointTree {
        &self.tree
    }

    /// The response to loads.
    pub fn solve(&self, loads: &DomainLoads) -> StaticResponse {
        let q = self.solve_reduced(&self.tree.reduce(loads));
        StaticResponse { frames: self.tree.frame_motions(&q), q }
    }

    /// The coordinates under the forces of [`JointTree::reduce`].
    pub fn solve_reduced(&self, forces: &[f64]) -> Vec<f64> {
        forces.iter().zip(&self.compliances).map(|(force, compliance)| force * compliance).collect()
    }

    /// The factor, at most 1, by which forces of viewers are scaled so that linear modes can show their effect at rest:
    /// the scene moves by at most [`MAX_STATIC_DISPLACEMENT`](crate::viewer_forces::MAX_STATIC_DISPLACEMENT), and no
    /// domain bends by more than half its diagonal. `forces` are those of [`JointTree::reduce`].
    pub fn viewer_force_scale(&self, model: &Model, forces: &[f64]) -> f64 {
        let q = self.solve_reduced(forces);
        let domains = model.domains.iter().zip(&self.bending_per_unit);
        let bending = |(domain, per_unit): (&DomainModel, &Vec<f64>)| -> f64 {
            domain.q(&q).iter().zip(per_unit).map(|(q, per_unit)| q.abs() * per_unit).sum()
        };
        let largest_bending = domains.map(bending).fold(0.0, f64::max);
        let bending_scale =
            if largest_bending <= MAX_DOMAIN_BENDING { 1.0 } else { MAX_DOMAIN_BENDING / largest_bending };
        force_scale(&q, &self.displacements_per_unit).min(bending_scale)
    }
}

impl StaticResponse {
    /// The translation of a domain's origin, in scene units and world axes.
    pub fn translation(&self, domain: usize) -> Vector3<f64> {
        split(&self.frames[domain]).0
    }

    /// The rotation vector of a domain's frame, in radians and world axes.
    pub fn rotation(&self, domain: usize) -> Vector3<f64> {
        split(&self.frames[domain]).1
    }

    /// The displacement of a sample of a domain, in scene units and world axes.
    pub fn displacement(&self, model: &Model, domain: usize, sample: &Sample) -> Vector3<f64> {
        let (translation, rotation) = split(&self.frames[domain]);
        let DomainModel { placement, .. } = &model.domains[domain];
        let elastic_displacement = sample.displacement(model.domains[domain].q(&self.q));
        translation
            + rotation.cross(&(placement.linear * sample.rest_position))
            + placement.linear * elastic_displacement
    }
}
