//! Batches, which multiply one U by the vectors q of many domains: errors of tensor cores against their bound, and
//! launches.

use std::sync::Arc;

use modalcast_bench::kernels::{BatchMmaBenchmark, BenchmarkStep, DeformerBenchmark, KernelBenchmark, StepOutputs};
use modalcast_compute::gpu::Device;
use modalcast_compute::storage::bound::{ErrorBoundInput, ShapeErrorModel};
use modalcast_compute::storage::{QUAD, TILE_QUADS, TensorCoreError, TiledModes};
use modalcast_model::backend_settings::BatchPolicy;
use modalcast_model::scene::{Scene, SceneState, StorageType};

use crate::accuracy::have_equal_bits;
use crate::instanced_scenes::{build_scene, instanced_parts, random_states, with_storage};
use crate::scenes;

/// Largest ratio of a vertex's error to the error bound of its tile. A tile of stored U has [`TILE_QUADS`] quads, and a
/// quad is four consecutive vertices. The bound covers the rounding of U to 16 bits, of q to pairs of 16-bit numbers,
/// and of the tensor cores' sums.
fn max_error_over_bound(scene: &Scene, state: &SceneState, positions: &[f32]) -> f64 {
    let (shape, storage) = (scene.shape_of(0), scene.deformation.storage);
    let tiles = TiledModes::new(shape, storage);
    let error_model = ShapeErrorModel::new(shape, &tiles);
    let tensor_core_error = TensorCoreError::of(storage, tiles.rank());
    let vertices = shape.mesh.rest_positions().len();
    let reference_positions = modalcast_compute::reference::deform(scene, state);
    let error_over_bound = |(packed_vertex, position): (usize, &[f32; 3])| {
        let (domain, tile) = (packed_vertex / vertices, packed_vertex % vertices / (QUAD * TILE_QUADS));
        let bound_input = ErrorBoundInput {
            q: state.q_of(scene, domain),
            transform: state.composed_transform(scene, domain),
            compensated: false,
        };
        let bound = error_model.tile_bound(tile, &bound_input).total()
            + error_model.tensor_core_bound(tile, &bound_input, tensor_core_error);
        let squared_difference =
            |axis: usize| (f64::from(position[axis]) - reference_positions[packed_vertex][axis]).powi(2);
        let error = (0..3).map(squared_difference).sum::<f64>().sqrt();
        if error.is_nan() { f64::INFINITY } else { error / bound }
    };
    positions.as_chunks::<3>().0.iter().enumerate().map(error_over_bound).fold(0.0, f64::max)
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_tensor_core_batches_stay_within_their_bound() {
    let device = Device::open(0).expect("a CUDA device");
    for storage in [StorageType::F16, StorageType::Bf16] {
        for (vertices, rank, domains) in [
            (1, 3, 1),
            (33, 0, 2),
            (64, 1, 16),
            (127, 4, 5),
            (128, 33, 16),
            (129, 16, 8),
            (261, 31, 32),
            (2000, 32, 16),
            (5003, 512, 13),
        ] {
            let scene = build_scene(instanced_parts(vertices, rank, domains, with_storage(storage)));
            let states = random_states(&scene);
            let batch = BatchMmaBenchmark::new(&device, &scene, &states).expect("a benchmark");
            let name = format!("{} n {vertices} r {rank}", batch.name());
            for (input_set, state) in states.iter().enumerate() {
                batch.launch(&device, input_set).expect("a launch");
                let positions = batch.positions(&device).expect("positions");
                let error_over_bound = max_error_over_bound(&scene, state, &positions);
                assert!(
                    error_over_bound <= 1.0,
                    "{name} input set {input_set}: expected an error within the bound, got {error_over_bound} times \
                     the bound"
                );
                let next_error_over_bound =
                    max_error_over_bound(&scene, &states[(input_set + 1) % states.len()], &positions);
                assert!(
                    next_error_over_bound > 1.0,
                    "control: {name}: expected an error above the bound against the next state, got \
                     {next_error_over_bound} times the bound"
                );
                batch.launch(&device, input_set).expect("a launch");
                assert!(
                    have_equal_bits(&positions, &batch.positions(&device).expect("positions")),
                    "{name}: expected bit-identical positions of two launches"
                );
            }
            for attributes in batch.kernel_attributes() {
                assert!(attributes.local_bytes == 0, "{name}: expected no register spills, got {attributes:?}");
            }
        }
    }
    let rejection =
        |scene: &Arc<Scene>| BatchMmaBenchmark::new(&device, scene, &random_states(scene)).expect_err("a rejection");
    assert!(
        rejection(&build_scene(instanced_parts(9, 2, 2, with_storage(StorageType::F32))))
            .to_string()
            .contains("f16 or bf16")
    );
    assert!(
        rejection(&build_scene(instanced_parts(9, 2, 33, with_storage(StorageType::F16))))
            .to_string()
            .contains("at most 32")
    );
}

/// The vertices of 16 domains that share U come from one launch, as those of one domain do.
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_batch_of_16_is_one_launch() {
    let device = Device::open(0).expect("a CUDA device");
    for storage in StorageType::ALL {
        let benchmark = |domains: usize, batches: BatchPolicy| {
            let scene = build_scene(instanced_parts(20_000, 32, domains, with_storage(storage)));
            let step = BenchmarkStep { batches, ..BenchmarkStep::full(StepOutputs::Positions) };
            let state = scenes::random_state(&scene, 1);
            DeformerBenchmark::new(&device, &scene, &[state], step).expect("a benchmark")
        };
        for (domains, batches, kernel) in
            [(1, BatchPolicy::Always, "deform"), (16, BatchPolicy::Never, "deform"), (16, BatchPolicy::Always, "batch")]
        {
            let benchmark = benchmark(domains, batches);
            let attributes = &benchmark.kernel_attributes()[0];
            assert_eq!(
                (attributes.name.as_str(), benchmark.launches_per_step()),
                (kernel, 1),
                "{} x {domains}",
                storage.name()
            );
        }
    }
}
