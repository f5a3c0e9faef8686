//! Decodes a chunk of stored planes to columns of f32, `[mode][axis][vertex of the tile]`, which is the stored order of
//! f32 tiles. The planes of a tile are read sequentially.

use crate::storage::{PackedWord, TILE_QUADS};

/// Capacity for the four modes that are added together.
pub(super) type Columns = [f32; 4 * 12 * TILE_QUADS];

/// Decodes two modes of f16, without their factors. Exact.
#[inline(always)]
pub(super) fn unpack_f16(packed_words: &[PackedWord], columns: &mut [f32]) {
    let mut room = [0_u64; 6 * TILE_QUADS];
    let bits: &[u16] = bytemuck::cast_slice(deinterleave(packed_words, &mut room));
    for (column, bits) in columns.iter_mut().zip(bits) {
        *column = half(*bits);
    }
}

/// Decodes a finite f16 without a branch and without subnormal operands, which would be slow.
#[inline(always)]
fn half(bits: u16) -> f32 {
    // Change the exponent's bias from 15 to 127. A subnormal m 2^-24 becomes x = 2^-15 + m 2^-25, which 2 x - 2^-14
    // corrects; for all other numbers that expression is at least x.
    let bits = u32::from(bits);
    let x = f32::from_bits((bits << 13 & 0x0fff_e000) + (112 << 23));
    let fixed = x.mul_add(2.0, -SMALLEST_NORMAL_HALF);
    let magnitude = if x < fixed { x } else { fixed };
    f32::from_bits(magnitude.to_bits() | bits << 16 & 1 << 31)
}

/// 2^-14.
pub(super) const SMALLEST_NORMAL_HALF: f32 = 1.0 / (1 << 14) as f32;

/// Decodes two modes of bf16, without their factors. Exact.
#[inline(always)]
pub(super) fn unpack_bf16(packed_words: &[PackedWord], columns: &mut [f32]) {
    let mut room = [0_u64; 6 * TILE_QUADS];
    let bits: &[u16] = bytemuck::cast_slice(deinterleave(packed_words, &mut room));
    for (column, bits) in columns.iter_mut().zip(bits) {
        *column = f32::from_bits(u32::from(*bits) << 16);
    }
}

/// Decodes four modes of codes, -127 to 127, without their scales.
#[inline(always)]
pub(super) fn unpack_int8(packed_words: &[PackedWord], columns: &mut [f32]) {
    let quads = packed_words.len() / 3;
    let mut room = [0_u32; 12 * TILE_QUADS];
    let room = &mut room[..12 * quads];
    for (packed_words, groups) in packed_words.chunks_exact(quads).zip(room.chunks_exact_mut(4 * quads)) {
        let (ab, cd) = groups.split_at_mut(2 * quads);
        let ((a, b), (c, d)) = (ab.split_at_mut(quads), cd.split_at_mut(quads));
        let packed_words: &[[u32; 4]] = bytemuck::cast_slice(packed_words);
        for ((((plane, a), b), c), d) in packed_words.iter().zip(a).zip(b).zip(c).zip(d) {
            [*a, *b, *c, *d] = *plane;
        }
    }
    let bytes: &[u8] = bytemuck::cast_slice(room);
    for (column, code) in columns.iter_mut().zip(bytes) {
        *column = (i32::from(*code) - 128) as f32;
    }
}

/// Separates the two groups of four halves that each plane of a chunk has per quad: the first groups of all quads, then
/// the second.
#[inline(always)]
fn deinterleave<'a>(packed_words: &[PackedWord], room: &'a mut [u64; 6 * TILE_QUADS]) -> &'a [u64] {
    let quads = packed_words.len() / 3;
    let room = &mut room[..6 * quads];
    for (packed_words, groups) in packed_words.chunks_exact(quads).zip(room.chunks_exact_mut(2 * quads)) {
        let (a, b) = groups.split_at_mut(quads);
        let packed_words: &[[u64; 2]] = bytemuck::cast_slice(packed_words);
        for ((plane, a), b) in packed_words.iter().zip(a).zip(b) {
            [*a, *b] = *plane;
        }
    }
    room
}

#[cfg(test)]
mod tests {
    #[test]
    fn every_finite_half_is_decoded_exactly() {
        for bits in (0..=u16::MAX).filter(|bits| half::f16::from_bits(*bits).is_finite()) {
            let want = half::f16::from_bits(bits).to_f32();
            assert_eq!(super::half(bits).to_bits(), want.to_bits(), "{bits:#06x}");
        }
    }
}
