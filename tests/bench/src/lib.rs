//! Benchmarks of error against run time for every variant of the deformation, on synthetic scenes or on a scene of the
//! user. [`render`] does the same for the renderer.
//!
//! Validation comes before timing: a variant whose error exceeds its a-priori bound at any vertex of any state is not
//! timed. The report names the variant and fails.
//!
//! - [`loads`] and [`motion`]: seeded synthetic scenes, modal coordinates and transforms; [`record`]: recorded
//!   trajectories.
//! - [`exact`], [`ingredients`] and `double`: reference positions in f64 with single terms of the error model
//!   exchanged, and a-priori bounds. [`errors`] and [`sources`] measure variants against them.
//! - [`variant`] and [`mod@bench`]: the variants to measure. A new variant implements [`variant::Variant`], and a
//!   [`bench::Bench`] offers it.
//! - [`table`], [`peers`], [`plot`]: the output.

pub mod bench;
pub mod cli;
mod double;
pub mod errors;
pub mod exact;
pub mod ingredients;
pub mod kernels;
pub mod loads;
pub mod machine;
pub mod motion;
mod offers;
mod page;
pub mod peers;
pub mod plot;
pub mod record;
pub mod render;
pub mod sources;
pub mod table;
#[cfg(test)]
mod testing;
pub mod thesis;
pub mod timing;
pub mod traffic;
pub mod validate;
pub mod variant;

use std::path::{Path, PathBuf};

use serde::Serialize;

use crate::kernels::{HostWrite, Overlap};
use bench::{Bench, Roofs};
use loads::{Kind, Load, Size};
use machine::Provenance;
use modalcast_model::deform::Backend;
use modalcast_model::error::{Result, during};
use modalcast_model::load;
use motion::Motion;
use peers::Peers;
use record::Record;
use table::Row;
use timing::Cache;
use validate::Condition;
use variant::Variant;

/// Name under which [`Request::variants`] selects the overlap benchmark: device-to-host readback of a step while the
/// next step runs.
const OVERLAP: &str = "cuda overlap";

/// Number of states that timed steps rotate through.
const ROTATING: usize = 8;

/// Settings of a report: scenes, sample counts and variants.
#[derive(Debug, Clone)]
pub struct Request {
    pub sources: Vec<Source>,
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

impl Request {
    fn wants(&self, name: &str) -> bool {
        wants(&self.variants, name)
    }
}

/// Whether `name` is selected by a list of full names and prefixes that end in `*`; an empty list selects everything.
fn wants(list: &[String], name: &str) -> bool {
    let fits = |wanted: &String| wanted.strip_suffix('*').map_or(name == wanted, |begin| name.starts_with(begin));
    list.is_empty() || list.iter().any(fits)
}

/// Source of a scene.
#[derive(Debug, Clone)]
pub enum Source {
    Synthetic(Kind),
    /// A scene given on the command line and its recorded trajectory. Without `record`, a recording next to the scene
    /// is used if there is one.
    Scene {
        source: String,
        record: Option<PathBuf>,
    },
}

impl Source {
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
pub struct Entry {
    pub name: String,
    /// Whether the load has the full size that its name states; false for `--quick` builds and for scenes of the user.
    pub full: bool,
    pub remarks: Vec<String>,
    pub vertices: usize,
    pub corners: usize,
    pub triangles: usize,
    pub domains: usize,
    pub coordinates: usize,
    pub diagonal_metres: f64,
    /// Steps of the trajectory.
    pub steps: usize,
    pub recorded: bool,
    pub condition: Condition,
    /// Upload of one whole step to the CUDA device: bytes and time.
    pub ingest: Option<Ingest>,
    /// Steps with readback of the vertices on the CUDA device, serial against overlapped.
    pub overlap: Option<Overlap>,
}

/// Host-to-device upload of one step, timed alone.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Ingest {
    pub bytes: u64,
    pub median_us: f64,
    /// Measured time divided by the time that the same bytes take at this run's pinned host-to-device rate.
    pub of_pinned: f64,
}

/// All results of one run.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Report {
    pub made: Provenance,
    /// Missing capabilities and the reasons, for the reader.
    pub remarks: Vec<String>,
    pub seeds: usize,
    pub roofs: Vec<(Backend, Roofs)>,
    /// Host write rates into the pinned memory from which the CUDA device reads a step's values.
    pub host_writes: Vec<HostWrite>,
    pub loads: Vec<Entry>,
    /// Requested loads that are not measured yet; empty when the report is complete.
    pub missing: Vec<String>,
    pub rows: Vec<Row>,
    pub thesis: Peers,
    /// Failed variants, each as `load: variant: reason`.
    pub failed: Vec<String>,
}

/// Progress events of a running report.
#[derive(Debug)]
pub enum Progress<'a> {
    /// Description of the measurement that starts now.
    Begins(&'a str),
    /// All results so far: one load more than in the previous event.
    Measured(&'a Report),
}

/// Measures all requested loads and returns the report. `progress` is called when a load starts and after each load.
///
/// # Errors
/// Errors of loading a scene and of `progress`. Failures of a variant are recorded in the report instead.
pub fn deform(
    request: &Request,
    bench: &dyn Bench,
    mut progress: impl FnMut(Progress<'_>) -> Result<()>,
) -> Result<Report> {
    let mut made = Made::default();
    if request.wants(OVERLAP) {
        made.host_writes = bench.host_writes(request.replays);
    }
    let mut report = gathered(request, bench, &made);
    for source in &request.sources {
        let (load, motion) = open(source, request.size)?;
        let (vertices, domains) = (load.scene.layout.vertices, load.scene.domains.len());
        progress(Progress::Begins(&format!("{}: {vertices} vertices, {domains} domains", load.name)))?;
        let (condition, measured) = measure(request, bench, &load, &motion);
        made.rows.extend(measured);
        let full = request.size == Size::Full && matches!(source, Source::Synthetic(_));
        let entry = entry(&load, &motion, condition, full);
        let overlap = overlap(request, bench, &load, &motion, &mut made.failed);
        made.loads.push(Entry { ingest: bench.ingest(&load, request.replays), overlap, ..entry });
        report = gathered(request, bench, &made);
        progress(Progress::Measured(&report))?;
    }
    Ok(report)
}

/// Results so far.
#[derive(Default)]
struct Made {
    host_writes: Vec<HostWrite>,
    loads: Vec<Entry>,
    rows: Vec<Row>,
    /// Failures that belong to no row, such as those of the overlap benchmark.
    failed: Vec<String>,
}

/// Assembles the report from the loads measured so far. They are the first ones of `request.sources`.
fn gathered(request: &Request, bench: &dyn Bench, made: &Made) -> Report {
    let Made { loads, rows, .. } = made;
    let full = |name: &str| loads.iter().any(|load: &Entry| load.name == name && load.full);
    let thesis = Peers::of(rows, full);
    let name = |row: &Row| format!("{}: {}: {}", row.load, row.name, row.faults.join("; "));
    let mut failed = made.failed.clone();
    failed.extend(rows.iter().filter(|row| !row.passed && !row.left_out).map(name));
    // The rows for warm and cold caches repeat the same failure of one variant.
    failed.dedup();
    let roofs = [Backend::Cpu, Backend::Cuda].map(|backend| (backend, bench.roofs(backend))).into();
    Report {
        made: Provenance::here(),
        remarks: bench.remarks(),
        seeds: request.seeds,
        roofs,
        host_writes: made.host_writes.clone(),
        loads: loads.clone(),
        missing: request.sources[loads.len()..].iter().map(Source::name).collect(),
        rows: rows.clone(),
        thesis,
        failed,
    }
}

/// Runs the overlap benchmark if it is requested. The report fails if its vertices differ from those of serial steps.
fn overlap(
    request: &Request,
    bench: &dyn Bench,
    load: &Load,
    motion: &Motion,
    failed: &mut Vec<String>,
) -> Option<Overlap> {
    if !request.wants(OVERLAP) {
        return None;
    }
    let states: Vec<_> = (0..ROTATING).map(|seed| motion.seed(seed).state()).collect();
    match bench.overlap(load, &states, request.replays)? {
        Ok(overlap) => {
            let differing = overlap.differing;
            let wrong = (differing > 0).then(|| format!("{}: {OVERLAP}: {differing} steps differ", load.name));
            failed.extend(wrong);
            Some(overlap)
        }
        Err(error) => {
            failed.push(format!("{}: {OVERLAP}: {error}", load.name));
            None
        }
    }
}

fn open(source: &Source, size: Size) -> Result<(Load, Motion)> {
    match source {
        Source::Synthetic(kind) => {
            let load = kind.build(size)?;
            let motion = Motion::new(&load, None);
            Ok((load, motion))
        }
        Source::Scene { source, record } => {
            let scene = load::open(source)?;
            let record = match record {
                Some(path) => Some(Record::read(path, &scene)?),
                None => Record::beside(source, &scene)?,
            };
            let remarks = scene.remarks.clone();
            let load = Load { name: scene.name.clone(), scene, paired: false, species: None, remarks };
            let motion = Motion::new(&load, record);
            Ok((load, motion))
        }
    }
}

fn entry(load: &Load, motion: &Motion, condition: Condition, full: bool) -> Entry {
    let (scene, layout) = (&load.scene, &load.scene.layout);
    Entry {
        name: load.name.clone(),
        full,
        remarks: load.remarks.clone(),
        vertices: layout.vertices,
        corners: layout.corners,
        triangles: layout.triangles,
        domains: scene.domains.len(),
        coordinates: layout.coordinates,
        diagonal_metres: scene.unit * scene.rest_bounds.diagonal(),
        steps: motion.steps(),
        recorded: motion.is_recorded(),
        condition,
        ingest: None,
        overlap: None,
    }
}

/// Validates all variants of a load together, then times the passing ones one after the other.
fn measure(request: &Request, bench: &dyn Bench, load: &Load, motion: &Motion) -> (Condition, Vec<Row>) {
    let (mut variants, mut rows): (Vec<Box<dyn Variant>>, Vec<Row>) = (Vec::new(), Vec::new());
    let wanted = |name: &str| request.wants(name);
    for (label, made) in bench.variants(load, &wanted).into_iter().filter(|(label, _)| wanted(&label.name)) {
        match made {
            Ok(variant) => variants.push(variant),
            Err(error) => rows.push(Row::unmade(&load.name, &label, &error)),
        }
    }
    let (found, condition) = validate::validate(load, motion, &mut variants, (request.seeds, request.steps));
    let states: Vec<_> = (0..ROTATING).map(|seed| motion.seed(seed).state()).collect();
    for (variant, found) in variants.iter_mut().zip(found) {
        for cache in [Cache::Warm, Cache::Cold] {
            let mut found = found.clone();
            let timing = match found.passed() {
                true => variant.time(&states, cache, request.replays),
                false => Ok(None),
            };
            let timing = timing.unwrap_or_else(|error| {
                found.faults.push(error.to_string());
                None
            });
            let (label, traffic) = (variant.label(), variant.traffic());
            let (launches, kernels) = variant.kernels();
            let row = Row::new(&load.name, label, found, traffic, (cache, timing));
            rows.push(Row { launches, kernels, ..row.under(bench.roofs(label.backend)) });
        }
    }
    (condition, rows)
}

impl Report {
    /// Whether every variant passed.
    pub fn passed(&self) -> bool {
        self.failed.is_empty()
    }

    /// Writes `report.json`, `report.csv`, `report.md`, `report.svg` and `report.png` into a folder, which is created.
    /// Each file is written under a temporary name and then renamed, so that an interrupted run leaves only complete
    /// files.
    pub fn write(&self, folder: &Path) -> Result<()> {
        std::fs::create_dir_all(folder).map_err(during("report"))?;
        let svg = plot::svg(self);
        let files = [
            ("report.json", serde_json::to_vec_pretty(self).map_err(during("report"))?),
            ("report.csv", table::csv(&self.rows)?),
            ("report.md", page::markdown(self).into_bytes()),
            ("report.png", plot::png(&svg)?),
            ("report.svg", svg.into_bytes()),
        ];
        for (name, bytes) in files {
            let (place, beside) = (folder.join(name), folder.join(format!("{name}.part")));
            std::fs::write(&beside, bytes).and_then(|()| std::fs::rename(&beside, place)).map_err(during("report"))?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests;
