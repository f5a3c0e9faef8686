//! Pictures ten thousand kilometers from the scene origin equal those at the origin.

use std::sync::Arc;

use modalcast::config::{BackendChoice, Config};
use modalcast::engine::DeviceContext;
use modalcast_model::backend_settings::BackendSettings;
use modalcast_model::domain::Material;
use modalcast_model::scene::{
    Camera, FrameSize, Lens, ORIGIN_GRID, RawStepUpdate, RenderSettings, Scene, SceneState, ShadowMethod,
    ShadowSettings, StepUpdate, TransformFormat, View,
};
use modalcast_render::FrameImage;

use super::harness::{SceneBuilder, facing_rectangle, floor_mesh};

/// Far position: not on the grid of origin cells, and not representable in f32.
const AWAY: [f64; 3] = [1e7 + 1.3, 0.0, -1e7 - 2.7];

fn bench() -> DeviceContext {
    DeviceContext::open(&Config { backend: BackendChoice::Cpu, ..Config::default() }).expect("expected a renderer")
}

/// The rest state with some domains moved by an f64 translation.
fn moved(scene: &Scene, domains: &[u32], [x, y, z]: [f64; 3]) -> SceneState {
    let one = || {
        let rotation = [0.0, 0.0, 0.0, 1.0_f32].into_iter().flat_map(f32::to_le_bytes);
        rotation.chain([x, y, z].into_iter().flat_map(f64::to_le_bytes))
    };
    let raw = RawStepUpdate {
        transform_domains: domains.to_vec(),
        transforms: domains.iter().flat_map(|_| one()).collect(),
        transform_format: TransformFormat::RigidF64,
        ..RawStepUpdate::default()
    };
    let mut state = SceneState::rest(scene);
    state.apply(scene, &StepUpdate::parse(scene, &raw).expect("expected a valid step"));
    state
}

/// A camera that looks obliquely from above at a square around `at`.
fn camera(at: [f64; 3]) -> Camera {
    let eye = [at[0] + 1.7, at[1] + 2.1, at[2] + 3.3];
    let view = View::LookAt { eye, target: [at[0], at[1] + 0.2, at[2]], up: [0.0, 1.0, 0.0] };
    Camera { view, lens: Lens::FieldOfView(40.0), near: 0.0, far: 0.0 }
}

fn picture(bench: &mut DeviceContext, scene: &Arc<Scene>, state: &SceneState, camera: &Camera) -> FrameImage {
    let mut staged = bench.load_scene(scene, BackendSettings::default()).expect("expected the scene to load");
    staged.deform(state).expect("expected the step to succeed");
    let image = bench.draw(&mut staged, camera, FrameSize::new(96, 96)).expect("expected a frame");
    bench.unload_scene(staged);
    image
}

/// Largest difference of two pictures in levels, and number of pixels that differ by more than one level.
fn difference(one: &FrameImage, other: &FrameImage) -> (u8, usize) {
    let pairs = one.rgba.chunks_exact(4).zip(other.rgba.chunks_exact(4));
    let levels = |(a, b): (&[u8], &[u8])| a.iter().zip(b).map(|(a, b)| a.abs_diff(*b)).max().unwrap_or(0);
    pairs.map(levels).fold((0, 0), |(most, count), levels| (most.max(levels), count + usize::from(levels > 1)))
}

/// A table over the ground, with the default look and the given shadow.
fn table(shadow: Option<ShadowSettings>) -> Arc<Scene> {
    let mut builder = SceneBuilder::new();
    builder.parts.look = RenderSettings { shadow, ..RenderSettings::default() };
    builder
        .add_domain(floor_mesh(0.8, 0.5), Material::default())
        .add_domain(floor_mesh(0.4, 0.0), Material::default())
        .build()
}

/// With ground and every kind of shadow map.
#[test]
fn far_scene_renders_like_the_scene_at_the_origin() {
    let mut bench = bench();
    // Texels of a shadow map are aligned to a grid, so the edge of a shadow looks the same only after a move by
    // multiples of the grid.
    let on_grid = [9766.0 * ORIGIN_GRID, 0.0, -9767.0 * ORIGIN_GRID];
    // Off the grid, positions round differently, by 1/500 pixel. A sample closer than that to an edge may change sides,
    // which affects at most one pixel in a thousand.
    let base = ShadowSettings::default();
    let kinds = [
        (Some(base), on_grid, 0),
        (Some(ShadowSettings { method: ShadowMethod::Standard, ..base }), on_grid, 0),
        (Some(ShadowSettings { method: ShadowMethod::PercentageCloser, ..base }), on_grid, 0),
        (Some(ShadowSettings { splits: 3, ..base }), on_grid, 0),
        (None, AWAY, 9),
    ];
    for (shadow, at, edges) in kinds {
        let scene = table(shadow);
        let home = picture(&mut bench, &scene, &SceneState::rest(&scene), &camera([0.0; 3]));
        let away = moved(&scene, &[0, 1], at);
        assert!(away.origins.as_ref().is_some_and(|origins| origins.is_uniform()));
        let far = picture(&mut bench, &scene, &away, &camera(at));
        let (most, count) = difference(&home, &far);
        assert!(count <= edges, "{count} pixels at {at:?}, by {most} levels at most");
    }
    let scene = table(None);
    let home = picture(&mut bench, &scene, &SceneState::rest(&scene), &camera([0.0; 3]));
    let away = moved(&scene, &[0, 1], AWAY);
    // Controls: a camera position rounded to f32 gives another picture, and so does a camera moved by 0.1 units.
    let rounded = AWAY.map(|number| f64::from(number as f32));
    assert!(difference(&home, &picture(&mut bench, &scene, &away, &camera(rounded))).0 > 8);
    assert!(difference(&home, &picture(&mut bench, &scene, &away, &camera([AWAY[0] + 0.1, 0.0, AWAY[2]]))).0 > 8);
}

/// Two domains are far apart. A camera near either one sees that domain alone.
#[test]
fn distant_domains_are_seen_by_nearby_cameras() {
    let mut bench = bench();
    let square = |z: f32| facing_rectangle(-0.7, -0.3, 0.6, 0.9, z);
    let red = Material { diffuse: [1.0, 0.1, 0.1], ambient: [1.0, 0.1, 0.1], ..Material::default() };
    let scene =
        SceneBuilder::new().add_domain(square(0.0), Material::default()).add_domain(square(-0.1), red.clone()).build();
    let alone = |material: Material, z| SceneBuilder::new().add_domain(square(z), material).build();
    let (gray, red) = (alone(Material::default(), 0.0), alone(red, -0.1));
    let mut at_rest = |scene: &Arc<Scene>| picture(&mut bench, scene, &SceneState::rest(scene), &camera([0.0; 3]));
    let (gray, red, both) = (at_rest(&gray), at_rest(&red), at_rest(&scene));
    let apart = moved(&scene, &[1], AWAY);
    assert!(apart.origins.as_ref().is_some_and(|origins| !origins.is_uniform()));
    let mut staged = bench.load_scene(&scene, BackendSettings::default()).expect("expected the scene to load");
    let mut seen = |state: &SceneState, at| {
        staged.deform(state).expect("expected the step to succeed");
        let image = bench.draw(&mut staged, &camera(at), FrameSize::new(96, 96)).expect("expected a frame");
        [&gray, &red, &both].map(|want| difference(&image, want).0)
    };
    let is_only = |levels: [u8; 3], which: usize| (0..3).all(|at| (levels[at] <= 1) == (at == which));
    // Twice, because no frame may contain remains of an earlier one.
    for _ in 0..2 {
        let levels = [seen(&apart, AWAY), seen(&apart, [0.0; 3]), seen(&SceneState::rest(&scene), [0.0; 3])];
        assert!(is_only(levels[0], 1) && is_only(levels[1], 0) && is_only(levels[2], 2), "{levels:?}");
    }
    bench.unload_scene(staged);
}
