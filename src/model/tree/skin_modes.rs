//! Lifts the modes of a beam to its skin: u = w(s) + theta(s) x d for a vertex at the offset d from the center of its
//! section, where w and theta are the displacement and rotation of the section.

use nalgebra::{DMatrix, Vector3, Vector4};

use super::element::{BendingBasis, element_axes};
use crate::domain::Modes;
use crate::error::Result;

/// A position along a beam: the element, and the fraction of its length, 0 to 1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Station {
    pub(super) element: usize,
    pub(super) fraction: f64,
}

impl Station {
    /// The same position after every element is divided into `parts` equal elements.
    pub(super) fn subdivide(self, parts: usize) -> Self {
        let scaled_fraction = self.fraction * parts as f64;
        let part = (scaled_fraction as usize).min(parts - 1);
        Self { element: self.element * parts + part, fraction: scaled_fraction - part as f64 }
    }
}

/// Rest position and infinitesimal motion of a section.
#[derive(Debug, Clone, Copy)]
pub(super) struct SectionMotion {
    pub(super) center: Vector3<f64>,
    pub(super) translation: Vector3<f64>,
    pub(super) rotation: Vector3<f64>,
}

impl SectionMotion {
    /// Displacement of a point that is fixed to the section.
    pub(super) fn displacement_of(&self, point: &Vector3<f64>) -> Vector3<f64> {
        self.translation + self.rotation.cross(&(point - self.center))
    }
}

/// Motion of a section under the nodal displacements `dofs` (six per node). The shape functions are cubic Hermite for
/// bending, and linear for stretch and twist. The section rotates with the slope of its centerline.
pub(super) fn section_motion(nodes: &[Vector3<f64>], dofs: &[f64], station: Station) -> SectionMotion {
    let Station { element, fraction: x } = station;
    let (from, to) = (nodes[element], nodes[element + 1]);
    let (local_from_global, length) = (element_axes(&from, &to), (to - from).norm());
    let local_vector = |node: usize, first_dof: usize| {
        local_from_global * Vector3::from_column_slice(&dofs[6 * node + first_dof..][..3])
    };
    let (displacement_a, rotation_a) = (local_vector(element, 0), local_vector(element, 3));
    let (displacement_b, rotation_b) = (local_vector(element + 1, 0), local_vector(element + 1, 3));
    let basis = BendingBasis::new(x, length);
    // The slope of y is a rotation about z, and the slope of z is a rotation about -y.
    let (y_values, z_values) = (
        Vector4::new(displacement_a.y, rotation_a.z, displacement_b.y, rotation_b.z),
        Vector4::new(displacement_a.z, -rotation_a.y, displacement_b.z, -rotation_b.y),
    );
    let interpolate_linearly = |a: f64, b: f64| a * (1.0 - x) + b * x;
    let translation = Vector3::new(
        interpolate_linearly(displacement_a.x, displacement_b.x),
        basis.values.dot(&y_values),
        basis.values.dot(&z_values),
    );
    let rotation = Vector3::new(
        interpolate_linearly(rotation_a.x, rotation_b.x),
        -basis.slopes.dot(&z_values),
        basis.slopes.dot(&y_values),
    );
    SectionMotion {
        center: from + (to - from) * x,
        translation: local_from_global.transpose() * translation,
        rotation: local_from_global.transpose() * rotation,
    }
}

/// U of a skin whose vertex i is fixed to the section at `stations[i]`.
///
/// # Errors
/// `Invalid` if a mode overflows f32.
pub(super) fn lift_to_skin(
    nodes: &[Vector3<f64>],
    mode_shapes: &DMatrix<f64>,
    rest_positions: &[[f32; 3]],
    stations: &[Station],
) -> Result<Modes> {
    let mut columns = Vec::with_capacity(3 * rest_positions.len() * mode_shapes.ncols());
    for shape in mode_shapes.column_iter() {
        let dofs: Vec<f64> = shape.iter().copied().collect();
        for (position, station) in rest_positions.iter().zip(stations) {
            let displacement = section_motion(nodes, &dofs, *station).displacement_of(&Vector3::from(*position).cast());
            // Adding zero converts -0 to 0, so that all bits of the clamped rows are zero.
            columns.extend(displacement.iter().map(|entry| (entry + 0.0) as f32));
        }
    }
    Modes::from_columns(3 * rest_positions.len(), mode_shapes.ncols(), columns)
}

#[cfg(test)]
mod tests {
    use super::super::beam::tests::curved_beam;
    use super::*;

    /// Nodal displacements of a rigid motion: a translation and a small rotation about the origin.
    fn rigid_dofs(nodes: &[Vector3<f64>], translation: Vector3<f64>, rotation: Vector3<f64>) -> Vec<f64> {
        let dofs = |node: &Vector3<f64>| {
            let displacement = translation + rotation.cross(node);
            [displacement.x, displacement.y, displacement.z, rotation.x, rotation.y, rotation.z]
        };
        nodes.iter().flat_map(dofs).collect()
    }

    #[test]
    fn rigid_nodal_motion_moves_every_point_rigidly() {
        let beam = curved_beam(5, [0.02, 0.01], 1.1);
        let (translation, rotation) = (Vector3::new(0.3, -0.2, 0.5), Vector3::new(-0.4, 0.25, 0.1));
        let dofs = rigid_dofs(&beam.nodes, translation, rotation);
        let point = Vector3::new(0.3, 0.7, -0.2);
        for element in 0..5 {
            for fraction in [0.0, 0.137, 0.5, 0.9, 1.0] {
                let section_motion = section_motion(&beam.nodes, &dofs, Station { element, fraction });
                assert!(
                    (section_motion.rotation - rotation).norm() < 1e-12,
                    "got rotation {}",
                    section_motion.rotation
                );
                assert!(
                    (section_motion.displacement_of(&point) - (translation + rotation.cross(&point))).norm() < 1e-12
                );
            }
        }
    }

    #[test]
    fn section_motion_is_continuous_and_follows_the_slope() {
        let beam = curved_beam(6, [0.02, 0.01], 0.8);
        let modes = beam.solve_modes(5).expect("a converged solution");
        for column in modes.mode_shapes.column_iter() {
            let dofs: Vec<f64> = column.iter().copied().collect();
            let motion_at = |element, fraction| section_motion(&beam.nodes, &dofs, Station { element, fraction });
            for node in 1..6 {
                let (before, after) = (motion_at(node - 1, 1.0), motion_at(node, 0.0));
                let magnitude = before.translation.norm() + before.rotation.norm();
                assert!((before.translation - after.translation).norm() <= 1e-9 * magnitude);
                assert!((before.rotation - after.rotation).norm() <= 1e-9 * magnitude);
            }
            // The rotation is the derivative of the transverse displacement.
            let (before, after) = (motion_at(3, 0.4 - 1e-5), motion_at(3, 0.4 + 1e-5));
            let distance = 2e-5 * (beam.nodes[4] - beam.nodes[3]).norm();
            let tangent = (beam.nodes[4] - beam.nodes[3]).normalize();
            let transverse = |vector: Vector3<f64>| vector - tangent * tangent.dot(&vector);
            let slope = transverse((after.translation - before.translation) / distance);
            let rotated_tangent = transverse(motion_at(3, 0.4).rotation.cross(&tangent));
            assert!((slope - rotated_tangent).norm() <= 1e-6 * slope.norm().max(1e-3), "{slope} {rotated_tangent}");
        }
    }

    #[test]
    fn skin_at_a_node_moves_with_the_node() {
        let beam = curved_beam(6, [0.02, 0.01], 0.8);
        let modes = beam.solve_modes(4).expect("a converged solution");
        let node = 4;
        let offset = Vector3::new(0.02, -0.01, 0.03);
        let rest_positions: Vec<[f32; 3]> =
            [0, node].map(|node_index| (beam.nodes[node_index] + offset).cast::<f32>().into()).to_vec();
        let stations = [Station { element: 0, fraction: 0.0 }, Station { element: node, fraction: 0.0 }];
        let skin = lift_to_skin(&beam.nodes, &modes.mode_shapes, &rest_positions, &stations).expect("valid modes");
        for mode in 0..4 {
            let nodal_vector =
                |first_dof| Vector3::from_fn(|axis, _| modes.mode_shapes[(6 * node + first_dof + axis, mode)]);
            let arm = Vector3::from(rest_positions[1]).cast::<f64>() - beam.nodes[node];
            let expected: Vector3<f64> = nodal_vector(0) + nodal_vector(3).cross(&arm);
            for axis in 0..3 {
                assert_eq!(skin.entry(0, axis, mode).to_bits(), 0, "expected a clamped base");
                let actual = f64::from(skin.entry(1, axis, mode));
                assert!(
                    (actual - expected[axis]).abs() <= 1e-6 * expected.norm(),
                    "mode {mode}: expected {}, got {actual}",
                    expected[axis]
                );
            }
            // Counterexample: without the rotational part, the skin's displacement would differ.
            assert!(nodal_vector(3).cross(&arm).norm() > 1e-4 * expected.norm());
        }
    }
}
