//! Health, readiness and metrics in HTTP/1.1, for supervisors and Prometheus. They have a listener of their own, so that
//! clients of the other listeners do not delay them. Requests need no credential, and change nothing.

mod metrics;

use std::convert::Infallible;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use bytes::Bytes;
use http_body_util::Full;
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use prometheus_client::metrics::counter::Counter;
use tokio::sync::Semaphore;
use tonic::codegen::http::header::{self, HeaderValue};
use tonic::codegen::http::{Method, Request, Response, StatusCode};

use self::metrics::Metrics;
use super::accept::ACCEPT_RETRY_DELAY;
use super::connection_gauges::ConnectionGauges;
use super::listen::{ListeningSockets, Socket};
use crate::engine::Engine;

/// Limit on the connections at a time. Further ones wait in the queue of the socket.
const MAX_CONNECTIONS: usize = 16;

/// Time in which a client must send its request and take the answer.
const EXCHANGE_TIMEOUT: Duration = Duration::from_secs(5);

/// Limit on the head of a request in bytes.
const MAX_HEAD_BYTES: usize = 16 << 10;

const PLAIN_TEXT: &str = "text/plain; charset=utf-8";
const METRICS: &str = "text/plain; version=0.0.4; charset=utf-8";

/// Answers requests for health, readiness and metrics.
pub(super) struct AdminServer {
    engine: Engine,
    /// Whether the device works and the server does not shut down.
    is_serving: Arc<AtomicBool>,
    metrics: Metrics,
    http1: http1::Builder,
}

/// Status, media type and text of an answer.
type Answer = (StatusCode, &'static str, String);

impl AdminServer {
    /// `auth_failures` counts rejected calls.
    pub(super) fn new(
        engine: Engine,
        is_serving: Arc<AtomicBool>,
        connections: &ConnectionGauges,
        auth_failures: Counter,
    ) -> Arc<Self> {
        let mut http1 = http1::Builder::new();
        http1.timer(TokioTimer::new()).header_read_timeout(EXCHANGE_TIMEOUT);
        http1.keep_alive(false).max_buf_size(MAX_HEAD_BYTES);
        let metrics = Metrics::new(engine.clone(), connections, auth_failures);
        Arc::new(Self { engine, is_serving, metrics, http1 })
    }

    /// Accepts connections until this future is dropped.
    pub(super) async fn accept_connections(self: Arc<Self>, sockets: ListeningSockets) {
        let permits = Arc::new(Semaphore::new(MAX_CONNECTIONS));
        // Nothing closes the semaphore.
        while let Ok(permit) = Arc::clone(&permits).acquire_owned().await {
            match sockets.accept().await {
                Ok((socket, _)) => {
                    let server = Arc::clone(&self);
                    tokio::spawn(async move {
                        server.serve(socket).await;
                        drop(permit);
                    });
                }
                Err(error) => {
                    tracing::warn!(%error, "a connection for health and metrics could not be accepted");
                    tokio::time::sleep(ACCEPT_RETRY_DELAY).await;
                }
            }
        }
    }

    /// Answers one request.
    async fn serve(&self, socket: Socket) {
        let service = hyper::service::service_fn(|request: Request<hyper::body::Incoming>| {
            let (status, media_type, text) = self.answer(request.method(), request.uri().path());
            async move { Ok::<_, Infallible>(response(status, media_type, text)) }
        });
        let connection = self.http1.serve_connection(TokioIo::new(socket), service);
        if let Ok(Err(error)) = tokio::time::timeout(EXCHANGE_TIMEOUT, connection).await {
            tracing::debug!(%error, "a connection for health and metrics ended");
        }
    }

    fn answer(&self, method: &Method, path: &str) -> Answer {
        if method != Method::GET {
            return (StatusCode::METHOD_NOT_ALLOWED, PLAIN_TEXT, "expected GET\n".into());
        }
        match path {
            "/healthz" => (StatusCode::OK, PLAIN_TEXT, "alive\n".into()),
            "/readyz" => self.readiness(),
            "/metrics" => match self.metrics.render() {
                Ok(text) => (StatusCode::OK, METRICS, text),
                Err(error) => (StatusCode::INTERNAL_SERVER_ERROR, PLAIN_TEXT, format!("{error}\n")),
            },
            _ => (StatusCode::NOT_FOUND, PLAIN_TEXT, "expected the path /healthz, /readyz or /metrics\n".into()),
        }
    }

    /// Ready when the device works, and every scene of the last run is open or has failed.
    fn readiness(&self) -> Answer {
        let not_ready = |reason: &str| (StatusCode::SERVICE_UNAVAILABLE, PLAIN_TEXT, format!("not ready: {reason}\n"));
        if !self.is_serving.load(Ordering::Relaxed) {
            return not_ready("the device does not work, or the server is shutting down");
        }
        match *self.engine.watch_reopening().borrow() {
            true => (StatusCode::OK, PLAIN_TEXT, "ready\n".into()),
            false => not_ready("the scenes of the last run are being opened"),
        }
    }
}

fn response(status: StatusCode, media_type: &'static str, text: String) -> Response<Full<Bytes>> {
    let mut response = Response::new(Full::from(text));
    *response.status_mut() = status;
    let headers = response.headers_mut();
    headers.insert(header::CONTENT_TYPE, HeaderValue::from_static(media_type));
    headers.insert(header::X_CONTENT_TYPE_OPTIONS, HeaderValue::from_static("nosniff"));
    headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-store"));
    response
}
