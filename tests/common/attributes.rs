//! Optional vertex attributes of a scene: displacements, and a bounding box per domain.

use std::sync::Arc;

use modalcast::config::{BackendChoice, Config, RendererChoice};
use modalcast::engine::DeviceContext;
use modalcast_model::backend_settings::BackendSettings;
use modalcast_model::deform::{Deformer, VertexAttributes};
use modalcast_model::domain::{Domain, Transform};
use modalcast_model::scene::{BoundingBox, DeformationSettings, Scene, SceneState, StorageType};

use super::extreme_values::scene_from_columns;
use super::neighbors::has_one_item_per_lane;
use super::{
    StepResult, assert_displacements_within_bound, domains_beyond_displacement_bound, partial_steps, run_step,
    scene_of_shapes, strip_shape,
};
use crate::scenes::{self, NORMAL_MAPPED_MATERIAL, Random};

/// The given settings, with displacements and boxes enabled.
pub(crate) fn with_displacements_and_boxes(deformation: DeformationSettings) -> DeformationSettings {
    DeformationSettings { displacements: true, boxes: true, ..deformation }
}

/// The first domain whose box differs from the bounds of its positions.
pub(crate) fn find_wrong_box(scene: &Scene, result: &StepResult) -> Option<usize> {
    let layouts = &scene.layout.domains;
    assert_eq!(result.surface.boxes.len(), layouts.len(), "expected a box per domain");
    let position_bounds = |domain: usize| {
        let positions = &result.surface.positions[3 * layouts[domain].first_vertex..][..3 * layouts[domain].vertices];
        BoundingBox::from_positions(positions)
    };
    (0..layouts.len()).find(|domain| result.surface.boxes[*domain] != position_bounds(*domain))
}

/// Number of vertices and rank of each shape. A tile has at most 128 vertices: small domains share a tile, and large
/// domains have several. With `has_many_domains`, there are so many tiles that a lane (a GPU thread) computes four
/// vertices instead of one.
fn shape_sizes(has_many_domains: bool) -> Vec<(usize, usize)> {
    if has_many_domains {
        return (0..900).map(|index| (3 + index % 9, index % 4)).chain([(4097, 0), (5000, 3)]).collect();
    }
    vec![(1, 3), (7, 2), (9, 0), (31, 1), (64, 5), (65, 0), (130, 33), (1, 0), (300, 4)]
}

/// A scene with two domains per shape. With `has_many_domains`, the scene has one domain per shape and 29 further
/// domains of the last shape. Every other shape has more corners than vertices.
fn create_scene(deformation: DeformationSettings, has_many_domains: bool) -> Arc<Scene> {
    let mut random = Random(101);
    let create_shape = |(index, (vertices, rank)): (usize, (usize, usize))| match index % 2 {
        0 => strip_shape(&mut random, vertices, rank),
        _ => scenes::random_shape(&mut random, vertices, rank),
    };
    let shapes = shape_sizes(has_many_domains).into_iter().enumerate().map(create_shape).collect();
    let mut parts = scenes::parts_of_shapes(shapes);
    parts.deformation = deformation;
    let shape_count = parts.shapes.len();
    let further_shapes = if has_many_domains { vec![shape_count - 1; 29] } else { (0..shape_count).collect() };
    let create_domain = |(index, shape): (usize, usize)| Domain {
        name: format!("domain {index}"),
        ..scenes::new_domain(shape, if has_many_domains { scenes::PLAIN_MATERIAL } else { NORMAL_MAPPED_MATERIAL })
    };
    parts.domains = (0..shape_count).chain(further_shapes).enumerate().map(create_domain).collect();
    Scene::new(parts).expect("expected a valid scene")
}

/// Displacements are within their bound, boxes are tight, and vertices have the same bits as without these attributes.
pub(crate) fn check_displacements_and_boxes<D: Deformer>(create_deformer: impl Fn(&Arc<Scene>) -> D) {
    // Each storage type has two small scenes and one scene with many domains.
    for (storage, compensated, has_many_domains) in StorageType::ALL.into_iter().flat_map(|storage| {
        [(storage, false, false), (storage, true, false), (storage, storage == StorageType::Bf16, true)]
    }) {
        let deformation = DeformationSettings { storage, compensated, ..DeformationSettings::default() };
        let plain_scene = create_scene(deformation, has_many_domains);
        let scene = create_scene(with_displacements_and_boxes(deformation), has_many_domains);
        let state = scenes::random_state(&scene, 102);
        let (plain_result, result) =
            (run_step(&mut create_deformer(&plain_scene), &state), run_step(&mut create_deformer(&scene), &state));
        assert_eq!(has_one_item_per_lane(&scene), !has_many_domains);
        let name = format!("{}, compensated {compensated}, {} domains", storage.name(), scene.domains.len());
        assert!(plain_result.surface.displacements.is_empty() && plain_result.surface.boxes.is_empty(), "{name}");
        let mut result_without_attributes = result.clone();
        result_without_attributes.surface.displacements.clear();
        result_without_attributes.surface.boxes.clear();
        assert_eq!(
            result_without_attributes.difference(&plain_result),
            None,
            "{name}: expected the same vertices with and without attributes"
        );
        assert_displacements_within_bound(&name, &scene, &state, &result.surface.displacements);
        assert_eq!(find_wrong_box(&scene, &result), None, "{name}");
        // Negative control: with the opposite q, every domain with modes exceeds its bound. The displacements of the
        // other domains are zero for every q.
        let mut negated_state = state.clone();
        negated_state.q.iter_mut().for_each(|number| *number = -*number);
        let modal_domains: Vec<usize> = (0..scene.domains.len()).filter(|domain| scene.rank_of(*domain) > 0).collect();
        assert_eq!(
            domains_beyond_displacement_bound(&scene, &negated_state, &result.surface.displacements),
            modal_domains,
            "{name}"
        );
        // Negative control: a moved vertex of domain 3 makes the box of domain 3 wrong.
        let mut modified = result.clone();
        modified.surface.positions[3 * scene.layout.domains[3].first_vertex] += 100.0;
        assert_eq!(find_wrong_box(&scene, &modified), Some(3), "{name}");
    }
}

/// A scene in which no domain has modes has zero displacements and correct boxes.
pub(crate) fn check_scene_without_modes<D: Deformer>(create_deformer: impl Fn(&Arc<Scene>) -> D) {
    let mut random = Random(103);
    let shapes = vec![strip_shape(&mut random, 7, 0), scenes::random_shape(&mut random, 300, 0)];
    let (deformation, normal_maps) = (with_displacements_and_boxes(DeformationSettings::default()), false);
    let scene = scene_of_shapes(shapes, 2, deformation, normal_maps);
    assert!(!scene.features.modes && scene.features.displacements);
    let result = run_step(&mut create_deformer(&scene), &scenes::random_state(&scene, 104));
    assert_eq!(result.surface.displacements, vec![0.0; 3 * scene.layout.vertices]);
    assert_eq!(find_wrong_box(&scene, &result), None);
}

/// A read of some attributes returns their values in the last step. A read of all attributes succeeds afterwards.
pub(crate) fn check_separate_reads<D: Deformer>(create_deformer: impl Fn(&Arc<Scene>) -> D) {
    let has_many_domains = false;
    let scene = create_scene(with_displacements_and_boxes(DeformationSettings::default()), has_many_domains);
    let (mut deformer, mut random) = (create_deformer(&scene), Random(105));
    let mut state = scenes::random_state(&scene, 106);
    let mut previous = run_step(&mut deformer, &state);
    let no_attributes = VertexAttributes::default();
    for (step, requested) in [
        VertexAttributes { boxes: true, ..no_attributes },
        VertexAttributes { displacements: true, ..no_attributes },
        VertexAttributes { positions: true, ..no_attributes },
        VertexAttributes { displacements: true, boxes: true, ..no_attributes },
    ]
    .into_iter()
    .enumerate()
    {
        let (q_domains, transform_domains) = ([1, 6, step as u32 + 8], [2, 6]);
        partial_steps::randomize_q_and_transforms(&scene, &mut state, &mut random, &q_domains, &transform_domains);
        let expected = run_step(&mut create_deformer(&scene), &state);
        deformer.deform(&state).expect("expected the step to succeed");
        let actual = deformer.surface_with(requested).expect("expected a surface").clone();
        // The values must also differ from those of the previous step, so that a read of old values fails.
        let [new_surface, old_surface] = [&expected.surface, &previous.surface];
        if requested.boxes {
            assert!(actual.boxes == new_surface.boxes && new_surface.boxes != old_surface.boxes, "step {step}");
        }
        if requested.displacements {
            let is_new = new_surface.displacements != old_surface.displacements;
            assert!(actual.displacements == new_surface.displacements && is_new, "step {step}");
        }
        if requested.positions {
            assert!(
                actual.positions == new_surface.positions && new_surface.positions != old_surface.positions,
                "step {step}"
            );
        }
        let result_after_read = StepResult {
            bounds: expected.bounds,
            light_bounds: expected.light_bounds,
            surface: deformer.surface().expect("expected a surface").clone(),
        };
        assert_eq!(result_after_read.difference(&expected), None, "step {step}: after a partial read");
        previous = expected;
    }
}

/// A readback returns the requested attributes of its own step and no others. Several requests for the same step
/// succeed, and readbacks remain valid when later steps are computed.
pub(crate) fn check_separate_readbacks<D: Deformer>(create_deformer: impl Fn(&Arc<Scene>) -> D) {
    let has_many_domains = false;
    let scene = create_scene(with_displacements_and_boxes(DeformationSettings::default()), has_many_domains);
    let (mut deformer, mut random, mut state) =
        (create_deformer(&scene), Random(108), scenes::random_state(&scene, 109));
    let mut pending = Vec::new();
    for step in 0..20 {
        let (q_domains, transform_domains) = ([1, 6, step % 4 + 8], [2, 6]);
        partial_steps::randomize_q_and_transforms(&scene, &mut state, &mut random, &q_domains, &transform_domains);
        let expected = run_step(&mut create_deformer(&scene), &state).surface;
        deformer.deform(&state).expect("expected the step to succeed");
        // Three requests per step. The formulas only vary the combinations of the four attributes.
        let requests = [step, step / 4 * 3 + 1, step * 7 + 2].map(|bits| attributes_of_bits(bits as usize % 16));
        let readbacks =
            requests.map(|requested| (requested, deformer.readback(requested).expect("expected a readback to start")));
        // Check the readbacks of the previous step while those of this step are in flight.
        for (expected, readbacks) in std::mem::replace(&mut pending, vec![(expected, readbacks)]) {
            for (requested, readback) in readbacks.iter().rev() {
                let actual = deformer.wait_readback(readback).expect("expected the readback to complete");
                let comparisons = [
                    (requested.positions, actual.positions == expected.positions, actual.positions.is_empty()),
                    (requested.normals, actual.normals == expected.normals, actual.normals.is_empty()),
                    (
                        requested.displacements,
                        actual.displacements == expected.displacements,
                        actual.displacements.is_empty(),
                    ),
                    (requested.boxes, actual.boxes == expected.boxes, actual.boxes.is_empty()),
                ];
                // An attribute that is not requested is empty, unless another request for the same step includes it.
                let is_valid =
                    |(requested, is_equal, is_empty): &(bool, bool, bool)| *is_equal || !requested && *is_empty;
                assert!(
                    comparisons.iter().all(is_valid) && actual.tangents.is_empty(),
                    "the step before step {step}: {requested:?}, {comparisons:?}"
                );
            }
        }
    }
    // Negative control: the next step changes the values of all attributes.
    let (last_surface, _) = pending.pop().expect("expected a readback of the last step");
    let (q_domains, transform_domains) = ([1, 6], [2, 6]);
    partial_steps::randomize_q_and_transforms(&scene, &mut state, &mut random, &q_domains, &transform_domains);
    let next_surface = run_step(&mut deformer, &state).surface;
    assert!(last_surface.positions != next_surface.positions && last_surface.normals != next_surface.normals);
    assert!(last_surface.displacements != next_surface.displacements && last_surface.boxes != next_surface.boxes);
}

/// The attributes whose bit is set; `bits` is less than 16.
fn attributes_of_bits(bits: usize) -> VertexAttributes {
    let bit = |index: usize| bits >> index & 1 == 1;
    VertexAttributes { positions: bit(0), normals: bit(1), displacements: bit(2), boxes: bit(3) }
}

/// A scene with the displacement u = U q = (q0 + q1, q0 + q1, q2) at each of five vertices.
fn scene_of_ones(deformation: DeformationSettings) -> Arc<Scene> {
    let column = |row: [f32; 3]| row.repeat(5);
    let columns = [column([1.0, 1.0, 0.0]), column([1.0, 1.0, 0.0]), column([0.0, 0.0, 1.0])].concat();
    scene_from_columns(5, columns, deformation)
}

/// Scales by 1e-6, so that x is finite where u overflows.
const TINY_SCALE: Transform = Transform([1e-6, 0.0, 0.0, 0.0, 0.0, 1e-6, 0.0, 0.0, 0.0, 0.0, 1e-6, 0.0]);

/// A displacement that overflows is reported, even if x is finite. A displacement in the range of f32 is correct, even
/// if partial sums overflow.
pub(crate) fn check_displacement_overflow<D: Deformer>(create_deformer: impl Fn(&Arc<Scene>) -> D) {
    for (storage, compensated) in StorageType::ALL.into_iter().flat_map(|storage| [(storage, false), (storage, true)]) {
        let deformation = DeformationSettings { storage, compensated, ..DeformationSettings::default() };
        let name = format!("{}, compensated {compensated}", storage.name());
        let (plain_scene, scene) =
            (scene_of_ones(deformation), scene_of_ones(with_displacements_and_boxes(deformation)));
        let (mut plain_deformer, mut deformer) = (create_deformer(&plain_scene), create_deformer(&scene));
        let mut state = SceneState::rest(&scene);
        state.transforms[0] = TINY_SCALE;
        // u is 6e38; the largest f32 is 3.4e38.
        state.q = vec![3e38, 3e38, 0.75];
        assert!(run_step(&mut plain_deformer, &state).bounds.is_finite(), "{name}: expected a finite x");
        assert!(
            !run_step(&mut deformer, &state).bounds.is_finite(),
            "{name}: expected the overflow of u to be reported"
        );
        state.q = vec![1e38, 2e38, 0.75];
        let result = run_step(&mut deformer, &state);
        assert!(result.bounds.is_finite() && find_wrong_box(&scene, &result).is_none(), "{name}: {:?}", result.bounds);
        assert_displacements_within_bound(&name, &scene, &state, &result.surface.displacements);
    }
    // u = (q0 + q1 + q2 + q3) (1, -1, 0.5). The partial sum q0 + q1 is 6e38 and overflows, the total is 5e37.
    let row = [1.0_f32, -1.0, 0.5].repeat(5);
    let scene = scene_from_columns(
        5,
        [row.clone(), row.clone(), row.clone(), row].concat(),
        with_displacements_and_boxes(DeformationSettings::default()),
    );
    let mut state = SceneState::rest(&scene);
    (state.transforms[0], state.q) = (TINY_SCALE, vec![3e38, 3e38, -3e38, -2.5e38]);
    let result = run_step(&mut create_deformer(&scene), &state);
    assert!(result.bounds.is_finite() && find_wrong_box(&scene, &result).is_none(), "{:?}", result.bounds);
    for u in result.surface.displacements.chunks_exact(3) {
        let expected = [5e37_f32, -5e37, 2.5e37];
        let mut relative_errors =
            u.iter().zip(expected).map(|(actual, expected)| ((actual - expected) / expected).abs());
        assert!(relative_errors.all(|error| error < 1e-6), "expected {expected:?}, got {u:?}");
    }
}

/// A step with an overflowing displacement is rejected with the name of its domain, and the vertices of the last valid
/// step remain readable.
pub(crate) fn check_displacement_overflow_rejection(backend: BackendChoice) {
    let config = Config { backend, renderer: RendererChoice::Off, ..Config::default() };
    let mut context = DeviceContext::open(&config).expect("expected a device context");
    let has_many_domains = false;
    let scene = create_scene(with_displacements_and_boxes(DeformationSettings::default()), has_many_domains);
    let (mut loaded_scene, mut random) =
        (context.load_scene(&scene, BackendSettings::default()).expect("expected the scene to load"), Random(107));
    let mut valid_state = SceneState::rest(&scene);
    let (q_domains, transform_domains) = ([1, 4], [4]);
    partial_steps::randomize_q_and_transforms(&scene, &mut valid_state, &mut random, &q_domains, &transform_domains);
    loaded_scene.deform(&valid_state).expect("expected a valid step");
    let valid_surface = loaded_scene.surface().expect("expected a surface").clone();
    for domain in [4, 6] {
        let mut overflowing_state = valid_state.clone();
        partial_steps::randomize_q_and_transforms(
            &scene,
            &mut overflowing_state,
            &mut random,
            &[domain as u32],
            &[domain as u32],
        );
        // A scale of 1e-24 keeps x finite, so that only u overflows.
        overflowing_state.transforms[domain] = Transform(TINY_SCALE.0.map(|entry| entry * 1e-18));
        let layout = scene.layout.domains[domain];
        overflowing_state.q[layout.first_q..][..layout.rank].fill(f32::MAX);
        let error = loaded_scene.deform(&overflowing_state).expect_err("expected an overflow error").to_string();
        eprintln!("{error}");
        assert!(error.starts_with("step.q: ") && error.contains(&format!("of domain 'domain {domain}'")), "{error}");
        assert_eq!(loaded_scene.surface().expect("expected a surface"), &valid_surface);
    }
    // The next valid step sets only q of domain 8.
    partial_steps::randomize_q_and_transforms(&scene, &mut valid_state, &mut random, &[8], &[]);
    loaded_scene.deform(&valid_state).expect("expected a valid step");
    assert_ne!(
        loaded_scene.surface().expect("expected a surface"),
        &valid_surface,
        "expected the step to change vertices"
    );
    context.unload_scene(loaded_scene);
}
