//! Triangle culling on the GPU. A compute pass tests each triangle of a draw group and lists those that may be visible;
//! an indirect draw then draws the list. This is worthwhile because a data-center GPU rasterizes only about 0.4 G
//! triangles/s (an H200 draws the depth of 3 M triangles in 7.3 ms), while its compute throughput is high.
//!
//! # Tests
//! Culling removes triangles outside one plane of the view volume, back faces of single-sided materials, and triangles
//! so small that no sample lies in their bounding box. Occlusion culling also removes triangles behind nearer ones.
//! Each bound is widened by the rounding errors of the shaders and of the rasterizer, so that culling does not change
//! the image. The counts are read back with the pixels.
//!
//! # Occlusion culling
//! The occluders are the triangles that were visible in the last frame. Their depth is drawn at their current
//! positions, and reduced to a Hi-Z pyramid of farthest depths. All triangles are tested against the pyramid, and those
//! that are not culled are drawn into cleared images in their original order.
//!
//! The image does not depend on earlier frames: the occluders have the positions of this frame, so a triangle that is
//! strictly behind them at every sample is not visible. The number of culled triangles does depend on earlier frames.
//! The first frame has no occluders.
//!
//! Occluders are drawn twice: first their depth, later their ids among all visible triangles. Drawing them once with
//! ids, and then the other triangles, would not be exact: at equal depths, the later triangle in draw order must win.
//! A fragment shader cannot decide this: it cannot read the id that is already in the image, and a depth comparison in
//! the shader would force per-sample shading.
//! The depth is cleared between the two draws. Therefore the depths of both draws need to match only within the margin
//! of the occlusion test, not exactly.
//!
//! # Lists
//! The list of a group begins at the index of the group's first triangle. Its triangles are in draw order, because it
//! is compacted with a prefix sum over the bitmap of visible triangles, not with atomics. It contains vertex indices,
//! so that triangles still share transformed vertices. Fragments get the id of their triangle with one texel fetch.

use super::draw::{TriangleDraw, TriangleSet, bind_visibility, draw_groups};
use super::recorder::{FrameContext, PassRecorder};
use crate::device::gl::{ClearOp, PipelineState, Program};
use crate::layout::cull::MAX_LEVEL;
use crate::layout::{DEPTH_UNIT, TRIANGLE_ID_UNIT, pack_size};
use crate::pass::Pass;
use crate::pieces::PieceRange;
use crate::region::Band;
use crate::resources::cull::CullResources;
use crate::resources::depth_pyramid::DepthPyramid;
use crate::resources::programs::OcclusionPrograms;
use crate::resources::scene_buffers::SceneBuffers;
use crate::resources::target::RenderTarget;
use crate::scene_data::geometry::BlendMode;
use modalcast_model::error::Result;

/// Side of the square of pixels whose triangles a workgroup records as visible.
const RECORD_TILE: u32 = 8;
/// Levels that one dispatch computes from the coarsest existing level of the depth pyramid.
const LEVELS_PER_DISPATCH: u32 = 4;
const _: () = assert!(2 * LEVELS_PER_DISPATCH == MAX_LEVEL, "two dispatches must build the pyramid");
/// Side of the square of texels that a workgroup of the depth pyramid reduces.
const PYRAMID_TILE: u32 = 1 << LEVELS_PER_DISPATCH;

/// Runs the bound culling program, which marks visible triangles, and compacts the marked triangles to lists. The
/// caller has bound the inputs.
fn cull_and_compact(recorder: &PassRecorder<'_>, pass: Pass, cull_resources: &CullResources, compact: &Program) {
    let [columns, rows] = cull_resources.uniforms.dispatch_size();
    recorder.gl.dispatch(columns, rows);
    recorder.barrier_within_pass(pass);
    compact.bind(None);
    recorder.gl.dispatch(columns, rows);
    cull_resources.triangle_ids.bind(TRIANGLE_ID_UNIT);
}

/// Begins a pass that lists triangles: empties the lists and binds the buffers. `has_pieces`: whether parts of the lists
/// are drawn. The indices beyond the end of each list are then 0, so that they draw nothing.
fn begin_lists(recorder: &PassRecorder<'_>, pass: Pass, cull_resources: &CullResources, has_pieces: bool) {
    recorder.begin(pass);
    let buffers = &cull_resources.buffers;
    buffers.draws.write(&cull_resources.uniforms.empty_draws());
    if has_pieces {
        buffers.indices.write(&vec![0; buffers.indices.bytes as usize]);
    }
    cull_resources.bind();
}

/// Lists the triangles that may cast a shadow into one layer of the map. `size`: side of the map in texels. `set_layer`
/// sets the layer of the bound program. `has_pieces`: whether parts of the lists are drawn. Does nothing without culling.
pub(super) fn cull_shadow_casters(
    recorder: &PassRecorder<'_>,
    buffers: &SceneBuffers,
    size: u32,
    has_pieces: bool,
    set_layer: impl Fn(&Program),
) -> Result<()> {
    let (Some(cull_resources), Some(programs)) = (&buffers.cull_resources, &buffers.programs.shadow_cull) else {
        return Ok(());
    };
    begin_lists(recorder, Pass::ShadowCull, cull_resources, has_pieces);
    programs.cull_triangles.bind(Some(pack_size([size; 2])));
    set_layer(&programs.cull_triangles);
    cull_and_compact(recorder, Pass::ShadowCull, cull_resources, &programs.compact);
    recorder.check(Pass::ShadowCull)
}

/// Lists the triangles that were visible in the last frame, which are the occluders of this one. Does nothing without
/// occlusion culling.
pub(crate) fn list_occluders(recorder: &PassRecorder<'_>, frame: &FrameContext<'_>) -> Result<()> {
    let FrameContext { buffers, target, programs, has_pieces, .. } = *frame;
    let (Some(cull_resources), Some(programs)) = (&buffers.cull_resources, &programs.cull) else { return Ok(()) };
    let (Some(_), Some(occlusion)) = (&target.depth_pyramid, &programs.occlusion) else { return Ok(()) };
    begin_lists(recorder, Pass::Occluders, cull_resources, has_pieces);
    occlusion.cull_previous.bind(None);
    cull_and_compact(recorder, Pass::Occluders, cull_resources, &programs.compact);
    recorder.check(Pass::Occluders)
}

/// Draws the depth of the occluders in a range of the lists. Several calls draw consecutive ranges of all triangles. Does
/// nothing without occlusion culling.
pub(crate) fn draw_occluders(
    recorder: &mut PassRecorder<'_>,
    frame: &FrameContext<'_>,
    range: PieceRange,
) -> Result<()> {
    let FrameContext { buffers, target, programs, .. } = *frame;
    let Some(pyramid) = &target.depth_pyramid else { return Ok(()) };
    recorder.barrier_within_pass(Pass::Occluders);
    let clear = if range.first == 0 { ClearOp::Depth(Some(&target.dirty_regions.depth)) } else { ClearOp::Load };
    let band = Band::whole(target.desc.height);
    recorder.gl.begin_pass(&pyramid.occluder_fbo, target.draw_region.get(), band, clear);
    let programs_by_mode =
        [(BlendMode::Opaque, buffers.programs.opaque.as_deref()), (BlendMode::Mask, programs.mask.as_deref())];
    let state = PipelineState { depth_write: true, ..PipelineState::default() };
    for (blend_mode, program) in programs_by_mode {
        if let Some(program) = program {
            let draw = TriangleDraw { blend_mode, program, triangles: TriangleSet::Visible, range };
            draw_groups(recorder, buffers, draw, state);
        }
    }
    recorder.check(Pass::Occluders)
}

/// Lists the triangles that the camera may see. With occlusion culling, all occluders must be drawn before. Does nothing
/// without culling.
pub(crate) fn cull_for_camera(recorder: &mut PassRecorder<'_>, frame: &FrameContext<'_>) -> Result<()> {
    let FrameContext { buffers, target, programs, has_pieces, .. } = *frame;
    let (Some(cull_resources), Some(programs)) = (&buffers.cull_resources, &programs.cull) else { return Ok(()) };
    if let (Some(pyramid), Some(occlusion)) = (&target.depth_pyramid, &programs.occlusion) {
        build_pyramid(recorder, target, pyramid, occlusion);
        recorder.finish(Pass::Occluders)?;
    }
    begin_lists(recorder, Pass::Cull, cull_resources, has_pieces);
    if let Some(pyramid) = &target.depth_pyramid {
        pyramid.bind();
    }
    programs.cull_triangles.bind(Some(pack_size([target.desc.width, target.desc.height])));
    cull_and_compact(recorder, Pass::Cull, cull_resources, &programs.compact);
    recorder.finish(Pass::Cull)
}

/// Builds all levels of the pyramid from the depth of the occluders.
fn build_pyramid(
    recorder: &PassRecorder<'_>,
    target: &RenderTarget,
    pyramid: &DepthPyramid,
    programs: &OcclusionPrograms,
) {
    let size = [target.desc.width, target.desc.height];
    let workgroups = size.map(|side| side.div_ceil(PYRAMID_TILE));
    pyramid.bind();
    target.depth.bind(DEPTH_UNIT);
    programs.fine_levels.bind(Some(pack_size(size)));
    recorder.gl.dispatch(workgroups[0], workgroups[1]);
    recorder.barrier_within_pass(Pass::Occluders);
    programs.coarse_levels.bind(Some(pack_size(size)));
    recorder.gl.dispatch(workgroups[0].div_ceil(PYRAMID_TILE), workgroups[1].div_ceil(PYRAMID_TILE));
}

/// Records the visible triangles as the occluders of the next frame. Does nothing without occlusion culling.
pub(crate) fn record_visible(recorder: &PassRecorder<'_>, frame: &FrameContext<'_>) -> Result<()> {
    let FrameContext { buffers, target, programs, .. } = *frame;
    let occlusion = programs.cull.as_ref().and_then(|programs| programs.occlusion.as_ref());
    let (Some(cull_resources), Some(programs)) = (&buffers.cull_resources, occlusion) else { return Ok(()) };
    recorder.begin(Pass::RecordVisible);
    cull_resources.bind();
    bind_visibility(target);
    programs.record_visible.bind(None);
    recorder.gl.dispatch(target.desc.width.div_ceil(RECORD_TILE), target.desc.height.div_ceil(RECORD_TILE));
    recorder.check(Pass::RecordVisible)
}
