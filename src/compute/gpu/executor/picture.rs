//! Pictures in device memory that OpenGL and CUDA share, and their readback by CUDA's copy engine.
//!
//! OpenGL draws into the memory. The host waits for OpenGL's fence, then a copy on a stream of its own moves the pixels
//! to pinned memory. Copies run concurrently with the next frame: they do not make the GPU change between the contexts
//! of OpenGL and CUDA, as kernels do.

use std::slice;
use std::sync::Arc;

use cudarc::driver::{CudaEvent, CudaStream, sys};

use crate::gpu::launch::cleanup::WaitForStream;
use crate::gpu::launch::error::cuda_error;
use crate::gpu::launch::{Device, ExportedMemory, PinnedBuffer, PinnedUse};
use modalcast_model::error::{Result, fault};
use modalcast_model::shared_memory::{HostPixels, NewPicture, PictureMemory, SharedPicture};

const STAGE: &str = "read";

/// Allocates pictures on a CUDA device.
#[derive(Debug)]
pub struct CudaPictureMemory {
    device: Arc<Device>,
    copy_stream: Arc<CudaStream>,
}

/// A picture in device memory, and the pinned memory of its copy.
#[derive(Debug)]
struct CudaPicture {
    memory: ExportedMemory,
    /// Bytes of the picture; `memory` may be larger.
    bytes: usize,
    pixels: Arc<PinnedPixels>,
    /// End of the last copy.
    copied: CudaEvent,
    is_copying: bool,
    copy_stream: Arc<CudaStream>,
    device: Arc<Device>,
}

/// Pinned host memory. Only a copy that [`CudaPicture`] has started writes it, and readers get it after the copy.
#[derive(Debug)]
struct PinnedPixels {
    /// Address of the first byte of `buffer`, because the buffer calls the driver for each access.
    address: *const u8,
    bytes: usize,
    _buffer: PinnedBuffer<u8>,
}

// SAFETY: the memory belongs to this value. It is written only by a copy that starts while no reader has a reference.
unsafe impl Send for PinnedPixels {}
// SAFETY: as above.
unsafe impl Sync for PinnedPixels {}

impl CudaPictureMemory {
    /// Creates the stream of the copies.
    ///
    /// # Errors
    /// `Fault` when the driver refuses a stream.
    pub fn new(device: &Arc<Device>) -> Result<Self> {
        let copy_stream = device.context().new_stream().map_err(cuda_error(STAGE))?;
        Ok(Self { device: Arc::clone(device), copy_stream })
    }
}

impl PictureMemory for CudaPictureMemory {
    fn create_picture(&self, bytes: usize) -> Result<NewPicture> {
        let device = &self.device;
        let _current = device.enter()?;
        let memory = ExportedMemory::new(device, bytes)?;
        let (descriptor, allocated_bytes) = (memory.export()?, memory.bytes() as u64);
        let picture = Box::new(CudaPicture {
            memory,
            bytes,
            pixels: Arc::new(PinnedPixels::new(device, bytes)?),
            copied: device.context().new_event(None).map_err(cuda_error(STAGE))?,
            is_copying: false,
            copy_stream: Arc::clone(&self.copy_stream),
            device: Arc::clone(device),
        });
        Ok(NewPicture { descriptor, allocated_bytes, picture })
    }
}

impl PinnedPixels {
    fn new(device: &Device, bytes: usize) -> Result<Self> {
        let buffer = PinnedBuffer::<u8>::zeroed(device, bytes, PinnedUse::FromDevice)?;
        Ok(Self { address: buffer.address()? as *const u8, bytes, _buffer: buffer })
    }
}

impl HostPixels for PinnedPixels {
    fn bytes(&self) -> &[u8] {
        // SAFETY: `_buffer` has these bytes, which are initialized. No copy writes them while a reader has a reference.
        unsafe { slice::from_raw_parts(self.address, self.bytes) }
    }
}

impl SharedPicture for CudaPicture {
    fn start_copy(&mut self, bytes: usize) -> Result<()> {
        if bytes > self.bytes {
            return Err(fault(STAGE, format!("expected at most {} bytes of a picture, got {bytes}", self.bytes)));
        }
        if self.is_copying || Arc::strong_count(&self.pixels) > 1 {
            return Err(fault(STAGE, "expected a picture without a copy in flight and without a reader"));
        }
        let _current = self.device.enter()?;
        let guard = WaitForStream::new(&self.copy_stream);
        let target = self.pixels.address.cast_mut().cast();
        // SAFETY: both memories have at least `bytes` bytes and belong to this value, which waits for the copy before
        // it is dropped. No reader has a reference to the pixels: readers get them after the copy. If this
        // function fails before the event is recorded, the guard waits for the copy.
        unsafe { sys::cuMemcpyDtoHAsync_v2(target, self.memory.address(), bytes, self.copy_stream.cu_stream()) }
            .result()
            .map_err(cuda_error(STAGE))?;
        self.copied.record(&self.copy_stream).map_err(cuda_error(STAGE))?;
        guard.disarm();
        self.is_copying = true;
        Ok(())
    }

    fn is_copied(&self) -> bool {
        !self.is_copying || self.copied.try_is_complete() != Ok(false)
    }

    fn finish_copy(&mut self) -> Result<Arc<dyn HostPixels>> {
        if !self.is_copying {
            return Err(fault(STAGE, "expected a copy in flight, got none"));
        }
        self.copied.synchronize().map_err(cuda_error(STAGE))?;
        self.is_copying = false;
        Ok(Arc::clone(&self.pixels) as Arc<dyn HostPixels>)
    }

    fn fill(&mut self, word: u32) -> Result<()> {
        let _current = self.device.enter()?;
        let stream = &self.copy_stream;
        // SAFETY: the memory has at least these words, and the stream is synchronized before this returns.
        let fill_result =
            unsafe { sys::cuMemsetD32Async(self.memory.address(), word, self.bytes / 4, stream.cu_stream()) };
        let wait_result = stream.synchronize();
        fill_result.result().and(wait_result).map_err(cuda_error(STAGE))
    }
}

impl Drop for CudaPicture {
    fn drop(&mut self) {
        if self.is_copying {
            // Ignore a fault: the next call to the device reports it.
            self.copied.synchronize().ok();
        }
    }
}
