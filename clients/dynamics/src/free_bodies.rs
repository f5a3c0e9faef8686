//! Bodies that nothing holds: every domain without a parent, with all that it carries, moves and turns under the forces
//! of viewers and of the wind ([`FreeModes`]). There is no gravity, because only changes of load act, and no contact.
//!
//! A force that lasts accelerates a free body without limit, and a body that was pushed does not stop. A body that is
//! farther than [`MAX_DISTANCE`] from its place returns to rest there, and a remark says so.

use nalgebra::{DVector, Vector3};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use crate::affine::AffineTransform;
use crate::attachments::Attachments;
use crate::checkpoint::RunIdentity;
use crate::coupled::{FreeModes, FreeState, StaticSystem};
use crate::drag::Drag;
use crate::error::{Result, check_option, invalid_input};
use crate::hierarchy::compose_transforms;
use crate::integrator::nyquist_remark;
use crate::loads::{DomainLoads, PointForce};
use crate::model::Model;
use crate::parameters::ModalParameters;
use crate::run::{Report, Scenario};
use crate::saved_state::{check_vector, from_json, number_bits, to_json, vector_bits};
use crate::step_values::StepValues;
use crate::viewer_forces::scale_remark;

/// Largest distance of a body's center of mass from its place at rest, in diagonals of the scene's rest bounds.
pub const MAX_DISTANCE: f64 = 5.0;

/// Largest rotation in a step without a remark, in radians: 13 steps per turn.
const MAX_ROTATION: f64 = 0.5;

/// Settings of the scenario.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FreeOptions {
    /// Seconds per step.
    pub dt: f64,
    /// Mean speed of the wind in m/s; 0 for no air.
    pub wind_speed: f64,
    /// Direction that the wind blows to, in radians about the up axis from the first horizontal axis.
    pub direction_radians: f64,
    /// Seed of the turbulence.
    pub seed: u64,
}

/// The scenario of free bodies.
pub struct FreeScenario {
    model: Model,
    options: FreeOptions,
    modes: FreeModes,
    statics: StaticSystem,
    drag: Option<Drag>,
    attachments: Attachments,
    remarks: Vec<String>,
    saved: SavedBodies,
    /// The step that the next call of `compute_next_step` computes.
    next_step: u64,
}

/// The state of a run in a checkpoint.
#[derive(Debug, Clone, Serialize, Deserialize)]
struct SavedBodies {
    state: FreeState,
    viewer_forces: ViewerForces,
    late_remarks: Vec<String>,
    has_scaled_forces: bool,
    has_fast_body: bool,
    /// The number of times that a body returned to rest.
    returns: u64,
    /// Largest distance of a center of mass from its place at rest, in diagonals.
    #[serde(with = "number_bits")]
    peak_distance: f64,
}

/// The forces of viewers in newtons.
#[derive(Debug, Clone, Serialize, Deserialize)]
struct ViewerForces {
    #[serde(with = "vector_bits")]
    coordinates: DVector<f64>,
    /// The domain of each force at a point.
    domains: Vec<usize>,
    /// Per force at a point: the point at rest in the frame of the domain, and the force in world axes.
    #[serde(with = "vector_bits")]
    points: DVector<f64>,
}

impl ViewerForces {
    fn none(model: &Model) -> Self {
        Self { coordinates: DVector::zeros(model.coordinate_count), domains: vec![], points: DVector::zeros(0) }
    }

    /// The forces of loads times a factor.
    fn scaled(loads: &DomainLoads, scale: f64) -> Self {
        // Forces of infinite size have the scale 0.
        let scaled = |force: &f64| if scale > 0.0 { force * scale } else { 0.0 };
        let numbers = |point: &PointForce| {
            let force: Vec<f64> = point.force.iter().map(scaled).collect();
            point.rest_point.iter().copied().chain(force).collect::<Vec<f64>>()
        };
        Self {
            coordinates: DVector::from_iterator(loads.coordinates.len(), loads.coordinates.iter().map(scaled)),
            domains: loads.points.iter().map(|point| point.domain).collect(),
            points: DVector::from_vec(loads.points.iter().flat_map(numbers).collect()),
        }
    }

    fn check(&self, model: &Model) -> Result<()> {
        check_vector("coordinates", &self.coordinates, model.coordinate_count)?;
        check_vector("points", &self.points, 6 * self.domains.len())?;
        match self.domains.iter().find(|domain| **domain >= model.domains.len()) {
            None => Ok(()),
            Some(domain) => {
                Err(invalid_input("state.domains", format!("indices below {}", model.domains.len()), domain))
            }
        }
    }

    fn points(&self) -> impl Iterator<Item = PointForce> + '_ {
        let point = |(domain, numbers): (&usize, &[f64])| PointForce {
            domain: *domain,
            rest_point: Vector3::from_column_slice(&numbers[..3]),
            force: Vector3::from_column_slice(&numbers[3..]),
        };
        self.domains.iter().zip(self.points.as_slice().chunks_exact(6)).map(point)
    }
}

impl FreeOptions {
    fn check(&self) -> Result<()> {
        check_option("dt", self.dt, f64::MIN_POSITIVE..=1e6)?;
        check_option("wind", self.wind_speed, 0.0..=1e6)?;
        check_option("direction", self.direction_radians, -1e6..=1e6)
    }
}

impl FreeScenario {
    /// Creates the scenario at rest.
    ///
    /// # Errors
    /// `Invalid` if an option is out of range, or as for [`FreeModes::new`].
    pub fn new(model: Model, options: FreeOptions) -> Result<Self> {
        options.check()?;
        let parameters = ModalParameters::read(&model)?;
        let modes = FreeModes::new(&model, &parameters, options.dt)?;
        let unresolved_modes = nyquist_remark(parameters.frequencies(&model), options.dt);
        let saved = SavedBodies {
            state: modes.at_rest(),
            viewer_forces: ViewerForces::none(&model),
            late_remarks: vec![],
            has_scaled_forces: false,
            has_fast_body: false,
            returns: 0,
            peak_distance: 0.0,
        };
        Ok(Self {
            statics: StaticSystem::new(&model, &parameters)?,
            drag: (options.wind_speed > 0.0).then(|| {
                Drag::new(&model, options.wind_speed, options.direction_radians, options.seed, 0.5 / options.dt)
            }),
            attachments: Attachments::new(&model),
            remarks: parameters.remarks.iter().cloned().chain(unresolved_modes).collect(),
            options,
            modes,
            saved,
            next_step: 0,
            model,
        })
    }

    /// Per domain: its transform at coordinates `q`.
    fn transforms(&self, q: &[f64]) -> Vec<AffineTransform> {
        let mut attachments = self.attachments.deform(&self.model, q);
        let motions = self.modes.world_from_rest(&self.saved.state);
        let roots = self.model.domains.iter().enumerate().filter(|(_, domain)| domain.carrier().is_none());
        for (index, domain) in roots {
            attachments[index] = motions[self.modes.body_of(index)].compose(&domain.placement);
        }
        compose_transforms(&self.model, &attachments, &[])
    }

    /// The loads of the next step in the axes of the bodies.
    fn loads(&self) -> DomainLoads {
        let SavedBodies { state, viewer_forces, .. } = &self.saved;
        let rotations = self.modes.middle_rotations(state);
        let mut loads = DomainLoads::none(&self.model);
        loads.coordinates.copy_from_slice(viewer_forces.coordinates.as_slice());
        for point in viewer_forces.points() {
            let rotation = rotations[self.modes.body_of(point.domain)].inverse();
            let force = rotation * point.force;
            loads.add_wrench(&self.model, point.domain, &point.rest_point, &force);
        }
        if let Some(drag) = &self.drag {
            let velocity = |domain: usize| state.bodies[self.modes.body_of(domain)].velocity() * self.model.unit;
            let time = self.options.dt * (self.next_step as f64 + 0.5);
            for (domain, force) in drag.forces(&self.model, time, velocity).into_iter().enumerate() {
                let rotation = rotations[self.modes.body_of(domain)].inverse();
                drag.add_to(&self.model, domain, &(rotation * force), &mut loads);
            }
        }
        loads
    }

    /// Advances the state by a step, and returns bodies to rest that are too far away.
    fn advance(&mut self) -> Result<()> {
        let load = self.modes.reduce(&self.loads());
        self.modes.advance(&mut self.saved.state, &load)?;
        for body in 0..self.modes.body_count() {
            self.check_body(body);
        }
        self.next_step += 1;
        Ok(())
    }

    /// Returns a body to rest if it is too far away, and adds remarks.
    fn check_body(&mut self, body: usize) {
        let (step, saved) = (self.next_step + 1, &mut self.saved);
        let rigid = &saved.state.bodies[body];
        let (name, rotation) = (self.modes.name(body), rigid.angular_velocity().norm() * self.options.dt);
        if rotation > MAX_ROTATION && !saved.has_fast_body {
            saved.has_fast_body = true;
            saved.late_remarks.push(format!(
                "step {step}: '{name}' turns by {rotation:.2} radians per step, of which the integrator needs at most \
                 {MAX_ROTATION} for an accurate rotation: choose smaller steps (--dt)"
            ));
        }
        let distance = rigid.displacement().norm() / self.model.diagonal();
        let is_near = rigid.is_finite() && distance <= MAX_DISTANCE;
        if is_near {
            saved.peak_distance = saved.peak_distance.max(distance);
            return;
        }
        if saved.returns == 0 {
            saved.late_remarks.push(format!(
                "step {step}: '{name}', which nothing holds (--free), was {distance:.1} diagonals of the scene from its \
                 place, more than {MAX_DISTANCE}: it returns to rest there; bodies_returned counts such returns"
            ));
        }
        saved.returns += 1;
        self.modes.reset(&mut saved.state, body);
    }
}

impl Scenario for FreeScenario {
    fn model(&self) -> &Model {
        &self.model
    }

    fn identity(&self) -> RunIdentity {
        let FreeOptions { dt: _, wind_speed, direction_radians, seed } = self.options;
        RunIdentity::default()
            .with("motion", "free bodies")
            .with_number("--wind", wind_speed)
            .with_number("--direction (radians)", direction_radians)
            .with("--seed", seed)
    }

    fn save(&self) -> Result<Value> {
        to_json(&self.saved)
    }

    fn restore(&mut self, next_step: u64, state: Value) -> Result<()> {
        let saved: SavedBodies = from_json(state)?;
        self.modes.check(&saved.state)?;
        saved.viewer_forces.check(&self.model)?;
        (self.saved, self.next_step) = (saved, next_step);
        Ok(())
    }

    fn compute_next_step(&mut self, values: &mut StepValues) -> Result<()> {
        values.q = self.saved.state.motion.q.iter().map(|coordinate| *coordinate as f32).collect();
        let q: Vec<f64> = values.q.iter().map(|coordinate| f64::from(*coordinate)).collect();
        values.transforms = self.transforms(&q).iter().map(|transform| transform.to_row_major()).collect();
        self.advance()
    }

    /// Forces that would bend a domain too far are scaled down, with those that accelerate the body as a whole.
    fn set_viewer_forces(&mut self, loads: &DomainLoads) -> Result<()> {
        let load = self.modes.reduce(loads);
        let scale = self.statics.viewer_force_scale(&self.model, &self.modes.deforming_forces(&load));
        self.saved.viewer_forces = ViewerForces::scaled(loads, scale);
        if !self.saved.has_scaled_forces {
            self.saved.late_remarks.extend(scale_remark(scale));
            self.saved.has_scaled_forces = scale < 1.0;
        }
        Ok(())
    }

    fn remarks(&self) -> Vec<String> {
        [&self.remarks[..], &self.saved.late_remarks].concat()
    }

    fn late_remarks(&self) -> &[String] {
        &self.saved.late_remarks
    }

    fn report(&self) -> Report {
        let load = match self.options.wind_speed {
            0.0 => "none but the forces of viewers".to_owned(),
            speed => format!("wind of {speed} m/s relative to the bodies"),
        };
        let speed = |index: usize| self.saved.state.bodies[index].velocity().norm();
        let describe = |index: usize| {
            let rigid = &self.saved.state.bodies[index];
            json!({
                "root": self.modes.name(index),
                "displacement": rigid.displacement().as_slice(),
                "speed": speed(index),
                "radians_per_second": rigid.angular_velocity().norm(),
            })
        };
        // The report lists the first bodies only, so that it stays readable.
        let bodies: Vec<Value> = (0..self.modes.body_count().min(MAX_REPORTED_BODIES)).map(describe).collect();
        Report::from_iter([
            ("load".to_owned(), json!(load)),
            ("free_bodies".to_owned(), json!(self.modes.body_count())),
            ("bodies".to_owned(), json!(bodies)),
            ("bodies_returned".to_owned(), json!(self.saved.returns)),
            ("peak_of_diagonal".to_owned(), json!(self.saved.peak_distance)),
            ("energy".to_owned(), json!(self.modes.energy(&self.model, &self.saved.state))),
        ])
    }
}

/// Maximum number of bodies that a report describes.
const MAX_REPORTED_BODIES: usize = 16;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::coupled::testing::{Branch, create_scene, in_units, random_plant};
    use crate::divergence::DivergenceCheck;
    use crate::wind::AIR_DENSITY;

    const OPTIONS: FreeOptions = FreeOptions { dt: 1.0 / 60.0, wind_speed: 0.0, direction_radians: 0.4, seed: 7 };

    /// A body of 2 kg with three modes.
    fn body() -> Model {
        create_scene(&[Branch { rank: 3, length: 1.0, mass: 2.0, hertz: 3.0 }], &[None], 1)
    }

    fn scenario(model: &Model, options: FreeOptions) -> FreeScenario {
        FreeScenario::new(model.clone(), options).expect("a valid scene")
    }

    /// Advances the scenario, and checks every step as a run does.
    fn advance(scenario: &mut FreeScenario, steps: u64) -> StepValues {
        let (check, mut values) = (DivergenceCheck::new(&scenario.model), StepValues::default());
        for _ in 0..steps {
            let step = scenario.next_step;
            scenario.compute_next_step(&mut values).expect("a step");
            check.check(&scenario.model, step, 0.0, &values).expect("values in range");
        }
        values
    }

    fn pull(model: &Model, domain: usize, force: [f64; 3]) -> DomainLoads {
        let mut loads = DomainLoads::none(model);
        loads.add_force(model, domain, &model.domains[domain].samples[26], &force.into());
        loads
    }

    #[test]
    fn bodies_rest_without_forces() {
        let model = random_plant(9, 1);
        let values = advance(&mut scenario(&model, OPTIONS), 30);
        for (domain, transform) in model.domains.iter().zip(&values.transforms) {
            let expected = domain.placement.to_row_major();
            let error = expected.iter().zip(transform).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            assert!(error <= 1e-6 && values.q.iter().all(|q| *q == 0.0), "{}: {error}", domain.name);
        }
    }

    /// A pull moves and turns the body. After it, the body goes on with a constant velocity.
    #[test]
    fn pull_moves_and_turns_the_body() {
        let model = body();
        let mut free = scenario(&model, OPTIONS);
        free.set_viewer_forces(&pull(&model, 0, [0.5, 0.0, 0.0])).expect("valid forces");
        advance(&mut free, 60);
        let rigid = &free.saved.state.bodies[0];
        // 0.5 N on 2 kg for a second.
        assert!((rigid.velocity() - Vector3::new(0.25, 0.0, 0.0)).norm() <= 1e-9, "{:?}", rigid.velocity());
        assert!(rigid.rotation().angle() > 0.05, "{}", rigid.rotation().angle());
        let (start, velocity) = (rigid.displacement(), rigid.velocity());
        free.set_viewer_forces(&DomainLoads::none(&model)).expect("no forces");
        let values = advance(&mut free, 61);
        let rigid = &free.saved.state.bodies[0];
        assert!((rigid.displacement() - start - velocity * (61.0 / 60.0)).norm() <= 1e-9);
        assert!(values.transforms[0][3].abs() > 0.05, "{:?}", values.transforms);
        assert!(free.saved.late_remarks.is_empty() && free.saved.returns == 0);
    }

    /// 0.5 N on 2 kg for a second, in a scene in millimeters.
    #[test]
    fn pulls_are_in_newtons_whatever_the_unit_of_the_scene() {
        let model = in_units(&body(), 1e-3);
        let mut free = scenario(&model, OPTIONS);
        free.set_viewer_forces(&pull(&model, 0, [0.5, 0.0, 0.0])).expect("valid forces");
        advance(&mut free, 60);
        let velocity = free.saved.state.bodies[0].velocity();
        assert!((velocity - Vector3::new(250.0, 0.0, 0.0)).norm() <= 1e-6, "{velocity}");
        assert!(free.saved.late_remarks.is_empty(), "{:?}", free.saved.late_remarks);
    }

    /// A body that is far away returns to rest with one remark, whatever the force is.
    #[test]
    fn bodies_that_leave_return_to_rest_with_a_remark() {
        for force in [30.0, f64::from(f32::MAX)] {
            let model = body();
            let mut free = scenario(&model, OPTIONS);
            free.set_viewer_forces(&pull(&model, 0, [force, 0.0, 0.0])).expect("valid forces");
            advance(&mut free, 3000);
            assert!(free.saved.returns > 1, "{force} N");
            let returned: Vec<&String> =
                free.late_remarks().iter().filter(|remark| remark.contains("returns to rest")).collect();
            assert!(returned.len() == 1 && returned[0].contains("'branch 0'"), "{:?}", free.late_remarks());
            assert!(free.saved.peak_distance <= MAX_DISTANCE && free.saved.peak_distance > 0.5 * MAX_DISTANCE);
        }
    }

    /// In a steady wind, a body approaches the speed of the air, and never passes the speed of the gusts by far.
    #[test]
    fn wind_carries_bodies_at_most_as_fast_as_the_air() {
        let mut model = body();
        model.domains[0].area = 10.0;
        // The diagonal limits the distance.
        (model.bounds_min, model.bounds_max) = (Vector3::repeat(-1e3), Vector3::repeat(1e3));
        let mut free = scenario(&model, FreeOptions { wind_speed: 5.0, ..OPTIONS });
        advance(&mut free, 1200);
        let downwind = model.horizontal_direction(0.4);
        let speed = free.saved.state.bodies[0].velocity().dot(&downwind);
        assert!((2.0..12.0).contains(&speed), "{speed} m/s");
        // Control: the pressure on a body at rest would have accelerated it to a multiple.
        let pressure_speed = 0.5 * AIR_DENSITY * 0.3 * 10.0 * 25.0 / 2.0 * 20.0;
        assert!(pressure_speed > 30.0 * speed, "{pressure_speed} m/s");
    }

    #[test]
    fn fast_spins_have_a_remark() {
        // Without modes, no force is scaled.
        let model = create_scene(&[Branch { rank: 0, length: 1.0, mass: 2.0, hertz: 3.0 }], &[None], 1);
        let mut free = scenario(&model, OPTIONS);
        let mut loads = DomainLoads::none(&model);
        // Two opposite forces that turn the body.
        for (sample, force) in [(24, 500.0), (27, -500.0)] {
            loads.add_force(&model, 0, &model.domains[0].samples[sample], &Vector3::new(0.0, 0.0, force));
        }
        free.set_viewer_forces(&loads).expect("valid forces");
        advance(&mut free, 60);
        assert!(
            free.late_remarks().iter().any(|remark| remark.contains("radians per step")),
            "{:?} {:?}",
            free.remarks(),
            free.saved.state
        );
    }

    /// A run that continues from a checkpoint computes the same bits.
    #[test]
    fn continued_runs_have_the_same_bits() {
        let model = random_plant(9, 4);
        let options = FreeOptions { wind_speed: 2.0, ..OPTIONS };
        let mut whole = scenario(&model, options);
        whole.set_viewer_forces(&pull(&model, 8, [0.02, 0.01, 0.0])).expect("valid forces");
        advance(&mut whole, 40);
        let text = whole.save().expect("a state").to_string();
        let mut continued = scenario(&model, options);
        continued.restore(40, serde_json::from_str(&text).expect("JSON")).expect("a valid state");
        let bits = |values: &StepValues| {
            let numbers = values.q.iter().chain(values.transforms.iter().flatten());
            numbers.map(|number| number.to_bits()).collect::<Vec<u32>>()
        };
        assert_eq!(bits(&advance(&mut whole, 50)), bits(&advance(&mut continued, 50)));
        let mut other = scenario(&body(), options);
        assert!(other.restore(40, serde_json::from_str(&text).expect("JSON")).is_err(), "control");
    }
}
