//! The 12 x 12 stiffness and consistent mass matrices of one Euler-Bernoulli frame element with a tapered section.
//!
//! Degrees of freedom per node: displacement along x, y, z (m), rotation about x, y, z (rad). Local x points along the
//! element. Within the element, bending is cubic, and stretch and twist are linear (Przemieniecki, "Theory of Matrix
//! Structural Analysis", sections 5.6 and 11.3). The rotary inertia of bending is neglected, as in Euler-Bernoulli
//! theory.

use nalgebra::{Matrix3, Matrix4, SMatrix, Vector3, Vector4};

pub(super) type Matrix12 = SMatrix<f64, 12, 12>;

/// The degrees of freedom of bending in local y and their signs: displacement and rotation about z of both nodes.
const BENDING_Y: ([usize; 4], [f64; 4]) = ([1, 5, 7, 11], [1.0; 4]);

/// The same in local z. A rotation about y decreases the slope dz/dx.
const BENDING_Z: ([usize; 4], [f64; 4]) = ([2, 4, 8, 10], [1.0, -1.0, 1.0, -1.0]);

/// Abscissas and weights of the five-point Gauss-Legendre rule on 0 to 1. It is exact for polynomials of degree 9. The
/// integrands are at most of degree 8: a squared cubic shape function times the area of a cone.
const GAUSS_POINTS: [(f64, f64); 5] = [
    (0.046_910_077_030_668_0, 0.118_463_442_528_094_5),
    (0.230_765_344_947_158_5, 0.239_314_335_249_683_2),
    (0.5, 0.284_444_444_444_444_4),
    (0.769_234_655_052_841_5, 0.239_314_335_249_683_2),
    (0.953_089_922_969_332, 0.118_463_442_528_094_5),
];

/// Elastic constants (Pa) and density (kg/m^3) of wood or of a green shoot.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct ElasticConstants {
    pub(super) youngs_modulus: f64,
    pub(super) shear_modulus: f64,
    pub(super) density: f64,
}

/// Circular sections of an element whose radius is linear along it: a truncated cone.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Taper {
    /// Radii at the start and at the end, meters.
    pub(super) radii: [f64; 2],
}

impl Taper {
    /// Area in m^2 at a fraction of the length.
    pub(super) fn area(&self, fraction: f64) -> f64 {
        std::f64::consts::PI * self.radius(fraction).powi(2)
    }

    /// Second moment of area about a diameter, in m^4, at a fraction of the length.
    pub(super) fn moment(&self, fraction: f64) -> f64 {
        std::f64::consts::FRAC_PI_4 * self.radius(fraction).powi(4)
    }

    /// Mean area in m^2.
    pub(super) fn mean_area(&self) -> f64 {
        let [a, b] = self.radii;
        std::f64::consts::PI * (a * a + a * b + b * b) / 3.0
    }

    fn radius(&self, fraction: f64) -> f64 {
        self.radii[0] + (self.radii[1] - self.radii[0]) * fraction
    }
}

/// Weights of the displacement and the rotation of the first node, then of the second, in one plane of bending: the
/// cubic Hermite basis on an element.
pub(super) struct BendingBasis {
    /// Weights in the transverse displacement.
    pub(super) values: Vector4<f64>,
    /// Weights in its derivative along the element, per meter.
    pub(super) slopes: Vector4<f64>,
    /// Weights in its second derivative, per square meter.
    curvatures: Vector4<f64>,
}

impl BendingBasis {
    /// The basis at the fraction `x` of an element of `length` meters.
    pub(super) fn new(x: f64, length: f64) -> Self {
        Self {
            values: Vector4::new(
                1.0 - 3.0 * x * x + 2.0 * x.powi(3),
                length * x * (1.0 - x).powi(2),
                x * x * (3.0 - 2.0 * x),
                length * x * x * (x - 1.0),
            ),
            slopes: Vector4::new(
                6.0 * x * (x - 1.0) / length,
                (1.0 - x) * (1.0 - 3.0 * x),
                6.0 * x * (1.0 - x) / length,
                x * (3.0 * x - 2.0),
            ),
            curvatures: Vector4::new(
                (12.0 * x - 6.0) / (length * length),
                (6.0 * x - 4.0) / length,
                (6.0 - 12.0 * x) / (length * length),
                (6.0 * x - 2.0) / length,
            ),
        }
    }
}

/// The local axes of an element between two nodes, as rows.
pub(super) fn element_axes(from: &Vector3<f64>, to: &Vector3<f64>) -> Matrix3<f64> {
    let x = (to - from).normalize();
    let reference = if x.x.abs() < 0.7 { Vector3::x() } else { Vector3::z() };
    let z = x.cross(&reference).normalize();
    Matrix3::from_rows(&[x.transpose(), z.cross(&x).transpose(), z.transpose()])
}

/// Stiffness and consistent mass in the coordinate frame of the nodes.
pub(super) fn element_matrices(
    from: &Vector3<f64>,
    to: &Vector3<f64>,
    taper: &Taper,
    material: &ElasticConstants,
) -> (Matrix12, Matrix12) {
    let (local_from_global, length) = (rotation_of_nodes(from, to), (to - from).norm());
    let (mut stiffness, mut mass) = (Matrix12::zeros(), Matrix12::zeros());
    for (x, weight) in GAUSS_POINTS {
        let (area, moment) = (taper.area(x), taper.moment(x));
        let ElasticConstants { youngs_modulus, shear_modulus, density } = *material;
        let weight = weight * length;
        let (linear_values, linear_slopes) = ([1.0 - x, x], [-1.0 / length, 1.0 / length]);
        add_linear(&mut stiffness, 0, linear_slopes, weight * youngs_modulus * area);
        // The polar moment of a circular section, which resists twist, is twice its second moment about a diameter.
        add_linear(&mut stiffness, 3, linear_slopes, weight * shear_modulus * 2.0 * moment);
        add_linear(&mut mass, 0, linear_values, weight * density * area);
        add_linear(&mut mass, 3, linear_values, weight * density * 2.0 * moment);
        let basis = BendingBasis::new(x, length);
        add_bending(
            &mut stiffness,
            &(basis.curvatures * basis.curvatures.transpose()),
            weight * youngs_modulus * moment,
        );
        add_bending(&mut mass, &(basis.values * basis.values.transpose()), weight * density * area);
    }
    (
        local_from_global.transpose() * stiffness * local_from_global,
        local_from_global.transpose() * mass * local_from_global,
    )
}

/// The consistent mass matrix m N^T N of a point mass of `mass` kg on the centerline, at a fraction of the element. N
/// is the 3 x 12 matrix of shape functions, which gives the displacement at the mass. Shares of the mass at the two
/// nodes would overestimate the kinetic energy, because bending moves a point between the nodes less than their mean.
pub(super) fn point_mass_matrix(from: &Vector3<f64>, to: &Vector3<f64>, fraction: f64, mass: f64) -> Matrix12 {
    let mut shape_functions = SMatrix::<f64, 3, 12>::zeros();
    (shape_functions[(0, 0)], shape_functions[(0, 6)]) = (1.0 - fraction, fraction);
    let basis = BendingBasis::new(fraction, (to - from).norm());
    for (row, (dofs, signs)) in [(1, BENDING_Y), (2, BENDING_Z)] {
        for index in 0..4 {
            shape_functions[(row, dofs[index])] = signs[index] * basis.values[index];
        }
    }
    let shape_functions = shape_functions * rotation_of_nodes(from, to);
    shape_functions.transpose() * shape_functions * mass
}

/// The local axes of an element for the four vectors of its degrees of freedom.
fn rotation_of_nodes(from: &Vector3<f64>, to: &Vector3<f64>) -> Matrix12 {
    let mut local_from_global = Matrix12::zeros();
    for block in 0..4 {
        local_from_global.fixed_view_mut::<3, 3>(3 * block, 3 * block).copy_from(&element_axes(from, to));
    }
    local_from_global
}

/// Adds the outer product of linear shape functions, for the degree of freedom `dof` of both nodes.
fn add_linear(matrix: &mut Matrix12, dof: usize, shape_functions: [f64; 2], factor: f64) {
    for (row, a) in shape_functions.iter().enumerate() {
        for (column, b) in shape_functions.iter().enumerate() {
            matrix[(dof + 6 * row, dof + 6 * column)] += factor * a * b;
        }
    }
}

/// Adds bending in both planes.
fn add_bending(matrix: &mut Matrix12, block: &Matrix4<f64>, factor: f64) {
    for (dofs, signs) in [BENDING_Y, BENDING_Z] {
        for row in 0..4 {
            for column in 0..4 {
                matrix[(dofs[row], dofs[column])] += factor * signs[row] * signs[column] * block[(row, column)];
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const WOOD: ElasticConstants = ElasticConstants { youngs_modulus: 8e9, shear_modulus: 5e8, density: 800.0 };

    fn oblique_nodes() -> (Vector3<f64>, Vector3<f64>) {
        (Vector3::new(0.2, -0.1, 0.4), Vector3::new(0.5, 0.3, 0.1))
    }

    #[test]
    fn rigid_motions_have_no_elastic_energy() {
        let (from, to) = oblique_nodes();
        let taper = Taper { radii: [0.03, 0.02] };
        let (stiffness, mass) = element_matrices(&from, &to, &taper, &WOOD);
        let element_mass = WOOD.density * taper.mean_area() * (to - from).norm();
        for axis in 0..3 {
            let direction = Vector3::ith(axis, 1.0);
            let mut translation = nalgebra::SVector::<f64, 12>::zeros();
            let mut rotation = translation;
            for (node, position) in [from, to].iter().enumerate() {
                translation.fixed_rows_mut::<3>(6 * node).copy_from(&direction);
                rotation.fixed_rows_mut::<3>(6 * node).copy_from(&direction.cross(position));
                rotation.fixed_rows_mut::<3>(6 * node + 3).copy_from(&direction);
            }
            assert!((stiffness * translation).norm() <= 1e-9 * stiffness.norm());
            assert!((stiffness * rotation).norm() <= 1e-9 * stiffness.norm());
            assert!((translation.dot(&(mass * translation)) / element_mass - 1.0).abs() < 1e-12);
            // Counterexample: moving only one end requires energy.
            translation.fixed_rows_mut::<3>(0).fill(0.0);
            assert!((stiffness * translation).norm() > 1e-6 * stiffness.norm());
        }
    }

    #[test]
    fn matrices_are_symmetric_and_the_mass_is_positive() {
        let (from, to) = oblique_nodes();
        let (stiffness, mass) = element_matrices(&from, &to, &Taper { radii: [0.01; 2] }, &WOOD);
        assert!((stiffness - stiffness.transpose()).norm() <= 1e-12 * stiffness.norm());
        assert!((mass - mass.transpose()).norm() <= 1e-12 * mass.norm());
        assert!(mass.cholesky().is_some());
    }

    #[test]
    fn uniform_element_has_the_textbook_matrices() {
        let (from, to) = (Vector3::zeros(), Vector3::new(0.8, 0.0, 0.0));
        let taper = Taper { radii: [0.02; 2] };
        let (stiffness, mass) = element_matrices(&from, &to, &taper, &WOOD);
        let (l, area, moment) = (0.8_f64, taper.area(0.5), taper.moment(0.5));
        // Przemieniecki, equations 5.116 and 11.21: entries of bending in y, stretch and twist.
        let bending = WOOD.youngs_modulus * moment;
        let line_mass = WOOD.density * area;
        for (matrix, row, column, expected) in [
            (&stiffness, 1, 1, 12.0 * bending / l.powi(3)),
            (&stiffness, 1, 5, 6.0 * bending / l.powi(2)),
            (&stiffness, 5, 11, 2.0 * bending / l),
            (&stiffness, 0, 6, -WOOD.youngs_modulus * area / l),
            (&stiffness, 3, 3, WOOD.shear_modulus * 2.0 * moment / l),
            (&mass, 1, 1, 156.0 / 420.0 * line_mass * l),
            (&mass, 1, 11, -13.0 / 420.0 * line_mass * l * l),
            (&mass, 5, 5, 4.0 / 420.0 * line_mass * l.powi(3)),
            (&mass, 0, 6, line_mass * l / 6.0),
            (&mass, 3, 3, WOOD.density * 2.0 * moment * l / 3.0),
        ] {
            let entry = matrix[(row, column)];
            assert!((entry / expected - 1.0).abs() <= 1e-12, "({row}, {column}): expected {expected}, got {entry}");
        }
    }

    #[test]
    fn point_mass_has_its_kinetic_energy_anywhere() {
        let (from, to) = oblique_nodes();
        // An element of bent nodes: both rotate about z by different angles.
        let dofs = nalgebra::SVector::<f64, 12>::from_fn(|row, _| (1.7 * row as f64).sin());
        for fraction in [0.0, 0.3, 0.5, 1.0] {
            let motion = super::super::skin_modes::section_motion(
                &[from, to],
                dofs.as_slice(),
                super::super::skin_modes::Station { element: 0, fraction },
            );
            let twice_energy = (point_mass_matrix(&from, &to, fraction, 2.5) * dofs).dot(&dofs);
            let expected = 2.5 * motion.translation.norm_squared();
            assert!(
                (twice_energy / expected - 1.0).abs() <= 1e-12,
                "{fraction}: expected {expected}, got {twice_energy}"
            );
        }
    }

    #[test]
    fn mean_area_of_a_cone_is_the_mean_over_its_length() {
        let taper = Taper { radii: [2.0, 1.0] };
        let integrated: f64 = GAUSS_POINTS.iter().map(|(x, weight)| weight * taper.area(*x)).sum();
        assert!((taper.mean_area() / integrated - 1.0).abs() < 1e-12);
        // The mean of r^2 between the radii 2 and 1 is (2^2 + 2 x 1 + 1^2) / 3.
        assert!((taper.mean_area() - std::f64::consts::PI * 7.0 / 3.0).abs() < 1e-12);
    }
}
