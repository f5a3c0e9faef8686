//! Affine transforms in f64 and the rigid motion that best fits moved points. Transforms are 3x4 row-major on the wire
//! and are named by target and source frame (`world_from_domain`).

use nalgebra::{Matrix3, Vector3};

/// An affine transform x -> A x + t.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Affine {
    pub linear: Matrix3<f64>,
    pub translation: Vector3<f64>,
}

impl Affine {
    /// The identity.
    pub fn identity() -> Self {
        Self { linear: Matrix3::identity(), translation: Vector3::zeros() }
    }

    /// Converts from twelve numbers, row-major 3x4.
    pub fn from_entries(entries: &[f32; 12]) -> Self {
        let at = |row: usize, column: usize| f64::from(entries[4 * row + column]);
        Self { linear: Matrix3::from_fn(at), translation: Vector3::from_fn(|row, _| at(row, 3)) }
    }

    /// Rounds to twelve f32, row-major 3x4.
    pub fn entries(&self) -> [f32; 12] {
        std::array::from_fn(|at| {
            let (row, column) = (at / 4, at % 4);
            if column == 3 { self.translation[row] as f32 } else { self.linear[(row, column)] as f32 }
        })
    }

    /// Composes transforms: `a_from_c = a_from_b.compose(b_from_c)`.
    #[must_use]
    pub fn compose(&self, b_from_c: &Self) -> Self {
        Self { linear: self.linear * b_from_c.linear, translation: self.apply(&b_from_c.translation) }
    }

    /// Transforms a point.
    pub fn apply(&self, point: &Vector3<f64>) -> Vector3<f64> {
        self.linear * point + self.translation
    }

    /// A rotation by `angle` radians about an axis through the point `about`. The axis is normalized.
    pub fn rotation_about(axis: &Vector3<f64>, angle: f64, about: &Vector3<f64>) -> Self {
        let turn = nalgebra::Rotation3::from_axis_angle(&nalgebra::Unit::new_normalize(*axis), angle).into_inner();
        Self { linear: turn, translation: about - turn * about }
    }
}

/// The proper rotation and translation that map `rest` to `now` with the least squared error (Kabsch 1976). Fewer than
/// three points, or collinear points, do not determine the rotation: then the result is the translation of the mean.
pub fn rigid_motion(rest: &[Vector3<f64>], now: &[Vector3<f64>]) -> Affine {
    let count = rest.len().min(now.len());
    if count == 0 {
        return Affine::identity();
    }
    let mean = |points: &[Vector3<f64>]| points[..count].iter().sum::<Vector3<f64>>() / count as f64;
    let (from, to) = (mean(rest), mean(now));
    let pairs = rest.iter().zip(now).map(|(rest, now)| (now - to) * (rest - from).transpose());
    let turn = rotation(&pairs.sum());
    Affine { linear: turn, translation: to - turn * from }
}

/// The proper rotation nearest to a 3x3 correlation matrix; the identity if two of its singular values vanish.
fn rotation(correlation: &Matrix3<f64>) -> Matrix3<f64> {
    let parts = correlation.svd(true, true);
    let (Some(left), Some(right)) = (parts.u, parts.v_t) else { return Matrix3::identity() };
    let sizes = parts.singular_values;
    let spread = sizes[0].is_normal() && sizes[1] > 1e-9 * sizes[0];
    if !spread {
        return Matrix3::identity();
    }
    let mirrored = (left * right).determinant() < 0.0;
    let mut signs = Matrix3::identity();
    // The third singular value of a planar ring is zero, so its direction can be flipped to make the rotation proper.
    signs[(2, 2)] = if mirrored { -1.0 } else { 1.0 };
    left * signs * right
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ring(points: usize) -> Vec<Vector3<f64>> {
        let turn = |at: usize| 2.0 * std::f64::consts::PI * at as f64 / points as f64;
        (0..points).map(|at| Vector3::new(turn(at).cos() * 0.1, 2.0, turn(at).sin() * 0.1)).collect()
    }

    #[test]
    fn rigid_motion_recovers_the_motion_of_a_planar_ring() {
        for angle in [0.0, 1e-9, 0.3, 1.5, 3.0] {
            let motion = Affine::rotation_about(&Vector3::new(1.0, 2.0, -0.5), angle, &Vector3::new(0.3, -1.0, 4.0));
            let rest = ring(8);
            let now: Vec<_> = rest.iter().map(|point| motion.apply(point)).collect();
            let got = rigid_motion(&rest, &now);
            assert!((got.linear - motion.linear).abs().max() <= 1e-12, "{angle}: {}", got.linear);
            assert!((got.translation - motion.translation).norm() <= 1e-11, "{angle}");
        }
    }

    #[test]
    fn rotation_of_mirrored_points_is_proper() {
        let rest: [Vector3<f64>; 4] = [Vector3::x(), Vector3::y(), Vector3::z(), Vector3::zeros()];
        let now = rest.map(|point| Vector3::new(-point.x, point.y, point.z));
        let got = rigid_motion(&rest, &now);
        assert!((got.linear.determinant() - 1.0).abs() <= 1e-12);
        assert!((got.linear.transpose() * got.linear - Matrix3::identity()).abs().max() <= 1e-12);
    }

    #[test]
    fn too_few_or_collinear_points_only_translate() {
        let by = Vector3::new(1.0, -2.0, 3.0);
        let line: Vec<_> = (0..5).map(|at| Vector3::new(f64::from(at), 0.0, 0.0)).collect();
        let same = vec![Vector3::x(); 4];
        for rest in [vec![], vec![Vector3::x()], vec![Vector3::x(), Vector3::y()], line, same] {
            let now: Vec<_> = rest.iter().map(|point| point + by).collect();
            let got = rigid_motion(&rest, &now);
            let want = if rest.is_empty() { Vector3::zeros() } else { by };
            assert!((got.translation - want).norm() <= 1e-12, "{} points: {}", rest.len(), got.translation);
            assert_eq!(got.linear, Matrix3::identity());
        }
    }

    #[test]
    fn entries_round_trip_and_transforms_compose() {
        let turn = Affine::rotation_about(&Vector3::z(), std::f64::consts::FRAC_PI_2, &Vector3::new(1.0, 0.0, 0.0));
        let there = turn.apply(&Vector3::new(2.0, 0.0, 0.0));
        assert!((there - Vector3::new(1.0, 1.0, 0.0)).norm() <= 1e-15);
        assert_eq!(Affine::from_entries(&turn.entries()).entries(), turn.entries());
        let both = turn.compose(&turn).apply(&Vector3::new(2.0, 0.0, 0.0));
        assert!((both - Vector3::zeros()).norm() <= 1e-15);
    }
}
