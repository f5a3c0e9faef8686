//! Converts errors to gRPC statuses and to rejections. The details of a status contain the serialized `Rejection` of
//! the same error.

use modalcast_proto::v1::Rejection;
use prost::Message as _;
use tonic::{Code, Status};

use modalcast_model::error::Error;

/// Limit in characters on each text of a rejection. Clients control parts of the text, and statuses are sent in HTTP/2
/// headers.
const MAX_TEXT_CHARS: usize = 512;

fn truncate_text(text: String) -> String {
    match text.char_indices().nth(MAX_TEXT_CHARS) {
        None => text,
        Some((end, _)) => format!("{}...", &text[..end]),
    }
}

/// Converts an error to a rejection. `step` is the number of the rejected step, if any.
pub(super) fn to_rejection(step: Option<u64>, error: &Error) -> Rejection {
    let (field, expected, given) = match error.clone() {
        Error::Invalid { field, expected, given } => (field, expected, given),
        Error::NotFound { what, given } => (what.into(), format!("an existing {what}"), given),
        Error::Taken { what, holder } => (what.into(), format!("a free {what}"), holder),
        Error::Gone { what, expected, given } => (what.into(), expected, given),
        Error::Busy { queue, limit } => (queue.into(), format!("at most {limit}"), "one more".into()),
        Error::Deadline { what, ms } => (what, format!("completion within {ms} ms"), "no completion in time".into()),
        Error::Unavailable { what, reason, remedy } => (what.into(), remedy, reason),
        Error::Fault { stage, reason } => (stage.into(), "no internal error".into(), reason),
        Error::DeviceLost { stage, reason } => (stage.into(), "a restart of the server".into(), reason),
    };
    Rejection { step, field: truncate_text(field), expected: truncate_text(expected), given: truncate_text(given) }
}

/// Converts an error to a gRPC status.
pub(super) fn to_status(error: Error) -> Status {
    // No wildcard, so that a new error variant requires a decision here.
    let code = match error {
        Error::Invalid { .. } => Code::InvalidArgument,
        Error::NotFound { .. } => Code::NotFound,
        Error::Taken { .. } => Code::AlreadyExists,
        Error::Gone { .. } => Code::FailedPrecondition,
        Error::Busy { .. } => Code::ResourceExhausted,
        Error::Deadline { .. } => Code::DeadlineExceeded,
        Error::Unavailable { .. } | Error::DeviceLost { .. } => Code::Unavailable,
        Error::Fault { .. } => Code::Internal,
    };
    let details = to_rejection(None, &error);
    Status::with_details(code, truncate_text(error.to_string()), details.encode_to_vec().into())
}

/// Converts a transport error of a client's stream. Tonic reports a message over the size limit as `OUT_OF_RANGE`.
/// Other gRPC implementations report `RESOURCE_EXHAUSTED`, and so does this server.
pub(super) fn transport_status(stream_status: Status, max_message_bytes: usize) -> Status {
    if stream_status.code() != Code::OutOfRange {
        return stream_status;
    }
    let details = Rejection {
        step: None,
        field: "message".into(),
        expected: format!("at most {max_message_bytes} bytes"),
        given: stream_status.message().into(),
    };
    Status::with_details(Code::ResourceExhausted, stream_status.message(), details.encode_to_vec().into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn status_contains_the_rejection_and_is_small() {
        let error = modalcast_model::error::invalid("step.q", "8 bytes", "x".repeat(100_000));
        let status = to_status(error);
        assert_eq!(status.code(), Code::InvalidArgument);
        let details = Rejection::decode(status.details()).expect("expected a rejection");
        assert_eq!((details.field.as_str(), details.expected.as_str()), ("step.q", "8 bytes"));
        assert!(status.message().len() + status.details().len() < 4096);
    }
}
