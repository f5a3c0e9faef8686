//! Runs the culling passes of a frame.

use super::super::FrameStats;
use super::super::geometry::BlendMode;
use super::super::passes::{TriangleSet, bind_visibility, draw_depth};
use super::super::programs::SampleCountPrograms;
use super::super::scene_buffers::SceneBuffers;
use super::super::target::RenderTarget;
use super::blocks::CullUniforms;
use super::pyramid::pack_size;
use super::{COUNTER_BYTES, COUNTERS, TriangleCuller};
use crate::device::gl::{ClearOp, Gl, Program};
use modalcast_model::error::Result;

const TRIANGLE_ID_UNIT: u32 = 25;
const GROUP_BLOCK: u32 = 3;
/// Storage buffer bindings, by buffer name.
const STORAGE_BINDINGS: [(&str, u32); 6] = [
    ("cull draws", 0),
    ("cull visible bits", 1),
    (COUNTERS, 2),
    ("cull previously visible", 3),
    ("visible triangle ids", 5),
    ("visible indices", 6),
];
/// Side of the square of pixels whose ids one workgroup records.
const RECORD_TILE: u32 = 8;

/// Resets the counts.
pub(crate) fn clear_counters(buffers: &SceneBuffers) {
    if let Some(counts) = buffers.buffers.get(COUNTERS) {
        counts.write(&[0; COUNTER_BYTES]);
    }
}

fn bind(buffers: &SceneBuffers) {
    for (name, binding) in STORAGE_BINDINGS {
        if let Some(buffer) = buffers.buffers.get(name) {
            buffer.bind_storage(binding);
        }
    }
    if let Some(groups) = buffers.buffers.get("cull uniforms") {
        groups.bind_uniform(GROUP_BLOCK, size_of::<CullUniforms>());
    }
}

/// Runs the bound culling program and compacts its result to lists. The caller has bound their inputs.
fn compact_triangles(gl: &Gl, culler: &TriangleCuller, compact: &Program) {
    let [wide, tall] = culler.uniforms.dispatch();
    gl.dispatch(wide, tall);
    compact.bind(None);
    gl.dispatch(wide, tall);
    culler.triangle_ids.bind(TRIANGLE_ID_UNIT);
}

/// Resets the ledger and binds the buffers, after the draws that use the previous lists.
fn empty(gl: &Gl, buffers: &SceneBuffers, culler: &TriangleCuller) {
    gl.barrier();
    if let Some(ledger) = buffers.buffers.get("cull draws") {
        ledger.write(&culler.uniforms.empty_draws());
    }
    bind(buffers);
}

/// Lists the triangles that may cast a shadow into one layer of the map, whose side is `size` texels. `choose` sets the
/// layer of the bound program.
pub(crate) fn cull_shadow_casters(gl: &Gl, buffers: &SceneBuffers, size: u32, choose: impl Fn(&Program)) -> Result<()> {
    let (Some(culler), Some(programs)) = (&buffers.culler, &buffers.programs.shadow_cull) else { return Ok(()) };
    empty(gl, buffers, culler);
    programs.cull_triangles.bind(Some(size | size << 16));
    choose(&programs.cull_triangles);
    compact_triangles(gl, culler, &programs.compact);
    gl.check("shadow cull")
}

/// Lists the triangles that the camera may see.
pub(crate) fn cull_for_camera(
    gl: &Gl,
    buffers: &SceneBuffers,
    target: &RenderTarget,
    sample_programs: &SampleCountPrograms,
    stats: &mut FrameStats,
) -> Result<()> {
    let (Some(culler), Some(programs)) = (&buffers.culler, &sample_programs.cull) else { return Ok(()) };
    if let (Some(pyramid), Some(cull_previous)) = (&target.pyramid, &programs.cull_previous) {
        empty(gl, buffers, culler);
        cull_previous.bind(None);
        compact_triangles(gl, culler, &programs.compact);
        gl.begin_pass(&pyramid.occluders, target.draw_region.get(), ClearOp::Depth(Some(&target.dirty.depth)));
        let kinds = [
            (BlendMode::Opaque, buffers.programs.opaque.as_deref()),
            (BlendMode::Mask, sample_programs.mask.as_deref()),
        ];
        for (blend_mode, program) in kinds {
            if let Some(program) = program {
                draw_depth(gl, buffers, (blend_mode, program), TriangleSet::Visible, stats);
            }
        }
        pyramid.build(gl, (&target.depth, target.desc), sample_programs);
        stats.passes.push("occluders");
        gl.check("occluders")?;
    }
    empty(gl, buffers, culler);
    if let Some(pyramid) = &target.pyramid {
        pyramid.bind();
    }
    programs.cull_triangles.bind(Some(pack_size(target.desc)));
    compact_triangles(gl, culler, &programs.compact);
    stats.passes.push("cull");
    gl.check("cull")
}

/// Records the triangles that the ids name, which are the occluders of the next frame.
pub(crate) fn record_visible(
    gl: &Gl,
    buffers: &SceneBuffers,
    target: &RenderTarget,
    sample_programs: &SampleCountPrograms,
) -> Result<()> {
    let Some(program) = sample_programs.cull.as_ref().and_then(|programs| programs.record_visible.as_ref()) else {
        return Ok(());
    };
    gl.barrier();
    bind(buffers);
    bind_visibility(target);
    program.bind(None);
    gl.dispatch(target.desc.width.div_ceil(RECORD_TILE), target.desc.height.div_ceil(RECORD_TILE));
    gl.check("remember")
}
