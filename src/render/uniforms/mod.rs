//! Uniform blocks of a frame: camera, look, shadow map and cascades. Computed in f64 and rounded to f32 at the end.

pub(crate) mod cascades;
pub(crate) mod frame;
pub(crate) mod light_box;
