//! Plan of the device resources of a scene: buffers, textures, passes and shader defines. It is derived once from the
//! scene's [`modalcast_model::scene::SceneFeatures`]. It also lists the features that the scene does not need, and what
//! each of these omissions saves.
//!
//! The renderer allocates and compiles exactly the resources of the plan. Planning needs no device.

pub(crate) mod buffers;
pub(crate) mod culling;
pub(crate) mod features;
pub(crate) mod shadow_map;

use self::buffers::{CullBuffers, GeometryBuffers, MaterialBuffers, SceneBufferSet, UniformBuffers};
use self::culling::{cull_buffer_sizes, cull_passes, select_culling};
use self::features::ShaderFeatures;
use self::shadow_map::shadow_textures;
use crate::device::gl::Limits;
use crate::layout::ambient::AmbientSampling;
use crate::layout::material::MATERIAL_BYTES;
use crate::pass::Pass;
use crate::scene_data::geometry::{BlendMode, DrawGroup, blend_mode, groups, used_materials, uses_material_table};
use crate::scene_data::textures::{TextureRole, arrays};
use crate::types::BlurMethod;
use crate::uniforms::cascades::ShadowCascades;
use crate::uniforms::frame::FrameUniforms;
use modalcast_model::scene::{
    Antialiasing, Culling, Lighting, LookPreset, RenderSettings, RendererKind, Scene, ShadowSettings, ToneMapping,
    Transparency,
};

/// A buffer or texture and its size.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize)]
pub struct Allocation {
    pub name: String,
    pub bytes: u64,
}

/// A feature that the scene does not need, and the savings from leaving it out.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize)]
pub struct OmittedFeature {
    /// Name of the feature.
    pub feature: &'static str,
    /// Device memory that is not allocated.
    pub bytes: u64,
    /// Passes that do not run.
    pub passes: Vec<Pass>,
    /// Description of the shader work that is saved.
    pub shaders: &'static str,
}

/// All device resources and passes of a scene.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize)]
pub struct RenderPlan {
    /// Buffers of the scene, by name.
    pub buffers: Vec<Allocation>,
    /// Textures of the scene, by name.
    pub textures: Vec<Allocation>,
    /// Passes of a frame, in execution order, without the passes of the compute rasterizer, `UniformUpload`,
    /// `RecordVisible` and `Read`.
    pub passes: Vec<Pass>,
    /// Draw calls of the occluder, visibility and blend passes, independent of the number of domains and materials. At
    /// most 4 + 4 + 2 x 3 = 14: four opaque and cut-out groups, once as occluders and once for the visibility, and two
    /// blended groups in three phases.
    pub draw_calls: usize,
    /// Defines that the shaders are compiled with.
    pub defines: Vec<&'static str>,
    /// Features that the scene does not need.
    pub omitted: Vec<OmittedFeature>,
}

impl RenderPlan {
    /// Whether the shaders are compiled with a define.
    pub fn has_define(&self, name: &str) -> bool {
        self.defines.contains(&name)
    }

    /// Bytes of all buffers and textures.
    pub fn bytes(&self) -> u64 {
        self.buffers.iter().chain(&self.textures).map(|allocation| allocation.bytes).sum()
    }
}

/// The plan of a scene for one device, with typed buffers and features.
#[derive(Debug)]
pub(crate) struct ScenePlan {
    /// Sizes in bytes.
    pub(crate) buffers: SceneBufferSet<u64>,
    pub(crate) features: ShaderFeatures,
    /// The same plan with names, for reports.
    pub(crate) report: RenderPlan,
}

/// Plans a scene for a GPU without size limits.
pub fn plan(scene: &Scene) -> RenderPlan {
    let limits = Limits { max_storage_bytes: u64::MAX, ..Limits::default() };
    ScenePlan::new(scene, &limits, BlurMethod::Auto).report
}

impl ScenePlan {
    /// Plans a scene for a device with these limits.
    pub(crate) fn new(scene: &Scene, limits: &Limits, blur_method: BlurMethod) -> Self {
        let (groups, _) = groups(scene);
        let culling = select_culling(scene, limits);
        let shadow = scene.look.with_shadow_map_for(limits.renderer_kind()).shadow;
        let features = features(scene, shadow, limits, blur_method, culling);
        let buffers = buffer_sizes(scene, culling);
        let allocations = buffers.named().map(|(name, bytes)| Allocation { name: name.to_string(), bytes: *bytes });
        let report = RenderPlan {
            buffers: allocations.collect(),
            textures: textures(scene, &features),
            passes: passes(scene, &groups, &features),
            draw_calls: draw_calls(scene, &groups) + occluder_draw_calls(&groups, culling),
            defines: features.defines(),
            omitted: omitted_features(scene, culling),
        };
        Self { buffers, features, report }
    }
}

/// The passes of a frame, in execution order.
fn passes(scene: &Scene, groups: &[DrawGroup], features: &ShaderFeatures) -> Vec<Pass> {
    let has_blend_mode = |blend_mode: BlendMode| groups.iter().any(|group| group.blend_mode == blend_mode);
    let mut passes = Vec::new();
    if let Some(shadow) = features.shadow {
        passes.extend(features.has_culling().then_some(Pass::ShadowCull));
        passes.push(Pass::Shadow);
        passes.extend(shadow.has_moments().then_some(Pass::Blur));
    }
    let has_visibility = has_blend_mode(BlendMode::Opaque) || has_blend_mode(BlendMode::Mask) || features.opaque_parts;
    passes.extend(cull_passes(features.culling));
    passes.extend(has_visibility.then_some(Pass::Visibility));
    passes.extend(features.ambient_occlusion.map(|_| Pass::AmbientOcclusion));
    passes.extend(if features.blend_layers { blend_passes(scene) } else { &[] });
    passes.push(Pass::Background);
    passes.extend(has_visibility.then_some(Pass::Shade));
    passes.extend(scene.look.bloom.map(|_| Pass::Bloom));
    passes.push(Pass::Encode);
    passes
}

/// The passes of blended triangles.
const fn blend_passes(scene: &Scene) -> &'static [Pass] {
    match scene.look.transparency {
        Transparency::TwoPass => &[Pass::Blended],
        Transparency::OrderIndependent => &[Pass::OitCount, Pass::OitAllocate, Pass::OitFill, Pass::OitResolve],
    }
}

/// Whether two-pass transparency may draw parts of blended triangles as opaque: the alpha of some material reaches
/// `look.opaque_alpha`.
fn has_opaque_parts(scene: &Scene) -> bool {
    let (look, materials) = (scene.look, used_materials(scene));
    let is_opaque_enough = |material: usize| {
        let material = &scene.materials[material];
        blend_mode(material) == BlendMode::Blend && material.alpha >= look.opaque_alpha
    };
    look.transparency == Transparency::TwoPass && materials.into_iter().any(is_opaque_enough)
}

/// Number of draw calls of the occluder pass, which draws opaque and cut-out groups.
fn occluder_draw_calls(groups: &[DrawGroup], culling: Culling) -> usize {
    let occluder_groups = groups.iter().filter(|group| group.blend_mode != BlendMode::Blend).count();
    if culling == Culling::Occlusion { occluder_groups } else { 0 }
}

/// Number of draw calls without the occluder pass. Order-independent transparency draws blended triangles once
/// each in `OitCount`, `OitFill` and `OitResolve`; the last is skipped in frames without overflow. Two-pass transparency
/// draws their opaque parts too.
fn draw_calls(scene: &Scene, groups: &[DrawGroup]) -> usize {
    let blended_groups = groups.iter().filter(|group| group.blend_mode == BlendMode::Blend).count();
    let phases = match scene.look.transparency {
        Transparency::OrderIndependent => 3,
        Transparency::TwoPass => 1 + usize::from(has_opaque_parts(scene)),
    };
    groups.len() + (phases - 1) * blended_groups
}

/// Sizes of the scene's buffers in bytes. [`GeometryBuffers`] states how many f32 and u32 of 4 bytes a
/// vertex, a corner and a triangle have.
fn buffer_sizes(scene: &Scene, culling: Culling) -> SceneBufferSet<u64> {
    let (layout, features) = (&scene.layout, scene.features);
    let [vertices, corners, triangles] = [layout.vertices, layout.corners, layout.triangles].map(|count| count as u64);
    let cascades = scene.look.shadow.filter(|shadow| shadow.cascades > 1);
    SceneBufferSet {
        geometry: GeometryBuffers {
            positions: 12 * vertices,
            normals: 12 * corners,
            tangents: features.normal_maps.then_some(16 * corners),
            uvs: (features.textures || features.normal_maps).then_some(8 * corners),
            triangles: 12 * triangles,
            triangle_vertices: 12 * triangles,
            corner_vertices: (features.mask || features.blend).then_some(4 * corners),
        },
        materials: MaterialBuffers {
            materials: (MATERIAL_BYTES * used_materials(scene).len()) as u64,
            triangle_materials: uses_material_table(scene).then_some(4 * triangles),
        },
        uniforms: UniformBuffers {
            frame: size_of::<FrameUniforms>() as u64,
            cascades: cascades.map(|_| size_of::<ShadowCascades>() as u64),
        },
        culling: cull_buffer_sizes(scene, culling),
    }
}

/// The texture arrays of the materials, and the textures of the shadow map.
fn textures(scene: &Scene, features: &ShaderFeatures) -> Vec<Allocation> {
    let mut textures = Vec::new();
    for (role, label) in [(TextureRole::Color, "colors"), (TextureRole::Normal, "normals")] {
        for array in arrays(scene, role) {
            let name = format!("{label} {} x {} x {}", array.width, array.height, array.layers.len());
            textures.push(Allocation { name, bytes: array.bytes() });
        }
    }
    if let Some(shadow) = &features.shadow {
        textures.extend(shadow_allocations(shadow, features.blur_method));
    }
    textures
}

fn shadow_allocations(shadow: &ShadowSettings, blur_method: BlurMethod) -> impl Iterator<Item = Allocation> {
    let texels = u64::from(shadow.size) * u64::from(shadow.size);
    shadow_textures(shadow, blur_method).into_iter().map(move |texture| Allocation {
        name: texture.name.into(),
        bytes: u64::from(texture.texel_bytes * texture.layers) * texels,
    })
}

fn features(
    scene: &Scene,
    shadow: Option<ShadowSettings>,
    limits: &Limits,
    blur_method: BlurMethod,
    culling: Culling,
) -> ShaderFeatures {
    let (features, look) = (scene.features, &scene.look);
    ShaderFeatures {
        textures: features.textures,
        normal_maps: features.normal_maps,
        material_table: uses_material_table(scene),
        ground: look.ground.is_some(),
        blend_layers: features.blend,
        oit: features.blend && look.transparency == Transparency::OrderIndependent,
        opaque_parts: has_opaque_parts(scene),
        shadow,
        ambient_occlusion: look.ambient_occlusion.map(|_| AmbientSampling::of(ambient_sampling_kind(look, limits))),
        blur_method: blur_method.resolve(limits.software),
        culling,
    }
}

/// The kind of renderer whose sampling of the ambient occlusion is used: that of a GPU unless a preset or the rule
/// chooses the settings of a CPU.
fn ambient_sampling_kind(look: &RenderSettings, limits: &Limits) -> RendererKind {
    match look.preset.map(|request| request.preset) {
        Some(Some(LookPreset::Preview)) => RendererKind::Software,
        Some(None) => limits.renderer_kind(),
        Some(Some(LookPreset::Standard | LookPreset::Best)) | None => RendererKind::Hardware,
    }
}

/// The features that the scene does not need. The texts "8 bytes per sample" and "10.7 bytes per pixel" refer to
/// RGBA16F images with 8 bytes per texel; all levels of the bloom pyramid together have 4/3 texels per pixel.
fn omitted_features(scene: &Scene, culling: Culling) -> Vec<OmittedFeature> {
    let (features, layout, look) = (scene.features, &scene.layout, &scene.look);
    let shadow_bytes: u64 =
        shadow_allocations(&look.shadow.unwrap_or_default(), BlurMethod::Auto).map(|allocation| allocation.bytes).sum();
    let corner_bytes = |bytes_per_corner: usize| (bytes_per_corner * layout.corners) as u64;
    let uv_bytes = if features.textures || features.normal_maps { 0 } else { corner_bytes(8) };
    let omit_unless = |is_needed: bool, feature, bytes, passes: &[Pass], shaders| {
        (!is_needed).then(|| OmittedFeature { feature, bytes, passes: passes.to_vec(), shaders })
    };
    let omitted = [
        omit_unless(
            features.normal_maps,
            "normal maps",
            corner_bytes(16),
            &[],
            "no tangent frame, no normal map lookup",
        ),
        omit_unless(features.textures, "textures", uv_bytes, &[], "no color texture lookup"),
        omit_unless(features.mask, "mask", 0, &[], "no discard, no sample mask; depth needs no fragment shader"),
        omit_unless(
            features.blend,
            "blend",
            0,
            blend_passes(scene),
            "no layers in the shading, 8 bytes per sample less",
        ),
        omit_unless(features.shadows, "shadows", shadow_bytes, &[Pass::Shadow, Pass::Blur], "no shadow lookup"),
        omit_unless(
            uses_material_table(scene),
            "many materials",
            4 * layout.triangles as u64,
            &[],
            "no lookup per triangle",
        ),
        omit_unless(look.ground.is_some(), "ground", 0, &[], "no ground in the shading"),
        omit_unless(look.lighting == Lighting::Studio, "studio", 0, &[], "ambient light of one color, no fill light"),
        omit_unless(
            look.ambient_occlusion.is_some(),
            "ambient occlusion",
            0,
            &[Pass::AmbientOcclusion],
            "no lookup of the ambient visibility, up to 24 bytes per pixel less",
        ),
        omit_unless(
            look.bloom.is_some(),
            "bloom",
            0,
            &[Pass::Bloom],
            "no image of bright light, 10.7 bytes per pixel less",
        ),
        omit_unless(look.tone != ToneMapping::None, "tone curve", 0, &[], "no tone mapping of light"),
        omit_unless(look.antialias == Antialiasing::Fxaa, "fxaa", 0, &[], "no search for edges in the image"),
        omit_unless(
            culling != Culling::None,
            "culling",
            cull_buffer_sizes(scene, Culling::Triangles)
                .iter()
                .flat_map(CullBuffers::named)
                .map(|(_, bytes)| *bytes)
                .sum(),
            cull_passes(Culling::Triangles),
            "no triangle id lookup in fragments",
        ),
        omit_unless(look.edges.is_some(), "mesh edges", 0, &[], "no distance to the edges of a triangle"),
        omit_unless(look.dither, "dither", 0, &[], "no dither pattern"),
    ];
    omitted.into_iter().flatten().collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene_data::geometry::tests::squares;
    use modalcast_model::domain::{AlphaMode, Material, Texture};
    use modalcast_model::scene::PresetRequest;
    use modalcast_model::scene::{AmbientOcclusion, Bloom, MeshEdges};

    fn names(allocations: &[Allocation]) -> Vec<&str> {
        allocations.iter().map(|allocation| allocation.name.as_str()).collect()
    }

    fn pass_names(plan: &RenderPlan) -> Vec<&str> {
        plan.passes.iter().map(|pass| pass.name()).collect()
    }

    /// Parts of a scene that needs every feature.
    fn full_featured_parts() -> modalcast_model::scene::SceneParts {
        let materials = vec![
            Material { color_texture: Some(0), normal_texture: Some(0), ..Material::default() },
            Material { alpha_mode: AlphaMode::Mask { cutoff: 0.5 }, ..Material::default() },
            Material { alpha_mode: AlphaMode::Blend, ..Material::default() },
        ];
        let mut parts = squares(materials);
        parts.textures.push(Texture::new("one", 1, 1, vec![255; 4]).expect("a valid texture"));
        let look =
            RenderSettings { bloom: Some(Bloom::default()), tone: ToneMapping::Aces, dither: true, ..parts.look };
        let look = RenderSettings { edges: Some(MeshEdges::default()), ..look };
        let look = RenderSettings { antialias: Antialiasing::Fxaa, culling: Culling::Occlusion, ..look };
        let ambient_occlusion = Some(AmbientOcclusion::default());
        parts.look = RenderSettings { lighting: Lighting::Studio, ambient_occlusion, ..look };
        parts
    }

    #[test]
    fn plan_of_a_plain_scene_omits_every_feature() {
        let mut parts = squares(vec![Material::default()]);
        parts.look.shadow = None;
        parts.look.ground = None;
        let scene = Scene::new(parts).expect("a valid scene");
        let plan = plan(&scene);
        assert_eq!(pass_names(&plan), ["visibility", "background", "shade", "encode"]);
        let expected = ["positions", "normals", "triangles", "triangle vertices", "materials", "frame uniforms"];
        assert_eq!(names(&plan.buffers), expected);
        assert!(plan.textures.is_empty() && plan.defines.is_empty());
        let omitted: Vec<&str> = plan.omitted.iter().map(|omitted| omitted.feature).collect();
        let scene_features = ["normal maps", "textures", "mask", "blend", "shadows", "many materials", "ground"];
        assert_eq!(
            omitted,
            [
                &scene_features[..],
                &["studio", "ambient occlusion", "bloom", "tone curve", "fxaa", "culling", "mesh edges", "dither"]
            ]
            .concat()
        );
        assert_eq!(plan.omitted[0].bytes, 16 * 4, "expected the tangents of four corners");
        assert_eq!(
            plan.omitted[4].bytes,
            12 * 1024 * 1024,
            "expected 4 bytes of depth and 8 bytes of moments for each of 1024 x 1024 texels"
        );
    }

    #[test]
    fn plan_of_a_blended_scene_has_visibility_only_for_opaque_parts() {
        let plan_blended = |transparency, alpha| {
            let mut parts = squares(vec![Material { alpha_mode: AlphaMode::Blend, alpha, ..Material::default() }]);
            (parts.look.shadow, parts.look.transparency) = (None, transparency);
            plan(&Scene::new(parts).expect("a valid scene"))
        };
        let two_pass = plan_blended(Transparency::TwoPass, 0.5);
        assert_eq!(pass_names(&two_pass), ["blended", "background", "encode"]);
        assert_eq!((two_pass.draw_calls, two_pass.defines), (1, vec!["HAS_GROUND", "BLEND_LAYERS"]));
        assert_eq!(two_pass.buffers.last().map(|buffer| buffer.name.as_str()), Some("corner vertices"));
        let oit = plan_blended(Transparency::OrderIndependent, 1.0);
        assert_eq!(pass_names(&oit), ["oit count", "oit allocate", "oit fill", "oit resolve", "background", "encode"]);
        assert_eq!((oit.draw_calls, oit.defines), (3, vec!["HAS_GROUND", "BLEND_LAYERS", "OIT"]));
        let with_opaque_parts = plan_blended(Transparency::TwoPass, 1.0);
        assert_eq!(
            pass_names(&with_opaque_parts),
            ["visibility", "blended", "background", "shade", "encode"],
            "expected visibility and shade passes for opaque parts"
        );
        assert_eq!(
            (with_opaque_parts.draw_calls, with_opaque_parts.defines),
            (2, vec!["HAS_GROUND", "BLEND_LAYERS", "OPAQUE_PARTS"])
        );
    }

    #[test]
    fn ambient_occlusion_has_the_sampling_of_the_preset_or_of_the_renderer() {
        let sampling = |preset: Option<Option<LookPreset>>, software: bool| {
            let request = preset.map(|preset| PresetRequest { preset, ..PresetRequest::default() });
            let look = RenderSettings { preset: request, ..Lighting::Studio.settings() };
            let mut parts = squares(vec![Material::default()]);
            parts.look = look;
            let limits = Limits { software, max_storage_bytes: u64::MAX, ..Limits::default() };
            let plan = ScenePlan::new(&Scene::new(parts).expect("a valid scene"), &limits, BlurMethod::Auto);
            plan.features.ambient_occlusion.expect("ambient occlusion")
        };
        let [hardware, software] = [RendererKind::Hardware, RendererKind::Software].map(AmbientSampling::of);
        assert_ne!(hardware, software);
        for (preset, on_gpu, on_cpu) in [
            (None, hardware, hardware),
            (Some(None), hardware, software),
            (Some(Some(LookPreset::Preview)), software, software),
            (Some(Some(LookPreset::Standard)), hardware, hardware),
            (Some(Some(LookPreset::Best)), hardware, hardware),
        ] {
            assert_eq!([sampling(preset, false), sampling(preset, true)], [on_gpu, on_cpu], "{preset:?}");
        }
    }

    #[test]
    fn plan_of_a_full_featured_scene_omits_nothing() {
        let mut parts = full_featured_parts();
        parts.look.transparency = Transparency::TwoPass;
        let plan = plan(&Scene::new(parts).expect("a valid scene"));
        assert_eq!(
            pass_names(&plan),
            [
                &["shadow cull", "shadow", "blur", "occluders", "cull", "visibility"][..],
                &["ambient occlusion", "blended", "background", "shade", "bloom", "encode"]
            ]
            .concat()
        );
        assert!(plan.omitted.is_empty(), "{:?}", plan.omitted);
        assert!(names(&plan.buffers).contains(&"tangents") && names(&plan.buffers).contains(&"uvs"));
        assert_eq!(plan.textures[0], Allocation { name: "colors 1 x 1 x 1".into(), bytes: 4 });
    }
}
