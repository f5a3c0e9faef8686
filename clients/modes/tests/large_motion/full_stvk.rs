//! A reference for reduced forces: the Saint Venant-Kirchhoff material with all freedoms of a mesh, by Newton's method. It
//! computes stresses from the deformation gradient, and not from a polynomial.

use faer::prelude::Solve as _;
use faer::sparse::{SparseColMat, Triplet};
use modalcast_modes::tet10::{NODES, shape_points};
use nalgebra::{Matrix3, Vector3};

/// Maximum number of Newton iterations per load.
const MAX_ITERATIONS: usize = 40;

/// A solid whose held nodes do not move.
pub(crate) struct FullSolid<'a> {
    pub(crate) positions: &'a [Vector3<f64>],
    pub(crate) elements: &'a [[u32; NODES]],
    /// Lamé's parameters lambda and mu, pascals.
    pub(crate) lame_parameters: (f64, f64),
    pub(crate) is_held: Vec<bool>,
}

/// The force of an element and its derivative.
struct ElementResponse {
    force: [Vector3<f64>; NODES],
    stiffness: [[Matrix3<f64>; NODES]; NODES],
    volume: f64,
}

impl FullSolid<'_> {
    fn freedoms(&self) -> usize {
        3 * self.positions.len()
    }

    fn element_response(&self, element: &[u32; NODES], displacements: &[f64]) -> ElementResponse {
        let (lambda, mu) = self.lame_parameters;
        let nodes = element.map(|node| self.positions[node as usize]);
        let mut response = ElementResponse {
            force: [Vector3::zeros(); NODES],
            stiffness: [[Matrix3::zeros(); NODES]; NODES],
            volume: 0.0,
        };
        for point in shape_points(&nodes).expect("expected a valid element") {
            let mut deformation = Matrix3::identity();
            for (node, gradient) in element.iter().zip(&point.gradients) {
                let displacement = Vector3::from_column_slice(&displacements[3 * *node as usize..][..3]);
                deformation += displacement * gradient.transpose();
            }
            let strain = (deformation.transpose() * deformation - Matrix3::identity()) * 0.5;
            let stress = Matrix3::from_diagonal_element(lambda * strain.trace()) + strain * (2.0 * mu);
            response.volume += point.volume * deformation.determinant();
            // Per node: F^T applied to the gradient, so that the strain of a displacement is symmetric in both.
            let carried = point.gradients.map(|gradient| deformation * gradient);
            for i in 0..NODES {
                response.force[i] += deformation * stress * point.gradients[i] * point.volume;
                for j in 0..NODES {
                    let [gi, gj] = [point.gradients[i], point.gradients[j]];
                    let material = carried[i] * carried[j].transpose() * lambda
                        + carried[j] * carried[i].transpose() * mu
                        + deformation * deformation.transpose() * (mu * gi.dot(&gj));
                    let geometric = Matrix3::from_diagonal_element(gi.dot(&(stress * gj)));
                    response.stiffness[i][j] += (material + geometric) * point.volume;
                }
            }
        }
        response
    }

    /// The internal force of all freedoms, newtons.
    pub(crate) fn force(&self, displacements: &[f64]) -> Vec<f64> {
        let mut force = vec![0.0; self.freedoms()];
        for element in self.elements {
            self.add_force(element, &self.element_response(element, displacements), &mut force);
        }
        force
    }

    fn add_force(&self, element: &[u32; NODES], response: &ElementResponse, sum: &mut [f64]) {
        for (node, force) in element.iter().zip(&response.force) {
            (0..3).for_each(|axis| sum[3 * *node as usize + axis] += force[axis]);
        }
    }

    /// The volume of the deformed solid, cubic meters.
    pub(crate) fn volume(&self, displacements: &[f64]) -> f64 {
        self.elements.iter().map(|element| self.element_response(element, displacements).volume).sum()
    }

    /// Force, and the factor-ready stiffness without held freedoms, whose diagonal is 1.
    fn linearize(&self, displacements: &[f64]) -> (Vec<f64>, SparseColMat<usize, f64>) {
        let mut force = vec![0.0; self.freedoms()];
        let mut triplets = Vec::new();
        for element in self.elements {
            let response = self.element_response(element, displacements);
            self.add_force(element, &response, &mut force);
            for (i, row) in element.iter().enumerate() {
                for (j, column) in element.iter().enumerate() {
                    if self.is_held[*row as usize] || self.is_held[*column as usize] {
                        continue;
                    }
                    for entry in 0..9 {
                        let [a, b] = [entry / 3, entry % 3];
                        let value = response.stiffness[i][j][(a, b)];
                        triplets.push(Triplet::new(3 * *row as usize + a, 3 * *column as usize + b, value));
                    }
                }
            }
        }
        let held = (0..self.freedoms()).filter(|freedom| self.is_held[freedom / 3]);
        triplets.extend(held.map(|freedom| Triplet::new(freedom, freedom, 1.0)));
        let matrix = SparseColMat::try_new_from_triplets(self.freedoms(), self.freedoms(), &triplets);
        (force, matrix.expect("expected valid indices"))
    }

    /// K^-1 b.
    fn solve(matrix: &SparseColMat<usize, f64>, load: &[f64]) -> Vec<f64> {
        let mut vector = faer::Mat::from_fn(load.len(), 1, |row, _| load[row]);
        matrix.sp_lu().expect("expected an invertible stiffness").solve_in_place(vector.as_mut());
        vector.col(0).iter().copied().collect()
    }

    fn without_held(&self, mut vector: Vec<f64>) -> Vec<f64> {
        vector
            .iter_mut()
            .enumerate()
            .filter(|(freedom, _)| self.is_held[freedom / 3])
            .for_each(|(_, entry)| *entry = 0.0);
        vector
    }

    /// The displacements under a load by the stiffness at rest.
    pub(crate) fn linear_equilibrium(&self, load: &[f64]) -> Vec<f64> {
        let (_, stiffness) = self.linearize(&vec![0.0; self.freedoms()]);
        Self::solve(&stiffness, &self.without_held(load.to_vec()))
    }

    /// The displacements at equilibrium under a load, which is applied in `steps` steps.
    pub(crate) fn equilibrium(&self, load: &[f64], steps: usize) -> Vec<f64> {
        let mut displacements = vec![0.0; self.freedoms()];
        let scale = norm(load);
        for step in 1..=steps {
            let share = step as f64 / steps as f64;
            let mut residual = f64::INFINITY;
            for _ in 0..MAX_ITERATIONS {
                let (force, stiffness) = self.linearize(&displacements);
                let missing = load.iter().zip(&force).map(|(load, force)| share * load - force).collect();
                let missing = self.without_held(missing);
                residual = norm(&missing) / scale;
                if residual < 1e-10 {
                    break;
                }
                let increment = Self::solve(&stiffness, &missing);
                displacements.iter_mut().zip(increment).for_each(|(entry, increment)| *entry += increment);
            }
            assert!(residual < 1e-10, "step {step}: residual {residual:e}");
        }
        displacements
    }
}

pub(crate) fn norm(vector: &[f64]) -> f64 {
    vector.iter().map(|entry| entry * entry).sum::<f64>().sqrt()
}
