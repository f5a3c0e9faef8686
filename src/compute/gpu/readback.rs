//! Asynchronous readback of vertices: a stream of its own copies them to the host while the next step runs.
//!
//! ```text
//! step k   [copy in][kernels]
//! copy k                     [copy out      ]
//! step k+1                   [copy in][kernels]      into the other output set
//! ```
//! OpenGL's buffers cannot be double-buffered. They are first copied to a back buffer on the device, which takes a
//! small part of the readback time; the next step may overwrite them after that copy. Displacements and boxes exist
//! once on the device, so their copies are synchronous.
//!
//! Streams, events and memory are allocated on the first fetch.

use std::sync::Arc;

use cudarc::driver::{CudaEvent, CudaSlice, CudaStream, result};

use super::device::Device;
use super::interop::MapAccess;
use super::memory::{PageLock, address, alloc_zeroed};
use super::output::{OutputAccess, OutputBuffers};
use modalcast_model::deform::{DeformedSurface, VertexReadback};
use modalcast_model::error::{Error, Result, fault_in};

const STAGE: &str = "fetch";

/// Unused host slots that are kept for later readbacks.
const MAX_SPARE_SLOTS: usize = 3;

/// The copy stream, and the host slots that it fills.
#[derive(Debug, Default)]
pub(super) struct ReadbackPool {
    stream: Option<Arc<CudaStream>>,
    slots: Vec<ReadbackSlot>,
    /// Number of copies started.
    started: u64,
    /// Per output set, the end of the last copy from it. With OpenGL's buffers: the end of the last copy from the back
    /// buffer.
    read_done: Vec<CudaEvent>,
    /// Only with OpenGL's buffers.
    back: Option<BackBuffer>,
}

/// Copy of OpenGL's buffers on the device.
#[derive(Debug)]
struct BackBuffer {
    /// Positions and normals; each is allocated on its first use.
    parts: [Option<CudaSlice<u8>>; 2],
    /// End of the last copy into it.
    filled: CudaEvent,
}

/// A host slot: the memory of one readback.
#[derive(Debug)]
struct ReadbackSlot {
    // Declared before `surface`, so dropped before it: the locks refer to its memory.
    _locks: Vec<PageLock>,
    /// The slot keeps the memory alive. The slot is free while this is the only reference.
    surface: Arc<DeformedSurface>,
    /// End of the last copy into it.
    ready: CudaEvent,
    lengths: AttributeLengths,
    /// Sequence number of that copy.
    age: u64,
    /// Number of that copy's readback in `OutputRing`, if it read an output set.
    read_id: Option<u64>,
}

/// Lengths of the lists of a surface, in f32; 0 for an attribute that is not wanted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct AttributeLengths {
    pub positions: usize,
    pub normals: usize,
    pub displacements: usize,
}

impl AttributeLengths {
    /// Whether an output set has to be read for them.
    pub(super) const fn reads_output(self) -> bool {
        self.positions + self.normals > 0
    }
}

/// A copy to start.
#[derive(Debug, Clone, Copy)]
pub(super) struct ReadbackRequest<'a> {
    /// The output set to read.
    pub set: usize,
    pub lengths: AttributeLengths,
    /// Number of the readback in `OutputRing`, if an output set is read.
    pub read_id: Option<u64>,
    /// End of the step that wrote the output set.
    pub after: &'a CudaEvent,
}

impl ReadbackPool {
    /// Starts the copy of the wanted positions and normals. Meanwhile `rest` fills the other lists.
    pub(super) fn start(
        &mut self,
        device: &Device,
        output: &mut OutputBuffers,
        request: ReadbackRequest<'_>,
        rest: impl FnOnce(&mut DeformedSurface) -> Result<()>,
    ) -> Result<VertexReadback> {
        let at = self.acquire_slot(device, request.lengths)?;
        self.started += 1;
        (self.slots[at].age, self.slots[at].read_id) = (self.started, request.read_id);
        let is_read = request.lengths.reads_output();
        if is_read {
            self.start_reading(device, output, request, at)?;
        }
        let surface = self.slots[at].exclusive_surface()?;
        surface.boxes.clear();
        rest(surface)?;
        let surface = Arc::clone(&self.slots[at].surface);
        Ok(if is_read { VertexReadback::pending(surface) } else { VertexReadback::ready(surface) })
    }

    /// Starts the copy from an output set into a slot.
    fn start_reading(
        &mut self,
        device: &Device,
        output: &mut OutputBuffers,
        request: ReadbackRequest<'_>,
        at: usize,
    ) -> Result<()> {
        let fail = fault_in(STAGE);
        let own = match &self.stream {
            Some(stream) => Arc::clone(stream),
            None => Arc::clone(self.stream.insert(device.context().new_stream().map_err(&fail)?)),
        };
        while self.read_done.len() <= request.set {
            self.read_done.push(device.context().new_event(None).map_err(&fail)?);
        }
        let from = if output.is_shared() {
            self.fill_back_buffer(device, output, &request, &own)?
        } else {
            own.wait(request.after).map_err(&fail)?;
            addresses(device, output, request.set)?
        };
        let slot = &mut self.slots[at];
        let surface = slot.exclusive_surface()?;
        for (from, to) in from.into_iter().zip([&mut surface.positions, &mut surface.normals]) {
            // SAFETY: the outputs have the bytes of the plan, and each list has that length or is empty. The lists are
            // not read before `wait` has synchronized on the copy's event. The slot keeps them alive, and it is dropped
            // only after its event has completed or the stream is synchronized.
            unsafe { copy(from, to, &own) }?;
        }
        slot.ready.record(&own).map_err(&fail)?;
        self.read_done[request.set].record(&own).map_err(&fail)
    }

    /// Copies OpenGL's buffers to the back buffer and makes `own` wait for that copy. Returns the addresses of the
    /// copies.
    fn fill_back_buffer(
        &mut self,
        device: &Device,
        output: &mut OutputBuffers,
        request: &ReadbackRequest<'_>,
        own: &CudaStream,
    ) -> Result<[u64; 2]> {
        let bytes = [request.lengths.positions, request.lengths.normals].map(|length| 4 * length);
        self.wait_for_reads(device, request.set)?;
        let back = match &mut self.back {
            Some(back) => back,
            none => none.insert(BackBuffer {
                parts: [None, None],
                filled: device.context().new_event(None).map_err(fault_in(STAGE))?,
            }),
        };
        let mut to = [0; 2];
        for ((part, bytes), to) in back.parts.iter_mut().zip(bytes).zip(&mut to).filter(|((_, bytes), _)| *bytes > 0) {
            *to = match part {
                Some(part) => address(device, part),
                none => address(device, none.insert(alloc_zeroed(device, bytes as u64)?)),
            };
        }
        output.with_addresses(device, OutputAccess { set: request.set, access: MapAccess::Read }, |from| {
            let copies = [from.positions, from.normals].into_iter().zip(to).zip(bytes);
            for ((from, to), bytes) in copies.filter(|(_, bytes)| *bytes > 0) {
                // SAFETY: outputs and back buffer have the bytes of the plan for each wanted list. Both live until the
                // stream is synchronized.
                unsafe { result::memcpy_dtod_async(to, from, bytes, device.stream().cu_stream()) }
                    .map_err(fault_in(STAGE))?;
            }
            Ok(())
        })?;
        back.filled.record(device.stream()).map_err(fault_in(STAGE))?;
        own.wait(&back.filled).map_err(fault_in(STAGE))?;
        Ok(to)
    }

    /// Waits for a copy. Returns its surface and the number of its readback.
    pub(super) fn wait(&self, readback: &VertexReadback) -> Result<(Arc<DeformedSurface>, Option<u64>)> {
        let own = self.slots.iter().find(|slot| readback.is_of(&slot.surface));
        let stranger = || Error::Fault { stage: STAGE, reason: "not a fetch of this deformer".into() };
        let slot = own.ok_or_else(stranger)?;
        slot.ready.synchronize().map_err(fault_in(STAGE))?;
        Ok((Arc::clone(&slot.surface), slot.read_id))
    }

    /// Makes the device's stream wait for the last copy from an output set.
    pub(super) fn wait_for_reads(&self, device: &Device, set: usize) -> Result<()> {
        match self.read_done.get(set) {
            Some(end) => device.stream().wait(end).map_err(fault_in(STAGE)),
            None => Ok(()),
        }
    }

    /// Waits for all copies.
    pub(super) fn synchronize(&self) {
        if let Some(stream) = &self.stream {
            // The device's own stream reports the same fault.
            stream.synchronize().ok();
        }
    }

    /// A free slot with these list lengths. Frees the oldest free slots beyond [`MAX_SPARE_SLOTS`], of any lengths, whose copies
    /// have ended.
    fn acquire_slot(&mut self, device: &Device, lengths: AttributeLengths) -> Result<usize> {
        let is_free = |slot: &ReadbackSlot| Arc::strong_count(&slot.surface) == 1;
        let mut ages: Vec<u64> = self.slots.iter().filter(|slot| is_free(slot)).map(|slot| slot.age).collect();
        ages.sort_unstable();
        let oldest = ages.len().checked_sub(MAX_SPARE_SLOTS).map_or(0, |beyond| ages[beyond]);
        self.slots.retain(|slot| !is_free(slot) || slot.age >= oldest || !slot.ready.is_complete());
        // Take the slot with the oldest copy: that copy has most likely ended.
        let free = self.slots.iter().enumerate().filter(|(_, slot)| is_free(slot) && slot.lengths == lengths);
        if let Some((at, _)) = free.min_by_key(|(_, slot)| slot.age) {
            return Ok(at);
        }
        self.slots.push(ReadbackSlot::new(device, lengths)?);
        Ok(self.slots.len() - 1)
    }
}

/// Addresses of the positions and normals of an owned output set.
fn addresses(device: &Device, output: &mut OutputBuffers, set: usize) -> Result<[u64; 2]> {
    let mut found = [0; 2];
    output.with_addresses(device, OutputAccess { set, access: MapAccess::Read }, |from| {
        found = [from.positions, from.normals];
        Ok(())
    })?;
    Ok(found)
}

impl ReadbackSlot {
    fn new(device: &Device, lengths: AttributeLengths) -> Result<Self> {
        let ready = device.context().new_event(None).map_err(fault_in(STAGE))?;
        let mut surface = DeformedSurface::default();
        let mut locks = Vec::new();
        let DeformedSurface { positions, normals, displacements, .. } = &mut surface;
        for (list, length) in
            [(positions, lengths.positions), (normals, lengths.normals), (displacements, lengths.displacements)]
        {
            list.resize(length, 0.0);
            // SAFETY: the length of the list never changes again, and the locks are dropped before it.
            locks.extend(unsafe { PageLock::new(device, list) });
        }
        Ok(Self { _locks: locks, surface: Arc::new(surface), ready, lengths, age: 0, read_id: None })
    }

    /// Exclusive access to the lists.
    ///
    /// # Errors
    /// `Fault` when another holder has a reference to them.
    fn exclusive_surface(&mut self) -> Result<&mut DeformedSurface> {
        let taken = || Error::Fault { stage: STAGE, reason: "the memory is in use".into() };
        Arc::get_mut(&mut self.surface).ok_or_else(taken)
    }
}

/// Starts a device-to-host copy.
///
/// # Safety
/// `from` is the address of at least as many bytes of device memory as `to` has, and `to` is not accessed before the
/// stream has completed the copy.
unsafe fn copy(from: u64, to: &mut [f32], stream: &CudaStream) -> Result<()> {
    if to.is_empty() {
        return Ok(());
    }
    // SAFETY: the caller guarantees both conditions.
    unsafe { result::memcpy_dtoh_async(to, from, stream.cu_stream()) }.map_err(fault_in(STAGE))
}
