//! Domains that act on each other at joints: linear equations of motion about rest, and their integrator.
//!
//! The material of a domain moves by R X + U q, where X is the small motion of its frame and R are the six rigid motions
//! (`joints`). The frame of a child moves with the section of its parent that carries it, so the inertia of the child
//! loads the parent, and the motion of the parent shakes the child. The frames of roots do not move, so all X are
//! functions of q, and the energy is 1/2 v^T M v + 1/2 q^T K q with the diagonal matrix K of eigenvalues. U are modes
//! with loaded interfaces (Benfield and Hruda 1971): eigenmodes of a domain that carries the rigid inertia of its
//! descendants.
//!
//! A step of dt seconds uses the implicit midpoint rule: with the acceleration a,
//!
//! ```text
//! (M + dt/2 C + dt^2/4 K) a = f - C v - K (q + dt/2 v),    q' = q + dt v + dt^2/2 a,    v' = v + dt a
//! ```
//!
//! It conserves the energy of a free motion without damping at any dt. `mass` factors the matrix once. A step then
//! has one sweep from the leaves to the roots and one back, so its time is proportional to the number of domains.
//!
//! `free` lets the frames of the roots move as well, by any angle.

#[cfg(test)]
mod beam_tests;
mod free;
#[cfg(test)]
mod free_tests;
mod joints;
mod mass;
mod statics;
#[cfg(test)]
pub(crate) mod testing;
#[cfg(test)]
mod tests;

use std::ops::Range;

use nalgebra::{Matrix6, Vector3, Vector6};
use rayon::prelude::*;

use crate::error::{Result, invalid_input};
use crate::integrator::{Integrator, LoadChange, MotionState, StepReport};
use crate::model::{MIN_DOMAINS_PER_THREAD, Model};
use crate::parameters::{ModalParameters, ModeParameters};
pub use free::{FreeLoad, FreeModes, FreeState, RigidState};
use joints::Body;
pub use joints::JointTree;
use mass::{Diagonal, Factor, factor_bodies};
pub use statics::{StaticResponse, StaticSystem};

/// The modes of all domains of a scene, coupled at joints.
pub struct CoupledModes {
    tree: JointTree,
    /// Per body.
    factors: Vec<Factor>,
    /// Per root: the inertia of its frame in a step, with that of everything it carries.
    root_inertias: Vec<Matrix6<f64>>,
    /// Per coordinate; `None` for a mode that is held still.
    modes: Vec<Option<ModeTerms>>,
    dt: f64,
}

/// Stiffness and damping of a coordinate.
#[derive(Debug, Clone, Copy)]
struct ModeTerms {
    /// omega^2.
    stiffness: f64,
    /// 2 zeta omega: the damping ratio holds for the mode of the domain alone.
    damping: f64,
}

/// The bodies of a part of a level with their numbers in a step.
struct LevelPart<'a> {
    first_body: usize,
    /// Forces on the coordinates of the bodies, then accelerations.
    coordinates: &'a mut [f64],
    /// Per body: the wrench that it passes to its parent, or the acceleration of its frame.
    frames: &'a mut [Vector6<f64>],
}

impl CoupledModes {
    /// Factors the equations of steps of `dt` seconds.
    ///
    /// # Errors
    /// `Invalid` if `dt` is not positive and finite; if a domain shares coordinates, but moves with a domain that has
    /// others; or if the mass properties of a domain are invalid.
    pub fn new(model: &Model, parameters: &ModalParameters, dt: f64) -> Result<Self> {
        if !(dt.is_finite() && dt > 0.0) {
            return Err(invalid_input("dt", "a positive number of seconds", dt));
        }
        let tree = JointTree::new(model)?;
        let terms = |mode: &ModeParameters| {
            let ModeParameters { eigenvalue, damping_ratio } = *mode;
            ModeTerms { stiffness: eigenvalue, damping: 2.0 * damping_ratio * eigenvalue.sqrt() }
        };
        let modes: Vec<Option<ModeTerms>> = parameters.modes.iter().map(|mode| mode.as_ref().map(terms)).collect();
        let diagonal_term = |mode: &ModeTerms| 0.5 * dt * mode.damping + 0.25 * dt * dt * mode.stiffness;
        let diagonal: Vec<Diagonal> = modes.iter().map(|mode| mode.as_ref().map(diagonal_term)).collect();
        let (factors, root_inertias) = factor_bodies(model, &tree, &diagonal)?;
        Ok(Self { tree, factors, root_inertias, modes, dt })
    }

    /// The joints of the scene.
    pub const fn joints(&self) -> &JointTree {
        &self.tree
    }

    /// The kinetic and elastic energy of a state.
    pub fn energy(&self, model: &Model, state: &MotionState) -> f64 {
        self.energy_with_frames(model, state, &self.tree.frame_motions(state.v.as_slice()))
    }

    /// As [`Self::energy`]. `frames` has the motion of the frame of each domain per second.
    fn energy_with_frames(&self, model: &Model, state: &MotionState, frames: &[Vector6<f64>]) -> f64 {
        let velocities = state.v.as_slice();
        let kinetic = model.domains.iter().zip(frames);
        let kinetic = kinetic.map(|(domain, frame)| domain.kinetic_energy(frame, domain.q(velocities)));
        let elastic = |(q, mode): (&f64, &Option<ModeTerms>)| mode.map_or(0.0, |mode| 0.5 * mode.stiffness * q * q);
        kinetic.sum::<f64>() + state.q.iter().zip(&self.modes).map(elastic).sum::<f64>()
    }

    /// The indices of all coordinates: in the order of bodies, and in the scene.
    fn coordinates(&self) -> impl Iterator<Item = (usize, usize)> + '_ {
        let bodies = self.tree.bodies.iter();
        bodies.flat_map(|body| (0..body.rank).map(|mode| (body.offset + mode, body.first_coordinate + mode)))
    }

    /// The right side of the equations of a step, in the order of bodies. `force` is the mean force on a coordinate.
    fn right_side(&self, state: &MotionState, force: impl Fn(usize) -> f64) -> Vec<f64> {
        let mut forces = vec![0.0; state.q.len()];
        for (position, index) in self.coordinates() {
            let Some(ModeTerms { stiffness, damping }) = self.modes[index] else { continue };
            let (q, v) = (state.q[index], state.v[index]);
            forces[position] = force(index) - damping * v - stiffness * (q + 0.5 * self.dt * v);
        }
        forces
    }

    /// Adds a step of the accelerations, in the order of bodies, to a state.
    fn add_step(&self, state: &mut MotionState, accelerations: &[f64]) {
        for (position, index) in self.coordinates() {
            let velocity_change = self.dt * accelerations[position];
            state.q[index] += self.dt * (state.v[index] + 0.5 * velocity_change);
            state.v[index] += velocity_change;
        }
    }

    /// Solves the equations of a step: replaces the forces on all coordinates, in the order of bodies, by accelerations.
    /// `solve_roots` replaces the wrenches on the frames of the roots by accelerations.
    ///
    /// # Errors
    /// Those of `solve_roots`.
    fn solve(
        &self,
        coordinates: &mut [f64],
        solve_roots: impl FnOnce(&mut [Vector6<f64>]) -> Result<()>,
    ) -> Result<()> {
        let bodies = &self.tree.bodies;
        let end_of = |level: &Range<usize>| bodies[level.end - 1].offset + bodies[level.end - 1].rank;
        // Per body: the wrench that it passes to its parent.
        let mut wrenches = vec![Vector6::zeros(); bodies.len()];
        for level in self.tree.levels.iter().rev() {
            let (level_wrenches, child_wrenches) = wrenches.split_at_mut(level.end);
            let level_coordinates = &mut coordinates[bodies[level.start].offset..end_of(level)];
            let parts = self.split_level(level, level_coordinates, &mut level_wrenches[level.start..]);
            run_parts(parts, |part| self.eliminate(part, level.end, child_wrenches));
        }
        // Per body: the acceleration of its frame.
        let mut accelerations = wrenches;
        let root_count = self.tree.levels.first().map_or(0, Range::len);
        solve_roots(&mut accelerations[..root_count])?;
        for level in &self.tree.levels {
            let (parent_accelerations, level_accelerations) = accelerations.split_at_mut(level.start);
            let (parent_coordinates, level_coordinates) = coordinates.split_at_mut(bodies[level.start].offset);
            let level_coordinates = &mut level_coordinates[..end_of(level) - parent_coordinates.len()];
            let parts = self.split_level(level, level_coordinates, &mut level_accelerations[..level.len()]);
            run_parts(parts, |part| self.substitute(part, parent_coordinates, parent_accelerations));
        }
        Ok(())
    }

    /// Splits a level, so that a thread gets at least `MIN_DOMAINS_PER_THREAD` bodies.
    fn split_level<'a>(
        &self,
        level: &Range<usize>,
        mut coordinates: &'a mut [f64],
        frames: &'a mut [Vector6<f64>],
    ) -> Vec<LevelPart<'a>> {
        let mut parts = vec![];
        let mut first_body = level.start;
        for frames in frames.chunks_mut(MIN_DOMAINS_PER_THREAD) {
            let bodies = &self.tree.bodies[first_body..first_body + frames.len()];
            let count = bodies.iter().map(|body| body.rank).sum();
            let (part_coordinates, rest) = std::mem::take(&mut coordinates).split_at_mut(count);
            parts.push(LevelPart { first_body, coordinates: part_coordinates, frames });
            (coordinates, first_body) = (rest, first_body + bodies.len());
        }
        parts
    }

    /// Adds the wrenches of the children of every body, and computes the wrench that the body passes to its parent.
    /// `child_wrenches` begins with the body `first_child`.
    fn eliminate(&self, part: LevelPart<'_>, first_child: usize, child_wrenches: &[Vector6<f64>]) {
        for_each_body(part, &self.tree, &self.factors, |body, factor, forces, frame| {
            let mut wrench = Vector6::zeros();
            for child in body.children.clone() {
                let Some(joint) = &self.tree.bodies[child].joint else { continue };
                let child_wrench = &child_wrenches[child - first_child];
                joint.add_modal_forces(child_wrench, forces);
                wrench += joint.transport_back(child_wrench);
            }
            let responses = forces.iter().zip(&factor.frame_response);
            *frame = responses.fold(wrench, |wrench, (force, response)| wrench - response * *force);
        });
    }

    /// Computes the acceleration of the frame of every body but the roots from those of its parent, and the accelerations
    /// of its coordinates.
    fn substitute(&self, part: LevelPart<'_>, parent_coordinates: &[f64], parent_accelerations: &[Vector6<f64>]) {
        for_each_body(part, &self.tree, &self.factors, |body, factor, forces, frame| {
            if let Some(joint) = &body.joint {
                let parent = &self.tree.bodies[joint.body];
                let parent_coordinates = &parent_coordinates[parent.offset..][..parent.rank];
                *frame = joint.apply(&parent_accelerations[joint.body], parent_coordinates);
            }
            factor.solve(forces);
            for (acceleration, response) in forces.iter_mut().zip(&factor.frame_response) {
                *acceleration -= response.dot(frame);
            }
        });
    }
}

impl Integrator for CoupledModes {
    fn advance(&self, state: &mut MotionState, load: LoadChange<'_>) -> Result<StepReport> {
        let mut accelerations = self.right_side(state, |index| 0.5 * (load.start[index] + load.end[index]));
        self.solve(&mut accelerations, |roots| {
            roots.fill(Vector6::zeros());
            Ok(())
        })?;
        self.add_step(state, &accelerations);
        Ok(StepReport { sub_steps: 1, ..StepReport::default() })
    }

    fn dt(&self) -> f64 {
        self.dt
    }
}

/// The matrix of a rigid motion at `offset` from the point whose motion it multiplies.
fn transport_matrix(offset: &Vector3<f64>) -> Matrix6<f64> {
    let mut matrix = Matrix6::identity();
    matrix.fixed_view_mut::<3, 3>(0, 3).copy_from(&-offset.cross_matrix());
    matrix
}

/// Runs `work` for all bodies of a part with their factors, coordinates and frames.
fn for_each_body(
    part: LevelPart<'_>,
    tree: &JointTree,
    factors: &[Factor],
    work: impl Fn(&Body, &Factor, &mut [f64], &mut Vector6<f64>),
) {
    let LevelPart { first_body, mut coordinates, frames } = part;
    let bodies = tree.bodies[first_body..].iter().zip(&factors[first_body..]);
    for ((body, factor), frame) in bodies.zip(frames) {
        let (body_coordinates, rest) = coordinates.split_at_mut(body.rank);
        work(body, factor, body_coordinates, frame);
        coordinates = rest;
    }
}

/// Runs `work` for all parts of a level, concurrently if there are several.
fn run_parts<'a>(mut parts: Vec<LevelPart<'a>>, work: impl Fn(LevelPart<'a>) + Send + Sync) {
    match parts.pop() {
        Some(part) if parts.is_empty() => work(part),
        Some(part) => {
            parts.push(part);
            parts.into_par_iter().for_each(work);
        }
        None => {}
    }
}
