//! Asynchronous frames: [`Renderer::submit`] records the commands of a frame, [`Renderer::read_image`] takes its pixels
//! when they are ready. In between, the host can do other work or submit more frames.
//!
//! The uniforms of a frame (camera, cascades, the initial values of the counters) are written with stream-ordered
//! OpenGL commands. Frames in flight therefore keep their own values; the same holds for uploaded vertices.

use std::cell::Cell;
use std::ops::Range;

use super::pending_frame::{MappedPixels, PendingFrame};
use super::{LastFrame, Renderer};
use crate::device::gl::PassTimer;
use crate::device::readback_ring::ReadbackSlot;
use crate::layout;
use crate::pass::{FrameTimes, Pass};
use crate::passes::{self, FrameContext, PassRecorder, readback};
use crate::region::Region;
use crate::resources::compute_rasterizer::RasterPasses;
use crate::resources::oit::blend_storage;
use crate::resources::scene_buffers::SceneBuffers;
use crate::resources::target_desc::TargetDesc;
use crate::types::{FrameImage, FrameParams, FrameStats, RasterBackend};
use crate::uniforms::frame::{FrameUniforms, camera_is_above_ground, clip_from_positions, ground_is_behind_scene};
use modalcast_model::error::{Result, fault_in};

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
    /// [`crate::MAX_FRAMES_IN_FLIGHT`] frames of one form may be in flight. A further one is refused until the oldest is
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
                read(listed)?.map(|head| layout::oit::parse_counters(&head)),
                read(culled)?.map(|counts| layout::cull::parse_counters(&counts)),
            );
        }
        // When the compute rasterizer drew the visibility there are no camera counts; the sun's are dropped with them.
        stats.culled = stats.culled.filter(|_| stats.raster_backends.visibility != Some(RasterBackend::Cuda));
        let view = staging.map(|staging| staging.view(desc.bytes() as usize)).transpose()?;
        self.gl.check(Pass::Read.name())?;
        warn_of_dropped_fragments(&self.stats, &stats);
        if let Some(culled) = &stats.culled {
            tracing::trace!(?culled, "triangles before they were drawn");
        }
        let raster_backends = stats.raster_backends;
        self.stats = stats;
        let times: Vec<(Pass, f64)> = passes.iter().map(|(pass, timer)| (*pass, timer.ms())).collect();
        let times = FrameTimes::of_passes(&times);
        Ok(MappedPixels { width: desc.width, height: desc.height, view, times, raster_backends })
    }

    fn submit_frame(&mut self, buffers: &SceneBuffers, shot: &FrameParams, is_read: bool) -> Result<PendingFrame> {
        let _current = self.gl.make_current()?;
        self.check_size(shot)?;
        let uniforms = FrameUniforms::new(&buffers.scene, shot, buffers.origin)?;
        let look = &buffers.scene.look;
        let size = [shot.width, shot.height];
        let desc = TargetDesc::new(&self.gl, size, look, blend_storage(&self.gl, &buffers.scene, size)?);
        let desc = TargetDesc { culling: buffers.culling(), ..desc };
        self.ensure_target(desc)?;
        let programs = buffers.sample_programs(desc.samples, &mut |source| self.programs.program(source))?;
        let Some(target) = self.targets.last() else { return Err(fault_in("draw")("no target")) };
        let slot = if is_read { Some(target.readback_ring.acquire(self.frame_timeout)?) } else { None };
        // A pass that fails or panics leaves the images undefined, so the target is cached again only after all passes.
        self.last_frame = None;
        let Some(target) = self.targets.pop() else { return Err(fault_in("draw")("no target")) };
        let ground = draws_ground(buffers, shot);
        target.draw_region.set(draw_region(buffers, shot, ground));
        let mut stats = FrameStats { samples: desc.samples, ..FrameStats::default() };
        let mut recorder = PassRecorder { gl: &self.gl, stats: &mut stats };
        passes::uniforms::upload(&recorder, buffers, shot, &uniforms);
        let frame = FrameContext { buffers, target: &target, programs: &programs, shot };
        let passes = self.record_passes(&mut recorder, &frame, ground).and_then(|mut passes| {
            passes.extend(self.record_readback(&recorder, &frame, slot.as_ref())?);
            Ok(passes)
        });
        let passes = passes?;
        self.targets.push(target);
        self.last_frame = Some(LastFrame { desc, uniforms });
        Ok(PendingFrame {
            desc,
            slot,
            fence: self.gl.fence(Pass::Read.name())?,
            passes,
            stats,
            limit: self.frame_timeout,
            first_wait: Cell::new(None),
        })
    }

    /// Records the passes that make the picture.
    fn record_passes(
        &self,
        recorder: &mut PassRecorder<'_>,
        frame: &FrameContext<'_>,
        ground: bool,
    ) -> Result<Vec<(Pass, PassTimer)>> {
        let buffers = frame.buffers;
        let mut times = Vec::new();
        let content = buffers.shadow_key(frame.shot);
        if let Some((rasterizer, enabled)) = buffers.active_rasterizer() {
            let wanted = RasterPasses { shadow: enabled.shadow && buffers.shadow_cache.is_stale(content), ..enabled };
            if wanted.any() {
                let draw = || passes::raster::draw(recorder, frame, rasterizer, wanted);
                match self.time_pass(wanted.name(), draw) {
                    Ok(time) => times.push(time),
                    Err(error) => rasterizer.disable(&error),
                }
            }
        }
        buffers.shadow_cache.draw_if_stale(content, || {
            times.push(self.time_pass(Pass::Shadow, || passes::shadow::draw_depth(recorder, buffers))?);
            times.push(self.time_pass(Pass::Blur, || passes::shadow::blur(recorder, buffers))?);
            Ok(())
        })?;
        let rasterizer = buffers.visibility_rasterizer();
        if buffers.culler.is_some() && rasterizer.is_none() {
            times.push(self.time_pass(Pass::Cull, || passes::cull::cull_for_camera(recorder, frame))?);
        }
        times.push(self.time_pass(Pass::Visibility, || match rasterizer {
            Some(rasterizer) => passes::raster::unpack(recorder, frame, rasterizer),
            None => passes::visibility::draw(recorder, frame, ground),
        })?);
        times.push(self.time_pass(Pass::Blended, || passes::blended::draw(recorder, frame))?);
        times.push(self.time_pass(Pass::Shade, || passes::shade::draw(recorder, frame))?);
        times.push(self.time_pass(Pass::Bloom, || passes::post::bloom(recorder, frame))?);
        times.push(self.time_pass(Pass::Encode, || passes::post::encode(recorder, frame))?);
        Ok(times)
    }

    /// Measures the passes that `commands` records, under the name of one of them.
    fn time_pass(&self, pass: Pass, commands: impl FnOnce() -> Result<()>) -> Result<(Pass, PassTimer)> {
        self.gl.time_pass(pass.name(), self.frame_timeout, commands).map(|timer| (pass, timer))
    }

    /// Copies the pixels, then the list and culling statistics, to the staging buffer.
    fn record_readback(
        &self,
        recorder: &PassRecorder<'_>,
        frame: &FrameContext<'_>,
        slot: Option<&ReadbackSlot>,
    ) -> Result<Option<(Pass, PassTimer)>> {
        let Some(staging) = slot.and_then(ReadbackSlot::staging) else { return Ok(None) };
        let copy = || readback::copy_frame(recorder, frame, &staging.buffer);
        self.time_pass(Pass::Read, copy).map(Some)
    }
}

/// Whether the ground must be rasterized.
fn draws_ground(buffers: &SceneBuffers, shot: &FrameParams) -> bool {
    let scene = &buffers.scene;
    // The bounds of a rebased scene exclude distant domains.
    let is_last = buffers.rebased.is_none() && ground_is_behind_scene(scene, shot, buffers.origin);
    scene.look.ground.is_some() && camera_is_above_ground(scene, shot) && !is_last
}

/// Region of the frame that may show triangles or rasterized ground.
fn draw_region(buffers: &SceneBuffers, shot: &FrameParams, ground: bool) -> Region {
    let size = [shot.width, shot.height];
    if buffers.rebased.is_some() || ground {
        return Region::whole(size);
    }
    Region::project(&clip_from_positions(&buffers.scene, shot, buffers.origin), &shot.bounds, size)
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
