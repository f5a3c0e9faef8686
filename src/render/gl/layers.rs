//! Images of several layers that passes write one by one: the maps of a shadow.

use std::rc::Rc;

use glow::HasContext as _;

use super::{Framebuffer, Gl, Program, Texture};
use modalcast_model::error::{Result, during};

impl Gl {
    /// A framebuffer of one layer of an image: of its depth, or of its one colour.
    pub(crate) fn layer_framebuffer(
        self: &Rc<Self>,
        image: &Texture,
        is_depth: bool,
        layer: u32,
    ) -> Result<Framebuffer> {
        let gl = self.on();
        let point = if is_depth { glow::DEPTH_ATTACHMENT } else { glow::COLOR_ATTACHMENT0 };
        // SAFETY: attaches a layer of a texture of this context; completeness is asked for at once.
        unsafe {
            let name = gl.create_framebuffer().map_err(during("framebuffer"))?;
            let framebuffer = Framebuffer { gl: Rc::clone(self), name };
            gl.bind_framebuffer(glow::FRAMEBUFFER, Some(name));
            gl.framebuffer_texture_layer(glow::FRAMEBUFFER, point, Some(image.name), 0, layer as i32);
            gl.draw_buffers(&[if is_depth { glow::NONE } else { glow::COLOR_ATTACHMENT0 }]);
            match gl.check_framebuffer_status(glow::FRAMEBUFFER) {
                glow::FRAMEBUFFER_COMPLETE => self.check("framebuffer").map(|()| framebuffer),
                status => Err(during("framebuffer")(format!("incomplete, 0x{status:04X}"))),
            }
        }
    }

    /// Draws a triangle over the whole of a framebuffer with the current program. Nothing is cleared.
    pub(crate) fn cover(&self, into: &Framebuffer, side: u32, nothing: &super::VertexArray) {
        let gl = self.on();
        // SAFETY: state and a draw without attributes into a complete framebuffer.
        unsafe {
            gl.bind_framebuffer(glow::FRAMEBUFFER, Some(into.name));
            gl.viewport(0, 0, side as i32, side as i32);
            gl.disable(glow::SCISSOR_TEST);
        }
        self.draw_made(nothing, 3);
    }
}

impl Texture {
    /// Binds one layer as an image that a compute shader writes.
    pub(crate) fn bind_image_layer(&self, unit: u32, layer: u32) {
        // SAFETY: level 0 of a texture whose format the shader names.
        unsafe {
            let gl = self.gl.on();
            gl.bind_image_texture(unit, Some(self.name), 0, false, layer as i32, glow::WRITE_ONLY, self.kind.format);
        }
    }
}

impl Program {
    /// Gives the program in use, which is this one, the layer that it writes: location 1.
    pub(crate) fn layer(&self, layer: u32) {
        // SAFETY: location 1 is declared by the shaders that are given a layer.
        unsafe { self.gl.on().uniform_1_i32(Some(&glow::NativeUniformLocation(1)), layer as i32) }
    }
}
