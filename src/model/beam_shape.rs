//! Shapes that follow beams: a vertex at the offset d from the center of its section moves by u = w(s) + theta(s) x d,
//! where w and theta are the displacement and rotation of the section.

use modalcast_beam::{Beam, BeamModes, ModalInertia, RigidInertia, Station};
use nalgebra::Vector3;

use crate::domain::{Inertia, Modes};
use crate::error::Result;

/// U of a mesh whose vertex i is fixed to the section at `stations[i]`. `rest_positions` are relative to the origin of
/// the nodes of the beam.
///
/// # Errors
/// `Invalid` if a mode overflows f32.
pub(crate) fn lift_modes(
    beam: &Beam,
    modes: &BeamModes,
    rest_positions: &[[f32; 3]],
    stations: &[Station],
) -> Result<Modes> {
    let rank = modes.mode_shapes.ncols();
    let rows = 3 * rest_positions.len();
    let mut columns = vec![0.0_f32; rows * rank];
    for (vertex, (position, station)) in rest_positions.iter().zip(stations).enumerate() {
        let motions = beam.section_motions(modes, *station);
        let arm = Vector3::from(*position).cast::<f64>() - beam.center(*station);
        for (mode, motion) in motions.column_iter().enumerate() {
            let [translation, rotation] = [0, 3].map(|row| motion.fixed_rows::<3>(row).into_owned());
            let displacement = translation + rotation.cross(&arm);
            // Adding zero converts -0 to 0, so that all bits of the clamped rows are zero.
            let entries = displacement.map(|entry| (entry + 0.0) as f32);
            columns[mode * rows + 3 * vertex..][..3].copy_from_slice(entries.as_slice());
        }
    }
    Modes::from_columns(rows, rank, columns)
}

/// The mass properties of a beam whose nodes are in the frame of the domain: those of the beam as a rigid body, and of its
/// modes.
///
/// # Errors
/// `Invalid` if a number is not finite.
pub(crate) fn inertia_of(body: &RigidInertia, ModalInertia { momenta, masses }: &ModalInertia) -> Result<Inertia> {
    let tensor = body.tensor();
    let moments = [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)].map(|index| tensor[index]);
    // The transposes in column-major order are the matrices in row-major order.
    let momenta = momenta.transpose().iter().copied().collect();
    let masses = masses.transpose().iter().copied().collect();
    Inertia::new(body.mass(), body.center().into(), moments, momenta, masses)
}

#[cfg(test)]
mod tests {
    use modalcast_beam::{ElasticConstants, RigidInertia};
    use nalgebra::DMatrix;

    use super::*;

    const WOOD: ElasticConstants = ElasticConstants { youngs_modulus: 8e9, shear_modulus: 5e8, density: 800.0 };

    fn curved_beam() -> Beam {
        let points: Vec<_> =
            (0..=6).map(|index| 0.1 * f64::from(index)).map(|s| Vector3::new(s, 0.4 * s * s, -0.2 * s)).collect();
        Beam::along(&points, &[0.02; 7], WOOD, 6).expect("a valid beam")
    }

    #[test]
    fn vertices_move_with_their_sections() {
        let beam = curved_beam();
        let modes = beam.solve_modes(4).expect("a converged solution");
        let offset = Vector3::new(0.02, -0.01, 0.03);
        let stations = [Station { element: 0, fraction: 0.0 }, Station { element: 4, fraction: 0.0 }];
        let rest_positions: Vec<[f32; 3]> =
            stations.iter().map(|station| (beam.center(*station) + offset).cast::<f32>().into()).collect();
        let lifted = lift_modes(&beam, &modes, &rest_positions, &stations).expect("valid modes");
        for mode in 0..4 {
            let nodal_vector =
                |first_dof: usize| modes.mode_shapes.fixed_view::<3, 1>(6 * 4 + first_dof, mode).into_owned();
            let arm = Vector3::from(rest_positions[1]).cast::<f64>() - beam.nodes()[4];
            let expected: Vector3<f64> = nodal_vector(0) + nodal_vector(3).cross(&arm);
            for axis in 0..3 {
                assert_eq!(lifted.entry(0, axis, mode).to_bits(), 0, "expected a clamped base");
                let error = (f64::from(lifted.entry(1, axis, mode)) - expected[axis]).abs();
                assert!(error <= 1e-6 * expected.norm(), "mode {mode}: an error of {error}");
            }
            // Counterexample: without the rotational part, the displacement would differ.
            assert!(nodal_vector(3).cross(&arm).norm() > 1e-4 * expected.norm());
        }
    }

    #[test]
    fn inertia_has_the_blocks_of_the_beam() {
        let mut beam = curved_beam();
        beam.carry(Station { element: 5, fraction: 1.0 }, RigidInertia::point_mass(0.5));
        let modes = beam.solve_modes(5).expect("a converged solution");
        let modal_inertia = beam.modal_inertia(&modes);
        let matrix = inertia_of(&beam.rigid_inertia(), &modal_inertia).expect("valid masses").mass_matrix();
        assert!((matrix.view((0, 0), (6, 6)) - beam.rigid_inertia().matrix()).amax() < 1e-12);
        assert!((matrix.view((0, 6), (6, 5)) - modal_inertia.momenta).amax() < 1e-12);
        assert!((matrix.view((6, 6), (5, 5)) - modal_inertia.masses).amax() < 1e-12);
        // The modes are normalized with the carried body, which is not part of the masses.
        assert!((matrix.view((6, 6), (5, 5)) - DMatrix::<f64>::identity(5, 5)).amax() > 0.1);
        let no_modes = beam.solve_modes(0).expect("no modes");
        let rigid = inertia_of(&beam.rigid_inertia(), &beam.modal_inertia(&no_modes)).expect("valid masses");
        assert_eq!((rigid.rank(), rigid.mass_matrix()), (0, matrix.view((0, 0), (6, 6)).into_owned()));
    }
}
