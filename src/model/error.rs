//! The error type of the server's crates. The variants distinguish what the caller can correct or retry, what the
//! operator must repair, and failures of the server itself. Each variant contains the values that are needed to act on
//! the error.

/// The error type of the server.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Error {
    /// The caller sent an invalid value.
    #[error("{field}: expected {expected}, got {given}")]
    Invalid { field: String, expected: String, given: String },
    /// The caller named an object that does not exist.
    #[error("{what} not found: {given}")]
    NotFound { what: &'static str, given: String },
    /// Another client uses the resource. A later attempt may succeed.
    #[error("{what} is in use: {holder}")]
    Taken { what: &'static str, holder: String },
    /// The requested step has already been superseded.
    #[error("{what}: expected {expected}, got {given}")]
    Gone { what: &'static str, expected: String, given: String },
    /// A queue is full. A later attempt may succeed.
    #[error("{queue} is full ({limit})")]
    Busy { queue: &'static str, limit: usize },
    /// The caller's deadline expired before the result was available.
    #[error("{what}: expected within {ms} ms, got none")]
    Deadline { what: String, ms: u64 },
    /// A resource or program is missing; the operator must install, mount or free it.
    #[error("{what} is not available: {reason}. {remedy}")]
    Unavailable { what: &'static str, reason: String, remedy: String },
    /// An internal error, or a failure of the device or a library.
    #[error("{stage} failed: {reason}")]
    Fault { stage: &'static str, reason: String },
    /// The device context and its memory are lost, for example after an illegal access by a kernel. All later calls to
    /// the device fail, so the operator must restart the server.
    #[error("{stage} failed: the device is lost ({reason}). Restart the server")]
    DeviceLost { stage: &'static str, reason: String },
}

/// `Result` with [`Error`] as its default error type.
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// An [`Error::Invalid`] that names the field, the expected and the given value.
pub fn invalid(field: impl Into<String>, expected: impl Into<String>, given: impl ToString) -> Error {
    Error::Invalid { field: field.into(), expected: expected.into(), given: given.to_string() }
}

/// An [`Error::Fault`] of `stage`.
pub fn fault(stage: &'static str, reason: impl ToString) -> Error {
    Error::Fault { stage, reason: reason.to_string() }
}

/// Converts any library error to an [`Error::Fault`] of `stage`, for use with `map_err`.
pub fn fault_in<E: std::fmt::Display>(stage: &'static str) -> impl Fn(E) -> Error {
    move |error| fault(stage, error)
}

impl Error {
    /// Prefixes the field of an [`Error::Invalid`] with its location, such as a file, so that the message contains the
    /// whole path. Other variants remain unchanged.
    pub fn prefix_field(self, location: &str) -> Self {
        match self {
            Self::Invalid { field, expected, given } => {
                Self::Invalid { field: format!("{location}: {field}"), expected, given }
            }
            other => other,
        }
    }
}
