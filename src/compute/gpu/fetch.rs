//! Vertices on their way to the host: copied on a stream of their own, so that the next step runs beside it.
//!
//! ```text
//! step k   [copy in][kernels]
//! copy k                     [copy out      ]
//! step k+1                   [copy in][kernels]      into the other output
//! ```
//! OpenGL's buffers cannot take turns: they are copied to a back buffer on the device first, which takes a small part of
//! the time of the way out, and the next step may overwrite them then. Displacements and boxes, of which the device has
//! but one, are waited for at once.
//!
//! Nothing here is made for a scene whose vertices nobody fetches.

use std::sync::Arc;

use cudarc::driver::{CudaEvent, CudaSlice, CudaStream, result};

use super::device::Device;
use super::interop::Access;
use super::memory::{PageLock, address, room};
use super::output::{Output, Use};
use modalcast_model::deform::{Fetch, Surface};
use modalcast_model::error::{Error, Result, during};

const STAGE: &str = "fetch";

/// Host surfaces that nobody holds and that are kept for the next readings all the same.
const SPARE: usize = 3;

/// The stream, and the host memory that it fills.
#[derive(Debug, Default)]
pub(super) struct Fetches {
    stream: Option<Arc<CudaStream>>,
    slots: Vec<Slot>,
    /// Copies that were begun.
    begun: u64,
    /// Per output set, or of the back buffer, the end of the last copy from it.
    ends: Vec<CudaEvent>,
    /// With OpenGL's buffers.
    back: Option<Back>,
}

/// A copy of OpenGL's buffers on the device.
#[derive(Debug)]
struct Back {
    /// Positions and normals, once they are wanted.
    parts: [Option<CudaSlice<u8>>; 2],
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
    lengths: Lists,
    /// That copy among all.
    age: u64,
    /// What that copy's order called its reading.
    reading: Option<u64>,
}

/// Numbers in the lists of a surface; 0 for what is not wanted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Lists {
    pub positions: usize,
    pub normals: usize,
    pub displacements: usize,
}

impl Lists {
    /// Whether a set of outputs is read for them.
    pub(super) const fn are_of_output(self) -> bool {
        self.positions + self.normals > 0
    }
}

/// A copy to begin.
#[derive(Debug, Clone, Copy)]
pub(super) struct Order<'a> {
    /// The output set that is read.
    pub set: usize,
    pub lengths: Lists,
    /// What the reading of the output is called, if it is read.
    pub reading: Option<u64>,
    /// The end of the step that wrote the output.
    pub after: &'a CudaEvent,
}

impl Fetches {
    /// Starts the copy of positions and normals, as far as they are wanted; `rest` fills the other lists meanwhile.
    pub(super) fn start(
        &mut self,
        device: &Device,
        output: &mut Output,
        order: Order<'_>,
        rest: impl FnOnce(&mut Surface) -> Result<()>,
    ) -> Result<Fetch> {
        let at = self.free_slot(device, order.lengths)?;
        self.begun += 1;
        (self.slots[at].age, self.slots[at].reading) = (self.begun, order.reading);
        let is_read = order.lengths.are_of_output();
        if is_read {
            self.start_reading(device, output, order, at)?;
        }
        let surface = self.slots[at].unshared()?;
        surface.boxes.clear();
        rest(surface)?;
        let surface = Arc::clone(&self.slots[at].surface);
        Ok(if is_read { Fetch::pending(surface) } else { Fetch::ready(surface) })
    }

    /// Starts the copy from an output into a slot.
    fn start_reading(&mut self, device: &Device, output: &mut Output, order: Order<'_>, at: usize) -> Result<()> {
        let fail = during(STAGE);
        let own = match &self.stream {
            Some(stream) => Arc::clone(stream),
            None => Arc::clone(self.stream.insert(device.context().new_stream().map_err(&fail)?)),
        };
        while self.ends.len() <= order.set {
            self.ends.push(device.context().new_event(None).map_err(&fail)?);
        }
        let from = if output.is_shared() {
            self.fill_back(device, output, &order, &own)?
        } else {
            own.wait(order.after).map_err(&fail)?;
            addresses(device, output, order.set)?
        };
        let slot = &mut self.slots[at];
        let surface = slot.unshared()?;
        for (from, to) in from.into_iter().zip([&mut surface.positions, &mut surface.normals]) {
            // SAFETY: the outputs have the bytes of the plan, from which the lists have their lengths, or none. Nobody looks
            // at the lists before the copy's event was waited for, the slot keeps them, and it goes after the stream was waited
            // for.
            unsafe { copy(from, to, &own) }?;
        }
        slot.there.record(&own).map_err(&fail)?;
        self.ends[order.set].record(&own).map_err(&fail)
    }

    /// Copies OpenGL's buffers aside, and lets `own` wait for that; where the copies lie.
    fn fill_back(
        &mut self,
        device: &Device,
        output: &mut Output,
        order: &Order<'_>,
        own: &CudaStream,
    ) -> Result<[u64; 2]> {
        let bytes = [order.lengths.positions, order.lengths.normals].map(|length| 4 * length);
        self.let_pass(device, order.set)?;
        let back = match &mut self.back {
            Some(back) => back,
            none => none
                .insert(Back { parts: [None, None], filled: device.context().new_event(None).map_err(during(STAGE))? }),
        };
        let mut to = [0; 2];
        for ((part, bytes), to) in back.parts.iter_mut().zip(bytes).zip(&mut to).filter(|((_, bytes), _)| *bytes > 0) {
            *to = match part {
                Some(part) => address(device, part),
                none => address(device, none.insert(room(device, bytes as u64)?)),
            };
        }
        output.with(device, Use { set: order.set, access: Access::Read }, |from| {
            let copies = [from.positions, from.normals].into_iter().zip(to).zip(bytes);
            for ((from, to), bytes) in copies.filter(|(_, bytes)| *bytes > 0) {
                // SAFETY: the outputs have the bytes of the plan, and so has what of the back buffer is wanted. Both live
                // until the stream was waited for.
                unsafe { result::memcpy_dtod_async(to, from, bytes, device.stream().cu_stream()) }
                    .map_err(during(STAGE))?;
            }
            Ok(())
        })?;
        back.filled.record(device.stream()).map_err(during(STAGE))?;
        own.wait(&back.filled).map_err(during(STAGE))?;
        Ok(to)
    }

    /// Waits for a copy; its surface, and what its reading was called.
    pub(super) fn wait(&self, fetch: &Fetch) -> Result<(Arc<Surface>, Option<u64>)> {
        let own = self.slots.iter().find(|slot| fetch.is_of(&slot.surface));
        let stranger = || Error::Fault { stage: STAGE, reason: "not a fetch of this deformer".into() };
        let slot = own.ok_or_else(stranger)?;
        slot.there.synchronize().map_err(during(STAGE))?;
        Ok((Arc::clone(&slot.surface), slot.reading))
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

    /// A slot of these lists that nobody holds. The oldest beyond the spare ones go, whatever their lists, once the device
    /// has done with them.
    fn free_slot(&mut self, device: &Device, lengths: Lists) -> Result<usize> {
        let is_free = |slot: &Slot| Arc::strong_count(&slot.surface) == 1;
        let mut ages: Vec<u64> = self.slots.iter().filter(|slot| is_free(slot)).map(|slot| slot.age).collect();
        ages.sort_unstable();
        let oldest = ages.len().checked_sub(SPARE).map_or(0, |beyond| ages[beyond]);
        self.slots.retain(|slot| !is_free(slot) || slot.age >= oldest || !slot.there.is_complete());
        // The one whose copy is the oldest: it has most likely ended.
        let free = self.slots.iter().enumerate().filter(|(_, slot)| is_free(slot) && slot.lengths == lengths);
        if let Some((at, _)) = free.min_by_key(|(_, slot)| slot.age) {
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
    fn new(device: &Device, lengths: Lists) -> Result<Self> {
        let there = device.context().new_event(None).map_err(during(STAGE))?;
        let mut surface = Surface::default();
        let mut locks = Vec::new();
        let Surface { positions, normals, displacements, .. } = &mut surface;
        for (list, length) in
            [(positions, lengths.positions), (normals, lengths.normals), (displacements, lengths.displacements)]
        {
            list.resize(length, 0.0);
            // SAFETY: the list never changes its length again, and the locks are dropped before it.
            locks.extend(unsafe { PageLock::new(device, list) });
        }
        Ok(Self { _locks: locks, surface: Arc::new(surface), there, lengths, age: 0, reading: None })
    }

    /// The lists, while nobody else holds them.
    fn unshared(&mut self) -> Result<&mut Surface> {
        let taken = || Error::Fault { stage: STAGE, reason: "the memory is in use".into() };
        Arc::get_mut(&mut self.surface).ok_or_else(taken)
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
