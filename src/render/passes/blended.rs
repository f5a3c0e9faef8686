//! Draws blended triangles: in draw order into one blend layer (an image of their light and transmittance), or with
//! exact transparency into fragment lists (`oit`).

use super::draw::{TriangleDraw, bind_shadow, draw_groups, triangle_set};
use super::recorder::{FrameContext, PassRecorder};
use crate::device::gl::{ClearOp, PipelineState};
use crate::pass::Pass;
use crate::region::Band;
use crate::scene_data::geometry::BlendMode;
use modalcast_model::error::Result;

/// Clear value of the blend layer: no light, full transmittance.
const CLEAR_LAYER: [f32; 4] = [0.0, 0.0, 0.0, 1.0];

/// Draws the blended triangles of a scene in a band in draw order, if the frame has a blend layer.
pub(crate) fn draw(recorder: &mut PassRecorder<'_>, frame: &FrameContext<'_>, band: Band) -> Result<()> {
    let FrameContext { buffers, target, programs, .. } = *frame;
    let (Some(program), Some(layer)) = (&programs.blended, &target.blend_layer) else { return Ok(()) };
    recorder.begin(Pass::Blended);
    let clear = ClearOp::Color(CLEAR_LAYER, &layer.dirty_region);
    recorder.gl.begin_pass(&layer.framebuffer, target.draw_region.get(), band, clear);
    bind_shadow(buffers);
    let draw = TriangleDraw { blend_mode: BlendMode::Blend, program, triangles: triangle_set(buffers) };
    draw_groups(recorder, buffers, draw, PipelineState { blend: true, ..PipelineState::default() });
    recorder.finish(Pass::Blended)
}
