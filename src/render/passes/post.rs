//! Post-processing: bloom, then sRGB encoding to the readback buffer.

use super::recorder::{FrameContext, PassRecorder};
use crate::device::gl::Texture;
use crate::layout::{SOURCE_UNIT, TILE, WORDS_BINDING, WORKGROUP_SIZE};
use crate::pass::Pass;
use crate::region::Band;
use crate::resources::target::RenderTarget;
use modalcast_model::error::Result;

/// Image unit that the bloom writes.
const DESTINATION_IMAGE: u32 = 0;

/// A step of the bloom. Each step reads the result of the step before it.
#[derive(Debug, Clone, Copy)]
pub(crate) enum BloomStep {
    /// Computes a level of the pyramid from the next finer one.
    Downsample { level: usize },
    /// Replaces a level by the mean of itself and all `coarser_levels` coarser levels. The next coarser level already
    /// has the mean of these.
    Upsample { level: usize, coarser_levels: u32 },
    /// Adds level 1 to the scene color, in place: inverts the tone curve, adds the blurred light and applies the curve
    /// again.
    Composite,
}

/// The steps of the bloom in execution order, each with the image that it writes; none without bloom.
pub(crate) fn bloom_steps(target: &RenderTarget) -> impl Iterator<Item = (BloomStep, &Texture)> {
    let mips = &target.bloom_mips;
    let downsample = (1..mips.len()).map(|level| (BloomStep::Downsample { level }, &mips[level]));
    let coarsest_level = mips.len().saturating_sub(1);
    let upsample = (1..coarsest_level)
        .rev()
        .zip(1..)
        .map(|(level, coarser_levels)| (BloomStep::Upsample { level, coarser_levels }, &mips[level]));
    let composite = (!mips.is_empty()).then_some((BloomStep::Composite, &target.scene_color));
    downsample.chain(upsample).chain(composite)
}

/// Executes a step of the bloom for a band of the image that it writes.
pub(crate) fn bloom(
    recorder: &mut PassRecorder<'_>,
    frame: &FrameContext<'_>,
    step: BloomStep,
    band: Band,
) -> Result<()> {
    let (Some(bloom), mips) = (&frame.buffers.post.bloom, &frame.target.bloom_mips) else { return Ok(()) };
    recorder.begin(Pass::Bloom);
    let (program, uniform, source_level, destination) = match step {
        BloomStep::Downsample { level } => (&bloom.downsample, None, level - 1, &mips[level]),
        BloomStep::Upsample { level, coarser_levels } => {
            (&bloom.upsample, Some(coarser_levels), level + 1, &mips[level])
        }
        BloomStep::Composite => (&bloom.composite, None, 1, &frame.target.scene_color),
    };
    program.bind(uniform);
    program.set_first_row(band.first_row);
    mips[source_level].bind(SOURCE_UNIT);
    match step {
        BloomStep::Downsample { .. } => destination.bind_image(DESTINATION_IMAGE),
        BloomStep::Upsample { .. } | BloomStep::Composite => destination.bind_image_read_write(DESTINATION_IMAGE),
    }
    recorder.gl.dispatch(destination.desc.width.div_ceil(TILE), band.rows.div_ceil(TILE));
    recorder.finish(Pass::Bloom)
}

/// Encodes a band of the scene color to sRGB bytes in the picture that CUDA reads too, or without one in the source of
/// the readback.
pub(crate) fn encode(recorder: &mut PassRecorder<'_>, frame: &FrameContext<'_>, band: Band) -> Result<()> {
    let (target, program) = (frame.target, frame.encode);
    recorder.begin(Pass::Encode);
    program.bind(None);
    program.set_first_row(band.first_row);
    target.scene_color.bind(SOURCE_UNIT);
    frame.picture.unwrap_or(&target.readback_source).bind_storage(WORDS_BINDING);
    recorder.gl.dispatch(target.desc.width.div_ceil(WORKGROUP_SIZE), band.rows);
    recorder.finish(Pass::Encode)
}
