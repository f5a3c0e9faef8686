//! Tests of the output of a report with given results.

use std::collections::BTreeMap;

use super::vertex_encodings::EncodingErrors;
use super::*;
use stages::StageRate;

fn encoding_row(encoding: &'static str, of_bound: f64) -> VertexEncodingRow {
    VertexEncodingRow {
        attribute: "positions",
        encoding,
        bytes: 600,
        pack_ms: 0.5,
        decode_ms: 0.25,
        errors: EncodingErrors { largest: 2e-4, rms: 1e-4, bound: 4e-4, of_bound },
    }
}

pub(super) fn rate_result() -> RateResult {
    let stage_rates = vec![StageRate {
        stages: "draw and shadow".into(),
        ms: 2.5,
        resource: "one GPU".into(),
        parallel: 1,
        per_second: 400.0,
    }];
    RateResult {
        content: Some("PNG 8x8".into()),
        viewers: 1,
        views: 1,
        steps: 20,
        runs: vec![90.0, 100.0, 110.0],
        per_second: 100.0,
        steps_per_second: 101.0,
        reply_bytes: Some(1234.0),
        skipped: 0,
        stages_ms: vec![BTreeMap::from([("draw".to_owned(), 1.5)])],
        alone_ms: vec![BTreeMap::from([("draw".to_owned(), 1.25)])],
        stage_rates,
        of_slowest_stage: 0.25,
    }
}

pub(super) fn case(name: &'static str, result: CaseResult) -> CaseReport {
    let look = serde_json::json!({ "antialias": "msaa", "raster": "opengl", "shadow": { "method": "variance", "fit": "vertices" } });
    CaseReport {
        name,
        scene: "tree",
        look: Some(SceneLook { look, samples: 4, shadow_map: Some(2048) }),
        server: "deforms on cpu".into(),
        machine: "a machine".into(),
        date: "2026-11-22T00:00:00Z".into(),
        build: modalcast::BUILD,
        command: "modalcast-report stream".into(),
        result,
    }
}

pub(super) fn report(cases: Vec<CaseReport>) -> StreamReport {
    StreamReport {
        provenance: Provenance::collect(),
        build: modalcast::BUILD,
        is_full_size: false,
        cases,
        missing: vec!["tree-steps"],
        failed: vec![],
    }
}

#[test]
fn files_contain_the_same_numbers_and_how_to_repeat_them() {
    let folder = tempfile::tempdir().expect("expected a folder");
    let encodings = CaseResult::VertexEncodings(vec![encoding_row("f32", 0.0), encoding_row("f16", 0.5)]);
    let cases = vec![case("tree-png-1080p", CaseResult::Rate(rate_result())), case("tree-vertex-encodings", encodings)];
    report(cases).write(folder.path()).expect("expected the files");
    let read = |name: &str| std::fs::read(folder.path().join(name)).expect("expected a file");
    let json: serde_json::Value = serde_json::from_slice(&read("report.json")).expect("expected JSON");
    assert_eq!(json["cases"][0]["result"]["rate"]["per_second"], 100.0);
    assert_eq!(json["cases"][1]["result"]["vertex_encodings"][1]["errors"]["of_bound"], 0.5);
    let csv_bytes = read("report.csv");
    let mut csv = csv::Reader::from_reader(&csv_bytes[..]).into_records();
    let rows: Vec<Vec<String>> =
        csv.by_ref().map(|row| row.expect("expected a row").iter().map(str::to_owned).collect()).collect();
    let find = |case: &str, variant: &str, quantity: &str| {
        rows.iter().find(|row| row[..3] == [case, variant, quantity]).cloned().expect("expected the number")
    };
    let rate = find("tree-png-1080p", "", "rate");
    let look = "variance shadow map of 2048x2048 fitted to vertices, antialias msaa, raster opengl";
    assert_eq!(rate[3..9], ["100", "1/s", "tree", look, "4", "2048"]);
    assert_eq!(rate[10..], ["a machine", "2026-11-22T00:00:00Z", modalcast::BUILD, "modalcast-report stream"]);
    assert_eq!(find("tree-png-1080p", "draw and shadow of one GPU", "stage rate")[3], "400");
    assert_eq!(find("tree-vertex-encodings", "positions f16", "largest error")[3..5], ["0.0002", "m"]);
    let markdown = String::from_utf8(read("report.md")).expect("expected text");
    for text in ["Not measured yet: tree-steps.", "draw and shadow: 2.500 ms of one GPU", "| 400.0 | 0.25 |", "f16"] {
        assert!(markdown.contains(text), "expected '{text}' in {markdown}");
    }
    let svg = String::from_utf8(read("report.svg")).expect("expected text");
    assert!(svg.contains(">tree-png-1080p</text>") && svg.contains(">tree: positions</text>"), "{svg}");
    assert!(image::load_from_memory(&read("report.png")).is_ok());
}

#[test]
fn encoding_beyond_its_bound_is_a_failure() {
    let failures = |of_bound| case("a", CaseResult::VertexEncodings(vec![encoding_row("f16", of_bound)])).failures();
    assert!(failures(1.0).is_empty());
    for of_bound in [1.01, f64::INFINITY, f64::NAN] {
        assert_eq!(failures(of_bound).len(), 1, "{of_bound}");
    }
    let names = ["a: positions f16: expected an error of at most 4e-4, got 2e-4"];
    assert_eq!(failures(2.0), names);
}

#[test]
fn unknown_case_is_rejected_with_all_names() {
    let options = StreamReportOptions {
        scenes: None,
        cases: vec!["x".into()],
        steps: 2,
        latency_steps: None,
        repeat: 1,
        size: Size::Quick,
    };
    let error = measure(&options, |_| Ok(())).expect_err("expected an unknown case").to_string();
    assert!(error.contains("tree-png-1080p, ") && error.ends_with("got x"), "{error}");
}
