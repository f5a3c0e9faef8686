//! Samples of a compute rasterizer in memory that OpenGL imports. The rasterizer writes a set of samples while OpenGL
//! reads other sets, so that it can draw ahead of OpenGL.
//!
//! The host orders the accesses: it waits for the rasterizer before OpenGL reads a set, and for OpenGL before the
//! rasterizer writes the set again.

use std::collections::VecDeque;
use std::rc::Rc;
use std::sync::Arc;
use std::time::{Duration, Instant};

use crate::device::gl::{Buffer, Fence, Gl};
use modalcast_model::error::{Error, Result};
use modalcast_model::memory::{MemoryBudget, MemoryReservation};
use modalcast_model::raster::{NewTarget, Rasterizer, SharedDraw};
use modalcast_model::scene::Viewport;
use modalcast_model::shared_memory::{SharedPositions, SharedRange};

/// Maximum number of sets: two that OpenGL reads, and two that the rasterizer writes.
const MAX_SETS: usize = 4;
/// Bytes of a depth.
pub(super) const DEPTH_BYTES: u64 = 4;
/// Bytes of a visibility key: a word of the triangle's index, and a word of the inverted bits of the depth.
pub(super) const KEY_BYTES: u64 = 8;

/// What a compute rasterizer draws for a frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct RasterViews {
    /// The shadow map.
    pub(crate) shadow: Option<Viewport>,
    /// The visibility of the frame.
    pub(crate) frame: Option<Viewport>,
}

/// What a compute rasterizer draws of one step.
#[derive(Debug)]
pub(crate) struct StepViews {
    pub(crate) positions: SharedPositions,
    pub(crate) views: RasterViews,
}

/// The time of a set.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct SharedDrawTime {
    /// Milliseconds that the device drew.
    pub(crate) device_ms: f64,
    /// Further milliseconds that the host waited: for frames of OpenGL and for the change of the device's context.
    pub(crate) switch_ms: f64,
}

/// A buffer of OpenGL and the rasterizer's handle to its memory. OpenGL releases the memory first.
#[derive(Debug)]
struct SharedBuffer {
    buffer: Buffer,
    range: Rc<dyn SharedRange>,
    _memory: Arc<MemoryReservation>,
}

/// The samples of one frame.
#[derive(Debug, Default)]
struct TargetSet {
    depths: Option<SharedBuffer>,
    keys: Option<SharedBuffer>,
    /// Follows OpenGL's last command that reads the set.
    read: Option<Fence>,
}

/// A set that the rasterizer has drawn.
#[derive(Debug)]
struct DrawnSet {
    set: TargetSet,
    step: u64,
    views: RasterViews,
    time: SharedDrawTime,
}

/// The sets of a scene.
#[derive(Debug)]
pub(super) struct SharedTargets {
    /// Limit on their memory.
    budget: Arc<MemoryBudget>,
    /// Sets whose readers have been submitted, oldest first, and unused ones.
    free: VecDeque<TargetSet>,
    /// Sets of frames that are not recorded yet.
    drawn: Vec<DrawnSet>,
    /// The set of the frame that is recorded next, or at present.
    current: Option<DrawnSet>,
    /// Number of existing sets.
    count: usize,
    /// Limit on `count`: [`MAX_SETS`], or fewer if the budget has no memory for more.
    max_count: usize,
    last_draw: Instant,
}

/// Reserves the memory of an output buffer of the compute rasterizer.
///
/// # Errors
/// `OutOfMemory`.
pub(super) fn reserve_output(budget: &Arc<MemoryBudget>, bytes: u64) -> Result<Arc<MemoryReservation>> {
    let memory = MemoryReservation::new(budget);
    memory.reserve("the output of the compute rasterizer", bytes)?;
    Ok(memory)
}

impl SharedBuffer {
    fn new(gl: &Rc<Gl>, budget: &Arc<MemoryBudget>, rasterizer: &mut dyn Rasterizer, bytes: u64) -> Result<Self> {
        let memory = reserve_output(budget, bytes)?;
        let NewTarget { descriptor, allocated_bytes, range } = rasterizer.create_target(bytes)?;
        Ok(Self { buffer: Buffer::import(gl, descriptor, allocated_bytes, bytes)?, range, _memory: memory })
    }
}

impl TargetSet {
    fn is_read(&self) -> bool {
        self.read.as_ref().is_none_or(Fence::is_done)
    }

    /// Allocates the memory that the views need. Replaces buffers that are too small; nothing accesses them.
    fn reserve(
        &mut self,
        gl: &Rc<Gl>,
        budget: &Arc<MemoryBudget>,
        rasterizer: &mut dyn Rasterizer,
        views: &RasterViews,
    ) -> Result<()> {
        for (slot, viewport, sample_bytes) in
            [(&mut self.depths, views.shadow, DEPTH_BYTES), (&mut self.keys, views.frame, KEY_BYTES)]
        {
            let bytes = viewport.map_or(0, |viewport| sample_bytes * viewport.pixel_count() as u64);
            if slot.as_ref().map_or(0, |shared| shared.buffer.bytes) < bytes {
                *slot = None;
                *slot = Some(SharedBuffer::new(gl, budget, rasterizer, bytes)?);
            }
        }
        Ok(())
    }

    /// The draws of the views into this set.
    fn draw<'a>(&'a self, step: &'a StepViews) -> SharedDraw<'a> {
        fn target<'a>(
            slot: &'a Option<SharedBuffer>,
            view: &'a Option<Viewport>,
        ) -> Option<(&'a Viewport, &'a dyn SharedRange)> {
            view.as_ref().zip(slot.as_ref().map(|shared| shared.range.as_ref()))
        }
        SharedDraw {
            positions: step.positions.range.as_ref(),
            depth: target(&self.depths, &step.views.shadow),
            ids: target(&self.keys, &step.views.frame),
        }
    }
}

impl SharedTargets {
    pub(super) fn new(budget: &Arc<MemoryBudget>) -> Self {
        let (free, drawn) = (VecDeque::new(), Vec::new());
        let (current, count, max_count, last_draw) = (None, 0, MAX_SETS, Instant::now());
        Self { budget: Arc::clone(budget), free, drawn, current, count, max_count, last_draw }
    }

    /// Makes the set of the first step the current one. Draws it unless it was drawn ahead; then also draws the later
    /// steps, in the same turn of the device, as long as sets are free and their memory is within the budget. After an
    /// error, this value must be dropped.
    ///
    /// # Errors
    /// Errors of the rasterizer; `OutOfMemory`; `Fault` if OpenGL refuses the memory or does not finish within `limit`.
    pub(super) fn draw(
        &mut self,
        gl: &Rc<Gl>,
        rasterizer: &mut dyn Rasterizer,
        steps: Vec<StepViews>,
        limit: Duration,
    ) -> Result<()> {
        self.release(gl)?;
        let mut steps = steps.into_iter();
        let Some(step) = steps.next() else { return Ok(()) };
        self.forget_steps_before(step.positions.step);
        let is_match = |drawn: &DrawnSet| drawn.step == step.positions.step && drawn.views == step.views;
        if let Some(index) = self.drawn.iter().position(is_match) {
            self.current = Some(self.drawn.swap_remove(index));
            return Ok(());
        }
        self.last_draw = Instant::now();
        let first = loop {
            let set = self.take_free(limit)?;
            if let Some(set) = self.reserve(gl, rasterizer, set, &step.views)? {
                break set;
            }
        };
        let mut sets = vec![(first, step)];
        for step in steps {
            let Some(set) = self.take_read() else { break };
            let Some(set) = self.reserve(gl, rasterizer, set, &step.views)? else { break };
            sets.push((set, step));
        }
        let count = sets.len() as f64;
        let begin = Instant::now();
        let device_ms = rasterizer.draw_shared(&sets.iter().map(|(set, step)| set.draw(step)).collect::<Vec<_>>())?;
        let switch_ms = (begin.elapsed().as_secs_f64() * 1e3 - device_ms).max(0.0);
        let device_ms = device_ms / count;
        let mut drawn_sets = sets.into_iter().map(|(set, StepViews { positions, views })| DrawnSet {
            set,
            step: positions.step,
            views,
            time: SharedDrawTime { device_ms, switch_ms: 0.0 },
        });
        self.current = drawn_sets.next();
        self.drawn.extend(drawn_sets);
        if let Some(current) = &mut self.current {
            current.time.switch_ms = switch_ms;
        }
        Ok(())
    }

    /// The set with the memory that the views need. `None` if the budget has no memory for so many sets; the set is
    /// then freed, and fewer exist from now on.
    ///
    /// # Errors
    /// `OutOfMemory` for the last set; `Fault` if OpenGL refuses the memory.
    fn reserve(
        &mut self,
        gl: &Rc<Gl>,
        rasterizer: &mut dyn Rasterizer,
        mut set: TargetSet,
        views: &RasterViews,
    ) -> Result<Option<TargetSet>> {
        match set.reserve(gl, &self.budget, rasterizer, views) {
            Ok(()) => Ok(Some(set)),
            Err(Error::OutOfMemory { .. }) if self.count > 1 => {
                self.count -= 1;
                self.max_count = self.count;
                Ok(None)
            }
            Err(error) => Err(error),
        }
    }

    /// Frees the sets that OpenGL does not read, if no set was drawn for the time `unused`.
    pub(super) fn free_unused(&mut self, unused: Duration) {
        if self.last_draw.elapsed() >= unused {
            self.forget_steps_before(u64::MAX);
            self.free.retain(|set| !set.is_read());
            self.count = self.free.len() + usize::from(self.current.is_some());
            self.max_count = MAX_SETS;
        }
    }

    /// The time of the current set if it has these views; otherwise there is no current set afterwards.
    pub(super) fn time_of(&mut self, gl: &Rc<Gl>, views: &RasterViews) -> Result<Option<SharedDrawTime>> {
        if let Some(current) = self.current.as_ref().filter(|current| current.views == *views) {
            return Ok(Some(current.time));
        }
        self.release(gl).map(|()| None)
    }

    /// Ends the use of the current set by OpenGL, after all commands that read it.
    pub(super) fn release(&mut self, gl: &Rc<Gl>) -> Result<()> {
        if let Some(DrawnSet { set, .. }) = self.current.take() {
            // Without a fence, the set cannot be reused, and is freed.
            let read = gl.fence("raster").inspect_err(|_| self.count -= 1)?;
            self.free.push_back(TargetSet { read: Some(read), ..set });
        }
        Ok(())
    }

    /// The buffer of depths of the current set.
    pub(super) fn depths(&self) -> Option<&Buffer> {
        Some(&self.current.as_ref()?.set.depths.as_ref()?.buffer)
    }

    /// The buffer of keys of the current set.
    pub(super) fn keys(&self) -> Option<&Buffer> {
        Some(&self.current.as_ref()?.set.keys.as_ref()?.buffer)
    }

    /// Bytes of depths and of keys in all sets.
    pub(super) fn bytes(&self) -> [u64; 2] {
        let pending = self.drawn.iter().chain(&self.current).map(|drawn| &drawn.set);
        let bytes = |slot: &Option<SharedBuffer>| slot.as_ref().map_or(0, |shared| shared.buffer.bytes);
        self.free
            .iter()
            .chain(pending)
            .fold([0, 0], |[depths, keys], set| [depths + bytes(&set.depths), keys + bytes(&set.keys)])
    }

    /// Frees the sets that were drawn ahead for frames that will not be drawn.
    fn forget_steps_before(&mut self, step: u64) {
        let (kept, old) = std::mem::take(&mut self.drawn).into_iter().partition(|drawn| drawn.step >= step);
        self.drawn = kept;
        let old: Vec<DrawnSet> = old;
        // OpenGL does not read them.
        old.into_iter().for_each(|drawn| self.free.push_front(drawn.set));
    }

    /// A set that OpenGL does not read. `None` if all are in use.
    fn take_read(&mut self) -> Option<TargetSet> {
        if self.free.front().is_some_and(TargetSet::is_read) {
            return self.free.pop_front();
        }
        (self.count < self.max_count).then(|| {
            self.count += 1;
            TargetSet::default()
        })
    }

    /// A set that OpenGL does not read. Takes one that was drawn ahead if all are in use, or waits for OpenGL.
    fn take_free(&mut self, limit: Duration) -> Result<TargetSet> {
        if let Some(set) = self.take_read().or_else(|| self.drawn.pop().map(|drawn| drawn.set)) {
            return Ok(set);
        }
        let set = self.free.pop_front().unwrap_or_default();
        set.read.as_ref().map_or(Ok(()), |fence| fence.wait("raster", limit))?;
        Ok(set)
    }
}
