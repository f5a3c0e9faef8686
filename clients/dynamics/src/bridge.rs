//! A body with reduced forces of a Saint Venant-Kirchhoff (StVK) material, integrated implicitly: a bridge under a
//! pulsating load, or any body that viewers pull. The other domains of the scene follow at their joints, and their modes
//! with eigenvalues respond to viewers.
//!
//! The load acts on the middle of the bridge, spread evenly over the sampled vertices there. Its strength is calibrated
//! so that the deflection at equilibrium is a given fraction of the diagonal of the scene's rest bounds. The run starts
//! at this equilibrium. The load then pulsates between its full strength and 0, as (1 + cos(2 pi t / period)) / 2.
//!
//! The load does not act on eigenvectors without stiffness at rest, which it would move away. A bridge whose stiffness
//! at rest has a negative eigenvalue (a buckled one) is not in equilibrium there: its run starts at rest, and the linear
//! stiffness calibrates the load. With a deflection of 0 there is no load.
//!
//! The damping is that of Vega's settings and, if the domain has the note `damping_ratio`, that of linear modes with this
//! ratio.

use std::f64::consts::TAU;

use nalgebra::{DVector, Vector3};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use crate::attachments::Attachments;
use crate::checkpoint::RunIdentity;
use crate::cubic::ReducedForce;
use crate::error::{Result, check_option, invalid_input};
use crate::hierarchy::compose_transforms;
use crate::implicit::{ImplicitIntegrator, ImplicitMethod, MAX_SUB_STEPS, StepControl};
use crate::integrator::{Integrator as _, IntegratorTotals, LoadChange, ModalOscillators, MotionState, nyquist_remark};
use crate::loads::DomainLoads;
use crate::model::{DomainModel, Model};
use crate::parameters::{ModalParameters, noted_damping_ratio};
use crate::reduced_system::ReducedSystem;
use crate::run::{Report, Scenario, aliasing_remark};
use crate::saved_state::{check_vector, from_json, number_bits, to_json, vector_bits};
use crate::step_values::StepValues;
use crate::vega::VegaSettings;
use crate::viewer_forces::{MAX_STATIC_DISPLACEMENT, force_scale, scale_remark};
use crate::viewer_response::{ForcedMotion, ViewerResponse};

/// Largest error of the deflection at equilibrium, as a fraction of the requested deflection.
const DEFLECTION_TOLERANCE: f64 = 1e-3;

/// Largest estimated error of the displacement in a step, in diagonals of the scene's rest bounds.
const STEP_TOLERANCE: f64 = 1e-5;

/// Name of the note with the largest coordinates of the first modes for which the forces were checked: up to them, no load
/// on one of these modes compresses the material below a stretch of 0.6. `modalcast model --large` writes it.
const SAFE_COORDINATES_NOTE: &str = "modes.safe_coordinates";

/// Largest static displacement under the forces of viewers, in diagonals of the scene's rest bounds, of a body whose forces
/// were checked for it. Others have `MAX_STATIC_DISPLACEMENT`.
const MAX_LARGE_DISPLACEMENT: f64 = 0.5;

/// Settings of the bridge scenario.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BridgeOptions {
    /// Index of the domain that the reduced forces belong to.
    pub domain: usize,
    /// Seconds per step.
    pub dt: f64,
    /// Deflection at equilibrium as a fraction of the diagonal of the scene's rest bounds. 0: no load.
    pub deflection_fraction: f64,
    /// Period of the load in seconds.
    pub period: f64,
    pub load_direction: LoadDirection,
    pub method: ImplicitMethod,
    /// Whether every step is one step of the integrator, instead of sub-steps by an estimate of the error.
    pub has_fixed_step: bool,
}

/// Direction of the load.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LoadDirection {
    /// Like wind: across the bridge, with an upward component of 0.3 times the horizontal one.
    Across,
    /// Like a weight. A bridge close to the ground then moves below the ground plane of a rendered frame.
    Down,
    Up,
}

/// The bridge scenario.
pub struct BridgeScenario {
    model: Model,
    integrator: ImplicitIntegrator,
    totals: IntegratorTotals,
    options: BridgeOptions,
    settings: VegaSettings,
    /// Of the domain's note; 0 without it.
    damping_ratio: f64,
    /// Reduced load U^T f of the force f at the peak of the pulse.
    peak_load: DVector<f64>,
    /// Reduced load of the viewers' forces.
    viewer_load: DVector<f64>,
    /// The linear modes of the other domains.
    linear_modes: ModalParameters,
    oscillators: ModalOscillators,
    viewer_response: ViewerResponse,
    attachments: Attachments,
    /// The state at step `next_step`.
    state: MotionState,
    /// The step that the next call of `compute_next_step` computes.
    next_step: u64,
    /// Magnitude of the force at the peak of the pulse, in the units in which the reduced mass matrix is the identity.
    strength: f64,
    /// Deflection at equilibrium as a fraction of the diagonal of the scene's rest bounds.
    static_deflection_fraction: f64,
    /// Largest displacement so far, in scene units.
    peak_displacement: f64,
    /// Largest static displacement under the forces of viewers, by the stiffness at rest, in diagonals of the scene's rest
    /// bounds.
    static_limit: f64,
    /// Largest magnitudes of the first coordinates without a remark.
    safe_coordinates: Vec<f64>,
    has_compression_remark: bool,
    late_remarks: Vec<String>,
    /// Whether forces of viewers were scaled down.
    has_scaled_forces: bool,
}

/// The state of a bridge in a checkpoint.
#[derive(Serialize, Deserialize)]
struct SavedBridge {
    state: MotionState,
    #[serde(with = "vector_bits")]
    viewer_load: DVector<f64>,
    viewer_response: ForcedMotion,
    totals: IntegratorTotals,
    #[serde(with = "number_bits")]
    peak_displacement: f64,
    has_compression_remark: bool,
    late_remarks: Vec<String>,
    has_scaled_forces: bool,
}

/// An equilibrium and the strength of the load that causes it.
struct LoadedEquilibrium {
    strength: f64,
    q: DVector<f64>,
}

impl BridgeScenario {
    /// Calibrates the load of the bridge.
    ///
    /// # Errors
    /// `Invalid` if an option is out of range, the domain has another rank than the forces or no coordinates of its
    /// own, the load cannot deform the domain, or the bridge has no stable equilibrium at the requested deflection.
    pub fn new(model: Model, force: ReducedForce, settings: &VegaSettings, options: BridgeOptions) -> Result<Self> {
        check_option("dt", options.dt, f64::MIN_POSITIVE..=1e6)?;
        check_option("deflection", options.deflection_fraction, 0.0..=0.5)?;
        check_option("period", options.period, f64::MIN_POSITIVE..=1e6)?;
        let rank = force.rank();
        let domain = find_domain(&model, options.domain, rank)?;
        let damping_ratio = noted_damping_ratio(domain)?.unwrap_or(0.0);
        let system = ReducedSystem::new(force, settings).with_damping_ratio(damping_ratio);
        let (unit_load, equilibrium) = match options.deflection_fraction > 0.0 {
            true => create_load(&system, &model, domain, &options)?,
            false => (DVector::zeros(rank), LoadedEquilibrium { strength: 0.0, q: DVector::zeros(rank) }),
        };
        let static_deflection = max_sample_displacement(domain, &equilibrium.q);
        let coordinates = domain.first_coordinate..domain.first_coordinate + rank;
        let control = match options.has_fixed_step {
            true => StepControl::Fixed,
            false => StepControl::Adaptive {
                tolerance: STEP_TOLERANCE,
                displacements_per_unit: model.displacements_per_unit()[coordinates].to_vec(),
            },
        };
        let integrator = ImplicitIntegrator::new(system, options.method, control, options.dt)?;
        let safe_coordinates = read_safe_coordinates(domain)?;
        let linear_modes = ModalParameters::read_except(&model, Some(options.domain))?;
        let oscillators = ModalOscillators::new(&linear_modes, options.dt)?;
        Ok(Self {
            viewer_response: ViewerResponse::at_rest(&model, &oscillators),
            linear_modes,
            oscillators,
            attachments: Attachments::new(&model),
            options,
            settings: *settings,
            damping_ratio,
            peak_load: unit_load * equilibrium.strength,
            viewer_load: DVector::zeros(rank),
            state: MotionState::resting(equilibrium.q),
            next_step: 0,
            strength: equilibrium.strength,
            static_deflection_fraction: static_deflection / model.diagonal(),
            peak_displacement: 0.0,
            static_limit: match safe_coordinates.is_empty() {
                true => MAX_STATIC_DISPLACEMENT,
                false => MAX_LARGE_DISPLACEMENT,
            },
            safe_coordinates,
            has_compression_remark: false,
            late_remarks: vec![],
            has_scaled_forces: false,
            totals: IntegratorTotals::default(),
            integrator,
            model,
        })
    }

    /// Integrates the state over one step.
    fn advance(&mut self) -> Result<()> {
        let (start_load, end_load) = (self.compute_load(self.next_step), self.compute_load(self.next_step + 1));
        let load = LoadChange { start: &start_load, end: &end_load };
        let report = self.integrator.advance(&mut self.state, load)?;
        self.viewer_response.advance(&self.oscillators)?;
        self.totals.add(&report);
        if report.is_limited && self.totals.limited_steps == 1 {
            self.late_remarks.push(format!(
                "step {}: {MAX_SUB_STEPS} sub-steps leave an estimated error of {:.1e} diagonals, more than \
                 {STEP_TOLERANCE:e}: choose smaller steps (--dt); integrator.steps_above_tolerance counts such steps",
                self.next_step + 1,
                report.error
            ));
        }
        self.next_step += 1;
        Ok(())
    }

    /// Adds a remark when a coordinate exceeds its safe range for the first time.
    fn check_compression(&mut self) {
        let exceeds = |(q, limit): (&f64, &f64)| q.abs() > *limit;
        let mode = self.state.q.iter().zip(&self.safe_coordinates).position(exceeds);
        if let Some(mode) = mode.filter(|_| !self.has_compression_remark) {
            self.late_remarks.push(format!(
                "step {}: q[{mode}] = {:.3e} exceeds {:.3e}, up to which loads on this mode compress no point below 0.6 of \
                 its length; below 0.577 the material loses its stiffness, so that larger shapes may be wrong",
                self.next_step, self.state.q[mode], self.safe_coordinates[mode]
            ));
            self.has_compression_remark = true;
        }
    }

    /// The reduced load at a step.
    fn compute_load(&self, step: u64) -> DVector<f64> {
        let time = step as f64 * self.options.dt;
        &self.peak_load * (0.5 + 0.5 * (TAU * time / self.options.period).cos()) + &self.viewer_load
    }
}

impl Scenario for BridgeScenario {
    fn model(&self) -> &Model {
        &self.model
    }

    fn identity(&self) -> RunIdentity {
        let BridgeOptions { domain, dt: _, deflection_fraction, period, load_direction, method, has_fixed_step } =
            self.options;
        let VegaSettings { base_frequency, damping_mass, damping_stiffness } = self.settings;
        RunIdentity::default()
            .with("motion", "cubic forces")
            .with("cubic forces (SHA-256)", self.integrator.system().force().content_hash())
            .with("--domain", domain)
            .with_number("--deflection", deflection_fraction)
            .with_number("--period", period)
            .with("--toward", format_args!("{load_direction:?}"))
            .with("--integrator", format_args!("{method:?}"))
            .with("--fixed-step", has_fixed_step)
            .with_number("baseFrequency in --config", base_frequency)
            .with_number("dampingMassCoef in --config", damping_mass)
            .with_number("dampingStiffnessCoef in --config", damping_stiffness)
            .with_number("damping_ratio", self.damping_ratio)
    }

    fn save(&self) -> Result<Value> {
        to_json(&SavedBridge {
            state: self.state.clone(),
            viewer_load: self.viewer_load.clone(),
            viewer_response: self.viewer_response.save(),
            totals: self.totals,
            peak_displacement: self.peak_displacement,
            has_compression_remark: self.has_compression_remark,
            late_remarks: self.late_remarks.clone(),
            has_scaled_forces: self.has_scaled_forces,
        })
    }

    fn restore(&mut self, next_step: u64, state: Value) -> Result<()> {
        let saved: SavedBridge = from_json(state)?;
        let rank = self.integrator.system().rank();
        saved.state.check(rank)?;
        check_vector("viewer_load", &saved.viewer_load, rank)?;
        self.viewer_response.restore(saved.viewer_response)?;
        (self.next_step, self.state, self.viewer_load) = (next_step, saved.state, saved.viewer_load);
        (self.totals, self.peak_displacement) = (saved.totals, saved.peak_displacement);
        self.has_compression_remark = saved.has_compression_remark;
        (self.late_remarks, self.has_scaled_forces) = (saved.late_remarks, saved.has_scaled_forces);
        Ok(())
    }

    fn compute_next_step(&mut self, values: &mut StepValues) -> Result<()> {
        let first_coordinate = self.model.domains[self.options.domain].first_coordinate;
        let mut q = vec![0.0; self.model.coordinate_count];
        for (destination, coordinate) in q[first_coordinate..].iter_mut().zip(self.state.q.iter()) {
            *destination = *coordinate;
        }
        self.viewer_response.add_to(&mut q);
        let attachments = self.attachments.deform(&self.model, &q);
        let world_from_domain = compose_transforms(&self.model, &attachments, &[]);
        values.q = q.iter().map(|coordinate| *coordinate as f32).collect();
        values.transforms = world_from_domain.iter().map(|transform| transform.to_row_major()).collect();
        self.peak_displacement = self.peak_displacement.max(self.model.max_displacement(&q, &world_from_domain));
        self.check_compression();
        self.advance()
    }

    fn set_viewer_forces(&mut self, loads: &DomainLoads) -> Result<()> {
        let forces = &loads.coordinates;
        let first_coordinate = self.model.domains[self.options.domain].first_coordinate;
        self.viewer_load.copy_from_slice(&forces[first_coordinate..][..self.integrator.system().rank()]);
        let q = self.integrator.system().linear_equilibrium(&self.viewer_load);
        let displacements_per_unit = &self.model.displacements_per_unit()[first_coordinate..];
        // In units of the limit, which `force_scale` has as a share of the diagonal.
        let limit_share = MAX_STATIC_DISPLACEMENT / self.static_limit;
        let scale = force_scale((q * limit_share).as_slice(), displacements_per_unit);
        self.viewer_load *= scale;
        let linear_scale = self.viewer_response.set_forces(forces);
        if !self.has_scaled_forces {
            let own_remark = (scale < 1.0).then(|| {
                format!(
                    "the forces of viewers would displace the body by {:.3e} diagonals with its stiffness at rest: scaled \
                     to {}",
                    self.static_limit / scale,
                    self.static_limit
                )
            });
            self.late_remarks.extend(own_remark.or_else(|| scale_remark(linear_scale)));
            self.has_scaled_forces = scale.min(linear_scale) < 1.0;
        }
        Ok(())
    }

    fn remarks(&self) -> Vec<String> {
        let VegaSettings { damping_mass, damping_stiffness, .. } = self.settings;
        let is_damped = [damping_mass, damping_stiffness, self.damping_ratio].into_iter().any(|value| value > 0.0);
        let undamped = (!is_damped).then(|| {
            "the bridge has no damping, so that vibrations do not decay: set it in the .config file, or by the note \
             damping_ratio"
                .to_owned()
        });
        let system = self.integrator.system();
        let unstable = match system.unstable_counts() {
            (0, 0) => None,
            (zero, negative) => Some(format!(
                "the stiffness at rest has {zero} eigenvalues of 0 and {negative} negative ones, the lowest of \
                 {:.3e} (rad/s)^2: the load does not act on them",
                system.eigenvalues()[0]
            )),
        };
        let modes = system.frequencies().into_iter().enumerate();
        let modes = modes.map(|(mode, hertz)| (format!("mode {}", mode + 1), hertz));
        let unresolved = nyquist_remark(modes.chain(self.linear_modes.frequencies(&self.model)), self.options.dt);
        let unresolved_load = aliasing_remark("the load", self.options.period, self.options.dt);
        let unresolved_load = unresolved_load.filter(|_| self.strength > 0.0);
        let remarks = [unresolved_load, undamped, unstable, unresolved];
        let linear_remarks = self.linear_modes.remarks.iter().cloned();
        linear_remarks.chain(remarks.into_iter().flatten()).chain(self.late_remarks.iter().cloned()).collect()
    }

    fn late_remarks(&self) -> &[String] {
        &self.late_remarks
    }

    fn report(&self) -> Report {
        let has_load = self.strength > 0.0;
        let load_description = has_load.then(|| {
            format!(
                "a force of {:.4} (in units of mass-normalized modes) on the middle tenth of the bridge, {}, \
             pulsating every {} s; the run starts at the equilibrium, with a deflection of {:.4} of the diagonal",
                self.strength,
                self.options.load_direction.description(),
                self.options.period,
                self.static_deflection_fraction,
            )
        });
        let load_description = load_description.unwrap_or_else(|| "none: the forces of viewers move the body".into());
        let peak_displacement_fraction = self.peak_displacement / self.model.diagonal();
        Report::from_iter([
            ("load".to_owned(), json!(load_description)),
            ("deflection_of_diagonal".to_owned(), json!(self.static_deflection_fraction)),
            ("peak_of_diagonal".to_owned(), json!(peak_displacement_fraction)),
            ("frequencies_hz".to_owned(), json!(self.integrator.system().frequencies())),
            ("integrator".to_owned(), self.totals.to_json()),
        ])
    }
}

/// The coordinates in the note of a domain; none without the note.
fn read_safe_coordinates(domain: &DomainModel) -> Result<Vec<f64>> {
    let Some(text) = domain.notes.get(SAFE_COORDINATES_NOTE) else { return Ok(vec![]) };
    let number = |word: &str| word.parse().ok().filter(|number: &f64| *number >= 0.0);
    let numbers: Option<Vec<f64>> = text.split_whitespace().map(number).collect();
    numbers.filter(|numbers| (1..=domain.rank).contains(&numbers.len())).ok_or_else(|| {
        let field = format!("{SAFE_COORDINATES_NOTE} of '{}'", domain.name);
        invalid_input(field, format!("1 to {} numbers >= 0", domain.rank), format!("'{text}'"))
    })
}

/// The domain with an index. `rank` is the rank of the forces that act on it.
fn find_domain(model: &Model, index: usize, rank: usize) -> Result<&DomainModel> {
    let domain_count = model.domains.len();
    let domain = model.domains.get(index);
    let domain = domain.ok_or_else(|| invalid_input("domain", format!("an index below {domain_count}"), index))?;
    if !domain.owns_q {
        let given = format!("'{}', which shares them", domain.name);
        return Err(invalid_input("domain", "a domain with coordinates of its own", given));
    }
    if domain.rank != rank {
        let expected = format!("a domain of rank {rank} (the rank of the cubic forces)");
        return Err(invalid_input("domain", expected, format!("'{}' of rank {}", domain.name, domain.rank)));
    }
    Ok(domain)
}

impl LoadDirection {
    const fn description(self) -> &'static str {
        match self {
            Self::Across => "sideways, with 0.3 of the force upwards",
            Self::Down => "downwards",
            Self::Up => "upwards",
        }
    }

    /// Unit vector of the load in world axes.
    fn unit_vector(self, model: &Model) -> Vector3<f64> {
        match self {
            Self::Across => (model.ground_axes().short_axis + 0.3 * model.up).normalize(),
            Self::Down => -model.up,
            Self::Up => model.up,
        }
    }
}

/// Computes U^T times a unit force that is spread over the middle tenth of the longer horizontal axis, or over the
/// whole domain if the middle tenth cannot move.
fn compute_unit_load(model: &Model, domain: &DomainModel, load_direction: LoadDirection) -> Result<DVector<f64>> {
    let axis = model.ground_axes().long_axis;
    let axis_coordinate = |rest_position: &Vector3<f64>| domain.placement.apply(rest_position).dot(&axis);
    let axis_coordinates = domain.samples.iter().map(|sample| axis_coordinate(&sample.rest_position));
    let (min, max) = axis_coordinates
        .fold((f64::MAX, f64::MIN), |(min, max), coordinate| (min.min(coordinate), max.max(coordinate)));
    let local_direction = domain.placement.linear.transpose() * load_direction.unit_vector(model);
    // The samples at most `half_width` from the middle, where `half_width` is a fraction of the bridge's length: 0.05
    // selects the middle tenth, and 1.0 the whole bridge.
    let unit_load_within = |half_width: f64| {
        let is_within = |coordinate: f64| (coordinate - 0.5 * (min + max)).abs() <= half_width * (max - min);
        let samples: Vec<_> =
            domain.samples.iter().filter(|sample| is_within(axis_coordinate(&sample.rest_position))).collect();
        let sum =
            |mode| samples.iter().map(|sample| sample.column(mode, domain.rank).dot(&local_direction)).sum::<f64>();
        DVector::from_fn(domain.rank, |mode, _| sum(mode) / samples.len().max(1) as f64)
    };
    let unit_load =
        Some(unit_load_within(0.05)).filter(|load| load.norm() > 0.0).unwrap_or_else(|| unit_load_within(1.0));
    if unit_load.norm() > 0.0 {
        Ok(unit_load)
    } else {
        let given = format!("'{}' with a reduced load of 0", domain.name);
        Err(invalid_input("scene", "a domain whose modes respond to the load", given))
    }
}

/// A unit load, and the equilibrium at the requested deflection with the strength of the load there.
///
/// # Errors
/// `Invalid` if the load cannot deform the domain, or no stable equilibrium has the deflection.
fn create_load(
    system: &ReducedSystem,
    model: &Model,
    domain: &DomainModel,
    options: &BridgeOptions,
) -> Result<(DVector<f64>, LoadedEquilibrium)> {
    let unit_load = system.stiff_part(&compute_unit_load(model, domain, options.load_direction)?);
    if unit_load.norm() == 0.0 {
        let given = format!("{} modes, and no stiffness at rest against the load", system.rank());
        return Err(invalid_input("cubic forces", "a stiffness at rest", given));
    }
    let target_deflection = options.deflection_fraction * model.diagonal();
    let (_, negative_count) = system.unstable_counts();
    let equilibrium = match negative_count {
        0 => calibrate_load(system, domain, &unit_load, target_deflection)?,
        _ => calibrate_load_at_rest(system, domain, &unit_load, target_deflection),
    };
    Ok((unit_load, equilibrium))
}

/// The largest displacement of a domain's samples, in scene units.
fn max_sample_displacement(domain: &DomainModel, q: &DVector<f64>) -> f64 {
    domain.samples.iter().map(|sample| sample.displacement(q.as_slice()).norm()).fold(0.0, f64::max)
}

/// The strength of the load whose linear deflection at rest is the target (scene units). The run starts at rest.
fn calibrate_load_at_rest(
    system: &ReducedSystem,
    domain: &DomainModel,
    unit_load: &DVector<f64>,
    target_deflection: f64,
) -> LoadedEquilibrium {
    let deflection = max_sample_displacement(domain, &system.linear_equilibrium(unit_load));
    let strength = if deflection > 0.0 { target_deflection / deflection } else { 0.0 };
    LoadedEquilibrium { strength, q: DVector::zeros(system.rank()) }
}

/// Finds the strength of the load whose equilibrium has the target deflection (scene units). Increases the strength
/// until the deflection reaches the target, then bisects. Each solve starts from the equilibrium of a smaller load.
///
/// A structure that softens has no equilibrium above some load: it would deflect without bound or snap to a distant
/// state.
///
/// # Errors
/// `Invalid` if no load deflects the bridge, or if no stable equilibrium has the target deflection.
fn calibrate_load(
    system: &ReducedSystem,
    domain: &DomainModel,
    unit_load: &DVector<f64>,
    target_deflection: f64,
) -> Result<LoadedEquilibrium> {
    let solve =
        |strength: f64, initial_guess: &DVector<f64>| system.solve_equilibrium(&(unit_load * strength), initial_guess);
    let rest_q = DVector::zeros(system.rank());
    // The response to a small load is linear. Extrapolate from it to a tenth of the target deflection.
    let probe_strength = 1e-6 * unit_load.norm().recip();
    let probe_deflection = max_sample_displacement(domain, &solve(probe_strength, &rest_q));
    if !(probe_deflection > 0.0 && probe_deflection.is_finite()) {
        let given = format!("a deflection of {probe_deflection}");
        return Err(invalid_input("load", "a load that deflects the bridge", given));
    }
    let (mut low_strength, mut high_strength) = (0.0, 0.1 * target_deflection / probe_deflection * probe_strength);
    let (mut q_low, mut q_high) = (rest_q.clone(), rest_q);
    // 60 increases multiply the strength by up to 1.3^60, about 7 million.
    for _ in 0..60 {
        q_high = solve(high_strength, &q_low);
        if max_sample_displacement(domain, &q_high) >= target_deflection {
            break;
        }
        (low_strength, q_low) = (high_strength, q_high.clone());
        high_strength *= 1.3;
    }
    // 40 bisections reduce the interval by a factor of 1e12.
    for _ in 0..40 {
        let middle_strength = 0.5 * (low_strength + high_strength);
        let q = solve(middle_strength, &q_low);
        if max_sample_displacement(domain, &q) >= target_deflection {
            (high_strength, q_high) = (middle_strength, q);
        } else {
            (low_strength, q_low) = (middle_strength, q);
        }
    }
    let deflection = max_sample_displacement(domain, &q_high);
    let is_equilibrium = system.is_equilibrium(&(unit_load * high_strength), &q_high);
    if is_equilibrium && (deflection - target_deflection).abs() <= DEFLECTION_TOLERANCE * target_deflection {
        return Ok(LoadedEquilibrium { strength: high_strength, q: q_high });
    }
    let stable_deflection = max_sample_displacement(domain, &q_low);
    let expected = format!("a stable equilibrium at a deflection of {target_deflection} scene units (--deflection)");
    let given = format!("a bridge that softens: the largest stable deflection is {stable_deflection}");
    Err(invalid_input("load", expected, given))
}

#[cfg(test)]
mod tests;
