//! The output of one step, as a reader receives it.

use std::sync::Arc;

use super::rendered_picture::RenderedPicture;
use super::step_vertices::StepVertices;
use crate::engine::device::handle::PendingReply;
use crate::telemetry::StageTimes;
use modalcast_model::scene::{FloatingOrigins, SceneState};
use modalcast_render::PickHit;

/// Identifies a step. Step numbers are unique within one run; each writer starts a new run.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StepId {
    /// 0 before the scene's first step.
    pub run: u64,
    pub number: u64,
    /// Simulation time in seconds.
    pub time: f64,
}

impl StepId {
    pub(in crate::engine) const fn of(state: &SceneState) -> Self {
        Self { run: state.run, number: state.step, time: state.time }
    }
}

/// A picture of a step that is being drawn. Readers of equal pictures share it.
pub type SharedPicture = Arc<PendingReply<Arc<RenderedPicture>>>;

/// The content of an output. The device may still be working on it.
#[derive(Debug, Clone)]
pub enum OutputBody {
    Frames(StepFrames),
    Vertices(Arc<PendingReply<Arc<StepVertices>>>),
    /// The hits, and the state of the step.
    Pick(Arc<PendingReply<Vec<PickHit>>>, Arc<SceneState>),
    State(Arc<SceneState>),
}

/// All pictures of one step.
#[derive(Debug, Clone)]
pub struct StepFrames {
    /// One per requested picture, in the same order.
    pub pictures: Vec<SharedPicture>,
    /// Number of camera updates that the pictures include; 0 for a single request.
    pub camera_version: u64,
}

/// The output of one step for one [`super::output_spec::OutputSpec`].
#[derive(Debug, Clone)]
pub struct StepOutput {
    pub step: StepId,
    /// Steps that this subscriber skipped since its last output.
    pub skipped: u64,
    pub stages: StageTimes,
    /// The floating origins: per domain, the f64 point that its vertices are relative to. `None` if all are relative to
    /// the scene's origin.
    pub origins: Option<Arc<FloatingOrigins>>,
    pub body: OutputBody,
}

/// One hit of a pick.
#[derive(Debug, Clone, PartialEq)]
pub struct ModalHit {
    /// Lengths are in scene units.
    pub hit: PickHit,
    /// A, the linear part of `world_from_domain` at the step, row-major.
    pub linear: [f32; 9],
    /// The 3 x r block of U at the point, row-major. A force f at the point (world axes) acts on the coordinates as
    /// f_q = U^T A^T f.
    pub modes: Vec<f32>,
}
