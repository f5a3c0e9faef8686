//! The error type of this crate.

/// Why a beam has no modes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum BeamError {
    /// An invalid argument. `field` is its name.
    Invalid { field: &'static str, expected: &'static str, given: String },
    /// The stiffness is not positive definite: the beam has no stiffness, or its entries exceed f64.
    Singular,
    /// The eigenvalue iteration did not converge.
    NotConverged,
}

/// `Result` with [`BeamError`].
pub type Result<T> = std::result::Result<T, BeamError>;

impl std::fmt::Display for BeamError {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Invalid { field, expected, given } => write!(formatter, "{field}: expected {expected}, got {given}"),
            Self::Singular => formatter.write_str("the stiffness of the beam is not positive definite"),
            Self::NotConverged => formatter.write_str("the eigenvalue iteration of the beam did not converge"),
        }
    }
}

impl std::error::Error for BeamError {}

/// A [`BeamError::Invalid`].
pub(crate) fn invalid(field: &'static str, expected: &'static str, given: impl ToString) -> BeamError {
    BeamError::Invalid { field, expected, given: given.to_string() }
}
