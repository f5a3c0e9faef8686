//! Shader sources of the ambient light and of the ambient occlusion.

use std::fmt::Write as _;

use super::{BAND, BARYCENTRICS, CLIP, FRAME, GROUND_PLANE, ProgramSource, ShaderOptions, VISIBILITY_IDS};
use crate::layout::TILE;
use crate::layout::ambient::AmbientSampling;
use modalcast_model::scene::StudioLight;

const AMBIENT_LIGHT: &str = include_str!("../../../shaders/shared/ambient_light.glsl");
const OCTAHEDRAL: &str = include_str!("../../../shaders/shared/octahedral.glsl");
const AMBIENT_TEXEL: &str = include_str!("../../../shaders/shared/ambient_texel.glsl");
const AMBIENT_VISIBILITY: &str = include_str!("../../../shaders/shared/ambient_visibility.glsl");

/// Largest radius of the ambient occlusion in the image, as a fraction of the image height.
const MAX_REACH: f32 = 0.35;

/// GLSL constants of the sampling, and functions on texels.
fn ambient_texel(AmbientSampling { scale, slices, steps, noise, rotation_stride }: AmbientSampling) -> String {
    let constants = [
        ("AMBIENT_SCALE", scale),
        ("AMBIENT_NOISE", noise),
        ("SLICES", slices),
        ("STEPS", steps),
        ("ROTATION_STRIDE", rotation_stride),
    ];
    let mut text = format!("#define MAX_REACH {MAX_REACH:?}\n");
    for (name, value) in constants {
        writeln!(text, "#define {name} {value}").ok();
    }
    text + AMBIENT_TEXEL
}

/// GLSL function `ambient_light`, with the colors of a studio as constants.
pub(crate) fn ambient_light(studio: Option<StudioLight>) -> String {
    let mut text = String::new();
    if let Some(StudioLight { ambient_cube, fill }) = studio {
        let vector = |[r, g, b]: [f32; 3]| format!("vec3({r:?}, {g:?}, {b:?})");
        let sides = ambient_cube.map(vector).join(", ");
        writeln!(text, "#define STUDIO\nconst vec3 AMBIENT_CUBE[6] = vec3[]({sides});").ok();
        writeln!(text, "const vec3 FILL = {};", vector(fill)).ok();
    }
    text + AMBIENT_LIGHT
}

impl ShaderOptions {
    /// GLSL function `ambient_visibility_of`, and the define that makes the shading call it; empty without ambient
    /// occlusion. The frame block and the sample defines must precede it.
    pub(crate) fn ambient_visibility(&self) -> String {
        let Some(sampling) = self.features.ambient_occlusion else { return String::new() };
        ["#define AMBIENT_OCCLUSION\n", &ambient_texel(sampling), AMBIENT_VISIBILITY].concat()
    }

    /// Program that finds the surface at each texel.
    pub(crate) fn ambient_surface(&self, sampling: AmbientSampling, samples: u32) -> ProgramSource {
        let body = include_str!("../../../shaders/ambient_surface.comp");
        let text = [&self.ambient_head(sampling, samples), BARYCENTRICS, body].concat();
        ProgramSource::compute(format!("ambient surface, {samples} samples"), text)
    }

    /// Program that computes the visibility of these surfaces.
    pub(crate) fn ambient_occlusion(&self, sampling: AmbientSampling, samples: u32) -> ProgramSource {
        let text = self.ambient_head(sampling, samples) + include_str!("../../../shaders/ambient_occlusion.comp");
        ProgramSource::compute(format!("ambient occlusion, {samples} samples"), text)
    }

    /// Program that filters the noise of the visibility.
    pub(crate) fn ambient_filter(&self, sampling: AmbientSampling, samples: u32) -> ProgramSource {
        let text = self.ambient_head(sampling, samples) + include_str!("../../../shaders/ambient_filter.comp");
        ProgramSource::compute(format!("ambient filter, {samples} samples"), text)
    }

    fn ambient_head(&self, sampling: AmbientSampling, samples: u32) -> String {
        let ground = if self.features.ground { "#define HAS_GROUND\n" } else { "" };
        let head = format!("{}#define TILE {TILE}\n{ground}", super::VERSION);
        let samples = self.sample_defines(samples);
        [
            &head,
            &samples,
            BAND,
            FRAME,
            CLIP,
            VISIBILITY_IDS,
            GROUND_PLANE,
            super::SAFE_NORMALIZE,
            OCTAHEDRAL,
            &ambient_texel(sampling),
        ]
        .concat()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn light_of_outdoor_scenes_has_no_constants() {
        assert!(!ambient_light(None).contains("#define STUDIO"));
        let studio = StudioLight { ambient_cube: [[0.5; 3]; 6], fill: [0.25, 0.5, 1.0] };
        let text = ambient_light(Some(studio));
        assert!(text.contains("#define STUDIO\n") && text.contains("FILL = vec3(0.25, 0.5, 1.0);"), "{text}");
    }
}
