//! The OpenGL device: EGL contexts, typed OpenGL objects and commands, and the staging buffers of readbacks.

pub(crate) mod egl;
mod egl_devices;
pub(crate) mod gl;
pub(crate) mod readback_ring;

pub(crate) use self::egl_devices::open;
pub use self::egl_devices::{EglDevice, devices};
