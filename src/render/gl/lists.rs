//! The commands that lists of fragments need beside the others.

use std::rc::Rc;

use glow::HasContext as _;

use super::{Buffer, Framebuffer, Gl, Texture, VertexArray};
use modalcast_model::error::Result;

impl Gl {
    /// A framebuffer without depth.
    pub(crate) fn colour_framebuffer(self: &Rc<Self>, colour: &Texture) -> Result<Framebuffer> {
        self.attached(Some(colour), None)
    }

    /// Draws triangles of an array's index buffer as a command in a buffer says, which a shader may have written.
    pub(crate) fn draw_told(&self, array: &VertexArray, commands: &Buffer, offset: usize) {
        let gl = self.on();
        // SAFETY: the command names a checked range of the index buffer; of it shaders change the number of instances, or
        // of indices, which they have written themselves from checked ones and never beyond the range.
        unsafe {
            gl.bind_vertex_array(Some(array.name));
            gl.bind_buffer(glow::DRAW_INDIRECT_BUFFER, Some(commands.name));
            gl.draw_elements_indirect_offset(glow::TRIANGLES, glow::UNSIGNED_INT, offset as i32);
            gl.bind_vertex_array(None);
        }
    }

    /// Lets everything after this see what shaders wrote.
    pub(crate) fn wait_for_stores(&self) {
        // SAFETY: only orders memory.
        unsafe { self.on().memory_barrier(glow::ALL_BARRIER_BITS) }
    }
}
