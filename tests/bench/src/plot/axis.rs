//! Logarithmic axes: range, ticks and their labels.

/// A logarithmic axis from one pixel to another.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Axis {
    /// Decimal logarithms of the ends.
    low: f64,
    high: f64,
    /// Pixel coordinates of the ends.
    from: f64,
    to: f64,
}

/// Margin beyond the outermost values, and minimum span, in decades.
const ROOM: f64 = 0.25;
const LEAST: f64 = 1.2;

impl Axis {
    /// An axis that covers all positive values; other values are drawn at its lower end. `usual` is the range when
    /// there are no values.
    pub(super) fn around(values: impl Iterator<Item = f64>, usual: (f64, f64), (from, to): (f64, f64)) -> Self {
        let logs = values.filter(|value| *value > 0.0 && value.is_finite()).map(f64::log10);
        let (low, high) =
            logs.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), log| (low.min(log), high.max(log)));
        let (low, high) = if low > high { (usual.0.log10(), usual.1.log10()) } else { (low - ROOM, high + ROOM) };
        let lacking = (LEAST - (high - low)).max(0.0) / 2.0;
        Self { low: low - lacking, high: high + lacking, from, to }
    }

    /// Pixel coordinate of a value.
    pub(super) fn place(&self, value: f64) -> f64 {
        let log = if value > 0.0 { value.log10().clamp(self.low, self.high) } else { self.low };
        self.from + (log - self.low) / (self.high - self.low) * (self.to - self.from)
    }

    /// Tick values: decades, with twos and fives between them on short axes.
    pub(super) fn ticks(&self) -> Vec<f64> {
        let span = self.high - self.low;
        let steps: &[f64] = if span < 2.2 { &[1.0, 2.0, 5.0] } else { &[1.0] };
        let every = (span / 7.0).ceil().max(1.0) as i32;
        let decades = (self.low.floor() as i32)..=(self.high.ceil() as i32);
        let fits = |value: &f64| (self.low..=self.high).contains(&value.log10());
        let decades = decades.filter(|decade| decade.rem_euclid(every) == 0);
        decades.flat_map(|decade| steps.iter().map(move |step| step * 10f64.powi(decade))).filter(fits).collect()
    }
}

/// Formats microseconds with a suitable unit.
pub(super) fn time(us: f64) -> String {
    let (value, unit) = match us {
        us if us < 0.999 => (us * 1e3, "ns"),
        us if us < 999.0 => (us, "µs"),
        us if us < 999e3 => (us / 1e3, "ms"),
        us => (us / 1e6, "s"),
    };
    format!("{} {unit}", (value * 100.0).round() / 100.0)
}

/// Formats a number as one digit and a power of ten.
pub(super) fn power(value: f64) -> String {
    format!("{value:.0e}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn axis_contains_values_and_clamps_non_positive_ones() {
        let axis = Axis::around([1e-7, 1e-3].into_iter(), (1.0, 10.0), (100.0, 0.0));
        let [small, large, zero] = [1e-7, 1e-3, 0.0].map(|value| axis.place(value));
        assert!(zero == 100.0 && small < 100.0 && large > 0.0 && large < small, "{zero} {small} {large}");
        assert_eq!(axis.ticks(), [1e-7, 1e-6, 1e-5, 1e-4, 1e-3]);
        let narrow = Axis::around([30.0].into_iter(), (1.0, 10.0), (0.0, 1.0));
        assert!(narrow.ticks().len() >= 3, "{:?}", narrow.ticks());
        let empty = Axis::around(std::iter::empty(), (1.0, 1e3), (0.0, 1.0));
        assert_eq!((empty.place(1.0), empty.place(1e3)), (0.0, 1.0));
    }

    #[test]
    fn many_decades_get_few_ticks() {
        let axis = Axis::around([1e-20, 1.0].into_iter(), (1.0, 10.0), (0.0, 1.0));
        assert!((4..=8).contains(&axis.ticks().len()), "{:?}", axis.ticks());
    }

    #[test]
    fn times_get_a_suitable_unit() {
        let texts = [0.5, 1.0, 200.0, 1e3, 5e4, 1e6].map(time);
        assert_eq!(texts, ["500 ns", "1 µs", "200 µs", "1 ms", "50 ms", "1 s"]);
        assert_eq!(power(2e-7), "2e-7");
    }
}
