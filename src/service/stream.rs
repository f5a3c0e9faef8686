//! Reply streams. A task sends messages through a bounded queue, within the reply budgets. Replies are split into
//! chunks of at most 1 MiB. A deadline covers the whole reply up to its last chunk. A panic ends only its own call.

use std::marker::PhantomData;
use std::pin::Pin;
use std::sync::{Arc, Mutex};
use std::task::{Context, Poll, ready};
use std::time::{Duration, Instant};

use bytes::Bytes;
use tokio::sync::{mpsc, oneshot};
use tokio::task::JoinHandle;
use tokio_stream::Stream;
use tonic::metadata::MetadataMap;
use tonic::{Response, Status};

use super::reply_body::{EncodedMessage, PREFIX_BYTES, QueuedMessage, ReplyMessage, with_body};
use super::reply_budget::{CallReplies, UnsentBytes};
use super::status::{internal_fault, to_status};
use crate::config::Config;
use crate::engine::lock;
use modalcast_model::error::{Error, Result};

/// A reply stream.
pub(super) type ReplyStream<T> = Pin<Box<dyn Stream<Item = Result<T, Status>> + Send>>;

/// Maximum number of messages of a reply that are queued for the connection.
const REPLY_CAPACITY: usize = 2;

/// Sender of a reply stream. Sending waits while the client reads slowly (back-pressure), and while the replies of its
/// connection or of all connections exceed their budget.
#[derive(Debug)]
pub(super) struct ReplySender<T> {
    messages: mpsc::Sender<QueuedMessage>,
    replies: Arc<CallReplies>,
    message_type: PhantomData<fn(T)>,
}

/// Capacity for one message.
pub(super) struct ReplyPermit<'a, T> {
    slot: mpsc::Permit<'a, QueuedMessage>,
    unsent: UnsentBytes,
    message_type: PhantomData<fn(T)>,
}

impl<T: ReplyMessage> ReplyPermit<'_, T> {
    /// Encodes and queues a message, and releases the reserved bytes that it does not need.
    ///
    /// # Errors
    /// `INTERNAL` for a message that is larger than a reply may be.
    pub(super) fn send(self, message: T) -> Result<(), Status> {
        self.slot.send(encode_within(message, self.unsent)?);
        Ok(())
    }
}

/// Encodes a message, and releases the reserved bytes that it does not need.
fn encode_within(message: impl ReplyMessage, mut unsent: UnsentBytes) -> Result<QueuedMessage, Status> {
    let message = EncodedMessage::new(message)?;
    unsent.shrink_to(message.size());
    Ok(QueuedMessage { message, unsent })
}

/// Capacity for the messages of a whole reply that is produced at once.
pub(super) struct WholeReplyPermit<'a, T> {
    sender: &'a ReplySender<T>,
    unsent: UnsentBytes,
}

impl<T: ReplyMessage> WholeReplyPermit<'_, T> {
    /// Releases all but `bytes`.
    pub(super) fn shrink_to(&mut self, bytes: usize) {
        self.unsent.shrink_to(bytes);
    }

    /// Encodes and queues a message. Waits until the queue has capacity.
    ///
    /// # Errors
    /// `CANCELLED` when the client has disconnected; `INTERNAL` for a message that is larger than a reply may be.
    pub(super) async fn send(&mut self, message: T) -> Result<(), Status> {
        let slot = self.sender.messages.reserve().await.map_err(|_| disconnected_status())?;
        let message = EncodedMessage::new(message)?;
        let unsent = self.unsent.split(message.size()).ok_or_else(|| internal_fault("the reply budget is closed"))?;
        slot.send(QueuedMessage { message, unsent });
        Ok(())
    }
}

impl<T: ReplyMessage> ReplySender<T> {
    /// Sends one message. Waits until there is capacity. Large messages wait outside the budget here, so reserve before
    /// they are built.
    ///
    /// # Errors
    /// `CANCELLED` when the client has disconnected; `INTERNAL` for a message that is larger than a reply may be.
    pub(super) async fn send(&self, message: T) -> Result<(), Status> {
        self.reserve(message.encoded_len()).await?.send(message)
    }

    /// Waits until there is capacity for a message of `bytes` bytes. Reserve before a large message is built, so that
    /// no message waits outside the budget. Cancel-safe.
    ///
    /// # Errors
    /// `CANCELLED` when the client has disconnected.
    pub(super) async fn reserve(&self, bytes: usize) -> Result<ReplyPermit<'_, T>, Status> {
        let slot = self.messages.reserve().await.map_err(|_| disconnected_status())?;
        let unsent = self.replies.acquire(bytes + PREFIX_BYTES).await?;
        Ok(ReplyPermit { slot, unsent, message_type: PhantomData })
    }

    /// Waits until the budget has capacity for a whole reply of `bytes` bytes, whose messages are produced at once.
    /// Reserve before they are produced. A reply above the budget of its connection waits until nothing else of the
    /// connection is unsent. Cancel-safe.
    ///
    /// # Errors
    /// `CANCELLED` when the client has disconnected.
    pub(super) async fn reserve_whole(&self, bytes: usize) -> Result<WholeReplyPermit<'_, T>, Status> {
        Ok(WholeReplyPermit { sender: self, unsent: self.replies.acquire(bytes).await? })
    }

    /// Waits until the queue has capacity for a message of unknown size. Cancel-safe.
    ///
    /// # Errors
    /// `CANCELLED` when the client has disconnected.
    pub(super) async fn wait_for_capacity(&self) -> Result<(), Status> {
        self.messages.reserve().await.map(drop).map_err(|_| disconnected_status())
    }

    /// Waits until the client has disconnected.
    pub(super) async fn closed(&self) {
        self.messages.closed().await;
    }
}

fn disconnected_status() -> Status {
    Status::cancelled("the client has disconnected")
}

/// The queue of a reply. The body takes messages from it, and the task that supervises the call can empty it.
#[derive(Debug)]
struct ReplyQueue {
    messages: Mutex<mpsc::Receiver<QueuedMessage>>,
    /// The error after the last message.
    error: Mutex<Option<Status>>,
}

impl ReplyQueue {
    /// Drops all queued messages.
    fn clear(&self) {
        let mut messages = lock(&self.messages);
        while messages.try_recv().is_ok() {}
    }
}

/// The stream of queued messages.
struct QueuedReplies {
    queue: Arc<ReplyQueue>,
    /// Tells the supervising task when the stream is dropped.
    _is_open: oneshot::Sender<()>,
}

impl Stream for QueuedReplies {
    type Item = Result<QueuedMessage, Status>;

    fn poll_next(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        let next = lock(&self.queue.messages).poll_recv(cx);
        match ready!(next) {
            Some(queued) => Poll::Ready(Some(Ok(queued))),
            None => Poll::Ready(lock(&self.queue.error).take().map(Err)),
        }
    }
}

impl Drop for QueuedReplies {
    fn drop(&mut self) {
        lock(&self.queue.messages).close();
        self.queue.clear();
    }
}

/// Runs the work of a stream until its caller loses the right to the scene. `right_ended` completes then.
///
/// # Errors
/// Those of `work` and `right_ended`.
pub(super) async fn run_while_permitted(
    right_ended: impl Future<Output = Error>,
    work: impl Future<Output = Result<(), Status>>,
) -> Result<(), Status> {
    tokio::select! {
        biased;
        result = work => result,
        error = right_ended => Err(to_status(error)),
    }
}

/// Creates a reply stream to which `work` sends messages. An error of `work` ends the stream. When the client
/// disconnects, `work` is dropped at its next await, so that its resources are released. If the client does not read
/// while others wait for the reply budget, the call ends with `SlowReader`. The stream of the response is empty: its
/// messages are in the body that [`with_body`] adds.
pub(super) fn respond<T, W, F>(replies: Arc<CallReplies>, work: W) -> Response<ReplyStream<T>>
where
    T: Send + 'static,
    W: FnOnce(ReplySender<T>) -> F,
    F: Future<Output = Result<(), Status>> + Send + 'static,
{
    let (messages, receiver) = mpsc::channel(REPLY_CAPACITY);
    let queue = Arc::new(ReplyQueue { messages: Mutex::new(receiver), error: Mutex::default() });
    let (_is_open, is_closed) = oneshot::channel();
    let stream = QueuedReplies { queue: Arc::clone(&queue), _is_open };
    // The stream must not end before the error of `work` is stored.
    let keep_open = messages.clone();
    let reply_sender = ReplySender { messages, replies: Arc::clone(&replies), message_type: PhantomData };
    let task = tokio::spawn(work(reply_sender));
    tokio::spawn(supervise(task, queue, replies, keep_open, is_closed));
    let no_messages: ReplyStream<T> = Box::pin(tokio_stream::empty());
    with_body(Response::new(no_messages), stream)
}

/// Stores the error of a call. Ends the call when the stream is dropped or its client does not read.
async fn supervise(
    mut task: JoinHandle<Result<(), Status>>,
    queue: Arc<ReplyQueue>,
    replies: Arc<CallReplies>,
    keep_open: mpsc::Sender<QueuedMessage>,
    mut is_closed: oneshot::Receiver<()>,
) {
    let panicked = |_| Err(internal_fault("the call panicked in the server"));
    let end_slow_reader = || {
        *lock(&queue.error) = Some(to_status(replies.slow_reader()));
        queue.clear();
    };
    tokio::select! {
        result = &mut task => *lock(&queue.error) = result.unwrap_or_else(panicked).err(),
        _ = &mut is_closed => return task.abort(),
        () = replies.ended() => {
            task.abort();
            // Wait for the end of the task, because it may be sending a message.
            (&mut task).await.ok();
            end_slow_reader();
            return;
        }
    }
    drop(keep_open);
    // The queue may still have messages.
    tokio::select! {
        _ = &mut is_closed => {}
        () = replies.ended() => end_slow_reader(),
    }
}

/// The task of a unary call. Dropping it cancels the task.
struct CallTask<T>(JoinHandle<Result<T>>);

impl<T> Drop for CallTask<T> {
    fn drop(&mut self) {
        self.0.abort();
    }
}

/// Runs work of a unary call in a separate task, so that a panic becomes an `INTERNAL` status of that call. When the
/// client cancels the call, `work` is dropped at its next await.
pub(super) async fn catch_panic<T: Send + 'static>(
    work: impl Future<Output = Result<T>> + Send + 'static,
) -> Result<T, Status> {
    let mut task = CallTask(tokio::spawn(work));
    match (&mut task.0).await {
        Ok(result) => result.map_err(to_status),
        Err(_) => Err(internal_fault("the call panicked in the server")),
    }
}

/// Answers a unary call with the message that `build` produces, of at most `max_bytes` bytes. Waits for the reply budget
/// first, so `build` must not wait for other clients.
pub(super) async fn respond_once<T: ReplyMessage + Default + Send + 'static>(
    replies: Arc<CallReplies>,
    max_bytes: usize,
    build: impl Future<Output = Result<T>> + Send + 'static,
) -> Result<Response<T>, Status> {
    let unsent = replies.acquire(max_bytes + PREFIX_BYTES).await?;
    let queued = encode_within(catch_panic(build).await?, unsent)?;
    Ok(with_body(Response::new(T::default()), tokio_stream::once(Ok(queued))))
}

/// Splits a reply into chunks of at most `max_chunk_bytes` bytes, each with its offset in bytes. An empty reply is one
/// empty chunk.
pub(super) fn split_into_chunks(bytes: Bytes, max_chunk_bytes: usize) -> impl Iterator<Item = (u64, Bytes)> {
    let chunk_starts = (0..bytes.len().max(1)).step_by(max_chunk_bytes.max(1));
    chunk_starts.map(move |start| (start as u64, bytes.slice(start..bytes.len().min(start + max_chunk_bytes))))
}

/// Splits a reply as [`split_into_chunks`] does; the first chunk carries the head.
pub(super) fn chunks_with_head<H, C>(
    head: H,
    bytes: Bytes,
    max_chunk_bytes: usize,
    chunk: impl Fn(Option<H>, u64, Bytes) -> C,
) -> impl Iterator<Item = C> {
    let mut head = Some(head);
    split_into_chunks(bytes, max_chunk_bytes).map(move |(offset, data)| chunk(head.take(), offset, data))
}

/// The deadline of a call.
#[derive(Debug, Clone, Copy)]
pub(super) struct Deadline {
    /// `None` means no deadline.
    limit: Option<TimeLimit>,
}

#[derive(Debug, Clone, Copy)]
struct TimeLimit {
    deadline: Instant,
    /// The whole time limit in milliseconds, for errors.
    ms: u64,
}

impl Deadline {
    /// The deadline of a single request: the smaller of `ms` (milliseconds; 0 means unset) and the `grpc-timeout`
    /// header. If both are unset, the configured default. At most the configured maximum.
    pub(super) fn of_request(metadata: &MetadataMap, ms: u32, config: &Config) -> Self {
        let requested = (ms > 0).then(|| Duration::from_millis(ms.into()));
        let duration = requested.into_iter().chain(grpc_timeout(metadata)).min().unwrap_or(config.deadline);
        Self::after(duration.min(config.max_deadline))
    }

    /// The deadline of a stream: its `grpc-timeout` header, if present.
    pub(super) fn of_stream(metadata: &MetadataMap) -> Self {
        grpc_timeout(metadata).map_or(Self { limit: None }, Self::after)
    }

    fn after(duration: Duration) -> Self {
        let ms = duration.as_millis() as u64;
        Self { limit: Instant::now().checked_add(duration).map(|deadline| TimeLimit { deadline, ms }) }
    }

    /// Awaits `work`. If the deadline passes first, drops `work` and returns `DEADLINE_EXCEEDED` with `what`, a name of
    /// the awaited result.
    pub(super) async fn enforce<T>(
        self,
        what: &str,
        work: impl Future<Output = Result<T, Status>>,
    ) -> Result<T, Status> {
        let Some(TimeLimit { deadline, ms }) = self.limit else { return work.await };
        match tokio::time::timeout_at(deadline.into(), work).await {
            Ok(result) => result,
            Err(_) => Err(to_status(Error::Deadline { what: what.into(), ms })),
        }
    }
}

/// The `grpc-timeout` header of a call.
fn grpc_timeout(metadata: &MetadataMap) -> Option<Duration> {
    parse_timeout(metadata.get("grpc-timeout")?.to_str().ok()?)
}

/// Parses a `grpc-timeout` header: 1 to 8 digits and a unit.
pub(super) fn parse_timeout(text: &str) -> Option<Duration> {
    let (digits, unit) = text.split_at_checked(text.len().checked_sub(1)?)?;
    if digits.is_empty() || digits.len() > 8 || !digits.bytes().all(|digit| digit.is_ascii_digit()) {
        return None;
    }
    let count: u64 = digits.parse().ok()?;
    match unit {
        "H" => Some(Duration::from_secs(count * 3600)),
        "M" => Some(Duration::from_secs(count * 60)),
        "S" => Some(Duration::from_secs(count)),
        "m" => Some(Duration::from_millis(count)),
        "u" => Some(Duration::from_micros(count)),
        "n" => Some(Duration::from_nanos(count)),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

    use modalcast_proto::v1;
    use prost::Message as _;

    use super::*;
    use crate::admission::Account;
    use crate::service::reply_body::take_body;
    use crate::service::reply_budget::{ConnectionReplyBudget, ReplyBudget};

    #[test]
    fn chunks_cover_a_reply_once() {
        let bytes = Bytes::from((0..=250).collect::<Vec<u8>>());
        let chunks: Vec<_> = split_into_chunks(bytes.clone(), 100).collect();
        let offsets_and_sizes: Vec<_> = chunks.iter().map(|(offset, chunk)| (*offset, chunk.len())).collect();
        assert_eq!(offsets_and_sizes, [(0, 100), (100, 100), (200, 51)]);
        assert_eq!(chunks.iter().flat_map(|(_, chunk)| chunk.to_vec()).collect::<Vec<_>>(), bytes);
    }

    #[test]
    fn empty_reply_is_one_empty_chunk() {
        assert_eq!(split_into_chunks(Bytes::new(), 100).collect::<Vec<_>>(), [(0, Bytes::new())]);
    }

    #[test]
    fn timeout_header_has_digits_and_a_unit() {
        assert_eq!(parse_timeout("250m"), Some(Duration::from_millis(250)));
        assert_eq!(parse_timeout("99999999H"), Some(Duration::from_secs(99_999_999 * 3600)));
        for text in ["", "S", "123456789S", "-1S", "1s", "1 S", "1é", "é"] {
            assert_eq!(parse_timeout(text), None, "{text}");
        }
    }

    #[test]
    fn request_has_its_shortest_limit_up_to_the_maximum() {
        let config = Config::default();
        let limit_ms = |deadline: Deadline| deadline.limit.map(|limit| limit.ms);
        let metadata = |grpc_timeout: &'static str| {
            let mut metadata = MetadataMap::new();
            metadata.insert("grpc-timeout", grpc_timeout.parse().expect("expected a valid header"));
            metadata
        };
        let request_ms = |metadata: &MetadataMap, ms: u32| limit_ms(Deadline::of_request(metadata, ms, &config));
        let no_metadata = MetadataMap::new();
        // The default of the configuration is 30 s, and its maximum is 600 s.
        assert_eq!(request_ms(&no_metadata, 0), Some(30_000));
        assert_eq!(request_ms(&no_metadata, 80), Some(80));
        assert_eq!(request_ms(&no_metadata, u32::MAX), Some(600_000));
        assert_eq!(request_ms(&metadata("50m"), 80), Some(50));
        assert_eq!(request_ms(&metadata("2S"), 80), Some(80));
        assert_eq!(request_ms(&metadata("99H"), 0), Some(600_000));
        // A stream has no default and no maximum.
        let stream_ms = |metadata: &MetadataMap| limit_ms(Deadline::of_stream(metadata));
        assert_eq!(stream_ms(&no_metadata), None);
        assert_eq!(stream_ms(&metadata("2S")), Some(2000));
        assert_eq!(stream_ms(&metadata("99H")), Some(99 * 3_600_000));
    }

    #[tokio::test]
    async fn work_is_dropped_when_the_client_disconnects() {
        let (work_guard, work_dropped) = tokio::sync::oneshot::channel::<()>();
        let replies =
            respond(CallReplies::with_default_budgets(), move |_: ReplySender<v1::StreamForcesResponse>| async move {
                std::future::pending::<()>().await;
                drop(work_guard);
                Ok(())
            });
        drop(replies);
        let result =
            tokio::time::timeout(crate::hang_guard::HANG_GUARD, work_dropped).await.expect("expected dropped work");
        assert!(result.is_err());
    }

    /// Work that the client no longer waits for must not go on, for example an upload whose scene nobody would know.
    #[tokio::test]
    async fn work_of_a_canceled_unary_call_is_dropped() {
        let (work_guard, work_dropped) = tokio::sync::oneshot::channel::<()>();
        let mut call = Box::pin(catch_panic(async move {
            std::future::pending::<()>().await;
            drop(work_guard);
            Ok(())
        }));
        let pending = tokio::time::timeout(Duration::ZERO, call.as_mut()).await;
        assert!(pending.is_err(), "control: expected a call without an end");
        drop(call);
        let result =
            tokio::time::timeout(crate::hang_guard::HANG_GUARD, work_dropped).await.expect("expected dropped work");
        assert!(result.is_err());
    }

    /// A connection whose unsent replies have at most 100 bytes.
    fn small_connection() -> Arc<ConnectionReplyBudget> {
        let config = Config { connection_reply_bytes: 100, ..Config::default() };
        ReplyBudget::new(&config).new_connection(Arc::default())
    }

    /// Lets other tasks run until they wait.
    async fn run_other_tasks() {
        for _ in 0..100 {
            tokio::task::yield_now().await;
        }
    }

    /// Otherwise each call whose client does not read would hold a whole reply outside the budget.
    #[tokio::test]
    async fn whole_reply_is_produced_after_it_has_budget() {
        let connection = small_connection();
        let produced = Arc::new(AtomicUsize::new(0));
        let start_call = async || {
            let produced = Arc::clone(&produced);
            let work = |reply_sender: ReplySender<v1::StreamForcesResponse>| async move {
                let mut reply = reply_sender.reserve_whole(80).await?;
                produced.fetch_add(1, Ordering::Relaxed);
                reply.shrink_to(60);
                reply.send(v1::StreamForcesResponse { receiver_error: "x".repeat(50), ..Default::default() }).await
            };
            respond(connection.new_call(&Account::server()), work)
        };
        let unread = start_call().await;
        run_other_tasks().await;
        let waiting = start_call().await;
        run_other_tasks().await;
        assert_eq!(produced.load(Ordering::Relaxed), 1, "expected one reply within the budget");
        drop(unread);
        run_other_tasks().await;
        assert_eq!(produced.load(Ordering::Relaxed), 2, "expected the second reply after the first one");
        drop(waiting);
    }

    #[tokio::test]
    async fn unary_reply_is_built_after_it_has_budget() {
        let connection = small_connection();
        let unread = connection.new_call(&Account::server()).acquire(50).await.expect("expected capacity");
        let is_built = Arc::new(AtomicBool::new(false));
        let mark_built = Arc::clone(&is_built);
        let build = async move {
            mark_built.store(true, Ordering::Relaxed);
            Ok(v1::DeleteSceneResponse {})
        };
        let mut call = Box::pin(respond_once(connection.new_call(&Account::server()), 60, build));
        let pending = tokio::time::timeout(Duration::from_millis(50), call.as_mut()).await;
        assert!(pending.is_err() && !is_built.load(Ordering::Relaxed), "expected no reply without budget");
        drop(unread);
        tokio::time::timeout(crate::hang_guard::HANG_GUARD, call)
            .await
            .expect("expected an answer")
            .expect("expected a reply");
        assert!(is_built.load(Ordering::Relaxed));
    }

    /// The channel is full when the work panics.
    #[tokio::test]
    async fn panicking_work_ends_its_stream_with_internal() {
        use http_body_util::BodyExt as _;
        let reply = |text: &str| v1::StreamForcesResponse { receiver_error: text.into(), ..Default::default() };
        let response = respond(
            CallReplies::with_default_budgets(),
            move |reply_sender: ReplySender<v1::StreamForcesResponse>| async move {
                reply_sender.send(reply("first")).await?;
                reply_sender.send(reply("second")).await?;
                panic!("injected")
            },
        );
        let body = take_body(response).expect("expected a body").collect().await.expect("expected frames");
        let status = Status::from_header_map(body.trailers().expect("expected trailers")).expect("expected a status");
        assert_eq!(status.code(), tonic::Code::Internal);
        let expected = ["first", "second"].map(|text| {
            let message = reply(text).encode_to_vec();
            [&[0], &(message.len() as u32).to_be_bytes()[..], &message].concat()
        });
        assert_eq!(body.to_bytes(), expected.concat());
    }
}
