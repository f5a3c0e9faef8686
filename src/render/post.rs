//! Post-processing between shading and output bytes, as the look says: bloom, tone curve, anti-aliasing and dithering.
//! Programs contain no code, and frames no images, for features that the look does not use.

use std::fmt::Write as _;
use std::rc::Rc;

use super::FrameStats;
use super::programs::ProgramCompiler;
use super::shaders::{ProgramSource, TILE, WORKGROUP_SIZE};
use super::target::{RenderTarget, TargetDesc};
use crate::device::gl::{self, Gl, Program, Texture, TextureDesc};
use modalcast_model::error::Result;
use modalcast_model::scene::{Antialiasing, Bloom, RenderSettings, ToneMapping};

const TONE_MAPPING: &str = include_str!("../../shaders/shared/tone_mapping.glsl");
const SAMPLE_RESOLVE: &str = include_str!("../../shaders/shared/sample_resolve.glsl");
const FXAA: &str = include_str!("../../shaders/shared/fxaa.glsl");
const VERSION: &str = "#version 430 core\n";
/// Maximum light of a sample: far above white, and well within half precision.
const MAX_RADIANCE: f32 = 1000.0;

/// The post-processing programs of one look.
#[derive(Debug)]
pub(crate) struct PostProcess {
    encode: Rc<Program>,
    bloom: Option<BloomPrograms>,
}

/// The bloom programs: downsample, upsample, and the last upsample onto the picture.
#[derive(Debug)]
struct BloomPrograms {
    down: Rc<Program>,
    up: Rc<Program>,
    last: Rc<Program>,
}

impl PostProcess {
    pub(crate) fn compile(look: &RenderSettings, compile: &mut ProgramCompiler<'_>) -> Result<Self> {
        let bloom = match look.bloom {
            Some(bloom) => Some(BloomPrograms {
                down: compile(bloom_downsample())?,
                up: compile(bloom_upsample(look, bloom, false))?,
                last: compile(bloom_upsample(look, bloom, true))?,
            }),
            None => None,
        };
        Ok(Self { encode: compile(encode(look))?, bloom })
    }

    /// Spreads the bright light over the picture and applies the tone curve, in place.
    pub(crate) fn bloom(&self, gl: &Gl, target: &RenderTarget, stats: &mut FrameStats) -> Result<()> {
        let (Some(bloom), Some(coarsest)) = (&self.bloom, target.bloom_mips.last()) else { return Ok(()) };
        bloom.down.bind(None);
        for (from, to) in target.bloom_mips.iter().zip(target.bloom_mips.iter().skip(1)) {
            from.bind(0);
            to.bind_image(0);
            dispatch_tiles(gl, to);
        }
        let mut from = coarsest;
        for (coarser, to) in (1..).zip(target.bloom_mips.iter().skip(1).rev().skip(1)) {
            bloom.up.bind(Some(coarser));
            from.bind(0);
            to.bind_image_read_write(0);
            dispatch_tiles(gl, to);
            from = to;
        }
        // The last program has no uniform for the number of levels.
        bloom.last.bind(None);
        from.bind(0);
        target.scene_color.bind_image_read_write(0);
        dispatch_tiles(gl, &target.scene_color);
        stats.passes.push("bloom");
        gl.check("bloom")
    }

    /// Encodes the picture to bytes in a buffer that can be copied to the host.
    pub(crate) fn encode(&self, gl: &Gl, target: &RenderTarget, stats: &mut FrameStats) -> Result<()> {
        self.encode.bind(None);
        target.scene_color.bind(0);
        target.readback_source.bind_storage(super::passes::PIXELS);
        gl.dispatch(target.desc.width.div_ceil(WORKGROUP_SIZE), target.desc.height);
        stats.passes.push("encode");
        gl.check("encode")
    }
}

fn dispatch_tiles(gl: &Gl, of: &Texture) {
    gl.dispatch(of.desc.width.div_ceil(TILE), of.desc.height.div_ceil(TILE));
}

/// The bloom pyramid: the bright light of each pixel, then levels of half the size, rounded up.
pub(crate) fn bloom_mips(gl: &Rc<Gl>, desc: TargetDesc) -> Result<Vec<Texture>> {
    if desc.bloom_levels == 0 {
        return Ok(Vec::new());
    }
    let half = |level: u32| {
        let [width, height] = [desc.width, desc.height].map(|side| side.div_ceil(1 << level));
        let desc = TextureDesc { target: gl::TEXTURE_2D, format: gl::RGBA16F, width, height, depth: 1, levels: 1 };
        let texture = gl.texture(desc)?;
        texture.set_sampling(&[(gl::TEXTURE_MIN_FILTER, gl::NEAREST), (gl::TEXTURE_MAG_FILTER, gl::NEAREST)], 1.0);
        Ok(texture)
    };
    (0..=desc.bloom_levels).map(half).collect()
}

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

fn bloom_downsample() -> ProgramSource {
    let head = format!("{VERSION}#define TILE {TILE}\n");
    compute("bloom, half", head + include_str!("../../shaders/bloom_downsample.comp"))
}

fn bloom_upsample(look: &RenderSettings, bloom: Bloom, last: bool) -> ProgramSource {
    let mut text = format!("{VERSION}#define TILE {TILE}\n");
    if last {
        write!(text, "#define COMPOSITE\n#define BLOOM_STRENGTH {:?}\n", bloom.strength).ok();
        text += &tone_curve(look);
    }
    text += include_str!("../../shaders/bloom_upsample.comp");
    compute(if last { "bloom, onto the picture" } else { "bloom, double" }, text)
}

/// Converts the picture to sRGB bytes.
fn encode(look: &RenderSettings) -> ProgramSource {
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
    text += include_str!("../../shaders/encode_srgb.comp");
    compute("encode", text)
}

fn compute(label: &str, text: String) -> ProgramSource {
    ProgramSource { label: label.into(), stages: vec![(gl::COMPUTE_SHADER, text)] }
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
