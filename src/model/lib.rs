//! The scene model as plain values: meshes, modes U, materials, scenes, and steps (new coordinates q and transforms T).
//! Also the loaders that read scenes from files, and the traits that deformers and rasterizers implement. This crate
//! uses neither CUDA nor OpenGL.

#![cfg_attr(not(test), deny(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::print_stdout))]

pub mod backend_settings;
mod beam_shape;
pub mod deform;
pub mod domain;
pub mod error;
pub mod escaping;
pub mod fault_injection;
pub mod load;
pub mod memory;
pub mod raster;
pub mod rounding;
pub mod scene;
pub mod shared_memory;
pub mod tree;
pub mod views;
