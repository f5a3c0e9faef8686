//! Domains that follow others by constant frames: T = T_root F.

use std::sync::Arc;

use modalcast_compute::reference::{self, rigid_normals, rigid_tangents};
use modalcast_model::deform::Deformer;
use modalcast_model::domain::{Domain, FollowConstraint, Mesh, Modes, Shape, Transform};
use modalcast_model::scene::{
    DeformationSettings, DirtyDomains, NormalMethod, RawStepUpdate, Scene, SceneParts, SceneState, StepUpdate,
    StorageType, TransformFormat,
};

use super::changes::apply;
use super::readers::{kept, wrong_box};
use super::surfaces::largest_error;
use super::{StepResult, beyond, run, strip, within};
use crate::scenes::{self, NORMAL_MAPPED, Random};

/// Largest accepted error of a component of a unit vector. Products of shears have a worse condition number than single
/// shears.
const DIRECTION: f64 = 1e-4;

/// Numbers of vertices and ranks of the shapes.
const SIZES: [(usize, usize); 9] =
    [(1, 0), (1, 3), (7, 0), (31, 1), (33, 4), (130, 31), (257, 0), (300, 33), (2000, 2)];

/// A similarity transform; every third is mirrored. Unless `rigid`, every second is sheared too.
fn frame(random: &mut Random, at: usize, rigid: bool) -> Transform {
    let mut frame = random.similarity(at.is_multiple_of(3));
    if !rigid && at.is_multiple_of(2) {
        frame.0[1] += 0.3 * random.number();
        frame.0[8] -= 0.2 * random.number();
    }
    frame
}

/// A scene in which one third of the domains are transform roots. Each other domain follows an earlier one, which may
/// be a follower itself.
pub(crate) fn grove(count: usize, deformation: DeformationSettings, rigid: bool) -> SceneParts {
    let mut random = Random(count as u64);
    let mut shapes: Vec<Shape> = SIZES.iter().map(|(vertices, rank)| strip(&mut random, *vertices, *rank)).collect();
    // A shape with more corners than vertices.
    shapes.push(scenes::shape(&mut random, 40, 2));
    let kinds = shapes.len();
    let mut parts = scenes::parts(shapes);
    (parts.deformation, parts.rigid_transforms) = (deformation, rigid);
    for at in 0..count {
        let follows = (at % 3 != 0).then(|| {
            let parent = ((random.number().abs() * at as f32) as usize).min(at - 1);
            FollowConstraint { parent, frame: frame(&mut random, at, rigid) }
        });
        let material = if at % 4 == 0 { NORMAL_MAPPED } else { 0 };
        let name = format!("domain {at}");
        parts.domains.push(Domain { name, follows, ..scenes::domain(at * 3 % kinds, material) });
    }
    parts
}

/// The same scene without followers, in a state whose transforms are given by `place`.
fn apart(mut parts: SceneParts, state: &SceneState, place: impl Fn(usize) -> Transform) -> (Arc<Scene>, SceneState) {
    parts.domains.iter_mut().for_each(|domain| domain.follows = None);
    let scene = Scene::new(parts).expect("a scene");
    let mut placed = SceneState::rest(&scene);
    placed.q.clone_from(&state.q);
    placed.transforms = (0..scene.domains.len()).map(place).collect();
    (scene, placed)
}

/// Errors of normals and tangents.
fn turned(shown: &StepResult, scene: &Scene, state: &SceneState) -> [f64; 2] {
    let normals = largest_error(&shown.surface.normals, rigid_normals(scene, state).as_flattened());
    [normals, largest_error(&shown.surface.tangents, rigid_tangents(scene, state).as_flattened())]
}

/// Mirrored, sheared and chained frames of small and large shapes for every storage type.
pub(crate) fn frames_of_all_sizes<D: Deformer>(make: impl Fn(&Arc<Scene>) -> D) {
    for (storage, rigid) in StorageType::ALL.into_iter().flat_map(|storage| [(storage, false), (storage, true)]) {
        let name = format!("followers, {}, rigid {rigid}", storage.name());
        let parts = || grove(45, DeformationSettings { storage, ..DeformationSettings::default() }, rigid);
        let scene = Scene::new(parts()).expect("a scene");
        assert_eq!((scene.movers.count(), scene.needs.shear), (15, !rigid));
        let state = scenes::state(&scene, 61);
        let shown = run(&mut make(&scene), &state);
        within(&name, (&scene, &state), &shown.surface.positions, 0.0);
        let errors = turned(&shown, &scene, &state);
        eprintln!("{name}: normals off by {:.2e}, tangents by {:.2e}", errors[0], errors[1]);
        assert!(errors.iter().all(|error| *error <= DIRECTION), "{name}: {errors:?}");
        // A root at the place of each follower has the same bits.
        let (others, placed) = apart(parts(), &state, |domain| state.transform_of(&scene, domain));
        let twin = run(&mut make(&others), &placed);
        assert!(twin.bounds == shown.bounds && bits(&twin.surface.positions) == bits(&shown.surface.positions));
        // Control: without their frames all followers have other positions and normals.
        let (others, bare) = apart(parts(), &state, |domain| state.transforms[scene.movers.of(domain)]);
        let followers: Vec<usize> = (0..45).filter(|domain| domain % 3 != 0).collect();
        assert_eq!(beyond((&others, &bare), &shown.surface.positions, 0.0), followers, "{name}");
        assert!(turned(&shown, &others, &bare)[0] > 0.1);
    }
}

fn bits(numbers: &[f32]) -> Vec<u32> {
    numbers.iter().map(|number| number.to_bits()).collect()
}

/// The transform root of a domain, found along its parents.
fn root(scene: &Scene, domain: usize) -> usize {
    scene.domains[domain].follows.map_or(domain, |follow| root(scene, follow.parent))
}

/// Domains that a step changes: named ones, and those whose transform root is named.
fn changed_by(scene: &Scene, q: &[u32], transforms: &[u32]) -> Vec<u32> {
    let moves = |domain: &u32| q.contains(domain) || transforms.contains(&(root(scene, *domain as usize) as u32));
    (0..scene.domains.len() as u32).filter(moves).collect()
}

/// A list that moves some roots and bends some followers gives the bits of a full step.
pub(crate) fn steps_of_movers<D: Deformer>(make: impl Fn(&Arc<Scene>) -> D) {
    let plain = DeformationSettings::default();
    for deformation in [
        plain,
        kept(plain),
        DeformationSettings { normals: NormalMethod::Exact, ..plain },
        DeformationSettings { normals: NormalMethod::Exact, storage: StorageType::Int8, ..plain },
        DeformationSettings { truncation: Some(0.2), storage: StorageType::F16, ..plain },
    ] {
        let scene = Scene::new(grove(120, deformation, false)).expect("a scene");
        let (mut listed, mut whole, mut random) = (make(&scene), make(&scene), Random(62));
        let mut state = scenes::state(&scene, 63);
        let mut last = run(&mut listed, &state);
        run(&mut whole, &state);
        let movers: Vec<u32> = scene.movers.domains().collect();
        let mut lists = 0;
        for step in 0..12 {
            let transforms = [movers[(step * 5 + 20) % 40], movers[(step * 11 + 39) % 40]];
            let transforms = if step == 7 { &movers[..] } else { &transforms[..step % 3] };
            let q: &[u32] = if step % 4 == 1 { &[1, 5, 64] } else { &[] };
            apply(&scene, &mut state, &mut random, (q, transforms));
            let expected = changed_by(&scene, q, transforms);
            assert_eq!(state.changed, DirtyDomains::Some(expected.clone()), "step {step}");
            let shown = run(&mut listed, &state);
            let mut all = state.clone();
            all.mark_all_dirty();
            assert_eq!(shown.difference(&run(&mut whole, &all)), None, "{deformation:?}, step {step}");
            let moved: Vec<u32> = (0..120).filter(|domain| moves(&scene, *domain, [&last, &shown])).collect();
            let in_place = |domain: &u32| transforms.contains(&(root(&scene, *domain as usize) as u32));
            assert!(moved.iter().all(|domain| expected.contains(domain)));
            assert!(expected.iter().filter(|domain| in_place(domain)).all(|domain| moved.contains(domain)));
            assert!(!scene.needs.boxes || wrong_box(&scene, &shown).is_none(), "step {step}");
            lists += usize::from(!expected.is_empty() && expected.len() <= 30);
            last = shown;
        }
        assert!(lists >= 5, "{lists} steps short enough for a list");
    }
}

fn moves(scene: &Scene, domain: u32, [before, after]: [&StepResult; 2]) -> bool {
    let slot = scene.layout.slots[domain as usize];
    let own = |shown: &StepResult| bits(&shown.surface.positions[3 * slot.first_vertex..][..3 * slot.vertices]);
    own(before) != own(after)
}

/// A step that moves a domain by an f64 translation without rotating it.
fn far_step(domain: u32, translation: [f64; 3]) -> RawStepUpdate {
    let rotation = [0.0_f32, 0.0, 0.0, 1.0].into_iter().flat_map(f32::to_le_bytes);
    let bytes: Vec<u8> = rotation.chain(translation.into_iter().flat_map(f64::to_le_bytes)).collect();
    RawStepUpdate {
        transform_domains: vec![domain],
        transforms: bytes.into(),
        transform_format: TransformFormat::RigidF64,
        ..RawStepUpdate::default()
    }
}

/// Followers are in the origin cell of their root, and as precise there as near the origin.
pub(crate) fn far_away<D: Deformer>(make: impl Fn(&Arc<Scene>) -> D) {
    let mut random = Random(64);
    let mut parts = scenes::parts(vec![strip(&mut random, 50, 0)]);
    let frame = random.similarity(true);
    for follows in [None, Some(FollowConstraint { parent: 0, frame }), None] {
        parts.domains.push(Domain { follows, ..scenes::domain(0, 0) });
    }
    let scene = Scene::new(parts).expect("a scene");
    let mut state = SceneState::rest(&scene);
    let place = [1e7 + 0.3, -1e7 - 0.7, 12.25];
    state.apply(&scene, &StepUpdate::parse(&scene, &far_step(0, place)).expect("a step"));
    assert_eq!((scene.movers.of(1), state.transforms.len()), (0, 2));
    let shown = run(&mut make(&scene), &state);
    let (slot, cell) = (scene.layout.slots[1], state.origin_of(scene.movers.of(1)));
    let [mut error, mut rounded] = [0.0_f64; 2];
    for (vertex, rest) in scene.shape_of(1).mesh.rest().iter().enumerate() {
        let inside = frame.to_matrix().transform_point(&nalgebra::Point3::from(*rest).cast());
        for axis in 0..3 {
            let want = place[axis] + inside[axis];
            let got = cell[axis] + f64::from(shown.surface.positions[3 * (slot.first_vertex + vertex) + axis]);
            error = error.max((got - want).abs());
            rounded = rounded.max((f64::from(want as f32) - want).abs());
        }
    }
    eprintln!("a follower 10,000 km away is off by {error:.2e} m");
    assert!(error <= 1e-3, "{error} m");
    assert!(rounded > 0.1, "the control: in f32 from the origin it would be off by {rounded} m");
}

/// The product of T and F exceeds the range of f32; the positions that it gives to tiny vertices do not.
pub(crate) fn products_that_overflow<D: Deformer>(make: impl Fn(&Arc<Scene>) -> D) {
    let mut random = Random(65);
    let rest: Vec<[f32; 3]> = (0..37).map(|_| random.triple().map(|number| number * 1e-20)).collect();
    let normals = (0..37).map(|_| random.triple()).collect();
    let triangles = (0..35).map(|at| [at, at + 1, at + 2]).collect();
    let mesh = Mesh::from_indexed(rest, normals, vec![], triangles).expect("a strip");
    let scaled = |transform: Transform, scale: f32| {
        let mut linear = transform.0.map(|entry| entry * scale);
        [3, 7, 11].into_iter().for_each(|at| linear[at] = 0.0);
        Transform(linear)
    };
    for rigid in [true, false] {
        let mut parts = scenes::parts(vec![Shape::new(mesh.clone(), Modes::rigid()).expect("rigid")]);
        parts.rigid_transforms = rigid;
        let frame = scaled(random.similarity(true), 1e25);
        for follows in [None, Some(FollowConstraint { parent: 0, frame })] {
            parts.domains.push(Domain { follows, ..scenes::domain(0, 0) });
        }
        let scene = Scene::new(parts).expect("a scene");
        let mut state = SceneState::rest(&scene);
        state.transforms[0] = scaled(random.similarity(false), 1e25);
        assert!(!state.transform_of(&scene, 1).0[0].is_finite(), "the product leaves f32");
        let shown = run(&mut make(&scene), &state);
        assert!(shown.bounds.is_finite());
        let want = reference::deform(&scene, &state);
        let largest = want.as_flattened().iter().fold(0.0_f64, |largest, number| largest.max(number.abs()));
        let error = largest_error(&shown.surface.positions, want.as_flattened()) / largest;
        assert!(error <= 1e-6, "{error}");
        let [normals, _] = turned(&shown, &scene, &state);
        assert!(normals <= DIRECTION, "{normals}");
    }
}
