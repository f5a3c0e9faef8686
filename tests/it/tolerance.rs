//! Comparison of numbers with a tolerance, and the test that the comparison can fail.

/// Absolute and relative tolerance.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Tolerance {
    pub(crate) abs: f64,
    pub(crate) rel: f64,
}

/// Describes the first element where `got` is not close to `want`. NaN is close to nothing.
pub(crate) fn find_difference(got: &[f32], want: &[f64], tolerance: Tolerance) -> Option<String> {
    if got.len() != want.len() || want.is_empty() {
        return Some(format!("expected {} numbers and at least one, got {}", want.len(), got.len()));
    }
    got.iter().zip(want).enumerate().find_map(|(index, (got, want))| {
        let is_close = (f64::from(*got) - want).abs() <= tolerance.abs + tolerance.rel * want.abs();
        (!is_close).then(|| format!("[{index}] is {got}, expected {want}"))
    })
}

/// Largest distance between two lists of points; infinite if a point is not finite.
pub(crate) fn max_distance(got: &[f32], want: &[[f64; 3]]) -> f64 {
    assert_eq!(got.len(), 3 * want.len(), "expected three numbers per point");
    let error = |(got, want): (&[f32], &[f64; 3])| {
        let squared: f64 = got.iter().zip(want).map(|(got, want)| (f64::from(*got) - want).powi(2)).sum();
        if squared.is_nan() { f64::INFINITY } else { squared.sqrt() }
    };
    got.chunks_exact(3).zip(want).map(error).fold(0.0, f64::max)
}

#[test]
fn difference_detects_wrong_and_non_finite_numbers() {
    let tolerance = Tolerance { abs: 1e-6, rel: 1e-6 };
    let want = [1.0, 2.0];
    assert_eq!(find_difference(&[1.0, 2.0], &want, tolerance), None);
    for got in [&[1.0, 2.1][..], &[1.0, f32::NAN], &[1.0, f32::INFINITY], &[2.0, 1.0], &[1.0], &[]] {
        assert!(find_difference(got, &want, tolerance).is_some(), "{got:?} passed");
    }
    assert!(find_difference(&[], &[], tolerance).is_some(), "expected empty lists to fail");
    assert_eq!(max_distance(&[3.0, 0.0, f32::NAN], &[[0.0; 3]]), f64::INFINITY);
    assert!((max_distance(&[3.0, 4.0, 0.0], &[[0.0; 3]]) - 5.0).abs() < 1e-12);
}
