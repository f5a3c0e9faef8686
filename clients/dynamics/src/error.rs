//! Errors of the physics process: errors of the gRPC client and of local files, and invalid input.

/// The result type of this crate.
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// The error type of this crate.
#[derive(Debug, Clone, thiserror::Error)]
pub enum Error {
    /// The server rejected a request, the connection was lost, or a local file cannot be read or written.
    #[error(transparent)]
    Client(#[from] modalcast_client::Error),
    /// A file, an option or a scene description has content that this process cannot use.
    #[error("{field}: expected {expected}, got {given}")]
    Invalid { field: String, expected: String, given: String },
}

/// Creates an `Invalid` error: `field` holds `given` instead of `expected`.
pub fn invalid_input(field: impl Into<String>, expected: impl ToString, given: impl ToString) -> Error {
    Error::Invalid { field: field.into(), expected: expected.to_string(), given: given.to_string() }
}
