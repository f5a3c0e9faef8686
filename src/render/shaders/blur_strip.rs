//! Generates the shader that blurs a variance shadow map by strips. A workgroup blurs a strip of consecutive rows, with
//! one column per lane (an invocation of the workgroup). The code is unrolled with one variable per sum, because not
//! all compilers keep arrays in registers. It is inserted into `shaders/vsm_blur_strip.comp`, which declares the GLSL
//! variables `corner`, `lane`, `side`, `first_row` and `buffer_offset`.

use std::fmt::Write as _;

use modalcast_model::scene::ShadowSettings;

/// Largest radius of the blur kernel for which the first of [`STRIP_SHAPES`] is used. Measured on an H200 with a map of
/// 4096 x 4096 texels: a radius of 7 takes 135 us with the first shape and 154 us with the second; a radius of 12 takes
/// 200 us and 166 us.
const NARROW_RADIUS: u32 = 9;
/// Lanes per workgroup and rows per iteration: first for narrow kernels, then for wide kernels.
const STRIP_SHAPES: [(u32, u32); 2] = [(64, 4), (128, 8)];
/// Largest radius of the blur kernel whose 2 `radius` + 1 sums fit into the registers of a lane.
const MAX_RADIUS: u32 = 24;

/// Strip of the map that a workgroup blurs, in texels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct BlurStrip {
    /// Columns, one per lane.
    pub(crate) columns: u32,
    /// Rows that the workgroup writes.
    pub(crate) rows: u32,
    /// Rows per iteration.
    rows_per_iteration: u32,
    /// Radius of the blur kernel.
    radius: u32,
}

impl BlurStrip {
    /// Fits a strip to the blur of a shadow map; none if the kernel is too wide. A strip also processes 2 `radius` rows
    /// that it does not write. Large maps have tall strips, so that this overhead is small. Small maps have short
    /// strips, because the device needs many workgroups.
    pub(crate) fn fit(shadow: &ShadowSettings) -> Option<Self> {
        let radius = shadow.blur_radius();
        let (columns, rows_per_iteration) = STRIP_SHAPES[usize::from(radius > NARROW_RADIUS)];
        let input_rows = (shadow.size / 32).clamp(16, 128) + 2 * radius;
        let rows = input_rows.next_multiple_of(rows_per_iteration) - 2 * radius;
        (radius <= MAX_RADIUS).then_some(Self { columns, rows, rows_per_iteration, radius })
    }

    /// Bytes of shared memory: two buffers of f32 depths of an iteration's rows, with margins.
    #[cfg(test)]
    const fn shared_bytes(self) -> u32 {
        2 * 4 * self.rows_per_iteration * (self.columns + 2 * self.radius)
    }

    /// Defines of the strip, and the shader body. The caller prepends the version, the defines FORMAT and
    /// WORKGROUP_SIZE, and `centered_depth`. `weights`: one half of a Gaussian, center first.
    pub(crate) fn text(self, weights: &[f32]) -> String {
        let Self { rows, rows_per_iteration, radius, .. } = self;
        let text = format!(
            "#define OUTPUT_ROWS {rows}\n#define ITERATION_ROWS {rows_per_iteration}\n#define RADIUS {radius}\n"
        );
        let body = include_str!("../../../shaders/vsm_blur_strip.comp");
        let parts = [
            ("// @SUMS", self.declare_sums()),
            ("// @LOAD", self.load_depths()),
            ("// @ADD", self.accumulate_rows(weights)),
        ];
        text + &parts.into_iter().fold(String::from(body), |body, (marker, code)| body.replace(marker, &code))
    }

    /// Declares the partial sums that an iteration carries over to the next.
    fn declare_sums(self) -> String {
        (0..2 * self.radius).map(|sum| format!("vec2 sum{sum} = vec2(0.0);\n")).collect()
    }

    /// Loads the depths of an iteration's rows into shared memory: the column of each lane, then the left and right
    /// margins, distributed over all lanes. All loads precede the first store, so that their latencies overlap.
    fn load_depths(self) -> String {
        let Self { columns, rows_per_iteration, radius, .. } = self;
        let row_pitch = columns + 2 * radius;
        let (mut loads, mut stores) = (String::new(), String::new());
        for row in 0..rows_per_iteration {
            let texel = format!("corner + ivec2(lane, first_row + {row} - {radius})");
            writeln!(loads, "float depth{row} = centered_depth({texel}, side);").ok();
            writeln!(stores, "depths[buffer_offset + {} + lane] = depth{row};", row * row_pitch + radius).ok();
        }
        // A row has `radius` margin texels to the left of the strip, then `radius` to the right. Each lane loads one
        // margin texel per iteration of this loop.
        let margin_count = rows_per_iteration * 2 * radius;
        for (index, first) in (0..margin_count).step_by(columns as usize).enumerate() {
            writeln!(loads, "int texel{index} = {first} + lane, row{index} = texel{index} / {};", 2 * radius).ok();
            writeln!(loads, "int column{index} = texel{index} % {};", 2 * radius).ok();
            writeln!(loads, "if (column{index} >= {radius}) column{index} += {columns};").ok();
            writeln!(loads, "float margin{index} = 0.0;").ok();
            let guard = if first + columns > margin_count {
                format!("if (texel{index} < {margin_count}) ")
            } else {
                String::new()
            };
            let texel = format!("corner + ivec2(column{index}, first_row + row{index}) - {radius}");
            writeln!(loads, "{guard}margin{index} = centered_depth({texel}, side);").ok();
            writeln!(
                stores,
                "{guard}depths[buffer_offset + row{index} * {row_pitch} + column{index}] = margin{index};"
            )
            .ok();
        }
        loads + &stores
    }

    /// Blurs the rows of an iteration horizontally, adds each row to the vertical sums that contain it, and stores the
    /// sums that are complete. `sum0` is the oldest sum. An iteration completes one sum per row; the remaining sums are
    /// then renumbered from 0.
    fn accumulate_rows(self, weights: &[f32]) -> String {
        let Self { columns, rows_per_iteration, radius, .. } = self;
        let weight_at = |position: u32, center: u32| format!("{:?}", weights[position.abs_diff(center) as usize]);
        let mut text = String::new();
        for row in 0..rows_per_iteration {
            writeln!(text, "vec2 blurred{row} = vec2(0.0);").ok();
            for tap in 0..=2 * radius {
                let offset = row * (columns + 2 * radius) + tap;
                writeln!(text, "float m{row}_{tap} = depths[buffer_offset + {offset} + lane];").ok();
                let pair = format!("vec2(m{row}_{tap}, m{row}_{tap} * m{row}_{tap})");
                writeln!(text, "blurred{row} += {} * {pair};", weight_at(tap, radius)).ok();
            }
            for sum in row..row + 2 * radius {
                writeln!(text, "sum{sum} += {} * blurred{row};", weight_at(sum, row + radius)).ok();
            }
            let new_sum = row + 2 * radius;
            writeln!(text, "vec2 sum{new_sum} = {} * blurred{row};", weight_at(new_sum, row + radius)).ok();
            let texel = format!("corner + ivec2(lane, first_row + {row} - {})", 2 * radius);
            // The sums that the first 2 `radius` rows complete belong to rows above the strip.
            let min_first_row = (2 * radius).saturating_sub(row);
            writeln!(
                text,
                "if (first_row >= {min_first_row}) imageStore(destination, {texel}, vec4(sum{row}, 0.0, 0.0));"
            )
            .ok();
        }
        for sum in 0..2 * radius {
            writeln!(text, "sum{sum} = sum{};", sum + rows_per_iteration).ok();
        }
        text
    }
}

#[cfg(test)]
mod tests {
    use super::super::shadow::{SHARED_BYTES, gaussian_weights};
    use super::*;

    fn strip(blur: f32, size: u32) -> Option<BlurStrip> {
        BlurStrip::fit(&ShadowSettings { blur, size, ..ShadowSettings::default() })
    }

    #[test]
    fn strips_fit_into_shared_memory_in_whole_iterations() {
        // Blurs from 0 to 16 texels.
        for tenths in 0..=160 {
            let blur = tenths as f32 / 10.0;
            for size in [16, 512, 1000, 4096, 16384] {
                let Some(strip) = strip(blur, size) else {
                    // The radius is 3 blur, rounded up; a blur of 8 texels has MAX_RADIUS.
                    assert!(blur > 8.0, "expected a strip for blur {blur}");
                    continue;
                };
                assert!(
                    strip.shared_bytes() <= SHARED_BYTES && strip.radius <= MAX_RADIUS && strip.rows >= 16,
                    "{strip:?}"
                );
                assert_eq!((strip.rows + 2 * strip.radius) % strip.rows_per_iteration, 0, "{strip:?}");
            }
        }
        assert!(strip(8.1, 1024).is_none(), "expected no strip for a radius of 25 texels");
    }

    #[test]
    fn iteration_adds_each_row_to_all_its_sums() {
        for blur in [0.0, 0.3, 1.5, 2.3, 4.0, 8.0] {
            let (strip, weights) = (strip(blur, 4096).expect("a strip"), gaussian_weights(blur));
            let text = strip.text(&weights);
            let (taps, count) = (2 * strip.radius + 1, |pattern: &str| text.matches(pattern).count() as u32);
            assert_eq!(
                (count("@"), count("imageStore(destination")),
                (0, strip.rows_per_iteration),
                "{blur}: markers and stores"
            );
            // Stores to `depths` contain "] = ", loads do not.
            assert_eq!(
                count("depths[buffer_offset + ") - count("] = "),
                strip.rows_per_iteration * taps,
                "{blur}: depths read"
            );
            assert_eq!(count(" * blurred"), strip.rows_per_iteration * taps, "{blur}: sums");
            let center = format!("{:?} * blurred0", weights[0]);
            let center_sum = format!("sum{} += {center}", strip.radius);
            assert!(
                text.contains(&center_sum) || strip.radius == 0,
                "{blur}: expected the center weight of the center row"
            );
        }
    }
}
