//! Modes and inertia of slender bodies, such as branches and leaves: a Timoshenko beam along a polyline, clamped at its
//! first node, with rigid bodies at stations along it.
//!
//! A body of a tree of coupled bodies moves by R X + Phi q: X is the small rigid motion of its frame (translation of the
//! frame's origin, then rotation vector), R the six rigid motions about the origin, and Phi the mode shapes.
//! [`Beam::solve_modes`] computes *loaded-interface modes* (Benfield and Hruda, "Vibration analysis of structures by
//! component mode substitution", AIAA Journal 9, 1971): the modes of the clamped beam that carries at each joint the
//! rigid inertia D_c of everything beyond the joint, K phi = lambda (M + sum P_c^T D_c P_c) phi. P_c is the motion of the
//! section at the joint. [`Beam::rigid_inertia`] is R^T M R with the beam's own mass M, and [`Beam::modal_inertia`] has
//! R^T M Phi and Phi^T M Phi.
//!
//! Any consistent units work, for example meters, kilograms, pascals and seconds. Nothing here panics: a beam that has
//! no length, no section or no stiffness is an error.

#![cfg_attr(not(test), deny(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::print_stdout))]

mod band;
mod beam;
mod element;
mod error;
#[cfg(test)]
mod frame_model;
mod inertia;
mod polyline;
mod profile;
mod similarity;
mod station;
#[cfg(test)]
mod testing;

pub use beam::{Beam, BeamElement, BeamModes, ModalInertia};
pub use error::{BeamError, Result};
pub use inertia::RigidInertia;
pub use profile::{ElasticConstants, Profile};
pub use similarity::Similarity;
pub use station::{SectionMotion, Station};
