//! Batches of coordinate vectors with one U: tensor cores against their error bound, and the cost of batches.

use std::sync::Arc;

use modalcast_bench::kernels::{
    BatchMmaBenchmark, BenchmarkStep, DeformerBenchmark, KernelBenchmark, StepOutputs, gigabytes_per_second, time,
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

/// Largest quotient of a vertex's error and the bound of its tile. The bound covers U in 16 bits, q as pairs of 16-bit
/// numbers, and the tensor cores' own sums.
fn of_bound(scene: &Scene, state: &SceneState, positions: &[f32]) -> f64 {
    let (shape, storage) = (scene.shape_of(0), scene.deformation.storage);
    let tiles = TiledModes::new(shape, storage);
    let (reaches, products) = (ShapeErrorModel::new(shape, &tiles), TensorCoreError::of(storage, tiles.rank()));
    let vertices = shape.mesh.rest_positions().len();
    let want = modalcast_compute::reference::deform(scene, state);
    let share = |(packed, got): (usize, &[f32; 3])| {
        let (domain, tile) = (packed / vertices, packed % vertices / (QUAD * TILE_QUADS));
        let step = ErrorBoundInput {
            q: state.q_of(scene, domain),
            transform: state.composed_transform(scene, domain),
            compensated: false,
        };
        let bound = reaches.tile(tile, &step).total() + reaches.products(tile, &step, products);
        let square = |axis: usize| (f64::from(got[axis]) - want[packed][axis]).powi(2);
        let error = (0..3).map(square).sum::<f64>().sqrt();
        if error.is_nan() { f64::INFINITY } else { error / bound }
    };
    positions.as_chunks::<3>().0.iter().enumerate().map(share).fold(0.0, f64::max)
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_tensor_core_batches_stay_within_their_bound() {
    let device = Device::open(0).expect("expected a CUDA device");
    for storage in [StorageType::F16, StorageType::Bf16] {
        for (vertices, rank, count) in [
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
            let scene = build_scene(instanced_parts(vertices, rank, count, with_storage(storage)));
            let states = random_states(&scene);
            let batch = BatchMmaBenchmark::new(&device, &scene, &states).expect("expected a benchmark");
            let name = format!("{} n {vertices} r {rank}", batch.name());
            for (input_set, state) in states.iter().enumerate() {
                batch.launch(&device, input_set).expect("expected a launch");
                let got = batch.positions(&device).expect("expected a surface");
                let share = of_bound(&scene, state, &got);
                assert!(share <= 1.0, "{name} input set {input_set}: {share} of the bound");
                let other = of_bound(&scene, &states[(input_set + 1) % states.len()], &got);
                assert!(other > 1.0, "{name}: expected the next state to exceed the bound, got {other} of it");
                batch.launch(&device, input_set).expect("expected a launch");
                assert!(
                    have_equal_bits(&got, &batch.positions(&device).expect("expected a surface")),
                    "{name}: run after run"
                );
            }
            for attributes in batch.kernel_attributes() {
                assert!(attributes.local_bytes == 0, "{name}: {attributes:?}");
            }
        }
    }
    let refused =
        |scene: &Arc<Scene>| BatchMmaBenchmark::new(&device, scene, &random_states(scene)).expect_err("refused");
    assert!(
        refused(&build_scene(instanced_parts(9, 2, 2, with_storage(StorageType::F32))))
            .to_string()
            .contains("f16 or bf16")
    );
    assert!(
        refused(&build_scene(instanced_parts(9, 2, 33, with_storage(StorageType::F16))))
            .to_string()
            .contains("at most 32")
    );
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_batch_of_16_takes_less_than_8_times_one_vector() {
    let device = Device::open(0).expect("expected a CUDA device");
    let measure = |benchmark: &dyn KernelBenchmark| {
        let us = time(&device, benchmark, CacheState::Warm, 200).expect("times").median_us;
        let bytes: u64 = benchmark.traffic().iter().map(|traffic| traffic.bytes).sum();
        let rate = gigabytes_per_second(bytes, us);
        eprintln!("{}: {us:.1} us, {rate:.0} GB/s, {:?}", benchmark.name(), benchmark.kernel_attributes());
        us
    };
    for storage in StorageType::ALL {
        let step = BenchmarkStep { batches: BatchPolicy::Always, ..BenchmarkStep::full(StepOutputs::Positions) };
        let scene = build_scene(instanced_parts(1_500_000, 32, 1, with_storage(storage)));
        let state = scenes::random_state(&scene, 1);
        let one = measure(&DeformerBenchmark::new(&device, &scene, &[state], step).expect("expected a benchmark"));
        let scene = build_scene(instanced_parts(1_500_000, 32, 16, with_storage(storage)));
        let state = scenes::random_state(&scene, 1);
        let sixteen =
            DeformerBenchmark::new(&device, &scene, std::slice::from_ref(&state), step).expect("expected a benchmark");
        assert_eq!(sixteen.kernel_attributes()[0].name, "batch");
        let sixteen = measure(&sixteen);
        eprintln!("{}: {:.2} times as long as one", storage.name(), sixteen / one);
        assert!(sixteen < 8.0 * one, "{storage:?} {one} {sixteen}");
        if matches!(storage, StorageType::F16 | StorageType::Bf16) {
            let products = measure(&BatchMmaBenchmark::new(&device, &scene, &[state]).expect("expected a benchmark"));
            eprintln!("{} by tensor cores: {:.2} times as long as one", storage.name(), products / one);
            assert!(products < 8.0 * one, "{storage:?} {one} {products}");
        }
    }
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_auto_mode_batches_where_it_is_faster() {
    let device = Device::open(0).expect("expected a CUDA device");
    let mut slow = Vec::new();
    for (vertices, rank) in [(1000, 32), (4000, 32), (16_000, 8), (16_000, 32), (64_000, 32), (500_000, 32)] {
        for count in [2, 3, 4, 8, 16, 64] {
            if vertices * count * rank > 1 << 29 {
                continue;
            }
            let scene = build_scene(instanced_parts(vertices, rank, count, DeformationSettings::default()));
            let state = scenes::random_state(&scene, 1);
            let measured = |batches: BatchPolicy| {
                let step = BenchmarkStep { batches, ..BenchmarkStep::full(StepOutputs::Positions) };
                let ours = DeformerBenchmark::new(&device, &scene, std::slice::from_ref(&state), step)
                    .expect("expected a benchmark");
                time(&device, &ours, CacheState::Warm, 100).expect("times").median_us
            };
            let [batch, alone] = [BatchPolicy::Always, BatchPolicy::Never].map(measured);
            let chooses = modalcast_compute::gpu::plan(&scene, CudaDeformerOptions::default())
                .kernel(KernelKind::Batch)
                .is_some();
            eprintln!("n {vertices} r {rank} x {count}: {batch:.1} us batched, {alone:.1} apart, chosen {chooses}");
            let (own, other) = if chooses { (batch, alone) } else { (alone, batch) };
            if own > 1.5 * other + 2.0 {
                slow.push((vertices, rank, count, own, other));
            }
        }
    }
    assert!(slow.is_empty(), "chosen and slower: {slow:?}");
}
