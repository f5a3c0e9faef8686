//! Visibility buffer: the triangle id and the depth of each sample.

use super::draw::{TriangleDraw, TriangleSet, draw_groups, triangle_set};
use super::recorder::{FrameContext, PassRecorder};
use crate::device::gl::{ClearOp, Framebuffer, PipelineState, Program};
use crate::pass::Pass;
use crate::pieces::PieceRange;
use crate::region::{Band, Region};
use crate::resources::scene_buffers::SceneBuffers;
use crate::scene_data::geometry::BlendMode;
use crate::types::RasterBackend;
use modalcast_model::error::Result;

/// Parameters of a draw of ids and depth. The framebuffer must be at least as large as the frame of the region.
#[derive(Debug)]
pub(super) struct IdDraw<'a> {
    pub(super) framebuffer: &'a Framebuffer,
    pub(super) clear: ClearOp<'a>,
    pub(super) region: Region,
    /// The rows of the frame that are drawn and cleared.
    pub(super) band: Band,
    pub(super) triangles: TriangleSet,
    /// The triangles that are drawn. Nothing is cleared unless they begin with the first triangle of the scene.
    pub(super) range: PieceRange,
    /// Draws cut-outs; none without such triangles.
    pub(super) mask: Option<&'a Program>,
    /// Draws the opaque parts of blended triangles; none if blended triangles are not drawn.
    pub(super) opaque_parts: Option<&'a Program>,
}

/// Draws the id and depth of each sample in a band. Several calls draw consecutive ranges of all triangles.
pub(crate) fn draw(
    recorder: &mut PassRecorder<'_>,
    frame: &FrameContext<'_>,
    band: Band,
    range: PieceRange,
) -> Result<()> {
    let FrameContext { buffers, target, programs, .. } = *frame;
    // Multisampled ids are not cleared, which saves time: shaders also read the depth, which tells which ids are valid.
    let clear = match target.desc.samples {
        1 => ClearOp::DepthAndIds(Some(&target.dirty_regions)),
        _ => ClearOp::Depth(Some(&target.dirty_regions.depth)),
    };
    recorder.begin(Pass::Visibility);
    let ids = IdDraw {
        framebuffer: &target.visibility_fbo,
        clear,
        region: target.draw_region.get(),
        band,
        triangles: triangle_set(buffers),
        range,
        mask: programs.mask.as_deref(),
        opaque_parts: programs.opaque_parts.as_deref(),
    };
    draw_ids(recorder, buffers, &ids)
}

/// Draws ids and depth of the triangles of each blend mode that has a program.
pub(super) fn draw_ids(recorder: &mut PassRecorder<'_>, buffers: &SceneBuffers, ids: &IdDraw<'_>) -> Result<()> {
    let clear = if ids.range.first == 0 { ids.clear } else { ClearOp::Load };
    recorder.gl.begin_pass(ids.framebuffer, ids.region, ids.band, clear);
    // Cut-outs are drawn after opaque triangles, so that the depth test can save their texture lookups.
    let programs = [
        (BlendMode::Opaque, buffers.programs.opaque.as_deref()),
        (BlendMode::Mask, ids.mask),
        (BlendMode::Blend, ids.opaque_parts),
    ];
    let state = PipelineState { depth_write: true, ..PipelineState::default() };
    let mut has_program = false;
    for (blend_mode, program) in programs {
        if let Some(program) = program {
            let IdDraw { triangles, range, .. } = *ids;
            draw_groups(recorder, buffers, TriangleDraw { blend_mode, program, triangles, range }, state);
            has_program = true;
        }
    }
    if has_program {
        recorder.add_to_stats(Pass::Visibility);
        recorder.stats.raster_backends.visibility = Some(RasterBackend::OpenGl);
    }
    recorder.check(Pass::Visibility)
}
