//! Decodes the entries of a chunk (a few modes of one tile) to columns of f32, one column per mode. A column is
//! `[axis][vertex of the tile]`. Tiles of f32 are stored in this order already.
//!
//! The documentation of `crate::storage` defines the stored layout. A chunk has three planes, and a plane has 16 bytes
//! (a packed word) per quad of four vertices. A group is the four entries of a quad for one mode and axis. A packed
//! word has one group (f32), two groups (f16 and bf16) or four groups (int8).

use crate::storage::{PackedWord, TILE_QUADS};

/// Decoded columns, with capacity for four modes, the largest number that is added together. A column has 12 numbers
/// per quad: three axes of four vertices.
pub(super) type Columns = [f32; 4 * 12 * TILE_QUADS];

/// Decodes two modes of f16 exactly, without their factors.
#[inline(always)]
pub(super) fn unpack_f16(packed_words: &[PackedWord], columns: &mut [f32]) {
    let mut buffer = [0_u64; 6 * TILE_QUADS];
    let bits: &[u16] = bytemuck::cast_slice(deinterleave(packed_words, &mut buffer));
    for (entry, bits) in columns.iter_mut().zip(bits) {
        *entry = decode_f16(*bits);
    }
}

/// Decodes a finite f16 without a branch and without subnormal operands, which would be slow.
#[inline(always)]
fn decode_f16(bits: u16) -> f32 {
    // Change the exponent's bias from 15 (f16) to 127 = 15 + 112 (f32). This turns a subnormal m 2^-24 into
    // x = 2^-15 + m 2^-25, and 2 x - 2^-14 is the correct value. For a subnormal, 2 x - 2^-14 is less than x. For all
    // other numbers it is at least x, and x is correct. The minimum of both is therefore the result.
    let bits = u32::from(bits);
    let x = f32::from_bits((bits << 13 & 0x0fff_e000) + (112 << 23));
    let corrected = x.mul_add(2.0, -MIN_NORMAL_F16);
    let magnitude = if x < corrected { x } else { corrected };
    f32::from_bits(magnitude.to_bits() | bits << 16 & 1 << 31)
}

/// 2^-14, the smallest normal f16.
pub(super) const MIN_NORMAL_F16: f32 = 1.0 / (1 << 14) as f32;

/// Decodes two modes of bf16 exactly, without their factors.
#[inline(always)]
pub(super) fn unpack_bf16(packed_words: &[PackedWord], columns: &mut [f32]) {
    let mut buffer = [0_u64; 6 * TILE_QUADS];
    let bits: &[u16] = bytemuck::cast_slice(deinterleave(packed_words, &mut buffer));
    for (entry, bits) in columns.iter_mut().zip(bits) {
        *entry = f32::from_bits(u32::from(*bits) << 16);
    }
}

/// Decodes four modes of int8 to integers from -127 to 127, without their scales. The stored code is the integer plus
/// 128.
#[inline(always)]
pub(super) fn unpack_int8(packed_words: &[PackedWord], columns: &mut [f32]) {
    let quads = packed_words.len() / 3;
    // Separate the four groups of four bytes in each packed word. (`deinterleave` does this for 16-bit entries.)
    let mut buffer = [0_u32; 12 * TILE_QUADS];
    let buffer = &mut buffer[..12 * quads];
    for (packed_words, groups) in packed_words.chunks_exact(quads).zip(buffer.chunks_exact_mut(4 * quads)) {
        let (ab, cd) = groups.split_at_mut(2 * quads);
        let ((a, b), (c, d)) = (ab.split_at_mut(quads), cd.split_at_mut(quads));
        let packed_words: &[[u32; 4]] = bytemuck::cast_slice(packed_words);
        for ((((word, a), b), c), d) in packed_words.iter().zip(a).zip(b).zip(c).zip(d) {
            [*a, *b, *c, *d] = *word;
        }
    }
    let bytes: &[u8] = bytemuck::cast_slice(buffer);
    for (entry, code) in columns.iter_mut().zip(bytes) {
        *entry = (i32::from(*code) - 128) as f32;
    }
}

/// Separates the two groups of four 16-bit entries in each packed word of a plane. A plane then has the first groups of
/// all quads, followed by their second groups.
#[inline(always)]
fn deinterleave<'a>(packed_words: &[PackedWord], buffer: &'a mut [u64; 6 * TILE_QUADS]) -> &'a [u64] {
    let quads = packed_words.len() / 3;
    // A quad has three planes of two groups each.
    let buffer = &mut buffer[..6 * quads];
    for (packed_words, groups) in packed_words.chunks_exact(quads).zip(buffer.chunks_exact_mut(2 * quads)) {
        let (a, b) = groups.split_at_mut(quads);
        let packed_words: &[[u64; 2]] = bytemuck::cast_slice(packed_words);
        for ((word, a), b) in packed_words.iter().zip(a).zip(b) {
            [*a, *b] = *word;
        }
    }
    buffer
}

#[cfg(test)]
mod tests {
    #[test]
    fn every_finite_f16_is_decoded_exactly() {
        for bits in (0..=u16::MAX).filter(|bits| half::f16::from_bits(*bits).is_finite()) {
            let expected = half::f16::from_bits(bits).to_f32();
            assert_eq!(super::decode_f16(bits).to_bits(), expected.to_bits(), "{bits:#06x}");
        }
    }
}
