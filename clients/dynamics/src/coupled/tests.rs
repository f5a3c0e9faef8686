use nalgebra::{DMatrix, DVector, Vector3};

use super::testing::{Branch, Random, create_scene, inertia_of_samples, point_masses, random_plant};
use super::*;
use crate::affine::AffineTransform;
use crate::hierarchy::compute_transforms;
use crate::loads::DomainLoads;
use crate::model::{DomainModel, FollowedDomain};
use crate::oscillator::{ModeState, Oscillator};

fn parameters(model: &Model, damping_ratio: f64) -> ModalParameters {
    let mut parameters = ModalParameters::read(model).expect("valid parameters");
    parameters.modes.iter_mut().flatten().for_each(|mode| mode.damping_ratio = damping_ratio);
    parameters
}

/// The stiffness of every coordinate.
fn stiffness(parameters: &ModalParameters) -> DVector<f64> {
    DVector::from_iterator(
        parameters.modes.len(),
        parameters.modes.iter().map(|mode| mode.map_or(0.0, |m| m.eigenvalue)),
    )
}

fn random_q(model: &Model, seed: u64, amplitude: f64) -> DVector<f64> {
    let mut random = Random::new(seed);
    DVector::from_fn(model.coordinate_count, |_, _| amplitude * random.next())
}

/// The velocities of all point masses per unit rate of each coordinate, from the drawn transforms: a row per component,
/// multiplied by the square root of the mass. The product of the matrix with its transpose is the mass matrix.
fn drawn_velocities(model: &Model) -> DMatrix<f64> {
    let positions = |q: &[f64]| -> Vec<f64> {
        let transforms = compute_transforms(model, q, &[]);
        let domains = model.domains.iter().zip(&transforms);
        domains
            .flat_map(|(domain, transform)| {
                let (samples, mass) = point_masses(domain);
                let position = |sample: &crate::model::Sample| {
                    let position = transform.apply(&sample.deformed_position(domain.q(q))) * mass.sqrt();
                    [position.x, position.y, position.z]
                };
                samples.iter().flat_map(position).collect::<Vec<f64>>()
            })
            .collect()
    };
    let displaced = |coordinate: usize, step: f64| {
        let mut q = vec![0.0; model.coordinate_count];
        q[coordinate] = step;
        DVector::from_vec(positions(&q))
    };
    let step = 1e-5;
    let columns: Vec<DVector<f64>> = (0..model.coordinate_count)
        .map(|coordinate| (displaced(coordinate, step) - displaced(coordinate, -step)) / (2.0 * step))
        .collect();
    DMatrix::from_columns(&columns)
}

/// Advances a free motion.
fn advance_freely(modes: &CoupledModes, state: &mut MotionState, steps: u64) {
    let none = DVector::zeros(state.q.len());
    for _ in 0..steps {
        modes.advance(state, LoadChange { start: &none, end: &none }).expect("a step");
    }
}

/// A plant with a rigid branch that carries another one, a follower, and a domain that shares the coordinates of the
/// domain that it follows.
fn irregular_plant() -> Model {
    let branch = |rank: usize| Branch { rank, length: 1.0, mass: 3.0, hertz: 1.0 };
    let branches = [branch(5), branch(0), branch(4), branch(3), branch(6), branch(0), branch(5)];
    let parents = [None, Some(0), Some(1), Some(0), Some(2), Some(4), None];
    let mut model = create_scene(&branches, &parents, 11);
    let leader_from_follower = AffineTransform {
        translation: Vector3::new(0.3, 0.1, -0.2),
        ..AffineTransform::rotation_about(&Vector3::z(), 0.4, &Vector3::zeros())
    };
    let follow = |leader: usize, domain: &mut DomainModel, placement: AffineTransform| {
        domain.joint = None;
        domain.follow = Some(FollowedDomain { leader, leader_from_follower });
        domain.placement = placement.compose(&leader_from_follower);
    };
    let placement = model.domains[2].placement;
    // Domain 3 follows domain 2, with coordinates of its own.
    follow(2, &mut model.domains[3], placement);
    // A copy of domain 4 follows it and shares its coordinates.
    let mut copy = model.domains[4].clone();
    let placement = copy.placement;
    follow(4, &mut copy, placement);
    copy.owns_q = false;
    model.domains.push(copy);
    model
}

/// One step from rest gives the accelerations, which the drawn motion determines as well.
#[test]
fn step_equals_the_dense_equations_of_the_drawn_motion() {
    for (model, damping_ratio, dt) in
        [(random_plant(9, 1), 0.0, 0.02), (random_plant(14, 2), 0.3, 0.1), (irregular_plant(), 0.05, 1e-3)]
    {
        let parameters = parameters(&model, damping_ratio);
        let modes = CoupledModes::new(&model, &parameters, dt).expect("a valid scene");
        let velocities = drawn_velocities(&model);
        let stiffness = stiffness(&parameters);
        let damping = stiffness.map(|eigenvalue| 2.0 * damping_ratio * eigenvalue.sqrt());
        let matrix = velocities.transpose() * &velocities
            + DMatrix::from_diagonal(&(&damping * (0.5 * dt) + &stiffness * (0.25 * dt * dt)));
        let (q, v, force) = (random_q(&model, 3, 0.1), random_q(&model, 4, 1.0), random_q(&model, 5, 50.0));
        let right_side = &force - damping.component_mul(&v) - stiffness.component_mul(&(&q + &v * (0.5 * dt)));
        let expected = matrix.cholesky().expect("a positive definite matrix").solve(&right_side);
        let mut state = MotionState { v: v.clone(), ..MotionState::resting(q.clone()) };
        modes.advance(&mut state, LoadChange { start: &force, end: &force }).expect("a step");
        let acceleration = (&state.v - &v) / dt;
        assert!((&acceleration - &expected).amax() <= 1e-6 * expected.amax(), "{acceleration} {expected}");
        assert!((&state.q - (&q + (&v + &state.v) * (0.5 * dt))).amax() <= 1e-12, "the midpoint rule");
        // Control: modes that do not act on each other.
        let mut apart = model.clone();
        apart.domains.iter_mut().for_each(|domain| (domain.joint, domain.follow) = (None, None));
        let modes = CoupledModes::new(&apart, &parameters, dt).expect("a valid scene");
        let mut state = MotionState { v: v.clone(), ..MotionState::resting(q) };
        modes.advance(&mut state, LoadChange { start: &force, end: &force }).expect("a step");
        assert!(((&state.v - &v) / dt - &expected).amax() > 1e-2 * expected.amax(), "control");
    }
}

#[test]
fn forces_on_material_do_the_work_of_the_drawn_motion() {
    let model = irregular_plant();
    let tree = JointTree::new(&model).expect("a valid scene");
    let mut random = Random::new(8);
    for domain in 0..model.domains.len() {
        let sample = &model.domains[domain].samples[random.index(30)];
        let force = random.vector();
        let mut loads = DomainLoads::none(&model);
        loads.add_force(&model, domain, sample, &force);
        let forces = tree.reduce(&loads);
        for (coordinate, reduced) in forces.iter().enumerate() {
            let position = |step: f64| {
                let mut q = vec![0.0; model.coordinate_count];
                q[coordinate] = step;
                let transform = compute_transforms(&model, &q, &[])[domain];
                transform.apply(&sample.deformed_position(model.domains[domain].q(&q)))
            };
            let work = (position(1e-5) - position(-1e-5)).dot(&force) / 2e-5;
            assert!((reduced - work).abs() <= 1e-7, "domain {domain}, q[{coordinate}]: {reduced} {work}");
        }
        assert!(domain == 0 || domain == 6 || forces[..5].iter().any(|force| force.abs() > 1e-3), "{forces:?}");
    }
}

/// The error of the midpoint rule is of second order.
#[test]
fn single_domain_converges_to_the_exact_oscillator() {
    let branch = Branch { rank: 3, length: 1.0, mass: 2.0, hertz: 1.0 };
    let mut model = create_scene(&[branch], &[None], 4);
    model.domains[0].inertia = None;
    let parameters = parameters(&model, 0.05);
    let end_force = DVector::from_vec(vec![3.0, -2.0, 1.0]);
    let error = |steps: u32| {
        let dt = 1.0 / f64::from(steps);
        let modes = CoupledModes::new(&model, &parameters, dt).expect("a valid scene");
        let mut state = MotionState::resting(DVector::from_vec(vec![0.1, 0.2, -0.3]));
        for step in 0..steps {
            let load = |step: u32| &end_force * (f64::from(step) / f64::from(steps));
            let (start, end) = (load(step), load(step + 1));
            modes.advance(&mut state, LoadChange { start: &start, end: &end }).expect("a step");
        }
        let exact = |(mode, q): (usize, f64)| {
            let parameters = parameters.modes[mode].expect("a mode");
            let oscillator = Oscillator::new(parameters.eigenvalue, parameters.damping_ratio, 1.0).expect("a mode");
            let end = oscillator.advance(ModeState { q, v: 0.0 }, 0.0, end_force[mode]);
            (state.q[mode] - end.q).abs()
        };
        [0.1, 0.2, -0.3].into_iter().enumerate().map(exact).fold(0.0, f64::max)
    };
    let errors = [error(500), error(1000), error(2000)];
    assert!(errors[2] <= 2e-5, "{errors:?}");
    assert!(errors.windows(2).all(|pair| (3.9..4.1).contains(&(pair[0] / pair[1]))), "{errors:?}");
}

#[test]
fn undamped_plant_conserves_energy() {
    let model = random_plant(24, 5);
    let parameters = parameters(&model, 0.0);
    for dt in [1.0 / 60.0, 2.0] {
        let modes = CoupledModes::new(&model, &parameters, dt).expect("a valid scene");
        let mut state = MotionState::resting(random_q(&model, 6, 0.01));
        let start = modes.energy(&model, &state);
        let mut drift = 0.0_f64;
        for _ in 0..40 {
            advance_freely(&modes, &mut state, 25);
            drift = drift.max((modes.energy(&model, &state) / start - 1.0).abs());
        }
        assert!(drift <= 1e-11, "dt {dt}: {drift}");
    }
    // Control: damping.
    let modes = CoupledModes::new(&model, &self::parameters(&model, 1e-4), 1.0 / 60.0).expect("a valid scene");
    let mut state = MotionState::resting(random_q(&model, 6, 0.01));
    let start = modes.energy(&model, &state);
    advance_freely(&modes, &mut state, 1000);
    assert!(modes.energy(&model, &state) < (1.0 - 1e-3) * start);
}

#[test]
#[ignore = "the long run of the test above"]
fn undamped_plant_conserves_energy_over_a_hundred_thousand_steps() {
    let model = random_plant(60, 5);
    let modes = CoupledModes::new(&model, &parameters(&model, 0.0), 1.0 / 60.0).expect("a valid scene");
    let mut state = MotionState::resting(random_q(&model, 6, 0.01));
    let start = modes.energy(&model, &state);
    let mut drift = 0.0_f64;
    for _ in 0..100 {
        advance_freely(&modes, &mut state, 1000);
        drift = drift.max((modes.energy(&model, &state) / start - 1.0).abs());
    }
    println!("{} coordinates, 1e5 steps: largest relative drift {drift:e}", model.coordinate_count);
    assert!(drift <= 1e-9, "{drift}");
}

/// c(A, B), the displacement at A in the direction a under a unit force at B in the direction b, equals c(B, A).
#[test]
fn static_compliances_are_reciprocal() {
    let model = random_plant(40, 9);
    let system = StaticSystem::new(&model, &parameters(&model, 0.03)).expect("a valid scene");
    let mut random = Random::new(1);
    let mut points = || (random.index(model.domains.len()), random.index(30), random.vector().normalize());
    // `transmits` leaves out the moment that a force has about the joints, as a control.
    let compliance = |at: &(usize, usize, Vector3<f64>), of: &(usize, usize, Vector3<f64>), has_moment: bool| {
        let mut loads = DomainLoads::none(&model);
        loads.add_force(&model, of.0, &model.domains[of.0].samples[of.1], &of.2);
        if !has_moment {
            loads.wrenches[of.0].fixed_rows_mut::<3>(3).fill(0.0);
        }
        let response = system.solve(&loads);
        response.displacement(&model, at.0, &model.domains[at.0].samples[at.1]).dot(&at.2)
    };
    let (mut largest, mut control) = (0.0_f64, 0.0_f64);
    for _ in 0..100 {
        let (a, b) = (points(), points());
        let scale = (compliance(&a, &a, true) * compliance(&b, &b, true)).sqrt().max(f64::MIN_POSITIVE);
        largest = largest.max((compliance(&a, &b, true) - compliance(&b, &a, true)).abs() / scale);
        control = control.max((compliance(&a, &b, false) - compliance(&b, &a, false)).abs() / scale);
    }
    assert!(largest <= 1e-9, "{largest}");
    assert!(control > 1e-3, "control: {control}");
}

/// A pull that would bend a twig several times around is scaled; a small one is not.
#[test]
fn viewer_forces_are_limited_by_the_bending_of_the_pulled_twig() {
    let branch = |length: f64, mass: f64| Branch { rank: 3, length, mass, hertz: 2.0 };
    let model = create_scene(&[branch(10.0, 500.0), branch(0.3, 0.001)], &[None, Some(0)], 2);
    let system = StaticSystem::new(&model, &parameters(&model, 0.03)).expect("a valid scene");
    let scale = |newtons: f64| {
        let mut loads = DomainLoads::none(&model);
        loads.add_force(&model, 1, &model.domains[1].samples[24], &(Vector3::x() * newtons));
        let forces = system.joints().reduce(&loads);
        let scale = system.viewer_force_scale(&model, &forces);
        let q = system.solve_reduced(&forces);
        let bending: f64 = (0..3).map(|mode| q[3 + mode].abs() * model.domains[1].displacement_per_unit(mode)).sum();
        (scale, scale * bending / model.domains[1].diagonal)
    };
    assert_eq!(scale(1e-6).0, 1.0);
    let (factor, bending) = scale(10.0);
    assert!(factor < 0.1 && (bending - 0.5).abs() <= 1e-9, "{factor} {bending}");
    // Control: the same force on the trunk bends it by less.
    let mut loads = DomainLoads::none(&model);
    loads.add_force(&model, 0, &model.domains[0].samples[24], &(Vector3::x() * 10.0));
    assert_eq!(system.viewer_force_scale(&model, &system.joints().reduce(&loads)), 1.0);
    assert_eq!(system.viewer_force_scale(&model, &[f64::INFINITY; 6]), 0.0);
}

/// A damped motion under a constant load ends at the static response.
#[test]
fn motion_ends_at_the_static_response() {
    let model = random_plant(12, 3);
    let parameters = parameters(&model, 0.5);
    let mut loads = DomainLoads::none(&model);
    loads.add_force(&model, 11, &model.domains[11].samples[26], &Vector3::new(0.01, -0.02, 0.01));
    let system = StaticSystem::new(&model, &parameters).expect("a valid scene");
    let expected = DVector::from_vec(system.solve(&loads).q);
    let load = DVector::from_vec(system.joints().reduce(&loads));
    let modes = CoupledModes::new(&model, &parameters, 0.05).expect("a valid scene");
    let mut state = MotionState::resting(DVector::zeros(model.coordinate_count));
    for _ in 0..4000 {
        modes.advance(&mut state, LoadChange { start: &load, end: &load }).expect("a step");
    }
    assert!((&state.q - &expected).amax() <= 1e-6 * expected.amax(), "{} {expected}", state.q);
}

/// Pools of one and four threads compute the same bits.
#[test]
fn results_do_not_depend_on_the_number_of_threads() {
    let branch = |index: usize| Branch { rank: index % 5, length: 0.3, mass: 0.1, hertz: 2.0 };
    let branches: Vec<Branch> =
        std::iter::once(Branch { rank: 6, length: 2.0, mass: 9.0, hertz: 1.0 }).chain((1..900).map(branch)).collect();
    let parents: Vec<Option<usize>> = (0..900).map(|index| (index > 0).then_some(0)).collect();
    let model = create_scene(&branches, &parents, 2);
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a thread pool");
        pool.install(|| {
            let modes = CoupledModes::new(&model, &parameters(&model, 0.02), 0.01).expect("a valid scene");
            let mut state = MotionState::resting(random_q(&model, 7, 0.1));
            advance_freely(&modes, &mut state, 5);
            state.q.iter().chain(&state.v).map(|number| number.to_bits()).collect::<Vec<u64>>()
        })
    };
    assert_eq!(run(1), run(4));
}

/// Chains, stars, heavy and light domains, and steps of all sizes. Without damping, the energy stays.
#[test]
fn extreme_scenes_conserve_energy() {
    let chain = |index: usize| (index > 0).then(|| index - 1);
    let star = |index: usize| (index > 0).then_some(0);
    let light = |_: usize| 1.0;
    let alternating = |index: usize| if index.is_multiple_of(2) { 1e6 } else { 1e-6 };
    type Numbers<'a> = &'a dyn Fn(usize) -> f64;
    type Parents<'a> = &'a dyn Fn(usize) -> Option<usize>;
    let cases: [(usize, Parents<'_>, Numbers<'_>); 4] =
        [(10_000, &chain, &light), (3000, &star, &light), (12, &chain, &alternating), (40, &star, &alternating)];
    for (count, parent, mass) in cases {
        let branch = |index: usize| Branch { rank: 2, length: 0.1, mass: mass(index), hertz: 3.0 };
        let branches: Vec<Branch> = (0..count).map(branch).collect();
        let model = create_scene(&branches, &(0..count).map(parent).collect::<Vec<_>>(), 3);
        for dt in [1e-6, 1.0 / 60.0, 10.0] {
            let modes = CoupledModes::new(&model, &parameters(&model, 0.0), dt).expect("a valid scene");
            let mut state = MotionState::resting(random_q(&model, 1, 1e-3));
            let start = modes.energy(&model, &state);
            advance_freely(&modes, &mut state, 20);
            let ratio = modes.energy(&model, &state) / start;
            assert!((ratio - 1.0).abs() <= 1e-6, "{count} domains of mass {}, dt {dt}: {ratio}", mass(0));
        }
    }
}

#[test]
fn domains_without_inertia_and_held_modes_move_as_massless_frames() {
    let branch = |rank: usize| Branch { rank, length: 1.0, mass: 1.0, hertz: 1.0 };
    let mut model = create_scene(&[branch(3), branch(3), branch(3)], &[None, Some(0), Some(1)], 5);
    model.domains[1].inertia = None;
    model.domains[2].eigenvalues.clear();
    let parameters = parameters(&model, 0.0);
    let modes = CoupledModes::new(&model, &parameters, 0.02).expect("a valid scene");
    let mut state = MotionState::resting(random_q(&model, 2, 0.1));
    // A held mode does not move.
    state.q.rows_mut(6, 3).fill(0.0);
    let start = modes.energy(&model, &state);
    advance_freely(&modes, &mut state, 500);
    assert!((modes.energy(&model, &state) / start - 1.0).abs() <= 1e-11);
    assert_eq!(state.q.rows(6, 3).amax(), 0.0);
    assert!(state.q.rows(0, 6).amin() > 1e-6, "{}", state.q);
    // A heavier leaf slows the trunk down.
    let first_acceleration = |mass: f64| {
        let mut model = model.clone();
        model.domains[2].inertia = Some(inertia_of_samples(&model.domains[2], mass));
        let modes = CoupledModes::new(&model, &parameters, 1e-6).expect("a valid scene");
        let mut state = MotionState::resting(DVector::zeros(9));
        let load = DVector::from_vec(vec![1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
        modes.advance(&mut state, LoadChange { start: &load, end: &load }).expect("a step");
        state.v[0]
    };
    assert!(first_acceleration(100.0) < 0.9 * first_acceleration(1.0));
}

/// Mass, center, moments, momenta and masses of a description are the matrices of point masses.
#[test]
fn inertia_of_a_description_is_that_of_its_point_masses() {
    let branch = Branch { rank: 4, length: 1.3, mass: 2.5, hertz: 1.0 };
    let domain = branch.create(&mut Random::new(6));
    let expected = domain.inertia.expect("an inertia");
    let masses: Vec<&crate::model::Sample> = domain.samples[..domain.surface_sample_count].iter().collect();
    let mass = branch.mass / masses.len() as f64;
    let sum = |value: &dyn Fn(&Vector3<f64>) -> f64| -> f64 {
        masses.iter().map(|sample| mass * value(&sample.rest_position)).sum()
    };
    let center = [0, 1, 2].map(|axis| sum(&|point| point[axis]) / branch.mass);
    let product = |a: usize, b: usize| -sum(&|point| point[a] * point[b]);
    let moment = |axis: usize| sum(&|point| point.norm_squared() - point[axis] * point[axis]);
    let moments = [moment(0), moment(1), moment(2), product(0, 1), product(0, 2), product(1, 2)];
    let momenta = (0..6).flat_map(|row| expected.coupling.iter().map(move |column| column[row])).collect();
    let modal_masses = expected.modal.transpose().iter().copied().collect();
    let description =
        modalcast_client::Inertia { mass: branch.mass, center, moments, modal_momenta: momenta, modal_masses };
    let inertia = crate::model::DomainInertia::new(4, &description);
    assert!((inertia.rigid - expected.rigid).amax() <= 1e-12, "{} {}", inertia.rigid, expected.rigid);
    assert_eq!((inertia.coupling, inertia.modal), (expected.coupling, expected.modal));
}

#[test]
fn invalid_scenes_are_rejected() {
    let error = |change: &dyn Fn(&mut Model)| {
        let mut model = irregular_plant();
        change(&mut model);
        let parameters = parameters(&model, 0.03);
        CoupledModes::new(&model, &parameters, 0.1).err().expect("an error").to_string()
    };
    let message = error(&|model| {
        // The last domain shares the coordinates of domain 4, but follows domain 2.
        model.domains[7].follow.as_mut().expect("a follower").leader = 2;
    });
    assert!(message.contains("'branch 4', which shares") && message.contains("'branch 2'"), "{message}");
    let message = error(&|model| model.domains[2].placement.linear *= 2.0);
    assert!(message.contains("placement of 'branch 2'"), "{message}");
    let message = error(&|model| model.domains[2].inertia.as_mut().expect("an inertia").coupling.truncate(3));
    assert!(message.contains("inertia of 'branch 2'") && message.contains("4 modes"), "{message}");
    let message = error(&|model| model.domains[2].inertia.as_mut().expect("an inertia").modal[(1, 1)] = -1e6);
    assert!(message.contains("inertia of 'branch 2'") && message.contains("positive energy"), "{message}");
    let message = error(&|model| model.domains[2].inertia.as_mut().expect("an inertia").modal[(1, 1)] = f64::NAN);
    assert!(message.contains("inertia of 'branch 2'"), "{message}");
    // A domain that follows a root does not move, so it may share any coordinates.
    let mut model = irregular_plant();
    model.domains[7].follow.as_mut().expect("a follower").leader = 0;
    CoupledModes::new(&model, &parameters(&model, 0.0), 0.1).expect("a valid scene");
    let model = irregular_plant();
    for dt in [0.0, f64::NAN, f64::INFINITY] {
        assert!(CoupledModes::new(&model, &parameters(&model, 0.0), dt).is_err(), "{dt}");
    }
}

/// A plant of `shoots` shoots of 12 to 30 modes, each with leaves of three modes, `leaves` in all.
fn shoots_and_leaves(shoots: usize, leaves: usize) -> Model {
    let mut random = Random::new(3);
    let mut parents: Vec<Option<usize>> =
        (0..shoots).map(|index| (index > 0).then(|| random.index(index).max(index / 3))).collect();
    parents.extend((0..leaves).map(|leaf| Some(leaf % shoots)));
    let branch = |index: usize| match index < shoots {
        true => Branch { rank: 12 + index * 19 / shoots, length: 0.5, mass: 0.3, hertz: 1.5 },
        false => Branch { rank: 3, length: 0.06, mass: 5e-4, hertz: 4.0 },
    };
    create_scene(&(0..parents.len()).map(branch).collect::<Vec<_>>(), &parents, 3)
}

#[test]
#[ignore = "measures times; run it alone, and optimized"]
fn measure_steps_per_second() {
    use crate::run::Scenario as _;
    let run = |model: &Model, steps: u32| {
        let options = crate::tree::TreeOptions { dt: 1.0 / 60.0, wind_speed: 4.0, direction_radians: 0.4, seed: 7 };
        let mut tree = crate::tree::TreeScenario::new(model.clone(), options).expect("a valid scenario");
        let mut values = crate::step_values::StepValues::default();
        (0..20).for_each(|_| tree.compute_next_step(&mut values).expect("a step"));
        let start = std::time::Instant::now();
        (0..steps).for_each(|_| tree.compute_next_step(&mut values).expect("a step"));
        f64::from(steps) / start.elapsed().as_secs_f64()
    };
    let solve = |model: &Model, steps: u32| {
        let modes = CoupledModes::new(model, &parameters(model, 0.03), 1.0 / 60.0).expect("a valid scene");
        let mut state = MotionState::resting(random_q(model, 1, 1e-3));
        advance_freely(&modes, &mut state, 10);
        let start = std::time::Instant::now();
        advance_freely(&modes, &mut state, steps.into());
        start.elapsed().as_secs_f64() / f64::from(steps)
    };
    let model = shoots_and_leaves(139, 1308);
    println!(
        "{} domains, {} coordinates: {:.0} steps/s, {:.3} ms in the equations",
        model.domains.len(),
        model.coordinate_count,
        run(&model, 400),
        1e3 * solve(&model, 1000)
    );
    for shoots in [10, 100, 1000] {
        let model = shoots_and_leaves(shoots, 9 * shoots);
        let count = model.domains.len() as f64;
        let steps = 100_000 / shoots as u32;
        println!(
            "{count} domains: {:.3} us per domain and step, {:.3} us in the equations",
            1e6 / count / run(&model, steps / 10),
            1e6 / count * solve(&model, steps / 5)
        );
    }
}
