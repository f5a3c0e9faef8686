//! Records the OpenGL commands of each pass.
//!
//! A pass is a value of [`Pass`]. Its inputs, outputs and barriers are in `accesses`, its commands in the file of its
//! technique. [`PassRecorder`] issues the barriers, checks for errors and collects statistics.

mod accesses;
pub(crate) mod ambient;
pub(crate) mod aov;
pub(crate) mod blended;
pub(crate) mod cull;
mod draw;
mod oit;
pub(crate) mod picking;
pub(crate) mod post;
pub(crate) mod raster;
pub(crate) mod readback;
mod recorder;
pub(crate) mod shade;
pub(crate) mod shadow;
pub(crate) mod uniforms;
pub(crate) mod visibility;

pub(crate) use self::oit::OitFrame;
pub(crate) use self::recorder::{FrameContext, PassRecorder};
