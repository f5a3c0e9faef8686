//! Zero rows, the signs of overflows, and singular or tiny transforms on the device. Checks for every deformer are in
//! `tests/both`.

use modalcast_compute::reference::rigid_normals;
use modalcast_model::deform::Deformer;
use modalcast_model::domain::{Modes, Shape, Transform};
use modalcast_model::scene::{Scene, SceneState};

use crate::accuracy::{DIRECTION, check, largest_error, same_bits};
use crate::scenes::{self, NORMAL_MAPPED, Random};
use crate::twins::deformer;

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_vertices_with_zero_rows_do_not_move() {
    let mut random = Random(1);
    let shape = scenes::shape(&mut random, 700, 9);
    let mut entries = shape.modes.columns().to_vec();
    for (row, entry) in entries.iter_mut().enumerate() {
        // Zeros of both signs.
        if (row % 2100 / 3).is_multiple_of(3) {
            *entry = if row % 2 == 0 { 0.0 } else { -0.0 };
        }
    }
    let modes = Modes::from_columns(2100, 9, entries).expect("modes");
    let mut parts = scenes::parts(vec![Shape::new(shape.mesh, modes).expect("a shape")]);
    parts.domains = vec![scenes::domain(0, 0), scenes::domain(0, 0)];
    let scene = Scene::new(parts).expect("a scene");
    let mut deformer = deformer(&scene);
    let mut state = scenes::state(&scene, 2);
    state.transforms[1] = Transform::IDENTITY;
    check("zero rows", &scene, &state, &mut deformer);
    let bent = deformer.surface().expect("copies").positions.clone();
    state.q.fill(0.0);
    deformer.deform(&state).expect("deforms");
    let still = &deformer.surface().expect("copies").positions;
    for vertex in 0..1400 {
        let of = |positions: &[f32]| positions[3 * vertex..][..3].to_vec();
        assert_eq!(same_bits(&of(&bent), &of(still)), (vertex % 700).is_multiple_of(3), "vertex {vertex}");
    }
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_bounds_show_axis_and_sign_of_an_overflow() {
    let mut random = Random(4);
    let shape = scenes::shape(&mut random, 1000, 1);
    let mut column = vec![0.0; 3000];
    column[3 * 517] = 2.0;
    column[3 * 517 + 1] = 2.0;
    let modes = Modes::from_columns(3000, 1, column).expect("modes");
    let mut parts = scenes::parts(vec![Shape::new(shape.mesh, modes).expect("a shape")]);
    parts.domains = vec![scenes::domain(0, 0)];
    let scene = Scene::new(parts).expect("a scene");
    let mut state = SceneState::rest(&scene);
    state.q[0] = f32::MAX;
    // Infinity minus infinity in the first row, which is finite in f64. The other rows overflow in f32.
    state.transforms[0] = Transform([1.0, -1.0, 1.0, 0.0, 1.0, 1.0, 1.0, 0.0, -1.0, -1.0, 1.0, 5.0]);
    let bounds = deformer(&scene).deform(&state).expect("deforms").bounds;
    assert!(bounds.min[0].is_finite() && bounds.max[0].is_finite(), "{bounds:?}");
    assert!(bounds.min[1].is_finite() && bounds.max[1] == f64::INFINITY, "{bounds:?}");
    assert!(bounds.min[2] == f64::NEG_INFINITY && bounds.max[2].is_finite(), "{bounds:?}");
}

/// Normals and tangents of singular, tiny and huge transforms.
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_directions_of_singular_transforms_equal_the_twin() {
    let linear: [[f32; 9]; 10] = [
        [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0],
        [-1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0],
        [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        [0.0; 9],
        [1.0, 2.0, 3.0, 2.0, 4.0, 6.0, 0.0, 0.0, 1.0],
        [1e-30, 0.0, 0.0, 0.0, 3e-30, 1e-30, 0.0, 0.0, 2e-30],
        [1e30, 2e29, 0.0, 0.0, 3e30, 1e30, 0.0, 0.0, -2e30],
        [1e-40, 0.0, 0.0, 0.0, 2e-40, 0.0, 1e-41, 0.0, 1e-40],
        [1.0, 0.0, 0.0, 0.0, 1e-6, 0.0, 0.0, 0.0, 1.0],
        [0.3, 0.5, -0.2, 0.300_000_03, 0.5, -0.2, 0.1, -0.7, 0.4],
    ];
    let mut random = Random(6);
    let mut parts = scenes::parts(vec![scenes::shape(&mut random, 40, 0)]);
    parts.domains = vec![scenes::domain(0, NORMAL_MAPPED); linear.len()];
    let scene = Scene::new(parts).expect("a scene");
    let mut state = SceneState::rest(&scene);
    for (transform, [a, b, c, d, e, f, g, h, i]) in state.transforms.iter_mut().zip(linear) {
        *transform = Transform([a, b, c, 0.0, d, e, f, 0.0, g, h, i, 0.0]);
    }
    let mut deformer = deformer(&scene);
    check("edge transforms", &scene, &state, &mut deformer);
    // Control: the twin of other transforms differs.
    let normals = &deformer.surface().expect("copies").normals;
    let other = rigid_normals(&scene, &SceneState::rest(&scene));
    assert!(largest_error(normals, &other, DIRECTION).is_err(), "the judge can fail");
}
