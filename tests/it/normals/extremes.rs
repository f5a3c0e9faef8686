//! Exact normals of surfaces that are collapsed, far from the origin, tiny, huge, overflowing or rotated by half a
//! turn.

use modalcast_compute::reference;
use modalcast_model::scene::Scene;
use nalgebra::{Matrix3, Rotation3, Vector3};

use super::fixtures::{
    angle_degrees, create_scene, create_state, deform_on_cpu, max_angle_degrees, reference_normals_and_tangents,
    shape_with_mode, sheet, tube, uniform_q_state,
};
use super::{MAX_ANGLE_DEGREES, linear_parts, parabola};

/// Bound of the rounding error of a sum of area vectors, as a fraction of the rounding scale B of [`max_error_ratio`].
/// If each position is rounded once, the bound is 2^-23. It is doubled, because the CPU deformer rounds several times.
const ROUNDING_BOUND: f64 = 2.0 / 8_388_608.0;

/// Largest ratio of the angular error of a normal to its bound. The section "Fallback" of
/// `src/compute/reference/normals.rs` derives the bound. At a corner of a triangle, l and m are the sums of the
/// absolute components of the two edges, and w is this sum for the position of the corner. The rounding scale B of a
/// normal is the sum of l (l + w) + m (m + w) over the triangles at the corner.
fn max_error_ratio(scene: &Scene, positions: &[[f64; 3]], normals: &[f32], reference_normals: &[[f64; 3]]) -> f64 {
    let mesh = &scene.shapes[0].mesh;
    // Per corner: the sum of the area vectors of its triangles, and their rounding scale B.
    let mut corner_sums = vec![(Vector3::zeros(), 0.0); reference_normals.len()];
    for triangle in mesh.triangles() {
        for corner in 0..3 {
            // The corner of the triangle `offset` places after `corner`.
            let position = |offset: usize| {
                Vector3::from(positions[mesh.corners().vertices[triangle[(corner + offset) % 3] as usize] as usize])
            };
            let (corner_position, first_edge, second_edge) =
                (position(0), position(1) - position(0), position(2) - position(0));
            let (area_sum, rounding_sum) = &mut corner_sums[triangle[corner] as usize];
            *area_sum += first_edge.cross(&second_edge);
            let (l, m, w) = (first_edge.abs().sum(), second_edge.abs().sum(), corner_position.abs().sum());
            *rounding_sum += l * (l + w) + m * (m + w);
        }
    }
    let mut max_ratio = 0.0_f64;
    for ((normal, reference_normal), (area_sum, rounding_sum)) in
        normals.chunks_exact(3).zip(reference_normals).zip(&corner_sums)
    {
        let error = angle_degrees([0, 1, 2].map(|axis| f64::from(normal[axis])), *reference_normal).to_radians();
        // 2e-7 is for rounding the normal itself to f32.
        let ratio = error / (ROUNDING_BOUND * rounding_sum / area_sum.norm() + 2e-7);
        max_ratio = if ratio.is_nan() { f64::INFINITY } else { max_ratio.max(ratio) };
    }
    max_ratio
}

/// A sheet collapsed to a line or to a point keeps its rigid normals. A sheet that is almost collapsed has the normals
/// of its deformed surface.
#[test]
fn collapsed_sheet_keeps_its_rigid_normals() {
    let collapse =
        |axes: [f32; 3]| move |rest_position: [f32; 3]| [0, 1, 2].map(|axis| -axes[axis] * rest_position[axis]);
    for axes in [[1.0, 0.0, 0.0], [1.0, 1.0, 1.0]] {
        let scene = create_scene(vec![shape_with_mode(sheet(9, 9), collapse(axes))]);
        for linear in linear_parts() {
            let state = create_state(&scene, 1.0, linear, [0.0; 3]);
            let (normals, tangents) = reference_normals_and_tangents(&scene, &state);
            assert_eq!(normals, reference::rigid_normals(&scene, &state));
            assert_eq!(tangents, reference::rigid_tangents(&scene, &state));
            let surface = deform_on_cpu(&scene, &state);
            assert!(max_angle_degrees(&surface.normals, &normals) < MAX_ANGLE_DEGREES);
            assert!(surface.tangents.iter().all(|number| number.is_finite()));
        }
    }
    // Almost collapsed to a line: x becomes 0.001 x and z becomes 0.002 x, so that the normal has the direction
    // (-0.002, 0, 0.001).
    let narrow_scene = create_scene(vec![shape_with_mode(sheet(9, 9), |[x, _, _]| [-0.999 * x, 0.0, 0.002 * x])]);
    let (normals, _) = reference_normals_and_tangents(&narrow_scene, &uniform_q_state(&narrow_scene, 1.0));
    assert!(normals.iter().all(|normal| angle_degrees(*normal, [-0.002, 0.0, 0.001]) < 0.01));
    assert!(
        max_angle_degrees(&deform_on_cpu(&narrow_scene, &uniform_q_state(&narrow_scene, 1.0)).normals, &normals) < 0.1
    );
}

/// A tube that T flattens along its axis is a circle. A mode opens it to a cone, whose flat picture has a normal, although
/// T maps all rest normals to zero. Exactly singular transforms, and one that is singular up to rounding on each side.
#[test]
fn flattened_tube_has_the_normals_of_its_cone() {
    let scene = create_scene(vec![shape_with_mode(tube(24, 5, 0.0), |[x, y, z]| [x * y, 0.0, z * y])]);
    let rotation = Rotation3::from_euler_angles(0.3, -1.1, 2.0).into_inner();
    for thickness in [0.0, 1e-9, -1e-9] {
        let linear = rotation * Matrix3::from_diagonal(&Vector3::new(1.0, thickness, 1.0));
        let state = create_state(&scene, 0.5, linear, [0.0; 3]);
        let (normals, tangents) = reference_normals_and_tangents(&scene, &state);
        // The radius is 1 + y / 2, so that the normal has the slope -1/2 along y, of which only the sign remains.
        let determinant_sign = state.composed_transform(&scene, 0).linear().determinant().signum();
        let expected: [f64; 3] = (rotation * Vector3::new(0.0, -determinant_sign, 0.0)).into();
        for (normal, [tangent @ .., _]) in normals.iter().zip(&tangents) {
            assert!(angle_degrees(*normal, expected) < 0.01, "{thickness}: {normal:?} {expected:?}");
            assert!(Vector3::from(*normal).dot(&Vector3::from(*tangent)).abs() < 1e-6, "{tangent:?}");
        }
        let surface = deform_on_cpu(&scene, &state);
        assert!(max_angle_degrees(&surface.normals, &normals) < MAX_ANGLE_DEGREES, "{thickness}");
        let rigid_normals = reference::rigid_normals(&scene, &state);
        assert!(rigid_normals.iter().all(|normal| angle_degrees(*normal, expected) > 30.0), "negative control");
    }
}

/// Corners without triangles keep their rest normals.
#[test]
fn zero_area_triangles_do_not_change_normals() {
    let mesh = sheet(5, 5);
    let mut triangles = mesh.triangles().to_vec();
    let (original_triangles, corners) = (triangles.clone(), mesh.corners().clone());
    // The added triangles have collinear corners (a part of the first row) or repeated corners. No remaining triangle
    // contains corner 24, the last one.
    triangles.extend([[0, 1, 3], [6, 6, 7], [8, 8, 8]]);
    triangles.retain(|triangle| !triangle.contains(&24));
    let scene_of_triangles = |triangles: Vec<[u32; 3]>| {
        let corners = corners.clone();
        let mesh = modalcast_model::domain::Mesh::from_indexed(
            mesh.rest_positions().to_vec(),
            corners.normals,
            corners.uvs,
            triangles,
        );
        create_scene(vec![shape_with_mode(mesh.expect("expected a valid mesh"), |[x, y, _]| [0.0, 0.0, x + 0.5 * y])])
    };
    let (degenerate_scene, original_scene) = (scene_of_triangles(triangles), scene_of_triangles(original_triangles));
    let state = uniform_q_state(&degenerate_scene, 0.8);
    let (degenerate_normals, _) = reference_normals_and_tangents(&degenerate_scene, &state);
    let (original_normals, _) = reference_normals_and_tangents(&original_scene, &state);
    for corner in 0..24 {
        assert!(angle_degrees(degenerate_normals[corner], original_normals[corner]) < 1e-5, "corner {corner}");
    }
    assert_eq!(degenerate_normals[24], [0.0, 0.0, 1.0], "expected the rest normal");
    let angle = angle_degrees(original_normals[24], degenerate_normals[24]);
    assert!(angle > 30.0, "negative control: expected another normal with the original triangles, got {angle} degrees");
    assert!(
        max_angle_degrees(&deform_on_cpu(&degenerate_scene, &state).normals, &degenerate_normals) < MAX_ANGLE_DEGREES
    );
}

#[test]
fn normals_do_not_depend_on_the_scale_of_a_domain() {
    let scene = create_scene(vec![shape_with_mode(sheet(17, 9), parabola)]);
    for linear in linear_parts() {
        let (unscaled_normals, unscaled_tangents) =
            reference_normals_and_tangents(&scene, &create_state(&scene, 0.5, linear, [0.0; 3]));
        for scale in [1e-40, 1e-30, 1e-20, 1e18, 1e30, 1e37] {
            let state = create_state(&scene, 0.5, linear * scale, [0.0; 3]);
            let surface = deform_on_cpu(&scene, &state);
            // Positions of 1e-40 are denormal, with about five significant digits.
            let tolerance = if scale < 1e-38 { 0.1 } else { MAX_ANGLE_DEGREES };
            let error = max_angle_degrees(&surface.normals, &unscaled_normals);
            assert!(error < tolerance, "scale {scale}: expected less than {tolerance} degrees, got {error}");
            let (reference_normals, tangents) = reference_normals_and_tangents(&scene, &state);
            assert!(max_angle_degrees(&surface.normals, &reference_normals) < tolerance, "scale {scale}");
            for (tangent, unscaled_tangent) in tangents.iter().zip(&unscaled_tangents) {
                assert!(
                    angle_degrees([0, 1, 2].map(|axis| tangent[axis]), [0, 1, 2].map(|axis| unscaled_tangent[axis]))
                        < tolerance
                );
            }
        }
    }
}

/// Small domains, whose shape is lost when their positions are rounded to f32, have rigid normals.
#[test]
fn normals_far_from_the_origin_stay_within_their_bound() {
    let scene = create_scene(vec![shape_with_mode(tube(24, 6, 0.0), |[x, y, _]| [0.2 * y * y, 0.1 * x, 0.3 * x * y])]);
    let translation = [1e7, -1e7, 1e7];
    // `size` scales the domain. `keeps_shape` is false if the rounding of positions at 1e7 hides its shape.
    for (size, keeps_shape) in [(1e6, true), (1e5, true), (1.0, false), (1e-3, false)] {
        for linear in linear_parts() {
            let state = create_state(&scene, 0.3, linear * size, translation);
            let positions = reference::deform(&scene, &state);
            let (normals, _) = reference_normals_and_tangents(&scene, &state);
            let rigid_normals = reference::rigid_normals(&scene, &state);
            let cpu_normals = deform_on_cpu(&scene, &state).normals;
            assert_eq!(normals != rigid_normals, keeps_shape, "size {size}");
            if keeps_shape {
                let ratio = max_error_ratio(&scene, &positions, &cpu_normals, &normals);
                assert!(ratio <= 1.0, "size {size}: expected an error within the bound, got {ratio} of the bound");
                assert!(ratio > 1e-3, "size {size}: expected a tight bound, got an error of {ratio} of the bound");
            } else {
                assert!(max_angle_degrees(&cpu_normals, &rigid_normals) < MAX_ANGLE_DEGREES, "size {size}");
            }
        }
    }
}

#[test]
fn overflow_and_half_turns_give_unit_normals() {
    let scene = create_scene(vec![shape_with_mode(tube(16, 4, 0.0), |[x, y, z]| [-2.0 * x, y, -2.0 * z])]);
    for q in [1.0, 1e30, 3e38, -3e38] {
        for scale in [1.0, 1e-30, 1e10] {
            let surface = deform_on_cpu(&scene, &create_state(&scene, q, Matrix3::identity() * scale, [0.0; 3]));
            for (normal, tangent) in surface.normals.chunks_exact(3).zip(surface.tangents.chunks_exact(4)) {
                let length = |vector: &[f32]| vector.iter().map(|number| number * number).sum::<f32>().sqrt();
                assert!((length(normal) - 1.0).abs() < 1e-6, "q {q}, scale {scale}: {normal:?}");
                assert!((length(&tangent[..3]) - 1.0).abs() < 1e-6, "q {q}, scale {scale}: {tangent:?}");
            }
        }
    }
    // At q = 1, the mode rotates the tube by 180 degrees about y and stretches it along y. The tube has 16 sides, so
    // that a rest normal differs from the normals of its triangles by at most 360 / 16 / 2 = 11.25 degrees. Close to
    // half a turn, the error of the rotation is at most twice that angle.
    let (normals, _) = reference_normals_and_tangents(&scene, &uniform_q_state(&scene, 1.0));
    for (normal, rest_normal) in normals.iter().zip(&scene.shapes[0].mesh.corners().normals) {
        assert!(angle_degrees(*normal, rest_normal.map(f64::from)) >= 180.0 - 22.5);
    }
}
