use super::*;

const SPEED: f64 = 12.0;

const SETTINGS: WindSettings =
    WindSettings { seed: 7, mean_speed: SPEED, domain_distance: 2.0, max_frequency: f64::INFINITY };

/// The pressure of the mean wind, in pascals.
const MEAN_PRESSURE: f64 = 0.5 * AIR_DENSITY * SPEED * SPEED;

/// A sum of five cosines for negative controls: periods in seconds and amplitudes. It has no energy above 2 Hz, and two
/// of its frequencies are close to those of modes of the built-in tree's trunk.
const FIVE_GUSTS: [(f64, f64); 5] = [(0.83, 0.30), (1.31, 0.30), (2.17, 0.22), (3.71, 0.12), (6.43, 0.06)];

/// Number of samples of a signal, a power of two, and the seconds between them.
const SAMPLES: usize = 8192;
const SAMPLE_TIME: f64 = 0.05;

/// Discrete Fourier transform of a power of two of complex numbers (Cooley and Tukey 1965).
fn fourier_transform(signal: &[[f64; 2]]) -> Vec<[f64; 2]> {
    if signal.len() == 1 {
        return signal.to_vec();
    }
    let half = |first: usize| fourier_transform(&signal.iter().copied().skip(first).step_by(2).collect::<Vec<_>>());
    let (even, odd, count) = (half(0), half(1), signal.len());
    let combine = |index: usize| {
        let ([a, b], [c, d]) = (even[index % (count / 2)], odd[index % (count / 2)]);
        let (sin, cos) = (-TAU * index as f64 / count as f64).sin_cos();
        [a + cos * c - sin * d, b + cos * d + sin * c]
    };
    (0..count).map(combine).collect()
}

/// The variance of a signal per frequency bin.
fn periodogram(signal: &[f64]) -> Vec<f64> {
    let transform = fourier_transform(&signal.iter().map(|value| [*value, 0.0]).collect::<Vec<_>>());
    let variance =
        |[real, imaginary]: &[f64; 2]| 2.0 * (real * real + imaginary * imaginary) / (SAMPLES as f64).powi(2);
    transform[..SAMPLES / 2].iter().map(variance).collect()
}

/// Variance between two frequencies in hertz.
fn variance_between(periodogram: &[f64], low: f64, high: f64) -> f64 {
    let frequency = |index: usize| index as f64 / (SAMPLES as f64 * SAMPLE_TIME);
    let bins = periodogram.iter().enumerate().skip(1);
    bins.filter(|(index, _)| (low..high).contains(&frequency(*index))).map(|(_, variance)| variance).sum()
}

/// Gust speeds of some domains: per domain and component, a signal.
fn record_gusts(wind: &Wind) -> Vec<[Vec<f64>; 2]> {
    let mut signals = vec![[vec![], vec![]]; wind.domain_count];
    for sample in 0..SAMPLES {
        let gusts: Vec<GustSpeed> = wind.gust_speeds(sample as f64 * SAMPLE_TIME).collect();
        for (signal, gust) in signals.iter_mut().zip(gusts) {
            signal[0].push(gust.downwind);
            signal[1].push(gust.crosswind);
        }
    }
    signals
}

/// Fails unless the signals have the energy of the spectrum in ranges of eight bands, nearly an octave each, with an
/// error of 25 %. The record is too short for the lowest range.
fn check_energy(signals: &[Vec<f64>], component: Component) -> Result<(), String> {
    let periodograms: Vec<Vec<f64>> = signals.iter().map(|signal| periodogram(signal)).collect();
    for range in 1..COSINE_COUNT / 8 {
        let (low, high) = (band_edge(8 * range), band_edge(8 * range + 8));
        let bands = 8 * range..8 * range + 8;
        let expected: f64 =
            bands.map(|band| integrate_spectrum(component, SPEED, band_edge(band), band_edge(band + 1))).sum();
        let variances = periodograms.iter().map(|periodogram| variance_between(periodogram, low, high));
        let ratio = variances.sum::<f64>() / signals.len() as f64 / expected;
        if !(0.75..=1.25).contains(&ratio) {
            return Err(format!("{low} to {high} Hz: {ratio} of the expected variance {expected}"));
        }
    }
    Ok(())
}

#[test]
fn gusts_have_the_energy_of_the_spectrum_at_all_frequencies() {
    for seed in [1, 7] {
        let signals = record_gusts(&Wind::new(&WindSettings { seed, ..SETTINGS }, &[0.0; 16]));
        let component_signals =
            |index: usize| signals.iter().map(|signal| signal[index].clone()).collect::<Vec<Vec<f64>>>();
        check_energy(&component_signals(0), Component::Downwind).expect("the spectrum along the wind");
        check_energy(&component_signals(1), Component::Crosswind).expect("the spectrum across the wind");
    }
    // Negative control: five cosines of the same variance.
    let variance: f64 = FIVE_GUSTS.iter().map(|(_, amplitude)| 0.5 * amplitude * amplitude).sum();
    let factor = TURBULENCE_INTENSITY / variance.sqrt();
    let gust = |time: f64| -> f64 {
        FIVE_GUSTS.iter().map(|(period, amplitude)| factor * amplitude * (TAU * time / period).cos()).sum()
    };
    let signal: Vec<f64> = (0..SAMPLES).map(|sample| gust(sample as f64 * SAMPLE_TIME)).collect();
    assert!(check_energy(std::slice::from_ref(&signal), Component::Downwind).is_err());
    let leaf_variance = variance_between(&periodogram(&signal), 3.0, 7.0);
    assert!(leaf_variance < 1e-3 * TURBULENCE_INTENSITY.powi(2), "expected no energy at the leaves' frequencies");
}

#[test]
fn spectra_are_normalized_and_isotropic_at_high_frequencies() {
    let integral = |component| -> f64 {
        let edge = |index: u32| 1e-7 * 10.0_f64.powf(f64::from(index) / 200.0);
        (0..2400).map(|index| integrate_spectrum(component, SPEED, edge(index), edge(index + 1))).sum()
    };
    let expected = TURBULENCE_INTENSITY.powi(2);
    assert!((integral(Component::Downwind) / expected - 1.0).abs() < 2e-3);
    assert!((integral(Component::Crosswind) / (expected * CROSSWIND_RATIO.powi(2)) - 1.0).abs() < 2e-3);
    // In the inertial range of isotropic turbulence, the lateral spectrum is 4/3 of the longitudinal one, and both
    // decrease with n^(-5/3) (Kolmogorov 1941). `spectrum` is n S(n).
    let ratio = spectrum(Component::Crosswind, SPEED, 1e4)
        / spectrum(Component::Downwind, SPEED, 1e4)
        / CROSSWIND_RATIO.powi(2);
    assert!((ratio - 4.0 / 3.0).abs() < 2e-3, "{ratio}");
    let slope = (spectrum(Component::Downwind, SPEED, 2e4) / spectrum(Component::Downwind, SPEED, 1e4)).log2();
    assert!((slope + 2.0 / 3.0).abs() < 1e-3, "{slope}");
}

/// Variance of a mode's response to cosines, each given as frequency (hertz) and amplitude.
fn response_variance(cosines: &[(f64, f64)], hertz: f64, damping_ratio: f64) -> f64 {
    let variance = |(frequency, amplitude): &(f64, f64)| {
        let ratio = frequency / hertz;
        0.5 * amplitude * amplitude / ((1.0 - ratio * ratio).powi(2) + (2.0 * damping_ratio * ratio).powi(2))
    };
    cosines.iter().map(variance).sum()
}

/// The response should hardly depend on whether a cosine has the frequency of a mode. The trunk of the built-in tree
/// has a damping ratio of 0.05; its lowest modes are between 0.4 and 1.5 Hz.
#[test]
fn response_changes_smoothly_with_the_frequency_of_a_mode() {
    let largest_change = |cosines: &[(f64, f64)]| {
        let responses: Vec<f64> = (0..=60)
            .map(|index| 0.4 * (1.5_f64 / 0.4).powf(f64::from(index) / 60.0))
            .map(|hertz| response_variance(cosines, hertz, 0.05).sqrt())
            .collect();
        // The frequencies of a window differ by 20 % or less.
        let windows = responses.windows(9);
        let ratio = |window: &[f64]| {
            window.iter().fold(0.0, |a: f64, b| a.max(*b)) / window.iter().fold(f64::MAX, |a, b| a.min(*b))
        };
        windows.map(ratio).fold(0.0, f64::max)
    };
    for seed in 0..8 {
        let cosines: Vec<(f64, f64)> = create_cosines(&WindSettings { seed, ..SETTINGS })
            .iter()
            .map(|cosine| (cosine.frequency, cosine.amplitudes[0]))
            .collect();
        assert!(largest_change(&cosines) < 1.6, "seed {seed}: {}", largest_change(&cosines));
    }
    let five_gusts = FIVE_GUSTS.map(|(period, amplitude)| (1.0 / period, amplitude));
    assert!(largest_change(&five_gusts) > 2.0, "control: {}", largest_change(&five_gusts));
}

#[test]
fn domains_share_slow_gusts_but_not_fast_ones() {
    let signals = record_gusts(&Wind::new(&SETTINGS, &[0.0; 12]));
    let difference = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a - b).collect::<Vec<f64>>();
    for (low, high, range) in [(0.06, 0.12, 0.0..0.4), (4.0, 8.0, 0.7..1.3)] {
        // The variance of the difference of two signals is 2 (1 - correlation) times that of a signal.
        let (mut differences, mut sums) = (0.0, 0.0);
        for pair in signals.windows(2) {
            let variance = |signal: &[f64]| variance_between(&periodogram(signal), low, high);
            differences += variance(&difference(&pair[0][0], &pair[1][0]));
            sums += variance(&pair[0][0]) + variance(&pair[1][0]);
        }
        let ratio = differences / sums;
        assert!(range.contains(&ratio), "{low} to {high} Hz: expected {range:?}, got {ratio}");
    }
}

#[test]
fn wind_starts_at_zero_and_depends_on_seed_and_domain() {
    let wind = Wind::new(&SETTINGS, &[0.5; 4]);
    assert_eq!(wind.pressures(0.0), [WindPressure::default(); 4]);
    let (same_wind, other_wind) =
        (Wind::new(&SETTINGS, &[0.5; 4]), Wind::new(&WindSettings { seed: 8, ..SETTINGS }, &[0.5; 4]));
    for step in 1..2000 {
        let time = f64::from(step) * 0.01;
        let pressures = wind.pressures(time);
        assert_eq!(pressures, same_wind.pressures(time));
        assert_ne!(pressures[3], pressures[2], "domains 3 and 2 at {time} s");
        assert_ne!(pressures, other_wind.pressures(time), "seeds 7 and 8 at {time} s");
    }
}

#[test]
fn run_begins_with_a_strong_gust() {
    for seed in 0..6 {
        let wind = Wind::new(&WindSettings { seed, ..SETTINGS }, &[0.0; 8]);
        let mean_pressure = |start: f64, duration: f64| {
            let times = (0..20).map(|index| start + duration * f64::from(index) / 20.0);
            times.map(|time| wind.pressures(time)[0].downwind / MEAN_PRESSURE).sum::<f64>() / 20.0
        };
        let (gust, mean) = (mean_pressure(0.35, 0.8), mean_pressure(0.35, 300.0));
        assert!(gust > 1.4 * mean && (0.7..1.6).contains(&mean), "seed {seed}: gust {gust}, mean {mean}");
    }
}

#[test]
fn gust_arrives_later_downwind() {
    // Below 0.1 Hz, the gusts of different domains are nearly the same. The gusts take 1.2 s to travel 14.4 m at the mean
    // speed of 12 m/s.
    let wind = Wind::new(&WindSettings { max_frequency: 0.1, ..SETTINGS }, &[0.0, 14.4]);
    let difference = |delay: f64| {
        let square = |index: u32| {
            let time = 10.0 + 0.5 * f64::from(index);
            let gust = |time: f64, domain: usize| wind.gust_speeds(time).collect::<Vec<_>>()[domain].downwind;
            (gust(time + delay, 1) - gust(time, 0)).powi(2)
        };
        (0..400).map(square).sum::<f64>()
    };
    let best = (0..40).map(|index| 0.1 * f64::from(index)).min_by(|a, b| difference(*a).total_cmp(&difference(*b)));
    let best = best.expect("a delay");
    assert!((best - 1.2).abs() <= 0.5, "expected 1.2 s, got {best}");
    assert!(difference(best + 2.0) > difference(best) && difference(best - 2.0) > difference(best));
}

#[test]
fn frequencies_above_the_limit_are_left_out() {
    let count = |max_frequency: f64| Wind::new(&WindSettings { max_frequency, ..SETTINGS }, &[0.0]).cosines.len();
    assert_eq!((count(8.0), count(0.01)), (COSINE_COUNT, 0));
    assert!(count(1.0) < COSINE_COUNT && count(1.0) > 0);
    let steady_wind = Wind::new(&WindSettings { max_frequency: 0.01, ..SETTINGS }, &[0.0]);
    assert_eq!(steady_wind.pressures(5.0), [WindPressure { downwind: MEAN_PRESSURE, crosswind: 0.0 }]);
}

/// Four times the pressure at twice the speed, on the average over ten minutes.
#[test]
fn pressure_is_proportional_to_the_square_of_the_speed() {
    let mean_pressure = |mean_speed: f64| {
        let wind = Wind::new(&WindSettings { mean_speed, ..SETTINGS }, &[0.0; 4]);
        let pressure = |sample: u32| wind.pressures(10.0 + 0.2 * f64::from(sample))[2].downwind;
        (0..3000).map(pressure).sum::<f64>() / 3000.0
    };
    let (breeze, gale) = (mean_pressure(8.0), mean_pressure(16.0));
    assert!((3.6..4.4).contains(&(gale / breeze)), "{breeze} Pa at 8 m/s, {gale} Pa at 16 m/s");
    // Turbulence adds its variance to the square of the mean speed.
    assert!((1.0..1.3).contains(&(breeze / (0.5 * AIR_DENSITY * 64.0))), "{breeze}");
    assert_eq!(mean_pressure(0.0), 0.0);
    assert!((mean_pressure(1e6) / 0.6125e12 - 1.0).abs() < 0.3 && mean_pressure(1e-6) > 0.0);
}
