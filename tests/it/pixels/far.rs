//! Images ten thousand kilometers from the scene origin equal those at the origin. A scene unit is one meter here. The
//! vertices of a far domain are relative to a floating origin, a grid point near the domain, so that f32 suffices.

use std::sync::Arc;

use modalcast::config::{BackendChoice, Config};
use modalcast::engine::DeviceContext;
use modalcast_model::backend_settings::BackendSettings;
use modalcast_model::domain::Material;
use modalcast_model::scene::{
    Camera, FrameSize, Lens, RawStepUpdate, RenderSettings, Scene, SceneState, ShadowMethod, ShadowSettings,
    StepUpdate, TransformFormat, View,
};
use modalcast_render::FrameImage;

use super::harness::{SceneBuilder, facing_rectangle, floor_mesh};

/// A position that is not on the grid of floating origins and not representable in f32.
const FAR_POSITION: [f64; 3] = [1e7 + 1.3, 0.0, -1e7 - 2.7];

fn open_context() -> DeviceContext {
    DeviceContext::open(&Config { backend: BackendChoice::Cpu, ..Config::default() }).expect("expected a renderer")
}

/// The rest state with `domains` (indices) moved by an f64 translation.
fn move_domains(scene: &Scene, domains: &[u32], [x, y, z]: [f64; 3]) -> SceneState {
    // `QuaternionXyzwF64`: a quaternion (x, y, z, w) in f32, here the identity, then a translation in f64.
    let transform_bytes = || {
        let quaternion = [0.0, 0.0, 0.0, 1.0_f32].into_iter().flat_map(f32::to_le_bytes);
        quaternion.chain([x, y, z].into_iter().flat_map(f64::to_le_bytes))
    };
    let raw_update = RawStepUpdate {
        transform_domains: domains.to_vec(),
        transforms: domains.iter().flat_map(|_| transform_bytes()).collect(),
        transform_format: TransformFormat::QuaternionXyzwF64,
        ..RawStepUpdate::default()
    };
    let mut state = SceneState::rest(scene);
    state.apply(scene, &StepUpdate::parse(scene, &raw_update).expect("expected a valid step"));
    state
}

/// A camera that looks obliquely from above at a square around `target`. Clip planes of 0 are fitted to the bounds.
fn camera_at(target: [f64; 3]) -> Camera {
    let eye = [target[0] + 1.7, target[1] + 2.1, target[2] + 3.3];
    let view = View::LookAt { eye, target: [target[0], target[1] + 0.2, target[2]], up: [0.0, 1.0, 0.0] };
    Camera { view, lens: Lens::FieldOfView(40.0), near: 0.0, far: 0.0 }
}

fn draw_frame(context: &mut DeviceContext, scene: &Arc<Scene>, state: &SceneState, camera: &Camera) -> FrameImage {
    let mut loaded_scene = context.load_scene(scene, BackendSettings::default()).expect("expected the scene to load");
    loaded_scene.deform(state).expect("expected the step to succeed");
    let image = context.draw(&mut loaded_scene, camera, FrameSize::new(96, 96)).expect("expected a frame");
    context.unload_scene(loaded_scene);
    image
}

/// Difference of two images.
struct ImageDifference {
    /// Largest difference of a channel, in levels of 255.
    max_levels: u8,
    /// Number of pixels that differ by more than one level.
    different_pixels: usize,
}

fn compare_images(left: &FrameImage, right: &FrameImage) -> ImageDifference {
    let pairs = left.rgba.chunks_exact(4).zip(right.rgba.chunks_exact(4));
    let pixel_difference = |(a, b): (&[u8], &[u8])| a.iter().zip(b).map(|(a, b)| a.abs_diff(*b)).max().unwrap_or(0);
    let pixel_differences: Vec<u8> = pairs.map(pixel_difference).collect();
    ImageDifference {
        max_levels: pixel_differences.iter().copied().max().unwrap_or(0),
        different_pixels: pixel_differences.iter().filter(|levels| **levels > 1).count(),
    }
}

/// A table over the ground, with the default look and the given shadow.
fn table_scene(shadow: Option<ShadowSettings>) -> Arc<Scene> {
    let mut builder = SceneBuilder::new();
    builder.parts.look = RenderSettings { shadow, ..RenderSettings::default() };
    builder
        .add_domain(floor_mesh(0.8, 0.5), Material::default())
        .add_domain(floor_mesh(0.4, 0.0), Material::default())
        .build()
}

/// The scene has a ground and every kind of shadow map.
#[test]
fn far_scene_renders_like_the_scene_at_the_origin() {
    let mut context = open_context();
    // About ten thousand kilometers along x and z. Texels of a shadow map are aligned to a grid that is fixed in the
    // world. So the edge of a shadow looks the same only after a move by multiples of the texel size.
    let grid_position = [9766.0 * 1024.0, 0.0, -9767.0 * 1024.0];
    // Off the grid, rounding moves positions by up to 1/500 pixel. A sample that is closer to an edge may change sides,
    // which affects at most one pixel in a thousand: 9 of 96 x 96.
    let default_shadow = ShadowSettings::default();
    let cases = [
        (Some(default_shadow), grid_position, 0),
        (Some(ShadowSettings { method: ShadowMethod::Standard, ..default_shadow }), grid_position, 0),
        (Some(ShadowSettings { method: ShadowMethod::PercentageCloser, ..default_shadow }), grid_position, 0),
        (Some(ShadowSettings { cascades: 3, ..default_shadow }), grid_position, 0),
        (None, FAR_POSITION, 9),
    ];
    for (shadow, position, max_different_pixels) in cases {
        let scene = table_scene(shadow);
        let origin_frame = draw_frame(&mut context, &scene, &SceneState::rest(&scene), &camera_at([0.0; 3]));
        let far_state = move_domains(&scene, &[0, 1], position);
        assert!(
            far_state.origins.as_ref().is_some_and(|origins| origins.has_no_outliers()),
            "expected one floating origin for both domains"
        );
        let far_frame = draw_frame(&mut context, &scene, &far_state, &camera_at(position));
        let ImageDifference { max_levels, different_pixels } = compare_images(&origin_frame, &far_frame);
        assert!(
            different_pixels <= max_different_pixels,
            "{different_pixels} pixels differ at {position:?}, by up to {max_levels} levels"
        );
    }
    let scene = table_scene(None);
    let origin_frame = draw_frame(&mut context, &scene, &SceneState::rest(&scene), &camera_at([0.0; 3]));
    let far_state = move_domains(&scene, &[0, 1], FAR_POSITION);
    let rounded_position = FAR_POSITION.map(|number| f64::from(number as f32));
    let moved_position = [FAR_POSITION[0] + 0.1, 0.0, FAR_POSITION[2]];
    for (position, change) in [(rounded_position, "rounded to f32"), (moved_position, "moved by 0.1")] {
        let frame = draw_frame(&mut context, &scene, &far_state, &camera_at(position));
        let difference = compare_images(&origin_frame, &frame);
        assert!(difference.max_levels > 8, "negative control: expected another image from a position {change}");
    }
}

/// The rest bounds keep their height, so that the frame's bounds span the whole distance from the ground to the scene.
#[test]
fn scene_at_a_height_of_100_km_renders_like_the_scene_at_0() {
    let mut context = open_context();
    let scene = SceneBuilder::new().add_domain(floor_mesh(0.8, 0.5), Material::default()).build();
    let origin_frame = draw_frame(&mut context, &scene, &SceneState::rest(&scene), &camera_at([0.0; 3]));
    let surface_pixels = origin_frame.rgba.chunks_exact(4).filter(|pixel| pixel[0] > 50).count();
    assert!(surface_pixels > 1000, "control: expected a visible surface, got {surface_pixels} pixels");
    for height in [1e5, 98.0 * 1024.0, -1e5] {
        let high_state = move_domains(&scene, &[0], [0.0, height, 0.0]);
        let high_frame = draw_frame(&mut context, &scene, &high_state, &camera_at([0.0, height, 0.0]));
        let ImageDifference { max_levels, different_pixels } = compare_images(&origin_frame, &high_frame);
        assert!(
            different_pixels <= 9,
            "height {height}: {different_pixels} pixels differ, by up to {max_levels} levels"
        );
    }
}

/// A camera near one of two distant domains sees only that domain.
#[test]
fn distant_domains_are_seen_by_nearby_cameras() {
    let mut context = open_context();
    let square = |z: f32| facing_rectangle(-0.7, -0.3, 0.6, 0.9, z);
    let red = Material { diffuse: [1.0, 0.1, 0.1], ambient: [1.0, 0.1, 0.1], ..Material::default() };
    let scene =
        SceneBuilder::new().add_domain(square(0.0), Material::default()).add_domain(square(-0.1), red.clone()).build();
    let single_domain_scene = |material: Material, z| SceneBuilder::new().add_domain(square(z), material).build();
    let (gray_scene, red_scene) = (single_domain_scene(Material::default(), 0.0), single_domain_scene(red, -0.1));
    let mut draw_at_rest =
        |scene: &Arc<Scene>| draw_frame(&mut context, scene, &SceneState::rest(scene), &camera_at([0.0; 3]));
    let frames = [draw_at_rest(&gray_scene), draw_at_rest(&red_scene), draw_at_rest(&scene)];
    // Indices in `frames`.
    let (gray, red, both) = (0, 1, 2);
    let separated_state = move_domains(&scene, &[1], FAR_POSITION);
    assert!(
        separated_state.origins.as_ref().is_some_and(|origins| !origins.has_no_outliers()),
        "expected a floating origin per domain"
    );
    let mut loaded_scene = context.load_scene(&scene, BackendSettings::default()).expect("expected the scene to load");
    // Draws the scene of both domains and returns the largest difference from each of `frames`, in levels.
    let mut compare_with_frames = |state: &SceneState, target| {
        loaded_scene.deform(state).expect("expected the step to succeed");
        let image =
            context.draw(&mut loaded_scene, &camera_at(target), FrameSize::new(96, 96)).expect("expected a frame");
        [gray, red, both].map(|index| compare_images(&image, &frames[index]).max_levels)
    };
    // Whether an image equals only the frame with the index `expected`.
    let equals_only =
        |differences: [u8; 3], expected: usize| (0..3).all(|index| (differences[index] <= 1) == (index == expected));
    // Twice, because no frame may contain pixels of an earlier frame.
    for _ in 0..2 {
        let far_differences = compare_with_frames(&separated_state, FAR_POSITION);
        let origin_differences = compare_with_frames(&separated_state, [0.0; 3]);
        let rest_differences = compare_with_frames(&SceneState::rest(&scene), [0.0; 3]);
        assert!(equals_only(far_differences, red), "expected the red domain, got {far_differences:?}");
        assert!(equals_only(origin_differences, gray), "expected the gray domain, got {origin_differences:?}");
        assert!(equals_only(rest_differences, both), "expected both domains, got {rest_differences:?}");
    }
    context.unload_scene(loaded_scene);
}
