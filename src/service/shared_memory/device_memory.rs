//! Slots of device memory that a call lends to its client.

use std::sync::Arc;

use rustix::net::{SendAncillaryBuffer, SendAncillaryMessage, SendFlags, sendmsg};

use super::slot_pool::SlotPool;
use super::{CallMemory, ConnectionMemory};
use crate::engine::ExportedSlots;
use modalcast_model::error::{Result, fault_in, invalid};

/// The client returns slot n as this number plus n.
pub(super) const FIRST_DEVICE_SLOT: u32 = 1 << 31;

/// The number that announces device memory.
const ANNOUNCEMENT: u32 = u32::MAX;

/// The largest number of slots: the files of all of them are sent with one message.
const MAX_SLOTS: usize = 16;

/// The slots of a call. They end with this value.
#[derive(Debug)]
pub(in crate::service) struct DeviceMemory {
    slots: Arc<SlotPool>,
}

/// A slot that is written. Unless it is lent, it becomes free when this is dropped.
#[derive(Debug)]
pub(in crate::service) struct TakenSlot<'a> {
    slots: &'a SlotPool,
    number: u32,
    is_lent: bool,
}

impl CallMemory {
    /// Sends the files of device memory to the client of this call.
    ///
    /// # Errors
    /// `Invalid` for a call without shared memory, or whose connection has served such a call before; `Fault` if the
    /// client cannot receive the files.
    pub(in crate::service) fn send_device_memory(&self, exported: &ExportedSlots) -> Result<DeviceMemory> {
        let field = "device_slots";
        let Some(connection) = &self.0 else {
            return Err(invalid(field, "a call with shared memory", "a call without it"));
        };
        let slots = Arc::new(SlotPool::new(exported.files.len()));
        if connection.device_slots.set(Arc::clone(&slots)).is_err() {
            return Err(invalid(field, "a connection without an earlier call", "a second call"));
        }
        send_files(connection, exported)?;
        Ok(DeviceMemory { slots })
    }
}

fn send_files(connection: &ConnectionMemory, exported: &ExportedSlots) -> Result<()> {
    let files: Vec<_> = exported.files.iter().map(|(file, _)| std::os::fd::AsFd::as_fd(file)).collect();
    let numbers = [ANNOUNCEMENT, files.len() as u32].map(u32::to_le_bytes);
    let mut space = [std::mem::MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(MAX_SLOTS))];
    let mut control = SendAncillaryBuffer::new(&mut space);
    let has_space = control.push(SendAncillaryMessage::ScmRights(&files));
    let message = [std::io::IoSlice::new(numbers.as_flattened())];
    let flags = SendFlags::NOSIGNAL | SendFlags::DONTWAIT;
    let sent =
        sendmsg(connection.returns.as_ref(), &message, &mut control, flags).map_err(fault_in("device memory"))?;
    match has_space && sent == numbers.as_flattened().len() {
        true => Ok(()),
        false => Err(fault_in("device memory")(format!("expected to send {} files", files.len()))),
    }
}

impl DeviceMemory {
    /// Takes a free slot. Waits until the client returns one. `None` if its connection has ended.
    pub(in crate::service) async fn take(&self) -> Option<TakenSlot<'_>> {
        let number = self.slots.take().await?;
        Some(TakenSlot { slots: &self.slots, number, is_lent: false })
    }
}

impl Drop for DeviceMemory {
    fn drop(&mut self) {
        self.slots.close();
    }
}

impl TakenSlot<'_> {
    pub(in crate::service) const fn number(&self) -> u32 {
        self.number
    }

    /// Lends the slot to the client. Its memory is complete.
    pub(in crate::service) fn lend(mut self) -> u32 {
        self.is_lent = true;
        self.slots.lend(self.number);
        self.number
    }
}

impl Drop for TakenSlot<'_> {
    fn drop(&mut self) {
        if !self.is_lent {
            self.slots.free(self.number);
        }
    }
}
