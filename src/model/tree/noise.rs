//! Periodic gradient noise on the unit square, so that images made of it tile seamlessly.

use super::random::mix64;

/// Gradient noise (after K. Perlin, "Improving noise", 2002) with `cells[0]` x `cells[1]` cells per tile.
#[derive(Debug, Clone, Copy)]
pub(super) struct GradientNoise {
    pub(super) cells: [i32; 2],
    pub(super) seed: u64,
}

impl GradientNoise {
    /// The noise at (u, v): about -1 to 1 with a mean of about 0, and with period 1 in both directions.
    pub(super) fn sample(&self, u: f32, v: f32) -> f32 {
        let (x, y) = (u * self.cells[0] as f32, v * self.cells[1] as f32);
        let (column, row) = (x.floor(), y.floor());
        let (dx, dy) = (x - column, y - row);
        let corner_value = |column_offset: i32, row_offset: i32| {
            let (gx, gy) = self.gradient(column as i32 + column_offset, row as i32 + row_offset);
            gx * (dx - column_offset as f32) + gy * (dy - row_offset as f32)
        };
        let (sx, sy) = (fade(dx), fade(dy));
        let top_value = corner_value(0, 0) * (1.0 - sx) + corner_value(1, 0) * sx;
        let bottom_value = corner_value(0, 1) * (1.0 - sx) + corner_value(1, 1) * sx;
        // The factor scales the interpolated values to about -1 to 1.
        1.4 * (top_value * (1.0 - sy) + bottom_value * sy)
    }

    /// The pseudo-random gradient at a grid point, of about unit length.
    fn gradient(&self, column: i32, row: i32) -> (f32, f32) {
        let grid_point_key = column.rem_euclid(self.cells[0]) as u64 | (row.rem_euclid(self.cells[1]) as u64) << 32;
        let angle_fraction = (mix64(grid_point_key ^ self.seed) >> 40) as f32 / (1_u32 << 24) as f32;
        // Parabolas approximate the sine and cosine of the gradient's angle, because they are cheaper. The argument is
        // the angle as a fraction of a full turn.
        let parabolic_sine = |angle_fraction: f32| {
            let x = 2.0 * angle_fraction.fract() - 1.0;
            4.0 * x * (1.0 - x.abs())
        };
        (parabolic_sine(angle_fraction + 0.25), parabolic_sine(angle_fraction))
    }
}

/// Perlin's quintic interpolation weight.
fn fade(t: f32) -> f32 {
    t * t * t * (t * (t * 6.0 - 15.0) + 10.0)
}

/// 0 below `low`, 1 above `high`, smooth in between.
pub(super) fn smoothstep(low: f32, high: f32, x: f32) -> f32 {
    let t = ((x - low) / (high - low)).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

/// Linear interpolation per channel: `a` at 0, `b` at 1.
pub(super) fn lerp_color(a: [f32; 3], b: [f32; 3], t: f32) -> [f32; 3] {
    std::array::from_fn(|channel| a[channel] + (b[channel] - a[channel]) * t)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_is_periodic_and_bounded() {
        let noise = GradientNoise { cells: [5, 3], seed: 11 };
        let mut sum = 0.0;
        let mut peak = 0.0_f32;
        for step in 0..400 {
            let (u, v) = (step as f32 / 400.0, (step as f32 * 0.377).fract());
            let value = noise.sample(u, v);
            assert!((value - noise.sample(u + 1.0, v)).abs() < 1e-4);
            assert!((value - noise.sample(u, v - 1.0)).abs() < 1e-4);
            assert!(value.abs() <= 1.5);
            sum += value;
            peak = peak.max(value.abs());
        }
        assert!(peak > 0.3);
        assert!((sum / 400.0_f32).abs() < 0.15);
    }
}
