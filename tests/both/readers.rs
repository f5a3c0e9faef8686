//! Attributes that a scene keeps for readers: displacements, and a box per domain.

use std::sync::Arc;

use modalcast::config::{BackendChoice, Config, RendererChoice};
use modalcast::engine::DeviceContext;
use modalcast_model::backend_settings::BackendSettings;
use modalcast_model::deform::{Deformer, VertexAttributes};
use modalcast_model::domain::{Domain, Transform};
use modalcast_model::scene::{Bounds, DeformationSettings, Scene, SceneState, StorageType};

use super::extremes::columns_of;
use super::neighbors::has_one_item_per_lane;
use super::{StepResult, changes, displacements_beyond, displacements_within, run, scene_of, strip};
use crate::scenes::{self, NORMAL_MAPPED, Random};

/// The same deformation with displacements and boxes.
pub(crate) fn kept(deformation: DeformationSettings) -> DeformationSettings {
    DeformationSettings { displacements: true, boxes: true, ..deformation }
}

/// The first domain whose box differs from the bounds of its positions.
pub(crate) fn wrong_box(scene: &Scene, shown: &StepResult) -> Option<usize> {
    let slots = &scene.layout.slots;
    assert_eq!(shown.surface.boxes.len(), slots.len(), "a box of each domain");
    let from_positions = |domain: usize| {
        let positions = &shown.surface.positions[3 * slots[domain].first_vertex..][..3 * slots[domain].vertices];
        Bounds::from_positions(positions)
    };
    (0..slots.len()).find(|domain| shown.surface.boxes[*domain] != from_positions(*domain))
}

/// Numbers of vertices and ranks for every kind of tile: shared, own, and several per domain. With `many` there are so
/// many domains that a lane computes four vertices.
fn sizes(many: bool) -> Vec<(usize, usize)> {
    let few = [(1, 3), (7, 2), (9, 0), (31, 1), (64, 5), (65, 0), (130, 33), (1, 0), (300, 4)];
    let others = (0..900).map(|at| (3 + at % 9, at % 4)).chain([(4097, 0), (5000, 3)]);
    if many { others.collect() } else { few.to_vec() }
}

/// A scene with two domains per shape, or with `many` one domain per shape and 30 of the last.
fn scene(deformation: DeformationSettings, many: bool) -> Arc<Scene> {
    let mut random = Random(101);
    let shape = |(at, (vertices, rank)): (usize, (usize, usize))| match at % 2 {
        0 => strip(&mut random, vertices, rank),
        _ => scenes::shape(&mut random, vertices, rank),
    };
    let mut parts = scenes::parts(sizes(many).into_iter().enumerate().map(shape).collect());
    parts.deformation = deformation;
    let count = parts.shapes.len();
    let again = if many { vec![count - 1; 29] } else { (0..count).collect() };
    let domain = |(at, shape): (usize, usize)| Domain {
        name: format!("domain {at}"),
        ..scenes::domain(shape, if many { 0 } else { NORMAL_MAPPED })
    };
    parts.domains = (0..count).chain(again).enumerate().map(domain).collect();
    Scene::new(parts).expect("a scene")
}

/// Displacements are within their bound, boxes are tight, and vertices have the bits that they have without these
/// attributes.
pub(crate) fn displacements_and_boxes_equal_their_twins<D: Deformer>(make: impl Fn(&Arc<Scene>) -> D) {
    for (storage, compensated, many) in StorageType::ALL.into_iter().flat_map(|storage| {
        [(storage, false, false), (storage, true, false), (storage, storage == StorageType::Bf16, true)]
    }) {
        let plain = DeformationSettings { storage, compensated, ..DeformationSettings::default() };
        let (bare, kept) = (scene(plain, many), scene(kept(plain), many));
        let state = scenes::state(&kept, 102);
        let (without, with) = (run(&mut make(&bare), &state), run(&mut make(&kept), &state));
        assert_eq!(has_one_item_per_lane(&kept), !many);
        let name = format!("{}, compensated {compensated}, {} domains", storage.name(), kept.domains.len());
        assert!(without.surface.displacements.is_empty() && without.surface.boxes.is_empty(), "{name}");
        let mut vertices = with.clone();
        (vertices.surface.displacements, vertices.surface.boxes) = (vec![], vec![]);
        assert_eq!(vertices.difference(&without), None, "{name}: keeping changes no vertex");
        displacements_within(&name, (&kept, &state), &with.surface.displacements);
        assert_eq!(wrong_box(&kept, &with), None, "{name}");
        // Control: other coordinates exceed the bound of each domain with modes; the other domains have zeros.
        let mut other = state.clone();
        other.q.iter_mut().for_each(|number| *number = -*number);
        let bent: Vec<usize> = (0..kept.domains.len()).filter(|domain| kept.rank_of(*domain) > 0).collect();
        assert_eq!(displacements_beyond((&kept, &other), &with.surface.displacements), bent, "{name}");
        let mut spoilt = with.clone();
        spoilt.surface.positions[3 * kept.layout.slots[3].first_vertex] += 100.0;
        assert_eq!(wrong_box(&kept, &spoilt), Some(3), "{name}");
    }
}

/// A scene in which no domain has modes has zero displacements, and boxes.
pub(crate) fn a_scene_without_modes_has_zeros<D: Deformer>(make: impl Fn(&Arc<Scene>) -> D) {
    let mut random = Random(103);
    let shapes = vec![strip(&mut random, 7, 0), scenes::shape(&mut random, 300, 0)];
    let scene = scene_of(shapes, 2, kept(DeformationSettings::default()), false);
    assert!(!scene.needs.modes && scene.needs.displacements);
    let shown = run(&mut make(&scene), &scenes::state(&scene, 104));
    assert_eq!(shown.surface.displacements, vec![0.0; 3 * scene.layout.vertices]);
    assert_eq!(wrong_box(&scene, &shown), None);
}

/// Attributes read alone are those of the last step, and so are attributes read later.
pub(crate) fn parts_are_read_alone<D: Deformer>(make: impl Fn(&Arc<Scene>) -> D) {
    let scene = scene(kept(DeformationSettings::default()), false);
    let (mut deformer, mut random) = (make(&scene), Random(105));
    let mut state = scenes::state(&scene, 106);
    let mut last = run(&mut deformer, &state);
    let nothing = VertexAttributes::default();
    for (number, wanted) in [
        VertexAttributes { boxes: true, ..nothing },
        VertexAttributes { displacements: true, ..nothing },
        VertexAttributes { positions: true, ..nothing },
        VertexAttributes { displacements: true, boxes: true, ..nothing },
    ]
    .into_iter()
    .enumerate()
    {
        changes::apply(&scene, &mut state, &mut random, (&[1, 6, number as u32 + 8], &[2, 6]));
        let want = run(&mut make(&scene), &state);
        deformer.deform(&state).expect("deforms");
        let got = deformer.read(wanted).expect("copies").clone();
        let is = |wanted: bool, same: bool, moved: bool| !wanted || same && moved;
        let [new, old] = [&want.surface, &last.surface];
        assert!(is(wanted.boxes, got.boxes == new.boxes, new.boxes != old.boxes), "step {number}");
        let same = got.displacements == new.displacements;
        assert!(is(wanted.displacements, same, new.displacements != old.displacements), "step {number}");
        assert!(is(wanted.positions, got.positions == new.positions, new.positions != old.positions), "step {number}");
        let whole =
            StepResult { bounds: want.bounds, light: want.light, surface: deformer.surface().expect("copies").clone() };
        assert_eq!(whole.difference(&want), None, "step {number}: the rest comes after");
        last = want;
    }
}

/// A fetch returns the requested attributes of its own step and nothing else. Other requests for the same step succeed
/// too, and fetched data stay valid when later steps are computed.
pub(crate) fn parts_are_fetched_alone<D: Deformer>(make: impl Fn(&Arc<Scene>) -> D) {
    let scene = scene(kept(DeformationSettings::default()), false);
    let (mut deformer, mut random, mut state) = (make(&scene), Random(108), scenes::state(&scene, 109));
    let mut before = Vec::new();
    for step in 0..20 {
        changes::apply(&scene, &mut state, &mut random, (&[1, 6, step % 4 + 8], &[2, 6]));
        let want = run(&mut make(&scene), &state).surface;
        deformer.deform(&state).expect("deforms");
        let wishes = [step, step / 4 * 3 + 1, step * 7 + 2].map(|number| wish(number as usize % 16));
        let begun = wishes.map(|wanted| (wanted, deformer.readback(wanted).expect("begins")));
        for (want, begun) in std::mem::replace(&mut before, vec![(want, begun)]) {
            for (wanted, readback) in begun.iter().rev() {
                let got = deformer.wait_readback(readback).expect("arrives");
                let parts = [
                    (wanted.positions, got.positions == want.positions, got.positions.is_empty()),
                    (wanted.normals, got.normals == want.normals, got.normals.is_empty()),
                    (wanted.displacements, got.displacements == want.displacements, got.displacements.is_empty()),
                    (wanted.boxes, got.boxes == want.boxes, got.boxes.is_empty()),
                ];
                // A smaller request may receive the attributes of an earlier one.
                let is = |(wanted, same, empty): &(bool, bool, bool)| *same || !wanted && *empty;
                assert!(parts.iter().all(is) && got.tangents.is_empty(), "before step {step}: {wanted:?}, {parts:?}");
            }
        }
    }
    // Control: the next step has other attributes.
    let (last, _) = before.pop().expect("a step");
    changes::apply(&scene, &mut state, &mut random, (&[1, 6], &[2, 6]));
    let next = run(&mut deformer, &state).surface;
    assert!(last.positions != next.positions && last.normals != next.normals);
    assert!(last.displacements != next.displacements && last.boxes != next.boxes);
}

/// One of the sixteen combinations of attributes.
fn wish(number: usize) -> VertexAttributes {
    let bit = |at: usize| number >> at & 1 == 1;
    VertexAttributes { positions: bit(0), normals: bit(1), displacements: bit(2), boxes: bit(3) }
}

/// Modes of ones along x and y (twice) and along z, so that u is known.
fn ones(deformation: DeformationSettings) -> Arc<Scene> {
    let column = |row: [f32; 3]| row.repeat(5);
    let columns = [column([1.0, 1.0, 0.0]), column([1.0, 1.0, 0.0]), column([0.0, 0.0, 1.0])].concat();
    columns_of(5, columns, deformation)
}

/// Shrinks so much that x is finite where u overflows.
const TINY: Transform = Transform([1e-6, 0.0, 0.0, 0.0, 0.0, 1e-6, 0.0, 0.0, 0.0, 0.0, 1e-6, 0.0]);

/// A displacement in the range of f32 survives intermediate overflow. One that overflows is reported, even if x is
/// finite.
pub(crate) fn lost_displacements_are_told_and_others_survive<D: Deformer>(make: impl Fn(&Arc<Scene>) -> D) {
    for (storage, compensated) in StorageType::ALL.into_iter().flat_map(|storage| [(storage, false), (storage, true)]) {
        let plain = DeformationSettings { storage, compensated, ..DeformationSettings::default() };
        let name = format!("{}, compensated {compensated}", storage.name());
        let (bare, kept) = (ones(plain), ones(kept(plain)));
        let (mut without, mut with) = (make(&bare), make(&kept));
        let mut state = SceneState::rest(&kept);
        state.transforms[0] = TINY;
        // u is 6e38, which exceeds f32.
        state.q = vec![3e38, 3e38, 0.75];
        assert!(run(&mut without, &state).bounds.is_finite(), "{name}: x is finite");
        assert!(!run(&mut with, &state).bounds.is_finite(), "{name}: u is not");
        state.q = vec![1e38, 2e38, 0.75];
        let shown = run(&mut with, &state);
        assert!(shown.bounds.is_finite() && wrong_box(&kept, &shown).is_none(), "{name}: {:?}", shown.bounds);
        displacements_within(&name, (&kept, &state), &shown.surface.displacements);
    }
    // Partial sums overflow although the total is finite.
    let row = [1.0_f32, -1.0, 0.5].repeat(5);
    let scene =
        columns_of(5, [row.clone(), row.clone(), row.clone(), row].concat(), kept(DeformationSettings::default()));
    let mut state = SceneState::rest(&scene);
    (state.transforms[0], state.q) = (TINY, vec![3e38, 3e38, -3e38, -2.5e38]);
    let shown = run(&mut make(&scene), &state);
    assert!(shown.bounds.is_finite() && wrong_box(&scene, &shown).is_none(), "{:?}", shown.bounds);
    for u in shown.surface.displacements.chunks_exact(3) {
        let off = |got: f32, want: f32| (got - want).abs() / want.abs();
        let worst = off(u[0], 5e37).max(off(u[1], -5e37)).max(off(u[2], 2.5e37));
        assert!(worst < 1e-6, "{u:?}");
    }
}

/// A step with an overflowing displacement is refused with the name of its domain, and no reader sees it.
pub(crate) fn lost_displacements_are_refused_by_name(backend: BackendChoice) {
    let config = Config { backend, renderer: RendererChoice::Off, ..Config::default() };
    let mut bench = DeviceContext::open(&config).expect("a workbench");
    let scene = scene(kept(DeformationSettings::default()), false);
    let (mut staged, mut random) = (bench.load_scene(&scene, BackendSettings::default()).expect("stages"), Random(107));
    let mut good = SceneState::rest(&scene);
    changes::apply(&scene, &mut good, &mut random, (&[1, 4], &[4]));
    staged.deform(&good).expect("a good step");
    let before = staged.surface().expect("vertices").clone();
    for domain in [4, 6] {
        let mut bad = good.clone();
        changes::apply(&scene, &mut bad, &mut random, (&[domain as u32], &[domain as u32]));
        bad.transforms[domain] = Transform(TINY.0.map(|number| number * 1e-18));
        let slot = scene.layout.slots[domain];
        bad.q[slot.first_q..][..slot.rank].fill(f32::MAX);
        let refusal = staged.deform(&bad).expect_err("overflows").to_string();
        eprintln!("{refusal}");
        assert!(refusal.starts_with(&format!("step.q of domain 'domain {domain}'")), "{refusal}");
        assert_eq!(staged.surface().expect("vertices"), &before);
    }
    changes::apply(&scene, &mut good, &mut random, (&[8], &[]));
    staged.deform(&good).expect("a good step");
    assert_ne!(staged.surface().expect("vertices"), &before, "the judge can fail");
    bench.unload_scene(staged);
}
