//! Shadow map of a scene and the passes that draw it: depth from the sun and, for a variance map, its blurred moments.
//! One array layer per cascade (split).

mod blur_strip;
mod cache;
mod sources;

use std::rc::Rc;

pub(crate) use self::cache::ShadowCache;
pub(crate) use self::sources::defines;
use self::sources::{TEXELS_PER_INVOCATION, texels_per_workgroup};
use super::geometry::BlendMode;
use super::passes::{draw_blend_mode, triangle_set};
use super::raster_backends::ComputeRasterizer;
use super::region::Region;
use super::scene_buffers::SceneBuffers;
use super::shaders::WORKGROUP_SIZE;
use crate::device::gl::{self, ClearOp, Framebuffer, Gl, PipelineState, Program, Texture, TextureDesc};
use crate::types::BlurMethod;
use modalcast_model::error::{Result, fault_in};
use modalcast_model::scene::{MomentFormat, ShadowSettings};

/// Textures and framebuffers of a shadow map.
#[derive(Debug)]
pub(crate) struct ShadowMap {
    shadow: ShadowSettings,
    blur_method: BlurMethod,
    depth: Texture,
    /// One per layer of the depth.
    framebuffers: Vec<Framebuffer>,
    blurred: Option<BlurredMoments>,
}

/// The blurred moments of a variance map.
#[derive(Debug)]
struct BlurredMoments {
    moments: Texture,
    /// One layer of moments blurred in x; none when tiles are blurred in both directions at once.
    horizontal: Option<Texture>,
    /// For `horizontal`, then for each layer of the moments; empty when compute shaders blur.
    framebuffers: Vec<Framebuffer>,
}

/// Textures of a map: name, bytes per texel, layers.
pub(crate) fn textures(shadow: &ShadowSettings, blur_method: BlurMethod) -> Vec<(&'static str, u32, u32)> {
    let pair = if shadow.moments == MomentFormat::F16 { 4 } else { 8 };
    let mut textures = vec![("shadow depth", 4, shadow.splits)];
    if shadow.has_moments() {
        textures.push(("shadow moments", pair, shadow.splits));
        if matches!(blur_method, BlurMethod::Rows | BlurMethod::Fragments) {
            textures.push(("shadow moments, blurred in x", pair, 1));
        }
    }
    textures
}

impl ShadowMap {
    pub(crate) fn new(gl: &Rc<Gl>, shadow: ShadowSettings, blur_method: BlurMethod) -> Result<Self> {
        let most = gl.limits.max_side;
        if shadow.size > most {
            return Err(gl::too_large("look.shadow.size", u64::from(most), u64::from(shadow.size)));
        }
        let depth = create_image(gl, &shadow, gl::DEPTH_COMPONENT32F, gl::NEAREST, shadow.splits)?;
        let framebuffers =
            (0..shadow.splits).map(|layer| gl.layer_framebuffer(&depth, true, layer)).collect::<Result<_>>()?;
        let blurred = if shadow.has_moments() { Some(BlurredMoments::new(gl, &shadow, blur_method)?) } else { None };
        Ok(Self { shadow, blur_method, depth, framebuffers, blurred })
    }

    /// The texture that the shading samples: moments if there are any, else depth.
    pub(crate) fn lookup(&self) -> &Texture {
        self.blurred.as_ref().map_or(&self.depth, |blurred| &blurred.moments)
    }

    /// Number of textures that the map holds.
    pub(crate) fn texture_count(&self) -> usize {
        textures(&self.shadow, self.blur_method).len()
    }
}

impl BlurredMoments {
    fn new(gl: &Rc<Gl>, shadow: &ShadowSettings, blur_method: BlurMethod) -> Result<Self> {
        let format = if shadow.moments == MomentFormat::F16 { gl::RG16F } else { gl::RG32F };
        let moments = create_image(gl, shadow, format, gl::LINEAR, shadow.splits)?;
        let horizontal = match blur_method {
            BlurMethod::Auto | BlurMethod::Tiles => None,
            BlurMethod::Rows | BlurMethod::Fragments => Some(create_image(gl, shadow, format, gl::NEAREST, 1)?),
        };
        let mut framebuffers = Vec::new();
        if let Some(horizontal) = horizontal.as_ref().filter(|_| blur_method == BlurMethod::Fragments) {
            framebuffers.push(gl.layer_framebuffer(horizontal, false, 0)?);
            for layer in 0..shadow.splits {
                framebuffers.push(gl.layer_framebuffer(&moments, false, layer)?);
            }
        }
        Ok(Self { moments, horizontal, framebuffers })
    }
}

fn create_image(gl: &Rc<Gl>, shadow: &ShadowSettings, format: u32, filter: u32, layers: u32) -> Result<Texture> {
    let size = shadow.size;
    let target = gl::TEXTURE_2D_ARRAY;
    let texture = gl.texture(TextureDesc { target, format, width: size, height: size, depth: layers, levels: 1 })?;
    let sampling = [
        (gl::TEXTURE_MIN_FILTER, filter),
        (gl::TEXTURE_MAG_FILTER, filter),
        (gl::TEXTURE_WRAP_S, gl::CLAMP_TO_EDGE),
        (gl::TEXTURE_WRAP_T, gl::CLAMP_TO_EDGE),
    ];
    texture.set_sampling(&sampling, 1.0);
    Ok(texture)
}

/// Draws the depth from the sun, layer by layer.
pub(crate) fn depth(gl: &Gl, buffers: &SceneBuffers, map: &ShadowMap) -> Result<()> {
    let size = map.shadow.size;
    let drawn = triangle_set(buffers);
    for (layer, framebuffer) in (0..).zip(&map.framebuffers) {
        super::cull::cull_shadow_casters(gl, buffers, size, |program| choose(program, map, layer))?;
        gl.begin_pass(framebuffer, Region::whole([size; 2]), ClearOp::Depth(None));
        gl.set_pipeline_state(PipelineState { depth_write: true, ..PipelineState::default() });
        for (blend_mode, program) in
            [BlendMode::Opaque, BlendMode::Mask, BlendMode::Blend].into_iter().zip(&buffers.programs.shadow)
        {
            let Some(program) = program else { continue };
            program.bind(None);
            choose(program, map, layer);
            draw_blend_mode(gl, buffers, (blend_mode, program), drawn);
        }
    }
    gl.check("shadow")
}

/// Blurs the moments of the depth, layer by layer. Returns whether the map has moments.
pub(crate) fn blur(gl: &Gl, buffers: &SceneBuffers, map: &ShadowMap) -> Result<bool> {
    let Some(blurred) = &map.blurred else { return Ok(false) };
    let mut programs: Vec<&Program> = buffers.programs.blur.iter().map(AsRef::as_ref).collect();
    if let (Some((depths, program)), Some(first)) =
        (buffers.shadow_rasterizer().and_then(ComputeRasterizer::blur_input), programs.first_mut())
    {
        *first = program;
        depths.bind_storage(0);
    }
    for layer in 0..map.shadow.splits {
        match (programs.as_slice(), &blurred.horizontal) {
            ([both], None) => {
                let groups = texels_per_workgroup(&map.shadow).map(|side| map.shadow.size.div_ceil(side));
                begin(both, &map.depth, map, layer);
                blurred.moments.bind_image_layer(0, layer);
                gl.dispatch(groups[0], groups[1]);
            }
            ([x, y], Some(horizontal)) if blurred.framebuffers.is_empty() => {
                let (size, runs) = (map.shadow.size, map.shadow.size.div_ceil(TEXELS_PER_INVOCATION));
                begin(x, &map.depth, map, layer);
                horizontal.bind_image(0);
                gl.dispatch(runs.div_ceil(WORKGROUP_SIZE), size);
                begin(y, horizontal, map, layer);
                blurred.moments.bind_image_layer(0, layer);
                gl.dispatch(size.div_ceil(WORKGROUP_SIZE), runs);
            }
            ([x, y], Some(horizontal)) => {
                gl.set_pipeline_state(PipelineState::default());
                let into = [&blurred.framebuffers[0], &blurred.framebuffers[1 + layer as usize]];
                for ((program, from), into) in [(x, &map.depth), (y, horizontal)].into_iter().zip(into) {
                    begin(program, from, map, layer);
                    gl.draw_fullscreen_triangle(into, map.shadow.size, &buffers.empty_vertex_array);
                }
            }
            _ => return Err(fault_in("blur")("the plan has no program for this map")),
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
        program.set_layer(layer);
    }
}
