//! Deformers: three implementations of x = T (x0 + U q), the deformation of every vertex of a scene. They run on CUDA,
//! on all cores of the CPU, and as a plain f64 reference against which the tests compare the other two.

#![cfg_attr(not(test), deny(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::print_stdout))]

pub mod cpu;
pub mod gpu;
pub mod reference;
pub mod storage;
#[cfg(any(test, feature = "testing"))]
pub mod testing;
