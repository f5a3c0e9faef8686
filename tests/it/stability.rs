//! Runs the checks of `tests/both` on the CPU deformer.

use std::sync::Arc;

use modalcast::config::BackendChoice;
use modalcast_compute::cpu::CpuDeformer;
use modalcast_compute::storage::Truncation;
use modalcast_model::scene::Scene;

use crate::both::{changes, extremes, following, light, neighbors, readers, refusal, surfaces, truncation};

fn deformer(scene: &Arc<Scene>) -> CpuDeformer {
    CpuDeformer::new(scene)
}

/// Bound on the error of a vertex from truncated modes, the largest of all domains.
fn left_out(deformer: &CpuDeformer, scene: &Scene) -> f64 {
    let bound = |domain| deformer.truncation(domain).map_or(0.0, Truncation::bound);
    (0..scene.domains.len()).map(bound).fold(0.0, f64::max)
}

#[test]
fn huge_tiny_and_denormal_q_stay_within_the_bound() {
    extremes::huge_and_tiny_amounts(deformer);
}

#[test]
fn columns_that_differ_by_1e12_stay_within_the_bound() {
    extremes::columns_of_every_scale(deformer);
}

#[test]
fn nearly_canceling_modes_need_compensated_sums() {
    extremes::modes_that_nearly_cancel(deformer);
}

#[test]
fn finite_sums_survive_intermediate_overflow() {
    extremes::finite_sums_that_overflow_on_their_way(deformer);
}

#[test]
fn zero_tiles_do_not_move() {
    extremes::tiles_of_zeros(deformer);
}

#[test]
fn every_rank_and_storage_stays_within_its_bound() {
    extremes::ranks_of_all_sizes(deformer);
}

#[test]
fn shears_and_mirrors_equal_the_twin() {
    surfaces::shears_and_mirrors(deformer);
}

#[test]
fn zero_area_and_missing_uvs_give_unit_directions() {
    surfaces::no_area_and_no_uvs(deformer);
}

#[test]
fn overflow_is_reported_for_its_step_only() {
    refusal::overflow_is_told_and_forgotten(deformer);
}

#[test]
fn overflow_refusal_names_the_domain() {
    refusal::overflow_is_refused_by_name(BackendChoice::Cpu);
}

#[test]
fn errors_of_twenty_truncated_states_stay_within_the_budget() {
    truncation::errors_within_the_budget(deformer, left_out);
}

#[test]
fn mode_near_the_truncation_limit_does_not_flicker() {
    truncation::no_flicker(deformer);
}

#[test]
fn partial_steps_have_the_bits_of_full_steps() {
    changes::steps_of_a_few_domains(deformer);
    assert!(!changes::trusts_change_lists(deformer), "the cpu compares values");
}

#[test]
fn displacements_and_boxes_equal_their_twins() {
    readers::displacements_and_boxes_equal_their_twins(deformer);
}

#[test]
fn scene_without_modes_has_zero_displacements() {
    readers::a_scene_without_modes_has_zeros(deformer);
}

#[test]
fn displacements_and_boxes_are_read_alone() {
    readers::parts_are_read_alone(deformer);
    readers::parts_are_fetched_alone(deformer);
}

#[test]
fn displacement_overflow_is_reported_and_others_survive() {
    readers::lost_displacements_are_told_and_others_survive(deformer);
}

#[test]
fn displacement_overflow_refusal_names_the_domain() {
    readers::lost_displacements_are_refused_by_name(BackendChoice::Cpu);
}

#[test]
fn domain_has_the_same_bits_alone_and_among_others() {
    neighbors::alone_and_among_others(deformer);
}

#[test]
fn followers_have_the_bits_of_roots_in_their_places() {
    following::frames_of_all_sizes(deformer);
}

#[test]
fn partial_steps_of_roots_move_their_followers() {
    following::steps_of_movers(deformer);
}

#[test]
fn followers_10000_km_away_keep_the_millimeter() {
    following::far_away(deformer);
}

#[test]
fn overflowing_frame_products_keep_finite_vertices() {
    following::products_that_overflow(deformer);
}

#[test]
fn light_bounds_contain_every_vertex() {
    light::every_vertex_is_held(deformer);
}

#[test]
fn thin_scene_is_fitted_closely_in_light_space() {
    light::a_thin_scene_is_fitted_closely(deformer);
}

#[test]
fn light_bounds_need_a_shadow_and_report_overflow() {
    light::nothing_is_measured_without_a_shadow_and_overflow_is_told(deformer);
}
