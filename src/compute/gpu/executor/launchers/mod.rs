//! The launchers of the kernels of a step: one file per kernel, with its name. A launcher owns the constant tables of
//! its kernel on the device.
//!
//! The launch functions are unsafe, because the header of a step's values contains the addresses of its outputs
//! (`StepHeader`), which only the caller knows.

pub(crate) mod apply;
mod batch;
pub(crate) mod bounds;
pub(crate) mod deform;
mod domain_boxes;
pub(crate) mod normals;
