//! u = U q of one tile of up to 32 quads (of four vertices). Each component of u is a chain of fused multiply-adds over
//! the modes in ascending order. U is stored in chunks of one to four modes (`crate::storage`).

use super::decode::{self, Columns};
#[cfg(target_arch = "x86_64")]
use super::fused;
use crate::storage::{PackedWord, TILE_QUADS, TileLayout, TiledModes};
use modalcast_model::domain::MAX_RANK;
use modalcast_model::scene::StorageType;

/// Three numbers per vertex of a tile, `[axis][vertex]`. A quad has 12 numbers.
pub(super) type TileVertices = [f32; 12 * TILE_QUADS];

/// Working memory of a tile's sums, small enough for the L1 cache.
#[derive(Debug)]
pub(super) struct Scratch {
    pub(super) sums: TileVertices,
    /// Accumulated rounding errors; only for compensated sums.
    compensation: TileVertices,
    /// Decoded entries of the modes that are added together.
    columns: Columns,
    /// q times the factors or scales of the modes.
    scaled_q: [f32; MAX_RANK],
}

impl Scratch {
    pub(super) const fn new() -> Self {
        let zeros = [0.0; 12 * TILE_QUADS];
        Self { sums: zeros, compensation: zeros, columns: [0.0; 48 * TILE_QUADS], scaled_q: [0.0; MAX_RANK] }
    }
}

/// Writes u to the sums. With `COMPENSATED`, it also accumulates the rounding errors: algorithm Dot2 of Ogita, Rump and
/// Oishi, "Accurate sum and dot product", 2005, with a fused multiply-add. The result is then as accurate as a sum in
/// twice the precision.
#[inline(always)]
pub(super) fn sum_modes<const COMPENSATED: bool>(
    tiled_modes: &TiledModes,
    tile: &TileLayout,
    q: &[f32],
    scratch: &mut Scratch,
) {
    #[cfg(target_arch = "x86_64")]
    if let (false, Some(simd)) = (COMPENSATED, pulp::x86::V3::try_new()) {
        return sum_fused(simd, tiled_modes, tile, q, scratch);
    }
    sum_columns::<COMPENSATED>(tiled_modes, tile, q, scratch);
}

/// Decodes entries to columns in scratch memory, then adds the columns.
#[inline(always)]
fn sum_columns<const COMPENSATED: bool>(tiled_modes: &TiledModes, tile: &TileLayout, q: &[f32], scratch: &mut Scratch) {
    let Scratch { sums, compensation, columns, scaled_q } = scratch;
    let length = 12 * tile.quads;
    scale_coordinates(tiled_modes, tile, q, scaled_q);
    let sums = &mut sums[..length];
    let compensation = &mut compensation[..if COMPENSATED { length } else { 0 }];
    sums.fill(0.0);
    compensation.fill(0.0);
    let mut accumulator = Sums::<COMPENSATED> { sums, compensation };
    let chunks = TileChunks::of(tiled_modes, tile, scaled_q);
    match tiled_modes.storage() {
        StorageType::F32 => accumulator.add_f32(chunks),
        StorageType::F16 => accumulator.add_packed16(chunks, columns, decode::unpack_f16),
        StorageType::Bf16 => accumulator.add_packed16(chunks, columns, decode::unpack_bf16),
        StorageType::Int8 => accumulator.add_int8(chunks, columns),
    }
    if COMPENSATED {
        for (sum, compensation) in accumulator.sums.iter_mut().zip(accumulator.compensation) {
            *sum += *compensation;
        }
    }
}

/// Decodes entries in vector registers, without columns in memory ([`fused`]).
#[cfg(target_arch = "x86_64")]
#[inline(always)]
fn sum_fused(simd: pulp::x86::V3, tiled_modes: &TiledModes, tile: &TileLayout, q: &[f32], scratch: &mut Scratch) {
    let Scratch { sums, scaled_q, .. } = scratch;
    scale_coordinates(tiled_modes, tile, q, scaled_q);
    let sums = &mut sums[..12 * tile.quads];
    sums.fill(0.0);
    let chunks = TileChunks::of(tiled_modes, tile, scaled_q);
    match tiled_modes.storage() {
        StorageType::F32 => Sums::<false> { sums, compensation: &mut [] }.add_f32(chunks),
        StorageType::F16 => chunks.fuse_packed16::<fused::DecodeF16>(simd, sums),
        StorageType::Bf16 => chunks.fuse_packed16::<fused::DecodeBf16>(simd, sums),
        StorageType::Int8 => chunks.fuse_int8(simd, sums),
    }
}

/// Multiplies q by the factors or scales of the stored entries; each product is rounded once.
#[inline(always)]
fn scale_coordinates(tiled_modes: &TiledModes, tile: &TileLayout, q: &[f32], scaled_q: &mut [f32; MAX_RANK]) {
    let rank = q.len();
    let factors = match tiled_modes.storage() {
        StorageType::F32 => &[][..],
        StorageType::F16 | StorageType::Bf16 => tiled_modes.factors(),
        StorageType::Int8 => &tiled_modes.scales()[tile.first_scale..][..rank],
    };
    scaled_q[..rank].copy_from_slice(q);
    scaled_q[..rank].iter_mut().zip(factors).for_each(|(coordinate, factor)| *coordinate *= factor);
    // The last chunk may have up to three padding modes.
    scaled_q[rank..MAX_RANK.min(rank + 3)].fill(0.0);
}

/// The chunks of a tile.
#[derive(Clone, Copy)]
struct TileChunks<'a> {
    packed_words: &'a [PackedWord],
    quads: usize,
    /// Number of chunks.
    count: usize,
    scaled_q: &'a [f32; MAX_RANK],
}

impl<'a> TileChunks<'a> {
    #[inline(always)]
    fn of(tiled_modes: &'a TiledModes, tile: &TileLayout, scaled_q: &'a [f32; MAX_RANK]) -> Self {
        let (quads, count) = (tile.quads, tiled_modes.chunks());
        let packed_words = &tiled_modes.packed_words()[tile.first_packed_word..][..3 * count * quads];
        Self { packed_words, quads, count, scaled_q }
    }

    /// The three planes of a chunk.
    #[inline(always)]
    fn chunk(&self, chunk: usize) -> &'a [PackedWord] {
        &self.packed_words[3 * self.quads * chunk..][..3 * self.quads]
    }

    /// The scaled coordinates of a chunk of K modes.
    #[inline(always)]
    fn scaled_q<const K: usize>(&self, chunk: usize) -> [f32; K] {
        std::array::from_fn(|mode| self.scaled_q[K * chunk + mode])
    }
}

#[cfg(target_arch = "x86_64")]
impl TileChunks<'_> {
    /// Adds the chunks of a 16-bit type, two at a time. The arguments of `add_chunks` are the decoder, 2 groups per
    /// packed word, 2 modes per chunk, and the number of chunks.
    #[inline(always)]
    fn fuse_packed16<D: fused::Decode<2>>(&self, simd: pulp::x86::V3, sums: &mut [f32]) {
        let with_scaled_q = |chunk: usize| (self.chunk(chunk), self.scaled_q(chunk));
        let mut first = 0;
        while first + 2 <= self.count {
            fused::add_chunks::<D, 2, 2, 2>(simd, [with_scaled_q(first), with_scaled_q(first + 1)], sums);
            first += 2;
        }
        if first < self.count {
            fused::add_chunks::<D, 2, 2, 1>(simd, [with_scaled_q(first)], sums);
        }
    }

    /// Adds the chunks of `Int8`, one at a time. A packed word has 4 groups, and a chunk has 4 modes.
    #[inline(always)]
    fn fuse_int8(&self, simd: pulp::x86::V3, sums: &mut [f32]) {
        for chunk in 0..self.count {
            fused::add_chunks::<fused::DecodeInt8, 4, 4, 1>(simd, [(self.chunk(chunk), self.scaled_q(chunk))], sums);
        }
    }
}

/// The sums of a tile, `[axis][vertex]`, and their accumulated rounding errors.
struct Sums<'a, const COMPENSATED: bool> {
    sums: &'a mut [f32],
    compensation: &'a mut [f32],
}

impl<const COMPENSATED: bool> Sums<'_, COMPENSATED> {
    /// Adds four modes at a time, which needs a quarter of the loads and stores of the sums. The order of the additions
    /// does not change.
    #[inline(always)]
    fn add_f32(&mut self, tile_chunks: TileChunks) {
        let column = |mode: usize| bytemuck::cast_slice(tile_chunks.chunk(mode));
        let mut first = 0;
        while first + 4 <= tile_chunks.count {
            let modes = [first, first + 1, first + 2, first + 3];
            self.add(modes.map(column), modes.map(|mode| tile_chunks.scaled_q[mode]));
            first += 4;
        }
        for mode in first..tile_chunks.count {
            self.add([column(mode)], tile_chunks.scaled_q(mode));
        }
    }

    #[inline(always)]
    fn add_packed16(
        &mut self,
        tile_chunks: TileChunks,
        columns: &mut Columns,
        decode: impl Fn(&[PackedWord], &mut [f32]),
    ) {
        let length = self.sums.len();
        let mut first = 0;
        while first + 2 <= tile_chunks.count {
            let ([a, b], [c, d]) = (tile_chunks.scaled_q(first), tile_chunks.scaled_q(first + 1));
            decode(tile_chunks.chunk(first), &mut columns[..2 * length]);
            decode(tile_chunks.chunk(first + 1), &mut columns[2 * length..4 * length]);
            self.add(split_columns(columns, length), [a, b, c, d]);
            first += 2;
        }
        if first < tile_chunks.count {
            decode(tile_chunks.chunk(first), &mut columns[..2 * length]);
            self.add::<2>(split_columns(columns, length), tile_chunks.scaled_q(first));
        }
    }

    #[inline(always)]
    fn add_int8(&mut self, tile_chunks: TileChunks, columns: &mut Columns) {
        let length = self.sums.len();
        for chunk in 0..tile_chunks.count {
            decode::unpack_int8(tile_chunks.chunk(chunk), &mut columns[..4 * length]);
            self.add::<4>(split_columns(columns, length), tile_chunks.scaled_q(chunk));
        }
    }

    /// Adds N columns, each multiplied by its scaled coordinate.
    #[expect(clippy::needless_range_loop, reason = "one index for all columns leaves no check inside the loop")]
    #[inline(always)]
    fn add<const N: usize>(&mut self, columns: [&[f32]; N], scaled_q: [f32; N]) {
        let length = self.sums.len();
        let columns = columns.map(|column| &column[..length]);
        if COMPENSATED {
            let compensation = &mut self.compensation[..length];
            for index in 0..length {
                let mut pair = (self.sums[index], compensation[index]);
                for mode in 0..N {
                    pair = add_exactly(pair, columns[mode][index], scaled_q[mode]);
                }
                (self.sums[index], compensation[index]) = pair;
            }
        } else {
            for index in 0..length {
                let mut sum = self.sums[index];
                for mode in 0..N {
                    sum = columns[mode][index].mul_add(scaled_q[mode], sum);
                }
                self.sums[index] = sum;
            }
        }
    }
}

/// Adds a product to a compensated sum. Returns the new sum and the new accumulated rounding error. A fused
/// multiply-add gives the exact rounding error of the product (TwoProduct), and Knuth's TwoSum gives that of the
/// addition.
#[inline(always)]
fn add_exactly((sum, compensation): (f32, f32), entry: f32, coordinate: f32) -> (f32, f32) {
    let product = entry * coordinate;
    let product_error = entry.mul_add(coordinate, -product);
    let new_sum = sum + product;
    let rounded_product = new_sum - sum;
    let sum_error = (sum - (new_sum - rounded_product)) + (product - rounded_product);
    (new_sum, compensation + (product_error + sum_error))
}

/// The first N decoded columns, each of `length` numbers.
#[inline(always)]
fn split_columns<const N: usize>(columns: &Columns, length: usize) -> [&[f32]; N] {
    std::array::from_fn(|mode| &columns[mode * length..][..length])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{TestRng, shape_with_columns};
    use modalcast_model::domain::Shape;

    /// The expected sums of one tile of f32, `[axis][vertex]`, by plain loops.
    fn sum_tile(shape: &Shape, tile: &TileLayout, q: &[f32]) -> Vec<f32> {
        let expected_sum = |vertex: usize, axis: usize| {
            (0..q.len()).fold(0.0_f32, |sum, mode| shape.modes.entry(vertex, axis, mode).mul_add(q[mode], sum))
        };
        let tile_vertices = || tile.first_vertex..tile.first_vertex + tile.vertices;
        (0..3).flat_map(|axis| tile_vertices().map(move |vertex| expected_sum(vertex, axis))).collect()
    }

    #[test]
    fn fused_sums_column_sums_and_plain_sums_are_bit_identical() {
        let mut rng = TestRng(1);
        for (vertices, rank) in [(128, 32), (4, 1), (12, 5), (128, 7), (140, 33), (52, 512)] {
            // Every fifth entry is subnormal in f16.
            let entry = |index: usize, value: f32| if index.is_multiple_of(5) { value * 1e-8 } else { value };
            let columns = (0..3 * vertices * rank).map(|index| entry(index, rng.next())).collect();
            let shape = shape_with_columns(vertices, rank, columns, &mut rng);
            for storage in StorageType::ALL {
                let tiled_modes = TiledModes::new(&shape, storage);
                let q: Vec<f32> = (0..rank).map(|_| rng.next()).collect();
                for tile_index in 0..tiled_modes.count() {
                    let tile = tiled_modes.tile(tile_index);
                    let (mut fused, mut columns) = (Scratch::new(), Scratch::new());
                    crate::cpu::simd::run_vectorized(|| {
                        sum_modes::<false>(&tiled_modes, &tile, &q, &mut fused);
                    });
                    sum_columns::<false>(&tiled_modes, &tile, &q, &mut columns);
                    let bits = |sums: &[f32]| sums.iter().map(|sum| sum.to_bits()).collect::<Vec<_>>();
                    assert_eq!(bits(&fused.sums), bits(&columns.sums), "{storage:?} {vertices} x {rank}");
                    // Only f32 stores exact entries. In a tile without padding, sums have the order of `sum_tile`.
                    if storage == StorageType::F32 && tile.vertices == 4 * tile.quads {
                        let expected = sum_tile(&shape, &tile, &q);
                        assert_eq!(bits(&fused.sums[..expected.len()]), bits(&expected), "{vertices} x {rank}");
                    }
                }
            }
        }
    }
}
