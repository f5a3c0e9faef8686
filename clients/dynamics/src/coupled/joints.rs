//! Kinematics of joints, linear about rest: the small rigid motion of every domain's frame as a function of q.
//!
//! A motion X of a frame has six numbers in world axes at rest: the translation of the frame's origin, and the rotation
//! vector. The frame of a child c on a parent p moves by X_c = G X_p + H q_p. G is the rigid transport between the
//! origins, and H is the best-fit motion of the parent's attachment vertices
//! ([`joint_modes`](crate::attachments::joint_modes)). The frame of a root does not move.

use std::collections::BTreeMap;
use std::ops::Range;

use nalgebra::{Matrix6, Vector3, Vector6};

use super::transport_matrix;
use crate::attachments::joint_modes;
use crate::error::{Result, invalid_input};
use crate::loads::DomainLoads;
use crate::model::{DomainModel, Model, Sample};
use crate::wrench::{split, stack};

/// The motion of a frame: G X + H q with the motion X and the coordinates q of a body.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct FrameMotion {
    /// Index of the body.
    pub(super) body: usize,
    /// From the origin of the body to the origin of the frame, in world axes at rest; it defines G. `None` if the frame
    /// does not move with the body: G = 0.
    offset: Option<Vector3<f64>>,
    /// The columns of H. Empty for H = 0.
    pub(super) modes: Vec<Vector6<f64>>,
}

/// The domains that have one set of coordinates: a domain, and the domains that share its coordinates. Their frames
/// move as functions of the first domain's frame and of these coordinates.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Body {
    pub(super) first_coordinate: usize,
    pub(super) rank: usize,
    /// Motion of the body's frame with another body. `None` for a root.
    pub(super) joint: Option<FrameMotion>,
    /// The bodies that are attached to this one.
    pub(super) children: Range<usize>,
    /// Index of the first coordinate in a vector of all coordinates in the order of bodies.
    pub(super) offset: usize,
}

/// All bodies of a scene and the joints between them.
#[derive(Debug, Clone, PartialEq)]
pub struct JointTree {
    /// In the order of their depth, so that the children of a body are neighbors.
    pub(super) bodies: Vec<Body>,
    /// The bodies of every depth.
    pub(super) levels: Vec<Range<usize>>,
    /// Per domain: the motion of its frame.
    pub(super) frames: Vec<FrameMotion>,
    /// The force in kg scene units/s^2 of a newton.
    newton: f64,
}

/// Forces on the coordinates of a scene, and wrenches on the frames of its roots, in the units of the equations of motion:
/// kilograms, scene units and seconds.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct ReducedLoad {
    pub(super) coordinates: Vec<f64>,
    pub(super) roots: Vec<Vector6<f64>>,
}

impl FrameMotion {
    /// The frame of the body itself.
    const fn of_body(body: usize) -> Self {
        Self { body, offset: Some(Vector3::new(0.0, 0.0, 0.0)), modes: vec![] }
    }

    /// Whether the frame moves with that of its body.
    pub(super) const fn moves_with_body(&self) -> bool {
        self.offset.is_some()
    }

    /// The motion G X.
    pub(super) fn transport(&self, motion: &Vector6<f64>) -> Vector6<f64> {
        self.offset.map_or_else(Vector6::zeros, |offset| transport(motion, &offset))
    }

    /// The motion G X + H q.
    pub(super) fn apply(&self, motion: &Vector6<f64>, q: &[f64]) -> Vector6<f64> {
        self.modes.iter().zip(q).fold(self.transport(motion), |sum, (mode, q)| sum + mode * *q)
    }

    /// G^T p for a wrench p on the frame: the wrench on the body.
    pub(super) fn transport_back(&self, wrench: &Vector6<f64>) -> Vector6<f64> {
        let Some(offset) = self.offset else { return Vector6::zeros() };
        let (force, moment) = split(wrench);
        stack(&force, &(moment + offset.cross(&force)))
    }

    /// Adds H^T p for a wrench p on the frame to the forces on the coordinates of the body.
    pub(super) fn add_modal_forces(&self, wrench: &Vector6<f64>, forces: &mut [f64]) {
        for (force, mode) in forces.iter_mut().zip(&self.modes) {
            *force += mode.dot(wrench);
        }
    }

    /// G.
    pub(super) fn matrix(&self) -> Matrix6<f64> {
        self.offset.map_or_else(Matrix6::zeros, |offset| transport_matrix(&offset))
    }

    /// The motion of a frame at `offset` from this one, which the modes `modes` move in addition.
    fn attached(&self, offset: &Vector3<f64>, modes: &[Vector6<f64>]) -> Self {
        let count = self.modes.len().max(modes.len());
        let mode = |index: usize| {
            let transported = self.modes.get(index).map_or_else(Vector6::zeros, |mode| transport(mode, offset));
            modes.get(index).map_or(transported, |mode| transported + mode)
        };
        Self {
            body: self.body,
            offset: self.offset.map(|body_offset| body_offset + offset),
            modes: (0..count).map(mode).collect(),
        }
    }
}

/// The motion at `offset` of a rigid body that moves by `motion` at its origin.
fn transport(motion: &Vector6<f64>, offset: &Vector3<f64>) -> Vector6<f64> {
    let (translation, rotation) = split(motion);
    stack(&(translation + rotation.cross(offset)), &rotation)
}

impl JointTree {
    /// Finds the bodies and joints of a scene. A domain that follows another one moves with its frame.
    ///
    /// # Errors
    /// `Invalid` if a domain shares the coordinates of another one, but its frame moves with a third one.
    pub fn new(model: &Model) -> Result<Self> {
        let mut bodies: Vec<Body> = vec![];
        let mut frames: Vec<FrameMotion> = vec![];
        let mut body_of_coordinate = BTreeMap::new();
        for domain in &model.domains {
            let joint = attach(model, domain, &frames);
            if domain.rank > 0 && !domain.owns_q {
                let body = body_of_coordinate.get(&domain.first_coordinate).copied();
                frames.push(share(model, domain, joint, &bodies, body)?);
                continue;
            }
            if domain.rank > 0 {
                body_of_coordinate.insert(domain.first_coordinate, bodies.len());
            }
            frames.push(FrameMotion::of_body(bodies.len()));
            let DomainModel { first_coordinate, rank, .. } = *domain;
            bodies.push(Body { first_coordinate, rank, joint, children: 0..0, offset: 0 });
        }
        Ok(Self { newton: model.unit.recip(), ..Self::sorted(bodies, frames) })
    }

    /// Sorts bodies by depth. A body precedes its children in `bodies`.
    fn sorted(mut bodies: Vec<Body>, mut frames: Vec<FrameMotion>) -> Self {
        let mut children: Vec<Vec<usize>> = vec![vec![]; bodies.len()];
        let mut order = vec![];
        for (index, body) in bodies.iter().enumerate() {
            match &body.joint {
                Some(joint) => children[joint.body].push(index),
                None => order.push(index),
            }
        }
        let mut levels = vec![];
        let mut level = 0..order.len();
        while !level.is_empty() {
            for position in level.clone() {
                let body = order[position];
                let first_child = order.len();
                order.extend(&children[body]);
                bodies[body].children = first_child..order.len();
            }
            levels.push(level.clone());
            level = level.end..order.len();
        }
        let mut positions = vec![0; order.len()];
        order.iter().enumerate().for_each(|(position, body)| positions[*body] = position);
        let mut sorted: Vec<Body> = Vec::with_capacity(order.len());
        let mut offset = 0;
        for body in order {
            let body = &mut bodies[body];
            let joint = body.joint.take().map(|joint| FrameMotion { body: positions[joint.body], ..joint });
            let Body { first_coordinate, rank, .. } = *body;
            sorted.push(Body { first_coordinate, rank, joint, children: body.children.clone(), offset });
            offset += rank;
        }
        frames.iter_mut().for_each(|frame| frame.body = positions[frame.body]);
        Self { bodies: sorted, levels, frames, newton: 1.0 }
    }

    /// Whether a joint lets domains act on each other: some frame moves with the modes of another domain.
    pub fn is_coupled(&self) -> bool {
        let joints = self.bodies.iter().filter_map(|body| body.joint.as_ref());
        joints.clone().any(|joint| !joint.modes.is_empty()) || self.frames.iter().any(|frame| !frame.modes.is_empty())
    }

    /// The forces on the coordinates that have the same effect as `loads`: the loads do the same work, because all
    /// frames move as functions of the coordinates. The loads are in newtons, and the result is in kg scene units/s^2 times
    /// scene units per unit of q, because masses are in kilograms and motions in scene units.
    pub fn reduce(&self, loads: &DomainLoads) -> Vec<f64> {
        self.reduce_to_roots(loads).coordinates
    }

    /// As [`Self::reduce`], with the wrenches on the frames of the roots.
    pub(super) fn reduce_to_roots(&self, loads: &DomainLoads) -> ReducedLoad {
        let mut forces: Vec<f64> = loads.coordinates.iter().map(|force| force * self.newton).collect();
        let mut wrenches = vec![Vector6::zeros(); self.bodies.len()];
        for (frame, wrench) in self.frames.iter().zip(&loads.wrenches) {
            self.add_wrench(frame, &(wrench * self.newton), &mut forces, &mut wrenches);
        }
        self.sweep_to_roots(forces, wrenches)
    }

    /// Moves the wrenches on all bodies to the coordinates of their ancestors and to the roots.
    pub(super) fn sweep_to_roots(&self, mut forces: Vec<f64>, mut wrenches: Vec<Vector6<f64>>) -> ReducedLoad {
        for (index, body) in self.bodies.iter().enumerate().rev() {
            if let Some(joint) = &body.joint {
                let wrench = wrenches[index];
                self.add_wrench(joint, &wrench, &mut forces, &mut wrenches);
            }
        }
        wrenches.truncate(self.root_count());
        ReducedLoad { coordinates: forces, roots: wrenches }
    }

    /// Adds a wrench on a frame to its body.
    fn add_wrench(
        &self,
        frame: &FrameMotion,
        wrench: &Vector6<f64>,
        forces: &mut [f64],
        wrenches: &mut [Vector6<f64>],
    ) {
        let Body { first_coordinate, rank, .. } = self.bodies[frame.body];
        frame.add_modal_forces(wrench, &mut forces[first_coordinate..][..rank]);
        wrenches[frame.body] += frame.transport_back(wrench);
    }

    /// The number of bodies without a joint, which are the first ones.
    pub(super) fn root_count(&self) -> usize {
        self.levels.first().map_or(0, Range::len)
    }

    /// Per body: the index of its root.
    pub(super) fn roots(&self) -> Vec<usize> {
        let mut roots: Vec<usize> = vec![];
        for (index, body) in self.bodies.iter().enumerate() {
            roots.push(body.joint.as_ref().map_or(index, |joint| roots[joint.body]));
        }
        roots
    }

    /// Per coordinate: a bound of the displacement of the vertices of all descendants of its domain per unit of the
    /// coordinate, in scene units. It is that of a rigid motion of each descendant and its own descendants.
    pub(super) fn levers(&self, model: &Model) -> Vec<f64> {
        // Per body: the largest distance of a sample of the body or of a descendant from the frame of the body at rest.
        let mut radii = vec![0.0_f64; self.bodies.len()];
        let mut levers = vec![0.0_f64; model.coordinate_count];
        let mut add = |frame: &FrameMotion, radius: f64, radii: &mut [f64]| {
            let first_coordinate = self.bodies[frame.body].first_coordinate;
            for (lever, mode) in levers[first_coordinate..].iter_mut().zip(&frame.modes) {
                *lever = lever.max(max_displacement(mode, radius));
            }
            if let Some(offset) = frame.offset {
                radii[frame.body] = radii[frame.body].max(offset.norm() + radius);
            }
        };
        for (domain, frame) in model.domains.iter().zip(&self.frames) {
            let distance = |sample: &Sample| (domain.placement.linear * sample.rest_position).norm();
            add(frame, domain.samples.iter().map(distance).fold(0.0, f64::max), &mut radii);
        }
        for (index, body) in self.bodies.iter().enumerate().rev() {
            if let Some(joint) = &body.joint {
                let radius = radii[index];
                add(joint, radius, &mut radii);
            }
        }
        levers
    }

    /// Per domain: the motion of its frame at the coordinates `q` of the scene.
    pub fn frame_motions(&self, q: &[f64]) -> Vec<Vector6<f64>> {
        self.frame_motions_from(&vec![Vector6::zeros(); self.root_count()], q)
    }

    /// As [`Self::frame_motions`], with small motions of the roots.
    pub(super) fn frame_motions_from(&self, roots: &[Vector6<f64>], q: &[f64]) -> Vec<Vector6<f64>> {
        let mut motions = roots.to_vec();
        motions.resize(self.bodies.len(), Vector6::zeros());
        let q_of = |body: usize| &q[self.bodies[body].first_coordinate..][..self.bodies[body].rank];
        for (index, body) in self.bodies.iter().enumerate() {
            if let Some(joint) = &body.joint {
                motions[index] = joint.apply(&motions[joint.body], q_of(joint.body));
            }
        }
        self.frames.iter().map(|frame| frame.apply(&motions[frame.body], q_of(frame.body))).collect()
    }
}

/// The largest displacement by a unit motion of a frame of a point at most `radius` from its origin.
fn max_displacement(motion: &Vector6<f64>, radius: f64) -> f64 {
    let (translation, rotation) = split(motion);
    translation.norm() + rotation.norm() * radius
}

/// The motion of a domain's frame with the domain that it follows or is attached to. `None` for a root.
fn attach(model: &Model, domain: &DomainModel, frames: &[FrameMotion]) -> Option<FrameMotion> {
    let origin = |domain: &DomainModel| domain.placement.translation;
    let offset = |parent: usize| origin(domain) - origin(&model.domains[parent]);
    match (&domain.follow, &domain.joint) {
        (Some(follow), _) => Some(frames[follow.leader].attached(&offset(follow.leader), &[])),
        (None, Some(joint)) => {
            let modes = joint_modes(&model.domains[joint.parent], joint);
            Some(frames[joint.parent].attached(&offset(joint.parent), &modes))
        }
        (None, None) => None,
    }
}

/// Whether the frame moves at all: it, or the frame of an ancestor, moves with modes.
fn moves<'a>(mut frame: &'a FrameMotion, bodies: &'a [Body]) -> bool {
    while frame.modes.is_empty() {
        match (&frame.offset, &bodies[frame.body].joint) {
            (Some(_), Some(joint)) => frame = joint,
            _ => return false,
        }
    }
    true
}

/// The motion of the frame of a domain that shares the coordinates of `body`.
fn share(
    model: &Model,
    domain: &DomainModel,
    joint: Option<FrameMotion>,
    bodies: &[Body],
    body: Option<usize>,
) -> Result<FrameMotion> {
    let invalid = |given: String| {
        let field = format!("domain that moves '{}', which shares coordinates", domain.name);
        invalid_input(field, "none, or one with the same coordinates", given)
    };
    let Some(body) = body else { return Err(invalid("coordinates of no earlier domain".into())) };
    match joint.filter(|joint| moves(joint, bodies)) {
        None => Ok(FrameMotion { body, offset: None, modes: vec![] }),
        Some(joint) if joint.body == body => Ok(joint),
        Some(_) => {
            let name = domain.carrier().map_or("", |carrier| model.domains[carrier].name.as_str());
            Err(invalid(format!("'{name}', which has other coordinates")))
        }
    }
}
