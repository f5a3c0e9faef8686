//! Plants whose domains have modes and act on each other, with the columns of tables 4.5 to 4.7 of the thesis: the
//! almond and the bean of a folder of scenes, and generated plants (`skeletons`).
//!
//! The thesis's frames include the simulation of one process that computes and draws. Here, a physics process computes
//! steps while the server draws. Both rates are measured: frames with the simulation, and frames of recorded steps. The
//! project's CPU system is the same server with `--backend cpu`: as in the thesis, the CPU deforms and the same
//! renderer draws.

use modalcast_client::ShapeArray;
use serde::Serialize;

use super::motion;
use super::peers::PeerJob;
use super::peers::viewer::{Content, ViewerJob, ViewerSummary};
use super::rates::{self, RateResult, Viewers};
use super::session::{SceneSource, Session};
use super::stages::{self, StageRate};
use super::{CaseReport, CaseResult, RECORDED_STEPS, SCENE, StreamReport, StreamReportOptions};
use crate::markdown_table::dash;
use crate::thesis::{PLANTS, ThesisPlant};
use modalcast_model::error::{Result, fault, fault_in};

/// The counts of a plant, in the notation of table 4.5.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct PlantCounts {
    /// v.
    pub vertices: u64,
    /// f.
    pub triangles: u64,
    /// d.
    pub domains: usize,
    /// d': domains with modes.
    pub deformable: usize,
    /// r: modes of all domains.
    pub modes: u64,
    /// u: rows of all U.
    pub rows: usize,
}

/// Results of one plant and one backend.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PlantRates {
    /// The row of the thesis whose counts the plant has; `None` for a plant of a folder.
    pub thesis: Option<ThesisPlant>,
    pub counts: PlantCounts,
    /// `cuda` or `cpu`.
    pub backend: String,
    /// Frames at the viewer, with the simulation.
    pub rate: RateResult,
    /// Frames per second at the viewer without the simulation: of recorded steps.
    pub recorded_per_second: f64,
    /// Steps per second of the physics process alone.
    pub physics_per_second: f64,
}

impl PlantRates {
    /// The sum of the median times of stages of a frame alone, in milliseconds.
    fn stages_ms(&self, stages: &[&str]) -> f64 {
        let times = self.rate.alone_ms.first();
        stages.iter().filter_map(|stage| Some(f64::from(*times?.get(*stage)?))).sum()
    }

    /// The time to deform the plant and to pass its vertices to the renderer.
    fn deform_ms(&self) -> f64 {
        self.stages_ms(&["deform", "upload"])
    }

    /// The time to draw the plant with its shadow map.
    fn draw_ms(&self) -> f64 {
        self.stages_ms(&["switch", "shadow", "draw"])
    }
}

/// Measures the plant of a session.
///
/// # Errors
/// `Fault` when a process fails.
pub(super) fn measure(session: &Session, content: Content, options: &StreamReportOptions) -> Result<PlantRates> {
    let rate = rates::measure(session, Some(Viewers::one(content)), options)?;
    let physics = rate.stage_rates.iter().find(|stage| stage.stages == stages::PHYSICS_STAGE);
    let physics_per_second = physics.map(|stage: &StageRate| stage.per_second);
    Ok(PlantRates {
        thesis: match session.source {
            SceneSource::Skeleton(index) => Some(PLANTS[index]),
            _ => None,
        },
        counts: count(session)?,
        backend: session.server_info.backend.clone(),
        recorded_per_second: measure_recorded(session, content, options)?,
        physics_per_second: physics_per_second.ok_or_else(|| fault("plants", "expected a rate of the physics"))?,
        rate,
    })
}

fn count(session: &Session) -> Result<PlantCounts> {
    let no_arrays: &[ShapeArray] = &[];
    let description =
        session.runtime.block_on(session.client.describe(SCENE, no_arrays)).map_err(fault_in("plants"))?;
    let deformable = description.domains.iter().filter(|domain| domain.rank > 0);
    let vertices = deformable.clone().map(|domain| description.shapes[domain.shape].vertex_count);
    let info = &session.scene_info;
    Ok(PlantCounts {
        vertices: info.vertices,
        triangles: info.triangles,
        domains: description.domains.len(),
        deformable: deformable.count(),
        modes: info.coordinates,
        rows: 3 * vertices.sum::<usize>(),
    })
}

/// Frames per second of a viewer while recorded steps are sent.
fn measure_recorded(session: &Session, content: Content, options: &StreamReportOptions) -> Result<f64> {
    let motion = session.motion(options.steps.min(RECORDED_STEPS))?;
    let job = ViewerJob {
        server: session.url(),
        shared_memory: None,
        scene: SCENE.into(),
        replies: options.steps,
        content,
        view: 0,
    };
    let mut viewer = PeerJob::Viewer(job).start()?;
    viewer.wait_for("ready")?;
    session.runtime.block_on(motion::measure_rate(&session.client, motion, options.steps))?;
    Ok(viewer.finish::<ViewerSummary>()?.per_second)
}

/// Header of the table of plants.
pub(super) const HEADER: [&str; 19] = [
    "plant",
    "v",
    "f",
    "d",
    "d'",
    "r",
    "u",
    "deform ms",
    "draw ms",
    "simulate ms",
    "frames/s, simulated",
    "frames/s, recorded",
    "CPU deform ms",
    "CPU draw ms",
    "CPU frames/s, simulated",
    "simulated / CPU",
    "thesis GPU t_vb, t_vbr ms",
    "thesis FPS, GPU and CPU",
    "thesis k_fps",
];

/// What the columns of [`HEADER`] mean.
pub(super) const NOTE: &str = "\
The plants have modes, and their domains act on each other at joints. `plant` names the row of table 4.5 whose \
d, d' and r a generated plant has; a quick report has a sixteenth of them. v and f are those of the generated \
meshes, and u differs by at most 7 %. `deform` includes the upload of vertices if the renderer does not share \
their memory, and `draw` the shadow map. `simulate` is a step of the physics process alone. Frames are PNG at \
one viewer, with the simulation in its own process, and of recorded steps. `CPU` is the same server with \
`--backend cpu`. The thesis's frames per second include its own simulation, with other modes and materials.";

/// The rows of the table: one per plant, with the CPU system if it was measured.
pub(super) fn table_rows(report: &StreamReport) -> Vec<Vec<String>> {
    let plants = || {
        report.cases.iter().filter_map(|case| match &case.result {
            CaseResult::Plant(plant) => Some((case, &**plant)),
            _ => None,
        })
    };
    let on_cpu = |scene: &str| plants().find(|(case, _)| case.scene == scene && is_cpu_case(case));
    let by_default = plants().filter(|(case, _)| !is_cpu_case(case));
    by_default.map(|(case, plant)| table_row(case, plant, on_cpu(case.scene).map(|(_, plant)| plant))).collect()
}

/// The end of the names of cases of the CPU system.
pub(super) const CPU_SUFFIX: &str = "-cpu";

fn is_cpu_case(case: &CaseReport) -> bool {
    case.name.ends_with(CPU_SUFFIX)
}

fn table_row(case: &CaseReport, plant: &PlantRates, on_cpu: Option<&PlantRates>) -> Vec<String> {
    let PlantCounts { vertices, triangles, domains, deformable, modes, rows } = plant.counts;
    let thesis = plant.thesis;
    let mut cells = vec![thesis.map_or_else(|| case.scene.to_owned(), |thesis| thesis.name.to_owned())];
    cells.extend([vertices, triangles, domains as u64, deformable as u64, modes, rows as u64].map(|n| n.to_string()));
    let milliseconds = [plant.deform_ms(), plant.draw_ms(), 1e3 / plant.physics_per_second];
    cells.extend(milliseconds.map(|ms| format!("{ms:.3}")));
    cells.extend([plant.rate.per_second, plant.recorded_per_second].map(|rate| format!("{rate:.1}")));
    let cpu = |text: &dyn Fn(&PlantRates) -> String| on_cpu.map_or_else(dash, text);
    cells.push(cpu(&|plant| format!("{:.3}", plant.deform_ms())));
    cells.push(cpu(&|plant| format!("{:.3}", plant.draw_ms())));
    cells.push(cpu(&|plant| format!("{:.1}", plant.rate.per_second)));
    cells.push(cpu(&|other| format!("{:.2}", plant.rate.per_second / other.rate.per_second)));
    let of_thesis = |text: &dyn Fn(&ThesisPlant) -> String| thesis.as_ref().map_or_else(dash, text);
    cells.push(of_thesis(&|row| format!("{}, {}", row.gpu_update_ms, row.drawn.gpu_vbr_ms)));
    cells.push(of_thesis(&|row| format!("{}, {}", row.drawn.gpu_fps, row.drawn.cpu_fps)));
    cells.push(of_thesis(&|row| format!("{:.2}", row.drawn.gpu_fps / row.drawn.cpu_fps)));
    cells
}

#[cfg(test)]
mod tests {
    use super::super::tests::{case, rate_result, report};
    use super::*;

    fn plant(backend: &str, per_second: f64, thesis: Option<ThesisPlant>) -> CaseResult {
        let counts = PlantCounts { vertices: 7, triangles: 6, domains: 5, deformable: 4, modes: 3, rows: 2 };
        let mut rate = RateResult { per_second, ..rate_result() };
        rate.alone_ms[0].extend([("deform".into(), 0.5), ("shadow".into(), 0.25), ("encode".into(), 9.0)]);
        CaseResult::Plant(Box::new(PlantRates {
            thesis,
            counts,
            backend: backend.into(),
            rate,
            recorded_per_second: 120.0,
            physics_per_second: 500.0,
        }))
    }

    #[test]
    fn table_has_both_systems_beside_the_thesis() {
        let mut cases = vec![
            case("plant-2-png-1080p", plant("cuda", 100.0, Some(PLANTS[1]))),
            case("plant-2-png-1080p-cpu", plant("cpu", 25.0, Some(PLANTS[1]))),
            case("almond-png", plant("cuda", 90.0, None)),
        ];
        (cases[0].scene, cases[1].scene, cases[2].scene) = ("plant-2", "plant-2", "plants/almond");
        let rows = table_rows(&report(cases));
        // The drawing time is that of the shadow and of the frame, 1.25 ms.
        let expected = [
            "Conifer",
            "7",
            "6",
            "5",
            "4",
            "3",
            "2",
            "0.500",
            "1.500",
            "2.000",
            "100.0",
            "120.0",
            "0.500",
            "1.500",
            "25.0",
            "4.00",
            "1.059, 1.693",
            "55, 60",
            "0.92",
        ];
        assert_eq!(rows[0], expected);
        assert_eq!(
            (rows.len(), rows[1][0].as_str(), &rows[1][12..]),
            (2, "plants/almond", &[(); 7].map(|()| dash())[..])
        );
        assert!(rows.iter().all(|row| row.len() == HEADER.len()));
    }
}
