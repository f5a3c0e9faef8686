//! Partial steps: a state reached by steps that change a few domains each has the bits of the same state computed in
//! full.

use std::sync::Arc;

use modalcast_model::deform::Deformer;
use modalcast_model::domain::{Domain, Shape};
use modalcast_model::scene::{
    BatchPolicy, DeformationSettings, DirtyDomains, NormalMethod, RawStepUpdate, Scene, SceneState, StepUpdate,
    StorageType,
};

use super::readers::{kept, wrong_box};
use super::{StepResult, run, strip};
use crate::scenes::{self, NORMAL_MAPPED, Random};

/// A wire step that names the domains of its coordinates and of its transforms.
fn update(scene: &Scene, random: &mut Random, (q, transforms): (&[u32], &[u32])) -> StepUpdate {
    let rank: usize = q.iter().map(|domain| scene.rank_of(*domain as usize)).sum();
    let numbers: Vec<f32> = (0..rank).map(|_| random.number()).collect();
    let place = |domain: &u32| match domain % 3 {
        0 => random.similarity(true).0,
        1 if scene.needs.shear => random.shear().0,
        _ => random.similarity(false).0,
    };
    let places: Vec<f32> = transforms.iter().flat_map(place).collect();
    let bytes =
        |numbers: Vec<f32>| -> bytes::Bytes { numbers.iter().flat_map(|number| number.to_le_bytes()).collect() };
    let raw = RawStepUpdate {
        q_domains: q.to_vec(),
        q: bytes(numbers),
        transform_domains: transforms.to_vec(),
        transforms: bytes(places),
        ..RawStepUpdate::default()
    };
    StepUpdate::parse(scene, &raw).expect("a step")
}

/// Applies a random step that names these domains.
pub(crate) fn apply(scene: &Scene, state: &mut SceneState, random: &mut Random, named: (&[u32], &[u32])) {
    state.apply(scene, &update(scene, random, named));
}

/// A domain of several tiles, one without modes, and one that shares the coordinates of the domain before it.
const LARGE: u32 = 26;
const RIGID: u32 = 27;
const SHARER: u32 = 29;
/// Number of domains of [`crowd`]. A list of changes may name at most a quarter of them.
const CROWD: u32 = 40;

/// A scene of small domains of many ranks, with and without separate corners, a large domain, one without modes,
/// instances, and domains of one shape or of two shapes that share coordinates.
fn crowd(deformation: DeformationSettings, normal_maps: bool) -> Arc<Scene> {
    let mut random = Random(50);
    let mut shapes: Vec<Shape> = (0..20).map(|at| strip(&mut random, 5 + at % 9, at % 5)).collect();
    shapes.extend((0..6).map(|at| scenes::shape(&mut random, 3 + 7 * at, 3)));
    shapes.push(scenes::shape(&mut random, 300, 33));
    shapes.push(strip(&mut random, 200, 0));
    shapes.push(strip(&mut random, 40, 4));
    let mut of: Vec<usize> = (0..29).collect();
    // A domain that shares the coordinates of another shape, then instances.
    of.extend([9, 28, 28, 28, 4, 4, 28, 28, 28, 0, 27]);
    let mut parts = scenes::parts(shapes);
    parts.deformation = deformation;
    let material = |at: usize| if normal_maps && at % 3 != 1 { NORMAL_MAPPED } else { 0 };
    let domain = |(at, shape): (usize, usize)| Domain { name: format!("{at}"), ..scenes::domain(shape, material(at)) };
    parts.domains = of.into_iter().enumerate().map(domain).collect();
    parts.domains[SHARER as usize].shares_q_with = Some(28);
    parts.domains[31].shares_q_with = Some(28);
    parts.domains[34].shares_q_with = Some(33);
    let scene = Scene::new(parts).expect("a scene");
    assert_eq!(scene.domains.len(), CROWD as usize);
    scene
}

/// Event between two states that are shown.
#[derive(Clone, Copy, PartialEq)]
enum Between {
    Nothing,
    /// A state is applied but not shown.
    Skipped,
    /// A state is refused, and the state before it is shown again.
    Refused,
    /// A state of another history is shown.
    Other,
}

/// Domains that each step names: first those of its coordinates, then those of its transforms.
fn script() -> Vec<(Vec<u32>, Vec<u32>, Between)> {
    use Between::{Nothing, Other, Refused, Skipped};
    let all: Vec<u32> = (0..CROWD).collect();
    let (quarter, more) = ((0..CROWD / 4).collect(), (3..4 + CROWD / 4).collect());
    vec![
        (vec![], vec![], Nothing),
        (vec![3], vec![], Nothing),
        (vec![], vec![3], Nothing),
        (vec![3], vec![3], Nothing),
        (vec![], vec![RIGID], Nothing),
        (vec![LARGE], vec![1], Nothing),
        (all.clone(), all, Nothing),
        (vec![22, 24], vec![22], Nothing),
        (vec![SHARER - 1], vec![], Nothing),
        (vec![SHARER], vec![SHARER], Nothing),
        (quarter, vec![], Nothing),
        (vec![], more, Nothing),
        (vec![], vec![], Nothing),
        (vec![7], vec![], Skipped),
        (vec![8, 33], vec![9], Nothing),
        (vec![LARGE], vec![], Refused),
        (vec![30], vec![32], Nothing),
        (vec![11], vec![], Other),
        (vec![11, 38], vec![LARGE, 39], Nothing),
        (vec![], vec![], Other),
    ]
}

/// A deformer that receives partial steps, and one that receives the same states with every domain marked as changed.
struct Both<D> {
    listed: D,
    whole: D,
    scene: Arc<Scene>,
    shows: usize,
}

impl<D: Deformer> Both<D> {
    fn show(&mut self, state: &SceneState, name: &str) -> StepResult {
        let mut whole = state.clone();
        whole.mark_all_dirty();
        let (listed, whole) = (run(&mut self.listed, state), run(&mut self.whole, &whole));
        // The bounds of a refused state are not finite, and NaNs equal nothing, so its numbers are not compared.
        if listed.bounds.is_finite() {
            if !listed.surface.boxes.is_empty() {
                assert_eq!(wrong_box(&self.scene, &listed), None, "{name}, show {}", self.shows);
            }
            assert_eq!(listed.difference(&whole), None, "{name}, show {}", self.shows);
            assert!(listed.light.is_some() && listed.light == whole.light, "{name}, show {}", self.shows);
        }
        assert_eq!(listed.bounds.is_finite(), whole.bounds.is_finite(), "{name}");
        self.shows += 1;
        listed
    }
}

fn follow<D: Deformer>(name: &str, scene: &Arc<Scene>, make: &impl Fn(&Arc<Scene>) -> D) {
    let mut random = Random(51);
    let mut both = Both { listed: make(scene), whole: make(scene), scene: Arc::clone(scene), shows: 0 };
    let (mut state, mut other) = (scenes::state(scene, 52), scenes::state(scene, 53));
    let (mut last, mut moved) = (both.show(&state, name), 0);
    for (q, transforms, between) in script() {
        match between {
            Between::Nothing => {}
            Between::Skipped => apply(scene, &mut state, &mut random, (&[5, 6], &[RIGID])),
            Between::Refused => {
                let mut bad = state.clone();
                apply(scene, &mut bad, &mut random, (&[12], &[4]));
                bad.transforms[4].0.fill(f32::MAX);
                assert!(!both.show(&bad, name).bounds.is_finite());
                assert_eq!(both.show(&state, name).difference(&last), None, "{name}: back again");
            }
            Between::Other => {
                apply(scene, &mut other, &mut random, (&[2], &[]));
                assert!(both.show(&other, name).difference(&last).is_some());
            }
        }
        apply(scene, &mut state, &mut random, (&q, &transforms));
        let shown = both.show(&state, name);
        if !q.is_empty() || !transforms.is_empty() {
            assert!(shown.difference(&last).is_some(), "{name}: the judge can fail");
            moved += 1;
        }
        last = shown;
    }
    // The same serial number once more. Without truncation nothing depends on earlier steps, so a fresh deformer gives
    // the same bits.
    assert_eq!(both.show(&state, name).difference(&last), None, "{name}: again");
    if !scene.needs.truncation {
        assert_eq!(run(&mut make(scene), &state).difference(&last), None, "{name}: anew");
    }
    eprintln!("{name}: {} shows, {moved} of them with moved domains, agree bit by bit", both.shows);
}

/// Twenty steps for every storage type and every feature of a deformation.
pub(crate) fn steps_of_a_few_domains<D: Deformer>(make: impl Fn(&Arc<Scene>) -> D) {
    let plain = |storage| DeformationSettings { storage, ..DeformationSettings::default() };
    let exact = |storage| DeformationSettings { normals: NormalMethod::Exact, ..plain(storage) };
    let compensated = |deformation| DeformationSettings { compensated: true, ..deformation };
    let together = |deformation| DeformationSettings { batches: BatchPolicy::Always, ..deformation };
    let truncated = |storage| DeformationSettings { truncation: Some(0.2), ..plain(storage) };
    for (deformation, normal_maps) in [
        (plain(StorageType::F32), true),
        (exact(StorageType::F32), true),
        (compensated(exact(StorageType::F32)), false),
        (truncated(StorageType::F32), false),
        (plain(StorageType::F16), true),
        (truncated(StorageType::F16), true),
        (exact(StorageType::Bf16), true),
        (plain(StorageType::Int8), true),
        (compensated(exact(StorageType::Int8)), false),
        (kept(plain(StorageType::F32)), true),
        (kept(truncated(StorageType::F16)), false),
        (kept(compensated(exact(StorageType::Int8))), false),
        (together(plain(StorageType::F32)), true),
        (together(exact(StorageType::F16)), true),
        (DeformationSettings { boxes: true, ..together(plain(StorageType::Int8)) }, true),
    ] {
        follow(&format!("{deformation:?}, normal maps {normal_maps}"), &crowd(deformation, normal_maps), &make);
    }
}

/// Whether a deformer trusts a state's list of changes: it then skips a changed domain that is not listed, and computes
/// a listed one.
pub(crate) fn trusts_change_lists<D: Deformer>(make: impl Fn(&Arc<Scene>) -> D) -> bool {
    let scene = crowd(DeformationSettings::default(), false);
    let mut deformer = make(&scene);
    let mut state = scenes::state(&scene, 54);
    let before = run(&mut deformer, &state).surface.positions;
    apply(&scene, &mut state, &mut Random(55), (&[LARGE, 3], &[]));
    assert_eq!(state.changed, DirtyDomains::Some(vec![3, LARGE]));
    state.changed = DirtyDomains::Some(vec![3]);
    let after = run(&mut deformer, &state).surface.positions;
    let stays = |domain: u32| {
        let slot = scene.layout.slots[domain as usize];
        let range = 3 * slot.first_vertex..3 * (slot.first_vertex + slot.vertices);
        before[range.clone()] == after[range]
    };
    assert!(!stays(3), "what is listed is computed");
    stays(LARGE)
}
