//! Comparison of positions and displacements with the f64 twin, relative to their a-priori bounds.

use modalcast_compute::reference;
use modalcast_compute::storage::bound::{ErrorBoundInput, ShapeErrorModel};
use modalcast_compute::storage::{QUAD, TILE_QUADS, TiledModes};
use modalcast_model::scene::{Scene, SceneState};

const TILE: usize = QUAD * TILE_QUADS;

/// Largest error of each domain relative to the bound of its tile; infinite for values that are not finite. Truncated
/// modes add `left_out`, in scene units, to the bound.
fn parts_of_bound(scene: &Scene, state: &SceneState, positions: &[f32], left_out: f64) -> Vec<f64> {
    let bound =
        |reaches: &ShapeErrorModel, tile: usize, step: &ErrorBoundInput| reaches.tile(tile, step).total() + left_out;
    parts((scene, state), positions, &reference::deform(scene, state), bound)
}

/// The same for displacements.
fn parts_of_displacement_bound(scene: &Scene, state: &SceneState, displacements: &[f32]) -> Vec<f64> {
    let bound = |reaches: &ShapeErrorModel, tile: usize, step: &ErrorBoundInput| {
        reaches.displacement(tile, step.q, step.compensated)
    };
    parts((scene, state), displacements, &reference::displacements(scene, state), bound)
}

fn parts(
    (scene, state): (&Scene, &SceneState),
    got: &[f32],
    want: &[[f64; 3]],
    bound: impl Fn(&ShapeErrorModel, usize, &ErrorBoundInput) -> f64,
) -> Vec<f64> {
    assert_eq!(got.len(), 3 * want.len(), "as many vertices");
    let storage = scene.deformation.storage;
    let reaches = |shape| ShapeErrorModel::new(shape, &TiledModes::new(shape, storage));
    let reaches: Vec<ShapeErrorModel> = scene.shapes.iter().map(reaches).collect();
    let error = |packed: usize| {
        let square = |axis: usize| (f64::from(got[3 * packed + axis]) - want[packed][axis]).powi(2);
        (0..3).map(square).sum::<f64>().sqrt()
    };
    let part = |domain: usize| {
        let (slot, compensated) = (scene.layout.slots[domain], scene.deformation.compensated);
        let step = ErrorBoundInput {
            q: state.q_of(scene, domain),
            transform: state.composed_transform(scene, domain),
            compensated,
        };
        let tile = |first: usize| {
            let bound = bound(&reaches[scene.domains[domain].shape], first / TILE, &step);
            let vertices = first..slot.vertices.min(first + TILE);
            vertices.map(|vertex| part_of(error(slot.first_vertex + vertex), bound)).fold(0.0, f64::max)
        };
        (0..slot.vertices).step_by(TILE).map(tile).fold(0.0, f64::max)
    };
    (0..scene.domains.len()).map(part).collect()
}

/// Ratio of an error to its bound. No error gives 0 even if the bound is 0, as for a domain without modes.
fn part_of(error: f64, bound: f64) -> f64 {
    let part = if error == 0.0 { 0.0 } else { error / bound };
    if part.is_nan() { f64::INFINITY } else { part }
}

/// Prints the largest ratio of an error to its bound, and panics if it exceeds 1.
pub(crate) fn within(name: &str, (scene, state): (&Scene, &SceneState), positions: &[f32], left_out: f64) {
    let parts = parts_of_bound(scene, state, positions, left_out);
    let worst = (0..parts.len()).max_by(|a, b| parts[*a].total_cmp(&parts[*b])).expect("a domain");
    eprintln!("{name}: an error takes up at most {:.3} of its bound", parts[worst]);
    assert!(parts[worst] <= 1.0, "{name}: '{}' is {} of its bound off", scene.domains[worst].name, parts[worst]);
}

/// [`within`] for displacements.
pub(crate) fn displacements_within(name: &str, (scene, state): (&Scene, &SceneState), displacements: &[f32]) {
    let parts = parts_of_displacement_bound(scene, state, displacements);
    let worst = (0..parts.len()).max_by(|a, b| parts[*a].total_cmp(&parts[*b])).expect("a domain");
    eprintln!("{name}: an error of u takes up at most {:.3} of its bound", parts[worst]);
    assert!(parts[worst] <= 1.0, "{name}: u of '{}' is {} of its bound off", scene.domains[worst].name, parts[worst]);
}

/// Domains with a displacement error beyond its bound.
pub(crate) fn displacements_beyond((scene, state): (&Scene, &SceneState), displacements: &[f32]) -> Vec<usize> {
    let parts = parts_of_displacement_bound(scene, state, displacements);
    (0..parts.len()).filter(|domain| parts[*domain] > 1.0).collect()
}

/// Domains with a position error beyond its bound.
pub(crate) fn beyond((scene, state): (&Scene, &SceneState), positions: &[f32], left_out: f64) -> Vec<usize> {
    let parts = parts_of_bound(scene, state, positions, left_out);
    (0..parts.len()).filter(|domain| parts[*domain] > 1.0).collect()
}

#[test]
fn judge_refuses_wrong_and_non_finite_vertices() {
    let mut random = crate::scenes::Random(1);
    let shapes = vec![super::strip(&mut random, 130, 3), super::strip(&mut random, 7, 0)];
    let scene = super::scene_of(shapes, 1, Default::default(), false);
    let state = crate::scenes::state(&scene, 2);
    let right: Vec<f32> = reference::deform(&scene, &state).as_flattened().iter().map(|x| *x as f32).collect();
    assert_eq!(beyond((&scene, &state), &right, 0.0), [0; 0]);
    for (at, number) in [(3 * 129, f32::NAN), (3 * 129, f32::INFINITY), (3 * 129 + 2, 0.125), (0, 7.0)] {
        let mut wrong = right.clone();
        wrong[at] = number;
        assert_eq!(beyond((&scene, &state), &wrong, 0.0), [0], "{number}");
    }
    let mut wrong = right;
    wrong[3 * 136] += 1e-3;
    assert_eq!(beyond((&scene, &state), &wrong, 0.0), [1]);
    let right_u: Vec<f32> = reference::displacements(&scene, &state).as_flattened().iter().map(|x| *x as f32).collect();
    assert_eq!(displacements_beyond((&scene, &state), &right_u), [0; 0]);
    for (at, number, domain) in [(5, f32::NAN, 0), (3 * 129, 0.125, 0), (3 * 136, 1e-30, 1)] {
        let mut wrong = right_u.clone();
        wrong[at] = number;
        assert_eq!(displacements_beyond((&scene, &state), &wrong), [domain], "{number}");
    }
    assert_eq!(beyond((&scene, &state), &wrong, 2e-3), [0; 0]);
}
