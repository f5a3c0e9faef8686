//! Device resources of one scene: buffers, texture arrays, shadow map and programs, as listed in its plan.

use std::cell::OnceCell;
use std::rc::Rc;
use std::sync::Arc;

use super::compute_rasterizer::{ComputeRasterizer, RasterOutputs, RasterPasses};
use super::cull::{CullResources, CullVertexArrays};
use super::programs::{PostPrograms, ProgramCompiler, SampleCountPrograms, ScenePrograms};
use super::raster_mesh;
use super::shadow_cache::{ShadowCache, ShadowKey};
use super::shadow_map::ShadowMap;
use super::shared_vertices::SceneVertices;
use crate::device::gl::{self, Buffer, Gl, Program, Texture, VertexArray, VertexAttribute};
use crate::layout::ambient::AmbientSampling;
use crate::layout::material::{PackedMaterial, pack_materials};
use crate::layout::{
    CORNER_NORMAL_UNIT, FIXED_TEXTURE_READS, MATERIAL_UNIT, TANGENT_UNIT, TRIANGLE_CORNER_UNIT, TRIANGLE_MATERIAL_UNIT,
    TRIANGLE_VERTEX_UNIT, UV_UNIT,
};
use crate::pieces::{OutputCosts, PieceRange};
use crate::plan::buffers::{BufferName, GeometryBuffers, MaterialBuffers, SceneBufferSet, UniformBuffers};
use crate::plan::features::ShaderFeatures;
use crate::plan::{Allocation, RenderPlan, ScenePlan};
use crate::scene_data::geometry::{
    BlendMode, DrawGroup, Geometry, TriangleSpan, blend_mode, groups, locate_triangle, used_materials,
};
use crate::scene_data::inner_edges::{has_inner_edges, pack_inner_edges};
use crate::scene_data::textures::{ArrayUse, TextureArray, TextureRole, arrays, check_texture_budget, find_layer};
use crate::shaders::{ImageFilter, MaterialUse, ProgramSource, ShaderOptions, ambient, post};
use crate::types::{BlurMethod, FrameParams};
use modalcast_model::error::Result;
use modalcast_model::memory::MemoryBudget;
use modalcast_model::raster::{GlVertexBuffers, RasterGeometry, Rasterizer};
use modalcast_model::scene::{Antialiasing, Culling, FrameAntialiasing, RenderSettings, RendererKind, Scene};
use modalcast_model::shared_memory::VertexImporter;

/// Programs are compiled in advance for frames of this size: the default size of a picture.
const TYPICAL_FRAME_SIZE: [u32; 2] = [1280, 720];

/// A scene's buffers, textures and programs on the device; freed when dropped.
#[derive(Debug)]
pub struct SceneBuffers {
    /// Compute rasterizer that draws some passes instead of OpenGL, if one was attached. It owns handles to the buffers
    /// that it has registered.
    pub(crate) compute_rasterizer: Option<ComputeRasterizer>,
    pub(crate) scene: Arc<Scene>,
    /// The scene's look, with the shadow map for this renderer.
    pub(crate) look: RenderSettings,
    renderer_kind: RendererKind,
    /// The deformed positions in it are called shared positions, because a deformer may write their buffer directly
    /// ([`Self::vertex_buffers`]).
    pub(crate) geometry: GeometryBuffers<Buffer>,
    /// Imports memory of a deformer, if the renderer shares memory with CUDA.
    pub(crate) vertex_importer: Option<Rc<SceneVertices>>,
    /// Keeps the buffers of the buffer textures alive.
    _materials: MaterialBuffers<Buffer>,
    pub(crate) uniforms: UniformBuffers<Buffer>,
    /// Lists of visible triangles; present with culling.
    pub(crate) cull_resources: Option<CullResources>,
    pub(crate) buffer_textures: BufferTextures,
    /// Triangles by blend mode and sidedness, in draw order.
    pub(crate) groups: Vec<DrawGroup>,
    /// Vertex array of opaque triangles.
    position_array: VertexArray,
    /// Vertex array of cut-out and blended triangles; none without such triangles.
    corner_array: Option<VertexArray>,
    /// Vertex array without attributes, for vertices that a shader generates.
    pub(crate) empty_vertex_array: VertexArray,
    pub(crate) color_arrays: Vec<Texture>,
    pub(crate) normal_arrays: Vec<Texture>,
    pub(crate) shadow: Option<ShadowMap>,
    pub(crate) shadow_cache: ShadowCache,
    pub(crate) programs: ScenePrograms,
    pub(crate) post: PostPrograms,
    /// Programs for the number of samples per pixel of a frame of [`TYPICAL_FRAME_SIZE`].
    sample_programs: SampleCountPrograms,
    /// Parameters of the shader sources, to compile further programs.
    options: ShaderOptions,
    /// Maps ranges of the draw order to the meshes of the domains.
    pub(crate) spans: Rc<[TriangleSpan]>,
    /// Origin of the positions that are drawn, in scene units from the scene's origin.
    pub(crate) origin: [f64; 3],
    /// Rebased positions that are drawn instead of the shared ones.
    pub(crate) rebased: Option<RebasedPositions>,
    /// A scalar per vertex for AOV readbacks; allocated by the first upload.
    pub(crate) values: Option<VertexValues>,
    /// Marks of the edges inside of polygons; allocated by the first frame with lines along mesh edges.
    pub(crate) inner_edges: OnceCell<Buffer>,
    /// Device times of recent outputs. Frames in flight record theirs.
    pub(crate) costs: Rc<OutputCosts>,
    plan: RenderPlan,
    /// Names and sizes of the plan's buffers as they were allocated, sorted by name.
    plan_allocations: Vec<Allocation>,
}

/// Positions rebased to one origin, for scenes in which each domain has a local origin.
#[derive(Debug)]
pub(crate) struct RebasedPositions {
    pub(crate) buffer: Buffer,
    view: Texture,
    position_array: VertexArray,
    /// Vertex array of the visible triangles; present with culling.
    culled_position_array: Option<VertexArray>,
}

impl RebasedPositions {
    pub(crate) fn new(gl: &Rc<Gl>, scene_buffers: &SceneBuffers) -> Result<Self> {
        let buffer = gl.buffer(scene_buffers.geometry.positions.bytes, gl::DYNAMIC_DRAW, None)?;
        let view = gl.buffer_texture(&buffer, gl::RGB32F)?;
        let position_array = self::position_array(gl, &buffer, &scene_buffers.geometry.triangle_vertices)?;
        let culled_indices =
            scene_buffers.cull_resources.as_ref().map(|cull_resources| &cull_resources.buffers.indices);
        let culled_position_array =
            culled_indices.map(|indices| self::position_array(gl, &buffer, indices)).transpose()?;
        Ok(Self { view, position_array, culled_position_array, buffer })
    }
}

/// A scalar per vertex, which an AOV shader interpolates.
#[derive(Debug)]
pub(crate) struct VertexValues {
    pub(crate) buffer: Buffer,
    pub(crate) view: Texture,
}

/// Buffer textures over the scene's buffers.
#[derive(Debug)]
pub(crate) struct BufferTextures {
    positions: Texture,
    /// Views of the other buffers, each with its texture unit.
    pub(crate) unit_views: Vec<(u32, Texture)>,
}

/// Passes the sources of all programs of a scene to `collect`. `placeholder` stands for each program.
///
/// # Errors
/// `Invalid` if the scene exceeds a limit of the device.
pub(crate) fn collect_program_sources(
    gl: &Gl,
    scene: &Scene,
    sample_positions: &[[f32; 2]],
    blur_method: BlurMethod,
    placeholder: &Rc<Program>,
) -> Result<Vec<ProgramSource>> {
    let features = ScenePlan::new(scene, &gl.limits, blur_method).features;
    let texture_arrays = [arrays(scene, TextureRole::Color), arrays(scene, TextureRole::Normal)];
    check_texture_limits(gl, scene, &texture_arrays)?;
    let options = shader_options(gl, scene, features, &texture_arrays, sample_positions);
    let (groups, _) = groups(scene);
    let mut sources = Vec::new();
    let collect = &mut |source| {
        sources.push(source);
        Ok(Rc::clone(placeholder))
    };
    ScenePrograms::compile(&options, &groups, collect)?;
    let antialiasing = antialiasing(scene, gl.limits.renderer_kind(), TYPICAL_FRAME_SIZE, None);
    PostPrograms::compile(&scene.look, antialiasing.method, collect)?;
    let (samples, has_edges) = (supported_samples(antialiasing, sample_positions), scene.look.edges.is_some());
    SampleCountPrograms::compile(&options, &groups, samples, has_edges, collect)?;
    Ok(sources)
}

fn shader_options(
    gl: &Gl,
    scene: &Scene,
    features: ShaderFeatures,
    texture_arrays: &[Vec<TextureArray>; 2],
    sample_positions: &[[f32; 2]],
) -> ShaderOptions {
    ShaderOptions {
        features,
        used_materials: material_uses(scene, texture_arrays),
        inner_edges: has_inner_edges(scene),
        image_filter: ImageFilter { anisotropy: gl.limits.anisotropy, blends_levels: !gl.limits.software },
        sample_positions: sample_positions.to_vec(),
        sample_resolve: post::sample_resolve(&scene.look),
        ambient_light: ambient::ambient_light(scene.look.studio_light(scene.up)),
        post_depth_coverage: gl.limits.post_depth_coverage,
    }
}

/// The antialiasing of a frame. `samples`: samples per pixel that the frame sets for itself.
pub(crate) fn antialiasing(
    scene: &Scene,
    renderer_kind: RendererKind,
    [width, height]: [u32; 2],
    samples: Option<u32>,
) -> FrameAntialiasing {
    let pixels = u64::from(width) * u64::from(height);
    scene.look.frame_antialiasing(renderer_kind, scene.layout.triangles, pixels, samples)
}

/// Samples per pixel. A device without 4x multisampling has no sample positions, and one sample per pixel.
fn supported_samples(antialiasing: FrameAntialiasing, sample_positions: &[[f32; 2]]) -> u32 {
    if sample_positions.is_empty() { 1 } else { antialiasing.samples }
}

impl SceneBuffers {
    /// Creates the resources that the scene's plan lists. `textures`: the texture arrays of colors and of normals.
    /// `compile` may return programs that other scenes share.
    pub(crate) fn new(
        gl: &Rc<Gl>,
        scene: &Arc<Scene>,
        sample_positions: &[[f32; 2]],
        blur_method: BlurMethod,
        textures: [Vec<Texture>; 2],
        compile: &mut ProgramCompiler<'_>,
    ) -> Result<Self> {
        let ScenePlan { buffers: sizes, features, report: plan } = ScenePlan::new(scene, &gl.limits, blur_method);
        let texture_arrays = [arrays(scene, TextureRole::Color), arrays(scene, TextureRole::Normal)];
        check_texture_limits(gl, scene, &texture_arrays)?;
        let mesh = Geometry::new(scene);
        let buffers = allocate(gl, &sizes, &mesh, &pack_materials(scene, &texture_arrays))?;
        let allocation =
            |(name, buffer): (BufferName, &Buffer)| Allocation { name: name.to_string(), bytes: buffer.bytes };
        let mut plan_allocations: Vec<Allocation> = buffers.named().map(allocation).collect();
        plan_allocations.sort_by(|a, b| a.name.cmp(&b.name));
        let SceneBufferSet { geometry, materials, uniforms, culling } = buffers;
        let options = shader_options(gl, scene, features, &texture_arrays, sample_positions);
        let renderer_kind = gl.limits.renderer_kind();
        let look = scene.look.with_shadow_map_for(renderer_kind);
        let antialiasing = antialiasing(scene, renderer_kind, TYPICAL_FRAME_SIZE, None);
        let samples = supported_samples(antialiasing, sample_positions);
        let cull_resources = match culling {
            Some(culling) => {
                let arrays = CullVertexArrays {
                    position_array: position_array(gl, &geometry.positions, &culling.indices)?,
                    corner_array: corner_array(gl, &geometry, &culling.indices)?,
                };
                Some(CullResources::new(gl, culling, &mesh.groups, arrays)?)
            }
            None => None,
        };
        let [color_arrays, normal_arrays] = textures;
        Ok(Self {
            compute_rasterizer: None,
            scene: Arc::clone(scene),
            look,
            renderer_kind,
            buffer_textures: BufferTextures::new(gl, &geometry, &materials)?,
            position_array: position_array(gl, &geometry.positions, &geometry.triangle_vertices)?,
            corner_array: corner_array(gl, &geometry, &geometry.triangles)?,
            cull_resources,
            geometry,
            vertex_importer: None,
            _materials: materials,
            uniforms,
            empty_vertex_array: gl.vertex_array(None, &[])?,
            color_arrays,
            normal_arrays,
            shadow: features.shadow.map(|shadow| ShadowMap::new(gl, shadow, features.blur_method)).transpose()?,
            shadow_cache: ShadowCache::default(),
            programs: ScenePrograms::compile(&options, &mesh.groups, compile)?,
            post: PostPrograms::compile(&look, antialiasing.method, compile)?,
            sample_programs: {
                let has_edges = scene.look.edges.is_some();
                SampleCountPrograms::compile(&options, &mesh.groups, samples, has_edges, compile)?
            },
            options,
            groups: mesh.groups,
            spans: mesh.spans.into(),
            origin: [0.0; 3],
            rebased: None,
            values: None,
            inner_edges: OnceCell::new(),
            costs: Rc::default(),
            plan,
            plan_allocations,
        })
    }

    /// The antialiasing of a frame of this size in pixels. The device may support fewer samples. `samples`: samples per
    /// pixel that the frame sets for itself.
    pub(crate) fn antialiasing(&self, size: [u32; 2], samples: Option<u32>) -> FrameAntialiasing {
        antialiasing(&self.scene, self.renderer_kind, size, samples)
    }

    /// Whether the programs of a frame with this antialiasing are those of most frames.
    pub(crate) fn has_frame_programs(&self, antialiasing: FrameAntialiasing, has_edges: bool) -> bool {
        let FrameAntialiasing { method, samples } = antialiasing;
        let has_shade = self.sample_programs.has_edges == has_edges || self.sample_programs.shade.is_none();
        self.sample_programs.samples == samples && self.post.antialias == method && has_shade
    }

    /// Program that encodes frames with this antialiasing; compiled here if most frames use another one.
    pub(crate) fn encode_program(
        &self,
        antialias: Antialiasing,
        compile: &mut ProgramCompiler<'_>,
    ) -> Result<Rc<Program>> {
        match self.post.antialias == antialias {
            true => Ok(Rc::clone(&self.post.encode)),
            false => compile(post::encode(&self.look, antialias)),
        }
    }

    /// Programs for this number of samples per pixel, with or without lines along mesh edges. Programs that differ from
    /// those of most frames are compiled.
    pub(crate) fn sample_programs(
        &self,
        samples: u32,
        has_edges: bool,
        compile: &mut ProgramCompiler<'_>,
    ) -> Result<SampleCountPrograms> {
        if self.sample_programs.samples != samples {
            return SampleCountPrograms::compile(&self.options, &self.groups, samples, has_edges, compile);
        }
        let mut programs = self.sample_programs.clone();
        if programs.has_edges != has_edges && programs.shade.is_some() {
            programs.shade = Some(compile(self.options.shade(samples, has_edges))?);
        }
        Ok(SampleCountPrograms { has_edges, ..programs })
    }

    /// Allocates the marks of inner edges, which frames with lines along mesh edges read. Does nothing if they exist
    /// already, or if the scene has no inner edges.
    pub(crate) fn ensure_inner_edges(&self, gl: &Rc<Gl>) -> Result<()> {
        if !self.options.inner_edges || self.inner_edges.get().is_some() {
            return Ok(());
        }
        let words = pack_inner_edges(&self.scene, &self.spans);
        let bytes: &[u8] = bytemuck::cast_slice(&words);
        let buffer = gl.buffer(bytes.len() as u64, gl::STATIC_DRAW, Some(bytes))?;
        // The cell was empty above.
        self.inner_edges.set(buffer).ok();
        Ok(())
    }

    /// Program that draws ids of cut-out triangles with this number of samples per pixel; none without such triangles.
    pub(crate) fn mask_program(&self, samples: u32, compile: &mut ProgramCompiler<'_>) -> Result<Option<Rc<Program>>> {
        if self.sample_programs.samples == samples {
            return Ok(self.sample_programs.mask.clone());
        }
        let has_mask = self.groups.iter().any(|group| group.blend_mode == BlendMode::Mask);
        if has_mask { compile(self.options.visibility(BlendMode::Mask, samples)).map(Some) } else { Ok(None) }
    }

    /// Program that computes an AOV field from ids with this number of samples per pixel.
    pub(crate) fn aov_program(
        &self,
        field: &'static str,
        samples: u32,
        compile: &mut ProgramCompiler<'_>,
    ) -> Result<Rc<Program>> {
        compile(self.options.aov(field, samples))
    }

    /// The triangles with this blend mode, which are contiguous.
    pub(crate) fn triangle_range(&self, blend_mode: BlendMode) -> PieceRange {
        let mut groups = self.groups.iter().filter(|group| group.blend_mode == blend_mode);
        let first_triangle = groups.clone().next().map_or(0, |group| group.first_triangle);
        PieceRange::new(first_triangle, groups.by_ref().map(|group| group.triangle_count).sum())
    }

    /// All triangles of the scene.
    pub(crate) fn all_triangles(&self) -> PieceRange {
        PieceRange::new(0, self.scene.layout.triangles)
    }

    /// Domain of a triangle, and its index in the mesh of the domain. `triangle` is an index in the draw order: an id
    /// minus 1.
    pub fn source_triangle(&self, triangle: usize) -> Option<(usize, usize)> {
        if triangle < self.scene.layout.triangles { locate_triangle(&self.spans, triangle) } else { None }
    }

    /// Sets the origin of the shared positions, in scene units from the scene's origin. Later frames draw the shared
    /// positions instead of rebased ones. Before the first call, positions are relative to the scene's origin.
    pub fn set_shared_origin(&mut self, origin: [f64; 3]) {
        self.origin = origin;
        self.rebased = None;
    }

    /// Positions to draw: the rebased ones if present, else the shared ones.
    pub(crate) fn position_texture(&self) -> &Texture {
        self.rebased.as_ref().map_or(&self.buffer_textures.positions, |rebased| &rebased.view)
    }

    /// Vertex array of all triangles with this blend mode; none without such triangles.
    pub(crate) fn vertex_array(&self, blend_mode: BlendMode) -> Option<&VertexArray> {
        match blend_mode {
            BlendMode::Opaque => {
                Some(self.rebased.as_ref().map_or(&self.position_array, |rebased| &rebased.position_array))
            }
            BlendMode::Mask | BlendMode::Blend => self.corner_array.as_ref(),
        }
    }

    /// Vertex array of the visible triangles with this blend mode, and the buffer with the indirect draw commands; none
    /// without culling.
    pub(crate) fn visible_draws(&self, blend_mode: BlendMode) -> Option<(&VertexArray, &Buffer)> {
        let cull_resources = self.cull_resources.as_ref()?;
        let rebased_array = self
            .rebased
            .as_ref()
            .and_then(|rebased| rebased.culled_position_array.as_ref())
            .filter(|_| blend_mode == BlendMode::Opaque);
        rebased_array
            .or_else(|| cull_resources.vertex_array(blend_mode))
            .map(|array| (array, &cull_resources.buffers.draws))
    }

    /// Attaches a compute rasterizer, which draws those of `passes` that it supports. `budget` limits the memory of its
    /// output. Does nothing for a scene without such passes.
    ///
    /// # Errors
    /// Errors of `create_rasterizer` and [`Rasterizer::precompile`], and `Fault` of OpenGL. OpenGL then draws all
    /// passes.
    pub(crate) fn attach_rasterizer(
        &mut self,
        gl: &Rc<Gl>,
        budget: &Arc<MemoryBudget>,
        compile: &mut ProgramCompiler<'_>,
        passes: RasterPasses,
        create_rasterizer: impl FnOnce(RasterGeometry) -> Result<Box<dyn Rasterizer>>,
    ) -> Result<()> {
        let supported = RasterPasses::supported(&self.scene).intersection(passes);
        if !supported.has_any() {
            return Ok(());
        }
        let outputs = RasterOutputs::new(supported, &self.options, compile)?;
        let passes = outputs.passes();
        let positions = self.geometry.positions.shared();
        let mut rasterizer =
            create_rasterizer(raster_mesh::raster_geometry(&self.scene, positions, gl.limits.anisotropy))?;
        rasterizer.precompile(passes.shadow, passes.visibility)?;
        if let Some(map) = self.shadow.as_mut().filter(|_| passes.shadow) {
            map.add_depth_copy(gl, budget)?;
        }
        self.compute_rasterizer = Some(ComputeRasterizer::new(rasterizer, outputs, budget));
        Ok(())
    }

    /// The compute rasterizer and the passes that it draws; none if OpenGL draws all passes. OpenGL draws all passes of
    /// rebased scenes, because the compute rasterizer has registered only the shared positions.
    pub(crate) fn active_rasterizer(&self) -> Option<(&ComputeRasterizer, RasterPasses)> {
        let compute_rasterizer = self.compute_rasterizer.as_ref().filter(|_| self.rebased.is_none())?;
        let enabled = compute_rasterizer.enabled();
        enabled.has_any().then_some((compute_rasterizer, enabled))
    }

    /// Whether a compute rasterizer is attached. It may draw no passes.
    pub const fn has_compute_rasterizer(&self) -> bool {
        self.compute_rasterizer.is_some()
    }

    /// The compute rasterizer if it draws the depth of the shadow map.
    pub(crate) fn shadow_rasterizer(&self) -> Option<&ComputeRasterizer> {
        self.active_rasterizer().filter(|(_, enabled)| enabled.shadow).map(|(compute_rasterizer, _)| compute_rasterizer)
    }

    /// The compute rasterizer if it draws the visibility.
    pub(crate) fn visibility_rasterizer(&self) -> Option<&ComputeRasterizer> {
        let active = self.active_rasterizer().filter(|(_, enabled)| enabled.visibility);
        active.map(|(compute_rasterizer, _)| compute_rasterizer)
    }

    /// Sets the step whose vertices the buffers contain. Frames with the same step, bounds and origin share one shadow
    /// map, unless the map is split into cascades, which follow the camera. Code that writes the buffers directly must
    /// set another step afterwards. An upload clears the step; then every frame draws its shadow map.
    pub fn set_step(&self, step: u64) {
        self.shadow_cache.set_step(step);
    }

    /// Key of the shadow map for this frame; none if other frames cannot share the map.
    pub(crate) fn shadow_key(&self, params: &FrameParams) -> Option<ShadowKey> {
        let cascades = self.scene.look.shadow.map_or(1, |shadow| shadow.cascades);
        self.shadow_cache.key(params, self.origin).filter(|_| cascades == 1)
    }

    /// Culling method; never `Auto`.
    pub(crate) const fn culling(&self) -> Culling {
        self.options.features.culling
    }

    /// The sampling of the ambient occlusion; none without it.
    pub(crate) const fn ambient_sampling(&self) -> Option<AmbientSampling> {
        self.options.features.ambient_occlusion
    }

    /// Plan from which the buffers were created.
    pub const fn plan(&self) -> &RenderPlan {
        &self.plan
    }

    /// Names and sizes of all buffers of this scene on the device.
    pub fn allocations(&self) -> Vec<Allocation> {
        let rebased = self
            .rebased
            .iter()
            .map(|rebased| Allocation { name: "rebased positions".into(), bytes: rebased.buffer.bytes });
        let values =
            self.values.iter().map(|values| Allocation { name: "vertex values".into(), bytes: values.buffer.bytes });
        let outputs = self.compute_rasterizer.iter().flat_map(ComputeRasterizer::allocations);
        let depth_copy = self.shadow.as_ref().and_then(ShadowMap::depth_copy_bytes);
        let outputs = outputs.chain(depth_copy.map(|bytes| ("shadow depth, copied", bytes)));
        let outputs = outputs.map(|(name, bytes)| Allocation { name: name.into(), bytes });
        let inner_edges = self.inner_edges.get();
        let inner_edges = inner_edges.map(|buffer| Allocation { name: "inner edges".into(), bytes: buffer.bytes });
        self.plan_allocations.iter().cloned().chain(inner_edges).chain(rebased).chain(values).chain(outputs).collect()
    }

    /// Handles to the vertex buffers, which a deformer can write directly. The handles keep the buffers alive.
    pub fn vertex_buffers(&self) -> GlVertexBuffers {
        GlVertexBuffers {
            positions: self.geometry.positions.shared(),
            normals: self.geometry.normals.shared(),
            tangents: self.geometry.tangents.as_ref().map(Buffer::shared),
            importer: self.vertex_importer.clone().map(|importer| importer as Rc<dyn VertexImporter>),
        }
    }

    /// Lets a deformer write vertices into memory of its own, which OpenGL imports. `copy_words` copies the vertices to
    /// the vertex buffers.
    pub(crate) fn enable_vertex_import(&mut self, gl: &Rc<Gl>, copy_words: Rc<Program>) {
        let GeometryBuffers { positions, normals, tangents, .. } = &self.geometry;
        let destinations = [positions, normals].into_iter().chain(tangents).map(Buffer::alias).collect();
        self.vertex_importer = Some(Rc::new(SceneVertices::new(gl, copy_words, destinations)));
    }

    /// Number of textures that the device holds for this scene: texture arrays and shadow map textures.
    pub fn texture_count(&self) -> usize {
        self.color_arrays.len() + self.normal_arrays.len() + self.shadow.as_ref().map_or(0, ShadowMap::texture_count)
    }
}

/// Properties of the used materials that the shader sources depend on.
fn material_uses(scene: &Scene, texture_arrays: &[Vec<TextureArray>; 2]) -> Vec<MaterialUse> {
    let array_of = |arrays: &[TextureArray], texture: Option<usize>| {
        let (index, _) = find_layer(arrays, texture?)?;
        Some(ArrayUse { index, is_mixed: arrays[index].is_mixed })
    };
    let material_use = |material: usize| {
        let material = &scene.materials[material];
        MaterialUse {
            blend_mode: blend_mode(material),
            color_array: array_of(&texture_arrays[0], material.color_texture),
            normal_array: array_of(&texture_arrays[1], material.normal_texture),
        }
    };
    used_materials(scene).into_iter().map(material_use).collect()
}

/// Checks the number and size of the texture arrays against the limits of the device.
fn check_texture_limits(gl: &Gl, scene: &Scene, texture_arrays: &[Vec<TextureArray>; 2]) -> Result<()> {
    check_texture_budget(texture_arrays)?;
    let (reads, max_reads) =
        (FIXED_TEXTURE_READS + texture_arrays[0].len() + texture_arrays[1].len(), gl.limits.max_compute_textures);
    if reads > max_reads as usize {
        return Err(gl::too_large("textures read by the shading", max_reads.into(), reads as u64));
    }
    let layout = &scene.layout;
    for (field, count) in [("vertices", layout.vertices), ("corners", layout.corners), ("triangles", layout.triangles)]
    {
        if count as u64 > gl.limits.max_texels {
            return Err(gl::too_large(&format!("scene.{field}"), gl.limits.max_texels, count as u64));
        }
    }
    Ok(())
}

/// Allocates all buffers of the scene, and fills those whose content does not change.
fn allocate(
    gl: &Rc<Gl>,
    sizes: &SceneBufferSet<u64>,
    mesh: &Geometry,
    materials: &[PackedMaterial],
) -> Result<SceneBufferSet<Buffer>> {
    sizes.try_map(|name, bytes| {
        let content: Option<&[u8]> = match name {
            BufferName::CornerVertices => Some(bytemuck::cast_slice(&mesh.corner_vertices)),
            BufferName::Triangles => Some(bytemuck::cast_slice(&mesh.triangle_corners)),
            BufferName::TriangleVertices => Some(bytemuck::cast_slice(&mesh.triangle_vertices)),
            BufferName::Uvs => Some(bytemuck::cast_slice(&mesh.uvs)),
            BufferName::TriangleMaterials => Some(bytemuck::cast_slice(&mesh.triangle_materials)),
            BufferName::Materials => Some(bytemuck::cast_slice(materials)),
            _ => None,
        };
        gl.buffer(*bytes, if content.is_some() { gl::STATIC_DRAW } else { gl::DYNAMIC_DRAW }, content)
    })
}

impl BufferTextures {
    fn new(gl: &Rc<Gl>, geometry: &GeometryBuffers<Buffer>, materials: &MaterialBuffers<Buffer>) -> Result<Self> {
        let views = [
            (MATERIAL_UNIT, gl::RGBA32F, Some(&materials.materials)),
            (TRIANGLE_MATERIAL_UNIT, gl::R32UI, materials.triangle_materials.as_ref()),
            (CORNER_NORMAL_UNIT, gl::RGB32F, Some(&geometry.normals)),
            (TRIANGLE_CORNER_UNIT, gl::RGB32UI, Some(&geometry.triangles)),
            (TRIANGLE_VERTEX_UNIT, gl::RGB32UI, Some(&geometry.triangle_vertices)),
            (UV_UNIT, gl::RG32F, geometry.uvs.as_ref()),
            (TANGENT_UNIT, gl::RGBA32F, geometry.tangents.as_ref()),
        ];
        let mut unit_views = Vec::new();
        for (unit, format, buffer) in views {
            if let Some(buffer) = buffer {
                unit_views.push((unit, gl.buffer_texture(buffer, format)?));
            }
        }
        Ok(Self { positions: gl.buffer_texture(&geometry.positions, gl::RGB32F)?, unit_views })
    }
}

/// A vertex attribute of `components` f32.
const fn f32_attribute(location: u32, buffer: &Buffer, components: i32) -> VertexAttribute<'_> {
    VertexAttribute { location, buffer, components, integer: false }
}

/// Vertex array of opaque triangles, which need positions only.
fn position_array(gl: &Rc<Gl>, positions: &Buffer, indices: &Buffer) -> Result<VertexArray> {
    gl.vertex_array(Some(indices), &[f32_attribute(0, positions, 3)])
}

/// Vertex array over the corners of cut-out and blended triangles; none without such triangles. The locations are those
/// in `shaders/visibility.vert` and `shaders/blended.vert`.
fn corner_array(gl: &Rc<Gl>, geometry: &GeometryBuffers<Buffer>, indices: &Buffer) -> Result<Option<VertexArray>> {
    let Some(vertices) = &geometry.corner_vertices else { return Ok(None) };
    let vertex_index = VertexAttribute { location: 0, buffer: vertices, components: 1, integer: true };
    let mut attributes = vec![vertex_index, f32_attribute(1, &geometry.normals, 3)];
    attributes.extend(geometry.uvs.as_ref().map(|buffer| f32_attribute(2, buffer, 2)));
    attributes.extend(geometry.tangents.as_ref().map(|buffer| f32_attribute(3, buffer, 4)));
    gl.vertex_array(Some(indices), &attributes).map(Some)
}
