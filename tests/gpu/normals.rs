//! Exact normals follow the deformed surface, whereas rigid normals are rest normals rotated by T. Exact normals and
//! tangents of the CUDA deformer equal those of the f64 reference for the same positions.

use std::sync::Arc;

use modalcast_compute::gpu::{BufferRole, CudaDeformer};
use modalcast_compute::reference::{exact_normals, exact_tangents, rigid_normals, rigid_tangents};
use modalcast_model::deform::Deformer;
use modalcast_model::domain::{Corners, CreaseAngle, Mesh, Modes, Shape, Transform, split_at_creases};
use modalcast_model::scene::{NormalMethod, Scene, SceneState};
use nalgebra::Vector3;

use crate::accuracy::{MAX_DIRECTION_ERROR, have_equal_bits, max_error};
use crate::reference_comparison::cuda_deformer;
use crate::scenes::{self, NORMAL_MAPPED_MATERIAL, Random, RandomSceneOptions, new_domain};

/// A tube of `columns` x `rows` vertices with a texture seam, a hard edge along every fifth row, and `rank` smooth
/// modes.
fn tube(random: &mut Random, columns: u32, rows: u32, rank: usize) -> Shape {
    let column_angle = |column: u32| column as f32 / columns as f32 * std::f32::consts::TAU;
    let position = |row: u32, column: u32| {
        let radius = 1.0 + 0.2 * (row as f32).sin();
        [
            radius * column_angle(column).cos(),
            6.0 * row as f32 / rows as f32 - 3.0,
            -radius * column_angle(column).sin(),
        ]
    };
    let rest: Vec<_> = (0..rows).flat_map(|row| (0..columns).map(move |column| position(row, column))).collect();
    let mut corners = Corners::default();
    // A row of vertices has two rows of corners: one for the triangles below it, then one for the triangles above it.
    // Where their normals differ, the row is a hard edge. A row of corners has one more column, for the seam.
    // `is_below`: whether the corner row is for the triangles below the row of vertices.
    for (row, is_below) in (0..rows).flat_map(|row| [(row, true), (row, false)]) {
        let normal_y = if row % 5 == 0 && !is_below { 0.4 } else { 0.0 };
        for column in 0..=columns {
            let angle = column_angle(column % columns);
            corners.vertices.push(row * columns + column % columns);
            corners.normals.push([angle.cos(), normal_y, -angle.sin()]);
            corners.uvs.push([column as f32 / columns as f32, row as f32 / rows as f32]);
        }
    }
    let triangle = |row: u32, column: u32| {
        let (lower_corner, upper_corner) =
            ((2 * row + 1) * (columns + 1) + column, (2 * row + 2) * (columns + 1) + column);
        [[lower_corner, lower_corner + 1, upper_corner + 1], [lower_corner, upper_corner + 1, upper_corner]]
    };
    let triangles = (0..rows - 1).flat_map(|row| (0..columns).flat_map(move |column| triangle(row, column))).collect();
    let modes = wave_modes(random, &rest, rank);
    Shape::new(Mesh::new(rest, corners, triangles).expect("expected a valid mesh"), modes)
        .expect("expected a valid shape")
}

/// `rank` smooth modes: plane waves of random directions and amplitudes.
fn wave_modes(random: &mut Random, rest: &[[f32; 3]], rank: usize) -> Modes {
    let mut entries = Vec::with_capacity(3 * rest.len() * rank);
    for _ in 0..rank {
        let (wave_vector, amplitudes) = (random.next_triple(), random.next_triple());
        let phase = |position: &[f32; 3]| (0..3).map(|axis| 2.0 * wave_vector[axis] * position[axis]).sum::<f32>();
        let scale = 0.3 / (rank as f32).sqrt();
        entries.extend(
            rest.iter().flat_map(|position| amplitudes.map(|amplitude| scale * amplitude * phase(position).sin())),
        );
    }
    Modes::from_columns(3 * rest.len(), rank, entries).expect("expected valid modes")
}

/// A scene with exact normals. `normal_maps` of the options applies to all shapes.
fn scene_with_exact_normals(shapes: Vec<Shape>, options: RandomSceneOptions) -> Arc<Scene> {
    let RandomSceneOptions { instances, normal_maps, rigid_transforms } = options;
    let count = shapes.len();
    let mut parts = scenes::parts_of_shapes(shapes);
    parts.deformation.normals = NormalMethod::Exact;
    parts.rigid_transforms = rigid_transforms;
    let material = if normal_maps { NORMAL_MAPPED_MATERIAL } else { scenes::PLAIN_MATERIAL };
    parts.domains = (0..instances * count).map(|index| new_domain(index % count, material)).collect();
    Scene::new(parts).expect("expected a valid scene")
}

/// Normals and tangents of the device, and those of the reference for the device's positions.
struct NormalComparison {
    normals: Vec<f32>,
    tangents: Vec<f32>,
    want_normals: Vec<[f64; 3]>,
    want_tangents: Vec<[f64; 4]>,
}

fn compare_normals(scene: &Scene, state: &SceneState, deformer: &mut CudaDeformer) -> NormalComparison {
    deformer.deform(state).expect("expected the step to succeed");
    let surface = deformer.surface().expect("expected a surface");
    let positions: Vec<[f64; 3]> =
        surface.positions.chunks_exact(3).map(|position| [0, 1, 2].map(|axis| f64::from(position[axis]))).collect();
    NormalComparison {
        normals: surface.normals.clone(),
        tangents: surface.tangents.clone(),
        want_normals: exact_normals(scene, state, &positions),
        want_tangents: exact_tangents(scene, state, &positions),
    }
}

/// Largest angle between unit vectors of the device and of the reference, in degrees.
fn max_angle_degrees(got: &[f32], want: &[[f64; 3]]) -> f64 {
    let angle = |(got, want): (&[f32], &[f64; 3])| {
        let (got, want) = (Vector3::new(got[0], got[1], got[2]).cast::<f64>(), Vector3::from(*want));
        let angle = got.cross(&want).norm().atan2(got.dot(&want)).to_degrees();
        if angle.is_nan() { f64::INFINITY } else { angle }
    };
    got.chunks_exact(3).zip(want).map(angle).fold(0.0, f64::max)
}

/// Asserts that exact normals and tangents equal the reference. As a negative control, rigid normals differ.
fn assert_equals_reference(name: &str, scene: &Scene, state: &SceneState, deformer: &mut CudaDeformer) {
    let comparison = compare_normals(scene, state, deformer);
    let normal_error = max_error(&comparison.normals, &comparison.want_normals, MAX_DIRECTION_ERROR);
    let normal_error = normal_error.unwrap_or_else(|error| panic!("{name}: normal {error}"));
    let tangent_error = max_error(&comparison.tangents, &comparison.want_tangents, MAX_DIRECTION_ERROR);
    let tangent_error = tangent_error.unwrap_or_else(|error| panic!("{name}: tangent {error}"));
    let rigid_angle = max_angle_degrees(&comparison.normals, &rigid_normals(scene, state));
    assert!(rigid_angle > 5.0, "{name}: expected rigid normals to differ by more than 5 degrees, got {rigid_angle}");
    let angle = max_angle_degrees(&comparison.normals, &comparison.want_normals);
    eprintln!(
        "{name}: error of normals {normal_error:.2e} ({angle:.1e} degrees), of tangents {tangent_error:.2e}; rigid {rigid_angle:.1} degrees"
    );
}

/// Checks the test scenes on the CPU: deformation rotates normals by at least 5 degrees, and by less than 150 degrees.
/// Near 180 degrees, f32 cannot determine the axis of a rotation.
#[test]
fn test_scenes_bend_but_do_not_fold() {
    // The tubes of the tests below, the last one with a tenth of the columns and rows.
    for (seed, columns, rows, rank) in [(1, 16, 9, 3), (4, 24, 12, 3), (5, 16, 6, 2), (6, 70, 72, 8)] {
        let scene = scene_with_exact_normals(
            vec![tube(&mut Random(seed), columns, rows, rank)],
            RandomSceneOptions { instances: 3, normal_maps: true, rigid_transforms: false },
        );
        for seed in 5..11 {
            let state = scenes::random_state(&scene, seed);
            let mut cpu = modalcast_compute::cpu::CpuDeformer::new(&scene);
            cpu.deform(&state).expect("expected the step to succeed");
            let surface = cpu.surface().expect("expected a surface");
            let positions = modalcast_compute::reference::deform(&scene, &state);
            let want = exact_normals(&scene, &state, &positions);
            let rigid_angle = max_angle_degrees(&surface.normals, &rigid_normals(&scene, &state));
            assert!((5.0..150.0).contains(&rigid_angle), "expected 5 to 150 degrees, got {rigid_angle}");
            // The CPU deformer computes in f32.
            let angle = max_angle_degrees(&surface.normals, &want);
            assert!(angle < 0.01, "expected an error below 0.01 degrees, got {angle}");
        }
    }
}

/// Checks scenes with and without normal maps, and with and without shear.
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_exact_normals_equal_the_reference() {
    let mut random = Random(1);
    let shapes = [(16, 9, 3), (5, 2, 1), (40, 31, 12)];
    let shapes: Vec<_> = shapes.map(|(columns, rows, rank)| tube(&mut random, columns, rows, rank)).into();
    for (normal_maps, rigid_transforms) in [(false, false), (false, true), (true, false), (true, true)] {
        let options = RandomSceneOptions { instances: 4, normal_maps, rigid_transforms };
        let scene = scene_with_exact_normals(shapes.clone(), options);
        let mut deformer = cuda_deformer(&scene);
        assert!(deformer.plan().kernels.iter().any(|kernel| kernel.name == "normals"));
        // A ring lists the triangles around a corner. Only exact normals need rings.
        assert!(deformer.plan().bytes(BufferRole::RingTables) > 0);
        let name = format!("normal maps {normal_maps}, rigid transforms {rigid_transforms}");
        assert_equals_reference(&name, &scene, &scenes::random_state(&scene, 5), &mut deformer);
        assert_eq!(deformer.surface().expect("expected a surface").tangents.is_empty(), !normal_maps);
    }
}

/// A prism of `sides` sides without normals, whose corners are split at creases, with `rank` smooth modes. The vertices
/// are not split: the prism has two rows of `sides` vertices.
fn creased_prism(random: &mut Random, sides: u32, rank: usize) -> Shape {
    let angle = |side: u32| side as f32 / sides as f32 * std::f32::consts::TAU;
    let rest: Vec<[f32; 3]> =
        (0..2 * sides).map(|index| [angle(index / 2).cos(), (index % 2) as f32, -angle(index / 2).sin()]).collect();
    let side_triangles = |side: u32| {
        let (a, b) = (2 * side, 2 * ((side + 1) % sides));
        [[a, b, b + 1], [a, b + 1, a + 1]]
    };
    let triangles: Vec<[u32; 3]> = (0..sides).flat_map(side_triangles).collect();
    let vertices: Vec<u32> = (0..2 * sides).collect();
    let creased = split_at_creases(&rest, &vertices, &triangles, &[], CreaseAngle::default());
    let corners = Corners { vertices: creased.source_corners, normals: creased.normals, uvs: vec![] };
    let modes = wave_modes(random, &rest, rank);
    Shape::new(Mesh::new(rest, corners, creased.triangles).expect("expected a valid mesh"), modes)
        .expect("expected a valid shape")
}

/// The first prism has a hard edge between all sides, the second one has none.
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_exact_normals_of_creases_equal_the_reference() {
    let mut random = Random(7);
    let shapes = vec![creased_prism(&mut random, 6, 3), creased_prism(&mut random, 300, 4)];
    let corners = shapes.iter().map(|shape| shape.mesh.corners().vertices.len()).collect::<Vec<_>>();
    assert_eq!(corners, [24, 600], "expected two corners per vertex of the first prism");
    let options = RandomSceneOptions { instances: 2, normal_maps: false, rigid_transforms: false };
    let scene = scene_with_exact_normals(shapes, options);
    let mut deformer = cuda_deformer(&scene);
    assert_equals_reference("prisms", &scene, &scenes::random_state(&scene, 11), &mut deformer);
}

/// Prisms that T flattens along their axis, exactly or up to rounding, so that the cofactors of T lose the normals of the
/// sides. Modes tilt the sides.
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_exact_normals_of_flattened_prisms_equal_the_reference() {
    let mut random = Random(12);
    let shapes = vec![creased_prism(&mut random, 6, 3), creased_prism(&mut random, 300, 4)];
    let options = RandomSceneOptions { instances: 2, normal_maps: false, rigid_transforms: false };
    let scene = scene_with_exact_normals(shapes, options);
    let mut state = scenes::random_state(&scene, 13);
    for (transform, thickness) in state.transforms.iter_mut().zip([0.0, 0.0, 1e-9, -1e-9]) {
        [1, 5, 9].into_iter().for_each(|entry| transform.0[entry] *= thickness);
    }
    assert_equals_reference("flattened prisms", &scene, &state, &mut cuda_deformer(&scene));
}

/// Checks a shape with modes at q = 0, and a shape without modes.
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_exact_normals_equal_rigid_ones_without_deformation() {
    let mut random = Random(2);
    let (modal_shape, rigid_shape) = (tube(&mut random, 20, 11, 2), tube(&mut random, 9, 7, 0));
    let scene = scene_with_exact_normals(
        vec![modal_shape, rigid_shape],
        RandomSceneOptions { instances: 3, normal_maps: true, rigid_transforms: false },
    );
    let mut deformer = cuda_deformer(&scene);
    let mut state = scenes::random_state(&scene, 6);
    state.q.fill(0.0);
    let comparison = compare_normals(&scene, &state, &mut deformer);
    let assert_equal = |domain: usize, got: &[f32], want: &[f64], components: usize, limit: f64| {
        let layout = scene.layout.domains[domain];
        let (first, count) = (components * layout.first_corner, components * layout.corners);
        let want: Vec<[f64; 1]> = want[first..][..count].iter().map(|number| [*number]).collect();
        max_error(&got[first..][..count], &want, limit).unwrap_or_else(|error| panic!("domain {domain}: {error}"));
    };
    let (normals, tangents) = (rigid_normals(&scene, &state).into_flattened(), rigid_tangents(&scene, &state));
    let tangents = tangents.into_flattened();
    for domain in 0..scene.domains.len() {
        // Domains 0, 2 and 4 have modes. There, rounding the positions rotates a normal by about the rounding error
        // divided by the size of a triangle.
        let limit = if domain % 2 == 0 { 1e-3 } else { MAX_DIRECTION_ERROR };
        assert_equal(domain, &comparison.normals, &normals, 3, limit);
        assert_equal(domain, &comparison.tangents, &tangents, 4, limit);
    }
    state.q.fill(1.0);
    deformer.deform(&state).expect("expected the step to succeed");
    let deformed = &deformer.surface().expect("expected a surface").normals;
    assert!(max_angle_degrees(deformed, &rigid_normals(&scene, &state)) > 5.0, "negative control");
}

/// The bits of an instance depend neither on earlier steps nor on the instance's place in the packed arrays.
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_exact_normals_are_unit_and_deterministic() {
    let mut random = Random(3);
    let scene = scene_with_exact_normals(
        vec![scenes::random_shape(&mut random, 700, 9), tube(&mut random, 33, 8, 5)],
        RandomSceneOptions { instances: 3, normal_maps: true, rigid_transforms: false },
    );
    let (mut state, other_state) = (scenes::random_state(&scene, 7), scenes::random_state(&scene, 8));
    // Domains 1, 3 and 5 are the instances of the tube, of rank 5. They get the same q and transform.
    let q = state.q_of(&scene, 1).to_vec();
    for domain in [3, 5] {
        state.transforms[domain] = state.transforms[1];
        state.q[scene.layout.domains[domain].first_q..][..5].copy_from_slice(&q);
    }
    let mut deformer = cuda_deformer(&scene);
    let mut deform = |state: &SceneState| {
        deformer.deform(state).expect("expected the step to succeed");
        deformer.surface().expect("expected a surface").clone()
    };
    let (first, other_surface, repeated) = (deform(&state), deform(&other_state), deform(&state));
    assert!(!have_equal_bits(&first.normals, &other_surface.normals), "expected states with different normals");
    assert!(have_equal_bits(&first.normals, &repeated.normals) && have_equal_bits(&first.tangents, &repeated.tangents));
    for surface in [&first, &other_surface] {
        for normal in
            surface.normals.chunks_exact(3).chain(surface.tangents.chunks_exact(4).map(|tangent| &tangent[..3]))
        {
            let length = normal.iter().map(|number| number * number).sum::<f32>().sqrt();
            assert!((length - 1.0).abs() < 1e-5, "{normal:?}");
        }
    }
    let normals_of = |domain: usize| {
        let layout = scene.layout.domains[domain];
        &first.normals[3 * layout.first_corner..][..3 * layout.corners]
    };
    assert!(
        have_equal_bits(normals_of(1), normals_of(3)) && have_equal_bits(normals_of(1), normals_of(5)),
        "expected equal normals of all instances"
    );
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_seams_share_a_normal_and_hard_edges_stay_hard() {
    let mut random = Random(4);
    let scene = scene_with_exact_normals(
        vec![tube(&mut random, 24, 12, 3)],
        RandomSceneOptions { instances: 1, normal_maps: false, rigid_transforms: false },
    );
    let mut deformer = cuda_deformer(&scene);
    deformer.deform(&scenes::random_state(&scene, 9)).expect("expected the step to succeed");
    let normals = &deformer.surface().expect("expected a surface").normals;
    // A row of corners has 25 columns. Corner rows 2 r and 2 r + 1 belong to row r of the tube.
    let normal_at = |corner_row: usize, column: usize| &normals[3 * (25 * corner_row + column)..][..3];
    // The seam is between columns 0 and 24. Corner rows 0 and 23 have no triangles.
    for corner_row in 1..23 {
        assert!(have_equal_bits(normal_at(corner_row, 0), normal_at(corner_row, 24)), "corner row {corner_row}");
    }
    // Between the normals of this corner row and of the next one, at column 5.
    let squared_distance = |corner_row: usize| {
        (0..3).map(|axis| (normal_at(corner_row, 5)[axis] - normal_at(corner_row + 1, 5)[axis]).powi(2)).sum::<f32>()
    };
    assert!(squared_distance(10) > 1e-3, "expected a hard edge along row 5");
    assert!(have_equal_bits(normal_at(12, 5), normal_at(13, 5)), "expected smooth normals along row 6");
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_exact_normals_stay_unit_at_collapse_overflow_and_scale() {
    let mut random = Random(5);
    let scene = scene_with_exact_normals(
        vec![tube(&mut random, 16, 6, 2)],
        RandomSceneOptions { instances: 1, normal_maps: true, rigid_transforms: false },
    );
    let mut deformer = cuda_deformer(&scene);
    for scale in [1e-40, 1e-30, 1e-20, 1.0, 1e18, 1e30, 1e37_f32] {
        for offset in [0.0, 1e7] {
            for q in [0.0, 0.7, 1e30, -3e38] {
                let mut state = SceneState::rest(&scene);
                state.q.fill(q);
                state.transforms[0] = Transform([
                    scale,
                    0.0,
                    0.0,
                    offset,
                    0.0,
                    -scale,
                    0.5 * scale,
                    -offset,
                    0.2 * scale,
                    0.0,
                    scale,
                    offset,
                ]);
                let comparison = compare_normals(&scene, &state, &mut deformer);
                let name = format!("scale {scale:e}, offset {offset:e}, q {q:e}");
                let assert_unit = |vector: &[f32]| {
                    let length = vector.iter().map(|number| number * number).sum::<f32>().sqrt();
                    assert!((length - 1.0).abs() < 1e-5, "{name}: {vector:?}");
                };
                comparison.normals.chunks_exact(3).for_each(assert_unit);
                comparison.tangents.chunks_exact(4).for_each(|tangent| assert_unit(&tangent[..3]));
                if q.abs() < 1.0 {
                    max_error(&comparison.normals, &comparison.want_normals, MAX_DIRECTION_ERROR)
                        .unwrap_or_else(|error| panic!("{name}: {error}"));
                }
            }
        }
    }
}

/// Also prints the times of steps with rigid and with exact normals.
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_exact_normals_of_a_million_corners_equal_the_reference() {
    let mut random = Random(6);
    let shape = tube(&mut random, 700, 720, 8);
    let mut times = [NormalMethod::Rigid, NormalMethod::Exact].map(|normals| {
        let mut parts = scenes::parts_of_shapes(vec![shape.clone()]);
        parts.deformation.normals = normals;
        parts.domains = vec![new_domain(0, scenes::PLAIN_MATERIAL)];
        let scene = Scene::new(parts).expect("expected a valid scene");
        let state = scenes::random_state(&scene, 10);
        let mut deformer = cuda_deformer(&scene);
        if normals == NormalMethod::Exact {
            assert_equals_reference("a million corners", &scene, &state, &mut deformer);
        }
        let mut times: Vec<f64> =
            (0..50).map(|_| deformer.deform(&state).expect("expected the step to succeed").ms).collect();
        times.sort_by(f64::total_cmp);
        // The median of 50 times.
        times[25]
    });
    // Milliseconds to microseconds.
    times.iter_mut().for_each(|time| *time *= 1e3);
    let corners = shape.mesh.corners().vertices.len();
    let [rigid, exact] = times;
    eprintln!("{corners} corners, microseconds per step: {rigid:.0} with rigid normals, {exact:.0} with exact normals");
}
