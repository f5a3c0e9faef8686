//! Frames that are submitted in steps (draw steps, not steps of a simulation). Between two steps, the device can
//! execute commands of other scenes.
//!
//! A frame whose size exceeds the limit of [`Renderer::set_max_band_samples`] is divided into bands of rows: each band of
//! a pass is a step. A frame that may take long, as the first frames of a scene, is drawn in pieces
//! ([`crate::pieces`]): each band, and each range of triangles of a band or of a layer of the shadow map, is a step. A
//! pass ends with its last step before the next pass begins, so the inputs of a pass are complete, and the pixels do not
//! depend on the steps. All other frames are submitted without a break.
//!
//! The target of the frame is not in the cache until the frame is submitted, so other frames cannot use it. The buffers
//! of the scene must not change until then.

use std::cell::Cell;
use std::collections::VecDeque;
use std::rc::Rc;
use std::time::{Duration, Instant};

use super::frame_readback::{BandReadback, FrameReadback};
use super::frame_steps::{FramePlan, Step, record, visibility_rasterizer};
use super::pending_frame::PendingFrame;
use super::{LastFrame, MAX_TARGETS, Renderer};
use crate::device::gl::{Fence, PassTimer, Program, SpanTimer};
use crate::pass::Pass;
use crate::passes::{self, FrameContext, PassRecorder};
use crate::pieces::{OutputClass, OutputCosts, OutputKind, PieceCursor, PieceLoad, PieceRange};
use crate::region::Region;
use crate::resources::compute_rasterizer::RasterPasses;
use crate::resources::oit::blend_storage;
use crate::resources::programs::SampleCountPrograms;
use crate::resources::scene_buffers::SceneBuffers;
use crate::resources::target::RenderTarget;
use crate::resources::target_desc::TargetDesc;
use crate::types::{FrameInfo, FrameLook, FrameParams, FrameStats, RasterBackends};
use crate::uniforms::frame::{FrameUniforms, clip_from_positions, depth_below_ground};
use modalcast_model::error::{Result, fault};
use modalcast_model::fault_injection::{self, InjectionPoint};
use modalcast_model::scene::FrameAntialiasing;

/// A frame of which some steps are not submitted yet. Dropping it abandons the frame and frees its target.
#[derive(Debug)]
pub struct PartialFrame {
    params: FrameParams,
    uniforms: FrameUniforms,
    target: RenderTarget,
    programs: SampleCountPrograms,
    encode: Rc<Program>,
    /// None for a frame whose pixels are not read back.
    readback: Option<FrameReadback>,
    stats: FrameStats,
    info: FrameInfo,
    /// Submitted passes in execution order. A pass in bands has one entry for each band.
    timers: Vec<(Pass, PassTimer)>,
    /// Milliseconds of the upload of vertices before the frame; `None` if none were uploaded.
    upload_ms: Option<f64>,
    /// Milliseconds that the host waited for [`Renderer::rasterize`] beside its device time.
    raster_switch_ms: f64,
    /// When the device draws the frame; `None` for a software rasterizer, and before the first step.
    span: Option<SpanTimer>,
    /// Steps that are not submitted yet.
    steps: VecDeque<Step>,
    /// Items of the first of `steps` that are not submitted yet; none before its first piece.
    cursor: Option<PieceCursor>,
    class: OutputClass,
    /// Receives the time of the frame.
    costs: Rc<OutputCosts>,
    is_divided: bool,
    has_pieces: bool,
    is_begun: bool,
    /// Fence after the last submitted step of a frame in pieces.
    fence: Option<Fence>,
}

/// Where a frame has breaks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Breaks {
    /// After each band of a large frame.
    AfterBands,
    /// Also after each piece of a frame that may take long.
    AfterPieces,
}

/// How the compute rasterizer drew its passes.
#[derive(Debug)]
enum ComputeRaster {
    /// OpenGL draws all passes.
    Unused,
    /// Before the frame, into shared memory.
    Shared { timer: (Pass, PassTimer), switch_ms: f64 },
    /// A range of triangles, into mapped buffers.
    Drawn((Pass, PassTimer)),
}

impl ComputeRaster {
    /// [`PartialFrame::raster_switch_ms`].
    const fn switch_ms(&self) -> f64 {
        match self {
            Self::Shared { switch_ms, .. } => *switch_ms,
            Self::Unused | Self::Drawn(_) => 0.0,
        }
    }

    fn into_timer(self) -> Option<(Pass, PassTimer)> {
        match self {
            Self::Unused => None,
            Self::Shared { timer, .. } | Self::Drawn(timer) => Some(timer),
        }
    }
}

impl PartialFrame {
    /// Whether all steps are submitted.
    pub fn is_submitted(&self) -> bool {
        self.steps.is_empty()
    }

    /// Whether the frame is large and therefore divided into bands.
    pub const fn is_divided(&self) -> bool {
        self.is_divided
    }

    /// Whether commands of other scenes should be executed between the steps, because the frame may take long.
    pub const fn has_breaks(&self) -> bool {
        self.has_pieces
    }

    /// Milliseconds that the device took for the last submitted step. Waits for the step.
    pub fn last_step_ms(&self) -> f64 {
        self.timers.last().map_or(0.0, |(_, timer)| timer.ms())
    }

    /// Sets the milliseconds of the upload of vertices before the frame.
    pub const fn set_upload_ms(&mut self, ms: f64) {
        self.upload_ms = Some(ms);
    }

    /// Sets whether the camera frames the present state ([`FrameInfo::is_reframed`]).
    pub const fn set_reframed(&mut self, is_reframed: bool) {
        self.info.is_reframed = is_reframed;
    }

    /// How the frame is drawn, without the rasterizers, which are known when it is finished.
    pub const fn info(&self) -> &FrameInfo {
        &self.info
    }

    /// Waits at most `limit` for the last submitted step of a frame in pieces. Returns whether it is complete.
    /// Submitting the next step only then keeps the queue of the device short.
    pub fn is_ready_within(&self, limit: Duration) -> bool {
        self.fence.as_ref().is_none_or(|fence| fence.is_done_within(limit))
    }
}

#[cfg(test)]
impl PartialFrame {
    pub(super) fn remaining_step_count(&self) -> usize {
        self.steps.len()
    }

    pub(super) fn remove_step(&mut self, index: usize) {
        self.steps.remove(index);
    }
}

impl Renderer {
    /// Begins a frame of the current buffers. `has_readback`: whether its pixels are read back.
    ///
    /// # Errors
    /// `Busy` if too many frames are in flight; `Invalid` for a size above the limit or a camera whose matrices
    /// overflow; `Fault` if OpenGL reports an error.
    pub fn begin_frame(
        &mut self,
        buffers: &SceneBuffers,
        params: &FrameParams,
        has_readback: bool,
    ) -> Result<PartialFrame> {
        self.begin_frame_with(buffers, params, has_readback, Breaks::AfterPieces)
    }

    /// [`Self::begin_frame`] with a choice of breaks.
    pub(super) fn begin_frame_with(
        &mut self,
        buffers: &SceneBuffers,
        params: &FrameParams,
        has_readback: bool,
        breaks: Breaks,
    ) -> Result<PartialFrame> {
        let _current = self.gl.make_current()?;
        fault_injection::check(InjectionPoint::Frame)?;
        self.check_size(params)?;
        let uniforms = FrameUniforms::new(&buffers.scene, &buffers.look, params, buffers.origin)?;
        let size = [params.width, params.height];
        let antialiasing = buffers.antialiasing(size, params.samples);
        let blend_storage = blend_storage(&self.gl, &buffers.scene, size)?;
        let desc = TargetDesc::new(&self.gl, size, &buffers.look, antialiasing.samples, blend_storage);
        let desc = TargetDesc { culling: buffers.culling(), ambient_sampling: buffers.ambient_sampling(), ..desc };
        self.ensure_target(desc)?;
        let has_edges = params.edges.is_some();
        let compile = &mut |source| self.programs.program(source);
        let programs = buffers.sample_programs(desc.samples, has_edges, compile)?;
        if has_edges {
            buffers.ensure_inner_edges(&self.gl)?;
        }
        let encode = buffers.encode_program(antialiasing.method, &mut |source| self.programs.program(source))?;
        let Some(target) = self.targets.last() else { return Err(fault("draw", "expected a render target, got none")) };
        let is_divided = self.exceeds_band_limit(size, desc.samples);
        let readback = match (has_readback, is_divided) {
            (false, _) => None,
            (true, false) => Some(FrameReadback::Whole(target.readback_ring.acquire(self.frame_timeout)?)),
            (true, true) => {
                let slot = self.band_ring.acquire(self.frame_timeout)?;
                Some(FrameReadback::Bands(BandReadback::new(slot, desc)))
            }
        };
        // If a pass fails or panics, the images of the target are undefined. Therefore the target is not in the cache
        // until all passes are recorded.
        self.last_frame = None;
        let Some(target) = self.targets.pop() else { return Err(fault("draw", "expected a render target, got none")) };
        target.draw_region.set(draw_region(buffers, params));
        let draws_shadow = buffers.shadow.is_some() && buffers.shadow_cache.is_stale(buffers.shadow_key(params));
        let class = OutputClass::new(OutputKind::Frame { draws_shadow }, size, desc.samples);
        let may_take_long = buffers.costs.has_pieces(class, self.output_limits.pieces);
        let has_pieces = is_divided || breaks == Breaks::AfterPieces && may_take_long;
        let max_pixels = self.output_limits.bands.max_pixels(desc.samples);
        let planned = FramePlan { target: &target, has_readback: readback.is_some(), max_pixels, has_pieces };
        let shadow = buffers.shadow.as_ref().filter(|_| draws_shadow);
        let steps = planned.steps(shadow);
        Ok(PartialFrame {
            params: *params,
            uniforms,
            programs,
            encode,
            readback,
            stats: FrameStats { samples: desc.samples, ..FrameStats::default() },
            info: frame_info(buffers, params, FrameAntialiasing { samples: desc.samples, ..antialiasing }),
            timers: Vec::new(),
            upload_ms: None,
            raster_switch_ms: 0.0,
            span: None,
            is_divided,
            has_pieces,
            class,
            costs: Rc::clone(&buffers.costs),
            cursor: None,
            steps,
            is_begun: false,
            fence: None,
            target,
        })
    }

    /// Submits the next step of a frame. On hardware, submits all steps of a frame that is not drawn in pieces.
    ///
    /// # Errors
    /// `Fault` with the pass if OpenGL reports an error. The frame must then be dropped.
    pub fn submit_step(&mut self, buffers: &SceneBuffers, partial_frame: &mut PartialFrame) -> Result<()> {
        let _current = self.gl.make_current()?;
        let PartialFrame {
            params,
            uniforms,
            target,
            programs,
            encode,
            readback,
            stats,
            timers,
            steps,
            cursor,
            raster_switch_ms,
            ..
        } = partial_frame;
        if let Some(readback) = readback {
            readback.collect(partial_frame.fence.as_ref(), self.frame_timeout)?;
        }
        let mut recorder = PassRecorder { gl: &self.gl, stats };
        if std::mem::replace(&mut partial_frame.is_begun, true) {
            // Commands of other scenes may have changed the bindings.
            passes::uniforms::bind(buffers);
        } else {
            partial_frame.span = self.gl.begin_span()?;
            passes::uniforms::upload(&recorder, buffers, params, uniforms);
        }
        let readback = readback.as_ref();
        let picture = readback.and_then(FrameReadback::picture);
        let has_pieces = partial_frame.has_pieces;
        let frame = FrameContext { buffers, target, programs, encode, params, has_pieces, picture };
        while let Some(step) = steps.front() {
            let range = match step.load(&frame).filter(|_| has_pieces) {
                Some(load) => self.next_piece(cursor, load, timers),
                None => PieceRange::ALL,
            };
            let mut is_finished = cursor.as_ref().is_none_or(PieceCursor::is_finished);
            match step {
                Step::ComputeRaster => {
                    let raster = self.record_compute_raster(&mut recorder, &frame, range)?;
                    is_finished |= !matches!(raster, ComputeRaster::Drawn(_));
                    *raster_switch_ms = raster.switch_ms();
                    timers.extend(raster.into_timer());
                }
                Step::Passes(pass, band_passes) => timers.push(self.time_pass(*pass, || {
                    let mut band_passes = band_passes.iter();
                    band_passes.try_for_each(|band_pass| record(&mut recorder, &frame, readback, *band_pass, range))
                })?),
            }
            if is_finished {
                *cursor = None;
                steps.pop_front();
            }
            if has_pieces || self.gl.limits.software {
                break;
            }
        }
        if has_pieces {
            partial_frame.fence = Some(self.gl.fence("draw")?);
        }
        if partial_frame.is_submitted() {
            buffers.compute_rasterizer.as_ref().map_or(Ok(()), |rasterizer| rasterizer.release_shared(&self.gl))?;
        }
        Ok(())
    }

    /// Returns a frame whose steps are all submitted. Its target returns to the cache.
    ///
    /// # Errors
    /// `Fault` if steps are missing or OpenGL fails.
    pub fn finish_frame(&mut self, partial_frame: PartialFrame) -> Result<PendingFrame> {
        if !partial_frame.is_submitted() {
            return Err(fault("draw", "expected a frame whose steps are all submitted"));
        }
        let _current = self.gl.make_current()?;
        let PartialFrame {
            uniforms,
            mut target,
            readback,
            timers,
            upload_ms,
            raster_switch_ms,
            mut span,
            stats,
            info,
            class,
            costs,
            ..
        } = partial_frame;
        span.as_mut().map_or(Ok(()), |span| span.end(&self.gl))?;
        let desc = target.desc;
        target.last_use = Instant::now();
        // A frame with an equal description may have been drawn between the steps of this one.
        self.targets.retain(|cached_target| cached_target.desc != desc);
        if self.targets.len() >= MAX_TARGETS {
            self.targets.remove(0);
        }
        self.targets.push(target);
        self.last_frame = Some(LastFrame { desc, uniforms });
        Ok(PendingFrame {
            desc,
            readback,
            fence: self.gl.fence(Pass::Read.name())?,
            passes: timers,
            upload_ms,
            raster_switch_ms,
            span,
            stats,
            info,
            class,
            costs,
            timeout: self.frame_timeout,
            first_wait: Cell::new(None),
        })
    }

    /// The items of the next piece of a step.
    fn next_piece(
        &self,
        cursor: &mut Option<PieceCursor>,
        load: PieceLoad,
        timers: &[(Pass, PassTimer)],
    ) -> PieceRange {
        match cursor {
            Some(cursor) => {
                // The device has finished the previous piece, so this does not wait.
                cursor.record_ms(timers.last().map_or(0.0, |(_, timer)| timer.ms()));
                cursor.next_piece()
            }
            None => cursor.insert(PieceCursor::new(self.output_limits.pieces, load)).next_piece(),
        }
    }

    /// Draws triangles of a range in the passes of the compute rasterizer, unless [`Renderer::rasterize`] has drawn them.
    /// If it fails, OpenGL draws these passes in later steps.
    fn record_compute_raster(
        &self,
        recorder: &mut PassRecorder<'_>,
        frame: &FrameContext<'_>,
        range: PieceRange,
    ) -> Result<ComputeRaster> {
        let buffers = frame.buffers;
        let Some((rasterizer, enabled)) = buffers.active_rasterizer() else { return Ok(ComputeRaster::Unused) };
        let is_shadow_stale = buffers.shadow_cache.is_stale(buffers.shadow_key(frame.params));
        let raster_passes = RasterPasses {
            shadow: enabled.shadow && is_shadow_stale,
            visibility: visibility_rasterizer(frame).is_some(),
        };
        if !raster_passes.has_any() {
            return Ok(ComputeRaster::Unused);
        }
        let views = passes::raster::views(buffers, frame.params, raster_passes)?;
        if let Some(time) = rasterizer.shared_time(&self.gl, &views)? {
            passes::raster::use_shared(recorder, raster_passes);
            let timer = (raster_passes.stats_pass(), PassTimer::Wall(time.device_ms));
            return Ok(ComputeRaster::Shared { timer, switch_ms: time.switch_ms });
        }
        let draw = || passes::raster::draw(recorder, rasterizer, raster_passes, &views, range);
        match self.time_pass(raster_passes.stats_pass(), draw) {
            Ok(timer) => Ok(ComputeRaster::Drawn(timer)),
            // OpenGL cannot draw on a lost device either.
            Err(error) if error.is_loss() => Err(error),
            Err(error) => {
                rasterizer.disable(&error);
                Ok(ComputeRaster::Unused)
            }
        }
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
}

/// How a frame is drawn, without the rasterizers, which are known when it is finished.
fn frame_info(buffers: &SceneBuffers, params: &FrameParams, antialiasing: FrameAntialiasing) -> FrameInfo {
    let FrameAntialiasing { method: antialias, samples } = antialiasing;
    let preset = buffers.look.preset.and_then(|request| request.preset);
    FrameInfo {
        raster_backends: RasterBackends::default(),
        shares_samples: false,
        look: Some(FrameLook { preset, antialias, samples, shadow: buffers.look.shadow }),
        below_ground: depth_below_ground(&buffers.scene, params, buffers.origin),
        is_reframed: false,
    }
}

/// Region of the frame that may show triangles.
fn draw_region(buffers: &SceneBuffers, params: &FrameParams) -> Region {
    let size = [params.width, params.height];
    // A rebased scene is drawn with positions relative to one chosen origin. Its bounds exclude distant domains.
    if buffers.rebased.is_some() {
        return Region::whole(size);
    }
    Region::project(&clip_from_positions(&buffers.scene, params, buffers.origin), &params.bounds, size)
}
