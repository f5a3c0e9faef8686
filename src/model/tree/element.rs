//! The 12 x 12 stiffness and consistent mass matrices of one Euler-Bernoulli frame element.
//!
//! Degrees of freedom per node: displacement along x, y, z (m), rotation about x, y, z (rad). Local x points along the
//! element. Within the element, bending is cubic, and stretch and twist are linear (Przemieniecki, "Theory of Matrix
//! Structural Analysis", sections 5.6 and 11.3). The rotary inertia of bending is neglected, as in Euler-Bernoulli
//! theory.

use nalgebra::{Matrix3, Matrix4, SMatrix, Vector3};

pub(super) type Matrix12 = SMatrix<f64, 12, 12>;

/// Elastic constants (Pa) and density (kg/m^3) of wood or of a green shoot.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct ElasticConstants {
    pub(super) youngs_modulus: f64,
    pub(super) shear_modulus: f64,
    pub(super) density: f64,
}

/// A circular section: area (m^2) and second moment of area about a diameter (m^4).
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Section {
    pub(super) area: f64,
    pub(super) moment: f64,
}

impl Section {
    /// Mean area and second moment of a truncated cone. Its radius is linear between the two radii, so that the means
    /// of r^2 and r^4 have these closed forms.
    pub(super) fn of_cone(radius_a: f64, radius_b: f64) -> Self {
        use std::f64::consts::{FRAC_PI_4, PI};
        let mean_square = (radius_a * radius_a + radius_a * radius_b + radius_b * radius_b) / 3.0;
        let mean_fourth_power = (radius_a.powi(4)
            + radius_a.powi(3) * radius_b
            + (radius_a * radius_b).powi(2)
            + radius_a * radius_b.powi(3)
            + radius_b.powi(4))
            / 5.0;
        Self { area: PI * mean_square, moment: FRAC_PI_4 * mean_fourth_power }
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
    section: &Section,
    material: &ElasticConstants,
) -> (Matrix12, Matrix12) {
    let length = (to - from).norm();
    let mut local_from_global = Matrix12::zeros();
    for block in 0..4 {
        local_from_global.fixed_view_mut::<3, 3>(3 * block, 3 * block).copy_from(&element_axes(from, to));
    }
    let (stiffness, mass) = (local_stiffness(length, section, material), local_mass(length, section, material));
    (
        local_from_global.transpose() * stiffness * local_from_global,
        local_from_global.transpose() * mass * local_from_global,
    )
}

/// Stiffness in local axes; `l` is the element's length. The polar moment of a circular section, which resists twist,
/// is twice its second moment about a diameter.
fn local_stiffness(l: f64, section: &Section, material: &ElasticConstants) -> Matrix12 {
    let mut matrix = Matrix12::zeros();
    let block = [1.0, -1.0, -1.0, 1.0];
    add_linear(&mut matrix, 0, block.map(|entry| entry * material.youngs_modulus * section.area / l));
    add_linear(&mut matrix, 3, block.map(|entry| entry * material.shear_modulus * 2.0 * section.moment / l));
    #[rustfmt::skip]
    let bending = Matrix4::new(
        12.0,    6.0 * l,     -12.0,   6.0 * l,
        6.0 * l, 4.0 * l * l, -6.0 * l, 2.0 * l * l,
        -12.0,   -6.0 * l,    12.0,    -6.0 * l,
        6.0 * l, 2.0 * l * l, -6.0 * l, 4.0 * l * l,
    );
    add_bending(&mut matrix, &(bending * (material.youngs_modulus * section.moment / l.powi(3))));
    matrix
}

/// Consistent mass in local axes, with the same symbols as [`local_stiffness`].
fn local_mass(l: f64, section: &Section, material: &ElasticConstants) -> Matrix12 {
    let mut matrix = Matrix12::zeros();
    let block = [2.0, 1.0, 1.0, 2.0];
    add_linear(&mut matrix, 0, block.map(|entry| entry * material.density * section.area * l / 6.0));
    add_linear(&mut matrix, 3, block.map(|entry| entry * material.density * 2.0 * section.moment * l / 6.0));
    #[rustfmt::skip]
    let bending = Matrix4::new(
        156.0,     22.0 * l,     54.0,      -13.0 * l,
        22.0 * l,  4.0 * l * l,  13.0 * l,  -3.0 * l * l,
        54.0,      13.0 * l,     156.0,     -22.0 * l,
        -13.0 * l, -3.0 * l * l, -22.0 * l, 4.0 * l * l,
    );
    add_bending(&mut matrix, &(bending * (material.density * section.area * l / 420.0)));
    matrix
}

/// Adds a row-major 2 x 2 block that couples degree of freedom `dof` of both nodes.
fn add_linear(matrix: &mut Matrix12, dof: usize, block: [f64; 4]) {
    for (index, value) in block.into_iter().enumerate() {
        matrix[(dof + 6 * (index / 2), dof + 6 * (index % 2))] += value;
    }
}

/// Adds bending in both planes: y with the rotation about z, and z with the rotation about y. Terms that couple z with
/// the rotation change their sign, because a rotation about y decreases the slope dz/dx.
fn add_bending(matrix: &mut Matrix12, block: &Matrix4<f64>) {
    for (dofs, sign) in [([1, 5, 7, 11], 1.0), ([2, 4, 8, 10], -1.0)] {
        for row in 0..4 {
            for column in 0..4 {
                let factor = if (row + column) % 2 == 1 { sign } else { 1.0 };
                matrix[(dofs[row], dofs[column])] += factor * block[(row, column)];
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
        let section = Section::of_cone(0.03, 0.02);
        let (stiffness, mass) = element_matrices(&from, &to, &section, &WOOD);
        let element_mass = WOOD.density * section.area * (to - from).norm();
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
        let (stiffness, mass) = element_matrices(&from, &to, &Section::of_cone(0.01, 0.01), &WOOD);
        assert!((stiffness - stiffness.transpose()).norm() <= 1e-12 * stiffness.norm());
        assert!((mass - mass.transpose()).norm() <= 1e-12 * mass.norm());
        assert!(mass.cholesky().is_some());
    }

    #[test]
    fn cone_section_is_between_those_of_its_ends() {
        let (thick_section, thin_section, cone_section) =
            (Section::of_cone(2.0, 2.0), Section::of_cone(1.0, 1.0), Section::of_cone(2.0, 1.0));
        assert!((thin_section.area - std::f64::consts::PI).abs() < 1e-12);
        assert!((thin_section.moment - std::f64::consts::FRAC_PI_4).abs() < 1e-12);
        assert!(cone_section.area < thick_section.area && cone_section.area > thin_section.area);
        // The mean of r^2 between the radii 2 and 1 is (2^2 + 2 x 1 + 1^2) / 3.
        assert!((cone_section.area - std::f64::consts::PI * 7.0 / 3.0).abs() < 1e-12);
    }
}
