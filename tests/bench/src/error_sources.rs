//! Splits the error of a variant into its sources. Each approximation of x = T (x0 + U q) is applied alone, with
//! everything else exact in f64.

use std::sync::{Arc, Mutex, PoisonError};

use rayon::prelude::*;
use serde::Serialize;

use super::error_model::ErrorModel;
use super::errors::{ErrorNorms, NormAccumulator, reduce_parallel, select};
use super::exact_positions::positions;
use super::exact_state::ExactState;
use modalcast_model::scene::{Scene, SceneState, StorageType};

/// Position errors by each source alone, meters.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct ErrorSources {
    /// Storage of U: decoded entries instead of the exact ones.
    pub storage: ErrorNorms,
    /// Rounding of q to f32, and to pairs of 16-bit numbers for tensor cores.
    pub q: ErrorNorms,
    /// The f32 arithmetic of the deformer: the sum of modes, x0 and T, except for the final rounding of the position.
    pub accumulation: ErrorNorms,
    /// T rounded to f32.
    pub transform: ErrorNorms,
    /// The final rounding of the position itself, which grows with the distance from the scene's origin.
    pub origin: ErrorNorms,
}

/// Positions that a variant computed.
#[derive(Debug, Clone, Copy)]
pub(super) struct ComputedPositions<'a> {
    /// Three f32 per computed vertex.
    pub positions: &'a [f32],
    /// Indices of the computed vertices; `None` if these are all vertices.
    pub vertices: Option<&'a [u32]>,
}

/// Accumulators of the five sources, in the order of [`ErrorSources`].
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct ErrorSourcesAccumulator([NormAccumulator; 5]);

/// Reference positions of one exact state, which all variants share.
#[derive(Debug)]
pub(super) struct SharedErrorSources {
    /// The exact state.
    truth: ExactState,
    /// The exact state rounded to f32.
    rounded: ExactState,
    /// Positions of the exact state.
    exact_positions: Vec<[f64; 3]>,
    /// Error from rounding q alone.
    q_norms: NormAccumulator,
    /// Error from rounding T alone.
    transform_norms: NormAccumulator,
    /// Positions with q and T rounded to f32, and U exact.
    rounded_positions: Vec<[f64; 3]>,
    /// Errors of the storage types that variants have requested so far.
    storage_errors: Mutex<Vec<(StorageType, Arc<StorageError>)>>,
}

/// Error and positions of one storage type. All variants with this storage type share them.
#[derive(Debug)]
struct StorageError {
    /// Error of the storage alone.
    norms: NormAccumulator,
    /// Positions with q and T rounded to f32 and U as stored.
    positions: Vec<[f64; 3]>,
}

impl SharedErrorSources {
    /// Evaluates an exact state and `state`, its rounding to f32, in f64.
    pub(super) fn new(scene: &Scene, truth: ExactState, state: &SceneState) -> Self {
        let rounded = ExactState::of(state);
        let positions_of = |q: &[f64], transforms: &[[f64; 12]]| positions_at(scene, q, transforms, None);
        let exact_positions = positions_of(&truth.q, &truth.transforms);
        let q_norms = distances(&exact_positions, &positions_of(&rounded.q, &truth.transforms));
        let transform_norms = distances(&exact_positions, &positions_of(&truth.q, &rounded.transforms));
        let rounded_positions = positions_of(&rounded.q, &rounded.transforms);
        let storage_errors = Mutex::default();
        Self { truth, rounded, exact_positions, q_norms, transform_norms, rounded_positions, storage_errors }
    }

    /// The error of a variant's storage type, computed at the first request.
    fn storage_error(&self, scene: &Scene, error_model: &ErrorModel) -> Arc<StorageError> {
        let (storage, mut cached) =
            (scene.deformation.storage, self.storage_errors.lock().unwrap_or_else(PoisonError::into_inner));
        if let Some((_, stored)) = cached.iter().find(|(cached_storage, _)| *cached_storage == storage) {
            return Arc::clone(stored);
        }
        let positions_of = |truth: &ExactState| positions(scene, truth, Some(error_model));
        let norms = distances(&self.exact_positions, &positions_of(&self.truth));
        let stored = Arc::new(StorageError { norms, positions: positions_of(&self.rounded) });
        cached.push((storage, Arc::clone(&stored)));
        stored
    }

    /// Adds the sources of a variant's error at this state. Those of the arithmetic are of the vertices in `got`, the
    /// others of all vertices.
    pub(super) fn add_sources(
        &self,
        scene: &Scene,
        error_model: &ErrorModel,
        got: ComputedPositions<'_>,
        accumulator: &mut ErrorSourcesAccumulator,
    ) {
        let storage = Some(error_model).filter(|error_model| error_model.has_stored_modes());
        let stored = storage.map(|error_model| self.storage_error(scene, error_model));
        // A source that moves no vertex contributes a zero for each vertex.
        let zero_norms = distances(&self.exact_positions, &self.exact_positions);
        let storage_norms = stored.as_ref().map_or(zero_norms, |stored| stored.norms);
        let split_q = error_model.split_q(&self.rounded.q);
        let error_from_q =
            |q: &Vec<f64>| distances(&self.exact_positions, &positions_at(scene, q, &self.truth.transforms, None));
        let q_norms = split_q.as_ref().map_or(self.q_norms, error_from_q);
        // Positions with all approximations except f32 arithmetic. Only variants that split q need positions of their
        // own.
        let own_positions = split_q.as_ref().map(|q| positions_at(scene, q, &self.rounded.transforms, storage));
        let approximate_positions = own_positions
            .as_ref()
            .or(stored.as_ref().map(|stored| &stored.positions))
            .unwrap_or(&self.rounded_positions);
        let rounded: Vec<[f64; 3]> =
            approximate_positions.par_iter().map(|position| position.map(|number| f64::from(number as f32))).collect();
        let got_positions = got.positions.as_chunks::<3>().0;
        let got_positions: Vec<[f64; 3]> = got_positions.par_iter().map(|position| position.map(f64::from)).collect();
        let arithmetic_norms = match got.vertices {
            None => distances(&rounded, &got_positions),
            Some(vertices) => distances(&select(&rounded, vertices), &got_positions),
        };
        let norms = [
            storage_norms,
            q_norms,
            arithmetic_norms,
            self.transform_norms,
            distances(approximate_positions, &rounded),
        ];
        accumulator.0.iter_mut().zip(norms).for_each(|(sum, norms)| *sum = sum.join(norms));
    }
}

impl ErrorSourcesAccumulator {
    /// The accumulated sources in meters; `unit` is meters per scene unit.
    pub(super) fn sources(&self, unit: f64) -> ErrorSources {
        let [storage, q, accumulation, transform, origin] = self.0.map(|norms| norms.norms(unit).unwrap_or_default());
        ErrorSources { storage, q, accumulation, transform, origin }
    }
}

/// Positions of these coordinates and transforms; with `storage`, U is as this model stores it.
fn positions_at(scene: &Scene, q: &[f64], transforms: &[[f64; 12]], storage: Option<&ErrorModel>) -> Vec<[f64; 3]> {
    positions(scene, &ExactState { q: q.to_vec(), transforms: transforms.to_vec() }, storage)
}

/// Norms of the distances between corresponding positions.
fn distances(first: &[[f64; 3]], second: &[[f64; 3]]) -> NormAccumulator {
    let distance = |vertex: usize| {
        let square: f64 =
            first[vertex].iter().zip(second[vertex]).map(|(first, second)| (first - second).powi(2)).sum();
        square.sqrt()
    };
    reduce_parallel(
        first.len().min(second.len()),
        |vertex, norms: &mut NormAccumulator| norms.add(distance(vertex)),
        NormAccumulator::join,
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::WorkloadMotion;
    use crate::workloads::{Size, Workload, WorkloadKind, with_deformation};
    use modalcast_model::scene::{DeformationSettings, StorageType};

    fn load() -> Workload {
        WorkloadKind::Single { power: 8, rank: 2 }.build(Size::Full).expect("expected a load")
    }

    /// The sources of the error of the positions `got`. Without `got`, those of a variant that computes in f64 and
    /// rounds only its positions.
    fn measure(deformation: DeformationSettings, truth: &ExactState, got: Option<&[f32]>) -> ErrorSources {
        let (scene, state) = (with_deformation(&load().scene, deformation).expect("expected a scene"), truth.state());
        let error_model = ErrorModel::of(&scene);
        let emulated = positions(&scene, &ExactState::of(&state), Some(&error_model));
        let emulated: Vec<f32> = emulated.as_flattened().iter().map(|number| *number as f32).collect();
        let mut accumulator = ErrorSourcesAccumulator::default();
        SharedErrorSources::new(&scene, truth.clone(), &state).add_sources(
            &scene,
            &error_model,
            ComputedPositions { positions: got.unwrap_or(&emulated), vertices: None },
            &mut accumulator,
        );
        accumulator.sources(1.0)
    }

    /// A state whose numbers f32 represents exactly, so that rounding moves no vertex.
    fn representable_truth() -> ExactState {
        let identity = modalcast_model::domain::Transform::IDENTITY.0.map(f64::from);
        ExactState { q: vec![1.0, 0.5], transforms: vec![identity] }
    }

    #[test]
    fn measures_each_source_alone() {
        let default = DeformationSettings::default;
        let sources = measure(default(), &representable_truth(), None);
        assert_eq!([sources.storage, sources.q, sources.accumulation, sources.transform], [ErrorNorms::default(); 4]);
        assert!(sources.origin.largest > 0.0 && sources.origin.largest < 1e-6);
        // 1 + 2^-30 is 1 in f32. Entries of U are at most 1, so a vertex moves by at most 2^-30 sqrt(3) = 1.6e-9.
        let sources =
            measure(default(), &ExactState { q: vec![1.0 + 2f64.powi(-30), 0.5], ..representable_truth() }, None);
        assert!(
            sources.q.largest > 1e-10 && sources.q.largest < 2e-9 && sources.transform.largest == 0.0,
            "{sources:?}"
        );
        let rotated = ExactState {
            transforms: WorkloadMotion::new(&load(), None).random_state(0).transforms,
            ..representable_truth()
        };
        let sources = measure(default(), &rotated, None);
        assert!(sources.transform.largest > 1e-9 && sources.q.largest == 0.0, "{sources:?}");
        let sources =
            measure(DeformationSettings { storage: StorageType::Int8, ..default() }, &representable_truth(), None);
        // int8 stores entries of at most 1 with errors of at most 0.5 / 127. The coordinates add up to 1.5, and errors
        // on three axes have a length of at most sqrt(3) < 1.74 times each of them.
        assert!(sources.storage.largest > 1e-3 && sources.storage.largest < 0.5 / 127.0 * 1.5 * 1.74, "{sources:?}");
        assert_eq!(sources.accumulation, ErrorNorms::default());
    }

    #[test]
    fn counts_unexplained_error_as_accumulation() {
        // The load has 2^8 = 256 vertices near the origin, so positions of (1e3, 1e3, 1e3) are wrong by about as much.
        let got = vec![1e3_f32; 3 * 256];
        let sources =
            measure(DeformationSettings::default(), &WorkloadMotion::new(&load(), None).random_state(0), Some(&got));
        assert!(sources.accumulation.largest > 1e3, "{sources:?}");
        assert!(sources.origin.largest < 1e-6);
    }
}
