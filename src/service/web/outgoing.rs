//! Writes the messages of all calls of a connection.

use std::sync::atomic::{AtomicUsize, Ordering};

use bytes::{Bytes, BytesMut};
use futures_util::{Sink, SinkExt as _};
use tokio::sync::{OwnedSemaphorePermit, mpsc};
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::tungstenite::error::Error as WebSocketError;
use tokio_tungstenite::tungstenite::protocol::frame::Frame;
use tokio_tungstenite::tungstenite::protocol::frame::coding::{Data, OpCode};

use super::envelope::{ENVELOPE_BYTES, ServerKind, server_envelope};

/// Largest payload of a WebSocket frame. A message has as many frames as it needs. The library copies each frame into
/// its buffer, which therefore remains small.
const MAX_FRAME_BYTES: usize = 64 << 10;

/// Pieces below this size are collected in one frame. Copying fewer bytes costs less than a further frame.
const MIN_PIECE_FRAME: usize = 16 << 10;

/// Messages are flushed together until they have this size.
const MAX_BATCH_BYTES: usize = 64 << 10;

/// Messages to the client.
pub(super) enum Outgoing {
    Message(OutgoingMessage),
    Ping,
    Pong(Bytes),
}

/// A message of a call.
pub(super) struct OutgoingMessage {
    pub(super) id: u32,
    pub(super) kind: ServerKind,
    /// The payload in pieces. Bytes of replies count against the reply budget until they are dropped.
    pub(super) pieces: Vec<Bytes>,
    /// Returned when the message is written.
    pub(super) _in_flight: Option<OwnedSemaphorePermit>,
}

impl OutgoingMessage {
    fn payload_bytes(&self) -> usize {
        self.pieces.iter().map(Bytes::len).sum()
    }

    /// The payloads of the frames of this message.
    fn frame_payloads(&self) -> Vec<Bytes> {
        let mut payloads = Vec::new();
        let mut collected = BytesMut::with_capacity(ENVELOPE_BYTES + MIN_PIECE_FRAME.min(self.payload_bytes()));
        collected.extend_from_slice(&server_envelope(self.id, self.kind));
        for piece in &self.pieces {
            if piece.len() < MIN_PIECE_FRAME && collected.len() + piece.len() <= MAX_FRAME_BYTES {
                collected.extend_from_slice(piece);
                continue;
            }
            if !collected.is_empty() {
                payloads.push(collected.split().freeze());
            }
            let starts = (0..piece.len()).step_by(MAX_FRAME_BYTES);
            payloads.extend(starts.map(|start| piece.slice(start..piece.len().min(start + MAX_FRAME_BYTES))));
        }
        if !collected.is_empty() {
            payloads.push(collected.freeze());
        }
        payloads
    }
}

/// Writes messages until the queue is closed, and adds the bytes of their payloads to `sent_bytes`. A message is
/// dropped when it is written to the socket.
pub(super) async fn write_messages<S>(
    sink: &mut S,
    queue: &mut mpsc::Receiver<Outgoing>,
    sent_bytes: &AtomicUsize,
) -> Result<(), WebSocketError>
where
    S: Sink<Message, Error = WebSocketError> + Unpin,
{
    let mut unflushed = Vec::new();
    while let Some(first) = queue.recv().await {
        let (mut next, mut batch_bytes) = (Some(first), 0);
        while let Some(outgoing) = next {
            match outgoing {
                Outgoing::Ping => sink.feed(Message::Ping(Bytes::new())).await?,
                Outgoing::Pong(payload) => sink.feed(Message::Frame(Frame::pong(payload))).await?,
                Outgoing::Message(message) => {
                    feed_frames(sink, message.frame_payloads()).await?;
                    batch_bytes += message.payload_bytes();
                    unflushed.push(message);
                }
            }
            next = if batch_bytes < MAX_BATCH_BYTES { queue.try_recv().ok() } else { None };
        }
        sink.flush().await?;
        sent_bytes.fetch_add(batch_bytes, Ordering::Relaxed);
        unflushed.clear();
    }
    Ok(())
}

async fn feed_frames<S>(sink: &mut S, payloads: Vec<Bytes>) -> Result<(), WebSocketError>
where
    S: Sink<Message, Error = WebSocketError> + Unpin,
{
    let last = payloads.len().saturating_sub(1);
    for (index, payload) in payloads.into_iter().enumerate() {
        let opcode = if index == 0 { Data::Binary } else { Data::Continue };
        let frame = Frame::message(payload, OpCode::Data(opcode), index == last);
        sink.feed(Message::Frame(frame)).await?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn message(pieces: Vec<Bytes>) -> OutgoingMessage {
        OutgoingMessage { id: 9, kind: ServerKind::Message, pieces, _in_flight: None }
    }

    #[test]
    fn small_messages_are_one_frame_and_large_pieces_are_not_copied() {
        let envelope = server_envelope(9, ServerKind::Message).to_vec();
        let small = message(vec![Bytes::from_static(b"ab"), Bytes::new(), Bytes::from_static(b"cd")]);
        assert_eq!(small.frame_payloads(), [[&envelope[..], b"abcd"].concat()]);
        assert_eq!(message(Vec::new()).frame_payloads().concat(), envelope);

        let large = Bytes::from((0..200_000_u32).map(|index| index as u8).collect::<Vec<_>>());
        let pieces = vec![Bytes::from_static(b"head"), large.clone(), Bytes::from_static(b"tail")];
        let payloads = message(pieces.clone()).frame_payloads();
        assert!(payloads.iter().all(|payload| payload.len() <= MAX_FRAME_BYTES));
        assert_eq!(payloads.concat(), [envelope, pieces.concat()].concat());
        assert_eq!(payloads[1].as_ptr(), large.as_ptr());
        // Many small pieces do not become one large frame.
        let payloads = message(vec![Bytes::from(vec![1; 10_000]); 30]).frame_payloads();
        assert!(payloads.iter().all(|payload| payload.len() <= MAX_FRAME_BYTES));
    }
}
