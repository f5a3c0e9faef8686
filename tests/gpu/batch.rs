//! Many coordinate vectors for one U, as one product: each instance is where the deformer puts it.

use std::sync::Arc;

use modalcast::deform::Deformer;
use modalcast::domain::Transform;
use modalcast::error::Error;
use modalcast::gpu::{Batch, BatchMma, Cache, Device, Extent, Ours, Trial, gigabytes_per_second, time};
use modalcast::scene::{Bounds, Scene, State, Storage};
use modalcast::storage::bound::{Reaches, Step};
use modalcast::storage::{Products, QUAD, TILE_QUADS, Tiles};

use crate::judge::{POSITION, largest_error, same_bits};
use crate::scenes::{self, Random};
use crate::twins::deformer;

/// `count` domains of one shape, stored as said.
fn ensemble(vertices: usize, rank: usize, count: usize, storage: Storage) -> Arc<Scene> {
    let mut parts = scenes::parts(vec![scenes::shape(&mut Random(7), vertices, rank)]);
    parts.domains = vec![scenes::domain(0, 0); count];
    parts.deformation.storage = storage;
    Scene::new(parts).expect("a scene")
}

fn states(scene: &Scene) -> Vec<State> {
    (1..=3).map(|seed| scenes::state(scene, seed)).collect()
}

/// What the deformer says.
fn one_by_one(scene: &Arc<Scene>, state: &State) -> Vec<f32> {
    let mut deformer = deformer(scene);
    deformer.deform(state).expect("deforms");
    deformer.surface().expect("copies").positions.clone()
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_a_batch_has_the_bits_of_the_deformer_at_every_size_rank_count_and_storage() {
    let device = Device::open(0).expect("a CUDA device");
    for storage in Storage::ALL {
        for (vertices, rank, count) in [
            (1, 3, 1),
            (33, 0, 2),
            (64, 1, 16),
            (127, 4, 5),
            (128, 33, 16),
            (129, 16, 8),
            (2000, 32, 16),
            (5003, 512, 13),
        ] {
            let scene = ensemble(vertices, rank, count, storage);
            let states = states(&scene);
            let batch = Batch::new(&device, &scene, &states).expect("a trial");
            let name = format!("{} n {vertices} r {rank}", batch.name());
            for (turn, state) in states.iter().enumerate() {
                batch.launch(&device, turn).expect("launches");
                let got = batch.positions(&device).expect("copies");
                assert!(same_bits(&got, &one_by_one(&scene, state)), "{name} turn {turn}");
                let other = one_by_one(&scene, &states[(turn + 1) % states.len()]);
                assert!(!same_bits(&got, &other), "{name}: the judge can fail");
                if storage == Storage::F32 {
                    judge(&scene, state, &got).unwrap_or_else(|error| panic!("{name}: {error}"));
                }
            }
            for facts in batch.kernels() {
                assert!(facts.registers <= 128 && facts.spilled_bytes == 0, "{name}: {facts:?}");
            }
        }
    }
}

fn judge(scene: &Scene, state: &State, positions: &[f32]) -> Result<f64, String> {
    let want = modalcast::reference::deform(scene, state);
    let mut bounds = Bounds::EMPTY;
    want.iter().for_each(|position| bounds.include(*position));
    largest_error(positions, &want, POSITION * bounds.diagonal().max(1.0))
}

/// The largest error of a vertex over the bound of its tile: of U in 16 bits, of q in two numbers of 16 bits, and of the
/// tensor cores' own sums.
fn of_bound(scene: &Scene, state: &State, positions: &[f32]) -> f64 {
    let (shape, storage) = (scene.shape_of(0), scene.deformation.storage);
    let tiles = Tiles::new(shape, storage);
    let (reaches, products) = (Reaches::new(shape, &tiles), Products::of(storage, tiles.rank()));
    let vertices = shape.mesh.rest().len();
    let want = modalcast::reference::deform(scene, state);
    let share = |(packed, got): (usize, &[f32; 3])| {
        let (domain, tile) = (packed / vertices, packed % vertices / (QUAD * TILE_QUADS));
        let step = Step { q: state.q_of(scene, domain), transform: state.composed(scene, domain), compensated: false };
        let bound = reaches.tile(tile, &step).total() + reaches.products(tile, &step, products);
        let square = |axis: usize| (f64::from(got[axis]) - want[packed][axis]).powi(2);
        let error = (0..3).map(square).sum::<f64>().sqrt();
        if error.is_nan() { f64::INFINITY } else { error / bound }
    };
    positions.as_chunks::<3>().0.iter().enumerate().map(share).fold(0.0, f64::max)
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_a_batch_by_tensor_cores_stays_within_its_bound_at_every_size_rank_and_count() {
    let device = Device::open(0).expect("a CUDA device");
    for storage in [Storage::F16, Storage::Bf16] {
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
            let scene = ensemble(vertices, rank, count, storage);
            let states = states(&scene);
            let batch = BatchMma::new(&device, &scene, &states).expect("a trial");
            let name = format!("{} n {vertices} r {rank}", batch.name());
            for (turn, state) in states.iter().enumerate() {
                batch.launch(&device, turn).expect("launches");
                let got = batch.positions(&device).expect("copies");
                let share = of_bound(&scene, state, &got);
                assert!(share <= 1.0, "{name} turn {turn}: {share} of the bound");
                let other = of_bound(&scene, &states[(turn + 1) % states.len()], &got);
                assert!(other > 1.0, "{name}: the judge can fail");
                batch.launch(&device, turn).expect("launches");
                assert!(same_bits(&got, &batch.positions(&device).expect("copies")), "{name}: run after run");
            }
            for facts in batch.kernels() {
                assert!(facts.spilled_bytes == 0, "{name}: {facts:?}");
            }
        }
    }
    let refused = |scene: &Arc<Scene>| BatchMma::new(&device, scene, &states(scene)).expect_err("refused");
    assert!(refused(&ensemble(9, 2, 2, Storage::F32)).to_string().contains("f16 or bf16"));
    assert!(refused(&ensemble(9, 2, 33, Storage::F16)).to_string().contains("at most 32"));
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_what_overflows_on_its_way_in_f32_is_mended_in_a_batch_too() {
    let device = Device::open(0).expect("a CUDA device");
    for vertices in [300, 512] {
        let scene = ensemble(vertices, 5, 6, Storage::F32);
        let mut state = scenes::state(&scene, 4);
        // The sum of domain 1 overflows for good; the products of domain 3 do, although their sum need not.
        state.q[5..10].fill(f32::MAX);
        state.transforms[3] = Transform([2e38, 2e38, -2e38, 0.0, 3e38, -3e38, 3e38, 0.0, 1e38, 1e38, 1e38, 0.0]);
        state.q[15..20].fill(3.0);
        let batch = Batch::new(&device, &scene, std::slice::from_ref(&state)).expect("a trial");
        batch.launch(&device, 0).expect("launches");
        let (got, want) = (batch.positions(&device).expect("copies"), one_by_one(&scene, &state));
        assert!(want.iter().any(|number| !number.is_finite()), "something overflows");
        for (index, (got, want)) in got.iter().zip(&want).enumerate() {
            let same = got.to_bits() == want.to_bits() || got.is_nan() && want.is_nan();
            assert!(same, "vertex {}: {got} not {want}", index / 3);
        }
    }
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_batches_refuse_scenes_that_they_are_not_for() {
    let device = Device::open(0).expect("a CUDA device");
    let field = |scene: &Arc<Scene>| match Batch::new(&device, scene, &states(scene)) {
        Err(Error::Invalid { field, .. }) => field,
        other => panic!("{other:?}"),
    };
    assert_eq!(field(&ensemble(9, 2, 17, Storage::F32)), "scene.domains");
    assert_eq!(field(&scenes::scene(&[(40, 3), (40, 3)], 2, false, false)), "domain 1: shape");
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_sixteen_vectors_at_once_take_less_than_four_times_as_long_as_one() {
    let device = Device::open(0).expect("a CUDA device");
    let measure = |trial: &dyn Trial| {
        let us = time(&device, trial, Cache::Warm, 200).expect("times").median_us;
        let bytes: u64 = trial.bytes().iter().map(|(_, bytes)| bytes).sum();
        let rate = gigabytes_per_second(bytes, us);
        eprintln!("{}: {us:.1} us, {rate:.0} GB/s, {:?}", trial.name(), trial.kernels());
        us
    };
    for storage in Storage::ALL {
        let scene = ensemble(1_500_000, 32, 1, storage);
        let state = scenes::state(&scene, 1);
        let one = measure(&Ours::new(&device, &scene, &[state], Extent::Positions).expect("a trial"));
        let scene = ensemble(1_500_000, 32, 16, storage);
        let state = scenes::state(&scene, 1);
        let sixteen = measure(&Batch::new(&device, &scene, std::slice::from_ref(&state)).expect("a trial"));
        eprintln!("{}: {:.2} times as long as one", storage.name(), sixteen / one);
        assert!(sixteen < 4.0 * one, "{storage:?} {one} {sixteen}");
        if matches!(storage, Storage::F16 | Storage::Bf16) {
            let products = measure(&BatchMma::new(&device, &scene, &[state]).expect("a trial"));
            eprintln!("{} by tensor cores: {:.2} times as long as one", storage.name(), products / one);
            assert!(products < 4.0 * one, "{storage:?} {one} {products}");
        }
    }
}
