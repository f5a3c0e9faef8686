//! Runs the culling passes of a frame.

use super::super::Ran;
use super::super::geometry::Kind;
use super::super::gl::{Clear, Gl, Program};
use super::super::passes::{Drawn, bind_seen, draw_depth};
use super::super::programs::Sampled;
use super::super::scene_buffers::SceneBuffers;
use super::super::target::Target;
use super::layout::Groups;
use super::pyramid::packed;
use super::{COUNT_BYTES, COUNTED, Culler};
use modalcast_model::error::Result;

const NAME_UNIT: u32 = 25;
const GROUP_BLOCK: u32 = 3;
/// Storage buffer bindings, by buffer name.
const STORED: [(&str, u32); 6] = [
    ("cull ledger", 0),
    ("cull bits", 1),
    (COUNTED, 2),
    ("cull seen", 3),
    ("listed names", 5),
    ("listed triangles", 6),
];
/// Side of the square of pixels whose ids one workgroup records.
const REMEMBERED: u32 = 8;

/// Resets the counts.
pub(crate) fn begin(buffers: &SceneBuffers) {
    if let Some(counts) = buffers.buffers.get(COUNTED) {
        counts.write(&[0; COUNT_BYTES]);
    }
}

fn bind(buffers: &SceneBuffers) {
    for (name, binding) in STORED {
        if let Some(buffer) = buffers.buffers.get(name) {
            buffer.bind_storage(binding);
        }
    }
    if let Some(groups) = buffers.buffers.get("cull groups") {
        groups.bind_uniform(GROUP_BLOCK, 0, size_of::<Groups>());
    }
}

/// Runs the bound culling program and compacts its result to lists. The caller has bound their inputs.
fn lists(gl: &Gl, culler: &Culler, list: &Program) {
    let [wide, tall] = culler.numbers.dispatch();
    gl.dispatch(wide, tall);
    list.bind(None);
    gl.dispatch(wide, tall);
    culler.names.bind(NAME_UNIT);
}

/// Resets the ledger and binds the buffers, after the draws that use the previous lists.
fn empty(gl: &Gl, buffers: &SceneBuffers, culler: &Culler) {
    gl.wait_for_stores();
    if let Some(ledger) = buffers.buffers.get("cull ledger") {
        ledger.write(&culler.numbers.empty_ledger());
    }
    bind(buffers);
}

/// Lists the triangles that may cast a shadow into one layer of the map, whose side is `size` texels. `choose` sets the
/// layer of the bound program.
pub(crate) fn sun(gl: &Gl, buffers: &SceneBuffers, size: u32, choose: impl Fn(&Program)) -> Result<()> {
    let (Some(culler), Some(programs)) = (&buffers.culler, &buffers.programs.sun) else { return Ok(()) };
    empty(gl, buffers, culler);
    programs.sift.bind(Some(size | size << 16));
    choose(&programs.sift);
    lists(gl, culler, &programs.list);
    gl.check("shadow cull")
}

/// Lists the triangles that the camera may see.
pub(crate) fn camera(gl: &Gl, buffers: &SceneBuffers, target: &Target, sampled: &Sampled, ran: &mut Ran) -> Result<()> {
    let (Some(culler), Some(programs)) = (&buffers.culler, &sampled.cull) else { return Ok(()) };
    if let (Some(pyramid), Some(remembered)) = (&target.pyramid, &programs.remembered) {
        empty(gl, buffers, culler);
        remembered.bind(None);
        lists(gl, culler, &programs.list);
        gl.begin(&pyramid.occluders, target.reach.get(), Clear::Depth(Some(&target.touched.depth)));
        let kinds = [(Kind::Opaque, buffers.programs.opaque.as_deref()), (Kind::Mask, sampled.mask.as_deref())];
        for (kind, program) in kinds {
            if let Some(program) = program {
                draw_depth(gl, buffers, (kind, program), Drawn::Listed, ran);
            }
        }
        pyramid.build(gl, (&target.depth, target.form), sampled);
        ran.passes.push("occluders");
        gl.check("occluders")?;
    }
    empty(gl, buffers, culler);
    if let Some(pyramid) = &target.pyramid {
        pyramid.bind();
    }
    programs.sift.bind(Some(packed(target.form)));
    lists(gl, culler, &programs.list);
    ran.passes.push("cull");
    gl.check("cull")
}

/// Records the triangles that the ids name, which are the occluders of the next frame.
pub(crate) fn remember(gl: &Gl, buffers: &SceneBuffers, target: &Target, sampled: &Sampled) -> Result<()> {
    let Some(program) = sampled.cull.as_ref().and_then(|programs| programs.remember.as_ref()) else { return Ok(()) };
    gl.wait_for_stores();
    bind(buffers);
    bind_seen(target);
    program.bind(None);
    gl.dispatch(target.form.width.div_ceil(REMEMBERED), target.form.height.div_ceil(REMEMBERED));
    gl.check("remember")
}
