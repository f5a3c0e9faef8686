//! The time limit that all tests of the workspace share. Test crates include this file by its path.

use std::time::Duration;

/// Longest time that a test waits for an event that it expects. It only turns a hang into a failure: a test asserts
/// that the event happens, not when. On a machine that is busy with other work, a second of work may take minutes.
pub(crate) const HANG_GUARD: Duration = Duration::from_secs(600);
