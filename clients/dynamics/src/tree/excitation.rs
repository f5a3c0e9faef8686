//! Generalized forces of the wind: U^T times the wind pressure on the surface samples of a domain, plus the forces of
//! its child domains at their joints.

use nalgebra::Vector3;

use crate::model::{DomainModel, Model};
use crate::wind::{Wind, WindPressure, WindSettings};

/// Horizontal unit vectors of a wind.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct WindAxes {
    /// The direction that the wind blows to.
    pub(super) downwind: Vector3<f64>,
    /// At a right angle to `downwind`.
    pub(super) crosswind: Vector3<f64>,
}

/// The wind on a scene.
pub(super) struct WindExcitation {
    pub(super) axes: WindAxes,
    wind: Wind,
    /// Per domain.
    loads: Vec<WindLoad>,
}

/// Factors for the generalized forces of one domain: those of the wind pressure on the domain's own modes, and those of
/// the force at the domain's joint on the modes of its parent.
struct WindLoad {
    /// Per mode: U^T times a unit pressure downwind.
    downwind: Vec<f64>,
    /// Per mode: U^T times a unit pressure crosswind.
    crosswind: Vec<f64>,
    /// The mean of the parent's U over the attachment samples of the joint: 3 x r of the parent, in world axes. Empty
    /// without a parent.
    joint_modes: Vec<f64>,
}

impl WindExcitation {
    /// Creates the wind on a scene. Its frequencies are at most `max_frequency` hertz.
    pub(super) fn new(model: &Model, direction_radians: f64, seed: u64, max_frequency: f64) -> Self {
        let downwind = model.horizontal_direction(direction_radians);
        let axes = WindAxes { downwind, crosswind: model.up.cross(&downwind) };
        let positions: Vec<f64> = model.domains.iter().map(|domain| downwind_position(model, domain, &axes)).collect();
        let settings = WindSettings { seed, diagonal: model.diagonal(), max_frequency };
        Self {
            axes,
            wind: Wind::new(&settings, &positions),
            loads: model.domains.iter().map(|domain| WindLoad::new(model, domain, &axes)).collect(),
        }
    }

    /// The pressure on every domain at `time` seconds.
    pub(super) fn pressures(&self, time: f64) -> Vec<WindPressure> {
        self.wind.pressures(time)
    }

    /// Computes the generalized forces of pressures, one per coordinate. A child has a larger index than its parent. In
    /// reverse order, the forces of all descendants of a domain are therefore complete before its own joint needs them.
    pub(super) fn compute_forces(&self, model: &Model, pressures: &[WindPressure]) -> Vec<f64> {
        let mut forces = vec![0.0; model.coordinate_count];
        // Per domain: the force on it and its descendants, in world axes.
        let mut subtree_forces = vec![Vector3::zeros(); model.domains.len()];
        for (index, domain) in model.domains.iter().enumerate().rev() {
            let load = &self.loads[index];
            let WindPressure { downwind, crosswind } = pressures[index];
            for mode in 0..domain.rank {
                forces[domain.first_coordinate + mode] +=
                    downwind * load.downwind[mode] + crosswind * load.crosswind[mode];
            }
            subtree_forces[index] += (self.axes.downwind * downwind + self.axes.crosswind * crosswind) * domain.area;
            let Some(joint) = &domain.joint else { continue };
            let (parent, joint_force) = (&model.domains[joint.parent], subtree_forces[index]);
            for (component, row) in load.joint_modes.chunks_exact(parent.rank.max(1)).enumerate() {
                for (mode, entry) in row.iter().enumerate() {
                    forces[parent.first_coordinate + mode] += entry * joint_force[component];
                }
            }
            subtree_forces[joint.parent] += joint_force;
        }
        forces
    }
}

/// Position of a domain's center along the wind, from the lower corner of the scene's bounds, in scene units.
fn downwind_position(model: &Model, domain: &DomainModel, axes: &WindAxes) -> f64 {
    let samples = domain.surface_samples();
    let center = samples.iter().map(|sample| sample.rest_position).sum::<Vector3<f64>>() / samples.len().max(1) as f64;
    (domain.placement.apply(&center) - model.bounds_min).dot(&axes.downwind)
}

impl WindLoad {
    fn new(model: &Model, domain: &DomainModel, axes: &WindAxes) -> Self {
        let samples = domain.surface_samples();
        let sample_area = domain.area / samples.len().max(1) as f64;
        let reduced_load = |direction: &Vector3<f64>| {
            let local_direction = domain.placement.linear.transpose() * direction;
            let modal_load = |mode| {
                samples.iter().map(|sample| sample.column(mode, domain.rank).dot(&local_direction)).sum::<f64>()
                    * sample_area
            };
            (0..domain.rank).map(modal_load).collect::<Vec<f64>>()
        };
        let joint_modes = domain.joint.as_ref().map_or(vec![], |joint| {
            let parent = &model.domains[joint.parent];
            let attachment_samples = joint.attachment_samples.iter().map(|index| &parent.samples[*index]);
            let sample_count = joint.attachment_samples.len().max(1) as f64;
            let mean_column = |mode: usize| {
                let columns = attachment_samples.clone().map(|sample| sample.column(mode, parent.rank));
                columns.sum::<Vector3<f64>>() / sample_count
            };
            let columns: Vec<Vector3<f64>> =
                (0..parent.rank).map(|mode| parent.placement.linear * mean_column(mode)).collect();
            (0..3).flat_map(|component| columns.iter().map(move |column| column[component])).collect()
        });
        Self { downwind: reduced_load(&axes.downwind), crosswind: reduced_load(&axes.crosswind), joint_modes }
    }
}
