//! Large deformations of a solid of quadratic tetrahedra with a Saint Venant-Kirchhoff (StVK) material: the stress is
//! linear in the Green-Lagrange strain E = (H + H^T + H^T H) / 2, where H is the displacement gradient. The internal force
//! is then a polynomial of degree three in the displacements.
//!
//! In an element with straight edges, H is linear in the position, so that the energy has degree four, for which
//! [`crate::tet10::RULE`] is exact. A rule of four points, enough for small deformations, is not.

use nalgebra::{Matrix3, Vector3};
use rayon::prelude::*;

use crate::assembly::HELD_NODE;
use crate::materials::Material;
use crate::tet10::{NODES, Nodes, ShapePoint, shape_points};
use crate::volume_mesh::VolumeMesh;

/// The smallest stretch with which a StVK material is trusted. Below 1 / sqrt(3) = 0.577 it loses its stiffness under
/// compression; the limit has a margin.
pub const MIN_STRETCH: f64 = 0.6;

/// A solid of quadratic tetrahedra. Displacements are vectors of all freedoms, `3 node + axis`.
#[derive(Debug, Clone)]
pub struct StvkSolid<'a> {
    pub mesh: &'a VolumeMesh,
    /// The numbers of the nodes of each element, in the order of [`crate::tet10`]. [`HELD_NODE`] has no freedoms.
    pub element_nodes: &'a [[u32; NODES]],
    /// The number of nodes with freedoms.
    pub node_count: usize,
    /// Lamé's parameters lambda and mu of each element, pascals.
    pub lame_parameters: Vec<(f64, f64)>,
}

/// The gradient of nodal displacements at a point.
pub(crate) fn displacement_gradient(point: &ShapePoint, displacements: &Nodes) -> Matrix3<f64> {
    displacements.iter().zip(&point.gradients).map(|(displacement, gradient)| displacement * gradient.transpose()).sum()
}

/// (A + A^T) / 2.
fn symmetric(matrix: &Matrix3<f64>) -> Matrix3<f64> {
    (matrix + matrix.transpose()) * 0.5
}

/// The stress lambda tr(E) I + 2 mu E of a strain.
fn stress((lambda, mu): (f64, f64), strain: &Matrix3<f64>) -> Matrix3<f64> {
    Matrix3::from_diagonal_element(lambda * strain.trace()) + strain * (2.0 * mu)
}

impl<'a> StvkSolid<'a> {
    /// Creates a solid with one material per group of elements.
    pub fn new(
        mesh: &'a VolumeMesh,
        element_nodes: &'a [[u32; NODES]],
        node_count: usize,
        materials: &[Material],
    ) -> Self {
        let groups = mesh.element_groups.iter();
        let lame_parameters = groups.map(|group| materials[*group as usize].lame_parameters()).collect();
        Self { mesh, element_nodes, node_count, lame_parameters }
    }

    /// The points of integration of an element.
    pub(crate) fn points(&self, element: usize) -> impl Iterator<Item = ShapePoint> + use<> {
        shape_points(&self.mesh.nodes_of(element)).into_iter().flatten()
    }

    /// The displacements of an element's nodes.
    pub(crate) fn element_displacements(&self, element: usize, displacements: &[f64]) -> Nodes {
        self.element_nodes[element].map(|node| match node {
            HELD_NODE => Vector3::zeros(),
            node => Vector3::from_column_slice(&displacements[3 * node as usize..][..3]),
        })
    }

    /// The second derivative of the internal force at rest in the directions `first` and `second`, newtons per unit of
    /// both. With the strain E = A + B / 2, where A(u) is the symmetric part of H and B(u, u) = H^T H, the force in the
    /// direction w is B(second, w) : C A(first) + B(first, w) : C A(second) + A(w) : C B(first, second).
    pub fn second_derivative(&self, first: &[f64], second: &[f64]) -> Vec<f64> {
        let element_forces = |element: usize| {
            let lame = self.lame_parameters[element];
            let displacements = [first, second].map(|field| self.element_displacements(element, field));
            let mut forces: Nodes = [Vector3::zeros(); NODES];
            for point in self.points(element) {
                let [first, second] = displacements.each_ref().map(|field| displacement_gradient(&point, field));
                let mut flux = second * stress(lame, &symmetric(&first)) + first * stress(lame, &symmetric(&second));
                flux += stress(lame, &symmetric(&(first.transpose() * second)));
                for (force, gradient) in forces.iter_mut().zip(&point.gradients) {
                    *force += flux * gradient * point.volume;
                }
            }
            forces
        };
        let forces: Vec<Nodes> = (0..self.element_nodes.len()).into_par_iter().map(element_forces).collect();
        // In the order of the elements, so that the result does not depend on the number of threads.
        let mut sum = vec![0.0; 3 * self.node_count];
        for (nodes, forces) in self.element_nodes.iter().zip(&forces) {
            for (node, force) in nodes.iter().zip(forces).filter(|(node, _)| **node != HELD_NODE) {
                (0..3).for_each(|axis| sum[3 * *node as usize + axis] += force[axis]);
            }
        }
        sum
    }

    /// The smallest stretch in the solid: the smallest singular value of the deformation gradient F = I + H over all points
    /// of integration. Negative if an element is turned inside out at one of them.
    pub fn smallest_stretch(&self, displacements: &[f64]) -> f64 {
        let smallest_in = |element: usize| {
            let field = self.element_displacements(element, displacements);
            let stretch = |point: ShapePoint| {
                let deformation = Matrix3::identity() + displacement_gradient(&point, &field);
                // The eigenvalues of F^T F are the squares.
                let smallest = (deformation.transpose() * deformation).symmetric_eigenvalues().min().max(0.0).sqrt();
                if deformation.determinant() > 0.0 { smallest } else { -smallest }
            };
            self.points(element).map(stretch).fold(f64::INFINITY, f64::min)
        };
        (0..self.element_nodes.len()).into_par_iter().map(smallest_in).reduce(|| f64::INFINITY, f64::min)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::volume_mesh::tests::cube;

    #[test]
    fn smallest_stretch_is_that_of_the_deformation() {
        let mesh = VolumeMesh::new(cube()).expect("a mesh");
        let materials = [Material::new(1e6, 0.3, 1000.0).expect("a material")];
        let solid = StvkSolid::new(&mesh, &mesh.elements, mesh.positions.len(), &materials);
        let stretch = |x: f64, y: f64, z: f64| {
            let change = Vector3::new(x - 1.0, y - 1.0, z - 1.0);
            let displacements = mesh.positions.iter().flat_map(|rest| <[f64; 3]>::from(change.component_mul(rest)));
            solid.smallest_stretch(&displacements.collect::<Vec<f64>>())
        };
        assert!((stretch(0.7, 1.3, 2.0) - 0.7).abs() < 1e-12);
        assert!((stretch(-0.2, 1.0, 1.0) + 0.2).abs() < 1e-12, "turned inside out");
    }
}
