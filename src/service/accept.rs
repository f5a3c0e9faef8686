//! Accepts connections under a limit. A permit is acquired before a connection is accepted. A connection that sends
//! nothing is closed. The listener pauses after a failed accept, so that it does not spin when file descriptors run
//! out.

use std::io;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::sync::futures::OwnedNotified;
use tokio::sync::{Notify, OwnedSemaphorePermit, Semaphore, mpsc};
use tokio_stream::wrappers::ReceiverStream;
use tonic::transport::server::Connected;

use super::connection::{Budgets, ConnectionInfo};
use super::listen::{ListeningSockets, Socket};
use crate::config::Config;

/// Maximum number of connections that have sent their first byte and are queued for the server. Further connections
/// wait until the queue has capacity.
const READY_QUEUE_CAPACITY: usize = 16;

/// Pause of the listener after a failed accept.
const ACCEPT_RETRY_DELAY: Duration = Duration::from_millis(50);

/// An accepted connection with its permit.
#[derive(Debug)]
pub(super) struct Connection {
    socket: Socket,
    info: ConnectionInfo,
    /// Completes when the server must close the connection.
    closed: Pin<Box<OwnedNotified>>,
    is_closed: bool,
    /// Counts against the limit on connections until the connection is dropped.
    _permit: OwnedSemaphorePermit,
}

/// Accepts connections until the returned stream is dropped. At most `config.connections` are open at a time. Each must
/// send its first byte within `config.first_byte_timeout`. All share the budgets of the configuration.
pub(super) fn accept_connections(sockets: ListeningSockets, config: &Config) -> ReceiverStream<io::Result<Connection>> {
    let budgets = Budgets::new(config);
    let (max_connections, first_byte_timeout) = (config.connections, config.first_byte_timeout);
    let (ready_sender, ready_receiver) = mpsc::channel(READY_QUEUE_CAPACITY);
    tokio::spawn(async move {
        let permits = Arc::new(Semaphore::new(max_connections));
        loop {
            let accept_result = tokio::select! {
                accept_result = accept(&sockets, &permits, &budgets) => accept_result,
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

async fn accept(sockets: &ListeningSockets, permits: &Arc<Semaphore>, budgets: &Budgets) -> io::Result<Connection> {
    let permit = Arc::clone(permits).acquire_owned().await.map_err(io::Error::other)?;
    let (socket, peer) = sockets.accept().await?;
    let close = Arc::new(Notify::new());
    let closed = Box::pin(Arc::clone(&close).notified_owned());
    Ok(Connection {
        socket,
        info: ConnectionInfo::new(peer, budgets, close),
        closed,
        is_closed: false,
        _permit: permit,
    })
}

/// Forwards a connection once it has sent its first byte. Drops it if it sends nothing within `first_byte_timeout`.
async fn await_first_byte(
    mut connection: Connection,
    first_byte_timeout: Duration,
    ready_sender: mpsc::Sender<io::Result<Connection>>,
) {
    let first_byte = connection.socket.wait_for_first_byte();
    if tokio::time::timeout(first_byte_timeout, first_byte).await == Ok(true) {
        ready_sender.send(Ok(connection)).await.ok(); // Fails only if the server has stopped.
    }
}

impl Connected for Connection {
    type ConnectInfo = ConnectionInfo;

    fn connect_info(&self) -> ConnectionInfo {
        self.info.clone()
    }
}

impl Connection {
    /// Fails when the server must close the connection.
    fn check_open(&mut self, cx: &mut Context<'_>) -> io::Result<()> {
        self.is_closed = self.is_closed || self.closed.as_mut().poll(cx).is_ready();
        if self.is_closed { Err(io::ErrorKind::ConnectionAborted.into()) } else { Ok(()) }
    }
}

impl AsyncRead for Connection {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buffer: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        self.check_open(cx)?;
        if let Some(byte) = self.socket.take_first_byte() {
            buffer.put_slice(&[byte]);
            return Poll::Ready(Ok(()));
        }
        self.socket.io().poll_read(cx, buffer)
    }
}

impl AsyncWrite for Connection {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        self.check_open(cx)?;
        self.socket.io().poll_write(cx, bytes)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        slices: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        self.check_open(cx)?;
        self.socket.io().poll_write_vectored(cx, slices)
    }

    fn is_write_vectored(&self) -> bool {
        self.socket.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.socket.io().poll_flush(cx)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.socket.io().poll_shutdown(cx)
    }
}
