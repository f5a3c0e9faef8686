//! Errors of the client. A rejection by the server names the field, the expected value and the received value.

use modalcast_proto::v1;
pub use modalcast_proto::v1::Reason;
use tokio_rustls::rustls::{CertificateError, Error as TlsError, InvalidMessage};
use tonic_types::StatusExt as _;

/// The result type of this crate.
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// Why the server rejected a request or a step.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Rejection {
    /// The number of the rejected step; `None` for other requests.
    pub step: Option<u64>,
    /// `Unspecified` if the server is newer than this client and has sent an unknown reason.
    pub reason: Reason,
    /// Path of the invalid field in the request; empty if no field is invalid.
    pub field: String,
    pub expected: String,
    pub given: String,
}

impl From<v1::Rejection> for Rejection {
    fn from(wire: v1::Rejection) -> Self {
        let reason = wire.reason();
        Self { step: wire.step, reason, field: wire.field, expected: wire.expected, given: wire.given }
    }
}

impl Rejection {
    /// Reads the standard details of an error status. `None` if the status is not from a modalcast server.
    fn from_details(status: &tonic::Status) -> Option<Self> {
        let mut error_info = status.get_details_error_info().filter(|error_info| error_info.domain == "modalcast")?;
        let violations = status.get_details_bad_request().map(|bad_request| bad_request.field_violations);
        let mut metadata = |key| error_info.metadata.remove(key).unwrap_or_default();
        let (expected, given) = (metadata("expected"), metadata("given"));
        Some(Self {
            step: None,
            reason: Reason::from_str_name(&error_info.reason).unwrap_or(Reason::Unspecified),
            field: violations.and_then(|mut list| list.pop()).map_or_else(String::new, |violation| violation.field),
            expected,
            given,
        })
    }
}

impl std::fmt::Display for Rejection {
    fn fmt(&self, out: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        if let Some(step) = self.step {
            write!(out, "step {step}: ")?;
        }
        if !self.field.is_empty() {
            write!(out, "{}: ", self.field)?;
        }
        write!(out, "expected {}, got {}", self.expected, self.given)
    }
}

/// The error type of this crate.
#[derive(Debug, Clone, thiserror::Error)]
pub enum Error {
    /// The connection failed or was lost.
    #[error("{url}: no connection: {reason}")]
    Connect { url: String, reason: String },
    /// The certificate of the server is not accepted: it is of an unknown authority, for another host, or not valid now.
    #[error("{url}: the certificate of the server is not accepted: {reason}")]
    Certificate { url: String, reason: String },
    /// The server has another version of the wire contract than this client, so they cannot communicate.
    #[error("{url}: expected a server of protocol version {client}, got version {server}")]
    ProtocolVersion { url: String, client: u32, server: u32 },
    /// The server rejected a call with a gRPC status. `rejection` is present if the server sent details.
    #[error("rejected ({code:?}): {message}")]
    Status { code: tonic::Code, message: String, rejection: Option<Box<Rejection>> },
    /// The server rejected a step, or the opening of a step stream. A rejected step does not end the stream.
    #[error("rejected: {0}")]
    Rejected(Box<Rejection>),
    /// The reply of the server contradicts itself or the wire contract.
    #[error("malformed reply: {field}: expected {expected}, got {given}")]
    Malformed { field: String, expected: String, given: String },
    /// A stream ended too early.
    #[error("the stream ended before {awaited_reply}")]
    StreamEnded { awaited_reply: &'static str },
    /// A reply did not arrive in time.
    #[error("{awaited_reply} did not arrive within {ms} ms")]
    Deadline { awaited_reply: &'static str, ms: u64 },
    /// A step cannot be encoded as one message, so it was not sent.
    #[error("step {step} cannot be sent: {reason}")]
    Step { step: u64, reason: &'static str },
    /// A local file could not be read or written.
    #[error("{path}: {reason}")]
    File { path: String, reason: String },
}

impl Error {
    /// An error of a local file.
    pub fn file(path: impl AsRef<std::path::Path>, error: impl std::fmt::Display) -> Self {
        Self::File { path: path.as_ref().display().to_string(), reason: error.to_string() }
    }

    /// The rejection by the server, if it sent details.
    pub fn rejection(&self) -> Option<&Rejection> {
        match self {
            Self::Rejected(rejection) => Some(rejection),
            Self::Status { rejection, .. } => rejection.as_deref(),
            _ => None,
        }
    }
}

/// Creates a `Malformed` error: `field` of a reply holds `given` instead of `expected`.
pub(crate) fn malformed_reply(field: impl Into<String>, expected: impl ToString, given: impl ToString) -> Error {
    Error::Malformed { field: field.into(), expected: expected.to_string(), given: given.to_string() }
}

impl Error {
    /// Converts the error of a connection attempt.
    pub(crate) fn of_connection(url: &str, error: &tonic::transport::Error) -> Self {
        let (url, reason) = (url.to_owned(), describe_causes(error));
        match find_tls_error(error) {
            Some(TlsError::InvalidCertificate(CertificateError::UnknownIssuer)) => {
                let remedy = "name the file of its authority by `ConnectOptions::with_ca_file` or MODALCAST_CA_FILE";
                Self::Certificate { url, reason: format!("its authority is unknown; {remedy}") }
            }
            Some(TlsError::InvalidCertificate(error)) => Self::Certificate { url, reason: error.to_string() },
            Some(TlsError::InvalidMessage(InvalidMessage::InvalidContentType)) => {
                Self::Connect { url, reason: "expected TLS, got another protocol; a plain server has http://".into() }
            }
            _ => Self::Connect { url, reason },
        }
    }

    /// Converts the gRPC status of the first call on a connection. A status with a cause is not of the server: the
    /// connection has ended.
    pub(crate) fn of_first_call(status: tonic::Status, url: &str) -> Self {
        match std::error::Error::source(&status) {
            Some(cause) if url.starts_with("https://") => {
                let reason = format!("{}. The server may not accept the client certificate", describe_causes(cause));
                Self::Connect { url: url.to_owned(), reason }
            }
            Some(cause) => {
                let reason = format!("{}. A server that expects TLS has https:// in its URL", describe_causes(cause));
                Self::Connect { url: url.to_owned(), reason }
            }
            None => Self::from_status(status, url),
        }
    }

    /// Converts the gRPC status of a call. `url` is the server's URL.
    pub(crate) fn from_status(status: tonic::Status, url: &str) -> Self {
        if is_connection_lost(&status) {
            return Self::Connect { url: url.to_owned(), reason: describe_causes(&status) };
        }
        let rejection = Rejection::from_details(&status).map(Box::new);
        Self::Status { code: status.code(), message: status.message().to_owned(), rejection }
    }
}

/// Whether the connection failed. The server adds details to every status. A status without them comes from tonic or
/// from a proxy: a broken connection is `Unknown`, `Unavailable` or, after a proxy has reset the stream, `Internal`.
fn is_connection_lost(status: &tonic::Status) -> bool {
    let is_of_server = !status.details().is_empty();
    match status.code() {
        tonic::Code::Unknown | tonic::Code::Internal | tonic::Code::Unavailable => !is_of_server,
        _ => false,
    }
}

/// The error of TLS among the causes of an error.
fn find_tls_error<'a>(error: &'a (dyn std::error::Error + 'static)) -> Option<&'a TlsError> {
    std::iter::successors(Some(error), |error| error.source()).find_map(|cause| {
        // The source of an I/O error is not the error inside, but the source of that one.
        let inner = cause.downcast_ref::<std::io::Error>().and_then(std::io::Error::get_ref);
        inner.and_then(|inner| inner.downcast_ref()).or_else(|| cause.downcast_ref())
    })
}

/// Joins the messages of an error and its causes, because tonic's own message is only "transport error".
pub(crate) fn describe_causes(error: &dyn std::error::Error) -> String {
    let causes = std::iter::successors(Some(error), |error| error.source());
    causes.map(ToString::to_string).collect::<Vec<_>>().join(": ")
}

#[cfg(test)]
mod tests {
    use std::collections::HashMap;

    use tonic_types::ErrorDetails;

    use super::*;

    #[test]
    fn only_valid_status_details_become_a_rejection() {
        let details = |domain: &str| {
            let texts = [("expected", "80 bytes"), ("given", "79 bytes")];
            let metadata: HashMap<String, String> =
                texts.iter().map(|(key, text)| ((*key).to_owned(), (*text).to_owned())).collect();
            let mut details = ErrorDetails::with_error_info("REASON_INVALID_FIELD", domain, metadata);
            details.add_bad_request_violation("q", "wrong length");
            tonic::Status::with_error_details(tonic::Code::InvalidArgument, "no", details)
        };
        let error = Error::from_status(details("modalcast"), "server:1");
        let rejection = error.rejection().expect("expected a rejection");
        assert_eq!(
            (rejection.reason, rejection.to_string().as_str()),
            (Reason::InvalidField, "q: expected 80 bytes, got 79 bytes")
        );
        assert_eq!(Error::from_status(details("other.service"), "server:1").rejection(), None);
        let invalid_details = tonic::Status::with_details(tonic::Code::Internal, "no", vec![0xff; 3].into());
        assert_eq!(Error::from_status(invalid_details, "server:1").rejection(), None);
        assert_eq!(Error::from_status(tonic::Status::not_found("scene"), "server:1").rejection(), None);
    }

    /// A proxy ends streams with `INTERNAL` when it resets them.
    #[test]
    fn only_transport_errors_without_details_are_a_lost_connection() {
        use tonic::Code;
        let is_lost = |status| matches!(Error::from_status(status, "server:1"), Error::Connect { .. });
        let lost = [Code::Unavailable, Code::Unknown, Code::Internal];
        for code in lost {
            assert!(is_lost(tonic::Status::new(code, "reset")), "{code:?}");
            let details = ErrorDetails::with_error_info("REASON_INTERNAL", "modalcast", HashMap::new());
            assert!(!is_lost(tonic::Status::with_error_details(code, "fault", details)), "{code:?}");
        }
        // Local deadlines, cancellations and size limits.
        for code in [Code::DeadlineExceeded, Code::Cancelled, Code::OutOfRange, Code::ResourceExhausted] {
            assert!(!is_lost(tonic::Status::new(code, "local")), "{code:?}");
        }
    }
}
