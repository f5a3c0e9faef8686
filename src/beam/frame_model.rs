//! An independent model of a beam, against which its modes and inertia are tested: a fine frame of two-node elements
//! with constant strain, assembled densely. It shares only the geometry with `beam` and `element`: its matrices are in
//! closed form, use vectors instead of local axes, and its mass is lumped at the nodes.

use nalgebra::{Cholesky, DMatrix, Matrix3, Matrix6, Vector3};

use crate::inertia::RigidInertia;
use crate::profile::ElasticConstants;

/// A frame with a node at each position. The node 0 is clamped.
pub(crate) struct FrameModel {
    stiffness: DMatrix<f64>,
    mass: DMatrix<f64>,
}

impl FrameModel {
    /// The frame through `nodes` with a circular section per element.
    pub(crate) fn new(nodes: &[Vector3<f64>], radii: &[f64], material: &ElasticConstants) -> Self {
        let size = 6 * nodes.len();
        let mut model = Self { stiffness: DMatrix::zeros(size, size), mass: DMatrix::zeros(size, size) };
        for (index, radius) in radii.iter().enumerate() {
            let axis = nodes[index + 1] - nodes[index];
            let block = element_stiffness(&axis, *radius, material);
            let mut view = model.stiffness.view_mut((6 * index, 6 * index), (12, 12));
            view += block;
            let half = half_of_element(&axis, *radius, material);
            model.add_body(index, &half);
            model.add_body(index + 1, &half);
        }
        model
    }

    /// Adds a rigid body about a node.
    pub(crate) fn add_body(&mut self, node: usize, body: &RigidInertia) {
        let mut view = self.mass.view_mut((6 * node, 6 * node), (6, 6));
        view += body.matrix();
    }

    /// M of all nodes.
    pub(crate) const fn mass(&self) -> &DMatrix<f64> {
        &self.mass
    }

    /// The lowest frequencies in hertz, ascending.
    pub(crate) fn frequencies(&self, count: usize) -> Vec<f64> {
        let free = self.stiffness.nrows() - 6;
        let [stiffness, mass] =
            [&self.stiffness, &self.mass].map(|matrix| matrix.view((6, 6), (free, free)).into_owned());
        // 1 / omega^2 are the eigenvalues of L^-1 M L^-T with K = L L^T.
        let factor = Cholesky::new(stiffness).expect("a positive definite stiffness").unpack();
        let half_transformed = factor.solve_lower_triangular(&mass).expect("a regular factor");
        let transformed = factor.solve_lower_triangular(&half_transformed.transpose()).expect("a regular factor");
        let mut inverse_eigenvalues: Vec<f64> = transformed.symmetric_eigenvalues().iter().copied().collect();
        inverse_eigenvalues.sort_by(|a, b| b.total_cmp(a));
        inverse_eigenvalues[..count].iter().map(|mu| mu.sqrt().recip() / std::f64::consts::TAU).collect()
    }
}

/// Half of the mass of an element, about one of its nodes.
fn half_of_element(axis: &Vector3<f64>, radius: f64, material: &ElasticConstants) -> RigidInertia {
    let (length, tangent) = (axis.norm(), axis.normalize());
    let half_mass = 0.5 * material.density * std::f64::consts::PI * radius.powi(2) * length;
    // The moments of a disk: m r^2 / 2 about its axis, half of that about a diameter.
    let tensor = (Matrix3::identity() + tangent * tangent.transpose()) * (0.25 * half_mass * radius.powi(2));
    RigidInertia::body(half_mass, Vector3::zeros(), tensor)
}

/// The stiffness for the displacements and rotation vectors of both nodes. The strain of the centerline relative to the
/// mean rotation is constant, and so is the curvature. With the residual bending flexibility l^2 / (12 E I) in shear, the
/// element is exact for end loads (MacNeal, "A simple quadrilateral shell element", Computers and Structures 8, 1978).
fn element_stiffness(axis: &Vector3<f64>, radius: f64, material: &ElasticConstants) -> DMatrix<f64> {
    let (l, t) = (axis.norm(), axis.normalize());
    let (area, moment) = (std::f64::consts::PI * radius.powi(2), std::f64::consts::FRAC_PI_4 * radius.powi(4));
    let (e, g) = (material.youngs_modulus, material.shear_modulus);
    let shear = 1.0 / (1.0 / (0.9 * g * area) + l * l / (12.0 * e * moment));
    let along = t * t.transpose();
    let across = Matrix3::identity() - along;
    let mut moduli = Matrix6::zeros();
    moduli.fixed_view_mut::<3, 3>(0, 0).copy_from(&(along * (e * area) + across * shear));
    moduli.fixed_view_mut::<3, 3>(3, 3).copy_from(&(along * (2.0 * g * moment) + across * (e * moment)));
    let mut strains = DMatrix::zeros(6, 12);
    for (node, sign) in [(0, -1.0), (1, 1.0)] {
        let slope = Matrix3::identity() * (sign / l);
        strains.fixed_view_mut::<3, 3>(0, 6 * node).copy_from(&slope);
        strains.fixed_view_mut::<3, 3>(3, 6 * node + 3).copy_from(&slope);
        // - theta x t = [t] theta.
        strains.fixed_view_mut::<3, 3>(0, 6 * node + 3).copy_from(&(t.cross_matrix() * 0.5));
    }
    strains.transpose() * moduli * strains * l
}
