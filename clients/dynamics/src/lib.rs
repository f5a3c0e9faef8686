//! A physics process that drives a modalcast server. It computes reduced coordinates q and transforms T of every step
//! from the server's description of the scene and, for large motion, from a file of reduced forces: that of a model of
//! `modalcast model --large`, or of the library Vega.
//!
//! | module | what it does |
//! |---|---|
//! | `model` | converts a scene description into domain models: rank, joints, selected rows of U |
//! | `affine` | affine transforms, and the rotation nearest to a matrix |
//! | `connected_parts` | finds the connected parts of a mesh |
//! | `attachments` | the rigid transforms of joints as functions of q, fitted to displaced vertices |
//! | `hierarchy` | computes transforms that keep every joint closed |
//! | `joint_gap` | measures how far joints open |
//! | `displacement_meter` | measures the largest displacement over a run |
//! | `parameters` | reads and validates eigenvalues and damping ratios |
//! | `rigid_modes` | finds the modes without stiffness, which are held still |
//! | `oscillator` | integrates one linear mode over a step, exactly |
//! | `loads` | forces on the coordinates of domains, and wrenches on their frames |
//! | `coupled` | domains that act on each other at joints: equations of motion, integrator, static response |
//! | `free_bodies` | bodies that nothing holds, under the forces of viewers and of the wind |
//! | `drag` | the drag of the wind on moving bodies |
//! | `deflection` | displacements of a scene at rest under forces at vertices |
//! | `wind` | wind pressure by time and position, from a spectrum of turbulence |
//! | `tree` | linear modes in the wind and under forces of viewers: a tree, or a single body |
//! | `cubic` | reduced forces of a St. Venant-Kirchhoff material from a `.cub` file, with Jacobian and potential |
//! | `vega` | base frequency and damping from a `.config` file, and the hash of U in a `.URendering.float` file |
//! | `force_domain` | finds the domain that a file of reduced forces belongs to |
//! | `reduced_system` | the reduced equations of motion of a nonlinear body, and its equilibria |
//! | `newton` | Newton's method with a line search |
//! | `integrator` | the trait of integrators, their reports, and the exact integrator of linear modes |
//! | `implicit` | implicit integrators of cubic forces, with sub-steps by an estimate of the error |
//! | `bridge` | a body with cubic forces, under a pulsating load (a bridge) or pulled by viewers, and linear modes of the other domains |
//! | `sweep` | motion for any scene: moves one coordinate after another, or rocks a rigid scene |
//! | `viewer_forces` | reads the forces that viewers apply |
//! | `viewer_response` | the response of linear modes to the forces of viewers |
//! | `divergence` | stops a run before it sends a step that is not finite or far out of range |
//! | `checkpoint` | files from which a later process continues a run, bit by bit |
//! | `saved_state` | converts the state of a scenario to and from JSON, exactly |
//! | `slow_motion` | the slow motion in which the vibrations of a stiff body are visible |
//! | `step_values` | coordinates and transforms of a step, and the message with those that have changed |
//! | `recorder` | writes the values of all steps to NumPy files |
//! | `run` | sends a scenario as a step stream, optionally records it, and reports the results |
//!
//! # Example
//! A client that moves the parts of the built-in tree and saves frames. `modalcast serve` runs in another process.
//!
//! ```rust,no_run
//! use modalcast_client::{Client, Delivery, DriveRequest, FrameRequest, Picture};
//! use modalcast_dynamics::{model::Model, step_values::StepValues};
//!
//! #[tokio::main]
//! async fn main() -> Result<(), Box<dyn std::error::Error>> {
//!     let client = Client::connect("http://127.0.0.1:50051").await?; // `modalcast serve`
//!     let scene = client.open_scene("tree", "").await?.scene;
//!     let surface_samples = 24; // per domain, at most
//!     let model = Model::fetch(&client, &scene, surface_samples).await?;
//!     let mut drive = client.drive(&DriveRequest::new(&scene, Delivery::Lossless)).await?;
//!     for number in 0..12 {
//!         let time = number as f64 / 12.0;
//!         let mut q = vec![0.0; model.coordinate_count];
//!         for domain in model.domains.iter().filter(|domain| domain.rank > 0) {
//!             // The first mode of each part moves its outermost point by up to 8 % of the part's size.
//!             let amplitude = 0.08 * domain.diagonal / domain.displacement_per_unit(0);
//!             q[domain.first_coordinate] = amplitude * (std::f64::consts::TAU * time).sin();
//!         }
//!         let step = StepValues::new(&model, &q).to_step(&model, number, time); // with the T that close all joints
//!         drive.step(&step).await?; // x = T (x0 + U q)
//!         drive.flush().await?;
//!         let frame = client.render_frame(&FrameRequest::new(&scene, Picture::default())).await?;
//!         std::fs::write(format!("frame-{number:02}.png"), &frame.bytes)?;
//!     }
//!     Ok(drive.finish().await.map(drop)?)
//! }
//! ```

#![cfg_attr(not(test), deny(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::print_stdout))]

pub mod affine;
pub mod attachments;
pub mod bridge;
pub mod checkpoint;
mod connected_parts;
pub mod coupled;
pub mod cubic;
pub mod deflection;
pub mod displacement_meter;
pub mod divergence;
mod drag;
mod error;
pub mod force_domain;
pub mod free_bodies;
pub mod hierarchy;
pub mod implicit;
pub mod integrator;
pub mod joint_gap;
pub mod loads;
pub mod model;
mod newton;
pub mod oscillator;
pub mod parameters;
mod recorder;
pub mod reduced_system;
#[cfg(test)]
mod resume_tests;
mod rigid_modes;
pub mod run;
mod saved_state;
pub mod slow_motion;
#[cfg(test)]
mod stability;
pub mod step_values;
pub mod sweep;
pub mod tree;
pub mod vega;
pub mod viewer_forces;
mod viewer_response;
pub mod wind;
mod wrench;

pub use error::{Error, Result, invalid_input};
