//! Wind pressure by time and position: a mean wind with turbulence of von Karman's spectrum. The wind is a sum of
//! cosines with random frequencies and phases (Shinozuka and Deodatis 1991), so that it is a function of time and of a
//! seed. Speeds are in meters per second, and pressures in pascals: 1/2 rho |v| v.
//!
//! With the frequency n, the length scale L, the mean speed V and the standard deviation sigma of a gust speed, the
//! spectra S of the gust speeds along and across the wind are (von Karman 1948, in the form of ESDU 85020)
//!
//! ```text
//! n S(n) / sigma^2 = 4 x / (1 + 70.8 x^2)^(5/6)                          along,  x = n L / V
//! n S(n) / sigma^2 = 4 x (1 + 755.2 x^2) / (1 + 283.2 x^2)^(11/6)        across, x = n L / (2 V)
//! ```
//!
//! Gusts travel with the mean wind. The gusts of two domains are less similar at higher frequencies: the magnitude of
//! their normalized cross-spectrum is exp(-10 n d / V) (Davenport 1961), with one typical distance d for all pairs of
//! domains. Slow gusts therefore move a tree as a whole, and fast ones each leaf on its own.
//!
//! The mean speed is the same at all heights: that at the crown. Turbulence intensity and length scale are those of EN
//! 1991-1-4 (4.4 and annex B) 10 m above ground, between the terrain categories III and IV: suburbs or forest, and
//! cities.

use std::f64::consts::{PI, TAU};

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::model::MIN_DOMAINS_PER_THREAD;
use crate::saved_state::number_bits;

/// rho, the density of air at 15 degrees Celsius and sea level (ICAO standard atmosphere), in kg/m^3.
pub(crate) const AIR_DENSITY: f64 = 1.225;

/// L, in meters.
const LENGTH_SCALE: f64 = 40.0;

/// Standard deviation of the gust speed along the wind, as a fraction of the mean speed.
const TURBULENCE_INTENSITY: f64 = 0.35;

/// Standard deviation of the gust speed across the wind, as a fraction of that along the wind.
const CROSSWIND_RATIO: f64 = 0.75;

/// Factor in the exponent of the coherence.
const COHERENCE_DECAY: f64 = 10.0;

/// Lowest and highest frequency in hertz. The range contains the first modes of trunks (about 0.5 Hz) and of leaves (3
/// to 7 Hz).
const FREQUENCY_RANGE: [f64; 2] = [0.05, 8.0];

/// Number of cosines. The frequencies of neighbors differ by 8 % on average. That is less than the bandwidth of a mode
/// with a damping ratio of 0.05 (10 %), so that no mode is between two frequencies.
const COSINE_COUNT: usize = 64;

/// Duration of the wind from which its start is selected, in seconds.
const SEARCH_DURATION: f64 = 600.0;

/// Duration over which a gust is averaged when the start of the wind is selected, in seconds.
const GUST_DURATION: f64 = 1.0;

/// Time of the strongest gust after the start of the wind, in seconds.
const GUST_TIME: f64 = 0.6;

/// Time in which the wind rises from 0, in seconds.
const RISE_TIME: f64 = 0.35;

/// Number of products that are summed separately, so that the compiler can vectorize the sums.
const LANES: usize = 8;

/// Direction of a gust speed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Component {
    Downwind,
    Crosswind,
}

/// Pressure in pascals along the two horizontal directions of a wind.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct WindPressure {
    #[serde(with = "number_bits")]
    pub downwind: f64,
    #[serde(with = "number_bits")]
    pub crosswind: f64,
}

/// Velocity of the air in m/s along the two horizontal directions of a wind.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct WindVelocity {
    pub(crate) downwind: f64,
    pub(crate) crosswind: f64,
}

/// Speeds of a gust, relative to the mean speed.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
struct GustSpeed {
    downwind: f64,
    crosswind: f64,
}

/// Settings of a wind.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WindSettings {
    /// Seed of all frequencies and phases.
    pub seed: u64,
    /// V, in m/s; 0 for calm air.
    pub mean_speed: f64,
    /// d, the typical distance between two domains, in meters.
    pub domain_distance: f64,
    /// Highest frequency of the wind in hertz. Frequencies that a run does not resolve are left out: they would appear
    /// as slower gusts that the spectrum does not contain.
    pub max_frequency: f64,
}

/// One frequency of the wind.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Cosine {
    /// Hertz.
    frequency: f64,
    /// Amplitudes of the gust speeds along and across the wind, relative to the mean speed.
    amplitudes: [f64; 2],
}

/// A wind that blows in one horizontal direction.
#[derive(Debug, Clone)]
pub struct Wind {
    /// The pressure of the mean wind in pascals.
    mean_pressure: f64,
    cosines: Vec<Cosine>,
    /// The argument of the cosines when the wind starts, in seconds.
    start_time: f64,
    /// Per domain: the factors of the gust speeds along and across the wind, in this order. A gust speed has one factor
    /// per cosine, then one factor per sine, then zeros up to a multiple of `LANES`.
    coefficients: Vec<f32>,
    /// Number of factors of one gust speed of a domain.
    coefficient_count: usize,
    domain_count: usize,
}

impl Wind {
    /// Creates a wind on domains at the given positions along the wind, in meters.
    pub fn new(settings: &WindSettings, downwind_positions: &[f64]) -> Self {
        let is_resolved = |cosine: &Cosine| settings.mean_speed > 0.0 && cosine.frequency <= settings.max_frequency;
        let cosines: Vec<Cosine> = create_cosines(settings).into_iter().filter(is_resolved).collect();
        let coefficient_count = (2 * cosines.len()).next_multiple_of(LANES);
        let coefficients = downwind_positions.par_iter().enumerate().flat_map_iter(|(domain, position)| {
            let delay = position / settings.mean_speed;
            let downwind = coefficients(&cosines, settings, Component::Downwind, domain, delay);
            let crosswind = coefficients(&cosines, settings, Component::Crosswind, domain, delay);
            [downwind, crosswind].into_iter().flat_map(move |mut factors| {
                factors.resize(coefficient_count, 0.0);
                factors
            })
        });
        Self {
            mean_pressure: 0.5 * AIR_DENSITY * settings.mean_speed.powi(2),
            start_time: find_start_time(&cosines, settings),
            coefficients: coefficients.collect(),
            coefficient_count,
            domain_count: downwind_positions.len(),
            cosines,
        }
    }

    /// The pressure in pascals of the gusts of a wind with a mean speed in m/s: the peak velocity pressure of EN 1991-1-4,
    /// equation 4.8, with a peak factor of 3.5.
    pub fn gust_pressure(mean_speed: f64) -> f64 {
        (1.0 + 7.0 * TURBULENCE_INTENSITY) * 0.5 * AIR_DENSITY * mean_speed.powi(2)
    }

    /// The highest frequency of all winds, in hertz.
    pub const fn highest_frequency() -> f64 {
        FREQUENCY_RANGE[1]
    }

    /// The pressure on every domain `time` seconds after the start of the wind: 1/2 rho |v| v with the velocity v of the
    /// wind. It is 0 at time 0.
    pub fn pressures(&self, time: f64) -> Vec<WindPressure> {
        let pressure_scale = self.mean_pressure * smoothstep(time / RISE_TIME);
        let pressure = |gust: GustSpeed| {
            let speed = (1.0 + gust.downwind).hypot(gust.crosswind);
            WindPressure {
                downwind: pressure_scale * speed * (1.0 + gust.downwind),
                crosswind: pressure_scale * speed * gust.crosswind,
            }
        };
        self.gust_speeds(time).map(pressure).collect()
    }

    /// The velocity of the wind at every domain `time` seconds after its start, of which [`Self::pressures`] are the
    /// pressures on bodies at rest.
    pub(crate) fn velocities(&self, time: f64) -> Vec<WindVelocity> {
        let mean_speed = (2.0 * self.mean_pressure / AIR_DENSITY * smoothstep(time / RISE_TIME)).sqrt();
        let velocity = |gust: GustSpeed| WindVelocity {
            downwind: mean_speed * (1.0 + gust.downwind),
            crosswind: mean_speed * gust.crosswind,
        };
        self.gust_speeds(time).map(velocity).collect()
    }

    /// The gust speed at every domain.
    fn gust_speeds(&self, time: f64) -> impl IndexedParallelIterator<Item = GustSpeed> + '_ {
        let angle = |cosine: &Cosine| TAU * (cosine.frequency * (self.start_time + time)).fract();
        let cosines = self.cosines.iter().map(|cosine| angle(cosine).cos() as f32);
        let sines = self.cosines.iter().map(|cosine| angle(cosine).sin() as f32);
        let mut basis: Vec<f32> = cosines.chain(sines).collect();
        basis.resize(self.coefficient_count, 0.0);
        (0..self.domain_count).into_par_iter().with_min_len(MIN_DOMAINS_PER_THREAD).map(move |domain| {
            let count = self.coefficient_count;
            let (downwind, crosswind) = self.coefficients[2 * count * domain..][..2 * count].split_at(count);
            GustSpeed { downwind: dot(downwind, &basis), crosswind: dot(crosswind, &basis) }
        })
    }
}

/// The frequencies of all winds of a seed, in bands of equal ratio. Each is random in its band, so that the sum does
/// not repeat. The amplitudes have the energy of the spectrum in the band.
fn create_cosines(settings: &WindSettings) -> Vec<Cosine> {
    let WindSettings { seed, mean_speed, .. } = *settings;
    let cosine = |index: usize| {
        let (low, high) = (band_edge(index), band_edge(index + 1));
        let amplitude = |component| (2.0 * integrate_spectrum(component, mean_speed, low, high)).sqrt();
        Cosine {
            frequency: low * (high / low).powf(hash_to_unit(seed, u64::MAX - index as u64)),
            amplitudes: [amplitude(Component::Downwind), amplitude(Component::Crosswind)],
        }
    };
    (0..COSINE_COUNT).map(cosine).collect()
}

/// The lower edge of a frequency band, in hertz.
fn band_edge(index: usize) -> f64 {
    let [lowest, highest] = FREQUENCY_RANGE;
    lowest * (highest / lowest).powf(index as f64 / COSINE_COUNT as f64)
}

/// The spectrum n S(n) of a gust speed relative to the mean speed, at `frequency` hertz: see the module documentation.
fn spectrum(component: Component, mean_speed: f64, frequency: f64) -> f64 {
    match component {
        Component::Downwind => {
            let x = frequency * LENGTH_SCALE / mean_speed;
            TURBULENCE_INTENSITY.powi(2) * 4.0 * x / (1.0 + 70.8 * x * x).powf(5.0 / 6.0)
        }
        Component::Crosswind => {
            let x = frequency * 0.5 * LENGTH_SCALE / mean_speed;
            (CROSSWIND_RATIO * TURBULENCE_INTENSITY).powi(2) * 4.0 * x * (1.0 + 755.2 * x * x)
                / (1.0 + 283.2 * x * x).powf(11.0 / 6.0)
        }
    }
}

/// The variance of a gust speed between two frequencies: the integral of n S(n) over ln n, by Simpson's rule.
fn integrate_spectrum(component: Component, mean_speed: f64, low: f64, high: f64) -> f64 {
    let value = |frequency: f64| spectrum(component, mean_speed, frequency);
    let sum = value(low) + 4.0 * value((low * high).sqrt()) + value(high);
    sum * (high / low).ln() / 6.0
}

/// Magnitude of the normalized cross-spectrum of two domains.
fn coherence(settings: &WindSettings, frequency: f64) -> f64 {
    (-COHERENCE_DECAY * frequency * settings.domain_distance / settings.mean_speed).exp()
}

/// The factors of the cosines, then of the sines, of a gust speed. A domain has its own gusts and those of the whole
/// scene, which arrive `delay` seconds later than at the position 0. Their energies add up to that of the spectrum.
fn coefficients(
    cosines: &[Cosine],
    settings: &WindSettings,
    component: Component,
    domain: usize,
    delay: f64,
) -> Vec<f32> {
    let seed = settings.seed;
    let phasor = |(index, cosine): (usize, &Cosine)| {
        let coherence = coherence(settings, cosine.frequency);
        let scene_angle = scene_phase(seed, component, index) - TAU * (cosine.frequency * delay).fract();
        let counter = ((domain as u64 + 1) * 2 + component as u64) * COSINE_COUNT as u64 + index as u64;
        let own_angle = TAU * hash_to_unit(seed, counter);
        let (scene_amplitude, own_amplitude) = (coherence.sqrt(), (1.0 - coherence).sqrt());
        // cos(a + b) = cos a cos b - sin a sin b.
        let amplitude = cosine.amplitudes[component as usize];
        [
            (amplitude * (scene_amplitude * scene_angle.cos() + own_amplitude * own_angle.cos())) as f32,
            (-amplitude * (scene_amplitude * scene_angle.sin() + own_amplitude * own_angle.sin())) as f32,
        ]
    };
    let phasors: Vec<[f32; 2]> = cosines.iter().enumerate().map(phasor).collect();
    (0..2).flat_map(|part| phasors.iter().map(move |phasor| phasor[part])).collect()
}

/// The phase of the gusts of the whole scene, in radians.
fn scene_phase(seed: u64, component: Component, index: usize) -> f64 {
    TAU * hash_to_unit(seed, (component as u64) * COSINE_COUNT as u64 + index as u64)
}

/// Finds the start of the wind, `GUST_TIME` before its strongest gust. A short run then shows a gust, and the wind does
/// not become much stronger later.
fn find_start_time(cosines: &[Cosine], settings: &WindSettings) -> f64 {
    let amplitude = |cosine: &Cosine| {
        // The mean of a cosine over a duration d has the amplitude sin(pi n d) / (pi n d).
        let angle = PI * cosine.frequency * GUST_DURATION;
        cosine.amplitudes[Component::Downwind as usize] * coherence(settings, cosine.frequency).sqrt() * angle.sin()
            / angle
    };
    let amplitudes: Vec<f64> = cosines.iter().map(amplitude).collect();
    let phases: Vec<f64> =
        (0..cosines.len()).map(|index| scene_phase(settings.seed, Component::Downwind, index)).collect();
    let mean_gust = |time: f64| -> f64 {
        let terms = cosines.iter().zip(&amplitudes).zip(&phases);
        terms.map(|((cosine, amplitude), phase)| amplitude * (TAU * cosine.frequency * time + phase).cos()).sum()
    };
    let times = (0..(10.0 * SEARCH_DURATION) as u32).into_par_iter().map(|index| 0.1 * f64::from(index));
    // Of equal gusts, the earliest one is selected, so that the result does not depend on the number of threads.
    let gusts = times.map(|time| (mean_gust(time), time));
    let strongest = gusts
        .max_by(|(a_gust, a_time), (b_gust, b_time)| a_gust.total_cmp(b_gust).then_with(|| b_time.total_cmp(a_time)));
    strongest.map_or(0.0, |(_, time)| time) - GUST_TIME
}

/// The sum of products. Both slices have the same multiple of `LANES` entries.
fn dot(a: &[f32], b: &[f32]) -> f64 {
    let mut sums = [0.0_f32; LANES];
    for (a_lanes, b_lanes) in a.as_chunks::<LANES>().0.iter().zip(b.as_chunks::<LANES>().0) {
        for lane in 0..LANES {
            sums[lane] += a_lanes[lane] * b_lanes[lane];
        }
    }
    f64::from(sums.iter().sum::<f32>())
}

/// A smooth step: 0 if x is below 0, 1 if x is above 1, and a cubic polynomial in between.
fn smoothstep(x: f64) -> f64 {
    let x = x.clamp(0.0, 1.0);
    x * x * (3.0 - 2.0 * x)
}

/// Hashes a seed and a counter to a pseudorandom number in [0, 1), with the finalizer of splitmix64.
pub(crate) fn hash_to_unit(seed: u64, counter: u64) -> f64 {
    let mut x = seed.wrapping_add(counter.wrapping_mul(0x9e37_79b9_7f4a_7c15)).wrapping_add(0x9e37_79b9_7f4a_7c15);
    x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    ((x ^ (x >> 31)) >> 11) as f64 / (1_u64 << 53) as f64
}

#[cfg(test)]
mod tests;
