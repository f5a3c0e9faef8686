//! The error type of this crate, and the exit codes of its program.

use std::path::Path;

use modalcast_client::{Error as ClientError, Reason};

/// The result type of this crate.
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// The error type of this crate.
#[derive(Debug, Clone, thiserror::Error)]
pub enum Error {
    /// An argument is invalid, or does not fit the recording.
    #[error("{field}: expected {expected}, got {given}")]
    Invalid { field: String, expected: String, given: String },
    /// A file is not a valid recording. `location` is the record or the field.
    #[error("{path}: {location}: expected {expected}, got {given}")]
    InvalidFile { path: String, location: String, expected: String, given: String },
    /// A file does not exist.
    #[error("{path} does not exist")]
    NotFound { path: String },
    /// A program or content is missing. `remedy` says how to get it.
    #[error("{what}: {reason}. {remedy}")]
    Unavailable { what: String, reason: String, remedy: String },
    /// A local file or process could not be read or written.
    #[error("{path}: {reason}")]
    File { path: String, reason: String },
    /// The server rejected a call, or the connection failed.
    #[error(transparent)]
    Client(#[from] ClientError),
}

impl Error {
    /// An error of a local file.
    pub(crate) fn file(path: &Path, error: impl std::fmt::Display) -> Self {
        Self::File { path: path.display().to_string(), reason: error.to_string() }
    }

    /// Replaces the path of an error of a writer that does not know its path.
    pub(crate) fn at(self, path: &Path) -> Self {
        match self {
            Self::File { reason, .. } => Self::file(path, reason),
            error => error,
        }
    }

    /// An error while a local file is opened.
    pub(crate) fn open(path: &Path, error: &std::io::Error) -> Self {
        match error.kind() {
            std::io::ErrorKind::NotFound => Self::NotFound { path: path.display().to_string() },
            _ => Self::file(path, error),
        }
    }

    pub(crate) fn invalid(field: impl Into<String>, expected: impl ToString, given: impl ToString) -> Self {
        Self::Invalid { field: field.into(), expected: expected.to_string(), given: given.to_string() }
    }

    /// The exit code of a program that ends with this error, as `modalcast --help` lists them.
    pub const fn exit_code(&self) -> u8 {
        match self {
            Self::Invalid { .. } | Self::InvalidFile { .. } => 3,
            Self::NotFound { .. } => 4,
            Self::Unavailable { .. } => 5,
            Self::File { .. } => 6,
            Self::Client(error) => client_exit_code(error),
        }
    }
}

const fn client_exit_code(error: &ClientError) -> u8 {
    match error {
        ClientError::Connect { .. } | ClientError::Certificate { .. } | ClientError::ProtocolVersion { .. } => 5,
        ClientError::Step { .. } => 3,
        ClientError::Rejected(rejection) => reason_exit_code(rejection.reason),
        ClientError::Status { rejection: Some(rejection), .. } => reason_exit_code(rejection.reason),
        ClientError::Status { rejection: None, .. }
        | ClientError::Malformed { .. }
        | ClientError::StreamEnded { .. }
        | ClientError::Deadline { .. }
        | ClientError::File { .. } => 6,
    }
}

const fn reason_exit_code(reason: Reason) -> u8 {
    match reason {
        Reason::InvalidField | Reason::UnexpectedMessage | Reason::InvalidFile | Reason::MessageTooLarge => 3,
        Reason::SceneNotFound | Reason::StepPassed | Reason::StreamNotFound | Reason::ContentNotFound => 4,
        Reason::SceneNameTaken
        | Reason::WriterLeaseTaken
        | Reason::LeaseLost
        | Reason::WindowFull
        | Reason::QueueFull
        | Reason::LimitReached
        | Reason::Preempted
        | Reason::EndedByAdministrator
        | Reason::OutOfMemory
        | Reason::SlowReader
        | Reason::Unauthenticated
        | Reason::PermissionDenied
        | Reason::ResourceMissing
        | Reason::ShuttingDown => 5,
        Reason::DeadlineExpired | Reason::DeviceLost | Reason::Internal | Reason::Unspecified => 6,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exit_codes_are_those_of_the_main_program() {
        let rejected = |reason| {
            let (field, expected, given) = (String::new(), String::new(), String::new());
            let rejection = modalcast_client::Rejection { step: None, reason, field, expected, given };
            Error::Client(ClientError::Rejected(Box::new(rejection)))
        };
        let missing_folder = Error::open(Path::new("no/file"), &std::io::ErrorKind::NotFound.into());
        for (error, code) in [
            (Error::invalid("--speed", "a number", "x"), 3),
            (missing_folder, 4),
            (rejected(Reason::SceneNotFound), 4),
            (rejected(Reason::WriterLeaseTaken), 5),
            (rejected(Reason::Internal), 6),
            (Error::Client(ClientError::Connect { url: String::new(), reason: String::new() }), 5),
        ] {
            assert_eq!(error.exit_code(), code, "{error}");
        }
    }
}
