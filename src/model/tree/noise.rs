//! Periodic gradient noise on the unit square, so that images made of it tile seamlessly.

use super::random::mix64;

/// Gradient noise (after K. Perlin, "Improving noise", 2002) with `cells[0]` x `cells[1]` cells per tile.
#[derive(Debug, Clone, Copy)]
pub(super) struct GradientNoise {
    pub(super) cells: [i32; 2],
    pub(super) seed: u64,
}

impl GradientNoise {
    /// Noise of about -1 to 1, with period 1 in both `u` and `v` and a mean of about 0.
    pub(super) fn at(&self, u: f32, v: f32) -> f32 {
        let (x, y) = (u * self.cells[0] as f32, v * self.cells[1] as f32);
        let (column, row) = (x.floor(), y.floor());
        let (dx, dy) = (x - column, y - row);
        let corner = |right: i32, down: i32| {
            let (gx, gy) = self.gradient(column as i32 + right, row as i32 + down);
            gx * (dx - right as f32) + gy * (dy - down as f32)
        };
        let (sx, sy) = (fade(dx), fade(dy));
        let top = corner(0, 0) * (1.0 - sx) + corner(1, 0) * sx;
        let bottom = corner(0, 1) * (1.0 - sx) + corner(1, 1) * sx;
        1.4 * (top * (1.0 - sy) + bottom * sy)
    }

    fn gradient(&self, column: i32, row: i32) -> (f32, f32) {
        let place = column.rem_euclid(self.cells[0]) as u64 | (row.rem_euclid(self.cells[1]) as u64) << 32;
        let turn = (mix64(place ^ self.seed) >> 40) as f32 / (1_u32 << 24) as f32;
        // Approximate cosine and sine of the gradient's angle by parabolas, which is cheaper.
        let wave = |turn: f32| {
            let x = 2.0 * turn.fract() - 1.0;
            4.0 * x * (1.0 - x.abs())
        };
        (wave(turn + 0.25), wave(turn))
    }
}

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
    fn noise_is_periodic_bounded_and_not_constant() {
        let noise = GradientNoise { cells: [5, 3], seed: 11 };
        let mut sum = 0.0;
        let mut peak = 0.0_f32;
        for step in 0..400 {
            let (u, v) = (step as f32 / 400.0, (step as f32 * 0.377).fract());
            let here = noise.at(u, v);
            assert!((here - noise.at(u + 1.0, v)).abs() < 1e-4);
            assert!((here - noise.at(u, v - 1.0)).abs() < 1e-4);
            assert!(here.abs() <= 1.5);
            sum += here;
            peak = peak.max(here.abs());
        }
        assert!(peak > 0.3);
        assert!((sum / 400.0_f32).abs() < 0.15);
    }
}
