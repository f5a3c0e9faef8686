//! Positions for inputs at the limits of f32: huge, tiny, canceling and overflowing terms.

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

/// A scene of one domain with the given columns of U. All rest positions are 0, so that x0 does not round U q.
pub(super) fn scene_from_columns(vertices: usize, columns: Vec<f32>, deformation: DeformationSettings) -> Arc<Scene> {
    let template = scenes::random_shape(&mut Random(1), vertices, 0).mesh;
    let mesh = Mesh::new(vec![[0.0; 3]; vertices], template.corners().clone(), template.triangles().to_vec())
        .expect("expected a valid mesh");
    let modes =
        Modes::from_columns(3 * vertices, columns.len() / (3 * vertices), columns).expect("expected valid modes");
    let normal_maps = false;
    scene_of_shapes(vec![Shape::new(mesh, modes).expect("expected a valid shape")], 1, deformation, normal_maps)
}

fn random_numbers(random: &mut Random, count: usize) -> Vec<f32> {
    (0..count).map(|_| random.next_number()).collect()
}

fn negate_q(state: &SceneState) -> SceneState {
    let mut negated_state = state.clone();
    negated_state.q.iter_mut().for_each(|number| *number = -*number);
    negated_state
}

/// Errors are within the bound for q of about 1e30, and for q so small that f32 has few significant digits left.
pub(crate) fn check_huge_and_tiny_q<D: Deformer>(create_deformer: impl Fn(&Arc<Scene>) -> D) {
    let (vertices, rank) = (140, 9);
    let columns = random_numbers(&mut Random(31), 3 * vertices * rank);
    for deformation in deformations() {
        let scene = scene_from_columns(vertices, columns.clone(), deformation);
        let mut deformer = create_deformer(&scene);
        for scale in [1e30, 1e-38, 1e-42, 1e-45, 0.0_f32] {
            let name = format!("{}, q of {scale:e}", format_deformation(deformation));
            let mut state = SceneState::rest(&scene);
            state.q = random_numbers(&mut Random(7), rank).iter().map(|number| number * scale).collect();
            let result = run_step(&mut deformer, &state);
            assert!(result.bounds.is_finite(), "{name}: {:?}", result.bounds);
            assert_within_bound(&name, &scene, &state, &result.surface.positions);
            // Whether a wrong sign exceeds the bound. At 1e-42, f16 and int8 lose the sign, because they first multiply
            // q by a scale. At 1e-45, all storage types lose it.
            let is_sign_visible =
                scale >= 1e-38 || scale == 1e-42 && matches!(deformation.storage, StorageType::F32 | StorageType::Bf16);
            if is_sign_visible {
                let wrong_domains = domains_beyond_bound(&scene, &negate_q(&state), &result.surface.positions);
                assert_eq!(wrong_domains, [0], "{name}: negative control with the opposite q");
            }
        }
    }
}

/// Errors are within the bound for columns of U with scales from 1e-6 to 1e6, once with q of equal magnitude, and once
/// with q divided by the scales.
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
        assert_within_bound(&format!("{name}, columns that differ by 1e12"), &scene, &state, &equal_q_positions);
        state.q.iter_mut().enumerate().for_each(|(mode, coordinate)| *coordinate /= scale(mode));
        let balanced_positions = run_step(&mut deformer, &state).surface.positions;
        assert_within_bound(&format!("{name}, columns and q that differ by 1e12"), &scene, &state, &balanced_positions);
        for mode in [0, rank - 1] {
            let mut negated_state = state.clone();
            negated_state.q[mode] = -negated_state.q[mode];
            assert_eq!(
                domains_beyond_bound(&scene, &negated_state, &balanced_positions),
                [0],
                "{name}: negative control with mode {mode} negated"
            );
        }
    }
}

/// Negative control of [`check_canceling_modes`]: the error of the plain sum must exceed this multiple of the bound of
/// the compensated sum.
const MIN_PLAIN_ERROR_RATIO: f64 = 1000.0;

/// If pairs of modes nearly cancel, the compensated sum keeps the digits that the plain sum loses.
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
        assert_within_bound(&format!("nearly canceling, compensated {compensated}"), &scene, &state, &positions);
        let modes = &scene.shape_of(0).modes;
        let expected = reference::deform(&scene, &state).into_flattened();
        let ratio = |(row, (actual, expected)): (usize, (&f32, &f64))| {
            let term = |mode: usize| (f64::from(modes.entry(row / 3, row % 3, mode)) * f64::from(state.q[mode])).abs();
            // Bound of the compensated dot product Dot2 (Ogita, Rump, Oishi, Accurate Sum and Dot Product, 2005,
            // proposition 5.5): u |sum| + gamma^2 sum|terms| with u = 2^-24 and, for 64 modes, gamma = 65 u. The
            // addition of x0 and the product with T add up to four roundings, hence 5 u.
            let abs_sum = (0..rank).map(term).sum::<f64>();
            let bound = f64::exp2(-24.0) * 5.0 * expected.abs() + (65.0 * f64::exp2(-24.0)).powi(2) * abs_sum;
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

/// Positions are finite and correct if a partial sum of U q or x0 + U q overflows f32 although x does not.
pub(crate) fn check_intermediate_overflow<D: Deformer>(create_deformer: impl Fn(&Arc<Scene>) -> D) {
    let column = |row: [f32; 3]| row.repeat(5);
    // u = (q0 + q1 + q2 + q3, q0 + q1 + q2 + q3, q4) at each of five vertices.
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
            // The coordinates are a few units large. An uncaught overflow gives NaN or infinity.
            assert!(error <= 1e-5, "{name}: expected {expected:?} per vertex, got {positions:?}");
        };
        assert_positions(&state, [0.0, 0.0, 0.75]);
        // x0 + U q has x = y = 6e38, which is infinite in f32. The first row of T computes infinity minus infinity, the
        // second one infinity times zero.
        state.q = vec![3e38, 3e38, 0.0, 0.0, 0.75];
        state.transforms[0] = Transform([1.0, -1.0, 1.0, 0.0, 0.0, 0.0, 1.0, 5.0, 0.0, 0.0, 1.0, -5.0]);
        assert_positions(&state, [0.75, 5.75, -4.25]);
        // Negative control: x overflows if the first row of T adds the infinities. The next step is not affected.
        state.transforms[0].0[1] = 1.0;
        assert!(!run_step(&mut deformer, &state).bounds.is_finite(), "{name}");
        state.q = vec![1.0, 0.0, 0.0, 0.0, 1.0];
        assert!(run_step(&mut deformer, &state).bounds.is_finite(), "{name}");
    }
}

/// A tile (128 vertices) whose rows of U are all zero does not move, although its largest entry, which sets the
/// quantization scale, is 0.
pub(crate) fn check_zero_tiles<D: Deformer>(create_deformer: impl Fn(&Arc<Scene>) -> D) {
    let (vertices, rank) = (300, 6);
    // Rows of the second tile; a tile has 128 vertices.
    let zero_tile = 3 * 128..3 * 256;
    let shape = scenes::random_shape(&mut Random(33), vertices, rank);
    let mut columns = shape.modes.columns().to_vec();
    for (mode, column) in columns.chunks_exact_mut(3 * vertices).enumerate() {
        column[zero_tile.clone()].fill(0.0);
        // One mode is also zero in the first tile.
        if mode == 2 {
            column[..zero_tile.start].fill(0.0);
        }
    }
    let modes = Modes::from_columns(3 * vertices, rank, columns).expect("expected valid modes");
    let shape = Shape::new(shape.mesh, modes).expect("expected a valid shape");
    for deformation in deformations() {
        let normal_maps = false;
        let scene = scene_of_shapes(vec![shape.clone()], 1, deformation, normal_maps);
        let (mut deformer, mut state) = (create_deformer(&scene), scenes::random_state(&scene, 4));
        let deformed_positions = run_step(&mut deformer, &state).surface.positions;
        assert_within_bound(
            &format!("{}, a tile of zeros", format_deformation(deformation)),
            &scene,
            &state,
            &deformed_positions,
        );
        let mut positions_at = |q: f32| {
            state.q.fill(q);
            run_step(&mut deformer, &state).surface.positions
        };
        let (rest_positions, huge_q_positions) = (positions_at(0.0), positions_at(3e38));
        for positions in [&deformed_positions, &huge_q_positions] {
            let is_unmoved =
                zero_tile.clone().all(|index| positions[index].to_bits() == rest_positions[index].to_bits());
            assert!(is_unmoved, "{}: expected the zero tile not to move", format_deformation(deformation));
            assert!(
                positions[0] != rest_positions[0] && positions[zero_tile.end] != rest_positions[zero_tile.end],
                "expected vertices of other tiles to move"
            );
        }
    }
}

/// Errors are within the bound for ranks below and above multiples of a chunk (1, 2 or 4 modes) and of a warp (32), and
/// for shapes of one vertex, of less than two quads of four vertices, and of two tiles of 128 vertices.
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
            let deformation = DeformationSettings { storage, ..DeformationSettings::default() };
            let normal_maps = true;
            let scene = scene_of_shapes(shapes, 2, deformation, normal_maps);
            let state = scenes::random_state(&scene, 5);
            let positions = run_step(&mut create_deformer(&scene), &state).surface.positions;
            assert_within_bound(&format!("{}, rank {rank}", storage.name()), &scene, &state, &positions);
            let wrong_domains = domains_beyond_bound(&scene, &negate_q(&state), &positions);
            assert_eq!(
                wrong_domains.len(),
                scene.domains.len(),
                "{}, rank {rank}: negative control: expected every domain beyond its bound, got {wrong_domains:?}",
                storage.name()
            );
        }
    }
}
