//! Frames of one step share one shadow map. They equal frames of a new renderer, which draws its own shadow map.

use std::sync::Arc;

use modalcast::config::{BackendChoice, Config};
use modalcast::engine::DeviceContext;
use modalcast_compute::reference::ReferenceDeformer;
use modalcast_model::backend_settings::BackendSettings;
use modalcast_model::deform::{DeformedSurface, Deformer as _};
use modalcast_model::domain::{AlphaMode, Material};
use modalcast_model::scene::{BoundingBox, Camera, FrameSize, Lens, OrientedBounds, Scene, SceneState, ShadowSettings};
use modalcast_render::{FrameParams, Pass, Renderer, SceneBuffers};

use super::harness::open_renderer;
use super::shadow::{create_builder, with_square};

/// A cut-out square and an opaque square that float above the ground, with a shadow map of `cascades` cascades.
fn create_scene(cascades: u32) -> Arc<Scene> {
    let mut builder = with_square(create_builder(), AlphaMode::Mask { cutoff: 0.5 }, 1.0);
    builder.parts.look.shadow = Some(ShadowSettings { size: 256, cascades, ..ShadowSettings::default() });
    builder.add_domain(super::harness::floor_mesh(0.5, 2.0), Material::default()).build()
}

/// The surface and the bounds at rest, shifted along x by `shift`.
fn shifted_surface(scene: &Arc<Scene>, shift: f32) -> (DeformedSurface, BoundingBox) {
    let mut deformer = ReferenceDeformer::new(scene);
    let mut bounds = deformer.deform(&SceneState::rest(scene)).expect("expected the step to succeed").bounds;
    let mut surface = deformer.surface().expect("expected a surface").clone();
    surface.positions.chunks_exact_mut(3).for_each(|position| position[0] += shift);
    (bounds.min[0], bounds.max[0]) = (bounds.min[0] + f64::from(shift), bounds.max[0] + f64::from(shift));
    (surface, bounds)
}

/// Two cameras that differ in their field of view.
fn cameras(scene: &Scene) -> [Camera; 2] {
    let fitted_camera = Camera::fit_to_scene(scene, 64, 64);
    [fitted_camera, Camera { lens: Lens::FieldOfView(25.0), ..fitted_camera }]
}

fn frame_params(camera: Camera, bounds: BoundingBox) -> FrameParams {
    FrameParams { camera, width: 64, height: 64, bounds, light_bounds: None, edges: None, samples: None }
}

fn count_shadow_passes(passes: &[Pass]) -> usize {
    passes.iter().filter(|pass| [Pass::Shadow, Pass::Blur].contains(pass)).count()
}

/// An image rendered by a new renderer.
fn render_with_new_renderer(scene: &Arc<Scene>, shift: f32, camera: Camera) -> Vec<u8> {
    let mut renderer = open_renderer();
    let buffers = renderer.load(scene).expect("expected the scene to load");
    let (surface, bounds) = shifted_surface(scene, shift);
    renderer.upload(&buffers, &surface).expect("expected the upload to succeed");
    renderer.draw(&buffers, &frame_params(camera, bounds)).expect("expected a frame").rgba
}

struct Frame {
    rgba: Vec<u8>,
    /// Number of passes that drew or blurred the shadow map.
    shadow_passes: usize,
}

/// Frames of both cameras at step 1, where the scene is at rest, and at step 2, where it is shifted. `set_step`
/// receives the buffers and the step number after each upload.
fn render_two_steps(scene: &Arc<Scene>, set_step: impl Fn(&SceneBuffers, u64)) -> Vec<Frame> {
    let mut renderer = open_renderer();
    let buffers = renderer.load(scene).expect("expected the scene to load");
    let mut frames = Vec::new();
    for (step, shift) in [(1, 0.0), (2, 0.7)] {
        let (surface, bounds) = shifted_surface(scene, shift);
        renderer.upload(&buffers, &surface).expect("expected the upload to succeed");
        set_step(&buffers, step);
        for camera in cameras(scene) {
            let image = renderer.draw(&buffers, &frame_params(camera, bounds)).expect("expected a frame");
            frames.push(Frame { rgba: image.rgba, shadow_passes: count_shadow_passes(&renderer.stats().passes) });
        }
    }
    frames
}

fn shadow_pass_counts(frames: &[Frame]) -> Vec<usize> {
    frames.iter().map(|frame| frame.shadow_passes).collect()
}

#[test]
fn cameras_of_one_step_share_its_shadow() {
    let scene = create_scene(1);
    let frames = render_two_steps(&scene, SceneBuffers::set_step);
    assert_eq!(shadow_pass_counts(&frames), [2, 0, 2, 0], "expected shadow and blur once per step");
    let [first_camera, second_camera] = cameras(&scene);
    for (frame, (shift, camera)) in
        frames.iter().zip([(0.0, first_camera), (0.0, second_camera), (0.7, first_camera), (0.7, second_camera)])
    {
        assert!(frame.rgba == render_with_new_renderer(&scene, shift, camera), "{shift}");
    }
    assert!(
        frames[0].rgba != frames[1].rgba && frames[1].rgba != frames[3].rgba,
        "negative control: expected different images"
    );
}

/// The shadow map is drawn for each frame if it depends on the view, as with cascades, or if the step has no number. It
/// is drawn again if the bounds change, even if the step number does not.
#[test]
fn view_dependent_shadows_are_drawn_for_each_frame() {
    assert_eq!(
        // `SceneBuffers::set_step` is not called.
        shadow_pass_counts(&render_two_steps(&create_scene(1), |_, _| ())),
        [2; 4],
        "expected a shadow map per frame without a step number"
    );
    assert_eq!(
        shadow_pass_counts(&render_two_steps(&create_scene(2), SceneBuffers::set_step)),
        [2; 4],
        "expected a shadow map per frame with cascades"
    );
    // Both steps have the number 7.
    let frames = render_two_steps(&create_scene(1), |buffers, _| buffers.set_step(7));
    assert_eq!(shadow_pass_counts(&frames), [2, 0, 2, 0], "expected a shadow map per step with other bounds");
}

#[test]
fn new_bounds_origin_or_surface_invalidate_the_shadow() {
    let scene = create_scene(1);
    let mut renderer = open_renderer();
    let mut buffers = renderer.load(&scene).expect("expected the scene to load");
    let ((surface, bounds), [camera, _]) = (shifted_surface(&scene, 0.0), cameras(&scene));
    renderer.upload(&buffers, &surface).expect("expected the upload to succeed");
    buffers.set_step(1);
    let draw = |renderer: &mut Renderer, buffers: &SceneBuffers, bounds| {
        renderer.draw(buffers, &frame_params(camera, bounds)).expect("expected a frame");
        count_shadow_passes(&renderer.stats().passes)
    };
    let wider_bounds = BoundingBox { min: bounds.min.map(|side| side - 1.0), ..bounds };
    let shadow_passes =
        [bounds, bounds, wider_bounds, wider_bounds, bounds].map(|bounds| draw(&mut renderer, &buffers, bounds));
    assert_eq!(shadow_passes, [2, 0, 2, 0, 2]);
    let nan_bounds = BoundingBox { min: [f64::NAN; 3], max: [f64::NAN; 3] };
    assert_eq!(
        [nan_bounds, nan_bounds].map(|bounds| draw(&mut renderer, &buffers, bounds)),
        [2, 2],
        "expected a new shadow map in each frame with NaN bounds"
    );
    let light_bounds_passes = [0.0, 0.0, 0.5, 0.5].map(|expansion| {
        let axes = scene.light_axes().expect("expected a scene with a shadow");
        let light_bounds = Some(OrientedBounds::enclosing(&axes, &bounds).expanded_by(expansion));
        renderer
            .draw(&buffers, &FrameParams { light_bounds, ..frame_params(camera, bounds) })
            .expect("expected a frame");
        count_shadow_passes(&renderer.stats().passes)
    });
    assert_eq!(light_bounds_passes, [2, 0, 2, 0], "expected a new shadow map for other light bounds");
    buffers.set_shared_origin([1024.0, 0.0, 0.0]);
    assert_eq!([bounds, bounds].map(|bounds| draw(&mut renderer, &buffers, bounds)), [2, 0]);
    // An upload clears the step number. Without a number, every frame draws its shadow map.
    renderer.upload(&buffers, &surface).expect("expected the upload to succeed");
    assert_eq!([bounds, bounds].map(|bounds| draw(&mut renderer, &buffers, bounds)), [2, 2]);
}

#[test]
fn frames_of_an_engine_step_share_its_shadow() {
    let scene = create_scene(1);
    let mut context = DeviceContext::open(&Config { backend: BackendChoice::Cpu, ..Config::default() })
        .expect("expected a device context");
    let mut loaded_scene = context.load_scene(&scene, BackendSettings::default()).expect("expected the scene to load");
    let draw_frames = |context: &mut DeviceContext, loaded_scene: &mut modalcast::engine::LoadedScene| {
        cameras(&scene).map(|camera| {
            let rgba = context.draw(loaded_scene, &camera, FrameSize::new(64, 64)).expect("expected a frame").rgba;
            let passes = context.stats().expect("expected a frame").passes.clone();
            Frame { rgba, shadow_passes: count_shadow_passes(&passes) }
        })
    };
    let mut state = SceneState::rest(&scene);
    loaded_scene.deform(&state).expect("expected the step to succeed");
    let first_frames = draw_frames(&mut context, &mut loaded_scene);
    assert_eq!(shadow_pass_counts(&first_frames), [2, 0]);
    assert_eq!(
        shadow_pass_counts(&draw_frames(&mut context, &mut loaded_scene)),
        [0, 0],
        "expected no shadow pass for the same step"
    );
    let last_domain = scene.domains.len() - 1;
    let rest_state = state.clone();
    // x of the translation, element 3 of the row-major 3 x 4 matrix.
    state.transforms[last_domain].0[3] = 2.0;
    loaded_scene.deform(&state).expect("expected the step to succeed");
    let second_frames = draw_frames(&mut context, &mut loaded_scene);
    assert_eq!(shadow_pass_counts(&second_frames), [2, 0], "expected a shadow pass for a new step");
    // This step fails: the squares of such positions overflow f32.
    state.transforms[last_domain].0[3] = 1e30;
    loaded_scene.deform(&state).expect_err("expected an overflow error");
    let third_frames = draw_frames(&mut context, &mut loaded_scene);
    assert!(
        third_frames[0].rgba == second_frames[0].rgba && third_frames[1].rgba == second_frames[1].rgba,
        "expected frames of the last valid step"
    );
    loaded_scene.deform(&rest_state).expect("expected the step to succeed");
    let fourth_frames = draw_frames(&mut context, &mut loaded_scene);
    assert!(
        fourth_frames[0].rgba == first_frames[0].rgba && fourth_frames[0].rgba != second_frames[0].rgba,
        "expected the frame at rest again, and as negative control another frame of the moved domain"
    );
    context.unload_scene(loaded_scene);
}
