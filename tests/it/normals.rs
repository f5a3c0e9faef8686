//! Exact normals and tangents: the reference is compared with algebra, and the CPU deformer with the reference.

mod extremes;
mod fixtures;
mod normal_reuse;

use modalcast_compute::reference;
use modalcast_model::scene::NormalMethod;
use nalgebra::{Matrix3, Rotation3, Vector3};

use fixtures::{
    bent, cube, degrees, exact, largest_angle, on_cpu, scene, scene_with, sheet, sphere, state, tube, with_mode,
};

/// Largest accepted angle between the CPU's directions and the reference's on smooth surfaces, in degrees.
const TOLERANCE: f64 = 1e-3;

/// Displaces a sheet to z = q x^2.
fn parabola(rest: [f32; 3]) -> [f32; 3] {
    [0.0, 0.0, rest[0] * rest[0]]
}

/// A scaled rotation, a mirrored rotation and a rotated shear.
fn linear_parts() -> [Matrix3<f64>; 3] {
    let turn = Rotation3::from_euler_angles(0.3, -1.1, 2.0).into_inner();
    [turn * 2.0, turn * -1.0, turn * Matrix3::new(1.0, 0.7, -0.2, 0.0, 0.5, 0.4, 0.1, 0.0, 1.5)]
}

/// A normal transformed by the cofactor matrix of a linear map, normalized.
fn by_cofactors(linear: Matrix3<f64>, normal: [f64; 3]) -> [f64; 3] {
    let inverse = linear.try_inverse().expect("regular");
    (inverse.transpose() * Vector3::from(normal)).normalize().into()
}

/// Control: rigid normals are off by more than 40 degrees.
#[test]
fn bent_strip_has_normals_and_tangents_of_its_parabola() {
    let scene = scene(vec![with_mode(sheet(33, 5), parabola)]);
    let state = bent(&scene, 0.5);
    let (normals, tangents) = exact(&scene, &state);
    let cpu = on_cpu(&scene, &state);
    let rigid = reference::rigid_normals(&scene, &state);
    let mut largest = 0.0_f64;
    let inner = |(_, rest): &(usize, &[f32; 3])| rest[0].abs() < 0.99 && rest[1].abs() < 0.99;
    for (corner, [x, ..]) in scene.shapes[0].mesh.rest().iter().enumerate().filter(inner) {
        // The slope of a parabola equals that of the chord over both neighbors.
        let slope = f64::from(*x);
        assert!(degrees(normals[corner], [-slope, 0.0, 1.0]) < 1e-5, "corner {corner}: {:?}", normals[corner]);
        let [along @ .., sign] = tangents[corner];
        assert!(degrees(along, [1.0, 0.0, slope]) < 1e-5 && sign == 1.0, "corner {corner}: {:?}", tangents[corner]);
        largest = largest.max(degrees(rigid[corner], normals[corner]));
    }
    assert!(largest > 40.0, "rigid normals are off by {largest} degrees");
    assert!(largest_angle(&cpu.normals, &normals) < TOLERANCE);
    let rigid_scene = scene_with(scene.shapes.clone(), NormalMethod::Rigid);
    assert!(largest_angle(&on_cpu(&rigid_scene, &state).normals, &normals) > 40.0, "negative control");
}

#[test]
fn sheared_box_has_face_normals_and_hard_edges() {
    let scene = scene(vec![with_mode(cube(), |[_, y, z]| [z - 0.5 * y, 0.0, 0.3 * z])]);
    let bend = Matrix3::new(1.0, -0.5, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.3);
    let corners = scene.shapes[0].mesh.corners();
    assert_eq!(scene.shapes[0].smoothing().expect("groups").groups(), 24, "a group per corner");
    for linear in linear_parts() {
        let state = state(&scene, 1.0, linear, [1.0, 2.0, 3.0]);
        let (normals, _) = exact(&scene, &state);
        for (normal, rest) in normals.iter().zip(&corners.normals) {
            let error = degrees(*normal, by_cofactors(linear * bend, rest.map(f64::from)));
            assert!(error < 1e-4, "off by {error} degrees");
        }
        let apart = degrees(normals[0], normals[8]);
        assert!(apart > 30.0, "faces that share an edge are {apart} degrees apart");
        assert!(largest_angle(&on_cpu(&scene, &state).normals, &normals) < TOLERANCE);
    }
}

#[test]
fn stretched_sphere_has_normals_of_the_ellipsoid() {
    let stretch = Matrix3::from_diagonal(&Vector3::new(2.0, 1.0, 0.5));
    let errors = [3, 4, 5].map(|level| {
        let scene = scene(vec![with_mode(sphere(level), |[x, _, z]| [x, 0.0, -0.5 * z])]);
        let state = bent(&scene, 1.0);
        let (normals, _) = exact(&scene, &state);
        let mesh = &scene.shapes[0].mesh;
        for (normal, rest) in normals.iter().zip(&mesh.corners().normals) {
            let error = degrees(*normal, by_cofactors(stretch, rest.map(f64::from)));
            assert!(error < 1e-3, "area vectors turn by cofactors, but this is off by {error} degrees");
        }
        assert!(largest_angle(&on_cpu(&scene, &state).normals, &normals) < TOLERANCE);
        let smooth: Vec<_> = mesh.rest().iter().map(|place| by_cofactors(stretch, place.map(f64::from))).collect();
        let rigid = reference::rigid_normals(&scene, &state);
        let off = |(normal, smooth): (&[f64; 3], &[f64; 3])| degrees(*normal, *smooth);
        assert!(rigid.iter().zip(&smooth).map(off).fold(0.0, f64::max) > 30.0, "rigid ones are no ellipsoid's");
        normals.iter().zip(&smooth).map(off).fold(0.0, f64::max)
    });
    // Finer triangles approximate the smooth surface better.
    assert!(errors[1] < 0.75 * errors[0] && errors[2] < 0.75 * errors[1] && errors[2] < 2.0, "{errors:?} degrees");
}

/// At q = 0 exact normals equal the rigid ones, for authored rest normals as well as for computed ones.
#[test]
fn exact_normals_equal_rigid_ones_at_zero_q() {
    let mut authored = sheet(9, 9);
    let corners = authored.corners().clone();
    let mut noise = crate::deformers::TestRng(5);
    let normals = corners.normals.iter().map(|_| [noise.next(), noise.next(), noise.next()]).collect();
    let rest = authored.rest().iter().map(|[x, y, _]| [*x, *y, 0.3 * noise.next()]).collect();
    let triangles = authored.triangles().to_vec();
    authored = modalcast_model::domain::Mesh::from_indexed(rest, normals, corners.uvs, triangles)
        .expect("expected a valid mesh");
    let scene = scene(vec![with_mode(authored, parabola), with_mode(cube(), parabola)]);
    for linear in linear_parts() {
        let mut state = state(&scene, 0.0, linear, [1.0, -2.0, 0.5]);
        let (rigid, along) = (reference::rigid_normals(&scene, &state), reference::rigid_tangents(&scene, &state));
        let (normals, tangents) = exact(&scene, &state);
        let cpu = on_cpu(&scene, &state);
        for (exact, rigid) in normals.iter().zip(&rigid) {
            assert!(degrees(*exact, *rigid) < 1e-10);
        }
        for ([exact @ .., sign], [rigid @ .., hand]) in tangents.iter().zip(&along) {
            // Rest tangents are orthogonal to rest normals up to the rounding of f32.
            assert!((sign, true) == (hand, degrees(*exact, *rigid) < 2e-5) || *hand == 0.0);
        }
        assert!(largest_angle(&cpu.normals, &rigid) < TOLERANCE);
        state.q.fill(1.0);
        let (bent, _) = exact(&scene, &state);
        assert!(largest_angle(&cpu.normals, &bent) > 10.0, "negative control");
    }
}

/// Corners on both sides of a seam of texture coordinates form one smoothing group. Control: sides with different rest
/// normals form no group and differ by degrees.
#[test]
fn both_sides_of_a_uv_seam_share_one_normal() {
    let squash = |[x, _, z]: [f32; 3]| [2.0 * x + z, 0.0, -0.5 * z * z];
    let mut widest = [0.0_f64; 2];
    for (widest, tilt) in widest.iter_mut().zip([0.0, 0.2]) {
        let scene = scene(vec![with_mode(tube(16, 4, tilt), squash)]);
        let state = bent(&scene, 0.7);
        let (normals, _) = exact(&scene, &state);
        let cpu = on_cpu(&scene, &state).normals;
        for row in 0..4 {
            let (first, last) = (17 * row, 17 * row + 16);
            *widest = widest.max(degrees(normals[first], normals[last]));
            assert_eq!(cpu[3 * first..][..3] == cpu[3 * last..][..3], tilt == 0.0);
        }
        assert!(largest_angle(&cpu, &normals) < TOLERANCE);
    }
    assert_eq!(widest[0], 0.0);
    assert!(widest[1] > 2.0, "sides that are no group are {} degrees apart", widest[1]);
}

#[test]
fn rest_normals_opposite_to_the_winding_stay_opposite() {
    let mesh = sheet(9, 9);
    let down = vec![[0.0, 0.0, -1.0]; 81];
    let flipped =
        modalcast_model::domain::Mesh::from_indexed(mesh.rest().to_vec(), down, vec![], mesh.triangles().to_vec());
    let scene = scene(vec![with_mode(mesh, parabola), with_mode(flipped.expect("expected a valid mesh"), parabola)]);
    let (normals, _) = exact(&scene, &bent(&scene, 0.5));
    for corner in 0..81 {
        assert!(degrees(normals[corner], normals[81 + corner]) > 180.0 - 1e-5);
    }
}

/// A mirror also flips the sign of each tangent.
#[test]
fn transforms_act_on_bent_normals_by_their_cofactors() {
    let scene = scene(vec![with_mode(sheet(9, 9), |[x, y, _]| [0.1 * y, 0.0, x * x - 0.4 * y])]);
    let (normals, tangents) = exact(&scene, &bent(&scene, 0.6));
    for linear in linear_parts() {
        let state = state(&scene, 0.6, linear, [5.0, 1.0, -3.0]);
        let (turned, along) = exact(&scene, &state);
        for (turned, normal) in turned.iter().zip(&normals) {
            assert!(degrees(*turned, by_cofactors(linear, *normal)) < 1e-4);
        }
        let hand = linear.determinant().signum();
        let signs = along.iter().zip(&tangents).map(|(turned, tangent)| (turned[3], tangent[3]));
        signs.for_each(|(turned, sign)| assert_eq!(turned, sign * hand));
        let cpu = on_cpu(&scene, &state);
        assert!(largest_angle(&cpu.normals, &turned) < TOLERANCE);
        let carried: Vec<[f64; 3]> = along.iter().map(|[x, y, z, _]| [*x, *y, *z]).collect();
        let own: Vec<f32> = cpu.tangents.chunks_exact(4).flat_map(|tangent| tangent[..3].to_vec()).collect();
        assert!(largest_angle(&own, &carried) < TOLERANCE);
    }
}

/// Shapes without texture coordinates have zero tangents.
#[test]
fn tangents_are_unit_and_orthogonal_to_normals() {
    let bare = modalcast_model::domain::Mesh::from_indexed(
        sheet(5, 5).rest().to_vec(),
        vec![fixtures::UP; 25],
        vec![],
        sheet(5, 5).triangles().to_vec(),
    );
    let wave = |[x, y, _]: [f32; 3]| [0.2 * y * y, 0.1 * x, (3.0 * x + y).sin()];
    let scene = scene(vec![with_mode(bare.expect("expected a valid mesh"), wave), with_mode(sheet(17, 17), wave)]);
    for linear in linear_parts() {
        let state = state(&scene, 0.4, linear, [0.0; 3]);
        let cpu = on_cpu(&scene, &state);
        for (at, (normal, tangent)) in cpu.normals.chunks_exact(3).zip(cpu.tangents.chunks_exact(4)).enumerate() {
            let dot = |a: &[f32], b: &[f32]| -> f32 { a.iter().zip(b).map(|(a, b)| a * b).sum() };
            assert!((dot(normal, normal) - 1.0).abs() < 1e-6);
            if at < 25 {
                assert_eq!(tangent, [0.0; 4]);
            } else {
                let along = &tangent[..3];
                assert!((dot(along, along) - 1.0).abs() < 1e-6 && dot(along, normal).abs() < 1e-6);
                assert_eq!(tangent[3].abs(), 1.0);
            }
        }
    }
}

/// Smoothing groups exist only in scenes with exact normals, and there only for shapes with modes.
#[test]
fn only_deformable_shapes_have_smoothing_groups() {
    let rigid = modalcast_model::domain::Shape::new(sheet(3, 3), modalcast_model::domain::Modes::rigid())
        .expect("expected a valid shape");
    let shapes = || vec![with_mode(sheet(3, 3), parabola), rigid.clone()];
    let asks = scene(shapes());
    assert!(asks.needs.exact_normals);
    assert!(asks.shapes[0].smoothing().is_some() && asks.shapes[1].smoothing().is_none());
    let state = state(&asks, 0.5, linear_parts()[2], [0.0; 3]);
    let cpu = on_cpu(&asks, &state);
    let orient = reference::rigid_normals(&asks, &state);
    assert!(largest_angle(&cpu.normals[27..], &orient[9..]) < TOLERANCE, "the rigid shape");
    let silent = scene_with(shapes(), NormalMethod::Rigid);
    assert!(!silent.needs.exact_normals && silent.shapes.iter().all(|shape| shape.smoothing().is_none()));
}
