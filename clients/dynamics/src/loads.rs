//! Forces on a scene: on the coordinates of domains, and on their material.

use nalgebra::{Vector3, Vector6};

use crate::model::{DomainModel, Model, Sample};
use crate::wrench::stack;

/// Forces on all domains of a scene.
#[derive(Debug, Clone, PartialEq)]
pub struct DomainLoads {
    /// Per coordinate: U^T f, in newtons times scene units per unit of q.
    pub coordinates: Vec<f64>,
    /// Per domain: the sum of the forces on its material in newtons, then the sum of their moments about the domain's
    /// origin at rest in newtons times scene units; in world axes. They act on the ancestors of the domain.
    pub wrenches: Vec<Vector6<f64>>,
    /// The forces that [`Self::add_wrench`] has added to `wrenches`, for bodies that turn.
    pub points: Vec<PointForce>,
}

/// A force at a point of a domain.
#[derive(Debug, Clone, PartialEq)]
pub struct PointForce {
    pub domain: usize,
    /// At rest, in the frame of the domain.
    pub rest_point: Vector3<f64>,
    /// In newtons and world axes.
    pub force: Vector3<f64>,
}

impl DomainLoads {
    /// No forces.
    pub fn none(model: &Model) -> Self {
        Self {
            coordinates: vec![0.0; model.coordinate_count],
            wrenches: vec![Vector6::zeros(); model.domains.len()],
            points: vec![],
        }
    }

    /// Forces on the coordinates alone.
    #[cfg(test)]
    pub(crate) fn of_coordinates(model: &Model, coordinates: &[f64]) -> Self {
        Self { coordinates: coordinates.to_vec(), ..Self::none(model) }
    }

    /// Adds the wrench of a force in newtons and world axes at a point at rest, in the frame of the domain.
    pub fn add_wrench(&mut self, model: &Model, domain: usize, rest_point: &Vector3<f64>, force: &Vector3<f64>) {
        let arm = model.domains[domain].placement.linear * rest_point;
        self.wrenches[domain] += stack(force, &arm.cross(force));
        self.points.push(PointForce { domain, rest_point: *rest_point, force: *force });
    }

    /// Adds a force in newtons and world axes at a sample of a domain.
    pub fn add_force(&mut self, model: &Model, domain: usize, sample: &Sample, force: &Vector3<f64>) {
        let DomainModel { placement, first_coordinate, rank, .. } = &model.domains[domain];
        let local_force = placement.linear.transpose() * force;
        for mode in 0..*rank {
            self.coordinates[first_coordinate + mode] += sample.column(mode, *rank).dot(&local_force);
        }
        self.add_wrench(model, domain, &sample.rest_position, force);
    }
}
