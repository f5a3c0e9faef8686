//! Light-space bounds from the kernel `bounds`, compared with its twin for each tile.

use modalcast_model::deform::Deformer;
use modalcast_model::scene::{DeformationSettings, SceneState};

use crate::both::light::{self, TILE, along, beyond, coil, reach};
use crate::both::scene_of;
use crate::scenes::{self};
use crate::twins::deformer;

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_light_bounds_contain_every_vertex() {
    light::every_vertex_is_held(deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_thin_scene_is_fitted_closely_in_light_space() {
    light::a_thin_scene_is_fitted_closely(deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_light_bounds_need_a_shadow_and_report_overflow() {
    light::nothing_is_measured_without_a_shadow_and_overflow_is_told(deformer);
}

/// The scene has one domain, so each tile is 128 consecutive vertices.
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_light_bounds_equal_those_of_tile_boxes() {
    for vertices in [2, 31, 32, 33, 127, 128, 129, 257, 5000, 16085, 200_000] {
        let scene = scene_of(vec![coil(vertices, 3)], 1, DeformationSettings::default(), false);
        let mut deformer = deformer(&scene);
        for seed in 0..3 {
            let deformed = deformer.deform(&scenes::state(&scene, seed)).expect("deforms");
            let (light, positions) =
                (deformed.light.expect("measured"), &deformer.surface().expect("copies").positions);
            let (want, allowed) = (along(&scene, positions, TILE), 4e-7 * reach(&deformed.bounds));
            let (inside, outside) = (beyond(&light, &want), beyond(&want, &light));
            assert!(inside <= 0.0 && outside <= allowed, "n {vertices}: {light:?}, expected {want:?}");
        }
        let other = deformer.deform(&SceneState::rest(&scene)).expect("deforms").light.expect("measured");
        let moved = deformer.deform(&scenes::state(&scene, 0)).expect("deforms").light.expect("measured");
        assert!(beyond(&other, &moved).max(beyond(&moved, &other)) > 1e-3, "control");
    }
}
