//! A socket whose traffic is checked against limits while it is read.

use std::io;
use std::pin::Pin;
use std::task::{Context, Poll, ready};

use bytes::Bytes;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};

/// Limits of a connection, in terms of its protocol.
pub(super) trait Meter: Unpin {
    /// Counts received bytes.
    ///
    /// # Errors
    /// When a limit is exceeded. The socket then cannot be read any more.
    fn receive(&mut self, bytes: &[u8]) -> io::Result<()>;

    /// Limit on the bytes of the next read.
    fn max_read_bytes(&self) -> usize {
        usize::MAX
    }

    /// Counts sent bytes.
    fn send(&mut self, _bytes: usize) {}

    /// Called when no bytes can be read. Ready when the connection must not wait for more bytes.
    fn poll_overdue(&mut self, _cx: &mut Context<'_>) -> Poll<io::Error> {
        Poll::Pending
    }
}

/// No limits.
impl Meter for () {
    fn receive(&mut self, _bytes: &[u8]) -> io::Result<()> {
        Ok(())
    }
}

/// A socket of which some bytes were read before.
pub(super) struct MeteredSocket<S, M> {
    pub(super) socket: S,
    /// Bytes that were read before and count as checked.
    prefix: Bytes,
    pub(super) meter: M,
}

impl<S, M: Meter> MeteredSocket<S, M> {
    pub(super) const fn new(socket: S, prefix: Bytes, meter: M) -> Self {
        Self { socket, prefix, meter }
    }

    fn count_sent(&mut self, sent: Poll<io::Result<usize>>) -> Poll<io::Result<usize>> {
        if let Poll::Ready(Ok(bytes)) = sent {
            self.meter.send(bytes);
        }
        sent
    }
}

impl<S: AsyncRead + Unpin, M: Meter> AsyncRead for MeteredSocket<S, M> {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buffer: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        let this = &mut *self;
        if !this.prefix.is_empty() {
            let length = this.prefix.len().min(buffer.remaining());
            buffer.put_slice(&this.prefix.split_to(length));
            return Poll::Ready(Ok(()));
        }
        let max_bytes = this.meter.max_read_bytes().min(buffer.remaining());
        let mut received = ReadBuf::new(buffer.initialize_unfilled_to(max_bytes));
        let Poll::Ready(result) = Pin::new(&mut this.socket).poll_read(cx, &mut received) else {
            return Poll::Ready(Err(ready!(this.meter.poll_overdue(cx))));
        };
        this.meter.receive(received.filled())?;
        let length = received.filled().len();
        buffer.advance(length);
        Poll::Ready(result)
    }
}

impl<S: AsyncWrite + Unpin, M: Meter> AsyncWrite for MeteredSocket<S, M> {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        let sent = Pin::new(&mut self.socket).poll_write(cx, bytes);
        self.count_sent(sent)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        slices: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        let sent = Pin::new(&mut self.socket).poll_write_vectored(cx, slices);
        self.count_sent(sent)
    }

    fn is_write_vectored(&self) -> bool {
        self.socket.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.socket).poll_flush(cx)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.socket).poll_shutdown(cx)
    }
}
