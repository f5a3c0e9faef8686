//! Generates the shader that blurs a variance map by strips, with every sum in a variable of its own: not all compilers
//! keep arrays in registers.

use std::fmt::Write as _;

use modalcast_model::scene::ShadowSettings;

/// Lanes per workgroup and rows per iteration, for kernels with a reach up to `NARROW_RADIUS` and beyond. A longer kernel needs
/// more sums, which leaves registers for fewer lanes; lanes wait at fewer barriers when an iteration has more rows.
/// Measured on an H200 with a 4096^2 map: 15 taps take 135 us with the first and 154 us with the second setting, 25
/// taps take 200 us and 166 us.
const NARROW_RADIUS: u32 = 9;
const STRIP_SHAPES: [(u32, u32); 2] = [(64, 4), (128, 8)];
/// The widest reach whose sums still fit into the registers of a lane.
const MAX_RADIUS: u32 = 24;

/// The strip of a workgroup: one column per lane, and the number of rows that it writes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct BlurStrip {
    /// Columns, one per lane.
    pub(crate) wide: u32,
    pub(crate) tall: u32,
    /// Rows per iteration, which are loaded together.
    rows_per_step: u32,
    reach: u32,
}

impl BlurStrip {
    /// None if the kernel is too wide. Each strip also processes 2 `reach` rows that it does not store, so tall strips
    /// cost less; a small map needs many strips to occupy the device.
    pub(crate) fn of(shadow: &ShadowSettings) -> Option<Self> {
        let reach = shadow.blur_radius();
        let (wide, rows_per_step) = STRIP_SHAPES[usize::from(reach > NARROW_RADIUS)];
        let rows = (shadow.size / 32).clamp(16, 128) + 2 * reach;
        let tall = rows.next_multiple_of(rows_per_step) - 2 * reach;
        (reach <= MAX_RADIUS).then_some(Self { wide, tall, rows_per_step, reach })
    }

    /// Bytes of shared memory.
    #[cfg(test)]
    const fn bytes(self) -> u32 {
        4 * 2 * self.rows_per_step * (self.wide + 2 * self.reach)
    }

    /// The shader source after its head, which defines LANES, for one half of a Gaussian with these weights.
    pub(crate) fn text(self, weights: &[f32]) -> String {
        let Self { tall, rows_per_step, reach, .. } = self;
        let text = format!("#define OUTPUT_ROWS {tall}\n#define STEP_ROWS {rows_per_step}\n#define RADIUS {reach}\n");
        let body = include_str!("../../../shaders/vsm_blur_strip.comp");
        let parts = [("// @SUMS", self.sums()), ("// @LOAD", self.load()), ("// @ADD", self.add(weights))];
        text + &parts.into_iter().fold(String::from(body), |body, (place, part)| body.replace(place, &part))
    }

    /// Partial sums that an iteration carries over to the next.
    fn sums(self) -> String {
        (0..2 * self.reach).map(|sum| format!("vec2 sum{sum} = vec2(0.0);\n")).collect()
    }

    /// Loads the depths of an iteration's rows into shared memory: each lane's own column, then the margins. All loads
    /// are issued before the first one is waited for.
    fn load(self) -> String {
        let Self { wide, rows_per_step, reach, .. } = self;
        let pitch = wide + 2 * reach;
        let (mut read, mut write) = (String::new(), String::new());
        for row in 0..rows_per_step {
            let at = format!("corner + ivec2(lane, first + {row} - {reach})");
            writeln!(read, "float own{row} = centered_depth({at}, side);").ok();
            writeln!(write, "depths[half_at + {} + lane] = own{row};", row * pitch + reach).ok();
        }
        let cells = rows_per_step * 2 * reach;
        for (index, begin) in (0..cells).step_by(wide as usize).enumerate() {
            writeln!(read, "int cell{index} = {begin} + lane, row{index} = cell{index} / {};", 2 * reach).ok();
            writeln!(read, "int column{index} = cell{index} % {};", 2 * reach).ok();
            writeln!(read, "if (column{index} >= {reach}) column{index} += {wide};").ok();
            writeln!(read, "float beside{index} = 0.0;").ok();
            let inside = if begin + wide > cells { format!("if (cell{index} < {cells}) ") } else { String::new() };
            let at = format!("corner + ivec2(column{index}, first + row{index}) - {reach}");
            writeln!(read, "{inside}beside{index} = centered_depth({at}, side);").ok();
            writeln!(write, "{inside}depths[half_at + row{index} * {pitch} + column{index}] = beside{index};").ok();
        }
        read + &write
    }

    /// Adds the blurred rows of an iteration to the sums that use them, and stores the sums that are complete.
    fn add(self, weights: &[f32]) -> String {
        let Self { wide, rows_per_step, reach, .. } = self;
        let weight = |from: u32, to: u32| format!("{:?}", weights[from.abs_diff(to) as usize]);
        let mut text = String::new();
        for row in 0..rows_per_step {
            writeln!(text, "vec2 blurred{row} = vec2(0.0);").ok();
            for tap in 0..=2 * reach {
                let from = row * (wide + 2 * reach) + tap;
                writeln!(text, "float m{row}_{tap} = depths[half_at + {from} + lane];").ok();
                let pair = format!("vec2(m{row}_{tap}, m{row}_{tap} * m{row}_{tap})");
                writeln!(text, "blurred{row} += {} * {pair};", weight(tap, reach)).ok();
            }
            for sum in row..row + 2 * reach {
                writeln!(text, "sum{sum} += {} * blurred{row};", weight(sum, row + reach)).ok();
            }
            let last = row + 2 * reach;
            writeln!(text, "vec2 sum{last} = {} * blurred{row};", weight(last, row + reach)).ok();
            let at = format!("corner + ivec2(lane, first + {row} - {})", 2 * reach);
            let within = (2 * reach).saturating_sub(row);
            writeln!(text, "if (first >= {within}) imageStore(destination, {at}, vec4(sum{row}, 0.0, 0.0));").ok();
        }
        for sum in 0..2 * reach {
            writeln!(text, "sum{sum} = sum{};", sum + rows_per_step).ok();
        }
        text
    }
}

#[cfg(test)]
mod tests {
    use super::super::shadow::{SHARED_BYTES, gaussian_weights};
    use super::*;

    fn strip(blur: f32, size: u32) -> Option<BlurStrip> {
        BlurStrip::of(&ShadowSettings { blur, size, ..ShadowSettings::default() })
    }

    #[test]
    fn strips_fit_into_shared_memory_and_are_walked_in_whole_turns_up_to_the_widest_reach() {
        for step in 0..=160 {
            let blur = step as f32 / 10.0;
            for size in [16, 512, 1000, 4096, 16384] {
                let Some(strip) = strip(blur, size) else {
                    assert!(blur > 8.0, "{blur}");
                    continue;
                };
                assert!(strip.bytes() <= SHARED_BYTES && strip.reach <= MAX_RADIUS && strip.tall >= 16, "{strip:?}");
                assert_eq!((strip.tall + 2 * strip.reach) % strip.rows_per_step, 0, "{strip:?}");
            }
        }
        assert!(strip(8.1, 1024).is_none(), "control");
    }

    #[test]
    fn a_turn_adds_every_row_to_all_its_sums_and_stores_each_that_is_whole() {
        for blur in [0.0, 0.3, 1.5, 2.3, 4.0, 8.0] {
            let (strip, weights) = (strip(blur, 4096).expect("narrow enough"), gaussian_weights(blur));
            let text = strip.text(&weights);
            let (taps, count) = (2 * strip.reach + 1, |part: &str| text.matches(part).count() as u32);
            assert_eq!((count("@"), count("imageStore(destination")), (0, strip.rows_per_step), "{blur}");
            assert_eq!(count("depths[half_at + ") - count("] = "), strip.rows_per_step * taps, "{blur}: depths read");
            assert_eq!(count(" * blurred"), strip.rows_per_step * taps, "{blur}: sums");
            let center = format!("{:?} * blurred0", weights[0]);
            let own_row = format!("sum{} += {center}", strip.reach);
            assert!(text.contains(&own_row) || strip.reach == 0, "{blur}: the middle row has the middle weight");
        }
    }
}
