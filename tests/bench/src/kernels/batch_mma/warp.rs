//! CPU twin (the same algorithm in Rust) of one warp of `kernels/batch_mma.cu`: fragments, staging buffer and stores of
//! all 32 lanes. Sums are f64.
//!
//! A group is 8 domains, the columns of one product. Domain pair p of a group is its domains 2 p and 2 p + 1. The
//! parity of a domain is its index modulo 2.

use super::{
    BatchMmaArgs, STEP_MODES, args_without_addresses, pack_fragments, pack_transforms_and_scales, select_batch_size,
    split_coordinates,
};
use modalcast_compute::storage::{PackedWord, TiledModes};
use modalcast_compute::testing::transformed_axis;
use modalcast_model::scene::{Scene, SceneState, StorageType};

/// Quads (four consecutive vertices each) per warp.
pub(super) const WARP_QUADS: usize = 8;
/// float4 per domain in the staging buffer: three per quad, and two of padding.
const STRIDE: usize = 3 * WARP_QUADS + 2;

/// The kernel's inputs.
pub(super) struct KernelInputs {
    pub tiles: TiledModes,
    pub args: BatchMmaArgs,
    /// q as [`pack_fragments`] packs it.
    fragments: Vec<u32>,
    /// Transforms, then inverse scales.
    transforms_and_scales: Vec<f32>,
    pub batch_size: usize,
}

impl KernelInputs {
    pub(super) fn pack(scene: &Scene, state: &SceneState) -> Self {
        let tiles = TiledModes::new(scene.shape_of(0), scene.deformation.storage);
        let (batch_size, _) = select_batch_size(scene.domains.len());
        let split_q = split_coordinates(scene, state, &tiles);
        Self {
            args: args_without_addresses(scene, tiles.chunks()),
            fragments: pack_fragments(&split_q, tiles.rank(), batch_size),
            transforms_and_scales: pack_transforms_and_scales(state, &split_q, batch_size),
            batch_size,
            tiles,
        }
    }

    /// The 16-bit number in the lower half of `bits`.
    fn decode(&self, bits: u32) -> f64 {
        match self.tiles.storage() {
            StorageType::F16 => half::f16::from_bits(bits as u16).to_f64(),
            _ => half::bf16::from_bits(bits as u16).to_f64(),
        }
    }
}

/// Adds the product of the matrices A (entries of U) and B (coordinates of q) to matrix D, as the PTX instruction
/// `mma.m16n8k16` does. `a`, `b` and `d` hold the fragment of each lane, the part of the matrix in the registers of the
/// lane. The PTX manual defines which lane holds which entries ("Matrix Fragments for mma.m16n8k16"). Lane 4 g + t
/// holds rows g and g + 8 of A and D, column g of B, and columns 2 t and 2 t + 1 of D.
fn multiply(inputs: &KernelInputs, a: &[[u32; 4]; 32], b: &[[u32; 2]; 32], d: &mut [[f64; 4]; 32]) {
    // k is a column of A and a row of B. A register holds two numbers: the number of an even k in the lower half, of
    // the following odd k in the upper half.
    let decode_half = |register: u32, k: usize| inputs.decode(register >> (16 * (k % 2)) & 0xffff);
    // The lane that holds entry (row, k) of A, or entry (k, column) of B. In that lane, register row / 8 + 2 (k / 8)
    // holds the entry of A, and register k / 8 the entry of B.
    let lane_of = |row_or_column: usize, k: usize| 4 * (row_or_column % 8) + k % 8 / 2;
    let entry_of_a = |row: usize, k: usize| decode_half(a[lane_of(row, k)][row / 8 + 2 * (k / 8)], k);
    let entry_of_b = |k: usize, column: usize| decode_half(b[lane_of(column, k)][k / 8], k);
    for (lane, sums) in d.iter_mut().enumerate() {
        for (entry, sum) in sums.iter_mut().enumerate() {
            let (row, column) = (lane / 4 + 8 * (entry / 2), 2 * (lane % 4) + entry % 2);
            *sum += (0..STEP_MODES).map(|k| entry_of_a(row, k) * entry_of_b(k, column)).sum::<f64>();
        }
    }
}

/// The quad of a tile that a lane reads.
#[derive(Clone, Copy)]
struct TileQuad {
    /// Index of the tile's first packed word.
    first_word: usize,
    /// Number of quads of the tile.
    tile_quads: usize,
    /// Index of the quad in the tile.
    quad: usize,
}

/// A chunk (two modes) of one quad as twelve words of 32 bits; zeros beyond the last chunk. The 48 bytes are stored in
/// three planes of 16 bytes.
fn load_chunk(inputs: &KernelInputs, tile_quad: TileQuad, chunk: usize) -> [u32; 12] {
    let mut words = [0; 12];
    if chunk < inputs.args.chunks as usize {
        let plane_word = |plane: usize| -> PackedWord {
            inputs.tiles.packed_words()
                [tile_quad.first_word + (3 * chunk + plane) * tile_quad.tile_quads + tile_quad.quad]
        };
        let bytes: Vec<u8> = (0..3).flat_map(|plane| plane_word(plane).0).collect();
        words = std::array::from_fn(|word| bytemuck::pod_read_unaligned(&bytes[4 * word..4 * word + 4]));
    }
    words
}

/// Accumulators: [2 axis + vertex / 2][group of 8 domains][lane][entry of D]. The first index counts pairs of vertices
/// for each axis, with `vertex` from 0 to 3 in the quad.
pub(super) type AccumulatorFragments = Vec<Vec<[[f64; 4]; 32]>>;

/// The sums over all modes for the quads of one warp.
pub(super) fn sum_modes(inputs: &KernelInputs, tile: usize, warp: usize) -> AccumulatorFragments {
    let tile_quads = inputs.tiles.tile(tile).quads;
    let first_word = inputs.tiles.tile(tile).first_packed_word;
    let group_count = inputs.batch_size / 8;
    let mut sums: AccumulatorFragments = vec![vec![[[0.0; 4]; 32]; group_count]; 6];
    for step in 0..inputs.tiles.rank().div_ceil(STEP_MODES) {
        // A step has 8 chunks of two modes. A lane loads chunks lane % 4 and lane % 4 + 4 of them.
        let chunks: Vec<[[u32; 12]; 2]> = (0..32)
            .map(|lane| {
                let quad = (WARP_QUADS * warp + lane / 4).min(tile_quads - 1);
                let tile_quad = TileQuad { first_word, tile_quads, quad };
                [0, 4].map(|offset| load_chunk(inputs, tile_quad, 8 * step + lane % 4 + offset))
            })
            .collect();
        // Words 0 to 5 of a chunk belong to its first mode, words 6 to 11 to its second mode. Word 2 axis + vertex / 2
        // of a mode holds a pair of vertices. A register of A holds both modes of one vertex.
        for (pair, sums) in sums.iter_mut().enumerate() {
            let first_vertex = |words: &[u32; 12]| words[pair] & 0xffff | words[6 + pair] << 16;
            let second_vertex = |words: &[u32; 12]| words[pair] >> 16 | words[6 + pair] & 0xffff_0000;
            let a: [[u32; 4]; 32] = std::array::from_fn(|lane| {
                let [low, high] = &chunks[lane];
                [first_vertex(low), second_vertex(low), first_vertex(high), second_vertex(high)]
            });
            for (group, sums) in sums.iter_mut().enumerate() {
                let word = |lane: usize, index: usize| {
                    inputs.fragments[4 * (32 * (group_count * step + group) + lane) + index]
                };
                // Words 2 and 3 hold the rounding remainders of q. They are added first, because they are small.
                for first_word in [2, 0] {
                    let b = std::array::from_fn(|lane| [word(lane, first_word), word(lane, first_word + 1)]);
                    multiply(inputs, &a, &b, sums);
                }
            }
        }
    }
    sums
}

/// The staging buffer of one warp after a pass: the positions of four domains. Pass p stages the domains of group p / 2
/// with parity p % 2.
pub(super) fn stage_positions(
    inputs: &KernelInputs,
    sums: &AccumulatorFragments,
    (tile, warp): (usize, usize),
    pass: usize,
) -> Vec<[f32; 4]> {
    let mut staged = vec![[f32::NAN; 4]; 4 * STRIDE];
    let layout = inputs.tiles.tile(tile);
    for (quad, domain_pair) in (0..WARP_QUADS).flat_map(|quad| (0..4).map(move |domain_pair| (quad, domain_pair))) {
        let (lane, parity) = (4 * quad + domain_pair, pass % 2);
        let domain = 8 * (pass / 2) + 2 * domain_pair + parity;
        let rest = inputs.tiles.rest()[layout.first_quad + (WARP_QUADS * warp + quad).min(layout.quads - 1)];
        let rows = &inputs.transforms_and_scales[12 * domain..][..12];
        let inverse_scale = inputs.transforms_and_scales[12 * inputs.batch_size + domain];
        let world: Vec<f32> = (0..4)
            .flat_map(|vertex| {
                let deformed = [0, 1, 2].map(|axis| {
                    // In D, the row selects the vertex of the pair, and the column the domain of the domain pair.
                    let sum = sums[2 * axis + vertex / 2][pass / 2][lane][2 * (vertex % 2) + parity] as f32;
                    rest[4 * axis + vertex] + sum * inverse_scale
                });
                [0, 1, 2].map(|row| transformed_axis(&rows[4 * row..], deformed))
            })
            .collect();
        for (vector, components) in world.chunks_exact(4).enumerate() {
            staged[STRIDE * domain_pair + 3 * quad + vector] =
                [components[0], components[1], components[2], components[3]];
        }
    }
    staged
}

/// The part of the positions that a warp stores in one pass.
#[derive(Clone, Copy)]
pub(super) struct StoreRange {
    /// First vertex of the warp in the shape.
    pub first_vertex: usize,
    /// Coordinates of the warp's vertices: three per vertex.
    pub coordinates: usize,
    pub pass: usize,
}

/// Copies the staged positions of four domains to their packed vertices. Eight lanes store one domain: 24 vectors in
/// three rounds.
pub(super) fn store_staged(inputs: &KernelInputs, staged: &[[f32; 4]], range: StoreRange, positions: &mut [f32]) {
    for (lane, round) in (0..32).flat_map(|lane| (0..3).map(move |round| (lane, round))) {
        let (domain_pair, vector) = (lane / 8, 8 * round + lane % 8);
        let domain = 8 * (range.pass / 2) + 2 * domain_pair + range.pass % 2;
        let is_stored =
            |component: &usize| domain < inputs.args.domains as usize && 4 * vector + component < range.coordinates;
        for component in (0..4).filter(is_stored) {
            let first_vertex = inputs.args.first_vertices[domain] as usize + range.first_vertex;
            let index = 3 * first_vertex + 4 * vector + component;
            assert!(positions[index].is_nan(), "expected one write to coordinate {index}, got two");
            positions[index] = staged[STRIDE * domain_pair + vector][component];
        }
    }
}
