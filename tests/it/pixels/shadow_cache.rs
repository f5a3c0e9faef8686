//! Frames of several cameras share the shadow map of their step, and equal frames rendered separately.

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

/// A cut-out square and an opaque square that float above the ground.
fn cut_out_scene(splits: u32) -> Arc<Scene> {
    let mut builder = with_square(create_builder(), AlphaMode::Mask { cutoff: 0.5 }, 1.0);
    builder.parts.look.shadow = Some(ShadowSettings { size: 256, splits, ..ShadowSettings::default() });
    builder.add_domain(super::harness::floor_mesh(0.5, 2.0), Material::default()).build()
}

/// The surface and the bounds at rest, shifted along x.
fn shifted_surface(cut_out_scene: &Arc<Scene>, shift: f32) -> (DeformedSurface, BoundingBox) {
    let mut deformer = ReferenceDeformer::new(cut_out_scene);
    let mut bounds = deformer.deform(&SceneState::rest(cut_out_scene)).expect("expected the step to succeed").bounds;
    let mut shifted_surface = deformer.surface().expect("expected a surface").clone();
    shifted_surface.positions.chunks_exact_mut(3).for_each(|position| position[0] += shift);
    (bounds.min[0], bounds.max[0]) = (bounds.min[0] + f64::from(shift), bounds.max[0] + f64::from(shift));
    (shifted_surface, bounds)
}

/// Two cameras that differ in their field of view.
fn cameras(cut_out_scene: &Scene) -> [Camera; 2] {
    let first = Camera::fit_to_scene(cut_out_scene, 64, 64);
    [first, Camera { lens: Lens::FieldOfView(25.0), ..first }]
}

fn frame_params(camera: Camera, bounds: BoundingBox) -> FrameParams {
    FrameParams { camera, width: 64, height: 64, bounds, light: None }
}

fn count_shadow_passes(renderer: &Renderer) -> usize {
    renderer.stats().passes.iter().filter(|pass| [Pass::Shadow, Pass::Blur].contains(pass)).count()
}

/// The image of a new renderer.
fn render_alone(cut_out_scene: &Arc<Scene>, shift: f32, camera: Camera) -> Vec<u8> {
    let mut renderer = open_renderer();
    let buffers = renderer.load(cut_out_scene).expect("expected the scene to load");
    let (shifted_surface, bounds) = shifted_surface(cut_out_scene, shift);
    renderer.upload(&buffers, &shifted_surface).expect("expected the upload to succeed");
    renderer.draw(&buffers, &frame_params(camera, bounds)).expect("expected a frame").rgba
}

/// Images of both cameras at two steps, and the number of shadow passes of each.
fn render_two_steps(cut_out_scene: &Arc<Scene>, name: impl Fn(&SceneBuffers, u64)) -> Vec<(Vec<u8>, usize)> {
    let mut renderer = open_renderer();
    let buffers = renderer.load(cut_out_scene).expect("expected the scene to load");
    let mut frames = Vec::new();
    for (step, shift) in [(1, 0.0), (2, 0.7)] {
        let (shifted_surface, bounds) = shifted_surface(cut_out_scene, shift);
        renderer.upload(&buffers, &shifted_surface).expect("expected the upload to succeed");
        name(&buffers, step);
        for camera in cameras(cut_out_scene) {
            let image = renderer.draw(&buffers, &frame_params(camera, bounds)).expect("expected a frame");
            frames.push((image.rgba, count_shadow_passes(&renderer)));
        }
    }
    frames
}

fn pass_counts(frames: &[(Vec<u8>, usize)]) -> Vec<usize> {
    frames.iter().map(|(_, count)| *count).collect()
}

#[test]
fn cameras_of_one_step_share_its_shadow() {
    let cut_out_scene = cut_out_scene(1);
    let frames = render_two_steps(&cut_out_scene, SceneBuffers::set_step);
    assert_eq!(pass_counts(&frames), [2, 0, 2, 0], "expected shadow and blur once per step");
    let [first, second] = cameras(&cut_out_scene);
    for ((frame, _), (shift, camera)) in frames.iter().zip([(0.0, first), (0.0, second), (0.7, first), (0.7, second)]) {
        assert!(*frame == render_alone(&cut_out_scene, shift, camera), "{shift}");
    }
    assert!(frames[0].0 != frames[1].0 && frames[1].0 != frames[3].0, "negative control: expected different images");
}

/// Shadow maps that are split by the view, and shadows of vertices without a step number, are drawn for each frame. A
/// shadow is redrawn if the bounds change under the same step number.
#[test]
fn view_dependent_shadows_are_drawn_for_each_frame() {
    assert_eq!(pass_counts(&render_two_steps(&cut_out_scene(1), |_, _| ())), [2; 4], "without a step number");
    assert_eq!(pass_counts(&render_two_steps(&cut_out_scene(2), SceneBuffers::set_step)), [2; 4], "split by the view");
    let frames = render_two_steps(&cut_out_scene(1), |buffers, _| buffers.set_step(7));
    assert_eq!(pass_counts(&frames), [2, 0, 2, 0], "other bounds under the same step number");
}

#[test]
fn upload_bounds_or_origin_invalidate_the_shadow() {
    let cut_out_scene = cut_out_scene(1);
    let mut renderer = open_renderer();
    let mut buffers = renderer.load(&cut_out_scene).expect("expected the scene to load");
    let ((shifted_surface, bounds), [camera, _]) = (shifted_surface(&cut_out_scene, 0.0), cameras(&cut_out_scene));
    renderer.upload(&buffers, &shifted_surface).expect("expected the upload to succeed");
    buffers.set_step(1);
    let draw = |renderer: &mut Renderer, buffers: &SceneBuffers, bounds| {
        renderer.draw(buffers, &frame_params(camera, bounds)).expect("expected a frame");
        count_shadow_passes(renderer)
    };
    let wider_bounds = BoundingBox { min: bounds.min.map(|side| side - 1.0), ..bounds };
    let shadow_passes =
        [bounds, bounds, wider_bounds, wider_bounds, bounds].map(|bounds| draw(&mut renderer, &buffers, bounds));
    assert_eq!(shadow_passes, [2, 0, 2, 0, 2]);
    let nan_bounds = BoundingBox { min: [f64::NAN; 3], max: [f64::NAN; 3] };
    assert_eq!(
        [nan_bounds, nan_bounds].map(|bounds| draw(&mut renderer, &buffers, bounds)),
        [2, 2],
        "NaN bounds never equal"
    );
    let light_bounds_passes = [0.0, 0.0, 0.5, 0.5].map(|expansion| {
        let axes = cut_out_scene.light_axes().expect("expected a scene with a shadow");
        let light = Some(OrientedBounds::enclosing(&axes, &bounds).expanded_by(expansion));
        renderer.draw(&buffers, &FrameParams { light, ..frame_params(camera, bounds) }).expect("expected a frame");
        count_shadow_passes(&renderer)
    });
    assert_eq!(light_bounds_passes, [2, 0, 2, 0], "expected a shadow for other light bounds");
    buffers.set_origin([1024.0, 0.0, 0.0]);
    assert_eq!([bounds, bounds].map(|bounds| draw(&mut renderer, &buffers, bounds)), [2, 0]);
    renderer.upload(&buffers, &shifted_surface).expect("expected the upload to succeed");
    assert_eq!([bounds, bounds].map(|bounds| draw(&mut renderer, &buffers, bounds)), [2, 2]);
}

#[test]
fn frames_of_an_engine_step_share_its_shadow() {
    let cut_out_scene = cut_out_scene(1);
    let mut context = DeviceContext::open(&Config { backend: BackendChoice::Cpu, ..Config::default() })
        .expect("expected a device context");
    let mut loaded_scene =
        context.load_scene(&cut_out_scene, BackendSettings::default()).expect("expected the scene to load");
    let draw_frames = |context: &mut DeviceContext, loaded_scene: &mut modalcast::engine::LoadedScene| {
        cameras(&cut_out_scene).map(|camera| {
            let rgba = context.draw(loaded_scene, &camera, FrameSize::new(64, 64)).expect("expected a frame").rgba;
            let stats = context.stats().expect("expected a frame").passes.clone();
            (rgba, stats.iter().filter(|pass| **pass == Pass::Shadow).count())
        })
    };
    let mut state = SceneState::rest(&cut_out_scene);
    loaded_scene.deform(&state).expect("expected the step to succeed");
    let first = draw_frames(&mut context, &mut loaded_scene);
    assert_eq!(pass_counts(&first), [1, 0]);
    assert_eq!(
        pass_counts(&draw_frames(&mut context, &mut loaded_scene)),
        [0, 0],
        "expected no shadow pass for the same step"
    );
    let last_domain = cut_out_scene.domains.len() - 1;
    let valid_state = state.clone();
    state.transforms[last_domain].0[3] = 2.0;
    loaded_scene.deform(&state).expect("expected the step to succeed");
    let second = draw_frames(&mut context, &mut loaded_scene);
    assert_eq!(pass_counts(&second), [1, 0], "expected a shadow pass for a new step");
    state.transforms[last_domain].0[3] = 1e30;
    loaded_scene.deform(&state).expect_err("expected an overflow error");
    let third = draw_frames(&mut context, &mut loaded_scene);
    assert!(third[0].0 == second[0].0 && third[1].0 == second[1].0, "expected frames of the last valid step");
    loaded_scene.deform(&valid_state).expect("expected the step to succeed");
    let fourth = draw_frames(&mut context, &mut loaded_scene);
    assert!(fourth[0].0 == first[0].0 && fourth[0].0 != second[0].0, "negative control");
    context.unload_scene(loaded_scene);
}
