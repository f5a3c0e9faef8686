//! Exact normals at the limits of f32: no area, far from the origin, tiny, huge, overflowed and folded.

use modalcast_compute::reference;
use modalcast_model::scene::Scene;
use nalgebra::{Matrix3, Vector3};

use super::fixtures::{bent, degrees, exact, largest_angle, on_cpu, scene, sheet, state, tube, with_mode};
use super::{TOLERANCE, linear_parts, parabola};

/// Twice the bound for positions that are rounded once, because the CPU's own sum is rounded a few more times.
const BOUND: f64 = 2.0 / 8_388_608.0;

/// Largest ratio of the angular error of a corner to its bound; see `reference/normals.rs`.
fn part_of_bound(scene: &Scene, positions: &[[f64; 3]], got: &[f32], want: &[[f64; 3]]) -> f64 {
    let mesh = &scene.shapes[0].mesh;
    let mut sums = vec![(Vector3::zeros(), 0.0); want.len()];
    for triangle in mesh.triangles() {
        for at in 0..3 {
            let place = |step: usize| {
                Vector3::from(positions[mesh.corners().vertices[triangle[(at + step) % 3] as usize] as usize])
            };
            let (own, edge, other) = (place(0), place(1) - place(0), place(2) - place(0));
            let (sum, rounding) = &mut sums[triangle[at] as usize];
            *sum += edge.cross(&other);
            let (l, m, w) = (edge.abs().sum(), other.abs().sum(), own.abs().sum());
            *rounding += l * (l + w) + m * (m + w);
        }
    }
    let mut most = 0.0_f64;
    for ((got, want), (sum, rounding)) in got.chunks_exact(3).zip(want).zip(&sums) {
        let error = degrees([0, 1, 2].map(|axis| f64::from(got[axis])), *want).to_radians();
        let part = error / (BOUND * rounding / sum.norm() + 2e-7);
        most = if part.is_nan() { f64::INFINITY } else { most.max(part) };
    }
    most
}

/// A sheet collapsed to a line or to a point keeps its rigid normals. A sheet that is almost collapsed has the normals
/// of its folded surface.
#[test]
fn collapsed_sheet_keeps_its_rigid_normals() {
    let crush = |axes: [f32; 3]| move |rest: [f32; 3]| [0, 1, 2].map(|axis| -axes[axis] * rest[axis]);
    for axes in [[1.0, 0.0, 0.0], [1.0, 1.0, 1.0]] {
        let scene = scene(vec![with_mode(sheet(9, 9), crush(axes))]);
        for linear in linear_parts() {
            let state = state(&scene, 1.0, linear, [0.0; 3]);
            let (normals, tangents) = exact(&scene, &state);
            assert_eq!(normals, reference::rigid_normals(&scene, &state));
            assert_eq!(tangents, reference::rigid_tangents(&scene, &state));
            let cpu = on_cpu(&scene, &state);
            assert!(largest_angle(&cpu.normals, &normals) < TOLERANCE);
            assert!(cpu.tangents.iter().all(|number| number.is_finite()));
        }
    }
    // Almost collapsed to a line: a thousandth of the width is left, and the normals follow the folded surface.
    let folded = scene(vec![with_mode(sheet(9, 9), |[x, _, _]| [-0.999 * x, 0.0, 0.002 * x])]);
    let (normals, _) = exact(&folded, &bent(&folded, 1.0));
    assert!(normals.iter().all(|normal| degrees(*normal, [-0.002, 0.0, 0.001]) < 0.01));
    assert!(largest_angle(&on_cpu(&folded, &bent(&folded, 1.0)).normals, &normals) < 0.1);
}

/// Corners without triangles keep their rest normals.
#[test]
fn zero_area_triangles_do_not_change_normals() {
    let mesh = sheet(5, 5);
    let mut triangles = mesh.triangles().to_vec();
    let (clean, corners) = (triangles.clone(), mesh.corners().clone());
    // The added triangles are collinear in x or repeat vertices. No remaining triangle contains corner 24.
    triangles.extend([[0, 1, 3], [6, 6, 7], [8, 8, 8]]);
    triangles.retain(|triangle| !triangle.contains(&24));
    let of = |triangles: Vec<[u32; 3]>| {
        let corners = corners.clone();
        let mesh =
            modalcast_model::domain::Mesh::from_indexed(mesh.rest().to_vec(), corners.normals, corners.uvs, triangles);
        scene(vec![with_mode(mesh.expect("expected a valid mesh"), |[x, y, _]| [0.0, 0.0, x + 0.5 * y])])
    };
    let (dirty, clean) = (of(triangles), of(clean));
    let state = bent(&dirty, 0.8);
    let (got, want) = (exact(&dirty, &state), exact(&clean, &state));
    for corner in 0..24 {
        assert!(degrees(got.0[corner], want.0[corner]) < 1e-5, "corner {corner}");
    }
    assert_eq!(got.0[24], [0.0, 0.0, 1.0]);
    assert!(degrees(want.0[24], got.0[24]) > 30.0);
    assert!(largest_angle(&on_cpu(&dirty, &state).normals, &got.0) < TOLERANCE);
}

#[test]
fn normals_do_not_depend_on_the_scale_of_a_domain() {
    let scene = scene(vec![with_mode(sheet(17, 9), parabola)]);
    for linear in linear_parts() {
        let (want, along) = exact(&scene, &state(&scene, 0.5, linear, [0.0; 3]));
        for scale in [1e-40, 1e-30, 1e-20, 1e18, 1e30, 1e37] {
            let state = state(&scene, 0.5, linear * scale, [0.0; 3]);
            let cpu = on_cpu(&scene, &state);
            // Positions of 1e-40 are denormal, with about five significant digits.
            let tolerance = if scale < 1e-38 { 0.1 } else { TOLERANCE };
            let error = largest_angle(&cpu.normals, &want);
            assert!(error < tolerance, "scale {scale}: off by {error} degrees");
            let (twin, tangents) = exact(&scene, &state);
            assert!(largest_angle(&cpu.normals, &twin) < tolerance, "scale {scale}");
            for (tangent, along) in tangents.iter().zip(&along) {
                assert!(degrees([0, 1, 2].map(|at| tangent[at]), [0, 1, 2].map(|at| along[at])) < tolerance);
            }
        }
    }
}

/// Domains so small that the rounding of far positions hides their shape fall back to rigid normals.
#[test]
fn normals_far_from_the_origin_stay_within_their_bound() {
    let scene = scene(vec![with_mode(tube(24, 6, 0.0), |[x, y, _]| [0.2 * y * y, 0.1 * x, 0.3 * x * y])]);
    let far = [1e7, -1e7, 1e7];
    for (size, follows) in [(1e6, true), (1e5, true), (1.0, false), (1e-3, false)] {
        for linear in linear_parts() {
            let state = state(&scene, 0.3, linear * size, far);
            let positions = reference::deform(&scene, &state);
            let (normals, _) = exact(&scene, &state);
            let rigid = reference::rigid_normals(&scene, &state);
            let cpu = on_cpu(&scene, &state).normals;
            assert_eq!(normals != rigid, follows, "size {size}");
            if follows {
                let part = part_of_bound(&scene, &positions, &cpu, &normals);
                assert!(part <= 1.0, "size {size}: {part} of the bound");
                assert!(part > 1e-3, "size {size}: the bound says nothing, {part} of it");
            } else {
                assert!(largest_angle(&cpu, &rigid) < TOLERANCE, "size {size}");
            }
        }
    }
}

#[test]
fn overflow_and_half_turns_give_unit_normals() {
    let scene = scene(vec![with_mode(tube(16, 4, 0.0), |[x, y, z]| [-2.0 * x, y, -2.0 * z])]);
    for q in [1.0, 1e30, 3e38, -3e38] {
        for scale in [1.0, 1e-30, 1e10] {
            let cpu = on_cpu(&scene, &state(&scene, q, Matrix3::identity() * scale, [0.0; 3]));
            for (normal, tangent) in cpu.normals.chunks_exact(3).zip(cpu.tangents.chunks_exact(4)) {
                let length = |list: &[f32]| list.iter().map(|number| number * number).sum::<f32>().sqrt();
                assert!((length(normal) - 1.0).abs() < 1e-6, "q {q}, scale {scale}: {normal:?}");
                assert!((length(&tangent[..3]) - 1.0).abs() < 1e-6, "q {q}, scale {scale}: {tangent:?}");
            }
        }
    }
    // Half a turn about y: the normals turn with the surface, up to twice the angle between them and the normals of the
    // triangles. That angle is at most half of one of the tube's 16 sides.
    let (normals, _) = exact(&scene, &bent(&scene, 1.0));
    for (normal, rest) in normals.iter().zip(&scene.shapes[0].mesh.corners().normals) {
        assert!(degrees(*normal, rest.map(f64::from)) >= 180.0 - 22.5);
    }
}
