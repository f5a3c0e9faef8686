//! Beams and random numbers for tests.

use nalgebra::{DMatrix, Vector3};

use crate::beam::{Beam, BeamModes};
use crate::profile::ElasticConstants;

pub(crate) const WOOD: ElasticConstants = ElasticConstants { youngs_modulus: 8e9, shear_modulus: 5e8, density: 800.0 };

/// The points of a polyline along an oblique direction, bent by `bend` radians. Its length is 1 m if it is straight.
pub(crate) fn curve(elements: usize, bend: f64) -> Vec<Vector3<f64>> {
    let orientation = nalgebra::Rotation3::from_euler_angles(0.4, 0.9, -1.3);
    let point = |index: usize| {
        let s = index as f64 / elements as f64;
        let local_position = match bend == 0.0 {
            true => Vector3::new(0.0, s, 0.0),
            false => Vector3::new((1.0 - (bend * s).cos()) / bend, (bend * s).sin() / bend, 0.1 * s * s),
        };
        orientation * local_position
    };
    (0..=elements).map(point).collect()
}

/// A beam along [`curve`] with radii at its ends in meters.
pub(crate) fn curved_beam(elements: usize, radii: [f64; 2], bend: f64, material: ElasticConstants) -> Beam {
    let radius = |index: usize| radii[0] + (radii[1] - radii[0]) * index as f64 / elements as f64;
    let all_radii: Vec<f64> = (0..=elements).map(radius).collect();
    Beam::along(&curve(elements, bend), &all_radii, material, 1).expect("a valid beam")
}

/// The largest ||K phi - lambda M phi|| / ||K phi||, and the largest deviation of phi^T M phi from the identity.
pub(crate) fn eigen_residuals(beam: &Beam, modes: &BeamModes) -> (f64, f64) {
    let (stiffness, mass) = beam.assemble_free();
    let (stiffness, mass) = (stiffness.to_dense(), mass.to_dense());
    let mode_shapes = modes.mode_shapes.rows(6, stiffness.nrows()).into_owned();
    let residual = |column: usize| {
        let force = &stiffness * mode_shapes.column(column);
        (&force - &mass * mode_shapes.column(column) * modes.eigenvalues[column]).norm() / force.norm()
    };
    let gram =
        mode_shapes.transpose() * &mass * &mode_shapes - DMatrix::identity(mode_shapes.ncols(), mode_shapes.ncols());
    ((0..mode_shapes.ncols()).map(residual).fold(0.0, f64::max), gram.abs().max())
}

/// A linear congruential generator (Knuth's MMIX).
pub(crate) struct Random(u64);

impl Random {
    pub(crate) fn new(seed: u64) -> Self {
        Self(seed)
    }

    /// A number between -`limit` and `limit`.
    pub(crate) fn uniform_symmetric(&mut self, limit: f64) -> f64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        limit * ((self.0 >> 11) as f64 / (1_u64 << 52) as f64 - 1.0)
    }
}
