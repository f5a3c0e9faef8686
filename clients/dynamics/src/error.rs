//! What can go wrong in the physics process: the connection, or what it was given.

/// Shorthand of every fallible function in the crate.
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// The one error of the physics process.
#[derive(Debug, Clone, thiserror::Error)]
pub enum Error {
    /// The server refused, or the connection is gone, or a local file cannot be used.
    #[error(transparent)]
    Client(#[from] modalcast_client::Error),
    /// A file, a flag or a scene does not fit.
    #[error("{field}: expected {expected}, given {given}")]
    Invalid { field: String, expected: String, given: String },
}

/// A refusal that names the field, what was expected and what was given.
pub fn invalid(field: impl Into<String>, expected: impl ToString, given: impl ToString) -> Error {
    Error::Invalid { field: field.into(), expected: expected.to_string(), given: given.to_string() }
}
