//! A batch is a group of domains of one shape, for which the kernel `batch` reads U once. Its results have the same
//! bits as those of the kernel `deform`, which reads U once per domain.

use std::sync::Arc;

use modalcast_compute::gpu::{CudaDeformer, CudaDeformerOptions, KernelKind};
use modalcast_compute::storage::{QUAD, TILE_QUADS};
use modalcast_model::backend_settings::BatchPolicy;
use modalcast_model::domain::Transform;
use modalcast_model::scene::{DeformationSettings, NormalMethod, Scene, SceneParts, StorageType};

use crate::common::attributes::find_wrong_box;
use crate::common::followers::follower_scene_parts;
use crate::common::{assert_within_bound, run_step, scene_of_shapes, strip_shape};
use crate::instanced_scenes::{instanced_parts, random_states, with_storage};
use crate::reference_comparison::cuda_deformer_with_batches;
use crate::scenes::{self, Random};

/// Deformers of a scene, with batches and without.
fn batched_and_separate(scene: &Arc<Scene>) -> [CudaDeformer; 2] {
    [BatchPolicy::Always, BatchPolicy::Never].map(|batches| cuda_deformer_with_batches(scene, batches))
}

fn build_scene(parts: SceneParts) -> Arc<Scene> {
    Scene::new(parts).expect("expected a valid scene")
}

/// Deforms three states of a scene with batches and without, and returns the number of states whose results differ in a
/// bit.
fn count_differing_states(name: &str, scene: &Arc<Scene>) -> usize {
    let [mut batched_deformer, mut separate_deformer] = batched_and_separate(scene);
    assert!(batched_deformer.plan().kernel(KernelKind::Batch).is_some(), "{name}: expected a batch kernel");
    assert!(separate_deformer.plan().kernel(KernelKind::Batch).is_none(), "{name}: expected no batch kernel");
    // `batch`, `deform`, `bounds` and `normals`.
    assert!(batched_deformer.plan().launches() <= 4, "{name}");
    let states = random_states(scene);
    let mut differing_states = 0;
    for state in &states {
        let (result, want) = (run_step(&mut batched_deformer, state), run_step(&mut separate_deformer, state));
        if result.bounds.is_finite() {
            assert_within_bound(name, scene, state, &result.surface.positions);
            assert!(result.surface.boxes.is_empty() || find_wrong_box(scene, &result).is_none(), "{name}");
        }
        let difference = result.difference(&want);
        difference.iter().for_each(|difference| eprintln!("{name}: {difference}"));
        let changes_vertices = run_step(&mut separate_deformer, &states[0]).difference(&result).is_some();
        assert!(changes_vertices || state.q == states[0].q, "{name}: expected the state to change vertices");
        differing_states += usize::from(difference.is_some());
    }
    differing_states
}

/// Each case is a scene with `domains` domains of one shape, which has `vertices` vertices and `rank` modes.
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_batches_have_the_bits_of_separate_domains() {
    for storage in StorageType::ALL {
        for (vertices, rank, domains) in [
            (1, 3, 2),
            (33, 1, 2),
            (64, 1, 16),
            (127, 4, 5),
            (128, 33, 16),
            (129, 16, 8),
            (261, 12, 40),
            (2000, 32, 16),
            (5003, 512, 13),
        ] {
            let deformation = DeformationSettings { boxes: true, ..with_storage(storage) };
            let name = format!("{} n {vertices}, r {rank}, {domains} domains", storage.name());
            let scene = build_scene(instanced_parts(vertices, rank, domains, deformation));
            assert_eq!(count_differing_states(&name, &scene), 0, "{name}");
        }
    }
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_multi_tile_blocks_have_the_bits_of_separate_domains() {
    // More than 8,192 tiles of 128 vertices. `batch` has about 4,096 thread blocks, so a block computes several tiles.
    // The last tile is partly filled.
    for (storage, vertices) in
        [(StorageType::F32, 1_100_007), (StorageType::Int8, 1_100_007), (StorageType::F16, 1_600_001)]
    {
        let name = format!("{} n {vertices}", storage.name());
        let deformation = DeformationSettings { boxes: true, ..with_storage(storage) };
        let scene = build_scene(instanced_parts(vertices, 5, 3, deformation));
        let options = CudaDeformerOptions { batches: BatchPolicy::Always, ..CudaDeformerOptions::default() };
        let blocks = modalcast_compute::gpu::plan(&scene, options)
            .kernel(KernelKind::Batch)
            .expect("expected a batch kernel")
            .blocks as usize;
        // A tile has TILE_QUADS quads, and a quad has QUAD vertices.
        let tiles = vertices.div_ceil(QUAD * TILE_QUADS);
        assert!(2 * blocks <= tiles + 1, "{name}: expected at most one block per two tiles, got {blocks} blocks");
        assert_eq!(count_differing_states(&name, &scene), 0, "{name}");
    }
}

/// Scenes with exact normals, normal maps, boxes and followers that also contain unbatched domains.
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_batches_have_the_bits_of_separate_domains_with_features() {
    let with_exact_normals = |storage| DeformationSettings { normals: NormalMethod::Exact, ..with_storage(storage) };
    let mixed_parts = |deformation: DeformationSettings, normal_maps: bool| {
        let mut random = Random(70);
        let sizes = [(300, 33), (40, 0), (7, 2), (513, 5), (200, 0), (130, 1)];
        let shapes = sizes.iter().enumerate().map(|(index, (vertices, rank))| match index % 2 {
            0 => strip_shape(&mut random, *vertices, *rank),
            _ => scenes::random_shape(&mut random, *vertices, *rank),
        });
        // 19 domains per shape. `parts` gets copies of the shapes and domains of this scene.
        let scene = scene_of_shapes(shapes.collect(), 19, deformation, normal_maps);
        let mut parts = scenes::parts_of_shapes(scene.shapes.clone());
        (parts.domains, parts.deformation) = (scene.domains.clone(), deformation);
        // A domain that is not batched, because its shape has no other domain.
        parts.shapes.push(scenes::random_shape(&mut random, 90, 9));
        parts.domains.push(scenes::new_domain(sizes.len(), scenes::PLAIN_MATERIAL));
        parts
    };
    for (deformation, normal_maps) in [
        (with_storage(StorageType::F32), true),
        (with_storage(StorageType::F16), false),
        (with_exact_normals(StorageType::F32), true),
        (with_exact_normals(StorageType::Int8), false),
        (DeformationSettings { boxes: true, ..with_storage(StorageType::Bf16) }, true),
    ] {
        let name = format!("{deformation:?}, normal maps {normal_maps}");
        assert_eq!(count_differing_states(&name, &build_scene(mixed_parts(deformation, normal_maps))), 0, "{name}");
        // Covers followers with and without shear.
        let is_rigid = !normal_maps;
        let name = format!("followers, {name}");
        assert_eq!(
            count_differing_states(&name, &build_scene(follower_scene_parts(90, deformation, is_rigid))),
            0,
            "{name}"
        );
    }
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_batches_repair_intermediate_overflow() {
    for vertices in [300, 512] {
        let deformation = DeformationSettings { boxes: true, ..DeformationSettings::default() };
        let scene = build_scene(instanced_parts(vertices, 5, 6, deformation));
        let [mut batched_deformer, mut separate_deformer] = batched_and_separate(&scene);
        let mut state = scenes::random_state(&scene, 4);
        // A domain has five coordinates. The sum of domain 1 overflows. The products of domain 3 overflow in f32,
        // although their sum may be finite.
        state.q[5..10].fill(f32::MAX);
        state.transforms[3] = Transform([2e38, 2e38, -2e38, 0.0, 3e38, -3e38, 3e38, 0.0, 1e38, 1e38, 1e38, 0.0]);
        state.q[15..20].fill(3.0);
        let [got, want] =
            [&mut batched_deformer, &mut separate_deformer].map(|deformer| run_step(deformer, &state).surface);
        assert!(want.positions.iter().any(|number| !number.is_finite()), "expected an overflow");
        for (index, (got, want)) in got.positions.iter().zip(&want.positions).enumerate() {
            let is_equal = got.to_bits() == want.to_bits() || got.is_nan() && want.is_nan();
            assert!(is_equal, "vertex {}: expected {want}, got {got}", index / 3);
        }
        for (domain, (got, want)) in got.boxes.iter().zip(&want.boxes).enumerate() {
            assert_eq!(got.is_finite(), want.is_finite(), "the box of domain {domain}");
            assert!(!want.is_finite() || got == want, "the box of domain {domain}");
        }
        assert_eq!(
            [0, 1].map(|domain| got.boxes[domain].is_finite()),
            [true, false],
            "expected domain 1 to overflow, and domain 0 not to overflow"
        );
    }
}
