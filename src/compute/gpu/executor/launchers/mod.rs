//! The launchers of the kernels of a step: one file per kernel, with its name. A launcher owns the constant tables of
//! its kernel on the device.
//!
//! The launch functions are unsafe, because the device reads the addresses of the outputs from the header of a step
//! (`StepHeader`). Only the caller knows whether these addresses are valid.

pub(crate) mod apply;
mod batch;
pub(crate) mod bounds;
pub(crate) mod deform;
mod domain_boxes;
pub(crate) mod normals;
