//! The bounded queue of steps from one writer to its scene, and the queue of reports back to the writer. The window, a
//! number of steps, bounds both. A lossless queue rejects a step beyond the window, or lets the stream wait: then the
//! server reads the next step only when there is capacity. A `latest` queue merges a step into the one already queued.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::Instant;

use tokio::sync::Notify;

use super::delivery::Delivery;
use crate::engine::lock::lock;
use crate::telemetry::{Stage, StageTimes, ms_since};
use modalcast_model::error::{Error, Result};
use modalcast_model::scene::StepUpdate;

/// Limit in bytes on the queued steps of one writer. A step is accepted as long as the steps before it are below the
/// limit, so the queue holds at most one message more.
const MAX_QUEUED_BYTES: usize = 16 << 20;

/// What happens to a lossless step for which the window has no capacity.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Overflow {
    /// The stream is not read until there is capacity.
    Block,
    /// The step is rejected.
    Reject,
}

/// An accepted step in the queue.
#[derive(Debug)]
pub(in crate::engine) struct QueuedStep {
    pub update: StepUpdate,
    /// Number of older steps that were merged into this one.
    pub merged: u64,
    /// Milliseconds that parsing the step took.
    parse_ms: f64,
    queued_at: Instant,
}

impl QueuedStep {
    pub(in crate::engine) fn new(update: StepUpdate, parse_ms: f64) -> Self {
        Self { update, merged: 0, parse_ms, queued_at: Instant::now() }
    }

    /// Parse time, and queue time until now.
    pub(in crate::engine) fn stages(&self) -> StageTimes {
        vec![(Stage::Parse, self.parse_ms), (Stage::Queue, ms_since(self.queued_at))]
    }
}

/// The outcome of a step.
#[derive(Debug, Clone, PartialEq)]
pub enum StepReport {
    /// All steps up to this one are completed or merged into a later one.
    Done {
        step: u64,
        /// Number of steps that were merged into later ones since the stream began.
        skipped: u64,
        stages: StageTimes,
    },
    /// The step failed; the scene is as it was before the step.
    Rejected { step: u64, error: Error },
}

/// The step queue, shared by a writer's handle and its scene. The lock is never held across an await.
#[derive(Debug)]
pub(in crate::engine) struct StepQueue {
    delivery: Delivery,
    overflow: Overflow,
    /// Maximum number of steps that are queued, in progress, or whose report the writer has not taken.
    window: usize,
    state: Mutex<QueueState>,
    /// Wakes the scene: a step was queued or the queue was closed.
    scene_wake: Arc<Notify>,
    /// Wakes the writer: a report was added or the queue has ended.
    writer_wake: Notify,
}

/// A computed step whose acknowledgment is outstanding.
#[derive(Debug)]
pub(super) struct CompletedStep {
    step_queue: Arc<StepQueue>,
    stages: StageTimes,
}

impl CompletedStep {
    pub(super) const fn new(step_queue: Arc<StepQueue>, stages: StageTimes) -> Self {
        Self { step_queue, stages }
    }

    /// Whether subscribers may block the writer: only a writer that is lossless and still connected.
    pub(super) fn applies_back_pressure(&self) -> bool {
        self.step_queue.delivery == Delivery::Lossless && !self.step_queue.is_closed()
    }

    /// Reports the step to its writer as done. Steps of a queue are acknowledged in the order in which they were taken.
    pub(super) fn acknowledge(self) {
        self.step_queue.report(Ok(self.stages));
    }
}

/// A step that was taken and is not yet reported.
#[derive(Debug)]
struct StepInProgress {
    number: u64,
    bytes: usize,
}

#[derive(Debug, Default)]
struct QueueState {
    queued: VecDeque<QueuedStep>,
    /// Oldest first. There are several while readbacks of the earlier ones are in flight.
    in_progress: VecDeque<StepInProgress>,
    /// Size of the steps that are queued or in progress.
    bytes: usize,
    reports: VecDeque<StepReport>,
    /// Number of steps that were merged into later ones since the stream began.
    skipped: u64,
    is_lease_dropped: bool,
    /// The error with which the scene ended the queue.
    end_error: Option<Error>,
}

impl QueueState {
    fn unacknowledged(&self) -> usize {
        self.queued.len() + self.in_progress.len() + self.reports.len()
    }

    fn drop_queued(&mut self) {
        self.bytes -= self.queued.drain(..).map(|step| step.update.bytes()).sum::<usize>();
    }
}

impl StepQueue {
    pub(in crate::engine) fn new(delivery: Delivery, overflow: Overflow, window: u32, scene_wake: Arc<Notify>) -> Self {
        let window = window.max(1) as usize;
        Self { delivery, overflow, window, state: Mutex::default(), scene_wake, writer_wake: Notify::new() }
    }

    /// Whether the server may read another step from the stream: always, unless it must wait for capacity.
    pub(in crate::engine) fn may_read_step(&self) -> bool {
        let must_wait = self.delivery == Delivery::Lossless && self.overflow == Overflow::Block;
        !must_wait || self.has_capacity(&self.lock())
    }

    /// Queues a step.
    ///
    /// # Errors
    /// `WindowFull` when the step is beyond the window, or the error that ended the queue.
    pub(in crate::engine) fn push(&self, step: QueuedStep) -> Result<()> {
        let mut state = self.lock();
        if let Some(error) = &state.end_error {
            return Err(error.clone());
        }
        match (self.delivery, state.queued.pop_back()) {
            (Delivery::Latest, Some(previous)) => {
                state.skipped += 1;
                let merged = previous.merged + 1;
                state.bytes -= previous.update.bytes();
                let update = step.update.merged_with_older(&previous.update);
                state.bytes += update.bytes();
                state.queued.push_back(QueuedStep { update, merged, ..step });
            }
            (_, previous) => {
                state.queued.extend(previous);
                if self.delivery == Delivery::Lossless && !self.has_capacity(&state) {
                    return Err(Error::WindowFull { limit: self.window, given: state.unacknowledged() + 1 });
                }
                state.bytes += step.update.bytes();
                state.queued.push_back(step);
            }
        }
        self.scene_wake.notify_one();
        Ok(())
    }

    /// Removes the next step to compute. The step counts against the window until its report is taken.
    pub(in crate::engine) fn take(&self) -> Option<QueuedStep> {
        let mut state = self.lock();
        let step = state.queued.pop_front()?;
        state.in_progress.push_back(StepInProgress { number: step.update.number, bytes: step.update.bytes() });
        Some(step)
    }

    /// Takes the step after the one that is being computed, so that both can be computed at once. `None` if the queue is not
    /// lossless: a later step may then replace the queued one.
    pub(super) fn take_early(&self) -> Option<QueuedStep> {
        if self.delivery == Delivery::Lossless { self.take() } else { None }
    }

    /// Whether a step is queued.
    pub(in crate::engine) fn has_queued(&self) -> bool {
        !self.lock().queued.is_empty()
    }

    /// Reports the outcome of the oldest step in progress. Does nothing if no step is in progress.
    pub(super) fn report(&self, outcome: Result<StageTimes>) {
        let mut state = self.lock();
        let Some(StepInProgress { number: step, bytes }) = state.in_progress.pop_front() else { return };
        state.bytes -= bytes;
        let skipped = state.skipped;
        let report = match outcome {
            Ok(stages) => StepReport::Done { step, skipped, stages },
            Err(error) => StepReport::Rejected { step, error },
        };
        // Under `latest`, a writer may read its reports slowly. A `Done` also covers all older steps. If at least
        // `window` reports wait, a new `Done` therefore replaces the newest report, if that is a `Done` too. A
        // `Rejected` is never replaced. If `window` + 1 reports wait, the new report is dropped, and the queue ends with
        // an error.
        let replaces_newest =
            matches!((state.reports.back(), &report), (Some(StepReport::Done { .. }), StepReport::Done { .. }));
        if state.reports.len() >= self.window && replaces_newest {
            state.reports.pop_back();
        }
        if state.reports.len() > self.window {
            state
                .end_error
                .get_or_insert(Error::SlowReader { queue: "queue of reports to the writer", limit: self.window });
        } else {
            state.reports.push_back(report);
        }
        self.writer_wake.notify_one();
    }

    /// Waits for the next report. Cancel-safe.
    ///
    /// # Errors
    /// The error that ended the queue, after all reports were taken.
    pub(in crate::engine) async fn next_report(&self) -> Result<StepReport> {
        loop {
            {
                let mut state = self.lock();
                if let Some(report) = state.reports.pop_front() {
                    return Ok(report);
                }
                if let Some(error) = &state.end_error {
                    return Err(error.clone());
                }
            }
            self.writer_wake.notified().await;
        }
    }

    /// Whether every accepted step is reported and every report is taken.
    pub(in crate::engine) fn is_drained(&self) -> bool {
        let state = self.lock();
        state.in_progress.is_empty() && state.queued.is_empty() && state.reports.is_empty()
    }

    /// Called when the writer drops its lease. Drops the queued steps.
    pub(in crate::engine) fn close(&self) {
        let mut state = self.lock();
        state.is_lease_dropped = true;
        state.drop_queued();
        self.scene_wake.notify_one();
    }

    /// Whether the writer has dropped its lease or the queue has ended with an error.
    pub(in crate::engine) fn is_closed(&self) -> bool {
        let state = self.lock();
        state.is_lease_dropped || state.end_error.is_some()
    }

    /// Ends the queue with an error, which the writer receives after its reports. Drops the queued steps.
    pub(in crate::engine) fn end(&self, error: Error) {
        let mut state = self.lock();
        state.end_error.get_or_insert(error);
        state.drop_queued();
        self.writer_wake.notify_one();
    }

    /// Whether the window and the limit on bytes have capacity for a step.
    fn has_capacity(&self, state: &QueueState) -> bool {
        state.unacknowledged() < self.window && state.bytes < MAX_QUEUED_BYTES
    }

    fn lock(&self) -> MutexGuard<'_, QueueState> {
        lock(&self.state)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::testing;
    use modalcast_model::error::invalid;
    use modalcast_model::scene::{RawStepUpdate, SceneState};

    /// A step that sets the two coordinates of one domain of [`testing::two_strips`].
    fn step(number: u64, domain: u32, q: [f32; 2]) -> QueuedStep {
        let scene = testing::two_strips();
        let q = bytes::Bytes::copy_from_slice(bytemuck::cast_slice(&q));
        let raw = RawStepUpdate { number, q_domains: vec![domain], q, ..RawStepUpdate::default() };
        QueuedStep::new(StepUpdate::parse(&scene, &raw).expect("expected a valid step"), 0.0)
    }

    #[test]
    fn lossless_queue_rejects_steps_beyond_the_window() {
        let step_queue = StepQueue::new(Delivery::Lossless, Overflow::Reject, 2, Arc::default());
        step_queue.push(step(1, 0, [0.0; 2])).expect("expected capacity for the first step");
        step_queue.push(step(2, 0, [0.0; 2])).expect("expected capacity for the second step");
        let error = step_queue.push(step(3, 0, [0.0; 2])).expect_err("expected a full window");
        assert_eq!(error, Error::WindowFull { limit: 2, given: 3 });
        assert_eq!(step_queue.take().map(|step| step.update.number), Some(1));
        step_queue.report(Ok(vec![]));
        assert!(step_queue.push(step(3, 0, [0.0; 2])).is_err(), "expected a full window until the report is taken");
        step_queue.state.lock().expect("expected an unpoisoned lock").reports.clear();
        step_queue.push(step(3, 0, [0.0; 2])).expect("expected capacity after the report was taken");
    }

    #[test]
    fn only_a_lossless_queue_gives_a_step_early() {
        for (delivery, expected) in [(Delivery::Lossless, Some(2)), (Delivery::Latest, None)] {
            let step_queue = StepQueue::new(delivery, Overflow::Reject, 4, Arc::default());
            step_queue.push(step(1, 0, [0.0; 2])).expect("expected capacity");
            assert_eq!(step_queue.take().map(|step| step.update.number), Some(1));
            step_queue.push(step(2, 0, [0.0; 2])).expect("expected capacity");
            assert_eq!(step_queue.take_early().map(|step| step.update.number), expected);
            assert_eq!(step_queue.has_queued(), expected.is_none());
            assert!(!step_queue.is_drained());
        }
    }

    #[test]
    fn blocked_writer_may_read_a_step_when_a_report_is_taken() {
        let step_queue = StepQueue::new(Delivery::Lossless, Overflow::Block, 1, Arc::default());
        assert!(step_queue.may_read_step());
        step_queue.push(step(1, 0, [0.0; 2])).expect("expected capacity for the first step");
        assert!(!step_queue.may_read_step());
        step_queue.take().expect("expected the queued step");
        step_queue.report(Ok(vec![]));
        assert!(!step_queue.may_read_step(), "expected no capacity until the report is taken");
        step_queue.lock().reports.clear();
        assert!(step_queue.may_read_step());
        let rejecting_queue = StepQueue::new(Delivery::Lossless, Overflow::Reject, 1, Arc::default());
        rejecting_queue.push(step(1, 0, [0.0; 2])).expect("expected capacity for the first step");
        assert!(rejecting_queue.may_read_step(), "a step beyond the window is read and rejected");
    }

    #[test]
    fn queued_bytes_are_counted_until_the_step_is_reported() {
        let step_queue = StepQueue::new(Delivery::Lossless, Overflow::Reject, 4, Arc::default());
        let step_bytes = step(1, 0, [0.0; 2]).update.bytes();
        assert!(step_bytes >= 8, "two coordinates of 4 bytes");
        for number in 1..=3 {
            step_queue.push(step(number, 0, [0.0; 2])).expect("expected capacity");
        }
        assert_eq!(step_queue.lock().bytes, 3 * step_bytes);
        step_queue.take().expect("expected a queued step");
        assert_eq!(step_queue.lock().bytes, 3 * step_bytes);
        step_queue.report(Ok(vec![]));
        assert_eq!(step_queue.lock().bytes, 2 * step_bytes);
        step_queue.close();
        assert_eq!(step_queue.lock().bytes, 0);
    }

    #[test]
    fn merged_step_has_the_effect_of_all_its_steps() {
        let scene = testing::two_strips();
        let step_queue = StepQueue::new(Delivery::Latest, Overflow::Block, 1, Arc::default());
        let mut expected_state = SceneState::rest(&scene);
        for step in [step(1, 0, [1.0, 2.0]), step(2, 1, [3.0, 4.0]), step(5, 0, [5.0, 6.0])] {
            expected_state.apply(&scene, &step.update);
            step_queue.push(step).expect("expected a merge beyond the window");
        }
        let merged_step = step_queue.take().expect("expected one step");
        let mut state = SceneState::rest(&scene);
        state.apply(&scene, &merged_step.update);
        assert_eq!((state, merged_step.merged), (expected_state, 2));
        assert!(step_queue.take().is_none());
    }

    #[tokio::test]
    async fn slow_latest_writer_receives_the_newest_report() {
        let step_queue = StepQueue::new(Delivery::Latest, Overflow::Block, 2, Arc::default());
        for number in 1..=9 {
            step_queue.push(step(number, 0, [0.0; 2])).expect("expected an accepted step");
            step_queue.take().expect("expected the queued step");
            step_queue.report(Ok(vec![]));
        }
        let mut reported_numbers = Vec::new();
        while !step_queue.is_drained() {
            match step_queue.next_report().await.expect("expected a report") {
                StepReport::Done { step, .. } => reported_numbers.push(step),
                rejected => panic!("expected a completed step, got {rejected:?}"),
            }
        }
        // The window of two reports holds the first one and the newest one, which replaced the reports in between.
        assert_eq!(reported_numbers, [1, 9]);
    }

    #[tokio::test]
    async fn writer_that_reads_no_rejections_is_disconnected() {
        let step_queue = StepQueue::new(Delivery::Latest, Overflow::Block, 1, Arc::default());
        for number in 1..=3 {
            if step_queue.push(step(number, 0, [0.0; 2])).is_ok() {
                step_queue.take();
                step_queue.report(Err(invalid("step.q", "a finite number", "NaN")));
            }
        }
        assert!(matches!(step_queue.next_report().await, Ok(StepReport::Rejected { step: 1, .. })));
        assert!(matches!(step_queue.next_report().await, Ok(StepReport::Rejected { step: 2, .. })));
        assert!(matches!(step_queue.next_report().await, Err(Error::SlowReader { limit: 1, .. })));
        assert!(matches!(step_queue.push(step(4, 0, [0.0; 2])), Err(Error::SlowReader { .. })));
    }
}
