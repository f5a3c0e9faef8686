//! The lowest modes of a clamped chain of beam elements: K phi = lambda M phi, lambda in (rad/s)^2, phi^T M phi = 1.

use nalgebra::{Cholesky, DMatrix, SymmetricEigen, Vector3};

use super::element::{ElasticConstants, Section, element_matrices};
use super::skin_modes::Station;
use crate::error::{Result, fault_in};

/// A cantilever along a polyline, clamped at its first node.
#[derive(Debug, Clone)]
pub(super) struct Beam {
    /// N + 1 node positions in meters.
    pub(super) nodes: Vec<Vector3<f64>>,
    /// N sections, one per element.
    pub(super) sections: Vec<Section>,
    pub(super) elastic: ElasticConstants,
    /// Carried masses (kg) and their stations.
    pub(super) point_masses: Vec<(Station, f64)>,
}

/// The lowest modes of a beam.
#[derive(Debug, Clone)]
pub(super) struct BeamModes {
    /// Eigenvalues in (rad/s)^2, ascending.
    pub(super) eigenvalues: Vec<f64>,
    /// 6 (N + 1) rows and one column per mode. The first six rows, those of the clamped node, are zero.
    pub(super) mode_shapes: DMatrix<f64>,
}

impl Beam {
    /// Mass of the wood alone in kg.
    pub(super) fn own_mass(&self) -> f64 {
        let lengths = self.nodes.windows(2).map(|ends| (ends[1] - ends[0]).norm());
        lengths.zip(&self.sections).map(|(length, section)| self.elastic.density * section.area * length).sum()
    }

    /// K and M of the 6 N free degrees of freedom.
    pub(super) fn assemble(&self) -> (DMatrix<f64>, DMatrix<f64>) {
        let free = 6 * self.sections.len();
        let (mut stiffness, mut mass) = (DMatrix::zeros(free, free), DMatrix::zeros(free, free));
        for (element, section) in self.sections.iter().enumerate() {
            let (k, m) = element_matrices(&self.nodes[element], &self.nodes[element + 1], section, &self.elastic);
            // The first node is clamped: of the first element, only the second node's block is free.
            let (first, count) = if element == 0 { (6, 6) } else { (0, 12) };
            let to = 6 * element + first - 6;
            let mut block = stiffness.view_mut((to, to), (count, count));
            block += k.view((first, first), (count, count));
            let mut block = mass.view_mut((to, to), (count, count));
            block += m.view((first, first), (count, count));
        }
        for (station, load) in &self.point_masses {
            for (node, share) in [(station.element, 1.0 - station.fraction), (station.element + 1, station.fraction)] {
                for axis in 0..if node == 0 { 0 } else { 3 } {
                    mass[(6 * (node - 1) + axis, 6 * (node - 1) + axis)] += share * load;
                }
            }
        }
        (stiffness, mass)
    }

    /// The `count` lowest modes.
    ///
    /// K is factored instead of M. Axial stiffness is up to 10^10 times the lowest bending stiffness, so that in L^-1 K
    /// L^-T with M = L L^T the lowest eigenvalues would be lost in the rounding errors of the highest. With K = L L^T
    /// they are the largest ones of L^-1 M L^-T, mu = 1 / lambda, and accurate to full precision; phi = L^-T y /
    /// sqrt(mu).
    ///
    /// # Errors
    /// `Fault` if K is not positive definite (a node without stiffness) or the iteration does not converge.
    pub(super) fn modes(&self, count: usize) -> Result<BeamModes> {
        let fault = fault_in::<&str>("tree.beam");
        let (stiffness, mass) = self.assemble();
        let factor = Cholesky::new(stiffness).ok_or_else(|| fault("the stiffness is not positive definite"))?.unpack();
        let singular = || fault("the factor of the stiffness is singular");
        let half = factor.solve_lower_triangular(&mass).ok_or_else(singular)?;
        let flexibility = factor.solve_lower_triangular(&half.transpose()).ok_or_else(singular)?;
        let flexibility = (&flexibility + flexibility.transpose()) * 0.5;
        let eigen = SymmetricEigen::try_new(flexibility, f64::EPSILON, 10_000)
            .ok_or_else(|| fault("the eigenvalue iteration did not converge"))?;
        let mut order: Vec<usize> = (0..eigen.eigenvalues.len()).collect();
        order.sort_by(|a, b| eigen.eigenvalues[*b].total_cmp(&eigen.eigenvalues[*a]));
        order.truncate(count);
        let mut mode_shapes = DMatrix::zeros(6 * self.nodes.len(), order.len());
        let mut eigenvalues = Vec::with_capacity(order.len());
        for (column, index) in order.into_iter().enumerate() {
            let mu = eigen.eigenvalues[index];
            let shape = factor.tr_solve_lower_triangular(&eigen.eigenvectors.column(index)).ok_or_else(singular)?;
            // The largest entry is positive, so that the sign does not depend on the solver.
            let scale = shape[shape.icamax()].signum() / mu.sqrt();
            mode_shapes.view_mut((6, column), (shape.len(), 1)).copy_from(&(shape * scale));
            eigenvalues.push(1.0 / mu);
        }
        Ok(BeamModes { eigenvalues, mode_shapes })
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    pub(in super::super) const WOOD: ElasticConstants =
        ElasticConstants { youngs_modulus: 8e9, shear_modulus: 5e8, density: 800.0 };

    /// A beam of length 1 with different radii at its ends, bent by `bend` radians over its length, in an oblique
    /// direction.
    pub(in super::super) fn curved_beam(elements: usize, radii: [f64; 2], bend: f64) -> Beam {
        let oblique = nalgebra::Rotation3::from_euler_angles(0.4, 0.9, -1.3);
        let place = |index: usize| {
            let s = index as f64 / elements as f64;
            let flat = match bend == 0.0 {
                true => Vector3::new(0.0, s, 0.0),
                false => Vector3::new((1.0 - (bend * s).cos()) / bend, (bend * s).sin() / bend, 0.1 * s * s),
            };
            oblique * flat
        };
        let radius = |index: usize| radii[0] + (radii[1] - radii[0]) * index as f64 / elements as f64;
        Beam {
            nodes: (0..=elements).map(place).collect(),
            sections: (0..elements).map(|index| Section::of_cone(radius(index), radius(index + 1))).collect(),
            elastic: WOOD,
            point_masses: vec![],
        }
    }

    /// The largest ||K phi - lambda M phi|| / ||K phi||, and the largest deviation of phi^T M phi from the identity.
    pub(in super::super) fn eigen_residuals(beam: &Beam, modes: &BeamModes) -> (f64, f64) {
        let (stiffness, mass) = beam.assemble();
        let mode_shapes = modes.mode_shapes.rows(6, stiffness.nrows()).into_owned();
        let residual = |column: usize| {
            let force = &stiffness * mode_shapes.column(column);
            (&force - &mass * mode_shapes.column(column) * modes.eigenvalues[column]).norm() / force.norm()
        };
        let gram = mode_shapes.transpose() * &mass * &mode_shapes
            - DMatrix::identity(mode_shapes.ncols(), mode_shapes.ncols());
        ((0..mode_shapes.ncols()).map(residual).fold(0.0, f64::max), gram.abs().max())
    }

    #[test]
    fn kept_modes_solve_the_eigenproblem_and_are_mass_orthonormal_at_every_slenderness() {
        for slenderness in [10.0, 60.0, 2000.0] {
            for (bend, taper) in [(0.0, 1.0), (0.0, 0.1), (1.2, 1.0), (1.2, 0.1)] {
                let radius = 0.5 / slenderness;
                let mut beam = curved_beam(14, [radius, radius * taper], bend);
                beam.point_masses.push((Station { element: 7, fraction: 0.25 }, 0.3 * beam.own_mass()));
                let modes = beam.modes(12).expect("converges");
                let (residual, skew) = eigen_residuals(&beam, &modes);
                let case = format!("1:{slenderness}, bend {bend}, taper {taper}: residual {residual}, skew {skew}");
                assert!(residual <= 1e-6, "{case}");
                assert!(skew <= 1e-6, "{case}");
                assert!(modes.eigenvalues.windows(2).all(|pair| pair[0] <= pair[1] && pair[0] > 0.0), "{case}");
            }
        }
    }

    #[test]
    fn a_wrong_eigenvalue_or_shape_fails_the_residual_test() {
        let beam = curved_beam(10, [0.02, 0.01], 0.6);
        let mut modes = beam.modes(4).expect("converges");
        modes.eigenvalues[2] *= 1.0 + 1e-4;
        assert!(eigen_residuals(&beam, &modes).0 > 1e-5);
        modes = beam.modes(4).expect("converges");
        modes.mode_shapes[(20, 1)] *= 1.001;
        let (residual, skew) = eigen_residuals(&beam, &modes);
        assert!(residual > 1e-6 && skew > 1e-9, "{residual} {skew}");
    }

    #[test]
    fn a_uniform_cantilever_has_the_frequencies_of_euler_and_bernoulli() {
        for radius in [0.02, 0.00025] {
            // An unrealistically high shear modulus keeps torsion above the first bending modes.
            let elastic = ElasticConstants { shear_modulus: 1e12, ..WOOD };
            let beam = Beam { elastic, ..curved_beam(14, [radius; 2], 0.0) };
            let modes = beam.modes(6).expect("converges");
            let Section { area, moment } = beam.sections[0];
            let base = (elastic.youngs_modulus * moment / (elastic.density * area)).sqrt();
            // Roots of cos x cosh x = -1. Each bending mode occurs twice, once per plane.
            let roots = [1.875_104, 1.875_104, 4.694_091, 4.694_091, 7.854_757, 7.854_757];
            for (value, root) in modes.eigenvalues.iter().zip(roots) {
                let want = root * root * base;
                let omega = value.sqrt();
                assert!((omega / want - 1.0).abs() <= 1e-3, "radius {radius}: {omega} rad/s is not {want}");
            }
        }
    }

    #[test]
    fn torsion_of_a_shaft_has_its_analytic_frequency() {
        let soft = ElasticConstants { shear_modulus: 1e3, ..WOOD };
        let beam = Beam { elastic: soft, ..curved_beam(14, [0.05; 2], 0.0) };
        let omega = beam.modes(1).expect("converges").eigenvalues[0].sqrt();
        let want = std::f64::consts::FRAC_PI_2 * (soft.shear_modulus / soft.density).sqrt();
        assert!((omega / want - 1.0).abs() <= 1e-3, "{omega} is not {want}");
    }

    #[test]
    fn a_heavy_tip_turns_the_beam_into_a_spring() {
        let mut beam = curved_beam(12, [0.02; 2], 0.0);
        let load = 1000.0 * beam.own_mass();
        beam.point_masses.push((Station { element: 11, fraction: 1.0 }, load));
        let spring = 3.0 * WOOD.youngs_modulus * beam.sections[0].moment;
        let got = beam.modes(1).expect("converges").eigenvalues[0];
        assert!((got * load / spring - 1.0).abs() < 1e-3, "{got}");
    }

    #[test]
    fn a_beam_without_stiffness_is_a_fault_and_no_panic() {
        let mut beam = curved_beam(4, [0.02; 2], 0.0);
        beam.elastic.youngs_modulus = 0.0;
        let fault = beam.modes(2).expect_err("nothing holds it").to_string();
        assert!(fault.contains("positive definite"), "{fault}");
        beam.elastic.youngs_modulus = f64::NAN;
        assert!(beam.modes(2).is_err());
    }
}
