//! Post-processing: bloom, then sRGB encoding to the readback buffer.

use super::recorder::{FrameContext, PassRecorder};
use crate::device::gl::{Gl, Texture};
use crate::layout::{SOURCE_UNIT, TILE, WORDS_BINDING, WORKGROUP_SIZE};
use crate::pass::Pass;
use modalcast_model::error::Result;

/// Image unit that the bloom writes.
const DESTINATION_IMAGE: u32 = 0;

/// Adds bloom to the scene color, in place. The composite program inverts the tone curve, adds the blurred light and
/// applies the curve again.
pub(crate) fn bloom(recorder: &mut PassRecorder<'_>, frame: &FrameContext<'_>) -> Result<()> {
    let mips = &frame.target.bloom_mips;
    let (Some(bloom), Some(coarsest_mip)) = (&frame.buffers.post.bloom, mips.last()) else { return Ok(()) };
    recorder.begin(Pass::Bloom);
    bloom.downsample.bind(None);
    for (source, destination) in mips.iter().zip(mips.iter().skip(1)) {
        source.bind(SOURCE_UNIT);
        destination.bind_image(DESTINATION_IMAGE);
        dispatch_tiles(recorder.gl, destination);
        recorder.barrier_within_pass(Pass::Bloom);
    }
    let mut source = coarsest_mip;
    // The destinations are all levels from the second coarsest to level 1. `coarser_levels`: number of levels whose
    // mean `source` contains.
    for (coarser_levels, destination) in (1..).zip(mips.iter().skip(1).rev().skip(1)) {
        bloom.upsample.bind(Some(coarser_levels));
        source.bind(SOURCE_UNIT);
        destination.bind_image_read_write(DESTINATION_IMAGE);
        dispatch_tiles(recorder.gl, destination);
        recorder.barrier_within_pass(Pass::Bloom);
        source = destination;
    }
    // The composite program has no uniform `coarser_levels`.
    bloom.composite.bind(None);
    source.bind(SOURCE_UNIT);
    frame.target.scene_color.bind_image_read_write(DESTINATION_IMAGE);
    dispatch_tiles(recorder.gl, &frame.target.scene_color);
    recorder.finish(Pass::Bloom)
}

/// Encodes the scene color to sRGB bytes in the readback source.
pub(crate) fn encode(recorder: &mut PassRecorder<'_>, frame: &FrameContext<'_>) -> Result<()> {
    let target = frame.target;
    recorder.begin(Pass::Encode);
    frame.buffers.post.encode.bind(None);
    target.scene_color.bind(SOURCE_UNIT);
    target.readback_source.bind_storage(WORDS_BINDING);
    recorder.gl.dispatch(target.desc.width.div_ceil(WORKGROUP_SIZE), target.desc.height);
    recorder.finish(Pass::Encode)
}

/// Dispatches a workgroup for each tile of a texture.
fn dispatch_tiles(gl: &Gl, texture: &Texture) {
    gl.dispatch(texture.desc.width.div_ceil(TILE), texture.desc.height.div_ceil(TILE));
}
