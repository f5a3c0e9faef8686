//! CPU twin of one warp of `kernels/batch_mma.cu` in lockstep: fragments, staging buffer and stores. Sums are f64.

use super::{BatchMmaArgs, STEP, args, fragments, halves, placements, vectors_for};
use modalcast_compute::storage::{PackedWord, TiledModes};
use modalcast_compute::testing::transformed_axis;
use modalcast_model::scene::{Scene, SceneState, StorageType};

pub(super) const QUADS: usize = 8;
const STRIDE: usize = 3 * QUADS + 2;

/// The kernel's inputs.
pub(super) struct KernelInputs {
    pub tiles: TiledModes,
    pub args: BatchMmaArgs,
    fragments: Vec<u32>,
    placements: Vec<f32>,
    pub vectors: usize,
}

impl KernelInputs {
    pub(super) fn of(scene: &Scene, state: &SceneState) -> Self {
        let tiles = TiledModes::new(scene.shape_of(0), scene.deformation.storage);
        let (vectors, halves) = (vectors_for(scene.domains.len()).0, halves(scene, state, &tiles));
        Self {
            args: args(scene, tiles.chunks()),
            fragments: fragments(&halves, tiles.rank(), vectors),
            placements: placements(state, &halves, vectors),
            vectors,
            tiles,
        }
    }

    fn number(&self, bits: u32) -> f64 {
        match self.tiles.storage() {
            StorageType::F16 => half::f16::from_bits(bits as u16).to_f64(),
            _ => half::bf16::from_bits(bits as u16).to_f64(),
        }
    }
}

/// A product of fragments as the PTX instruction set defines m16n8k16: rows g and g + 8 of A and columns 2 t and 2 t +
/// 1 of D belong to lane 4 g + t.
fn multiply(tables: &KernelInputs, a: &[[u32; 4]; 32], b: &[[u32; 2]; 32], d: &mut [[f64; 4]; 32]) {
    let half = |word: u32, index: usize| tables.number(word >> (16 * (index % 2)) & 0xffff);
    let at = |row: usize, k: usize| half(a[4 * (row % 8) + k % 8 / 2][row / 8 + 2 * (k / 8)], k);
    let from = |k: usize, column: usize| half(b[4 * column + k % 8 / 2][k / 8], k);
    for (lane, sums) in d.iter_mut().enumerate() {
        for (i, sum) in sums.iter_mut().enumerate() {
            let (row, column) = (lane / 4 + 8 * (i / 2), 2 * (lane % 4) + i % 2);
            *sum += (0..16).map(|k| at(row, k) * from(k, column)).sum::<f64>();
        }
    }
}

/// The twelve words of a lane's chunk; zeros beyond the last chunk.
fn load(tables: &KernelInputs, (first, width, quad): (usize, usize, usize), chunk: usize) -> [u32; 12] {
    let mut words = [0; 12];
    if chunk < tables.args.chunks as usize {
        let plane =
            |plane: usize| -> PackedWord { tables.tiles.packed_words()[first + (3 * chunk + plane) * width + quad] };
        let bytes: Vec<u8> = (0..3).flat_map(|index| plane(index).0).collect();
        words = std::array::from_fn(|word| bytemuck::pod_read_unaligned(&bytes[4 * word..4 * word + 4]));
    }
    words
}

/// Accumulators: [row][eight of domains][lane][4].
pub(super) type AccumulatorFragments = Vec<Vec<[[f64; 4]; 32]>>;

pub(super) fn sums(tables: &KernelInputs, tile: usize, warp: usize) -> AccumulatorFragments {
    let width = tables.tiles.tile(tile).quads;
    let first = tables.tiles.tile(tile).first_packed_word;
    let eights = tables.vectors / 8;
    let mut sums: AccumulatorFragments = vec![vec![[[0.0; 4]; 32]; eights]; 6];
    for step in 0..tables.tiles.rank().div_ceil(STEP) {
        let chunks: Vec<[[u32; 12]; 2]> = (0..32)
            .map(|lane| {
                let place = (first, width, (QUADS * warp + lane / 4).min(width - 1));
                [0, 4].map(|more| load(tables, place, 8 * step + lane % 4 + more))
            })
            .collect();
        for (row, sums) in sums.iter_mut().enumerate() {
            let low = |words: &[u32; 12]| words[row] & 0xffff | words[6 + row] << 16;
            let high = |words: &[u32; 12]| words[row] >> 16 | words[6 + row] & 0xffff_0000;
            let a: [[u32; 4]; 32] = std::array::from_fn(|lane| {
                let [near, far] = &chunks[lane];
                [low(near), high(near), low(far), high(far)]
            });
            for (eight, sums) in sums.iter_mut().enumerate() {
                let word = |lane: usize, at: usize| tables.fragments[4 * (32 * (eights * step + eight) + lane) + at];
                for half in [2, 0] {
                    let b = std::array::from_fn(|lane| [word(lane, half), word(lane, half + 1)]);
                    multiply(tables, &a, &b, sums);
                }
            }
        }
    }
    sums
}

pub(super) fn staged(
    tables: &KernelInputs,
    sums: &AccumulatorFragments,
    (tile, warp): (usize, usize),
    pass: usize,
) -> Vec<[f32; 4]> {
    let mut staged = vec![[f32::NAN; 4]; 4 * STRIDE];
    let place = tables.tiles.tile(tile);
    for (quad, pair) in (0..QUADS).flat_map(|quad| (0..4).map(move |pair| (quad, pair))) {
        let (lane, of_pair) = (4 * quad + pair, pass % 2);
        let domain = 8 * (pass / 2) + of_pair + 2 * pair;
        let rest = tables.tiles.rest()[place.first_quad + (QUADS * warp + quad).min(place.quads - 1)];
        let rows = &tables.placements[12 * domain..][..12];
        let shrink = tables.placements[12 * tables.vectors + domain];
        let world: Vec<f32> = (0..4)
            .flat_map(|vertex| {
                let bent = [0, 1, 2].map(|axis| {
                    let sum = sums[2 * axis + vertex / 2][pass / 2][lane][2 * (vertex % 2) + of_pair] as f32;
                    rest[4 * axis + vertex] + sum * shrink
                });
                [0, 1, 2].map(|row| transformed_axis(&rows[4 * row..], bent))
            })
            .collect();
        for (i, four) in world.chunks_exact(4).enumerate() {
            staged[STRIDE * pair + 3 * quad + i] = [four[0], four[1], four[2], four[3]];
        }
    }
    staged
}

pub(super) fn store(
    tables: &KernelInputs,
    staged: &[[f32; 4]],
    (first, own, pass): (usize, usize, usize),
    positions: &mut [f32],
) {
    for (lane, i) in (0..32).flat_map(|lane| (0..3).map(move |i| (lane, i))) {
        let domain = 8 * (pass / 2) + pass % 2 + 2 * (lane / 8);
        let four = 8 * i + lane % 8;
        for k in (0..4).filter(|k| domain < tables.args.domains as usize && 4 * four + k < own) {
            let at = 3 * (tables.args.first[domain] as usize + first) + 4 * four + k;
            assert!(positions[at].is_nan(), "number {at} is written once");
            positions[at] = staged[STRIDE * (lane / 8) + four][k];
        }
    }
}
