use super::*;
use modalcast_compute::cpu::CpuDeformer;
use modalcast_model::error::invalid;
use testing::Damaged;
use variant::{DeformerVariant, VariantLabel};
use variant::{VariantCandidate, VariantFilter, make_candidate};

/// A bench with the CPU deformer, intact and damaged, and a variant that cannot be created.
struct Mixed {
    damage: f32,
}

impl BenchTarget for Mixed {
    fn variants(&self, load: &Workload, wanted: VariantFilter<'_>) -> Vec<VariantCandidate> {
        let label = |name: &str| VariantLabel::new(name, Backend::Cpu, &load.scene);
        let cpu =
            |label: VariantLabel| DeformerVariant::new(label, &load.scene, Box::new(CpuDeformer::new(&load.scene)));
        let bad = |label: VariantLabel| Ok(Damaged::new(cpu(label), self.damage));
        vec![make_candidate(wanted, label("good"), |label| Ok(cpu(label))), make_candidate(wanted, label("bad"), bad)]
    }

    fn roofs(&self, _backend: Backend) -> MemoryBandwidth {
        MemoryBandwidth { copy_gbs: Some(10.0), read_gbs: Some(12.0), ..MemoryBandwidth::default() }
    }
}

fn request(sources: Vec<WorkloadSource>) -> DeformReportOptions {
    DeformReportOptions { sources, seeds: 3, replays: 20, steps: usize::MAX, variants: vec![], size: Size::Quick }
}

fn report(damage: f32) -> DeformReport {
    let sources = vec![
        WorkloadSource::Synthetic(WorkloadKind::Plant(1)),
        WorkloadSource::Synthetic(WorkloadKind::Single { power: 14, rank: 10 }),
    ];
    let mut heard = Vec::new();
    let hear = |told: Progress<'_>| {
        heard.push(match told {
            Progress::Started(what) => what.to_owned(),
            Progress::Measured(report) => format!("{} {:?}", report.rows.len(), report.missing),
        });
        Ok(())
    };
    let report = deform(&request(sources), &Mixed { damage }, hear).expect("a report");
    assert!(heard[0].starts_with("plant-2: ") && heard[2].starts_with("single-14-10: "), "{heard:?}");
    assert_eq!([&heard[1], &heard[3]], ["4 [\"single-14-10\"]", "8 []"]);
    report
}

#[test]
fn interrupted_run_keeps_results_and_names_missing_loads() {
    let folder = tempfile::tempdir().expect("a folder");
    let absent = WorkloadSource::Scene { source: "absent".into(), record: None };
    let request = request(vec![WorkloadSource::Synthetic(WorkloadKind::TinyDomains), absent]);
    let keep = |told: Progress<'_>| match told {
        Progress::Measured(report) => report.write(folder.path()),
        Progress::Started(_) => Ok(()),
    };
    deform(&request, &Mixed { damage: 0.0 }, keep).expect_err("no such scene");
    let json = std::fs::read(folder.path().join("report.json")).expect("written");
    let json: serde_json::Value = serde_json::from_slice(&json).expect("JSON");
    assert_eq!((&json["missing"][0], json["rows"].as_array().map(Vec::len)), (&"absent".into(), Some(4)));
    let markdown = std::fs::read_to_string(folder.path().join("report.md")).expect("written");
    assert!(markdown.contains("Not measured yet: absent."), "{markdown}");
    let mut names = std::fs::read_dir(folder.path()).expect("listed").map(|entry| entry.expect("one").file_name());
    assert!(
        names.all(|name| name.to_string_lossy().starts_with("report.") && !name.to_string_lossy().ends_with("part"))
    );
}

#[test]
fn writes_all_report_files_and_reads_them_back() {
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
fn damaged_variant_fails_report_and_is_not_timed() {
    let report = report(0.01);
    assert!(!report.passed());
    assert_eq!(report.failed.len(), 2);
    assert!(report.failed[0].starts_with("plant-2: bad: "), "{:?}", report.failed);
    for row in &report.rows {
        assert_eq!((row.passed, row.timing.is_some()), (row.name == "good", row.name == "good"));
    }
}

#[test]
fn variant_that_cannot_be_created_fails_report() {
    struct Broken;
    impl BenchTarget for Broken {
        fn variants(&self, load: &Workload, _wanted: VariantFilter<'_>) -> Vec<VariantCandidate> {
            let label = VariantLabel::new("lost", Backend::Cuda, &load.scene);
            vec![(label, Err(invalid("kernel", "one that compiles", "none")))]
        }
    }
    let report = deform(&request(vec![WorkloadSource::Synthetic(WorkloadKind::TinyDomains)]), &Broken, |_| Ok(()))
        .expect("a report");
    assert_eq!(report.failed, ["c: lost: kernel: expected one that compiles, got none"]);
    assert!(plot::png(&plot::svg(&report)).is_ok(), "an empty plot is still a plot");
}

#[test]
fn unavailable_variant_is_skipped_without_failing_report() {
    struct Lacking;
    impl BenchTarget for Lacking {
        fn variants(&self, load: &Workload, _wanted: VariantFilter<'_>) -> Vec<VariantCandidate> {
            let label = VariantLabel::new("peer", Backend::Cuda, &load.scene);
            let (reason, remedy) = ("not found".into(), "install it".into());
            vec![(label, Err(modalcast_model::error::Error::Unavailable { what: "a library", reason, remedy }))]
        }
    }
    let report = deform(&request(vec![WorkloadSource::Synthetic(WorkloadKind::TinyDomains)]), &Lacking, |_| Ok(()))
        .expect("a report");
    assert!(report.passed() && report.rows[0].left_out && !report.rows[0].passed);
    assert!(report.rows[0].faults[0].contains("not found"), "{:?}", report.rows[0].faults);
}

#[test]
fn overlap_fails_report_only_when_vertices_differ() {
    struct Beside(usize);
    impl BenchTarget for Beside {
        fn variants(&self, _load: &Workload, _wanted: VariantFilter<'_>) -> Vec<VariantCandidate> {
            Vec::new()
        }

        fn overlap(
            &self,
            _load: &Workload,
            states: &[modalcast_model::scene::SceneState],
            steps: usize,
        ) -> Option<Result<Overlap>> {
            assert_eq!(states.len(), ROTATING);
            let us = 12.5;
            let (cores, [bytes_in, bytes_out]) = (2, [1, 2]);
            let [write_one_core_us, write_us, graph_us, copy_out_us, step_us, ideal_us] = [us; 6];
            let [serial_us, fetched_us, overlapped_us, gain] = [4.0 * us, 3.0 * us, 2.0 * us, 2.0];
            let differing = self.0;
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
                fetched_us,
                overlapped_us,
                gain,
                ideal_us,
                differing,
            }))
        }
    }
    let made = |differing, variants: &[&str]| {
        let variants = variants.iter().map(|name| (*name).to_owned()).collect();
        let request =
            DeformReportOptions { variants, ..request(vec![WorkloadSource::Synthetic(WorkloadKind::TinyDomains)]) };
        deform(&request, &Beside(differing), |_| Ok(())).expect("a report")
    };
    assert_eq!(made(3, &[]).failed, ["c: cuda overlap: 3 steps differ"]);
    let good = made(0, &["cuda overlap"]);
    assert!(good.passed());
    assert!(markdown::markdown(&good).contains("50.0 one after the other, 37.5"));
    assert_eq!(made(3, &["cpu*"]).loads[0].overlap, None, "not asked for");
}

#[test]
fn user_scene_is_measured_under_its_own_name() {
    let source = WorkloadSource::Scene { source: "tree".into(), record: None };
    let report = deform(&request(vec![source]), &Mixed { damage: 0.0 }, |_| Ok(())).expect("a report");
    assert!(report.passed(), "{:?}", report.failed);
    assert_eq!((report.loads[0].name.as_str(), report.loads[0].recorded), ("tree", false));
    assert!(
        deform(
            &request(vec![WorkloadSource::Scene { source: "absent".into(), record: None }]),
            &Mixed { damage: 0.0 },
            |_| Ok(())
        )
        .is_err()
    );
}
