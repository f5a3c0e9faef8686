//! Accepts connections under a limit. A permit is acquired before a connection is accepted. A connection that sends
//! nothing is closed. The listener pauses after a failed accept, so that it does not spin when file descriptors run
//! out.

use std::io;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc};
use tokio_stream::wrappers::ReceiverStream;
use tonic::transport::server::Connected;

use super::connection::ConnectionInfo;

/// Maximum number of connections that have sent their first byte and are queued for the server. Further connections
/// wait until the queue has capacity.
const READY_QUEUE_CAPACITY: usize = 16;

/// Pause of the listener after a failed accept.
const ACCEPT_RETRY_DELAY: Duration = Duration::from_millis(50);

/// An accepted connection with its permit.
#[derive(Debug)]
pub(super) struct Connection {
    stream: TcpStream,
    info: ConnectionInfo,
    /// Counts against the limit on connections until the connection is dropped.
    _permit: OwnedSemaphorePermit,
}

/// Accepts connections until the returned stream is dropped. At most `max_connections` are open at a time. Each must
/// send its first byte within `first_byte_timeout`.
pub(super) fn accept_connections(
    listener: TcpListener,
    max_connections: usize,
    first_byte_timeout: Duration,
) -> ReceiverStream<io::Result<Connection>> {
    let (ready_sender, ready_receiver) = mpsc::channel(READY_QUEUE_CAPACITY);
    tokio::spawn(async move {
        let permits = Arc::new(Semaphore::new(max_connections));
        loop {
            let accept_result = tokio::select! {
                accept_result = accept(&listener, &permits) => accept_result,
                () = ready_sender.closed() => return,
            };
            match accept_result {
                Ok(connection) => {
                    tokio::spawn(await_first_byte(connection, first_byte_timeout, ready_sender.clone()));
                }
                Err(error) => {
                    tracing::warn!(%error, "a connection could not be accepted");
                    tokio::time::sleep(ACCEPT_RETRY_DELAY).await;
                }
            }
        }
    });
    ReceiverStream::new(ready_receiver)
}

async fn accept(listener: &TcpListener, permits: &Arc<Semaphore>) -> io::Result<Connection> {
    let permit = Arc::clone(permits).acquire_owned().await.map_err(io::Error::other)?;
    let (stream, remote) = listener.accept().await?;
    stream.set_nodelay(true)?;
    Ok(Connection { stream, info: ConnectionInfo::new(remote), _permit: permit })
}

/// Forwards a connection once it has sent its first byte. Drops it if it sends nothing within `first_byte_timeout`.
async fn await_first_byte(
    connection: Connection,
    first_byte_timeout: Duration,
    ready_sender: mpsc::Sender<io::Result<Connection>>,
) {
    let mut first_byte = [0];
    let peeked_bytes = tokio::time::timeout(first_byte_timeout, connection.stream.peek(&mut first_byte)).await;
    if matches!(peeked_bytes, Ok(Ok(1))) {
        ready_sender.send(Ok(connection)).await.ok(); // Fails only if the server has stopped.
    }
}

impl Connected for Connection {
    type ConnectInfo = ConnectionInfo;

    fn connect_info(&self) -> ConnectionInfo {
        self.info.clone()
    }
}

impl AsyncRead for Connection {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buffer: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_read(cx, buffer)
    }
}

impl AsyncWrite for Connection {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.stream).poll_write(cx, bytes)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        slices: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.stream).poll_write_vectored(cx, slices)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(cx)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(cx)
    }
}
