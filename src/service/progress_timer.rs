//! The deadline of a message that is being received. Progress extends it.

use std::pin::Pin;
use std::task::{Context, Poll};
use std::time::Duration;

use tokio::time::{Instant, Sleep};

use modalcast_model::error::Error;

/// The lowest rate at which a message must arrive, in bytes per second: 32 KiB/s.
const MIN_MESSAGE_RATE: f64 = 32768.0;

/// Measures the time without progress of a message. The time runs only while the receiver waits for more bytes.
#[derive(Debug)]
pub(super) struct ProgressTimer {
    /// Longest time without progress.
    timeout: Duration,
    /// Remaining time while the timer does not run.
    remaining: Duration,
    timer: Option<Pin<Box<Sleep>>>,
    is_running: bool,
}

impl ProgressTimer {
    pub(super) const fn new(timeout: Duration) -> Self {
        Self { timeout, remaining: timeout, timer: None, is_running: false }
    }

    /// Begins the time of the next message.
    pub(super) fn reset(&mut self) {
        (self.remaining, self.is_running) = (self.timeout, false);
    }

    /// Stops the timer after `received_bytes` have arrived, and adds the time in which a client with the rate
    /// [`MIN_MESSAGE_RATE`] sends them.
    pub(super) fn stop(&mut self, received_bytes: usize) {
        if let Some(timer) = self.timer.as_ref().filter(|_| self.is_running) {
            self.remaining = timer.deadline().saturating_duration_since(Instant::now());
        }
        self.is_running = false;
        let refill = Duration::from_secs_f64(received_bytes as f64 / MIN_MESSAGE_RATE);
        self.remaining = self.timeout.min(self.remaining + refill);
    }

    /// Runs the timer. Ready with an error when the rest of the message is overdue.
    pub(super) fn poll_overdue(&mut self, cx: &mut Context<'_>) -> Poll<Error> {
        let deadline = Instant::now() + self.remaining;
        let timer = self.timer.get_or_insert_with(|| Box::pin(tokio::time::sleep_until(deadline)));
        if !std::mem::replace(&mut self.is_running, true) {
            timer.as_mut().reset(deadline);
        }
        let ms = self.timeout.as_millis() as u64;
        timer.as_mut().poll(cx).map(|()| Error::Deadline { what: "the rest of a message".into(), ms })
    }
}
