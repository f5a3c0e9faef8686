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
mod double;
pub mod errors;
pub mod exact;
pub mod ingredients;
pub mod loads;
pub mod machine;
pub mod motion;
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
mod trials;
pub mod validate;
pub mod variant;

use std::path::{Path, PathBuf};

use serde::Serialize;

use crate::deform::Backend;
use crate::error::{Result, during};
use crate::load;
use bench::{Bench, Roofs};
use loads::{Kind, Load, Size};
use machine::Provenance;
use motion::Motion;
use peers::Peers;
use record::Record;
use table::Row;
use timing::Cache;
use validate::Condition;
use variant::Variant;

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
    pub loads: Vec<Entry>,
    pub rows: Vec<Row>,
    pub thesis: Peers,
    /// Variants that did not pass, as load: variant: why.
    pub failed: Vec<String>,
}

/// Makes a report; `progress` hears what is being done.
///
/// # Errors
/// Those of loading a scene. What a variant does wrong is in the report.
pub fn deform(request: &Request, bench: &dyn Bench, mut progress: impl FnMut(&str)) -> Result<Report> {
    let (mut loads, mut rows) = (Vec::new(), Vec::new());
    for source in &request.sources {
        let (load, motion) = open(source, request.size)?;
        progress(&format!(
            "{}: {} vertices, {} domains",
            load.name,
            load.scene.layout.vertices,
            load.scene.domains.len()
        ));
        let (condition, measured) = measure(request, bench, &load, &motion);
        rows.extend(measured);
        let full = request.size == Size::Full && matches!(source, Source::Synthetic(_));
        let entry = entry(&load, &motion, condition, full);
        loads.push(Entry { ingest: bench.ingest(&load, request.replays), ..entry });
    }
    let full = |name: &str| loads.iter().any(|load: &Entry| load.name == name && load.full);
    let thesis = Peers::of(&rows, full);
    let name = |row: &Row| format!("{}: {}: {}", row.load, row.name, row.faults.join("; "));
    let mut failed: Vec<String> = rows.iter().filter(|row| !row.passed && !row.left_out).map(name).collect();
    // The rows of warm and cold caches say the same of one variant.
    failed.dedup();
    let roofs = [Backend::Cpu, Backend::Cuda].map(|backend| (backend, bench.roofs(backend))).into();
    let (made, remarks) = (Provenance::here(), bench.remarks());
    Ok(Report { made, remarks, seeds: request.seeds, roofs, loads, rows, thesis, failed })
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

    /// Writes `report.json`, `report.csv`, `report.md`, `report.svg` and `report.png` into a folder, which is made.
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
            std::fs::write(folder.join(name), bytes).map_err(during("report"))?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cpu::CpuDeformer;
    use crate::error::invalid;
    use bench::{Offer, Wanted, offer};
    use testing::Damaged;
    use variant::{Driven, Label};

    /// The CPU, healthy and damaged, and a variant that cannot be made.
    struct Mixed {
        damage: f32,
    }

    impl Bench for Mixed {
        fn variants(&self, load: &Load, wanted: Wanted<'_>) -> Vec<Offer> {
            let label = |name: &str| Label::new(name, Backend::Cpu, &load.scene);
            let cpu = |label: Label| Driven::new(label, &load.scene, Box::new(CpuDeformer::new(&load.scene)));
            let bad = |label: Label| Ok(Damaged::new(cpu(label), self.damage));
            vec![offer(wanted, label("good"), |label| Ok(cpu(label))), offer(wanted, label("bad"), bad)]
        }

        fn roofs(&self, _backend: Backend) -> Roofs {
            Roofs { copy_gbs: Some(10.0), read_gbs: Some(12.0), ..Roofs::default() }
        }
    }

    fn request(sources: Vec<Source>) -> Request {
        Request { sources, seeds: 3, replays: 20, steps: usize::MAX, variants: vec![], size: Size::Quick }
    }

    fn report(damage: f32) -> Report {
        let sources = vec![Source::Synthetic(Kind::Plant(1)), Source::Synthetic(Kind::Single { power: 14, rank: 10 })];
        let mut heard = Vec::new();
        let report =
            deform(&request(sources), &Mixed { damage }, |what| heard.push(what.to_owned())).expect("a report");
        assert_eq!(heard.len(), 2, "{heard:?}");
        report
    }

    #[test]
    fn a_report_writes_all_files_and_they_read_back() {
        let report = report(0.0);
        assert!(report.passed(), "{:?}", report.failed);
        let folder = tempfile::tempdir().expect("a folder");
        let out = folder.path().join("new");
        report.write(&out).expect("written");
        let read = |name: &str| std::fs::read(out.join(name)).expect(name);
        let json: serde_json::Value = serde_json::from_slice(&read("report.json")).expect("JSON");
        assert_eq!(json["rows"].as_array().map(Vec::len), Some(8), "two loads, two variants, two caches");
        assert_eq!(json["rows"][0]["passed"], true);
        assert!(json["rows"][0]["of_read"].as_f64().expect("a share") > 0.0);
        assert_eq!(json["made"]["version"], env!("CARGO_PKG_VERSION"));
        assert_eq!(json["thesis"]["tables_4_5_to_4_7"].as_array().map(Vec::len), Some(12));
        let records = csv::Reader::from_reader(read("report.csv").as_slice()).records().count();
        assert_eq!(records, 8);
        assert!(String::from_utf8(read("report.md")).expect("UTF-8").contains("plant-2"));
        assert!(read("report.svg").starts_with(b"<svg"));
        let image = image::load_from_memory(&read("report.png")).expect("a PNG");
        assert!(image.width() > 400);
    }

    #[test]
    fn a_damaged_variant_fails_the_report_by_name_and_is_not_timed() {
        let report = report(0.01);
        assert!(!report.passed());
        assert_eq!(report.failed.len(), 2);
        assert!(report.failed[0].starts_with("plant-2: bad: "), "{:?}", report.failed);
        for row in &report.rows {
            assert_eq!((row.passed, row.timing.is_some()), (row.name == "good", row.name == "good"));
        }
    }

    #[test]
    fn a_variant_that_cannot_be_made_fails_the_report_by_name() {
        struct Broken;
        impl Bench for Broken {
            fn variants(&self, load: &Load, _wanted: Wanted<'_>) -> Vec<Offer> {
                let label = Label::new("lost", Backend::Cuda, &load.scene);
                vec![(label, Err(invalid("kernel", "one that compiles", "none")))]
            }
        }
        let report = deform(&request(vec![Source::Synthetic(Kind::C)]), &Broken, |_| {}).expect("a report");
        assert_eq!(report.failed, ["c: lost: kernel: expected one that compiles, given none"]);
        assert!(plot::png(&plot::svg(&report)).is_ok(), "an empty plot is still a plot");
    }

    #[test]
    fn a_variant_that_lacks_what_is_not_here_is_left_out_with_the_reason_and_fails_nothing() {
        struct Lacking;
        impl Bench for Lacking {
            fn variants(&self, load: &Load, _wanted: Wanted<'_>) -> Vec<Offer> {
                let label = Label::new("peer", Backend::Cuda, &load.scene);
                let (reason, remedy) = ("not found".into(), "install it".into());
                vec![(label, Err(crate::error::Error::Unavailable { what: "a library", reason, remedy }))]
            }
        }
        let report = deform(&request(vec![Source::Synthetic(Kind::C)]), &Lacking, |_| {}).expect("a report");
        assert!(report.passed() && report.rows[0].left_out && !report.rows[0].passed);
        assert!(report.rows[0].faults[0].contains("not found"), "{:?}", report.rows[0].faults);
    }

    #[test]
    fn a_scene_of_the_user_is_measured_under_its_own_name() {
        let source = Source::Scene { source: "tree".into(), record: None };
        let report = deform(&request(vec![source]), &Mixed { damage: 0.0 }, |_| {}).expect("a report");
        assert!(report.passed(), "{:?}", report.failed);
        assert_eq!((report.loads[0].name.as_str(), report.loads[0].recorded), ("tree", false));
        assert!(
            deform(
                &request(vec![Source::Scene { source: "absent".into(), record: None }]),
                &Mixed { damage: 0.0 },
                |_| {}
            )
            .is_err()
        );
    }
}
