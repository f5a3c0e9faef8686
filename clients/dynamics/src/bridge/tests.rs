use super::*;
use crate::cubic::tests::{data_folder, spring_chain};
use crate::divergence::DivergenceCheck;
use crate::error::Error;
use crate::hierarchy::tests::four_domain_model;
use crate::model::Sample;

const OPTIONS: BridgeOptions = BridgeOptions {
    domain: 0,
    dt: 1.0 / 60.0,
    deflection_fraction: 0.03,
    period: 2.0,
    load_direction: LoadDirection::Across,
    method: ImplicitMethod::AverageVectorField,
    has_fixed_step: false,
};

/// A bridge whose force has rank 2, as the domains of the model. The force consists of two springs with the
/// eigenvalues 40 and 90 (rad/s)^2, coupled by a quartic (30) and a cubic (4) potential.
fn two_mode_bridge() -> BridgeScenario {
    let force = spring_chain(&[40.0, 90.0], 30.0, 4.0);
    BridgeScenario::new(four_domain_model(), force, &VegaSettings::default(), OPTIONS).expect("a valid scenario")
}

#[test]
fn run_starts_at_the_requested_deflection_and_moves() {
    let mut bridge = two_mode_bridge();
    let deflection = bridge.static_deflection_fraction;
    assert!((deflection - 0.03).abs() <= 1e-6, "expected 0.03, got {deflection}");
    let (mut first_values, mut last_values) = (StepValues::default(), StepValues::default());
    bridge.compute_next_step(&mut first_values).expect("the first step");
    // The first step is the equilibrium. Its coordinates are rounded to f32.
    assert!(bridge.peak_displacement / bridge.model.diagonal() >= 0.0299);
    (0..40).for_each(|_| bridge.compute_next_step(&mut last_values).expect("the next step"));
    assert_ne!(first_values.q, last_values.q);
    // The domains that are attached to the bridge follow it.
    assert_eq!(first_values.transforms[0], last_values.transforms[0]);
    assert!((1..4).all(|domain| first_values.transforms[domain] != last_values.transforms[domain]));
    assert!(bridge.peak_displacement / bridge.model.diagonal() < 0.2);
}

/// A bridge that softens: the potential a (q_0 - q_1)^4 with a < 0 has no minimum far from rest.
fn softening_bridge(deflection_fraction: f64) -> Result<BridgeScenario> {
    let options = BridgeOptions { deflection_fraction, ..OPTIONS };
    let force = spring_chain(&[40.0, 90.0], -30.0, 0.0);
    BridgeScenario::new(four_domain_model(), force, &VegaSettings::default(), options)
}

#[test]
fn deflection_without_stable_equilibrium_is_rejected() {
    let error = softening_bridge(0.5).err().expect("an error").to_string();
    assert!(error.contains("stable equilibrium") && error.contains("softens"), "{error}");
    // Negative control: the bridge withstands a small load.
    let bridge = softening_bridge(0.03).expect("a valid scenario");
    assert!((bridge.static_deflection_fraction - 0.03).abs() <= 1e-4);
}

/// A push beyond the potential barrier accelerates the softening bridge to infinity in a finite time, in which the
/// last step has no solution.
#[test]
fn diverging_softening_bridge_is_reported_as_error() {
    let mut bridge = softening_bridge(0.03).expect("a valid scenario");
    let check = DivergenceCheck::new(&bridge.model);
    // A load without the limit on viewers.
    bridge.viewer_load[0] = 500.0;
    let mut values = StepValues::default();
    let mut steps = (0..600).map(|step| {
        bridge.compute_next_step(&mut values)?;
        check.check(&bridge.model, step, 0.0, &values)
    });
    let error = steps.find_map(Result::err).expect("expected the bridge to diverge").to_string();
    assert!(error.contains("with 64 sub-steps"), "{error}");
}

#[test]
fn remarks_name_unresolved_load_and_missing_damping() {
    let remarks = |dt: f64, period: f64, damping_stiffness: f64| {
        let options = BridgeOptions { dt, period, ..OPTIONS };
        let force = spring_chain(&[40.0, 90.0], 30.0, 4.0);
        let settings = VegaSettings { damping_stiffness, ..VegaSettings::default() };
        let bridge = BridgeScenario::new(four_domain_model(), force, &settings, options);
        bridge.expect("a valid scenario").remarks()
    };
    // With one step per period, the load is the same in all steps.
    let unresolved = remarks(2.0, 2.0, 0.01);
    assert!(unresolved.len() == 2 && unresolved[0].contains("the load has a period of 2 s"), "{unresolved:?}");
    // The modes at rest have 1.0 and 1.5 Hz, and those of the other domains 0.9 Hz.
    assert!(unresolved[1].contains("not seen as vibrations (6; "), "{unresolved:?}");
    let undamped = remarks(1.0 / 60.0, 2.0, 0.0);
    assert!(undamped.len() == 1 && undamped[0].starts_with("the bridge has no damping"), "{undamped:?}");
    assert_eq!(remarks(1.0 / 60.0, 2.0, 0.01), [""; 0]);
}

/// A body without a load of its own, which a viewer pulls and releases.
#[test]
fn body_without_load_moves_by_viewers_and_decays_by_its_damping_ratio() {
    let swing = |damping_ratio: &str| {
        let mut model = four_domain_model();
        model.domains[0].notes.insert("damping_ratio".into(), damping_ratio.into());
        let options = BridgeOptions { deflection_fraction: 0.0, ..OPTIONS };
        let force = spring_chain(&[40.0, 90.0], 30.0, 4.0);
        let body = BridgeScenario::new(model, force, &VegaSettings::default(), options);
        let (mut body, mut values) = (body.expect("a valid scenario"), StepValues::default());
        body.compute_next_step(&mut values).expect("the first step");
        assert_eq!(values.q, [0.0; 6], "expected no motion without forces");
        body.set_viewer_forces(&DomainLoads::of_coordinates(body.model(), &[5.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
            .expect("a scenario with forces");
        (0..20).for_each(|_| body.compute_next_step(&mut values).expect("the next step"));
        assert!(values.q[0] > 1e-2, "{:?}", values.q);
        body.set_viewer_forces(&DomainLoads::of_coordinates(body.model(), &[0.0; 6])).expect("a scenario with forces");
        body.compute_next_step(&mut values).expect("the next step");
        let start = body.integrator.system().energy(&body.state);
        (0..300).for_each(|_| body.compute_next_step(&mut values).expect("the next step"));
        (body.integrator.system().energy(&body.state) / start, body.remarks())
    };
    let (kept, undamped_remarks) = swing("0");
    assert!((kept - 1.0).abs() <= 1e-6 && undamped_remarks.iter().any(|text| text.contains("no damping")), "{kept}");
    let (decayed, remarks) = swing("0.05");
    // exp(-2 * 0.05 * 6.3 rad/s * 5 s) = 0.04.
    assert!((0.005..0.2).contains(&decayed) && remarks.is_empty(), "{decayed} {remarks:?}");
}

#[test]
fn coordinate_beyond_its_safe_range_is_one_remark() {
    let remarks = |limits: &str| {
        let mut model = four_domain_model();
        model.domains[0].notes.insert(SAFE_COORDINATES_NOTE.into(), limits.into());
        let force = spring_chain(&[40.0, 90.0], 30.0, 4.0);
        let settings = VegaSettings { damping_stiffness: 0.01, ..VegaSettings::default() };
        let mut bridge = BridgeScenario::new(model, force, &settings, OPTIONS)?;
        let start = bridge.state.q.clone();
        let mut values = StepValues::default();
        (0..100).for_each(|_| bridge.compute_next_step(&mut values).expect("the next step"));
        Ok::<_, Error>((bridge.late_remarks().to_vec(), start))
    };
    let (none, start) = remarks("1e3 1e3").expect("valid limits");
    assert_eq!(none, [""; 0]);
    let (beyond, _) = remarks(&format!("1e3 {:e}", 0.5 * start[1].abs())).expect("valid limits");
    assert!(beyond.len() == 1 && beyond[0].contains("q[1]") && beyond[0].contains("loses its stiffness"), "{beyond:?}");
    for invalid in ["-1", "", "x 1", "1 1 1", "nan"] {
        let error = remarks(invalid).expect_err("an invalid note").to_string();
        assert!(error.contains("modes.safe_coordinates of 'beam'"), "{invalid}: {error}");
    }
}

#[test]
fn viewer_forces_change_the_motion() {
    let run = |forces: Option<[f64; 6]>| {
        let (mut bridge, mut values) = (two_mode_bridge(), StepValues::default());
        for _ in 0..20 {
            if let Some(forces) = &forces {
                let loads = DomainLoads::of_coordinates(bridge.model(), forces);
                bridge.set_viewer_forces(&loads).expect("a scenario with forces");
            }
            bridge.compute_next_step(&mut values).expect("the next step");
        }
        values.q
    };
    let free_q = run(None);
    assert_eq!(run(Some([0.0; 6])), free_q);
    // The bridge has the first two coordinates, and the other domains have linear modes.
    let pulled_q = run(Some([0.0, 0.0, 1.0, 1.0, 1.0, 1.0]));
    assert_eq!(pulled_q[..2], free_q[..2], "expected no effect on the bridge");
    assert!(free_q[2..] == [0.0; 4] && pulled_q[2..].iter().all(|q| *q > 1e-4), "{pulled_q:?}");
    let pushed_q = run(Some([5.0, 0.0, 0.0, 0.0, 0.0, 0.0]));
    assert!(pushed_q[0] > free_q[0] + 1e-3, "pushed {pushed_q:?}, free {free_q:?}");
}

/// The largest forces that the server passes on, from 32 viewers.
#[test]
fn enormous_viewer_forces_do_not_end_the_run() {
    let (mut bridge, mut values) = (two_mode_bridge(), StepValues::default());
    let check = DivergenceCheck::new(&bridge.model);
    let loads = |force: f64| DomainLoads::of_coordinates(&four_domain_model(), &[force; 6]);
    bridge.set_viewer_forces(&loads(32.0 * f64::from(f32::MAX))).expect("a scenario with forces");
    assert!(bridge.viewer_load.norm() > 0.0, "expected an effect");
    bridge.set_viewer_forces(&loads(1e30)).expect("a scenario with forces");
    let remarks = bridge.late_remarks();
    assert!(remarks.len() == 1 && remarks[0].contains("scaled to 0.25"), "{remarks:?}");
    for step in 0..600 {
        bridge.compute_next_step(&mut values).expect("the next step");
        check.check(&bridge.model, step, 0.0, &values).expect("a bounded motion");
    }
}

/// A body whose forces were checked for large displacements follows stronger pulls.
#[test]
fn checked_body_is_pulled_further() {
    let load = |is_checked: bool| {
        let mut model = four_domain_model();
        if is_checked {
            model.domains[0].notes.insert(SAFE_COORDINATES_NOTE.into(), "1".into());
        }
        let force = spring_chain(&[40.0, 90.0], 30.0, 4.0);
        let body = BridgeScenario::new(model, force, &VegaSettings::default(), OPTIONS);
        let mut body = body.expect("a valid scenario");
        body.set_viewer_forces(&DomainLoads::of_coordinates(body.model(), &[1e6, 0.0, 0.0, 0.0, 0.0, 0.0]))
            .expect("a scenario with forces");
        (body.viewer_load.norm(), body.late_remarks().concat())
    };
    let ((usual, remark), (checked, checked_remark)) = (load(false), load(true));
    assert!(
        remark.ends_with("scaled to 0.25") && checked_remark.ends_with("scaled to 0.5"),
        "{remark} {checked_remark}"
    );
    assert!((checked / usual - 2.0).abs() <= 1e-9, "{checked} and {usual}");
}

/// Very short steps, and steps that are longer than all periods.
#[test]
fn extreme_steps_run_and_invalid_ones_are_rejected() {
    let create = |options: BridgeOptions| {
        let force = spring_chain(&[40.0, 90.0], 30.0, 4.0);
        BridgeScenario::new(four_domain_model(), force, &VegaSettings::default(), options)
    };
    for dt in [1e-9, 10.0] {
        let mut bridge = create(BridgeOptions { dt, ..OPTIONS }).expect("a valid scenario");
        let (mut values, check) = (StepValues::default(), DivergenceCheck::new(&bridge.model));
        for step in 0..50 {
            bridge.compute_next_step(&mut values).expect("a step");
            check.check(&bridge.model, step, 0.0, &values).expect("a bounded motion");
        }
        assert!(bridge.remarks().iter().any(|remark| remark.contains("Nyquist")) == (dt == 10.0));
    }
    for (options, field) in [
        (BridgeOptions { dt: f64::NAN, ..OPTIONS }, "dt"),
        (BridgeOptions { dt: 0.0, ..OPTIONS }, "dt"),
        (BridgeOptions { deflection_fraction: f64::NAN, ..OPTIONS }, "deflection"),
        (BridgeOptions { period: f64::INFINITY, ..OPTIONS }, "period"),
    ] {
        let error = create(options).err().expect("an error").to_string();
        assert!(error.starts_with(field), "{error}");
    }
}

/// A buckled bridge starts at rest. A load that is limited by the linear stiffness keeps it in range.
#[test]
fn forces_with_eigenvalues_that_are_not_positive_run() {
    for eigenvalues in [[-4.0, 90.0], [0.0, 90.0]] {
        let force = spring_chain(&eigenvalues, 30.0, 0.0);
        let bridge = BridgeScenario::new(four_domain_model(), force, &VegaSettings::default(), OPTIONS);
        let (mut bridge, mut values) = (bridge.expect("a valid scenario"), StepValues::default());
        let check = DivergenceCheck::new(&bridge.model);
        let remarks = bridge.remarks();
        assert!(remarks.iter().any(|remark| remark.contains("the stiffness at rest has")), "{remarks:?}");
        let mut largest = 0.0_f32;
        for step in 0..600 {
            bridge.compute_next_step(&mut values).expect("the next step");
            check.check(&bridge.model, step, 0.0, &values).expect("a bounded motion");
            largest = largest.max(values.q[1].abs());
        }
        assert!(largest > 1e-3, "{eigenvalues:?}: expected motion, got {largest}");
    }
}

#[test]
fn only_the_given_domain_moves() {
    let options = BridgeOptions { domain: 1, ..OPTIONS };
    let force = spring_chain(&[40.0, 90.0], 30.0, 4.0);
    let bridge = BridgeScenario::new(four_domain_model(), force, &VegaSettings::default(), options);
    let mut values = StepValues::default();
    bridge.expect("a valid scenario").compute_next_step(&mut values).expect("the first step");
    assert!(values.q[..2] == [0.0; 2] && values.q[2..4] != [0.0; 2] && values.q[4..] == [0.0; 2], "{:?}", values.q);
}

#[test]
fn domain_that_does_not_fit_the_force_is_rejected() {
    let mut model = four_domain_model();
    model.domains[1].owns_q = false;
    let error = |rank: usize, domain: usize| {
        let force = spring_chain(&vec![2.0; rank], 0.0, 0.0);
        let options = BridgeOptions { domain, ..OPTIONS };
        let result = BridgeScenario::new(model.clone(), force, &VegaSettings::default(), options);
        result.err().expect("an error").to_string()
    };
    assert!(error(3, 0).contains("rank 3") && error(3, 0).contains("'beam' of rank 2"), "{}", error(3, 0));
    assert!(error(2, 1).contains("coordinates of its own"), "{}", error(2, 1));
    assert!(error(2, 4).contains("an index below 4"), "{}", error(2, 4));
}

/// The model of Vega's bridge, with every vertex as a sample.
fn real_bridge_model() -> Model {
    let folder = data_folder().join("vega/simpleBridge");
    let text = std::fs::read_to_string(folder.join("simpleBridge.obj")).expect("an OBJ file");
    let rest_positions: Vec<Vector3<f64>> = text
        .lines()
        .filter_map(|line| line.strip_prefix("v "))
        .map(|line| {
            Vector3::from_iterator(line.split_whitespace().map(|number| number.parse().expect("a number")).take(3))
        })
        .collect();
    // U is in column-major order after its numbers of rows and columns.
    let file = std::fs::read(folder.join("simpleBridge.URendering.float")).expect("a file of U");
    let (words, _) = file.as_chunks::<4>();
    let size = |index: usize| i32::from_le_bytes(words[index]) as usize;
    let (rows, rank) = (size(0), size(1));
    assert_eq!(rows, 3 * rest_positions.len());
    let entry = |row: usize, mode: usize| f64::from(f32::from_le_bytes(words[2 + mode * rows + row]));
    let sample = |(vertex, rest_position): (usize, &Vector3<f64>)| Sample {
        rest_position: *rest_position,
        mode_rows: (0..3 * rank).map(|index| entry(3 * vertex + index / rank, index % rank)).collect(),
        part: 0,
    };
    let mut model = four_domain_model();
    model.domains.truncate(1);
    let domain = &mut model.domains[0];
    domain.samples = rest_positions.iter().enumerate().map(sample).collect();
    (domain.rank, domain.surface_sample_count, domain.base_sample) = (rank, rest_positions.len(), None);
    model.coordinate_count = rank;
    model.bounds_min = rest_positions.iter().fold(rest_positions[0], |min, position| min.inf(position));
    model.bounds_max = rest_positions.iter().fold(rest_positions[0], |max, position| max.sup(position));
    model
}

/// The scenario of Vega's bridge at a deflection of half its span, with the damping of its file.
fn real_bridge(dt: f64, has_fixed_step: bool) -> BridgeScenario {
    let path = data_folder().join("vega/simpleBridge/simpleBridge.config");
    real_bridge_with(&VegaSettings::read(&path).expect("a readable file"), dt, has_fixed_step)
}

fn real_bridge_with(settings: &VegaSettings, dt: f64, has_fixed_step: bool) -> BridgeScenario {
    let path = data_folder().join("vega/simpleBridge/simpleBridge.cub");
    let force = ReducedForce::read(&path).expect("a readable file");
    let model = real_bridge_model();
    let span = (model.bounds_max - model.bounds_min).dot(&model.ground_axes().long_axis);
    let deflection_fraction = 0.5 * span / model.diagonal();
    let options = BridgeOptions { dt, deflection_fraction, has_fixed_step, ..OPTIONS };
    BridgeScenario::new(model, force, settings, options).expect("a valid scenario")
}

/// The coordinates at each of `count` steps of 1/60 s, each divided into `division` steps of the scenario.
fn coordinates(bridge: &mut BridgeScenario, count: u32, division: u32) -> Vec<DVector<f64>> {
    let step = |_| {
        (0..division).for_each(|_| bridge.advance().expect("a step"));
        bridge.state.q.clone()
    };
    (0..count).map(step).collect()
}

/// The largest error of a mode at any step, relative to the largest value of this mode.
fn worst_mode_error(coordinates: &[DVector<f64>], reference: &[DVector<f64>]) -> f64 {
    let error = |mode: usize| {
        let largest = reference.iter().map(|q| q[mode].abs()).fold(0.0, f64::max);
        let difference = coordinates.iter().zip(reference).map(|(a, b)| (a[mode] - b[mode]).abs());
        difference.fold(0.0, f64::max) / largest
    };
    (0..reference[0].len()).map(error).fold(0.0, f64::max)
}

#[test]
#[ignore = "needs the real inputs: MODALCAST_DATA or ../shared/data"]
fn real_bridge_at_half_its_span_is_accurate_by_default() {
    const STEPS: u32 = 120;
    // 128 steps of second order per step of the test: an error of 5e-5.
    let reference = coordinates(&mut real_bridge(1.0 / 60.0 / 128.0, true), STEPS, 128);
    let error = |has_fixed_step: bool| {
        let mut bridge = real_bridge(1.0 / 60.0, has_fixed_step);
        let start = std::time::Instant::now();
        let q = coordinates(&mut bridge, STEPS, 1);
        let milliseconds = 1e3 * start.elapsed().as_secs_f64() / f64::from(STEPS);
        let error = worst_mode_error(&q, &reference);
        println!("fixed step {has_fixed_step}: {error:.2e}, {milliseconds:.2} ms per step, {:?}", bridge.totals);
        assert!(bridge.totals.max_residual <= 1e-11, "{:?}", bridge.totals);
        error
    };
    assert!(error(false) <= 0.02);
    assert!(error(true) > 0.2, "control: expected a large error with one step per step sent");
}

/// Released from half its span, without load and damping.
#[test]
#[ignore = "needs the real inputs: MODALCAST_DATA or ../shared/data"]
fn real_bridge_keeps_its_energy_in_large_motion() {
    let settings = VegaSettings { base_frequency: 0.25, ..VegaSettings::default() };
    for (method, dt, is_kept) in [
        (ImplicitMethod::AverageVectorField, 1.0 / 60.0, true),
        (ImplicitMethod::AverageVectorField, 0.5, true),
        (ImplicitMethod::BackwardEuler, 1.0 / 60.0, false),
    ] {
        let bridge = real_bridge_with(&settings, dt, true);
        let system = bridge.integrator.system().clone();
        let integrator = ImplicitIntegrator::new(system, method, StepControl::Fixed, dt).expect("a valid step");
        let (mut state, no_load) = (bridge.state, DVector::zeros(20));
        let start = integrator.system().energy(&state);
        for _ in 0..600 {
            integrator.advance(&mut state, LoadChange { start: &no_load, end: &no_load }).expect("a step");
        }
        let change = (integrator.system().energy(&state) / start - 1.0).abs();
        println!("{method:?}, dt {dt}: the energy changes by {change:.1e}");
        assert_eq!(change <= 1e-10, is_kept, "{method:?}, dt {dt}: {change}");
    }
}
