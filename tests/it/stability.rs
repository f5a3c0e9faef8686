//! The checks of any deformer, on the cpu.

use std::sync::Arc;

use modalcast::config::BackendChoice;
use modalcast_compute::cpu::CpuDeformer;
use modalcast_compute::storage::Truncation;
use modalcast_model::scene::Scene;

use crate::both::{changes, extremes, following, light, neighbours, readers, refusal, surfaces, truncation};

fn deformer(scene: &Arc<Scene>) -> CpuDeformer {
    CpuDeformer::new(scene)
}

/// How far a vertex may be off for the modes that were left out.
fn left_out(deformer: &CpuDeformer, scene: &Scene) -> f64 {
    let bound = |domain| deformer.truncation(domain).map_or(0.0, Truncation::bound);
    (0..scene.domains.len()).map(bound).fold(0.0, f64::max)
}

#[test]
fn q_of_1e30_1e_minus_38_and_denormals_stay_within_the_bound() {
    extremes::huge_and_tiny_amounts(deformer);
}

#[test]
fn columns_that_differ_by_1e12_stay_within_the_bound() {
    extremes::columns_of_every_scale(deformer);
}

#[test]
fn modes_that_nearly_cancel_keep_their_digits_with_compensation_and_lose_them_without() {
    extremes::modes_that_nearly_cancel(deformer);
}

#[test]
fn finite_sums_survive_overflow_on_their_way_and_infinity_less_infinity() {
    extremes::finite_sums_that_overflow_on_their_way(deformer);
}

#[test]
fn tiles_of_zeros_stay_where_q_of_zero_puts_them() {
    extremes::tiles_of_zeros(deformer);
}

#[test]
fn every_rank_in_every_storage_stays_within_its_bound_down_to_one_vertex() {
    extremes::ranks_of_all_sizes(deformer);
}

#[test]
fn shears_and_mirrors_equal_the_twin() {
    surfaces::shears_and_mirrors(deformer);
}

#[test]
fn triangles_without_area_and_missing_uvs_give_directions_of_unit_length() {
    surfaces::no_area_and_no_uvs(deformer);
}

#[test]
fn overflow_is_told_and_forgotten() {
    refusal::overflow_is_told_and_forgotten(deformer);
}

#[test]
fn overflow_is_refused_by_the_name_of_its_domain() {
    refusal::overflow_is_refused_by_name(BackendChoice::Cpu);
}

#[test]
fn errors_of_twenty_truncated_states_stay_within_the_budget() {
    truncation::errors_within_the_budget(deformer, left_out);
}

#[test]
fn a_mode_that_swings_about_the_limit_does_not_flicker() {
    truncation::no_flicker(deformer);
}

#[test]
fn twenty_steps_of_a_few_domains_give_the_bits_of_whole_ones() {
    changes::steps_of_a_few_domains(deformer);
    assert!(!changes::believes_lists(deformer), "the cpu compares values");
}

#[test]
fn displacements_and_boxes_equal_their_twins_and_change_no_vertex() {
    readers::displacements_and_boxes_equal_their_twins(deformer);
}

#[test]
fn a_scene_without_modes_has_displacements_of_zero() {
    readers::a_scene_without_modes_has_zeros(deformer);
}

#[test]
fn displacements_and_boxes_are_read_alone_and_are_those_of_the_last_step() {
    readers::parts_are_read_alone(deformer);
    readers::parts_are_fetched_alone(deformer);
}

#[test]
fn displacements_that_no_f32_holds_are_told_and_others_survive() {
    readers::lost_displacements_are_told_and_others_survive(deformer);
}

#[test]
fn a_lost_displacement_is_refused_by_the_name_of_its_domain() {
    readers::lost_displacements_are_refused_by_name(BackendChoice::Cpu);
}

#[test]
fn a_domain_has_the_same_bits_alone_and_among_a_thousand() {
    neighbours::alone_and_among_others(deformer);
}

#[test]
fn followers_stay_within_their_bounds_and_have_the_bits_of_movers_in_their_places() {
    following::frames_of_all_sizes(deformer);
}

#[test]
fn steps_of_movers_give_the_bits_of_whole_ones_and_move_their_followers() {
    following::steps_of_movers(deformer);
}

#[test]
fn followers_ten_thousand_kilometres_away_keep_the_millimetre() {
    following::far_away(deformer);
}

#[test]
fn products_of_frames_that_overflow_do_no_harm_where_the_vertices_do_not() {
    following::products_that_overflow(deformer);
}

#[test]
fn what_vertices_take_up_in_light_space_holds_every_one_of_them() {
    light::every_vertex_is_held(deformer);
}

#[test]
fn a_thin_scene_is_fitted_closely_in_light_space() {
    light::a_thin_scene_is_fitted_closely(deformer);
}

#[test]
fn light_space_is_not_measured_without_a_shadow_and_overflow_there_is_told() {
    light::nothing_is_measured_without_a_shadow_and_overflow_is_told(deformer);
}
