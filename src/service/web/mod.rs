//! HTTP/1.1 on the port of the gRPC server: the browser viewer's page, a WebSocket that carries gRPC calls, and the
//! health of the server. `proto/websocket.md` specifies all of it.

mod access;
mod call;
mod client_messages;
mod close_reason;
mod envelope;
mod frame_meter;
mod outgoing;
mod page;
mod reply_messages;
mod websocket;

use std::convert::Infallible;
use std::net::IpAddr;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use bytes::Bytes;
use http_body_util::Full;
use hyper::body::Incoming;
use hyper::server::conn::http1;
use hyper::upgrade::OnUpgrade;
use hyper_util::rt::{TokioIo, TokioTimer};
use tokio_tungstenite::tungstenite::handshake::derive_accept_key;
use tonic::codegen::http::header::{self, HeaderMap, HeaderName, HeaderValue};
use tonic::codegen::http::{Method, Request, Response, StatusCode};

pub(super) use self::access::Access;

use self::access::Denied;
use self::page::Page;
use self::websocket::{WebSocketLimits, serve_websocket};
use super::connection::ConnectionInfo;
use super::connection_table::ConnectionSlot;
use super::listen::Socket;
use super::metered_socket::MeteredSocket;
use super::routes::Routes;
use crate::config::Config;
use crate::engine::lock;
use modalcast_model::error::Result;

/// The subprotocol of the WebSocket.
const SUBPROTOCOL: &str = "modalcast.v1";

/// Limits on the head of a request.
const MAX_HEAD_BYTES: usize = 16 << 10;
const MAX_HEADERS: usize = 64;

/// Time within which a client must send its request and take the answer.
const EXCHANGE_TIMEOUT: Duration = Duration::from_secs(60);

/// Serves HTTP/1.1.
pub(super) struct WebServer {
    routes: Routes,
    access: Access,
    page: Page,
    /// Whether the server is healthy.
    is_serving: Arc<AtomicBool>,
    http1: http1::Builder,
    websocket_limits: WebSocketLimits,
}

/// An answer of the server.
type Answer = Response<Full<Bytes>>;

/// The upgrade of a connection to a WebSocket, once the client has asked for it.
type Upgrade = Mutex<Option<OnUpgrade>>;

impl WebServer {
    /// Unpacks the page of the viewer, and adds the recording of the configuration.
    ///
    /// # Errors
    /// `Fault` when the page that the program contains is damaged.
    pub(super) fn new(routes: Routes, access: Access, is_serving: Arc<AtomicBool>, config: &Config) -> Result<Self> {
        let mut http1 = http1::Builder::new();
        http1
            .timer(TokioTimer::new())
            .header_read_timeout(config.handshake_timeout)
            .max_headers(MAX_HEADERS)
            .max_header_size(MAX_HEAD_BYTES)
            .max_buf_size(MAX_HEAD_BYTES);
        let websocket_limits = WebSocketLimits::new(config);
        let page = config.viewer_recording.as_ref().map_or_else(Page::viewer, Page::playing)?;
        Ok(Self { routes, access, page, is_serving, http1, websocket_limits })
    }

    /// Serves a connection, of which `first_bytes` were read before, until it ends or must be closed.
    pub(super) async fn serve(&self, socket: Socket, first_bytes: Bytes, info: ConnectionInfo, slot: &ConnectionSlot) {
        let Some(on_upgrade) = self.serve_request(socket, first_bytes, slot).await else { return };
        let Ok(upgraded) = on_upgrade.await else { return };
        let Ok(parts) = upgraded.downcast::<TokioIo<MeteredSocket<Socket, ()>>>() else { return };
        let socket = parts.io.into_inner().socket;
        serve_websocket(socket, parts.read_buf, self.routes.clone(), info, slot, self.websocket_limits).await;
    }

    /// Answers one request. Returns the upgrade if it was the handshake of a WebSocket.
    async fn serve_request(&self, socket: Socket, first_bytes: Bytes, slot: &ConnectionSlot) -> Option<OnUpgrade> {
        let local_ip = socket.local_ip();
        let upgrade = Upgrade::default();
        let service = hyper::service::service_fn(|request| {
            let answer = self.answer(request, local_ip, &upgrade);
            async { Ok::<_, Infallible>(answer) }
        });
        let io = TokioIo::new(MeteredSocket::new(socket, first_bytes, ()));
        let connection = self.http1.serve_connection(io, service).with_upgrades();
        tokio::select! {
            result = tokio::time::timeout(EXCHANGE_TIMEOUT, connection) => match result {
                Ok(Ok(())) => {}
                Ok(Err(error)) => tracing::debug!(%error, "a connection ended"),
                Err(_) => tracing::debug!("a client has not taken its answer in time"),
            },
            () = slot.signals.retire.notified() => return None,
        }
        lock(&upgrade).take()
    }

    /// Answers a request. Sets `upgrade` if the answer begins a WebSocket.
    fn answer(&self, request: Request<Incoming>, local_ip: Option<IpAddr>, upgrade: &Upgrade) -> Answer {
        let host = match self.access.check_site(request.headers(), local_ip) {
            Ok(host) => host,
            Err(denied) => return denied_answer(denied),
        };
        let is_page = match request.uri().path() {
            "/" => true,
            "/websocket" => false,
            "/healthz" if request.method() == Method::GET => return self.health_answer(),
            "/healthz" => return method_answer(),
            _ => return text_answer(StatusCode::NOT_FOUND, "expected the path /, /websocket or /healthz\n"),
        };
        if request.method() != Method::GET {
            return method_answer();
        }
        if let Err(denied) = self.access.check_token(request.uri()) {
            return denied_answer(denied);
        }
        if is_page {
            return self.page_answer(host);
        }
        match websocket_accept_key(request.headers()) {
            Some(key) => {
                *lock(upgrade) = Some(hyper::upgrade::on(request));
                websocket_answer(&key)
            }
            None => text_answer(
                StatusCode::BAD_REQUEST,
                format!("expected the handshake of a WebSocket with version 13 and the subprotocol {SUBPROTOCOL}\n"),
            ),
        }
    }

    fn health_answer(&self) -> Answer {
        match self.is_serving.load(Ordering::Relaxed) {
            true => text_answer(StatusCode::OK, "serving\n"),
            false => text_answer(StatusCode::SERVICE_UNAVAILABLE, "not serving\n"),
        }
    }

    fn page_answer(&self, host: &str) -> Answer {
        let mut answer = answer_with(StatusCode::OK, "text/html; charset=utf-8", self.page.body.clone());
        let headers = answer.headers_mut();
        if self.page.is_compressed {
            headers.insert(header::CONTENT_ENCODING, HeaderValue::from_static("gzip"));
        }
        // The host was parsed before, so it is a valid header value.
        if let Ok(policy) = HeaderValue::try_from(self.page.policy(host)) {
            headers.insert(header::CONTENT_SECURITY_POLICY, policy);
        }
        answer
    }
}

/// The key that accepts the handshake of a WebSocket (RFC 6455, 4.2). `None` for another request.
fn websocket_accept_key(headers: &HeaderMap) -> Option<String> {
    let has_item = |name: HeaderName, expected: &str| {
        let texts = headers.get_all(name).into_iter().filter_map(|value| value.to_str().ok());
        texts.flat_map(|text| text.split(',')).any(|item| item.trim().eq_ignore_ascii_case(expected))
    };
    let is_handshake = has_item(header::CONNECTION, "upgrade")
        && has_item(header::UPGRADE, "websocket")
        && has_item(header::SEC_WEBSOCKET_VERSION, "13")
        && has_item(header::SEC_WEBSOCKET_PROTOCOL, SUBPROTOCOL);
    let key = headers.get(header::SEC_WEBSOCKET_KEY).filter(|_| is_handshake)?;
    Some(derive_accept_key(key.as_bytes()))
}

fn websocket_answer(accept_key: &str) -> Answer {
    let mut answer = Response::new(Full::default());
    *answer.status_mut() = StatusCode::SWITCHING_PROTOCOLS;
    let headers = answer.headers_mut();
    headers.insert(header::CONNECTION, HeaderValue::from_static("upgrade"));
    headers.insert(header::UPGRADE, HeaderValue::from_static("websocket"));
    headers.insert(header::SEC_WEBSOCKET_PROTOCOL, HeaderValue::from_static(SUBPROTOCOL));
    // The key is Base64.
    if let Ok(key) = HeaderValue::try_from(accept_key) {
        headers.insert(header::SEC_WEBSOCKET_ACCEPT, key);
    }
    answer
}

fn denied_answer(denied: Denied) -> Answer {
    let expected = denied.expected();
    let text = format!(
        "Expected {expected}.\n\nOpen the URL that `modalcast serve` prints as 'viewer at'. The token is new at each start.\n"
    );
    text_answer(StatusCode::FORBIDDEN, text)
}

fn method_answer() -> Answer {
    let mut answer = text_answer(StatusCode::METHOD_NOT_ALLOWED, "expected the method GET\n");
    answer.headers_mut().insert(header::ALLOW, HeaderValue::from_static("GET"));
    answer
}

fn text_answer(status: StatusCode, text: impl Into<Bytes>) -> Answer {
    answer_with(status, "text/plain; charset=utf-8", text.into())
}

/// An answer that ends the connection.
fn answer_with(status: StatusCode, content_type: &'static str, body: Bytes) -> Answer {
    let mut answer = Response::new(Full::new(body));
    *answer.status_mut() = status;
    for (name, value) in [
        (header::CONTENT_TYPE, content_type),
        (header::CONNECTION, "close"),
        (header::CACHE_CONTROL, "no-store"),
        (header::REFERRER_POLICY, "no-referrer"),
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (HeaderName::from_static("cross-origin-resource-policy"), "same-origin"),
    ] {
        answer.headers_mut().insert(name, HeaderValue::from_static(value));
    }
    answer
}
