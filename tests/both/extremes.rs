//! Positions at the limits of f32.

use std::sync::Arc;

use modalcast_compute::reference;
use modalcast_model::deform::Deformer;
use modalcast_model::domain::{Mesh, Modes, Shape, Transform};
use modalcast_model::scene::{DeformationSettings, Scene, SceneState, StorageType};

use super::{beyond, run, scene_of, strip, within};
use crate::scenes::{self, Random};

/// Every storage type, with and without compensated summation.
fn deformations() -> impl Iterator<Item = DeformationSettings> {
    let of = |storage| {
        [false, true].map(|compensated| DeformationSettings { storage, compensated, ..DeformationSettings::default() })
    };
    StorageType::ALL.into_iter().flat_map(of)
}

fn named(deformation: DeformationSettings) -> String {
    format!("{}{}", deformation.storage.name(), if deformation.compensated { " compensated" } else { "" })
}

/// One domain with these columns whose rest positions are all 0, so that nothing hides the sum.
pub(super) fn columns_of(vertices: usize, columns: Vec<f32>, deformation: DeformationSettings) -> Arc<Scene> {
    let like = scenes::shape(&mut Random(1), vertices, 0).mesh;
    let mesh = Mesh::new(vec![[0.0; 3]; vertices], like.corners().clone(), like.triangles().to_vec()).expect("a mesh");
    let modes = Modes::from_columns(3 * vertices, columns.len() / (3 * vertices), columns).expect("modes");
    scene_of(vec![Shape::new(mesh, modes).expect("a shape")], 1, deformation, false)
}

fn noise(random: &mut Random, count: usize) -> Vec<f32> {
    (0..count).map(|_| random.number()).collect()
}

fn negated(state: &SceneState) -> SceneState {
    let mut other = state.clone();
    other.q.iter_mut().for_each(|number| *number = -*number);
    other
}

/// q of 1e30, and q so small that f32 has few significant digits left.
pub(crate) fn huge_and_tiny_amounts<D: Deformer>(make: impl Fn(&Arc<Scene>) -> D) {
    let columns = noise(&mut Random(31), 3 * 140 * 9);
    for deformation in deformations() {
        let scene = columns_of(140, columns.clone(), deformation);
        let mut deformer = make(&scene);
        for amount in [1e30, 1e-38, 1e-42, 1e-45, 0.0_f32] {
            let name = format!("{}, q of {amount:e}", named(deformation));
            let mut state = SceneState::rest(&scene);
            state.q = noise(&mut Random(7), 9).iter().map(|number| number * amount).collect();
            let shown = run(&mut deformer, &state);
            assert!(shown.bounds.is_finite(), "{name}: {:?}", shown.bounds);
            within(&name, (&scene, &state), &shown.surface.positions, 0.0);
            // f16 and int8 first multiply q by a scale. Denormals then have too few digits to distinguish signs.
            let tells = amount >= 1e-38
                || amount == 1e-42 && matches!(deformation.storage, StorageType::F32 | StorageType::Bf16);
            if tells {
                let wrong = beyond((&scene, &negated(&state)), &shown.surface.positions, 0.0);
                assert_eq!(wrong, [0], "{name}: the judge can fail");
            }
        }
    }
}

/// Columns of U from 1e-6 to 1e6, with q that balances their scales and with equal q.
pub(crate) fn columns_of_every_scale<D: Deformer>(make: impl Fn(&Arc<Scene>) -> D) {
    let (vertices, rank) = (140, 13);
    let scale = |mode: usize| 10_f32.powi(mode as i32 - 6);
    let mut columns = noise(&mut Random(32), 3 * vertices * rank);
    columns.iter_mut().enumerate().for_each(|(at, entry)| *entry *= scale(at / (3 * vertices)));
    for deformation in deformations() {
        let scene = columns_of(vertices, columns.clone(), deformation);
        let (mut deformer, mut state) = (make(&scene), SceneState::rest(&scene));
        let name = named(deformation);
        state.q = (0..rank).map(|mode| if mode % 2 == 0 { 0.75 } else { -1.25 }).collect();
        let alike = run(&mut deformer, &state).surface.positions;
        within(&format!("{name}, 1e12 between columns"), (&scene, &state), &alike, 0.0);
        state.q.iter_mut().enumerate().for_each(|(mode, number)| *number /= scale(mode));
        let balanced = run(&mut deformer, &state).surface.positions;
        within(&format!("{name}, 1e12 between columns and q"), (&scene, &state), &balanced, 0.0);
        for mode in [0, rank - 1] {
            let mut wrong = state.clone();
            wrong.q[mode] = -wrong.q[mode];
            assert_eq!(beyond((&scene, &wrong), &balanced, 0.0), [0], "{name}: mode {mode} matters");
        }
    }
}

/// Least ratio of the error of the plain sum to the bound of the compensated sum, for nearly canceling modes.
const WORSE: f64 = 1000.0;

/// Pairs of modes that nearly cancel: the compensated sum keeps the digits that the plain sum loses.
pub(crate) fn modes_that_nearly_cancel<D: Deformer>(make: impl Fn(&Arc<Scene>) -> D) {
    let (mut random, vertices, rank) = (Random(17), 200, 64);
    let half = noise(&mut random, 3 * vertices * rank / 2);
    let almost: Vec<f32> = half.iter().map(|entry| entry * (1.0 + 1e-5 * random.number())).collect();
    let columns = [half, almost].concat();
    let parts = [true, false].map(|compensated| {
        let scene = columns_of(
            vertices,
            columns.clone(),
            DeformationSettings { compensated, ..DeformationSettings::default() },
        );
        let mut state = SceneState::rest(&scene);
        state.q = (0..rank).map(|mode| if mode < rank / 2 { 1000.0 } else { -1000.0 }).collect();
        let positions = run(&mut make(&scene), &state).surface.positions;
        within(&format!("nearly cancelling, compensated {compensated}"), (&scene, &state), &positions, 0.0);
        let modes = &scene.shape_of(0).modes;
        let want = reference::deform(&scene, &state).into_flattened();
        let part = |(row, (got, want)): (usize, (&f32, &f64))| {
            let term = |mode: usize| (f64::from(modes.at(row / 3, row % 3, mode)) * f64::from(state.q[mode])).abs();
            // Bound of Dot2: half a unit in the last place of the sum plus gamma squared times the terms; then four
            // roundings.
            let terms = (0..rank).map(term).sum::<f64>();
            let bound = f64::exp2(-24.0) * 5.0 * want.abs() + (65.0 * f64::exp2(-24.0)).powi(2) * terms;
            (f64::from(*got) - want).abs() / bound
        };
        positions.iter().zip(&want).enumerate().map(part).fold(0.0, f64::max)
    });
    let [compensated, plain] = parts;
    eprintln!("nearly cancelling: compensated {compensated:.3}, plain {plain:.0} of the compensated sum's bound");
    assert!(compensated <= 1.0, "{compensated} of the bound of a compensated sum");
    assert!(plain > WORSE, "a plain sum is {plain} of that bound");
}

/// Partial sums beyond f32 whose total is finite, and infinity minus infinity in the transform.
pub(crate) fn finite_sums_that_overflow_on_their_way<D: Deformer>(make: impl Fn(&Arc<Scene>) -> D) {
    let column = |row: [f32; 3]| row.repeat(5);
    let columns = [[1.0, 1.0, 0.0]; 4].map(column).concat();
    let columns = [columns, column([0.0, 0.0, 1.0])].concat();
    for deformation in deformations() {
        let name = named(deformation);
        let scene = columns_of(5, columns.clone(), deformation);
        let (mut deformer, mut state) = (make(&scene), SceneState::rest(&scene));
        state.q = vec![3e38, 3e38, -3e38, -3e38, 0.75];
        assert!((state.q[0] + state.q[1]).is_infinite());
        let mut judge = |state: &SceneState, want: [f32; 3]| {
            let shown = run(&mut deformer, state);
            assert!(shown.bounds.is_finite(), "{name}: {:?}", shown.bounds);
            let positions = &shown.surface.positions;
            assert!(positions.iter().all(|number| number.is_finite()), "{name}: {positions:?}");
            let vertex = |got: &[f32]| got.iter().zip(want).map(|(got, want)| (got - want).abs()).fold(0.0, f32::max);
            let off = positions.chunks_exact(3).map(vertex).fold(0.0, f32::max);
            eprintln!("{name}: {want:?} is off by {off:e}");
            assert!(off <= 1e-5, "{name}: {positions:?}");
        };
        judge(&state, [0.0, 0.0, 0.75]);
        // x = y = 6e38: the first row subtracts them, and the second row is infinity times zero in f32.
        state.q = vec![3e38, 3e38, 0.0, 0.0, 0.75];
        state.transforms[0] = Transform([1.0, -1.0, 1.0, 0.0, 0.0, 0.0, 1.0, 5.0, 0.0, 0.0, 1.0, -5.0]);
        judge(&state, [0.75, 5.75, -4.25]);
        // Control: a result that is not finite is reported, for that step only.
        state.transforms[0].0[1] = 1.0;
        assert!(!run(&mut deformer, &state).bounds.is_finite(), "{name}");
        state.q = vec![1.0, 0.0, 0.0, 0.0, 1.0];
        assert!(run(&mut deformer, &state).bounds.is_finite(), "{name}");
    }
}

/// A tile whose rows of U are all zero has no scale: it keeps its positions at q = 0 for every q.
pub(crate) fn tiles_of_zeros<D: Deformer>(make: impl Fn(&Arc<Scene>) -> D) {
    let (vertices, rank) = (300, 6);
    let shape = scenes::shape(&mut Random(33), vertices, rank);
    let mut columns = shape.modes.columns().to_vec();
    for (mode, column) in columns.chunks_exact_mut(3 * vertices).enumerate() {
        column[3 * 128..3 * 256].fill(0.0);
        // One mode is zero in the first tile too.
        column[..if mode == 2 { 3 * 128 } else { 0 }].fill(0.0);
    }
    let modes = Modes::from_columns(3 * vertices, rank, columns).expect("modes");
    let shape = Shape::new(shape.mesh, modes).expect("a shape");
    for deformation in deformations() {
        let scene = scene_of(vec![shape.clone()], 1, deformation, false);
        let (mut deformer, mut state) = (make(&scene), scenes::state(&scene, 4));
        let bent = run(&mut deformer, &state).surface.positions;
        within(&format!("{}, a tile of zeros", named(deformation)), (&scene, &state), &bent, 0.0);
        let mut at = |amount: f32| {
            state.q.fill(amount);
            run(&mut deformer, &state).surface.positions
        };
        let (still, huge) = (at(0.0), at(3e38));
        let zeros = 3 * 128..3 * 256;
        for positions in [&bent, &huge] {
            let same = zeros.clone().all(|at| positions[at].to_bits() == still[at].to_bits());
            assert!(same, "{}", named(deformation));
            assert!(positions[0] != still[0] && positions[3 * 256] != still[3 * 256], "the others move");
        }
    }
}

/// Ranks around the sizes of chunks and groups of chunks, for one vertex, for less than two quads, and for two tiles.
pub(crate) fn ranks_of_all_sizes<D: Deformer>(make: impl Fn(&Arc<Scene>) -> D) {
    for storage in StorageType::ALL {
        for rank in [1, 3, 31, 33, 512] {
            let mut random = Random(rank as u64);
            let shapes = vec![
                scenes::shape(&mut random, 1, rank),
                strip(&mut random, 7, rank),
                strip(&mut random, 1, rank),
                scenes::shape(&mut random, 129, rank),
            ];
            let scene = scene_of(shapes, 2, DeformationSettings { storage, ..DeformationSettings::default() }, true);
            let state = scenes::state(&scene, 5);
            let positions = run(&mut make(&scene), &state).surface.positions;
            within(&format!("{}, r {rank}", storage.name()), (&scene, &state), &positions, 0.0);
            let wrong = beyond((&scene, &negated(&state)), &positions, 0.0);
            assert_eq!(wrong.len(), scene.domains.len(), "{} r {rank}: {wrong:?} alone are seen", storage.name());
        }
    }
}
