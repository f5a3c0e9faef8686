//! Splits an error into its sources: each term of x = T (x0 + U q) is exchanged alone, with everything else exact in
//! f64.

use std::sync::{Arc, Mutex, PoisonError};

use rayon::prelude::*;
use serde::Serialize;

use super::error_model::ErrorModel;
use super::errors::{ErrorNorms, NormAccumulator, in_pieces};
use super::exact_positions::{ErrorModelTerms, positions};
use super::exact_state::ExactState;
use modalcast_model::scene::{Scene, SceneState, StorageType};

/// Displacement of a vertex by each source alone, meters.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct ErrorSources {
    /// Storage of U: decoded stored entries instead of U.
    pub storage: ErrorNorms,
    /// q rounded to f32 instead of the f64 of the physics process, and to pairs of 16-bit numbers where tensor cores
    /// multiply.
    pub q: ErrorNorms,
    /// The deformer's own f32 arithmetic: the sum over the modes, x0 and T, beyond one final rounding.
    pub accumulation: ErrorNorms,
    /// T rounded to f32.
    pub transform: ErrorNorms,
    /// The final rounding of the position itself, which grows with the distance from the scene's origin.
    pub origin: ErrorNorms,
    /// Truncated modes.
    pub truncation: ErrorNorms,
}

/// Accumulators of the six sources, in the order of [`ErrorSources`].
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct ErrorSourcesAccumulator([NormAccumulator; 6]);

/// Reference positions of one truth that all variants share.
#[derive(Debug)]
pub(super) struct SharedErrorSources {
    truth: ExactState,
    given: ExactState,
    exact: Vec<[f64; 3]>,
    q: NormAccumulator,
    transform: NormAccumulator,
    /// Positions with q and T rounded to f32, U exact and all modes.
    plain: Vec<[f64; 3]>,
    /// Per storage type that a variant has requested so far.
    stored: Mutex<Vec<(StorageType, Arc<StorageError>)>>,
}

/// Positions that variants of one storage type without truncation share.
#[derive(Debug)]
struct StorageError {
    alone: NormAccumulator,
    /// Positions with q and T rounded to f32.
    own: Vec<[f64; 3]>,
}

impl SharedErrorSources {
    /// Evaluates a truth and its rounding to f32 in f64.
    pub(super) fn new(scene: &Scene, truth: ExactState, state: &SceneState) -> Self {
        let given = ExactState::of(state);
        let at = |q: &[f64], transforms: &[[f64; 12]]| {
            positions(scene, &ExactState { q: q.to_vec(), transforms: transforms.to_vec() }, ErrorModelTerms::default())
        };
        let exact = at(&truth.q, &truth.transforms);
        let q = apart(&exact, &at(&given.q, &truth.transforms));
        let transform = apart(&exact, &at(&truth.q, &given.transforms));
        let plain = at(&given.q, &given.transforms);
        Self { truth, given, exact, q, transform, plain, stored: Mutex::default() }
    }

    fn stored(&self, scene: &Scene, error_model: &ErrorModel) -> Arc<StorageError> {
        let (storage, mut known) =
            (scene.deformation.storage, self.stored.lock().unwrap_or_else(PoisonError::into_inner));
        if let Some((_, stored)) = known.iter().find(|(known, _)| *known == storage) {
            return Arc::clone(stored);
        }
        let take = ErrorModelTerms { storage: Some(error_model), truncation: None };
        let alone = apart(&self.exact, &positions(scene, &self.truth, take));
        let stored = Arc::new(StorageError { alone, own: positions(scene, &self.given, take) });
        known.push((storage, Arc::clone(&stored)));
        stored
    }

    /// Adds the sources of a variant's error at this truth. `got`: its positions, three f32 per vertex.
    pub(super) fn split(
        &self,
        scene: &Scene,
        error_model: &ErrorModel,
        got: &[f32],
        split: &mut ErrorSourcesAccumulator,
    ) {
        let storage = Some(error_model).filter(|error_model| error_model.stores());
        let truncation = Some(error_model).filter(|error_model| error_model.truncates());
        let stored = storage.map(|error_model| self.stored(scene, error_model));
        // Every source counts all vertices, even if it moves none of them.
        let none = apart(&self.exact, &self.exact);
        let from_storage = stored.as_ref().map_or(none, |stored| stored.alone);
        // Truncation was decided from the rounded q; applying it to the unrounded q hardly changes the displacement.
        let cut = ErrorModelTerms { storage: None, truncation };
        let from_truncation = truncation.map_or(none, |_| apart(&self.exact, &positions(scene, &self.truth, cut)));
        let halved = error_model.halved(&self.given.q);
        let with = |q: &[f64], transforms: &[[f64; 12]], take: ErrorModelTerms<'_>| {
            positions(scene, &ExactState { q: q.to_vec(), transforms: transforms.to_vec() }, take)
        };
        let exact_but = |q: &Vec<f64>| apart(&self.exact, &with(q, &self.truth.transforms, ErrorModelTerms::default()));
        let from_q = halved.as_ref().map_or(self.q, exact_but);
        let q = halved.as_ref().unwrap_or(&self.given.q);
        let otherwise = truncation.is_some() || halved.is_some();
        let other = otherwise.then(|| with(q, &self.given.transforms, ErrorModelTerms { storage, truncation }));
        let own = other.as_ref().or(stored.as_ref().map(|stored| &stored.own)).unwrap_or(&self.plain);
        let rounded: Vec<[f64; 3]> = own.par_iter().map(|at| at.map(|number| f64::from(number as f32))).collect();
        let got: Vec<[f64; 3]> = got.as_chunks::<3>().0.par_iter().map(|at| at.map(f64::from)).collect();
        let parts =
            [from_storage, from_q, apart(&rounded, &got), self.transform, apart(own, &rounded), from_truncation];
        split.0.iter_mut().zip(parts).for_each(|(sum, part)| *sum = sum.join(part));
    }
}

impl ErrorSourcesAccumulator {
    /// The accumulated sources in meters; `unit` is meters per scene unit.
    pub(super) fn sources(&self, unit: f64) -> ErrorSources {
        let [storage, q, accumulation, transform, origin, truncation] =
            self.0.map(|collect| collect.spread(unit).unwrap_or_default());
        ErrorSources { storage, q, accumulation, transform, origin, truncation }
    }
}

fn apart(one: &[[f64; 3]], other: &[[f64; 3]]) -> NormAccumulator {
    let length = |at: usize| {
        let square: f64 = one[at].iter().zip(other[at]).map(|(one, other)| (one - other).powi(2)).sum();
        square.sqrt()
    };
    in_pieces(one.len().min(other.len()), |at, sum: &mut NormAccumulator| sum.add(length(at)), NormAccumulator::join)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::WorkloadMotion;
    use crate::workloads::{Size, Workload, WorkloadKind, with_deformation};
    use modalcast_model::scene::{DeformationSettings, StorageType};

    fn load() -> Workload {
        WorkloadKind::Single { power: 8, rank: 2 }.build(Size::Full).expect("built")
    }

    fn split(deformation: DeformationSettings, truth: &ExactState, got: Option<&[f32]>) -> ErrorSources {
        let (scene, state) = (with_deformation(&load().scene, deformation).expect("restated"), truth.state());
        let mut error_model = ErrorModel::of(&scene);
        error_model.follow(&state);
        let all = ErrorModelTerms { storage: Some(&error_model), truncation: Some(&error_model) };
        let perfect = positions(&scene, &ExactState::of(&state), all);
        let perfect: Vec<f32> = perfect.as_flattened().iter().map(|number| *number as f32).collect();
        let mut split = ErrorSourcesAccumulator::default();
        SharedErrorSources::new(&scene, truth.clone(), &state).split(
            &scene,
            &error_model,
            got.unwrap_or(&perfect),
            &mut split,
        );
        split.sources(1.0)
    }

    /// A truth whose numbers f32 represents exactly, so that rounding moves nothing.
    fn even() -> ExactState {
        let identity = modalcast_model::domain::Transform::IDENTITY.0.map(f64::from);
        ExactState { q: vec![1.0, 0.5], transforms: vec![identity] }
    }

    #[test]
    fn measures_each_source_alone() {
        let plain = DeformationSettings::default;
        let none = split(plain(), &even(), None);
        assert!(
            [none.storage, none.q, none.accumulation, none.transform, none.truncation] == [ErrorNorms::default(); 5]
        );
        assert!(none.origin.largest > 0.0 && none.origin.largest < 1e-6);
        let found = split(plain(), &ExactState { q: vec![1.0 + 2f64.powi(-30), 0.5], ..even() }, None);
        assert!(found.q.largest > 1e-10 && found.q.largest < 2e-9 && found.transform.largest == 0.0, "{found:?}");
        let turned = ExactState { transforms: WorkloadMotion::new(&load(), None).seed(0).transforms, ..even() };
        let found = split(plain(), &turned, None);
        assert!(found.transform.largest > 1e-9 && found.q.largest == 0.0, "{found:?}");
        let found = split(DeformationSettings { storage: StorageType::Int8, ..plain() }, &even(), None);
        // Half a step of 1/127 on each axis for coordinates of 1.5 together, at most.
        assert!(found.storage.largest > 1e-3 && found.storage.largest < 0.5 / 127.0 * 1.5 * 1.74, "{found:?}");
        assert_eq!([found.accumulation, found.truncation], [ErrorNorms::default(); 2]);
        // Mode 1 moves vertices by up to 0.5 sqrt(3). A mode is truncated if it moves no vertex by half the budget.
        let found = split(DeformationSettings { truncation: Some(1.75), ..plain() }, &even(), None);
        assert!(found.truncation.largest > 0.5 && found.truncation.largest <= 0.87, "{found:?}");
        assert_eq!([found.accumulation, found.storage], [ErrorNorms::default(); 2]);
    }

    #[test]
    fn counts_unexplained_error_as_accumulation() {
        let got = vec![1e3_f32; 3 * 256];
        let found = split(DeformationSettings::default(), &WorkloadMotion::new(&load(), None).seed(0), Some(&got));
        assert!(found.accumulation.largest > 1e3, "{found:?}");
        assert!(found.origin.largest < 1e-6);
    }
}
