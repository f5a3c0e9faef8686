//! The memory in which a client sends the values of its steps.

use std::io;
use std::os::fd::OwnedFd;

use bytes::Bytes;
use memmap2::{MmapOptions, MmapRaw};
use modalcast_proto::v1;
use rustix::fs::{MemfdFlags, SealFlags, fcntl_add_seals, ftruncate, memfd_create};

use super::reply_memory::{SLOT_BYTES, SLOT_COUNT};
use modalcast_model::error::{Result, invalid};

/// Slots that the client fills. The client may write to them at any time, so they are only copied, and the copy is
/// validated.
#[derive(Debug)]
pub(super) struct RequestMemory {
    mapping: MmapRaw,
}

impl RequestMemory {
    /// Creates the memory, and returns it with a file through which a client can write to it. The size of the file
    /// cannot change.
    pub(super) fn new() -> io::Result<(Self, OwnedFd)> {
        let file = memfd_create("modalcast-requests", MemfdFlags::CLOEXEC | MemfdFlags::ALLOW_SEALING)?;
        ftruncate(&file, (SLOT_COUNT * SLOT_BYTES) as u64)?;
        fcntl_add_seals(&file, SealFlags::SHRINK | SealFlags::GROW | SealFlags::SEAL)?;
        let mapping = MmapOptions::new().len(SLOT_COUNT * SLOT_BYTES).map_raw_read_only(&file)?;
        Ok((Self { mapping }, file))
    }

    /// Copies the data of a range. `field` names the range in errors.
    ///
    /// # Errors
    /// `Invalid` if the range is not within a slot.
    pub(super) fn copy(&self, field: &str, range: v1::SharedRange) -> Result<Bytes> {
        let (slot, bytes) = (range.slot as usize, range.bytes as usize);
        if slot >= SLOT_COUNT || bytes > SLOT_BYTES {
            let expected = format!("at most {SLOT_BYTES} bytes in one of {SLOT_COUNT} slots");
            return Err(invalid(field, expected, format!("{bytes} bytes in slot {slot}")));
        }
        let mut data = Vec::with_capacity(bytes);
        // SAFETY: the range is within the mapping, whose file cannot shrink, and `data` has the capacity. The client
        // may write to the range at the same time, which can only mix old and new bytes: no reference to the memory
        // exists, and every byte is a valid u8.
        unsafe {
            std::ptr::copy_nonoverlapping(self.mapping.as_ptr().add(slot * SLOT_BYTES), data.as_mut_ptr(), bytes);
            data.set_len(bytes);
        }
        Ok(data.into())
    }
}

#[cfg(test)]
mod tests {
    use rustix::fs::fcntl_get_seals;

    use super::*;

    #[test]
    fn only_ranges_within_a_slot_are_copied() {
        let (memory, file) = RequestMemory::new().expect("expected memory");
        let slot = SLOT_COUNT as u32 - 1;
        rustix::io::pwrite(&file, b"values", u64::from(slot) * SLOT_BYTES as u64).expect("expected a written file");
        let copy = |slot, bytes| memory.copy("step.shared_q", v1::SharedRange { slot, bytes });
        assert_eq!(copy(slot, 6).expect("expected data"), &b"values"[..]);
        assert_eq!(copy(0, SLOT_BYTES as u32).expect("expected data").len(), SLOT_BYTES);
        for (slot, bytes) in [(slot + 1, 0), (u32::MAX, 1), (slot, SLOT_BYTES as u32 + 1), (0, u32::MAX)] {
            let error = copy(slot, bytes).expect_err("expected an error").to_string();
            assert!(error.starts_with("step.shared_q: "), "{error}");
        }
    }

    #[test]
    fn size_of_the_file_is_sealed() {
        let (_memory, file) = RequestMemory::new().expect("expected memory");
        let seals = fcntl_get_seals(&file).expect("expected seals");
        assert!(seals.contains(SealFlags::SHRINK | SealFlags::GROW | SealFlags::SEAL));
        assert!(ftruncate(&file, 0).is_err());
    }
}
