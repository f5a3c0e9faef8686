//! The values of steps (q and transforms) in shared memory. Each array of a step takes one slot of the memory.

use std::io;
use std::sync::Arc;

use bytes::Bytes;
use modalcast_proto::v1;

use super::MemoryConnection;

/// Values of at least this size are put into a slot. For fewer bytes, sending them costs less than copying them to a
/// slot and returning it.
const MIN_SHARED_BYTES: usize = 64 << 10;

/// The memory for the values of the steps of one stream.
#[derive(Debug)]
pub(crate) struct StepMemory {
    /// `None` after the server has closed the connection. Further values are sent in their messages.
    connection: Option<Arc<MemoryConnection>>,
    free_slots: Vec<u32>,
    /// The first bytes of the number of a slot that the server returns, and how many there are.
    returned: ([u8; 4], usize),
}

impl StepMemory {
    pub(super) fn new(connection: Arc<MemoryConnection>) -> Self {
        let free_slots = (0..connection.slot_count as u32).rev().collect();
        Self { connection: Some(connection), free_slots, returned: ([0; 4], 0) }
    }

    /// Moves large values of a step to shared memory. Waits for free slots, which the server returns when it has copied
    /// earlier values. Cancel-safe, except that slots which were filled before the cancellation may stay unused.
    pub(crate) async fn share(&mut self, step: &mut v1::Step) {
        step.shared_q = self.put(&mut step.q).await;
        step.shared_transforms = self.put(&mut step.transforms).await;
    }

    /// Moves values to a slot. Returns `None` and keeps the values if they are sent in the message.
    async fn put(&mut self, values: &mut Bytes) -> Option<v1::SharedRange> {
        let connection = Arc::clone(self.connection.as_ref()?);
        if !(MIN_SHARED_BYTES..=connection.slot_bytes).contains(&values.len()) {
            return None;
        }
        while self.free_slots.is_empty() {
            match self.receive_slot(&connection).await {
                Ok(slot) => self.free_slots.push(slot),
                Err(_) => {
                    self.connection = None;
                    return None;
                }
            }
        }
        let slot = self.free_slots.pop()?;
        let (start, bytes) = (slot as usize * connection.slot_bytes, values.len());
        // SAFETY: the slot is below the number of slots and `bytes` is at most the size of a slot, so the target is in
        // the mapping, whose file cannot shrink. `values` is no part of it, and no reference to the mapping exists. The
        // server only reads it, and does not read a free slot.
        unsafe {
            std::ptr::copy_nonoverlapping(values.as_ptr(), connection.requests.as_mut_ptr().add(start), bytes);
        }
        *values = Bytes::new();
        Some(v1::SharedRange { slot, bytes: bytes as u32 })
    }

    /// Waits for a slot that the server returns. Cancel-safe.
    ///
    /// # Errors
    /// The connection has ended, or the server has returned a slot that does not exist.
    async fn receive_slot(&mut self, connection: &MemoryConnection) -> io::Result<u32> {
        loop {
            let (number, received) = &mut self.returned;
            if *received == number.len() {
                *received = 0;
                let slot = u32::from_le_bytes(*number);
                let is_valid = (slot as usize) < connection.slot_count && !self.free_slots.contains(&slot);
                return if is_valid { Ok(slot) } else { Err(io::ErrorKind::InvalidData.into()) };
            }
            connection.socket.readable().await?;
            match connection.socket.try_read(&mut number[*received..]) {
                Ok(0) => return Err(io::ErrorKind::UnexpectedEof.into()),
                Ok(bytes) => *received += bytes,
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
                Err(error) => return Err(error),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use tokio::io::AsyncWriteExt as _;

    use super::super::tests::{FakeServer, Handshake, acquire};
    use super::*;

    const SLOT_BYTES: usize = 1 << 20;

    /// A server with two slots of 1 MiB, its socket, and the memory of a step stream.
    async fn connect() -> (FakeServer, tokio::net::UnixStream, StepMemory) {
        let numbers = [1, SLOT_BYTES as u32, 2, 0];
        let server =
            FakeServer::start(Handshake { numbers, file_bytes: 2 * SLOT_BYTES as u64, ..Handshake::default() });
        let (memory, socket) = server.connect().await;
        let call = acquire(&memory.expect("expected memory")).await;
        (server, socket, call.into_step_memory().expect("expected memory"))
    }

    fn step(q_bytes: usize, transform_bytes: usize) -> v1::Step {
        v1::Step { q: vec![1; q_bytes].into(), transforms: vec![2; transform_bytes].into(), ..Default::default() }
    }

    #[tokio::test]
    async fn values_wait_for_slots_that_the_server_returns() {
        let (server, mut socket, mut memory) = connect().await;
        let mut first = step(MIN_SHARED_BYTES, SLOT_BYTES);
        memory.share(&mut first).await;
        let range = |slot, bytes: usize| Some(v1::SharedRange { slot, bytes: bytes as u32 });
        let expected = v1::Step {
            shared_q: range(0, MIN_SHARED_BYTES),
            shared_transforms: range(1, SLOT_BYTES),
            ..Default::default()
        };
        assert_eq!(first, expected);
        let mut content = vec![0; 2 * SLOT_BYTES];
        rustix::io::pread(&server.file, &mut content[..], 0).expect("expected a file");
        assert!(content[..MIN_SHARED_BYTES].iter().all(|byte| *byte == 1));
        assert!(content[SLOT_BYTES..].iter().all(|byte| *byte == 2));
        let mut second = step(SLOT_BYTES, 0);
        let waiting = tokio::time::timeout(Duration::from_millis(20), memory.share(&mut second)).await;
        assert!(waiting.is_err() && second == step(SLOT_BYTES, 0), "expected no free slot");
        // The number arrives in two parts, and the wait is cancelled between them.
        socket.write_all(&[1, 0]).await.expect("expected a client");
        tokio::time::timeout(Duration::from_millis(20), memory.share(&mut second)).await.expect_err("half a number");
        socket.write_all(&[0, 0]).await.expect("expected a client");
        memory.share(&mut second).await;
        assert_eq!((second.shared_q, second.q.len()), (range(1, SLOT_BYTES), 0));
    }

    #[tokio::test]
    async fn small_values_and_values_after_the_end_are_kept() {
        let (_server, mut socket, mut memory) = connect().await;
        let mut kept = step(MIN_SHARED_BYTES - 1, SLOT_BYTES + 1);
        memory.share(&mut kept).await;
        assert_eq!(kept, step(MIN_SHARED_BYTES - 1, SLOT_BYTES + 1));
        memory.share(&mut step(SLOT_BYTES, SLOT_BYTES)).await;
        // A slot that does not exist ends the use of the memory, as the end of the connection does.
        socket.write_u32_le(2).await.expect("expected a client");
        for _ in 0..2 {
            let mut kept = step(SLOT_BYTES, 0);
            memory.share(&mut kept).await;
            assert_eq!(kept, step(SLOT_BYTES, 0));
        }
        let (_server, socket, mut memory) = connect().await;
        memory.share(&mut step(SLOT_BYTES, SLOT_BYTES)).await;
        drop(socket);
        let mut kept = step(SLOT_BYTES, 0);
        memory.share(&mut kept).await;
        assert_eq!(kept, step(SLOT_BYTES, 0));
    }
}
