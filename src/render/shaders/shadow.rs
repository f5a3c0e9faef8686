//! Shader sources of the shadow passes: casters, blur and lookup, with the branches that the scene's shadow method
//! needs.

use std::fmt::Write as _;

use super::blur_strip::BlurStrip;
use super::{
    FRAME, ProgramSource, SHADOW_CASTER, ShaderOptions, TRIANGLE_ID, UvDerivatives, VERSION, vertex_and_fragment,
};
use crate::device::gl;
use crate::layout::WORKGROUP_SIZE;
use crate::scene_data::geometry::BlendMode;
use crate::types::BlurMethod;
use modalcast_model::scene::{MomentFormat, ShadowMethod, ShadowSettings};

const SUN_VISIBILITY: &str = include_str!("../../../shaders/shared/sun_visibility.glsl");
const CASCADES: &str = include_str!("../../../shaders/shared/shadow_cascades.glsl");
const VSM_MOMENTS: &str = include_str!("../../../shaders/shared/vsm_moments.glsl");

/// Consecutive texels that one invocation of the blur writes, along its direction.
pub(crate) const TEXELS_PER_INVOCATION: u32 = 8;
/// Lanes of a workgroup that blurs a tile.
const TILE_WORKGROUP_SIZE: u32 = 256;
/// Bytes of shared memory that every device gives a workgroup.
pub(crate) const SHARED_BYTES: u32 = 32 << 10;

/// Columns and rows of the map that one workgroup writes when both directions are blurred in one pass.
pub(crate) fn texels_per_workgroup(shadow: &ShadowSettings) -> [u32; 2] {
    let tile = BlurTile::of(shadow);
    BlurStrip::of(shadow).map_or([tile.wide, tile.tall], |strip| [strip.wide, strip.tall])
}

/// The tile of a workgroup: its width and height in texels, and the number of depth rows that it holds at once.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct BlurTile {
    wide: u32,
    tall: u32,
    band: u32,
    reach: u32,
}

impl BlurTile {
    /// The first of these sizes that fits into shared memory; a wider blur kernel needs smaller tiles.
    fn of(shadow: &ShadowSettings) -> Self {
        let reach = shadow.blur_radius();
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

impl ShaderOptions {
    /// Source of `lit`, the share of the sun's light that reaches a point.
    pub(crate) fn sun(&self) -> String {
        let mut text = String::new();
        if let Some(shadow) = self.features.variance_shadow() {
            writeln!(text, "const float DEVIATION = {:?};", shadow.filter_deviation() as f32).ok();
        }
        let filtered = self.features.shadow.filter(|shadow| shadow.method == ShadowMethod::PercentageCloser);
        if let Some(shadow) = filtered {
            let taps = gaussian_weights(shadow.blur);
            writeln!(text, "#define RADIUS {}", taps.len() - 1).ok();
            let list: String = taps.iter().map(|weight| format!("{weight:?}, ")).collect();
            writeln!(text, "const float TAPS[RADIUS + 2] = float[]({list}0.0);").ok();
        }
        text + self.splits() + SUN_VISIBILITY
    }

    pub(crate) fn splits(&self) -> &'static str {
        if self.features.shadow.is_some_and(|shadow| shadow.splits > 1) { CASCADES } else { "" }
    }

    /// Draws one kind of triangle into the shadow map; opaque ones need no fragment shader.
    pub(crate) fn shadow(&self, blend_mode: BlendMode) -> ProgramSource {
        let label = format!("shadow, {blend_mode:?}");
        let vertex = |head: &str| [head, FRAME, self.splits(), include_str!("../../../shaders/shadow.vert")].concat();
        if blend_mode == BlendMode::Opaque {
            return ProgramSource { label, stages: vec![(gl::VERTEX_SHADER, vertex(&self.head(&["POSITION_ONLY"])))] };
        }
        let head = self.head(if blend_mode == BlendMode::Mask { &["MASK"] } else { &[] })
            + &self.material_defines(&[blend_mode]);
        let material_lookups = self.material_lookups(&[blend_mode], UvDerivatives::Implicit);
        let body = include_str!("../../../shaders/shadow.frag");
        let fragment = [&head, FRAME, &material_lookups, TRIANGLE_ID, SHADOW_CASTER, body].concat();
        ProgramSource { label, stages: vertex_and_fragment(vertex(&head), fragment) }
    }

    /// The programs that blur the moments of depth, in execution order; none without moments.
    pub(crate) fn blur(&self) -> Vec<ProgramSource> {
        let Some(shadow) = self.features.variance_shadow() else { return Vec::new() };
        match self.features.blur_method {
            BlurMethod::Auto | BlurMethod::Tiles => vec![self.blur_single_pass(shadow)],
            BlurMethod::Rows | BlurMethod::Fragments => {
                vec![self.blur_separable(shadow, true), self.blur_separable(shadow, false)]
            }
        }
    }

    /// The first blur program, for depth in a storage buffer; none without moments.
    pub(crate) fn blur_from_buffer(&self) -> Option<ProgramSource> {
        let ProgramSource { label, stages } = self.blur().into_iter().next()?;
        let version = |text: String| text.replacen('\n', "\n#define DEPTH_IN_BUFFER\n", 1);
        let stages = stages.into_iter().map(|(stage, text)| (stage, version(text))).collect();
        Some(ProgramSource { label: label + ", of a buffer", stages })
    }

    fn blur_head(&self, shadow: &ShadowSettings, more: &[&str], lanes: u32, run: u32) -> String {
        let mut head = self.head(more);
        let format = if shadow.moments == MomentFormat::F16 { "rg16f" } else { "rg32f" };
        writeln!(head, "#define WORKGROUP_SIZE {lanes}\n#define TEXELS_PER_INVOCATION {run}\n#define FORMAT {format}")
            .ok();
        [&head, FRAME, self.splits(), VSM_MOMENTS].concat()
    }

    /// One direction of the blur; the first direction also converts depth to moments.
    fn blur_separable(&self, shadow: &ShadowSettings, first: bool) -> ProgramSource {
        let more: &[&str] = if first { &["FROM_DEPTH"] } else { &[] };
        let fragments = self.features.blur_method == BlurMethod::Fragments;
        let run = if fragments { 1 } else { TEXELS_PER_INVOCATION };
        let arguments = "ivec2 at, ivec2 along, int side";
        let taps = taps("blur", arguments, &gaussian_weights(shadow.blur), run, |tap| {
            format!("load_moments(at + {tap} * along, side)")
        });
        let head = self.blur_head(shadow, more, WORKGROUP_SIZE, run) + &taps;
        let label = format!("blur, {}", if first { "x" } else { "y" });
        if !fragments {
            return ProgramSource::compute(label, head + include_str!("../../../shaders/vsm_blur.comp"));
        }
        let vertex = String::from(VERSION) + include_str!("../../../shaders/fullscreen.vert");
        let fragment = head + include_str!("../../../shaders/vsm_blur.frag");
        ProgramSource { label, stages: vertex_and_fragment(vertex, fragment) }
    }

    /// Both directions of the blur in one pass: by strips if the kernel is small enough, else by tiles.
    fn blur_single_pass(&self, shadow: &ShadowSettings) -> ProgramSource {
        let weights = gaussian_weights(shadow.blur);
        let Some(strip) = BlurStrip::of(shadow) else { return self.blur_tiles(shadow, &weights) };
        let text = self.blur_head(shadow, &["FROM_DEPTH"], strip.wide, 1) + &strip.text(&weights);
        ProgramSource::compute("blur, strips", text)
    }

    /// Both directions of the blur, tile by tile.
    fn blur_tiles(&self, shadow: &ShadowSettings, weights: &[f32]) -> ProgramSource {
        let tile = BlurTile::of(shadow);
        let BlurTile { wide, tall, band, reach } = tile;
        let mut text = self.blur_head(shadow, &["FROM_DEPTH"], TILE_WORKGROUP_SIZE, TEXELS_PER_INVOCATION);
        writeln!(text, "#define OUTPUT_COLUMNS {wide}\n#define OUTPUT_ROWS {tall}\n#define BAND_ROWS {band}\n#define RADIUS {reach}").ok();
        writeln!(text, "#define ROW_PITCH {}\n#define DEPTH_PITCH {}", tile.pitch(), tile.depth_pitch()).ok();
        writeln!(text, "shared float depths[BAND_ROWS * DEPTH_PITCH];").ok();
        writeln!(text, "shared vec2 rows[(OUTPUT_ROWS + 2 * RADIUS) * ROW_PITCH];").ok();
        writeln!(text, "vec2 to_moments(float m) {{ return vec2(m, m * m); }}").ok();
        text += &taps("blur_row", "int at", weights, TEXELS_PER_INVOCATION, |tap| {
            format!("to_moments(depths[at + {tap}])")
        });
        text += &taps("blur_column", "int at", weights, TEXELS_PER_INVOCATION, |tap| {
            format!("rows[at + {tap} * ROW_PITCH]")
        });
        text += include_str!("../../../shaders/vsm_blur_tile.comp");
        ProgramSource::compute("blur, tiles", text)
    }
}

/// GLSL function with the unrolled weighted sums of one blur invocation. Each pair of moments is fetched once for all
/// sums that use it.
fn taps(name: &str, arguments: &str, weights: &[f32], run: u32, fetch: impl Fn(i32) -> String) -> String {
    let reach = weights.len() as i32 - 1;
    let mut text = format!("void {name}({arguments}, out vec2 sums[TEXELS_PER_INVOCATION]) {{\n    vec2 texel;\n");
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
pub(crate) fn gaussian_weights(filter_deviation: f32) -> Vec<f32> {
    let filter_deviation = f64::from(filter_deviation);
    let reach = (3.0 * filter_deviation).ceil() as i32;
    let bell = |step: i32| if step == 0 { 1.0 } else { (-0.5 * (f64::from(step) / filter_deviation).powi(2)).exp() };
    let sum: f64 = (-reach..=reach).map(bell).sum();
    (0..=reach).map(|step| (bell(step) / sum) as f32).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::features::ShaderFeatures;

    #[test]
    fn blur_weights_are_a_normalised_bell() {
        for filter_deviation in [0.0, 0.3, 2.0, 16.0] {
            let weights = gaussian_weights(filter_deviation);
            let sum = weights[0] + 2.0 * weights[1..].iter().sum::<f32>();
            assert!((sum - 1.0).abs() < 1e-5, "{filter_deviation}: {sum}");
            assert!(weights.is_sorted_by(|near, far| near >= far));
            let shadow = ShadowSettings { blur: filter_deviation, ..ShadowSettings::default() };
            assert_eq!(shadow.blur_radius() as usize, weights.len() - 1);
        }
        assert_eq!(gaussian_weights(0.0), [1.0]);
    }

    #[test]
    fn a_tile_fits_into_shared_memory_whatever_the_blur() {
        for step in 0..=160 {
            let tile = BlurTile::of(&ShadowSettings { blur: step as f32 / 10.0, ..ShadowSettings::default() });
            assert!(tile.bytes() <= SHARED_BYTES, "{tile:?}: {} bytes", tile.bytes());
            assert!(tile.wide.is_multiple_of(TEXELS_PER_INVOCATION) && tile.tall.is_multiple_of(TEXELS_PER_INVOCATION));
        }
        let default = BlurTile::of(&ShadowSettings::default());
        assert_eq!((default.tall, default.band), (64, 74), "the default blur has the largest tile, in one band");
    }

    #[test]
    fn only_what_the_scene_names_is_compiled() {
        let all = ["SHADOW_VARIANCE", "SHADOW_STANDARD", "SHADOW_FILTERED"];
        for (method, own) in
            [ShadowMethod::Variance, ShadowMethod::Standard, ShadowMethod::PercentageCloser].into_iter().zip(all)
        {
            let shadow = ShadowSettings { method, ..ShadowSettings::default() };
            let features = |shadow| ShaderFeatures { shadow: Some(shadow), ..ShaderFeatures::NONE };
            assert_eq!(features(shadow).defines(), ["SHADOWS", own]);
            let options = ShaderOptions {
                features: features(shadow),
                used: vec![],
                sample_positions: vec![],
                sample_resolve: String::new(),
                post_depth_coverage: false,
            };
            assert_eq!(options.sun().contains("const float TAPS"), own == "SHADOW_FILTERED");
            assert!(
                !options.sun().contains("CascadeBlock")
                    && !options.shadow(BlendMode::Opaque).stages[0].1.contains("CascadeBlock")
            );
            let split = ShaderOptions { features: features(ShadowSettings { splits: 3, ..shadow }), ..options };
            assert!(split.sun().contains("CascadeBlock"));
            let four = features(ShadowSettings { splits: 4, ..shadow });
            assert_eq!(four.defines().last(), Some(&"CASCADES 4"));
        }
    }
}
