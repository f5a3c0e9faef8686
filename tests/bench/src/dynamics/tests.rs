//! Tests of the report with small sizes. They look at errors, never at times.

use std::path::Path;

use nalgebra::DVector;

use super::expectations::{failures, leading_term};
use super::method::{AVERAGE_VECTOR_FIELD, BACKWARD_EULER, Method, System};
use super::oscillators::{ReleasedMode, SINGLE_MODES};
use super::recommendation::recommend;
use super::row::{Label, Measured, rows_of_integrator, set_observed_orders};
use super::run::Motion;
use super::*;
use crate::timing::Timing;
use modalcast_dynamics::Error as DynamicsError;
use modalcast_dynamics::integrator::{Integrator, LoadChange, MotionState, StepReport};
use modalcast_dynamics::oscillator::ModeState;
use modalcast_dynamics::vega::VegaSettings;

/// A row without results.
fn row(case: &'static str, method: Method, dt_seconds: f64, steps: u64) -> IntegrationRow {
    IntegrationRow {
        case,
        system: "a system".into(),
        mode_hertz: None,
        method: method.name(),
        coordinates: 1,
        highest_hertz: 1.0,
        conserves_energy: false,
        dt_seconds,
        steps,
        expectation: Expectation::Candidate,
        errors: None,
        observed_order: None,
        theoretical_order: method.order(),
        timing: None,
        run_us: None,
        work: None,
        failure: None,
    }
}

/// A row with an error and the time of a step.
fn measured_row(case: &'static str, method: Method, per_second: f64, error: f64, step_us: f64) -> IntegrationRow {
    let steps = (4.0 * per_second) as u64;
    IntegrationRow {
        errors: Some(MotionErrors { displacement: error, ..MotionErrors::default() }),
        timing: Some(Timing { median_us: step_us, q1_us: step_us, q3_us: step_us, replays: 1 }),
        run_us: Some(step_us * steps as f64),
        ..row(case, method, per_second.recip(), steps)
    }
}

fn solid_row(solid: &'static str, freedom_limit: usize, error: f64, seconds: f64) -> SolidRow {
    SolidRow {
        solid,
        triangles: 12,
        freedom_limit,
        freedoms: freedom_limit,
        worst_error: Some(error),
        mean_error: Some(error / 2.0),
        estimated_error: None,
        seconds,
        peak_bytes: None,
        failure: None,
    }
}

#[test]
fn modes_have_the_orders_of_the_theory() {
    let rows = oscillators::measure_single_modes(Size::Quick).expect("rows");
    assert_eq!(failures(&rows, &[], &[]), [""; 0]);
    let compared = |method: Method, system: &str| {
        let is_compared = |row: &&IntegrationRow| {
            row.method == method.name()
                && row.system == system
                && row.observed_order.is_some()
                && leading_term(row) <= 0.2
        };
        rows.iter().filter(is_compared).count()
    };
    for system in ["0.001 Hz, undamped", "1 Hz, damping ratio 0.02", "1 kHz, undamped", "1 MHz, damping ratio 0.02"] {
        assert!(compared(AVERAGE_VECTOR_FIELD, system) >= 2, "{system}");
        assert!(compared(BACKWARD_EULER, system) >= 1, "{system}");
    }
    let largest_error = |method: &str| {
        let errors = rows.iter().filter(|row| row.method == method).map(|row| row.errors.expect("errors").displacement);
        errors.fold(0.0, f64::max)
    };
    assert!(largest_error("exact modes") < 1e-10 && largest_error("backward Euler") > 0.5);
}

/// An integrator whose steps are longer than it says.
struct LongSteps(Box<dyn Integrator>);

impl Integrator for LongSteps {
    fn advance(&self, state: &mut MotionState, load: LoadChange<'_>) -> Result<StepReport, DynamicsError> {
        self.0.advance(state, load)
    }

    fn dt(&self) -> f64 {
        self.0.dt() / 1.01
    }
}

/// The rows of the average vector field method at 1 Hz, or of an integrator with steps that are 1 % too long.
fn rows_at_one_hertz(is_wrong: bool) -> Vec<IntegrationRow> {
    let omega = std::f64::consts::TAU;
    let system = System::of_modes(&[omega * omega], VegaSettings::default()).expect("a system");
    let mode = ReleasedMode::new(omega * omega, 0.0);
    let label = Label {
        case: SINGLE_MODES,
        expectation: Expectation::Candidate,
        method: AVERAGE_VECTOR_FIELD,
        system: &system,
    };
    let mut rows = Vec::new();
    for steps_per_sample in [8, 16] {
        let dt = 1.0 / (8 * steps_per_sample) as f64;
        let motion = Motion {
            start: MotionState::resting(DVector::from_element(1, 1.0)),
            load: DVector::zeros(1),
            dt,
            steps_per_sample,
            samples: 16,
        };
        let integrator: Box<dyn Integrator> = match is_wrong {
            true => Box::new(LongSteps(system.create_integrator(label.method, 1.01 * dt).expect("an integrator"))),
            false => system.create_integrator(label.method, dt).expect("an integrator"),
        };
        rows.extend(rows_of_integrator(&label, "1 Hz", &motion, Ok(integrator), |samples| {
            let state = |(index, sample): (usize, &MotionState)| {
                (motion.sample_time(index), ModeState { q: sample.q[0], v: sample.v[0] })
            };
            let states: Vec<_> = samples.iter().enumerate().map(state).collect();
            Measured::of_system("1 Hz", mode.errors(&states))
        }));
    }
    set_observed_orders(&mut rows);
    rows
}

#[test]
fn integrator_with_wrong_steps_is_a_failure() {
    assert_eq!(failures(&rows_at_one_hertz(false), &[], &[]), [""; 0], "control");
    let wrong = failures(&rows_at_one_hertz(true), &[], &[]);
    assert!(wrong.len() == 1 && wrong[0].contains("expected the order 2, got"), "{wrong:?}");
}

/// The stiff system: an energy that is conserved at any step, exact modes, and fast modes that backward Euler damps.
#[test]
fn stiff_modes_are_exact_or_keep_their_energy() {
    let rows = oscillators::measure_stiff_system(Size::Quick).expect("rows");
    assert_eq!(failures(&rows, &[], &[]), [""; 0]);
    let of_method = |method: &str| rows.iter().filter(|row| row.method == method).collect::<Vec<_>>();
    // Ten modes, with and without damping, at two steps.
    assert_eq!(of_method("AVF").len(), 40);
    assert_eq!(of_method("AVF").iter().filter(|row| row.conserves_energy).count(), 20);
    let lost = |row: &&&IntegrationRow| row.mode_hertz >= Some(1e3) && row.errors.expect("errors").energy >= Some(0.99);
    assert_eq!(
        of_method("backward Euler").iter().filter(|row| row.system.ends_with("undamped")).filter(lost).count(),
        8
    );
}

#[test]
fn beam_errors_of_time_and_of_modes_are_apart() {
    let rows = beam::measure(Size::Quick).expect("rows");
    assert_eq!(failures(&rows, &[], &[]), [""; 0]);
    let errors = |method: Method, modes: usize, dt: f64| {
        let is_meant = |row: &&IntegrationRow| {
            row.method == method.name() && row.coordinates == modes && (row.dt_seconds - dt).abs() < 1e-9
        };
        rows.iter().find(is_meant).and_then(|row| row.errors).expect("errors")
    };
    // More modes reduce the truncation error; the exact integrator has no other error.
    for (few, many) in [(1, 2), (2, 5), (5, 10)] {
        let [few, many] = [few, many].map(|modes| errors(Method::Exact, modes, 1.0 / 30.0));
        assert!(many.truncation < few.truncation && many.displacement < 1e-9, "{few:?} {many:?}");
        assert!((many.total.expect("a total") / many.truncation.expect("a truncation") - 1.0).abs() < 1e-3);
    }
    // Shorter steps reduce the error of time, and not that of the modes.
    let [long, short] = [1.0 / 30.0, 1.0 / 960.0].map(|dt| errors(AVERAGE_VECTOR_FIELD, 1, dt));
    assert!(short.displacement < 0.1 * long.displacement && short.truncation == long.truncation, "{long:?} {short:?}");
}

#[test]
fn chain_conserves_energy_and_its_control_fails() {
    let result = cubic::measure_chain(Size::Quick).expect("rows");
    assert_eq!(failures(&result.rows, std::slice::from_ref(&result.reference), &[]), [""; 0]);
    assert!(result.reference.change_by_halving < 1e-8, "{:?}", result.reference);
    let of_method = |method: &str| result.rows.iter().filter(|row| row.method == method).collect::<Vec<_>>();
    let error = |row: &IntegrationRow| row.errors.expect("errors").displacement;
    for row in of_method("AVF") {
        assert!(row.conserves_energy && row.errors.expect("errors").energy < Some(1e-10), "{row:?}");
    }
    assert!(of_method("backward Euler").iter().all(|row| row.errors.expect("errors").energy > Some(0.01)));
    let [control] = of_method("exact modes")[..] else { panic!("expected one control") };
    let smallest = of_method("AVF").into_iter().map(error).fold(f64::INFINITY, f64::min);
    assert!(error(control) > 0.1 && error(control) > 10.0 * smallest, "{control:?} {smallest}");
    // A tighter tolerance reduces the error.
    let adaptive: Vec<f64> = ["1e-3", "1e-4", "1e-5"]
        .iter()
        .map(|tolerance| error(of_method(&format!("AVF, tolerance {tolerance}"))[0]))
        .collect();
    assert!(adaptive[1] < 0.5 * adaptive[0] && adaptive[2] < 0.5 * adaptive[1], "{adaptive:?}");
}

#[test]
fn unmet_expectations_are_named() {
    let good = IntegrationRow { observed_order: Some(2.05), ..measured_row("a", AVERAGE_VECTOR_FIELD, 1e3, 1e-4, 1.0) };
    let with_errors = |errors| IntegrationRow { errors: Some(errors), ..good.clone() };
    let failed = IntegrationRow { errors: None, failure: Some("no solution".into()), ..good.clone() };
    let control = IntegrationRow { expectation: Expectation::LargeError, ..good.clone() };
    let energy = MotionErrors { energy: Some(1e-3), ..MotionErrors::default() };
    let inexact = measured_row("a", Method::Exact, 1e3, 1e-4, 1.0);
    for (row, reason) in [
        (IntegrationRow { observed_order: Some(1.5), ..good.clone() }, "expected the order 2, got 1.50"),
        (IntegrationRow { conserves_energy: true, ..with_errors(energy) }, "expected an energy within 1e-9"),
        (with_errors(MotionErrors { displacement: f64::NAN, ..MotionErrors::default() }), "finite displacement"),
        (control, "expected an error of at least 0.1"),
        (inexact, "expected an error of at most 1e-6"),
        (failed.clone(), "no solution"),
        (IntegrationRow { errors: None, ..good.clone() }, "expected errors, got none"),
        (IntegrationRow { expectation: Expectation::Failure, ..good.clone() }, "expected an error, got a motion"),
    ] {
        let reasons = failures(&[row], &[], &[]);
        assert!(reasons.len() == 1 && reasons[0].contains(reason), "expected {reason}, got {reasons:?}");
    }
    let expected_failure = IntegrationRow { expectation: Expectation::Failure, ..failed };
    assert_eq!(failures(&[good, expected_failure], &[], &[]), [""; 0]);
    let reference = |change_by_halving| ReferenceSummary {
        case: "chain",
        system: "a chain".into(),
        dt_seconds: 1e-3,
        change_by_halving,
    };
    let references = failures(&[], &[reference(1e-9), reference(1e-3), reference(f64::NAN)], &[]);
    assert_eq!(references.len(), 2, "{references:?}");
    // Only the largest number of freedoms has a limit of the error.
    let solids = failures(&[], &[], &[solid_row("box", 3_000, 0.02, 1.0), solid_row("box", 6_000, 0.006, 2.0)]);
    assert!(solids.len() == 1 && solids[0].contains("box with 6000 freedoms"), "{solids:?}");
}

#[test]
fn recommends_the_fastest_setting_within_each_limit() {
    let case = cubic::CHAIN;
    let control = measured_row(case, Method::Exact, 60.0, 1e-8, 0.1);
    let rows = [
        measured_row(case, AVERAGE_VECTOR_FIELD, 60.0, 5e-3, 10.0),
        measured_row(case, AVERAGE_VECTOR_FIELD, 480.0, 8e-5, 10.0),
        // Slower than the first row at a larger error, and faster with an error above all limits.
        measured_row(case, BACKWARD_EULER, 960.0, 9e-3, 10.0),
        measured_row(case, BACKWARD_EULER, 15.0, 0.5, 10.0),
        measured_row(case, BACKWARD_EULER, 30.0, f64::NAN, 10.0),
        IntegrationRow { expectation: Expectation::LargeError, ..control },
        IntegrationRow { failure: Some("no solution".into()), errors: None, ..row(case, BACKWARD_EULER, 0.1, 40) },
    ];
    let solids = [
        solid_row("box", 3_000, 2e-3, 1.0),
        solid_row("sphere", 3_000, 8e-3, 2.0),
        solid_row("box", 25_000, 2e-4, 6.0),
        solid_row("sphere", 25_000, 1e-4, 7.0),
    ];
    let recommendations = recommend(&rows, &solids);
    let summary: Vec<(f64, &str, f64)> =
        recommendations.iter().map(|item| (item.limit, item.setting.as_str(), item.milliseconds)).collect();
    let expected = [
        (1e-4, "AVF, steps of 1/480 s", 4.8),
        (1e-2, "AVF, steps of 1/60 s", 0.6),
        (1e-3, "--freedoms 25000", 7e3),
        (1e-2, "--freedoms 3000", 2e3),
    ];
    assert_eq!(summary.len(), expected.len(), "{summary:?}");
    for (given, expected) in summary.iter().zip(expected) {
        let is_equal =
            given.1 == expected.1 && (given.0 / expected.0 - 1.0).abs() + (given.2 / expected.2 - 1.0).abs() < 1e-9;
        assert!(is_equal, "expected {expected:?}, got {given:?}");
    }
    assert!(recommend(&[], &[]).is_empty());
}

/// A setting of linear modes counts with its largest error of all frequencies.
#[test]
fn modes_are_recommended_by_their_worst_frequency() {
    let mode = |steps_per_period: u64, error: f64| IntegrationRow {
        steps: steps_per_period * oscillators::PERIODS,
        ..measured_row(SINGLE_MODES, AVERAGE_VECTOR_FIELD, 10.0, error, 1.0)
    };
    let recommendations = recommend(&[mode(8, 2e-4), mode(16, 1e-4), mode(8, 6e-3)], &[]);
    let summary: Vec<(f64, &str)> = recommendations.iter().map(|item| (item.error, item.setting.as_str())).collect();
    assert_eq!(summary, [(1e-4, "AVF, 16 steps per period"), (6e-3, "AVF, 8 steps per period")]);
}

#[test]
fn extreme_rows_have_an_error_or_state_why_not() {
    let (rows, references) = extremes::measure().expect("rows");
    assert_eq!(failures(&rows, &references, &[]), [""; 0]);
    for row in &rows {
        assert_eq!(row.errors.is_some(), row.failure.is_none(), "{row:?}");
    }
    let failure = |system: &str, method: &str| {
        let row = rows.iter().find(|row| row.system.starts_with(system) && row.method == method).expect("a row");
        row.failure.clone().expect("a failure")
    };
    assert!(
        failure("negative eigenvalue", "exact modes").contains("eigenvalue: expected a finite number >= 0, got -39")
    );
    assert!(failure("softening", "AVF").contains("64 sub-steps"));
    let steps: Vec<f64> = rows.iter().map(|row| row.dt_seconds).collect();
    assert!(steps.contains(&1e-9) && steps.contains(&10.0), "{steps:?}");
}

/// The control of the references: frequencies of another solid.
#[test]
fn frequencies_of_a_wrong_reference_are_a_failure() {
    let solids = solid_modes::all(Size::Quick);
    let row = solids[0].measure(1_000);
    assert!(row.worst_error.is_some_and(|error| error < 0.05) && row.freedoms <= 1_000, "{row:?}");
    let wrong = solids[0].with_frequencies_of(&solids[1]).measure(1_000);
    let reasons = failures(&[], &[], &[wrong]);
    assert!(reasons.len() == 1 && reasons[0].contains("expected frequencies within 0.005"), "{reasons:?}");
}

#[test]
fn missing_bridge_is_a_remark_or_a_failure() {
    let mut report = DynamicsReport::new(&CASES);
    let measure = |report: &mut DynamicsReport, scenes: Option<&Path>| {
        let options = DynamicsReportOptions { scenes: scenes.map(Into::into), cases: vec![], size: Size::Quick };
        report.measure_case(cubic::BRIDGE, &options)
    };
    measure(&mut report, None).expect("a skipped case");
    assert!(report.rows.is_empty() && report.remarks[0].starts_with("bridge: skipped"), "{:?}", report.remarks);
    assert!(!report.missing.contains(&"bridge") && report.missing.contains(&"chain"));
    let folder = tempfile::tempdir().expect("a folder");
    let error = measure(&mut report, Some(folder.path())).expect_err("no bridge").to_string();
    assert!(error.contains("simpleBridge.cub"), "{error}");
}

#[test]
fn files_are_complete_and_parse() {
    let mut report = DynamicsReport::new(&CASES);
    report.rows = rows_at_one_hertz(false);
    report.rows.push(measured_row(cubic::CHAIN, AVERAGE_VECTOR_FIELD, 60.0, 1e-3, 10.0));
    report.rows.extend([10.0, 20.0].map(|per_second| measured_row(beam::CASE, Method::Exact, per_second, 1e-3, 2.0)));
    report.solids = vec![solid_row("box", 3_000, 1e-3, 1.0)];
    report.plants = vec![plant_row(100, 200.0), plant_row(1_000, 3_000.0)];
    report.recommendations = recommend(&report.rows, &report.solids);
    report.failed = vec!["a case: a reason".into()];
    let folder = tempfile::tempdir().expect("a folder");
    report.write(folder.path()).expect("files");
    let read = |name: &str| std::fs::read(folder.path().join(name)).expect("a file");
    let json: serde_json::Value = serde_json::from_slice(&read("report.json")).expect("JSON");
    assert_eq!(json["rows"].as_array().map(Vec::len), Some(5));
    assert!(json["rows"][1]["observed_order"].as_f64().is_some_and(|order| (order - 2.0).abs() < 0.1), "{json}");
    for (name, count) in [("report.csv", 5), ("solids.csv", 1), ("plants.csv", 2)] {
        let bytes = read(name);
        let mut reader = csv::Reader::from_reader(bytes.as_slice());
        assert_eq!(reader.records().filter(Result::is_ok).count(), count, "{name}");
    }
    let markdown = String::from_utf8(read("report.md")).expect("UTF-8");
    for text in [
        "- a case: a reason",
        "| chain with cubic forces | 1e-3 | AVF, steps of 1/60 s |",
        "Not measured yet: ",
        PLANT_LINE,
    ] {
        assert!(markdown.contains(text), "expected {text} in {markdown}");
    }
    let svg = String::from_utf8(read("report.svg")).expect("UTF-8");
    assert!(svg.contains("chain of Duffing oscillators: by time") && svg.contains("modes of solids"));
    assert!(image::load_from_memory(&read("report.png")).expect("a PNG").width() > 1000);
}

/// Every pointer of the tables exists in a complete row.
#[test]
fn every_column_has_a_value() {
    let rows = rows_at_one_hertz(false);
    let value = serde_json::to_value(&rows[1]).expect("JSON");
    for (name, pointer) in output::COLUMNS {
        assert!(value.pointer(pointer).is_some(), "{name}");
    }
    let value = serde_json::to_value(solid_row("box", 1, 1.0, 1.0)).expect("JSON");
    for (name, pointer) in output::SOLID_COLUMNS {
        assert!(value.pointer(pointer).is_some(), "{name}");
    }
    let value = serde_json::to_value(plant_row(100, 1.0)).expect("JSON");
    for (name, pointer) in output::PLANT_COLUMNS {
        assert!(value.pointer(pointer).is_some(), "{name}");
    }
}

/// A plant whose step takes the given time of all threads.
fn plant_row(domains: usize, step_cpu_us: f64) -> PlantRow {
    let plant = format!("generated, {domains} domains");
    let (coordinates, steps) = (4 * domains, 100);
    PlantRow { plant, domains, coordinates, steps, step_us: 0.5 * step_cpu_us, step_cpu_us, load_average: Some(0.5) }
}

/// The line of the second plant of the tables.
const PLANT_LINE: &str = "| generated, 1000 domains | 1000 | 4000 | 1500 | 3000 | 3.00 | 1.50 | 667 | 0.50 |";

/// All domains of a generated plant act on each other and move in the wind.
#[test]
fn generated_plants_have_modes_and_sway() {
    let model = plants::generated_plant(40).expect("a plant");
    assert_eq!(model.domains.len(), 40);
    let ranks: Vec<usize> = model.domains.iter().map(|domain| domain.rank).collect();
    assert_eq!((ranks[0], ranks.iter().filter(|rank| **rank == 3).count()), (12, 36), "{ranks:?}");
    assert_eq!(model.domains.iter().filter(|domain| domain.joint.is_none()).count(), 1);
    assert!(model.domains.iter().all(|domain| domain.inertia.is_some()));
    let row = plants::measure_plant("small", model).expect("a measurement");
    assert!(row.domains == 40 && row.step_us > 0.0 && row.step_cpu_us > 0.0, "{row:?}");
}

#[test]
#[ignore = "needs the real inputs: MODALCAST_DATA or ../shared/data"]
fn real_bridge_agrees_with_its_reference() {
    let default_folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../../shared/data");
    let folder = std::env::var_os("MODALCAST_DATA").map_or_else(|| default_folder.into(), std::path::PathBuf::from);
    let result = cubic::measure_bridge(&folder, Size::Quick).expect("a bridge");
    assert_eq!(failures(&result.rows, &[result.reference], &[]), [""; 0]);
}
