//! Emulates a warp of `kernels/batch.cu` in lockstep, with its ring buffer for U and its coalesced stores. As in the
//! kernel, a quad is four consecutive vertices, a chunk is a few consecutive modes, and the ring has stages of a few
//! chunks. The members of a group are its domains.

use crate::testing::transformed_axis;
use std::sync::Arc;

use crate::gpu::tables::input_packing::InputPacker;
use crate::gpu::tables::kernels::BATCH_WARPS;
use crate::gpu::tables::layout::{BatchGroup, BatchMember};
use crate::gpu::tables::work::batches::MAX_BATCH_SIZE;
use crate::gpu::tables::work::tests::{LoadedTables, load_tables};
use crate::gpu::tables::work::{CoordinateLayout, WorkList};
use crate::storage::{PackedWord, TILE_QUADS, modes_per_chunk};
use modalcast_model::backend_settings::BatchPolicy;
use modalcast_model::scene::{Scene, SceneState, StorageType};

/// Quads of a warp.
const WARP_QUADS: usize = TILE_QUADS / BATCH_WARPS;
/// Vertices of a warp.
const WARP_VERTICES: usize = 4 * WARP_QUADS;
/// Chunks of a stage.
const STAGE_CHUNKS: usize = 4;
/// 16-byte words of a stage: three per chunk and quad.
const STAGE_WORDS: usize = 3 * STAGE_CHUNKS * WARP_QUADS;
/// Stages of the ring.
const RING_STAGES: usize = 3;
/// Content of unwritten memory, on which no result may depend: a NaN in every storage type except `Int8`.
const POISON: PackedWord = PackedWord([0xff; 16]);

/// The inputs of the kernel.
pub(super) struct Tables {
    pub scene: Arc<Scene>,
    pub work: WorkList,
    loaded: LoadedTables,
    state: SceneState,
    q: Vec<f32>,
}

impl Tables {
    pub(super) fn of(scene: &Arc<Scene>, state: &SceneState) -> Self {
        let coordinates = CoordinateLayout::new(scene);
        let work = WorkList::new(scene, &coordinates, BatchPolicy::Always);
        let loaded = load_tables(scene, &work);
        let mut q = vec![f32::NAN; coordinates.total];
        let factors = coordinates.spread_factors(scene, &loaded.factors);
        let packer = InputPacker { factors, ..InputPacker::sizes_only(scene) };
        for domain in 0..scene.domains.len() {
            let first_q = packer.coordinates.first_q[domain] as usize;
            packer.put_q(first_q, state.q_of(scene, domain), &mut q[first_q..]);
        }
        Self { scene: Arc::clone(scene), work, loaded, state: state.clone(), q }
    }
}

/// One warp of a block, in lockstep.
pub(super) struct Warp<'a> {
    tables: &'a Tables,
    pub group: BatchGroup,
    tile: usize,
    /// Index of the first word of the warp's first quad in U.
    first_word: usize,
    /// Number of quads of the tile.
    tile_quads: usize,
    /// Index of the warp's first quad in the tile.
    warp_quad: usize,
    /// Number of quads of the warp.
    pub quads: usize,
    /// Index of the warp's first vertex in the shape.
    first_vertex: usize,
    ring: Vec<PackedWord>,
}

impl<'a> Warp<'a> {
    pub(super) fn new(tables: &'a Tables, (group, tile): (u32, u32), warp: usize) -> Self {
        let (group, tile) = (tables.work.batched.groups[group as usize], tile as usize);
        let tile_quads = TILE_QUADS.min((group.vertex_count as usize).div_ceil(4) - TILE_QUADS * tile);
        let warp_quad = WARP_QUADS * warp;
        Self {
            tables,
            group,
            tile,
            first_word: group.first_word as usize + 3 * group.chunk_count as usize * TILE_QUADS * tile + warp_quad,
            tile_quads,
            warp_quad,
            quads: tile_quads.saturating_sub(warp_quad).min(WARP_QUADS),
            first_vertex: 4 * (TILE_QUADS * tile + warp_quad),
            ring: vec![POISON; RING_STAGES * STAGE_WORDS],
        }
    }

    fn member(&self, index: usize) -> BatchMember {
        self.tables.work.batched.members[self.group.first_member as usize + index]
    }

    /// Copies a stage of U to the ring: `3 * STAGE_CHUNKS` rows, each with one word of every quad of the warp. Lanes
    /// beyond the last quad copy the last quad again.
    fn copy_stage(&mut self, stage: usize) {
        let ring_word = stage % RING_STAGES * STAGE_WORDS;
        self.ring[ring_word..][..STAGE_WORDS].fill(POISON);
        for (lane, copy) in (0..32).flat_map(|lane| (0..STAGE_WORDS / 32).map(move |copy| (lane, copy))) {
            let row = 3 * STAGE_CHUNKS * stage + lane / WARP_QUADS + copy * (32 / WARP_QUADS);
            if row < 3 * self.group.chunk_count as usize {
                let word = self.first_word + row * self.tile_quads + (lane % WARP_QUADS).min(self.quads - 1);
                self.ring[ring_word + lane + 32 * copy] = self.tables.loaded.words[word];
            }
        }
    }

    /// Decodes the entry of U at a byte of the ring, without the scale of `Int8`.
    fn entry(&self, byte: usize) -> f32 {
        let bytes: &[u8] = bytemuck::cast_slice(&self.ring);
        let first_bytes = [bytes[byte], bytes.get(byte + 1).copied().unwrap_or(0)];
        match self.tables.scene.deformation.storage {
            StorageType::F32 => bytemuck::pod_read_unaligned(&bytes[byte..byte + 4]),
            StorageType::F16 => half::f16::from_le_bytes(first_bytes).to_f32(),
            StorageType::Bf16 => half::bf16::from_le_bytes(first_bytes).to_f32(),
            StorageType::Int8 => f32::from(bytes[byte]) - 128.0,
        }
    }

    /// Sums of all lanes, `[lane][2 * axis + vertex][member]`. A lane sums two vertices: lanes 2 i and 2 i + 1 have the
    /// first and the second half of quad i.
    pub(super) fn sums(&mut self) -> Vec<[[f32; MAX_BATCH_SIZE]; 6]> {
        let chunks = self.group.chunk_count as usize;
        let chunk_modes = modes_per_chunk(self.tables.scene.deformation.storage);
        let entry_bytes = 4 / chunk_modes;
        let scales = &self.tables.loaded.scales[self.group.first_scale as usize..];
        let mut sums = vec![[[0.0_f32; MAX_BATCH_SIZE]; 6]; 32];
        (0..RING_STAGES).for_each(|stage| self.copy_stage(stage));
        for stage in 0..chunks.div_ceil(STAGE_CHUNKS) {
            let stage_chunks = 0..STAGE_CHUNKS.min(chunks - STAGE_CHUNKS * stage);
            for (chunk, mode) in stage_chunks.flat_map(|chunk| (0..chunk_modes).map(move |mode| (chunk, mode))) {
                let mode_index = (STAGE_CHUNKS * stage + chunk) * chunk_modes + mode;
                let scale = scales.get(self.tile * chunks * chunk_modes + mode_index).copied().unwrap_or(1.0);
                for (lane, sums) in sums.iter_mut().enumerate() {
                    // The first byte of the lane's half of a word, in the first row of the stage.
                    let lane_byte = 16 * (stage % RING_STAGES * STAGE_WORDS + lane / 2) + 2 * entry_bytes * (lane % 2);
                    for (axis, vertex) in (0..3).flat_map(|axis| (0..2).map(move |vertex| (axis, vertex))) {
                        // The offset of the quad's entries of this mode and axis in the 48 bytes of a chunk. Each 16
                        // bytes are one word, and consecutive words are one row apart.
                        let chunk_byte = 4 * entry_bytes * (3 * mode + axis);
                        let entry_byte = chunk_byte / 16 * (16 * WARP_QUADS) + chunk_byte % 16 + vertex * entry_bytes;
                        let entry = self.entry(lane_byte + chunk * (3 * 16 * WARP_QUADS) + entry_byte);
                        let members = self.group.member_count as usize;
                        for (index, sum) in sums[2 * axis + vertex].iter_mut().enumerate().take(members) {
                            *sum = entry
                                .mul_add(self.tables.q[self.member(index).first_q as usize + mode_index] * scale, *sum);
                        }
                    }
                }
            }
            self.copy_stage(stage + RING_STAGES);
        }
        sums
    }

    /// Positions of the members `member` and `member + 1` as the warp stages them before the stores:
    /// `[member][vertex][axis]`. Positions of a missing second member are NaN.
    pub(super) fn staged(&self, sums: &[[[f32; MAX_BATCH_SIZE]; 6]], member: usize) -> Vec<f32> {
        let mut staged = vec![f32::NAN; 2 * 3 * WARP_VERTICES];
        let first_rest_vector = 3 * (self.group.rest_quad as usize + TILE_QUADS * self.tile);
        // A lane stages two vertices of two members.
        for (lane, position) in (0..32).flat_map(|lane| (0..4).map(move |position| (lane, position))) {
            let (member_offset, vertex) = (position / 2, position % 2);
            if member + member_offset >= self.group.member_count as usize {
                continue;
            }
            let quad = self.warp_quad + (lane / 2).min(self.quads - 1);
            let deformed = [0, 1, 2].map(|axis| {
                let rest = self.tables.loaded.rest_positions[first_rest_vector + axis * self.tile_quads + quad]
                    [2 * (lane % 2) + vertex];
                rest + sums[lane][2 * axis + vertex][member + member_offset]
            });
            let rows = self.tables.state.transforms[self.member(member + member_offset).domain as usize].0;
            for axis in 0..3 {
                let index = member_offset * 3 * WARP_VERTICES + 6 * lane + 3 * vertex + axis;
                staged[index] = transformed_axis(&rows[4 * axis..], deformed);
            }
        }
        staged
    }

    /// Stores the staged positions of two members, or of one if `member` is the last. Uses the 16-byte stores of the
    /// kernel under the same conditions.
    pub(super) fn store(&self, staged: &[f32], member: usize, positions: &mut [f32]) {
        let mut put_component = |member: usize, component: usize, value: f32| {
            let index = 3 * (self.member(member).first_vertex as usize + self.first_vertex) + component;
            assert!(positions[index].is_nan(), "expected position component {index} to be written once");
            positions[index] = value;
        };
        let vertices = WARP_VERTICES.min(self.group.vertex_count as usize - self.first_vertex);
        let members = self.group.member_count as usize;
        let are_aligned =
            || (0..2).all(|member_offset| self.member(member + member_offset).first_vertex.is_multiple_of(4));
        if vertices == WARP_VERTICES && member + 1 < members && are_aligned() {
            // The positions of a member are 64 * 3 components, 48 words of 16 bytes. Each of the 32 lanes stores three
            // of the 96 words of both members.
            for (lane, lane_component) in (0..32).flat_map(|lane| (0..12).map(move |component| (lane, component))) {
                let (store, word_component) = (lane_component / 4, lane_component % 4);
                let (target_member, target_word) = match store {
                    0 => (member, lane),
                    1 if lane < 16 => (member, 32 + lane),
                    1 => (member + 1, lane - 16),
                    _ => (member + 1, 16 + lane),
                };
                let staged_component = staged[4 * (32 * store + lane) + word_component];
                put_component(target_member, 4 * target_word + word_component, staged_component);
            }
            return;
        }
        for member_offset in (0..2).filter(|member_offset| member + member_offset < members) {
            (0..3 * vertices).for_each(|component| {
                put_component(member + member_offset, component, staged[member_offset * 3 * WARP_VERTICES + component])
            });
        }
    }
}
