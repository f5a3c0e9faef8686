//! The ambient occlusion pass: finds the surface at each texel, computes its visibility, and filters the noise.

use super::draw::bind_visibility;
use super::recorder::{FrameContext, PassRecorder};
use crate::layout::{NOISY_VISIBILITY_UNIT, SOURCE_UNIT, TILE};
use crate::pass::Pass;
use crate::region::Band;
use modalcast_model::error::Result;

/// Image unit of the output.
const OUTPUT_IMAGE: u32 = 0;

/// A step of the pass. Each step reads the output of the previous step at neighboring texels, so all bands of a step
/// are executed before the next step.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum AmbientStep {
    Surface,
    Occlusion,
    Filter,
}

impl AmbientStep {
    /// The steps in execution order.
    pub(crate) const ALL: [Self; 3] = [Self::Surface, Self::Occlusion, Self::Filter];
}

/// Executes a step for a band of its output.
pub(crate) fn draw(
    recorder: &mut PassRecorder<'_>,
    frame: &FrameContext<'_>,
    step: AmbientStep,
    band: Band,
) -> Result<()> {
    let (Some(images), Some(programs)) = (&frame.target.ambient, &frame.programs.ambient) else { return Ok(()) };
    recorder.begin(Pass::AmbientOcclusion);
    bind_visibility(frame.target);
    images.surface.bind(SOURCE_UNIT);
    images.noisy_visibility.bind(NOISY_VISIBILITY_UNIT);
    let (program, output) = match step {
        AmbientStep::Surface => (&programs.surface, &images.surface),
        AmbientStep::Occlusion => (&programs.occlusion, &images.noisy_visibility),
        AmbientStep::Filter => (&programs.filter, &images.visibility),
    };
    output.bind_image(OUTPUT_IMAGE);
    program.bind(None);
    program.set_first_row(band.first_row);
    recorder.gl.dispatch(output.desc.width.div_ceil(TILE), band.rows.div_ceil(TILE));
    recorder.finish(Pass::AmbientOcclusion)
}
