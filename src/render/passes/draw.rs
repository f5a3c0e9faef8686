//! Draw calls that several passes share: groups of triangles, listed or not, and the inputs that all passes bind.

use super::recorder::PassRecorder;
use crate::device::gl::{Gl, PipelineState, Program};
use crate::layout::cull::command_offset;
use crate::layout::{
    CASCADE_BLOCK, COLOR_UNIT, DEPTH_UNIT, FRAME_BLOCK, ID_UNIT, NORMAL_UNIT, POSITION_UNIT, SHADOW_UNIT,
};
use crate::resources::scene_buffers::SceneBuffers;
use crate::resources::target::RenderTarget;
use crate::scene_data::geometry::{BlendMode, DrawGroup};
use crate::uniforms::cascades::ShadowCascades;
use crate::uniforms::frame::FrameUniforms;

/// Which triangles of a kind a pass draws.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum TriangleSet {
    All,
    /// The triangles in the culled lists.
    Visible,
}

/// A draw of the triangles of one kind.
#[derive(Debug, Clone, Copy)]
pub(super) struct KindDraw<'a> {
    pub(super) blend_mode: BlendMode,
    pub(super) program: &'a Program,
    pub(super) set: TriangleSet,
}

/// Binds the buffers and textures that all passes read.
pub(super) fn bind_scene(buffers: &SceneBuffers) {
    buffers.position_texture().bind(POSITION_UNIT);
    for (unit, view) in &buffers.buffer_textures.others {
        view.bind(*unit);
    }
    buffers.uniforms.frame.bind_uniform(FRAME_BLOCK, size_of::<FrameUniforms>());
    if let Some(cascades) = &buffers.uniforms.cascades {
        cascades.bind_uniform(CASCADE_BLOCK, size_of::<ShadowCascades>());
    }
    for (unit, texture) in (COLOR_UNIT..).zip(&buffers.color_arrays) {
        texture.bind(unit);
    }
    for (unit, texture) in (NORMAL_UNIT..).zip(&buffers.normals) {
        texture.bind(unit);
    }
}

/// Binds ids and depth. Depth says which samples hold a valid id.
pub(super) fn bind_visibility(target: &RenderTarget) {
    target.ids.bind(ID_UNIT);
    target.depth.bind(DEPTH_UNIT);
}

/// Binds the shadow map for lookups.
pub(super) fn bind_shadow(buffers: &SceneBuffers) {
    if let Some(map) = &buffers.shadow {
        map.lookup().bind(SHADOW_UNIT);
    }
}

/// The groups of one kind with their indices.
pub(super) fn groups_of(buffers: &SceneBuffers, blend_mode: BlendMode) -> impl Iterator<Item = (usize, &DrawGroup)> {
    buffers.groups.iter().enumerate().filter(move |(_, group)| group.blend_mode == blend_mode)
}

/// Draws the triangles of one kind: one call for single-sided, one for double-sided ones.
pub(super) fn draw_groups(
    recorder: &mut PassRecorder<'_>,
    buffers: &SceneBuffers,
    draw: KindDraw<'_>,
    state: PipelineState,
) {
    for (index, group) in groups_of(buffers, draw.blend_mode) {
        recorder.gl.set_pipeline_state(PipelineState { cull: !group.double_sided, ..state });
        draw.program.bind(Some(first_triangle_of(group, draw.set)));
        draw_group(recorder.gl, buffers, index, draw.set);
        recorder.stats.draw_calls += 1;
    }
}

/// Draws the triangles of one kind, single- and double-sided alike, with the bound program: in one call, or in one call
/// per culled list.
pub(super) fn draw_kind(gl: &Gl, buffers: &SceneBuffers, draw: KindDraw<'_>) {
    let has_fragments = draw.blend_mode != BlendMode::Opaque;
    if draw.set == TriangleSet::All {
        let (first, count) = buffers.triangles(draw.blend_mode);
        if has_fragments {
            draw.program.set_first_triangle(first as u32);
        }
        if let Some(array) = buffers.vertex_array(draw.blend_mode) {
            gl.draw_indexed(array, first, count);
        }
        return;
    }
    for (index, group) in groups_of(buffers, draw.blend_mode) {
        if has_fragments {
            draw.program.set_first_triangle(first_triangle_of(group, draw.set));
        }
        draw_group(gl, buffers, index, draw.set);
    }
}

/// The culled lists when the scene is culled, else all triangles.
pub(super) fn triangle_set(buffers: &SceneBuffers) -> TriangleSet {
    if buffers.culler.is_some() { TriangleSet::Visible } else { TriangleSet::All }
}

/// Offset of a group for the shaders: its first triangle, or the complement of it for a list
/// (`shaders/shared/triangle_id.glsl`).
pub(super) const fn first_triangle_of(group: &DrawGroup, set: TriangleSet) -> u32 {
    match set {
        TriangleSet::All => group.first_triangle as u32,
        TriangleSet::Visible => !(group.first_triangle as u32),
    }
}

/// Draws a group, or the culled list of the group.
pub(super) fn draw_group(gl: &Gl, buffers: &SceneBuffers, index: usize, set: TriangleSet) {
    let group = buffers.groups[index];
    match set {
        TriangleSet::All => {
            if let Some(array) = buffers.vertex_array(group.blend_mode) {
                gl.draw_indexed(array, group.first_triangle, group.triangles);
            }
        }
        TriangleSet::Visible => {
            if let Some((array, draws)) = buffers.visible_draws(group.blend_mode) {
                gl.draw_indexed_indirect(array, draws, command_offset(index));
            }
        }
    }
}
