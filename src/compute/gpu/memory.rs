//! Device buffers, and host memory that the device copies into.

use std::ffi::c_void;
use std::sync::Arc;

use bytemuck::Pod;
use cudarc::driver::{CudaContext, CudaSlice, DevicePtr as _, result, sys};

use super::device::Device;
use modalcast_model::error::{Result, during};

/// Bytes on the device, zeroed.
pub fn room(device: &Device, bytes: u64) -> Result<CudaSlice<u8>> {
    // The driver refuses to allocate nothing, and a kernel that reads nothing still wants an address.
    let bytes = usize::try_from(bytes.max(16)).map_err(during("allocate"))?;
    device.stream().alloc_zeros(bytes).map_err(during("allocate"))
}

/// A new device buffer that holds a list.
pub fn upload<T: Pod>(device: &Device, list: &[T]) -> Result<CudaSlice<u8>> {
    let mut buffer = room(device, size_of_val(list) as u64)?;
    device.stream().memcpy_htod(bytemuck::cast_slice::<T, u8>(list), &mut buffer).map_err(during("upload"))?;
    Ok(buffer)
}

/// The address of a buffer on the device. All use of it is on the device's one stream.
pub fn address(device: &Device, buffer: &CudaSlice<u8>) -> u64 {
    buffer.device_ptr(device.stream()).0
}

/// Copies from the device and waits until the numbers are there.
///
/// # Safety
/// `from` is the address of at least as many bytes of device memory as `to` has.
pub unsafe fn download<T: Pod>(device: &Device, from: u64, to: &mut [T]) -> Result<()> {
    if to.is_empty() {
        return Ok(());
    }
    let stream = device.stream();
    // SAFETY: the caller vouches for `from`; `to` stays borrowed until the stream has been waited for.
    let copied = unsafe { result::memcpy_dtoh_async(to, from, stream.cu_stream()) };
    let waited = stream.synchronize();
    copied.and(waited).map_err(during("download"))
}

/// Host memory locked in place, so that the device copies into it at full speed.
#[derive(Debug)]
pub(super) struct PageLock {
    address: *mut c_void,
    context: Arc<CudaContext>,
}

impl PageLock {
    /// Locks a list when that pays; copies work without, only slower, so a refusal is no error.
    ///
    /// # Safety
    /// The list stays where it is, and lives, until the lock is dropped.
    pub(super) unsafe fn new(device: &Device, list: &mut [f32]) -> Option<Self> {
        // Smaller lists share their pages with strangers, and copying them is quick anyway.
        const WORTH_IT: usize = 1 << 20;
        let bytes = size_of_val(list);
        if bytes < WORTH_IT {
            return None;
        }
        let address = list.as_mut_ptr().cast();
        // SAFETY: the range is that of a live list; the caller keeps it there.
        let locked = unsafe { sys::cuMemHostRegister_v2(address, bytes, 0) }.result();
        locked.ok().map(|()| Self { address, context: Arc::clone(device.context()) })
    }
}

impl Drop for PageLock {
    fn drop(&mut self) {
        // Answers are dropped on purpose: nothing is left to be done, and a device that failed says so at its next call.
        self.context.bind_to_thread().ok();
        // SAFETY: it was registered by `new` and is unregistered once.
        unsafe { sys::cuMemHostUnregister(self.address) }.result().ok();
    }
}
