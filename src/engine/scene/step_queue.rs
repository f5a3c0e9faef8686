//! The bounded queue of steps from one writer to its scene, and the queue of reports back to the writer. The window
//! bounds both: `lossless` rejects a step beyond the window, `latest` merges a step into the one already queued.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::Instant;

use tokio::sync::Notify;

use crate::engine::lock::lock;
use crate::telemetry::{Stage, StageTimes, ms_since};
use modalcast_model::error::{Error, Result, invalid};
use modalcast_model::scene::StepUpdate;

/// What happens to steps that arrive faster than the scene completes them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Policy {
    /// Every step is deformed, in order.
    Lossless,
    /// Queued steps are merged into one whose effect on the state equals applying all of them in order.
    Latest,
}

/// An accepted step in the queue.
#[derive(Debug)]
pub(in crate::engine) struct QueuedStep {
    pub update: StepUpdate,
    /// Number of older steps that were merged into this one.
    pub merged: u64,
    parse_ms: f64,
    since: Instant,
}

impl QueuedStep {
    pub(in crate::engine) fn new(update: StepUpdate, parse_ms: f64) -> Self {
        Self { update, merged: 0, parse_ms, since: Instant::now() }
    }

    /// Parse time, and queue time until now.
    pub(in crate::engine) fn stages(&self) -> StageTimes {
        vec![(Stage::Parse, self.parse_ms), (Stage::Queue, ms_since(self.since))]
    }
}

/// The outcome of a step.
#[derive(Debug, Clone, PartialEq)]
pub enum StepReport {
    /// All steps up to this one are completed or superseded. `skipped` counts the steps merged since the stream began.
    Done { step: u64, skipped: u64, stages: StageTimes },
    /// The step failed; the scene is as it was before the step.
    Rejected { step: u64, error: Error },
}

/// The step queue, shared by a writer's handle and its scene. The lock is never held across an await.
#[derive(Debug)]
pub(in crate::engine) struct StepQueue {
    policy: Policy,
    window: usize,
    inner: Mutex<QueueState>,
    /// Notifies the scene of a new step or a closed queue.
    scene: Arc<Notify>,
    /// Notifies the writer of a report or the end.
    writer: Notify,
}

/// A computed step whose acknowledgement is outstanding.
#[derive(Debug)]
pub(super) struct CompletedStep {
    step_queue: Arc<StepQueue>,
    stages: StageTimes,
}

impl CompletedStep {
    pub(super) const fn new(step_queue: Arc<StepQueue>, stages: StageTimes) -> Self {
        Self { step_queue, stages }
    }

    /// Whether subscribers may block the writer: it is lossless and still connected.
    pub(super) fn applies_back_pressure(&self) -> bool {
        self.step_queue.policy() == Policy::Lossless && !self.step_queue.is_closed()
    }

    /// Reports the step to its writer as done. Steps of a queue are acknowledged in the order in which they were taken.
    pub(super) fn acknowledge(self) {
        self.step_queue.report(Ok(self.stages));
    }
}

/// The writer's lease on a scene. Dropping it closes the queue and admits the next writer, also if the reply that
/// carries the lease is dropped because the client has disconnected.
#[derive(Debug)]
pub(in crate::engine) struct WriterLease(pub Arc<StepQueue>);

impl Drop for WriterLease {
    fn drop(&mut self) {
        self.0.close();
    }
}

#[derive(Debug, Default)]
struct QueueState {
    queued: VecDeque<QueuedStep>,
    /// Numbers of the steps taken and not yet reported, oldest first. More than one while readbacks of the earlier ones
    /// are in flight.
    in_progress: VecDeque<u64>,
    reports: VecDeque<StepReport>,
    skipped: u64,
    /// The writer has dropped its lease.
    closed: bool,
    /// The error with which the server ended the queue.
    ended: Option<Error>,
}

impl StepQueue {
    pub(in crate::engine) fn new(policy: Policy, window: u32, scene: Arc<Notify>) -> Self {
        Self { policy, window: window.max(1) as usize, inner: Mutex::default(), scene, writer: Notify::new() }
    }

    pub(in crate::engine) const fn policy(&self) -> Policy {
        self.policy
    }

    /// Queues a step.
    ///
    /// # Errors
    /// `Invalid` naming the window when the step is beyond it, or the error that ended the queue.
    pub(in crate::engine) fn push(&self, step: QueuedStep) -> Result<()> {
        let mut inner = self.lock();
        if let Some(error) = &inner.ended {
            return Err(error.clone());
        }
        match (self.policy, inner.queued.pop_back()) {
            (Policy::Latest, Some(older)) => {
                inner.skipped += 1;
                let merged = older.merged + 1;
                inner.queued.push_back(QueuedStep { update: step.update.merged_after(&older.update), merged, ..step });
            }
            (_, last) => {
                inner.queued.extend(last);
                self.check_window(&inner, step.update.number)?;
                inner.queued.push_back(step);
            }
        }
        self.scene.notify_one();
        Ok(())
    }

    /// Removes the next step to compute. The step counts against the window until its report is taken.
    pub(in crate::engine) fn take(&self) -> Option<QueuedStep> {
        let mut inner = self.lock();
        let step = inner.queued.pop_front()?;
        inner.in_progress.push_back(step.update.number);
        Some(step)
    }

    /// Whether a step is queued.
    pub(in crate::engine) fn has_queued(&self) -> bool {
        !self.lock().queued.is_empty()
    }

    /// Reports the outcome of the oldest step in progress; does nothing if there is none.
    pub(super) fn report(&self, outcome: Result<StageTimes>) {
        let mut inner = self.lock();
        let Some(step) = inner.in_progress.pop_front() else { return };
        let skipped = inner.skipped;
        let report = match outcome {
            Ok(stages) => StepReport::Done { step, skipped, stages },
            Err(error) => StepReport::Rejected { step, error },
        };
        // Under `latest` a writer may read reports slowly. A newer `Done` covers the older one and replaces it.
        // `Rejected` is never replaced. A writer that reads none of them is cut off with the rejection that exceeds the
        // window; that one and later reports are dropped.
        let supersedes =
            matches!((inner.reports.back(), &report), (Some(StepReport::Done { .. }), StepReport::Done { .. }));
        if inner.reports.len() >= self.window && supersedes {
            inner.reports.pop_back();
        }
        if inner.reports.len() > self.window {
            inner.ended.get_or_insert(Error::Busy { queue: "replies not read by the writer", limit: self.window });
        } else {
            inner.reports.push_back(report);
        }
        self.writer.notify_one();
    }

    /// Waits for the next report. Cancel-safe.
    ///
    /// # Errors
    /// The error that ended the queue, after all reports were taken.
    pub(in crate::engine) async fn next_report(&self) -> Result<StepReport> {
        loop {
            {
                let mut inner = self.lock();
                if let Some(report) = inner.reports.pop_front() {
                    return Ok(report);
                }
                if let Some(error) = &inner.ended {
                    return Err(error.clone());
                }
            }
            self.writer.notified().await;
        }
    }

    /// Whether every accepted step is reported and every report is taken.
    pub(in crate::engine) fn is_drained(&self) -> bool {
        let inner = self.lock();
        inner.in_progress.is_empty() && inner.queued.is_empty() && inner.reports.is_empty()
    }

    /// Called when the writer drops its lease. Drops the queued steps.
    pub(in crate::engine) fn close(&self) {
        let mut inner = self.lock();
        inner.closed = true;
        inner.queued.clear();
        self.scene.notify_one();
    }

    pub(in crate::engine) fn is_closed(&self) -> bool {
        let inner = self.lock();
        inner.closed || inner.ended.is_some()
    }

    /// Ends the queue with an error from the scene. Drops the queued steps.
    pub(in crate::engine) fn end(&self, error: Error) {
        let mut inner = self.lock();
        inner.ended.get_or_insert(error);
        inner.queued.clear();
        self.writer.notify_one();
    }

    fn check_window(&self, inner: &QueueState, number: u64) -> Result<()> {
        let open = inner.queued.len() + inner.in_progress.len() + inner.reports.len();
        if self.policy == Policy::Lossless && open >= self.window {
            let expected = format!("at most {} steps without acknowledgement", self.window);
            return Err(invalid("window", expected, format!("step {number} as number {}", open + 1)));
        }
        Ok(())
    }

    fn lock(&self) -> MutexGuard<'_, QueueState> {
        lock(&self.inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::testing;
    use modalcast_model::scene::{RawStepUpdate, SceneState};

    fn step(number: u64, domain: u32, q: [f32; 2]) -> QueuedStep {
        let scene = testing::two_strips();
        let q = bytes::Bytes::copy_from_slice(bytemuck::cast_slice(&q));
        let raw = RawStepUpdate { number, q_domains: vec![domain], q, ..RawStepUpdate::default() };
        QueuedStep::new(StepUpdate::parse(&scene, &raw).expect("a step"), 0.0)
    }

    #[test]
    fn a_lossless_lane_refuses_the_step_beyond_the_window_until_a_report_is_taken() {
        let step_queue = StepQueue::new(Policy::Lossless, 2, Arc::default());
        step_queue.push(step(1, 0, [0.0; 2])).expect("first");
        step_queue.push(step(2, 0, [0.0; 2])).expect("second");
        let refusal = step_queue.push(step(3, 0, [0.0; 2])).expect_err("beyond").to_string();
        assert!(refusal.starts_with("window: expected at most 2"), "{refusal}");
        assert_eq!(step_queue.take().map(|step| step.update.number), Some(1));
        step_queue.report(Ok(vec![]));
        assert!(step_queue.push(step(3, 0, [0.0; 2])).is_err(), "the report was not taken yet");
        step_queue.inner.lock().expect("sound").reports.clear();
        step_queue.push(step(3, 0, [0.0; 2])).expect("room again");
    }

    #[test]
    fn a_latest_lane_merges_to_the_state_that_all_steps_would_have_left() {
        let scene = testing::two_strips();
        let step_queue = StepQueue::new(Policy::Latest, 1, Arc::default());
        let steps = || [step(1, 0, [1.0, 2.0]), step(2, 1, [3.0, 4.0]), step(5, 0, [5.0, 6.0])];
        let mut want = SceneState::rest(&scene);
        for step in steps() {
            want.apply(&scene, &step.update);
            step_queue.push(step).expect("never refused");
        }
        let merged = step_queue.take().expect("one step");
        let mut got = SceneState::rest(&scene);
        got.apply(&scene, &merged.update);
        assert_eq!((got, merged.merged), (want, 2));
        assert!(step_queue.take().is_none());
    }

    #[tokio::test]
    async fn a_latest_writer_that_reads_late_hears_of_the_newest_step() {
        let step_queue = StepQueue::new(Policy::Latest, 2, Arc::default());
        for number in 1..=9 {
            step_queue.push(step(number, 0, [0.0; 2])).expect("taken");
            step_queue.take().expect("in work");
            step_queue.report(Ok(vec![]));
        }
        let mut heard = Vec::new();
        while !step_queue.is_drained() {
            heard.push(step_queue.next_report().await.expect("a report"));
        }
        let steps: Vec<u64> =
            heard.iter().map(|r| if let StepReport::Done { step, .. } = r { *step } else { 0 }).collect();
        assert_eq!(steps, [1, 9]);
    }

    #[tokio::test]
    async fn a_writer_that_reads_no_refusal_is_cut_off_and_an_ended_lane_says_why() {
        let step_queue = StepQueue::new(Policy::Latest, 1, Arc::default());
        for number in 1..=3 {
            if step_queue.push(step(number, 0, [0.0; 2])).is_ok() {
                step_queue.take();
                step_queue.report(Err(invalid("step.q", "less", "more")));
            }
        }
        assert!(matches!(step_queue.next_report().await, Ok(StepReport::Rejected { step: 1, .. })));
        assert!(matches!(step_queue.next_report().await, Ok(StepReport::Rejected { step: 2, .. })));
        assert!(matches!(step_queue.next_report().await, Err(Error::Busy { limit: 1, .. })));
        assert!(matches!(step_queue.push(step(4, 0, [0.0; 2])), Err(Error::Busy { .. })));
    }
}
