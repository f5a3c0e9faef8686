//! Reads the messages and the status of a gRPC response from its body, without copying the messages.

use std::collections::VecDeque;
use std::pin::Pin;

use bytes::{Buf as _, Bytes};
use http_body::Body as _;
use tonic::Status;
use tonic::body::Body;
use tonic::codegen::http::Response;

use super::super::status::internal_fault;

/// Size of the prefix of a gRPC message: a flag (0: not compressed) and the length of the message as u32.
const PREFIX_BYTES: usize = 5;

/// The messages of a response.
pub(super) struct ReplyMessages {
    body: Body,
    /// Received data that were not returned as messages.
    data: PieceQueue,
    /// The status in the head of a response without messages, or in the trailers.
    status: Option<Status>,
    is_at_end: bool,
}

/// What a response contains next.
#[derive(Debug)]
pub(super) enum Reply {
    /// An encoded protobuf message, in pieces.
    Message(Vec<Bytes>),
    /// The end of the call.
    End(Status),
}

impl ReplyMessages {
    pub(super) fn new(response: Response<Body>) -> Self {
        let status = Status::from_header_map(response.headers());
        let is_at_end = status.is_some();
        Self { body: response.into_body(), data: PieceQueue::default(), status, is_at_end }
    }

    /// Waits for the next message or the end. Cancel-safe.
    pub(super) async fn next(&mut self) -> Reply {
        loop {
            match self.data.take_message() {
                Ok(Some(pieces)) => return Reply::Message(pieces),
                Ok(None) if self.is_at_end => return Reply::End(self.take_status()),
                Ok(None) => {}
                Err(status) => return Reply::End(status),
            }
            match std::future::poll_fn(|cx| Pin::new(&mut self.body).poll_frame(cx)).await {
                Some(Ok(frame)) => match frame.into_data() {
                    Ok(data) => self.data.push(data),
                    Err(frame) => {
                        let trailers = frame.into_trailers().unwrap_or_default();
                        self.status = Status::from_header_map(&trailers);
                        self.is_at_end = true;
                    }
                },
                Some(Err(status)) => return Reply::End(status),
                None => self.is_at_end = true,
            }
        }
    }

    fn take_status(&mut self) -> Status {
        let status = self.status.take();
        match status {
            Some(status) if self.data.bytes == 0 => status,
            _ => internal_fault("expected complete messages and a status, got the end of the reply"),
        }
    }
}

/// A sequence of bytes in pieces.
#[derive(Debug, Default)]
struct PieceQueue {
    pieces: VecDeque<Bytes>,
    bytes: usize,
    /// Length of the message whose prefix was removed.
    message_bytes: Option<usize>,
}

impl PieceQueue {
    fn push(&mut self, piece: Bytes) {
        self.bytes += piece.len();
        self.pieces.push_back(piece);
    }

    /// Removes the next message if it is complete.
    fn take_message(&mut self) -> Result<Option<Vec<Bytes>>, Status> {
        if self.message_bytes.is_none() && self.bytes >= PREFIX_BYTES {
            let mut prefix = [0; PREFIX_BYTES];
            let mut filled = 0;
            for piece in self.take(PREFIX_BYTES) {
                prefix[filled..][..piece.len()].copy_from_slice(&piece);
                filled += piece.len();
            }
            let [flag, length @ ..] = prefix;
            if flag != 0 {
                return Err(internal_fault("expected a message without compression"));
            }
            self.message_bytes = Some(u32::from_be_bytes(length) as usize);
        }
        let Some(message_bytes) = self.message_bytes.filter(|length| self.bytes >= *length) else { return Ok(None) };
        self.message_bytes = None;
        Ok(Some(self.take(message_bytes)))
    }

    /// Removes `bytes` bytes from the front. The queue must contain at least as many.
    fn take(&mut self, bytes: usize) -> Vec<Bytes> {
        self.bytes -= bytes;
        let (mut taken, mut missing) = (Vec::new(), bytes);
        while missing > 0 {
            let Some(piece) = self.pieces.front_mut() else { break };
            let length = missing.min(piece.len());
            if length > 0 {
                taken.push(piece.split_to(length));
            }
            missing -= length;
            if !piece.has_remaining() {
                self.pieces.pop_front();
            }
        }
        taken
    }
}

#[cfg(test)]
mod tests {
    use std::task::{Context, Poll};

    use http_body::Frame;
    use tonic::codegen::http::HeaderMap;

    use super::*;

    /// A body of these frames.
    struct Frames(VecDeque<Frame<Bytes>>);

    impl http_body::Body for Frames {
        type Data = Bytes;
        type Error = Status;

        fn poll_frame(mut self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
            Poll::Ready(self.0.pop_front().map(Ok))
        }
    }

    fn trailers(status: &Status) -> Frame<Bytes> {
        let mut headers = HeaderMap::new();
        status.add_header(&mut headers).expect("expected a valid status");
        Frame::trailers(headers)
    }

    fn encode(message: &[u8]) -> Vec<u8> {
        [&[0], &(message.len() as u32).to_be_bytes()[..], message].concat()
    }

    async fn read(frames: Vec<Frame<Bytes>>) -> (Vec<Vec<u8>>, Status) {
        let mut replies = ReplyMessages::new(Response::new(Body::new(Frames(frames.into()))));
        let mut messages = Vec::new();
        loop {
            match replies.next().await {
                Reply::Message(pieces) => messages.push(pieces.concat()),
                Reply::End(status) => return (messages, status),
            }
        }
    }

    #[tokio::test]
    async fn messages_are_found_in_any_split() {
        let expected = [b"abc".to_vec(), Vec::new(), vec![7; 300]];
        let bytes = expected.iter().flat_map(|message| encode(message)).collect::<Vec<_>>();
        for part in [1, 4, 5, 6, 8, 100, bytes.len()] {
            let data = bytes.chunks(part).map(|part| Frame::data(Bytes::copy_from_slice(part)));
            let (messages, status) = read(data.chain([trailers(&Status::not_found("no scene"))]).collect()).await;
            assert_eq!(messages, expected, "{part}");
            assert_eq!((status.code(), status.message()), (tonic::Code::NotFound, "no scene"));
        }
    }

    #[tokio::test]
    async fn broken_reply_is_an_internal_error() {
        let data = |bytes: &[u8]| Frame::data(Bytes::copy_from_slice(bytes));
        let ok = || trailers(&Status::ok(""));
        for frames in [
            vec![],
            vec![data(&encode(b"abc"))],
            vec![data(&encode(b"abc")[..7]), ok()],
            vec![data(&encode(b"abc")[..3]), ok()],
            vec![data(&[1, 0, 0, 0, 0]), ok()],
        ] {
            let (_, status) = read(frames).await;
            assert_eq!(status.code(), tonic::Code::Internal);
        }
        assert_eq!(read(vec![ok()]).await.1.code(), tonic::Code::Ok);
    }

    #[tokio::test]
    async fn response_without_messages_has_its_status_in_the_head() {
        let response = Status::with_details(tonic::Code::NotFound, "no", Bytes::from_static(b"details")).into_http();
        match ReplyMessages::new(response).next().await {
            Reply::End(status) => assert_eq!(status.details(), b"details"),
            other => panic!("expected the end, got {other:?}"),
        }
    }

    #[tokio::test]
    async fn large_messages_are_not_copied() {
        let large = Bytes::from(vec![1; 1 << 20]);
        let prefix = Bytes::from([&[0][..], &(large.len() as u32).to_be_bytes()].concat());
        let frames = VecDeque::from([Frame::data(prefix), Frame::data(large.clone())]);
        let mut replies = ReplyMessages::new(Response::new(Body::new(Frames(frames))));
        let Reply::Message(pieces) = replies.next().await else { panic!("expected a message") };
        assert_eq!(pieces[0].as_ptr(), large.as_ptr());
    }
}
