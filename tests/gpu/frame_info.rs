//! Information that comes with frames of the CUDA deformer: the look that the renderer has chosen for a scene without a
//! preset, and the depth of vertices below the ground.

use modalcast::config::{BackendChoice, Config};
use modalcast::engine::DeviceContext;
use modalcast_model::backend_settings::BackendSettings;
use modalcast_model::domain::Transform;
use modalcast_model::scene::{Camera, FrameSize, SceneState, ShadowMethod};
use nalgebra::{Matrix4, Vector3};

use crate::gl::Exclusive;

/// The bounds that the CUDA deformer computes are those of the vertices, so the depth is exact up to rounding.
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_frames_report_variance_shadows_and_depth_below_ground() {
    let tree = modalcast_model::load::open("tree").expect("expected the built-in scene").scene;
    let config = Config { backend: BackendChoice::Cuda, ..Config::default() };
    let mut context = Exclusive::open(|| DeviceContext::open(&config));
    let mut loaded_scene = context.load_scene(&tree, BackendSettings::default()).expect("expected a loaded scene");
    for (size, depth) in
        [(FrameSize::new(64, 48), 0.0), (FrameSize::new(1280, 720), 0.5), (FrameSize::new(96, 64), 0.0)]
    {
        let mut state = SceneState::rest(&tree);
        let lowering = Matrix4::new_translation(&Vector3::new(0.0, -depth, 0.0));
        for transform in &mut state.transforms {
            *transform = Transform::from_matrix(&(lowering * transform.to_matrix()));
        }
        loaded_scene.deform(&state).expect("expected a valid state");
        let camera = Camera::fit_to_scene(&tree, size.width, size.height);
        let info = context.draw(&mut loaded_scene, &camera, size).expect("expected a frame").info;
        let look = info.look.expect("expected the look of a color frame");
        let shadow = look.shadow.expect("expected a shadow");
        assert_eq!((look.preset, look.samples), (None, 4), "{size}");
        assert_eq!((shadow.method, shadow.size), (ShadowMethod::Variance, 1024), "{size}");
        let error = (info.below_ground - depth).abs();
        assert!(error < 1e-4, "expected {depth} m below the ground, got {} m", info.below_ground);
    }
    context.unload_scene(loaded_scene);
}
