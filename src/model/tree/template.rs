//! Templates of tree parts. A template has a centerline, radii, a skin, carried bodies and joints. It is converted to
//! a shape with modes. Several parts of a tree can be instances of one template.

use std::collections::BTreeMap;

use modalcast_beam::{Beam, BeamElement, BeamError, ElasticConstants, Profile, RigidInertia, Station};
use nalgebra::{Rotation3, Vector3};

use super::centerline::{Centerline, part_orientation};
use super::skin::{SkinBuilder, Tube, UvMapping, station};
use crate::beam_shape::{inertia_of, lift_modes};
use crate::domain::{Metadata, Modes, Shape};
use crate::error::{Error, Result, fault_in};

/// Largest ratio of the radii of a beam element.
const MAX_RADIUS_RATIO: f64 = 1.15;

/// The kind of a part.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum PartKind {
    Trunk,
    Branch,
    Leaf,
}

/// A joint where a child part is attached.
#[derive(Debug, Clone)]
pub(super) struct ChildJoint {
    /// The ring whose center is the joint.
    pub(super) ring: usize,
    /// Unit direction of the child in this part's frame.
    pub(super) direction: Vector3<f64>,
    /// Index of the child's template.
    pub(super) template_index: usize,
}

/// A template of a part.
#[derive(Debug, Clone)]
pub(super) struct PartTemplate {
    pub(super) kind: PartKind,
    /// Branching level: 0 for the trunk, 1 for boughs, 2 for twigs. `None` for leaf clusters, because boughs and twigs
    /// share their templates.
    pub(super) level: Option<usize>,
    pub(super) centerline: Centerline,
    /// One radius per ring, meters.
    pub(super) radii: Vec<f64>,
    /// Number of vertices per ring.
    pub(super) sides: usize,
    pub(super) skin: SkinBuilder,
    pub(super) elastic: ElasticConstants,
    /// Damping ratio (fraction of critical damping), for clients.
    pub(super) damping: f64,
    /// Rigid bodies of the part itself (leaf blades) and their stations. The inertia is about the section's center.
    pub(super) own_bodies: Vec<(Station, RigidInertia)>,
    /// Rigid inertia of everything at each joint, and the stations of the joints.
    pub(super) carried_bodies: Vec<(Station, RigidInertia)>,
    /// The world's up direction in the part's frame; for parts with several instances, that of a typical one.
    pub(super) up: Vector3<f64>,
    pub(super) children: Vec<ChildJoint>,
    /// Number of modes; 0 for a rigid part.
    pub(super) rank: usize,
    /// Total one-sided area of all blades in m^2.
    pub(super) leaf_area: f64,
}

impl PartTemplate {
    /// Attaches a part at a ring, with everything that it carries.
    ///
    /// # Errors
    /// `Fault` if the part has no valid beam.
    pub(super) fn attach_child(&mut self, child_joint: ChildJoint, child: &Self) -> Result<()> {
        let orientation = part_orientation(&child_joint.direction, &self.up);
        let body = child.total_inertia()?.seen_from(&orientation, &Vector3::zeros());
        self.carried_bodies.push((station(&self.centerline, child_joint.ring), body));
        self.children.push(child_joint);
        Ok(())
    }

    /// The rigid inertia of the part and of everything that it carries, about the origin of its frame.
    ///
    /// # Errors
    /// `Fault` if the part has no valid beam.
    pub(super) fn total_inertia(&self) -> Result<RigidInertia> {
        let beam = self.beam()?;
        let about_origin =
            |(station, body): &(Station, RigidInertia)| body.seen_from(&Rotation3::identity(), &beam.center(*station));
        Ok(beam.rigid_inertia() + beam.carried_bodies().iter().map(about_origin).sum())
    }

    /// The vertices of a ring of the tube. The tube must be the first geometry of the skin.
    pub(super) fn ring_vertices(&self, ring: usize) -> Vec<u32> {
        (ring * self.sides..(ring + 1) * self.sides).map(|vertex| vertex as u32).collect()
    }

    /// Adds a tube around the centerline. For `radius_factor`, see [`SkinBuilder::add_tube`].
    pub(super) fn add_skin(&mut self, uv_mapping: UvMapping, radius_factor: impl Fn(f64, f64) -> f64) {
        let tube = Tube { centerline: &self.centerline, radii: &self.radii, sides: self.sides, uv_mapping };
        self.skin.add_tube(&tube, radius_factor);
    }

    /// Converts to a shape with modes and metadata for clients.
    ///
    /// # Errors
    /// `Fault` if the beam's eigenproblem fails.
    pub(super) fn build_shape(&self) -> Result<(Shape, Metadata)> {
        let beam = self.beam()?;
        let beam_modes = beam.solve_modes(self.rank).map_err(beam_fault)?;
        let inertia = Some(inertia_of(&beam.rigid_inertia(), &beam.modal_inertia(&beam_modes))?);
        let mut modes = Modes::rigid();
        if self.rank > 0 {
            let parts = self.elements_per_ring();
            let stations: Vec<Station> = self.skin.stations.iter().map(|station| station.subdivide(parts)).collect();
            modes = lift_modes(&beam, &beam_modes, &self.skin.rest_positions, &stations)?;
        }
        let metadata = Metadata { notes: self.notes(&beam), eigenvalues: beam_modes.eigenvalues, inertia };
        Ok((Shape::new(self.skin.build_mesh()?, modes)?, metadata))
    }

    /// The beam along the centerline, with [`Self::elements_per_ring`] elements between two rings.
    ///
    /// # Errors
    /// `Fault` if the part has no length or no section.
    pub(super) fn beam(&self) -> Result<Beam> {
        let parts = self.elements_per_ring();
        let points = self.centerline.points.windows(2);
        let fractions = || (0..parts).map(|part| part as f64 / parts as f64);
        let mut nodes: Vec<_> =
            points.flat_map(|ends| fractions().map(move |fraction| ends[0].lerp(&ends[1], fraction))).collect();
        nodes.extend(self.centerline.points.last());
        let radius = |ends: &[f64], fraction: f64| ends[0] * (1.0 - fraction) + ends[1] * fraction;
        let element = |ends: &[f64], fraction: f64| BeamElement {
            profile: Profile::Cone { radii: [radius(ends, fraction), radius(ends, fraction + 1.0 / parts as f64)] },
            material: self.elastic,
        };
        let elements = self.radii.windows(2).flat_map(|ends| fractions().map(move |fraction| element(ends, fraction)));
        let mut beam = Beam::new(nodes, elements.collect()).map_err(beam_fault)?;
        for (station, body) in &self.own_bodies {
            beam.add_own_body(station.subdivide(parts), *body);
        }
        for (station, body) in &self.carried_bodies {
            beam.carry(station.subdivide(parts), *body);
        }
        Ok(beam)
    }

    /// Number of beam elements between two rings, so that the radii of an element differ by at most
    /// [`MAX_RADIUS_RATIO`]. An element bends as a cubic. A strongly tapered section, such as a branch collar, does
    /// not, so twigs with one element between two rings are up to 0.6 % too stiff.
    pub(super) fn elements_per_ring(&self) -> usize {
        let ratio = |ends: &[f64]| (ends[1] / ends[0]).max(ends[0] / ends[1]);
        let largest_ratio = self.radii.windows(2).map(ratio).fold(1.0, f64::max);
        ((largest_ratio.ln() / MAX_RADIUS_RATIO.ln()).ceil() as usize).clamp(1, 8)
    }

    fn carried_mass(&self) -> f64 {
        self.carried_bodies.iter().map(|(_, body)| body.mass()).sum()
    }

    /// Notes for clients, by name. Numbers are in SI units.
    fn notes(&self, beam: &Beam) -> BTreeMap<String, String> {
        let kind = match self.kind {
            PartKind::Trunk => "trunk",
            PartKind::Branch => "branch",
            PartKind::Leaf => "leaf",
        };
        let mut notes = BTreeMap::from([
            ("kind".into(), kind.into()),
            ("length".into(), format!("{:.4}", self.centerline.length())),
            ("mass".into(), format!("{:.5}", beam.rigid_inertia().mass())),
            ("carried_mass".into(), format!("{:.5}", self.carried_mass())),
            ("damping_ratio".into(), self.damping.to_string()),
            ("youngs_modulus".into(), self.elastic.youngs_modulus.to_string()),
            ("density".into(), self.elastic.density.to_string()),
        ]);
        if let Some(level) = self.level {
            notes.insert("level".into(), level.to_string());
        }
        if self.rank > 0 {
            // U^T M U = I with the own mass and the carried rigid bodies in M. U is in 1/sqrt(kg).
            notes.insert("mass_normalized".into(), "true".into());
            notes.insert("q_unit".into(), "m sqrt(kg)".into());
        }
        if self.kind == PartKind::Leaf {
            notes.insert("leaf_area".into(), format!("{:.5}", self.leaf_area));
        }
        notes
    }
}

fn beam_fault(error: BeamError) -> Error {
    fault_in("tree.beam")(error)
}

#[cfg(test)]
mod tests {
    use nalgebra::DMatrix;

    use super::super::random::SplitMix64;
    use super::super::species::grow_templates;
    use super::*;

    fn templates() -> Vec<PartTemplate> {
        grow_templates(&mut SplitMix64::new(7)).expect("valid templates")
    }

    /// The kinetic energies of the own and of the carried parts add up to the identity, for which the modes are
    /// normalized.
    #[test]
    fn modes_of_every_template_are_orthonormal_with_their_load() {
        for template in templates().iter().filter(|template| template.rank > 0) {
            let beam = template.beam().expect("a valid beam");
            let modes = beam.solve_modes(template.rank).expect("a converged solution");
            let own_mass = beam.modal_inertia(&modes).masses;
            let carried = |(station, body): &(Station, RigidInertia)| {
                let motions = beam.section_motions(&modes, *station);
                motions.tr_mul(&(body.matrix() * &motions))
            };
            let total = beam.carried_bodies().iter().fold(own_mass.clone(), |sum, joint| sum + carried(joint));
            let identity = DMatrix::identity(template.rank, template.rank);
            assert!((total - &identity).amax() <= 1e-6, "level {:?}", template.level);
            // Counterexample: a part that carries others has less own mass.
            assert_eq!((own_mass - identity).amax() > 0.01, !template.children.is_empty());
        }
    }

    #[test]
    fn mean_of_a_ring_moves_with_its_section() {
        for template in templates().iter().filter(|template| template.rank > 0) {
            let (shape, _) = template.build_shape().expect("a valid shape");
            let beam = template.beam().expect("a valid beam");
            let beam_modes = beam.solve_modes(template.rank).expect("a converged solution");
            let ring_mean = |ring: usize, mode: usize| {
                let vertices = template.ring_vertices(ring);
                let count = vertices.len() as f64;
                let vertex_vector =
                    |vertex: u32| Vector3::from_fn(|axis, _| f64::from(shape.modes.entry(vertex as usize, axis, mode)));
                vertices.into_iter().map(vertex_vector).sum::<Vector3<f64>>() / count
            };
            for mode in 0..template.rank {
                let base_vertices = template.ring_vertices(0);
                let is_zero =
                    |vertex: &u32| (0..3).all(|axis| shape.modes.entry(*vertex as usize, axis, mode).to_bits() == 0);
                assert!(base_vertices.iter().all(is_zero), "expected a clamped base");
                let dofs = beam_modes.mode_shapes.column(mode).into_owned();
                let max_entry = beam_modes.mode_shapes.column(mode).amax();
                for ring in 1..template.centerline.points.len() {
                    let station = station(&template.centerline, ring).subdivide(template.elements_per_ring());
                    let motion = beam.section_motion(&dofs, station);
                    let expected = motion.displacement_of(&template.centerline.points[ring]);
                    assert!((ring_mean(ring, mode) - expected).norm() <= 1e-6 * max_entry, "ring {ring}");
                }
                // Counterexample: neighboring rings move differently.
                let last_ring = template.centerline.points.len() - 1;
                assert!((ring_mean(last_ring, mode) - ring_mean(last_ring - 1, mode)).norm() > 1e-4 * max_entry);
            }
        }
    }

    #[test]
    fn bark_normals_point_outwards() {
        for template in templates().iter().filter(|template| template.kind != PartKind::Leaf) {
            let mesh = template.skin.build_mesh().expect("a valid mesh");
            let last_ring = template.centerline.points.len() - 1;
            for (vertex, normal) in mesh.corners().vertices.iter().zip(&mesh.corners().normals) {
                let position = Vector3::from(mesh.rest_positions()[*vertex as usize]).cast::<f64>();
                // The vertex after the last ring is the tip.
                let center = template.centerline.points[(*vertex as usize / template.sides).min(last_ring)];
                let outward_component = (position - center).normalize().dot(&Vector3::from(*normal).cast());
                assert!(outward_component > 0.2, "level {:?}: {outward_component}", template.level);
                assert!((Vector3::from(*normal).norm() - 1.0).abs() < 1e-5);
            }
            assert!(mesh.corners().uvs.as_flattened().iter().all(|number| number.is_finite()));
        }
    }

    #[test]
    fn carried_mass_is_the_sum_of_the_child_masses() {
        let templates = templates();
        let mass = |template: &PartTemplate| template.total_inertia().expect("a valid beam").mass();
        for template in templates.iter().filter(|template| template.kind != PartKind::Leaf) {
            let child_mass: f64 =
                template.children.iter().map(|child_joint| mass(&templates[child_joint.template_index])).sum();
            let own_mass = template.beam().expect("a valid beam").rigid_inertia().mass();
            assert!((mass(template) - own_mass - child_mass).abs() <= 1e-9 * mass(template));
        }
        let tree_mass = mass(templates.last().expect("a trunk"));
        assert!((80.0..400.0).contains(&tree_mass), "expected 80 to 400 kg, got {tree_mass}");
    }
}
