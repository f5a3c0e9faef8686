//! Plan of the device resources of a scene, derived once from its [`modalcast_model::scene::SceneFeatures`]: buffers, textures,
//! passes and shader branches. It also lists the features that were left out, and what each saves compared with a scene
//! that uses every feature.
//!
//! The renderer allocates and compiles exactly what the plan lists. Planning is pure and needs no device.

use super::cull::{self, allocations, select_culling};
use super::geometry::{BlendMode, DrawGroup, blend_mode, groups, used_materials, uses_material_table};
use super::textures::{TextureRole, arrays};
use super::types::BlurMethod;
use crate::device::gl::Limits;
use modalcast_model::scene::{Antialiasing, Culling, Scene, ShadowSettings, ToneMapping, Transparency};

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
    pub passes: Vec<&'static str>,
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
    /// Passes of a frame, in execution order. The ground pass runs only when the camera is above the ground and
    /// something lies below it.
    pub passes: Vec<&'static str>,
    /// Draw calls of the occluders, visibility and blended passes, fourteen at most; independent of the number of
    /// domains and materials.
    pub draw_calls: usize,
    /// Defines that the shaders are compiled with.
    pub defines: Vec<&'static str>,
    pub omitted: Vec<OmittedFeature>,
}

impl RenderPlan {
    /// Whether the shaders are compiled with a define.
    pub fn defines(&self, name: &str) -> bool {
        self.defines.contains(&name)
    }

    /// Bytes of all buffers and textures.
    pub fn bytes(&self) -> u64 {
        self.buffers.iter().chain(&self.textures).map(|allocation| allocation.bytes).sum()
    }
}

/// Plans a scene for a GPU without limits.
pub fn plan(scene: &Scene) -> RenderPlan {
    plan_for_device(scene, &Limits { max_storage_bytes: u64::MAX, ..Limits::default() }, BlurMethod::Auto)
}

/// Plans a scene for a device, which may be a software rasterizer.
pub(crate) fn plan_for_device(scene: &Scene, limits: &Limits, blur_method: BlurMethod) -> RenderPlan {
    let (groups, _) = groups(scene);
    let has = |blend_mode: BlendMode| groups.iter().any(|group| group.blend_mode == blend_mode);
    let mut passes = Vec::new();
    let culling = select_culling(scene, limits);
    if let Some(shadow) = scene.look.shadow {
        passes.extend((culling != Culling::None).then_some(cull::SHADOW_CULL));
        passes.push("shadow");
        passes.extend(shadow.has_moments().then_some("blur"));
    }
    let seen = has(BlendMode::Opaque) || has(BlendMode::Mask) || opaque_parts(scene);
    passes.extend(cull::passes(culling));
    if seen {
        passes.push("visibility");
    }
    passes.extend(scene.look.ground.map(|_| "ground"));
    if scene.needs.blend {
        passes.extend(blended(scene));
    }
    passes.push("background");
    if seen {
        passes.push("shade");
    }
    passes.extend(scene.look.bloom.map(|_| "bloom"));
    passes.push("encode");
    RenderPlan {
        buffers: [buffers(scene), allocations(scene, culling)].concat(),
        textures: textures(scene, blur_method.resolve(limits.software)),
        passes,
        draw_calls: draw_calls(scene, &groups) + occluder_draw_calls(&groups, culling),
        defines: [defines(scene), cull_defines(culling)].concat(),
        omitted: omitted(scene, culling),
    }
}

/// The passes of blended triangles.
fn blended(scene: &Scene) -> Vec<&'static str> {
    match scene.look.transparency {
        Transparency::TwoPass => vec!["blended"],
        Transparency::OrderIndependent => super::oit::PASSES.to_vec(),
    }
}

/// Whether some blended triangle may reach the alpha threshold above which two-pass transparency draws it as opaque.
fn opaque_parts(scene: &Scene) -> bool {
    let (look, materials) = (scene.look, used_materials(scene));
    let dense = |material: usize| {
        let material = &scene.materials[material];
        blend_mode(material) == BlendMode::Blend && material.alpha >= look.opaque_alpha
    };
    look.transparency == Transparency::TwoPass && materials.into_iter().any(dense)
}

/// Draw calls of the occluder pass: culling by depth draws opaque and cut-out groups twice.
fn occluder_draw_calls(groups: &[DrawGroup], culling: Culling) -> usize {
    let hiding = groups.iter().filter(|group| group.blend_mode != BlendMode::Blend).count();
    if culling == Culling::Occlusion { hiding } else { 0 }
}

fn cull_defines(culling: Culling) -> Vec<&'static str> {
    match culling {
        Culling::Occlusion => vec!["CULLED", "OCCLUSION_CULLING"],
        Culling::Triangles => vec!["CULLED"],
        Culling::None | Culling::Auto => vec![],
    }
}

/// Draw calls without occluders. Exact transparency draws blended triangles in three phases, the third only on demand;
/// two-pass transparency draws their opaque parts in a second phase.
fn draw_calls(scene: &Scene, groups: &[DrawGroup]) -> usize {
    let blended = groups.iter().filter(|group| group.blend_mode == BlendMode::Blend).count();
    let turns = match scene.look.transparency {
        Transparency::OrderIndependent => 3,
        Transparency::TwoPass => 1 + usize::from(opaque_parts(scene)),
    };
    groups.len() + (turns - 1) * blended
}

fn allocation_of(name: impl Into<String>, bytes: usize) -> Allocation {
    Allocation { name: name.into(), bytes: bytes as u64 }
}

fn buffers(scene: &Scene) -> Vec<Allocation> {
    let layout = &scene.layout;
    let mut buffers = vec![
        allocation_of("positions", 12 * layout.vertices),
        allocation_of("normals", 12 * layout.corners),
        allocation_of("triangles", 12 * layout.triangles),
        allocation_of("triangle vertices", 12 * layout.triangles),
        allocation_of("materials", super::scene_buffers::MATERIAL_BYTES * used_materials(scene).len()),
        allocation_of("frame uniforms", size_of::<super::frame_uniforms::FrameUniforms>()),
    ];
    if scene.needs.mask || scene.needs.blend {
        buffers.push(allocation_of("corner vertices", 4 * layout.corners));
    }
    if scene.needs.normal_maps {
        buffers.push(allocation_of("tangents", 16 * layout.corners));
    }
    if scene.needs.textures || scene.needs.normal_maps {
        buffers.push(allocation_of("uvs", 8 * layout.corners));
    }
    if uses_material_table(scene) {
        buffers.push(allocation_of("triangle materials", 4 * layout.triangles));
    }
    if scene.look.shadow.is_some_and(|shadow| shadow.splits > 1) {
        buffers.push(allocation_of("shadow cascades", size_of::<super::cascades::ShadowCascades>()));
    }
    buffers
}

fn textures(scene: &Scene, blur_method: BlurMethod) -> Vec<Allocation> {
    let mut textures = Vec::new();
    for (purpose, word) in [(TextureRole::Color, "colors"), (TextureRole::Normal, "normals")] {
        for array in arrays(scene, purpose) {
            let name = format!("{word} {} x {} x {}", array.width, array.height, array.layers.len());
            textures.push(Allocation { name, bytes: array.bytes() });
        }
    }
    if let Some(shadow) = scene.look.shadow {
        textures.extend(shadow_textures(&shadow, blur_method));
    }
    textures
}

fn shadow_textures(shadow: &ShadowSettings, blur_method: BlurMethod) -> Vec<Allocation> {
    let texels = shadow.size as usize * shadow.size as usize;
    let allocation_of =
        |(name, bytes, layers): (&'static str, u32, u32)| allocation_of(name, (bytes * layers) as usize * texels);
    super::shadow::textures(shadow, blur_method).into_iter().map(allocation_of).collect()
}

fn defines(scene: &Scene) -> Vec<&'static str> {
    let needs = scene.needs;
    let branches = [
        ("TEXTURES", needs.textures),
        ("NORMAL_MAPS", needs.normal_maps),
        ("UVS", needs.textures || needs.normal_maps),
        ("MATERIAL_TABLE", uses_material_table(scene)),
        ("HAS_GROUND", scene.look.ground.is_some()),
        ("BLEND_LAYERS", needs.blend),
        ("OIT", needs.blend && scene.look.transparency == Transparency::OrderIndependent),
        ("OPAQUE_PARTS", opaque_parts(scene)),
    ];
    let shadows = scene.look.shadow.iter().flat_map(super::shadow::defines);
    branches.into_iter().filter_map(|(name, on)| on.then_some(name)).chain(shadows).collect()
}

fn omitted(scene: &Scene, culling: Culling) -> Vec<OmittedFeature> {
    let (needs, layout, look) = (scene.needs, &scene.layout, &scene.look);
    let map: u64 =
        shadow_textures(&look.shadow.unwrap_or_default(), BlurMethod::Auto).iter().map(|part| part.bytes).sum();
    let per_corner = |bytes: usize| (bytes * layout.corners) as u64;
    let uvs = if needs.textures || needs.normal_maps { 0 } else { per_corner(8) };
    let all = [
        (needs.normal_maps, "normal maps", per_corner(16), vec![], "no tangent frame, no normal map lookup"),
        (needs.textures, "textures", uvs, vec![], "no colour lookup"),
        (needs.mask, "mask", 0, vec![], "no discard, no sample mask; depth needs no fragment shader"),
        (needs.blend, "blend", 0, blended(scene), "no layers in the shading, 8 bytes a sample less"),
        (needs.shadows, "shadows", map, vec!["shadow", "blur"], "no shadow lookup"),
        (uses_material_table(scene), "many materials", 4 * layout.triangles as u64, vec![], "no lookup per triangle"),
        (look.ground.is_some(), "ground", 0, vec!["ground"], "no ground program"),
        (look.bloom.is_some(), "bloom", 0, vec!["bloom"], "what glows is not kept, 10.7 bytes a pixel less"),
        (look.tone != ToneMapping::None, "tone curve", 0, vec![], "light is shown as it is"),
        (look.antialias == Antialiasing::Fxaa, "fxaa", 0, vec![], "no search for edges in the picture"),
        (
            culling != Culling::None,
            "culling",
            allocations(scene, Culling::Triangles).iter().map(|part| part.bytes).sum(),
            cull::passes(Culling::Triangles),
            "fragments know their triangle without a lookup",
        ),
        (look.dither, "dither", 0, vec![], "levels are rounded without a pattern"),
    ];
    let unneeded = all.into_iter().filter(|row| !row.0);
    unneeded.map(|(_, feature, bytes, passes, shaders)| OmittedFeature { feature, bytes, passes, shaders }).collect()
}

#[cfg(test)]
mod tests {
    use super::super::geometry::tests::squares;
    use super::*;
    use modalcast_model::domain::{AlphaMode, Material, Texture};
    use modalcast_model::scene::{Bloom, RenderSettings};

    fn names(allocations: &[Allocation]) -> Vec<&str> {
        allocations.iter().map(|allocation| allocation.name.as_str()).collect()
    }

    fn everything() -> modalcast_model::scene::SceneParts {
        let materials = vec![
            Material { color_texture: Some(0), normal_texture: Some(0), ..Material::default() },
            Material { alpha_mode: AlphaMode::Mask { cutoff: 0.5 }, ..Material::default() },
            Material { alpha_mode: AlphaMode::Blend, ..Material::default() },
        ];
        let mut parts = squares(materials);
        parts.textures.push(Texture::new("one", 1, 1, vec![255; 4]).expect("fits"));
        let look =
            RenderSettings { bloom: Some(Bloom::default()), tone: ToneMapping::Aces, dither: true, ..parts.look };
        parts.look = RenderSettings { antialias: Antialiasing::Fxaa, culling: Culling::Occlusion, ..look };
        parts
    }

    #[test]
    fn a_plain_scene_without_shadow_leaves_out_everything_and_says_what_that_saved() {
        let mut parts = squares(vec![Material::default()]);
        parts.look.shadow = None;
        parts.look.ground = None;
        let scene = Scene::new(parts).expect("good");
        let plan = plan(&scene);
        assert_eq!(plan.passes, ["visibility", "background", "shade", "encode"]);
        let expected = ["positions", "normals", "triangles", "triangle vertices", "materials", "frame uniforms"];
        assert_eq!(names(&plan.buffers), expected);
        assert!(plan.textures.is_empty() && plan.defines.is_empty());
        let left: Vec<&str> = plan.omitted.iter().map(|saving| saving.feature).collect();
        let materials = ["normal maps", "textures", "mask", "blend", "shadows", "many materials", "ground"];
        assert_eq!(left, [&materials[..], &["bloom", "tone curve", "fxaa", "culling", "dither"]].concat());
        assert_eq!(plan.omitted[0].bytes, 16 * 4, "tangents of four corners");
        assert_eq!(plan.omitted[4].bytes, 12 * 1024 * 1024, "map and moments");
    }

    #[test]
    fn a_scene_that_is_all_glass_rasterises_no_ids_and_shades_no_triangle_that_hides_others() {
        let glass = |transparency, alpha| {
            let mut parts = squares(vec![Material { alpha_mode: AlphaMode::Blend, alpha, ..Material::default() }]);
            (parts.look.shadow, parts.look.transparency) = (None, transparency);
            plan(&Scene::new(parts).expect("good"))
        };
        let passes = glass(Transparency::TwoPass, 0.5);
        assert_eq!(passes.passes, ["ground", "blended", "background", "encode"]);
        assert_eq!((passes.draw_calls, passes.defines), (1, vec!["HAS_GROUND", "BLEND_LAYERS"]));
        assert_eq!(passes.buffers.last().map(|last| last.name.as_str()), Some("corner vertices"));
        let exact = glass(Transparency::OrderIndependent, 1.0);
        assert_eq!(
            exact.passes,
            ["ground", "oit count", "oit allocate", "oit fill", "oit resolve", "background", "encode"]
        );
        assert_eq!((exact.draw_calls, exact.defines), (3, vec!["HAS_GROUND", "BLEND_LAYERS", "OIT"]));
        let dense = glass(Transparency::TwoPass, 1.0);
        assert_eq!(
            dense.passes,
            ["visibility", "ground", "blended", "background", "shade", "encode"],
            "it may be opaque"
        );
        assert_eq!((dense.draw_calls, dense.defines), (2, vec!["HAS_GROUND", "BLEND_LAYERS", "OPAQUE_PARTS"]));
    }

    #[test]
    fn a_scene_that_needs_all_leaves_out_nothing() {
        let mut parts = everything();
        parts.look.transparency = Transparency::TwoPass;
        let plan = plan(&Scene::new(parts).expect("good"));
        assert_eq!(
            plan.passes,
            [
                &["shadow cull", "shadow", "blur", "occluders", "cull", "visibility", "ground", "blended"][..],
                &["background", "shade", "bloom", "encode"]
            ]
            .concat()
        );
        assert!(plan.omitted.is_empty(), "{:?}", plan.omitted);
        assert!(names(&plan.buffers).contains(&"tangents") && names(&plan.buffers).contains(&"uvs"));
        assert_eq!(plan.textures[0], Allocation { name: "colors 1 x 1 x 1".into(), bytes: 4 });
    }
}
