//! The lowest modes of a clamped chain of beam elements that carries rigid bodies, and its inertia.

use nalgebra::{DMatrix, DVector, Matrix6, Matrix6xX, SymmetricEigen, Vector3, Vector6};

use crate::band::BandMatrix;
use crate::element::{Element, Interpolation, Matrix12};
use crate::error::{BeamError, Result, invalid};
use crate::inertia::RigidInertia;
use crate::profile::{ElasticConstants, Profile};
use crate::station::{SectionMotion, Station};

/// Number of vectors that the iteration has in addition to the wanted modes. More vectors converge in fewer iterations.
const SPARE_VECTORS: usize = 8;

/// Maximum number of iterations.
const MAX_ITERATIONS: usize = 400;

/// Largest relative change of an eigenvalue in an iteration after convergence.
const EIGENVALUE_TOLERANCE: f64 = 1e-12;

/// Rounding errors of the eigenvalues mu = 1 / lambda, as a fraction of the largest one.
const ROUNDING: f64 = 64.0 * f64::EPSILON;

/// Largest ratio of two eigenvalues. Rounding errors dominate modes of higher eigenvalues.
const MAX_EIGENVALUE_RATIO: f64 = 1e10;

/// Iterations after the eigenvalues have converged, because the error of a shape decreases with the square root of the
/// error of its eigenvalue.
const EXTRA_ITERATIONS: usize = 4;

/// An element of a beam: its sections and its material.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BeamElement {
    pub profile: Profile,
    pub material: ElasticConstants,
}

/// A cantilever along a polyline, clamped at its first node, with rigid bodies that are fixed to sections.
#[derive(Debug, Clone)]
pub struct Beam {
    nodes: Vec<Vector3<f64>>,
    elements: Vec<BeamElement>,
    /// Rigid bodies that are part of the beam's own mass.
    own_bodies: Vec<(Station, RigidInertia)>,
    /// Rigid inertias of everything that hangs on the joints.
    carried_bodies: Vec<(Station, RigidInertia)>,
}

/// The lowest modes of a beam.
#[derive(Debug, Clone)]
pub struct BeamModes {
    /// Eigenvalues in (rad/s)^2, ascending.
    pub eigenvalues: Vec<f64>,
    /// Nodal displacements and rotations: 6 (N + 1) rows and one column per mode. The first six rows, those of the
    /// clamped node, are zero. Normalized: Phi^T (M + sum P^T D P) Phi = I.
    pub mode_shapes: DMatrix<f64>,
}

/// The inertia of modes with the beam's own mass M, without the carried bodies.
#[derive(Debug, Clone)]
pub struct ModalInertia {
    /// R^T M Phi (6 x r): momentum and angular momentum about the origin per unit rate of each mode.
    pub momenta: Matrix6xX<f64>,
    /// Phi^T M Phi (r x r).
    pub masses: DMatrix<f64>,
}

impl Beam {
    /// A beam through N + 1 `nodes` (meters) with N elements.
    ///
    /// # Errors
    /// `Invalid` unless all numbers are finite and all lengths, sections and moduli are positive.
    pub fn new(nodes: Vec<Vector3<f64>>, elements: Vec<BeamElement>) -> Result<Self> {
        if elements.is_empty() || nodes.len() != elements.len() + 1 {
            return Err(invalid("elements", "one less than the nodes, and at least one", elements.len()));
        }
        if let Some(ends) = nodes.windows(2).find(|ends| !is_positive((ends[1] - ends[0]).norm())) {
            return Err(invalid("nodes", "elements of a positive finite length", format!("{:?}", ends[1] - ends[0])));
        }
        if let Some(element) = elements.iter().find(|element| !element.profile.is_valid()) {
            return Err(invalid("profile", "positive finite sections", format!("{:?}", element.profile)));
        }
        let is_valid = |element: &&BeamElement| {
            let ElasticConstants { youngs_modulus, shear_modulus, density } = element.material;
            [youngs_modulus, shear_modulus, density].into_iter().all(is_positive)
        };
        if let Some(element) = elements.iter().find(|element| !is_valid(element)) {
            return Err(invalid("material", "positive finite constants", format!("{:?}", element.material)));
        }
        Ok(Self { nodes, elements, own_bodies: Vec::new(), carried_bodies: Vec::new() })
    }

    /// Adds a rigid body to the beam's own mass, such as a fruit. `body` is its inertia about the center of the section
    /// at `station`, in the axes of the nodes. A station beyond the beam is moved to its tip.
    pub fn add_own_body(&mut self, station: Station, body: RigidInertia) {
        self.own_bodies.push((self.clamp(station), body));
    }

    /// Adds the rigid inertia of everything that hangs on a joint. See [`Self::add_own_body`]. A heavy body should be at
    /// a node, because an element cannot bend by different amounts on both sides of a point within it.
    pub fn carry(&mut self, station: Station, body: RigidInertia) {
        self.carried_bodies.push((self.clamp(station), body));
    }

    /// The N + 1 nodes, in meters.
    pub fn nodes(&self) -> &[Vector3<f64>] {
        &self.nodes
    }

    /// The N elements.
    pub fn elements(&self) -> &[BeamElement] {
        &self.elements
    }

    /// The carried bodies and their stations.
    pub fn carried_bodies(&self) -> &[(Station, RigidInertia)] {
        &self.carried_bodies
    }

    /// Whether the beam has own or carried bodies.
    pub(crate) fn has_bodies(&self) -> bool {
        !self.own_bodies.is_empty() || !self.carried_bodies.is_empty()
    }

    /// A beam of valid nodes and elements without bodies.
    pub(crate) const fn from_valid_parts(nodes: Vec<Vector3<f64>>, elements: Vec<BeamElement>) -> Self {
        Self { nodes, elements, own_bodies: Vec::new(), carried_bodies: Vec::new() }
    }

    /// Length of the centerline in meters.
    pub fn length(&self) -> f64 {
        self.nodes.windows(2).map(|ends| (ends[1] - ends[0]).norm()).sum()
    }

    /// Mass of the elements in kg, without bodies.
    pub fn element_mass(&self) -> f64 {
        let lengths = self.nodes.windows(2).map(|ends| (ends[1] - ends[0]).norm());
        let line_masses = self.elements.iter().map(|element| element.material.density * element.profile.mean_area());
        lengths.zip(line_masses).map(|(length, line_mass)| length * line_mass).sum()
    }

    /// The center of the section at a station.
    pub fn center(&self, station: Station) -> Vector3<f64> {
        let Station { element, fraction } = self.clamp(station);
        self.nodes[element].lerp(&self.nodes[element + 1], fraction)
    }

    /// R^T M R: the inertia of the beam and its own bodies about the origin of the coordinates of the nodes.
    pub fn rigid_inertia(&self) -> RigidInertia {
        let rigid = self.rigid_dofs();
        let matrix = rigid.tr_mul(&self.assemble_mass(&self.own_bodies).multiply(&rigid));
        RigidInertia::from_matrix(Matrix6::from_fn(|row, column| matrix[(row, column)]))
    }

    /// The inertia of the beam's modes with its own mass.
    pub fn modal_inertia(&self, modes: &BeamModes) -> ModalInertia {
        if modes.mode_shapes.ncols() == 0 {
            return ModalInertia { momenta: Matrix6xX::zeros(0), masses: DMatrix::zeros(0, 0) };
        }
        let momentum = self.assemble_mass(&self.own_bodies).multiply(&modes.mode_shapes);
        let momenta = self.rigid_dofs().tr_mul(&momentum);
        let masses = modes.mode_shapes.tr_mul(&momentum);
        ModalInertia {
            momenta: Matrix6xX::from_fn(momenta.ncols(), |row, column| momenta[(row, column)]),
            masses: (&masses + masses.transpose()) * 0.5,
        }
    }

    /// H (6 x r): the motion of the section at a station, per unit of each mode. Rows 0 to 2 are the displacement of
    /// the center, rows 3 to 5 the rotation vector.
    pub fn section_motions(&self, modes: &BeamModes, station: Station) -> Matrix6xX<f64> {
        let (element, interpolation) = self.interpolation(station);
        let product = interpolation * modes.mode_shapes.fixed_rows::<12>(6 * element);
        Matrix6xX::from_fn(product.ncols(), |row, column| product[(row, column)])
    }

    /// The motion of the section at a station under nodal displacements `dofs` (6 (N + 1)).
    pub fn section_motion(&self, dofs: &DVector<f64>, station: Station) -> SectionMotion {
        let (element, interpolation) = self.interpolation(station);
        let motion = interpolation * dofs.fixed_rows::<12>(6 * element);
        SectionMotion {
            center: self.center(station),
            translation: motion.fixed_rows::<3>(0).into_owned(),
            rotation: motion.fixed_rows::<3>(3).into_owned(),
        }
    }

    /// Nodal displacements (6 (N + 1)) at rest under a force (N) and a moment (N m) on the section at a station.
    ///
    /// # Errors
    /// `Singular` if the stiffness is not positive definite.
    pub fn solve_static(&self, station: Station, wrench: &Vector6<f64>) -> Result<DVector<f64>> {
        let (element, interpolation) = self.interpolation(station);
        let mut load = DMatrix::zeros(6 * self.nodes.len(), 1);
        load.fixed_view_mut::<12, 1>(6 * element, 0).copy_from(&(interpolation.transpose() * wrench));
        let factor = self.assemble_stiffness().without_first(6).factor().ok_or(BeamError::Singular)?;
        let free = factor.solve_upper(factor.solve_lower(load.rows(6, load.nrows() - 6).into_owned()));
        let mut dofs = DVector::zeros(6 * self.nodes.len());
        dofs.rows_mut(6, free.nrows()).copy_from(&free.column(0));
        Ok(dofs)
    }

    /// The `count` lowest modes. There are fewer if the beam has fewer degrees of freedom, or if the eigenvalue of a mode
    /// is more than 10^10 times the lowest one.
    ///
    /// Orthogonal iteration with Rayleigh-Ritz projection (Golub and Van Loan, "Matrix Computations", section 8.2). It
    /// needs a few vectors more than modes. Its cost is proportional to the number of elements; that of a dense solution
    /// is proportional to the cube of this number. K is factored instead of M, because axial stiffness is up to 10^10
    /// times the lowest bending stiffness. With K = L L^T, the lowest modes have the largest eigenvalues mu = 1 / lambda
    /// of A = L^-1 M L^-T, which are accurate to full precision. For an eigenvector y of A, phi = L^-T y / sqrt(mu).
    ///
    /// # Errors
    /// `Singular` if K is not positive definite, or `NotConverged`.
    pub fn solve_modes(&self, count: usize) -> Result<BeamModes> {
        if count == 0 {
            return Ok(self.create_modes(&[], DMatrix::zeros(6 * self.elements.len(), 0)));
        }
        let (stiffness, mass) = self.assemble_free();
        let factor = stiffness.factor().ok_or(BeamError::Singular)?;
        let vector_count = (count + SPARE_VECTORS).min(mass.size());
        let mut vectors = start_vectors(mass.size(), vector_count);
        let mut inverse_eigenvalues = vec![f64::INFINITY; count.min(vector_count)];
        let mut converged_iterations = 0;
        for _ in 0..MAX_ITERATIONS {
            let basis = vectors.qr().q();
            let shapes = factor.solve_upper(basis.clone());
            let mapped = factor.solve_lower(mass.multiply(&shapes));
            let projected = basis.tr_mul(&mapped);
            let eigen = SymmetricEigen::try_new((&projected + projected.transpose()) * 0.5, f64::EPSILON, 10_000)
                .ok_or(BeamError::NotConverged)?;
            let mut order: Vec<usize> = (0..vector_count).collect();
            order.sort_by(|a, b| eigen.eigenvalues[*b].total_cmp(&eigen.eigenvalues[*a]));
            let largest = eigen.eigenvalues[order[0]];
            let mut is_converged = true;
            for (mu, index) in inverse_eigenvalues.iter_mut().zip(&order) {
                let change = (*mu - eigen.eigenvalues[*index]).abs();
                *mu = eigen.eigenvalues[*index];
                is_converged &= change <= EIGENVALUE_TOLERANCE * *mu + ROUNDING * largest;
            }
            converged_iterations += usize::from(is_converged);
            if converged_iterations > EXTRA_ITERATIONS {
                inverse_eigenvalues.retain(|mu| *mu >= largest / MAX_EIGENVALUE_RATIO);
                let ritz_vectors = eigen.eigenvectors.select_columns(&order[..inverse_eigenvalues.len()]);
                return Ok(self.create_modes(&inverse_eigenvalues, shapes * ritz_vectors));
            }
            vectors = mapped;
        }
        Err(BeamError::NotConverged)
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

    /// K, and M with the own and the carried bodies, of the 6 N free degrees of freedom.
    pub(crate) fn assemble_free(&self) -> (BandMatrix, BandMatrix) {
        let bodies: Vec<_> = self.own_bodies.iter().chain(&self.carried_bodies).copied().collect();
        (self.assemble_stiffness().without_first(6), self.assemble_mass(&bodies).without_first(6))
    }

    /// K of the 6 (N + 1) degrees of freedom, including those of the clamped node.
    fn assemble_stiffness(&self) -> BandMatrix {
        self.assemble(Element::stiffness)
    }

    /// M with `bodies` of the 6 (N + 1) degrees of freedom.
    fn assemble_mass(&self, bodies: &[(Station, RigidInertia)]) -> BandMatrix {
        let mut mass = self.assemble(Element::mass);
        for (Station { element, fraction }, body) in bodies {
            add_element(&mut mass, *element, &self.element(*element).body_mass(*fraction, body));
        }
        mass
    }

    /// The sum of the matrices of all elements.
    fn assemble(&self, matrix_of: impl Fn(&Element) -> Matrix12) -> BandMatrix {
        let mut matrix = BandMatrix::zeros(6 * self.nodes.len());
        for index in 0..self.elements.len() {
            add_element(&mut matrix, index, &matrix_of(&self.element(index)));
        }
        matrix
    }

    fn element(&self, index: usize) -> Element {
        let BeamElement { profile, material } = self.elements[index];
        Element::new([&self.nodes[index], &self.nodes[index + 1]], profile, material)
    }

    /// The element of a station, and the interpolation there.
    fn interpolation(&self, station: Station) -> (usize, Interpolation) {
        let Station { element, fraction } = self.clamp(station);
        (element, self.element(element).interpolation(fraction))
    }

    /// A station on the beam.
    fn clamp(&self, station: Station) -> Station {
        if station.element >= self.elements.len() {
            return Station { element: self.elements.len() - 1, fraction: 1.0 };
        }
        let fraction = if station.fraction.is_nan() { 0.0 } else { station.fraction.clamp(0.0, 1.0) };
        Station { element: station.element, fraction }
    }

    /// Nodal displacements (6 (N + 1) rows) of the six rigid motions about the origin. The shape functions reproduce
    /// them exactly.
    fn rigid_dofs(&self) -> DMatrix<f64> {
        let mut rigid = DMatrix::zeros(6 * self.nodes.len(), 6);
        for (node, position) in self.nodes.iter().enumerate() {
            let mut block = Matrix6::identity();
            block.fixed_view_mut::<3, 3>(0, 3).copy_from(&-position.cross_matrix());
            rigid.view_mut((6 * node, 0), (6, 6)).copy_from(&block);
        }
        rigid
    }
}

pub(crate) fn is_positive(number: f64) -> bool {
    number.is_finite() && number > 0.0
}

/// Adds the lower triangle of an element's matrix.
fn add_element(matrix: &mut BandMatrix, element: usize, block: &Matrix12) {
    for row in 0..12 {
        for column in 0..=row {
            matrix.add(6 * element + row, 6 * element + column, block[(row, column)]);
        }
    }
}

/// Pseudorandom entries between -1 and 1, the same in every call (the generator splitmix64 by Vigna).
fn start_vectors(rows: usize, columns: usize) -> DMatrix<f64> {
    let mut state = 0_u64;
    DMatrix::from_fn(rows, columns, |_, _| {
        state = state.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut bits = (state ^ (state >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        bits = (bits ^ (bits >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((bits ^ (bits >> 31)) >> 11) as f64 / (1_u64 << 52) as f64 - 1.0
    })
}

#[cfg(test)]
mod tests;
