//! Followers: domains with the transform T = T_root F, where T_root is the transform of another domain (the transform
//! root) and F is a constant frame.

use std::sync::Arc;

use modalcast_compute::reference::{self, rigid_normals, rigid_tangents};
use modalcast_model::deform::Deformer;
use modalcast_model::domain::{Domain, FollowConstraint, Mesh, Modes, Shape, Transform};
use modalcast_model::scene::{
    DeformationSettings, DirtyDomains, NormalMethod, RawStepUpdate, Scene, SceneParts, SceneState, StepUpdate,
    StorageType, TransformFormat,
};

use super::attributes::{find_wrong_box, with_displacements_and_boxes};
use super::partial_steps::randomize_q_and_transforms;
use super::surfaces::max_abs_error;
use super::{StepResult, assert_within_bound, domains_beyond_bound, run_step, strip_shape};
use crate::scenes::{self, NORMAL_MAPPED_MATERIAL, Random};

/// Largest accepted error of a component of a unit vector. It is larger than for single transforms, because products of
/// shears are worse conditioned.
const MAX_DIRECTION_ERROR: f64 = 1e-4;

/// Number of vertices and rank of each shape.
const SIZES: [(usize, usize); 9] =
    [(1, 0), (1, 3), (7, 0), (31, 1), (33, 4), (130, 31), (257, 0), (300, 33), (2000, 2)];

/// A random frame for the follower with this index. The frame is mirrored if the index is divisible by 3. With
/// `is_rigid`, no frame is sheared; otherwise, the frame is sheared if the index is even.
fn random_frame(random: &mut Random, index: usize, is_rigid: bool) -> Transform {
    let is_mirrored = index.is_multiple_of(3);
    let mut frame = random.next_similarity(is_mirrored);
    if !is_rigid && index.is_multiple_of(2) {
        // Row 0, column 1, and row 2, column 0 of the 3 x 4 matrix.
        frame.0[1] += 0.3 * random.next_number();
        frame.0[8] -= 0.2 * random.next_number();
    }
    frame
}

/// Parts of a scene with `count` domains. Domains with an index divisible by 3 are transform roots. Each other domain
/// follows a random earlier domain, which is a root or a follower. With `is_rigid`, transforms have no shear. They may
/// have a uniform scale and a reflection.
pub(crate) fn follower_scene_parts(count: usize, deformation: DeformationSettings, is_rigid: bool) -> SceneParts {
    let mut random = Random(count as u64);
    let mut shapes: Vec<Shape> =
        SIZES.iter().map(|(vertices, rank)| strip_shape(&mut random, *vertices, *rank)).collect();
    // A shape with more corners than vertices.
    shapes.push(scenes::random_shape(&mut random, 40, 2));
    let shape_count = shapes.len();
    let mut parts = scenes::parts_of_shapes(shapes);
    (parts.deformation, parts.rigid_transforms) = (deformation, is_rigid);

    for index in 0..count {
        let follows = (index % 3 != 0).then(|| {
            let parent = ((random.next_number().abs() * index as f32) as usize).min(index - 1);
            FollowConstraint { parent, frame: random_frame(&mut random, index, is_rigid) }
        });
        let material = if index % 4 == 0 { NORMAL_MAPPED_MATERIAL } else { scenes::PLAIN_MATERIAL };
        let name = format!("domain {index}");
        parts.domains.push(Domain { name, follows, ..scenes::new_domain(index * 3 % shape_count, material) });
    }
    parts
}

/// A scene of the same parts in which every domain is a transform root, and a state with the q of `state` and with
/// `transform(domain)` as the transform of each domain.
fn without_followers(
    mut parts: SceneParts,
    state: &SceneState,
    transform: impl Fn(usize) -> Transform,
) -> (Arc<Scene>, SceneState) {
    parts.domains.iter_mut().for_each(|domain| domain.follows = None);
    let scene = Scene::new(parts).expect("expected a valid scene");
    let mut root_state = SceneState::rest(&scene);
    root_state.q.clone_from(&state.q);
    root_state.transforms = (0..scene.domains.len()).map(transform).collect();
    (scene, root_state)
}

/// Largest error of a component of a normal, and of a component of a tangent.
fn direction_errors(result: &StepResult, scene: &Scene, state: &SceneState) -> [f64; 2] {
    let normals = max_abs_error(&result.surface.normals, rigid_normals(scene, state).as_flattened());
    [normals, max_abs_error(&result.surface.tangents, rigid_tangents(scene, state).as_flattened())]
}

/// Followers with mirrored, sheared and chained frames are within their error bounds for every storage type. They have
/// the same bits as transform roots with the same composed transform.
pub(crate) fn check_frames<D: Deformer>(create_deformer: impl Fn(&Arc<Scene>) -> D) {
    for (storage, is_rigid) in StorageType::ALL.into_iter().flat_map(|storage| [(storage, false), (storage, true)]) {
        let name = format!("followers, {}, rigid {is_rigid}", storage.name());
        let deformation = DeformationSettings { storage, ..DeformationSettings::default() };
        let parts = || follower_scene_parts(45, deformation, is_rigid);
        let scene = Scene::new(parts()).expect("expected a valid scene");
        assert_eq!((scene.transform_roots.count(), scene.features.shear), (15, !is_rigid));
        let state = scenes::random_state(&scene, 61);
        let result = run_step(&mut create_deformer(&scene), &state);
        assert_within_bound(&name, &scene, &state, &result.surface.positions);
        let errors = direction_errors(&result, &scene, &state);
        eprintln!("{name}: error of normals {:.2e}, of tangents {:.2e}", errors[0], errors[1]);
        assert!(errors.iter().all(|error| *error <= MAX_DIRECTION_ERROR), "{name}: {errors:?}");
        // A root with the composed transform of the follower has the same bits.
        let (root_scene, root_state) = without_followers(parts(), &state, |domain| state.transform_of(&scene, domain));
        let root_result = run_step(&mut create_deformer(&root_scene), &root_state);
        assert!(
            root_result.bounds == result.bounds
                && bits(&root_result.surface.positions) == bits(&result.surface.positions)
        );
        // Negative control: without their frames all followers have other positions and normals.
        let (root_scene, unframed_state) =
            without_followers(parts(), &state, |domain| state.transforms[scene.transform_roots.root_of(domain)]);
        let followers: Vec<usize> = (0..45).filter(|domain| domain % 3 != 0).collect();
        assert_eq!(domains_beyond_bound(&root_scene, &unframed_state, &result.surface.positions), followers, "{name}");
        assert!(direction_errors(&result, &root_scene, &unframed_state)[0] > 0.1);
    }
}

fn bits(numbers: &[f32]) -> Vec<u32> {
    numbers.iter().map(|number| number.to_bits()).collect()
}

/// The transform root of a domain, found by ascending to its ancestors.
fn transform_root(scene: &Scene, domain: usize) -> usize {
    scene.domains[domain].follows.map_or(domain, |constraint| transform_root(scene, constraint.parent))
}

/// Domains that a step changes: those in `q_domains`, and those whose transform root is in `transform_domains`.
fn changed_domains(scene: &Scene, q_domains: &[u32], transform_domains: &[u32]) -> Vec<u32> {
    let is_changed = |domain: &u32| {
        q_domains.contains(domain) || transform_domains.contains(&(transform_root(scene, *domain as usize) as u32))
    };
    (0..scene.domains.len() as u32).filter(is_changed).collect()
}

/// A partial step that sets the transforms of some roots and q of some domains gives the bits of a full step.
pub(crate) fn check_partial_steps_of_roots<D: Deformer>(create_deformer: impl Fn(&Arc<Scene>) -> D) {
    let default = DeformationSettings::default();
    for deformation in [
        default,
        with_displacements_and_boxes(default),
        DeformationSettings { normals: NormalMethod::Exact, ..default },
        DeformationSettings { normals: NormalMethod::Exact, storage: StorageType::Int8, ..default },
        DeformationSettings { storage: StorageType::F16, ..default },
    ] {
        let name = format!("{deformation:?}");
        let is_rigid = false;
        let scene = Scene::new(follower_scene_parts(120, deformation, is_rigid)).expect("expected a valid scene");
        let (mut partial_deformer, mut full_deformer) = (create_deformer(&scene), create_deformer(&scene));
        let (mut state, mut random) = (scenes::random_state(&scene, 63), Random(62));
        let mut previous_result = run_step(&mut partial_deformer, &state);
        run_step(&mut full_deformer, &state);
        let roots: Vec<u32> = scene.transform_roots.domains().collect();
        let mut partial_steps = 0;
        for step in 0..12 {
            // The step moves no root, one or two of the 40 roots, or in step 7 all roots.
            let two_roots = [roots[(step * 5 + 20) % 40], roots[(step * 11 + 39) % 40]];
            let transform_domains = if step == 7 { &roots[..] } else { &two_roots[..step % 3] };
            let q_domains: &[u32] = if step % 4 == 1 { &[1, 5, 64] } else { &[] };
            randomize_q_and_transforms(&scene, &mut state, &mut random, q_domains, transform_domains);
            let expected_domains = changed_domains(&scene, q_domains, transform_domains);
            assert_eq!(state.dirty_domains, DirtyDomains::Some(expected_domains.clone()), "step {step}");
            let result = run_step(&mut partial_deformer, &state);
            let mut dirty_state = state.clone();
            dirty_state.mark_all_dirty();
            let full_result = run_step(&mut full_deformer, &dirty_state);
            assert_eq!(result.difference(&full_result), None, "{name}, step {step}");
            let moved_domains: Vec<u32> =
                (0..120).filter(|domain| has_moved(&scene, *domain, [&previous_result, &result])).collect();
            let has_new_transform =
                |domain: &u32| transform_domains.contains(&(transform_root(&scene, *domain as usize) as u32));
            assert!(moved_domains.iter().all(|domain| expected_domains.contains(domain)));
            assert!(
                expected_domains
                    .iter()
                    .filter(|domain| has_new_transform(domain))
                    .all(|domain| moved_domains.contains(domain))
            );
            assert!(!scene.features.boxes || find_wrong_box(&scene, &result).is_none(), "step {step}");
            // Deformers compute a step as a partial step if it changes at most a quarter of the domains.
            partial_steps += usize::from(!expected_domains.is_empty() && expected_domains.len() <= 30);
            previous_result = result;
        }
        assert!(partial_steps >= 5, "expected at least 5 partial steps, got {partial_steps}");
    }
}

/// Whether the positions of a domain differ between two steps.
fn has_moved(scene: &Scene, domain: u32, [previous, current]: [&StepResult; 2]) -> bool {
    let layout = scene.layout.domains[domain as usize];
    let positions =
        |result: &StepResult| bits(&result.surface.positions[3 * layout.first_vertex..][..3 * layout.vertices]);
    positions(previous) != positions(current)
}

/// A step that sets the transform of a domain to an f64 translation: the quaternion of the identity as four f32, then
/// the translation as three f64.
pub(super) fn far_step(domain: u32, translation: [f64; 3]) -> RawStepUpdate {
    let rotation = [0.0_f32, 0.0, 0.0, 1.0].into_iter().flat_map(f32::to_le_bytes);
    let bytes: Vec<u8> = rotation.chain(translation.into_iter().flat_map(f64::to_le_bytes)).collect();
    RawStepUpdate {
        transform_domains: vec![domain],
        transforms: bytes.into(),
        transform_format: TransformFormat::QuaternionXyzwF64,
        ..RawStepUpdate::default()
    }
}

/// The positions of a follower are relative to its root's origin, which is an f64 point. So a far follower is as
/// precise as a follower near the scene's origin.
pub(crate) fn check_far_followers<D: Deformer>(create_deformer: impl Fn(&Arc<Scene>) -> D) {
    let mut random = Random(64);
    let mut parts = scenes::parts_of_shapes(vec![strip_shape(&mut random, 50, 0)]);
    let is_mirrored = true;
    let frame = random.next_similarity(is_mirrored);
    for follows in [None, Some(FollowConstraint { parent: 0, frame }), None] {
        parts.domains.push(Domain { follows, ..scenes::new_domain(0, scenes::PLAIN_MATERIAL) });
    }
    let scene = Scene::new(parts).expect("expected a valid scene");
    let mut state = SceneState::rest(&scene);
    let translation = [1e7 + 0.3, -1e7 - 0.7, 12.25];
    state.apply(&scene, &StepUpdate::parse(&scene, &far_step(0, translation)).expect("expected a valid step"));
    assert_eq!((scene.transform_roots.root_of(1), state.transforms.len()), (0, 2));
    let result = run_step(&mut create_deformer(&scene), &state);
    let (layout, origin) = (scene.layout.domains[1], state.origin_of(scene.transform_roots.root_of(1)));
    // `max_f32_error` is the error that world positions in f32 would have.
    let [mut max_error, mut max_f32_error] = [0.0_f64; 2];
    for (vertex, rest_position) in scene.shape_of(1).mesh.rest_positions().iter().enumerate() {
        let position_in_root = frame.to_matrix().transform_point(&nalgebra::Point3::from(*rest_position).cast());
        for axis in 0..3 {
            let expected = translation[axis] + position_in_root[axis];
            let actual = origin[axis] + f64::from(result.surface.positions[3 * (layout.first_vertex + vertex) + axis]);
            max_error = max_error.max((actual - expected).abs());
            max_f32_error = max_f32_error.max((f64::from(expected as f32) - expected).abs());
        }
    }
    eprintln!("error of a follower at 10,000 km: {max_error:.2e} m");
    assert!(max_error <= 1e-3, "expected at most 1 mm, got {max_error} m");
    assert!(
        max_f32_error > 0.1,
        "negative control: expected more than 0.1 m for f32 world positions, got {max_f32_error} m"
    );
}

/// Positions are finite and correct if entries of T_root F exceed f32. T_root and F have a scale of 1e25 each. Rest
/// positions of 1e-20 give coordinates x of about 1e30, which are in the range of f32.
pub(crate) fn check_overflowing_frame_products<D: Deformer>(create_deformer: impl Fn(&Arc<Scene>) -> D) {
    let mut random = Random(65);
    let rest_positions: Vec<[f32; 3]> =
        (0..37).map(|_| random.next_triple().map(|coordinate| coordinate * 1e-20)).collect();
    let normals = (0..37).map(|_| random.next_triple()).collect();
    let triangles = (0..35).map(|index| [index, index + 1, index + 2]).collect();
    let mesh = Mesh::from_indexed(rest_positions, normals, vec![], triangles).expect("expected a valid mesh");
    // The scaled linear part of a transform, with a translation of zero.
    let scaled_linear_part = |transform: Transform, scale: f32| {
        let mut entries = transform.0.map(|entry| entry * scale);
        [3, 7, 11].into_iter().for_each(|index| entries[index] = 0.0);
        Transform(entries)
    };
    for is_rigid in [true, false] {
        let mut parts =
            scenes::parts_of_shapes(vec![Shape::new(mesh.clone(), Modes::rigid()).expect("expected a valid shape")]);
        parts.rigid_transforms = is_rigid;
        let is_mirrored = true;
        let frame = scaled_linear_part(random.next_similarity(is_mirrored), 1e25);
        for follows in [None, Some(FollowConstraint { parent: 0, frame })] {
            parts.domains.push(Domain { follows, ..scenes::new_domain(0, scenes::PLAIN_MATERIAL) });
        }
        let scene = Scene::new(parts).expect("expected a valid scene");
        let mut state = SceneState::rest(&scene);
        state.transforms[0] = scaled_linear_part(random.next_similarity(!is_mirrored), 1e25);
        assert!(!state.transform_of(&scene, 1).0[0].is_finite(), "expected a product beyond f32");
        let result = run_step(&mut create_deformer(&scene), &state);
        assert!(result.bounds.is_finite());
        let expected = reference::deform(&scene, &state);
        let max_coordinate = expected
            .as_flattened()
            .iter()
            .fold(0.0_f64, |max_coordinate, coordinate| max_coordinate.max(coordinate.abs()));
        let error = max_abs_error(&result.surface.positions, expected.as_flattened()) / max_coordinate;
        assert!(error <= 1e-6, "expected a relative error of at most 1e-6, got {error}");
        let [normal_error, _] = direction_errors(&result, &scene, &state);
        assert!(normal_error <= MAX_DIRECTION_ERROR, "expected at most {MAX_DIRECTION_ERROR}, got {normal_error}");
    }
}
