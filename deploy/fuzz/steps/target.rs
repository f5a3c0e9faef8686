//! The target of steps: parses the steps of a writer for a scene with three domains, merges them, and applies them. The
//! fuzzer and `files/replay.rs` run it.
//!
//! An input is a sequence of steps. Each begins with a head of [`HEAD_BYTES`]: the time (f64, little-endian), the format
//! of the transforms, and the lengths of its four lists, two of indices of domains and two of values.

use std::fs;
use std::sync::Arc;

use modalcast_model::domain::{Domain, Transform};
use modalcast_model::load::SceneRepository;
use modalcast_model::memory::{MemoryBudget, MemoryKind, MemoryReservation};
use modalcast_model::scene::{RawStepUpdate, Scene, SceneState, StepUpdate, TransformFormat};

/// The size of a step's head: one f64, and five bytes.
const HEAD_BYTES: usize = 13;

/// The largest number of steps of an input.
const MAX_STEPS: usize = 4;

const SQUARE: &str = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3\nf 1 3 4\n";

/// Modes in SOFA's text format: 12 rows, two columns.
const MODES: &str = "12 2\n1 0\n0 1\n0 0\n1 0\n0 2\n0 0\n0 0\n0 1\n1 0\n0 0\n0 1\n2 0\n";

const SCENE: &str = "unit = 0.5\n[[domain]]\nname = \"a\"\nmodel = \"m.obj\"\nmodes = \"modes.txt\"\n[[domain]]\nname = \"b\"\n\
                     model = \"m.obj\"\nmodes = \"\"\n";

/// A scene and its rest state. Domain "c" shares the coordinates of domain "a".
pub(crate) struct StepTarget {
    scene: Arc<Scene>,
    rest: SceneState,
}

/// Steps and sequences of them: coordinates and transforms; a quaternion; a quaternion with a translation in f64; values
/// of the whole scene, with coordinates of every domain and with each coordinate once.
pub(crate) fn seeds(_target: &str) -> Vec<Vec<u8>> {
    let floats = |numbers: &[f32]| numbers.iter().flat_map(|number| number.to_le_bytes()).collect::<Vec<u8>>();
    let step = |format: u8, q_domains: &[u8], transform_domains: &[u8], q: &[u8], transforms: &[u8]| {
        let lengths = [q_domains, transform_domains, q, transforms].map(|list| list.len() as u8);
        [&1.5_f64.to_le_bytes()[..], &[format], &lengths, q_domains, transform_domains, q, transforms].concat()
    };
    let identity = floats(&[1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0]);
    let quaternion = floats(&[0.0, 0.0, 0.0, 1.0]);
    let translation: Vec<u8> = [1.0_f64, 1e7, 3.0].iter().flat_map(|number| number.to_le_bytes()).collect();
    let steps = [
        step(0, &[0], &[1], &floats(&[0.5, -0.5]), &identity),
        step(1, &[], &[1], &[], &[quaternion.clone(), floats(&[1.0, 2.0, 3.0])].concat()),
        step(2, &[], &[0], &[], &[quaternion, translation].concat()),
        step(0, &[], &[], &floats(&[0.25, 0.75, -0.5, 1.0]), &identity.repeat(3)),
        step(0, &[], &[], &floats(&[0.5, 0.25]), &[]),
    ];
    let sequences = [steps[..3].concat(), steps[3..].concat()];
    steps.into_iter().chain(sequences).collect()
}

impl StepTarget {
    /// # Panics
    /// If the temporary folder is not writable.
    pub(crate) fn new() -> Self {
        let folder = tempfile::tempdir().expect("expected a writable folder");
        for (name, content) in [("m.obj", SQUARE), ("modes.txt", MODES), ("scene.toml", SCENE)] {
            fs::write(folder.path().join(name), content).expect("expected a writable folder");
        }
        let repository = SceneRepository::new(Some(folder.path())).expect("expected a readable folder");
        let budget = MemoryBudget::new(MemoryKind::Host, u64::MAX, u64::MAX);
        let opened = repository.open(".", &MemoryReservation::new(&budget)).expect("expected a valid scene");
        let mut parts = opened.scene.parts();
        let sharing = Domain { name: "c".into(), shares_q_with: Some(0), ..parts.domains[0].clone() };
        parts.domains.push(sharing);
        let scene = Scene::new(parts).expect("expected a valid scene");
        Self { rest: SceneState::rest(&scene), scene }
    }

    /// Parses and applies the steps. Returns whether all are valid.
    ///
    /// # Panics
    /// If the code panics, or steps that are merged give another state than the same steps one after another.
    pub(crate) fn run(&self, input: &[u8]) -> bool {
        let (mut rest, mut is_valid) = (input, true);
        let mut steps: Vec<StepUpdate> = Vec::new();
        while !rest.is_empty() && steps.len() < MAX_STEPS {
            let (raw, next) = read_step(rest);
            rest = next;
            match StepUpdate::parse(&self.scene, &raw) {
                Ok(step) => steps.push(step),
                Err(_) => is_valid = false,
            }
        }
        let mut one_by_one = self.rest.clone();
        steps.iter().for_each(|step| one_by_one.apply(&self.scene, step));
        if let Some(merged) = steps.into_iter().reduce(|older, newer| newer.merged_with_older(&older)) {
            let mut at_once = self.rest.clone();
            at_once.apply(&self.scene, &merged);
            assert_eq!(bits(&one_by_one.q), bits(&at_once.q), "expected equal coordinates");
            for root in 0..self.scene.domains.len() {
                let [first, second] = [&one_by_one, &at_once].map(|state| self.transform_bits(state, root));
                assert_eq!(first, second, "expected equal transforms of domain {root}");
            }
        }
        is_valid
    }
}

impl StepTarget {
    /// The linear part and the translation of T. The translation is that from the scene's origin, because floating
    /// origins depend on the number of steps.
    fn transform_bits(&self, state: &SceneState, root: usize) -> ([u32; 9], [u64; 3]) {
        let Transform(rows) = state.transform_of(&self.scene, root);
        let relative = [rows[3], rows[7], rows[11]].map(f64::from);
        let translation = state.origins.as_ref().map_or(relative, |origins| origins.translations()[root]);
        let linear = std::array::from_fn(|index| rows[index / 3 * 4 + index % 3].to_bits());
        (linear, translation.map(f64::to_bits))
    }
}

fn bits(numbers: &[f32]) -> Vec<u32> {
    numbers.iter().map(|number| number.to_bits()).collect()
}

/// The first step of an input, and the rest. Bytes that are missing are zero, and lists that are cut off are shorter.
fn read_step(input: &[u8]) -> (RawStepUpdate, &[u8]) {
    let mut head = [0; HEAD_BYTES];
    let head_bytes = input.len().min(HEAD_BYTES);
    head[..head_bytes].copy_from_slice(&input[..head_bytes]);
    let mut rest = &input[head_bytes..];
    let mut take = |length: u8| {
        let (list, next) = rest.split_at(rest.len().min(length.into()));
        rest = next;
        list
    };
    let indices = |list: &[u8]| list.iter().map(|index| u32::from(*index)).collect();
    let (time, [format, lengths @ ..]) = (f64::from_bits(u64::from_le_bytes(head_time(&head))), head_lists(&head));
    let [q_domains, transform_domains, q, transforms] = lengths.map(&mut take);
    let raw = RawStepUpdate {
        number: 1,
        time,
        q_domains: indices(q_domains),
        q: bytes::Bytes::copy_from_slice(q),
        transform_domains: indices(transform_domains),
        transforms: bytes::Bytes::copy_from_slice(transforms),
        transform_format: match format % 3 {
            0 => TransformFormat::Affine,
            1 => TransformFormat::QuaternionXyzwF32,
            _ => TransformFormat::QuaternionXyzwF64,
        },
    };
    (raw, rest)
}

fn head_time(head: &[u8; HEAD_BYTES]) -> [u8; 8] {
    std::array::from_fn(|index| head[index])
}

/// The format of the transforms and the lengths of the lists.
fn head_lists(head: &[u8; HEAD_BYTES]) -> [u8; 5] {
    std::array::from_fn(|index| head[8 + index])
}
