//! The CPU deformer equals the f64 reference deformer up to f32 rounding, and the reference deformer equals closed-form
//! results.

use std::sync::Arc;

use modalcast_compute::cpu::CpuDeformer;
use modalcast_compute::reference;
use modalcast_model::deform::Deformer;
use modalcast_model::domain::{Corners, Domain, Material, Mesh, Modes, Shape, Texture};
use modalcast_model::scene::{Scene, SceneParts, SceneState};

use crate::tolerance::{Tolerance, find_difference, max_distance};

/// Generator of deterministic pseudo-random numbers in [-1, 1).
pub(crate) struct TestRng(pub(crate) u64);

impl TestRng {
    pub(crate) fn next(&mut self) -> f32 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 40) as f32 / (1_u64 << 23) as f32 - 1.0
    }
}

/// A strip of triangles between random vertices, with random modes. Corner i of the mesh is at vertex i.
pub(crate) fn random_strip(vertices: usize, rank: usize, random: &mut TestRng) -> Shape {
    let rest_positions: Vec<[f32; 3]> = (0..vertices).map(|_| [random.next(), random.next(), random.next()]).collect();
    let normals = rest_positions.iter().map(|_| [random.next(), random.next(), random.next() + 2.0]).collect();
    let uvs = rest_positions.iter().map(|_| [random.next(), random.next()]).collect();
    let corners = Corners { vertices: (0..vertices as u32).collect(), normals, uvs };
    // The last two triangles repeat the last vertex, so that a strip of one vertex also has a triangle.
    let last_vertex = vertices as u32 - 1;
    let triangles = (0..vertices as u32)
        .map(|vertex| [vertex, (vertex + 1).min(last_vertex), (vertex + 2).min(last_vertex)])
        .collect();
    let mesh = Mesh::new(rest_positions, corners, triangles).expect("expected a valid mesh");
    let entries = (0..3 * vertices * rank).map(|_| random.next()).collect();
    let modes = if rank == 0 {
        Modes::rigid()
    } else {
        Modes::from_columns(3 * vertices, rank, entries).expect("expected valid modes")
    };
    Shape::new(mesh, modes).expect("expected a valid shape")
}

/// A scene of strips with a normal map. `sizes` has the number of vertices and the rank of each strip.
fn strips_scene(sizes: &[(usize, usize)]) -> Arc<Scene> {
    let mut random = TestRng(42);
    let mut parts = SceneParts::named("strips");
    parts.textures = vec![Texture::new("flat", 1, 1, vec![128, 128, 255, 255]).expect("expected a valid texture")];
    parts.materials = vec![Material { normal_texture: Some(0), ..Material::default() }];
    for (index, (vertices, rank)) in sizes.iter().enumerate() {
        parts.shapes.push(random_strip(*vertices, *rank, &mut random));
        parts.domains.push(Domain::new(format!("strip {index}"), index));
    }
    Scene::new(parts).expect("expected a valid scene")
}

/// A state with random coordinates q and sheared or mirrored transforms.
pub(crate) fn random_state(scene: &Scene) -> SceneState {
    let mut random = TestRng(7);
    let mut state = SceneState::rest(scene);
    state.q.iter_mut().for_each(|number| *number = random.next());
    for transform in &mut state.transforms {
        transform.0.iter_mut().for_each(|number| *number += 0.7 * random.next());
    }
    state
}

/// Number of vertices and rank of each shape.
const SIZES: [(usize, usize); 10] =
    [(1, 1), (3, 0), (31, 3), (32, 4), (33, 5), (257, 20), (256, 31), (1000, 33), (7, 512), (5000, 7)];

#[test]
fn cpu_equals_reference_for_all_sizes_ranks_and_transforms() {
    let scene = strips_scene(&SIZES);
    let state = random_state(&scene);
    let mut cpu = CpuDeformer::new(&scene);
    let summary = cpu.deform(&state).expect("expected the step to succeed");
    let reference_positions = reference::deform(&scene, &state);
    let surface = cpu.surface().expect("expected a surface");
    let diagonal = summary.bounds.diagonal();
    let error = max_distance(&surface.positions, &reference_positions) / diagonal;
    assert!(error <= 1e-6, "expected a position error of at most 1e-6 of the diagonal, got {error}");
    // Random transforms can be ill-conditioned, which amplifies f32 rounding (6e-8).
    let tolerance = Tolerance { abs: 2e-5, rel: 0.0 };
    // Rigid normals and tangents are the rest normals and tangents, changed by the transform but not by U q.
    let normals = reference::rigid_normals(&scene, &state).into_flattened();
    assert_eq!(find_difference(&surface.normals, &normals, tolerance), None);
    let tangents = reference::rigid_tangents(&scene, &state).into_flattened();
    assert_eq!(find_difference(&surface.tangents, &tangents, tolerance), None);
    let margin = 1e-6 * diagonal;
    for point in &reference_positions {
        for (coordinate, (min, max)) in point.iter().zip(summary.bounds.min.iter().zip(&summary.bounds.max)) {
            assert!((min - margin..=max + margin).contains(coordinate), "{coordinate} is outside {min} to {max}");
        }
    }
}

/// Negative control: a wrong coordinate, a coordinate set to zero and swapped transforms each change vertices by more
/// than 1e-3.
#[test]
fn wrong_coordinates_and_transforms_are_detected() {
    let scene = strips_scene(&SIZES);
    let state = random_state(&scene);
    let reference_positions = reference::deform(&scene, &state);
    let mut cpu = CpuDeformer::new(&scene);
    let mut error_after = |modify: &dyn Fn(&mut SceneState)| {
        let mut wrong_state = state.clone();
        modify(&mut wrong_state);
        cpu.deform(&wrong_state).expect("expected the step to succeed");
        max_distance(&cpu.surface().expect("expected a surface").positions, &reference_positions)
    };
    // Coordinate 30 belongs to the shape with 257 vertices.
    assert!(error_after(&|state| state.q[30] += 0.01) > 1e-3);
    assert!(error_after(&|state| *state.q.last_mut().expect("expected coordinates") = 0.0) > 1e-3);
    assert!(error_after(&|state| state.transforms.swap(4, 5)) > 1e-3);
}

/// q = 0 gives the rest positions. A single nonzero coordinate of q adds the coordinate times the same column of U.
#[test]
fn reference_is_linear_in_q() {
    let scene = strips_scene(&[(50, 6)]);
    let modes = &scene.shape_of(0).modes;
    let mesh_positions = scene.shape_of(0).mesh.rest_positions();
    let mut state = SceneState::rest(&scene);
    let rest_positions = reference::deform(&scene, &state);
    state.q[4] = 1.0;
    let unit_positions = reference::deform(&scene, &state);
    state.q[4] = -2.5;
    let scaled_positions = reference::deform(&scene, &state);
    for vertex in 0..50 {
        for axis in 0..3 {
            assert_eq!(rest_positions[vertex][axis], f64::from(mesh_positions[vertex][axis]));
            let entry = f64::from(modes.entry(vertex, axis, 4));
            assert!((unit_positions[vertex][axis] - rest_positions[vertex][axis] - entry).abs() < 1e-12);
            assert!((scaled_positions[vertex][axis] - rest_positions[vertex][axis] + 2.5 * entry).abs() < 1e-12);
        }
    }
}

#[test]
fn normals_stay_orthogonal_to_a_sheared_plane() {
    let mut parts = SceneParts::named("plane");
    let rest_positions = vec![[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]];
    let mesh = Mesh::from_indexed(rest_positions, vec![[0.0, 0.0, 1.0]; 3], vec![], vec![[0, 1, 2]])
        .expect("expected a valid mesh");
    parts.shapes = vec![Shape::new(mesh, Modes::rigid()).expect("expected a valid shape")];
    parts.materials = vec![Material::default()];
    parts.domains = vec![Domain::new("plane", 0)];
    let scene = Scene::new(parts).expect("expected a valid scene");
    let mut state = SceneState::rest(&scene);
    // The row-major 3 x 4 transform becomes z' = z + x, which tilts the plane about the y axis. Its linear part A maps
    // the normal (0, 0, 1) to itself, which is not the normal of the tilted plane.
    state.transforms[0].0[8] = 1.0;
    let mut cpu = CpuDeformer::new(&scene);
    cpu.deform(&state).expect("expected the step to succeed");
    let surface = cpu.surface().expect("expected a surface");
    // From vertex 0, which is at the origin, to vertex 1.
    let edge = [surface.positions[3], surface.positions[4], surface.positions[5]];
    let dot = |normal: &[f32]| -> f32 { normal.iter().zip(edge).map(|(a, b)| a * b).sum() };
    assert!(dot(&surface.normals[..3]).abs() < 1e-6);
    assert!(dot(&[0.0, 0.0, 1.0]).abs() > 0.5, "negative control: expected the rest normal not to be orthogonal");
}

#[test]
fn only_overflow_makes_bounds_non_finite() {
    let scene = strips_scene(&[(40, 3), (9, 0)]);
    let mut cpu = CpuDeformer::new(&scene);
    let mut bounds_at = |q: f32| {
        let mut state = SceneState::rest(&scene);
        state.q.fill(q);
        cpu.deform(&state).expect("expected the step to succeed").bounds
    };
    assert!(bounds_at(1e30).is_finite());
    // The largest f32 is 3.4e38, so sums of three modes overflow.
    assert!(!bounds_at(3e38).is_finite());
    assert!(bounds_at(1e-42).is_finite(), "expected finite bounds for denormal q");
    assert!(bounds_at(0.0).is_finite());
}

/// Repeated steps give the same bits. Vertices whose rows of U are zero have the same bits as at q = 0.
#[test]
fn repeated_steps_are_bit_identical_and_zero_rows_stay() {
    let mut parts = SceneParts::named("clamped");
    let (vertices, rank) = (300, 8);
    let mut shape = random_strip(vertices, rank, &mut TestRng(3));
    let mut columns = shape.modes.columns().to_vec();
    // U has three rows per vertex. Its first 30 rows belong to ten vertices.
    for mode in 0..rank {
        columns[3 * vertices * mode..][..30].fill(0.0);
    }
    shape.modes = Modes::from_columns(3 * vertices, rank, columns).expect("expected valid modes");
    parts.shapes = vec![shape];
    parts.materials = vec![Material::default()];
    parts.domains = vec![Domain::new("clamped", 0)];
    let scene = Scene::new(parts).expect("expected a valid scene");
    let mut cpu = CpuDeformer::new(&scene);
    let mut deform = |state: &SceneState| {
        cpu.deform(state).expect("expected the step to succeed");
        cpu.surface().expect("expected a surface").positions.clone()
    };
    let rest_positions = deform(&SceneState::rest(&scene));
    let mut state = random_state(&scene);
    state.transforms = SceneState::rest(&scene).transforms;
    let positions = deform(&state);
    assert_eq!(positions, deform(&state));
    // Vertices 0 to 9 do not move, but vertex 10 does.
    assert_eq!(positions[..30], rest_positions[..30]);
    assert_ne!(positions[30..33], rest_positions[30..33]);
}
