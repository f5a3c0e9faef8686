//! Runs a case and measures its errors in windows of steps.

use std::sync::Arc;

use nalgebra::{Isometry3, Matrix3, Matrix4, Vector3};
use serde::Serialize;

use super::case::Case;
use modalcast_compute::cpu::CpuDeformer;
use modalcast_compute::reference;
use modalcast_model::deform::{DeformedSurface, Deformer as _};
use modalcast_model::error::Result;
use modalcast_model::scene::{Scene, SceneState, StepUpdate};

/// Steps of a window. A single step would be a poor measure, because the error depends on the pose.
const WINDOW: u64 = 100;
/// Largest quotient of an error of a later window and that of the first [`WINDOW`] steps that counts as constant.
const MAX_GROWTH: f64 = 2.0;
/// Error bound per axis in multiples of the spacing, from [`modalcast_model::scene::FloatingOrigins`]: 7 x 2^-23.
const ORIGIN_ERROR: f64 = 7.0 / (1 << 23) as f64;

/// The largest errors of several steps.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct DriftErrors {
    /// Distance of a vertex from its position in the exact motion.
    pub position_meters: f64,
    /// Distance of a vertex from its position in f64 for the same state, which is rounded to f32.
    pub deformer_meters: f64,
    /// Distance of a vertex from its position on a server that has received only this step.
    pub path_meters: f64,
    /// Deviation from 1 of the determinant of the linear part A of T.
    pub determinant: f64,
    /// Entry of A^T A - I.
    pub orthogonality: f64,
    /// Number of steps whose bits differ from those of a new deformer with the same state.
    pub steps_unlike_new_deformer: u64,
}

/// Errors of the steps `first_step` to `last_step`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct DriftWindow {
    pub first_step: u64,
    pub last_step: u64,
    #[serde(flatten)]
    pub errors: DriftErrors,
}

/// Result of one case.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DriftResult {
    pub name: &'static str,
    /// Whether the errors must grow: a negative control.
    #[serde(rename = "control")]
    pub is_control: bool,
    pub domains: usize,
    /// The largest error of a later window divided by that of the first window.
    pub growth: f64,
    /// Steps in which the floating origin of domain 0 differs from that of the previous step.
    pub origin_changes: u64,
    /// Bound of `path_meters`: twice the bound of one position. 0 without floating origins.
    pub path_bound_meters: f64,
    /// The first step whose T a scene with rigid transforms rejects, because it shears or does not scale uniformly.
    pub first_rejected_step: Option<u64>,
    pub windows: Vec<DriftWindow>,
}

/// Runs a case and measures its errors in windows that end at the steps 1, 10, 100, ..., at half of the steps, where a
/// domain that travels is farthest from its start, and at the last step.
pub(super) fn measure(mut case: Case, steps: u64) -> Result<DriftResult> {
    let scene = case.scene()?;
    let (mut state, mut deformer) = (SceneState::rest(&scene), CpuDeformer::new(&scene));
    let mut windows = list_windows(steps);
    let (mut origin_changes, mut first_rejected_step) = (0, None);
    for step in 1..=steps {
        let (pose, previous_origin) = (case.pose(step, steps), state.origin_of(0));
        let update = StepUpdate::parse(&scene, &case.next_step(step, &pose))?;
        state.apply(&scene, &update);
        deformer.deform(&state)?;
        origin_changes += u64::from(state.origin_of(0) != previous_origin);
        if first_rejected_step.is_none() && !state.transforms[0].is_similarity() {
            first_rejected_step = Some(step);
        }
        if windows.iter().any(|window| window.contains(step)) {
            let errors = measure_step(&scene, &state, &update, deformer.surface()?, &pose)?;
            for window in windows.iter_mut().filter(|window| window.contains(step)) {
                window.errors = window.errors.join(&errors);
            }
        }
    }
    let path_bound = 2.0 * 3_f64.sqrt() * ORIGIN_ERROR * scene.origin_grids.spacing(0);
    Ok(DriftResult {
        name: case.name,
        is_control: case.is_control,
        domains: scene.domains.len(),
        growth: growth(&windows),
        origin_changes,
        path_bound_meters: if state.origins.is_some() { path_bound } else { 0.0 },
        first_rejected_step,
        windows,
    })
}

fn list_windows(steps: u64) -> Vec<DriftWindow> {
    let powers_of_ten = std::iter::successors(Some(1), |step: &u64| step.checked_mul(10));
    let mut last_steps: Vec<u64> = powers_of_ten.take_while(|step| *step < steps).chain([steps / 2, steps]).collect();
    last_steps.sort_unstable();
    last_steps.dedup();
    let window = |last_step: u64| DriftWindow {
        first_step: last_step.saturating_sub(WINDOW - 1).max(1),
        last_step,
        errors: DriftErrors::default(),
    };
    last_steps.into_iter().map(window).collect()
}

fn growth(windows: &[DriftWindow]) -> f64 {
    let largest_error = |is_early: bool| {
        let windows = windows.iter().filter(|window| (window.last_step <= WINDOW) == is_early);
        windows.map(|window| window.errors.position_meters).fold(0.0, f64::max)
    };
    largest_error(false) / largest_error(true)
}

/// Errors of one step. `surface` is the result of the deformer that received all steps.
pub(super) fn measure_step(
    scene: &Arc<Scene>,
    state: &SceneState,
    update: &StepUpdate,
    surface: &DeformedSurface,
    pose: &Isometry3<f64>,
) -> Result<DriftErrors> {
    let deform_anew = |state: &SceneState| {
        let mut deformer = CpuDeformer::new(scene);
        deformer.deform(state)?;
        deformer.surface().cloned()
    };
    let mut state_of_step = SceneState::rest(scene);
    state_of_step.apply(scene, update);
    let surface_of_step = deform_anew(&state_of_step)?;
    let positions = world_positions(scene, state, &surface.positions);
    let relative_positions: Vec<_> =
        surface.positions.as_chunks::<3>().0.iter().map(|point| Vector3::from(*point).cast()).collect();
    let reference_positions: Vec<_> = reference::deform(scene, state).into_iter().map(Vector3::from).collect();
    let linear = state.transforms[0].linear();
    Ok(DriftErrors {
        position_meters: largest_distance(&positions, &exact_positions(scene, state, pose)),
        deformer_meters: largest_distance(&relative_positions, &reference_positions),
        path_meters: largest_distance(&positions, &world_positions(scene, &state_of_step, &surface_of_step.positions)),
        determinant: (linear.determinant() - 1.0).abs(),
        orthogonality: (linear.transpose() * linear - Matrix3::identity()).abs().max(),
        steps_unlike_new_deformer: u64::from(bits(&deform_anew(state)?) != bits(surface)),
    })
}

/// The bits of positions and normals. A comparison of f32 would not distinguish 0 from -0.
fn bits(surface: &DeformedSurface) -> [&[u32]; 2] {
    [&surface.positions, &surface.normals].map(|numbers| bytemuck::cast_slice(numbers))
}

/// Positions relative to the scene's origin.
fn world_positions(scene: &Scene, state: &SceneState, positions: &[f32]) -> Vec<Vector3<f64>> {
    let (positions, mut world_positions) = (positions.as_chunks::<3>().0, Vec::with_capacity(positions.len() / 3));
    for (domain, layout) in scene.layout.domains.iter().enumerate() {
        let origin = Vector3::from(state.origin_of(scene.transform_roots.root_of(domain)));
        let domain_positions = &positions[layout.first_vertex..][..layout.vertices];
        world_positions.extend(domain_positions.iter().map(|point| origin + Vector3::from(*point).cast()));
    }
    world_positions
}

/// Positions of the exact motion: domain 0 has the pose `pose`, and no product of frames is rounded to f32.
fn exact_positions(scene: &Scene, state: &SceneState, pose: &Isometry3<f64>) -> Vec<Vector3<f64>> {
    let displacements = reference::displacements(scene, state);
    let mut positions = Vec::with_capacity(displacements.len());
    let mut world_from_domain: Vec<Matrix4<f64>> = Vec::with_capacity(scene.domains.len());
    for (index, domain) in scene.domains.iter().enumerate() {
        let transform = match &domain.follows {
            Some(constraint) => world_from_domain[constraint.parent] * constraint.frame.to_matrix(),
            None if index == 0 => pose.to_homogeneous(),
            None => domain.placement.to_matrix(),
        };
        let displacements = &displacements[scene.layout.domains[index].first_vertex..];
        for (rest, displacement) in scene.shape_of(index).mesh.rest_positions().iter().zip(displacements) {
            let deformed = Vector3::from(*rest).cast() + Vector3::from(*displacement);
            positions.push(transform.transform_point(&deformed.into()).coords);
        }
        world_from_domain.push(transform);
    }
    positions
}

/// Infinite if a coordinate is not a number, because `f64::max` ignores such distances.
fn largest_distance(points: &[Vector3<f64>], others: &[Vector3<f64>]) -> f64 {
    let distances = points.iter().zip(others).map(|(point, other)| (point - other).norm());
    distances.map(|distance| if distance.is_nan() { f64::INFINITY } else { distance }).fold(0.0, f64::max)
}

impl DriftErrors {
    fn join(&self, other: &Self) -> Self {
        Self {
            position_meters: self.position_meters.max(other.position_meters),
            deformer_meters: self.deformer_meters.max(other.deformer_meters),
            path_meters: self.path_meters.max(other.path_meters),
            determinant: self.determinant.max(other.determinant),
            orthogonality: self.orthogonality.max(other.orthogonality),
            steps_unlike_new_deformer: self.steps_unlike_new_deformer + other.steps_unlike_new_deformer,
        }
    }
}

impl DriftWindow {
    const fn contains(&self, step: u64) -> bool {
        self.first_step <= step && step <= self.last_step
    }
}

impl DriftResult {
    /// The largest errors of all windows.
    pub fn largest_errors(&self) -> DriftErrors {
        self.windows.iter().fold(DriftErrors::default(), |largest, window| largest.join(&window.errors))
    }

    /// Expectations that are not met, each as `case: reason`.
    pub(super) fn failures(&self) -> Vec<String> {
        let (errors, bound, growth) = (self.largest_errors(), self.path_bound_meters, self.growth);
        let expected_growth = if self.is_control { "more than" } else { "at most" };
        let checks = [
            (
                (growth > MAX_GROWTH) == self.is_control,
                format!("growth: expected {expected_growth} {MAX_GROWTH}, got {growth}"),
            ),
            (
                errors.steps_unlike_new_deformer == 0,
                format!("steps unlike a new deformer: expected 0, got {}", errors.steps_unlike_new_deformer),
            ),
            (
                errors.path_meters <= bound,
                format!("difference by the path: expected at most {bound:e} m, got {:e} m", errors.path_meters),
            ),
        ];
        let failures = checks.into_iter().filter(|(passed, _)| !passed);
        failures.map(|(_, reason)| format!("{}: {reason}", self.name)).collect()
    }

    /// The case in one line.
    pub fn summary(&self) -> String {
        let errors = self.largest_errors();
        let mut text = format!("{}: error {:.2e} m, growth {:.2}", self.name, errors.position_meters, self.growth);
        if self.origin_changes > 0 {
            let (path, bound) = (errors.path_meters, self.path_bound_meters);
            let changes = self.origin_changes;
            text.push_str(&format!(", {changes} changes of the origin, path {path:.2e} m of at most {bound:.2e} m"));
        }
        if let Some(step) = self.first_rejected_step {
            text.push_str(&format!(", rejected from step {step}"));
        }
        text
    }
}
