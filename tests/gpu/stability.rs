//! Runs the checks of `tests/both` on the device, and checks of scenes too large for the CPU tests.

use modalcast::config::BackendChoice;
use modalcast_compute::gpu::{BufferRole, CudaDeformer, KernelKind};
use modalcast_model::domain::{Domain, FollowConstraint};
use modalcast_model::scene::{DeformationSettings, Scene};

use crate::both::{self, changes, extremes, following, neighbors, readers, refusal, surfaces, truncation};
use crate::scenes::{self, Random};
use crate::twins::deformer;

fn left_out(deformer: &CudaDeformer, _: &Scene) -> f64 {
    deformer.truncation_bound()
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_huge_tiny_and_denormal_q_stay_within_the_bound() {
    extremes::huge_and_tiny_amounts(deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_columns_that_differ_by_1e12_stay_within_the_bound() {
    extremes::columns_of_every_scale(deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_nearly_canceling_modes_need_compensated_sums() {
    extremes::modes_that_nearly_cancel(deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_finite_sums_survive_intermediate_overflow() {
    extremes::finite_sums_that_overflow_on_their_way(deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_zero_tiles_do_not_move() {
    extremes::tiles_of_zeros(deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_every_rank_and_storage_stays_within_its_bound() {
    extremes::ranks_of_all_sizes(deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_shears_and_mirrors_equal_the_twin() {
    surfaces::shears_and_mirrors(deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_zero_area_and_missing_uvs_give_unit_directions() {
    surfaces::no_area_and_no_uvs(deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_overflow_is_reported_for_its_step_only() {
    refusal::overflow_is_told_and_forgotten(deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_overflow_refusal_names_the_domain() {
    refusal::overflow_is_refused_by_name(BackendChoice::Cuda);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_errors_of_twenty_truncated_states_stay_within_the_budget() {
    truncation::errors_within_the_budget(deformer, left_out);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_mode_near_the_truncation_limit_does_not_flicker() {
    truncation::no_flicker(deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_partial_steps_have_the_bits_of_full_steps() {
    changes::steps_of_a_few_domains(deformer);
}

/// Control of the test above: steps do depend on their lists.
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_domain_missing_from_the_list_does_not_move() {
    assert!(changes::trusts_change_lists(deformer));
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_displacements_and_boxes_equal_their_twins() {
    readers::displacements_and_boxes_equal_their_twins(deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_scene_without_modes_has_zero_displacements() {
    readers::a_scene_without_modes_has_zeros(deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_displacements_and_boxes_are_read_alone() {
    readers::parts_are_read_alone(deformer);
    readers::parts_are_fetched_alone(deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_displacement_overflow_is_reported_and_others_survive() {
    readers::lost_displacements_are_told_and_others_survive(deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_displacement_overflow_refusal_names_the_domain() {
    readers::lost_displacements_are_refused_by_name(BackendChoice::Cuda);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_domain_has_the_same_bits_alone_and_among_others() {
    neighbors::alone_and_among_others(deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_domain_of_four_million_vertices_is_within_its_bound() {
    let scene = scenes::scene(&[(4_000_000, 2)], 1, false, false);
    let mut state = scenes::state(&scene, 91);
    let mut deformer = deformer(&scene);
    let positions = both::run(&mut deformer, &state).surface.positions;
    both::within("n 4,000,000 r 2", (&scene, &state), &positions, 0.0);
    state.q[1] = -state.q[1];
    assert_eq!(both::beyond((&scene, &state), &positions, 0.0), [0], "the judge can fail");
}

/// Each domain has its own shape, so that a tile contains quads of many domains.
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_two_hundred_thousand_domains_take_three_launches() {
    let mut random = Random(92);
    let shapes: Vec<_> = (0..200_000).map(|at| both::strip(&mut random, 7, at % 5)).collect();
    let scene = both::scene_of(shapes, 1, DeformationSettings::default(), false);
    let mut deformer = deformer(&scene);
    let plan = deformer.plan();
    eprintln!(
        "200,000 domains of 7: at most {} launches a step, {:?}",
        plan.launches(),
        plan.kernel(KernelKind::Deform)
    );
    assert_eq!(plan.launches(), 3);
    let mut state = scenes::state(&scene, 93);
    let shown = both::run(&mut deformer, &state);
    both::within("200,000 domains of 7", (&scene, &state), &shown.surface.positions, 0.0);
    // A thousand domains change: the bits equal those of a full step, and no other domain moves.
    let few: Vec<u32> = (0..1000).map(|at| at * 199 + 7).collect();
    changes::apply(&scene, &mut state, &mut random, (&few, &few[..500]));
    let after = both::run(&mut deformer, &state);
    let mut whole = state.clone();
    whole.mark_all_dirty();
    assert_eq!(after.difference(&both::run(&mut deformer, &whole)), None);
    let moves = |domain: usize| {
        let first = 3 * scene.layout.slots[domain].first_vertex;
        shown.surface.positions[first..first + 21] != after.surface.positions[first..first + 21]
    };
    let moved = (0..scene.domains.len()).filter(|domain| moves(*domain)).count();
    eprintln!("a thousand named: {moved} move");
    // A fifth of the domains has no modes, and half of the named ones have a new transform.
    assert!(moved > 800 && moved <= 1000, "{moved}");
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_followers_have_the_bits_of_roots_in_their_places() {
    following::frames_of_all_sizes(deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_partial_steps_of_roots_move_their_followers() {
    following::steps_of_movers(deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_followers_10000_km_away_keep_the_millimeter() {
    following::far_away(deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_overflowing_frame_products_keep_finite_vertices() {
    following::products_that_overflow(deformer);
}

/// A step copies a thousand transforms instead of two hundred thousand, and a moved branch moves its leaves.
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_two_hundred_thousand_leaves_follow_their_branches() {
    let mut random = Random(94);
    let shapes = vec![both::strip(&mut random, 60, 6), both::strip(&mut random, 4, 0), both::strip(&mut random, 7, 0)];
    let mut parts = scenes::parts(shapes);
    parts.rigid_transforms = true;
    for at in 0..201_000 {
        let parent = at % 1000;
        let frame = random.similarity(at % 5 == 0);
        let follows = (at >= 1000).then_some(FollowConstraint { parent, frame });
        let shape = if at < 1000 { 0 } else { 1 + at % 2 };
        parts.domains.push(Domain { name: format!("domain {at}"), follows, ..scenes::domain(shape, 0) });
    }
    let scene = Scene::new(parts).expect("a scene");
    let mut deformer = deformer(&scene);
    let plan = deformer.plan();
    eprintln!(
        "201,000 domains: {} bytes a step, {} bytes of frames",
        plan.bytes_in,
        plan.bytes(BufferRole::FollowerFrames)
    );
    assert_eq!((plan.launches(), plan.bytes_in), (3, 112 + 48 * 1000 + 4 * 6000));
    let mut state = scenes::state(&scene, 95);
    let before = both::run(&mut deformer, &state);
    both::within("200,000 leaves", (&scene, &state), &before.surface.positions, 0.0);
    changes::apply(&scene, &mut state, &mut random, (&[7], &[3, 999]));
    let after = both::run(&mut deformer, &state);
    both::within("200,000 leaves, some moved", (&scene, &state), &after.surface.positions, 0.0);
    let mut whole = state.clone();
    whole.mark_all_dirty();
    assert_eq!(after.difference(&both::run(&mut deformer, &whole)), None);
    let moves = |domain: usize| {
        let slot = scene.layout.slots[domain];
        let range = 3 * slot.first_vertex..3 * (slot.first_vertex + slot.vertices);
        before.surface.positions[range.clone()] != after.surface.positions[range]
    };
    let moved = (0..scene.domains.len()).filter(|domain| moves(*domain)).count();
    assert_eq!(moved, 2 * 201 + 1, "two branches with two hundred leaves each, and one that bends alone");
}
