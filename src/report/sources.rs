//! Where an error comes from: each ingredient of x = T (x0 + U q) exchanged alone, all else exact in f64.

use serde::Serialize;

use super::errors::{Collect, Spread};
use super::exact::{Exact, Ingredients, positions};
use super::motion::Truth;
use crate::scene::{Scene, State};

/// What each source alone moves a vertex by, metres.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Sources {
    /// U as it is stored, decoded, instead of U.
    pub storage: Spread,
    /// q rounded to f32 instead of the f64 of the physics process.
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
}

impl Origin {
    /// What a truth and its rounding give in f64.
    pub(super) fn new(scene: &Scene, truth: Truth, state: &State) -> Self {
        let given = Truth::of(state);
        let at = |q: &[f64], transforms: &[[f64; 12]]| {
            positions(scene, &Truth { q: q.to_vec(), transforms: transforms.to_vec() }, &Exact, false, false)
        };
        let exact = at(&truth.q, &truth.transforms);
        let q = apart(&exact, &at(&given.q, &truth.transforms));
        let transform = apart(&exact, &at(&truth.q, &given.transforms));
        let plain = at(&given.q, &given.transforms);
        Self { truth, given, exact, q, transform, plain }
    }

    /// Adds what a variant made of it.
    pub(super) fn split(&self, scene: &Scene, ingredients: &dyn Ingredients, got: &[f32], split: &mut Split) {
        let stores = (0..scene.shapes.len()).any(|shape| ingredients.decoded(shape).is_some());
        let truncates = ingredients.truncation_bound() > 0.0;
        let alone = |decode: bool, truncate: bool| {
            // Which modes are left out depends on what the deformer was given; their sizes hardly do.
            apart(&self.exact, &positions(scene, &self.truth, ingredients, decode, truncate))
        };
        let same = |list: &[[f64; 3]]| apart(list, list);
        let storage = if stores { alone(true, false) } else { same(&self.exact) };
        let truncation = if truncates { alone(false, true) } else { same(&self.exact) };
        let own = (stores || truncates).then(|| positions(scene, &self.given, ingredients, true, true));
        let own = own.as_deref().unwrap_or(&self.plain);
        let rounded: Vec<[f64; 3]> = own.iter().map(|at| at.map(|number| f64::from(number as f32))).collect();
        let got: Vec<[f64; 3]> = got.as_chunks::<3>().0.iter().map(|at| at.map(f64::from)).collect();
        let parts = [storage, self.q, apart(&rounded, &got), self.transform, apart(own, &rounded), truncation];
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
    let mut collect = Collect::default();
    for (one, other) in one.iter().zip(other) {
        let square: f64 = one.iter().zip(other).map(|(one, other)| (one - other).powi(2)).sum();
        collect.add(square.sqrt());
    }
    collect
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::Modes;
    use crate::report::loads::{Kind, Size};
    use crate::report::motion::Motion;

    /// Stores U with 1/64 added to every entry, and leaves out mode 1.
    struct Coarse(Modes);

    impl Ingredients for Coarse {
        fn is_exact(&self) -> bool {
            false
        }

        fn decoded(&self, _shape: usize) -> Option<&Modes> {
            Some(&self.0)
        }

        fn left_out(&self, _domain: usize, _truth: &Truth, left_out: &mut Vec<usize>) {
            left_out.push(1);
        }

        fn truncation_bound(&self) -> f64 {
            1.0
        }
    }

    fn split(ingredients: &dyn Ingredients, scene: &Scene, truth: &Truth, got: Option<&[f32]>) -> Sources {
        let state = truth.state();
        let origin = Origin::new(scene, truth.clone(), &state);
        let perfect: Vec<f32> = positions(scene, &Truth::of(&state), ingredients, true, true)
            .as_flattened()
            .iter()
            .map(|number| *number as f32)
            .collect();
        let mut split = Split::default();
        origin.split(scene, ingredients, got.unwrap_or(&perfect), &mut split);
        split.sources(1.0)
    }

    #[test]
    fn each_source_is_seen_alone() {
        let load = Kind::Single { power: 8, rank: 2 }.build(Size::Full).expect("built");
        let scene = &load.scene;
        let still = Motion::new(&load, None).seed(0).transforms;
        // Numbers that f32 holds have no rounding; 1 + 2^-30 rounds to 1.
        let exact =
            Truth { q: vec![1.0, 0.5], transforms: vec![[1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0]] };
        let none = split(&Exact, scene, &exact, None);
        assert!([none.storage, none.q, none.accumulation, none.transform, none.truncation] == [Spread::default(); 5]);
        assert!(none.origin.largest > 0.0 && none.origin.largest < 1e-6);
        let odd = Truth { q: vec![1.0 + 2f64.powi(-30), 0.5], ..exact.clone() };
        let found = split(&Exact, scene, &odd, None);
        assert!(found.q.largest > 1e-10 && found.q.largest < 2e-9 && found.transform.largest == 0.0, "{found:?}");
        let turned = Truth { transforms: still, ..exact.clone() };
        let found = split(&Exact, scene, &turned, None);
        assert!(found.transform.largest > 1e-9 && found.q.largest == 0.0, "{found:?}");
        let shifted: Vec<f32> = scene.shapes[0].modes.columns().iter().map(|entry| entry + 1.0 / 64.0).collect();
        let coarse = Coarse(Modes::from_columns(3 * scene.layout.vertices, 2, shifted).expect("modes"));
        let found = split(&coarse, scene, &exact, None);
        // Both coordinates together, on each of three axes.
        let want = 1.5 / 64.0 * 3f64.sqrt();
        assert!((found.storage.largest - want).abs() < 1e-6 && (found.storage.rms - want).abs() < 1e-6, "{found:?}");
        assert!(found.truncation.largest > 0.2 && found.truncation.largest <= 0.5 * 3f64.sqrt(), "{found:?}");
        assert_eq!(found.accumulation, Spread::default());
    }

    #[test]
    fn what_no_other_source_explains_is_accumulation() {
        let load = Kind::Single { power: 4, rank: 2 }.build(Size::Full).expect("built");
        let truth = Motion::new(&load, None).seed(0);
        let got = vec![1e3_f32; 48];
        let found = split(&Exact, &load.scene, &truth, Some(&got));
        assert!(found.accumulation.largest > 1e3, "{found:?}");
        assert!(found.origin.largest < 1e-6);
    }
}
