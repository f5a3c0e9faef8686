//! The tiles of one shape, and the decoded values of their entries. The documentation of the parent module describes
//! the layout.

use std::ops::Range;

use half::{bf16, f16};

use super::{QUAD, TILE_QUADS, modes_per_chunk, quantize};
use modalcast_model::domain::Shape;
use modalcast_model::scene::StorageType;

/// The 16 bytes of one quad and chunk in one plane. A lane of a warp loads them at once.
#[repr(C, align(16))]
#[derive(Debug, Clone, Copy, PartialEq, Eq, bytemuck::Pod, bytemuck::Zeroable)]
pub struct PackedWord(pub [u8; 16]);

/// Offsets and sizes of one tile. C is the number of chunks of the shape, K the number of modes per chunk, W the number
/// of quads of the tile.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TileLayout {
    /// Index of the first quad in the shape.
    pub first_quad: usize,
    /// W, the number of quads.
    pub quads: usize,
    /// Index of the first vertex in the shape.
    pub first_vertex: usize,
    /// Number of vertices without padding.
    pub vertices: usize,
    /// Index of the first of the tile's `3 C W` packed words.
    pub first_packed_word: usize,
    /// Index of the first of the tile's `C K` scales, if the storage has scales.
    pub first_scale: usize,
}

/// U and x0 of one shape in tiles.
#[derive(Debug, Clone, PartialEq)]
pub struct TiledModes {
    storage: StorageType,
    vertices: usize,
    rank: usize,
    packed_words: Vec<PackedWord>,
    scales: Vec<f32>,
    factors: Vec<f32>,
    /// As returned by [`Self::rest`].
    rest: Vec<[f32; 12]>,
}

impl TiledModes {
    /// Rounds a shape's U to the storage type.
    ///
    /// Before the rounding, `F16` and `Bf16` divide each mode by a power of two (its factor), so that the largest entry
    /// of the mode lies in [2^14, 2^15) for `F16` and in [1, 2) for `Bf16`. `Int8` divides each mode of each tile by a
    /// scale, which is 1/127 of the largest entry of this mode in the tile, rounded up.
    pub fn new(shape: &Shape, storage: StorageType) -> Self {
        let rest = shape.mesh.rest_positions();
        let rank = shape.modes.rank();
        let mut tiles = Self {
            storage,
            vertices: rest.len(),
            rank,
            packed_words: Vec::new(),
            scales: Vec::new(),
            factors: quantize::factors(&shape.modes, storage),
            rest: rest.chunks(QUAD).map(quantize::rest_quad).collect(),
        };
        tiles.packed_words = bytemuck::zeroed_vec(3 * tiles.chunks() * tiles.quads());
        if rank == 0 {
            return tiles;
        }
        let tile_layouts: Vec<TileLayout> = (0..tiles.count()).map(|tile| tiles.tile(tile)).collect();
        if storage == StorageType::Int8 {
            tiles.scales = vec![0.0; tiles.count() * tiles.chunks() * modes_per_chunk(storage)];
            quantize::encode_int8(&shape.modes, &tile_layouts, &mut tiles.packed_words, &mut tiles.scales);
        } else {
            quantize::encode_floats(&shape.modes, &tile_layouts, storage, &tiles.factors, &mut tiles.packed_words);
        }
        tiles
    }

    /// The storage type of the entries.
    pub const fn storage(&self) -> StorageType {
        self.storage
    }

    /// n, the number of vertices.
    pub const fn vertices(&self) -> usize {
        self.vertices
    }

    /// r, the number of modes.
    pub const fn rank(&self) -> usize {
        self.rank
    }

    /// Q, a quarter of n rounded up: the number of quads.
    pub const fn quads(&self) -> usize {
        self.vertices.div_ceil(QUAD)
    }

    /// C, the number of chunks of modes; 0 without modes.
    pub const fn chunks(&self) -> usize {
        self.rank.div_ceil(modes_per_chunk(self.storage))
    }

    /// Number of tiles.
    pub const fn count(&self) -> usize {
        self.quads().div_ceil(TILE_QUADS)
    }

    /// Offsets and sizes of tile `tile`.
    #[inline]
    pub fn tile(&self, tile: usize) -> TileLayout {
        let first_quad = TILE_QUADS * tile;
        let quads = TILE_QUADS.min(self.quads() - first_quad);
        let first_vertex = QUAD * first_quad;
        TileLayout {
            first_quad,
            quads,
            first_vertex,
            vertices: (QUAD * quads).min(self.vertices - first_vertex),
            first_packed_word: 3 * self.chunks() * first_quad,
            first_scale: tile * self.chunks() * modes_per_chunk(self.storage),
        }
    }

    /// The packed words of all tiles without gaps: `3 C Q` words.
    pub fn packed_words(&self) -> &[PackedWord] {
        &self.packed_words
    }

    /// The packed words as `48 C Q` bytes, for the upload to a device.
    pub fn bytes(&self) -> &[u8] {
        bytemuck::cast_slice(&self.packed_words)
    }

    /// The range of tile `tile` in [`Self::bytes`].
    pub fn byte_range(&self, tile: usize) -> Range<usize> {
        let layout = self.tile(tile);
        let first = 16 * layout.first_packed_word;
        first..first + 48 * self.chunks() * layout.quads
    }

    /// With `Int8`, the difference between values of consecutive codes per tile and mode, `[tile][C K]`; zero for
    /// padding modes. Empty for other storage types.
    pub fn scales(&self) -> &[f32] {
        &self.scales
    }

    /// With `F16` and `Bf16`, the power of two per mode by which decoding multiplies its stored entries. Empty for
    /// other storage types.
    pub fn factors(&self) -> &[f32] {
        &self.factors
    }

    /// x0 per quad, with the coordinate of an axis and a vertex of the quad at the index `4 axis + vertex`.
    pub fn rest(&self) -> &[[f32; 12]] {
        &self.rest
    }

    /// The stored entry of vertex `vertex`, axis `axis` and mode `mode`, times its factor or scale. Exact in f64.
    #[inline]
    pub fn decode_entry(&self, vertex: usize, axis: usize, mode: usize) -> f64 {
        let chunk_modes = modes_per_chunk(self.storage);
        let (quad, tile) = (vertex / QUAD, vertex / QUAD / TILE_QUADS);
        let layout = self.tile(tile);
        let entry = (mode % chunk_modes * 3 + axis) * QUAD + vertex % QUAD;
        let entry_bytes = 4 / chunk_modes;
        let (plane, byte) = (entry * entry_bytes / 16, entry * entry_bytes % 16);
        let word =
            layout.first_packed_word + (mode / chunk_modes * 3 + plane) * layout.quads + quad - layout.first_quad;
        let bytes = &self.packed_words[word].0[byte..byte + entry_bytes];
        match self.storage {
            StorageType::F32 => f64::from(bytemuck::pod_read_unaligned::<f32>(bytes)),
            StorageType::F16 => f16::from_ne_bytes([bytes[0], bytes[1]]).to_f64() * f64::from(self.factors[mode]),
            StorageType::Bf16 => bf16::from_ne_bytes([bytes[0], bytes[1]]).to_f64() * f64::from(self.factors[mode]),
            StorageType::Int8 => (f64::from(bytes[0]) - 128.0) * f64::from(self.scales[layout.first_scale + mode]),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{TestRng, shape};

    /// (vertices, rank) of the tested shapes.
    const SIZES: [(usize, usize); 12] = [
        (1, 1),
        (1, 0),
        (3, 5),
        (4, 3),
        (7, 2),
        (127, 4),
        (128, 31),
        (129, 33),
        (255, 7),
        (300, 8),
        (1500, 6),
        (9, 512),
    ];

    /// Half the spacing of decoded values near an entry.
    fn half_step(tiles: &TiledModes, tile: TileLayout, mode: usize, entry: f64) -> f64 {
        let exponent = |value: f64| value.abs().log2().floor();
        match tiles.storage() {
            StorageType::F32 => 0.0,
            StorageType::F16 => {
                let factor = f64::from(tiles.factors()[mode]);
                f64::exp2((exponent(entry / factor) - 11.0).max(-25.0)) * factor
            }
            StorageType::Bf16 => f64::exp2(exponent(entry) - 8.0),
            StorageType::Int8 => f64::from(tiles.scales()[tile.first_scale + mode]) * 0.5 * (1.0 + 1e-12),
        }
    }

    #[test]
    fn entries_are_rounded_to_the_nearest_stored_value() {
        let mut rng = TestRng(1);
        for (vertices, rank) in SIZES {
            let shape = shape(vertices, rank, &mut rng);
            for storage in StorageType::ALL {
                let tiles = TiledModes::new(&shape, storage);
                for vertex in 0..vertices {
                    let tile = tiles.tile(vertex / QUAD / TILE_QUADS);
                    for (axis, mode) in (0..3).flat_map(|axis| (0..rank).map(move |mode| (axis, mode))) {
                        let entry = f64::from(shape.modes.entry(vertex, axis, mode));
                        let error = (tiles.decode_entry(vertex, axis, mode) - entry).abs();
                        let max_error = half_step(&tiles, tile, mode, entry);
                        assert!(
                            error <= max_error,
                            "{storage:?}, {vertices} x {rank}, entry {entry}: expected at most {max_error}, got {error}"
                        );
                    }
                }
            }
        }
    }

    #[test]
    fn tiles_have_no_gaps_and_padding_is_zero() {
        let mut rng = TestRng(2);
        for (vertices, rank) in SIZES {
            let shape = shape(vertices, rank, &mut rng);
            for storage in StorageType::ALL {
                let tiles = TiledModes::new(&shape, storage);
                assert_eq!(tiles.bytes().len(), 48 * tiles.chunks() * tiles.quads());
                let end = (0..tiles.count()).fold((0, 0, 0), |(byte, quad, vertex), tile| {
                    let layout = tiles.tile(tile);
                    let range = tiles.byte_range(tile);
                    assert_eq!((range.start, layout.first_quad, layout.first_vertex), (byte, quad, vertex));
                    (range.end, quad + layout.quads, vertex + layout.vertices)
                });
                assert_eq!(end, (tiles.bytes().len(), tiles.quads(), vertices));
                let padded_rank = tiles.chunks() * modes_per_chunk(storage);
                for vertex in vertices..QUAD * tiles.quads() {
                    for (axis, mode) in (0..3).flat_map(|axis| (0..rank).map(move |mode| (axis, mode))) {
                        assert_eq!(tiles.decode_entry(vertex, axis, mode), 0.0);
                    }
                }
                if storage == StorageType::Int8 && padded_rank > rank {
                    let layout = tiles.tile(0);
                    assert!(tiles.scales()[rank..padded_rank].iter().all(|scale| *scale == 0.0));
                    // The last byte of the last chunk is vertex 3, axis 2 of a padding mode.
                    assert_eq!(
                        tiles.packed_words()[layout.first_packed_word + (3 * tiles.chunks() - 1) * layout.quads].0[15],
                        128
                    );
                }
            }
        }
    }

    #[test]
    fn entries_have_the_documented_byte_offsets() {
        let shape = shape(9, 5, &mut TestRng(3));
        let tiles = TiledModes::new(&shape, StorageType::F32);
        let float =
            |offset: usize| f32::from_ne_bytes(tiles.bytes()[offset..offset + 4].try_into().expect("four bytes"));
        // The entry of vertex 6, axis 1 and mode 2. Nine vertices are three quads; vertex 6 is vertex 2 of quad 1. In
        // f32, a chunk is one mode and a plane is one axis. The entry is in word (2 * 3 planes + 1) * 3 quads + 1 of 16
        // bytes, behind two entries of 4 bytes.
        assert_eq!(float(((2 * 3 + 1) * 3 + 1) * 16 + 2 * 4), shape.modes.entry(6, 1, 2));
        assert_eq!(tiles.rest()[1][4 + 2], shape.mesh.rest_positions()[6][1]);
        assert_eq!(tiles.rest()[2][1], 0.0, "expected padding after vertex 8, the only vertex of quad 2");
        let tiles = TiledModes::new(&shape, StorageType::Int8);
        // Mode 2 and axis 1 are group 2 * 3 + 1 = 7 of 4 bytes in chunk 0: plane 1, bytes 12 to 15. The word has the
        // index plane * 3 + quad.
        let code = tiles.packed_words()[3 + 1].0[12 + 2];
        let expected = (shape.modes.entry(6, 1, 2) / tiles.scales()[2]).round() + 128.0;
        assert_eq!(f32::from(code), expected);
        let tiles = TiledModes::new(&shape, StorageType::F16);
        // Mode 3 is the second mode of chunk 1, and its axis 1 is group 3 + 1 = 4 of 8 bytes: plane 2, bytes 0 to 7. A
        // chunk has 9 words.
        let bytes = &tiles.packed_words()[9 + 2 * 3 + 1].0[4..6];
        let stored = f16::from_ne_bytes([bytes[0], bytes[1]]).to_f32();
        assert_eq!(f16::from_f32(shape.modes.entry(6, 1, 3) / tiles.factors()[3]).to_f32(), stored);
    }
}
