//! The checks of any deformer, on the device, and scenes that only it is for.

use modalcast::config::BackendChoice;
use modalcast_compute::gpu::{CudaDeformer, Launch, Role};
use modalcast_model::domain::{Domain, Follow};
use modalcast_model::scene::{Deformation, Scene};

use crate::both::{self, changes, extremes, following, neighbours, readers, refusal, surfaces, truncation};
use crate::scenes::{self, Random};
use crate::twins::deformer;

fn left_out(deformer: &CudaDeformer, _: &Scene) -> f64 {
    deformer.truncation_bound()
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_q_of_1e30_1e_minus_38_and_denormals_stay_within_the_bound() {
    extremes::huge_and_tiny_amounts(deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_columns_that_differ_by_1e12_stay_within_the_bound() {
    extremes::columns_of_every_scale(deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_modes_that_nearly_cancel_keep_their_digits_with_compensation_and_lose_them_without() {
    extremes::modes_that_nearly_cancel(deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_finite_sums_survive_overflow_on_their_way_and_infinity_less_infinity() {
    extremes::finite_sums_that_overflow_on_their_way(deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_tiles_of_zeros_stay_where_q_of_zero_puts_them() {
    extremes::tiles_of_zeros(deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_every_rank_in_every_storage_stays_within_its_bound_down_to_one_vertex() {
    extremes::ranks_of_all_sizes(deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_shears_and_mirrors_equal_the_twin() {
    surfaces::shears_and_mirrors(deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_triangles_without_area_and_missing_uvs_give_directions_of_unit_length() {
    surfaces::no_area_and_no_uvs(deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_overflow_is_told_and_forgotten() {
    refusal::overflow_is_told_and_forgotten(deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_overflow_is_refused_by_the_name_of_its_domain() {
    refusal::overflow_is_refused_by_name(BackendChoice::Cuda);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_errors_of_twenty_truncated_states_stay_within_the_budget() {
    truncation::errors_within_the_budget(deformer, left_out);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_a_mode_that_swings_about_the_limit_does_not_flicker() {
    truncation::no_flicker(deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_twenty_steps_of_a_few_domains_give_the_bits_of_whole_ones() {
    changes::steps_of_a_few_domains(deformer);
}

/// The control of the test above: steps do go by their lists.
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_a_domain_that_a_list_leaves_out_stays_where_it_was() {
    assert!(changes::believes_lists(deformer));
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_displacements_and_boxes_equal_their_twins_and_change_no_vertex() {
    readers::displacements_and_boxes_equal_their_twins(deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_a_scene_without_modes_has_displacements_of_zero() {
    readers::a_scene_without_modes_has_zeros(deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_displacements_and_boxes_are_read_alone_and_are_those_of_the_last_step() {
    readers::parts_are_read_alone(deformer);
    readers::parts_are_fetched_alone(deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_displacements_that_no_f32_holds_are_told_and_others_survive() {
    readers::lost_displacements_are_told_and_others_survive(deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_a_lost_displacement_is_refused_by_the_name_of_its_domain() {
    readers::lost_displacements_are_refused_by_name(BackendChoice::Cuda);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_a_domain_has_the_same_bits_alone_and_among_a_thousand() {
    neighbours::alone_and_among_others(deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_one_domain_of_four_million_vertices_stays_within_its_bound() {
    let scene = scenes::scene(&[(4_000_000, 2)], 1, false, false);
    let mut state = scenes::state(&scene, 91);
    let mut deformer = deformer(&scene);
    let positions = both::run(&mut deformer, &state).surface.positions;
    both::within("n 4,000,000 r 2", (&scene, &state), &positions, 0.0);
    state.q[1] = -state.q[1];
    assert_eq!(both::beyond((&scene, &state), &positions, 0.0), [0], "the judge can fail");
}

/// Each its own shape, so that a tile holds quads of many.
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_two_hundred_thousand_domains_of_seven_take_three_launches_and_stay_within_their_bounds() {
    let mut random = Random(92);
    let shapes: Vec<_> = (0..200_000).map(|at| both::strip(&mut random, 7, at % 5)).collect();
    let scene = both::scene_of(shapes, 1, Deformation::default(), false);
    let mut deformer = deformer(&scene);
    let plan = deformer.plan();
    eprintln!("200,000 domains of 7: at most {} launches a step, {:?}", plan.launches(), plan.kernel(Launch::Deform));
    assert_eq!(plan.launches(), 3);
    let mut state = scenes::state(&scene, 93);
    let shown = both::run(&mut deformer, &state);
    both::within("200,000 domains of 7", (&scene, &state), &shown.surface.positions, 0.0);
    // A thousand of them change: the bits are those of the whole, and no other domain moves.
    let few: Vec<u32> = (0..1000).map(|at| at * 199 + 7).collect();
    changes::apply(&scene, &mut state, &mut random, (&few, &few[..500]));
    let after = both::run(&mut deformer, &state);
    let mut whole = state.clone();
    whole.touch();
    assert_eq!(after.difference(&both::run(&mut deformer, &whole)), None);
    let moves = |domain: usize| {
        let first = 3 * scene.layout.slots[domain].first_vertex;
        shown.surface.positions[first..first + 21] != after.surface.positions[first..first + 21]
    };
    let moved = (0..scene.domains.len()).filter(|domain| moves(*domain)).count();
    eprintln!("a thousand named: {moved} move");
    // A fifth has no modes, and of the named ones half have a new transform.
    assert!(moved > 800 && moved <= 1000, "{moved}");
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_followers_stay_within_their_bounds_and_have_the_bits_of_movers_in_their_places() {
    following::frames_of_all_sizes(deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_steps_of_movers_give_the_bits_of_whole_ones_and_move_their_followers() {
    following::steps_of_movers(deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_followers_ten_thousand_kilometres_away_keep_the_millimetre() {
    following::far_away(deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_products_of_frames_that_overflow_do_no_harm_where_the_vertices_do_not() {
    following::products_that_overflow(deformer);
}

/// A step copies a thousand transforms instead of two hundred thousand, and a branch that moves takes its leaves along.
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_two_hundred_thousand_leaves_follow_a_thousand_branches_within_their_bounds() {
    let mut random = Random(94);
    let shapes = vec![both::strip(&mut random, 60, 6), both::strip(&mut random, 4, 0), both::strip(&mut random, 7, 0)];
    let mut parts = scenes::parts(shapes);
    parts.rigid_transforms = true;
    for at in 0..201_000 {
        let parent = at % 1000;
        let frame = random.similarity(at % 5 == 0);
        let follows = (at >= 1000).then_some(Follow { parent, frame });
        let shape = if at < 1000 { 0 } else { 1 + at % 2 };
        parts.domains.push(Domain { name: format!("domain {at}"), follows, ..scenes::domain(shape, 0) });
    }
    let scene = Scene::new(parts).expect("a scene");
    let mut deformer = deformer(&scene);
    let plan = deformer.plan();
    eprintln!("201,000 domains: {} bytes a step, {} bytes of frames", plan.bytes_in, plan.bytes(Role::Frames));
    assert_eq!((plan.launches(), plan.bytes_in), (3, 112 + 48 * 1000 + 4 * 6000));
    let mut state = scenes::state(&scene, 95);
    let before = both::run(&mut deformer, &state);
    both::within("200,000 leaves", (&scene, &state), &before.surface.positions, 0.0);
    changes::apply(&scene, &mut state, &mut random, (&[7], &[3, 999]));
    let after = both::run(&mut deformer, &state);
    both::within("200,000 leaves, some moved", (&scene, &state), &after.surface.positions, 0.0);
    let mut whole = state.clone();
    whole.touch();
    assert_eq!(after.difference(&both::run(&mut deformer, &whole)), None);
    let moves = |domain: usize| {
        let slot = scene.layout.slots[domain];
        let range = 3 * slot.first_vertex..3 * (slot.first_vertex + slot.vertices);
        before.surface.positions[range.clone()] != after.surface.positions[range]
    };
    let moved = (0..scene.domains.len()).filter(|domain| moves(*domain)).count();
    assert_eq!(moved, 2 * 201 + 1, "two branches with two hundred leaves each, and one that bends alone");
}
