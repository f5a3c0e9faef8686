//! Asynchronous frames: [`Renderer::submit`] records the commands of a frame, [`Renderer::read_image`] waits for its
//! pixels and copies them. In between, the host can do other work or submit more frames.
//!
//! Uniforms, initial counter values and uploaded vertices are written with stream-ordered OpenGL commands, so frames in
//! flight keep their values.

use std::ops::Range;

use super::Renderer;
use super::partial_frame::Breaks;
use super::pending_frame::{MappedPixels, PendingFrame};
use crate::device::gl::ReadbackView;
use crate::layout;
use crate::pass::{FrameTimes, Pass, RenderStage};
use crate::resources::scene_buffers::SceneBuffers;
use crate::types::{FrameImage, FrameInfo, FrameParams, FrameStats, RasterBackend};
use modalcast_model::error::Result;
use modalcast_model::fault_injection::{self, InjectionPoint};

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
        fault_injection::check(InjectionPoint::Pixels)?;
        pending_frame.wait()?;
        let limit = pending_frame.time_left();
        let PendingFrame {
            desc,
            readback,
            fence,
            passes,
            upload_ms,
            raster_switch_ms,
            span,
            mut stats,
            info,
            class,
            costs,
            ..
        } = pending_frame;
        let mut view = readback.map_or(Ok(None), |readback| readback.into_view(&fence, limit))?;
        let png = view.as_mut().and_then(ReadbackView::take_png);
        if let Some(view) = &mut view {
            let [oit_range, cull_range] = desc.readback_ranges().map(|range| range.start as usize..range.end as usize);
            let counters_in = |range: Range<usize>| view.bytes().get(range).filter(|counters| !counters.is_empty());
            (stats.oit, stats.culled) = (
                counters_in(oit_range).map(layout::oit::parse_counters),
                counters_in(cull_range).map(layout::cull::parse_counters),
            );
            view.truncate(desc.frame_bytes() as usize);
        }
        // If the compute rasterizer drew the visibility, there are no camera counts. Then the shadow counts are
        // dropped, too.
        stats.culled = stats.culled.filter(|_| stats.raster_backends.visibility != Some(RasterBackend::Cuda));
        self.gl.check(Pass::Read.name())?;
        warn_of_dropped_fragments(&self.stats, &stats);
        if let Some(culled) = &stats.culled {
            tracing::trace!(?culled, "culled triangles");
        }
        let info = FrameInfo { raster_backends: stats.raster_backends, shares_samples: stats.shares_samples, ..info };
        self.stats = stats;
        let mut times: Vec<(Pass, f64)> = Vec::new();
        for (pass, timer) in &passes {
            // A pass that was submitted in bands has several timers.
            match times.iter_mut().find(|(timed_pass, _)| timed_pass == pass) {
                Some((_, ms)) => *ms += timer.ms(),
                None => times.push((*pass, timer.ms())),
            }
        }
        costs.record(class, times.iter().map(|(_, ms)| ms).sum());
        let mut times = FrameTimes::of_passes(&times);
        if let Some(span) = &span {
            let ms = raster_switch_ms + span.delay_ms(&mut self.last_end_ns);
            times.insert_first(RenderStage::Switch, ms);
        }
        if let Some(ms) = upload_ms {
            times.insert_first(RenderStage::Upload, ms);
        }
        Ok(MappedPixels { width: desc.width, height: desc.height, view, png, times, info })
    }

    fn submit_frame(
        &mut self,
        buffers: &SceneBuffers,
        params: &FrameParams,
        has_readback: bool,
    ) -> Result<PendingFrame> {
        let mut partial_frame = self.begin_frame_with(buffers, params, has_readback, Breaks::AfterBands)?;
        while !partial_frame.is_submitted() {
            self.submit_step(buffers, &mut partial_frame)?;
        }
        self.finish_frame(partial_frame)
    }
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
