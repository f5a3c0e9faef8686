//! Encodes columns of U as planes: scales, factors, rounding. Parallel over tiles.

use half::{bf16, f16};
use rayon::prelude::*;

use super::{Plane, QUAD, TILE_QUADS, Tile, modes_per_chunk};
use modalcast_model::domain::Modes;
use modalcast_model::scene::Storage;

/// x0 of up to four vertices, element `4 axis + vertex`.
pub(super) fn rest_quad(vertices: &[[f32; 3]]) -> [f32; 12] {
    let mut quad = [0.0; 12];
    for (at, vertex) in vertices.iter().enumerate() {
        (0..3).for_each(|axis| quad[QUAD * axis + at] = vertex[axis]);
    }
    quad
}

/// Factors 2^s per mode such that the largest stored entry lies in [2^14, 2^15) for `F16`, in [1, 2) for `Bf16`; 1 for
/// a mode of zeros. s is at least -149, where 2^s is the smallest f32: columns below 2^-135 are stored smaller, without
/// loss of precision.
pub(super) fn factors(modes: &Modes, storage: Storage) -> Vec<f32> {
    let top = match storage {
        Storage::F16 => 14,
        Storage::Bf16 => 0,
        Storage::F32 | Storage::Int8 => return Vec::new(),
    };
    let factor = |mode: usize| match largest(modes.column(mode)) {
        0.0 => 1.0,
        largest => power_of_two((exponent(largest) - top).max(-149)) as f32,
    };
    (0..modes.rank()).into_par_iter().map(factor).collect()
}

/// Writes the planes of `F32`, `F16` or `Bf16`; they must be zero.
pub(super) fn fill_floats(modes: &Modes, tiles: &[Tile], storage: (Storage, &[f32]), planes: &mut [Plane]) {
    let (storage, factors) = storage;
    let inverse = |mode: usize| 1.0 / f64::from(factors[mode]);
    each_tile(modes, storage, tiles, planes).for_each(|(tile, planes)| match storage {
        Storage::F32 => write(modes, tile, storage, planes, |_, entry| entry.to_ne_bytes()),
        // The quotient is exact in f64, and in f32 unless it is far below the range of the storage type.
        Storage::F16 => write(modes, tile, storage, planes, |mode, entry| {
            f16::from_f32((f64::from(entry) * inverse(mode)) as f32).to_ne_bytes()
        }),
        Storage::Bf16 => write(modes, tile, storage, planes, |mode, entry| {
            bf16::from_f32((f64::from(entry) * inverse(mode)) as f32).to_ne_bytes()
        }),
        Storage::Int8 => {}
    });
}

/// Writes the planes and scales of `Int8`.
pub(super) fn fill_codes(modes: &Modes, tiles: &[Tile], planes: &mut [Plane], scales: &mut [f32]) {
    let per_tile = modes.rank().next_multiple_of(modes_per_chunk(Storage::Int8));
    let parts = each_tile(modes, Storage::Int8, tiles, planes).zip(scales.par_chunks_mut(per_tile));
    parts.for_each(|((tile, planes), scales)| {
        planes.fill(Plane([ZERO_CODE; 16]));
        for (mode, scale) in scales.iter_mut().take(modes.rank()).enumerate() {
            *scale = step_between_codes(largest(rows(modes, tile, mode)));
        }
        let scales = &*scales;
        write(modes, tile, Storage::Int8, planes, |mode, entry| match scales[mode] {
            0.0 => [ZERO_CODE],
            // At most 127 away from zero, because the scale was rounded up.
            scale => [((f64::from(entry) / f64::from(scale)).round() + f64::from(ZERO_CODE)) as u8],
        });
    });
}

/// The code of zero.
const ZERO_CODE: u8 = 128;

/// Each tile with its planes. Only the last tile of a shape is shorter.
fn each_tile<'a>(
    modes: &Modes,
    storage: Storage,
    tiles: &'a [Tile],
    planes: &'a mut [Plane],
) -> impl IndexedParallelIterator<Item = (&'a Tile, &'a mut [Plane])> {
    let chunks = modes.rank().div_ceil(modes_per_chunk(storage));
    tiles.par_iter().zip(planes.par_chunks_mut(3 * chunks * TILE_QUADS))
}

/// The entries of a tile's vertices in one mode, three per vertex.
fn rows<'a>(modes: &'a Modes, tile: &Tile, mode: usize) -> &'a [f32] {
    &modes.column(mode)[3 * tile.first_vertex..][..3 * tile.vertices]
}

/// Writes every entry of a tile to its byte offset.
fn write<const SIZE: usize>(
    modes: &Modes,
    tile: &Tile,
    storage: Storage,
    planes: &mut [Plane],
    encode: impl Fn(usize, f32) -> [u8; SIZE],
) {
    let per_chunk = modes_per_chunk(storage);
    for mode in 0..modes.rank() {
        let chunk = 3 * (mode / per_chunk) * tile.quads;
        for (vertex, entries) in rows(modes, tile, mode).chunks_exact(3).enumerate() {
            for (axis, entry) in entries.iter().enumerate() {
                let byte = SIZE * ((mode % per_chunk * 3 + axis) * QUAD + vertex % QUAD);
                let plane = &mut planes[chunk + byte / 16 * tile.quads + vertex / QUAD];
                plane.0[byte % 16..][..SIZE].copy_from_slice(&encode(mode, *entry));
            }
        }
    }
}

/// 1/127 of the largest entry, rounded up, so that 127 steps reach it. A tile of zeros has step 0.
fn step_between_codes(largest: f32) -> f32 {
    let exact = f64::from(largest) / 127.0;
    let near = exact as f32;
    if f64::from(near) < exact { near.next_up() } else { near }
}

fn largest(entries: &[f32]) -> f32 {
    entries.iter().fold(0.0, |largest, entry| entry.abs().max(largest))
}

/// The floor of the binary logarithm of a positive number.
pub(super) fn exponent(number: f32) -> i32 {
    // Every f32 is a normal number in f64.
    ((f64::from(number).to_bits() >> 52) & 0x7ff) as i32 - 1023
}

/// 2^s, exact, for s in -1022 to 1023.
pub(super) const fn power_of_two(s: i32) -> f64 {
    f64::from_bits(((s + 1023) as u64) << 52)
}
