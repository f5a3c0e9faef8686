//! Device resources of one scene: buffers, texture arrays, shadow map and programs, exactly as its plan says.

use std::collections::BTreeMap;
use std::rc::Rc;
use std::sync::Arc;

use bytemuck::{Pod, Zeroable};
use rayon::prelude::*;

use super::SharedBuffers;
use super::cull::{Culler, LISTED};
use super::geometry::{Geometry, Group, Kind, Stretch, kind, used_materials, whose};
use super::gl::{self, Attribute, Buffer, Gl, Program, Texture, TextureKind, VertexArray};
use super::paths::Beside;
use super::plan::{Allocation, Plan, planned};
use super::post::Post;
use super::programs::{Compile, Programs, Sampled};
use super::shaders::{self, OTHER_READS, Options, Used};
use super::shadow::{ShadowMap, Shared, fitting};
use super::textures::{Array, Use, arrays, cutoff, levels, place, within_budget};
use modalcast_model::domain::AlphaMode;
use modalcast_model::error::{Result, during};
use modalcast_model::scene::Scene;

/// GPU layout of a material. Twin of `material_of` in `shaders/shared/material.glsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
struct PackedMaterial {
    /// Ambient color, array of the normal map.
    ambient_array: [f32; 4],
    /// Diffuse color, layer of the normal map.
    diffuse_layer: [f32; 4],
    /// Specular color, exponent.
    specular_exponent: [f32; 4],
    /// Array and layer of the color texture, alpha, cutoff.
    cut: [f32; 4],
}

pub(super) const MATERIAL_BYTES: usize = size_of::<PackedMaterial>();
const _: () = assert!(MATERIAL_BYTES == 64, "PackedMaterial differs from shaders/shared/material.glsl");

/// A scene's buffers, textures and programs on the device; freed when dropped.
#[derive(Debug)]
pub struct SceneBuffers {
    /// Names of the buffers that a deformer can write directly, instead of an upload.
    pub shared: SharedBuffers,
    /// Compute rasterizer that draws some passes instead of OpenGL; present when the look asks for it and one was
    /// given. Declared before the buffers that it has registered, so that it is dropped first.
    pub(super) beside: Option<Beside>,
    pub(super) scene: Arc<Scene>,
    pub(super) buffers: BTreeMap<String, Buffer>,
    pub(super) views: Views,
    pub(super) groups: Vec<Group>,
    /// Vertex array of opaque triangles.
    solids: VertexArray,
    /// Vertex array of cut-out and blended triangles; none without such triangles.
    corners: Option<VertexArray>,
    /// Vertex array without attributes, for triangles that a vertex shader generates.
    pub(super) nothing: VertexArray,
    pub(super) colours: Vec<Texture>,
    pub(super) normals: Vec<Texture>,
    pub(super) shadow: Option<ShadowMap>,
    pub(super) shared_shadow: Shared,
    pub(super) programs: Programs,
    pub(super) post: Post,
    /// Lists of culled triangles; present when triangles are culled.
    pub(super) culler: Option<Culler>,
    /// Programs for the number of samples per pixel that the look asks for.
    sampled: Sampled,
    options: Options,
    pub(super) stretches: Rc<[Stretch]>,
    /// Origin of the positions, in scene units from the scene's origin.
    pub(super) origin: [f64; 3],
    /// Rebased positions that are drawn instead of the shared ones.
    pub(super) apart: Option<Apart>,
    /// A scalar per vertex for AOV readbacks; allocated by the first upload.
    pub(super) values: Option<Values>,
    plan: Plan,
}

/// Positions rebased to one origin, for scenes whose domains have separate local origins.
#[derive(Debug)]
pub(super) struct Apart {
    pub(super) buffer: Buffer,
    view: Texture,
    solids: VertexArray,
    /// Vertex array of the culled lists, when triangles are culled.
    listed: Option<VertexArray>,
}

impl Apart {
    pub(super) fn new(gl: &Rc<Gl>, scene: &SceneBuffers) -> Result<Self> {
        let buffer = gl.buffer(scene.buffer("positions")?.bytes, gl::DYNAMIC_DRAW, None)?;
        let view = gl.view(&buffer, gl::RGB32F)?;
        let array = |index: &Buffer| gl.vertex_array(Some(index), &[attribute(0, &buffer, 3, false)]);
        let (solids, listed) = (array(scene.buffer("triangle vertices")?)?, scene.buffers.get(LISTED).map(array));
        Ok(Self { view, solids, listed: listed.transpose()?, buffer })
    }
}

/// A scalar per vertex, which the shader of an AOV readback interpolates.
#[derive(Debug)]
pub(super) struct Values {
    pub(super) buffer: Buffer,
    pub(super) view: Texture,
}

/// Buffer textures over the scene's buffers.
#[derive(Debug)]
pub(super) struct Views {
    positions: Texture,
    /// Texture unit and view.
    pub(super) others: Vec<(u32, Texture)>,
}

impl SceneBuffers {
    /// Allocates and fills the buffers that the scene's plan lists. `compile` returns programs, which scenes may share.
    pub(super) fn new(
        gl: &Rc<Gl>,
        scene: &Arc<Scene>,
        sample_places: &[[f32; 2]],
        compile: &mut Compile<'_>,
    ) -> Result<Self> {
        let plan = planned(scene, &gl.limits);
        let shadow = scene.look.shadow.map(|shadow| fitting(shadow, gl.limits.software));
        let images = [arrays(scene, Use::Colour), arrays(scene, Use::Normal)];
        within_budget(&images)?;
        let reads = OTHER_READS + images[0].len() + images[1].len();
        if reads > gl.limits.max_reads as usize {
            return Err(gl::too_large("textures read by the shading", gl.limits.max_reads.into(), reads as u64));
        }
        let geometry = Geometry::new(scene);
        let buffers = allocate(gl, &plan, &geometry, &pack(scene, &images))?;
        let (views, shared) = (Views::new(gl, scene, &buffers)?, shared(&buffers)?);
        let options = Options {
            defines: plan.defines.clone(),
            used: used(scene, &images),
            shadow: shadow.unwrap_or_default(),
            sample_places: sample_places.to_vec(),
            resolve: super::post::resolve(&scene.look),
            post_depth: gl.limits.post_depth,
        };
        let programs = Programs::compile(&options, &plan, &geometry.groups, compile)?;
        let samples = if sample_places.is_empty() { 1 } else { scene.look.samples_a_pixel() };
        let sampled = Sampled::compile(&options, &geometry.groups, samples, compile)?;
        let [colours, normals] = images;
        Ok(Self {
            shared,
            beside: None,
            scene: Arc::clone(scene),
            views,
            solids: solids(gl, &buffers, "triangle vertices")?,
            corners: corners(gl, &buffers, "triangles")?,
            culler: culler(gl, &buffers, &geometry.groups)?,
            buffers,
            groups: geometry.groups,
            nothing: gl.vertex_array(None, &[])?,
            colours: upload_arrays(gl, scene, &colours, Use::Colour)?,
            normals: upload_arrays(gl, scene, &normals, Use::Normal)?,
            shadow: shadow.map(|shadow| ShadowMap::new(gl, shadow)).transpose()?,
            shared_shadow: Shared::default(),
            programs,
            post: Post::compile(&scene.look, compile)?,
            sampled,
            options,
            stretches: geometry.stretches.into(),
            origin: [0.0; 3],
            apart: None,
            values: None,
            plan,
        })
    }

    pub(super) const fn options(&self) -> &Options {
        &self.options
    }

    /// The programs for this number of samples per pixel; compiled now unless the look asked for the same number.
    pub(super) fn sampled(&self, samples: u32, compile: &mut Compile<'_>) -> Result<Sampled> {
        match self.sampled.samples == samples {
            true => Ok(self.sampled.clone()),
            false => Sampled::compile(&self.options, &self.groups, samples, compile),
        }
    }

    /// The program that draws ids of cut-out triangles with this number of samples per pixel; none without such
    /// triangles.
    pub(super) fn cut_out(&self, samples: u32, compile: &mut Compile<'_>) -> Result<Option<Rc<Program>>> {
        if self.sampled.samples == samples {
            return Ok(self.sampled.mask.clone());
        }
        let any = self.groups.iter().any(|group| group.kind == Kind::Mask);
        if any { compile(self.options.visibility(Kind::Mask, samples)).map(Some) } else { Ok(None) }
    }

    /// The program that reads an AOV field from ids with this number of samples per pixel.
    pub(super) fn survey(&self, field: &'static str, samples: u32, compile: &mut Compile<'_>) -> Result<Rc<Program>> {
        compile(self.options.survey(field, samples))
    }

    /// First triangle and number of triangles of one kind; they are contiguous.
    pub(super) fn triangles(&self, kind: Kind) -> (usize, usize) {
        let mut of_kind = self.groups.iter().filter(|group| group.kind == kind);
        let first = of_kind.next().map_or((0, 0), |group| (group.first_triangle, group.triangles));
        of_kind.fold(first, |(first, count), group| (first, count + group.triangles))
    }

    /// Domain of a triangle that an id of a frame names (`place` is the id minus 1), and its index in the domain's
    /// mesh.
    pub fn triangle(&self, place: usize) -> Option<(usize, usize)> {
        if place < self.scene.layout.triangles { whose(&self.stretches, place) } else { None }
    }

    /// Sets the origin of the shared positions, in scene units from the scene's origin, and draws the shared positions
    /// from now on. Before the first call, positions are relative to the scene's origin.
    pub fn relative_to(&mut self, origin: [f64; 3]) {
        self.origin = origin;
        self.apart = None;
    }

    /// The positions that are drawn: the rebased ones if there are any, else the shared ones.
    pub(super) fn drawn_positions(&self) -> &Texture {
        self.apart.as_ref().map_or(&self.views.positions, |apart| &apart.view)
    }

    /// Vertex array of one kind of triangle, for ids and depth; none without such triangles.
    pub(super) fn array(&self, kind: Kind) -> Option<&VertexArray> {
        match kind {
            Kind::Opaque => Some(self.apart.as_ref().map_or(&self.solids, |apart| &apart.solids)),
            Kind::Mask | Kind::Blend => self.corners.as_ref(),
        }
    }

    /// Vertex array of the culled list of one kind, and the buffer with the indirect draw commands; none when triangles
    /// are not culled.
    pub(super) fn listed(&self, kind: Kind) -> Option<(&VertexArray, &Buffer)> {
        let (culler, ledger) = (self.culler.as_ref()?, self.buffers.get("cull ledger")?);
        let apart = self.apart.as_ref().and_then(|apart| apart.listed.as_ref()).filter(|_| kind == Kind::Opaque);
        apart.or_else(|| culler.array(kind)).map(|array| (array, ledger))
    }

    /// The plan that the buffers follow.
    pub const fn plan(&self) -> &Plan {
        &self.plan
    }

    /// The buffers that the device holds for this scene, by name.
    pub fn allocated(&self) -> Vec<Allocation> {
        let buffers = self.buffers.iter().map(|(name, buffer)| Allocation { name: name.clone(), bytes: buffer.bytes });
        let apart = self.apart.iter().map(|apart| Allocation { name: "apart".into(), bytes: apart.buffer.bytes });
        let values = self.values.iter().map(|own| Allocation { name: "values".into(), bytes: own.buffer.bytes });
        let beside = self.beside.iter().flat_map(Beside::allocated);
        let beside = beside.map(|(name, bytes)| Allocation { name: name.into(), bytes });
        buffers.chain(apart).chain(values).chain(beside).collect()
    }

    /// Number of textures that the device holds for this scene: texture arrays and shadow map textures.
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
    let one = |material: &modalcast_model::domain::Material| {
        let cutoff = match material.alpha_mode {
            AlphaMode::Mask { cutoff } => cutoff,
            AlphaMode::Blend => scene.look.opaque_alpha,
            AlphaMode::Opaque => 0.0,
        };
        let [colour_array, colour_layer] = at(&images[0], material.colour_texture);
        let [normal_array, normal_layer] = at(&images[1], material.normal_texture);
        PackedMaterial {
            ambient_array: wide(material.ambient, normal_array),
            diffuse_layer: wide(material.diffuse, normal_layer),
            specular_exponent: wide(material.specular, material.shininess),
            cut: [colour_array, colour_layer, material.alpha, cutoff],
        }
    };
    used_materials(scene).into_iter().map(|material| one(&scene.materials[material])).collect()
}

/// The properties of each material that the shader sources depend on.
fn used(scene: &Scene, images: &[Vec<Array>; 2]) -> Vec<Used> {
    let array = |arrays: &[Array], texture: Option<usize>| Some(place(arrays, texture?)?.0);
    let one = |material: usize| {
        let material = &scene.materials[material];
        let (colour, normal) = (array(&images[0], material.colour_texture), array(&images[1], material.normal_texture));
        Used { kind: kind(material), colour, normal }
    };
    used_materials(scene).into_iter().map(one).collect()
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
            "triangle vertices" => Some(bytemuck::cast_slice(&geometry.triangle_vertices)),
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

impl Views {
    fn new(gl: &Rc<Gl>, scene: &Scene, buffers: &BTreeMap<String, Buffer>) -> Result<Self> {
        let (limit, layout) = (gl.limits.max_texels, &scene.layout);
        for (field, count) in
            [("vertices", layout.vertices), ("corners", layout.corners), ("triangles", layout.triangles)]
        {
            if count as u64 > limit {
                return Err(gl::too_large(&format!("scene.{field}"), limit, count as u64));
            }
        }
        let read = [
            ("materials", shaders::MATERIAL_UNIT, gl::RGBA32F),
            ("triangle materials", shaders::TRIANGLE_MATERIAL_UNIT, gl::R32UI),
            ("normals", shaders::CORNER_NORMAL_UNIT, gl::RGB32F),
            ("triangles", shaders::TRIANGLE_UNIT, gl::RGB32UI),
            ("triangle vertices", shaders::TRIANGLE_VERTEX_UNIT, gl::RGB32UI),
            ("uvs", shaders::UV_UNIT, gl::RG32F),
            ("tangents", shaders::TANGENT_UNIT, gl::RGBA32F),
        ];
        let view = |(name, unit, format): (&str, u32, u32)| {
            buffers.get(name).map(|buffer| Ok((unit, gl.view(buffer, format)?)))
        };
        let others: Result<Vec<_>> = read.into_iter().filter_map(view).collect();
        Ok(Self { positions: gl.view(named(buffers, "positions")?, gl::RGB32F)?, others: others? })
    }
}

const fn attribute(location: u32, buffer: &Buffer, components: i32, integer: bool) -> Attribute<'_> {
    Attribute { location, buffer, components, integer }
}

/// Vertex array of opaque triangles, which need positions only.
fn solids(gl: &Rc<Gl>, buffers: &BTreeMap<String, Buffer>, index: &'static str) -> Result<VertexArray> {
    gl.vertex_array(Some(named(buffers, index)?), &[attribute(0, named(buffers, "positions")?, 3, false)])
}

/// Creates the culled lists if the plan has buffers for them.
fn culler(gl: &Rc<Gl>, buffers: &BTreeMap<String, Buffer>, groups: &[Group]) -> Result<Option<Culler>> {
    if !buffers.contains_key(LISTED) {
        return Ok(None);
    }
    Culler::new(gl, buffers, groups, (solids(gl, buffers, LISTED)?, corners(gl, buffers, LISTED)?))
}

/// Vertex array over the corners of cut-out and blended triangles; none without such triangles.
fn corners(gl: &Rc<Gl>, buffers: &BTreeMap<String, Buffer>, index: &'static str) -> Result<Option<VertexArray>> {
    let Some(vertices) = buffers.get("corner vertices") else { return Ok(None) };
    let mut from = vec![attribute(0, vertices, 1, true), attribute(1, named(buffers, "normals")?, 3, false)];
    from.extend(buffers.get("uvs").map(|buffer| attribute(2, buffer, 2, false)));
    from.extend(buffers.get("tangents").map(|buffer| attribute(3, buffer, 4, false)));
    gl.vertex_array(Some(named(buffers, index)?), &from).map(Some)
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
    // Few layers at a time: the mipmap chains of all layers of a large scene would take many times the memory of its
    // textures.
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
    // On a CPU, blending two mipmap levels costs a sixth of the frame time and is hardly visible.
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
