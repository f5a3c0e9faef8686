//! A call over a WebSocket. It becomes a gRPC call in this process, so that services, budgets and errors are those of
//! gRPC.

use std::sync::Arc;
use std::sync::atomic::{AtomicI64, Ordering};
use std::time::Duration;

use bytes::Bytes;
use prost::Message as _;
use tokio::sync::{Notify, OwnedSemaphorePermit, Semaphore, mpsc};
use tonic::Status;
use tonic::body::Body;
use tonic::codegen::http::{HeaderValue, Method, Request, Uri, header};

use super::super::connection::ConnectionInfo;
use super::super::routes::Routes;
use super::client_messages::{ClientBody, ClientMessages};
use super::envelope::{CallHead, ServerKind};
use super::outgoing::{Outgoing, OutgoingMessage};
use super::reply_messages::{Reply, ReplyMessages};

/// Bytes of replies that the server may send before the client has processed any.
const INITIAL_CREDIT: i64 = 4 << 20;

/// Bytes of replies of one call that wait for the socket. A larger message waits alone.
const MAX_IN_FLIGHT_BYTES: usize = 1 << 20;

/// The largest number of a `grpc-timeout` header, which has eight digits.
const MAX_TIMEOUT_VALUE: u64 = 99_999_999;

/// Bytes of replies that the client accepts.
#[derive(Debug)]
pub(super) struct ReplyCredit {
    bytes: AtomicI64,
    added: Notify,
}

impl ReplyCredit {
    pub(super) fn new() -> Arc<Self> {
        Arc::new(Self { bytes: AtomicI64::new(INITIAL_CREDIT), added: Notify::new() })
    }

    /// Adds bytes that the client has processed.
    pub(super) fn add(&self, bytes: u32) {
        self.bytes.fetch_add(bytes.into(), Ordering::AcqRel);
        self.added.notify_one();
    }

    /// Waits until the client accepts more bytes. Cancel-safe.
    async fn available(&self) {
        while self.bytes.load(Ordering::Acquire) <= 0 {
            self.added.notified().await;
        }
    }

    fn subtract(&self, bytes: usize) {
        self.bytes.fetch_sub(bytes as i64, Ordering::AcqRel);
    }
}

/// A call that was started.
pub(super) struct Call {
    pub(super) id: u32,
    pub(super) head: CallHead,
    pub(super) messages: Arc<ClientMessages>,
    pub(super) credit: Arc<ReplyCredit>,
    pub(super) outgoing: mpsc::Sender<Outgoing>,
    /// Counts the call among those of its connection.
    pub(super) permit: OwnedSemaphorePermit,
}

impl Call {
    /// Runs the call until its status is queued. Dropping the future cancels the call.
    pub(super) async fn run(self, routes: Routes, connection: ConnectionInfo) {
        let Self { id, head, messages, credit, outgoing, permit } = self;
        let request = to_request(head, ClientBody(Arc::clone(&messages)), connection);
        let reply = async {
            // Infallible.
            let Ok(response) = routes.call(request).await;
            send_replies(id, ReplyMessages::new(response), &credit, &outgoing).await
        };
        let status = tokio::select! {
            status = reply => status,
            () = return_credit(id, &messages, &outgoing) => return,
        };
        // The client may start another call as soon as it has the status.
        drop(permit);
        outgoing.send(status_message(id, &status)).await.ok();
    }
}

/// Sends the replies of a call and returns its status. A reply is taken from the service only while there is credit.
async fn send_replies(
    id: u32,
    mut replies: ReplyMessages,
    credit: &ReplyCredit,
    outgoing: &mpsc::Sender<Outgoing>,
) -> Status {
    let in_flight = Arc::new(Semaphore::new(MAX_IN_FLIGHT_BYTES));
    loop {
        credit.available().await;
        let pieces = match replies.next().await {
            Reply::Message(pieces) => pieces,
            Reply::End(status) => return status,
        };
        let bytes = pieces.iter().map(Bytes::len).sum();
        let permits = MAX_IN_FLIGHT_BYTES.min(bytes) as u32;
        let in_flight = Arc::clone(&in_flight).acquire_many_owned(permits).await.ok();
        credit.subtract(bytes);
        let message = OutgoingMessage { id, kind: ServerKind::Message, pieces, _in_flight: in_flight };
        if outgoing.send(Outgoing::Message(message)).await.is_err() {
            return Status::cancelled("the client has disconnected");
        }
    }
}

/// Returns credit for the messages that the service takes. Ends when the connection ends.
async fn return_credit(id: u32, messages: &ClientMessages, outgoing: &mpsc::Sender<Outgoing>) {
    loop {
        let bytes = messages.returned_credit().await;
        let pieces = vec![Bytes::copy_from_slice(&bytes.to_le_bytes())];
        let message = OutgoingMessage { id, kind: ServerKind::Credit, pieces, _in_flight: None };
        if outgoing.send(Outgoing::Message(message)).await.is_err() {
            return;
        }
    }
}

fn to_request(head: CallHead, body: ClientBody, connection: ConnectionInfo) -> Request<Body> {
    let mut request = Request::new(Body::new(body));
    *request.method_mut() = Method::POST;
    *request.uri_mut() = Uri::from(head.path);
    let headers = request.headers_mut();
    headers.insert(header::CONTENT_TYPE, HeaderValue::from_static("application/grpc"));
    headers.insert(header::TE, HeaderValue::from_static("trailers"));
    if let Some(timeout) = head.timeout.and_then(|timeout| HeaderValue::try_from(timeout_text(timeout)).ok()) {
        headers.insert("grpc-timeout", timeout);
    }
    request.extensions_mut().insert(connection);
    request
}

/// A timeout as in the `grpc-timeout` header.
fn timeout_text(timeout: Duration) -> String {
    let ms = timeout.as_millis() as u64;
    if ms <= MAX_TIMEOUT_VALUE { format!("{ms}m") } else { format!("{}S", timeout.as_secs()) }
}

/// The message that ends a call.
pub(super) fn status_message(id: u32, status: &Status) -> Outgoing {
    let pieces = vec![encode_status(status)];
    Outgoing::Message(OutgoingMessage { id, kind: ServerKind::Status, pieces, _in_flight: None })
}

/// A status as `google.rpc.Status`. The details of a gRPC status are already encoded so.
fn encode_status(status: &Status) -> Bytes {
    if !status.details().is_empty() {
        return Bytes::copy_from_slice(status.details());
    }
    let (code, message) = (status.code() as i32, status.message().to_owned());
    tonic_types::Status { code, message, details: Vec::new() }.encode_to_vec().into()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::service::status::to_status;

    #[test]
    fn status_has_code_message_and_details() {
        let status = to_status(modalcast_model::error::invalid("q", "2 numbers", 3));
        let decoded = tonic_types::Status::decode(encode_status(&status)).expect("expected a status");
        assert_eq!((decoded.code, decoded.message.as_str()), (3, status.message()));
        assert_eq!(decoded.details.len(), 2);
        let decoded = tonic_types::Status::decode(encode_status(&Status::ok(""))).expect("expected a status");
        assert_eq!(decoded, tonic_types::Status::default());
    }

    #[test]
    fn timeout_has_at_most_eight_digits() {
        assert_eq!(timeout_text(Duration::from_millis(1)), "1m");
        assert_eq!(timeout_text(Duration::from_millis(99_999_999)), "99999999m");
        assert_eq!(timeout_text(Duration::from_millis(u32::MAX.into())), "4294967S");
    }

    #[tokio::test]
    async fn credit_is_available_while_it_is_positive() {
        let credit = ReplyCredit::new();
        credit.available().await;
        credit.subtract((4 << 20) + 10);
        let is_available = async || tokio::time::timeout(Duration::ZERO, credit.available()).await.is_ok();
        assert!(!is_available().await);
        credit.add(10);
        assert!(!is_available().await);
        credit.add(1);
        assert!(is_available().await);
        credit.add(u32::MAX);
        assert!(is_available().await);
    }
}
