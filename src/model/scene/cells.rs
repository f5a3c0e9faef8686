//! Origins of domains in f64, so that millimetres last ten thousand kilometres away from the scene's origin.
//!
//! A domain's f32 transform, and with it every f32 position that a deformer writes, is relative to the domain's *cell*:
//! a point at whole multiples of [`GRID`] from the scene's origin. All domains within [`REACH`] of the shared cell have
//! it, so that one frame holds for all that is drawn; a domain beyond has a cell of its own. When more than half of the
//! domains are beyond, the shared cell follows them, and all transforms are expressed anew from their kept f64
//! translations.
//!
//! The bound, per axis: a translation is rounded once, by at most 2^-13 units at `REACH`, and the three fused
//! multiply-adds of x = A p + t by at most 2^-12 units each as long as the vertex is within 8192 units of its cell. That
//! is 0.86 mm in a scene of metres. In a cell of its own a translation is at most 512 units long, and a vertex within
//! 1024 units of it is off by at most 0.11 mm. What f32 costs A and p themselves comes on top, wherever the domain is.
//!
//! A domain that follows another one by a constant frame has no translation of its own: it is in the cell of that mover,
//! and what is said of domains here holds of movers, in the order of their transforms.
//!
//! Cells exist once a step with f64 translations has come. A scene that never sees one has none, and its origin is the
//! cell of all.

use super::{Bounds, Scene};
use crate::domain::Transform;
use crate::error::{Result, invalid};

/// Cells lie at whole multiples of this, in scene units: a power of two, so that f64 and often f32 hold them exactly.
pub const GRID: f64 = 1024.0;

/// How far from the shared cell a domain's translation may be on each axis, in scene units, before the domain gets a cell
/// of its own.
pub const REACH: f64 = 4096.0;

/// The cells of all movers of one state.
#[derive(Debug, Clone)]
pub struct Cells {
    /// Translation of each mover in scene units from the scene's origin.
    translations: Vec<[f64; 3]>,
    shared: [f64; 3],
    /// How many movers have a cell of their own.
    away: usize,
    /// How many translations were set since a shared cell was last looked for: looking costs a pass over all domains,
    /// so it is done at most once per that many.
    set: usize,
}

/// How cells came about does not matter, only what they say.
impl PartialEq for Cells {
    fn eq(&self, other: &Self) -> bool {
        self.shared == other.shared && self.translations == other.translations
    }
}

impl Cells {
    /// Cells of transforms that are relative to the scene's origin. [`Self::express`] tells what becomes of them.
    pub(super) fn of(transforms: &[Transform]) -> Self {
        Self::with([0.0; 3], transforms.iter().map(|transform| transform.translation().into()).collect())
    }

    fn with(shared: [f64; 3], translations: Vec<[f64; 3]>) -> Self {
        let away = translations.iter().filter(|translation| is_beyond(shared, **translation)).count();
        Self { shared, away, set: translations.len(), translations }
    }

    /// Cells as [`Self::shared`] and [`Self::translations`] of others told, from where they were kept.
    ///
    /// # Errors
    /// `Invalid` when the shared cell is not on the grid or a translation is not finite.
    pub fn restore(shared: [f64; 3], translations: Vec<[f64; 3]>) -> Result<Self> {
        if shared != nearest_cell(shared) || !shared.iter().all(|number| number.is_finite()) {
            return Err(invalid("cells.shared", format!("multiples of {GRID}"), format!("{shared:?}")));
        }
        match translations.iter().position(|translation| !translation.iter().all(|number| number.is_finite())) {
            None => Ok(Self::with(shared, translations)),
            Some(at) => Err(invalid(format!("cells.translations[{at}]"), "finite numbers", "others")),
        }
    }

    /// The cell of every domain that has none of its own, in scene units from the scene's origin.
    pub const fn shared(&self) -> [f64; 3] {
        self.shared
    }

    /// Translation of each mover in scene units from the scene's origin.
    pub fn translations(&self) -> &[[f64; 3]] {
        &self.translations
    }

    /// Whether all domains have the shared cell.
    pub const fn is_one(&self) -> bool {
        self.away == 0
    }

    /// The cell of a mover and its followers, in scene units from the scene's origin.
    pub fn cell_of(&self, mover: usize) -> [f64; 3] {
        let translation = self.translations[mover];
        if is_beyond(self.shared, translation) { nearest_cell(translation) } else { self.shared }
    }

    /// A transform with the translation that the mover has in its cell, rounded once.
    pub(super) fn express(&self, mover: usize, mut transform: Transform) -> Transform {
        let own = difference(self.translations[mover], self.cell_of(mover));
        for (row, along) in transform.0.chunks_exact_mut(4).zip(own) {
            row[3] = along as f32;
        }
        transform
    }

    /// Moves a mover.
    pub(super) fn set(&mut self, mover: usize, translation: [f64; 3]) {
        let (shared, kept) = (self.shared, &mut self.translations[mover]);
        self.away -= usize::from(is_beyond(shared, *kept));
        *kept = translation;
        self.away += usize::from(is_beyond(shared, translation));
        self.set = self.set.saturating_add(1);
    }

    /// Lets the shared cell follow the domains when most of them have left it. When true, every transform is to be
    /// expressed anew. The cell nearest to the median on each axis: unlike the centroid, it does not mind a few domains
    /// that are very far from all others.
    pub(super) fn follow(&mut self) -> bool {
        let count = self.translations.len();
        if 2 * self.away <= count || self.set < count {
            return false;
        }
        self.set = 0;
        let median = |axis: usize| {
            let mut along: Vec<f64> = self.translations.iter().map(|translation| translation[axis]).collect();
            *along.select_nth_unstable_by(count / 2, f64::total_cmp).1
        };
        let shared = nearest_cell([0, 1, 2].map(median));
        let away = self.translations.iter().filter(|translation| is_beyond(shared, **translation)).count();
        let nearer = away < self.away;
        if nearer {
            (self.shared, self.away) = (shared, away);
        }
        nearer
    }

    /// Positions relative to their domains' cells as positions relative to `view`, a point in scene units from the
    /// scene's origin: f64 in between, f32 in the end. Three numbers per vertex, packed as the layout says. Also the bounds
    /// of the domains that are near `view` when measured by the nearest one; those of a domain that is a thousand times
    /// as far would tell nothing about what can be seen.
    pub fn seen_from(&self, view: [f64; 3], scene: &Scene, positions: &[f32]) -> (Vec<f32>, Bounds) {
        let slots = &scene.layout.slots;
        let offset = |domain| difference(self.cell_of(scene.movers.of(domain)), view);
        let offsets: Vec<[f64; 3]> = (0..slots.len()).map(offset).collect();
        let distance = |offset: &[f64; 3]| offset.iter().fold(0.0, |most: f64, along| most.max(along.abs()));
        let nearest = offsets.iter().map(distance).fold(f64::INFINITY, f64::min);
        let mut seen = Vec::with_capacity(positions.len());
        let mut bounds = Bounds::EMPTY;
        for (slot, offset) in slots.iter().zip(&offsets) {
            let is_near = distance(offset) <= REACH + 4.0 * nearest;
            let own = &positions[3 * slot.first_vertex..][..3 * slot.vertices];
            for point in own.chunks_exact(3) {
                let point: [f64; 3] = std::array::from_fn(|axis| f64::from(point[axis]) + offset[axis]);
                seen.extend(point.map(|number| number as f32));
                if is_near {
                    bounds.include(point);
                }
            }
        }
        (seen, bounds)
    }
}

/// The cell nearest to a point.
pub fn nearest_cell(point: [f64; 3]) -> [f64; 3] {
    point.map(|along| (along / GRID).round() * GRID)
}

fn difference(to: [f64; 3], from: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|axis| to[axis] - from[axis])
}

fn is_beyond(shared: [f64; 3], translation: [f64; 3]) -> bool {
    difference(translation, shared).iter().any(|along| along.abs() > REACH)
}
