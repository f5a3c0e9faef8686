//! Vertices fetched while later steps run are those of their own step, bit by bit.

use std::collections::VecDeque;
use std::sync::Arc;

use modalcast_compute::gpu::{CudaDeformer, MAX_STEPS_IN_FLIGHT};
use modalcast_model::deform::{DeformedSurface, Deformer, VertexAttributes, VertexReadback};
use modalcast_model::domain::{Domain, FollowConstraint};
use modalcast_model::error::Error;
use modalcast_model::scene::{DeformationSettings, NormalMethod, Scene, SceneState, StorageType};

use crate::accuracy::{check, same_bits};
use crate::both::readers::kept;
use crate::both::{self, changes};
use crate::scenes::{self, Random};
use crate::twins::deformer;

const STEPS: usize = 50;

/// Sixty domains: some of several tiles, some of few quads, some without modes.
fn crowd(deformation: DeformationSettings) -> Arc<Scene> {
    let mut random = Random(70);
    let mut shapes: Vec<_> = (0..16).map(|at| both::strip(&mut random, 5 + at % 9, at % 5)).collect();
    shapes.push(scenes::shape(&mut random, 900, 33));
    shapes.extend((0..3).map(|at| scenes::shape(&mut random, 40 + at, 2)));
    both::scene_of(shapes, 3, deformation, false)
}

/// Sixty domains: the first twenty are transform roots, and each other domain follows one of them.
fn following(deformation: DeformationSettings) -> Arc<Scene> {
    let mut random = Random(73);
    let mut parts = scenes::parts((0..20).map(|at| both::strip(&mut random, 5 + 20 * at, at % 3)).collect());
    parts.deformation = deformation;
    let follow = |at: usize, random: &mut Random| FollowConstraint {
        parent: at % 20,
        frame: random.similarity(at.is_multiple_of(2)),
    };
    let domain = |at: usize| Domain {
        name: format!("domain {at}"),
        follows: (at >= 20).then(|| follow(at, &mut random)),
        ..scenes::domain(at * 3 % 20, 0)
    };
    parts.domains = (0..60).map(domain).collect();
    Scene::new(parts).expect("a scene")
}

/// A random set of domains without duplicates, in ascending order.
fn some(scene: &Scene, random: &mut Random) -> Vec<u32> {
    let share = random.number().abs() / 10.0;
    (0..scene.domains.len() as u32).filter(|_| random.number().abs() < share).collect()
}

/// A sequence of states with random lists of changes; every 17th marks every domain as changed.
fn states(scene: &Scene) -> Vec<SceneState> {
    let mut random = Random(71);
    let mut state = scenes::state(scene, 72);
    let next = |at: usize| {
        let (q, mut transforms) = (some(scene, &mut random), some(scene, &mut random));
        if scene.needs.followers {
            // Each root moves its followers too, so few roots already change many domains.
            transforms.retain(|domain| *domain < 20);
            transforms.truncate(2);
        }
        changes::apply(scene, &mut state, &mut random, (&q, &transforms));
        if at % 17 == 16 {
            state.mark_all_dirty();
        }
        state.clone()
    };
    (0..STEPS).map(next).collect()
}

/// Surfaces of each step, computed in full and read before the next step.
fn plainly(scene: &Arc<Scene>, states: &[SceneState]) -> Vec<DeformedSurface> {
    let mut deformer = deformer(scene);
    let mut show = |state: &SceneState| {
        let mut whole = state.clone();
        whole.mark_all_dirty();
        deformer.deform(&whole).expect("deforms");
        deformer.surface().expect("copies").clone()
    };
    states.iter().map(&mut show).collect()
}

fn is(got: &DeformedSurface, want: &DeformedSurface) -> bool {
    same_bits(&got.positions, &want.positions)
        && same_bits(&got.normals, &want.normals)
        && same_bits(&got.displacements, &want.displacements)
        && got.boxes == want.boxes
        && got.tangents.is_empty()
}

/// Reads fetches in order and compares each with the step in which it was started.
struct Reader<'a> {
    want: &'a [DeformedSurface],
    waiting: VecDeque<(usize, VertexReadback)>,
    read: usize,
}

impl Reader<'_> {
    fn read(&mut self, deformer: &mut CudaDeformer, behind: usize) {
        while self.waiting.len() > behind {
            let Some((step, readback)) = self.waiting.pop_front() else { break };
            let surface = deformer.wait_readback(&readback).expect("arrives");
            assert!(is(&surface, &self.want[step]), "step {step}");
            // A second read returns the same memory.
            assert!(Arc::ptr_eq(&surface, &deformer.wait_readback(&readback).expect("is there")));
            let other = (step + STEPS / 2) % self.want.len();
            assert!(!is(&surface, &self.want[other]), "the judge can fail");
            self.read += 1;
        }
    }
}

fn deformations() -> Vec<DeformationSettings> {
    let plain = |storage| DeformationSettings { storage, ..DeformationSettings::default() };
    let exact = DeformationSettings { normals: NormalMethod::Exact, ..plain(StorageType::F32) };
    let truncated = DeformationSettings { truncation: Some(1e-9), ..plain(StorageType::F32) };
    vec![plain(StorageType::F32), exact, plain(StorageType::Int8), truncated, kept(plain(StorageType::F32))]
}

/// Scenes of all deformations, some of them also with followers.
fn all_scenes() -> Vec<Arc<Scene>> {
    let exact = DeformationSettings { normals: NormalMethod::Exact, ..DeformationSettings::default() };
    let followed = [DeformationSettings::default(), exact, kept(DeformationSettings::default())].map(following);
    deformations().into_iter().map(crowd).chain(followed).collect()
}

/// Fifty steps with random lists of changes, read while up to five later steps run.
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_overlapped_reads_equal_blocking_reads() {
    for scene in all_scenes() {
        let states = states(&scene);
        let want = plainly(&scene, &states);
        // Number of fetches in flight when the oldest one is read.
        for late in [0, 1, 2, 5] {
            let mut deformer = deformer(&scene);
            let mut reader = Reader { want: &want, waiting: VecDeque::new(), read: 0 };
            for (step, state) in states.iter().enumerate() {
                deformer.deform(state).expect("deforms");
                // Some steps are fetched and never read, some are not fetched.
                match step % 7 {
                    3 => drop(deformer.readback(VertexAttributes::ALL).expect("begins")),
                    5 => {}
                    _ => reader.waiting.push_back((step, deformer.readback(VertexAttributes::ALL).expect("begins"))),
                }
                reader.read(&mut deformer, late);
            }
            reader.read(&mut deformer, 0);
            assert_eq!(reader.read, (0..STEPS).filter(|step| ![3, 5].contains(&(step % 7))).count());
            assert_eq!(deformer.outputs(), 2, "steps were fetched beside steps");
            assert!(is(&without_tangents(deformer.surface().expect("copies")), &want[STEPS - 1]));
        }
        let (deformation, followers) = (scene.deformation, scene.needs.followers);
        eprintln!(
            "{deformation:?}, followers {followers}: {STEPS} steps agree bit by bit, read at once and up to five steps late"
        );
    }
}

fn without_tangents(surface: &DeformedSurface) -> DeformedSurface {
    DeformedSurface { tangents: vec![], ..surface.clone() }
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_two_steps_in_flight_keep_their_own_results() {
    for scene in all_scenes() {
        let states = states(&scene);
        let want = plainly(&scene, &states);
        let bounds: Vec<_> = {
            let mut one = deformer(&scene);
            states.iter().map(|state| one.deform(state).expect("deforms").bounds).collect()
        };
        assert_ne!(bounds[0], bounds[STEPS - 1], "the judge can fail");
        let mut deformer = deformer(&scene);
        let mut reader = Reader { want: &want, waiting: VecDeque::new(), read: 0 };
        for step in 0..STEPS + MAX_STEPS_IN_FLIGHT {
            if step >= MAX_STEPS_IN_FLIGHT {
                let told = deformer.finish().expect("ends").bounds;
                assert_eq!(told, bounds[step - MAX_STEPS_IN_FLIGHT], "step {}", step - MAX_STEPS_IN_FLIGHT);
            }
            if step < STEPS {
                deformer.submit(&states[step]).expect("starts");
                reader.waiting.push_back((step, deformer.readback(VertexAttributes::ALL).expect("begins")));
            }
            reader.read(&mut deformer, MAX_STEPS_IN_FLIGHT);
        }
        reader.read(&mut deformer, 0);
        assert_eq!(reader.read, STEPS);
        if scene.deformation == DeformationSettings::default() && !scene.needs.followers {
            check("after it all", &scene, &scenes::state(&scene, 5), &mut deformer);
        }
    }
}

/// Fetches from before the fault stay readable.
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_steps_after_a_fault_are_computed_in_full() {
    let scene = crowd(DeformationSettings::default());
    let states = states(&scene);
    let want = plainly(&scene, &states);
    let mut deformer = deformer(&scene);
    for step in 0..STEPS {
        deformer.submit(&states[step]).expect("starts");
        let readback = deformer.readback(VertexAttributes::ALL).expect("begins");
        if step % 5 == 4 {
            // As after a failed step: no result counts as complete.
            deformer.invalidate();
            assert!(matches!(deformer.readback(VertexAttributes::ALL), Err(Error::Fault { .. })), "nothing is whole");
            assert!(matches!(deformer.finish(), Err(Error::Fault { .. })), "nothing is under way");
        } else {
            deformer.finish().expect("ends");
        }
        assert!(is(&deformer.wait_readback(&readback).expect("arrives"), &want[step]), "step {step}");
    }
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_invalid_call_sequences_are_refused() {
    let scene = crowd(DeformationSettings::default());
    let states = states(&scene);
    let want = plainly(&scene, &states[..3]);
    let (mut one, mut other) = (deformer(&scene), deformer(&scene));
    assert!(matches!(one.readback(VertexAttributes::VERTICES), Err(Error::Fault { .. })), "nothing was deformed");
    assert!(matches!(one.finish(), Err(Error::Fault { .. })));
    one.submit(&states[0]).expect("starts");
    one.submit(&states[1]).expect("starts");
    assert!(matches!(one.submit(&states[2]), Err(Error::Busy { limit: MAX_STEPS_IN_FLIGHT, .. })));
    // A blocking step waits for the steps before it.
    one.deform(&states[2]).expect("deforms");
    other.deform(&states[0]).expect("deforms");
    let strange = other.readback(VertexAttributes::VERTICES).expect("begins");
    assert!(matches!(one.wait_readback(&strange), Err(Error::Fault { .. })));
    let own = one.readback(VertexAttributes::VERTICES).expect("begins");
    assert!(is(&one.wait_readback(&own).expect("arrives"), &want[2]));
    // Data that were read outlive the deformer.
    let kept = other.wait_readback(&strange).expect("arrives");
    drop(other);
    assert!(is(&kept, &want[0]));
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_second_output_exists_only_for_overlapped_reads() {
    let scene = crowd(DeformationSettings::default());
    let states = states(&scene);
    let mut deformer = deformer(&scene);
    for state in &states[..10] {
        deformer.deform(state).expect("deforms");
    }
    assert_eq!(deformer.outputs(), 1, "nobody reads");
    for state in &states[10..20] {
        deformer.deform(state).expect("deforms");
        let readback = deformer.readback(VertexAttributes::ALL).expect("begins");
        deformer.wait_readback(&readback).expect("arrives");
        deformer.surface().expect("copies");
    }
    assert_eq!(deformer.outputs(), 1, "every step is read before the next");
    let readback = deformer.readback(VertexAttributes::ALL).expect("begins");
    deformer.deform(&states[20]).expect("deforms");
    assert_eq!(deformer.outputs(), 1, "it was waited for already");
    deformer.wait_readback(&readback).expect("is there");
    let readback = deformer.readback(VertexAttributes::ALL).expect("begins");
    deformer.deform(&states[21]).expect("deforms");
    assert_eq!(deformer.outputs(), 2);
    deformer.wait_readback(&readback).expect("arrives");
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_box_and_displacement_readers_need_no_second_output() {
    let scene = following(kept(DeformationSettings::default()));
    let states = states(&scene);
    let want = plainly(&scene, &states);
    let mut deformer = deformer(&scene);
    let wanted = VertexAttributes { displacements: true, boxes: true, ..VertexAttributes::default() };
    let mut before: Option<(usize, VertexReadback)> = None;
    for (step, state) in states.iter().enumerate() {
        deformer.deform(state).expect("deforms");
        let readback = deformer.readback(wanted).expect("begins");
        assert!(readback.is_ready());
        if let Some((step, readback)) = before.replace((step, readback)) {
            let got = deformer.wait_readback(&readback).expect("is there");
            let alone = DeformedSurface {
                displacements: want[step].displacements.clone(),
                boxes: want[step].boxes.clone(),
                ..DeformedSurface::default()
            };
            assert!(is(&got, &alone), "step {step}");
            assert!(got.boxes != want[(step + STEPS / 2) % STEPS].boxes, "the judge can fail");
        }
        assert_eq!(deformer.outputs(), 1, "nobody reads an output");
    }
    // Only positions are copied, and the fetch waits for nothing else.
    let positions = VertexAttributes { positions: true, ..VertexAttributes::default() };
    let readback = deformer.readback(positions).expect("begins");
    deformer.deform(&states[0]).expect("deforms");
    assert_eq!(deformer.outputs(), 2);
    let got = deformer.wait_readback(&readback).expect("arrives");
    assert!(same_bits(&got.positions, &want[STEPS - 1].positions) && got.normals.is_empty() && got.boxes.is_empty());
}
