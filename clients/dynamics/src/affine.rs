//! Affine transforms in f64, and the rigid transform that best fits displaced points. The name of a transform states
//! its target and its source: `world_from_domain` maps coordinates of a domain to the world.

use nalgebra::{Matrix3, Vector3};

/// An affine transform x -> A x + t.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AffineTransform {
    pub linear: Matrix3<f64>,
    pub translation: Vector3<f64>,
}

impl AffineTransform {
    /// The identity.
    pub fn identity() -> Self {
        Self { linear: Matrix3::identity(), translation: Vector3::zeros() }
    }

    /// Converts from twelve numbers, row-major 3x4.
    pub fn from_row_major(entries: &[f32; 12]) -> Self {
        let entry = |row: usize, column: usize| f64::from(entries[4 * row + column]);
        Self { linear: Matrix3::from_fn(entry), translation: Vector3::from_fn(|row, _| entry(row, 3)) }
    }

    /// Rounds to twelve f32, row-major 3x4.
    pub fn to_row_major(self) -> [f32; 12] {
        std::array::from_fn(|index| {
            let (row, column) = (index / 4, index % 4);
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

    /// A rotation by `angle` radians about the direction `axis` through the point `center`. `axis` may have any length
    /// but 0.
    pub fn rotation_about(axis: &Vector3<f64>, angle: f64, center: &Vector3<f64>) -> Self {
        let rotation = nalgebra::Rotation3::from_axis_angle(&nalgebra::Unit::new_normalize(*axis), angle).into_inner();
        Self { linear: rotation, translation: center - rotation * center }
    }
}

/// The proper rotation and translation that map `rest` to `current` with the least squared error (Kabsch 1976). Fewer
/// than three points, or collinear points, do not determine the rotation. In this case, the result is the translation
/// of the mean.
#[cfg(test)]
pub(crate) fn fit_rigid_transform(rest: &[Vector3<f64>], current: &[Vector3<f64>]) -> AffineTransform {
    let count = rest.len().min(current.len());
    if count == 0 {
        return AffineTransform::identity();
    }
    let mean = |points: &[Vector3<f64>]| points[..count].iter().sum::<Vector3<f64>>() / count as f64;
    let (rest_mean, current_mean) = (mean(rest), mean(current));
    let outer_products =
        rest.iter().zip(current).map(|(rest, current)| (current - current_mean) * (rest - rest_mean).transpose());
    let rotation = nearest_rotation(&outer_products.sum());
    AffineTransform { linear: rotation, translation: current_mean - rotation * rest_mean }
}

/// The smallest product D of [`closed_form_rotation`] for which its result is used, because rounding errors grow as D
/// becomes smaller. A test compares the results with a singular value decomposition.
const MIN_PAIR_SUM_PRODUCT: f64 = 0.02;

/// The smallest ratio of the second singular value of a correlation matrix to the first one with which it determines a
/// rotation. Singular values are sums of squared distances, so points count as collinear if their extent in one
/// direction is more than sqrt(1e9) = 3e4 times the extent in any other direction.
pub(crate) const MIN_RELATIVE_SPREAD: f64 = 1e-9;

/// The proper rotation nearest to a 3x3 correlation matrix; the identity if two of its singular values vanish.
pub(crate) fn nearest_rotation(correlation: &Matrix3<f64>) -> Matrix3<f64> {
    closed_form_rotation(correlation).unwrap_or_else(|| rotation_by_svd(correlation))
}

/// The proper rotation R nearest to a matrix M, without a singular value decomposition. R does not change if M is
/// divided by its Frobenius norm, so let |M| = 1. Let s1, s2 and s3 be the singular values, and let s3 have the sign of
/// det M. Then R is a polynomial of M (Hoger and Carlson 1984):
///
/// ```text
/// R D = (t^2 + 1) / 2 M + t cof M - M M^T M,      t = s1 + s2 + s3,      D = (s1 + s2) (s2 + s3) (s3 + s1)
/// ```
///
/// t is the largest root of t^4 - 2 t^2 - 8 t det M + 1 - 4 |cof M|^2 (Horn 1987). Newton's method finds it from above.
/// `None` if D is so small that the rotation is badly determined, or if M is not finite.
fn closed_form_rotation(correlation: &Matrix3<f64>) -> Option<Matrix3<f64>> {
    let norm = correlation.norm();
    if !norm.is_normal() {
        return None;
    }
    let matrix = correlation / norm;
    let [x, y, z] = [matrix.column(0), matrix.column(1), matrix.column(2)];
    let cofactors = Matrix3::from_columns(&[y.cross(&z), z.cross(&x), x.cross(&y)]);
    let (determinant, constant) = (x.dot(&cofactors.column(0)), 1.0 - 4.0 * cofactors.norm_squared());
    // Start at the upper bound of t: the largest sum of three numbers whose squares add up to 1.
    let mut sum = 3.0_f64.sqrt();
    // The limit only bounds the loop. The convergence is quadratic, so fewer iterations are sufficient.
    for _ in 0..16 {
        let value = ((sum * sum - 2.0) * sum - 8.0 * determinant) * sum + constant;
        let slope = 4.0 * ((sum * sum - 1.0) * sum - 2.0 * determinant);
        // At the root, the slope is 8 D, because s1 s2 + s2 s3 + s3 s1 = (t^2 - 1) / 2.
        if slope < 8.0 * MIN_PAIR_SUM_PRODUCT {
            return None;
        }
        sum -= value / slope;
        if value.abs() <= 2.0 * f64::EPSILON * slope {
            break;
        }
    }
    let pair_sum_product = 0.5 * (sum * sum - 1.0) * sum - determinant;
    let polynomial = matrix * (0.5 * (sum * sum + 1.0)) + cofactors * sum - matrix * (matrix.transpose() * matrix);
    (pair_sum_product >= MIN_PAIR_SUM_PRODUCT).then(|| polynomial / pair_sum_product)
}

fn rotation_by_svd(correlation: &Matrix3<f64>) -> Matrix3<f64> {
    let (compute_u, compute_v) = (true, true);
    let svd = correlation.svd(compute_u, compute_v);
    let (Some(left), Some(right)) = (svd.u, svd.v_t) else { return Matrix3::identity() };
    let singular_values = svd.singular_values;
    let has_rank_two = singular_values[0].is_normal() && singular_values[1] > MIN_RELATIVE_SPREAD * singular_values[0];
    if !has_rank_two {
        return Matrix3::identity();
    }
    // If the orthogonal factor is a reflection, flip the direction of the smallest singular value. This gives the
    // nearest proper rotation.
    let is_reflection = (left * right).determinant() < 0.0;
    let mut signs = Matrix3::identity();
    signs[(2, 2)] = if is_reflection { -1.0 } else { 1.0 };
    left * signs * right
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Points on a circle in the plane y = 2.
    fn planar_circle(point_count: usize) -> Vec<Vector3<f64>> {
        let angle = |index: usize| 2.0 * std::f64::consts::PI * index as f64 / point_count as f64;
        let point = |index| Vector3::new(angle(index).cos() * 0.1, 2.0, angle(index).sin() * 0.1);
        (0..point_count).map(point).collect()
    }

    #[test]
    fn fit_recovers_the_rigid_transform_of_a_circle() {
        for angle in [0.0, 1e-9, 0.3, 1.5, 3.0] {
            let axis = Vector3::new(1.0, 2.0, -0.5);
            let expected = AffineTransform::rotation_about(&axis, angle, &Vector3::new(0.3, -1.0, 4.0));
            let rest = planar_circle(8);
            let current: Vec<_> = rest.iter().map(|point| expected.apply(point)).collect();
            let fitted = fit_rigid_transform(&rest, &current);
            assert!((fitted.linear - expected.linear).abs().max() <= 1e-12, "{angle}: {}", fitted.linear);
            assert!((fitted.translation - expected.translation).norm() <= 1e-11, "{angle}");
        }
    }

    #[test]
    fn fit_of_mirrored_points_is_a_proper_rotation() {
        let rest: [Vector3<f64>; 4] = [Vector3::x(), Vector3::y(), Vector3::z(), Vector3::zeros()];
        let current = rest.map(|point| Vector3::new(-point.x, point.y, point.z));
        let fitted = fit_rigid_transform(&rest, &current);
        assert!((fitted.linear.determinant() - 1.0).abs() <= 1e-12);
        assert!((fitted.linear.transpose() * fitted.linear - Matrix3::identity()).abs().max() <= 1e-12);
    }

    #[test]
    fn fit_of_too_few_or_collinear_points_is_a_translation() {
        let translation = Vector3::new(1.0, -2.0, 3.0);
        let line: Vec<_> = (0..5).map(|index| Vector3::new(f64::from(index), 0.0, 0.0)).collect();
        let coincident = vec![Vector3::x(); 4];
        for rest in [vec![], vec![Vector3::x()], vec![Vector3::x(), Vector3::y()], line, coincident] {
            let current: Vec<_> = rest.iter().map(|point| point + translation).collect();
            let fitted = fit_rigid_transform(&rest, &current);
            let expected = if rest.is_empty() { Vector3::zeros() } else { translation };
            assert!((fitted.translation - expected).norm() <= 1e-12, "{} points: {}", rest.len(), fitted.translation);
            assert_eq!(fitted.linear, Matrix3::identity());
        }
    }

    #[test]
    fn row_major_entries_round_trip_and_transforms_compose() {
        let center = Vector3::new(1.0, 0.0, 0.0);
        let quarter_turn = AffineTransform::rotation_about(&Vector3::z(), std::f64::consts::FRAC_PI_2, &center);
        let rotated_once = quarter_turn.apply(&Vector3::new(2.0, 0.0, 0.0));
        assert!((rotated_once - Vector3::new(1.0, 1.0, 0.0)).norm() <= 1e-15);
        let entries = quarter_turn.to_row_major();
        assert_eq!(AffineTransform::from_row_major(&entries).to_row_major(), entries);
        // A half turn about (1, 0, 0) moves (2, 0, 0) to the origin.
        let rotated_twice = quarter_turn.compose(&quarter_turn).apply(&Vector3::new(2.0, 0.0, 0.0));
        assert!((rotated_twice - Vector3::zeros()).norm() <= 1e-15);
    }

    /// Rotations of scaled shapes: spheres, disks, rods and mirrored shapes. The closed form gives no result for the
    /// last two shapes, which are thin rods.
    #[test]
    fn closed_form_rotation_equals_singular_value_decomposition() {
        let mut closed_count = 0;
        for singular_values in [
            [1.0, 1.0, 1.0],
            [1.0, 1.0, 0.0],
            [1.0, 0.3, 0.0],
            [1.0, 0.5, -0.2],
            [3.0, 2.0, 1e-9],
            [1.0, 0.1, 0.1],
            [1.0, 1e-3, 0.0],
            [1.0, 1e-6, 1e-7],
        ] {
            for (index, scale) in [1e-150, 1e-9, 1.0, 1e12, 1e150].into_iter().enumerate() {
                let axis = Vector3::new(1.0 + index as f64, -2.0, 0.5);
                let left = AffineTransform::rotation_about(&axis, 0.7 * index as f64, &Vector3::zeros()).linear;
                let right = AffineTransform::rotation_about(&Vector3::y(), 2.5, &Vector3::zeros()).linear;
                let matrix = left * Matrix3::from_diagonal(&(Vector3::from(singular_values) * scale)) * right;
                let expected = left * right;
                let rotation = nearest_rotation(&matrix);
                let [a, b, c] = singular_values;
                let condition = singular_values[0] / (b + c);
                let error = (rotation - expected).abs().max();
                assert!(error <= 1e-12 * condition, "{a} {b} {c} x {scale}: {error}");
                closed_count += usize::from(closed_form_rotation(&matrix).is_some());
            }
        }
        // Six shapes at five scales.
        assert_eq!(closed_count, 6 * 5);
        for matrix in [Matrix3::zeros(), Matrix3::repeat(f64::NAN), Matrix3::repeat(f64::INFINITY)] {
            assert_eq!(closed_form_rotation(&matrix), None);
        }
    }
}
