//! The response of all modes to the wind or to the forces of viewers, by exact integration of every mode.

use nalgebra::DVector;

use super::excitation::WindExcitation;
use crate::error::Result;
use crate::integrator::{Integrator, LoadChange, ModalOscillators, MotionState};
use crate::model::Model;
use crate::viewer_forces::force_scale;
use crate::wind::WindPressure;

/// The wind and the response to it at one time, with gain 1 (see `calibration`).
pub(super) struct Response {
    state: MotionState,
    /// Per coordinate.
    forces: DVector<f64>,
    /// Per domain.
    pub(super) pressures: Vec<WindPressure>,
}

/// The response of every mode to the forces of viewers. The modes are linear, so this response is added to the response
/// to the wind. The gains do not scale it. A force acts on one domain only: joints do not transmit it to the parent.
pub(super) struct ViewerResponse {
    /// Per coordinate.
    forces: DVector<f64>,
    state: MotionState,
    /// Per coordinate: [`Model::displacements_per_unit`].
    displacements_per_unit: Vec<f64>,
    /// Per coordinate: 1 / omega^2; 0 for a mode that is held still.
    compliances: Vec<f64>,
}

impl Response {
    /// The rest state without wind, at step 0.
    pub(super) fn at_rest(model: &Model) -> Self {
        Self {
            state: MotionState::resting(DVector::zeros(model.coordinate_count)),
            forces: DVector::zeros(model.coordinate_count),
            pressures: vec![WindPressure::default(); model.domains.len()],
        }
    }

    /// The response at step `next_step`, one step after this one.
    ///
    /// # Errors
    /// Those of the integrator.
    pub(super) fn next(
        &self,
        integrator: &dyn Integrator,
        model: &Model,
        excitation: &WindExcitation,
        next_step: u64,
    ) -> Result<Self> {
        let pressures = excitation.pressures(integrator.dt() * next_step as f64);
        let forces = DVector::from_vec(excitation.compute_forces(model, &pressures));
        let mut state = self.state.clone();
        integrator.advance(&mut state, LoadChange { start: &self.forces, end: &forces })?;
        Ok(Self { state, forces, pressures })
    }

    /// Per coordinate.
    pub(super) fn q(&self) -> &[f64] {
        self.state.q.as_slice()
    }
}

impl ViewerResponse {
    /// The rest state without forces.
    pub(super) fn at_rest(model: &Model, oscillators: &ModalOscillators) -> Self {
        Self {
            forces: DVector::zeros(model.coordinate_count),
            state: MotionState::resting(DVector::zeros(model.coordinate_count)),
            displacements_per_unit: model.displacements_per_unit(),
            compliances: oscillators.compliances(),
        }
    }

    /// Sets the forces, one number per coordinate. Forces that displace the tree by more than
    /// [`MAX_STATIC_DISPLACEMENT`](crate::viewer_forces::MAX_STATIC_DISPLACEMENT) are scaled down.
    pub(super) fn set_forces(&mut self, forces: &[f64]) {
        let q: Vec<f64> = forces.iter().zip(&self.compliances).map(|(force, compliance)| force * compliance).collect();
        let scale = force_scale(&q, &self.displacements_per_unit);
        self.forces = DVector::from_column_slice(forces) * scale;
    }

    /// Adds the response to the coordinates `q` and rounds them to f32, as the server receives them.
    pub(super) fn add_to(&self, q: &mut [f64]) {
        for (coordinate, response) in q.iter_mut().zip(&self.state.q) {
            *coordinate = f64::from((*coordinate + response) as f32);
        }
    }

    /// Advances every mode by one step under constant forces.
    ///
    /// # Errors
    /// Those of the integrator.
    pub(super) fn advance(&mut self, integrator: &dyn Integrator) -> Result<()> {
        let load = LoadChange { start: &self.forces, end: &self.forces };
        integrator.advance(&mut self.state, load).map(drop)
    }
}
