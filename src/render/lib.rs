//! Headless OpenGL: a scene's buffers, the passes that draw it, and the pixels back.
//!
//! | pass | what it does | runs when |
//! |---|---|---|
//! | raster | the shadow map's depth, what the camera sees, or both, by a rasteriser beside OpenGL ([`Path`]) | the look asks for it |
//! | shadow cull | lists of the triangles that the shadow map may show (compute) | triangles are culled |
//! | shadow | depth from the sun; cut-outs leave holes | the look has a shadow |
//! | blur | depth to moments, blurred in x and in y (compute) | that shadow is a variance map |
//! | occluders | depth of what the last frame saw, and its pyramid (compute) | hidden triangles are culled |
//! | cull | lists of the triangles that the camera may see (compute) | triangles are culled |
//! | visibility | which triangle each sample sees, and depth; mask discards | some triangle is not blended |
//! | unpack | in its place: what a rasteriser beside OpenGL saw, and the ground, to ids (compute) | that drew it |
//! | ground | the same of the ground | the look has a ground, the camera is above it, and something is below it |
//! | blended | light of the blended triangles over each other, no depth written | two passes, and some triangle is blended |
//! | count, scan, fill | lists of the blended fragments of each pixel | exact, and some triangle is blended |
//! | resolve | lists sorted by depth, shaded and blended (compute) | the same |
//! | backdrop | sky, ground (found here where it was not drawn) and blended layer to light, where no triangle is seen; lists the other tiles (compute) | always |
//! | shade | Phong and images too, in the listed tiles; samples to pixels (compute) | some triangle is not blended |
//! | bloom | bright light spreads, then the tone curve (compute) | the look has a bloom |
//! | encode | light to sRGB bytes, top row first; smooths edges and mixes levels (compute) | always |
//!
//! A frame is submitted and collected apart, so that others may be under way meanwhile ([`Ticket`]).
//!
//! Two things are drawn only when asked for, with programs and buffers made then: what a few pixels see ([`Pick`]), and
//! numbers in place of colours ([`Survey`]).
//!
//! A triangle is shaded once in each pixel where it is seen, whatever lies behind it; the rasteriser writes ids alone. Of
//! several samples a pixel these are never cleared: depth says where there is one. Of a frame no more is drawn into than the
//! bounds of the vertices can reach, and no more is cleared than earlier frames have.

#![cfg_attr(not(test), deny(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::print_stdout))]

mod cull;
mod device;
mod egl;
mod frame;
mod geometry;
mod gl;
mod light;
mod lists;
mod passes;
mod paths;
mod pick;
mod plan;
mod post;
mod programs;
mod region;
mod ring;
mod scene_buffers;
mod seen;
mod shaders;
mod shadow;
mod splits;
mod submit;
mod survey;
mod target;
mod textures;

use std::collections::HashMap;
use std::rc::Rc;
use std::sync::Arc;
use std::time::Duration;

pub use self::cull::{Culled, Sifted};
pub use self::device::{EglDevice, devices};
pub use self::frame::{shadow_clip, shadow_texel};
use self::gl::{Gl, Program};
pub use self::lists::Lists;
pub use self::paths::{Path, Paths};
pub use self::pick::{Hit, Pick};
pub use self::plan::{Allocation, Plan, Saving, plan};
pub use self::ring::FRAMES_UNDER_WAY;
use self::scene_buffers::Apart;
pub use self::scene_buffers::SceneBuffers;
pub use self::seen::Seen;
use self::shaders::Source;
pub use self::submit::{Pixels, Ticket};
pub use self::survey::{Field, Survey};
use self::target::{Form, Target};
use modalcast_model::deform::Surface;
use modalcast_model::error::{Result, during};
use modalcast_model::scene::{Bounds, Camera, LightBounds, Scene};

/// Which EGL device to draw on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Prefer {
    /// The device that is this CUDA device.
    Cuda(i32),
    /// Any hardware device, else Mesa's software rasteriser.
    Any,
    /// Mesa's software rasteriser.
    Software,
}

/// What draws.
#[derive(Debug, Clone, serde::Serialize)]
pub struct Info {
    /// GL_RENDERER.
    pub renderer: String,
    /// GL_VERSION.
    pub version: String,
    /// Whether it runs on the CPU.
    pub software: bool,
    /// The CUDA device that it is, by EGL_CUDA_DEVICE_NV.
    pub cuda_device: Option<i32>,
    /// The largest side of a frame, in pixels.
    pub max_side: u32,
}

/// One frame to be drawn of what the buffers hold.
#[derive(Debug, Clone, Copy)]
pub struct Shot {
    pub camera: Camera,
    pub width: u32,
    pub height: u32,
    /// Bounds that hold every deformed vertex: a frame shows nothing outside of them, unless they are not finite.
    pub bounds: Bounds,
    /// What the same vertices take up in light space, to which the shadow map is fitted; without it, to the corners of
    /// `bounds`.
    pub light: Option<LightBounds>,
}

/// RGBA8 sRGB pixels, top row first.
#[derive(Debug, Clone, PartialEq)]
pub struct Image {
    pub width: u32,
    pub height: u32,
    pub rgba: Vec<u8>,
    /// Milliseconds, by name: the stages "shadow", "draw" and "read", and the passes out of them: "raster" (of a rasteriser
    /// beside OpenGL; what the camera sees too, where it draws both) and "blur" of the shadow, "ids" (by that one alone),
    /// "cull" (of a culled scene, with the occluders), "visibility" (with the ground), "blended" (lists and all), "shade"
    /// (with the backdrop), "bloom" and "encode" of drawing.
    pub passes: Vec<(&'static str, f64)>,
    pub paths: Paths,
}

/// Names of the OpenGL buffers that a deformer may write in place of an upload.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SharedBuffers {
    /// 3 f32 per vertex.
    pub positions: u32,
    /// 3 f32 per corner.
    pub normals: u32,
    /// 4 f32 per corner, when the scene has normal maps.
    pub tangents: Option<u32>,
}

/// What the last frame really ran.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Ran {
    /// Passes, in order. Of several frames of one step the first alone has "shadow" and "blur", where they can be shared:
    /// see [`SceneBuffers::hold_step`].
    pub passes: Vec<&'static str>,
    /// Who drew the passes that turn triangles into samples.
    pub paths: Paths,
    /// Draw calls of the visibility and blended passes.
    pub draws: usize,
    /// Samples a pixel.
    pub samples: u32,
    /// Of exact transparency: how many fragments were blended, and whether all fitted.
    pub lists: Option<Lists>,
    /// What was left out before it was drawn, where triangles are culled.
    pub culled: Option<Culled>,
}

/// The largest side of a frame, whatever the device can do.
const MAX_SIDE: u32 = 8192;
/// Forms of frames whose images are kept.
const TARGETS: usize = 4;
/// Programs that are kept for scenes to come.
const PROGRAMS: usize = 128;
/// How long a renderer that goes waits for those who still copy pixels.
const LAST_READERS: Duration = Duration::from_secs(1);
/// How long the device may take for one frame.
const WATCHDOG: Duration = Duration::from_secs(60);

/// The EGL and OpenGL contexts. Lives and dies on the device thread.
#[derive(Debug)]
pub struct Renderer {
    info: Info,
    gl: Rc<Gl>,
    programs: HashMap<Source, Rc<Program>>,
    sample_places: Vec<[f32; 2]>,
    /// The most recently used last.
    targets: Vec<Target>,
    ran: Ran,
    /// Of the last frame.
    last: Option<frame::Frame>,
    watchdog: Duration,
    /// What picks are drawn into, once there was one.
    picker: Option<pick::Picker>,
    /// What the last survey was drawn into, once there was one.
    surveyor: Option<survey::Surveyor>,
}

impl Renderer {
    /// Opens a surfaceless context and makes it current on this thread.
    ///
    /// # Errors
    /// `Unavailable` naming the missing library or vendor file.
    pub fn open(prefer: Prefer) -> Result<Self> {
        let (gl, cuda_device) = device::open(prefer)?;
        let info = Info {
            renderer: gl.limits.renderer.clone(),
            version: gl.limits.version.clone(),
            software: gl.limits.software,
            cuda_device,
            max_side: gl.limits.max_side.min(MAX_SIDE),
        };
        let sample_places = target::sample_places(&gl)?;
        Ok(Self {
            info,
            gl,
            programs: HashMap::new(),
            sample_places,
            targets: Vec::new(),
            ran: Ran::default(),
            last: None,
            watchdog: WATCHDOG,
            picker: None,
            surveyor: None,
        })
    }

    /// What draws.
    pub const fn info(&self) -> &Info {
        &self.info
    }

    /// What the last frame really ran.
    pub const fn ran(&self) -> &Ran {
        &self.ran
    }

    /// Loads what never changes of a scene, and makes room for what does.
    ///
    /// # Errors
    /// `Invalid` when the scene is over a limit of the device, `Fault` when a shader or a buffer is refused.
    pub fn load(&mut self, scene: &Arc<Scene>) -> Result<SceneBuffers> {
        let (gl, places) = (Rc::clone(&self.gl), self.sample_places.clone());
        if self.programs.len() > PROGRAMS {
            self.programs.clear();
        }
        let compile: &mut programs::Compile<'_> = &mut |source| self.program(source);
        let buffers = SceneBuffers::new(&gl, scene, &places, compile)?;
        gl.check("load").map(|()| buffers)
    }

    /// Frees a scene's buffers.
    pub fn unload(&mut self, buffers: SceneBuffers) {
        // Makes this context current: a rasteriser beside it gives its buffers back to the current one.
        self.gl.check("unload").ok();
        drop(buffers);
    }

    /// Fills the shared buffers from host memory.
    ///
    /// # Errors
    /// `Fault` when the surface is not the scene's, or OpenGL reports an error.
    pub fn upload(&mut self, buffers: &SceneBuffers, surface: &Surface) -> Result<()> {
        buffers.shared_shadow.forget();
        for (name, list) in
            [("positions", &surface.positions), ("normals", &surface.normals), ("tangents", &surface.tangents)]
        {
            let Some(buffer) = buffers.buffers.get(name) else { continue };
            if 4 * list.len() as u64 != buffer.bytes {
                return Err(during("upload")(format!(
                    "{} numbers of {name}, {} expected",
                    list.len(),
                    buffer.bytes / 4
                )));
            }
            buffer.write(bytemuck::cast_slice(list));
        }
        self.gl.check("upload")
    }

    /// Fills positions that are drawn in place of the shared ones until [`SceneBuffers::relative_to`] says otherwise: for
    /// domains in cells of their own, whose shared positions have no common origin. `origin` is theirs.
    ///
    /// # Errors
    /// `Fault` when the positions are not the scene's, or OpenGL reports an error.
    pub fn upload_apart(&mut self, buffers: &mut SceneBuffers, positions: &[f32], origin: [f64; 3]) -> Result<()> {
        let bytes = buffers.buffer("positions")?.bytes;
        if 4 * positions.len() as u64 != bytes {
            let given = format!("{} numbers of positions, {} expected", positions.len(), bytes / 4);
            return Err(during("upload")(given));
        }
        let apart = match buffers.apart.take() {
            Some(apart) => apart,
            None => Apart::new(&self.gl, buffers)?,
        };
        buffers.shared_shadow.forget();
        apart.buffer.write(bytemuck::cast_slice(positions));
        buffers.apart = Some(apart);
        buffers.origin = origin;
        self.gl.check("upload")
    }

    /// What the first sample of each pixel of the last frame sees, top row first.
    ///
    /// # Errors
    /// `Fault` when no frame was drawn, or the device does not finish.
    pub fn seen(&mut self) -> Result<Vec<Seen>> {
        let nothing = || during("seen")("no frame was drawn");
        let samples = self.targets.last().ok_or_else(nothing)?.form.samples;
        let program = self.program(shaders::seen(samples))?;
        let target = self.targets.last().ok_or_else(nothing)?;
        passes::seen(&self.gl, target, &program)?;
        // Not by the ring, which may be full of frames under way.
        let bytes = target.form.bytes();
        let staging = self.gl.buffer(bytes, gl::STREAM_READ, None)?;
        self.gl.copy(&target.packed, &staging, bytes);
        self.gl.wait("seen", self.watchdog)?;
        let words = staging.read(bytes as usize)?;
        let id = |word: &[u8]| word.iter().rev().fold(0, |id, byte| id << 8 | u32::from(*byte));
        let place = if samples > 1 { self.sample_places[0] } else { [0.5; 2] };
        let size = [target.form.width, target.form.height];
        let behind = |pixel: u32| self.last.is_some_and(|last| last.meets_ground(image_place(pixel, size, place)));
        let seen = words.chunks_exact(4).zip(0..).map(|(word, pixel)| match Seen::from_id(id(word)) {
            Seen::Nothing if behind(pixel) => Seen::Ground,
            seen => seen,
        });
        Ok(seen.collect())
    }

    /// Puts the images for frames of this form last in the list, made if need be.
    fn make_room(&mut self, form: Form) -> Result<()> {
        if let Some(at) = self.targets.iter().position(|target| target.form == form) {
            self.targets[at..].rotate_left(1);
            return Ok(());
        }
        if self.targets.len() >= TARGETS {
            self.targets.remove(0);
        }
        self.targets.push(Target::new(&self.gl, form)?);
        Ok(())
    }

    fn program(&mut self, source: Source) -> Result<Rc<Program>> {
        if let Some(program) = self.programs.get(&source) {
            return Ok(Rc::clone(program));
        }
        let stages: Vec<(u32, &str)> = source.stages.iter().map(|(stage, text)| (*stage, text.as_str())).collect();
        let program = Rc::new(self.gl.program(&source.label, &stages)?);
        self.programs.insert(source, Rc::clone(&program));
        Ok(program)
    }
}

/// Normalised device coordinates of a place in a pixel, by the pixel's number from the top left on; the place is measured
/// from the pixel's lower left, 0 to 1.
fn image_place(pixel: u32, [width, height]: [u32; 2], place: [f32; 2]) -> [f64; 2] {
    let (column, row) = (pixel % width, height - 1 - pixel / width);
    let across = |at: u32, place: f32, side: u32| 2.0 * (f64::from(at) + f64::from(place)) / f64::from(side) - 1.0;
    [across(column, place[0], width), across(row, place[1], height)]
}

impl Drop for Renderer {
    fn drop(&mut self) {
        self.targets.clear();
        self.gl.bury(LAST_READERS);
    }
}
