//! Benchmarks of error against run time for every variant of the deformation, on synthetic scenes or on a scene of the
//! user. [`render`] does the same for the renderer.
//!
//! Validation comes before timing: a variant whose error exceeds its a-priori bound at any vertex of any state is not
//! timed. The report names the variant and fails.
//!
//! - [`workloads`] and [`motion`]: seeded synthetic scenes, modal coordinates and transforms;
//!   [`recorded_trajectory`]: recorded trajectories.
//! - [`exact_positions`], [`error_model`] and `double_double`: reference positions in f64 with single terms of the error model
//!   exchanged, and a-priori bounds. [`errors`] and [`error_sources`] measure variants against them.
//! - [`variant`] and [`mod@bench`]: the variants to measure. A new variant implements [`variant::Variant`], and a
//!   [`bench::BenchTarget`] offers it.
//! - [`table`], [`thesis_comparison`], [`plot`]: the output.

pub mod bench;
pub mod cli;
mod cuda_variants;
mod double_double;
pub mod error_model;
pub mod error_sources;
pub mod errors;
pub mod exact_positions;
mod exact_state;
pub mod kernels;
mod markdown;
mod markdown_table;
pub mod memory_traffic;
pub mod motion;
pub mod plot;
pub mod provenance;
pub mod recorded_trajectory;
pub mod render;
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
use provenance::Provenance;
use recorded_trajectory::RecordedTrajectory;
use table::DeformRow;
use thesis_comparison::ThesisComparison;
use timing::CacheState;
use validate::ConditionNumbers;
use variant::Variant;
use workloads::{Size, Workload, WorkloadKind};

/// Name under which [`DeformReportOptions::variants`] selects the overlap benchmark: device-to-host readback of a step while the
/// next step runs.
const OVERLAP: &str = "cuda overlap";

/// Number of states that timed steps rotate through.
const ROTATING_STATES: usize = 8;

/// Settings of a report: scenes, sample counts and variants.
#[derive(Debug, Clone)]
pub struct DeformReportOptions {
    pub sources: Vec<WorkloadSource>,
    /// Random states per load.
    pub seeds: usize,
    /// Repetitions per median.
    pub replays: usize,
    /// Upper limit of the steps taken from a trajectory.
    pub steps: usize,
    /// Variants to measure: full names, or prefixes that end in `*`. An empty list selects all.
    pub variants: Vec<String>,
    pub size: Size,
}

impl DeformReportOptions {
    fn selects(&self, name: &str) -> bool {
        is_selected(&self.variants, name)
    }
}

/// Whether `name` is selected by a list of full names and prefixes that end in `*`; an empty list selects everything.
fn is_selected(list: &[String], name: &str) -> bool {
    let matches =
        |pattern: &String| pattern.strip_suffix('*').map_or(name == pattern, |prefix| name.starts_with(prefix));
    list.is_empty() || list.iter().any(matches)
}

/// Source of a scene.
#[derive(Debug, Clone)]
pub enum WorkloadSource {
    Synthetic(WorkloadKind),
    /// A scene given on the command line and its recorded trajectory. Without `record`, a recording next to the scene
    /// is used if there is one.
    Scene {
        source: String,
        record: Option<PathBuf>,
    },
}

impl WorkloadSource {
    /// Name for messages.
    fn name(&self) -> String {
        match self {
            Self::Synthetic(kind) => kind.name(),
            Self::Scene { source, .. } => source.clone(),
        }
    }
}

/// Facts of one load in a report.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct WorkloadSummary {
    pub name: String,
    /// Whether the load has the full size that its name states; false for `--quick` builds and for scenes of the user.
    pub full: bool,
    pub remarks: Vec<String>,
    pub vertices: usize,
    pub corners: usize,
    pub triangles: usize,
    pub domains: usize,
    pub coordinates: usize,
    #[serde(rename = "diagonal_metres")]
    pub diagonal_meters: f64,
    /// Steps of the trajectory.
    pub steps: usize,
    pub recorded: bool,
    pub condition: ConditionNumbers,
    /// Upload of one whole step to the CUDA device: bytes and time.
    pub ingest: Option<UploadTiming>,
    /// Steps with readback of the vertices on the CUDA device, serial against overlapped.
    pub overlap: Option<Overlap>,
}

/// Host-to-device upload of one step, timed alone.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct UploadTiming {
    pub bytes: u64,
    pub median_us: f64,
    /// Measured time divided by the time that the same bytes take at this run's pinned host-to-device rate.
    pub of_pinned: f64,
}

/// All results of one run.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DeformReport {
    #[serde(rename = "made")]
    pub provenance: Provenance,
    /// Missing capabilities and the reasons, for the reader.
    pub remarks: Vec<String>,
    pub seeds: usize,
    pub roofs: Vec<(Backend, MemoryBandwidth)>,
    /// Host write rates into the pinned memory from which the CUDA device reads a step's values.
    pub host_writes: Vec<HostWrite>,
    pub loads: Vec<WorkloadSummary>,
    /// Requested loads that are not measured yet; empty when the report is complete.
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
    /// All results so far: one load more than in the previous event.
    Measured(&'a DeformReport),
}

/// Measures all requested loads and returns the report. `progress` is called when a load starts and after each load.
///
/// # Errors
/// Errors of loading a scene and of `progress`. Failures of a variant are recorded in the report instead.
pub fn deform(
    request: &DeformReportOptions,
    bench: &dyn BenchTarget,
    mut progress: impl FnMut(Progress<'_>) -> Result<()>,
) -> Result<DeformReport> {
    let mut measurements = Measurements::default();
    if request.selects(OVERLAP) {
        measurements.host_writes = bench.host_writes(request.replays);
    }
    let mut report = assemble_report(request, bench, &measurements);
    for source in &request.sources {
        let (load, motion) = open_workload(source, request.size)?;
        let (vertices, domains) = (load.scene.layout.vertices, load.scene.domains.len());
        progress(Progress::Started(&format!("{}: {vertices} vertices, {domains} domains", load.name)))?;
        let (condition, rows) = measure_variants(request, bench, &load, &motion);
        measurements.rows.extend(rows);
        let full = request.size == Size::Full && matches!(source, WorkloadSource::Synthetic(_));
        let summary = summarize(&load, &motion, condition, full);
        let overlap = measure_overlap(request, bench, &load, &motion, &mut measurements.failed);
        measurements.loads.push(WorkloadSummary { ingest: bench.ingest(&load, request.replays), overlap, ..summary });
        report = assemble_report(request, bench, &measurements);
        progress(Progress::Measured(&report))?;
    }
    Ok(report)
}

/// Results so far.
#[derive(Default)]
struct Measurements {
    host_writes: Vec<HostWrite>,
    loads: Vec<WorkloadSummary>,
    rows: Vec<DeformRow>,
    /// Failures that belong to no row, such as those of the overlap benchmark.
    failed: Vec<String>,
}

/// Assembles the report from the loads measured so far. They are the first ones of `request.sources`.
fn assemble_report(
    request: &DeformReportOptions,
    bench: &dyn BenchTarget,
    measurements: &Measurements,
) -> DeformReport {
    let Measurements { loads, rows, .. } = measurements;
    let is_full_size = |name: &str| loads.iter().any(|load: &WorkloadSummary| load.name == name && load.full);
    let thesis = ThesisComparison::of(rows, is_full_size);
    let describe = |row: &DeformRow| format!("{}: {}: {}", row.load, row.name, row.faults.join("; "));
    let mut failed = measurements.failed.clone();
    failed.extend(rows.iter().filter(|row| !row.passed && !row.is_skipped).map(describe));
    // The rows for warm and cold caches repeat the same failure of one variant.
    failed.dedup();
    let roofs = [Backend::Cpu, Backend::Cuda].map(|backend| (backend, bench.roofs(backend))).into();
    DeformReport {
        provenance: Provenance::here(),
        remarks: bench.remarks(),
        seeds: request.seeds,
        roofs,
        host_writes: measurements.host_writes.clone(),
        loads: loads.clone(),
        missing: request.sources[loads.len()..].iter().map(WorkloadSource::name).collect(),
        rows: rows.clone(),
        thesis,
        failed,
    }
}

/// Runs the overlap benchmark if it is requested. The report fails if its vertices differ from those of serial steps.
fn measure_overlap(
    request: &DeformReportOptions,
    bench: &dyn BenchTarget,
    load: &Workload,
    motion: &WorkloadMotion,
    failed: &mut Vec<String>,
) -> Option<Overlap> {
    if !request.selects(OVERLAP) {
        return None;
    }
    let states: Vec<_> = (0..ROTATING_STATES).map(|seed| motion.random_state(seed).state()).collect();
    match bench.overlap(load, &states, request.replays)? {
        Ok(overlap) => {
            let differing = overlap.differing;
            let failure = (differing > 0).then(|| format!("{}: {OVERLAP}: {differing} steps differ", load.name));
            failed.extend(failure);
            Some(overlap)
        }
        Err(error) => {
            failed.push(format!("{}: {OVERLAP}: {error}", load.name));
            None
        }
    }
}

fn open_workload(source: &WorkloadSource, size: Size) -> Result<(Workload, WorkloadMotion)> {
    match source {
        WorkloadSource::Synthetic(kind) => {
            let load = kind.build(size)?;
            let motion = WorkloadMotion::new(&load, None);
            Ok((load, motion))
        }
        WorkloadSource::Scene { source, record } => {
            let OpenedScene { scene, backends } = load::open(source)?;
            let record = match record {
                Some(path) => Some(RecordedTrajectory::read(path, &scene)?),
                None => RecordedTrajectory::find_next_to(source, &scene)?,
            };
            let remarks = scene.remarks.clone();
            let batches = backends.batches;
            let load = Workload { batches, remarks, ..Workload::new(scene.name.clone(), scene) };
            let motion = WorkloadMotion::new(&load, record);
            Ok((load, motion))
        }
    }
}

fn summarize(load: &Workload, motion: &WorkloadMotion, condition: ConditionNumbers, full: bool) -> WorkloadSummary {
    let (scene, layout) = (&load.scene, &load.scene.layout);
    WorkloadSummary {
        name: load.name.clone(),
        full,
        remarks: load.remarks.clone(),
        vertices: layout.vertices,
        corners: layout.corners,
        triangles: layout.triangles,
        domains: scene.domains.len(),
        coordinates: layout.coordinates,
        diagonal_meters: scene.unit * scene.rest_bounds.diagonal(),
        steps: motion.steps(),
        recorded: motion.is_recorded(),
        condition,
        ingest: None,
        overlap: None,
    }
}

/// Validates all variants of a load together, then times the passing ones one after the other.
fn measure_variants(
    request: &DeformReportOptions,
    bench: &dyn BenchTarget,
    load: &Workload,
    motion: &WorkloadMotion,
) -> (ConditionNumbers, Vec<DeformRow>) {
    let (mut variants, mut rows): (Vec<Box<dyn Variant>>, Vec<DeformRow>) = (Vec::new(), Vec::new());
    let is_selected = |name: &str| request.selects(name);
    for (label, candidate) in
        bench.variants(load, &is_selected).into_iter().filter(|(label, _)| is_selected(&label.name))
    {
        match candidate {
            Ok(variant) => variants.push(variant),
            Err(error) => rows.push(DeformRow::not_created(&load.name, &label, &error)),
        }
    }
    let (results, condition) = validate::validate(load, motion, &mut variants, (request.seeds, request.steps));
    let states: Vec<_> = (0..ROTATING_STATES).map(|seed| motion.random_state(seed).state()).collect();
    for (variant, result) in variants.iter_mut().zip(results) {
        for cache in [CacheState::Warm, CacheState::Cold] {
            let mut result = result.clone();
            let timing = match result.passed() {
                true => variant.time(&states, cache, request.replays),
                false => Ok(None),
            };
            let timing = timing.unwrap_or_else(|error| {
                result.faults.push(error.to_string());
                None
            });
            let (label, traffic) = (variant.label(), variant.traffic());
            let (launches, kernels) = (variant.launches_per_step(), variant.kernel_attributes());
            let row = DeformRow::new(&load.name, label, result, traffic, (cache, timing));
            rows.push(DeformRow { launches, kernels, ..row.relative_to(bench.roofs(label.backend)) });
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
    /// Each file is written under a temporary name and then renamed, so that an interrupted run leaves only complete
    /// files.
    pub fn write(&self, folder: &Path) -> Result<()> {
        std::fs::create_dir_all(folder).map_err(fault_in("report"))?;
        let svg = plot::draw_svg(self);
        let files = [
            ("report.json", serde_json::to_vec_pretty(self).map_err(fault_in("report"))?),
            ("report.csv", table::csv(&self.rows)?),
            ("report.md", markdown::markdown(self).into_bytes()),
            ("report.png", plot::render_png(&svg)?),
            ("report.svg", svg.into_bytes()),
        ];
        for (name, bytes) in files {
            let (path, temporary_path) = (folder.join(name), folder.join(format!("{name}.part")));
            std::fs::write(&temporary_path, bytes)
                .and_then(|()| std::fs::rename(&temporary_path, path))
                .map_err(fault_in("report"))?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests;
