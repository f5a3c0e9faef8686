//! Reply streams. A task sends messages through a bounded channel. Replies are split into chunks of at most 1 MiB. A
//! deadline covers the whole reply up to its last chunk. A panic ends only its own call.

use std::pin::Pin;
use std::time::{Duration, Instant};

use bytes::Bytes;
use tokio::sync::mpsc;
use tokio_stream::Stream;
use tokio_stream::wrappers::ReceiverStream;
use tonic::metadata::MetadataMap;
use tonic::{Response, Status};

use super::status::to_status;
use crate::config::Config;
use modalcast_model::error::{Error, Result};

/// A reply stream.
pub(super) type ReplyStream<T> = Pin<Box<dyn Stream<Item = Result<T, Status>> + Send>>;

/// Maximum number of messages of a reply that are buffered for the connection.
const REPLY_CAPACITY: usize = 2;

/// Sender of a reply stream. Sending waits while the client reads slowly (back-pressure).
#[derive(Debug)]
pub(super) struct ReplySender<T>(mpsc::Sender<Result<T, Status>>);

impl<T> ReplySender<T> {
    /// Sends one message. Waits until the channel has capacity.
    ///
    /// # Errors
    /// `CANCELLED` when the client has disconnected.
    pub(super) async fn send(&self, message: T) -> Result<(), Status> {
        self.0.send(Ok(message)).await.map_err(|_| disconnected_status())
    }

    /// Waits until the channel has capacity for a message. Cancel-safe.
    ///
    /// # Errors
    /// `CANCELLED` when the client has disconnected.
    pub(super) async fn reserve(&self) -> Result<mpsc::Permit<'_, Result<T, Status>>, Status> {
        self.0.reserve().await.map_err(|_| disconnected_status())
    }

    /// Waits until the client has disconnected.
    pub(super) async fn closed(&self) {
        self.0.closed().await;
    }
}

fn disconnected_status() -> Status {
    Status::cancelled("the client has disconnected")
}

/// Creates a reply stream to which `work` sends messages. An error of `work` ends the stream. When the client
/// disconnects, `work` is dropped at its next await, so that its resources are released.
pub(super) fn respond<T, W, F>(work: W) -> Response<ReplyStream<T>>
where
    T: Send + 'static,
    W: FnOnce(ReplySender<T>) -> F,
    F: Future<Output = Result<(), Status>> + Send + 'static,
{
    let (sender, replies) = mpsc::channel(REPLY_CAPACITY + 1);
    // Reserved for the error of `work`, so that it can be sent even if the channel is full.
    let error_permit = sender.clone().try_reserve_owned();
    let disconnect_watcher = sender.clone();
    let work = work(ReplySender(sender));
    let task = tokio::spawn(async move {
        tokio::select! {
            result = work => result,
            () = disconnect_watcher.closed() => Err(disconnected_status()),
        }
    });
    tokio::spawn(async move {
        let result = task.await.unwrap_or_else(|_| Err(Status::internal("the call panicked in the server")));
        if let (Err(status), Ok(error_permit)) = (result, error_permit) {
            error_permit.send(Err(status));
        }
    });
    Response::new(Box::pin(ReceiverStream::new(replies)))
}

/// Runs the work of a unary call in a separate task, so that a panic becomes an `INTERNAL` status of that call.
pub(super) async fn catch_panic<T: Send + 'static>(
    work: impl Future<Output = Result<T>> + Send + 'static,
) -> Result<Response<T>, Status> {
    match tokio::spawn(work).await {
        Ok(result) => result.map(Response::new).map_err(to_status),
        Err(_) => Err(Status::internal("the call panicked in the server")),
    }
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
fn parse_timeout(text: &str) -> Option<Duration> {
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
        let result = tokio::time::timeout(Duration::from_secs(10), work_dropped).await.expect("expected dropped work");
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
