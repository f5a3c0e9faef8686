//! Post-processing between shading and output bytes: bloom and tone curve, then the encoding.

use super::recorder::{FrameContext, PassRecorder};
use crate::device::gl::{Gl, Texture};
use crate::layout::{SOURCE_UNIT, TILE, WORDS_BINDING, WORKGROUP_SIZE};
use crate::pass::Pass;
use modalcast_model::error::Result;

/// Image unit that the bloom writes.
const DESTINATION_IMAGE: u32 = 0;

/// Spreads the bright light over the picture and applies the tone curve, in place.
pub(crate) fn bloom(recorder: &mut PassRecorder<'_>, frame: &FrameContext<'_>) -> Result<()> {
    let mips = &frame.target.bloom_mips;
    let (Some(bloom), Some(coarsest)) = (&frame.buffers.post.bloom, mips.last()) else { return Ok(()) };
    recorder.begin(Pass::Bloom);
    bloom.down.bind(None);
    for (from, to) in mips.iter().zip(mips.iter().skip(1)) {
        from.bind(SOURCE_UNIT);
        to.bind_image(DESTINATION_IMAGE);
        dispatch_tiles(recorder.gl, to);
        recorder.continue_pass(Pass::Bloom);
    }
    let mut from = coarsest;
    for (coarser, to) in (1..).zip(mips.iter().skip(1).rev().skip(1)) {
        bloom.up.bind(Some(coarser));
        from.bind(SOURCE_UNIT);
        to.bind_image_read_write(DESTINATION_IMAGE);
        dispatch_tiles(recorder.gl, to);
        recorder.continue_pass(Pass::Bloom);
        from = to;
    }
    // The last program has no uniform for the number of levels.
    bloom.last.bind(None);
    from.bind(SOURCE_UNIT);
    frame.target.scene_color.bind_image_read_write(DESTINATION_IMAGE);
    dispatch_tiles(recorder.gl, &frame.target.scene_color);
    recorder.finish(Pass::Bloom)
}

/// Encodes the picture to bytes in a buffer that can be copied to the host.
pub(crate) fn encode(recorder: &mut PassRecorder<'_>, frame: &FrameContext<'_>) -> Result<()> {
    let target = frame.target;
    recorder.begin(Pass::Encode);
    frame.buffers.post.encode.bind(None);
    target.scene_color.bind(SOURCE_UNIT);
    target.readback_source.bind_storage(WORDS_BINDING);
    recorder.gl.dispatch(target.desc.width.div_ceil(WORKGROUP_SIZE), target.desc.height);
    recorder.finish(Pass::Encode)
}

fn dispatch_tiles(gl: &Gl, of: &Texture) {
    gl.dispatch(of.desc.width.div_ceil(TILE), of.desc.height.div_ceil(TILE));
}
