//! Error model of a deformer: what it replaces in x = T (x0 + U q) before it computes (storage of U, truncation of
//! modes, 16-bit coordinates), and a-priori bounds on the resulting error.

use std::sync::{Arc, Mutex, PoisonError};

use rayon::prelude::*;

use super::workloads::with_deformation;
use modalcast_compute::storage::bound::{ErrorBound, ErrorBoundInput, ShapeErrorModel, norm};
use modalcast_compute::storage::{
    QUAD, SplitCoordinates, TILE_QUADS, TensorCoreError, TiledModes, Truncation, TruncationInput, max_row_norms,
};
use modalcast_model::error::Result;
use modalcast_model::scene::{DeformationSettings, DomainLayout, Scene, SceneState, StorageType};

/// Vertices per tile of stored U.
const TILE: usize = QUAD * TILE_QUADS;

/// The error model of one scene, derived from its deformation.
#[derive(Debug)]
pub struct ErrorModel {
    scene: Arc<Scene>,
    /// Stored U per shape; empty when U is stored in f32.
    stored: Arc<Vec<Stored>>,
    truncation: Option<TruncationState>,
    /// Whether tensor cores multiply, in which case each coordinate is split into two 16-bit numbers.
    halves: bool,
}

/// Stored U of one shape, and the data that its error bounds need.
type Stored = (TiledModes, ShapeErrorModel);

#[derive(Debug)]
struct TruncationState {
    /// Error budget, scene units.
    most: f64,
    /// Per shape and mode: the farthest that a unit coordinate moves a vertex.
    max_row_norms: Vec<Vec<f64>>,
    /// Truncation state per domain.
    domains: Vec<Truncation>,
}

impl ErrorModel {
    /// The error model of a deformer that follows this scene's deformation.
    pub fn of(scene: &Arc<Scene>) -> Self {
        Self::with(scene, Arc::new(store(scene)))
    }

    fn with(scene: &Arc<Scene>, stored: Arc<Vec<Stored>>) -> Self {
        let truncation =
            scene.deformation.truncation.filter(|_| scene.needs.truncation).map(|meters| TruncationState {
                most: meters / scene.unit,
                max_row_norms: scene.shapes.par_iter().map(|shape| max_row_norms(&shape.modes)).collect(),
                domains: (0..scene.domains.len()).map(|domain| Truncation::new(scene.rank_of(domain))).collect(),
            });
        Self { scene: Arc::clone(scene), stored, truncation, halves: false }
    }

    /// The same for sums by tensor cores. U must be stored in 16 bits.
    pub fn with_products(self) -> Self {
        Self { halves: true, ..self }
    }

    /// Whether nothing is replaced. All such deformers share their bounds.
    pub fn is_exact(&self) -> bool {
        !self.stores() && !self.truncates()
    }

    /// Whether U is stored in another type than f32.
    pub fn stores(&self) -> bool {
        !self.stored.is_empty()
    }

    /// Whether modes may be truncated.
    pub fn truncates(&self) -> bool {
        self.truncation.is_some()
    }

    /// Resets the truncation history, so that the next state is decided independently.
    pub fn reset(&mut self) {
        if let Some(TruncationState { domains, .. }) = &mut self.truncation {
            domains.iter_mut().for_each(Truncation::reset);
        }
    }

    /// Advances truncation to a state: decides which modes are left out, given the previous states, as a deformer does.
    pub fn follow(&mut self, state: &SceneState) {
        let Self { scene, truncation, .. } = self;
        if let Some(TruncationState { most, max_row_norms, domains }) = truncation {
            domains.par_iter_mut().enumerate().with_min_len(64).for_each(|(domain, truncation)| {
                let max_row_norms = &max_row_norms[scene.domains[domain].shape];
                let norm = norm(&state.composed_transform(scene, domain));
                truncation.update(TruncationInput { q: state.q_of(scene, domain), max_row_norms, norm }, *most);
            });
        }
    }

    /// Stored U of a shape; `None` when it is stored in f32.
    pub(super) fn tiles(&self, shape: usize) -> Option<&TiledModes> {
        self.stored.get(shape).map(|(tiles, _)| tiles)
    }

    /// Zeroes the coordinates of a domain's truncated modes.
    pub(super) fn truncate<T: Default + Copy>(&self, domain: usize, q: &mut [T]) {
        if let Some(budget) = &self.truncation {
            let mut retained = vec![false; q.len()];
            budget.domains[domain].retained().iter().for_each(|mode| retained[usize::from(*mode)] = true);
            q.iter_mut().zip(retained).filter(|(_, retained)| !retained).for_each(|(q, _)| *q = T::default());
        }
    }

    /// Error bounds of a domain at a state.
    pub(super) fn bounds(&self, domain: usize, state: &SceneState) -> DomainErrorBounds<'_> {
        let mut q = state.q_of(&self.scene, domain).to_vec();
        self.truncate(domain, &mut q);
        let truncation = self.truncation.as_ref().map_or(0.0, |budget| budget.domains[domain].bound());
        let error_model = self.stored.get(self.scene.domains[domain].shape).map(|(_, error_model)| error_model);
        DomainErrorBounds {
            error_model,
            q,
            transform: state.composed_transform(&self.scene, domain),
            compensated: self.scene.deformation.compensated,
            truncation,
            products: self
                .halves
                .then(|| TensorCoreError::of(self.scene.deformation.storage, self.scene.rank_of(domain))),
        }
    }

    /// The packed coordinates as tensor cores read them, rounded to a pair of 16-bit numbers each; `None` when they are
    /// read in f32.
    pub(super) fn halved(&self, q: &[f64]) -> Option<Vec<f64>> {
        let own = |(domain, slot): (usize, &DomainLayout)| -> Vec<f64> {
            let factors = self.stored[self.scene.domains[domain].shape].0.factors();
            let amounts = q[slot.first_q..][..slot.rank].iter().zip(factors).map(|(q, factor)| *q as f32 * factor);
            let halves = SplitCoordinates::new(&amounts.collect::<Vec<_>>(), self.scene.deformation.storage);
            factors
                .iter()
                .enumerate()
                .map(|(mode, factor)| halves.decode_coordinate(mode) / f64::from(*factor))
                .collect()
        };
        let mut halved = q.to_vec();
        for (domain, slot) in self.scene.layout.slots.iter().enumerate().filter(|_| self.halves) {
            halved[slot.first_q..][..slot.rank].copy_from_slice(&own((domain, slot)));
        }
        self.halves.then_some(halved)
    }
}

/// The shapes of a scene in its storage type; empty for f32.
fn store(scene: &Scene) -> Vec<Stored> {
    let storage = scene.deformation.storage;
    let one = |shape| {
        let tiles = TiledModes::new(shape, storage);
        let error_model = ShapeErrorModel::new(shape, &tiles);
        (tiles, error_model)
    };
    match storage {
        StorageType::F32 => Vec::new(),
        _ => scene.shapes.par_iter().map(one).collect(),
    }
}

/// Cache of one scene under several deformations: variants with the same storage type share the stored U, and variants
/// with the same deformation share their scene.
#[derive(Debug)]
pub struct ErrorModelCache {
    scene: Arc<Scene>,
    scenes: Mutex<Vec<(DeformationSettings, Arc<Scene>)>>,
    stored: Mutex<Vec<(StorageType, Arc<Vec<Stored>>)>>,
}

impl ErrorModelCache {
    /// A cache that holds only the given scene.
    pub fn new(scene: &Arc<Scene>) -> Self {
        let scenes = Mutex::new(vec![(scene.deformation, Arc::clone(scene))]);
        Self { scene: Arc::clone(scene), scenes, stored: Mutex::default() }
    }

    /// The scene with another deformation.
    ///
    /// # Errors
    /// `Invalid` when the deformation's options contradict each other.
    pub fn scene(&self, deformation: DeformationSettings) -> Result<Arc<Scene>> {
        let mut scenes = self.scenes.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((_, known)) = scenes.iter().find(|(known, _)| *known == deformation) {
            return Ok(Arc::clone(known));
        }
        let made = with_deformation(&self.scene, deformation)?;
        scenes.push((deformation, Arc::clone(&made)));
        Ok(made)
    }

    /// The error model of a deformer of one of these scenes.
    pub fn error_model(&self, scene: &Arc<Scene>) -> ErrorModel {
        let storage = scene.deformation.storage;
        let mut known = self.stored.lock().unwrap_or_else(PoisonError::into_inner);
        let own = known.iter().find(|(known, _)| *known == storage).map(|(_, stored)| Arc::clone(stored));
        let stored = own.unwrap_or_else(|| {
            let made = Arc::new(store(scene));
            known.push((storage, Arc::clone(&made)));
            made
        });
        ErrorModel::with(scene, stored)
    }
}

/// A-priori bounds of one domain on the displacement caused by the replacements, in scene units.
pub(super) struct DomainErrorBounds<'a> {
    error_model: Option<&'a ShapeErrorModel>,
    q: Vec<f32>,
    transform: modalcast_model::domain::ComposedTransform,
    compensated: bool,
    truncation: f64,
    products: Option<TensorCoreError>,
}

impl DomainErrorBounds<'_> {
    /// Widens the bounds of consecutive vertices, from vertex `first` of the shape. On entry they hold `arithmetic`,
    /// the bound of a sum of all modes in f32.
    pub(super) fn widen<'b>(&self, first: usize, arithmetic: impl Iterator<Item = &'b mut f64>) {
        let step = ErrorBoundInput { q: &self.q, transform: self.transform, compensated: self.compensated };
        let mut known: Option<(usize, ErrorBound, f64)> = None;
        for (vertex, bound) in arithmetic.enumerate() {
            if let Some(error_model) = self.error_model {
                let tile = (first + vertex) / TILE;
                let look = || {
                    let products = self.products.map_or(0.0, |products| error_model.products(tile, &step, products));
                    (tile, error_model.tile(tile, &step), products)
                };
                let (_, own, products) = known.filter(|(at, ..)| *at == tile).unwrap_or_else(look);
                known = Some((tile, own, products));
                // Stored entries differ from U, so sums of them may be larger and round correspondingly more.
                let stored = (own.storage + own.coordinates) * (1.0 + 1e-4);
                *bound = (*bound + stored).min(own.total()) + products;
            }
            *bound += self.truncation;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::WorkloadMotion;
    use crate::workloads::{Size, WorkloadKind};

    fn model_and_state(deformation: DeformationSettings) -> (ErrorModel, SceneState) {
        let load = WorkloadKind::Single { power: 8, rank: 20 }.build(Size::Full).expect("built");
        let scene = with_deformation(&load.scene, deformation).expect("restated");
        (ErrorModel::of(&scene), WorkloadMotion::new(&load, None).seed(0).state())
    }

    #[test]
    fn default_deformation_replaces_nothing() {
        let (exact, state) = model_and_state(DeformationSettings::default());
        assert!(exact.is_exact() && exact.tiles(0).is_none());
        let mut bounds = [1.0, 2.0];
        exact.bounds(0, &state).widen(0, bounds.iter_mut());
        assert_eq!(bounds, [1.0, 2.0]);
    }

    #[test]
    fn variants_share_stored_u_by_storage_type() {
        let load = WorkloadKind::Single { power: 8, rank: 4 }.build(Size::Full).expect("built");
        let cache = ErrorModelCache::new(&load.scene);
        let half = DeformationSettings { storage: StorageType::F16, ..DeformationSettings::default() };
        let [one, two] = [half, half].map(|half| cache.scene(half).expect("restated"));
        assert!(Arc::ptr_eq(&one, &two) && !Arc::ptr_eq(&one, &load.scene));
        assert!(Arc::ptr_eq(&cache.scene(load.scene.deformation).expect("its own"), &load.scene));
        let short = cache.scene(DeformationSettings { truncation: Some(0.01), ..half }).expect("restated");
        let made = [&one, &short].map(|scene| cache.error_model(scene));
        assert!(Arc::ptr_eq(&made[0].stored, &made[1].stored) && made[0].stores());
        assert!(made[1].truncates() && !made[0].truncates());
        assert!(cache.error_model(&load.scene).is_exact());
    }

    #[test]
    fn coarser_storage_widens_bounds_more() {
        let widened = |storage| {
            let (stored, state) = model_and_state(DeformationSettings { storage, ..DeformationSettings::default() });
            assert!(!stored.is_exact() && stored.tiles(0).is_some());
            let mut bounds = [1e-6; 256];
            stored.bounds(0, &state).widen(0, bounds.iter_mut());
            bounds[200]
        };
        let [half, brain, eighth] = [StorageType::F16, StorageType::Bf16, StorageType::Int8].map(widened);
        assert!(1e-5 < half && half < brain && half < eighth, "{half} {brain} {eighth}");
    }

    #[test]
    fn tensor_cores_widen_bounds_and_round_q_to_two_halves() {
        let (stored, state) =
            model_and_state(DeformationSettings { storage: StorageType::Bf16, ..DeformationSettings::default() });
        let widened = |error_model: &ErrorModel| {
            let mut bounds = [1e-6];
            error_model.bounds(0, &state).widen(0, bounds.iter_mut());
            bounds[0]
        };
        let q: Vec<f64> = state.q.iter().map(|q| f64::from(*q)).collect();
        let before = widened(&stored);
        assert_eq!(stored.halved(&q), None);
        let products = stored.with_products();
        let after = widened(&products);
        assert!(before < after && after < 1.1 * before, "{before} {after}");
        let halved = products.halved(&q).expect("halves");
        let largest = q.iter().fold(0.0, |largest: f64, q| largest.max(q.abs()));
        let off = |of_own: f64| {
            let off = |(half, q): (&f64, &f64)| (half - q).abs() <= of_own * q.abs() + 1e-9 * largest;
            halved.iter().zip(&q).all(off)
        };
        assert!(off(2f64.powi(-16)) && !off(2f64.powi(-24)), "{halved:?} {q:?}");
    }

    #[test]
    fn truncates_small_modes_within_budget_after_first_state() {
        let (mut truncated, state) =
            model_and_state(DeformationSettings { truncation: Some(0.01), ..DeformationSettings::default() });
        let count = |error_model: &ErrorModel| {
            let mut q = state.q.clone();
            error_model.truncate(0, &mut q);
            q.iter().filter(|q| **q != 0.0).count()
        };
        assert_eq!(count(&truncated), 20);
        truncated.follow(&state);
        assert!((1..20).contains(&count(&truncated)), "{}", count(&truncated));
        let mut bounds = [0.0];
        truncated.bounds(0, &state).widen(0, bounds.iter_mut());
        assert!(bounds[0] > 0.0 && bounds[0] <= 0.01, "{bounds:?}");
    }
}
