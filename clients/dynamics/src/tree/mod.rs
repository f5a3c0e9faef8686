//! A tree that sways in the wind. Each mode is integrated exactly. The force of a mode is U^T times the wind pressure
//! on the surface samples, plus the forces of child domains at their joints. `hierarchy` computes the transforms. A
//! trunk is a domain without a parent, and a branch is a domain with a parent. A leaf is a branch with neither modes
//! nor children.

mod calibration;
mod crown;
mod excitation;
mod response;
#[cfg(test)]
mod tests;

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use crate::affine::AffineTransform;
use crate::attachments::Attachments;
use crate::checkpoint::RunIdentity;
use crate::error::{Result, check_option, invalid_input};
use crate::hierarchy::{JointGapMeter, compose_transforms};
use crate::integrator::{ModalOscillators, nyquist_remark};
use crate::model::{DomainModel, Model};
use crate::parameters::ModalParameters;
use crate::run::{Report, Scenario};
use crate::saved_state::{from_json, number_bits, to_json};
use crate::step_values::StepValues;
use crate::viewer_forces::scale_remark;
use crate::viewer_response::{ForcedMotion, ViewerResponse};
use crate::wind::{Wind, WindPressure};
use calibration::{Calibration, MAX_BRANCH_BENDING, SwayTarget, calibrate, scale_response};
use crown::Crown;
use excitation::WindExcitation;
use response::Response;

/// Rotation of a rigid leaf about its base in the pressure of the mean wind at strength 1, in radians.
const LEAF_ANGLE: f64 = 0.1;

/// Maximum rotation of a rigid leaf, in radians.
const MAX_LEAF_ANGLE: f64 = 0.6;

/// Wind strength above which the rotation of rigid leaves no longer increases.
const MAX_LEAF_STRENGTH: f64 = 2.0;

/// Settings of the tree scenario.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TreeOptions {
    /// Seconds per step.
    pub dt: f64,
    /// Peak displacement of the crown at wind strength 1 in the first 30 s, as a fraction of the height.
    pub sway_fraction: f64,
    /// Strength of the wind.
    pub wind_strength: f64,
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
    integrator: ModalOscillators,
    /// The response at step `next_step`.
    response: Response,
    /// The response to the forces of viewers; `None` until there are any.
    viewer_response: Option<ViewerResponse>,
    /// The step that the next call of `compute_next_step` computes.
    next_step: u64,
    crown: Crown,
    attachments: Attachments,
    gap_meter: JointGapMeter,
    calibration: Calibration,
    remarks: Vec<String>,
    late_remarks: Vec<String>,
    /// Per domain: whether it is a rigid leaf.
    rigid_leaves: Vec<bool>,
    /// Peaks of all steps but the last one.
    earlier_peaks: Peaks,
    /// The last step, which is measured while the next one is computed.
    last_step: Option<SentStep>,
}

/// Coordinates and transforms of a step, as the server receives them: rounded to f32.
struct SentStep {
    q: Vec<f64>,
    world_from_domain: Vec<AffineTransform>,
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
}

/// The state of a tree in a checkpoint.
#[derive(Serialize, Deserialize)]
struct SavedTree {
    response: Response,
    viewer_response: Option<ForcedMotion>,
    peaks: Peaks,
    late_remarks: Vec<String>,
}

impl Peaks {
    const fn max(self, other: Self) -> Self {
        Self {
            sway: self.sway.max(other.sway),
            displacement: self.displacement.max(other.displacement),
            gap: self.gap.max(other.gap),
        }
    }
}

impl TreeOptions {
    fn check(&self) -> Result<()> {
        check_option("dt", self.dt, f64::MIN_POSITIVE..=1e6)?;
        check_option("sway", self.sway_fraction, 0.0..=0.5)?;
        check_option("wind", self.wind_strength, 0.0..=1e6)?;
        check_option("direction", self.direction_radians, -1e6..=1e6)
    }

    const fn target(&self) -> SwayTarget {
        SwayTarget { sway_fraction: self.sway_fraction, wind_strength: self.wind_strength }
    }

    /// Highest frequency that the steps resolve, in hertz.
    fn nyquist_frequency(&self) -> f64 {
        0.5 / self.dt
    }
}

impl TreeScenario {
    /// Calibrates the wind for the tree.
    ///
    /// # Errors
    /// `Invalid` if the scene has no eigenvalues; if an option, an eigenvalue or a damping ratio is out of range; or if
    /// the wind does not deform any domain.
    pub fn new(model: Model, options: TreeOptions) -> Result<Self> {
        options.check()?;
        if model.domains.iter().all(|domain| domain.eigenvalues.is_empty()) {
            let given =
                format!("{} domains without eigenvalues (`modalcast-sim sweep` needs none)", model.domains.len());
            return Err(invalid_input("scene.eigenvalues", "a domain whose modes have eigenvalues", given));
        }
        let parameters = ModalParameters::read(&model)?;
        let integrator = ModalOscillators::new(&parameters, options.dt)?;
        let excitation =
            WindExcitation::new(&model, options.direction_radians, options.seed, options.nyquist_frequency());
        let crown = Crown::select(&model);
        let calibration = calibrate(&model, &excitation, &parameters, &crown, &options.target())?;
        let needs_motion = options.target().crown_sway() > 0.0;
        if needs_motion && calibration.gains.iter().all(|gain| *gain == 0.0) {
            let area: f64 = model.domains.iter().map(|domain| domain.area).sum();
            let given = format!("no motion in the wind (surface area {area}); use --wind 0 for a scene without wind");
            return Err(invalid_input(
                "scene",
                "a domain with a surface and with modes that the wind can excite",
                given,
            ));
        }
        Ok(Self {
            excitation,
            options,
            integrator,
            response: Response::at_rest(&model),
            viewer_response: None,
            next_step: 0,
            crown,
            attachments: Attachments::new(&model),
            gap_meter: JointGapMeter::new(&model),
            remarks: create_remarks(&model, &parameters, &options, &calibration),
            late_remarks: vec![],
            calibration,
            rigid_leaves: find_rigid_leaves(&model),
            earlier_peaks: Peaks::default(),
            last_step: None,
            model,
        })
    }

    /// The response one step after `next_step`.
    fn next_response(&self) -> Result<Response> {
        self.response.next(&self.integrator, &self.model, &self.excitation, self.next_step + 1)
    }

    /// The largest values of a step.
    fn measure(&self, step: &SentStep) -> Peaks {
        let SentStep { q, world_from_domain } = step;
        Peaks {
            sway: self.crown.sway(&self.model, q, world_from_domain),
            displacement: self.model.max_displacement(q, world_from_domain),
            gap: self.gap_meter.max_gap(&self.model, q, world_from_domain),
        }
    }

    /// The largest values of all steps.
    fn peaks(&self) -> Peaks {
        let last_peaks = self.last_step.as_ref().map(|step| self.measure(step));
        last_peaks.map_or(self.earlier_peaks, |last_peaks| self.earlier_peaks.max(last_peaks))
    }

    /// Rotations of rigid leaves about their bases, which follow the wind pressure. `None` for the other domains.
    fn leaf_rotations(&self) -> Vec<Option<AffineTransform>> {
        let angle_per_pressure = LEAF_ANGLE * self.options.wind_strength.clamp(0.0, MAX_LEAF_STRENGTH);
        let axes = &self.excitation.axes;
        let leaf_rotation = |((domain, is_rigid_leaf), pressure): ((&DomainModel, &bool), &WindPressure)| {
            // A rotation about the crosswind axis turns the upper end of a leaf downwind, and one about the negative
            // downwind axis turns it crosswind.
            let axis = axes.crosswind * pressure.downwind - axes.downwind * pressure.crosswind;
            let angle = (angle_per_pressure * axis.norm()).min(MAX_LEAF_ANGLE);
            (*is_rigid_leaf && angle > 0.0).then(|| {
                let local_axis = domain.placement.linear.transpose() * axis;
                AffineTransform::rotation_about(&local_axis, angle, &Vector3::zeros())
            })
        };
        self.model.domains.iter().zip(&self.rigid_leaves).zip(&self.response.pressures).map(leaf_rotation).collect()
    }
}

impl Scenario for TreeScenario {
    fn model(&self) -> &Model {
        &self.model
    }

    fn identity(&self) -> RunIdentity {
        let TreeOptions { dt: _, sway_fraction, wind_strength, direction_radians, seed } = self.options;
        RunIdentity::default()
            .with("motion", "modes in wind")
            .with_number("--wind", wind_strength)
            .with_number("--sway", sway_fraction)
            .with_number("--direction (radians)", direction_radians)
            .with("--seed", seed)
    }

    fn save(&self) -> Result<Value> {
        to_json(&SavedTree {
            response: self.response.clone(),
            viewer_response: self.viewer_response.as_ref().map(ViewerResponse::save),
            peaks: self.peaks(),
            late_remarks: self.late_remarks.clone(),
        })
    }

    fn restore(&mut self, next_step: u64, state: Value) -> Result<()> {
        let saved: SavedTree = from_json(state)?;
        saved.response.check(&self.model)?;
        let restore_viewer_response = |saved| {
            let mut viewer_response = ViewerResponse::at_rest(&self.model, &self.integrator);
            viewer_response.restore(saved).map(|()| viewer_response)
        };
        self.viewer_response = saved.viewer_response.map(restore_viewer_response).transpose()?;
        (self.response, self.next_step) = (saved.response, next_step);
        (self.earlier_peaks, self.last_step, self.late_remarks) = (saved.peaks, None, saved.late_remarks);
        Ok(())
    }

    fn compute_next_step(&mut self, values: &mut StepValues) -> Result<()> {
        let mut q = scale_response(&self.model, self.response.q(), &self.calibration.gains);
        if let Some(viewer_response) = &self.viewer_response {
            viewer_response.add_to(&mut q);
        }
        // The four computations below do not depend on each other, so they run concurrently.
        let compute_attachments = || self.attachments.deform(&self.model, &q);
        let measure_last_step = || self.peaks();
        let ((attachments, earlier_peaks), (leaf_rotations, next_response)) = rayon::join(
            || rayon::join(compute_attachments, measure_last_step),
            || rayon::join(|| self.leaf_rotations(), || self.next_response()),
        );
        let world_from_domain = compose_transforms(&self.model, &attachments, &leaf_rotations);
        values.q = q.iter().map(|coordinate| *coordinate as f32).collect();
        values.transforms = world_from_domain.iter().map(|transform| transform.to_row_major()).collect();
        let world_from_domain = values.transforms.iter().map(AffineTransform::from_row_major).collect();
        (self.earlier_peaks, self.last_step) = (earlier_peaks, Some(SentStep { q, world_from_domain }));
        (self.response, self.next_step) = (next_response?, self.next_step + 1);
        if let Some(viewer_response) = &mut self.viewer_response {
            viewer_response.advance(&self.integrator)?;
        }
        Ok(())
    }

    fn set_viewer_forces(&mut self, forces: &[f64]) -> Result<()> {
        if self.viewer_response.is_none() && forces.iter().all(|force| *force == 0.0) {
            return Ok(());
        }
        let viewer_response =
            self.viewer_response.get_or_insert_with(|| ViewerResponse::at_rest(&self.model, &self.integrator));
        let scale = viewer_response.set_forces(forces);
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
        let load_description = format!(
            "wind {} on all surfaces, calibrated to a crown sway of {:.3} of the height; branches bend by at most {:.3} of \
             their diagonal",
            self.options.wind_strength,
            self.calibration.sway_fraction,
            self.options.target().scale_bending_limit(MAX_BRANCH_BENDING),
        );
        let peaks = self.peaks();
        Report::from_iter([
            ("load".to_owned(), json!(load_description)),
            ("crown_sway_of_height".to_owned(), json!(peaks.sway)),
            ("peak_of_height".to_owned(), json!(peaks.displacement / self.model.height())),
            ("peak_of_diagonal".to_owned(), json!(peaks.displacement / self.model.diagonal())),
            ("joint_gap_max".to_owned(), json!(peaks.gap)),
            ("joint_gap_of_diagonal".to_owned(), json!(peaks.gap / self.model.diagonal())),
        ])
    }
}

/// Per domain: whether it is a branch with neither modes nor children.
fn find_rigid_leaves(model: &Model) -> Vec<bool> {
    let mut rigid_leaves: Vec<bool> =
        model.domains.iter().map(|domain| domain.rank == 0 && domain.joint.is_some()).collect();
    for joint in model.domains.iter().filter_map(|domain| domain.joint.as_ref()) {
        rigid_leaves[joint.parent] = false;
    }
    rigid_leaves
}

/// Remarks on held modes, omitted gusts and limited sway.
fn create_remarks(
    model: &Model,
    parameters: &ModalParameters,
    options: &TreeOptions,
    calibration: &Calibration,
) -> Vec<String> {
    let left_out_gusts = (options.nyquist_frequency() < Wind::highest_frequency()).then(|| {
        format!(
            "gusts above {} Hz are left out, because steps of {} s do not resolve them: choose steps below {} s",
            options.nyquist_frequency(),
            options.dt,
            0.5 / Wind::highest_frequency()
        )
    });
    let target_sway = options.target().crown_sway();
    let limited_sway = (calibration.sway_fraction < 0.99 * target_sway).then(|| {
        format!(
            "the crown sways by {:.4} of the height instead of {target_sway}, because the bending of trunk and branches \
             is limited",
            calibration.sway_fraction
        )
    });
    let unresolved_modes = nyquist_remark(parameters.frequencies(model), options.dt);
    let remarks = parameters.remarks.iter().cloned();
    remarks.chain(left_out_gusts).chain(limited_sway).chain(unresolved_modes).collect()
}
