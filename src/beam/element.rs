//! The stiffness and consistent mass of one Timoshenko beam element.
//!
//! Degrees of freedom per node: displacement along x, y, z (m), rotation about x, y, z (rad). Local x points along the
//! element. Stretch and twist are linear. Bending has the shape functions of Friedman and Kosmatka ("An improved
//! two-node Timoshenko beam finite element", Computers and Structures 47, 1993), which are exact for end loads: a cubic
//! displacement and a quadratic rotation that depend on the ratio of bending to shear stiffness. They become those of
//! Euler and Bernoulli for slender elements, so neither thin nor thick elements lock. The mass includes the rotary
//! inertia of the sections.

use nalgebra::{Matrix2, Matrix3, Matrix4, SMatrix, SVector, Vector2, Vector3, Vector4};

use crate::inertia::RigidInertia;
use crate::profile::{ElasticConstants, Profile};

pub(crate) type Matrix12 = SMatrix<f64, 12, 12>;

/// Maps the twelve degrees of freedom of an element to the motion of a section.
pub(crate) type Interpolation = SMatrix<f64, 6, 12>;

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

/// Weights of the displacement and the rotation of the first node, then of the second, in one plane of bending.
struct BendingBasis {
    /// Weights in the transverse displacement.
    values: Vector4<f64>,
    /// Weights in the rotation of the section.
    rotations: Vector4<f64>,
    /// Weights in the curvature: the derivative of the rotation, per meter.
    curvatures: Vector4<f64>,
    /// Weights in the shear strain, which is constant along the element.
    shears: Vector4<f64>,
}

impl BendingBasis {
    /// The basis at the fraction `x` of an element of `length` meters. `ratio` is 12 E I / (G A_s L^2).
    fn new(x: f64, length: f64, ratio: f64) -> Self {
        let half = 0.5 * ratio;
        let bubble = x * x * (2.0 * x - 3.0) - ratio * x;
        let scale = 1.0 / (1.0 + ratio);
        Self {
            values: Vector4::new(
                1.0 + ratio + bubble,
                length * x * (x * x - (2.0 + half) * x + 1.0 + half),
                -bubble,
                length * x * (x * x - (1.0 - half) * x - half),
            ) * scale,
            rotations: Vector4::new(
                6.0 * x * (x - 1.0) / length,
                (3.0 * x - 4.0 - ratio) * x + 1.0 + ratio,
                6.0 * x * (1.0 - x) / length,
                (3.0 * x - 2.0 + ratio) * x,
            ) * scale,
            curvatures: Vector4::new(
                (12.0 * x - 6.0) / length,
                6.0 * x - 4.0 - ratio,
                (6.0 - 12.0 * x) / length,
                6.0 * x - 2.0 + ratio,
            ) * (scale / length),
            shears: Vector4::new(-ratio / length, -half, ratio / length, -half) * scale,
        }
    }
}

/// Stiffness or mass of an element in its local axes. Stretch, twist and bending in two planes do not act on each other.
struct ElementParts {
    /// Of the displacements along the element.
    stretch: Matrix2<f64>,
    /// Of the rotations about the element.
    twist: Matrix2<f64>,
    /// Per plane: of the degrees of freedom of [`BENDING_Y`] and [`BENDING_Z`].
    bending: [Matrix4<f64>; 2],
}

/// One element between two nodes.
pub(crate) struct Element {
    length: f64,
    /// Local axes as rows.
    axes: Matrix3<f64>,
    profile: Profile,
    material: ElasticConstants,
    /// 12 E I / (G A_s L^2) in local y and z, at the middle of the element.
    shear_ratios: [f64; 2],
}

impl Element {
    pub(crate) fn new([from, to]: [&Vector3<f64>; 2], profile: Profile, material: ElasticConstants) -> Self {
        let length = (to - from).norm();
        let axes = profile.axes(&((to - from) / length));
        let section = profile.section(0.5);
        let shear_stiffness = material.shear_modulus * section.shear_area * length * length;
        let shear_ratios = section.moments.map(|moment| 12.0 * material.youngs_modulus * moment / shear_stiffness);
        Self { length, axes, profile, material, shear_ratios }
    }

    /// Stiffness in the coordinate frame of the nodes.
    pub(crate) fn stiffness(&self) -> Matrix12 {
        let ElasticConstants { youngs_modulus, shear_modulus, .. } = self.material;
        let slopes = Vector2::new(-1.0, 1.0) / self.length;
        let mut parts = ElementParts::zeros();
        for (x, weight) in GAUSS_POINTS {
            let (section, weight) = (self.profile.section(x), weight * self.length);
            parts.stretch += square(&slopes) * (weight * youngs_modulus * section.area);
            parts.twist += square(&slopes) * (weight * shear_modulus * section.torsion);
            for (plane, bending) in parts.bending.iter_mut().enumerate() {
                let basis = BendingBasis::new(x, self.length, self.shear_ratios[plane]);
                *bending += square(&basis.curvatures) * (weight * youngs_modulus * section.moments[plane]);
                *bending += square(&basis.shears) * (weight * shear_modulus * section.shear_area);
            }
        }
        self.to_global_axes(&parts.assemble())
    }

    /// Consistent mass in the coordinate frame of the nodes.
    pub(crate) fn mass(&self) -> Matrix12 {
        let mut parts = ElementParts::zeros();
        for (x, weight) in GAUSS_POINTS {
            let section = self.profile.section(x);
            let density = weight * self.length * self.material.density;
            let values = Vector2::new(1.0 - x, x);
            parts.stretch += square(&values) * (density * section.area);
            parts.twist += square(&values) * (density * section.polar_moment());
            for (plane, bending) in parts.bending.iter_mut().enumerate() {
                let basis = BendingBasis::new(x, self.length, self.shear_ratios[plane]);
                *bending += square(&basis.values) * (density * section.area);
                *bending += square(&basis.rotations) * (density * section.moments[plane]);
            }
        }
        self.to_global_axes(&parts.assemble())
    }

    /// A symmetric matrix in the coordinate frame of the nodes. Each 3 x 3 block belongs to two vectors of degrees of
    /// freedom.
    fn to_global_axes(&self, local: &Matrix12) -> Matrix12 {
        let mut global = Matrix12::zeros();
        for (row, column) in (0..4).flat_map(|row| (0..=row).map(move |column| (3 * row, 3 * column))) {
            let block = self.axes.transpose() * local.fixed_view::<3, 3>(row, column) * self.axes;
            global.fixed_view_mut::<3, 3>(row, column).copy_from(&block);
            global.fixed_view_mut::<3, 3>(column, row).copy_from(&block.transpose());
        }
        global
    }

    /// Displacement of the center (rows 0 to 2) and rotation vector (rows 3 to 5) of the section at a fraction of the
    /// element, in the coordinate frame of the nodes, per unit of each degree of freedom.
    pub(crate) fn interpolation(&self, fraction: f64) -> Interpolation {
        let mut local = Interpolation::zeros();
        for row in [0, 3] {
            (local[(row, row)], local[(row, row + 6)]) = (1.0 - fraction, fraction);
        }
        // A rotation about y is the negative rotation of the section in the plane of z.
        for (plane, (dofs, signs), rotation_row, sign) in [(0, BENDING_Y, 5, 1.0), (1, BENDING_Z, 4, -1.0)] {
            let basis = BendingBasis::new(fraction, self.length, self.shear_ratios[plane]);
            for index in 0..4 {
                local[(1 + plane, dofs[index])] = signs[index] * basis.values[index];
                local[(rotation_row, dofs[index])] = sign * signs[index] * basis.rotations[index];
            }
        }
        let mut interpolation = Interpolation::zeros();
        for (row, column) in [0, 3].into_iter().flat_map(|row| [0, 3, 6, 9].map(|column| (row, column))) {
            let block = self.axes.transpose() * local.fixed_view::<3, 3>(row, column) * self.axes;
            interpolation.fixed_view_mut::<3, 3>(row, column).copy_from(&block);
        }
        interpolation
    }

    /// P^T D P: the mass of a rigid body that is fixed to the section at a fraction of the element. The inertia D is
    /// about the center of the section.
    pub(crate) fn body_mass(&self, fraction: f64, body: &RigidInertia) -> Matrix12 {
        let interpolation = self.interpolation(fraction);
        interpolation.transpose() * body.matrix() * interpolation
    }
}

impl ElementParts {
    fn zeros() -> Self {
        Self { stretch: Matrix2::zeros(), twist: Matrix2::zeros(), bending: [Matrix4::zeros(); 2] }
    }

    /// The matrix of all twelve degrees of freedom.
    fn assemble(&self) -> Matrix12 {
        let mut matrix = Matrix12::zeros();
        for (dof, part) in [(0, &self.stretch), (3, &self.twist)] {
            for (row, column) in (0..2).flat_map(|row| [0, 1].map(|column| (row, column))) {
                matrix[(dof + 6 * row, dof + 6 * column)] = part[(row, column)];
            }
        }
        for ((dofs, signs), part) in [BENDING_Y, BENDING_Z].iter().zip(&self.bending) {
            for (row, column) in (0..4).flat_map(|row| [0, 1, 2, 3].map(|column| (row, column))) {
                matrix[(dofs[row], dofs[column])] = signs[row] * signs[column] * part[(row, column)];
            }
        }
        matrix
    }
}

/// The outer product of a vector with itself.
fn square<const N: usize>(vector: &SVector<f64, N>) -> SMatrix<f64, N, N> {
    vector * vector.transpose()
}
