//! The response of linear modes to the forces of viewers.

use nalgebra::DVector;
use serde::{Deserialize, Serialize};

use crate::error::Result;
use crate::integrator::{Integrator as _, LoadChange, ModalOscillators, MotionState};
use crate::model::Model;
use crate::saved_state::{check_vector, vector_bits};
use crate::viewer_forces::force_scale;

/// The response of every mode to the forces of viewers on its coordinate: joints do not transmit the forces to other
/// domains.
pub(crate) struct ViewerResponse {
    current: ForcedMotion,
    /// Per coordinate: [`Model::displacements_per_unit`].
    displacements_per_unit: Vec<f64>,
    /// Per coordinate: 1 / omega^2; 0 for a mode that is held still.
    compliances: Vec<f64>,
}

/// The forces of viewers, and the motion that they cause.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct ForcedMotion {
    /// Per coordinate.
    #[serde(with = "vector_bits")]
    forces: DVector<f64>,
    state: MotionState,
}

impl ViewerResponse {
    /// The rest state without forces.
    pub(crate) fn at_rest(model: &Model, oscillators: &ModalOscillators) -> Self {
        Self {
            current: ForcedMotion {
                forces: DVector::zeros(model.coordinate_count),
                state: MotionState::resting(DVector::zeros(model.coordinate_count)),
            },
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
        self.current.forces = DVector::from_column_slice(forces) * scale;
        scale
    }

    /// Adds the response to the coordinates `q` and rounds them to f32, as the server receives them.
    pub(crate) fn add_to(&self, q: &mut [f64]) {
        for (coordinate, response) in q.iter_mut().zip(&self.current.state.q) {
            *coordinate = f64::from((*coordinate + response) as f32);
        }
    }

    /// Advances every mode by one step under constant forces.
    ///
    /// # Errors
    /// Those of the integrator.
    pub(crate) fn advance(&mut self, oscillators: &ModalOscillators) -> Result<()> {
        let ForcedMotion { forces, state } = &mut self.current;
        oscillators.advance(state, LoadChange { start: forces, end: forces }).map(drop)
    }

    /// The state for a checkpoint.
    pub(crate) fn save(&self) -> ForcedMotion {
        self.current.clone()
    }

    /// Continues from a state of [`Self::save`].
    ///
    /// # Errors
    /// `Invalid` if the state is that of another number of coordinates, or a number is not finite.
    pub(crate) fn restore(&mut self, saved: ForcedMotion) -> Result<()> {
        let count = self.compliances.len();
        check_vector("forces", &saved.forces, count)?;
        saved.state.check(count)?;
        self.current = saved;
        Ok(())
    }
}
