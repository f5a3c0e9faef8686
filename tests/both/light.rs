//! Light-space bounds: they contain every vertex, they are tight, and a scene without a shadow has none.

use std::sync::Arc;

use modalcast_model::deform::Deformer;
use modalcast_model::domain::{Mesh, Modes, Shape};
use modalcast_model::scene::{BatchPolicy, Bounds, DeformationSettings, LightSpaceBox, Scene, SceneState};

use super::{StepResult, run, scene_of};
use crate::scenes::{self, Random};

/// Vertices per tile; each tile contributes one box.
pub(crate) const TILE: usize = 128;

/// A thin coil along the diagonal of a cube of side 2, bent by smooth waves. The box of each of its tiles is small,
/// while the box of the whole coil is not.
pub(crate) fn coil(vertices: usize, rank: usize) -> Shape {
    let along = |vertex: usize| vertex as f32 / vertices as f32;
    let point = |vertex: usize| {
        let (t, turn) = (2.0 * along(vertex) - 1.0, 300.0 * along(vertex));
        [t + 0.02 * turn.cos(), t + 0.02 * turn.sin(), t]
    };
    let rest: Vec<[f32; 3]> = (0..vertices).map(point).collect();
    let wave = |entry: usize| 0.05 * ((entry / (3 * vertices) + 1) as f32 * 3.0 * along(entry / 3 % vertices)).sin();
    let modes = Modes::from_columns(3 * vertices, rank, (0..3 * vertices * rank).map(wave).collect()).expect("modes");
    let last = vertices as u32 - 1;
    let triangles = (0..=last).map(|at| [at, (at + 1).min(last), (at + 2).min(last)]).collect();
    let mesh = Mesh::from_indexed(rest, vec![[0.0, 0.0, 1.0]; vertices], vec![], triangles).expect("a mesh");
    Shape::new(mesh, modes).expect("a shape")
}

/// Coils that fill tiles of their own and coils that share tiles.
pub(crate) fn coils(deformation: DeformationSettings) -> Arc<Scene> {
    scene_of(vec![coil(5000, 4), coil(700, 2), coil(9, 1)], 2, deformation, false)
}

/// The smallest box along the light axes of a scene that contains the boxes of all tiles of `size` packed positions.
pub(crate) fn along(scene: &Scene, positions: &[f32], size: usize) -> LightSpaceBox {
    let axes = scene.light_axes().expect("the look has a shadow");
    let tile = |positions: &[f32]| LightSpaceBox::enclosing(&axes, &Bounds::from_positions(positions));
    positions.chunks(3 * size).map(tile).fold(LightSpaceBox::EMPTY, LightSpaceBox::union)
}

/// Distance by which `inner` exceeds `outer`, or NaN if either contains a NaN.
pub(crate) fn beyond(outer: &LightSpaceBox, inner: &LightSpaceBox) -> f64 {
    let ends = (0..3).flat_map(|axis| [outer.0.min[axis] - inner.0.min[axis], inner.0.max[axis] - outer.0.max[axis]]);
    ends.fold(0.0, |most: f64, end| if end.is_nan() || most.is_nan() { f64::NAN } else { most.max(end) })
}

/// Sum of the largest absolute coordinates; the rounding error of f32 is proportional to it.
pub(crate) fn reach(bounds: &Bounds) -> f64 {
    bounds.min.iter().zip(&bounds.max).map(|(min, max)| min.abs().max(max.abs())).sum()
}

/// Largest diagonal of the box of a tile.
fn widest(positions: &[f32]) -> f64 {
    positions.chunks(3 * TILE).map(|tile| Bounds::from_positions(tile).diagonal()).fold(0.0, f64::max)
}

/// Light bounds of a step, checked to contain every vertex and to exceed the box of the corners of the bounds only by
/// rounding.
fn held(name: &str, scene: &Scene, shown: &StepResult) -> LightSpaceBox {
    let light = shown.light.expect("the look has a shadow");
    let (exact, corners) = (along(scene, &shown.surface.positions, 1), along_corners(scene, &shown.bounds));
    let reach = reach(&shown.bounds);
    assert!(beyond(&light, &exact) <= 1e-12 * reach, "{name}: a vertex is outside: {light:?}, {exact:?}");
    assert!(beyond(&corners, &light) <= 4e-7 * reach, "{name}: {light:?} reaches beyond {corners:?}");
    let smaller = exact.expanded_by(-1e-3 * shown.bounds.diagonal());
    assert!(shown.bounds.diagonal() == 0.0 || beyond(&smaller, &exact) > 0.0, "{name}: control");
    light
}

fn along_corners(scene: &Scene, bounds: &Bounds) -> LightSpaceBox {
    LightSpaceBox::enclosing(&scene.light_axes().expect("the look has a shadow"), bounds)
}

/// Scenes that are random, smooth, far away or tiny, that have one vertex, or whose domains share tiles.
pub(crate) fn every_vertex_is_held<D: Deformer>(make: impl Fn(&Arc<Scene>) -> D) {
    let together = DeformationSettings { batches: BatchPolicy::Always, ..DeformationSettings::default() };
    let scenes = [
        ("coils", coils(DeformationSettings::default())),
        ("coils together", coils(together)),
        ("one vertex", scenes::scene(&[(1, 1)], 1, false, true)),
        ("small ones", scenes::scene(&[(7, 3), (40, 0), (300, 5)], 5, false, false)),
    ];
    for (name, scene) in scenes {
        let mut deformer = make(&scene);
        for seed in 0..3 {
            let mut state = scenes::state(&scene, seed);
            held(name, &scene, &run(&mut deformer, &state));
            state.transforms.iter_mut().for_each(|place| place.0[3] += 1e6);
            held(&format!("{name}, far"), &scene, &run(&mut deformer, &state));
            state.transforms.iter_mut().for_each(|place| place.0.iter_mut().for_each(|entry| *entry *= 1e-20));
            held(&format!("{name}, tiny"), &scene, &run(&mut deformer, &state));
        }
    }
}

/// Less than half the volume of the box of the corners, and no more than the diagonal of a tile beyond the vertices.
pub(crate) fn a_thin_scene_is_fitted_closely<D: Deformer>(make: impl Fn(&Arc<Scene>) -> D) {
    let scene = scene_of(vec![coil(5000, 4)], 1, DeformationSettings::default(), false);
    let shown = run(&mut make(&scene), &SceneState::rest(&scene));
    let light = held("coil", &scene, &shown);
    let (exact, corners) = (along(&scene, &shown.surface.positions, 1), along_corners(&scene, &shown.bounds));
    let widest = widest(&shown.surface.positions);
    assert!(beyond(&exact, &light) < widest, "{light:?} beyond {exact:?}, tiles of {widest}");
    let volume = |LightSpaceBox(from_positions): &LightSpaceBox| {
        (0..3).map(|axis| from_positions.max[axis] - from_positions.min[axis]).product::<f64>()
    };
    let [light, exact, corners] = [light, exact, corners].map(|from_positions| volume(&from_positions));
    eprintln!("coil: {:.3} of the volume by corners, {:.3} by vertices", light / corners, exact / corners);
    assert!(light < 0.5 * corners && exact <= light);
}

/// A look without a shadow has no light bounds, and overflow is reported.
pub(crate) fn nothing_is_measured_without_a_shadow_and_overflow_is_told<D: Deformer>(make: impl Fn(&Arc<Scene>) -> D) {
    let mut parts = scenes::parts(vec![scenes::shape(&mut Random(3), 300, 2)]);
    parts.domains = vec![scenes::domain(0, 0); 2];
    parts.look.shadow = None;
    let dark = Scene::new(parts).expect("a scene");
    assert_eq!(run(&mut make(&dark), &SceneState::rest(&dark)).light, None);
    let scene = scenes::scene(&[(300, 2)], 2, false, false);
    let (mut deformer, good) = (make(&scene), SceneState::rest(&scene));
    let before = run(&mut deformer, &good).light;
    assert!(before.is_some_and(|light| light.is_valid()));
    for bad in [f32::NAN, f32::INFINITY, f32::MAX] {
        let mut lost = good.clone();
        lost.transforms[1].0.fill(bad);
        assert!(run(&mut deformer, &lost).light.is_some_and(|light| !light.is_valid()), "{bad}");
        assert_eq!(run(&mut deformer, &good).light, before, "forgotten");
    }
}
