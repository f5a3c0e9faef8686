//! The slow motion in which people see the vibrations of a stiff body.

/// Highest frequency in hertz of a vibration that is shown without slow motion: 12 steps per period at 60 steps per
/// second.
const MAX_SHOWN_HERTZ: f64 = 5.0;

/// Frequency in hertz at which slow motion shows the lowest mode, about: three steps of a factor are rounded to one.
const SLOW_HERTZ: f64 = 2.0;

/// Factors have one digit, one of these.
const DIGITS: [f64; 4] = [1.0, 2.0, 5.0, 10.0];

/// The largest factor.
const MAX_FACTOR: f64 = 1e6;

/// Real seconds per simulated second in which a vibration of `hertz` is seen: 1 up to 5 Hz, else a number 1, 2 or 5
/// times a power of ten with which it has 1.2 to 3.2 Hz.
pub fn slow_factor(hertz: f64) -> f64 {
    if hertz.is_nan() || hertz <= MAX_SHOWN_HERTZ {
        return 1.0;
    }
    let factor = (hertz / SLOW_HERTZ).min(MAX_FACTOR);
    let power = 10.0_f64.powf(factor.log10().floor());
    let distance = |digit: &f64| (digit * power / factor).ln().abs();
    let nearest = DIGITS.into_iter().min_by(|a, b| distance(a).total_cmp(&distance(b)));
    nearest.map_or(1.0, |digit| (digit * power).round())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stiff_bodies_are_shown_slowly() {
        let cases = [(0.0, 1.0), (0.5, 1.0), (5.0, 1.0), (5.1, 2.0), (20.0, 10.0), (206.0, 100.0), (5000.0, 2000.0)];
        for (hertz, factor) in cases {
            assert_eq!(slow_factor(hertz), factor, "{hertz} Hz");
        }
        assert_eq!((slow_factor(f64::NAN), slow_factor(1e12), slow_factor(f64::INFINITY)), (1.0, 1e6, 1e6));
        for hertz in (51..100_000).map(|tenth| 0.1 * f64::from(tenth)) {
            assert!((1.2..=3.2).contains(&(hertz / slow_factor(hertz))), "{hertz} Hz: {}", slow_factor(hertz));
        }
    }
}
