//! Compares the results of a demo with the f64 reference and with the demo's acceptance criteria.

use serde_json::{Value, json};

use super::DemoRun;
use modalcast_compute::reference;
use modalcast_model::domain::Transform;
use modalcast_model::error::{Result, invalid};
use modalcast_model::scene::{Scene, SceneState};

/// Tolerance for the error of received vertices, as a fraction of the scene's diagonal. The README guarantees it.
const MAX_RELATIVE_ERROR: f64 = 1e-5;

/// Tolerance for [`Joint::gap`], as a fraction of the scene's diagonal. The gap is not exactly 0, because the physics
/// process fits the transform of a child to a ring of displaced vertices.
const MAX_RELATIVE_GAP: f64 = 1e-3;

/// The measured results of a demo.
pub(super) struct Evaluation {
    backend: String,
    renderer: String,
    steps: usize,
    steps_per_second: f64,
    /// Names and median milliseconds of the stages.
    stages: Vec<(String, f64)>,
    /// Largest distance of a received vertex from the reference, in scene units.
    error: f64,
    /// `error` as a fraction of the scene's diagonal.
    relative_error: f64,
    /// Largest distance of a received vertex from its rest position, in scene units.
    displacement: f64,
    /// `displacement` as a fraction of the scene's diagonal.
    relative_displacement: f64,
    /// The displacement of the top tenth of the scene alone, as a fraction of the scene's height.
    sway: f64,
    /// Largest [`Joint::gap`], as a fraction of the diagonal. `None` without joints.
    joint_gap: Option<f64>,
    min_motion: MinimumMotion,
    /// Number of frames on disk.
    frames: usize,
    expected_frames: usize,
}

impl Evaluation {
    /// Compares every received vertex of every step with the reference.
    ///
    /// # Errors
    /// `Invalid` when the recorded arrays have different step counts or do not have the scene's shapes.
    pub(super) fn of(scene: &Scene, run: &DemoRun, expected_frames: u32) -> Result<Self> {
        let steps = run.vertices.shape()[0];
        if run.q.shape() != [steps, scene.layout.coordinates]
            || run.transforms.shape() != [steps, scene.domains.len(), 12]
            || run.vertices.shape() != [steps, scene.layout.vertices, 3]
        {
            let given = format!("{:?}, {:?}, {:?}", run.q.shape(), run.transforms.shape(), run.vertices.shape());
            return Err(invalid("demo", "q, transforms and vertices of the same steps of the scene", given));
        }
        let rest_positions = reference::deform(scene, &SceneState::rest(scene));
        let top_region = TopRegion::of(scene, &rest_positions);
        let joints = Joint::all(scene, &rest_positions);
        let (mut error, mut displacement, mut sway, mut gap) = (0.0_f64, 0.0_f64, 0.0_f64, 0.0_f64);
        for step in 0..steps {
            let state = sent_state(scene, run, step);
            let expected_positions = reference::deform(scene, &state);
            let (received_positions, _) = run.vertices.row(step).as_chunks::<3>();
            gap = joints.iter().fold(gap, |gap, joint| max_or_infinity(gap, joint.gap(received_positions, &state)));
            for (vertex, position) in received_positions.iter().enumerate() {
                let position = position.map(f64::from);
                error = max_or_infinity(error, distance(position, expected_positions[vertex]));
                let vertex_displacement = distance(position, rest_positions[vertex]);
                displacement = max_or_infinity(displacement, vertex_displacement);
                if top_region.contains(rest_positions[vertex]) {
                    sway = max_or_infinity(sway, vertex_displacement);
                }
            }
        }
        let diagonal = scene.rest_bounds.diagonal();
        Ok(Self {
            backend: string_field(&run.server, "backend"),
            renderer: string_field(&run.server, "renderer"),
            steps,
            steps_per_second: run.physics["steps_per_second"].as_f64().unwrap_or(f64::NAN),
            stages: median_stage_ms(&run.frames),
            error,
            relative_error: error / diagonal,
            displacement,
            relative_displacement: displacement / diagonal,
            sway: sway / top_region.scene_height,
            joint_gap: (!joints.is_empty()).then_some(gap / diagonal),
            min_motion: MinimumMotion::of(scene),
            frames: run.frames_on_disk,
            expected_frames: expected_frames as usize,
        })
    }

    /// The acceptance criteria that are not met.
    pub(super) fn failed_checks(&self) -> Vec<String> {
        let criteria = [
            (
                self.relative_error <= MAX_RELATIVE_ERROR,
                format!("vertices within {MAX_RELATIVE_ERROR:.0e} of the diagonal"),
            ),
            (self.joint_gap.is_none_or(|gap| gap <= MAX_RELATIVE_GAP), format!("joints within {MAX_RELATIVE_GAP:.0e}")),
            (self.frames == self.expected_frames, format!("{} frames", self.expected_frames)),
            (self.sway >= self.min_motion.sway, format!("a sway of {} % of the height", 100.0 * self.min_motion.sway)),
            (
                self.relative_displacement >= self.min_motion.displacement,
                format!("a displacement of {} % of the diagonal", 100.0 * self.min_motion.displacement),
            ),
        ];
        criteria.into_iter().filter_map(|(is_met, criterion)| (!is_met).then_some(criterion)).collect()
    }

    pub(super) fn table(&self) -> Vec<String> {
        let mut rows = vec![
            ("backend".into(), self.backend.clone()),
            ("renderer".into(), self.renderer.clone()),
            ("steps".into(), format!("{} at {:.1} steps/s", self.steps, self.steps_per_second)),
        ];
        rows.extend(self.stages.iter().map(|(stage, ms)| (format!("  {stage}"), format!("{ms:.2} ms"))));
        let displacement_percent = 100.0 * self.relative_displacement;
        rows.extend([
            (
                "error against f64".into(),
                format!("{:.2e} units, {:.1e} of the diagonal", self.error, self.relative_error),
            ),
            (
                "largest displacement".into(),
                format!("{:.3} units, {displacement_percent:.1} % of the diagonal", self.displacement),
            ),
            ("sway at the top".into(), format!("{:.1} % of the height", 100.0 * self.sway)),
        ]);
        rows.extend(self.joint_gap.map(|gap| ("largest joint gap".into(), format!("{gap:.1e} of the diagonal"))));
        rows.push(("frames written".into(), format!("{} of {}", self.frames, self.expected_frames)));
        rows.extend(self.failed_checks().into_iter().map(|criterion| ("NOT MET".into(), criterion)));
        rows.into_iter().map(|(name, value): (String, String)| format!("{name:<22}{value}")).collect()
    }

    pub(super) fn json(&self) -> Value {
        let stages: serde_json::Map<String, Value> =
            self.stages.iter().map(|(stage, ms)| (stage.clone(), json!(ms))).collect();
        json!({
            "backend": self.backend,
            "renderer": self.renderer,
            "steps": self.steps,
            "steps_per_second": self.steps_per_second,
            "stage_ms_median": stages,
            "error_units": self.error,
            "error_of_diagonal": self.relative_error,
            "displacement_of_diagonal": self.relative_displacement,
            "sway_of_height": self.sway,
            "joint_gap_of_diagonal": self.joint_gap,
            "frames": self.frames,
            "broken": self.failed_checks(),
        })
    }
}

/// The top tenth of a scene along its up axis.
struct TopRegion {
    up_axis: usize,
    /// Lower bound of the region on the up axis.
    min_height: f64,
    /// Height of the whole scene.
    scene_height: f64,
}

impl TopRegion {
    fn of(scene: &Scene, rest_positions: &[[f64; 3]]) -> Self {
        let up_axis = scene.up.index();
        let heights = || rest_positions.iter().map(|point| point[up_axis]);
        let (bottom, top) = (heights().fold(f64::INFINITY, f64::min), heights().fold(f64::NEG_INFINITY, f64::max));
        let min_height = top - 0.1 * (top - bottom);
        Self { up_axis, min_height, scene_height: (top - bottom).max(f64::MIN_POSITIVE) }
    }

    fn contains(&self, point: [f64; 3]) -> bool {
        point[self.up_axis] >= self.min_height
    }
}

/// Minimum motion that a demo must show. A demo whose scene does not move fails.
struct MinimumMotion {
    /// As a fraction of the diagonal.
    displacement: f64,
    /// As a fraction of the height.
    sway: f64,
}

impl MinimumMotion {
    /// 2 % of the diagonal for a scene with modes, 0.01 % for a rigid one. A scene with modes and attached domains must
    /// also sway by 3 % of its height.
    fn of(scene: &Scene) -> Self {
        let has_joints = scene.features.modes && scene.domains.iter().any(|domain| domain.attachment.is_some());
        Self { displacement: if scene.features.modes { 0.02 } else { 1e-4 }, sway: if has_joints { 0.03 } else { 0.0 } }
    }
}

/// A child domain and the ring of parent vertices that carries it.
struct Joint {
    /// Index of the child's transform.
    transform_index: usize,
    /// Vertices of the ring, as indices in the positions of the whole scene.
    ring: Vec<usize>,
}

impl Joint {
    /// The joints whose child has its origin at the center of the ring at rest. Only these joints have an expected gap
    /// of 0.
    fn all(scene: &Scene, rest_positions: &[[f64; 3]]) -> Vec<Self> {
        let state = SceneState::rest(scene);
        let diagonal = scene.rest_bounds.diagonal();
        let joint = |(child, domain): (usize, &modalcast_model::domain::Domain)| {
            let attachment = domain.attachment.as_ref().filter(|attachment| !attachment.vertices.is_empty())?;
            // A child that follows another domain has no transform of its own. Its gap is not checked.
            let transform_index = scene
                .transform_roots
                .root_from_domain(child)
                .is_none()
                .then(|| scene.transform_roots.root_of(child))?;
            let first_vertex = scene.layout.domains[attachment.parent].first_vertex;
            let joint = Self {
                transform_index,
                ring: attachment.vertices.iter().map(|vertex| first_vertex + *vertex as usize).collect(),
            };
            let center = center(joint.ring.iter().map(|vertex| rest_positions[*vertex]));
            // The tolerance allows for the f32 rounding of rest positions.
            (distance(center, joint.origin(&state)) <= 1e-5 * diagonal).then_some(joint)
        };
        scene.domains.iter().enumerate().filter_map(joint).collect()
    }

    /// World position of the child's origin.
    fn origin(&self, state: &SceneState) -> [f64; 3] {
        state.transforms[self.transform_index].translation().into()
    }

    /// Distance in scene units of the child's sent origin from the center of the received ring.
    fn gap(&self, received_positions: &[[f32; 3]], state: &SceneState) -> f64 {
        let ring_positions = self.ring.iter().map(|vertex| received_positions[*vertex].map(f64::from));
        distance(center(ring_positions), self.origin(state))
    }
}

fn center(points: impl ExactSizeIterator<Item = [f64; 3]>) -> [f64; 3] {
    let count = points.len() as f64;
    let sum = points.fold([0.0; 3], |sum, point| [0, 1, 2].map(|axis| sum[axis] + point[axis]));
    sum.map(|number| number / count)
}

/// The state that the physics process sent at one step.
fn sent_state(scene: &Scene, run: &DemoRun, step: usize) -> SceneState {
    let mut state = SceneState::rest(scene);
    state.q = run.q.row(step).to_vec();
    let (sent_transforms, _) = run.transforms.row(step).as_chunks::<12>();
    // The record has a transform for each domain, the state only for domains that follow no other domain.
    for (transform, domain) in state.transforms.iter_mut().zip(scene.transform_roots.domains()) {
        *transform = Transform(sent_transforms[domain as usize]);
    }
    state
}

fn distance(a: [f64; 3], b: [f64; 3]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt()
}

/// The larger of two values, or infinity if `b` is NaN, so that an invalid position fails the checks.
fn max_or_infinity(a: f64, b: f64) -> f64 {
    if b.is_nan() { f64::INFINITY } else { a.max(b) }
}

fn string_field(value: &Value, key: &str) -> String {
    value[key].as_str().unwrap_or("unknown").to_owned()
}

/// Median milliseconds per stage, as reported by the receiving client.
fn median_stage_ms(frames: &Value) -> Vec<(String, f64)> {
    let object = frames["stages_ms"].as_object();
    object
        .map(|stage_ms| stage_ms.iter().filter_map(|(name, ms)| Some((name.clone(), ms.as_f64()?))).collect())
        .unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cli::demo::step_records::StepRecords;

    #[test]
    fn max_or_infinity_treats_nan_as_infinity() {
        assert_eq!(max_or_infinity(1.0, f64::NAN), f64::INFINITY);
        assert_eq!(max_or_infinity(f64::INFINITY, 1.0), f64::INFINITY);
        assert_eq!(max_or_infinity(1.0, 2.0), 2.0);
    }

    /// Results with two steps of a scene at rest, as correct processes would record them.
    fn demo_run_at_rest(scene: &Scene) -> DemoRun {
        let (domains, vertices) = (scene.domains.len(), scene.layout.vertices);
        let state = SceneState::rest(scene);
        let rest_positions = reference::deform(scene, &state);
        let transforms = state.transforms.iter().flat_map(|transform| transform.0).collect();
        let positions = rest_positions.iter().flatten().map(|entry| *entry as f32).collect();
        let repeat_row = |row: Vec<f32>| [row.clone(), row];
        DemoRun {
            frames: json!({}),
            physics: json!({}),
            server: json!({}),
            q: StepRecords::from_rows(&[scene.layout.coordinates], &repeat_row(vec![0.0; scene.layout.coordinates])),
            transforms: StepRecords::from_rows(&[domains, 12], &repeat_row(transforms)),
            vertices: StepRecords::from_rows(&[vertices, 3], &repeat_row(positions)),
            frames_on_disk: 2,
        }
    }

    #[test]
    fn failed_checks_names_the_criteria_that_are_not_met() {
        let scene = modalcast_model::load::open("tree").expect("expected the built-in scene").scene;
        let failed_checks = |change: &dyn Fn(&mut DemoRun)| {
            let mut run = demo_run_at_rest(&scene);
            change(&mut run);
            Evaluation::of(&scene, &run, 2).expect("expected consistent records").failed_checks().join("; ")
        };
        // A scene at rest fails only the criteria of motion.
        let result_at_rest = failed_checks(&|_| {});
        assert_eq!(result_at_rest, "a sway of 3 % of the height; a displacement of 2 % of the diagonal");
        assert!(failed_checks(&|run| run.frames_on_disk = 1).contains("2 frames"));
        // Vertex 77 stands for any vertex.
        assert!(failed_checks(&|run| run.vertices.row_mut(1)[3 * 77] += 0.01).contains("vertices within"));
        assert!(failed_checks(&|run| run.vertices.row_mut(1)[3 * 77] = f32::NAN).contains("vertices within"));
        let child_domain =
            scene.domains.iter().position(|domain| domain.attachment.is_some()).expect("expected an attached domain");
        // Entry 3 of a row-major 3x4 transform is the translation along x.
        assert!(
            failed_checks(&|run| run.transforms.row_mut(1)[12 * child_domain + 3] += 0.1).contains("joints within")
        );
    }
}
