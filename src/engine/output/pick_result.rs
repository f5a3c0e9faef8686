//! The result of a pick. It has the data that a client needs to apply a force at a picked point: the 3 x r block of U
//! at the point, where r is the number of modes, and the linear part A of the transform.

use std::sync::Arc;

use super::step_output::{ModalHit, OutputBody, StepId, StepOutput};
use crate::engine::blocking::run_blocking;
use crate::telemetry::StageTimes;
use modalcast_model::error::{Result, fault};
use modalcast_model::scene::{Scene, SceneState};
use modalcast_render::PickHit;

/// All hits of a pick in one step.
#[derive(Debug, Clone)]
pub struct PickResult {
    pub step: StepId,
    pub stages: StageTimes,
    pub hits: Vec<ModalHit>,
}

/// Adds the linear parts of the domains' transforms to hits.
fn with_transforms(state: &SceneState, scene: &Scene, hits: Vec<PickHit>) -> Vec<ModalHit> {
    let add_transform = |hit: PickHit| {
        let transform_entries = state.transform_of(scene, hit.domain).0;
        // The transform is 3 x 4, row-major. Its fourth column is the translation.
        let linear = [0, 1, 2, 4, 5, 6, 8, 9, 10].map(|entry: usize| transform_entries[entry]);
        ModalHit { hit, linear, modes: Vec::new() }
    };
    hits.into_iter().map(add_transform).collect()
}

/// Waits for the hits. Adds to every hit the block of U at its point if `with_modes` is true.
///
/// # Errors
/// The error of the device; `Fault` when `output` is not a pick.
pub async fn resolve_picks(output: StepOutput, scene: &Arc<Scene>, with_modes: bool) -> Result<PickResult> {
    let OutputBody::Pick(hits, state) = output.body else {
        return Err(fault("pick", "expected a pick, got another output"));
    };
    let (hits, scene) = (hits.wait().await?, Arc::clone(scene));
    let add_modes = move || {
        let mut hits = with_transforms(&state, &scene, hits);
        if with_modes {
            for modal_hit in &mut hits {
                let shape = &scene.shapes[scene.domains[modal_hit.hit.domain].shape];
                modal_hit.modes = shape.modes.block_at_point(modal_hit.hit.vertices, modal_hit.hit.barycentrics);
            }
        }
        Ok(hits)
    };
    Ok(PickResult { step: output.step, stages: output.stages, hits: run_blocking("pick", add_modes).await? })
}
