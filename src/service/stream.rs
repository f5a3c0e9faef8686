//! Reply streams. A task sends messages through a bounded queue, within the reply budgets. Replies are split into
//! chunks of at most 1 MiB. A deadline covers the whole reply up to its last chunk. A panic ends only its own call.

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

use super::reply_budget::{CallReplies, ReplyContext, UnsentBytes};
use super::status::to_status;
use crate::config::Config;
use crate::engine::lock;
use modalcast_model::error::{Error, Result};

/// A reply stream.
pub(super) type ReplyStream<T> = Pin<Box<dyn Stream<Item = Result<T, Status>> + Send>>;

/// Maximum number of messages of a reply that are queued for the connection.
const REPLY_CAPACITY: usize = 2;

/// Bytes that gRPC adds to a message.
const MESSAGE_HEADER_BYTES: usize = 5;

/// A message with its share of the reply budget.
type QueuedMessage<T> = (T, UnsentBytes);

/// Sender of a reply stream. Sending waits while the client reads slowly (back-pressure), and while the replies of its
/// connection or of all connections exceed their budget.
#[derive(Debug)]
pub(super) struct ReplySender<T> {
    messages: mpsc::Sender<QueuedMessage<T>>,
    replies: Arc<CallReplies>,
}

/// Capacity for one message.
pub(super) struct ReplyPermit<'a, T> {
    slot: mpsc::Permit<'a, QueuedMessage<T>>,
    unsent: UnsentBytes,
}

impl<T: prost::Message> ReplyPermit<'_, T> {
    /// Queues a message, and releases the reserved bytes that it does not need.
    pub(super) fn send(mut self, message: T) {
        self.unsent.shrink_to(message.encoded_len() + MESSAGE_HEADER_BYTES);
        self.slot.send((message, self.unsent));
    }
}

impl<T: prost::Message> ReplySender<T> {
    /// Sends one message. Waits until there is capacity.
    ///
    /// # Errors
    /// `CANCELLED` when the client has disconnected.
    pub(super) async fn send(&self, message: T) -> Result<(), Status> {
        self.reserve(message.encoded_len()).await?.send(message);
        Ok(())
    }

    /// Waits until there is capacity for a message of `bytes` bytes. Reserve before a large message is built, so that
    /// no message waits outside the budget. Cancel-safe.
    ///
    /// # Errors
    /// `CANCELLED` when the client has disconnected.
    pub(super) async fn reserve(&self, bytes: usize) -> Result<ReplyPermit<'_, T>, Status> {
        let slot = self.messages.reserve().await.map_err(|_| disconnected_status())?;
        let unsent = self.replies.acquire(bytes + MESSAGE_HEADER_BYTES).await?;
        Ok(ReplyPermit { slot, unsent })
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

/// The queue of a reply. The stream takes messages from it, and the task that supervises the call can empty it.
#[derive(Debug)]
struct ReplyQueue<T> {
    messages: Mutex<mpsc::Receiver<QueuedMessage<T>>>,
    /// The error after the last message.
    error: Mutex<Option<Status>>,
}

impl<T> ReplyQueue<T> {
    /// Drops all queued messages.
    fn clear(&self) {
        let mut messages = lock(&self.messages);
        while messages.try_recv().is_ok() {}
    }
}

/// The stream of queued messages.
struct QueuedReplies<T> {
    queue: Arc<ReplyQueue<T>>,
    context: ReplyContext,
    /// Tells the supervising task when the stream is dropped.
    _is_open: oneshot::Sender<()>,
}

impl<T> Stream for QueuedReplies<T> {
    type Item = Result<T, Status>;

    fn poll_next(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        let next = lock(&self.queue.messages).poll_recv(cx);
        match ready!(next) {
            Some((message, unsent)) => {
                self.context.encode(unsent);
                Poll::Ready(Some(Ok(message)))
            }
            None => Poll::Ready(lock(&self.queue.error).take().map(Err)),
        }
    }
}

impl<T> Drop for QueuedReplies<T> {
    fn drop(&mut self) {
        lock(&self.queue.messages).close();
        self.queue.clear();
    }
}

/// Creates a reply stream to which `work` sends messages. An error of `work` ends the stream. When the client
/// disconnects, `work` is dropped at its next await, so that its resources are released. If the client does not read
/// while others wait for the reply budget, the call ends with `SlowReader`.
pub(super) fn respond<T, W, F>(work: W) -> Response<ReplyStream<T>>
where
    T: Send + 'static,
    W: FnOnce(ReplySender<T>) -> F,
    F: Future<Output = Result<(), Status>> + Send + 'static,
{
    let context = ReplyContext::current();
    let replies = Arc::clone(&context.replies);
    let (messages, receiver) = mpsc::channel(REPLY_CAPACITY);
    let queue = Arc::new(ReplyQueue { messages: Mutex::new(receiver), error: Mutex::default() });
    let (_is_open, is_closed) = oneshot::channel();
    let stream = QueuedReplies { queue: Arc::clone(&queue), context, _is_open };
    // The stream must not end before the error of `work` is stored.
    let keep_open = messages.clone();
    let task = tokio::spawn(work(ReplySender { messages, replies: Arc::clone(&replies) }));
    tokio::spawn(supervise(task, queue, replies, keep_open, is_closed));
    Response::new(Box::pin(stream))
}

/// Stores the error of a call. Ends the call when the stream is dropped or its client does not read.
async fn supervise<T>(
    mut task: JoinHandle<Result<(), Status>>,
    queue: Arc<ReplyQueue<T>>,
    replies: Arc<CallReplies>,
    keep_open: mpsc::Sender<QueuedMessage<T>>,
    mut is_closed: oneshot::Receiver<()>,
) {
    let panicked = |_| Err(Status::internal("the call panicked in the server"));
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

/// Runs the work of a unary call in a separate task, so that a panic becomes an `INTERNAL` status of that call. When the
/// client cancels the call, `work` is dropped at its next await.
pub(super) async fn catch_panic<T: prost::Message + 'static>(
    work: impl Future<Output = Result<T>> + Send + 'static,
) -> Result<Response<T>, Status> {
    let mut task = CallTask(tokio::spawn(work));
    let message = match (&mut task.0).await {
        Ok(result) => result.map_err(to_status)?,
        Err(_) => return Err(Status::internal("the call panicked in the server")),
    };
    let context = ReplyContext::current();
    context.encode(context.replies.acquire(message.encoded_len() + MESSAGE_HEADER_BYTES).await?);
    Ok(Response::new(message))
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
    use super::*;

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
        let replies = respond(move |_: ReplySender<u32>| async move {
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
            Ok(0_u32)
        }));
        let pending = tokio::time::timeout(Duration::ZERO, call.as_mut()).await;
        assert!(pending.is_err(), "control: expected a call without an end");
        drop(call);
        let result =
            tokio::time::timeout(crate::hang_guard::HANG_GUARD, work_dropped).await.expect("expected dropped work");
        assert!(result.is_err());
    }

    /// The channel is full when the work panics.
    #[tokio::test]
    async fn panicking_work_ends_its_stream_with_internal() {
        use tokio_stream::StreamExt as _;
        let response = respond(|reply_sender: ReplySender<u32>| async move {
            reply_sender.send(1).await?;
            reply_sender.send(2).await?;
            panic!("injected")
        });
        let mut replies = response.into_inner();
        for expected in [1, 2] {
            let reply = replies.next().await.expect("expected a reply").expect("expected a message");
            assert_eq!(reply, expected);
        }
        let end = replies.next().await.expect("expected an end").expect_err("expected an error");
        assert_eq!(end.code(), tonic::Code::Internal);
        assert!(replies.next().await.is_none());
    }
}
