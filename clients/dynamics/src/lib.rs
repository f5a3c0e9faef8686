//! A physics process that drives a modalcast server. It computes reduced coordinates q and transforms T of every step
//! from the server's description of the scene and, for a Vega model, from its files of reduced forces.
//!
//! | module | what it does |
//! |---|---|
//! | `model` | converts a scene description into domain models: rank, joints, selected rows of U |
//! | `affine` | affine transforms, and the rotation nearest to a matrix |
//! | `attachments` | the rigid transforms of joints as functions of q, fitted to displaced vertices |
//! | `hierarchy` | computes transforms that keep every joint closed, and measures the remaining gap |
//! | `parameters` | reads and validates eigenvalues and damping ratios |
//! | `oscillator` | integrates one linear mode over a step, exactly |
//! | `wind` | wind pressure by time and position, from a spectrum of turbulence |
//! | `tree` | a tree in the wind, by modal superposition |
//! | `cubic` | reduced StVK forces from a `.cub` file, with Jacobian and potential |
//! | `vega` | base frequency and damping from a `.config` file |
//! | `newmark` | implicit time integration of the reduced equations of motion |
//! | `bridge` | a bridge under a pulsating load |
//! | `sweep` | motion for any scene: moves one coordinate after another, or rocks a rigid scene |
//! | `viewer_forces` | reads the forces that viewers apply |
//! | `divergence` | stops a run before it sends a step that is not finite or far out of range |
//! | `step_values` | coordinates and transforms of a step, and the message with those that have changed |
//! | `run` | sends a scenario as a step stream, optionally records it, and reports the results |

#![cfg_attr(not(test), deny(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::print_stdout))]

pub mod affine;
pub mod attachments;
pub mod bridge;
pub mod cubic;
pub mod divergence;
mod error;
pub mod hierarchy;
pub mod model;
pub mod newmark;
pub mod oscillator;
pub mod parameters;
pub mod run;
#[cfg(test)]
mod stability;
pub mod step_values;
pub mod sweep;
pub mod tree;
pub mod vega;
pub mod viewer_forces;
pub mod wind;

pub use error::{Error, Result, invalid_input};

/// Compiles the client code in the project's README as a doctest.
#[cfg(doctest)]
#[doc = include_str!("../../../README.md")]
struct ProjectReadme;
