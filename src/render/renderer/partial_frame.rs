//! Frames that are submitted in steps (draw steps, not steps of a simulation). Between two steps, the device can
//! execute commands of other scenes.
//!
//! A frame within the limit of [`Renderer::set_max_band_samples`] has one step for each pass, and is meant to be
//! submitted without a break. The first frame of a scene is an exception: drivers finish the compilation of a program
//! when it is used for the first time. A larger frame is divided into bands of rows. Its steps are the passes that work
//! on the complete frame, and each band of the other passes. A pass ends with its last band before the next pass
//! begins, so the inputs of a pass are complete, and the pixels do not depend on the bands.
//!
//! The target of the frame is not in the cache until the frame is submitted, so other frames cannot use it. The buffers
//! of the scene must not change until then.

use std::cell::Cell;
use std::collections::VecDeque;
use std::rc::Rc;
use std::time::{Duration, Instant};

use super::frame_readback::{BandReadback, FrameReadback, MAX_BAND_PIXELS};
use super::pending_frame::PendingFrame;
use super::{LastFrame, MAX_TARGETS, Renderer};
use crate::device::gl::{Fence, PassTimer, Program, SpanTimer};
use crate::pass::Pass;
use crate::passes::post::BloomStep;
use crate::passes::{self, FrameContext, OitFrame, PassRecorder};
use crate::region::{Band, Region};
use crate::resources::compute_rasterizer::{ComputeRasterizer, RasterPasses};
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
    /// Milliseconds that the host waited for [`Renderer::rasterize`] beside its device time.
    raster_switch_ms: f64,
    /// When the device draws the frame; `None` for a software rasterizer, and before the first step.
    span: Option<SpanTimer>,
    /// Steps that are not submitted yet.
    steps: VecDeque<Step>,
    is_divided: bool,
    has_breaks: bool,
    is_begun: bool,
    /// Fence after the last submitted step of a frame with breaks.
    fence: Option<Fence>,
}

/// Commands that are submitted without a break.
#[derive(Debug)]
enum Step {
    /// The passes of the compute rasterizer, if there is one.
    ComputeRaster,
    /// Shadow map and its blur, unless the map of an earlier frame is valid.
    Shadow,
    /// Culling for the camera, if OpenGL draws the visibility.
    Cull,
    /// Passes that are timed together under one name.
    Passes(Pass, Vec<BandPass>),
}

/// A pass, or a part of it.
#[derive(Debug, Clone, Copy)]
enum BandPass {
    Visibility(Band),
    RecordVisible,
    Blended(Band),
    OitCount(Band),
    OitSumCounts,
    OitBlend(Band),
    Shade(Band),
    Bloom(BloomStep, Band),
    Encode(Band),
    Read(Band),
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

    /// Whether commands of other scenes should be executed between the steps, because the frame is large or the first
    /// one of its scene.
    pub const fn has_breaks(&self) -> bool {
        self.has_breaks
    }

    /// How the frame is drawn, without the rasterizers, which are known when it is finished.
    pub const fn info(&self) -> &FrameInfo {
        &self.info
    }

    /// Waits at most `limit` for the last submitted step of a frame with breaks. Returns whether it is complete.
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
        let _current = self.gl.make_current()?;
        fault_injection::check(InjectionPoint::Frame)?;
        self.check_size(params)?;
        let uniforms = FrameUniforms::new(&buffers.scene, &buffers.look, params, buffers.origin)?;
        let size = [params.width, params.height];
        let antialiasing = buffers.antialiasing(size, params.samples);
        let blend_storage = blend_storage(&self.gl, &buffers.scene, size)?;
        let desc = TargetDesc::new(&self.gl, size, &buffers.look, antialiasing.samples, blend_storage);
        let desc = TargetDesc { culling: buffers.culling(), ..desc };
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
        let steps = plan_steps(&target, readback.is_some(), self.band_limit.max_pixels(desc.samples));
        Ok(PartialFrame {
            params: *params,
            uniforms,
            programs,
            encode,
            readback,
            stats: FrameStats { samples: desc.samples, ..FrameStats::default() },
            info: frame_info(buffers, params, FrameAntialiasing { samples: desc.samples, ..antialiasing }),
            timers: Vec::new(),
            raster_switch_ms: 0.0,
            span: None,
            is_divided,
            has_breaks: is_divided || !buffers.is_drawn_with(desc.samples),
            steps,
            is_begun: false,
            fence: None,
            target,
        })
    }

    /// Submits the next step of a frame. On hardware, submits all steps of a frame without breaks.
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
        let frame = FrameContext { buffers, target, programs, encode, params, picture };
        let has_breaks = partial_frame.has_breaks;
        while let Some(step) = steps.pop_front() {
            match step {
                Step::ComputeRaster => {
                    timers.extend(self.record_compute_raster(&mut recorder, &frame, raster_switch_ms)?);
                }
                Step::Shadow => self.record_shadow(&mut recorder, &frame, timers)?,
                Step::Cull if buffers.cull_resources.is_some() && visibility_rasterizer(&frame).is_none() => {
                    timers.push(self.time_pass(Pass::Cull, || passes::cull::cull_for_camera(&mut recorder, &frame))?);
                }
                Step::Cull => {}
                Step::Passes(pass, band_passes) => timers.push(self.time_pass(pass, || {
                    let mut band_passes = band_passes.into_iter();
                    band_passes.try_for_each(|band_pass| record(&mut recorder, &frame, readback, band_pass))
                })?),
            }
            if has_breaks || self.gl.limits.software {
                break;
            }
        }
        if has_breaks {
            partial_frame.fence = Some(self.gl.fence("draw")?);
        }
        if partial_frame.is_submitted() {
            buffers.mark_drawn_with(partial_frame.target.desc.samples);
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
        let PartialFrame { uniforms, mut target, readback, timers, raster_switch_ms, mut span, stats, info, .. } =
            partial_frame;
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
            raster_switch_ms,
            span,
            stats,
            info,
            timeout: self.frame_timeout,
            first_wait: Cell::new(None),
        })
    }

    /// Draws the passes of the compute rasterizer, unless [`Renderer::rasterize`] has drawn them. Returns no timer if
    /// there is none or it fails; OpenGL then draws these passes in later steps.
    fn record_compute_raster(
        &self,
        recorder: &mut PassRecorder<'_>,
        frame: &FrameContext<'_>,
        raster_switch_ms: &mut f64,
    ) -> Result<Option<(Pass, PassTimer)>> {
        let buffers = frame.buffers;
        let Some((rasterizer, enabled)) = buffers.active_rasterizer() else { return Ok(None) };
        let is_shadow_stale = buffers.shadow_cache.is_stale(buffers.shadow_key(frame.params));
        let raster_passes = RasterPasses {
            shadow: enabled.shadow && is_shadow_stale,
            visibility: visibility_rasterizer(frame).is_some(),
        };
        if !raster_passes.has_any() {
            return Ok(None);
        }
        let views = passes::raster::views(buffers, frame.params, raster_passes)?;
        if let Some(time) = rasterizer.shared_time(&self.gl, &views)? {
            passes::raster::use_shared(recorder, raster_passes);
            *raster_switch_ms = time.switch_ms;
            return Ok(Some((raster_passes.stats_pass(), PassTimer::Wall(time.device_ms))));
        }
        let draw = || passes::raster::draw(recorder, rasterizer, raster_passes, &views);
        match self.time_pass(raster_passes.stats_pass(), draw) {
            Ok(timer) => Ok(Some(timer)),
            // OpenGL cannot draw on a lost device either.
            Err(error) if error.is_loss() => Err(error),
            Err(error) => {
                rasterizer.disable(&error);
                Ok(None)
            }
        }
    }

    /// Draws and blurs the shadow map unless the map of an earlier frame is valid.
    fn record_shadow(
        &self,
        recorder: &mut PassRecorder<'_>,
        frame: &FrameContext<'_>,
        timers: &mut Vec<(Pass, PassTimer)>,
    ) -> Result<()> {
        let buffers = frame.buffers;
        let draw = || {
            timers.push(self.time_pass(Pass::Shadow, || passes::shadow::draw_depth(recorder, buffers))?);
            timers.push(self.time_pass(Pass::Blur, || passes::shadow::blur(recorder, buffers))?);
            Ok(())
        };
        buffers.shadow_cache.draw_if_stale(buffers.shadow_key(frame.params), draw).map(drop)
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

/// The compute rasterizer if it draws the visibility of a frame. It draws one sample per pixel, but a frame can set
/// another number than its scene.
fn visibility_rasterizer<'a>(frame: &FrameContext<'a>) -> Option<&'a ComputeRasterizer> {
    frame.buffers.visibility_rasterizer().filter(|_| frame.target.desc.samples == 1)
}

/// Records a pass, or a band of it.
fn record(
    recorder: &mut PassRecorder<'_>,
    frame: &FrameContext<'_>,
    readback: Option<&FrameReadback>,
    band_pass: BandPass,
) -> Result<()> {
    let rasterizer = visibility_rasterizer(frame);
    match (band_pass, OitFrame::of(frame)) {
        (BandPass::Visibility(band), _) => match rasterizer {
            // This pass only converts the output of the compute rasterizer, so the first band converts all rows.
            Some(rasterizer) if band.first_row == 0 => passes::raster::unpack(recorder, frame, rasterizer),
            Some(_) => Ok(()),
            None => passes::visibility::draw(recorder, frame, band),
        },
        (BandPass::RecordVisible, _) if rasterizer.is_none() => passes::cull::record_visible(recorder, frame),
        (BandPass::Blended(band), _) => passes::blended::draw(recorder, frame, band),
        (BandPass::OitCount(band), Some(oit)) => oit.count(recorder, band),
        (BandPass::OitSumCounts, Some(oit)) => oit.sum_counts(recorder),
        (BandPass::OitBlend(band), Some(oit)) => oit.blend(recorder, band),
        (BandPass::Shade(band), _) => passes::shade::draw(recorder, frame, band),
        (BandPass::Bloom(step, band), _) => passes::post::bloom(recorder, frame, step, band),
        (BandPass::Encode(band), _) => passes::post::encode(recorder, frame, band),
        (BandPass::Read(band), _) => {
            let staging = readback.and_then(|readback| readback.buffer(frame.target.desc, band));
            passes::readback::copy_frame(recorder, frame, staging, band)
        }
        // Passes that OpenGL or a frame without fragment lists does not have.
        (BandPass::RecordVisible | BandPass::OitCount(_), _) | (BandPass::OitSumCounts | BandPass::OitBlend(_), _) => {
            Ok(())
        }
    }
}

/// The steps of a frame. Bands have at most `max_pixels` pixels.
fn plan_steps(target: &RenderTarget, has_readback: bool, max_pixels: u64) -> VecDeque<Step> {
    let TargetDesc { width, height, .. } = target.desc;
    let bands = Band::divide([width, height], max_pixels);
    let of_bands = |pass: fn(Band) -> BandPass| bands.iter().copied().map(pass);
    let mut visibility: Vec<BandPass> = of_bands(BandPass::Visibility).collect();
    visibility.push(BandPass::RecordVisible);
    let blended = match (&target.blend_layer, &target.oit) {
        (_, Some(_)) => {
            of_bands(BandPass::OitCount).chain([BandPass::OitSumCounts]).chain(of_bands(BandPass::OitBlend)).collect()
        }
        (Some(_), None) => of_bands(BandPass::Blended).collect(),
        (None, None) => Vec::new(),
    };
    let bloom = passes::post::bloom_steps(target).flat_map(|(step, image)| {
        let bands = Band::divide([image.desc.width, image.desc.height], max_pixels);
        bands.into_iter().map(move |band| BandPass::Bloom(step, band))
    });
    let mut groups = vec![
        (Pass::Visibility, visibility),
        (Pass::Blended, blended),
        (Pass::Shade, of_bands(BandPass::Shade).collect()),
        (Pass::Bloom, bloom.collect()),
        (Pass::Encode, of_bands(BandPass::Encode).collect()),
    ];
    if has_readback && bands.len() > 1 {
        let bands = Band::divide([width, height], max_pixels.min(MAX_BAND_PIXELS));
        groups.push((Pass::Read, bands.into_iter().map(BandPass::Read).collect()));
    } else if has_readback {
        groups.push((Pass::Read, of_bands(BandPass::Read).collect()));
    }
    let mut steps = VecDeque::from([Step::ComputeRaster, Step::Shadow, Step::Cull]);
    for (pass, band_passes) in groups {
        if bands.len() > 1 {
            steps.extend(band_passes.into_iter().map(|band_pass| Step::Passes(pass, vec![band_pass])));
        } else {
            steps.push_back(Step::Passes(pass, band_passes));
        }
    }
    steps
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
