//! Shadow map of a scene and the passes that draw it: depth from the sun and, for a variance map, its blurred moments.
//! One array layer per cascade (split).

mod shared;
mod sources;
mod strip;

use std::rc::Rc;

pub(super) use self::shared::Shared;
pub(super) use self::sources::defines;
use self::sources::{RUN, made_at_once};
use super::geometry::Kind;
use super::gl::{self, Clear, Fixed, Framebuffer, Gl, Program, Texture, TextureKind};
use super::passes::{draw_kind, listed};
use super::paths::Beside;
use super::region::Region;
use super::scene_buffers::SceneBuffers;
use super::shaders::LANES;
use modalcast_model::error::{Result, during};
use modalcast_model::scene::{Blurring, Moments, Shadow};

/// Textures and framebuffers of a shadow map.
#[derive(Debug)]
pub(super) struct ShadowMap {
    shadow: Shadow,
    depth: Texture,
    /// One per layer of the depth.
    framebuffers: Vec<Framebuffer>,
    blurred: Option<Blurred>,
}

/// The blurred moments of a variance map.
#[derive(Debug)]
struct Blurred {
    moments: Texture,
    /// One layer of moments blurred in x; none when tiles are blurred in both directions at once.
    half: Option<Texture>,
    /// For `half`, then for each layer of the moments; empty when compute shaders blur.
    framebuffers: Vec<Framebuffer>,
}

/// Resolves the settings that depend on the kind of device.
pub(super) fn fitting(shadow: Shadow, software: bool) -> Shadow {
    let blurring = match shadow.blurring {
        Blurring::Fitting if software => Blurring::Rows,
        Blurring::Fitting => Blurring::Tiles,
        chosen => chosen,
    };
    Shadow { blurring, ..shadow }
}

/// Textures of a map: name, bytes per texel, layers.
pub(super) fn textures(shadow: &Shadow) -> Vec<(&'static str, u32, u32)> {
    let pair = if shadow.moments == Moments::F16 { 4 } else { 8 };
    let mut textures = vec![("shadow depth", 4, shadow.splits)];
    if shadow.has_moments() {
        textures.push(("shadow moments", pair, shadow.splits));
        if matches!(shadow.blurring, Blurring::Rows | Blurring::Fragments) {
            textures.push(("shadow moments, blurred in x", pair, 1));
        }
    }
    textures
}

impl ShadowMap {
    pub(super) fn new(gl: &Rc<Gl>, shadow: Shadow) -> Result<Self> {
        let most = gl.limits.max_side;
        if shadow.size > most {
            return Err(gl::too_large("look.shadow.size", u64::from(most), u64::from(shadow.size)));
        }
        let depth = image(gl, &shadow, gl::DEPTH_COMPONENT32F, gl::NEAREST, shadow.splits)?;
        let framebuffers =
            (0..shadow.splits).map(|layer| gl.layer_framebuffer(&depth, true, layer)).collect::<Result<_>>()?;
        let blurred = if shadow.has_moments() { Some(Blurred::new(gl, &shadow)?) } else { None };
        Ok(Self { shadow, depth, framebuffers, blurred })
    }

    /// The texture that the shading samples: moments if there are any, else depth.
    pub(super) fn lookup(&self) -> &Texture {
        self.blurred.as_ref().map_or(&self.depth, |blurred| &blurred.moments)
    }

    /// Number of textures that the map holds.
    pub(super) fn texture_count(&self) -> usize {
        textures(&self.shadow).len()
    }
}

impl Blurred {
    fn new(gl: &Rc<Gl>, shadow: &Shadow) -> Result<Self> {
        let format = if shadow.moments == Moments::F16 { gl::RG16F } else { gl::RG32F };
        let moments = image(gl, shadow, format, gl::LINEAR, shadow.splits)?;
        let half = match shadow.blurring {
            Blurring::Fitting | Blurring::Tiles => None,
            Blurring::Rows | Blurring::Fragments => Some(image(gl, shadow, format, gl::NEAREST, 1)?),
        };
        let mut framebuffers = Vec::new();
        if let Some(half) = half.as_ref().filter(|_| shadow.blurring == Blurring::Fragments) {
            framebuffers.push(gl.layer_framebuffer(half, false, 0)?);
            for layer in 0..shadow.splits {
                framebuffers.push(gl.layer_framebuffer(&moments, false, layer)?);
            }
        }
        Ok(Self { moments, half, framebuffers })
    }
}

fn image(gl: &Rc<Gl>, shadow: &Shadow, format: u32, filter: u32, layers: u32) -> Result<Texture> {
    let size = shadow.size;
    let target = gl::TEXTURE_2D_ARRAY;
    let texture = gl.texture(TextureKind { target, format, width: size, height: size, depth: layers, levels: 1 })?;
    let sampling = [
        (gl::TEXTURE_MIN_FILTER, filter),
        (gl::TEXTURE_MAG_FILTER, filter),
        (gl::TEXTURE_WRAP_S, gl::CLAMP_TO_EDGE),
        (gl::TEXTURE_WRAP_T, gl::CLAMP_TO_EDGE),
    ];
    texture.sampling(&sampling, 1.0);
    Ok(texture)
}

/// Draws the depth from the sun, layer by layer.
pub(super) fn depth(gl: &Gl, buffers: &SceneBuffers, map: &ShadowMap) -> Result<()> {
    let size = map.shadow.size;
    let drawn = listed(buffers);
    for (layer, framebuffer) in (0..).zip(&map.framebuffers) {
        super::cull::sun(gl, buffers, size, |program| choose(program, map, layer))?;
        gl.begin(framebuffer, Region::whole([size; 2]), Clear::Depth(None));
        gl.set(Fixed { depth_write: true, ..Fixed::default() });
        for (kind, program) in [Kind::Opaque, Kind::Mask, Kind::Blend].into_iter().zip(&buffers.programs.shadow) {
            let Some(program) = program else { continue };
            program.bind(None);
            choose(program, map, layer);
            draw_kind(gl, buffers, (kind, program), drawn);
        }
    }
    gl.check("shadow")
}

/// Blurs the moments of the depth, layer by layer. Returns whether the map has moments.
pub(super) fn blur(gl: &Gl, buffers: &SceneBuffers, map: &ShadowMap) -> Result<bool> {
    let Some(blurred) = &map.blurred else { return Ok(false) };
    let mut programs: Vec<&Program> = buffers.programs.blur.iter().map(AsRef::as_ref).collect();
    if let (Some((depths, program)), Some(first)) =
        (buffers.shadow_beside().and_then(Beside::blur), programs.first_mut())
    {
        *first = program;
        depths.bind_storage(0);
    }
    for layer in 0..map.shadow.splits {
        match (programs.as_slice(), &blurred.half) {
            ([both], None) => {
                let groups = made_at_once(&map.shadow).map(|side| map.shadow.size.div_ceil(side));
                begin(both, &map.depth, map, layer);
                blurred.moments.bind_image_layer(0, layer);
                gl.dispatch(groups[0], groups[1]);
            }
            ([x, y], Some(half)) if blurred.framebuffers.is_empty() => {
                let (size, runs) = (map.shadow.size, map.shadow.size.div_ceil(RUN));
                begin(x, &map.depth, map, layer);
                half.bind_image(0);
                gl.dispatch(runs.div_ceil(LANES), size);
                begin(y, half, map, layer);
                blurred.moments.bind_image_layer(0, layer);
                gl.dispatch(size.div_ceil(LANES), runs);
            }
            ([x, y], Some(half)) => {
                gl.set(Fixed::default());
                let into = [&blurred.framebuffers[0], &blurred.framebuffers[1 + layer as usize]];
                for ((program, from), into) in [(x, &map.depth), (y, half)].into_iter().zip(into) {
                    begin(program, from, map, layer);
                    gl.cover(into, map.shadow.size, &buffers.nothing);
                }
            }
            _ => return Err(during("blur")("the plan has no program for this map")),
        }
    }
    gl.check("blur").map(|()| true)
}

fn begin(program: &Program, from: &Texture, map: &ShadowMap, layer: u32) {
    program.bind(None);
    from.bind(0);
    choose(program, map, layer);
}

/// Sets the layer of the bound program, which has that uniform only when the map is split.
fn choose(program: &Program, map: &ShadowMap, layer: u32) {
    if map.shadow.splits > 1 {
        program.layer(layer);
    }
}
