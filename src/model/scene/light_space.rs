//! Light space: the coordinate axes of the sun's shadow map (section 3.3.1 of the thesis), and bounding boxes in it.
//!
//! The thesis takes the axis-aligned bounding box of all vertices in the world, and in light space the bounding box of
//! its eight corners. Here, the light-space box is tighter: it bounds the corners of the boxes of small parts of the
//! surface, or the vertices themselves.

use nalgebra::Vector3;

use super::shadow::ShadowFit;
use super::{BoundingBox, Scene, UpAxis};

/// The x, y and z axes of light space as unit vectors in the world. z is v_l, the direction to the sun, and y points
/// up. If the sun is at the zenith, "up" does not determine y, and y is chosen arbitrarily.
pub fn light_axes(to_sun: Vector3<f64>, up: UpAxis) -> [Vector3<f64>; 3] {
    let across = up.vector().cross(&to_sun);
    let x = across.try_normalize(1e-6).unwrap_or_else(|| {
        let other = if to_sun.x.abs() < 0.9 { Vector3::x() } else { Vector3::y() };
        other.cross(&to_sun).normalize()
    });
    [x, to_sun.cross(&x), to_sun]
}

impl Scene {
    /// The axes along which the renderer needs bounds of the vertices. `None` if the look has no shadow map that is
    /// fitted to the vertices.
    pub fn light_axes(&self) -> Option<[Vector3<f64>; 3]> {
        let fitted = self.look.shadow.filter(|shadow| shadow.fit == ShadowFit::Vertices);
        fitted.map(|_| light_axes(self.look.to_sun(self.up), self.up))
    }
}

/// A bounding box along three orthogonal axes, such as those of light space, in scene units and relative to the same
/// origin as the bounded positions. Empty if `min > max`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OrientedBounds(pub BoundingBox);

impl OrientedBounds {
    pub const EMPTY: Self = Self(BoundingBox::EMPTY);

    /// The smallest box along these axes that contains a world-space box: along each axis, a corner of the box is the
    /// farthest point. NaN and infinite coordinates yield NaN or infinite bounds; an empty box yields an empty one.
    pub fn enclosing(axes: &[Vector3<f64>; 3], world: &BoundingBox) -> Self {
        if world.min[0] > world.max[0] {
            return Self::EMPTY;
        }
        let end = |axis: usize, is_upper: bool| {
            let farthest = |along: usize| {
                let part = axes[axis][along];
                part * if (part >= 0.0) == is_upper { world.max[along] } else { world.min[along] }
            };
            farthest(0) + farthest(1) + farthest(2)
        };
        Self(BoundingBox {
            min: std::array::from_fn(|axis| end(axis, false)),
            max: std::array::from_fn(|axis| end(axis, true)),
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
        Self(BoundingBox { min: self.0.min.map(|end| end - margin), max: self.0.max.map(|end| end + margin) })
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
            .map(|sun| Vector3::from(sun).normalize())
    }

    #[test]
    fn axes_are_perpendicular_unit_vectors_with_y_up_and_z_to_the_sun() {
        for (sun, up) in suns().into_iter().flat_map(|sun| [UpAxis::X, UpAxis::Y, UpAxis::Z].map(|up| (sun, up))) {
            let [x, y, z] = light_axes(sun, up);
            assert!((x.cross(&y) - z).norm() < 1e-12 && (x.norm() - 1.0).abs() < 1e-12, "{sun}");
            assert!(z == sun && y.dot(&up.vector()) >= -1e-12, "{sun} {up:?}");
        }
    }

    #[test]
    fn a_box_in_light_space_reaches_to_the_farthest_corners_and_no_farther() {
        let world = BoundingBox { min: [-1.0, 0.5, -2.0], max: [1.5, 3.0, 2.0] };
        for sun in suns() {
            let axes = light_axes(sun, UpAxis::Y);
            let mut want = BoundingBox::EMPTY;
            for corner in world.corners() {
                want.include(axes.map(|axis| axis.dot(&corner.coords)));
            }
            let OrientedBounds(got) = OrientedBounds::enclosing(&axes, &world);
            for axis in 0..3 {
                assert!(
                    (got.min[axis] - want.min[axis]).abs() < 1e-12 && (got.max[axis] - want.max[axis]).abs() < 1e-12
                );
            }
        }
    }

    #[test]
    fn nothing_is_empty_and_what_is_not_finite_is_told() {
        let axes = light_axes(suns()[0], UpAxis::Y);
        let of = |min, max| OrientedBounds::enclosing(&axes, &BoundingBox { min, max });
        let good = of([0.0; 3], [1.0; 3]);
        assert!(good.is_valid() && !OrientedBounds::EMPTY.is_valid());
        assert_eq!(OrientedBounds::enclosing(&axes, &BoundingBox::EMPTY), OrientedBounds::EMPTY);
        assert_eq!(good.union(OrientedBounds::EMPTY), good);
        for bad in [f64::NAN, f64::INFINITY] {
            assert!(!of([0.0; 3], [1.0, bad, 1.0]).is_valid());
            assert!(!good.union(of([0.0; 3], [1.0, bad, 1.0])).is_valid());
        }
        assert_eq!(good.expanded_by(0.5).0.max[2], good.0.max[2] + 0.5);
    }
}
