//! Floating origins: f64 reference points that keep f32 coordinates accurate to a millimeter, ten thousand kilometers
//! away from the scene's origin.
//!
//! A domain's f32 transform, and every f32 position that a deformer computes with it, is relative to the domain's
//! *cell*: a point at whole multiples of [`ORIGIN_GRID`] from the scene's origin. All domains within [`ORIGIN_REACH`] of the shared
//! cell use the shared cell, so that one coordinate frame suffices to draw them. A domain outside has a cell of its
//! own. When more than half of the domains are outside, the shared cell moves to them, and all transforms are rebased
//! from the stored f64 translations.
//!
//! Error bound per axis: rounding a translation contributes at most 2^-13 units at `ORIGIN_REACH`, and each of the three fused
//! multiply-adds of x = A p + t at most 2^-12 units while the vertex is within 8192 units of its cell. In a scene of
//! meters that is 0.86 mm. In a cell of its own, a translation is at most 512 units long, and the error of a vertex
//! within 1024 units is at most 0.11 mm. The f32 rounding of A and p adds to this bound, independent of the domain's
//! position.
//!
//! A follower has no translation of its own: it uses the cell of its transform root. Where this module says "domain",
//! it means a transform root; translations have the order of the roots' transforms.
//!
//! Cells exist only after the first step with f64 translations. Until then, the scene's origin is the cell of all
//! domains.

use super::{BoundingBox, Scene};
use crate::domain::Transform;
use crate::error::{Result, invalid};

/// Spacing of cells in scene units. A power of two, so that their coordinates are exact in f64 and often in f32.
pub const ORIGIN_GRID: f64 = 1024.0;

/// The largest distance, per axis and in scene units, between the shared cell and the translation of a domain that uses
/// it. Beyond, the domain has a cell of its own.
pub const ORIGIN_REACH: f64 = 4096.0;

/// The cells of all transform roots of one state.
#[derive(Debug, Clone)]
pub struct FloatingOrigins {
    /// Translation of each root in scene units from the scene's origin.
    translations: Vec<[f64; 3]>,
    shared: [f64; 3],
    /// Number of roots that have a cell of their own.
    outliers: usize,
    /// Number of translations set since the last search for a shared cell. A search is a pass over all domains; it is
    /// repeated only after as many translations as there are domains, so that its cost per translation is constant.
    set: usize,
}

/// Equality ignores the counters: equal cells and translations are enough.
impl PartialEq for FloatingOrigins {
    fn eq(&self, other: &Self) -> bool {
        self.shared == other.shared && self.translations == other.translations
    }
}

impl FloatingOrigins {
    /// Cells of transforms that are relative to the scene's origin. [`Self::rebase_transform`] converts the transforms to their
    /// cells.
    pub(super) fn of(transforms: &[Transform]) -> Self {
        Self::with_shared_origin([0.0; 3], transforms.iter().map(|transform| transform.translation().into()).collect())
    }

    fn with_shared_origin(shared: [f64; 3], translations: Vec<[f64; 3]>) -> Self {
        let outliers = translations.iter().filter(|translation| is_out_of_reach(shared, **translation)).count();
        Self { shared, outliers, set: translations.len(), translations }
    }

    /// Restores cells from the stored values of [`Self::shared`] and [`Self::translations`].
    ///
    /// # Errors
    /// `Invalid` if the shared cell is not on the grid or a translation is not finite.
    pub fn restore(shared: [f64; 3], translations: Vec<[f64; 3]>) -> Result<Self> {
        if shared != snap_to_origin_grid(shared) || !shared.iter().all(|number| number.is_finite()) {
            return Err(invalid("cells.shared", format!("multiples of {ORIGIN_GRID}"), format!("{shared:?}")));
        }
        match translations.iter().position(|translation| !translation.iter().all(|number| number.is_finite())) {
            None => Ok(Self::with_shared_origin(shared, translations)),
            Some(at) => Err(invalid(format!("cells.translations[{at}]"), "finite numbers", "others")),
        }
    }

    /// The cell of all domains without a cell of their own, in scene units from the scene's origin.
    pub const fn shared(&self) -> [f64; 3] {
        self.shared
    }

    /// Translation of each root in scene units from the scene's origin.
    pub fn translations(&self) -> &[[f64; 3]] {
        &self.translations
    }

    /// Whether all domains use the shared cell.
    pub const fn is_uniform(&self) -> bool {
        self.outliers == 0
    }

    /// The cell of a root and its followers, in scene units from the scene's origin.
    pub fn origin_of(&self, mover: usize) -> [f64; 3] {
        let translation = self.translations[mover];
        if is_out_of_reach(self.shared, translation) { snap_to_origin_grid(translation) } else { self.shared }
    }

    /// Replaces the translation of `transform` by the root's translation relative to its cell, rounded once.
    pub(super) fn rebase_transform(&self, mover: usize, mut transform: Transform) -> Transform {
        let own = difference(self.translations[mover], self.origin_of(mover));
        for (row, along) in transform.0.chunks_exact_mut(4).zip(own) {
            row[3] = along as f32;
        }
        transform
    }

    /// Sets the translation of a root, in scene units from the scene's origin.
    pub(super) fn set(&mut self, mover: usize, translation: [f64; 3]) {
        let (shared, kept) = (self.shared, &mut self.translations[mover]);
        self.outliers -= usize::from(is_out_of_reach(shared, *kept));
        *kept = translation;
        self.outliers += usize::from(is_out_of_reach(shared, translation));
        self.set = self.set.saturating_add(1);
    }

    /// Moves the shared cell if more than half of the domains are outside its reach, as many translations were set
    /// since the last attempt as there are domains, and the move leaves fewer domains outside. If this returns true,
    /// the caller must rebase every transform by [`Self::rebase_transform`]. The new cell is the one nearest to the per-axis
    /// median, which, unlike the centroid, is robust to a few very distant domains.
    pub(super) fn update_shared_origin(&mut self) -> bool {
        let count = self.translations.len();
        if 2 * self.outliers <= count || self.set < count {
            return false;
        }
        self.set = 0;
        let median = |axis: usize| {
            let mut along: Vec<f64> = self.translations.iter().map(|translation| translation[axis]).collect();
            *along.select_nth_unstable_by(count / 2, f64::total_cmp).1
        };
        let shared = snap_to_origin_grid([0, 1, 2].map(median));
        let outliers = self.translations.iter().filter(|translation| is_out_of_reach(shared, **translation)).count();
        let nearer = outliers < self.outliers;
        if nearer {
            (self.shared, self.outliers) = (shared, outliers);
        }
        nearer
    }

    /// Rebases positions from their domains' cells to `view`, a point in scene units from the scene's origin: computed
    /// in f64, rounded to f32 once. `positions` has three numbers per vertex in layout order. Also returns the bounds
    /// of the domains that are near `view` compared with the nearest one; bounds of much more distant domains would say
    /// nothing about the visible ones.
    pub fn rebase_positions(&self, view: [f64; 3], scene: &Scene, positions: &[f32]) -> (Vec<f32>, BoundingBox) {
        let slots = &scene.layout.domains;
        let offset = |domain| difference(self.origin_of(scene.transform_roots.root_of(domain)), view);
        let offsets: Vec<[f64; 3]> = (0..slots.len()).map(offset).collect();
        let distance = |offset: &[f64; 3]| offset.iter().fold(0.0, |most: f64, along| most.max(along.abs()));
        let nearest = offsets.iter().map(distance).fold(f64::INFINITY, f64::min);
        let mut seen = Vec::with_capacity(positions.len());
        let mut bounds = BoundingBox::EMPTY;
        for (slot, offset) in slots.iter().zip(&offsets) {
            let is_near = distance(offset) <= ORIGIN_REACH + 4.0 * nearest;
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
pub fn snap_to_origin_grid(point: [f64; 3]) -> [f64; 3] {
    point.map(|along| (along / ORIGIN_GRID).round() * ORIGIN_GRID)
}

fn difference(to: [f64; 3], from: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|axis| to[axis] - from[axis])
}

fn is_out_of_reach(shared: [f64; 3], translation: [f64; 3]) -> bool {
    difference(translation, shared).iter().any(|along| along.abs() > ORIGIN_REACH)
}
