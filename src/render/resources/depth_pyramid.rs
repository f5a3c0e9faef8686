//! Hi-Z pyramid: each texel is the farthest depth of 2 x 2 texels of the next finer level, that is, the smallest,
//! because depth is reversed. Level 0 has one texel per pixel.

use std::rc::Rc;

use super::target_desc::TargetDesc;
use crate::device::gl::{self, Buffer, Framebuffer, Gl, Texture};
use crate::layout::cull::{MAX_LEVEL, PYRAMID_BINDING};
use modalcast_model::error::Result;

/// Hi-Z pyramid for occlusion culling, and the framebuffer into which the occluders are drawn. Valid for one
/// [`TargetDesc`].
#[derive(Debug)]
pub(crate) struct DepthPyramid {
    /// Depth-only framebuffer; shares the depth texture of the frame.
    pub(crate) occluder_fbo: Framebuffer,
    /// Depths of all levels, one level after another.
    levels: Buffer,
}

/// Number of texels of all levels.
fn count_texels([mut width, mut height]: [u32; 2]) -> u64 {
    let mut sum = 0;
    for _ in 0..=MAX_LEVEL {
        sum += u64::from(width) * u64::from(height);
        (width, height) = (width.div_ceil(2), height.div_ceil(2));
    }
    sum
}

impl DepthPyramid {
    pub(crate) fn new(gl: &Rc<Gl>, desc: TargetDesc, depth: &Texture) -> Result<Self> {
        let levels = gl.buffer(4 * count_texels([desc.width, desc.height]), gl::STREAM_COPY, None)?;
        Ok(Self { occluder_fbo: gl.framebuffer(None, depth)?, levels })
    }

    /// Binds the levels for the programs that build them or test triangles against them.
    pub(crate) fn bind(&self) {
        self.levels.bind_storage(PYRAMID_BINDING);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn level_sizes_are_halved_and_rounded_up() {
        assert_eq!(count_texels([1, 1]), 9, "expected one texel in each of nine levels");
        assert_eq!(count_texels([256, 256]), (0..=8).map(|level| 1 << (2 * level)).sum::<u64>());
        // 3 x 5, 2 x 3, 1 x 2, and six levels of 1 x 1.
        assert_eq!(count_texels([3, 5]), 15 + 6 + 2 + 6);
    }
}
