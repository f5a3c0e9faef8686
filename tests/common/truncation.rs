//! Mode truncation: a deformer omits modes that together move no vertex by more than an error budget.

use std::sync::Arc;

use modalcast_model::deform::Deformer;
use modalcast_model::scene::{DeformationSettings, Scene, SceneState, StorageType};

use super::extreme_values::scene_from_columns;
use super::{assert_within_bound, domains_beyond_bound, partial_steps, run_step, scene_of_shapes, strip_shape};
use crate::scenes::{self, Random};

/// Truncation budget in meters. The scenes of this file have a unit of one meter.
const BUDGET: f64 = 0.02;

/// Deforms twenty random states, each of which changes two domains. Errors are within the rounding bound plus the
/// truncation bound, and the truncation bound is within the budget. `truncation_bound` returns the largest error that
/// the truncated modes of the last step can cause, in scene units.
pub(crate) fn check_error_budget<D: Deformer>(
    create_deformer: impl Fn(&Arc<Scene>) -> D,
    truncation_bound: impl Fn(&D, &Scene) -> f64,
) {
    for storage in StorageType::ALL {
        let mut random = Random(81);
        let shapes = vec![
            scenes::random_shape(&mut random, 300, 24),
            strip_shape(&mut random, 40, 12),
            strip_shape(&mut random, 7, 5),
            strip_shape(&mut random, 60, 0),
        ];
        let deformation = DeformationSettings { storage, truncation: Some(BUDGET), ..DeformationSettings::default() };
        let normal_maps = false;
        let scene = scene_of_shapes(shapes, 2, deformation, normal_maps);
        assert_eq!(scene.unit, 1.0, "expected a unit of one meter");
        let (mut deformer, mut state) = (create_deformer(&scene), scenes::random_state(&scene, 82));
        run_step(&mut deformer, &state);
        let (mut max_bound, mut states_beyond_rounding) = (0.0_f64, 0);
        for step in 0..20 {
            let domains = [step % 8, (step + 5) % 8];
            partial_steps::randomize_q_and_transforms(&scene, &mut state, &mut random, &domains, &domains);
            // Amplitudes decrease with the mode, as for a vibrating body.
            for domain in domains {
                let layout = scene.layout.domains[domain as usize];
                let q = &mut state.q[layout.first_q..][..layout.rank];
                q.iter_mut().enumerate().for_each(|(mode, amplitude)| *amplitude *= f32::exp2(-(mode as f32)));
            }
            let positions = run_step(&mut deformer, &state).surface.positions;
            let bound = truncation_bound(&deformer, &scene);
            assert!((0.0..=BUDGET).contains(&bound), "{}: expected at most {BUDGET}, got {bound}", storage.name());
            let name = format!("{}, state {step}, truncation bound {bound:.2e}", storage.name());
            assert_within_bound(&name, &scene, &state, &positions, bound);
            max_bound = max_bound.max(bound);
            states_beyond_rounding += usize::from(!domains_beyond_bound(&scene, &state, &positions, 0.0).is_empty());
        }
        eprintln!(
            "{}: truncation bound at most {max_bound:.2e} of {BUDGET}; the error exceeds the rounding bound in \
             {states_beyond_rounding} of 20 states",
            storage.name()
        );
        assert!(max_bound > BUDGET / 10.0, "expected truncated modes, got a largest bound of {max_bound}");
        // Rounding to the other storage types may hide the truncation error.
        assert!(
            storage != StorageType::F32 || states_beyond_rounding > 10,
            "negative control: expected errors beyond rounding in more than 10 states, got {states_beyond_rounding}"
        );
    }
}

/// Number of times that a mode is truncated or restored while its amplitude oscillates between 0.4 and 0.6 of the
/// budget. `deform` returns the positions of a state.
fn count_mode_toggles(storage: StorageType, mut deform: impl FnMut(&Arc<Scene>, &SceneState) -> Vec<f32>) -> usize {
    let (vertices, rank, oscillating_mode) = (5, 8, 4);
    let mut columns = vec![0.0; 3 * vertices * rank];
    for vertex in 0..vertices {
        // Mode 0 moves every vertex along y, the oscillating mode moves it along x. A chunk is up to four consecutive
        // modes. If one mode of a chunk is retained, all modes of the chunk are summed. So the oscillating mode must be
        // in another chunk than mode 0.
        columns[3 * vertex + 1] = 1.0;
        columns[3 * vertices * oscillating_mode + 3 * vertex] = 1.0;
    }
    let scene = scene_from_columns(
        vertices,
        columns,
        DeformationSettings { storage, truncation: Some(1.0), ..DeformationSettings::default() },
    );
    let mut state = SceneState::rest(&scene);
    state.q[0] = 10.0;
    let (mut toggles, mut was_truncated) = (0, None);
    for step in 0..60 {
        state.q[oscillating_mode] = 0.5 + 0.1 * (0.7 * step as f32).sin();
        state.mark_all_dirty();
        let positions = deform(&scene, &state);
        assert!((positions[1] - 10.0).abs() < 1e-3, "expected mode 0 not to be truncated");
        let is_truncated = positions[0] == 0.0;
        assert!(is_truncated || (positions[0] - state.q[oscillating_mode]).abs() < 0.01);
        toggles += usize::from(was_truncated == Some(!is_truncated));
        was_truncated = Some(is_truncated);
    }
    toggles
}

/// Hysteresis: modes are truncated below half of the budget and restored above the whole budget, so an oscillation
/// around half of the budget truncates a mode at most once. Negative control: a new deformer per step has no
/// hysteresis.
pub(crate) fn check_hysteresis<D: Deformer>(create_deformer: impl Fn(&Arc<Scene>) -> D) {
    for storage in StorageType::ALL {
        let mut deformer: Option<D> = None;
        let toggles = count_mode_toggles(storage, |scene, state| {
            run_step(deformer.get_or_insert_with(|| create_deformer(scene)), state).surface.positions
        });
        eprintln!("{}: the mode was truncated or restored {toggles} times in 60 steps", storage.name());
        assert!(toggles <= 1, "expected at most one change, got {toggles}");
    }
    let toggles = count_mode_toggles(StorageType::F32, |scene, state| {
        run_step(&mut create_deformer(scene), state).surface.positions
    });
    eprintln!("without hysteresis the mode was truncated or restored {toggles} times");
    assert!(toggles > 10, "negative control: expected more than 10 changes, got {toggles}");
}
