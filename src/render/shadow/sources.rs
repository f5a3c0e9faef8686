//! Shader sources of the shadow passes: casters, blur and lookup, with the branches that the scene's shadow method
//! needs.

use std::fmt::Write as _;

use super::super::geometry::Kind;
use super::super::gl;
use super::super::shaders::{CASTER, DRAWN, FRAME, LANES, Options, Slopes, Source, drawn};
use super::strip::Strip;
use modalcast_model::scene::{Blurring, Moments, Shadow, ShadowMethod};

const SUN: &str = include_str!("../../../shaders/shared/sun.glsl");
const SPLITS: &str = include_str!("../../../shaders/shared/splits.glsl");
const MOMENTS: &str = include_str!("../../../shaders/shared/moments.glsl");

/// Consecutive texels that one invocation of the blur writes, along its direction.
pub(crate) const RUN: u32 = 8;
/// Lanes of a workgroup that blurs a tile.
const TILE_LANES: u32 = 256;
/// Bytes of shared memory that every device gives a workgroup.
pub(super) const SHARED_BYTES: u32 = 32 << 10;

/// Defines of a shadow method.
pub(crate) fn defines(shadow: &Shadow) -> impl Iterator<Item = &'static str> {
    let method = match shadow.method {
        ShadowMethod::Variance => "VARIANCE",
        ShadowMethod::Standard => "STANDARD",
        ShadowMethod::Filtered => "FILTERED",
    };
    let splits = ["SPLITS 2", "SPLITS 3", "SPLITS 4"].get((shadow.splits as usize).wrapping_sub(2)).copied();
    ["SHADOWS", method].into_iter().chain(splits)
}

/// Columns and rows of the map that one workgroup writes when both directions are blurred in one pass.
pub(crate) fn made_at_once(shadow: &Shadow) -> [u32; 2] {
    let tile = Tile::of(shadow);
    Strip::of(shadow).map_or([tile.wide, tile.tall], |strip| [strip.wide, strip.tall])
}

/// The tile of a workgroup: its width and height in texels, and the number of depth rows that it holds at once.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Tile {
    wide: u32,
    tall: u32,
    band: u32,
    reach: u32,
}

impl Tile {
    /// The first of these sizes that fits into shared memory; a wider blur kernel needs smaller tiles.
    fn of(shadow: &Shadow) -> Self {
        let reach = shadow.reach();
        let sizes = [(32, 64, 256), (32, 48, 256), (32, 32, 256), (32, 32, 32), (16, 64, 32), (16, 64, 16)];
        // All rows at once if they fit: a second band would leave most lanes idle.
        let tiles = sizes.map(|(wide, tall, band)| Self { wide, tall, band: (tall + 2 * reach).min(band), reach });
        tiles.into_iter().find(|tile| tile.bytes() <= SHARED_BYTES).unwrap_or(tiles[sizes.len() - 1])
    }

    /// Floats from one row of depths to the next; odd, which avoids bank conflicts.
    const fn depth_pitch(&self) -> u32 {
        (self.wide + 2 * self.reach) | 1
    }

    /// Moment pairs from one blurred row to the next.
    const fn pitch(&self) -> u32 {
        self.wide + 1
    }

    const fn bytes(&self) -> u32 {
        4 * self.band * self.depth_pitch() + 8 * (self.tall + 2 * self.reach) * self.pitch()
    }
}

impl Options {
    /// Source of `lit`, the share of the sun's light that reaches a point.
    pub(crate) fn sun(&self) -> String {
        let mut text = String::new();
        if self.has("VARIANCE") {
            writeln!(text, "const float DEVIATION = {:?};", self.shadow.deviation() as f32).ok();
        }
        if self.has("FILTERED") {
            let taps = weights(self.shadow.blur);
            writeln!(text, "#define REACH {}", taps.len() - 1).ok();
            let list: String = taps.iter().map(|weight| format!("{weight:?}, ")).collect();
            writeln!(text, "const float TAPS[REACH + 2] = float[]({list}0.0);").ok();
        }
        text + self.splits() + SUN
    }

    pub(crate) fn splits(&self) -> &'static str {
        if self.shadow.splits > 1 && self.has("SHADOWS") { SPLITS } else { "" }
    }

    fn has(&self, define: &str) -> bool {
        self.defines.contains(&define)
    }

    /// Draws one kind of triangle into the shadow map; opaque ones need no fragment shader.
    pub(crate) fn shadow(&self, kind: Kind) -> Source {
        let label = format!("shadow, {kind:?}");
        let vertex = |head: &str| [head, FRAME, self.splits(), include_str!("../../../shaders/shadow.vert")].concat();
        if kind == Kind::Opaque {
            return Source { label, stages: vec![(gl::VERTEX_SHADER, vertex(&self.head(&["SOLID"])))] };
        }
        let head = self.head(if kind == Kind::Mask { &["MASK"] } else { &[] }) + &self.branches(&[kind]);
        let lookups = self.lookups(&[kind], Slopes::OfTheQuad);
        let body = include_str!("../../../shaders/shadow.frag");
        let fragment = [&head, FRAME, &lookups, DRAWN, CASTER, body].concat();
        Source { label, stages: drawn(vertex(&head), fragment) }
    }

    /// The programs that blur the moments of depth, in execution order.
    pub(crate) fn blur(&self) -> Vec<Source> {
        match self.shadow.blurring {
            Blurring::Fitting | Blurring::Tiles => vec![self.blur_at_once()],
            Blurring::Rows | Blurring::Fragments => vec![self.blur_along(true), self.blur_along(false)],
        }
    }

    /// The first blur program, for depth in a storage buffer; none without a blur.
    pub(crate) fn blur_of_buffer(&self) -> Option<Source> {
        let Source { label, stages } = self.blur().into_iter().next().filter(|_| self.has("VARIANCE"))?;
        let version = |text: String| text.replacen('\n', "\n#define OF_BUFFER\n", 1);
        let stages = stages.into_iter().map(|(stage, text)| (stage, version(text))).collect();
        Some(Source { label: label + ", of a buffer", stages })
    }

    fn blur_head(&self, more: &[&str], lanes: u32, run: u32) -> String {
        let mut head = self.head(more);
        let format = if self.shadow.moments == Moments::F16 { "rg16f" } else { "rg32f" };
        writeln!(head, "#define LANES {lanes}\n#define RUN {run}\n#define FORMAT {format}").ok();
        [&head, FRAME, self.splits(), MOMENTS].concat()
    }

    /// One direction of the blur; the first direction also converts depth to moments.
    fn blur_along(&self, first: bool) -> Source {
        let more: &[&str] = if first { &["FIRST"] } else { &[] };
        let fragments = self.shadow.blurring == Blurring::Fragments;
        let run = if fragments { 1 } else { RUN };
        let arguments = "ivec2 at, ivec2 along, int side";
        let taps = taps("blur", arguments, &weights(self.shadow.blur), run, |tap| {
            format!("moments(at + {tap} * along, side)")
        });
        let head = self.blur_head(more, LANES, run) + &taps;
        let label = format!("blur, {}", if first { "x" } else { "y" });
        if !fragments {
            let body = head + include_str!("../../../shaders/blur.comp");
            return Source { label, stages: vec![(gl::COMPUTE_SHADER, body)] };
        }
        let vertex = String::from("#version 430 core\n") + include_str!("../../../shaders/whole.vert");
        let fragment = head + include_str!("../../../shaders/blur.frag");
        Source { label, stages: vec![(gl::VERTEX_SHADER, vertex), (gl::FRAGMENT_SHADER, fragment)] }
    }

    /// Both directions of the blur in one pass: by strips if the kernel is small enough, else by tiles.
    fn blur_at_once(&self) -> Source {
        let weights = weights(self.shadow.blur);
        let Some(strip) = Strip::of(&self.shadow) else { return self.blur_tiles(&weights) };
        let text = self.blur_head(&["FIRST"], strip.wide, 1) + &strip.text(&weights);
        Source { label: "blur, strips".into(), stages: vec![(gl::COMPUTE_SHADER, text)] }
    }

    /// Both directions of the blur, tile by tile.
    fn blur_tiles(&self, weights: &[f32]) -> Source {
        let tile = Tile::of(&self.shadow);
        let Tile { wide, tall, band, reach } = tile;
        let mut text = self.blur_head(&["FIRST"], TILE_LANES, RUN);
        writeln!(text, "#define WIDE {wide}\n#define TALL {tall}\n#define BAND {band}\n#define REACH {reach}").ok();
        writeln!(text, "#define PITCH {}\n#define DEPTH_PITCH {}", tile.pitch(), tile.depth_pitch()).ok();
        writeln!(text, "shared float depths[BAND * DEPTH_PITCH];").ok();
        writeln!(text, "shared vec2 rows[(TALL + 2 * REACH) * PITCH];").ok();
        writeln!(text, "vec2 pair(float m) {{ return vec2(m, m * m); }}").ok();
        text += &taps("across", "int at", weights, RUN, |tap| format!("pair(depths[at + {tap}])"));
        text += &taps("down", "int at", weights, RUN, |tap| format!("rows[at + {tap} * PITCH]"));
        text += include_str!("../../../shaders/blur_tile.comp");
        Source { label: "blur, tiles".into(), stages: vec![(gl::COMPUTE_SHADER, text)] }
    }
}

/// GLSL function with the unrolled weighted sums of one blur invocation. Each pair of moments is fetched once for all
/// sums that use it.
fn taps(name: &str, arguments: &str, weights: &[f32], run: u32, fetch: impl Fn(i32) -> String) -> String {
    let reach = weights.len() as i32 - 1;
    let mut text = format!("void {name}({arguments}, out vec2 sums[RUN]) {{\n    vec2 texel;\n");
    for index in 0..run {
        writeln!(text, "    sums[{index}] = vec2(0.0);").ok();
    }
    for tap in -reach..run as i32 + reach {
        writeln!(text, "    texel = {};", fetch(tap)).ok();
        for index in 0..run as i32 {
            if let Some(weight) = weights.get((tap - index).unsigned_abs() as usize) {
                writeln!(text, "    sums[{index}] += {weight:?} * texel;").ok();
            }
        }
    }
    text + "}\n"
}

/// One half of a normalized Gaussian (equation 3.11 in one dimension), center first, cut off at three standard
/// deviations.
pub(crate) fn weights(deviation: f32) -> Vec<f32> {
    let deviation = f64::from(deviation);
    let reach = (3.0 * deviation).ceil() as i32;
    let bell = |step: i32| if step == 0 { 1.0 } else { (-0.5 * (f64::from(step) / deviation).powi(2)).exp() };
    let sum: f64 = (-reach..=reach).map(bell).sum();
    (0..=reach).map(|step| (bell(step) / sum) as f32).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn blur_weights_are_a_normalised_bell() {
        for deviation in [0.0, 0.3, 2.0, 16.0] {
            let weights = weights(deviation);
            let sum = weights[0] + 2.0 * weights[1..].iter().sum::<f32>();
            assert!((sum - 1.0).abs() < 1e-5, "{deviation}: {sum}");
            assert!(weights.is_sorted_by(|near, far| near >= far));
            let shadow = Shadow { blur: deviation, ..Shadow::default() };
            assert_eq!(shadow.reach() as usize, weights.len() - 1);
        }
        assert_eq!(weights(0.0), [1.0]);
    }

    #[test]
    fn a_tile_fits_into_shared_memory_whatever_the_blur() {
        for step in 0..=160 {
            let tile = Tile::of(&Shadow { blur: step as f32 / 10.0, ..Shadow::default() });
            assert!(tile.bytes() <= SHARED_BYTES, "{tile:?}: {} bytes", tile.bytes());
            assert!(tile.wide.is_multiple_of(RUN) && tile.tall.is_multiple_of(RUN));
        }
        let default = Tile::of(&Shadow::default());
        assert_eq!((default.tall, default.band), (64, 74), "the default blur has the largest tile, in one band");
    }

    #[test]
    fn only_what_the_scene_names_is_compiled() {
        let all = ["VARIANCE", "STANDARD", "FILTERED"];
        for (method, own) in
            [ShadowMethod::Variance, ShadowMethod::Standard, ShadowMethod::Filtered].into_iter().zip(all)
        {
            let shadow = Shadow { method, ..Shadow::default() };
            let names: Vec<&str> = defines(&shadow).collect();
            assert_eq!(names, ["SHADOWS", own]);
            let options = Options {
                defines: names,
                used: vec![],
                shadow,
                sample_places: vec![],
                resolve: String::new(),
                post_depth: false,
            };
            assert_eq!(options.sun().contains("const float TAPS"), own == "FILTERED");
            assert!(
                !options.sun().contains("SplitBlock")
                    && !options.shadow(Kind::Opaque).stages[0].1.contains("SplitBlock")
            );
            let split = Options { shadow: Shadow { splits: 3, ..shadow }, ..options };
            assert!(split.sun().contains("SplitBlock"));
        }
        assert_eq!(defines(&Shadow { splits: 4, ..Shadow::default() }).last(), Some("SPLITS 4"));
    }
}
