//! Assembles the shader sources from the files under `shaders/`, with only the branches that a scene needs.

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
use crate::layout::{COLOR_UNIT, NORMAL_UNIT, TILE, TILE_ROW};
use crate::plan::features::ShaderFeatures;
use crate::scene_data::geometry::BlendMode;
use crate::scene_data::textures::TextureRole;

pub(crate) const FRAME: &str = include_str!("../../../shaders/shared/frame.glsl");
const CLIP: &str = include_str!("../../../shaders/shared/clip.glsl");
const MATERIAL: &str = include_str!("../../../shaders/shared/material.glsl");
pub(crate) const TRIANGLE_ID: &str = include_str!("../../../shaders/shared/triangle_id.glsl");
pub(crate) const VISIBILITY_IDS: &str = include_str!("../../../shaders/shared/visibility_ids.glsl");
const ALPHA_COVERAGE: &str = include_str!("../../../shaders/shared/alpha_coverage.glsl");
pub(crate) const SHADOW_CASTER: &str = include_str!("../../../shaders/shared/shadow_caster.glsl");
const OIT_LISTS: &str = include_str!("../../../shaders/shared/oit_lists.glsl");
const SKY: &str = include_str!("../../../shaders/shared/sky.glsl");
const GROUND: &str = include_str!("../../../shaders/shared/ground_shading.glsl");
const GROUND_PLANE: &str = include_str!("../../../shaders/shared/ground_plane.glsl");
const PHONG: &str = include_str!("../../../shaders/shared/phong.glsl");
const BARYCENTRICS: &str = include_str!("../../../shaders/shared/barycentrics.glsl");
const TRIANGLE_SHADING: &str = include_str!("../../../shaders/shared/triangle_shading.glsl");

/// First line of every shader.
pub(crate) const VERSION: &str = "#version 430 core\n";

/// Parameters of the shader sources.
#[derive(Debug, Clone)]
pub(crate) struct ShaderOptions {
    pub(crate) features: ShaderFeatures,
    /// The materials that triangles use.
    pub(crate) used: Vec<MaterialUse>,
    /// Sample positions within a multisampled pixel.
    pub(crate) sample_positions: Vec<[f32; 2]>,
    /// Source that is applied to the light of each sample.
    pub(crate) sample_resolve: String,
    /// Whether a fragment can read its coverage after the depth test.
    pub(crate) post_depth_coverage: bool,
}

/// A material that triangles use: the pipeline that draws them, and the arrays of its images.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct MaterialUse {
    pub(crate) blend_mode: BlendMode,
    pub(crate) color: Option<usize>,
    pub(crate) normal: Option<usize>,
}

/// The source text of a program's stages.
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
    pub(crate) fn head(&self, more: &[&str]) -> String {
        let mut text = String::from(VERSION);
        for define in self.features.defines().iter().chain(more) {
            writeln!(text, "#define {define}").ok();
        }
        writeln!(text, "#define MATERIAL_STRIDE {}", MATERIAL_BYTES / 16).ok();
        text
    }

    /// Defines for triangles of these kinds: for their images, and for the material lookup if they have several
    /// materials.
    pub(crate) fn material_defines(&self, kinds: &[BlendMode]) -> String {
        let mut own = (0..).zip(&self.used).filter(|(_, used)| kinds.contains(&used.blend_mode));
        let mut text = match (own.next(), own.next()) {
            (Some((only, _)), None) => format!("#undef MATERIAL_TABLE\n#define SINGLE_MATERIAL {only}\n"),
            _ => String::new(),
        };
        let (colors, normals) = (self.arrays(kinds, TextureRole::Color), self.arrays(kinds, TextureRole::Normal));
        for (define, unneeded) in [
            ("TEXTURES", colors.is_empty()),
            ("NORMAL_MAPS", normals.is_empty()),
            ("UVS", colors.is_empty() && normals.is_empty()),
        ] {
            if unneeded {
                writeln!(text, "#undef {define}").ok();
            }
        }
        text
    }

    /// Lookup functions for the images and materials of these kinds.
    pub(crate) fn material_lookups(&self, kinds: &[BlendMode], slopes: UvDerivatives) -> String {
        let colors = sampler("color", COLOR_UNIT, &self.arrays(kinds, TextureRole::Color), slopes);
        let normals = sampler("normal", NORMAL_UNIT, &self.arrays(kinds, TextureRole::Normal), slopes);
        [MATERIAL, &colors, &normals].concat()
    }

    /// Texture arrays that hold images of these kinds' materials.
    fn arrays(&self, kinds: &[BlendMode], purpose: TextureRole) -> BTreeSet<usize> {
        let image = |used: &MaterialUse| match purpose {
            TextureRole::Color => used.color,
            TextureRole::Normal => used.normal,
        };
        self.used.iter().filter(|used| kinds.contains(&used.blend_mode)).filter_map(image).collect()
    }

    /// Defines that depend on the samples per pixel.
    pub(crate) fn sample_defines(&self, samples: u32) -> String {
        let middle = vec![[0.5; 2]];
        let places = if samples > 1 { &self.sample_positions } else { &middle };
        let places: Vec<String> = places.iter().map(|[x, y]| format!("vec2({x:?}, {y:?})")).collect();
        let list = places.join(", ");
        format!("#define SAMPLES {samples}\nconst vec2 SAMPLE_POSITIONS[{}] = vec2[]({list});\n", places.len())
    }

    /// Draws ids and depth of one kind of triangle.
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
        let fragment = [&head, &material_lookups, TRIANGLE_ID, &sample_defines, ALPHA_COVERAGE, body].concat();
        ProgramSource { label, stages: vertex_and_fragment([&head, FRAME, CLIP, vertex].concat(), fragment) }
    }

    /// Draws the layer of the blended triangles, except the parts that were drawn as opaque.
    pub(crate) fn blended(&self, samples: u32) -> ProgramSource {
        let head = self.head(&[]) + &self.material_defines(&[BlendMode::Blend]);
        let material_lookups = self.material_lookups(&[BlendMode::Blend], UvDerivatives::Implicit);
        let vertex = [&head, FRAME, CLIP, include_str!("../../../shaders/blended.vert")].concat();
        let body = include_str!("../../../shaders/blended.frag");
        let parts =
            if self.features.opaque_parts { self.sample_defines(samples) + ALPHA_COVERAGE } else { String::new() };
        let fragment = [&head, FRAME, &material_lookups, TRIANGLE_ID, &self.sun(), PHONG, &parts, body].concat();
        ProgramSource { label: "blended".into(), stages: vertex_and_fragment(vertex, fragment) }
    }

    /// Shades tiles in which no triangle is visible.
    pub(crate) fn background(&self, samples: u32) -> ProgramSource {
        let mut text = self.shading(samples, &["BACKGROUND"]);
        text += include_str!("../../../shaders/shade.comp");
        ProgramSource::compute(format!("background, {samples} samples"), text)
    }

    /// Shades the other tiles.
    pub(crate) fn shade(&self, samples: u32) -> ProgramSource {
        let all = [BlendMode::Opaque, BlendMode::Mask, BlendMode::Blend];
        let kinds = if self.features.opaque_parts { &all } else { &all[..2] };
        let mut text = self.shading(samples, &[]) + &self.material_defines(kinds);
        text +=
            &[&self.material_lookups(kinds, UvDerivatives::Explicit), PHONG, BARYCENTRICS, TRIANGLE_SHADING].concat();
        text += include_str!("../../../shaders/shade.comp");
        ProgramSource::compute(format!("shade, {samples} samples"), text)
    }

    fn shading(&self, samples: u32, more: &[&str]) -> String {
        let mut head = self.head(more);
        writeln!(head, "#define TILE {TILE}\n#define TILES_PER_ROW {TILE_ROW}u").ok();
        let ground = if self.features.ground { GROUND } else { "" };
        [
            &head,
            &self.sample_defines(samples),
            FRAME,
            CLIP,
            VISIBILITY_IDS,
            GROUND_PLANE,
            &self.sun(),
            SKY,
            ground,
            &self.sample_resolve,
        ]
        .concat()
    }

    /// Converts the keys of the compute rasterizer to ids.
    pub(crate) fn unpack(&self) -> ProgramSource {
        let mut head = self.head(&[]);
        writeln!(head, "#define TILE {TILE}").ok();
        let text =
            [&head, FRAME, VISIBILITY_IDS, GROUND_PLANE, include_str!("../../../shaders/visibility_unpack.comp")]
                .concat();
        ProgramSource::compute("unpack", text)
    }

    pub(crate) fn ground(&self) -> ProgramSource {
        let head = self.head(&[]);
        let vertex = [&head, FRAME, GROUND_PLANE, include_str!("../../../shaders/ground.vert")].concat();
        let fragment =
            [&head, FRAME, VISIBILITY_IDS, GROUND_PLANE, include_str!("../../../shaders/ground.frag")].concat();
        ProgramSource { label: "ground".into(), stages: vertex_and_fragment(vertex, fragment) }
    }
}

pub(crate) fn vertex_and_fragment(vertex: String, fragment: String) -> Vec<(u32, String)> {
    vec![(gl::VERTEX_SHADER, vertex), (gl::FRAGMENT_SHADER, fragment)]
}

/// Lookup in texture arrays. Implicit derivatives are undefined in divergent control flow, so with several arrays the
/// derivatives are computed before the array is chosen.
fn sampler(name: &str, unit: u32, arrays: &BTreeSet<usize>, slopes: UvDerivatives) -> String {
    let mut text = String::new();
    let Some(first) = arrays.first() else { return text };
    for index in arrays {
        let unit = unit as usize + index;
        writeln!(text, "layout(binding = {unit}) uniform sampler2DArray {name}_{index};").ok();
    }
    let given = if slopes == UvDerivatives::Explicit { ", vec2 dx, vec2 dy" } else { "" };
    writeln!(text, "vec4 {name}_texel(ivec2 place, vec2 uv{given}) {{").ok();
    writeln!(text, "    vec3 at = vec3(uv, float(max(place.y, 0)));").ok();
    if slopes == UvDerivatives::Implicit && arrays.len() == 1 {
        writeln!(text, "    return texture({name}_{first}, at);\n}}").ok();
        return text;
    }
    if slopes == UvDerivatives::Implicit {
        writeln!(text, "    vec2 dx = dFdx(uv), dy = dFdy(uv);").ok();
    }
    for index in arrays.iter().skip(1) {
        writeln!(text, "    if (place.x == {index}) return textureGrad({name}_{index}, at, dx, dy);").ok();
    }
    writeln!(text, "    return textureGrad({name}_{first}, at, dx, dy);\n}}").ok();
    text
}

/// Source of the derivatives of texture coordinates.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum UvDerivatives {
    /// Differences between the fragments of a quad.
    Implicit,
    /// Arguments of the lookup.
    Explicit,
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::device::gl::Limits;
    use crate::plan::ScenePlan;
    use crate::scene_data::geometry::tests::squares;
    use crate::types::BlurMethod;
    use modalcast_model::domain::{AlphaMode, Material};
    use modalcast_model::scene::Scene;

    fn options(alpha_mode: AlphaMode) -> ShaderOptions {
        let scene = Scene::new(squares(vec![Material { alpha_mode, ..Material::default() }])).expect("good");
        let plan =
            ScenePlan::new(&scene, &Limits { max_storage_bytes: u64::MAX, ..Limits::default() }, BlurMethod::Tiles);
        let sample_positions = vec![[0.375, 0.125], [0.875, 0.375], [0.125, 0.625], [0.625, 0.875]];
        let used = vec![MaterialUse { blend_mode: BlendMode::Opaque, color: None, normal: None }];
        let sample_resolve = post::sample_resolve(&scene.look);
        ShaderOptions { features: plan.features, used, sample_positions, sample_resolve, post_depth_coverage: false }
    }

    fn text(source: ProgramSource) -> String {
        source.stages.into_iter().map(|(_, text)| text).collect()
    }

    #[test]
    fn only_cut_out_triangles_have_a_discard_in_their_shader_and_depth_alone_needs_no_fragment_shader() {
        let options = options(AlphaMode::Opaque);
        assert!(!text(options.visibility(BlendMode::Opaque, 4)).contains("discard;"));
        assert!(!text(options.blended(4)).contains("discard;"));
        for (samples, masks) in [(4, true), (1, false)] {
            let text = text(options.visibility(BlendMode::Mask, samples));
            assert!(text.contains("discard;") && text.contains(&format!("SAMPLES {samples}")));
            assert_eq!(text.contains("vec2(0.375, 0.125)"), masks, "places of the samples");
        }
        assert_eq!(options.shadow(BlendMode::Opaque).stages.len(), 1);
    }

    #[test]
    fn the_shading_of_a_plain_scene_knows_no_image_no_shadow_no_ground_and_no_layer() {
        let plain = ShaderOptions { features: ShaderFeatures::NONE, ..options(AlphaMode::Opaque) };
        let [background, shading] = [plain.background(4), plain.shade(4)].map(text);
        assert!(!background.contains("vec4 shade_triangle("), "no triangle, no shading of one");
        assert!(shading.contains("vec4 shade_triangle("));
        for text in [&background, &shading] {
            assert!(!text.contains("vec3 shade_ground(") && !text.contains("textureGrad"));
        }
        let used = vec![MaterialUse { blend_mode: BlendMode::Opaque, color: Some(0), normal: None }];
        let features = ShaderFeatures { textures: true, ground: true, ..ShaderFeatures::NONE };
        let full = ShaderOptions { features, used, ..plain };
        let shading = text(full.shade(1));
        assert!(shading.contains("vec3 shade_ground(") && shading.contains("textureGrad(color_0"));
    }

    #[test]
    fn each_kind_reads_the_arrays_of_its_own_materials_and_looks_up_a_material_only_among_several() {
        let of = |blend_mode, color, normal| MaterialUse { blend_mode, color, normal };
        let used = vec![
            of(BlendMode::Opaque, Some(0), Some(0)),
            of(BlendMode::Mask, Some(1), None),
            of(BlendMode::Blend, None, None),
            of(BlendMode::Blend, Some(2), None),
        ];
        let options = ShaderOptions { used, ..options(AlphaMode::Opaque) };
        let of =
            |kinds: &[BlendMode], slopes| options.material_defines(kinds) + &options.material_lookups(kinds, slopes);
        let mask = of(&[BlendMode::Mask], UvDerivatives::Implicit);
        assert!(mask.contains("texture(color_1, at)") && !mask.contains("color_0") && !mask.contains("textureGrad"));
        assert!(mask.contains("#undef NORMAL_MAPS") && !mask.contains("#undef UVS"));
        assert!(mask.contains("SINGLE_MATERIAL 1") && mask.contains("#undef MATERIAL_TABLE"));
        let blend = of(&[BlendMode::Blend], UvDerivatives::Implicit);
        assert!(!blend.contains("#undef MATERIAL_TABLE") && !blend.contains("#undef TEXTURES"));
        let shade = of(&[BlendMode::Opaque, BlendMode::Mask], UvDerivatives::Explicit);
        assert!(shade.contains("if (place.x == 1) return textureGrad(color_1") && !shade.contains("dFdx"));
        assert!(shade.contains("normal_0") && !shade.contains("color_2"));
    }

    #[test]
    fn several_arrays_are_chosen_by_their_number_and_slopes_taken_before() {
        let text = sampler("color", 1, &BTreeSet::from([0, 2, 3]), UvDerivatives::Implicit);
        let (slopes, choice) = (text.find("dFdx"), text.find("place.x == 2"));
        assert!(slopes.is_some() && slopes < choice, "{text}");
        assert_eq!(sampler("color", 1, &BTreeSet::new(), UvDerivatives::Explicit), "");
    }
}
