//! A part of the tree before it is placed: centreline, radii and skin, what it carries, and the shape with modes that
//! comes of it. Parts that look alike are instances of one mold.

use std::collections::BTreeMap;

use nalgebra::Vector3;

use super::beam::Beam;
use super::centreline::Centreline;
use super::element::{Section, Wood};
use super::lift::{Station, lift};
use super::sheet::{Sheet, Tube, Wrap, station};
use crate::domain::{Metadata, Modes, Shape};
use crate::error::Result;

/// What a part is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    Trunk,
    Branch,
    Leaf,
}

/// Where another part hangs on this one.
#[derive(Debug, Clone)]
pub(super) struct Bud {
    /// The ring whose centre is the joint.
    pub(super) ring: usize,
    /// Unit direction of the other part in this part's frame.
    pub(super) direction: Vector3<f64>,
    /// Index of the other part's mold.
    pub(super) mold: usize,
}

/// A part that can be placed any number of times.
#[derive(Debug, Clone)]
pub(super) struct Mold {
    pub(super) kind: Kind,
    /// 0 for the trunk, 1 for what grows on it, and so on.
    pub(super) level: usize,
    pub(super) line: Centreline,
    /// One radius per ring, metres.
    pub(super) radii: Vec<f64>,
    pub(super) sides: usize,
    pub(super) sheet: Sheet,
    pub(super) wood: Wood,
    /// Fraction of the critical damping that such a part has.
    pub(super) damping: f64,
    /// Carried masses, kg.
    pub(super) loads: Vec<(Station, f64)>,
    pub(super) buds: Vec<Bud>,
    /// Modes to keep; 0 makes a rigid part.
    pub(super) rank: usize,
    /// One side of all blades, m^2.
    pub(super) leaf_area: f64,
}

impl Mold {
    /// Hangs a part of `mass` kg at a ring.
    pub(super) fn hang(&mut self, bud: Bud, mass: f64) {
        self.loads.push((station(&self.line, bud.ring), mass));
        self.buds.push(bud);
    }

    /// Own and carried mass, kg.
    pub(super) fn mass(&self) -> f64 {
        self.beam().own_mass() + self.carried()
    }

    /// The vertices of a ring of its tube, which is the first thing on its sheet.
    pub(super) fn ring_rows(&self, ring: usize) -> Vec<u32> {
        (ring * self.sides..(ring + 1) * self.sides).map(|row| row as u32).collect()
    }

    /// Covers the line with a tube.
    pub(super) fn add_skin(&mut self, wrap: Wrap, swell: impl Fn(f64, f64) -> f64) {
        let tube = Tube { line: &self.line, radii: &self.radii, sides: self.sides, wrap };
        self.sheet.add_tube(&tube, swell);
    }

    /// The shape with its modes, and what a client should know of it.
    ///
    /// # Errors
    /// `Fault` when the beam's eigenproblem fails.
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
