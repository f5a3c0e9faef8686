//! Headless OpenGL renderer: uploads a scene to the device, draws frames of it and reads their pixels back.
//!
//! | pass | what it does | runs when |
//! |---|---|---|
//! | raster | shadow depth, visibility or both, drawn by the compute rasterizer ([`RasterBackend`]) | the look asks for it |
//! | shadow cull | lists of the triangles that may appear in the shadow map (compute) | triangles are culled |
//! | shadow | depth as seen from the sun; cut-outs leave holes | the look has a shadow |
//! | blur | depth to moments, blurred in x and in y (compute) | the shadow is a variance map |
//! | occluders | depth of the triangles that the last frame saw, and its pyramid (compute) | hidden triangles are culled |
//! | cull | lists of the triangles that the camera may see (compute) | triangles are culled |
//! | visibility | triangle id and depth of each sample; masked materials discard | some triangle is not blended |
//! | unpack | keys of the compute rasterizer, and the ground, to ids (compute) | it drew the visibility |
//! | ground | id and depth of the ground | the look has a ground, the camera is above it, and something is below it |
//! | blended | light of translucent triangles over each other; no depth writes | two-pass transparency, some triangle is blended |
//! | count, scan, fill | a list of the blended fragments of each pixel | exact transparency, some triangle is blended |
//! | resolve | lists sorted by depth, shaded and blended (compute) | exact transparency, some triangle is blended |
//! | backdrop | shades tiles that see no opaque triangle; lists the other tiles (compute) | always |
//! | shade | Phong shading in the listed tiles; samples to pixels (compute) | some triangle is not blended |
//! | bloom | spreads bright light, then applies the tone curve (compute) | the look has a bloom |
//! | encode | linear light to sRGB bytes, top row first; smooths edges and dithers (compute) | always |
//!
//! Submitting a frame and collecting its pixels are separate calls, so that several frames can be in flight
//! ([`PendingFrame`]).
//!
//! Two outputs are drawn only on request, with programs and buffers that are created on first use: picking, which finds
//! the triangles at a few pixels ([`PendingPick`]), and AOV (arbitrary output variable) readbacks, which deliver numbers
//! instead of colors ([`AovImage`]).
//!
//! Shading is deferred: the rasterizer writes ids only, and each visible triangle is shaded once per pixel, whatever
//! lies behind it. Multisampled id buffers are not cleared; the depth buffer says which samples hold an id. A frame
//! draws only into the screen region that the bounds of the vertices can reach, and clears only the region that earlier
//! frames wrote.

#![cfg_attr(not(test), deny(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::print_stdout))]

mod aov;
mod cascades;
mod cull;
mod device;
mod frame_uniforms;
mod geometry;
mod light;
mod oit;
mod passes;
mod pick;
mod plan;
mod post;
mod programs;
mod raster_backends;
mod region;
mod scene_buffers;
mod shaders;
mod shadow;
mod submit;
mod target;
mod textures;
mod types;

use std::collections::HashMap;
use std::rc::Rc;
use std::sync::Arc;
use std::time::Duration;

pub use self::aov::{Aov, AovImage};
pub use self::device::{EglDevice, devices};
pub use self::frame_uniforms::{shadow_clip_from_world, shadow_texel_axes};
pub use self::pick::{PendingPick, PickHit};
pub use self::plan::{Allocation, OmittedFeature, RenderPlan, plan};
use self::scene_buffers::RebasedPositions;
pub use self::scene_buffers::SceneBuffers;
use self::shaders::ProgramSource;
pub use self::submit::{MappedPixels, PendingFrame};
use self::target::{RenderTarget, TargetDesc};
pub use self::types::{
    BlurMethod, CullStats, DevicePreference, FrameCullStats, FrameImage, FrameParams, FrameStats, OitStats,
    RasterBackend, RasterBackends, RendererInfo, VisibilityId,
};
use crate::device::gl::{self, Gl, Program};
pub use crate::device::readback_ring::MAX_FRAMES_IN_FLIGHT;
use modalcast_model::deform::DeformedSurface;
use modalcast_model::error::{Result, fault_in};
use modalcast_model::scene::Scene;

/// Longest side of a frame in pixels, even on devices that support more.
const MAX_SIDE: u32 = 8192;
/// Number of render targets that are cached, by frame form.
const MAX_TARGETS: usize = 4;
/// Number of programs that are cached across scenes.
const MAX_PROGRAMS: usize = 128;
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
    programs: HashMap<ProgramSource, Rc<Program>>,
    sample_positions: Vec<[f32; 2]>,
    blur_method: BlurMethod,
    /// Least recently used first.
    targets: Vec<RenderTarget>,
    stats: FrameStats,
    /// Uniforms of the last frame.
    last_uniforms: Option<frame_uniforms::FrameUniforms>,
    frame_timeout: Duration,
    /// Render target for picks; created by the first pick.
    pick_target: Option<pick::PickTarget>,
    /// Render target of the last AOV readback.
    aov_target: Option<aov::AovTarget>,
}

impl Renderer {
    /// Creates a surfaceless context and makes it current on this thread.
    ///
    /// # Errors
    /// `Unavailable` with the name of the missing library or vendor file.
    pub fn open(prefer: DevicePreference) -> Result<Self> {
        let (gl, cuda_device) = device::open(prefer)?;
        let info = RendererInfo {
            renderer: gl.limits.renderer.clone(),
            version: gl.limits.version.clone(),
            software: gl.limits.software,
            cuda_device,
            max_side: gl.limits.max_side.min(MAX_SIDE),
        };
        let sample_positions = target::sample_positions(&gl)?;
        Ok(Self {
            info,
            gl,
            programs: HashMap::new(),
            sample_positions,
            blur_method: BlurMethod::default(),
            targets: Vec::new(),
            stats: FrameStats::default(),
            last_uniforms: None,
            frame_timeout: FRAME_TIMEOUT,
            pick_target: None,
            aov_target: None,
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
        let (gl, places, blur_method) = (Rc::clone(&self.gl), self.sample_positions.clone(), self.blur_method);
        if self.programs.len() > MAX_PROGRAMS {
            self.programs.clear();
        }
        let compile: &mut programs::ProgramCompiler<'_> = &mut |source| self.program(source);
        let buffers = SceneBuffers::new(&gl, scene, &places, blur_method, compile)?;
        gl.check("load").map(|()| buffers)
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
        for (name, list) in
            [("positions", &surface.positions), ("normals", &surface.normals), ("tangents", &surface.tangents)]
        {
            let Some(buffer) = buffers.buffers.get(name) else { continue };
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
        let bytes = buffers.buffer("positions")?.bytes;
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

    /// Ids that the first sample of each pixel of the last frame sees, top row first.
    ///
    /// # Errors
    /// `Fault` when no frame was drawn, or the device does not finish in time.
    pub fn read_visibility(&mut self) -> Result<Vec<VisibilityId>> {
        let _current = self.gl.make_current()?;
        let nothing = || fault_in("visibility readback")("no frame was drawn");
        let samples = self.targets.last().ok_or_else(nothing)?.desc.samples;
        let program = self.program(shaders::visibility_readback(samples))?;
        let target = self.targets.last().ok_or_else(nothing)?;
        passes::resolve_ids(&self.gl, target, &program)?;
        // A temporary staging buffer, because the ring may be full of frames in flight.
        let bytes = target.desc.bytes();
        let staging = self.gl.buffer(bytes, gl::STREAM_READ, None)?;
        self.gl.copy(gl::BufferCopy::first(bytes, &target.readback_source, &staging));
        self.gl.wait("visibility readback", self.frame_timeout)?;
        let words = staging.read(bytes as usize)?;
        let id = |word: &[u8]| word.iter().rev().fold(0, |id, byte| id << 8 | u32::from(*byte));
        let place = if samples > 1 { self.sample_positions[0] } else { [0.5; 2] };
        let size = [target.desc.width, target.desc.height];
        let behind = |pixel: u32| {
            self.last_uniforms.is_some_and(|last| last.ray_hits_ground(ndc_from_pixel(pixel, size, place)))
        };
        let seen = words.chunks_exact(4).zip(0..).map(|(word, pixel)| match VisibilityId::from_id(id(word)) {
            VisibilityId::Background if behind(pixel) => VisibilityId::Ground,
            seen => seen,
        });
        Ok(seen.collect())
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

    fn program(&mut self, source: ProgramSource) -> Result<Rc<Program>> {
        if let Some(program) = self.programs.get(&source) {
            return Ok(Rc::clone(program));
        }
        let stages: Vec<(u32, &str)> = source.stages.iter().map(|(stage, text)| (*stage, text.as_str())).collect();
        let program = Rc::new(self.gl.program(&source.label, &stages)?);
        self.programs.insert(source, Rc::clone(&program));
        Ok(program)
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
