//! Slots of memory that the server lends to a client.

use std::io;
use std::sync::Mutex;

use tokio::sync::Semaphore;

use crate::engine::lock;

/// Which slots are free, and which are lent to the client. In between, a slot is taken: the server writes it.
#[derive(Debug)]
pub(in crate::service) struct SlotPool {
    slots: Mutex<Slots>,
    /// One permit for each free slot. Closed when the connection has ended.
    free_slots: Semaphore,
}

#[derive(Debug)]
struct Slots {
    /// Free slots. The last one is used next, because its memory is most likely in a cache.
    free: Vec<u32>,
    /// Whether each slot is lent to the client.
    is_lent: Vec<bool>,
}

impl SlotPool {
    pub(super) fn new(count: usize) -> Self {
        let slots = Slots { free: (0..count as u32).rev().collect(), is_lent: vec![false; count] };
        Self { slots: Mutex::new(slots), free_slots: Semaphore::new(count) }
    }

    /// Takes a free slot. Waits until there is one. `None` if the connection has ended. Cancel-safe.
    pub(super) async fn take(&self) -> Option<u32> {
        self.free_slots.acquire().await.ok()?.forget();
        lock(&self.slots).free.pop()
    }

    /// Lends a slot that was taken, after its memory was written, because the client could otherwise guess the slot and
    /// return it before.
    pub(super) fn lend(&self, slot: u32) {
        if let Some(is_lent) = lock(&self.slots).is_lent.get_mut(slot as usize) {
            *is_lent = true;
        }
    }

    /// Frees a slot that was taken and not lent.
    pub(super) fn free(&self, slot: u32) {
        lock(&self.slots).free.push(slot);
        self.free_slots.add_permits(1);
    }

    /// Takes a slot back from the client.
    ///
    /// # Errors
    /// `InvalidData` if the client does not have this slot.
    pub(super) fn take_back(&self, slot: u32) -> io::Result<()> {
        if !lock(&self.slots).is_lent.get_mut(slot as usize).is_some_and(std::mem::take) {
            let reason = format!("expected a slot that was sent and not returned, got {slot}");
            return Err(io::Error::new(io::ErrorKind::InvalidData, reason));
        }
        self.free(slot);
        Ok(())
    }

    /// Ends the use of the slots for further data.
    pub(super) fn close(&self) {
        self.free_slots.close();
    }
}
