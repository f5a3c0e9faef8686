//! Budgets for the bytes of replies that are produced and not yet sent, per connection and in total.
//!
//! A message counts from the moment when it is queued until HTTP/2 has written its last byte to the socket. A sender
//! without budget waits; the client that holds the fewest bytes is the first to continue ([`Limit::REPLY_BYTES`]). The wait is bounded: a
//! call whose client takes no bytes for the reply timeout ends as soon as another sender waits for the same budget. If
//! that does not free the bytes, the connection is closed. If the total is exhausted, a connection that holds more than
//! its share and takes nothing for a shorter time is closed, so that a few connections do not delay all others.

use std::collections::HashMap;
use std::pin::Pin;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, Weak};
use std::task::{Context, Poll};
use std::time::{Duration, Instant};

use bytes::Bytes;
use http_body::{Body as HttpBody, Frame, SizeHint};
use tokio::sync::{Notify, OwnedSemaphorePermit, Semaphore};
use tonic::Status;
use tonic::body::Body;

use super::open_calls::CountedCall;
use super::status::{internal_fault, to_status};
use crate::admission::{Account, Limit, Queue, QueueMember, Units};
use crate::config::Config;
use crate::engine::lock;
use modalcast_model::error::Error;

/// After this multiple of the reply timeout, a connection with unsent bytes of an ended call is closed if other senders
/// wait, even if another call of the connection makes progress.
const MAX_STALL: u32 = 3;

/// How often a sender that waits for the total searches for connections to close.
const EVICTION_INTERVAL: Duration = Duration::from_millis(100);

/// Time without progress after which a connection above its share is closed when the total is exhausted.
const EVICTION_STALL: Duration = Duration::from_millis(400);

/// A connection that holds at most this many bytes is not above its share. One call never holds more: two messages of 1
/// MiB in its queue and two in HTTP/2.
const MIN_SHARE: usize = 4 << 20;

/// The budget of all connections.
#[derive(Debug)]
pub(super) struct ReplyBudget {
    bytes: Queue,
    max_connection_bytes: usize,
    /// Time without progress after which a call may be ended.
    reply_timeout: Duration,
    connections: Registry<ConnectionReplyBudget>,
}

/// The budget of one connection.
#[derive(Debug)]
pub(super) struct ConnectionReplyBudget {
    total: Arc<ReplyBudget>,
    /// Key in `ReplyBudget::connections`.
    id: u64,
    /// The budget of the connection.
    permits: Arc<Semaphore>,
    max_bytes: usize,
    /// Held by the sender that waits for the total. One sender per connection waits there, so that connections with
    /// many calls do not delay the others.
    turn: tokio::sync::Mutex<()>,
    close: Arc<Notify>,
    calls: Registry<CallReplies>,
    progress: Mutex<Progress>,
}

/// The unsent replies of one call.
#[derive(Debug)]
pub(super) struct CallReplies {
    connection: Arc<ConnectionReplyBudget>,
    /// The place of the client among those that wait for the total.
    of_total: QueueMember,
    /// Key in `ConnectionReplyBudget::calls`.
    id: u64,
    progress: Mutex<Progress>,
    ended: Notify,
    /// Whether the call was ended because its client does not read.
    is_ended: AtomicBool,
}

/// The unsent bytes of a connection or of a call.
#[derive(Debug, Clone, Copy)]
struct Progress {
    unsent_bytes: usize,
    /// When bytes were last sent, or when the first unsent bytes were produced.
    last_change: Instant,
}

impl Progress {
    fn new() -> Self {
        Self { unsent_bytes: 0, last_change: Instant::now() }
    }

    fn produce(&mut self, bytes: usize) {
        if self.unsent_bytes == 0 {
            self.last_change = Instant::now();
        }
        self.unsent_bytes += bytes;
    }

    fn send(&mut self, bytes: usize) {
        self.unsent_bytes -= bytes;
        self.last_change = Instant::now();
    }

    /// Time for which unsent bytes have waited without any being sent.
    fn stall(&self) -> Duration {
        if self.unsent_bytes > 0 { self.last_change.elapsed() } else { Duration::ZERO }
    }
}

/// Bytes of a reply that count against the budgets until this is dropped.
#[derive(Debug)]
pub(super) struct UnsentBytes {
    call: Arc<CallReplies>,
    bytes: usize,
    /// What these bytes take from the budget of the connection.
    of_connection: OwnedSemaphorePermit,
    /// Whether the bytes are part of a frame of the response. Others are dropped without being sent.
    is_attached: bool,
    /// What these bytes take from the budget of all connections.
    of_total: Units,
}

/// All existing objects of a kind.
#[derive(Debug)]
struct Registry<T> {
    objects: Mutex<HashMap<u64, Weak<T>>>,
    next_id: AtomicU64,
    /// When [`Self::search`] last returned the objects.
    last_search: Mutex<Instant>,
}

impl<T> Registry<T> {
    fn new() -> Self {
        Self { objects: Mutex::default(), next_id: AtomicU64::new(0), last_search: Mutex::new(Instant::now()) }
    }

    /// Adds an object, which `new` creates with its key.
    fn insert(&self, new: impl FnOnce(u64) -> T) -> Arc<T> {
        let id = self.next_id.fetch_add(1, Ordering::Relaxed);
        let object = Arc::new(new(id));
        lock(&self.objects).insert(id, Arc::downgrade(&object));
        object
    }

    fn remove(&self, id: u64) {
        lock(&self.objects).remove(&id);
    }

    /// All objects, or none if another search was less than `interval` ago: one search serves all that wait.
    fn search(&self, interval: Duration) -> Vec<Arc<T>> {
        let mut last_search = lock(&self.last_search);
        if last_search.elapsed() < interval {
            return Vec::new();
        }
        *last_search = Instant::now();
        lock(&self.objects).values().filter_map(Weak::upgrade).collect()
    }
}

/// Waits for bytes, and calls `search` after each `interval` of the wait.
async fn search_while_waiting<T>(acquire: impl Future<Output = T>, interval: Duration, search: impl Fn()) -> T {
    let mut acquire = std::pin::pin!(acquire);
    loop {
        tokio::select! {
            biased;
            granted = &mut acquire => return granted,
            () = tokio::time::sleep(interval) => search(),
        }
    }
}

impl ReplyBudget {
    pub(super) fn new(config: &Config) -> Arc<Self> {
        Arc::new(Self {
            bytes: Queue::new(Limit::REPLY_BYTES, config),
            max_connection_bytes: config.connection_reply_bytes,
            reply_timeout: config.reply_timeout,
            connections: Registry::new(),
        })
    }

    /// The budget of a new connection, which `close` closes.
    pub(super) fn new_connection(self: &Arc<Self>, close: Arc<Notify>) -> Arc<ConnectionReplyBudget> {
        let max_bytes = self.max_connection_bytes.min(u32::MAX as usize).min(Semaphore::MAX_PERMITS);
        self.connections.insert(|id| ConnectionReplyBudget {
            total: Arc::clone(self),
            id,
            permits: Arc::new(Semaphore::new(max_bytes)),
            max_bytes,
            turn: tokio::sync::Mutex::default(),
            close,
            calls: Registry::new(),
            progress: Mutex::new(Progress::new()),
        })
    }

    /// How often a sender that waits for its connection searches for stalled calls.
    fn search_interval(&self) -> Duration {
        self.reply_timeout / 4
    }

    /// How often a sender that waits for the total searches for stalled calls and connections.
    fn total_search_interval(&self) -> Duration {
        EVICTION_INTERVAL.min(self.search_interval())
    }

    /// Ends the stalled calls of all connections, and closes stalled connections above their share.
    fn relieve(&self) {
        let connections = self.connections.search(self.total_search_interval() / 2);
        let loads: Vec<_> = connections.iter().map(|connection| *lock(&connection.progress)).collect();
        for index in find_connections_above_share(&loads, self.bytes.total(), EVICTION_STALL) {
            let unsent_bytes = loads[index].unsent_bytes;
            tracing::warn!(
                unsent_bytes,
                "a connection that reads nothing is closed, because the reply budget is exhausted"
            );
            connections[index].close.notify_one();
        }
        let calls: Vec<_> = connections.iter().flat_map(|connection| connection.calls.search(Duration::ZERO)).collect();
        end_stalled(&calls, self.reply_timeout, Some(MAX_STALL * self.reply_timeout));
    }
}

/// The stalled connections that hold more than an equal share of the total, beginning with the largest, until they hold
/// a quarter of the total together. The connection that waits counts for the shares, too.
fn find_connections_above_share(loads: &[Progress], max_bytes: usize, stall: Duration) -> Vec<usize> {
    let holders = loads.iter().filter(|load| load.unsent_bytes > 0).count();
    let share = MIN_SHARE.max(max_bytes / (holders + 1));
    let is_above_share = |index: &usize| loads[*index].unsent_bytes > share && loads[*index].stall() >= stall;
    let mut found: Vec<usize> = (0..loads.len()).filter(is_above_share).collect();
    found.sort_by_key(|index| std::cmp::Reverse(loads[*index].unsent_bytes));
    let mut freed_bytes = 0;
    found.retain(|index| {
        let is_needed = freed_bytes < max_bytes / 4;
        freed_bytes += loads[*index].unsent_bytes;
        is_needed
    });
    found
}

impl ConnectionReplyBudget {
    /// The replies of a new call, which count to an account.
    pub(super) fn new_call(self: &Arc<Self>, account: &Account) -> Arc<CallReplies> {
        let (connection, of_total) = (Arc::clone(self), self.total.bytes.member(account));
        let (progress, ended) = (Mutex::new(Progress::new()), Notify::new());
        let is_ended = AtomicBool::new(false);
        self.calls.insert(|id| CallReplies { connection, of_total, id, progress, ended, is_ended })
    }

    /// Ends the stalled calls of this connection, unless they were searched less than `interval` ago.
    fn end_stalled_calls(&self, interval: Duration) {
        end_stalled(&self.calls.search(interval), self.total.reply_timeout, None);
    }
}

impl Drop for ConnectionReplyBudget {
    fn drop(&mut self) {
        self.total.connections.remove(self.id);
    }
}

impl CallReplies {
    /// Waits for budget for a reply. Cancel-safe.
    ///
    /// # Errors
    /// `INTERNAL` when the budget no longer exists.
    pub(super) async fn acquire(self: &Arc<Self>, bytes: usize) -> Result<UnsentBytes, Status> {
        let connection = &self.connection;
        let total = &connection.total;
        // A larger message passes with all permits of its connection.
        let permits = bytes.min(connection.max_bytes);
        let interval = total.search_interval();
        let end_own = || connection.end_stalled_calls(interval / 2);
        let of_connection = Arc::clone(&connection.permits).acquire_many_owned(permits as u32);
        let of_connection = search_while_waiting(of_connection, interval, end_own)
            .await
            .map_err(|_| internal_fault("the reply budget is closed"))?;
        let turn = connection.turn.lock().await;
        let of_total = self.of_total.acquire(permits);
        let of_total = search_while_waiting(of_total, total.total_search_interval(), || total.relieve()).await;
        let of_total = of_total.map_err(to_status)?;
        drop(turn);
        self.each_progress(|progress| progress.produce(bytes));
        Ok(UnsentBytes { call: Arc::clone(self), bytes, of_connection, is_attached: false, of_total })
    }

    /// Changes the progress of the call and of its connection.
    fn each_progress(&self, change: impl Fn(&mut Progress)) {
        for progress in [&self.progress, &self.connection.progress] {
            change(&mut lock(progress));
        }
    }

    fn is_ended(&self) -> bool {
        self.is_ended.load(Ordering::Relaxed)
    }

    /// Waits until the call is ended because its client does not read. Cancel-safe.
    pub(super) async fn ended(&self) {
        self.ended.notified().await;
    }

    /// The error of a call that was ended.
    pub(super) fn slow_reader(&self) -> Error {
        Error::SlowReader { queue: "reply buffer (in bytes)", limit: self.connection.total.max_connection_bytes }
    }
}

/// Ends the calls whose clients have taken nothing for `timeout`. If all these calls were ended earlier, the bytes that
/// they still hold are buffers of HTTP/2, which only the end of the connection frees, so their connections are closed.
/// While another call of the connection holds bytes, which it may still send or release, the connection is closed only
/// after `max_stall`; `None` means never. A call that was ended less than `timeout` ago may still release its queue.
fn end_stalled(calls: &[Arc<CallReplies>], timeout: Duration, max_stall: Option<Duration>) {
    let mut ended = Vec::new();
    let mut ends_running = false;
    for call in calls {
        // Two searches may find the same call.
        let mut progress = lock(&call.progress);
        if progress.unsent_bytes == 0 || progress.stall() < timeout {
            continue;
        }
        if call.is_ended() {
            ended.push(call);
        } else {
            call.is_ended.store(true, Ordering::Relaxed);
            progress.last_change = Instant::now();
            call.ended.notify_one();
            ends_running = true;
        }
    }
    if !ends_running {
        for call in ended {
            let progress = *lock(&call.progress);
            if max_stall.is_none_or(|max_stall| progress.stall() < max_stall)
                && may_free_bytes(calls, &call.connection, timeout)
            {
                continue;
            }
            let unsent_bytes = progress.unsent_bytes;
            tracing::warn!(unsent_bytes, "a connection that does not read its replies is closed");
            call.connection.close.notify_one();
        }
    }
}

/// Whether a call of the connection has unsent bytes, and runs or was ended less than `timeout` ago.
fn may_free_bytes(calls: &[Arc<CallReplies>], connection: &Arc<ConnectionReplyBudget>, timeout: Duration) -> bool {
    let mut of_connection = calls.iter().filter(|call| Arc::ptr_eq(&call.connection, connection));
    of_connection.any(|call| {
        let progress = *lock(&call.progress);
        progress.unsent_bytes > 0 && (!call.is_ended() || progress.stall() < timeout)
    })
}

impl Drop for CallReplies {
    fn drop(&mut self) {
        self.connection.calls.remove(self.id);
    }
}

impl UnsentBytes {
    /// Releases all but `bytes`, which is no progress. Without this, a call that was sent completely would still hold
    /// bytes, as if its client did not read.
    pub(super) fn shrink_to(&mut self, bytes: usize) {
        if let Some(excess) = self.bytes.checked_sub(bytes) {
            self.split_permits(excess);
            self.bytes = bytes;
            self.call.each_progress(|progress| progress.unsent_bytes -= excess);
        }
    }

    /// Removes `bytes`, at most all of these.
    pub(super) fn split(&mut self, bytes: usize) -> Option<Self> {
        let bytes = bytes.min(self.bytes);
        let (of_connection, of_total) = self.split_permits(bytes)?;
        self.bytes -= bytes;
        Some(Self { call: Arc::clone(&self.call), bytes, of_connection, is_attached: self.is_attached, of_total })
    }

    /// Removes what `bytes` take from the budgets. A message above the budget of its connection has fewer permits than
    /// bytes; the remainder keeps the rest.
    fn split_permits(&mut self, bytes: usize) -> Option<(OwnedSemaphorePermit, Units)> {
        let of_connection = self.of_connection.split(bytes.min(self.of_connection.num_permits()))?;
        Some((of_connection, self.of_total.split(bytes)))
    }
}

impl Drop for UnsentBytes {
    fn drop(&mut self) {
        let (bytes, is_attached) = (self.bytes, self.is_attached);
        let end =
            |progress: &mut Progress| if is_attached { progress.send(bytes) } else { progress.unsent_bytes -= bytes };
        self.call.each_progress(end);
    }
}

/// A frame that counts until HTTP/2 drops it.
struct CountedFrame {
    bytes: Bytes,
    _unsent: Vec<UnsentBytes>,
}

impl AsRef<[u8]> for CountedFrame {
    fn as_ref(&self) -> &[u8] {
        &self.bytes
    }
}

/// Makes a frame of a body hold `unsent` until HTTP/2 has written its last byte.
pub(super) fn count_until_sent(bytes: Bytes, mut unsent: Vec<UnsentBytes>) -> Bytes {
    if unsent.is_empty() {
        return bytes;
    }
    unsent.iter_mut().for_each(|unsent| unsent.is_attached = true);
    Bytes::from_owner(CountedFrame { bytes, _unsent: unsent })
}

/// The body of a response. The call counts until the body is dropped.
pub(super) struct CountedReplyBody {
    pub(super) inner: Body,
    pub(super) call: Arc<CountedCall>,
}

impl HttpBody for CountedReplyBody {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        let frame = Pin::new(&mut self.inner).poll_frame(cx);
        if let Poll::Ready(Some(Ok(frame))) = &frame
            && frame.is_data()
        {
            self.call.send_data();
        }
        frame
    }

    fn is_end_stream(&self) -> bool {
        self.inner.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.inner.size_hint()
    }
}

#[cfg(test)]
impl CallReplies {
    /// The replies of a call of a connection of its own, with the default budgets.
    pub(super) fn with_default_budgets() -> Arc<Self> {
        ReplyBudget::new(&Config::default()).new_connection(Arc::default()).new_call(&Account::server())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::admission::Client;

    /// A total of 100 bytes, of which one connection may hold 60.
    fn small_budget() -> Arc<ReplyBudget> {
        ReplyBudget::new(&Config {
            reply_bytes: 100,
            connection_reply_bytes: 60,
            reply_timeout: Duration::from_millis(40),
            ..Config::default()
        })
    }

    fn account(client: u64) -> Account {
        Account { principal: Some("anna".into()), client: Client::Connection(client) }
    }

    async fn with_timeout<T>(work: impl Future<Output = T>) -> T {
        tokio::time::timeout(crate::hang_guard::HANG_GUARD, work).await.expect("expected completion")
    }

    #[tokio::test]
    async fn bytes_count_until_their_frame_is_dropped() {
        let budget = small_budget();
        let call = budget.new_connection(Arc::default()).new_call(&Account::server());
        // A frame of two messages, of which one needs less than was reserved.
        let mut unsent = Vec::new();
        for (reserved_bytes, bytes) in [(20, 20), (40, 30)] {
            let mut of_message = call.acquire(reserved_bytes).await.expect("expected capacity");
            of_message.shrink_to(bytes);
            unsent.push(of_message);
        }
        let free_bytes = || budget.bytes.free();
        assert_eq!(free_bytes(), 50);
        let frame = count_until_sent(vec![0; 50].into(), unsent);
        let uncounted = count_until_sent(vec![0; 5].into(), vec![]);
        assert_eq!((frame.len(), uncounted.len(), free_bytes()), (50, 5, 50));
        let slice = frame.slice(3..4);
        drop(frame);
        assert_eq!(free_bytes(), 50);
        drop(slice);
        assert_eq!((free_bytes(), lock(&call.progress).unsent_bytes), (100, 0));
    }

    /// A message above the budget passes when nothing else is unsent.
    #[tokio::test]
    async fn message_above_the_budget_passes_alone() {
        let budget = small_budget();
        let call = budget.new_connection(Arc::default()).new_call(&account(1));
        let other_call = budget.new_connection(Arc::default()).new_call(&account(2));
        let large = with_timeout(call.acquire(1000)).await.expect("expected capacity");
        let other = with_timeout(other_call.acquire(40)).await.expect("expected capacity");
        drop((large, other));
        assert_eq!(budget.bytes.free(), 100);
    }

    #[test]
    fn largest_stalled_connections_above_their_share_are_found() {
        const MIB: usize = 1 << 20;
        let load = |mib: usize, stall: u64| Progress {
            unsent_bytes: mib * MIB,
            last_change: Instant::now() - Duration::from_secs(stall),
        };
        let find = |loads: &[Progress]| find_connections_above_share(loads, 256 * MIB, Duration::from_secs(1));
        // The share is 64 MiB for three holders and the connection that waits. Idle connections do not count.
        assert_eq!(find(&[load(70, 2), load(90, 0), load(80, 2), load(0, 9)]), [2]);
        assert_eq!(find(&[load(64, 9), load(63, 9), load(90, 0), load(0, 9)]), [0; 0]);
        assert_eq!(find(&[load(128, 9), load(128, 9)]), [0]);
        // A connection with one call is never above its share.
        assert_eq!(find(&vec![load(4, 9); 100]), [0; 0]);
        let many = [vec![load(3, 9); 60], vec![load(40, 9); 3]].concat();
        assert_eq!(find(&many), [60, 61]);
    }

    /// A call that takes nothing ends when another connection waits, and its connection is closed if that frees
    /// nothing.
    #[tokio::test]
    async fn stalled_call_ends_when_others_wait() {
        let budget = small_budget();
        let close = Arc::new(Notify::new());
        let stalled_connection = budget.new_connection(Arc::clone(&close));
        let stalled = stalled_connection.new_call(&account(1));
        let held = stalled.acquire(60).await.expect("expected capacity");
        // Nobody waits, so the call does not end.
        let end = tokio::time::timeout(Duration::from_millis(200), stalled.ended()).await;
        assert!(end.is_err(), "expected no end while nobody waits");
        let other = budget.new_connection(Arc::default()).new_call(&account(2));
        let waiting = tokio::spawn(async move { other.acquire(60).await.map(drop) });
        with_timeout(stalled.ended()).await;
        with_timeout(close.notified()).await;
        assert!(!waiting.is_finished());
        drop(held);
        with_timeout(waiting).await.expect("expected no panic").expect("expected capacity");
    }

    #[tokio::test]
    async fn connection_with_a_running_call_is_closed_later() {
        let budget = small_budget();
        let close = Arc::new(Notify::new());
        let connection = budget.new_connection(Arc::clone(&close));
        let calls = [connection.new_call(&account(1)), connection.new_call(&account(1))];
        let _stalled_bytes = calls[0].acquire(20).await.expect("expected capacity");
        end_stalled(&calls, Duration::ZERO, None);
        assert!(calls[0].is_ended());
        let running_bytes = calls[1].acquire(10).await.expect("expected capacity");
        lock(&calls[0].progress).last_change -= Duration::from_secs(60);
        let is_closed = async || tokio::time::timeout(Duration::ZERO, close.notified()).await.is_ok();
        end_stalled(&calls, Duration::from_secs(50), None);
        assert!(!is_closed().await, "expected no end of the running call");
        end_stalled(&calls, Duration::from_secs(50), Some(Duration::from_secs(60)));
        assert!(is_closed().await, "expected a limit for calls of other connections");
        drop(running_bytes);
        end_stalled(&calls, Duration::from_secs(50), None);
        assert!(is_closed().await, "expected nothing that could free bytes");
    }

    /// On a busy machine, a call needs time to release its queue after it was ended.
    #[tokio::test]
    async fn connection_with_a_call_that_just_ended_is_closed_later() {
        let limit = Duration::from_secs(50);
        let close = Arc::new(Notify::new());
        let connection = small_budget().new_connection(Arc::clone(&close));
        let calls = [connection.new_call(&account(1)), connection.new_call(&account(1))];
        let _first_bytes = calls[0].acquire(20).await.expect("expected capacity");
        let _second_bytes = calls[1].acquire(20).await.expect("expected capacity");
        end_stalled(&calls, Duration::ZERO, None);
        let is_closed = async || tokio::time::timeout(Duration::ZERO, close.notified()).await.is_ok();
        lock(&calls[0].progress).last_change -= limit;
        end_stalled(&calls, limit, None);
        assert!(!is_closed().await, "expected time for the second call to release bytes");
        lock(&calls[1].progress).last_change -= limit;
        end_stalled(&calls, limit, None);
        assert!(is_closed().await, "expected nothing that could free bytes");
    }

    /// Otherwise each message that a stalled connection produces would postpone its end.
    #[tokio::test]
    async fn only_sent_bytes_are_progress_of_a_connection() {
        let connection = small_budget().new_connection(Arc::default());
        let first = connection.new_call(&account(1)).acquire(20).await.expect("expected capacity");
        let first_change = lock(&connection.progress).last_change;
        let mut second = connection.new_call(&account(1)).acquire(30).await.expect("expected capacity");
        second.shrink_to(10);
        let progress = *lock(&connection.progress);
        assert_eq!((progress.unsent_bytes, progress.last_change), (30, first_change));
        drop(second);
        assert_eq!(lock(&connection.progress).last_change, first_change, "expected no progress by a canceled message");
        drop(count_until_sent(vec![0; 20].into(), vec![first]));
        assert!(lock(&connection.progress).last_change > first_change);
    }

    #[tokio::test]
    async fn only_a_call_without_progress_is_stalled() {
        let call = small_budget().new_connection(Arc::default()).new_call(&Account::server());
        let calls = [Arc::clone(&call)];
        let is_ended = || call.is_ended();
        end_stalled(&calls, Duration::ZERO, None);
        assert!(!is_ended(), "expected a call without unsent bytes to continue");
        let held = [10, 20].map(|bytes| call.acquire(bytes));
        let [first, second] = held;
        let (first, second) = (first.await.expect("expected capacity"), second.await.expect("expected capacity"));
        let change_before = lock(&call.progress).last_change;
        drop(count_until_sent(vec![0; 10].into(), vec![first]));
        assert!(lock(&call.progress).last_change > change_before, "expected sent bytes to count as progress");
        end_stalled(&calls, Duration::from_secs(1000), None);
        assert!(!is_ended(), "expected a call with recent progress to continue");
        end_stalled(&calls, Duration::ZERO, None);
        assert!(is_ended());
        drop(second);
    }
}
