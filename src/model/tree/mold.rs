//! Templates of tree parts. A template has a centerline, radii, a skin, carried masses and joints, and is converted to
//! a shape with modes. Parts that look alike are instances of one template.

use std::collections::BTreeMap;

use nalgebra::Vector3;

use super::beam::Beam;
use super::centreline::Centreline;
use super::element::{Section, Wood};
use super::lift::{Station, lift};
use super::sheet::{Sheet, Tube, Wrap, station};
use crate::domain::{Metadata, Modes, Shape};
use crate::error::Result;

/// The kind of a part.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    Trunk,
    Branch,
    Leaf,
}

/// A joint where a child part is attached.
#[derive(Debug, Clone)]
pub(super) struct Bud {
    /// The ring whose center is the joint.
    pub(super) ring: usize,
    /// Unit direction of the child in this part's frame.
    pub(super) direction: Vector3<f64>,
    /// Index of the child's template.
    pub(super) mold: usize,
}

/// A template: a part that can be placed any number of times.
#[derive(Debug, Clone)]
pub(super) struct Mold {
    pub(super) kind: Kind,
    /// 0 for the trunk, 1 for boughs, 2 for twigs; 0 for leaf clusters.
    pub(super) level: usize,
    pub(super) line: Centreline,
    /// One radius per ring, meters.
    pub(super) radii: Vec<f64>,
    pub(super) sides: usize,
    pub(super) sheet: Sheet,
    pub(super) wood: Wood,
    /// Damping ratio (fraction of critical damping), for clients.
    pub(super) damping: f64,
    /// Carried masses in kg and their stations.
    pub(super) loads: Vec<(Station, f64)>,
    pub(super) buds: Vec<Bud>,
    /// Number of modes; 0 for a rigid part.
    pub(super) rank: usize,
    /// Total one-sided area of all blades in m^2.
    pub(super) leaf_area: f64,
}

impl Mold {
    /// Attaches a part of `mass` kg at a ring.
    pub(super) fn hang(&mut self, bud: Bud, mass: f64) {
        self.loads.push((station(&self.line, bud.ring), mass));
        self.buds.push(bud);
    }

    /// Own and carried mass in kg.
    pub(super) fn mass(&self) -> f64 {
        self.beam().own_mass() + self.carried()
    }

    /// The vertices of a ring of the tube. The tube must be the first geometry of its sheet.
    pub(super) fn ring_rows(&self, ring: usize) -> Vec<u32> {
        (ring * self.sides..(ring + 1) * self.sides).map(|row| row as u32).collect()
    }

    /// Adds a tube around the centerline.
    pub(super) fn add_skin(&mut self, wrap: Wrap, swell: impl Fn(f64, f64) -> f64) {
        let tube = Tube { line: &self.line, radii: &self.radii, sides: self.sides, wrap };
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
            modes = lift(&beam.nodes, &solved.shapes, &self.sheet.rest, &self.sheet.stations)?;
            metadata.eigenvalues = solved.eigenvalues;
        }
        Ok((Shape::new(self.sheet.mesh()?, modes)?, metadata))
    }

    pub(super) fn beam(&self) -> Beam {
        let element = |first: usize| {
            let cones =
                self.radii[first..=first + self.line.rings].windows(2).map(|ends| Section::of_cone(ends[0], ends[1]));
            let count = self.line.rings as f64;
            cones.fold(Section { area: 0.0, moment: 0.0 }, |sum, cone| Section {
                area: sum.area + cone.area / count,
                moment: sum.moment + cone.moment / count,
            })
        };
        let sections = (0..self.radii.len() - 1).step_by(self.line.rings).map(element).collect();
        Beam { nodes: self.line.nodes(), sections, wood: self.wood, loads: self.loads.clone() }
    }

    fn carried(&self) -> f64 {
        self.loads.iter().map(|(_, mass)| mass).sum()
    }

    fn notes(&self, beam: &Beam) -> BTreeMap<String, String> {
        let kind = match self.kind {
            Kind::Trunk => "trunk",
            Kind::Branch => "branch",
            Kind::Leaf => "leaf",
        };
        let mut notes = BTreeMap::from([
            ("kind".into(), kind.into()),
            ("level".into(), self.level.to_string()),
            ("length".into(), format!("{:.4}", self.line.length())),
            ("mass".into(), format!("{:.5}", beam.own_mass())),
            ("carried_mass".into(), format!("{:.5}", self.carried())),
            ("damping_ratio".into(), self.damping.to_string()),
            ("youngs_modulus".into(), self.wood.youngs_modulus.to_string()),
            ("density".into(), self.wood.density.to_string()),
        ]);
        if self.rank > 0 {
            notes.insert("mass_normalised".into(), "true".into());
        }
        if self.kind == Kind::Leaf {
            notes.insert("leaf_area".into(), format!("{:.5}", self.leaf_area));
        }
        notes
    }
}

#[cfg(test)]
mod tests {
    use super::super::beam::tests::faults;
    use super::super::lift::motion;
    use super::super::plan::plan;
    use super::super::random::Random;
    use super::*;

    #[test]
    fn the_modes_of_every_part_solve_its_eigenproblem() {
        for mold in plan(&mut Random::new(7)).iter().filter(|mold| mold.rank > 0) {
            let beam = mold.beam();
            let modes = beam.modes(mold.rank).expect("converges");
            let (residual, skew) = faults(&beam, &modes);
            assert!(residual <= 1e-6, "level {}: residual {residual}", mold.level);
            assert!(skew <= 1e-6, "level {}: departure from mass-orthonormality {skew}", mold.level);
        }
    }

    #[test]
    fn the_base_rests_and_the_mean_of_a_ring_moves_as_its_section_does() {
        for mold in plan(&mut Random::new(7)).iter().filter(|mold| mold.rank > 0) {
            let (shape, _) = mold.cast().expect("solved");
            let beam = mold.beam();
            let solved = beam.modes(mold.rank).expect("converges");
            let mean = |ring: usize, mode: usize| {
                let rows = mold.ring_rows(ring);
                let count = rows.len() as f64;
                let row = |row: u32| Vector3::from_fn(|axis, _| f64::from(shape.modes.at(row as usize, axis, mode)));
                rows.into_iter().map(row).sum::<Vector3<f64>>() / count
            };
            for mode in 0..mold.rank {
                let base = mold.ring_rows(0);
                let at_rest = |row: &u32| (0..3).all(|axis| shape.modes.at(*row as usize, axis, mode).to_bits() == 0);
                assert!(base.iter().all(at_rest), "the base moves");
                let dofs: Vec<f64> = solved.shapes.column(mode).iter().copied().collect();
                let largest = solved.shapes.column(mode).amax();
                for ring in 1..mold.line.points.len() {
                    let section = motion(&beam.nodes, &dofs, station(&mold.line, ring));
                    let want = section.of(&mold.line.points[ring]);
                    assert!((mean(ring, mode) - want).norm() <= 1e-6 * largest, "ring {ring}");
                }
                // Counterexample: neighboring rings move differently.
                let last = mold.line.points.len() - 1;
                assert!((mean(last, mode) - mean(last - 1, mode)).norm() > 1e-4 * largest);
            }
        }
    }

    #[test]
    fn all_bark_looks_outwards() {
        for mold in plan(&mut Random::new(7)).iter().filter(|mold| mold.kind != Kind::Leaf) {
            let mesh = mold.sheet.mesh().expect("finite");
            let last = mold.line.points.len() - 1;
            for (vertex, normal) in mesh.corners().vertices.iter().zip(&mesh.corners().normals) {
                let place = Vector3::from(mesh.rest()[*vertex as usize]).cast::<f64>();
                let centre = mold.line.points[(*vertex as usize / mold.sides).min(last)];
                let outwards = (place - centre).normalize().dot(&Vector3::from(*normal).cast());
                assert!(outwards > 0.2, "level {}: {outwards}", mold.level);
                assert!((Vector3::from(*normal).norm() - 1.0).abs() < 1e-5);
            }
            assert!(mesh.corners().uvs.as_flattened().iter().all(|number| number.is_finite()));
        }
    }

    #[test]
    fn masses_add_up_from_the_leaves_to_the_trunk() {
        let molds = plan(&mut Random::new(7));
        for mold in molds.iter().filter(|mold| mold.kind != Kind::Leaf) {
            let children: f64 = mold.buds.iter().map(|bud| molds[bud.mold].mass()).sum();
            assert!((mold.mass() - mold.beam().own_mass() - children).abs() <= 1e-9 * mold.mass());
        }
        let whole = molds.last().expect("a trunk").mass();
        assert!((80.0..400.0).contains(&whole), "the tree weighs {whole} kg");
    }
}
