//! Uniform blocks of a frame, computed in f64 and rounded to f32 at the end: camera, look, shadow map and cascades.

pub(crate) mod cascades;
pub(crate) mod frame;
pub(crate) mod light_box;
