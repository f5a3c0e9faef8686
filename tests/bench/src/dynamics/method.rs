//! The methods of the report, and the systems that they integrate.

use modalcast_dynamics::Result;
use modalcast_dynamics::cubic::ReducedForce;
use modalcast_dynamics::implicit::{ImplicitIntegrator, ImplicitMethod, StepControl};
use modalcast_dynamics::integrator::{Integrator, LoadChange, ModalOscillators, MotionState, StepReport};
use modalcast_dynamics::parameters::{ModalParameters, ModeParameters};
use modalcast_dynamics::reduced_system::ReducedSystem;
use modalcast_dynamics::vega::VegaSettings;
use nalgebra::{DMatrix, DVector};

/// One way to integrate a system.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Method {
    /// The exact integrator of independent linear modes. It ignores forces of higher degree.
    Exact,
    /// One implicit step per step.
    Fixed(ImplicitMethod),
    /// Sub-steps by an estimate of the error, with this tolerance in diagonals.
    Adaptive(ImplicitMethod, f64),
}

pub(super) const AVERAGE_VECTOR_FIELD: Method = Method::Fixed(ImplicitMethod::AverageVectorField);
pub(super) const BACKWARD_EULER: Method = Method::Fixed(ImplicitMethod::BackwardEuler);

impl Method {
    pub(super) fn name(self) -> String {
        let implicit_name = |method| match method {
            ImplicitMethod::AverageVectorField => "AVF",
            ImplicitMethod::BackwardEuler => "backward Euler",
        };
        match self {
            Self::Exact => "exact modes".into(),
            Self::Fixed(method) => implicit_name(method).into(),
            Self::Adaptive(method, tolerance) => format!("{}, tolerance {tolerance:.0e}", implicit_name(method)),
        }
    }

    /// The order of the error in the step; `None` for a method without one.
    pub(super) const fn order(self) -> Option<f64> {
        match self {
            Self::Fixed(method) => Some(method.order()),
            Self::Exact | Self::Adaptive(..) => None,
        }
    }

    /// Whether the method conserves the energy of a system without damping and load.
    pub(super) fn conserves_energy(self) -> bool {
        match self {
            Self::Exact => false,
            Self::Fixed(method) | Self::Adaptive(method, _) => method == ImplicitMethod::AverageVectorField,
        }
    }
}

/// The equations q'' + D q' + f(q) = load with r coordinates.
#[derive(Debug, Clone)]
pub(super) struct System {
    pub(super) force: ReducedForce,
    /// Scale of the force and Rayleigh damping D.
    pub(super) settings: VegaSettings,
    /// Displacement per unit of each coordinate, in diagonals.
    pub(super) displacements_per_unit: Vec<f64>,
}

impl System {
    /// Independent linear modes with these eigenvalues in (rad/s)^2. A unit of a coordinate is one diagonal.
    pub(super) fn of_modes(eigenvalues: &[f64], settings: VegaSettings) -> Result<Self> {
        Self::with_quartic_potentials(eigenvalues, &[], settings)
    }

    /// Modes with the potential of the sum of `coefficient (weights . q)^4 / 4` besides the linear one. The weights are
    /// given by coordinate; other coordinates have the weight 0.
    pub(super) fn with_quartic_potentials(
        eigenvalues: &[f64],
        potentials: &[QuarticPotential],
        settings: VegaSettings,
    ) -> Result<Self> {
        let rank = eigenvalues.len();
        let mut linear = vec![0.0; rank * rank];
        for (mode, eigenvalue) in eigenvalues.iter().enumerate() {
            linear[mode * (rank + 1)] = *eigenvalue;
        }
        let pair_count = rank * (rank + 1) / 2;
        let triples: Vec<[usize; 3]> =
            (0..rank).flat_map(|i| (i..rank).flat_map(move |j| (j..rank).map(move |k| [i, j, k]))).collect();
        let mut cubic = vec![0.0; rank * triples.len()];
        for (component, row) in cubic.chunks_exact_mut(triples.len()).enumerate() {
            for (entry, triple) in row.iter_mut().zip(&triples) {
                *entry = potentials.iter().map(|potential| potential.cubic_coefficient(component, *triple)).sum();
            }
        }
        Ok(Self {
            force: ReducedForce::new(rank, &linear, &vec![0.0; rank * pair_count], &cubic)?,
            settings,
            displacements_per_unit: vec![1.0; rank],
        })
    }

    pub(super) fn rank(&self) -> usize {
        self.force.rank()
    }

    pub(super) fn reduced_system(&self) -> ReducedSystem {
        ReducedSystem::new(self.force.clone(), &self.settings)
    }

    /// The highest frequency of the linear system in hertz.
    pub(super) fn highest_hertz(&self) -> f64 {
        self.linear_modes().0.max().max(0.0).sqrt() / std::f64::consts::TAU
    }

    /// Whether the energy is constant without a load.
    pub(super) fn is_undamped(&self) -> bool {
        self.settings.damping_mass == 0.0 && self.settings.damping_stiffness == 0.0
    }

    /// Eigenvalues of the scaled stiffness at rest in (rad/s)^2, and the eigenvector of each as a column.
    pub(super) fn linear_modes(&self) -> (DVector<f64>, DMatrix<f64>) {
        let scale = self.settings.base_frequency * self.settings.base_frequency;
        let decomposition = (self.force.rest_stiffness() * scale).symmetric_eigen();
        (decomposition.eigenvalues, decomposition.eigenvectors)
    }

    /// Creates an integrator with steps of `dt` seconds.
    ///
    /// # Errors
    /// `Invalid` if the method does not support an eigenvalue or the step.
    pub(super) fn create_integrator(&self, method: Method, dt: f64) -> Result<Box<dyn Integrator>> {
        let (method, control) = match method {
            Method::Exact => return self.create_exact_integrator(dt),
            Method::Fixed(method) => (method, StepControl::Fixed),
            Method::Adaptive(method, tolerance) => {
                let displacements_per_unit = self.displacements_per_unit.clone();
                (method, StepControl::Adaptive { tolerance, displacements_per_unit })
            }
        };
        Ok(Box::new(ImplicitIntegrator::new(self.reduced_system(), method, control, dt)?))
    }

    /// The product's integrator of linear modes, in the basis of the eigenvectors if that is not the basis of the system.
    fn create_exact_integrator(&self, dt: f64) -> Result<Box<dyn Integrator>> {
        let create_oscillators = |eigenvalues: &DVector<f64>| {
            let modes = eigenvalues.iter().map(|eigenvalue| Some(self.mode(*eigenvalue))).collect();
            ModalOscillators::new(&ModalParameters { modes, remarks: vec![] }, dt)
        };
        let stiffness = self.force.rest_stiffness();
        let diagonal = stiffness.diagonal();
        if *stiffness == DMatrix::from_diagonal(&diagonal) {
            let scale = self.settings.base_frequency * self.settings.base_frequency;
            return Ok(Box::new(create_oscillators(&(diagonal * scale))?));
        }
        let (eigenvalues, eigenvectors) = self.linear_modes();
        Ok(Box::new(RotatedModes { oscillators: create_oscillators(&eigenvalues)?, eigenvectors }))
    }

    /// A linear mode with the damping ratio of the Rayleigh damping.
    fn mode(&self, eigenvalue: f64) -> ModeParameters {
        let damping = self.settings.damping_mass + self.settings.damping_stiffness * eigenvalue;
        let damping_ratio = if eigenvalue > 0.0 { 0.5 * damping / eigenvalue.sqrt() } else { 0.0 };
        ModeParameters { eigenvalue, damping_ratio }
    }
}

/// Linear modes in the basis of their eigenvectors.
struct RotatedModes {
    oscillators: ModalOscillators,
    eigenvectors: DMatrix<f64>,
}

impl Integrator for RotatedModes {
    fn advance(&self, state: &mut MotionState, load: LoadChange<'_>) -> Result<StepReport> {
        let rotate = |vector: &DVector<f64>| self.eigenvectors.tr_mul(vector);
        let mut modes = MotionState { q: rotate(&state.q), v: rotate(&state.v), sub_steps: state.sub_steps };
        let load = LoadChange { start: &rotate(load.start), end: &rotate(load.end) };
        let report = self.oscillators.advance(&mut modes, load)?;
        (state.q, state.v) = (&self.eigenvectors * modes.q, &self.eigenvectors * modes.v);
        Ok(report)
    }

    fn dt(&self) -> f64 {
        self.oscillators.dt()
    }
}

/// The potential `coefficient (weights . q)^4 / 4`.
#[derive(Debug, Clone)]
pub(super) struct QuarticPotential {
    pub(super) coefficient: f64,
    /// Coordinates and their weights.
    pub(super) weights: Vec<(usize, f64)>,
}

impl QuarticPotential {
    /// The coefficient of the monomial of three ascending coordinates in a component of the force
    /// `coefficient weights (weights . q)^3`.
    fn cubic_coefficient(&self, component: usize, triple: [usize; 3]) -> f64 {
        let weight =
            |coordinate: usize| self.weights.iter().find(|entry| entry.0 == coordinate).map_or(0.0, |entry| entry.1);
        let [i, j, k] = triple;
        // The number of orders of the three coordinates.
        let multiplicity = match (i == j, j == k) {
            (true, true) => 1.0,
            (false, false) => 6.0,
            _ => 3.0,
        };
        self.coefficient * multiplicity * weight(component) * triple.map(weight).iter().product::<f64>()
    }
}
