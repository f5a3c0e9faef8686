//! Images that a pass begins with, filled without the rasteriser.
//!
//! Clearing a framebuffer writes every sample through the rasteriser's own units, which data-centre GPUs have few of: four
//! samples of ids and depth at 1920 x 1080 take more than a millisecond on an H200. Filling the texture is a copy.

use super::{Framebuffer, Gl, Texture};

/// glClearTexSubImage (OpenGL 4.4): texture, level; x, y, z; width, height, depth; format, type, one texel.
pub(super) type ClearTexSubImage =
    unsafe extern "system" fn(u32, i32, i32, i32, i32, i32, i32, i32, u32, u32, *const std::ffi::c_void);

/// An image that a framebuffer draws into.
#[derive(Debug, Clone, Copy)]
pub(super) struct Attached {
    name: glow::Texture,
    layer: i32,
    size: [i32; 2],
}

impl Attached {
    pub(super) fn new(texture: &Texture, layer: u32) -> Self {
        let size = [texture.kind.width, texture.kind.height].map(|side| side as i32);
        Self { name: texture.name, layer: layer as i32, size }
    }
}

impl Gl {
    /// Loads the function where it pays: software clears as fast as it can either way.
    pub(super) fn filler(&self) -> Option<ClearTexSubImage> {
        let address = self.context.address("glClearTexSubImage");
        if address.is_null() || self.limits.software || !self.limits.persistent {
            return None;
        }
        // SAFETY: the address is that of the function of this name, whose parameters are these; 4.4 has it, as it has
        // persistent buffers.
        Some(unsafe { std::mem::transmute::<*const std::ffi::c_void, ClearTexSubImage>(address) })
    }

    /// Fills the depth of a framebuffer with 1 and, with `ids`, its colour with 0. Whether that could be done.
    pub(super) fn fill(&self, into: &Framebuffer, ids: bool) -> bool {
        let (Some(fill), Some(depth)) = (self.fill, into.depth) else { return false };
        let one = 1.0_f32;
        let write = |image: Attached, format: u32, ty: u32, texel: *const std::ffi::c_void| {
            let [width, height] = image.size;
            // SAFETY: the box is that of the texture, or of one of its layers; `texel` is null, for zeros, or one live f32.
            unsafe { fill(image.name.0.get(), 0, 0, 0, image.layer, width, height, 1, format, ty, texel) }
        };
        write(depth, glow::DEPTH_COMPONENT, glow::FLOAT, (&raw const one).cast());
        if let Some(colour) = into.colour.filter(|_| ids) {
            write(colour, glow::RED_INTEGER, glow::UNSIGNED_INT, std::ptr::null());
        }
        true
    }
}
