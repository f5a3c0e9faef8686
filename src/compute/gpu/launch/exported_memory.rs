//! Device memory that another API can import: an allocation with a file descriptor, mapped at an address of CUDA.

use std::os::fd::{FromRawFd as _, OwnedFd, RawFd};
use std::sync::Arc;

use cudarc::driver::CudaContext;
use cudarc::driver::sys::{self, CUmemAllocationHandleType_enum as HandleType};

use super::context::CurrentContext;
use super::device::Device;
use super::error::cuda_error;
use modalcast_model::error::{Result, fault, fault_in};

const STAGE: &str = "shared memory";

/// Exportable device memory. Its content is undefined at first. The importing API holds its own reference to the
/// memory.
///
/// The owner waits for all CUDA work on the memory before it drops this value, because dropping it ends the mapping at
/// once.
#[derive(Debug)]
pub(crate) struct ExportedMemory {
    // The fields are dropped in this order.
    _mapping: Mapping,
    range: AddressRange,
    allocation: Allocation,
}

/// A physical allocation.
#[derive(Debug)]
struct Allocation {
    handle: sys::CUmemGenericAllocationHandle,
    context: Arc<CudaContext>,
}

/// A reserved range of addresses.
#[derive(Debug)]
struct AddressRange {
    address: u64,
    bytes: usize,
    context: Arc<CudaContext>,
}

/// An allocation that is mapped at a range of addresses.
#[derive(Debug)]
struct Mapping {
    address: u64,
    bytes: usize,
    context: Arc<CudaContext>,
}

impl ExportedMemory {
    /// Allocates at least `bytes` bytes, rounded up to the granularity of the device.
    ///
    /// # Errors
    /// `Fault` if the device has not enough memory, or cannot export memory as a file descriptor.
    pub(crate) fn new(device: &Device, bytes: usize) -> Result<Self> {
        let _current = device.enter()?;
        let location = sys::CUmemLocation {
            type_: sys::CUmemLocationType::CU_MEM_LOCATION_TYPE_DEVICE,
            id: device.context().cu_device(),
        };
        let properties = sys::CUmemAllocationProp {
            type_: sys::CUmemAllocationType::CU_MEM_ALLOCATION_TYPE_PINNED,
            requestedHandleTypes: HandleType::CU_MEM_HANDLE_TYPE_POSIX_FILE_DESCRIPTOR,
            location,
            win32HandleMetaData: std::ptr::null_mut(),
            allocFlags: sys::CUmemAllocationProp_st__bindgen_ty_1 {
                compressionType: 0,
                gpuDirectRDMACapable: 0,
                usage: 0,
                reserved: [0; 4],
            },
        };
        let bytes = round_up(bytes, granularity(&properties)?)?;
        let allocation = Allocation::new(device, bytes, &properties)?;
        let range = AddressRange::reserve(device, bytes)?;
        let mapping = Mapping::new(&allocation, &range)?;
        let access =
            sys::CUmemAccessDesc { location, flags: sys::CUmemAccess_flags::CU_MEM_ACCESS_FLAGS_PROT_READWRITE };
        // SAFETY: the range is mapped as a whole, and `access` is one descriptor.
        unsafe { sys::cuMemSetAccess(range.address, bytes, &raw const access, 1) }
            .result()
            .map_err(cuda_error(STAGE))?;
        Ok(Self { _mapping: mapping, range, allocation })
    }

    /// A file descriptor with which another API imports the memory.
    ///
    /// # Errors
    /// `Fault` when the driver cannot export the memory.
    pub(crate) fn export(&self) -> Result<OwnedFd> {
        let _current = CurrentContext::enter(&self.allocation.context)?;
        let mut descriptor: RawFd = -1;
        // SAFETY: for this type of handle, the driver writes one file descriptor.
        let result = unsafe {
            sys::cuMemExportToShareableHandle(
                (&raw mut descriptor).cast(),
                self.allocation.handle,
                HandleType::CU_MEM_HANDLE_TYPE_POSIX_FILE_DESCRIPTOR,
                0,
            )
        };
        result.result().map_err(cuda_error(STAGE))?;
        if descriptor < 0 {
            return Err(fault(STAGE, format!("expected a file descriptor, got {descriptor}")));
        }
        // SAFETY: the driver created the descriptor for the caller, and nothing else owns it.
        Ok(unsafe { OwnedFd::from_raw_fd(descriptor) })
    }

    /// Device address of the first byte. It is valid while this value exists.
    pub(crate) const fn address(&self) -> u64 {
        self.range.address
    }

    /// Size of the allocation in bytes.
    pub(crate) const fn bytes(&self) -> usize {
        self.range.bytes
    }
}

impl Allocation {
    fn new(device: &Device, bytes: usize, properties: &sys::CUmemAllocationProp) -> Result<Self> {
        let mut handle = 0;
        // SAFETY: both pointers are live.
        unsafe { sys::cuMemCreate(&raw mut handle, bytes, properties, 0) }.result().map_err(cuda_error(STAGE))?;
        Ok(Self { handle, context: Arc::clone(device.context()) })
    }
}

impl AddressRange {
    fn reserve(device: &Device, bytes: usize) -> Result<Self> {
        let mut address = 0;
        // SAFETY: `address` is live. 0 lets the driver choose the alignment and the address.
        let result = unsafe { sys::cuMemAddressReserve(&raw mut address, bytes, 0, 0, 0) };
        result.result().map_err(cuda_error(STAGE))?;
        Ok(Self { address, bytes, context: Arc::clone(device.context()) })
    }
}

impl Mapping {
    /// Maps an allocation at a range of the same size.
    fn new(allocation: &Allocation, range: &AddressRange) -> Result<Self> {
        // SAFETY: the range is reserved, not mapped yet, and as large as the allocation.
        let result = unsafe { sys::cuMemMap(range.address, range.bytes, 0, allocation.handle, 0) };
        result.result().map_err(cuda_error(STAGE))?;
        Ok(Self { address: range.address, bytes: range.bytes, context: Arc::clone(&allocation.context) })
    }
}

// Errors of the cleanup are ignored: there is no other cleanup, and a failed device reports its error at the next call.

impl Drop for Allocation {
    fn drop(&mut self) {
        let _current = CurrentContext::enter(&self.context);
        // SAFETY: created once and released once; the mapping has ended before.
        unsafe { sys::cuMemRelease(self.handle) }.result().ok();
    }
}

impl Drop for AddressRange {
    fn drop(&mut self) {
        let _current = CurrentContext::enter(&self.context);
        // SAFETY: reserved once and freed once; the mapping has ended before.
        unsafe { sys::cuMemAddressFree(self.address, self.bytes) }.result().ok();
    }
}

impl Drop for Mapping {
    fn drop(&mut self) {
        let _current = CurrentContext::enter(&self.context);
        // SAFETY: mapped once and unmapped once. The owner has waited for all work on the memory.
        unsafe { sys::cuMemUnmap(self.address, self.bytes) }.result().ok();
    }
}

/// The smallest unit of an allocation with these properties, in bytes.
fn granularity(properties: &sys::CUmemAllocationProp) -> Result<usize> {
    let mut granularity = 0;
    let option = sys::CUmemAllocationGranularity_flags::CU_MEM_ALLOC_GRANULARITY_MINIMUM;
    // SAFETY: both pointers are live.
    unsafe { sys::cuMemGetAllocationGranularity(&raw mut granularity, properties, option) }
        .result()
        .map_err(cuda_error(STAGE))?;
    Ok(granularity.max(1))
}

/// The next multiple of `granularity`, at least one.
fn round_up(bytes: usize, granularity: usize) -> Result<usize> {
    let units = bytes.max(1).div_ceil(granularity);
    units
        .checked_mul(granularity)
        .ok_or_else(|| fault_in(STAGE)(format!("expected a size that fits in 64 bits when rounded up, got {bytes}")))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_rounded_up_to_whole_units() {
        for (bytes, expected) in [(0, 4096), (1, 4096), (4096, 4096), (4097, 8192)] {
            assert_eq!(round_up(bytes, 4096), Ok(expected), "{bytes}");
        }
        round_up(usize::MAX, 4096).expect_err("expected an error instead of an overflow");
    }
}
