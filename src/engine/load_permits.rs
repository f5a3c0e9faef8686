//! Limits on the scenes that are read or created at the same time.

use tokio::sync::{Semaphore, SemaphorePermit};

use modalcast_model::error::{Error, Result};

/// Maximum number of scenes that are read from disk concurrently.
const MAX_CONCURRENT_LOADS: usize = 2;

/// Maximum number of built-in scenes that are created concurrently.
const MAX_CONCURRENT_BUILT_IN: usize = 1;

/// Permits to read or create a scene. Built-in scenes have permits of their own, so that they do not wait for slow
/// files.
#[derive(Debug)]
pub(super) struct LoadPermits {
    files: Semaphore,
    built_in: Semaphore,
}

impl LoadPermits {
    pub(super) const fn new() -> Self {
        Self {
            files: Semaphore::const_new(MAX_CONCURRENT_LOADS),
            built_in: Semaphore::const_new(MAX_CONCURRENT_BUILT_IN),
        }
    }

    /// Waits in the order of the calls.
    ///
    /// # Errors
    /// `ShuttingDown`.
    pub(super) async fn acquire(&self, is_built_in: bool) -> Result<SemaphorePermit<'_>> {
        let permits = if is_built_in { &self.built_in } else { &self.files };
        permits.acquire().await.map_err(|_| Error::ShuttingDown)
    }
}
