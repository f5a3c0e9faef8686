//! Restores the state of the device after some work, also when the work panics.

use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::Arc;

use cudarc::driver::CudaStream;

/// Guard that waits for a stream on drop, unless [`Self::disarm`] was called. It covers submitted work that nothing
/// else waits for yet.
#[must_use]
pub(crate) struct WaitForStream(Option<Arc<CudaStream>>);

impl WaitForStream {
    pub(crate) fn new(stream: &Arc<CudaStream>) -> Self {
        Self(Some(Arc::clone(stream)))
    }

    /// Drops the guard without waiting.
    pub(crate) fn disarm(mut self) {
        self.0 = None;
    }
}

impl Drop for WaitForStream {
    fn drop(&mut self) {
        // The caller reports the error or the panic that led here.
        self.0.take().map(|stream| stream.synchronize().ok());
    }
}

/// Runs `work`, then `cleanup`, and returns both results. When `work` panics, `cleanup` runs before the panic
/// continues.
pub(crate) fn with_cleanup<T, R>(work: impl FnOnce() -> T, cleanup: impl FnOnce() -> R) -> (T, R) {
    // Unwind safety: only `cleanup` observes the state that a panic of `work` leaves, and it expects that state.
    let work_result = catch_unwind(AssertUnwindSafe(work));
    let cleanup_result = cleanup();
    match work_result {
        Ok(work_result) => (work_result, cleanup_result),
        Err(panic) => resume_unwind(panic),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::cell::RefCell;

    #[test]
    fn cleanup_runs_once_after_results_and_panics() {
        let log = RefCell::new(Vec::new());
        let record = |text| log.borrow_mut().push(text);
        let results = with_cleanup(|| record("work"), || log.borrow().len());
        assert_eq!(results, ((), 1), "the cleanup comes second");
        let panicking = || with_cleanup(|| panic!("injected"), || record("cleanup")).1;
        let panic = catch_unwind(AssertUnwindSafe(panicking)).expect_err("the panic continues");
        assert_eq!(panic.downcast_ref::<&str>(), Some(&"injected"));
        assert_eq!(*log.borrow(), ["work", "cleanup"]);
    }
}
