//! Validation: the errors of all variants of one load, over random seeds and step by step along a trajectory.

use std::ops::Range;
use std::sync::{Arc, OnceLock};

use rayon::prelude::*;
use serde::Serialize;

use super::errors::{Collect, Errors, IMAGE, Orientation, Spread, Tally, Turned, Yardstick, step_errors};
use super::exact::{Judged, judge, widen};
use super::loads::{Load, restated};
use super::motion::Motion;
use super::offers::has_normals;
use super::sources::{Origin, Sources, Split};
use super::variant::Variant;
use modalcast_compute::reference;
use modalcast_model::deform::Surface;
use modalcast_model::error::Error;
use modalcast_model::scene::{Camera, Deformation, Normals, Scene, State};

/// Number of seeds for which the error is split into its sources. Each split costs five evaluations in f64.
const SPLIT: usize = 4;

/// Condition numbers of the modal sums of a load: sum |U q| / |u| per vertex.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Condition {
    /// Largest finite condition number.
    pub largest: f64,
    /// Median over the states of the median over the vertices that have modes.
    pub median: f64,
    /// Number of vertices over all states whose nonzero terms sum to exactly zero.
    pub infinite: u64,
}

/// Validation result of one variant.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Found {
    pub errors: Errors,
    /// Error of x(k + 1) - x(k) along the trajectory, meters.
    pub step_metres: Spread,
    pub sources: Sources,
    pub orientation: Orientation,
    /// Whether the same state gives bit-identical results when it is evaluated again.
    pub repeatable: bool,
    /// Reasons why the variant failed; empty when it passed.
    pub faults: Vec<String>,
    /// Whether the variant was skipped because something that it needs is unavailable on this machine.
    pub left_out: bool,
}

impl Found {
    /// Whether the variant passed validation, so that it may be timed.
    pub fn passed(&self) -> bool {
        self.faults.is_empty()
    }
}

/// Accumulator for the [`Found`] of one variant.
struct Case<'a> {
    variant: &'a mut dyn Variant,
    tally: Tally,
    turned: Turned,
    split: Split,
    steps: Collect,
    before: Option<(Vec<f32>, Arc<Vec<Judged>>)>,
    /// The variant's most recent surface. The buffers are reused.
    held: Surface,
    first: Surface,
    repeatable: bool,
    fault: Option<String>,
    left_out: bool,
}

/// One state to validate, with the reference values that all variants share.
struct Look<'a> {
    at: usize,
    scenes: &'a Scenes<'a>,
    state: &'a State,
    /// Exact positions, with the bounds of a deformer that stores U exactly and sums all modes.
    judged: Arc<Vec<Judged>>,
    partial: Partial,
    /// Present for the states whose error is split into its sources.
    origin: Option<Origin>,
    rigid: OnceLock<Directions>,
    exact: OnceLock<Directions>,
    along: bool,
}

/// Reference normals and tangents in f64.
struct Directions {
    normals: Vec<[f64; 3]>,
    tangents: Vec<[f64; 4]>,
}

/// The scenes that define the correct directions.
struct Scenes<'a> {
    rigid: &'a Scene,
    /// The same scene with exact normals of the deformed surface; `None` when it has no modes or no normals.
    bent: Option<Arc<Scene>>,
}

impl<'a> Scenes<'a> {
    fn new(load: &'a Load) -> Self {
        let exact_normals = Deformation { normals: Normals::Exact, ..load.scene.deformation };
        let bends = load.scene.needs.modes && has_normals(&load.scene);
        let bent = bends.then(|| restated(&load.scene, exact_normals)).and_then(Result::ok);
        Self { rigid: &load.scene, bent }
    }
}

impl<'a> Look<'a> {
    fn new(scenes: &'a Scenes<'a>, at: usize, state: &'a State, along: bool) -> Self {
        let judged = Arc::new(judge(scenes.rigid, state));
        let (rigid, exact) = (OnceLock::new(), OnceLock::new());
        Self { at, scenes, state, partial: Partial::of(&judged), judged, origin: None, rigid, exact, along }
    }

    /// Reference directions: by T alone, or, if `exact`, of the deformed surface. Computed at the first call and
    /// cached.
    fn directions(&self, exact: bool) -> &Directions {
        match exact {
            true => self.exact.get_or_init(|| {
                let (scene, places) = (self.scenes.bent.as_deref().unwrap_or(self.scenes.rigid), places(&self.judged));
                let normals = || reference::exact_normals(scene, self.state, &places);
                let tangents = || reference::exact_tangents(scene, self.state, &places);
                let (normals, tangents) = rayon::join(normals, tangents);
                Directions { normals, tangents }
            }),
            false => self.rigid.get_or_init(|| {
                let normals = || reference::orient_normals(self.scenes.rigid, self.state);
                let (normals, tangents) =
                    rayon::join(normals, || reference::orient_tangents(self.scenes.rigid, self.state));
                Directions { normals, tangents }
            }),
        }
    }
}

/// Upper limit of the vertices plus corners of the states that are evaluated together: 40 bytes per vertex and up to
/// 112 per corner.
const AT_ONCE: usize = 1 << 24;

/// Validates the variants at `seeds` random states and at no more than `steps` states of the trajectory, at every
/// vertex and corner. The reference values are computed once for all variants, in parallel over several states.
pub fn validate(
    load: &Load,
    motion: &Motion,
    variants: &mut [Box<dyn Variant>],
    (seeds, steps): (usize, usize),
) -> (Vec<Found>, Condition) {
    let camera = Camera::framing(&load.scene, IMAGE.0, IMAGE.1);
    let yardstick = Yardstick::new(&load.scene, &camera);
    let truth = |at: usize| if at < seeds { motion.seed(at) } else { motion.step(at - seeds) };
    let count = seeds + motion.steps().min(steps);
    let states: Vec<State> = (0..count).into_par_iter().map(|at| truth(at).state()).collect();
    let mut cases: Vec<Case<'_>> = variants.iter_mut().map(|variant| Case::new(variant.as_mut(), &states)).collect();
    let (scenes, mut conditions) = (Scenes::new(load), Conditions::default());
    // Which directions the variants needed at the first state. For the other states these are computed beforehand, in
    // parallel.
    let mut asked = [false; 2];
    for group in groups(count, load.scene.layout.vertices + load.scene.layout.corners) {
        let look = |at: usize| {
            let look = Look::new(&scenes, at, &states[at], at >= seeds);
            for exact in [false, true].into_iter().filter(|exact| asked[usize::from(*exact)]) {
                look.directions(exact);
            }
            let split = at < SPLIT.min(seeds);
            Look { origin: split.then(|| Origin::new(&load.scene, truth(at), &states[at])), ..look }
        };
        let looks: Vec<Look<'_>> = group.into_par_iter().map(look).collect();
        for look in looks {
            conditions.add(&look.partial);
            cases.iter_mut().for_each(|case| case.look(&yardstick, &look));
            if look.at == 0 {
                let exact = cases.iter().any(|case| case.is_held_to_surface());
                asked = [look.rigid.get().is_some(), exact];
            }
        }
    }
    cases.iter_mut().for_each(|case| case.repeat(&states));
    (cases.into_iter().map(|case| case.found(&yardstick)).collect(), conditions.condition())
}

/// Splits states 0 to `count` into groups that are evaluated together. The first state is its own group, because it
/// shows which directions the others need.
fn groups(count: usize, items: usize) -> impl Iterator<Item = Range<usize>> {
    let together = (AT_ONCE / items.max(1)).clamp(1, rayon::current_num_threads());
    let rest = (1..count).step_by(together).map(move |first| first..count.min(first + together));
    std::iter::once(0..count.min(1)).chain(rest)
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
            held: Surface::default(),
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
        match self.variant.surface(look.at, look.state) {
            Ok(surface) => copy(&mut self.held, surface),
            Err(error) => {
                self.fault = Some(error.to_string());
                return;
            }
        }
        if self.held.positions.len() != 3 * look.judged.len() {
            let (given, wanted) = (self.held.positions.len(), look.judged.len());
            self.fault = Some(format!("{given} coordinates for {wanted} vertices"));
            return;
        }
        self.tally.add(yardstick, &self.held.positions, &self.judged(look));
        self.orient(look);
        if let Some(origin) = &look.origin {
            let (scene, ingredients) = (self.variant.scene(), self.variant.ingredients());
            origin.split(scene, ingredients, &self.held.positions, &mut self.split);
        }
        if look.at == 0 {
            copy(&mut self.first, &self.held);
        }
        if look.along {
            self.step(look);
        }
    }

    /// Error of the step from the previous state.
    fn step(&mut self, look: &Look<'_>) {
        if let Some((positions, before)) = &self.before {
            self.steps = self.steps.join(step_errors([positions, &self.held.positions], [before, &look.judged]));
        }
        let (mut positions, _) = self.before.take().unwrap_or_default();
        std::mem::swap(&mut positions, &mut self.held.positions);
        self.before = Some((positions, Arc::clone(&look.judged)));
    }

    /// Whether the variant outputs normals that must follow the deformed surface.
    fn is_held_to_surface(&self) -> bool {
        !self.held.normals.is_empty() && self.variant.scene().needs.exact_normals
    }

    /// Evaluates the first state again, after all others. Variants with truncation are exempt: their choice of modes
    /// may depend on earlier states.
    fn repeat(&mut self, states: &[State]) {
        if self.fault.is_none() && !self.variant.ingredients().truncates() {
            let again = self.variant.surface(0, &states[0]);
            self.repeatable = again.is_ok_and(|again| bits(again).eq(bits(&self.first)));
        }
    }

    /// The exact positions with this variant's own bounds.
    fn judged(&self, look: &Look<'_>) -> Arc<Vec<Judged>> {
        let ingredients = self.variant.ingredients();
        match ingredients.is_exact() {
            true => Arc::clone(&look.judged),
            false => Arc::new(widen(self.variant.scene(), look.state, &look.judged, ingredients)),
        }
    }

    fn orient(&mut self, look: &Look<'_>) {
        let Surface { normals, tangents, .. } = &self.held;
        if normals.is_empty() {
            return;
        }
        let want = look.directions(self.variant.scene().needs.exact_normals);
        self.turned.add_normals(normals, &want.normals);
        if look.origin.is_some() && look.scenes.bent.is_some() {
            self.turned.add_to_surface(normals, &look.directions(true).normals);
        }
        self.turned.add_tangents(tangents, &want.tangents, normals);
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

/// Copies a surface into the buffers of another.
fn copy(to: &mut Surface, from: &Surface) {
    to.positions.clone_from(&from.positions);
    to.normals.clone_from(&from.normals);
    to.tangents.clone_from(&from.tangents);
}

fn places(judged: &[Judged]) -> Vec<[f64; 3]> {
    judged.par_iter().map(|judged| judged.at).collect()
}

fn bits(surface: &Surface) -> impl Iterator<Item = u32> + '_ {
    let lists = [&surface.positions, &surface.normals, &surface.tangents];
    lists.into_iter().flatten().map(|number| number.to_bits())
}

/// Condition numbers of one state: largest finite one, median, and number of infinite ones.
#[derive(Debug, Default)]
struct Partial {
    largest: f64,
    median: Option<f64>,
    infinite: u64,
}

impl Partial {
    fn of(judged: &[Judged]) -> Self {
        let all = judged.iter().map(|judged| judged.condition).filter(|condition| *condition > 0.0);
        let mut all: Vec<f64> = all.collect();
        let count = all.len();
        all.retain(|condition| condition.is_finite());
        let largest = all.iter().copied().fold(0.0, f64::max);
        Self { largest, infinite: (count - all.len()) as u64, median: median(&mut all) }
    }
}

/// Accumulator for [`Condition`].
#[derive(Debug, Default)]
struct Conditions {
    largest: f64,
    infinite: u64,
    medians: Vec<f64>,
}

impl Conditions {
    fn add(&mut self, state: &Partial) {
        self.infinite += state.infinite;
        self.largest = self.largest.max(state.largest);
        self.medians.extend(state.median);
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
    use crate::ingredients::Ingredients;
    use crate::loads::{Kind, Size};
    use crate::testing::{Damaged, Emulated};
    use crate::variant::{Driven, Label};
    use modalcast_compute::cpu::CpuDeformer;
    use modalcast_model::deform::Backend;
    use modalcast_model::scene::Storage;

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
    fn cpu_passes_all_loads_and_fills_all_figures() {
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
    fn damaged_variant_fails_with_a_reason() {
        let (found, _) = find(Kind::B, 1e-3);
        assert!(!found.passed() && found.faults[0].contains("times its a-priori bound"), "{:?}", found.faults);
        let (found, _) = find(Kind::B, f32::NAN);
        assert!(found.faults[0].contains("not finite"), "{:?}", found.faults);
    }

    /// Validates an emulated deformer that computes by the deformation `does` but declares `says`, which gives its
    /// bounds.
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
    fn approximate_deformers_meet_only_their_own_bounds() {
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
