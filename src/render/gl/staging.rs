//! Buffers through which bytes come back to the host. Where OpenGL has it (4.4), one stays mapped for good, so that reading
//! it is no command: any thread may copy out of it what a fence has passed.

use std::cell::RefCell;
use std::mem::{self, ManuallyDrop};
use std::rc::Rc;
use std::sync::mpsc::{self, Receiver, RecvTimeoutError, SyncSender, TryRecvError};
use std::time::Duration;

use glow::HasContext as _;

use super::{Buffer, Gl};
use modalcast_model::error::{Result, during};

/// A buffer that the device writes and the host reads.
#[derive(Debug)]
pub(crate) struct Staging {
    pub(crate) buffer: ManuallyDrop<Buffer>,
    /// Where it is mapped; none where it cannot stay so.
    mapped: Option<*const u8>,
    /// Hears when whoever reads it has done.
    reader: RefCell<Option<Receiver<()>>>,
}

/// A buffer whose reader has outlived its use.
pub(super) type Retired = (Buffer, Receiver<()>);

/// Bytes of a staging buffer, to be copied by any thread. The device does not write them and they stay mapped while this
/// lives, so it must not live long.
#[derive(Debug)]
pub(crate) enum Lent {
    /// Where they are mapped, and what tells the buffer that they were read when it is dropped.
    Mapped {
        first: *const u8,
        bytes: usize,
        _done: SyncSender<()>,
    },
    Copied(Vec<u8>),
}

// SAFETY: the memory is mapped for reading, nobody writes it before the lender hears that this was dropped, and it is
// unmapped after that or never.
unsafe impl Send for Lent {}

impl Gl {
    /// A buffer of so many bytes that the host may read.
    pub(crate) fn staging(self: &Rc<Self>, bytes: u64) -> Result<Staging> {
        self.bury(Duration::ZERO);
        let reader = RefCell::default();
        if !self.limits.persistent {
            let buffer = ManuallyDrop::new(self.buffer(bytes, glow::STREAM_READ, None)?);
            return Ok(Staging { buffer, mapped: None, reader });
        }
        let size = i32::try_from(bytes).map_err(during("readback"))?;
        let kept = glow::MAP_READ_BIT | glow::MAP_PERSISTENT_BIT | glow::MAP_COHERENT_BIT;
        let gl = self.on();
        // SAFETY: a fresh buffer of fixed storage, mapped whole and only for reading, for as long as it lives.
        let (buffer, mapped) = unsafe {
            let name = gl.create_buffer().map_err(during("readback"))?;
            let buffer = Buffer { gl: Rc::clone(self), name, bytes };
            gl.bind_buffer(glow::COPY_READ_BUFFER, Some(name));
            gl.buffer_storage(glow::COPY_READ_BUFFER, size, None, kept | glow::CLIENT_STORAGE_BIT);
            (buffer, gl.map_buffer_range(glow::COPY_READ_BUFFER, 0, size, kept))
        };
        self.check("readback")?;
        if mapped.is_null() {
            return Err(during("readback")(format!("{bytes} bytes cannot be mapped")));
        }
        Ok(Staging { buffer: ManuallyDrop::new(buffer), mapped: Some(mapped.cast_const()), reader })
    }

    /// Frees the buffers that were given up while somebody read them, after waiting for each reader at most so long. Those
    /// that are read even then stay, and so does the context: better some memory is lost than read when it is gone.
    pub(crate) fn bury(&self, limit: Duration) {
        let mut retired = mem::take(&mut *self.retired.borrow_mut());
        retired.retain(|(_, reader)| !is_over(reader, limit));
        self.retired.borrow_mut().extend(retired);
    }
}

impl Staging {
    /// The first bytes, once a fence behind the last command that writes them was passed. While they are lent, no command
    /// may write the buffer.
    ///
    /// # Errors
    /// `Fault` where the buffer cannot be mapped.
    pub(crate) fn lend(&self, bytes: usize) -> Result<Lent> {
        let Some(first) = self.mapped else { return self.buffer.read(bytes).map(Lent::Copied) };
        // Nothing is ever sent: its end is all it tells.
        let (done, reader) = mpsc::sync_channel(1);
        self.reader.replace(Some(reader));
        Ok(Lent::Mapped { first, bytes: bytes.min(self.buffer.bytes as usize), _done: done })
    }

    /// Waits until nobody reads it any more, at most `limit`; whether that is so.
    pub(crate) fn is_read(&self, limit: Duration) -> bool {
        let mut reader = self.reader.borrow_mut();
        let over = reader.as_ref().is_none_or(|reader| is_over(reader, limit));
        if over {
            *reader = None;
        }
        over
    }

    /// A copy of some bytes, as [`Self::lend`] has them.
    pub(crate) fn read(&self, range: std::ops::Range<usize>) -> Result<Vec<u8>> {
        let lent = self.lend(range.end)?;
        Ok(lent.bytes().get(range).unwrap_or_default().to_vec())
    }
}

impl Drop for Staging {
    /// Waits for nobody: the reader may be this very thread.
    fn drop(&mut self) {
        // SAFETY: taken once, here, and not used after this.
        let buffer = unsafe { ManuallyDrop::take(&mut self.buffer) };
        if let Some(reader) = self.reader.take().filter(|reader| !is_over(reader, Duration::ZERO)) {
            let gl = Rc::clone(&buffer.gl);
            gl.retired.borrow_mut().push((buffer, reader));
        }
    }
}

/// Whether the reader has done, after waiting for it at most so long. Its end is told as an error, as nothing is ever sent.
fn is_over(reader: &Receiver<()>, limit: Duration) -> bool {
    match limit {
        Duration::ZERO => reader.try_recv() == Err(TryRecvError::Disconnected),
        limit => reader.recv_timeout(limit) == Err(RecvTimeoutError::Disconnected),
    }
}

impl Lent {
    pub(crate) fn bytes(&self) -> &[u8] {
        match self {
            // SAFETY: the range is inside the mapping, which stays, and nobody writes it while this lives.
            Self::Mapped { first, bytes, .. } => unsafe { std::slice::from_raw_parts(*first, *bytes) },
            Self::Copied(bytes) => bytes,
        }
    }
}

#[cfg(test)]
impl Gl {
    /// Buffers that wait for their readers.
    pub(crate) fn retired(&self) -> usize {
        self.retired.borrow().len()
    }
}
