//! Ranges of memory that CUDA shares with OpenGL, as handles that leave this module.

use std::any::Any;
use std::ops::Range;
use std::rc::Rc;
use std::sync::Arc;

use cudarc::driver::CudaStream;

use crate::gpu::launch::{Device, ExportedMemory};
use modalcast_model::error::{Result, fault};
use modalcast_model::shared_memory::SharedRange;

/// A range of bytes of exported memory. All work on the memory is submitted to one stream, and the owner of the handle
/// waits for the stream before it drops the last handle.
#[derive(Debug)]
pub(super) struct CudaRange {
    memory: Rc<ExportedMemory>,
    bytes: Range<u64>,
    stream: Arc<CudaStream>,
}

impl CudaRange {
    /// The range `bytes`, which is inside the memory.
    pub(super) fn new(device: &Device, memory: &Rc<ExportedMemory>, bytes: Range<u64>) -> Self {
        Self { memory: Rc::clone(memory), bytes, stream: Arc::clone(device.stream()) }
    }

    /// The device address of a range of at least `bytes` bytes.
    ///
    /// # Errors
    /// `Fault` if the range is smaller, or does not belong to the stream of `device`.
    pub(super) fn address_of(range: &dyn SharedRange, device: &Device, bytes: u64) -> Result<u64> {
        let own = range.as_any().downcast_ref::<Self>().filter(|own| Arc::ptr_eq(&own.stream, device.stream()));
        let own = own.ok_or_else(|| fault("raster", "expected memory of the rasterizer's CUDA stream"))?;
        let got = own.bytes.end.saturating_sub(own.bytes.start);
        if got < bytes {
            return Err(fault("raster", format!("expected at least {bytes} bytes of shared memory, got {got}")));
        }
        Ok(own.memory.address() + own.bytes.start)
    }
}

impl SharedRange for CudaRange {
    fn as_any(&self) -> &dyn Any {
        self
    }
}
