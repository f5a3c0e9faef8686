//! Device resources of one scene: buffers, texture arrays, shadow map and programs, exactly as its plan says.

use std::collections::BTreeMap;
use std::rc::Rc;
use std::sync::Arc;

use bytemuck::{Pod, Zeroable};
use rayon::prelude::*;

use super::cull::{TriangleCuller, VISIBLE_INDICES};
use super::geometry::{BlendMode, DrawGroup, Geometry, TriangleSpan, blend_mode, locate_triangle, used_materials};
use super::plan::{Allocation, RenderPlan, plan_for_device};
use super::post::PostProcess;
use super::programs::{ProgramCompiler, SampleCountPrograms, ScenePrograms};
use super::raster_backends::ComputeRasterizer;
use super::shaders::{self, FIXED_TEXTURE_READS, MaterialUse, ShaderOptions};
use super::shadow::{ShadowCache, ShadowMap};
use super::textures::{TextureArray, TextureRole, arrays, check_texture_budget, cutoff, find_layer, mip_levels};
use super::types::BlurMethod;
use crate::device::gl::{self, Buffer, Gl, Program, Texture, TextureDesc, VertexArray, VertexAttribute};
use modalcast_model::domain::AlphaMode;
use modalcast_model::error::{Result, fault_in};
use modalcast_model::raster::GlVertexBuffers;
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

pub(crate) const MATERIAL_BYTES: usize = size_of::<PackedMaterial>();
const _: () = assert!(MATERIAL_BYTES == 64, "PackedMaterial differs from shaders/shared/material.glsl");

/// A scene's buffers, textures and programs on the device; freed when dropped.
#[derive(Debug)]
pub struct SceneBuffers {
    /// Compute rasterizer that draws some passes instead of OpenGL; present when the look asks for it and one was
    /// given. It keeps the buffers alive that it has registered.
    pub(crate) compute_rasterizer: Option<ComputeRasterizer>,
    pub(crate) scene: Arc<Scene>,
    pub(crate) buffers: BTreeMap<String, Buffer>,
    pub(crate) buffer_textures: BufferTextures,
    pub(crate) groups: Vec<DrawGroup>,
    /// Vertex array of opaque triangles.
    position_array: VertexArray,
    /// Vertex array of cut-out and blended triangles; none without such triangles.
    corners: Option<VertexArray>,
    /// Vertex array without attributes, for triangles that a vertex shader generates.
    pub(crate) empty_vertex_array: VertexArray,
    pub(crate) color_arrays: Vec<Texture>,
    pub(crate) normals: Vec<Texture>,
    pub(crate) shadow: Option<ShadowMap>,
    pub(crate) shadow_cache: ShadowCache,
    pub(crate) programs: ScenePrograms,
    pub(crate) post: PostProcess,
    /// Lists of culled triangles; present when triangles are culled.
    pub(crate) culler: Option<TriangleCuller>,
    /// Programs for the number of samples per pixel that the look asks for.
    sample_programs: SampleCountPrograms,
    options: ShaderOptions,
    pub(crate) spans: Rc<[TriangleSpan]>,
    /// Origin of the positions, in scene units from the scene's origin.
    pub(crate) origin: [f64; 3],
    /// Rebased positions that are drawn instead of the shared ones.
    pub(crate) rebased: Option<RebasedPositions>,
    /// A scalar per vertex for AOV readbacks; allocated by the first upload.
    pub(crate) values: Option<VertexValues>,
    plan: RenderPlan,
}

/// Positions rebased to one origin, for scenes whose domains have separate local origins.
#[derive(Debug)]
pub(crate) struct RebasedPositions {
    pub(crate) buffer: Buffer,
    view: Texture,
    position_array: VertexArray,
    /// Vertex array of the culled lists, when triangles are culled.
    listed: Option<VertexArray>,
}

impl RebasedPositions {
    pub(crate) fn new(gl: &Rc<Gl>, scene: &SceneBuffers) -> Result<Self> {
        let buffer = gl.buffer(scene.buffer("positions")?.bytes, gl::DYNAMIC_DRAW, None)?;
        let view = gl.buffer_texture(&buffer, gl::RGB32F)?;
        let array = |index: &Buffer| gl.vertex_array(Some(index), &[attribute(0, &buffer, 3, false)]);
        let (position_array, listed) =
            (array(scene.buffer("triangle vertices")?)?, scene.buffers.get(VISIBLE_INDICES).map(array));
        Ok(Self { view, position_array, listed: listed.transpose()?, buffer })
    }
}

/// A scalar per vertex, which the shader of an AOV readback interpolates.
#[derive(Debug)]
pub(crate) struct VertexValues {
    pub(crate) buffer: Buffer,
    pub(crate) view: Texture,
}

/// Buffer textures over the scene's buffers.
#[derive(Debug)]
pub(crate) struct BufferTextures {
    positions: Texture,
    /// Texture unit and view.
    pub(crate) others: Vec<(u32, Texture)>,
}

impl SceneBuffers {
    /// Allocates and fills the buffers that the scene's plan lists. `compile` returns programs, which scenes may share.
    pub(crate) fn new(
        gl: &Rc<Gl>,
        scene: &Arc<Scene>,
        sample_positions: &[[f32; 2]],
        blur_method: BlurMethod,
        compile: &mut ProgramCompiler<'_>,
    ) -> Result<Self> {
        let plan = plan_for_device(scene, &gl.limits, blur_method);
        let (shadow, blur_method) = (scene.look.shadow, blur_method.resolve(gl.limits.software));
        let images = [arrays(scene, TextureRole::Color), arrays(scene, TextureRole::Normal)];
        check_texture_budget(&images)?;
        let reads = FIXED_TEXTURE_READS + images[0].len() + images[1].len();
        if reads > gl.limits.max_compute_textures as usize {
            return Err(gl::too_large(
                "textures read by the shading",
                gl.limits.max_compute_textures.into(),
                reads as u64,
            ));
        }
        let geometry = Geometry::new(scene);
        let buffers = allocate(gl, &plan, &geometry, &pack_materials(scene, &images))?;
        let buffer_textures = BufferTextures::new(gl, scene, &buffers)?;
        let options = ShaderOptions {
            defines: plan.defines.clone(),
            used: used(scene, &images),
            shadow: shadow.unwrap_or_default(),
            blur_method,
            sample_positions: sample_positions.to_vec(),
            sample_resolve: super::post::sample_resolve(&scene.look),
            post_depth_coverage: gl.limits.post_depth_coverage,
        };
        let programs = ScenePrograms::compile(&options, &plan, &geometry.groups, compile)?;
        let samples = if sample_positions.is_empty() { 1 } else { scene.look.samples_per_pixel() };
        let sample_programs = SampleCountPrograms::compile(&options, &geometry.groups, samples, compile)?;
        let [color_arrays, normals] = images;
        Ok(Self {
            compute_rasterizer: None,
            scene: Arc::clone(scene),
            buffer_textures,
            position_array: position_array(gl, &buffers, "triangle vertices")?,
            corners: corners(gl, &buffers, "triangles")?,
            culler: culler(gl, &buffers, &geometry.groups)?,
            buffers,
            groups: geometry.groups,
            empty_vertex_array: gl.vertex_array(None, &[])?,
            color_arrays: upload_arrays(gl, scene, &color_arrays, TextureRole::Color)?,
            normals: upload_arrays(gl, scene, &normals, TextureRole::Normal)?,
            shadow: shadow.map(|shadow| ShadowMap::new(gl, shadow, blur_method)).transpose()?,
            shadow_cache: ShadowCache::default(),
            programs,
            post: PostProcess::compile(&scene.look, compile)?,
            sample_programs,
            options,
            spans: geometry.spans.into(),
            origin: [0.0; 3],
            rebased: None,
            values: None,
            plan,
        })
    }

    pub(crate) const fn options(&self) -> &ShaderOptions {
        &self.options
    }

    /// The programs for this number of samples per pixel; compiled now unless the look asked for the same number.
    pub(crate) fn sample_programs(
        &self,
        samples: u32,
        compile: &mut ProgramCompiler<'_>,
    ) -> Result<SampleCountPrograms> {
        match self.sample_programs.samples == samples {
            true => Ok(self.sample_programs.clone()),
            false => SampleCountPrograms::compile(&self.options, &self.groups, samples, compile),
        }
    }

    /// The program that draws ids of cut-out triangles with this number of samples per pixel; none without such
    /// triangles.
    pub(crate) fn mask_program(&self, samples: u32, compile: &mut ProgramCompiler<'_>) -> Result<Option<Rc<Program>>> {
        if self.sample_programs.samples == samples {
            return Ok(self.sample_programs.mask.clone());
        }
        let any = self.groups.iter().any(|group| group.blend_mode == BlendMode::Mask);
        if any { compile(self.options.visibility(BlendMode::Mask, samples)).map(Some) } else { Ok(None) }
    }

    /// The program that reads an AOV field from ids with this number of samples per pixel.
    pub(crate) fn aov_program(
        &self,
        field: &'static str,
        samples: u32,
        compile: &mut ProgramCompiler<'_>,
    ) -> Result<Rc<Program>> {
        compile(self.options.aov(field, samples))
    }

    /// First triangle and number of triangles of one kind; they are contiguous.
    pub(crate) fn triangles(&self, blend_mode: BlendMode) -> (usize, usize) {
        let mut of_kind = self.groups.iter().filter(|group| group.blend_mode == blend_mode);
        let first = of_kind.next().map_or((0, 0), |group| (group.first_triangle, group.triangles));
        of_kind.fold(first, |(first, count), group| (first, count + group.triangles))
    }

    /// Domain of a triangle that an id of a frame names (`place` is the id minus 1), and its index in the domain's
    /// mesh.
    pub fn source_triangle(&self, place: usize) -> Option<(usize, usize)> {
        if place < self.scene.layout.triangles { locate_triangle(&self.spans, place) } else { None }
    }

    /// Sets the origin of the shared positions, in scene units from the scene's origin, and draws the shared positions
    /// from now on. Before the first call, positions are relative to the scene's origin.
    pub fn set_origin(&mut self, origin: [f64; 3]) {
        self.origin = origin;
        self.rebased = None;
    }

    /// The positions that are drawn: the rebased ones if there are any, else the shared ones.
    pub(crate) fn position_texture(&self) -> &Texture {
        self.rebased.as_ref().map_or(&self.buffer_textures.positions, |rebased| &rebased.view)
    }

    /// Vertex array of one kind of triangle, for ids and depth; none without such triangles.
    pub(crate) fn vertex_array(&self, blend_mode: BlendMode) -> Option<&VertexArray> {
        match blend_mode {
            BlendMode::Opaque => {
                Some(self.rebased.as_ref().map_or(&self.position_array, |rebased| &rebased.position_array))
            }
            BlendMode::Mask | BlendMode::Blend => self.corners.as_ref(),
        }
    }

    /// Vertex array of the culled list of one kind, and the buffer with the indirect draw commands; none when triangles
    /// are not culled.
    pub(crate) fn visible_draws(&self, blend_mode: BlendMode) -> Option<(&VertexArray, &Buffer)> {
        let (culler, ledger) = (self.culler.as_ref()?, self.buffers.get("cull draws")?);
        let rebased = self
            .rebased
            .as_ref()
            .and_then(|rebased| rebased.listed.as_ref())
            .filter(|_| blend_mode == BlendMode::Opaque);
        rebased.or_else(|| culler.vertex_array(blend_mode)).map(|array| (array, ledger))
    }

    /// The plan that the buffers follow.
    pub const fn plan(&self) -> &RenderPlan {
        &self.plan
    }

    /// The buffers that the device holds for this scene, by name.
    pub fn allocations(&self) -> Vec<Allocation> {
        let buffers = self.buffers.iter().map(|(name, buffer)| Allocation { name: name.clone(), bytes: buffer.bytes });
        let rebased = self
            .rebased
            .iter()
            .map(|rebased| Allocation { name: "rebased positions".into(), bytes: rebased.buffer.bytes });
        let values = self.values.iter().map(|own| Allocation { name: "vertex values".into(), bytes: own.buffer.bytes });
        let compute_rasterizer = self.compute_rasterizer.iter().flat_map(ComputeRasterizer::allocations);
        let compute_rasterizer = compute_rasterizer.map(|(name, bytes)| Allocation { name: name.into(), bytes });
        buffers.chain(rebased).chain(values).chain(compute_rasterizer).collect()
    }

    /// The buffers that a deformer can write directly, instead of an upload. The handles keep them alive.
    ///
    /// # Errors
    /// `Fault` when the scene has no vertices.
    pub fn vertex_buffers(&self) -> Result<GlVertexBuffers> {
        Ok(GlVertexBuffers {
            positions: self.buffer("positions")?.shared(),
            normals: self.buffer("normals")?.shared(),
            tangents: self.buffers.get("tangents").map(Buffer::shared),
        })
    }

    /// Number of textures that the device holds for this scene: texture arrays and shadow map textures.
    pub fn texture_count(&self) -> usize {
        self.color_arrays.len() + self.normals.len() + self.shadow.as_ref().map_or(0, ShadowMap::texture_count)
    }

    pub(crate) fn buffer(&self, name: &'static str) -> Result<&Buffer> {
        find_buffer(&self.buffers, name)
    }
}

fn find_buffer<'a>(buffers: &'a BTreeMap<String, Buffer>, name: &'static str) -> Result<&'a Buffer> {
    buffers.get(name).ok_or_else(|| fault_in("render")(format!("the plan has no buffer '{name}'")))
}

fn pack_materials(scene: &Scene, images: &[Vec<TextureArray>; 2]) -> Vec<PackedMaterial> {
    let wide = |[r, g, b]: [f32; 3], fourth: f32| [r, g, b, fourth];
    let at = |arrays: &[TextureArray], texture: Option<usize>| {
        let place = texture.and_then(|texture| find_layer(arrays, texture));
        place.map_or([-1.0; 2], |(array, layer)| [array as f32, layer as f32])
    };
    let one = |material: &modalcast_model::domain::Material| {
        let cutoff = match material.alpha_mode {
            AlphaMode::Mask { cutoff } => cutoff,
            AlphaMode::Blend => scene.look.opaque_alpha,
            AlphaMode::Opaque => 0.0,
        };
        let [color_array, color_layer] = at(&images[0], material.color_texture);
        let [normal_array, normal_layer] = at(&images[1], material.normal_texture);
        PackedMaterial {
            ambient_array: wide(material.ambient, normal_array),
            diffuse_layer: wide(material.diffuse, normal_layer),
            specular_exponent: wide(material.specular, material.shininess),
            cut: [color_array, color_layer, material.alpha, cutoff],
        }
    };
    used_materials(scene).into_iter().map(|material| one(&scene.materials[material])).collect()
}

/// The properties of each material that the shader sources depend on.
fn used(scene: &Scene, images: &[Vec<TextureArray>; 2]) -> Vec<MaterialUse> {
    let array = |arrays: &[TextureArray], texture: Option<usize>| Some(find_layer(arrays, texture?)?.0);
    let one = |material: usize| {
        let material = &scene.materials[material];
        let (color, normal) = (array(&images[0], material.color_texture), array(&images[1], material.normal_texture));
        MaterialUse { blend_mode: blend_mode(material), color, normal }
    };
    used_materials(scene).into_iter().map(one).collect()
}

fn allocate(
    gl: &Rc<Gl>,
    plan: &RenderPlan,
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

impl BufferTextures {
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
            buffers.get(name).map(|buffer| Ok((unit, gl.buffer_texture(buffer, format)?)))
        };
        let others: Result<Vec<_>> = read.into_iter().filter_map(view).collect();
        Ok(Self { positions: gl.buffer_texture(find_buffer(buffers, "positions")?, gl::RGB32F)?, others: others? })
    }
}

const fn attribute(location: u32, buffer: &Buffer, components: i32, integer: bool) -> VertexAttribute<'_> {
    VertexAttribute { location, buffer, components, integer }
}

/// Vertex array of opaque triangles, which need positions only.
fn position_array(gl: &Rc<Gl>, buffers: &BTreeMap<String, Buffer>, index: &'static str) -> Result<VertexArray> {
    gl.vertex_array(Some(find_buffer(buffers, index)?), &[attribute(0, find_buffer(buffers, "positions")?, 3, false)])
}

/// Creates the culled lists if the plan has buffers for them.
fn culler(gl: &Rc<Gl>, buffers: &BTreeMap<String, Buffer>, groups: &[DrawGroup]) -> Result<Option<TriangleCuller>> {
    if !buffers.contains_key(VISIBLE_INDICES) {
        return Ok(None);
    }
    TriangleCuller::new(
        gl,
        buffers,
        groups,
        (position_array(gl, buffers, VISIBLE_INDICES)?, corners(gl, buffers, VISIBLE_INDICES)?),
    )
}

/// Vertex array over the corners of cut-out and blended triangles; none without such triangles.
fn corners(gl: &Rc<Gl>, buffers: &BTreeMap<String, Buffer>, index: &'static str) -> Result<Option<VertexArray>> {
    let Some(vertices) = buffers.get("corner vertices") else { return Ok(None) };
    let mut from = vec![attribute(0, vertices, 1, true), attribute(1, find_buffer(buffers, "normals")?, 3, false)];
    from.extend(buffers.get("uvs").map(|buffer| attribute(2, buffer, 2, false)));
    from.extend(buffers.get("tangents").map(|buffer| attribute(3, buffer, 4, false)));
    gl.vertex_array(Some(find_buffer(buffers, index)?), &from).map(Some)
}

fn upload_arrays(gl: &Rc<Gl>, scene: &Scene, arrays: &[TextureArray], purpose: TextureRole) -> Result<Vec<Texture>> {
    arrays.iter().map(|array| upload_array(gl, scene, array, purpose)).collect()
}

fn upload_array(gl: &Rc<Gl>, scene: &Scene, array: &TextureArray, purpose: TextureRole) -> Result<Texture> {
    let layers = array.layers.len() as u32;
    if layers > gl.limits.max_layers {
        let field = format!("textures of {} x {}", array.width, array.height);
        return Err(gl::too_large(&field, u64::from(gl.limits.max_layers), u64::from(layers)));
    }
    let texture = gl.texture(TextureDesc {
        target: gl::TEXTURE_2D_ARRAY,
        format: if purpose == TextureRole::Color { gl::SRGB8_ALPHA8 } else { gl::RGBA8 },
        width: array.width,
        height: array.height,
        depth: layers,
        levels: array.levels(),
    })?;
    // Few layers at a time: the mipmap chains of all layers of a large scene would take many times the memory of its
    // textures.
    for (chunk, part) in array.layers.chunks(8).enumerate() {
        let chain = |layer: &usize| {
            let cutoff = if purpose == TextureRole::Color { cutoff(scene, *layer) } else { None };
            mip_levels(&scene.textures[*layer], array, purpose, cutoff)
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
    texture.set_sampling(&sampling, gl.limits.anisotropy);
    Ok(texture)
}
