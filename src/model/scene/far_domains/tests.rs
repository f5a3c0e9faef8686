//! Vertices of far domains at rest and after steps, compared with x = T (x0 + U q) in f64.

use std::sync::Arc;

use nalgebra::{Matrix3, Matrix4, Point3, Quaternion, UnitQuaternion, Vector3};

use crate::domain::{Domain, FollowConstraint, Material, Mesh, Modes, RestOrigin, Shape, Transform};
use crate::scene::{BoundingBox, RawStepUpdate, Scene, SceneParts, SceneState, StepUpdate, TransformFormat};

/// Largest accepted error of a vertex, in diagonals of a domain. The promise is 1e-5.
const MAX_ERROR: f64 = 2e-6;

/// A tetrahedron of about 0.4 units at `center`.
fn tetrahedron(center: [f64; 3]) -> Vec<[f64; 3]> {
    let offsets = [[0.0, 0.0, 0.0], [0.41, 0.03, 0.0], [0.07, 0.37, 0.011], [0.1, 0.13, 0.43]];
    offsets.map(|offset| std::array::from_fn(|axis| center[axis] + offset[axis])).to_vec()
}

/// A shape with a mode, from f64 positions.
fn shape_of(positions: &[[f64; 3]]) -> Shape {
    let triangles = vec![[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]];
    let RestOrigin { origin, positions } = RestOrigin::choose(positions, 0..positions.len());
    let mesh = Mesh::from_indexed(positions, vec![[0.0, 0.0, 1.0]; 4], vec![], triangles).expect("a tetrahedron");
    let columns = (0..12).map(|row| 0.01 * (row as f32 - 5.0)).collect();
    Shape::new(mesh, Modes::from_columns(12, 1, columns).expect("a mode")).expect("a shape").with_origin(origin)
}

/// One domain per list of positions.
fn parts_of(domains: &[Vec<[f64; 3]>]) -> SceneParts {
    let mut parts = SceneParts::named("far");
    parts.materials.push(Material::default());
    for (index, positions) in domains.iter().enumerate() {
        parts.shapes.push(shape_of(positions));
        parts.domains.push(Domain::new(format!("body {index}"), index));
    }
    parts
}

fn scene_of(domains: &[Vec<[f64; 3]>]) -> Arc<Scene> {
    Scene::new(parts_of(domains)).expect("a scene")
}

/// World positions of a domain as deformers compute them in f32, plus the f64 origin.
fn computed_positions(scene: &Scene, state: &SceneState, domain: usize) -> Vec<Vector3<f64>> {
    let (shape, Transform(t)) = (scene.shape_of(domain), state.transform_of(scene, domain));
    let origin = Vector3::from(state.origin_of(scene.transform_roots.root_of(domain)));
    let q = state.q_of(scene, domain);
    let position = |(vertex, v): (usize, &[f32; 3])| {
        let p: [f32; 3] = std::array::from_fn(|axis| shape.modes.entry(vertex, axis, 0).mul_add(q[0], v[axis]));
        let x = |row: usize| {
            t[4 * row].mul_add(p[0], t[4 * row + 1].mul_add(p[1], t[4 * row + 2].mul_add(p[2], t[4 * row + 3])))
        };
        origin + Vector3::new(x(0), x(1), x(2)).cast::<f64>()
    };
    shape.mesh.rest_positions().iter().enumerate().map(position).collect()
}

/// T (x0 + U q) in f64.
fn expected_positions(scene: &Scene, domain: usize, x0: &[[f64; 3]], q: f32, t: &Matrix4<f64>) -> Vec<Vector3<f64>> {
    let modes = &scene.shape_of(domain).modes;
    let position = |(vertex, x0): (usize, &[f64; 3])| {
        let u = Vector3::from_fn(|axis, _| f64::from(modes.entry(vertex, axis, 0)) * f64::from(q));
        t.transform_point(&Point3::from(Vector3::from(*x0) + u)).coords
    };
    x0.iter().enumerate().map(position).collect()
}

/// Largest distance of two lists of points, in diagonals of a tetrahedron.
fn relative_error(computed: &[Vector3<f64>], expected: &[Vector3<f64>]) -> f64 {
    let distances = computed.iter().zip(expected).map(|(computed, expected)| (computed - expected).norm());
    distances.fold(0.0, f64::max) / 0.7
}

/// Positions that are rounded to f32 before anything else.
fn rounded(positions: &[[f64; 3]]) -> Vec<[f64; 3]> {
    positions.iter().map(|position| position.map(|number| f64::from(number as f32))).collect()
}

/// A center with one or all coordinates of a magnitude.
fn centers(magnitude: f64) -> [[f64; 3]; 4] {
    let [x, y, z] = [0.123 + magnitude, 0.456 - 0.9 * magnitude, 0.789 + 0.7 * magnitude];
    [[x, 0.3, -0.2], [0.1, y, 0.4], [-0.6, 0.2, z], [x, y, z]]
}

fn random_rotation(random: &mut fastrand::Rng) -> UnitQuaternion<f64> {
    UnitQuaternion::from_euler_angles(6.0 * random.f64(), 3.0 * random.f64(), 6.0 * random.f64())
}

/// A step with one f64 pose, and the pose as a matrix: T from the rounded quaternion, as a server reads it.
fn pose_step(domain: u32, rotation: UnitQuaternion<f64>, translation: [f64; 3]) -> (RawStepUpdate, Matrix4<f64>) {
    let quaternion = [rotation.i, rotation.j, rotation.k, rotation.w].map(|number| number as f32);
    let [i, j, k, w] = quaternion.map(f64::from);
    let rotation = UnitQuaternion::from_quaternion(Quaternion::new(w, i, j, k));
    let bytes =
        quaternion.into_iter().flat_map(f32::to_le_bytes).chain(translation.into_iter().flat_map(f64::to_le_bytes));
    let raw = RawStepUpdate {
        transform_domains: vec![domain],
        transforms: bytes.collect(),
        transform_format: TransformFormat::QuaternionXyzwF64,
        ..RawStepUpdate::default()
    };
    (raw, rotation.to_homogeneous().append_translation(&translation.into()))
}

#[test]
fn rest_state_is_exact_at_any_distance() {
    for magnitude in [1e3, 1e5, 5e5, 4_649_776.0, 1e7, 1e9] {
        for center in centers(magnitude) {
            let x0 = tetrahedron(center);
            let scene = scene_of(std::slice::from_ref(&x0));
            assert!(scene.is_far && scene.shape_of(0).is_centered(), "{center:?}");
            let state = SceneState::rest(&scene);
            let expected = expected_positions(&scene, 0, &x0, 0.0, &Matrix4::identity());
            // At 1e9, f64 itself rounds the positions of this test by 1e-7.
            let tolerance = MAX_ERROR + magnitude * 2.0_f64.powi(-51);
            let error = relative_error(&computed_positions(&scene, &state, 0), &expected);
            assert!(error <= tolerance, "{center:?}: {error:e}");
            let f32_error = relative_error(&rounded(&x0).into_iter().map(Vector3::from).collect::<Vec<_>>(), &expected);
            assert!(f32_error > 5.0 * error, "control: expected an error of f32 at {center:?}, got {f32_error:e}");
            let bounds_error = (scene.rest_bounds.diagonal() - 0.41_f64.hypot(0.37).hypot(0.43)).abs();
            assert!(bounds_error < tolerance, "{center:?}: {bounds_error}");
        }
    }
}

#[test]
fn random_f64_poses_are_exact() {
    let mut random = fastrand::Rng::with_seed(11);
    let mut largest_error = 0.0_f64;
    for magnitude in [1e3, 1e5, 4_649_776.0, 1e8, 1e9] {
        for center in centers(magnitude) {
            let x0 = tetrahedron(center);
            let scene = scene_of(std::slice::from_ref(&x0));
            let mut state = SceneState::rest(&scene);
            for _ in 0..20 {
                let translation = [0.0; 3].map(|_: f64| magnitude * (2.0 * random.f64() - 1.0));
                let (mut raw, t) = pose_step(0, random_rotation(&mut random), translation);
                let q = random.f32();
                raw.q = q.to_le_bytes().to_vec().into();
                state.apply(&scene, &StepUpdate::parse(&scene, &raw).expect("a valid step"));
                let expected = expected_positions(&scene, 0, &x0, q, &t);
                let error = relative_error(&computed_positions(&scene, &state, 0), &expected);
                let tolerance = MAX_ERROR + magnitude * 2.0_f64.powi(-49);
                assert!(error <= tolerance, "{center:?}: {error:e}");
                largest_error = largest_error.max(if magnitude < 1e7 { error } else { 0.0 });
            }
        }
    }
    eprintln!("largest error of f64 poses: {largest_error:.1e} diagonals");
}

/// The remark on a far scene states the error of f32 transforms.
#[test]
fn f32_transforms_have_at_most_the_error_of_the_remark() {
    let mut random = fastrand::Rng::with_seed(12);
    let x0 = tetrahedron([500_000.3, 4_649_776.2, 0.1]);
    let scene = scene_of(std::slice::from_ref(&x0));
    let remark = scene.remarks.iter().find(|remark| remark.contains("f32 transforms")).expect("a remark");
    let stated = remark.split("up to ").nth(1).and_then(|text| text.split(' ').next());
    let stated: f64 = stated.and_then(|number| number.parse().ok()).expect("a number of meters");
    let mut largest_error = 0.0_f64;
    let mut state = SceneState::rest(&scene);
    for _ in 0..200 {
        // The body stays where it is, and turns.
        let center = Vector3::new(500_000.3, 4_649_776.2, 0.1);
        let rotation = random_rotation(&mut random);
        let t = rotation.to_homogeneous().append_translation(&(center - rotation * center));
        let Transform(entries) = Transform::from_matrix(&t);
        let raw = RawStepUpdate {
            transform_domains: vec![0],
            transforms: entries.into_iter().flat_map(f32::to_le_bytes).collect(),
            ..RawStepUpdate::default()
        };
        state.apply(&scene, &StepUpdate::parse(&scene, &raw).expect("a valid step"));
        let expected = expected_positions(&scene, 0, &x0, 0.0, &t);
        let errors = computed_positions(&scene, &state, 0)
            .iter()
            .zip(&expected)
            .map(|(a, b)| (a - b).amax())
            .collect::<Vec<_>>();
        largest_error = errors.into_iter().fold(largest_error, f64::max);
    }
    assert!(largest_error <= stated && largest_error > stated / 20.0, "stated {stated}, got {largest_error}");
    // An exact matrix is exact, because only the client rounds.
    let identity = RawStepUpdate {
        transform_domains: vec![0],
        transforms: Transform::IDENTITY.0.into_iter().flat_map(f32::to_le_bytes).collect(),
        ..RawStepUpdate::default()
    };
    state.apply(&scene, &StepUpdate::parse(&scene, &identity).expect("a valid step"));
    let expected = expected_positions(&scene, 0, &x0, 0.0, &Matrix4::identity());
    assert!(relative_error(&computed_positions(&scene, &state, 0), &expected) <= MAX_ERROR);
}

/// A remark is due where f32 transforms misplace a body by more than the promised 1e-5 diagonals: from 42 diagonals on.
#[test]
fn remark_is_due_above_the_promised_error() {
    for (distance, has_remark) in [(2.0, false), (12.0, false), (35.0, false), (60.0, true), (1000.0, true)] {
        let x0 = tetrahedron([0.0; 3]);
        let size = BoundingBox::from_positions(&x0.iter().flatten().map(|number| *number as f32).collect::<Vec<_>>());
        let scene = scene_of(&[tetrahedron([distance * size.diagonal(), 0.0, 0.0])]);
        assert_eq!(scene.is_far, distance > 8.5, "{distance}");
        let x0 = tetrahedron([distance * size.diagonal(), 0.0, 0.0]);
        let expected = expected_positions(&scene, 0, &x0, 0.0, &Matrix4::identity());
        let error = relative_error(&computed_positions(&scene, &SceneState::rest(&scene), 0), &expected);
        assert!(error <= MAX_ERROR, "{distance}: {error:e}");
        assert_eq!(scene.remarks.len(), usize::from(has_remark), "{distance}: {:?}", scene.remarks);
    }
}

/// A scene near its origin has the bits that it has without any of this: no origins, and placements in f32.
#[test]
fn near_scenes_have_no_origins_and_unchanged_bits() {
    let mut parts = parts_of(&[tetrahedron([0.0; 3]), tetrahedron([2.3, -0.1, 0.7])]);
    let placement = Matrix4::new_translation(&Vector3::new(0.1, 0.2, -0.3));
    parts.domains[1].set_placement(&placement);
    assert_ne!(parts.domains[1].placement_remainder, [0.0; 12], "control");
    let scene = Scene::new(parts).expect("a scene");
    let state = SceneState::rest(&scene);
    assert!(!scene.is_far && state.origins.is_none() && scene.remarks.is_empty());
    assert_eq!(scene.domains[1].placement_remainder, [0.0; 12]);
    assert_eq!(state.transforms, [Transform::IDENTITY, Transform::from_matrix(&placement)]);
    assert_eq!((scene.transform_roots.pivots().len(), scene.shape_of(0).origin()), (0, [0.0; 3]));
    for (domain, center) in [[0.0; 3], [2.3, -0.1, 0.7]].into_iter().enumerate() {
        let positions: Vec<[f32; 3]> =
            tetrahedron(center).iter().map(|position| position.map(|number| number as f32)).collect();
        assert_eq!(scene.shape_of(domain).mesh.rest_positions(), positions);
    }
}

/// Many small bodies of a scene of ordinary size keep their frames, although each is far in terms of its own size.
#[test]
fn small_parts_of_a_near_scene_have_no_origins() {
    let tiny = |x: f64| -> Vec<[f64; 3]> {
        tetrahedron([0.0; 3]).iter().map(|p| [x + 1e-2 * p[0], 1e-2 * p[1], 5.0 + 1e-2 * p[2]]).collect()
    };
    let bodies: Vec<_> = (0..10).map(|index| tiny(f64::from(index))).collect();
    assert!(shape_of(&bodies[3]).is_centered(), "control: expected an origin for the single body");
    let scene = scene_of(&bodies);
    assert!(!scene.is_far && scene.transform_roots.pivots().is_empty() && SceneState::rest(&scene).origins.is_none());
}

#[test]
fn far_placement_and_sheared_placement_are_exact() {
    let x0 = tetrahedron([0.0; 3]);
    for magnitude in [1e4, 4_649_776.0, 1e8] {
        for center in centers(magnitude) {
            let linear = Matrix3::new(0.9, -0.3, 0.1, 0.2, 1.1, -0.4, 0.05, 0.3, 0.8);
            let placement = linear.to_homogeneous().append_translation(&center.into());
            let mut parts = parts_of(std::slice::from_ref(&x0));
            parts.domains[0].set_placement(&placement);
            let scene = Scene::new(parts).expect("a scene");
            assert!(scene.is_far && !scene.shape_of(0).is_centered());
            let expected = expected_positions(&scene, 0, &x0, 0.0, &placement);
            let error = relative_error(&computed_positions(&scene, &SceneState::rest(&scene), 0), &expected);
            assert!(error <= MAX_ERROR + magnitude * 2.0_f64.powi(-51), "{center:?}: {error:e}");
        }
    }
}

/// A shape in coordinates of a map that a placement brings back to the scene's origin.
#[test]
fn far_shape_with_an_opposite_placement_is_exact() {
    let center = [500_000.3, 4_649_776.2, 0.1];
    let x0 = tetrahedron(center);
    let rotation = UnitQuaternion::from_euler_angles(0.4, -0.2, 1.1);
    let placement = rotation.to_homogeneous().append_translation(&-(rotation * Vector3::from(center)));
    let mut parts = parts_of(std::slice::from_ref(&x0));
    parts.domains[0].set_placement(&placement);
    let scene = Scene::new(parts).expect("a scene");
    let expected = expected_positions(&scene, 0, &x0, 0.0, &placement);
    let error = relative_error(&computed_positions(&scene, &SceneState::rest(&scene), 0), &expected);
    assert!(error <= MAX_ERROR + 5e6 * 2.0_f64.powi(-50), "{error:e}");
    assert!(scene.rest_bounds.max.iter().all(|coordinate| coordinate.abs() < 1.0));
}

/// A follower near the origin of its own file, at a far place of its parent: f32 would round its frame by 0.25.
#[test]
fn frames_of_followers_on_far_parents_are_exact() {
    let place = Matrix4::new_translation(&Vector3::new(500_000.9, 4_649_776.7, -29.7));
    let bodies = [tetrahedron([500_000.3, 4_649_776.2, -30.0]), tetrahedron([0.0; 3])];
    let mut parts = parts_of(&bodies);
    parts.domains[1].set_placement(&place);
    parts.domains[1].follows = Some(FollowConstraint { parent: 0, frame: Transform::from_matrix(&place) });
    let scene = Scene::new(parts).expect("a scene");
    let mut state = SceneState::rest(&scene);
    let error = |state: &SceneState, transform: &Matrix4<f64>| {
        let expected = expected_positions(&scene, 1, &bodies[1], 0.0, transform);
        relative_error(&computed_positions(&scene, state, 1), &expected)
    };
    assert!(error(&state, &place) <= MAX_ERROR);
    let rounded = Transform::from_matrix(&place).to_matrix();
    assert!(error(&state, &rounded) > 0.1, "control: f32 moves the follower");
    let (raw, t) = pose_step(0, UnitQuaternion::from_euler_angles(0.3, 0.5, -0.8), [10.0, -20.0, 5.0]);
    state.apply(&scene, &StepUpdate::parse(&scene, &raw).expect("a valid step"));
    assert!(error(&state, &(t * place)) <= 4.0 * MAX_ERROR);
}

/// A near body and a far one, and a follower of the far one.
#[test]
fn followers_and_distant_neighbors_are_exact() {
    let center = [500_000.3, 4_649_776.2, -30.0];
    let bodies = [tetrahedron([0.0; 3]), tetrahedron(center), tetrahedron([500_001.1, 4_649_776.9, -29.5])];
    let mut parts = parts_of(&bodies);
    parts.domains[2].follows = Some(FollowConstraint { parent: 1, frame: Transform::IDENTITY });
    let scene = Scene::new(parts).expect("a scene");
    let mut state = SceneState::rest(&scene);
    let check = |state: &SceneState, transforms: [&Matrix4<f64>; 3]| {
        for (domain, x0) in bodies.iter().enumerate() {
            let expected = expected_positions(&scene, domain, x0, 0.0, transforms[domain]);
            let error = relative_error(&computed_positions(&scene, state, domain), &expected);
            assert!(error <= 4.0 * MAX_ERROR, "domain {domain}: {error:e}");
        }
    };
    let identity = Matrix4::identity();
    check(&state, [&identity; 3]);
    let (raw, t) = pose_step(1, UnitQuaternion::from_euler_angles(0.3, 0.5, -0.8), [10.0, -20.0, 5.0]);
    state.apply(&scene, &StepUpdate::parse(&scene, &raw).expect("a valid step"));
    check(&state, [&identity, &t, &t]);
}
