//! Batches, which multiply one U by the vectors q of many domains: errors of tensor cores against their bound, and run
//! times.

use std::sync::Arc;

use modalcast_bench::kernels::{
    BatchMmaBenchmark, BenchmarkStep, DeformerBenchmark, KernelBenchmark, StepOutputs, gigabytes_per_second, time_steps,
};
use modalcast_bench::timing::CacheState;
use modalcast_compute::gpu::{CudaDeformerOptions, Device, KernelKind};
use modalcast_compute::storage::bound::{ErrorBoundInput, ShapeErrorModel};
use modalcast_compute::storage::{QUAD, TILE_QUADS, TensorCoreError, TiledModes};
use modalcast_model::backend_settings::BatchPolicy;
use modalcast_model::scene::{DeformationSettings, Scene, SceneState, StorageType};

use crate::accuracy::have_equal_bits;
use crate::ensembles::{build_scene, instanced_parts, random_states, with_storage};
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

/// Compares a step of 16 domains that share U with a step of one domain. The limit of 8 is half of 16 separate steps.
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_batch_of_16_takes_less_than_8_times_one_vector() {
    let device = Device::open(0).expect("a CUDA device");
    let measure_us = |benchmark: &dyn KernelBenchmark| {
        let us = time_steps(&device, benchmark, CacheState::Warm, 200).expect("a timing").median_us;
        let bytes: u64 = benchmark.traffic().iter().map(|traffic| traffic.bytes).sum();
        let bandwidth = gigabytes_per_second(bytes, us);
        eprintln!("{}: {us:.1} us, {bandwidth:.0} GB/s, {:?}", benchmark.name(), benchmark.kernel_attributes());
        us
    };
    for storage in StorageType::ALL {
        let step = BenchmarkStep { batches: BatchPolicy::Always, ..BenchmarkStep::full(StepOutputs::Positions) };
        // 1.5 M vertices, 32 modes; one domain, then 16.
        let scene = build_scene(instanced_parts(1_500_000, 32, 1, with_storage(storage)));
        let state = scenes::random_state(&scene, 1);
        let single_us = measure_us(&DeformerBenchmark::new(&device, &scene, &[state], step).expect("a benchmark"));
        let scene = build_scene(instanced_parts(1_500_000, 32, 16, with_storage(storage)));
        let state = scenes::random_state(&scene, 1);
        let batch = DeformerBenchmark::new(&device, &scene, std::slice::from_ref(&state), step).expect("a benchmark");
        assert_eq!(batch.kernel_attributes()[0].name, "batch");
        let batch_us = measure_us(&batch);
        eprintln!("{}: {:.2} times as long as one vector", storage.name(), batch_us / single_us);
        assert!(batch_us < 8.0 * single_us, "{storage:?}: expected less than 8 x {single_us} us, got {batch_us} us");
        if matches!(storage, StorageType::F16 | StorageType::Bf16) {
            let tensor_core_us = measure_us(&BatchMmaBenchmark::new(&device, &scene, &[state]).expect("a benchmark"));
            eprintln!(
                "{} by tensor cores: {:.2} times as long as one vector",
                storage.name(),
                tensor_core_us / single_us
            );
            assert!(
                tensor_core_us < 8.0 * single_us,
                "{storage:?} by tensor cores: expected less than 8 x {single_us} us, got {tensor_core_us} us"
            );
        }
    }
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_auto_mode_batches_where_it_is_faster() {
    let device = Device::open(0).expect("a CUDA device");
    let mut slow_choices = Vec::new();
    for (vertices, rank) in [(1000, 32), (4000, 32), (16_000, 8), (16_000, 32), (64_000, 32), (500_000, 32)] {
        for domains in [2, 3, 4, 8, 16, 64] {
            // Skips only the largest scene: 64 instances of 500,000 vertices.
            if vertices * domains * rank > 1 << 29 {
                continue;
            }
            let scene = build_scene(instanced_parts(vertices, rank, domains, DeformationSettings::default()));
            let state = scenes::random_state(&scene, 1);
            let measure_us = |batches: BatchPolicy| {
                let step = BenchmarkStep { batches, ..BenchmarkStep::full(StepOutputs::Positions) };
                let benchmark =
                    DeformerBenchmark::new(&device, &scene, std::slice::from_ref(&state), step).expect("a benchmark");
                time_steps(&device, &benchmark, CacheState::Warm, 100).expect("a timing").median_us
            };
            let [batch_us, separate_us] = [BatchPolicy::Always, BatchPolicy::Never].map(measure_us);
            let is_batch_chosen = modalcast_compute::gpu::plan(&scene, CudaDeformerOptions::default())
                .kernel(KernelKind::Batch)
                .is_some();
            eprintln!(
                "n {vertices} r {rank} x {domains}: {batch_us:.1} us batched, {separate_us:.1} us separate, \
                 batched by auto: {is_batch_chosen}"
            );
            let (chosen_us, rejected_us) =
                if is_batch_chosen { (batch_us, separate_us) } else { (separate_us, batch_us) };
            // The margins of 50 % and 2 us are larger than the noise of a timing.
            if chosen_us > 1.5 * rejected_us + 2.0 {
                slow_choices.push((vertices, rank, domains, chosen_us, rejected_us));
            }
        }
    }
    // Entries are (vertices, rank, domains, us of the choice, us of the alternative).
    assert!(slow_choices.is_empty(), "expected no slow choice, got {slow_choices:?}");
}
