//! Pinned host memory of pictures, which readers on other threads share.

use std::slice;
use std::sync::Arc;

use crate::gpu::launch::{Device, PinnedBuffer, PinnedUse};
use modalcast_model::error::{Result, fault};

/// Free buffers that a pool keeps: those of four arrays, of which two are drawn and sent at a time.
const MAX_FREE: usize = 8;

/// Pinned host memory. It is written only while no reader has a reference.
#[derive(Debug)]
pub(super) struct PinnedPixels {
    /// Address of the first byte of `_buffer`, because the buffer calls the driver for each access.
    pub(super) address: *mut u8,
    bytes: usize,
    _buffer: PinnedBuffer<u8>,
}

// SAFETY: the memory belongs to this value. It is written only while no reader has a reference.
unsafe impl Send for PinnedPixels {}
// SAFETY: as above.
unsafe impl Sync for PinnedPixels {}

impl PinnedPixels {
    pub(super) fn new(device: &Device, bytes: usize) -> Result<Self> {
        let buffer = PinnedBuffer::<u8>::zeroed(device, bytes, PinnedUse::FromDevice)?;
        Ok(Self { address: buffer.address()? as *mut u8, bytes, _buffer: buffer })
    }

    pub(super) const fn as_slice(&self) -> &[u8] {
        // SAFETY: `_buffer` has these bytes, which are initialized. Nothing writes them while a reader has a reference.
        unsafe { slice::from_raw_parts(self.address, self.bytes) }
    }

    const fn as_mut_slice(&mut self) -> &mut [u8] {
        // SAFETY: `_buffer` has these bytes, which are initialized, and this is the only reference to them.
        unsafe { slice::from_raw_parts_mut(self.address, self.bytes) }
    }
}

/// An array in pinned memory. The memory is used again when all of its readers are gone.
#[derive(Debug, Clone)]
pub struct PinnedArray {
    pixels: Arc<PinnedPixels>,
    bytes: usize,
}

impl AsRef<[u8]> for PinnedArray {
    fn as_ref(&self) -> &[u8] {
        &self.pixels.as_slice()[..self.bytes]
    }
}

/// A pool of pinned host buffers. A buffer is free when no reader has it.
#[derive(Debug, Default)]
pub struct PinnedPool {
    buffers: Vec<Arc<PinnedPixels>>,
}

impl PinnedPool {
    /// An array of this many bytes, which `write` fills.
    pub(super) fn fill(
        &mut self,
        device: &Device,
        bytes: usize,
        write: impl FnOnce(&mut [u8]) -> Result<()>,
    ) -> Result<PinnedArray> {
        let mut buffer = self.take(device, bytes)?;
        let pixels =
            Arc::get_mut(&mut buffer).ok_or_else(|| fault("pinned memory", "expected a buffer without readers"))?;
        let written = write(&mut pixels.as_mut_slice()[..bytes]);
        self.buffers.push(Arc::clone(&buffer));
        written.map(|()| PinnedArray { pixels: buffer, bytes })
    }

    /// Takes a free buffer that is large enough, or a new one. Frees the memory of further free ones.
    fn take(&mut self, device: &Device, bytes: usize) -> Result<Arc<PinnedPixels>> {
        let is_free = |buffer: &Arc<PinnedPixels>| Arc::strong_count(buffer) == 1;
        let found = self.buffers.iter().position(|buffer| is_free(buffer) && buffer.bytes >= bytes);
        let taken = found.map(|index| self.buffers.swap_remove(index));
        let mut free_count = 0;
        self.buffers.retain(|buffer| {
            free_count += usize::from(is_free(buffer));
            !is_free(buffer) || free_count <= MAX_FREE
        });
        match taken {
            Some(buffer) => Ok(buffer),
            None => {
                // A larger array needs another buffer, and so do the following ones.
                self.buffers.retain(|buffer| !is_free(buffer) || buffer.bytes >= bytes);
                let _current = device.enter()?;
                Ok(Arc::new(PinnedPixels::new(device, bytes)?))
            }
        }
    }
}
