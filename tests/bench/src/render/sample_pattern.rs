//! Sample patterns: in a pixel, of a Gaussian filter, and over a hemisphere.

use std::f64::consts::TAU;

/// Samples of one pixel, one in each of `side` x `side` cells. The sample of cell (i, j) has
/// x = (i + (j + 1/2) / side) / side, and y with i and j exchanged. All x are different, and so are all y.
pub(super) fn pixel_samples(side: usize) -> Vec<[f64; 2]> {
    let count = side as f64;
    let coordinate = |cell: usize, other_cell: usize| (cell as f64 + (other_cell as f64 + 0.5) / count) / count;
    (0..side * side)
        .map(|index| (index % side, index / side))
        .map(|(i, j)| [coordinate(i, j), coordinate(j, i)])
        .collect()
}

/// Points of a two-dimensional normal distribution with standard deviation 1: Hammersley points after a Box-Muller
/// transform. `shift` (each component 0 to 1) is added to the Hammersley points. With a different shift per pixel, the
/// errors of neighboring pixels are uncorrelated.
pub(super) fn gaussian_samples(count: usize, shift: [f64; 2]) -> Vec<[f64; 2]> {
    let point = |index: usize| {
        // The reversed bits divided by 2^32.
        let radical_inverse = f64::from((index as u32).reverse_bits()) / 4_294_967_296.0;
        let quantile = ((index as f64 + 0.5) / count as f64 + shift[0]).fract();
        let angle = TAU * (radical_inverse + shift[1]);
        // The lower bound limits the radius of the outermost point.
        let radius = (-2.0 * (1.0 - quantile).max(0.25 / count as f64).ln()).sqrt();
        [radius * angle.cos(), radius * angle.sin()]
    };
    (0..count).map(point).collect()
}

/// Cosine-distributed unit vectors around the z axis: a Fibonacci lattice on the unit disk, projected to the
/// hemisphere. Vectors at equal distances in the list, such as every 64th, also cover the hemisphere evenly. `shift` is
/// that of [`gaussian_samples`].
pub(super) fn cosine_samples(count: usize, shift: [f64; 2]) -> Vec<[f64; 3]> {
    const GOLDEN_RATIO: f64 = 1.618_033_988_749_895;
    let direction = |index: usize| {
        let squared_radius = ((index as f64 + 0.5) / count as f64 + shift[0]).fract();
        let angle = TAU * (index as f64 * (GOLDEN_RATIO - 1.0) + shift[1]);
        let radius = squared_radius.sqrt();
        [radius * angle.cos(), radius * angle.sin(), (1.0 - squared_radius).sqrt()]
    };
    (0..count).map(direction).collect()
}

/// Two pseudo-random numbers in [0, 1) per pixel, with the constants of the generator `SplitMix64`.
pub(super) fn pixel_shift(x: u32, y: u32) -> [f64; 2] {
    let mix_bits = |mut word: u64| {
        word = (word ^ (word >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        word = (word ^ (word >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        word ^ (word >> 31)
    };
    let seed = mix_bits((u64::from(x) << 32 | u64::from(y)).wrapping_add(0x9E37_79B9_7F4A_7C15));
    // The upper 24 bits of each word.
    [seed >> 40, mix_bits(seed) >> 40].map(|bits| bits as f64 / (1_u64 << 24) as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn samples_have_distinct_evenly_spaced_coordinates() {
        let samples = pixel_samples(8);
        assert_eq!(samples.len(), 64);
        for axis in 0..2 {
            let mut coordinates: Vec<f64> = samples.iter().map(|sample| sample[axis]).collect();
            coordinates.sort_by(f64::total_cmp);
            assert!(
                coordinates
                    .iter()
                    .enumerate()
                    .all(|(index, coordinate)| (coordinate * 64.0 - index as f64 - 0.5).abs() < 1e-9)
            );
        }
    }

    #[test]
    fn gaussian_has_mean_0_and_deviation_1_for_any_shift() {
        for shift in [[0.0, 0.0], [0.3, 0.9], [0.999, 0.5]] {
            let points = gaussian_samples(256, shift);
            for axis in 0..2 {
                let mean = points.iter().map(|point| point[axis]).sum::<f64>() / 256.0;
                let variance = points.iter().map(|point| point[axis] * point[axis]).sum::<f64>() / 256.0;
                assert!(
                    mean.abs() < 0.03 && (variance - 1.0).abs() < 0.04,
                    "{shift:?}: mean {mean}, variance {variance}"
                );
            }
        }
    }

    /// For a cosine distribution, the mean of z is 2/3, the mean of z^2 is 1/2 and the means of x and y are 0.
    #[test]
    fn cosine_samples_and_their_subsets_have_the_moments_of_a_cosine() {
        for shift in [[0.0, 0.0], [0.3, 0.9], [0.999, 0.5]] {
            let directions = cosine_samples(1024, shift);
            assert!(directions.iter().all(|[x, y, z]| (x * x + y * y + z * z - 1.0).abs() < 1e-12 && *z >= 0.0));
            // All directions, and those of one of 64 samples.
            for (step, tolerance) in [(1, 2e-3), (64, 0.06)] {
                let subset: Vec<&[f64; 3]> = directions.iter().skip(step / 2).step_by(step).collect();
                let mean = |value: fn(&[f64; 3]) -> f64| {
                    subset.iter().map(|direction| value(direction)).sum::<f64>() / subset.len() as f64
                };
                let errors = [
                    mean(|direction| direction[0]),
                    mean(|direction| direction[1]),
                    mean(|direction| direction[2]) - 2.0 / 3.0,
                    mean(|direction| direction[2] * direction[2]) - 0.5,
                ];
                assert!(errors.iter().all(|error| error.abs() < tolerance), "{shift:?}, every {step}: {errors:?}");
            }
        }
    }

    #[test]
    fn neighboring_pixels_get_different_shifts() {
        let shifts: Vec<[f64; 2]> = (0..100).map(|index| pixel_shift(index % 10, index / 10)).collect();
        assert!(shifts.iter().flatten().all(|number| (0.0..1.0).contains(number)));
        let mean = shifts.iter().map(|pair| pair[0]).sum::<f64>() / 100.0;
        assert!((mean - 0.5).abs() < 0.1 && shifts[0] != shifts[1], "{mean}");
    }
}
