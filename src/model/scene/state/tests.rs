//! Tests of dirty domains, distant translations and merged steps.

use super::*;
use crate::domain::{Domain, FollowConstraint, Material, Mesh, Modes, Shape, Transform};
use crate::scene::{RawStepUpdate, SceneParts, TransformFormat};

/// Domains of one vertex and two modes. The largest coordinate is 1, and so is the spacing of floating origins. Domains
/// 2 and 4 share the coordinates of domain 1; domain 5 has no modes.
fn scene(count: usize) -> Arc<Scene> {
    let mesh =
        || Mesh::from_indexed(vec![[0.5, 0.25, 1.0]], vec![[0.0, 0.0, 1.0]], vec![], vec![[0, 0, 0]]).expect("a point");
    let modes = Modes::from_columns(3, 2, vec![1.0, 0.0, 0.0, 0.0, 1.0, 0.0]).expect("3 x 2");
    let mut parts = SceneParts::named("points");
    parts.shapes =
        vec![Shape::new(mesh(), modes).expect("a valid shape"), Shape::new(mesh(), Modes::rigid()).expect("rigid")];
    parts.materials = vec![Material::default()];
    let domain = |index: usize| Domain {
        shares_q_with: [(2, 1), (4, 2)]
            .into_iter()
            .find(|(domain, _)| *domain == index)
            .map(|(_, other_domain)| other_domain),
        ..Domain::new(format!("point {index}"), usize::from(index == 5))
    };
    parts.domains = (0..count).map(domain).collect();
    Scene::new(parts).expect("a scene")
}

fn coordinates_step(domains: &[u32], values: &[f32]) -> RawStepUpdate {
    let q = values.iter().flat_map(|number| number.to_le_bytes()).collect();
    RawStepUpdate { q_domains: domains.to_vec(), q, ..RawStepUpdate::default() }
}

/// A step with f64 translations and no rotation.
fn f64_step(domains: &[u32], translations: &[[f64; 3]]) -> RawStepUpdate {
    let encode = |translation: &[f64; 3]| {
        let rotation = [0.0, 0.0, 0.0, 1.0_f32].into_iter().flat_map(f32::to_le_bytes);
        rotation.chain(translation.iter().flat_map(|number| number.to_le_bytes())).collect::<Vec<u8>>()
    };
    RawStepUpdate {
        transform_domains: domains.to_vec(),
        transforms: translations.iter().flat_map(encode).collect(),
        transform_format: TransformFormat::QuaternionXyzwF64,
        ..RawStepUpdate::default()
    }
}

/// A step with an f32 translation and no rotation.
fn f32_step(domain: u32, [x, y, z]: [f32; 3]) -> RawStepUpdate {
    let entries = [1.0, 0.0, 0.0, x, 0.0, 1.0, 0.0, y, 0.0, 0.0, 1.0, z];
    let transforms = entries.iter().flat_map(|number: &f32| number.to_le_bytes()).collect();
    RawStepUpdate { transform_domains: vec![domain], transforms, ..RawStepUpdate::default() }
}

fn parse_step(scene: &Scene, raw: &RawStepUpdate) -> StepUpdate {
    StepUpdate::parse(scene, raw).expect("a valid step")
}

fn state_after(scene: &Scene, steps: &[RawStepUpdate]) -> SceneState {
    let mut state = SceneState::rest(scene);
    steps.iter().for_each(|raw| state.apply(scene, &parse_step(scene, raw)));
    state
}

/// The position of a domain's origin in f64, relative to the scene's origin.
fn world_position(state: &SceneState, domain: usize) -> [f64; 3] {
    let (origin, translation) = (state.origin_of(domain), state.transforms[domain].translation());
    std::array::from_fn(|axis| origin[axis] + translation[axis])
}

#[test]
fn changed_domains_include_those_that_share_coordinates() {
    let scene = scene(7);
    let rest = SceneState::rest(&scene);
    assert_eq!((rest.serial, &rest.dirty_domains), (0, &DirtyDomains::All));
    let mut state = rest;
    for (serial, (raw, changed_domains)) in [
        (coordinates_step(&[3, 0], &[0.0; 4]), vec![0, 3]),
        (coordinates_step(&[1], &[1.0, 2.0]), vec![1, 2, 4]),
        (coordinates_step(&[4], &[1.0, 2.0]), vec![1, 2, 4]),
        (coordinates_step(&[2, 6], &[0.0; 4]), vec![1, 2, 4, 6]),
        // A domain without modes has the same `first_q` as the next one but shares no coordinates with it.
        (coordinates_step(&[5], &[]), vec![5]),
        (f32_step(6, [1.0; 3]), vec![6]),
        (RawStepUpdate { q_domains: vec![4], q: vec![0; 8].into(), ..f32_step(2, [1.0; 3]) }, vec![1, 2, 4]),
        (RawStepUpdate::default(), vec![]),
    ]
    .into_iter()
    .enumerate()
    {
        state.apply(&scene, &parse_step(&scene, &raw));
        assert_eq!((state.serial, &state.dirty_domains), (serial as u64 + 1, &DirtyDomains::Some(changed_domains)));
    }
    // The ninth update, after eight steps.
    state.mark_all_dirty();
    assert_eq!((state.serial, &state.dirty_domains), (9, &DirtyDomains::All));
}

/// Domains 2 and 4 share the coordinates of domain 1, and domain 5 has no modes.
#[test]
fn q_without_list_has_each_coordinate_once_or_every_domain() {
    let scene = scene(7);
    let packed: Vec<f32> = (0..8).map(|number| number as f32).collect();
    let of_domain = |domain: usize| scene.layout.domains[domain].first_q;
    let every_domain: Vec<f32> =
        [0, 1, 2, 3, 4, 6].iter().flat_map(|domain| packed[of_domain(*domain)..][..2].to_vec()).collect();
    for values in [&packed, &every_domain] {
        let state = state_after(&scene, &[coordinates_step(&[], values)]);
        assert_eq!(state.q, packed, "{} numbers", values.len());
        assert_eq!(state.dirty_domains, DirtyDomains::Some((0..7).collect()));
    }
    // Of several values of a coordinate, the last one counts.
    let mut different = every_domain;
    different[8] = 9.0;
    assert_eq!(state_after(&scene, &[coordinates_step(&[], &different)]).q[2], 9.0);
    for (numbers, given) in [(7, "28 bytes"), (9, "36 bytes")] {
        let error = StepUpdate::parse(&scene, &coordinates_step(&[], &vec![0.0; numbers])).expect_err("a wrong length");
        let expected = format!("step.q: expected 32 bytes (8 coordinates), got {given}");
        assert!(error.to_string().contains(&expected), "{error}");
    }
    let mut invalid = packed;
    invalid[5] = f32::NAN;
    let error = StepUpdate::parse(&scene, &coordinates_step(&[], &invalid)).expect_err("a number that is not finite");
    assert!(
        error.to_string().contains("step.q[5]: expected a finite number, got NaN for mode 1 of domain 'point 3'"),
        "{error}"
    );
}

/// Recomputing only the domains in `dirty_domains` must suffice, and no entry of the list may be superfluous.
#[test]
fn changed_domains_are_complete_and_minimal() {
    let scene = scene(7);
    let updated_fingerprints = |state: &SceneState, previous: &[f64], changed_domains: &[u32]| {
        let expected = fingerprints(&scene, state);
        let mut updated = previous.to_vec();
        changed_domains.iter().for_each(|domain| updated[*domain as usize] = expected[*domain as usize]);
        (updated, expected)
    };
    let mut state = SceneState::rest(&scene);
    let mut previous = fingerprints(&scene, &state);
    for raw in [
        coordinates_step(&[1], &[0.5, 2.0]),
        f32_step(3, [1.0, 2.0, 3.0]),
        coordinates_step(&[4, 0], &[1.0, -1.0, 3.0, 4.0]),
    ] {
        state.apply(&scene, &parse_step(&scene, &raw));
        let DirtyDomains::Some(changed_domains) = &state.dirty_domains else { panic!("expected a list of domains") };
        let (updated, expected) = updated_fingerprints(&state, &previous, changed_domains);
        assert_eq!(updated, expected);
        for removed in 0..changed_domains.len() {
            let mut incomplete_list = changed_domains.clone();
            incomplete_list.remove(removed);
            assert_ne!(
                updated_fingerprints(&state, &previous, &incomplete_list).0,
                expected,
                "expected a wrong result without entry {removed} of {changed_domains:?}"
            );
        }
        previous = expected;
    }
}

/// For each domain, a weighted sum of all entries of its q and T. The weights distinguish the states of the tests.
fn fingerprints(scene: &Scene, state: &SceneState) -> Vec<f64> {
    let fingerprint = |domain: usize| {
        let q: f64 = state.q_of(scene, domain).iter().zip([1.0, 10.0]).map(|(q, weight)| f64::from(*q) * weight).sum();
        let t: f64 =
            state.transforms[domain].0.iter().zip(1..).map(|(t, weight)| f64::from(*t) * f64::from(weight)).sum();
        q + 1000.0 * t
    };
    (0..scene.domains.len()).map(fingerprint).collect()
}

#[test]
fn near_translations_keep_the_scene_origin() {
    let scene = scene(3);
    let state = state_after(&scene, &[f32_step(1, [1e6, 0.0, 0.0])]);
    assert_eq!((state.origins.as_ref(), state.transforms[1].0[3]), (None, 1e6));
    let state = state_after(&scene, &[f64_step(&[0, 1], &[[4.0, -4.0, 0.1], [1.0, 2.0, 3.0]])]);
    assert_eq!((state.origin_of(0), state.transforms[0].0[11]), ([0.0; 3], 0.1));
    assert_eq!(state.dirty_domains, DirtyDomains::Some(vec![0, 1]));
    assert!(state.origins.is_some_and(|origins| origins.has_no_outliers()));
}

#[test]
fn distant_domain_has_its_own_floating_origin() {
    let scene = scene(3);
    let position = [1e7 + 0.001, -1e7 - 0.002, 3.0];
    let mut state = state_after(&scene, &[f64_step(&[2], &[position])]);
    assert_eq!(state.dirty_domains, DirtyDomains::Some(vec![2]));
    assert_eq!((state.origin_of(0), state.origin_of(2)), ([0.0; 3], [1e7, -1e7, 3.0]));
    // The translation is within half a unit of its floating origin, where rounding to f32 changes it by at most 2^-26.
    // In f64, numbers near 1e7 have a spacing of 2^-29.
    let error = (0..3).map(|axis| (world_position(&state, 2)[axis] - position[axis]).abs()).fold(0.0, f64::max);
    assert!(error <= 2.0_f64.powi(-25), "{error} units");
    assert!((f64::from(position[0] as f32) - position[0]).abs() > 5e-4, "expected f32 to lose a millimeter");
    // f32 translations also change the floating origin, and move the domain back to the scene's origin.
    state.apply(&scene, &parse_step(&scene, &f32_step(2, [1e6 + 1.0, 0.0, 0.0])));
    assert_eq!((world_position(&state, 2), state.origin_of(2)), ([1e6 + 1.0, 0.0, 0.0], [1e6 + 1.0, 0.0, 0.0]));
    state.apply(&scene, &parse_step(&scene, &f32_step(2, [5.0, 6.0, 7.0])));
    assert_eq!((state.transforms[2].0[3], state.origin_of(2)), (5.0, [0.0; 3]));
}

#[test]
fn shared_origin_follows_the_majority_of_the_domains() {
    let scene = scene(5);
    let distant_positions = |shift: f64| [0.0, 1.0, 2.0, 3.0].map(|offset| [shift + offset, 0.25, -shift]);
    // Of five domains, two distant ones become outliers; four distant ones move the shared origin.
    let steps = [f64_step(&[0, 1], &distant_positions(1e7)[..2]), f64_step(&[2, 3], &distant_positions(1e7)[2..])];
    let state = state_after(&scene, &steps[..1]);
    assert_eq!((state.origin_of(1), state.origin_of(4)), ([1e7 + 1.0, 0.0, -1e7], [0.0; 3]));
    assert_eq!(state.origins.as_ref().map(|origins| origins.shared_origin()), Some([0.0; 3]));
    let mut state = state_after(&scene, &steps);
    assert_eq!((state.serial, &state.dirty_domains), (2, &DirtyDomains::All), "expected all transforms to be rebased");
    assert_eq!(
        state.origins.as_ref().map(|origins| (origins.shared_origin(), origins.has_no_outliers())),
        Some((state.origin_of(0), false))
    );
    assert_eq!((state.origin_of(4), world_position(&state, 4)), ([0.0; 3], [0.0; 3]));
    for (domain, expected) in distant_positions(1e7).iter().enumerate() {
        assert_eq!(state.origin_of(domain), [1e7 + 1.0, 0.0, -1e7]);
        assert_eq!(world_position(&state, domain), *expected);
    }
    // The shared origin remains while the domains are within its reach, and moves when they are beyond it.
    state.apply(&scene, &parse_step(&scene, &f64_step(&[0, 1, 2, 3], &distant_positions(1e7 + 2.0))));
    assert_eq!(
        (state.origin_of(0), &state.dirty_domains),
        ([1e7 + 1.0, 0.0, -1e7], &DirtyDomains::Some(vec![0, 1, 2, 3]))
    );
    state.apply(&scene, &parse_step(&scene, &f64_step(&[0, 1, 2, 3], &distant_positions(1e7 + 9000.0))));
    assert_eq!((state.origin_of(0), &state.dirty_domains), ([1e7 + 9001.0, 0.0, -1e7 - 9000.0], &DirtyDomains::All));
}

/// A domain beyond the home reach but within the shared reach uses the shared origin of the majority.
#[test]
fn minority_within_the_shared_reach_has_no_origin_of_its_own() {
    let scene = scene(3);
    let mut state = state_after(&scene, &[f64_step(&[2], &[[64.0, 0.0, -64.0]])]);
    assert!(state.origins.as_ref().is_some_and(|origins| origins.has_no_outliers()));
    state.apply(&scene, &parse_step(&scene, &f64_step(&[2], &[[64.5, 0.0, 0.0]])));
    assert!(state.origins.as_ref().is_some_and(|origins| !origins.has_no_outliers()));
    assert_eq!((state.origin_of(0), state.origin_of(2)), ([0.0; 3], [65.0, 0.0, 0.0]));
    state.apply(&scene, &parse_step(&scene, &f64_step(&[2], &[[-3.0, 0.0, 0.0]])));
    assert!(state.origins.as_ref().is_some_and(|origins| origins.has_no_outliers()));
}

/// The shared origin of one domain stays while the domain is within its home reach, and then jumps to the nearest grid
/// point. So a domain that swings around a border of this reach does not move the origin back and forth.
#[test]
fn shared_origin_follows_one_domain_with_hysteresis_and_returns() {
    let scene = scene(1);
    let mut state = SceneState::rest(&scene);
    let expected_origins =
        [(4.0, 0.0), (4.25, 4.0), (3.75, 4.0), (0.0, 4.0), (-0.25, 0.0), (500.3, 500.0), (1e5, 1e5), (0.1, 0.0)];
    for (x, expected_origin) in expected_origins {
        state.apply(&scene, &parse_step(&scene, &f64_step(&[0], &[[x, 0.0, 0.0]])));
        assert_eq!(state.origin_of(0), [expected_origin, 0.0, 0.0], "translation {x}");
        let error = (world_position(&state, 0)[0] - x).abs();
        assert!(error <= 2.0_f64.powi(-23), "translation {x}: error {error:e}");
    }
}

/// The spacing is the power of two below the diagonal or the largest coordinate of a root with its followers.
#[test]
fn origin_spacing_follows_the_size_of_a_root() {
    let spacing = |scale: f32, placement: Transform| {
        let mut parts = scene(1).parts();
        let corners = vec![[-scale, 0.0, 0.0], [scale, 0.0, 0.0], [0.0, scale, 0.0]];
        let mesh = Mesh::from_indexed(corners, vec![[0.0, 0.0, 1.0]; 3], vec![], vec![[0, 1, 2]]).expect("a triangle");
        parts.shapes = vec![Shape::new(mesh, Modes::rigid()).expect("rigid")];
        let follower = FollowConstraint { parent: 0, frame: placement };
        parts.domains = vec![Domain::new("root", 0), Domain { follows: Some(follower), ..Domain::new("follower", 0) }];
        Scene::new(parts).expect("a scene").origin_grids.spacing(0)
    };
    let mut moved = Transform::IDENTITY;
    moved.0[3] = 100.0;
    // The diagonal is sqrt(5) times the scale: 2.2, 0.22 and 2.2e9.
    assert_eq!([1.0, 0.1, 1e9].map(|scale| spacing(scale, Transform::IDENTITY)), [2.0, 0.125, 2_147_483_648.0]);
    assert_eq!(spacing(1.0, moved), 64.0, "expected the largest coordinate of the follower, 101");
}

#[test]
fn first_f64_step_rebases_distant_f32_transforms() {
    let scene = scene(5);
    let mut state = state_after(&scene, &[f32_step(3, [1e6, 2.0, 0.0])]);
    state.apply(&scene, &parse_step(&scene, &f64_step(&[0], &[[1.0, 0.0, 0.0]])));
    assert_eq!((state.origin_of(3), world_position(&state, 3)), ([1e6, 2.0, 0.0], [1e6, 2.0, 0.0]));
    assert_eq!(state.dirty_domains, DirtyDomains::All);
}

#[test]
fn scattered_scene_is_not_searched_in_every_step() {
    let scene = scene(4);
    let positions = [0.0, 1e5, 2e5, 3e5].map(|x| [x, x, x]);
    // The first step searches for a shared origin. The next search needs four more translations, one per domain.
    let mut state = state_after(&scene, &[f64_step(&[0, 1, 2, 3], &positions)]);
    let shared_origin = state.origins.as_ref().map(|origins| origins.shared_origin());
    for _ in 0..3 {
        state.apply(&scene, &parse_step(&scene, &f64_step(&[3], &[positions[3]])));
        assert_eq!(state.dirty_domains, DirtyDomains::Some(vec![3]));
        assert_eq!(state.origins.as_ref().map(|origins| origins.shared_origin()), shared_origin);
    }
    for (domain, expected) in positions.iter().enumerate() {
        assert_eq!(world_position(&state, domain), *expected);
    }
}

/// Domains 2 and 4 share the coordinates of domain 1. The newer step names another one of them.
#[test]
fn merged_step_keeps_newest_shared_coordinates() {
    let scene = scene(7);
    for newer in [coordinates_step(&[1], &[3.0, 4.0]), coordinates_step(&[2, 0], &[3.0, 4.0, 0.0, 0.0])] {
        let steps = [coordinates_step(&[4], &[1.0, 2.0]), newer];
        let [older, newer] = steps.each_ref().map(|raw| parse_step(&scene, raw));
        let mut merged_state = SceneState::rest(&scene);
        merged_state.apply(&scene, &newer.merged_with_older(&older));
        assert_eq!(merged_state, state_after(&scene, &steps));
        assert_eq!(merged_state.q_of(&scene, 4), [3.0, 4.0]);
    }
}

#[test]
fn merged_step_gives_the_state_of_all_its_steps() {
    let scene = scene(4);
    let steps = [
        f64_step(&[0, 1], &[[1e7, 0.0, 0.0], [3.0, 0.5, 0.0]]),
        RawStepUpdate { q_domains: vec![1], q: vec![1; 8].into(), ..f32_step(0, [1.0, 2.0, 3.0]) },
        f64_step(&[3], &[[-1e7 - 0.125, 0.0, 0.0]]),
        f32_step(2, [3.0, 3.0, 3.0]),
    ];
    let merged = steps
        .iter()
        .map(|raw| parse_step(&scene, raw))
        .reduce(|older, newer| newer.merged_with_older(&older))
        .expect("at least one step");
    let mut merged_state = SceneState::rest(&scene);
    merged_state.apply(&scene, &merged);
    let sequential_state = state_after(&scene, &steps);
    assert_eq!(merged_state, sequential_state);
    assert_eq!((merged_state.serial, sequential_state.serial), (1, 4));
    assert_eq!(merged_state.dirty_domains, DirtyDomains::Some(vec![0, 1, 2, 3]));
    assert_eq!(world_position(&merged_state, 3), [-1e7 - 0.125, 0.0, 0.0]);
    // The f32 translation of domain 0 in the second step changes the result.
    assert_ne!(state_after(&scene, &[steps[0].clone(), steps[2].clone(), steps[3].clone()]), sequential_state);
}
