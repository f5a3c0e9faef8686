//! Boxes as the kernels write them: the maxima of -x, -y, -z, x, y, z as integer keys. Keys compare as the numbers that
//! they encode.

use nalgebra::Vector3;

use modalcast_model::scene::{BoundingBox, OrientedBounds};

/// The bounding axes as arguments of `bounds`; zeros if there are none.
pub(crate) fn axes_to_f32(axes: Option<[Vector3<f64>; 3]>) -> [f32; 9] {
    let axes = axes.unwrap_or_default();
    std::array::from_fn(|index| axes[index / 3][index % 3] as f32)
}

/// The bounds along the bounding axes, from the last six of twelve keys; `None` when there are only six keys.
///
/// The kernel rounds its sums outward, but its axes are rounded to f32. A component of a unit vector then has an error
/// of at most 2^-25, so each bound has an error of at most 2^-25 times the sum of the largest absolute x, y and z. This
/// function widens the bounds by twice that error, 2^-24 = `f32::EPSILON` / 2 times the sum.
pub(crate) fn oriented_bounds_from_keys(keys: &[u32]) -> Option<OrientedBounds> {
    let (world, oriented) = keys.split_at_checked(6).filter(|(_, oriented)| oriented.len() == 6)?;
    let world = bounds_from_keys(world);
    let coordinate_sum: f64 = world.min.iter().zip(&world.max).map(|(min, max)| min.abs().max(max.abs())).sum();
    Some(OrientedBounds(bounds_from_keys(oriented)).expanded_by(coordinate_sum * f64::from(f32::EPSILON) / 2.0))
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

/// Twin of `ordered_to_float` in `kernels/ordered_float.cuh`, the inverse of `float_to_ordered`. Key 0, which no number
/// has, gives NaN.
fn ordered_to_float(key: u32) -> f32 {
    f32::from_bits(if key >> 31 == 1 { key & 0x7fff_ffff } else { !key })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Twin of `float_to_ordered` in the kernels.
    fn float_to_ordered(x: f32) -> u32 {
        match x {
            x if x.is_nan() => u32::MAX,
            x if x.is_sign_negative() => !x.to_bits(),
            x => x.to_bits() | 0x8000_0000,
        }
    }

    #[test]
    fn oriented_bounds_cover_the_rounding_error_of_the_axes() {
        let world = [1000.0_f32, 10.0, 1.0, 2000.0, 10.0, -0.5].map(float_to_ordered);
        let oriented = [1.0_f32, -2.0, 0.0, 4.0, 5.0, 6.0].map(float_to_ordered);
        assert_eq!(oriented_bounds_from_keys(&world), None, "six keys have no oriented bounds");
        let OrientedBounds(bounds) = oriented_bounds_from_keys(&[world, oriented].concat()).expect("oriented bounds");
        let margin = (2000.0 + 10.0 + 1.0) * 2.0_f64.powi(-24);
        for (widened, exact) in [(bounds.min, [-1.0_f64, 2.0, 0.0]), (bounds.max, [4.0, 5.0, 6.0])] {
            let widening = |axis: usize| (exact[axis] - widened[axis]).abs();
            assert!((0..3).all(|axis| (widening(axis) - margin).abs() < 1e-12), "{widened:?}");
        }
        assert!(bounds.min[0] < -1.0 && bounds.max[2] > 6.0, "expected wider bounds, got {bounds:?}");
        let is_valid = |keys: &[u32]| oriented_bounds_from_keys(keys).is_some_and(|bounds| bounds.is_valid());
        let mut with_nan = oriented;
        with_nan[4] = float_to_ordered(f32::NAN);
        assert!(!is_valid(&[world, with_nan].concat()));
        assert!(!is_valid(&[0; 12]), "keys that no number has");
    }

    #[test]
    fn rounding_error_of_axes_is_at_most_two_to_minus_25() {
        let mut max_error = 0.0_f64;
        for step in 0..1000 {
            let angle = 0.1 * f64::from(step);
            let sun = Vector3::new(angle.sin(), (1.7 * angle).cos(), (0.3 * angle).sin()).normalize();
            let axes = modalcast_model::scene::light_axes(sun, modalcast_model::scene::UpAxis::Y);
            for (axis, rounded_axis) in axes.iter().zip(axes_to_f32(Some(axes)).chunks_exact(3)) {
                let error = |component: usize| (axis[component] - f64::from(rounded_axis[component])).abs();
                max_error = (0..3).map(error).fold(max_error, f64::max);
            }
        }
        assert!(max_error <= 2.0_f64.powi(-25) && max_error > 2.0_f64.powi(-28), "{max_error}");
        assert_eq!(axes_to_f32(None), [0.0; 9]);
    }

    #[test]
    fn keys_compare_as_their_numbers() {
        let ascending = [f32::NEG_INFINITY, -1e30, -1.0, -1e-45, -0.0, 0.0, 1e-45, 2.5, f32::MAX, f32::INFINITY];
        for pair in ascending.windows(2) {
            assert!(float_to_ordered(pair[0]) < float_to_ordered(pair[1]), "{pair:?}");
            assert!(float_to_ordered(pair[0]) > 0);
        }
        for number in ascending {
            assert_eq!(ordered_to_float(float_to_ordered(number)).to_bits(), number.to_bits());
        }
        assert!(ordered_to_float(float_to_ordered(f32::NAN)).is_nan());
        assert!(ordered_to_float(0).is_nan());
        let finite = [-1.0_f32, -2.0, -3.0, 4.0, 5.0, 6.0].map(float_to_ordered);
        assert_eq!(bounds_from_keys(&finite), BoundingBox { min: [1.0, 2.0, 3.0], max: [4.0, 5.0, 6.0] });
        for non_finite in [f32::NAN, f32::INFINITY] {
            let mut keys = finite;
            keys[4] = float_to_ordered(non_finite);
            assert!(!bounds_from_keys(&keys).is_finite());
        }
        assert!(!bounds_from_keys(&[0; 6]).is_finite());
    }
}
