//! The commands that lists of triangles need beside the others.

use glow::HasContext as _;

use super::{Buffer, Gl};

/// Bits of a place within a pixel; not among glow's constants.
const SUBPIXEL_BITS: u32 = 0x0D50;

impl Gl {
    /// The part of a pixel to which the rasteriser rounds places, at most.
    pub(crate) fn grid(&self) -> f32 {
        // SAFETY: a plain question that every context answers, with 4 or more.
        let bits = unsafe { self.on().get_parameter_i32(SUBPIXEL_BITS) };
        0.5_f32.powi(bits.clamp(0, 16))
    }

    /// Copies `bytes` bytes, from and to a place in each buffer.
    pub(crate) fn copy_part(&self, (from, first): (&Buffer, usize), (to, place): (&Buffer, usize), bytes: usize) {
        let gl = self.on();
        // SAFETY: OpenGL refuses ranges outside either buffer.
        unsafe {
            gl.bind_buffer(glow::COPY_READ_BUFFER, Some(from.name));
            gl.bind_buffer(glow::COPY_WRITE_BUFFER, Some(to.name));
            let (read, write) = (glow::COPY_READ_BUFFER, glow::COPY_WRITE_BUFFER);
            gl.copy_buffer_sub_data(read, write, first as i32, place as i32, bytes as i32);
        }
    }
}
