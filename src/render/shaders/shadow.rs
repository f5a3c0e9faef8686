//! Shader sources of the shadow passes: casters, blur and lookup, with only the branches of the scene's shadow method.

use std::fmt::Write as _;

use super::blur_strip::BlurStrip;
use super::{
    FRAGMENT_ALPHA, FRAME, ProgramSource, ShaderOptions, TRIANGLE_ID, UvDerivatives, VERSION, vertex_and_fragment,
};
use crate::device::gl;
use crate::layout::WORKGROUP_SIZE;
use crate::scene_data::geometry::BlendMode;
use crate::types::BlurMethod;
use modalcast_model::scene::{MomentFormat, ShadowMethod, ShadowSettings};

const SUN_VISIBILITY: &str = include_str!("../../../shaders/shared/sun_visibility.glsl");
const CASCADES: &str = include_str!("../../../shaders/shared/shadow_cascades.glsl");
const VSM_MOMENTS: &str = include_str!("../../../shaders/shared/vsm_moments.glsl");

/// Consecutive texels along the direction of the blur that an invocation writes.
pub(crate) const TEXELS_PER_INVOCATION: u32 = 8;
/// Number of lanes (invocations) of a workgroup that blurs a tile.
const TILE_WORKGROUP_SIZE: u32 = 256;
/// Bytes of shared memory that OpenGL 4.3 guarantees to a workgroup.
pub(crate) const SHARED_BYTES: u32 = 32 << 10;

/// Columns and rows of the map that one workgroup writes when both directions are blurred in one pass.
pub(crate) fn texels_per_workgroup(shadow: &ShadowSettings) -> [u32; 2] {
    let tile = BlurTile::fit(shadow);
    BlurStrip::fit(shadow).map_or([tile.columns, tile.rows], |strip| [strip.columns, strip.rows])
}

/// Tile of the map that a workgroup blurs, in texels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct BlurTile {
    columns: u32,
    rows: u32,
    /// Rows of a band: the rows of depth that shared memory holds at once. A tile and its margins have
    /// `rows + 2 * radius` rows, in one or more bands.
    band_rows: u32,
    /// Radius of the blur kernel.
    radius: u32,
}

impl BlurTile {
    /// The first candidate that fits into shared memory. A wider blur kernel needs smaller tiles.
    fn fit(shadow: &ShadowSettings) -> Self {
        let radius = shadow.blur_radius();
        // Columns, rows, and maximum rows per band. A maximum of 256 means one band for all rows, because a second band
        // would leave most lanes idle.
        let candidates = [(32, 64, 256), (32, 48, 256), (32, 32, 256), (32, 32, 32), (16, 64, 32), (16, 64, 16)];
        let tiles = candidates.map(|(columns, rows, max_band_rows)| Self {
            columns,
            rows,
            band_rows: (rows + 2 * radius).min(max_band_rows),
            radius,
        });
        tiles.into_iter().find(|tile| tile.shared_bytes() <= SHARED_BYTES).unwrap_or(tiles[candidates.len() - 1])
    }

    /// Floats from the start of one row of depths to the next. An odd number avoids bank conflicts.
    const fn depth_pitch(&self) -> u32 {
        (self.columns + 2 * self.radius) | 1
    }

    /// Moment pairs from the start of one blurred row to the next.
    const fn row_pitch(&self) -> u32 {
        self.columns + 1
    }

    /// Bytes of shared memory: a float per depth of a band, and a moment pair of two floats per texel that is blurred
    /// in x.
    const fn shared_bytes(&self) -> u32 {
        4 * self.band_rows * self.depth_pitch() + 8 * (self.rows + 2 * self.radius) * self.row_pitch()
    }
}

/// Taps of percentage-closer filtering: a square of texture gathers, each of 2 x 2 texels, with Gaussian weights.
#[derive(Debug, Clone, Copy, PartialEq)]
struct PcfKernel {
    /// Gathers along one axis.
    gathers: u32,
    /// Distance of adjacent gathers in texels, an even number; 2 if no texel is skipped.
    spacing: u32,
    /// Standard deviation in texels.
    blur: f32,
}

impl PcfKernel {
    /// Largest number of gathers along one axis where filtering supplements a variance map: all texels of a blur of up
    /// to 6 texels. Wider kernels skip texels, because otherwise a blur of 16 would take a hundred times as long as the
    /// lookup of the moments. Skipped texels let no light into full shadow.
    const MAX_FALLBACK_GATHERS: u32 = 16;

    /// The kernel of the settings; none if lookups do not filter the depth.
    fn of(shadow: &ShadowSettings) -> Option<Self> {
        let blur = shadow.blur;
        if shadow.method == ShadowMethod::PercentageCloser {
            return Some(Self { gathers: shadow.blur_radius() + 1, spacing: 2, blur });
        }
        // Texels beyond 2.5 standard deviations change a shadow edge by at most 0.6 %. Without them, the default blur
        // needs 25 instead of 36 gathers.
        let radius = (2.5 * f64::from(blur)).ceil() as u32;
        let stride = radius.div_ceil(Self::MAX_FALLBACK_GATHERS - 1).max(1);
        let kernel = Self { gathers: radius.div_ceil(stride) + 1, spacing: 2 * stride, blur };
        shadow.filters_undecided_points().then_some(kernel)
    }

    /// GLSL constants. The weight of a texel at the distance d from the center is TAP_SCALE 2^(TAP_FALLOFF d^2) along
    /// one axis; the weights of all texels sum to 1.
    fn constants(&self) -> String {
        let Self { gathers, spacing, blur } = *self;
        // Without a blur, all texels except the center have a weight of 0 in f32.
        let falloff = -0.5 * std::f64::consts::LOG2_E / f64::from(blur).powi(2).max(1e-4);
        // A gather at x reads the texels x and x + 1.
        let first = -(((gathers - 1) * spacing / 2) as i32);
        let corners = (0..gathers).map(|index| first + (index * spacing) as i32);
        let weight = |offset: i32| (falloff * f64::from(offset).powi(2)).exp2();
        let sum: f64 = corners.map(|corner| weight(corner) + weight(corner + 1)).sum();
        format!(
            "const int GATHERS = {gathers}, GATHER_SPACING = {spacing};\n\
             const float TAP_FALLOFF = {:?}, TAP_SCALE = {:?};\n",
            falloff as f32,
            (1.0 / sum) as f32,
        )
    }
}

impl ShaderOptions {
    /// GLSL function `sun_visibility`.
    pub(crate) fn sun_visibility(&self) -> String {
        let mut text = String::new();
        if let Some(shadow) = self.features.variance_shadow() {
            writeln!(text, "const float DEVIATION = {:?};", shadow.filter_deviation() as f32).ok();
            writeln!(text, "const float ROUNDING_VARIANCE = {:?};", shadow.variance_floor()).ok();
        }
        if let Some(kernel) = self.features.shadow.as_ref().and_then(PcfKernel::of) {
            text += &kernel.constants();
        }
        text + self.cascade_source() + SUN_VISIBILITY
    }

    /// Cascade lookups; empty if the shadow map is not split.
    pub(crate) fn cascade_source(&self) -> &'static str {
        if self.features.shadow.is_some_and(|shadow| shadow.cascades > 1) { CASCADES } else { "" }
    }

    /// Draws triangles with this blend mode into the shadow map. Opaque triangles need no fragment shader.
    pub(crate) fn shadow(&self, blend_mode: BlendMode) -> ProgramSource {
        let label = format!("shadow, {blend_mode:?}");
        let vertex =
            |head: &str| [head, FRAME, self.cascade_source(), include_str!("../../../shaders/shadow.vert")].concat();
        if blend_mode == BlendMode::Opaque {
            return ProgramSource { label, stages: vec![(gl::VERTEX_SHADER, vertex(&self.head(&["POSITION_ONLY"])))] };
        }
        let head = self.head(if blend_mode == BlendMode::Mask { &["MASK"] } else { &[] })
            + &self.material_defines(&[blend_mode]);
        let material_lookups = self.material_lookups(&[blend_mode], UvDerivatives::Implicit);
        let body = include_str!("../../../shaders/shadow.frag");
        let fragment = [&head, FRAME, &material_lookups, TRIANGLE_ID, FRAGMENT_ALPHA, body].concat();
        ProgramSource { label, stages: vertex_and_fragment(vertex(&head), fragment) }
    }

    /// The programs that blur a variance shadow map, in execution order; empty for other shadow methods.
    pub(crate) fn blur(&self) -> Vec<ProgramSource> {
        let Some(shadow) = self.features.variance_shadow() else { return Vec::new() };
        match self.features.blur_method {
            BlurMethod::Auto | BlurMethod::Tiles => vec![self.blur_single_pass(shadow)],
            BlurMethod::Rows | BlurMethod::Fragments => {
                vec![self.blur_separable(shadow, true), self.blur_separable(shadow, false)]
            }
        }
    }

    /// The first blur program, for depth in a storage buffer; none if the shadow is no variance map.
    pub(crate) fn blur_from_buffer(&self) -> Option<ProgramSource> {
        let ProgramSource { label, stages } = self.blur().into_iter().next()?;
        // Inserts the define after the first line, which is the version.
        let define_buffer = |text: String| text.replacen('\n', "\n#define DEPTH_IN_BUFFER\n", 1);
        let stages = stages.into_iter().map(|(stage, text)| (stage, define_buffer(text))).collect();
        Some(ProgramSource { label: label + ", from a buffer", stages })
    }

    /// Version, defines, and functions that load moments.
    fn blur_head(
        &self,
        shadow: &ShadowSettings,
        defines: &[&str],
        workgroup_size: u32,
        texels_per_invocation: u32,
    ) -> String {
        let mut head = self.head(defines);
        let format = if shadow.moments == MomentFormat::F16 { "rg16f" } else { "rg32f" };
        writeln!(head, "#define WORKGROUP_SIZE {workgroup_size}\n#define TEXELS_PER_INVOCATION {texels_per_invocation}\n#define FORMAT {format}")
            .ok();
        [&head, FRAME, self.cascade_source(), VSM_MOMENTS].concat()
    }

    /// One direction of the blur; the first direction also converts depth to moments.
    fn blur_separable(&self, shadow: &ShadowSettings, is_first_direction: bool) -> ProgramSource {
        let defines: &[&str] = if is_first_direction { &["FROM_DEPTH"] } else { &[] };
        let uses_fragments = self.features.blur_method == BlurMethod::Fragments;
        let texels_per_invocation = if uses_fragments { 1 } else { TEXELS_PER_INVOCATION };
        let parameters = "ivec2 texel, ivec2 direction, int side";
        let blur_function =
            blur_function("blur", parameters, &gaussian_weights(shadow.blur), texels_per_invocation, |offset| {
                format!("load_moments(texel + {offset} * direction, side)")
            });
        let head = self.blur_head(shadow, defines, WORKGROUP_SIZE, texels_per_invocation) + &blur_function;
        let label = format!("blur, {}", if is_first_direction { "x" } else { "y" });
        if !uses_fragments {
            return ProgramSource::compute(label, head + include_str!("../../../shaders/vsm_blur.comp"));
        }
        let vertex = String::from(VERSION) + include_str!("../../../shaders/fullscreen.vert");
        let fragment = head + include_str!("../../../shaders/vsm_blur.frag");
        ProgramSource { label, stages: vertex_and_fragment(vertex, fragment) }
    }

    /// Both directions of the blur in one pass: by strips if the kernel is small enough, else by tiles.
    fn blur_single_pass(&self, shadow: &ShadowSettings) -> ProgramSource {
        let weights = gaussian_weights(shadow.blur);
        let Some(strip) = BlurStrip::fit(shadow) else { return self.blur_tiles(shadow, &weights) };
        let text = self.blur_head(shadow, &["FROM_DEPTH"], strip.columns, 1) + &strip.text(&weights);
        ProgramSource::compute("blur, strips", text)
    }

    /// Both directions of the blur in one pass, by tiles.
    fn blur_tiles(&self, shadow: &ShadowSettings, weights: &[f32]) -> ProgramSource {
        let tile = BlurTile::fit(shadow);
        let BlurTile { columns, rows, band_rows, radius } = tile;
        let mut text = self.blur_head(shadow, &["FROM_DEPTH"], TILE_WORKGROUP_SIZE, TEXELS_PER_INVOCATION);
        writeln!(text, "#define OUTPUT_COLUMNS {columns}\n#define OUTPUT_ROWS {rows}\n#define BAND_ROWS {band_rows}\n#define RADIUS {radius}").ok();
        writeln!(text, "#define ROW_PITCH {}\n#define DEPTH_PITCH {}", tile.row_pitch(), tile.depth_pitch()).ok();
        writeln!(text, "shared float depths[BAND_ROWS * DEPTH_PITCH];").ok();
        writeln!(text, "shared vec2 rows[(OUTPUT_ROWS + 2 * RADIUS) * ROW_PITCH];").ok();
        writeln!(text, "vec2 to_moments(float m) {{ return vec2(m, m * m); }}").ok();
        text += &blur_function("blur_row", "int first", weights, TEXELS_PER_INVOCATION, |offset| {
            format!("to_moments(depths[first + {offset}])")
        });
        text += &blur_function("blur_column", "int first", weights, TEXELS_PER_INVOCATION, |offset| {
            format!("rows[first + {offset} * ROW_PITCH]")
        });
        text += include_str!("../../../shaders/vsm_blur_tile.comp");
        ProgramSource::compute("blur, tiles", text)
    }
}

/// GLSL function that computes the `texels_per_invocation` blurred texels of an invocation, unrolled. `weights`: one
/// half of a Gaussian, center first. `fetch` gives the GLSL expression for the moments at an offset from the first of
/// these texels. Each pair of moments is fetched only once.
fn blur_function(
    name: &str,
    parameters: &str,
    weights: &[f32],
    texels_per_invocation: u32,
    fetch: impl Fn(i32) -> String,
) -> String {
    let radius = weights.len() as i32 - 1;
    let mut text = format!("void {name}({parameters}, out vec2 sums[TEXELS_PER_INVOCATION]) {{\n    vec2 moments;\n");
    for index in 0..texels_per_invocation {
        writeln!(text, "    sums[{index}] = vec2(0.0);").ok();
    }
    for offset in -radius..texels_per_invocation as i32 + radius {
        writeln!(text, "    moments = {};", fetch(offset)).ok();
        for index in 0..texels_per_invocation as i32 {
            if let Some(weight) = weights.get((offset - index).unsigned_abs() as usize) {
                writeln!(text, "    sums[{index}] += {weight:?} * moments;").ok();
            }
        }
    }
    text + "}\n"
}

/// One half of a normalized Gaussian (equation 3.11 of the thesis in one dimension), center first, truncated at three
/// standard deviations. `blur` is the standard deviation in texels ([`ShadowSettings::blur`]).
pub(crate) fn gaussian_weights(blur: f32) -> Vec<f32> {
    let blur = f64::from(blur);
    let radius = (3.0 * blur).ceil() as i32;
    let gaussian = |step: i32| if step == 0 { 1.0 } else { (-0.5 * (f64::from(step) / blur).powi(2)).exp() };
    let sum: f64 = (-radius..=radius).map(gaussian).sum();
    (0..=radius).map(|step| (gaussian(step) / sum) as f32).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::features::ShaderFeatures;

    #[test]
    fn gaussian_weights_decrease_and_sum_to_one() {
        for blur in [0.0, 0.3, 2.0, 16.0] {
            let weights = gaussian_weights(blur);
            let sum = weights[0] + 2.0 * weights[1..].iter().sum::<f32>();
            assert!((sum - 1.0).abs() < 1e-5, "blur {blur}: expected a sum of 1, got {sum}");
            assert!(weights.is_sorted_by(|a, b| a >= b));
            let shadow = ShadowSettings { blur, ..ShadowSettings::default() };
            assert_eq!(shadow.blur_radius() as usize, weights.len() - 1);
        }
        assert_eq!(gaussian_weights(0.0), [1.0]);
    }

    #[test]
    fn tiles_fit_into_shared_memory() {
        // Blurs from 0 to 16 texels.
        for tenths in 0..=160 {
            let tile = BlurTile::fit(&ShadowSettings { blur: tenths as f32 / 10.0, ..ShadowSettings::default() });
            let bytes = tile.shared_bytes();
            assert!(bytes <= SHARED_BYTES, "{tile:?}: {bytes} bytes");
            assert!(
                tile.columns.is_multiple_of(TEXELS_PER_INVOCATION) && tile.rows.is_multiple_of(TEXELS_PER_INVOCATION)
            );
        }
        let default = BlurTile::fit(&ShadowSettings::default());
        assert_eq!(
            (default.rows, default.band_rows),
            (64, 74),
            "expected one band of 64 rows and twice the radius of 5"
        );
    }

    /// Sums the weights as the shader does: each gather reads the texels x and x + 1, whose weights are interpolated
    /// between Gaussians that are centered at the texels 0 and 1.
    #[test]
    fn pcf_weights_sum_to_one_at_every_position() {
        for (method, blur) in [ShadowMethod::Variance, ShadowMethod::PercentageCloser]
            .into_iter()
            .flat_map(|method| [0.0, 0.3, 1.5, 6.0, 6.1, 16.0].map(|blur| (method, blur)))
        {
            let shadow = ShadowSettings { method, blur, ..ShadowSettings::default() };
            let kernel = PcfKernel::of(&shadow).expect("a kernel");
            let PcfKernel { gathers, spacing, .. } = kernel;
            let skips_texels = spacing > 2;
            assert_eq!(skips_texels, method == ShadowMethod::Variance && blur > 6.0, "{kernel:?}");
            let constants = kernel.constants();
            let constant = |name: &str| -> f64 {
                let (_, value) = constants.split_once(&format!("{name} = ")).expect("a constant");
                value.split([',', ';']).next().and_then(|value| value.parse().ok()).expect("a number")
            };
            let [falloff, scale] = ["TAP_FALLOFF", "TAP_SCALE"].map(constant);
            let tap = |offset: f64| scale * (falloff * offset * offset).exp2();
            let sum_at = |fraction: f64| -> f64 {
                let first = -f64::from((gathers - 1) * spacing) / 2.0;
                let corners = (0..gathers).map(|index| first + f64::from(index * spacing));
                let texels = corners.flat_map(|corner| [corner, corner + 1.0]);
                texels.map(|texel| (1.0 - fraction) * tap(texel) + fraction * tap(texel - 1.0)).sum()
            };
            for fraction in [0.0, 0.25, 0.5, 1.0] {
                let sum = sum_at(fraction);
                assert!((sum - 1.0).abs() < 1e-5, "{kernel:?}: expected a sum of 1, got {sum}");
            }
        }
    }

    #[test]
    fn pcf_fallback_reads_a_limited_number_of_texels() {
        let gathers = |blur: f32| {
            let shadow = ShadowSettings { blur, ..ShadowSettings::default() };
            PcfKernel::of(&shadow).map(|kernel| (kernel.gathers, kernel.spacing))
        };
        assert_eq!([0.0, 1.5, 6.0].map(gathers), [Some((1, 2)), Some((5, 2)), Some((16, 2))]);
        for tenths in 0..=160 {
            let (gathers, spacing) = gathers(tenths as f32 / 10.0).expect("a kernel");
            // The gathers reach 2.5 standard deviations in both directions.
            assert!(gathers <= PcfKernel::MAX_FALLBACK_GATHERS && (gathers - 1) * spacing >= tenths / 2, "{tenths}");
        }
        assert_eq!(
            PcfKernel::of(&ShadowSettings { pcf_fallback: false, ..ShadowSettings::default() }),
            None,
            "no lookup filters the depth"
        );
    }

    #[test]
    fn sources_contain_only_features_of_the_scene() {
        let defines = ["SHADOW_VARIANCE", "SHADOW_STANDARD", "SHADOW_FILTERED"];
        for (method, define) in
            [ShadowMethod::Variance, ShadowMethod::Standard, ShadowMethod::PercentageCloser].into_iter().zip(defines)
        {
            let shadow = ShadowSettings { method, ..ShadowSettings::default() };
            let features = |shadow| ShaderFeatures { shadow: Some(shadow), ..ShaderFeatures::NONE };
            let fallback = (method == ShadowMethod::Variance).then_some("PCF_FALLBACK");
            let expected_defines: Vec<&str> = ["SHADOWS", define].into_iter().chain(fallback).collect();
            assert_eq!(features(shadow).defines(), expected_defines);
            let options = ShaderOptions {
                features: features(shadow),
                image_filter: crate::shaders::ImageFilter { anisotropy: 1.0, blends_levels: false },
                inner_edges: false,
                used_materials: vec![],
                sample_positions: vec![],
                sample_resolve: String::new(),
                ambient_light: String::new(),
                post_depth_coverage: false,
            };
            assert_eq!(options.sun_visibility().contains("const int GATHERS"), define != "SHADOW_STANDARD");
            assert!(
                !options.sun_visibility().contains("CascadeBlock")
                    && !options.shadow(BlendMode::Opaque).stages[0].1.contains("CascadeBlock")
            );
            let without_fallback = ShadowSettings { pcf_fallback: false, ..shadow };
            assert_eq!(features(without_fallback).defines(), ["SHADOWS", define]);
            let cascaded = ShaderOptions { features: features(ShadowSettings { cascades: 3, ..shadow }), ..options };
            assert!(cascaded.sun_visibility().contains("CascadeBlock"));
            let four_cascades = features(ShadowSettings { cascades: 4, ..shadow });
            assert_eq!(four_cascades.defines().last(), Some(&"CASCADES 4"));
        }
    }
}
