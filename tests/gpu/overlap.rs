//! Readbacks that run while later steps are computed return the bits of their own step. An output is a set of device
//! buffers for the vertices of one step. A deformer allocates a second output when a step begins during a readback.

use std::collections::VecDeque;
use std::sync::Arc;

use modalcast_compute::gpu::{CudaDeformer, MAX_STEPS_IN_FLIGHT};
use modalcast_model::deform::{DeformedSurface, Deformer, VertexAttributes, VertexReadback};
use modalcast_model::domain::{Domain, FollowConstraint};
use modalcast_model::error::Error;
use modalcast_model::scene::{DeformationSettings, NormalMethod, Scene, SceneState, StorageType};

use crate::accuracy::{assert_equals_reference, have_equal_bits};
use crate::common::attributes::with_displacements_and_boxes;
use crate::common::{partial_steps, scene_of_shapes, strip_shape};
use crate::reference_comparison::cuda_deformer;
use crate::scenes::{self, Random};

/// Number of states per scene.
const STEPS: usize = 50;

/// Sixty domains: some of several tiles of 128 vertices, some of few quads (four consecutive vertices), some without
/// modes.
fn mixed_scene(deformation: DeformationSettings) -> Arc<Scene> {
    let mut random = Random(70);
    let mut shapes: Vec<_> = (0..16).map(|index| strip_shape(&mut random, 5 + index % 9, index % 5)).collect();
    shapes.push(scenes::random_shape(&mut random, 900, 33));
    shapes.extend((0..3).map(|index| scenes::random_shape(&mut random, 40 + index, 2)));
    let normal_maps = false;
    scene_of_shapes(shapes, 3, deformation, normal_maps)
}

/// Sixty domains: the first twenty are transform roots, and each other domain follows one of them.
fn follower_scene(deformation: DeformationSettings) -> Arc<Scene> {
    let mut random = Random(73);
    let mut parts =
        scenes::parts_of_shapes((0..20).map(|index| strip_shape(&mut random, 5 + 20 * index, index % 3)).collect());
    parts.deformation = deformation;
    let follow = |index: usize, random: &mut Random| {
        let is_mirrored = index.is_multiple_of(2);
        FollowConstraint { parent: index % 20, frame: random.next_similarity(is_mirrored) }
    };
    let domain = |index: usize| Domain {
        name: format!("domain {index}"),
        follows: (index >= 20).then(|| follow(index, &mut random)),
        ..scenes::new_domain(index * 3 % 20, scenes::PLAIN_MATERIAL)
    };
    parts.domains = (0..60).map(domain).collect();
    Scene::new(parts).expect("expected a valid scene")
}

/// A random set of less than a tenth of the domains on average, in ascending order.
fn random_domains(scene: &Scene, random: &mut Random) -> Vec<u32> {
    let probability = random.next_number().abs() / 10.0;
    (0..scene.domains.len() as u32).filter(|_| random.next_number().abs() < probability).collect()
}

/// A sequence of states with random dirty domains. In every 17th state, all domains are dirty.
fn states(scene: &Scene) -> Vec<SceneState> {
    let mut random = Random(71);
    let mut state = scenes::random_state(scene, 72);
    let next_state = |step: usize| {
        let (q_domains, mut transform_domains) =
            (random_domains(scene, &mut random), random_domains(scene, &mut random));
        if scene.features.followers {
            // Domains 0 to 19 are the roots. A root also moves its followers, so two roots already change many domains.
            transform_domains.retain(|domain| *domain < 20);
            transform_domains.truncate(2);
        }
        partial_steps::randomize_q_and_transforms(scene, &mut state, &mut random, &q_domains, &transform_domains);
        if step % 17 == 16 {
            state.mark_all_dirty();
        }
        state.clone()
    };
    (0..STEPS).map(next_state).collect()
}

/// The surface of each state, computed in full and read before the next step.
fn blocking_surfaces(scene: &Arc<Scene>, states: &[SceneState]) -> Vec<DeformedSurface> {
    let mut deformer = cuda_deformer(scene);
    let mut deform_fully = |state: &SceneState| {
        let mut dirty_state = state.clone();
        dirty_state.mark_all_dirty();
        deformer.deform(&dirty_state).expect("expected the step to succeed");
        deformer.surface().expect("expected a surface").clone()
    };
    states.iter().map(&mut deform_fully).collect()
}

/// Whether a readback has no tangents, and its other attributes have the bits of `want`.
fn equals_without_tangents(got: &DeformedSurface, want: &DeformedSurface) -> bool {
    have_equal_bits(&got.positions, &want.positions)
        && have_equal_bits(&got.normals, &want.normals)
        && have_equal_bits(&got.displacements, &want.displacements)
        && got.boxes == want.boxes
        && got.tangents.is_empty()
}

/// Waits for readbacks in order and compares each with the step that it belongs to.
struct Reader<'a> {
    /// Expected surface of each step.
    want: &'a [DeformedSurface],
    /// Steps and their readbacks, oldest first.
    pending: VecDeque<(usize, VertexReadback)>,
    /// Number of compared readbacks.
    compared_count: usize,
}

impl Reader<'_> {
    /// Compares the oldest readbacks until at most `max_pending` are left.
    fn compare(&mut self, deformer: &mut CudaDeformer, max_pending: usize) {
        while self.pending.len() > max_pending {
            let Some((step, readback)) = self.pending.pop_front() else { break };
            let surface = deformer.wait_readback(&readback).expect("expected the readback to complete");
            assert!(equals_without_tangents(&surface, &self.want[step]), "step {step}");
            // A second wait for the same readback returns the same memory.
            assert!(Arc::ptr_eq(
                &surface,
                &deformer.wait_readback(&readback).expect("expected the completed readback")
            ));
            let other_step = (step + STEPS / 2) % self.want.len();
            assert!(
                !equals_without_tangents(&surface, &self.want[other_step]),
                "negative control with step {other_step}"
            );
            self.compared_count += 1;
        }
    }
}

fn deformations() -> Vec<DeformationSettings> {
    let with_storage = |storage| DeformationSettings { storage, ..DeformationSettings::default() };
    let exact = DeformationSettings { normals: NormalMethod::Exact, ..with_storage(StorageType::F32) };
    vec![
        with_storage(StorageType::F32),
        exact,
        with_storage(StorageType::Int8),
        with_displacements_and_boxes(with_storage(StorageType::F32)),
    ]
}

/// A scene without followers for each of [`deformations`], and three scenes with followers.
fn all_scenes() -> Vec<Arc<Scene>> {
    let exact = DeformationSettings { normals: NormalMethod::Exact, ..DeformationSettings::default() };
    let follower_scenes =
        [DeformationSettings::default(), exact, with_displacements_and_boxes(DeformationSettings::default())]
            .map(follower_scene);
    deformations().into_iter().map(mixed_scene).chain(follower_scenes).collect()
}

/// Steps with random dirty domains, read back while up to five later steps run.
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_overlapped_reads_equal_blocking_reads() {
    for scene in all_scenes() {
        let states = states(&scene);
        let want = blocking_surfaces(&scene, &states);
        // Number of readbacks in flight when the oldest one is read.
        for max_pending in [0, 1, 2, 5] {
            let mut deformer = cuda_deformer(&scene);
            let mut reader = Reader { want: &want, pending: VecDeque::new(), compared_count: 0 };
            for (step, state) in states.iter().enumerate() {
                deformer.deform(state).expect("expected the step to succeed");
                // Some readbacks are dropped, and some steps start none.
                match step % 7 {
                    3 => drop(deformer.readback(VertexAttributes::ALL).expect("expected a readback to start")),
                    5 => {}
                    _ => reader.pending.push_back((
                        step,
                        deformer.readback(VertexAttributes::ALL).expect("expected a readback to start"),
                    )),
                }
                reader.compare(&mut deformer, max_pending);
            }
            reader.compare(&mut deformer, 0);
            assert_eq!(reader.compared_count, (0..STEPS).filter(|step| ![3, 5].contains(&(step % 7))).count());
            assert_eq!(deformer.outputs(), 2, "expected a second output for overlapped readbacks");
            assert!(equals_without_tangents(
                &without_tangents(deformer.surface().expect("expected a surface")),
                &want[STEPS - 1]
            ));
        }
        let (deformation, followers) = (scene.deformation, scene.features.followers);
        eprintln!(
            "{deformation:?}, followers {followers}: {STEPS} steps have equal bits with up to five readbacks in flight"
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
        let want = blocking_surfaces(&scene, &states);
        let bounds: Vec<_> = {
            let mut deformer = cuda_deformer(&scene);
            states.iter().map(|state| deformer.deform(state).expect("expected the step to succeed").bounds).collect()
        };
        assert_ne!(bounds[0], bounds[STEPS - 1], "expected states with different bounds");
        let mut deformer = cuda_deformer(&scene);
        let mut reader = Reader { want: &want, pending: VecDeque::new(), compared_count: 0 };
        for step in 0..STEPS + MAX_STEPS_IN_FLIGHT {
            if step >= MAX_STEPS_IN_FLIGHT {
                let finished_bounds = deformer.finish().expect("expected a finished step").bounds;
                assert_eq!(finished_bounds, bounds[step - MAX_STEPS_IN_FLIGHT], "step {}", step - MAX_STEPS_IN_FLIGHT);
            }
            if step < STEPS {
                deformer.submit(&states[step]).expect("expected the step to start");
                reader
                    .pending
                    .push_back((step, deformer.readback(VertexAttributes::ALL).expect("expected a readback to start")));
            }
            reader.compare(&mut deformer, MAX_STEPS_IN_FLIGHT);
        }
        reader.compare(&mut deformer, 0);
        assert_eq!(reader.compared_count, STEPS);
        if scene.deformation == DeformationSettings::default() && !scene.features.followers {
            assert_equals_reference("after overlapped steps", &scene, &scenes::random_state(&scene, 5), &mut deformer);
        }
    }
}

/// Readbacks started before the fault stay readable.
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_steps_after_a_fault_are_computed_in_full() {
    let scene = mixed_scene(DeformationSettings::default());
    let states = states(&scene);
    let want = blocking_surfaces(&scene, &states);
    let mut deformer = cuda_deformer(&scene);
    for step in 0..STEPS {
        deformer.submit(&states[step]).expect("expected the step to start");
        let readback = deformer.readback(VertexAttributes::ALL).expect("expected a readback to start");
        if step % 5 == 4 {
            // A failed step also calls `invalidate`.
            deformer.invalidate();
            assert!(
                matches!(deformer.readback(VertexAttributes::ALL), Err(Error::Fault { .. })),
                "expected no current surface"
            );
            assert!(matches!(deformer.finish(), Err(Error::Fault { .. })), "expected no step in flight");
        } else {
            deformer.finish().expect("expected a finished step");
        }
        assert!(
            equals_without_tangents(
                &deformer.wait_readback(&readback).expect("expected the readback to complete"),
                &want[step]
            ),
            "step {step}"
        );
    }
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_invalid_call_sequences_return_errors() {
    let scene = mixed_scene(DeformationSettings::default());
    let states = states(&scene);
    let want = blocking_surfaces(&scene, &states[..3]);
    let (mut deformer, mut other_deformer) = (cuda_deformer(&scene), cuda_deformer(&scene));
    assert!(
        matches!(deformer.readback(VertexAttributes::POSITIONS_AND_NORMALS), Err(Error::Fault { .. })),
        "expected no surface before the first step"
    );
    assert!(matches!(deformer.finish(), Err(Error::Fault { .. })));
    deformer.submit(&states[0]).expect("expected the step to start");
    deformer.submit(&states[1]).expect("expected the step to start");
    assert!(matches!(deformer.submit(&states[2]), Err(Error::Busy { limit: MAX_STEPS_IN_FLIGHT, .. })));
    // `deform` waits for the steps in flight.
    deformer.deform(&states[2]).expect("expected the step to succeed");
    other_deformer.deform(&states[0]).expect("expected the step to succeed");
    let foreign_readback =
        other_deformer.readback(VertexAttributes::POSITIONS_AND_NORMALS).expect("expected a readback to start");
    assert!(matches!(deformer.wait_readback(&foreign_readback), Err(Error::Fault { .. })));
    let own_readback =
        deformer.readback(VertexAttributes::POSITIONS_AND_NORMALS).expect("expected a readback to start");
    assert!(equals_without_tangents(
        &deformer.wait_readback(&own_readback).expect("expected the readback to complete"),
        &want[2]
    ));
    // Completed readbacks outlive the deformer.
    let outliving_surface = other_deformer.wait_readback(&foreign_readback).expect("expected the readback to complete");
    drop(other_deformer);
    assert!(equals_without_tangents(&outliving_surface, &want[0]));
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_second_output_exists_only_for_overlapped_reads() {
    let scene = mixed_scene(DeformationSettings::default());
    let states = states(&scene);
    let mut deformer = cuda_deformer(&scene);
    for state in &states[..10] {
        deformer.deform(state).expect("expected the step to succeed");
    }
    assert_eq!(deformer.outputs(), 1, "without readbacks");
    for state in &states[10..20] {
        deformer.deform(state).expect("expected the step to succeed");
        let readback = deformer.readback(VertexAttributes::ALL).expect("expected a readback to start");
        deformer.wait_readback(&readback).expect("expected the readback to complete");
        deformer.surface().expect("expected a surface");
    }
    assert_eq!(deformer.outputs(), 1, "with readbacks that complete before the next step");
    let readback = deformer.readback(VertexAttributes::ALL).expect("expected a readback to start");
    deformer.deform(&states[20]).expect("expected the step to succeed");
    // `surface` has already copied the vertices to the host, so the readback does not read the output.
    assert_eq!(deformer.outputs(), 1, "with a readback of an already copied surface");
    deformer.wait_readback(&readback).expect("expected the completed readback");
    let readback = deformer.readback(VertexAttributes::ALL).expect("expected a readback to start");
    deformer.deform(&states[21]).expect("expected the step to succeed");
    assert_eq!(deformer.outputs(), 2, "with a step that begins during a readback");
    deformer.wait_readback(&readback).expect("expected the readback to complete");
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_box_and_displacement_readers_need_no_second_output() {
    let scene = follower_scene(with_displacements_and_boxes(DeformationSettings::default()));
    let states = states(&scene);
    let want = blocking_surfaces(&scene, &states);
    let mut deformer = cuda_deformer(&scene);
    let requested = VertexAttributes { displacements: true, boxes: true, ..VertexAttributes::default() };
    let mut pending: Option<(usize, VertexReadback)> = None;
    for (step, state) in states.iter().enumerate() {
        deformer.deform(state).expect("expected the step to succeed");
        let readback = deformer.readback(requested).expect("expected a readback to start");
        assert!(readback.is_ready());
        if let Some((step, readback)) = pending.replace((step, readback)) {
            let got = deformer.wait_readback(&readback).expect("expected the completed readback");
            let expected = DeformedSurface {
                displacements: want[step].displacements.clone(),
                boxes: want[step].boxes.clone(),
                ..DeformedSurface::default()
            };
            assert!(equals_without_tangents(&got, &expected), "step {step}");
            assert!(got.boxes != want[(step + STEPS / 2) % STEPS].boxes, "negative control");
        }
        assert_eq!(deformer.outputs(), 1, "expected no second output for boxes and displacements");
    }
    // A readback of positions copies no other attribute.
    let positions = VertexAttributes { positions: true, ..VertexAttributes::default() };
    let readback = deformer.readback(positions).expect("expected a readback to start");
    deformer.deform(&states[0]).expect("expected the step to succeed");
    assert_eq!(deformer.outputs(), 2);
    let got = deformer.wait_readback(&readback).expect("expected the readback to complete");
    assert!(
        have_equal_bits(&got.positions, &want[STEPS - 1].positions) && got.normals.is_empty() && got.boxes.is_empty()
    );
}
