//! Claims that need no GPU. One binary.

mod deformers;
mod far;
mod frames;
mod hostile;
mod layering;
mod normals;
mod pixels;
mod real;
mod restart;
mod service;
mod service_faults;
mod service_files;
mod service_harness;
mod steps;
mod storages;
mod tolerance;
