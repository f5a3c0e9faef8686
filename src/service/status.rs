//! Converts errors to gRPC statuses with the details of `google.rpc`, and to rejections on streams. Both carry the same
//! reason, field and texts.

use std::collections::HashMap;
use std::time::Duration;

use modalcast_proto::v1::{Reason, Rejection};
use tonic::{Code, Status};
use tonic_types::{ErrorDetails, StatusExt as _};

use modalcast_model::error::{Error, StepNumber, fault};
use modalcast_model::escaping::escape_controls;

/// Limit in characters on each text of a rejection. Clients control parts of the text, and statuses are sent in HTTP/2
/// headers.
const MAX_TEXT_CHARS: usize = 256;

/// `ErrorInfo.domain` of all errors of this server.
const ERROR_DOMAIN: &str = "modalcast";

/// `RetryInfo` of a full queue. The queues of a scene are emptied at every step or frame.
const QUEUE_RETRY_DELAY: Duration = Duration::from_millis(100);

/// `RetryInfo` while the server shuts down, which includes the time of a restart.
const RESTART_RETRY_DELAY: Duration = Duration::from_secs(5);

/// `RetryInfo` while the renderer is opened again.
const RENDERER_RETRY_DELAY: Duration = Duration::from_secs(1);

/// The text as clients receive it: escaped, and of limited length.
fn display_text(text: String) -> String {
    let text = escape_controls(&text).into_owned();
    match text.char_indices().nth(MAX_TEXT_CHARS) {
        None => text,
        Some((end, _)) => format!("{}...", &text[..end]),
    }
}

/// Everything that a client learns about an error.
struct ErrorReport {
    code: Code,
    reason: Reason,
    /// Path of the invalid field. Empty if no field is invalid.
    field: String,
    expected: String,
    given: String,
    /// Metadata besides `expected` and `given`; the comment of the reason in `errors.proto` names the keys.
    metadata: Vec<(&'static str, String)>,
    retry_delay: Option<Duration>,
}

impl ErrorReport {
    fn new(code: Code, reason: Reason, expected: impl Into<String>, given: impl Into<String>) -> Self {
        let (expected, given) = (expected.into(), given.into());
        Self { code, reason, field: String::new(), expected, given, metadata: Vec::new(), retry_delay: None }
    }

    fn with_field(self, field: impl Into<String>) -> Self {
        Self { field: field.into(), ..self }
    }

    fn with_retry_delay(self, delay: Duration) -> Self {
        Self { retry_delay: Some(delay), ..self }
    }

    fn with_metadata<const N: usize>(self, metadata: [(&'static str, String); N]) -> Self {
        Self { metadata: metadata.into(), ..self }
    }

    fn of(error: &Error) -> Self {
        // No wildcard, so that a new error variant requires a decision here.
        match error.clone() {
            Error::Invalid { field, expected, given } => {
                Self::new(Code::InvalidArgument, Reason::InvalidField, expected, given).with_field(field)
            }
            Error::InvalidFile { location, expected, given } => {
                Self::new(Code::InvalidArgument, Reason::InvalidFile, expected, given)
                    .with_metadata([("location", location)])
            }
            Error::UnexpectedMessage { expected, given } => {
                Self::new(Code::InvalidArgument, Reason::UnexpectedMessage, expected, given)
            }
            Error::NotFound { what, given } => {
                Self::new(Code::NotFound, Reason::SceneNotFound, format!("an existing {what}"), given)
            }
            Error::ContentNotFound { field, what, sha256 } => {
                let expected = format!("the SHA-256 of an existing {what}");
                Self::new(Code::NotFound, Reason::ContentNotFound, expected, sha256).with_field(field)
            }
            Error::StreamNotFound => {
                Self::new(Code::NotFound, Reason::StreamNotFound, "the id of a running frame stream", "another id")
            }
            Error::NameTaken { name, owner } => {
                let given = format!("'{name}', which belongs to '{owner}'");
                Self::new(Code::AlreadyExists, Reason::SceneNameTaken, "a free scene name", given)
            }
            Error::NotPermitted { expected, given } => {
                Self::new(Code::PermissionDenied, Reason::PermissionDenied, expected, given)
            }
            Error::LeaseTaken { run, seconds } => {
                let given = format!("the lease of run {run}, held for {seconds} s");
                Self::new(Code::AlreadyExists, Reason::WriterLeaseTaken, "a free writer lease", given)
            }
            Error::LeaseLost { run } => Self::lease_lost(run),
            Error::StepPassed { field, expected, given } => {
                Self::new(Code::FailedPrecondition, Reason::StepPassed, expected, given).with_field(field)
            }
            exhausted @ (Error::WindowFull { .. }
            | Error::Busy { .. }
            | Error::LimitReached { .. }
            | Error::Preempted { .. }
            | Error::ClientEnded
            | Error::OutOfMemory { .. }
            | Error::SlowReader { .. }
            | Error::SlowSubscriber { .. }) => Self::of_exhausted(exhausted),
            Error::Deadline { what, ms } => {
                let expected = format!("{what} within {ms} ms");
                Self::new(Code::DeadlineExceeded, Reason::DeadlineExpired, expected, "no reply in time")
            }
            Error::Unavailable { what, reason, remedy } => {
                Self::new(Code::Unavailable, Reason::ResourceMissing, what, reason).with_metadata([("remedy", remedy)])
            }
            Error::ShuttingDown => Self::new(Code::Unavailable, Reason::ShuttingDown, "a running server", "a shutdown")
                .with_retry_delay(RESTART_RETRY_DELAY),
            Error::RendererLost { stage, reason } => {
                let given = format!("{stage}: {reason}");
                Self::new(Code::Unavailable, Reason::DeviceLost, "a renderer that is open again", given)
                    .with_retry_delay(RENDERER_RETRY_DELAY)
            }
            Error::DeviceLost { stage, reason } => {
                let given = format!("{stage}: {reason}");
                Self::new(Code::Unavailable, Reason::DeviceLost, "a restart of the server", given)
            }
            Error::Fault { stage, reason } => {
                Self::new(Code::Internal, Reason::Internal, "no internal error", format!("{stage}: {reason}"))
            }
        }
    }

    /// The report of an error with the code `RESOURCE_EXHAUSTED`.
    fn of_exhausted(error: Error) -> Self {
        match error {
            Error::WindowFull { limit, given } => {
                let expected = format!("at most {limit} steps without acknowledgment");
                Self::new(Code::ResourceExhausted, Reason::WindowFull, expected, given.to_string())
            }
            Error::Busy { queue, limit } => {
                Self::new(Code::ResourceExhausted, Reason::QueueFull, "capacity", "a full queue")
                    .with_metadata([("queue", queue.into()), ("limit", limit.to_string())])
                    .with_retry_delay(QUEUE_RETRY_DELAY)
            }
            Error::LimitReached { objects, limit } => {
                let expected = format!("at most {limit} {objects}");
                Self::new(Code::ResourceExhausted, Reason::LimitReached, expected, "one more")
                    .with_metadata([("object", objects.into()), ("limit", limit.to_string())])
            }
            Error::Preempted { objects, held, limit } => {
                let expected = format!("at most {limit} {objects}, shared with other clients");
                let given = format!("{held} of this client, and another client that holds less");
                Self::new(Code::ResourceExhausted, Reason::Preempted, expected, given).with_metadata([
                    ("object", objects.into()),
                    ("held", held.to_string()),
                    ("limit", limit.to_string()),
                ])
            }
            Error::ClientEnded => {
                let (expected, given) = ("a client that is not ended", "one that an administrator has ended");
                Self::new(Code::ResourceExhausted, Reason::EndedByAdministrator, expected, given)
            }
            Error::OutOfMemory { object, memory, asked, available, total } => {
                let expected = format!("at most {available} bytes of the {memory}");
                let given = format!("{asked} bytes for {object}");
                Self::new(Code::ResourceExhausted, Reason::OutOfMemory, expected, given).with_metadata([
                    ("object", object),
                    ("memory", memory.into()),
                    ("asked", asked.to_string()),
                    ("available", available.to_string()),
                    ("total", total.to_string()),
                ])
            }
            Error::SlowReader { queue, limit } => {
                let expected = "a client that reads its replies";
                Self::new(Code::ResourceExhausted, Reason::SlowReader, expected, "a full queue")
                    .with_metadata([("queue", queue.into()), ("limit", limit.to_string())])
            }
            Error::SlowSubscriber { received, missing } => Self::of_slow_subscriber(received, missing),
            other => Self::new(Code::Internal, Reason::Internal, "an exhausted resource", other.to_string()),
        }
    }

    /// The report of an error that ends a lossless stream.
    fn of_slow_subscriber(received: Option<StepNumber>, missing: StepNumber) -> Self {
        let expected = "a client that reads about as fast as the writer sends steps";
        let given = "a client for which the writer has waited too long";
        let mut metadata = vec![("missing_run", missing.run.to_string()), ("missing_step", missing.number.to_string())];
        if let Some(StepNumber { run, number }) = received {
            metadata.extend([("received_run", run.to_string()), ("received_step", number.to_string())]);
        }
        Self { metadata, ..Self::new(Code::ResourceExhausted, Reason::SlowReader, expected, given) }
    }

    fn lease_lost(run: u64) -> Self {
        let given = format!("the lease of run {run}");
        Self::new(Code::Aborted, Reason::LeaseLost, "the lease of this stream", given)
    }

    fn into_status(self, message: String) -> Status {
        let texts = [("expected", self.expected), ("given", self.given)].into_iter().chain(self.metadata);
        let metadata: HashMap<String, String> = texts.map(|(key, text)| (key.to_owned(), display_text(text))).collect();
        let mut details = ErrorDetails::with_error_info(self.reason.as_str_name(), ERROR_DOMAIN, metadata);
        let message = display_text(message);
        if !self.field.is_empty() {
            details.add_bad_request_violation(display_text(self.field), message.clone());
        }
        if let Some(delay) = self.retry_delay {
            details.set_retry_info(Some(delay));
        }
        Status::with_error_details(self.code, message, details)
    }
}

/// Converts an error to a rejection on a stream. `step` is the number of the rejected step, if any.
pub(super) fn to_rejection(step: Option<u64>, error: &Error) -> Rejection {
    let ErrorReport { reason, field, expected, given, .. } = ErrorReport::of(error);
    let place = match error {
        Error::InvalidFile { location, .. } => location.clone(),
        _ => field,
    };
    Rejection {
        step,
        reason: reason.into(),
        field: display_text(place),
        expected: display_text(expected),
        given: display_text(given),
    }
}

/// Converts an error to a gRPC status.
pub(super) fn to_status(error: Error) -> Status {
    ErrorReport::of(&error).into_status(error.to_string())
}

/// Converts a transport error of a client's stream. Tonic reports a message over the size limit as `OUT_OF_RANGE`.
/// Other gRPC implementations report `RESOURCE_EXHAUSTED`, and so does this server.
pub(super) fn transport_status(stream_status: Status, max_message_bytes: usize) -> Status {
    if stream_status.code() != Code::OutOfRange {
        return stream_status;
    }
    let expected = format!("at most {max_message_bytes} bytes");
    ErrorReport::new(Code::ResourceExhausted, Reason::MessageTooLarge, expected, stream_status.message())
        .into_status(stream_status.message().to_owned())
}

/// The status of a fault of the server itself.
pub(super) fn internal_fault(reason: impl ToString) -> Status {
    to_status(fault("call", reason))
}

/// The status of a call to a method that the server does not have, as gRPC defines it.
pub(super) fn unknown_method() -> Status {
    Status::unimplemented("expected the path of a method of this server")
}

/// The status of a call without a valid credential.
pub(super) fn unauthenticated(expected: &str, given: &str) -> Status {
    ErrorReport::new(Code::Unauthenticated, Reason::Unauthenticated, expected, given)
        .into_status(format!("credential: expected {expected}, got {given}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn status_names_field_and_reason_and_fits_into_a_header() {
        let error = modalcast_model::error::invalid("step.q", "8 bytes", "x".repeat(100_000));
        let rejection = to_rejection(Some(7), &error);
        let status = to_status(error);
        assert_eq!(status.code(), Code::InvalidArgument);
        let error_info = status.get_details_error_info().expect("expected an ErrorInfo");
        assert_eq!((error_info.reason.as_str(), error_info.domain.as_str()), ("REASON_INVALID_FIELD", "modalcast"));
        assert_eq!(error_info.metadata["expected"], "8 bytes");
        let bad_request = status.get_details_bad_request().expect("expected a BadRequest");
        assert_eq!(bad_request.field_violations[0].field, "step.q");
        assert!(status.get_details_retry_info().is_none());
        assert!(status.message().len() + status.details().len() < 4096);
        assert_eq!((rejection.step, rejection.reason()), (Some(7), Reason::InvalidField));
        assert_eq!((rejection.field.as_str(), &rejection.given), ("step.q", &error_info.metadata["given"]));
    }

    /// A client can put such characters into a name, and another one reads it in a terminal.
    #[test]
    fn controls_in_texts_of_clients_are_escaped() {
        let error = modalcast_model::error::invalid("a\u{1b}[2J", "b", "c\u{202e}\n");
        let rejection = to_rejection(None, &error);
        let status = to_status(error);
        assert_eq!(status.message(), r"a\u{1b}[2J: expected b, got c\u{202e}\n");
        assert_eq!((rejection.field.as_str(), rejection.given.as_str()), (r"a\u{1b}[2J", r"c\u{202e}\n"));
    }

    #[test]
    fn only_errors_that_a_retry_can_mend_have_a_retry_delay() {
        let delay = |error| to_status(error).get_details_retry_info().and_then(|info| info.retry_delay);
        assert_eq!(delay(Error::Busy { queue: "device", limit: 4 }), Some(QUEUE_RETRY_DELAY));
        assert_eq!(delay(Error::ShuttingDown), Some(RESTART_RETRY_DELAY));
        assert_eq!(delay(Error::LimitReached { objects: "open scenes", limit: 4 }), None);
        assert_eq!(delay(Error::NotFound { what: "scene", given: "'a'".into() }), None);
    }
}
