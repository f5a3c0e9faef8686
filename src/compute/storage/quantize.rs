//! Encodes the entries of U in a storage type, in parallel over tiles. The module `storage` describes tiles, planes and
//! chunks.

use half::{bf16, f16};
use rayon::prelude::*;

use super::{PackedWord, QUAD, TILE_QUADS, TileLayout, modes_per_chunk};
use modalcast_model::domain::Modes;
use modalcast_model::scene::StorageType;

/// Packs x0 of up to four vertices, at the indices `4 axis + vertex`.
pub(super) fn rest_quad(vertices: &[[f32; 3]]) -> [f32; 12] {
    let mut quad = [0.0; 12];
    for (vertex, position) in vertices.iter().enumerate() {
        (0..3).for_each(|axis| quad[QUAD * axis + vertex] = position[axis]);
    }
    quad
}

/// Per mode the factor 2^s, by which stored entries are multiplied. The largest stored entry lies in [2^14, 2^15) for
/// `F16` and in [1, 2) for `Bf16`; the factor of a mode of zeros is 1. s is at least -149, because 2^-149 is the
/// smallest positive f32. With `F16`, modes with entries below 2^-135 therefore have smaller stored entries, without
/// loss of precision.
pub(super) fn factors(modes: &Modes, storage: StorageType) -> Vec<f32> {
    let stored_exponent = match storage {
        StorageType::F16 => 14,
        StorageType::Bf16 => 0,
        StorageType::F32 | StorageType::Int8 => return Vec::new(),
    };
    let factor = |mode: usize| match max_magnitude(modes.column(mode)) {
        0.0 => 1.0,
        magnitude => power_of_two((floor_log2(magnitude) - stored_exponent).max(-149)) as f32,
    };
    (0..modes.rank()).into_par_iter().map(factor).collect()
}

/// Encodes U as `F32`, `F16` or `Bf16`. `packed_words` must be zero before the call.
pub(super) fn encode_floats(
    modes: &Modes,
    tiles: &[TileLayout],
    storage: StorageType,
    factors: &[f32],
    packed_words: &mut [PackedWord],
) {
    let inverse = |mode: usize| 1.0 / f64::from(factors[mode]);
    par_tiles(modes, storage, tiles, packed_words).for_each(|(tile, packed_words)| match storage {
        StorageType::F32 => write_planes(modes, tile, storage, packed_words, |_, entry| entry.to_ne_bytes()),
        // The quotient is exact in f64, and in f32 unless it is far below the range of the storage type.
        StorageType::F16 => write_planes(modes, tile, storage, packed_words, |mode, entry| {
            f16::from_f32((f64::from(entry) * inverse(mode)) as f32).to_ne_bytes()
        }),
        StorageType::Bf16 => write_planes(modes, tile, storage, packed_words, |mode, entry| {
            bf16::from_f32((f64::from(entry) * inverse(mode)) as f32).to_ne_bytes()
        }),
        StorageType::Int8 => {}
    });
}

/// Encodes U as `Int8`, and writes the scale of each tile and mode.
pub(super) fn encode_int8(modes: &Modes, tiles: &[TileLayout], packed_words: &mut [PackedWord], scales: &mut [f32]) {
    let scales_per_tile = modes.rank().next_multiple_of(modes_per_chunk(StorageType::Int8));
    let encoded_tiles =
        par_tiles(modes, StorageType::Int8, tiles, packed_words).zip(scales.par_chunks_mut(scales_per_tile));
    encoded_tiles.for_each(|((tile, packed_words), scales)| {
        packed_words.fill(PackedWord([ZERO_CODE; 16]));
        for (mode, scale) in scales.iter_mut().take(modes.rank()).enumerate() {
            *scale = quantization_step(max_magnitude(tile_entries(modes, tile, mode)));
        }
        let scales = &*scales;
        write_planes(modes, tile, StorageType::Int8, packed_words, |mode, entry| match scales[mode] {
            0.0 => [ZERO_CODE],
            // The code differs from `ZERO_CODE` by at most 127, because the scale was rounded up.
            scale => [((f64::from(entry) / f64::from(scale)).round() + f64::from(ZERO_CODE)) as u8],
        });
    });
}

/// The stored code of an entry of zero with `Int8`.
const ZERO_CODE: u8 = 128;

/// Iterates in parallel over tiles and their packed words. Only the last tile of a shape may have fewer quads.
fn par_tiles<'a>(
    modes: &Modes,
    storage: StorageType,
    tiles: &'a [TileLayout],
    packed_words: &'a mut [PackedWord],
) -> impl IndexedParallelIterator<Item = (&'a TileLayout, &'a mut [PackedWord])> {
    let chunks = modes.rank().div_ceil(modes_per_chunk(storage));
    tiles.par_iter().zip(packed_words.par_chunks_mut(3 * chunks * TILE_QUADS))
}

/// The entries of a tile's vertices in one mode, three per vertex.
fn tile_entries<'a>(modes: &'a Modes, tile: &TileLayout, mode: usize) -> &'a [f32] {
    &modes.column(mode)[3 * tile.first_vertex..][..3 * tile.vertices]
}

/// Writes every entry of a tile to its place in the packed words of the tile. `encode` gets the mode and the entry.
fn write_planes<const SIZE: usize>(
    modes: &Modes,
    tile: &TileLayout,
    storage: StorageType,
    packed_words: &mut [PackedWord],
    encode: impl Fn(usize, f32) -> [u8; SIZE],
) {
    let chunk_modes = modes_per_chunk(storage);
    for mode in 0..modes.rank() {
        let first_word = 3 * (mode / chunk_modes) * tile.quads;
        for (vertex, entries) in tile_entries(modes, tile, mode).chunks_exact(3).enumerate() {
            for (axis, entry) in entries.iter().enumerate() {
                let byte = SIZE * ((mode % chunk_modes * 3 + axis) * QUAD + vertex % QUAD);
                let word = &mut packed_words[first_word + byte / 16 * tile.quads + vertex / QUAD];
                word.0[byte % 16..][..SIZE].copy_from_slice(&encode(mode, *entry));
            }
        }
    }
}

/// The scale of `Int8`: 1/127 of the largest magnitude, rounded up, so that 127 steps reach the largest entry. 0 for
/// entries of zero.
fn quantization_step(max_magnitude: f32) -> f32 {
    let exact = f64::from(max_magnitude) / 127.0;
    let nearest = exact as f32;
    if f64::from(nearest) < exact { nearest.next_up() } else { nearest }
}

/// The largest magnitude of these entries.
fn max_magnitude(entries: &[f32]) -> f32 {
    entries.iter().fold(0.0, |largest, entry| entry.abs().max(largest))
}

/// The floor of the binary logarithm of a positive number.
pub(super) fn floor_log2(number: f32) -> i32 {
    // Every f32 is a normal number in f64.
    ((f64::from(number).to_bits() >> 52) & 0x7ff) as i32 - 1023
}

/// 2^s, exact, for s in -1022 to 1023.
pub(super) const fn power_of_two(s: i32) -> f64 {
    f64::from_bits(((s + 1023) as u64) << 52)
}
