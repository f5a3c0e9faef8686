//! Post-processing between shading and output bytes, as the look says: bloom, tone curve, anti-aliasing and dithering.
//! Programs contain no code, and frames no images, for features that the look does not use.

use std::fmt::Write as _;
use std::rc::Rc;

use super::Ran;
use super::gl::{self, Gl, Program, Texture, TextureKind};
use super::programs::Compile;
use super::shaders::{LANES, Source, TILE};
use super::target::{Form, Target};
use modalcast_model::error::Result;
use modalcast_model::scene::{Antialias, Bloom, Look, Tone};

const TONE: &str = include_str!("../../shaders/shared/tone.glsl");
const RESOLVE: &str = include_str!("../../shaders/shared/resolve.glsl");
const FXAA: &str = include_str!("../../shaders/shared/fxaa.glsl");
const VERSION: &str = "#version 430 core\n";
/// Maximum light of a sample: far above white, and well within half precision.
const MOST_LIGHT: f32 = 1000.0;

/// The post-processing programs of one look.
#[derive(Debug)]
pub(super) struct Post {
    encode: Rc<Program>,
    glow: Option<Glow>,
}

/// The bloom programs: downsample, upsample, and the last upsample onto the picture.
#[derive(Debug)]
struct Glow {
    down: Rc<Program>,
    up: Rc<Program>,
    last: Rc<Program>,
}

impl Post {
    pub(super) fn compile(look: &Look, compile: &mut Compile<'_>) -> Result<Self> {
        let glow = match look.bloom {
            Some(bloom) => Some(Glow {
                down: compile(down())?,
                up: compile(up(look, bloom, false))?,
                last: compile(up(look, bloom, true))?,
            }),
            None => None,
        };
        Ok(Self { encode: compile(encode(look))?, glow })
    }

    /// Spreads the bright light over the picture and applies the tone curve, in place.
    pub(super) fn bloom(&self, gl: &Gl, target: &Target, ran: &mut Ran) -> Result<()> {
        let (Some(glow), Some(coarsest)) = (&self.glow, target.glow.last()) else { return Ok(()) };
        glow.down.bind(None);
        for (from, to) in target.glow.iter().zip(target.glow.iter().skip(1)) {
            from.bind(0);
            to.bind_image(0);
            tiles(gl, to);
        }
        let mut from = coarsest;
        for (coarser, to) in (1..).zip(target.glow.iter().skip(1).rev().skip(1)) {
            glow.up.bind(Some(coarser));
            from.bind(0);
            to.bind_image_both_ways(0);
            tiles(gl, to);
            from = to;
        }
        // The last program has no uniform for the number of levels.
        glow.last.bind(None);
        from.bind(0);
        target.picture.bind_image_both_ways(0);
        tiles(gl, &target.picture);
        ran.passes.push("bloom");
        gl.check("bloom")
    }

    /// Encodes the picture to bytes in a buffer that can be copied to the host.
    pub(super) fn encode(&self, gl: &Gl, target: &Target, ran: &mut Ran) -> Result<()> {
        self.encode.bind(None);
        target.picture.bind(0);
        target.packed.bind_storage(super::passes::PIXELS);
        gl.dispatch(target.form.width.div_ceil(LANES), target.form.height);
        ran.passes.push("encode");
        gl.check("encode")
    }
}

fn tiles(gl: &Gl, of: &Texture) {
    gl.dispatch(of.kind.width.div_ceil(TILE), of.kind.height.div_ceil(TILE));
}

/// The bloom pyramid: the bright light of each pixel, then levels of half the size, rounded up.
pub(super) fn glow(gl: &Rc<Gl>, form: Form) -> Result<Vec<Texture>> {
    if form.halvings == 0 {
        return Ok(Vec::new());
    }
    let half = |level: u32| {
        let [width, height] = [form.width, form.height].map(|side| side.div_ceil(1 << level));
        let kind = TextureKind { target: gl::TEXTURE_2D, format: gl::RGBA16F, width, height, depth: 1, levels: 1 };
        let texture = gl.texture(kind)?;
        texture.sampling(&[(gl::TEXTURE_MIN_FILTER, gl::NEAREST), (gl::TEXTURE_MAG_FILTER, gl::NEAREST)], 1.0);
        Ok(texture)
    };
    (0..=form.halvings).map(half).collect()
}

/// Shader source that the shading applies to the light of each sample.
pub(super) fn resolve(look: &Look) -> String {
    let mut text = String::new();
    if look.exposure != 1.0 {
        writeln!(text, "#define EXPOSURE {:?}", look.exposure).ok();
    }
    if let Some(Bloom { threshold, strength, .. }) = look.bloom {
        write!(text, "#define BLOOM\n#define THRESHOLD {threshold:?}\n#define STRENGTH {strength:?}\n").ok();
    }
    [&text, &curve(look), RESOLVE].concat()
}

/// Shader source of the tone curve and its inverse.
fn curve(look: &Look) -> String {
    let name = match look.tone {
        Tone::None => "",
        Tone::Reinhard => "#define REINHARD\n",
        Tone::Aces => "#define ACES\n",
    };
    format!("#define MOST_LIGHT {MOST_LIGHT:?}\n{name}{TONE}")
}

fn down() -> Source {
    let head = format!("{VERSION}#define TILE {TILE}\n");
    compute("bloom, half", head + include_str!("../../shaders/bloom_down.comp"))
}

fn up(look: &Look, bloom: Bloom, last: bool) -> Source {
    let mut text = format!("{VERSION}#define TILE {TILE}\n");
    if last {
        write!(text, "#define LAST\n#define STRENGTH {:?}\n", bloom.strength).ok();
        text += &curve(look);
    }
    text += include_str!("../../shaders/bloom_up.comp");
    compute(if last { "bloom, onto the picture" } else { "bloom, double" }, text)
}

/// Converts the picture to sRGB bytes.
fn encode(look: &Look) -> Source {
    let mut text = format!("{VERSION}#define LANES {LANES}\nlayout(binding = 0) uniform sampler2D picture;\n");
    if look.dither {
        text += "#define DITHER\n";
    }
    if look.antialias == Antialias::Fxaa {
        text += "#define FXAA\n";
        text += FXAA;
    }
    text += include_str!("../../shaders/encode.comp");
    compute("encode", text)
}

fn compute(label: &str, text: String) -> Source {
    Source { label: label.into(), stages: vec![(gl::COMPUTE_SHADER, text)] }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn text(source: Source) -> String {
        source.stages.into_iter().map(|(_, text)| text).collect()
    }

    #[test]
    fn a_look_that_names_nothing_has_no_curve_no_glow_no_search_and_no_pattern() {
        let plain = Look::default();
        let encode_text = text(encode(&plain));
        assert!(!encode_text.contains("#define FXAA") && !encode_text.contains("smoothed(ivec2 at) {"));
        assert!(!encode_text.contains("#define DITHER"));
        let shading = resolve(&plain);
        for define in ["EXPOSURE", "BLOOM", "STRENGTH", "REINHARD", "ACES"] {
            assert!(!shading.contains(&format!("#define {define}")), "{define}");
        }
        let named = Look { tone: Tone::Aces, exposure: 1.5, antialias: Antialias::Fxaa, dither: true, ..plain };
        let (encode_text, shading) = (text(encode(&named)), resolve(&named));
        assert!(encode_text.contains("#define FXAA") && encode_text.contains("smoothed(ivec2 at) {"));
        assert!(encode_text.contains("#define DITHER"));
        assert!(shading.contains("#define EXPOSURE 1.5\n") && shading.contains("#define ACES"));
    }
}
