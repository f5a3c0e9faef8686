//! Bodies of reply streams whose chunks are sent without a copy. tonic encodes every message into one buffer. A
//! [`ReplyBody`] encodes only the head of a chunk. The data of the chunk follow as a separate frame, which refers to
//! the memory that the engine filled.
//!
//! tonic decodes the request and builds the head of the response as for every call. The response has an empty body,
//! which [`replace_body`] replaces by the body in the extensions of the response.

use std::collections::VecDeque;
use std::mem;
use std::pin::Pin;
use std::sync::{Arc, Mutex, PoisonError};
use std::task::{Context, Poll, ready};

use bytes::{Buf as _, BufMut as _, Bytes, BytesMut};
use http_body::Frame;
use modalcast_proto::v1;
use prost::Message;
use tonic::body::Body;
use tonic::codegen::http;
use tonic::{Response, Status};

use super::MAX_REPLY_BYTES;
use super::stream::ReplyStream;

/// Data of at least this size are sent as a frame of their own. Copying fewer bytes costs less than a further frame.
const MIN_DATA_FRAME: usize = 16 << 10;

/// Messages are collected in one frame until it has this size, or no further message is ready.
const MAX_COLLECTED_BYTES: usize = 32 << 10;

/// Initial capacity of the buffer that messages are collected in.
const BUFFER_CAPACITY: usize = 8 << 10;

/// Size of the prefix of a message: a flag (0: not compressed) and the length of the message as u32.
const PREFIX_BYTES: usize = 5;

/// Key of the field `data` of a chunk: field 3 with a length. It is the last field of every chunk with large data.
const DATA_KEY: u8 = 3 << 3 | 2;

/// A reply that may have a chunk. The chunk is then its only field.
pub(super) trait ChunkReply: Message {
    /// The field `data` of the chunk. It has the number 3, and is the last field of the chunk if it is not empty.
    fn chunk_data(&mut self) -> Option<&mut Bytes>;
}

/// Implements [`ChunkReply`] for messages with `oneof part { ... chunk }`.
macro_rules! chunk_reply_with_parts {
    ($($reply:ident, $part:ident;)*) => {$(
        impl ChunkReply for v1::$reply {
            fn chunk_data(&mut self) -> Option<&mut Bytes> {
                match &mut self.part {
                    Some(v1::$part::Part::Chunk(chunk)) => Some(&mut chunk.data),
                    #[allow(unreachable_patterns, reason = "some replies have no other part than a chunk")]
                    _ => None,
                }
            }
        }
    )*};
}

chunk_reply_with_parts! {
    GetVerticesResponse, get_vertices_response;
    StreamVerticesResponse, stream_vertices_response;
    RenderFrameResponse, render_frame_response;
    StreamFramesResponse, stream_frames_response;
    StreamStatesResponse, stream_states_response;
}

impl ChunkReply for v1::GetStateResponse {
    fn chunk_data(&mut self) -> Option<&mut Bytes> {
        self.chunk.as_mut().map(|chunk| &mut chunk.data)
    }
}

/// Lets the data of chunks be sent without a copy.
pub(super) fn without_copies<T: ChunkReply + 'static>(response: Response<ReplyStream<T>>) -> Response<ReplyStream<T>> {
    let (metadata, messages, mut extensions) = response.into_parts();
    extensions.insert(DetachedBody::new(Body::new(ReplyBody::new(messages))));
    Response::from_parts(metadata, Box::pin(tokio_stream::empty()), extensions)
}

/// Replaces the body of a response by the one that [`without_copies`] has set, if any.
pub(super) fn replace_body(mut response: http::Response<Body>) -> http::Response<Body> {
    match response.extensions_mut().remove::<DetachedBody>().and_then(DetachedBody::into_body) {
        Some(body) => response.map(|_| body),
        None => response,
    }
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

/// The messages of a reply stream as frames, and the status of the call as trailers.
struct ReplyBody<T> {
    messages: ReplyStream<T>,
    /// Messages that are not in `frames` yet.
    collected: BytesMut,
    /// Frames to send, the oldest first.
    frames: VecDeque<Bytes>,
    state: State,
}

/// Progress of a [`ReplyBody`].
enum State {
    Streaming,
    /// The messages have ended. The status follows the last frame.
    Ending(Status),
    Ended,
}

impl<T: ChunkReply> ReplyBody<T> {
    fn new(messages: ReplyStream<T>) -> Self {
        let collected = BytesMut::with_capacity(BUFFER_CAPACITY);
        Self { messages, collected, frames: VecDeque::new(), state: State::Streaming }
    }

    /// Fills `frames` with the messages that are ready, or sets the status at the end.
    fn poll_messages(&mut self, context: &mut Context<'_>) -> Poll<()> {
        while self.frames.is_empty() && self.collected.len() < MAX_COLLECTED_BYTES {
            match self.messages.as_mut().poll_next(context) {
                Poll::Ready(Some(message)) => {
                    if let Err(status) = message.and_then(|message| self.encode(message)) {
                        self.state = State::Ending(status);
                        break;
                    }
                }
                Poll::Ready(None) => {
                    self.state = State::Ending(Status::ok(""));
                    break;
                }
                Poll::Pending if self.collected.is_empty() => return Poll::Pending,
                Poll::Pending => break,
            }
        }
        self.end_frame();
        Poll::Ready(())
    }

    /// Moves the collected messages to a frame.
    fn end_frame(&mut self) {
        if !self.collected.is_empty() {
            self.frames.push_back(self.collected.split().freeze());
        }
    }

    /// Encodes a message. Large data of a chunk become a frame without a copy.
    fn encode(&mut self, mut message: T) -> Result<(), Status> {
        let length = message.encoded_len();
        if length > MAX_REPLY_BYTES {
            let expected = format!("expected a reply of at most {MAX_REPLY_BYTES} bytes");
            return Err(Status::internal(format!("{expected}, got {length}")));
        }
        self.collected.reserve(PREFIX_BYTES);
        self.collected.put_u8(0);
        self.collected.put_u32(length as u32);
        let data = match message.chunk_data().filter(|data| data.len() >= MIN_DATA_FRAME) {
            Some(data) => mem::take(data),
            None => {
                // The buffer grows, so it has room for every message.
                return message.encode(&mut self.collected).map_err(|error| Status::internal(error.to_string()));
            }
        };
        encode_without_data(&message, data.len(), &mut self.collected)?;
        self.end_frame();
        self.frames.push_back(data);
        Ok(())
    }
}

/// Encodes a message up to the data of its chunk, of which there are `data_length` bytes. `message` has a chunk without
/// data.
fn encode_without_data(message: &impl Message, data_length: usize, buffer: &mut BytesMut) -> Result<(), Status> {
    let invalid = |error: prost::DecodeError| Status::internal(error.to_string());
    // The key of the chunk, the length of the chunk, and the chunk.
    let mut encoded = Bytes::from(message.encode_to_vec());
    let chunk_key = encoded.try_get_u8().map_err(|_| Status::internal("expected a reply with a chunk"))?;
    let chunk_length = prost::decode_length_delimiter(&mut encoded).map_err(invalid)?;
    if encoded.len() != chunk_length {
        return Err(Status::internal("expected a reply with nothing but a chunk"));
    }
    let chunk_length = chunk_length + 1 + prost::length_delimiter_len(data_length) + data_length;
    let put_length = |length: usize, buffer: &mut BytesMut| {
        prost::encode_length_delimiter(length, buffer).map_err(|error| Status::internal(error.to_string()))
    };
    buffer.put_u8(chunk_key);
    put_length(chunk_length, buffer)?;
    buffer.put(encoded);
    buffer.put_u8(DATA_KEY);
    put_length(data_length, buffer)
}

impl<T: ChunkReply> http_body::Body for ReplyBody<T> {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        if self.frames.is_empty() && matches!(self.state, State::Streaming) {
            ready!(self.poll_messages(context));
        }
        if let Some(frame) = self.frames.pop_front() {
            return Poll::Ready(Some(Ok(Frame::data(frame))));
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

    use super::*;

    /// A chunk of a vertex stream. All of its fields are set.
    fn chunk(data: Bytes) -> v1::StreamVerticesResponse {
        let step = Some(v1::StepId { run: 1, number: 300, time: 0.5 });
        let head = Some(v1::VertexHead { step, total: 1 << 40, skipped: 7, ..Default::default() });
        let chunk = v1::VertexChunk { head, offset: 1 << 33, data, shared: None };
        v1::StreamVerticesResponse { part: Some(v1::stream_vertices_response::Part::Chunk(chunk)) }
    }

    /// The frames and the trailers of a body with these messages, which are all ready.
    async fn body_frames<T: ChunkReply + 'static>(
        messages: Vec<Result<T, Status>>,
    ) -> (Vec<Bytes>, Option<http::HeaderMap>) {
        let mut body = pin!(ReplyBody::new(Box::pin(tokio_stream::iter(messages))));
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
        async fn assert_encoding<T: ChunkReply + Clone + 'static>(reply: T) {
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
        let mut body = pin!(ReplyBody::new(Box::pin(ReceiverStream::new(receiver))));
        sender.send(Ok(chunk(Bytes::new()))).await.expect("expected an open channel");
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
