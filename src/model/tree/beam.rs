//! The lowest modes of a clamped chain of beam elements: K phi = lambda M phi, lambda in (rad/s)^2, phi^T M phi = 1.

use nalgebra::{DMatrix, SymmetricEigen, Vector3};

use super::band::BandMatrix;
use super::element::{ElasticConstants, Matrix12, Taper, element_matrices, point_mass_matrix};
use super::random::SplitMix64;
use super::skin_modes::Station;
use crate::error::{Result, fault_in};

/// Number of vectors that the iteration has in addition to the wanted modes. More vectors converge in fewer iterations.
const SPARE_VECTORS: usize = 8;

/// Maximum number of iterations.
const MAX_ITERATIONS: usize = 200;

/// Largest relative change of an eigenvalue in an iteration after convergence.
const EIGENVALUE_TOLERANCE: f64 = 1e-12;

/// Iterations after the eigenvalues have converged, because the error of a shape decreases with the square root of the
/// error of its eigenvalue.
const EXTRA_ITERATIONS: usize = 4;

/// A cantilever along a polyline, clamped at its first node.
#[derive(Debug, Clone)]
pub(super) struct Beam {
    /// N + 1 node positions in meters.
    pub(super) nodes: Vec<Vector3<f64>>,
    /// N tapers, one per element.
    pub(super) tapers: Vec<Taper>,
    pub(super) elastic: ElasticConstants,
    /// Carried masses (kg) and their stations (element, and fraction of its length).
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
    /// Mass of the beam in kg, without carried masses.
    pub(super) fn wood_mass(&self) -> f64 {
        let lengths = self.nodes.windows(2).map(|ends| (ends[1] - ends[0]).norm());
        lengths.zip(&self.tapers).map(|(length, taper)| self.elastic.density * taper.mean_area() * length).sum()
    }

    /// K and M of the 6 N free degrees of freedom.
    pub(super) fn assemble(&self) -> (BandMatrix, BandMatrix) {
        let free_dofs = 6 * self.tapers.len();
        let (mut stiffness, mut mass) = (BandMatrix::zeros(free_dofs), BandMatrix::zeros(free_dofs));
        for (element, taper) in self.tapers.iter().enumerate() {
            let (k, m) = element_matrices(&self.nodes[element], &self.nodes[element + 1], taper, &self.elastic);
            add_element(&mut stiffness, element, &k);
            add_element(&mut mass, element, &m);
        }
        for (Station { element, fraction }, carried_mass) in &self.point_masses {
            let (from, to) = (&self.nodes[*element], &self.nodes[element + 1]);
            add_element(&mut mass, *element, &point_mass_matrix(from, to, *fraction, *carried_mass));
        }
        (stiffness, mass)
    }

    /// The `count` lowest modes, by orthogonal iteration with Rayleigh-Ritz projection (Golub and Van Loan, "Matrix
    /// Computations", section 8.2). It needs a few vectors more than modes. Its cost is proportional to the number of
    /// elements; that of a dense solution is proportional to the cube of this number.
    ///
    /// K is factored instead of M, because axial stiffness is up to 10^10 times the lowest bending stiffness. With
    /// K = L L^T, the lowest modes have the largest eigenvalues mu = 1 / lambda of A = L^-1 M L^-T, which are accurate
    /// to full precision. For an eigenvector y of A, phi = L^-T y / sqrt(mu).
    ///
    /// # Errors
    /// `Fault` if K is not positive definite (the beam has no stiffness) or the iteration does not converge.
    pub(super) fn solve_modes(&self, count: usize) -> Result<BeamModes> {
        let fault = fault_in::<&str>("tree.beam");
        let (stiffness, mass) = self.assemble();
        let factor = stiffness.factor().ok_or_else(|| fault("the stiffness is not positive definite"))?;
        let not_converged = || fault("the eigenvalue iteration did not converge");
        let vector_count = (count + SPARE_VECTORS).min(mass.size());
        let mut random = SplitMix64::new(0);
        let mut vectors = DMatrix::from_fn(mass.size(), vector_count, |_, _| random.uniform_symmetric(1.0));
        let mut inverse_eigenvalues = vec![f64::INFINITY; count.min(vector_count)];
        let mut converged_iterations = 0;
        for _ in 0..MAX_ITERATIONS {
            let basis = vectors.qr().q();
            let shapes = factor.solve_upper(basis.clone());
            let mapped = factor.solve_lower(mass.multiply(&shapes));
            let projected = basis.tr_mul(&mapped);
            let eigen = SymmetricEigen::try_new((&projected + projected.transpose()) * 0.5, f64::EPSILON, 10_000)
                .ok_or_else(not_converged)?;
            let mut order: Vec<usize> = (0..vector_count).collect();
            order.sort_by(|a, b| eigen.eigenvalues[*b].total_cmp(&eigen.eigenvalues[*a]));
            let mut largest_change = 0.0_f64;
            for (mu, index) in inverse_eigenvalues.iter_mut().zip(&order) {
                largest_change = largest_change.max((*mu / eigen.eigenvalues[*index] - 1.0).abs());
                *mu = eigen.eigenvalues[*index];
            }
            converged_iterations += usize::from(largest_change <= EIGENVALUE_TOLERANCE);
            if converged_iterations > EXTRA_ITERATIONS {
                let ritz_vectors = eigen.eigenvectors.select_columns(&order[..inverse_eigenvalues.len()]);
                return Ok(self.create_modes(&inverse_eigenvalues, shapes * ritz_vectors));
            }
            vectors = mapped;
        }
        Err(not_converged())
    }

    /// Normalizes the shapes of the free degrees of freedom, one column per mode, and adds the rows of the clamped
    /// node.
    fn create_modes(&self, inverse_eigenvalues: &[f64], shapes: DMatrix<f64>) -> BeamModes {
        let mut mode_shapes = DMatrix::zeros(6 * self.nodes.len(), inverse_eigenvalues.len());
        for (column, (shape, mu)) in shapes.column_iter().zip(inverse_eigenvalues).enumerate() {
            // Make the largest entry positive, so that the sign does not depend on the solver.
            let scale = shape[shape.icamax()].signum() / mu.sqrt();
            mode_shapes.view_mut((6, column), (shape.len(), 1)).copy_from(&(shape * scale));
        }
        BeamModes { eigenvalues: inverse_eigenvalues.iter().map(|mu| mu.recip()).collect(), mode_shapes }
    }
}

/// Adds the lower triangle of an element's matrix to the matrix of all free degrees of freedom. Those of the first
/// node, which is clamped, are not free.
fn add_element(matrix: &mut BandMatrix, element: usize, block: &Matrix12) {
    let first_free = if element == 0 { 6 } else { 0 };
    for row in first_free..12 {
        for column in first_free..=row {
            matrix.add(6 * element + row - 6, 6 * element + column - 6, block[(row, column)]);
        }
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    pub(in super::super) const WOOD: ElasticConstants =
        ElasticConstants { youngs_modulus: 8e9, shear_modulus: 5e8, density: 800.0 };

    /// A beam along an oblique direction, bent by `bend` radians. Its length is 1 m if it is straight. `radii` are the
    /// radii at its ends in meters.
    pub(in super::super) fn curved_beam(elements: usize, radii: [f64; 2], bend: f64) -> Beam {
        let orientation = nalgebra::Rotation3::from_euler_angles(0.4, 0.9, -1.3);
        let node_position = |index: usize| {
            let s = index as f64 / elements as f64;
            let local_position = match bend == 0.0 {
                true => Vector3::new(0.0, s, 0.0),
                false => Vector3::new((1.0 - (bend * s).cos()) / bend, (bend * s).sin() / bend, 0.1 * s * s),
            };
            orientation * local_position
        };
        let radius = |index: usize| radii[0] + (radii[1] - radii[0]) * index as f64 / elements as f64;
        Beam {
            nodes: (0..=elements).map(node_position).collect(),
            tapers: (0..elements).map(|index| Taper { radii: [radius(index), radius(index + 1)] }).collect(),
            elastic: WOOD,
            point_masses: vec![],
        }
    }

    /// The largest ||K phi - lambda M phi|| / ||K phi||, and the largest deviation of phi^T M phi from the identity.
    pub(in super::super) fn eigen_residuals(beam: &Beam, modes: &BeamModes) -> (f64, f64) {
        let (stiffness, mass) = beam.assemble();
        let (stiffness, mass) = (stiffness.to_dense(), mass.to_dense());
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
    fn modes_solve_the_eigenproblem_at_every_slenderness() {
        // The ratio of length to diameter at the base. The length is about 1 m.
        for slenderness in [10.0, 60.0, 2000.0] {
            for (bend, taper) in [(0.0, 1.0), (0.0, 0.1), (1.2, 1.0), (1.2, 0.1)] {
                let radius = 0.5 / slenderness;
                let mut beam = curved_beam(14, [radius, radius * taper], bend);
                beam.point_masses.push((Station { element: 7, fraction: 0.25 }, 0.3 * beam.wood_mass()));
                let modes = beam.solve_modes(12).expect("a converged solution");
                let (residual, gram_error) = eigen_residuals(&beam, &modes);
                let case = format!(
                    "1:{slenderness}, bend {bend}, taper {taper}: residual {residual}, Gram error {gram_error}"
                );
                assert!(residual <= 1e-6, "{case}");
                assert!(gram_error <= 1e-6, "{case}");
                assert!(modes.eigenvalues.windows(2).all(|pair| pair[0] <= pair[1] && pair[0] > 0.0), "{case}");
            }
        }
    }

    #[test]
    fn residuals_detect_a_wrong_eigenvalue_or_shape() {
        let beam = curved_beam(10, [0.02, 0.01], 0.6);
        let mut modes = beam.solve_modes(4).expect("a converged solution");
        modes.eigenvalues[2] *= 1.0 + 1e-4;
        assert!(eigen_residuals(&beam, &modes).0 > 1e-5);
        modes = beam.solve_modes(4).expect("a converged solution");
        modes.mode_shapes[(20, 1)] *= 1.001;
        let (residual, gram_error) = eigen_residuals(&beam, &modes);
        assert!(residual > 1e-6 && gram_error > 1e-9, "{residual} {gram_error}");
    }

    #[test]
    fn uniform_cantilever_has_its_analytic_frequencies() {
        for radius in [0.02, 0.00025] {
            // An unrealistically high shear modulus keeps torsion above the first bending modes.
            let elastic = ElasticConstants { shear_modulus: 1e12, ..WOOD };
            let beam = Beam { elastic, ..curved_beam(14, [radius; 2], 0.0) };
            let modes = beam.solve_modes(6).expect("a converged solution");
            let (area, moment) = (beam.tapers[0].area(0.5), beam.tapers[0].moment(0.5));
            let base_frequency = (elastic.youngs_modulus * moment / (elastic.density * area)).sqrt();
            // Roots of cos x cosh x = -1. Each bending mode occurs twice, once per plane.
            let roots = [1.875_104, 1.875_104, 4.694_091, 4.694_091, 7.854_757, 7.854_757];
            for (eigenvalue, root) in modes.eigenvalues.iter().zip(roots) {
                let expected = root * root * base_frequency;
                let omega = eigenvalue.sqrt();
                assert!(
                    (omega / expected - 1.0).abs() <= 1e-3,
                    "radius {radius}: expected {expected} rad/s, got {omega}"
                );
            }
        }
    }

    #[test]
    fn torsion_of_a_shaft_has_its_analytic_frequency() {
        let soft_constants = ElasticConstants { shear_modulus: 1e3, ..WOOD };
        let beam = Beam { elastic: soft_constants, ..curved_beam(14, [0.05; 2], 0.0) };
        let omega = beam.solve_modes(1).expect("a converged solution").eigenvalues[0].sqrt();
        // A shaft of length 1 that is clamped at one end: omega = pi / 2 sqrt(G / rho).
        let expected = std::f64::consts::FRAC_PI_2 * (soft_constants.shear_modulus / soft_constants.density).sqrt();
        assert!((omega / expected - 1.0).abs() <= 1e-3, "expected {expected} rad/s, got {omega}");
    }

    #[test]
    fn beam_with_a_heavy_tip_behaves_like_a_spring() {
        let mut beam = curved_beam(12, [0.02; 2], 0.0);
        let tip_mass = 1000.0 * beam.wood_mass();
        beam.point_masses.push((Station { element: 11, fraction: 1.0 }, tip_mass));
        // The tip stiffness of a cantilever of length 1: 3 E I.
        let expected_stiffness = 3.0 * WOOD.youngs_modulus * beam.tapers[0].moment(0.5);
        let eigenvalue = beam.solve_modes(1).expect("a converged solution").eigenvalues[0];
        assert!((eigenvalue * tip_mass / expected_stiffness - 1.0).abs() < 1e-3, "{eigenvalue}");
    }

    #[test]
    fn beam_without_stiffness_is_a_fault() {
        let mut beam = curved_beam(4, [0.02; 2], 0.0);
        beam.elastic.youngs_modulus = 0.0;
        let message = beam.solve_modes(2).expect_err("a beam without stiffness").to_string();
        assert!(message.contains("positive definite"), "{message}");
        beam.elastic.youngs_modulus = f64::NAN;
        assert!(beam.solve_modes(2).is_err());
    }
}
