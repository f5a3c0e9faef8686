//! The reduced equations of motion q'' + D q' + s f(q) = load of a nonlinear body, and their equilibria. D is the
//! damping matrix and s the scale of the force f, which is cubic in q. The reduced mass is the identity.

use nalgebra::{DMatrix, DVector};

use crate::cubic::{ForceEvaluation, ReducedForce};
use crate::integrator::MotionState;
use crate::newton::{NewtonProblem, ProblemEvaluation, solve};
use crate::vega::VegaSettings;

/// Eigenvalues of the stiffness at rest below this fraction of the largest one are rounding errors of 0.
const EIGENVALUE_TOLERANCE: f64 = 1e-9;

/// The reduced equations of motion: r coordinates, unit mass.
#[derive(Debug, Clone)]
pub struct ReducedSystem {
    force: ReducedForce,
    /// s, the square of Vega's base frequency.
    scale: f64,
    /// D = mass coefficient * I + stiffness coefficient * scaled stiffness at rest + modal damping; r x r.
    damping: DMatrix<f64>,
    /// Eigenvalues of the scaled stiffness at rest in (rad/s)^2, lowest first.
    eigenvalues: Vec<f64>,
    /// The eigenvector of each eigenvalue, as a column.
    eigenvectors: DMatrix<f64>,
}

impl ReducedSystem {
    /// Creates a system with the frequency scale and the Rayleigh damping of Vega's settings. An eigenvector whose
    /// eigenvalue is negative gets no damping by stiffness, which would add energy.
    pub fn new(force: ReducedForce, settings: &VegaSettings) -> Self {
        let scale = settings.base_frequency * settings.base_frequency;
        let stiffness = force.rest_stiffness() * scale;
        let decomposition = stiffness.clone().symmetric_eigen();
        let mut order: Vec<usize> = (0..force.rank()).collect();
        order.sort_by(|a, b| decomposition.eigenvalues[*a].total_cmp(&decomposition.eigenvalues[*b]));
        let eigenvalues: Vec<f64> = order.iter().map(|index| decomposition.eigenvalues[*index]).collect();
        let eigenvectors = DMatrix::from_fn(force.rank(), force.rank(), |row, column| {
            decomposition.eigenvectors[(row, order[column])]
        });
        let damping_stiffness = if eigenvalues[0] >= 0.0 {
            stiffness
        } else {
            let positive = DVector::from_iterator(force.rank(), eigenvalues.iter().map(|value| value.max(0.0)));
            &eigenvectors * DMatrix::from_diagonal(&positive) * eigenvectors.transpose()
        };
        let identity = DMatrix::identity(force.rank(), force.rank());
        let damping = identity * settings.damping_mass + damping_stiffness * settings.damping_stiffness;
        Self { force, scale, damping, eigenvalues, eigenvectors }
    }

    /// Adds modal damping: each eigenvector of the stiffness at rest gets this fraction of its critical damping. One
    /// without positive stiffness gets none.
    #[must_use]
    pub fn with_damping_ratio(mut self, ratio: f64) -> Self {
        let coefficients = self.eigenvalues.iter().map(|eigenvalue| 2.0 * ratio * eigenvalue.max(0.0).sqrt());
        let coefficients = DMatrix::from_diagonal(&DVector::from_iterator(self.rank(), coefficients));
        self.damping += &self.eigenvectors * coefficients * self.eigenvectors.transpose();
        self
    }

    /// The number of coordinates r.
    pub const fn rank(&self) -> usize {
        self.force.rank()
    }

    /// f.
    pub(crate) const fn force(&self) -> &ReducedForce {
        &self.force
    }

    /// D, r x r.
    pub const fn damping(&self) -> &DMatrix<f64> {
        &self.damping
    }

    /// Eigenvalues of the stiffness at rest in (rad/s)^2, lowest first.
    pub fn eigenvalues(&self) -> &[f64] {
        &self.eigenvalues
    }

    /// Natural frequencies at rest in hertz, lowest first; 0 for an eigenvalue that is not positive.
    pub fn frequencies(&self) -> Vec<f64> {
        self.eigenvalues.iter().map(|eigenvalue| eigenvalue.max(0.0).sqrt() / std::f64::consts::TAU).collect()
    }

    /// The lowest natural frequency at rest in hertz, without eigenvectors that have no positive stiffness; `None` if none
    /// has one.
    pub fn lowest_frequency(&self) -> Option<f64> {
        let tolerance = self.eigenvalue_tolerance();
        let lowest = self.eigenvalues.iter().find(|eigenvalue| **eigenvalue > tolerance)?;
        Some(lowest.sqrt() / std::f64::consts::TAU)
    }

    /// The number of eigenvectors without stiffness at rest and of those with a negative one.
    pub fn unstable_counts(&self) -> (usize, usize) {
        let tolerance = self.eigenvalue_tolerance();
        let negative = self.eigenvalues.iter().filter(|eigenvalue| **eigenvalue < -tolerance).count();
        let not_positive = self.eigenvalues.iter().filter(|eigenvalue| **eigenvalue <= tolerance).count();
        (not_positive - negative, negative)
    }

    fn eigenvalue_tolerance(&self) -> f64 {
        EIGENVALUE_TOLERANCE * self.eigenvalues.iter().fold(0.0, |largest: f64, value| largest.max(value.abs()))
    }

    /// The coordinates at rest under a load by the stiffness at rest. An eigenvector without positive stiffness counts
    /// with the lowest positive one, or 1 (rad/s)^2 if there is none.
    pub fn linear_equilibrium(&self, load: &DVector<f64>) -> DVector<f64> {
        let tolerance = self.eigenvalue_tolerance();
        let lowest = self.eigenvalues.iter().copied().find(|eigenvalue| *eigenvalue > tolerance).unwrap_or(1.0);
        let mut components = self.eigenvectors.transpose() * load;
        for (component, eigenvalue) in components.iter_mut().zip(&self.eigenvalues) {
            *component /= if *eigenvalue > tolerance { *eigenvalue } else { lowest };
        }
        &self.eigenvectors * components
    }

    /// The part of a load on the eigenvectors with positive stiffness at rest.
    pub fn stiff_part(&self, load: &DVector<f64>) -> DVector<f64> {
        let tolerance = self.eigenvalue_tolerance();
        let mut components = self.eigenvectors.transpose() * load;
        for (component, eigenvalue) in components.iter_mut().zip(&self.eigenvalues) {
            if *eigenvalue <= tolerance {
                *component = 0.0;
            }
        }
        &self.eigenvectors * components
    }

    /// The sum of kinetic and elastic energy.
    pub fn energy(&self, state: &MotionState) -> f64 {
        0.5 * state.v.norm_squared() + self.scale * self.force.potential(&state.q)
    }

    /// Force, Jacobian and potential at `q`, scaled.
    pub fn evaluate(&self, q: &DVector<f64>) -> ForceEvaluation {
        let ForceEvaluation { force, jacobian, potential } = self.force.evaluate(q);
        ForceEvaluation {
            force: force * self.scale,
            jacobian: jacobian * self.scale,
            potential: potential * self.scale,
        }
    }

    /// Solves for the equilibrium under a load, starting from `initial_guess`. The result may be inaccurate:
    /// [`Self::is_equilibrium`] checks it.
    pub fn solve_equilibrium(&self, load: &DVector<f64>, initial_guess: &DVector<f64>) -> DVector<f64> {
        solve(&Equilibrium { system: self, load }, initial_guess).unknown
    }

    /// Whether `q` is a stable equilibrium under a load: the forces balance up to 1e-6 of the load, and the stiffness
    /// is positive semidefinite up to rounding.
    pub fn is_equilibrium(&self, load: &DVector<f64>, q: &DVector<f64>) -> bool {
        let ForceEvaluation { force, jacobian, .. } = self.evaluate(q);
        let residual = (force - load).norm();
        let is_finite = q.iter().chain(jacobian.iter()).all(|number| number.is_finite());
        if !is_finite || residual > 1e-6 * load.norm() + f64::MIN_POSITIVE {
            return false;
        }
        let largest = jacobian.abs().max();
        jacobian.symmetric_eigenvalues().min() >= -1e-9 * largest
    }
}

/// A minimum of the potential s V(q) - load . q.
struct Equilibrium<'a> {
    system: &'a ReducedSystem,
    load: &'a DVector<f64>,
}

impl NewtonProblem for Equilibrium<'_> {
    fn evaluate(&self, q: &DVector<f64>) -> ProblemEvaluation {
        let ForceEvaluation { force, jacobian, potential } = self.system.evaluate(q);
        ProblemEvaluation {
            objective: potential - self.load.dot(q),
            objective_scale: potential.abs() + self.load.dot(q).abs(),
            gradient_scale: force.norm() + self.load.norm(),
            gradient: force - self.load,
            hessian: jacobian,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cubic::tests::{data_folder, spring_chain};

    #[test]
    fn forces_balance_at_the_equilibrium() {
        let system = ReducedSystem::new(spring_chain(&[40.0, 90.0], 30.0, 4.0), &VegaSettings::default());
        let load = DVector::from_column_slice(&[12.0, -3.0]);
        let equilibrium = system.solve_equilibrium(&load, &DVector::zeros(2));
        assert!((system.evaluate(&equilibrium).force - &load).norm() <= 1e-9);
        assert!(system.is_equilibrium(&load, &equilibrium));
        assert!(!system.is_equilibrium(&load, &(equilibrium * 1.01)), "control");
    }

    /// Eigenvalues that are not positive get neither damping that adds energy nor an infinite deflection.
    #[test]
    fn eigenvalues_without_stiffness_are_counted_and_not_damped() {
        let settings = VegaSettings { damping_stiffness: 0.1, ..VegaSettings::default() };
        let system = ReducedSystem::new(spring_chain(&[5.0, -2.0, 0.0], 0.0, 0.0), &settings);
        assert_eq!((system.unstable_counts(), system.eigenvalues()), ((1, 1), &[-2.0, 0.0, 5.0][..]));
        assert_eq!(system.lowest_frequency(), Some(5.0_f64.sqrt() / std::f64::consts::TAU));
        assert!(system.damping().clone().symmetric_eigenvalues().min() >= -1e-15);
        let load = DVector::from_column_slice(&[5.0, 10.0, 15.0]);
        assert!((system.linear_equilibrium(&load) - DVector::from_column_slice(&[1.0, 2.0, 3.0])).norm() <= 1e-12);
        assert!((system.stiff_part(&load) - DVector::from_column_slice(&[5.0, 0.0, 0.0])).norm() <= 1e-12);
    }

    #[test]
    fn modal_damping_is_a_fraction_of_the_critical_one() {
        // The force of coupled springs, so that the eigenvectors are no axes.
        let coupled = ReducedForce::new(2, &[50.0, -20.0, -20.0, 80.0], &[0.0; 6], &[0.0; 8]).expect("a valid force");
        let system = ReducedSystem::new(coupled, &VegaSettings::default()).with_damping_ratio(0.25);
        // D^2 = (2 * 0.25)^2 K.
        let difference = system.damping() * system.damping() - system.force().rest_stiffness() * 0.25;
        assert!(difference.norm() <= 1e-12, "{difference}");
        let unstable = ReducedSystem::new(spring_chain(&[5.0, -2.0, 0.0], 0.0, 0.0), &VegaSettings::default());
        let eigenvalues = unstable.with_damping_ratio(0.1).damping().clone().symmetric_eigenvalues();
        assert!((eigenvalues.max() - 0.2 * 5.0_f64.sqrt()).abs() <= 1e-12 && eigenvalues.min() >= -1e-15);
    }

    #[test]
    #[ignore = "needs the real inputs: MODALCAST_DATA or ../shared/data"]
    fn real_bridge_is_scaled_to_a_quarter_hertz() {
        let folder = data_folder().join("vega/simpleBridge");
        let force = ReducedForce::read(&folder.join("simpleBridge.cub")).expect("a readable file");
        let settings = VegaSettings::read(&folder.join("simpleBridge.config")).expect("a readable file");
        // The lowest frequency of the .cub file is 1 Hz, and the .config file has the base frequency 0.25.
        let frequencies = ReducedSystem::new(force, &settings).frequencies();
        assert!((frequencies[0] - 0.25).abs() <= 2.5e-4, "{frequencies:?}");
    }
}
