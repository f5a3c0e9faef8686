//! Implicit time integration of the reduced equations of motion, with sub-steps by an estimate of the error.
//!
//! The average vector field method (Quispel and McLaren, A new class of energy-preserving numerical integration methods,
//! J. Phys. A 41, 2008) replaces the force of a step by its mean along the chord from q to q + d. With a step of h
//! seconds, the load of the middle of the step and the mean velocity d / h:
//!
//! ```text
//! 2/h^2 (d - h v) + integral of s f(q + t d) over t from 0 to 1 + D d / h = load,    v_end = 2 d / h - v
//! ```
//!
//! Two Gauss points integrate a cubic force exactly. Multiplied by d, the equation says that the energy changes by the
//! work of the load minus h (d/h)^T D (d/h): without load and damping it is constant at any step, and damping never
//! increases it. The method is of second order. Backward Euler is of first order and damps fast vibrations:
//!
//! ```text
//! 1/h^2 (d - h v) + s f(q + d) + D d / h = load at the end,    v_end = d / h
//! ```
//!
//! Both equations set the gradient of an objective to zero, so a line search makes Newton's method robust. The unknown
//! is the displacement d, not q + d, because short steps would cancel.

use nalgebra::{DMatrix, DVector};

use crate::cubic::ForceEvaluation;
use crate::error::{Error, Result, check_option};
use crate::integrator::{Integrator, LoadChange, MotionState, StepReport};
use crate::newton::{NewtonProblem, ProblemEvaluation, Solution, solve};
use crate::reduced_system::ReducedSystem;

/// Maximum number of sub-steps of a step.
pub const MAX_SUB_STEPS: u32 = 64;

/// Points of Gauss's rule with two equal weights on 0 to 1.
const GAUSS_POINTS: [f64; 2] = [0.211_324_865_405_187_13, 0.788_675_134_594_812_9];

/// Factor on the number of sub-steps that the estimated error asks for.
const SUB_STEP_MARGIN: f64 = 1.1;

/// The equations of a step.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ImplicitMethod {
    /// Conserves the energy.
    AverageVectorField,
    /// Damps fast vibrations.
    BackwardEuler,
}

impl ImplicitMethod {
    /// The power of the sub-step to which the error of a step is proportional.
    pub const fn order(self) -> f64 {
        match self {
            Self::AverageVectorField => 2.0,
            Self::BackwardEuler => 1.0,
        }
    }
}

/// How a step is divided.
#[derive(Debug, Clone, PartialEq)]
pub enum StepControl {
    /// One sub-step, unless Newton's method needs smaller ones to converge.
    Fixed,
    /// As many sub-steps as the estimated error of the displacement asks for, at most [`MAX_SUB_STEPS`].
    Adaptive {
        /// Largest estimated error of a step, in diagonals of the scene's rest bounds.
        tolerance: f64,
        /// Per coordinate: displacement per unit of the coordinate, in diagonals of the scene's rest bounds.
        displacements_per_unit: Vec<f64>,
    },
}

/// Integrates a [`ReducedSystem`].
pub struct ImplicitIntegrator {
    system: ReducedSystem,
    method: ImplicitMethod,
    control: StepControl,
    dt: f64,
}

/// A sub-step.
struct SubStep {
    q: DVector<f64>,
    v: DVector<f64>,
    iterations: u32,
    residual: f64,
    /// Per coordinate.
    error: DVector<f64>,
}

/// Why a division of a step is not accepted, and the iterations spent on it.
enum Rejection {
    NotConverged {
        iterations: u32,
        residual: f64,
    },
    /// With the solution, which is accepted if it cannot be improved.
    Inaccurate {
        state: MotionState,
        report: StepReport,
    },
}

impl ImplicitIntegrator {
    /// Creates an integrator with steps of `dt` seconds.
    ///
    /// # Errors
    /// `Invalid` unless the step is finite and positive.
    pub fn new(system: ReducedSystem, method: ImplicitMethod, control: StepControl, dt: f64) -> Result<Self> {
        check_option("dt", dt, f64::MIN_POSITIVE..=1e6)?;
        Ok(Self { system, method, control, dt })
    }

    /// The equations of motion.
    pub const fn system(&self) -> &ReducedSystem {
        &self.system
    }

    /// Divides the step into `count` equal sub-steps.
    fn try_sub_steps(
        &self,
        start: &MotionState,
        load: LoadChange<'_>,
        count: u32,
    ) -> Result<(MotionState, StepReport), Rejection> {
        let h = self.dt / f64::from(count);
        let mut state = start.clone();
        let mut error = DVector::zeros(self.system.rank());
        let mut report = StepReport { sub_steps: count, ..StepReport::default() };
        let mut start_force = self.needs_error().then(|| self.system.evaluate(&state.q).force);
        for index in 0..count {
            let fraction = |offset: u32| f64::from(index + offset) / f64::from(count);
            let (start_load, end_load) = (load.at(fraction(0)), load.at(fraction(1)));
            let sub_step =
                self.sub_step(&state, h, LoadChange { start: &start_load, end: &end_load }, &mut start_force);
            let sub_step = sub_step.map_err(|solution| Rejection::NotConverged {
                iterations: report.iterations + solution.iterations,
                residual: solution.residual,
            })?;
            report.iterations += sub_step.iterations;
            report.residual = report.residual.max(sub_step.residual);
            error += sub_step.error;
            (state.q, state.v) = (sub_step.q, sub_step.v);
        }
        if let StepControl::Adaptive { tolerance, displacements_per_unit } = &self.control {
            report.error = error.iter().zip(displacements_per_unit).map(|(error, per_unit)| error * per_unit).sum();
            let wanted =
                f64::from(count) * (report.error / tolerance).powf(1.0 / self.method.order()) * SUB_STEP_MARGIN;
            state.sub_steps = (wanted.ceil() as u32).clamp(1, MAX_SUB_STEPS);
            // A NaN is not accurate.
            let is_accurate = report.error <= *tolerance;
            if !is_accurate {
                return Err(Rejection::Inaccurate { state, report });
            }
        }
        Ok((state, report))
    }

    const fn needs_error(&self) -> bool {
        matches!(self.control, StepControl::Adaptive { .. })
    }

    /// Solves for a sub-step of `h` seconds. `start_force` is the force at its start, and then at its end, for the
    /// estimate of the error.
    fn sub_step(
        &self,
        state: &MotionState,
        h: f64,
        load: LoadChange<'_>,
        start_force: &mut Option<DVector<f64>>,
    ) -> Result<SubStep, Box<Solution>> {
        let predicted = &state.v * h;
        let equations = StepEquations {
            system: &self.system,
            method: self.method,
            h,
            q: &state.q,
            predicted: &predicted,
            load: match self.method {
                ImplicitMethod::AverageVectorField => load.at(0.5),
                ImplicitMethod::BackwardEuler => load.end.clone(),
            },
        };
        let mut solution = solve(&equations, &predicted);
        if !solution.is_converged {
            // The prediction may be far away after a long step.
            let failed_iterations = solution.iterations;
            solution = solve(&equations, &DVector::zeros(self.system.rank()));
            solution.iterations += failed_iterations;
        }
        if !solution.is_converged {
            return Err(Box::new(solution));
        }
        let displacement = &solution.unknown;
        let q = &state.q + displacement;
        let v = match self.method {
            // Not times 2 / h, whose rounding error is the same in all steps and would change the energy steadily.
            ImplicitMethod::AverageVectorField => displacement * 2.0 / h - &state.v,
            ImplicitMethod::BackwardEuler => displacement / h,
        };
        let mut error = DVector::zeros(self.system.rank());
        if let Some(start_force) = start_force {
            let end_force = self.system.evaluate(&q).force;
            let defect = match self.method {
                // The term of third order of the displacement is h^2 / 12 times the change of the acceleration.
                // The inverse of the Hessian is h^2 / 2 times a filter of vibrations that the step does not resolve.
                ImplicitMethod::AverageVectorField => {
                    let damping_change = self.system.damping() * (&state.v - &v);
                    (load.start - load.end + &end_force - &*start_force - damping_change) / 6.0
                }
                // h / 2 times the change of the velocity; the inverse of the Hessian is h^2 times such a filter.
                ImplicitMethod::BackwardEuler => (&state.v - &v) / (2.0 * h),
            };
            if let Some(hessian) = &solution.hessian {
                error = hessian.solve(&defect).abs();
            }
            *start_force = end_force;
        }
        Ok(SubStep { q, v, iterations: solution.iterations, residual: solution.residual, error })
    }
}

impl Integrator for ImplicitIntegrator {
    fn advance(&self, state: &mut MotionState, load: LoadChange<'_>) -> Result<StepReport> {
        let mut count = if self.needs_error() { state.sub_steps.clamp(1, MAX_SUB_STEPS) } else { 1 };
        let (mut rejections, mut rejected_iterations) = (0, 0);
        loop {
            let is_last = count == MAX_SUB_STEPS;
            let (next_state, report) = match self.try_sub_steps(state, load, count) {
                Ok(accepted) => accepted,
                Err(Rejection::Inaccurate { state: next_state, report }) if is_last => {
                    (next_state, StepReport { is_limited: true, ..report })
                }
                Err(Rejection::Inaccurate { state: next_state, report }) => {
                    rejections += 1;
                    rejected_iterations += report.iterations;
                    count = next_state.sub_steps.clamp(count + 1, MAX_SUB_STEPS);
                    continue;
                }
                Err(Rejection::NotConverged { residual, .. }) if is_last => {
                    return Err(Error::NotConverged { dt: self.dt, sub_steps: count, residual });
                }
                Err(Rejection::NotConverged { iterations, .. }) => {
                    rejections += 1;
                    rejected_iterations += iterations;
                    count = (2 * count).min(MAX_SUB_STEPS);
                    continue;
                }
            };
            *state = next_state;
            return Ok(StepReport { rejections, iterations: report.iterations + rejected_iterations, ..report });
        }
    }

    fn dt(&self) -> f64 {
        self.dt
    }
}

/// The equations of a sub-step in the displacement d, as the gradient of an objective.
struct StepEquations<'a> {
    system: &'a ReducedSystem,
    method: ImplicitMethod,
    h: f64,
    /// q at the start.
    q: &'a DVector<f64>,
    /// h v.
    predicted: &'a DVector<f64>,
    load: DVector<f64>,
}

impl StepEquations<'_> {
    /// The mean force, the Jacobian of this mean with respect to d, and its potential.
    fn mean_force(&self, displacement: &DVector<f64>) -> ForceEvaluation {
        let evaluate = |fraction: f64| self.system.evaluate(&(self.q + displacement * fraction));
        if self.method == ImplicitMethod::BackwardEuler {
            return evaluate(1.0);
        }
        let [first, second] = GAUSS_POINTS.map(evaluate);
        let [t, u] = GAUSS_POINTS;
        // The mean force is the gradient of the mean of V(q + t d) / t; the constant V(q) / t does not matter.
        ForceEvaluation {
            force: (first.force + second.force) * 0.5,
            jacobian: (first.jacobian * t + second.jacobian * u) * 0.5,
            potential: 0.5 * (first.potential / t + second.potential / u),
        }
    }
}

impl NewtonProblem for StepEquations<'_> {
    fn evaluate(&self, displacement: &DVector<f64>) -> ProblemEvaluation {
        let inertia = match self.method {
            ImplicitMethod::AverageVectorField => 2.0 / (self.h * self.h),
            ImplicitMethod::BackwardEuler => 1.0 / (self.h * self.h),
        };
        let ForceEvaluation { force, jacobian, potential } = self.mean_force(displacement);
        let correction = displacement - self.predicted;
        let damping_force = self.system.damping() * displacement / self.h;
        let kinetic = 0.5 * inertia * correction.norm_squared();
        let (dissipation, work) = (0.5 * damping_force.dot(displacement), self.load.dot(displacement));
        let gradient_scale = inertia * (displacement.norm() + self.predicted.norm())
            + force.norm()
            + damping_force.norm()
            + self.load.norm();
        let hessian =
            jacobian + self.system.damping() / self.h + DMatrix::identity(self.q.len(), self.q.len()) * inertia;
        ProblemEvaluation {
            objective: kinetic + potential + dissipation - work,
            objective_scale: kinetic + potential.abs() + dissipation + work.abs(),
            gradient: correction * inertia + force + damping_force - &self.load,
            gradient_scale,
            hessian,
        }
    }
}

#[cfg(test)]
mod tests;
