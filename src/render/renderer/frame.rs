//! Asynchronous frames: [`Renderer::submit`] records the commands of a frame, [`Renderer::read_image`] waits for its
//! pixels and copies them. In between, the host can do other work or submit more frames.
//!
//! Uniforms, initial counter values and uploaded vertices are written with stream-ordered OpenGL commands, so frames in
//! flight keep their values.

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
use modalcast_model::error::{Error, Result, fault};

impl Renderer {
    /// Draws one frame of the current buffers and waits for its pixels.
    ///
    /// # Errors
    /// Errors of [`Self::submit`] and [`Self::map_pixels`].
    pub fn draw(&mut self, buffers: &SceneBuffers, params: &FrameParams) -> Result<FrameImage> {
        let pending_frame = self.submit(buffers, params)?;
        self.read_image(pending_frame)
    }

    /// Submits one frame of the current buffers; later changes of the buffers do not affect it. At most
    /// [`crate::MAX_FRAMES_IN_FLIGHT`] frames of one render target may be in flight.
    ///
    /// # Errors
    /// `Busy` if too many frames are in flight; `Invalid` for a size above the limit or a camera whose matrices
    /// overflow; `Fault` with the pass if OpenGL reports an error.
    pub fn submit(&mut self, buffers: &SceneBuffers, params: &FrameParams) -> Result<PendingFrame> {
        self.submit_frame(buffers, params, true)
    }

    /// Submits a frame whose pixels stay on the device; its image is empty. Such frames use no staging buffer, so their
    /// number in flight is not limited.
    ///
    /// # Errors
    /// Errors of [`Self::submit`] except `Busy`.
    pub fn submit_without_readback(&mut self, buffers: &SceneBuffers, params: &FrameParams) -> Result<PendingFrame> {
        self.submit_frame(buffers, params, false)
    }

    /// Waits for a frame and copies its pixels.
    ///
    /// # Errors
    /// Errors of [`Self::map_pixels`].
    pub fn read_image(&mut self, pending_frame: PendingFrame) -> Result<FrameImage> {
        self.map_pixels(pending_frame).map(MappedPixels::into_image)
    }

    /// Waits for a frame and maps its pixels, so that another thread can copy them.
    ///
    /// # Errors
    /// `Fault` with the pass that did not finish within the time limit, or with the OpenGL error.
    pub fn map_pixels(&mut self, pending_frame: PendingFrame) -> Result<MappedPixels> {
        let _current = self.gl.make_current()?;
        pending_frame.wait()?;
        let PendingFrame { desc, slot, passes, mut stats, .. } = pending_frame;
        let staging = slot.as_ref().and_then(ReadbackSlot::staging);
        if let Some(staging) = staging {
            let [oit_range, cull_range] = desc.readback_ranges().map(|range| range.start as usize..range.end as usize);
            let read_range =
                |range: Range<usize>| if range.is_empty() { Ok(None) } else { staging.read(range).map(Some) };
            (stats.oit, stats.culled) = (
                read_range(oit_range)?.map(|counters| layout::oit::parse_counters(&counters)),
                read_range(cull_range)?.map(|counts| layout::cull::parse_counters(&counts)),
            );
        }
        // If the compute rasterizer drew the visibility, there are no camera counts. Then the shadow counts are
        // dropped, too.
        stats.culled = stats.culled.filter(|_| stats.raster_backends.visibility != Some(RasterBackend::Cuda));
        let view = staging.map(|staging| staging.view(desc.frame_bytes() as usize)).transpose()?;
        self.gl.check(Pass::Read.name())?;
        warn_of_dropped_fragments(&self.stats, &stats);
        if let Some(culled) = &stats.culled {
            tracing::trace!(?culled, "culled triangles");
        }
        let raster_backends = stats.raster_backends;
        self.stats = stats;
        let times: Vec<(Pass, f64)> = passes.iter().map(|(pass, timer)| (*pass, timer.ms())).collect();
        let times = FrameTimes::of_passes(&times);
        Ok(MappedPixels { width: desc.width, height: desc.height, view, times, raster_backends })
    }

    /// Records and submits a frame. `has_readback`: whether its pixels are read back.
    fn submit_frame(
        &mut self,
        buffers: &SceneBuffers,
        params: &FrameParams,
        has_readback: bool,
    ) -> Result<PendingFrame> {
        let _current = self.gl.make_current()?;
        self.check_size(params)?;
        let uniforms = FrameUniforms::new(&buffers.scene, params, buffers.origin)?;
        let look = &buffers.scene.look;
        let size = [params.width, params.height];
        let desc = TargetDesc::new(&self.gl, size, look, blend_storage(&self.gl, &buffers.scene, size)?);
        let desc = TargetDesc { culling: buffers.culling(), ..desc };
        self.ensure_target(desc)?;
        let programs = buffers.sample_programs(desc.samples, &mut |source| self.programs.program(source))?;
        let Some(target) = self.targets.last() else { return Err(fault("draw", "no target")) };
        let slot = if has_readback { Some(target.readback_ring.acquire(self.frame_timeout)?) } else { None };
        // If a pass fails or panics, the images of the target are undefined. Therefore the target is not in the cache
        // until all passes are recorded.
        self.last_frame = None;
        let Some(target) = self.targets.pop() else { return Err(fault("draw", "no target")) };
        let draws_ground = must_draw_ground(buffers, params);
        target.draw_region.set(draw_region(buffers, params, draws_ground));
        let mut stats = FrameStats { samples: desc.samples, ..FrameStats::default() };
        let mut recorder = PassRecorder { gl: &self.gl, stats: &mut stats };
        passes::uniforms::upload(&recorder, buffers, params, &uniforms);
        let frame = FrameContext { buffers, target: &target, programs: &programs, params };
        let mut passes = self.record_passes(&mut recorder, &frame, draws_ground)?;
        passes.extend(self.record_readback(&recorder, &frame, slot.as_ref())?);
        self.targets.push(target);
        self.last_frame = Some(LastFrame { desc, uniforms });
        Ok(PendingFrame {
            desc,
            slot,
            fence: self.gl.fence(Pass::Read.name())?,
            passes,
            stats,
            timeout: self.frame_timeout,
            first_wait: Cell::new(None),
        })
    }

    /// Records all passes except the readback.
    fn record_passes(
        &self,
        recorder: &mut PassRecorder<'_>,
        frame: &FrameContext<'_>,
        draws_ground: bool,
    ) -> Result<Vec<(Pass, PassTimer)>> {
        let buffers = frame.buffers;
        let mut timers = Vec::new();
        let shadow_key = buffers.shadow_key(frame.params);
        if let Some((rasterizer, enabled)) = buffers.active_rasterizer() {
            let raster_passes =
                RasterPasses { shadow: enabled.shadow && buffers.shadow_cache.is_stale(shadow_key), ..enabled };
            if raster_passes.has_any() {
                let draw = || passes::raster::draw(recorder, frame, rasterizer, raster_passes);
                match self.time_pass(raster_passes.stats_pass(), draw) {
                    Ok(timer) => timers.push(timer),
                    // OpenGL cannot draw on a lost device either.
                    Err(error @ Error::DeviceLost { .. }) => return Err(error),
                    // OpenGL then draws these passes, below.
                    Err(error) => rasterizer.disable(&error),
                }
            }
        }
        buffers.shadow_cache.draw_if_stale(shadow_key, || {
            timers.push(self.time_pass(Pass::Shadow, || passes::shadow::draw_depth(recorder, buffers))?);
            timers.push(self.time_pass(Pass::Blur, || passes::shadow::blur(recorder, buffers))?);
            Ok(())
        })?;
        let rasterizer = buffers.visibility_rasterizer();
        if buffers.cull_resources.is_some() && rasterizer.is_none() {
            timers.push(self.time_pass(Pass::Cull, || passes::cull::cull_for_camera(recorder, frame))?);
        }
        timers.push(self.time_pass(Pass::Visibility, || match rasterizer {
            Some(rasterizer) => passes::raster::unpack(recorder, frame, rasterizer),
            None => passes::visibility::draw(recorder, frame, draws_ground),
        })?);
        timers.push(self.time_pass(Pass::Blended, || passes::blended::draw(recorder, frame))?);
        timers.push(self.time_pass(Pass::Shade, || passes::shade::draw(recorder, frame))?);
        timers.push(self.time_pass(Pass::Bloom, || passes::post::bloom(recorder, frame))?);
        timers.push(self.time_pass(Pass::Encode, || passes::post::encode(recorder, frame))?);
        Ok(timers)
    }

    /// Times the passes that `commands` records, and reports the time under `pass`, which is one of these passes.
    fn time_pass(&self, pass: Pass, commands: impl FnOnce() -> Result<()>) -> Result<(Pass, PassTimer)> {
        let commands = || {
            #[cfg(test)]
            assert_ne!(self.injected_panic, Some(pass), "injected");
            commands()
        };
        self.gl.time_pass(pass.name(), self.frame_timeout, commands).map(|timer| (pass, timer))
    }

    /// Copies the pixels, then the fragment and culling counters, to the staging buffer of the slot. Does nothing
    /// without a slot.
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

/// Whether the ground must be rasterized. Otherwise the shading adds visible ground to samples without an id.
fn must_draw_ground(buffers: &SceneBuffers, params: &FrameParams) -> bool {
    let scene = &buffers.scene;
    // The bounds of a rebased scene (drawn with positions relative to one chosen origin) exclude distant domains, which
    // may be below the ground.
    let is_ground_behind_scene = buffers.rebased.is_none() && ground_is_behind_scene(scene, params, buffers.origin);
    scene.look.ground.is_some() && camera_is_above_ground(scene, params) && !is_ground_behind_scene
}

/// Region of the frame that may show triangles or rasterized ground.
fn draw_region(buffers: &SceneBuffers, params: &FrameParams, draws_ground: bool) -> Region {
    let size = [params.width, params.height];
    // The bounds of a rebased scene exclude distant domains, and the ground is larger than all bounds.
    if buffers.rebased.is_some() || draws_ground {
        return Region::whole(size);
    }
    Region::project(&clip_from_positions(&buffers.scene, params, buffers.origin), &params.bounds, size)
}

/// Warns if a frame drops blended fragments and the previous one did not.
fn warn_of_dropped_fragments(previous: &FrameStats, stats: &FrameStats) {
    let drops_fragments = |stats: &FrameStats| stats.oit.filter(|oit| oit.dropped() > 0);
    if let (Some(oit), None) = (drops_fragments(stats), drops_fragments(previous)) {
        let (dropped, kept) = (oit.dropped(), oit.stored);
        tracing::warn!(
            dropped,
            kept,
            "blended fragments are over the budget (look.fragments): the farthest are not drawn"
        );
    }
}
