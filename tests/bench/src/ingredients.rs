//! What a deformer replaces in x = T (x0 + U q) before it computes, and how far off that may be.

use std::sync::{Arc, Mutex, PoisonError};

use rayon::prelude::*;

use super::loads::restated;
use modalcast_compute::storage::bound::{Bound, Reaches, Step, norm};
use modalcast_compute::storage::{Amounts, Halves, Products, QUAD, TILE_QUADS, Tiles, Truncation, reaches};
use modalcast_model::error::Result;
use modalcast_model::scene::{Deformation, Scene, Slot, State, Storage};

/// Vertices of a tile of U as it is stored.
const TILE: usize = QUAD * TILE_QUADS;

/// The replacements of one scene, as its deformation says.
#[derive(Debug)]
pub struct Ingredients {
    scene: Arc<Scene>,
    /// Per shape; empty when U is stored in f32.
    stored: Arc<Vec<Stored>>,
    truncation: Option<Budget>,
    /// Whether tensor cores multiply: q is then two numbers of 16 bits.
    halves: bool,
}

/// U of one shape as it is stored, and what its bounds need to know.
type Stored = (Tiles, Reaches);

#[derive(Debug)]
struct Budget {
    /// Scene units.
    most: f64,
    /// Per shape.
    reaches: Vec<Vec<f64>>,
    /// Per domain.
    domains: Vec<Truncation>,
}

impl Ingredients {
    /// What a deformer of this scene replaces that does as its deformation says.
    pub fn of(scene: &Arc<Scene>) -> Self {
        Self::with(scene, Arc::new(store(scene)))
    }

    fn with(scene: &Arc<Scene>, stored: Arc<Vec<Stored>>) -> Self {
        let truncation = scene.deformation.truncation.filter(|_| scene.needs.truncation).map(|metres| Budget {
            most: metres / scene.unit,
            reaches: scene.shapes.par_iter().map(|shape| reaches(&shape.modes)).collect(),
            domains: (0..scene.domains.len()).map(|domain| Truncation::new(scene.rank_of(domain))).collect(),
        });
        Self { scene: Arc::clone(scene), stored, truncation, halves: false }
    }

    /// The same with sums from tensor cores. U is stored in 16 bits.
    pub fn with_products(self) -> Self {
        Self { halves: true, ..self }
    }

    /// Whether nothing is replaced, so that all such deformers share their bounds.
    pub fn is_exact(&self) -> bool {
        !self.stores() && !self.truncates()
    }

    /// Whether U is not stored as it is.
    pub fn stores(&self) -> bool {
        !self.stored.is_empty()
    }

    /// Whether modes may be left out.
    pub fn truncates(&self) -> bool {
        self.truncation.is_some()
    }

    /// Forgets the states before, so that the next is decided on its own.
    pub fn forget(&mut self) {
        if let Some(Budget { domains, .. }) = &mut self.truncation {
            domains.iter_mut().for_each(Truncation::forget);
        }
    }

    /// Decides which modes are left out at a state, from those of the state before, as a deformer does.
    pub fn follow(&mut self, state: &State) {
        let Self { scene, truncation, .. } = self;
        if let Some(Budget { most, reaches, domains }) = truncation {
            domains.par_iter_mut().enumerate().with_min_len(64).for_each(|(domain, truncation)| {
                let reaches = &reaches[scene.domains[domain].shape];
                let norm = norm(&state.composed(scene, domain));
                truncation.update(Amounts { q: state.q_of(scene, domain), reaches, norm }, *most);
            });
        }
    }

    /// U of a shape as it is stored; `None` when that is U.
    pub(super) fn tiles(&self, shape: usize) -> Option<&Tiles> {
        self.stored.get(shape).map(|(tiles, _)| tiles)
    }

    /// Zeroes the coordinates of the modes that a domain leaves out.
    pub(super) fn truncate<T: Default + Copy>(&self, domain: usize, q: &mut [T]) {
        if let Some(budget) = &self.truncation {
            let mut kept = vec![false; q.len()];
            budget.domains[domain].kept().iter().for_each(|mode| kept[usize::from(*mode)] = true);
            q.iter_mut().zip(kept).filter(|(_, kept)| !kept).for_each(|(q, _)| *q = T::default());
        }
    }

    /// Bounds of a domain at a state.
    pub(super) fn bounds(&self, domain: usize, state: &State) -> Bounds<'_> {
        let mut q = state.q_of(&self.scene, domain).to_vec();
        self.truncate(domain, &mut q);
        let truncation = self.truncation.as_ref().map_or(0.0, |budget| budget.domains[domain].bound());
        let reaches = self.stored.get(self.scene.domains[domain].shape).map(|(_, reaches)| reaches);
        Bounds {
            reaches,
            q,
            transform: state.composed(&self.scene, domain),
            compensated: self.scene.deformation.compensated,
            truncation,
            products: self.halves.then(|| Products::of(self.scene.deformation.storage, self.scene.rank_of(domain))),
        }
    }

    /// Coordinates, packed as the scene says, as tensor cores take them; `None` when they are taken as they are.
    pub(super) fn halved(&self, q: &[f64]) -> Option<Vec<f64>> {
        let own = |(domain, slot): (usize, &Slot)| -> Vec<f64> {
            let factors = self.stored[self.scene.domains[domain].shape].0.factors();
            let amounts = q[slot.first_q..][..slot.rank].iter().zip(factors).map(|(q, factor)| *q as f32 * factor);
            let halves = Halves::new(&amounts.collect::<Vec<_>>(), self.scene.deformation.storage);
            factors.iter().enumerate().map(|(mode, factor)| halves.worth(mode) / f64::from(*factor)).collect()
        };
        let mut halved = q.to_vec();
        for (domain, slot) in self.scene.layout.slots.iter().enumerate().filter(|_| self.halves) {
            halved[slot.first_q..][..slot.rank].copy_from_slice(&own((domain, slot)));
        }
        self.halves.then_some(halved)
    }
}

/// The shapes of a scene as its storage type says; none when that is f32.
fn store(scene: &Scene) -> Vec<Stored> {
    let storage = scene.deformation.storage;
    let one = |shape| {
        let tiles = Tiles::new(shape, storage);
        let reaches = Reaches::new(shape, &tiles);
        (tiles, reaches)
    };
    match storage {
        Storage::F32 => Vec::new(),
        _ => scene.shapes.par_iter().map(one).collect(),
    }
}

/// One scene deformed in several ways: the variants that store U alike share what is stored, and those that deform
/// alike share their scene.
#[derive(Debug)]
pub struct Stock {
    scene: Arc<Scene>,
    scenes: Mutex<Vec<(Deformation, Arc<Scene>)>>,
    stored: Mutex<Vec<(Storage, Arc<Vec<Stored>>)>>,
}

impl Stock {
    /// With nothing in it but the scene.
    pub fn new(scene: &Arc<Scene>) -> Self {
        let scenes = Mutex::new(vec![(scene.deformation, Arc::clone(scene))]);
        Self { scene: Arc::clone(scene), scenes, stored: Mutex::default() }
    }

    /// The scene, deformed in another way.
    ///
    /// # Errors
    /// `Invalid` when the choices make no sense.
    pub fn scene(&self, deformation: Deformation) -> Result<Arc<Scene>> {
        let mut scenes = self.scenes.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((_, known)) = scenes.iter().find(|(known, _)| *known == deformation) {
            return Ok(Arc::clone(known));
        }
        let made = restated(&self.scene, deformation)?;
        scenes.push((deformation, Arc::clone(&made)));
        Ok(made)
    }

    /// What a deformer of one of these scenes replaces.
    pub fn ingredients(&self, scene: &Arc<Scene>) -> Ingredients {
        let storage = scene.deformation.storage;
        let mut known = self.stored.lock().unwrap_or_else(PoisonError::into_inner);
        let own = known.iter().find(|(known, _)| *known == storage).map(|(_, stored)| Arc::clone(stored));
        let stored = own.unwrap_or_else(|| {
            let made = Arc::new(store(scene));
            known.push((storage, Arc::clone(&made)));
            made
        });
        Ingredients::with(scene, stored)
    }
}

/// What the replacements may move the vertices of one domain by, in scene units.
pub(super) struct Bounds<'a> {
    reaches: Option<&'a Reaches>,
    q: Vec<f32>,
    transform: modalcast_model::domain::Composed,
    compensated: bool,
    truncation: f64,
    products: Option<Products>,
}

impl Bounds<'_> {
    /// The bound of one vertex after another, from `arithmetic`: that of a sum of all modes in f32.
    pub(super) fn widen<'b>(&self, first: usize, arithmetic: impl Iterator<Item = &'b mut f64>) {
        let step = Step { q: &self.q, transform: self.transform, compensated: self.compensated };
        let mut known: Option<(usize, Bound, f64)> = None;
        for (vertex, bound) in arithmetic.enumerate() {
            if let Some(reaches) = self.reaches {
                let tile = (first + vertex) / TILE;
                let look = || {
                    let products = self.products.map_or(0.0, |products| reaches.products(tile, &step, products));
                    (tile, reaches.tile(tile, &step), products)
                };
                let (_, own, products) = known.filter(|(at, ..)| *at == tile).unwrap_or_else(look);
                known = Some((tile, own, products));
                // Sums of stored entries are longer by what storing them added, and round that much more.
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
    use crate::loads::{Kind, Size};
    use crate::motion::Motion;

    fn ingredients(deformation: Deformation) -> (Ingredients, State) {
        let load = Kind::Single { power: 8, rank: 20 }.build(Size::Full).expect("built");
        let scene = restated(&load.scene, deformation).expect("restated");
        (Ingredients::of(&scene), Motion::new(&load, None).seed(0).state())
    }

    #[test]
    fn the_default_replaces_nothing() {
        let (exact, state) = ingredients(Deformation::default());
        assert!(exact.is_exact() && exact.tiles(0).is_none());
        let mut bounds = [1.0, 2.0];
        exact.bounds(0, &state).widen(0, bounds.iter_mut());
        assert_eq!(bounds, [1.0, 2.0]);
    }

    #[test]
    fn variants_that_store_alike_share_what_is_stored_and_others_do_not() {
        let load = Kind::Single { power: 8, rank: 4 }.build(Size::Full).expect("built");
        let stock = Stock::new(&load.scene);
        let half = Deformation { storage: Storage::F16, ..Deformation::default() };
        let [one, two] = [half, half].map(|half| stock.scene(half).expect("restated"));
        assert!(Arc::ptr_eq(&one, &two) && !Arc::ptr_eq(&one, &load.scene));
        assert!(Arc::ptr_eq(&stock.scene(load.scene.deformation).expect("its own"), &load.scene));
        let short = stock.scene(Deformation { truncation: Some(0.01), ..half }).expect("restated");
        let made = [&one, &short].map(|scene| stock.ingredients(scene));
        assert!(Arc::ptr_eq(&made[0].stored, &made[1].stored) && made[0].stores());
        assert!(made[1].truncates() && !made[0].truncates());
        assert!(stock.ingredients(&load.scene).is_exact());
    }

    #[test]
    fn stored_entries_widen_bounds_by_what_their_type_loses() {
        let widened = |storage| {
            let (stored, state) = ingredients(Deformation { storage, ..Deformation::default() });
            assert!(!stored.is_exact() && stored.tiles(0).is_some());
            let mut bounds = [1e-6; 256];
            stored.bounds(0, &state).widen(0, bounds.iter_mut());
            bounds[200]
        };
        let [half, brain, eighth] = [Storage::F16, Storage::Bf16, Storage::Int8].map(widened);
        assert!(1e-5 < half && half < brain && half < eighth, "{half} {brain} {eighth}");
    }

    #[test]
    fn tensor_cores_widen_bounds_a_little_and_round_q_as_they_say() {
        let (stored, state) = ingredients(Deformation { storage: Storage::Bf16, ..Deformation::default() });
        let widened = |ingredients: &Ingredients| {
            let mut bounds = [1e-6];
            ingredients.bounds(0, &state).widen(0, bounds.iter_mut());
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
    fn small_modes_are_left_out_within_the_budget_and_none_before_the_first_state() {
        let (mut truncated, state) = ingredients(Deformation { truncation: Some(0.01), ..Deformation::default() });
        let count = |ingredients: &Ingredients| {
            let mut q = state.q.clone();
            ingredients.truncate(0, &mut q);
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
