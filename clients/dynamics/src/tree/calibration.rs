//! Calibrates the wind to a given sway.
//!
//! A calibration run, which sends no steps, applies the wind for a duration of its own. So the result does not depend
//! on the step size or the number of steps that are sent later. The modes are linear, so their response can be scaled:
//! the gain of a domain is the factor of the response of its modes, and the calibration run has gain 1. The calibration
//! finds a common gain, at which the peak of the crown's mean displacement is the requested fraction of the height. A
//! branch gets a smaller gain if it would bend by more than a fraction of its diagonal, because linear modes do not
//! represent large bending.
//!
//! Bending is the elastic displacement U q. The wind strength, an option of the scenario, scales the requested sway and
//! the bending limits.

use rayon::prelude::*;

use super::crown::Crown;
use super::excitation::WindExcitation;
use super::response::Response;
use crate::attachments::Attachments;
use crate::error::Result;
use crate::hierarchy::compose_transforms;
use crate::integrator::ModalOscillators;
use crate::model::{DomainModel, MIN_DOMAINS_PER_THREAD, Model};
use crate::parameters::ModalParameters;

/// Maximum bending of a branch as a fraction of its diagonal, at wind strength 1.
pub(super) const MAX_BRANCH_BENDING: f64 = 0.05;

/// Maximum bending of the trunk as a fraction of its diagonal, at wind strength 1.
const MAX_TRUNK_BENDING: f64 = 0.2;

/// Maximum factor by which the wind strength scales the bending limits.
const MAX_BENDING_SCALE: f64 = 2.5;

/// Minimum duration of the calibration run in seconds.
const MIN_DURATION: f64 = 30.0;

/// Minimum duration of the calibration run in periods of the slowest mode.
const MIN_PERIODS: f64 = 6.0;

/// Number of steps of the calibration run. At the minimum duration, a step takes 0.05 s and resolves all frequencies of
/// the wind.
const STEP_COUNT: u64 = 600;

/// Number of recorded states at which the calibration evaluates the sway: the states with the largest trunk
/// displacements.
const EVALUATED_STATES: usize = 24;

/// Maximum size of all stored states of the calibration run, in bytes.
const MAX_STATE_BYTES: u64 = 64 << 20;

/// Requested motion of a tree.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct SwayTarget {
    /// Peak displacement of the crown at wind strength 1, as a fraction of the height.
    pub(super) sway_fraction: f64,
    pub(super) wind_strength: f64,
}

/// The gain of each domain, and the sway at these gains as a fraction of the height.
pub(super) struct Calibration {
    /// Per domain.
    pub(super) gains: Vec<f64>,
    pub(super) sway_fraction: f64,
}

/// The response to the wind in the calibration run.
struct UnitResponse {
    /// Per domain: largest elastic displacement of its surface samples, in scene units.
    bending: Vec<f64>,
    /// The coordinates at the steps with the largest trunk displacements.
    coordinates: Vec<Vec<f64>>,
}

impl SwayTarget {
    /// Peak displacement of the crown as a fraction of the height.
    pub(super) fn crown_sway(&self) -> f64 {
        self.sway_fraction * self.wind_strength
    }

    /// Scales a bending limit at wind strength 1 to the wind strength.
    pub(super) fn scale_bending_limit(&self, limit: f64) -> f64 {
        limit * self.wind_strength.clamp(0.0, MAX_BENDING_SCALE)
    }

    /// The gain of each domain: `common_gain`, reduced for branches that would exceed their bending limit.
    fn compute_gains(&self, model: &Model, common_gain: f64, bending: &[f64]) -> Vec<f64> {
        let gain = |(domain, bending): (&DomainModel, &f64)| match (&domain.joint, *bending > 0.0) {
            (Some(_), true) => {
                common_gain.min(self.scale_bending_limit(MAX_BRANCH_BENDING) * domain.diagonal / bending)
            }
            _ => common_gain,
        };
        model.domains.iter().zip(bending).map(gain).collect()
    }

    /// The gain at which the trunk reaches its bending limit. If no trunk deforms, the gain at which all branches have
    /// reached their limits. 0 if nothing deforms.
    fn max_common_gain(&self, model: &Model, bending: &[f64]) -> f64 {
        let bending_domains = || model.domains.iter().zip(bending).filter(|(_, bending)| **bending > 0.0);
        let gain_at = |limit: f64, domain: &DomainModel, bending: f64| {
            self.scale_bending_limit(limit) * domain.diagonal / bending
        };
        let roots = bending_domains().filter(|(domain, _)| domain.joint.is_none());
        let trunk_gain =
            roots.map(|(domain, bending)| gain_at(MAX_TRUNK_BENDING, domain, *bending)).fold(f64::MAX, f64::min);
        if trunk_gain < f64::MAX {
            return trunk_gain;
        }
        bending_domains().map(|(domain, bending)| gain_at(MAX_BRANCH_BENDING, domain, *bending)).fold(0.0, f64::max)
    }
}

/// Finds the gains at which the peak displacement of the crown is the requested fraction of the height. If the bending
/// limits do not allow these gains, returns the largest gains that the limits allow. All gains are 0 if the wind does
/// not deform the scene.
///
/// # Errors
/// `Invalid` as for [`ModalOscillators::new`].
pub(super) fn calibrate(
    model: &Model,
    excitation: &WindExcitation,
    parameters: &ModalParameters,
    crown: &Crown,
    target: &SwayTarget,
) -> Result<Calibration> {
    let response = record_unit_response(model, excitation, parameters)?;
    let attachments = Attachments::new(model);
    let evaluate = |common_gain: f64| {
        let gains = target.compute_gains(model, common_gain, &response.bending);
        let sway = |unit_q: &Vec<f64>| {
            let q = scale_response(model, unit_q, &gains);
            crown.sway(model, &q, &compose_transforms(model, &attachments.deform(model, &q), &[]))
        };
        let sway_fraction = response.coordinates.iter().map(sway).fold(0.0, f64::max);
        Calibration { gains, sway_fraction }
    };
    let mut high_gain = target.max_common_gain(model, &response.bending);
    let can_sway = target.crown_sway() > 0.0 && high_gain > 0.0;
    if !can_sway {
        return Ok(Calibration { gains: vec![0.0; model.domains.len()], sway_fraction: 0.0 });
    }
    if evaluate(high_gain).sway_fraction > target.crown_sway() {
        let mut low_gain = 0.0;
        // 24 bisections reduce the interval by a factor of 1.7e7.
        for _ in 0..24 {
            let middle_gain = 0.5 * (low_gain + high_gain);
            if evaluate(middle_gain).sway_fraction > target.crown_sway() {
                high_gain = middle_gain;
            } else {
                low_gain = middle_gain;
            }
        }
    }
    Ok(evaluate(high_gain))
}

/// Runs with gain 1 and records the response.
fn record_unit_response(
    model: &Model,
    excitation: &WindExcitation,
    parameters: &ModalParameters,
) -> Result<UnitResponse> {
    let longest_period = parameters.lowest_frequency().map_or(0.0, f64::recip);
    let dt = MIN_DURATION.max(MIN_PERIODS * longest_period) / STEP_COUNT as f64;
    let integrator = ModalOscillators::new(parameters, dt)?;
    // Record every `stride`-th state, so that all of them fit in `MAX_STATE_BYTES`. A state has 8 bytes per coordinate.
    let stride = (STEP_COUNT * model.coordinate_count as u64 * 8).div_ceil(MAX_STATE_BYTES).max(1);
    let mut bending = vec![0.0_f64; model.domains.len()];
    let mut recorded_states = vec![];
    let mut response = Response::at_rest(model);
    for step in 1..=STEP_COUNT {
        response = response.next(&integrator, model, excitation, step)?;
        let q = response.q();
        let domains = model.domains.par_iter().with_min_len(MIN_DOMAINS_PER_THREAD);
        let displacements: Vec<f64> = domains.map(|domain| elastic_displacement(domain, domain.q(q))).collect();
        let root_displacements = model.domains.iter().zip(&displacements).filter(|(domain, _)| domain.joint.is_none());
        let trunk_displacement: f64 = root_displacements.map(|(_, displacement)| displacement).sum();
        for (bending, displacement) in bending.iter_mut().zip(displacements) {
            *bending = bending.max(displacement);
        }
        if step % stride == 0 {
            recorded_states.push((trunk_displacement, q.to_vec()));
        }
    }
    // Largest trunk displacement first.
    recorded_states.sort_by(|(a_displacement, _), (b_displacement, _)| b_displacement.total_cmp(a_displacement));
    recorded_states.truncate(EVALUATED_STATES);
    Ok(UnitResponse { bending, coordinates: recorded_states.into_iter().map(|(_, q)| q).collect() })
}

/// Multiplies the response at gain 1 by the gain of each domain, and rounds it to f32.
pub(super) fn scale_response(model: &Model, unit_q: &[f64], gains: &[f64]) -> Vec<f64> {
    let mut q = vec![0.0; model.coordinate_count];
    for (domain, gain) in model.domains.iter().zip(gains) {
        for coordinate in domain.first_coordinate..domain.first_coordinate + domain.rank {
            q[coordinate] = f64::from((unit_q[coordinate] * gain) as f32);
        }
    }
    q
}

/// The largest elastic displacement of a domain's surface samples, in scene units.
fn elastic_displacement(domain: &DomainModel, q: &[f64]) -> f64 {
    domain.surface_samples().iter().map(|sample| sample.displacement(q).norm()).fold(0.0, f64::max)
}
