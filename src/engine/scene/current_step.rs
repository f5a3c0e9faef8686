//! The step that a scene shows.

use std::sync::Arc;

use crate::engine::output::step_output::StepId;
use crate::telemetry::StageTimes;
use modalcast_model::scene::SceneState;

/// The step whose vertices the device holds.
#[derive(Debug, Clone)]
pub(super) struct CurrentStep {
    pub state: Arc<SceneState>,
    /// Number of steps applied to the scene, merged ones included.
    pub step_count: u64,
    /// Stage times up to the end of the deformation.
    pub stages: StageTimes,
}

impl CurrentStep {
    /// The step of a scene that is opened with a restored state or the rest state.
    pub(super) fn of_opened_scene(state: Arc<SceneState>) -> Self {
        // A restored state counts as one step. The rest state is no step: its run, which counts the writers so far, is
        // 0.
        let step_count = u64::from(state.run > 0);
        Self { state, step_count, stages: Vec::new() }
    }

    pub(super) fn id(&self) -> StepId {
        StepId::of(&self.state)
    }
}
