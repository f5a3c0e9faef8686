//! Accepts connections that get a permit, and encrypts those of TCP if the server has a certificate. Serves gRPC on those that
//! begin with the preface of HTTP/2, and the browser viewer on the others. A connection that does not complete its TLS
//! handshake, or does not send its first bytes or its first request, in time is closed. The listener pauses after a failed
//! accept, so that it does not spin when file descriptors run out.

use std::convert::Infallible;
use std::io;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use hyper::body::Incoming;
use hyper::server::conn::http2;
use hyper_util::rt::{TokioExecutor, TokioIo, TokioTimer};
use tokio::io::AsyncReadExt as _;
use tonic::body::Body;
use tonic::codegen::http::{Request, Response};

use super::authentication::Authenticator;
use super::connected_peers::ConnectedPeerEntry;
use super::connection::{Budgets, ConnectionInfo, STREAMS_PER_CONNECTION_WINDOW};
use super::connection_gauges::ConnectionGauges;
use super::connection_table::{ConnectionSlot, ConnectionTable, GOAWAY_TIMEOUT};
use super::control_frames::ControlFrameLimit;
use super::listen::{ListeningSockets, Socket};
use super::metered_socket::MeteredSocket;
use super::peer::Peer;
use super::routes::Routes;
use super::tls::TlsServer;
use super::web::WebServer;
use crate::admission::{Account, Admission};
use crate::config::Config;

/// Pause of the listener after a failed accept.
pub(super) const ACCEPT_RETRY_DELAY: Duration = Duration::from_millis(50);

/// Limit on the open calls of one connection. All of them are handled at a time. No call waits in a queue: HTTP/2 would
/// buffer up to one stream window of a waiting call outside the budgets.
const MAX_CALLS: u32 = 128;

/// The bytes that every client sends first (RFC 9113, 3.4).
const PREFACE: [u8; 24] = *b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n";

/// Serves accepted connections.
pub(super) struct ConnectionServer {
    routes: Routes,
    /// Serves HTTP/1.1. `None` if the viewer is off.
    web: Option<WebServer>,
    http2: http2::Builder<TokioExecutor>,
    authenticator: Arc<Authenticator>,
    /// Encrypts TCP connections. `None`: they are plain.
    tls: Option<Arc<TlsServer>>,
    connections: ConnectionGauges,
    budgets: Budgets,
    handshake_timeout: Duration,
    first_request_timeout: Duration,
}

impl ConnectionServer {
    pub(super) fn new(
        routes: Routes,
        web: Option<WebServer>,
        authenticator: Arc<Authenticator>,
        tls: Option<Arc<TlsServer>>,
        connections: ConnectionGauges,
        config: &Config,
        metrics: &Admission,
    ) -> Arc<Self> {
        Arc::new(Self {
            routes,
            authenticator,
            tls,
            connections,
            web,
            http2: http2_builder(config),
            budgets: Budgets::new(config, metrics),
            handshake_timeout: config.handshake_timeout,
            first_request_timeout: config.first_request_timeout,
        })
    }

    /// Accepts connections until this future is dropped.
    pub(super) async fn accept_connections(self: Arc<Self>, sockets: ListeningSockets, table: Arc<ConnectionTable>) {
        loop {
            match sockets.accept().await {
                Ok((socket, peer)) => match table.insert(&self.account_of(&peer)).await {
                    Ok(slot) => {
                        let entry = table.peers().add(&peer, slot.permit());
                        tokio::spawn(Arc::clone(&self).serve(socket, peer, slot, entry));
                    }
                    Err(error) => tracing::debug!(peer = peer.name, %error, "a connection is refused"),
                },
                Err(error) => {
                    tracing::warn!(%error, "a connection could not be accepted");
                    // The process may have too few file descriptors, and closing a connection frees one.
                    table.preempt_one();
                    tokio::time::sleep(ACCEPT_RETRY_DELAY).await;
                }
            }
        }
    }

    /// The account of a connection before its first bytes.
    fn account_of(&self, peer: &Peer) -> Account {
        let credential = self.authenticator.credential_of_connection(peer.uid, &[]);
        let principal = credential.map(|credential| Arc::clone(credential.principal()));
        principal.map_or(Account::anonymous(peer.client()), |principal| Account::new(&principal, peer.client()))
    }

    /// Serves a connection until it ends or must be closed.
    async fn serve(self: Arc<Self>, socket: Socket, peer: Peer, slot: ConnectionSlot, _entry: ConnectedPeerEntry) {
        tokio::select! {
            () = slot.overdue() => {}
            () = self.serve_until_retired(socket, peer, &slot) => {}
        }
    }

    async fn serve_until_retired(&self, socket: Socket, peer: Peer, slot: &ConnectionSlot) {
        let Some(mut socket) = self.encrypt(socket, &peer).await else { return };
        let protocol = tokio::time::timeout(self.handshake_timeout, detect_protocol(&mut socket));
        let Ok(Ok(Some(protocol))) = protocol.await else { return };
        let info_with = |credential| ConnectionInfo::new(&peer, credential, &self.budgets, slot);
        match (protocol, &self.web) {
            (Protocol::Http2, _) => {
                let _counted = self.connections.count("grpc");
                let credential = self.authenticator.credential_of_connection(peer.uid, &socket.client_names());
                self.serve_http2(socket, &info_with(credential), slot).await;
            }
            (Protocol::Other(first_bytes), Some(web)) => {
                let _counted = self.connections.count("http");
                // Browsers send the token of their session in a message.
                let credential = self.authenticator.credential_of_connection(peer.uid, &socket.client_names());
                web.serve(socket, first_bytes, info_with(credential), slot).await;
            }
            (Protocol::Other(_), None) => {}
        }
    }

    /// Makes a TLS connection of a TCP connection if the server has a certificate. `None` if the handshake fails or takes too
    /// long. The table bounds the number of handshakes: connections in one are anonymous and without progress, and are closed
    /// first when the table is full.
    async fn encrypt(&self, socket: Socket, peer: &Peer) -> Option<Socket> {
        let (tls, stream) = match (&self.tls, socket) {
            (Some(tls), Socket::Tcp(stream)) => (tls, stream),
            (_, socket) => return Some(socket),
        };
        match tokio::time::timeout(self.handshake_timeout, tls.accept(stream)).await {
            Ok(Ok(socket)) => Some(Socket::Tls(socket)),
            Ok(Err(error)) => {
                tracing::info!(peer = peer.name, %error, "a TLS handshake failed");
                None
            }
            Err(_) => None,
        }
    }

    async fn serve_http2(&self, socket: Socket, info: &ConnectionInfo, slot: &ConnectionSlot) {
        let service = hyper::service::service_fn(|request| self.call(request, info));
        let io = MeteredSocket::new(socket, Bytes::from_static(&PREFACE), ControlFrameLimit::new());
        let mut connection = std::pin::pin!(self.http2.serve_connection(TokioIo::new(io), service));
        tokio::select! {
            result = &mut connection => return log_end(result),
            () = slot.retired() => {}
            () = slot.first_request_overdue(self.first_request_timeout) => {}
        }
        connection.as_mut().graceful_shutdown();
        loop {
            match tokio::time::timeout(GOAWAY_TIMEOUT, &mut connection).await {
                Ok(result) => return log_end(result),
                Err(_) if slot.calls.is_empty() => return,
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
}

/// Every limit is set explicitly, because the library's defaults disable some of them. Sizes are in bytes.
fn http2_builder(config: &Config) -> http2::Builder<TokioExecutor> {
    let mut builder = http2::Builder::new(TokioExecutor::new());
    builder
        .timer(TokioTimer::new())
        .max_concurrent_streams(MAX_CALLS)
        // A connection ends when the server has reset this many of its streams because of errors.
        .max_local_error_reset_streams(1024)
        // A connection ends when its client has reset this many streams that the server has not accepted yet (a
        // rapid-reset attack).
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

/// The protocol of a connection, by its first bytes.
enum Protocol {
    /// The preface has been read.
    Http2,
    /// These bytes have been read, and they do not begin the preface.
    Other(Bytes),
}

/// Reads the preface, or the first bytes that differ from it. `None` if the client sends nothing more.
async fn detect_protocol(socket: &mut Socket) -> io::Result<Option<Protocol>> {
    let mut bytes = [0; PREFACE.len()];
    let mut length = 0;
    while length < bytes.len() {
        let received = socket.read(&mut bytes[length..]).await?;
        length += received;
        if received == 0 {
            return Ok(None);
        }
        if bytes[..length] != PREFACE[..length] {
            return Ok(Some(Protocol::Other(Bytes::copy_from_slice(&bytes[..length]))));
        }
    }
    Ok(Some(Protocol::Http2))
}
