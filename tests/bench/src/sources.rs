//! Where an error comes from: each ingredient of x = T (x0 + U q) exchanged alone, all else exact in f64.

use std::sync::{Arc, Mutex, PoisonError};

use rayon::prelude::*;
use serde::Serialize;

use super::errors::{Collect, Spread, in_pieces};
use super::exact::{Take, positions};
use super::ingredients::Ingredients;
use super::motion::Truth;
use modalcast_model::scene::{Scene, State, Storage};

/// What each source alone moves a vertex by, metres.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Sources {
    /// U as it is stored, decoded, instead of U.
    pub storage: Spread,
    /// q rounded to f32 instead of the f64 of the physics process, and to what tensor cores take where they multiply.
    pub q: Spread,
    /// What the deformer's own arithmetic adds: the sum over the modes, x0 and T, all in f32, beyond one rounding.
    pub accumulation: Spread,
    /// T rounded to f32.
    pub transform: Spread,
    /// The one rounding of the position itself, which grows with its distance from the scene's origin.
    pub origin: Spread,
    /// The modes that are left out.
    pub truncation: Spread,
}

/// The six sources while they are collected, in the order of [`Sources`].
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Split([Collect; 6]);

/// What the sources of one truth have in common, whatever the variant.
#[derive(Debug)]
pub(super) struct Origin {
    truth: Truth,
    given: Truth,
    exact: Vec<[f64; 3]>,
    q: Collect,
    transform: Collect,
    /// With q and T as given, U exact and no mode left out.
    plain: Vec<[f64; 3]>,
    /// Of the storage types that variants have asked for.
    stored: Mutex<Vec<(Storage, Arc<Stored>)>>,
}

/// What all variants have in common that store U in one type and leave out no mode.
#[derive(Debug)]
struct Stored {
    alone: Collect,
    /// With q and T as given.
    own: Vec<[f64; 3]>,
}

impl Origin {
    /// What a truth and its rounding give in f64.
    pub(super) fn new(scene: &Scene, truth: Truth, state: &State) -> Self {
        let given = Truth::of(state);
        let at = |q: &[f64], transforms: &[[f64; 12]]| {
            positions(scene, &Truth { q: q.to_vec(), transforms: transforms.to_vec() }, Take::default())
        };
        let exact = at(&truth.q, &truth.transforms);
        let q = apart(&exact, &at(&given.q, &truth.transforms));
        let transform = apart(&exact, &at(&truth.q, &given.transforms));
        let plain = at(&given.q, &given.transforms);
        Self { truth, given, exact, q, transform, plain, stored: Mutex::default() }
    }

    fn stored(&self, scene: &Scene, ingredients: &Ingredients) -> Arc<Stored> {
        let (storage, mut known) =
            (scene.deformation.storage, self.stored.lock().unwrap_or_else(PoisonError::into_inner));
        if let Some((_, stored)) = known.iter().find(|(known, _)| *known == storage) {
            return Arc::clone(stored);
        }
        let take = Take { storage: Some(ingredients), truncation: None };
        let alone = apart(&self.exact, &positions(scene, &self.truth, take));
        let stored = Arc::new(Stored { alone, own: positions(scene, &self.given, take) });
        known.push((storage, Arc::clone(&stored)));
        stored
    }

    /// Adds what a variant made of it.
    pub(super) fn split(&self, scene: &Scene, ingredients: &Ingredients, got: &[f32], split: &mut Split) {
        let storage = Some(ingredients).filter(|ingredients| ingredients.stores());
        let truncation = Some(ingredients).filter(|ingredients| ingredients.truncates());
        let stored = storage.map(|ingredients| self.stored(scene, ingredients));
        // Every source counts all vertices, also one that moves none.
        let none = apart(&self.exact, &self.exact);
        let from_storage = stored.as_ref().map_or(none, |stored| stored.alone);
        // Which modes are left out depends on what the deformer was given; their sizes hardly do.
        let cut = Take { storage: None, truncation };
        let from_truncation = truncation.map_or(none, |_| apart(&self.exact, &positions(scene, &self.truth, cut)));
        let halved = ingredients.halved(&self.given.q);
        let with = |q: &[f64], transforms: &[[f64; 12]], take: Take<'_>| {
            positions(scene, &Truth { q: q.to_vec(), transforms: transforms.to_vec() }, take)
        };
        let exact_but = |q: &Vec<f64>| apart(&self.exact, &with(q, &self.truth.transforms, Take::default()));
        let from_q = halved.as_ref().map_or(self.q, exact_but);
        let q = halved.as_ref().unwrap_or(&self.given.q);
        let otherwise = truncation.is_some() || halved.is_some();
        let other = otherwise.then(|| with(q, &self.given.transforms, Take { storage, truncation }));
        let own = other.as_ref().or(stored.as_ref().map(|stored| &stored.own)).unwrap_or(&self.plain);
        let rounded: Vec<[f64; 3]> = own.par_iter().map(|at| at.map(|number| f64::from(number as f32))).collect();
        let got: Vec<[f64; 3]> = got.as_chunks::<3>().0.par_iter().map(|at| at.map(f64::from)).collect();
        let parts =
            [from_storage, from_q, apart(&rounded, &got), self.transform, apart(own, &rounded), from_truncation];
        split.0.iter_mut().zip(parts).for_each(|(sum, part)| *sum = sum.join(part));
    }
}

impl Split {
    /// What was collected, in metres.
    pub(super) fn sources(&self, unit: f64) -> Sources {
        let [storage, q, accumulation, transform, origin, truncation] =
            self.0.map(|collect| collect.spread(unit).unwrap_or_default());
        Sources { storage, q, accumulation, transform, origin, truncation }
    }
}

fn apart(one: &[[f64; 3]], other: &[[f64; 3]]) -> Collect {
    let length = |at: usize| {
        let square: f64 = one[at].iter().zip(other[at]).map(|(one, other)| (one - other).powi(2)).sum();
        square.sqrt()
    };
    in_pieces(one.len().min(other.len()), |at, sum: &mut Collect| sum.add(length(at)), Collect::join)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::loads::{Kind, Load, Size, restated};
    use crate::motion::Motion;
    use modalcast_model::scene::{Deformation, Storage};

    fn load() -> Load {
        Kind::Single { power: 8, rank: 2 }.build(Size::Full).expect("built")
    }

    fn split(deformation: Deformation, truth: &Truth, got: Option<&[f32]>) -> Sources {
        let (scene, state) = (restated(&load().scene, deformation).expect("restated"), truth.state());
        let mut ingredients = Ingredients::of(&scene);
        ingredients.follow(&state);
        let all = Take { storage: Some(&ingredients), truncation: Some(&ingredients) };
        let perfect = positions(&scene, &Truth::of(&state), all);
        let perfect: Vec<f32> = perfect.as_flattened().iter().map(|number| *number as f32).collect();
        let mut split = Split::default();
        Origin::new(&scene, truth.clone(), &state).split(&scene, &ingredients, got.unwrap_or(&perfect), &mut split);
        split.sources(1.0)
    }

    /// Numbers that f32 holds, so that rounding them moves nothing.
    fn even() -> Truth {
        let identity = modalcast_model::domain::Transform::IDENTITY.0.map(f64::from);
        Truth { q: vec![1.0, 0.5], transforms: vec![identity] }
    }

    #[test]
    fn each_source_is_seen_alone() {
        let plain = Deformation::default;
        let none = split(plain(), &even(), None);
        assert!([none.storage, none.q, none.accumulation, none.transform, none.truncation] == [Spread::default(); 5]);
        assert!(none.origin.largest > 0.0 && none.origin.largest < 1e-6);
        let found = split(plain(), &Truth { q: vec![1.0 + 2f64.powi(-30), 0.5], ..even() }, None);
        assert!(found.q.largest > 1e-10 && found.q.largest < 2e-9 && found.transform.largest == 0.0, "{found:?}");
        let turned = Truth { transforms: Motion::new(&load(), None).seed(0).transforms, ..even() };
        let found = split(plain(), &turned, None);
        assert!(found.transform.largest > 1e-9 && found.q.largest == 0.0, "{found:?}");
        let found = split(Deformation { storage: Storage::Int8, ..plain() }, &even(), None);
        // Half a step of 1/127 on each axis for coordinates of 1.5 together, at most.
        assert!(found.storage.largest > 1e-3 && found.storage.largest < 0.5 / 127.0 * 1.5 * 1.74, "{found:?}");
        assert_eq!([found.accumulation, found.truncation], [Spread::default(); 2]);
        // Mode 1 moves vertices by up to 0.5 sqrt(3); a mode goes when it moves none by half the budget.
        let found = split(Deformation { truncation: Some(1.75), ..plain() }, &even(), None);
        assert!(found.truncation.largest > 0.5 && found.truncation.largest <= 0.87, "{found:?}");
        assert_eq!([found.accumulation, found.storage], [Spread::default(); 2]);
    }

    #[test]
    fn what_no_other_source_explains_is_accumulation() {
        let got = vec![1e3_f32; 3 * 256];
        let found = split(Deformation::default(), &Motion::new(&load(), None).seed(0), Some(&got));
        assert!(found.accumulation.largest > 1e3, "{found:?}");
        assert!(found.origin.largest < 1e-6);
    }
}
