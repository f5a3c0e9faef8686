//! Decodes the messages of a reply from the frames of its body. tonic copies all frames into one buffer before it
//! decodes them. Here, the bytes of a message refer to the memory of its frame.
//!
//! The generated clients send the request and check the head of the response. [`UndecodedChannel`] hides the body from
//! them, and [`MessageStream`] reads it.

use std::collections::VecDeque;
use std::marker::PhantomData;
use std::pin::Pin;
use std::sync::{Arc, Mutex, PoisonError};
use std::task::{Context, Poll, ready};

use bytes::{Buf, BufMut as _, Bytes, BytesMut};
use prost::Message;
use tonic::body::Body;
use tonic::codegen::http::{HeaderMap, Request, Response, StatusCode};
use tonic::codegen::{Body as _, BoxFuture, Service};
use tonic::{Status, Streaming};

use crate::server_channel::ServerChannel;

/// Size of the prefix of a message: a flag (0: not compressed) and the length of the message as u32.
const PREFIX_BYTES: usize = 5;

/// Largest message that is accepted, in bytes. The largest ones of the server are chunks of 1 MiB and layouts.
const MAX_MESSAGE_BYTES: usize = 4 << 20;

/// A connection for generated clients whose replies are read by a [`MessageStream`].
#[derive(Debug, Clone)]
pub(crate) struct UndecodedChannel(pub(crate) ServerChannel);

impl Service<Request<Body>> for UndecodedChannel {
    type Response = Response<Body>;
    type Error = tonic::transport::Error;
    type Future = BoxFuture<Response<Body>, tonic::transport::Error>;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), Self::Error>> {
        self.0.poll_ready(context)
    }

    fn call(&mut self, request: Request<Body>) -> Self::Future {
        let call = self.0.call(request);
        Box::pin(async move {
            let (mut head, body) = call.await?.into_parts();
            let status_without_trailers = Status::from_header_map(&head.headers).unwrap_or_else(|| {
                Status::new(code_of_http(head.status), format!("no gRPC status; HTTP {}", head.status))
            });
            let undecoded = UndecodedBody { body, status_without_trailers };
            head.extensions.insert(DetachedBody(Arc::new(Mutex::new(Some(undecoded)))));
            Ok(Response::from_parts(head, Body::empty()))
        })
    }
}

/// The code of a response without a gRPC status, as gRPC maps codes of HTTP
/// (<https://grpc.github.io/grpc/core/md_doc_http-grpc-status-mapping.html>).
fn code_of_http(status: StatusCode) -> tonic::Code {
    match status {
        StatusCode::BAD_REQUEST => tonic::Code::Internal,
        StatusCode::UNAUTHORIZED => tonic::Code::Unauthenticated,
        StatusCode::FORBIDDEN => tonic::Code::PermissionDenied,
        StatusCode::NOT_FOUND => tonic::Code::Unimplemented,
        StatusCode::TOO_MANY_REQUESTS
        | StatusCode::BAD_GATEWAY
        | StatusCode::SERVICE_UNAVAILABLE
        | StatusCode::GATEWAY_TIMEOUT => tonic::Code::Unavailable,
        _ => tonic::Code::Unknown,
    }
}

/// A body in the extensions of a response, which must be `Clone` and `Sync`.
#[derive(Clone)]
struct DetachedBody(Arc<Mutex<Option<UndecodedBody>>>);

struct UndecodedBody {
    body: Body,
    /// The status of the call if the body ends without trailers.
    status_without_trailers: Status,
}

/// The messages of a reply.
pub(crate) struct MessageStream<M> {
    source: UndecodedBody,
    frames: FrameBuffer,
    /// Size of the next message; `None` until its prefix was read.
    message_bytes: Option<usize>,
    has_ended: bool,
    decoded: PhantomData<fn() -> M>,
}

impl<M: Message + Default> MessageStream<M> {
    /// Reads the body of a response that came through an [`UndecodedChannel`]; `None` for any other response.
    pub(crate) fn of_response(mut response: tonic::Response<Streaming<M>>) -> Option<Self> {
        let DetachedBody(source) = response.extensions_mut().remove()?;
        let source = source.lock().unwrap_or_else(PoisonError::into_inner).take()?;
        Some(Self::new(source))
    }

    fn new(source: UndecodedBody) -> Self {
        Self { source, frames: FrameBuffer::default(), message_bytes: None, has_ended: false, decoded: PhantomData }
    }

    /// Polls for the next message; `None` at the end of the stream. An error ends the stream.
    pub(crate) fn poll_next(&mut self, context: &mut Context<'_>) -> Poll<Option<Result<M, Status>>> {
        while !self.has_ended {
            let message = match self.decode().transpose() {
                None => ready!(self.poll_frame(context)).err().map(Err),
                message => message,
            };
            self.has_ended |= matches!(message, Some(Err(_)));
            if let Some(message) = message {
                return Poll::Ready(Some(message));
            }
        }
        Poll::Ready(None)
    }

    /// Receives a frame, or ends the stream with the status of the call.
    fn poll_frame(&mut self, context: &mut Context<'_>) -> Poll<Result<(), Status>> {
        let frame = ready!(Pin::new(&mut self.source.body).poll_frame(context)).transpose()?;
        Poll::Ready(match frame.map(|frame| frame.into_data()) {
            Some(Ok(data)) => {
                self.frames.push(data);
                Ok(())
            }
            Some(Err(frame)) => self.end(frame.into_trailers().ok().as_ref()),
            None => self.end(None),
        })
    }

    fn end(&mut self, trailers: Option<&HeaderMap>) -> Result<(), Status> {
        self.has_ended = true;
        let without_trailers = || self.source.status_without_trailers.clone();
        let status = trailers.and_then(Status::from_header_map).unwrap_or_else(without_trailers);
        match status.code() {
            tonic::Code::Ok if self.frames.has_remaining() || self.message_bytes.is_some() => {
                Err(Status::internal("the reply ended within a message"))
            }
            tonic::Code::Ok => Ok(()),
            _ => Err(status),
        }
    }

    /// Decodes a message; `None` until all of its frames were received.
    fn decode(&mut self) -> Result<Option<M>, Status> {
        let message_bytes = match self.message_bytes {
            Some(message_bytes) => message_bytes,
            None if self.frames.remaining() < PREFIX_BYTES => return Ok(None),
            None => {
                let (flag, length) = (self.frames.get_u8(), self.frames.get_u32() as usize);
                if flag != 0 {
                    return Err(Status::internal(format!("expected a message without compression, got flag {flag}")));
                }
                if length > MAX_MESSAGE_BYTES {
                    let expected = format!("expected a message of at most {MAX_MESSAGE_BYTES} bytes");
                    return Err(Status::out_of_range(format!("{expected}, got {length}")));
                }
                *self.message_bytes.insert(length)
            }
        };
        if self.frames.remaining() < message_bytes {
            return Ok(None);
        }
        self.message_bytes = None;
        let message = M::decode((&mut self.frames).take(message_bytes));
        message.map(Some).map_err(|error| Status::internal(error.to_string()))
    }
}

/// Received frames that were not decoded yet, the oldest first.
#[derive(Debug, Default)]
struct FrameBuffer {
    /// None of them is empty.
    frames: VecDeque<Bytes>,
    bytes: usize,
}

impl FrameBuffer {
    fn push(&mut self, frame: Bytes) {
        if !frame.is_empty() {
            self.bytes += frame.len();
            self.frames.push_back(frame);
        }
    }
}

impl Buf for FrameBuffer {
    fn remaining(&self) -> usize {
        self.bytes
    }

    fn chunk(&self) -> &[u8] {
        self.frames.front().map_or(&[], |frame| frame)
    }

    fn advance(&mut self, mut count: usize) {
        self.bytes -= count;
        while count > 0 {
            let Some(frame) = self.frames.front_mut() else { return };
            if frame.len() > count {
                frame.advance(count);
                return;
            }
            count -= frame.len();
            self.frames.pop_front();
        }
    }

    /// Without a copy unless the bytes belong to several frames.
    fn copy_to_bytes(&mut self, length: usize) -> Bytes {
        let Some(frame) = self.frames.front_mut().filter(|frame| frame.len() >= length) else {
            let mut bytes = BytesMut::with_capacity(length);
            bytes.put(self.take(length));
            return bytes.freeze();
        };
        self.bytes -= length;
        let bytes = frame.split_to(length);
        if frame.is_empty() {
            self.frames.pop_front();
        }
        bytes
    }
}

#[cfg(test)]
mod tests {
    use std::future::poll_fn;

    use modalcast_proto::v1;

    use super::*;

    /// A body with these frames, and with trailers if `status` is given.
    struct FakeBody {
        frames: VecDeque<Bytes>,
        status: Option<Status>,
    }

    impl tonic::codegen::Body for FakeBody {
        type Data = Bytes;
        type Error = Status;

        fn poll_frame(
            mut self: Pin<&mut Self>,
            _: &mut Context<'_>,
        ) -> Poll<Option<Result<http_body::Frame<Bytes>, Status>>> {
            if let Some(frame) = self.frames.pop_front() {
                return Poll::Ready(Some(Ok(http_body::Frame::data(frame))));
            }
            Poll::Ready(self.status.take().map(|status| {
                let mut trailers = HeaderMap::new();
                status.add_header(&mut trailers).map(|()| http_body::Frame::trailers(trailers))
            }))
        }
    }

    fn source(frames: Vec<Bytes>, status: Option<Status>, status_without_trailers: Status) -> UndecodedBody {
        UndecodedBody { body: Body::new(FakeBody { frames: frames.into(), status }), status_without_trailers }
    }

    fn prefixed(message: &impl Message) -> Vec<u8> {
        let message = message.encode_to_vec();
        [&[0], &(message.len() as u32).to_be_bytes()[..], &message].concat()
    }

    fn chunk(offset: u64, data: &[u8]) -> v1::VertexChunk {
        v1::VertexChunk { head: None, offset, data: Bytes::copy_from_slice(data), shared: None }
    }

    /// All messages up to the end or the first error.
    async fn receive(source: UndecodedBody) -> (Vec<v1::VertexChunk>, Option<Status>) {
        let mut stream = MessageStream::<v1::VertexChunk>::new(source);
        let mut messages = Vec::new();
        while let Some(message) = poll_fn(|context| stream.poll_next(context)).await {
            match message {
                Ok(message) => messages.push(message),
                Err(status) => {
                    assert!(poll_fn(|context| stream.poll_next(context)).await.is_none());
                    return (messages, Some(status));
                }
            }
        }
        (messages, None)
    }

    #[tokio::test]
    async fn messages_are_decoded_from_frames_of_any_size() {
        let messages = [chunk(7, &[1; 300]), chunk(0, b""), chunk(1 << 40, &[2; 2])];
        let bytes: Vec<u8> = messages.iter().flat_map(prefixed).collect();
        for frame_bytes in 1..=bytes.len() {
            let frames = bytes.chunks(frame_bytes).map(Bytes::copy_from_slice);
            let frames = frames.chain([Bytes::new()]).collect();
            let (received, error) = receive(source(frames, Some(Status::ok("")), Status::unknown("none"))).await;
            assert_eq!(received, messages, "frames of {frame_bytes} bytes");
            assert!(error.is_none(), "frames of {frame_bytes} bytes: {error:?}");
        }
    }

    #[tokio::test]
    async fn data_refer_to_the_memory_of_their_frame() {
        let bytes = Bytes::from(prefixed(&chunk(9, &[3; 1000])));
        let (head, data) = (bytes.slice(..bytes.len() - 1000), bytes.slice(bytes.len() - 1000..));
        for frames in [vec![bytes.clone()], vec![head, data.clone()]] {
            let (received, _) = receive(source(frames, Some(Status::ok("")), Status::unknown("none"))).await;
            assert_eq!(received[0].data.as_ptr(), data.as_ptr());
        }
        // Control: data of two frames are copied.
        let frames = vec![bytes.slice(..500), bytes.slice(500..)];
        let (received, _) = receive(source(frames, Some(Status::ok("")), Status::unknown("none"))).await;
        assert_ne!(received[0].data.as_ptr(), data.as_ptr());
    }

    #[tokio::test]
    async fn status_of_the_call_ends_the_stream() {
        let message = Bytes::from(prefixed(&chunk(9, &[3; 10])));
        let failed = || Some(Status::with_details(tonic::Code::NotFound, "no scene", Bytes::from_static(b"details")));
        let (received, error) = receive(source(vec![message.clone()], failed(), Status::ok(""))).await;
        let error = error.expect("expected an error");
        assert_eq!((received.len(), error.code(), error.details()), (1, tonic::Code::NotFound, &b"details"[..]));
        // The status of the head holds if there are no trailers.
        let (_, error) = receive(source(vec![], None, Status::ok(""))).await;
        assert!(error.is_none());
        let no_status = Status::new(code_of_http(StatusCode::BAD_GATEWAY), "HTTP 502");
        let (_, error) = receive(source(vec![], None, no_status)).await;
        assert_eq!(error.expect("expected an error").code(), tonic::Code::Unavailable);
        assert_eq!(code_of_http(StatusCode::OK), tonic::Code::Unknown);
    }

    #[tokio::test]
    async fn malformed_messages_are_errors() {
        let message = Bytes::from(prefixed(&chunk(9, &[3; 10])));
        for (bytes, code) in [
            (message.slice(..message.len() - 1), tonic::Code::Internal),
            (message.slice(..3), tonic::Code::Internal),
            (Bytes::from_static(&[0, 0, 0, 0, 1]), tonic::Code::Internal),
            (Bytes::from_static(&[1, 0, 0, 0, 0]), tonic::Code::Internal),
            (Bytes::from_static(&[0, 0xff, 0xff, 0xff, 0xff]), tonic::Code::OutOfRange),
            // A key without its value.
            (Bytes::from_static(&[0, 0, 0, 0, 1, 0x10]), tonic::Code::Internal),
        ] {
            let (received, error) = receive(source(vec![bytes.clone()], Some(Status::ok("")), Status::ok(""))).await;
            assert!(received.is_empty());
            assert_eq!(error.expect("expected an error").code(), code, "{bytes:?}");
        }
    }
}
