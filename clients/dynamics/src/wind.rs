//! Time and place to wind: a steady part, gusts that travel downwind, and turbulence of each part's own. Pressures are
//! relative (the tree scales them); everything is deterministic for a seed.

use std::f64::consts::TAU;

use nalgebra::Vector3;

/// Periods in seconds (no two commensurate) and strengths of the gusts.
const GUSTS: [(f64, f64); 5] = [(0.83, 0.30), (1.31, 0.30), (2.17, 0.22), (3.71, 0.12), (6.43, 0.06)];

/// When all gusts of the first front peak together, in seconds, and how long the wind takes to rise.
const FRONT: f64 = 0.55;
const RISE: f64 = 0.35;

/// A wind that blows along one horizontal direction.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Wind {
    pub seed: u64,
    /// Downwind, and across, unit vectors.
    pub along: Vector3<f64>,
    pub across: Vector3<f64>,
    /// Seconds that a gust takes per unit of length.
    pub delay: f64,
}

impl Wind {
    /// Pressures along and across at `time` for a part, at `distance` downwind. They begin at zero.
    pub fn pressure(&self, time: f64, part: usize, distance: f64) -> (f64, f64) {
        let rise = smooth(time / RISE);
        let here = time - FRONT - self.delay * distance;
        let gust: f64 = GUSTS.iter().map(|(period, strength)| strength * (TAU * here / period).cos()).sum();
        let (own, side) = (self.turbulence(time, part, 0), self.turbulence(time, part, 1));
        (rise * (0.55 + 0.45 * gust + 0.15 * own), rise * 0.25 * side)
    }

    /// A sum of three sines of the part's own frequencies (0.3 to 2 Hz) and phases, between -1 and 1.
    pub fn turbulence(&self, time: f64, part: usize, channel: u64) -> f64 {
        let wave = |index: u64| {
            let name = (part as u64) * 16 + channel * 8 + 2 * index;
            let hertz = 0.3 + 1.7 * random(self.seed, name);
            (TAU * (hertz * time + random(self.seed, name + 1))).sin()
        };
        (0..3).map(wave).sum::<f64>() / 3.0
    }
}

/// 0 below 0, 1 above 1, smooth between.
fn smooth(x: f64) -> f64 {
    let x = x.clamp(0.0, 1.0);
    x * x * (3.0 - 2.0 * x)
}

/// A number from 0 to 1 that belongs to a seed and a name (the finaliser of splitmix64).
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
    fn the_wind_begins_at_zero_repeats_for_its_seed_and_varies_from_part_to_part() {
        let wind = Wind { seed: 1, along: Vector3::x(), across: Vector3::z(), delay: 0.1 };
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
    fn a_gust_arrives_later_downwind() {
        let wind = Wind { seed: 1, along: Vector3::x(), across: Vector3::z(), delay: 0.2 };
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
