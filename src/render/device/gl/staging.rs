//! Staging buffers for readback. With OpenGL 4.4 they are persistently mapped: any thread can copy from them once a
//! fence has passed, without an OpenGL call.

use std::cell::RefCell;
use std::mem;
use std::rc::Rc;
use std::sync::mpsc::{self, Receiver, RecvTimeoutError, SyncSender, TryRecvError};
use std::time::Duration;

use glow::HasContext as _;

use super::object::BufferObject;
use super::{Buffer, Gl};
use modalcast_model::error::{Result, fault_in};

/// A buffer that the device writes and the host reads.
#[derive(Debug)]
pub(crate) struct StagingBuffer {
    pub(crate) buffer: Buffer,
    /// Address of the persistent mapping; none where the context does not support it.
    mapped: Option<*const u8>,
    /// Disconnects when the current reader is done.
    reader: RefCell<Option<Receiver<()>>>,
}

/// The buffer of a dropped staging buffer that a reader still uses.
pub(super) struct RetiredBuffer {
    /// Keeps the mapping.
    _object: Rc<BufferObject>,
    reader: Receiver<()>,
}

/// Bytes of a staging buffer that any thread may copy. While this value exists, the bytes stay mapped and the device
/// does not write them, so it must be short-lived.
#[derive(Debug)]
pub(crate) enum ReadbackView {
    /// Address and length of the mapped bytes. Dropping the sender tells the staging buffer that the reader is done.
    Mapped {
        first: *const u8,
        bytes: usize,
        _done: SyncSender<()>,
    },
    Copied(Vec<u8>),
}

// SAFETY: the memory is mapped for reading only. Nothing writes it before the staging buffer sees that this value was
// dropped, and it is unmapped after that or never.
unsafe impl Send for ReadbackView {}

impl Gl {
    /// Creates a staging buffer of `bytes` bytes, persistently mapped if possible.
    pub(crate) fn staging(self: &Rc<Self>, bytes: u64) -> Result<StagingBuffer> {
        self.free_retired_buffers(Duration::ZERO);
        let reader = RefCell::default();
        if !self.limits.persistent_mapping {
            return Ok(StagingBuffer { buffer: self.buffer(bytes, glow::STREAM_READ, None)?, mapped: None, reader });
        }
        let size = i32::try_from(bytes).map_err(fault_in("readback"))?;
        let access = glow::MAP_READ_BIT | glow::MAP_PERSISTENT_BIT | glow::MAP_COHERENT_BIT;
        let gl = self.functions()?;
        // SAFETY: a new name, which the buffer owns.
        let name = unsafe { gl.create_buffer() }.map_err(fault_in("readback"))?;
        let buffer = Buffer::new(self, name, bytes);
        // SAFETY: immutable storage, mapped as a whole for reading, for as long as the buffer exists: OpenGL unmaps it
        // when the name is deleted.
        let mapped = unsafe {
            gl.bind_buffer(glow::COPY_READ_BUFFER, Some(name));
            gl.buffer_storage(glow::COPY_READ_BUFFER, size, None, access | glow::CLIENT_STORAGE_BIT);
            gl.map_buffer_range(glow::COPY_READ_BUFFER, 0, size, access)
        };
        self.check("readback")?;
        if mapped.is_null() {
            return Err(fault_in("readback")(format!("{bytes} bytes cannot be mapped")));
        }
        Ok(StagingBuffer { buffer, mapped: Some(mapped.cast_const()), reader })
    }

    /// Frees the retired buffers whose readers are done, after waiting for each reader at most `limit`. Buffers that
    /// are still read survive, and with them the context: a leak is better than a read of unmapped memory.
    pub(crate) fn free_retired_buffers(&self, limit: Duration) {
        let mut retired = mem::take(&mut *self.retired.borrow_mut());
        retired.retain(|buffer| !is_done(&buffer.reader, limit));
        self.retired.borrow_mut().extend(retired);
    }
}

impl StagingBuffer {
    /// The first `bytes` bytes. Call it once a fence after the last command that writes them has passed; no command may write
    /// the buffer while the bytes are lent.
    ///
    /// # Errors
    /// `Fault` when the buffer is smaller or cannot be mapped.
    pub(crate) fn view(&self, bytes: usize) -> Result<ReadbackView> {
        if bytes as u64 > self.buffer.bytes {
            return Err(fault_in("readback")(format!("expected at most {} bytes, got {bytes}", self.buffer.bytes)));
        }
        let Some(first) = self.mapped else { return self.buffer.read(bytes).map(ReadbackView::Copied) };
        // No message is ever sent; the reader signals with the disconnect alone.
        let (done, reader) = mpsc::sync_channel(1);
        self.reader.replace(Some(reader));
        Ok(ReadbackView::Mapped { first, bytes, _done: done })
    }

    /// Waits at most `limit` for the reader and returns whether it is done.
    pub(crate) fn is_read(&self, limit: Duration) -> bool {
        let mut reader = self.reader.borrow_mut();
        let over = reader.as_ref().is_none_or(|reader| is_done(reader, limit));
        if over {
            *reader = None;
        }
        over
    }

    /// Copies a range of bytes, under the same conditions as [`Self::view`].
    pub(crate) fn read(&self, range: std::ops::Range<usize>) -> Result<Vec<u8>> {
        let view = self.view(range.end)?;
        view.bytes()
            .get(range)
            .map(<[u8]>::to_vec)
            .ok_or_else(|| fault_in("readback")("the range ends before its start"))
    }
}

impl Drop for StagingBuffer {
    /// Does not wait for the reader, which may run on this thread.
    fn drop(&mut self) {
        if let Some(reader) = self.reader.take().filter(|reader| !is_done(reader, Duration::ZERO)) {
            let object = self.buffer.object();
            let retired = RetiredBuffer { _object: Rc::clone(object), reader };
            object.gl.retired.borrow_mut().push(retired);
        }
    }
}

/// Whether the reader is done, after waiting at most `limit`. The disconnect signals its end.
fn is_done(reader: &Receiver<()>, limit: Duration) -> bool {
    match limit {
        Duration::ZERO => reader.try_recv() == Err(TryRecvError::Disconnected),
        limit => reader.recv_timeout(limit) == Err(RecvTimeoutError::Disconnected),
    }
}

impl ReadbackView {
    pub(crate) fn bytes(&self) -> &[u8] {
        match self {
            // SAFETY: the range is inside the mapping, which stays mapped and unwritten while this value exists.
            Self::Mapped { first, bytes, .. } => unsafe { std::slice::from_raw_parts(*first, *bytes) },
            Self::Copied(bytes) => bytes,
        }
    }
}

#[cfg(test)]
impl Gl {
    /// Number of buffers that wait for their readers.
    pub(crate) fn retired(&self) -> usize {
        self.retired.borrow().len()
    }
}
