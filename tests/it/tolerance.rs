//! Comparison of numbers with a tolerance, and a test that the comparison detects differences.

/// A number is close to an expected number e if they differ by at most `abs + rel |e|`.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Tolerance {
    pub(crate) abs: f64,
    pub(crate) rel: f64,
}

/// Describes the first number of `actual` that is not close to the number of `expected` with the same index. NaN is
/// close to no number. Empty lists and lists of different lengths also give a description.
pub(crate) fn find_difference(actual: &[f32], expected: &[f64], tolerance: Tolerance) -> Option<String> {
    if actual.len() != expected.len() || expected.is_empty() {
        return Some(format!("expected {} numbers and at least one, got {}", expected.len(), actual.len()));
    }
    actual.iter().zip(expected).enumerate().find_map(|(index, (actual, expected))| {
        let is_close = (f64::from(*actual) - expected).abs() <= tolerance.abs + tolerance.rel * expected.abs();
        (!is_close).then(|| format!("[{index}] is {actual}, expected {expected}"))
    })
}

/// Largest distance between points of two lists with the same index; infinite if a coordinate is not finite.
pub(crate) fn max_distance(actual: &[f32], expected: &[[f64; 3]]) -> f64 {
    assert_eq!(actual.len(), 3 * expected.len(), "expected three numbers per point");
    let distance = |(actual, expected): (&[f32], &[f64; 3])| {
        let squared_distance: f64 =
            actual.iter().zip(expected).map(|(actual, expected)| (f64::from(*actual) - expected).powi(2)).sum();
        if squared_distance.is_nan() { f64::INFINITY } else { squared_distance.sqrt() }
    };
    actual.chunks_exact(3).zip(expected).map(distance).fold(0.0, f64::max)
}

#[test]
fn difference_detects_wrong_and_non_finite_numbers() {
    let tolerance = Tolerance { abs: 1e-6, rel: 1e-6 };
    let expected = [1.0, 2.0];
    assert_eq!(find_difference(&[1.0, 2.0], &expected, tolerance), None);
    for actual in [&[1.0, 2.1][..], &[1.0, f32::NAN], &[1.0, f32::INFINITY], &[2.0, 1.0], &[1.0], &[]] {
        assert!(find_difference(actual, &expected, tolerance).is_some(), "expected a difference for {actual:?}");
    }
    assert!(find_difference(&[], &[], tolerance).is_some(), "expected a difference for empty lists");
    assert_eq!(max_distance(&[3.0, 0.0, f32::NAN], &[[0.0; 3]]), f64::INFINITY);
    assert!((max_distance(&[3.0, 4.0, 0.0], &[[0.0; 3]]) - 5.0).abs() < 1e-12);
}
