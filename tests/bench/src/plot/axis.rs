//! Logarithmic axes: range, ticks and their labels.

/// A logarithmic axis that maps values to pixel coordinates.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Axis {
    /// Decimal logarithms of the values at the ends.
    min_log: f64,
    max_log: f64,
    /// Pixel coordinates of the ends.
    min_pixel: f64,
    max_pixel: f64,
}

/// Margin beyond the smallest and largest value, decades.
const VALUE_MARGIN: f64 = 0.25;
/// Minimum length of an axis, decades, so that an axis has at least three ticks.
const MIN_SPAN: f64 = 1.2;

impl Axis {
    /// An axis that covers all positive values; other values are drawn at its lower end. Without positive values it
    /// covers `default_range`.
    pub(super) fn new(
        values: impl Iterator<Item = f64>,
        default_range: (f64, f64),
        (min_pixel, max_pixel): (f64, f64),
    ) -> Self {
        let logs = values.filter(|value| *value > 0.0 && value.is_finite()).map(f64::log10);
        let (min_log, max_log) =
            logs.fold((f64::INFINITY, f64::NEG_INFINITY), |(min, max), log| (min.min(log), max.max(log)));
        let (min_log, max_log) = if min_log > max_log {
            (default_range.0.log10(), default_range.1.log10())
        } else {
            (min_log - VALUE_MARGIN, max_log + VALUE_MARGIN)
        };
        let extension = (MIN_SPAN - (max_log - min_log)).max(0.0) / 2.0;
        Self { min_log: min_log - extension, max_log: max_log + extension, min_pixel, max_pixel }
    }

    /// Pixel coordinate of a value.
    pub(super) fn pixel(&self, value: f64) -> f64 {
        let log = if value > 0.0 { value.log10().clamp(self.min_log, self.max_log) } else { self.min_log };
        self.min_pixel + (log - self.min_log) / (self.max_log - self.min_log) * (self.max_pixel - self.min_pixel)
    }

    /// Tick values: powers of ten. Short axes also have ticks at 2 and 5 times each power; long axes skip powers.
    pub(super) fn ticks(&self) -> Vec<f64> {
        let span = self.max_log - self.min_log;
        // Up to 2.2 decades have at most seven ticks with these multiples.
        let multiples: &[f64] = if span < 2.2 { &[1.0, 2.0, 5.0] } else { &[1.0] };
        // An axis with powers of ten only has about seven ticks.
        let decade_step = (span / 7.0).ceil().max(1.0) as i32;
        let decades = (self.min_log.floor() as i32)..=(self.max_log.ceil() as i32);
        let decades = decades.filter(|decade| decade.rem_euclid(decade_step) == 0);
        let is_on_axis = |value: &f64| (self.min_log..=self.max_log).contains(&value.log10());
        decades
            .flat_map(|decade| multiples.iter().map(move |multiple| multiple * 10f64.powi(decade)))
            .filter(is_on_axis)
            .collect()
    }
}

/// Formats microseconds with a suitable unit. The limits are slightly below powers of ten, so that a tick at 1 ms
/// appears as such despite its rounding error.
pub(super) fn format_time(us: f64) -> String {
    let (value, unit) = match us {
        us if us < 0.999 => (us * 1e3, "ns"),
        us if us < 999.0 => (us, "µs"),
        us if us < 999e3 => (us / 1e3, "ms"),
        us => (us / 1e6, "s"),
    };
    format!("{} {unit}", (value * 100.0).round() / 100.0)
}

/// Formats a count.
pub(super) fn format_count(count: f64) -> String {
    format!("{count:.0}")
}

/// Formats a number as one digit and a power of ten.
pub(super) fn format_power(value: f64) -> String {
    format!("{value:.0e}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn axis_contains_values_and_clamps_non_positive_ones() {
        let axis = Axis::new([1e-7, 1e-3].into_iter(), (1.0, 10.0), (100.0, 0.0));
        let [small_pixel, large_pixel, zero_pixel] = [1e-7, 1e-3, 0.0].map(|value| axis.pixel(value));
        assert!(
            zero_pixel == 100.0 && small_pixel < 100.0 && large_pixel > 0.0 && large_pixel < small_pixel,
            "{zero_pixel} {small_pixel} {large_pixel}"
        );
        assert_eq!(axis.ticks(), [1e-7, 1e-6, 1e-5, 1e-4, 1e-3]);
        let single_value_axis = Axis::new([30.0].into_iter(), (1.0, 10.0), (0.0, 1.0));
        assert!(single_value_axis.ticks().len() >= 3, "{:?}", single_value_axis.ticks());
        let default_axis = Axis::new(std::iter::empty(), (1.0, 1e3), (0.0, 1.0));
        assert_eq!((default_axis.pixel(1.0), default_axis.pixel(1e3)), (0.0, 1.0));
    }

    #[test]
    fn many_decades_get_few_ticks() {
        let axis = Axis::new([1e-20, 1.0].into_iter(), (1.0, 10.0), (0.0, 1.0));
        assert!((4..=8).contains(&axis.ticks().len()), "{:?}", axis.ticks());
    }

    #[test]
    fn formats_times_with_a_suitable_unit() {
        let texts = [0.5, 1.0, 200.0, 1e3, 5e4, 1e6].map(format_time);
        assert_eq!(texts, ["500 ns", "1 µs", "200 µs", "1 ms", "50 ms", "1 s"]);
        assert_eq!(format_power(2e-7), "2e-7");
    }
}
