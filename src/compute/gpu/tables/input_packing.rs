//! The input values of a step. The host writes them once to pinned memory, in the layout of the device buffer; several
//! cores write large steps. Pure.
//!
//! ```text
//! [header][transforms: 12 f32 per transform root][q, padded to whole chunks of modes][kept chunks of each domain]
//! ```
//! The kept chunks are present only with truncation. The pinned memory is write-combined: the host writes it from front
//! to back and never reads it.

use std::sync::Arc;

use rayon::prelude::*;

use super::layout::{Header, TransformLink};
use super::staging::{SliceWriter, fill_parts};
use super::work::CoordinateLayout;
use crate::storage::{Truncation, TruncationInput, bound, max_row_norms, modes_per_chunk};
use modalcast_model::scene::{Scene, SceneState};

/// Layout of a scene's modal coordinates on the device.
#[derive(Debug)]
pub struct InputPacker {
    pub(crate) scene: Arc<Scene>,
    pub(crate) coordinates: CoordinateLayout,
    /// Per shape, the factors of its modes; empty unless the storage has factors.
    pub(crate) factors: Vec<Vec<f32>>,
    pub(crate) dirty_tile_layout: DirtyTileLayout,
}

/// Tiles of each domain, from which a partial step derives its tile list.
#[derive(Debug, Default)]
pub(crate) struct DirtyTileLayout {
    /// Per domain, first tile and tile count: of tiles with vertices, and of tiles with corners alone.
    pub spans: Vec<[(u32, u32); 2]>,
    /// Number of all tiles.
    pub tiles: usize,
    /// Cost of a full step in tiles, the limit of a partial step. A batched tile counts as several, because a batch
    /// reads U once but computes every member.
    pub whole: usize,
}

/// Sizes of the parts in bytes, in buffer order.
#[derive(Debug, Clone, Copy)]
pub(crate) struct InputSizes {
    pub transforms: u64,
    pub q: u64,
    pub retained_counts: u64,
    pub retained: u64,
}

impl InputSizes {
    pub(crate) fn of(scene: &Scene, coordinates: &CoordinateLayout) -> Self {
        let domains = scene.domains.len() as u64;
        let (truncation, per_chunk) = (scene.features.truncation, modes_per_chunk(scene.deformation.storage));
        Self {
            transforms: 48 * scene.transform_roots.count() as u64,
            q: 4 * coordinates.total as u64,
            retained_counts: if truncation { 4 * domains.next_multiple_of(4) } else { 0 },
            retained: if truncation { 2 * (coordinates.total / per_chunk).next_multiple_of(8) as u64 } else { 0 },
        }
    }

    pub(crate) const fn total(self) -> u64 {
        size_of::<Header>() as u64 + self.transforms + self.q + self.retained_counts + self.retained
    }
}

/// Writes the values of steps in buffer order. Pure.
#[derive(Debug)]
pub struct InputWriter {
    packing: Arc<InputPacker>,
    truncation: Option<ChunkSelection>,
}

impl InputWriter {
    /// A writer of steps in the layout of `packing`.
    pub fn new(packing: &Arc<InputPacker>) -> Self {
        let truncation = packing.scene.features.truncation.then(|| ChunkSelection::new(&packing.scene));
        Self { packing: Arc::clone(packing), truncation }
    }

    /// Writes a full step; `to` has `InputSizes::total` bytes.
    pub fn write(&mut self, to: &mut [f32], header: &Header, state: &SceneState) {
        let mut to = SliceWriter::new(to);
        to.put(std::slice::from_ref(header));
        to.put(&state.transforms);
        self.packing.write_q(state, to.take(self.packing.coordinates.total));
        if let Some(choice) = &mut self.truncation {
            choice.write(&self.packing, state, &mut to);
        }
    }
}

impl InputWriter {
    /// Number of chunks of modes that each domain sums in the last step; `None` when all are summed.
    pub(crate) fn retained_chunk_counts(&self) -> Option<&[u32]> {
        self.truncation.as_ref().map(|choice| choice.counts.as_slice())
    }

    /// Bound of the displacement that the truncated modes cause at any vertex in the last step, scene units.
    pub(crate) fn truncation_bound(&self) -> f64 {
        self.truncation.as_ref().map_or(0.0, |choice| choice.bound)
    }
}

/// Transform root and frame of each domain; empty in a scene without followers.
pub(crate) fn transform_links(scene: &Scene) -> Vec<TransformLink> {
    scene
        .transform_roots
        .root_and_frame_indices()
        .iter()
        .map(|[root, frame]| TransformLink { root: *root, frame: *frame })
        .collect()
}

impl InputPacker {
    /// A layout without factors and tiles: its steps have the sizes of the scene's steps, but not their numbers. For
    /// measurements of the upload alone.
    pub fn sizes_only(scene: &Arc<Scene>) -> Self {
        Self {
            scene: Arc::clone(scene),
            coordinates: CoordinateLayout::new(scene),
            factors: vec![Vec::new(); scene.shapes.len()],
            dirty_tile_layout: DirtyTileLayout::default(),
        }
    }

    /// Writes all coordinates in the layout of the device, and zeros the padding at the end.
    fn write_q(&self, state: &SceneState, to: &mut [f32]) {
        if self.coordinates.is_scene_order {
            let mut to = SliceWriter::new(to);
            to.put(&state.q);
            to.take(self.coordinates.total - state.q.len()).fill(0.0);
            return;
        }
        fill_parts(to, &self.coordinates.first, |domains, part| {
            let mut at = 0;
            for domain in domains {
                self.put_q(domain, state.q_of(&self.scene, domain), |number| {
                    part[at] = number;
                    at += 1;
                });
            }
            part[at..].fill(0.0);
        });
    }

    /// Passes the coordinates of one domain to `put`, multiplied by the factors of their modes and padded to whole
    /// chunks.
    pub(crate) fn put_q(&self, domain: usize, q: &[f32], mut put: impl FnMut(f32)) {
        let factors = &self.factors[self.scene.domains[domain].shape];
        // The factor is a power of two, so the product is exact unless it overflows or underflows f32.
        q.iter()
            .enumerate()
            .for_each(|(mode, amount)| put(factors.get(mode).map_or(*amount, |factor| amount * factor)));
        if !self.coordinates.is_scene_order {
            let whole = q.len().next_multiple_of(modes_per_chunk(self.scene.deformation.storage));
            (q.len()..whole).for_each(|_| put(0.0));
        }
    }
}

/// Domains per parallel work item of the truncation; a domain takes a few microseconds.
const MIN_DOMAINS_PER_TASK: usize = 64;

/// Modal truncation: which chunks of modes each domain sums.
#[derive(Debug)]
struct ChunkSelection {
    /// Error budget, scene units.
    budget: f64,
    /// Per shape.
    max_row_norms: Vec<Vec<f64>>,
    /// Per domain.
    truncations: Vec<Truncation>,
    bound: f64,
    counts: Vec<u32>,
    /// Chunk indices, two u16 per word.
    chunks: Vec<u32>,
}

impl ChunkSelection {
    fn new(scene: &Scene) -> Self {
        Self {
            budget: scene.deformation.truncation.unwrap_or(0.0) / scene.unit,
            max_row_norms: scene.shapes.iter().map(|shape| max_row_norms(&shape.modes)).collect(),
            truncations: (0..scene.domains.len()).map(|domain| Truncation::new(scene.rank_of(domain))).collect(),
            bound: 0.0,
            counts: Vec::new(),
            chunks: Vec::new(),
        }
    }

    /// Keeps a chunk when at least one of its modes is kept: reading the chunk reads its other modes too.
    fn write(&mut self, packing: &InputPacker, state: &SceneState, to: &mut SliceWriter) {
        let scene = &packing.scene;
        let per_chunk = modes_per_chunk(scene.deformation.storage);
        self.counts.clear();
        self.counts.resize(scene.domains.len().next_multiple_of(4), 0);
        self.chunks.clear();
        self.chunks.resize((packing.coordinates.total / per_chunk).next_multiple_of(8) / 2, 0);
        let chunks: &mut [u16] = bytemuck::cast_slice_mut(&mut self.chunks);
        self.bound = 0.0;
        let (max_row_norms, budget) = (&self.max_row_norms, self.budget);
        let decide = |(domain, truncation): (usize, &mut Truncation)| {
            // Without modes nothing can be truncated, and the norm of T does not matter.
            if scene.rank_of(domain) > 0 {
                let max_row_norms = &max_row_norms[scene.domains[domain].shape];
                let norm = bound::norm(&state.composed_transform(scene, domain));
                truncation.update(TruncationInput { q: state.q_of(scene, domain), max_row_norms, norm }, budget);
            }
        };
        self.truncations.par_iter_mut().enumerate().with_min_len(MIN_DOMAINS_PER_TASK).for_each(decide);
        for (domain, truncation) in self.truncations.iter().enumerate() {
            self.bound = self.bound.max(truncation.bound());
            let first = packing.coordinates.first[domain] as usize / per_chunk;
            let mut count = 0;
            for mode in truncation.retained() {
                let chunk = mode / per_chunk as u16;
                if count == 0 || chunks[first + count - 1] != chunk {
                    chunks[first + count] = chunk;
                    count += 1;
                }
            }
            self.counts[domain] = count as u32;
        }
        to.put(&self.counts);
        to.put(&self.chunks);
    }
}

#[cfg(test)]
mod tests {
    use super::super::test_scenes::{deformed, scene};
    use super::*;
    use modalcast_model::scene::{DeformationSettings, StorageType};

    fn packing(scene: &Arc<Scene>) -> Arc<InputPacker> {
        let factors = vec![vec![0.5; 64]; scene.shapes.len()];
        Arc::new(InputPacker { factors, ..InputPacker::sizes_only(scene) })
    }

    fn state(scene: &Scene) -> SceneState {
        let mut state = SceneState::rest(scene);
        state.q.iter_mut().enumerate().for_each(|(at, amount)| *amount = (at % 1000) as f32);
        let transforms = state.transforms.iter_mut().enumerate();
        transforms.for_each(|(at, transform)| transform.0[3] = at as f32);
        state
    }

    /// All words of a step, written one by one.
    fn plainly(packing: &InputPacker, state: &SceneState) -> Vec<f32> {
        let scene = &packing.scene;
        let mut words = vec![0.0; size_of::<Header>() / 4];
        words.extend(state.transforms.iter().flat_map(|transform| transform.0));
        let begin = words.len();
        words.resize(begin + packing.coordinates.total, 0.0);
        for domain in 0..scene.domains.len() {
            let first = begin + packing.coordinates.first[domain] as usize;
            for (mode, amount) in state.q_of(scene, domain).iter().enumerate() {
                words[first + mode] = if packing.coordinates.is_scene_order { *amount } else { 0.5 * amount };
            }
        }
        words
    }

    #[test]
    fn small_and_large_steps_are_written_word_for_word_whatever_the_cores() {
        let f16 = DeformationSettings { storage: StorageType::F16, ..DeformationSettings::default() };
        for (shapes, cores) in [(3, 1), (3, 4), (20_000, 1), (20_000, 4)] {
            let ranks: Vec<(usize, usize)> = (0..shapes).map(|at| (7, at % 20)).collect();
            for scene in [scene(&ranks, false, false), deformed(&ranks, f16)] {
                let (packing, state) = (packing(&scene), state(&scene));
                let mut words = vec![f32::NAN; InputSizes::of(&scene, &packing.coordinates).total() as usize / 4];
                let pool = rayon::ThreadPoolBuilder::new().num_threads(cores).build().expect("a pool");
                pool.install(|| InputWriter::new(&packing).write(&mut words, &Header::default(), &state));
                let mut want = plainly(&packing, &state);
                assert!(words == want, "{shapes} shapes, {cores} cores");
                want[24] += 1.0;
                assert!(words != want, "the judge can fail");
            }
        }
    }
}
