//! f64 translations drive a small model far away and back. Floating origins keep its relative precision.

use std::sync::Arc;

use modalcast_compute::reference;
use modalcast_model::deform::Deformer;
use modalcast_model::domain::{Domain, Mesh, Modes, Shape};
use modalcast_model::scene::{NormalMethod, Scene, SceneState, StepUpdate};

use super::followers::far_step;
use super::run_step;
use super::surfaces::max_abs_error;
use crate::scenes;

/// Vertices along each side of the model.
const SIDE: usize = 17;
/// Side of the model in scene units.
const SIZE: f32 = 0.1;

/// Largest accepted error of a position on each axis, relative to the diagonal of the model: 7 x 2^-23 for the
/// translation (see `FloatingOrigins`), and 2^-23 for the deformation.
const MAX_RELATIVE_ERROR: f64 = 8.0 / (1 << 23) as f64;

/// Largest accepted error of a component of a unit normal: about 0.006 degrees.
const MAX_NORMAL_ERROR: f64 = 1e-4;

/// A square sheet with sides of 0.1 and one mode, a parabola along x. Normals follow the deformed triangles.
fn sheet_scene() -> Arc<Scene> {
    let coordinate = |index: usize| SIZE * (index as f32 / (SIDE - 1) as f32 - 0.5);
    let positions: Vec<[f32; 3]> =
        (0..SIDE * SIDE).map(|vertex| [coordinate(vertex % SIDE), coordinate(vertex / SIDE), 0.0]).collect();
    let columns = positions.iter().flat_map(|[x, _, _]| [0.0, 0.0, 10.0 * x * x]).collect();
    let cells = (0..SIDE - 1).flat_map(|row| (0..SIDE - 1).map(move |column| (row * SIDE + column) as u32));
    let side = SIDE as u32;
    let triangles = cells.flat_map(|a| [[a, a + 1, a + side + 1], [a, a + side + 1, a + side]]).collect();
    let (normals, uvs) = (vec![[0.0, 0.0, 1.0]; positions.len()], vec![[0.0; 2]; positions.len()]);
    let modes = Modes::from_columns(3 * positions.len(), 1, columns).expect("expected valid modes");
    let mesh = Mesh::from_indexed(positions, normals, uvs, triangles).expect("expected a valid mesh");
    let mut parts = scenes::parts_of_shapes(vec![Shape::new(mesh, modes).expect("expected a valid shape")]);
    parts.deformation.normals = NormalMethod::Exact;
    parts.domains = vec![Domain::new("sheet", 0)];
    Scene::new(parts).expect("expected a valid scene")
}

/// At every distance, position errors stay within 1e-6 of the diagonal of the model, and normals stay exact. Moved back
/// to its first place, the model has the same bits as before.
pub(crate) fn check_driven_model<D: Deformer>(create_deformer: impl Fn(&Arc<Scene>) -> D) {
    let scene = sheet_scene();
    let diagonal = scene.rest_bounds.diagonal();
    let mut state = SceneState::rest(&scene);
    state.q = vec![1.0];
    state.mark_all_dirty();
    // The reference computes in f64, here with the sheet at the scene's origin.
    let expected_positions = reference::deform(&scene, &state);
    let expected_normals = reference::exact_normals(&scene, &state, &expected_positions);
    let rigid_normals = reference::rigid_normals(&scene, &state);
    let mut deformer = create_deformer(&scene);
    let [mut max_error, mut max_normal_error] = [0.0_f64; 2];
    let mut surfaces_at_zero = Vec::new();
    for distance in [0.0, 0.3, 2.0, 30.0, 100.0, 500.0, 1e5, 1e9, 1e5, 500.0, 1.0, 0.0] {
        let translation = [distance, -0.7 * distance, 0.1 * distance];
        state.apply(&scene, &StepUpdate::parse(&scene, &far_step(0, translation)).expect("expected a valid step"));
        let (origin, surface) = (state.origin_of(0), run_step(&mut deformer, &state).surface);
        for (vertex, expected) in expected_positions.iter().enumerate() {
            for axis in 0..3 {
                // The difference of the origins is exact even where f64 would round the world position.
                let expected = expected[axis] + (translation[axis] - origin[axis]);
                let error = (f64::from(surface.positions[3 * vertex + axis]) - expected).abs() / diagonal;
                max_error = max_error.max(error);
                assert!(error <= MAX_RELATIVE_ERROR, "at {distance}: error of {error:e} of the diagonal");
            }
        }
        let normal_error = max_abs_error(&surface.normals, expected_normals.as_flattened());
        max_normal_error = max_normal_error.max(normal_error);
        assert!(normal_error <= MAX_NORMAL_ERROR, "at {distance}: normal error {normal_error:e}");
        if distance == 0.0 {
            assert_eq!(origin, [0.0; 3], "expected the shared origin to follow the domain back");
            surfaces_at_zero.push(surface);
        }
    }
    eprintln!("errors of a driven model: {max_error:.1e} of its diagonal, {max_normal_error:.1e} of a normal");
    assert_eq!(surfaces_at_zero[0].positions, surfaces_at_zero[1].positions);
    assert_eq!(surfaces_at_zero[0].normals, surfaces_at_zero[1].normals);
    let rigid_normals: Vec<f32> = rigid_normals.as_flattened().iter().map(|number| *number as f32).collect();
    let rigid_error = max_abs_error(&rigid_normals, expected_normals.as_flattened());
    assert!(
        rigid_error > 0.1,
        "negative control: expected rigid normals to differ by more than 0.1, got {rigid_error}"
    );
}
