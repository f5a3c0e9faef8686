//! The passes of one frame, in execution order: shadow, blur, visibility, ground, blended, backdrop, shade. `post.rs`
//! has the passes after them.

use super::cull::{SHADOW_CULL, command};
use super::frame::{Frame, above_ground};
use super::geometry::{Group, Kind};
use super::gl::{Buffer, Clear, Fixed, Framebuffer, Gl, Program, Texture};
use super::paths::Path;
use super::programs::Sampled;
use super::region::Region;
use super::scene_buffers::SceneBuffers;
use super::shaders::{
    COLOUR_UNIT, COUNT_UNIT, DEPTH_UNIT, ID_UNIT, LANES, LAYER_UNIT, NORMAL_UNIT, POSITION_UNIT, SHADOW_UNIT, TILE,
    TILE_ROW,
};
use super::splits::Splits;
use super::target::Target;
use super::{Ran, Shot};
use modalcast_model::error::Result;

pub(super) const PIXELS: u32 = 0;
pub(super) const TILES: u32 = 1;
/// Initial indirect dispatch over listed tiles: group counts (TILE_ROW, 0 rows, 1), then the tile count 0.
pub(super) const NO_TILES: [u32; 4] = [TILE_ROW, 0, 1, 0];
const FRAME: u32 = 0;
const SPLITS: u32 = 2;
/// Cleared layer: no light, full transmittance.
const CLEAR_LAYER: [f32; 4] = [0.0, 0.0, 0.0, 1.0];

/// Which triangles of a kind a pass draws.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Drawn {
    All,
    /// The triangles in the culled lists.
    Listed,
}

/// Binds the buffers and textures that all passes read.
pub(super) fn bind(buffers: &SceneBuffers) -> Result<()> {
    buffers.drawn_positions().bind(POSITION_UNIT);
    for (unit, view) in &buffers.views.others {
        view.bind(*unit);
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

/// Draws the depth of the shadow map, unless the compute rasterizer has drawn it.
pub(super) fn shadow(gl: &Gl, buffers: &SceneBuffers, ran: &mut Ran) -> Result<()> {
    let Some(map) = buffers.shadow.as_ref().filter(|_| buffers.shadow_beside().is_none()) else { return Ok(()) };
    ran.paths.shadow = Some(Path::OpenGl);
    super::shadow::depth(gl, buffers, map)?;
    ran.passes.extend(buffers.culler.as_ref().map(|_| SHADOW_CULL));
    ran.passes.push("shadow");
    Ok(())
}

/// Blurs the moments of a variance map. Other shadow methods need depth only.
pub(super) fn blur(gl: &Gl, buffers: &SceneBuffers, ran: &mut Ran) -> Result<()> {
    let Some(map) = &buffers.shadow else { return Ok(()) };
    if super::shadow::blur(gl, buffers, map)? {
        ran.passes.push("blur");
    }
    Ok(())
}

/// Draws the id and depth of each sample.
pub(super) fn visibility(
    gl: &Gl,
    buffers: &SceneBuffers,
    target: &Target,
    sampled: &Sampled,
    ran: &mut Ran,
) -> Result<()> {
    let programs = (sampled.mask.as_deref(), sampled.parts.as_deref());
    // With several samples, depth says where an id is valid; the ids need no clear.
    let clear = match target.form.samples {
        1 => Clear::DepthAndIds(Some(&target.touched)),
        _ => Clear::Depth(Some(&target.touched.depth)),
    };
    let into = (&target.visible, clear, target.reach.get(), listed(buffers));
    identify(gl, buffers, into, programs, ran)?;
    super::cull::remember(gl, buffers, target, sampled)
}

/// Draws ids and depth into `part` of a framebuffer that is at least as large as the part's frame: of opaque triangles,
/// of cut-outs with the first program, and of the opaque parts of blended triangles with the second.
pub(super) fn identify(
    gl: &Gl,
    buffers: &SceneBuffers,
    (into, clear, part, drawn): (&Framebuffer, Clear<'_>, Region, Drawn),
    (cut_out, parts): (Option<&Program>, Option<&Program>),
    ran: &mut Ran,
) -> Result<()> {
    gl.begin(into, part, clear);
    // Cut-outs come after opaque triangles: where something opaque is nearer, the depth test saves their texture
    // lookups.
    let kinds = [(Kind::Opaque, buffers.programs.opaque.as_deref()), (Kind::Mask, cut_out), (Kind::Blend, parts)];
    let written = Fixed { depth_write: true, ..Fixed::default() };
    let mut any = false;
    for (kind, program) in kinds {
        if let Some(program) = program {
            draw(gl, buffers, (kind, program, drawn), written, ran);
            any = true;
        }
    }
    if any {
        ran.passes.push("visibility");
        ran.paths.visibility = Some(Path::OpenGl);
    }
    gl.check("visibility")
}

/// Draws the ground into ids and depth. A picture draws it only when something lies below it; otherwise the shading
/// finds the ground.
pub(super) fn ground(gl: &Gl, buffers: &SceneBuffers, shot: &Shot, ran: &mut Ran) -> Result<()> {
    let Some(program) = buffers.programs.ground.as_ref().filter(|_| above_ground(&buffers.scene, shot)) else {
        return Ok(());
    };
    gl.set(Fixed { depth_clamp: true, depth_write: true, behind: true, ..Fixed::default() });
    program.bind(None);
    gl.draw_made(&buffers.nothing, 3);
    ran.passes.push("ground");
    gl.check("ground")
}

/// Draws the layer of the blended triangles in front of the opaque ones.
pub(super) fn blended(
    gl: &Gl,
    buffers: &SceneBuffers,
    target: &Target,
    sampled: &Sampled,
    ran: &mut Ran,
) -> Result<()> {
    if let (Some(programs), Some(lists)) = (&sampled.lists, &target.lists) {
        return super::lists::draw(gl, buffers, (lists, target.reach.get()), programs, ran);
    }
    let (Some(program), Some(layer)) = (&sampled.blended, &target.layer) else { return Ok(()) };
    gl.begin(&layer.framebuffer, target.reach.get(), Clear::Colour(CLEAR_LAYER, &layer.touched));
    bind_shadow(buffers);
    let program = (Kind::Blend, program.as_ref(), listed(buffers));
    draw(gl, buffers, program, Fixed { blend: true, ..Fixed::default() }, ran);
    ran.passes.push("blended");
    gl.check("blended")
}

/// Shades the visible surfaces to linear light.
pub(super) fn shade(gl: &Gl, buffers: &SceneBuffers, target: &Target, sampled: &Sampled, ran: &mut Ran) -> Result<()> {
    bind_shadow(buffers);
    bind_seen(target);
    if let Some(layer) = &target.layer {
        layer.colour.bind(LAYER_UNIT);
    }
    if let Some(lists) = &target.lists {
        lists.layers.bind(LAYER_UNIT);
        lists.counts.bind(COUNT_UNIT);
    }
    target.picture.bind_image(0);
    if let Some(glare) = target.glow.first() {
        glare.bind_image(1);
    }
    target.tiles.write(bytemuck::cast_slice(&NO_TILES));
    target.tiles.bind_storage(TILES);
    sampled.backdrop.bind(None);
    gl.dispatch(target.form.width.div_ceil(TILE), target.form.height.div_ceil(TILE));
    ran.passes.push("backdrop");
    gl.check("backdrop")?;
    if let Some(program) = &sampled.shade {
        program.bind(None);
        gl.dispatch_listed(&target.tiles);
        ran.passes.push("shade");
    }
    gl.check("shade")
}

/// Binds ids and depth. Depth says which samples hold a valid id.
pub(super) fn bind_seen(target: &Target) {
    target.ids.bind(ID_UNIT);
    target.depth.bind(DEPTH_UNIT);
}

/// Converts ids to words in a buffer that can be copied to the host. `number` is the uniform at location 0 of programs
/// that have one.
pub(super) fn words(
    gl: &Gl,
    (ids, into): (&Texture, &Buffer),
    (program, number): (&Program, Option<u32>),
    [width, height]: [u32; 2],
) -> Result<()> {
    program.bind(number);
    ids.bind(ID_UNIT);
    into.bind_storage(PIXELS);
    gl.dispatch(width.div_ceil(LANES), height);
    gl.check("words")
}

/// Packs the ids of each pixel's first sample into a buffer that can be copied to the host.
pub(super) fn seen(gl: &Gl, target: &Target, program: &Program) -> Result<()> {
    program.bind(None);
    bind_seen(target);
    target.packed.bind_storage(PIXELS);
    gl.dispatch(target.form.width.div_ceil(LANES), target.form.height);
    gl.check("seen")
}

/// Draws the triangles of one kind: one call for single-sided, one for double-sided ones.
fn draw(gl: &Gl, buffers: &SceneBuffers, (kind, program, drawn): (Kind, &Program, Drawn), fixed: Fixed, ran: &mut Ran) {
    for (index, group) in buffers.groups.iter().enumerate().filter(|(_, group)| group.kind == kind) {
        gl.set(Fixed { cull: !group.double_sided, ..fixed });
        program.bind(Some(begins(group, drawn)));
        draw_group(gl, buffers, index, drawn);
        ran.draws += 1;
    }
}

/// Draws the depth of one kind of triangle into the bound framebuffer.
pub(super) fn draw_depth(
    gl: &Gl,
    buffers: &SceneBuffers,
    (kind, program): (Kind, &Program),
    drawn: Drawn,
    ran: &mut Ran,
) {
    draw(gl, buffers, (kind, program, drawn), Fixed { depth_write: true, ..Fixed::default() }, ran);
}

/// Draws the triangles of one kind, single- and double-sided alike, with the bound program: in one call, or in one call
/// per culled list.
pub(super) fn draw_kind(gl: &Gl, buffers: &SceneBuffers, (kind, program): (Kind, &Program), drawn: Drawn) {
    let has_fragments = kind != Kind::Opaque;
    if drawn == Drawn::All {
        let (first, count) = buffers.triangles(kind);
        if has_fragments {
            program.first(first as u32);
        }
        if let Some(array) = buffers.array(kind) {
            gl.draw_indexed(array, first, count);
        }
        return;
    }
    for (index, group) in buffers.groups.iter().enumerate().filter(|(_, group)| group.kind == kind) {
        if has_fragments {
            program.first(begins(group, drawn));
        }
        draw_group(gl, buffers, index, drawn);
    }
}

/// The culled lists when the scene is culled, else all triangles.
pub(super) fn listed(buffers: &SceneBuffers) -> Drawn {
    if buffers.culler.is_some() { Drawn::Listed } else { Drawn::All }
}

/// Offset of a group for the shaders: its first triangle, or the complement of it for a list
/// (`shaders/shared/drawn.glsl`).
pub(super) const fn begins(group: &Group, drawn: Drawn) -> u32 {
    match drawn {
        Drawn::All => group.first_triangle as u32,
        Drawn::Listed => !(group.first_triangle as u32),
    }
}

/// Draws a group, or the culled list of the group.
pub(super) fn draw_group(gl: &Gl, buffers: &SceneBuffers, index: usize, drawn: Drawn) {
    let group = buffers.groups[index];
    match drawn {
        Drawn::All => {
            if let Some(array) = buffers.array(group.kind) {
                gl.draw_indexed(array, group.first_triangle, group.triangles);
            }
        }
        Drawn::Listed => {
            if let Some((array, ledger)) = buffers.listed(group.kind) {
                gl.draw_told(array, ledger, command(index));
            }
        }
    }
}

pub(super) fn bind_shadow(buffers: &SceneBuffers) {
    if let Some(map) = &buffers.shadow {
        map.lookup().bind(SHADOW_UNIT);
    }
}
