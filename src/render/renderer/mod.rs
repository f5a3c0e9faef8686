//! The renderer: a context, its caches, and the calls that load scenes and draw them.

mod autotune;
mod frame;
mod pending_frame;

#[cfg(test)]
mod cull_tests;
#[cfg(test)]
mod oit_tests;
#[cfg(test)]
mod tests;

use std::rc::Rc;
use std::sync::Arc;
use std::time::Duration;

pub use self::pending_frame::{MappedPixels, PendingFrame};
use crate::device::{self, gl, gl::Gl};
use crate::passes::aov::{Aov, AovImage, AovReader};
use crate::passes::picking::{PendingPick, PickHit, Picker};
use crate::passes::{PassRecorder, readback};
use crate::resources::programs::ProgramCache;
use crate::resources::scene_buffers::{RebasedPositions, SceneBuffers, VertexValues};
use crate::resources::target::RenderTarget;
use crate::resources::target_desc::{TargetDesc, sample_positions};
use crate::shaders;
use crate::types::{BlurMethod, DevicePreference, FrameParams, FrameStats, RendererInfo, VisibilityId};
use crate::uniforms::frame::FrameUniforms;
use modalcast_model::deform::DeformedSurface;
use modalcast_model::error::{Result, fault_in, invalid};
use modalcast_model::raster::{RasterGeometry, Rasterizer};
use modalcast_model::scene::{PixelRect, Scene};

/// Longest side of a frame in pixels, even on devices that support more.
const MAX_SIDE: u32 = 8192;
/// Number of render targets that are cached, by frame form.
const MAX_TARGETS: usize = 4;
/// Maximum time that a dropped renderer waits for each thread that still copies pixels.
const READER_TIMEOUT: Duration = Duration::from_secs(1);
/// Time limit of the device for one frame.
const FRAME_TIMEOUT: Duration = Duration::from_secs(60);

/// A headless OpenGL context with its cached programs and render targets. It is created, used and dropped on the device
/// thread.
#[derive(Debug)]
pub struct Renderer {
    info: RendererInfo,
    gl: Rc<Gl>,
    programs: ProgramCache,
    sample_positions: Vec<[f32; 2]>,
    blur_method: BlurMethod,
    /// Least recently used first.
    targets: Vec<RenderTarget>,
    stats: FrameStats,
    /// The last frame that was submitted without an error.
    last_frame: Option<LastFrame>,
    frame_timeout: Duration,
    picker: Picker,
    aov_reader: AovReader,
}

/// A submitted frame whose ids the target of its form shows.
#[derive(Debug)]
struct LastFrame {
    desc: TargetDesc,
    uniforms: FrameUniforms,
}

impl Renderer {
    /// Creates a surfaceless context and makes it current on this thread.
    ///
    /// # Errors
    /// `Unavailable` with the name of the missing library or vendor file.
    pub fn open(prefer: DevicePreference) -> Result<Self> {
        let (gl, cuda_device) = device::open(prefer)?;
        Self::new(gl, cuda_device)
    }

    fn new(gl: Rc<Gl>, cuda_device: Option<i32>) -> Result<Self> {
        let info = RendererInfo {
            renderer: gl.limits.renderer.clone(),
            version: gl.limits.version.clone(),
            software: gl.limits.software,
            cuda_device,
            max_side: gl.limits.max_side.min(MAX_SIDE),
        };
        Ok(Self {
            info,
            programs: ProgramCache::new(&gl),
            sample_positions: sample_positions(&gl)?,
            blur_method: BlurMethod::default(),
            targets: Vec::new(),
            stats: FrameStats::default(),
            last_frame: None,
            frame_timeout: FRAME_TIMEOUT,
            picker: Picker::new(&gl),
            aov_reader: AovReader::new(&gl),
            gl,
        })
    }

    /// The OpenGL device and driver.
    pub const fn info(&self) -> &RendererInfo {
        &self.info
    }

    /// Statistics of the last frame that was collected.
    pub const fn stats(&self) -> &FrameStats {
        &self.stats
    }

    /// Selects the implementation of the shadow blur for all scenes that are loaded after this call.
    pub fn set_blur_method(&mut self, method: BlurMethod) {
        self.blur_method = method;
    }

    /// Uploads the static data of a scene and allocates the buffers of the deformed data.
    ///
    /// # Errors
    /// `Invalid` when the scene is over a limit of the device, `Fault` when a shader or a buffer is refused.
    pub fn load(&mut self, scene: &Arc<Scene>) -> Result<SceneBuffers> {
        let _current = self.gl.make_current()?;
        let compile = &mut |source| self.programs.program(source);
        let buffers = SceneBuffers::new(&self.gl, scene, &self.sample_positions, self.blur_method, compile)?;
        self.gl.check("load").map(|()| buffers)
    }

    /// Frees a scene's buffers.
    pub fn unload(&mut self, buffers: SceneBuffers) {
        let _current = self.gl.make_current();
        drop(buffers);
    }

    /// Uploads a deformed surface from host memory into the shared buffers.
    ///
    /// # Errors
    /// `Fault` when an array of the surface has another length than its buffer, or OpenGL reports an error.
    pub fn upload(&mut self, buffers: &SceneBuffers, surface: &DeformedSurface) -> Result<()> {
        let _current = self.gl.make_current()?;
        buffers.shadow_cache.invalidate();
        let geometry = &buffers.geometry;
        let attributes = [
            ("positions", Some(&geometry.positions), &surface.positions),
            ("normals", Some(&geometry.normals), &surface.normals),
            ("tangents", geometry.tangents.as_ref(), &surface.tangents),
        ];
        for (name, buffer, list) in attributes {
            let Some(buffer) = buffer else { continue };
            if 4 * list.len() as u64 != buffer.bytes {
                return Err(fault_in("upload")(format!(
                    "{} numbers of {name}, {} expected",
                    list.len(),
                    buffer.bytes / 4
                )));
            }
            buffer.write(bytemuck::cast_slice(list));
        }
        self.gl.check("upload")
    }

    /// Uploads positions that are drawn instead of the shared ones until the next [`SceneBuffers::set_origin`]. For
    /// scenes whose domains have separate local origins: the shared positions then have no common origin, and
    /// `positions` are rebased to `origin` (scene units, from the scene's origin).
    ///
    /// # Errors
    /// `Fault` when the number of positions differs from the scene's, or OpenGL reports an error.
    pub fn upload_rebased(&mut self, buffers: &mut SceneBuffers, positions: &[f32], origin: [f64; 3]) -> Result<()> {
        let _current = self.gl.make_current()?;
        let bytes = buffers.geometry.positions.bytes;
        if 4 * positions.len() as u64 != bytes {
            let given = format!("{} numbers of positions, {} expected", positions.len(), bytes / 4);
            return Err(fault_in("upload")(given));
        }
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
    /// `Fault` when the count differs from the scene's number of vertices, or OpenGL reports an error.
    pub fn upload_vertex_values(&mut self, buffers: &mut SceneBuffers, values: &[f32]) -> Result<()> {
        let _current = self.gl.make_current()?;
        let count = buffers.scene.layout.vertices;
        if values.len() != count {
            return Err(fault_in("upload")(format!("{} numbers of values, {count} expected", values.len())));
        }
        let held = match buffers.values.take() {
            Some(held) => held,
            None => {
                let buffer = self.gl.buffer(4 * count as u64, gl::DYNAMIC_DRAW, None)?;
                VertexValues { view: self.gl.buffer_texture(&buffer, gl::R32F)?, buffer }
            }
        };
        held.buffer.write(bytemuck::cast_slice(values));
        buffers.values = Some(held);
        self.gl.check("upload")
    }

    /// Attaches a compute rasterizer to a scene; `make` creates it from the scene's mesh. It draws the passes that it
    /// supports from now on. Nothing is created for a scene without such passes.
    ///
    /// # Errors
    /// Those of `make` and of [`Rasterizer::precompile`], and `Fault` of OpenGL; OpenGL then still draws the scene.
    pub fn attach_rasterizer(
        &mut self,
        buffers: &mut SceneBuffers,
        make: impl FnOnce(RasterGeometry) -> Result<Box<dyn Rasterizer>>,
    ) -> Result<()> {
        let _current = self.gl.make_current()?;
        buffers.attach_rasterizer(&self.gl, &mut |source| self.programs.program(source), make)
    }

    /// Begins a pick in a rectangle of the picture that `shot` describes, without waiting for the device.
    ///
    /// # Errors
    /// `Invalid` for a camera whose matrices overflow, `Fault` when OpenGL reports an error.
    pub fn begin_pick(
        &mut self,
        buffers: &SceneBuffers,
        shot: &FrameParams,
        rectangle: PixelRect,
    ) -> Result<PendingPick> {
        let _current = self.gl.make_current()?;
        self.picker.begin(&mut self.programs, buffers, shot, rectangle)
    }

    /// Waits for a pick and returns its hits row by row. Pixels without a triangle have no entry.
    ///
    /// # Errors
    /// `Fault` when the device does not finish in time.
    pub fn finish_pick(&mut self, pick: PendingPick) -> Result<Vec<PickHit>> {
        let _current = self.gl.make_current()?;
        self.picker.finish(pick, self.frame_timeout)
    }

    /// Reads a field for the current content of the shared buffers. Depth, domains and normals are sampled at pixel
    /// centers.
    ///
    /// # Errors
    /// `Invalid` for a size above the limit or a camera whose matrices overflow; `Fault` when no values were uploaded,
    /// OpenGL reports an error or the device does not finish in time.
    pub fn render_aov(&mut self, buffers: &SceneBuffers, shot: &FrameParams, field: Aov) -> Result<AovImage> {
        let _current = self.gl.make_current()?;
        self.check_size(shot)?;
        self.aov_reader.render(&mut self.programs, buffers, shot, field, self.frame_timeout)
    }

    /// Ids that the first sample of each pixel of the last frame sees, top row first. The last frame is the one that was
    /// submitted last without an error, even if other frames were collected since.
    ///
    /// # Errors
    /// `Fault` when no frame was drawn, its images were freed, or the device does not finish in time.
    pub fn read_visibility(&mut self) -> Result<Vec<VisibilityId>> {
        let _current = self.gl.make_current()?;
        let nothing = || fault_in("visibility readback")("no frame was drawn, or its images were freed");
        let last = self.last_frame.as_ref().ok_or_else(nothing)?;
        let program = self.programs.program(shaders::readback::visibility_readback(last.desc.samples))?;
        let target = self.targets.iter().find(|target| target.desc == last.desc).ok_or_else(nothing)?;
        // A temporary staging buffer, because the ring may be full of frames in flight.
        let bytes = target.desc.bytes();
        let staging = self.gl.buffer(bytes, gl::STREAM_READ, None)?;
        let recorder = PassRecorder { gl: &self.gl, stats: &mut FrameStats::default() };
        readback::read_visibility(&recorder, target, &program, &staging)?;
        self.gl.wait("visibility readback", self.frame_timeout)?;
        let words = staging.read(bytes as usize)?;
        let id = |word: &[u8]| word.iter().rev().fold(0, |id, byte| id << 8 | u32::from(*byte));
        let place = if last.desc.samples > 1 { self.sample_positions[0] } else { [0.5; 2] };
        let size = [last.desc.width, last.desc.height];
        let sees_ground = |pixel: u32| last.uniforms.ray_hits_ground(ndc_from_pixel(pixel, size, place));
        let seen = words.chunks_exact(4).zip(0..).map(|(word, pixel)| match VisibilityId::from_id(id(word)) {
            VisibilityId::Background if sees_ground(pixel) => VisibilityId::Ground,
            seen => seen,
        });
        Ok(seen.collect())
    }

    fn check_size(&self, shot: &FrameParams) -> Result<()> {
        let limit = self.info.max_side;
        if [shot.width, shot.height].iter().all(|side| (1..=limit).contains(side)) {
            return Ok(());
        }
        let given = format!("{} x {}", shot.width, shot.height);
        Err(invalid("frame.size", format!("1 to {limit} pixels a side"), given))
    }

    /// Moves the target of this form to the end of the cache, and creates it if it is not cached.
    fn ensure_target(&mut self, desc: TargetDesc) -> Result<()> {
        if let Some(at) = self.targets.iter().position(|target| target.desc == desc) {
            self.targets[at..].rotate_left(1);
            return Ok(());
        }
        if self.targets.len() >= MAX_TARGETS {
            self.targets.remove(0);
        }
        self.targets.push(RenderTarget::new(&self.gl, desc)?);
        Ok(())
    }
}

/// Normalized device coordinates of a point in a pixel. `pixel` counts from the top left; `place` is measured from the
/// pixel's lower left corner, 0 to 1.
fn ndc_from_pixel(pixel: u32, [width, height]: [u32; 2], place: [f32; 2]) -> [f64; 2] {
    let (column, row) = (pixel % width, height - 1 - pixel / width);
    let across = |at: u32, place: f32, side: u32| 2.0 * (f64::from(at) + f64::from(place)) / f64::from(side) - 1.0;
    [across(column, place[0], width), across(row, place[1], height)]
}

impl Drop for Renderer {
    fn drop(&mut self) {
        self.targets.clear();
        self.gl.free_retired_buffers(READER_TIMEOUT);
    }
}
