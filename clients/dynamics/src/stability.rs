//! Stability of all integrators on stiff and extreme cases.
//!
//! For a unit mass with the energy E = v^2 / 2 + V(q) under a force f, d/dt sqrt(2 E) <= |f| without negative damping.
//! Hence sqrt(2 E) never exceeds the integral of |f| from rest. The bound holds for all stiffnesses, damping ratios and
//! step sizes.

use nalgebra::DVector;

use crate::cubic::tests::{random_vector, spring_chain};
use crate::divergence::DivergenceCheck;
use crate::error::Error;
use crate::hierarchy::tests::four_domain_model;
use crate::implicit::{ImplicitIntegrator, ImplicitMethod, StepControl};
use crate::integrator::{Integrator as _, LoadChange, MotionState};
use crate::loads::DomainLoads;
use crate::oscillator::{ModeState, Oscillator};
use crate::reduced_system::ReducedSystem;
use crate::run::Scenario as _;
use crate::step_values::StepValues;
use crate::tree::{TreeOptions, TreeScenario};
use crate::vega::VegaSettings;

/// An extreme system under a random force.
struct Case {
    name: &'static str,
    hertz: [f64; 2],
    damping_ratio: f64,
    dt: f64,
    /// Largest force on a mode.
    force: f64,
}

const CASES: [Case; 8] = [
    Case { name: "usual", hertz: [0.8, 3.0], damping_ratio: 0.05, dt: 1.0 / 60.0, force: 1.0 },
    Case { name: "stiff beam", hertz: [1e4, 1e7], damping_ratio: 0.02, dt: 1.0 / 60.0, force: 1.0 },
    Case { name: "soft and stiff", hertz: [1e-3, 1e6], damping_ratio: 0.02, dt: 1.0 / 60.0, force: 1.0 },
    Case { name: "long steps", hertz: [0.8, 30.0], damping_ratio: 0.02, dt: 1e3, force: 1.0 },
    Case { name: "short steps", hertz: [0.8, 30.0], damping_ratio: 0.02, dt: 1e-9, force: 1.0 },
    Case { name: "no damping", hertz: [0.8, 3.0], damping_ratio: 0.0, dt: 1.0 / 60.0, force: 1.0 },
    Case { name: "overdamped", hertz: [0.8, 3.0], damping_ratio: 900.0, dt: 1.0 / 60.0, force: 1.0 },
    Case { name: "huge force", hertz: [0.8, 3.0], damping_ratio: 0.05, dt: 1.0 / 60.0, force: 1e12 },
];

const STEPS: u64 = 2000;

fn eigenvalues(case: &Case) -> [f64; 2] {
    case.hertz.map(|hertz| (std::f64::consts::TAU * hertz).powi(2))
}

/// The force on both modes at a step; 0 at step 0.
fn force(case: &Case, step: u64) -> DVector<f64> {
    random_vector(step, 2) * if step == 0 { 0.0 } else { case.force }
}

#[test]
fn energy_of_modes_is_bounded() {
    for case in &CASES {
        for (mode, eigenvalue) in eigenvalues(case).into_iter().enumerate() {
            let oscillator = Oscillator::new(eigenvalue, case.damping_ratio, case.dt).expect("valid parameters");
            let (mut state, mut bound) = (ModeState::default(), 0.0);
            for step in 0..STEPS {
                let (start, end) = (force(case, step)[mode], force(case, step + 1)[mode]);
                state = oscillator.advance(state, start, end);
                bound += case.dt * start.abs().max(end.abs());
                let root_energy = (state.v * state.v + eigenvalue * state.q * state.q).sqrt();
                assert!(
                    root_energy.is_finite() && root_energy <= bound * (1.0 + 1e-6),
                    "{}, mode {mode}, step {step}: expected at most {bound}, got {root_energy}",
                    case.name
                );
            }
            assert!(bound > 0.0 && state.q != 0.0, "control: expected motion in {}", case.name);
        }
    }
}

/// An explicit integrator violates the bound: the test detects instability.
#[test]
fn bound_detects_an_unstable_integrator() {
    let case = &CASES[1];
    let (eigenvalue, mut state, mut bound) = (eigenvalues(case)[0], ModeState::default(), 0.0);
    let exceeds_bound = (0..20).any(|step| {
        // Forward Euler.
        let (start, end) = (force(case, step)[0], force(case, step + 1)[0]);
        state = ModeState { q: state.q + case.dt * state.v, v: state.v + case.dt * (start - eigenvalue * state.q) };
        bound += case.dt * start.abs().max(end.abs());
        (state.v * state.v + eigenvalue * state.q * state.q).sqrt() > bound * (1.0 + 1e-6)
    });
    assert!(exceeds_bound);
}

#[test]
fn energy_of_reduced_forces_is_bounded() {
    for case in &CASES {
        // A linear system, and a hardening one whose cubic force is comparable to the linear one.
        for hardening in [0.0, 1.0] {
            let quartic_coefficient = hardening * eigenvalues(case)[0] / case.force.powi(2);
            let springs = spring_chain(&eigenvalues(case), quartic_coefficient, 0.0);
            let damping_mass = 2.0 * case.damping_ratio * eigenvalues(case)[0].sqrt();
            let settings = VegaSettings { damping_mass, ..VegaSettings::default() };
            let system = ReducedSystem::new(springs, &settings);
            let method = ImplicitMethod::AverageVectorField;
            let integrator =
                ImplicitIntegrator::new(system, method, StepControl::Fixed, case.dt).expect("a valid step");
            let (mut state, mut bound) = (MotionState::resting(DVector::zeros(2)), 0.0);
            for step in 0..STEPS / 4 {
                let (start, end) = (force(case, step), force(case, step + 1));
                integrator
                    .advance(&mut state, LoadChange { start: &start, end: &end })
                    .unwrap_or_else(|error| panic!("{}, {step}: {error}", case.name));
                bound += case.dt * start.norm().max(end.norm());
                let root_energy = (2.0 * integrator.system().energy(&state)).sqrt();
                assert!(
                    root_energy.is_finite() && root_energy <= bound * (1.0 + 1e-6),
                    "{}, hardening {hardening}, step {step}: expected at most {bound}, got {root_energy}",
                    case.name
                );
            }
        }
    }
}

/// The scenario itself: it sends only finite steps in range, also if a viewer pushes hard.
#[test]
fn tree_sends_only_steps_in_range() {
    for case in &CASES {
        for viewer_force in [0.0, 1e30, 1e300] {
            let mut model = four_domain_model();
            for domain in model.domains.iter_mut().filter(|domain| domain.rank > 0) {
                domain.eigenvalues = eigenvalues(case).to_vec();
                domain.notes.insert("damping_ratio".into(), case.damping_ratio.to_string());
            }
            let options = TreeOptions { dt: case.dt, wind_speed: 0.1, direction_radians: 0.4, seed: 7 };
            let mut tree = TreeScenario::new(model, options).expect("a valid scenario");
            let check = DivergenceCheck::new(tree.model());
            let loads = DomainLoads::of_coordinates(tree.model(), &[viewer_force; 6]);
            tree.set_viewer_forces(&loads).expect("a scenario with forces");
            let mut values = StepValues::default();
            let mut send_step = |step: u64| {
                tree.compute_next_step(&mut values)?;
                check.check(tree.model(), step, case.dt * step as f64, &values)?;
                let mut numbers = values.q.iter().chain(values.transforms.as_flattened());
                assert!(numbers.all(|number| number.is_finite()), "{}, step {step}", case.name);
                Ok(())
            };
            let outcome: Result<(), Error> = (0..300).try_for_each(&mut send_step);
            assert!(outcome.is_ok(), "{}, force {viewer_force}: {outcome:?}", case.name);
            // The first mode of each domain is the softer one.
            let soft_modes_move = values.q.iter().step_by(2).all(|coordinate| *coordinate != 0.0);
            assert!(soft_modes_move, "{}, force {viewer_force}: {:?}", case.name, values.q);
        }
    }
}
