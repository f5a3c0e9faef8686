//! What a scene owns on the device: buffers, texture arrays, shadow map and programs, exactly as its plan says.

use std::collections::BTreeMap;
use std::rc::Rc;
use std::sync::Arc;

use bytemuck::{Pod, Zeroable};
use rayon::prelude::*;

use super::SharedBuffers;
use super::geometry::Geometry;
use super::gl::{self, Attribute, Buffer, Gl, Texture, TextureKind, VertexArray};
use super::plan::{Allocation, Plan, planned};
use super::programs::{Compile, DrawGroup, Programs};
use super::shaders::Options;
use super::shadow::{ShadowMap, fitting};
use super::textures::{Array, Use, arrays, cutoff, levels, place};
use crate::domain::AlphaMode;
use crate::error::{Result, during};
use crate::scene::Scene;

/// Twin of `Material` in `shaders/shared/material.glsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
struct PackedMaterial {
    ambient_alpha: [f32; 4],
    diffuse_cutoff: [f32; 4],
    specular_exponent: [f32; 4],
    images: [f32; 4],
    /// A uniform block may begin at any multiple of 256 bytes.
    gap: [f32; 48],
}

pub(super) const MATERIAL_BYTES: usize = size_of::<PackedMaterial>();
const _: () = assert!(MATERIAL_BYTES == 256, "PackedMaterial differs from shaders/shared/material.glsl");

/// A scene's buffers, textures and programs on the device; freed when dropped.
#[derive(Debug)]
pub struct SceneBuffers {
    /// Names of the buffers that a deformer may write in place of an upload.
    pub shared: SharedBuffers,
    pub(super) scene: Arc<Scene>,
    pub(super) buffers: BTreeMap<String, Buffer>,
    pub(super) views: Views,
    pub(super) groups: Vec<DrawGroup>,
    pub(super) corners: VertexArray,
    pub(super) casters: VertexArray,
    /// No attributes: for triangles that shaders make themselves.
    pub(super) nothing: VertexArray,
    pub(super) colours: Vec<Texture>,
    pub(super) normals: Vec<Texture>,
    pub(super) shadow: Option<ShadowMap>,
    pub(super) programs: Programs,
    /// What positions are relative to, in scene units from the scene's origin.
    pub(super) origin: [f64; 3],
    /// Positions that are drawn in place of the shared ones.
    pub(super) apart: Option<Apart>,
    plan: Plan,
}

/// Positions of a scene whose domains have no common origin, brought to one.
#[derive(Debug)]
pub(super) struct Apart {
    pub(super) buffer: Buffer,
    view: Texture,
}

impl Apart {
    pub(super) fn new(gl: &Rc<Gl>, bytes: u64) -> Result<Self> {
        let buffer = gl.buffer(bytes, gl::DYNAMIC_DRAW, None)?;
        let view = gl.view(&buffer, gl::RGB32F)?;
        Ok(Self { buffer, view })
    }
}

/// Buffers that shaders read like textures.
#[derive(Debug)]
pub(super) struct Views {
    pub(super) positions: Texture,
    pub(super) materials: Texture,
    pub(super) triangle_materials: Option<Texture>,
}

impl SceneBuffers {
    /// Allocates and fills what the plan of the scene says; `compile` gives programs that may be shared.
    pub(super) fn new(gl: &Rc<Gl>, scene: &Arc<Scene>, samples: u32, compile: &mut Compile<'_>) -> Result<Self> {
        let plan = planned(scene, gl.limits.software);
        let shadow = scene.look.shadow.map(|shadow| fitting(shadow, gl.limits.software));
        let geometry = Geometry::new(scene);
        let images = [arrays(scene, Use::Colour), arrays(scene, Use::Normal)];
        let materials = pack(scene, &images);
        let buffers = allocate(gl, &plan, &geometry, &materials)?;
        let (views, shared) = (views(gl, scene, &buffers)?, shared(&buffers)?);
        let (corners, casters) = vertex_arrays(gl, &buffers)?;
        let options = Options {
            defines: plan.defines.clone(),
            colour_arrays: images[0].len(),
            normal_arrays: images[1].len(),
            shadow: shadow.unwrap_or_default(),
            samples,
        };
        let groups = geometry.groups.iter();
        let groups: Result<Vec<DrawGroup>> =
            groups.map(|group| DrawGroup::compile(scene, *group, &images, &options, compile)).collect();
        let programs = Programs::compile(&options, &plan, compile)?;
        let [colours, normals] = images;
        Ok(Self {
            shared,
            scene: Arc::clone(scene),
            buffers,
            views,
            groups: groups?,
            corners,
            casters,
            nothing: gl.vertex_array(None, &[])?,
            colours: upload_arrays(gl, scene, &colours, Use::Colour)?,
            normals: upload_arrays(gl, scene, &normals, Use::Normal)?,
            shadow: shadow.map(|shadow| ShadowMap::new(gl, shadow)).transpose()?,
            programs,
            origin: [0.0; 3],
            apart: None,
            plan,
        })
    }

    /// Says what the positions in the shared buffers are relative to, in scene units from the scene's origin (which they
    /// are until this is called), and that these are to be drawn.
    pub fn relative_to(&mut self, origin: [f64; 3]) {
        self.origin = origin;
        self.apart = None;
    }

    /// The positions that are drawn.
    pub(super) fn drawn_positions(&self) -> &Texture {
        self.apart.as_ref().map_or(&self.views.positions, |apart| &apart.view)
    }

    /// The plan that was followed.
    pub const fn plan(&self) -> &Plan {
        &self.plan
    }

    /// The buffers that the device really holds for this scene, by name.
    pub fn allocated(&self) -> Vec<Allocation> {
        let buffers = self.buffers.iter().map(|(name, buffer)| Allocation { name: name.clone(), bytes: buffer.bytes });
        let apart = self.apart.iter().map(|apart| Allocation { name: "apart".into(), bytes: apart.buffer.bytes });
        buffers.chain(apart).collect()
    }

    /// The textures that the device really holds for this scene: arrays of images, and the maps of the shadow.
    pub fn texture_count(&self) -> usize {
        self.colours.len() + self.normals.len() + self.shadow.as_ref().map_or(0, ShadowMap::texture_count)
    }

    pub(super) fn buffer(&self, name: &'static str) -> Result<&Buffer> {
        named(&self.buffers, name)
    }
}

fn named<'a>(buffers: &'a BTreeMap<String, Buffer>, name: &'static str) -> Result<&'a Buffer> {
    buffers.get(name).ok_or_else(|| during("render")(format!("the plan has no buffer '{name}'")))
}

fn pack(scene: &Scene, images: &[Vec<Array>; 2]) -> Vec<PackedMaterial> {
    let wide = |[r, g, b]: [f32; 3], fourth: f32| [r, g, b, fourth];
    let at = |arrays: &[Array], texture: Option<usize>| {
        let place = texture.and_then(|texture| place(arrays, texture));
        place.map_or([-1.0; 2], |(array, layer)| [array as f32, layer as f32])
    };
    let one = |material: &crate::domain::Material| {
        let cutoff = if let AlphaMode::Mask { cutoff } = material.alpha_mode { cutoff } else { 0.0 };
        let ([a, b], [c, d]) = (at(&images[0], material.colour_texture), at(&images[1], material.normal_texture));
        PackedMaterial {
            ambient_alpha: wide(material.ambient, material.alpha),
            diffuse_cutoff: wide(material.diffuse, cutoff),
            specular_exponent: wide(material.specular, material.shininess),
            images: [a, b, c, d],
            gap: [0.0; 48],
        }
    };
    scene.materials.iter().map(one).collect()
}

fn allocate(
    gl: &Rc<Gl>,
    plan: &Plan,
    geometry: &Geometry,
    materials: &[PackedMaterial],
) -> Result<BTreeMap<String, Buffer>> {
    let mut buffers = BTreeMap::new();
    for allocation in &plan.buffers {
        let content: Option<&[u8]> = match allocation.name.as_str() {
            "corner vertices" => Some(bytemuck::cast_slice(&geometry.vertices)),
            "triangles" => Some(bytemuck::cast_slice(&geometry.triangles)),
            "uvs" => Some(bytemuck::cast_slice(&geometry.uvs)),
            "triangle materials" => Some(bytemuck::cast_slice(&geometry.materials)),
            "materials" => Some(bytemuck::cast_slice(materials)),
            _ => None,
        };
        let usage = if content.is_some() { gl::STATIC_DRAW } else { gl::DYNAMIC_DRAW };
        let buffer = gl.buffer(allocation.bytes, usage, content)?;
        buffers.insert(allocation.name.clone(), buffer);
    }
    Ok(buffers)
}

fn shared(buffers: &BTreeMap<String, Buffer>) -> Result<SharedBuffers> {
    Ok(SharedBuffers {
        positions: named(buffers, "positions")?.name(),
        normals: named(buffers, "normals")?.name(),
        tangents: buffers.get("tangents").map(Buffer::name),
    })
}

fn views(gl: &Rc<Gl>, scene: &Scene, buffers: &BTreeMap<String, Buffer>) -> Result<Views> {
    let limit = gl.limits.max_texels;
    for (field, count) in [("scene.vertices", scene.layout.vertices), ("scene.triangles", scene.layout.triangles)] {
        if count as u64 > limit {
            return Err(gl::too_large(field, limit, count as u64));
        }
    }
    let of_triangles = buffers.get("triangle materials");
    Ok(Views {
        positions: gl.view(named(buffers, "positions")?, gl::RGB32F)?,
        materials: gl.view(named(buffers, "materials")?, gl::RGBA32F)?,
        triangle_materials: of_triangles.map(|list| gl.view(list, gl::R32UI)).transpose()?,
    })
}

/// Attributes for the picture, and the fewer for the shadow map.
fn vertex_arrays(gl: &Rc<Gl>, buffers: &BTreeMap<String, Buffer>) -> Result<(VertexArray, VertexArray)> {
    let attribute = |location, buffer, components, integer| Attribute { location, buffer, components, integer };
    let index = named(buffers, "triangles")?;
    let vertex = || Ok(attribute(0, named(buffers, "corner vertices")?, 1, true));
    let uv = || buffers.get("uvs").map(|buffer| attribute(2, buffer, 2, false));
    let mut corners = vec![vertex()?, attribute(1, named(buffers, "normals")?, 3, false)];
    corners.extend(uv());
    corners.extend(buffers.get("tangents").map(|buffer| attribute(3, buffer, 4, false)));
    let mut casters = vec![vertex()?];
    casters.extend(uv());
    Ok((gl.vertex_array(Some(index), &corners)?, gl.vertex_array(Some(index), &casters)?))
}

fn upload_arrays(gl: &Rc<Gl>, scene: &Scene, arrays: &[Array], purpose: Use) -> Result<Vec<Texture>> {
    arrays.iter().map(|array| upload_array(gl, scene, array, purpose)).collect()
}

fn upload_array(gl: &Rc<Gl>, scene: &Scene, array: &Array, purpose: Use) -> Result<Texture> {
    let layers = array.layers.len() as u32;
    if layers > gl.limits.max_layers {
        let field = format!("textures of {} x {}", array.width, array.height);
        return Err(gl::too_large(&field, u64::from(gl.limits.max_layers), u64::from(layers)));
    }
    let texture = gl.texture(TextureKind {
        target: gl::TEXTURE_2D_ARRAY,
        format: if purpose == Use::Colour { gl::SRGB8_ALPHA8 } else { gl::RGBA8 },
        width: array.width,
        height: array.height,
        depth: layers,
        levels: array.levels(),
    })?;
    // A few layers at a time: all chains of a large scene at once would take many times its textures in memory.
    for (chunk, part) in array.layers.chunks(8).enumerate() {
        let chain = |layer: &usize| {
            let cutoff = if purpose == Use::Colour { cutoff(scene, *layer) } else { None };
            levels(&scene.textures[*layer], array, purpose, cutoff)
        };
        let chains: Vec<Vec<Vec<u8>>> = part.par_iter().map(chain).collect();
        for (offset, chain) in chains.iter().enumerate() {
            for (level, rgba) in chain.iter().enumerate() {
                let size = [(array.width >> level).max(1), (array.height >> level).max(1)];
                texture.fill(level as u32, (8 * chunk + offset) as u32, size, rgba)?;
            }
        }
    }
    // On a CPU blending two levels costs a sixth of the frame and is hardly seen.
    let between = if gl.limits.software { gl::LINEAR_MIPMAP_NEAREST } else { gl::LINEAR_MIPMAP_LINEAR };
    let sampling = [
        (gl::TEXTURE_MIN_FILTER, between),
        (gl::TEXTURE_MAG_FILTER, gl::LINEAR),
        (gl::TEXTURE_WRAP_S, gl::REPEAT),
        (gl::TEXTURE_WRAP_T, gl::REPEAT),
    ];
    texture.sampling(&sampling, gl.limits.anisotropy);
    Ok(texture)
}
