//! The error type of the server's crates. The variants distinguish what the caller can correct or retry, what the
//! operator must repair, and failures of the server itself. Each variant contains the values that are needed to act on
//! the error.

use std::fmt;

/// A step, by the number of its writer and its own.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct StepNumber {
    pub run: u64,
    pub number: u64,
}

impl fmt::Display for StepNumber {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "step {} of run {}", self.number, self.run)
    }
}

fn describe_slow_subscriber(received: Option<StepNumber>, missing: StepNumber) -> String {
    let received = received.map_or_else(|| "none".into(), |step| step.to_string());
    format!(
        "the client reads too slowly and has used up the stall budget of the scene. Last complete step: {received}; \
         first missing step: {missing}"
    )
}

/// The error type of the server.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Error {
    /// The caller sent an invalid value. `field` is its path in the request, such as `step.q_domains[1]`, or its place
    /// in a file.
    #[error("{field}: expected {expected}, got {given}")]
    Invalid { field: String, expected: String, given: String },
    /// A file of a scene has invalid content. `location` names the file and the place in it.
    #[error("{location}: expected {expected}, got {given}")]
    InvalidFile { location: String, expected: String, given: String },
    /// A message arrived that is not allowed at this point of its stream.
    #[error("unexpected message: expected {expected}, got {given}")]
    UnexpectedMessage { expected: &'static str, given: &'static str },
    /// The caller named an object that does not exist.
    #[error("{what} not found: {given}")]
    NotFound { what: &'static str, given: String },
    /// No content has the hash that the caller named. `what` describes the contents that were searched.
    #[error("{field}: expected the SHA-256 of an existing {what}, got {sha256}")]
    ContentNotFound { field: String, what: &'static str, sha256: String },
    /// No running frame stream has the id that the caller sent. The stream may have ended.
    #[error("no running frame stream has this id")]
    StreamNotFound,
    /// Another scene has the name. `owner` is the source of that scene.
    #[error("the scene name '{name}' belongs to '{owner}'")]
    NameTaken { name: String, owner: String },
    /// The caller may not do this. `given` names the caller.
    #[error("permission: expected {expected}, got {given}")]
    NotPermitted { expected: String, given: String },
    /// Another writer holds the lease of the scene. A run is the number of a writer.
    #[error("run {run} has held the writer lease for {seconds} s")]
    LeaseTaken { run: u64, seconds: u64 },
    /// The writer with this run has taken over the lease.
    #[error("the writer of run {run} has taken over the lease")]
    LeaseLost { run: u64 },
    /// The requested step has already been superseded.
    #[error("{field}: expected {expected}, got {given}")]
    StepPassed { field: &'static str, expected: String, given: String },
    /// Too many steps of a step stream are unacknowledged.
    #[error("the window is full: expected at most {limit} steps without acknowledgment, got {given}")]
    WindowFull { limit: usize, given: usize },
    /// A queue is full. A later attempt may succeed.
    #[error("{queue} is full ({limit})")]
    Busy { queue: &'static str, limit: usize },
    /// As many objects exist as the configuration allows.
    #[error("at most {limit} {objects} are allowed")]
    LimitReached { objects: &'static str, limit: usize },
    /// The server has ended what the caller held in favor of another client. `held` is what the caller held of `limit`
    /// objects.
    #[error("ended to make room for another client: this client held {held} of at most {limit} {objects}")]
    Preempted { objects: &'static str, held: usize, limit: usize },
    /// An administrator has ended what the caller held.
    #[error("an administrator has ended this client")]
    ClientEnded,
    /// An object of a scene needs more memory than is left of a limit. `memory` names the limit. Nothing was allocated.
    #[error("{object}: expected at most {available} bytes ({memory}, in total {total}), got {asked}")]
    OutOfMemory { object: String, memory: &'static str, asked: u64, available: u64, total: u64 },
    /// The caller has not read its replies in time.
    #[error("{queue} is full ({limit}), because the client does not read it")]
    SlowReader { queue: &'static str, limit: usize },
    /// The writer of a scene has waited for the caller, a lossless subscriber, for longer than its stall budget allows.
    #[error("{}", describe_slow_subscriber(*received, *missing))]
    SlowSubscriber {
        /// The last step that the caller has received completely.
        received: Option<StepNumber>,
        /// The first step that the caller has not received completely.
        missing: StepNumber,
    },
    /// The caller's deadline expired before the result was available.
    #[error("{what}: expected within {ms} ms, got none")]
    Deadline { what: String, ms: u64 },
    /// A resource or program is missing; the operator must install, mount or free it.
    #[error("{what} is not available: {reason}. {remedy}")]
    Unavailable { what: &'static str, reason: String, remedy: String },
    /// The server is shutting down.
    #[error("the server is shutting down. Try again when it is running again")]
    ShuttingDown,
    /// An internal error, or a failure of the device or a library.
    #[error("{stage} failed: {reason}")]
    Fault { stage: &'static str, reason: String },
    /// The OpenGL context and its objects are lost, for example after a reset of the GPU. The server opens the renderer
    /// again, so that a later attempt may succeed.
    #[error("{stage} failed: the renderer is lost ({reason}) and is opened again. Try again")]
    RendererLost { stage: &'static str, reason: String },
    /// The device context and its memory are lost, for example after an illegal access by a kernel, or the device does not
    /// answer. All later calls to the device fail, so the server ends, and its supervisor must start it again.
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
    /// Whether the renderer or the device is lost, so that a second attempt on the same context fails, too.
    pub const fn is_loss(&self) -> bool {
        matches!(self, Self::RendererLost { .. } | Self::DeviceLost { .. })
    }

    /// Converts an [`Error::Invalid`] of a loader, whose field is a place in a file, to an [`Error::InvalidFile`].
    /// Other variants remain unchanged.
    pub fn into_file_error(self) -> Self {
        match self {
            Self::Invalid { field: location, expected, given } => Self::InvalidFile { location, expected, given },
            other => other,
        }
    }

    /// Prefixes the field of an [`Error::Invalid`] with the path of the message that contains it: `near` becomes
    /// `camera.near`. Other variants remain unchanged.
    pub fn in_message(self, path: &str) -> Self {
        match self {
            Self::Invalid { field, expected, given } => {
                Self::Invalid { field: format!("{path}.{field}"), expected, given }
            }
            other => other,
        }
    }

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
