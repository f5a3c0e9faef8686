//! Error against run time: every variant of the deformation, on scenes of known sizes or one of the user's; and in
//! [`render`] the same of the renderer.
//!
//! Validate first, then time: a variant whose error exceeds its a-priori bound on any vertex of any state is not timed,
//! is named, and fails the report.
//!
//! - [`loads`] and [`motion`]: seeded scenes, coordinates and transforms; [`record`]: recorded ones.
//! - [`exact`], [`ingredients`] and `double`: positions in f64 with any ingredient exchanged, and bounds; [`errors`] and
//!   [`sources`] measure against them.
//! - [`variant`] and [`mod@bench`]: what is measured. A new variant implements [`variant::Variant`] and is offered by a
//!   [`bench::Bench`].
//! - [`table`], [`peers`], [`plot`]: what comes out.

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

/// What the request calls steps that the host reads beside the next.
const OVERLAP: &str = "cuda overlap";

/// States over which timed steps rotate.
const ROTATING: usize = 8;

/// What to report on.
#[derive(Debug, Clone)]
pub struct Request {
    pub sources: Vec<Source>,
    /// Random states per load.
    pub seeds: usize,
    /// Repetitions per median.
    pub replays: usize,
    /// The most steps of a trajectory.
    pub steps: usize,
    /// Which variants, by name or by its beginning and a `*`; empty: all.
    pub variants: Vec<String>,
    pub size: Size,
}

impl Request {
    fn wants(&self, name: &str) -> bool {
        wants(&self.variants, name)
    }
}

/// Whether a list of names, some of them beginnings with a `*`, has this one; an empty list has all.
fn wants(list: &[String], name: &str) -> bool {
    let fits = |wanted: &String| wanted.strip_suffix('*').map_or(name == wanted, |begin| name.starts_with(begin));
    list.is_empty() || list.iter().any(fits)
}

/// Where a scene comes from.
#[derive(Debug, Clone)]
pub enum Source {
    Synthetic(Kind),
    /// A scene of the command line, and what was recorded of it; without that, what lies beside it.
    Scene {
        source: String,
        record: Option<PathBuf>,
    },
}

impl Source {
    /// What was asked for, in words.
    fn name(&self) -> String {
        match self {
            Self::Synthetic(kind) => kind.name(),
            Self::Scene { source, .. } => source.clone(),
        }
    }
}

/// One load of a report.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Entry {
    pub name: String,
    /// Whether it has the size that its name promises.
    pub full: bool,
    pub remarks: Vec<String>,
    pub vertices: usize,
    pub corners: usize,
    pub triangles: usize,
    pub domains: usize,
    pub coordinates: usize,
    pub diagonal_metres: f64,
    /// Steps of the trajectory, and whether they were recorded.
    pub steps: usize,
    pub recorded: bool,
    pub condition: Condition,
    /// What a whole step brings to the CUDA device, and how long that takes.
    pub ingest: Option<Ingest>,
    /// Steps whose vertices the host reads, on the CUDA device.
    pub overlap: Option<Overlap>,
}

/// The way in of a step, by itself.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Ingest {
    pub bytes: u64,
    pub median_us: f64,
    /// Of the time that the bytes take at the pinned copy rate of this run.
    pub of_pinned: f64,
}

/// A whole report.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Report {
    pub made: Provenance,
    /// What is missing and why.
    pub remarks: Vec<String>,
    pub seeds: usize,
    pub roofs: Vec<(Backend, Roofs)>,
    /// Copies to the pinned memory from which the CUDA device takes a step's values.
    pub host_writes: Vec<HostWrite>,
    pub loads: Vec<Entry>,
    /// Loads that were asked for and are not measured yet; empty when the report is whole.
    pub missing: Vec<String>,
    pub rows: Vec<Row>,
    pub thesis: Peers,
    /// Variants that did not pass, as load: variant: why.
    pub failed: Vec<String>,
}

/// What a report tells while it is made.
#[derive(Debug)]
pub enum Progress<'a> {
    /// What is measured next, in words.
    Begins(&'a str),
    /// All that is measured so far: a load more than the last time.
    Measured(&'a Report),
}

/// Makes a report; `progress` hears what is being done, and what is done after each load.
///
/// # Errors
/// Those of loading a scene and of `progress`. What a variant does wrong is in the report.
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

/// What is measured so far.
#[derive(Default)]
struct Made {
    host_writes: Vec<HostWrite>,
    loads: Vec<Entry>,
    rows: Vec<Row>,
    /// What is no row's fault.
    failed: Vec<String>,
}

/// The report of some loads and their rows, the first of those that were asked for.
fn gathered(request: &Request, bench: &dyn Bench, made: &Made) -> Report {
    let Made { loads, rows, .. } = made;
    let full = |name: &str| loads.iter().any(|load: &Entry| load.name == name && load.full);
    let thesis = Peers::of(rows, full);
    let name = |row: &Row| format!("{}: {}: {}", row.load, row.name, row.faults.join("; "));
    let mut failed = made.failed.clone();
    failed.extend(rows.iter().filter(|row| !row.passed && !row.left_out).map(name));
    // The rows of warm and cold caches say the same of one variant.
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

/// Measures the overlap if it is asked for. Vertices that differ from those of the serial way fail the report.
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

/// Validates all variants of a load together, then times those that passed, one after the other.
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

    /// Writes `report.json`, `report.csv`, `report.md`, `report.svg` and `report.png` into a folder, which is made. Each
    /// file is written beside its place and renamed, so that whoever stops the run finds whole files.
    ///
    /// # Errors
    /// `Fault` when a file cannot be written.
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
