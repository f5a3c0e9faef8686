//! Newton's method with a line search for a minimum of a smooth objective.

use nalgebra::{Cholesky, DMatrix, DVector, Dyn};

/// Maximum number of Newton iterations per solve.
const MAX_ITERATIONS: u32 = 60;

/// Maximum number of step lengths that a line search tries. Each is half of the previous one.
const MAX_LINE_SEARCH_STEPS: usize = 50;

/// Constant c1 of Armijo's condition for a sufficient decrease. 1e-4 is its usual value (Nocedal and Wright, Numerical
/// Optimization, 3.1).
const ARMIJO_CONSTANT: f64 = 1e-4;

/// Relative changes below this value are rounding errors: some hundred times the precision of f64.
const ROUNDING_TOLERANCE: f64 = 1e-13;

/// The last increment relative to the unknown of a converged solve. Newton's method converges quadratically, so that
/// the error after an increment of 1e-9 is at the precision of f64. The last increment is always added, because Newton's
/// method approaches a solution from one side, so that the remainders of many steps would add up.
const CONVERGENCE_TOLERANCE: f64 = 1e-9;

/// An increment below this value, relative to the unknown, is close to the solution.
const LOCAL_INCREMENT: f64 = 1e-3;

/// A residual below this value is a rounding error, which a line search would not reduce.
const RESIDUAL_PRECISION: f64 = 1e-15;

/// An objective to minimize.
pub(crate) trait NewtonProblem {
    fn evaluate(&self, unknown: &DVector<f64>) -> ProblemEvaluation;
}

/// An objective with its derivatives at one point.
pub(crate) struct ProblemEvaluation {
    pub(crate) objective: f64,
    /// Sum of the magnitudes of the terms of the objective, for the rounding error.
    pub(crate) objective_scale: f64,
    pub(crate) gradient: DVector<f64>,
    /// Sum of the norms of the terms of the gradient, for the relative residual.
    pub(crate) gradient_scale: f64,
    pub(crate) hessian: DMatrix<f64>,
}

/// The result of a solve.
pub(crate) struct Solution {
    pub(crate) unknown: DVector<f64>,
    pub(crate) iterations: u32,
    /// Norm of the gradient relative to its terms.
    pub(crate) residual: f64,
    pub(crate) is_converged: bool,
    /// The factorized Hessian of the last iteration; `None` if the initial guess is the solution.
    pub(crate) hessian: Option<Cholesky<f64, Dyn>>,
}

impl ProblemEvaluation {
    fn residual(&self) -> f64 {
        let norm = self.gradient.norm();
        if norm > 0.0 { norm / self.gradient_scale } else { norm }
    }
}

/// Minimizes by Newton's method. The line search accepts only points with a smaller objective or, where rounding hides
/// the decrease, a smaller gradient.
pub(crate) fn solve(problem: &dyn NewtonProblem, initial_guess: &DVector<f64>) -> Solution {
    let mut unknown = initial_guess.clone();
    let mut current = problem.evaluate(&unknown);
    let (mut hessian, mut iterations, mut is_converged) = (None, 0, false);
    loop {
        let residual = current.residual();
        is_converged |= residual == 0.0;
        let solution =
            |unknown, hessian, is_converged| Solution { unknown, iterations, residual, is_converged, hessian };
        if is_converged || iterations == MAX_ITERATIONS || !residual.is_finite() {
            return solution(unknown, hessian, is_converged);
        }
        let Some(Factorization { cholesky, is_shifted }) = factorize(&current.hessian) else {
            return solution(unknown, hessian, false);
        };
        let direction = -cholesky.solve(&current.gradient);
        hessian = Some(cholesky);
        // The increment of a shifted Hessian says nothing about the distance to the solution.
        let increment = direction.norm() / unknown.norm().max(f64::MIN_POSITIVE);
        let is_last = increment <= CONVERGENCE_TOLERANCE || residual <= RESIDUAL_PRECISION;
        if is_last && !is_shifted {
            unknown += direction;
            current = problem.evaluate(&unknown);
            (is_converged, iterations) = (true, iterations + 1);
            continue;
        }
        let is_local = increment <= LOCAL_INCREMENT && !is_shifted;
        let Some((next_unknown, next)) = search_line(problem, &unknown, &current, &direction, is_local) else {
            return solution(unknown, hessian, false);
        };
        (unknown, current) = (next_unknown, next);
        iterations += 1;
    }
}

/// The first acceptable point along a direction. Close to the solution, where the terms of the objective may cancel, it
/// is enough that the gradient halves.
fn search_line(
    problem: &dyn NewtonProblem,
    unknown: &DVector<f64>,
    current: &ProblemEvaluation,
    direction: &DVector<f64>,
    is_local: bool,
) -> Option<(DVector<f64>, ProblemEvaluation)> {
    let slope = current.gradient.dot(direction);
    let rounding_error = ROUNDING_TOLERANCE * current.objective_scale;
    let gradient_norm = current.gradient.norm();
    let mut step_length = 1.0;
    (0..MAX_LINE_SEARCH_STEPS).find_map(|_| {
        let next_unknown = unknown + direction * step_length;
        let next = problem.evaluate(&next_unknown);
        let satisfies_armijo = next.objective <= current.objective + ARMIJO_CONSTANT * step_length * slope;
        let reduces_gradient =
            next.objective <= current.objective + rounding_error && next.gradient.norm() < gradient_norm;
        let halves_gradient = is_local && next.gradient.norm() <= 0.5 * gradient_norm;
        step_length *= 0.5;
        (satisfies_armijo || reduces_gradient || halves_gradient).then_some((next_unknown, next))
    })
}

struct Factorization {
    cholesky: Cholesky<f64, Dyn>,
    is_shifted: bool,
}

/// Factorizes a Hessian. An indefinite one, as of a buckling system, gets a growing diagonal shift that makes it
/// positive definite. `None` if it is not finite.
fn factorize(hessian: &DMatrix<f64>) -> Option<Factorization> {
    // After an attempt without shift, the shift grows from 1e-6 of the largest entry by a factor of 10 per attempt.
    let largest = hessian.abs().max();
    let mut shift = 0.0;
    (0..40).find_map(|_| {
        let mut shifted = hessian.clone();
        (0..hessian.nrows()).for_each(|index| shifted[(index, index)] += shift);
        let is_shifted = shift > 0.0;
        shift = (10.0 * shift).max(1e-6 * largest);
        Cholesky::new(shifted).map(|cholesky| Factorization { cholesky, is_shifted })
    })
}
