//! Geometry below the ground plane. AOV (arbitrary output variable) readbacks and picks ignore the ground, except depth
//! with ground, where the ground is behind all geometry.

use std::sync::Arc;

use modalcast_compute::reference::ReferenceDeformer;
use modalcast_model::deform::Deformer as _;
use modalcast_model::domain::{Material, Transform};
use modalcast_model::scene::{Camera, Ground, PixelRect, Scene, SceneState, View};
use modalcast_render::{Aov, FrameParams, PickHit};
use nalgebra::{Matrix4, Vector3};

use super::harness::{SceneBuilder, facing_rectangle, front_camera, open_renderer};

/// Side of the image in pixels.
const SIZE: u32 = 64;

/// A wall that is 4 units wide and 3 units high and stands on the ground plane y = 0.
fn wall_scene(samples: u32, ground: Option<Ground>) -> Arc<Scene> {
    let mut builder = SceneBuilder::new();
    (builder.parts.look.ground, builder.parts.look.samples) = (ground, samples);
    builder.add_domain(facing_rectangle(-2.0, 0.0, 2.0, 3.0, 0.0), Material::default()).build()
}

/// A camera 3 units above the ground. From there, the geometry below the ground is behind the ground plane.
fn camera_above_ground() -> Camera {
    Camera { view: View::LookAt { eye: [0.0, 3.0, 10.0], target: [0.0; 3], up: [0.0, 1.0, 0.0] }, ..front_camera(SIZE) }
}

/// Readbacks of all pixels of an image.
#[derive(Debug, PartialEq)]
struct Readbacks {
    /// The AOV as 32-bit words.
    aov_words: Vec<u32>,
    hits: Vec<PickHit>,
}

/// Lowers the wall by half of its height, and reads back an AOV and the picks of all pixels. The wall covers about
/// 1,050 pixels, half of them below the ground.
fn read_aov_and_picks(scene: &Arc<Scene>, aov: Aov) -> Readbacks {
    let mut state = SceneState::rest(scene);
    state.transforms[0] = Transform::from_matrix(&Matrix4::new_translation(&Vector3::new(0.0, -1.5, 0.0)));
    let mut deformer = ReferenceDeformer::new(scene);
    let bounds = deformer.deform(&state).expect("expected the step to succeed").bounds;
    let mut renderer = open_renderer();
    let mut buffers = renderer.load(scene).expect("expected the scene to load");
    renderer.upload(&buffers, deformer.surface().expect("expected a surface")).expect("expected the upload to succeed");
    renderer.upload_vertex_values(&mut buffers, &[0.25, 0.5, 0.75, 1.0]).expect("expected the upload to succeed");
    let params = FrameParams {
        camera: camera_above_ground(),
        width: SIZE,
        height: SIZE,
        bounds,
        light_bounds: None,
        edges: None,
        samples: None,
    };
    let aov_words =
        bytemuck::pod_collect_to_vec(&renderer.render_aov(&buffers, &params, aov).expect("expected AOVs").bytes);
    let full_image = PixelRect::within([SIZE; 2], [0; 2], [SIZE; 2]).expect("expected a valid rectangle");
    let pick = renderer.begin_pick(&buffers, &params, full_image).expect("expected a pick to start");
    Readbacks { aov_words, hits: renderer.finish_pick(pick).expect("expected hits") }
}

#[test]
fn picks_and_aovs_ignore_the_ground() {
    for (samples, aov) in [
        (1, Aov::Depth),
        (1, Aov::Domains),
        (1, Aov::Normals),
        (1, Aov::Values { scale_max: 1.0 }),
        (4, Aov::Values { scale_max: 1.0 }),
    ] {
        let [with_ground, without_ground] =
            [Some(Ground::default()), None].map(|ground| read_aov_and_picks(&wall_scene(samples, ground), aov));
        assert_eq!(with_ground, without_ground, "{aov:?}, {samples} samples");
        assert!(with_ground.hits.len() > 900, "{aov:?}: {} pixels picked", with_ground.hits.len());
        let below_ground = with_ground.hits.iter().filter(|hit| hit.position[1] < 0.0).count();
        assert!(below_ground > 400, "{aov:?}: {below_ground} pixels below the ground");
    }
}

#[test]
fn depth_with_ground_has_the_ground_behind_all_geometry() {
    let scene = wall_scene(1, Some(Ground::default()));
    let [depths_with_ground, depths] = [Aov::DepthWithGround, Aov::Depth]
        .map(|aov| read_aov_and_picks(&scene, aov).aov_words.into_iter().map(f32::from_bits).collect::<Vec<f32>>());
    let wall_pixels = depths.iter().filter(|depth| depth.is_finite()).count();
    assert!(wall_pixels > 900, "{wall_pixels} pixels of the wall");
    let differs_on_wall = |(with_ground, depth): (&f32, &f32)| depth.is_finite() && with_ground != depth;
    assert!(!depths_with_ground.iter().zip(&depths).any(differs_on_wall), "expected the depth of the whole wall");
    let finite_pixels = depths_with_ground.iter().filter(|depth| depth.is_finite()).count();
    assert!(finite_pixels > wall_pixels + 1000, "expected the depth of the ground beside the wall");
    // Without a ground, both depths are equal.
    let scene = wall_scene(1, None);
    let [left, right] = [Aov::DepthWithGround, Aov::Depth].map(|aov| read_aov_and_picks(&scene, aov).aov_words);
    assert_eq!(left, right);
}
