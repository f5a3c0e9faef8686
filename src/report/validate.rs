//! Errors of all variants of one load: over random seeds, and step by step along a trajectory.

use std::sync::Arc;

use serde::Serialize;

use super::errors::{Collect, Errors, IMAGE, Orientation, Spread, Tally, Turned, Yardstick, step_errors};
use super::exact::{Judged, judge};
use super::ingredients::Ingredients;
use super::loads::{Load, restated};
use super::motion::Motion;
use super::sources::{Origin, Sources, Split};
use super::trials::has_normals;
use super::variant::Variant;
use crate::deform::Surface;
use crate::error::Error;
use crate::reference;
use crate::scene::{Camera, Deformation, Normals, State};

/// Of how many seeds the sources of error are split. Each costs five evaluations in f64.
const SPLIT: usize = 4;

/// How well conditioned the sums of a load are: sum |U q| / |u| of its vertices.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Condition {
    /// The largest finite one.
    pub largest: f64,
    /// The median over the states of the median over the vertices that have modes.
    pub median: f64,
    /// How many vertices of all states have terms that sum to exactly zero.
    pub infinite: u64,
}

/// What was found of one variant.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Found {
    pub errors: Errors,
    /// Error of x(k + 1) - x(k) along the trajectory, metres.
    pub step_metres: Spread,
    pub sources: Sources,
    pub orientation: Orientation,
    /// Whether the same state gives the same bits again.
    pub repeatable: bool,
    /// Why it did not pass; empty when it did.
    pub faults: Vec<String>,
    /// Whether it was not looked at because something that it needs is not here.
    pub left_out: bool,
}

impl Found {
    /// Whether the variant may be timed.
    pub fn passed(&self) -> bool {
        self.faults.is_empty()
    }
}

/// [`Found`] while it is collected.
struct Case<'a> {
    variant: &'a mut dyn Variant,
    tally: Tally,
    turned: Turned,
    split: Split,
    steps: Collect,
    before: Option<(Vec<f32>, Arc<Vec<Judged>>)>,
    first: Surface,
    repeatable: bool,
    fault: Option<String>,
    left_out: bool,
}

/// One state to look at.
struct Look<'a> {
    at: usize,
    state: &'a State,
    /// What exact storage of all modes gives, and its bound.
    judged: Arc<Vec<Judged>>,
    origin: Option<Origin>,
    /// Normals of the deformed surface, of the states whose sources are split.
    surface: Option<Vec<[f64; 3]>>,
    along: bool,
}

/// Looks at `seeds` random states and at most `steps` of the trajectory.
pub fn validate(
    load: &Load,
    motion: &Motion,
    variants: &mut [Box<dyn Variant>],
    (seeds, steps): (usize, usize),
) -> (Vec<Found>, Condition) {
    let camera = Camera::framing(&load.scene, IMAGE.0, IMAGE.1);
    let yardstick = Yardstick::new(&load.scene, &camera);
    let truth = |at: usize| if at < seeds { motion.seed(at) } else { motion.step(at - seeds) };
    let states: Vec<State> = (0..seeds + motion.steps().min(steps)).map(|at| truth(at).state()).collect();
    let mut cases: Vec<Case<'_>> = variants.iter_mut().map(|variant| Case::new(variant.as_mut(), &states)).collect();
    // The scene whose normals are those of the deformed surface, where that bends and has any.
    let exact_normals = Deformation { normals: Normals::Exact, ..load.scene.deformation };
    let bends = load.scene.needs.modes && has_normals(&load.scene);
    let bent = bends.then(|| restated(&load.scene, exact_normals)).and_then(Result::ok);
    let (exact, mut conditions) = (Ingredients::of(&load.scene), Conditions::default());
    for (at, state) in states.iter().enumerate() {
        let judged = Arc::new(judge(&load.scene, state, &exact));
        conditions.add(&judged);
        let split = at < SPLIT.min(seeds);
        let origin = split.then(|| Origin::new(&load.scene, truth(at), state));
        let bent = bent.as_ref().filter(|_| split);
        let surface = bent.map(|scene| reference::exact_normals(scene, state, &places(&judged)));
        let look = Look { at, state, judged, origin, surface, along: at >= seeds };
        cases.iter_mut().for_each(|case| case.look(&yardstick, &look));
    }
    cases.iter_mut().for_each(|case| case.repeat(&states));
    (cases.into_iter().map(|case| case.found(&yardstick)).collect(), conditions.condition())
}

impl<'a> Case<'a> {
    fn new(variant: &'a mut dyn Variant, states: &[State]) -> Self {
        let fault = variant.prepare(states).err();
        let left_out = matches!(fault, Some(Error::Unavailable { .. }));
        let fault = fault.map(|error| error.to_string());
        Self {
            variant,
            tally: Tally::default(),
            turned: Turned::default(),
            split: Split::default(),
            steps: Collect::default(),
            before: None,
            first: Surface::default(),
            repeatable: true,
            fault,
            left_out,
        }
    }

    fn look(&mut self, yardstick: &Yardstick, look: &Look<'_>) {
        if self.fault.is_some() {
            return;
        }
        let surface = match self.variant.surface(look.at, look.state) {
            Ok(surface) => surface.clone(),
            Err(error) => {
                self.fault = Some(error.to_string());
                return;
            }
        };
        if surface.positions.len() != 3 * look.judged.len() {
            self.fault = Some(format!("{} coordinates for {} vertices", surface.positions.len(), look.judged.len()));
            return;
        }
        let judged = self.judged(look);
        self.tally.add(yardstick, &surface.positions, &judged);
        self.orient(look, &surface);
        if let Some(origin) = &look.origin {
            origin.split(self.variant.scene(), self.variant.ingredients(), &surface.positions, &mut self.split);
        }
        if look.at == 0 {
            self.first = surface.clone();
        }
        if look.along {
            if let Some((positions, before)) = &self.before {
                self.steps = self.steps.join(step_errors([positions, &surface.positions], [before, &judged]));
            }
            self.before = Some((surface.positions, judged));
        }
    }

    /// Asks for the first state again, after all others. A deformer that leaves out modes may remember what it was given
    /// before, so that its answers may differ.
    fn repeat(&mut self, states: &[State]) {
        if self.fault.is_none() && !self.variant.ingredients().truncates() {
            let again = self.variant.surface(0, &states[0]);
            self.repeatable = again.is_ok_and(|again| bits(again).eq(bits(&self.first)));
        }
    }

    /// The exact positions with this variant's own bound.
    fn judged(&self, look: &Look) -> Arc<Vec<Judged>> {
        let ingredients = self.variant.ingredients();
        match ingredients.is_exact() {
            true => Arc::clone(&look.judged),
            false => Arc::new(judge(self.variant.scene(), look.state, ingredients)),
        }
    }

    fn orient(&mut self, look: &Look<'_>, surface: &Surface) {
        if surface.normals.is_empty() {
            return;
        }
        let (scene, state) = (self.variant.scene(), look.state);
        let exact = || places(&look.judged);
        let (normals, tangents) = match scene.needs.exact_normals {
            true => {
                (reference::exact_normals(scene, state, &exact()), reference::exact_tangents(scene, state, &exact()))
            }
            false => (reference::orient_normals(scene, state), reference::orient_tangents(scene, state)),
        };
        self.turned.add_normals(&surface.normals, &normals);
        if let Some(want) = &look.surface {
            self.turned.add_to_surface(&surface.normals, want);
        }
        self.turned.add_tangents(&surface.tangents, &tangents, &surface.normals);
    }

    fn found(self, yardstick: &Yardstick) -> Found {
        let (errors, orientation) = (self.tally.errors(yardstick), self.turned.orientation());
        let mut faults: Vec<String> = self.fault.into_iter().collect();
        if !errors.passed() {
            let Errors { of_bound, not_finite, .. } = errors;
            faults.push(format!("{of_bound:.3} times its a-priori bound, {not_finite} coordinates not finite"));
        }
        if orientation.broken > 0 {
            faults.push(format!("{} normals or tangents are no directions", orientation.broken));
        }
        Found {
            errors,
            step_metres: self.steps.spread(yardstick.unit()).unwrap_or_default(),
            sources: self.split.sources(yardstick.unit()),
            orientation,
            repeatable: self.repeatable,
            faults,
            left_out: self.left_out,
        }
    }
}

fn places(judged: &[Judged]) -> Vec<[f64; 3]> {
    judged.iter().map(|judged| judged.at).collect()
}

fn bits(surface: &Surface) -> impl Iterator<Item = u32> + '_ {
    let lists = [&surface.positions, &surface.normals, &surface.tangents];
    lists.into_iter().flatten().map(|number| number.to_bits())
}

/// [`Condition`] while it is collected.
#[derive(Debug, Default)]
struct Conditions {
    largest: f64,
    infinite: u64,
    medians: Vec<f64>,
}

impl Conditions {
    fn add(&mut self, judged: &[Judged]) {
        let all = || judged.iter().map(|judged| judged.condition).filter(|condition| *condition > 0.0);
        let (mut finite, count) = (all().filter(|condition| condition.is_finite()).collect::<Vec<_>>(), all().count());
        self.infinite += (count - finite.len()) as u64;
        self.largest = finite.iter().copied().fold(self.largest, f64::max);
        self.medians.extend(median(&mut finite));
    }

    fn condition(mut self) -> Condition {
        let median = median(&mut self.medians).unwrap_or(0.0);
        Condition { largest: self.largest, median, infinite: self.infinite }
    }
}

fn median(numbers: &mut [f64]) -> Option<f64> {
    let middle = numbers.len().checked_sub(1)? / 2;
    Some(*numbers.select_nth_unstable_by(middle, f64::total_cmp).1)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cpu::CpuDeformer;
    use crate::deform::Backend;
    use crate::report::loads::{Kind, Size};
    use crate::report::testing::{Damaged, Emulated};
    use crate::report::variant::{Driven, Label};
    use crate::scene::Storage;

    fn find(kind: Kind, damage: f32) -> (Found, Condition) {
        let load = kind.build(Size::Quick).expect("built");
        let label = Label::new("cpu", Backend::Cpu, &load.scene);
        let cpu = Driven::new(label, &load.scene, Box::new(CpuDeformer::new(&load.scene)));
        let mut variants: Vec<Box<dyn Variant>> = vec![Box::new(Damaged::new(cpu, damage))];
        let motion = Motion::new(&load, None);
        let (mut found, condition) = validate(&load, &motion, &mut variants, (4, usize::MAX));
        (found.remove(0), condition)
    }

    #[test]
    fn the_cpu_passes_on_every_kind_of_load_with_all_figures_filled() {
        let (found, condition) = find(Kind::A { dressed: true }, 0.0);
        assert!(found.passed() && found.repeatable, "{:?}", found.faults);
        assert_eq!(found.errors.states, 4 + 24);
        assert!(found.errors.metres.largest > 0.0 && found.errors.of_diagonal.largest < 1e-6, "{found:?}");
        assert!(found.step_metres.largest > 0.0 && found.step_metres.largest < 2e-6, "{found:?}");
        let normals = found.orientation.normals_degrees.expect("normals");
        let tangents = found.orientation.tangents_degrees.expect("tangents");
        let to_surface = found.orientation.normals_to_surface_degrees.expect("normals");
        assert!(to_surface.largest > 0.1, "rigid normals do not follow the surface: {found:?}");
        assert!(normals.largest < 1e-4 && tangents.largest < 1e-4, "{found:?}");
        assert!(found.orientation.normal_dot_tangent.expect("dots").largest < 1e-6, "{found:?}");
        let Sources { storage, q, accumulation, transform, origin, truncation } = found.sources;
        assert_eq!([storage, truncation], [Spread::default(); 2]);
        assert!([q, accumulation, transform, origin].iter().all(|part| part.largest > 0.0), "{:?}", found.sources);
        assert!(condition.median > 1.0 && condition.largest > condition.median, "{condition:?}");
        for kind in [Kind::B, Kind::C, Kind::Cancelling, Kind::Plant(1)] {
            let (found, _) = find(kind, 0.0);
            assert!(found.passed(), "{kind:?}: {:?}", found.faults);
        }
    }

    #[test]
    fn a_damaged_variant_fails_with_its_fault_in_words() {
        let (found, _) = find(Kind::B, 1e-3);
        assert!(!found.passed() && found.faults[0].contains("times its a-priori bound"), "{:?}", found.faults);
        let (found, _) = find(Kind::B, f32::NAN);
        assert!(found.faults[0].contains("not finite"), "{:?}", found.faults);
    }

    /// A deformer that does as one deformation says, judged by another.
    fn emulate(does: Deformation, says: Deformation) -> Found {
        let load = Kind::B.build(Size::Quick).expect("built");
        let [done, said] = [does, says].map(|deformation| restated(&load.scene, deformation).expect("restated"));
        let label = Label::new("emulated", Backend::Cpu, &said);
        let (does, says) = (Ingredients::of(&done), Ingredients::of(&said));
        let emulated = Emulated { label, scene: said, does, says, surface: Surface::default() };
        let mut variants: Vec<Box<dyn Variant>> = vec![Box::new(emulated)];
        validate(&load, &Motion::new(&load, None), &mut variants, (3, usize::MAX)).0.remove(0)
    }

    #[test]
    fn stored_and_truncated_deformers_keep_their_own_bounds_and_not_those_of_exact_ones() {
        let storage = |storage| Deformation { storage, ..Deformation::default() };
        let [half, brain, eighth] = [Storage::F16, Storage::Bf16, Storage::Int8].map(storage);
        let short = Deformation { truncation: Some(1e-4), ..Deformation::default() };
        for deformation in [half, brain, eighth, short, Deformation { truncation: Some(1e-4), ..eighth }] {
            let found = emulate(deformation, deformation);
            assert!(found.passed(), "{deformation:?}: {:?}", found.faults);
            assert!(found.errors.of_bound > 0.05, "{deformation:?} is judged by a bound of its size: {found:?}");
            assert_eq!(found.sources.accumulation, Spread::default(), "{deformation:?}");
            assert_eq!(found.sources.storage.largest > 0.0, deformation.storage != Storage::F32);
            assert_eq!(found.sources.truncation.largest > 0.0, deformation.truncation.is_some());
            assert!(!emulate(deformation, Deformation::default()).passed(), "{deformation:?} is not exact");
        }
        assert!(!emulate(eighth, half).passed() && !emulate(brain, half).passed(), "coarser than it says");
    }
}
