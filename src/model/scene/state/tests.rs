//! Change lists of steps, distant translations, and merged steps.

use super::*;
use crate::domain::{Domain, Material, Mesh, Metadata, Modes, Shape};
use crate::scene::{ORIGIN_GRID, RawStepUpdate, SceneParts, TransformFormat};

/// Domains of one vertex and two modes. Domains 2 and 4 share the coordinates of domain 1; domain 5 has no modes.
fn scene(count: usize) -> Arc<Scene> {
    let mesh =
        || Mesh::from_indexed(vec![[0.5, 0.25, 1.0]], vec![[0.0, 0.0, 1.0]], vec![], vec![[0, 0, 0]]).expect("a point");
    let modes = Modes::from_columns(3, 2, vec![1.0, 0.0, 0.0, 0.0, 1.0, 0.0]).expect("3 x 2");
    let mut parts = SceneParts::named("points");
    parts.shapes = vec![Shape::new(mesh(), modes).expect("fits"), Shape::new(mesh(), Modes::rigid()).expect("rigid")];
    parts.materials = vec![Material::default()];
    let domain = |index: usize| Domain {
        name: format!("point {index}"),
        shape: usize::from(index == 5),
        material: 0,
        material_ranges: vec![],
        placement: Transform::IDENTITY,
        attachment: None,
        follows: None,
        rest_q: vec![],
        shares_q_with: [(2, 1), (4, 2)].into_iter().find(|(own, _)| *own == index).map(|(_, twin)| twin),
        metadata: Metadata::default(),
    };
    parts.domains = (0..count).map(domain).collect();
    Scene::new(parts).expect("a scene")
}

fn q(domains: &[u32], values: &[f32]) -> RawStepUpdate {
    let q = values.iter().flat_map(|number| number.to_le_bytes()).collect();
    RawStepUpdate { q_domains: domains.to_vec(), q, ..RawStepUpdate::default() }
}

/// A step with f64 translations without rotation.
fn far(domains: &[u32], translations: &[[f64; 3]]) -> RawStepUpdate {
    let one = |translation: &[f64; 3]| {
        let rotation = [0.0, 0.0, 0.0, 1.0_f32].into_iter().flat_map(f32::to_le_bytes);
        rotation.chain(translation.iter().flat_map(|number| number.to_le_bytes())).collect::<Vec<u8>>()
    };
    RawStepUpdate {
        transform_domains: domains.to_vec(),
        transforms: translations.iter().flat_map(one).collect(),
        transform_format: TransformFormat::RigidF64,
        ..RawStepUpdate::default()
    }
}

/// A step with an f32 translation without rotation.
fn near(domain: u32, [x, y, z]: [f32; 3]) -> RawStepUpdate {
    let entries = [1.0, 0.0, 0.0, x, 0.0, 1.0, 0.0, y, 0.0, 0.0, 1.0, z];
    let transforms = entries.iter().flat_map(|number: &f32| number.to_le_bytes()).collect();
    RawStepUpdate { transform_domains: vec![domain], transforms, ..RawStepUpdate::default() }
}

fn parse(scene: &Scene, raw: &RawStepUpdate) -> StepUpdate {
    StepUpdate::parse(scene, raw).expect("a good step")
}

fn after(scene: &Scene, steps: &[RawStepUpdate]) -> SceneState {
    let mut state = SceneState::rest(scene);
    steps.iter().for_each(|raw| state.apply(scene, &parse(scene, raw)));
    state
}

/// The f64 position of a domain as stored in the state.
fn place(state: &SceneState, domain: usize) -> [f64; 3] {
    let (cell, own) = (state.origin_of(domain), state.transforms[domain].translation());
    std::array::from_fn(|axis| cell[axis] + own[axis])
}

#[test]
fn a_step_lists_the_domains_that_it_names_and_those_that_share_their_coordinates() {
    let scene = scene(7);
    let rest = SceneState::rest(&scene);
    assert_eq!((rest.serial, &rest.changed), (0, &DirtyDomains::All));
    let mut state = rest;
    for (serial, (raw, listed)) in [
        (q(&[3, 0], &[0.0; 4]), vec![0, 3]),
        (q(&[1], &[1.0, 2.0]), vec![1, 2, 4]),
        (q(&[4], &[1.0, 2.0]), vec![1, 2, 4]),
        (q(&[2, 6], &[0.0; 4]), vec![1, 2, 4, 6]),
        // A domain without modes has the same `first_q` as the next one but shares no coordinates with it.
        (q(&[5], &[]), vec![5]),
        (near(6, [1.0; 3]), vec![6]),
        (RawStepUpdate { q_domains: vec![4], q: vec![0; 8].into(), ..near(2, [1.0; 3]) }, vec![1, 2, 4]),
        (RawStepUpdate::default(), vec![]),
    ]
    .into_iter()
    .enumerate()
    {
        state.apply(&scene, &parse(&scene, &raw));
        assert_eq!((state.serial, &state.changed), (serial as u64 + 1, &DirtyDomains::Some(listed)));
    }
    state.mark_all_dirty();
    assert_eq!((state.serial, &state.changed), (9, &DirtyDomains::All));
}

#[test]
fn vertices_kept_from_the_last_state_are_right_with_the_list_and_wrong_without_an_entry_of_it() {
    let scene = scene(7);
    let vertices = |state: &SceneState, kept: &[f64], list: &[u32]| {
        let whole = fingerprints(&scene, state);
        let mut mixed = kept.to_vec();
        list.iter().for_each(|domain| mixed[*domain as usize] = whole[*domain as usize]);
        (mixed, whole)
    };
    let mut state = SceneState::rest(&scene);
    let mut kept = fingerprints(&scene, &state);
    for raw in [q(&[1], &[0.5, 2.0]), near(3, [1.0, 2.0, 3.0]), q(&[4, 0], &[1.0, -1.0, 3.0, 4.0])] {
        state.apply(&scene, &parse(&scene, &raw));
        let DirtyDomains::Some(list) = &state.changed else { panic!("a list") };
        let (mixed, whole) = vertices(&state, &kept, list);
        assert_eq!(mixed, whole);
        for left_out in 0..list.len() {
            let mut short = list.clone();
            short.remove(left_out);
            assert_ne!(vertices(&state, &kept, &short).0, whole, "{left_out} of {list:?}");
        }
        kept = whole;
    }
}

/// One number per domain that depends on all of its q and T.
fn fingerprints(scene: &Scene, state: &SceneState) -> Vec<f64> {
    let of = |domain: usize| {
        let q: f64 = state.q_of(scene, domain).iter().zip([1.0, 10.0]).map(|(q, weight)| f64::from(*q) * weight).sum();
        let t: f64 =
            state.transforms[domain].0.iter().zip(1..).map(|(t, weight)| f64::from(*t) * f64::from(weight)).sum();
        q + 1000.0 * t
    };
    (0..scene.domains.len()).map(of).collect()
}

#[test]
fn a_scene_that_never_sees_f64_has_no_cells_and_one_that_stays_near_keeps_its_origin() {
    let scene = scene(3);
    let state = after(&scene, &[near(1, [1e6, 0.0, 0.0])]);
    assert_eq!((state.origins.as_ref(), state.transforms[1].0[3]), (None, 1e6));
    let state = after(&scene, &[far(&[0, 1], &[[4096.0, -4096.0, 0.1], [1.0, 2.0, 3.0]])]);
    assert_eq!((state.origin_of(0), state.transforms[0].0[11]), ([0.0; 3], 0.1));
    assert_eq!(state.changed, DirtyDomains::Some(vec![0, 1]));
    assert!(state.origins.is_some_and(|origins| origins.is_uniform()));
}

#[test]
fn a_domain_ten_thousand_kilometres_away_has_a_cell_of_its_own_and_the_others_stay() {
    let scene = scene(3);
    let at = [1e7 + 0.001, -1e7 - 0.002, 3.0];
    let mut state = after(&scene, &[far(&[2], &[at])]);
    assert_eq!(state.changed, DirtyDomains::Some(vec![2]));
    assert_eq!(
        (state.origin_of(0), state.origin_of(2)),
        ([0.0; 3], [9766.0 * ORIGIN_GRID, -9766.0 * ORIGIN_GRID, 0.0])
    );
    let error = (0..3).map(|axis| (place(&state, 2)[axis] - at[axis]).abs()).fold(0.0, f64::max);
    assert!(error <= 2e-5, "{error} units");
    assert!((f64::from(at[0] as f32) - at[0]).abs() > 5e-4, "the control: f32 alone loses the millimetre");
    // An f32 translation also moves the domain, exactly, and it may return.
    state.apply(&scene, &parse(&scene, &near(2, [1e6 + 1.0, 0.0, 0.0])));
    assert_eq!((place(&state, 2), state.origin_of(2)), ([1e6 + 1.0, 0.0, 0.0], [977.0 * ORIGIN_GRID, 0.0, 0.0]));
    state.apply(&scene, &parse(&scene, &near(2, [5.0, 6.0, 7.0])));
    assert_eq!((state.transforms[2].0[3], state.origin_of(2)), (5.0, [0.0; 3]));
}

#[test]
fn a_scene_that_leaves_as_a_whole_takes_its_origin_along_but_for_those_who_stay_behind() {
    let scene = scene(5);
    let off = |shift: f64| [0.0, 1.0, 2.0, 3.0].map(|at| [shift + at, 0.25, -shift]);
    // The first two of five domains leave alone; after the third, most have left.
    let steps = [far(&[0, 1], &off(1e7)[..2]), far(&[2, 3], &off(1e7)[2..])];
    let state = after(&scene, &steps[..1]);
    assert_eq!(
        (state.origin_of(1), state.origin_of(4)),
        ([9766.0 * ORIGIN_GRID, 0.0, -9766.0 * ORIGIN_GRID], [0.0; 3])
    );
    assert_eq!(state.origins.as_ref().map(|origins| origins.shared()), Some([0.0; 3]));
    let mut state = after(&scene, &steps);
    assert_eq!((state.serial, &state.changed), (2, &DirtyDomains::All), "every transform was expressed anew");
    assert_eq!(
        state.origins.as_ref().map(|origins| (origins.shared(), origins.is_uniform())),
        Some((state.origin_of(0), false))
    );
    assert_eq!((state.origin_of(4), place(&state, 4)), ([0.0; 3], [0.0; 3]));
    for (domain, want) in off(1e7).iter().enumerate() {
        assert_eq!(state.origin_of(domain), [9766.0 * ORIGIN_GRID, 0.0, -9766.0 * ORIGIN_GRID]);
        assert_eq!(place(&state, domain), *want);
    }
    // Within reach of the origin, the shared cell stays; beyond, it moves.
    state.apply(&scene, &parse(&scene, &far(&[0, 1, 2, 3], &off(1e7 + 4000.0))));
    assert_eq!(
        (state.origin_of(0), &state.changed),
        ([9766.0 * ORIGIN_GRID, 0.0, -9766.0 * ORIGIN_GRID], &DirtyDomains::Some(vec![0, 1, 2, 3]))
    );
    state.apply(&scene, &parse(&scene, &far(&[0, 1, 2, 3], &off(1e7 + 9000.0))));
    assert_eq!(
        (state.origin_of(0), &state.changed),
        ([9774.0 * ORIGIN_GRID, 0.0, -9774.0 * ORIGIN_GRID], &DirtyDomains::All)
    );
}

#[test]
fn f64_that_begins_in_a_scene_with_far_f32_transforms_expresses_those_anew() {
    let scene = scene(5);
    let mut state = after(&scene, &[near(3, [1e6, 2.0, 0.0])]);
    state.apply(&scene, &parse(&scene, &far(&[0], &[[1.0, 0.0, 0.0]])));
    assert_eq!((state.origin_of(3), place(&state, 3)), ([977.0 * ORIGIN_GRID, 0.0, 0.0], [1e6, 2.0, 0.0]));
    assert_eq!(state.changed, DirtyDomains::All);
}

#[test]
fn a_scattered_scene_is_not_searched_for_a_shared_cell_at_every_step() {
    let scene = scene(4);
    let scattered = [0.0, 1e5, 2e5, 3e5].map(|x| [x, x, x]);
    let mut state = after(&scene, &[far(&[0, 1, 2, 3], &scattered)]);
    let shared = state.origins.as_ref().map(|origins| origins.shared());
    for _ in 0..3 {
        state.apply(&scene, &parse(&scene, &far(&[3], &[scattered[3]])));
        assert_eq!(state.changed, DirtyDomains::Some(vec![3]));
        assert_eq!(state.origins.as_ref().map(|origins| origins.shared()), shared);
    }
    for (domain, want) in scattered.iter().enumerate() {
        assert_eq!(place(&state, domain), *want);
    }
}

#[test]
fn merged_steps_leave_the_state_of_all_in_whatever_formats_they_came() {
    let scene = scene(4);
    let steps = [
        far(&[0, 1], &[[1e7, 0.0, 0.0], [5.0, 0.5, 0.0]]),
        RawStepUpdate { q_domains: vec![1], q: vec![1; 8].into(), ..near(0, [1.0, 2.0, 3.0]) },
        far(&[3], &[[-1e7 - 0.125, 0.0, 0.0]]),
        near(2, [9.0, 9.0, 9.0]),
    ];
    let merged =
        steps.iter().map(|raw| parse(&scene, raw)).reduce(|older, newer| newer.merged_after(&older)).expect("some");
    let mut at_once = SceneState::rest(&scene);
    at_once.apply(&scene, &merged);
    let one_by_one = after(&scene, &steps);
    assert_eq!(at_once, one_by_one);
    assert_eq!((at_once.serial, one_by_one.serial), (1, 4));
    assert_eq!(at_once.changed, DirtyDomains::Some(vec![0, 1, 2, 3]));
    assert_eq!(place(&at_once, 3), [-1e7 - 0.125, 0.0, 0.0]);
    // An implementation that ignores the newer f32 translation of domain 0 would fail here.
    assert_ne!(after(&scene, &[steps[0].clone(), steps[2].clone(), steps[3].clone()]), one_by_one);
}
