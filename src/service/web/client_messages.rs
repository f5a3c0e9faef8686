//! The messages of a call that the client has sent and the service has not taken yet. They are the body of the gRPC
//! request.

use std::collections::VecDeque;
use std::pin::Pin;
use std::sync::{Arc, Mutex};
use std::task::{Context, Poll, Waker};

use bytes::{BufMut as _, Bytes, BytesMut};
use http_body::Frame;
use tokio::sync::Notify;
use tonic::Status;

use super::super::receive_budget::{ConnectionReceiveBudget, ReceivedMemory};
use super::close_reason::CloseReason;
use crate::engine::lock;

/// Bytes of messages that a client may send before the service has taken any.
const INITIAL_CREDIT: i64 = 1 << 20;

/// Credit is returned when at least this many bytes have been processed.
const MIN_RETURNED_CREDIT: i64 = INITIAL_CREDIT / 4;

/// Messages below this size are collected in one frame of the body.
const MAX_COLLECTED_BYTES: usize = 16 << 10;

/// Size of the prefix of a gRPC message: a flag (0: not compressed) and the length of the message as u32.
const PREFIX_BYTES: usize = 5;

/// The queue of messages. Its size is bounded by the credit of the call, which is the number of bytes that the client
/// may send, and by the receive budget of the connection, which also counts the prefixes of empty messages.
#[derive(Debug)]
pub(super) struct ClientMessages {
    state: Mutex<State>,
    processed: Notify,
}

#[derive(Debug)]
struct State {
    /// Complete frames, the oldest first.
    frames: VecDeque<QueuedFrame>,
    /// The frame that small messages are added to.
    collected: BytesMut,
    collected_payload: usize,
    memory: ReceivedMemory,
    memory_bytes: usize,
    /// Bytes that the client may send. Negative after a message that was larger than the credit.
    credit: i64,
    /// Bytes that the service has taken, and for which no credit was returned to the client yet.
    processed_bytes: i64,
    /// The client has sent END.
    is_complete: bool,
    /// The service takes no more messages.
    is_discarding: bool,
    reader: Option<Waker>,
}

#[derive(Debug)]
struct QueuedFrame {
    data: Bytes,
    /// Bytes of messages in the frame, without prefixes.
    payload_bytes: usize,
    /// Bytes of the budget that are released when the service takes the frame. A frame that ends with the prefix of a
    /// large message also releases the bytes of that message, because the body of the request counts them from the
    /// prefix on.
    memory_bytes: usize,
}

impl ClientMessages {
    pub(super) fn new(budget: &Arc<ConnectionReceiveBudget>) -> Arc<Self> {
        let state = State {
            frames: VecDeque::new(),
            collected: BytesMut::new(),
            collected_payload: 0,
            memory: budget.new_memory(),
            memory_bytes: 0,
            credit: INITIAL_CREDIT,
            processed_bytes: 0,
            is_complete: false,
            is_discarding: false,
            reader: None,
        };
        Arc::new(Self { state: Mutex::new(state), processed: Notify::new() })
    }

    /// Adds a message.
    ///
    /// # Errors
    /// The reason to close the connection: no credit, a message after the end, or an exhausted receive budget.
    pub(super) fn push(&self, message: Bytes) -> Result<(), CloseReason> {
        let mut state = lock(&self.state);
        if state.is_complete {
            return Err(CloseReason::invalid_id("no MESSAGE after END", "one more"));
        }
        if state.credit <= 0 {
            return Err(CloseReason::over_credit());
        }
        state.credit -= message.len() as i64;
        if state.is_discarding {
            return Ok(());
        }
        state.add_memory(message.len() + PREFIX_BYTES)?;
        state.add(message);
        state.wake_reader();
        Ok(())
    }

    /// Ends the messages. Later calls have no effect.
    pub(super) fn complete(&self) {
        let mut state = lock(&self.state);
        state.is_complete = true;
        state.wake_reader();
    }

    /// Waits until credit must be returned to the client, and returns its bytes. Cancel-safe.
    pub(super) async fn returned_credit(&self) -> u32 {
        loop {
            if let Some(bytes) = lock(&self.state).take_returned_credit() {
                return bytes;
            }
            self.processed.notified().await;
        }
    }
}

impl State {
    fn add_memory(&mut self, bytes: usize) -> Result<(), CloseReason> {
        let total = self.memory_bytes + bytes;
        self.memory.resize(total).map_err(|error| CloseReason::receive_budget(&error))?;
        self.memory_bytes = total;
        Ok(())
    }

    fn add(&mut self, message: Bytes) {
        self.collected.put_u8(0);
        self.collected.put_u32(message.len() as u32);
        if message.len() < MAX_COLLECTED_BYTES {
            self.collected.put_slice(&message);
            self.collected_payload += message.len();
            if self.collected.len() >= MAX_COLLECTED_BYTES {
                self.end_frame(0);
            }
        } else {
            self.end_frame(message.len());
            let payload_bytes = message.len();
            self.frames.push_back(QueuedFrame { data: message, payload_bytes, memory_bytes: 0 });
        }
    }

    /// Moves the collected messages to a frame. `announced_bytes` is the size of a message that follows the last
    /// prefix.
    fn end_frame(&mut self, announced_bytes: usize) {
        let data = self.collected.split().freeze();
        if !data.is_empty() {
            let memory_bytes = data.len() + announced_bytes;
            let payload_bytes = std::mem::take(&mut self.collected_payload);
            self.frames.push_back(QueuedFrame { data, payload_bytes, memory_bytes });
        }
    }

    fn pop(&mut self) -> Option<Bytes> {
        if self.frames.is_empty() {
            self.end_frame(0);
        }
        let frame = self.frames.pop_front()?;
        self.memory_bytes -= frame.memory_bytes;
        // Fails only after an eviction, which closes the connection.
        self.memory.resize(self.memory_bytes).ok();
        self.processed_bytes += frame.payload_bytes as i64;
        Some(frame.data)
    }

    fn take_returned_credit(&mut self) -> Option<u32> {
        if self.processed_bytes < MIN_RETURNED_CREDIT {
            return None;
        }
        let bytes = u32::try_from(std::mem::take(&mut self.processed_bytes)).unwrap_or(u32::MAX);
        self.credit += i64::from(bytes);
        Some(bytes)
    }

    fn wake_reader(&mut self) {
        if let Some(reader) = self.reader.take() {
            reader.wake();
        }
    }
}

/// The body of a gRPC request.
pub(super) struct ClientBody(pub(super) Arc<ClientMessages>);

impl http_body::Body for ClientBody {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        let mut state = lock(&self.0.state);
        if let Some(data) = state.pop() {
            if state.processed_bytes >= MIN_RETURNED_CREDIT {
                self.0.processed.notify_one();
            }
            return Poll::Ready(Some(Ok(Frame::data(data))));
        }
        if state.is_complete {
            return Poll::Ready(None);
        }
        state.reader = Some(cx.waker().clone());
        Poll::Pending
    }
}

impl Drop for ClientBody {
    fn drop(&mut self) {
        let mut state = lock(&self.0.state);
        state.is_discarding = true;
        (state.frames, state.collected, state.memory_bytes) = (VecDeque::new(), BytesMut::new(), 0);
        state.memory.resize(0).ok();
    }
}

#[cfg(test)]
mod tests {
    use http_body::Body as _;

    use super::super::super::receive_budget::ReceiveBudget;
    use super::*;
    use crate::admission::{Account, Admission};
    use crate::config::Config;

    fn messages() -> Arc<ClientMessages> {
        let config = Config { receive_bytes: 4 << 20, ..Config::default() };
        let budget = ReceiveBudget::new(&config, &Admission::default());
        ClientMessages::new(&budget.new_connection(&Account::server()))
    }

    /// The bytes of a gRPC message.
    fn encode(message: &[u8]) -> Vec<u8> {
        [&[0], &(message.len() as u32).to_be_bytes()[..], message].concat()
    }

    async fn next(body: &mut ClientBody) -> Option<Bytes> {
        let frame = std::future::poll_fn(|cx| Pin::new(&mut *body).poll_frame(cx)).await?;
        frame.expect("expected no error").into_data().ok()
    }

    #[tokio::test]
    async fn large_message_is_passed_on_without_a_copy() {
        let (messages, large) = (messages(), Bytes::from(vec![3; 100_000]));
        let mut body = ClientBody(Arc::clone(&messages));
        for message in [Bytes::from_static(b"ab"), Bytes::new(), large.clone(), Bytes::from_static(b"c")] {
            messages.push(message).expect("expected credit");
        }
        messages.complete();
        let (mut received, mut shares_memory) = (Vec::new(), false);
        while let Some(data) = next(&mut body).await {
            shares_memory |= data.as_ptr() == large.as_ptr();
            received.extend(data);
        }
        assert_eq!(received, [encode(b"ab"), encode(b""), encode(&large), encode(b"c")].concat());
        assert!(shares_memory);
        assert!(!lock(&messages.state).memory.is_in_use());
    }

    #[tokio::test]
    async fn credit_returns_when_the_service_takes_messages() {
        let messages = messages();
        let mut body = ClientBody(Arc::clone(&messages));
        let message = Bytes::from(vec![1; 1 << 18]);
        for _ in 0..3 {
            messages.push(message.clone()).expect("expected credit");
        }
        // The last message may exceed the credit.
        messages.push(vec![2; 3 << 18].into()).expect("expected credit for one message");
        let reason = messages.push(Bytes::from_static(b"x")).expect_err("expected no credit");
        assert_eq!(reason.code(), 4002);
        let pending = tokio::time::timeout(std::time::Duration::ZERO, messages.returned_credit()).await;
        assert!(pending.is_err(), "expected no credit before the service takes a message");
        let mut returned = 0;
        while returned < 6 << 18 {
            next(&mut body).await.expect("expected a frame");
            if lock(&messages.state).processed_bytes > 0 {
                returned += messages.returned_credit().await;
            }
        }
        assert_eq!(lock(&messages.state).credit, INITIAL_CREDIT);
    }

    #[test]
    fn empty_messages_are_bounded_by_the_budget() {
        let messages = messages();
        let _body = ClientBody(Arc::clone(&messages));
        let accepted = (0..10_000_000).position(|_| messages.push(Bytes::new()).is_err());
        assert_eq!(accepted, Some((3 << 20) / PREFIX_BYTES));
    }

    #[test]
    fn messages_after_the_body_are_dropped() {
        let messages = messages();
        drop(ClientBody(Arc::clone(&messages)));
        for _ in 0..4 {
            messages.push(vec![1; 1 << 18].into()).expect("expected credit");
        }
        assert!(!lock(&messages.state).memory.is_in_use());
        assert_eq!(messages.push(Bytes::from_static(b"x")).expect_err("expected no credit").code(), 4002);
        messages.complete();
        assert_eq!(messages.push(Bytes::new()).expect_err("expected an end").code(), 4001);
    }
}
