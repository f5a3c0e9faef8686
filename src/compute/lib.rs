//! Deformers: three implementations of x = T (x0 + U q), the deformation of every vertex of a scene. The first runs on
//! CUDA, the second on all cores of the CPU. The third is a plain f64 reference, with which tests compare the others.
//! The module [`gpu`] also has the compute rasterizer, the renderer of small views and the PNG encoder in CUDA.

#![cfg_attr(not(test), deny(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::print_stdout))]

pub mod cpu;
pub mod gpu;
pub mod reference;
pub mod storage;
#[cfg(any(test, feature = "testing"))]
pub mod testing;
