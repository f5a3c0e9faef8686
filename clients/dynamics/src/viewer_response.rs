//! The response of linear modes to the forces of viewers.

use nalgebra::DVector;

use crate::error::Result;
use crate::integrator::{Integrator as _, LoadChange, ModalOscillators, MotionState};
use crate::model::Model;
use crate::viewer_forces::force_scale;

/// The response of every mode to the forces of viewers. The modes are linear, so this response is added to the response
/// to the wind. The gains of the wind do not scale it. A force acts on one domain only: joints do not transmit it to the parent.
pub(crate) struct ViewerResponse {
    /// Per coordinate.
    forces: DVector<f64>,
    state: MotionState,
    /// Per coordinate: [`Model::displacements_per_unit`].
    displacements_per_unit: Vec<f64>,
    /// Per coordinate: 1 / omega^2; 0 for a mode that is held still.
    compliances: Vec<f64>,
}

impl ViewerResponse {
    /// The rest state without forces.
    pub(crate) fn at_rest(model: &Model, oscillators: &ModalOscillators) -> Self {
        Self {
            forces: DVector::zeros(model.coordinate_count),
            state: MotionState::resting(DVector::zeros(model.coordinate_count)),
            displacements_per_unit: model.displacements_per_unit(),
            compliances: oscillators.compliances(),
        }
    }

    /// Sets the forces, one number per coordinate. Forces that displace the scene by more than
    /// [`MAX_STATIC_DISPLACEMENT`](crate::viewer_forces::MAX_STATIC_DISPLACEMENT) are scaled down. Returns the
    /// factor, at most 1.
    pub(crate) fn set_forces(&mut self, forces: &[f64]) -> f64 {
        let q: Vec<f64> = forces.iter().zip(&self.compliances).map(|(force, compliance)| force * compliance).collect();
        let scale = force_scale(&q, &self.displacements_per_unit);
        self.forces = DVector::from_column_slice(forces) * scale;
        scale
    }

    /// Adds the response to the coordinates `q` and rounds them to f32, as the server receives them.
    pub(crate) fn add_to(&self, q: &mut [f64]) {
        for (coordinate, response) in q.iter_mut().zip(&self.state.q) {
            *coordinate = f64::from((*coordinate + response) as f32);
        }
    }

    /// Advances every mode by one step under constant forces.
    ///
    /// # Errors
    /// Those of the integrator.
    pub(crate) fn advance(&mut self, oscillators: &ModalOscillators) -> Result<()> {
        let load = LoadChange { start: &self.forces, end: &self.forces };
        oscillators.advance(&mut self.state, load).map(drop)
    }
}
