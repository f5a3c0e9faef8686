//! Origins of rest positions: f64 points that keep f32 rest positions accurate relative to the size of their mesh.

/// The largest coordinate that a position may have in f32, in diagonals of the bounds, before it gets an origin.
///
/// A coordinate of at most 8 diagonals is rounded by at most 8 x 2^-24 = 4.8e-7 diagonals. The four roundings of a
/// deformer add at most 4 x 4.8e-7. The norm of these errors on three axes is at most 4.2e-6 diagonals, which leaves
/// more than half of the promised 1e-5 diagonals for the deformation.
pub const MAX_DIAGONALS: f64 = 8.0;

/// Rest positions in f32, relative to an f64 origin.
#[derive(Debug, Clone, PartialEq)]
pub struct RestOrigin {
    /// The origin in the unit of the positions. Zero if f32 suffices without an origin.
    pub origin: [f64; 3],
    /// The positions relative to the origin.
    pub positions: Vec<[f32; 3]>,
}

impl RestOrigin {
    /// Chooses the origin of rest positions: zero if all coordinates of the drawn vertices are within [`MAX_DIAGONALS`]
    /// of the diagonal of their bounds, else a point near the center of these bounds. `drawn` are the indices of the
    /// vertices that triangles use, with repetitions. Indices beyond the positions are ignored.
    pub fn choose(positions: &[[f64; 3]], drawn: impl IntoIterator<Item = usize>) -> Self {
        let origin = origin_of_positions(drawn.into_iter().filter_map(|vertex| positions.get(vertex)));
        let relative = |position: &[f64; 3]| std::array::from_fn(|axis| (position[axis] - origin[axis]) as f32);
        Self { origin, positions: positions.iter().map(relative).collect() }
    }
}

/// The origin of positions, as [`RestOrigin::choose`] chooses it.
pub(crate) fn origin_of_positions<'a>(positions: impl IntoIterator<Item = &'a [f64; 3]>) -> [f64; 3] {
    let mut bounds = [[f64::INFINITY; 3], [f64::NEG_INFINITY; 3]];
    for position in positions {
        for axis in 0..3 {
            bounds[0][axis] = bounds[0][axis].min(position[axis]);
            bounds[1][axis] = bounds[1][axis].max(position[axis]);
        }
    }
    origin_of_bounds(bounds)
}

/// The origin of positions with these bounds (minimum and maximum): zero if f32 suffices without an origin. Its
/// coordinates are multiples of a power of two near the diagonal, so that f32 coordinates relative to it are exact if
/// the coordinates themselves are.
pub(crate) fn origin_of_bounds([min, max]: [[f64; 3]; 2]) -> [f64; 3] {
    let diagonal = (0..3).map(|axis| (max[axis] - min[axis]).powi(2)).sum::<f64>().sqrt();
    let largest = min.iter().chain(&max).fold(0.0, |largest: f64, coordinate| largest.max(coordinate.abs()));
    if !(diagonal.is_normal() && largest > MAX_DIAGONALS * diagonal && largest.is_finite()) {
        return [0.0; 3];
    }
    let spacing = power_of_two_at_most(diagonal);
    std::array::from_fn(|axis| snap_to_grid(min[axis] / 2.0 + max[axis] / 2.0, spacing))
}

/// The multiple of `spacing` nearest to a coordinate.
pub(crate) fn snap_to_grid(coordinate: f64, spacing: f64) -> f64 {
    (coordinate / spacing).round() * spacing
}

/// The largest power of two that is at most `size`; 1 for a size that is not a positive normal number.
pub(crate) fn power_of_two_at_most(size: f64) -> f64 {
    // The exponent bits of a normal number, without its fraction.
    let exponent_bits = 0x7FF0_0000_0000_0000;
    if size.is_normal() && size > 0.0 { f64::from_bits(size.to_bits() & exponent_bits) } else { 1.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn corners_at(center: [f64; 3], size: f64) -> Vec<[f64; 3]> {
        let corner = |index: usize| {
            std::array::from_fn(|axis| center[axis] + size * if index >> axis & 1 == 0 { -0.5 } else { 0.5 })
        };
        (0..8).map(corner).collect()
    }

    #[test]
    fn near_positions_have_no_origin_and_keep_their_bits() {
        // The diagonal is 1.73, so that 8 diagonals are 13.9.
        for center in [[0.0; 3], [0.3, -0.1, 7.7], [13.3, 0.0, 0.0], [0.0, -13.3, 13.3]] {
            let positions = corners_at(center, 1.0);
            let near = RestOrigin::choose(&positions, 0..8);
            assert_eq!(near.origin, [0.0; 3], "{center:?}");
            let rounded: Vec<[f32; 3]> =
                positions.iter().map(|position| position.map(|number| number as f32)).collect();
            assert_eq!(near.positions, rounded);
        }
    }

    #[test]
    fn far_positions_are_exact_relative_to_their_origin() {
        let mut random = fastrand::Rng::with_seed(7);
        for magnitude in [1e2, 1e3, 1e5, 1e7, 1e9] {
            for axis in 0..3 {
                let mut center = [random.f64(), random.f64(), random.f64()];
                center[axis] += magnitude;
                let positions = corners_at(center, 0.4);
                let far = RestOrigin::choose(&positions, 0..8);
                assert_ne!(far.origin, [0.0; 3], "{center:?}");
                let error = |positions: &[[f32; 3]], origin: [f64; 3], expected: &[[f64; 3]]| {
                    let pairs = positions.as_flattened().iter().zip(expected.as_flattened()).enumerate();
                    let errors = pairs.map(|(index, (v, x0))| (f64::from(*v) + origin[index % 3] - x0).abs());
                    errors.fold(0.0, f64::max)
                };
                // f64 itself rounds the sum by 2^-53 of the magnitude.
                let accepted = 5e-8 + magnitude * 2.0_f64.powi(-52);
                let actual = error(&far.positions, far.origin, &positions);
                assert!(actual <= accepted, "{center:?}: {actual}");
                let rounded: Vec<_> = positions.iter().map(|position| position.map(|number| number as f32)).collect();
                let rounded_error = error(&rounded, [0.0; 3], &positions);
                assert!(rounded_error > magnitude * 1e-10, "control: expected an error of f32, got {rounded_error}");
                // f32 positions are exact.
                let f32_positions: Vec<_> = rounded.iter().map(|position| position.map(f64::from)).collect();
                let exact = RestOrigin::choose(&f32_positions, 0..8);
                // At 1e7 and above, f32 moves the corners together.
                if exact.origin != [0.0; 3] {
                    let along = |positions: &[[f32; 3]]| positions.iter().map(|v| v[axis]).collect::<Vec<f32>>();
                    let sums = along(&exact.positions).into_iter().map(|v| f64::from(v) + exact.origin[axis]);
                    assert!(sums.eq(f32_positions.iter().map(|position| position[axis])), "{center:?}");
                }
            }
        }
    }

    #[test]
    fn undrawn_vertices_and_degenerate_bounds_choose_no_origin() {
        let mut positions = corners_at([0.0; 3], 1.0);
        positions.push([1e6, 0.0, 0.0]);
        assert_eq!(RestOrigin::choose(&positions, 0..8).origin, [0.0; 3]);
        // A far body with an undrawn vertex near zero.
        let mut positions = corners_at([1e6, 0.0, 0.0], 1.0);
        positions.push([0.0; 3]);
        assert_eq!(RestOrigin::choose(&positions, 0..8).origin, [1e6, 0.0, 0.0]);
        assert_eq!(RestOrigin::choose(&positions, 0..9).origin, [0.0; 3], "control: drawn, it widens the bounds");
        for degenerate in [vec![], vec![[1e6; 3]; 3], vec![[f64::INFINITY; 3], [0.0; 3]], vec![[f64::NAN; 3]; 3]] {
            assert_eq!(RestOrigin::choose(&degenerate, 0..3).origin, [0.0; 3], "{degenerate:?}");
        }
    }
}
