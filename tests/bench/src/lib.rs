//! Benchmarks of error against run time for every variant of the deformation, on synthetic scenes or on a scene of the
//! user. [`render`] does the same for the renderer, [`stream`] measures at the client, [`drift`] measures errors over
//! long runs, and [`dynamics`] measures time integrators and computed modes.
//!
//! A workload (`load` in options and reports) is a scene to measure. A variant is one way to deform it: a backend, a
//! storage type of U and further options. Validation comes before timing: a variant whose error exceeds its a-priori
//! bound at any vertex of any state is not timed. The report names the variant and fails.
//!
//! - [`workloads`] and [`motion`]: seeded synthetic scenes, modal coordinates and transforms;
//!   [`recorded_trajectory`]: recorded trajectories.
//! - [`exact_positions`], [`error_model`] and `double_double`: reference positions in f64, on request with the
//!   approximations of a variant, and a-priori bounds. [`errors`] and [`error_sources`] measure variants against them.
//! - [`variant`] and [`mod@bench`]: the variants to measure. A new variant implements [`variant::Variant`], and
//!   [`bench::LocalMachine`] lists it.
//! - [`table`], [`thesis_comparison`], [`recommendation`], [`plot`]: the output.

pub mod bench;
pub mod cli;
mod cpu_bandwidth;
mod csv_table;
mod cuda_variants;
mod double_double;
pub mod drift;
pub mod dynamics;
pub mod error_model;
pub mod error_sources;
pub mod errors;
pub mod exact_positions;
mod exact_state;
#[cfg(test)]
#[path = "../../common/hang_guard.rs"]
mod hang_guard;
pub mod kernels;
mod markdown;
mod markdown_table;
pub mod memory_traffic;
pub mod motion;
mod output_files;
pub mod plot;
pub mod provenance;
pub mod recommendation;
pub mod recorded_trajectory;
pub mod render;
pub mod stream;
pub mod table;
#[cfg(test)]
mod testing;
pub mod thesis;
pub mod thesis_comparison;
pub mod timing;
pub mod validate;
pub mod variant;
pub mod workloads;

use std::path::{Path, PathBuf};

use serde::Serialize;

use crate::kernels::{HostWrite, Overlap};
use bench::{BenchTarget, MemoryBandwidth};
use modalcast_model::deform::Backend;
use modalcast_model::error::{Result, fault_in};
use modalcast_model::load::{self, OpenedScene};
use motion::WorkloadMotion;
use output_files::write_files;
use provenance::Provenance;
use recommendation::{Recommendation, recommend};
use recorded_trajectory::RecordedTrajectory;
use table::DeformRow;
use thesis_comparison::ThesisComparison;
use timing::CacheState;
use validate::{ConditionNumbers, ValidationLimits};
use variant::Variant;
use workloads::{Size, Workload, WorkloadKind};

/// Name under which [`DeformReportOptions::variants`] selects the overlap benchmark, which reads a step back while the
/// next step runs.
const OVERLAP: &str = "cuda overlap";

/// Number of states that timed steps rotate through, so that consecutive steps have different inputs.
const ROTATING_STATES: usize = 8;

/// Settings of a report: scenes, variants, numbers of states and of repetitions.
#[derive(Debug, Clone)]
pub struct DeformReportOptions {
    pub sources: Vec<WorkloadSource>,
    /// How many states of each workload are validated.
    pub validation: ValidationLimits,
    /// Repetitions per median.
    pub replays: usize,
    /// Variants to measure: full names, or prefixes that end in `*`. An empty list selects all.
    pub variants: Vec<String>,
    pub size: Size,
}

impl DeformReportOptions {
    fn selects(&self, name: &str) -> bool {
        is_selected(&self.variants, name)
    }
}

/// Whether one of the patterns selects `name`. A pattern is a full name, or a prefix that ends in `*`. An empty list
/// selects everything.
fn is_selected(patterns: &[String], name: &str) -> bool {
    let matches =
        |pattern: &String| pattern.strip_suffix('*').map_or(name == pattern, |prefix| name.starts_with(prefix));
    patterns.is_empty() || patterns.iter().any(matches)
}

/// Source of a scene.
#[derive(Debug, Clone)]
pub enum WorkloadSource {
    Synthetic(WorkloadKind),
    /// A scene given on the command line, and the path of its recorded trajectory. Without a path, the recording next
    /// to the scene is used, if there is exactly one.
    Scene {
        source: String,
        recording: Option<PathBuf>,
    },
}

impl WorkloadSource {
    /// Name in messages.
    fn name(&self) -> String {
        match self {
            Self::Synthetic(kind) => kind.name(),
            Self::Scene { source, .. } => source.clone(),
        }
    }
}

/// Sizes and properties of one workload in a report. Here and in the types below, a serialized name that differs from
/// the field's name is the one of earlier reports (`tests/bench/records`).
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct WorkloadSummary {
    pub name: String,
    /// Whether the workload has the full size that its name states. False for `--quick` builds and for scenes of the
    /// user.
    #[serde(rename = "full")]
    pub is_full_size: bool,
    pub remarks: Vec<String>,
    pub vertices: usize,
    /// Render vertices: each refers to one of `vertices` and has a normal.
    pub corners: usize,
    pub triangles: usize,
    pub domains: usize,
    /// Modal coordinates of all domains.
    pub coordinates: usize,
    #[serde(rename = "diagonal_metres")]
    pub diagonal_meters: f64,
    /// Steps of the trajectory.
    pub steps: usize,
    /// Whether the trajectory is recorded; otherwise it is synthetic.
    #[serde(rename = "recorded")]
    pub is_recorded: bool,
    /// Condition numbers of u = U q at the validated states.
    pub condition: ConditionNumbers,
    /// Upload of one step to the CUDA device; `None` without a device.
    #[serde(rename = "ingest")]
    pub upload: Option<UploadTiming>,
    /// Times of steps with readback of the vertices, serial and overlapped; `None` without a CUDA device.
    pub overlap: Option<Overlap>,
    /// The fastest complete step for limits of the error.
    pub recommendations: Vec<Recommendation>,
}

/// Host-to-device upload of one step, timed alone.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct UploadTiming {
    pub bytes: u64,
    pub median_us: f64,
    /// `median_us` divided by the time of a copy of the same bytes at the pinned host-to-device bandwidth of this run.
    pub of_pinned: f64,
}

/// All results of one run.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DeformReport {
    #[serde(rename = "made")]
    pub provenance: Provenance,
    /// Capabilities that this machine lacks, each with the reason.
    pub remarks: Vec<String>,
    /// Maximum number of random states per workload; `states` of a row is the number of validated states.
    pub seeds: usize,
    /// Peak memory bandwidth of each backend.
    #[serde(rename = "roofs")]
    pub memory_bandwidths: Vec<(Backend, MemoryBandwidth)>,
    /// Times of host writes into the pinned memory from which the CUDA device reads a step's values.
    pub host_writes: Vec<HostWrite>,
    pub loads: Vec<WorkloadSummary>,
    /// Names of the requested workloads that are not measured yet. Empty when the report is complete.
    pub missing: Vec<String>,
    pub rows: Vec<DeformRow>,
    pub thesis: ThesisComparison,
    /// Failed variants, each as `load: variant: reason`.
    pub failed: Vec<String>,
}

/// Progress events of a running report.
#[derive(Debug)]
pub enum Progress<'a> {
    /// Description of the measurement that starts now.
    Started(&'a str),
    /// All results so far, with one more workload than in the previous event.
    Measured(&'a DeformReport),
}

/// Measures all requested workloads and returns the report. `progress` is called before and after each workload.
///
/// # Errors
/// Errors of loading a scene and of `progress`. Failures of a variant are recorded in the report instead.
pub fn deform(
    options: &DeformReportOptions,
    target: &dyn BenchTarget,
    mut progress: impl FnMut(Progress<'_>) -> Result<()>,
) -> Result<DeformReport> {
    let mut measurements = Measurements::default();
    if options.selects(OVERLAP) {
        measurements.host_writes = target.time_host_writes(options.replays);
    }
    let mut report = assemble_report(options, target, &measurements);
    for source in &options.sources {
        let (workload, motion) = open_workload(source, options.size)?;
        let (vertices, domains) = (workload.scene.layout.vertices, workload.scene.domains.len());
        progress(Progress::Started(&format!("{}: {vertices} vertices, {domains} domains", workload.name)))?;
        let (condition, rows) = measure_variants(options, target, &workload, &motion);
        let recommendations = recommend(rows.iter());
        measurements.rows.extend(rows);
        let is_full_size = match source {
            WorkloadSource::Synthetic(kind) => options.size == Size::Full || kind.quick_size() == Size::Full,
            WorkloadSource::Scene { .. } => false,
        };
        let summary = summarize(&workload, &motion, condition, is_full_size);
        let overlap = measure_overlap(options, target, &workload, &motion, &mut measurements.failed);
        measurements.loads.push(WorkloadSummary {
            upload: target.time_upload(&workload, options.replays),
            overlap,
            recommendations,
            ..summary
        });
        report = assemble_report(options, target, &measurements);
        progress(Progress::Measured(&report))?;
    }
    Ok(report)
}

/// Results of the workloads that are measured so far.
#[derive(Default)]
struct Measurements {
    host_writes: Vec<HostWrite>,
    loads: Vec<WorkloadSummary>,
    rows: Vec<DeformRow>,
    /// Failures that belong to no row, such as those of the overlap benchmark. Each is `workload: variant: reason`.
    failed: Vec<String>,
}

/// Assembles the report from the workloads measured so far, which are the first ones of `options.sources`.
fn assemble_report(
    options: &DeformReportOptions,
    target: &dyn BenchTarget,
    measurements: &Measurements,
) -> DeformReport {
    let Measurements { loads, rows, .. } = measurements;
    let is_full_size =
        |name: &str| loads.iter().any(|workload: &WorkloadSummary| workload.name == name && workload.is_full_size);
    let thesis = ThesisComparison::new(rows, is_full_size);
    let describe_failure = |row: &DeformRow| format!("{}: {}: {}", row.load, row.name, row.faults.join("; "));
    let mut failed = measurements.failed.clone();
    failed.extend(rows.iter().filter(|row| !row.passed && !row.is_skipped).map(describe_failure));
    // A variant has one row for warm and one for cold caches. Both repeat its failure.
    failed.dedup();
    let memory_bandwidths = [Backend::Cpu, Backend::Cuda].map(|backend| (backend, target.memory_bandwidth(backend)));
    DeformReport {
        provenance: Provenance::collect(),
        remarks: target.remarks(),
        seeds: options.validation.seeds,
        memory_bandwidths: memory_bandwidths.into(),
        host_writes: measurements.host_writes.clone(),
        loads: loads.clone(),
        missing: options.sources[loads.len()..].iter().map(WorkloadSource::name).collect(),
        rows: rows.clone(),
        thesis,
        failed,
    }
}

/// Runs the overlap benchmark if it is selected. Appends to `failed` if the benchmark fails, or if the vertices of
/// overlapped steps differ from those of serial steps.
fn measure_overlap(
    options: &DeformReportOptions,
    target: &dyn BenchTarget,
    workload: &Workload,
    motion: &WorkloadMotion,
    failed: &mut Vec<String>,
) -> Option<Overlap> {
    if !options.selects(OVERLAP) {
        return None;
    }
    let states: Vec<_> = (0..ROTATING_STATES).map(|seed| motion.random_state(seed).state()).collect();
    match target.measure_overlap(workload, &states, options.replays)? {
        Ok(overlap) => {
            let differing = overlap.differing;
            let failure = (differing > 0).then(|| format!("{}: {OVERLAP}: {differing} steps differ", workload.name));
            failed.extend(failure);
            Some(overlap)
        }
        Err(error) => {
            failed.push(format!("{}: {OVERLAP}: {error}", workload.name));
            None
        }
    }
}

/// Builds or loads a scene, and its motion.
fn open_workload(source: &WorkloadSource, size: Size) -> Result<(Workload, WorkloadMotion)> {
    match source {
        WorkloadSource::Synthetic(kind) => {
            let size = if size == Size::Quick { kind.quick_size() } else { size };
            let workload = kind.build(size)?;
            let motion = WorkloadMotion::new(&workload, None);
            Ok((workload, motion))
        }
        WorkloadSource::Scene { source, recording } => {
            let OpenedScene { scene, backends } = load::open(source)?;
            let recording = match recording {
                Some(path) => Some(RecordedTrajectory::read(path, &scene)?),
                None => RecordedTrajectory::find_next_to(source, &scene)?,
            };
            let remarks = scene.remarks.clone();
            let batches = backends.batches;
            let workload = Workload { batches, remarks, ..Workload::new(scene.name.clone(), scene) };
            let motion = WorkloadMotion::new(&workload, recording);
            Ok((workload, motion))
        }
    }
}

fn summarize(
    workload: &Workload,
    motion: &WorkloadMotion,
    condition: ConditionNumbers,
    is_full_size: bool,
) -> WorkloadSummary {
    let (scene, layout) = (&workload.scene, &workload.scene.layout);
    WorkloadSummary {
        name: workload.name.clone(),
        is_full_size,
        remarks: workload.remarks.clone(),
        vertices: layout.vertices,
        corners: layout.corners,
        triangles: layout.triangles,
        domains: scene.domains.len(),
        coordinates: layout.coordinates,
        diagonal_meters: scene.unit * scene.rest_bounds.diagonal(),
        steps: motion.steps(),
        is_recorded: motion.is_recorded(),
        condition,
        upload: None,
        overlap: None,
        recommendations: Vec::new(),
    }
}

/// Validates all variants of a workload together, then times each variant that passed.
fn measure_variants(
    options: &DeformReportOptions,
    target: &dyn BenchTarget,
    workload: &Workload,
    motion: &WorkloadMotion,
) -> (ConditionNumbers, Vec<DeformRow>) {
    let (mut variants, mut rows): (Vec<Box<dyn Variant>>, Vec<DeformRow>) = (Vec::new(), Vec::new());
    let is_selected = |name: &str| options.selects(name);
    // For each variant that is not selected, the list may hold an error. These variants are omitted.
    for (label, candidate) in
        target.variants(workload, &is_selected).into_iter().filter(|(label, _)| is_selected(&label.name))
    {
        match candidate {
            Ok(variant) => variants.push(variant),
            Err(error) => rows.push(DeformRow::not_created(&workload.name, &label, &error)),
        }
    }
    let (results, condition) = validate::validate(workload, motion, &mut variants, options.validation);
    let states: Vec<_> = (0..ROTATING_STATES).map(|seed| motion.random_state(seed).state()).collect();
    for (variant, result) in variants.iter_mut().zip(results) {
        for cache in [CacheState::Warm, CacheState::Cold] {
            // An error of timing counts only for the row of this cache state.
            let mut result = result.clone();
            let timing = match result.passed() {
                true => variant.time(&states, cache, options.replays),
                false => Ok(None),
            };
            let timing = timing.unwrap_or_else(|error| {
                result.faults.push(error.to_string());
                None
            });
            let (label, traffic) = (variant.label(), variant.traffic());
            let (launches, kernels) = (variant.launches_per_step(), variant.kernel_attributes());
            let row = DeformRow::new(&workload.name, label, result, traffic, (cache, timing));
            rows.push(DeformRow { launches, kernels, ..row.relative_to(target.memory_bandwidth(label.backend)) });
        }
    }
    (condition, rows)
}

impl DeformReport {
    /// Whether every variant passed.
    pub fn passed(&self) -> bool {
        self.failed.is_empty()
    }

    /// Writes `report.json`, `report.csv`, `report.md`, `report.svg` and `report.png` into a folder, which is created.
    ///
    /// # Errors
    /// `Fault` when a file cannot be written.
    pub fn write(&self, folder: &Path) -> Result<()> {
        let svg = plot::draw_svg(self);
        let files = [
            ("report.json", serde_json::to_vec_pretty(self).map_err(fault_in("report"))?),
            ("report.csv", table::csv(&self.rows)?),
            ("report.md", markdown::markdown(self).into_bytes()),
            ("report.png", plot::render_png(&svg)?),
            ("report.svg", svg.into_bytes()),
        ];
        write_files(folder, files)
    }
}

#[cfg(test)]
mod tests;
