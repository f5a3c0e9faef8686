//! Encodes reply messages, and sends them as the body of a response. Large data of a message are not copied: they are
//! a frame of their own, which refers to the memory that the engine filled or that the scene holds.
//!
//! tonic decodes the request and builds the head of the response as for every call. [`with_body`] adds the body to the
//! extensions of that response, and [`replace_body`] replaces the empty body of tonic by it.

use std::collections::VecDeque;
use std::mem;
use std::pin::Pin;
use std::sync::{Arc, Mutex, PoisonError};
use std::task::{Context, Poll, ready};

use bytes::{Buf as _, BufMut as _, Bytes, BytesMut};
use http_body::Frame;
use modalcast_proto::v1;
use prost::Message;
use tokio_stream::Stream;
use tonic::body::Body;
use tonic::codegen::http;
use tonic::{Response, Status};

use super::MAX_REPLY_BYTES;
use super::reply_budget::{UnsentBytes, count_until_sent};
use super::status::internal_fault;

/// Data of at least this size are sent as a frame of their own. Copying fewer bytes costs less than a further frame.
const MIN_DATA_FRAME: usize = 16 << 10;

/// Messages are collected in one frame until it has this size, or no further message is ready.
const MAX_COLLECTED_BYTES: usize = 32 << 10;

/// Size of the prefix of a message: a flag (0: not compressed) and the length of the message as u32.
pub(super) const PREFIX_BYTES: usize = 5;

/// Wire type of a field whose length precedes it.
const LENGTH_DELIMITED: u8 = 2;

/// Initial capacity of the buffer for a message without its large data, in bytes.
const HEAD_CAPACITY: usize = 64;

/// A message of a reply.
pub(super) trait ReplyMessage: Message {
    /// The data of the message, if it may have large data.
    fn data(&mut self) -> Option<DataField<'_>> {
        None
    }
}

/// The field `data` of a message. If it is not empty, it is the last field.
pub(super) struct DataField<'a> {
    data: &'a mut Bytes,
    /// Number of the field.
    number: u8,
    /// Whether the data belong to a chunk, which is then the only field of the message.
    is_in_chunk: bool,
}

/// Implements [`ReplyMessage`] for messages with `oneof part { ... chunk }`, whose chunk has `data` with a number.
macro_rules! replies_with_chunk_part {
    ($($reply:ident, $part:ident, $number:literal;)*) => {$(
        impl ReplyMessage for v1::$reply {
            fn data(&mut self) -> Option<DataField<'_>> {
                match &mut self.part {
                    Some(v1::$part::Part::Chunk(chunk)) => {
                        Some(DataField { data: &mut chunk.data, number: $number, is_in_chunk: true })
                    }
                    #[allow(unreachable_patterns, reason = "some replies have no other part than a chunk")]
                    _ => None,
                }
            }
        }
    )*};
}

replies_with_chunk_part! {
    GetVerticesResponse, get_vertices_response, 3;
    StreamVerticesResponse, stream_vertices_response, 3;
    RenderFrameResponse, render_frame_response, 3;
    StreamFramesResponse, stream_frames_response, 3;
    StreamStatesResponse, stream_states_response, 3;
    DescribeSceneResponse, describe_scene_response, 5;
    DrawViewsResponse, draw_views_response, 5;
}

impl ReplyMessage for v1::GetStateResponse {
    fn data(&mut self) -> Option<DataField<'_>> {
        self.chunk.as_mut().map(|chunk| DataField { data: &mut chunk.data, number: 3, is_in_chunk: true })
    }
}

/// Implements [`ReplyMessage`] for messages whose last field is `data` with a number.
macro_rules! replies_with_data {
    ($($reply:ident, $number:literal;)*) => {$(
        impl ReplyMessage for v1::$reply {
            fn data(&mut self) -> Option<DataField<'_>> {
                Some(DataField { data: &mut self.data, number: $number, is_in_chunk: false })
            }
        }
    )*};
}

replies_with_data! {
    ReadContentResponse, 4;
    ReadModesResponse, 4;
}

/// Implements [`ReplyMessage`] for messages without large data.
macro_rules! replies_without_data {
    ($($reply:ident)*) => {$(impl ReplyMessage for v1::$reply {})*};
}

replies_without_data! {
    DeleteSceneResponse
    DriveSceneResponse
    FindUploadedFilesResponse
    ListClientsResponse
    ListScenesResponse
    OpenSceneResponse
    PickResponse
    ShareSceneResponse
    StreamForcesResponse
    UploadArraysResponse
    UploadSceneResponse
}

/// An encoded message with the prefix of gRPC.
#[derive(Debug)]
pub(super) struct EncodedMessage {
    /// The message without its large data.
    head: BytesMut,
    /// Large data, which follow the head. They are not copied.
    large_data: Option<Bytes>,
}

impl EncodedMessage {
    /// # Errors
    /// `INTERNAL` for a message that is larger than a reply may be.
    pub(super) fn new(mut message: impl ReplyMessage) -> Result<Self, Status> {
        let length = message.encoded_len();
        if length > MAX_REPLY_BYTES {
            let expected = format!("expected a reply of at most {MAX_REPLY_BYTES} bytes");
            return Err(internal_fault(format!("{expected}, got {length}")));
        }
        let large_data = message.data().filter(|field| field.data.len() >= MIN_DATA_FRAME);
        let large_data = large_data.map(|field| (mem::take(field.data), field.number, field.is_in_chunk));
        let mut head =
            BytesMut::with_capacity(if large_data.is_some() { HEAD_CAPACITY } else { PREFIX_BYTES + length });
        head.put_u8(0);
        head.put_u32(length as u32);
        let Some((data, number, is_in_chunk)) = large_data else {
            message.encode(&mut head).map_err(|error| internal_fault(error.to_string()))?;
            return Ok(Self { head, large_data: None });
        };
        if is_in_chunk {
            encode_chunk_without_data(&message, data.len(), &mut head)?;
        } else {
            message.encode(&mut head).map_err(|error| internal_fault(error.to_string()))?;
        }
        head.put_u8(number << 3 | LENGTH_DELIMITED);
        put_length(data.len(), &mut head)?;
        Ok(Self { head, large_data: Some(data) })
    }

    /// Size in bytes, including the prefix.
    pub(super) fn size(&self) -> usize {
        self.head.len() + self.large_data.as_ref().map_or(0, Bytes::len)
    }
}

fn put_length(length: usize, buffer: &mut BytesMut) -> Result<(), Status> {
    prost::encode_length_delimiter(length, buffer).map_err(|error| internal_fault(error.to_string()))
}

/// Encodes a message with a chunk up to the field `data`, of which there are `data_length` bytes. `message` has a chunk
/// without data.
fn encode_chunk_without_data(message: &impl Message, data_length: usize, buffer: &mut BytesMut) -> Result<(), Status> {
    let invalid = |error: prost::DecodeError| internal_fault(error.to_string());
    // The key of the chunk, the length of the chunk, and the chunk.
    let mut encoded = Bytes::from(message.encode_to_vec());
    let chunk_key = encoded.try_get_u8().map_err(|_| internal_fault("expected a reply with a chunk"))?;
    let chunk_length = prost::decode_length_delimiter(&mut encoded).map_err(invalid)?;
    if encoded.len() != chunk_length {
        return Err(internal_fault("expected a reply with nothing but a chunk"));
    }
    buffer.put_u8(chunk_key);
    put_length(chunk_length + 1 + prost::length_delimiter_len(data_length) + data_length, buffer)?;
    buffer.put(encoded);
    Ok(())
}

/// A message that waits to be sent, and its share of the reply budget.
#[derive(Debug)]
pub(super) struct QueuedMessage {
    pub(super) message: EncodedMessage,
    pub(super) unsent: UnsentBytes,
}

/// Adds the body that replaces the empty body of a response.
pub(super) fn with_body<T>(
    mut response: Response<T>,
    messages: impl Stream<Item = Result<QueuedMessage, Status>> + Send + Unpin + 'static,
) -> Response<T> {
    response.extensions_mut().insert(DetachedBody::new(Body::new(ReplyBody::new(messages))));
    response
}

/// Replaces the body of a response by the one that [`with_body`] has set, if any.
pub(super) fn replace_body(mut response: http::Response<Body>) -> http::Response<Body> {
    match response.extensions_mut().remove::<DetachedBody>().and_then(DetachedBody::into_body) {
        Some(body) => response.map(|_| body),
        None => response,
    }
}

/// The body that [`with_body`] has set.
#[cfg(test)]
pub(super) fn take_body<T>(mut response: Response<T>) -> Option<Body> {
    response.extensions_mut().remove::<DetachedBody>().and_then(DetachedBody::into_body)
}

/// A body in the extensions of a response, which must be `Clone` and `Sync`.
#[derive(Clone)]
struct DetachedBody(Arc<Mutex<Option<Body>>>);

impl DetachedBody {
    fn new(body: Body) -> Self {
        Self(Arc::new(Mutex::new(Some(body))))
    }

    fn into_body(self) -> Option<Body> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).take()
    }
}

/// A part of the body.
struct UnsentFrame {
    bytes: Bytes,
    /// What the messages that end in the frame take from the reply budget.
    unsent: Vec<UnsentBytes>,
}

/// Encoded messages as frames, and the status of the call as trailers.
struct ReplyBody<S> {
    messages: S,
    /// Frames to send, the oldest first.
    frames: VecDeque<UnsentFrame>,
    state: State,
}

/// Progress of a [`ReplyBody`].
enum State {
    Streaming,
    /// The messages have ended. The status follows the last frame.
    Ending(Status),
    Ended,
}

impl<S: Stream<Item = Result<QueuedMessage, Status>> + Unpin> ReplyBody<S> {
    const fn new(messages: S) -> Self {
        Self { messages, frames: VecDeque::new(), state: State::Streaming }
    }

    /// Fills `frames` with the messages that are ready, or sets the status at the end. Small messages share a frame.
    fn poll_messages(&mut self, context: &mut Context<'_>) -> Poll<()> {
        let (mut collected, mut unsent) = (BytesMut::new(), Vec::new());
        while collected.len() < MAX_COLLECTED_BYTES {
            let queued = match Pin::new(&mut self.messages).poll_next(context) {
                Poll::Ready(Some(Ok(queued))) => queued,
                Poll::Ready(Some(Err(status))) => {
                    self.state = State::Ending(status);
                    break;
                }
                Poll::Ready(None) => {
                    self.state = State::Ending(Status::ok(""));
                    break;
                }
                Poll::Pending if collected.is_empty() => return Poll::Pending,
                Poll::Pending => break,
            };
            let EncodedMessage { head, large_data } = queued.message;
            if collected.is_empty() {
                collected = head;
            } else {
                collected.extend_from_slice(&head);
            }
            if let Some(data) = large_data {
                self.frames.push_back(UnsentFrame { bytes: collected.freeze(), unsent });
                self.frames.push_back(UnsentFrame { bytes: data, unsent: vec![queued.unsent] });
                return Poll::Ready(());
            }
            unsent.push(queued.unsent);
        }
        if !collected.is_empty() {
            self.frames.push_back(UnsentFrame { bytes: collected.freeze(), unsent });
        }
        Poll::Ready(())
    }
}

impl<S: Stream<Item = Result<QueuedMessage, Status>> + Unpin> http_body::Body for ReplyBody<S> {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        if self.frames.is_empty() && matches!(self.state, State::Streaming) {
            ready!(self.poll_messages(context));
        }
        if let Some(UnsentFrame { bytes, unsent }) = self.frames.pop_front() {
            return Poll::Ready(Some(Ok(Frame::data(count_until_sent(bytes, unsent)))));
        }
        match mem::replace(&mut self.state, State::Ended) {
            State::Ending(status) => {
                let mut trailers = http::HeaderMap::new();
                Poll::Ready(Some(status.add_header(&mut trailers).map(|()| Frame::trailers(trailers))))
            }
            State::Streaming | State::Ended => Poll::Ready(None),
        }
    }

    fn is_end_stream(&self) -> bool {
        matches!(self.state, State::Ended)
    }
}

#[cfg(test)]
mod tests {
    use std::future::poll_fn;
    use std::pin::pin;

    use http_body::Body as _;
    use tokio_stream::wrappers::ReceiverStream;

    use super::super::reply_budget::CallReplies;
    use super::*;

    /// A chunk of a vertex stream. All of its fields are set.
    fn chunk(data: Bytes) -> v1::StreamVerticesResponse {
        let step = Some(v1::StepId { run: 1, number: 300, time: 0.5 });
        let head = Some(v1::VertexHead { step, total: 1 << 40, skipped: 7, ..Default::default() });
        let chunk = v1::VertexChunk { head, offset: 1 << 33, data, shared: None };
        v1::StreamVerticesResponse { part: Some(v1::stream_vertices_response::Part::Chunk(chunk)) }
    }

    async fn queued(message: impl ReplyMessage) -> Result<QueuedMessage, Status> {
        let message = EncodedMessage::new(message)?;
        let unsent = CallReplies::with_default_budgets().acquire(message.size()).await?;
        Ok(QueuedMessage { message, unsent })
    }

    /// The frames and the trailers of a body with these messages, which are all ready.
    async fn body_frames<T: ReplyMessage + 'static>(
        messages: Vec<Result<T, Status>>,
    ) -> (Vec<Bytes>, Option<http::HeaderMap>) {
        let mut queued_messages = Vec::new();
        for message in messages {
            queued_messages.push(match message {
                Ok(message) => queued(message).await,
                Err(status) => Err(status),
            });
        }
        let mut body = pin!(ReplyBody::new(tokio_stream::iter(queued_messages)));
        let (mut frames, mut trailers) = (Vec::new(), None);
        while let Some(frame) = poll_fn(|context| body.as_mut().poll_frame(context)).await {
            assert_eq!(trailers, None, "expected nothing after the trailers");
            match frame.expect("expected a frame").into_data() {
                Ok(data) => frames.push(data),
                Err(frame) => trailers = frame.into_trailers().ok(),
            }
        }
        assert!(body.is_end_stream());
        (frames, trailers)
    }

    /// The bytes that tonic sends for a message.
    fn encoded(message: &impl Message) -> Vec<u8> {
        let message = message.encode_to_vec();
        [&[0], &(message.len() as u32).to_be_bytes()[..], &message].concat()
    }

    fn status_code(trailers: Option<http::HeaderMap>) -> tonic::Code {
        Status::from_header_map(&trailers.expect("expected trailers")).expect("expected a status").code()
    }

    #[tokio::test]
    async fn large_data_are_a_frame_without_a_copy() {
        for length in [MIN_DATA_FRAME, 1 << 20, (1 << 20) + 1] {
            let data = Bytes::from((0..length).map(|index| index as u8).collect::<Vec<u8>>());
            let (frames, trailers) = body_frames(vec![Ok(chunk(data.clone())), Ok(chunk(data.clone()))]).await;
            assert_eq!(frames.len(), 4, "{length} bytes");
            for frames in frames.chunks(2) {
                assert_eq!(frames.concat(), encoded(&chunk(data.clone())), "{length} bytes");
                assert_eq!(frames[1].as_ptr(), data.as_ptr(), "{length} bytes: expected the same memory");
            }
            assert_eq!(status_code(trailers), tonic::Code::Ok);
        }
    }

    #[tokio::test]
    async fn every_reply_with_large_data_is_encoded_as_by_prost() {
        async fn assert_encoding<T: ReplyMessage + Clone + 'static>(reply: T) {
            let (frames, _) = body_frames(vec![Ok(reply.clone())]).await;
            assert_eq!((frames.len(), frames.concat()), (2, encoded(&reply)), "{}", std::any::type_name::<T>());
        }
        let data = Bytes::from(vec![5; MIN_DATA_FRAME]);
        let vertices = v1::VertexChunk { head: None, offset: 9, data: data.clone(), shared: None };
        let frame =
            v1::FrameChunk { offset: 0, data: data.clone(), head: Some(v1::FrameHead::default()), shared: None };
        let state = v1::StateChunk { head: Some(v1::StateHead::default()), offset: 1 << 20, data };
        let part = v1::get_vertices_response::Part::Chunk(vertices);
        assert_encoding(v1::GetVerticesResponse { part: Some(part) }).await;
        let part = v1::render_frame_response::Part::Chunk(frame.clone());
        assert_encoding(v1::RenderFrameResponse { part: Some(part) }).await;
        let part = v1::stream_frames_response::Part::Chunk(frame);
        assert_encoding(v1::StreamFramesResponse { part: Some(part) }).await;
        assert_encoding(v1::GetStateResponse { chunk: Some(state.clone()) }).await;
        let part = v1::stream_states_response::Part::Chunk(state);
        assert_encoding(v1::StreamStatesResponse { part: Some(part) }).await;
        let data = Bytes::from(vec![6; MIN_DATA_FRAME]);
        let array = v1::ArrayChunk { shape: 3, array: 2, offset: 1 << 40, total: 1 << 41, data: data.clone() };
        let part = v1::describe_scene_response::Part::Chunk(array);
        assert_encoding(v1::DescribeSceneResponse { part: Some(part) }).await;
        assert_encoding(v1::ReadContentResponse { item: 7, offset: 9, total: 1 << 33, data: data.clone() }).await;
        assert_encoding(v1::ReadModesResponse { rank: 0, offset: 0, total: 0, data }).await;
    }

    #[tokio::test]
    async fn small_messages_share_a_frame() {
        let settings = v1::VertexStreamSettings { delivery: 1, max_hz: 30.0, steps: 2 };
        let part = Some(v1::stream_vertices_response::Part::Settings(settings));
        let small = [
            v1::StreamVerticesResponse { part },
            chunk(Bytes::new()),
            chunk(vec![1; MIN_DATA_FRAME - 1].into()),
            v1::StreamVerticesResponse::default(),
        ];
        let expected: Vec<u8> = small.iter().flat_map(encoded).collect();
        let (frames, _) = body_frames(small.map(Ok).to_vec()).await;
        assert_eq!(frames, [expected]);
        // Eight messages of 4 KiB are more than one frame.
        let (frames, _) = body_frames(vec![Ok(chunk(vec![1; MAX_COLLECTED_BYTES / 8].into())); 24]).await;
        assert_eq!(frames.len(), 3, "expected bounded frames");
    }

    #[tokio::test]
    async fn status_of_the_call_follows_the_last_message() {
        let error = || Err(Status::with_details(tonic::Code::NotFound, "no scene", Bytes::from_static(b"details")));
        let (frames, trailers) = body_frames(vec![Ok(chunk(Bytes::new())), error(), Ok(chunk(Bytes::new()))]).await;
        assert_eq!(frames, [encoded(&chunk(Bytes::new()))], "expected nothing after the error");
        let trailers = trailers.expect("expected trailers");
        let status = Status::from_header_map(&trailers).expect("expected a status");
        assert_eq!((status.message(), status.details()), ("no scene", &b"details"[..]));
        assert_eq!(status_code(Some(trailers)), tonic::Code::NotFound);
        let too_large = chunk(vec![0; MAX_REPLY_BYTES].into());
        let (frames, trailers) = body_frames(vec![Ok(too_large)]).await;
        assert!(frames.is_empty());
        assert_eq!(status_code(trailers), tonic::Code::Internal);
    }

    /// A message is sent when no further one is ready, not when the frame is full.
    #[tokio::test]
    async fn message_does_not_wait_for_the_next_one() {
        let (sender, receiver) = tokio::sync::mpsc::channel(1);
        let mut body = pin!(ReplyBody::new(ReceiverStream::new(receiver)));
        sender.send(queued(chunk(Bytes::new())).await).await.expect("expected an open channel");
        let frame = poll_fn(|context| body.as_mut().poll_frame(context)).await;
        let frame = frame.expect("expected a frame").expect("expected data").into_data();
        assert_eq!(frame.expect("expected data"), encoded(&chunk(Bytes::new())));
        let mut next_frame = std::pin::pin!(poll_fn(|context| body.as_mut().poll_frame(context)));
        let pending = tokio::time::timeout(std::time::Duration::ZERO, next_frame.as_mut()).await;
        assert!(pending.is_err(), "expected no frame without a message");
        drop(sender);
        let trailers = next_frame.await.expect("expected trailers").expect("expected trailers");
        assert!(trailers.is_trailers());
    }
}
