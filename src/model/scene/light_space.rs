//! Light space: the coordinate axes of the sun's shadow map (section 3.3.1 of B. Wang's thesis, "CUDA Deformers for
//! Model Reduction"), and bounding boxes along these axes.
//!
//! With `ShadowFit::Corners`, the shadow map is fitted to the eight corners of the world-space bounding box, as in the
//! thesis. With `ShadowFit::Vertices`, the box in light space is tighter: it bounds the vertices, or the corners of the
//! bounding boxes of small parts of the surface.

use nalgebra::Vector3;

use super::shadow::ShadowFit;
use super::{BoundingBox, Scene, UpAxis};

/// The x, y and z axes of light space as unit vectors in the world. z is the direction to the sun (v_l in the thesis),
/// and y points up. If z is vertical, the choice of y is arbitrary.
pub fn light_axes(to_sun: Vector3<f64>, up: UpAxis) -> [Vector3<f64>; 3] {
    let horizontal = up.vector().cross(&to_sun);
    let x = horizontal.try_normalize(1e-6).unwrap_or_else(|| {
        let fallback_axis = if to_sun.x.abs() < 0.9 { Vector3::x() } else { Vector3::y() };
        fallback_axis.cross(&to_sun).normalize()
    });
    [x, to_sun.cross(&x), to_sun]
}

impl Scene {
    /// The axes along which deformers compute bounds of the vertices. `None` unless a shadow map is fitted to the
    /// vertices.
    pub fn light_axes(&self) -> Option<[Vector3<f64>; 3]> {
        let is_fitted = self.look.shadow.is_some_and(|shadow| shadow.fit == ShadowFit::Vertices);
        is_fitted.then(|| light_axes(self.look.to_sun(self.up), self.up))
    }
}

/// A bounding box along three orthogonal axes, such as those of light space. It is in scene units and relative to the
/// same origin as the bounded positions. Empty if `min > max`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OrientedBounds(pub BoundingBox);

impl OrientedBounds {
    pub const EMPTY: Self = Self(BoundingBox::EMPTY);

    /// The smallest box along these axes that contains a world-space box. NaN and infinite coordinates yield NaN or
    /// infinite bounds. An empty box yields an empty box.
    pub fn enclosing(axes: &[Vector3<f64>; 3], world_box: &BoundingBox) -> Self {
        if world_box.min[0] > world_box.max[0] {
            return Self::EMPTY;
        }
        let bound = |axis: usize, is_upper: bool| {
            let contribution = |world_axis: usize| {
                let component = axes[axis][world_axis];
                let uses_max = (component >= 0.0) == is_upper;
                component * if uses_max { world_box.max[world_axis] } else { world_box.min[world_axis] }
            };
            contribution(0) + contribution(1) + contribution(2)
        };
        Self(BoundingBox {
            min: std::array::from_fn(|axis| bound(axis, false)),
            max: std::array::from_fn(|axis| bound(axis, true)),
        })
    }

    /// The smallest box that contains both. NaN in either propagates.
    #[must_use]
    pub fn union(self, other: Self) -> Self {
        Self(self.0.union(other.0))
    }

    /// The box, extended by `margin` at all sides.
    #[must_use]
    pub fn expanded_by(self, margin: f64) -> Self {
        Self(BoundingBox { min: self.0.min.map(|bound| bound - margin), max: self.0.max.map(|bound| bound + margin) })
    }

    /// Whether a shadow map can be fitted to the box: it is finite and not empty.
    pub fn is_valid(&self) -> bool {
        self.0.is_finite() && self.0.min[0] <= self.0.max[0]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn suns() -> [Vector3<f64>; 5] {
        [[0.4, 0.8, 0.5], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, -1.0, 1e-9], [-0.3, 0.1, -0.9]]
            .map(|direction| Vector3::from(direction).normalize())
    }

    #[test]
    fn axes_are_orthonormal_with_y_up_and_z_to_the_sun() {
        for (sun, up) in suns().into_iter().flat_map(|sun| [UpAxis::X, UpAxis::Y, UpAxis::Z].map(|up| (sun, up))) {
            let [x, y, z] = light_axes(sun, up);
            assert!((x.cross(&y) - z).norm() < 1e-12 && (x.norm() - 1.0).abs() < 1e-12, "{sun}");
            assert!(z == sun && y.dot(&up.vector()) >= -1e-12, "{sun} {up:?}");
        }
    }

    #[test]
    fn enclosing_box_equals_the_bounds_of_the_corners() {
        let world = BoundingBox { min: [-1.0, 0.5, -2.0], max: [1.5, 3.0, 2.0] };
        for sun in suns() {
            let axes = light_axes(sun, UpAxis::Y);
            let mut expected = BoundingBox::EMPTY;
            for corner in world.corners() {
                expected.include(axes.map(|axis| axis.dot(&corner.coords)));
            }
            let OrientedBounds(actual) = OrientedBounds::enclosing(&axes, &world);
            for axis in 0..3 {
                assert!(
                    (actual.min[axis] - expected.min[axis]).abs() < 1e-12
                        && (actual.max[axis] - expected.max[axis]).abs() < 1e-12
                );
            }
        }
    }

    #[test]
    fn non_finite_coordinates_make_the_bounds_invalid() {
        let axes = light_axes(suns()[0], UpAxis::Y);
        let enclosing = |min, max| OrientedBounds::enclosing(&axes, &BoundingBox { min, max });
        let unit_box = enclosing([0.0; 3], [1.0; 3]);
        assert!(unit_box.is_valid() && !OrientedBounds::EMPTY.is_valid());
        assert_eq!(OrientedBounds::enclosing(&axes, &BoundingBox::EMPTY), OrientedBounds::EMPTY);
        assert_eq!(unit_box.union(OrientedBounds::EMPTY), unit_box);
        for coordinate in [f64::NAN, f64::INFINITY] {
            assert!(!enclosing([0.0; 3], [1.0, coordinate, 1.0]).is_valid());
            assert!(!unit_box.union(enclosing([0.0; 3], [1.0, coordinate, 1.0])).is_valid());
        }
        assert_eq!(unit_box.expanded_by(0.5).0.max[2], unit_box.0.max[2] + 0.5);
    }
}
