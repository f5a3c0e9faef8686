//! Triangle culling on the GPU. Before the rasterizer processes a group of triangles, a compute pass tests each
//! triangle and lists those that may be visible; one indirect draw per group draws the list. Rasterizer throughput is
//! scarce (about 0.4 G triangles/s on a data-center GPU), compute throughput is not.
//!
//! # Tests
//! Culling removes triangles outside one plane of the view volume, back faces of single-sided materials, triangles so
//! small that no sample lies in their bounding box and, if the look asks for it, triangles behind nearer ones. Each
//! bound is widened by the rounding errors of the shaders and of the rasterizer, so that culling changes no bit of the
//! picture. The counts are read back with the pixels.
//!
//! # Occlusion culling
//! The pass first draws the depth of the triangles that the last frame saw, at their current positions. A hierarchical
//! depth pyramid holds the farthest depth of ever larger squares. All triangles are tested against the pyramid, and the
//! survivors are drawn into a cleared image in their original order. The picture does not depend on the history. The
//! occluders have this frame's positions, so a triangle strictly behind their depth at every sample is also behind the
//! picture's depth and would not be visible. The set of hidden triangles, and so their count, does depend on the
//! history: the first frame hides none.
//!
//! Drawing the remembered triangles once, with ids, and then only the rest would avoid drawing them twice, but it is
//! not exact: at equal depths the later triangle must win, and one of the rest may have equal depth and an earlier
//! position. Fragment shaders cannot read the current id, and a depth comparison in the shader would force per-sample
//! shading. The occluders are therefore drawn twice, the first time without ids. The depth is cleared in between
//! because the depths of both draws would otherwise have to match to the bit; with the clear they only need to match
//! within the margin.
//!
//! # Lists
//! A list keeps the order of its triangles, because it is compacted with a prefix sum over bits instead of atomics, and
//! begins at the offset of its group. It holds indices and not only triangles, so that triangles still share
//! transformed vertices: without an index buffer, each vertex would be transformed three times. Fragments find the id
//! of their triangle with one texel fetch, which is uniform over a triangle.

use super::draw::{KindDraw, TriangleSet, bind_visibility, draw_groups};
use super::recorder::{FrameContext, PassRecorder};
use crate::device::gl::{ClearOp, PipelineState, Program};
use crate::layout::cull::MAX_LEVEL;
use crate::layout::{DEPTH_UNIT, TRIANGLE_ID_UNIT, pack_size};
use crate::pass::Pass;
use crate::resources::cull::TriangleCuller;
use crate::resources::depth_pyramid::DepthPyramid;
use crate::resources::programs::OcclusionPrograms;
use crate::resources::scene_buffers::SceneBuffers;
use crate::resources::target::RenderTarget;
use crate::scene_data::geometry::BlendMode;
use modalcast_model::error::Result;

/// Side of the square of pixels whose ids one workgroup records.
const RECORD_TILE: u32 = 8;
/// Levels that one dispatch adds to the depth pyramid below its first level; two dispatches reach the coarsest level.
const LEVELS_PER_DISPATCH: u32 = 4;
const _: () = assert!(2 * LEVELS_PER_DISPATCH == MAX_LEVEL, "two dispatches build the pyramid");
/// Side of the square of texels that a workgroup of the pyramid reduces.
const PYRAMID_TILE: u32 = 1 << LEVELS_PER_DISPATCH;

/// Runs the bound culling program and compacts its result to lists. The caller has bound their inputs.
fn compact_triangles(recorder: &PassRecorder<'_>, pass: Pass, culler: &TriangleCuller, compact: &Program) {
    let [wide, tall] = culler.uniforms.dispatch();
    recorder.gl.dispatch(wide, tall);
    recorder.continue_pass(pass);
    compact.bind(None);
    recorder.gl.dispatch(wide, tall);
    culler.triangle_ids.bind(TRIANGLE_ID_UNIT);
}

/// Begins a pass that lists triangles: empties the lists and binds the buffers.
fn begin_lists(recorder: &PassRecorder<'_>, pass: Pass, culler: &TriangleCuller) {
    recorder.begin(pass);
    culler.buffers.draws.write(&culler.uniforms.empty_draws());
    culler.bind();
}

/// Lists the triangles that may cast a shadow into one layer of the map, whose side is `size` texels. `set_layer` sets
/// the layer of the bound program. Does nothing in a scene that is not culled.
pub(super) fn cull_shadow_casters(
    recorder: &PassRecorder<'_>,
    buffers: &SceneBuffers,
    size: u32,
    set_layer: impl Fn(&Program),
) -> Result<()> {
    let (Some(culler), Some(programs)) = (&buffers.culler, &buffers.programs.shadow_cull) else { return Ok(()) };
    begin_lists(recorder, Pass::ShadowCull, culler);
    programs.cull_triangles.bind(Some(pack_size([size; 2])));
    set_layer(&programs.cull_triangles);
    compact_triangles(recorder, Pass::ShadowCull, culler, &programs.compact);
    recorder.check(Pass::ShadowCull)
}

/// Lists the triangles that the camera may see. Does nothing in a scene that is not culled.
pub(crate) fn cull_for_camera(recorder: &mut PassRecorder<'_>, frame: &FrameContext<'_>) -> Result<()> {
    let FrameContext { buffers, target, programs, .. } = *frame;
    let (Some(culler), Some(programs)) = (&buffers.culler, &programs.cull) else { return Ok(()) };
    if let (Some(pyramid), Some(occlusion)) = (&target.pyramid, &programs.occlusion) {
        begin_lists(recorder, Pass::Occluders, culler);
        occlusion.cull_previous.bind(None);
        compact_triangles(recorder, Pass::Occluders, culler, &programs.compact);
        recorder.continue_pass(Pass::Occluders);
        draw_occluders(recorder, frame, pyramid);
        build_pyramid(recorder, target, pyramid, occlusion);
        recorder.finish(Pass::Occluders)?;
    }
    begin_lists(recorder, Pass::Cull, culler);
    if let Some(pyramid) = &target.pyramid {
        pyramid.bind();
    }
    programs.cull_triangles.bind(Some(pack_size([target.desc.width, target.desc.height])));
    compact_triangles(recorder, Pass::Cull, culler, &programs.compact);
    recorder.finish(Pass::Cull)
}

/// Draws the depth of the listed triangles.
fn draw_occluders(recorder: &mut PassRecorder<'_>, frame: &FrameContext<'_>, pyramid: &DepthPyramid) {
    let FrameContext { buffers, target, programs, .. } = *frame;
    let clear = ClearOp::Depth(Some(&target.dirty.depth));
    recorder.gl.begin_pass(&pyramid.occluders, target.draw_region.get(), clear);
    let kinds = [(BlendMode::Opaque, buffers.programs.opaque.as_deref()), (BlendMode::Mask, programs.mask.as_deref())];
    let state = PipelineState { depth_write: true, ..PipelineState::default() };
    for (blend_mode, program) in kinds {
        if let Some(program) = program {
            draw_groups(recorder, buffers, KindDraw { blend_mode, program, set: TriangleSet::Visible }, state);
        }
    }
}

/// Builds all levels of the pyramid from the current depth.
fn build_pyramid(
    recorder: &PassRecorder<'_>,
    target: &RenderTarget,
    pyramid: &DepthPyramid,
    programs: &OcclusionPrograms,
) {
    let size = [target.desc.width, target.desc.height];
    let groups = size.map(|side| side.div_ceil(PYRAMID_TILE));
    pyramid.bind();
    target.depth.bind(DEPTH_UNIT);
    programs.fine_levels.bind(Some(pack_size(size)));
    recorder.gl.dispatch(groups[0], groups[1]);
    recorder.continue_pass(Pass::Occluders);
    programs.coarse_levels.bind(Some(pack_size(size)));
    recorder.gl.dispatch(groups[0].div_ceil(PYRAMID_TILE), groups[1].div_ceil(PYRAMID_TILE));
}

/// Records the triangles that the ids name, which are the occluders of the next frame. Does nothing without occlusion
/// culling.
pub(super) fn record_visible(recorder: &PassRecorder<'_>, frame: &FrameContext<'_>) -> Result<()> {
    let FrameContext { buffers, target, programs, .. } = *frame;
    let occlusion = programs.cull.as_ref().and_then(|programs| programs.occlusion.as_ref());
    let (Some(culler), Some(programs)) = (&buffers.culler, occlusion) else { return Ok(()) };
    recorder.begin(Pass::RecordVisible);
    culler.bind();
    bind_visibility(target);
    programs.record_visible.bind(None);
    recorder.gl.dispatch(target.desc.width.div_ceil(RECORD_TILE), target.desc.height.div_ceil(RECORD_TILE));
    recorder.check(Pass::RecordVisible)
}
