//! Passes of the compute rasterizer that are drawn into shared memory before their frame.

use super::Renderer;
use crate::passes::raster;
use crate::pieces::{OutputClass, OutputKind};
use crate::resources::compute_rasterizer::RasterPasses;
use crate::resources::scene_buffers::SceneBuffers;
use crate::resources::shared_targets::StepViews;
use crate::types::FrameParams;
use modalcast_model::error::Result;
use modalcast_model::shared_memory::SharedPositions;

impl Renderer {
    /// Draws the passes of the compute rasterizer for the next frame, which has the same parameters, from positions in
    /// shared memory. Waits for the compute rasterizer, but submits nothing to OpenGL, so that the device changes from
    /// OpenGL to CUDA only once for a deformation and this call. Also draws the frame of the next step that `ahead` returns,
    /// so that several frames need one change. Without this call, or after an error of shared memory, the frame itself draws
    /// these passes into mapped buffers.
    ///
    /// Does nothing if OpenGL draws all passes, or if the frame may take long and is therefore drawn in pieces.
    ///
    /// # Errors
    /// `Invalid` for a size above the limit or a camera whose matrices overflow; `DeviceLost`; errors of `ahead`.
    pub fn rasterize(
        &mut self,
        buffers: &SceneBuffers,
        params: &FrameParams,
        positions: SharedPositions,
        ahead: impl FnOnce() -> Result<Option<(FrameParams, SharedPositions)>>,
    ) -> Result<()> {
        let Some((rasterizer, enabled)) = buffers.active_rasterizer() else { return Ok(()) };
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
        let views = raster::views(buffers, params, passes)?;
        let ahead = || {
            // The shadow map of another step is always drawn.
            let Some((params, positions)) = ahead()? else { return Ok(None) };
            Ok(Some(StepViews { positions, views: raster::views(buffers, &params, enabled)? }))
        };
        rasterizer.draw_shared(&self.gl, StepViews { positions, views }, ahead, self.frame_timeout)
    }
}
