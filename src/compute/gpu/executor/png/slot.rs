//! Pinned memory that receives a PNG file, and the file in it.

use std::sync::Arc;

use cudarc::driver::CudaEvent;
use cudarc::driver::sys::CUevent_flags;

use super::STAGE;
use crate::gpu::launch::error::cuda_error;
use crate::gpu::launch::{Device, PinnedBuffer, PinnedUse};
use modalcast_model::error::{Result, fault};
use modalcast_model::shared_memory::HostPixels;

/// The kernel copies vectors of this size to the file.
const ALIGNMENT: u64 = 16;
/// Bytes of `PngResult` in `kernels/png.cuh`.
const RESULT_BYTES: usize = 8;

/// Pinned memory for one file. It is free while the encoder has the only reference.
#[derive(Debug)]
pub(super) struct FileSlot {
    /// The file, then a `PngResult`.
    memory: PinnedBuffer<u8>,
    /// Address of `memory`, because the buffer calls the driver for each access.
    address: u64,
    result_offset: usize,
    /// Begin of the last encoding into this slot.
    begun: CudaEvent,
    /// End of the last encoding into this slot.
    done: CudaEvent,
}

/// An encoding in flight. Any thread may wait for it. A dropped one continues, and its file is lost.
#[derive(Debug)]
pub struct PendingPng {
    slot: Arc<FileSlot>,
    /// Whether the file has no alpha channel.
    is_rgb: bool,
}

/// A PNG file in pinned memory. The encoder uses the memory again when the file is dropped.
#[derive(Debug)]
pub struct EncodedPng {
    slot: Arc<FileSlot>,
    bytes: usize,
    /// Milliseconds that the device encoded.
    ms: f64,
}

impl FileSlot {
    /// Allocates memory for files of at most `max_file_bytes` bytes.
    ///
    /// # Errors
    /// `Fault` when the driver cannot lock so much memory.
    pub(super) fn new(device: &Device, max_file_bytes: u64) -> Result<Self> {
        let result_offset = max_file_bytes.next_multiple_of(ALIGNMENT) as usize;
        let memory = PinnedBuffer::zeroed(device, result_offset + RESULT_BYTES, PinnedUse::FromDevice)?;
        let new_event = || device.context().new_event(Some(CUevent_flags::CU_EVENT_DEFAULT)).map_err(cuda_error(STAGE));
        Ok(Self { address: memory.address()?, memory, result_offset, begun: new_event()?, done: new_event()? })
    }

    /// Device addresses of the file and of its result.
    pub(super) const fn addresses(&self) -> [u64; 2] {
        [self.address, self.address + self.result_offset as u64]
    }

    /// Marks the begin of an encoding.
    pub(super) fn record_begin(&self, device: &Device) -> Result<()> {
        self.begun.record(device.stream()).map_err(cuda_error(STAGE))
    }

    /// Marks the end of the work that the device's stream has received.
    pub(super) fn record(&self, device: &Device) -> Result<()> {
        self.done.record(device.stream()).map_err(cuda_error(STAGE))
    }
}

impl PendingPng {
    pub(super) const fn new(slot: Arc<FileSlot>, is_rgb: bool) -> Self {
        Self { slot, is_rgb }
    }

    /// Whether [`Self::wait`] returns at once. Also true if the device has failed; `wait` then returns the error.
    pub fn is_complete(&self) -> bool {
        self.slot.done.try_is_complete() != Ok(false)
    }

    /// Waits for the file. Returns `None` if it has no alpha channel and a pixel is not opaque.
    ///
    /// # Errors
    /// `DeviceLost` or `Fault` when the device fails.
    pub fn wait(self) -> Result<Option<EncodedPng>> {
        self.slot.done.synchronize().map_err(cuda_error(STAGE))?;
        let content = self.slot.memory.as_slice()?;
        let result = content.get(self.slot.result_offset..).and_then(|result| result.as_chunks::<4>().0.first_chunk());
        let [file_bytes, is_translucent] =
            result.map(|words: &[[u8; 4]; 2]| words.map(u32::from_ne_bytes)).unwrap_or_default();
        if self.is_rgb && is_translucent != 0 {
            return Ok(None);
        }
        let (bytes, max_bytes) = (file_bytes as usize, self.slot.result_offset);
        if bytes == 0 || bytes > max_bytes {
            return Err(fault(STAGE, format!("expected a file of 1 to {max_bytes} bytes, got {bytes}")));
        }
        let ms = f64::from(self.slot.begun.elapsed_ms(&self.slot.done).map_err(cuda_error(STAGE))?);
        Ok(Some(EncodedPng { slot: self.slot, bytes, ms }))
    }
}

impl EncodedPng {
    /// Milliseconds that the device encoded.
    pub const fn ms(&self) -> f64 {
        self.ms
    }
}

impl HostPixels for EncodedPng {
    fn bytes(&self) -> &[u8] {
        self.as_ref()
    }
}

impl AsRef<[u8]> for EncodedPng {
    fn as_ref(&self) -> &[u8] {
        // SAFETY: the slot has `bytes` initialized bytes at its address, because the encoding of this file is complete.
        // The encoder writes only to slots that have no other reference, and `self` has a reference to this slot.
        unsafe { std::slice::from_raw_parts(self.slot.address as *const u8, self.bytes) }
    }
}
