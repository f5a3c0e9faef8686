//! Positions, normals and tangents of the CUDA deformer equal those of the f64 twin at every size.

use std::sync::Arc;

use modalcast_compute::gpu::{CudaDeformer, Device};
use modalcast_model::deform::Deformer;
use modalcast_model::scene::{Scene, SceneState};

use crate::accuracy::{check, same_bits};
use crate::scenes::{self, NORMAL_MAPPED, Random};

pub(crate) fn deformer(scene: &Arc<Scene>) -> CudaDeformer {
    let device = Device::open(0).expect("a CUDA device");
    CudaDeformer::new(&device, scene, None).expect("a deformer")
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_deform_and_orient_equal_twins_at_every_size_and_rank() {
    for vertices in [1, 31, 32, 33, 257, 16085] {
        for rank in [0, 1, 3, 20, 31, 33, 64, 512] {
            let scene = scenes::scene(&[(vertices, rank)], 3, rank % 2 == 1, false);
            let mut deformer = deformer(&scene);
            check(&format!("n {vertices} r {rank}"), &scene, &scenes::state(&scene, 5), &mut deformer);
        }
    }
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_every_feature_combination_equals_its_twin() {
    for (modes, normal_maps, rigid) in (0..8).map(|set| (set & 1 != 0, set & 2 != 0, set & 4 != 0)) {
        let rank = if modes { 5 } else { 0 };
        let scene = scenes::scene(&[(300, rank), (40, 0), (7, rank)], 4, normal_maps, rigid);
        assert_eq!((scene.needs.modes, scene.needs.normal_maps, scene.needs.shear), (modes, normal_maps, !rigid));
        let mut deformer = deformer(&scene);
        assert!(deformer.plan().launches() <= 4);
        let name = format!("modes {modes} normal maps {normal_maps} rigid {rigid}");
        check(&name, &scene, &scenes::state(&scene, 9), &mut deformer);
        assert_eq!(deformer.surface().expect("copies").tangents.is_empty(), !normal_maps);
    }
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_twenty_thousand_small_domains_take_three_launches() {
    let shapes: Vec<_> = (0..50).map(|index| (7, index % 5)).collect();
    let scene = scenes::scene(&shapes, 400, true, false);
    let mut deformer = deformer(&scene);
    assert_eq!((scene.domains.len(), deformer.plan().launches()), (20_000, 3));
    let state = scenes::state(&scene, 3);
    check("20,000 domains", &scene, &state, &mut deformer);
    report("20,000 domains of 7", &mut deformer, &state);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_a_million_vertices_equal_the_twin() {
    let scene = scenes::scene(&[(1_000_000, 32)], 1, false, false);
    let mut deformer = deformer(&scene);
    let state = scenes::state(&scene, 4);
    check("n 1,000,000 r 32", &scene, &state, &mut deformer);
    report("n 1,000,000 r 32", &mut deformer, &state);
}

fn report(name: &str, deformer: &mut CudaDeformer, state: &SceneState) {
    let mut times: Vec<f64> = (0..50).map(|_| deformer.deform(state).expect("deforms").ms).collect();
    times.sort_by(f64::total_cmp);
    eprintln!("{name}: {:.3} ms a step (median of 50, copies and waiting included)", times[25]);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_domains_with_shared_coordinates_move_alike() {
    let mut random = Random(11);
    let mut parts = scenes::parts(vec![
        scenes::shape(&mut random, 100, 4),
        scenes::shape(&mut random, 300, 4),
        scenes::shape(&mut random, 50, 2),
    ]);
    parts.domains = [0, 1, 2, 1].map(|shape| scenes::domain(shape, NORMAL_MAPPED)).into();
    parts.domains[1].shares_q_with = Some(0);
    parts.domains[3].shares_q_with = Some(1);
    let scene = Scene::new(parts).expect("a scene");
    assert_eq!(scene.layout.coordinates, 6);
    let mut state = scenes::state(&scene, 12);
    state.transforms[3] = state.transforms[1];
    let mut deformer = deformer(&scene);
    check("shared q", &scene, &state, &mut deformer);
    let positions = &deformer.surface().expect("copies").positions;
    let [first, second] = [1, 3].map(|domain: usize| &positions[3 * scene.layout.slots[domain].first_vertex..][..900]);
    assert!(same_bits(first, second));
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_bits_do_not_depend_on_history_or_packing() {
    let scene = scenes::scene(&[(1000, 37), (33, 5)], 4, true, false);
    let (mut first, other) = (scenes::state(&scene, 20), scenes::state(&scene, 21));
    // The instances of the first shape differ only in their place in the packing, and no block boundary divides them
    // evenly.
    let q = first.q_of(&scene, 0).to_vec();
    for domain in [2, 4, 6] {
        first.transforms[domain] = first.transforms[0];
        first.q[scene.layout.slots[domain].first_q..][..37].copy_from_slice(&q);
    }
    let mut one = deformer(&scene);
    one.deform(&first).expect("deforms");
    let before = one.surface().expect("copies").clone();
    one.deform(&other).expect("deforms");
    let between = one.surface().expect("copies").clone();
    one.deform(&first).expect("deforms");
    let after = one.surface().expect("copies").clone();
    let mut two = deformer(&scene);
    two.deform(&first).expect("deforms");
    let anew = two.surface().expect("copies");
    assert!(!same_bits(&before.positions, &between.positions), "the judge can fail");
    for same in [&after, anew] {
        assert!(same_bits(&before.positions, &same.positions));
        assert!(same_bits(&before.normals, &same.normals));
        assert!(same_bits(&before.tangents, &same.tangents));
    }
    let of = |domain: usize| &before.positions[3 * scene.layout.slots[domain].first_vertex..][..3000];
    for domain in [2, 4, 6] {
        assert!(same_bits(of(0), of(domain)), "instance {domain}");
    }
}
