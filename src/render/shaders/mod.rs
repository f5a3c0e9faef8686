//! Shader sources, assembled from the files in `shaders/` with only the branches that a scene needs.

pub(crate) mod ambient;
mod blur_strip;
mod cull;
pub(crate) mod oit;
pub(crate) mod post;
pub(crate) mod readback;
pub(crate) mod shadow;

use std::collections::BTreeSet;
use std::fmt::Write as _;

use crate::device::gl;
use crate::layout::material::MATERIAL_BYTES;
use crate::layout::{COLOR_UNIT, NORMAL_UNIT, TILE, TILES_PER_ROW, WORKGROUP_SIZE};
use crate::plan::features::ShaderFeatures;
use crate::scene_data::geometry::BlendMode;
use crate::scene_data::textures::{ArrayUse, TextureRole};

pub(crate) const FRAME: &str = include_str!("../../../shaders/shared/frame.glsl");
const CLIP: &str = include_str!("../../../shaders/shared/clip.glsl");
const MATERIAL: &str = include_str!("../../../shaders/shared/material.glsl");
pub(crate) const TRIANGLE_ID: &str = include_str!("../../../shaders/shared/triangle_id.glsl");
pub(crate) const VISIBILITY_IDS: &str = include_str!("../../../shaders/shared/visibility_ids.glsl");
const ALPHA_COVERAGE: &str = include_str!("../../../shaders/shared/alpha_coverage.glsl");
pub(crate) const FRAGMENT_ALPHA: &str = include_str!("../../../shaders/shared/fragment_alpha.glsl");
const MIXED_IMAGE: &str = include_str!("../../../shaders/shared/mixed_image.glsl");
const OIT_LISTS: &str = include_str!("../../../shaders/shared/oit_lists.glsl");
const SKY: &str = include_str!("../../../shaders/shared/sky.glsl");
const GROUND: &str = include_str!("../../../shaders/shared/ground_shading.glsl");
const GROUND_PLANE: &str = include_str!("../../../shaders/shared/ground_plane.glsl");
const SAFE_NORMALIZE: &str = include_str!("../../../shaders/shared/safe_normalize.glsl");
const PHONG: &str = include_str!("../../../shaders/shared/phong.glsl");
const BARYCENTRICS: &str = include_str!("../../../shaders/shared/barycentrics.glsl");
const TRIANGLE_FETCH: &str = include_str!("../../../shaders/shared/triangle_fetch.glsl");
const TRIANGLE_SHADING: &str = include_str!("../../../shaders/shared/triangle_shading.glsl");
const MESH_EDGES: &str = include_str!("../../../shaders/shared/mesh_edges.glsl");
const TILE_LIST: &str = include_str!("../../../shaders/shared/tile_list.glsl");
const TILE_APPEND: &str = include_str!("../../../shaders/shared/tile_append.glsl");
pub(crate) const BAND: &str = include_str!("../../../shaders/shared/band.glsl");

/// First line of every shader.
pub(crate) const VERSION: &str = "#version 430 core\n";

/// Parameters of the shader sources.
#[derive(Debug, Clone)]
pub(crate) struct ShaderOptions {
    pub(crate) features: ShaderFeatures,
    /// The materials that triangles use.
    pub(crate) used_materials: Vec<MaterialUse>,
    /// Whether some triangles have edges inside of polygons, which have no lines.
    pub(crate) inner_edges: bool,
    /// The filter of images in mixed arrays, which shaders compute.
    pub(crate) image_filter: ImageFilter,
    /// Sample positions within a pixel with four samples, 0 to 1.
    pub(crate) sample_positions: Vec<[f32; 2]>,
    /// GLSL that accumulates the samples of a pixel, see [`post::sample_resolve`].
    pub(crate) sample_resolve: String,
    /// GLSL function `ambient_light`, see [`ambient::ambient_light`].
    pub(crate) ambient_light: String,
    /// Whether the device supports `GL_ARB_post_depth_coverage`.
    pub(crate) post_depth_coverage: bool,
}

/// The filter of images, as the samplers of texture arrays have it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct ImageFilter {
    /// Maximum anisotropy.
    pub(crate) anisotropy: f32,
    /// Whether two mipmap levels are blended, instead of a lookup in the nearest one.
    pub(crate) blends_levels: bool,
}

/// A material that triangles use: its blend mode, and the texture arrays with its images.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct MaterialUse {
    pub(crate) blend_mode: BlendMode,
    pub(crate) color_array: Option<ArrayUse>,
    pub(crate) normal_array: Option<ArrayUse>,
}

/// Source text of a program's stages. Each stage is its OpenGL type, such as `COMPUTE_SHADER`, and its text.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(crate) struct ProgramSource {
    pub(crate) label: String,
    pub(crate) stages: Vec<(u32, String)>,
}

impl ProgramSource {
    /// A program with a compute stage only.
    fn compute(label: impl Into<String>, text: String) -> Self {
        Self { label: label.into(), stages: vec![(gl::COMPUTE_SHADER, text)] }
    }
}

impl ShaderOptions {
    /// Version and defines of a shader: those of the features, and `defines`.
    pub(crate) fn head(&self, defines: &[&str]) -> String {
        let mut text = String::from(VERSION);
        for define in self.features.defines().iter().chain(defines) {
            writeln!(text, "#define {define}").ok();
        }
        // Number of texels of a material; a texel has 16 bytes.
        writeln!(text, "#define MATERIAL_STRIDE {}", MATERIAL_BYTES / 16).ok();
        text
    }

    /// Defines for triangles with these blend modes. Undefines image features that their materials do not use. If there
    /// is only one material, replaces the material lookup by a constant.
    pub(crate) fn material_defines(&self, blend_modes: &[BlendMode]) -> String {
        let mut materials = (0..).zip(&self.used_materials).filter(|(_, used)| blend_modes.contains(&used.blend_mode));
        let mut text = match (materials.next(), materials.next()) {
            (Some((index, _)), None) => format!("#undef MATERIAL_TABLE\n#define SINGLE_MATERIAL {index}\n"),
            _ => String::new(),
        };
        let (colors, normals) =
            (self.arrays(blend_modes, TextureRole::Color), self.arrays(blend_modes, TextureRole::Normal));
        for (define, is_unneeded) in [
            ("TEXTURES", colors.is_empty()),
            ("NORMAL_MAPS", normals.is_empty()),
            ("UVS", colors.is_empty() && normals.is_empty()),
        ] {
            if is_unneeded {
                writeln!(text, "#undef {define}").ok();
            }
        }
        text
    }

    /// Lookup functions for the materials with these blend modes, and for the images of these materials.
    pub(crate) fn material_lookups(&self, blend_modes: &[BlendMode], derivatives: UvDerivatives) -> String {
        let [color_arrays, normal_arrays] =
            [TextureRole::Color, TextureRole::Normal].map(|role| self.arrays(blend_modes, role));
        let has_mixed_array = color_arrays.iter().chain(&normal_arrays).any(|array| array.is_mixed);
        let mixed_image = if has_mixed_array { self.image_filter.glsl() + MIXED_IMAGE } else { String::new() };
        let colors = sampler("color", COLOR_UNIT, &color_arrays, derivatives);
        let normals = sampler("normal", NORMAL_UNIT, &normal_arrays, derivatives);
        [MATERIAL, &mixed_image, &colors, &normals].concat()
    }

    /// The texture arrays whose images the materials with these blend modes use in a role.
    fn arrays(&self, blend_modes: &[BlendMode], role: TextureRole) -> BTreeSet<ArrayUse> {
        let array_of = |material: &MaterialUse| match role {
            TextureRole::Color => material.color_array,
            TextureRole::Normal => material.normal_array,
        };
        let materials = self.used_materials.iter().filter(|material| blend_modes.contains(&material.blend_mode));
        materials.filter_map(array_of).collect()
    }

    /// GLSL that declares SAMPLES, the number of samples per pixel, and their positions within the pixel.
    pub(crate) fn sample_defines(&self, samples: u32) -> String {
        let pixel_center = vec![[0.5; 2]];
        let positions = if samples > 1 { &self.sample_positions } else { &pixel_center };
        let positions: Vec<String> = positions.iter().map(|[x, y]| format!("vec2({x:?}, {y:?})")).collect();
        let vectors = positions.join(", ");
        format!("#define SAMPLES {samples}\nconst vec2 SAMPLE_POSITIONS[{}] = vec2[]({vectors});\n", positions.len())
    }

    /// Draws ids and depth of triangles with this blend mode.
    pub(crate) fn visibility(&self, blend_mode: BlendMode, samples: u32) -> ProgramSource {
        let label = format!("visibility, {blend_mode:?}, {samples} samples");
        let (vertex, body) =
            (include_str!("../../../shaders/visibility.vert"), include_str!("../../../shaders/visibility.frag"));
        if blend_mode == BlendMode::Opaque {
            let head = self.head(&[]);
            return ProgramSource {
                label,
                stages: vertex_and_fragment([&head, FRAME, CLIP, vertex].concat(), [&head, TRIANGLE_ID, body].concat()),
            };
        }
        let head = self.head(&["MASK"]) + &self.material_defines(&[blend_mode]);
        let (material_lookups, sample_defines) =
            (self.material_lookups(&[blend_mode], UvDerivatives::Implicit), self.sample_defines(samples));
        let fragment =
            [&head, &material_lookups, TRIANGLE_ID, FRAGMENT_ALPHA, &sample_defines, ALPHA_COVERAGE, body].concat();
        ProgramSource { label, stages: vertex_and_fragment([&head, FRAME, CLIP, vertex].concat(), fragment) }
    }

    /// Draws the blended triangles into the blend layer, except the parts that were drawn as opaque.
    pub(crate) fn blended(&self, samples: u32) -> ProgramSource {
        let head = self.head(&[]) + &self.material_defines(&[BlendMode::Blend]);
        let material_lookups = self.material_lookups(&[BlendMode::Blend], UvDerivatives::Implicit);
        let vertex = [&head, FRAME, CLIP, include_str!("../../../shaders/blended.vert")].concat();
        let body = include_str!("../../../shaders/blended.frag");
        let sample_coverage =
            if self.features.opaque_parts { self.sample_defines(samples) + ALPHA_COVERAGE } else { String::new() };
        let fragment = [
            &head,
            FRAME,
            &material_lookups,
            TRIANGLE_ID,
            &self.sun_visibility(),
            SAFE_NORMALIZE,
            &self.ambient_light,
            PHONG,
            &sample_coverage,
            body,
        ]
        .concat();
        ProgramSource { label: "blended".into(), stages: vertex_and_fragment(vertex, fragment) }
    }

    /// Shades tiles in which no triangle is visible.
    pub(crate) fn background(&self, samples: u32) -> ProgramSource {
        let mut text = self.shading_head(samples, &["BACKGROUND"]);
        text += &[BAND, TILE_APPEND].concat();
        text += include_str!("../../../shaders/shade.comp");
        ProgramSource::compute(format!("background, {samples} samples"), text)
    }

    /// Shades tiles in which a triangle is visible. `edges`: whether lines along mesh edges are drawn.
    pub(crate) fn shade(&self, samples: u32, edges: bool) -> ProgramSource {
        let all_modes = [BlendMode::Opaque, BlendMode::Mask, BlendMode::Blend];
        let blend_modes = if self.features.opaque_parts { &all_modes } else { &all_modes[..2] };
        let defines: &[&str] = match (edges, self.inner_edges) {
            (false, _) => &[],
            (true, false) => &["MESH_EDGES"],
            (true, true) => &["MESH_EDGES", "INNER_EDGES"],
        };
        let mut text = self.shading_head(samples, defines) + &self.material_defines(blend_modes);
        text += &self.triangle_shading(blend_modes, if edges { MESH_EDGES } else { "" });
        text += include_str!("../../../shaders/shade.comp");
        let suffix = if edges { ", edges" } else { "" };
        ProgramSource::compute(format!("shade, {samples} samples{suffix}"), text)
    }

    /// Common part of the shading programs, without the functions that shade triangles.
    fn shading_head(&self, samples: u32, defines: &[&str]) -> String {
        let mut head = self.head(defines);
        head += &tile_list();
        let ground = if self.features.ground { GROUND } else { "" };
        [
            &head,
            &self.sample_defines(samples),
            FRAME,
            CLIP,
            VISIBILITY_IDS,
            GROUND_PLANE,
            &self.sun_visibility(),
            &self.ambient_light,
            &self.ambient_visibility(),
            SKY,
            ground,
            &self.sample_resolve,
        ]
        .concat()
    }

    /// GLSL function `shade_triangle`, with the lookups for the materials of these blend modes. `mesh_edges` is the
    /// source of the lines along mesh edges, or empty.
    fn triangle_shading(&self, blend_modes: &[BlendMode], mesh_edges: &str) -> String {
        let material_lookups = self.material_lookups(blend_modes, UvDerivatives::Explicit);
        [&material_lookups, SAFE_NORMALIZE, PHONG, BARYCENTRICS, TRIANGLE_FETCH, mesh_edges, TRIANGLE_SHADING].concat()
    }

    /// Converts the keys of the compute rasterizer to ids.
    pub(crate) fn unpack(&self) -> ProgramSource {
        let mut head = self.head(&[]);
        writeln!(head, "#define TILE {TILE}").ok();
        let text = [&head, VISIBILITY_IDS, include_str!("../../../shaders/visibility_unpack.comp")].concat();
        ProgramSource::compute("unpack", text)
    }
}

/// Copies the first words of a buffer to another one.
pub(crate) fn copy_words() -> ProgramSource {
    let head = format!("{VERSION}#define WORKGROUP_SIZE {WORKGROUP_SIZE}\n");
    ProgramSource::compute("copy words", head + include_str!("../../../shaders/copy_words.comp"))
}

pub(crate) fn vertex_and_fragment(vertex: String, fragment: String) -> Vec<(u32, String)> {
    vec![(gl::VERTEX_SHADER, vertex), (gl::FRAGMENT_SHADER, fragment)]
}

/// GLSL that declares the tile list, with its macros TILE and TILES_PER_ROW.
fn tile_list() -> String {
    format!("#define TILE {TILE}\n#define TILES_PER_ROW {TILES_PER_ROW}u\n{TILE_LIST}")
}

impl ImageFilter {
    /// Constants of `mixed_image.glsl`.
    fn glsl(self) -> String {
        let level_blend = if self.blends_levels { "#define IMAGE_LEVEL_BLEND\n" } else { "" };
        format!("{level_blend}const float image_anisotropy = {:?};\n", self.anisotropy.max(1.0))
    }
}

/// Function `{name}_texel` that samples an image in one of several texture arrays. Implicit derivatives are undefined
/// in divergent control flow, so with several arrays the derivatives are computed before the array is selected. Images
/// in mixed arrays are sampled by `mixed_image_texel`.
fn sampler(name: &str, unit: u32, arrays: &BTreeSet<ArrayUse>, derivatives: UvDerivatives) -> String {
    let mut text = String::new();
    let Some(first) = arrays.first() else { return text };
    for ArrayUse { index, .. } in arrays {
        let unit = unit as usize + index;
        writeln!(text, "layout(binding = {unit}) uniform sampler2DArray {name}_{index};").ok();
    }
    let parameters = if derivatives == UvDerivatives::Explicit { ", vec2 dx, vec2 dy" } else { "" };
    writeln!(text, "vec4 {name}_texel(ivec2 array_and_layer, vec2 uv{parameters}) {{").ok();
    writeln!(text, "    vec3 coordinates = vec3(uv, float(max(array_and_layer.y, 0)));").ok();
    if derivatives == UvDerivatives::Implicit && arrays.len() == 1 && !first.is_mixed {
        writeln!(text, "    return texture({name}_{}, coordinates);\n}}", first.index).ok();
        return text;
    }
    if derivatives == UvDerivatives::Implicit {
        writeln!(text, "    vec2 dx = dFdx(uv), dy = dFdy(uv);").ok();
    }
    let lookup = |ArrayUse { index, is_mixed }: &ArrayUse| match is_mixed {
        true => format!("mixed_image_texel({name}_{index}, max(array_and_layer, ivec2(0)), uv, dx, dy)"),
        false => format!("textureGrad({name}_{index}, coordinates, dx, dy)"),
    };
    // The upper bits of a location in a mixed array contain the size of the image.
    let array = if arrays.iter().any(|array| array.is_mixed) { "(array_and_layer.x & 7)" } else { "array_and_layer.x" };
    for array_use in arrays.iter().skip(1) {
        writeln!(text, "    if ({array} == {}) return {};", array_use.index, lookup(array_use)).ok();
    }
    writeln!(text, "    return {};\n}}", lookup(first)).ok();
    text
}

/// How a lookup gets the derivatives of texture coordinates.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum UvDerivatives {
    /// From differences between neighboring fragments (`texture`, or `dFdx` and `dFdy`).
    Implicit,
    /// From the caller, as arguments.
    Explicit,
}

#[cfg(test)]
mod shared_array_tests;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::device::gl::Limits;
    use crate::plan::ScenePlan;
    use crate::scene_data::geometry::tests::squares;
    use crate::types::BlurMethod;
    use modalcast_model::domain::{AlphaMode, Material};
    use modalcast_model::scene::Scene;

    /// An array of images of one size.
    fn uniform(index: usize) -> ArrayUse {
        ArrayUse { index, is_mixed: false }
    }

    fn options(alpha_mode: AlphaMode) -> ShaderOptions {
        let scene = Scene::new(squares(vec![Material { alpha_mode, ..Material::default() }])).expect("a valid scene");
        let plan =
            ScenePlan::new(&scene, &Limits { max_storage_bytes: u64::MAX, ..Limits::default() }, BlurMethod::Tiles);
        let sample_positions = vec![[0.375, 0.125], [0.875, 0.375], [0.125, 0.625], [0.625, 0.875]];
        let used_materials = vec![MaterialUse { blend_mode: BlendMode::Opaque, color_array: None, normal_array: None }];
        let sample_resolve = post::sample_resolve(&scene.look);
        ShaderOptions {
            features: plan.features,
            used_materials,
            inner_edges: false,
            image_filter: ImageFilter { anisotropy: 1.0, blends_levels: false },
            sample_positions,
            sample_resolve,
            ambient_light: ambient::ambient_light(None),
            post_depth_coverage: false,
        }
    }

    fn text(source: ProgramSource) -> String {
        source.stages.into_iter().map(|(_, text)| text).collect()
    }

    #[test]
    fn only_masked_triangles_are_discarded() {
        let options = options(AlphaMode::Opaque);
        assert!(!text(options.visibility(BlendMode::Opaque, 4)).contains("discard;"));
        assert!(!text(options.blended(4)).contains("discard;"));
        for (samples, is_multisampled) in [(4, true), (1, false)] {
            let text = text(options.visibility(BlendMode::Mask, samples));
            assert!(text.contains("discard;") && text.contains(&format!("SAMPLES {samples}")));
            assert_eq!(text.contains("vec2(0.375, 0.125)"), is_multisampled, "sample positions for {samples} samples");
        }
    }

    #[test]
    fn opaque_shadow_needs_no_fragment_shader() {
        assert_eq!(options(AlphaMode::Opaque).shadow(BlendMode::Opaque).stages.len(), 1);
    }

    #[test]
    fn shading_contains_only_features_of_the_scene() {
        let plain_options = ShaderOptions { features: ShaderFeatures::NONE, ..options(AlphaMode::Opaque) };
        let [background, shading] = [plain_options.background(4), plain_options.shade(4, false)].map(text);
        assert!(!background.contains("vec4 shade_triangle("), "expected no triangle in the background");
        assert!(shading.contains("vec4 shade_triangle("));
        for text in [&background, &shading] {
            assert!(!text.contains("vec3 shade_ground(") && !text.contains("textureGrad"));
        }
        let used_materials =
            vec![MaterialUse { blend_mode: BlendMode::Opaque, color_array: Some(uniform(0)), normal_array: None }];
        let features = ShaderFeatures { textures: true, ground: true, ..ShaderFeatures::NONE };
        let textured_options = ShaderOptions { features, used_materials, ..plain_options };
        let shading = text(textured_options.shade(1, false));
        assert!(shading.contains("vec3 shade_ground(") && shading.contains("textureGrad(color_0"));
    }

    #[test]
    fn only_frames_with_edges_compute_distances_to_edges() {
        let options = options(AlphaMode::Opaque);
        let [plain, edges] = [false, true].map(|edges| text(options.shade(4, edges)));
        assert!(!plain.contains("edge_coverage(Triangle") && !plain.contains("#define MESH_EDGES"));
        assert!(edges.contains("edge_coverage(Triangle") && !edges.contains("#define INNER_EDGES"));
        let polygons = ShaderOptions { inner_edges: true, ..options };
        assert!(text(polygons.shade(1, true)).contains("#define INNER_EDGES"));
        assert_eq!(text(polygons.shade(4, false)), plain, "expected the same program without edges");
        assert!(!text(polygons.background(4)).contains("#define MESH_EDGES"));
    }

    #[test]
    fn lookups_use_only_materials_of_the_blend_modes() {
        let material = |blend_mode, color_array: Option<usize>, normal_array: Option<usize>| MaterialUse {
            blend_mode,
            color_array: color_array.map(uniform),
            normal_array: normal_array.map(uniform),
        };
        let used_materials = vec![
            material(BlendMode::Opaque, Some(0), Some(0)),
            material(BlendMode::Mask, Some(1), None),
            material(BlendMode::Blend, None, None),
            material(BlendMode::Blend, Some(2), None),
        ];
        let options = ShaderOptions { used_materials, ..options(AlphaMode::Opaque) };
        let lookups = |blend_modes: &[BlendMode], derivatives| {
            options.material_defines(blend_modes) + &options.material_lookups(blend_modes, derivatives)
        };
        let mask = lookups(&[BlendMode::Mask], UvDerivatives::Implicit);
        assert!(
            mask.contains("texture(color_1, coordinates)")
                && !mask.contains("color_0")
                && !mask.contains("textureGrad")
        );
        assert!(mask.contains("#undef NORMAL_MAPS") && !mask.contains("#undef UVS"));
        assert!(mask.contains("SINGLE_MATERIAL 1") && mask.contains("#undef MATERIAL_TABLE"));
        let blend = lookups(&[BlendMode::Blend], UvDerivatives::Implicit);
        assert!(!blend.contains("#undef MATERIAL_TABLE") && !blend.contains("#undef TEXTURES"));
        let shade = lookups(&[BlendMode::Opaque, BlendMode::Mask], UvDerivatives::Explicit);
        assert!(shade.contains("if (array_and_layer.x == 1) return textureGrad(color_1") && !shade.contains("dFdx"));
        assert!(shade.contains("normal_0") && !shade.contains("color_2"));
    }

    #[test]
    fn only_images_in_mixed_arrays_are_filtered_by_the_shader() {
        let mixed = ArrayUse { index: 5, is_mixed: true };
        let material = MaterialUse { blend_mode: BlendMode::Opaque, color_array: Some(mixed), normal_array: None };
        let filter = ImageFilter { anisotropy: 8.0, blends_levels: true };
        let options =
            |used_materials| ShaderOptions { used_materials, image_filter: filter, ..options(AlphaMode::Opaque) };
        let lookups = |options: ShaderOptions| options.material_lookups(&[BlendMode::Opaque], UvDerivatives::Explicit);
        let text = lookups(options(vec![material, MaterialUse { color_array: Some(uniform(0)), ..material }]));
        assert!(text.contains("if ((array_and_layer.x & 7) == 5) return mixed_image_texel(color_5,"), "{text}");
        assert!(text.contains("return textureGrad(color_0,") && text.contains("image_anisotropy = 8.0"), "{text}");
        assert!(text.contains("#define IMAGE_LEVEL_BLEND"), "{text}");
        let text = lookups(options(vec![MaterialUse { color_array: Some(uniform(5)), ..material }]));
        assert!(!text.contains("mixed_image_texel") && text.contains("textureGrad(color_5"), "{text}");
        // A single lookup with implicit derivatives computes them, because the shader selects the level.
        let text = sampler("color", 1, &BTreeSet::from([mixed]), UvDerivatives::Implicit);
        assert!(text.contains("vec2 dx = dFdx(uv)") && text.contains("mixed_image_texel(color_5"), "{text}");
    }

    #[test]
    fn derivatives_precede_the_selection_of_an_array() {
        let text = sampler("color", 1, &BTreeSet::from([0, 2, 3].map(uniform)), UvDerivatives::Implicit);
        let (derivatives_offset, selection_offset) = (text.find("dFdx"), text.find("array_and_layer.x == 2"));
        assert!(derivatives_offset.is_some() && derivatives_offset < selection_offset, "{text}");
        assert_eq!(sampler("color", 1, &BTreeSet::new(), UvDerivatives::Explicit), "");
    }
}
