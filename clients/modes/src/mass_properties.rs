//! The mass properties of a free body with its modes, about the origin of its coordinates.

use nalgebra::{DMatrix, Matrix3, Vector3};

use crate::assembly::{SystemMatrices, dot};
use crate::eigensolver::ElasticModes;

/// The number of rigid motions: translations along the axes, then rotations about them.
pub const RIGID_MOTIONS: usize = 6;

/// [[R^T M R, R^T M U], [U^T M R, U^T M U]] with the rigid motions R about the origin, in kg and meters: the kinetic energy
/// of a body whose frame moves by X while its coordinates are q is half of [X', q']^T times this matrix times [X', q'].
/// `positions` has the position of every node in meters.
pub fn mass_properties(system: &SystemMatrices, positions: &[Vector3<f64>], modes: &ElasticModes) -> DMatrix<f64> {
    let rigid_motion = |motion: usize| -> Vec<f64> {
        let axis = Vector3::ith(motion % 3, 1.0);
        let displacement = |position: &Vector3<f64>| if motion < 3 { axis } else { axis.cross(position) };
        positions.iter().flat_map(|position| <[f64; 3]>::from(displacement(position))).collect()
    };
    let rigid_motions: Vec<Vec<f64>> = (0..RIGID_MOTIONS).map(rigid_motion).collect();
    let vectors: Vec<&Vec<f64>> = rigid_motions.iter().chain(&modes.vectors).collect();
    let momenta: Vec<Vec<f64>> = vectors.iter().map(|vector| system.apply_mass(vector)).collect();
    let masses = DMatrix::from_fn(vectors.len(), vectors.len(), |row, column| dot(vectors[row], &momenta[column]));
    (&masses + masses.transpose()) * 0.5
}

/// The same properties with the first `count` modes.
pub fn truncated(masses: &DMatrix<f64>, count: usize) -> DMatrix<f64> {
    let size = masses.nrows().min(RIGID_MOTIONS + count);
    masses.view((0, 0), (size, size)).into_owned()
}

/// The same properties in rotated axes.
pub fn rotated(masses: &DMatrix<f64>, rotation: &Matrix3<f64>) -> DMatrix<f64> {
    let mut axes = DMatrix::identity(masses.nrows(), masses.ncols());
    [0, 3].into_iter().for_each(|start| axes.fixed_view_mut::<3, 3>(start, start).copy_from(rotation));
    &axes * masses * axes.transpose()
}
