//! What can go wrong, sorted by who can act on it. Every variant carries the numbers that the actor needs.

/// The one error of the server.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Error {
    /// The caller sent something that can never be accepted.
    #[error("{field}: expected {expected}, given {given}")]
    Invalid { field: String, expected: String, given: String },
    /// The caller named something that is not there.
    #[error("{what} not found: {given}")]
    NotFound { what: &'static str, given: String },
    /// The caller wants what somebody else holds; it may be free later.
    #[error("{what} is taken: {holder}")]
    Taken { what: &'static str, holder: String },
    /// The caller asked for what has passed.
    #[error("{what}: expected {expected}, given {given}")]
    Gone { what: &'static str, expected: String, given: String },
    /// The caller came too fast; a later try may pass.
    #[error("{queue} is full ({limit})")]
    Busy { queue: &'static str, limit: usize },
    /// The caller's deadline passed first.
    #[error("{what} did not come within {ms} ms")]
    Deadline { what: String, ms: u64 },
    /// The operator must install, mount or free something.
    #[error("{what} is not available: {reason}. {remedy}")]
    Unavailable { what: &'static str, reason: String, remedy: String },
    /// A fault of ours or of the device.
    #[error("{stage} failed: {reason}")]
    Fault { stage: &'static str, reason: String },
}

/// Shorthand of every fallible function in the crate.
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// A refusal that names the field, what was expected and what was given.
pub fn invalid(field: impl Into<String>, expected: impl Into<String>, given: impl ToString) -> Error {
    Error::Invalid { field: field.into(), expected: expected.into(), given: given.to_string() }
}

/// Makes a fault of `stage` out of any library error; to be used with `map_err`.
pub fn during<E: std::fmt::Display>(stage: &'static str) -> impl Fn(E) -> Error {
    move |error| Error::Fault { stage, reason: error.to_string() }
}

impl Error {
    /// The same error with `place` put before its field, so that a nested parser's refusal names the whole path.
    pub fn within(self, place: &str) -> Self {
        match self {
            Self::Invalid { field, expected, given } => {
                Self::Invalid { field: format!("{place}: {field}"), expected, given }
            }
            other => other,
        }
    }
}
