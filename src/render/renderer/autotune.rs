//! Chooses the faster rasterizer for each pass by timing them on the scene itself.

use super::Renderer;
use crate::resources::compute_rasterizer::RasterPasses;
use crate::resources::scene_buffers::SceneBuffers;
use crate::types::{FrameParams, RasterBackend, RasterBackends};
use modalcast_model::error::Result;

/// Frames per combination of rasterizers. The first frame warms up; the result is the median time of the others.
const TRIAL_FRAMES: usize = 6;

impl Renderer {
    /// Selects the fastest combination of OpenGL and the compute rasterizer for shadow map and visibility, and returns
    /// it. All combinations are timed, because the time of one pass depends on the rasterizer of the other. A compute
    /// rasterizer that draws no pass is dropped. Without a compute rasterizer, both fields of the result are none.
    ///
    /// # Errors
    /// Errors of drawing. The compute rasterizer then draws the same passes as before.
    pub fn select_raster_backends(
        &mut self,
        buffers: &mut SceneBuffers,
        params: &FrameParams,
    ) -> Result<RasterBackends> {
        let Some(rasterizer) = &buffers.compute_rasterizer else { return Ok(RasterBackends::default()) };
        let supported_passes = rasterizer.enabled();
        let result = self.find_fastest_passes(buffers, params, supported_passes);
        let Some(rasterizer) = &buffers.compute_rasterizer else { return Ok(RasterBackends::default()) };
        let fastest_passes = result.inspect_err(|_| rasterizer.enable(supported_passes))?;
        rasterizer.enable(fastest_passes);
        if !fastest_passes.has_any() {
            buffers.compute_rasterizer = None;
        }
        let backend = |is_compute: bool| Some(if is_compute { RasterBackend::Cuda } else { RasterBackend::OpenGl });
        Ok(RasterBackends { shadow: backend(fastest_passes.shadow), visibility: backend(fastest_passes.visibility) })
    }

    /// Times all subsets of the supported passes, and returns the fastest. Leaves the last subset enabled.
    fn find_fastest_passes(
        &mut self,
        buffers: &SceneBuffers,
        params: &FrameParams,
        supported_passes: RasterPasses,
    ) -> Result<RasterPasses> {
        let Some(rasterizer) = &buffers.compute_rasterizer else { return Ok(RasterPasses::NONE) };
        let mut timings = Vec::new();
        for (shadow, visibility) in [(false, false), (true, false), (false, true), (true, true)] {
            let combination = RasterPasses { shadow, visibility };
            if !combination.is_subset_of(supported_passes) {
                continue;
            }
            rasterizer.enable(combination);
            let ms = self.measure_median_ms(buffers, params)?;
            // An error disables the compute rasterizer. The time is then that of OpenGL, and does not count.
            if rasterizer.enabled() == combination {
                timings.push((combination, ms));
            }
        }
        tracing::info!(measured = ?timings, "milliseconds per frame by the passes of the compute rasterizer");
        let fastest = timings.into_iter().min_by(|(_, a_ms), (_, b_ms)| a_ms.total_cmp(b_ms));
        Ok(fastest.map_or(RasterPasses::NONE, |(combination, _)| combination))
    }

    /// Median time of a frame in milliseconds, including its shadow map, without readback.
    fn measure_median_ms(&mut self, buffers: &SceneBuffers, params: &FrameParams) -> Result<f64> {
        let mut times = Vec::new();
        for _ in 0..TRIAL_FRAMES {
            buffers.shadow_cache.invalidate();
            // Without readback, the trial needs no staging buffer, which frames in flight may occupy.
            let pending_frame = self.submit_without_readback(buffers, params)?;
            times.push(self.read_image(pending_frame)?.times.drawing_ms());
        }
        times.remove(0);
        times.sort_by(f64::total_cmp);
        Ok(times[times.len() / 2])
    }
}
