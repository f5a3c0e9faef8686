//! Implicit time integration of reduced forces under a load: q'' + D q' + s f(q) = load, by Newmark's method with
//! average acceleration (beta 1/4, gamma 1/2; Newmark 1959). Newton's method with the analytic Jacobian solves each
//! step.
//!
//! The reduced mass is the identity. Each step minimizes
//!
//! ```text
//! c/2 |q - q_p|^2 + 1/(2 d) v(q)^T D v(q) + s V(q) - load . q,    v(q) = v_p + d (q - q_p)
//! ```
//!
//! The gradient of this expression is Newmark's equation. A line search along Newton's direction ensures that the value
//! decreases, so the iteration cannot diverge.
//!
//! Average acceleration conserves the energy of a linear system exactly and that of a nonlinear system approximately.
//! The spurious energy gain is summed up. A step that would exceed a small allowance is repeated with backward Euler,
//! and its velocity is scaled down to the available energy. The motion therefore stays bounded at any step size.

use nalgebra::{Cholesky, DMatrix, DVector};

use crate::cubic::ReducedForce;
use crate::error::{Result, invalid};
use crate::vega::VegaSettings;

/// The most Newton steps per solve, and the most halvings per line search.
const MAX_NEWTON_STEPS: usize = 60;
const MAX_HALVINGS: usize = 50;

/// The allowed spurious energy gain of rounding and the method, as a share of the highest energy so far.
const ENERGY_TOLERANCE: f64 = 0.02;

/// A reduced model: r coordinates, unit mass.
#[derive(Debug, Clone)]
pub struct ReducedSystem {
    force: ReducedForce,
    /// s, the square of Vega's base frequency.
    scale: f64,
    /// D = mass coefficient * I + stiffness coefficient * scaled stiffness at rest; r x r.
    damping: DMatrix<f64>,
}

/// The load at the start and at the end of a step; it changes linearly in between.
#[derive(Debug, Clone, Copy)]
pub struct LoadChange<'a> {
    pub before: &'a DVector<f64>,
    pub after: &'a DVector<f64>,
}

/// Coordinates, velocities and accelerations at one time.
#[derive(Debug, Clone, PartialEq)]
pub struct NewmarkState {
    pub q: DVector<f64>,
    pub v: DVector<f64>,
    a: DVector<f64>,
    /// Spurious energy gain so far, and the highest energy so far.
    surplus: f64,
    highest: f64,
}

/// One minimization problem: the constants of the expression in the module documentation.
struct Problem<'a> {
    /// c (1/s^2) and d (1/s); both 0 for a static solution.
    inertia: f64,
    rate: f64,
    q: DVector<f64>,
    v: DVector<f64>,
    load: &'a DVector<f64>,
}

impl ReducedSystem {
    /// Creates a model with Vega's frequency scaling and Rayleigh damping.
    ///
    /// # Errors
    /// `Invalid` if the stiffness at rest is not positive definite.
    pub fn new(force: ReducedForce, settings: &VegaSettings) -> Result<Self> {
        let scale = settings.base_frequency * settings.base_frequency;
        let stiffness = (force.linear() + force.linear().transpose()) * (0.5 * scale);
        if Cholesky::new(stiffness.clone()).is_none() {
            return Err(invalid("cub.linear", "a positive definite stiffness", "an indefinite one"));
        }
        let unit = DMatrix::identity(force.rank(), force.rank());
        let damping = unit * settings.damping_mass + stiffness * settings.damping_stiffness;
        Ok(Self { force, scale, damping })
    }

    /// The number of coordinates r.
    pub const fn rank(&self) -> usize {
        self.force.rank()
    }

    /// Natural frequencies at rest in hertz, lowest first.
    pub fn frequencies(&self) -> Vec<f64> {
        let values = (self.force.linear() * self.scale).symmetric_eigenvalues();
        let mut hertz: Vec<f64> =
            values.iter().map(|value| value.max(0.0).sqrt() / (2.0 * std::f64::consts::PI)).collect();
        hertz.sort_by(f64::total_cmp);
        hertz
    }

    /// The motion at rest, without load.
    pub fn at_rest(&self) -> NewmarkState {
        self.static_state(DVector::zeros(self.rank()))
    }

    /// The motion at `q` with zero velocity and acceleration, in equilibrium with a load.
    pub fn static_state(&self, q: DVector<f64>) -> NewmarkState {
        let zero = DVector::zeros(self.rank());
        let highest = self.scale * self.force.potential(&q);
        NewmarkState { q, v: zero.clone(), a: zero, surplus: 0.0, highest }
    }

    /// The sum of kinetic and elastic energy.
    pub fn energy(&self, motion: &NewmarkState) -> f64 {
        0.5 * motion.v.norm_squared() + self.scale * self.force.potential(&motion.q)
    }

    /// The equilibrium under a load, searched from `near`.
    pub fn equilibrium(&self, load: &DVector<f64>, near: &DVector<f64>) -> DVector<f64> {
        let zero = DVector::zeros(self.rank());
        self.minimize(&Problem { inertia: 0.0, rate: 0.0, q: near.clone(), v: zero, load }, near)
    }

    /// The motion `dt` seconds later, under a changing load.
    #[must_use]
    pub fn step(&self, motion: &NewmarkState, dt: f64, load: LoadChange<'_>) -> NewmarkState {
        let LoadChange { before, after } = load;
        let next = self.newmark(motion, dt, after);
        let legal = |next: &NewmarkState| {
            let moved = &next.q - &motion.q;
            let work = 0.5 * (before + after).dot(&moved);
            let lost = (&self.damping * &moved).dot(&moved) / dt;
            self.energy(motion) + work - lost
        };
        let surplus = motion.surplus + self.energy(&next) - legal(&next);
        let highest = motion.highest.max(self.energy(&next).min(legal(&next)));
        if surplus <= ENERGY_TOLERANCE * highest {
            return NewmarkState { surplus: surplus.max(-ENERGY_TOLERANCE * highest), highest, ..next };
        }
        let mut next = self.backward_euler(motion, dt, after);
        // Backward Euler damps fast modes; the kinetic energy of the result must not exceed the available energy.
        let room = (self.energy(motion) + after.dot(&(&next.q - &motion.q))).max(0.0);
        let kinetic = room - self.scale * self.force.potential(&next.q);
        let speed = next.v.norm();
        if speed > 0.0 {
            next.v *= ((2.0 * kinetic.max(0.0)).sqrt() / speed).min(1.0);
        }
        next.a = after - &self.damping * &next.v - self.force.force(&next.q) * self.scale;
        NewmarkState { surplus: motion.surplus.min(0.0), highest: motion.highest.max(self.energy(&next)), ..next }
    }

    /// One step of average acceleration.
    fn newmark(&self, motion: &NewmarkState, dt: f64, load: &DVector<f64>) -> NewmarkState {
        let (inertia, rate) = (4.0 / (dt * dt), 2.0 / dt);
        let q = &motion.q + &motion.v * dt + &motion.a * (0.25 * dt * dt);
        let v = &motion.v + &motion.a * (0.5 * dt);
        let solved = self.minimize(&Problem { inertia, rate, q: q.clone(), v: v.clone(), load }, &motion.q);
        let ahead = &solved - q;
        let v = v + &ahead * rate;
        NewmarkState { q: solved, v, a: ahead * inertia, surplus: motion.surplus, highest: motion.highest }
    }

    fn backward_euler(&self, motion: &NewmarkState, dt: f64, load: &DVector<f64>) -> NewmarkState {
        let ahead = &motion.q + &motion.v * dt;
        let problem = Problem { inertia: 1.0 / (dt * dt), rate: 1.0 / dt, q: ahead, v: motion.v.clone(), load };
        let q = self.minimize(&problem, &motion.q);
        let v = (&q - &motion.q) / dt;
        NewmarkState { q, v, ..motion.clone() }
    }

    /// Newton's method with a line search on the minimized value. Returns the last accepted point, which is no worse
    /// than the start up to rounding.
    fn minimize(&self, problem: &Problem<'_>, start: &DVector<f64>) -> DVector<f64> {
        let mut q = start.clone();
        let mut value = self.value(problem, &q);
        for _ in 0..MAX_NEWTON_STEPS {
            let gradient = self.gradient(problem, &q);
            let direction = self.newton(problem, &q, &gradient);
            let slope = gradient.dot(&direction);
            let descends = slope < 0.0;
            if !descends {
                return q;
            }
            // Near the minimum the decrease is below rounding; there the norm of the gradient decides.
            let noise = 1e-13 * (value.abs() + problem.inertia * (&q - &problem.q).norm_squared());
            let mut share = 1.0;
            let accepted = (0..MAX_HALVINGS).find_map(|_| {
                let next = &q + &direction * share;
                let there = self.value(problem, &next);
                let falls = there <= value + 1e-4 * share * slope;
                let flat = there <= value + noise && self.gradient(problem, &next).norm() < gradient.norm();
                share *= 0.5;
                (falls || flat).then_some((next, there))
            });
            let Some((next, there)) = accepted else { return q };
            let settled = (&next - &q).norm() <= 1e-13 * next.norm().max(f64::MIN_POSITIVE);
            (q, value) = (next, there);
            if settled {
                return q;
            }
        }
        q
    }

    fn value(&self, problem: &Problem<'_>, q: &DVector<f64>) -> f64 {
        let ahead = q - &problem.q;
        let elastic = self.scale * self.force.potential(q) - problem.load.dot(q);
        let v = &problem.v + &ahead * problem.rate;
        let damped = if problem.rate > 0.0 { (&self.damping * &v).dot(&v) / (2.0 * problem.rate) } else { 0.0 };
        0.5 * problem.inertia * ahead.norm_squared() + damped + elastic
    }

    fn gradient(&self, problem: &Problem<'_>, q: &DVector<f64>) -> DVector<f64> {
        let ahead = q - &problem.q;
        let elastic = self.force.force(q) * self.scale - problem.load;
        let damped = &self.damping * (&problem.v + &ahead * problem.rate);
        ahead * problem.inertia + if problem.rate > 0.0 { damped + elastic } else { elastic }
    }

    /// Newton's direction. The Hessian of a buckling model can be indefinite; a growing diagonal shift makes it
    /// positive definite.
    fn newton(&self, problem: &Problem<'_>, q: &DVector<f64>, gradient: &DVector<f64>) -> DVector<f64> {
        let unit = DMatrix::<f64>::identity(self.rank(), self.rank());
        let jacobian = self.force.jacobian(q);
        let stiffness = (&jacobian + jacobian.transpose()) * (0.5 * self.scale);
        let matrix = &unit * problem.inertia + &self.damping * problem.rate + stiffness;
        let mut shift = 0.0;
        for _ in 0..40 {
            if let Some(factors) = Cholesky::new(&matrix + &unit * shift) {
                return -factors.solve(gradient);
            }
            shift = (10.0 * shift).max(1e-6 * matrix.abs().max());
        }
        -gradient
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cubic::tests::{chain, data, noise};

    fn omega2(hertz: f64) -> f64 {
        (2.0 * std::f64::consts::PI * hertz).powi(2)
    }

    fn constant(load: &DVector<f64>) -> LoadChange<'_> {
        LoadChange { before: load, after: load }
    }

    fn undamped(force: ReducedForce) -> ReducedSystem {
        ReducedSystem::new(force, &VegaSettings::default()).expect("definite")
    }

    /// Two coupled hardening springs, deflected and released; `count` steps in one second.
    fn released(count: u32) -> (ReducedSystem, NewmarkState) {
        let system = undamped(chain(&[40.0, 90.0], 30.0, 4.0));
        let none = DVector::zeros(2);
        let dt = 1.0 / f64::from(count);
        let mut motion = system.static_state(DVector::from_column_slice(&[0.8, -0.3]));
        // The holding load is removed, so the initial acceleration is not 0.
        motion.a = -system.force.force(&motion.q);
        let end = (0..count).fold(motion, |motion, _| system.step(&motion, dt, constant(&none)));
        (system, end)
    }

    #[test]
    fn halving_the_step_quarters_the_error() {
        let fine = released(20_000).1;
        let error = |count| (released(count).1.q - &fine.q).norm();
        let (coarse, half, quarter) = (error(100), error(200), error(400));
        assert!((3.6..4.4).contains(&(coarse / half)) && (3.6..4.4).contains(&(half / quarter)));
        assert!(quarter < 2e-3, "{quarter}");
    }

    #[test]
    fn energy_is_conserved_without_damping_and_lost_with_it() {
        let (system, end) = released(1000);
        let start = system.scale * system.force.potential(&DVector::from_column_slice(&[0.8, -0.3]));
        assert!((system.energy(&end) / start - 1.0).abs() <= 1e-3, "{}", system.energy(&end) / start);
        let settings = VegaSettings { damping_mass: 0.5, damping_stiffness: 0.01, ..VegaSettings::default() };
        let damped = ReducedSystem::new(chain(&[40.0, 90.0], 30.0, 4.0), &settings).expect("definite");
        let none = DVector::zeros(2);
        let mut motion = damped.static_state(DVector::from_column_slice(&[0.8, -0.3]));
        for _ in 0..2000 {
            let next = damped.step(&motion, 0.01, constant(&none));
            assert!(damped.energy(&next) <= damped.energy(&motion) * (1.0 + 1e-3) + 1e-12);
            motion = next;
        }
        assert!(damped.energy(&motion) < 1e-3 * start);
    }

    #[test]
    fn steady_load_converges_to_the_equilibrium() {
        let settings = VegaSettings { damping_mass: 4.0, ..VegaSettings::default() };
        let system = ReducedSystem::new(chain(&[40.0, 90.0], 30.0, 4.0), &settings).expect("definite");
        let load = DVector::from_column_slice(&[12.0, -3.0]);
        let still = system.equilibrium(&load, &DVector::zeros(2));
        assert!((system.force.force(&still) - &load).norm() <= 1e-9);
        let mut motion = system.at_rest();
        for _ in 0..4000 {
            motion = system.step(&motion, 0.02, constant(&load));
        }
        assert!((motion.q - still).norm() <= 1e-6);
    }

    #[test]
    fn stays_bounded_far_beyond_the_explicit_step_limit() {
        let hertz = [0.1, 1.0, 10.0, 1e3, 1e5];
        let stiff: Vec<f64> = hertz.iter().map(|hertz| omega2(*hertz)).collect();
        let system = undamped(chain(&stiff, 1e3, 0.2));
        for dt in [1e-3, 0.05, 1.0, 10.0] {
            assert!(dt * stiff[4].sqrt() > 2.0 * 10.0, "the step is within the explicit limit");
            let load = |at: u32| noise(u64::from(at), 5) * 0.5;
            let (mut motion, mut work) = (system.at_rest(), 0.0_f64);
            for at in 0..3000 {
                let (before, after) = (load(at), load(at + 1));
                let next = system.step(&motion, dt, LoadChange { before: &before, after: &after });
                work += (before + after).dot(&(&next.q - &motion.q)).abs();
                let energy = system.energy(&next);
                assert!(energy.is_finite() && energy <= 2.0 * work + 1e-6, "dt {dt}, step {at}: {energy} from {work}");
                motion = next;
            }
            assert!(motion.q.norm() < 1e3, "dt {dt}: {}", motion.q.norm());
        }
    }

    #[test]
    fn high_initial_velocity_gains_no_energy_at_any_step() {
        let system = undamped(chain(&[1.0, 7.0, 1e6], 50.0, 3.0));
        let none = DVector::zeros(3);
        for dt in [1e-3, 0.1, 1.0, 30.0] {
            for seed in 0..4 {
                let mut motion = system.at_rest();
                motion.v = noise(seed, 3) * 20.0;
                let limit = 1.1 * system.energy(&motion);
                for at in 0..1500 {
                    motion = system.step(&motion, dt, constant(&none));
                    let energy = system.energy(&motion);
                    assert!(energy <= limit, "dt {dt}, seed {seed}, step {at}: {energy} above {limit}");
                }
            }
        }
    }

    #[test]
    fn indefinite_stiffness_is_refused() {
        assert!(ReducedSystem::new(chain(&[1.0, -1.0], 0.1, 0.0), &VegaSettings::default()).is_err());
    }

    #[test]
    #[ignore = "needs the real inputs: MODALCAST_DATA or ../shared/data"]
    fn real_bridge_has_a_quarter_hertz_and_stays_bounded() {
        let folder = data().join("vega/simpleBridge");
        let force = ReducedForce::read(&folder.join("simpleBridge.cub")).expect("reads");
        let settings = VegaSettings::read(&folder.join("simpleBridge.config")).expect("reads");
        let system = ReducedSystem::new(force, &settings).expect("definite");
        assert!((system.frequencies()[0] - 0.25).abs() <= 2.5e-4, "{:?}", system.frequencies());
        for dt in [1.0 / 60.0, 1.0, 20.0] {
            let load = noise(3, 20) * 5.0;
            let mut motion = system.at_rest();
            for at in 0..400 {
                let sway = &load * (f64::from(at) * 0.37).sin();
                motion = system.step(&motion, dt, constant(&sway));
                assert!(motion.q.norm() <= 1e4, "dt {dt}, step {at}: {}", motion.q.norm());
            }
        }
    }
}
