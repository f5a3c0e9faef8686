//! The renderer: an OpenGL context, its caches, and the calls that load scenes and draw them.

mod autotune;
mod frame;
mod frame_readback;
mod frame_steps;
mod partial_frame;
mod pending_frame;
mod preparation;
mod shared_raster;

#[cfg(test)]
mod band_tests;
#[cfg(test)]
mod cull_tests;
#[cfg(test)]
mod oit_tests;
#[cfg(test)]
mod tests;

use std::num::NonZero;
use std::rc::Rc;
use std::sync::Arc;
use std::time::{Duration, Instant};

use rayon::{ThreadPool, ThreadPoolBuilder};

pub use self::autotune::TrialScene;
pub use self::partial_frame::PartialFrame;
pub use self::pending_frame::{EncodedPng, FramePixels, HeldPixels, MappedPixels, PendingFrame};
pub use self::preparation::ScenePreparation;
use crate::device::readback_ring::ReadbackRing;
use crate::device::{self, gl, gl::Gl};
use crate::passes::aov::{Aov, AovImage, AovReader, OutputLimits, PartialAov};
use crate::passes::picking::{PendingPick, PickHit, Picker};
use crate::passes::{PassRecorder, readback};
use crate::pieces::PieceLimits;
use crate::region::BandLimit;
use crate::resources::compute_rasterizer::RasterPasses;
use crate::resources::programs::ProgramCache;
use crate::resources::scene_buffers::{RebasedPositions, SceneBuffers, VertexValues, antialiasing};
use crate::resources::target::RenderTarget;
use crate::resources::target_desc::{TargetDesc, sample_positions};
use crate::shaders;
use crate::types::{BlurMethod, DevicePreference, FrameParams, FrameStats, PixelReadback, RendererInfo, VisibilityId};
use crate::uniforms::frame::FrameUniforms;
use modalcast_model::deform::DeformedSurface;
use modalcast_model::error::{Result, fault, fault_in, invalid};
use modalcast_model::fault_injection::{self, InjectionPoint};
use modalcast_model::memory::{MemoryBudget, MemoryKind, MemoryReservation};
use modalcast_model::raster::{RasterGeometry, Rasterizer};
use modalcast_model::scene::{PixelRect, Scene};
use modalcast_model::shared_memory::PictureMemory;

/// Maximum width and height of a frame in pixels, also on devices that support more.
const MAX_SIDE: u32 = 8192;
/// Maximum number of cached render targets.
const MAX_TARGETS: usize = 4;
/// Maximum time that dropping a renderer waits for each thread that still copies pixels.
const READER_TIMEOUT: Duration = Duration::from_secs(1);
/// The most that hardware draws without a break: a frame of 3840 x 2160 pixels with four samples each. The cost of
/// drawing is that of the samples, and the cost of page-locked memory for the readback that of the pixels.
const HARDWARE_BAND_LIMIT: BandLimit = BandLimit { max_pixels: 1 << 23, max_samples: 1 << 25 };
/// The most that a software renderer draws without a break: a frame of 1920 x 1080 pixels. Most of the cost is that of
/// shading each pixel once.
const SOFTWARE_BAND_LIMIT: BandLimit = BandLimit { max_pixels: 1 << 21, max_samples: u64::MAX };
/// Time limit for one frame.
const FRAME_TIMEOUT: Duration = Duration::from_secs(60);

/// A headless OpenGL context with its cached programs and render targets. It is created, used and dropped on the device
/// thread.
#[derive(Debug)]
pub struct Renderer {
    info: RendererInfo,
    gl: Rc<Gl>,
    programs: ProgramCache,
    /// Sample positions within a pixel with four samples; empty on a device without 4x multisampling.
    sample_positions: Vec<[f32; 2]>,
    blur_method: BlurMethod,
    /// Allocates the memory of pictures that OpenGL shares with CUDA, after it has passed the check.
    picture_memory: Option<Rc<dyn PictureMemory>>,
    /// Cached render targets, least recently used first.
    targets: Vec<RenderTarget>,
    /// Limit on the memory of all targets, also of those that frames and AOVs own.
    target_budget: Arc<MemoryBudget>,
    stats: FrameStats,
    /// The last frame that was submitted without an error.
    last_frame: Option<LastFrame>,
    /// When the device finished the last frame whose times were read, by the device's clock.
    last_end_ns: u64,
    frame_timeout: Duration,
    output_limits: OutputLimits,
    /// Staging buffers of frames that are copied to the host band by band.
    band_ring: Rc<ReadbackRing>,
    /// Threads that compute mipmap levels: few, because they compete with the threads of a software renderer and with
    /// the deformer.
    preparation_pool: ThreadPool,
    /// Scenes that are prepared and not loaded yet.
    prepared_scenes: Vec<preparation::PreparedScene>,
    picker: Picker,
    aov_reader: AovReader,
    /// The pass in which a test makes every frame panic.
    #[cfg(test)]
    injected_panic: Option<crate::pass::Pass>,
}

/// The last submitted frame. The cached render target with `desc` contains its ids.
#[derive(Debug)]
struct LastFrame {
    desc: TargetDesc,
    uniforms: FrameUniforms,
}

impl Renderer {
    /// Creates a surfaceless context and makes it current on this thread.
    ///
    /// On a GPU, a process should have one renderer at a time: on an H200 with driver 580.159, 25 of 30 frames in
    /// flight had wrong pixels, in every run, while other threads of the process had contexts. With one context in each
    /// of four processes, all frames were right.
    ///
    /// # Errors
    /// `Unavailable` with the name of the missing library or vendor file.
    pub fn open(preference: DevicePreference) -> Result<Self> {
        let (gl, cuda_device) = device::open(preference)?;
        Self::new(gl, cuda_device)
    }

    fn new(gl: Rc<Gl>, cuda_device: Option<i32>) -> Result<Self> {
        let info = RendererInfo {
            renderer: gl.limits.renderer.clone(),
            version: gl.limits.version.clone(),
            software: gl.limits.software,
            cuda_device,
            max_side: gl.limits.max_side.min(MAX_SIDE),
            pixel_readback: PixelReadback::PixelBuffer("CUDA is not used".into()),
        };
        let cores = std::thread::available_parallelism().map_or(1, NonZero::get);
        let preparation_pool = ThreadPoolBuilder::new()
            .num_threads((cores / 2).max(1))
            .thread_name(|index| format!("textures {index}"))
            .build()
            .map_err(fault_in("threads that compute mipmap levels"))?;
        Ok(Self {
            preparation_pool,
            prepared_scenes: Vec::new(),
            info,
            programs: ProgramCache::new(&gl),
            sample_positions: sample_positions(&gl)?,
            blur_method: BlurMethod::default(),
            picture_memory: None,
            targets: Vec::new(),
            target_budget: MemoryBudget::new(MemoryKind::RenderTargets, u64::MAX, u64::MAX),
            stats: FrameStats::default(),
            last_frame: None,
            last_end_ns: 0,
            frame_timeout: FRAME_TIMEOUT,
            output_limits: match gl.limits.software {
                true => OutputLimits { bands: SOFTWARE_BAND_LIMIT, pieces: PieceLimits::SOFTWARE },
                false => OutputLimits { bands: HARDWARE_BAND_LIMIT, pieces: PieceLimits::HARDWARE },
            },
            band_ring: ReadbackRing::new(&gl, frame_readback::BAND_STAGING_BYTES, None),
            picker: Picker::new(&gl),
            aov_reader: AovReader::new(&gl),
            #[cfg(test)]
            injected_panic: None,
            gl,
        })
    }

    /// The OpenGL device and driver.
    pub const fn info(&self) -> &RendererInfo {
        &self.info
    }

    /// Statistics of the last frame whose pixels were read or mapped.
    pub const fn stats(&self) -> &FrameStats {
        &self.stats
    }

    /// Draws later frames into memory of CUDA, whose copy engine moves the pixels to the host. Before that, checks that
    /// both APIs see what the other one writes. If the check fails, logs the reason, and OpenGL copies the pixels.
    /// [`RendererInfo::pixel_readback`] holds the result.
    ///
    /// # Errors
    /// `RendererLost`, `DeviceLost`.
    pub fn share_pictures(&mut self, picture_memory: Rc<dyn PictureMemory>) -> Result<()> {
        self.info.pixel_readback = match self.check_picture_memory(picture_memory.as_ref()) {
            Ok(()) => {
                // Targets with staging buffers.
                self.targets.clear();
                self.picture_memory = Some(picture_memory);
                PixelReadback::CopyEngine
            }
            Err(lost) if lost.is_loss() => return Err(lost),
            Err(error) => {
                tracing::warn!(%error, "OpenGL copies the pixels: no memory that CUDA and OpenGL share");
                PixelReadback::PixelBuffer(error.to_string())
            }
        };
        Ok(())
    }

    fn check_picture_memory(&self, picture_memory: &dyn PictureMemory) -> Result<()> {
        if self.info.cuda_device.is_none() {
            return Err(fault("shared memory", format!("{} is not a CUDA device", self.info.renderer)));
        }
        let _current = self.gl.make_current()?;
        gl::check_sharing(&self.gl, picture_memory)
    }

    /// Selects the implementation of the shadow blur for all scenes that are loaded after this call.
    pub fn set_blur_method(&mut self, method: BlurMethod) {
        self.blur_method = method;
    }

    /// Limits the memory of render targets. Without this call, it is unlimited.
    pub fn set_target_budget(&mut self, target_budget: Arc<MemoryBudget>) {
        self.target_budget = target_budget;
    }

    /// Sets the maximum number of samples (pixels times samples per pixel) that are drawn without a break. Larger
    /// frames and AOVs are divided into bands of rows. The pixels do not depend on the bands. By default, hardware
    /// draws 2^25 samples and 2^23 pixels without a break, and a software renderer 2^21 pixels.
    pub fn set_max_band_samples(&mut self, max_band_samples: u64) {
        self.output_limits.bands = BandLimit { max_pixels: u64::MAX, max_samples: max_band_samples };
    }

    /// Sets the time in milliseconds of a piece of a long output, and the maximum samples of a piece if each of its
    /// triangles covers its whole image. The pixels do not depend on the pieces. By default, a piece takes about 50 ms on
    /// hardware and 500 ms on a software renderer.
    pub fn set_piece_limits(&mut self, target_ms: f64, max_samples: u64) {
        self.output_limits.pieces = PieceLimits { target_ms, first_samples: max_samples, max_samples };
    }

    /// Whether an output of this size is divided into bands.
    pub fn is_divided(&self, scene: &Scene, size: [u32; 2]) -> bool {
        let samples = antialiasing(scene, self.gl.limits.renderer_kind(), size, None).samples;
        self.exceeds_band_limit(size, TargetDesc::ids_and_depth(&self.gl, size, samples).samples)
    }

    fn exceeds_band_limit(&self, [width, height]: [u32; 2], samples: u32) -> bool {
        u64::from(width) * u64::from(height) > self.output_limits.bands.max_pixels(samples)
    }

    /// Uploads the static data of a scene and allocates the buffers of the deformed data.
    ///
    /// # Errors
    /// `Invalid` if the scene exceeds a limit of the device; `Fault` if a shader or a buffer cannot be created.
    pub fn load(&mut self, scene: &Arc<Scene>) -> Result<SceneBuffers> {
        let _current = self.gl.make_current()?;
        let textures = self.textures_of(scene)?;
        let compile = &mut |source| self.programs.program(source);
        let mut buffers =
            SceneBuffers::new(&self.gl, scene, &self.sample_positions, self.blur_method, textures, compile)?;
        if self.picture_memory.is_some() {
            buffers.enable_vertex_import(&self.gl, self.programs.program(shaders::copy_words())?);
        }
        self.gl.check("load").map(|()| buffers)
    }

    /// Frees a scene's buffers.
    pub fn unload(&mut self, buffers: SceneBuffers) {
        let _current = self.gl.make_current();
        drop(buffers);
    }

    /// Uploads a deformed surface from host memory into the vertex buffers, which a deformer on the device can write
    /// instead ([`SceneBuffers::vertex_buffers`]).
    ///
    /// # Errors
    /// `Fault` if the length of an array differs from its buffer, or OpenGL reports an error.
    pub fn upload(&mut self, buffers: &SceneBuffers, surface: &DeformedSurface) -> Result<()> {
        let _current = self.gl.make_current()?;
        buffers.shadow_cache.invalidate();
        if let Some(rasterizer) = &buffers.compute_rasterizer {
            rasterizer.release_shared(&self.gl)?;
        }
        let geometry = &buffers.geometry;
        let attributes = [
            ("positions", Some(&geometry.positions), &surface.positions),
            ("normals", Some(&geometry.normals), &surface.normals),
            ("tangents", geometry.tangents.as_ref(), &surface.tangents),
        ];
        for (name, buffer, numbers) in attributes {
            let Some(buffer) = buffer else { continue };
            check_length(name, numbers, buffer.bytes / 4)?;
            buffer.write(bytemuck::cast_slice(numbers));
        }
        self.gl.check("upload")
    }

    /// Uploads positions relative to one `origin`, which is in scene units from the scene's origin. They are drawn
    /// instead of the shared positions (those in [`SceneBuffers::vertex_buffers`]) until the next
    /// [`SceneBuffers::set_shared_origin`]. This is for scenes in which each domain has a local origin, so that the
    /// shared positions have no common origin.
    ///
    /// # Errors
    /// `Fault` if the number of positions is wrong, or OpenGL reports an error.
    pub fn upload_rebased(&mut self, buffers: &mut SceneBuffers, positions: &[f32], origin: [f64; 3]) -> Result<()> {
        let _current = self.gl.make_current()?;
        check_length("positions", positions, buffers.geometry.positions.bytes / 4)?;
        let rebased = match buffers.rebased.take() {
            Some(rebased) => rebased,
            None => RebasedPositions::new(&self.gl, buffers)?,
        };
        buffers.shadow_cache.invalidate();
        rebased.buffer.write(bytemuck::cast_slice(positions));
        buffers.rebased = Some(rebased);
        buffers.origin = origin;
        self.gl.check("upload")
    }

    /// Uploads a scalar per vertex, in the vertex order of the scene's layout, for readbacks of [`Aov::Values`].
    ///
    /// # Errors
    /// `Fault` if the number of values is wrong, or OpenGL reports an error.
    pub fn upload_vertex_values(&mut self, buffers: &mut SceneBuffers, values: &[f32]) -> Result<()> {
        let _current = self.gl.make_current()?;
        let count = buffers.scene.layout.vertices;
        check_length("values", values, count as u64)?;
        let vertex_values = match buffers.values.take() {
            Some(vertex_values) => vertex_values,
            None => {
                let buffer = self.gl.buffer(4 * count as u64, gl::DYNAMIC_DRAW, None)?;
                VertexValues { view: self.gl.buffer_texture(&buffer, gl::R32F)?, buffer }
            }
        };
        vertex_values.buffer.write(bytemuck::cast_slice(values));
        buffers.values = Some(vertex_values);
        self.gl.check("upload")
    }

    /// Attaches a compute rasterizer to a scene, which draws all passes that it supports. Does nothing for a scene
    /// without such passes.
    ///
    /// # Errors
    /// Errors of `create_rasterizer` and [`Rasterizer::precompile`], and `Fault` of OpenGL. OpenGL then draws all
    /// passes.
    pub fn attach_rasterizer(
        &mut self,
        buffers: &mut SceneBuffers,
        create_rasterizer: impl FnOnce(RasterGeometry) -> Result<Box<dyn Rasterizer>>,
    ) -> Result<()> {
        self.attach_rasterizer_for(RasterPasses::ALL, buffers, create_rasterizer)
    }

    /// [`Self::attach_rasterizer`], but the compute rasterizer draws the shadow map only.
    ///
    /// # Errors
    /// As [`Self::attach_rasterizer`].
    pub fn attach_shadow_rasterizer(
        &mut self,
        buffers: &mut SceneBuffers,
        create_rasterizer: impl FnOnce(RasterGeometry) -> Result<Box<dyn Rasterizer>>,
    ) -> Result<()> {
        self.attach_rasterizer_for(RasterPasses::SHADOW, buffers, create_rasterizer)
    }

    fn attach_rasterizer_for(
        &mut self,
        passes: RasterPasses,
        buffers: &mut SceneBuffers,
        create_rasterizer: impl FnOnce(RasterGeometry) -> Result<Box<dyn Rasterizer>>,
    ) -> Result<()> {
        let _current = self.gl.make_current()?;
        let compile = &mut |source| self.programs.program(source);
        buffers.attach_rasterizer(&self.gl, &self.target_budget, compile, passes, create_rasterizer)
    }

    /// Begins a pick in a rectangle of the frame that `params` describes, without waiting for the device.
    ///
    /// # Errors
    /// `Invalid` for a camera whose matrices overflow; `Fault` if OpenGL reports an error.
    pub fn begin_pick(
        &mut self,
        buffers: &SceneBuffers,
        params: &FrameParams,
        rectangle: PixelRect,
    ) -> Result<PendingPick> {
        let _current = self.gl.make_current()?;
        self.picker.begin(&mut self.programs, buffers, params, rectangle)
    }

    /// Waits for a pick and returns its hits row by row. Pixels without a triangle have no entry.
    ///
    /// # Errors
    /// `Fault` if the device does not finish in time.
    pub fn finish_pick(&mut self, pick: PendingPick) -> Result<Vec<PickHit>> {
        let _current = self.gl.make_current()?;
        self.picker.finish(pick, self.frame_timeout)
    }

    /// Reads an AOV field for the current content of the scene's buffers. Depth, domains and normals are sampled at
    /// pixel centers.
    ///
    /// # Errors
    /// `Invalid` for a size above the limit or a camera whose matrices overflow; `Fault` if no values were uploaded,
    /// OpenGL reports an error or the device does not finish in time.
    pub fn render_aov(&mut self, buffers: &SceneBuffers, params: &FrameParams, field: Aov) -> Result<AovImage> {
        let mut partial_aov = self.begin_aov(buffers, params, field)?;
        while !partial_aov.is_submitted() {
            self.submit_aov_piece(buffers, &mut partial_aov)?;
        }
        self.finish_aov(buffers, partial_aov)
    }

    /// Begins to read an AOV field in pieces. The scene's buffers must not change until it is finished.
    ///
    /// # Errors
    /// `Invalid` for a size above the limit or a camera whose matrices overflow; `OutOfMemory`; `Fault` if no values
    /// were uploaded or OpenGL reports an error.
    pub fn begin_aov(&mut self, buffers: &SceneBuffers, params: &FrameParams, field: Aov) -> Result<PartialAov> {
        let _current = self.gl.make_current()?;
        self.check_size(params)?;
        let reserve = |desc, bytes| reserve_target(&self.target_budget, &mut self.targets, desc, bytes);
        self.aov_reader.begin(&mut self.programs, buffers, params, field, self.output_limits, reserve)
    }

    /// Submits the next piece of an AOV field.
    ///
    /// # Errors
    /// `Fault` if OpenGL reports an error or a software renderer does not finish in time.
    pub fn submit_aov_piece(&mut self, buffers: &SceneBuffers, partial_aov: &mut PartialAov) -> Result<()> {
        let _current = self.gl.make_current()?;
        self.aov_reader.submit_piece(partial_aov, buffers, self.output_limits, self.frame_timeout)
    }

    /// Waits for an AOV field whose bands are all submitted.
    ///
    /// # Errors
    /// `Fault` if OpenGL reports an error or the device does not finish in time.
    pub fn finish_aov(&mut self, buffers: &SceneBuffers, partial_aov: PartialAov) -> Result<AovImage> {
        let _current = self.gl.make_current()?;
        self.aov_reader.finish(partial_aov, buffers, self.frame_timeout)
    }

    /// Reads the id of the first sample of each pixel of the last frame, top row first. The last frame is the last one
    /// that was submitted without an error.
    ///
    /// # Errors
    /// `Fault` if no frame was drawn, its images were freed, or the device does not finish in time.
    pub fn read_visibility(&mut self) -> Result<Vec<VisibilityId>> {
        let _current = self.gl.make_current()?;
        let no_frame = || fault("visibility readback", "no frame was drawn, or its images were freed");
        let frame = self.last_frame.as_ref().ok_or_else(no_frame)?;
        let program = self.programs.program(shaders::readback::visibility_readback(frame.desc.samples))?;
        let target = self.targets.iter().find(|target| target.desc == frame.desc).ok_or_else(no_frame)?;
        // Uses a temporary staging buffer, because the ring may be full of frames in flight.
        let bytes = target.desc.frame_bytes();
        let staging = self.gl.buffer(bytes, gl::STREAM_READ, None)?;
        let recorder = PassRecorder { gl: &self.gl, stats: &mut FrameStats::default() };
        readback::read_visibility(&recorder, target, &program, &staging)?;
        self.gl.wait("visibility readback", self.frame_timeout)?;
        let id_bytes = staging.read(bytes as usize)?;
        // The bytes are little-endian.
        let parse_id = |word: &[u8]| word.iter().rev().fold(0, |id, byte| id << 8 | u32::from(*byte));
        let sample_position = if frame.desc.samples > 1 { self.sample_positions[0] } else { [0.5; 2] };
        let size = [frame.desc.width, frame.desc.height];
        // The ground has no id. It is visible where the view ray of a sample without an id hits it.
        let sees_ground = |pixel: u32| frame.uniforms.ray_hits_ground(ndc_from_pixel(pixel, size, sample_position));
        let ids = id_bytes.chunks_exact(4).zip(0..).map(|(word, pixel)| match VisibilityId::from_id(parse_id(word)) {
            VisibilityId::Background if sees_ground(pixel) => VisibilityId::Ground,
            id => id,
        });
        Ok(ids.collect())
    }

    /// Fails if a side of the frame is 0 or above the limit.
    fn check_size(&self, params: &FrameParams) -> Result<()> {
        let limit = self.info.max_side;
        if [params.width, params.height].iter().all(|side| (1..=limit).contains(side)) {
            return Ok(());
        }
        let got = format!("{} x {}", params.width, params.height);
        Err(invalid("frame.size", format!("1 to {limit} pixels a side"), got))
    }

    /// Frees the render targets that no frame has used for the time `unused`. Mesa frees their memory only when the
    /// next frame binds other targets.
    ///
    /// # Errors
    /// `Fault` if the context cannot be made current.
    pub fn free_unused_targets(&mut self, unused: Duration) -> Result<()> {
        let _current = self.gl.make_current()?;
        self.targets.retain(|target| target.last_use.elapsed() < unused);
        self.aov_reader.free_unused_target(unused);
        if let Some(last_frame) = &self.last_frame
            && self.targets.iter().all(|target| target.desc != last_frame.desc)
        {
            self.last_frame = None;
        }
        Ok(())
    }

    /// Frees the memory into which the compute rasterizer of a scene draws, if no frame has used it for the time
    /// `unused`.
    ///
    /// # Errors
    /// `Fault` if the context cannot be made current.
    pub fn free_unused_samples(&mut self, buffers: &SceneBuffers, unused: Duration) -> Result<()> {
        let _current = self.gl.make_current()?;
        buffers.compute_rasterizer.iter().for_each(|rasterizer| rasterizer.free_unused(unused));
        Ok(())
    }

    /// Whether a render target is cached.
    pub const fn has_targets(&self) -> bool {
        !self.targets.is_empty() || self.aov_reader.has_target()
    }

    /// Moves the target with this description to the end of the cache. Creates it if it is not cached, after dropping
    /// the least recently used target of a full cache.
    fn ensure_target(&mut self, desc: TargetDesc) -> Result<()> {
        if let Some(index) = self.targets.iter().position(|target| target.desc == desc) {
            self.targets[index].last_use = Instant::now();
            self.targets[index..].rotate_left(1);
            return Ok(());
        }
        fault_injection::check(InjectionPoint::Target)?;
        if self.targets.len() >= MAX_TARGETS {
            self.targets.remove(0);
        }
        let memory = match reserve_target(&self.target_budget, &mut self.targets, desc, desc.bytes()) {
            Err(_) if self.aov_reader.has_target() => {
                self.aov_reader.free_target();
                reserve_target(&self.target_budget, &mut self.targets, desc, desc.bytes())
            }
            result => result,
        }?;
        self.targets.push(RenderTarget::new(&self.gl, desc, memory, self.picture_memory.clone())?);
        Ok(())
    }
}

/// Reserves the memory of a target. Drops the least recently used targets of the cache until it is available.
///
/// # Errors
/// `OutOfMemory` if the target is above the limit, or the targets of frames in progress leave too little.
fn reserve_target(
    budget: &Arc<MemoryBudget>,
    cached_targets: &mut Vec<RenderTarget>,
    desc: TargetDesc,
    bytes: u64,
) -> Result<Arc<MemoryReservation>> {
    let object = format!("a frame of {} x {} pixels", desc.width, desc.height);
    let memory = MemoryReservation::new(budget);
    loop {
        match memory.reserve(&object, bytes) {
            Ok(()) => return Ok(memory),
            Err(_) if bytes <= budget.per_scene() && !cached_targets.is_empty() => drop(cached_targets.remove(0)),
            Err(error) => return Err(error),
        }
    }
}

/// Fails if an array to upload does not have the expected length.
fn check_length(name: &str, numbers: &[f32], expected: u64) -> Result<()> {
    if numbers.len() as u64 == expected {
        return Ok(());
    }
    Err(fault("upload", format!("expected {expected} numbers of {name}, got {}", numbers.len())))
}

/// Normalized device coordinates of a point in a pixel. `pixel` counts row by row from the top left. `sample_position`
/// is relative to the pixel's lower left corner, 0 to 1.
fn ndc_from_pixel(pixel: u32, [width, height]: [u32; 2], sample_position: [f32; 2]) -> [f64; 2] {
    let (column, row) = (pixel % width, height - 1 - pixel / width);
    let to_ndc = |coordinate: u32, offset: f32, side: u32| {
        2.0 * (f64::from(coordinate) + f64::from(offset)) / f64::from(side) - 1.0
    };
    [to_ndc(column, sample_position[0], width), to_ndc(row, sample_position[1], height)]
}

impl Drop for Renderer {
    fn drop(&mut self) {
        self.targets.clear();
        self.gl.free_retired_buffers(READER_TIMEOUT);
    }
}
