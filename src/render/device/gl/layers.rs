//! Rendering to single layers of array textures: the cascades of a shadow map.

use std::rc::Rc;

use glow::HasContext as _;

use super::{Framebuffer, Gl, Program, Texture};
use modalcast_model::error::{Result, fault_in};

impl Gl {
    /// Creates a framebuffer of one layer of an array texture: of its depth, or of its only color attachment.
    pub(crate) fn layer_framebuffer(
        self: &Rc<Self>,
        image: &Texture,
        is_depth: bool,
        layer: u32,
    ) -> Result<Framebuffer> {
        let gl = self.current();
        let point = if is_depth { glow::DEPTH_ATTACHMENT } else { glow::COLOR_ATTACHMENT0 };
        // SAFETY: attaches a layer of a texture of this context; completeness is checked right after.
        unsafe {
            let name = gl.create_framebuffer().map_err(fault_in("framebuffer"))?;
            let framebuffer = Framebuffer { gl: Rc::clone(self), name };
            gl.bind_framebuffer(glow::FRAMEBUFFER, Some(name));
            gl.framebuffer_texture_layer(glow::FRAMEBUFFER, point, Some(image.name), 0, layer as i32);
            gl.draw_buffers(&[if is_depth { glow::NONE } else { glow::COLOR_ATTACHMENT0 }]);
            match gl.check_framebuffer_status(glow::FRAMEBUFFER) {
                glow::FRAMEBUFFER_COMPLETE => self.check("framebuffer").map(|()| framebuffer),
                status => Err(fault_in("framebuffer")(format!("incomplete, 0x{status:04X}"))),
            }
        }
    }

    /// Draws a triangle over the whole framebuffer with the bound program. Nothing is cleared.
    pub(crate) fn draw_fullscreen_triangle(
        &self,
        into: &Framebuffer,
        side: u32,
        empty_vertex_array: &super::VertexArray,
    ) {
        let gl = self.current();
        // SAFETY: state and a draw without attributes into a complete framebuffer.
        unsafe {
            gl.bind_framebuffer(glow::FRAMEBUFFER, Some(into.name));
            gl.viewport(0, 0, side as i32, side as i32);
            gl.disable(glow::SCISSOR_TEST);
        }
        self.draw_procedural(empty_vertex_array, 3);
    }
}

impl Texture {
    /// Binds one layer as an image that a compute shader writes.
    pub(crate) fn bind_image_layer(&self, unit: u32, layer: u32) {
        // SAFETY: level 0 of a texture whose format the shader declares.
        unsafe {
            let gl = self.gl.current();
            gl.bind_image_texture(unit, Some(self.name), 0, false, layer as i32, glow::WRITE_ONLY, self.desc.format);
        }
    }
}

impl Program {
    /// Sets the layer (location 1) that this program writes. It must be the bound program.
    pub(crate) fn set_layer(&self, layer: u32) {
        // SAFETY: the shaders that write layers declare location 1.
        unsafe { self.gl.current().uniform_1_i32(Some(&glow::NativeUniformLocation(1)), layer as i32) }
    }
}
