//! Shader sources of post-processing: bloom, tone curve, anti-aliasing, dithering and encoding. They contain no code for
//! features that the look does not use.

use std::fmt::Write as _;

use super::{ProgramSource, VERSION};
use crate::layout::{TILE, WORKGROUP_SIZE};
use modalcast_model::scene::{Antialiasing, Bloom, RenderSettings, ToneMapping};

const TONE_MAPPING: &str = include_str!("../../../shaders/shared/tone_mapping.glsl");
const SAMPLE_RESOLVE: &str = include_str!("../../../shaders/shared/sample_resolve.glsl");
const FXAA: &str = include_str!("../../../shaders/shared/fxaa.glsl");
/// Maximum light of a sample: far above white, and well within half precision.
const MAX_RADIANCE: f32 = 1000.0;

/// Shader source that the shading applies to the light of each sample.
pub(crate) fn sample_resolve(look: &RenderSettings) -> String {
    let mut text = String::new();
    if look.exposure != 1.0 {
        writeln!(text, "#define EXPOSURE {:?}", look.exposure).ok();
    }
    if let Some(Bloom { threshold, strength, .. }) = look.bloom {
        write!(text, "#define BLOOM\n#define BLOOM_THRESHOLD {threshold:?}\n#define BLOOM_STRENGTH {strength:?}\n")
            .ok();
    }
    [&text, &tone_curve(look), SAMPLE_RESOLVE].concat()
}

/// Shader source of the tone curve and its inverse.
fn tone_curve(look: &RenderSettings) -> String {
    let name = match look.tone {
        ToneMapping::None => "",
        ToneMapping::Reinhard => "#define REINHARD\n",
        ToneMapping::Aces => "#define ACES\n",
    };
    format!("#define MAX_RADIANCE {MAX_RADIANCE:?}\n{name}{TONE_MAPPING}")
}

pub(crate) fn bloom_downsample() -> ProgramSource {
    let head = format!("{VERSION}#define TILE {TILE}\n");
    ProgramSource::compute("bloom, half", head + include_str!("../../../shaders/bloom_downsample.comp"))
}

pub(crate) fn bloom_upsample(look: &RenderSettings, bloom: Bloom, last: bool) -> ProgramSource {
    let mut text = format!("{VERSION}#define TILE {TILE}\n");
    if last {
        write!(text, "#define COMPOSITE\n#define BLOOM_STRENGTH {:?}\n", bloom.strength).ok();
        text += &tone_curve(look);
    }
    text += include_str!("../../../shaders/bloom_upsample.comp");
    ProgramSource::compute(if last { "bloom, onto the picture" } else { "bloom, double" }, text)
}

/// Converts the picture to sRGB bytes.
pub(crate) fn encode(look: &RenderSettings) -> ProgramSource {
    let mut text = format!(
        "{VERSION}#define WORKGROUP_SIZE {WORKGROUP_SIZE}\nlayout(binding = 0) uniform sampler2D scene_color;\n"
    );
    if look.dither {
        text += "#define DITHER\n";
    }
    if look.antialias == Antialiasing::Fxaa {
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
    fn a_look_that_names_nothing_has_no_curve_no_glow_no_search_and_no_pattern() {
        let plain = RenderSettings::default();
        let encode_text = text(encode(&plain));
        assert!(!encode_text.contains("#define FXAA") && !encode_text.contains("fxaa_color(ivec2 at) {"));
        assert!(!encode_text.contains("#define DITHER"));
        let shading = sample_resolve(&plain);
        for define in ["EXPOSURE", "BLOOM", "BLOOM_STRENGTH", "REINHARD", "ACES"] {
            assert!(!shading.contains(&format!("#define {define}")), "{define}");
        }
        let named = RenderSettings {
            tone: ToneMapping::Aces,
            exposure: 1.5,
            antialias: Antialiasing::Fxaa,
            dither: true,
            ..plain
        };
        let (encode_text, shading) = (text(encode(&named)), sample_resolve(&named));
        assert!(encode_text.contains("#define FXAA") && encode_text.contains("fxaa_color(ivec2 at) {"));
        assert!(encode_text.contains("#define DITHER"));
        assert!(shading.contains("#define EXPOSURE 1.5\n") && shading.contains("#define ACES"));
    }
}
