//! Templates of tree parts. A template has a centerline, radii, a skin, carried masses and joints, and is converted to
//! a shape with modes. Parts that look alike are instances of one template.

use std::collections::BTreeMap;

use nalgebra::Vector3;

use super::beam::Beam;
use super::centerline::Centerline;
use super::element::{ElasticConstants, Section};
use super::skin::{SkinBuilder, Tube, UvMapping, station};
use super::skin_modes::{Station, lift};
use crate::domain::{Metadata, Modes, Shape};
use crate::error::Result;

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
    pub(super) mold: usize,
}

/// A template: a part that can be placed any number of times.
#[derive(Debug, Clone)]
pub(super) struct PartTemplate {
    pub(super) kind: PartKind,
    /// Branching level: 0 for the trunk, 1 for boughs, 2 for twigs. `None` for leaf clusters, whose templates are used at
    /// several levels.
    pub(super) level: Option<usize>,
    pub(super) centerline: Centerline,
    /// One radius per ring, meters.
    pub(super) radii: Vec<f64>,
    pub(super) sides: usize,
    pub(super) sheet: SkinBuilder,
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
    pub(super) fn attach_child(&mut self, bud: ChildJoint, mass: f64) {
        self.point_masses.push((station(&self.centerline, bud.ring), mass));
        self.children.push(bud);
    }

    /// Own and carried mass in kg.
    pub(super) fn mass(&self) -> f64 {
        self.beam().own_mass() + self.carried_mass()
    }

    /// The vertices of a ring of the tube. The tube must be the first geometry of its sheet.
    pub(super) fn ring_rows(&self, ring: usize) -> Vec<u32> {
        (ring * self.sides..(ring + 1) * self.sides).map(|row| row as u32).collect()
    }

    /// Adds a tube around the centerline.
    pub(super) fn add_skin(&mut self, wrap: UvMapping, swell: impl Fn(f64, f64) -> f64) {
        let tube = Tube { centerline: &self.centerline, radii: &self.radii, sides: self.sides, wrap };
        self.sheet.add_tube(&tube, swell);
    }

    /// Converts to a shape with modes and metadata for clients.
    ///
    /// # Errors
    /// `Fault` if the beam's eigenproblem fails.
    pub(super) fn cast(&self) -> Result<(Shape, Metadata)> {
        let beam = self.beam();
        let mut metadata = Metadata { notes: self.notes(&beam), eigenvalues: vec![] };
        let mut modes = Modes::rigid();
        if self.rank > 0 {
            let solved = beam.modes(self.rank)?;
            modes = lift(&beam.nodes, &solved.mode_shapes, &self.sheet.rest, &self.sheet.stations)?;
            metadata.eigenvalues = solved.eigenvalues;
        }
        Ok((Shape::new(self.sheet.mesh()?, modes)?, metadata))
    }

    pub(super) fn beam(&self) -> Beam {
        let element = |first: usize| {
            let cones = self.radii[first..=first + self.centerline.rings]
                .windows(2)
                .map(|ends| Section::of_cone(ends[0], ends[1]));
            let count = self.centerline.rings as f64;
            cones.fold(Section { area: 0.0, moment: 0.0 }, |sum, cone| Section {
                area: sum.area + cone.area / count,
                moment: sum.moment + cone.moment / count,
            })
        };
        let sections = (0..self.radii.len() - 1).step_by(self.centerline.rings).map(element).collect();
        Beam {
            nodes: self.centerline.nodes(),
            sections,
            elastic: self.elastic,
            point_masses: self.point_masses.clone(),
        }
    }

    fn carried_mass(&self) -> f64 {
        self.point_masses.iter().map(|(_, mass)| mass).sum()
    }

    fn notes(&self, beam: &Beam) -> BTreeMap<String, String> {
        let kind = match self.kind {
            PartKind::Trunk => "trunk",
            PartKind::Branch => "branch",
            PartKind::Leaf => "leaf",
        };
        let mut notes = BTreeMap::from([
            ("kind".into(), kind.into()),
            ("length".into(), format!("{:.4}", self.centerline.length())),
            ("mass".into(), format!("{:.5}", beam.own_mass())),
            ("carried_mass".into(), format!("{:.5}", self.carried_mass())),
            ("damping_ratio".into(), self.damping.to_string()),
            ("youngs_modulus".into(), self.elastic.youngs_modulus.to_string()),
            ("density".into(), self.elastic.density.to_string()),
        ]);
        if let Some(level) = self.level {
            notes.insert("level".into(), level.to_string());
        }
        if self.rank > 0 {
            notes.insert("mass_normalised".into(), "true".into());
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
    use super::super::species::plan;
    use super::*;

    #[test]
    fn the_modes_of_every_part_solve_its_eigenproblem() {
        for mold in plan(&mut SplitMix64::new(7)).iter().filter(|mold| mold.rank > 0) {
            let beam = mold.beam();
            let modes = beam.modes(mold.rank).expect("converges");
            let (residual, skew) = eigen_residuals(&beam, &modes);
            assert!(residual <= 1e-6, "level {:?}: residual {residual}", mold.level);
            assert!(skew <= 1e-6, "level {:?}: departure from mass-orthonormality {skew}", mold.level);
        }
    }

    #[test]
    fn the_base_rests_and_the_mean_of_a_ring_moves_as_its_section_does() {
        for mold in plan(&mut SplitMix64::new(7)).iter().filter(|mold| mold.rank > 0) {
            let (shape, _) = mold.cast().expect("solved");
            let beam = mold.beam();
            let solved = beam.modes(mold.rank).expect("converges");
            let mean = |ring: usize, mode: usize| {
                let rows = mold.ring_rows(ring);
                let count = rows.len() as f64;
                let row = |row: u32| Vector3::from_fn(|axis, _| f64::from(shape.modes.entry(row as usize, axis, mode)));
                rows.into_iter().map(row).sum::<Vector3<f64>>() / count
            };
            for mode in 0..mold.rank {
                let base = mold.ring_rows(0);
                let at_rest =
                    |row: &u32| (0..3).all(|axis| shape.modes.entry(*row as usize, axis, mode).to_bits() == 0);
                assert!(base.iter().all(at_rest), "the base moves");
                let dofs: Vec<f64> = solved.mode_shapes.column(mode).iter().copied().collect();
                let largest = solved.mode_shapes.column(mode).amax();
                for ring in 1..mold.centerline.points.len() {
                    let section = section_motion(&beam.nodes, &dofs, station(&mold.centerline, ring));
                    let want = section.displacement_of(&mold.centerline.points[ring]);
                    assert!((mean(ring, mode) - want).norm() <= 1e-6 * largest, "ring {ring}");
                }
                // Counterexample: neighboring rings move differently.
                let last = mold.centerline.points.len() - 1;
                assert!((mean(last, mode) - mean(last - 1, mode)).norm() > 1e-4 * largest);
            }
        }
    }

    #[test]
    fn all_bark_looks_outwards() {
        for mold in plan(&mut SplitMix64::new(7)).iter().filter(|mold| mold.kind != PartKind::Leaf) {
            let mesh = mold.sheet.mesh().expect("finite");
            let last = mold.centerline.points.len() - 1;
            for (vertex, normal) in mesh.corners().vertices.iter().zip(&mesh.corners().normals) {
                let place = Vector3::from(mesh.rest_positions()[*vertex as usize]).cast::<f64>();
                let center = mold.centerline.points[(*vertex as usize / mold.sides).min(last)];
                let outwards = (place - center).normalize().dot(&Vector3::from(*normal).cast());
                assert!(outwards > 0.2, "level {:?}: {outwards}", mold.level);
                assert!((Vector3::from(*normal).norm() - 1.0).abs() < 1e-5);
            }
            assert!(mesh.corners().uvs.as_flattened().iter().all(|number| number.is_finite()));
        }
    }

    #[test]
    fn masses_add_up_from_the_leaves_to_the_trunk() {
        let molds = plan(&mut SplitMix64::new(7));
        for mold in molds.iter().filter(|mold| mold.kind != PartKind::Leaf) {
            let children: f64 = mold.children.iter().map(|bud| molds[bud.mold].mass()).sum();
            assert!((mold.mass() - mold.beam().own_mass() - children).abs() <= 1e-9 * mold.mass());
        }
        let whole = molds.last().expect("a trunk").mass();
        assert!((80.0..400.0).contains(&whole), "the tree weighs {whole} kg");
    }
}
