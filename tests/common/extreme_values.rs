//! Positions at the limits of f32.

use std::sync::Arc;

use modalcast_compute::reference;
use modalcast_model::deform::Deformer;
use modalcast_model::domain::{Mesh, Modes, Shape, Transform};
use modalcast_model::scene::{DeformationSettings, Scene, SceneState, StorageType};

use super::{assert_within_bound, domains_beyond_bound, run_step, scene_of_shapes, strip_shape};
use crate::scenes::{self, Random};

/// Every storage type, with and without compensated summation.
fn deformations() -> impl Iterator<Item = DeformationSettings> {
    let settings = |storage| {
        [false, true].map(|compensated| DeformationSettings { storage, compensated, ..DeformationSettings::default() })
    };
    StorageType::ALL.into_iter().flat_map(settings)
}

fn format_deformation(deformation: DeformationSettings) -> String {
    format!("{}{}", deformation.storage.name(), if deformation.compensated { " compensated" } else { "" })
}

/// A scene of one domain with these columns of U. All rest positions are 0, so that x0 + U q has the precision of U q.
pub(super) fn scene_from_columns(vertices: usize, columns: Vec<f32>, deformation: DeformationSettings) -> Arc<Scene> {
    let template = scenes::random_shape(&mut Random(1), vertices, 0).mesh;
    let mesh = Mesh::new(vec![[0.0; 3]; vertices], template.corners().clone(), template.triangles().to_vec())
        .expect("expected a valid mesh");
    let modes =
        Modes::from_columns(3 * vertices, columns.len() / (3 * vertices), columns).expect("expected valid modes");
    scene_of_shapes(vec![Shape::new(mesh, modes).expect("expected a valid shape")], 1, deformation, false)
}

fn random_numbers(random: &mut Random, count: usize) -> Vec<f32> {
    (0..count).map(|_| random.next_number()).collect()
}

fn negate_q(state: &SceneState) -> SceneState {
    let mut negated_state = state.clone();
    negated_state.q.iter_mut().for_each(|number| *number = -*number);
    negated_state
}

/// q of 1e30, and q so small that f32 has few significant digits left.
pub(crate) fn check_huge_and_tiny_q<D: Deformer>(create_deformer: impl Fn(&Arc<Scene>) -> D) {
    let columns = random_numbers(&mut Random(31), 3 * 140 * 9);
    for deformation in deformations() {
        let scene = scene_from_columns(140, columns.clone(), deformation);
        let mut deformer = create_deformer(&scene);
        for scale in [1e30, 1e-38, 1e-42, 1e-45, 0.0_f32] {
            let name = format!("{}, q of {scale:e}", format_deformation(deformation));
            let mut state = SceneState::rest(&scene);
            state.q = random_numbers(&mut Random(7), 9).iter().map(|number| number * scale).collect();
            let result = run_step(&mut deformer, &state);
            assert!(result.bounds.is_finite(), "{name}: {:?}", result.bounds);
            assert_within_bound(&name, &scene, &state, &result.surface.positions, 0.0);
            // f16 and int8 first multiply q by a scale. Denormals then have too few digits to distinguish signs.
            let is_sign_visible =
                scale >= 1e-38 || scale == 1e-42 && matches!(deformation.storage, StorageType::F32 | StorageType::Bf16);
            if is_sign_visible {
                let wrong_domains = domains_beyond_bound(&scene, &negate_q(&state), &result.surface.positions, 0.0);
                assert_eq!(wrong_domains, [0], "{name}: negative control with the opposite q");
            }
        }
    }
}

/// Columns of U with scales from 1e-6 to 1e6, once with q of equal magnitude and once with q that cancels the scales.
pub(crate) fn check_column_scales<D: Deformer>(create_deformer: impl Fn(&Arc<Scene>) -> D) {
    let (vertices, rank) = (140, 13);
    let scale = |mode: usize| 10_f32.powi(mode as i32 - 6);
    let mut columns = random_numbers(&mut Random(32), 3 * vertices * rank);
    columns.iter_mut().enumerate().for_each(|(index, entry)| *entry *= scale(index / (3 * vertices)));
    for deformation in deformations() {
        let scene = scene_from_columns(vertices, columns.clone(), deformation);
        let (mut deformer, mut state) = (create_deformer(&scene), SceneState::rest(&scene));
        let name = format_deformation(deformation);
        state.q = (0..rank).map(|mode| if mode % 2 == 0 { 0.75 } else { -1.25 }).collect();
        let equal_q_positions = run_step(&mut deformer, &state).surface.positions;
        assert_within_bound(&format!("{name}, 1e12 between columns"), &scene, &state, &equal_q_positions, 0.0);
        state.q.iter_mut().enumerate().for_each(|(mode, coordinate)| *coordinate /= scale(mode));
        let balanced_positions = run_step(&mut deformer, &state).surface.positions;
        assert_within_bound(&format!("{name}, 1e12 between columns and q"), &scene, &state, &balanced_positions, 0.0);
        for mode in [0, rank - 1] {
            let mut negated_state = state.clone();
            negated_state.q[mode] = -negated_state.q[mode];
            assert_eq!(
                domains_beyond_bound(&scene, &negated_state, &balanced_positions, 0.0),
                [0],
                "{name}: negative control with mode {mode} negated"
            );
        }
    }
}

/// The smallest expected error of the plain sum relative to the bound of the compensated sum, for nearly canceling modes.
const MIN_PLAIN_ERROR_RATIO: f64 = 1000.0;

/// Pairs of modes that nearly cancel: the compensated sum keeps the digits that the plain sum loses.
pub(crate) fn check_canceling_modes<D: Deformer>(create_deformer: impl Fn(&Arc<Scene>) -> D) {
    let (mut random, vertices, rank) = (Random(17), 200, 64);
    let first_half = random_numbers(&mut random, 3 * vertices * rank / 2);
    let second_half: Vec<f32> = first_half.iter().map(|entry| entry * (1.0 + 1e-5 * random.next_number())).collect();
    let columns = [first_half, second_half].concat();
    let ratios = [true, false].map(|compensated| {
        let scene = scene_from_columns(
            vertices,
            columns.clone(),
            DeformationSettings { compensated, ..DeformationSettings::default() },
        );
        let mut state = SceneState::rest(&scene);
        state.q = (0..rank).map(|mode| if mode < rank / 2 { 1000.0 } else { -1000.0 }).collect();
        let positions = run_step(&mut create_deformer(&scene), &state).surface.positions;
        assert_within_bound(&format!("nearly canceling, compensated {compensated}"), &scene, &state, &positions, 0.0);
        let modes = &scene.shape_of(0).modes;
        let expected = reference::deform(&scene, &state).into_flattened();
        let ratio = |(row, (actual, expected)): (usize, (&f32, &f64))| {
            let term = |mode: usize| (f64::from(modes.entry(row / 3, row % 3, mode)) * f64::from(state.q[mode])).abs();
            // Bound of the compensated dot product Dot2: half a unit in the last place of the sum, plus gamma squared
            // times the sum of absolute terms. Four further roundings follow.
            let terms = (0..rank).map(term).sum::<f64>();
            let bound = f64::exp2(-24.0) * 5.0 * expected.abs() + (65.0 * f64::exp2(-24.0)).powi(2) * terms;
            (f64::from(*actual) - expected).abs() / bound
        };
        positions.iter().zip(&expected).enumerate().map(ratio).fold(0.0, f64::max)
    });
    let [compensated_ratio, plain_ratio] = ratios;
    eprintln!(
        "nearly canceling, error relative to the compensated bound: compensated {compensated_ratio:.3}, plain {plain_ratio:.0}"
    );
    assert!(
        compensated_ratio <= 1.0,
        "expected the compensated sum within its bound, got {compensated_ratio} of the bound"
    );
    assert!(
        plain_ratio > MIN_PLAIN_ERROR_RATIO,
        "negative control: the error of the plain sum is {plain_ratio} of the bound"
    );
}

/// Partial sums overflow f32 although the total is finite, and a transform that subtracts two infinities in f32.
pub(crate) fn check_intermediate_overflow<D: Deformer>(create_deformer: impl Fn(&Arc<Scene>) -> D) {
    let column = |row: [f32; 3]| row.repeat(5);
    let columns = [[1.0, 1.0, 0.0]; 4].map(column).concat();
    let columns = [columns, column([0.0, 0.0, 1.0])].concat();
    for deformation in deformations() {
        let name = format_deformation(deformation);
        let scene = scene_from_columns(5, columns.clone(), deformation);
        let (mut deformer, mut state) = (create_deformer(&scene), SceneState::rest(&scene));
        state.q = vec![3e38, 3e38, -3e38, -3e38, 0.75];
        assert!((state.q[0] + state.q[1]).is_infinite(), "control: expected a partial sum beyond f32");
        let mut assert_positions = |state: &SceneState, expected: [f32; 3]| {
            let result = run_step(&mut deformer, state);
            assert!(result.bounds.is_finite(), "{name}: {:?}", result.bounds);
            let positions = &result.surface.positions;
            assert!(positions.iter().all(|number| number.is_finite()), "{name}: {positions:?}");
            let vertex_error = |actual: &[f32]| {
                actual.iter().zip(expected).map(|(actual, expected)| (actual - expected).abs()).fold(0.0, f32::max)
            };
            let error = positions.chunks_exact(3).map(vertex_error).fold(0.0, f32::max);
            eprintln!("{name}: error of {expected:?} is {error:e}");
            assert!(error <= 1e-5, "{name}: expected {expected:?} per vertex, got {positions:?}");
        };
        assert_positions(&state, [0.0, 0.0, 0.75]);
        // x0 + U q has x = y = 6e38, which is infinite in f32. The first row of T computes infinity minus infinity, the
        // second one infinity times zero.
        state.q = vec![3e38, 3e38, 0.0, 0.0, 0.75];
        state.transforms[0] = Transform([1.0, -1.0, 1.0, 0.0, 0.0, 0.0, 1.0, 5.0, 0.0, 0.0, 1.0, -5.0]);
        assert_positions(&state, [0.75, 5.75, -4.25]);
        // Negative control: a result that is not finite is reported, for that step only.
        state.transforms[0].0[1] = 1.0;
        assert!(!run_step(&mut deformer, &state).bounds.is_finite(), "{name}");
        state.q = vec![1.0, 0.0, 0.0, 0.0, 1.0];
        assert!(run_step(&mut deformer, &state).bounds.is_finite(), "{name}");
    }
}

/// A tile whose rows of U are all zero has no quantization scale. Its positions do not depend on q.
pub(crate) fn check_zero_tiles<D: Deformer>(create_deformer: impl Fn(&Arc<Scene>) -> D) {
    let (vertices, rank) = (300, 6);
    let shape = scenes::random_shape(&mut Random(33), vertices, rank);
    let mut columns = shape.modes.columns().to_vec();
    for (mode, column) in columns.chunks_exact_mut(3 * vertices).enumerate() {
        column[3 * 128..3 * 256].fill(0.0);
        // One mode is also zero in the first tile.
        column[..if mode == 2 { 3 * 128 } else { 0 }].fill(0.0);
    }
    let modes = Modes::from_columns(3 * vertices, rank, columns).expect("expected valid modes");
    let shape = Shape::new(shape.mesh, modes).expect("expected a valid shape");
    for deformation in deformations() {
        let scene = scene_of_shapes(vec![shape.clone()], 1, deformation, false);
        let (mut deformer, mut state) = (create_deformer(&scene), scenes::random_state(&scene, 4));
        let deformed_positions = run_step(&mut deformer, &state).surface.positions;
        assert_within_bound(
            &format!("{}, a tile of zeros", format_deformation(deformation)),
            &scene,
            &state,
            &deformed_positions,
            0.0,
        );
        let mut positions_at = |scale: f32| {
            state.q.fill(scale);
            run_step(&mut deformer, &state).surface.positions
        };
        let (rest_positions, huge_q_positions) = (positions_at(0.0), positions_at(3e38));
        let zero_tile = 3 * 128..3 * 256;
        for positions in [&deformed_positions, &huge_q_positions] {
            let is_unmoved =
                zero_tile.clone().all(|index| positions[index].to_bits() == rest_positions[index].to_bits());
            assert!(is_unmoved, "{}: expected the zero tile not to move", format_deformation(deformation));
            assert!(
                positions[0] != rest_positions[0] && positions[3 * 256] != rest_positions[3 * 256],
                "expected vertices of other tiles to move"
            );
        }
    }
}

/// Ranks around the sizes of chunks and groups of chunks, for shapes of one vertex, of less than two quads and of two
/// tiles.
pub(crate) fn check_ranks<D: Deformer>(create_deformer: impl Fn(&Arc<Scene>) -> D) {
    for storage in StorageType::ALL {
        for rank in [1, 3, 31, 33, 512] {
            let mut random = Random(rank as u64);
            let shapes = vec![
                scenes::random_shape(&mut random, 1, rank),
                strip_shape(&mut random, 7, rank),
                strip_shape(&mut random, 1, rank),
                scenes::random_shape(&mut random, 129, rank),
            ];
            let scene =
                scene_of_shapes(shapes, 2, DeformationSettings { storage, ..DeformationSettings::default() }, true);
            let state = scenes::random_state(&scene, 5);
            let positions = run_step(&mut create_deformer(&scene), &state).surface.positions;
            assert_within_bound(&format!("{}, r {rank}", storage.name()), &scene, &state, &positions, 0.0);
            let wrong_domains = domains_beyond_bound(&scene, &negate_q(&state), &positions, 0.0);
            assert_eq!(
                wrong_domains.len(),
                scene.domains.len(),
                "{} r {rank}: negative control detects only {wrong_domains:?}",
                storage.name()
            );
        }
    }
}
