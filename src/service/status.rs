//! Converts errors to gRPC statuses and to rejections. One match without a wildcard selects the status code. The
//! details of a status are the serialized `Rejection` that a step stream would send.

use modalcast_proto::v1::Rejection;
use prost::Message as _;
use tonic::{Code, Status};

use modalcast_model::error::Error;

/// Limit in characters on each text of a rejection. Clients control parts of the text, and it is sent in headers or
/// between steps.
const MAX_TEXT_CHARS: usize = 512;

fn truncate(text: String) -> String {
    match text.char_indices().nth(MAX_TEXT_CHARS) {
        None => text,
        Some((end, _)) => format!("{}...", &text[..end]),
    }
}

/// Converts an error to a rejection: field, expected, given. `step` is the number of the rejected step, if any.
pub(super) fn rejection(step: Option<u64>, error: &Error) -> Rejection {
    let (field, expected, given) = match error.clone() {
        Error::Invalid { field, expected, given } => (field, expected, given),
        Error::NotFound { what, given } => (what.into(), format!("a {what} that is there"), given),
        Error::Taken { what, holder } => (what.into(), "nobody there".into(), holder),
        Error::Gone { what, expected, given } => (what.into(), expected, given),
        Error::Busy { queue, limit } => (queue.into(), format!("at most {limit}"), "more".into()),
        Error::Deadline { what, ms } => (what, format!("within {ms} ms"), "later".into()),
        Error::Unavailable { what, reason, remedy } => (what.into(), remedy, reason),
        Error::Fault { stage, reason } => (stage.into(), "success".into(), reason),
        Error::DeviceLost { stage, reason } => (stage.into(), "a restart of the server".into(), reason),
    };
    Rejection { step, field: truncate(field), expected: truncate(expected), given: truncate(given) }
}

/// Converts an error to a gRPC status.
pub(super) fn status(error: Error) -> Status {
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
    let details = rejection(None, &error);
    Status::with_details(code, truncate(error.to_string()), details.encode_to_vec().into())
}

/// Converts a transport error of a client's stream. Tonic reports a message over the size limit as `OUT_OF_RANGE`; it
/// becomes `RESOURCE_EXHAUSTED`, as in other gRPC implementations.
pub(super) fn transport_status(fault: Status, limit: usize) -> Status {
    if fault.code() != Code::OutOfRange {
        return fault;
    }
    let details = Rejection {
        step: None,
        field: "message".into(),
        expected: format!("at most {limit} bytes"),
        given: fault.message().into(),
    };
    Status::with_details(Code::ResourceExhausted, fault.message(), details.encode_to_vec().into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_status_carries_the_rejection_and_stays_small() {
        let error = modalcast_model::error::invalid("step.q", "8 bytes", "x".repeat(100_000));
        let status = status(error);
        assert_eq!(status.code(), Code::InvalidArgument);
        let details = Rejection::decode(status.details()).expect("a rejection");
        assert_eq!((details.field.as_str(), details.expected.as_str()), ("step.q", "8 bytes"));
        assert!(status.message().len() + status.details().len() < 4096);
    }
}
