//! Zero rows of U, the signs of overflows, and singular or tiny transforms on the device. Checks for every deformer are
//! in `tests/common`.

use modalcast_compute::reference::rigid_normals;
use modalcast_model::deform::Deformer;
use modalcast_model::domain::{Modes, Shape, Transform};
use modalcast_model::scene::{Scene, SceneState};

use crate::accuracy::{MAX_DIRECTION_ERROR, assert_equals_reference, have_equal_bits, max_error};
use crate::reference_comparison::cuda_deformer;
use crate::scenes::{self, NORMAL_MAPPED_MATERIAL, Random};

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_vertices_with_zero_rows_do_not_move() {
    let mut random = Random(1);
    let shape = scenes::random_shape(&mut random, 700, 9);
    let mut entries = shape.modes.columns().to_vec();
    for (index, entry) in entries.iter_mut().enumerate() {
        // `columns` are the columns of U one after another, of 2100 rows each, three per vertex.
        let vertex = index % 2100 / 3;
        // Every third vertex has zero rows, with zeros of both signs.
        if vertex.is_multiple_of(3) {
            *entry = if index % 2 == 0 { 0.0 } else { -0.0 };
        }
    }
    let modes = Modes::from_columns(2100, 9, entries).expect("expected valid modes");
    let mut parts = scenes::parts_of_shapes(vec![Shape::new(shape.mesh, modes).expect("expected a valid shape")]);
    parts.domains = vec![scenes::new_domain(0, scenes::PLAIN_MATERIAL), scenes::new_domain(0, scenes::PLAIN_MATERIAL)];
    let scene = Scene::new(parts).expect("expected a valid scene");
    let mut deformer = cuda_deformer(&scene);
    let mut state = scenes::random_state(&scene, 2);
    state.transforms[1] = Transform::IDENTITY;
    assert_equals_reference("zero rows", &scene, &state, &mut deformer);
    let deformed = deformer.surface().expect("expected a surface").positions.clone();
    state.q.fill(0.0);
    deformer.deform(&state).expect("expected the step to succeed");
    let rest = &deformer.surface().expect("expected a surface").positions;
    // Both domains have 700 vertices.
    for vertex in 0..1400 {
        let position = |positions: &[f32]| positions[3 * vertex..][..3].to_vec();
        let is_unmoved = have_equal_bits(&position(&deformed), &position(rest));
        assert_eq!(is_unmoved, (vertex % 700).is_multiple_of(3), "vertex {vertex}");
    }
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_bounds_show_axis_and_sign_of_an_overflow() {
    let mut random = Random(4);
    let shape = scenes::random_shape(&mut random, 1000, 1);
    // The only mode moves vertex 517 along x and y.
    let mut column = vec![0.0; 3000];
    column[3 * 517] = 2.0;
    column[3 * 517 + 1] = 2.0;
    let modes = Modes::from_columns(3000, 1, column).expect("expected valid modes");
    let mut parts = scenes::parts_of_shapes(vec![Shape::new(shape.mesh, modes).expect("expected a valid shape")]);
    parts.domains = vec![scenes::new_domain(0, scenes::PLAIN_MATERIAL)];
    let scene = Scene::new(parts).expect("expected a valid scene");
    let mut state = SceneState::rest(&scene);
    state.q[0] = f32::MAX;
    // In f32 the first row is infinity minus infinity. The device then computes it in f64, where it is finite. The
    // other rows exceed f32.
    state.transforms[0] = Transform([1.0, -1.0, 1.0, 0.0, 1.0, 1.0, 1.0, 0.0, -1.0, -1.0, 1.0, 5.0]);
    let bounds = cuda_deformer(&scene).deform(&state).expect("expected the step to succeed").bounds;
    assert!(bounds.min[0].is_finite() && bounds.max[0].is_finite(), "{bounds:?}");
    assert!(bounds.min[1].is_finite() && bounds.max[1] == f64::INFINITY, "{bounds:?}");
    assert!(bounds.min[2] == f64::NEG_INFINITY && bounds.max[2].is_finite(), "{bounds:?}");
}

/// Normals and tangents of singular, tiny and huge transforms.
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_directions_of_singular_transforms_equal_the_reference() {
    let linear_parts: [[f32; 9]; 10] = [
        // Singular: projections, zero, and two parallel rows.
        [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0],
        [-1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0],
        [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        [0.0; 9],
        [1.0, 2.0, 3.0, 2.0, 4.0, 6.0, 0.0, 0.0, 1.0],
        // Tiny, huge and denormal.
        [1e-30, 0.0, 0.0, 0.0, 3e-30, 1e-30, 0.0, 0.0, 2e-30],
        [1e30, 2e29, 0.0, 0.0, 3e30, 1e30, 0.0, 0.0, -2e30],
        [1e-40, 0.0, 0.0, 0.0, 2e-40, 0.0, 1e-41, 0.0, 1e-40],
        // Nearly singular.
        [1.0, 0.0, 0.0, 0.0, 1e-6, 0.0, 0.0, 0.0, 1.0],
        [0.3, 0.5, -0.2, 0.300_000_03, 0.5, -0.2, 0.1, -0.7, 0.4],
    ];
    let mut random = Random(6);
    let mut parts = scenes::parts_of_shapes(vec![scenes::random_shape(&mut random, 40, 0)]);
    parts.domains = vec![scenes::new_domain(0, NORMAL_MAPPED_MATERIAL); linear_parts.len()];
    let scene = Scene::new(parts).expect("expected a valid scene");
    let mut state = SceneState::rest(&scene);
    // T is 3 x 4 and row-major. Its last column, the translation, is 0.
    for (transform, [a, b, c, d, e, f, g, h, i]) in state.transforms.iter_mut().zip(linear_parts) {
        *transform = Transform([a, b, c, 0.0, d, e, f, 0.0, g, h, i, 0.0]);
    }
    let mut deformer = cuda_deformer(&scene);
    assert_equals_reference("singular, tiny and huge transforms", &scene, &state, &mut deformer);
    // Negative control: the normals at rest differ.
    let normals = &deformer.surface().expect("expected a surface").normals;
    let rest_normals = rigid_normals(&scene, &SceneState::rest(&scene));
    assert!(max_error(normals, &rest_normals, MAX_DIRECTION_ERROR).is_err(), "negative control");
}
