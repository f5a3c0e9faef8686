//! Chooses the faster rasterizer for each pass by timing them on the scene itself.

use super::Renderer;
use crate::resources::compute_rasterizer::RasterPasses;
use crate::resources::scene_buffers::SceneBuffers;
use crate::types::{FrameParams, RasterBackend, RasterBackends};
use modalcast_model::error::Result;

/// Frames per combination; the first one warms up, and the median of the others counts.
const TRIAL_FRAMES: usize = 6;

impl Renderer {
    /// Times all combinations of OpenGL and the compute rasterizer for shadow map and visibility, and keeps the
    /// fastest: the cost of one pass depends on who draws the other. Returns the choice, which is OpenGL without a
    /// compute rasterizer. A compute rasterizer that draws nothing is dropped.
    ///
    /// # Errors
    /// Those of drawing. The compute rasterizer then draws the passes that it drew before.
    pub fn select_raster_backends(&mut self, buffers: &mut SceneBuffers, shot: &FrameParams) -> Result<RasterBackends> {
        let Some(rasterizer) = &buffers.compute_rasterizer else { return Ok(RasterBackends::default()) };
        let able = rasterizer.enabled();
        let fastest = self.fastest_combination(buffers, shot, able);
        let Some(rasterizer) = &buffers.compute_rasterizer else { return Ok(RasterBackends::default()) };
        let chosen = fastest.inspect_err(|_| rasterizer.enable(able))?;
        rasterizer.enable(chosen);
        if !chosen.any() {
            buffers.compute_rasterizer = None;
        }
        let backend = |is_compute: bool| Some(if is_compute { RasterBackend::Cuda } else { RasterBackend::OpenGl });
        Ok(RasterBackends { shadow: backend(chosen.shadow), visibility: backend(chosen.visibility) })
    }

    /// The fastest combination of passes for the compute rasterizer, among those that it is able to draw. Leaves the
    /// last combination enabled.
    fn fastest_combination(
        &mut self,
        buffers: &SceneBuffers,
        shot: &FrameParams,
        able: RasterPasses,
    ) -> Result<RasterPasses> {
        let Some(rasterizer) = &buffers.compute_rasterizer else { return Ok(RasterPasses::NONE) };
        let mut measured = Vec::new();
        for (shadow, visibility) in [(false, false), (true, false), (false, true), (true, true)] {
            let combination = RasterPasses { shadow, visibility };
            if !combination.is_subset_of(able) {
                continue;
            }
            rasterizer.enable(combination);
            let ms = self.median_ms(buffers, shot)?;
            // A combination that failed was disabled, and the timing is that of OpenGL.
            if rasterizer.enabled() == combination {
                measured.push((combination, ms));
            }
        }
        tracing::info!(?measured, "milliseconds per frame by the passes of the compute rasterizer");
        let fastest = measured.into_iter().min_by(|one, other| one.1.total_cmp(&other.1));
        Ok(fastest.map_or(RasterPasses::NONE, |(combination, _)| combination))
    }

    /// Median milliseconds of a frame including its shadow map, without readback.
    fn median_ms(&mut self, buffers: &SceneBuffers, shot: &FrameParams) -> Result<f64> {
        let mut times = Vec::new();
        for _ in 0..TRIAL_FRAMES {
            buffers.shadow_cache.invalidate();
            // Submitted unread, so that the trial does not compete for the staging buffers of frames in flight.
            let ticket = self.submit_without_readback(buffers, shot)?;
            times.push(self.read_image(ticket)?.times.drawing_ms());
        }
        times.remove(0);
        times.sort_by(f64::total_cmp);
        Ok(times[times.len() / 2])
    }
}
