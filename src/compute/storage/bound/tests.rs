//! Tests of the error bounds: errors stay within their bounds, and deliberately wrong results exceed them.

use super::*;
use crate::testing::{TestRng, shape, shape_with_columns};

/// A random transform with shear, possibly mirroring.
fn transform(rng: &mut TestRng) -> ComposedTransform {
    Transform(std::array::from_fn(|_| 2.0 * rng.next())).into()
}

/// World positions by the f32 sums that the module `bound` describes, with stored entries of U. For `axis`, reads the
/// entries of axis `axis + axis_shift`: 0 is correct, 1 is the control with swapped axes.
fn sum_in_f32(shape: &Shape, tiles: &TiledModes, input: &ErrorBoundInput, axis_shift: usize) -> Vec<[f32; 3]> {
    let t = input.transform.to_f32().0;
    let position = |vertex: usize| {
        let tile = vertex / crate::storage::QUAD / crate::storage::TILE_QUADS;
        let deformed: [f32; 3] = std::array::from_fn(|axis| {
            let mut sum = 0.0_f32;
            for (mode, q) in input.q.iter().enumerate() {
                let factor = factor(tiles, tile, mode);
                if factor > 0.0 {
                    let stored = tiles.decode_entry(vertex, (axis + axis_shift) % 3, mode) / f64::from(factor);
                    sum = (stored as f32).mul_add(q * factor, sum);
                }
            }
            sum + shape.mesh.rest_positions()[vertex][axis]
        });
        std::array::from_fn(|row| {
            let [x, y, z, offset] = [0, 1, 2, 3].map(|column| t[4 * row + column]);
            z.mul_add(deformed[2], y.mul_add(deformed[1], x.mul_add(deformed[0], offset)))
        })
    };
    (0..tiles.vertices()).map(position).collect()
}

/// World positions by f64 sums, with the entries of U before their rounding to the storage type.
fn positions_f64(shape: &Shape, input: &ErrorBoundInput) -> Vec<[f64; 3]> {
    let t = input.transform.to_f64();
    let position = |vertex: usize| {
        let deformed = [0, 1, 2].map(|axis| {
            let mode_term = |(mode, q): (usize, &f32)| f64::from(*q) * f64::from(shape.modes.entry(vertex, axis, mode));
            f64::from(shape.mesh.rest_positions()[vertex][axis])
                + input.q.iter().enumerate().map(mode_term).sum::<f64>()
        });
        [0, 4, 8].map(|row| t[row] * deformed[0] + t[row + 1] * deformed[1] + t[row + 2] * deformed[2] + t[row + 3])
    };
    (0..shape.mesh.rest_positions().len()).map(position).collect()
}

/// The largest ratio of a vertex's error to the bound of its tile; infinite if a ratio is NaN.
fn max_error_ratio(got: &[[f32; 3]], expected: &[[f64; 3]], bounds: impl Fn(usize) -> f64) -> f64 {
    let ratio = |(vertex, (got, expected)): (usize, (&[f32; 3], &[f64; 3]))| {
        let error = norm_f64([0, 1, 2].map(|axis| f64::from(got[axis]) - expected[axis]));
        let ratio = error / bounds(vertex / crate::storage::QUAD / crate::storage::TILE_QUADS);
        if ratio.is_nan() { f64::INFINITY } else { ratio }
    };
    got.iter().zip(expected).enumerate().map(ratio).fold(0.0, f64::max)
}

/// The largest ratios of error to bound, for correct axes and for swapped axes.
fn error_ratios(shape: &Shape, storage: StorageType, input: &ErrorBoundInput) -> [f64; 2] {
    let tiles = TiledModes::new(shape, storage);
    let model = ShapeErrorModel::new(shape, &tiles);
    let expected = positions_f64(shape, input);
    let bounds = |tile: usize| model.tile_bound(tile, input).total();
    assert!((0..tiles.count()).all(|tile| bounds(tile) <= model.domain_bound(input).total()));
    [0, 1].map(|axis_shift| max_error_ratio(&sum_in_f32(shape, &tiles, input, axis_shift), &expected, bounds))
}

#[test]
fn bound_holds_for_every_storage_and_fails_for_swapped_axes() {
    // (vertices, rank)
    let sizes = [(1, 1), (1, 512), (7, 3), (130, 31), (129, 33), (40, 5), (5, 512), (300, 1)];
    for seed in 0..120_u64 {
        let mut rng = TestRng(seed);
        let (vertices, rank) = sizes[seed as usize % sizes.len()];
        let shape = shape(vertices, rank, &mut rng);
        let q: Vec<f32> = (0..rank).map(|_| rng.next() * f32::exp2(6.0 * rng.next())).collect();
        let input = ErrorBoundInput { q: &q, transform: transform(&mut rng), compensated: false };
        for storage in StorageType::ALL {
            let [correct, swapped] = error_ratios(&shape, storage, &input);
            let case = format!("{storage:?}, {vertices} x {rank}, seed {seed}");
            assert!(correct <= 1.0, "{case}: expected an error within the bound, got {correct} times the bound");
            assert!(swapped > 1.0, "{case}: expected swapped axes to exceed the bound, got {swapped} times the bound");
        }
    }
}

#[test]
fn bound_of_a_follower_holds_and_fails_for_a_wrong_frame() {
    let (mut largest_ratio, mut coarse_failures) = (0.0_f64, 0);
    for seed in 0..120_u64 {
        let mut rng = TestRng(500 + seed);
        let shape = shape(40, 3, &mut rng);
        let q: Vec<f32> = (0..3).map(|_| rng.next()).collect();
        let (root, frame) = (transform(&mut rng).root, transform(&mut rng).root);
        let input = |transform| ErrorBoundInput { q: &q, transform, compensated: false };
        let follower = ComposedTransform { root, frame: Some(frame) };
        let tiles = TiledModes::new(&shape, StorageType::F32);
        let bound = ShapeErrorModel::new(&shape, &tiles).domain_bound(&input(follower));
        let expected = positions_f64(&shape, &input(follower));
        let ratio = |transform: ComposedTransform| {
            max_error_ratio(&sum_in_f32(&shape, &tiles, &input(transform), 0), &expected, |_| bound.total())
        };
        largest_ratio = largest_ratio.max(ratio(follower));
        assert!(ratio(follower) <= 1.0, "seed {seed}: expected at most the bound, got {} times it", ratio(follower));
        let frameless_ratio = ratio(root.into());
        assert!(
            frameless_ratio > 1.0,
            "seed {seed}: expected an error above the bound without the frame, got {frameless_ratio}"
        );
        // Control: a frame whose entries are truncated to ten mantissa bits.
        let coarse = Transform(frame.0.map(|entry| f32::from_bits(entry.to_bits() & 0xffff_e000)));
        coarse_failures += usize::from(ratio(ComposedTransform { root, frame: Some(coarse) }) > 1.0);
    }
    assert!(largest_ratio > 0.01, "expected an error above 1/100 of the bound, got {largest_ratio} times the bound");
    assert_eq!(coarse_failures, 120, "expected every truncated frame to exceed the bound");
}

#[test]
fn frame_rounding_stays_within_its_bound_and_norm_covers_it() {
    for seed in 0..200_u64 {
        let mut rng = TestRng(900 + seed);
        let scale = f32::exp2(40.0 * rng.next());
        let root = Transform(transform(&mut rng).root.0.map(|entry| entry * scale));
        let follower = ComposedTransform { root, frame: Some(transform(&mut rng).root) };
        let (got, expected, bound) = (follower.to_f32(), follower.to_f64(), frame_rounding_error(&follower));
        let error_of = |columns: std::ops::Range<usize>| {
            let entries = (0..12_usize).filter(|index| columns.contains(&(index % 4)));
            entries.map(|index| (f64::from(got.0[index]) - expected[index]).powi(2)).sum::<f64>().sqrt()
        };
        // Columns 0 to 2 of T are the linear part, column 3 is the translation.
        let (linear_error, translation_error) = (error_of(0..3), error_of(3..4));
        assert!(linear_error <= bound.linear && translation_error <= bound.translation, "seed {seed}");
        // The bound is not far too large.
        assert!(linear_error > 1e-3 * bound.linear, "seed {seed}: {linear_error} of {}", bound.linear);
        for linear in [follower.linear(), got.linear()] {
            let (largest_singular, norm) = (linear.singular_values().max(), linear_norm_bound(&follower));
            let limit = largest_singular * (1.0 + 1e-5);
            assert!((largest_singular..=limit).contains(&norm), "expected {largest_singular} to {limit}, got {norm}");
        }
    }
    assert_eq!(frame_rounding_error(&Transform::IDENTITY.into()), FrameError::default());
}

#[test]
fn f16_columns_of_very_different_scales_keep_their_precision() {
    let mut rng = TestRng(9);
    let scale = |mode: usize| 10_f32.powi(6 - 4 * mode as i32);
    // Four modes of 200 vertices, that is, 600 entries each. The scales are 1e6, 1e2, 1e-2 and 1e-6.
    let columns: Vec<f32> =
        (0..4).flat_map(|mode| (0..600).map(move |_| mode)).map(|mode| rng.next() * scale(mode)).collect();
    let shape = shape_with_columns(200, 4, columns, &mut rng);
    assert!(!half::f16::from_f32(shape.modes.column(0)[0]).is_finite(), "expected overflow without scaling");
    let tiles = TiledModes::new(&shape, StorageType::F16);
    for mode in 0..4 {
        let q: Vec<f32> = (0..4).map(|other| if other == mode { 1.0 / scale(mode) } else { 0.0 }).collect();
        let input = ErrorBoundInput { q: &q, transform: Transform::IDENTITY.into(), compensated: false };
        assert!(error_ratios(&shape, StorageType::F16, &input)[0] <= 1.0);
        assert!(ShapeErrorModel::new(&shape, &tiles).domain_bound(&input).storage <= 1e-3, "mode {mode}");
    }
}

#[test]
fn denormal_zero_and_extreme_values_stay_within_the_bound() {
    let mut rng = TestRng(11);
    // 200 vertices have 600 rows of U; a tile has 3 * 128 rows. Mode 0 is denormal, mode 1 is zero in the first tile,
    // mode 2 is zero everywhere. In mode 3, the entry of row 5 is far below the other entries of the first tile, and
    // all entries of the second tile underflow in f16.
    let entry = |mode: usize, row: usize, value: f32| match mode {
        0 => value * 1e-41,
        1 if row < 3 * 128 => 0.0,
        2 => 0.0,
        3 if row == 5 => value * 1e-30,
        3 if row >= 3 * 128 => value * 5e-13,
        _ => value,
    };
    let columns = (0..4 * 600).map(|index| entry(index / 600, index % 600, rng.next())).collect();
    let shape = shape_with_columns(200, 4, columns, &mut rng);
    for q in [
        [1.0, 1.0, 1.0, 1.0],
        [0.0, 0.0, 0.0, 1e8],
        [1e38, 0.0, 1e38, 1e-38],
        [1e-38, 1e-45, 0.0, 1e-40],
        [3e38, 1e30, 1.0, -1e30],
    ] {
        let input = ErrorBoundInput { q: &q, transform: transform(&mut rng), compensated: false };
        for storage in StorageType::ALL {
            let [correct, swapped] = error_ratios(&shape, storage, &input);
            assert!(correct <= 1.0, "{storage:?} {q:?}: expected at most the bound, got {correct} times it");
            // Without a term of mode 1, swapped axes may stay within the bound.
            let swapped_may_hold = q[1] < 1e-40;
            assert!(
                swapped > 1.0 || swapped_may_hold,
                "{storage:?} {q:?}: expected more than the bound, got {swapped} times it"
            );
        }
    }
}

#[test]
fn bounds_are_zero_for_sources_without_error() {
    let mut rng = TestRng(4);
    let shape = shape(50, 6, &mut rng);
    let q = [0.3; 6];
    let bound = |storage, q: &[f32]| {
        let model = ShapeErrorModel::new(&shape, &TiledModes::new(&shape, storage));
        model.domain_bound(&ErrorBoundInput { q, transform: Transform::IDENTITY.into(), compensated: false })
    };
    let f32_bound = bound(StorageType::F32, &q);
    assert_eq!((f32_bound.storage, f32_bound.coordinates), (0.0, 0.0));
    assert!(f32_bound.accumulation > 0.0 && f32_bound.rest > 0.0 && f32_bound.transform > 0.0);
    assert_eq!(bound(StorageType::F16, &q).coordinates, 0.0, "expected factors that are powers of two");
    assert!(bound(StorageType::Int8, &q).coordinates > 0.0);
    let [f16, bf16, int8] =
        [StorageType::F16, StorageType::Bf16, StorageType::Int8].map(|storage| bound(storage, &q).storage);
    assert!(f16 < bf16 && f16 < int8 && f16 > 0.0);
    let zero = bound(StorageType::Int8, &[0.0; 6]);
    assert_eq!((zero.storage, zero.coordinates, zero.accumulation, zero.rest), (0.0, 0.0, 0.0, 0.0));
}

#[test]
fn norm_is_a_tight_upper_bound_of_the_largest_singular_value() {
    let mut rng = TestRng(6);
    let check_norm = |linear: nalgebra::Matrix3<f64>| {
        let transform = Transform::from_parts(&linear, &nalgebra::Vector3::zeros());
        let exact = transform.linear().singular_values().max();
        let norm = linear_norm_bound(&transform.into());
        let limits = exact * (1.0 - 1e-15)..=exact * (1.0 + 2e-7);
        assert!(limits.contains(&norm), "expected {exact}, got {norm} for {linear}");
    };
    let rotation = nalgebra::Rotation3::from_euler_angles(0.3, -1.1, 2.0).into_inner();
    for scale in [1.0, 1e-3, 1e-40, 1e30, -2.0] {
        check_norm(rotation * scale);
        check_norm(nalgebra::Matrix3::from_diagonal(&nalgebra::Vector3::new(1.0, 1.0, 0.0)) * scale);
        check_norm(nalgebra::Matrix3::from_element(scale));
    }
    (0..1000).for_each(|_| check_norm(nalgebra::Matrix3::from_fn(|_, _| f64::from(rng.next()))));
    assert_eq!(linear_norm_bound(&Transform([0.0; 12]).into()), 0.0);
}
