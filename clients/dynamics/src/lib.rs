//! A physics process that drives a modalcast server: reduced coordinates q and transforms T of every step, computed
//! from nothing but what the server describes (and, for a Vega model, its files of reduced forces).
//!
//! | module | what it turns into what |
//! |---|---|
//! | `model` | a described scene to parts: rank, joints, chosen rows of U |
//! | `affine` | frames: compose, apply, round; the rigid motion of some points |
//! | `hierarchy` | coordinates to transforms that keep every joint closed, and the gap that is left |
//! | `oscillator` | one mode's state and force to its state a step later, exactly |
//! | `wind` | time and place to a wind pressure |
//! | `tree` | wind to the coordinates and transforms of a tree |
//! | `cubic` | a `.cub` file to reduced StVK forces, their Jacobian and potential |
//! | `vega` | a `.config` file to frequencies and damping |
//! | `newmark` | reduced forces and a load to motion, implicitly |
//! | `bridge` | a span under a load to its coordinates |
//! | `sweep` | any scene to motion that shows every coordinate, or rocks what is rigid |
//! | `run` | any of these to a step stream, with records and a summary |

#![cfg_attr(not(test), deny(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::print_stdout))]

pub mod affine;
pub mod bridge;
pub mod cubic;
mod error;
pub mod hierarchy;
pub mod model;
pub mod newmark;
pub mod oscillator;
pub mod run;
pub mod sweep;
pub mod tree;
pub mod vega;
pub mod wind;

pub use error::{Error, Result, invalid};
