//! Draws blended triangles: in draw order into one blend layer (an image of their light and transmittance), or with
//! exact transparency into fragment lists (`oit`).

use super::draw::{TriangleDraw, bind_shadow, draw_groups, triangle_set};
use super::recorder::{FrameContext, PassRecorder};
use crate::device::gl::{ClearOp, PipelineState};
use crate::pass::Pass;
use crate::scene_data::geometry::BlendMode;
use modalcast_model::error::Result;

/// Clear value of the blend layer: no light, full transmittance.
const CLEAR_LAYER: [f32; 4] = [0.0, 0.0, 0.0, 1.0];

/// Draws the blended triangles of a scene, if it has any.
pub(crate) fn draw(recorder: &mut PassRecorder<'_>, frame: &FrameContext<'_>) -> Result<()> {
    let FrameContext { buffers, target, programs, .. } = *frame;
    if let (Some(programs), Some(oit)) = (&programs.oit, &target.oit) {
        return super::oit::draw(recorder, buffers, oit, programs, target.draw_region.get());
    }
    let (Some(program), Some(layer)) = (&programs.blended, &target.blend_layer) else { return Ok(()) };
    recorder.begin(Pass::Blended);
    let clear = ClearOp::Color(CLEAR_LAYER, &layer.dirty_region);
    recorder.gl.begin_pass(&layer.framebuffer, target.draw_region.get(), clear);
    bind_shadow(buffers);
    let draw = TriangleDraw { blend_mode: BlendMode::Blend, program, triangles: triangle_set(buffers) };
    draw_groups(recorder, buffers, draw, PipelineState { blend: true, ..PipelineState::default() });
    recorder.finish(Pass::Blended)
}
