//! Buffers through which bytes come back to the host. Where OpenGL has it (4.4), one stays mapped for good, so that reading
//! it is no command: any thread may copy out of it what a fence has passed.

use std::cell::RefCell;
use std::rc::Rc;
use std::sync::mpsc::{self, Receiver, RecvTimeoutError, Sender, TryRecvError};
use std::time::Duration;

use glow::HasContext as _;

use super::{Buffer, Gl};
use crate::error::{Result, during};

/// A buffer that the device writes and the host reads.
#[derive(Debug)]
pub(in crate::render) struct Staging {
    pub(in crate::render) buffer: Buffer,
    /// Where it is mapped; none where it cannot stay so.
    mapped: Option<*const u8>,
    /// Hears when whoever reads it has done.
    reader: RefCell<Option<Receiver<()>>>,
}

/// Bytes of a staging buffer, to be copied by any thread. The device does not write them and they stay mapped while this
/// lives, so it must not live long.
#[derive(Debug)]
pub(in crate::render) enum Lent {
    /// Where they are mapped, and what tells the buffer that they were read when it is dropped.
    Mapped {
        first: *const u8,
        bytes: usize,
        _done: Sender<()>,
    },
    Copied(Vec<u8>),
}

// SAFETY: the memory is mapped for reading, nobody writes it before the lender hears that this was dropped, and the lender
// hears of it before the memory is unmapped.
unsafe impl Send for Lent {}

impl Gl {
    /// A buffer of so many bytes that the host may read.
    pub(in crate::render) fn staging(self: &Rc<Self>, bytes: u64) -> Result<Staging> {
        let reader = RefCell::default();
        if !self.limits.persistent {
            return Ok(Staging { buffer: self.buffer(bytes, glow::STREAM_READ, None)?, mapped: None, reader });
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
        Ok(Staging { buffer, mapped: Some(mapped.cast_const()), reader })
    }
}

impl Staging {
    /// The first bytes, once a fence behind the last command that writes them was passed. While they are lent, no command
    /// may write the buffer.
    ///
    /// # Errors
    /// `Fault` where the buffer cannot be mapped.
    pub(in crate::render) fn lend(&self, bytes: usize) -> Result<Lent> {
        let Some(first) = self.mapped else { return self.buffer.read(bytes).map(Lent::Copied) };
        let (done, reader) = mpsc::channel();
        self.reader.replace(Some(reader));
        Ok(Lent::Mapped { first, bytes: bytes.min(self.buffer.bytes as usize), _done: done })
    }

    /// Waits until nobody reads it any more, at most `limit`; whether that is so.
    pub(in crate::render) fn is_read(&self, limit: Duration) -> bool {
        let mut reader = self.reader.borrow_mut();
        let over = reader.as_ref().is_none_or(|reader| match limit {
            Duration::ZERO => reader.try_recv() == Err(TryRecvError::Disconnected),
            limit => reader.recv_timeout(limit) == Err(RecvTimeoutError::Disconnected),
        });
        if over {
            *reader = None;
        }
        over
    }

    /// A copy of some bytes, as [`Self::lend`] has them.
    pub(in crate::render) fn read(&self, range: std::ops::Range<usize>) -> Result<Vec<u8>> {
        let lent = self.lend(range.end)?;
        Ok(lent.bytes().get(range).unwrap_or_default().to_vec())
    }
}

impl Drop for Staging {
    fn drop(&mut self) {
        if let Some(reader) = self.reader.take() {
            // The reader copies memory and does nothing else, and its end is told as an error, as nothing is ever sent.
            reader.recv().ok();
        }
    }
}

impl Lent {
    pub(in crate::render) fn bytes(&self) -> &[u8] {
        match self {
            // SAFETY: the range is inside the mapping, which stays, and nobody writes it while this lives.
            Self::Mapped { first, bytes, .. } => unsafe { std::slice::from_raw_parts(*first, *bytes) },
            Self::Copied(bytes) => bytes,
        }
    }
}
