//! Free bodies: coupled domains whose root moves and turns by any angle, under forces alone.
//!
//! A root, with everything it carries, has the position c of its center of mass, the rotation R, the velocity u = c' and the
//! angular velocity w in its own axes. In these axes, the joints and modes are those of [`CoupledModes`]. The kinetic
//! energy is that of the shape at rest:
//!
//! ```text
//! T = 1/2 m u^2 + 1/2 w^T J w + w^T B q' + 1/2 q'^T S q'
//! ```
//!
//! with the moments of inertia J about the center of mass, the angular momenta B of the coordinates, and their masses S
//! relative to the center of mass. Deformations are small, so that they do not change J and B, and a spin does not stretch
//! the body. With the angular momentum l = J w + B q' in the axes of the body, the forces f and the moments t,
//!
//! ```text
//! m c'' = f,    l' = l x w + t,    R' = R [w],    S q'' + B^T w' + C q' + K q = U^T f
//! ```
//!
//! A step is the implicit midpoint rule for c, l, q and q', and R' = R cay(dt w) with w in the middle of the step
//! (Austin, Krishnaprasad and Wang, "Almost Poisson integration of rigid body systems", 1993). Without forces it
//! conserves the momentum, the angular momentum R l and, without damping, the energy, at any dt.

use nalgebra::{Matrix3, Matrix6, Quaternion, UnitQuaternion, Vector3, Vector6};
use serde::{Deserialize, Serialize};

use super::joints::{JointTree, ReducedLoad};
use super::mass::{Block, assemble_blocks};
use super::{CoupledModes, transport_matrix};
use crate::affine::AffineTransform;
use crate::error::{Error, Result, invalid_input};
use crate::integrator::MotionState;
use crate::loads::DomainLoads;
use crate::model::Model;
use crate::parameters::ModalParameters;
use crate::saved_state::vector_bits;
use crate::wrench::{split, stack};

/// The smallest principal moment of inertia of a free body, as a fraction of the largest one. A thinner rod could spin
/// about its axis without energy.
const MIN_MOMENT_RATIO: f64 = 1e-9;

/// Maximum number of Newton iterations for the angular velocity in the middle of a step, and of step lengths of one
/// iteration.
const MAX_ITERATIONS: u32 = 100;
const MAX_STEP_LENGTHS: i32 = 30;

/// Limit on the residual of the angular velocity, as a fraction of its terms.
const TOLERANCE: f64 = 1e-14;

/// A residual that rounding errors leave. It is accepted if no step length reduces it.
const ROUNDING_TOLERANCE: f64 = 1e-10;

/// The equations of motion of free bodies.
pub struct FreeModes {
    modes: CoupledModes,
    /// One per root.
    bodies: Vec<FreeBody>,
    /// Per body of the tree: the index of its root.
    roots: Vec<usize>,
}

/// A root with everything it carries, at rest.
#[derive(Debug, Clone)]
struct FreeBody {
    name: String,
    mass: f64,
    /// The center of mass and the origin of the root's frame.
    center: Vector3<f64>,
    origin: Vector3<f64>,
    /// J.
    moments: Matrix3<f64>,
    /// Inverse of the inertia about the center of mass in a step, with the responses of all coordinates.
    step_response: Matrix6<f64>,
    /// The inverse of m and J.
    compliance: Matrix6<f64>,
    /// The coordinates of the body, each with its momentum and its angular momentum about the center of mass.
    momenta: Vec<(usize, Vector6<f64>)>,
}

/// The motion of all free bodies of a scene.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FreeState {
    pub motion: MotionState,
    /// One per root.
    pub bodies: Vec<RigidState>,
}

/// The rigid motion of a body.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RigidState {
    /// The displacement of the center of mass from rest, its velocity, the rotation as a quaternion (x, y, z, w), and the
    /// angular velocity in the axes of the body.
    #[serde(with = "vector_bits")]
    numbers: nalgebra::DVector<f64>,
}

/// Forces on free bodies, which are constant in the axes of the bodies during a step.
#[derive(Debug, Clone, PartialEq)]
pub struct FreeLoad {
    reduced: ReducedLoad,
}

impl RigidState {
    pub(super) fn new(
        displacement: &Vector3<f64>,
        velocity: &Vector3<f64>,
        rotation: &UnitQuaternion<f64>,
        angular_velocity: &Vector3<f64>,
    ) -> Self {
        let numbers = displacement.iter().chain(velocity).chain(rotation.coords.iter()).chain(angular_velocity);
        Self { numbers: nalgebra::DVector::from_iterator(13, numbers.copied()) }
    }

    /// A body at rest.
    fn resting() -> Self {
        let zero = Vector3::zeros();
        Self::new(&zero, &zero, &UnitQuaternion::identity(), &zero)
    }

    fn vector(&self, start: usize) -> Vector3<f64> {
        self.numbers.fixed_rows::<3>(start).into_owned()
    }

    /// The displacement of the center of mass from rest, in world axes.
    pub fn displacement(&self) -> Vector3<f64> {
        self.vector(0)
    }

    /// The velocity of the center of mass, in world axes.
    pub fn velocity(&self) -> Vector3<f64> {
        self.vector(3)
    }

    /// From the axes of the body, which are the world axes at rest, to the world axes.
    pub fn rotation(&self) -> UnitQuaternion<f64> {
        let [x, y, z, w] = [6, 7, 8, 9].map(|index| self.numbers[index]);
        UnitQuaternion::new_unchecked(Quaternion::new(w, x, y, z))
    }

    /// In the axes of the body.
    pub fn angular_velocity(&self) -> Vector3<f64> {
        self.vector(10)
    }

    /// Whether all numbers are finite.
    pub fn is_finite(&self) -> bool {
        self.numbers.iter().all(|number| number.is_finite())
    }
}

impl FreeModes {
    /// Factors the equations of steps of `dt` seconds.
    ///
    /// # Errors
    /// `Invalid` if a root has no mass or no moment of inertia about some axis; if a domain shares coordinates without
    /// moving with the domain that has them; or as for [`CoupledModes::new`].
    pub fn new(model: &Model, parameters: &ModalParameters, dt: f64) -> Result<Self> {
        let modes = CoupledModes::new(model, parameters, dt)?;
        let tree = &modes.tree;
        check_frames(model, tree)?;
        let blocks = assemble_blocks(model, tree)?;
        let responses: Vec<ReducedLoad> = (0..6).map(|motion| rigid_momenta(tree, &blocks, motion)).collect();
        let roots = tree.roots();
        let body = |root: usize| {
            let domain = tree.frames.iter().position(|frame| frame.body == root);
            let Some(domain) = domain.map(|domain| &model.domains[domain]) else {
                return Err(invalid_input("root", "a domain", "none"));
            };
            let inertia = Matrix6::from_fn(|row, column| responses[column].roots[root][row]);
            let momentum_of = |index: usize| Vector6::from_fn(|row, _| responses[row].coordinates[index]);
            let of_body = |body: usize| {
                tree.bodies[body].first_coordinate..tree.bodies[body].first_coordinate + tree.bodies[body].rank
            };
            let coordinates = (0..tree.bodies.len()).filter(|body| roots[*body] == root).flat_map(of_body);
            let momenta = coordinates.map(|index| (index, momentum_of(index))).collect();
            FreeBody::new(&domain.name, &domain.placement.translation, &inertia, &modes.root_inertias[root], momenta)
        };
        let bodies = (0..tree.root_count()).map(body).collect::<Result<_>>()?;
        Ok(Self { bodies, roots, modes })
    }

    /// The joints of the scene.
    pub const fn joints(&self) -> &JointTree {
        &self.modes.tree
    }

    /// The number of free bodies.
    pub fn body_count(&self) -> usize {
        self.bodies.len()
    }

    /// The name of the root of a free body.
    pub fn name(&self, body: usize) -> &str {
        &self.bodies[body].name
    }

    /// The index of the free body that a domain belongs to.
    pub fn body_of(&self, domain: usize) -> usize {
        self.roots[self.modes.tree.frames[domain].body]
    }

    /// The center of mass of a free body at rest.
    pub fn center(&self, body: usize) -> Vector3<f64> {
        self.bodies[body].center
    }

    /// The state at rest.
    pub fn at_rest(&self) -> FreeState {
        let count = self.modes.modes.len();
        FreeState {
            motion: MotionState::resting(nalgebra::DVector::zeros(count)),
            bodies: vec![RigidState::resting(); self.bodies.len()],
        }
    }

    /// Checks a state that was read from a checkpoint.
    ///
    /// # Errors
    /// `Invalid` if it has other numbers of coordinates or bodies, or a number is not finite.
    pub fn check(&self, state: &FreeState) -> Result<()> {
        state.motion.check(self.modes.modes.len())?;
        if state.bodies.len() != self.bodies.len() {
            return Err(invalid_input("state.bodies", self.bodies.len(), state.bodies.len()));
        }
        state.bodies.iter().try_for_each(|body| crate::saved_state::check_vector("bodies", &body.numbers, 13))
    }

    /// Returns a body to rest, with its coordinates.
    pub fn reset(&self, state: &mut FreeState, body: usize) {
        state.bodies[body] = RigidState::resting();
        for (index, _) in &self.bodies[body].momenta {
            (state.motion.q[*index], state.motion.v[*index]) = (0.0, 0.0);
        }
    }

    /// The rotation of each body in the middle of the next step, if its angular velocity stays as it is.
    pub fn middle_rotations(&self, state: &FreeState) -> Vec<UnitQuaternion<f64>> {
        let middle = |body: &RigidState| body.rotation() * cayley(&(body.angular_velocity() * (0.5 * self.modes.dt)));
        state.bodies.iter().map(middle).collect()
    }

    /// The effect of loads, whose wrenches are in the axes of the bodies.
    pub fn reduce(&self, loads: &DomainLoads) -> FreeLoad {
        FreeLoad { reduced: self.modes.tree.reduce_to_roots(loads) }
    }

    /// The forces of a load that deform the bodies: without those that accelerate them as a whole (inertia relief).
    pub fn deforming_forces(&self, load: &FreeLoad) -> Vec<f64> {
        let mut forces = load.reduced.coordinates.clone();
        for (body, wrench) in self.bodies.iter().zip(&load.reduced.roots) {
            let acceleration = body.compliance * body.at_center(wrench);
            for (index, momentum) in &body.momenta {
                forces[*index] -= momentum.dot(&acceleration);
            }
        }
        forces
    }

    /// Advances a state by one step under a load. An error leaves the state as it is.
    ///
    /// # Errors
    /// `NotConverged` if a body spins so fast that its equations have no solution that Newton's method finds.
    pub fn advance(&self, state: &mut FreeState, load: &FreeLoad) -> Result<()> {
        let ReducedLoad { coordinates, roots } = &load.reduced;
        let mut accelerations = self.modes.right_side(&state.motion, |index| coordinates[index]);
        let mut steps = vec![];
        self.modes.solve(&mut accelerations, |frames| {
            for ((body, frame), (wrench, rigid)) in self.bodies.iter().zip(frames).zip(roots.iter().zip(&state.bodies))
            {
                let angular_momentum = body.angular_momentum(rigid, state.motion.v.as_slice());
                let step = body.solve_step(&(*frame + wrench), wrench, rigid, &angular_momentum, self.modes.dt)?;
                *frame = transport_matrix(&(body.origin - body.center)) * step.acceleration;
                steps.push(step);
            }
            Ok(())
        })?;
        self.modes.add_step(&mut state.motion, &accelerations);
        for ((body, rigid), step) in self.bodies.iter().zip(&mut state.bodies).zip(&steps) {
            *rigid = body.advanced(rigid, step, self.modes.dt);
        }
        Ok(())
    }

    /// Per body: the motion from rest to the present that its material has without deformation.
    pub fn world_from_rest(&self, state: &FreeState) -> Vec<AffineTransform> {
        let motion = |(body, rigid): (&FreeBody, &RigidState)| {
            let rotation = rigid.rotation().to_rotation_matrix().into_inner();
            // The frame moves so that the center of mass stays where it is while the body deforms.
            let momentum: Vector3<f64> =
                body.momenta.iter().map(|(index, momentum)| momentum.fixed_rows::<3>(0) * state.motion.q[*index]).sum();
            let center = body.center + rigid.displacement() - rotation * (momentum / body.mass);
            AffineTransform { linear: rotation, translation: center - rotation * body.center }
        };
        self.bodies.iter().zip(&state.bodies).map(motion).collect()
    }

    /// Momentum, and angular momentum about the world's origin, of all bodies, in world axes.
    pub fn momentum(&self, state: &FreeState) -> Vector6<f64> {
        let of_body = |(body, rigid): (&FreeBody, &RigidState)| {
            let momentum = rigid.velocity() * body.mass;
            let own = rigid.rotation() * body.angular_momentum(rigid, state.motion.v.as_slice());
            stack(&momentum, &(own + (body.center + rigid.displacement()).cross(&momentum)))
        };
        self.bodies.iter().zip(&state.bodies).map(of_body).sum()
    }

    /// The kinetic and elastic energy of all bodies.
    pub fn energy(&self, model: &Model, state: &FreeState) -> f64 {
        let v = state.motion.v.as_slice();
        let root_motion = |(body, rigid): (&FreeBody, &RigidState)| {
            // The velocity of the center of mass at rest without that of the deformation.
            let rotation = rigid.rotation().inverse();
            let momentum: Vector3<f64> =
                body.momenta.iter().map(|(index, momentum)| momentum.fixed_rows::<3>(0) * v[*index]).sum();
            let velocity = rotation * rigid.velocity() - momentum / body.mass;
            transport_matrix(&(body.origin - body.center)) * stack(&velocity, &rigid.angular_velocity())
        };
        let roots: Vec<Vector6<f64>> = self.bodies.iter().zip(&state.bodies).map(root_motion).collect();
        let frames = self.modes.tree.frame_motions_from(&roots, v);
        self.modes.energy_with_frames(model, &state.motion, &frames)
    }
}

/// The accelerations of a body in a step.
#[derive(Debug, Clone, Copy)]
struct RigidStep {
    /// Of the material at the center of mass and of the rotation, in the axes of the body.
    acceleration: Vector6<f64>,
    /// Of the center of mass, in the axes of the body.
    center_acceleration: Vector3<f64>,
    /// The angular velocity in the middle of the step.
    angular_velocity: Vector3<f64>,
}

impl FreeBody {
    fn new(
        name: &str,
        origin: &Vector3<f64>,
        inertia: &Matrix6<f64>,
        step_inertia: &Matrix6<f64>,
        momenta: Vec<(usize, Vector6<f64>)>,
    ) -> Result<Self> {
        let mass = inertia[(0, 0)];
        let invalid = |given: String| {
            let field = format!("inertia of '{name}' with all that it carries, which is free");
            let expected = "a positive mass, and positive moments of inertia about all axes";
            Err(invalid_input(field, expected, given))
        };
        let has_mass = mass.is_finite() && mass > 0.0;
        if !has_mass {
            return invalid(format!("a mass of {mass} kg"));
        }
        // m c x v is the angular momentum of a translation.
        let moment = inertia.fixed_view::<3, 3>(3, 0) / mass;
        let offset = Vector3::new(moment[(2, 1)], moment[(0, 2)], moment[(1, 0)]);
        let at_center = |inertia: &Matrix6<f64>| {
            let origin_from_center = transport_matrix(&-offset);
            origin_from_center.transpose() * inertia * origin_from_center
        };
        let moments: Matrix3<f64> = at_center(inertia).fixed_view::<3, 3>(3, 3).into_owned();
        let principal = moments.symmetric_eigenvalues();
        let has_moments = principal.min() > MIN_MOMENT_RATIO * principal.max() && principal.max().is_finite();
        if !has_moments {
            let [a, b, c]: [f64; 3] = principal.into();
            return invalid(format!("principal moments of {a:.3e}, {b:.3e} and {c:.3e}"));
        }
        let mut rigid = Matrix6::identity() * mass;
        rigid.fixed_view_mut::<3, 3>(3, 3).copy_from(&moments);
        let (Some(step_response), Some(compliance)) = (at_center(step_inertia).try_inverse(), rigid.try_inverse())
        else {
            return invalid("a matrix of masses without an inverse".to_owned());
        };
        let mut body = Self {
            name: name.into(),
            mass,
            center: origin + offset,
            origin: *origin,
            moments,
            step_response,
            compliance,
            momenta,
        };
        let momenta = std::mem::take(&mut body.momenta).into_iter();
        body.momenta = momenta.map(|(index, momentum)| (index, body.at_center(&momentum))).collect();
        Ok(body)
    }

    /// A wrench about the origin of the frame, about the center of mass.
    fn at_center(&self, wrench: &Vector6<f64>) -> Vector6<f64> {
        let (force, moment) = split(wrench);
        stack(&force, &(moment - (self.center - self.origin).cross(&force)))
    }

    /// l, in the axes of the body.
    fn angular_momentum(&self, rigid: &RigidState, velocities: &[f64]) -> Vector3<f64> {
        let rotation = self.moments * rigid.angular_velocity();
        let modal = self.momenta.iter().map(|(index, momentum)| momentum.fixed_rows::<3>(3) * velocities[*index]);
        modal.fold(rotation, |sum, momentum| sum + momentum)
    }

    /// Solves a step. `eliminated` is the wrench about the origin with the responses of the coordinates, and `external` is
    /// that of the forces alone, both in the axes of the body.
    ///
    /// The unknown is the angular velocity w in the middle of the step. The angular momentum there solves
    /// (I + dt/2 [w]) l = l0 + dt/2 t, so that the gyroscopic moment l x w has the derivative (I + dt/2 [w])^-1 [l].
    fn solve_step(
        &self,
        eliminated: &Vector6<f64>,
        external: &Vector6<f64>,
        rigid: &RigidState,
        angular_momentum: &Vector3<f64>,
        dt: f64,
    ) -> Result<RigidStep> {
        let external = self.at_center(external);
        let free = self.step_response * self.at_center(eliminated);
        let response = self.step_response.fixed_view::<3, 3>(3, 3).into_owned();
        let (start, h) = (rigid.angular_velocity(), 0.5 * dt);
        let middle_momentum = angular_momentum + split(&external).1 * h;
        let evaluate = |w: &Vector3<f64>| {
            let inverse = (Matrix3::identity() + w.cross_matrix() * h).try_inverse().unwrap_or_else(Matrix3::zeros);
            let l = inverse * middle_momentum;
            let gyroscopic = l.cross(w);
            let terms = [*w, -start, -split(&free).1 * h, -(response * gyroscopic) * h];
            let scale: f64 = terms.iter().map(Vector3::norm).sum();
            let residual: Vector3<f64> = terms.iter().sum();
            let jacobian = Matrix3::identity() - response * inverse * l.cross_matrix() * h;
            (residual, scale, jacobian, gyroscopic)
        };
        let newton = |guess: Vector3<f64>| {
            let mut w = guess;
            let mut current = evaluate(&w);
            for _ in 0..MAX_ITERATIONS {
                let (residual, scale, jacobian, _) = current;
                if residual.norm() <= TOLERANCE * scale {
                    break;
                }
                let Some(direction) = jacobian.try_inverse().map(|inverse| -(inverse * residual)) else { break };
                let mut shorter = (0..MAX_STEP_LENGTHS).map(|halvings| {
                    let candidate = w + direction * 0.5_f64.powi(halvings);
                    (candidate, evaluate(&candidate))
                });
                let better = shorter.find(|(_, (shorter, ..))| shorter.norm() < residual.norm());
                let Some((candidate, evaluation)) = better else { break };
                (w, current) = (candidate, evaluation);
            }
            let (residual, scale, _, gyroscopic) = current;
            (w, gyroscopic, if scale > 0.0 { residual.norm() / scale } else { 0.0 })
        };
        let is_solution = |residual: f64| residual <= ROUNDING_TOLERANCE;
        let mut best = newton(start);
        if !is_solution(best.2) {
            // The gyroscopic moment does no work, so that solutions are on an ellipsoid through 0 and the solution without
            // this moment. For large steps they approach the principal axes.
            let without = start + split(&free).1 * h;
            let axes = response.symmetric_eigen().eigenvectors;
            let on_axis = |axis: usize| axes.column(axis) * axes.column(axis).dot(&without);
            let guesses = [without, 0.5 * without, on_axis(0), on_axis(1), on_axis(2)];
            let solution = guesses.into_iter().map(newton).find(|(_, _, residual)| is_solution(*residual));
            best = solution.unwrap_or(best);
        }
        let (w, gyroscopic, residual) = best;
        if !is_solution(residual) {
            return Err(Error::NotConverged { dt, sub_steps: 1, residual });
        }
        let acceleration = free + self.step_response * stack(&Vector3::zeros(), &gyroscopic);
        Ok(RigidStep { acceleration, center_acceleration: split(&external).0 / self.mass, angular_velocity: w })
    }

    /// The state after a step.
    fn advanced(&self, rigid: &RigidState, step: &RigidStep, dt: f64) -> RigidState {
        // The forces were turned into the axes of the body by this rotation.
        let middle = rigid.rotation() * cayley(&(rigid.angular_velocity() * (0.5 * dt)));
        let rotation = rigid.rotation() * cayley(&(step.angular_velocity * dt));
        let velocity_change = middle * step.center_acceleration * dt;
        RigidState::new(
            &(rigid.displacement() + (rigid.velocity() + velocity_change * 0.5) * dt),
            &(rigid.velocity() + velocity_change),
            &UnitQuaternion::new_normalize(rotation.into_inner()),
            &(rigid.angular_velocity() + split(&step.acceleration).1 * dt),
        )
    }
}

/// The Cayley transform (I - [v] / 2)^-1 (I + [v] / 2): a rotation about v by 2 atan(|v| / 2).
fn cayley(vector: &Vector3<f64>) -> UnitQuaternion<f64> {
    UnitQuaternion::new_normalize(Quaternion::from_parts(1.0, vector * 0.5))
}

/// The momenta of all coordinates and the wrenches on the roots per unit of one of the six rigid velocities of the
/// roots.
fn rigid_momenta(tree: &JointTree, blocks: &[Block], motion: usize) -> ReducedLoad {
    let mut motions: Vec<Vector6<f64>> = vec![];
    let count = tree.bodies.iter().map(|body| body.rank).sum();
    let mut momenta = vec![0.0; count];
    for (body, block) in tree.bodies.iter().zip(blocks) {
        let velocity = match &body.joint {
            Some(joint) => joint.transport(&motions[joint.body]),
            None => Vector6::ith(motion, 1.0),
        };
        let modal = block.modal_momenta(&velocity);
        momenta[body.first_coordinate..].iter_mut().zip(modal).for_each(|(sum, momentum)| *sum += momentum);
        motions.push(velocity);
    }
    let wrenches = blocks.iter().zip(&motions).map(|(block, velocity)| block.rigid() * velocity).collect();
    tree.sweep_to_roots(momenta, wrenches)
}

/// Checks that every frame moves with the frame of its body.
fn check_frames(model: &Model, tree: &JointTree) -> Result<()> {
    let apart = model.domains.iter().zip(&tree.frames).find(|(_, frame)| !frame.moves_with_body());
    match apart {
        None => Ok(()),
        Some((domain, _)) => {
            let field = format!("domain '{}', which shares coordinates", domain.name);
            Err(invalid_input(
                field,
                "a domain that moves with a deformable part of their body",
                "a rigid part, or none",
            ))
        }
    }
}
