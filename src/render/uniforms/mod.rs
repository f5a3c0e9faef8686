//! Uniform blocks of a frame: camera, look, shadow map and cascades. Computed in f64 and rounded to f32 at the end.

pub(crate) mod cascades;
pub(crate) mod frame;
pub(crate) mod light_box;

/// Smallest size, in scene units, that is used for a scene without extent. Shaders can still square it, and divide by
/// the square, in f32.
const MIN_SIZE: f64 = 1e-15;
