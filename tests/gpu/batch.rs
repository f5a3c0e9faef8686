//! Batches read U once for many coordinate vectors: each instance has the bits that it has without batches.

use std::sync::Arc;

use modalcast_compute::gpu::KernelKind;
use modalcast_compute::storage::{QUAD, TILE_QUADS};
use modalcast_model::domain::Transform;
use modalcast_model::scene::{BatchPolicy, DeformationSettings, NormalMethod, Scene, SceneParts, StorageType};

use crate::both::following::grove;
use crate::both::readers::wrong_box;
use crate::both::{run, scene_of, strip, within};
use crate::ensembles::{ensemble, states, stored};
use crate::scenes::{self, Random};
use crate::twins::deformer;

/// The scene with batches and without.
fn both(mut parts: impl FnMut() -> SceneParts) -> [Arc<Scene>; 2] {
    [BatchPolicy::Always, BatchPolicy::Never].map(|batches| {
        let mut parts = parts();
        parts.deformation.batches = batches;
        Scene::new(parts).expect("a scene")
    })
}

/// Deforms states of a scene with batches and without, and returns the number of states with a differing bit.
fn differences(name: &str, [together, apart]: &[Arc<Scene>; 2]) -> usize {
    let (mut one, mut other) = (deformer(together), deformer(apart));
    assert!(one.plan().kernel(KernelKind::Batch).is_some(), "{name}: there is a batch");
    assert!(other.plan().kernel(KernelKind::Batch).is_none(), "{name}: there is none");
    assert!(one.plan().launches() <= 4, "{name}");
    let states = states(together);
    let count = states.iter().filter(|state| {
        let (shown, want) = (run(&mut one, state), run(&mut other, state));
        if shown.bounds.is_finite() {
            within(name, (together, state), &shown.surface.positions, 0.0);
            assert!(shown.surface.boxes.is_empty() || wrong_box(together, &shown).is_none(), "{name}");
        }
        let difference = shown.difference(&want);
        difference.iter().for_each(|difference| eprintln!("{name}: {difference}"));
        let moved = run(&mut other, &states[0]).difference(&shown).is_some();
        assert!(moved || state.q == states[0].q, "{name}: the judge can fail");
        difference.is_some()
    });
    count.count()
}

/// For every size, rank, number of instances and storage type.
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_batches_have_the_bits_of_separate_domains() {
    for storage in StorageType::ALL {
        for size in [
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
            let deformation = DeformationSettings { boxes: true, ..stored(storage) };
            let name = format!("{} n, r, domains {size:?}", storage.name());
            assert_eq!(differences(&name, &both(|| ensemble(size, deformation))), 0, "{name}");
        }
    }
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_multi_tile_blocks_have_the_bits_of_separate_domains() {
    // More than 8,192 tiles, so that a block has two or three of them; the last tile is not full.
    for (storage, vertices) in
        [(StorageType::F32, 1_100_007), (StorageType::Int8, 1_100_007), (StorageType::F16, 1_600_001)]
    {
        let name = format!("{} n {vertices}", storage.name());
        let scenes = both(|| ensemble((vertices, 5, 3), DeformationSettings { boxes: true, ..stored(storage) }));
        let blocks =
            modalcast_compute::gpu::plan(&scenes[0]).kernel(KernelKind::Batch).expect("a batch").blocks as usize;
        assert!(2 * blocks <= vertices.div_ceil(QUAD * TILE_QUADS) + 1, "{name}: {blocks} blocks");
        assert_eq!(differences(&name, &scenes), 0, "{name}");
    }
}

/// With exact normals, normal maps, boxes and followers, in scenes that contain other domains too.
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_batches_agree_with_every_feature_of_a_scene() {
    let exact = |storage| DeformationSettings { normals: NormalMethod::Exact, ..stored(storage) };
    let crowd = |deformation: DeformationSettings, normal_maps: bool| {
        let mut random = Random(70);
        let sizes = [(300, 33), (40, 0), (7, 2), (513, 5), (200, 0), (130, 1)];
        let shapes = sizes.iter().enumerate().map(|(at, (vertices, rank))| match at % 2 {
            0 => strip(&mut random, *vertices, *rank),
            _ => scenes::shape(&mut random, *vertices, *rank),
        });
        let scene = scene_of(shapes.collect(), 19, deformation, normal_maps);
        let mut parts = scenes::parts(scene.shapes.clone());
        (parts.domains, parts.deformation) = (scene.domains.clone(), deformation);
        // A domain whose shape has no other instance.
        parts.shapes.push(scenes::shape(&mut random, 90, 9));
        parts.domains.push(scenes::domain(sizes.len(), 0));
        parts
    };
    for (deformation, normal_maps) in [
        (stored(StorageType::F32), true),
        (stored(StorageType::F16), false),
        (exact(StorageType::F32), true),
        (exact(StorageType::Int8), false),
        (DeformationSettings { boxes: true, ..stored(StorageType::Bf16) }, true),
    ] {
        let name = format!("{deformation:?}, normal maps {normal_maps}");
        assert_eq!(differences(&name, &both(|| crowd(deformation, normal_maps))), 0, "{name}");
        let name = format!("followers, {name}");
        assert_eq!(differences(&name, &both(|| grove(90, deformation, !normal_maps))), 0, "{name}");
    }
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_batches_repair_intermediate_overflow() {
    for vertices in [300, 512] {
        let [together, apart] =
            both(|| ensemble((vertices, 5, 6), DeformationSettings { boxes: true, ..DeformationSettings::default() }));
        let (mut one, mut other) = (deformer(&together), deformer(&apart));
        let mut state = scenes::state(&together, 4);
        // The sum of domain 1 overflows. The products of domain 3 overflow too, although their sum may be finite.
        state.q[5..10].fill(f32::MAX);
        state.transforms[3] = Transform([2e38, 2e38, -2e38, 0.0, 3e38, -3e38, 3e38, 0.0, 1e38, 1e38, 1e38, 0.0]);
        state.q[15..20].fill(3.0);
        let [got, want] = [&mut one, &mut other].map(|deformer| run(deformer, &state).surface);
        assert!(want.positions.iter().any(|number| !number.is_finite()), "something overflows");
        for (index, (got, want)) in got.positions.iter().zip(&want.positions).enumerate() {
            let same = got.to_bits() == want.to_bits() || got.is_nan() && want.is_nan();
            assert!(same, "vertex {}: {got} not {want}", index / 3);
        }
        for (domain, (got, want)) in got.boxes.iter().zip(&want.boxes).enumerate() {
            assert_eq!(got.is_finite(), want.is_finite(), "the box of domain {domain}");
            assert!(!want.is_finite() || got == want, "the box of domain {domain}");
        }
        assert_eq!([0, 1].map(|domain| got.boxes[domain].is_finite()), [true, false], "boxes tell who is lost");
    }
}
