//! A warp of `kernels/batch.cu` in step, with its ring, its stages and its ways out.

use super::{BatchArgs, MOST, WARPS, amounts, transforms, vectors_for};
use crate::scene::{Scene, State, Storage};
use crate::storage::{Plane, TILE_QUADS, Tiles, modes_per_chunk};

/// Quads and vertices of a warp, 16 byte words of a stage, and stages of its ring.
const QUADS: usize = TILE_QUADS / WARPS;
const VERTICES: usize = 4 * QUADS;
const STAGE: usize = 12 * QUADS;
const STAGES: usize = 3;
/// What no result may depend on: a NaN in every storage but `Int8`.
const POISON: Plane = Plane([0xff; 16]);

/// What the kernel reads.
pub(super) struct Tables {
    pub tiles: Tiles,
    transforms: Vec<f32>,
    q: Vec<f32>,
    vectors: usize,
}

impl Tables {
    pub(super) fn of(scene: &Scene, state: &State) -> Self {
        let tiles = Tiles::new(scene.shape_of(0), scene.deformation.storage);
        let (vectors, modes) = (vectors_for(scene.domains.len()).0, tiles.chunks() * modes_per_chunk(tiles.storage()));
        let q = amounts(scene, state, tiles.factors(), (vectors, modes));
        Self { transforms: transforms(scene, state, vectors), q, vectors, tiles }
    }
}

/// One warp of a block, in step.
pub(super) struct Warp<'a> {
    tables: &'a Tables,
    args: BatchArgs,
    tile: usize,
    first_word: usize,
    width: usize,
    pub quads: usize,
    first: usize,
    ring: Vec<Plane>,
}

impl<'a> Warp<'a> {
    pub(super) fn new(tables: &'a Tables, args: BatchArgs, (tile, warp): (usize, usize)) -> Self {
        let width = TILE_QUADS.min((args.vertices as usize).div_ceil(4) - TILE_QUADS * tile);
        let before = QUADS * warp;
        Self {
            tables,
            args,
            tile,
            first_word: 3 * args.chunks as usize * TILE_QUADS * tile + before,
            width,
            quads: width.saturating_sub(before).min(QUADS),
            first: 4 * (TILE_QUADS * tile + before),
            ring: vec![POISON; STAGES * STAGE],
        }
    }

    fn copy_stage(&mut self, stage: usize) {
        let at = stage % STAGES * STAGE;
        self.ring[at..][..STAGE].fill(POISON);
        for (lane, i) in (0..32).flat_map(|lane| (0..STAGE / 32).map(move |i| (lane, i))) {
            let row = 12 * stage + lane / QUADS + i * (32 / QUADS);
            if row < 3 * self.args.chunks as usize {
                let from = self.first_word + row * self.width + (lane % QUADS).min(self.quads - 1);
                self.ring[at + lane + 32 * i] = self.tables.tiles.planes()[from];
            }
        }
    }

    fn entry(&self, byte: usize) -> f32 {
        let bytes: &[u8] = bytemuck::cast_slice(&self.ring);
        let two = [bytes[byte], bytes.get(byte + 1).copied().unwrap_or(0)];
        match self.tables.tiles.storage() {
            Storage::F32 => bytemuck::pod_read_unaligned(&bytes[byte..byte + 4]),
            Storage::F16 => half::f16::from_le_bytes(two).to_f32(),
            Storage::Bf16 => half::bf16::from_le_bytes(two).to_f32(),
            Storage::Int8 => f32::from(bytes[byte]) - 128.0,
        }
    }

    /// A lane's sums, [2 * axis + vertex][domain].
    pub(super) fn sums(&mut self) -> Vec<[[f32; MOST]; 6]> {
        let (chunks, vectors) = (self.args.chunks as usize, self.tables.vectors);
        let per_chunk = modes_per_chunk(self.tables.tiles.storage());
        let (size, scales) = (4 / per_chunk, self.tables.tiles.scales());
        let mut sums = vec![[[0.0_f32; MOST]; 6]; 32];
        (0..STAGES).for_each(|stage| self.copy_stage(stage));
        for stage in 0..chunks.div_ceil(4) {
            for (chunk, mode) in (0..4.min(chunks - 4 * stage)).flat_map(|c| (0..per_chunk).map(move |m| (c, m))) {
                let at = (4 * stage + chunk) * per_chunk + mode;
                let scale = scales.get(self.tile * chunks * per_chunk + at).copied().unwrap_or(1.0);
                for (lane, sums) in sums.iter_mut().enumerate() {
                    let lanes = 16 * (stage % STAGES * STAGE + lane / 2) + 2 * size * (lane % 2);
                    for (axis, vertex) in (0..3).flat_map(|axis| (0..2).map(move |vertex| (axis, vertex))) {
                        let byte = 4 * size * (3 * mode + axis);
                        let place = byte / 16 * (16 * QUADS) + byte % 16 + vertex * size;
                        let entry = self.entry(lanes + chunk * (3 * 16 * QUADS) + place);
                        for (domain, sum) in sums[2 * axis + vertex].iter_mut().enumerate().take(vectors) {
                            *sum = entry.mul_add(self.tables.q[at * vectors + domain] * scale, *sum);
                        }
                    }
                }
            }
            self.copy_stage(stage + STAGES);
        }
        sums
    }

    /// What two domains stage, [domain][vertex][3].
    pub(super) fn staged(&self, sums: &[[[f32; MOST]; 6]], domain: usize) -> Vec<f32> {
        let mut staged = vec![f32::NAN; 2 * 3 * VERTICES];
        for (lane, i) in (0..32).flat_map(|lane| (0..4).map(move |i| (lane, i))) {
            let (one, vertex) = (i / 2, i % 2);
            let quad = (lane / 2).min(self.quads - 1);
            let rest = self.tables.tiles.rest()[self.first / 4 + quad];
            let bent = [0, 1, 2]
                .map(|axis| rest[4 * axis + 2 * (lane % 2) + vertex] + sums[lane][2 * axis + vertex][domain + one]);
            let rows = &self.tables.transforms[12 * (domain + one)..];
            for axis in 0..3 {
                let at = one * 3 * VERTICES + 6 * lane + 3 * vertex + axis;
                staged[at] = placed(&rows[4 * axis..], bent);
            }
        }
        staged
    }

    pub(super) fn store(&self, staged: &[f32], domain: usize, positions: &mut [f32]) {
        let mut put = |domain: usize, number: usize, value: f32| {
            let at = 3 * (self.args.first[domain] as usize + self.first) + number;
            assert!(positions[at].is_nan(), "number {at} is written once");
            positions[at] = value;
        };
        let vertices = VERTICES.min(self.args.vertices as usize - self.first);
        let domains = self.args.domains as usize;
        if self.args.aligned == 1 && vertices == VERTICES && domain + 1 < domains {
            for (lane, i) in (0..32).flat_map(|lane| (0..12).map(move |i| (lane, i))) {
                let (word, within) = (i / 4, i % 4);
                let (to, first) = match word {
                    0 => (domain, lane),
                    1 if lane < 16 => (domain, 32 + lane),
                    1 => (domain + 1, lane - 16),
                    _ => (domain + 1, 16 + lane),
                };
                put(to, 4 * first + within, staged[4 * (32 * word + lane) + within]);
            }
            return;
        }
        for one in (0..2).filter(|one| domain + one < domains) {
            (0..3 * vertices).for_each(|k| put(domain + one, k, staged[one * 3 * VERTICES + k]));
        }
    }
}

pub(in super::super) fn placed(row: &[f32], [x, y, z]: [f32; 3]) -> f32 {
    row[0].mul_add(x, row[1].mul_add(y, row[2].mul_add(z, row[3])))
}
