//! Asynchronous frames: [`Renderer::submit`] records the commands of a frame, [`Renderer::read_image`] takes its pixels
//! when they are ready. In between, the host can do other work or submit more frames.
//!
//! The uniforms of a frame (`frame`, `splits`, the initial values of the counters) are written with stream-ordered
//! OpenGL commands. Frames in flight therefore keep their own values; the same holds for uploaded vertices.

use std::cell::Cell;
use std::ops::Range;
use std::time::{Duration, Instant};

use rayon::prelude::*;

use super::cascades::ShadowCascades;
use super::oit;
use super::programs::SampleCountPrograms;
use super::region::Region;
use super::scene_buffers::SceneBuffers;
use super::target::{RenderTarget, TargetDesc};
use super::{
    FrameImage, FrameParams, FrameStats, RasterBackend, RasterBackends, Renderer, cull, frame_uniforms, passes,
};
use crate::device::gl::{BufferCopy, Fence, PassTimer, ReadbackView};
use crate::device::readback_ring::ReadbackSlot;
use modalcast_model::error::{Error, Result, fault_in, invalid};

/// Bytes that one thread copies at a time: large enough that the cost of starting a task is small in comparison.
const COPY_CHUNK_BYTES: usize = 1 << 20;

/// A frame in flight. Dropping the ticket abandons the frame.
#[derive(Debug)]
pub struct PendingFrame {
    desc: TargetDesc,
    /// None for a frame whose pixels are not read back.
    slot: Option<ReadbackSlot>,
    fence: Fence,
    /// Passes in execution order, each with its timer.
    passes: Vec<(&'static str, PassTimer)>,
    stats: FrameStats,
    limit: Duration,
    /// When the host first polled or waited for the frame.
    first_wait: Cell<Option<Instant>>,
}

/// Pixels of a finished frame, still in the staging buffer that the device wrote. Any thread may copy them. The ring
/// cannot reuse the staging buffer until then, so copy them soon.
#[derive(Debug)]
pub struct MappedPixels {
    width: u32,
    height: u32,
    view: Option<ReadbackView>,
    passes: Vec<(&'static str, f64)>,
    raster_backends: RasterBackends,
}

impl Renderer {
    /// Draws one frame of the current buffers and waits for its pixels.
    ///
    /// # Errors
    /// Those of [`Self::submit`] and [`Self::map_pixels`].
    pub fn draw(&mut self, buffers: &SceneBuffers, shot: &FrameParams) -> Result<FrameImage> {
        let ticket = self.submit(buffers, shot)?;
        self.read_image(ticket)
    }

    /// Submits one frame of the current buffers; later changes of the buffers do not affect it. At most
    /// [`super::MAX_FRAMES_IN_FLIGHT`] frames of one form may be in flight. A further one is refused until the oldest is
    /// collected.
    ///
    /// # Errors
    /// `Busy` when too many frames are in flight, `Invalid` for a size above the limit or a camera whose matrices
    /// overflow, `Fault` naming the pass when OpenGL reports an error.
    pub fn submit(&mut self, buffers: &SceneBuffers, shot: &FrameParams) -> Result<PendingFrame> {
        self.submit_frame(buffers, shot, true)
    }

    /// Submits a frame whose pixels stay on the device, like a frame that is shown on a screen: its image is empty.
    /// Such frames use no staging buffer, so their number in flight is not limited.
    ///
    /// # Errors
    /// Those of [`Self::submit`] except `Busy`.
    pub fn submit_without_readback(&mut self, buffers: &SceneBuffers, shot: &FrameParams) -> Result<PendingFrame> {
        self.submit_frame(buffers, shot, false)
    }

    /// Waits for a frame and copies its pixels.
    ///
    /// # Errors
    /// Those of [`Self::map_pixels`].
    pub fn read_image(&mut self, ticket: PendingFrame) -> Result<FrameImage> {
        self.map_pixels(ticket).map(MappedPixels::into_image)
    }

    /// Waits for a frame and returns its pixels uncopied, so that another thread can copy them.
    ///
    /// # Errors
    /// `Fault` naming the pass that did not finish within the time limit, or the OpenGL error.
    pub fn map_pixels(&mut self, ticket: PendingFrame) -> Result<MappedPixels> {
        let _current = self.gl.make_current()?;
        ticket.wait()?;
        let PendingFrame { desc, slot, passes, mut stats, .. } = ticket;
        let staging = slot.as_ref().and_then(ReadbackSlot::staging);
        if let Some(staging) = staging {
            let [listed, culled] = desc.readback_ranges().map(|part| part.start as usize..part.end as usize);
            let read = |part: Range<usize>| if part.is_empty() { Ok(None) } else { staging.read(part).map(Some) };
            (stats.oit, stats.culled) = (
                read(listed)?.map(|head| oit::parse_stats(&head)),
                read(culled)?.map(|counts| cull::parse_stats(&counts)),
            );
        }
        // When the compute rasterizer drew the visibility there are no camera counts; the sun's are dropped with them.
        stats.culled = stats.culled.filter(|_| stats.raster_backends.visibility != Some(RasterBackend::Cuda));
        let view = staging.map(|staging| staging.view(desc.bytes() as usize)).transpose()?;
        self.gl.check("read")?;
        warn_of_dropped_fragments(&self.stats, &stats);
        if let Some(culled) = &stats.culled {
            tracing::trace!(?culled, "triangles before they were drawn");
        }
        let raster_backends = stats.raster_backends;
        self.stats = stats;
        Ok(MappedPixels { width: desc.width, height: desc.height, view, passes: stage_times(&passes), raster_backends })
    }

    fn submit_frame(&mut self, buffers: &SceneBuffers, shot: &FrameParams, is_read: bool) -> Result<PendingFrame> {
        let _current = self.gl.make_current()?;
        self.check_size(shot)?;
        let numbers = frame_uniforms::FrameUniforms::new(&buffers.scene, shot, buffers.origin)?;
        let look = &buffers.scene.look;
        let size = [shot.width, shot.height];
        let desc = TargetDesc::new(&self.gl, size, look, oit::blend_storage(&self.gl, &buffers.scene, size)?);
        let desc = TargetDesc { culling: cull::culling_of(buffers.plan()), ..desc };
        self.ensure_target(desc)?;
        let sample_programs = buffers.sample_programs(desc.samples, &mut |source| self.program(source))?;
        let Some(target) = self.targets.last() else { return Err(fault_in("draw")("no target")) };
        let slot = if is_read { Some(target.readback_ring.acquire(self.frame_timeout)?) } else { None };
        // A pass that fails or panics leaves the images undefined, so the target is cached again only after all passes.
        let Some(target) = self.targets.pop() else { return Err(fault_in("draw")("no target")) };
        let ground = draws_ground(buffers, shot);
        target.draw_region.set(draw_region(buffers, shot, ground));
        buffers.buffer("frame uniforms")?.write(bytemuck::bytes_of(&numbers));
        passes::bind(buffers)?;
        cull::clear_counters(buffers);
        if let Some(splits) = buffers.buffers.get("shadow cascades") {
            let fit = frame_uniforms::light_box_params(&buffers.scene, shot, buffers.origin);
            splits.write(bytemuck::bytes_of(&ShadowCascades::new(&buffers.scene, shot, &fit, buffers.origin)));
        }
        let mut stats = FrameStats { samples: desc.samples, ..FrameStats::default() };
        let passes = self.record_passes(buffers, shot, (&target, &sample_programs, ground), &mut stats).and_then(
            |mut passes| {
                passes.extend(self.record_readback(buffers, &target, slot.as_ref())?);
                Ok(passes)
            },
        );
        let passes = passes?;
        self.targets.push(target);
        self.last_uniforms = Some(numbers);
        Ok(PendingFrame {
            desc,
            slot,
            fence: self.gl.fence("read")?,
            passes,
            stats,
            limit: self.frame_timeout,
            first_wait: Cell::new(None),
        })
    }

    pub(crate) fn check_size(&self, shot: &FrameParams) -> Result<()> {
        let limit = self.info.max_side;
        if [shot.width, shot.height].iter().all(|side| (1..=limit).contains(side)) {
            return Ok(());
        }
        let given = format!("{} x {}", shot.width, shot.height);
        Err(invalid("frame.size", format!("1 to {limit} pixels a side"), given))
    }

    /// Records the passes that make the picture.
    fn record_passes(
        &self,
        buffers: &SceneBuffers,
        shot: &FrameParams,
        (target, sample_programs, ground): (&RenderTarget, &SampleCountPrograms, bool),
        stats: &mut FrameStats,
    ) -> Result<Vec<(&'static str, PassTimer)>> {
        let gl = &self.gl;
        let time_pass = |pass, commands: &mut dyn FnMut() -> Result<()>| {
            gl.time_pass((pass, self.frame_timeout), commands).map(|timer| (pass, timer))
        };
        let mut times = Vec::new();
        let content = buffers.shadow_key(shot);
        let by_others = buffers.active_rasterizer().map(|(compute_rasterizer, enabled)| {
            let wanted = [enabled[0] && buffers.shadow_cache.is_stale(content), enabled[1]];
            (compute_rasterizer, wanted)
        });
        if let Some((compute_rasterizer, wanted)) = by_others.filter(|(_, wanted)| wanted.contains(&true)) {
            let name = if wanted[0] { "raster shadow" } else { "raster visibility" };
            match time_pass(name, &mut || compute_rasterizer.draw(gl, (buffers, shot), wanted, stats)) {
                Ok(time) => times.push(time),
                Err(error) => compute_rasterizer.disable(&error),
            }
        }
        buffers.shadow_cache.draw_if_stale(content, || {
            times.push(time_pass("shadow", &mut || passes::shadow(gl, buffers, stats))?);
            times.push(time_pass("blur", &mut || passes::blur(gl, buffers, stats))?);
            Ok(())
        })?;
        let compute_rasterizer = buffers
            .active_rasterizer()
            .filter(|(_, enabled)| enabled[1])
            .map(|(compute_rasterizer, _)| compute_rasterizer);
        if buffers.culler.is_some() && compute_rasterizer.is_none() {
            times.push(time_pass("cull", &mut || cull::cull_for_camera(gl, buffers, target, sample_programs, stats))?);
        }
        times.extend([
            time_pass("visibility", &mut || match compute_rasterizer {
                Some(compute_rasterizer) => compute_rasterizer.unpack(gl, target, stats),
                None => {
                    passes::visibility(gl, buffers, target, sample_programs, stats)?;
                    if ground { passes::ground(gl, buffers, shot, stats) } else { Ok(()) }
                }
            })?,
            time_pass("blended", &mut || passes::blended(gl, buffers, target, sample_programs, stats))?,
            time_pass("shade", &mut || passes::shade(gl, buffers, target, sample_programs, stats))?,
            time_pass("bloom", &mut || buffers.post.bloom(gl, target, stats))?,
            time_pass("encode", &mut || buffers.post.encode(gl, target, stats))?,
        ]);
        Ok(times)
    }

    /// Copies the pixels, then the list and culling statistics, to the staging buffer.
    fn record_readback(
        &self,
        buffers: &SceneBuffers,
        target: &RenderTarget,
        slot: Option<&ReadbackSlot>,
    ) -> Result<Option<(&'static str, PassTimer)>> {
        let Some(staging) = slot.and_then(ReadbackSlot::staging) else { return Ok(None) };
        let bytes = target.desc.bytes();
        let copy = || {
            self.gl.copy(BufferCopy::first(bytes, &target.readback_source, &staging.buffer));
            let counters = target.oit.as_ref().map(|oit| &oit.counters);
            for (from, to) in
                [counters, buffers.buffers.get(cull::COUNTERS)].into_iter().zip(target.desc.readback_ranges())
            {
                if let Some(from) = from.filter(|_| !to.is_empty()) {
                    let copy = BufferCopy::first(to.end - to.start, from, &staging.buffer);
                    self.gl.copy(BufferCopy { to_offset: to.start, ..copy });
                }
            }
            self.gl.check("read")
        };
        self.gl.time_pass(("read", self.frame_timeout), copy).map(|timer| Some(("read", timer)))
    }
}

/// Whether the ground must be rasterized.
fn draws_ground(buffers: &SceneBuffers, shot: &FrameParams) -> bool {
    let scene = &buffers.scene;
    // The bounds of a rebased scene exclude distant domains.
    let is_last = buffers.rebased.is_none() && frame_uniforms::ground_is_behind_scene(scene, shot, buffers.origin);
    scene.look.ground.is_some() && frame_uniforms::camera_is_above_ground(scene, shot) && !is_last
}

/// Region of the frame that may show triangles or rasterized ground.
fn draw_region(buffers: &SceneBuffers, shot: &FrameParams, ground: bool) -> Region {
    let size = [shot.width, shot.height];
    if buffers.rebased.is_some() || ground {
        return Region::whole(size);
    }
    Region::project(&frame_uniforms::clip_from_positions(&buffers.scene, shot, buffers.origin), &shot.bounds, size)
}

impl PendingFrame {
    /// Whether [`Renderer::map_pixels`] would return without waiting.
    pub fn is_ready(&self) -> bool {
        self.is_ready_within(Duration::ZERO)
    }

    /// Waits at most `limit` for the frame and returns whether it is ready. A frame that exceeds the watchdog's limit
    /// counts as ready: retrieving it reports the timeout.
    pub fn is_ready_within(&self, limit: Duration) -> bool {
        self.time_left().is_zero() || self.fence.is_done_within(limit)
    }

    /// Remaining watchdog time. The clock starts at the first poll or wait.
    fn time_left(&self) -> Duration {
        let begin = self.first_wait.get().unwrap_or_else(Instant::now);
        self.first_wait.set(Some(begin));
        self.limit.saturating_sub(begin.elapsed())
    }

    fn wait(&self) -> Result<()> {
        self.fence.wait("read", self.time_left()).map_err(|error| self.name_failed_pass(error))
    }

    /// Names the pass at which the device stopped: the one after the last pass that is known to be finished.
    fn name_failed_pass(&self, error: Error) -> Error {
        let Error::Fault { stage, reason } = error else { return error };
        let over = self.passes.iter().take_while(|(_, timer)| timer.is_done()).count();
        let stage = self.passes.get(over).map_or(stage, |(pass, _)| *pass);
        let last = over.checked_sub(1).map_or("none".into(), |last| format!("'{}'", self.passes[last].0));
        Error::Fault { stage, reason: format!("{reason} ({:?}); the last pass that it finished: {last}", self.limit) }
    }
}

impl MappedPixels {
    /// Adds the milliseconds of a stage that ran before the others.
    #[must_use]
    pub fn with_stage(mut self, stage: &'static str, ms: f64) -> Self {
        self.passes.insert(0, (stage, ms));
        self
    }

    /// Copies the pixels; several threads share the work when there are many.
    pub fn into_image(self) -> FrameImage {
        let begin = Instant::now();
        let Self { width, height, view, mut passes, raster_backends } = self;
        let bytes = view.as_ref().map_or(&[][..], ReadbackView::bytes);
        let mut rgba = vec![0; bytes.len()];
        let stretches = rgba.par_chunks_mut(COPY_CHUNK_BYTES).zip(bytes.par_chunks(COPY_CHUNK_BYTES));
        stretches.for_each(|(to, from)| to.copy_from_slice(from));
        drop(view);
        if let Some((_, ms)) = passes.iter_mut().find(|(name, _)| *name == "read") {
            *ms += begin.elapsed().as_secs_f64() * 1e3;
        }
        FrameImage { width, height, rgba, passes, raster_backends }
    }
}

/// Milliseconds of the stages and of their passes.
fn stage_times(passes: &[(&'static str, PassTimer)]) -> Vec<(&'static str, f64)> {
    let all: Vec<(&'static str, f64)> = passes.iter().map(|(name, timer)| (*name, timer.ms())).collect();
    let of_shadow = |name: &str| ["raster shadow", "shadow", "blur"].contains(&name);
    let sum =
        |wanted: &dyn Fn(&str) -> bool| all.iter().filter(|(name, _)| wanted(name)).fold(0.0, |sum, (_, ms)| sum + ms);
    let mut times = vec![("shadow", sum(&of_shadow))];
    times.extend(all.iter().filter(|(name, _)| of_shadow(name) && *name != "shadow"));
    times.push(("draw", sum(&|name| !of_shadow(name) && name != "read")));
    times.extend(all.iter().filter(|(name, _)| !of_shadow(name)));
    times
}

/// Warns when a frame drops blended fragments and the previous one did not.
fn warn_of_dropped_fragments(last: &FrameStats, stats: &FrameStats) {
    let lacks = |stats: &FrameStats| stats.oit.filter(|oit| oit.dropped() > 0);
    if let (Some(oit), None) = (lacks(stats), lacks(last)) {
        let (dropped, kept) = (oit.dropped(), oit.stored);
        tracing::warn!(
            dropped,
            kept,
            "blended fragments are over the budget (look.fragments): the farthest are not drawn"
        );
    }
}

#[cfg(test)]
mod tests;
