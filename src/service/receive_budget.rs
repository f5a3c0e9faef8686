//! Counts the bytes of messages that are being received, per connection, against [`Limit::RECEIVED_BYTES`].
//!
//! tonic allocates the memory of a whole message as soon as it has read the message's length, and holds it until the
//! last byte has arrived. A message therefore counts with its whole length as soon as its header has arrived. When the
//! limit is reached, the connection that is next in order loses its incomplete messages, so that a few connections with
//! half-sent messages do not block the others.

use std::pin::Pin;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use crate::admission::{Account, Admission, Limit, Permit, PermitHandle, PermitPool};
use crate::config::Config;
use crate::engine::lock;
use modalcast_model::error::{Error, Result};

/// Completes with the error of a preemption.
pub(super) type Preemption = Pin<Box<dyn Future<Output = Error> + Send>>;

/// The budget of all connections.
#[derive(Debug)]
pub(super) struct ReceiveBudget {
    bytes: PermitPool,
    message_limits: MessageLimits,
}

/// Limits of one message.
#[derive(Debug, Clone, Copy)]
pub(super) struct MessageLimits {
    /// Maximum size in bytes. The decoder rejects a larger message, so its remaining bytes do not count.
    pub(super) max_bytes: usize,
    /// Longest time without progress of an incomplete message.
    pub(super) timeout: Duration,
}

/// What one connection holds.
#[derive(Debug)]
pub(super) struct ConnectionReceiveBudget {
    total: Arc<ReceiveBudget>,
    /// For all bytes of the connection. Replaced after a preemption, so that the connection continues with nothing.
    permit: Mutex<Permit>,
}

impl ReceiveBudget {
    pub(super) fn new(config: &Config, metrics: &Admission) -> Arc<Self> {
        let bytes = metrics.pool(Limit::RECEIVED_BYTES, (Limit::RECEIVED_BYTES.total)(config));
        let message_limits = MessageLimits { max_bytes: config.message_bytes, timeout: config.message_timeout };
        Arc::new(Self { bytes, message_limits })
    }

    pub(super) fn new_connection(self: &Arc<Self>, account: &Account) -> Arc<ConnectionReceiveBudget> {
        let permit = Mutex::new(self.bytes.count_held(account, 0));
        Arc::new(ConnectionReceiveBudget { total: Arc::clone(self), permit })
    }
}

impl ConnectionReceiveBudget {
    pub(super) fn limits(&self) -> MessageLimits {
        self.total.message_limits
    }

    /// Counts the bytes of an anonymous connection to the account of a principal.
    pub(super) fn identify(&self, account: impl FnOnce() -> Account) {
        lock(&self.permit).handle().identify(account);
    }

    /// A new reservation of this connection, with 0 bytes.
    pub(super) fn new_memory(self: &Arc<Self>) -> ReceivedMemory {
        ReceivedMemory { connection: Arc::clone(self), bytes: 0, permit: lock(&self.permit).handle().clone() }
    }

    /// Completes when the connection loses its incomplete messages next.
    pub(super) fn preempted(&self) -> impl Future<Output = Error> + Send + use<> {
        lock(&self.permit).handle().preempted()
    }
}

/// A reservation of bytes for received messages. It counts until it is dropped.
#[derive(Debug)]
pub(super) struct ReceivedMemory {
    connection: Arc<ConnectionReceiveBudget>,
    bytes: usize,
    /// The permit of the connection when the bytes were added.
    permit: PermitHandle,
}

impl ReceivedMemory {
    /// Sets the number of bytes.
    ///
    /// # Errors
    /// `LimitReached` when the client has its share; the number is then unchanged. `Preempted` if the bytes were lost; the
    /// number is then 0.
    pub(super) fn resize(&mut self, bytes: usize) -> Result<()> {
        let connection = Arc::clone(&self.connection);
        let mut permit = lock(&connection.permit);
        if permit.handle().is_preempted() {
            *permit = connection.total.bytes.count_held(&permit.handle().account(), 0);
        }
        if self.permit.is_preempted() {
            let lost = self.check();
            (self.bytes, self.permit) = (0, permit.handle().clone());
            if bytes > 0 {
                lost?;
            }
        }
        let held = permit.amount() - self.bytes;
        permit.resize(held + bytes)?;
        self.bytes = bytes;
        Ok(())
    }

    pub(super) const fn is_in_use(&self) -> bool {
        self.bytes > 0
    }

    /// # Errors
    /// `Preempted` if the memory is in use and was lost.
    pub(super) fn check(&self) -> Result<()> {
        match self.permit.preemption().filter(|_| self.is_in_use()) {
            Some(error) => Err(error),
            None => Ok(()),
        }
    }

    /// Completes when bytes that are held now are lost.
    pub(super) fn preempted(&self) -> Preemption {
        Box::pin(self.permit.preempted())
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
    use crate::admission::Client;

    /// A budget of 100 bytes, of which one client may hold 75.
    fn small_budget() -> Arc<ReceiveBudget> {
        ReceiveBudget::new(&Config { receive_bytes: 100, ..Config::default() }, &Admission::default())
    }

    fn connection(budget: &Arc<ReceiveBudget>, client: u64) -> Arc<ConnectionReceiveBudget> {
        budget.new_connection(&Account { principal: Some("anna".into()), client: Client::Connection(client) })
    }

    #[test]
    fn client_leaves_bytes_for_others_and_gets_its_bytes_back() {
        let budget = small_budget();
        // Two connections of one client.
        let [one, other] = [1, 1].map(|client| connection(&budget, client));
        let (mut first, mut second) = (one.new_memory(), other.new_memory());
        first.resize(40).expect("expected capacity");
        assert!(matches!(second.resize(36), Err(Error::LimitReached { limit: 100, .. })));
        second.resize(35).expect("expected capacity");
        first.resize(10).expect("expected capacity");
        second.resize(65).expect("expected capacity");
        drop((first, second));
        assert_eq!(budget.bytes.held(), 0);
    }

    #[test]
    fn largest_client_loses_its_messages_when_the_total_is_reached() {
        let budget = small_budget();
        let connections = [1, 2, 3].map(|client| connection(&budget, client));
        let [mut large, mut medium, mut small] = [0, 1, 2].map(|index| connections[index].new_memory());
        large.resize(60).expect("expected capacity");
        medium.resize(40).expect("expected capacity");
        small.resize(30).expect("expected the largest client to lose its bytes");
        assert!(matches!(large.check(), Err(Error::Preempted { held: 60, limit: 100, .. })));
        assert!(matches!(large.resize(10), Err(Error::Preempted { .. })));
        // It continues with nothing.
        large.resize(30).expect("expected capacity");
        assert!(medium.check().is_ok() && small.check().is_ok());
        // The client that would hold the most is the one that is rejected.
        assert!(matches!(medium.resize(50), Err(Error::LimitReached { .. })));
        assert!([&large, &medium, &small].into_iter().all(|memory| memory.check().is_ok()));
        drop((large, medium, small));
        assert_eq!(budget.bytes.held(), 0);
    }

    /// Memory that is not in use when its connection loses its messages stays valid.
    #[test]
    fn memory_without_bytes_is_never_lost() {
        let budget = small_budget();
        let [victim, other] = [1, 2].map(|client| connection(&budget, client));
        let (mut held, mut unused, mut requested) = (victim.new_memory(), victim.new_memory(), other.new_memory());
        held.resize(60).expect("expected capacity");
        requested.resize(50).expect("expected the other connection to lose its bytes");
        assert!(unused.check().is_ok() && held.check().is_err());
        unused.resize(20).expect("expected capacity");
        held.resize(0).expect("expected no error without bytes");
        assert_eq!(budget.bytes.held(), 70);
        drop((held, unused, requested));
        assert_eq!(budget.bytes.held(), 0);
    }

    #[tokio::test]
    async fn preemption_wakes_the_connection() {
        let budget = small_budget();
        let [victim, other] = [1, 2].map(|client| connection(&budget, client));
        let (mut held, mut requested) = (victim.new_memory(), other.new_memory());
        held.resize(60).expect("expected capacity");
        let preempted = held.preempted();
        requested.resize(50).expect("expected the other connection to lose its bytes");
        tokio::time::timeout(crate::hang_guard::HANG_GUARD, preempted).await.expect("expected a notification");
    }
}
