//! Draws blended triangles: in draw order into one blend layer (an image of their light and transmittance), or with
//! exact transparency into fragment lists (`oit`).

use super::draw::{TriangleDraw, bind_shadow, draw_groups, triangle_set};
use super::recorder::{FrameContext, PassRecorder};
use crate::device::gl::{ClearOp, PipelineState};
use crate::pass::Pass;
use crate::pieces::PieceRange;
use crate::region::Band;
use crate::scene_data::geometry::BlendMode;
use modalcast_model::error::Result;

/// Clear value of the blend layer: no light, full transmittance.
const CLEAR_LAYER: [f32; 4] = [0.0, 0.0, 0.0, 1.0];

/// Draws blended triangles in a band in draw order, if the frame has a blend layer. Several calls draw consecutive
/// ranges of all blended triangles.
pub(crate) fn draw(
    recorder: &mut PassRecorder<'_>,
    frame: &FrameContext<'_>,
    band: Band,
    range: PieceRange,
) -> Result<()> {
    let FrameContext { buffers, target, programs, .. } = *frame;
    let (Some(program), Some(layer)) = (&programs.blended, &target.blend_layer) else { return Ok(()) };
    recorder.begin(Pass::Blended);
    let is_first = range.first <= buffers.triangle_range(BlendMode::Blend).first;
    let clear = if is_first { ClearOp::Color(CLEAR_LAYER, &layer.dirty_region) } else { ClearOp::Load };
    recorder.gl.begin_pass(&layer.framebuffer, target.draw_region.get(), band, clear);
    bind_shadow(buffers);
    let draw = TriangleDraw { blend_mode: BlendMode::Blend, program, triangles: triangle_set(buffers), range };
    draw_groups(recorder, buffers, draw, PipelineState { blend: true, ..PipelineState::default() });
    recorder.finish(Pass::Blended)
}
