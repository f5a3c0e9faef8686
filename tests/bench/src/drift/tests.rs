//! Tests with 2,000 steps.

use super::measurement::measure_step;
use super::*;
use modalcast_compute::cpu::CpuDeformer;
use modalcast_model::deform::Deformer as _;
use modalcast_model::scene::{SceneState, StepUpdate};

fn report() -> DriftReport {
    measure(2_000, |_| ()).expect("expected a report")
}

fn case<'a>(report: &'a DriftReport, name: &str) -> &'a DriftResult {
    report.cases.iter().find(|case| case.name == name).expect("expected the case")
}

#[test]
fn only_the_f32_products_of_a_client_drift() {
    let report = report();
    assert_eq!(report.failed, [""; 0]);
    let growing: Vec<_> = report.cases.iter().filter(|case| case.growth > 2.0).map(|case| case.name).collect();
    assert_eq!(growing, ["f32-product", "f32-orthonormal"]);
    let determinant = |name: &str| case(&report, name).largest_errors().determinant;
    // Gram-Schmidt keeps A a rotation up to a few roundings of 6e-8, but not its angle.
    assert!(determinant("f32-orthonormal") < 1e-6 && determinant("f32-product") > 1e-5);
    for name in ["follower-chain", "shared-origin", "own-origin"] {
        // The chain is 13 m long and starts 3 m from the origin. At 16 m, neighboring f32 differ by 1.9e-6.
        let error = case(&report, name).largest_errors().position_meters;
        assert!(error > 0.0 && error < 5e-6, "{name}: {error}");
    }
}

#[test]
fn steps_equal_those_of_a_new_deformer_on_any_path() {
    let report = report();
    for case in &report.cases {
        assert_eq!(case.largest_errors().steps_unlike_new_deformer, 0, "{}", case.name);
        // Only the shared origin depends on earlier steps.
        assert_eq!(case.largest_errors().path_meters > 0.0, case.name == "shared-origin", "{}", case.name);
    }
    // A domain that travels 2 m per step leaves the reach of the shared origin every few steps, and enters another
    // cell of its own grid with a spacing of 2 m in almost every step.
    assert!((200..1_000).contains(&case(&report, "shared-origin").origin_changes));
    assert!((1_800..=2_000).contains(&case(&report, "own-origin").origin_changes));
    assert_eq!(case(&report, "follower-chain").origin_changes, 0);
}

/// The control of the test above: the deformer has not received the last step.
#[test]
fn surface_of_an_older_step_is_unlike_a_new_deformer() {
    let mut case = case::all().remove(0);
    let scene = case.scene().expect("expected a scene");
    let (mut state, mut deformer) = (SceneState::rest(&scene), CpuDeformer::new(&scene));
    for (step, unlike) in [(1, 0), (2, 1)] {
        let pose = case.pose(step, 2);
        let update = StepUpdate::parse(&scene, &case.next_step(step, &pose)).expect("expected a valid step");
        state.apply(&scene, &update);
        if step == 1 {
            deformer.deform(&state).expect("expected a deformation");
        }
        let surface = deformer.surface().expect("expected a surface");
        let errors = measure_step(&scene, &state, &update, surface, &pose).expect("expected errors");
        assert_eq!(errors.steps_unlike_new_deformer, unlike, "step {step}");
        assert_eq!(errors.path_meters > 0.0, unlike == 1, "step {step}");
    }
}

#[test]
fn unmet_expectations_are_failures() {
    let report = report();
    let failures = |change: fn(&mut DriftResult)| {
        let mut changed = case(&report, "follower-chain").clone();
        change(&mut changed);
        changed.failures()
    };
    assert_eq!(failures(|_| ()), [""; 0]);
    let reasons = [
        failures(|case| case.growth = 2.5),
        failures(|case| case.is_control = true),
        failures(|case| case.windows[0].errors.steps_unlike_new_deformer = 1),
        failures(|case| case.windows[1].errors.path_meters = 1e-9),
    ];
    for (failures, reason) in
        reasons.iter().zip(["at most 2, got 2.5", "more than 2", "expected 0, got 1", "got 1e-9 m"])
    {
        assert!(failures.len() == 1 && failures[0].contains(reason), "expected {reason}, got {failures:?}");
    }
}

#[test]
fn report_has_all_cases_windows_and_failures() {
    let folder = tempfile::tempdir().expect("expected a folder");
    let report = DriftReport { failed: vec!["a case: a reason".into()], ..report() };
    report.write(folder.path()).expect("expected files");
    let read = |name: &str| std::fs::read_to_string(folder.path().join(name)).expect("expected a file");
    let json: serde_json::Value = serde_json::from_str(&read("report.json")).expect("JSON");
    assert_eq!((&json["steps"], json["cases"].as_array().map(Vec::len)), (&2_000.into(), Some(7)));
    let last_steps: Vec<_> = report.cases[0].windows.iter().map(|window| window.last_step).collect();
    assert_eq!(last_steps, [1, 10, 100, 1_000, 2_000]);
    assert_eq!(json["cases"][0]["windows"][4]["first_step"], 1_901);
    let markdown = read("report.md");
    assert!(
        markdown.contains("- a case: a reason") && markdown.contains("| own-origin | 1901 to 2000 |"),
        "{markdown}"
    );
}
