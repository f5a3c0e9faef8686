//! What a scene is, and the contract of those who deform and draw it: meshes, modes U and materials, scenes and steps as
//! values, and the files that they are read from. Neither CUDA nor OpenGL is known here.

#![cfg_attr(not(test), deny(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::print_stdout))]

pub mod deform;
pub mod domain;
pub mod error;
pub mod load;
pub mod raster;
pub mod scene;
pub mod tree;
