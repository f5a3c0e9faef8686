//! A chunk of stored planes to columns of f32, `[mode][axis][vertex of the tile]`: the order that f32 tiles have as they
//! are. The planes of a tile are read from their first byte to their last.

use half::f16;
use half::slice::{HalfBitsSliceExt, HalfFloatSliceExt};

use crate::storage::{Plane, TILE_QUADS};

/// Room for the four modes that are added at once.
pub(super) type Columns = [f32; 4 * 12 * TILE_QUADS];

/// Two modes of f16, without their factors. Exact.
#[inline(always)]
pub(super) fn halves(planes: &[Plane], columns: &mut [f32]) {
    let mut room = [0_u64; 6 * TILE_QUADS];
    let bits: &[u16] = bytemuck::cast_slice(pairs_apart(planes, &mut room));
    bits.reinterpret_cast::<f16>().convert_to_f32_slice(columns);
}

/// Two modes of bf16, without their factors. Exact.
#[inline(always)]
pub(super) fn brains(planes: &[Plane], columns: &mut [f32]) {
    let mut room = [0_u64; 6 * TILE_QUADS];
    let bits: &[u16] = bytemuck::cast_slice(pairs_apart(planes, &mut room));
    for (column, bits) in columns.iter_mut().zip(bits) {
        *column = f32::from_bits(u32::from(*bits) << 16);
    }
}

/// Four modes of codes, -127 to 127, without their scales.
#[inline(always)]
pub(super) fn codes(planes: &[Plane], columns: &mut [f32]) {
    let quads = planes.len() / 3;
    let mut room = [0_u32; 12 * TILE_QUADS];
    let room = &mut room[..12 * quads];
    for (planes, groups) in planes.chunks_exact(quads).zip(room.chunks_exact_mut(4 * quads)) {
        let (ab, cd) = groups.split_at_mut(2 * quads);
        let ((a, b), (c, d)) = (ab.split_at_mut(quads), cd.split_at_mut(quads));
        let planes: &[[u32; 4]] = bytemuck::cast_slice(planes);
        for ((((plane, a), b), c), d) in planes.iter().zip(a).zip(b).zip(c).zip(d) {
            [*a, *b, *c, *d] = *plane;
        }
    }
    let bytes: &[u8] = bytemuck::cast_slice(room);
    for (column, code) in columns.iter_mut().zip(bytes) {
        *column = (i32::from(*code) - 128) as f32;
    }
}

/// Each plane of a chunk holds two groups of four halves per quad: the first ones of all quads, then the second ones.
#[inline(always)]
fn pairs_apart<'a>(planes: &[Plane], room: &'a mut [u64; 6 * TILE_QUADS]) -> &'a [u64] {
    let quads = planes.len() / 3;
    let room = &mut room[..6 * quads];
    for (planes, groups) in planes.chunks_exact(quads).zip(room.chunks_exact_mut(2 * quads)) {
        let (a, b) = groups.split_at_mut(quads);
        let planes: &[[u64; 2]] = bytemuck::cast_slice(planes);
        for ((plane, a), b) in planes.iter().zip(a).zip(b) {
            [*a, *b] = *plane;
        }
    }
    room
}
