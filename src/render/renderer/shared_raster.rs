//! Passes of the compute rasterizer that are drawn into shared memory before their frame.

use super::Renderer;
use crate::passes::raster;
use crate::pieces::{OutputClass, OutputKind};
use crate::resources::compute_rasterizer::RasterPasses;
use crate::resources::scene_buffers::SceneBuffers;
use crate::resources::shared_targets::StepViews;
use crate::types::SharedFrame;
use modalcast_model::error::Result;

impl Renderer {
    /// Draws the passes of the compute rasterizer for the next frame, which has the same parameters, from positions in
    /// shared memory. Waits for the compute rasterizer, but submits nothing to OpenGL, so that the device changes from
    /// OpenGL to CUDA only once for a deformation and this call. The first of `frames` is the next one. The others show
    /// later steps, whose passes are also drawn if memory is free, so that several frames need one change. Without this call,
    /// or after an error of shared memory, the frame itself draws these passes into mapped buffers.
    ///
    /// Does nothing if OpenGL draws all passes, or if the frame may take long and is therefore drawn in pieces.
    ///
    /// # Errors
    /// `Invalid` for a size above the limit or a camera whose matrices overflow; `DeviceLost`.
    pub fn rasterize(&mut self, buffers: &SceneBuffers, frames: Vec<SharedFrame>) -> Result<()> {
        let Some((rasterizer, enabled)) = buffers.active_rasterizer() else { return Ok(()) };
        let Some(SharedFrame { params, .. }) = frames.first() else { return Ok(()) };
        let _current = self.gl.make_current()?;
        self.check_size(params)?;
        let samples = buffers.antialiasing([params.width, params.height], params.samples).samples;
        let enabled = RasterPasses { visibility: enabled.visibility && samples == 1, ..enabled };
        let is_shadow_stale = buffers.shadow_cache.is_stale(buffers.shadow_key(params));
        let passes = RasterPasses { shadow: enabled.shadow && is_shadow_stale, ..enabled };
        let draws_shadow = buffers.shadow.is_some() && is_shadow_stale;
        let class = OutputClass::new(OutputKind::Frame { draws_shadow }, [params.width, params.height], samples);
        if !passes.has_any() || buffers.costs.has_pieces(class, self.output_limits.pieces) {
            return Ok(());
        }
        // The shadow map of a later step is always drawn.
        let passes_of_frames = std::iter::once(passes).chain(std::iter::repeat(enabled));
        let steps: Result<_> = (frames.into_iter().zip(passes_of_frames))
            .map(|(SharedFrame { params, positions }, passes)| {
                Ok(StepViews { positions, views: raster::views(buffers, &params, passes)? })
            })
            .collect();
        rasterizer.draw_shared(&self.gl, steps?, self.frame_timeout)
    }
}
