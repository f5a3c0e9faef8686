//! The deformers x = T (x0 + U q): CUDA, all cores of the CPU, and the plain f64 reference that both are tested against.

#![cfg_attr(not(test), deny(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::print_stdout))]

pub mod cpu;
pub mod gpu;
pub mod reference;
pub mod storage;
#[cfg(any(test, feature = "testing"))]
pub mod testing;
