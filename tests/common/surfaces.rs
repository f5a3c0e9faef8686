//! Normals and tangents under shears, mirrors and singular transforms, and of triangles without area.

use std::sync::Arc;

use modalcast_compute::reference::{rigid_normals, rigid_tangents};
use modalcast_model::deform::Deformer;
use modalcast_model::domain::{Corners, Mesh, Modes, Shape, Transform};
use modalcast_model::scene::{DeformationSettings, NormalMethod, Scene, SceneState};

use super::{assert_within_bound, run_step, scene_of_shapes};
use crate::scenes::{self, Random};

/// Largest accepted error of a component of a unit vector. It is about 300 times the rounding error of f32 (6e-8),
/// because shears amplify rounding errors.
const MAX_DIRECTION_ERROR: f64 = 2e-5;

/// Largest absolute difference of two lists; infinite for a NaN or if the lengths of the lists differ.
pub(crate) fn max_abs_error(actual: &[f32], expected: &[f64]) -> f64 {
    let error = |(actual, expected): (&f32, &f64)| {
        let error = (f64::from(*actual) - expected).abs();
        if error.is_nan() { f64::INFINITY } else { error }
    };
    if actual.len() == expected.len() {
        actual.iter().zip(expected).map(error).fold(0.0, f64::max)
    } else {
        f64::INFINITY
    }
}

/// Positions, normals and tangents equal the reference under a mirror, a shear, both, and a strongly anisotropic scale.
pub(crate) fn check_shears_and_mirrors<D: Deformer>(create_deformer: impl Fn(&Arc<Scene>) -> D) {
    let scene = scenes::random_scene(
        &[(40, 3), (200, 2)],
        scenes::RandomSceneOptions { instances: 2, normal_maps: true, rigid_transforms: false },
    );
    let mut state = scenes::random_state(&scene, 6);
    // Row-major 3 x 3 matrices.
    let linear_parts: [[f32; 9]; 4] = [
        [-1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        [1.0, 0.7, -0.2, 0.0, 0.5, 0.4, 0.1, 0.0, 1.5],
        [1.0, 3.0, 0.0, 0.0, 1.0, 0.0, 0.0, 2.0, -1.0],
        [30.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, -0.1],
    ];
    for (transform, [a, b, c, d, e, f, g, h, i]) in state.transforms.iter_mut().zip(linear_parts) {
        *transform = Transform([a, b, c, 1.0, d, e, f, -2.0, g, h, i, 0.5]);
    }
    let result = run_step(&mut create_deformer(&scene), &state);
    assert_within_bound("shears and mirrors", &scene, &state, &result.surface.positions);
    let direction_errors = |state: &SceneState| {
        let normals = max_abs_error(&result.surface.normals, rigid_normals(&scene, state).as_flattened());
        (normals, max_abs_error(&result.surface.tangents, rigid_tangents(&scene, state).as_flattened()))
    };
    let (normal_error, tangent_error) = direction_errors(&state);
    eprintln!("shears and mirrors: error of normals {normal_error:.2e}, of tangents {tangent_error:.2e}");
    assert!(normal_error <= MAX_DIRECTION_ERROR && tangent_error <= MAX_DIRECTION_ERROR);
    // Negative control: without its mirror, the first domain has other normals and tangents.
    state.transforms[0] = Transform::IDENTITY;
    let (normal_error, tangent_error) = direction_errors(&state);
    assert!(normal_error > 0.1 && tangent_error > 0.1);
}

/// A T that maps space to a plane gives the normal of this plane, also where it folds the rest surface to a line. The
/// surface is a fan in the plane x = 0 with three normals at rest. It tilts about z, so that it has an area in the image.
pub(crate) fn check_singular_transforms<D: Deformer>(create_deformer: impl Fn(&Arc<Scene>) -> D) {
    let positions = [[0.0; 3], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]];
    let uvs: Vec<[f32; 2]> = positions.iter().map(|[_, y, z]| [*y, *z]).collect();
    let triangles = vec![[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1]];
    // u = (y, 0, 0) q.
    let column: Vec<f32> = positions.iter().flat_map(|[_, y, _]| [*y, 0.0, 0.0]).collect();
    let rest_normals = [[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.8, 0.6, 0.0]];
    let shapes = rest_normals.map(|normal| {
        let mesh = Mesh::from_indexed(positions.to_vec(), vec![normal; 5], uvs.clone(), triangles.clone());
        let modes = Modes::from_columns(15, 1, column.clone()).expect("expected valid modes");
        Shape::new(mesh.expect("expected a valid mesh"), modes).expect("expected a valid shape")
    });
    let deformation = DeformationSettings { normals: NormalMethod::Exact, ..DeformationSettings::default() };
    let scene = scene_of_shapes(shapes.to_vec(), 1, deformation, true);
    let mut deformer = create_deformer(&scene);
    // The image is the plane with the normal (0, 0.8, 0.6). Its determinant is 0, without a rounding error.
    let singular = Transform([25.0, 0.0, 0.0, 1.0, 0.0, 9.0, -12.0, 2.0, 0.0, -12.0, 16.0, 3.0]);
    for tilt in [0.5, -0.5_f32] {
        let mut state = SceneState::rest(&scene);
        state.q.iter_mut().for_each(|q| *q = tilt);
        state.transforms.iter_mut().for_each(|transform| *transform = singular);
        let surface = run_step(&mut deformer, &state).surface;
        let exact_positions = modalcast_compute::reference::deform(&scene, &state);
        let by_reference = modalcast_compute::reference::exact_normals(&scene, &state, &exact_positions);
        for (corner, normal) in surface.normals.as_chunks::<3>().0.iter().enumerate() {
            // The area of the deformed fan before T has the direction (1, -q, 0).
            let side = f64::from(-tilt.signum()) * if (5..10).contains(&corner) { -1.0 } else { 1.0 };
            let expected = [0.0, 0.8 * side, 0.6 * side];
            assert!(max_abs_error(normal, &expected) < 1e-5, "tilt {tilt}, corner {corner}: {normal:?}");
            assert!(max_abs_error(normal, &by_reference[corner]) < 1e-5, "{:?}", by_reference[corner]);
        }
        assert!(are_unit_vectors(&surface.tangents, 4));
        for (tangent, normal) in surface.tangents.chunks_exact(4).zip(surface.normals.chunks_exact(3)) {
            let product: f32 = tangent.iter().zip(normal).map(|(tangent, normal)| tangent * normal).sum();
            assert!(product.abs() < 1e-5, "{tangent:?} is not orthogonal to {normal:?}");
        }
    }
}

/// Position of a vertex.
type PositionFn = fn(usize) -> [f32; 3];
/// Corners of a triangle.
type TriangleFn = fn(u32) -> [u32; 3];
/// Texture coordinates for a number of corners.
type UvsFn = fn(usize) -> Vec<[f32; 2]>;

/// Meshes whose triangles have no area, with and without texture coordinates.
fn zero_area_meshes() -> Vec<Mesh> {
    // One point, a line, and a parabola whose triangles repeat a vertex.
    let position_functions: [PositionFn; 3] =
        [|_| [0.5, -0.25, 1.0], |index| [index as f32, 0.0, 0.0], |index| [index as f32, (index * index) as f32, 1.0]];
    let triangle_functions: [TriangleFn; 3] = [
        |index| [index, index + 1, index + 2],
        |index| [index, index + 1, index + 2],
        |index| [index, index, index + index % 2],
    ];
    // No texture coordinates, one point, and a line.
    let uv_functions: [UvsFn; 3] =
        [|_| vec![], |count| vec![[0.5, 0.5]; count], |count| (0..count).map(|index| [index as f32, 0.0]).collect()];
    let mut meshes = Vec::new();
    for (position_of, triangle_of) in position_functions.into_iter().zip(triangle_functions) {
        for uvs_of in uv_functions {
            let rest_positions: Vec<[f32; 3]> = (0..9).map(position_of).collect();
            let normals =
                (0..9).map(|index| if index % 4 == 0 { [0.0; 3] } else { [0.0, index as f32, 1.0] }).collect();
            let corners = Corners { vertices: (0..9).collect(), normals, uvs: uvs_of(9) };
            meshes.push(
                Mesh::new(rest_positions, corners, (0..7).map(triangle_of).collect()).expect("expected a valid mesh"),
            );
        }
    }
    meshes
}

/// Whether every vector has length 1. Each vector has `width` numbers, of which the first three are x, y and z.
fn are_unit_vectors(components: &[f32], width: usize) -> bool {
    let length = |vector: &[f32]| vector[..3].iter().map(|component| component * component).sum::<f32>().sqrt();
    components.chunks_exact(width).all(|vector| (length(vector) - 1.0).abs() < 1e-5)
}

/// Triangles without area have unit normals. Their tangents have length 1 too, even if the triangles have no area in
/// texture coordinates. Without texture coordinates, tangents are zero.
pub(crate) fn check_zero_area_and_missing_uvs<D: Deformer>(create_deformer: impl Fn(&Arc<Scene>) -> D) {
    assert!(are_unit_vectors(&[0.6, 0.8, 0.0], 3));
    assert!(!are_unit_vectors(&[0.0; 3], 3) && !are_unit_vectors(&[f32::NAN; 3], 3));
    let modes = scenes::random_shape(&mut Random(35), 9, 2).modes;
    let shapes: Vec<Shape> = zero_area_meshes()
        .into_iter()
        .map(|mesh| Shape::new(mesh, modes.clone()).expect("expected a valid shape"))
        .collect();
    for normals in [NormalMethod::Rigid, NormalMethod::Exact] {
        let (deformation, normal_maps) = (DeformationSettings { normals, ..DeformationSettings::default() }, true);
        let scene = scene_of_shapes(shapes.clone(), 1, deformation, normal_maps);
        let mut deformer = create_deformer(&scene);
        for scale in [0.0, 1e-30, 1.0, 1e15] {
            let mut state = scenes::random_state(&scene, 8);
            state.q.iter_mut().for_each(|number| *number *= scale);
            let result = run_step(&mut deformer, &state);
            assert!(result.bounds.is_finite());
            assert!(are_unit_vectors(&result.surface.normals, 3), "{normals:?}, q of {scale:e}");
            for (domain, layout) in scene.layout.domains.iter().enumerate() {
                let tangents = &result.surface.tangents[4 * layout.first_corner..][..4 * layout.corners];
                let is_valid = if scene.shape_of(domain).tangents().is_empty() {
                    tangents.iter().all(|number| *number == 0.0)
                } else {
                    are_unit_vectors(tangents, 4) && tangents.iter().skip(3).step_by(4).all(|sign| sign.abs() == 1.0)
                };
                assert!(is_valid, "{normals:?}, q of {scale:e}, domain {domain}: {tangents:?}");
            }
        }
    }
}
