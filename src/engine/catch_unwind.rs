//! Catches panics of async work.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::task::Poll;

/// Runs `work` to its end. Returns `Err` with the payload if a poll panics. Values that `work` borrows keep the state
/// that they had at the panic.
pub(super) async fn catch_unwind_async<F: Future>(work: F) -> std::thread::Result<F::Output> {
    let mut work = std::pin::pin!(work);
    std::future::poll_fn(|context| match catch_unwind(AssertUnwindSafe(|| work.as_mut().poll(context))) {
        Ok(Poll::Ready(output)) => Poll::Ready(Ok(output)),
        Ok(Poll::Pending) => Poll::Pending,
        Err(payload) => Poll::Ready(Err(payload)),
    })
    .await
}
