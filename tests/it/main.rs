//! Integration tests through the public door, in one binary.

mod frames;
mod hostile;
mod restart;
mod service;
mod service_harness;
mod steps;
