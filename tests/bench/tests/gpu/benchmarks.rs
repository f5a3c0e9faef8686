//! Tests device memory bandwidths and benchmark kernels. Every kernel's positions are compared with the f64 reference.

use std::sync::Arc;

use modalcast_bench::kernels::{
    CublasBenchmark, CublasMethod, KernelBenchmark, KernelSplit, StepPart, ThesisBenchmark, measure_bandwidth,
    time_empty_kernel, time_steps,
};
use modalcast_bench::timing::CacheState;
use modalcast_compute::gpu::Device;
use modalcast_model::error::Error;
use modalcast_model::scene::{BoundingBox, Scene, SceneState};

use crate::accuracy::{MAX_POSITION_ERROR, max_error};
use crate::scenes;

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_memory_rates_are_measured_and_empty_kernels_take_time() {
    let device = Device::open(0).expect("expected a CUDA device");
    let bandwidths = measure_bandwidth(&device).expect("memory bandwidths");
    eprintln!("{}: {bandwidths:?}", device.name());
    let rates = [bandwidths.copy_gbs, bandwidths.read_gbs, bandwidths.pinned_h2d_gbs, bandwidths.pinned_d2h_gbs];
    assert!(rates.iter().all(|rate| rate.is_finite() && *rate > 0.0), "{bandwidths:?}");
    let replay_timing = time_empty_kernel(&device, 100).expect("a timing");
    assert!(
        replay_timing.replays == 100
            && replay_timing.q1_us <= replay_timing.median_us
            && replay_timing.median_us <= replay_timing.q3_us,
        "{replay_timing:?}"
    );
    assert!(replay_timing.q1_us > 0.0, "{replay_timing:?}");
    assert!(time_empty_kernel(&device, 0).is_err());
}

/// For each vertex of the scene, whether a triangle refers to it. The vertex update of the thesis computes no other
/// vertices.
fn find_referenced_vertices(scene: &Scene) -> Vec<bool> {
    let mut is_referenced = vec![false; scene.layout.vertices];
    for (domain, slot) in scene.layout.domains.iter().enumerate() {
        let mesh = &scene.shape_of(domain).mesh;
        for corner in mesh.triangles().as_flattened() {
            is_referenced[slot.first_vertex + mesh.corners().vertices[*corner as usize] as usize] = true;
        }
    }
    is_referenced
}

/// Largest error of a benchmark's positions as a fraction of the scene's diagonal. Vertices that no triangle refers to
/// are not compared. `Err` if the error exceeds the tolerance.
fn relative_error(scene: &Scene, state: &SceneState, positions: &[f32]) -> Result<f64, String> {
    let (is_referenced, reference_positions) =
        (find_referenced_vertices(scene), modalcast_compute::reference::deform(scene, state));
    if positions.len() != 3 * is_referenced.len() {
        return Err(format!("expected {} vertices, got {} numbers", is_referenced.len(), positions.len()));
    }
    let mut bounds = BoundingBox::EMPTY;
    reference_positions.iter().for_each(|position| bounds.include(*position));
    // A single vertex has a diagonal of 0. The tolerance then refers to 1, half the side of the cube that contains
    // every shape.
    let diagonal = bounds.diagonal().max(1.0);
    let is_compared = |vertex: &usize| is_referenced[*vertex];
    let compared_positions: Vec<f32> =
        (0..is_referenced.len()).filter(is_compared).flat_map(|vertex| positions[3 * vertex..][..3].to_vec()).collect();
    let reference_positions: Vec<[f64; 3]> =
        (0..is_referenced.len()).filter(is_compared).map(|vertex| reference_positions[vertex]).collect();
    max_error(&compared_positions, &reference_positions, MAX_POSITION_ERROR * diagonal).map(|error| error / diagonal)
}

/// Checks the positions of every input set (the inputs of one state) after a launch, and those of the last input set
/// after the replays of a timing.
fn check_benchmark(device: &Device, scene: &Arc<Scene>, states: &[SceneState], benchmark: &dyn KernelBenchmark) {
    let name = benchmark.name();
    assert_eq!(benchmark.input_set_count(), states.len(), "{name}");
    for (input_set, state) in states.iter().enumerate() {
        benchmark.launch(device, input_set).unwrap_or_else(|error| panic!("{name}: {error}"));
        let positions = benchmark.positions(device).expect("positions");
        let error = relative_error(scene, state, &positions)
            .unwrap_or_else(|error| panic!("{name} input set {input_set}: {error}"));
        assert!(
            relative_error(scene, &states[(input_set + 1) % states.len()], &positions).is_err(),
            "control: {name}: expected an error above the tolerance against the next state"
        );
        eprintln!("{name} input set {input_set}: {error:.2e} of the diagonal");
    }
    // The replays rotate through the input sets. Their number is a multiple of the number of input sets, so the last
    // replay runs the last input set.
    for cache in [CacheState::Warm, CacheState::Cold] {
        benchmark.launch(device, 0).expect("expected a launch");
        let timing =
            time_steps(device, benchmark, cache, 10 * states.len()).unwrap_or_else(|error| panic!("{name}: {error}"));
        let positions = benchmark.positions(device).expect("positions");
        let last_state = &states[states.len() - 1];
        relative_error(scene, last_state, &positions).unwrap_or_else(|error| panic!("{name} replayed: {error}"));
        eprintln!("{name} {cache:?}: {timing:?}, {} launches", benchmark.launches_per_step());
    }
    assert!(benchmark.traffic().iter().map(|traffic| traffic.bytes).sum::<u64>() > 0, "{name}");
    for attributes in benchmark.kernel_attributes() {
        assert!(
            attributes.registers > 0 && attributes.local_bytes == 0,
            "{name}: expected no register spills, got {attributes:?}"
        );
    }
}

fn random_states(scene: &Scene) -> Vec<SceneState> {
    (1..=3).map(|seed| scenes::random_state(scene, seed)).collect()
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_thesis_single_matches_reference_at_a_few_ranks() {
    check_single_kernel(&[1, 10, 33]);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_thesis_single_matches_reference_up_to_rank_512() {
    check_single_kernel(&[3, 20, 30, 32, 129, 512]);
}

fn check_single_kernel(ranks: &[usize]) {
    let device = Device::open(0).expect("expected a CUDA device");
    for rank in ranks.iter().copied() {
        for (vertices, normal_maps) in [(1, false), (33, true), (5003, false)] {
            let scene = scenes::random_scene(
                &[(vertices, rank)],
                scenes::RandomSceneOptions { instances: 1, normal_maps, rigid_transforms: false },
            );
            for part in [StepPart::Uq, StepPart::Whole] {
                let benchmark = ThesisBenchmark::single(&device, &scene, &random_states(&scene), part)
                    .expect("expected a benchmark");
                check_benchmark(&device, &scene, &random_states(&scene), &benchmark);
            }
        }
    }
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_thesis_grouped_kernels_match_reference_in_all_splits() {
    let device = Device::open(0).expect("expected a CUDA device");
    // 66 shapes of (vertices, rank), with every rank from 0 to 32 twice.
    let shapes: Vec<_> = (0..66).map(|index| (1 + index * 29 % 611, index % 33)).collect();
    let scene = scenes::random_scene(
        &shapes,
        scenes::RandomSceneOptions { instances: 2, normal_maps: true, rigid_transforms: false },
    );
    for split in KernelSplit::ALL {
        for part in [StepPart::Uq, StepPart::Whole] {
            let benchmark = ThesisBenchmark::multi(&device, &scene, &random_states(&scene), (split, part))
                .expect("expected a benchmark");
            check_benchmark(&device, &scene, &random_states(&scene), &benchmark);
            assert_eq!(benchmark.launches_per_step(), split.widths().len() + usize::from(part == StepPart::Whole));
        }
    }
    // Without modes, only the vertex update is launched.
    let rigid_scene = scenes::random_scene(
        &[(40, 0)],
        scenes::RandomSceneOptions { instances: 3, normal_maps: false, rigid_transforms: true },
    );
    let update_benchmark = ThesisBenchmark::multi(
        &device,
        &rigid_scene,
        &random_states(&rigid_scene),
        (KernelSplit::Two, StepPart::Whole),
    )
    .expect("expected a benchmark");
    check_benchmark(&device, &rigid_scene, &random_states(&rigid_scene), &update_benchmark);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_cublas_matches_reference_with_every_product_kind() {
    let device = Device::open(0).expect("expected a CUDA device");
    // 40 shapes of (vertices, rank), with ranks from 0 to 64.
    let shapes: Vec<_> = (0..40).map(|index| (1 + index * 29 % 611, index * 7 % 65)).collect();
    let mixed_scene = scenes::random_scene(
        &shapes,
        scenes::RandomSceneOptions { instances: 2, normal_maps: false, rigid_transforms: false },
    );
    let (single_scene, instanced_scene) = (
        scenes::random_scene(
            &[(5003, 30)],
            scenes::RandomSceneOptions { instances: 1, normal_maps: false, rigid_transforms: false },
        ),
        scenes::random_scene(
            &[(5003, 32)],
            scenes::RandomSceneOptions { instances: 16, normal_maps: false, rigid_transforms: false },
        ),
    );
    for method in CublasMethod::ALL {
        let scene = match method {
            CublasMethod::SgemvColumns | CublasMethod::SgemvRows => &single_scene,
            CublasMethod::Instances => &instanced_scene,
            _ => &mixed_scene,
        };
        for part in [StepPart::Uq, StepPart::Whole] {
            match CublasBenchmark::new(&device, scene, &random_states(scene), (method, part)) {
                Ok(benchmark) => check_benchmark(&device, scene, &random_states(scene), &benchmark),
                Err(Error::Unavailable { what: "cuBLAS", reason, .. }) => {
                    eprintln!("{} skipped: {reason}", method.name())
                }
                Err(error) => panic!("{}: {error}", method.name()),
            }
        }
    }
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_thesis_kernels_reject_unsupported_scenes() {
    let device = Device::open(0).expect("expected a CUDA device");
    let (high_rank_scene, two_domain_scene) = (
        scenes::random_scene(
            &[(40, 33)],
            scenes::RandomSceneOptions { instances: 1, normal_maps: false, rigid_transforms: false },
        ),
        scenes::random_scene(
            &[(40, 3)],
            scenes::RandomSceneOptions { instances: 2, normal_maps: false, rigid_transforms: false },
        ),
    );
    let invalid_field = |result: Result<ThesisBenchmark, Error>| match result {
        Err(Error::Invalid { field, .. }) => field,
        other => panic!("expected an invalid field, got {other:?}"),
    };
    assert_eq!(
        invalid_field(ThesisBenchmark::multi(
            &device,
            &high_rank_scene,
            &random_states(&high_rank_scene),
            (KernelSplit::Two, StepPart::Uq)
        )),
        "domain 0: modes"
    );
    assert_eq!(
        invalid_field(ThesisBenchmark::single(
            &device,
            &two_domain_scene,
            &random_states(&two_domain_scene),
            StepPart::Uq
        )),
        "scene.domains"
    );
    assert_eq!(invalid_field(ThesisBenchmark::single(&device, &high_rank_scene, &[], StepPart::Uq)), "states");
    assert_eq!(
        invalid_field(ThesisBenchmark::single(
            &device,
            &high_rank_scene,
            &random_states(&two_domain_scene),
            StepPart::Uq
        )),
        "states"
    );
}
