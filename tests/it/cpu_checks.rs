//! Runs the checks of `tests/common` on the CPU deformer. In test names, "the bound" is the a-priori error bound of a
//! deformed vertex, and "the reference" is the f64 reference deformer.

use std::sync::Arc;

use modalcast::config::BackendChoice;
use modalcast_compute::cpu::CpuDeformer;
use modalcast_compute::reference::ReferenceDeformer;
use modalcast_model::scene::Scene;

use crate::common::{
    attributes, distant_steps, extreme_values, followers, light_bounds, neighbors, overflow, partial_steps, surfaces,
};

/// A deformer that also computes light-space bounds if the scene has a shadow.
fn cpu_deformer(scene: &Arc<Scene>) -> CpuDeformer {
    CpuDeformer::new(scene).with_bounding_axes(scene.light_axes())
}

#[test]
fn huge_tiny_and_denormal_q_stay_within_the_bound() {
    extreme_values::check_huge_and_tiny_q(cpu_deformer);
}

#[test]
fn columns_that_differ_by_1e12_stay_within_the_bound() {
    extreme_values::check_column_scales(cpu_deformer);
}

#[test]
fn nearly_canceling_modes_need_compensated_sums() {
    extreme_values::check_canceling_modes(cpu_deformer);
}

#[test]
fn finite_sums_survive_intermediate_overflow() {
    extreme_values::check_intermediate_overflow(cpu_deformer);
}

#[test]
fn tiles_with_zero_modes_do_not_move() {
    extreme_values::check_zero_tiles(cpu_deformer);
}

#[test]
fn every_rank_and_storage_stays_within_its_bound() {
    extreme_values::check_ranks(cpu_deformer);
}

#[test]
fn shears_and_mirrors_equal_the_reference() {
    surfaces::check_shears_and_mirrors(cpu_deformer);
}

#[test]
fn singular_transforms_have_the_normal_of_their_plane() {
    surfaces::check_singular_transforms(cpu_deformer);
}

#[test]
fn zero_area_and_missing_uvs_give_valid_directions() {
    surfaces::check_zero_area_and_missing_uvs(cpu_deformer);
}

#[test]
fn overflow_is_reported_for_its_step_only() {
    overflow::check_overflow_affects_one_step(cpu_deformer);
}

#[test]
fn overflow_error_names_the_domain() {
    overflow::check_overflow_rejection(BackendChoice::Cpu);
}

#[test]
fn partial_steps_have_the_bits_of_full_steps() {
    // Only the CUDA deformer has a batch policy (whether it deforms domains that share U together).
    partial_steps::check_partial_steps(|scene, _batch_policy| cpu_deformer(scene));
    assert!(partial_steps::relies_on_dirty_list(cpu_deformer), "control: expected only listed domains to be compared");
}

#[test]
fn displacements_are_within_bound_and_boxes_are_tight() {
    attributes::check_displacements_and_boxes(cpu_deformer);
}

#[test]
fn scene_without_modes_has_zero_displacements() {
    attributes::check_scene_without_modes(cpu_deformer);
}

#[test]
fn displacements_and_boxes_are_read_separately() {
    attributes::check_separate_reads(cpu_deformer);
    attributes::check_separate_readbacks(cpu_deformer);
}

#[test]
fn displacement_overflow_is_reported() {
    attributes::check_displacement_overflow(cpu_deformer);
}

#[test]
fn displacement_overflow_error_names_the_domain() {
    attributes::check_displacement_overflow_rejection(BackendChoice::Cpu);
}

#[test]
fn vertex_bits_do_not_depend_on_other_domains() {
    neighbors::check_independence_of_neighbors(cpu_deformer);
}

#[test]
fn followers_have_the_bits_of_equivalent_transform_roots() {
    followers::check_frames(cpu_deformer);
}

#[test]
fn partial_steps_of_transform_roots_move_their_followers() {
    followers::check_partial_steps_of_roots(cpu_deformer);
}

#[test]
fn followers_10000_km_away_are_exact_to_1_mm() {
    followers::check_far_followers(cpu_deformer);
}

#[test]
fn model_driven_far_away_keeps_its_relative_precision() {
    distant_steps::check_driven_model(cpu_deformer);
}

#[test]
fn reference_of_a_driven_model_keeps_its_relative_precision() {
    distant_steps::check_driven_model(ReferenceDeformer::new);
}

#[test]
fn overflow_in_products_of_frames_keeps_vertices_finite() {
    followers::check_overflowing_frame_products(cpu_deformer);
}

#[test]
fn light_space_bounds_contain_every_vertex() {
    light_bounds::check_containment(|scene, _batch_policy| cpu_deformer(scene));
}

#[test]
fn light_space_bounds_of_a_thin_scene_are_tight() {
    light_bounds::check_tightness(cpu_deformer);
}

#[test]
fn light_space_bounds_need_a_shadow_and_report_overflow() {
    light_bounds::check_missing_shadow_and_overflow(cpu_deformer);
}
