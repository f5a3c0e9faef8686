//! Shader sources of post-processing: bloom, tone curve, anti-aliasing, dithering and sRGB encoding. They contain only
//! features that the look uses.

use std::fmt::Write as _;

use super::{BAND, ProgramSource, VERSION};
use crate::layout::{TILE, WORKGROUP_SIZE};
use modalcast_model::scene::{Antialiasing, Bloom, RenderSettings, ToneMapping};

const TONE_MAPPING: &str = include_str!("../../../shaders/shared/tone_mapping.glsl");
const SAMPLE_RESOLVE: &str = include_str!("../../../shaders/shared/sample_resolve.glsl");
const FXAA: &str = include_str!("../../../shaders/shared/fxaa.glsl");
/// Maximum radiance of a sample: far above white, and far below the f16 maximum of 65504.
const MAX_RADIANCE: f32 = 1000.0;

/// GLSL that the shading applies to each sample: exposure, bloom threshold and tone curve.
pub(crate) fn sample_resolve(look: &RenderSettings) -> String {
    let mut defines = String::new();
    if look.exposure != 1.0 {
        writeln!(defines, "#define EXPOSURE {:?}", look.exposure).ok();
    }
    if let Some(Bloom { threshold, strength, .. }) = look.bloom {
        write!(defines, "#define BLOOM\n#define BLOOM_THRESHOLD {threshold:?}\n#define BLOOM_STRENGTH {strength:?}\n")
            .ok();
    }
    [&defines, &tone_curve(look), SAMPLE_RESOLVE].concat()
}

/// GLSL functions of the tone curve and its inverse.
fn tone_curve(look: &RenderSettings) -> String {
    let define = match look.tone {
        ToneMapping::None => "",
        ToneMapping::Reinhard => "#define REINHARD\n",
        ToneMapping::Aces => "#define ACES\n",
    };
    format!("#define MAX_RADIANCE {MAX_RADIANCE:?}\n{define}{TONE_MAPPING}")
}

/// Computes the next level of the bloom pyramid.
pub(crate) fn bloom_downsample() -> ProgramSource {
    let head = format!("{VERSION}#define TILE {TILE}\n{BAND}");
    ProgramSource::compute("bloom downsample", head + include_str!("../../../shaders/bloom_downsample.comp"))
}

/// Adds a level of the bloom pyramid to the next finer one, or, as the composite program, to the scene color.
pub(crate) fn bloom_upsample(look: &RenderSettings, bloom: Bloom, is_composite: bool) -> ProgramSource {
    let mut text = format!("{VERSION}#define TILE {TILE}\n{BAND}");
    if is_composite {
        write!(text, "#define COMPOSITE\n#define BLOOM_STRENGTH {:?}\n", bloom.strength).ok();
        text += &tone_curve(look);
    }
    text += include_str!("../../../shaders/bloom_upsample.comp");
    ProgramSource::compute(if is_composite { "bloom composite" } else { "bloom upsample" }, text)
}

/// Encodes the scene color to sRGB bytes.
pub(crate) fn encode(look: &RenderSettings, antialias: Antialiasing) -> ProgramSource {
    let mut text = format!(
        "{VERSION}#define WORKGROUP_SIZE {WORKGROUP_SIZE}\n{BAND}layout(binding = 0) uniform sampler2D scene_color;\n"
    );
    if look.dither {
        text += "#define DITHER\n";
    }
    if antialias == Antialiasing::Fxaa {
        text += "#define FXAA\n";
        text += FXAA;
    }
    text += include_str!("../../../shaders/encode_srgb.comp");
    ProgramSource::compute("encode", text)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn text(source: ProgramSource) -> String {
        source.stages.into_iter().map(|(_, text)| text).collect()
    }

    #[test]
    fn sources_contain_only_features_of_the_look() {
        let default_look = RenderSettings::default();
        let encode_text = text(encode(&default_look, default_look.antialias));
        assert!(!encode_text.contains("#define FXAA") && !encode_text.contains("fxaa_color(ivec2 pixel) {"));
        assert!(!encode_text.contains("#define DITHER"));
        let resolve_text = sample_resolve(&default_look);
        for define in ["EXPOSURE", "BLOOM", "BLOOM_STRENGTH", "REINHARD", "ACES"] {
            assert!(!resolve_text.contains(&format!("#define {define}")), "{define}");
        }
        let full_look = RenderSettings {
            tone: ToneMapping::Aces,
            exposure: 1.5,
            antialias: Antialiasing::Fxaa,
            dither: true,
            ..default_look
        };
        let (encode_text, resolve_text) = (text(encode(&full_look, full_look.antialias)), sample_resolve(&full_look));
        assert!(encode_text.contains("#define FXAA") && encode_text.contains("fxaa_color(ivec2 pixel) {"));
        assert!(encode_text.contains("#define DITHER"));
        assert!(resolve_text.contains("#define EXPOSURE 1.5\n") && resolve_text.contains("#define ACES"));
    }
}
