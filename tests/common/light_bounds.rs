//! Light-space bounds of a step: a box along the axes of light space, to which the shadow map is fitted. The box
//! contains every vertex and is tight. A scene without a shadow has none.

use std::sync::Arc;

use modalcast_model::backend_settings::BatchPolicy;
use modalcast_model::deform::Deformer;
use modalcast_model::domain::{Mesh, Modes, Shape};
use modalcast_model::scene::{BoundingBox, DeformationSettings, OrientedBounds, Scene, SceneState};

use super::{StepResult, run_step, scene_of_shapes};
use crate::scenes::{self, Random};

/// Vertices per tile; each tile contributes one box.
pub(crate) const TILE_VERTICES: usize = 128;

/// A thin coil along the diagonal of a cube of side 2, with sine waves as modes. The box of each of its tiles is small,
/// but the box of the whole coil is not.
pub(crate) fn coil_shape(vertices: usize, rank: usize) -> Shape {
    let fraction = |vertex: usize| vertex as f32 / vertices as f32;
    let position = |vertex: usize| {
        let (t, angle) = (2.0 * fraction(vertex) - 1.0, 300.0 * fraction(vertex));
        [t + 0.02 * angle.cos(), t + 0.02 * angle.sin(), t]
    };
    let rest_positions: Vec<[f32; 3]> = (0..vertices).map(position).collect();
    let entry_value = |entry: usize| {
        let (mode, vertex) = (entry / (3 * vertices), entry / 3 % vertices);
        0.05 * ((mode + 1) as f32 * 3.0 * fraction(vertex)).sin()
    };
    let modes = Modes::from_columns(3 * vertices, rank, (0..3 * vertices * rank).map(entry_value).collect())
        .expect("expected valid modes");
    let last_vertex = vertices as u32 - 1;
    let triangles =
        (0..=last_vertex).map(|index| [index, (index + 1).min(last_vertex), (index + 2).min(last_vertex)]).collect();
    let mesh = Mesh::from_indexed(rest_positions, vec![[0.0, 0.0, 1.0]; vertices], vec![], triangles)
        .expect("expected a valid mesh");
    Shape::new(mesh, modes).expect("expected a valid shape")
}

/// Large coils with tiles of their own, and coils so small that they share tiles; two domains per coil.
pub(crate) fn coil_scene(deformation: DeformationSettings) -> Arc<Scene> {
    let normal_maps = false;
    scene_of_shapes(vec![coil_shape(5000, 4), coil_shape(700, 2), coil_shape(9, 1)], 2, deformation, normal_maps)
}

/// The smallest light-space box that contains the world-space bounding boxes of all tiles, for tiles of `tile_vertices`
/// packed positions. With tiles of one position, the box is that of the vertices.
pub(crate) fn bounds_in_light_space(scene: &Scene, positions: &[f32], tile_vertices: usize) -> OrientedBounds {
    let axes = scene.light_axes().expect("expected a scene with a shadow");
    let tile_box = |positions: &[f32]| OrientedBounds::enclosing(&axes, &BoundingBox::from_positions(positions));
    positions.chunks(3 * tile_vertices).map(tile_box).fold(OrientedBounds::EMPTY, OrientedBounds::union)
}

/// Largest distance by which a side of `inner` lies outside of `outer`; NaN if either box contains a NaN.
pub(crate) fn max_excess(outer: &OrientedBounds, inner: &OrientedBounds) -> f64 {
    let excesses =
        (0..3).flat_map(|axis| [outer.0.min[axis] - inner.0.min[axis], inner.0.max[axis] - outer.0.max[axis]]);
    excesses.fold(0.0, |max: f64, excess| if excess.is_nan() || max.is_nan() { f64::NAN } else { max.max(excess) })
}

/// Sum over the axes of the largest absolute coordinate. The rounding error of light-space coordinates is proportional
/// to it.
pub(crate) fn coordinate_magnitude(bounds: &BoundingBox) -> f64 {
    bounds.min.iter().zip(&bounds.max).map(|(min, max)| min.abs().max(max.abs())).sum()
}

/// Largest diagonal of the box of a tile.
fn max_tile_diagonal(positions: &[f32]) -> f64 {
    positions.chunks(3 * TILE_VERTICES).map(|tile| BoundingBox::from_positions(tile).diagonal()).fold(0.0, f64::max)
}

/// Returns the light-space bounds of a step. Asserts that they contain every vertex, and that they exceed the
/// light-space box of the scene bounds only by rounding.
fn verify_light_bounds(name: &str, scene: &Scene, result: &StepResult) -> OrientedBounds {
    let light_box = result.light_bounds.expect("expected a scene with a shadow");
    let (vertex_box, scene_box) =
        (bounds_in_light_space(scene, &result.surface.positions, 1), scene_box_in_light_space(scene, &result.bounds));
    let magnitude = coordinate_magnitude(&result.bounds);
    // The tolerance is for rounding errors in f64.
    assert!(
        max_excess(&light_box, &vertex_box) <= 1e-12 * magnitude,
        "{name}: expected {light_box:?} to contain {vertex_box:?}"
    );
    // The tolerance is for rounding errors in f32: three products with a relative error of 2^-23 = 1.2e-7 each.
    assert!(
        max_excess(&scene_box, &light_box) <= 4e-7 * magnitude,
        "{name}: expected {light_box:?} within {scene_box:?}"
    );
    // Negative control: a box that is smaller than `vertex_box` does not contain `vertex_box`. The scene of one vertex
    // has a diagonal of 0, so its box cannot shrink.
    let shrunk_box = vertex_box.expanded_by(-1e-3 * result.bounds.diagonal());
    assert!(result.bounds.diagonal() == 0.0 || max_excess(&shrunk_box, &vertex_box) > 0.0, "{name}: negative control");
    light_box
}

/// The smallest light-space box that contains the scene bounds.
fn scene_box_in_light_space(scene: &Scene, bounds: &BoundingBox) -> OrientedBounds {
    OrientedBounds::enclosing(&scene.light_axes().expect("expected a scene with a shadow"), bounds)
}

/// Light bounds contain every vertex of coils, of a scene of one vertex, and of a scene with several domains per tile.
/// Each scene is also moved far from the origin, and then scaled by 1e-20.
pub(crate) fn check_containment<D: Deformer>(create_deformer: impl Fn(&Arc<Scene>, BatchPolicy) -> D) {
    let default_policy = BatchPolicy::default();
    let cases = [
        ("coils", default_policy, coil_scene(DeformationSettings::default())),
        ("batched coils", BatchPolicy::Always, coil_scene(DeformationSettings::default())),
        (
            "one vertex",
            default_policy,
            scenes::random_scene(
                &[(1, 1)],
                scenes::RandomSceneOptions { instances: 1, normal_maps: false, rigid_transforms: true },
            ),
        ),
        (
            "small domains",
            default_policy,
            scenes::random_scene(
                &[(7, 3), (40, 0), (300, 5)],
                scenes::RandomSceneOptions { instances: 5, normal_maps: false, rigid_transforms: false },
            ),
        ),
    ];
    for (name, batch_policy, scene) in cases {
        let mut deformer = create_deformer(&scene, batch_policy);
        for seed in 0..3 {
            let mut state = scenes::random_state(&scene, seed);
            verify_light_bounds(name, &scene, &run_step(&mut deformer, &state));
            state.transforms.iter_mut().for_each(|transform| transform.0[3] += 1e6);
            verify_light_bounds(&format!("{name}, far"), &scene, &run_step(&mut deformer, &state));
            state.transforms.iter_mut().for_each(|transform| transform.0.iter_mut().for_each(|entry| *entry *= 1e-20));
            verify_light_bounds(&format!("{name}, tiny"), &scene, &run_step(&mut deformer, &state));
        }
    }
}

/// Light bounds of a thin scene have less than half the volume of the light-space box of the scene bounds, and exceed
/// the vertices by less than the diagonal of a tile.
pub(crate) fn check_tightness<D: Deformer>(create_deformer: impl Fn(&Arc<Scene>) -> D) {
    let normal_maps = false;
    let scene = scene_of_shapes(vec![coil_shape(5000, 4)], 1, DeformationSettings::default(), normal_maps);
    let result = run_step(&mut create_deformer(&scene), &SceneState::rest(&scene));
    let light_box = verify_light_bounds("coil", &scene, &result);
    let (vertex_box, scene_box) =
        (bounds_in_light_space(&scene, &result.surface.positions, 1), scene_box_in_light_space(&scene, &result.bounds));
    let tile_diagonal = max_tile_diagonal(&result.surface.positions);
    assert!(
        max_excess(&vertex_box, &light_box) < tile_diagonal,
        "expected {light_box:?} to exceed {vertex_box:?} by less than {tile_diagonal}"
    );
    let volume = |OrientedBounds(bounds): &OrientedBounds| {
        (0..3).map(|axis| bounds.max[axis] - bounds.min[axis]).product::<f64>()
    };
    let [light_volume, vertex_volume, scene_volume] = [light_box, vertex_box, scene_box].map(|bounds| volume(&bounds));
    eprintln!(
        "coil, volume relative to the box of the scene bounds: light bounds {:.3}, vertices {:.3}",
        light_volume / scene_volume,
        vertex_volume / scene_volume
    );
    assert!(light_volume < 0.5 * scene_volume && vertex_volume <= light_volume);
}

/// A scene without a shadow has no light bounds. A step that overflows has invalid light bounds, and the next step has
/// valid ones.
pub(crate) fn check_missing_shadow_and_overflow<D: Deformer>(create_deformer: impl Fn(&Arc<Scene>) -> D) {
    let mut parts = scenes::parts_of_shapes(vec![scenes::random_shape(&mut Random(3), 300, 2)]);
    parts.domains = vec![scenes::new_domain(0, scenes::PLAIN_MATERIAL); 2];
    parts.look.shadow = None;
    let unshadowed_scene = Scene::new(parts).expect("expected a valid scene");
    assert_eq!(
        run_step(&mut create_deformer(&unshadowed_scene), &SceneState::rest(&unshadowed_scene)).light_bounds,
        None
    );
    let scene = scenes::random_scene(
        &[(300, 2)],
        scenes::RandomSceneOptions { instances: 2, normal_maps: false, rigid_transforms: false },
    );
    let (mut deformer, valid_state) = (create_deformer(&scene), SceneState::rest(&scene));
    let valid_bounds = run_step(&mut deformer, &valid_state).light_bounds;
    assert!(valid_bounds.is_some_and(|light| light.is_valid()));
    for invalid_entry in [f32::NAN, f32::INFINITY, f32::MAX] {
        let mut overflowing_state = valid_state.clone();
        overflowing_state.transforms[1].0.fill(invalid_entry);
        assert!(
            run_step(&mut deformer, &overflowing_state).light_bounds.is_some_and(|light| !light.is_valid()),
            "{invalid_entry}"
        );
        let light_bounds = run_step(&mut deformer, &valid_state).light_bounds;
        assert_eq!(light_bounds, valid_bounds, "expected no effect on the next step");
    }
}
