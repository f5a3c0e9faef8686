//! Draw calls and bindings that several passes share.

use super::recorder::PassRecorder;
use crate::device::gl::{Gl, PipelineState, Program};
use crate::layout::cull::command_offset;
use crate::layout::{
    CASCADE_BLOCK, COLOR_UNIT, DEPTH_UNIT, FRAME_BLOCK, ID_UNIT, NORMAL_UNIT, POSITION_UNIT, SHADOW_DEPTH_UNIT,
    SHADOW_UNIT,
};
use crate::pieces::PieceRange;
use crate::resources::scene_buffers::SceneBuffers;
use crate::resources::target::RenderTarget;
use crate::scene_data::geometry::{BlendMode, DrawGroup};
use crate::uniforms::cascades::ShadowCascades;
use crate::uniforms::frame::FrameUniforms;

/// Which triangles of a blend mode a pass draws.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum TriangleSet {
    All,
    /// The triangles that passed the culling tests, from the lists of visible triangles.
    Visible,
}

/// A draw of the triangles with one blend mode.
#[derive(Debug, Clone, Copy)]
pub(super) struct TriangleDraw<'a> {
    pub(super) blend_mode: BlendMode,
    pub(super) program: &'a Program,
    pub(super) triangles: TriangleSet,
    /// Only these triangles are drawn.
    pub(super) range: PieceRange,
}

/// Binds the buffers and textures that all passes read.
pub(super) fn bind_scene(buffers: &SceneBuffers) {
    buffers.position_texture().bind(POSITION_UNIT);
    for (unit, view) in &buffers.buffer_textures.unit_views {
        view.bind(*unit);
    }
    buffers.uniforms.frame.bind_uniform(FRAME_BLOCK, size_of::<FrameUniforms>());
    if let Some(cascades) = &buffers.uniforms.cascades {
        cascades.bind_uniform(CASCADE_BLOCK, size_of::<ShadowCascades>());
    }
    for (unit, texture) in (COLOR_UNIT..).zip(&buffers.color_arrays) {
        texture.bind(unit);
    }
    for (unit, texture) in (NORMAL_UNIT..).zip(&buffers.normal_arrays) {
        texture.bind(unit);
    }
}

/// Binds ids and depth. Depth tells which samples have a valid id.
pub(super) fn bind_visibility(target: &RenderTarget) {
    target.ids.bind(ID_UNIT);
    target.depth.bind(DEPTH_UNIT);
}

/// Binds the shadow map for lookups.
pub(super) fn bind_shadow(buffers: &SceneBuffers) {
    if let Some(map) = &buffers.shadow {
        map.lookup_texture().bind(SHADOW_UNIT);
        if map.shadow.filters_undecided_points() {
            map.current_depth().bind(SHADOW_DEPTH_UNIT);
        }
    }
}

/// Draw groups with one blend mode, each with its index among all groups.
pub(super) fn groups_of(buffers: &SceneBuffers, blend_mode: BlendMode) -> impl Iterator<Item = (usize, &DrawGroup)> {
    buffers.groups.iter().enumerate().filter(move |(_, group)| group.blend_mode == blend_mode)
}

/// Draws the triangles with one blend mode: one call for single-sided and one for double-sided triangles.
pub(super) fn draw_groups(
    recorder: &mut PassRecorder<'_>,
    buffers: &SceneBuffers,
    draw: TriangleDraw<'_>,
    state: PipelineState,
) {
    for (index, group) in groups_of(buffers, draw.blend_mode) {
        let Some(part) = GroupPart::new(index, group, draw.triangles, draw.range) else { continue };
        recorder.gl.set_pipeline_state(PipelineState { cull_back_faces: !group.double_sided, ..state });
        draw.program.bind(Some(part.first_triangle()));
        part.draw(recorder.gl, buffers);
        recorder.stats.draw_calls += 1;
    }
}

/// Draws the triangles with one blend mode without back-face culling. All triangles take one call, and visible
/// triangles one call per list. The caller has bound the program.
pub(super) fn draw_double_sided(gl: &Gl, buffers: &SceneBuffers, draw: TriangleDraw<'_>) {
    // Only the fragment shader of cut-outs and blended triangles reads the uniform `first_triangle`.
    let has_fragment_shader = draw.blend_mode != BlendMode::Opaque;
    if draw.triangles == TriangleSet::All {
        let triangles = buffers.triangle_range(draw.blend_mode).intersection(draw.range);
        if has_fragment_shader {
            draw.program.set_first_triangle(triangles.first as u32);
        }
        if let Some(array) = buffers.vertex_array(draw.blend_mode) {
            gl.draw_indexed(array, triangles);
        }
        return;
    }
    for (index, group) in groups_of(buffers, draw.blend_mode) {
        let Some(part) = GroupPart::new(index, group, draw.triangles, draw.range) else { continue };
        if has_fragment_shader {
            draw.program.set_first_triangle(part.first_triangle());
        }
        part.draw(gl, buffers);
    }
}

/// Selects the lists of visible triangles if the scene has them, else all triangles.
pub(super) fn triangle_set(buffers: &SceneBuffers) -> TriangleSet {
    if buffers.cull_resources.is_some() { TriangleSet::Visible } else { TriangleSet::All }
}

/// The part of a draw group in a range of triangles.
#[derive(Debug, Clone, Copy)]
pub(super) struct GroupPart {
    group_index: usize,
    blend_mode: BlendMode,
    triangles: TriangleSet,
    range: PieceRange,
    /// Whether the part is the whole group.
    is_whole: bool,
}

impl GroupPart {
    /// None if the range contains no triangle of the group.
    pub(super) fn new(
        group_index: usize,
        group: &DrawGroup,
        triangles: TriangleSet,
        range: PieceRange,
    ) -> Option<Self> {
        let whole = PieceRange::new(group.first_triangle, group.triangle_count);
        let part = whole.intersection(range);
        let is_whole = part == whole;
        let blend_mode = group.blend_mode;
        (part.count() > 0).then_some(Self { group_index, blend_mode, triangles, range: part, is_whole })
    }

    /// Whether the part is the whole group.
    pub(super) const fn is_whole(&self) -> bool {
        self.is_whole
    }

    pub(super) const fn range(&self) -> PieceRange {
        self.range
    }

    /// Uniform `first_triangle` of `shaders/shared/triangle_id.glsl`: the first triangle, or its bitwise complement for
    /// a list of visible triangles.
    pub(super) const fn first_triangle(&self) -> u32 {
        match self.triangles {
            TriangleSet::All => self.range.first as u32,
            TriangleSet::Visible => !(self.range.first as u32),
        }
    }

    /// Draws the part. The length of a list of visible triangles is known to the device only, so a part of the list may
    /// extend beyond its end, where the indices are 0 ([`super::cull::cull_shadow_casters`]).
    pub(super) fn draw(&self, gl: &Gl, buffers: &SceneBuffers) {
        match self.triangles {
            TriangleSet::All => {
                if let Some(array) = buffers.vertex_array(self.blend_mode) {
                    gl.draw_indexed(array, self.range);
                }
            }
            TriangleSet::Visible => match buffers.visible_draws(self.blend_mode) {
                Some((array, draws)) if self.is_whole => {
                    gl.draw_indexed_indirect(array, draws, command_offset(self.group_index));
                }
                Some((array, _)) => gl.draw_indexed(array, self.range),
                None => {}
            },
        }
    }
}
