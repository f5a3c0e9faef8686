use super::*;
use crate::hierarchy::tests::four_domain_model;

const OPTIONS: TreeOptions =
    TreeOptions { dt: 1.0 / 60.0, sway_fraction: 0.05, wind_strength: 1.0, direction_radians: 0.4, seed: 7 };

/// Runs some steps of the four-domain model. Returns the scenario with the values of every step.
fn run_tree(options: TreeOptions, steps: u64) -> (TreeScenario, Vec<StepValues>) {
    let mut tree = TreeScenario::new(four_domain_model(), options).expect("a valid scenario");
    let compute_step = |_| {
        let mut values = StepValues::default();
        tree.compute_next_step(&mut values).expect("finite coordinates");
        values
    };
    let steps = (0..steps).map(compute_step).collect();
    (tree, steps)
}

#[test]
fn crown_sways_as_calibrated_and_joints_stay_closed() {
    for (dt, steps, expected) in [
        (1.0 / 60.0, 90, 0.03..=0.052),
        (1.0 / 60.0, 1800, 0.045..=0.055),
        (0.05, 601, 0.049..=0.052),
        (0.5, 60, 0.01..=0.06),
    ] {
        let (tree, values) = run_tree(TreeOptions { dt, ..OPTIONS }, steps);
        // The wind is calibrated so that the sway, a fraction of the height, reaches 0.05 within 30 s that are simulated
        // with dt = 0.05 s. Shorter runs and other values of dt can differ.
        let peaks = tree.peaks();
        assert!(expected.contains(&peaks.sway), "dt {dt}, {steps} steps: {peaks:?}");
        assert!(peaks.gap <= 1e-3 * tree.model.diagonal(), "{peaks:?}");
        assert!(values[0].q.iter().all(|coordinate| *coordinate == 0.0));
        assert_eq!(values[9].transforms.len(), 4);
    }
}

/// The motion follows from the simulated time, whatever the steps are.
#[test]
fn motion_does_not_depend_on_the_step_size() {
    let first_coordinate =
        |dt: f64, steps: u64| f64::from(run_tree(TreeOptions { dt, ..OPTIONS }, steps).1.pop().expect("a step").q[0]);
    // After 60 steps of 1 ns, the tree has barely begun to move.
    let (instant, second) = (first_coordinate(1e-9, 61), first_coordinate(1.0 / 60.0, 61));
    assert!(instant.abs() <= 1e-12 * second.abs(), "{instant} after 60 ns, {second} after 1 s");
    let (fine, coarse) = (first_coordinate(1.0 / 480.0, 481), first_coordinate(1.0 / 60.0, 61));
    assert!((fine / coarse - 1.0).abs() <= 1e-2, "{fine} and {coarse} after 1 s");
}

#[test]
fn sway_increases_with_the_wind() {
    let (calm_tree, _) = run_tree(TreeOptions { wind_strength: 0.0, ..OPTIONS }, 90);
    assert!(calm_tree.peaks().displacement <= 1e-6, "{:?}", calm_tree.peaks());
    let half_sway = run_tree(TreeOptions { wind_strength: 0.5, ..OPTIONS }, 90).0.peaks().sway;
    let full_sway = run_tree(OPTIONS, 90).0.peaks().sway;
    assert!(half_sway < 0.7 * full_sway && half_sway > 0.01, "half {half_sway}, full {full_sway}");
}

/// Modes of up to 100 kHz. An explicit integrator would diverge with these steps.
#[test]
fn tree_stays_bounded_beyond_the_explicit_step_limit() {
    let mut model = four_domain_model();
    let eigenvalue = |hertz: f64| (2.0 * std::f64::consts::PI * hertz).powi(2);
    for (domain, hertz) in model.domains.iter_mut().zip([[0.1, 1.0], [30.0, 1e3], [1e4, 1e5], [0.0, 0.0]]) {
        domain.eigenvalues = if domain.rank > 0 { hertz.map(eigenvalue).to_vec() } else { vec![] };
    }
    for dt in [1.0 / 60.0, 1.0, 10.0] {
        let options = TreeOptions { dt, ..OPTIONS };
        let mut tree = TreeScenario::new(model.clone(), options).expect("a valid scenario");
        let mut values = StepValues::default();
        for _ in 0..400 {
            tree.compute_next_step(&mut values).expect("finite coordinates");
        }
        let peaks = tree.peaks();
        let is_bounded = peaks.displacement <= 0.5 * tree.model.diagonal();
        assert!(is_bounded && peaks.sway > 0.0, "dt {dt}: {peaks:?}");
    }
}

#[test]
fn viewer_force_deflects_its_domain_in_addition_to_the_wind() {
    let run = |wind_strength: f64, force: f64| {
        let options = TreeOptions { wind_strength, ..OPTIONS };
        let mut tree = TreeScenario::new(four_domain_model(), options).expect("a valid scenario");
        let mut values = StepValues::default();
        for _ in 0..30 {
            tree.set_viewer_forces(&[0.0, 0.0, force, 0.0, 0.0, 0.0]).expect("a scenario with forces");
            tree.compute_next_step(&mut values).expect("finite coordinates");
        }
        values.q
    };
    let (pushed_q, calm_q) = (run(0.0, 2.0), run(0.0, 0.0));
    assert_eq!(calm_q, [0.0; 6], "control");
    // Coordinate 2 is the first one of domain 1.
    assert!(pushed_q[2] > 1e-4, "{pushed_q:?}");
    assert!(pushed_q.iter().enumerate().all(|(coordinate, q)| coordinate == 2 || *q == 0.0), "{pushed_q:?}");
    let (windy_q, both_q) = (run(1.0, 0.0), run(1.0, 2.0));
    for ((both, windy), pushed) in both_q.iter().zip(&windy_q).zip(&pushed_q) {
        assert!((both - (windy + pushed)).abs() <= 1e-5 * (1.0 + both.abs()), "{both_q:?}");
    }
}

/// The largest forces that the server passes on, for 20 s, in the direction of the motion of each coordinate, which
/// adds most energy.
#[test]
fn enormous_viewer_forces_do_not_end_the_run() {
    let mut tree = TreeScenario::new(four_domain_model(), OPTIONS).expect("a valid scenario");
    let check = crate::divergence::DivergenceCheck::new(tree.model());
    let (mut values, mut last_q) = (StepValues::default(), vec![0.0; 6]);
    for step in 0..1200 {
        tree.compute_next_step(&mut values).expect("finite coordinates");
        check.check(tree.model(), step, 0.0, &values).expect("a bounded motion");
        let force = |(now, last): (&f32, &f32)| 32.0 * f64::from(f32::MAX).copysign(f64::from(now - last));
        let forces: Vec<f64> = values.q.iter().zip(&last_q).map(force).collect();
        tree.set_viewer_forces(&forces).expect("a scenario with forces");
        last_q.clone_from(&values.q);
    }
    assert!(values.q.iter().any(|q| q.abs() > 1e-3), "expected an effect: {:?}", values.q);
    let remarks = tree.remarks();
    assert!(remarks.len() == 1 && remarks[0].contains("scaled to 0.25"), "{remarks:?}");
}

#[test]
fn same_seed_gives_the_same_values() {
    let (first_run, second_run) = (run_tree(OPTIONS, 60).1, run_tree(OPTIONS, 60).1);
    let other_seed = run_tree(TreeOptions { seed: 8, ..OPTIONS }, 60).1;
    assert!(first_run == second_run && first_run != other_seed);
}

/// Creates the scenario of a changed four-domain model.
fn create_tree(options: TreeOptions, change: impl Fn(&mut Model)) -> Result<TreeScenario> {
    let mut model = four_domain_model();
    change(&mut model);
    TreeScenario::new(model, options)
}

#[test]
fn invalid_parameters_are_rejected_before_the_first_step() {
    let error = |change: &dyn Fn(&mut Model)| create_tree(OPTIONS, change).err().expect("an error").to_string();
    let message = error(&|model| model.domains[0].eigenvalues[1] = -3.0);
    assert!(message.contains("eigenvalues[1] of 'beam'"), "{message}");
    let message = error(&|model| drop(model.domains[2].notes.insert("damping_ratio".into(), "nan".into())));
    assert!(message.contains("damping_ratio of 'beam'"), "{message}");
    let message = error(&|model| model.domains[1].eigenvalues.truncate(1));
    assert!(message.contains("eigenvalues of 'beam'") && message.contains("1 numbers"), "{message}");
    for (options, field) in [
        (TreeOptions { dt: f64::NAN, ..OPTIONS }, "dt"),
        (TreeOptions { dt: 0.0, ..OPTIONS }, "dt"),
        (TreeOptions { sway_fraction: f64::NAN, ..OPTIONS }, "sway"),
        (TreeOptions { wind_strength: -1.0, ..OPTIONS }, "wind"),
        (TreeOptions { direction_radians: f64::INFINITY, ..OPTIONS }, "direction"),
    ] {
        let message = create_tree(options, |_| ()).err().expect("an error").to_string();
        assert!(message.starts_with(field), "{message}");
    }
    // Without surface, the wind has no effect.
    let remove_surface = |model: &mut Model| model.domains.iter_mut().for_each(|domain| domain.area = 0.0);
    let message = error(&remove_surface);
    assert!(message.contains("surface area 0"), "{message}");
    create_tree(TreeOptions { wind_strength: 0.0, ..OPTIONS }, remove_surface).expect("a calm tree");
}

#[test]
fn remarks_report_held_modes_omitted_gusts_and_limited_sway() {
    let remarks = |options: TreeOptions, change: &dyn Fn(&mut Model)| {
        create_tree(options, change).expect("a valid scenario").remarks()
    };
    assert_eq!(remarks(OPTIONS, &|_| ()), [""; 0]);
    let held = remarks(OPTIONS, &|model| model.domains[1].eigenvalues[0] = 0.0);
    assert!(held.len() == 1 && held[0].contains("'beam': q[0] (0 Hz)"), "{held:?}");
    let coarse = remarks(TreeOptions { dt: 0.5, ..OPTIONS }, &|_| ());
    assert!(coarse[0].contains("gusts above 1 Hz"), "{coarse:?}");
    let limited = remarks(TreeOptions { sway_fraction: 0.5, ..OPTIONS }, &|_| ());
    assert!(limited.len() == 1 && limited[0].contains("instead of 0.5"), "{limited:?}");
}

/// A flat scene has no height along its up axis.
#[test]
fn flat_scene_sways() {
    let flatten = |model: &mut Model| model.bounds_max.y = model.bounds_min.y;
    let mut tree = create_tree(OPTIONS, flatten).expect("a valid scenario");
    let mut values = StepValues::default();
    (0..60).for_each(|_| tree.compute_next_step(&mut values).expect("a step"));
    assert!(values.q.iter().all(|coordinate| coordinate.is_finite()) && values.q[0].abs() > 1e-3, "{:?}", values.q);
}

/// The rigid leaf turns with the pressure at its place: it flutters.
#[test]
fn rigid_leaf_flutters() {
    let (tree, values) = run_tree(OPTIONS, 600);
    // The rotation of the leaf relative to the rigid transform that keeps its joint closed.
    let angle = |values: &StepValues| {
        let q: Vec<f64> = values.q.iter().map(|coordinate| f64::from(*coordinate)).collect();
        let fixed_leaf = crate::hierarchy::compute_transforms(&tree.model, &q, &[])[3];
        let rotation = fixed_leaf.linear.transpose() * AffineTransform::from_row_major(&values.transforms[3]).linear;
        (0.5 * (rotation.trace() - 1.0)).clamp(-1.0, 1.0).acos()
    };
    let angles: Vec<f64> = values.iter().map(angle).collect();
    assert!(angles.iter().all(|angle| *angle <= MAX_LEAF_ANGLE + 1e-3));
    // Local extrema in 10 s. Each oscillation has two.
    let extrema = angles.windows(3).filter(|angles| (angles[1] - angles[0]) * (angles[2] - angles[1]) < 0.0).count();
    assert!((30..300).contains(&extrema), "{extrema} extrema in 10 s");
}
