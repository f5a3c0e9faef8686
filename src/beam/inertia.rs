//! The inertia of a rigid body for small motions.

use nalgebra::{Matrix3, Matrix6, Rotation3, Vector3};

/// The 6 x 6 inertia D of a rigid body for small motions of a frame: the kinetic energy is 1/2 V^T D V, where V is the
/// velocity of the frame's origin, then the angular velocity. D = [[m I, -m C], [m C, J]] with the mass m (kg), the
/// matrix C of the cross product with the center of mass, and the inertia tensor J about the origin (kg m^2).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RigidInertia(Matrix6<f64>);

impl RigidInertia {
    /// A massless body.
    pub fn zero() -> Self {
        Self(Matrix6::zeros())
    }

    /// A point mass in kg at the origin.
    pub fn point_mass(mass: f64) -> Self {
        Self::body(mass, Vector3::zeros(), Matrix3::zeros())
    }

    /// A body with `mass` in kg, the center of mass, and the inertia tensor about the origin in kg m^2.
    pub fn body(mass: f64, center: Vector3<f64>, tensor: Matrix3<f64>) -> Self {
        let mut matrix = Matrix6::zeros();
        let moment = (center * mass).cross_matrix();
        matrix.fixed_view_mut::<3, 3>(0, 0).fill_diagonal(mass);
        matrix.fixed_view_mut::<3, 3>(0, 3).copy_from(&-moment);
        matrix.fixed_view_mut::<3, 3>(3, 0).copy_from(&moment);
        matrix.fixed_view_mut::<3, 3>(3, 3).copy_from(&tensor);
        Self(matrix)
    }

    /// The 6 x 6 matrix R^T M R of a rigid body.
    pub fn from_matrix(matrix: Matrix6<f64>) -> Self {
        Self((matrix + matrix.transpose()) * 0.5)
    }

    /// The matrix D.
    pub const fn matrix(&self) -> &Matrix6<f64> {
        &self.0
    }

    /// Mass in kg.
    pub fn mass(&self) -> f64 {
        self.0[(0, 0)]
    }

    /// Center of mass; zero for a massless body.
    pub fn center(&self) -> Vector3<f64> {
        let moment = Vector3::new(self.0[(5, 1)], self.0[(3, 2)], self.0[(4, 0)]);
        if self.mass() > 0.0 { moment / self.mass() } else { Vector3::zeros() }
    }

    /// Inertia tensor about the origin, kg m^2.
    pub fn tensor(&self) -> Matrix3<f64> {
        self.0.fixed_view::<3, 3>(3, 3).into_owned()
    }

    /// The inertia of the same body for the motions of another frame. `rotation` and `origin` are the axes and the
    /// origin of this frame, seen from the other one.
    #[must_use]
    pub fn seen_from(&self, rotation: &Rotation3<f64>, origin: &Vector3<f64>) -> Self {
        // A motion (v, w) of the other frame moves this frame by v + w x origin and w, in axes of this frame.
        let mut transport = Matrix6::zeros();
        let inverse = rotation.inverse();
        transport.fixed_view_mut::<3, 3>(0, 0).copy_from(inverse.matrix());
        transport.fixed_view_mut::<3, 3>(0, 3).copy_from(&(inverse.matrix() * -origin.cross_matrix()));
        transport.fixed_view_mut::<3, 3>(3, 3).copy_from(inverse.matrix());
        Self::from_matrix(transport.transpose() * self.0 * transport)
    }
}

impl std::ops::Add for RigidInertia {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        Self(self.0 + other.0)
    }
}

impl std::iter::Sum for RigidInertia {
    fn sum<I: Iterator<Item = Self>>(bodies: I) -> Self {
        bodies.fold(Self::zero(), |sum, body| sum + body)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The inertia of points, from the sum of their kinetic energies.
    fn inertia_of_points(points: &[(f64, Vector3<f64>)]) -> Matrix6<f64> {
        let mut matrix = Matrix6::zeros();
        for (mass, point) in points {
            let mut velocity = nalgebra::Matrix3x6::zeros();
            velocity.fixed_view_mut::<3, 3>(0, 0).fill_with_identity();
            velocity.fixed_view_mut::<3, 3>(0, 3).copy_from(&-point.cross_matrix());
            matrix += velocity.transpose() * velocity * *mass;
        }
        matrix
    }

    fn points() -> Vec<(f64, Vector3<f64>)> {
        (0..5)
            .map(|i| (1.0 + f64::from(i), Vector3::from_fn(|axis, _| (3.7 * f64::from(i) + axis as f64).sin())))
            .collect()
    }

    #[test]
    fn parts_of_a_body_are_those_of_its_points() {
        let inertia = RigidInertia::from_matrix(inertia_of_points(&points()));
        assert!((inertia.mass() - 15.0).abs() < 1e-12);
        let center = points().iter().map(|(mass, point)| point * *mass).sum::<Vector3<f64>>() / 15.0;
        assert!((inertia.center() - center).norm() < 1e-12);
        let rebuilt = RigidInertia::body(inertia.mass(), inertia.center(), inertia.tensor());
        assert!((rebuilt.matrix() - inertia.matrix()).norm() < 1e-12);
    }

    #[test]
    fn another_frame_sees_the_moved_points() {
        let (rotation, origin) = (Rotation3::from_euler_angles(0.3, -0.8, 1.9), Vector3::new(0.4, -2.0, 0.7));
        let moved: Vec<_> = points().iter().map(|(mass, point)| (*mass, rotation * point + origin)).collect();
        let seen = RigidInertia::from_matrix(inertia_of_points(&points())).seen_from(&rotation, &origin);
        let expected = inertia_of_points(&moved);
        assert!((seen.matrix() - expected).norm() <= 1e-12 * expected.norm());
        // Counterexample: without the rotation, the points are elsewhere.
        let unrotated =
            RigidInertia::from_matrix(inertia_of_points(&points())).seen_from(&Rotation3::identity(), &origin);
        assert!((unrotated.matrix() - expected).norm() > 1e-2 * expected.norm());
    }
}
