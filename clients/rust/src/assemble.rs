//! Assembles chunks into complete replies. A reply states its total size and a chunk its offset; both are checked, and
//! the total is bounded before any byte is stored.

use std::pin::Pin;
use std::task::{Context, Poll, ready};

use bytes::Bytes;
use tokio_stream::Stream;

use crate::error::{Error, Result, malformed_reply};

/// One message of a chunked reply.
pub(crate) struct Chunk<H> {
    /// Head and total size in bytes; on the first chunk only.
    pub(crate) head: Option<(H, u64)>,
    pub(crate) offset: u64,
    pub(crate) data: Bytes,
}

/// A reply message that carries a chunk.
pub(crate) trait ChunkMessage: Sized {
    type Head;
    type Reply;
    const WHAT: &'static str;
    fn into_chunk(self) -> Result<Chunk<Self::Head>>;
    fn from_chunks(head: Self::Head, bytes: Bytes) -> Result<Self::Reply>;
}

/// Collects the chunks of consecutive replies.
pub(crate) struct Assembler<H> {
    what: &'static str,
    limit: u64,
    open: Option<(H, u64)>,
    bytes: Vec<u8>,
}

impl<H> Assembler<H> {
    pub(crate) const fn new(what: &'static str, limit: u64) -> Self {
        Self { what, limit, open: None, bytes: Vec::new() }
    }

    /// Whether a reply has begun and not ended.
    pub(crate) const fn is_open(&self) -> bool {
        self.open.is_some()
    }

    /// Adds a chunk. Returns the complete reply after its last chunk.
    pub(crate) fn push(&mut self, piece: Chunk<H>) -> Result<Option<(H, Bytes)>> {
        let field = |name: &str| format!("{}.{name}", self.what);
        match (piece.head, self.open.is_some()) {
            (Some((_, total)), false) if total > self.limit => {
                return Err(malformed_reply(field("total"), format!("at most {} bytes", self.limit), total));
            }
            (Some(head), false) => self.open = Some(head),
            (None, true) => {}
            (Some(_), true) => return Err(malformed_reply(field("head"), "the rest of the last reply", "a new head")),
            (None, false) => return Err(malformed_reply(field("head"), "a head on the first chunk", "none")),
        }
        let Some((_, total)) = &self.open else { return Ok(None) };
        let (total, kept) = (*total, self.bytes.len() as u64);
        if piece.offset != kept {
            return Err(malformed_reply(field("offset"), kept, piece.offset));
        }
        let end = kept.saturating_add(piece.data.len() as u64);
        if end > total {
            return Err(malformed_reply(field("data"), format!("{total} bytes in all"), end));
        }
        if end < total {
            self.bytes.extend_from_slice(&piece.data);
            return Ok(None);
        }
        Ok(self.close(piece.data))
    }

    /// Completes the reply. A reply of a single chunk is returned without a copy.
    fn close(&mut self, last: Bytes) -> Option<(H, Bytes)> {
        let (head, _) = self.open.take()?;
        if self.bytes.is_empty() {
            return Some((head, last));
        }
        let mut bytes = std::mem::take(&mut self.bytes);
        bytes.extend_from_slice(&last);
        Some((head, bytes.into()))
    }
}

/// Turns a server stream of chunks into a stream of complete replies. An error ends the stream.
pub(crate) struct ChunkedReplies<M: ChunkMessage> {
    inner: tonic::Streaming<M>,
    assembler: Assembler<M::Head>,
    ended: bool,
}

impl<M: ChunkMessage> ChunkedReplies<M> {
    pub(crate) const fn new(inner: tonic::Streaming<M>, limit: u64) -> Self {
        Self { inner, assembler: Assembler::new(M::WHAT, limit), ended: false }
    }

    /// Polls for the next complete reply.
    pub(crate) fn poll(&mut self, context: &mut Context<'_>) -> Poll<Option<Result<M::Reply>>> {
        while !self.ended {
            let whole = match ready!(Pin::new(&mut self.inner).poll_next(context)) {
                Some(Ok(message)) => self.accept(message),
                Some(Err(status)) => Err(status.into()),
                None if self.assembler.is_open() => Err(Error::StreamEnded { what: "the last chunk of a reply" }),
                None => {
                    self.ended = true;
                    return Poll::Ready(None);
                }
            };
            self.ended = whole.is_err();
            if let Some(whole) = whole.transpose() {
                return Poll::Ready(Some(whole));
            }
        }
        Poll::Ready(None)
    }

    /// The next complete reply.
    pub(crate) async fn next(&mut self) -> Option<Result<M::Reply>> {
        std::future::poll_fn(|context| self.poll(context)).await
    }

    fn accept(&mut self, message: M) -> Result<Option<M::Reply>> {
        match self.assembler.push(message.into_chunk()?)? {
            Some((head, bytes)) => M::from_chunks(head, bytes).map(Some),
            None => Ok(None),
        }
    }
}

/// Decodes little-endian f32 at any alignment.
pub(crate) fn floats(bytes: &[u8]) -> Vec<f32> {
    bytes.chunks_exact(4).map(|word| f32::from_le_bytes([word[0], word[1], word[2], word[3]])).collect()
}

/// Decodes little-endian u32 at any alignment.
pub(crate) fn words(bytes: &[u8]) -> Vec<u32> {
    bytes.chunks_exact(4).map(|word| u32::from_le_bytes([word[0], word[1], word[2], word[3]])).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn piece(head: Option<u64>, offset: u64, data: &'static [u8]) -> Chunk<()> {
        Chunk { head: head.map(|total| ((), total)), offset, data: Bytes::from_static(data) }
    }

    fn all(pieces: Vec<Chunk<()>>) -> Result<Vec<Bytes>> {
        let mut assembler = Assembler::new("frame", 8);
        let mut whole = vec![];
        for piece in pieces {
            whole.extend(assembler.push(piece)?.map(|((), bytes)| bytes));
        }
        if assembler.is_open() { Err(Error::StreamEnded { what: "chunk" }) } else { Ok(whole) }
    }

    #[test]
    fn chunks_become_replies_in_order() {
        let whole = all(vec![
            piece(Some(5), 0, b"ab"),
            piece(None, 2, b""),
            piece(None, 2, b"cde"),
            piece(Some(0), 0, b""),
            piece(Some(2), 0, b"fg"),
        ]);
        assert_eq!(whole.expect("fits"), [&b"abcde"[..], b"", b"fg"]);
    }

    #[test]
    fn wrong_chunks_are_refused_by_field() {
        for (pieces, field) in [
            (vec![piece(Some(9), 0, b"")], "frame.total"),
            (vec![piece(Some(u64::MAX), 0, b"")], "frame.total"),
            (vec![piece(Some(4), 1, b"ab")], "frame.offset"),
            (vec![piece(Some(4), 0, b"ab"), piece(None, 3, b"c")], "frame.offset"),
            (vec![piece(Some(4), 0, b"ab"), piece(None, 2, b"cde")], "frame.data"),
            (vec![piece(None, 0, b"ab")], "frame.head"),
            (vec![piece(Some(4), 0, b"ab"), piece(Some(4), 0, b"ab")], "frame.head"),
            (vec![piece(Some(4), 0, b"ab")], "the stream ended"),
        ] {
            let refusal = all(pieces).expect_err("wrong").to_string();
            assert!(refusal.contains(field), "{refusal} does not name {field}");
        }
    }

    #[test]
    fn numbers_are_read_at_any_alignment() {
        let mut bytes = vec![0];
        bytes.extend(1.5_f32.to_le_bytes());
        bytes.extend((-2.0_f32).to_le_bytes());
        assert_eq!(floats(&bytes[1..]), [1.5, -2.0]);
        assert_eq!(words(&7_u32.to_le_bytes()), [7]);
    }
}
