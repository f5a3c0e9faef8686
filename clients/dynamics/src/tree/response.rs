//! The response of all modes to the wind or to the forces of viewers, by exact integration of every mode.

use super::excitation::WindExcitation;
use crate::error::Result;
use crate::model::Model;
use crate::oscillator::{ModeState, Oscillator};
use crate::parameters::{ModalParameters, ModeParameters};
use crate::viewer_forces::force_scale;
use crate::wind::WindPressure;

/// One oscillator per coordinate, for one step size.
pub(super) struct Integrator {
    oscillators: Vec<Oscillator>,
    /// Seconds per step.
    dt: f64,
}

/// The wind and the response to it at one time, with gain 1 (see `calibration`).
pub(super) struct Response {
    /// Per coordinate.
    states: Vec<ModeState>,
    /// Per coordinate.
    forces: Vec<f64>,
    /// Per domain.
    pub(super) pressures: Vec<WindPressure>,
}

/// The response of every mode to the forces of viewers. The modes are linear, so this response is added to the response
/// to the wind. The gains do not scale it. A force acts on one domain only: joints do not transmit it to the parent.
pub(super) struct ViewerResponse {
    /// Per coordinate.
    pub(super) forces: Vec<f64>,
    /// Per coordinate.
    states: Vec<ModeState>,
    /// Per coordinate: [`Model::displacements_per_unit`].
    displacements_per_unit: Vec<f64>,
    /// Per coordinate: 1 / omega^2; 0 for a mode that is held still.
    compliances: Vec<f64>,
}

impl Integrator {
    /// Creates one oscillator per coordinate, for steps of `dt` seconds.
    ///
    /// # Errors
    /// `Invalid` if the step is not positive.
    pub(super) fn new(parameters: &ModalParameters, dt: f64) -> Result<Self> {
        let create_oscillator = |mode: &Option<ModeParameters>| match mode {
            Some(ModeParameters { eigenvalue, damping_ratio }) => Oscillator::new(*eigenvalue, *damping_ratio, dt),
            None => Ok(Oscillator::new_fixed()),
        };
        Ok(Self { oscillators: parameters.modes.iter().map(create_oscillator).collect::<Result<_>>()?, dt })
    }

    /// The response at step `next_step`, one step after `response`.
    pub(super) fn advance(
        &self,
        model: &Model,
        excitation: &WindExcitation,
        response: &Response,
        next_step: u64,
    ) -> Response {
        let pressures = excitation.pressures(self.dt * next_step as f64);
        let forces = excitation.compute_forces(model, &pressures);
        let Response { states, forces: last_forces, .. } = response;
        let advance = |(coordinate, state): (usize, &ModeState)| {
            self.oscillators[coordinate].advance(*state, last_forces[coordinate], forces[coordinate])
        };
        Response { states: states.iter().enumerate().map(advance).collect(), forces, pressures }
    }
}

impl Response {
    /// The rest state without wind, at step 0.
    pub(super) fn at_rest(model: &Model) -> Self {
        Self {
            states: vec![ModeState::default(); model.coordinate_count],
            forces: vec![0.0; model.coordinate_count],
            pressures: vec![WindPressure::default(); model.domains.len()],
        }
    }

    /// Per coordinate.
    pub(super) fn q(&self) -> Vec<f64> {
        self.states.iter().map(|state| state.q).collect()
    }
}

impl ViewerResponse {
    /// The rest state without forces.
    pub(super) fn at_rest(model: &Model, integrator: &Integrator) -> Self {
        Self {
            forces: vec![0.0; model.coordinate_count],
            states: vec![ModeState::default(); model.coordinate_count],
            displacements_per_unit: model.displacements_per_unit(),
            compliances: integrator.oscillators.iter().map(Oscillator::compliance).collect(),
        }
    }

    /// Sets the forces, one number per coordinate. Forces that displace the tree by more than
    /// [`MAX_STATIC_DISPLACEMENT`](crate::viewer_forces::MAX_STATIC_DISPLACEMENT) are scaled down.
    pub(super) fn set_forces(&mut self, forces: &[f64]) {
        let q: Vec<f64> = forces.iter().zip(&self.compliances).map(|(force, compliance)| force * compliance).collect();
        let scale = force_scale(&q, &self.displacements_per_unit);
        self.forces = forces.iter().map(|force| scale * force).collect();
    }

    /// Adds the response to the coordinates `q` and rounds them to f32, as the server receives them.
    pub(super) fn add_to(&self, q: &mut [f64]) {
        for (coordinate, state) in q.iter_mut().zip(&self.states) {
            *coordinate = f64::from((*coordinate + state.q) as f32);
        }
    }

    /// Advances every mode by one step under constant forces.
    pub(super) fn advance(&mut self, integrator: &Integrator) {
        for ((state, force), oscillator) in self.states.iter_mut().zip(&self.forces).zip(&integrator.oscillators) {
            *state = oscillator.advance(*state, *force, *force);
        }
    }
}
