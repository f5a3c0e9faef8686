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
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use bytes::Bytes;
use http_body_util::{BodyExt as _, Collected, Full, Limited};
use hyper::body::Incoming;
use hyper::server::conn::http1;
use hyper::upgrade::OnUpgrade;
use hyper_util::rt::{TokioIo, TokioTimer};
use tokio_tungstenite::tungstenite::handshake::derive_accept_key;
use tonic::codegen::http::header::{self, HeaderMap, HeaderName, HeaderValue};
use tonic::codegen::http::{Method, Request, Response, StatusCode};

pub(super) use self::access::Access;

use self::access::{Arrival, Denied};
use self::page::Page;
use self::websocket::{WebSocketLimits, serve_websocket};
use super::authentication::{Authenticator, bearer_token};
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

/// Limit on the body of a request for a session.
const MAX_CODE_BYTES: usize = 512;

/// Time within which a client must send its request and take the answer.
const EXCHANGE_TIMEOUT: Duration = Duration::from_secs(60);

/// Serves HTTP/1.1.
pub(super) struct WebServer {
    routes: Routes,
    access: Access,
    authenticator: Arc<Authenticator>,
    page: Page,
    recording: Option<Bytes>,
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
    /// Unpacks the page of the viewer.
    ///
    /// # Errors
    /// `Fault` when the page that the program contains is damaged.
    pub(super) fn new(
        routes: Routes,
        access: Access,
        authenticator: &Arc<Authenticator>,
        is_serving: Arc<AtomicBool>,
        config: &Config,
    ) -> Result<Self> {
        let mut http1 = http1::Builder::new();
        http1
            .timer(TokioTimer::new())
            .header_read_timeout(config.handshake_timeout)
            .max_headers(MAX_HEADERS)
            .max_header_size(MAX_HEAD_BYTES)
            .max_buf_size(MAX_HEAD_BYTES);
        let websocket_limits = WebSocketLimits::new(config);
        let page = config.viewer_recording.as_ref().map_or_else(Page::viewer, Page::playing)?;
        let recording = config.viewer_recording.as_ref().map(|recording| recording.file.clone());
        let authenticator = Arc::clone(authenticator);
        Ok(Self { routes, access, authenticator, page, recording, is_serving, http1, websocket_limits })
    }

    /// Serves a connection, of which `first_bytes` were read before, until it ends or must be closed.
    pub(super) async fn serve(&self, socket: Socket, first_bytes: Bytes, info: ConnectionInfo, slot: &ConnectionSlot) {
        let on_upgrade = self.serve_request(socket, first_bytes, &info, slot).await;
        let Some(on_upgrade) = on_upgrade else { return };
        let Ok(upgraded) = on_upgrade.await else { return };
        let Ok(parts) = upgraded.downcast::<TokioIo<MeteredSocket<Socket, ()>>>() else { return };
        let socket = parts.io.into_inner().socket;
        let (routes, authenticator) = (self.routes.clone(), Arc::clone(&self.authenticator));
        serve_websocket(socket, parts.read_buf, routes, authenticator, info, slot, self.websocket_limits).await;
    }

    /// Answers one request. Returns the upgrade if it was the handshake of a WebSocket.
    async fn serve_request(
        &self,
        socket: Socket,
        first_bytes: Bytes,
        info: &ConnectionInfo,
        slot: &ConnectionSlot,
    ) -> Option<OnUpgrade> {
        let arrival = Arrival::of(&socket);
        let upgrade = Upgrade::default();
        let service = hyper::service::service_fn(|request| {
            let answer = self.answer(request, info, &arrival, &upgrade);
            async { Ok::<_, Infallible>(answer.await) }
        });
        let io = TokioIo::new(MeteredSocket::new(socket, first_bytes, ()));
        let connection = self.http1.serve_connection(io, service).with_upgrades();
        tokio::select! {
            result = tokio::time::timeout(EXCHANGE_TIMEOUT, connection) => match result {
                Ok(Ok(())) => {}
                Ok(Err(error)) => tracing::debug!(%error, "a connection ended"),
                Err(_) => tracing::debug!("a client has not taken its answer in time"),
            },
            () = slot.retired() => return None,
        }
        lock(&upgrade).take()
    }

    /// Answers a request. Sets `upgrade` if the answer begins a WebSocket.
    async fn answer(
        &self,
        request: Request<Incoming>,
        info: &ConnectionInfo,
        arrival: &Arrival,
        upgrade: &Upgrade,
    ) -> Answer {
        let websocket_origins = match self.access.check_site(request.headers(), arrival) {
            Ok(origins) => origins,
            Err(denied) => return denied_answer(denied),
        };
        match (self.access.path_below_public_url(request.uri().path()), request.method()) {
            ("/", &Method::GET) => self.page_answer(&websocket_origins),
            ("/healthz", &Method::GET) => self.health_answer(),
            ("/recording", &Method::GET) => self.recording_answer(request.headers(), info).await,
            ("/session", &Method::POST) => self.session_answer(request.into_body()).await,
            ("/websocket", &Method::GET) => match websocket_accept_key(request.headers()) {
                Some(key) => {
                    *lock(upgrade) = Some(hyper::upgrade::on(request));
                    websocket_answer(&key)
                }
                None => text_answer(
                    StatusCode::BAD_REQUEST,
                    format!(
                        "expected the handshake of a WebSocket with version 13 and the subprotocol {SUBPROTOCOL}\n"
                    ),
                ),
            },
            ("/session", _) => method_answer("POST"),
            ("/" | "/healthz" | "/recording" | "/websocket", _) => method_answer("GET"),
            _ => text_answer(
                StatusCode::NOT_FOUND,
                "expected the path /, /healthz, /recording, /session or /websocket\n",
            ),
        }
    }

    /// Exchanges the code of a link, which is the body, for the token of a session.
    async fn session_answer(&self, body: Incoming) -> Answer {
        let code = Limited::new(body, MAX_CODE_BYTES).collect().await.map(Collected::to_bytes).unwrap_or_default();
        let sessions = self.authenticator.directory().viewer_sessions();
        match sessions.redeem(&String::from_utf8_lossy(&code)) {
            Ok(Some(session)) => text_answer(StatusCode::OK, session),
            Ok(None) => {
                self.authenticator.delay_wrong_token().await;
                text_answer(StatusCode::FORBIDDEN, "expected the code of a link that is not used yet\n")
            }
            Err(error) => text_answer(StatusCode::INTERNAL_SERVER_ERROR, error.to_string()),
        }
    }

    /// The recording that the page plays, for the bearer of a session.
    async fn recording_answer(&self, headers: &HeaderMap, info: &ConnectionInfo) -> Answer {
        let Some(recording) = &self.recording else {
            return text_answer(StatusCode::NOT_FOUND, "this server has no recording\n");
        };
        let session = bearer_token(headers);
        let is_known = |session| self.authenticator.directory().viewer_sessions().find(session).is_some();
        if info.credential.is_none() && !session.is_some_and(is_known) {
            self.authenticator.delay_wrong_token().await;
            return text_answer(StatusCode::FORBIDDEN, "expected the token of a session of this server\n");
        }
        answer_with(StatusCode::OK, "application/octet-stream", recording.clone())
    }

    fn health_answer(&self) -> Answer {
        match self.is_serving.load(Ordering::Relaxed) {
            true => text_answer(StatusCode::OK, "serving\n"),
            false => text_answer(StatusCode::SERVICE_UNAVAILABLE, "not serving\n"),
        }
    }

    fn page_answer(&self, websocket_origins: &str) -> Answer {
        let mut answer = answer_with(StatusCode::OK, "text/html; charset=utf-8", self.page.body.clone());
        let headers = answer.headers_mut();
        if self.page.is_compressed {
            headers.insert(header::CONTENT_ENCODING, HeaderValue::from_static("gzip"));
        }
        // The hosts were parsed before, so they are valid header values.
        let policy = self.page.policy(websocket_origins, self.authenticator.authentication());
        if let Ok(policy) = HeaderValue::try_from(policy) {
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
    let text = format!("Expected {expected}.\n\nOpen the URL that `modalcast serve` prints as 'viewer at'.\n");
    text_answer(StatusCode::FORBIDDEN, text)
}

fn method_answer(method: &'static str) -> Answer {
    let mut answer = text_answer(StatusCode::METHOD_NOT_ALLOWED, format!("expected the method {method}\n"));
    answer.headers_mut().insert(header::ALLOW, HeaderValue::from_static(method));
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
