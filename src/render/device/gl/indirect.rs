//! OpenGL commands for lists that shaders write: indirect draws.

use glow::HasContext as _;

use super::{Buffer, Gl, VertexArray};

impl Gl {
    /// Draws triangles of an array's index buffer with an indirect command, which a shader may have written.
    pub(crate) fn draw_indexed_indirect(&self, array: &VertexArray, commands: &Buffer, offset: usize) {
        let Some(gl) = self.functions_or_skip() else { return };
        // SAFETY: the command names a checked range of the index buffer. Shaders change only the number of instances or
        // of indices; they write the indices themselves, from checked ones and never beyond the range.
        unsafe {
            gl.bind_vertex_array(Some(array.name));
            gl.bind_buffer(glow::DRAW_INDIRECT_BUFFER, Some(commands.name()));
            gl.draw_elements_indirect_offset(glow::TRIANGLES, glow::UNSIGNED_INT, offset as i32);
            gl.bind_vertex_array(None);
        }
    }
}
