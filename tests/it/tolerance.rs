//! Comparison of numbers with a tolerance, and the test that the comparison can fail.

/// Absolute and relative tolerance.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Tolerance {
    pub(crate) abs: f64,
    pub(crate) rel: f64,
}

/// Describes the first element where `got` is not close to `want`. NaN is close to nothing.
pub(crate) fn first_wrong(got: &[f32], want: &[f64], tolerance: Tolerance) -> Option<String> {
    if got.len() != want.len() || want.is_empty() {
        return Some(format!("{} numbers, expected {} and at least one", got.len(), want.len()));
    }
    got.iter().zip(want).enumerate().find_map(|(at, (got, want))| {
        let close = (f64::from(*got) - want).abs() <= tolerance.abs + tolerance.rel * want.abs();
        (!close).then(|| format!("[{at}] is {got}, expected {want}"))
    })
}

/// Largest distance between two lists of points; infinite if a point is not finite.
pub(crate) fn largest_error(got: &[f32], want: &[[f64; 3]]) -> f64 {
    assert_eq!(got.len(), 3 * want.len(), "as many points");
    let error = |(got, want): (&[f32], &[f64; 3])| {
        let square: f64 = got.iter().zip(want).map(|(got, want)| (f64::from(*got) - want).powi(2)).sum();
        if square.is_nan() { f64::INFINITY } else { square.sqrt() }
    };
    got.chunks_exact(3).zip(want).map(error).fold(0.0, f64::max)
}

#[test]
fn judge_refuses_wrong_swapped_short_or_non_finite_numbers() {
    let tolerance = Tolerance { abs: 1e-6, rel: 1e-6 };
    let want = [1.0, 2.0];
    assert_eq!(first_wrong(&[1.0, 2.0], &want, tolerance), None);
    for got in [&[1.0, 2.1][..], &[1.0, f32::NAN], &[1.0, f32::INFINITY], &[2.0, 1.0], &[1.0], &[]] {
        assert!(first_wrong(got, &want, tolerance).is_some(), "{got:?} passed");
    }
    assert!(first_wrong(&[], &[], tolerance).is_some(), "nothing passed");
    assert_eq!(largest_error(&[3.0, 0.0, f32::NAN], &[[0.0; 3]]), f64::INFINITY);
    assert!((largest_error(&[3.0, 4.0, 0.0], &[[0.0; 3]]) - 5.0).abs() < 1e-12);
}
