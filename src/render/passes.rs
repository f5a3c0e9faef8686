//! The passes of one frame, in execution order: shadow, blur, visibility, ground, blended, background, shade. `post.rs`
//! has the passes after them.

use super::cascades::ShadowCascades;
use super::cull::{SHADOW_CULL, command_offset};
use super::frame_uniforms::{FrameUniforms, camera_is_above_ground};
use super::geometry::{BlendMode, DrawGroup};
use super::programs::SampleCountPrograms;
use super::region::Region;
use super::scene_buffers::SceneBuffers;
use super::shaders::{
    COLOR_UNIT, COUNT_UNIT, DEPTH_UNIT, ID_UNIT, LAYER_UNIT, NORMAL_UNIT, POSITION_UNIT, SHADOW_UNIT, TILE, TILE_ROW,
    WORKGROUP_SIZE,
};
use super::target::RenderTarget;
use super::{FrameParams, FrameStats};
use crate::device::gl::{Buffer, ClearOp, Framebuffer, Gl, PipelineState, Program, Texture};
use crate::types::RasterBackend;
use modalcast_model::error::Result;

pub(crate) const PIXELS: u32 = 0;
pub(crate) const TILES: u32 = 1;
/// Initial indirect dispatch over listed tiles: group counts (TILE_ROW, 0 rows, 1), then the tile count 0.
pub(crate) const EMPTY_TILE_LIST: [u32; 4] = [TILE_ROW, 0, 1, 0];
const FRAME: u32 = 0;
const CASCADES: u32 = 2;
/// Cleared layer: no light, full transmittance.
const CLEAR_LAYER: [f32; 4] = [0.0, 0.0, 0.0, 1.0];

/// Which triangles of a kind a pass draws.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum TriangleSet {
    All,
    /// The triangles in the culled lists.
    Visible,
}

/// Binds the buffers and textures that all passes read.
pub(crate) fn bind(buffers: &SceneBuffers) -> Result<()> {
    buffers.position_texture().bind(POSITION_UNIT);
    for (unit, view) in &buffers.buffer_textures.others {
        view.bind(*unit);
    }
    buffers.buffer("frame uniforms")?.bind_uniform(FRAME, size_of::<FrameUniforms>());
    if let Ok(splits) = buffers.buffer("shadow cascades") {
        splits.bind_uniform(CASCADES, size_of::<ShadowCascades>());
    }
    for (unit, texture) in (COLOR_UNIT..).zip(&buffers.color_arrays) {
        texture.bind(unit);
    }
    for (unit, texture) in (NORMAL_UNIT..).zip(&buffers.normals) {
        texture.bind(unit);
    }
    Ok(())
}

/// Draws the depth of the shadow map, unless the compute rasterizer has drawn it.
pub(crate) fn shadow(gl: &Gl, buffers: &SceneBuffers, stats: &mut FrameStats) -> Result<()> {
    let Some(map) = buffers.shadow.as_ref().filter(|_| buffers.shadow_rasterizer().is_none()) else { return Ok(()) };
    stats.raster_backends.shadow = Some(RasterBackend::OpenGl);
    super::shadow::depth(gl, buffers, map)?;
    stats.passes.extend(buffers.culler.as_ref().map(|_| SHADOW_CULL));
    stats.passes.push("shadow");
    Ok(())
}

/// Blurs the moments of a variance map. Other shadow methods need depth only.
pub(crate) fn blur(gl: &Gl, buffers: &SceneBuffers, stats: &mut FrameStats) -> Result<()> {
    let Some(map) = &buffers.shadow else { return Ok(()) };
    if super::shadow::blur(gl, buffers, map)? {
        stats.passes.push("blur");
    }
    Ok(())
}

/// Draws the id and depth of each sample.
pub(crate) fn visibility(
    gl: &Gl,
    buffers: &SceneBuffers,
    target: &RenderTarget,
    sample_programs: &SampleCountPrograms,
    stats: &mut FrameStats,
) -> Result<()> {
    let programs = (sample_programs.mask.as_deref(), sample_programs.opaque_parts.as_deref());
    // With several samples, depth says where an id is valid; the ids need no clear.
    let clear = match target.desc.samples {
        1 => ClearOp::DepthAndIds(Some(&target.dirty)),
        _ => ClearOp::Depth(Some(&target.dirty.depth)),
    };
    let into = (&target.visibility_fbo, clear, target.draw_region.get(), triangle_set(buffers));
    draw_ids(gl, buffers, into, programs, stats)?;
    super::cull::record_visible(gl, buffers, target, sample_programs)
}

/// Draws ids and depth into `part` of a framebuffer that is at least as large as the part's frame: of opaque triangles,
/// of cut-outs with the first program, and of the opaque parts of blended triangles with the second.
pub(crate) fn draw_ids(
    gl: &Gl,
    buffers: &SceneBuffers,
    (into, clear, part, drawn): (&Framebuffer, ClearOp<'_>, Region, TriangleSet),
    (cut_out, opaque_parts): (Option<&Program>, Option<&Program>),
    stats: &mut FrameStats,
) -> Result<()> {
    gl.begin_pass(into, part, clear);
    // Cut-outs come after opaque triangles: where something opaque is nearer, the depth test saves their texture
    // lookups.
    let kinds = [
        (BlendMode::Opaque, buffers.programs.opaque.as_deref()),
        (BlendMode::Mask, cut_out),
        (BlendMode::Blend, opaque_parts),
    ];
    let written = PipelineState { depth_write: true, ..PipelineState::default() };
    let mut any = false;
    for (blend_mode, program) in kinds {
        if let Some(program) = program {
            draw(gl, buffers, (blend_mode, program, drawn), written, stats);
            any = true;
        }
    }
    if any {
        stats.passes.push("visibility");
        stats.raster_backends.visibility = Some(RasterBackend::OpenGl);
    }
    gl.check("visibility")
}

/// Draws the ground into ids and depth. A picture draws it only when something lies below it; otherwise the shading
/// finds the ground.
pub(crate) fn ground(gl: &Gl, buffers: &SceneBuffers, shot: &FrameParams, stats: &mut FrameStats) -> Result<()> {
    let Some(program) = buffers.programs.ground.as_ref().filter(|_| camera_is_above_ground(&buffers.scene, shot))
    else {
        return Ok(());
    };
    gl.set_pipeline_state(PipelineState {
        depth_clamp: true,
        depth_write: true,
        polygon_offset: true,
        ..PipelineState::default()
    });
    program.bind(None);
    gl.draw_procedural(&buffers.empty_vertex_array, 3);
    stats.passes.push("ground");
    gl.check("ground")
}

/// Draws the layer of the blended triangles in front of the opaque ones.
pub(crate) fn blended(
    gl: &Gl,
    buffers: &SceneBuffers,
    target: &RenderTarget,
    sample_programs: &SampleCountPrograms,
    stats: &mut FrameStats,
) -> Result<()> {
    if let (Some(programs), Some(oit)) = (&sample_programs.oit, &target.oit) {
        return super::oit::draw(gl, buffers, (oit, target.draw_region.get()), programs, stats);
    }
    let (Some(program), Some(layer)) = (&sample_programs.blended, &target.layer) else { return Ok(()) };
    gl.begin_pass(&layer.framebuffer, target.draw_region.get(), ClearOp::Color(CLEAR_LAYER, &layer.dirty));
    bind_shadow(buffers);
    let program = (BlendMode::Blend, program.as_ref(), triangle_set(buffers));
    draw(gl, buffers, program, PipelineState { blend: true, ..PipelineState::default() }, stats);
    stats.passes.push("blended");
    gl.check("blended")
}

/// Shades the visible surfaces to linear light.
pub(crate) fn shade(
    gl: &Gl,
    buffers: &SceneBuffers,
    target: &RenderTarget,
    sample_programs: &SampleCountPrograms,
    stats: &mut FrameStats,
) -> Result<()> {
    bind_shadow(buffers);
    bind_visibility(target);
    if let Some(layer) = &target.layer {
        layer.color.bind(LAYER_UNIT);
    }
    if let Some(oit) = &target.oit {
        oit.layers.bind(LAYER_UNIT);
        oit.counts.bind(COUNT_UNIT);
    }
    target.scene_color.bind_image(0);
    if let Some(source) = target.bloom_mips.first() {
        source.bind_image(1);
    }
    target.tiles.write(bytemuck::cast_slice(&EMPTY_TILE_LIST));
    target.tiles.bind_storage(TILES);
    sample_programs.background.bind(None);
    gl.dispatch(target.desc.width.div_ceil(TILE), target.desc.height.div_ceil(TILE));
    stats.passes.push("background");
    gl.check("background")?;
    if let Some(program) = &sample_programs.shade {
        program.bind(None);
        gl.dispatch_indirect(&target.tiles);
        stats.passes.push("shade");
    }
    gl.check("shade")
}

/// Binds ids and depth. Depth says which samples hold a valid id.
pub(crate) fn bind_visibility(target: &RenderTarget) {
    target.ids.bind(ID_UNIT);
    target.depth.bind(DEPTH_UNIT);
}

/// Converts ids to words in a buffer that can be copied to the host. `number` is the uniform at location 0 of programs
/// that have one.
pub(crate) fn run_readback(
    gl: &Gl,
    (ids, into): (&Texture, &Buffer),
    (program, number): (&Program, Option<u32>),
    [width, height]: [u32; 2],
) -> Result<()> {
    program.bind(number);
    ids.bind(ID_UNIT);
    into.bind_storage(PIXELS);
    gl.dispatch(width.div_ceil(WORKGROUP_SIZE), height);
    gl.check("words")
}

/// Packs the ids of each pixel's first sample into a buffer that can be copied to the host.
pub(crate) fn resolve_ids(gl: &Gl, target: &RenderTarget, program: &Program) -> Result<()> {
    program.bind(None);
    bind_visibility(target);
    target.readback_source.bind_storage(PIXELS);
    gl.dispatch(target.desc.width.div_ceil(WORKGROUP_SIZE), target.desc.height);
    gl.check("visibility readback")
}

/// Draws the triangles of one kind: one call for single-sided, one for double-sided ones.
fn draw(
    gl: &Gl,
    buffers: &SceneBuffers,
    (blend_mode, program, drawn): (BlendMode, &Program, TriangleSet),
    fixed: PipelineState,
    stats: &mut FrameStats,
) {
    for (index, group) in buffers.groups.iter().enumerate().filter(|(_, group)| group.blend_mode == blend_mode) {
        gl.set_pipeline_state(PipelineState { cull: !group.double_sided, ..fixed });
        program.bind(Some(first_triangle_of(group, drawn)));
        draw_group(gl, buffers, index, drawn);
        stats.draw_calls += 1;
    }
}

/// Draws the depth of one kind of triangle into the bound framebuffer.
pub(crate) fn draw_depth(
    gl: &Gl,
    buffers: &SceneBuffers,
    (blend_mode, program): (BlendMode, &Program),
    drawn: TriangleSet,
    stats: &mut FrameStats,
) {
    draw(
        gl,
        buffers,
        (blend_mode, program, drawn),
        PipelineState { depth_write: true, ..PipelineState::default() },
        stats,
    );
}

/// Draws the triangles of one kind, single- and double-sided alike, with the bound program: in one call, or in one call
/// per culled list.
pub(crate) fn draw_blend_mode(
    gl: &Gl,
    buffers: &SceneBuffers,
    (blend_mode, program): (BlendMode, &Program),
    drawn: TriangleSet,
) {
    let has_fragments = blend_mode != BlendMode::Opaque;
    if drawn == TriangleSet::All {
        let (first, count) = buffers.triangles(blend_mode);
        if has_fragments {
            program.set_first_triangle(first as u32);
        }
        if let Some(array) = buffers.vertex_array(blend_mode) {
            gl.draw_indexed(array, first, count);
        }
        return;
    }
    for (index, group) in buffers.groups.iter().enumerate().filter(|(_, group)| group.blend_mode == blend_mode) {
        if has_fragments {
            program.set_first_triangle(first_triangle_of(group, drawn));
        }
        draw_group(gl, buffers, index, drawn);
    }
}

/// The culled lists when the scene is culled, else all triangles.
pub(crate) fn triangle_set(buffers: &SceneBuffers) -> TriangleSet {
    if buffers.culler.is_some() { TriangleSet::Visible } else { TriangleSet::All }
}

/// Offset of a group for the shaders: its first triangle, or the complement of it for a list
/// (`shaders/shared/triangle_id.glsl`).
pub(crate) const fn first_triangle_of(group: &DrawGroup, drawn: TriangleSet) -> u32 {
    match drawn {
        TriangleSet::All => group.first_triangle as u32,
        TriangleSet::Visible => !(group.first_triangle as u32),
    }
}

/// Draws a group, or the culled list of the group.
pub(crate) fn draw_group(gl: &Gl, buffers: &SceneBuffers, index: usize, drawn: TriangleSet) {
    let group = buffers.groups[index];
    match drawn {
        TriangleSet::All => {
            if let Some(array) = buffers.vertex_array(group.blend_mode) {
                gl.draw_indexed(array, group.first_triangle, group.triangles);
            }
        }
        TriangleSet::Visible => {
            if let Some((array, ledger)) = buffers.visible_draws(group.blend_mode) {
                gl.draw_indexed_indirect(array, ledger, command_offset(index));
            }
        }
    }
}

pub(crate) fn bind_shadow(buffers: &SceneBuffers) {
    if let Some(map) = &buffers.shadow {
        map.lookup().bind(SHADOW_UNIT);
    }
}
