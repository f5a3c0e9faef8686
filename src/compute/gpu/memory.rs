//! Device buffers, and page-locked host memory for readbacks.

use std::ffi::c_void;
use std::sync::Arc;

use bytemuck::Pod;
use cudarc::driver::{CudaContext, CudaSlice, DevicePtr as _, result, sys};

use super::device::Device;
use modalcast_model::error::{Result, fault_in};

/// Allocates zeroed bytes on the device.
pub fn alloc_zeroed(device: &Device, bytes: u64) -> Result<CudaSlice<u8>> {
    // The driver refuses an allocation of zero bytes, and a kernel that reads nothing still needs a valid address.
    let bytes = usize::try_from(bytes.max(16)).map_err(fault_in("allocate"))?;
    device.stream().alloc_zeros(bytes).map_err(fault_in("allocate"))
}

/// Uploads a list into a new device buffer.
pub fn upload<T: Pod>(device: &Device, list: &[T]) -> Result<CudaSlice<u8>> {
    let mut buffer = alloc_zeroed(device, size_of_val(list) as u64)?;
    device.stream().memcpy_htod(bytemuck::cast_slice::<T, u8>(list), &mut buffer).map_err(fault_in("upload"))?;
    Ok(buffer)
}

/// The device address of a buffer. All uses must be ordered on the device's one stream.
pub fn address(device: &Device, buffer: &CudaSlice<u8>) -> u64 {
    buffer.device_ptr(device.stream()).0
}

/// Copies from the device and waits for the copy.
///
/// # Safety
/// `from` is the address of at least as many bytes of device memory as `to` has.
pub unsafe fn download<T: Pod>(device: &Device, from: u64, to: &mut [T]) -> Result<()> {
    if to.is_empty() {
        return Ok(());
    }
    let stream = device.stream();
    // SAFETY: the caller guarantees `from`; `to` remains borrowed until the stream is synchronized.
    let copied = unsafe { result::memcpy_dtoh_async(to, from, stream.cu_stream()) };
    let waited = stream.synchronize();
    copied.and(waited).map_err(fault_in("download"))
}

/// Host memory that is page-locked in place, so that the device copies into it at full speed.
#[derive(Debug)]
pub(super) struct PageLock {
    address: *mut c_void,
    context: Arc<CudaContext>,
}

impl PageLock {
    /// Page-locks a list if it is large enough. A refusal is no error: copies work without the lock, only slower.
    ///
    /// # Safety
    /// The list is neither moved nor freed before the lock is dropped.
    pub(super) unsafe fn new(device: &Device, list: &mut [f32]) -> Option<Self> {
        // Smaller lists share their pages with other allocations, and copying them is fast anyway.
        const MIN_LOCKED_BYTES: usize = 1 << 20;
        let bytes = size_of_val(list);
        if bytes < MIN_LOCKED_BYTES {
            return None;
        }
        let address = list.as_mut_ptr().cast();
        // SAFETY: the range is that of a live list, which the caller keeps in place.
        let locked = unsafe { sys::cuMemHostRegister_v2(address, bytes, 0) }.result();
        locked.ok().map(|()| Self { address, context: Arc::clone(device.context()) })
    }
}

impl Drop for PageLock {
    fn drop(&mut self) {
        // Errors are ignored: no cleanup remains, and a failed device reports its error at the next call.
        self.context.bind_to_thread().ok();
        // SAFETY: `new` registered the range, and it is unregistered once.
        unsafe { sys::cuMemHostUnregister(self.address) }.result().ok();
    }
}
