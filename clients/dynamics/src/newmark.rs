//! Implicit time integration of the reduced equations of motion q'' + D q' + s f(q) = load, by Newmark's method with
//! average acceleration (beta 1/4, gamma 1/2; Newmark 1959). D is the damping matrix and s the scale of the force.
//! Newton's method with the analytic Jacobian solves each step.
//!
//! The reduced mass is the identity, and V is the potential of f. Each step minimizes the objective
//!
//! ```text
//! c/2 |q - q_p|^2 + 1/(2 d) v(q)^T D v(q) + s V(q) - load . q,    v(q) = v_p + d (q - q_p)
//! ```
//!
//! with the predictors q_p and v_p of the step and the constants c = 4 / h^2 and d = 2 / h for a step of h seconds.
//! Where the gradient of the objective is 0, Newmark's equation holds. A static solution has c = d = 0 and no damping
//! term. A line search along Newton's direction ensures that the objective decreases, so the iteration cannot diverge.
//!
//! Average acceleration conserves the energy of a linear system exactly and that of a nonlinear system approximately.
//! The energy error is the spurious gain accumulated over the steps. It may not exceed `ENERGY_TOLERANCE` times the
//! highest energy so far. A step that would exceed this bound is repeated with backward Euler (c = 1 / h^2, d = 1 / h).
//! The velocity after the repeated step is scaled down if its energy exceeds the previous energy plus the work of the
//! load. The solution therefore stays bounded at any step size.

use nalgebra::{Cholesky, DMatrix, DVector};

use crate::cubic::ReducedForce;
use crate::error::{Result, invalid_input};
use crate::vega::VegaSettings;

/// Maximum number of Newton steps per solve.
const MAX_NEWTON_STEPS: usize = 60;

/// Maximum number of step lengths that a line search tries. Each is half of the previous one.
const MAX_LINE_SEARCH_STEPS: usize = 50;

/// Maximum energy error, as a fraction of the highest energy so far. See the module documentation.
const ENERGY_TOLERANCE: f64 = 0.02;

/// Constant c1 of Armijo's condition for a sufficient decrease. 1e-4 is its usual value (Nocedal and Wright, Numerical
/// Optimization, 3.1).
const ARMIJO_CONSTANT: f64 = 1e-4;

/// Relative changes below this value are rounding errors: some hundred times the precision of f64.
const ROUNDING_TOLERANCE: f64 = 1e-13;

/// The reduced equations of motion: r coordinates, unit mass.
#[derive(Debug, Clone)]
pub struct ReducedSystem {
    force: ReducedForce,
    /// s, the square of Vega's base frequency.
    scale: f64,
    /// D = mass coefficient * I + stiffness coefficient * scaled stiffness at rest; r x r.
    damping: DMatrix<f64>,
}

/// The load at the start and at the end of a step. It changes linearly in between.
#[derive(Debug, Clone, Copy)]
pub struct LoadChange<'a> {
    pub start: &'a DVector<f64>,
    pub end: &'a DVector<f64>,
}

/// Coordinates, velocities and accelerations at one time.
#[derive(Debug, Clone, PartialEq)]
pub struct NewmarkState {
    pub q: DVector<f64>,
    pub v: DVector<f64>,
    a: DVector<f64>,
    /// Accumulated spurious energy gain.
    energy_error: f64,
    /// Highest energy so far.
    max_energy: f64,
}

/// The constants of the objective in the module documentation.
struct StepObjective<'a> {
    /// c, in 1/s^2.
    inertia_coefficient: f64,
    /// d, in 1/s.
    velocity_coefficient: f64,
    /// q_p.
    predicted_q: DVector<f64>,
    /// v_p.
    predicted_v: DVector<f64>,
    load: &'a DVector<f64>,
}

impl ReducedSystem {
    /// Creates a system with the frequency scale and the Rayleigh damping of Vega's settings.
    ///
    /// # Errors
    /// `Invalid` if the stiffness at rest is not positive definite.
    pub fn new(force: ReducedForce, settings: &VegaSettings) -> Result<Self> {
        let scale = settings.base_frequency * settings.base_frequency;
        let stiffness = (force.rest_stiffness() + force.rest_stiffness().transpose()) * (0.5 * scale);
        if Cholesky::new(stiffness.clone()).is_none() {
            let eigenvalue = stiffness.symmetric_eigenvalues().min();
            let given = format!("one with the eigenvalue {eigenvalue}");
            return Err(invalid_input("cub.linear", "a positive definite stiffness", given));
        }
        let identity = DMatrix::identity(force.rank(), force.rank());
        let damping = identity * settings.damping_mass + stiffness * settings.damping_stiffness;
        Ok(Self { force, scale, damping })
    }

    /// The number of coordinates r.
    pub const fn rank(&self) -> usize {
        self.force.rank()
    }

    /// Natural frequencies at rest in hertz, lowest first.
    pub fn frequencies(&self) -> Vec<f64> {
        let eigenvalues = (self.force.rest_stiffness() * self.scale).symmetric_eigenvalues();
        let mut hertz: Vec<f64> =
            eigenvalues.iter().map(|eigenvalue| eigenvalue.max(0.0).sqrt() / (2.0 * std::f64::consts::PI)).collect();
        hertz.sort_by(f64::total_cmp);
        hertz
    }

    /// The coordinates at rest under a load, with the stiffness of the shape at rest.
    pub fn linear_equilibrium(&self, load: &DVector<f64>) -> DVector<f64> {
        let stiffness = self.force.rest_stiffness() * self.scale;
        // A positive definite matrix, which always has a solution.
        stiffness.lu().solve(load).unwrap_or_else(|| DVector::zeros(self.rank()))
    }

    /// The state at rest, without load.
    pub fn rest_state(&self) -> NewmarkState {
        self.static_state(DVector::zeros(self.rank()))
    }

    /// The state at `q` with zero velocity and acceleration. The caller must apply a load under which
    /// `q` is in equilibrium.
    pub fn static_state(&self, q: DVector<f64>) -> NewmarkState {
        let zero = DVector::zeros(self.rank());
        let max_energy = self.scale * self.force.potential(&q);
        NewmarkState { q, v: zero.clone(), a: zero, energy_error: 0.0, max_energy }
    }

    /// The sum of kinetic and elastic energy.
    pub fn energy(&self, state: &NewmarkState) -> f64 {
        0.5 * state.v.norm_squared() + self.scale * self.force.potential(&state.q)
    }

    /// Solves for the equilibrium under a load, starting from `initial_guess`.
    pub fn solve_equilibrium(&self, load: &DVector<f64>, initial_guess: &DVector<f64>) -> DVector<f64> {
        let predicted_v = DVector::zeros(self.rank());
        let predicted_q = initial_guess.clone();
        let objective =
            StepObjective { inertia_coefficient: 0.0, velocity_coefficient: 0.0, predicted_q, predicted_v, load };
        self.minimize(&objective, initial_guess)
    }

    /// Whether `q` is a stable equilibrium under a load: the forces balance up to 1e-6 of the load, and the stiffness
    /// is positive semidefinite up to rounding.
    pub fn is_equilibrium(&self, load: &DVector<f64>, q: &DVector<f64>) -> bool {
        let residual = (self.force.force(q) * self.scale - load).norm();
        let jacobian = self.force.jacobian(q);
        let is_finite = q.iter().chain(jacobian.iter()).all(|number| number.is_finite());
        if !is_finite || residual > 1e-6 * load.norm() + f64::MIN_POSITIVE {
            return false;
        }
        let stiffness = (&jacobian + jacobian.transpose()) * 0.5;
        stiffness.symmetric_eigenvalues().min() >= -1e-9 * jacobian.abs().max()
    }

    /// Computes the state `dt` seconds later, under a changing load.
    #[must_use]
    pub fn advance(&self, state: &NewmarkState, dt: f64, load: LoadChange<'_>) -> NewmarkState {
        let LoadChange { start: start_load, end: end_load } = load;
        let next_state = self.step_average_acceleration(state, dt, end_load);
        // The expected energy after the step: the previous energy plus the work of the load minus the dissipation.
        let balanced_energy = |next_state: &NewmarkState| {
            let displacement = &next_state.q - &state.q;
            let work = 0.5 * (start_load + end_load).dot(&displacement);
            // The damping force D v times the displacement, at the mean velocity v = displacement / dt.
            let dissipated = (&self.damping * &displacement).dot(&displacement) / dt;
            self.energy(state) + work - dissipated
        };
        let energy_error = state.energy_error + self.energy(&next_state) - balanced_energy(&next_state);
        // The tolerance is relative to `max_energy`, so a spurious gain must not raise it.
        let max_energy = state.max_energy.max(self.energy(&next_state).min(balanced_energy(&next_state)));
        if energy_error <= ENERGY_TOLERANCE * max_energy {
            // Limit the negative error of steps that lose energy, so that it offsets only small later gains.
            let energy_error = energy_error.max(-ENERGY_TOLERANCE * max_energy);
            return NewmarkState { energy_error, max_energy, ..next_state };
        }
        let mut next_state = self.step_backward_euler(state, dt, end_load);
        // Backward Euler damps fast modes, but it can gain energy where the potential is not convex (buckling). Limit
        // the velocity so that the energy does not exceed the previous energy plus the work of the load.
        let available_energy = (self.energy(state) + end_load.dot(&(&next_state.q - &state.q))).max(0.0);
        let max_kinetic_energy = available_energy - self.scale * self.force.potential(&next_state.q);
        let speed = next_state.v.norm();
        if speed > 0.0 {
            next_state.v *= ((2.0 * max_kinetic_energy.max(0.0)).sqrt() / speed).min(1.0);
        }
        next_state.a = end_load - &self.damping * &next_state.v - self.force.force(&next_state.q) * self.scale;
        let max_energy = state.max_energy.max(self.energy(&next_state));
        // A repeated step resets a positive energy error. A negative one remains.
        NewmarkState { energy_error: state.energy_error.min(0.0), max_energy, ..next_state }
    }

    fn step_average_acceleration(&self, state: &NewmarkState, dt: f64, load: &DVector<f64>) -> NewmarkState {
        let (inertia_coefficient, velocity_coefficient) = (4.0 / (dt * dt), 2.0 / dt);
        // Newmark's predictors: q + h v + h^2 (1/2 - beta) a and v + h (1 - gamma) a.
        let predicted_q = &state.q + &state.v * dt + &state.a * (0.25 * dt * dt);
        let predicted_v = &state.v + &state.a * (0.5 * dt);
        let objective = StepObjective { inertia_coefficient, velocity_coefficient, predicted_q, predicted_v, load };
        let q = self.minimize(&objective, &state.q);
        let correction = &q - objective.predicted_q;
        let v = objective.predicted_v + &correction * velocity_coefficient;
        NewmarkState { q, v, a: correction * inertia_coefficient, ..*state }
    }

    /// Returns the new state with the acceleration of `state`. The caller computes the new acceleration.
    fn step_backward_euler(&self, state: &NewmarkState, dt: f64, load: &DVector<f64>) -> NewmarkState {
        let predicted_q = &state.q + &state.v * dt;
        let predicted_v = state.v.clone();
        let objective = StepObjective {
            inertia_coefficient: 1.0 / (dt * dt),
            velocity_coefficient: 1.0 / dt,
            predicted_q,
            predicted_v,
            load,
        };
        let q = self.minimize(&objective, &state.q);
        let v = (&q - &state.q) / dt;
        NewmarkState { q, v, ..state.clone() }
    }

    /// Minimizes the objective by Newton's method with a line search. Returns the last accepted point. Up to rounding,
    /// its objective does not exceed that of `initial_guess`.
    fn minimize(&self, objective: &StepObjective<'_>, initial_guess: &DVector<f64>) -> DVector<f64> {
        let mut q = initial_guess.clone();
        let mut objective_value = self.objective_value(objective, &q);
        for _ in 0..MAX_NEWTON_STEPS {
            let gradient = self.objective_gradient(objective, &q);
            let direction = self.newton_direction(objective, &q, &gradient);
            let slope = gradient.dot(&direction);
            let is_descent = slope < 0.0;
            if !is_descent {
                return q;
            }
            // Near the minimum, rounding hides the decrease, so a point with a smaller gradient is also accepted.
            let inertial_scale = objective.inertia_coefficient * (&q - &objective.predicted_q).norm_squared();
            let rounding_error = ROUNDING_TOLERANCE * (objective_value.abs() + inertial_scale);
            let mut step_length = 1.0;
            let accepted_point = (0..MAX_LINE_SEARCH_STEPS).find_map(|_| {
                let next_q = &q + &direction * step_length;
                let next_objective_value = self.objective_value(objective, &next_q);
                let satisfies_armijo = next_objective_value <= objective_value + ARMIJO_CONSTANT * step_length * slope;
                let reduces_gradient = next_objective_value <= objective_value + rounding_error
                    && self.objective_gradient(objective, &next_q).norm() < gradient.norm();
                step_length *= 0.5;
                (satisfies_armijo || reduces_gradient).then_some((next_q, next_objective_value))
            });
            let Some((next_q, next_objective_value)) = accepted_point else { return q };
            let has_converged = (&next_q - &q).norm() <= ROUNDING_TOLERANCE * next_q.norm().max(f64::MIN_POSITIVE);
            (q, objective_value) = (next_q, next_objective_value);
            if has_converged {
                return q;
            }
        }
        q
    }

    fn objective_value(&self, objective: &StepObjective<'_>, q: &DVector<f64>) -> f64 {
        let StepObjective { inertia_coefficient, velocity_coefficient, .. } = *objective;
        let correction = q - &objective.predicted_q;
        let static_term = self.scale * self.force.potential(q) - objective.load.dot(q);
        let v = &objective.predicted_v + &correction * velocity_coefficient;
        let damping_term =
            if velocity_coefficient > 0.0 { (&self.damping * &v).dot(&v) / (2.0 * velocity_coefficient) } else { 0.0 };
        0.5 * inertia_coefficient * correction.norm_squared() + damping_term + static_term
    }

    fn objective_gradient(&self, objective: &StepObjective<'_>, q: &DVector<f64>) -> DVector<f64> {
        let StepObjective { inertia_coefficient, velocity_coefficient, .. } = *objective;
        let correction = q - &objective.predicted_q;
        let static_term = self.force.force(q) * self.scale - objective.load;
        let damping_term = &self.damping * (&objective.predicted_v + &correction * velocity_coefficient);
        correction * inertia_coefficient
            + if velocity_coefficient > 0.0 { damping_term + static_term } else { static_term }
    }

    /// Newton's direction. The Hessian of a buckling system can be indefinite. A growing diagonal shift makes it
    /// positive definite.
    fn newton_direction(
        &self,
        objective: &StepObjective<'_>,
        q: &DVector<f64>,
        gradient: &DVector<f64>,
    ) -> DVector<f64> {
        let identity = DMatrix::<f64>::identity(self.rank(), self.rank());
        let jacobian = self.force.jacobian(q);
        let stiffness = (&jacobian + jacobian.transpose()) * (0.5 * self.scale);
        let hessian =
            &identity * objective.inertia_coefficient + &self.damping * objective.velocity_coefficient + stiffness;
        // After an attempt without shift, the shift grows from 1e-6 of the largest entry by a factor of 10 per attempt.
        let mut shift = 0.0;
        for _ in 0..40 {
            if let Some(cholesky) = Cholesky::new(&hessian + &identity * shift) {
                return -cholesky.solve(gradient);
            }
            shift = (10.0 * shift).max(1e-6 * hessian.abs().max());
        }
        // Fallback: the direction of steepest descent.
        -gradient
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cubic::tests::{data_folder, random_vector, spring_chain};

    /// omega^2 in (rad/s)^2 of a frequency in hertz.
    fn eigenvalue(hertz: f64) -> f64 {
        (2.0 * std::f64::consts::PI * hertz).powi(2)
    }

    fn constant_load(load: &DVector<f64>) -> LoadChange<'_> {
        LoadChange { start: load, end: load }
    }

    fn undamped_system(force: ReducedForce) -> ReducedSystem {
        ReducedSystem::new(force, &VegaSettings::default()).expect("a positive definite stiffness")
    }

    /// Two springs with the eigenvalues 40 and 90 (rad/s)^2. A quartic potential (30) couples and hardens them, a cubic
    /// one (4) makes them asymmetric.
    fn two_springs() -> ReducedForce {
        spring_chain(&[40.0, 90.0], 30.0, 4.0)
    }

    /// The coordinates from which [`two_springs`] is released.
    const RELEASED_Q: [f64; 2] = [0.8, -0.3];

    /// Deflects and releases [`two_springs`]. Returns the system and its state after one second.
    fn simulate_release(steps_per_second: u32) -> (ReducedSystem, NewmarkState) {
        let system = undamped_system(two_springs());
        let no_load = DVector::zeros(2);
        let dt = 1.0 / f64::from(steps_per_second);
        let mut state = system.static_state(DVector::from_column_slice(&RELEASED_Q));
        // The load that holds this state is released, so the initial acceleration is -f(q).
        state.a = -system.force.force(&state.q);
        let final_state =
            (0..steps_per_second).fold(state, |state, _| system.advance(&state, dt, constant_load(&no_load)));
        (system, final_state)
    }

    #[test]
    fn halving_the_step_quarters_the_error() {
        let reference = simulate_release(20_000).1;
        let error = |steps_per_second| (simulate_release(steps_per_second).1.q - &reference.q).norm();
        let errors = [error(100), error(200), error(400)];
        let ratios = [errors[0] / errors[1], errors[1] / errors[2]];
        assert!(ratios.iter().all(|ratio| (3.6..4.4).contains(ratio)), "expected ratios of 4, got {ratios:?}");
        assert!(errors[2] < 2e-3, "{errors:?}");
    }

    #[test]
    fn damping_alone_dissipates_energy() {
        let (system, final_state) = simulate_release(1000);
        let initial_energy = system.scale * system.force.potential(&DVector::from_column_slice(&RELEASED_Q));
        assert!(
            (system.energy(&final_state) / initial_energy - 1.0).abs() <= 1e-3,
            "{}",
            system.energy(&final_state) / initial_energy
        );
        let settings = VegaSettings { damping_mass: 0.5, damping_stiffness: 0.01, ..VegaSettings::default() };
        let damped_system = ReducedSystem::new(two_springs(), &settings).expect("a positive definite stiffness");
        let no_load = DVector::zeros(2);
        let mut state = damped_system.static_state(DVector::from_column_slice(&RELEASED_Q));
        for _ in 0..2000 {
            let next = damped_system.advance(&state, 0.01, constant_load(&no_load));
            assert!(damped_system.energy(&next) <= damped_system.energy(&state) * (1.0 + 1e-3) + 1e-12);
            state = next;
        }
        assert!(damped_system.energy(&state) < 1e-3 * initial_energy);
    }

    #[test]
    fn steady_load_converges_to_the_equilibrium() {
        let settings = VegaSettings { damping_mass: 4.0, ..VegaSettings::default() };
        let system = ReducedSystem::new(two_springs(), &settings).expect("a positive definite stiffness");
        let load = DVector::from_column_slice(&[12.0, -3.0]);
        let equilibrium = system.solve_equilibrium(&load, &DVector::zeros(2));
        assert!((system.force.force(&equilibrium) - &load).norm() <= 1e-9);
        let mut state = system.rest_state();
        for _ in 0..4000 {
            state = system.advance(&state, 0.02, constant_load(&load));
        }
        assert!((state.q - equilibrium).norm() <= 1e-6);
    }

    #[test]
    fn solution_stays_bounded_beyond_the_explicit_step_limit() {
        let hertz = [0.1, 1.0, 10.0, 1e3, 1e5];
        let eigenvalues: Vec<f64> = hertz.iter().map(|hertz| eigenvalue(*hertz)).collect();
        let system = undamped_system(spring_chain(&eigenvalues, 1e3, 0.2));
        for dt in [1e-3, 0.05, 1.0, 10.0] {
            // Explicit (central difference) integration is stable for omega dt < 2.
            assert!(
                dt * eigenvalues[4].sqrt() > 2.0 * 10.0,
                "control: expected ten times the stability limit of explicit integration"
            );
            let load = |step: u32| random_vector(u64::from(step), 5) * 0.5;
            let (mut state, mut work) = (system.rest_state(), 0.0_f64);
            for step in 0..3000 {
                let (start_load, end_load) = (load(step), load(step + 1));
                let next = system.advance(&state, dt, LoadChange { start: &start_load, end: &end_load });
                work += 0.5 * (start_load + end_load).dot(&(&next.q - &state.q)).abs();
                // The exact energy is at most the absolute work. The factor of 4 leaves room for the integration error.
                let energy = system.energy(&next);
                assert!(
                    energy.is_finite() && energy <= 4.0 * work + 1e-6,
                    "dt {dt}, step {step}: expected an energy of at most four times the absolute work {work}, got {energy}"
                );
                state = next;
            }
            assert!(state.q.norm() < 1e3, "dt {dt}: {}", state.q.norm());
        }
    }

    #[test]
    fn fast_initial_state_gains_no_energy_at_any_step_size() {
        let system = undamped_system(spring_chain(&[1.0, 7.0, 1e6], 50.0, 3.0));
        let no_load = DVector::zeros(3);
        for dt in [1e-3, 0.1, 1.0, 30.0] {
            for seed in 0..4 {
                let mut state = system.rest_state();
                state.v = random_vector(seed, 3) * 20.0;
                // The exact energy is constant. A gain of 10 percent has room for several times `ENERGY_TOLERANCE`.
                let limit = 1.1 * system.energy(&state);
                for step in 0..1500 {
                    state = system.advance(&state, dt, constant_load(&no_load));
                    let energy = system.energy(&state);
                    assert!(
                        energy <= limit,
                        "dt {dt}, seed {seed}, step {step}: expected at most {limit}, got {energy}"
                    );
                }
            }
        }
    }

    #[test]
    fn indefinite_stiffness_is_rejected() {
        assert!(ReducedSystem::new(spring_chain(&[1.0, -1.0], 0.1, 0.0), &VegaSettings::default()).is_err());
    }

    #[test]
    #[ignore = "needs the real inputs: MODALCAST_DATA or ../shared/data"]
    fn real_bridge_scaled_to_0_25_hz_stays_bounded() {
        let folder = data_folder().join("vega/simpleBridge");
        let force = ReducedForce::read(&folder.join("simpleBridge.cub")).expect("a readable file");
        let settings = VegaSettings::read(&folder.join("simpleBridge.config")).expect("a readable file");
        let system = ReducedSystem::new(force, &settings).expect("a positive definite stiffness");
        // The lowest frequency of the .cub file is 1 Hz, and the .config file has the base frequency 0.25.
        assert!((system.frequencies()[0] - 0.25).abs() <= 2.5e-4, "{:?}", system.frequencies());
        for dt in [1.0 / 60.0, 1.0, 20.0] {
            let peak_load = random_vector(3, 20) * 5.0;
            let mut state = system.rest_state();
            for step in 0..400 {
                let step_load = &peak_load * (f64::from(step) * 0.37).sin();
                state = system.advance(&state, dt, constant_load(&step_load));
                assert!(state.q.norm() <= 1e4, "dt {dt}, step {step}: {}", state.q.norm());
            }
        }
    }
}
