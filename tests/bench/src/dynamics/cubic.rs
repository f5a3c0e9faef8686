//! Cubic forces against a Runge-Kutta reference: a chain of Duffing oscillators, and the bridge of the library Vega.
//!
//! The exact integrator of the linear modes, which ignores the cubic forces, is the negative control.

use std::f64::consts::TAU;
use std::path::Path;

use nalgebra::{DMatrix, DVector};

use super::method::{AVERAGE_VECTOR_FIELD, BACKWARD_EULER, Method, QuarticPotential, System};
use super::reference::{Displacements, Reference, ReferenceSummary};
use super::row::{Expectation, IntegrationRow, Label, Measured, measure_rows, set_observed_orders};
use super::run::Motion;
use crate::workloads::Size;
use modalcast_dynamics::cubic::ReducedForce;
use modalcast_dynamics::implicit::ImplicitMethod::{AverageVectorField, BackwardEuler};
use modalcast_dynamics::integrator::MotionState;
use modalcast_dynamics::vega::VegaSettings;
use modalcast_dynamics::{Result, invalid_input};
use modalcast_model::load;

pub(super) const CHAIN: &str = "chain";
pub(super) const BRIDGE: &str = "bridge";

/// Folder of the bridge below that of `--scenes`, and its files.
const BRIDGE_FOLDER: &str = "vega/simpleBridge";
const BRIDGE_NAME: &str = "simpleBridge";

/// Samples per second. The largest step is the time between samples.
const SAMPLES_PER_SECOND: u64 = 15;
const SECONDS: u64 = 4;
/// Step of adaptive methods and of the control, as a fraction of the time between samples: 1/60 s.
const ADAPTIVE_DIVISION: u64 = 4;

/// The largest deflection of the bridge at the start, in diagonals.
const BRIDGE_DEFLECTION: f64 = 0.49;

/// A system that is released without a load.
struct ReleasedSystem {
    case: &'static str,
    name: String,
    system: System,
    displacements: Displacements,
    start: DVector<f64>,
}

/// The rows of a system, and its reference.
pub(super) struct CubicResult {
    pub(super) rows: Vec<IntegrationRow>,
    pub(super) reference: ReferenceSummary,
}

/// Measures the chain of Duffing oscillators.
///
/// # Errors
/// None are expected for this system.
pub(super) fn measure_chain(size: Size) -> Result<CubicResult> {
    let system = chain()?;
    let start = DVector::from_column_slice(&[0.6, -0.4, 0.3, 0.5, -0.2, 0.3]);
    let name = "six Duffing oscillators, undamped".to_owned();
    let displacements = Displacements::of_coordinates(system.rank());
    Ok(ReleasedSystem { case: CHAIN, name, system, displacements, start }.measure(size))
}

/// Six masses on hardening springs, whose stiffness is four times that at rest at q = 1. Hardening springs without a
/// linear part connect neighbors.
fn chain() -> Result<System> {
    let eigenvalues = [0.5, 0.8, 1.1, 1.7, 2.3, 3.0].map(|hertz| (TAU * hertz).powi(2));
    let springs = eigenvalues
        .iter()
        .enumerate()
        .map(|(mode, eigenvalue)| QuarticPotential { coefficient: *eigenvalue, weights: vec![(mode, 1.0)] });
    let couplings = (1..eigenvalues.len())
        .map(|mode| QuarticPotential { coefficient: 20.0, weights: vec![(mode - 1, 1.0), (mode, -1.0)] });
    let potentials: Vec<QuarticPotential> = springs.chain(couplings).collect();
    System::with_quartic_potentials(&eigenvalues, &potentials, VegaSettings::default())
}

/// Measures the bridge of a folder with `vega/simpleBridge`.
///
/// # Errors
/// Errors of its files; `Invalid` if they do not belong together.
pub(super) fn measure_bridge(scenes: &Path, size: Size) -> Result<CubicResult> {
    Ok(read_bridge(scenes)?.measure(size))
}

/// Reads the forces, settings and modes of the bridge, and bends it.
fn read_bridge(scenes: &Path) -> Result<ReleasedSystem> {
    let folder = scenes.join(BRIDGE_FOLDER);
    let file = |extension: &str| folder.join(BRIDGE_NAME).with_extension(extension);
    let force = ReducedForce::read(&file("cub"))?;
    let settings = VegaSettings::read(&file("config"))?;
    let expected = || format!("a model with {} modes", force.rank());
    let field = || folder.display().to_string();
    let opened = load::open(&folder.to_string_lossy()).map_err(|error| invalid_input(field(), expected(), error))?;
    let diagonal = opened.scene.rest_bounds.diagonal();
    let modes = opened.scene.shapes.iter().map(|shape| &shape.modes).find(|modes| modes.rank() == force.rank());
    let modes = modes.ok_or_else(|| invalid_input(field(), expected(), "another number of modes"))?;
    let entry = |row: usize, mode: usize| f64::from(modes.column(mode)[row]) / diagonal;
    let displacements = Displacements { modes: DMatrix::from_fn(3 * modes.vertices(), modes.rank(), entry) };
    let system = System { force, settings, displacements_per_unit: displacements.per_unit() };
    let start = bend(&system, &displacements, BRIDGE_DEFLECTION).ok_or_else(|| {
        let expected = format!("a stable equilibrium with a deflection of {BRIDGE_DEFLECTION} diagonals");
        invalid_input(field(), expected, "a bridge that softens")
    })?;
    let VegaSettings { damping_stiffness, .. } = settings;
    let name = format!("Vega's bridge, {} modes, stiffness damping {damping_stiffness} s", system.rank());
    Ok(ReleasedSystem { case: BRIDGE, name, system, displacements, start })
}

/// The equilibrium under a load on the lowest linear mode whose largest displacement is `target` diagonals. The load
/// increases in small steps, then is bisected, so that each solve starts near its solution. `None` if there is no stable
/// equilibrium.
fn bend(system: &System, displacements: &Displacements, target: f64) -> Option<DVector<f64>> {
    let (eigenvalues, eigenvectors) = system.linear_modes();
    let system = system.reduced_system();
    let load = |strength: f64| eigenvectors.column(eigenvalues.imin()) * strength;
    let linear_deflection = displacements.largest(&system.linear_equilibrium(&load(1.0)));
    let (mut low, mut high) = (0.0, 0.1 * target / linear_deflection);
    let mut start = DVector::zeros(system.rank());
    // 60 increases multiply the load by up to 1.3^60, about 7 million; 40 bisections divide the interval by 1e12.
    for _ in 0..60 {
        let q = system.solve_equilibrium(&load(high), &start);
        if displacements.largest(&q) >= target {
            break;
        }
        (low, start) = (high, q);
        high *= 1.3;
    }
    for _ in 0..40 {
        let middle = 0.5 * (low + high);
        let q = system.solve_equilibrium(&load(middle), &start);
        if displacements.largest(&q) >= target {
            high = middle;
        } else {
            (low, start) = (middle, q);
        }
    }
    let is_reached = (displacements.largest(&start) / target - 1.0).abs() < 1e-3;
    (is_reached && system.is_equilibrium(&load(low), &start)).then_some(start)
}

impl ReleasedSystem {
    fn motion(&self, steps_per_sample: u64) -> Motion {
        Motion {
            start: MotionState::resting(self.start.clone()),
            load: DVector::zeros(self.system.rank()),
            dt: 1.0 / (SAMPLES_PER_SECOND * steps_per_sample) as f64,
            steps_per_sample,
            samples: SECONDS * SAMPLES_PER_SECOND,
        }
    }

    fn measure(&self, size: Size) -> CubicResult {
        let halvings = if size == Size::Full { 8 } else { 5 };
        let motion = self.motion(1);
        let reference = Reference::integrate((self.case, &self.name), &self.system, &motion, &self.displacements);
        let mut runs = vec![(Method::Exact, ADAPTIVE_DIVISION, Expectation::LargeError)];
        for method in [AVERAGE_VECTOR_FIELD, BACKWARD_EULER] {
            runs.extend((0..halvings).map(|halving| (method, 1 << halving, Expectation::Candidate)));
        }
        let adaptive = [(AverageVectorField, &[1e-3, 1e-4, 1e-5, 1e-6][..]), (BackwardEuler, &[1e-3, 1e-4][..])];
        for (method, tolerances) in adaptive {
            let methods = tolerances.iter().map(|tolerance| Method::Adaptive(method, *tolerance));
            runs.extend(methods.map(|method| (method, ADAPTIVE_DIVISION, Expectation::Candidate)));
        }
        let measure = |(method, steps_per_sample, expectation)| {
            let motion = self.motion(steps_per_sample);
            let label = Label { case: self.case, expectation, method, system: &self.system };
            measure_rows(&label, &self.name, &motion, |samples| {
                let errors = reference.errors(&self.system, &motion, &self.displacements, samples);
                Measured::of_system(&self.name, errors)
            })
        };
        let mut rows: Vec<IntegrationRow> = runs.into_iter().flat_map(measure).collect();
        set_observed_orders(&mut rows);
        CubicResult { rows, reference: reference.summary }
    }
}
