//! Chooses the faster rasterizer for each pass by timing them on the scene itself.

use std::collections::VecDeque;
use std::time::Instant;

use super::{PendingFrame, Renderer};
use crate::resources::compute_rasterizer::{ComputeRasterizer, RasterPasses};
use crate::resources::scene_buffers::SceneBuffers;
use crate::types::{RasterBackend, RasterBackends};
use modalcast_model::error::Result;

/// Frames of a trial whose time does not count: they compile programs, allocate memory and fill the queue of the
/// device.
const WARM_UP_FRAMES: usize = 3;
/// Frames of a trial whose time counts.
const TIMED_FRAMES: usize = 8;
/// Frames that the device draws while the host submits the next one.
const FRAMES_IN_FLIGHT: usize = 2;
/// Trials of a combination of rasterizers. The fastest one counts, because other work can only delay a trial.
const TRIALS: usize = 2;

/// A scene whose frames are drawn to compare rasterizers.
pub trait TrialScene {
    /// The buffers of the scene.
    ///
    /// # Errors
    /// `Fault` without buffers.
    fn buffers_mut(&mut self) -> Result<&mut SceneBuffers>;

    /// Submits a frame without readback, of a new step and in the way in which frames of the scene are drawn later.
    ///
    /// # Errors
    /// Errors of deforming and drawing.
    fn submit(&mut self, renderer: &mut Renderer) -> Result<PendingFrame>;

    /// The time, by which frames are compared.
    fn now(&self) -> Instant {
        Instant::now()
    }
}

impl Renderer {
    /// Selects the fastest combination of OpenGL and the compute rasterizer for shadow map and visibility, and returns
    /// it. All combinations are timed with steps and frames in flight, because the time of one pass depends on the
    /// rasterizer of the other, and a change between CUDA and OpenGL can cost more than a pass. A compute rasterizer
    /// that draws no pass is dropped. Without a compute rasterizer, both fields of the result are none.
    ///
    /// # Errors
    /// Errors of the scene. The compute rasterizer then draws the same passes as before.
    pub fn select_raster_backends(&mut self, scene: &mut dyn TrialScene) -> Result<RasterBackends> {
        let Some(rasterizer) = &scene.buffers_mut()?.compute_rasterizer else { return Ok(RasterBackends::default()) };
        let supported_passes = rasterizer.enabled();
        let result = self.find_fastest_passes(scene, supported_passes);
        let buffers = scene.buffers_mut()?;
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
        scene: &mut dyn TrialScene,
        supported_passes: RasterPasses,
    ) -> Result<RasterPasses> {
        let all = [(false, false), (true, false), (false, true), (true, true)];
        let combinations = all.map(|(shadow, visibility)| RasterPasses { shadow, visibility });
        let mut timings: Vec<(RasterPasses, f64)> = Vec::new();
        for _ in 0..TRIALS {
            for combination in combinations.into_iter().filter(|passes| passes.is_subset_of(supported_passes)) {
                enable(scene, combination)?;
                let ms = self.measure_frame_ms(scene)?;
                // An error disables the compute rasterizer. The time is then that of OpenGL, and does not count.
                if enabled(scene)? != combination {
                    continue;
                }
                match timings.iter_mut().find(|(timed, _)| *timed == combination) {
                    Some((_, fastest_ms)) => *fastest_ms = fastest_ms.min(ms),
                    None => timings.push((combination, ms)),
                }
            }
        }
        tracing::info!(measured = ?timings, "milliseconds per frame by the passes of the compute rasterizer");
        let fastest = timings.into_iter().min_by(|(_, a_ms), (_, b_ms)| a_ms.total_cmp(b_ms));
        Ok(fastest.map_or(RasterPasses::NONE, |(combination, _)| combination))
    }

    /// Mean wall time of a frame in milliseconds, with its step and its shadow map, without readback.
    fn measure_frame_ms(&mut self, scene: &mut dyn TrialScene) -> Result<f64> {
        let (mut in_flight, mut ends) = (VecDeque::new(), Vec::new());
        for _ in 0..WARM_UP_FRAMES + TIMED_FRAMES {
            scene.buffers_mut()?.shadow_cache.invalidate();
            in_flight.push_back(scene.submit(self)?);
            if in_flight.len() > FRAMES_IN_FLIGHT
                && let Some(frame) = in_flight.pop_front()
            {
                self.read_image(frame)?;
                ends.push(scene.now());
            }
        }
        for frame in in_flight {
            self.read_image(frame)?;
            ends.push(scene.now());
        }
        let timed = &ends[WARM_UP_FRAMES - 1..];
        Ok((timed[TIMED_FRAMES] - timed[0]).as_secs_f64() * 1e3 / TIMED_FRAMES as f64)
    }
}

/// The passes that the compute rasterizer of a scene draws.
fn enabled(scene: &mut dyn TrialScene) -> Result<RasterPasses> {
    Ok(scene.buffers_mut()?.compute_rasterizer.as_ref().map_or(RasterPasses::NONE, ComputeRasterizer::enabled))
}

/// Selects the passes that the compute rasterizer of a scene draws.
fn enable(scene: &mut dyn TrialScene, passes: RasterPasses) -> Result<()> {
    let buffers = scene.buffers_mut()?;
    buffers.compute_rasterizer.iter().for_each(|rasterizer| rasterizer.enable(passes));
    Ok(())
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;
    use crate::renderer::tests::{load_renderer, params};
    use crate::types::FrameParams;
    use modalcast_model::raster::{DrawTarget, Rasterizer};

    /// Time of a frame of the fastest combination.
    const SHORT_FRAME: Duration = Duration::from_millis(10);
    /// Time of a frame of the other combinations.
    const LONG_FRAME: Duration = Duration::from_millis(11);

    #[derive(Debug)]
    struct EmptyRasterizer;

    impl Rasterizer for EmptyRasterizer {
        fn precompile(&mut self, _depth: bool, _ids: bool) -> Result<()> {
            Ok(())
        }

        fn draw(
            &mut self,
            _depth: Option<DrawTarget<'_>>,
            _ids: Option<DrawTarget<'_>>,
            _range: std::ops::Range<u32>,
        ) -> Result<()> {
            Ok(())
        }
    }

    /// A scene with a clock of its own, by which frames take longer unless the compute rasterizer draws `fastest`.
    struct ClockedScene {
        buffers: SceneBuffers,
        params: FrameParams,
        fastest: RasterPasses,
        clock: Instant,
    }

    impl TrialScene for ClockedScene {
        fn buffers_mut(&mut self) -> Result<&mut SceneBuffers> {
            Ok(&mut self.buffers)
        }

        fn submit(&mut self, renderer: &mut Renderer) -> Result<PendingFrame> {
            let duration = if enabled(self)? == self.fastest { SHORT_FRAME } else { LONG_FRAME };
            self.clock += duration;
            renderer.submit_without_readback(&self.buffers, &self.params)
        }

        fn now(&self) -> Instant {
            self.clock
        }
    }

    #[test]
    fn combination_with_the_fastest_frames_is_selected() {
        let (mut renderer, scene, mut buffers) = load_renderer();
        renderer.attach_rasterizer(&mut buffers, |_| Ok(Box::new(EmptyRasterizer))).expect("a rasterizer");
        let supported = buffers.compute_rasterizer.as_ref().map(ComputeRasterizer::enabled).expect("a rasterizer");
        let fastest = RasterPasses { shadow: true, visibility: false };
        assert!(fastest.is_subset_of(supported), "expected a scene whose shadow map the rasterizer can draw");
        let params = params(&scene, 16);
        let mut scene = ClockedScene { buffers, params, fastest, clock: Instant::now() };
        let backends = renderer.select_raster_backends(&mut scene).expect("timed trials");
        assert_eq!(backends.shadow, Some(RasterBackend::Cuda));
        assert_eq!(enabled(&mut scene).expect("buffers"), fastest);
        scene.fastest = RasterPasses::NONE;
        renderer.select_raster_backends(&mut scene).expect("timed trials");
        assert!(scene.buffers.compute_rasterizer.is_none(), "expected no rasterizer that draws no pass");
    }
}
