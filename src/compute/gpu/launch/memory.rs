//! Device buffers, pinned host memory, and page locks of host memory.

use std::ffi::c_void;
use std::sync::Arc;

use bytemuck::Pod;
use cudarc::driver::{
    CudaContext, CudaSlice, CudaStream, DevicePtr as _, DeviceRepr, PinnedHostSlice, ValidAsZeroBits, result, sys,
};

use super::context::CurrentContext;
use super::device::Device;
use super::error::cuda_error;
use modalcast_model::error::{Error, Result, fault_in};

/// Bytes in device memory. The stream of the device that allocated them orders the release of the memory on drop, so
/// work that was submitted earlier to this stream can still use the memory. A user that submits work to another stream
/// waits for that work before it drops the buffer.
#[derive(Debug)]
pub struct DeviceBuffer {
    slice: CudaSlice<u8>,
    /// Requested bytes. `slice` may be longer, because the driver refuses an allocation of 0 bytes.
    bytes: u64,
}

impl DeviceBuffer {
    /// Allocates `bytes` bytes of zeros.
    ///
    /// # Errors
    /// `Fault` when the device has not enough memory.
    pub fn zeroed(device: &Device, bytes: u64) -> Result<Self> {
        // A kernel that reads nothing still needs a valid address.
        let allocated_bytes = usize::try_from(bytes.max(16)).map_err(fault_in("allocate"))?;
        Ok(Self { slice: device.stream().alloc_zeros(allocated_bytes).map_err(cuda_error("allocate"))?, bytes })
    }

    /// Allocates a buffer with the content of `list`, and waits for the copy.
    ///
    /// # Errors
    /// As [`Self::zeroed`] and [`Self::write`].
    pub fn upload<T: Pod>(device: &Device, list: &[T]) -> Result<Self> {
        let mut buffer = Self::zeroed(device, size_of_val(list) as u64)?;
        buffer.write(device, 0, list)?;
        Ok(buffer)
    }

    /// Copies `list` to the buffer at `byte_offset` and waits for the copy, because the driver may read pageable memory
    /// after its own call has returned. The caller may free or change the list when this method returns.
    ///
    /// # Errors
    /// `Fault` when the range exceeds the buffer, or when the device fails.
    pub fn write<T: Pod>(&mut self, device: &Device, byte_offset: u64, list: &[T]) -> Result<()> {
        let range = self.checked_range(byte_offset, size_of_val(list) as u64)?;
        if range.is_empty() {
            return Ok(());
        }
        let stream = device.stream();
        let copy_result = stream.memcpy_htod(bytemuck::cast_slice::<T, u8>(list), &mut self.slice.slice_mut(range));
        copy_result.and(stream.synchronize()).map_err(cuda_error("upload"))
    }

    /// Copies bytes from `byte_offset` to `target` after all work that was submitted earlier, and waits for the copy.
    ///
    /// # Errors
    /// `Fault` when the range exceeds the buffer, or when the device fails.
    pub fn read<T: Pod>(&self, device: &Device, byte_offset: u64, target: &mut [T]) -> Result<()> {
        self.checked_range(byte_offset, size_of_val(target) as u64)?;
        // SAFETY: `checked_range` verified that the buffer has the bytes of `target` from `byte_offset` on.
        unsafe { download(device, self.address() + byte_offset, target) }
    }

    /// The device address of the first byte, for arguments of kernels. It is valid while the buffer exists.
    pub fn address(&self) -> u64 {
        self.slice.device_ptr(self.slice.stream()).0
    }

    /// The stream that orders the release of the memory.
    pub(crate) fn stream(&self) -> &Arc<CudaStream> {
        self.slice.stream()
    }

    /// Size in bytes.
    pub const fn bytes(&self) -> u64 {
        self.bytes
    }

    fn checked_range(&self, byte_offset: u64, bytes: u64) -> Result<std::ops::Range<usize>> {
        match byte_offset.checked_add(bytes) {
            Some(end) if end <= self.bytes => Ok(byte_offset as usize..end as usize),
            _ => {
                let reason =
                    format!("expected a range within {} bytes, got {bytes} bytes at offset {byte_offset}", self.bytes);
                Err(Error::Fault { stage: "device memory", reason })
            }
        }
    }
}

/// Copies from the device and waits for the copy.
///
/// # Safety
/// `address` is that of at least as many bytes of device memory as `target` has.
pub(crate) unsafe fn download<T: Pod>(device: &Device, address: u64, target: &mut [T]) -> Result<()> {
    if target.is_empty() {
        return Ok(());
    }
    let _current = device.enter()?;
    let stream = device.stream();
    // SAFETY: the caller guarantees `address`; `target` remains borrowed until the stream is synchronized.
    let copy_result = unsafe { result::memcpy_dtoh_async(target, address, stream.cu_stream()) };
    let wait_result = stream.synchronize();
    copy_result.and(wait_result).map_err(cuda_error("download"))
}

/// Use of pinned host memory.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PinnedUse {
    /// The host writes, the device reads by copies or kernels. Write-combined: reads by the host are slow.
    ToDevice,
    /// The device writes, the host reads.
    FromDevice,
}

/// Pinned host memory, which is also mapped for kernels at the same address (unified addressing).
#[derive(Debug)]
pub struct PinnedBuffer<T>(PinnedHostSlice<T>);

impl<T: DeviceRepr + ValidAsZeroBits> PinnedBuffer<T> {
    /// Allocates `length` zeros.
    ///
    /// # Errors
    /// `Fault` when the driver cannot lock so much memory.
    pub fn zeroed(device: &Device, length: usize, pinned_use: PinnedUse) -> Result<Self> {
        let flags = match pinned_use {
            PinnedUse::ToDevice => sys::CU_MEMHOSTALLOC_WRITECOMBINED | sys::CU_MEMHOSTALLOC_DEVICEMAP,
            PinnedUse::FromDevice => 0,
        };
        // SAFETY: the memory is uninitialized until `write_bytes` below, before anything reads it.
        let pinned = unsafe { device.context().alloc_pinned_with_flags::<T>(length, flags) };
        let mut pinned = pinned.map_err(cuda_error("allocate"))?;
        let pointer = pinned.as_mut_ptr().map_err(cuda_error("allocate"))?;
        // SAFETY: the allocation has `length` aligned elements, and zero bits are a valid `T`.
        unsafe { pointer.write_bytes(0, length) };
        Ok(Self(pinned))
    }

    /// The content. The caller has waited for the last copy or kernel that accesses the memory.
    ///
    /// # Errors
    /// `Fault` when the device fails.
    pub fn as_slice(&self) -> Result<&[T]> {
        self.0.as_slice().map_err(cuda_error("pinned memory"))
    }

    /// The content, to write. The caller has waited for the last copy or kernel that accesses the memory.
    ///
    /// # Errors
    /// `Fault` when the device fails.
    pub fn as_mut_slice(&mut self) -> Result<&mut [T]> {
        self.0.as_mut_slice().map_err(cuda_error("pinned memory"))
    }

    /// The address of the first element, for kernels.
    pub(crate) fn address(&self) -> Result<u64> {
        self.0.as_ptr().map(|pointer| pointer as u64).map_err(cuda_error("pinned memory"))
    }
}

/// A page lock on host memory, which lets the device copy into that memory at full speed.
#[derive(Debug)]
pub(crate) struct PageLock {
    address: *mut c_void,
    context: Arc<CudaContext>,
}

impl PageLock {
    /// Page-locks a list if it is large enough. A refusal is no error: copies work without the lock, only slower.
    ///
    /// # Safety
    /// The list is neither moved nor freed before the lock is dropped.
    pub(crate) unsafe fn new(device: &Device, list: &mut [f32]) -> Option<Self> {
        // Smaller lists share their pages with other allocations, and copying them is fast anyway.
        const MIN_LOCKED_BYTES: usize = 1 << 20;
        let bytes = size_of_val(list);
        if bytes < MIN_LOCKED_BYTES {
            return None;
        }
        let _current = device.enter().ok()?;
        let address = list.as_mut_ptr().cast();
        // SAFETY: the range is that of a live list, which the caller keeps in place.
        let lock_result = unsafe { sys::cuMemHostRegister_v2(address, bytes, 0) }.result();
        lock_result.ok().map(|()| Self { address, context: Arc::clone(device.context()) })
    }
}

impl Drop for PageLock {
    fn drop(&mut self) {
        // Errors are ignored: no cleanup remains, and a failed device reports its error at the next call.
        let _current = CurrentContext::enter(&self.context);
        // SAFETY: `new` registered the range, and it is unregistered once.
        unsafe { sys::cuMemHostUnregister(self.address) }.result().ok();
    }
}
