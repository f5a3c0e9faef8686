//! Linear modes in the wind and under the forces of viewers. Domains that are attached to each other act on each other
//! at their joints ([`coupled`](crate::coupled)); other modes are integrated exactly. `hierarchy` computes the
//! transforms.

mod crown;
mod excitation;
#[cfg(test)]
mod tests;

use nalgebra::{DVector, Vector3, Vector6};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use crate::affine::AffineTransform;
use crate::attachments::Attachments;
use crate::checkpoint::RunIdentity;
use crate::coupled::{CoupledModes, StaticResponse, StaticSystem};
use crate::displacement_meter::DisplacementMeter;
use crate::error::{Result, check_option, invalid_input};
use crate::hierarchy::compose_transforms;
use crate::integrator::{Integrator, LoadChange, ModalOscillators, MotionState, nyquist_remark};
use crate::joint_gap::JointGapMeter;
use crate::loads::DomainLoads;
use crate::model::{DomainModel, Model, Sample};
use crate::parameters::ModalParameters;
use crate::run::{Report, Scenario};
use crate::saved_state::{check_vector, from_json, number_bits, to_json, vector_bits};
use crate::step_values::StepValues;
use crate::viewer_forces::scale_remark;
use crate::wind::Wind;
use crown::Crown;
pub(crate) use excitation::{DRAG_COEFFICIENT, PROJECTED_FRACTION};
use excitation::{WindExcitation, WindOptions};

/// Largest mean speed that [`default_wind_speed`] returns, in m/s: a fresh breeze, in which small trees sway.
const MAX_DEFAULT_SPEED: f64 = 8.0;

/// Limit at rest in the gusts of the default wind: on displacements as a fraction of the scene's height, and on the
/// deflections of each part as a fraction of the part's size. The most flexible leaf or twig reaches it, and the crown a
/// fraction of it.
const DEFAULT_DEFLECTION: f64 = 0.3;

/// Settings of the tree scenario.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TreeOptions {
    /// Seconds per step.
    pub dt: f64,
    /// Mean speed of the wind in m/s.
    pub wind_speed: f64,
    /// Direction that the wind blows to, in radians about the up axis from the first horizontal axis (x, or y if x is
    /// up).
    pub direction_radians: f64,
    /// Seed of the turbulence.
    pub seed: u64,
}

/// The tree scenario.
pub struct TreeScenario {
    model: Model,
    excitation: WindExcitation,
    options: TreeOptions,
    integrator: Box<dyn Integrator + Send + Sync>,
    statics: StaticSystem,
    motion: ForcedMotion,
    /// The step that the next call of `compute_next_step` computes.
    next_step: u64,
    crown: Crown,
    attachments: Attachments,
    displacement_meter: DisplacementMeter,
    gap_meter: JointGapMeter,
    remarks: Vec<String>,
    late_remarks: Vec<String>,
    /// Peaks of all steps but the last one.
    earlier_peaks: Peaks,
    /// The last step, which is measured while the next one is computed.
    last_step: Option<SentStep>,
}

/// The motion at step `next_step`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct ForcedMotion {
    state: MotionState,
    /// Per coordinate: the forces of the wind and of viewers on it at the end of the last step.
    #[serde(with = "vector_bits")]
    forces: DVector<f64>,
    /// Per coordinate: the forces of viewers in later steps. They begin to act with a ramp over one step.
    #[serde(with = "vector_bits")]
    viewer_forces: DVector<f64>,
    /// The drag of the wind in newtons.
    #[serde(with = "number_bits")]
    drag: f64,
}

/// Coordinates and transforms of a step, as the server receives them: rounded to f32.
struct SentStep {
    q: Vec<f64>,
    /// Transforms relative to the parents, which are not rounded.
    attachments: Vec<AffineTransform>,
    world_from_domain: Vec<AffineTransform>,
    drag: f64,
}

/// Largest values of a run or of one step.
#[derive(Debug, Clone, Copy, Default, Serialize, Deserialize)]
struct Peaks {
    /// Sway of the crown, as a fraction of the height.
    #[serde(with = "number_bits")]
    sway: f64,
    /// Displacement of a domain's origin or of a surface sample, in scene units.
    #[serde(with = "number_bits")]
    displacement: f64,
    /// Opening of a joint, in scene units.
    #[serde(with = "number_bits")]
    gap: f64,
    /// Drag of the wind in newtons.
    #[serde(with = "number_bits")]
    drag: f64,
}

/// The state of a tree in a checkpoint.
#[derive(Serialize, Deserialize)]
struct SavedTree {
    motion: ForcedMotion,
    peaks: Peaks,
    late_remarks: Vec<String>,
}

impl TreeOptions {
    fn check(&self) -> Result<()> {
        check_option("dt", self.dt, f64::MIN_POSITIVE..=1e6)?;
        check_option("wind", self.wind_speed, 0.0..=1e6)?;
        check_option("direction", self.direction_radians, -1e6..=1e6)
    }

    /// Highest frequency that the steps resolve, in hertz.
    fn nyquist_frequency(&self) -> f64 {
        0.5 / self.dt
    }
}

impl ForcedMotion {
    /// The rest state without forces, at step 0.
    fn at_rest(model: &Model) -> Self {
        let zeros = || DVector::zeros(model.coordinate_count);
        Self { state: MotionState::resting(zeros()), forces: zeros(), viewer_forces: zeros(), drag: 0.0 }
    }

    /// Checks a motion that was read from a checkpoint.
    fn check(&self, model: &Model) -> Result<()> {
        self.state.check(model.coordinate_count)?;
        check_vector("forces", &self.forces, model.coordinate_count)?;
        check_vector("viewer_forces", &self.viewer_forces, model.coordinate_count)
    }
}

impl TreeScenario {
    /// Creates the scenario at rest.
    ///
    /// # Errors
    /// `Invalid` if the scene has no eigenvalues; if an option, an eigenvalue or a damping ratio is out of range; if the
    /// wind does not act on any coordinate; or as for [`CoupledModes::new`].
    pub fn new(model: Model, options: TreeOptions) -> Result<Self> {
        options.check()?;
        if model.domains.iter().all(|domain| domain.eigenvalues.is_empty()) {
            let given =
                format!("{} domains without eigenvalues (`modalcast-sim sweep` needs none)", model.domains.len());
            return Err(invalid_input("scene.eigenvalues", "a domain whose modes have eigenvalues", given));
        }
        let parameters = ModalParameters::read(&model)?;
        let statics = StaticSystem::new(&model, &parameters)?;
        let integrator: Box<dyn Integrator + Send + Sync> = match statics.joints().is_coupled() {
            true => Box::new(CoupledModes::new(&model, &parameters, options.dt)?),
            false => Box::new(ModalOscillators::new(&parameters, options.dt)?),
        };
        let wind = WindOptions {
            mean_speed: options.wind_speed,
            direction_radians: options.direction_radians,
            seed: options.seed,
            max_frequency: options.nyquist_frequency(),
        };
        let excitation = WindExcitation::new(&model, &wind);
        if options.wind_speed > 0.0 {
            check_wind_moves(&model, &excitation, &statics)?;
        }
        Ok(Self {
            excitation,
            options,
            integrator,
            statics,
            motion: ForcedMotion::at_rest(&model),
            next_step: 0,
            crown: Crown::select(&model),
            attachments: Attachments::new(&model),
            displacement_meter: DisplacementMeter::new(&model),
            gap_meter: JointGapMeter::new(&model),
            remarks: create_remarks(&model, &parameters, &options),
            late_remarks: vec![],
            earlier_peaks: Peaks::default(),
            last_step: None,
            model,
        })
    }

    /// The motion one step after `next_step`.
    fn next_motion(&self) -> Result<ForcedMotion> {
        let time = self.options.dt * (self.next_step + 1) as f64;
        let loads = self.excitation.loads(&self.model, time);
        let drag: Vector6<f64> = loads.wrenches.iter().sum();
        let forces = DVector::from_vec(self.statics.joints().reduce(&loads)) + &self.motion.viewer_forces;
        let ForcedMotion { mut state, viewer_forces, .. } = self.motion.clone();
        self.integrator.advance(&mut state, LoadChange { start: &self.motion.forces, end: &forces })?;
        Ok(ForcedMotion { state, forces, viewer_forces, drag: drag.fixed_rows::<3>(0).norm() })
    }

    /// The largest values of all steps. The meters visit only the parts of the last step that may exceed the earlier
    /// ones.
    fn peaks(&self) -> Peaks {
        let (model, earlier) = (&self.model, self.earlier_peaks);
        let Some(SentStep { q, attachments, world_from_domain, drag }) = &self.last_step else { return earlier };
        Peaks {
            sway: earlier.sway.max(self.crown.sway(model, q, world_from_domain)),
            displacement: self.displacement_meter.max_displacement(model, q, world_from_domain, earlier.displacement),
            gap: self.gap_meter.max_gap(model, q, attachments, world_from_domain, earlier.gap),
            drag: earlier.drag.max(*drag),
        }
    }
}

impl Scenario for TreeScenario {
    fn model(&self) -> &Model {
        &self.model
    }

    fn identity(&self) -> RunIdentity {
        let TreeOptions { dt: _, wind_speed, direction_radians, seed } = self.options;
        RunIdentity::default()
            .with("motion", "modes in wind")
            .with_number("--wind", wind_speed)
            .with_number("--direction (radians)", direction_radians)
            .with("--seed", seed)
    }

    fn save(&self) -> Result<Value> {
        to_json(&SavedTree {
            motion: self.motion.clone(),
            peaks: self.peaks(),
            late_remarks: self.late_remarks.clone(),
        })
    }

    fn restore(&mut self, next_step: u64, state: Value) -> Result<()> {
        let saved: SavedTree = from_json(state)?;
        saved.motion.check(&self.model)?;
        (self.motion, self.next_step) = (saved.motion, next_step);
        (self.earlier_peaks, self.last_step, self.late_remarks) = (saved.peaks, None, saved.late_remarks);
        Ok(())
    }

    fn compute_next_step(&mut self, values: &mut StepValues) -> Result<()> {
        values.q = self.motion.state.q.iter().map(|coordinate| *coordinate as f32).collect();
        let q: Vec<f64> = values.q.iter().map(|coordinate| f64::from(*coordinate)).collect();
        // The three computations below do not depend on each other, so they run concurrently.
        let ((attachments, earlier_peaks), next_motion) = rayon::join(
            || rayon::join(|| self.attachments.deform(&self.model, &q), || self.peaks()),
            || self.next_motion(),
        );
        let world_from_domain = compose_transforms(&self.model, &attachments, &[]);
        values.transforms = world_from_domain.iter().map(|transform| transform.to_row_major()).collect();
        let world_from_domain = values.transforms.iter().map(AffineTransform::from_row_major).collect();
        let sent_step = SentStep { q, attachments, world_from_domain, drag: self.motion.drag };
        (self.earlier_peaks, self.last_step) = (earlier_peaks, Some(sent_step));
        (self.motion, self.next_step) = (next_motion?, self.next_step + 1);
        Ok(())
    }

    fn set_viewer_forces(&mut self, loads: &DomainLoads) -> Result<()> {
        let forces = self.statics.joints().reduce(loads);
        let scale = self.statics.viewer_force_scale(&self.model, &forces);
        // Forces of infinite size have the scale 0.
        let scaled = forces.iter().map(|force| if scale > 0.0 { force * scale } else { 0.0 });
        self.motion.viewer_forces = DVector::from_iterator(forces.len(), scaled);
        if self.late_remarks.is_empty() {
            self.late_remarks.extend(scale_remark(scale));
        }
        Ok(())
    }

    fn remarks(&self) -> Vec<String> {
        [&self.remarks[..], &self.late_remarks].concat()
    }

    fn late_remarks(&self) -> &[String] {
        &self.late_remarks
    }

    fn report(&self) -> Report {
        let peaks = self.peaks();
        let load = match self.options.wind_speed {
            0.0 => "calm air".to_owned(),
            speed => format!("wind of {speed} m/s on all surfaces: a drag of at most {:.3e} N", peaks.drag),
        };
        Report::from_iter([
            ("load".to_owned(), json!(load)),
            ("wind_force_peak_n".to_owned(), json!(peaks.drag)),
            ("crown_sway_of_height".to_owned(), json!(peaks.sway)),
            ("peak_of_height".to_owned(), json!(peaks.displacement / self.model.height())),
            ("peak_of_diagonal".to_owned(), json!(peaks.displacement / self.model.diagonal())),
            ("joint_gap_max".to_owned(), json!(peaks.gap)),
            ("joint_gap_of_diagonal".to_owned(), json!(peaks.gap / self.model.diagonal())),
        ])
    }
}

/// Checks that the wind acts on a coordinate that can move.
fn check_wind_moves(model: &Model, excitation: &WindExcitation, statics: &StaticSystem) -> Result<()> {
    // After its rise, the wind has a pressure.
    let loads = excitation.loads(model, 1.0);
    let q = statics.solve_reduced(&statics.joints().reduce(&loads));
    if q.iter().any(|coordinate| *coordinate != 0.0) {
        return Ok(());
    }
    let area: f64 = model.domains.iter().map(|domain| domain.area).sum();
    let given = format!("no motion in the wind (surface area {area}); use --wind 0 for a scene without wind");
    Err(invalid_input("scene", "a domain with a surface and with modes that the wind can excite", given))
}

/// The mean speed of a wind that linear modes can show, in m/s: at most 8. The pressure of its gusts displaces no
/// surface sample by more than 0.3 of the scene's height at rest, and bends no domain by more than 0.3 of its own size.
/// Linear modes have no limit of their own: in a stronger wind they lengthen twigs and leaves, which real ones avoid by
/// bending away and by shelter.
///
/// # Errors
/// Those of [`StaticSystem::new`] and [`ModalParameters::read`].
pub fn default_wind_speed(model: &Model, direction_radians: f64) -> Result<f64> {
    let statics = StaticSystem::new(model, &ModalParameters::read(model)?)?;
    let wind = WindOptions { mean_speed: MAX_DEFAULT_SPEED, direction_radians, seed: 0, max_frequency: 0.0 };
    let excitation = WindExcitation::new(model, &wind);
    let response = statics.solve(&excitation.steady_loads(model, Wind::gust_pressure(MAX_DEFAULT_SPEED)));
    let deflection = largest_deflection(model, &response);
    if deflection <= DEFAULT_DEFLECTION {
        return Ok(MAX_DEFAULT_SPEED);
    }
    // The drag goes as the square of the speed. Two digits are enough, and are rounded down.
    let speed = MAX_DEFAULT_SPEED * (DEFAULT_DEFLECTION / deflection).sqrt();
    let digits_per_unit = 10_f64.powf(1.0 - speed.log10().floor());
    Ok((speed * digits_per_unit).floor() / digits_per_unit)
}

/// The largest displacement as a fraction of the scene's height, or deflection of a domain as a fraction of the diagonal of
/// its samples, whichever is larger.
fn largest_deflection(model: &Model, response: &StaticResponse) -> f64 {
    let of_domain = |(index, domain): (usize, &DomainModel)| {
        let samples = domain.surface_samples();
        let largest = |length: &dyn Fn(&Sample) -> f64| samples.iter().map(length).fold(0.0, f64::max);
        let displacement = largest(&|sample| response.displacement(model, index, sample).norm());
        let deflection = largest(&|sample| sample.displacement(domain.q(&response.q)).norm());
        let low = samples.iter().fold(Vector3::repeat(f64::MAX), |low, sample| low.inf(&sample.rest_position));
        let high = samples.iter().fold(Vector3::repeat(f64::MIN), |high, sample| high.sup(&sample.rest_position));
        (displacement / model.height()).max(if deflection > 0.0 { deflection / (high - low).norm() } else { 0.0 })
    };
    model.domains.iter().enumerate().map(of_domain).fold(0.0, f64::max)
}

/// Remarks on held modes and omitted gusts.
fn create_remarks(model: &Model, parameters: &ModalParameters, options: &TreeOptions) -> Vec<String> {
    let left_out_gusts =
        (options.wind_speed > 0.0 && options.nyquist_frequency() < Wind::highest_frequency()).then(|| {
            format!(
                "gusts above {} Hz are left out, because steps of {} s do not resolve them: choose steps below {} s",
                options.nyquist_frequency(),
                options.dt,
                0.5 / Wind::highest_frequency()
            )
        });
    let unresolved_modes = nyquist_remark(parameters.frequencies(model), options.dt);
    let remarks = parameters.remarks.iter().cloned();
    remarks.chain(left_out_gusts).chain(unresolved_modes).collect()
}
