//! Positions, normals and tangents of the CUDA deformer equal those of the f64 reference, for scenes of many sizes.

use std::sync::Arc;

use modalcast_compute::gpu::{CudaDeformer, CudaDeformerOptions, Device};
use modalcast_model::backend_settings::BatchPolicy;
use modalcast_model::deform::Deformer;
use modalcast_model::scene::{Scene, SceneState};

use crate::accuracy::{assert_equals_reference, have_equal_bits};
use crate::scenes::{self, NORMAL_MAPPED_MATERIAL, Random};

pub(crate) fn cuda_deformer(scene: &Arc<Scene>) -> CudaDeformer {
    cuda_deformer_with_batches(scene, BatchPolicy::default())
}

pub(crate) fn cuda_deformer_with_batches(scene: &Arc<Scene>, batches: BatchPolicy) -> CudaDeformer {
    let device = Device::open(0).expect("expected a CUDA device");
    let options = CudaDeformerOptions { batches, bounding_axes: scene.light_axes() };
    CudaDeformer::new(&device, scene, None, options).expect("expected a CUDA deformer")
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_vertices_equal_reference_at_every_size_and_rank() {
    for vertices in [1, 31, 32, 33, 257, 16085] {
        for rank in [0, 1, 3, 20, 31, 33, 64, 512] {
            let scene = scenes::random_scene(
                &[(vertices, rank)],
                scenes::RandomSceneOptions { instances: 3, normal_maps: rank % 2 == 1, rigid_transforms: false },
            );
            let mut deformer = cuda_deformer(&scene);
            assert_equals_reference(
                &format!("n {vertices} r {rank}"),
                &scene,
                &scenes::random_state(&scene, 5),
                &mut deformer,
            );
        }
    }
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_every_feature_combination_equals_the_reference() {
    // Each of the eight sets has one bit per feature.
    for (modes, normal_maps, rigid_transforms) in (0..8).map(|set| (set & 1 != 0, set & 2 != 0, set & 4 != 0)) {
        let rank = if modes { 5 } else { 0 };
        let scene = scenes::random_scene(
            &[(300, rank), (40, 0), (7, rank)],
            scenes::RandomSceneOptions { instances: 4, normal_maps, rigid_transforms },
        );
        assert_eq!(
            (scene.features.modes, scene.features.normal_maps, scene.features.shear),
            (modes, normal_maps, !rigid_transforms)
        );
        let mut deformer = cuda_deformer(&scene);
        // `deform`, `bounds` and at most two of `batch`, `normals` and `apply`.
        assert!(deformer.plan().launches() <= 4);
        let name = format!("modes {modes} normal maps {normal_maps} rigid {rigid_transforms}");
        assert_equals_reference(&name, &scene, &scenes::random_state(&scene, 9), &mut deformer);
        assert_eq!(deformer.surface().expect("expected a surface").tangents.is_empty(), !normal_maps);
    }
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_twenty_thousand_small_domains_take_three_launches() {
    let shapes: Vec<_> = (0..50).map(|index| (7, index % 5)).collect();
    let scene = scenes::random_scene(
        &shapes,
        scenes::RandomSceneOptions { instances: 400, normal_maps: true, rigid_transforms: false },
    );
    let mut deformer = cuda_deformer(&scene);
    // The launches are `deform`, `bounds`, and `apply` or `batch`.
    assert_eq!((scene.domains.len(), deformer.plan().launches()), (20_000, 3));
    let state = scenes::random_state(&scene, 3);
    assert_equals_reference("20,000 domains", &scene, &state, &mut deformer);
    print_step_time("20,000 domains of 7", &mut deformer, &state);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_a_million_vertices_equal_the_reference() {
    let scene = scenes::random_scene(
        &[(1_000_000, 32)],
        scenes::RandomSceneOptions { instances: 1, normal_maps: false, rigid_transforms: false },
    );
    let mut deformer = cuda_deformer(&scene);
    let state = scenes::random_state(&scene, 4);
    assert_equals_reference("n 1,000,000 r 32", &scene, &state, &mut deformer);
    print_step_time("n 1,000,000 r 32", &mut deformer, &state);
}

/// Prints the median time of a step.
fn print_step_time(name: &str, deformer: &mut CudaDeformer, state: &SceneState) {
    let mut times: Vec<f64> =
        (0..50).map(|_| deformer.deform(state).expect("expected the step to succeed").ms).collect();
    times.sort_by(f64::total_cmp);
    eprintln!("{name}: {:.3} ms per step (median of 50 steps with copies and synchronization)", times[25]);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_domains_with_shared_q_and_equal_transforms_are_equal() {
    let mut random = Random(11);
    let mut parts = scenes::parts_of_shapes(vec![
        scenes::random_shape(&mut random, 100, 4),
        scenes::random_shape(&mut random, 300, 4),
        scenes::random_shape(&mut random, 50, 2),
    ]);
    parts.domains = [0, 1, 2, 1].map(|shape| scenes::new_domain(shape, NORMAL_MAPPED_MATERIAL)).into();
    parts.domains[1].shares_q_with = Some(0);
    parts.domains[3].shares_q_with = Some(1);
    let scene = Scene::new(parts).expect("expected a valid scene");
    assert_eq!(scene.layout.coordinates, 6);
    let mut state = scenes::random_state(&scene, 12);
    state.transforms[3] = state.transforms[1];
    let mut deformer = cuda_deformer(&scene);
    assert_equals_reference("shared q", &scene, &state, &mut deformer);
    let positions = &deformer.surface().expect("expected a surface").positions;
    // Domains 1 and 3 have the shape with 300 vertices, the same q and the same transform.
    let [first, second] =
        [1, 3].map(|domain: usize| &positions[3 * scene.layout.domains[domain].first_vertex..][..3 * 300]);
    assert!(have_equal_bits(first, second));
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_bits_do_not_depend_on_history_or_packing() {
    let scene = scenes::random_scene(
        &[(1000, 37), (33, 5)],
        scenes::RandomSceneOptions { instances: 4, normal_maps: true, rigid_transforms: false },
    );
    let (mut state, other_state) = (scenes::random_state(&scene, 20), scenes::random_state(&scene, 21));
    // Domains 0, 2, 4 and 6 are the instances of the first shape, of rank 37. They get the same q and transform. Their
    // vertices start at different offsets within thread blocks.
    let q = state.q_of(&scene, 0).to_vec();
    for domain in [2, 4, 6] {
        state.transforms[domain] = state.transforms[0];
        state.q[scene.layout.domains[domain].first_q..][..37].copy_from_slice(&q);
    }
    let mut deformer = cuda_deformer(&scene);
    deformer.deform(&state).expect("expected the step to succeed");
    let first = deformer.surface().expect("expected a surface").clone();
    deformer.deform(&other_state).expect("expected the step to succeed");
    let other = deformer.surface().expect("expected a surface").clone();
    deformer.deform(&state).expect("expected the step to succeed");
    let repeated = deformer.surface().expect("expected a surface").clone();
    let mut new_deformer = cuda_deformer(&scene);
    new_deformer.deform(&state).expect("expected the step to succeed");
    let new = new_deformer.surface().expect("expected a surface");
    assert!(!have_equal_bits(&first.positions, &other.positions), "expected states with different positions");
    for surface in [&repeated, new] {
        assert!(have_equal_bits(&first.positions, &surface.positions));
        assert!(have_equal_bits(&first.normals, &surface.normals));
        assert!(have_equal_bits(&first.tangents, &surface.tangents));
    }
    let positions_of = |domain: usize| &first.positions[3 * scene.layout.domains[domain].first_vertex..][..3 * 1000];
    for domain in [2, 4, 6] {
        assert!(have_equal_bits(positions_of(0), positions_of(domain)), "domain {domain}");
    }
}
