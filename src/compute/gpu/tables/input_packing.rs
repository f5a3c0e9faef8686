//! The input values of a step, in the layout of the device buffer. The host writes them to pinned memory, with several
//! cores if the step is large.
//!
//! ```text
//! [header][transforms: 12 f32 per transform root][q, padded to whole chunks]
//! ```
//! A transform root is a domain that follows no other domain; a follower has the transform of its root times a constant
//! frame. A chunk is a few modes that are stored together. The pinned memory is write-combined: the host writes it from
//! front to back and never reads it.

use std::sync::Arc;

use super::layout::{StepHeader, TransformLink};
use super::staging::{SliceWriter, fill_parts};
use super::work::{CoordinateLayout, DomainTiles};
use modalcast_model::scene::{Scene, SceneState};

/// Writes the input values of a scene's steps in the layout of the device.
#[derive(Debug)]
pub struct InputPacker {
    pub(crate) scene: Arc<Scene>,
    pub(crate) coordinates: CoordinateLayout,
    /// Per coordinate of the device, the factor by which q is multiplied (`CoordinateLayout::spread_factors`); empty
    /// unless the storage type has factors.
    pub(crate) factors: Vec<f32>,
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

/// Sizes in bytes of the parts after the header, in buffer order: 48 bytes per transform, and f32 coordinates. Each
/// part is padded to a multiple of 16 bytes.
#[derive(Debug, Clone, Copy)]
pub(crate) struct InputSizes {
    pub transforms: u64,
    pub q: u64,
}

impl InputSizes {
    pub(crate) fn of(scene: &Scene, coordinates: &CoordinateLayout) -> Self {
        Self { transforms: 48 * scene.transform_roots.count() as u64, q: 4 * coordinates.total as u64 }
    }

    pub(crate) const fn total(self) -> u64 {
        size_of::<StepHeader>() as u64 + self.transforms + self.q
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
            factors: Vec::new(),
            dirty_tile_layout: DirtyTileLayout::default(),
        }
    }

    /// Writes a full step to `buffer`, which has `InputSizes::total` bytes.
    pub fn write(&self, buffer: &mut [f32], header: &StepHeader, state: &SceneState) {
        let mut writer = SliceWriter::new(buffer);
        writer.put(std::slice::from_ref(header));
        writer.put(&state.transforms);
        self.write_q(state, writer.take(self.coordinates.total));
    }

    /// Writes all coordinates in the layout of the device. If this layout has the order of the scene's state (U in f32,
    /// and therefore no factors), the coordinates are copied, and the padding at the end is zeroed. Otherwise each
    /// domain is padded to whole chunks.
    fn write_q(&self, state: &SceneState, device_q: &mut [f32]) {
        if self.coordinates.is_scene_order {
            let mut writer = SliceWriter::new(device_q);
            writer.put(&state.q);
            writer.take(self.coordinates.total - state.q.len()).fill(0.0);
            return;
        }
        fill_parts(
            device_q,
            &self.coordinates.ranges,
            |range| range.first_q,
            |ranges, part| {
                let mut length = 0;
                for range in ranges {
                    let q = &state.q[range.scene_first_q..][..range.rank];
                    length += self.put_q(range.first_q, q, &mut part[length..]);
                }
                part[length..].fill(0.0);
            },
        );
    }

    /// Writes the coordinates of one domain, multiplied by the factors of their modes, to the beginning of `target`, and
    /// then zeros up to whole chunks, unless the device has the coordinates in the order of the scene's state. Returns
    /// the number of written words. `first_q` is the offset of the domain's first coordinate on the device.
    pub(crate) fn put_q(&self, first_q: usize, q: &[f32], target: &mut [f32]) -> usize {
        let (coordinates, padding) = target[..self.coordinates.padded_rank(&self.scene, q.len())].split_at_mut(q.len());
        if self.factors.is_empty() {
            coordinates.copy_from_slice(q);
        } else {
            // A factor is a power of two, so a product is exact unless it overflows or underflows f32.
            let factored = q.iter().zip(&self.factors[first_q..]);
            coordinates.iter_mut().zip(factored).for_each(|(word, (coordinate, factor))| *word = coordinate * factor);
        }
        padding.fill(0.0);
        q.len() + padding.len()
    }
}

#[cfg(test)]
mod tests {
    use super::super::test_scenes::scene_with_storage;
    use super::*;
    use modalcast_model::domain::Shape;
    use modalcast_model::scene::StorageType;

    /// A factor that differs from those of the shape's other modes and of the next shapes.
    fn factor(shape: usize, mode: usize) -> f32 {
        (-((7 * shape + mode) as f32 % 50.0)).exp2()
    }

    fn has_factors(scene: &Scene) -> bool {
        matches!(scene.deformation.storage, StorageType::F16 | StorageType::Bf16)
    }

    fn packer_with_factors(scene: &Arc<Scene>) -> InputPacker {
        let packer = InputPacker::sizes_only(scene);
        let factors_of = |(shape, data): (usize, &Shape)| -> Vec<f32> {
            (0..data.modes.rank()).filter(|_| has_factors(scene)).map(|mode| factor(shape, mode)).collect()
        };
        let shape_factors: Vec<Vec<f32>> = scene.shapes.iter().enumerate().map(factors_of).collect();
        let factors = packer.coordinates.spread_factors(scene, &shape_factors);
        InputPacker { factors, ..packer }
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
                let factor = if has_factors(scene) { factor(scene.domains[domain].shape, mode) } else { 1.0 };
                words[first + mode] = factor * coordinate;
            }
        }
        words
    }

    #[test]
    fn parallel_steps_equal_sequential_steps() {
        for (shapes, cores) in [(3, 1), (3, 4), (20_000, 1), (20_000, 4)] {
            let sizes: Vec<(usize, usize)> = (0..shapes).map(|shape| (7, shape % 20)).collect();
            for storage in [StorageType::F32, StorageType::F16, StorageType::Int8] {
                let scene = scene_with_storage(&sizes, storage);
                let (packer, state) = (packer_with_factors(&scene), state_with_distinct_values(&scene));
                let mut words = vec![f32::NAN; InputSizes::of(&scene, &packer.coordinates).total() as usize / 4];
                let pool = rayon::ThreadPoolBuilder::new().num_threads(cores).build().expect("a thread pool");
                pool.install(|| packer.write(&mut words, &StepHeader::default(), &state));
                let mut expected = expected_words(&packer, &state);
                assert!(words == expected, "{storage:?}, {shapes} shapes, {cores} cores");
                let changed_word = 24; // any word
                expected[changed_word] += 1.0;
                assert!(words != expected, "control: expected the comparison to detect a changed word");
            }
        }
    }
}
