//! The passes of one frame, in order: shadow, blur, visibility, ground, blended, backdrop, shade; then those of `post.rs`.

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
/// Groups of the dispatch over listed tiles: rows of TILE_ROW, none so far; and the tiles, none so far.
pub(super) const NO_TILES: [u32; 4] = [TILE_ROW, 0, 1, 0];
const FRAME: u32 = 0;
const SPLITS: u32 = 2;
/// Nothing is blended yet: no light, and all that lies behind comes through.
const CLEAR_LAYER: [f32; 4] = [0.0, 0.0, 0.0, 1.0];

/// Which triangles of a kind a pass draws.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Drawn {
    All,
    /// Those that culling has listed.
    Listed,
}

/// Binds what all passes read.
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

/// Depth from the sun, unless a rasteriser beside OpenGL has drawn it.
pub(super) fn shadow(gl: &Gl, buffers: &SceneBuffers, ran: &mut Ran) -> Result<()> {
    let Some(map) = buffers.shadow.as_ref().filter(|_| buffers.shadow_beside().is_none()) else { return Ok(()) };
    ran.paths.shadow = Some(Path::OpenGl);
    super::shadow::depth(gl, buffers, map)?;
    ran.passes.extend(buffers.culler.as_ref().map(|_| SHADOW_CULL));
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

/// What each sample sees: ids and depth.
pub(super) fn visibility(
    gl: &Gl,
    buffers: &SceneBuffers,
    target: &Target,
    sampled: &Sampled,
    ran: &mut Ran,
) -> Result<()> {
    let programs = (sampled.mask.as_deref(), sampled.parts.as_deref());
    // Of several samples, depth says where there is an id.
    let clear = match target.form.samples {
        1 => Clear::DepthAndIds(Some(&target.touched)),
        _ => Clear::Depth(Some(&target.touched.depth)),
    };
    let into = (&target.visible, clear, target.reach.get(), listed(buffers));
    identify(gl, buffers, into, programs, ran)?;
    super::cull::remember(gl, buffers, target, sampled)
}

/// Ids and depth into a part of a framebuffer as large as its frame or larger: of what is opaque; of what is cut out, by
/// the first program; and of the opaque parts of what is blended, by the second.
pub(super) fn identify(
    gl: &Gl,
    buffers: &SceneBuffers,
    (into, clear, part, drawn): (&Framebuffer, Clear<'_>, Region, Drawn),
    (cut_out, parts): (Option<&Program>, Option<&Program>),
    ran: &mut Ran,
) -> Result<()> {
    gl.begin(into, part, clear);
    // What is cut out comes last: where something stands before it, nothing is sampled.
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

/// The ground as one more thing that samples see. A picture's is drawn where something lies below it alone; else the
/// shading finds it.
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

/// The layer of the blended triangles, before what is opaque.
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

/// What is seen to linear light.
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

/// Binds what each sample sees. Depth says where that is something.
pub(super) fn bind_seen(target: &Target) {
    target.ids.bind(ID_UNIT);
    target.depth.bind(DEPTH_UNIT);
}

/// Words made from ids, where the host can read them; `program` has a number at location 0 when one is given.
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

/// Ids of each pixel's first sample, where the host can read them.
pub(super) fn seen(gl: &Gl, target: &Target, program: &Program) -> Result<()> {
    program.bind(None);
    bind_seen(target);
    target.packed.bind_storage(PIXELS);
    gl.dispatch(target.form.width.div_ceil(LANES), target.form.height);
    gl.check("seen")
}

/// Draws the triangles of one kind: a call for those with one side, and one for those with two.
fn draw(gl: &Gl, buffers: &SceneBuffers, (kind, program, drawn): (Kind, &Program, Drawn), fixed: Fixed, ran: &mut Ran) {
    for (index, group) in buffers.groups.iter().enumerate().filter(|(_, group)| group.kind == kind) {
        gl.set(Fixed { cull: !group.double_sided, ..fixed });
        program.bind(Some(begins(group, drawn)));
        draw_group(gl, buffers, index, drawn);
        ran.draws += 1;
    }
}

/// Depth of the triangles of one kind into a framebuffer that is bound.
pub(super) fn draw_depth(
    gl: &Gl,
    buffers: &SceneBuffers,
    (kind, program): (Kind, &Program),
    drawn: Drawn,
    ran: &mut Ran,
) {
    draw(gl, buffers, (kind, program, drawn), Fixed { depth_write: true, ..Fixed::default() }, ran);
}

/// Draws the triangles of one kind, those with one side and those with two alike, with a program in use: in one call, or
/// a call for each list.
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

/// What a culled scene's passes draw, and any other's.
pub(super) fn listed(buffers: &SceneBuffers) -> Drawn {
    if buffers.culler.is_some() { Drawn::Listed } else { Drawn::All }
}

/// Where the triangles of a group, or its list, begin, as the shaders take it.
pub(super) const fn begins(group: &Group, drawn: Drawn) -> u32 {
    match drawn {
        Drawn::All => group.first_triangle as u32,
        Drawn::Listed => !(group.first_triangle as u32),
    }
}

/// Draws a group, or its list.
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
