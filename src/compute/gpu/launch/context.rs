//! Makes a CUDA context current on a thread for as long as a guard exists.

use std::marker::PhantomData;
use std::sync::Arc;

use cudarc::driver::{CudaContext, sys};

use super::error::cuda_error;
use modalcast_model::error::Result;

/// A context that is current on this thread. Dropping the guard restores the context that was current before, also when
/// a panic unwinds. Functions of the driver that take no stream or context need one.
#[derive(Debug)]
#[must_use]
pub(crate) struct CurrentContext {
    /// The context stack belongs to the thread, so the guard must stay on it.
    _not_send: PhantomData<*const ()>,
}

impl CurrentContext {
    /// Makes a context current on this thread.
    ///
    /// # Errors
    /// `DeviceLost` or `Fault` of the driver.
    pub(crate) fn enter(context: &Arc<CudaContext>) -> Result<Self> {
        // SAFETY: the context is alive while the caller holds it, and callers drop the guard before the context.
        unsafe { sys::cuCtxPushCurrent_v2(context.cu_ctx()) }.result().map_err(cuda_error("device"))?;
        Ok(Self { _not_send: PhantomData })
    }
}

impl Drop for CurrentContext {
    fn drop(&mut self) {
        let mut context = std::ptr::null_mut();
        // SAFETY: `context` is a live pointer. `enter` pushed a context onto the stack of this thread, which this call
        // removes. It fails only when the stack is empty or the driver shuts down; nothing remains to restore then.
        unsafe { sys::cuCtxPopCurrent_v2(&mut context) }.result().ok();
    }
}
