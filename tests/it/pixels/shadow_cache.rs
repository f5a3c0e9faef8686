//! Frames of several cameras share the shadow map of their step, and equal frames rendered separately.

use std::sync::Arc;

use modalcast::config::{BackendChoice, Config};
use modalcast::engine::DeviceContext;
use modalcast_compute::reference::ReferenceDeformer;
use modalcast_model::backend_settings::BackendSettings;
use modalcast_model::deform::{DeformedSurface, Deformer as _};
use modalcast_model::domain::{AlphaMode, Material};
use modalcast_model::scene::{Bounds, Camera, FrameSize, Lens, LightSpaceBox, Scene, SceneState, ShadowSettings};
use modalcast_render::{FrameParams, Renderer, SceneBuffers};

use super::harness::open_renderer;
use super::shadow::{create_builder, with_square};

/// A cut-out square and an opaque square that float above the ground.
fn scene(splits: u32) -> Arc<Scene> {
    let mut builder = with_square(create_builder(), AlphaMode::Mask { cutoff: 0.5 }, 1.0);
    builder.parts.look.shadow = Some(ShadowSettings { size: 256, splits, ..ShadowSettings::default() });
    builder.add_domain(super::harness::floor_mesh(0.5, 2.0), Material::default()).build()
}

/// The scene at rest, shifted along x.
fn surface(scene: &Arc<Scene>, by: f32) -> (DeformedSurface, Bounds) {
    let mut deformer = ReferenceDeformer::new(scene);
    let mut bounds = deformer.deform(&SceneState::rest(scene)).expect("expected the step to succeed").bounds;
    let mut surface = deformer.surface().expect("there").clone();
    surface.positions.chunks_exact_mut(3).for_each(|position| position[0] += by);
    (bounds.min[0], bounds.max[0]) = (bounds.min[0] + f64::from(by), bounds.max[0] + f64::from(by));
    (surface, bounds)
}

/// Two cameras that differ in their field of view.
fn cameras(scene: &Scene) -> [Camera; 2] {
    let first = Camera::fit_to_scene(scene, 64, 64);
    [first, Camera { lens: Lens::FieldOfView(25.0), ..first }]
}

fn shot(camera: Camera, bounds: Bounds) -> FrameParams {
    FrameParams { camera, width: 64, height: 64, bounds, light: None }
}

fn shadows(renderer: &Renderer) -> usize {
    renderer.stats().passes.iter().filter(|pass| ["shadow", "blur"].contains(pass)).count()
}

/// The picture of a renderer of its own.
fn alone(scene: &Arc<Scene>, by: f32, camera: Camera) -> Vec<u8> {
    let mut renderer = open_renderer();
    let buffers = renderer.load(scene).expect("expected the scene to load");
    let (surface, bounds) = surface(scene, by);
    renderer.upload(&buffers, &surface).expect("expected the upload to succeed");
    renderer.draw(&buffers, &shot(camera, bounds)).expect("expected a frame").rgba
}

/// Pictures of both cameras at two steps, and the number of shadow passes of each.
fn two_steps(scene: &Arc<Scene>, name: impl Fn(&SceneBuffers, u64)) -> Vec<(Vec<u8>, usize)> {
    let mut renderer = open_renderer();
    let buffers = renderer.load(scene).expect("expected the scene to load");
    let mut frames = Vec::new();
    for (step, by) in [(1, 0.0), (2, 0.7)] {
        let (surface, bounds) = surface(scene, by);
        renderer.upload(&buffers, &surface).expect("expected the upload to succeed");
        name(&buffers, step);
        for camera in cameras(scene) {
            let image = renderer.draw(&buffers, &shot(camera, bounds)).expect("expected a frame");
            frames.push((image.rgba, shadows(&renderer)));
        }
    }
    frames
}

fn counts(frames: &[(Vec<u8>, usize)]) -> Vec<usize> {
    frames.iter().map(|(_, count)| *count).collect()
}

#[test]
fn cameras_of_one_step_share_its_shadow() {
    let scene = scene(1);
    let frames = two_steps(&scene, SceneBuffers::set_step);
    assert_eq!(counts(&frames), [2, 0, 2, 0], "shadow and blur, once a step");
    let [first, second] = cameras(&scene);
    for ((frame, _), (by, camera)) in frames.iter().zip([(0.0, first), (0.0, second), (0.7, first), (0.7, second)]) {
        assert!(*frame == alone(&scene, by, camera), "{by}");
    }
    assert!(frames[0].0 != frames[1].0 && frames[1].0 != frames[3].0, "control: they differ");
}

/// So are shadows of vertices without a step number. Shadows are redrawn when the bounds change under the same step
/// number.
#[test]
fn view_dependent_shadows_are_drawn_for_each_frame() {
    assert_eq!(counts(&two_steps(&scene(1), |_, _| ())), [2; 4], "no name");
    assert_eq!(counts(&two_steps(&scene(2), SceneBuffers::set_step)), [2; 4], "split by the view");
    let frames = two_steps(&scene(1), |buffers, _| buffers.set_step(7));
    assert_eq!(counts(&frames), [2, 0, 2, 0], "the bounds of the second step differ, whatever it is called");
}

#[test]
fn upload_bounds_or_origin_invalidate_the_shadow() {
    let scene = scene(1);
    let mut renderer = open_renderer();
    let mut buffers = renderer.load(&scene).expect("expected the scene to load");
    let ((surface, bounds), [camera, _]) = (surface(&scene, 0.0), cameras(&scene));
    renderer.upload(&buffers, &surface).expect("expected the upload to succeed");
    buffers.set_step(1);
    let draw = |renderer: &mut Renderer, buffers: &SceneBuffers, bounds| {
        renderer.draw(buffers, &shot(camera, bounds)).expect("expected a frame");
        shadows(renderer)
    };
    let wider = Bounds { min: bounds.min.map(|side| side - 1.0), ..bounds };
    let drawn = [bounds, bounds, wider, wider, bounds].map(|bounds| draw(&mut renderer, &buffers, bounds));
    assert_eq!(drawn, [2, 0, 2, 0, 2]);
    let nobody = Bounds { min: [f64::NAN; 3], max: [f64::NAN; 3] };
    assert_eq!([nobody, nobody].map(|bounds| draw(&mut renderer, &buffers, bounds)), [2, 2], "no bounds are the same");
    let lit = [0.0, 0.0, 0.5, 0.5].map(|more| {
        let axes = scene.light_axes().expect("a shadow");
        let light = Some(LightSpaceBox::enclosing(&axes, &bounds).expanded_by(more));
        renderer.draw(&buffers, &FrameParams { light, ..shot(camera, bounds) }).expect("expected a frame");
        shadows(&renderer)
    });
    assert_eq!(lit, [2, 0, 2, 0], "another box in light space");
    buffers.set_origin([1024.0, 0.0, 0.0]);
    assert_eq!([bounds, bounds].map(|bounds| draw(&mut renderer, &buffers, bounds)), [2, 0]);
    renderer.upload(&buffers, &surface).expect("expected the upload to succeed");
    assert_eq!([bounds, bounds].map(|bounds| draw(&mut renderer, &buffers, bounds)), [2, 2]);
}

#[test]
fn engine_steps_share_a_shadow_and_refused_ones_have_none() {
    let scene = scene(1);
    let mut bench = DeviceContext::open(&Config { backend: BackendChoice::Cpu, ..Config::default() }).expect("opens");
    let mut staged = bench.load_scene(&scene, BackendSettings::default()).expect("expected the scene to load");
    let frames = |bench: &mut DeviceContext, staged: &mut modalcast::engine::LoadedScene| {
        cameras(&scene).map(|camera| {
            let rgba = bench.draw(staged, &camera, FrameSize::new(64, 64)).expect("expected a frame").rgba;
            let stats = bench.stats().expect("expected a frame").passes.clone();
            (rgba, stats.iter().filter(|pass| **pass == "shadow").count())
        })
    };
    let mut state = SceneState::rest(&scene);
    staged.deform(&state).expect("expected the step to succeed");
    let first = frames(&mut bench, &mut staged);
    assert_eq!(counts(&first), [1, 0]);
    assert_eq!(counts(&frames(&mut bench, &mut staged)), [0, 0], "the same step again");
    let last = scene.domains.len() - 1;
    let good = state.clone();
    state.transforms[last].0[3] = 2.0;
    staged.deform(&state).expect("expected the step to succeed");
    let second = frames(&mut bench, &mut staged);
    assert_eq!(counts(&second), [1, 0], "a new step");
    state.transforms[last].0[3] = 1e30;
    staged.deform(&state).expect_err("out of range");
    let third = frames(&mut bench, &mut staged);
    assert!(third[0].0 == second[0].0 && third[1].0 == second[1].0, "the step before it is shown");
    staged.deform(&good).expect("expected the step to succeed");
    let fourth = frames(&mut bench, &mut staged);
    assert!(fourth[0].0 == first[0].0 && fourth[0].0 != second[0].0, "control");
    bench.unload_scene(staged);
}
