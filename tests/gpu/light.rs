//! Bounds along the axes of the light from the kernel `bounds`, compared with bounds computed from the positions of
//! each tile, a block of vertices.

use modalcast_model::deform::Deformer;
use modalcast_model::scene::{DeformationSettings, SceneState};

use crate::common::light_bounds::{
    self, TILE_VERTICES, bounds_in_light_space, coil_shape, coordinate_magnitude, max_excess,
};
use crate::common::scene_of_shapes;
use crate::reference_comparison::{cuda_deformer, cuda_deformer_with_batches};
use crate::scenes;

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_light_bounds_contain_every_vertex() {
    light_bounds::check_containment(cuda_deformer_with_batches);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_light_bounds_of_a_thin_scene_are_tight() {
    light_bounds::check_tightness(cuda_deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_light_bounds_need_a_shadow_and_report_overflow() {
    light_bounds::check_missing_shadow_and_overflow(cuda_deformer);
}

/// The scene has one domain, so each tile is 128 consecutive vertices.
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_light_bounds_equal_those_of_tile_boxes() {
    for vertices in [2, 31, 32, 33, 127, 128, 129, 257, 5000, 16085, 200_000] {
        let scene = scene_of_shapes(vec![coil_shape(vertices, 3)], 1, DeformationSettings::default(), false);
        let mut deformer = cuda_deformer(&scene);
        for seed in 0..3 {
            let summary = deformer.deform(&scenes::random_state(&scene, seed)).expect("expected the step to succeed");
            let (got, positions) = (
                summary.oriented_bounds.expect("expected light-space bounds"),
                &deformer.surface().expect("expected a surface").positions,
            );
            let expected = bounds_in_light_space(&scene, positions, TILE_VERTICES);
            // A bound is a sum of three products in f32, each with a relative error of at most 2^-23 = 1.2e-7, in total
            // 3.6e-7. `missing` is how far the expected bounds reach beyond the bounds of the device, `excess` the
            // reverse.
            let tolerance = 4e-7 * coordinate_magnitude(&summary.bounds);
            let (missing, excess) = (max_excess(&got, &expected), max_excess(&expected, &got));
            assert!(missing <= 0.0 && excess <= tolerance, "n {vertices}: expected {expected:?}, got {got:?}");
        }
        let rest_bounds = deformer
            .deform(&SceneState::rest(&scene))
            .expect("expected the step to succeed")
            .oriented_bounds
            .expect("expected light-space bounds");
        let moved_bounds = deformer
            .deform(&scenes::random_state(&scene, 0))
            .expect("expected the step to succeed")
            .oriented_bounds
            .expect("expected light-space bounds");
        assert!(
            max_excess(&rest_bounds, &moved_bounds).max(max_excess(&moved_bounds, &rest_bounds)) > 1e-3,
            "negative control: expected other bounds of another state"
        );
    }
}
