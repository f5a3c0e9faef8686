//! Lifts the modes of a beam to its skin: u = w(s) + theta(s) x d at each vertex, as 3n x r entries in f32.

use nalgebra::{DMatrix, Vector3};

use super::element::element_axes;
use crate::domain::Modes;
use crate::error::Result;

/// A position along a beam: the element, and the fraction of its length, 0 to 1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Station {
    pub(super) element: usize,
    pub(super) fraction: f64,
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

/// Motion of a section under the nodal displacements `dofs` (six per node), with the element's shape functions: cubic
/// Hermite for bending, linear for stretch and twist. The section rotates with the slope of its centerline.
pub(super) fn section_motion(nodes: &[Vector3<f64>], dofs: &[f64], station: Station) -> SectionMotion {
    let Station { element, fraction: x } = station;
    let (from, to) = (nodes[element], nodes[element + 1]);
    let (local, length) = (element_axes(&from, &to), (to - from).norm());
    let part = |node: usize, first: usize| local * Vector3::from_column_slice(&dofs[6 * node + first..][..3]);
    let (shift_a, turn_a) = (part(element, 0), part(element, 3));
    let (shift_b, turn_b) = (part(element + 1, 0), part(element + 1, 3));
    let value =
        [1.0 - 3.0 * x * x + 2.0 * x.powi(3), x * (1.0 - x).powi(2), x * x * (3.0 - 2.0 * x), x * x * (x - 1.0)];
    let slope = [6.0 * x * (x - 1.0), (1.0 - x) * (1.0 - 3.0 * x), 6.0 * x * (1.0 - x), x * (3.0 * x - 2.0)];
    let bend = |basis: &[f64; 4], [a, da, b, db]: [f64; 4]| {
        basis[0] * a + basis[1] * length * da + basis[2] * b + basis[3] * length * db
    };
    // Slopes of y are rotations about z; slopes of z are rotations about -y.
    let (y, z) = ([shift_a.y, turn_a.z, shift_b.y, turn_b.z], [shift_a.z, -turn_a.y, shift_b.z, -turn_b.y]);
    let linear = |a: f64, b: f64| a * (1.0 - x) + b * x;
    let translation = Vector3::new(linear(shift_a.x, shift_b.x), bend(&value, y), bend(&value, z));
    let rotation = Vector3::new(linear(turn_a.x, turn_b.x), -bend(&slope, z) / length, bend(&slope, y) / length);
    SectionMotion {
        center: from + (to - from) * x,
        translation: local.transpose() * translation,
        rotation: local.transpose() * rotation,
    }
}

/// U of a skin whose vertex i is fixed to the section at `stations[i]`.
///
/// # Errors
/// `Invalid` if a mode overflows f32.
pub(super) fn lift(
    nodes: &[Vector3<f64>],
    mode_shapes: &DMatrix<f64>,
    rest: &[[f32; 3]],
    stations: &[Station],
) -> Result<Modes> {
    let mut columns = Vec::with_capacity(3 * rest.len() * mode_shapes.ncols());
    for shape in mode_shapes.column_iter() {
        let dofs: Vec<f64> = shape.iter().copied().collect();
        for (position, station) in rest.iter().zip(stations) {
            let moved = section_motion(nodes, &dofs, *station).displacement_of(&Vector3::from(*position).cast());
            // Adding zero converts -0 to 0, so that the rows of the clamp are plain zeros.
            columns.extend(moved.iter().map(|entry| (entry + 0.0) as f32));
        }
    }
    Modes::from_columns(3 * rest.len(), mode_shapes.ncols(), columns)
}

#[cfg(test)]
mod tests {
    use super::super::beam::tests::curved_beam;
    use super::*;

    /// Nodal displacements of a rigid motion: a translation and a small rotation about the origin.
    fn rigid(nodes: &[Vector3<f64>], translation: Vector3<f64>, rotation: Vector3<f64>) -> Vec<f64> {
        let dofs = |node: &Vector3<f64>| {
            let moved = translation + rotation.cross(node);
            [moved.x, moved.y, moved.z, rotation.x, rotation.y, rotation.z]
        };
        nodes.iter().flat_map(dofs).collect()
    }

    #[test]
    fn a_rigid_motion_of_the_nodes_moves_every_point_rigidly() {
        let beam = curved_beam(5, [0.02, 0.01], 1.1);
        let (translation, rotation) = (Vector3::new(0.3, -0.2, 0.5), Vector3::new(-0.4, 0.25, 0.1));
        let dofs = rigid(&beam.nodes, translation, rotation);
        let point = Vector3::new(0.3, 0.7, -0.2);
        for element in 0..5 {
            for fraction in [0.0, 0.137, 0.5, 0.9, 1.0] {
                let section_motion = section_motion(&beam.nodes, &dofs, Station { element, fraction });
                assert!((section_motion.rotation - rotation).norm() < 1e-12, "turn {}", section_motion.rotation);
                assert!(
                    (section_motion.displacement_of(&point) - (translation + rotation.cross(&point))).norm() < 1e-12
                );
            }
        }
    }

    #[test]
    fn sections_move_continuously_over_a_node_and_turn_with_the_slope() {
        let beam = curved_beam(6, [0.02, 0.01], 0.8);
        let modes = beam.modes(5).expect("converges");
        for column in modes.mode_shapes.column_iter() {
            let dofs: Vec<f64> = column.iter().copied().collect();
            let at = |element, fraction| section_motion(&beam.nodes, &dofs, Station { element, fraction });
            for node in 1..6 {
                let (before, after) = (at(node - 1, 1.0), at(node, 0.0));
                let size = before.translation.norm() + before.rotation.norm();
                assert!((before.translation - after.translation).norm() <= 1e-9 * size);
                assert!((before.rotation - after.rotation).norm() <= 1e-9 * size);
            }
            // The rotation is the derivative of the transverse displacement.
            let (a, b, h) = (at(3, 0.4 - 1e-5), at(3, 0.4 + 1e-5), 2e-5 * (beam.nodes[4] - beam.nodes[3]).norm());
            let along = (beam.nodes[4] - beam.nodes[3]).normalize();
            let across = |v: Vector3<f64>| v - along * along.dot(&v);
            let slope = across((b.translation - a.translation) / h);
            let turned = across(at(3, 0.4).rotation.cross(&along));
            assert!((slope - turned).norm() <= 1e-6 * slope.norm().max(1e-3), "{slope} {turned}");
        }
    }

    #[test]
    fn the_skin_at_a_node_moves_with_the_nodes_shift_and_rotation_and_the_clamp_rests() {
        let beam = curved_beam(6, [0.02, 0.01], 0.8);
        let modes = beam.modes(4).expect("converges");
        let node = 4;
        let offset = Vector3::new(0.02, -0.01, 0.03);
        let rest: Vec<[f32; 3]> = [0, node].map(|at| (beam.nodes[at] + offset).cast::<f32>().into()).to_vec();
        let stations = [Station { element: 0, fraction: 0.0 }, Station { element: node, fraction: 0.0 }];
        let skin = lift(&beam.nodes, &modes.mode_shapes, &rest, &stations).expect("finite");
        for mode in 0..4 {
            let part = |first| Vector3::from_fn(|axis, _| modes.mode_shapes[(6 * node + first + axis, mode)]);
            let arm = Vector3::from(rest[1]).cast::<f64>() - beam.nodes[node];
            let want: Vector3<f64> = part(0) + part(3).cross(&arm);
            for axis in 0..3 {
                assert_eq!(skin.entry(0, axis, mode).to_bits(), 0, "the clamp moves");
                let got = f64::from(skin.entry(1, axis, mode));
                assert!((got - want[axis]).abs() <= 1e-6 * want.norm(), "mode {mode}: {got} is not {}", want[axis]);
            }
            // Counterexample: without the rotational part, the skin's displacement would differ.
            assert!(part(3).cross(&arm).norm() > 1e-4 * want.norm());
        }
    }
}
