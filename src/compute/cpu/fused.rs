//! Decodes and sums stored entries in vector registers, two quads (of four vertices) at a time. [`super::sum`] also has
//! a path that first decodes columns to memory. The code of this module is much faster and gives bit-identical results,
//! but supports only x86 and uncompensated sums.
//!
//! The documentation of `crate::storage` defines the stored layout. A chunk of modes has three planes, and a plane has
//! 16 bytes (a packed word) per quad. A group is the four entries of a quad for one mode and axis.

use std::arch::x86_64::{__m256, __m256i};

use pulp::cast;
use pulp::x86::V3;

use super::decode::MIN_NORMAL_F16;
use crate::storage::{PackedWord, QUAD};

/// Decoder of a storage type. It decodes 32 bytes: the packed words of two quads in one plane. Each of the `GROUPS`
/// results has one group of both quads, that is, the entries of eight vertices for one mode and axis.
pub(super) trait Decode<const GROUPS: usize> {
    fn decode(simd: V3, packed_words: __m256i) -> [__m256; GROUPS];
}

/// Decoder of f16.
pub(super) struct DecodeF16;
/// Decoder of bf16.
pub(super) struct DecodeBf16;
/// Decoder of int8.
pub(super) struct DecodeInt8;

// Closures are compiled without the CPU features that intrinsics need to be inlined, so no closure here calls
// intrinsics.

impl Decode<2> for DecodeF16 {
    #[inline(always)]
    fn decode(simd: V3, packed_words: __m256i) -> [__m256; 2] {
        let mut groups = [simd.avx._mm256_set1_ps(0.0); 2];
        for (group, target) in groups.iter_mut().enumerate() {
            let bits = simd.avx2._mm256_shuffle_epi8(packed_words, cast(SHUFFLE_16_BIT[group]));
            // The algorithm of `decode::decode_f16`. Its shift by 13 to the left is a shift by 3 to the right here,
            // because the entry is in the upper 16 bits.
            let mantissa_mask = simd.avx._mm256_set1_epi32(0x0fff_e000);
            let magnitude = simd.avx2._mm256_and_si256(simd.avx2._mm256_srli_epi32::<3>(bits), mantissa_mask);
            let x = cast(simd.avx2._mm256_add_epi32(magnitude, simd.avx._mm256_set1_epi32(112 << 23)));
            let (two, offset) = (simd.avx._mm256_set1_ps(2.0), simd.avx._mm256_set1_ps(MIN_NORMAL_F16));
            let corrected = simd.fma._mm256_fmsub_ps(two, x, offset);
            let sign = simd.avx._mm256_and_ps(cast(bits), simd.avx._mm256_set1_ps(-0.0));
            *target = simd.avx._mm256_or_ps(sign, simd.avx._mm256_min_ps(x, corrected));
        }
        groups
    }
}

impl Decode<2> for DecodeBf16 {
    #[inline(always)]
    fn decode(simd: V3, packed_words: __m256i) -> [__m256; 2] {
        [
            cast(simd.avx2._mm256_shuffle_epi8(packed_words, cast(SHUFFLE_16_BIT[0]))),
            cast(simd.avx2._mm256_shuffle_epi8(packed_words, cast(SHUFFLE_16_BIT[1]))),
        ]
    }
}

impl Decode<4> for DecodeInt8 {
    #[inline(always)]
    fn decode(simd: V3, packed_words: __m256i) -> [__m256; 4] {
        // 0x4b00_0000 are the bits of 2^23 in f32. A byte in its lowest mantissa bits gives 2^23 + byte. One exact
        // subtraction removes 2^23 = 8388608 and 128, the code of zero.
        let exponent_bits = simd.avx._mm256_set1_epi32(0x4b00_0000);
        let bias = simd.avx._mm256_set1_ps(8_388_608.0 + 128.0);
        let mut groups = [bias; 4];
        for (group, target) in groups.iter_mut().enumerate() {
            let bytes = simd.avx2._mm256_shuffle_epi8(packed_words, cast(SHUFFLE_8_BIT[group]));
            *target = simd.avx._mm256_sub_ps(cast(simd.avx2._mm256_or_si256(bytes, exponent_bits)), bias);
        }
        groups
    }
}

/// Per group, the shuffle mask that moves each of its 16-bit entries to the upper half of a 32-bit word. A mask has the
/// index of a source byte for each target byte, or 0x80 for zero. AVX2 shuffles the 16 bytes of each quad separately,
/// so both halves of a mask are equal.
const SHUFFLE_16_BIT: [[u8; 32]; 2] = [shuffle_mask(2, 0), shuffle_mask(2, 1)];

/// Per group, the shuffle mask that moves each of its bytes to the lowest byte of a 32-bit word.
const SHUFFLE_8_BIT: [[u8; 32]; 4] = [shuffle_mask(1, 0), shuffle_mask(1, 1), shuffle_mask(1, 2), shuffle_mask(1, 3)];

/// The shuffle mask of a group of four entries of `entry_bytes` bytes.
const fn shuffle_mask(entry_bytes: u8, group: u8) -> [u8; 32] {
    let mut mask = [0x80; 32];
    let mut vertex = 0;
    while vertex < 4 {
        let mut byte = 0;
        while byte < entry_bytes {
            // Entries of 16 bits go to bytes 2 and 3 of a word, entries of 8 bits to byte 0.
            let target_byte = (4 * vertex + if entry_bytes == 2 { 2 } else { 0 } + byte) as usize;
            mask[target_byte] = entry_bytes * (4 * group + vertex) + byte;
            mask[target_byte + 16] = mask[target_byte];
            byte += 1;
        }
        vertex += 1;
    }
    mask
}

/// Adds chunks of a tile to its sums, `[axis][vertex]`. Each of `chunks` has the three planes of a chunk, and the
/// scaled coordinates of its `MODES` modes. A packed word has `GROUPS` groups.
#[inline(always)]
pub(super) fn add_chunks<D: Decode<GROUPS>, const GROUPS: usize, const MODES: usize, const CHUNKS: usize>(
    simd: V3,
    chunks: [(&[PackedWord], [f32; MODES]); CHUNKS],
    sums: &mut [f32],
) {
    let quads = sums.len() / (3 * QUAD);
    let (x, yz) = sums.split_at_mut(QUAD * quads);
    let (y, z) = yz.split_at_mut(QUAD * quads);
    // x, y and z become arrays of eight sums, one per pair of quads. The tails have the last quad if its pair is
    // missing.
    let ((x, x_tail), (y, y_tail), (z, z_tail)) = (x.as_chunks_mut(), y.as_chunks_mut(), z.as_chunks_mut());
    for (pair, ((x, y), z)) in x.iter_mut().zip(y).zip(z).enumerate() {
        add_pair::<D, GROUPS, MODES, CHUNKS>(simd, &chunks, [2 * pair, 2 * pair + 1], [x, y, z]);
    }
    if quads % 2 == 1 {
        // Process the last quad as both quads of a pair, and drop the second result.
        let mut padded_sums = [[0.0; 2 * QUAD]; 3];
        let [x_sums, y_sums, z_sums] = &mut padded_sums;
        x_sums[..QUAD].copy_from_slice(x_tail);
        y_sums[..QUAD].copy_from_slice(y_tail);
        z_sums[..QUAD].copy_from_slice(z_tail);
        add_pair::<D, GROUPS, MODES, CHUNKS>(simd, &chunks, [quads - 1; 2], [x_sums, y_sums, z_sums]);
        x_tail.copy_from_slice(&x_sums[..QUAD]);
        y_tail.copy_from_slice(&y_sums[..QUAD]);
        z_tail.copy_from_slice(&z_sums[..QUAD]);
    }
}

/// Adds chunks to the sums of two quads: x, y and z of eight vertices.
#[inline(always)]
fn add_pair<D: Decode<GROUPS>, const GROUPS: usize, const MODES: usize, const CHUNKS: usize>(
    simd: V3,
    chunks: &[(&[PackedWord], [f32; MODES]); CHUNKS],
    quads: [usize; 2],
    sums: [&mut [f32; 2 * QUAD]; 3],
) {
    let [x, y, z] = sums;
    let mut axis_sums: [__m256; 3] = [cast(*x), cast(*y), cast(*z)];
    for (packed_words, scaled_q) in chunks {
        let quad_count = packed_words.len() / 3;
        // Groups are ordered by mode, then axis, so each sum adds its modes in ascending order.
        for plane in 0..3 {
            let words = [packed_words[plane * quad_count + quads[0]], packed_words[plane * quad_count + quads[1]]];
            let groups = D::decode(simd, cast(words));
            for (group, entries) in groups.iter().enumerate() {
                let group_in_chunk = GROUPS * plane + group;
                let (mode, axis) = (group_in_chunk / 3, group_in_chunk % 3);
                let coordinate = simd.avx._mm256_set1_ps(scaled_q[mode]);
                axis_sums[axis] = simd.fma._mm256_fmadd_ps(*entries, coordinate, axis_sums[axis]);
            }
        }
    }
    (*x, *y, *z) = (cast(axis_sums[0]), cast(axis_sums[1]), cast(axis_sums[2]));
}
