//! Budgets for the bytes of messages that are being received, per connection and in total.
//!
//! tonic allocates the memory of a whole message as soon as it has read the message's length, and holds it until the
//! last byte has arrived. A message therefore counts with its whole length as soon as its header has arrived. A message
//! that exceeds the budget of its connection is rejected. If the total is exhausted, the connection that holds the most
//! bytes loses its incomplete messages, so that a few connections with half-sent messages do not block the others.

use std::collections::HashMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::sync::Notify;
use tokio::sync::futures::OwnedNotified;

use crate::config::Config;
use modalcast_model::error::{Error, Result};

/// The budget of all connections.
#[derive(Debug)]
pub(super) struct ReceiveBudget {
    /// Limits in bytes.
    max_total_bytes: usize,
    max_connection_bytes: usize,
    message_limits: MessageLimits,
    state: Mutex<State>,
}

/// Limits of one message.
#[derive(Debug, Clone, Copy)]
pub(super) struct MessageLimits {
    /// Maximum size in bytes. The decoder rejects a larger message, so its remaining bytes do not count.
    pub(super) max_bytes: usize,
    /// Longest time without progress of an incomplete message.
    pub(super) timeout: Duration,
}

#[derive(Debug, Default)]
struct State {
    held_bytes: usize,
    next_id: u64,
    connections: HashMap<u64, ConnectionState>,
}

#[derive(Debug)]
struct ConnectionState {
    held_bytes: usize,
    evictions: Arc<Evictions>,
}

/// Counts how often a connection has lost its incomplete messages.
#[derive(Debug, Default)]
struct Evictions {
    count: AtomicU64,
    /// Wakes those that wait for an eviction.
    changed: Arc<Notify>,
}

/// The budget of one connection.
#[derive(Debug)]
pub(super) struct ConnectionReceiveBudget {
    total: Arc<ReceiveBudget>,
    id: u64,
    evictions: Arc<Evictions>,
}

impl ReceiveBudget {
    pub(super) fn new(config: &Config) -> Arc<Self> {
        Arc::new(Self {
            max_total_bytes: config.receive_bytes,
            max_connection_bytes: config.connection_receive_bytes,
            message_limits: MessageLimits { max_bytes: config.message_bytes, timeout: config.message_timeout },
            state: Mutex::default(),
        })
    }

    pub(super) fn new_connection(self: &Arc<Self>) -> Arc<ConnectionReceiveBudget> {
        let evictions = Arc::new(Evictions::default());
        let mut state = self.lock();
        let id = state.next_id;
        state.next_id += 1;
        state.connections.insert(id, ConnectionState { held_bytes: 0, evictions: Arc::clone(&evictions) });
        Arc::new(ConnectionReceiveBudget { total: Arc::clone(self), id, evictions })
    }

    /// A poisoned lock is valid, because no update of the state can panic halfway.
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl State {
    /// Adds bytes to a connection.
    ///
    /// # Errors
    /// `LimitReached` above the limit of the connection; `Busy` above the total, unless another connection that holds
    /// more can be evicted.
    fn add(&mut self, id: u64, bytes: usize, budget: &ReceiveBudget) -> Result<()> {
        let connection_bytes = self.connections.get(&id).map_or(0, |connection| connection.held_bytes) + bytes;
        if connection_bytes > budget.max_connection_bytes {
            let objects = "bytes of incomplete messages of one connection";
            return Err(Error::LimitReached { objects, limit: budget.max_connection_bytes });
        }
        if self.held_bytes + bytes > budget.max_total_bytes && !self.evict_other(id, connection_bytes) {
            return Err(total_exhausted(budget));
        }
        if let Some(connection) = self.connections.get_mut(&id) {
            connection.held_bytes = connection_bytes;
            self.held_bytes += bytes;
        }
        Ok(())
    }

    /// Evicts the connection that holds the most bytes, if it is not `id` and holds more than `bytes`. The bytes no
    /// longer count, and the calls of the connection free the memory when they are polled next.
    fn evict_other(&mut self, id: u64, bytes: usize) -> bool {
        let largest = self.connections.iter_mut().max_by_key(|(_, connection)| connection.held_bytes);
        let Some((largest_id, connection)) = largest else { return false };
        if *largest_id == id || connection.held_bytes <= bytes {
            return false;
        }
        self.held_bytes -= std::mem::take(&mut connection.held_bytes);
        connection.evictions.count.fetch_add(1, Ordering::Release);
        connection.evictions.changed.notify_waiters();
        true
    }

    fn remove(&mut self, id: u64, bytes: usize) {
        if let Some(connection) = self.connections.get_mut(&id) {
            connection.held_bytes -= bytes;
            self.held_bytes -= bytes;
        }
    }
}

const fn total_exhausted(budget: &ReceiveBudget) -> Error {
    Error::Busy { queue: "receive buffer of all connections (in bytes)", limit: budget.max_total_bytes }
}

impl ConnectionReceiveBudget {
    pub(super) fn limits(&self) -> MessageLimits {
        self.total.message_limits
    }

    /// A new reservation of this connection, with 0 bytes.
    pub(super) fn new_memory(self: &Arc<Self>) -> ReceivedMemory {
        let eviction = self.evictions.count.load(Ordering::Acquire);
        ReceivedMemory { connection: Arc::clone(self), bytes: 0, eviction }
    }
}

impl Drop for ConnectionReceiveBudget {
    fn drop(&mut self) {
        let mut state = self.total.lock();
        if let Some(connection) = state.connections.remove(&self.id) {
            state.held_bytes -= connection.held_bytes;
        }
    }
}

/// A reservation of bytes for received messages. It counts against the budgets until it is dropped.
#[derive(Debug)]
pub(super) struct ReceivedMemory {
    connection: Arc<ConnectionReceiveBudget>,
    bytes: usize,
    /// `Evictions.count` when the bytes were added.
    eviction: u64,
}

impl ReceivedMemory {
    /// Sets the number of bytes.
    ///
    /// # Errors
    /// As for [`State::add`]; the number is then unchanged. `Busy` if the memory was evicted; the number is then 0.
    pub(super) fn resize(&mut self, bytes: usize) -> Result<()> {
        let connection = Arc::clone(&self.connection);
        let mut state = connection.total.lock();
        // Under the lock, so that no eviction comes between this test and the update.
        let eviction = connection.evictions.count.load(Ordering::Acquire);
        if eviction != self.eviction {
            let was_in_use = self.is_in_use();
            (self.bytes, self.eviction) = (0, eviction);
            if was_in_use && bytes > 0 {
                return Err(total_exhausted(&connection.total));
            }
        }
        match bytes.checked_sub(self.bytes) {
            Some(added_bytes) => state.add(connection.id, added_bytes, &connection.total)?,
            None => state.remove(connection.id, self.bytes - bytes),
        }
        self.bytes = bytes;
        Ok(())
    }

    pub(super) const fn is_in_use(&self) -> bool {
        self.bytes > 0
    }

    /// Fails if the memory is in use and was evicted.
    ///
    /// # Errors
    /// `Busy`, with the limit of all connections.
    pub(super) fn check(&self) -> Result<()> {
        if self.is_in_use() && self.connection.evictions.count.load(Ordering::Acquire) != self.eviction {
            return Err(total_exhausted(&self.connection.total));
        }
        Ok(())
    }

    /// Completes at the next eviction of the connection after this call.
    pub(super) fn next_eviction(&self) -> OwnedNotified {
        Arc::clone(&self.connection.evictions.changed).notified_owned()
    }

    /// Waits until the memory is in use and was evicted. Cancel-safe.
    pub(super) async fn evicted(&self) -> Error {
        loop {
            // Created before the check, so that it completes if the eviction comes between the two.
            let eviction = self.next_eviction();
            if let Err(error) = self.check() {
                return error;
            }
            eviction.await;
        }
    }
}

impl Drop for ReceivedMemory {
    fn drop(&mut self) {
        // Fewer bytes are always granted.
        self.resize(0).ok();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A budget of 100 bytes, of which one connection may hold 60.
    fn small_budget() -> Arc<ReceiveBudget> {
        ReceiveBudget::new(&Config { receive_bytes: 100, connection_receive_bytes: 60, ..Config::default() })
    }

    #[test]
    fn connection_has_its_own_limit_and_gets_its_bytes_back() {
        let budget = small_budget();
        let connection = budget.new_connection();
        let (mut first, mut second) = (connection.new_memory(), connection.new_memory());
        first.resize(40).expect("expected capacity");
        assert!(matches!(second.resize(21), Err(Error::LimitReached { limit: 60, .. })));
        second.resize(20).expect("expected capacity");
        first.resize(10).expect("expected capacity");
        second.resize(50).expect("expected capacity");
        drop((first, second, connection));
        assert_eq!(budget.lock().held_bytes, 0);
        assert!(budget.lock().connections.is_empty());
    }

    #[test]
    fn largest_connection_is_evicted_when_the_total_is_exhausted() {
        let budget = small_budget();
        let connections = [60, 40, 0].map(|bytes| {
            let connection = budget.new_connection();
            let mut memory = connection.new_memory();
            memory.resize(bytes).expect("expected capacity");
            (connection, memory)
        });
        let [(_, mut large), (_, mut medium), (_, mut small)] = connections;
        small.resize(30).expect("expected the largest connection to be evicted");
        assert!(matches!(large.check(), Err(Error::Busy { limit: 100, .. })));
        assert!(matches!(large.resize(10), Err(Error::Busy { .. })));
        // The evicted connection continues with nothing.
        large.resize(30).expect("expected capacity");
        assert!(medium.check().is_ok() && small.check().is_ok());
        // The connection that would hold the most is the one that is rejected.
        assert!(matches!(medium.resize(50), Err(Error::Busy { .. })));
        assert!([&large, &medium, &small].into_iter().all(|memory| memory.check().is_ok()));
        drop((large, medium, small));
        assert_eq!(budget.lock().held_bytes, 0);
    }

    #[tokio::test]
    async fn eviction_wakes_the_connection() {
        let budget = small_budget();
        let (victim, other) = (budget.new_connection(), budget.new_connection());
        let (mut held, mut requested) = (victim.new_memory(), other.new_memory());
        held.resize(60).expect("expected capacity");
        let eviction = held.next_eviction();
        requested.resize(50).expect("expected the other connection to be evicted");
        tokio::time::timeout(crate::hang_guard::HANG_GUARD, eviction).await.expect("expected a notification");
    }
}
