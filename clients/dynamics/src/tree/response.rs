//! The response of all modes to the wind, by exact integration of every mode.

use nalgebra::DVector;
use serde::{Deserialize, Serialize};

use super::excitation::WindExcitation;
use crate::error::{Result, invalid_input};
use crate::integrator::{Integrator, LoadChange, MotionState};
use crate::model::Model;
use crate::saved_state::{check_vector, vector_bits};
use crate::wind::WindPressure;

/// The wind and the response to it at one time, with gain 1 (see `calibration`).
#[derive(Clone, Serialize, Deserialize)]
pub(super) struct Response {
    state: MotionState,
    /// Per coordinate.
    #[serde(with = "vector_bits")]
    forces: DVector<f64>,
    /// Per domain.
    pub(super) pressures: Vec<WindPressure>,
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

    /// Checks a response that was read from a checkpoint.
    ///
    /// # Errors
    /// `Invalid` if a list has another length than the model demands, or a number is not finite.
    pub(super) fn check(&self, model: &Model) -> Result<()> {
        self.state.check(model.coordinate_count)?;
        check_vector("forces", &self.forces, model.coordinate_count)?;
        if self.pressures.len() != model.domains.len() {
            let expected = format!("{} domains", model.domains.len());
            return Err(invalid_input("state.pressures", expected, self.pressures.len()));
        }
        Ok(())
    }

    /// Per coordinate.
    pub(super) fn q(&self) -> &[f64] {
        self.state.q.as_slice()
    }
}
