//! Errors of the physics process: the client reports one, or an input is invalid.

/// The result type of this crate.
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// The error type of this crate.
#[derive(Debug, Clone, thiserror::Error)]
pub enum Error {
    /// The server refused a request, the connection was lost, or a local file cannot be used.
    #[error(transparent)]
    Client(#[from] modalcast_client::Error),
    /// A file, an option or a scene is not valid here.
    #[error("{field}: expected {expected}, got {given}")]
    Invalid { field: String, expected: String, given: String },
}

/// An `Invalid` error: at `field`, `expected` was expected and `given` was found.
pub fn invalid(field: impl Into<String>, expected: impl ToString, given: impl ToString) -> Error {
    Error::Invalid { field: field.into(), expected: expected.to_string(), given: given.to_string() }
}
