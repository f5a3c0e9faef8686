//! Wind pressure by time and place: a steady component, gusts that travel downwind, and turbulence per part. Pressures
//! are relative, and the tree scales them. The same seed gives the same wind.

use std::f64::consts::TAU;

use nalgebra::Vector3;

/// Periods in seconds, without simple ratios between them, and strengths of the gusts.
const GUSTS: [(f64, f64); 5] = [(0.83, 0.30), (1.31, 0.30), (2.17, 0.22), (3.71, 0.12), (6.43, 0.06)];

/// Time at which all gusts peak together at distance 0, and rise time of the wind, in seconds.
const FRONT: f64 = 0.55;
const RISE: f64 = 0.35;

/// A wind that blows along one horizontal direction.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Wind {
    pub seed: u64,
    /// Downwind and crosswind unit vectors.
    pub along: Vector3<f64>,
    pub across: Vector3<f64>,
    /// Travel time of a gust, in seconds per scene unit.
    pub delay_per_length: f64,
}

impl Wind {
    /// Pressures along and across the wind at `time` (seconds) on a part at `distance` downwind. Both are 0 at time 0.
    pub fn pressure(&self, time: f64, part: usize, distance: f64) -> (f64, f64) {
        let rise = smoothstep(time / RISE);
        let here = time - FRONT - self.delay_per_length * distance;
        let gust: f64 = GUSTS.iter().map(|(period, strength)| strength * (TAU * here / period).cos()).sum();
        let (own, side) = (self.turbulence(time, part, 0), self.turbulence(time, part, 1));
        (rise * (0.55 + 0.45 * gust + 0.15 * own), rise * 0.25 * side)
    }

    /// The mean of three sines with random frequencies (0.3 to 2 Hz) and phases per part, between -1 and 1.
    pub fn turbulence(&self, time: f64, part: usize, channel: u64) -> f64 {
        let wave = |index: u64| {
            let name = (part as u64) * 16 + channel * 8 + 2 * index;
            let hertz = 0.3 + 1.7 * random(self.seed, name);
            (TAU * (hertz * time + random(self.seed, name + 1))).sin()
        };
        (0..3).map(wave).sum::<f64>() / 3.0
    }
}

/// Smoothstep: 0 below 0, 1 above 1.
fn smoothstep(x: f64) -> f64 {
    let x = x.clamp(0.0, 1.0);
    x * x * (3.0 - 2.0 * x)
}

/// A pseudorandom number in [0, 1) for a seed and a name (the finalizer of splitmix64).
pub fn random(seed: u64, name: u64) -> f64 {
    let mut x = seed.wrapping_add(name.wrapping_mul(0x9e37_79b9_7f4a_7c15)).wrapping_add(0x9e37_79b9_7f4a_7c15);
    x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    ((x ^ (x >> 31)) >> 11) as f64 / (1_u64 << 53) as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wind_starts_at_zero_and_depends_on_seed_and_part() {
        let wind = Wind { seed: 1, along: Vector3::x(), across: Vector3::z(), delay_per_length: 0.1 };
        assert_eq!(wind.pressure(0.0, 3, 0.5), (0.0, 0.0));
        let other = Wind { seed: 2, ..wind };
        let (mut same, mut largest) = (0, 0.0_f64);
        for step in 1..2000 {
            let time = f64::from(step) * 0.01;
            let here = wind.pressure(time, 3, 0.5);
            assert_eq!(here, wind.pressure(time, 3, 0.5));
            same +=
                usize::from(here == wind.pressure(time, 4, 0.5)) + usize::from(here == other.pressure(time, 3, 0.5));
            largest = largest.max(here.0.abs()).max(here.1.abs());
        }
        assert!(same == 0 && largest <= 1.2, "{same} {largest}");
    }

    #[test]
    fn gust_arrives_later_downwind() {
        let wind = Wind { seed: 1, along: Vector3::x(), across: Vector3::z(), delay_per_length: 0.2 };
        let peak = |distance: f64| {
            let steps = 40..300;
            let force = |step: &i32| {
                let time = f64::from(*step) * 0.01;
                wind.pressure(time, 0, distance).0 - 0.15 * wind.turbulence(time, 0, 0)
            };
            steps.max_by(|a, b| force(a).total_cmp(&force(b))).unwrap_or(0)
        };
        assert_eq!(peak(2.0) - peak(0.0), 40);
    }
}
