//! The writer lease of a scene, which is the exclusive right to send steps: what a writer asks for, and the token that
//! identifies the writer.

use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use super::delivery::Delivery;
use super::step_queue::{Overflow, StepQueue};
use crate::admission::Account;
use modalcast_model::error::{Result, fault_in, invalid};

/// Identifies a writer across connections. Only the client and the server know it.
#[derive(Clone, PartialEq, Eq)]
pub struct LeaseToken(Vec<u8>);

impl LeaseToken {
    const MIN_BYTES: usize = 16;
    const MAX_BYTES: usize = 64;

    /// A token that the client has chosen.
    ///
    /// # Errors
    /// `Invalid` for a token of fewer than 16 or more than 64 bytes.
    pub fn parse(field: &str, bytes: &[u8]) -> Result<Self> {
        if (Self::MIN_BYTES..=Self::MAX_BYTES).contains(&bytes.len()) {
            Ok(Self(bytes.to_vec()))
        } else {
            let expected = format!("{} to {} bytes", Self::MIN_BYTES, Self::MAX_BYTES);
            Err(invalid(field, expected, format!("{} bytes", bytes.len())))
        }
    }

    /// A new token of random bytes from the operating system.
    ///
    /// # Errors
    /// `Fault` when the operating system returns no random bytes.
    pub(super) fn random() -> Result<Self> {
        let mut bytes = vec![0; Self::MIN_BYTES];
        getrandom::fill(&mut bytes).map_err(fault_in("random token"))?;
        Ok(Self(bytes))
    }

    pub fn as_bytes(&self) -> &[u8] {
        &self.0
    }
}

/// Without the bytes, because a token in a log would let others take the lease.
impl fmt::Debug for LeaseToken {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "LeaseToken({} bytes)", self.0.len())
    }
}

/// The state that the first step of a run changes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum InitialState {
    /// The current state.
    Keep,
    /// The rest state.
    Reset,
}

/// What a writer asks for when it opens its stream.
#[derive(Debug, Clone)]
pub struct LeaseRequest {
    /// The client that drives. A token identifies a writer only together with its principal.
    pub account: Account,
    pub delivery: Delivery,
    pub overflow: Overflow,
    /// Number of steps that may be unacknowledged.
    pub window: u32,
    /// The stall budget: how long lossless subscribers may make the writer wait.
    pub stall_budget: Duration,
    /// `None` asks for a new token.
    pub token: Option<LeaseToken>,
    /// Whether the writer replaces a connected writer that has another token.
    pub takes_over: bool,
    /// `None` means [`InitialState::Keep`] if the token is that of the last writer, otherwise [`InitialState::Reset`].
    pub initial_state: Option<InitialState>,
}

/// The writer's lease on a scene. Dropping it closes `step_queue` and admits the next writer. A reply that carries the
/// lease is dropped if the client has disconnected, which also releases the lease.
#[derive(Debug)]
pub(in crate::engine) struct WriterLease {
    pub step_queue: Arc<StepQueue>,
}

impl Drop for WriterLease {
    fn drop(&mut self) {
        self.step_queue.close();
    }
}

/// The writer lease, its token, and the run of steps that begins with it.
#[derive(Debug)]
pub(super) struct AcquiredLease {
    pub lease: WriterLease,
    pub token: LeaseToken,
    pub run: u64,
    pub initial_state: InitialState,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tokens_are_random_and_of_16_to_64_bytes() {
        let tokens = [(); 2].map(|()| LeaseToken::random().expect("expected random bytes"));
        assert_ne!(tokens[0], tokens[1]);
        let parse = |bytes: usize| LeaseToken::parse("open.lease_token", &vec![7; bytes]);
        assert!([15, 65].map(parse).iter().all(|token| token.is_err()));
        assert!([16, 64].map(parse).iter().all(|token| token.is_ok()));
        assert!(!format!("{:?}", parse(16)).contains('7'));
    }
}
