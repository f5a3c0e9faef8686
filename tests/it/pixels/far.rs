//! Pictures ten thousand kilometres from the scene's origin are those at the origin.

use std::sync::Arc;

use modalcast::config::{BackendChoice, Config};
use modalcast::engine::Workbench;
use modalcast_model::domain::Material;
use modalcast_model::scene::{
    Camera, GRID, Lens, Look, RawUpdate, Scene, Shadow, ShadowMethod, State, TransformFormat, Update, View,
};
use modalcast_render::Image;

use super::build::{Stage, facing, lying};

/// Where a scene goes: off the grid of its cells, and not a number that f32 holds.
const AWAY: [f64; 3] = [1e7 + 1.3, 0.0, -1e7 - 2.7];

fn bench() -> Workbench {
    Workbench::open(&Config { backend: BackendChoice::Cpu, ..Config::default() }).expect("a renderer")
}

/// The state with some domains moved from where they rest, in f64.
fn moved(scene: &Scene, domains: &[u32], [x, y, z]: [f64; 3]) -> State {
    let one = || {
        let rotation = [0.0, 0.0, 0.0, 1.0_f32].into_iter().flat_map(f32::to_le_bytes);
        rotation.chain([x, y, z].into_iter().flat_map(f64::to_le_bytes))
    };
    let raw = RawUpdate {
        transform_domains: domains.to_vec(),
        transforms: domains.iter().flat_map(|_| one()).collect(),
        transform_format: TransformFormat::RigidF64,
        ..RawUpdate::default()
    };
    let mut state = State::rest(scene);
    state.apply(scene, &Update::parse(scene, &raw).expect("a good step"));
    state
}

/// A camera from above and aside at a square around `at`.
fn camera(at: [f64; 3]) -> Camera {
    let eye = [at[0] + 1.7, at[1] + 2.1, at[2] + 3.3];
    let view = View::LookAt { eye, target: [at[0], at[1] + 0.2, at[2]], up: [0.0, 1.0, 0.0] };
    Camera { view, lens: Lens::FieldOfView(40.0), near: 0.0, far: 0.0 }
}

fn picture(bench: &mut Workbench, scene: &Arc<Scene>, state: &State, camera: &Camera) -> Image {
    let mut staged = bench.stage(scene).expect("stages");
    staged.deform(state).expect("deforms");
    let image = bench.draw(&mut staged, camera, 96, 96).expect("draws");
    bench.unstage(staged);
    image
}

/// The largest difference of two pictures in levels, and how many pixels differ by more than one level.
fn difference(one: &Image, other: &Image) -> (u8, usize) {
    let pairs = one.rgba.chunks_exact(4).zip(other.rgba.chunks_exact(4));
    let levels = |(a, b): (&[u8], &[u8])| a.iter().zip(b).map(|(a, b)| a.abs_diff(*b)).max().unwrap_or(0);
    pairs.map(levels).fold((0, 0), |(most, count), levels| (most.max(levels), count + usize::from(levels > 1)))
}

/// A table over the ground, with everything that a look has.
fn table(shadow: Option<Shadow>) -> Arc<Scene> {
    let mut stage = Stage::new();
    stage.0.look = Look { shadow, ..Look::default() };
    stage.add(lying(0.8, 0.5), Material::default()).add(lying(0.4, 0.0), Material::default()).scene()
}

#[test]
fn a_scene_that_has_gone_far_looks_as_it_did_with_its_ground_and_its_shadow() {
    let mut bench = bench();
    // The texels of a shadow map keep to a grid, so a shadow's edge looks the same only where the grid does.
    let on_grid = [9766.0 * GRID, 0.0, -9767.0 * GRID];
    // Off the grid positions are rounded elsewhere, by a five-hundredth of a pixel: a sample that an edge passes by less
    // may change sides, in one pixel of a thousand at most.
    let base = Shadow::default();
    let kinds = [
        (Some(base), on_grid, 0),
        (Some(Shadow { method: ShadowMethod::Standard, ..base }), on_grid, 0),
        (Some(Shadow { method: ShadowMethod::Filtered, ..base }), on_grid, 0),
        (Some(Shadow { splits: 3, ..base }), on_grid, 0),
        (None, AWAY, 9),
    ];
    for (shadow, at, edges) in kinds {
        let scene = table(shadow);
        let home = picture(&mut bench, &scene, &State::rest(&scene), &camera([0.0; 3]));
        let away = moved(&scene, &[0, 1], at);
        assert!(away.cells.as_ref().is_some_and(|cells| cells.is_one()));
        let far = picture(&mut bench, &scene, &away, &camera(at));
        let (most, count) = difference(&home, &far);
        assert!(count <= edges, "{count} pixels at {at:?}, by {most} levels at most");
    }
    let scene = table(None);
    let home = picture(&mut bench, &scene, &State::rest(&scene), &camera([0.0; 3]));
    let away = moved(&scene, &[0, 1], AWAY);
    // The controls: a camera that f32 rounds sees something else, and so does one that stands a decimetre aside.
    let rounded = AWAY.map(|number| f64::from(number as f32));
    assert!(difference(&home, &picture(&mut bench, &scene, &away, &camera(rounded))).0 > 8);
    assert!(difference(&home, &picture(&mut bench, &scene, &away, &camera([AWAY[0] + 0.1, 0.0, AWAY[2]]))).0 > 8);
}

#[test]
fn a_domain_far_from_all_others_is_seen_from_beside_it_and_the_others_from_beside_them() {
    let mut bench = bench();
    let square = |z: f32| facing(-0.7, -0.3, 0.6, 0.9, z);
    let red = Material { diffuse: [1.0, 0.1, 0.1], ambient: [1.0, 0.1, 0.1], ..Material::default() };
    let scene = Stage::new().add(square(0.0), Material::default()).add(square(-0.1), red.clone()).scene();
    let alone = |material: Material, z| Stage::new().add(square(z), material).scene();
    let (grey, red) = (alone(Material::default(), 0.0), alone(red, -0.1));
    let mut at_rest = |scene: &Arc<Scene>| picture(&mut bench, scene, &State::rest(scene), &camera([0.0; 3]));
    let (grey, red, both) = (at_rest(&grey), at_rest(&red), at_rest(&scene));
    let apart = moved(&scene, &[1], AWAY);
    assert!(apart.cells.as_ref().is_some_and(|cells| !cells.is_one()));
    let mut staged = bench.stage(&scene).expect("stages");
    let mut seen = |state: &State, at| {
        staged.deform(state).expect("deforms");
        let image = bench.draw(&mut staged, &camera(at), 96, 96).expect("draws");
        [&grey, &red, &both].map(|want| difference(&image, want).0)
    };
    let is_only = |levels: [u8; 3], which: usize| (0..3).all(|at| (levels[at] <= 1) == (at == which));
    // To and fro, because what was drawn in one frame must not be left over in another.
    for _ in 0..2 {
        let levels = [seen(&apart, AWAY), seen(&apart, [0.0; 3]), seen(&State::rest(&scene), [0.0; 3])];
        assert!(is_only(levels[0], 1) && is_only(levels[1], 0) && is_only(levels[2], 2), "{levels:?}");
    }
    bench.unstage(staged);
}
