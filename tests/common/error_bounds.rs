//! Comparison of positions and displacements with the f64 reference, relative to their a-priori error bounds. An error
//! ratio is an error divided by its bound.

use modalcast_compute::reference;
use modalcast_compute::storage::bound::{ErrorBoundInput, ShapeErrorModel};
use modalcast_compute::storage::{QUAD, TILE_QUADS, TiledModes};
use modalcast_model::scene::{Scene, SceneState};

/// Vertices per tile; all vertices of a tile have the same bound.
const TILE_VERTICES: usize = QUAD * TILE_QUADS;

/// Largest position error of each domain relative to the bound of its tile; infinite if a position is not finite.
fn position_error_ratios(scene: &Scene, state: &SceneState, positions: &[f32]) -> Vec<f64> {
    let bound = |model: &ShapeErrorModel, tile: usize, step: &ErrorBoundInput| model.tile_bound(tile, step).total();
    error_ratios(scene, state, Comparison { actual: positions, expected: &reference::deform(scene, state) }, bound)
}

/// Largest displacement error of each domain relative to the bound of its tile; infinite if a displacement is not
/// finite.
fn displacement_error_ratios(scene: &Scene, state: &SceneState, displacements: &[f32]) -> Vec<f64> {
    let bound = |model: &ShapeErrorModel, tile: usize, step: &ErrorBoundInput| {
        model.displacement_bound(tile, step.q, step.compensated)
    };
    let expected = reference::displacements(scene, state);
    error_ratios(scene, state, Comparison { actual: displacements, expected: &expected }, bound)
}

/// Positions or displacements of all packed vertices. `actual` has three numbers per vertex; `expected` is the
/// reference.
struct Comparison<'a> {
    actual: &'a [f32],
    expected: &'a [[f64; 3]],
}

impl Comparison<'_> {
    /// Length of the difference at a packed vertex.
    fn error(&self, vertex: usize) -> f64 {
        let squared = |axis: usize| (f64::from(self.actual[3 * vertex + axis]) - self.expected[vertex][axis]).powi(2);
        (0..3).map(squared).sum::<f64>().sqrt()
    }
}

/// Largest error ratio of each domain. `bound` computes the bound of a tile from the error model of its shape, the
/// index of the tile and the step.
fn error_ratios(
    scene: &Scene,
    state: &SceneState,
    comparison: Comparison<'_>,
    bound: impl Fn(&ShapeErrorModel, usize, &ErrorBoundInput) -> f64,
) -> Vec<f64> {
    assert_eq!(comparison.actual.len(), 3 * comparison.expected.len(), "expected three numbers per vertex");
    let storage = scene.deformation.storage;
    let create_model = |shape| ShapeErrorModel::new(shape, &TiledModes::new(shape, storage));
    let models: Vec<ShapeErrorModel> = scene.shapes.iter().map(create_model).collect();
    let domain_ratio = |domain: usize| {
        let (layout, compensated) = (scene.layout.domains[domain], scene.deformation.compensated);
        let step = ErrorBoundInput {
            q: state.q_of(scene, domain),
            transform: state.composed_transform(scene, domain),
            compensated,
        };
        let tile_ratio = |first_vertex: usize| {
            let tile_bound = bound(&models[scene.domains[domain].shape], first_vertex / TILE_VERTICES, &step);
            let vertices = first_vertex..layout.vertices.min(first_vertex + TILE_VERTICES);
            vertices
                .map(|vertex| error_ratio(comparison.error(layout.first_vertex + vertex), tile_bound))
                .fold(0.0, f64::max)
        };
        (0..layout.vertices).step_by(TILE_VERTICES).map(tile_ratio).fold(0.0, f64::max)
    };
    (0..scene.domains.len()).map(domain_ratio).collect()
}

/// Ratio of an error to its bound. An error of 0 gives 0 even if the bound is 0, as for a domain without modes.
fn error_ratio(error: f64, bound: f64) -> f64 {
    let ratio = if error == 0.0 { 0.0 } else { error / bound };
    if ratio.is_nan() { f64::INFINITY } else { ratio }
}

/// Prints the largest ratio of a position error to its bound, and panics if the ratio exceeds 1.
pub(crate) fn assert_within_bound(name: &str, scene: &Scene, state: &SceneState, positions: &[f32]) {
    assert_ratios(&format!("{name}, x"), scene, &position_error_ratios(scene, state, positions));
}

/// Prints the largest ratio of a displacement error to its bound, and panics if the ratio exceeds 1.
pub(crate) fn assert_displacements_within_bound(name: &str, scene: &Scene, state: &SceneState, displacements: &[f32]) {
    assert_ratios(&format!("{name}, u"), scene, &displacement_error_ratios(scene, state, displacements));
}

/// Prints the largest ratio, and panics if it exceeds 1.
fn assert_ratios(name: &str, scene: &Scene, ratios: &[f64]) {
    let max_domain = (0..ratios.len()).max_by(|a, b| ratios[*a].total_cmp(&ratios[*b])).expect("at least one domain");
    let (ratio, domain_name) = (ratios[max_domain], &scene.domains[max_domain].name);
    eprintln!("{name}: the largest error is {ratio:.3} of its bound");
    assert!(ratio <= 1.0, "{name}: expected an error within the bound, got {ratio} of the bound in '{domain_name}'");
}

/// Indices of the domains with a displacement error that exceeds its bound.
pub(crate) fn domains_beyond_displacement_bound(
    scene: &Scene,
    state: &SceneState,
    displacements: &[f32],
) -> Vec<usize> {
    domains_beyond(&displacement_error_ratios(scene, state, displacements))
}

/// Indices of the domains with a position error that exceeds its bound.
pub(crate) fn domains_beyond_bound(scene: &Scene, state: &SceneState, positions: &[f32]) -> Vec<usize> {
    domains_beyond(&position_error_ratios(scene, state, positions))
}

fn domains_beyond(ratios: &[f64]) -> Vec<usize> {
    (0..ratios.len()).filter(|domain| ratios[*domain] > 1.0).collect()
}

#[test]
fn error_bounds_reject_wrong_and_non_finite_vertices() {
    let mut random = crate::scenes::Random(1);
    let shapes = vec![super::strip_shape(&mut random, 130, 3), super::strip_shape(&mut random, 7, 0)];
    let normal_maps = false;
    let scene = super::scene_of_shapes(shapes, 1, Default::default(), normal_maps);
    let state = crate::scenes::random_state(&scene, 2);
    let positions: Vec<f32> = reference::deform(&scene, &state).as_flattened().iter().map(|x| *x as f32).collect();
    // `[0; 0]` is the empty list.
    assert_eq!(domains_beyond_bound(&scene, &state, &positions), [0; 0]);
    // Vertices 0 to 129 belong to domain 0. Its second tile begins at vertex 128. Vertices from 130 on belong to domain
    // 1.
    for (index, wrong_number) in [(3 * 129, f32::NAN), (3 * 129, f32::INFINITY), (3 * 129 + 2, 0.125), (0, 7.0)] {
        let mut modified = positions.clone();
        modified[index] = wrong_number;
        assert_eq!(domains_beyond_bound(&scene, &state, &modified), [0], "{wrong_number}");
    }
    let mut wrong_positions = positions;
    wrong_positions[3 * 136] += 1e-3;
    assert_eq!(domains_beyond_bound(&scene, &state, &wrong_positions), [1]);
    let displacements: Vec<f32> =
        reference::displacements(&scene, &state).as_flattened().iter().map(|u| *u as f32).collect();
    assert_eq!(domains_beyond_displacement_bound(&scene, &state, &displacements), [0; 0]);
    // Domain 1 has no modes, so its bound is 0.
    for (index, wrong_number, domain) in [(5, f32::NAN, 0), (3 * 129, 0.125, 0), (3 * 136, 1e-30, 1)] {
        let mut modified = displacements.clone();
        modified[index] = wrong_number;
        assert_eq!(domains_beyond_displacement_bound(&scene, &state, &modified), [domain], "{wrong_number}");
    }
}
