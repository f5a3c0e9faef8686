//! Similar beams: the modes of a beam that is rotated and scaled follow from those of the other one.

use nalgebra::{Matrix3, Rotation3, Vector3};

use crate::beam::{Beam, BeamElement, BeamModes};
use crate::profile::Profile;

/// A rotation and a uniform scale about the first node of a beam.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Similarity {
    pub rotation: Rotation3<f64>,
    pub scale: f64,
}

impl Beam {
    /// The similarity that maps this beam to `other`, or `None` if the beams differ: in their number of elements,
    /// materials or bodies, by more than `tolerance` times the size of `other` in the position of a node, or by more
    /// than the fraction `tolerance` in a radius, width or thickness. Bodies make all beams different.
    pub fn similarity_to(&self, other: &Self, tolerance: f64) -> Option<Similarity> {
        let has_bodies = |beam: &Self| beam.has_bodies();
        let is_comparable = |(a, b): (&BeamElement, &BeamElement)| a.material == b.material;
        if self.elements().len() != other.elements().len()
            || has_bodies(self)
            || has_bodies(other)
            || !self.elements().iter().zip(other.elements()).all(is_comparable)
        {
            return None;
        }
        let (points, other_points) = (self.shape_points(), other.shape_points());
        let squared_size = |points: &[Vector3<f64>]| points.iter().map(Vector3::norm_squared).sum::<f64>();
        let scale = (squared_size(&other_points) / squared_size(&points)).sqrt();
        let size = other_points.iter().map(Vector3::norm).fold(0.0, f64::max);
        let pairs = || points.iter().zip(&other_points);
        // Most beams that differ are found without the rotation, which takes longer.
        let has_similar_norms =
            pairs().all(|(point, other)| (scale * point.norm() - other.norm()).abs() <= tolerance * size);
        let has_similar_sections = |(a, b): (&BeamElement, &BeamElement)| {
            let pairs = dimensions(&a.profile).into_iter().zip(dimensions(&b.profile));
            std::mem::discriminant(&a.profile) == std::mem::discriminant(&b.profile)
                && pairs.into_iter().all(|(a, b)| (scale * a - b).abs() <= tolerance * b)
        };
        let may_be_similar = scale.is_finite()
            && has_similar_norms
            && self.elements().iter().zip(other.elements()).all(has_similar_sections);
        if !may_be_similar {
            return None;
        }
        let covariance: Matrix3<f64> = pairs().map(|(point, other)| other * point.transpose()).sum();
        let rotation = nearest_rotation(&covariance)?;
        let is_similar = pairs().all(|(point, other)| (rotation * point * scale - other).norm() <= tolerance * size);
        is_similar.then_some(Similarity { rotation, scale })
    }

    /// This beam, rotated and scaled, with its first node at `first_node`. Bodies are not copied.
    #[must_use]
    pub fn transformed(&self, similarity: &Similarity, first_node: &Vector3<f64>) -> Self {
        let Similarity { rotation, scale } = *similarity;
        let start = self.nodes()[0];
        let nodes = self.nodes().iter().map(|node| first_node + rotation * (node - start) * scale).collect();
        let transform = |element: &BeamElement| {
            let profile = match element.profile {
                Profile::Cone { radii } => Profile::Cone { radii: radii.map(|radius| radius * scale) },
                Profile::Strip { widths, thickness, normal } => Profile::Strip {
                    widths: widths.map(|width| width * scale),
                    thickness: thickness * scale,
                    normal: rotation * normal,
                },
            };
            BeamElement { profile, ..*element }
        };
        Self::from_valid_parts(nodes, self.elements().iter().map(transform).collect())
    }

    /// Points that fix the shape and the orientation: the nodes relative to the first one, and points beside the strips
    /// on both sides, in the order of the elements.
    fn shape_points(&self) -> Vec<Vector3<f64>> {
        let start = self.nodes()[0];
        let mut points: Vec<_> = self.nodes().iter().map(|node| node - start).collect();
        for (element, ends) in self.elements().iter().zip(self.nodes().windows(2)) {
            if let Profile::Strip { widths, .. } = element.profile {
                let axes = element.profile.axes(&(ends[1] - ends[0]).normalize());
                points.push(
                    0.5 * (ends[0] + ends[1]) - start + axes.row(2).transpose() * (0.5 * (widths[0] + widths[1])),
                );
            }
        }
        points
    }
}

impl BeamModes {
    /// The modes of a similar beam, normalized with its mass: eigenvalues go as 1 / s^2, displacements as s^-1.5, and
    /// rotations as s^-2.5.
    #[must_use]
    pub fn transformed(&self, similarity: &Similarity) -> Self {
        let Similarity { rotation, scale } = *similarity;
        let mut mode_shapes = self.mode_shapes.clone();
        for (row, factor) in
            (0..mode_shapes.nrows()).step_by(3).zip([scale.powf(-1.5), scale.powf(-2.5)].iter().cycle())
        {
            let rotated = rotation.matrix() * mode_shapes.fixed_rows::<3>(row) * *factor;
            mode_shapes.fixed_rows_mut::<3>(row).copy_from(&rotated);
        }
        let eigenvalues = self.eigenvalues.iter().map(|eigenvalue| eigenvalue / (scale * scale)).collect();
        Self { eigenvalues, mode_shapes }
    }
}

/// The rotation R that maximizes the trace of R^T A (Kabsch, "A solution for the best rotation to relate two sets of
/// vectors", Acta Crystallographica A 32, 1976).
fn nearest_rotation(covariance: &Matrix3<f64>) -> Option<Rotation3<f64>> {
    if !covariance.iter().all(|entry| entry.is_finite()) {
        return None;
    }
    let svd = covariance.try_svd(true, true, f64::EPSILON, 1000)?;
    let (u, v_t) = (svd.u?, svd.v_t?);
    let mut signs = Matrix3::identity();
    signs[(svd.singular_values.imin(), svd.singular_values.imin())] = (u * v_t).determinant().signum();
    Some(Rotation3::from_matrix_unchecked(u * signs * v_t))
}

/// The lengths of a profile, meters.
fn dimensions(profile: &Profile) -> [f64; 3] {
    match *profile {
        Profile::Cone { radii: [a, b] } => [a, b, a],
        Profile::Strip { widths: [a, b], thickness, .. } => [a, b, thickness],
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::inertia::RigidInertia;
    use crate::station::Station;
    use crate::testing::{WOOD, curved_beam, eigen_residuals};

    /// A change of the nodes and elements of a beam.
    type Change = dyn Fn(&mut [Vector3<f64>], &mut [BeamElement]);

    /// A stem with a blade in its plane.
    fn leaf(normal: Vector3<f64>) -> Beam {
        let points: Vec<_> = (0..=8).map(|index| Vector3::new(0.01 * f64::from(index), 0.0, 0.0)).collect();
        let profile = |index: usize| match index < 3 {
            true => Profile::Cone { radii: [1e-3; 2] },
            false => Profile::Strip { widths: [0.03; 2], thickness: 3e-4, normal },
        };
        let elements = (0..8).map(|index| BeamElement { profile: profile(index), material: WOOD }).collect();
        Beam::new(points, elements).expect("a valid beam")
    }

    #[test]
    fn transformed_modes_solve_the_eigenproblem_of_the_transformed_beam() {
        let similarity = Similarity { rotation: Rotation3::from_euler_angles(0.4, -1.0, 2.0), scale: 0.3 };
        let first_node = Vector3::new(3.0, -1.0, 0.5);
        for beam in [curved_beam(9, [0.02, 0.01], 0.9, WOOD), leaf(Vector3::z())] {
            let copy = beam.transformed(&similarity, &first_node);
            assert_eq!(copy.nodes()[0], first_node);
            let modes = beam.solve_modes(6).expect("a converged solution").transformed(&similarity);
            let (residual, gram_error) = eigen_residuals(&copy, &modes);
            assert!(residual < 1e-5 && gram_error < 1e-9, "{residual} {gram_error}");
            // Counterexample: another exponent.
            let wrong = BeamModes { mode_shapes: modes.mode_shapes.scale(0.3), ..modes };
            assert!(eigen_residuals(&copy, &wrong).1 > 0.5);
            let found = beam.similarity_to(&copy, 1e-6).expect("a similar beam");
            assert!((found.scale - 0.3).abs() < 1e-12);
            assert!((found.rotation.matrix() - similarity.rotation.matrix()).norm() < 1e-6);
        }
    }

    #[test]
    fn other_beams_are_not_similar() {
        let beam = leaf(Vector3::z());
        let similarity = Similarity { rotation: Rotation3::from_euler_angles(0.4, -1.0, 2.0), scale: 0.3 };
        let copy = beam.transformed(&similarity, &Vector3::zeros());
        assert!(beam.similarity_to(&copy, 1e-9).is_some());
        // The blade is turned about the stem; a side branch; another radius; another material; a body.
        let turned = beam.transformed(&similarity, &Vector3::zeros());
        let with = |change: &Change| {
            let (mut nodes, mut elements) = (turned.nodes().to_vec(), turned.elements().to_vec());
            change(&mut nodes, &mut elements);
            Beam::from_valid_parts(nodes, elements)
        };
        let thicker = with(&|_, elements| elements[0].profile = Profile::Cone { radii: [3.3e-4; 2] });
        let denser = with(&|_, elements| elements[5].material.density *= 1.1);
        let bent = with(&|nodes, _| nodes[8].z += 0.01);
        let mut loaded = copy.clone();
        loaded.carry(Station { element: 7, fraction: 1.0 }, RigidInertia::point_mass(1.0));
        let half_turned = with(&|_, elements| {
            if let Profile::Strip { normal, .. } = &mut elements[4].profile {
                *normal = Vector3::new(normal.y, -normal.x, normal.z);
            }
        });
        for (name, other) in
            [("thicker", thicker), ("denser", denser), ("bent", bent), ("loaded", loaded), ("turned", half_turned)]
        {
            assert!(beam.similarity_to(&other, 1e-3).is_none(), "{name}");
        }
        assert!(beam.similarity_to(&curved_beam(9, [0.02; 2], 0.1, WOOD), 1e-3).is_none());
    }
}
