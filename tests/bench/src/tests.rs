//! Tests of complete reports with small workloads.

use super::*;
use modalcast_compute::cpu::CpuDeformer;
use modalcast_model::error::invalid;
use testing::InaccurateVariant;
use variant::{DeformerVariant, VariantLabel};
use variant::{VariantCandidate, VariantFilter, make_candidate};

/// A target with the CPU deformer, and with the same deformer plus a position error.
struct CpuTarget {
    position_error: f32,
}

impl BenchTarget for CpuTarget {
    fn variants(&self, workload: &Workload, is_selected: VariantFilter<'_>) -> Vec<VariantCandidate> {
        let scene = &workload.scene;
        let label = |name: &str| VariantLabel::new(name, Backend::Cpu, scene);
        let cpu = |label: VariantLabel| DeformerVariant::new(label, scene, Box::new(CpuDeformer::new(scene)));
        let inaccurate = |label: VariantLabel| Ok(InaccurateVariant::new(cpu(label), self.position_error));
        vec![
            make_candidate(is_selected, label("accurate"), |label| Ok(cpu(label))),
            make_candidate(is_selected, label("inaccurate"), inaccurate),
        ]
    }

    fn memory_bandwidth(&self, _backend: Backend) -> MemoryBandwidth {
        MemoryBandwidth { copy_gbs: Some(10.0), read_gbs: Some(12.0), ..MemoryBandwidth::default() }
    }
}

fn report_options(sources: Vec<WorkloadSource>) -> DeformReportOptions {
    let validation = ValidationLimits { seeds: 3, steps: usize::MAX, seconds: f64::INFINITY };
    DeformReportOptions { sources, validation, replays: 20, variants: vec![], size: Size::Quick }
}

/// Measures two workloads with the CPU target and checks the progress events.
fn measure(position_error: f32) -> DeformReport {
    let sources = vec![
        WorkloadSource::Synthetic(WorkloadKind::Plant(1)),
        WorkloadSource::Synthetic(WorkloadKind::Single { power: 14, rank: 10 }),
    ];
    let mut events = Vec::new();
    let on_progress = |progress: Progress<'_>| {
        events.push(match progress {
            Progress::Started(description) => description.to_owned(),
            Progress::Measured(report) => format!("{} {:?}", report.rows.len(), report.missing),
        });
        Ok(())
    };
    let report =
        deform(&report_options(sources), &CpuTarget { position_error }, on_progress).expect("expected a report");
    // Names count plants from 1. A workload has four rows: two variants with warm and with cold caches.
    assert!(events[0].starts_with("plant-2: ") && events[2].starts_with("single-14-10: "), "{events:?}");
    assert_eq!([&events[1], &events[3]], ["4 [\"single-14-10\"]", "8 []"]);
    report
}

#[test]
fn interrupted_run_keeps_results_and_names_missing_loads() {
    let folder = tempfile::tempdir().expect("expected a folder");
    let absent = WorkloadSource::Scene { source: "absent".into(), recording: None };
    let report_options = report_options(vec![WorkloadSource::Synthetic(WorkloadKind::TinyDomains), absent]);
    let write_report = |progress: Progress<'_>| match progress {
        Progress::Measured(report) => report.write(folder.path()),
        Progress::Started(_) => Ok(()),
    };
    deform(&report_options, &CpuTarget { position_error: 0.0 }, write_report).expect_err("no such scene");
    let json = std::fs::read(folder.path().join("report.json")).expect("expected a report file");
    let json: serde_json::Value = serde_json::from_slice(&json).expect("JSON");
    assert_eq!((&json["missing"][0], json["rows"].as_array().map(Vec::len)), (&"absent".into(), Some(4)));
    let markdown = std::fs::read_to_string(folder.path().join("report.md")).expect("expected a report file");
    assert!(markdown.contains("Not measured yet: absent."), "{markdown}");
    for entry in std::fs::read_dir(folder.path()).expect("expected a folder") {
        let name = entry.expect("expected an entry").file_name().to_string_lossy().into_owned();
        assert!(name.starts_with("report.") && !name.ends_with("part"), "expected no temporary file, got {name}");
    }
}

#[test]
fn writes_all_report_files_and_reads_them_back() {
    let report = measure(0.0);
    assert!(report.passed(), "{:?}", report.failed);
    let folder = tempfile::tempdir().expect("expected a folder");
    let out = folder.path().join("new");
    report.write(&out).expect("expected a report file");
    let read = |name: &str| std::fs::read(out.join(name)).expect(name);
    let json: serde_json::Value = serde_json::from_slice(&read("report.json")).expect("JSON");
    assert_eq!(json["rows"].as_array().map(Vec::len), Some(8), "expected a row per load, variant and cache state");
    assert_eq!(json["rows"][0]["passed"], true);
    assert!(json["rows"][0]["of_read"].as_f64().expect("expected a fraction") > 0.0);
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
fn inaccurate_variant_fails_report_and_is_not_timed() {
    let report = measure(0.01);
    assert!(!report.passed());
    // One failure per workload.
    assert_eq!(report.failed.len(), 2);
    assert!(report.failed[0].starts_with("plant-2: inaccurate: "), "{:?}", report.failed);
    for row in &report.rows {
        assert_eq!((row.passed, row.timing.is_some()), (row.name == "accurate", row.name == "accurate"));
    }
}

#[test]
fn variant_that_cannot_be_created_fails_report() {
    struct BrokenTarget;
    impl BenchTarget for BrokenTarget {
        fn variants(&self, workload: &Workload, _is_selected: VariantFilter<'_>) -> Vec<VariantCandidate> {
            let label = VariantLabel::new("lost", Backend::Cuda, &workload.scene);
            vec![(label, Err(invalid("kernel", "one that compiles", "none")))]
        }
    }
    let report =
        deform(&report_options(vec![WorkloadSource::Synthetic(WorkloadKind::TinyDomains)]), &BrokenTarget, |_| Ok(()))
            .expect("expected a report");
    // "c" is the name of the workload `TinyDomains`.
    assert_eq!(report.failed, ["c: lost: kernel: expected one that compiles, got none"]);
    assert!(plot::render_png(&plot::draw_svg(&report)).is_ok(), "expected a plot without points");
}

#[test]
fn unavailable_variant_is_skipped_without_failing_report() {
    struct UnavailableTarget;
    impl BenchTarget for UnavailableTarget {
        fn variants(&self, workload: &Workload, _is_selected: VariantFilter<'_>) -> Vec<VariantCandidate> {
            let label = VariantLabel::new("peer", Backend::Cuda, &workload.scene);
            let (reason, remedy) = ("not found".into(), "install it".into());
            vec![(label, Err(modalcast_model::error::Error::Unavailable { what: "a library", reason, remedy }))]
        }
    }
    let report =
        deform(&report_options(vec![WorkloadSource::Synthetic(WorkloadKind::TinyDomains)]), &UnavailableTarget, |_| {
            Ok(())
        })
        .expect("expected a report");
    assert!(report.passed() && report.rows[0].is_skipped && !report.rows[0].passed);
    assert!(report.rows[0].faults[0].contains("not found"), "{:?}", report.rows[0].faults);
}

#[test]
fn overlap_fails_report_only_when_vertices_differ() {
    struct OverlapTarget {
        differing: usize,
    }
    impl BenchTarget for OverlapTarget {
        fn variants(&self, _workload: &Workload, _is_selected: VariantFilter<'_>) -> Vec<VariantCandidate> {
            Vec::new()
        }

        fn measure_overlap(
            &self,
            _workload: &Workload,
            states: &[modalcast_model::scene::SceneState],
            steps: usize,
        ) -> Option<Result<Overlap>> {
            assert_eq!(states.len(), ROTATING_STATES);
            let us = 12.5;
            let (cores, [bytes_in, bytes_out]) = (2, [1, 2]);
            let [write_one_core_us, write_us, graph_us, copy_out_us, step_us, ideal_us] = [us; 6];
            let [serial_us, pipelined_us, overlapped_us, gain] = [4.0 * us, 3.0 * us, 2.0 * us, 2.0];
            let differing = self.differing;
            Some(Ok(Overlap {
                steps,
                cores,
                bytes_in,
                bytes_out,
                write_one_core_us,
                write_us,
                graph_us,
                copy_out_us,
                step_us,
                serial_us,
                pipelined_us,
                overlapped_us,
                gain,
                ideal_us,
                differing,
            }))
        }
    }
    let report_with = |differing, variants: &[&str]| {
        let variants = variants.iter().map(|name| (*name).to_owned()).collect();
        let report_options = DeformReportOptions {
            variants,
            ..report_options(vec![WorkloadSource::Synthetic(WorkloadKind::TinyDomains)])
        };
        deform(&report_options, &OverlapTarget { differing }, |_| Ok(())).expect("expected a report")
    };
    assert_eq!(report_with(3, &[]).failed, ["c: cuda overlap: 3 steps differ"]);
    let passing = report_with(0, &["cuda overlap"]);
    assert!(passing.passed());
    // serial_us = 4 x 12.5 and pipelined_us = 3 x 12.5.
    assert!(markdown::markdown(&passing).contains("50.0 serially, 37.5"));
    assert_eq!(report_with(3, &["cpu*"]).loads[0].overlap, None, "expected no overlap if it is not selected");
}

#[test]
fn user_scene_is_measured_under_its_own_name() {
    let source = WorkloadSource::Scene { source: "tree".into(), recording: None };
    let report = deform(&report_options(vec![source]), &CpuTarget { position_error: 0.0 }, |_| Ok(()))
        .expect("expected a report");
    assert!(report.passed(), "{:?}", report.failed);
    assert_eq!((report.loads[0].name.as_str(), report.loads[0].is_recorded), ("tree", false));
    assert!(
        deform(
            &report_options(vec![WorkloadSource::Scene { source: "absent".into(), recording: None }]),
            &CpuTarget { position_error: 0.0 },
            |_| Ok(())
        )
        .is_err()
    );
}
