//! Geometry below the ground plane: AOVs other than depth and picks ignore the ground; depth includes it.

use std::sync::Arc;

use modalcast_compute::reference::ReferenceDeformer;
use modalcast_model::deform::Deformer as _;
use modalcast_model::domain::{Material, Transform};
use modalcast_model::scene::{Camera, Ground, PixelRect, Scene, SceneState, View};
use modalcast_render::{Aov, FrameParams, PickHit};
use nalgebra::{Matrix4, Vector3};

use super::harness::{SceneBuilder, facing_rectangle, front_camera, open_renderer};

/// Side of the picture in pixels.
const SIZE: u32 = 64;

/// A wall of 40 x 30 pixels on the ground.
fn wall(samples: u32, ground: Option<Ground>) -> Arc<Scene> {
    let mut builder = SceneBuilder::new();
    (builder.parts.look.ground, builder.parts.look.samples) = (ground, samples);
    builder.add_domain(facing_rectangle(-2.0, 0.0, 2.0, 3.0, 0.0), Material::default()).build()
}

/// A camera slightly above the ground, so that the ground can hide the geometry below it.
fn from_above() -> Camera {
    Camera { view: View::LookAt { eye: [0.0, 3.0, 10.0], target: [0.0; 3], up: [0.0, 1.0, 0.0] }, ..front_camera(SIZE) }
}

/// Words of an AOV and the hits of all pixels, with the wall lowered by half of its height.
fn measure(scene: &Arc<Scene>, field: Aov) -> (Vec<u32>, Vec<PickHit>) {
    let mut state = SceneState::rest(scene);
    state.transforms[0] = Transform::from_matrix(&Matrix4::new_translation(&Vector3::new(0.0, -1.5, 0.0)));
    let mut deformer = ReferenceDeformer::new(scene);
    let bounds = deformer.deform(&state).expect("expected the step to succeed").bounds;
    let mut renderer = open_renderer();
    let mut buffers = renderer.load(scene).expect("expected the scene to load");
    renderer.upload(&buffers, deformer.surface().expect("there")).expect("expected the upload to succeed");
    renderer.upload_vertex_values(&mut buffers, &[0.25, 0.5, 0.75, 1.0]).expect("expected the upload to succeed");
    let shot = FrameParams { camera: from_above(), width: SIZE, height: SIZE, bounds, light: None };
    let words =
        bytemuck::pod_collect_to_vec(&renderer.render_aov(&buffers, &shot, field).expect("expected AOVs").bytes);
    let whole = PixelRect::within([SIZE; 2], [0; 2], [SIZE; 2]).expect("inside");
    let pick = renderer.begin_pick(&buffers, &shot, whole).expect("expected a readback to start");
    (words, renderer.finish_pick(pick).expect("ends"))
}

#[test]
fn measurements_below_the_ground_equal_those_without_ground() {
    for (samples, field) in
        [(1, Aov::Domains), (1, Aov::Normals), (1, Aov::Values { largest: 1.0 }), (4, Aov::Values { largest: 1.0 })]
    {
        let [with, without] = [Some(Ground::default()), None].map(|ground| measure(&wall(samples, ground), field));
        assert_eq!(with, without, "{field:?}, {samples} samples");
        assert!(with.1.len() > 900, "{field:?}: {} pixels picked", with.1.len());
        let below = with.1.iter().filter(|hit| hit.position[1] < 0.0).count();
        assert!(below > 400, "{field:?}: {below} pixels below the ground");
    }
}

#[test]
fn depth_includes_the_ground() {
    let [with, without] = [Some(Ground::default()), None].map(|ground| measure(&wall(1, ground), Aov::Depth).0);
    let infinite = |words: &[u32]| words.iter().filter(|word| f32::from_bits(**word) == f32::INFINITY).count();
    assert!(infinite(&without) > infinite(&with) + 1000, "the ground is seen beside the wall");
    let nearer = with.iter().zip(&without).filter(|(with, without)| {
        let [with, without] = [with, without].map(|word| f32::from_bits(**word));
        without.is_finite() && with < without
    });
    assert!(nearer.count() > 400, "and before what is below it");
}
