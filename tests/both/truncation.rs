//! Mode truncation within an error budget.

use std::sync::Arc;

use modalcast_model::deform::Deformer;
use modalcast_model::scene::{DeformationSettings, Scene, SceneState, StorageType};

use super::extremes::columns_of;
use super::{beyond, changes, run, scene_of, strip, within};
use crate::scenes::{self, Random};

/// Budget in meters, which are scene units here.
const BUDGET: f64 = 0.02;

/// Runs twenty random states, each of which changes two domains. Errors stay within their bounds plus the reported
/// truncation bound, and that bound stays within the budget. `left_out` returns it in scene units.
pub(crate) fn errors_within_the_budget<D: Deformer>(
    make: impl Fn(&Arc<Scene>) -> D,
    left_out: impl Fn(&D, &Scene) -> f64,
) {
    for storage in StorageType::ALL {
        let mut random = Random(81);
        let shapes = vec![
            scenes::shape(&mut random, 300, 24),
            strip(&mut random, 40, 12),
            strip(&mut random, 7, 5),
            strip(&mut random, 60, 0),
        ];
        let deformation = DeformationSettings { storage, truncation: Some(BUDGET), ..DeformationSettings::default() };
        let scene = scene_of(shapes, 2, deformation, false);
        assert_eq!(scene.unit, 1.0);
        let (mut deformer, mut state) = (make(&scene), scenes::state(&scene, 82));
        run(&mut deformer, &state);
        let (mut most, mut seen) = (0.0_f64, 0);
        for number in 0..20 {
            let named = [number % 8, (number + 5) % 8];
            changes::apply(&scene, &mut state, &mut random, (&named, &named));
            // Amplitudes decrease with the mode, as for a vibrating body.
            for domain in named {
                let slot = scene.layout.slots[domain as usize];
                let own = &mut state.q[slot.first_q..][..slot.rank];
                own.iter_mut().enumerate().for_each(|(mode, number)| *number *= f32::exp2(-(mode as f32)));
            }
            let positions = run(&mut deformer, &state).surface.positions;
            let bound = left_out(&deformer, &scene);
            assert!((0.0..=BUDGET).contains(&bound), "{}: {bound} of {BUDGET}", storage.name());
            let name = format!("{}, state {number}, {bound:.2e} left out", storage.name());
            within(&name, (&scene, &state), &positions, bound);
            most = most.max(bound);
            seen += usize::from(!beyond((&scene, &state), &positions, 0.0).is_empty());
        }
        eprintln!("{}: at most {most:.2e} of {BUDGET} left out, to be seen in {seen} of 20 states", storage.name());
        assert!(most > BUDGET / 10.0, "modes are left out");
        assert!(storage != StorageType::F32 || seen > 10, "and their absence is an error that the judge sees");
    }
}

/// Number of times that the second of two modes appears or disappears while its amplitude oscillates around half of the
/// budget.
fn changes_of_a_swinging_mode(
    storage: StorageType,
    mut deform: impl FnMut(&Arc<Scene>, &SceneState) -> Vec<f32>,
) -> usize {
    let (vertices, rank, swinging) = (5, 8, 4);
    let mut columns = vec![0.0; 3 * vertices * rank];
    for vertex in 0..vertices {
        columns[3 * vertex + 1] = 1.0;
        // The mode is in another chunk for every storage type, because a chunk is summed with all of its modes.
        columns[3 * vertices * swinging + 3 * vertex] = 1.0;
    }
    let scene = columns_of(
        vertices,
        columns,
        DeformationSettings { storage, truncation: Some(1.0), ..DeformationSettings::default() },
    );
    let mut state = SceneState::rest(&scene);
    state.q[0] = 10.0;
    let (mut count, mut before) = (0, None);
    for step in 0..60 {
        state.q[swinging] = 0.5 + 0.1 * (0.7 * step as f32).sin();
        state.mark_all_dirty();
        let positions = deform(&scene, &state);
        assert!((positions[1] - 10.0).abs() < 1e-3, "the first mode is always there");
        let is_out = positions[0] == 0.0;
        assert!(is_out || (positions[0] - state.q[swinging]).abs() < 0.01);
        count += usize::from(before.is_some_and(|before| before != is_out));
        before = Some(is_out);
    }
    count
}

/// A mode near the limit is truncated once and stays so (hysteresis); without memory it flickers.
pub(crate) fn no_flicker<D: Deformer>(make: impl Fn(&Arc<Scene>) -> D) {
    for storage in StorageType::ALL {
        let mut kept: Option<D> = None;
        let count = changes_of_a_swinging_mode(storage, |scene, state| {
            run(kept.get_or_insert_with(|| make(scene)), state).surface.positions
        });
        eprintln!("{}: a swinging mode came or went {count} times in 60 steps", storage.name());
        assert!(count <= 1);
    }
    let forgetful =
        changes_of_a_swinging_mode(StorageType::F32, |scene, state| run(&mut make(scene), state).surface.positions);
    eprintln!("without memory it came or went {forgetful} times");
    assert!(forgetful > 10);
}
