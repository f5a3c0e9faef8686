//! Numbers in messages.

/// A number rounded to this many significant digits, for a message.
pub fn to_significant_digits(number: f64, digits: usize) -> f64 {
    format!("{number:.*e}", digits.saturating_sub(1)).parse().unwrap_or(number)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_keep_their_first_digits() {
        for (number, digits, expected) in [
            (123_456.0, 2, 120_000.0),
            (0.009_536_7, 4, 0.009_537),
            (-9.99e-30, 1, -1e-29),
            (0.0, 3, 0.0),
            (5.0, 0, 5.0),
        ] {
            assert_eq!(to_significant_digits(number, digits), expected);
        }
        assert_eq!(to_significant_digits(f64::INFINITY, 2), f64::INFINITY);
        assert!(to_significant_digits(f64::NAN, 2).is_nan());
    }
}
