//! Splits each coordinate of q into two 16-bit numbers, for sums by tensor cores with U in 16 bits. Both numbers have
//! the type of U, f16 or bf16.
//!
//! A number x becomes h = round(x) and l = round(x - h). For a type with p significant bits, |x - h| <= 2^-p |x|.
//! Unless l is denormal, |x - h - l| <= 2^-2p |x|: 2^-22 |x| with f16 (p = 11), 2^-16 |x| with bf16 (p = 8).
//!
//! All coordinates of a domain are first multiplied by one power of two, so that the largest coordinate lies in
//! [2^13, 2^14). Then no coordinate overflows f16. If l is denormal, the error is at most 2^-25, which is at most 2^-38
//! times the largest coordinate.

use half::{bf16, f16};

use modalcast_model::scene::StorageType;

/// Exponent of the power of two at or below the largest coordinate, after scaling.
const TOP_EXPONENT: i32 = 13;
/// Largest coordinates below 2^-113 are scaled as if they were 2^-113, so that the inverse scaling is at least 2^-126.
const MIN_EXPONENT: i32 = -113;

/// The split coordinates of one domain.
#[derive(Debug, Clone, PartialEq)]
pub struct SplitCoordinates {
    storage: StorageType,
    /// Per mode, the bits of h and l.
    pairs: Vec<[u16; 2]>,
    /// Exponent of the inverse scaling: sums are multiplied by 2 to this power.
    exponent: i32,
}

impl SplitCoordinates {
    /// Splits finite coordinates, which are already multiplied by the factors of their modes. They become pairs of f16
    /// for U in `F16`, and pairs of bf16 for any other storage.
    pub fn new(scaled_q: &[f32], storage: StorageType) -> Self {
        let largest = scaled_q.iter().fold(0.0, |largest: f32, coordinate| largest.max(coordinate.abs()));
        let exponent = floor_log2(largest).max(MIN_EXPONENT) - TOP_EXPONENT;
        let scale = f64::from(-exponent).exp2();
        let split = |coordinate: &f32| {
            let scaled = f64::from(*coordinate) * scale;
            let high = encode(scaled, storage);
            [high, encode(scaled - decode(high, storage), storage)]
        };
        Self { storage, pairs: scaled_q.iter().map(split).collect(), exponent }
    }

    /// The bits of h and l of a mode.
    pub fn pair(&self, mode: usize) -> [u16; 2] {
        self.pairs[mode]
    }

    /// Factor by which sums are multiplied to undo the scaling: a power of two that f32 can represent.
    pub fn inverse_scale(&self) -> f32 {
        f64::from(self.exponent).exp2() as f32
    }

    /// The coordinate of a mode that its pair represents.
    pub fn decode_coordinate(&self, mode: usize) -> f64 {
        let [high, low] = self.pairs[mode];
        (decode(high, self.storage) + decode(low, self.storage)) * f64::from(self.exponent).exp2()
    }
}

/// Relative error bounds of U q by tensor cores, in addition to the storage error of U.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TensorCoreError {
    /// Error of each coordinate by the split, relative to the coordinate.
    pub coordinate: f64,
    /// Further error of each coordinate if l is denormal, relative to the largest coordinate of the domain.
    pub floor: f64,
    /// Error of the sum, relative to the sum of the magnitudes of all terms.
    pub sum: f64,
}

/// 2^-23: the maximum error of truncating a term that is aligned to the exponent of the largest term, relative to the
/// largest term.
const TRUNCATION_ERROR: f64 = 1.0 / (1 << 23) as f64;
/// Number of modes per matrix product (mma.m16n8k16).
const MMA_MODES: usize = 16;
/// Upper bound of the number of truncations in a matrix product of 16 terms. A tensor core sums the terms at once or in
/// two halves of 8. It truncates each term, and in each half the previous sum and the result: 16 + 2 * 2 = 20.
const TRUNCATIONS: f64 = 20.0;

impl TensorCoreError {
    /// Bounds for `rank` modes in this storage type.
    ///
    /// A tensor core multiplies exactly, aligns all terms and the previous sum to the largest of them, and truncates
    /// (Fasi, Higham, Mikaitis, Pranesh, Numerical behavior of NVIDIA tensor cores, PeerJ Computer Science 7:e330,
    /// 2021). A matrix product therefore has an error of at most `TRUNCATIONS * TRUNCATION_ERROR` times the sum of
    /// all magnitudes. There are two matrix products for every 16 modes, one for h and one for l.
    pub fn of(storage: StorageType, rank: usize) -> Self {
        let coordinate = f64::from(if storage == StorageType::F16 { -22_i8 } else { -16 }).exp2();
        let sum = 2.0 * rank.div_ceil(MMA_MODES) as f64 * TRUNCATIONS * TRUNCATION_ERROR;
        // The last factor: the tensor core sums rounded coordinates and partial sums, whose magnitudes may be slightly
        // larger than the exact ones.
        Self { coordinate, floor: f64::from(-25 - TOP_EXPONENT).exp2(), sum: sum * (1.0 + 2.0 * sum + 1e-4) }
    }

    /// Smallest value of the largest coordinate to which `floor` is relative: smaller largest coordinates count as this
    /// value.
    pub(super) fn min_largest_coordinate() -> f64 {
        f64::from(MIN_EXPONENT).exp2()
    }
}

/// Exponent of the power of two at or below a number; for zero, that of the smallest f32.
fn floor_log2(number: f32) -> i32 {
    let bits = f64::from(number).to_bits();
    if number == 0.0 { -149 } else { (bits >> 52) as i32 - 1023 }
}

/// Rounds a number to the bits of f16 or bf16.
fn encode(number: f64, storage: StorageType) -> u16 {
    if storage == StorageType::F16 { f16::from_f64(number).to_bits() } else { bf16::from_f64(number).to_bits() }
}

/// The number with these bits of f16 or bf16.
fn decode(bits: u16, storage: StorageType) -> f64 {
    if storage == StorageType::F16 { f16::from_bits(bits).to_f64() } else { bf16::from_bits(bits).to_f64() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::TestRng;

    #[test]
    fn split_error_is_within_its_bound_only_with_the_low_part() {
        let mut rng = TestRng(3);
        for storage in [StorageType::F16, StorageType::Bf16] {
            let error_bound = TensorCoreError::of(storage, 32);
            for exponent in [-149, -126, -60, -14, 0, 30, 127] {
                let scale = f64::from(exponent).exp2();
                let random_coordinate = |index: i32| (f64::from(rng.next()) * scale * f64::from(-index).exp2()) as f32;
                let scaled_q: Vec<f32> = (0..32).map(random_coordinate).collect();
                let split = SplitCoordinates::new(&scaled_q, storage);
                let largest = scaled_q.iter().fold(0.0, |largest: f32, coordinate| largest.max(coordinate.abs()));
                let limited_largest = f64::from(largest).max(TensorCoreError::min_largest_coordinate());
                let mut high_part_exceeds_bound = false;
                for (mode, coordinate) in scaled_q.iter().map(|coordinate| f64::from(*coordinate)).enumerate() {
                    let max_error = error_bound.coordinate * coordinate.abs() + error_bound.floor * limited_largest;
                    assert!(
                        (split.decode_coordinate(mode) - coordinate).abs() <= max_error,
                        "{storage:?} {exponent} {mode}"
                    );
                    let high = decode(split.pair(mode)[0], storage) * f64::from(split.inverse_scale());
                    high_part_exceeds_bound |= (high - coordinate).abs() > max_error;
                }
                // Subnormal coordinates have few bits, which the high part alone may represent.
                assert!(
                    high_part_exceeds_bound || exponent < -120,
                    "{storage:?} 2^{exponent}: expected the high part alone to exceed the bound"
                );
                assert!(split.inverse_scale() > 0.0 && split.inverse_scale().is_finite());
            }
        }
    }

    #[test]
    fn zeros_and_extremes_of_f32_stay_finite_and_keep_their_signs() {
        let zeros = SplitCoordinates::new(&[0.0, -0.0], StorageType::F16);
        assert_eq!((zeros.decode_coordinate(0), zeros.decode_coordinate(1)), (0.0, 0.0));
        let wide = SplitCoordinates::new(&[f32::MAX, -f32::MAX, f32::MIN_POSITIVE, 1e-45], StorageType::F16);
        // 3e-7 is above 2^-22, the relative error of a split coordinate in f16.
        assert!(
            (wide.decode_coordinate(0) / f64::from(f32::MAX) - 1.0).abs() < 3e-7
                && wide.decode_coordinate(1) == -wide.decode_coordinate(0)
        );
        assert_eq!(
            (wide.decode_coordinate(2), wide.decode_coordinate(3)),
            (0.0, 0.0),
            "expected values below 2^-253 times the largest to become 0"
        );
        assert_eq!(SplitCoordinates::new(&[3.0], StorageType::F16).decode_coordinate(0), 3.0);
    }
}
