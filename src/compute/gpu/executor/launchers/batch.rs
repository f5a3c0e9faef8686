//! Launches `kernels/batch.cu`: x = T_b (x0 + U q_b) for groups of domains b that share a shape (mesh and U). The
//! kernel reads U once per group, and also computes bounding boxes of x.

use cudarc::driver::sys::CUfunction_attribute;
use cudarc::driver::{CudaFunction, LaunchConfig};

use crate::gpu::executor::inputs::InputAddresses;
use crate::gpu::launch::error::cuda_error;
use crate::gpu::launch::{Device, DeviceBuffer, KernelDescriptor, LaunchOrder, launch_kernel};
use crate::gpu::tables::kernels::batch_shared_bytes;
use crate::gpu::tables::layout::BatchArgs;
use crate::gpu::tables::work::batches::BatchTables;
use modalcast_model::error::Result;

/// The kernel and its work list.
#[derive(Debug)]
pub(super) struct BatchKernel {
    pub function: CudaFunction,
    config: LaunchConfig,
    blocks: DeviceBuffer,
    groups: DeviceBuffer,
    members: DeviceBuffer,
}

/// Buffers of `deform` that `batch` reads and writes.
#[derive(Debug, Clone, Copy)]
pub(super) struct SharedTables<'a> {
    pub words: &'a DeviceBuffer,
    pub rest_positions: &'a DeviceBuffer,
    pub scales: &'a DeviceBuffer,
    pub boxes: &'a DeviceBuffer,
}

impl BatchKernel {
    /// Compiles the kernel and uploads its work list.
    pub(super) fn new(device: &Device, kernel: &KernelDescriptor, batched: &BatchTables) -> Result<Self> {
        let function = kernel.compile(device)?;
        let shared_bytes = batch_shared_bytes(batched, &kernel.defines);
        // Give all of the L1 cache (100 percent) to shared memory, so that registers alone limit the number of resident
        // blocks.
        let carveout = CUfunction_attribute::CU_FUNC_ATTRIBUTE_PREFERRED_SHARED_MEMORY_CARVEOUT;
        let max_shared_bytes = CUfunction_attribute::CU_FUNC_ATTRIBUTE_MAX_DYNAMIC_SHARED_SIZE_BYTES;
        for (attribute, value) in [(carveout, 100), (max_shared_bytes, shared_bytes as i32)] {
            function.set_attribute(attribute, value).map_err(cuda_error("batch"))?;
        }
        Ok(Self {
            function,
            config: LaunchConfig { shared_mem_bytes: shared_bytes as u32, ..kernel.config() },
            blocks: DeviceBuffer::upload(device, &batched.blocks)?,
            groups: DeviceBuffer::upload(device, &batched.groups)?,
            members: DeviceBuffer::upload(device, &batched.members)?,
        })
    }

    /// Starts the kernel.
    ///
    /// # Safety
    /// `values` and `shared` belong to the scene of this launcher. The header has the address of the positions of this
    /// scene. All of these buffers exist until the kernel has ended.
    pub(super) unsafe fn launch(
        &self,
        device: &Device,
        values: InputAddresses,
        shared: SharedTables<'_>,
    ) -> Result<()> {
        let args = BatchArgs {
            header: values.header,
            blocks: self.blocks.address(),
            groups: self.groups.address(),
            members: self.members.address(),
            words: shared.words.address(),
            rest_positions: shared.rest_positions.address(),
            scales: shared.scales.address(),
            transforms: values.transforms,
            transform_links: values.transform_links,
            follower_frames: values.follower_frames,
            q: values.q,
            boxes: shared.boxes.address(),
        };
        // SAFETY: the kernel's only argument is a `BatchArgs`. Blocks refer to groups and groups to members. Groups and
        // members refer to the words, x0, scales, transforms, q and boxes of `WorkList`, from which the buffers were
        // made. A group has no more members than the kernel was compiled for, and shared memory has capacity for the
        // longest group. The caller guarantees the positions.
        unsafe { launch_kernel(device, &self.function, self.config, LaunchOrder::Serial, &args) }
    }
}

#[cfg(test)]
mod warp;

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::warp::{Tables, Warp};
    use crate::gpu::launch::KernelKind;
    use crate::gpu::tables::device_tables::CudaDeformerOptions;
    use crate::gpu::tables::plan::{BufferRole, plan};
    use crate::gpu::tables::test_scenes::scene_with_matching_corners;
    use crate::gpu::tables::work::{CoordinateLayout, WorkList};
    use crate::testing::{TestRng, scene_and_state, transformed_axis};
    use modalcast_model::backend_settings::BatchPolicy;
    use modalcast_model::scene::{DeformationSettings, Scene, SceneParts, SceneState, StorageType};

    /// A scene of random shapes, one for each (vertices, rank) of `shapes`, and a random state. `instances` domains use
    /// each shape: domain i uses shape `i % shapes.len()`.
    fn instanced_scene(storage: StorageType, shapes: &[(usize, usize)], instances: usize) -> (Arc<Scene>, SceneState) {
        let shapes_scene =
            scene_and_state(&shapes.iter().map(|(vertices, rank)| (*vertices, *rank, 1)).collect::<Vec<_>>()).0;
        let mut parts = SceneParts::named("instances");
        (parts.shapes, parts.materials) = (shapes_scene.shapes.clone(), shapes_scene.materials.clone());
        parts.deformation = DeformationSettings { storage, ..DeformationSettings::default() };
        parts.domains =
            (0..instances * shapes.len()).map(|index| shapes_scene.domains[index % shapes.len()].clone()).collect();
        let scene = Scene::new(parts).expect("a valid scene");
        let (mut rng, mut state) = (TestRng(instances as u64), SceneState::rest(&scene));
        state.q.iter_mut().for_each(|coordinate| *coordinate = rng.next());
        state.transforms.iter_mut().for_each(|transform| transform.0 = [0; 12].map(|_| rng.next()));
        (scene, state)
    }

    /// Emulates `batch` block by block. Returns the positions; those that it does not write are NaN.
    fn twin_of_batch(tables: &Tables) -> Vec<f32> {
        let mut positions = vec![f32::NAN; 3 * tables.scene.layout.vertices];
        let tiles = tables
            .work
            .batched
            .blocks
            .iter()
            .flat_map(|block| (block.first_tile..block.end_tile).map(|tile| (block.group, tile)));
        // The two warps of a block compute the halves of a tile, and store the positions of two members at a time.
        for (group_and_tile, warp) in tiles.flat_map(|group_and_tile| [0, 1].map(|warp| (group_and_tile, warp))) {
            let mut warp = Warp::new(tables, group_and_tile, warp);
            if warp.quads > 0 {
                let sums = warp.sums();
                for member in (0..warp.group.member_count as usize).step_by(2) {
                    warp.store(&warp.staged(&sums, member), member, &mut positions);
                }
            }
        }
        positions
    }

    /// x of a vertex by the same arithmetic as in the kernel, directly from the U of the shape.
    fn x_of(scene: &Scene, state: &SceneState, domain: usize, vertex: usize) -> [f32; 3] {
        let (shape, q) = (scene.shape_of(domain), state.q_of(scene, domain));
        let rest = shape.mesh.rest_positions()[vertex];
        let deformed = [0, 1, 2].map(|axis| {
            let entry = |(mode, q): (usize, &f32)| (shape.modes.entry(vertex, axis, mode), *q);
            rest[axis] + q.iter().enumerate().map(entry).fold(0.0_f32, |sum, (entry, q)| entry.mul_add(q, sum))
        });
        [0, 1, 2].map(|row| transformed_axis(&state.transforms[domain].0[4 * row..], deformed))
    }

    /// The scenes of the tests: (vertices, rank) of each shape, and the number of domains that use each shape. A warp
    /// computes 64 vertices, a tile has 128 vertices, and a group has at most 16 domains.
    const INSTANCED_SCENES: [(&[(usize, usize)], usize); 6] = [
        (&[(1, 3), (63, 13)], 2),
        (&[(64, 4), (300, 0)], 16),
        (&[(65, 16), (128, 32), (7, 1)], 3),
        (&[(129, 5)], 8),
        (&[(192, 17), (256, 33)], 21),
        (&[(261, 12), (320, 50)], 40),
    ];

    #[test]
    fn batch_positions_are_bit_identical_to_plain_sums() {
        for (shapes, instances) in INSTANCED_SCENES {
            let (scene, state) = instanced_scene(StorageType::F32, shapes, instances);
            let got = twin_of_batch(&Tables::of(&scene, &state));
            for (domain, layout) in scene.layout.domains.iter().enumerate() {
                for vertex in 0..layout.vertices {
                    let got = &got[3 * (layout.first_vertex + vertex)..][..3];
                    if layout.rank == 0 {
                        assert!(
                            got.iter().all(|number| number.is_nan()),
                            "expected rigid domains to be left to `deform`"
                        );
                        continue;
                    }
                    let bits = |x: &[f32]| x.iter().map(|number| number.to_bits()).collect::<Vec<_>>();
                    assert_eq!(bits(got), bits(&x_of(&scene, &state, domain, vertex)), "{shapes:?} {domain} {vertex}");
                    // Control: the next domain of the same shape has other coordinates and another transform.
                    let other_domain = (domain + shapes.len()) % scene.domains.len();
                    assert_ne!(bits(got), bits(&x_of(&scene, &state, other_domain, vertex)));
                }
            }
        }
    }

    #[test]
    fn batch_decodes_entries_of_every_storage() {
        // Tolerances for f32, f16, bf16 and int8. Entries and coordinates are random numbers from -1 to 1. Storage
        // rounds an entry by at most 2^-12 (f16), 2^-9 (bf16) or 1/254 (int8), and the errors of up to 50 modes partly
        // cancel. A wrong entry would typically change x by some tenths.
        for (storage, tolerance) in StorageType::ALL.into_iter().zip([1e-5, 1e-2, 8e-2, 8e-2]) {
            for (shapes, instances) in INSTANCED_SCENES {
                let (scene, state) = instanced_scene(storage, shapes, instances);
                let got = twin_of_batch(&Tables::of(&scene, &state));
                for (domain, layout) in scene.layout.domains.iter().enumerate().filter(|(_, layout)| layout.rank > 0) {
                    for vertex in 0..layout.vertices {
                        let got = &got[3 * (layout.first_vertex + vertex)..][..3];
                        let expected = x_of(&scene, &state, domain, vertex);
                        let is_close =
                            got.iter().zip(expected).all(|(got, expected)| (got - expected).abs() < tolerance);
                        assert!(is_close, "{storage:?} {shapes:?}: expected {expected:?}, got {got:?}");
                    }
                }
            }
        }
    }

    #[test]
    fn groups_have_similar_sizes_and_are_adjacent_within_a_tile() {
        // A shape of 261 vertices has three tiles. Its 40 domains need three groups of at most 16.
        let (scene, _) = instanced_scene(StorageType::F32, &[(261, 12)], 40);
        let work = WorkList::new(&scene, &CoordinateLayout::new(&scene), BatchPolicy::Always);
        let sizes: Vec<u32> = work.batched.groups.iter().map(|group| group.member_count).collect();
        assert_eq!(sizes, [14, 14, 12]);
        let blocks: Vec<(u32, u32)> = work.batched.blocks.iter().map(|block| (block.first_tile, block.group)).collect();
        assert_eq!(blocks, [(0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (1, 2), (2, 0), (2, 1), (2, 2)]);
        assert_eq!(
            (work.full_step_tiles, work.tiles.len()),
            (120, 240),
            "expected three corner tiles and three vertex tiles per domain"
        );
        let members: Vec<u32> = work.batched.members.iter().map(|member| member.first_tile).collect();
        assert!(
            members.iter().zip(&work.domain_tiles).all(|(first, tiles)| *first == tiles.vertices.first),
            "expected the first vertex tile of each domain, which locates its boxes"
        );
    }

    #[test]
    fn blocks_of_large_scenes_cover_each_tile_once() {
        // 6001 + 3000 tiles of 128 vertices are more than twice `TARGET_BLOCKS`, but less than three times.
        let (scene, _) = instanced_scene(StorageType::F32, &[(128 * 6001, 1), (128 * 3000, 1)], 2);
        let batched = WorkList::new(&scene, &CoordinateLayout::new(&scene), BatchPolicy::Always).batched;
        assert!(
            batched.blocks.iter().all(|block| (1..=2).contains(&(block.end_tile - block.first_tile))),
            "expected one or two tiles per block"
        );
        for (group, tiles) in [6001, 3000].into_iter().enumerate() {
            let group_blocks = batched.blocks.iter().filter(|block| block.group == group as u32);
            let covered: Vec<u32> = group_blocks.flat_map(|block| block.first_tile..block.end_tile).collect();
            assert_eq!(covered, (0..tiles).collect::<Vec<u32>>());
        }
    }

    #[test]
    fn batch_variant_fits_the_number_of_instances() {
        let defines = |instances: usize| {
            let options = CudaDeformerOptions { batches: BatchPolicy::Always, ..CudaDeformerOptions::default() };
            let plan = plan(&instanced_scene(StorageType::F16, &[(261, 12)], instances).0, options);
            let kernel = plan.kernel(KernelKind::Batch).expect("a batch kernel").clone();
            (kernel.defines.join(" "), kernel.blocks)
        };
        // A block per tile and group: three tiles, and two groups for 17 domains.
        assert_eq!(defines(2), ("STORE_F16 BATCH_4".into(), 3));
        assert_eq!(defines(8), ("STORE_F16 BATCH_8".into(), 3));
        assert_eq!(defines(17), ("STORE_F16".into(), 6));
        let unbatched = plan(&scene_with_matching_corners(&[(261, 12)]), CudaDeformerOptions::default());
        assert!(unbatched.kernel(KernelKind::Batch).is_none(), "expected no batch of a single domain");
        assert_eq!(unbatched.bytes(BufferRole::Batches), 0);
    }
}
