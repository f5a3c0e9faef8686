//! OpenGL commands that only triangle culling uses.

use glow::HasContext as _;

use super::{Buffer, Gl};

/// GL_SUBPIXEL_BITS, which glow does not define.
const SUBPIXEL_BITS: u32 = 0x0D50;

impl Gl {
    /// Largest step of the rasterizer's subpixel grid, in pixels.
    pub(crate) fn subpixel_step(&self) -> f32 {
        // SAFETY: a query that every context answers, with at least 4.
        let bits = unsafe { self.current().get_parameter_i32(SUBPIXEL_BITS) };
        0.5_f32.powi(bits.clamp(0, 16))
    }

    /// Copies `bytes` bytes between byte offsets of two buffers.
    pub(crate) fn copy_range(&self, (from, first): (&Buffer, usize), (to, place): (&Buffer, usize), bytes: usize) {
        let gl = self.current();
        // SAFETY: OpenGL rejects ranges outside either buffer.
        unsafe {
            gl.bind_buffer(glow::COPY_READ_BUFFER, Some(from.name));
            gl.bind_buffer(glow::COPY_WRITE_BUFFER, Some(to.name));
            let (read, write) = (glow::COPY_READ_BUFFER, glow::COPY_WRITE_BUFFER);
            gl.copy_buffer_sub_data(read, write, first as i32, place as i32, bytes as i32);
        }
    }
}
