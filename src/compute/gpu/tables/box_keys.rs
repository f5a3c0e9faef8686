//! Boxes as the kernels write them: keys of -x, -y, -z, x, y, z, whose order as integers is that of the numbers. Pure.

use nalgebra::Vector3;

use modalcast_model::scene::{BoundingBox, OrientedBounds};

/// The bounding axes as arguments of `bounds`; zeros without any.
pub(crate) fn axes_to_f32(axes: Option<[Vector3<f64>; 3]>) -> [f32; 9] {
    let axes = axes.unwrap_or_default();
    std::array::from_fn(|at| axes[at / 3][at % 3] as f32)
}

/// The bounds along the bounding axes, from the last six of twelve keys; `None` when there are only six keys.
///
/// The kernel rounds its sums outward, but its axes are f32. A component of a unit vector in f32 has an error of at
/// most 2^-25, so an end of the bounds has an error of at most 2^-25 times the sum of the largest coordinates. This
/// function widens the bounds by twice that.
pub(crate) fn oriented_bounds_from_keys(keys: &[u32]) -> Option<OrientedBounds> {
    let (world, oriented) = keys.split_at_checked(6).filter(|(_, oriented)| oriented.len() == 6)?;
    let world = bounds_from_keys(world);
    let farthest: f64 = world.min.iter().zip(&world.max).map(|(min, max)| min.abs().max(max.abs())).sum();
    Some(OrientedBounds(bounds_from_keys(oriented)).expanded_by(farthest * f64::from(f32::EPSILON) / 2.0))
}

/// The bounds that six keys encode.
pub(crate) fn bounds_from_keys(keys: &[u32]) -> BoundingBox {
    let mut bounds = BoundingBox::EMPTY;
    for axis in 0..3 {
        bounds.min[axis] = -f64::from(ordered_to_float(keys[axis]));
        bounds.max[axis] = f64::from(ordered_to_float(keys[3 + axis]));
    }
    bounds
}

/// `ordered_to_float` of `kernels/ordered_float.cuh`, the inverse of `float_to_ordered`. The key 0, which encodes no number, gives a NaN like
/// the key of NaN.
fn ordered_to_float(key: u32) -> f32 {
    f32::from_bits(if key >> 31 == 1 { key & 0x7fff_ffff } else { !key })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `float_to_ordered` of the kernel, branch by branch.
    fn float_to_ordered(x: f32) -> u32 {
        match x {
            x if x.is_nan() => u32::MAX,
            x if x.is_sign_negative() => !x.to_bits(),
            x => x.to_bits() | 0x8000_0000,
        }
    }

    #[test]
    fn oriented_bounds_are_the_last_six_keys_and_hold_what_the_axes_lost_in_f32() {
        let world = [1000.0_f32, 10.0, 1.0, 2000.0, 10.0, -0.5].map(float_to_ordered);
        let oriented = [1.0_f32, -2.0, 0.0, 4.0, 5.0, 6.0].map(float_to_ordered);
        assert_eq!(oriented_bounds_from_keys(&world), None, "without axes there are six");
        let OrientedBounds(got) = oriented_bounds_from_keys(&[world, oriented].concat()).expect("twelve");
        let margin = (2000.0 + 10.0 + 1.0) * 2.0_f64.powi(-24);
        for (end, want) in [(got.min, [-1.0, 2.0, 0.0]), (got.max, [4.0, 5.0, 6.0])] {
            let out = |axis: usize| if want[axis] == end[axis] { 0.0 } else { (want[axis] - end[axis]).abs() };
            assert!((0..3).all(|axis| (out(axis) - margin).abs() < 1e-12), "{end:?}");
        }
        assert!(got.min[0] < -1.0 && got.max[2] > 6.0, "outwards");
        let mut lost = oriented;
        lost[4] = float_to_ordered(f32::NAN);
        assert!(!oriented_bounds_from_keys(&[world, lost].concat()).is_some_and(|oriented| oriented.is_valid()));
        assert!(
            !oriented_bounds_from_keys(&[0; 12]).is_some_and(|oriented| oriented.is_valid()),
            "nothing was measured"
        );
    }

    #[test]
    fn the_margin_covers_axes_in_f32_whatever_the_sun() {
        let mut worst = 0.0_f64;
        for step in 0..1000 {
            let angle = 0.1 * f64::from(step);
            let sun = Vector3::new(angle.sin(), (1.7 * angle).cos(), (0.3 * angle).sin()).normalize();
            let axes = modalcast_model::scene::light_axes(sun, modalcast_model::scene::UpAxis::Y);
            for (axis, axes_to_f32) in axes.iter().zip(axes_to_f32(Some(axes)).chunks_exact(3)) {
                (0..3).for_each(|at| worst = worst.max((axis[at] - f64::from(axes_to_f32[at])).abs()));
            }
        }
        assert!(worst <= 2.0_f64.powi(-25) && worst > 2.0_f64.powi(-28), "{worst}");
        assert_eq!(axes_to_f32(None), [0.0; 9]);
    }

    #[test]
    fn keys_keep_the_order_of_numbers_and_a_nan_or_nothing_is_not_finite() {
        let rising = [f32::NEG_INFINITY, -1e30, -1.0, -1e-45, -0.0, 0.0, 1e-45, 2.5, f32::MAX, f32::INFINITY];
        for pair in rising.windows(2) {
            assert!(float_to_ordered(pair[0]) < float_to_ordered(pair[1]), "{pair:?}");
            assert!(float_to_ordered(pair[0]) > 0);
        }
        for number in rising {
            assert_eq!(ordered_to_float(float_to_ordered(number)).to_bits(), number.to_bits());
        }
        assert!(ordered_to_float(float_to_ordered(f32::NAN)).is_nan());
        assert!(ordered_to_float(0).is_nan());
        let good = [-1.0_f32, -2.0, -3.0, 4.0, 5.0, 6.0].map(float_to_ordered);
        assert_eq!(bounds_from_keys(&good), BoundingBox { min: [1.0, 2.0, 3.0], max: [4.0, 5.0, 6.0] });
        for bad in [f32::NAN, f32::INFINITY] {
            let mut keys = good;
            keys[4] = float_to_ordered(bad);
            assert!(!bounds_from_keys(&keys).is_finite());
        }
        assert!(!bounds_from_keys(&[0; 6]).is_finite());
    }
}
