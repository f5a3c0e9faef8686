//! Accepts connections under a limit and serves HTTP/2 on them. A connection that does not send the preface of HTTP/2 or
//! its first request in time is closed. The listener pauses after a failed accept, so that it does not spin when file
//! descriptors run out.

use std::convert::Infallible;
use std::io;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Duration;

use hyper::body::Incoming;
use hyper::server::conn::http2;
use hyper_util::rt::{TokioExecutor, TokioIo, TokioTimer};
use tokio::io::{AsyncRead, AsyncReadExt as _, AsyncWrite, ReadBuf};
use tonic::body::Body;
use tonic::codegen::http::{Request, Response};

use super::connection::{Budgets, ConnectionInfo, STREAMS_PER_CONNECTION_WINDOW};
use super::connection_table::{ConnectionSlot, ConnectionTable};
use super::control_frames::ControlFrameLimit;
use super::listen::{ListeningSockets, Socket};
use super::routes::Routes;
use crate::config::Config;

/// Pause of the listener after a failed accept.
const ACCEPT_RETRY_DELAY: Duration = Duration::from_millis(50);

/// Time within which the client must close a connection without calls after GOAWAY.
const GOAWAY_TIMEOUT: Duration = Duration::from_secs(1);

/// Limit on the open calls of one connection. All of them are handled at a time. A call in a queue would not be read, and
/// HTTP/2 would buffer a stream window of it outside the budgets.
const MAX_CALLS: u32 = 128;

/// The bytes that every client sends first (RFC 9113, 3.4).
const PREFACE: [u8; 24] = *b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n";

/// Serves HTTP/2 on accepted connections.
pub(super) struct ConnectionServer {
    routes: Routes,
    http2: http2::Builder<TokioExecutor>,
    budgets: Budgets,
    handshake_timeout: Duration,
    first_request_timeout: Duration,
}

impl ConnectionServer {
    pub(super) fn new(routes: Routes, config: &Config) -> Arc<Self> {
        Arc::new(Self {
            routes,
            http2: http2_builder(config),
            budgets: Budgets::new(config),
            handshake_timeout: config.handshake_timeout,
            first_request_timeout: config.first_request_timeout,
        })
    }

    /// Accepts connections until this future is dropped.
    pub(super) async fn accept_connections(self: Arc<Self>, sockets: ListeningSockets, table: Arc<ConnectionTable>) {
        loop {
            match sockets.accept().await {
                Ok((socket, peer)) => {
                    let slot = table.insert().await;
                    tokio::spawn(Arc::clone(&self).serve(socket, peer, slot));
                }
                Err(error) => {
                    tracing::warn!(%error, "a connection could not be accepted");
                    // The file descriptor of another connection may be all that is missing.
                    table.evict();
                    tokio::time::sleep(ACCEPT_RETRY_DELAY).await;
                }
            }
        }
    }

    /// Serves a connection until it ends or must be closed.
    async fn serve(self: Arc<Self>, socket: Socket, peer: String, slot: ConnectionSlot) {
        tokio::select! {
            () = slot.signals.close.notified() => {}
            () = self.serve_until_retired(socket, peer, &slot) => {}
        }
    }

    async fn serve_until_retired(&self, mut socket: Socket, peer: String, slot: &ConnectionSlot) {
        let preface = read_preface(&mut socket);
        if !matches!(tokio::time::timeout(self.handshake_timeout, preface).await, Ok(Ok(true))) {
            return;
        }
        let info = ConnectionInfo::new(peer, &self.budgets, slot);
        let service = hyper::service::service_fn(|request| self.call(request, &info));
        let io = TokioIo::new(LimitedSocket { socket, preface: &PREFACE, control_frames: ControlFrameLimit::new() });
        let mut connection = std::pin::pin!(self.http2.serve_connection(io, service));
        tokio::select! {
            result = &mut connection => return log_end(result),
            () = slot.signals.retire.notified() => {}
            () = self.first_request_overdue(slot) => {}
        }
        connection.as_mut().graceful_shutdown();
        loop {
            match tokio::time::timeout(GOAWAY_TIMEOUT, &mut connection).await {
                Ok(result) => return log_end(result),
                Err(_) if slot.activity.is_idle() => return,
                Err(_) => {}
            }
        }
    }

    fn call(
        &self,
        request: Request<Incoming>,
        info: &ConnectionInfo,
    ) -> impl Future<Output = Result<Response<Body>, Infallible>> + use<> {
        let mut request = request.map(Body::new);
        request.extensions_mut().insert(info.clone());
        self.routes.call(request)
    }

    /// Completes if no request has been received in time.
    async fn first_request_overdue(&self, slot: &ConnectionSlot) {
        tokio::time::sleep(self.first_request_timeout).await;
        if slot.activity.has_received_request() {
            std::future::pending().await
        }
    }
}

/// Every limit is set explicitly, because the library's defaults disable some of them. Sizes are in bytes.
fn http2_builder(config: &Config) -> http2::Builder<TokioExecutor> {
    let mut builder = http2::Builder::new(TokioExecutor::new());
    builder
        .timer(TokioTimer::new())
        .max_concurrent_streams(MAX_CALLS)
        // A client that opens and resets more streams than this (a rapid-reset attack) is disconnected.
        .max_local_error_reset_streams(1024)
        .max_pending_accept_reset_streams(100)
        .max_header_list_size(16 << 10)
        .initial_stream_window_size(config.stream_window)
        .initial_connection_window_size(STREAMS_PER_CONNECTION_WINDOW * config.stream_window)
        .max_frame_size(64 << 10)
        .keep_alive_interval(config.keepalive_interval)
        .keep_alive_timeout(config.keepalive_timeout);
    builder
}

fn log_end(result: hyper::Result<()>) {
    if let Err(error) = result {
        tracing::debug!(%error, "a connection ended");
    }
}

/// Reads the preface. False if the client sends other bytes.
async fn read_preface(socket: &mut Socket) -> io::Result<bool> {
    let mut bytes = [0; PREFACE.len()];
    let mut length = 0;
    while length < bytes.len() {
        let received = socket.io().read(&mut bytes[length..]).await?;
        length += received;
        if received == 0 || bytes[..length] != PREFACE[..length] {
            return Ok(false);
        }
    }
    Ok(true)
}

/// A socket whose preface was read before. Reading fails when the client has sent too many control frames.
struct LimitedSocket {
    socket: Socket,
    /// The part of the preface that HTTP/2 has not read.
    preface: &'static [u8],
    control_frames: ControlFrameLimit,
}

impl LimitedSocket {
    fn count_sent(&mut self, sent: Poll<io::Result<usize>>) -> Poll<io::Result<usize>> {
        if let Poll::Ready(Ok(bytes)) = sent {
            self.control_frames.send(bytes);
        }
        sent
    }
}

impl AsyncRead for LimitedSocket {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buffer: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        if !self.preface.is_empty() {
            let (now, later) = self.preface.split_at(self.preface.len().min(buffer.remaining()));
            buffer.put_slice(now);
            self.preface = later;
            return Poll::Ready(Ok(()));
        }
        let filled = buffer.filled().len();
        let result = self.socket.io().poll_read(cx, buffer);
        match self.control_frames.receive(&buffer.filled()[filled..]) {
            true => result,
            false => Poll::Ready(Err(io::Error::other("the client has sent too many control frames"))),
        }
    }
}

impl AsyncWrite for LimitedSocket {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        let sent = self.socket.io().poll_write(cx, bytes);
        self.count_sent(sent)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        slices: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        let sent = self.socket.io().poll_write_vectored(cx, slices);
        self.count_sent(sent)
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
