//! Vertices on their way to the host: copied on a stream of their own, so that the next step runs beside it.
//!
//! ```text
//! step k   [copy in][kernels]
//! copy k                     [copy out      ]
//! step k+1                   [copy in][kernels]      into the other output
//! ```
//! OpenGL's buffers cannot take turns: they are copied to a back buffer on the device first, which takes a small part of
//! the time of the way out, and the next step may overwrite them then.
//!
//! Nothing here is made for a scene whose vertices nobody fetches.

use std::sync::Arc;

use cudarc::driver::{CudaEvent, CudaSlice, CudaStream, result};

use super::device::Device;
use super::interop::Access;
use super::memory::{PageLock, address, room};
use super::output::{Output, Use};
use crate::deform::{Fetch, Surface};
use crate::error::{Error, Result, during};

const STAGE: &str = "fetch";

/// Host surfaces that nobody holds and that are kept for the next readings all the same.
const SPARE: usize = 3;

/// The stream, and the host memory that it fills.
#[derive(Debug, Default)]
pub(super) struct Fetches {
    stream: Option<Arc<CudaStream>>,
    slots: Vec<Slot>,
    /// Per output set, or of the back buffer, the end of the last copy from it.
    ends: Vec<CudaEvent>,
    /// With OpenGL's buffers.
    back: Option<Back>,
}

/// A copy of OpenGL's buffers on the device.
#[derive(Debug)]
struct Back {
    positions: CudaSlice<u8>,
    normals: CudaSlice<u8>,
    /// The end of the last copy into it.
    filled: CudaEvent,
}

/// One surface on the host.
#[derive(Debug)]
struct Slot {
    // Declared before `surface`, so dropped before it: the locks are on its memory.
    _locks: Vec<PageLock>,
    /// Held here too, so that its memory stays; the only one while nobody reads it.
    surface: Arc<Surface>,
    /// The end of the last copy into it.
    there: CudaEvent,
    /// That copy's number.
    number: u64,
}

/// A copy to begin.
#[derive(Debug, Clone, Copy)]
pub(super) struct Order<'a> {
    /// The output set that is read.
    pub set: usize,
    /// Numbers of positions and of normals.
    pub lengths: [usize; 2],
    /// What this reading is called.
    pub number: u64,
    /// The end of the step that wrote the output.
    pub after: &'a CudaEvent,
}

impl Fetches {
    /// Starts the copy of positions and normals.
    pub(super) fn start(&mut self, device: &Device, output: &mut Output, order: Order<'_>) -> Result<Fetch> {
        let fail = during(STAGE);
        let own = match &self.stream {
            Some(stream) => Arc::clone(stream),
            None => Arc::clone(self.stream.insert(device.context().new_stream().map_err(&fail)?)),
        };
        while self.ends.len() <= order.set {
            self.ends.push(device.context().new_event(None).map_err(&fail)?);
        }
        let at = self.free_slot(device, order.lengths)?;
        let from = if output.is_shared() {
            self.fill_back(device, output, &order, &own)?
        } else {
            own.wait(order.after).map_err(&fail)?;
            addresses(device, output, order.set)?
        };
        let slot = &mut self.slots[at];
        let taken = || Error::Fault { stage: STAGE, reason: "the memory is in use".into() };
        let surface = Arc::get_mut(&mut slot.surface).ok_or_else(taken)?;
        for (from, to) in from.into_iter().zip([&mut surface.positions, &mut surface.normals]) {
            // SAFETY: the outputs have the bytes of the plan, from which the lists have their lengths. Nobody looks at the
            // lists before the copy's event was waited for, the slot keeps them, and it goes after the stream was waited
            // for.
            unsafe { copy(from, to, &own) }?;
        }
        slot.there.record(&own).map_err(&fail)?;
        self.ends[order.set].record(&own).map_err(&fail)?;
        slot.number = order.number;
        Ok(Fetch::under_way(Arc::clone(&slot.surface)))
    }

    /// Copies OpenGL's buffers aside, and lets `own` wait for that; where the copies lie.
    fn fill_back(
        &mut self,
        device: &Device,
        output: &mut Output,
        order: &Order<'_>,
        own: &CudaStream,
    ) -> Result<[u64; 2]> {
        let bytes = order.lengths.map(|length| 4 * length);
        self.let_pass(device, order.set)?;
        let back = match &mut self.back {
            Some(back) => back,
            none => none.insert(Back {
                positions: room(device, bytes[0] as u64)?,
                normals: room(device, bytes[1] as u64)?,
                filled: device.context().new_event(None).map_err(during(STAGE))?,
            }),
        };
        let to = [address(device, &back.positions), address(device, &back.normals)];
        output.with(device, Use { set: order.set, access: Access::Read }, |from| {
            let copies = [from.positions, from.normals].into_iter().zip(to).zip(bytes);
            for ((from, to), bytes) in copies.filter(|(_, bytes)| *bytes > 0) {
                // SAFETY: the outputs have the bytes of the plan, and the back buffer was made of the same numbers. Both
                // live until the stream was waited for.
                unsafe { result::memcpy_dtod_async(to, from, bytes, device.stream().cu_stream()) }
                    .map_err(during(STAGE))?;
            }
            Ok(())
        })?;
        back.filled.record(device.stream()).map_err(during(STAGE))?;
        own.wait(&back.filled).map_err(during(STAGE))?;
        Ok(to)
    }

    /// Waits for a copy; its surface and its number.
    pub(super) fn wait(&self, fetch: &Fetch) -> Result<(Arc<Surface>, u64)> {
        let own = self.slots.iter().find(|slot| Arc::ptr_eq(&slot.surface, fetch.surface()));
        let stranger = || Error::Fault { stage: STAGE, reason: "not a fetch of this deformer".into() };
        let slot = own.ok_or_else(stranger)?;
        slot.there.synchronize().map_err(during(STAGE))?;
        Ok((Arc::clone(&slot.surface), slot.number))
    }

    /// Lets the device's stream wait for the last copy from an output set.
    pub(super) fn let_pass(&self, device: &Device, set: usize) -> Result<()> {
        match self.ends.get(set) {
            Some(end) => device.stream().wait(end).map_err(during(STAGE)),
            None => Ok(()),
        }
    }

    /// Waits for all copies.
    pub(super) fn synchronize(&self) {
        if let Some(stream) = &self.stream {
            // Its failure adds nothing to what the device's own stream says.
            stream.synchronize().ok();
        }
    }

    /// A slot that nobody holds. Those beyond the spare ones go, once the device has done with them.
    fn free_slot(&mut self, device: &Device, lengths: [usize; 2]) -> Result<usize> {
        let is_free = |slot: &Slot| Arc::strong_count(&slot.surface) == 1;
        let mut spare = 0;
        self.slots.retain(|slot| {
            spare += usize::from(is_free(slot));
            !is_free(slot) || spare <= SPARE || !slot.there.is_complete()
        });
        // The one whose copy is the oldest: it has most likely ended.
        let free = self.slots.iter().enumerate().filter(|(_, slot)| is_free(slot));
        if let Some((at, _)) = free.min_by_key(|(_, slot)| slot.number) {
            return Ok(at);
        }
        self.slots.push(Slot::new(device, lengths)?);
        Ok(self.slots.len() - 1)
    }
}

/// Where positions and normals of a set of our own lie.
fn addresses(device: &Device, output: &mut Output, set: usize) -> Result<[u64; 2]> {
    let mut found = [0; 2];
    output.with(device, Use { set, access: Access::Read }, |from| {
        found = [from.positions, from.normals];
        Ok(())
    })?;
    Ok(found)
}

impl Slot {
    fn new(device: &Device, [positions, normals]: [usize; 2]) -> Result<Self> {
        let there = device.context().new_event(None).map_err(during(STAGE))?;
        let mut surface = Surface::default();
        let mut locks = Vec::new();
        for (list, length) in [(&mut surface.positions, positions), (&mut surface.normals, normals)] {
            list.resize(length, 0.0);
            // SAFETY: the list never changes its length again, and the locks are dropped before it.
            locks.extend(unsafe { PageLock::new(device, list) });
        }
        Ok(Self { _locks: locks, surface: Arc::new(surface), there, number: 0 })
    }
}

/// Starts a copy from the device.
///
/// # Safety
/// `from` is the address of at least as many bytes of device memory as `to` has, and nobody uses `to` before the stream
/// has come to the end of the copy.
unsafe fn copy(from: u64, to: &mut [f32], stream: &CudaStream) -> Result<()> {
    if to.is_empty() {
        return Ok(());
    }
    // SAFETY: the caller vouches for both.
    unsafe { result::memcpy_dtoh_async(to, from, stream.cu_stream()) }.map_err(during(STAGE))
}
