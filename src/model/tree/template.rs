//! Templates of tree parts. A template has a centerline, radii, a skin, carried masses and joints. It is converted to
//! a shape with modes. Several parts of a tree can be instances of one template.

use std::collections::BTreeMap;

use nalgebra::Vector3;

use super::beam::Beam;
use super::centerline::Centerline;
use super::element::{ElasticConstants, Taper};
use super::skin::{SkinBuilder, Tube, UvMapping, station};
use super::skin_modes::{Station, lift_to_skin};
use crate::domain::{Metadata, Modes, Shape};
use crate::error::Result;

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
    /// Carried masses in kg and their stations.
    pub(super) point_masses: Vec<(Station, f64)>,
    pub(super) children: Vec<ChildJoint>,
    /// Number of modes; 0 for a rigid part.
    pub(super) rank: usize,
    /// Total one-sided area of all blades in m^2.
    pub(super) leaf_area: f64,
}

impl PartTemplate {
    /// Attaches a part of `mass` kg at a ring.
    pub(super) fn attach_child(&mut self, child_joint: ChildJoint, mass: f64) {
        self.point_masses.push((station(&self.centerline, child_joint.ring), mass));
        self.children.push(child_joint);
    }

    /// Own and carried mass in kg.
    pub(super) fn mass(&self) -> f64 {
        self.beam().wood_mass() + self.carried_mass()
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
        let beam = self.beam();
        let mut metadata = Metadata { notes: self.notes(&beam), eigenvalues: vec![] };
        let mut modes = Modes::rigid();
        if self.rank > 0 {
            let beam_modes = beam.solve_modes(self.rank)?;
            let parts = self.elements_per_ring();
            let stations: Vec<Station> = self.skin.stations.iter().map(|station| station.subdivide(parts)).collect();
            modes = lift_to_skin(&beam.nodes, &beam_modes.mode_shapes, &self.skin.rest_positions, &stations)?;
            metadata.eigenvalues = beam_modes.eigenvalues;
        }
        Ok((Shape::new(self.skin.build_mesh()?, modes)?, metadata))
    }

    /// The beam along the centerline, with [`Self::elements_per_ring`] elements between two rings.
    pub(super) fn beam(&self) -> Beam {
        let parts = self.elements_per_ring();
        let points = self.centerline.points.windows(2);
        let fractions = || (0..parts).map(|part| part as f64 / parts as f64);
        let mut nodes: Vec<_> =
            points.flat_map(|ends| fractions().map(move |fraction| ends[0].lerp(&ends[1], fraction))).collect();
        nodes.extend(self.centerline.points.last());
        let radius = |ends: &[f64], fraction: f64| ends[0] * (1.0 - fraction) + ends[1] * fraction;
        let taper = |ends: &[f64], fraction: f64| Taper {
            radii: [radius(ends, fraction), radius(ends, fraction + 1.0 / parts as f64)],
        };
        let tapers = self.radii.windows(2).flat_map(|ends| fractions().map(move |fraction| taper(ends, fraction)));
        let subdivide = |(station, mass): &(Station, f64)| (station.subdivide(parts), *mass);
        Beam {
            nodes,
            tapers: tapers.collect(),
            elastic: self.elastic,
            point_masses: self.point_masses.iter().map(subdivide).collect(),
        }
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
        self.point_masses.iter().map(|(_, mass)| mass).sum()
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
            ("mass".into(), format!("{:.5}", beam.wood_mass())),
            ("carried_mass".into(), format!("{:.5}", self.carried_mass())),
            ("damping_ratio".into(), self.damping.to_string()),
            ("youngs_modulus".into(), self.elastic.youngs_modulus.to_string()),
            ("density".into(), self.elastic.density.to_string()),
        ]);
        if let Some(level) = self.level {
            notes.insert("level".into(), level.to_string());
        }
        if self.rank > 0 {
            // U^T M U = I with the own and the carried mass M. U is in 1/sqrt(kg).
            notes.insert("mass_normalized".into(), "true".into());
            notes.insert("q_unit".into(), "m sqrt(kg)".into());
        }
        if self.kind == PartKind::Leaf {
            notes.insert("leaf_area".into(), format!("{:.5}", self.leaf_area));
        }
        notes
    }
}

#[cfg(test)]
mod tests {
    use super::super::beam::tests::eigen_residuals;
    use super::super::random::SplitMix64;
    use super::super::skin_modes::section_motion;
    use super::super::species::grow_templates;
    use super::*;

    #[test]
    fn modes_of_every_template_solve_its_eigenproblem() {
        for template in grow_templates(&mut SplitMix64::new(7)).iter().filter(|template| template.rank > 0) {
            let beam = template.beam();
            let modes = beam.solve_modes(template.rank).expect("a converged solution");
            let (residual, gram_error) = eigen_residuals(&beam, &modes);
            assert!(residual <= 1e-6, "level {:?}: residual {residual}", template.level);
            assert!(gram_error <= 1e-6, "level {:?}: Gram error {gram_error}", template.level);
        }
    }

    #[test]
    fn mean_of_a_ring_moves_with_its_section() {
        for template in grow_templates(&mut SplitMix64::new(7)).iter().filter(|template| template.rank > 0) {
            let (shape, _) = template.build_shape().expect("a valid shape");
            let beam = template.beam();
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
                let dofs: Vec<f64> = beam_modes.mode_shapes.column(mode).iter().copied().collect();
                let max_entry = beam_modes.mode_shapes.column(mode).amax();
                for ring in 1..template.centerline.points.len() {
                    let station = station(&template.centerline, ring).subdivide(template.elements_per_ring());
                    let motion = section_motion(&beam.nodes, &dofs, station);
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
        for template in
            grow_templates(&mut SplitMix64::new(7)).iter().filter(|template| template.kind != PartKind::Leaf)
        {
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
        let templates = grow_templates(&mut SplitMix64::new(7));
        for template in templates.iter().filter(|template| template.kind != PartKind::Leaf) {
            let child_mass: f64 =
                template.children.iter().map(|child_joint| templates[child_joint.template_index].mass()).sum();
            assert!((template.mass() - template.beam().wood_mass() - child_mass).abs() <= 1e-9 * template.mass());
        }
        let tree_mass = templates.last().expect("a trunk").mass();
        assert!((80.0..400.0).contains(&tree_mass), "expected 80 to 400 kg, got {tree_mass}");
    }
}
