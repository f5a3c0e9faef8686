use super::*;
use crate::testing::{TestRng, shape, with_columns};

/// A random transform with shear, possibly mirroring.
fn transform(noise: &mut TestRng) -> ComposedTransform {
    Transform(std::array::from_fn(|_| 2.0 * noise.next())).into()
}

/// The sums that the module describes, in f32 on stored entries. Reads axis `axis + turn` in place of `axis`.
fn chained(shape: &Shape, tiles: &TiledModes, step: &ErrorBoundInput, turn: usize) -> Vec<[f32; 3]> {
    let t = step.transform.to_f32().0;
    let position = |vertex: usize| {
        let place = vertex / crate::storage::QUAD / crate::storage::TILE_QUADS;
        let bent: [f32; 3] = std::array::from_fn(|axis| {
            let mut sum = 0.0_f32;
            for (mode, q) in step.q.iter().enumerate() {
                let factor = factor(tiles, place, mode);
                if factor > 0.0 {
                    let stored = tiles.decode_entry(vertex, (axis + turn) % 3, mode) / f64::from(factor);
                    sum = (stored as f32).mul_add(q * factor, sum);
                }
            }
            sum + shape.mesh.rest_positions()[vertex][axis]
        });
        std::array::from_fn(|row| {
            let [x, y, z, offset] = [0, 1, 2, 3].map(|column| t[4 * row + column]);
            z.mul_add(bent[2], y.mul_add(bent[1], x.mul_add(bent[0], offset)))
        })
    };
    (0..tiles.vertices()).map(position).collect()
}

fn exact(shape: &Shape, step: &ErrorBoundInput) -> Vec<[f64; 3]> {
    let t = step.transform.to_f64();
    let position = |vertex: usize| {
        let bent = [0, 1, 2].map(|axis| {
            let part = |(mode, q): (usize, &f32)| f64::from(*q) * f64::from(shape.modes.entry(vertex, axis, mode));
            f64::from(shape.mesh.rest_positions()[vertex][axis]) + step.q.iter().enumerate().map(part).sum::<f64>()
        });
        [0, 4, 8].map(|row| t[row] * bent[0] + t[row + 1] * bent[1] + t[row + 2] * bent[2] + t[row + 3])
    };
    (0..shape.mesh.rest_positions().len()).map(position).collect()
}

/// The largest error relative to the bound of its tile; infinite for a NaN.
fn worst(got: &[[f32; 3]], want: &[[f64; 3]], bounds: impl Fn(usize) -> f64) -> f64 {
    let part = |(vertex, (got, want)): (usize, (&[f32; 3], &[f64; 3]))| {
        let error = length([0, 1, 2].map(|axis| f64::from(got[axis]) - want[axis]));
        let part = error / bounds(vertex / 128);
        if part.is_nan() { f64::INFINITY } else { part }
    };
    got.iter().zip(want).enumerate().map(part).fold(0.0, f64::max)
}

/// Measured error over bound, for correct axes and for swapped axes.
fn judge(shape: &Shape, storage: StorageType, step: &ErrorBoundInput) -> [f64; 2] {
    let tiles = TiledModes::new(shape, storage);
    let reaches = ShapeErrorModel::new(shape, &tiles);
    let want = exact(shape, step);
    let bounds = |tile: usize| reaches.tile(tile, step).total();
    assert!((0..tiles.count()).all(|tile| bounds(tile) <= reaches.domain(step).total()));
    [0, 1].map(|turn| worst(&chained(shape, &tiles, step, turn), &want, bounds))
}

#[test]
fn the_bound_holds_for_every_storage_size_and_seed_and_mistaken_axes_break_it() {
    let sizes = [(1, 1), (1, 512), (7, 3), (130, 31), (129, 33), (40, 5), (5, 512), (300, 1)];
    for seed in 0..120_u64 {
        let mut noise = TestRng(seed);
        let (vertices, rank) = sizes[seed as usize % sizes.len()];
        let shape = shape(vertices, rank, &mut noise);
        let q: Vec<f32> = (0..rank).map(|_| noise.next() * f32::exp2(6.0 * noise.next())).collect();
        let step = ErrorBoundInput { q: &q, transform: transform(&mut noise), compensated: false };
        for storage in StorageType::ALL {
            let [right, wrong] = judge(&shape, storage, &step);
            assert!(right <= 1.0, "{storage:?}, {vertices} x {rank}, seed {seed}: {right} of the bound");
            assert!(
                wrong > 1.0,
                "{storage:?}, {vertices} x {rank}, seed {seed}: mistaken axes at {wrong} of the bound"
            );
        }
    }
}

#[test]
fn the_bound_of_a_follower_holds_for_every_seed_and_breaks_where_its_frame_is_left_out_or_rounds_more() {
    let (mut largest, mut coarser) = (0.0_f64, 0);
    for seed in 0..120_u64 {
        let mut noise = TestRng(500 + seed);
        let shape = shape(40, 3, &mut noise);
        let q: Vec<f32> = (0..3).map(|_| noise.next()).collect();
        let (root, frame) = (transform(&mut noise).root, transform(&mut noise).root);
        let step = |transform| ErrorBoundInput { q: &q, transform, compensated: false };
        let follows = ComposedTransform { root, frame: Some(frame) };
        let tiles = TiledModes::new(&shape, StorageType::F32);
        let bound = ShapeErrorModel::new(&shape, &tiles).domain(&step(follows));
        let want = exact(&shape, &step(follows));
        let part = |transform: ComposedTransform| {
            worst(&chained(&shape, &tiles, &step(transform), 0), &want, |_| bound.total())
        };
        largest = largest.max(part(follows));
        assert!(part(follows) <= 1.0, "seed {seed}: {} of the bound", part(follows));
        assert!(part(root.into()) > 1.0, "seed {seed}: without its frame at {}", part(root.into()));
        // A frame of ten bits, as if products were rounded to bf16.
        let coarse = Transform(frame.0.map(|entry| f32::from_bits(entry.to_bits() & 0xffff_e000)));
        coarser += usize::from(part(ComposedTransform { root, frame: Some(coarse) }) > 1.0);
    }
    assert!(largest > 0.01, "{largest} of the bound at most: it would be of no use");
    assert_eq!(coarser, 120);
}

#[test]
fn rounding_the_product_of_a_frame_is_within_its_part_of_the_bound_and_the_norm_covers_both() {
    for seed in 0..200_u64 {
        let mut noise = TestRng(900 + seed);
        let scale = f32::exp2(40.0 * noise.next());
        let root = Transform(transform(&mut noise).root.0.map(|entry| entry * scale));
        let follows = ComposedTransform { root, frame: Some(transform(&mut noise).root) };
        let (got, want, [turned, moved]) = (follows.to_f32(), follows.to_f64(), rounding(&follows));
        let error = |linear: bool| {
            let entries = (0..12).filter(|at| (at % 4 != 3) == linear);
            entries.map(|at| (f64::from(got.0[at]) - want[at]).powi(2)).sum::<f64>().sqrt()
        };
        assert!(error(true) <= turned && error(false) <= moved, "seed {seed}");
        assert!(error(true) > 1e-3 * turned, "seed {seed}: {} of {turned}", error(true));
        for linear in [follows.linear(), got.linear()] {
            let (singular, norm) = (linear.singular_values().max(), norm(&follows));
            assert!(norm >= singular && norm <= singular * (1.0 + 1e-5), "{norm} for {singular}");
        }
    }
    assert_eq!(rounding(&Transform::IDENTITY.into()), [0.0; 2]);
}

#[test]
fn columns_that_differ_by_a_factor_of_1e12_keep_their_digits_in_f16_and_would_overflow_unscaled() {
    let mut noise = TestRng(9);
    let scale = |mode: usize| 10_f32.powi(6 - 4 * mode as i32);
    let columns: Vec<f32> =
        (0..4).flat_map(|mode| (0..600).map(move |_| mode)).map(|m| noise.next() * scale(m)).collect();
    let shape = with_columns(200, 4, columns, &mut noise);
    assert!(!half::f16::from_f32(shape.modes.column(0)[0]).is_finite());
    let tiles = TiledModes::new(&shape, StorageType::F16);
    for mode in 0..4 {
        let alone: Vec<f32> = (0..4).map(|other| if other == mode { 1.0 / scale(mode) } else { 0.0 }).collect();
        let step = ErrorBoundInput { q: &alone, transform: Transform::IDENTITY.into(), compensated: false };
        assert!(judge(&shape, StorageType::F16, &step)[0] <= 1.0);
        assert!(ShapeErrorModel::new(&shape, &tiles).domain(&step).storage <= 1e-3, "mode {mode}");
    }
}

#[test]
fn denormal_columns_zero_tiles_and_extreme_amounts_stay_within_the_bound() {
    let mut noise = TestRng(11);
    // Mode 0 is denormal, mode 1 is zero in the first tile, mode 2 is zero everywhere. Mode 3 has one entry far below
    // the rest, and all of its second tile is too small for f16.
    let entry = |mode: usize, row: usize, value: f32| match mode {
        0 => value * 1e-41,
        1 if row < 3 * 128 => 0.0,
        2 => 0.0,
        3 if row == 5 => value * 1e-30,
        3 if row >= 3 * 128 => value * 5e-13,
        _ => value,
    };
    let columns = (0..4 * 600).map(|at| entry(at / 600, at % 600, noise.next())).collect();
    let shape = with_columns(200, 4, columns, &mut noise);
    for q in [
        [1.0, 1.0, 1.0, 1.0],
        [0.0, 0.0, 0.0, 1e8],
        [1e38, 0.0, 1e38, 1e-38],
        [1e-38, 1e-45, 0.0, 1e-40],
        [3e38, 1e30, 1.0, -1e30],
    ] {
        let step = ErrorBoundInput { q: &q, transform: transform(&mut noise), compensated: false };
        for storage in StorageType::ALL {
            let [right, wrong] = judge(&shape, storage, &step);
            assert!(right <= 1.0, "{storage:?} {q:?}: {right} of the bound");
            assert!(wrong > 1.0 || q[1] < 1e-40, "{storage:?} {q:?}: mistaken axes at {wrong}");
        }
    }
}

#[test]
fn sources_are_zero_where_there_is_no_such_error() {
    let mut noise = TestRng(4);
    let shape = shape(50, 6, &mut noise);
    let q = [0.3; 6];
    let bound = |storage, q: &[f32]| {
        let reaches = ShapeErrorModel::new(&shape, &TiledModes::new(&shape, storage));
        reaches.domain(&ErrorBoundInput { q, transform: Transform::IDENTITY.into(), compensated: false })
    };
    let plain = bound(StorageType::F32, &q);
    assert_eq!((plain.storage, plain.coordinates), (0.0, 0.0));
    assert!(plain.accumulation > 0.0 && plain.rest > 0.0 && plain.transform > 0.0);
    assert_eq!(bound(StorageType::F16, &q).coordinates, 0.0, "a power of two rounds nothing");
    assert!(bound(StorageType::Int8, &q).coordinates > 0.0);
    let [f16, bf16, int8] =
        [StorageType::F16, StorageType::Bf16, StorageType::Int8].map(|storage| bound(storage, &q).storage);
    assert!(f16 < bf16 && f16 < int8 && f16 > 0.0);
    let still = bound(StorageType::Int8, &[0.0; 6]);
    assert_eq!((still.storage, still.coordinates, still.accumulation, still.rest), (0.0, 0.0, 0.0, 0.0));
}

#[test]
fn the_norm_is_not_below_the_largest_singular_value_and_hardly_above_it() {
    let mut noise = TestRng(6);
    let judge = |linear: nalgebra::Matrix3<f64>| {
        let transform = Transform::from_parts(&linear, &nalgebra::Vector3::zeros());
        let exact = transform.linear().singular_values().max();
        let norm = norm(&transform.into());
        assert!(norm >= exact * (1.0 - 1e-15) && norm <= exact * (1.0 + 2e-7), "{norm} for {exact} of {linear}");
    };
    let turn = nalgebra::Rotation3::from_euler_angles(0.3, -1.1, 2.0).into_inner();
    for scale in [1.0, 1e-3, 1e-40, 1e30, -2.0] {
        judge(turn * scale);
        judge(nalgebra::Matrix3::from_diagonal(&nalgebra::Vector3::new(1.0, 1.0, 0.0)) * scale);
        judge(nalgebra::Matrix3::from_element(scale));
    }
    (0..1000).for_each(|_| judge(nalgebra::Matrix3::from_fn(|_, _| f64::from(noise.next()))));
    assert_eq!(norm(&Transform([0.0; 12]).into()), 0.0);
}
