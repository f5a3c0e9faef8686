//! The stiffness and consistent mass of one Timoshenko beam element.
//!
//! Degrees of freedom per node: displacement along x, y, z (m), rotation about x, y, z (rad). Local x points along the
//! element. Stretch and twist are linear. Bending has the shape functions of Friedman and Kosmatka ("An improved
//! two-node Timoshenko beam finite element", Computers and Structures 47, 1993), which are exact for end loads: a cubic
//! displacement and a quadratic rotation that depend on the ratio of bending to shear stiffness. They become those of
//! Euler and Bernoulli for slender elements, so neither thin nor thick elements lock. The mass includes the rotary
//! inertia of the sections.

use nalgebra::{Matrix3, RowSVector, SMatrix, Vector3, Vector4};

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

    /// Stiffness and consistent mass in the coordinate frame of the nodes.
    pub(crate) fn matrices(&self) -> (Matrix12, Matrix12) {
        let (mut stiffness, mut mass) = (Matrix12::zeros(), Matrix12::zeros());
        let ElasticConstants { youngs_modulus, shear_modulus, density } = self.material;
        let slopes = [-1.0 / self.length, 1.0 / self.length];
        for (x, weight) in GAUSS_POINTS {
            let (section, weight) = (self.profile.section(x), weight * self.length);
            let values = [1.0 - x, x];
            add_linear(&mut stiffness, 0, slopes, weight * youngs_modulus * section.area);
            add_linear(&mut stiffness, 3, slopes, weight * shear_modulus * section.torsion);
            add_linear(&mut mass, 0, values, weight * density * section.area);
            add_linear(&mut mass, 3, values, weight * density * section.polar_moment());
            for (plane, dofs) in [BENDING_Y, BENDING_Z].iter().enumerate() {
                let basis = BendingBasis::new(x, self.length, self.shear_ratios[plane]);
                let moment = section.moments[plane];
                add_bending(&mut stiffness, dofs, &basis.curvatures, weight * youngs_modulus * moment);
                add_bending(&mut stiffness, dofs, &basis.shears, weight * shear_modulus * section.shear_area);
                add_bending(&mut mass, dofs, &basis.values, weight * density * section.area);
                add_bending(&mut mass, dofs, &basis.rotations, weight * density * moment);
            }
        }
        let rotation = self.rotation_of_nodes();
        (rotation.transpose() * stiffness * rotation, rotation.transpose() * mass * rotation)
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
        let rotated = local * self.rotation_of_nodes();
        let mut interpolation = Interpolation::zeros();
        for row in [0, 3] {
            let block = self.axes.transpose() * rotated.fixed_rows::<3>(row);
            interpolation.fixed_rows_mut::<3>(row).copy_from(&block);
        }
        interpolation
    }

    /// P^T D P: the mass of a rigid body that is fixed to the section at a fraction of the element. The inertia D is
    /// about the center of the section.
    pub(crate) fn body_mass(&self, fraction: f64, body: &RigidInertia) -> Matrix12 {
        let interpolation = self.interpolation(fraction);
        interpolation.transpose() * body.matrix() * interpolation
    }

    /// The local axes for the four vectors of the degrees of freedom.
    fn rotation_of_nodes(&self) -> Matrix12 {
        let mut local_from_global = Matrix12::zeros();
        for block in 0..4 {
            local_from_global.fixed_view_mut::<3, 3>(3 * block, 3 * block).copy_from(&self.axes);
        }
        local_from_global
    }
}

/// Adds the outer product of linear shape functions, for the degree of freedom `dof` of both nodes.
fn add_linear(matrix: &mut Matrix12, dof: usize, shape_functions: [f64; 2], factor: f64) {
    for (row, a) in shape_functions.iter().enumerate() {
        for (column, b) in shape_functions.iter().enumerate() {
            matrix[(dof + 6 * row, dof + 6 * column)] += factor * a * b;
        }
    }
}

/// Adds the outer product of the shape functions of one plane of bending.
fn add_bending(matrix: &mut Matrix12, (dofs, signs): &([usize; 4], [f64; 4]), weights: &Vector4<f64>, factor: f64) {
    let mut row = RowSVector::<f64, 12>::zeros();
    for index in 0..4 {
        row[dofs[index]] = signs[index] * weights[index];
    }
    *matrix += row.transpose() * row * factor;
}
