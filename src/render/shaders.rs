//! Shader sources to programs: the files under `shaders/`, with the branches that a scene needs and no others.

use std::fmt::Write as _;

use super::geometry::Kind;
use super::gl;
use crate::scene::Shadow;

pub(super) const FRAME: &str = include_str!("../../shaders/shared/frame.glsl");
pub(super) const MATERIAL: &str = include_str!("../../shaders/shared/material.glsl");
const CUT_OUT: &str = include_str!("../../shaders/shared/cut_out.glsl");
pub(super) const CASTER: &str = include_str!("../../shaders/shared/caster.glsl");
const SKY: &str = include_str!("../../shaders/shared/sky.glsl");

/// First texture unit of each use.
pub(super) const SHADOW_UNIT: u32 = 0;
pub(super) const COLOUR_UNIT: u32 = 1;
pub(super) const NORMAL_UNIT: u32 = COLOUR_UNIT + super::textures::MAX_ARRAYS as u32;
/// Units of the buffer textures, as the shaders name them.
pub(super) const POSITION_UNIT: u32 = 13;
pub(super) const MATERIAL_UNIT: u32 = 14;
pub(super) const TRIANGLE_MATERIAL_UNIT: u32 = 15;
const _: () = assert!(NORMAL_UNIT + super::textures::MAX_ARRAYS as u32 <= POSITION_UNIT, "texture units overlap");

/// Lanes of a compute workgroup, along x.
pub(super) const LANES: u32 = 64;

/// What the sources depend on.
#[derive(Debug, Clone)]
pub(super) struct Options {
    pub(super) defines: Vec<&'static str>,
    pub(super) colour_arrays: usize,
    pub(super) normal_arrays: usize,
    /// The shadow map as the device is given it; what it says counts where the defines name shadows.
    pub(super) shadow: Shadow,
    /// Samples a pixel of an ordinary picture.
    pub(super) samples: u32,
}

/// The text of a program's stages.
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

    /// The same for triangles of one material: without the images that it has not, and with the one array of each use
    /// that is bound for it.
    pub(super) fn narrowed(&self, colour: bool, normal: bool) -> Self {
        let keeps = |define: &&'static str| match *define {
            "TEXTURES" => colour,
            "NORMAL_MAPS" => normal,
            "UVS" => colour || normal,
            _ => true,
        };
        Self {
            defines: self.defines.iter().copied().filter(keeps).collect(),
            colour_arrays: usize::from(colour),
            normal_arrays: usize::from(normal),
            ..*self
        }
    }

    /// Draws triangles of one kind into the picture.
    pub(super) fn surface(&self, kind: Kind, samples: u32) -> Source {
        let more: &[&str] = match kind {
            Kind::Opaque => &[],
            Kind::Mask if samples > 1 => &["MASK", "MULTISAMPLED"],
            Kind::Mask => &["MASK"],
            Kind::Blend => &["BLEND"],
        };
        let head = self.head(more);
        let vertex = [&head, FRAME, include_str!("../../shaders/surface.vert")].concat();
        let cut_out = if kind == Kind::Mask { CUT_OUT } else { "" };
        let body = include_str!("../../shaders/surface.frag");
        let fragment = [&head, FRAME, MATERIAL, &self.samplers(), cut_out, &self.sun(), body].concat();
        Source {
            label: format!("surface, {kind:?}, {samples} samples"),
            stages: vec![(gl::VERTEX_SHADER, vertex), (gl::FRAGMENT_SHADER, fragment)],
        }
    }

    pub(super) fn ground(&self) -> Source {
        let head = self.head(&[]);
        let vertex = [&head, FRAME, include_str!("../../shaders/ground.vert")].concat();
        let fragment = [&head, FRAME, &self.sun(), SKY, include_str!("../../shaders/ground.frag")].concat();
        Source { label: "ground".into(), stages: vec![(gl::VERTEX_SHADER, vertex), (gl::FRAGMENT_SHADER, fragment)] }
    }

    pub(super) fn sky(&self) -> Source {
        let head = self.head(&[]);
        let vertex = [&head, FRAME, include_str!("../../shaders/sky.vert")].concat();
        let fragment = [&head, FRAME, SKY, include_str!("../../shaders/sky.frag")].concat();
        Source { label: "sky".into(), stages: vec![(gl::VERTEX_SHADER, vertex), (gl::FRAGMENT_SHADER, fragment)] }
    }

    /// The lookup in the texture arrays: sampling must not hang on a number that differs within a quad, so that with
    /// several arrays the gradients are taken first.
    pub(super) fn samplers(&self) -> String {
        let mut text = String::new();
        let uses = [("colour", COLOUR_UNIT, self.colour_arrays), ("normal", NORMAL_UNIT, self.normal_arrays)];
        for (name, unit, count) in uses.into_iter().filter(|(_, _, count)| *count > 0) {
            for index in 0..count {
                let unit = unit as usize + index;
                writeln!(text, "layout(binding = {unit}) uniform sampler2DArray {name}_{index};").ok();
            }
            writeln!(text, "vec4 {name}_texel(ivec2 place, vec2 uv) {{").ok();
            writeln!(text, "    vec3 at = vec3(uv, float(max(place.y, 0)));").ok();
            if count == 1 {
                writeln!(text, "    return texture({name}_0, at);\n}}").ok();
                continue;
            }
            writeln!(text, "    vec2 dx = dFdx(uv), dy = dFdy(uv);\n    switch (place.x) {{").ok();
            for index in 1..count {
                writeln!(text, "    case {index}: return textureGrad({name}_{index}, at, dx, dy);").ok();
            }
            writeln!(text, "    default: return textureGrad({name}_0, at, dx, dy);\n    }}\n}}").ok();
        }
        text
    }
}

/// Turns the samples of the picture into sRGB bytes.
pub(super) fn encode(samples: u32) -> Source {
    let head = format!("#version 430 core\n#define SAMPLES {samples}\n#define LANES {LANES}\n");
    let body = [&head, include_str!("../../shaders/encode.comp")].concat();
    Source { label: format!("encode, {samples} samples"), stages: vec![(gl::COMPUTE_SHADER, body)] }
}

#[cfg(test)]
mod tests {
    use super::super::geometry::tests::squares;
    use super::*;
    use crate::domain::{AlphaMode, Material};
    use crate::scene::Scene;

    fn options(alpha_mode: AlphaMode) -> Options {
        let scene = Scene::new(squares(vec![Material { alpha_mode, ..Material::default() }])).expect("good");
        let plan = super::super::plan::plan(&scene);
        Options { defines: plan.defines, colour_arrays: 0, normal_arrays: 0, shadow: Shadow::default(), samples: 4 }
    }

    #[test]
    fn only_cut_out_triangles_have_a_discard_in_their_shader() {
        let text = |source: Source| source.stages.into_iter().map(|(_, text)| text).collect::<String>();
        let options = options(AlphaMode::Opaque);
        assert!(!text(options.surface(Kind::Opaque, 4)).contains("discard"));
        assert!(!text(options.surface(Kind::Blend, 4)).contains("discard"));
        assert!(text(options.surface(Kind::Mask, 4)).contains("discard"));
        assert_eq!(options.shadow(Kind::Opaque).stages.len(), 1, "depth alone needs no fragment shader");
    }

    #[test]
    fn a_material_without_images_gets_a_program_without_lookups() {
        let full = Options { defines: vec!["TEXTURES", "NORMAL_MAPS", "UVS", "SHADOWS"], ..options(AlphaMode::Opaque) };
        assert_eq!(full.narrowed(false, false).defines, ["SHADOWS"]);
        assert_eq!(full.narrowed(true, false).defines, ["TEXTURES", "UVS", "SHADOWS"]);
        assert_eq!(full.narrowed(false, true).normal_arrays, 1);
    }

    #[test]
    fn several_arrays_are_chosen_by_a_switch_and_one_is_read_directly() {
        let mut options = options(AlphaMode::Opaque);
        assert_eq!(options.samplers(), "");
        options.colour_arrays = 1;
        assert!(!options.samplers().contains("switch"));
        options.colour_arrays = 3;
        assert!(options.samplers().contains("case 2: return textureGrad(colour_2"));
    }
}
