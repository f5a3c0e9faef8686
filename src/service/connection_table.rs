//! The open connections and their calls. When the limit on connections is reached, connections without calls are closed
//! for new ones.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use tokio::sync::Notify;

use crate::engine::lock;

/// Limit on the connections that are being closed and do not count against the limit on connections. Above it, a
/// connection is closed without GOAWAY, and new connections wait until others have closed.
const MAX_CLOSING: usize = 64;

/// Time within which the client must close a connection without calls after GOAWAY.
pub(super) const GOAWAY_TIMEOUT: Duration = Duration::from_secs(1);

/// All connections that were accepted and have not ended.
#[derive(Debug)]
pub(super) struct ConnectionTable {
    max_connections: usize,
    state: Mutex<State>,
    /// Notified when a connection ends or has no call any more.
    changed: Arc<Notify>,
}

#[derive(Debug, Default)]
struct State {
    next_id: u64,
    /// In the order of acceptance.
    connections: BTreeMap<u64, Entry>,
}

#[derive(Debug)]
struct Entry {
    activity: Arc<Activity>,
    signals: CloseSignals,
    /// The connection no longer counts against the limit.
    is_closing: bool,
}

/// How the server closes a connection.
#[derive(Debug, Clone, Default)]
pub(super) struct CloseSignals {
    /// Send GOAWAY with NO_ERROR, and let open calls end.
    pub(super) retire: Arc<Notify>,
    /// Drop the socket.
    pub(super) close: Arc<Notify>,
}

/// The entry of a connection in the table. Dropping it removes the entry.
#[derive(Debug)]
pub(super) struct ConnectionSlot {
    table: Arc<ConnectionTable>,
    id: u64,
    pub(super) activity: Arc<Activity>,
    pub(super) signals: CloseSignals,
}

/// The calls of a connection. A call counts from the moment when its first message has been received completely, so
/// that headers alone do not protect a connection.
#[derive(Debug)]
pub(super) struct Activity {
    state: Mutex<ActivityState>,
    changed: Arc<Notify>,
}

#[derive(Debug, Clone, Copy)]
struct ActivityState {
    open_calls: usize,
    has_received_request: bool,
    /// When the last call ended, or when the connection was accepted.
    idle_since: Instant,
}

/// A call of a connection, until it is dropped.
#[derive(Debug)]
pub(super) struct CountedCall {
    activity: Arc<Activity>,
    is_counted: AtomicBool,
}

impl ConnectionTable {
    pub(super) fn new(max_connections: usize) -> Arc<Self> {
        Arc::new(Self { max_connections, state: Mutex::default(), changed: Arc::default() })
    }

    /// Adds a connection. If the table is full, closes another one. If more than an eighth of all connections have sent
    /// no request, closes the oldest of these; otherwise the one that has been without calls for the longest time.
    /// Waits while every connection has a call. Cancel-safe.
    pub(super) async fn insert(self: &Arc<Self>) -> ConnectionSlot {
        loop {
            if let Some(slot) = self.try_insert() {
                return slot;
            }
            self.changed.notified().await;
        }
    }

    fn try_insert(self: &Arc<Self>) -> Option<ConnectionSlot> {
        let mut state = lock(&self.state);
        let open = state.connections.values().filter(|entry| !entry.is_closing).count();
        if open >= self.max_connections {
            if !state.evict(self.max_new()) {
                return None;
            }
            tracing::warn!(limit = self.max_connections, "a connection without calls is closed for a new one");
        }
        if state.connections.len() >= self.max_connections + MAX_CLOSING {
            return None;
        }
        let id = state.next_id;
        state.next_id += 1;
        let (activity, signals) = (Activity::new(&self.changed), CloseSignals::default());
        let entry = Entry { activity: Arc::clone(&activity), signals: signals.clone(), is_closing: false };
        state.connections.insert(id, entry);
        Some(ConnectionSlot { table: Arc::clone(self), id, activity, signals })
    }

    /// Makes a file descriptor available by closing a connection without calls. Returns false if there is none.
    pub(super) fn evict(&self) -> bool {
        lock(&self.state).evict(self.max_new())
    }

    /// Number of connections without a request that are not closed while others are idle. Without this number, a client
    /// that connects repeatedly would cause each new connection of other clients to be closed before the first request
    /// of that connection arrives.
    const fn max_new(&self) -> usize {
        self.max_connections / 8
    }

    /// Sends GOAWAY to all connections and waits until they have ended.
    pub(super) async fn retire_all(&self) {
        for entry in lock(&self.state).connections.values_mut() {
            entry.is_closing = true;
            entry.signals.retire.notify_one();
        }
        while !lock(&self.state).connections.is_empty() {
            self.changed.notified().await;
        }
    }
}

impl State {
    /// Closes a connection without calls. Returns false if there is none.
    fn evict(&mut self, max_new: usize) -> bool {
        let closing = self.connections.values().filter(|entry| entry.is_closing).count();
        let idle = || self.connections.iter().filter(|(_, entry)| !entry.is_closing && entry.activity.is_idle());
        let mut new = idle().filter(|(_, entry)| entry.activity.idle_since_request().is_none());
        let (oldest_new, is_above_share) = (new.next(), new.count() >= max_new);
        let longest_idle = || {
            let served = idle().filter_map(|item| Some((item.1.activity.idle_since_request()?, item)));
            served.min_by_key(|(idle_since, _)| *idle_since).map(|(_, item)| item)
        };
        let victim = oldest_new.filter(|_| is_above_share).or_else(longest_idle).or(oldest_new);
        let Some(id) = victim.map(|(id, _)| *id) else { return false };
        let Some(entry) = self.connections.get_mut(&id) else { return false };
        entry.is_closing = true;
        let is_retired = entry.activity.has_received_request() && closing < MAX_CLOSING / 2;
        let signal = if is_retired { &entry.signals.retire } else { &entry.signals.close };
        signal.notify_one();
        true
    }
}

impl ConnectionSlot {
    /// Completes after this time if no request has been received until then.
    pub(super) async fn first_request_overdue(&self, timeout: Duration) {
        tokio::time::sleep(timeout).await;
        if self.activity.has_received_request() {
            std::future::pending().await
        }
    }
}

impl Drop for ConnectionSlot {
    fn drop(&mut self) {
        lock(&self.table.state).connections.remove(&self.id);
        self.table.changed.notify_one();
    }
}

impl Activity {
    pub(super) fn new(changed: &Arc<Notify>) -> Arc<Self> {
        let state = ActivityState { open_calls: 0, has_received_request: false, idle_since: Instant::now() };
        Arc::new(Self { state: Mutex::new(state), changed: Arc::clone(changed) })
    }

    /// A new call, which counts from [`CountedCall::count`] on.
    pub(super) fn new_call(self: &Arc<Self>) -> Arc<CountedCall> {
        Arc::new(CountedCall { activity: Arc::clone(self), is_counted: AtomicBool::new(false) })
    }

    pub(super) fn is_idle(&self) -> bool {
        lock(&self.state).open_calls == 0
    }

    pub(super) fn has_received_request(&self) -> bool {
        lock(&self.state).has_received_request
    }

    /// When the last call ended. `None` if there was none.
    fn idle_since_request(&self) -> Option<Instant> {
        let state = lock(&self.state);
        state.has_received_request.then_some(state.idle_since)
    }
}

impl CountedCall {
    /// Counts the call. Later calls of this function have no effect.
    pub(super) fn count(&self) {
        if !self.is_counted.swap(true, Ordering::Relaxed) {
            let mut state = lock(&self.activity.state);
            state.open_calls += 1;
            state.has_received_request = true;
        }
    }
}

impl Drop for CountedCall {
    fn drop(&mut self) {
        if !self.is_counted.load(Ordering::Relaxed) {
            return;
        }
        let mut state = lock(&self.activity.state);
        state.open_calls -= 1;
        state.idle_since = Instant::now();
        if state.open_calls == 0 {
            self.activity.changed.notify_one();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn is_notified(signal: &Notify) -> bool {
        let mut cx = std::task::Context::from_waker(std::task::Waker::noop());
        std::pin::pin!(signal.notified()).poll(&mut cx).is_ready()
    }

    fn insert(table: &Arc<ConnectionTable>) -> ConnectionSlot {
        table.try_insert().expect("expected a connection without calls")
    }

    fn call(slot: &ConnectionSlot) -> Arc<CountedCall> {
        let call = slot.activity.new_call();
        call.count();
        call
    }

    #[test]
    fn full_table_closes_the_oldest_connection_without_request() {
        let table = ConnectionTable::new(3);
        let served = insert(&table);
        drop(call(&served));
        let (first, second) = (insert(&table), insert(&table));
        let _headers_only = first.activity.new_call();
        let _third = insert(&table);
        assert!(is_notified(&first.signals.close), "expected headers alone not to protect a connection");
        let _fourth = insert(&table);
        assert!(is_notified(&second.signals.close));
        assert!(!is_notified(&served.signals.close) && !is_notified(&served.signals.retire));
    }

    #[test]
    fn full_table_retires_the_connection_that_was_idle_longest() {
        let table = ConnectionTable::new(3);
        let slots: Vec<_> = (0..3).map(|_| insert(&table)).collect();
        let calls: Vec<_> = slots.iter().map(call).collect();
        assert!(table.try_insert().is_none(), "expected connections with calls to remain");
        // The last connection keeps its call.
        let [first, second, _third] = <[_; 3]>::try_from(calls).expect("expected three calls");
        drop(second);
        drop(first);
        let new = insert(&table);
        assert!(is_notified(&slots[1].signals.retire) && !is_notified(&slots[1].signals.close));
        drop(call(&new));
        let _newer = insert(&table);
        assert!(is_notified(&slots[0].signals.retire));
        assert!(!is_notified(&slots[2].signals.retire));
    }

    #[tokio::test]
    async fn full_table_waits_until_a_call_ends() {
        let table = ConnectionTable::new(1);
        let slot = table.insert().await;
        let open_call = call(&slot);
        let waiting = tokio::spawn({
            let table = Arc::clone(&table);
            async move { table.insert().await.id }
        });
        tokio::task::yield_now().await;
        assert!(!waiting.is_finished());
        drop(open_call);
        assert_eq!(waiting.await.expect("expected a slot"), 1);
    }

    /// Idle connections that reconnect repeatedly do not close a new one before its first request.
    #[test]
    fn new_connections_keep_an_eighth_of_the_table() {
        let table = ConnectionTable::new(16);
        let mut slots: Vec<_> = (0..16).map(|_| insert(&table)).collect();
        slots.iter().for_each(|slot| drop(call(slot)));
        let new: Vec<_> = (0..3).map(|_| insert(&table)).collect();
        assert!(new.iter().all(|slot| !is_notified(&slot.signals.close)));
        slots.push(insert(&table));
        assert!(is_notified(&new[0].signals.close) && !is_notified(&new[1].signals.close));
    }

    /// Clients that do not react to GOAWAY hold a bounded number of sockets.
    #[test]
    fn closing_connections_are_bounded() {
        let table = ConnectionTable::new(2);
        let mut slots = Vec::new();
        while let Some(slot) = table.try_insert() {
            drop(call(&slot));
            slots.push(slot);
            assert!(slots.len() <= 2 + MAX_CLOSING);
        }
        assert_eq!(slots.len(), 2 + MAX_CLOSING);
        let closed = slots.iter().filter(|slot| is_notified(&slot.signals.close)).count();
        assert!(closed >= MAX_CLOSING / 2, "expected connections to be closed without GOAWAY, got {closed}");
    }
}
