//! The memory in which a client receives replies: slots that the server fills, and that the client reads and returns.

use std::io;
use std::os::fd::OwnedFd;

use bytes::Bytes;
use memmap2::{MmapOptions, MmapRaw};
use modalcast_proto::v1;
use rustix::fs::{MemfdFlags, SealFlags, fcntl_add_seals, ftruncate, memfd_create};

use super::slot_pool::SlotPool;
use crate::admission::Permit;

/// Size of a slot in bytes: the largest chunk of a reply.
pub(super) const SLOT_BYTES: usize = 1 << 20;

/// Number of slots of a connection. The client copies a slot while the server fills the next ones. With more slots, a
/// slow client would only read steps that are further out of date.
pub(super) const SLOT_COUNT: usize = 8;

/// Data of at least this size are put into a slot. Sending fewer bytes costs less than copying them to a slot and
/// returning the slot.
const MIN_SHARED_BYTES: usize = 64 << 10;

/// The slots of a connection. The memory is freed when this is dropped.
#[derive(Debug)]
pub(in crate::service) struct ReplyMemory {
    mapping: MmapRaw,
    slots: SlotPool,
    /// Counts the connection against the limit on connections.
    _permit: Permit,
}

impl ReplyMemory {
    /// Creates the memory, and returns it with a file through which a client can read it. The size of the file cannot
    /// change, and only the mapping of this process can write to it.
    pub(super) fn new(permit: Permit) -> io::Result<(Self, OwnedFd)> {
        let file = memfd_create("modalcast-replies", MemfdFlags::CLOEXEC | MemfdFlags::ALLOW_SEALING)?;
        ftruncate(&file, (SLOT_COUNT * SLOT_BYTES) as u64)?;
        let mapping = MmapOptions::new().len(SLOT_COUNT * SLOT_BYTES).map_raw(&file)?;
        // The mapping above remains writable.
        fcntl_add_seals(&file, SealFlags::SHRINK | SealFlags::GROW | SealFlags::FUTURE_WRITE | SealFlags::SEAL)?;
        Ok((Self { mapping, slots: SlotPool::new(SLOT_COUNT), _permit: permit }, file))
    }

    /// Copies data into a free slot, which belongs to the client until it returns the slot. Waits for a free slot.
    /// Returns `None` and keeps the data if they are small or the connection has ended. Cancel-safe.
    pub(super) async fn lend(&self, data: &mut Bytes) -> Option<v1::SharedRange> {
        if !(MIN_SHARED_BYTES..=SLOT_BYTES).contains(&data.len()) {
            return None;
        }
        let slot = self.slots.take().await?;
        self.write(slot as usize, data);
        self.slots.lend(slot);
        Some(v1::SharedRange { slot, bytes: std::mem::take(data).len() as u32 })
    }

    /// Copies at most [`SLOT_BYTES`] into a slot.
    fn write(&self, slot: usize, data: &[u8]) {
        let bytes = data.len().min(SLOT_BYTES);
        // SAFETY: `slot` comes from the list of free slots, so it is below SLOT_COUNT and its SLOT_BYTES are within the
        // mapping, which lives as long as `self`. No other thread writes to the slot: it was taken, and `take_back` does
        // not accept it before it is lent, after this copy. This process never reads the mapping, and has no reference to
        // the mapping's bytes: `data` is other memory.
        unsafe {
            let target = self.mapping.as_mut_ptr().add(slot * SLOT_BYTES);
            std::ptr::copy_nonoverlapping(data.as_ptr(), target, bytes);
        }
    }

    /// Takes a slot back from the client.
    ///
    /// # Errors
    /// `InvalidData` if the client does not have this slot.
    pub(super) fn take_back(&self, slot: u32) -> io::Result<()> {
        self.slots.take_back(slot)
    }

    /// Ends the use of the memory for further data.
    pub(super) fn close(&self) {
        self.slots.close();
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use rustix::fs::{fcntl_get_seals, fstat};

    use super::*;
    use crate::admission::Limit;

    fn new_memory() -> (ReplyMemory, OwnedFd) {
        ReplyMemory::new(Permit::for_test(Limit::SHARED_MEMORY)).expect("expected memory")
    }

    fn data(byte: u8) -> Bytes {
        vec![byte; SLOT_BYTES - usize::from(byte)].into()
    }

    #[tokio::test]
    async fn client_reads_the_data_until_it_returns_the_slot() {
        let (memory, file) = new_memory();
        let mapping = MmapOptions::new().map_raw_read_only(&file).expect("expected a mapping");
        let mut ranges = Vec::new();
        for byte in 0..SLOT_COUNT as u8 {
            let mut sent = data(byte);
            ranges.push(memory.lend(&mut sent).await.expect("expected a free slot"));
            assert!(sent.is_empty());
        }
        let mut last = data(100);
        let waiting = tokio::time::timeout(Duration::from_millis(20), memory.lend(&mut last)).await;
        assert!(waiting.is_err() && last == data(100), "expected no free slot, and data that are kept");
        for (byte, range) in ranges.iter().enumerate() {
            assert_eq!(range.bytes as usize, SLOT_BYTES - byte);
            // SAFETY: the slot is within the mapping, and nothing writes to it until it is returned below.
            let read = unsafe {
                let start = mapping.as_ptr().add(range.slot as usize * SLOT_BYTES);
                std::slice::from_raw_parts(start, range.bytes as usize)
            };
            assert_eq!(read, data(byte as u8));
        }
        memory.take_back(ranges[3].slot).expect("expected a lent slot");
        assert_eq!(memory.lend(&mut last).await.map(|range| range.slot), Some(ranges[3].slot));
    }

    #[tokio::test]
    async fn only_a_lent_slot_can_be_returned() {
        let (memory, _) = new_memory();
        let slot = memory.lend(&mut data(0)).await.expect("expected a free slot").slot;
        for wrong_slot in [slot + 1, SLOT_COUNT as u32, u32::MAX] {
            assert!(memory.take_back(wrong_slot).is_err(), "{wrong_slot}");
        }
        memory.take_back(slot).expect("expected a lent slot");
        assert!(memory.take_back(slot).is_err(), "expected an error of the second return");
    }

    #[tokio::test]
    async fn small_data_and_data_after_the_end_are_kept() {
        let (memory, _) = new_memory();
        for length in [0, MIN_SHARED_BYTES - 1, SLOT_BYTES + 1] {
            let mut kept = Bytes::from(vec![1; length]);
            assert_eq!((memory.lend(&mut kept).await, kept.len()), (None, length));
        }
        memory.close();
        let mut kept = data(1);
        assert_eq!((memory.lend(&mut kept).await, kept), (None, data(1)));
    }

    #[test]
    fn file_cannot_be_changed_by_its_receiver() {
        let (_memory, file) = new_memory();
        let seals = fcntl_get_seals(&file).expect("expected seals");
        assert!(seals.contains(SealFlags::SHRINK | SealFlags::GROW | SealFlags::FUTURE_WRITE | SealFlags::SEAL));
        assert_eq!(fstat(&file).expect("expected a size").st_size, (SLOT_COUNT * SLOT_BYTES) as i64);
        assert!(ftruncate(&file, 0).is_err());
        assert!(MmapOptions::new().map_raw(&file).is_err(), "expected no writable mapping");
        assert!(rustix::io::write(&file, &[0]).is_err());
    }
}
