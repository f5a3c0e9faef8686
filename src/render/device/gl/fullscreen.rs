//! Rendering without vertex attributes.

use glow::HasContext as _;

use super::{Framebuffer, Gl, VertexArray};

impl Gl {
    /// Draws a triangle that covers a square framebuffer, with the bound program. Nothing is cleared.
    pub(crate) fn draw_fullscreen_triangle(
        &self,
        framebuffer: &Framebuffer,
        side: u32,
        empty_vertex_array: &VertexArray,
    ) {
        let Some(gl) = self.functions_or_skip() else { return };
        // SAFETY: sets state with a complete framebuffer.
        unsafe {
            gl.bind_framebuffer(glow::FRAMEBUFFER, Some(framebuffer.name));
            gl.viewport(0, 0, side as i32, side as i32);
            gl.disable(glow::SCISSOR_TEST);
        }
        self.draw_procedural(empty_vertex_array, 3);
    }
}
