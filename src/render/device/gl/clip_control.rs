//! The range of depth in clip space.

use glow::HasContext as _;

use super::super::egl::Context;
use modalcast_model::error::{Error, Result, fault};

/// Sets the clip volume of a context to 0 <= z <= w, with y upwards. By default it is -w <= z <= w, and OpenGL maps z /
/// w to depth with an addition that would round reversed depth to a multiple of 2^-24.
///
/// # Errors
/// `Unavailable` if the context has neither OpenGL 4.5 nor `GL_ARB_clip_control`.
pub(super) fn set_depth_range_from_zero(gl: &glow::Context, context: &Context) -> Result<()> {
    type ClipControl = unsafe extern "system" fn(u32, u32);
    let version = gl.version();
    let is_supported =
        (version.major, version.minor) >= (4, 5) || gl.supported_extensions().contains("GL_ARB_clip_control");
    let address = context.address("glClipControl");
    if !is_supported || address.is_null() {
        let reason =
            format!("expected OpenGL 4.5 or GL_ARB_clip_control, got OpenGL {}.{}", version.major, version.minor);
        let remedy = "Install a driver with OpenGL 4.5".into();
        return Err(Error::Unavailable { what: "OpenGL", reason, remedy });
    }
    // SAFETY: the address is that of glClipControl, which has this signature. It sets state of the current context.
    unsafe {
        let clip_control = std::mem::transmute::<*const std::ffi::c_void, ClipControl>(address);
        clip_control(glow::LOWER_LEFT, glow::ZERO_TO_ONE);
        match gl.get_error() {
            glow::NO_ERROR => Ok(()),
            error => Err(fault("clip control", format!("OpenGL error 0x{error:04X}"))),
        }
    }
}
