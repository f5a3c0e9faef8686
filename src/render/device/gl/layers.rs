//! Rendering without vertex attributes.

use glow::HasContext as _;

use super::{Framebuffer, Gl, VertexArray};

impl Gl {
    /// Draws a triangle over the whole framebuffer with the bound program. Nothing is cleared.
    pub(crate) fn draw_fullscreen_triangle(&self, into: &Framebuffer, side: u32, empty_vertex_array: &VertexArray) {
        let Some(gl) = self.functions_or_skip() else { return };
        // SAFETY: state and a draw without attributes into a complete framebuffer.
        unsafe {
            gl.bind_framebuffer(glow::FRAMEBUFFER, Some(into.name));
            gl.viewport(0, 0, side as i32, side as i32);
            gl.disable(glow::SCISSOR_TEST);
        }
        self.draw_procedural(empty_vertex_array, 3);
    }
}
