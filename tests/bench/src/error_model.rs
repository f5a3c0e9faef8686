//! Error model of a deformer: the operands of x = T (x0 + U q) that the deformer approximates before it computes (U by
//! its storage type, q by 16-bit numbers), and a-priori bounds on the resulting error.

use std::sync::{Arc, Mutex, PoisonError};

use rayon::prelude::*;

use super::workloads::with_deformation;
use modalcast_compute::storage::bound::{ErrorBound, ErrorBoundInput, ShapeErrorModel};
use modalcast_compute::storage::{QUAD, SplitCoordinates, TILE_QUADS, TensorCoreError, TiledModes};
use modalcast_model::error::Result;
use modalcast_model::scene::{DeformationSettings, DomainLayout, Scene, SceneState, StorageType};

/// Vertices per tile of stored U. A quad is four consecutive vertices.
const TILE: usize = QUAD * TILE_QUADS;

/// The error model of one scene, derived from its deformation.
#[derive(Debug)]
pub struct ErrorModel {
    scene: Arc<Scene>,
    /// Stored U of each shape; empty when U is stored in f32.
    stored: Arc<Vec<StoredShape>>,
    /// Whether tensor cores compute U q. Each coordinate is then split into two 16-bit numbers.
    uses_tensor_cores: bool,
}

/// Stored U of one shape, and the data that its error bounds need.
#[derive(Debug)]
struct StoredShape {
    tiles: TiledModes,
    error_model: ShapeErrorModel,
}

impl ErrorModel {
    /// The error model of a deformer that follows this scene's deformation.
    pub fn of(scene: &Arc<Scene>) -> Self {
        Self::with_stored_shapes(scene, Arc::new(store_shapes(scene)))
    }

    fn with_stored_shapes(scene: &Arc<Scene>, stored: Arc<Vec<StoredShape>>) -> Self {
        Self { scene: Arc::clone(scene), stored, uses_tensor_cores: false }
    }

    /// This error model with sums computed by tensor cores. U must be stored in 16 bits.
    pub fn with_tensor_cores(self) -> Self {
        Self { uses_tensor_cores: true, ..self }
    }

    /// Whether no operand of x = T (x0 + U q) is approximated. All such deformers have the same bounds.
    pub fn is_exact(&self) -> bool {
        !self.has_stored_modes()
    }

    /// Whether U is stored in another type than f32.
    pub fn has_stored_modes(&self) -> bool {
        !self.stored.is_empty()
    }

    /// Stored U of a shape; `None` when it is stored in f32.
    pub(super) fn tiles(&self, shape: usize) -> Option<&TiledModes> {
        self.stored.get(shape).map(|stored| &stored.tiles)
    }

    /// Error bounds of a domain at a state.
    pub(super) fn bounds(&self, domain: usize, state: &SceneState) -> DomainErrorBounds<'_> {
        let error_model = self.stored.get(self.scene.domains[domain].shape).map(|stored| &stored.error_model);
        DomainErrorBounds {
            error_model,
            q: state.q_of(&self.scene, domain).to_vec(),
            transform: state.composed_transform(&self.scene, domain),
            compensated: self.scene.deformation.compensated,
            tensor_core_error: self
                .uses_tensor_cores
                .then(|| TensorCoreError::of(self.scene.deformation.storage, self.scene.rank_of(domain))),
        }
    }

    /// The packed coordinates as tensor cores read them: each one rounded to the sum of two 16-bit numbers. `None` when
    /// the deformer does not use tensor cores.
    pub(super) fn split_q(&self, q: &[f64]) -> Option<Vec<f64>> {
        if !self.uses_tensor_cores {
            return None;
        }
        let split_domain = |domain: usize, domain_layout: &DomainLayout| -> Vec<f64> {
            // U is stored divided by the factor of each mode, so tensor cores multiply it by q times the factor.
            let factors = self.stored[self.scene.domains[domain].shape].tiles.factors();
            let scaled_q = q[domain_layout.first_q..][..domain_layout.rank]
                .iter()
                .zip(factors)
                .map(|(q, factor)| *q as f32 * factor);
            let split = SplitCoordinates::new(&scaled_q.collect::<Vec<_>>(), self.scene.deformation.storage);
            factors
                .iter()
                .enumerate()
                .map(|(mode, factor)| split.decode_coordinate(mode) / f64::from(*factor))
                .collect()
        };
        let mut rounded_q = q.to_vec();
        for (domain, domain_layout) in self.scene.layout.domains.iter().enumerate() {
            rounded_q[domain_layout.first_q..][..domain_layout.rank]
                .copy_from_slice(&split_domain(domain, domain_layout));
        }
        Some(rounded_q)
    }
}

/// The shapes of a scene, stored in the scene's storage type; empty for f32.
fn store_shapes(scene: &Scene) -> Vec<StoredShape> {
    let storage = scene.deformation.storage;
    let store_shape = |shape| {
        let tiles = TiledModes::new(shape, storage);
        let error_model = ShapeErrorModel::new(shape, &tiles);
        StoredShape { tiles, error_model }
    };
    match storage {
        StorageType::F32 => Vec::new(),
        _ => scene.shapes.par_iter().map(store_shape).collect(),
    }
}

/// Cache of one scene with several deformations. Variants with the same storage type share the stored U, and variants
/// with the same deformation share the scene.
#[derive(Debug)]
pub struct ErrorModelCache {
    scene: Arc<Scene>,
    /// `scene` with each deformation that was requested so far.
    scenes: Mutex<Vec<(DeformationSettings, Arc<Scene>)>>,
    /// Stored U of each shape for each storage type that was requested so far.
    stored: Mutex<Vec<(StorageType, Arc<Vec<StoredShape>>)>>,
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
    /// As for [`Scene::new`].
    pub fn scene(&self, deformation: DeformationSettings) -> Result<Arc<Scene>> {
        let mut scenes = self.scenes.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((_, scene)) = scenes.iter().find(|(cached, _)| *cached == deformation) {
            return Ok(Arc::clone(scene));
        }
        let scene = with_deformation(&self.scene, deformation)?;
        scenes.push((deformation, Arc::clone(&scene)));
        Ok(scene)
    }

    /// The error model of a deformer of a scene from [`Self::scene`].
    pub fn error_model(&self, scene: &Arc<Scene>) -> ErrorModel {
        let storage = scene.deformation.storage;
        let mut cached = self.stored.lock().unwrap_or_else(PoisonError::into_inner);
        let found = cached.iter().find(|(cached, _)| *cached == storage).map(|(_, stored)| Arc::clone(stored));
        let stored = found.unwrap_or_else(|| {
            let stored = Arc::new(store_shapes(scene));
            cached.push((storage, Arc::clone(&stored)));
            stored
        });
        ErrorModel::with_stored_shapes(scene, stored)
    }
}

/// A-priori bounds on the errors of one domain's vertices by the approximations of an [`ErrorModel`], in scene units.
pub(super) struct DomainErrorBounds<'a> {
    error_model: Option<&'a ShapeErrorModel>,
    q: Vec<f32>,
    transform: modalcast_model::domain::ComposedTransform,
    compensated: bool,
    /// Relative errors of tensor cores; `None` if the deformer does not use them.
    tensor_core_error: Option<TensorCoreError>,
}

impl DomainErrorBounds<'_> {
    /// Widens the bounds of consecutive vertices, from vertex `first` of the shape. On entry, `bounds` holds the bounds
    /// of a sum of all modes in f32.
    pub(super) fn widen_bounds<'b>(&self, first: usize, bounds: impl Iterator<Item = &'b mut f64>) {
        let Some(error_model) = self.error_model else { return };
        let input = ErrorBoundInput { q: &self.q, transform: self.transform, compensated: self.compensated };
        // The tile evaluated last, its bounds, and the bound of its tensor core errors.
        let mut cached: Option<(usize, ErrorBound, f64)> = None;
        for (vertex, bound) in bounds.enumerate() {
            let tile = (first + vertex) / TILE;
            let evaluate_tile = || {
                let tensor_core_bound =
                    self.tensor_core_error.map_or(0.0, |error| error_model.tensor_core_bound(tile, &input, error));
                (tile, error_model.tile_bound(tile, &input), tensor_core_bound)
            };
            let (_, tile_bound, tensor_core_bound) =
                cached.filter(|(cached_tile, ..)| *cached_tile == tile).unwrap_or_else(evaluate_tile);
            cached = Some((tile, tile_bound, tensor_core_bound));
            // Rounding errors of the sum grow with the stored entries. 1e-4 exceeds their relative growth: 512 modes,
            // the maximum, have about 520 roundings of 6e-8 each, 3e-5 in total.
            let stored = (tile_bound.storage + tile_bound.coordinates) * (1.0 + 1e-4);
            // The total of the tile also bounds the error of each vertex. The smaller of the two bounds is used.
            *bound = (*bound + stored).min(tile_bound.total()) + tensor_core_bound;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::WorkloadMotion;
    use crate::workloads::{Size, WorkloadKind};

    fn model_and_state(deformation: DeformationSettings) -> (ErrorModel, SceneState) {
        let workload = WorkloadKind::Single { power: 8, rank: 20 }.build(Size::Full).expect("expected a load");
        let scene = with_deformation(&workload.scene, deformation).expect("expected a scene");
        (ErrorModel::of(&scene), WorkloadMotion::new(&workload, None).random_state(0).state())
    }

    #[test]
    fn default_deformation_approximates_nothing() {
        let (exact, state) = model_and_state(DeformationSettings::default());
        assert!(exact.is_exact() && exact.tiles(0).is_none());
        let mut bounds = [1.0, 2.0];
        exact.bounds(0, &state).widen_bounds(0, bounds.iter_mut());
        assert_eq!(bounds, [1.0, 2.0]);
    }

    #[test]
    fn variants_share_stored_u_by_storage_type() {
        let workload = WorkloadKind::Single { power: 8, rank: 4 }.build(Size::Full).expect("expected a load");
        let cache = ErrorModelCache::new(&workload.scene);
        let f16 = DeformationSettings { storage: StorageType::F16, ..DeformationSettings::default() };
        let [first, second] = [f16, f16].map(|f16| cache.scene(f16).expect("expected a scene"));
        assert!(Arc::ptr_eq(&first, &second) && !Arc::ptr_eq(&first, &workload.scene));
        assert!(Arc::ptr_eq(
            &cache.scene(workload.scene.deformation).expect("expected the cached scene"),
            &workload.scene
        ));
        let compensated = cache.scene(DeformationSettings { compensated: true, ..f16 }).expect("expected a scene");
        let models = [&first, &compensated].map(|scene| cache.error_model(scene));
        assert!(Arc::ptr_eq(&models[0].stored, &models[1].stored) && models[0].has_stored_modes());
        assert!(!Arc::ptr_eq(&models[0].scene, &models[1].scene));
        assert!(cache.error_model(&workload.scene).is_exact());
    }

    #[test]
    fn coarser_storage_widens_bounds_more() {
        let widened_bound = |storage| {
            let (stored, state) = model_and_state(DeformationSettings { storage, ..DeformationSettings::default() });
            assert!(!stored.is_exact() && stored.tiles(0).is_some());
            let mut bounds = [1e-6; 256];
            stored.bounds(0, &state).widen_bounds(0, bounds.iter_mut());
            bounds[200]
        };
        let [f16_bound, bf16_bound, int8_bound] =
            [StorageType::F16, StorageType::Bf16, StorageType::Int8].map(widened_bound);
        // The bound of f16 exceeds ten times the initial bound.
        assert!(
            1e-5 < f16_bound && f16_bound < bf16_bound && f16_bound < int8_bound,
            "{f16_bound} {bf16_bound} {int8_bound}"
        );
    }

    #[test]
    fn tensor_cores_widen_bounds_and_round_q_to_two_bf16() {
        let (stored, state) =
            model_and_state(DeformationSettings { storage: StorageType::Bf16, ..DeformationSettings::default() });
        let widened_bound = |error_model: &ErrorModel| {
            let mut bounds = [1e-6];
            error_model.bounds(0, &state).widen_bounds(0, bounds.iter_mut());
            bounds[0]
        };
        let q: Vec<f64> = state.q.iter().map(|q| f64::from(*q)).collect();
        let storage_bound = widened_bound(&stored);
        assert_eq!(stored.split_q(&q), None);
        let tensor_core_model = stored.with_tensor_cores();
        let tensor_core_bound = widened_bound(&tensor_core_model);
        // Storage in bf16 has a much larger error than tensor cores.
        assert!(
            storage_bound < tensor_core_bound && tensor_core_bound < 1.1 * storage_bound,
            "{storage_bound} {tensor_core_bound}"
        );
        let rounded_q = tensor_core_model.split_q(&q).expect("expected rounded coordinates");
        let max_q = q.iter().fold(0.0, |max_q: f64, q| max_q.max(q.abs()));
        let is_within = |relative_error: f64| {
            // 1e-9 of the largest coordinate allows for underflow of small coordinates.
            let is_close = |(rounded, q): (&f64, &f64)| (rounded - q).abs() <= relative_error * q.abs() + 1e-9 * max_q;
            rounded_q.iter().zip(&q).all(is_close)
        };
        // Two bf16 of 8 bits each represent 16 bits, fewer than the 24 bits of f32.
        assert!(is_within(2f64.powi(-16)) && !is_within(2f64.powi(-24)), "{rounded_q:?} {q:?}");
    }
}
