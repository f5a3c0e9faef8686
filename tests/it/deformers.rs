//! The CPU deformer equals its f64 reference, and the twin equals the algebra.

use std::sync::Arc;

use modalcast_compute::cpu::CpuDeformer;
use modalcast_compute::reference;
use modalcast_model::deform::Deformer;
use modalcast_model::domain::{Corners, Domain, Material, Mesh, Metadata, Modes, Shape, Texture, Transform};
use modalcast_model::scene::{Scene, SceneParts, SceneState};

use crate::tolerance::{Tolerance, first_wrong, largest_error};

/// Deterministic pseudo-random numbers in -1 to 1.
pub(crate) struct TestRng(pub(crate) u64);

impl TestRng {
    pub(crate) fn next(&mut self) -> f32 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 40) as f32 / (1_u64 << 23) as f32 - 1.0
    }
}

pub(crate) fn strip(vertices: usize, rank: usize, noise: &mut TestRng) -> Shape {
    let rest: Vec<[f32; 3]> = (0..vertices).map(|_| [noise.next(), noise.next(), noise.next()]).collect();
    let normals = rest.iter().map(|_| [noise.next(), noise.next(), noise.next() + 2.0]).collect();
    let uvs = rest.iter().map(|_| [noise.next(), noise.next()]).collect();
    let corners = Corners { vertices: (0..vertices as u32).collect(), normals, uvs };
    let last = vertices as u32 - 1;
    let triangles = (0..vertices as u32).map(|at| [at, (at + 1).min(last), (at + 2).min(last)]).collect();
    let mesh = Mesh::new(rest, corners, triangles).expect("expected a valid mesh");
    let entries = (0..3 * vertices * rank).map(|_| noise.next()).collect();
    let modes = if rank == 0 {
        Modes::rigid()
    } else {
        Modes::from_columns(3 * vertices, rank, entries).expect("expected valid modes")
    };
    Shape::new(mesh, modes).expect("expected a valid shape")
}

pub(crate) fn domain(shape: usize, name: String) -> Domain {
    Domain {
        name,
        shape,
        material: 0,
        placement: Transform::IDENTITY,
        attachment: None,
        follows: None,
        material_ranges: vec![],
        rest_q: vec![],
        shares_q_with: None,
        metadata: Metadata::default(),
    }
}

/// A scene of strips with a normal map; each strip has n vertices and rank r, given as (n, r).
fn strips(sizes: &[(usize, usize)]) -> Arc<Scene> {
    let mut noise = TestRng(42);
    let mut parts = SceneParts::named("strips");
    parts.textures = vec![Texture::new("flat", 1, 1, vec![128, 128, 255, 255]).expect("expected a valid texture")];
    parts.materials = vec![Material { normal_texture: Some(0), ..Material::default() }];
    for (at, (vertices, rank)) in sizes.iter().enumerate() {
        parts.shapes.push(strip(*vertices, *rank, &mut noise));
        parts.domains.push(domain(at, format!("strip {at}")));
    }
    Scene::new(parts).expect("expected a valid scene")
}

/// A state with random coordinates q and sheared or mirrored transforms.
pub(crate) fn shaken(scene: &Scene) -> SceneState {
    let mut noise = TestRng(7);
    let mut state = SceneState::rest(scene);
    state.q.iter_mut().for_each(|number| *number = noise.next());
    for transform in &mut state.transforms {
        transform.0.iter_mut().for_each(|number| *number += 0.7 * noise.next());
    }
    state
}

const SIZES: [(usize, usize); 10] =
    [(1, 1), (3, 0), (31, 3), (32, 4), (33, 5), (257, 20), (256, 31), (1000, 33), (7, 512), (5000, 7)];

#[test]
fn cpu_equals_twin_for_all_sizes_ranks_shears_and_mirrors() {
    let scene = strips(&SIZES);
    let state = shaken(&scene);
    let mut cpu = CpuDeformer::new(&scene);
    let told = cpu.deform(&state).expect("expected the step to succeed");
    let want = reference::deform(&scene, &state);
    let surface = cpu.surface().expect("expected a surface");
    let diagonal = told.bounds.diagonal();
    let error = largest_error(&surface.positions, &want) / diagonal;
    assert!(error <= 1e-6, "positions are off by {error} of the diagonal");
    let loose = Tolerance { abs: 2e-5, rel: 0.0 };
    let normals = reference::rigid_normals(&scene, &state).into_flattened();
    assert_eq!(first_wrong(&surface.normals, &normals, loose), None);
    let tangents = reference::rigid_tangents(&scene, &state).into_flattened();
    assert_eq!(first_wrong(&surface.tangents, &tangents, loose), None);
    for point in &want {
        let slack = 1e-6 * diagonal;
        let sides = point.iter().zip(told.bounds.min.iter().zip(&told.bounds.max));
        sides.for_each(|(at, (min, max))| assert!(*at >= min - slack && *at <= max + slack));
    }
}

/// Negative control: a wrong coordinate, swapped transforms and a missing mode each exceed the tolerance.
#[test]
fn wrong_q_transform_or_missing_mode_is_detected() {
    let scene = strips(&SIZES);
    let state = shaken(&scene);
    let want = reference::deform(&scene, &state);
    let mut cpu = CpuDeformer::new(&scene);
    let mut spoil = |change: &dyn Fn(&mut SceneState)| {
        let mut wrong = state.clone();
        change(&mut wrong);
        cpu.deform(&wrong).expect("expected the step to succeed");
        largest_error(&cpu.surface().expect("expected a surface").positions, &want)
    };
    assert!(spoil(&|state| state.q[30] += 0.01) > 1e-3);
    assert!(spoil(&|state| *state.q.last_mut().expect("some") = 0.0) > 1e-3);
    assert!(spoil(&|state| state.transforms.swap(4, 5)) > 1e-3);
}

/// q = 0 gives the rest positions, q = 1 adds one column of U, and other values scale that column.
#[test]
fn twin_is_linear_in_q() {
    let scene = strips(&[(50, 6)]);
    let modes = &scene.shape_of(0).modes;
    let rest = scene.shape_of(0).mesh.rest();
    let mut state = SceneState::rest(&scene);
    let still = reference::deform(&scene, &state);
    state.q[4] = 1.0;
    let one = reference::deform(&scene, &state);
    state.q[4] = -2.5;
    let more = reference::deform(&scene, &state);
    for vertex in 0..50 {
        for axis in 0..3 {
            assert_eq!(still[vertex][axis], f64::from(rest[vertex][axis]));
            let column = f64::from(modes.at(vertex, axis, 4));
            assert!((one[vertex][axis] - still[vertex][axis] - column).abs() < 1e-12);
            assert!((more[vertex][axis] - still[vertex][axis] + 2.5 * column).abs() < 1e-12);
        }
    }
}

/// The normal of a sheared plane stays orthogonal to it. The control shows that the untransformed normal does not.
#[test]
fn normals_stay_orthogonal_to_a_sheared_plane() {
    let mut parts = SceneParts::named("plane");
    let rest = vec![[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]];
    let mesh =
        Mesh::from_indexed(rest, vec![[0.0, 0.0, 1.0]; 3], vec![], vec![[0, 1, 2]]).expect("expected a valid mesh");
    parts.shapes = vec![Shape::new(mesh, Modes::rigid()).expect("expected a valid shape")];
    parts.materials = vec![Material::default()];
    parts.domains = vec![domain(0, "plane".into())];
    let scene = Scene::new(parts).expect("expected a valid scene");
    let mut state = SceneState::rest(&scene);
    // z += x tilts the plane about y. Transforming the normal by A itself would leave it upright.
    state.transforms[0].0[8] = 1.0;
    let mut cpu = CpuDeformer::new(&scene);
    cpu.deform(&state).expect("expected the step to succeed");
    let surface = cpu.surface().expect("expected a surface");
    let edge = [surface.positions[3], surface.positions[4], surface.positions[5]];
    let dot = |normal: &[f32]| -> f32 { normal.iter().zip(edge).map(|(a, b)| a * b).sum() };
    assert!(dot(&surface.normals[..3]).abs() < 1e-6);
    assert!(dot(&[0.0, 0.0, 1.0]).abs() > 0.5, "the control is not orthogonal");
}

#[test]
fn only_overflow_makes_bounds_non_finite() {
    let scene = strips(&[(40, 3), (9, 0)]);
    let mut cpu = CpuDeformer::new(&scene);
    let mut bounds = |amount: f32| {
        let mut state = SceneState::rest(&scene);
        state.q.fill(amount);
        cpu.deform(&state).expect("expected the step to succeed").bounds
    };
    assert!(bounds(1e30).is_finite());
    assert!(!bounds(3e38).is_finite());
    assert!(bounds(1e-42).is_finite(), "denormals");
    assert!(bounds(0.0).is_finite());
}

/// Repeated steps give the same bits. Vertices whose rows of U are zero stay bit-equal to their positions at q = 0.
#[test]
fn runs_are_bit_identical_and_zero_rows_do_not_move() {
    let mut parts = SceneParts::named("clamped");
    let mut shape = strip(300, 8, &mut TestRng(3));
    let mut columns = shape.modes.columns().to_vec();
    for mode in 0..8 {
        columns[900 * mode..][..30].fill(0.0);
    }
    shape.modes = Modes::from_columns(900, 8, columns).expect("expected valid modes");
    parts.shapes = vec![shape];
    parts.materials = vec![Material::default()];
    parts.domains = vec![domain(0, "clamped".into())];
    let scene = Scene::new(parts).expect("expected a valid scene");
    let mut cpu = CpuDeformer::new(&scene);
    let mut run = |state: &SceneState| {
        cpu.deform(state).expect("expected the step to succeed");
        cpu.surface().expect("expected a surface").positions.clone()
    };
    let still = run(&SceneState::rest(&scene));
    let mut state = shaken(&scene);
    state.transforms = SceneState::rest(&scene).transforms;
    let moved = run(&state);
    assert_eq!(moved, run(&state));
    assert_eq!(moved[..30], still[..30]);
    assert_ne!(moved[30..33], still[30..33]);
}
