use super::*;
use crate::coupled::testing::{in_units, random_plant};
use crate::divergence::DivergenceCheck;
use crate::hierarchy::tests::four_domain_model;

const OPTIONS: TreeOptions = TreeOptions { dt: 1.0 / 60.0, wind_speed: 4.0, direction_radians: 0.4, seed: 7 };

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
fn tree_sways_and_joints_stay_closed() {
    for (dt, steps) in [(1.0 / 60.0, 600), (0.05, 200)] {
        let (tree, values) = run_tree(TreeOptions { dt, ..OPTIONS }, steps);
        let peaks = tree.peaks();
        assert!((0.003..0.3).contains(&peaks.sway) && peaks.drag > 0.0, "dt {dt}: {peaks:?}");
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

/// The wind has a unit, and nothing limits its effect.
#[test]
fn sway_is_proportional_to_the_square_of_the_wind_speed() {
    let (calm_tree, _) = run_tree(TreeOptions { wind_speed: 0.0, ..OPTIONS }, 90);
    assert!(calm_tree.peaks().displacement <= 1e-6 && calm_tree.peaks().drag == 0.0, "{:?}", calm_tree.peaks());
    // The spectrum of the gusts depends on the mean speed, so the ratio of the peaks differs from 4.
    let peaks = |wind_speed: f64| run_tree(TreeOptions { wind_speed, ..OPTIONS }, 900).0.peaks();
    let (slow, fast) = (peaks(2.0), peaks(4.0));
    assert!((2.8..5.5).contains(&(fast.sway / slow.sway)), "{slow:?} {fast:?}");
    assert!((3.2..5.0).contains(&(fast.drag / slow.drag)), "{slow:?} {fast:?}");
    let sway_of_height = |wind_speed: f64| {
        let (tree, values) = run_tree(TreeOptions { wind_speed, ..OPTIONS }, 120);
        let outcome = DivergenceCheck::new(&tree.model).check(&tree.model, 119, 2.0, &values[119]);
        (f64::from(values[119].q[0].abs()), outcome.map_err(|error| error.to_string()))
    };
    let (storm, hurricane) = (sway_of_height(100.0), sway_of_height(1e6));
    assert!(hurricane.0 > 1e3 * storm.0, "{storm:?} {hurricane:?}");
    assert!(hurricane.1.as_ref().is_err_and(|error| error.contains("--wind")), "{hurricane:?}");
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
        let options = TreeOptions { dt, wind_speed: 1.0, ..OPTIONS };
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

/// A push on the rigid leaf, which has no coordinates, moves all domains that carry it.
#[test]
fn viewer_force_deflects_all_ancestors_in_addition_to_the_wind() {
    let run = |wind_speed: f64, force: f64| {
        let options = TreeOptions { wind_speed, ..OPTIONS };
        let mut tree = TreeScenario::new(four_domain_model(), options).expect("a valid scenario");
        let mut loads = DomainLoads::none(&tree.model);
        let sample = tree.model.domains[3].samples[24].clone();
        loads.add_force(&tree.model, 3, &sample, &Vector3::new(force, 0.5 * force, force));
        let mut values = StepValues::default();
        for _ in 0..30 {
            tree.set_viewer_forces(&loads).expect("a scenario with forces");
            tree.compute_next_step(&mut values).expect("finite coordinates");
        }
        values.q
    };
    let (pushed_q, calm_q) = (run(0.0, 0.05), run(0.0, 0.0));
    assert_eq!(calm_q, [0.0; 6], "control");
    assert!(pushed_q.iter().all(|q| q.abs() > 1e-5), "{pushed_q:?}");
    let (windy_q, both_q) = (run(4.0, 0.0), run(4.0, 0.05));
    for ((both, windy), pushed) in both_q.iter().zip(&windy_q).zip(&pushed_q) {
        assert!((both - (windy + pushed)).abs() <= 1e-5 * (1.0 + both.abs()), "{both_q:?}");
    }
}

/// 0.02 N held on a twig: the drawn tree comes to rest where the static equations say.
#[test]
fn held_force_deflects_all_ancestors_as_the_static_response() {
    let model = random_plant(40, 9);
    // The twig with the longest path to the root.
    let depth = |mut domain: usize| {
        let mut depth = 0;
        while let Some(carrier) = model.domains[domain].carrier() {
            (domain, depth) = (carrier, depth + 1);
        }
        depth
    };
    let twig = (0..model.domains.len()).max_by_key(|domain| depth(*domain)).expect("a domain");
    assert!(depth(twig) >= 4, "{}", depth(twig));
    let mut loads = DomainLoads::none(&model);
    loads.add_force(&model, twig, &model.domains[twig].samples[26], &Vector3::new(0.02, 0.0, 0.0));
    let parameters = ModalParameters::read(&model).expect("valid parameters");
    let statics = StaticSystem::new(&model, &parameters).expect("a valid scene");
    let response = statics.solve(&loads);
    let options = TreeOptions { wind_speed: 0.0, dt: 0.1, ..OPTIONS };
    let mut damped = model.clone();
    damped.domains.iter_mut().for_each(|domain| drop(domain.notes.insert("damping_ratio".into(), "0.7".into())));
    let mut tree = TreeScenario::new(damped, options).expect("a valid scenario");
    tree.set_viewer_forces(&loads).expect("a scenario with forces");
    assert_eq!(tree.late_remarks(), [""; 0], "expected a force that is not scaled");
    let mut values = StepValues::default();
    (0..3000).for_each(|_| tree.compute_next_step(&mut values).expect("finite coordinates"));
    let mut carrier = Some(twig);
    while let Some(index) = carrier {
        let domain = &model.domains[index];
        let q: Vec<f64> = tree.motion.state.q.iter().copied().collect();
        let transform = crate::hierarchy::compute_transforms(&model, &q, &[])[index];
        let sample = &domain.samples[26];
        let drawn =
            transform.apply(&sample.deformed_position(domain.q(&q))) - domain.placement.apply(&sample.rest_position);
        let expected = response.displacement(&model, index, sample);
        assert!(expected.norm() > 1e-9, "expected a deflection of '{}'", domain.name);
        assert!((drawn - expected).norm() <= 1e-2 * expected.norm(), "'{}': {drawn} {expected}", domain.name);
        carrier = domain.carrier();
    }
    // Control: domains that are not coupled would leave the root at rest.
    assert!(response.q[..model.domains[0].rank].iter().any(|q| *q != 0.0));
}

/// Forces are in newtons: a scene in millimeters moves by as many meters as the same scene in meters.
#[test]
fn motion_does_not_depend_on_the_unit_of_the_scene() {
    let meters = random_plant(12, 4);
    let run = |model: &Model| {
        let mut tree = TreeScenario::new(model.clone(), OPTIONS).expect("a valid scenario");
        let mut loads = DomainLoads::none(model);
        let sample = model.domains[7].samples[24].clone();
        loads.add_force(model, 7, &sample, &Vector3::new(1e-3, 2e-3, -1e-3));
        tree.set_viewer_forces(&loads).expect("a scenario with forces");
        let mut values = StepValues::default();
        (0..60).for_each(|_| tree.compute_next_step(&mut values).expect("a step"));
        (values.q.iter().map(|q| f64::from(*q) * model.unit).collect::<Vec<f64>>(), tree.peaks().drag)
    };
    let ((expected, drag), (q, scaled_drag)) = (run(&meters), run(&in_units(&meters, 1e-3)));
    let largest = expected.iter().fold(0.0_f64, |largest, q| largest.max(q.abs()));
    for (expected, q) in expected.iter().zip(&q) {
        assert!((expected - q).abs() <= 1e-5 * largest, "{expected} {q}");
    }
    assert!((scaled_drag / drag - 1.0).abs() <= 1e-9, "{drag} {scaled_drag}");
    // Control: other units of the same numbers are another scene.
    let (other, _) = run(&Model { unit: 1e-3, ..meters });
    assert!(other.iter().zip(&expected).any(|(a, b)| (a - b).abs() > 0.1 * largest));
}

/// The largest forces that the server passes on, for 20 s, in the direction of the motion of each coordinate, which
/// adds most energy.
#[test]
fn enormous_viewer_forces_do_not_end_the_run() {
    let mut tree = TreeScenario::new(four_domain_model(), OPTIONS).expect("a valid scenario");
    let check = DivergenceCheck::new(tree.model());
    let (mut values, mut last_q) = (StepValues::default(), vec![0.0; 6]);
    for step in 0..1200 {
        tree.compute_next_step(&mut values).expect("finite coordinates");
        check.check(tree.model(), step, 0.0, &values).expect("a bounded motion");
        let force = |(now, last): (&f32, &f32)| 32.0 * f64::from(f32::MAX).copysign(f64::from(now - last));
        let forces: Vec<f64> = values.q.iter().zip(&last_q).map(force).collect();
        let loads = DomainLoads::of_coordinates(tree.model(), &forces);
        tree.set_viewer_forces(&loads).expect("a scenario with forces");
        last_q.clone_from(&values.q);
    }
    assert!(values.q.iter().any(|q| q.abs() > 1e-3), "expected an effect: {:?}", values.q);
    let remarks = tree.remarks();
    assert!(remarks.len() == 1 && remarks[0].contains("at most 0.25"), "{remarks:?}");
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
        (TreeOptions { wind_speed: -1.0, ..OPTIONS }, "wind"),
        (TreeOptions { wind_speed: f64::NAN, ..OPTIONS }, "wind"),
        (TreeOptions { direction_radians: f64::INFINITY, ..OPTIONS }, "direction"),
    ] {
        let message = create_tree(options, |_| ()).err().expect("an error").to_string();
        assert!(message.starts_with(field), "{message}");
    }
    // Without surface, the wind has no effect.
    let remove_surface = |model: &mut Model| model.domains.iter_mut().for_each(|domain| domain.area = 0.0);
    let message = error(&remove_surface);
    assert!(message.contains("surface area 0"), "{message}");
    create_tree(TreeOptions { wind_speed: 0.0, ..OPTIONS }, remove_surface).expect("a calm tree");
}

#[test]
fn remarks_report_held_modes_and_omitted_gusts() {
    let remarks = |options: TreeOptions, change: &dyn Fn(&mut Model)| {
        create_tree(options, change).expect("a valid scenario").remarks()
    };
    assert_eq!(remarks(OPTIONS, &|_| ()), [""; 0]);
    let held = remarks(OPTIONS, &|model| model.domains[1].eigenvalues[0] = 0.0);
    assert!(held.len() == 1 && held[0].contains("'beam': q[0] (0 Hz)"), "{held:?}");
    let coarse = remarks(TreeOptions { dt: 0.5, ..OPTIONS }, &|_| ());
    assert!(coarse[0].contains("gusts above 1 Hz"), "{coarse:?}");
    let calm = remarks(TreeOptions { dt: 0.5, wind_speed: 0.0, ..OPTIONS }, &|_| ());
    assert_eq!(calm, [""; 0]);
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

/// Checked for each domain by itself: a stiff trunk and flexible leaves have different sizes.
#[test]
fn default_wind_bends_no_part_by_more_than_its_limit() {
    let model = four_domain_model();
    let statics = StaticSystem::new(&model, &ModalParameters::read(&model).expect("parameters")).expect("statics");
    let largest_ratio = |speed: f64| {
        let wind = WindOptions { mean_speed: speed, direction_radians: 0.4, seed: 0, max_frequency: 0.0 };
        let loads = WindExcitation::new(&model, &wind).steady_loads(&model, Wind::gust_pressure(speed));
        let response = statics.solve(&loads);
        let mut largest: f64 = 0.0;
        for (index, domain) in model.domains.iter().enumerate() {
            let positions = domain.surface_samples().iter().map(|sample| sample.rest_position);
            let (low, high) = positions
                .fold((Vector3::repeat(f64::MAX), Vector3::repeat(f64::MIN)), |(low, high), x| {
                    (low.inf(&x), high.sup(&x))
                });
            for sample in domain.surface_samples() {
                let displacement = response.displacement(&model, index, sample).norm() / model.height();
                let deflection = sample.displacement(domain.q(&response.q)).norm() / (high - low).norm();
                largest = largest.max(displacement).max(deflection);
            }
        }
        largest
    };
    let speed = default_wind_speed(&model, 0.4).expect("a speed");
    assert!(speed > 0.0 && speed <= MAX_DEFAULT_SPEED, "{speed} m/s");
    assert!(largest_ratio(speed) <= DEFAULT_DEFLECTION, "{speed} m/s");
    if speed < MAX_DEFAULT_SPEED {
        let ratio = largest_ratio(1.15 * speed);
        assert!(ratio > DEFAULT_DEFLECTION, "control: expected a larger deflection above {speed} m/s, got {ratio}");
    }
}
