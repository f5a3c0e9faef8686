//! Exact normals and tangents follow the deformed triangles. Rigid normals follow only the transform of the domain. The
//! tests compare the f64 reference with closed-form normals, and the CPU deformer with the reference.

mod extremes;
mod fixtures;
mod normal_reuse;

use modalcast_compute::reference;
use modalcast_model::scene::NormalMethod;
use nalgebra::{Matrix3, Rotation3, Vector3};

use fixtures::{
    angle_degrees, creased_box, create_scene, create_state, cube, deform_on_cpu, max_angle_degrees,
    reference_normals_and_tangents, scene_with_normals, shape_with_mode, sheet, sphere, tube, uniform_q_state,
};

/// Maximum angle between CPU and reference normals or tangents, in degrees.
const MAX_ANGLE_DEGREES: f64 = 1e-3;

/// The mode that displaces a flat sheet by z = x^2.
fn parabola(rest_position: [f32; 3]) -> [f32; 3] {
    [0.0, 0.0, rest_position[0] * rest_position[0]]
}

/// Linear parts of transforms: a scaled rotation, a mirrored rotation and a rotated shear.
fn linear_parts() -> [Matrix3<f64>; 3] {
    let rotation = Rotation3::from_euler_angles(0.3, -1.1, 2.0).into_inner();
    [rotation * 2.0, rotation * -1.0, rotation * Matrix3::new(1.0, 0.7, -0.2, 0.0, 0.5, 0.4, 0.1, 0.0, 1.5)]
}

/// The unit normal transformed by the inverse transpose of a linear map.
fn transform_normal(linear: Matrix3<f64>, normal: [f64; 3]) -> [f64; 3] {
    let inverse = linear.try_inverse().expect("expected an invertible map");
    (inverse.transpose() * Vector3::from(normal)).normalize().into()
}

/// Negative control: rigid normals differ by more than 40 degrees.
#[test]
fn bent_strip_has_normals_and_tangents_of_its_parabola() {
    let scene = create_scene(vec![shape_with_mode(sheet(33, 5), parabola)]);
    let state = uniform_q_state(&scene, 0.5);
    let (normals, tangents) = reference_normals_and_tangents(&scene, &state);
    let surface = deform_on_cpu(&scene, &state);
    let rigid_normals = reference::rigid_normals(&scene, &state);
    let mut max_rigid_error = 0.0_f64;
    let is_interior =
        |(_, rest_position): &(usize, &[f32; 3])| rest_position[0].abs() < 0.99 && rest_position[1].abs() < 0.99;
    for (corner, [x, ..]) in scene.shapes[0].mesh.rest_positions().iter().enumerate().filter(is_interior) {
        // At q = 0.5, z = x^2 / 2 has the slope x. It equals the slope of the chord between the two neighbors.
        let slope = f64::from(*x);
        assert!(angle_degrees(normals[corner], [-slope, 0.0, 1.0]) < 1e-5, "corner {corner}: {:?}", normals[corner]);
        let [tangent @ .., handedness] = tangents[corner];
        assert!(
            angle_degrees(tangent, [1.0, 0.0, slope]) < 1e-5 && handedness == 1.0,
            "corner {corner}: {:?}",
            tangents[corner]
        );
        max_rigid_error = max_rigid_error.max(angle_degrees(rigid_normals[corner], normals[corner]));
    }
    assert!(max_rigid_error > 40.0, "negative control: expected more than 40 degrees, got {max_rigid_error}");
    assert!(max_angle_degrees(&surface.normals, &normals) < MAX_ANGLE_DEGREES);
    let rigid_scene = scene_with_normals(scene.shapes.clone(), NormalMethod::Rigid);
    assert!(
        max_angle_degrees(&deform_on_cpu(&rigid_scene, &state).normals, &normals) > 40.0,
        "negative control: expected rigid normals to differ"
    );
}

#[test]
fn sheared_box_has_face_normals_and_hard_edges() {
    let scene = create_scene(vec![shape_with_mode(cube(), |[_, y, z]| [z - 0.5 * y, 0.0, 0.3 * z])]);
    // The identity plus the gradient of the mode, for q = 1.
    let deformation_gradient = Matrix3::new(1.0, -0.5, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.3);
    let corners = scene.shapes[0].mesh.corners();
    assert_eq!(
        scene.shapes[0].smoothing().expect("expected smoothing groups").group_count(),
        24,
        "expected a smoothing group for each of the 24 corners"
    );
    for linear in linear_parts() {
        let state = create_state(&scene, 1.0, linear, [1.0, 2.0, 3.0]);
        let (normals, _) = reference_normals_and_tangents(&scene, &state);
        for (normal, rest_normal) in normals.iter().zip(&corners.normals) {
            let error =
                angle_degrees(*normal, transform_normal(linear * deformation_gradient, rest_normal.map(f64::from)));
            assert!(error < 1e-4, "expected the face normal, got one that differs by {error} degrees");
        }
        // Corner 0 is on the face x = 0, corner 8 on the face y = 0.
        let edge_angle = angle_degrees(normals[0], normals[8]);
        assert!(edge_angle > 30.0, "expected more than 30 degrees between adjacent faces, got {edge_angle}");
        assert!(max_angle_degrees(&deform_on_cpu(&scene, &state).normals, &normals) < MAX_ANGLE_DEGREES);
    }
}

/// A mesh file without normals: the exact normals of a deformed state are the area-weighted normals of the deformed
/// triangles of each side of a crease. Negative control: with a crease angle of 180 degrees they are those of all
/// triangles of a vertex.
#[test]
fn creases_of_a_file_stay_hard_while_it_deforms() {
    let max_error = |degrees: f64| {
        let scene = creased_box(degrees);
        let mesh = &scene.shapes[0].mesh;
        let state = create_state(&scene, 0.4, linear_parts()[0], [1.0, 2.0, 3.0]);
        let positions = reference::deform(&scene, &state);
        let (normals, _) = reference_normals_and_tangents(&scene, &state);
        assert!(max_angle_degrees(&deform_on_cpu(&scene, &state).normals, &normals) < MAX_ANGLE_DEGREES);
        let area_vector = |triangle: &[u32; 3]| {
            let [a, b, c] =
                triangle.map(|corner| Vector3::from(positions[mesh.corners().vertices[corner as usize] as usize]));
            (b - a).cross(&(c - a))
        };
        // Triangles of one side have the same rest normal, because the sides of the box are flat.
        let rest_normal = |triangle: &[u32; 3]| {
            let [a, b, c] = triangle.map(|corner| mesh.corners().vertices[corner as usize] as usize);
            let [a, b, c] = [a, b, c].map(|vertex| Vector3::from(mesh.rest_positions()[vertex]));
            (b - a).cross(&(c - a)).normalize()
        };
        let mut max_error = 0.0_f64;
        for triangle in mesh.triangles() {
            for corner in triangle {
                let vertex = |corner: u32| mesh.corners().vertices[corner as usize];
                let is_on_side = |other: &&[u32; 3]| {
                    other.iter().any(|other| vertex(*other) == vertex(*corner))
                        && rest_normal(other).dot(&rest_normal(triangle)) > 0.99
                };
                let expected: Vector3<f64> = mesh.triangles().iter().filter(is_on_side).map(area_vector).sum();
                max_error = max_error.max(angle_degrees(normals[*corner as usize], expected.into()));
            }
        }
        max_error
    };
    assert!(max_error(40.0) < 1e-4, "{} degrees", max_error(40.0));
    assert!(max_error(180.0) > 30.0, "negative control: {} degrees", max_error(180.0));
}

#[test]
fn stretched_sphere_has_normals_of_the_ellipsoid() {
    // The identity plus the gradient of the mode below, for q = 1.
    let stretch = Matrix3::from_diagonal(&Vector3::new(2.0, 1.0, 0.5));
    let errors = [3, 4, 5].map(|level| {
        let scene = create_scene(vec![shape_with_mode(sphere(level), |[x, _, z]| [x, 0.0, -0.5 * z])]);
        let state = uniform_q_state(&scene, 1.0);
        let (normals, _) = reference_normals_and_tangents(&scene, &state);
        let mesh = &scene.shapes[0].mesh;
        for (normal, rest_normal) in normals.iter().zip(&mesh.corners().normals) {
            let error = angle_degrees(*normal, transform_normal(stretch, rest_normal.map(f64::from)));
            assert!(error < 1e-3, "expected the transformed rest normal, got one that differs by {error} degrees");
        }
        assert!(max_angle_degrees(&deform_on_cpu(&scene, &state).normals, &normals) < MAX_ANGLE_DEGREES);
        let analytic_normals: Vec<_> =
            mesh.rest_positions().iter().map(|position| transform_normal(stretch, position.map(f64::from))).collect();
        let rigid_normals = reference::rigid_normals(&scene, &state);
        let max_error = |normals: &[[f64; 3]]| {
            normals.iter().zip(&analytic_normals).map(|(a, b)| angle_degrees(*a, *b)).fold(0.0, f64::max)
        };
        assert!(max_error(&rigid_normals) > 30.0, "negative control: expected rigid normals to differ");
        max_error(&normals)
    });
    // Each level halves the edges of the triangles. Smaller triangles approximate the smooth surface better.
    assert!(errors[1] < 0.75 * errors[0] && errors[2] < 0.75 * errors[1] && errors[2] < 2.0, "{errors:?} degrees");
}

/// Rest normals may be arbitrary. So the first shape has random normals.
#[test]
fn exact_normals_equal_rigid_normals_at_zero_q() {
    let mut mesh = sheet(9, 9);
    let corners = mesh.corners().clone();
    let mut random = crate::deformers::TestRng(5);
    let normals = corners.normals.iter().map(|_| [random.next(), random.next(), random.next()]).collect();
    let rest_positions = mesh.rest_positions().iter().map(|[x, y, _]| [*x, *y, 0.3 * random.next()]).collect();
    let triangles = mesh.triangles().to_vec();
    mesh = modalcast_model::domain::Mesh::from_indexed(rest_positions, normals, corners.uvs, triangles)
        .expect("expected a valid mesh");
    let scene = create_scene(vec![shape_with_mode(mesh, parabola), shape_with_mode(cube(), parabola)]);
    for linear in linear_parts() {
        let mut state = create_state(&scene, 0.0, linear, [1.0, -2.0, 0.5]);
        let (rigid_normals, rigid_tangents) =
            (reference::rigid_normals(&scene, &state), reference::rigid_tangents(&scene, &state));
        let (normals, tangents) = reference_normals_and_tangents(&scene, &state);
        let surface = deform_on_cpu(&scene, &state);
        for (normal, rigid_normal) in normals.iter().zip(&rigid_normals) {
            assert!(angle_degrees(*normal, *rigid_normal) < 1e-10);
        }
        for ([tangent @ .., handedness], [rigid_tangent @ .., rigid_handedness]) in tangents.iter().zip(&rigid_tangents)
        {
            // Rest tangents are orthogonal to rest normals up to the rounding of f32.
            let is_same = handedness == rigid_handedness && angle_degrees(*tangent, *rigid_tangent) < 2e-5;
            let has_tangent = *rigid_handedness != 0.0;
            assert!(is_same || !has_tangent);
        }
        assert!(max_angle_degrees(&surface.normals, &rigid_normals) < MAX_ANGLE_DEGREES);
        state.q.fill(1.0);
        let (deformed_normals, _) = reference_normals_and_tangents(&scene, &state);
        assert!(
            max_angle_degrees(&surface.normals, &deformed_normals) > 10.0,
            "negative control: expected others at q = 1"
        );
    }
}

/// Corners of a vertex that have the same rest normal form a smoothing group and share an exact normal. Negative
/// control: on the second tube, rest normals on both sides of the seam differ, and exact normals differ by more than 2
/// degrees.
#[test]
fn both_sides_of_a_uv_seam_share_one_normal() {
    let displacement = |[x, _, z]: [f32; 3]| [2.0 * x + z, 0.0, -0.5 * z * z];
    let mut max_seam_angles = [0.0_f64; 2];
    // `tilt` is the angle in degrees between the rest normals on both sides of the seam.
    for (max_angle, tilt) in max_seam_angles.iter_mut().zip([0.0, 0.2]) {
        let scene = create_scene(vec![shape_with_mode(tube(16, 4, tilt), displacement)]);
        let state = uniform_q_state(&scene, 0.7);
        let (normals, _) = reference_normals_and_tangents(&scene, &state);
        let cpu_normals = deform_on_cpu(&scene, &state).normals;
        // A row of the tube has 16 columns and 17 corners. The first and the last corner share a vertex on the seam.
        for row in 0..4 {
            let (first_corner, last_corner) = (17 * row, 17 * row + 16);
            *max_angle = max_angle.max(angle_degrees(normals[first_corner], normals[last_corner]));
            let cpu_normal = |corner: usize| &cpu_normals[3 * corner..][..3];
            assert_eq!(cpu_normal(first_corner) == cpu_normal(last_corner), tilt == 0.0, "row {row}, tilt {tilt}");
        }
        assert!(max_angle_degrees(&cpu_normals, &normals) < MAX_ANGLE_DEGREES);
    }
    assert_eq!(max_seam_angles[0], 0.0);
    assert!(max_seam_angles[1] > 2.0, "expected more than 2 degrees without a group, got {}", max_seam_angles[1]);
}

#[test]
fn rest_normals_opposite_to_the_winding_stay_opposite() {
    let mesh = sheet(9, 9);
    let downward_normals = vec![[0.0, 0.0, -1.0]; 81];
    let flipped_mesh = modalcast_model::domain::Mesh::from_indexed(
        mesh.rest_positions().to_vec(),
        downward_normals,
        vec![],
        mesh.triangles().to_vec(),
    );
    let scene = create_scene(vec![
        shape_with_mode(mesh, parabola),
        shape_with_mode(flipped_mesh.expect("expected a valid mesh"), parabola),
    ]);
    let (normals, _) = reference_normals_and_tangents(&scene, &uniform_q_state(&scene, 0.5));
    // Corner i of the second shape is corner 81 + i of the scene.
    for corner in 0..81 {
        assert!(angle_degrees(normals[corner], normals[81 + corner]) > 180.0 - 1e-5);
    }
}

/// A mirroring transform also flips the bitangent sign, the fourth number of a tangent.
#[test]
fn transform_applies_inverse_transpose_to_normals() {
    let scene = create_scene(vec![shape_with_mode(sheet(9, 9), |[x, y, _]| [0.1 * y, 0.0, x * x - 0.4 * y])]);
    let (normals, tangents) = reference_normals_and_tangents(&scene, &uniform_q_state(&scene, 0.6));
    for linear in linear_parts() {
        let state = create_state(&scene, 0.6, linear, [5.0, 1.0, -3.0]);
        let (transformed_normals, transformed_tangents) = reference_normals_and_tangents(&scene, &state);
        for (transformed_normal, normal) in transformed_normals.iter().zip(&normals) {
            assert!(angle_degrees(*transformed_normal, transform_normal(linear, *normal)) < 1e-4);
        }
        let handedness = linear.determinant().signum();
        for (transformed_tangent, tangent) in transformed_tangents.iter().zip(&tangents) {
            assert_eq!(transformed_tangent[3], tangent[3] * handedness);
        }
        let surface = deform_on_cpu(&scene, &state);
        assert!(max_angle_degrees(&surface.normals, &transformed_normals) < MAX_ANGLE_DEGREES);
        let expected_tangents: Vec<[f64; 3]> = transformed_tangents.iter().map(|[x, y, z, _]| [*x, *y, *z]).collect();
        let cpu_tangents: Vec<f32> =
            surface.tangents.chunks_exact(4).flat_map(|tangent| tangent[..3].to_vec()).collect();
        assert!(max_angle_degrees(&cpu_tangents, &expected_tangents) < MAX_ANGLE_DEGREES);
    }
}

/// Shapes without texture coordinates have zero tangents.
#[test]
fn tangents_are_unit_and_orthogonal_to_normals() {
    let mesh_without_uvs = modalcast_model::domain::Mesh::from_indexed(
        sheet(5, 5).rest_positions().to_vec(),
        vec![fixtures::UP; 25],
        vec![],
        sheet(5, 5).triangles().to_vec(),
    );
    let wave = |[x, y, _]: [f32; 3]| [0.2 * y * y, 0.1 * x, (3.0 * x + y).sin()];
    let scene = create_scene(vec![
        shape_with_mode(mesh_without_uvs.expect("expected a valid mesh"), wave),
        shape_with_mode(sheet(17, 17), wave),
    ]);
    for linear in linear_parts() {
        let state = create_state(&scene, 0.4, linear, [0.0; 3]);
        let surface = deform_on_cpu(&scene, &state);
        for (corner, (normal, tangent)) in
            surface.normals.chunks_exact(3).zip(surface.tangents.chunks_exact(4)).enumerate()
        {
            let dot = |a: &[f32], b: &[f32]| -> f32 { a.iter().zip(b).map(|(a, b)| a * b).sum() };
            assert!((dot(normal, normal) - 1.0).abs() < 1e-6);
            // The first 25 corners are those of the shape without texture coordinates.
            if corner < 25 {
                assert_eq!(tangent, [0.0; 4]);
            } else {
                let direction = &tangent[..3];
                assert!((dot(direction, direction) - 1.0).abs() < 1e-6 && dot(direction, normal).abs() < 1e-6);
                assert_eq!(tangent[3].abs(), 1.0);
            }
        }
    }
}

/// Smoothing groups exist only in scenes with exact normals, and there only for shapes with modes.
#[test]
fn only_deformable_shapes_have_smoothing_groups() {
    let rigid_shape = modalcast_model::domain::Shape::new(sheet(3, 3), modalcast_model::domain::Modes::rigid())
        .expect("expected a valid shape");
    let shapes = || vec![shape_with_mode(sheet(3, 3), parabola), rigid_shape.clone()];
    let exact_scene = create_scene(shapes());
    assert!(exact_scene.features.exact_normals);
    assert!(exact_scene.shapes[0].smoothing().is_some() && exact_scene.shapes[1].smoothing().is_none());
    // The rigid shape has the last 9 of 18 corners. A corner has three numbers in `surface.normals`.
    let state = create_state(&exact_scene, 0.5, linear_parts()[2], [0.0; 3]);
    let surface = deform_on_cpu(&exact_scene, &state);
    let rigid_normals = reference::rigid_normals(&exact_scene, &state);
    assert!(
        max_angle_degrees(&surface.normals[27..], &rigid_normals[9..]) < MAX_ANGLE_DEGREES,
        "expected rigid normals of the rigid shape"
    );
    let rigid_scene = scene_with_normals(shapes(), NormalMethod::Rigid);
    assert!(!rigid_scene.features.exact_normals && rigid_scene.shapes.iter().all(|shape| shape.smoothing().is_none()));
}
