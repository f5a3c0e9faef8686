//! A bounded queue of readbacks that the device has not finished yet, each with the channel for its answer.

use std::collections::VecDeque;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::time::Duration;

use super::command::{Reply, SceneId};
use super::partial_output::Charge;

/// Device work whose completion can be polled.
pub(super) trait Pollable {
    /// Waits at most `limit`. Returns whether the result can then be collected without waiting.
    fn is_ready_within(&self, limit: Duration) -> bool;
}

/// A readback in flight.
pub(super) struct InFlight<P, T> {
    pub id: SceneId,
    pub pending: P,
    /// The device time that the scene was charged; `None` if its cost is already recorded.
    pub charge: Option<Charge>,
    pub reply: Reply<T>,
}

/// Readbacks of one type, oldest first. The caller collects the oldest one before it pushes into a full queue.
pub(super) struct InFlightQueue<P, T> {
    entries: VecDeque<InFlight<P, T>>,
    capacity: usize,
}

impl<P, T> InFlightQueue<P, T> {
    pub(super) fn new(capacity: usize) -> Self {
        Self { entries: VecDeque::with_capacity(capacity), capacity }
    }

    pub(super) fn len(&self) -> usize {
        self.entries.len()
    }

    pub(super) fn is_empty(&self) -> bool {
        self.entries.is_empty()
    }

    /// The newest readback.
    pub(super) fn newest(&self) -> Option<&P> {
        self.entries.back().map(|entry| &entry.pending)
    }

    pub(super) fn is_full(&self) -> bool {
        self.entries.len() >= self.capacity
    }

    /// Adds the newest readback. The queue must not be full.
    pub(super) fn push(&mut self, readback: InFlight<P, T>) {
        debug_assert!(!self.is_full(), "expected capacity for a readback");
        self.entries.push_back(readback);
    }

    pub(super) fn pop_oldest(&mut self) -> Option<InFlight<P, T>> {
        self.entries.pop_front()
    }

    /// Drops all readbacks; their callers get an error.
    pub(super) fn clear(&mut self) {
        self.entries.clear();
    }
}

impl<P: Pollable, T> InFlightQueue<P, T> {
    /// Waits at most `limit` for the oldest readback; returns whether it is ready. If the poll panics, the oldest
    /// readback is dropped, so that its caller gets an error and the next poll does not panic again.
    pub(super) fn is_oldest_ready(&mut self, limit: Duration) -> bool {
        let Some(oldest) = self.entries.front() else { return false };
        match catch_unwind(AssertUnwindSafe(|| oldest.pending.is_ready_within(limit))) {
            Ok(is_ready) => is_ready,
            Err(_) => {
                tracing::error!("polling a readback panicked on the device thread");
                self.entries.pop_front();
                false
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    enum FakeReadback {
        Ready,
        Busy,
        Panics,
    }

    impl Pollable for FakeReadback {
        fn is_ready_within(&self, _: Duration) -> bool {
            match self {
                Self::Ready => true,
                Self::Busy => false,
                Self::Panics => panic!("injected"),
            }
        }
    }

    #[test]
    fn panicking_poll_drops_only_the_polled_readback() {
        let mut queue = InFlightQueue::<FakeReadback, u32>::new(3);
        let mut answers = Vec::new();
        // The first readback is the oldest.
        for pending in [FakeReadback::Panics, FakeReadback::Ready, FakeReadback::Busy] {
            let (reply, answer, _end) = Reply::channel();
            queue.push(InFlight { id: 1, pending, charge: None, reply });
            answers.push(answer);
        }
        assert!(queue.is_full());
        assert!(!queue.is_oldest_ready(Duration::ZERO));
        assert_eq!(queue.len(), 2);
        assert!(answers[0].has_changed().is_err(), "expected a dropped reply channel");
        assert!(queue.is_oldest_ready(Duration::ZERO), "expected the second readback to be ready");
        let ready_readback = queue.pop_oldest().expect("expected the second readback");
        assert!(ready_readback.reply.send(Ok(7)), "expected a caller that waits");
        assert_eq!(*answers[1].borrow(), Some(Ok(7)));
        assert!(!queue.is_oldest_ready(Duration::ZERO));
        assert_eq!(queue.len(), 1, "expected the busy readback to remain");
        assert!(answers[2].has_changed().is_ok() && answers[2].borrow().is_none());
    }
}
