//! Test harness around the renderer: one scene with one look, deformed on the CPU, drawn and timed.

use std::sync::Arc;
use std::time::{Duration, Instant};

use serde::Serialize;

use crate::timing::{MIN_REPETITIONS, Timing};
use modalcast_compute::cpu::CpuDeformer;
use modalcast_compute::gpu::{CudaRasterizer, Device};
use modalcast_model::backend_settings::RasterPolicy;
use modalcast_model::deform::{DeformedSurface, Deformer};
use modalcast_model::error::{Result, fault_in};
use modalcast_model::raster::{RasterGeometry, Rasterizer};
use modalcast_model::scene::{BoundingBox, Camera, OrientedBounds, Scene, SceneState};
use modalcast_render::{DevicePreference, FrameImage, FrameParams, Renderer, SceneBuffers};

/// The first CUDA device with a working compiler, if there is one.
pub(super) fn cuda_device() -> Option<Arc<Device>> {
    Device::open(0).ok().filter(|device| device.check_compiler().is_ok())
}

/// Size of a picture in pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct Size {
    pub width: u32,
    pub height: u32,
}

/// Time of one pass, by the name of its stage.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PassTime {
    pub name: &'static str,
    pub timing: Timing,
}

/// Warm-up time before timing starts.
pub(super) const WARM_UP: Duration = Duration::from_millis(500);

/// Owns the renderer and draws scenes with it.
pub(super) struct RenderHarness {
    pub(super) renderer: Renderer,
}

/// A scene that is loaded on the device, with its deformer.
pub(super) struct HarnessScene {
    scene: Arc<Scene>,
    pub(super) buffers: SceneBuffers,
    deformer: CpuDeformer,
    bounds: BoundingBox,
    light: Option<OrientedBounds>,
}

impl RenderHarness {
    pub(super) fn open() -> Result<Self> {
        Ok(Self { renderer: Renderer::open(DevicePreference::Any)? })
    }

    /// Loads a scene.
    pub(super) fn set(&mut self, scene: &Arc<Scene>) -> Result<HarnessScene> {
        let (buffers, deformer) =
            (self.renderer.load(scene)?, CpuDeformer::new(scene).with_bounding_axes(scene.light_axes()));
        Ok(HarnessScene { scene: Arc::clone(scene), buffers, deformer, bounds: BoundingBox::EMPTY, light: None })
    }

    /// Lets the CUDA rasterizer draw the passes of a scene that it supports.
    ///
    /// # Errors
    /// Errors of the device.
    pub(super) fn attach_rasterizer(&mut self, set: &mut HarnessScene, device: &Arc<Device>) -> Result<()> {
        let make = |mesh: RasterGeometry| Ok(Box::new(CudaRasterizer::new(device, mesh)?) as Box<dyn Rasterizer>);
        self.renderer.attach_rasterizer(&mut set.buffers, make)
    }

    /// Selects the rasterizers of a posed scene by `policy`, as far as they are available.
    ///
    /// # Errors
    /// Errors of the device and of drawing.
    pub(super) fn select_rasterizer(
        &mut self,
        set: &mut HarnessScene,
        policy: RasterPolicy,
        camera: Camera,
        size: Size,
    ) -> Result<()> {
        let Some(device) = cuda_device().filter(|_| policy != RasterPolicy::OpenGl) else { return Ok(()) };
        self.attach_rasterizer(set, &device)?;
        if policy == RasterPolicy::Fastest {
            let shot = set.shot(camera, size);
            self.renderer.select_raster_backends(&mut set.buffers, &shot)?;
        }
        Ok(())
    }

    /// Deforms the scene to a state and uploads the vertices.
    pub(super) fn pose(&mut self, set: &mut HarnessScene, state: &SceneState) -> Result<()> {
        let deformed = set.deformer.deform(state)?;
        (set.bounds, set.light) = (deformed.bounds, deformed.oriented_bounds);
        self.renderer.upload(&set.buffers, set.deformer.surface()?)
    }

    pub(super) fn draw(&mut self, set: &HarnessScene, camera: Camera, size: Size) -> Result<FrameImage> {
        self.renderer.draw(&set.buffers, &set.shot(camera, size))
    }

    /// Draws the same frame repeatedly and returns the times per pass; "frame" is the sum of all passes except the
    /// readback.
    pub(super) fn time(
        &mut self,
        set: &HarnessScene,
        camera: Camera,
        size: Size,
        replays: usize,
    ) -> Result<Vec<PassTime>> {
        let mut times: Vec<(&'static str, Vec<f64>)> = vec![("frame", Vec::new())];
        self.warm_up(set, camera, size)?;
        for _ in 0..replays.max(MIN_REPETITIONS) {
            let image = self.draw(set, camera, size)?;
            times[0].1.push(1e3 * image.times.drawing_ms());
            for (key, ms) in image.times.iter() {
                let name = key.name();
                match times.iter_mut().find(|(own, _)| *own == name) {
                    Some((_, list)) => list.push(1e3 * ms),
                    None => times.push((name, vec![1e3 * ms])),
                }
            }
        }
        let pass = |(name, list): (&'static str, Vec<f64>)| {
            Timing::of(list)
                .map(|timing| PassTime { name, timing })
                .ok_or_else(|| fault_in("time")("no frame was drawn"))
        };
        times.into_iter().map(pass).collect()
    }

    /// Draws until times are stable. The first frame of a size compiles and allocates, and the clock rate of an idle
    /// device rises for a while: the same pass took six times as long on an H200 at first.
    pub(super) fn warm_up(&mut self, set: &HarnessScene, camera: Camera, size: Size) -> Result<()> {
        let begin = Instant::now();
        loop {
            self.draw(set, camera, size)?;
            if self.renderer.info().software || begin.elapsed() >= WARM_UP {
                return Ok(());
            }
        }
    }

    pub(super) fn unload(&mut self, set: HarnessScene) {
        self.renderer.unload(set.buffers);
    }
}

impl HarnessScene {
    pub(super) fn shot(&self, camera: Camera, size: Size) -> FrameParams {
        FrameParams { camera, width: size.width, height: size.height, bounds: self.bounds, light: self.light }
    }

    /// Bounds of the last posed vertices, in world and in light space.
    pub(super) const fn extents(&self) -> (BoundingBox, Option<OrientedBounds>) {
        (self.bounds, self.light)
    }

    pub(super) fn scene(&self) -> &Arc<Scene> {
        &self.scene
    }

    /// The last posed vertices.
    pub(super) fn surface(&mut self) -> Result<&DeformedSurface> {
        self.deformer.surface()
    }
}
