//! Free bodies against conservation laws, closed forms, and the motion of their point masses.

use nalgebra::{DVector, Matrix6, UnitQuaternion, Vector3, Vector6};

use super::testing::{Branch, Random, create_scene, point_masses, random_plant};
use super::*;
use crate::attachments::Attachments;
use crate::hierarchy::compose_transforms;
use crate::loads::DomainLoads;
use crate::model::DomainInertia;
use crate::wrench::{split, stack};

const DT: f64 = 1.0 / 60.0;

fn parameters(model: &Model, damping_ratio: f64) -> ModalParameters {
    let mut parameters = ModalParameters::read(model).expect("valid parameters");
    parameters.modes.iter_mut().flatten().for_each(|mode| mode.damping_ratio = damping_ratio);
    parameters
}

/// A rigid body with these principal moments about its origin, which is its center of mass.
fn rigid_body(mass: f64, moments: [f64; 3]) -> Model {
    let mut model = create_scene(&[Branch { rank: 0, length: 1.0, mass, hertz: 1.0 }], &[None], 1);
    let mut rigid = Matrix6::identity() * mass;
    (0..3).for_each(|axis| rigid[(3 + axis, 3 + axis)] = moments[axis]);
    let inertia = model.domains[0].inertia.as_mut().expect("an inertia");
    *inertia = DomainInertia { rigid, ..inertia.clone() };
    model
}

/// A state with random coordinates, velocities and rigid motions.
fn random_state(free: &FreeModes, seed: u64, amplitude: f64, spin: f64) -> FreeState {
    let mut random = Random::new(seed);
    let mut state = free.at_rest();
    let count = state.motion.q.len();
    state.motion.q = DVector::from_fn(count, |_, _| amplitude * random.next());
    state.motion.v = DVector::from_fn(count, |_, _| amplitude * random.next());
    for body in &mut state.bodies {
        let rotation = UnitQuaternion::from_scaled_axis(random.vector());
        *body = RigidState::new(&random.vector(), &random.vector(), &rotation, &(random.vector() * spin));
    }
    state
}

fn no_load(free: &FreeModes, model: &Model) -> FreeLoad {
    free.reduce(&DomainLoads::none(model))
}

fn advance(free: &FreeModes, state: &mut FreeState, load: &FreeLoad, steps: u32) {
    (0..steps).for_each(|_| free.advance(state, load).expect("a step"));
}

/// Per component, relative to the largest change that a step makes of each.
fn momentum_change(free: &FreeModes, a: &Vector6<f64>, state: &FreeState) -> f64 {
    let b = free.momentum(state);
    let ((p, l), (momentum, angular_momentum)) = (split(a), split(&b));
    ((p - momentum).norm() / p.norm()).max((l - angular_momentum).norm() / l.norm())
}

#[test]
fn momenta_and_energy_of_free_plants_are_conserved() {
    for (model, dt) in [
        (rigid_body(2.0, [0.5, 1.0, 1.4]), DT),
        (random_plant(1, 3), DT),
        (random_plant(14, 2), DT),
        (random_plant(14, 2), 0.5),
    ] {
        let free = FreeModes::new(&model, &parameters(&model, 0.0), dt).expect("a valid scene");
        let mut state = random_state(&free, 5, 0.05, 2.0);
        let load = no_load(&free, &model);
        let (momentum, energy) = (free.momentum(&state), free.energy(&model, &state));
        let (mut momentum_error, mut energy_error) = (0.0_f64, 0.0_f64);
        for _ in 0..50 {
            advance(&free, &mut state, &load, 100);
            momentum_error = momentum_error.max(momentum_change(&free, &momentum, &state));
            energy_error = energy_error.max((free.energy(&model, &state) / energy - 1.0).abs());
        }
        println!("{} domains, dt {dt}: momenta {momentum_error:.1e}, energy {energy_error:.1e}", model.domains.len());
        assert!(momentum_error <= 1e-10, "{} domains: {momentum_error:e}", model.domains.len());
        assert!(energy_error <= 1e-10, "{} domains: {energy_error:e}", model.domains.len());
        // Controls: a force changes the momentum, and damping the energy.
        let mut loads = DomainLoads::none(&model);
        loads.add_force(&model, 0, &model.domains[0].samples[24], &Vector3::new(0.1, 0.2, -0.3));
        advance(&free, &mut state, &free.reduce(&loads), 10);
        assert!(momentum_change(&free, &momentum, &state) > 1e-4, "control");
        if model.coordinate_count > 0 {
            let damped = FreeModes::new(&model, &parameters(&model, 0.05), dt).expect("a valid scene");
            let mut state = random_state(&damped, 5, 0.05, 2.0);
            advance(&damped, &mut state, &load, 100);
            assert!(damped.energy(&model, &state) < (1.0 - 1e-6) * energy, "control");
            assert!(momentum_change(&damped, &momentum, &state) <= 1e-10, "damping is an inner force");
        }
    }
}

/// The drawn positions of all point masses, each with its mass.
fn drawn_masses(model: &Model, free: &FreeModes, state: &FreeState) -> Vec<(f64, Vector3<f64>)> {
    let q = state.motion.q.as_slice();
    let mut attachments = Attachments::new(model).deform(model, q);
    let motions = free.world_from_rest(state);
    for (index, domain) in model.domains.iter().enumerate().filter(|(_, domain)| domain.carrier().is_none()) {
        attachments[index] = motions[free.body_of(index)].compose(&domain.placement);
    }
    let transforms = compose_transforms(model, &attachments, &[]);
    let positions = model.domains.iter().zip(&transforms).flat_map(|(domain, transform)| {
        let (samples, mass) = point_masses(domain);
        samples.iter().map(move |sample| (mass, transform.apply(&sample.deformed_position(domain.q(q)))))
    });
    positions.collect()
}

/// The momenta are those of the drawn point masses, and so is the energy.
#[test]
fn momenta_are_those_of_the_drawn_motion() {
    for model in [random_plant(1, 8), random_plant(9, 1)] {
        let dt = 1e-5;
        let free = FreeModes::new(&model, &parameters(&model, 0.0), dt).expect("a valid scene");
        // The inertia is that of the shape at rest.
        let mut state = random_state(&free, 3, 1.0, 1.0);
        state.motion.q.fill(0.0);
        let (momentum, energy) = (free.momentum(&state), free.energy(&model, &state));
        let before = drawn_masses(&model, &free, &state);
        advance(&free, &mut state, &no_load(&free, &model), 1);
        let after = drawn_masses(&model, &free, &state);
        let (mut drawn, mut drawn_energy) = (Vector6::zeros(), 0.0);
        for ((mass, a), (_, b)) in before.iter().zip(&after) {
            let velocity = (b - a) / dt;
            let p = velocity * *mass;
            drawn += stack(&p, &(0.5 * (a + b)).cross(&p));
            drawn_energy += 0.5 * mass * velocity.norm_squared();
        }
        assert!((drawn - momentum).norm() <= 1e-3 * momentum.norm(), "{drawn} {momentum}");
        assert!((drawn_energy / energy - 1.0).abs() <= 1e-3, "{drawn_energy} {energy}");
    }
}

/// A force on a body at rest moves the center of mass as Newton says, wherever it acts.
#[test]
fn steady_force_accelerates_the_center_of_mass() {
    let model = random_plant(9, 4);
    let free = FreeModes::new(&model, &parameters(&model, 0.1), DT).expect("a valid scene");
    let mut state = free.at_rest();
    let force = Vector3::new(3.0, -1.0, 2.0);
    let mass: f64 = model.domains.iter().map(|domain| domain.inertia.as_ref().expect("an inertia").rigid[(0, 0)]).sum();
    for step in 1..=120 {
        // The axes of the body turn.
        let rotation = free.middle_rotations(&state)[0];
        let mut loads = DomainLoads::none(&model);
        loads.add_force(&model, 8, &model.domains[8].samples[20], &(rotation.inverse() * force));
        free.advance(&mut state, &free.reduce(&loads)).expect("a step");
        let time = DT * f64::from(step);
        let expected = force * (0.5 * time * time / mass);
        let displacement = state.bodies[0].displacement();
        assert!((displacement - expected).norm() <= 1e-2 * expected.norm(), "{time} s: {displacement} {expected}");
    }
    let turned = state.bodies[0].rotation().angle();
    assert!(turned > 0.05, "expected the force to turn the body, got {turned} radians");
}

/// A symmetric top precesses in its own axes with the rate (J3 - J1) / J1 w3.
#[test]
fn symmetric_top_precesses() {
    let model = rigid_body(1.0, [1.0, 1.0, 1.5]);
    let error = |steps: u32| {
        let dt = 1.0 / f64::from(steps);
        let free = FreeModes::new(&model, &parameters(&model, 0.0), dt).expect("a valid scene");
        let mut state = free.at_rest();
        let zero = Vector3::zeros();
        let spin = Vector3::new(0.5, 0.0, 4.0);
        state.bodies[0] = RigidState::new(&zero, &zero, &UnitQuaternion::identity(), &spin);
        let momentum = split(&free.momentum(&state)).1;
        advance(&free, &mut state, &no_load(&free, &model), steps);
        let angle: f64 = 0.5 * 4.0;
        let expected = Vector3::new(0.5 * angle.cos(), 0.5 * angle.sin(), 4.0);
        // The axis of the top turns about the angular momentum by |l| / J1 per second.
        let axis = state.bodies[0].rotation() * Vector3::z();
        let about = nalgebra::Unit::new_normalize(momentum);
        let turned = nalgebra::Rotation3::from_axis_angle(&about, momentum.norm()) * Vector3::z();
        (state.bodies[0].angular_velocity() - expected).norm().max((axis - turned).norm())
    };
    let errors = [error(200), error(400), error(800)];
    assert!(errors[2] <= 1e-4, "{errors:?}");
    assert!(errors.windows(2).all(|pair| (3.8..4.2).contains(&(pair[0] / pair[1]))), "second order: {errors:?}");
}

/// Stiff modes, fast spins, heavy and light bodies, and steps of all sizes.
#[test]
fn extreme_bodies_conserve_momenta_and_energy() {
    let branch = |hertz: f64, mass: f64| Branch { rank: 3, length: 1.0, mass, hertz };
    for (hertz, mass) in [(1e9, 1.0), (1e-3, 1.0), (1.0, 1e9), (1.0, 1e-9)] {
        let model = create_scene(&[branch(hertz, mass)], &[None], 6);
        for (dt, spin) in [(DT, 1.0), (DT, 100.0), (10.0, 0.1), (1e-6, 1e5)] {
            let free = FreeModes::new(&model, &parameters(&model, 0.0), dt).expect("a valid scene");
            let mut state = random_state(&free, 2, 0.0, spin);
            let (momentum, energy) = (free.momentum(&state), free.energy(&model, &state));
            advance(&free, &mut state, &no_load(&free, &model), 200);
            let momentum_error = {
                let angular = |momentum: &Vector6<f64>| split(momentum).1;
                let distance = state.bodies[0].displacement().norm() * split(&momentum).0.norm();
                let change = angular(&free.momentum(&state)) - angular(&momentum);
                change.norm() / (angular(&momentum).norm() + distance)
            };
            let energy_error = (free.energy(&model, &state) / energy - 1.0).abs();
            assert!(momentum_error <= 1e-9, "{hertz} Hz, {mass} kg, dt {dt}, spin {spin}: {momentum_error:e}");
            assert!(energy_error <= 1e-7, "{hertz} Hz, {mass} kg, dt {dt}, spin {spin}: {energy_error:e}");
        }
        // Many turns per step have a solution that conserves the energy, or are an error.
        for (dt, spin) in [(DT, 1e5), (10.0, 100.0)] {
            let free = FreeModes::new(&model, &parameters(&model, 0.0), dt).expect("a valid scene");
            let mut state = random_state(&free, 2, 0.0, spin);
            let energy = free.energy(&model, &state);
            let load = no_load(&free, &model);
            match (0..200).try_for_each(|_| free.advance(&mut state, &load)) {
                Ok(()) => assert!((free.energy(&model, &state) / energy - 1.0).abs() <= 1e-6, "dt {dt}, spin {spin}"),
                Err(error) => assert!(error.to_string().contains("choose smaller steps (--dt)"), "{error}"),
            }
        }
    }
}

#[test]
fn bodies_without_inertia_are_refused() {
    let error = |change: &dyn Fn(&mut Model)| {
        let mut model = random_plant(3, 1);
        change(&mut model);
        FreeModes::new(&model, &parameters(&model, 0.0), DT).err().expect("an error").to_string()
    };
    let none = error(&|model| model.domains.iter_mut().for_each(|domain| domain.inertia = None));
    assert!(none.contains("inertia of 'branch 0'") && none.contains("a mass of 0 kg"), "{none}");
    let point = error(&|model| {
        for domain in &mut model.domains {
            let inertia = domain.inertia.as_mut().expect("an inertia");
            (inertia.modal, inertia.coupling) = (inertia.modal.clone() * 0.0, vec![Vector6::zeros(); domain.rank]);
            inertia.rigid.fill(0.0);
        }
        let rigid = &mut model.domains[0].inertia.as_mut().expect("an inertia").rigid;
        (0..3).for_each(|axis| rigid[(axis, axis)] = 1.0);
    });
    assert!(point.contains("inertia of 'branch 0'") && point.contains("principal moments"), "{point}");
    // Domains whose coordinates another body has.
    let shared = error(&|model| {
        let mut copy = model.domains[0].clone();
        (copy.owns_q, copy.name) = (false, "copy".into());
        model.domains.push(copy);
    });
    assert!(shared.contains("domain 'copy', which shares coordinates"), "{shared}");
}

/// A steady load deforms a damped body as if it were held by its own inertia.
#[test]
fn deforming_forces_are_free_of_rigid_accelerations() {
    let model = random_plant(9, 4);
    let free = FreeModes::new(&model, &parameters(&model, 0.7), 0.05).expect("a valid scene");
    let mut loads = DomainLoads::none(&model);
    // Without a moment about the center of mass, the body does not turn.
    loads.wrenches[0] = stack(&Vector3::new(1e-3, 2e-3, 0.0), &Vector3::zeros());
    let wrench = split(&loads.wrenches[0]).0;
    let center = free.center(0) - model.domains[0].placement.translation;
    loads.wrenches[0] = stack(&wrench, &center.cross(&wrench));
    let load = free.reduce(&loads);
    let deforming = free.deforming_forces(&load);
    let mut state = free.at_rest();
    advance(&free, &mut state, &load, 8000);
    let modes = parameters(&model, 0.7).modes;
    let expected = DVector::from_fn(deforming.len(), |index, _| {
        modes[index].map_or(0.0, |mode| deforming[index] / mode.eigenvalue)
    });
    assert!((&state.motion.q - &expected).amax() <= 1e-6 * expected.amax(), "{} {expected}", state.motion.q);
    let spin = state.bodies[0].angular_velocity().norm();
    assert!(expected.amax() > 1e-9 && spin <= 1e-9, "expected a deformation without a spin, got {spin}");
}
