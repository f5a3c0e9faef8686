//! Errors of the physics process: errors of the gRPC client and of local files, invalid input, motion
//! that diverges, and steps without a solution.

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
    /// The motion is not finite or far out of range. `subject` is a coordinate or a transform.
    #[error(
        "step {step} ({time} s): {subject} diverged: expected {expected}, got {given}: choose a weaker load (--wind, \
         --deflection) or smaller steps (--dt)"
    )]
    Diverged { step: u64, time: f64, subject: String, expected: String, given: String },
    /// The equations of a step have no solution that the integrator finds. `residual` is relative to the largest force.
    #[error(
        "a step of {dt} s: expected a solution of the equations of motion, got a residual of {residual:.1e} with \
         {sub_steps} sub-steps: choose smaller steps (--dt)"
    )]
    NotConverged { dt: f64, sub_steps: u32, residual: f64 },
}

/// Creates an `Invalid` error: `field` holds `given` instead of `expected`.
pub fn invalid_input(field: impl Into<String>, expected: impl ToString, given: impl ToString) -> Error {
    Error::Invalid { field: field.into(), expected: expected.to_string(), given: given.to_string() }
}

/// Checks an option of a scenario.
///
/// # Errors
/// `Invalid` unless `value` is in the range. NaN is in no range.
pub(crate) fn check_option(field: &str, value: f64, range: std::ops::RangeInclusive<f64>) -> Result<()> {
    if range.contains(&value) {
        return Ok(());
    }
    Err(invalid_input(field, format!("a number from {:e} to {:e}", range.start(), range.end()), value))
}
