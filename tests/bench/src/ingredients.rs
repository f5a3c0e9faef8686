//! Error model of a deformer: what it replaces in x = T (x0 + U q) before it computes (storage of U, truncation of
//! modes, 16-bit coordinates), and a-priori bounds on the resulting error.

use std::sync::{Arc, Mutex, PoisonError};

use rayon::prelude::*;

use super::loads::restated;
use modalcast_compute::storage::bound::{Bound, Reaches, Step, norm};
use modalcast_compute::storage::{Amounts, Halves, Products, QUAD, TILE_QUADS, Tiles, Truncation, reaches};
use modalcast_model::error::Result;
use modalcast_model::scene::{Deformation, Scene, Slot, State, Storage};

/// Vertices per tile of stored U.
const TILE: usize = QUAD * TILE_QUADS;

/// The error model of one scene, derived from its deformation.
#[derive(Debug)]
pub struct Ingredients {
    scene: Arc<Scene>,
    /// Stored U per shape; empty when U is stored in f32.
    stored: Arc<Vec<Stored>>,
    truncation: Option<Budget>,
    /// Whether tensor cores multiply, in which case each coordinate is split into two 16-bit numbers.
    halves: bool,
}

/// Stored U of one shape, and the data that its error bounds need.
type Stored = (Tiles, Reaches);

#[derive(Debug)]
struct Budget {
    /// Error budget, scene units.
    most: f64,
    /// Per shape and mode: the farthest that a unit coordinate moves a vertex.
    reaches: Vec<Vec<f64>>,
    /// Truncation state per domain.
    domains: Vec<Truncation>,
}

impl Ingredients {
    /// The error model of a deformer that follows this scene's deformation.
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
    pub fn forget(&mut self) {
        if let Some(Budget { domains, .. }) = &mut self.truncation {
            domains.iter_mut().for_each(Truncation::forget);
        }
    }

    /// Advances truncation to a state: decides which modes are left out, given the previous states, as a deformer does.
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

    /// Stored U of a shape; `None` when it is stored in f32.
    pub(super) fn tiles(&self, shape: usize) -> Option<&Tiles> {
        self.stored.get(shape).map(|(tiles, _)| tiles)
    }

    /// Zeroes the coordinates of a domain's truncated modes.
    pub(super) fn truncate<T: Default + Copy>(&self, domain: usize, q: &mut [T]) {
        if let Some(budget) = &self.truncation {
            let mut kept = vec![false; q.len()];
            budget.domains[domain].kept().iter().for_each(|mode| kept[usize::from(*mode)] = true);
            q.iter_mut().zip(kept).filter(|(_, kept)| !kept).for_each(|(q, _)| *q = T::default());
        }
    }

    /// Error bounds of a domain at a state.
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

    /// The packed coordinates as tensor cores read them, rounded to a pair of 16-bit numbers each; `None` when they are
    /// read in f32.
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

/// The shapes of a scene in its storage type; empty for f32.
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

/// Cache of one scene under several deformations: variants with the same storage type share the stored U, and variants
/// with the same deformation share their scene.
#[derive(Debug)]
pub struct Stock {
    scene: Arc<Scene>,
    scenes: Mutex<Vec<(Deformation, Arc<Scene>)>>,
    stored: Mutex<Vec<(Storage, Arc<Vec<Stored>>)>>,
}

impl Stock {
    /// A cache that holds only the given scene.
    pub fn new(scene: &Arc<Scene>) -> Self {
        let scenes = Mutex::new(vec![(scene.deformation, Arc::clone(scene))]);
        Self { scene: Arc::clone(scene), scenes, stored: Mutex::default() }
    }

    /// The scene with another deformation.
    ///
    /// # Errors
    /// `Invalid` when the deformation's options contradict each other.
    pub fn scene(&self, deformation: Deformation) -> Result<Arc<Scene>> {
        let mut scenes = self.scenes.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((_, known)) = scenes.iter().find(|(known, _)| *known == deformation) {
            return Ok(Arc::clone(known));
        }
        let made = restated(&self.scene, deformation)?;
        scenes.push((deformation, Arc::clone(&made)));
        Ok(made)
    }

    /// The error model of a deformer of one of these scenes.
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

/// A-priori bounds of one domain on the displacement caused by the replacements, in scene units.
pub(super) struct Bounds<'a> {
    reaches: Option<&'a Reaches>,
    q: Vec<f32>,
    transform: modalcast_model::domain::Composed,
    compensated: bool,
    truncation: f64,
    products: Option<Products>,
}

impl Bounds<'_> {
    /// Widens the bounds of consecutive vertices, from vertex `first` of the shape. On entry they hold `arithmetic`,
    /// the bound of a sum of all modes in f32.
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
    use crate::loads::{Kind, Size};
    use crate::motion::Motion;

    fn ingredients(deformation: Deformation) -> (Ingredients, State) {
        let load = Kind::Single { power: 8, rank: 20 }.build(Size::Full).expect("built");
        let scene = restated(&load.scene, deformation).expect("restated");
        (Ingredients::of(&scene), Motion::new(&load, None).seed(0).state())
    }

    #[test]
    fn default_deformation_replaces_nothing() {
        let (exact, state) = ingredients(Deformation::default());
        assert!(exact.is_exact() && exact.tiles(0).is_none());
        let mut bounds = [1.0, 2.0];
        exact.bounds(0, &state).widen(0, bounds.iter_mut());
        assert_eq!(bounds, [1.0, 2.0]);
    }

    #[test]
    fn variants_share_stored_u_by_storage_type() {
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
    fn coarser_storage_widens_bounds_more() {
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
    fn tensor_cores_widen_bounds_and_round_q_to_two_halves() {
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
    fn truncates_small_modes_within_budget_after_first_state() {
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
