//! Hierarchical depth pyramid: the farthest depth of ever larger squares of a frame.

use std::rc::Rc;

use super::super::programs::SampleCountPrograms;
use super::super::shaders::DEPTH_UNIT;
use super::super::target::TargetDesc;
use crate::device::gl::{self, Buffer, Framebuffer, Gl, Texture};
use modalcast_model::error::Result;

/// The coarsest level: squares of 2^8 pixels.
pub(crate) const MAX_LEVEL: u32 = 8;
/// Levels that one dispatch adds to its first level, and the side of the square of texels that a workgroup reduces.
const LEVELS_PER_PASS: u32 = 4;
const WORKGROUP_SIDE: u32 = 1 << LEVELS_PER_PASS;
const PYRAMID: u32 = 4;

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

    /// Builds all levels from the current depth.
    pub(crate) fn build(&self, gl: &Gl, (depth, desc): (&Texture, TargetDesc), sample_programs: &SampleCountPrograms) {
        let Some([fine, coarse]) = sample_programs.cull.as_ref().and_then(|cull| cull.pyramid.as_ref()) else { return };
        let groups = [desc.width, desc.height].map(|side| side.div_ceil(WORKGROUP_SIDE));
        self.bind();
        depth.bind(DEPTH_UNIT);
        fine.bind(Some(pack_size(desc)));
        gl.dispatch(groups[0], groups[1]);
        coarse.bind(Some(pack_size(desc)));
        gl.dispatch(groups[0].div_ceil(WORKGROUP_SIDE), groups[1].div_ceil(WORKGROUP_SIDE));
    }

    pub(crate) fn bind(&self) {
        self.depths.bind_storage(PYRAMID);
    }
}

/// Width and height in one word, as the shaders expect them.
pub(crate) const fn pack_size(desc: TargetDesc) -> u32 {
    desc.width | desc.height << 16
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_turns_reach_the_top_and_each_level_is_half_as_wide() {
        assert_eq!(2 * LEVELS_PER_PASS, MAX_LEVEL);
        assert_eq!(texels([1, 1]), 9);
        assert_eq!(texels([256, 256]), (0..=8).map(|level| 1 << (2 * level)).sum::<u64>());
        assert_eq!(texels([3, 5]), 15 + 6 + 2 + 6);
    }
}
