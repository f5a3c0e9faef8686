//! Indirect draws, whose commands shaders may write.

use glow::HasContext as _;

use super::{Buffer, Gl, VertexArray};

impl Gl {
    /// Draws triangles of the index buffer of `array` with the indirect draw command at byte `offset` of `commands`.
    pub(crate) fn draw_indexed_indirect(&self, array: &VertexArray, commands: &Buffer, offset: usize) {
        let Some(gl) = self.functions_or_skip() else { return };
        // SAFETY: the host has written a command with a valid range of the index buffer. In the command, shaders change
        // only the number of instances or of indices. In the index buffer, they write only copies of valid indices,
        // inside of that range.
        unsafe {
            gl.bind_vertex_array(Some(array.name));
            gl.bind_buffer(glow::DRAW_INDIRECT_BUFFER, Some(commands.name()));
            gl.draw_elements_indirect_offset(glow::TRIANGLES, glow::UNSIGNED_INT, offset as i32);
            gl.bind_vertex_array(None);
        }
    }
}
