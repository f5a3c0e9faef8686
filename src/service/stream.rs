//! Reply streams. A task sends messages through a bounded channel; replies are split into chunks of at most 1 MiB; a
//! deadline covers the whole reply up to the last chunk; a panic ends only its own call.

use std::pin::Pin;
use std::time::{Duration, Instant};

use bytes::Bytes;
use tokio::sync::mpsc;
use tokio_stream::Stream;
use tokio_stream::wrappers::ReceiverStream;
use tonic::metadata::MetadataMap;
use tonic::{Response, Status};

use super::status::status;
use crate::config::Config;
use modalcast_model::error::{Error, Result};

/// A reply stream.
pub(super) type ReplyStream<T> = Pin<Box<dyn Stream<Item = Result<T, Status>> + Send>>;

/// Messages of a reply that may be buffered for the connection.
const REPLY_CAPACITY: usize = 2;

/// Sender of a reply stream. Sending waits while the client reads slowly (back-pressure).
#[derive(Debug)]
pub(super) struct ReplySender<T>(mpsc::Sender<Result<T, Status>>);

impl<T> ReplySender<T> {
    /// Sends one message.
    ///
    /// # Errors
    /// `CANCELLED` when the client has disconnected.
    pub(super) async fn send(&self, message: T) -> Result<(), Status> {
        self.0.send(Ok(message)).await.map_err(|_| gone())
    }

    /// Waits until the channel has capacity for a message. Cancel-safe.
    ///
    /// # Errors
    /// `CANCELLED` when the client has disconnected.
    pub(super) async fn reserve(&self) -> Result<mpsc::Permit<'_, Result<T, Status>>, Status> {
        self.0.reserve().await.map_err(|_| gone())
    }

    /// Waits until the client has disconnected.
    pub(super) async fn closed(&self) {
        self.0.closed().await;
    }
}

fn gone() -> Status {
    Status::cancelled("the client has gone")
}

/// Creates a reply stream that `work` fills. The result of `work` ends the stream; one slot of the channel is reserved
/// for it. When the client disconnects, `work` is dropped at its next await, so that its resources are released.
pub(super) fn respond<T, W, F>(work: W) -> Response<ReplyStream<T>>
where
    T: Send + 'static,
    W: FnOnce(ReplySender<T>) -> F,
    F: Future<Output = Result<(), Status>> + Send + 'static,
{
    let (sender, replies) = mpsc::channel(REPLY_CAPACITY + 1);
    let last_word = sender.clone().try_reserve_owned();
    let client = sender.clone();
    let work = work(ReplySender(sender));
    let work = tokio::spawn(async move {
        tokio::select! {
            end = work => end,
            () = client.closed() => Err(gone()),
        }
    });
    tokio::spawn(async move {
        let end = work.await.unwrap_or_else(|_| Err(Status::internal("the call failed on our side")));
        if let (Err(status), Ok(last_word)) = (end, last_word) {
            last_word.send(Err(status));
        }
    });
    Response::new(Box::pin(ReceiverStream::new(replies)))
}

/// Runs the work of a unary call in a separate task, so that a panic becomes an `INTERNAL` status of that call.
pub(super) async fn catch_panic<T: Send + 'static>(
    work: impl Future<Output = Result<T>> + Send + 'static,
) -> Result<Response<T>, Status> {
    match tokio::spawn(work).await {
        Ok(result) => result.map(Response::new).map_err(status),
        Err(_) => Err(Status::internal("the call failed on our side")),
    }
}

/// Splits a reply into pieces of at most `most` bytes, each with its offset. An empty reply is one empty piece.
pub(super) fn split_into_chunks(bytes: Bytes, most: usize) -> impl Iterator<Item = (u64, Bytes)> {
    let starts = (0..bytes.len().max(1)).step_by(most.max(1));
    starts.map(move |start| (start as u64, bytes.slice(start..bytes.len().min(start + most))))
}

/// Splits a reply as [`split_into_chunks`] does; the first chunk carries the head.
pub(super) fn chunks_with_head<H, C>(
    head: H,
    bytes: Bytes,
    most: usize,
    chunk: impl Fn(Option<H>, u64, Bytes) -> C,
) -> impl Iterator<Item = C> {
    let mut head = Some(head);
    split_into_chunks(bytes, most).map(move |(offset, data)| chunk(head.take(), offset, data))
}

/// The deadline of a call.
#[derive(Debug, Clone, Copy)]
pub(super) struct Deadline {
    /// The instant, and the time limit in milliseconds for errors; `None` means no deadline.
    at: Option<(Instant, u64)>,
}

impl Deadline {
    /// The deadline of a single request: the smaller of `ms` (milliseconds; 0 means unset) and the `grpc-timeout`
    /// header, else the configured default; limited to the configured maximum.
    pub(super) fn of_request(metadata: &MetadataMap, ms: u32, config: &Config) -> Self {
        let asked = (ms > 0).then(|| Duration::from_millis(ms.into()));
        let time = asked.into_iter().chain(header(metadata)).min().unwrap_or(config.deadline);
        Self::after(time.min(config.max_deadline))
    }

    /// The deadline of a stream: its `grpc-timeout` header, if present.
    pub(super) fn of_stream(metadata: &MetadataMap) -> Self {
        header(metadata).map_or(Self { at: None }, Self::after)
    }

    fn after(time: Duration) -> Self {
        Self { at: Instant::now().checked_add(time).map(|at| (at, time.as_millis() as u64)) }
    }

    /// Awaits `work`. If the deadline passes first, drops `work` and returns `DEADLINE_EXCEEDED` naming `what`.
    pub(super) async fn enforce<T>(
        self,
        what: &str,
        work: impl Future<Output = Result<T, Status>>,
    ) -> Result<T, Status> {
        let Some((at, ms)) = self.at else { return work.await };
        match tokio::time::timeout_at(at.into(), work).await {
            Ok(result) => result,
            Err(_) => Err(status(Error::Deadline { what: what.into(), ms })),
        }
    }
}

fn header(metadata: &MetadataMap) -> Option<Duration> {
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
    fn pieces_cover_a_reply_once_and_an_empty_reply_is_one_piece() {
        let bytes = Bytes::from((0..=250).collect::<Vec<u8>>());
        let cut: Vec<_> = split_into_chunks(bytes.clone(), 100).collect();
        assert_eq!(
            cut.iter().map(|(at, piece)| (*at, piece.len())).collect::<Vec<_>>(),
            [(0, 100), (100, 100), (200, 51)]
        );
        assert_eq!(cut.iter().flat_map(|(_, piece)| piece.to_vec()).collect::<Vec<_>>(), bytes);
        assert_eq!(split_into_chunks(Bytes::new(), 100).collect::<Vec<_>>(), [(0, Bytes::new())]);
    }

    #[test]
    fn a_timeout_header_is_digits_and_a_unit_and_anything_else_is_none() {
        assert_eq!(parse_timeout("250m"), Some(Duration::from_millis(250)));
        assert_eq!(parse_timeout("99999999H"), Some(Duration::from_secs(99_999_999 * 3600)));
        for text in ["", "S", "123456789S", "-1S", "1s", "1 S", "1é", "é"] {
            assert_eq!(parse_timeout(text), None, "{text}");
        }
    }

    #[test]
    fn a_request_is_over_after_the_shortest_time_it_names_and_never_after_the_longest() {
        let config = Config::default();
        let ms = |header: Option<&'static str>, ms| {
            let mut metadata = MetadataMap::new();
            if let Some(header) = header {
                metadata.insert("grpc-timeout", header.parse().expect("a header"));
            }
            let of = |deadline: Deadline| deadline.at.map(|(_, ms)| ms);
            (of(Deadline::of_request(&metadata, ms, &config)), of(Deadline::of_stream(&metadata)))
        };
        assert_eq!(ms(None, 0), (Some(30_000), None));
        assert_eq!(ms(None, 80), (Some(80), None));
        assert_eq!(ms(Some("50m"), 80), (Some(50), Some(50)));
        assert_eq!(ms(Some("2S"), 80), (Some(80), Some(2000)));
        assert_eq!(ms(None, u32::MAX), (Some(600_000), None));
        assert_eq!(ms(Some("99H"), 0), (Some(600_000), Some(99 * 3_600_000)));
    }

    #[tokio::test]
    async fn work_ends_where_it_waits_when_its_client_leaves() {
        let (held, ended) = tokio::sync::oneshot::channel::<()>();
        let replies = respond(move |_outlet: ReplySender<u32>| async move {
            std::future::pending::<()>().await;
            drop(held);
            Ok(())
        });
        drop(replies);
        let end = tokio::time::timeout(Duration::from_secs(10), ended).await.expect("the work is dropped");
        assert!(end.is_err());
    }

    #[tokio::test]
    async fn a_panicking_task_ends_its_stream_with_internal_even_when_nobody_reads() {
        let respond = respond(|reply_sender: ReplySender<u32>| async move {
            reply_sender.send(1).await?;
            reply_sender.send(2).await?;
            panic!("a planted panic")
        });
        let mut replies = respond.into_inner();
        use tokio_stream::StreamExt as _;
        assert_eq!(replies.next().await.expect("a message").expect("fine"), 1);
        assert_eq!(replies.next().await.expect("a message").expect("fine"), 2);
        let end = replies.next().await.expect("an end").expect_err("an error");
        assert_eq!(end.code(), tonic::Code::Internal);
        assert!(replies.next().await.is_none());
    }
}
