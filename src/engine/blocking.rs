//! Runs blocking work off the async runtime's worker threads.

use modalcast_model::error::{Result, fault_in};

/// Runs blocking or long work on a thread of tokio's blocking pool. A panic becomes a `Fault` of `stage`.
pub(crate) async fn run_blocking<T: Send + 'static>(
    stage: &'static str,
    work: impl FnOnce() -> Result<T> + Send + 'static,
) -> Result<T> {
    tokio::task::spawn_blocking(work).await.map_err(fault_in(stage))?
}
