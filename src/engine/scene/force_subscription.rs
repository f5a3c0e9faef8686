//! A reader of the forces of a scene. After every change it receives the newest set of forces with their f_q, the force
//! on the coordinates q of the domain.

use std::sync::Arc;
use std::time::{Duration, Instant};

use tokio::sync::watch;

use super::delivery::StreamDelivery;
use super::forces::{AppliedForce, ForceChannel, ForceReader, ForceSet};
use super::handle::SceneHandle;
use crate::engine::blocking::run_blocking;
use crate::engine::output::step_output::StepId;
use modalcast_model::error::Result;
use modalcast_model::scene::SceneState;

/// All forces in a scene.
#[derive(Debug, Clone, PartialEq)]
pub struct ForceReport {
    /// Why nothing receives the forces; empty if unknown.
    pub receiver_error: Arc<str>,
    /// The step with whose transforms f_q was computed. `None` if f_q depends on no transform.
    pub step: Option<StepId>,
    /// Ordered by owner.
    pub forces: Arc<[AppliedForce]>,
}

/// A reader of the forces of a scene. It holds no reports: [`Self::next`] returns the newest one.
#[derive(Debug)]
pub struct ForceSubscription {
    scene_handle: Arc<SceneHandle>,
    channel: Arc<ForceChannel>,
    reader: ForceReader,
    states: watch::Receiver<Arc<SceneState>>,
    /// Minimum time between two reports; `None` if there is no limit.
    min_interval: Option<Duration>,
    /// Earliest time of the next report; `None` if it may be returned at once.
    next_report_at: Option<Instant>,
    /// The last report; `None` before the first one.
    last_report: Option<ForceReport>,
}

impl ForceSubscription {
    /// Subscribes to the forces of a scene, at the rate of `delivery`. A `passive` reader does not simulate and is not
    /// counted as a receiver of the forces.
    ///
    /// # Errors
    /// `LimitReached` when the scene has too many readers.
    pub fn new(scene_handle: Arc<SceneHandle>, delivery: StreamDelivery, passive: bool) -> Result<Self> {
        let channel = Arc::clone(scene_handle.force_channel());
        let (reader, states) = (channel.subscribe(passive)?, scene_handle.watch_state());
        let min_interval = delivery.min_interval();
        Ok(Self { scene_handle, channel, reader, states, min_interval, next_report_at: None, last_report: None })
    }

    /// Returns the present forces, and then waits until the forces, their f_q or the receiver's error differ from those
    /// of the last report. Cancel-safe.
    ///
    /// # Errors
    /// The error with which the scene has ended.
    pub async fn next(&mut self) -> Result<ForceReport> {
        if let Some(next_report_at) = self.next_report_at {
            tokio::select! {
                () = tokio::time::sleep_until(next_report_at.into()) => {}
                error = self.scene_handle.ended() => return Err(error),
            }
        }
        loop {
            self.channel.drop_expired();
            let set = self.reader.sets.borrow_and_update().clone();
            let next_expiry = set.next_expiry();
            let depends_on_state = set.depends_on_state();
            let report = self.reduce(set, depends_on_state).await?;
            let is_equal =
                |last: &ForceReport| (&last.forces, &last.receiver_error) == (&report.forces, &report.receiver_error);
            if !self.last_report.as_ref().is_some_and(is_equal) {
                self.last_report = Some(report.clone());
                self.next_report_at = self.min_interval.and_then(|interval| Instant::now().checked_add(interval));
                return Ok(report);
            }
            self.wait_for_change(next_expiry, depends_on_state).await?;
        }
    }

    /// Computes f_q of all forces at the current state. Interpolating U takes too long for a thread of the runtime.
    async fn reduce(&mut self, set: ForceSet, depends_on_state: bool) -> Result<ForceReport> {
        let state = Arc::clone(&self.states.borrow_and_update());
        let step = depends_on_state.then(|| StepId::of(&state));
        let scene = Arc::clone(&self.scene_handle.scene);
        let receiver_error = Arc::clone(&set.receiver_error);
        let forces = match depends_on_state {
            true => run_blocking("forces", move || Ok(set.reduce(&scene, &state))).await?,
            false => set.reduce(&scene, &state),
        };
        Ok(ForceReport { receiver_error, step, forces: forces.into() })
    }

    /// Waits until the forces may have changed: they were set or may have expired or, if f_q depends on the state, a
    /// step is completed.
    async fn wait_for_change(&mut self, next_expiry: Option<Instant>, depends_on_state: bool) -> Result<()> {
        let expiry = async {
            match next_expiry {
                Some(next_expiry) => tokio::time::sleep_until(next_expiry.into()).await,
                None => std::future::pending().await,
            }
        };
        tokio::select! {
            // Neither sender is dropped before the scene ends: this subscription holds the channel.
            _ = self.reader.sets.changed() => Ok(()),
            Ok(()) = self.states.changed(), if depends_on_state => Ok(()),
            () = expiry => Ok(()),
            error = self.scene_handle.ended() => Err(error),
        }
    }
}
