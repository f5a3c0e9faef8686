//! The report `stream` as a program, with the other programs of the workspace. They are in the same folder if the tests
//! of the workspace were built, or after `cargo build --workspace --bins`.

use std::path::Path;
use std::process::Command;

use serde_json::Value;

/// Runs a quick report of few steps. Returns the exit code and its output.
fn run_report(folder: &Path, cases: &[&str]) -> (Option<i32>, String) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_modalcast-report"));
    command.args(["stream", "--quick", "--steps", "6", "--out"]).arg(folder);
    cases.iter().for_each(|case| {
        command.args(["--case", case]);
    });
    let output = command.output().expect("expected a run of the report");
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    (output.status.code(), format!("{}{}", text(&output.stdout), text(&output.stderr)))
}

fn read(folder: &Path, name: &str) -> Vec<u8> {
    std::fs::read(folder.join(name)).unwrap_or_else(|error| panic!("{name}: {error}"))
}

#[test]
fn quick_report_is_complete_and_consistent() {
    let folder = tempfile::tempdir().expect("expected a folder");
    let cases = ["tree-vertices-compact", "tree-png-360p", "tree-socket"];
    let (code, output) = run_report(folder.path(), &cases);
    assert_eq!(code, Some(0), "{output}");
    let report: Value = serde_json::from_slice(&read(folder.path(), "report.json")).expect("expected JSON");
    assert_eq!(
        (&report["missing"], &report["failed"], &report["full"]),
        (&Value::Array(vec![]), &Value::Array(vec![]), &Value::Bool(false))
    );
    let case = |name: &str| {
        let mut reports = report["cases"].as_array().expect("expected cases").iter();
        reports.find(|case| case["name"] == name).cloned().unwrap_or_else(|| panic!("expected {name}"))
    };
    for name in cases {
        let case = case(name);
        assert_eq!(case["build"], report["build"], "{case}");
        // A software renderer draws one sample per pixel by default.
        assert!(matches!(case["look"]["samples"].as_u64(), Some(1 | 4)), "{case}");
        assert!(case["look"]["shadow_map"].as_u64().is_some_and(|side| side >= 16), "{case}");
        for field in ["machine", "server", "date", "command"] {
            assert!(case[field].as_str().is_some_and(|text| !text.is_empty()), "{field} of {case}");
        }
    }
    let png = &case("tree-png-360p")["result"]["rate"];
    assert_eq!((&png["content"], &png["steps"], &png["skipped"]), (&"PNG 160x90".into(), &6.into(), &0.into()));
    let number = |value: &Value| value.as_f64().filter(|number| *number > 0.0).expect("expected a positive number");
    let slowest = &png["stage_rates"][0];
    assert!(
        (number(&png["of_slowest_stage"]) - number(&png["per_second"]) / number(&slowest["per_second"])).abs() < 1e-9
    );
    for stage in ["draw", "shadow", "encode"] {
        number(&png["stages_ms"][0][stage]);
        number(&png["alone_ms"][0][stage]);
    }
    // The rates are those of the stages alone.
    let stage_rates = png["stage_rates"].as_array().expect("expected rates");
    let drawing = stage_rates.iter().find(|rate| rate["stages"].as_str().is_some_and(|stages| stages.contains("draw")));
    let alone_ms = ["deform", "upload", "switch", "shadow", "draw"].map(|stage| png["alone_ms"][0][stage].as_f64());
    let sum_ms: f64 = alone_ms.into_iter().flatten().sum();
    assert!((number(&drawing.expect("expected the device")["ms"]) - sum_ms).abs() < 1e-6 * sum_ms, "{png}");
    // Both are positions of the same vertices: 12 bytes as f32, and about 6 bytes as 16-bit numbers.
    let compact_bytes = number(&case("tree-vertices-compact")["result"]["rate"]["reply_bytes"]);
    let socket = &case("tree-socket")["result"]["socket"];
    let bytes = number(&socket["reply_bytes"]);
    assert!((0.5 * bytes..0.6 * bytes).contains(&compact_bytes), "{compact_bytes} of {bytes}");
    let quotient = number(&socket["stream_per_second"]) / number(&socket["socket_per_second"]);
    assert!((number(&socket["stream_of_socket"]) - quotient).abs() < 1e-9 * quotient, "{socket}");
    for path in ["unix_stream_per_second", "shared_stream_per_second", "shared_request_per_second"] {
        number(&socket[path]);
    }
    let csv = String::from_utf8(read(folder.path(), "report.csv")).expect("expected text");
    let markdown = String::from_utf8(read(folder.path(), "report.md")).expect("expected text");
    for name in cases {
        assert!(csv.contains(&format!("\n{name},")) && markdown.contains(&format!("\n| {name} |")), "{name}");
    }
    assert!(String::from_utf8(read(folder.path(), "report.svg")).expect("expected text").contains("tree-png-360p"));
    assert!(image::load_from_memory(&read(folder.path(), "report.png")).is_ok());
}

#[test]
fn quick_plant_is_simulated_and_drawn_by_both_systems() {
    let folder = tempfile::tempdir().expect("expected a folder");
    let (code, output) = run_report(folder.path(), &["plant-2-png-1080p*"]);
    assert_eq!(code, Some(0), "{output}");
    let report: Value = serde_json::from_slice(&read(folder.path(), "report.json")).expect("expected JSON");
    let cases = report["cases"].as_array().expect("expected cases");
    let names: Vec<&str> = cases.iter().filter_map(|case| case["name"].as_str()).collect();
    assert_eq!(names, ["plant-2-png-1080p", "plant-2-png-1080p-cpu"]);
    for case in cases {
        let plant = &case["result"]["plant"];
        assert_eq!(plant["thesis"]["name"], "Conifer");
        // The conifer has 644 domains, of which 43 have 360 modes. A quick report has a sixteenth of them.
        let counts = ["domains", "deformable", "modes"].map(|name| plant["counts"][name].as_u64());
        assert_eq!(counts, [Some(41), Some(3), Some(23)], "{case}");
        for rate in [&plant["rate"]["per_second"], &plant["recorded_per_second"], &plant["physics_per_second"]] {
            assert!(rate.as_f64().is_some_and(|rate| rate > 0.0 && rate.is_finite()), "{case}");
        }
        assert_eq!((&plant["rate"]["steps"], &plant["rate"]["skipped"]), (&6.into(), &0.into()));
        for stage in ["deform", "shadow", "draw"] {
            assert!(plant["rate"]["alone_ms"][0][stage].as_f64().is_some_and(|ms| ms > 0.0), "{stage} of {case}");
        }
    }
    assert_eq!(cases[1]["result"]["plant"]["backend"], "cpu");
    assert!(cases[1]["server"].as_str().is_some_and(|server| server.starts_with("deforms on cpu")), "{}", cases[1]);
    let markdown = String::from_utf8(read(folder.path(), "report.md")).expect("expected text");
    let row = markdown.lines().find(|line| line.starts_with("| Conifer |")).expect("expected a row of the table");
    assert!(row.contains("| 41 | 3 | 23 |") && row.ends_with("| 1.059, 1.693 | 55, 60 | 0.92 |"), "{row}");
}

#[test]
fn unknown_case_is_an_error_without_files() {
    let folder = tempfile::tempdir().expect("expected a folder");
    let (code, output) = run_report(folder.path(), &["tree-gif"]);
    assert!(code == Some(3) && output.contains("tree-vertices-compact"), "{code:?} {output}");
    assert!(!folder.path().join("report.json").exists());
}
