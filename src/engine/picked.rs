//! What a pick found, with what a client needs to push there: the rows of U at the point, and A.

use std::sync::Arc;

use super::blocking::run_blocking;
use super::viewer::{Body, Shown, StepName};
use crate::telemetry::StageTimes;
use modalcast_model::error::{Result, during};
use modalcast_model::scene::{Scene, State};
use modalcast_render::Hit;

/// One hit.
#[derive(Debug, Clone, PartialEq)]
pub struct Picked {
    /// Lengths are scene units.
    pub hit: Hit,
    /// A, the linear part of `world_from_domain` at the step, row-major.
    pub linear: [f32; 9],
    /// The 3 x r block of U at the point, row-major: a force f there (world axes) is f_q = U^T A^T f on the coordinates.
    pub modes: Vec<f32>,
}

/// The hits of one step.
#[derive(Debug, Clone)]
pub struct Picks {
    pub step: StepName,
    pub stages: StageTimes,
    pub hits: Vec<Picked>,
}

/// Hits with the linear parts of their domains' transforms; modes come later, off the device's path.
pub(super) fn with_transforms(state: &State, scene: &Scene, hits: Vec<Hit>) -> Vec<Picked> {
    let one = |hit: Hit| {
        let rows = state.transform_of(scene, hit.domain).0;
        let linear = [0, 1, 2, 4, 5, 6, 8, 9, 10].map(|entry: usize| rows[entry]);
        Picked { hit, linear, modes: Vec::new() }
    };
    hits.into_iter().map(one).collect()
}

/// Adds the block of U to every hit when `with_modes`.
///
/// # Errors
/// `Fault` when it was no pick that was shown.
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
