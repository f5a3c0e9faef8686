//! Sample patterns: in a pixel, and under the Gaussian of a blur.

use std::f64::consts::TAU;

/// Samples of one pixel in `side` x `side` cells. Each sample is shifted inside of its cell by its index in the other
/// direction, so that all samples have different x and different y: (i + (j + 1/2) / side) / side, and likewise for y.
pub(super) fn pixel(side: usize) -> Vec<[f64; 2]> {
    let count = side as f64;
    let place = |own: usize, other: usize| (own as f64 + (other as f64 + 0.5) / count) / count;
    (0..side * side).map(|at| (at % side, at / side)).map(|(i, j)| [place(i, j), place(j, i)]).collect()
}

/// Points of a two-dimensional normal distribution with standard deviation 1, by Box and Muller from Hammersley's
/// points. `turn` (each 0 to 1) shifts all points, so that neighboring pixels do not repeat each other's error.
pub(super) fn gaussian_samples(count: usize, turn: [f64; 2]) -> Vec<[f64; 2]> {
    let point = |at: usize| {
        let radical = f64::from((at as u32).reverse_bits()) / 4_294_967_296.0;
        let share = ((at as f64 + 0.5) / count as f64 + turn[0]).fract();
        let angle = TAU * (radical + turn[1]);
        // Limits the radius of the outermost point.
        let radius = (-2.0 * (1.0 - share).max(0.25 / count as f64).ln()).sqrt();
        [radius * angle.cos(), radius * angle.sin()]
    };
    (0..count).map(point).collect()
}

/// Two pseudo-random numbers in [0, 1) per pixel.
pub(super) fn scatter(x: u32, y: u32) -> [f64; 2] {
    let mix = |mut word: u64| {
        word = (word ^ (word >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        word = (word ^ (word >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        word ^ (word >> 31)
    };
    let seed = mix((u64::from(x) << 32 | u64::from(y)).wrapping_add(0x9E37_79B9_7F4A_7C15));
    [seed >> 40, mix(seed) >> 40].map(|bits| bits as f64 / (1_u64 << 24) as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn samples_have_distinct_evenly_spaced_coordinates() {
        let samples = pixel(8);
        assert_eq!(samples.len(), 64);
        for axis in 0..2 {
            let mut along: Vec<f64> = samples.iter().map(|sample| sample[axis]).collect();
            along.sort_by(f64::total_cmp);
            assert!(along.iter().enumerate().all(|(at, place)| (place * 64.0 - at as f64 - 0.5).abs() < 1e-9));
        }
    }

    #[test]
    fn gaussian_has_mean_0_and_deviation_1_for_any_shift() {
        for turn in [[0.0, 0.0], [0.3, 0.9], [0.999, 0.5]] {
            let points = gaussian_samples(256, turn);
            for axis in 0..2 {
                let mean = points.iter().map(|point| point[axis]).sum::<f64>() / 256.0;
                let square = points.iter().map(|point| point[axis] * point[axis]).sum::<f64>() / 256.0;
                assert!(mean.abs() < 0.03 && (square - 1.0).abs() < 0.04, "{turn:?}: {mean} {square}");
            }
        }
    }

    #[test]
    fn neighboring_pixels_get_different_offsets() {
        let all: Vec<[f64; 2]> = (0..100).map(|at| scatter(at % 10, at / 10)).collect();
        assert!(all.iter().flatten().all(|number| (0.0..1.0).contains(number)));
        let mean = all.iter().map(|pair| pair[0]).sum::<f64>() / 100.0;
        assert!((mean - 0.5).abs() < 0.1 && all[0] != all[1], "{mean}");
    }
}
