//! The drag of the wind on a scene: 1/2 rho Cd A |v| v on the surface of every domain.

use nalgebra::Vector3;

use crate::loads::DomainLoads;
use crate::model::{DomainModel, Model};
use crate::wind::{Wind, WindPressure, WindSettings};

/// Cd of plates and of cylinders at a right angle to the wind (Hoerner 1965).
pub(crate) const DRAG_COEFFICIENT: f64 = 1.2;

/// A, the area that the wind sees, as a fraction of the surface area: that of a convex body on the average over all
/// directions (Cauchy 1841).
pub(crate) const PROJECTED_FRACTION: f64 = 0.25;

/// The typical distance between two domains as a fraction of the diagonal of the scene's bounds.
const DISTANCE_FRACTION: f64 = 0.2;

/// Settings of the wind on a scene.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct WindOptions {
    /// In m/s.
    pub(super) mean_speed: f64,
    /// The direction that the wind blows to, in radians about the up axis from the first horizontal axis.
    pub(super) direction_radians: f64,
    pub(super) seed: u64,
    /// Highest frequency of gusts, in hertz.
    pub(super) max_frequency: f64,
}

/// The wind on a scene.
pub(super) struct WindExcitation {
    /// Horizontal unit vectors: the direction that the wind blows to, and one at a right angle to it.
    directions: [Vector3<f64>; 2],
    wind: Wind,
    /// Per domain.
    surfaces: Vec<DragSurface>,
}

/// The surface of a domain: its drag per unit of pressure.
struct DragSurface {
    /// Cd A, in square meters.
    drag_area: f64,
    /// From the origin of the domain to the mean of its surface samples, in world axes and scene units.
    center: Vector3<f64>,
    /// Per mode and direction of the wind: U^T times the drag, in square meters times scene units per unit of q.
    modes: Vec<[f64; 2]>,
}

impl WindExcitation {
    pub(super) fn new(model: &Model, options: &WindOptions) -> Self {
        let downwind = model.horizontal_direction(options.direction_radians);
        let directions = [downwind, model.up.cross(&downwind)];
        let surfaces: Vec<DragSurface> =
            model.domains.iter().map(|domain| DragSurface::new(model, domain, &directions)).collect();
        let position = |(domain, surface): (&DomainModel, &DragSurface)| {
            (domain.placement.translation + surface.center - model.bounds_min).dot(&downwind) * model.unit
        };
        let positions: Vec<f64> = model.domains.iter().zip(&surfaces).map(position).collect();
        let settings = WindSettings {
            seed: options.seed,
            mean_speed: options.mean_speed,
            domain_distance: DISTANCE_FRACTION * model.diagonal() * model.unit,
            max_frequency: options.max_frequency,
        };
        Self { directions, wind: Wind::new(&settings, &positions), surfaces }
    }

    /// The forces on all domains `time` seconds after the start of the wind.
    pub(super) fn loads(&self, model: &Model, time: f64) -> DomainLoads {
        self.loads_of(model, self.wind.pressures(time))
    }

    /// The forces on all domains under the same pressure along the wind, in pascals.
    pub(super) fn steady_loads(&self, model: &Model, downwind: f64) -> DomainLoads {
        self.loads_of(model, vec![WindPressure { downwind, crosswind: 0.0 }; model.domains.len()])
    }

    /// The forces under one pressure per domain.
    fn loads_of(&self, model: &Model, pressures: Vec<WindPressure>) -> DomainLoads {
        let mut loads = DomainLoads::none(model);
        let domains = model.domains.iter().zip(&self.surfaces).zip(pressures);
        for (((domain, surface), pressure), wrench) in domains.zip(&mut loads.wrenches) {
            let WindPressure { downwind, crosswind } = pressure;
            let force = (self.directions[0] * downwind + self.directions[1] * crosswind) * surface.drag_area;
            *wrench = crate::wrench::stack(&force, &surface.center.cross(&force));
            let coordinates = &mut loads.coordinates[domain.first_coordinate..][..domain.rank];
            for (coordinate, [along, across]) in coordinates.iter_mut().zip(&surface.modes) {
                *coordinate += downwind * along + crosswind * across;
            }
        }
        loads
    }
}

impl DragSurface {
    fn new(model: &Model, domain: &DomainModel, directions: &[Vector3<f64>; 2]) -> Self {
        let samples = domain.surface_samples();
        let count = samples.len().max(1) as f64;
        let drag_area = DRAG_COEFFICIENT * PROJECTED_FRACTION * domain.area * model.unit.powi(2);
        let local_directions = directions.map(|direction| domain.placement.linear.transpose() * direction);
        let mode = |mode: usize| {
            let mean = samples.iter().map(|sample| sample.column(mode, domain.rank)).sum::<Vector3<f64>>() / count;
            local_directions.map(|direction| drag_area * mean.dot(&direction))
        };
        let center = samples.iter().map(|sample| sample.rest_position).sum::<Vector3<f64>>() / count;
        Self { drag_area, center: domain.placement.linear * center, modes: (0..domain.rank).map(mode).collect() }
    }
}
