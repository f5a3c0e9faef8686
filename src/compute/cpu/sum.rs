//! u = U q of one tile: per vertex coordinate, a chain of fused multiply-adds over the modes in ascending order.

use super::decode::{self, Columns};
#[cfg(target_arch = "x86_64")]
use super::fused;
use crate::storage::{PackedWord, TILE_QUADS, TileLayout, TiledModes};
use modalcast_model::domain::MAX_RANK;
use modalcast_model::scene::StorageType;

/// Coordinates of a tile's vertices, `[axis][vertex]`.
pub(super) type TileVertices = [f32; 12 * TILE_QUADS];

/// Working memory of a tile's sums, small enough for the L1 cache.
#[derive(Debug)]
pub(super) struct Scratch {
    pub(super) sums: TileVertices,
    /// Accumulated rounding errors; only for compensated sums.
    compensation: TileVertices,
    columns: Columns,
    amounts: [f32; MAX_RANK],
}

impl Scratch {
    pub(super) const fn new() -> Self {
        let zeros = [0.0; 12 * TILE_QUADS];
        Self { sums: zeros, compensation: zeros, columns: [0.0; 48 * TILE_QUADS], amounts: [0.0; MAX_RANK] }
    }
}

/// The modes of a domain to sum.
#[derive(Debug, Clone, Copy)]
pub(super) struct ModeSelection<'a> {
    /// Coordinates, zero for truncated modes.
    pub(super) q: &'a [f32],
    /// Chunks with at least one kept mode, ascending.
    pub(super) chunks: &'a [u16],
}

/// Writes u to the sums. `COMPENSATED` also accumulates the rounding errors (Ogita, Rump, Oishi, Accurate Sum and Dot
/// Product, 2005, algorithm Dot2 with a fused multiply-add): as if summed in twice the precision, then rounded.
#[inline(always)]
pub(super) fn sum<const COMPENSATED: bool>(
    tiles: &TiledModes,
    tile: &TileLayout,
    mode_selection: ModeSelection,
    scratch: &mut Scratch,
) {
    #[cfg(target_arch = "x86_64")]
    if let (false, Some(simd)) = (COMPENSATED, pulp::x86::V3::try_new()) {
        return sum_fused(simd, tiles, tile, mode_selection, scratch);
    }
    sum_columns::<COMPENSATED>(tiles, tile, mode_selection, scratch);
}

#[inline(always)]
fn sum_columns<const COMPENSATED: bool>(
    tiles: &TiledModes,
    tile: &TileLayout,
    mode_selection: ModeSelection,
    scratch: &mut Scratch,
) {
    let Scratch { sums, compensation, columns, amounts } = scratch;
    let length = 12 * tile.quads;
    scale_coordinates(tiles, tile, mode_selection.q, amounts);
    let sums = &mut sums[..length];
    let compensation = &mut compensation[..if COMPENSATED { length } else { 0 }];
    sums.fill(0.0);
    compensation.fill(0.0);
    let mut target = Sums::<COMPENSATED> { sums, compensation };
    let parts = TileChunks::of(tiles, tile, mode_selection, amounts);
    match tiles.storage() {
        StorageType::F32 => target.add_f32(parts),
        StorageType::F16 => target.add_packed16(parts, columns, decode::unpack_f16),
        StorageType::Bf16 => target.add_packed16(parts, columns, decode::unpack_bf16),
        StorageType::Int8 => target.add_int8(parts, columns),
    }
    if COMPENSATED {
        for (sum, compensation) in target.sums.iter_mut().zip(target.compensation) {
            *sum += *compensation;
        }
    }
}

#[cfg(target_arch = "x86_64")]
#[inline(always)]
fn sum_fused(
    simd: pulp::x86::V3,
    tiles: &TiledModes,
    tile: &TileLayout,
    mode_selection: ModeSelection,
    scratch: &mut Scratch,
) {
    let Scratch { sums, amounts, .. } = scratch;
    scale_coordinates(tiles, tile, mode_selection.q, amounts);
    let sums = &mut sums[..12 * tile.quads];
    sums.fill(0.0);
    let parts = TileChunks::of(tiles, tile, mode_selection, amounts);
    match tiles.storage() {
        StorageType::F32 => Sums::<false> { sums, compensation: &mut [] }.add_f32(parts),
        StorageType::F16 => parts.fuse_packed16::<fused::DecodeF16>(simd, sums),
        StorageType::Bf16 => parts.fuse_packed16::<fused::DecodeBf16>(simd, sums),
        StorageType::Int8 => parts.fuse_int8(simd, sums),
    }
}

/// Multiplies q by the factors or scales of the stored entries, rounded once.
#[inline(always)]
fn scale_coordinates(tiles: &TiledModes, tile: &TileLayout, q: &[f32], amounts: &mut [f32; MAX_RANK]) {
    let rank = q.len();
    let factors = match tiles.storage() {
        StorageType::F32 => &[][..],
        StorageType::F16 | StorageType::Bf16 => tiles.factors(),
        StorageType::Int8 => &tiles.scales()[tile.first_scale..][..rank],
    };
    amounts[..rank].copy_from_slice(q);
    amounts[..rank].iter_mut().zip(factors).for_each(|(amount, factor)| *amount *= factor);
    // Padding modes of the last chunk.
    amounts[rank..MAX_RANK.min(rank + 3)].fill(0.0);
}

/// A tile's chunks and their amounts.
#[derive(Clone, Copy)]
struct TileChunks<'a> {
    packed_words: &'a [PackedWord],
    quads: usize,
    chunks: &'a [u16],
    amounts: &'a [f32; MAX_RANK],
}

impl<'a> TileChunks<'a> {
    #[inline(always)]
    fn of(
        tiles: &'a TiledModes,
        tile: &TileLayout,
        mode_selection: ModeSelection<'a>,
        amounts: &'a [f32; MAX_RANK],
    ) -> Self {
        let packed_words = &tiles.packed_words()[tile.first_packed_word..][..3 * tiles.chunks() * tile.quads];
        Self { packed_words, quads: tile.quads, chunks: mode_selection.chunks, amounts }
    }

    #[inline(always)]
    fn chunk(&self, chunk: u16) -> &'a [PackedWord] {
        &self.packed_words[3 * self.quads * usize::from(chunk)..][..3 * self.quads]
    }

    /// The amounts of a chunk of K modes.
    #[inline(always)]
    fn amounts<const K: usize>(&self, chunk: u16) -> [f32; K] {
        std::array::from_fn(|mode| self.amounts[K * usize::from(chunk) + mode])
    }
}

#[cfg(target_arch = "x86_64")]
impl TileChunks<'_> {
    #[inline(always)]
    fn fuse_packed16<D: fused::Decode<2>>(&self, simd: pulp::x86::V3, sums: &mut [f32]) {
        let part = |chunk: u16| (self.chunk(chunk), self.amounts(chunk));
        let mut pairs = self.chunks.chunks_exact(2);
        for pair in pairs.by_ref() {
            fused::add::<D, 2, 2, 2>(simd, [part(pair[0]), part(pair[1])], sums);
        }
        for chunk in pairs.remainder() {
            fused::add::<D, 2, 2, 1>(simd, [part(*chunk)], sums);
        }
    }

    #[inline(always)]
    fn fuse_int8(&self, simd: pulp::x86::V3, sums: &mut [f32]) {
        for chunk in self.chunks {
            fused::add::<fused::DecodeInt8, 4, 4, 1>(simd, [(self.chunk(*chunk), self.amounts(*chunk))], sums);
        }
    }
}

struct Sums<'a, const COMPENSATED: bool> {
    sums: &'a mut [f32],
    compensation: &'a mut [f32],
}

impl<const COMPENSATED: bool> Sums<'_, COMPENSATED> {
    // Four modes at a time quarter the loads and stores of the sums; the modes are still added in order.
    #[inline(always)]
    fn add_f32(&mut self, parts: TileChunks) {
        let column = |chunk: u16| bytemuck::cast_slice(parts.chunk(chunk));
        let mut fours = parts.chunks.chunks_exact(4);
        for four in fours.by_ref() {
            let chunks = [four[0], four[1], four[2], four[3]];
            self.add(chunks.map(column), chunks.map(|chunk| parts.amounts[usize::from(chunk)]));
        }
        for chunk in fours.remainder() {
            self.add([column(*chunk)], parts.amounts(*chunk));
        }
    }

    #[inline(always)]
    fn add_packed16(&mut self, parts: TileChunks, columns: &mut Columns, decode: impl Fn(&[PackedWord], &mut [f32])) {
        let length = self.sums.len();
        let mut pairs = parts.chunks.chunks_exact(2);
        for pair in pairs.by_ref() {
            let ([a, b], [c, d]) = (parts.amounts(pair[0]), parts.amounts(pair[1]));
            decode(parts.chunk(pair[0]), &mut columns[..2 * length]);
            decode(parts.chunk(pair[1]), &mut columns[2 * length..4 * length]);
            self.add(split(columns, length), [a, b, c, d]);
        }
        for chunk in pairs.remainder() {
            decode(parts.chunk(*chunk), &mut columns[..2 * length]);
            self.add::<2>(split(columns, length), parts.amounts(*chunk));
        }
    }

    #[inline(always)]
    fn add_int8(&mut self, parts: TileChunks, columns: &mut Columns) {
        let length = self.sums.len();
        for chunk in parts.chunks {
            decode::unpack_int8(parts.chunk(*chunk), &mut columns[..4 * length]);
            self.add::<4>(split(columns, length), parts.amounts(*chunk));
        }
    }

    #[expect(clippy::needless_range_loop, reason = "one index for all columns leaves no check inside the loop")]
    #[inline(always)]
    fn add<const N: usize>(&mut self, columns: [&[f32]; N], amounts: [f32; N]) {
        let length = self.sums.len();
        let columns = columns.map(|column| &column[..length]);
        if COMPENSATED {
            let compensation = &mut self.compensation[..length];
            for at in 0..length {
                let mut pair = (self.sums[at], compensation[at]);
                for mode in 0..N {
                    pair = add_exactly(pair, columns[mode][at], amounts[mode]);
                }
                (self.sums[at], compensation[at]) = pair;
            }
        } else {
            for at in 0..length {
                let mut sum = self.sums[at];
                for mode in 0..N {
                    sum = columns[mode][at].mul_add(amounts[mode], sum);
                }
                self.sums[at] = sum;
            }
        }
    }
}

/// The next sum, and the accumulated rounding error: TwoProduct by fused multiply-add, TwoSum of Knuth.
#[inline(always)]
fn add_exactly((sum, compensation): (f32, f32), entry: f32, amount: f32) -> (f32, f32) {
    let product = entry * amount;
    let product_lost = entry.mul_add(amount, -product);
    let next = sum + product;
    let part = next - sum;
    let sum_lost = (sum - (next - part)) + (product - part);
    (next, compensation + (product_lost + sum_lost))
}

/// The first N decoded columns.
#[inline(always)]
fn split<const N: usize>(columns: &Columns, length: usize) -> [&[f32]; N] {
    std::array::from_fn(|mode| &columns[mode * length..][..length])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{TestRng, with_columns};
    use modalcast_model::domain::Shape;

    /// The expected sums of one tile of f32.
    fn plain(shape: &Shape, tile: &TileLayout, q: &[f32]) -> Vec<f32> {
        let chain = |vertex: usize, axis: usize| {
            (0..q.len()).fold(0.0_f32, |sum, mode| shape.modes.entry(vertex, axis, mode).mul_add(q[mode], sum))
        };
        let vertices = || tile.first_vertex..tile.first_vertex + tile.vertices;
        (0..3).flat_map(|axis| vertices().map(move |vertex| chain(vertex, axis))).collect()
    }

    #[test]
    fn vectors_columns_and_plain_chains_agree_bit_by_bit_for_whole_and_chosen_chunks() {
        let mut noise = TestRng(1);
        for (vertices, rank) in [(128, 32), (4, 1), (12, 5), (128, 7), (140, 33), (52, 512)] {
            // Every fifth entry is subnormal in f16.
            let entry = |at: usize, value: f32| if at.is_multiple_of(5) { value * 1e-8 } else { value };
            let columns = (0..3 * vertices * rank).map(|at| entry(at, noise.next())).collect();
            let shape = with_columns(vertices, rank, columns, &mut noise);
            for storage in StorageType::ALL {
                let tiles = TiledModes::new(&shape, storage);
                let mut q: Vec<f32> = (0..rank).map(|_| noise.next()).collect();
                let per_chunk = crate::storage::modes_per_chunk(storage);
                let every: Vec<u16> = (0..tiles.chunks() as u16).collect();
                let odd: Vec<u16> = every.iter().copied().filter(|chunk| chunk % 2 == 0).collect();
                for chunks in [every, odd] {
                    (0..rank)
                        .filter(|mode| !chunks.contains(&((mode / per_chunk) as u16)))
                        .for_each(|mode| q[mode] = 0.0);
                    let mode_selection = ModeSelection { q: &q, chunks: &chunks };
                    for index in 0..tiles.count() {
                        let tile = tiles.tile(index);
                        let (mut fused, mut columns) = (Scratch::new(), Scratch::new());
                        crate::cpu::simd::run_vectorized(|| sum::<false>(&tiles, &tile, mode_selection, &mut fused));
                        sum_columns::<false>(&tiles, &tile, mode_selection, &mut columns);
                        let bits = |sums: &[f32]| sums.iter().map(|sum| sum.to_bits()).collect::<Vec<_>>();
                        assert_eq!(bits(&fused.sums), bits(&columns.sums), "{storage:?} {vertices} x {rank}");
                        if storage == StorageType::F32 && tile.vertices == 4 * tile.quads {
                            let plain = plain(&shape, &tile, &q);
                            assert_eq!(bits(&fused.sums[..plain.len()]), bits(&plain), "{vertices} x {rank}");
                        }
                    }
                }
            }
        }
    }
}
