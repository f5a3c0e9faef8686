//! Floating origins: f64 reference points that keep f32 coordinates accurate relative to the size of a domain, at any
//! distance from the scene's origin.
//!
//! A domain's f32 transform, and every f32 position that a deformer computes with it, is relative to the domain's
//! *floating origin*. Its distance from the domain is measured in multiples of the domain's *spacing* g
//! ([`OriginGrids`]), the power of two below the domain's size. Most domains use the *shared origin*, so that one
//! coordinate frame suffices to draw them. When more than half of the domains are farther than [`HOME_REACH`] spacings
//! from it, it moves to the majority, and all transforms are rebased from the stored f64 translations. In a scene with
//! a single domain, the shared origin therefore follows the domain, also when the domain returns. A domain farther than
//! [`SHARED_REACH`] spacings from the shared origin (an *outlier*) has a floating origin of its own.
//!
//! Error bound per axis, for a translation t from the floating origin with |t| <= 4 g = `HOME_REACH` g: rounding t
//! contributes at most 2^-23 g. Each of the three fused multiply-adds of x = A p + t contributes at most 2^-22 g while
//! the vertex is within 8 g of its floating origin. The sum is 7 x 2^-23 g: less than 8.4e-7 of the domain's size, at
//! any distance. A domain at the end of the shared origin's reach (64 g) has 16 times this bound, 1.4e-5 of its size.
//! An outlier, with |t| <= g / 2 and its vertices within 4 g, has less than half of this bound. The f32 rounding of A
//! and p adds to the bound, independent of the domain's position.
//!
//! Without f64 translations, all transforms are relative to the scene's origin, and rounding t contributes up to 2^-24
//! |t| in each of the four operations.
//!
//! A follower has no translation of its own: it uses the floating origin of its transform root, whose size includes its
//! followers. Where this module says "domain", it means a transform root with its followers. Translations have the
//! order of the roots' transforms.

use std::sync::Arc;

use super::{BoundingBox, Scene, TransformRoots, far_domains};
use crate::domain::{Domain, Shape, Transform, power_of_two_at_most, snap_to_grid};
use crate::error::{Result, invalid};

/// The distance of a domain from the shared origin, per axis and in multiples of the domain's spacing, beyond which the
/// shared origin does not suit the domain.
pub const HOME_REACH: f64 = 4.0;

/// The largest distance, per axis and in multiples of the domain's spacing, between the shared origin and the
/// translation of a domain that uses it. It is larger than [`HOME_REACH`], because frames with outliers need a pass
/// over all vertices on the host.
pub const SHARED_REACH: f64 = 64.0;

/// Distance in multiples of the domain's spacing up to which [`FloatingOrigins::rebase_positions`] includes a domain in
/// the bounds.
const NEARBY_REACH: f64 = 1024.0;

/// The spacing of the floating origins of each transform root, which is constant in a scene.
#[derive(Debug, Clone, PartialEq)]
pub struct OriginGrids {
    /// Per root, a power of two in scene units. Powers of two make floating origins, and differences of them, exact.
    spacings: Vec<f64>,
    /// The smallest spacing.
    finest: f64,
    /// Per root, its pivot ([`TransformRoots::pivot_of`]). Empty if all are zero.
    pivots: Vec<[f64; 3]>,
}

impl OriginGrids {
    /// The spacing of a root is the largest power of two that is at most its size. The size belongs to the rest
    /// positions of the root and its followers in the frame of the root. It is the diagonal of their bounds or, if
    /// larger, their largest coordinate, because f32 rounds relative to the coordinate.
    pub(super) fn new(shapes: &[Shape], domains: &[Domain], transform_roots: &TransformRoots) -> Self {
        let shape_bounds: Vec<BoundingBox> =
            shapes.iter().map(|shape| far_domains::drawn_bounds(&shape.mesh, [0.0; 3])).collect();
        let mut bounds = vec![BoundingBox::EMPTY; transform_roots.count()];
        for (index, domain) in domains.iter().enumerate() {
            let root_bounds = &mut bounds[transform_roots.root_of(index)];
            match transform_roots.root_from_domain(index).map(|frame| frame.to_matrix()) {
                None => *root_bounds = root_bounds.union(shape_bounds[domain.shape]),
                Some(frame) => shape_bounds[domain.shape]
                    .corners()
                    .iter()
                    .for_each(|corner| root_bounds.include(frame.transform_point(corner).coords.into())),
            }
        }
        let sizes = bounds.iter().map(|bounds| {
            let coordinates = bounds.min.iter().chain(&bounds.max);
            coordinates.fold(bounds.diagonal(), |size: f64, coordinate| size.max(coordinate.abs()))
        });
        let spacings: Vec<f64> = sizes.map(power_of_two_at_most).collect();
        let finest = spacings.iter().copied().fold(f64::INFINITY, f64::min);
        Self { spacings, finest, pivots: transform_roots.pivots().to_vec() }
    }

    /// Spacing of the floating origins of a root in scene units.
    pub fn spacing(&self, root: usize) -> f64 {
        self.spacings[root]
    }

    /// The point nearest to `point` on the finest grid of all roots.
    pub fn snap(&self, point: [f64; 3]) -> [f64; 3] {
        point.map(|coordinate| snap_to_grid(coordinate, self.finest))
    }

    /// Whether a root at `translation` is farther than `reach` spacings from `origin` along an axis.
    fn is_beyond(&self, root: usize, translation: [f64; 3], origin: [f64; 3], reach: f64) -> bool {
        let max_distance = reach * self.spacings[root];
        subtract(translation, origin).iter().any(|coordinate| coordinate.abs() > max_distance)
    }
}

/// Numbers of roots that are far from the shared origin. The order compares outliers first; fewer are better.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default)]
struct DistanceCounts {
    /// Beyond [`SHARED_REACH`], with a floating origin of their own.
    outliers: usize,
    /// Beyond [`HOME_REACH`].
    beyond_home: usize,
}

/// The floating origins of all transform roots of one state.
#[derive(Debug, Clone)]
pub struct FloatingOrigins {
    grids: Arc<OriginGrids>,
    /// Translation of each root in scene units from the scene's origin.
    translations: Vec<[f64; 3]>,
    shared_origin: [f64; 3],
    counts: DistanceCounts,
    /// Number of translations set since the last search for a shared origin. A search is a pass over all domains. It is
    /// repeated only after as many translations as there are domains, so that its cost per translation is constant.
    translations_since_search: usize,
}

/// Equality ignores the grids and counters: `grids` belong to the scene, `counts` follow from the other fields, and
/// `translations_since_search` only schedules searches.
impl PartialEq for FloatingOrigins {
    fn eq(&self, other: &Self) -> bool {
        self.shared_origin == other.shared_origin && self.translations == other.translations
    }
}

impl FloatingOrigins {
    /// Floating origins for transforms that are relative to the scene's origin. [`Self::rebase_transform`] makes the
    /// transforms relative to these floating origins.
    pub(super) fn from_transforms(grids: &Arc<OriginGrids>, transforms: &[Transform]) -> Self {
        let translations = transforms.iter().map(|transform| transform.translation().into()).collect();
        Self::with_shared_origin(grids, [0.0; 3], translations)
    }

    /// Floating origins of the rest state, for a scene that is far from its origin. [`Self::rebase_transform`] makes
    /// the transforms relative to these floating origins.
    pub(super) fn at_rest(scene: &Scene) -> Self {
        let roots = scene.transform_roots.domains().enumerate();
        let translation = |(root, domain): (usize, u32)| {
            let pivot = scene.transform_roots.pivot_of(root).unwrap_or_default();
            far_domains::transform_point(&scene.domains[domain as usize].placement_matrix(), pivot)
        };
        let mut origins = Self::with_shared_origin(&scene.origin_grids, [0.0; 3], roots.map(translation).collect());
        origins.update_shared_origin();
        origins
    }

    fn with_shared_origin(grids: &Arc<OriginGrids>, shared_origin: [f64; 3], translations: Vec<[f64; 3]>) -> Self {
        let mut origins = Self {
            grids: Arc::clone(grids),
            shared_origin,
            counts: DistanceCounts::default(),
            translations_since_search: translations.len(),
            translations,
        };
        origins.counts = origins.count_distances(shared_origin);
        origins
    }

    /// The points of the roots' frames that the transforms of a state map to their translations, in the order of the
    /// translations. Empty if all are zero.
    pub fn pivots(&self) -> &[[f64; 3]] {
        &self.grids.pivots
    }

    /// Converts the translations of transforms to the pivots of a scene. `pivots` are those of the scene from which the
    /// translations come; an empty list means zero.
    pub fn change_pivots(scene: &Scene, transforms: &[Transform], pivots: &[[f64; 3]], translations: &mut [[f64; 3]]) {
        for (root, (translation, transform)) in translations.iter_mut().zip(transforms).enumerate() {
            let pivot = scene.transform_roots.pivot_of(root).unwrap_or_default();
            let change = subtract(pivot, pivots.get(root).copied().unwrap_or_default());
            if change != [0.0; 3] {
                let change = transform.linear() * nalgebra::Vector3::from(change);
                *translation = std::array::from_fn(|axis| translation[axis] + change[axis]);
            }
        }
    }

    /// Restores floating origins from the stored values of [`Self::shared_origin`] and [`Self::translations`]. The
    /// caller must rebase the transforms ([`Self::rebase_transform`]), because the spacings may have changed since they
    /// were stored.
    ///
    /// # Errors
    /// `Invalid` if there is not one translation per root, or a number is not finite.
    pub fn restore(scene: &Scene, shared_origin: [f64; 3], translations: Vec<[f64; 3]>) -> Result<Self> {
        let is_finite = |point: &[f64; 3]| point.iter().all(|number| number.is_finite());
        if translations.len() != scene.transform_roots.count() {
            let root_count = scene.transform_roots.count();
            return Err(invalid("origins.translations", format!("{root_count} points"), translations.len()));
        }
        if !is_finite(&shared_origin) {
            return Err(invalid("origins.shared", "finite numbers", format!("{shared_origin:?}")));
        }
        match translations.iter().position(|translation| !is_finite(translation)) {
            None => Ok(Self::with_shared_origin(&scene.origin_grids, shared_origin, translations)),
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
        self.counts.outliers == 0
    }

    /// The floating origin of a root and its followers, in scene units from the scene's origin.
    pub fn origin_of(&self, root: usize) -> [f64; 3] {
        let translation = self.translations[root];
        if self.grids.is_beyond(root, translation, self.shared_origin, SHARED_REACH) {
            translation.map(|coordinate| snap_to_grid(coordinate, self.grids.spacings[root]))
        } else {
            self.shared_origin
        }
    }

    /// Replaces the translation of `transform` by the root's stored translation, relative to its floating origin and
    /// rounded once. The previous translation does not matter.
    #[must_use]
    pub fn rebase_transform(&self, root: usize, mut transform: Transform) -> Transform {
        let relative_translation = subtract(self.translations[root], self.origin_of(root));
        for (row, coordinate) in transform.0.chunks_exact_mut(4).zip(relative_translation) {
            row[3] = coordinate as f32;
        }
        transform
    }

    /// Makes these origins equal to `newer`, from which they differ at most in the translations of `roots`.
    pub(super) fn copy_roots(&mut self, newer: &Self, roots: impl Iterator<Item = usize>) {
        let Self { grids: _, translations, shared_origin, counts, translations_since_search } = self;
        (*shared_origin, *counts) = (newer.shared_origin, newer.counts);
        *translations_since_search = newer.translations_since_search;
        roots.for_each(|root| translations[root] = newer.translations[root]);
    }

    /// Sets the translation of a root, in scene units from the scene's origin.
    pub(super) fn set_translation(&mut self, root: usize, translation: [f64; 3]) {
        let previous_translation = std::mem::replace(&mut self.translations[root], translation);
        let previous_counts = self.count_distance(root, previous_translation, self.shared_origin);
        let counts = self.count_distance(root, translation, self.shared_origin);
        self.counts.beyond_home = self.counts.beyond_home - previous_counts.beyond_home + counts.beyond_home;
        self.counts.outliers = self.counts.outliers - previous_counts.outliers + counts.outliers;
        self.translations_since_search = self.translations_since_search.saturating_add(1);
    }

    /// Moves the shared origin if more than half of the domains are beyond [`HOME_REACH`], and the move leaves fewer
    /// outliers, or as many outliers and fewer domains beyond this reach. Searches for a better origin only if at least
    /// as many translations were set since the last search as there are domains. The new shared origin is the grid
    /// point nearest to the per-axis median, which is robust to a few very distant domains. If this function returns
    /// true, the caller must call [`Self::rebase_transform`] for every transform.
    pub(super) fn update_shared_origin(&mut self) -> bool {
        let root_count = self.translations.len();
        if 2 * self.counts.beyond_home <= root_count || self.translations_since_search < root_count {
            return false;
        }
        self.translations_since_search = 0;
        let median_along = |axis: usize| {
            let mut coordinates: Vec<f64> = self.translations.iter().map(|translation| translation[axis]).collect();
            *coordinates.select_nth_unstable_by(root_count / 2, f64::total_cmp).1
        };
        let shared_origin = self.grids.snap([0, 1, 2].map(median_along));
        let counts = self.count_distances(shared_origin);
        let is_improvement = counts < self.counts;
        if is_improvement {
            (self.shared_origin, self.counts) = (shared_origin, counts);
        }
        is_improvement
    }

    /// Counts the roots that are far from a shared origin.
    fn count_distances(&self, shared_origin: [f64; 3]) -> DistanceCounts {
        let mut sum = DistanceCounts::default();
        for (root, translation) in self.translations.iter().enumerate() {
            let counts = self.count_distance(root, *translation, shared_origin);
            sum = DistanceCounts {
                beyond_home: sum.beyond_home + counts.beyond_home,
                outliers: sum.outliers + counts.outliers,
            };
        }
        sum
    }

    /// The counts of one root: each is 0 or 1.
    fn count_distance(&self, root: usize, translation: [f64; 3], shared_origin: [f64; 3]) -> DistanceCounts {
        let is_beyond = |reach: f64| usize::from(self.grids.is_beyond(root, translation, shared_origin, reach));
        DistanceCounts { beyond_home: is_beyond(HOME_REACH), outliers: is_beyond(SHARED_REACH) }
    }

    /// Rebases positions from the floating origins of their domains to `reference_point`, in scene units from the
    /// scene's origin. The result is computed in f64 and rounded to f32 once. `positions` has three numbers per vertex
    /// in layout order.
    ///
    /// Also returns the bounds of the near domains. Let d be the distance from `reference_point` to the nearest
    /// floating origin. A domain of spacing g is near if the distance to its floating origin is at most 1024 g + 4 d.
    /// More distant domains would make the bounds too large to fit a shadow map to.
    pub fn rebase_positions(
        &self,
        reference_point: [f64; 3],
        scene: &Scene,
        positions: &[f32],
    ) -> (Vec<f32>, BoundingBox) {
        let layouts = &scene.layout.domains;
        let root_of = |domain| scene.transform_roots.root_of(domain);
        let offset = |domain| subtract(self.origin_of(root_of(domain)), reference_point);
        let offsets: Vec<[f64; 3]> = (0..layouts.len()).map(offset).collect();
        let distance =
            |offset: &[f64; 3]| offset.iter().fold(0.0, |largest: f64, coordinate| largest.max(coordinate.abs()));
        let nearest_distance = offsets.iter().map(distance).fold(f64::INFINITY, f64::min);
        let mut rebased = Vec::with_capacity(positions.len());
        let mut bounds = BoundingBox::EMPTY;
        for (domain, (layout, offset)) in layouts.iter().zip(&offsets).enumerate() {
            let reach = NEARBY_REACH * self.grids.spacings[root_of(domain)];
            let is_near = distance(offset) <= reach + 4.0 * nearest_distance;
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

fn subtract(minuend: [f64; 3], subtrahend: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|axis| minuend[axis] - subtrahend[axis])
}
