//! Floating origins: f64 reference points that keep f32 coordinates accurate to a millimeter, ten thousand kilometers
//! away from the scene's origin.
//!
//! A domain's f32 transform, and every f32 position that a deformer computes with it, is relative to the domain's
//! *floating origin*: a point at whole multiples of [`ORIGIN_GRID`] from the scene's origin. All domains within
//! [`ORIGIN_REACH`] of the *shared origin* use it, so that one coordinate frame suffices to draw them. A domain outside
//! (an *outlier*) has a floating origin of its own. When more than half of the domains are outliers, the shared origin
//! moves to them, and all transforms are rebased from the stored f64 translations.
//!
//! Error bound per axis: rounding a translation contributes at most 2^-13 units at `ORIGIN_REACH`. Each of the three
//! fused multiply-adds of x = A p + t contributes at most 2^-12 units while the vertex is within 8192 units of its
//! floating origin. The sum is 7 x 2^-13 units, which is 0.86 mm in a scene of meters. The translation of an outlier is
//! at most 512 units per axis from its own floating origin, so that within 1024 units the sum is 7 x 2^-16 units or
//! 0.11 mm. The f32 rounding of A and p adds to this bound, independent of the domain's position.
//!
//! A follower has no translation of its own: it uses the floating origin of its transform root. Where this module says
//! "domain", it means a transform root. Translations have the order of the roots' transforms.
//!
//! Floating origins exist only after the first step with f64 translations. Until then, all transforms are relative to
//! the scene's origin.

use super::{BoundingBox, Scene};
use crate::domain::Transform;
use crate::error::{Result, invalid};

/// Spacing of floating origins in scene units. It is a power of two, so that their coordinates are exact in f64, and up
/// to 2^34 units (2^24 times the spacing) also in f32.
pub const ORIGIN_GRID: f64 = 1024.0;

/// The largest distance, per axis and in scene units, between the shared origin and the translation of a domain that
/// uses it.
pub const ORIGIN_REACH: f64 = 4096.0;

/// The floating origins of all transform roots of one state.
#[derive(Debug, Clone)]
pub struct FloatingOrigins {
    /// Translation of each root in scene units from the scene's origin.
    translations: Vec<[f64; 3]>,
    shared_origin: [f64; 3],
    /// Number of roots that have a floating origin of their own.
    outlier_count: usize,
    /// Number of translations set since the last search for a shared origin. A search is a pass over all domains. It is
    /// repeated only after as many translations as there are domains, so that its cost per translation is constant.
    translations_since_search: usize,
}

/// Equality ignores the counters: `outlier_count` follows from the other fields, and `translations_since_search` only
/// schedules searches.
impl PartialEq for FloatingOrigins {
    fn eq(&self, other: &Self) -> bool {
        self.shared_origin == other.shared_origin && self.translations == other.translations
    }
}

impl FloatingOrigins {
    /// Floating origins for transforms that are relative to the scene's origin. [`Self::rebase_transform`] makes the
    /// transforms relative to these floating origins.
    pub(super) fn from_transforms(transforms: &[Transform]) -> Self {
        Self::with_shared_origin([0.0; 3], transforms.iter().map(|transform| transform.translation().into()).collect())
    }

    fn with_shared_origin(shared_origin: [f64; 3], translations: Vec<[f64; 3]>) -> Self {
        let outlier_count =
            translations.iter().filter(|translation| is_beyond_reach(shared_origin, **translation)).count();
        Self { shared_origin, outlier_count, translations_since_search: translations.len(), translations }
    }

    /// Restores floating origins from the stored values of [`Self::shared_origin`] and [`Self::translations`].
    ///
    /// # Errors
    /// `Invalid` if the shared origin is not on the grid or a translation is not finite.
    pub fn restore(shared_origin: [f64; 3], translations: Vec<[f64; 3]>) -> Result<Self> {
        if shared_origin != snap_to_origin_grid(shared_origin) || !shared_origin.iter().all(|number| number.is_finite())
        {
            return Err(invalid("origins.shared", format!("multiples of {ORIGIN_GRID}"), format!("{shared_origin:?}")));
        }
        match translations.iter().position(|translation| !translation.iter().all(|number| number.is_finite())) {
            None => Ok(Self::with_shared_origin(shared_origin, translations)),
            Some(index) => Err(invalid(
                format!("origins.translations[{index}]"),
                "finite numbers",
                format!("{:?}", translations[index]),
            )),
        }
    }

    /// The floating origin of all domains that are not outliers, in scene units from the scene's origin.
    pub const fn shared_origin(&self) -> [f64; 3] {
        self.shared_origin
    }

    /// Translation of each root in scene units from the scene's origin.
    pub fn translations(&self) -> &[[f64; 3]] {
        &self.translations
    }

    /// Whether all domains use the shared origin: there are no outliers.
    pub const fn has_no_outliers(&self) -> bool {
        self.outlier_count == 0
    }

    /// The floating origin of a root and its followers, in scene units from the scene's origin.
    pub fn origin_of(&self, root: usize) -> [f64; 3] {
        let translation = self.translations[root];
        if is_beyond_reach(self.shared_origin, translation) {
            snap_to_origin_grid(translation)
        } else {
            self.shared_origin
        }
    }

    /// Replaces the translation of `transform` by the root's stored translation, relative to its floating origin and
    /// rounded once. The previous translation does not matter.
    pub(super) fn rebase_transform(&self, root: usize, mut transform: Transform) -> Transform {
        let relative_translation = subtract(self.translations[root], self.origin_of(root));
        for (row, coordinate) in transform.0.chunks_exact_mut(4).zip(relative_translation) {
            row[3] = coordinate as f32;
        }
        transform
    }

    /// Sets the translation of a root, in scene units from the scene's origin.
    pub(super) fn set_translation(&mut self, root: usize, translation: [f64; 3]) {
        let (shared_origin, stored_translation) = (self.shared_origin, &mut self.translations[root]);
        self.outlier_count -= usize::from(is_beyond_reach(shared_origin, *stored_translation));
        *stored_translation = translation;
        self.outlier_count += usize::from(is_beyond_reach(shared_origin, translation));
        self.translations_since_search = self.translations_since_search.saturating_add(1);
    }

    /// Moves the shared origin under three conditions: more than half of the domains are outliers, at least as many
    /// translations were set since the last search as there are domains, and the move reduces the number of outliers.
    /// The new shared origin is the grid point nearest to the per-axis median, which is robust to a few very distant
    /// domains. If this function returns true, the caller must call [`Self::rebase_transform`] for every transform.
    pub(super) fn update_shared_origin(&mut self) -> bool {
        let root_count = self.translations.len();
        if 2 * self.outlier_count <= root_count || self.translations_since_search < root_count {
            return false;
        }
        self.translations_since_search = 0;
        let median_along = |axis: usize| {
            let mut coordinates: Vec<f64> = self.translations.iter().map(|translation| translation[axis]).collect();
            *coordinates.select_nth_unstable_by(root_count / 2, f64::total_cmp).1
        };
        let shared_origin = snap_to_origin_grid([0, 1, 2].map(median_along));
        let outlier_count =
            self.translations.iter().filter(|translation| is_beyond_reach(shared_origin, **translation)).count();
        let is_improvement = outlier_count < self.outlier_count;
        if is_improvement {
            (self.shared_origin, self.outlier_count) = (shared_origin, outlier_count);
        }
        is_improvement
    }

    /// Rebases positions from the floating origins of their domains to `reference_point`, in scene units from the
    /// scene's origin. The result is computed in f64 and rounded to f32 once. `positions` has three numbers per vertex
    /// in layout order.
    ///
    /// Also returns the bounds of the near domains. With d as the distance from `reference_point` to the nearest
    /// floating origin, a domain is near if the distance of its floating origin is at most [`ORIGIN_REACH`] + 4 d. More
    /// distant domains would make the bounds too large to fit a camera or shadow map to.
    pub fn rebase_positions(
        &self,
        reference_point: [f64; 3],
        scene: &Scene,
        positions: &[f32],
    ) -> (Vec<f32>, BoundingBox) {
        let layouts = &scene.layout.domains;
        let offset = |domain| subtract(self.origin_of(scene.transform_roots.root_of(domain)), reference_point);
        let offsets: Vec<[f64; 3]> = (0..layouts.len()).map(offset).collect();
        let distance =
            |offset: &[f64; 3]| offset.iter().fold(0.0, |largest: f64, coordinate| largest.max(coordinate.abs()));
        let nearest_distance = offsets.iter().map(distance).fold(f64::INFINITY, f64::min);
        let mut rebased = Vec::with_capacity(positions.len());
        let mut bounds = BoundingBox::EMPTY;
        for (layout, offset) in layouts.iter().zip(&offsets) {
            let is_near = distance(offset) <= ORIGIN_REACH + 4.0 * nearest_distance;
            let domain_positions = &positions[3 * layout.first_vertex..][..3 * layout.vertices];
            for point in domain_positions.chunks_exact(3) {
                let point: [f64; 3] = std::array::from_fn(|axis| f64::from(point[axis]) + offset[axis]);
                rebased.extend(point.map(|number| number as f32));
                if is_near {
                    bounds.include(point);
                }
            }
        }
        (rebased, bounds)
    }
}

/// The grid point nearest to a point. It is the floating origin of an outlier whose translation is `point`.
pub fn snap_to_origin_grid(point: [f64; 3]) -> [f64; 3] {
    point.map(|coordinate| (coordinate / ORIGIN_GRID).round() * ORIGIN_GRID)
}

fn subtract(minuend: [f64; 3], subtrahend: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|axis| minuend[axis] - subtrahend[axis])
}

fn is_beyond_reach(shared_origin: [f64; 3], translation: [f64; 3]) -> bool {
    subtract(translation, shared_origin).iter().any(|coordinate| coordinate.abs() > ORIGIN_REACH)
}
