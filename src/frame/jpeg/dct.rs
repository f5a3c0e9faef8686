//! The forward DCT of 8x8 samples, in f32: the scaled transform of Arai, Agui and Nakajima (1988), which has five
//! multiplications per row. Its scale is part of the quantization factors.

use super::lanes::Lanes;
use pulp::f32x8;

/// By which the transform of one dimension multiplies a coefficient of the orthonormal DCT, divided by √8: 1 for the
/// first one, √2 cos(kπ/16) for the others.
pub(super) const SCALES: [f64; 8] = [
    1.0,
    1.387_039_845_322_147_5,
    1.306_562_964_876_376_5,
    1.175_875_602_419_358_8,
    1.0,
    0.785_694_958_387_102_2,
    0.541_196_100_146_197,
    0.275_899_379_282_943,
];

/// The transform of a block of rows. The result is transposed: its rows are horizontal frequencies.
#[inline(always)]
pub(super) fn forward<L: Lanes>(lanes: L, rows: [f32x8; 8]) -> [f32x8; 8] {
    let columns = lanes.transpose(transform(lanes, rows));
    transform(lanes, columns)
}

/// Transforms eight lanes of eight numbers.
#[inline(always)]
fn transform<L: Lanes>(lanes: L, input: [f32x8; 8]) -> [f32x8; 8] {
    // cos(2π/8), cos(3π/8), and sums with cos(π/8).
    const COS_2: f32 = std::f32::consts::FRAC_1_SQRT_2;
    const COS_3: f32 = 0.382_683_43;
    const COS_1_MINUS_3: f32 = 0.541_196_1;
    const COS_1_PLUS_3: f32 = 1.306_563;
    let mut sums = [lanes.splat_f32s(0.0); 4];
    let mut differences = sums;
    for index in 0..4 {
        sums[index] = lanes.add_f32s(input[index], input[7 - index]);
        differences[index] = lanes.sub_f32s(input[index], input[7 - index]);
    }

    let (outer, inner) = (lanes.add_f32s(sums[0], sums[3]), lanes.add_f32s(sums[1], sums[2]));
    let outer_difference = lanes.sub_f32s(sums[0], sums[3]);
    let rotated = scale(lanes, COS_2, lanes.add_f32s(lanes.sub_f32s(sums[1], sums[2]), outer_difference));

    let low = lanes.add_f32s(differences[3], differences[2]);
    let middle = scale(lanes, COS_2, lanes.add_f32s(differences[2], differences[1]));
    let high = lanes.add_f32s(differences[1], differences[0]);
    let shared = scale(lanes, COS_3, lanes.sub_f32s(low, high));
    let low = lanes.add_f32s(scale(lanes, COS_1_MINUS_3, low), shared);
    let high = lanes.add_f32s(scale(lanes, COS_1_PLUS_3, high), shared);
    let (odd_sum, odd_difference) = (lanes.add_f32s(differences[0], middle), lanes.sub_f32s(differences[0], middle));
    [
        lanes.add_f32s(outer, inner),
        lanes.add_f32s(odd_sum, high),
        lanes.add_f32s(outer_difference, rotated),
        lanes.sub_f32s(odd_difference, low),
        lanes.sub_f32s(outer, inner),
        lanes.add_f32s(odd_difference, low),
        lanes.sub_f32s(outer_difference, rotated),
        lanes.sub_f32s(odd_sum, high),
    ]
}

#[inline(always)]
fn scale<L: Lanes>(lanes: L, factor: f32, numbers: f32x8) -> f32x8 {
    lanes.mul_f32s(lanes.splat_f32s(factor), numbers)
}

#[cfg(test)]
mod tests {
    use std::f64::consts::{FRAC_1_SQRT_2, PI};

    use super::*;

    #[test]
    fn spectrum_is_the_scaled_cosine_transform() {
        let mut random = fastrand::Rng::with_seed(1);
        for _ in 0..20 {
            let samples: [[f32; 8]; 8] =
                std::array::from_fn(|_| std::array::from_fn(|_| f32::from(random.i16(-128..128))));
            let rows = samples.map(|[a, b, c, d, e, f, g, h]| f32x8(a, b, c, d, e, f, g, h));
            let spectrum: [[f32; 8]; 8] = pulp::cast(forward(pulp::Scalar256b, rows));
            for (u, column) in spectrum.iter().enumerate() {
                for (v, coefficient) in column.iter().enumerate() {
                    let wave = |k: usize, x: usize| {
                        let norm = if k == 0 { FRAC_1_SQRT_2 } else { 1.0 };
                        norm / 2.0 * ((2 * x + 1) as f64 * k as f64 * PI / 16.0).cos()
                    };
                    let products = (0..64).map(|i| f64::from(samples[i / 8][i % 8]) * wave(v, i / 8) * wave(u, i % 8));
                    let expected = 8.0 * SCALES[u] * SCALES[v] * products.sum::<f64>();
                    assert!((f64::from(*coefficient) - expected).abs() < 0.01, "{u} {v}: {coefficient} {expected}");
                }
            }
        }
    }
}
