//! The body of a request. Counts its messages against the receive budgets, and ends a message of which no more bytes
//! arrive.

use std::pin::Pin;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll};

use bytes::Bytes;
use http_body::{Body as HttpBody, Frame, SizeHint};
use tonic::Status;
use tonic::body::Body;

use super::open_calls::CountedCall;
use super::progress_timer::ProgressTimer;
use super::receive_budget::{ConnectionReceiveBudget, MessageLimits, Preemption, ReceivedMemory};
use super::status::to_status;
use modalcast_model::error::{Error, Result};

/// Bytes before each message: a flag and the length.
const HEADER_BYTES: usize = 5;

/// Memory of the messages of a call.
#[derive(Debug)]
struct CallMemory {
    /// The message that is being received.
    incomplete: ReceivedMemory,
    /// The last complete message. `None` after the response head, because the handler has then taken the request.
    complete: Option<ReceivedMemory>,
}

impl CallMemory {
    fn is_in_use(&self) -> bool {
        self.incomplete.is_in_use() || self.complete.as_ref().is_some_and(ReceivedMemory::is_in_use)
    }

    /// Completes when the bytes that are in use now are lost.
    fn preempted(&self) -> Preemption {
        match &self.complete {
            Some(complete) if !self.incomplete.is_in_use() => complete.preempted(),
            _ => self.incomplete.preempted(),
        }
    }

    /// Fails if memory in use was lost.
    fn check(&self) -> Result<()> {
        self.incomplete.check()?;
        self.complete.as_ref().map_or(Ok(()), ReceivedMemory::check)
    }
}

/// Handle of the memory of a call's messages. It outlives the body until the handler has answered.
#[derive(Debug, Clone)]
pub(super) struct RequestMemory(Arc<Mutex<CallMemory>>);

impl RequestMemory {
    pub(super) fn new(connection: &Arc<ConnectionReceiveBudget>) -> Self {
        let (incomplete, complete) = (connection.new_memory(), Some(connection.new_memory()));
        Self(Arc::new(Mutex::new(CallMemory { incomplete, complete })))
    }

    /// Releases the last complete message. Call this when the handler has answered.
    pub(super) fn release_complete(&self) {
        self.lock().complete = None;
    }

    /// A poisoned lock is valid, because no update of the memory can panic halfway.
    fn lock(&self) -> MutexGuard<'_, CallMemory> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The body of a request.
pub(super) struct RequestBody {
    inner: Body,
    memory: RequestMemory,
    position: MessagePosition,
    limits: MessageLimits,
    timer: ProgressTimer,
    preemption: Option<Preemption>,
    call: Arc<CountedCall>,
}

impl RequestBody {
    pub(super) fn new(inner: Body, memory: RequestMemory, limits: MessageLimits, call: Arc<CountedCall>) -> Self {
        Self {
            inner,
            memory,
            position: MessagePosition::default(),
            limits,
            timer: ProgressTimer::new(limits.timeout),
            preemption: None,
            call,
        }
    }

    /// Counts the messages of a frame.
    fn receive(&mut self, data: &[u8]) -> Result<()> {
        self.timer.stop(data.len());
        let advance = self.position.advance(data);
        let CallMemory { incomplete, complete } = &mut *self.memory.lock();
        if !advance.has_boundary {
            return incomplete.check();
        }
        self.timer.reset();
        incomplete.resize(0)?;
        if advance.largest_complete.is_some() {
            self.call.receive_message();
        }
        if let Some(complete) = complete {
            complete.resize(advance.largest_complete.unwrap_or(0).min(self.limits.max_bytes))?;
        }
        incomplete.resize(self.position.incomplete_bytes().min(self.limits.max_bytes))
    }

    /// Waits for more bytes. Ready when the messages of the call were lost, or the rest of a message is overdue.
    fn poll_wait(&mut self, cx: &mut Context<'_>) -> Poll<Error> {
        if !self.memory.lock().is_in_use() && !self.position.is_incomplete() {
            return Poll::Pending;
        }
        while self.memory.lock().is_in_use() {
            let new_preemption = || self.memory.lock().preempted();
            if self.preemption.get_or_insert_with(new_preemption).as_mut().poll(cx).is_pending() {
                break;
            }
            // That of an earlier message, unless the check fails.
            self.preemption = None;
            if let Err(error) = self.memory.lock().check() {
                return Poll::Ready(error);
            }
        }
        if !self.position.is_incomplete() {
            return Poll::Pending;
        }
        self.timer.poll_overdue(cx)
    }
}

impl HttpBody for RequestBody {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        let this = &mut *self;
        match Pin::new(&mut this.inner).poll_frame(cx) {
            Poll::Ready(Some(Ok(frame))) => {
                let received = frame.data_ref().map_or(Ok(()), |data| this.receive(data));
                Poll::Ready(Some(received.map(|()| frame).map_err(to_status)))
            }
            Poll::Ready(end) => Poll::Ready(end),
            Poll::Pending => this.poll_wait(cx).map(|error| Some(Err(to_status(error)))),
        }
    }

    fn is_end_stream(&self) -> bool {
        self.inner.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.inner.size_hint()
    }
}

/// Position in a sequence of gRPC messages.
#[derive(Debug, Default)]
struct MessagePosition {
    header: [u8; HEADER_BYTES],
    /// Number of received bytes of the next header.
    header_bytes: usize,
    /// Length of the message that is being received. 0 between messages.
    message_bytes: usize,
    /// Number of bytes of this message that were not received yet.
    missing_bytes: usize,
}

/// What a frame contains.
#[derive(Debug, PartialEq, Eq)]
struct Advance {
    /// Whether a message begins or ends in the frame.
    has_boundary: bool,
    /// Size of the largest message that ends in the frame, in bytes.
    largest_complete: Option<usize>,
}

impl MessagePosition {
    fn advance(&mut self, mut data: &[u8]) -> Advance {
        let mut advance = Advance { has_boundary: false, largest_complete: None };
        while !data.is_empty() {
            if self.missing_bytes > 0 {
                let bytes = self.missing_bytes.min(data.len());
                data = &data[bytes..];
                self.missing_bytes -= bytes;
                if self.missing_bytes == 0 {
                    advance.has_boundary = true;
                    advance.largest_complete = advance.largest_complete.max(Some(self.message_bytes));
                    self.message_bytes = 0;
                }
                continue;
            }
            let bytes = (HEADER_BYTES - self.header_bytes).min(data.len());
            self.header[self.header_bytes..][..bytes].copy_from_slice(&data[..bytes]);
            data = &data[bytes..];
            self.header_bytes += bytes;
            if self.header_bytes == HEADER_BYTES {
                let [_, length @ ..] = self.header;
                (self.message_bytes, self.header_bytes) = (u32::from_be_bytes(length) as usize, 0);
                self.missing_bytes = self.message_bytes;
                advance.has_boundary = true;
                if self.message_bytes == 0 {
                    advance.largest_complete = advance.largest_complete.max(Some(0));
                }
            }
        }
        advance
    }

    const fn is_incomplete(&self) -> bool {
        self.header_bytes > 0 || self.missing_bytes > 0
    }

    /// Length of the message that is being received, in bytes.
    const fn incomplete_bytes(&self) -> usize {
        self.message_bytes
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;
    use crate::admission::{Account, Admission, Client, Limit, Permit};
    use crate::config::Config;
    use crate::service::receive_budget::ReceiveBudget;

    /// The bytes of messages with these lengths.
    fn encode(lengths: &[usize]) -> Vec<u8> {
        let encode_one = |length: &usize| [&[0], &(*length as u32).to_be_bytes()[..], &vec![7; *length]].concat();
        lengths.iter().flat_map(encode_one).collect()
    }

    #[test]
    fn position_is_the_same_for_every_split_into_frames() {
        let bytes = encode(&[3, 0, 300, 9]);
        for frame_bytes in [1, 2, 4, 5, 7, 100, bytes.len()] {
            let mut position = MessagePosition::default();
            let advances: Vec<_> = bytes.chunks(frame_bytes).map(|frame| position.advance(frame)).collect();
            assert!(!position.is_incomplete(), "{frame_bytes}");
            assert_eq!(
                advances.iter().filter_map(|advance| advance.largest_complete).max(),
                Some(300),
                "{frame_bytes}"
            );
            position.advance(&bytes[..20]);
            assert!(position.is_incomplete());
            assert_eq!(position.incomplete_bytes(), 300);
        }
    }

    /// A body whose frames come from a channel.
    struct ChannelBody(tokio::sync::mpsc::Receiver<Vec<u8>>);

    impl HttpBody for ChannelBody {
        type Data = Bytes;
        type Error = Status;

        fn poll_frame(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
            self.0.poll_recv(cx).map(|data| data.map(|data| Ok(Frame::data(data.into()))))
        }
    }

    async fn next_frame(body: &mut RequestBody) -> Option<Result<usize, Status>> {
        let frame = std::future::poll_fn(|cx| Pin::new(&mut *body).poll_frame(cx)).await?;
        Some(frame.map(|frame| frame.data_ref().map_or(0, Bytes::len)))
    }

    fn body_of(
        connection: &Arc<ConnectionReceiveBudget>,
        timeout: Duration,
    ) -> (RequestBody, tokio::sync::mpsc::Sender<Vec<u8>>) {
        let (sender, receiver) = tokio::sync::mpsc::channel(8);
        let memory = RequestMemory::new(connection);
        let limits = MessageLimits { max_bytes: 1 << 20, timeout };
        let call = CountedCall::new(&Arc::default(), Permit::for_test(Limit::CONNECTIONS).handle(), "/");
        (RequestBody::new(Body::new(ChannelBody(receiver)), memory, limits, call), sender)
    }

    /// A budget of which one client may hold 600 bytes.
    fn budget() -> Arc<ReceiveBudget> {
        ReceiveBudget::new(&Config { receive_bytes: 800, ..Config::default() }, &Admission::default())
    }

    fn account(client: u64) -> Account {
        Account { principal: Some("anna".into()), client: Client::Connection(client) }
    }

    fn connection() -> Arc<ConnectionReceiveBudget> {
        budget().new_connection(&account(1))
    }

    #[tokio::test]
    async fn only_an_incomplete_message_has_a_deadline() {
        let (mut body, frames) = body_of(&connection(), Duration::from_millis(30));
        let message = encode(&[100]);
        frames.send(message.clone()).await.expect("expected an open channel");
        assert_eq!(next_frame(&mut body).await.expect("a frame").expect("no error"), 105);
        let pause = tokio::time::timeout(Duration::from_millis(300), next_frame(&mut body)).await;
        assert!(pause.is_err(), "expected no deadline between messages, got {pause:?}");
        frames.send(message[..50].to_vec()).await.expect("expected an open channel");
        assert_eq!(next_frame(&mut body).await.expect("a frame").expect("no error"), 50);
        let status = next_frame(&mut body).await.expect("a result").expect_err("expected a deadline");
        assert_eq!(status.code(), tonic::Code::DeadlineExceeded);
    }

    /// A message whose bytes arrive one by one with pauses does not arrive completely.
    #[tokio::test]
    async fn trickle_below_the_minimum_rate_does_not_extend_the_deadline() {
        let (mut body, frames) = body_of(&connection(), Duration::from_millis(60));
        let message = encode(&[100]);
        tokio::spawn(async move {
            for byte in message {
                if frames.send(vec![byte]).await.is_err() {
                    return;
                }
                tokio::time::sleep(Duration::from_millis(30)).await;
            }
        });
        let status = loop {
            if let Err(status) = next_frame(&mut body).await.expect("expected no end of the body") {
                break status;
            }
        };
        assert_eq!(status.code(), tonic::Code::DeadlineExceeded);
    }

    /// A complete request counts until the handler has answered, also while the client keeps its side open.
    #[tokio::test]
    async fn complete_message_counts_until_the_handler_answers() {
        let connection = connection();
        let (mut body, frames) = body_of(&connection, Duration::from_secs(10));
        frames.send(encode(&[500])).await.expect("expected an open channel");
        next_frame(&mut body).await.expect("a frame").expect("no error");
        let mut other = connection.new_memory();
        assert!(matches!(other.resize(200), Err(Error::LimitReached { .. })));
        body.memory.release_complete();
        other.resize(200).expect("expected capacity");
    }

    #[tokio::test]
    async fn message_over_budget_is_rejected_and_preemption_ends_a_wait() {
        let budget = budget();
        let connection = budget.new_connection(&account(1));
        let (mut body, frames) = body_of(&connection, Duration::from_secs(1000));
        frames.send(encode(&[590])[..100].to_vec()).await.expect("expected an open channel");
        next_frame(&mut body).await.expect("a frame").expect("no error");
        let (mut second_body, second_frames) = body_of(&connection, Duration::from_secs(1000));
        second_frames.send(encode(&[11])[..6].to_vec()).await.expect("expected an open channel");
        let status = next_frame(&mut second_body).await.expect("a result").expect_err("expected a rejection");
        assert_eq!(status.code(), tonic::Code::ResourceExhausted);
        let evict = async {
            tokio::task::yield_now().await;
            let other = budget.new_connection(&account(2));
            let mut memory = other.new_memory();
            memory.resize(500).expect("expected the first connection to lose its bytes");
            memory
        };
        let (end, _memory) = tokio::join!(next_frame(&mut body), evict);
        let status = end.expect("a result").expect_err("expected a preemption");
        assert_eq!(status.code(), tonic::Code::ResourceExhausted);
    }
}
