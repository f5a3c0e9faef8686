use super::*;
use crate::cubic::ReducedForce;
use crate::cubic::tests::{duffing, random_force, random_vector, spring_chain};
use crate::integrator::IntegratorTotals;
use crate::vega::VegaSettings;
use ImplicitMethod::{AverageVectorField, BackwardEuler};

fn integrator(force: ReducedForce, method: ImplicitMethod, dt: f64) -> ImplicitIntegrator {
    damped_integrator(force, &VegaSettings::default(), method, dt)
}

fn damped_integrator(
    force: ReducedForce,
    settings: &VegaSettings,
    method: ImplicitMethod,
    dt: f64,
) -> ImplicitIntegrator {
    let system = ReducedSystem::new(force, settings);
    ImplicitIntegrator::new(system, method, StepControl::Fixed, dt).expect("a valid step")
}

/// A state at q = 0 with the velocity `v`.
fn moving_state(v: DVector<f64>) -> MotionState {
    MotionState { v: v.clone(), ..MotionState::resting(v * 0.0) }
}

/// Advances by `count` steps without load.
fn run(integrator: &ImplicitIntegrator, state: &mut MotionState, count: u32) -> IntegratorTotals {
    let no_load = DVector::zeros(state.q.len());
    let mut totals = IntegratorTotals::default();
    for step in 0..count {
        let load = LoadChange { start: &no_load, end: &no_load };
        totals.add(&integrator.advance(state, load).unwrap_or_else(|error| panic!("step {step}: {error}")));
    }
    totals
}

/// Relative change of the energy over a run without load: its largest value at `samples` evenly spread steps.
fn energy_error(integrator: &ImplicitIntegrator, mut state: MotionState, count: u32, samples: u32) -> f64 {
    let energy = integrator.system().energy(&state);
    let mut largest = 0.0_f64;
    for _ in 0..samples {
        run(integrator, &mut state, count / samples);
        largest = largest.max((integrator.system().energy(&state) / energy - 1.0).abs());
    }
    largest
}

/// The energy errors of the systems of `steps` steps: (name, dt, error).
fn energy_errors(method: ImplicitMethod, steps: u32) -> Vec<(&'static str, f64, f64)> {
    let mut errors = vec![];
    for dt in [1.0 / 60.0, 0.5] {
        let duffing = integrator(duffing(), method, dt);
        errors.push(("Duffing", dt, energy_error(&duffing, moving_state(DVector::from_element(1, 100.0)), steps, 100)));
        let random = integrator(random_force(5, 4), method, dt);
        errors.push(("rank 4", dt, energy_error(&random, moving_state(random_vector(9, 4) * 50.0), steps, 100)));
    }
    errors
}

#[test]
fn average_vector_field_conserves_energy_at_any_step() {
    for (name, dt, error) in energy_errors(AverageVectorField, 2000) {
        assert!(error <= 1e-10, "{name}, dt {dt}: {error}");
    }
    for (name, dt, error) in energy_errors(BackwardEuler, 2000) {
        assert!(error > 0.5, "control: expected {name} with dt {dt} to lose energy by backward Euler, got {error}");
    }
}

#[test]
#[ignore = "the long run of the test above; takes seconds in a release build"]
fn average_vector_field_conserves_energy_over_1e5_steps() {
    for (name, dt, error) in energy_errors(AverageVectorField, 100_000) {
        println!("{name}, dt {dt}: {error:e}");
        assert!(error <= 4e-13, "{name}, dt {dt}: {error}");
    }
}

/// The coordinates of two coupled springs one second after their release.
fn release(method: ImplicitMethod, steps: u32) -> DVector<f64> {
    let springs = integrator(spring_chain(&[40.0, 90.0], 30.0, 4.0), method, 1.0 / f64::from(steps));
    let mut state = MotionState::resting(DVector::from_column_slice(&[0.8, -0.3]));
    run(&springs, &mut state, steps);
    state.q
}

#[test]
fn halving_the_step_reduces_the_error_by_the_order() {
    let reference = release(AverageVectorField, 20_000);
    for (method, order, tolerance, steps) in [(AverageVectorField, 2.0, 0.03, 200), (BackwardEuler, 1.0, 0.1, 20_000)] {
        let error = |steps: u32| (release(method, steps) - &reference).norm();
        let measured_order = (error(steps) / error(2 * steps)).log2();
        assert!((measured_order - order).abs() <= tolerance, "{method:?}: expected {order}, got {measured_order}");
    }
    let error = (release(AverageVectorField, 400) - &reference).norm();
    assert!(error <= 2e-3, "{error}");
}

#[test]
fn damping_never_increases_the_energy() {
    let settings = VegaSettings { damping_mass: 0.5, damping_stiffness: 0.01, ..VegaSettings::default() };
    for eigenvalues in [[40.0, 90.0], [40.0, -20.0], [40.0, 0.0]] {
        for dt in [1e-3, 1.0 / 60.0, 0.5] {
            let force = spring_chain(&eigenvalues, 30.0, 0.0);
            let springs = damped_integrator(force, &settings, AverageVectorField, dt);
            let mut state = MotionState::resting(DVector::from_column_slice(&[0.8, -0.3]));
            let start = springs.system().energy(&state);
            let mut energy = start;
            for step in 0..1000 {
                run(&springs, &mut state, 1);
                let next = springs.system().energy(&state);
                assert!(
                    next <= energy + 1e-12 * start.abs(),
                    "{eigenvalues:?}, dt {dt}, step {step}: {energy} to {next}"
                );
                energy = next;
            }
            assert!(energy < 0.9 * start, "{eigenvalues:?}, dt {dt}: {start} to {energy}");
        }
    }
}

#[test]
fn steady_load_converges_to_the_equilibrium() {
    let settings = VegaSettings { damping_mass: 4.0, ..VegaSettings::default() };
    for method in [AverageVectorField, BackwardEuler] {
        let springs = damped_integrator(spring_chain(&[40.0, 90.0], 30.0, 4.0), &settings, method, 0.02);
        let load = DVector::from_column_slice(&[12.0, -3.0]);
        let equilibrium = springs.system().solve_equilibrium(&load, &DVector::zeros(2));
        let mut state = MotionState::resting(DVector::zeros(2));
        for _ in 0..2000 {
            springs.advance(&mut state, LoadChange { start: &load, end: &load }).expect("a step");
        }
        assert!((state.q - equilibrium).norm() <= 1e-6, "{method:?}");
    }
}

/// Fast initial velocities and steps of up to thousands of periods.
#[test]
fn energy_is_conserved_in_stiff_systems() {
    for dt in [1e-9, 1e-3, 0.1, 1.0, 30.0] {
        for seed in 0..4 {
            let springs = integrator(spring_chain(&[1.0, 7.0, 1e6], 50.0, 3.0), AverageVectorField, dt);
            let error = energy_error(&springs, moving_state(random_vector(seed, 3) * 20.0), 300, 30);
            assert!(error <= 1e-9, "dt {dt}, seed {seed}: {error}");
        }
    }
}

fn adaptive(force: ReducedForce, tolerance: f64, dt: f64) -> ImplicitIntegrator {
    adaptive_with(AverageVectorField, force, tolerance, dt)
}

fn adaptive_with(method: ImplicitMethod, force: ReducedForce, tolerance: f64, dt: f64) -> ImplicitIntegrator {
    let control = StepControl::Adaptive { tolerance, displacements_per_unit: vec![1.0; force.rank()] };
    let system = ReducedSystem::new(force, &VegaSettings::default());
    ImplicitIntegrator::new(system, method, control, dt).expect("a valid step")
}

/// The estimate of the error, from which the number of sub-steps follows, agrees with the error of one step.
#[test]
fn estimated_error_agrees_with_the_error() {
    let dt = 1.0 / 60.0;
    for seed in 0..6 {
        let start =
            MotionState { v: random_vector(seed, 3) * 6.0, ..MotionState::resting(random_vector(seed + 50, 3)) };
        let force = || random_force(2, 3);
        let (mut state, mut reference) = (start.clone(), start.clone());
        let no_load = DVector::zeros(3);
        let report =
            adaptive(force(), 1e3, dt / 4.0).advance(&mut state, LoadChange { start: &no_load, end: &no_load });
        let estimate = report.expect("a step").error;
        run(&integrator(force(), AverageVectorField, dt / 4.0 / 500.0), &mut reference, 500);
        let error = (state.q - reference.q).abs().sum();
        assert!((0.3..3.0).contains(&(estimate / error)), "seed {seed}: estimated {estimate}, got {error}");
    }
}

#[test]
fn sub_steps_follow_the_tolerance_up_to_their_limit() {
    let start = moving_state(DVector::from_element(1, 100.0));
    let run_with = |tolerance: f64| run(&adaptive(duffing(), tolerance, 1.0 / 60.0), &mut start.clone(), 60);
    let (loose, tight, impossible) = (run_with(1e-1), run_with(1e-2), run_with(1e-9));
    assert!(loose.sub_steps < tight.sub_steps && tight.limited_steps == 0, "{loose:?} {tight:?}");
    assert!(tight.max_error <= 1e-2 && tight.rejections > 0, "{tight:?}");
    assert_eq!((impossible.max_sub_steps, impossible.limited_steps), (MAX_SUB_STEPS, 60), "{impossible:?}");
    // A body at rest needs no sub-steps.
    let rest = run(&adaptive(duffing(), 1e-9, 1.0 / 60.0), &mut MotionState::resting(DVector::zeros(1)), 3);
    assert_eq!((rest.sub_steps, rest.iterations), (3, 0));
}

/// The error of a run follows the tolerance for both methods, with few rejected steps.
#[test]
fn tighter_tolerance_reduces_the_error_of_both_methods() {
    const STEPS: u32 = 30;
    let start = moving_state(DVector::from_element(1, 3.0));
    let coordinates = |integrator: &ImplicitIntegrator, division: u32, totals: &mut IntegratorTotals| -> Vec<f64> {
        let mut state = start.clone();
        let step = |_| {
            let step_totals = run(integrator, &mut state, division);
            totals.rejections += step_totals.rejections;
            totals.limited_steps += step_totals.limited_steps;
            totals.max_error = totals.max_error.max(step_totals.max_error);
            state.q[0]
        };
        (0..STEPS).map(step).collect()
    };
    let precise = integrator(duffing(), AverageVectorField, 1.0 / 60.0 / 500.0);
    let reference = coordinates(&precise, 500, &mut IntegratorTotals::default());
    for (method, tolerances) in [(AverageVectorField, [1e-3, 1e-5]), (BackwardEuler, [1e-2, 1e-3])] {
        let error = |tolerance: f64| {
            let mut totals = IntegratorTotals::default();
            let q = coordinates(&adaptive_with(method, duffing(), tolerance, 1.0 / 60.0), 1, &mut totals);
            assert!(totals.limited_steps == 0 && totals.max_error <= tolerance, "{method:?}: {totals:?}");
            assert!(totals.rejections <= u64::from(STEPS), "{method:?}: {totals:?}");
            q.iter().zip(&reference).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
        };
        let errors = tolerances.map(error);
        assert!(errors[1] < 0.5 * errors[0], "{method:?}: {errors:?}");
    }
}

/// Potentials without a lower bound: beyond the barrier, the motion reaches infinity in a finite time.
#[test]
fn step_without_solution_is_halved_and_then_an_error() {
    let springs = integrator(spring_chain(&[40.0, 90.0], -3e4, 0.0), AverageVectorField, 0.5);
    let mut state = moving_state(DVector::from_column_slice(&[300.0, -300.0]));
    let (start, no_load) = (state.clone(), DVector::zeros(2));
    let load = LoadChange { start: &no_load, end: &no_load };
    let outcome = (0..100).find_map(|_| springs.advance(&mut state, load).err());
    let error = outcome.expect("an error").to_string();
    assert!(error.contains("64 sub-steps") && error.contains("residual"), "{error}");
    // Shorter steps have a solution.
    let short = integrator(spring_chain(&[40.0, 90.0], -3e4, 0.0), AverageVectorField, 1e-6);
    let report = short.advance(&mut start.clone(), load).expect("a step");
    assert_eq!((report.sub_steps, report.rejections), (1, 0));
    for invalid in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        let system = ReducedSystem::new(duffing(), &VegaSettings::default());
        assert!(ImplicitIntegrator::new(system, BackwardEuler, StepControl::Fixed, invalid).is_err(), "{invalid}");
    }
}

/// A buckled beam swings into one of its stable states, and a free body moves on.
#[test]
fn zero_and_negative_eigenvalues_run() {
    let settings = VegaSettings { damping_mass: 1.0, ..VegaSettings::default() };
    let buckled = damped_integrator(spring_chain(&[-4.0, 90.0], 30.0, 0.0), &settings, AverageVectorField, 1.0 / 60.0);
    let mut state = MotionState::resting(DVector::from_column_slice(&[1e-3, 0.0]));
    run(&buckled, &mut state, 2000);
    assert!(state.q[0] > 0.05 && buckled.system().evaluate(&state.q).force.norm() <= 1e-6, "{state:?}");
    let free = integrator(spring_chain(&[0.0, 90.0], 0.0, 0.0), AverageVectorField, 0.5);
    let mut state = moving_state(DVector::from_column_slice(&[2.0, 0.0]));
    run(&free, &mut state, 100);
    assert!((state.q[0] - 100.0).abs() <= 1e-9, "{state:?}");
}
