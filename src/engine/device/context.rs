//! Device context: owns the deformation backend and the optional renderer, and loads scenes onto both
//! ([`LoadedScene`]).

use std::rc::Rc;
use std::sync::Arc;
use std::time::{Duration, Instant};

use super::loaded_scene::LoadedScene;
use crate::config::{BackendChoice, Config, EncodeChoice, RendererChoice};
use crate::engine::memory_limits::MemoryLimits;
use crate::engine::output::output_spec::{FrameOutput, PictureContent};
use crate::frame::Legend;
use crate::telemetry::ms_since;
use modalcast_compute::cpu::CpuDeformer;
use modalcast_compute::gpu::{self, CudaDeformer, CudaDeformerOptions, CudaPictureMemory, CudaRasterizer};
use modalcast_compute::reference::ReferenceDeformer;
use modalcast_model::backend_settings::{BackendSettings, BatchPolicy, RasterFacts, RasterPolicy};
use modalcast_model::deform::{Backend, Deformer};
use modalcast_model::error::{Error, Result, fault};
use modalcast_model::fault_injection;
use modalcast_model::raster::{RasterGeometry, Rasterizer};
use modalcast_model::scene::{Camera, FrameSize, FrameStyle, PixelRect, Scene};
use modalcast_model::shared_memory::PictureMemory;
use modalcast_render::{
    Aov, AovImage, DevicePreference, FrameImage, FrameParams, MappedPixels, PartialAov, PartialFrame, PendingFrame,
    PendingPick, PickHit, PixelReadback, Renderer, SceneBuffers, ScenePreparation,
};

/// Description of the deformation backend and the renderer in use.
#[derive(Debug, Clone)]
pub struct EngineInfo {
    pub backend: Backend,
    /// Name of the CUDA device, or the reason why no CUDA device is used.
    pub device: String,
    /// The renderer, or the reason why there is none.
    pub renderer: Result<modalcast_render::RendererInfo>,
    pub memory: MemoryLimits,
}

/// An AOV (arbitrary output variable: values instead of colors) of which some bands of rows are not submitted yet.
#[derive(Debug)]
pub(in crate::engine) struct PartialAovDraw {
    pub aov: PartialAov,
    legend: Option<Legend>,
    /// As [`modalcast_render::FrameInfo::is_reframed`].
    pub is_reframed: bool,
}

/// Creates the deformer of a scene in tests.
#[cfg(test)]
type CreateDeformer = fn(&Arc<Scene>) -> Box<dyn Deformer + Send>;

/// A deformer that any thread can prepare, and that the device thread completes.
pub(in crate::engine) enum PreparedDeformer {
    /// Needs no completion.
    Complete(Box<dyn Deformer + Send>),
    /// Lacks the output buffers. The device thread creates them, because OpenGL may own them.
    Cuda(Box<gpu::PreparedDeformer>),
}

/// Prepares deformers on any thread, so that the device thread executes the commands of other scenes meanwhile.
#[derive(Debug, Clone)]
pub(in crate::engine) struct DeformerPreparer {
    backend: Backend,
    cuda_device: Option<Arc<gpu::Device>>,
    #[cfg(test)]
    create_test_deformer: Option<CreateDeformer>,
}

impl DeformerPreparer {
    /// Prepares deformers of the reference backend.
    #[cfg(test)]
    pub(super) const fn reference() -> Self {
        Self { backend: Backend::Reference, cuda_device: None, create_test_deformer: None }
    }

    /// The device of the backend `cuda`.
    pub(super) const fn cuda_device(&self) -> Option<&Arc<gpu::Device>> {
        self.cuda_device.as_ref()
    }

    /// Prepares the deformer of a scene: compiles its kernels, and packs and uploads its tables.
    ///
    /// # Errors
    /// `Fault` of the device; `Unavailable` when its memory is too small.
    pub(in crate::engine) fn prepare(&self, scene: &Arc<Scene>, batches: BatchPolicy) -> Result<PreparedDeformer> {
        #[cfg(test)]
        if let Some(create_test_deformer) = self.create_test_deformer {
            return Ok(PreparedDeformer::Complete(create_test_deformer(scene)));
        }
        let bounding_axes = scene.light_axes();
        match (&self.cuda_device, self.backend) {
            (Some(device), Backend::Cuda) => {
                let options = CudaDeformerOptions { batches, bounding_axes };
                let prepared = gpu::PreparedDeformer::new(device, scene, options)?;
                Ok(PreparedDeformer::Cuda(Box::new(prepared)))
            }
            (_, Backend::Reference) => {
                let deformer = ReferenceDeformer::new(scene).with_bounding_axes(bounding_axes);
                Ok(PreparedDeformer::Complete(Box::new(deformer)))
            }
            _ => Ok(PreparedDeformer::Complete(Box::new(CpuDeformer::new(scene).with_bounding_axes(bounding_axes)))),
        }
    }
}

/// Owns the CUDA device and the renderer. Must remain on the thread that created it: the device thread of the server,
/// or the main thread of `modalcast render`.
#[derive(Debug)]
pub struct DeviceContext {
    renderer: Result<Renderer>,
    cuda_device: Option<Arc<gpu::Device>>,
    encode: EncodeChoice,
    /// Encodes frames as PNG on request. `None` if the CPU encodes all frames.
    picture_encoder: Option<Rc<CudaPictureMemory>>,
    info: EngineInfo,
    /// With which the renderer is opened again.
    config: Config,
    #[cfg(test)]
    create_test_deformer: Option<CreateDeformer>,
}

impl DeviceContext {
    /// Opens the configured backend and renderer.
    ///
    /// # Errors
    /// `Unavailable` when CUDA is requested by name and cannot be opened. A missing renderer is an error only once a
    /// frame is requested.
    pub fn open(config: &Config) -> Result<Self> {
        let (backend, cuda_device, device_label) = open_backend(config)?;
        let device_bytes =
            cuda_device.as_ref().map(|device| device.memory()).transpose()?.map(|(_, total)| total as u64);
        let memory = MemoryLimits::new(config, device_bytes);
        let OpenedRenderer { renderer, picture_encoder } = open_renderer(config, &memory, cuda_device.as_ref())?;
        let info = EngineInfo {
            backend,
            device: device_label,
            renderer: renderer.as_ref().map(|renderer| renderer.info().clone()).map_err(Clone::clone),
            memory,
        };
        Ok(Self {
            renderer,
            cuda_device,
            encode: config.encode,
            picture_encoder,
            info,
            config: config.clone(),
            #[cfg(test)]
            create_test_deformer: None,
        })
    }

    /// Opens the renderer again after its loss. All buffers of the old one must be freed before.
    ///
    /// # Errors
    /// Those of the renderer, for example `Unavailable`; `DeviceLost`.
    pub(super) fn reopen_renderer(&mut self) -> Result<()> {
        if matches!(self.config.renderer, RendererChoice::Off) {
            return Ok(());
        }
        // Destroys the old context before the new one is created.
        self.renderer = Err(fault("renderer", "the renderer is being opened"));
        fault_injection::reopen_renderer();
        self.picture_encoder = None;
        let opened = open_renderer(&self.config, &self.info.memory, self.cuda_device.as_ref())?;
        (self.renderer, self.picture_encoder) = (opened.renderer, opened.picture_encoder);
        self.renderer.as_ref().map(drop).map_err(Clone::clone)
    }

    /// A context without renderer whose scenes use the given deformer.
    #[cfg(test)]
    pub(in crate::engine) fn with_deformer(create: CreateDeformer) -> Result<Self> {
        let config = Config { backend: BackendChoice::Reference, renderer: RendererChoice::Off, ..Config::default() };
        Ok(Self { create_test_deformer: Some(create), ..Self::open(&config)? })
    }

    /// The backend in use.
    pub const fn backend(&self) -> Backend {
        self.info.backend
    }

    /// The backend and the renderer.
    pub const fn info(&self) -> &EngineInfo {
        &self.info
    }

    /// Whether render targets are cached.
    pub(super) fn has_targets(&self) -> bool {
        self.renderer.as_ref().is_ok_and(Renderer::has_targets)
    }

    /// Frees the render targets and the output of compute rasterizers that no frame has used for this time.
    pub(super) fn free_unused_targets<'a>(&mut self, scenes: impl Iterator<Item = &'a LoadedScene>, unused: Duration) {
        let Ok(renderer) = &mut self.renderer else { return };
        let mut buffers = scenes.filter_map(|scene| scene.buffers().ok());
        let result = renderer
            .free_unused_targets(unused)
            .and_then(|()| buffers.try_for_each(|buffers| renderer.free_unused_samples(buffers, unused)));
        if let Err(error) = result {
            tracing::warn!(%error, "the memory of unused render targets is not freed");
        }
    }

    /// Statistics of the passes that the last frame executed; `None` without a renderer.
    pub fn stats(&self) -> Option<&modalcast_render::FrameStats> {
        self.renderer.as_ref().ok().map(Renderer::stats)
    }

    /// Prepares the deformers of this context's scenes on other threads.
    pub(in crate::engine) fn deformer_preparer(&self) -> DeformerPreparer {
        DeformerPreparer {
            backend: self.info.backend,
            cuda_device: self.cuda_device.clone(),
            #[cfg(test)]
            create_test_deformer: self.create_test_deformer,
        }
    }

    /// Loads a scene and deforms it to the rest state. Creates OpenGL buffers here only if the deformer or a CUDA
    /// rasterizer uses them; otherwise the first frame creates them.
    ///
    /// # Errors
    /// `Fault` of the device; `Invalid` when the rest state overflows.
    pub fn load_scene(&mut self, scene: &Arc<Scene>, backends: BackendSettings) -> Result<LoadedScene> {
        let deformer = self.deformer_preparer().prepare(scene, backends.batches)?;
        self.load_prepared(scene, deformer, backends.raster)
    }

    /// [`Self::load_scene`] with a prepared deformer.
    pub(in crate::engine) fn load_prepared(
        &mut self,
        scene: &Arc<Scene>,
        deformer: PreparedDeformer,
        raster: RasterPolicy,
    ) -> Result<LoadedScene> {
        let (deformer, buffers) = self.complete_deformer(scene, deformer)?;
        let mut loaded_scene = LoadedScene::new(scene, deformer, buffers);
        let result = loaded_scene
            .deform_rest()
            .and_then(|()| self.attach_rasterizer(&mut loaded_scene, raster))
            .and_then(|()| self.select_png_encoder(&mut loaded_scene));
        match result {
            Ok(()) => Ok(loaded_scene),
            Err(error) => {
                self.unload_scene(loaded_scene);
                Err(error)
            }
        }
    }

    /// Completes a prepared deformer. If it can fill OpenGL buffers, creates the buffers, too.
    fn complete_deformer(
        &mut self,
        scene: &Arc<Scene>,
        deformer: PreparedDeformer,
    ) -> Result<(Box<dyn Deformer>, Option<SceneBuffers>)> {
        let prepared = match deformer {
            PreparedDeformer::Complete(deformer) => return Ok((deformer, None)),
            PreparedDeformer::Cuda(prepared) => prepared,
        };
        let buffers = self.create_shareable_buffers(scene)?;
        match CudaDeformer::from_prepared(*prepared, buffers.as_ref().map(SceneBuffers::vertex_buffers)) {
            Ok(deformer) => Ok((Box::new(deformer), buffers)),
            Err(error) => {
                self.free_buffers(buffers);
                Err(error)
            }
        }
    }

    /// Creates the compute (CUDA) rasterizer of a scene if `policy` selects it. For [`RasterPolicy::Fastest`] also
    /// measures both rasterizers and selects the faster one for each pass. If the compute rasterizer cannot be created,
    /// logs the reason and leaves all passes to OpenGL.
    ///
    /// # Errors
    /// `DeviceLost`; the errors of drawing the measured frames.
    fn attach_rasterizer(&mut self, loaded_scene: &mut LoadedScene, policy: RasterPolicy) -> Result<()> {
        let (Some(device), Ok(renderer)) = (&self.cuda_device, &mut self.renderer) else { return Ok(()) };
        let is_selected = match policy {
            RasterPolicy::OpenGl => false,
            RasterPolicy::Auto => RasterFacts::new(device.capability(), loaded_scene.scene()).is_cuda_faster(),
            RasterPolicy::Cuda | RasterPolicy::Fastest => true,
        };
        if !is_selected || renderer.info().cuda_device.is_none() {
            return Ok(());
        }
        let create_rasterizer =
            |geometry: RasterGeometry| Ok(Box::new(CudaRasterizer::new(device, geometry)?) as Box<dyn Rasterizer>);
        let attached = match policy {
            RasterPolicy::Auto => loaded_scene.attach_shadow_rasterizer(renderer, create_rasterizer),
            RasterPolicy::OpenGl | RasterPolicy::Cuda | RasterPolicy::Fastest => {
                loaded_scene.attach_rasterizer(renderer, create_rasterizer)
            }
        };
        match attached {
            Ok(()) => {}
            Err(error) if error.is_loss() => return Err(error),
            Err(error) => {
                tracing::warn!(%error, "the compute rasterizer could not be created; OpenGL draws");
                return Ok(());
            }
        }
        if policy == RasterPolicy::Fastest { loaded_scene.select_raster_backends(renderer) } else { Ok(()) }
    }

    /// Selects the device that encodes the frames of a scene as PNG.
    ///
    /// # Errors
    /// The errors of drawing the measured frames.
    fn select_png_encoder(&mut self, loaded_scene: &mut LoadedScene) -> Result<()> {
        let (Some(_), Ok(renderer)) = (&self.picture_encoder, &mut self.renderer) else { return Ok(()) };
        match self.encode {
            EncodeChoice::Cpu => Ok(()),
            EncodeChoice::Cuda => {
                loaded_scene.set_encodes_on_cuda(true);
                Ok(())
            }
            EncodeChoice::Fastest => loaded_scene.select_png_encoder(renderer),
        }
    }

    /// Starts to encode the frames that wait for it. The caller calls this before a deformation, and when OpenGL has
    /// nothing to draw ([`CudaPictureMemory::start_encodings`]).
    pub(super) fn start_encodings(&self) {
        if let Some(picture_encoder) = &self.picture_encoder {
            picture_encoder.start_encodings();
        }
    }

    /// Whether CUDA may encode frames.
    pub(super) const fn encodes_on_cuda(&self) -> bool {
        self.picture_encoder.is_some()
    }

    /// Frees a loaded scene. Waits until CUDA has freed its memory, so that it is available to the next scene.
    pub fn unload_scene(&mut self, loaded_scene: LoadedScene) {
        let buffers = loaded_scene.into_buffers();
        self.free_buffers(buffers);
        self.wait_for_freed_memory();
    }

    /// Waits until CUDA has freed the memory that was dropped, so that it is available to the next scene.
    pub(super) fn wait_for_freed_memory(&self) {
        if let Some(device) = &self.cuda_device {
            // A lost device reports its error at the next step.
            device.synchronize("unload").ok();
        }
    }

    /// Draws the vertices of the last deformation. The image's times include the stage `upload` if the vertices had to
    /// be uploaded.
    ///
    /// # Errors
    /// `Unavailable` without a renderer, `Invalid` for an invalid camera or size, `Fault` of OpenGL.
    pub fn draw(&mut self, loaded_scene: &mut LoadedScene, camera: &Camera, size: FrameSize) -> Result<FrameImage> {
        let style = FrameStyle { edges: loaded_scene.scene().look.edges, samples: None };
        let pending_draw = self.begin_draw(loaded_scene, camera, size, style)?;
        self.finish_draw(pending_draw).map(MappedPixels::into_image)
    }

    /// As [`Self::draw`], with this style instead of that of the scene's settings.
    ///
    /// # Errors
    /// As [`Self::draw`].
    pub fn draw_with_style(
        &mut self,
        loaded_scene: &mut LoadedScene,
        camera: &Camera,
        size: FrameSize,
        style: FrameStyle,
    ) -> Result<FrameImage> {
        let pending_draw = self.begin_draw(loaded_scene, camera, size, style)?;
        self.finish_draw(pending_draw).map(MappedPixels::into_image)
    }

    /// Submits a frame of the last deformation without waiting for the device. The scene may be deformed again while
    /// the frame is in flight.
    ///
    /// # Errors
    /// As [`Self::draw`]; `Busy` when every ring slot is in flight.
    pub fn begin_draw(
        &mut self,
        loaded_scene: &mut LoadedScene,
        camera: &Camera,
        size: FrameSize,
        style: FrameStyle,
    ) -> Result<PendingFrame> {
        let mut frame = self.begin_frame(loaded_scene, camera, size, style)?;
        while !frame.is_submitted() {
            self.submit_draw_step(loaded_scene, &mut frame)?;
        }
        self.finish_frame(loaded_scene, frame, PictureContent::PIXELS)
    }

    /// Begins a frame of the last deformation. The scene must not be used for anything else until all draw steps of the
    /// frame are submitted.
    ///
    /// # Errors
    /// As [`Self::begin_draw`].
    pub(in crate::engine) fn begin_frame(
        &mut self,
        loaded_scene: &mut LoadedScene,
        camera: &Camera,
        size: FrameSize,
        style: FrameStyle,
    ) -> Result<PartialFrame> {
        let camera = camera.validated()?;
        let renderer = self.renderer.as_mut().map_err(|error| error.clone())?;
        loaded_scene.rasterize(renderer, &camera, size, style.samples)?;
        let upload_begin = Instant::now();
        let contents = loaded_scene.fill_buffers(renderer, &camera)?;
        let upload_ms = contents.is_uploaded.then(|| ms_since(upload_begin));
        let params = FrameParams { edges: style.edges, samples: style.samples, ..contents.frame_params(camera, size) };
        let has_readback = true;
        let mut frame = renderer.begin_frame(loaded_scene.buffers()?, &params, has_readback)?;
        if let Some(ms) = upload_ms {
            frame.set_upload_ms(ms);
        }
        loaded_scene.log_frame(frame.info());
        Ok(frame)
    }

    /// Submits the next draw step of a frame.
    ///
    /// # Errors
    /// `Fault` of OpenGL. The frame must then be dropped.
    pub(in crate::engine) fn submit_draw_step(&mut self, scene: &LoadedScene, frame: &mut PartialFrame) -> Result<()> {
        self.renderer.as_mut().map_err(|error| error.clone())?.submit_step(scene.buffers()?, frame)
    }

    /// Returns a frame whose draw steps are all submitted. CUDA encodes it as PNG if it can and `content` has the PNG
    /// file.
    ///
    /// # Errors
    /// `Fault` of OpenGL.
    pub(in crate::engine) fn finish_frame(
        &mut self,
        scene: &LoadedScene,
        frame: PartialFrame,
        content: PictureContent,
    ) -> Result<PendingFrame> {
        let frame = self.renderer.as_mut().map_err(|error| error.clone())?.finish_frame(frame)?;
        if scene.encodes_on_cuda() && content.png {
            frame.request_png(content.pixels);
        }
        Ok(frame)
    }

    /// Begins to prepare the textures and programs of a scene, so that its buffers can then be created quickly. Returns
    /// `None` if there is no renderer, if there is nothing to prepare, or if the scene is not valid. For an invalid
    /// scene, creating the buffers then returns the error.
    pub(in crate::engine) fn begin_preparation(&mut self, scene: &Arc<Scene>) -> Option<ScenePreparation> {
        let preparation = self.renderer.as_mut().ok()?.begin_preparation(scene).ok()?;
        (!preparation.is_finished()).then_some(preparation)
    }

    /// Begins to compile the programs of a frame that are not compiled yet. `None` if all are compiled.
    pub(in crate::engine) fn begin_frame_preparation(
        &mut self,
        buffers: &SceneBuffers,
        size: FrameSize,
        style: FrameStyle,
    ) -> Option<ScenePreparation> {
        let renderer = self.renderer.as_mut().ok()?;
        let preparation = renderer.begin_frame_preparation(buffers, [size.width, size.height], style).ok()?;
        (!preparation.is_finished()).then_some(preparation)
    }

    /// Executes the next step of a preparation: uploads a layer of a texture, or compiles a program.
    ///
    /// # Errors
    /// `Fault` with the compiler's log, or of OpenGL.
    pub(in crate::engine) fn prepare_step(&mut self, preparation: &mut ScenePreparation) -> Result<()> {
        self.renderer.as_mut().map_err(|error| error.clone())?.prepare_step(preparation)
    }

    /// Keeps a finished preparation until the scene's buffers are created.
    pub(in crate::engine) fn finish_preparation(&mut self, preparation: ScenePreparation) {
        if let Ok(renderer) = &mut self.renderer {
            renderer.finish_preparation(preparation);
        }
    }

    /// Whether loading a scene creates its OpenGL buffers; otherwise its first output does.
    pub(in crate::engine) fn creates_buffers_at_load(&self) -> bool {
        self.cuda_device.is_some() && self.renderer.as_ref().is_ok_and(|renderer| renderer.info().cuda_device.is_some())
    }

    /// Whether an output of this size is drawn in several draw steps, between which other scenes are served.
    pub(in crate::engine) fn is_divided(&self, loaded_scene: &LoadedScene, size: FrameSize) -> bool {
        let size = [size.width, size.height];
        self.renderer.as_ref().is_ok_and(|renderer| renderer.is_divided(loaded_scene.scene(), size))
    }

    /// Sets the maximum number of samples of a band, the part of a picture that one draw step draws.
    #[cfg(test)]
    pub(in crate::engine) fn set_max_band_samples(&mut self, max_band_samples: u64) {
        if let Ok(renderer) = &mut self.renderer {
            renderer.set_max_band_samples(max_band_samples);
        }
    }

    /// Sets the time of a piece of a long output, and the maximum samples of a piece
    /// ([`Renderer::set_piece_limits`]).
    #[cfg(test)]
    pub(in crate::engine) fn set_piece_limits(&mut self, target_ms: f64, max_samples: u64) {
        if let Ok(renderer) = &mut self.renderer {
            renderer.set_piece_limits(target_ms, max_samples);
        }
    }

    /// Waits for a frame. Any thread may then copy its pixels.
    ///
    /// # Errors
    /// `Fault` when the device does not finish.
    pub fn finish_draw(&mut self, frame: PendingFrame) -> Result<MappedPixels> {
        self.renderer.as_mut().map_err(|error| error.clone())?.map_pixels(frame)
    }

    /// Renders an AOV: depth, domains, normals or the values of a color map. Returns it with the legend if it is a
    /// color map. [`Self::draw`] renders color frames.
    ///
    /// # Errors
    /// As [`Self::draw`].
    pub fn render_aov(
        &mut self,
        loaded_scene: &mut LoadedScene,
        camera: &Camera,
        size: FrameSize,
        frame_output: FrameOutput,
    ) -> Result<(AovImage, Option<Legend>)> {
        let mut draw = self.begin_aov(loaded_scene, camera, size, frame_output)?;
        while !draw.aov.is_submitted() {
            self.submit_aov_piece(loaded_scene, &mut draw)?;
        }
        self.finish_aov(loaded_scene, draw)
    }

    /// Begins an AOV. The scene must not be used for anything else until the AOV is finished.
    ///
    /// # Errors
    /// As [`Self::draw`].
    pub(in crate::engine) fn begin_aov(
        &mut self,
        loaded_scene: &mut LoadedScene,
        camera: &Camera,
        size: FrameSize,
        frame_output: FrameOutput,
    ) -> Result<PartialAovDraw> {
        let camera = camera.validated()?;
        let renderer = self.renderer.as_mut().map_err(|error| error.clone())?;
        let params = loaded_scene.fill_buffers(renderer, &camera)?.frame_params(camera, size);
        let legend = loaded_scene.upload_scalar_field(renderer, frame_output)?;
        let aov = match (frame_output, &legend) {
            (_, Some(legend)) => Aov::Values { scale_max: legend.scale_max as f32 },
            (FrameOutput::Depth, _) => Aov::Depth,
            (FrameOutput::DepthWithGround, _) => Aov::DepthWithGround,
            (FrameOutput::Normals, _) => Aov::Normals,
            _ => Aov::Domains,
        };
        let aov = renderer.begin_aov(loaded_scene.buffers()?, &params, aov)?;
        Ok(PartialAovDraw { aov, legend, is_reframed: false })
    }

    /// Submits the next band of an AOV.
    ///
    /// # Errors
    /// `Fault` of OpenGL. The AOV must then be dropped.
    pub(in crate::engine) fn submit_aov_piece(&mut self, scene: &LoadedScene, draw: &mut PartialAovDraw) -> Result<()> {
        self.renderer.as_mut().map_err(|error| error.clone())?.submit_aov_piece(scene.buffers()?, &mut draw.aov)
    }

    /// Waits for an AOV whose bands are all submitted.
    ///
    /// # Errors
    /// `Fault` when the device does not finish.
    pub(in crate::engine) fn finish_aov(
        &mut self,
        scene: &LoadedScene,
        draw: PartialAovDraw,
    ) -> Result<(AovImage, Option<Legend>)> {
        let PartialAovDraw { aov, legend, is_reframed: _ } = draw;
        let renderer = self.renderer.as_mut().map_err(|error| error.clone())?;
        Ok((renderer.finish_aov(scene.buffers()?, aov)?, legend))
    }

    /// Submits a pick without waiting for the device. `rectangle` is in pixels of a picture of size `size`.
    ///
    /// # Errors
    /// As [`Self::draw`].
    pub fn begin_pick(
        &mut self,
        loaded_scene: &mut LoadedScene,
        camera: &Camera,
        size: FrameSize,
        rectangle: PixelRect,
    ) -> Result<PendingPick> {
        let camera = camera.validated()?;
        let renderer = self.renderer.as_mut().map_err(|error| error.clone())?;
        let params = loaded_scene.fill_buffers(renderer, &camera)?.frame_params(camera, size);
        renderer.begin_pick(loaded_scene.buffers()?, &params, rectangle)
    }

    /// Waits for a pick; returns the hits row by row.
    ///
    /// # Errors
    /// `Fault` when the device does not finish.
    pub fn finish_pick(&mut self, pending_pick: PendingPick) -> Result<Vec<PickHit>> {
        self.renderer.as_mut().map_err(|error| error.clone())?.finish_pick(pending_pick)
    }

    /// Creates OpenGL buffers that CUDA can map. Returns `None` unless the renderer runs on a CUDA device.
    fn create_shareable_buffers(&mut self, scene: &Arc<Scene>) -> Result<Option<SceneBuffers>> {
        match &mut self.renderer {
            Ok(renderer) if renderer.info().cuda_device.is_some() => renderer.load(scene).map(Some),
            _ => Ok(None),
        }
    }

    fn free_buffers(&mut self, buffers: Option<SceneBuffers>) {
        if let (Some(buffers), Ok(renderer)) = (buffers, &mut self.renderer) {
            renderer.unload(buffers);
        }
    }
}

/// Lets the renderer draw into memory that it shares with CUDA, if both use the same device and the memory passes the
/// renderer's check. Returns the memory if it is shared.
///
/// # Errors
/// `DeviceLost`; `Fault` when CUDA refuses a stream.
pub fn share_pictures(renderer: &mut Renderer, device: &Arc<gpu::Device>) -> Result<Option<Rc<CudaPictureMemory>>> {
    if renderer.info().cuda_device.is_none() {
        return Ok(None);
    }
    let memory = Rc::new(CudaPictureMemory::new(device)?);
    renderer.share_pictures(Rc::clone(&memory) as Rc<dyn PictureMemory>)?;
    Ok((renderer.info().pixel_readback == PixelReadback::CopyEngine).then_some(memory))
}

/// The memory of pictures that CUDA can encode as PNG. If it cannot, logs the reason.
///
/// # Errors
/// `DeviceLost`.
fn prepare_encoder(picture_memory: Option<Rc<CudaPictureMemory>>) -> Result<Option<Rc<CudaPictureMemory>>> {
    let no_memory = || fault("encode", "CUDA and OpenGL share no pictures");
    match picture_memory.ok_or_else(no_memory).and_then(|memory| memory.prepare_encoder().map(|()| memory)) {
        Ok(memory) => Ok(Some(memory)),
        Err(lost @ Error::DeviceLost { .. }) => Err(lost),
        Err(error) => {
            tracing::warn!(%error, "the CPU encodes PNG files: CUDA cannot");
            Ok(None)
        }
    }
}

/// Opens the configured backend. Returns it with its CUDA device, if any, and [`EngineInfo::device`].
fn open_backend(config: &Config) -> Result<(Backend, Option<Arc<gpu::Device>>, String)> {
    match config.backend {
        BackendChoice::Cpu => Ok((Backend::Cpu, None, "not requested".into())),
        BackendChoice::Reference => Ok((Backend::Reference, None, "not requested".into())),
        BackendChoice::Cuda => open_cuda(config),
        BackendChoice::Auto => open_cuda(config).or_else(|error| Ok((Backend::Cpu, None, error.to_string()))),
    }
}

/// Opens the CUDA device. Fails if no installed NVRTC (the run-time compiler of CUDA) supports it, because the kernels
/// could not be compiled.
fn open_cuda(config: &Config) -> Result<(Backend, Option<Arc<gpu::Device>>, String)> {
    let device = gpu::Device::open(config.cuda_device)?;
    device.check_compiler()?;
    let name = device.name().to_owned();
    Ok((Backend::Cuda, Some(device), name))
}

/// A renderer, and what CUDA does for it.
struct OpenedRenderer {
    renderer: Result<Renderer>,
    picture_encoder: Option<Rc<CudaPictureMemory>>,
}

/// Opens the configured renderer.
///
/// # Errors
/// `DeviceLost`; `Fault` when CUDA refuses a stream. A missing renderer is no error.
fn open_renderer(
    config: &Config,
    memory: &MemoryLimits,
    cuda_device: Option<&Arc<gpu::Device>>,
) -> Result<OpenedRenderer> {
    let mut renderer = open_any_renderer(config, cuda_device.is_some());
    if let Ok(renderer) = &mut renderer {
        renderer.set_target_budget(memory.render_target_budget());
    }
    let picture_memory = match (&mut renderer, cuda_device) {
        (Ok(renderer), Some(device)) => share_pictures(renderer, device)?,
        _ => None,
    };
    let picture_encoder = match config.encode {
        EncodeChoice::Cpu => None,
        EncodeChoice::Cuda | EncodeChoice::Fastest => prepare_encoder(picture_memory)?,
    };
    Ok(OpenedRenderer { renderer, picture_encoder })
}

fn open_any_renderer(config: &Config, uses_cuda: bool) -> Result<Renderer> {
    let renderer_unavailable = |reason: &str, remedy: &str| Error::Unavailable {
        what: "renderer",
        reason: reason.into(),
        remedy: remedy.into(),
    };
    let renderer = match config.renderer {
        RendererChoice::Off => {
            return Err(renderer_unavailable("it was switched off", "Start the server with a renderer"));
        }
        RendererChoice::Software => Renderer::open(DevicePreference::Software),
        RendererChoice::Auto if uses_cuda => {
            let ordinal = i32::try_from(config.cuda_device).unwrap_or(i32::MAX);
            // A CUDA driver without EGL can deform but not draw. Another OpenGL device then draws the frames.
            Renderer::open(DevicePreference::Cuda(ordinal)).or_else(|_| Renderer::open(DevicePreference::Any))
        }
        RendererChoice::Auto => Renderer::open(DevicePreference::Any),
    }?;
    if renderer.info().software && !config.allow_software {
        let reason =
            format!("expected a GPU because software renderers are not allowed, got {}", renderer.info().renderer);
        return Err(renderer_unavailable(&reason, "Install the GPU's EGL driver or allow software"));
    }
    Ok(renderer)
}
