//! Work that would block the runtime's own threads.

use modalcast_model::error::{Result, during};

/// Runs long work on a blocking thread. A panic there is a fault of that work alone.
pub(super) async fn run_blocking<T: Send + 'static>(
    stage: &'static str,
    work: impl FnOnce() -> Result<T> + Send + 'static,
) -> Result<T> {
    tokio::task::spawn_blocking(work).await.map_err(during(stage))?
}
