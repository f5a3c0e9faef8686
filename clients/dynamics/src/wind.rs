//! Wind pressure by time and position: a steady component, gusts that travel downwind, and turbulence per domain.
//! Pressures are dimensionless: the tree scenario multiplies them by a calibrated strength. The same seed gives the
//! same wind.

use std::f64::consts::TAU;

use nalgebra::Vector3;

/// A periodic component of the downwind pressure.
struct Gust {
    /// Seconds.
    period: f64,
    /// Relative amplitude.
    amplitude: f64,
}

/// The gusts; their amplitudes add up to 1. Their periods have no simple ratios, so that the sum repeats only after a
/// long time.
const GUSTS: [Gust; 5] = [
    Gust { period: 0.83, amplitude: 0.30 },
    Gust { period: 1.31, amplitude: 0.30 },
    Gust { period: 2.17, amplitude: 0.22 },
    Gust { period: 3.71, amplitude: 0.12 },
    Gust { period: 6.43, amplitude: 0.06 },
];

/// The downwind channel of [`Wind::turbulence`].
pub const DOWNWIND_CHANNEL: u64 = 0;

/// The crosswind channel of [`Wind::turbulence`].
pub const CROSSWIND_CHANNEL: u64 = 1;

/// Time at which all gusts peak together at the downwind position 0, in seconds.
const PEAK_TIME: f64 = 0.55;

/// Time in which the wind rises from 0 to its full pressure, in seconds.
const RISE_TIME: f64 = 0.35;

/// A wind that blows in one horizontal direction.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Wind {
    /// Seed of the turbulence.
    pub seed: u64,
    /// Unit vector of the direction that the wind blows to.
    pub downwind: Vector3<f64>,
    /// Horizontal unit vector at a right angle to `downwind`.
    pub crosswind: Vector3<f64>,
    /// Travel time of a gust, in seconds per scene unit.
    pub delay_per_length: f64,
}

/// Components of the dimensionless pressure along the two horizontal directions of a wind.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct WindPressure {
    pub downwind: f64,
    pub crosswind: f64,
}

impl Wind {
    /// The pressure at `time` (seconds) on a domain. `downwind_position` is the domain's position along the wind, in
    /// scene units. The pressure is 0 at time 0. Its downwind component consists of a steady part (0.55), gusts (at
    /// most 0.45) and turbulence (at most 0.15).
    pub fn pressure(&self, time: f64, domain: usize, downwind_position: f64) -> WindPressure {
        let onset_factor = smoothstep(time / RISE_TIME);
        let gust_time = time - PEAK_TIME - self.delay_per_length * downwind_position;
        let gust_sum: f64 = GUSTS.iter().map(|gust| gust.amplitude * (TAU * gust_time / gust.period).cos()).sum();
        WindPressure {
            downwind: onset_factor * (0.55 + 0.45 * gust_sum + 0.15 * self.turbulence(time, domain, DOWNWIND_CHANNEL)),
            crosswind: onset_factor * 0.25 * self.turbulence(time, domain, CROSSWIND_CHANNEL),
        }
    }

    /// Turbulence from -1 to 1: the mean of three sines. Their frequencies (0.3 to 2 Hz) and phases are random per
    /// domain and channel ([`DOWNWIND_CHANNEL`] or [`CROSSWIND_CHANNEL`]).
    pub fn turbulence(&self, time: f64, domain: usize, channel: u64) -> f64 {
        let sine = |index: u64| {
            // A different counter for each domain, channel and sine, and for its frequency and phase.
            let counter = (domain as u64) * 16 + channel * 8 + 2 * index;
            let hertz = 0.3 + 1.7 * hash_to_unit(self.seed, counter);
            (TAU * (hertz * time + hash_to_unit(self.seed, counter + 1))).sin()
        };
        (0..3).map(sine).sum::<f64>() / 3.0
    }
}

/// A smooth step: 0 if x is below 0, 1 if x is above 1, and a cubic polynomial in between.
fn smoothstep(x: f64) -> f64 {
    let x = x.clamp(0.0, 1.0);
    x * x * (3.0 - 2.0 * x)
}

/// Hashes a seed and a counter to a pseudorandom number in [0, 1), with the finalizer of splitmix64.
fn hash_to_unit(seed: u64, counter: u64) -> f64 {
    let mut x = seed.wrapping_add(counter.wrapping_mul(0x9e37_79b9_7f4a_7c15)).wrapping_add(0x9e37_79b9_7f4a_7c15);
    x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    ((x ^ (x >> 31)) >> 11) as f64 / (1_u64 << 53) as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wind_starts_at_zero_and_depends_on_seed_and_domain() {
        let wind = Wind { seed: 1, downwind: Vector3::x(), crosswind: Vector3::z(), delay_per_length: 0.1 };
        assert_eq!(wind.pressure(0.0, 3, 0.5), WindPressure { downwind: 0.0, crosswind: 0.0 });
        let other_wind = Wind { seed: 2, ..wind };
        let mut max_pressure = 0.0_f64;
        for step in 1..2000 {
            let time = f64::from(step) * 0.01;
            let pressure = wind.pressure(time, 3, 0.5);
            assert_eq!(pressure, wind.pressure(time, 3, 0.5));
            assert_ne!(pressure, wind.pressure(time, 4, 0.5), "domains 3 and 4 at {time} s");
            assert_ne!(pressure, other_wind.pressure(time, 3, 0.5), "seeds 1 and 2 at {time} s");
            max_pressure = max_pressure.max(pressure.downwind.abs()).max(pressure.crosswind.abs());
        }
        // The largest possible pressure is 0.55 + 0.45 + 0.15 = 1.15.
        assert!(max_pressure <= 1.2, "expected at most 1.2, got {max_pressure}");
    }

    #[test]
    fn gust_arrives_later_downwind() {
        let wind = Wind { seed: 1, downwind: Vector3::x(), crosswind: Vector3::z(), delay_per_length: 0.2 };
        let peak_step = |downwind_position: f64| {
            let gust_pressure = |step: &i32| {
                let time = f64::from(*step) * 0.01;
                wind.pressure(time, 0, downwind_position).downwind - 0.15 * wind.turbulence(time, 0, DOWNWIND_CHANNEL)
            };
            // Start after 0.4 s, when the wind has reached its full pressure.
            (40..300).max_by(|a, b| gust_pressure(a).total_cmp(&gust_pressure(b))).unwrap_or(0)
        };
        // A delay of 0.2 s per scene unit over 2 units, in steps of 0.01 s.
        assert_eq!(peak_step(2.0) - peak_step(0.0), 40);
    }
}
