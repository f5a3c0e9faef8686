//! The passes of one frame, in order: shadow, blur, opaque, sky, ground, blended, encode.

use super::frame::{Frame, above_ground};
use super::geometry::Kind;
use super::gl::{Fixed, Gl, Program};
use super::programs::DrawGroup;
use super::scene_buffers::{MATERIAL_BYTES, SceneBuffers};
use super::shaders::{
    COLOUR_UNIT, LANES, MATERIAL_UNIT, NORMAL_UNIT, POSITION_UNIT, SHADOW_UNIT, TRIANGLE_MATERIAL_UNIT,
};
use super::splits::Splits;
use super::target::Target;
use super::{Ran, Shot};
use crate::error::Result;

const PIXELS: u32 = 0;
const FRAME: u32 = 0;
const MATERIAL: u32 = 1;
const SPLITS: u32 = 2;

/// Binds what all passes read.
pub(super) fn bind(buffers: &SceneBuffers) -> Result<()> {
    buffers.drawn_positions().bind(POSITION_UNIT);
    buffers.views.materials.bind(MATERIAL_UNIT);
    if let Some(view) = &buffers.views.triangle_materials {
        view.bind(TRIANGLE_MATERIAL_UNIT);
    }
    buffers.buffer("frame")?.bind_uniform(FRAME, 0, size_of::<Frame>());
    if let Ok(splits) = buffers.buffer("splits") {
        splits.bind_uniform(SPLITS, 0, size_of::<Splits>());
    }
    for (unit, texture) in (COLOUR_UNIT..).zip(&buffers.colours) {
        texture.bind(unit);
    }
    for (unit, texture) in (NORMAL_UNIT..).zip(&buffers.normals) {
        texture.bind(unit);
    }
    Ok(())
}

/// Depth from the sun.
pub(super) fn shadow(gl: &Gl, buffers: &SceneBuffers, ran: &mut Ran) -> Result<()> {
    let Some(map) = &buffers.shadow else { return Ok(()) };
    super::shadow::depth(gl, buffers, map)?;
    ran.passes.push("shadow");
    Ok(())
}

/// What the map of a method that needs it has besides depth: blurred moments.
pub(super) fn blur(gl: &Gl, buffers: &SceneBuffers, ran: &mut Ran) -> Result<()> {
    let Some(map) = &buffers.shadow else { return Ok(()) };
    if super::shadow::blur(gl, buffers, map)? {
        ran.passes.push("blur");
    }
    Ok(())
}

/// The picture, in linear light.
pub(super) fn draw(gl: &Gl, buffers: &SceneBuffers, target: &Target, shot: &Shot, ran: &mut Ran) -> Result<()> {
    let programs = &buffers.programs;
    gl.begin(&target.framebuffer, target.width, target.height);
    if let Some(map) = &buffers.shadow {
        map.lookup().bind(SHADOW_UNIT);
    }
    if surfaces(gl, buffers, target, &[Kind::Opaque, Kind::Mask], ran)? {
        ran.passes.push("opaque");
        gl.check("opaque")?;
    }
    gl.set(Fixed { depth_clamp: true, ..Fixed::default() });
    made(gl, buffers, &programs.sky, 3);
    ran.passes.push("sky");
    gl.check("sky")?;
    if let Some(program) = programs.ground.as_ref().filter(|_| above_ground(&buffers.scene, shot)) {
        gl.set(Fixed { depth_clamp: true, depth_write: true, behind: true, ..Fixed::default() });
        made(gl, buffers, program, 6);
        ran.passes.push("ground");
        gl.check("ground")?;
    }
    if surfaces(gl, buffers, target, &[Kind::Blend], ran)? {
        ran.passes.push("blended");
        gl.check("blended")?;
    }
    Ok(())
}

/// Samples to bytes, and the bytes to where the host can read them.
pub(super) fn encode(gl: &Gl, target: &Target, ran: &mut Ran) -> Result<()> {
    target.encode.bind(None);
    target.colour.bind(0);
    target.packed.bind_storage(PIXELS);
    gl.dispatch(target.width.div_ceil(LANES), target.height);
    ran.passes.push("encode");
    gl.check("encode")
}

/// Draws the groups of these kinds; whether there were any.
fn surfaces(gl: &Gl, buffers: &SceneBuffers, target: &Target, kinds: &[Kind], ran: &mut Ran) -> Result<bool> {
    let before = ran.draws;
    for drawn in buffers.groups.iter().filter(|drawn| kinds.contains(&drawn.group.kind)) {
        let group = &drawn.group;
        let single = drawn.surface_single.as_ref().filter(|_| target.samples == 1);
        let program = single.unwrap_or(&drawn.surface);
        gl.set(Fixed {
            depth_write: group.kind != Kind::Blend,
            cull: !group.double_sided,
            blend: group.kind == Kind::Blend,
            coverage: group.kind == Kind::Mask && target.samples > 1,
            ..Fixed::default()
        });
        bind_material(buffers, drawn, program, true)?;
        gl.draw_indexed(&buffers.corners, group.first_triangle, group.triangles);
        ran.draws += 1;
    }
    Ok(ran.draws > before)
}

fn made(gl: &Gl, buffers: &SceneBuffers, program: &Program, vertices: u32) {
    program.bind(None);
    gl.draw_made(&buffers.nothing, vertices);
}

/// Uses a program, with the one material of the group, or with the place where its triangles begin.
pub(super) fn bind_material(
    buffers: &SceneBuffers,
    drawn: &DrawGroup,
    program: &Program,
    reads_it: bool,
) -> Result<()> {
    if let Some(material) = drawn.group.material {
        buffers.buffer("materials")?.bind_uniform(MATERIAL, MATERIAL_BYTES * material, MATERIAL_BYTES);
    }
    if let Some(colour) = drawn.colour {
        buffers.colours[colour].bind(COLOUR_UNIT);
    }
    if let Some(normal) = drawn.normal {
        buffers.normals[normal].bind(NORMAL_UNIT);
    }
    let looks_up = reads_it && drawn.group.material.is_none();
    program.bind(looks_up.then_some(drawn.group.first_triangle as u32));
    Ok(())
}
