//! The drag of the air on bodies that move: 1/2 rho Cd A |v| v with the velocity v of the wind relative to the body.

use nalgebra::Vector3;

use crate::loads::DomainLoads;
use crate::model::{DomainModel, Model, Sample};
use crate::tree::{DRAG_COEFFICIENT, PROJECTED_FRACTION};
use crate::wind::{AIR_DENSITY, Wind, WindSettings};

/// The drag on all domains of a scene.
pub(crate) struct Drag {
    /// Horizontal unit vectors: the direction that the wind blows to, and one at a right angle to it.
    directions: [Vector3<f64>; 2],
    wind: Wind,
    /// Per domain.
    surfaces: Vec<Surface>,
}

/// The surface of a domain, in its frame.
struct Surface {
    /// 1/2 rho Cd A, in kg/m.
    drag: f64,
    /// The mean of the surface samples.
    center: Vector3<f64>,
    /// Per mode: the mean displacement of the surface samples per unit of the coordinate.
    modes: Vec<Vector3<f64>>,
}

impl Drag {
    /// Creates a wind of a mean speed in m/s, without gusts above a frequency in hertz. `direction` is that of the wind in
    /// radians about the up axis.
    pub(crate) fn new(model: &Model, mean_speed: f64, direction: f64, seed: u64, max_frequency: f64) -> Self {
        let downwind = model.horizontal_direction(direction);
        let positions: Vec<f64> = model
            .domains
            .iter()
            .map(|domain| (domain.placement.translation - model.bounds_min).dot(&downwind) * model.unit)
            .collect();
        let domain_distance = 0.2 * model.diagonal() * model.unit;
        let settings = WindSettings { seed, mean_speed, domain_distance, max_frequency };
        Self {
            directions: [downwind, model.up.cross(&downwind)],
            wind: Wind::new(&settings, &positions),
            surfaces: model.domains.iter().map(|domain| Surface::new(model, domain)).collect(),
        }
    }

    /// Per domain: the force in newtons and world axes `time` seconds after the start of the wind. `velocity` returns the
    /// velocity of a domain in m/s.
    pub(crate) fn forces(
        &self,
        model: &Model,
        time: f64,
        velocity: impl Fn(usize) -> Vector3<f64>,
    ) -> Vec<Vector3<f64>> {
        let winds = self.wind.velocities(time);
        let force = |(domain, wind): (usize, crate::wind::WindVelocity)| {
            let air = self.directions[0] * wind.downwind + self.directions[1] * wind.crosswind;
            let relative = air - velocity(domain);
            relative * (relative.norm() * self.surfaces[domain].drag)
        };
        winds.into_iter().take(model.domains.len()).enumerate().map(force).collect()
    }

    /// Adds a force on a domain, in world axes at rest, to loads.
    pub(crate) fn add_to(&self, model: &Model, domain: usize, force: &Vector3<f64>, loads: &mut DomainLoads) {
        let (surface, DomainModel { placement, first_coordinate, .. }) =
            (&self.surfaces[domain], &model.domains[domain]);
        let local_force = placement.linear.transpose() * force;
        for (coordinate, mode) in loads.coordinates[*first_coordinate..].iter_mut().zip(&surface.modes) {
            *coordinate += mode.dot(&local_force);
        }
        loads.wrenches[domain] += crate::wrench::stack(force, &(placement.linear * surface.center).cross(force));
    }
}

impl Surface {
    fn new(model: &Model, domain: &DomainModel) -> Self {
        let samples = domain.surface_samples();
        let mean = |value: &dyn Fn(&Sample) -> Vector3<f64>| {
            samples.iter().map(value).sum::<Vector3<f64>>() / samples.len().max(1) as f64
        };
        let area = domain.area * model.unit.powi(2);
        Self {
            drag: 0.5 * AIR_DENSITY * DRAG_COEFFICIENT * PROJECTED_FRACTION * area,
            center: mean(&|sample| sample.rest_position),
            modes: (0..domain.rank).map(|mode| mean(&|sample| sample.column(mode, domain.rank))).collect(),
        }
    }
}
