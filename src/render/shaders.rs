//! Assembles the shader sources from the files under `shaders/`, with only the branches that a scene needs.

mod asked;
pub(super) mod lists;

pub(super) use self::asked::pick;

use std::collections::BTreeSet;
use std::fmt::Write as _;

use super::geometry::Kind;
use super::gl;
use super::textures::Use;
use modalcast_model::scene::Shadow;

pub(super) const FRAME: &str = include_str!("../../shaders/shared/frame.glsl");
const CLIP: &str = include_str!("../../shaders/shared/clip.glsl");
const MATERIAL: &str = include_str!("../../shaders/shared/material.glsl");
pub(super) const DRAWN: &str = include_str!("../../shaders/shared/drawn.glsl");
pub(super) const IDS: &str = include_str!("../../shaders/shared/ids.glsl");
const CUT_OUT: &str = include_str!("../../shaders/shared/cut_out.glsl");
pub(super) const CASTER: &str = include_str!("../../shaders/shared/caster.glsl");
const LISTS: &str = include_str!("../../shaders/shared/lists.glsl");
const SKY: &str = include_str!("../../shaders/shared/sky.glsl");
const GROUND: &str = include_str!("../../shaders/shared/ground.glsl");
const MEETS: &str = include_str!("../../shaders/shared/meets.glsl");
const PHONG: &str = include_str!("../../shaders/shared/phong.glsl");
const SHARES: &str = include_str!("../../shaders/shared/shares.glsl");
const TRIANGLE: &str = include_str!("../../shaders/shared/triangle.glsl");

/// First texture unit of each use.
pub(super) const SHADOW_UNIT: u32 = 0;
pub(super) const COLOUR_UNIT: u32 = 1;
pub(super) const NORMAL_UNIT: u32 = COLOUR_UNIT + super::textures::MAX_ARRAYS as u32;
/// Units of the buffer textures and of the frame's images, the same as in the shaders.
pub(super) const POSITION_UNIT: u32 = 13;
pub(super) const MATERIAL_UNIT: u32 = 14;
pub(super) const TRIANGLE_MATERIAL_UNIT: u32 = 15;
pub(super) const CORNER_NORMAL_UNIT: u32 = 16;
pub(super) const TRIANGLE_UNIT: u32 = 17;
pub(super) const TRIANGLE_VERTEX_UNIT: u32 = 18;
pub(super) const UV_UNIT: u32 = 19;
pub(super) const TANGENT_UNIT: u32 = 20;
pub(super) const ID_UNIT: u32 = 21;
/// Depth of the samples whose ids are at [`ID_UNIT`].
pub(super) const DEPTH_UNIT: u32 = 26;
pub(super) const LAYER_UNIT: u32 = 22;
pub(super) const COUNT_UNIT: u32 = 23;
pub(super) const VALUE_UNIT: u32 = 24;
/// Maximum number of textures that the shading reads in addition to the scene's images.
pub(super) const OTHER_READS: usize = 13;
const _: () = assert!(NORMAL_UNIT + super::textures::MAX_ARRAYS as u32 <= POSITION_UNIT, "texture units overlap");

/// Lanes of a compute workgroup, along x.
pub(super) const LANES: u32 = 64;
/// Side of the square of pixels that a workgroup shades.
pub(super) const TILE: u32 = 8;
/// Workgroups in a row of the dispatch over listed tiles.
pub(super) const TILE_ROW: u32 = 64;

/// Parameters of the shader sources.
#[derive(Debug, Clone)]
pub(super) struct Options {
    pub(super) defines: Vec<&'static str>,
    /// The materials that triangles use.
    pub(super) used: Vec<Used>,
    /// Shadow settings as resolved for the device; used only when the defines contain SHADOWS.
    pub(super) shadow: Shadow,
    /// Sample positions within a multisampled pixel.
    pub(super) sample_places: Vec<[f32; 2]>,
    /// Source that is applied to the light of each sample.
    pub(super) resolve: String,
    /// Whether a fragment can read its coverage after the depth test.
    pub(super) post_depth: bool,
}

/// A material that triangles use: the pipeline that draws them, and the arrays of its images.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Used {
    pub(super) kind: Kind,
    pub(super) colour: Option<usize>,
    pub(super) normal: Option<usize>,
}

/// The source text of a program's stages.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(super) struct Source {
    pub(super) label: String,
    pub(super) stages: Vec<(u32, String)>,
}

impl Options {
    pub(super) fn head(&self, more: &[&str]) -> String {
        let mut text = String::from("#version 430 core\n");
        for define in self.defines.iter().chain(more) {
            writeln!(text, "#define {define}").ok();
        }
        writeln!(text, "#define STRIDE {}", super::scene_buffers::MATERIAL_BYTES / 16).ok();
        text
    }

    /// Defines for triangles of these kinds: for their images, and for the material lookup if they have several
    /// materials.
    pub(super) fn branches(&self, kinds: &[Kind]) -> String {
        let mut own = (0..).zip(&self.used).filter(|(_, used)| kinds.contains(&used.kind));
        let mut text = match (own.next(), own.next()) {
            (Some((only, _)), None) => format!("#undef LOOK_UP\n#define ONLY_MATERIAL {only}\n"),
            _ => String::new(),
        };
        let (colours, normals) = (self.arrays(kinds, Use::Colour), self.arrays(kinds, Use::Normal));
        for (define, unneeded) in [
            ("TEXTURES", colours.is_empty()),
            ("NORMAL_MAPS", normals.is_empty()),
            ("UVS", colours.is_empty() && normals.is_empty()),
        ] {
            if unneeded {
                writeln!(text, "#undef {define}").ok();
            }
        }
        text
    }

    /// Lookup functions for the images and materials of these kinds.
    pub(super) fn lookups(&self, kinds: &[Kind], slopes: Slopes) -> String {
        let colours = sampler("colour", COLOUR_UNIT, &self.arrays(kinds, Use::Colour), slopes);
        let normals = sampler("normal", NORMAL_UNIT, &self.arrays(kinds, Use::Normal), slopes);
        [MATERIAL, &colours, &normals].concat()
    }

    /// Texture arrays that hold images of these kinds' materials.
    fn arrays(&self, kinds: &[Kind], purpose: Use) -> BTreeSet<usize> {
        let image = |used: &Used| match purpose {
            Use::Colour => used.colour,
            Use::Normal => used.normal,
        };
        self.used.iter().filter(|used| kinds.contains(&used.kind)).filter_map(image).collect()
    }

    /// Whether two-pass transparency draws parts of blended triangles as opaque.
    pub(super) fn opaque_parts(&self) -> bool {
        self.defines.contains(&"OPAQUE_PARTS")
    }

    /// Defines that depend on the samples per pixel.
    pub(super) fn sampling(&self, samples: u32) -> String {
        let middle = vec![[0.5; 2]];
        let places = if samples > 1 { &self.sample_places } else { &middle };
        let places: Vec<String> = places.iter().map(|[x, y]| format!("vec2({x:?}, {y:?})")).collect();
        let list = places.join(", ");
        format!("#define SAMPLES {samples}\nconst vec2 SAMPLE_PLACES[{}] = vec2[]({list});\n", places.len())
    }

    /// Draws ids and depth of one kind of triangle.
    pub(super) fn visibility(&self, kind: Kind, samples: u32) -> Source {
        let label = format!("visibility, {kind:?}, {samples} samples");
        let (vertex, body) =
            (include_str!("../../shaders/visibility.vert"), include_str!("../../shaders/visibility.frag"));
        if kind == Kind::Opaque {
            let head = self.head(&[]);
            return Source {
                label,
                stages: drawn([&head, FRAME, CLIP, vertex].concat(), [&head, DRAWN, body].concat()),
            };
        }
        let head = self.head(&["MASK"]) + &self.branches(&[kind]);
        let (lookups, sampling) = (self.lookups(&[kind], Slopes::OfTheQuad), self.sampling(samples));
        let fragment = [&head, &lookups, DRAWN, &sampling, CUT_OUT, body].concat();
        Source { label, stages: drawn([&head, FRAME, CLIP, vertex].concat(), fragment) }
    }

    /// Draws the layer of the blended triangles, except the parts that were drawn as opaque.
    pub(super) fn blended(&self, samples: u32) -> Source {
        let head = self.head(&[]) + &self.branches(&[Kind::Blend]);
        let lookups = self.lookups(&[Kind::Blend], Slopes::OfTheQuad);
        let vertex = [&head, FRAME, CLIP, include_str!("../../shaders/blended.vert")].concat();
        let body = include_str!("../../shaders/blended.frag");
        let parts = if self.opaque_parts() { self.sampling(samples) + CUT_OUT } else { String::new() };
        let fragment = [&head, FRAME, &lookups, DRAWN, &self.sun(), PHONG, &parts, body].concat();
        Source { label: "blended".into(), stages: drawn(vertex, fragment) }
    }

    /// Shades tiles in which no triangle is visible.
    pub(super) fn backdrop(&self, samples: u32) -> Source {
        let mut text = self.shading(samples, &["BACKDROP"]);
        text += include_str!("../../shaders/shade.comp");
        Source { label: format!("backdrop, {samples} samples"), stages: vec![(gl::COMPUTE_SHADER, text)] }
    }

    /// Shades the other tiles.
    pub(super) fn shade(&self, samples: u32) -> Source {
        let all = [Kind::Opaque, Kind::Mask, Kind::Blend];
        let kinds = if self.opaque_parts() { &all } else { &all[..2] };
        let mut text = self.shading(samples, &[]) + &self.branches(kinds);
        text += &[&self.lookups(kinds, Slopes::Given), PHONG, SHARES, TRIANGLE].concat();
        text += include_str!("../../shaders/shade.comp");
        Source { label: format!("shade, {samples} samples"), stages: vec![(gl::COMPUTE_SHADER, text)] }
    }

    fn shading(&self, samples: u32, more: &[&str]) -> String {
        let mut head = self.head(more);
        writeln!(head, "#define TILE {TILE}\n#define ROW {TILE_ROW}u").ok();
        let ground = if self.defines.contains(&"GROUND_SEEN") { GROUND } else { "" };
        [&head, &self.sampling(samples), FRAME, CLIP, IDS, MEETS, &self.sun(), SKY, ground, &self.resolve].concat()
    }

    /// Converts the keys of the compute rasterizer to ids.
    pub(super) fn unpack(&self) -> Source {
        let mut head = self.head(&[]);
        writeln!(head, "#define TILE {TILE}").ok();
        let text = [&head, FRAME, IDS, MEETS, include_str!("../../shaders/unpack.comp")].concat();
        Source { label: "unpack".into(), stages: vec![(gl::COMPUTE_SHADER, text)] }
    }

    pub(super) fn ground(&self) -> Source {
        let head = self.head(&[]);
        let vertex = [&head, FRAME, MEETS, include_str!("../../shaders/ground.vert")].concat();
        let fragment = [&head, FRAME, IDS, MEETS, include_str!("../../shaders/ground.frag")].concat();
        Source { label: "ground".into(), stages: drawn(vertex, fragment) }
    }
}

pub(super) fn drawn(vertex: String, fragment: String) -> Vec<(u32, String)> {
    vec![(gl::VERTEX_SHADER, vertex), (gl::FRAGMENT_SHADER, fragment)]
}

/// Lookup in texture arrays. Implicit derivatives are undefined in divergent control flow, so with several arrays the
/// derivatives are computed before the array is chosen.
fn sampler(name: &str, unit: u32, arrays: &BTreeSet<usize>, slopes: Slopes) -> String {
    let mut text = String::new();
    let Some(first) = arrays.first() else { return text };
    for index in arrays {
        let unit = unit as usize + index;
        writeln!(text, "layout(binding = {unit}) uniform sampler2DArray {name}_{index};").ok();
    }
    let given = if slopes == Slopes::Given { ", vec2 dx, vec2 dy" } else { "" };
    writeln!(text, "vec4 {name}_texel(ivec2 place, vec2 uv{given}) {{").ok();
    writeln!(text, "    vec3 at = vec3(uv, float(max(place.y, 0)));").ok();
    if slopes == Slopes::OfTheQuad && arrays.len() == 1 {
        writeln!(text, "    return texture({name}_{first}, at);\n}}").ok();
        return text;
    }
    if slopes == Slopes::OfTheQuad {
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
pub(super) enum Slopes {
    /// Differences between the fragments of a quad.
    OfTheQuad,
    /// Arguments of the lookup.
    Given,
}

/// Packs the ids of each pixel's first sample.
pub(super) fn seen(samples: u32) -> Source {
    let head = format!("#version 430 core\n#define LANES {LANES}\n#define SAMPLES {samples}\n");
    let body = [&head, IDS, include_str!("../../shaders/seen.comp")].concat();
    Source { label: format!("seen, {samples} samples"), stages: vec![(gl::COMPUTE_SHADER, body)] }
}

#[cfg(test)]
mod tests {
    use super::super::geometry::tests::squares;
    use super::*;
    use modalcast_model::domain::{AlphaMode, Material};
    use modalcast_model::scene::Scene;

    fn options(alpha_mode: AlphaMode) -> Options {
        let scene = Scene::new(squares(vec![Material { alpha_mode, ..Material::default() }])).expect("good");
        let plan = super::super::plan::plan(&scene);
        let sample_places = vec![[0.375, 0.125], [0.875, 0.375], [0.125, 0.625], [0.625, 0.875]];
        let used = vec![Used { kind: Kind::Opaque, colour: None, normal: None }];
        let resolve = super::super::post::resolve(&scene.look);
        Options { defines: plan.defines, used, shadow: Shadow::default(), sample_places, resolve, post_depth: false }
    }

    fn text(source: Source) -> String {
        source.stages.into_iter().map(|(_, text)| text).collect()
    }

    #[test]
    fn only_cut_out_triangles_have_a_discard_in_their_shader_and_depth_alone_needs_no_fragment_shader() {
        let options = options(AlphaMode::Opaque);
        assert!(!text(options.visibility(Kind::Opaque, 4)).contains("discard;"));
        assert!(!text(options.blended(4)).contains("discard;"));
        for (samples, masks) in [(4, true), (1, false)] {
            let text = text(options.visibility(Kind::Mask, samples));
            assert!(text.contains("discard;") && text.contains(&format!("SAMPLES {samples}")));
            assert_eq!(text.contains("vec2(0.375, 0.125)"), masks, "places of the samples");
        }
        assert_eq!(options.shadow(Kind::Opaque).stages.len(), 1);
    }

    #[test]
    fn the_shading_of_a_plain_scene_knows_no_image_no_shadow_no_ground_and_no_layer() {
        let plain = Options { defines: vec![], ..options(AlphaMode::Opaque) };
        let [backdrop, shading] = [plain.backdrop(4), plain.shade(4)].map(text);
        assert!(!backdrop.contains("vec4 triangle_seen("), "no triangle, no shading of one");
        assert!(shading.contains("vec4 triangle_seen("));
        for text in [&backdrop, &shading] {
            assert!(!text.contains("vec3 ground(") && !text.contains("textureGrad"));
        }
        let used = vec![Used { kind: Kind::Opaque, colour: Some(0), normal: None }];
        let full = Options { defines: vec!["TEXTURES", "UVS", "GROUND_SEEN"], used, ..plain };
        let shading = text(full.shade(1));
        assert!(shading.contains("vec3 ground(") && shading.contains("textureGrad(colour_0"));
    }

    #[test]
    fn each_kind_reads_the_arrays_of_its_own_materials_and_looks_up_a_material_only_among_several() {
        let of = |kind, colour, normal| Used { kind, colour, normal };
        let used = vec![
            of(Kind::Opaque, Some(0), Some(0)),
            of(Kind::Mask, Some(1), None),
            of(Kind::Blend, None, None),
            of(Kind::Blend, Some(2), None),
        ];
        let options = Options { used, ..options(AlphaMode::Opaque) };
        let of = |kinds: &[Kind], slopes| options.branches(kinds) + &options.lookups(kinds, slopes);
        let mask = of(&[Kind::Mask], Slopes::OfTheQuad);
        assert!(mask.contains("texture(colour_1, at)") && !mask.contains("colour_0") && !mask.contains("textureGrad"));
        assert!(mask.contains("#undef NORMAL_MAPS") && !mask.contains("#undef UVS"));
        assert!(mask.contains("ONLY_MATERIAL 1") && mask.contains("#undef LOOK_UP"));
        let blend = of(&[Kind::Blend], Slopes::OfTheQuad);
        assert!(!blend.contains("#undef LOOK_UP") && !blend.contains("#undef TEXTURES"));
        let shade = of(&[Kind::Opaque, Kind::Mask], Slopes::Given);
        assert!(shade.contains("if (place.x == 1) return textureGrad(colour_1") && !shade.contains("dFdx"));
        assert!(shade.contains("normal_0") && !shade.contains("colour_2"));
    }

    #[test]
    fn several_arrays_are_chosen_by_their_number_and_slopes_taken_before() {
        let text = sampler("colour", 1, &BTreeSet::from([0, 2, 3]), Slopes::OfTheQuad);
        let (slopes, choice) = (text.find("dFdx"), text.find("place.x == 2"));
        assert!(slopes.is_some() && slopes < choice, "{text}");
        assert_eq!(sampler("colour", 1, &BTreeSet::new(), Slopes::Given), "");
    }
}
