//! Assembles chunks into complete replies. The first chunk states the total size of the reply, and each chunk its
//! offset. The total and the offsets are checked. A total above the limit is an error before any byte is stored.

use std::future::poll_fn;
use std::sync::Arc;
use std::task::{Context, Poll, ready};

use bytemuck::Pod;
use bytes::Bytes;
use prost::Message;

use crate::error::{Error, Result, malformed_reply};
use crate::message_stream::MessageStream;
use crate::shared_memory::CallMemory;

// Numbers are little-endian on the wire and are copied without conversion.
const _: () = assert!(cfg!(target_endian = "little"), "the client supports little-endian hosts only");

/// Decodes an array of little-endian numbers, or of fixed-size arrays of them, at any alignment.
///
/// # Errors
/// `Malformed` unless the length is a multiple of the size of `T`.
pub(crate) fn decode<T: Pod>(field: &str, bytes: &[u8]) -> Result<Vec<T>> {
    let size = size_of::<T>();
    if !bytes.len().is_multiple_of(size) {
        return Err(malformed_reply(field, format!("a multiple of {size} bytes"), bytes.len()));
    }
    Ok(bytemuck::pod_collect_to_vec(bytes))
}

/// The messages of a server stream; dropping it cancels the call. An error contains the server's URL.
pub struct Replies<M> {
    messages: MessageStream<M>,
    url: Arc<str>,
}

impl<M: Message + Default> Replies<M> {
    pub(crate) const fn new(messages: MessageStream<M>, url: Arc<str>) -> Self {
        Self { messages, url }
    }

    /// The next message, or `None` at the end of the stream. A call that is canceled before it returns loses no
    /// message.
    ///
    /// # Errors
    /// `Status` with which the server has ended the stream; `Connect` if the connection is lost.
    pub async fn next(&mut self) -> Result<Option<M>> {
        poll_fn(|context| self.poll(context)).await.transpose()
    }

    fn poll(&mut self, context: &mut Context<'_>) -> Poll<Option<Result<M>>> {
        let message = ready!(self.messages.poll_next(context));
        Poll::Ready(message.map(|message| message.map_err(|status| Error::from_status(status, &self.url))))
    }
}

/// One message of a chunked reply.
pub(crate) struct Chunk<H> {
    /// Head and total size in bytes; on the first chunk only.
    pub(crate) head: Option<(H, u64)>,
    pub(crate) offset: u64,
    pub(crate) data: Bytes,
}

impl<H> Chunk<H> {
    /// A chunk whose head, if it has one, states the total size.
    pub(crate) fn new(head: Option<H>, total_bytes: fn(&H) -> u64, offset: u64, data: Bytes) -> Self {
        let head = head.map(|head| {
            let total = total_bytes(&head);
            (head, total)
        });
        Self { head, offset, data }
    }
}

/// A chunk in its wire format. The first chunk of a reply has a `Head`, and all its chunks together form a `Reply`.
pub(crate) trait WireChunk: Sized {
    type Head;
    type Reply;
    /// Name of the reply in errors.
    const NAME: &'static str;
    /// `memory` contains the data of a chunk that was sent in shared memory.
    fn into_chunk(self, memory: &CallMemory) -> Result<Chunk<Self::Head>>;
    fn decode_reply(head: Self::Head, bytes: Bytes) -> Result<Self::Reply>;
}

/// Checks that the chunks of consecutive replies follow each other without gaps.
pub(crate) struct ChunkSequence<H> {
    /// Name of the reply in errors.
    name: &'static str,
    /// Maximum size of a reply in bytes.
    limit: u64,
    /// The reply whose last chunk has not been added.
    open_reply: Option<OpenReply<H>>,
}

/// A reply that has begun.
pub(crate) struct OpenReply<H> {
    pub(crate) head: H,
    /// Size of the reply in bytes.
    pub(crate) total: u64,
    received: u64,
}

impl<H> OpenReply<H> {
    /// Whether all bytes were received.
    const fn is_complete(&self) -> bool {
        self.received == self.total
    }
}

impl<H> ChunkSequence<H> {
    pub(crate) const fn new(name: &'static str, limit: u64) -> Self {
        Self { name, limit, open_reply: None }
    }

    /// Whether a reply has begun and not ended.
    pub(crate) const fn is_open(&self) -> bool {
        self.open_reply.is_some()
    }

    /// Adds a chunk, and returns its data. A chunk with a head begins a reply; `begin` is then called first.
    pub(crate) fn add(&mut self, chunk: Chunk<H>, begin: impl FnOnce(&OpenReply<H>) -> Result<()>) -> Result<Bytes> {
        let field = |name: &str| format!("{}.{name}", self.name);
        let begins = chunk.head.is_some();
        match (chunk.head, self.open_reply.is_some()) {
            (Some((_, total)), false) if total > self.limit => {
                return Err(malformed_reply(field("total"), format!("at most {} bytes", self.limit), total));
            }
            (Some((head, total)), false) => self.open_reply = Some(OpenReply { head, total, received: 0 }),
            (None, true) => {}
            (Some(_), true) => {
                return Err(malformed_reply(field("head"), "the next chunk of the open reply", "a new head"));
            }
            (None, false) => return Err(malformed_reply(field("head"), "a head on the first chunk", "none")),
        }
        let Some(reply) = &mut self.open_reply else { return Ok(Bytes::new()) };
        if chunk.offset != reply.received {
            return Err(malformed_reply(field("offset"), reply.received, chunk.offset));
        }
        let end = reply.received.saturating_add(chunk.data.len() as u64);
        if end > reply.total {
            return Err(malformed_reply(field("data"), format!("at most {} bytes", reply.total), end));
        }
        if begins {
            begin(reply)?;
        }
        reply.received = end;
        Ok(chunk.data)
    }

    /// Ends the open reply if it is complete, and returns its head.
    pub(crate) fn end_reply(&mut self) -> Option<H> {
        self.open_reply.take_if(|reply| reply.is_complete()).map(|reply| reply.head)
    }
}

/// Collects the chunks of consecutive replies.
pub(crate) struct Assembler<H> {
    chunks: ChunkSequence<H>,
    bytes: Vec<u8>,
}

impl<H> Assembler<H> {
    pub(crate) const fn new(name: &'static str, limit: u64) -> Self {
        Self { chunks: ChunkSequence::new(name, limit), bytes: Vec::new() }
    }

    /// Whether a reply has begun and not ended.
    pub(crate) const fn is_open(&self) -> bool {
        self.chunks.is_open()
    }

    /// Adds a chunk. Returns the complete reply after its last chunk. A reply of a single chunk is returned without a
    /// copy.
    pub(crate) fn push(&mut self, chunk: Chunk<H>) -> Result<Option<(H, Bytes)>> {
        let (name, bytes, chunk_bytes) = (self.chunks.name, &mut self.bytes, chunk.data.len() as u64);
        // Memory for the whole reply. A total that this machine cannot hold is an error, not an abort.
        let reserve = |reply: &OpenReply<H>| {
            let total = if chunk_bytes < reply.total { reply.total } else { 0 };
            let reservation = usize::try_from(total).ok().and_then(|total| bytes.try_reserve_exact(total).ok());
            reservation.ok_or_else(|| malformed_reply(format!("{name}.total"), "a size that fits in memory", total))
        };
        let data = self.chunks.add(chunk, reserve)?;
        let Some(head) = self.chunks.end_reply() else {
            self.bytes.extend_from_slice(&data);
            return Ok(None);
        };
        if self.bytes.is_empty() {
            return Ok(Some((head, data)));
        }
        let mut bytes = std::mem::take(&mut self.bytes);
        bytes.extend_from_slice(&data);
        Ok(Some((head, bytes.into())))
    }
}

/// Decodes the messages `M` of a stream to replies.
pub(crate) trait ReplyDecoder<M> {
    type Reply;

    /// Adds a message. Returns the reply that it completes.
    fn add_message(&mut self, message: M) -> Result<Option<Self::Reply>>;

    /// Whether a reply has begun and not ended.
    fn is_open(&self) -> bool;

    /// Called when the stream has ended with OK after a complete reply.
    fn end(&mut self) {}
}

/// Turns a server stream of messages `M` into a stream of complete replies. An error ends the stream.
pub(crate) struct DecodedReplies<M, D> {
    messages: Replies<M>,
    decoder: D,
    has_ended: bool,
}

impl<M: Message + Default, D: ReplyDecoder<M>> DecodedReplies<M, D> {
    pub(crate) const fn new(messages: Replies<M>, decoder: D) -> Self {
        Self { messages, decoder, has_ended: false }
    }

    /// Polls for the next complete reply.
    pub(crate) fn poll(&mut self, context: &mut Context<'_>) -> Poll<Option<Result<D::Reply>>> {
        while !self.has_ended {
            let reply = match ready!(self.messages.poll(context)) {
                Some(message) => message.and_then(|message| self.decoder.add_message(message)),
                None if self.decoder.is_open() => {
                    Err(Error::StreamEnded { awaited_reply: "the last chunk of a reply" })
                }
                None => {
                    self.has_ended = true;
                    self.decoder.end();
                    return Poll::Ready(None);
                }
            };
            self.has_ended = reply.is_err();
            if let Some(reply) = reply.transpose() {
                return Poll::Ready(Some(reply));
            }
        }
        Poll::Ready(None)
    }

    /// The next complete reply.
    pub(crate) async fn next(&mut self) -> Option<Result<D::Reply>> {
        poll_fn(|context| self.poll(context)).await
    }

    /// The only reply of a call. `awaited_reply` names it in errors.
    pub(crate) async fn single(mut self, awaited_reply: &'static str) -> Result<D::Reply> {
        let reply = self.next().await.unwrap_or(Err(Error::StreamEnded { awaited_reply }))?;
        match self.next().await {
            None => Ok(reply),
            Some(Err(error)) => Err(error),
            Some(Ok(_)) => Err(malformed_reply("reply", "one reply", "another one")),
        }
    }
}

/// Decodes messages that contain one chunk `C` each.
pub(crate) struct ChunkDecoder<M, C: WireChunk> {
    /// Extracts the chunk of a message.
    chunk_of: fn(M) -> Option<C>,
    assembler: Assembler<C::Head>,
    memory: CallMemory,
}

impl<M, C: WireChunk> ChunkDecoder<M, C> {
    /// A decoder of replies of at most `limit` bytes.
    pub(crate) const fn new(chunk_of: fn(M) -> Option<C>, limit: u64, memory: CallMemory) -> Self {
        Self { chunk_of, assembler: Assembler::new(C::NAME, limit), memory }
    }
}

impl<M, C: WireChunk> ReplyDecoder<M> for ChunkDecoder<M, C> {
    type Reply = C::Reply;

    fn add_message(&mut self, message: M) -> Result<Option<C::Reply>> {
        let missing_chunk = || malformed_reply(format!("{}.chunk", C::NAME), "a chunk", "none");
        let chunk = (self.chunk_of)(message).ok_or_else(missing_chunk)?;
        match self.assembler.push(chunk.into_chunk(&self.memory)?)? {
            Some((head, bytes)) => C::decode_reply(head, bytes).map(Some),
            None => Ok(None),
        }
    }

    fn is_open(&self) -> bool {
        self.assembler.is_open()
    }

    fn end(&mut self) {
        self.memory.release();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A chunk with an empty head. `total` is `None` for all chunks of a reply but the first one.
    fn chunk(total: Option<u64>, offset: u64, data: &'static [u8]) -> Chunk<()> {
        Chunk { head: total.map(|total| ((), total)), offset, data: Bytes::from_static(data) }
    }

    /// Assembles replies of at most 8 bytes.
    fn assemble(chunks: Vec<Chunk<()>>) -> Result<Vec<Bytes>> {
        let mut assembler = Assembler::new("frame", 8);
        let mut replies = vec![];
        for chunk in chunks {
            replies.extend(assembler.push(chunk)?.map(|((), bytes)| bytes));
        }
        if assembler.is_open() { Err(Error::StreamEnded { awaited_reply: "the last chunk" }) } else { Ok(replies) }
    }

    #[test]
    fn chunks_become_replies_in_order() {
        let replies = assemble(vec![
            chunk(Some(5), 0, b"ab"),
            chunk(None, 2, b""),
            chunk(None, 2, b"cde"),
            chunk(Some(0), 0, b""),
            chunk(Some(2), 0, b"fg"),
        ]);
        assert_eq!(replies.expect("valid chunks"), [&b"abcde"[..], b"", b"fg"]);
    }

    #[test]
    fn first_chunk_reserves_the_announced_total() {
        let mut assembler = Assembler::new("frame", 1 << 20);
        assert!(assembler.push(chunk(Some(1 << 20), 0, b"ab")).expect("a valid chunk").is_none());
        let (start, capacity) = (assembler.bytes.as_ptr(), assembler.bytes.capacity());
        assert!(capacity >= 1 << 20, "{capacity}");
        assembler.push(Chunk { head: None, offset: 2, data: vec![0; 1 << 19].into() }).expect("a valid chunk");
        assert_eq!((assembler.bytes.as_ptr(), assembler.bytes.capacity()), (start, capacity));
    }

    #[test]
    fn malformed_chunks_report_their_field() {
        for (chunks, field) in [
            (vec![chunk(Some(9), 0, b"")], "frame.total"),
            (vec![chunk(Some(u64::MAX), 0, b"")], "frame.total"),
            (vec![chunk(Some(4), 1, b"ab")], "frame.offset"),
            (vec![chunk(Some(4), 0, b"ab"), chunk(None, 3, b"c")], "frame.offset"),
            (vec![chunk(Some(4), 0, b"ab"), chunk(None, 2, b"cde")], "frame.data"),
            (vec![chunk(None, 0, b"ab")], "frame.head"),
            (vec![chunk(Some(4), 0, b"ab"), chunk(Some(4), 0, b"ab")], "frame.head"),
            (vec![chunk(Some(4), 0, b"ab")], "the stream ended"),
        ] {
            let error = assemble(chunks).expect_err("malformed chunks").to_string();
            assert!(error.contains(field), "expected an error of {field}, got: {error}");
        }
    }

    #[test]
    fn total_beyond_the_memory_is_an_error() {
        let mut assembler = Assembler::new("frame", u64::MAX);
        let error = assembler.push(chunk(Some(u64::MAX), 0, b"ab")).expect_err("too many bytes").to_string();
        assert!(error.contains("frame.total"), "{error}");
    }

    #[test]
    fn numbers_are_decoded_at_any_alignment() {
        let mut bytes = vec![0];
        bytes.extend(1.5_f32.to_le_bytes());
        bytes.extend((-2.0_f32).to_le_bytes());
        assert_eq!(decode::<f32>("q", &bytes[1..]).expect("a valid length"), [1.5, -2.0]);
        assert_eq!(decode::<[f32; 2]>("q", &bytes[1..]).expect("a valid length"), [[1.5, -2.0]]);
        assert_eq!(decode::<u32>("q", &7_u32.to_le_bytes()).expect("a valid length"), [7]);
        let error = decode::<f32>("q", &bytes).expect_err("nine bytes").to_string();
        assert!(error.contains("a multiple of 4 bytes"), "{error}");
    }
}
