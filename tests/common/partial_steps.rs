//! Partial steps: computing only the domains that a step changes gives the same bits as computing all domains.

use std::sync::Arc;

use modalcast_model::backend_settings::BatchPolicy;
use modalcast_model::deform::Deformer;
use modalcast_model::domain::{Domain, Shape};
use modalcast_model::scene::{
    DeformationSettings, DirtyDomains, NormalMethod, RawStepUpdate, Scene, SceneState, StepUpdate, StorageType,
};

use super::attributes::{find_wrong_box, with_displacements_and_boxes};
use super::{StepResult, run_step, strip_shape};
use crate::scenes::{self, NORMAL_MAPPED_MATERIAL, Random};

/// A step that sets the coordinates of `q_domains` and the transforms of `transform_domains` to random values.
/// The index of a domain modulo 3 selects the kind of its transform: 0 mirrored, 1 sheared (rotated if the scene does
/// not permit shear), 2 rotated.
fn random_step(scene: &Scene, random: &mut Random, q_domains: &[u32], transform_domains: &[u32]) -> StepUpdate {
    let coordinates: usize = q_domains.iter().map(|domain| scene.rank_of(*domain as usize)).sum();
    let q: Vec<f32> = (0..coordinates).map(|_| random.next_number()).collect();
    let random_transform = |domain: &u32| {
        let is_mirrored = domain.is_multiple_of(3);
        if domain % 3 == 1 && scene.features.shear {
            random.next_shear().0
        } else {
            random.next_similarity(is_mirrored).0
        }
    };
    let transforms: Vec<f32> = transform_domains.iter().flat_map(random_transform).collect();
    let to_bytes =
        |numbers: Vec<f32>| -> bytes::Bytes { numbers.iter().flat_map(|number| number.to_le_bytes()).collect() };
    let raw = RawStepUpdate {
        q_domains: q_domains.to_vec(),
        q: to_bytes(q),
        transform_domains: transform_domains.to_vec(),
        transforms: to_bytes(transforms),
        ..RawStepUpdate::default()
    };
    StepUpdate::parse(scene, &raw).expect("expected a valid step")
}

/// Applies a random step that sets the coordinates of `q_domains` and the transforms of `transform_domains`.
pub(crate) fn randomize_q_and_transforms(
    scene: &Scene,
    state: &mut SceneState,
    random: &mut Random,
    q_domains: &[u32],
    transform_domains: &[u32],
) {
    state.apply(scene, &random_step(scene, random, q_domains, transform_domains));
}

/// Index of a domain of 300 vertices in [`mixed_scene`]: three tiles of at most 128 vertices.
const LARGE_DOMAIN: u32 = 26;
/// Index of a domain without modes.
const RIGID_DOMAIN: u32 = 27;
/// Index of a domain that shares the coordinates of the domain before it.
const SHARING_DOMAIN: u32 = 29;
/// Number of domains of [`mixed_scene`]. A step that changes more than a quarter of them is computed in full.
const DOMAIN_COUNT: u32 = 40;

/// A scene of small domains of many ranks. Some shapes have more corners than vertices. The scene also has a large
/// domain, a domain without modes, several domains of one shape, and domains that share coordinates.
fn mixed_scene(deformation: DeformationSettings, normal_maps: bool) -> Arc<Scene> {
    let mut random = Random(50);
    let mut shapes: Vec<Shape> = (0..20).map(|index| strip_shape(&mut random, 5 + index % 9, index % 5)).collect();
    shapes.extend((0..6).map(|index| scenes::random_shape(&mut random, 3 + 7 * index, 3)));
    shapes.push(scenes::random_shape(&mut random, 300, 33));
    shapes.push(strip_shape(&mut random, 200, 0));
    shapes.push(strip_shape(&mut random, 40, 4));
    let mut domain_shapes: Vec<usize> = (0..29).collect();
    // Shapes of domains 29 to 39. Domain 29 shares the coordinates of domain 28, which has another shape of the same
    // rank. Domains 31 and 34 share the coordinates of a domain of their own shape.
    domain_shapes.extend([9, 28, 28, 28, 4, 4, 28, 28, 28, 0, 27]);
    let mut parts = scenes::parts_of_shapes(shapes);
    parts.deformation = deformation;
    let material =
        |index: usize| if normal_maps && index % 3 != 1 { NORMAL_MAPPED_MATERIAL } else { scenes::PLAIN_MATERIAL };
    let create_domain = |(index, shape): (usize, usize)| Domain {
        name: format!("{index}"),
        ..scenes::new_domain(shape, material(index))
    };
    parts.domains = domain_shapes.into_iter().enumerate().map(create_domain).collect();
    parts.domains[SHARING_DOMAIN as usize].shares_q_with = Some(28);
    parts.domains[31].shares_q_with = Some(28);
    parts.domains[34].shares_q_with = Some(33);
    let scene = Scene::new(parts).expect("expected a valid scene");
    assert_eq!(scene.domains.len(), DOMAIN_COUNT as usize);
    scene
}

/// What happens between two steps of the test sequence.
#[derive(Clone, Copy, PartialEq)]
enum Interruption {
    Nothing,
    /// A step is applied but its state is not deformed.
    SkippedStep,
    /// A state that overflows is deformed, then the previous state is deformed again.
    Overflow,
    /// A state that results from other steps is deformed.
    OtherHistory,
}

/// A step of the test sequence.
struct ScriptedStep {
    q_domains: Vec<u32>,
    transform_domains: Vec<u32>,
    /// Event before the step.
    interruption: Interruption,
}

fn scripted_steps() -> Vec<ScriptedStep> {
    use Interruption::{Nothing, OtherHistory, Overflow, SkippedStep};
    let all_domains: Vec<u32> = (0..DOMAIN_COUNT).collect();
    let quarter_of_domains = (0..DOMAIN_COUNT / 4).collect();
    let more_than_quarter = (3..4 + DOMAIN_COUNT / 4).collect();
    // Each tuple has the fields of a `ScriptedStep`.
    let create_step =
        |(q_domains, transform_domains, interruption)| ScriptedStep { q_domains, transform_domains, interruption };
    [
        (vec![], vec![], Nothing),
        (vec![3], vec![], Nothing),
        (vec![], vec![3], Nothing),
        (vec![3], vec![3], Nothing),
        (vec![], vec![RIGID_DOMAIN], Nothing),
        (vec![LARGE_DOMAIN], vec![1], Nothing),
        (all_domains.clone(), all_domains, Nothing),
        (vec![22, 24], vec![22], Nothing),
        (vec![SHARING_DOMAIN - 1], vec![], Nothing),
        (vec![SHARING_DOMAIN], vec![SHARING_DOMAIN], Nothing),
        (quarter_of_domains, vec![], Nothing),
        (vec![], more_than_quarter, Nothing),
        (vec![], vec![], Nothing),
        (vec![7], vec![], SkippedStep),
        (vec![8, 33], vec![9], Nothing),
        (vec![LARGE_DOMAIN], vec![], Overflow),
        (vec![30], vec![32], Nothing),
        (vec![11], vec![], OtherHistory),
        (vec![11, 38], vec![LARGE_DOMAIN, 39], Nothing),
        (vec![], vec![], OtherHistory),
    ]
    .map(create_step)
    .into()
}

/// Two deformers that receive the same states. `partial` computes only the changed domains. For `full`, every domain is
/// marked dirty.
struct DeformerPair<D> {
    partial: D,
    full: D,
    scene: Arc<Scene>,
    /// Number of states that were deformed so far.
    states: usize,
}

impl<D: Deformer> DeformerPair<D> {
    /// Deforms a state with both deformers, compares the two results and returns the result of `partial`. `name` names
    /// the test case.
    fn deform(&mut self, state: &SceneState, name: &str) -> StepResult {
        let mut dirty_state = state.clone();
        dirty_state.mark_all_dirty();
        let (partial, full) = (run_step(&mut self.partial, state), run_step(&mut self.full, &dirty_state));
        assert_eq!(partial.bounds.is_finite(), full.bounds.is_finite(), "{name}");
        // The numbers of an overflowing state are not compared, because they contain NaNs.
        if partial.bounds.is_finite() {
            if !partial.surface.boxes.is_empty() {
                assert_eq!(find_wrong_box(&self.scene, &partial), None, "{name}, state {}", self.states);
            }
            assert_eq!(partial.difference(&full), None, "{name}, state {}", self.states);
            assert!(
                partial.light_bounds.is_some() && partial.light_bounds == full.light_bounds,
                "{name}, state {}",
                self.states
            );
        }
        self.states += 1;
        partial
    }
}

/// Applies the scripted steps to a [`DeformerPair`].
fn compare_scripted_steps<D: Deformer>(name: &str, scene: &Arc<Scene>, create_deformer: &impl Fn(&Arc<Scene>) -> D) {
    let mut random = Random(51);
    let mut deformers = DeformerPair {
        partial: create_deformer(scene),
        full: create_deformer(scene),
        scene: Arc::clone(scene),
        states: 0,
    };
    let (mut state, mut other_state) = (scenes::random_state(scene, 52), scenes::random_state(scene, 53));
    let (mut previous_result, mut changed_steps) = (deformers.deform(&state, name), 0);
    for ScriptedStep { q_domains, transform_domains, interruption } in scripted_steps() {
        match interruption {
            Interruption::Nothing => {}
            Interruption::SkippedStep => {
                randomize_q_and_transforms(scene, &mut state, &mut random, &[5, 6], &[RIGID_DOMAIN])
            }
            Interruption::Overflow => {
                let mut overflowing_state = state.clone();
                randomize_q_and_transforms(scene, &mut overflowing_state, &mut random, &[12], &[4]);
                overflowing_state.transforms[4].0.fill(f32::MAX);
                assert!(!deformers.deform(&overflowing_state, name).bounds.is_finite());
                assert_eq!(
                    deformers.deform(&state, name).difference(&previous_result),
                    None,
                    "{name}: after an overflow"
                );
            }
            Interruption::OtherHistory => {
                randomize_q_and_transforms(scene, &mut other_state, &mut random, &[2], &[]);
                let other_result = deformers.deform(&other_state, name);
                assert!(other_result.difference(&previous_result).is_some(), "{name}: expected another result");
            }
        }
        randomize_q_and_transforms(scene, &mut state, &mut random, &q_domains, &transform_domains);
        let result = deformers.deform(&state, name);
        if !q_domains.is_empty() || !transform_domains.is_empty() {
            assert!(result.difference(&previous_result).is_some(), "{name}: expected the step to change vertices");
            changed_steps += 1;
        }
        previous_result = result;
    }
    assert_eq!(deformers.deform(&state, name).difference(&previous_result), None, "{name}: the same state again");
    // The result does not depend on earlier steps.
    let new_result = run_step(&mut create_deformer(scene), &state);
    assert_eq!(new_result.difference(&previous_result), None, "{name}: a new deformer");
    eprintln!("{name}: {} states have equal bits, {changed_steps} of them after a step with changes", deformers.states);
}

/// Runs the scripted steps for every storage type and every deformation feature, and with batches.
pub(crate) fn check_partial_steps<D: Deformer>(create_deformer: impl Fn(&Arc<Scene>, BatchPolicy) -> D) {
    let with_storage = |storage| DeformationSettings { storage, ..DeformationSettings::default() };
    let with_exact_normals = |storage| DeformationSettings { normals: NormalMethod::Exact, ..with_storage(storage) };
    let with_compensation = |deformation| DeformationSettings { compensated: true, ..deformation };
    for (deformation, normal_maps) in [
        (with_storage(StorageType::F32), true),
        (with_exact_normals(StorageType::F32), true),
        (with_compensation(with_exact_normals(StorageType::F32)), false),
        (with_storage(StorageType::F16), true),
        (with_exact_normals(StorageType::Bf16), true),
        (with_storage(StorageType::Int8), true),
        (with_compensation(with_exact_normals(StorageType::Int8)), false),
        (with_displacements_and_boxes(with_storage(StorageType::F32)), true),
        (with_displacements_and_boxes(with_storage(StorageType::F16)), false),
        (with_displacements_and_boxes(with_compensation(with_exact_normals(StorageType::Int8))), false),
    ] {
        let name = format!("{deformation:?}, normal maps {normal_maps}");
        let create_deformer = |scene: &Arc<Scene>| create_deformer(scene, BatchPolicy::default());
        compare_scripted_steps(&name, &mixed_scene(deformation, normal_maps), &create_deformer);
    }
    for deformation in [
        with_storage(StorageType::F32),
        with_exact_normals(StorageType::F16),
        DeformationSettings { boxes: true, ..with_storage(StorageType::Int8) },
    ] {
        let name = format!("batched {deformation:?}");
        let create_deformer = |scene: &Arc<Scene>| create_deformer(scene, BatchPolicy::Always);
        let normal_maps = true;
        compare_scripted_steps(&name, &mixed_scene(deformation, normal_maps), &create_deformer);
    }
}

/// Whether a deformer skips a changed domain that is missing from the state's list of dirty domains. Asserts that a
/// listed domain is computed.
pub(crate) fn relies_on_dirty_list<D: Deformer>(create_deformer: impl Fn(&Arc<Scene>) -> D) -> bool {
    let normal_maps = false;
    let scene = mixed_scene(DeformationSettings::default(), normal_maps);
    let mut deformer = create_deformer(&scene);
    let mut state = scenes::random_state(&scene, 54);
    let previous_positions = run_step(&mut deformer, &state).surface.positions;
    // The step sets q of two domains. Then one of the two is removed from the list.
    randomize_q_and_transforms(&scene, &mut state, &mut Random(55), &[LARGE_DOMAIN, 3], &[]);
    assert_eq!(state.dirty_domains, DirtyDomains::Some(vec![3, LARGE_DOMAIN]));
    state.dirty_domains = DirtyDomains::Some(vec![3]);
    let positions = run_step(&mut deformer, &state).surface.positions;
    let is_unchanged = |domain: u32| {
        let layout = scene.layout.domains[domain as usize];
        let range = 3 * layout.first_vertex..3 * (layout.first_vertex + layout.vertices);
        previous_positions[range.clone()] == positions[range]
    };
    assert!(!is_unchanged(3), "expected the listed domain to be computed");
    is_unchanged(LARGE_DOMAIN)
}
