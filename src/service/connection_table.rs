//! The open connections. Each holds a permit of [`Limit::CONNECTIONS`].

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::{Notify, watch};

use super::connected_peers::ConnectedPeers;
use super::open_calls::OpenCalls;
use crate::admission::{Account, Admission, Limit, Permit, PermitHandle, PermitPool};
use modalcast_model::error::Result;

/// Limit on the preempted connections that have not ended. New connections wait when it is reached. Above half of it,
/// preempted connections are closed at once.
const MAX_ENDING: usize = 64;

/// Time within which the client must close a connection without calls after GOAWAY. A preempted connection is closed after
/// this time in any case.
pub(super) const GOAWAY_TIMEOUT: Duration = Duration::from_secs(1);

/// All connections that were accepted and have not ended.
#[derive(Debug)]
pub(super) struct ConnectionTable {
    permits: PermitPool,
    peers: Arc<ConnectedPeers>,
    /// Whether the server shuts down.
    is_retiring: watch::Sender<bool>,
}

/// The entry of a connection in the table. Dropping it removes the entry.
#[derive(Debug)]
pub(super) struct ConnectionSlot {
    permit: Permit,
    permits: PermitPool,
    is_retiring: watch::Receiver<bool>,
    pub(super) calls: Arc<OpenCalls>,
    /// Notified when the socket must be dropped.
    pub(super) close: Arc<Notify>,
}

impl ConnectionTable {
    pub(super) fn new(max_connections: usize, admission: &Admission) -> Arc<Self> {
        let permits = admission.pool(Limit::CONNECTIONS, max_connections);
        Arc::new(Self { permits, peers: Arc::default(), is_retiring: watch::Sender::new(false) })
    }

    /// The other ends of the connections.
    pub(super) const fn peers(&self) -> &Arc<ConnectedPeers> {
        &self.peers
    }

    /// Adds a connection of a client, if necessary after the preemption of another one. Waits while too many preempted
    /// connections have not ended. Cancel-safe.
    ///
    /// # Errors
    /// `LimitReached` when the client has its share of connections.
    pub(super) async fn insert(&self, account: &Account) -> Result<ConnectionSlot> {
        while self.permits.ending() >= MAX_ENDING {
            self.permits.released().await;
        }
        Ok(ConnectionSlot {
            permit: self.permits.acquire(account)?,
            permits: self.permits.clone(),
            is_retiring: self.is_retiring.subscribe(),
            calls: Arc::default(),
            close: Arc::default(),
        })
    }

    /// Makes a file descriptor available by preempting a connection.
    pub(super) fn preempt_one(&self) {
        self.permits.preempt_one();
    }

    /// Sends GOAWAY to all connections and waits until they have ended.
    pub(super) async fn retire_all(&self) {
        self.is_retiring.send_replace(true);
        while self.permits.held() + self.permits.ending() > 0 {
            self.permits.released().await;
        }
    }
}

impl ConnectionSlot {
    pub(super) const fn permit(&self) -> &PermitHandle {
        self.permit.handle()
    }

    /// Completes when the connection must accept no further call: the server shuts down, or the connection is preempted.
    pub(super) async fn retired(&self) {
        let mut is_retiring = self.is_retiring.clone();
        tokio::select! {
            // Fails only if the table no longer exists.
            _ = is_retiring.wait_for(|is_retiring| *is_retiring) => {}
            _ = self.permit().preempted() => {}
        }
    }

    /// Completes when the socket must be dropped, whether or not the client has closed the connection.
    pub(super) async fn overdue(&self) {
        tokio::select! {
            () = self.close.notified() => {}
            _ = self.permit().preempted() => {
                if self.calls.has_received_request() && self.permits.ending() < MAX_ENDING / 2 {
                    tokio::time::sleep(GOAWAY_TIMEOUT).await;
                }
            }
        }
    }

    /// Completes after this time if no request has been received until then.
    pub(super) async fn first_request_overdue(&self, timeout: Duration) {
        tokio::time::sleep(timeout).await;
        if self.calls.has_received_request() {
            std::future::pending().await
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::admission::Client;

    fn account(client: u64) -> Account {
        Account::anonymous(Client::Connection(client))
    }

    fn table(max_connections: usize) -> Arc<ConnectionTable> {
        ConnectionTable::new(max_connections, &Admission::default())
    }

    async fn insert(table: &ConnectionTable, client: u64) -> ConnectionSlot {
        let slot = tokio::time::timeout(crate::hang_guard::HANG_GUARD, table.insert(&account(client))).await;
        slot.expect("expected no wait").expect("expected a permit")
    }

    /// Clients that do not react to GOAWAY hold a bounded number of sockets.
    #[tokio::test]
    async fn ending_connections_are_bounded() {
        let table = table(2);
        let mut slots = Vec::new();
        for client in 0..(2 + MAX_ENDING) as u64 {
            slots.push(insert(&table, client).await);
        }
        let waits = tokio::time::timeout(Duration::ZERO, table.insert(&account(1000))).await;
        assert!(waits.is_err(), "expected a wait for the end of a preempted connection");
        slots.remove(0);
        insert(&table, 1001).await;
    }

    #[tokio::test]
    async fn preempted_connection_is_retired_and_then_dropped() {
        let table = table(1);
        let slot = insert(&table, 1).await;
        assert!(tokio::time::timeout(Duration::ZERO, slot.retired()).await.is_err());
        let _new = insert(&table, 2).await;
        slot.retired().await;
        slot.overdue().await;
    }

    #[tokio::test]
    async fn retired_table_waits_for_its_connections() {
        let table = table(2);
        let slots = [insert(&table, 1).await, insert(&table, 2).await];
        assert!(tokio::time::timeout(Duration::ZERO, table.retire_all()).await.is_err());
        slots[0].retired().await;
        drop(slots);
        tokio::time::timeout(crate::hang_guard::HANG_GUARD, table.retire_all()).await.expect("expected no connection");
    }
}
