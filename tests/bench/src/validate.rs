//! Validation: measures the errors of all variants of one workload at random states and along a trajectory.

use std::ops::Range;
use std::sync::{Arc, OnceLock};
use std::time::Instant;

use rayon::prelude::*;
use serde::Serialize;

use super::cuda_variants::has_normals;
use super::error_sources::{ComputedPositions, ErrorSources, ErrorSourcesAccumulator, SharedErrorSources};
use super::errors::{
    ErrorNorms, ErrorScale, IMAGE_SIZE, NormAccumulator, OrientationErrorAccumulator, OrientationErrors,
    PositionErrorAccumulator, PositionErrors, select, step_errors,
};
use super::exact_positions::{ReferenceVertex, reference_vertices, widen_bounds};
use super::motion::WorkloadMotion;
use super::timing::quantile;
use super::variant::Variant;
use super::workloads::{Workload, with_deformation};
use modalcast_compute::reference;
use modalcast_model::deform::DeformedSurface;
use modalcast_model::error::Error;
use modalcast_model::scene::{Camera, DeformationSettings, NormalMethod, Scene, SceneState};

/// Number of random states for which the error is split into its sources. Few, because each split takes at least four
/// evaluations of the scene in f64.
const SPLIT_SEEDS: usize = 4;

/// Condition numbers sum |U q| / |u| of the vertices of a workload.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct ConditionNumbers {
    /// Largest finite condition number.
    pub largest: f64,
    /// Median over the states of the median over the vertices that have modes.
    pub median: f64,
    /// Number of vertices, over all states, with u = 0 although some term of U q is not 0.
    pub infinite: u64,
}

/// Validation result of one variant.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ValidationResult {
    pub errors: PositionErrors,
    /// Error of the displacement x(k + 1) - x(k) between consecutive steps of the trajectory, meters.
    #[serde(rename = "step_metres")]
    pub step_meters: ErrorNorms,
    pub sources: ErrorSources,
    pub orientation: OrientationErrors,
    /// Whether a second evaluation of the same state gives bit-identical results.
    pub repeatable: bool,
    /// Reasons why the variant failed; empty when it passed.
    pub faults: Vec<String>,
    /// Whether the variant was skipped because the machine lacks something.
    #[serde(rename = "left_out")]
    pub is_skipped: bool,
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
    positions: PositionErrorAccumulator,
    orientation: OrientationErrorAccumulator,
    sources: ErrorSourcesAccumulator,
    /// Errors of the displacements between consecutive steps of the trajectory.
    steps: NormAccumulator,
    /// The variant's positions and the references at the previous step of the trajectory.
    previous: Option<(Vec<f32>, Arc<Vec<ReferenceVertex>>)>,
    /// The variant's most recent surface. The buffers are reused.
    surface: DeformedSurface,
    /// The surface at the first state.
    first_surface: DeformedSurface,
    is_repeatable: bool,
    fault: Option<String>,
    is_skipped: bool,
}

/// One state to validate, with the reference values that all variants share.
struct StateSample<'a> {
    index: usize,
    scenes: &'a NormalScenes<'a>,
    state: &'a SceneState,
    /// Exact positions, with the bounds of a deformer that stores U exactly.
    references: Arc<Vec<ReferenceVertex>>,
    condition: StateCondition,
    /// Present for the states whose error is split into its sources.
    error_sources: Option<SharedErrorSources>,
    /// Normals and tangents that are rotated by T, computed on first use.
    rigid: OnceLock<Directions>,
    /// Normals and tangents of the deformed surface, computed on first use.
    exact: OnceLock<Directions>,
    /// Whether the state is a step of the trajectory.
    is_trajectory_step: bool,
}

/// Reference normals and tangents in f64.
struct Directions {
    normals: Vec<[f64; 3]>,
    tangents: Vec<[f64; 4]>,
}

/// The scenes that define the reference normals and tangents.
struct NormalScenes<'a> {
    /// The scene of the workload.
    rigid: &'a Scene,
    /// The same scene with exact normals of the deformed surface; `None` when it has no modes or no normals.
    exact: Option<Arc<Scene>>,
}

impl<'a> NormalScenes<'a> {
    fn new(workload: &'a Workload) -> Self {
        let scene = &workload.scene;
        let exact_normals = DeformationSettings { normals: NormalMethod::Exact, ..scene.deformation };
        let has_exact_normals = scene.features.modes && has_normals(scene);
        let exact = has_exact_normals.then(|| with_deformation(scene, exact_normals)).and_then(Result::ok);
        Self { rigid: scene, exact }
    }
}

impl<'a> StateSample<'a> {
    fn new(scenes: &'a NormalScenes<'a>, index: usize, state: &'a SceneState, is_trajectory_step: bool) -> Self {
        let references = Arc::new(reference_vertices(scenes.rigid, state));
        let (rigid, exact) = (OnceLock::new(), OnceLock::new());
        Self {
            index,
            scenes,
            state,
            condition: StateCondition::of(&references),
            references,
            error_sources: None,
            rigid,
            exact,
            is_trajectory_step,
        }
    }

    /// Reference normals and tangents that are rotated by T.
    fn rigid_directions(&self) -> &Directions {
        self.rigid.get_or_init(|| {
            let normals = || reference::rigid_normals(self.scenes.rigid, self.state);
            let tangents = || reference::rigid_tangents(self.scenes.rigid, self.state);
            let (normals, tangents) = rayon::join(normals, tangents);
            Directions { normals, tangents }
        })
    }

    /// Reference normals and tangents of the deformed surface.
    fn exact_directions(&self) -> &Directions {
        self.exact.get_or_init(|| {
            let (scene, positions) =
                (self.scenes.exact.as_deref().unwrap_or(self.scenes.rigid), positions_of(&self.references));
            let normals = || reference::exact_normals(scene, self.state, &positions);
            let tangents = || reference::exact_tangents(scene, self.state, &positions);
            let (normals, tangents) = rayon::join(normals, tangents);
            Directions { normals, tangents }
        })
    }
}

/// Maximum number of vertices plus corners of a group of states. A vertex takes 40 bytes, the size of its reference. A
/// corner takes up to 112 bytes: rigid and exact normals of 24 bytes, rigid and exact tangents of 32 bytes. A group
/// takes at most 2^24 x 112 bytes = 1.9 GB.
const MAX_GROUP_ITEMS: usize = 1 << 24;

/// How many states of a workload are validated.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ValidationLimits {
    /// Maximum number of random states; at least one is validated.
    pub seeds: usize,
    /// Maximum number of states of the trajectory.
    pub steps: usize,
    /// Seconds after which no state beyond [`MIN_RANDOM_STATES`] and [`MIN_STEPS`] is validated. Random states take at most
    /// `RANDOM_FRACTION` of this time. The groups of states that are evaluated together are finished.
    pub seconds: f64,
}

/// Minimum number of random states, if as many are requested.
pub const MIN_RANDOM_STATES: usize = 10;
/// Minimum number of states of the trajectory, if as many are requested: one step from a state to the next.
pub const MIN_STEPS: usize = 2;
/// Fraction of the time for random states. The rest is for the trajectory.
const RANDOM_FRACTION: f64 = 0.8;

impl ValidationLimits {
    /// Whether the time is over for a state with this index: random states come first, then those of the trajectory.
    fn exclude(&self, index: usize, elapsed_seconds: f64) -> bool {
        match index.checked_sub(self.seeds) {
            None => index >= MIN_RANDOM_STATES && elapsed_seconds >= RANDOM_FRACTION * self.seconds,
            Some(step) => step >= MIN_STEPS && elapsed_seconds >= self.seconds,
        }
    }
}

/// Validates the variants at every vertex and corner of random states and of states of the trajectory, as many as
/// `limits` allows. The reference values are computed once for all variants, in parallel over several states.
pub fn validate(
    workload: &Workload,
    motion: &WorkloadMotion,
    variants: &mut [Box<dyn Variant>],
    limits: ValidationLimits,
) -> (Vec<ValidationResult>, ConditionNumbers) {
    let limits = ValidationLimits { seeds: limits.seeds.max(1), ..limits };
    let ValidationLimits { seeds, steps, .. } = limits;
    let camera = Camera::fit_to_scene(&workload.scene, IMAGE_SIZE.0, IMAGE_SIZE.1);
    let error_scale = ErrorScale::new(&workload.scene, &camera);
    let exact_state =
        |index: usize| if index < seeds { motion.random_state(index) } else { motion.trajectory_state(index - seeds) };
    let state_count = seeds + motion.steps().min(steps);
    let states: Vec<SceneState> = (0..state_count).into_par_iter().map(|index| exact_state(index).state()).collect();
    let mut checks: Vec<VariantCheck<'_>> =
        variants.iter_mut().map(|variant| VariantCheck::new(variant.as_mut(), &states)).collect();
    let (scenes, mut conditions) = (NormalScenes::new(workload), ConditionAccumulator::default());
    // Reference directions that variants needed at the first state. For later states, they are computed in parallel.
    let (mut needs_rigid_directions, mut needs_exact_directions) = (false, false);
    let begin = Instant::now();
    for group in group_states(seeds, state_count, workload.scene.layout.vertices + workload.scene.layout.corners) {
        if limits.exclude(group.start, begin.elapsed().as_secs_f64()) {
            continue;
        }
        let evaluate = |index: usize| {
            let sample = StateSample::new(&scenes, index, &states[index], index >= seeds);
            if needs_rigid_directions {
                sample.rigid_directions();
            }
            if needs_exact_directions {
                sample.exact_directions();
            }
            let has_error_sources = index < SPLIT_SEEDS.min(seeds);
            let error_sources =
                has_error_sources.then(|| SharedErrorSources::new(&workload.scene, exact_state(index), &states[index]));
            StateSample { error_sources, ..sample }
        };
        let samples: Vec<StateSample<'_>> = group.into_par_iter().map(evaluate).collect();
        for sample in samples {
            conditions.add(&sample.condition);
            checks.iter_mut().for_each(|check| check.add_sample(&error_scale, &sample));
            if sample.index == 0 {
                needs_rigid_directions = sample.rigid.get().is_some();
                needs_exact_directions = checks.iter().any(|check| check.has_exact_normals());
            }
        }
    }
    checks.iter_mut().for_each(|check| check.repeat_first_state(&states));
    (checks.into_iter().map(|check| check.result(&error_scale)).collect(), conditions.finish())
}

/// Splits states 0 to `count` into groups that are evaluated together. The first state is a group of its own, because
/// it shows which directions the other states need. No group has both random states, which come before `seeds`, and
/// states of the trajectory.
fn group_states(seeds: usize, count: usize, items_per_state: usize) -> impl Iterator<Item = Range<usize>> {
    let group_size = (MAX_GROUP_ITEMS / items_per_state.max(1)).clamp(1, rayon::current_num_threads());
    let groups_of = move |states: Range<usize>| {
        let end = states.end;
        states.step_by(group_size).map(move |first| first..end.min(first + group_size))
    };
    std::iter::once(0..count.min(1)).chain(groups_of(1..seeds)).chain(groups_of(seeds..count))
}

impl<'a> VariantCheck<'a> {
    fn new(variant: &'a mut dyn Variant, states: &[SceneState]) -> Self {
        let fault = variant.prepare(states).err();
        let is_skipped = matches!(fault, Some(Error::Unavailable { .. }));
        let fault = fault.map(|error| error.to_string());
        Self {
            variant,
            positions: PositionErrorAccumulator::default(),
            orientation: OrientationErrorAccumulator::default(),
            sources: ErrorSourcesAccumulator::default(),
            steps: NormAccumulator::default(),
            previous: None,
            surface: DeformedSurface::default(),
            first_surface: DeformedSurface::default(),
            is_repeatable: true,
            fault,
            is_skipped,
        }
    }

    /// Deforms to the state of a sample and adds the errors. Does nothing after a failure.
    fn add_sample(&mut self, error_scale: &ErrorScale, sample: &StateSample<'_>) {
        if self.fault.is_some() {
            return;
        }
        match self.variant.surface(sample.index, sample.state) {
            Ok(surface) => copy_surface(&mut self.surface, surface),
            Err(error) => {
                self.fault = Some(error.to_string());
                return;
            }
        }
        if self.surface.positions.len() != 3 * sample.references.len() {
            let (expected, given) = (3 * sample.references.len(), self.surface.positions.len());
            self.fault = Some(format!("positions: expected {expected} coordinates, got {given}"));
            return;
        }
        if sample.index == 0 {
            copy_surface(&mut self.first_surface, &self.surface);
        }
        let bounded_references = self.compared_references(&self.bounded_references(sample));
        if let Some(vertices) = self.variant.computed_vertices() {
            self.surface.positions = select(self.surface.positions.as_chunks::<3>().0, vertices).into_flattened();
        }
        self.positions.add(error_scale, &self.surface.positions, &bounded_references);
        self.add_orientation(sample);
        if let Some(error_sources) = &sample.error_sources {
            let (scene, error_model) = (self.variant.scene(), self.variant.error_model());
            let vertices = self.variant.computed_vertices();
            let positions = ComputedPositions { positions: &self.surface.positions, vertices };
            error_sources.add_sources(scene, error_model, positions, &mut self.sources);
        }
        if sample.is_trajectory_step {
            self.add_step(self.compared_references(&sample.references));
        }
    }

    /// Adds the error of the step from the previous state. `references` are those of the vertices that the variant
    /// computes.
    fn add_step(&mut self, references: Arc<Vec<ReferenceVertex>>) {
        if let Some((positions, previous_references)) = &self.previous {
            self.steps =
                self.steps.join(step_errors([positions, &self.surface.positions], [previous_references, &references]));
        }
        // The buffer of the previous positions is reused for the next surface.
        let (mut positions, _) = self.previous.take().unwrap_or_default();
        std::mem::swap(&mut positions, &mut self.surface.positions);
        self.previous = Some((positions, references));
    }

    /// The references of the vertices that the variant computes.
    fn compared_references(&self, references: &Arc<Vec<ReferenceVertex>>) -> Arc<Vec<ReferenceVertex>> {
        match self.variant.computed_vertices() {
            None => Arc::clone(references),
            Some(vertices) => Arc::new(select(references, vertices)),
        }
    }

    /// Whether the variant outputs normals that must follow the deformed surface.
    fn has_exact_normals(&self) -> bool {
        !self.surface.normals.is_empty() && self.variant.scene().features.exact_normals
    }

    /// Evaluates the first state again, after all others.
    fn repeat_first_state(&mut self, states: &[SceneState]) {
        if self.fault.is_none() {
            let surface = self.variant.surface(0, &states[0]);
            self.is_repeatable =
                surface.is_ok_and(|surface| surface_bits(surface).eq(surface_bits(&self.first_surface)));
        }
    }

    /// The exact positions with this variant's own bounds.
    fn bounded_references(&self, sample: &StateSample<'_>) -> Arc<Vec<ReferenceVertex>> {
        let error_model = self.variant.error_model();
        match error_model.is_exact() {
            true => Arc::clone(&sample.references),
            false => Arc::new(widen_bounds(self.variant.scene(), sample.state, &sample.references, error_model)),
        }
    }

    /// Adds the errors of normals and tangents.
    fn add_orientation(&mut self, sample: &StateSample<'_>) {
        let DeformedSurface { normals, tangents, .. } = &self.surface;
        if normals.is_empty() {
            return;
        }
        let has_exact_normals = self.variant.scene().features.exact_normals;
        let want = if has_exact_normals { sample.exact_directions() } else { sample.rigid_directions() };
        self.orientation.add_normals(normals, &want.normals);
        if sample.error_sources.is_some() && sample.scenes.exact.is_some() {
            self.orientation.add_normals_to_surface(normals, &sample.exact_directions().normals);
        }
        self.orientation.add_tangents(tangents, &want.tangents, normals);
    }

    fn result(self, error_scale: &ErrorScale) -> ValidationResult {
        let (errors, orientation) = (self.positions.errors(error_scale), self.orientation.orientation());
        let mut faults: Vec<String> = self.fault.into_iter().collect();
        if !errors.passed() {
            let PositionErrors { of_bound, not_finite, .. } = errors;
            faults
                .push(format!("error of {of_bound:.3} times its a-priori bound, {not_finite} coordinates not finite"));
        }
        if orientation.invalid_directions > 0 {
            faults.push(format!(
                "{} normals or tangents are not finite, too short or of the wrong sign",
                orientation.invalid_directions
            ));
        }
        ValidationResult {
            errors,
            step_meters: self.steps.norms(error_scale.unit()).unwrap_or_default(),
            sources: self.sources.sources(error_scale.unit()),
            orientation,
            repeatable: self.is_repeatable,
            faults,
            is_skipped: self.is_skipped,
        }
    }
}

/// Copies a surface into the buffers of another.
fn copy_surface(dst: &mut DeformedSurface, src: &DeformedSurface) {
    dst.positions.clone_from(&src.positions);
    dst.normals.clone_from(&src.normals);
    dst.tangents.clone_from(&src.tangents);
}

fn positions_of(references: &[ReferenceVertex]) -> Vec<[f64; 3]> {
    references.par_iter().map(|reference| reference.position).collect()
}

fn surface_bits(surface: &DeformedSurface) -> impl Iterator<Item = u32> + '_ {
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
    fn of(references: &[ReferenceVertex]) -> Self {
        let positive = references.iter().map(|reference| reference.condition).filter(|condition| *condition > 0.0);
        let mut conditions: Vec<f64> = positive.collect();
        let count = conditions.len();
        conditions.retain(|condition| condition.is_finite());
        let largest = conditions.iter().copied().fold(0.0, f64::max);
        Self { largest, infinite: (count - conditions.len()) as u64, median: quantile(&mut conditions, 0.5) }
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

    fn finish(mut self) -> ConditionNumbers {
        let median = quantile(&mut self.medians, 0.5).unwrap_or(0.0);
        ConditionNumbers { largest: self.largest, median, infinite: self.infinite }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::error_model::ErrorModel;
    use crate::testing::{EmulatedVariant, InaccurateVariant};
    use crate::variant::{DeformerVariant, VariantLabel};
    use crate::workloads::{Size, WorkloadKind};
    use modalcast_compute::cpu::CpuDeformer;
    use modalcast_model::deform::Backend;
    use modalcast_model::scene::StorageType;

    /// This number of random states and all steps, without a time limit.
    fn limits(seeds: usize) -> ValidationLimits {
        ValidationLimits { seeds, steps: usize::MAX, seconds: f64::INFINITY }
    }

    /// Validates the CPU deformer with `error` added to its last coordinate, at four random states and the trajectory.
    fn validate_cpu(kind: WorkloadKind, error: f32) -> (ValidationResult, ConditionNumbers) {
        let workload = kind.build(Size::Quick).expect("expected a load");
        let label = VariantLabel::new("cpu", Backend::Cpu, &workload.scene);
        let cpu = DeformerVariant::new(label, &workload.scene, Box::new(CpuDeformer::new(&workload.scene)));
        let mut variants: Vec<Box<dyn Variant>> = vec![Box::new(InaccurateVariant::new(cpu, error))];
        let motion = WorkloadMotion::new(&workload, None);
        let (mut results, condition) = validate(&workload, &motion, &mut variants, limits(4));
        (results.remove(0), condition)
    }

    #[test]
    fn cpu_passes_all_loads_and_fills_all_results() {
        let (found, condition) = validate_cpu(WorkloadKind::OneDomain { has_normal_map: true }, 0.0);
        assert!(found.passed() && found.repeatable, "{:?}", found.faults);
        assert_eq!(found.errors.states, 4 + 24, "expected the random states and the steps of the trajectory");
        assert!(found.errors.meters.largest > 0.0 && found.errors.of_diagonal.largest < 1e-6, "{found:?}");
        assert!(found.step_meters.largest > 0.0 && found.step_meters.largest < 2e-6, "{found:?}");
        let normals = found.orientation.normals_degrees.expect("expected normals");
        let tangents = found.orientation.tangents_degrees.expect("expected tangents");
        let to_surface = found.orientation.normals_to_surface_degrees.expect("expected normals");
        assert!(to_surface.largest > 0.1, "expected rigid normals to differ from surface normals, got {found:?}");
        assert!(normals.largest < 1e-4 && tangents.largest < 1e-4, "{found:?}");
        assert!(found.orientation.normal_dot_tangent.expect("expected dot products").largest < 1e-6, "{found:?}");
        let ErrorSources { storage, q, accumulation, transform, origin } = found.sources;
        assert_eq!(storage, ErrorNorms::default());
        assert!([q, accumulation, transform, origin].iter().all(|part| part.largest > 0.0), "{:?}", found.sources);
        assert!(condition.median > 1.0 && condition.largest > condition.median, "{condition:?}");
        for kind in
            [WorkloadKind::ManyDomains, WorkloadKind::TinyDomains, WorkloadKind::Cancelling, WorkloadKind::Plant(1)]
        {
            let (found, _) = validate_cpu(kind, 0.0);
            assert!(found.passed(), "{kind:?}: {:?}", found.faults);
        }
    }

    #[test]
    fn inaccurate_variant_fails_with_a_reason() {
        let (found, _) = validate_cpu(WorkloadKind::ManyDomains, 1e-3);
        assert!(!found.passed() && found.faults[0].contains("times its a-priori bound"), "{:?}", found.faults);
        let (found, _) = validate_cpu(WorkloadKind::ManyDomains, f32::NAN);
        assert!(found.faults[0].contains("not finite"), "{:?}", found.faults);
    }

    #[test]
    fn only_computed_vertices_are_compared() {
        let workload = WorkloadKind::ManyDomains.build(Size::Quick).expect("expected a load");
        let validate_without_last_vertex = |error: f32, first: u32| {
            let label = VariantLabel::new("cpu", Backend::Cpu, &workload.scene);
            let cpu = DeformerVariant::new(label, &workload.scene, Box::new(CpuDeformer::new(&workload.scene)));
            let last = workload.scene.layout.vertices as u32 - 1;
            let mut variants: Vec<Box<dyn Variant>> =
                vec![Box::new(InaccurateVariant::new(cpu, error).computing((first..last).collect()))];
            let motion = WorkloadMotion::new(&workload, None);
            validate(&workload, &motion, &mut variants, limits(4)).0.remove(0)
        };
        let omitted = validate_without_last_vertex(f32::NAN, 0);
        assert!(omitted.passed() && omitted.repeatable, "{:?}", omitted.faults);
        assert_eq!(omitted, validate_without_last_vertex(0.0, 0), "expected no influence of the omitted vertex");
        // The control: the compared positions belong to the listed vertices, not to as many first ones.
        assert_ne!(omitted.errors.meters, validate_without_last_vertex(0.0, 1000).errors.meters);
        assert!(validate_without_last_vertex(0.0, 1000).passed());
    }

    /// Validates an emulated deformer that applies one deformation and declares another, which gives its bounds.
    fn emulate(applied: DeformationSettings, declared: DeformationSettings) -> ValidationResult {
        let workload = WorkloadKind::ManyDomains.build(Size::Quick).expect("expected a load");
        let [applied_scene, declared_scene] = [applied, declared]
            .map(|deformation| with_deformation(&workload.scene, deformation).expect("expected a scene"));
        let label = VariantLabel::new("emulated", Backend::Cpu, &declared_scene);
        let (applied, declared) = (ErrorModel::of(&applied_scene), ErrorModel::of(&declared_scene));
        let emulated =
            EmulatedVariant { label, scene: declared_scene, applied, declared, surface: DeformedSurface::default() };
        let mut variants: Vec<Box<dyn Variant>> = vec![Box::new(emulated)];
        validate(&workload, &WorkloadMotion::new(&workload, None), &mut variants, limits(3)).0.remove(0)
    }

    #[test]
    fn at_least_one_state_is_validated() {
        let workload = WorkloadKind::OneDomain { has_normal_map: false }.build(Size::Quick).expect("expected a load");
        let label = VariantLabel::new("cpu", Backend::Cpu, &workload.scene);
        let cpu = DeformerVariant::new(label, &workload.scene, Box::new(CpuDeformer::new(&workload.scene)));
        let mut variants: Vec<Box<dyn Variant>> = vec![Box::new(cpu)];
        let limits = ValidationLimits { seeds: 0, steps: 0, seconds: 0.0 };
        let (results, _) = validate(&workload, &WorkloadMotion::new(&workload, None), &mut variants, limits);
        assert!(results[0].errors.states == 1 && results[0].passed(), "{results:?}");
    }

    #[test]
    fn time_limit_keeps_the_minimum_of_states() {
        let workload = WorkloadKind::Single { power: 8, rank: 2 }.build(Size::Full).expect("expected a load");
        let count_states = |seeds: usize, seconds: f64| {
            let label = VariantLabel::new("cpu", Backend::Cpu, &workload.scene);
            let cpu = DeformerVariant::new(label, &workload.scene, Box::new(CpuDeformer::new(&workload.scene)));
            let mut variants: Vec<Box<dyn Variant>> = vec![Box::new(cpu)];
            let limits = ValidationLimits { seconds, ..limits(seeds) };
            let (results, _) = validate(&workload, &WorkloadMotion::new(&workload, None), &mut variants, limits);
            assert!(results[0].passed() && results[0].step_meters.largest > 0.0, "{results:?}");
            results[0].errors.states
        };
        assert_eq!(count_states(4000, f64::INFINITY), 4000 + 24, "the control: no limit");
        // The groups that contain the last states of the minimum are finished.
        let most = MIN_RANDOM_STATES + MIN_STEPS + 2 * rayon::current_num_threads();
        assert!(
            (MIN_RANDOM_STATES + MIN_STEPS..=most).contains(&count_states(4000, 0.0)),
            "{}",
            count_states(4000, 0.0)
        );
        assert!(count_states(4, 0.0) <= 4 + MIN_STEPS + rayon::current_num_threads());
    }

    #[test]
    fn denormal_modes_pass_and_are_no_false_failure() {
        let workload = crate::testing::with_denormal_modes(&WorkloadKind::Single { power: 6, rank: 4 });
        let label = VariantLabel::new("cpu", Backend::Cpu, &workload.scene);
        let cpu = DeformerVariant::new(label, &workload.scene, Box::new(CpuDeformer::new(&workload.scene)));
        let mut variants: Vec<Box<dyn Variant>> = vec![Box::new(cpu)];
        let (results, _) = validate(&workload, &WorkloadMotion::new(&workload, None), &mut variants, limits(6));
        assert!(results[0].passed(), "{:?}", results[0].faults);
    }

    #[test]
    fn approximate_deformers_meet_only_their_own_bounds() {
        let storage = |storage| DeformationSettings { storage, ..DeformationSettings::default() };
        let [f16, bf16, int8] = [StorageType::F16, StorageType::Bf16, StorageType::Int8].map(storage);
        for deformation in [f16, bf16, int8] {
            let found = emulate(deformation, deformation);
            assert!(found.passed(), "{deformation:?}: {:?}", found.faults);
            assert!(found.errors.of_bound > 0.05, "{deformation:?}: expected a tight bound, got {found:?}");
            assert_eq!(found.sources.accumulation, ErrorNorms::default(), "{deformation:?}");
            assert!(found.sources.storage.largest > 0.0, "{deformation:?}");
            let declared_exact = emulate(deformation, DeformationSettings::default());
            assert!(!declared_exact.passed(), "{deformation:?}: expected an error above the bound of exact sums");
        }
        assert!(
            !emulate(int8, f16).passed() && !emulate(bf16, f16).passed(),
            "expected coarser storage than declared to fail"
        );
    }
}
