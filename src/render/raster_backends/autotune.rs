//! Chooses the faster rasterizer for each pass by timing them on the scene itself.

use super::super::scene_buffers::SceneBuffers;
use super::super::{FrameImage, FrameParams, Renderer};
use crate::types::{RasterBackend, RasterBackends};
use modalcast_model::error::Result;

/// Frames per combination; the first one warms up, and the median of the others counts.
const TRIAL_FRAMES: usize = 6;

impl Renderer {
    /// Times all combinations of OpenGL and the compute rasterizer for shadow map and visibility, and keeps the
    /// fastest: the cost of one pass depends on who draws the other. Returns the choice, which is OpenGL without a
    /// compute rasterizer. A compute rasterizer that draws nothing is dropped.
    ///
    /// # Errors
    /// Those of drawing.
    pub fn select_raster_backends(&mut self, buffers: &mut SceneBuffers, shot: &FrameParams) -> Result<RasterBackends> {
        let Some(compute_rasterizer) = &buffers.compute_rasterizer else { return Ok(RasterBackends::default()) };
        let able = compute_rasterizer.enabled.get();
        let mut measured = Vec::new();
        for ways in [[false, false], [true, false], [false, true], [true, true]] {
            if ways.iter().zip(able).all(|(wanted, able)| able || !wanted) {
                compute_rasterizer.enabled.set(ways);
                let ms = self.median_ms(buffers, shot)?;
                // A combination that failed was given up, and the timing is that of OpenGL.
                if compute_rasterizer.enabled.get() == ways {
                    measured.push((ways, ms));
                }
            }
        }
        tracing::info!(?measured, "milliseconds a frame by who draws: shadow map, visibility beside OpenGL");
        let fastest = measured.into_iter().min_by(|one, other| one.1.total_cmp(&other.1));
        let ways = fastest.map_or([false; 2], |(ways, _)| ways);
        compute_rasterizer.enabled.set(ways);
        if ways == [false; 2] {
            buffers.compute_rasterizer = None;
        }
        let path = |compute_rasterizer: bool| {
            Some(if compute_rasterizer { RasterBackend::Cuda } else { RasterBackend::OpenGl })
        };
        Ok(RasterBackends { shadow: path(ways[0]), visibility: path(ways[1]) })
    }

    /// Median milliseconds of a frame including its shadow map, without readback.
    fn median_ms(&mut self, buffers: &SceneBuffers, shot: &FrameParams) -> Result<f64> {
        let mut times = Vec::new();
        for _ in 0..TRIAL_FRAMES {
            buffers.shadow_cache.invalidate();
            // Submitted unread, so that the trial does not compete for the staging buffers of frames in flight.
            let ticket = self.submit_without_readback(buffers, shot)?;
            times.push(of_frame(&self.read_image(ticket)?));
        }
        times.remove(0);
        times.sort_by(f64::total_cmp);
        Ok(times[times.len() / 2])
    }
}

fn of_frame(image: &FrameImage) -> f64 {
    let stages = image.passes.iter().filter(|(name, _)| ["shadow", "draw"].contains(name));
    stages.fold(0.0, |sum, (_, ms)| sum + ms)
}
