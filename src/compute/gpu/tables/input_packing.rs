//! The input values of a step, in the layout of the device buffer. The host writes them to pinned memory, with several
//! cores if the step is large.
//!
//! ```text
//! [header][transforms: 12 f32 per transform root][q, padded to whole chunks][retained counts][retained chunks]
//! ```
//! A transform root is a domain that follows no other domain; a follower has the transform of its root times a constant
//! frame. A chunk is a few modes that are stored together. With modal truncation, a domain sums only its retained
//! chunks; their counts and indices are uploaded. Without truncation, the last two parts are empty. The pinned memory
//! is write-combined: the host writes it from front to back and never reads it.

use std::sync::Arc;

use rayon::prelude::*;

use super::layout::{StepHeader, TransformLink};
use super::staging::{SliceWriter, fill_parts};
use super::work::{CoordinateLayout, DomainTiles};
use crate::storage::{Truncation, TruncationInput, bound, max_row_norms, modes_per_chunk};
use modalcast_model::scene::{Scene, SceneState};

/// Packs the modal coordinates q of a scene into the layout of the device.
#[derive(Debug)]
pub struct InputPacker {
    pub(crate) scene: Arc<Scene>,
    pub(crate) coordinates: CoordinateLayout,
    /// Per shape, the factors of its modes, by which q is multiplied; empty unless the storage type has factors.
    pub(crate) factors: Vec<Vec<f32>>,
    pub(crate) dirty_tile_layout: DirtyTileLayout,
}

/// Tiles of each domain. A partial step, which changes few domains, derives from them the list of tiles to compute, the
/// dirty tiles. A full step computes all tiles.
#[derive(Debug, Default)]
pub(crate) struct DirtyTileLayout {
    /// Per domain.
    pub domain_tiles: Vec<DomainTiles>,
    /// Number of all tiles.
    pub tile_count: usize,
    /// Cost of a full step, counted in tiles of the kernel `deform`. A step with more dirty tiles is computed as a full
    /// step. A full step may use the kernel `batch`, whose tile counts as several, because it has several domains.
    pub full_step_cost: usize,
}

/// Sizes in bytes of the parts after the header, in buffer order: 48 bytes per transform, f32 coordinates, u32 counts
/// and u16 chunk indices. Each part is padded to a multiple of 16 bytes.
#[derive(Debug, Clone, Copy)]
pub(crate) struct InputSizes {
    pub transforms: u64,
    pub q: u64,
    pub retained_counts: u64,
    /// The indices of the retained chunks.
    pub retained: u64,
}

impl InputSizes {
    pub(crate) fn of(scene: &Scene, coordinates: &CoordinateLayout) -> Self {
        let domains = scene.domains.len() as u64;
        let (truncation, chunk_modes) = (scene.features.truncation, modes_per_chunk(scene.deformation.storage));
        Self {
            transforms: 48 * scene.transform_roots.count() as u64,
            q: 4 * coordinates.total as u64,
            retained_counts: if truncation { 4 * domains.next_multiple_of(4) } else { 0 },
            retained: if truncation { 2 * (coordinates.total / chunk_modes).next_multiple_of(8) as u64 } else { 0 },
        }
    }

    pub(crate) const fn total(self) -> u64 {
        size_of::<StepHeader>() as u64 + self.transforms + self.q + self.retained_counts + self.retained
    }
}

/// Writes the values of steps in buffer order.
#[derive(Debug)]
pub struct InputWriter {
    packer: Arc<InputPacker>,
    /// The retained chunks; only with truncation.
    chunk_selection: Option<ChunkSelection>,
}

impl InputWriter {
    /// A writer of steps in the layout of `packer`.
    pub fn new(packer: &Arc<InputPacker>) -> Self {
        let chunk_selection = packer.scene.features.truncation.then(|| ChunkSelection::new(&packer.scene));
        Self { packer: Arc::clone(packer), chunk_selection }
    }

    /// Writes a full step to `buffer`, which has `InputSizes::total` bytes.
    pub fn write(&mut self, buffer: &mut [f32], header: &StepHeader, state: &SceneState) {
        let mut writer = SliceWriter::new(buffer);
        writer.put(std::slice::from_ref(header));
        writer.put(&state.transforms);
        self.packer.write_q(state, writer.take(self.packer.coordinates.total));
        if let Some(selection) = &mut self.chunk_selection {
            selection.write(&self.packer, state, &mut writer);
        }
    }

    /// Number of chunks of modes that each domain sums in the last step; `None` when all are summed.
    pub(crate) fn retained_chunk_counts(&self) -> Option<&[u32]> {
        self.chunk_selection.as_ref().map(|selection| selection.counts.as_slice())
    }

    /// Upper bound of any vertex's displacement by the truncated modes in the last step, in scene units.
    pub(crate) fn truncation_bound(&self) -> f64 {
        self.chunk_selection.as_ref().map_or(0.0, |selection| selection.bound)
    }
}

/// Per domain, the index of its transform root and that of its constant frame; empty in a scene without followers.
pub(crate) fn transform_links(scene: &Scene) -> Vec<TransformLink> {
    scene
        .transform_roots
        .root_and_frame_indices()
        .iter()
        .map(|[root, frame]| TransformLink { root: *root, frame: *frame })
        .collect()
}

impl InputPacker {
    /// A packer without factors and tiles, for measurements of the upload. Its steps have the sizes of the scene's
    /// steps, but wrong values.
    pub fn sizes_only(scene: &Arc<Scene>) -> Self {
        Self {
            scene: Arc::clone(scene),
            coordinates: CoordinateLayout::new(scene),
            factors: vec![Vec::new(); scene.shapes.len()],
            dirty_tile_layout: DirtyTileLayout::default(),
        }
    }

    /// Writes all coordinates in the layout of the device. If this layout has the order of the scene's state (U in f32,
    /// no truncation, and therefore no factors), the coordinates are copied, and the padding at the end is zeroed.
    /// Otherwise each domain is padded to whole chunks.
    fn write_q(&self, state: &SceneState, device_q: &mut [f32]) {
        if self.coordinates.is_scene_order {
            let mut writer = SliceWriter::new(device_q);
            writer.put(&state.q);
            writer.take(self.coordinates.total - state.q.len()).fill(0.0);
            return;
        }
        fill_parts(device_q, &self.coordinates.first_q, |domains, part| {
            let mut length = 0;
            for domain in domains {
                self.put_q(domain, state.q_of(&self.scene, domain), |coordinate| {
                    part[length] = coordinate;
                    length += 1;
                });
            }
            part[length..].fill(0.0);
        });
    }

    /// Passes the coordinates of one domain to `put`, multiplied by the factors of their modes. Then passes zeros up to
    /// whole chunks, unless the device has the coordinates in the order of the scene's state.
    pub(crate) fn put_q(&self, domain: usize, q: &[f32], mut put: impl FnMut(f32)) {
        let factors = &self.factors[self.scene.domains[domain].shape];
        // The factor is a power of two, so the product is exact unless it overflows or underflows f32.
        for (mode, coordinate) in q.iter().enumerate() {
            put(factors.get(mode).map_or(*coordinate, |factor| coordinate * factor));
        }
        if !self.coordinates.is_scene_order {
            let padded_length = q.len().next_multiple_of(modes_per_chunk(self.scene.deformation.storage));
            (q.len()..padded_length).for_each(|_| put(0.0));
        }
    }
}

/// Minimum number of domains per parallel task of the truncation. A domain takes a few microseconds, so that a task
/// takes much longer than starting it.
const MIN_DOMAINS_PER_TASK: usize = 64;

/// Modal truncation: selects the chunks of modes that each domain sums.
#[derive(Debug)]
struct ChunkSelection {
    /// Maximum error of a vertex, in scene units.
    budget: f64,
    /// `[shape][mode]`, from [`max_row_norms`].
    max_row_norms: Vec<Vec<f64>>,
    /// Per domain.
    truncations: Vec<Truncation>,
    /// Maximum of the error bounds of all domains, in scene units.
    bound: f64,
    /// Per domain, the number of retained chunks; padded to a multiple of four.
    counts: Vec<u32>,
    /// Indices of the retained chunks, two u16 per word. Each domain has a fixed place for all its chunks, of which the
    /// first `counts` are used. It begins at the index of the domain's first chunk among the chunks of all domains.
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

    /// Selects and writes the retained chunks: those with at least one retained mode. The truncated modes of a retained
    /// chunk are summed too, because the kernel reads whole chunks.
    fn write(&mut self, packer: &InputPacker, state: &SceneState, writer: &mut SliceWriter) {
        let scene = &packer.scene;
        let chunk_modes = modes_per_chunk(scene.deformation.storage);
        self.counts.clear();
        self.counts.resize(scene.domains.len().next_multiple_of(4), 0);
        self.chunks.clear();
        self.chunks.resize((packer.coordinates.total / chunk_modes).next_multiple_of(8) / 2, 0);
        let chunks: &mut [u16] = bytemuck::cast_slice_mut(&mut self.chunks);
        self.bound = 0.0;
        let (max_row_norms, budget) = (&self.max_row_norms, self.budget);
        let update_truncation = |(domain, truncation): (usize, &mut Truncation)| {
            // Without modes nothing can be truncated, and the norm of T does not matter.
            if scene.rank_of(domain) > 0 {
                let max_row_norms = &max_row_norms[scene.domains[domain].shape];
                let norm = bound::linear_norm_bound(&state.composed_transform(scene, domain));
                truncation.update(TruncationInput { q: state.q_of(scene, domain), max_row_norms, norm }, budget);
            }
        };
        self.truncations.par_iter_mut().enumerate().with_min_len(MIN_DOMAINS_PER_TASK).for_each(update_truncation);
        for (domain, truncation) in self.truncations.iter().enumerate() {
            self.bound = self.bound.max(truncation.bound());
            let first_chunk = packer.coordinates.first_q[domain] as usize / chunk_modes;
            let mut count = 0;
            for mode in truncation.retained() {
                let chunk = mode / chunk_modes as u16;
                if count == 0 || chunks[first_chunk + count - 1] != chunk {
                    chunks[first_chunk + count] = chunk;
                    count += 1;
                }
            }
            self.counts[domain] = count as u32;
        }
        writer.put(&self.counts);
        writer.put(&self.chunks);
    }
}

#[cfg(test)]
mod tests {
    use super::super::test_scenes::{scene, scene_with_deformation};
    use super::*;
    use modalcast_model::scene::{DeformationSettings, StorageType};

    fn packer_with_factors(scene: &Arc<Scene>) -> Arc<InputPacker> {
        let factors = vec![vec![0.5; 64]; scene.shapes.len()];
        Arc::new(InputPacker { factors, ..InputPacker::sizes_only(scene) })
    }

    fn state_with_distinct_values(scene: &Scene) -> SceneState {
        let mut state = SceneState::rest(scene);
        state.q.iter_mut().enumerate().for_each(|(index, coordinate)| *coordinate = (index % 1000) as f32);
        let transforms = state.transforms.iter_mut().enumerate();
        transforms.for_each(|(index, transform)| transform.0[3] = index as f32);
        state
    }

    /// The words of a step by a sequential reference implementation.
    fn expected_words(packer: &InputPacker, state: &SceneState) -> Vec<f32> {
        let scene = &packer.scene;
        let mut words = vec![0.0; size_of::<StepHeader>() / 4];
        words.extend(state.transforms.iter().flat_map(|transform| transform.0));
        let q_offset = words.len();
        words.resize(q_offset + packer.coordinates.total, 0.0);
        for domain in 0..scene.domains.len() {
            let first = q_offset + packer.coordinates.first_q[domain] as usize;
            for (mode, coordinate) in state.q_of(scene, domain).iter().enumerate() {
                words[first + mode] = if packer.coordinates.is_scene_order { *coordinate } else { 0.5 * coordinate };
            }
        }
        words
    }

    #[test]
    fn parallel_steps_equal_sequential_steps() {
        let f16 = DeformationSettings { storage: StorageType::F16, ..DeformationSettings::default() };
        for (shapes, cores) in [(3, 1), (3, 4), (20_000, 1), (20_000, 4)] {
            let sizes: Vec<(usize, usize)> = (0..shapes).map(|shape| (7, shape % 20)).collect();
            for scene in [scene(&sizes), scene_with_deformation(&sizes, f16)] {
                let (packer, state) = (packer_with_factors(&scene), state_with_distinct_values(&scene));
                let mut words = vec![f32::NAN; InputSizes::of(&scene, &packer.coordinates).total() as usize / 4];
                let pool = rayon::ThreadPoolBuilder::new().num_threads(cores).build().expect("a thread pool");
                pool.install(|| InputWriter::new(&packer).write(&mut words, &StepHeader::default(), &state));
                let mut expected = expected_words(&packer, &state);
                assert!(words == expected, "{shapes} shapes, {cores} cores");
                let changed_word = 24; // any word
                expected[changed_word] += 1.0;
                assert!(words != expected, "control: expected the comparison to detect a changed word");
            }
        }
    }
}
