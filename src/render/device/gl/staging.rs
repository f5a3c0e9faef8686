//! Staging buffers for readback. With OpenGL 4.4 they are persistently mapped: any thread can copy from them once a
//! fence has passed, without an OpenGL call.

use std::cell::RefCell;
use std::mem;
use std::rc::Rc;
use std::sync::Arc;
use std::sync::mpsc::{self, Receiver, RecvTimeoutError, SyncSender, TryRecvError};
use std::time::Duration;

use glow::HasContext as _;

use super::object::BufferObject;
use super::{Buffer, Gl};
use modalcast_model::error::{Result, fault, fault_in};
use modalcast_model::shared_memory::{CopiedPixels, CopiedPng, HostPixels};

/// A buffer that the device writes and the host reads.
#[derive(Debug)]
pub(crate) struct StagingBuffer {
    pub(crate) buffer: Buffer,
    /// Address of the persistent mapping; `None` if the context does not support it.
    mapping: Option<*const u8>,
    reader: ReaderSignal,
}

/// Disconnects when the current reader (a [`ReadbackView`]) is dropped; `None` without a reader.
#[derive(Debug, Default)]
pub(super) struct ReaderSignal(RefCell<Option<Receiver<()>>>);

/// The buffer of a dropped staging buffer from which a reader still copies.
pub(super) struct RetiredBuffer {
    /// Keeps the mapping valid.
    _object: Rc<BufferObject>,
    reader: Receiver<()>,
}

/// Bytes of a staging buffer that any thread may copy. While this value exists, the bytes stay mapped and the device
/// does not write them, so it must be short-lived.
#[derive(Debug)]
pub(crate) enum ReadbackView {
    /// Address and length of the mapped bytes. Dropping the sender disconnects the staging buffer's `reader`.
    Mapped { pointer: *const u8, bytes: usize, _done: SyncSender<()> },
    /// A copy of the bytes, if the buffer is not persistently mapped.
    Copied(Vec<u8>),
    /// The first `bytes` bytes of pinned memory.
    Pinned {
        // Dropped before `_done`, so that the memory has no reader once the sender is disconnected.
        pixels: Arc<dyn HostPixels>,
        /// The PNG file, if it was requested.
        png: Option<CopiedPng>,
        bytes: usize,
        /// Whether a reader may keep the view for long, because enough slots are left for the next frames.
        can_be_held: bool,
        _done: SyncSender<()>,
    },
}

// SAFETY: the memory is mapped for reading only. Nothing writes it before the staging buffer sees that this value was
// dropped. It is unmapped after that, or never.
unsafe impl Send for ReadbackView {}
// SAFETY: as above; the bytes are only read.
unsafe impl Sync for ReadbackView {}

impl Gl {
    /// Creates a staging buffer of `bytes` bytes, persistently mapped if possible.
    pub(crate) fn staging(self: &Rc<Self>, bytes: u64) -> Result<StagingBuffer> {
        self.free_retired_buffers(Duration::ZERO);
        let reader = ReaderSignal::default();
        if !self.limits.persistent_mapping {
            return Ok(StagingBuffer { buffer: self.buffer(bytes, glow::STREAM_READ, None)?, mapping: None, reader });
        }
        let size = i32::try_from(bytes).map_err(fault_in("readback"))?;
        let access = glow::MAP_READ_BIT | glow::MAP_PERSISTENT_BIT | glow::MAP_COHERENT_BIT;
        let gl = self.functions()?;
        // SAFETY: a new name, which the buffer owns.
        let name = unsafe { gl.create_buffer() }.map_err(fault_in("readback"))?;
        let buffer = Buffer::new(self, name, bytes);
        // SAFETY: immutable storage, mapped as a whole for reading, for as long as the buffer exists: OpenGL unmaps it
        // when the name is deleted.
        let mapping = unsafe {
            gl.bind_buffer(glow::COPY_READ_BUFFER, Some(name));
            gl.buffer_storage(glow::COPY_READ_BUFFER, size, None, access | glow::CLIENT_STORAGE_BIT);
            gl.map_buffer_range(glow::COPY_READ_BUFFER, 0, size, access)
        };
        self.check("readback")?;
        if mapping.is_null() {
            return Err(fault("readback", format!("cannot map {bytes} bytes")));
        }
        Ok(StagingBuffer { buffer, mapping: Some(mapping.cast_const()), reader })
    }

    /// Frees the retired buffers whose readers are done, after waiting for each reader at most `limit`. Buffers with
    /// active readers remain, and keep the context alive: a leak is better than a read of unmapped memory.
    pub(crate) fn free_retired_buffers(&self, limit: Duration) {
        let mut retired_buffers = mem::take(&mut *self.retired_buffers.borrow_mut());
        retired_buffers.retain(|buffer| !is_done(&buffer.reader, limit));
        self.retired_buffers.borrow_mut().extend(retired_buffers);
    }
}

impl StagingBuffer {
    /// A view of the first `bytes` bytes. The caller has waited for a fence after the last command that writes them. No
    /// command may write the buffer while the view exists.
    ///
    /// # Errors
    /// `Fault` when the buffer is smaller than `bytes` or cannot be mapped.
    pub(crate) fn view(&self, bytes: usize) -> Result<ReadbackView> {
        if bytes as u64 > self.buffer.bytes {
            return Err(fault("readback", format!("expected at most {} bytes, got {bytes}", self.buffer.bytes)));
        }
        let Some(pointer) = self.mapping else { return self.buffer.read(bytes).map(ReadbackView::Copied) };
        Ok(ReadbackView::Mapped { pointer, bytes, _done: self.reader.begin() })
    }

    /// Waits at most `limit` for the reader and returns whether it is done.
    pub(crate) fn is_read(&self, limit: Duration) -> bool {
        self.reader.is_read(limit)
    }
}

impl Drop for StagingBuffer {
    /// Does not wait for the reader, which may run on this thread.
    fn drop(&mut self) {
        if let Some(reader) = self.reader.0.take().filter(|reader| !is_done(reader, Duration::ZERO)) {
            let object = self.buffer.object();
            let retired_buffer = RetiredBuffer { _object: Rc::clone(object), reader };
            object.gl.retired_buffers.borrow_mut().push(retired_buffer);
        }
    }
}

impl ReaderSignal {
    /// Begins to track a reader, which holds the returned sender.
    fn begin(&self) -> SyncSender<()> {
        // No message is sent. The disconnect signals that the reader is done.
        let (sender, reader) = mpsc::sync_channel(1);
        self.0.replace(Some(reader));
        sender
    }

    /// Waits at most `limit` for the reader and returns whether it is done.
    pub(super) fn is_read(&self, limit: Duration) -> bool {
        let mut reader = self.0.borrow_mut();
        let is_read = reader.as_ref().is_none_or(|reader| is_done(reader, limit));
        if is_read {
            *reader = None;
        }
        is_read
    }
}

/// Whether the reader is done, that is, has disconnected, after waiting at most `limit`.
fn is_done(reader: &Receiver<()>, limit: Duration) -> bool {
    match limit {
        Duration::ZERO => reader.try_recv() == Err(TryRecvError::Disconnected),
        limit => reader.recv_timeout(limit) == Err(RecvTimeoutError::Disconnected),
    }
}

impl ReadbackView {
    /// A view of the first `bytes` bytes of pinned memory, which `reader` tracks.
    pub(super) fn pinned(copied: CopiedPixels, bytes: usize, can_be_held: bool, reader: &ReaderSignal) -> Self {
        let CopiedPixels { pixels, png } = copied;
        let bytes = bytes.min(pixels.bytes().len());
        Self::Pinned { pixels, png, bytes, can_be_held, _done: reader.begin() }
    }

    /// Whether a reader may keep the view for long instead of copying the bytes.
    pub(crate) const fn can_be_held(&self) -> bool {
        matches!(self, Self::Pinned { can_be_held: true, .. })
    }

    /// Takes the PNG file out of the view.
    pub(crate) const fn take_png(&mut self) -> Option<CopiedPng> {
        match self {
            Self::Pinned { png, .. } => png.take(),
            Self::Mapped { .. } | Self::Copied(_) => None,
        }
    }

    /// Shortens the view to its first `bytes` bytes.
    pub(crate) fn truncate(&mut self, bytes: usize) {
        match self {
            Self::Mapped { bytes: length, .. } | Self::Pinned { bytes: length, .. } => *length = bytes.min(*length),
            Self::Copied(copy) => copy.truncate(bytes),
        }
    }

    pub(crate) fn bytes(&self) -> &[u8] {
        match self {
            // SAFETY: the range is inside the mapping, which stays mapped and unwritten while this value exists.
            Self::Mapped { pointer, bytes, .. } => unsafe { std::slice::from_raw_parts(*pointer, *bytes) },
            Self::Copied(bytes) => bytes,
            Self::Pinned { pixels, bytes, .. } => pixels.bytes().get(..*bytes).unwrap_or_default(),
        }
    }
}

#[cfg(test)]
impl Gl {
    /// Number of buffers that wait for their readers.
    pub(crate) fn retired_buffer_count(&self) -> usize {
        self.retired_buffers.borrow().len()
    }
}
