//! Device memory rates and benchmark kernels; every kernel's positions are compared with the f64 reference.

use std::sync::Arc;

use modalcast_bench::kernels::{
    CublasBenchmark, CublasMethod, KernelBenchmark, KernelSplit, Part, ThesisBenchmark, empty_replay, roofs, time,
};
use modalcast_bench::timing::CacheState;
use modalcast_compute::gpu::Device;
use modalcast_model::error::Error;
use modalcast_model::scene::{BoundingBox, Scene, SceneState};

use crate::accuracy::{MAX_POSITION_ERROR, max_error};
use crate::scenes;

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_memory_rates_are_plausible_and_empty_replay_takes_time() {
    let device = Device::open(0).expect("expected a CUDA device");
    let roofs = roofs(&device).expect("roofs");
    eprintln!("{}: {roofs:?}", device.name());
    assert!(roofs.copy_gbs > 20.0 && roofs.pinned_h2d_gbs > 1.0 && roofs.pinned_d2h_gbs > 1.0, "{roofs:?}");
    assert!((0.8..1.6).contains(&(roofs.read_gbs / roofs.copy_gbs)), "reading is about as fast as copying: {roofs:?}");
    assert!(roofs.pinned_h2d_gbs < roofs.copy_gbs, "{roofs:?}");
    let empty = empty_replay(&device, 100).expect("replays");
    assert!(empty.replays == 100 && empty.q1_us <= empty.median_us && empty.median_us <= empty.q3_us, "{empty:?}");
    assert!((0.1..100.0).contains(&empty.median_us), "{empty:?}");
    assert!(empty_replay(&device, 0).is_err());
}

/// Per packed vertex, whether a triangle refers to it. Other vertices are not computed from unfolded triangles.
fn is_corner_of_triangle(scene: &Scene) -> Vec<bool> {
    let mut named = vec![false; scene.layout.vertices];
    for (domain, slot) in scene.layout.domains.iter().enumerate() {
        let mesh = &scene.shape_of(domain).mesh;
        for corner in mesh.triangles().as_flattened() {
            named[slot.first_vertex + mesh.corners().vertices[*corner as usize] as usize] = true;
        }
    }
    named
}

/// Largest error of a benchmark's positions, over the vertices that a triangle refers to, as a fraction of the diagonal.
fn relative_error(scene: &Scene, state: &SceneState, positions: &[f32]) -> Result<f64, String> {
    let (named, want) = (is_corner_of_triangle(scene), modalcast_compute::reference::deform(scene, state));
    if positions.len() != 3 * named.len() {
        return Err(format!("{} numbers for {} vertices", positions.len(), named.len()));
    }
    let mut bounds = BoundingBox::EMPTY;
    want.iter().for_each(|position| bounds.include(*position));
    // One vertex has no diagonal; shapes fit into a cube of side 2.
    let diagonal = bounds.diagonal().max(1.0);
    let kept = |vertex: &usize| named[*vertex];
    let got: Vec<f32> = (0..named.len()).filter(kept).flat_map(|at| positions[3 * at..][..3].to_vec()).collect();
    let want: Vec<[f64; 3]> = (0..named.len()).filter(kept).map(|vertex| want[vertex]).collect();
    max_error(&got, &want, MAX_POSITION_ERROR * diagonal).map(|error| error / diagonal)
}

/// Checks every input set of a benchmark, launched directly and replayed.
fn check(device: &Device, scene: &Arc<Scene>, states: &[SceneState], benchmark: &dyn KernelBenchmark) {
    let name = benchmark.name();
    assert_eq!(benchmark.input_set_count(), states.len(), "{name}");
    for (input_set, state) in states.iter().enumerate() {
        benchmark.launch(device, input_set).unwrap_or_else(|error| panic!("{name}: {error}"));
        let positions = benchmark.positions(device).expect("expected a surface");
        let error = relative_error(scene, state, &positions)
            .unwrap_or_else(|error| panic!("{name} input set {input_set}: {error}"));
        assert!(
            relative_error(scene, &states[(input_set + 1) % states.len()], &positions).is_err(),
            "{name}: expected the next state to exceed the tolerance"
        );
        eprintln!("{name} input set {input_set}: {error:.2e} of the diagonal");
    }
    // The last replay runs the last input set.
    for cache in [CacheState::Warm, CacheState::Cold] {
        benchmark.launch(device, 0).expect("expected a launch");
        let timing =
            time(device, benchmark, cache, 10 * states.len()).unwrap_or_else(|error| panic!("{name}: {error}"));
        let positions = benchmark.positions(device).expect("expected a surface");
        let last = states.len() - 1;
        relative_error(scene, &states[last], &positions).unwrap_or_else(|error| panic!("{name} replayed: {error}"));
        eprintln!("{name} {cache:?}: {timing:?}, {} launches", benchmark.launches_per_step());
    }
    assert!(benchmark.traffic().iter().map(|traffic| traffic.bytes).sum::<u64>() > 0, "{name}");
    for attributes in benchmark.kernel_attributes() {
        assert!(attributes.registers > 0 && attributes.local_bytes == 0, "{name}: {attributes:?}");
    }
}

fn states(scene: &Scene) -> Vec<SceneState> {
    (1..=3).map(|seed| scenes::random_state(scene, seed)).collect()
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_thesis_single_matches_reference_at_a_few_ranks() {
    single(&[1, 10, 33]);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_thesis_single_matches_reference_up_to_rank_512() {
    single(&[3, 20, 30, 32, 129, 512]);
}

fn single(ranks: &[usize]) {
    let device = Device::open(0).expect("expected a CUDA device");
    for rank in ranks.iter().copied() {
        for (vertices, normal_maps) in [(1, false), (33, true), (5003, false)] {
            let scene = scenes::random_scene(&[(vertices, rank)], 1, normal_maps, false);
            for part in [Part::Uq, Part::Whole] {
                let benchmark =
                    ThesisBenchmark::single(&device, &scene, &states(&scene), part).expect("expected a benchmark");
                check(&device, &scene, &states(&scene), &benchmark);
            }
        }
    }
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_thesis_grouped_kernels_match_reference_in_all_splits() {
    let device = Device::open(0).expect("expected a CUDA device");
    let shapes: Vec<_> = (0..66).map(|index| (1 + index * 29 % 611, index % 33)).collect();
    let scene = scenes::random_scene(&shapes, 2, true, false);
    for split in KernelSplit::ALL {
        for part in [Part::Uq, Part::Whole] {
            let benchmark =
                ThesisBenchmark::multi(&device, &scene, &states(&scene), (split, part)).expect("expected a benchmark");
            check(&device, &scene, &states(&scene), &benchmark);
            assert_eq!(benchmark.launches_per_step(), split.widths().len() + usize::from(part == Part::Whole));
        }
    }
    let rigid = scenes::random_scene(&[(40, 0)], 3, false, true);
    let update_alone = ThesisBenchmark::multi(&device, &rigid, &states(&rigid), (KernelSplit::Two, Part::Whole))
        .expect("expected a benchmark");
    check(&device, &rigid, &states(&rigid), &update_alone);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_cublas_matches_reference_with_every_product_kind() {
    let device = Device::open(0).expect("expected a CUDA device");
    let shapes: Vec<_> = (0..40).map(|index| (1 + index * 29 % 611, index * 7 % 65)).collect();
    let many = scenes::random_scene(&shapes, 2, false, false);
    let (one, instances) =
        (scenes::random_scene(&[(5003, 30)], 1, false, false), scenes::random_scene(&[(5003, 32)], 16, false, false));
    for peer in CublasMethod::ALL {
        let scene = match peer {
            CublasMethod::SgemvColumns | CublasMethod::SgemvRows => &one,
            CublasMethod::Instances => &instances,
            _ => &many,
        };
        for part in [Part::Uq, Part::Whole] {
            match CublasBenchmark::new(&device, scene, &states(scene), (peer, part)) {
                Ok(benchmark) => check(&device, scene, &states(scene), &benchmark),
                Err(Error::Unavailable { what: "cuBLAS", reason, .. }) => {
                    eprintln!("{} skipped: {reason}", peer.name())
                }
                Err(error) => panic!("{}: {error}", peer.name()),
            }
        }
    }
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_thesis_kernels_reject_unsupported_scenes() {
    let device = Device::open(0).expect("expected a CUDA device");
    let (large, two) =
        (scenes::random_scene(&[(40, 33)], 1, false, false), scenes::random_scene(&[(40, 3)], 2, false, false));
    let field = |refusal: Result<ThesisBenchmark, Error>| match refusal {
        Err(Error::Invalid { field, .. }) => field,
        other => panic!("{other:?}"),
    };
    assert_eq!(
        field(ThesisBenchmark::multi(&device, &large, &states(&large), (KernelSplit::Two, Part::Uq))),
        "domain 0: modes"
    );
    assert_eq!(field(ThesisBenchmark::single(&device, &two, &states(&two), Part::Uq)), "scene.domains");
    assert_eq!(field(ThesisBenchmark::single(&device, &large, &[], Part::Uq)), "states");
    assert_eq!(field(ThesisBenchmark::single(&device, &large, &states(&two), Part::Uq)), "states");
}
