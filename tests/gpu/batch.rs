//! Many coordinate vectors for one U, read once: each instance is where the deformer puts it alone, bit by bit.

use std::sync::Arc;

use modalcast_compute::gpu::{BatchMma, Cache, Device, Extent, Launch, Ours, Trial, gigabytes_per_second, time};
use modalcast_compute::storage::bound::{Reaches, Step};
use modalcast_compute::storage::{Products, QUAD, TILE_QUADS, Tiles};
use modalcast_model::domain::Transform;
use modalcast_model::scene::{Batches, Deformation, Normals, Parts, Scene, State, Storage};

use crate::both::following::grove;
use crate::both::readers::wrong_box;
use crate::both::{run, scene_of, strip, within};
use crate::judge::same_bits;
use crate::scenes::{self, Random};
use crate::twins::deformer;

/// The scene with batches and without.
fn both(mut parts: impl FnMut() -> Parts) -> [Arc<Scene>; 2] {
    [Batches::Always, Batches::Never].map(|batches| {
        let mut parts = parts();
        parts.deformation.batches = batches;
        Scene::new(parts).expect("a scene")
    })
}

/// `count` domains of one shape, deformed so.
fn ensemble((vertices, rank, count): (usize, usize, usize), deformation: Deformation) -> Parts {
    let mut parts = scenes::parts(vec![scenes::shape(&mut Random(7), vertices, rank)]);
    parts.domains = vec![scenes::domain(0, 0); count];
    parts.deformation = deformation;
    parts
}

fn stored(storage: Storage) -> Deformation {
    Deformation { storage, ..Deformation::default() }
}

fn made(parts: Parts) -> Arc<Scene> {
    Scene::new(parts).expect("a scene")
}

fn states(scene: &Scene) -> Vec<State> {
    (1..=3).map(|seed| scenes::state(scene, seed)).collect()
}

/// Shows states of a scene with batches and without, and returns in how many a bit differs.
fn differences(name: &str, [together, apart]: &[Arc<Scene>; 2]) -> usize {
    let (mut one, mut other) = (deformer(together), deformer(apart));
    assert!(one.plan().kernel(Launch::Batch).is_some(), "{name}: there is a batch");
    assert!(other.plan().kernel(Launch::Batch).is_none(), "{name}: there is none");
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

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_a_batch_has_the_bits_of_domains_apart_at_every_size_rank_count_and_storage() {
    for storage in Storage::ALL {
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
            let deformation = Deformation { boxes: true, ..stored(storage) };
            let name = format!("{} n, r, domains {size:?}", storage.name());
            assert_eq!(differences(&name, &both(|| ensemble(size, deformation))), 0, "{name}");
        }
    }
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_blocks_with_several_tiles_have_the_bits_of_domains_apart() {
    // More than 8,192 tiles, so that a block has two or three of them; the last is not whole.
    for (storage, vertices) in [(Storage::F32, 1_100_007), (Storage::Int8, 1_100_007), (Storage::F16, 1_600_001)] {
        let name = format!("{} n {vertices}", storage.name());
        let scenes = both(|| ensemble((vertices, 5, 3), Deformation { boxes: true, ..stored(storage) }));
        let blocks = modalcast_compute::gpu::plan(&scenes[0]).kernel(Launch::Batch).expect("a batch").blocks as usize;
        assert!(2 * blocks <= vertices.div_ceil(QUAD * TILE_QUADS) + 1, "{name}: {blocks} blocks");
        assert_eq!(differences(&name, &scenes), 0, "{name}");
    }
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_batches_among_other_domains_agree_with_all_that_a_scene_may_ask_for() {
    let exact = |storage| Deformation { normals: Normals::Exact, ..stored(storage) };
    let crowd = |deformation: Deformation, normal_maps: bool| {
        let mut random = Random(70);
        let sizes = [(300, 33), (40, 0), (7, 2), (513, 5), (200, 0), (130, 1)];
        let shapes = sizes.iter().enumerate().map(|(at, (vertices, rank))| match at % 2 {
            0 => strip(&mut random, *vertices, *rank),
            _ => scenes::shape(&mut random, *vertices, *rank),
        });
        let scene = scene_of(shapes.collect(), 19, deformation, normal_maps);
        let mut parts = scenes::parts(scene.shapes.clone());
        (parts.domains, parts.deformation) = (scene.domains.clone(), deformation);
        // One that has nobody to share with.
        parts.shapes.push(scenes::shape(&mut random, 90, 9));
        parts.domains.push(scenes::domain(sizes.len(), 0));
        parts
    };
    for (deformation, normal_maps) in [
        (stored(Storage::F32), true),
        (stored(Storage::F16), false),
        (exact(Storage::F32), true),
        (exact(Storage::Int8), false),
        (Deformation { boxes: true, ..stored(Storage::Bf16) }, true),
    ] {
        let name = format!("{deformation:?}, normal maps {normal_maps}");
        assert_eq!(differences(&name, &both(|| crowd(deformation, normal_maps))), 0, "{name}");
        let name = format!("followers, {name}");
        assert_eq!(differences(&name, &both(|| grove(90, deformation, !normal_maps))), 0, "{name}");
    }
}

/// The largest error of a vertex over the bound of its tile: of U in 16 bits, of q in two numbers of 16 bits, and of the
/// tensor cores' own sums.
fn of_bound(scene: &Scene, state: &State, positions: &[f32]) -> f64 {
    let (shape, storage) = (scene.shape_of(0), scene.deformation.storage);
    let tiles = Tiles::new(shape, storage);
    let (reaches, products) = (Reaches::new(shape, &tiles), Products::of(storage, tiles.rank()));
    let vertices = shape.mesh.rest().len();
    let want = modalcast_compute::reference::deform(scene, state);
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
            let scene = made(ensemble((vertices, rank, count), stored(storage)));
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
    assert!(refused(&made(ensemble((9, 2, 2), stored(Storage::F32)))).to_string().contains("f16 or bf16"));
    assert!(refused(&made(ensemble((9, 2, 33), stored(Storage::F16)))).to_string().contains("at most 32"));
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_what_overflows_on_its_way_in_f32_is_mended_in_a_batch_too() {
    for vertices in [300, 512] {
        let [together, apart] =
            both(|| ensemble((vertices, 5, 6), Deformation { boxes: true, ..Deformation::default() }));
        let (mut one, mut other) = (deformer(&together), deformer(&apart));
        let mut state = scenes::state(&together, 4);
        // The sum of domain 1 overflows for good; the products of domain 3 do, although their sum need not.
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

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_sixteen_vectors_at_once_take_less_than_half_as_long_as_one_after_the_other() {
    let device = Device::open(0).expect("a CUDA device");
    let measure = |trial: &dyn Trial| {
        let us = time(&device, trial, Cache::Warm, 200).expect("times").median_us;
        let bytes: u64 = trial.bytes().iter().map(|(_, bytes)| bytes).sum();
        let rate = gigabytes_per_second(bytes, us);
        eprintln!("{}: {us:.1} us, {rate:.0} GB/s, {:?}", trial.name(), trial.kernels());
        us
    };
    for storage in Storage::ALL {
        let batched = Deformation { batches: Batches::Always, ..stored(storage) };
        let scene = made(ensemble((1_500_000, 32, 1), batched));
        let state = scenes::state(&scene, 1);
        let one = measure(&Ours::new(&device, &scene, &[state], Extent::Positions).expect("a trial"));
        let scene = made(ensemble((1_500_000, 32, 16), batched));
        let state = scenes::state(&scene, 1);
        let sixteen = Ours::new(&device, &scene, std::slice::from_ref(&state), Extent::Positions).expect("a trial");
        assert_eq!(sixteen.kernels()[0].name, "batch");
        let sixteen = measure(&sixteen);
        eprintln!("{}: {:.2} times as long as one", storage.name(), sixteen / one);
        assert!(sixteen < 8.0 * one, "{storage:?} {one} {sixteen}");
        if matches!(storage, Storage::F16 | Storage::Bf16) {
            let products = measure(&BatchMma::new(&device, &scene, &[state]).expect("a trial"));
            eprintln!("{} by tensor cores: {:.2} times as long as one", storage.name(), products / one);
            assert!(products < 8.0 * one, "{storage:?} {one} {products}");
        }
    }
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_scenes_that_choose_have_batches_where_they_pay() {
    let device = Device::open(0).expect("a CUDA device");
    let mut slow = Vec::new();
    for (vertices, rank) in [(1000, 32), (4000, 32), (16_000, 8), (16_000, 32), (64_000, 32), (500_000, 32)] {
        for count in [2, 3, 4, 8, 16, 64] {
            if vertices * count * rank > 1 << 29 {
                continue;
            }
            let of =
                |batches| made(ensemble((vertices, rank, count), Deformation { batches, ..Deformation::default() }));
            let [together, apart, chosen] = [Batches::Always, Batches::Never, Batches::Auto].map(of);
            let state = scenes::state(&together, 1);
            let measured = |scene: &Arc<Scene>| {
                let ours = Ours::new(&device, scene, std::slice::from_ref(&state), Extent::Positions).expect("a trial");
                time(&device, &ours, Cache::Warm, 100).expect("times").median_us
            };
            let [batch, alone] = [&together, &apart].map(measured);
            let chooses = modalcast_compute::gpu::plan(&chosen).kernel(Launch::Batch).is_some();
            eprintln!("n {vertices} r {rank} x {count}: {batch:.1} us batched, {alone:.1} apart, chosen {chooses}");
            let (own, other) = if chooses { (batch, alone) } else { (alone, batch) };
            if own > 1.5 * other + 2.0 {
                slow.push((vertices, rank, count, own, other));
            }
        }
    }
    assert!(slow.is_empty(), "chosen and slower: {slow:?}");
}
