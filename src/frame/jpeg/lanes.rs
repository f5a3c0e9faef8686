//! Vector operations on eight numbers, for AVX2 and portable. Both have the same results, bit by bit: they use no fused
//! multiplication, and round ties to even.

use super::zigzag::ZIGZAG;
use pulp::{Scalar256b, Simd, f32x8};

/// Quantized coefficients of a block.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Block {
    /// In the order of [`POSITIONS`].
    pub(super) values: [i16; 64],
    /// One bit for each coefficient, in zigzag order from the lowest bit: whether it is not 0.
    pub(super) nonzeros: u64,
}

/// Index of each coefficient of the zigzag sequence in [`Block::values`]. The order of the values is that of the pack
/// instructions of AVX2.
pub(super) const POSITIONS: [u8; 64] = {
    let mut positions = [0; 64];
    let mut index = 0;
    while index < 64 {
        let [u, v] = frequencies(index);
        positions[index] = (16 * (u / 2) + 8 * (v / 4) + 4 * (u % 2) + v % 4) as u8;
        index += 1;
    }
    positions
};

/// The horizontal and vertical frequency of a coefficient of the zigzag sequence.
const fn frequencies(index: usize) -> [usize; 2] {
    [ZIGZAG[index] as usize % 8, ZIGZAG[index] as usize / 8]
}

/// Bits of the fractions of [`WEIGHTS`].
const WEIGHT_BITS: i32 = 15;
/// Weights of red, green and blue in Y, Cb and Cr (ITU-R BT.601). Those of Y add up to 1, the others to 0.
const WEIGHTS: [[i16; 3]; 3] = [[9798, 19_235, 3735], [-5529, -10_855, 16_384], [16_384, -13_720, -2664]];
/// Offsets of the weighted sums: a half, so that a shift rounds, and -128 for Y.
const OFFSETS: [i32; 3] = [HALF - (128 << WEIGHT_BITS), HALF, HALF];
const HALF: i32 = 1 << (WEIGHT_BITS - 1);

/// Operations that [`Simd`] does not have.
pub(super) trait Lanes: Simd<f32s = f32x8> {
    /// Samples of the three components of eight RGBA8 pixels: integers of -128 to 128.
    fn samples(self, rgba: &[u8; 32]) -> [f32x8; 3];

    fn transpose(self, rows: [f32x8; 8]) -> [f32x8; 8];

    /// The sums of neighbors: four of `left`, then four of `right`.
    fn pair_sums(self, left: f32x8, right: f32x8) -> f32x8;

    /// Rounds coefficients to the nearest integers. Rows are horizontal frequencies. The integers must fit in 16 bits.
    fn round(self, rows: [f32x8; 8]) -> Block;
}

/// The nearest integer, of 16 bits. Ties are rounded to even.
#[inline(always)]
pub(super) fn round_to_i16(number: f32) -> i16 {
    // The sum of a smaller number and 1.5 * 2^23 is an integer, and its lowest bits are those of the rounded number.
    const INTEGERS: f32 = 12_582_912.0;
    (number + INTEGERS).to_bits() as i16
}

impl Lanes for Scalar256b {
    #[inline(always)]
    fn samples(self, rgba: &[u8; 32]) -> [f32x8; 3] {
        std::array::from_fn(|component| {
            let samples: [f32; 8] = std::array::from_fn(|pixel| {
                let color = |channel: usize| i32::from(rgba[4 * pixel + channel]);
                let weighted = |channel: usize| i32::from(WEIGHTS[component][channel]) * color(channel);
                ((weighted(0) + weighted(1) + weighted(2) + OFFSETS[component]) >> WEIGHT_BITS) as f32
            });
            pulp::cast(samples)
        })
    }

    #[inline(always)]
    fn transpose(self, rows: [f32x8; 8]) -> [f32x8; 8] {
        let rows: [[f32; 8]; 8] = pulp::cast(rows);
        let columns: [[f32; 8]; 8] = std::array::from_fn(|column| std::array::from_fn(|row| rows[row][column]));
        pulp::cast(columns)
    }

    #[inline(always)]
    fn pair_sums(self, left: f32x8, right: f32x8) -> f32x8 {
        let pairs: [[f32; 2]; 8] = pulp::cast([left, right]);
        pulp::cast(pairs.map(|[a, b]| a + b))
    }

    #[inline(always)]
    fn round(self, rows: [f32x8; 8]) -> Block {
        let rows: [[f32; 8]; 8] = pulp::cast(rows);
        let (mut values, mut nonzeros) = ([0; 64], 0);
        for (index, position) in POSITIONS.into_iter().enumerate() {
            let [u, v] = frequencies(index);
            let value = round_to_i16(rows[u][v]);
            values[usize::from(position)] = value;
            nonzeros |= u64::from(value != 0) << index;
        }
        Block { values, nonzeros }
    }
}

#[cfg(target_arch = "x86_64")]
mod avx2 {
    use std::arch::x86_64::{__m256, __m256d};

    use pulp::x86::V3;
    use pulp::{cast, f32x8};

    use super::{Block, Lanes, OFFSETS, WEIGHT_BITS, WEIGHTS, frequencies};

    /// For each half of the zigzag sequence, and each quadrant of the frequencies (low or high horizontal, low or high
    /// vertical): the indices of the bytes that move from the quadrant to the half. 0x80 selects no byte.
    const SHUFFLES: [[[u8; 32]; 4]; 2] = {
        let mut shuffles = [[[0x80; 32]; 4]; 2];
        let mut index = 0;
        while index < 64 {
            let [u, v] = frequencies(index);
            shuffles[index / 32][2 * (u / 4) + v / 4][index % 32] = (4 * (u % 4) + v % 4) as u8;
            index += 1;
        }
        shuffles
    };

    impl Lanes for V3 {
        #[inline(always)]
        fn samples(self, rgba: &[u8; 32]) -> [f32x8; 3] {
            const LOW_BYTES: [u16; 16] = [0xff; 16];
            let (avx, avx2) = (self.avx, self.avx2);
            let red_blue = avx2._mm256_and_si256(cast(*rgba), cast(LOW_BYTES));
            let green_alpha = avx2._mm256_srli_epi16::<8>(cast(*rgba));
            let mut samples = [avx._mm256_setzero_ps(); 3];
            for (component, samples) in samples.iter_mut().enumerate() {
                let [red, green, blue] = WEIGHTS[component];
                let sum = avx2._mm256_add_epi32(
                    avx2._mm256_madd_epi16(red_blue, cast([[red, blue]; 8])),
                    avx2._mm256_madd_epi16(green_alpha, cast([[green, 0]; 8])),
                );
                let sum = avx2._mm256_add_epi32(sum, cast([OFFSETS[component]; 8]));
                *samples = avx._mm256_cvtepi32_ps(avx2._mm256_srai_epi32::<WEIGHT_BITS>(sum));
            }
            cast(samples)
        }

        #[inline(always)]
        fn transpose(self, rows: [f32x8; 8]) -> [f32x8; 8] {
            let avx = self.avx;
            let rows: [__m256; 8] = cast(rows);
            let mut columns = rows;
            // Columns 0, 1, 4 and 5 are in the low parts of the 128-bit halves of the rows, the others in the high ones.
            for (part, is_high) in [(0, false), (1, true)] {
                let mut pairs = [rows[0]; 4];
                for (index, pair) in pairs.iter_mut().enumerate() {
                    let (first, second) = (rows[2 * index], rows[2 * index + 1]);
                    *pair = if is_high {
                        avx._mm256_unpackhi_ps(first, second)
                    } else {
                        avx._mm256_unpacklo_ps(first, second)
                    };
                }
                let pairs: [__m256d; 4] = cast(pairs);
                let quadruples: [__m256; 4] = cast([
                    avx._mm256_unpacklo_pd(pairs[0], pairs[1]),
                    avx._mm256_unpackhi_pd(pairs[0], pairs[1]),
                    avx._mm256_unpacklo_pd(pairs[2], pairs[3]),
                    avx._mm256_unpackhi_pd(pairs[2], pairs[3]),
                ]);
                for column in 0..2 {
                    let (upper, lower) = (quadruples[column], quadruples[column + 2]);
                    columns[2 * part + column] = avx._mm256_permute2f128_ps::<0x20>(upper, lower);
                    columns[2 * part + column + 4] = avx._mm256_permute2f128_ps::<0x31>(upper, lower);
                }
            }
            cast(columns)
        }

        #[inline(always)]
        fn pair_sums(self, left: f32x8, right: f32x8) -> f32x8 {
            // The sums of `left` and `right` alternate, two by two.
            let sums: __m256d = cast(self.avx._mm256_hadd_ps(cast(left), cast(right)));
            cast(self.avx2._mm256_permute4x64_pd::<0b11_01_10_00>(sums))
        }

        #[inline(always)]
        fn round(self, rows: [f32x8; 8]) -> Block {
            let (avx, avx2) = (self.avx, self.avx2);
            let rows: [__m256; 8] = cast(rows);
            let mut values = [avx._mm256_setzero_si256(); 4];
            for (index, values) in values.iter_mut().enumerate() {
                let even = avx._mm256_cvtps_epi32(rows[2 * index]);
                *values = avx2._mm256_packs_epi32(even, avx._mm256_cvtps_epi32(rows[2 * index + 1]));
            }
            // Saturation keeps nonzero numbers nonzero.
            let low = avx2._mm256_packs_epi16(values[0], values[1]);
            let high = avx2._mm256_packs_epi16(values[2], values[3]);
            // Each quadrant is half a vector. Both halves of the zigzag sequence need all bytes of a quadrant.
            let quadrants = [
                avx2._mm256_permute4x64_epi64::<0x44>(low),
                avx2._mm256_permute4x64_epi64::<0xee>(low),
                avx2._mm256_permute4x64_epi64::<0x44>(high),
                avx2._mm256_permute4x64_epi64::<0xee>(high),
            ];
            let mut nonzeros = 0;
            // The first half has no coefficient of the last quadrant, and the second half none of the first one.
            for (half, first_quadrant) in [0, 1].into_iter().enumerate() {
                let mut zigzag = avx._mm256_setzero_si256();
                for quadrant in first_quadrant..first_quadrant + 3 {
                    let part = avx2._mm256_shuffle_epi8(quadrants[quadrant], cast(SHUFFLES[half][quadrant]));
                    zigzag = avx2._mm256_or_si256(zigzag, part);
                }
                let zeros = avx2._mm256_cmpeq_epi8(zigzag, avx._mm256_setzero_si256());
                nonzeros |= u64::from(!avx2._mm256_movemask_epi8(zeros) as u32) << (32 * half);
            }
            Block { values: cast(values), nonzeros }
        }
    }

    #[cfg(test)]
    mod tests {
        use pulp::Scalar256b;

        use super::super::POSITIONS;
        use super::*;

        fn random_rows(random: &mut fastrand::Rng, scale: f32) -> [f32x8; 8] {
            let rows: [[f32; 8]; 8] = std::array::from_fn(|_| std::array::from_fn(|_| scale * (random.f32() - 0.5)));
            cast(rows)
        }

        #[test]
        fn avx2_has_the_results_of_portable_operations() {
            let Some(simd) = V3::try_new() else { return };
            let mut random = fastrand::Rng::with_seed(1);
            for scale in [1.0, 1.5, 10.0, 1000.0, 4000.0] {
                let rgba: [u8; 32] = std::array::from_fn(|_| random.u8(..));
                assert_eq!(simd.samples(&rgba), Scalar256b.samples(&rgba));
                let rows = random_rows(&mut random, scale);
                assert_eq!(simd.transpose(rows), Scalar256b.transpose(rows));
                assert_eq!(simd.pair_sums(rows[0], rows[1]), Scalar256b.pair_sums(rows[0], rows[1]));
                assert_eq!(simd.round(rows), Scalar256b.round(rows), "{scale}");
            }
            // Ties.
            let ties: [[f32; 8]; 8] = std::array::from_fn(|u| std::array::from_fn(|v| (u * 8 + v) as f32 / 2.0 - 9.0));
            assert_eq!(simd.round(cast(ties)), Scalar256b.round(cast(ties)));
        }

        #[test]
        fn only_selected_quadrants_are_shuffled() {
            let is_empty = |half: usize, quadrant: usize| SHUFFLES[half][quadrant] == [0x80; 32];
            assert!(is_empty(0, 3) && is_empty(1, 0), "{POSITIONS:?}");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn samples_are_those_of_the_standard() {
        let mut random = fastrand::Rng::with_seed(1);
        for _ in 0..1000 {
            let rgba: [u8; 32] = std::array::from_fn(|_| random.u8(..));
            let samples: [[f32; 8]; 3] = pulp::cast(Scalar256b.samples(&rgba));
            for pixel in 0..8 {
                let [red, green, blue] = [0, 1, 2].map(|channel| f64::from(rgba[4 * pixel + channel]));
                let luma = 0.299 * red + 0.587 * green + 0.114 * blue;
                let expected = [luma - 128.0, (blue - luma) / 1.772, (red - luma) / 1.402];
                for (samples, expected) in samples.iter().zip(expected) {
                    assert!((f64::from(samples[pixel]) - expected).abs() < 0.52, "{} {expected}", samples[pixel]);
                }
            }
        }
        let white: [[f32; 8]; 3] = pulp::cast(Scalar256b.samples(&[255; 32]));
        assert_eq!(white, [[127.0; 8], [0.0; 8], [0.0; 8]]);
    }

    #[test]
    fn rounded_block_has_zigzag_order() {
        let number = |u: usize, v: usize| if (u + v).is_multiple_of(3) { (10 * u + v) as f32 + 0.4 } else { -0.4 };
        let rows: [[f32; 8]; 8] = std::array::from_fn(|u| std::array::from_fn(|v| number(u, v)));
        let block = Scalar256b.round(pulp::cast(rows));
        for (index, position) in POSITIONS.into_iter().enumerate() {
            let [u, v] = frequencies(index);
            let value = block.values[usize::from(position)];
            assert_eq!(f32::from(value), number(u, v).round(), "{u} {v}");
            assert_eq!(block.nonzeros >> index & 1 == 1, value != 0, "{u} {v}");
        }
    }
}
