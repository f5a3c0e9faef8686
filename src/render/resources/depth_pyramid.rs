//! Hierarchical depth pyramid: the farthest depth of ever larger squares of a frame.

use std::rc::Rc;

use super::target_desc::TargetDesc;
use crate::device::gl::{self, Buffer, Framebuffer, Gl, Texture};
use crate::layout::cull::{MAX_LEVEL, PYRAMID_BINDING};
use modalcast_model::error::Result;

/// Framebuffer of the occluders and the pyramid of their depth, for frames of one form.
#[derive(Debug)]
pub(crate) struct DepthPyramid {
    /// Framebuffer with the frame's depth only.
    pub(crate) occluders: Framebuffer,
    depths: Buffer,
}

/// Texels of all levels.
fn texels([mut width, mut height]: [u32; 2]) -> u64 {
    let mut sum = 0;
    for _ in 0..=MAX_LEVEL {
        sum += u64::from(width) * u64::from(height);
        (width, height) = (width.div_ceil(2), height.div_ceil(2));
    }
    sum
}

impl DepthPyramid {
    pub(crate) fn new(gl: &Rc<Gl>, desc: TargetDesc, depth: &Texture) -> Result<Self> {
        let depths = gl.buffer(4 * texels([desc.width, desc.height]), gl::STREAM_COPY, None)?;
        Ok(Self { occluders: gl.framebuffer(None, depth)?, depths })
    }

    /// Binds the levels for the programs that write or test them.
    pub(crate) fn bind(&self) {
        self.depths.bind_storage(PYRAMID_BINDING);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_level_is_half_as_wide_rounded_up() {
        assert_eq!(texels([1, 1]), 9);
        assert_eq!(texels([256, 256]), (0..=8).map(|level| 1 << (2 * level)).sum::<u64>());
        assert_eq!(texels([3, 5]), 15 + 6 + 2 + 6);
    }
}
