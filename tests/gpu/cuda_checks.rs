//! Runs the checks of `tests/common` on the CUDA deformer, and tests scenes that are too large for the CPU tests.

use modalcast::config::BackendChoice;
use modalcast_compute::gpu::{BufferRole, KernelKind};
use modalcast_model::domain::{Domain, FollowConstraint};
use modalcast_model::scene::{DeformationSettings, Scene};

use crate::common::{
    self, attributes, distant_steps, extreme_values, followers, neighbors, overflow, partial_steps, surfaces,
};
use crate::reference_comparison::{cuda_deformer, cuda_deformer_with_batches};
use crate::scenes::{self, Random};

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_huge_tiny_and_denormal_q_stay_within_the_bound() {
    extreme_values::check_huge_and_tiny_q(cuda_deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_columns_that_differ_by_1e12_stay_within_the_bound() {
    extreme_values::check_column_scales(cuda_deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_nearly_canceling_modes_need_compensated_sums() {
    extreme_values::check_canceling_modes(cuda_deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_finite_sums_survive_intermediate_overflow() {
    extreme_values::check_intermediate_overflow(cuda_deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_zero_tiles_do_not_move() {
    extreme_values::check_zero_tiles(cuda_deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_every_rank_and_storage_stays_within_its_bound() {
    extreme_values::check_ranks(cuda_deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_shears_and_mirrors_equal_the_reference() {
    surfaces::check_shears_and_mirrors(cuda_deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_singular_transforms_have_the_normal_of_their_plane() {
    surfaces::check_singular_transforms(cuda_deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_zero_area_and_missing_uvs_give_valid_directions() {
    surfaces::check_zero_area_and_missing_uvs(cuda_deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_overflow_is_reported_for_its_step_only() {
    overflow::check_overflow_affects_one_step(cuda_deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_overflow_error_names_the_domain() {
    overflow::check_overflow_rejection(BackendChoice::Cuda);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_partial_steps_have_the_bits_of_full_steps() {
    partial_steps::check_partial_steps(cuda_deformer_with_batches);
}

/// Negative control of the previous test: a step depends on its list of dirty domains, those that have changed.
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_domain_missing_from_the_list_does_not_move() {
    assert!(partial_steps::relies_on_dirty_list(cuda_deformer));
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_displacements_are_within_bound_and_boxes_tight() {
    attributes::check_displacements_and_boxes(cuda_deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_scene_without_modes_has_zero_displacements() {
    attributes::check_scene_without_modes(cuda_deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_displacements_and_boxes_are_read_separately() {
    attributes::check_separate_reads(cuda_deformer);
    attributes::check_separate_readbacks(cuda_deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_displacement_overflow_is_reported() {
    attributes::check_displacement_overflow(cuda_deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_displacement_overflow_error_names_the_domain() {
    attributes::check_displacement_overflow_rejection(BackendChoice::Cuda);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_domain_bits_do_not_depend_on_neighbors() {
    neighbors::check_independence_of_neighbors(cuda_deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_domain_of_four_million_vertices_is_within_its_bound() {
    let scene = scenes::random_scene(
        &[(4_000_000, 2)],
        scenes::RandomSceneOptions { instances: 1, normal_maps: false, rigid_transforms: false },
    );
    let mut state = scenes::random_state(&scene, 91);
    let mut deformer = cuda_deformer(&scene);
    let positions = common::run_step(&mut deformer, &state).surface.positions;
    common::assert_within_bound("n 4,000,000 r 2", &scene, &state, &positions);
    state.q[1] = -state.q[1];
    assert_eq!(common::domains_beyond_bound(&scene, &state, &positions), [0], "negative control");
}

/// Each domain has its own shape, so that a tile (up to 128 vertices, in quads of four) contains many domains.
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_two_hundred_thousand_domains_take_three_launches() {
    let mut random = Random(92);
    let shapes: Vec<_> = (0..200_000).map(|index| common::strip_shape(&mut random, 7, index % 5)).collect();
    let scene = common::scene_of_shapes(shapes, 1, DeformationSettings::default(), false);
    let mut deformer = cuda_deformer(&scene);
    let plan = deformer.plan();
    eprintln!(
        "200,000 domains of 7: at most {} launches per step, {:?}",
        plan.launches(),
        plan.kernel(KernelKind::Deform)
    );
    assert_eq!(plan.launches(), 3);
    let mut state = scenes::random_state(&scene, 93);
    let result = common::run_step(&mut deformer, &state);
    common::assert_within_bound("200,000 domains of 7", &scene, &state, &result.surface.positions);
    // A partial step of a thousand domains has the bits of a full step, and no other domain moves.
    let dirty_domains: Vec<u32> = (0..1000).map(|index| index * 199 + 7).collect();
    partial_steps::randomize_q_and_transforms(&scene, &mut state, &mut random, &dirty_domains, &dirty_domains[..500]);
    let partial_result = common::run_step(&mut deformer, &state);
    let mut dirty_state = state.clone();
    dirty_state.mark_all_dirty();
    assert_eq!(partial_result.difference(&common::run_step(&mut deformer, &dirty_state)), None);
    let has_moved = |domain: usize| {
        let first = 3 * scene.layout.domains[domain].first_vertex;
        // A domain has 7 vertices.
        result.surface.positions[first..first + 3 * 7] != partial_result.surface.positions[first..first + 3 * 7]
    };
    let moved_domains = (0..scene.domains.len()).filter(|domain| has_moved(*domain)).count();
    eprintln!("{moved_domains} of 1000 dirty domains move");
    // All dirty domains have a new q, and 500 of them a new transform. Of the other 500, a fifth have no modes and do
    // not move, so about 900 domains move.
    assert!(moved_domains > 800 && moved_domains <= 1000, "expected 801 to 1000 moved domains, got {moved_domains}");
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_followers_have_the_bits_of_equivalent_roots() {
    followers::check_frames(cuda_deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_partial_steps_of_roots_move_their_followers() {
    followers::check_partial_steps_of_roots(cuda_deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_followers_10000_km_away_are_exact_to_1_mm() {
    followers::check_far_followers(cuda_deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_model_driven_far_away_keeps_its_relative_precision() {
    distant_steps::check_driven_model(cuda_deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_overflowing_frame_products_keep_finite_vertices() {
    followers::check_overflowing_frame_products(cuda_deformer);
}

/// A step copies the transforms of a thousand branches, not of two hundred thousand leaves, and the leaves follow their
/// branches.
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_two_hundred_thousand_leaves_follow_their_branches() {
    let mut random = Random(94);
    let shapes = vec![
        common::strip_shape(&mut random, 60, 6),
        common::strip_shape(&mut random, 4, 0),
        common::strip_shape(&mut random, 7, 0),
    ];
    let mut parts = scenes::parts_of_shapes(shapes);
    parts.rigid_transforms = true;
    // Domains 0 to 999 are branches. The leaves follow them in turn, so a branch has 200 leaves.
    for index in 0..201_000 {
        let parent = index % 1000;
        let is_mirrored = index % 5 == 0;
        let frame = random.next_similarity(is_mirrored);
        let follows = (index >= 1000).then_some(FollowConstraint { parent, frame });
        let shape = if index < 1000 { 0 } else { 1 + index % 2 };
        parts.domains.push(Domain {
            name: format!("domain {index}"),
            follows,
            ..scenes::new_domain(shape, scenes::PLAIN_MATERIAL)
        });
    }
    let scene = Scene::new(parts).expect("expected a valid scene");
    let mut deformer = cuda_deformer(&scene);
    let plan = deformer.plan();
    eprintln!(
        "201,000 domains: {} bytes per step, {} bytes of follower frames",
        plan.bytes_in,
        plan.bytes(BufferRole::FollowerFrames)
    );
    // A step copies its header (112 bytes), and for each of the 1000 branches a transform (48 bytes) and six
    // coordinates (4 bytes each).
    assert_eq!((plan.launches(), plan.bytes_in), (3, 112 + 48 * 1000 + 4 * 6000));
    let mut state = scenes::random_state(&scene, 95);
    let result = common::run_step(&mut deformer, &state);
    common::assert_within_bound("200,000 leaves", &scene, &state, &result.surface.positions);
    partial_steps::randomize_q_and_transforms(&scene, &mut state, &mut random, &[7], &[3, 999]);
    let partial_result = common::run_step(&mut deformer, &state);
    common::assert_within_bound(
        "200,000 leaves, two branches moved",
        &scene,
        &state,
        &partial_result.surface.positions,
    );
    let mut dirty_state = state.clone();
    dirty_state.mark_all_dirty();
    assert_eq!(partial_result.difference(&common::run_step(&mut deformer, &dirty_state)), None);
    let has_moved = |domain: usize| {
        let layout = scene.layout.domains[domain];
        let range = 3 * layout.first_vertex..3 * (layout.first_vertex + layout.vertices);
        result.surface.positions[range.clone()] != partial_result.surface.positions[range]
    };
    let moved_domains = (0..scene.domains.len()).filter(|domain| has_moved(*domain)).count();
    assert_eq!(
        moved_domains,
        2 * 201 + 1,
        "expected branches 3 and 999 with 200 leaves each to move, and branch 7 to deform"
    );
}
