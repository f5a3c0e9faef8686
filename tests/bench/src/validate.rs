//! Validation: the errors of all variants of one load, over random seeds and step by step along a trajectory.

use std::ops::Range;
use std::sync::{Arc, OnceLock};

use rayon::prelude::*;
use serde::Serialize;

use super::cuda_variants::has_normals;
use super::error_sources::{ErrorSources, ErrorSourcesAccumulator, SharedErrorSources};
use super::errors::{
    ErrorNorms, ErrorScale, IMAGE_SIZE, NormAccumulator, OrientationErrorAccumulator, OrientationErrors,
    PositionErrorAccumulator, PositionErrors, step_errors,
};
use super::exact_positions::{ReferenceVertex, reference_vertices, widen};
use super::motion::WorkloadMotion;
use super::timing::quantile;
use super::variant::Variant;
use super::workloads::{Workload, with_deformation};
use modalcast_compute::reference;
use modalcast_model::deform::DeformedSurface;
use modalcast_model::error::Error;
use modalcast_model::scene::{Camera, DeformationSettings, NormalMethod, Scene, SceneState};

/// Number of seeds for which the error is split into its sources. Each split costs five evaluations in f64.
const SPLIT: usize = 4;

/// Condition numbers of the modal sums of a load: sum |U q| / |u| per vertex.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct ConditionNumbers {
    /// Largest finite condition number.
    pub largest: f64,
    /// Median over the states of the median over the vertices that have modes.
    pub median: f64,
    /// Number of vertices over all states whose nonzero terms sum to exactly zero.
    pub infinite: u64,
}

/// Validation result of one variant.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ValidationResult {
    pub errors: PositionErrors,
    /// Error of x(k + 1) - x(k) along the trajectory, meters.
    #[serde(rename = "step_metres")]
    pub step_meters: ErrorNorms,
    pub sources: ErrorSources,
    pub orientation: OrientationErrors,
    /// Whether the same state gives bit-identical results when it is evaluated again.
    pub repeatable: bool,
    /// Reasons why the variant failed; empty when it passed.
    pub faults: Vec<String>,
    /// Whether the variant was skipped because something that it needs is unavailable on this machine.
    pub left_out: bool,
}

impl ValidationResult {
    /// Whether the variant passed validation, so that it may be timed.
    pub fn passed(&self) -> bool {
        self.faults.is_empty()
    }
}

/// Accumulator for the [`ValidationResult`] of one variant.
struct VariantCheck<'a> {
    variant: &'a mut dyn Variant,
    tally: PositionErrorAccumulator,
    turned: OrientationErrorAccumulator,
    split: ErrorSourcesAccumulator,
    steps: NormAccumulator,
    before: Option<(Vec<f32>, Arc<Vec<ReferenceVertex>>)>,
    /// The variant's most recent surface. The buffers are reused.
    held: DeformedSurface,
    first: DeformedSurface,
    repeatable: bool,
    fault: Option<String>,
    left_out: bool,
}

/// One state to validate, with the reference values that all variants share.
struct StateSample<'a> {
    at: usize,
    scenes: &'a Scenes<'a>,
    state: &'a SceneState,
    /// Exact positions, with the bounds of a deformer that stores U exactly and sums all modes.
    judged: Arc<Vec<ReferenceVertex>>,
    partial: StateCondition,
    /// Present for the states whose error is split into its sources.
    origin: Option<SharedErrorSources>,
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
    fn new(load: &'a Workload) -> Self {
        let exact_normals = DeformationSettings { normals: NormalMethod::Exact, ..load.scene.deformation };
        let bends = load.scene.needs.modes && has_normals(&load.scene);
        let bent = bends.then(|| with_deformation(&load.scene, exact_normals)).and_then(Result::ok);
        Self { rigid: &load.scene, bent }
    }
}

impl<'a> StateSample<'a> {
    fn new(scenes: &'a Scenes<'a>, at: usize, state: &'a SceneState, along: bool) -> Self {
        let judged = Arc::new(reference_vertices(scenes.rigid, state));
        let (rigid, exact) = (OnceLock::new(), OnceLock::new());
        Self { at, scenes, state, partial: StateCondition::of(&judged), judged, origin: None, rigid, exact, along }
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
                let normals = || reference::rigid_normals(self.scenes.rigid, self.state);
                let (normals, tangents) =
                    rayon::join(normals, || reference::rigid_tangents(self.scenes.rigid, self.state));
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
    load: &Workload,
    motion: &WorkloadMotion,
    variants: &mut [Box<dyn Variant>],
    (seeds, steps): (usize, usize),
) -> (Vec<ValidationResult>, ConditionNumbers) {
    let camera = Camera::fit_to_scene(&load.scene, IMAGE_SIZE.0, IMAGE_SIZE.1);
    let yardstick = ErrorScale::new(&load.scene, &camera);
    let truth = |at: usize| if at < seeds { motion.seed(at) } else { motion.step(at - seeds) };
    let count = seeds + motion.steps().min(steps);
    let states: Vec<SceneState> = (0..count).into_par_iter().map(|at| truth(at).state()).collect();
    let mut cases: Vec<VariantCheck<'_>> =
        variants.iter_mut().map(|variant| VariantCheck::new(variant.as_mut(), &states)).collect();
    let (scenes, mut conditions) = (Scenes::new(load), ConditionAccumulator::default());
    // Which directions the variants needed at the first state. For the other states these are computed beforehand, in
    // parallel.
    let mut asked = [false; 2];
    for group in groups(count, load.scene.layout.vertices + load.scene.layout.corners) {
        let look = |at: usize| {
            let look = StateSample::new(&scenes, at, &states[at], at >= seeds);
            for exact in [false, true].into_iter().filter(|exact| asked[usize::from(*exact)]) {
                look.directions(exact);
            }
            let split = at < SPLIT.min(seeds);
            StateSample { origin: split.then(|| SharedErrorSources::new(&load.scene, truth(at), &states[at])), ..look }
        };
        let looks: Vec<StateSample<'_>> = group.into_par_iter().map(look).collect();
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

impl<'a> VariantCheck<'a> {
    fn new(variant: &'a mut dyn Variant, states: &[SceneState]) -> Self {
        let fault = variant.prepare(states).err();
        let left_out = matches!(fault, Some(Error::Unavailable { .. }));
        let fault = fault.map(|error| error.to_string());
        Self {
            variant,
            tally: PositionErrorAccumulator::default(),
            turned: OrientationErrorAccumulator::default(),
            split: ErrorSourcesAccumulator::default(),
            steps: NormAccumulator::default(),
            before: None,
            held: DeformedSurface::default(),
            first: DeformedSurface::default(),
            repeatable: true,
            fault,
            left_out,
        }
    }

    fn look(&mut self, yardstick: &ErrorScale, look: &StateSample<'_>) {
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
            let (scene, error_model) = (self.variant.scene(), self.variant.error_model());
            origin.split(scene, error_model, &self.held.positions, &mut self.split);
        }
        if look.at == 0 {
            copy(&mut self.first, &self.held);
        }
        if look.along {
            self.step(look);
        }
    }

    /// Error of the step from the previous state.
    fn step(&mut self, look: &StateSample<'_>) {
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
    fn repeat(&mut self, states: &[SceneState]) {
        if self.fault.is_none() && !self.variant.error_model().truncates() {
            let again = self.variant.surface(0, &states[0]);
            self.repeatable = again.is_ok_and(|again| bits(again).eq(bits(&self.first)));
        }
    }

    /// The exact positions with this variant's own bounds.
    fn judged(&self, look: &StateSample<'_>) -> Arc<Vec<ReferenceVertex>> {
        let error_model = self.variant.error_model();
        match error_model.is_exact() {
            true => Arc::clone(&look.judged),
            false => Arc::new(widen(self.variant.scene(), look.state, &look.judged, error_model)),
        }
    }

    fn orient(&mut self, look: &StateSample<'_>) {
        let DeformedSurface { normals, tangents, .. } = &self.held;
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

    fn found(self, yardstick: &ErrorScale) -> ValidationResult {
        let (errors, orientation) = (self.tally.errors(yardstick), self.turned.orientation());
        let mut faults: Vec<String> = self.fault.into_iter().collect();
        if !errors.passed() {
            let PositionErrors { of_bound, not_finite, .. } = errors;
            faults.push(format!("{of_bound:.3} times its a-priori bound, {not_finite} coordinates not finite"));
        }
        if orientation.broken > 0 {
            faults.push(format!("{} normals or tangents are no directions", orientation.broken));
        }
        ValidationResult {
            errors,
            step_meters: self.steps.spread(yardstick.unit()).unwrap_or_default(),
            sources: self.split.sources(yardstick.unit()),
            orientation,
            repeatable: self.repeatable,
            faults,
            left_out: self.left_out,
        }
    }
}

/// Copies a surface into the buffers of another.
fn copy(to: &mut DeformedSurface, from: &DeformedSurface) {
    to.positions.clone_from(&from.positions);
    to.normals.clone_from(&from.normals);
    to.tangents.clone_from(&from.tangents);
}

fn places(judged: &[ReferenceVertex]) -> Vec<[f64; 3]> {
    judged.par_iter().map(|judged| judged.at).collect()
}

fn bits(surface: &DeformedSurface) -> impl Iterator<Item = u32> + '_ {
    let lists = [&surface.positions, &surface.normals, &surface.tangents];
    lists.into_iter().flatten().map(|number| number.to_bits())
}

/// Condition numbers of one state: largest finite one, median, and number of infinite ones.
#[derive(Debug, Default)]
struct StateCondition {
    largest: f64,
    median: Option<f64>,
    infinite: u64,
}

impl StateCondition {
    fn of(judged: &[ReferenceVertex]) -> Self {
        let all = judged.iter().map(|judged| judged.condition).filter(|condition| *condition > 0.0);
        let mut all: Vec<f64> = all.collect();
        let count = all.len();
        all.retain(|condition| condition.is_finite());
        let largest = all.iter().copied().fold(0.0, f64::max);
        Self { largest, infinite: (count - all.len()) as u64, median: quantile(&mut all, 0.5) }
    }
}

/// Accumulator for [`ConditionNumbers`].
#[derive(Debug, Default)]
struct ConditionAccumulator {
    largest: f64,
    infinite: u64,
    medians: Vec<f64>,
}

impl ConditionAccumulator {
    fn add(&mut self, state: &StateCondition) {
        self.infinite += state.infinite;
        self.largest = self.largest.max(state.largest);
        self.medians.extend(state.median);
    }

    fn condition(mut self) -> ConditionNumbers {
        let median = quantile(&mut self.medians, 0.5).unwrap_or(0.0);
        ConditionNumbers { largest: self.largest, median, infinite: self.infinite }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::error_model::ErrorModel;
    use crate::testing::{Damaged, Emulated};
    use crate::variant::{DeformerVariant, VariantLabel};
    use crate::workloads::{Size, WorkloadKind};
    use modalcast_compute::cpu::CpuDeformer;
    use modalcast_model::deform::Backend;
    use modalcast_model::scene::StorageType;

    fn find(kind: WorkloadKind, damage: f32) -> (ValidationResult, ConditionNumbers) {
        let load = kind.build(Size::Quick).expect("built");
        let label = VariantLabel::new("cpu", Backend::Cpu, &load.scene);
        let cpu = DeformerVariant::new(label, &load.scene, Box::new(CpuDeformer::new(&load.scene)));
        let mut variants: Vec<Box<dyn Variant>> = vec![Box::new(Damaged::new(cpu, damage))];
        let motion = WorkloadMotion::new(&load, None);
        let (mut found, condition) = validate(&load, &motion, &mut variants, (4, usize::MAX));
        (found.remove(0), condition)
    }

    #[test]
    fn cpu_passes_all_loads_and_fills_all_figures() {
        let (found, condition) = find(WorkloadKind::OneDomain { dressed: true }, 0.0);
        assert!(found.passed() && found.repeatable, "{:?}", found.faults);
        assert_eq!(found.errors.states, 4 + 24);
        assert!(found.errors.meters.largest > 0.0 && found.errors.of_diagonal.largest < 1e-6, "{found:?}");
        assert!(found.step_meters.largest > 0.0 && found.step_meters.largest < 2e-6, "{found:?}");
        let normals = found.orientation.normals_degrees.expect("normals");
        let tangents = found.orientation.tangents_degrees.expect("tangents");
        let to_surface = found.orientation.normals_to_surface_degrees.expect("normals");
        assert!(to_surface.largest > 0.1, "rigid normals do not follow the surface: {found:?}");
        assert!(normals.largest < 1e-4 && tangents.largest < 1e-4, "{found:?}");
        assert!(found.orientation.normal_dot_tangent.expect("dots").largest < 1e-6, "{found:?}");
        let ErrorSources { storage, q, accumulation, transform, origin, truncation } = found.sources;
        assert_eq!([storage, truncation], [ErrorNorms::default(); 2]);
        assert!([q, accumulation, transform, origin].iter().all(|part| part.largest > 0.0), "{:?}", found.sources);
        assert!(condition.median > 1.0 && condition.largest > condition.median, "{condition:?}");
        for kind in
            [WorkloadKind::ManyDomains, WorkloadKind::TinyDomains, WorkloadKind::Cancelling, WorkloadKind::Plant(1)]
        {
            let (found, _) = find(kind, 0.0);
            assert!(found.passed(), "{kind:?}: {:?}", found.faults);
        }
    }

    #[test]
    fn damaged_variant_fails_with_a_reason() {
        let (found, _) = find(WorkloadKind::ManyDomains, 1e-3);
        assert!(!found.passed() && found.faults[0].contains("times its a-priori bound"), "{:?}", found.faults);
        let (found, _) = find(WorkloadKind::ManyDomains, f32::NAN);
        assert!(found.faults[0].contains("not finite"), "{:?}", found.faults);
    }

    /// Validates an emulated deformer that computes by the deformation `does` but declares `says`, which gives its
    /// bounds.
    fn emulate(does: DeformationSettings, says: DeformationSettings) -> ValidationResult {
        let load = WorkloadKind::ManyDomains.build(Size::Quick).expect("built");
        let [done, said] =
            [does, says].map(|deformation| with_deformation(&load.scene, deformation).expect("restated"));
        let label = VariantLabel::new("emulated", Backend::Cpu, &said);
        let (does, says) = (ErrorModel::of(&done), ErrorModel::of(&said));
        let emulated = Emulated { label, scene: said, does, says, surface: DeformedSurface::default() };
        let mut variants: Vec<Box<dyn Variant>> = vec![Box::new(emulated)];
        validate(&load, &WorkloadMotion::new(&load, None), &mut variants, (3, usize::MAX)).0.remove(0)
    }

    #[test]
    fn approximate_deformers_meet_only_their_own_bounds() {
        let storage = |storage| DeformationSettings { storage, ..DeformationSettings::default() };
        let [half, brain, eighth] = [StorageType::F16, StorageType::Bf16, StorageType::Int8].map(storage);
        let short = DeformationSettings { truncation: Some(1e-4), ..DeformationSettings::default() };
        for deformation in [half, brain, eighth, short, DeformationSettings { truncation: Some(1e-4), ..eighth }] {
            let found = emulate(deformation, deformation);
            assert!(found.passed(), "{deformation:?}: {:?}", found.faults);
            assert!(found.errors.of_bound > 0.05, "{deformation:?} is judged by a bound of its size: {found:?}");
            assert_eq!(found.sources.accumulation, ErrorNorms::default(), "{deformation:?}");
            assert_eq!(found.sources.storage.largest > 0.0, deformation.storage != StorageType::F32);
            assert_eq!(found.sources.truncation.largest > 0.0, deformation.truncation.is_some());
            assert!(!emulate(deformation, DeformationSettings::default()).passed(), "{deformation:?} is not exact");
        }
        assert!(!emulate(eighth, half).passed() && !emulate(brain, half).passed(), "coarser than it says");
    }
}
