//! Emulates a warp of `kernels/batch.cu` in lockstep, with its ring of stages and its coalesced stores.

use crate::testing::transformed_axis;
use std::sync::Arc;

use crate::gpu::tables::input_packing::InputPacker;
use crate::gpu::tables::kernels::BATCH_WARPS;
use crate::gpu::tables::layout::{BatchGroup, BatchMember};
use crate::gpu::tables::work::batches::MAX_BATCH_SIZE;
use crate::gpu::tables::work::tests::{Loaded, load};
use crate::gpu::tables::work::{CoordinateLayout, WorkList};
use crate::storage::{PackedWord, TILE_QUADS, modes_per_chunk};
use modalcast_model::backend_settings::BatchPolicy;
use modalcast_model::scene::{Scene, SceneState, StorageType};

/// Quads and vertices of a warp, 16-byte words of a stage, and stages of its ring.
const WARP_QUADS: usize = TILE_QUADS / BATCH_WARPS;
const WARP_VERTICES: usize = 4 * WARP_QUADS;
const STAGE: usize = 12 * WARP_QUADS;
const STAGES: usize = 3;
/// Fill for memory that no result may depend on: a NaN in every storage type but `Int8`.
const POISON: PackedWord = PackedWord([0xff; 16]);

/// The inputs of the kernel.
pub(super) struct Tables {
    pub scene: Arc<Scene>,
    pub work: WorkList,
    loaded: Loaded,
    state: SceneState,
    q: Vec<f32>,
}

impl Tables {
    pub(super) fn of(scene: &Arc<Scene>, state: &SceneState) -> Self {
        let coordinates = CoordinateLayout::new(scene);
        let work = WorkList::new(scene, &coordinates, BatchPolicy::Always);
        let loaded = load(scene, &work);
        let mut q = vec![f32::NAN; coordinates.total];
        let packing = InputPacker { factors: loaded.factors.clone(), ..InputPacker::sizes_only(scene) };
        for domain in 0..scene.domains.len() {
            let mut at = packing.coordinates.first[domain] as usize;
            packing.put_q(domain, state.q_of(scene, domain), |number| {
                q[at] = number;
                at += 1;
            });
        }
        Self { scene: Arc::clone(scene), work, loaded, state: state.clone(), q }
    }
}

/// One warp of a block, in lockstep.
pub(super) struct Warp<'a> {
    tables: &'a Tables,
    pub group: BatchGroup,
    tile: usize,
    first_word: usize,
    width: usize,
    /// Quads of the tile before those of the warp.
    before: usize,
    pub quads: usize,
    first: usize,
    ring: Vec<PackedWord>,
}

impl<'a> Warp<'a> {
    pub(super) fn new(tables: &'a Tables, (group, tile): (u32, u32), warp: usize) -> Self {
        let (group, tile) = (tables.work.batched.groups[group as usize], tile as usize);
        let width = TILE_QUADS.min((group.vertices as usize).div_ceil(4) - TILE_QUADS * tile);
        let before = WARP_QUADS * warp;
        Self {
            tables,
            group,
            tile,
            first_word: group.first_word as usize + 3 * group.chunks as usize * TILE_QUADS * tile + before,
            width,
            before,
            quads: width.saturating_sub(before).min(WARP_QUADS),
            first: 4 * (TILE_QUADS * tile + before),
            ring: vec![POISON; STAGES * STAGE],
        }
    }

    fn member(&self, index: usize) -> BatchMember {
        self.tables.work.batched.members[self.group.first_member as usize + index]
    }

    fn copy_stage(&mut self, stage: usize) {
        let at = stage % STAGES * STAGE;
        self.ring[at..][..STAGE].fill(POISON);
        for (lane, i) in (0..32).flat_map(|lane| (0..STAGE / 32).map(move |i| (lane, i))) {
            let row = 12 * stage + lane / WARP_QUADS + i * (32 / WARP_QUADS);
            if row < 3 * self.group.chunks as usize {
                let from = self.first_word + row * self.width + (lane % WARP_QUADS).min(self.quads - 1);
                self.ring[at + lane + 32 * i] = self.tables.loaded.words[from];
            }
        }
    }

    fn entry(&self, byte: usize) -> f32 {
        let bytes: &[u8] = bytemuck::cast_slice(&self.ring);
        let two = [bytes[byte], bytes.get(byte + 1).copied().unwrap_or(0)];
        match self.tables.scene.deformation.storage {
            StorageType::F32 => bytemuck::pod_read_unaligned(&bytes[byte..byte + 4]),
            StorageType::F16 => half::f16::from_le_bytes(two).to_f32(),
            StorageType::Bf16 => half::bf16::from_le_bytes(two).to_f32(),
            StorageType::Int8 => f32::from(bytes[byte]) - 128.0,
        }
    }

    /// A lane's sums, [2 * axis + vertex][member].
    pub(super) fn sums(&mut self) -> Vec<[[f32; MAX_BATCH_SIZE]; 6]> {
        let chunks = self.group.chunks as usize;
        let per_chunk = modes_per_chunk(self.tables.scene.deformation.storage);
        let size = 4 / per_chunk;
        let scales = &self.tables.loaded.scales[self.group.first_scale as usize..];
        let mut sums = vec![[[0.0_f32; MAX_BATCH_SIZE]; 6]; 32];
        (0..STAGES).for_each(|stage| self.copy_stage(stage));
        for stage in 0..chunks.div_ceil(4) {
            for (chunk, mode) in (0..4.min(chunks - 4 * stage)).flat_map(|c| (0..per_chunk).map(move |m| (c, m))) {
                let at = (4 * stage + chunk) * per_chunk + mode;
                let scale = scales.get(self.tile * chunks * per_chunk + at).copied().unwrap_or(1.0);
                for (lane, sums) in sums.iter_mut().enumerate() {
                    let lanes = 16 * (stage % STAGES * STAGE + lane / 2) + 2 * size * (lane % 2);
                    for (axis, vertex) in (0..3).flat_map(|axis| (0..2).map(move |vertex| (axis, vertex))) {
                        let byte = 4 * size * (3 * mode + axis);
                        let place = byte / 16 * (16 * WARP_QUADS) + byte % 16 + vertex * size;
                        let entry = self.entry(lanes + chunk * (3 * 16 * WARP_QUADS) + place);
                        let members = self.group.members as usize;
                        for (index, sum) in sums[2 * axis + vertex].iter_mut().enumerate().take(members) {
                            *sum = entry.mul_add(self.tables.q[self.member(index).first_q as usize + at] * scale, *sum);
                        }
                    }
                }
            }
            self.copy_stage(stage + STAGES);
        }
        sums
    }

    /// What the warp stages for two domains, [domain][vertex][3].
    pub(super) fn staged(&self, sums: &[[[f32; MAX_BATCH_SIZE]; 6]], member: usize) -> Vec<f32> {
        let mut staged = vec![f32::NAN; 2 * 3 * WARP_VERTICES];
        let tile = 3 * (self.group.rest as usize + TILE_QUADS * self.tile);
        for (lane, i) in (0..32).flat_map(|lane| (0..4).map(move |i| (lane, i))) {
            let (one, vertex) = (i / 2, i % 2);
            if member + one >= self.group.members as usize {
                continue;
            }
            let quad = self.before + (lane / 2).min(self.quads - 1);
            let bent = [0, 1, 2].map(|axis| {
                let rest = self.tables.loaded.rest[tile + axis * self.width + quad][2 * (lane % 2) + vertex];
                rest + sums[lane][2 * axis + vertex][member + one]
            });
            let rows = self.tables.state.transforms[self.member(member + one).domain as usize].0;
            for axis in 0..3 {
                let at = one * 3 * WARP_VERTICES + 6 * lane + 3 * vertex + axis;
                staged[at] = transformed_axis(&rows[4 * axis..], bent);
            }
        }
        staged
    }

    pub(super) fn store(&self, staged: &[f32], member: usize, positions: &mut [f32]) {
        let mut put = |member: usize, number: usize, value: f32| {
            let at = 3 * (self.member(member).first as usize + self.first) + number;
            assert!(positions[at].is_nan(), "number {at} is written once");
            positions[at] = value;
        };
        let vertices = WARP_VERTICES.min(self.group.vertices as usize - self.first);
        let members = self.group.members as usize;
        let aligned = || (0..2).all(|one| self.member(member + one).first.is_multiple_of(4));
        if vertices == WARP_VERTICES && member + 1 < members && aligned() {
            for (lane, i) in (0..32).flat_map(|lane| (0..12).map(move |i| (lane, i))) {
                let (word, within) = (i / 4, i % 4);
                let (to, first) = match word {
                    0 => (member, lane),
                    1 if lane < 16 => (member, 32 + lane),
                    1 => (member + 1, lane - 16),
                    _ => (member + 1, 16 + lane),
                };
                put(to, 4 * first + within, staged[4 * (32 * word + lane) + within]);
            }
            return;
        }
        for one in (0..2).filter(|one| member + one < members) {
            (0..3 * vertices).for_each(|k| put(member + one, k, staged[one * 3 * WARP_VERTICES + k]));
        }
    }
}
