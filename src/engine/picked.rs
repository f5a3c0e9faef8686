//! The result of a pick, with the data that a client needs to apply a force at the point: the rows of U and the linear
//! part A of the transform.

use std::sync::Arc;

use super::blocking::run_blocking;
use super::viewer::{Body, Shown, StepName};
use crate::telemetry::StageTimes;
use modalcast_model::error::{Result, during};
use modalcast_model::scene::{Scene, State};
use modalcast_render::Hit;

/// One hit of a pick.
#[derive(Debug, Clone, PartialEq)]
pub struct Picked {
    /// Lengths are in scene units.
    pub hit: Hit,
    /// A, the linear part of `world_from_domain` at the step, row-major.
    pub linear: [f32; 9],
    /// The 3 x r block of U at the point, row-major. A force f at the point (world axes) acts on the coordinates as
    /// f_q = U^T A^T f.
    pub modes: Vec<f32>,
}

/// All hits of a pick in one step.
#[derive(Debug, Clone)]
pub struct Picks {
    pub step: StepName,
    pub stages: StageTimes,
    pub hits: Vec<Picked>,
}

/// Adds the linear parts of the domains' transforms to hits. [`resolve_picks`] adds the modes outside the scene's task.
pub(super) fn with_transforms(state: &State, scene: &Scene, hits: Vec<Hit>) -> Vec<Picked> {
    let one = |hit: Hit| {
        let rows = state.transform_of(scene, hit.domain).0;
        let linear = [0, 1, 2, 4, 5, 6, 8, 9, 10].map(|entry: usize| rows[entry]);
        Picked { hit, linear, modes: Vec::new() }
    };
    hits.into_iter().map(one).collect()
}

/// Adds the block of U to every hit if `with_modes` is true.
///
/// # Errors
/// `Fault` when `shown` is not a pick.
pub async fn resolve_picks(shown: Shown, scene: &Arc<Scene>, with_modes: bool) -> Result<Picks> {
    let Body::Picked(mut hits) = shown.body else { return Err(during("pick")("a picture is no pick")) };
    let scene = Arc::clone(scene);
    let work = move || {
        for picked in hits.iter_mut().filter(|_| with_modes) {
            let shape = &scene.shapes[scene.domains[picked.hit.domain].shape];
            picked.modes = shape.modes.at_point(picked.hit.vertices, picked.hit.shares);
        }
        Ok(hits)
    };
    Ok(Picks { step: shown.step, stages: shown.stages, hits: run_blocking("pick", work).await? })
}
