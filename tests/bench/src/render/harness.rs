//! Benchmark harness around the renderer: loads scenes, deforms them on the CPU, and draws and times frames.

use std::sync::Arc;
use std::time::{Duration, Instant};

use serde::Serialize;

use crate::timing::{MIN_REPETITIONS, Timing};
use modalcast::engine::share_pictures;
use modalcast_compute::cpu::CpuDeformer;
use modalcast_compute::gpu::{CudaRasterizer, Device};
use modalcast_model::backend_settings::{RasterFacts, RasterPolicy};
use modalcast_model::deform::{DeformedSurface, Deformer};
use modalcast_model::error::{Result, fault};
use modalcast_model::raster::{RasterGeometry, Rasterizer};
use modalcast_model::scene::{BoundingBox, Camera, OrientedBounds, Scene, SceneState};
use modalcast_render::{DevicePreference, FrameImage, FrameParams, PendingFrame, Renderer, SceneBuffers, TrialScene};

/// CUDA device 0, if there is one and the kernel compiler works on it.
pub(super) fn cuda_device() -> Option<Arc<Device>> {
    Device::open(0).ok().filter(|device| device.check_compiler().is_ok())
}

/// Size of an image in pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct Size {
    pub width: u32,
    pub height: u32,
}

/// Time of one render pass or stage, or of a whole frame.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PassTime {
    /// A name of `modalcast_render`'s passes and stages, or "frame" for all passes except the readback.
    pub name: &'static str,
    pub timing: Timing,
}

/// Warm-up time before timing starts, for the reasons in [`RenderHarness::warm_up`].
pub(super) const WARM_UP: Duration = Duration::from_millis(500);

/// Owns the renderer and draws scenes.
pub(super) struct RenderHarness {
    pub(super) renderer: Renderer,
}

/// A scene that is loaded on the device, with its deformer.
pub(super) struct LoadedScene {
    scene: Arc<Scene>,
    pub(super) buffers: SceneBuffers,
    deformer: CpuDeformer,
    /// Bounds of the last deformed vertices in world space.
    bounds: BoundingBox,
    /// Bounds of the same vertices in light space, whose z axis points to the sun.
    light_box: Option<OrientedBounds>,
}

impl RenderHarness {
    /// Opens a renderer that shares memory with CUDA if it can, as in the server.
    pub(super) fn open() -> Result<Self> {
        let mut renderer = Renderer::open(DevicePreference::Any)?;
        if let Some(device) = cuda_device() {
            share_pictures(&mut renderer, &device)?;
        }
        Ok(Self { renderer })
    }

    /// Loads a scene.
    pub(super) fn load(&mut self, scene: &Arc<Scene>) -> Result<LoadedScene> {
        let (buffers, deformer) =
            (self.renderer.load(scene)?, CpuDeformer::new(scene).with_bounding_axes(scene.light_axes()));
        Ok(LoadedScene { scene: Arc::clone(scene), buffers, deformer, bounds: BoundingBox::EMPTY, light_box: None })
    }

    /// Lets the CUDA rasterizer draw those passes of a scene that it supports.
    ///
    /// # Errors
    /// Errors of the device.
    pub(super) fn attach_rasterizer(&mut self, loaded_scene: &mut LoadedScene, device: &Arc<Device>) -> Result<()> {
        self.attach_rasterizer_to(&mut loaded_scene.buffers, device)
    }

    /// [`Self::attach_rasterizer`] for the buffers of a scene.
    pub(super) fn attach_rasterizer_to(&mut self, buffers: &mut SceneBuffers, device: &Arc<Device>) -> Result<()> {
        let create = |mesh: RasterGeometry| Ok(Box::new(CudaRasterizer::new(device, mesh)?) as Box<dyn Rasterizer>);
        self.renderer.attach_rasterizer(buffers, create)
    }

    /// Selects the rasterizers of a deformed scene by `policy`. `Fastest` draws `camera`'s frame to measure both
    /// rasterizers. Without a CUDA device, OpenGL draws all passes.
    ///
    /// # Errors
    /// Errors of the device and of drawing.
    pub(super) fn select_rasterizer(
        &mut self,
        loaded_scene: &mut LoadedScene,
        policy: RasterPolicy,
        camera: Camera,
        size: Size,
    ) -> Result<()> {
        let Some(device) = cuda_device().filter(|_| policy != RasterPolicy::OpenGl) else { return Ok(()) };
        if policy == RasterPolicy::Auto {
            if !RasterFacts::new(device.capability(), &loaded_scene.scene).is_cuda_faster() {
                return Ok(());
            }
            let create = |mesh| Ok(Box::new(CudaRasterizer::new(&device, mesh)?) as Box<dyn Rasterizer>);
            return self.renderer.attach_shadow_rasterizer(&mut loaded_scene.buffers, create);
        }
        self.attach_rasterizer(loaded_scene, &device)?;
        if policy == RasterPolicy::Fastest {
            let frame_params = loaded_scene.frame_params(camera, size);
            self.renderer.select_raster_backends(&mut StillScene { scene: loaded_scene, frame_params })?;
        }
        Ok(())
    }

    /// Deforms the scene to a state and uploads the vertices.
    pub(super) fn deform(&mut self, loaded_scene: &mut LoadedScene, state: &SceneState) -> Result<()> {
        let deformed = loaded_scene.deformer.deform(state)?;
        (loaded_scene.bounds, loaded_scene.light_box) = (deformed.bounds, deformed.oriented_bounds);
        self.renderer.upload(&loaded_scene.buffers, loaded_scene.deformer.surface()?)
    }

    pub(super) fn draw(&mut self, loaded_scene: &LoadedScene, camera: Camera, size: Size) -> Result<FrameImage> {
        self.renderer.draw(&loaded_scene.buffers, &loaded_scene.frame_params(camera, size))
    }

    /// Draws the same frame repeatedly and returns the times per pass. The first entry, "frame", is the sum of all
    /// passes except the readback.
    pub(super) fn time_passes(
        &mut self,
        loaded_scene: &LoadedScene,
        camera: Camera,
        size: Size,
        replays: usize,
    ) -> Result<Vec<PassTime>> {
        let mut us_by_pass: Vec<(&'static str, Vec<f64>)> = vec![("frame", Vec::new())];
        self.warm_up(loaded_scene, camera, size)?;
        for _ in 0..replays.max(MIN_REPETITIONS) {
            let image = self.draw(loaded_scene, camera, size)?;
            us_by_pass[0].1.push(1e3 * image.times.drawing_ms());
            for (key, ms) in image.times.iter() {
                let name = key.name();
                match us_by_pass.iter_mut().find(|(pass, _)| *pass == name) {
                    Some((_, times_us)) => times_us.push(1e3 * ms),
                    None => us_by_pass.push((name, vec![1e3 * ms])),
                }
            }
        }
        let pass_time = |(name, times_us): (&'static str, Vec<f64>)| {
            Timing::of(times_us)
                .map(|timing| PassTime { name, timing })
                .ok_or_else(|| fault("time", "expected at least one frame, got none"))
        };
        us_by_pass.into_iter().map(pass_time).collect()
    }

    /// Draws until times are stable. The first frame of a size compiles shaders and allocates textures, and the clock
    /// rate of an idle device rises slowly: on an idle H200 a pass took six times as long at first.
    pub(super) fn warm_up(&mut self, loaded_scene: &LoadedScene, camera: Camera, size: Size) -> Result<()> {
        let begin = Instant::now();
        loop {
            self.draw(loaded_scene, camera, size)?;
            if self.renderer.info().software || begin.elapsed() >= WARM_UP {
                return Ok(());
            }
        }
    }

    pub(super) fn unload(&mut self, loaded_scene: LoadedScene) {
        self.renderer.unload(loaded_scene.buffers);
    }
}

/// Draws the same step again, because the report measures the passes of a frame without a deformation.
struct StillScene<'a> {
    scene: &'a mut LoadedScene,
    frame_params: FrameParams,
}

impl TrialScene for StillScene<'_> {
    fn buffers_mut(&mut self) -> Result<&mut SceneBuffers> {
        Ok(&mut self.scene.buffers)
    }

    fn submit(&mut self, renderer: &mut Renderer) -> Result<PendingFrame> {
        renderer.submit_without_readback(&self.scene.buffers, &self.frame_params)
    }
}

impl LoadedScene {
    pub(super) fn frame_params(&self, camera: Camera, size: Size) -> FrameParams {
        FrameParams {
            camera,
            width: size.width,
            height: size.height,
            bounds: self.bounds,
            light_bounds: self.light_box,
            edges: None,
            samples: None,
        }
    }

    /// Bounds of the last deformed vertices, in world and in light space.
    pub(super) const fn deformed_bounds(&self) -> (BoundingBox, Option<OrientedBounds>) {
        (self.bounds, self.light_box)
    }

    pub(super) fn scene(&self) -> &Arc<Scene> {
        &self.scene
    }

    /// The last deformed vertices.
    pub(super) fn surface(&mut self) -> Result<&DeformedSurface> {
        self.deformer.surface()
    }
}
