//! Selects the rasterizer of each pass: OpenGL, or a compute rasterizer that gets the same mesh.
//!
//! The compute rasterizer writes into OpenGL buffers: depth for the blur, and visibility keys that a compute pass
//! converts to ids. All later passes are the same. A scene whose look does not ask for a compute rasterizer has none of
//! these resources.

mod mesh;
mod trial;

use std::cell::{Cell, RefCell};
use std::rc::Rc;

use super::frame::{camera_clip, map_clip};
use super::gl::{self, Buffer, Gl, Program};
use super::scene_buffers::SceneBuffers;
use super::shaders::TILE;
use super::target::Target;
use super::{Ran, Renderer, Shot};
use modalcast_model::error::{Error, Result, during};
use modalcast_model::raster::{GlBuffer, Mesh, Rasteriser};
use modalcast_model::scene::{Scene, Window};

/// A rasterizer that can draw a pass.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Path {
    OpenGl,
    Cuda,
}

/// The rasterizers of a frame's passes; none where the frame has no such pass.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, serde::Serialize)]
pub struct Paths {
    pub shadow: Option<Path>,
    pub visibility: Option<Path>,
}

/// A compute rasterizer and its output buffers.
#[derive(Debug)]
pub(super) struct Beside {
    // Declared before the buffers that it has registered, so that it is dropped first.
    rasteriser: RefCell<Box<dyn Rasteriser>>,
    shadow: Option<Depths>,
    visibility: Option<Keys>,
    /// Whether it draws the shadow map and the visibility.
    draws: Cell<[bool; 2]>,
}

/// Depth output of the shadow map.
#[derive(Debug)]
struct Depths {
    buffer: Buffer,
    /// The first pass of the blur, reading `buffer`.
    blur: Rc<Program>,
}

/// Visibility output.
#[derive(Debug)]
struct Keys {
    /// Sized for the largest frame so far.
    buffer: RefCell<Option<Buffer>>,
    unpack: Rc<Program>,
}

/// Bytes of a key.
const KEY: u64 = 8;

impl Path {
    /// Name in looks and on the wire.
    pub const fn name(self) -> &'static str {
        match self {
            Self::OpenGl => "opengl",
            Self::Cuda => "cuda",
        }
    }
}

/// Whether a compute rasterizer may draw the shadow map and the visibility. The shadow map must have moments and only
/// one cascade. Frames must have one sample per pixel and no blended triangles, which are tested against depth.
fn allowed(scene: &Scene) -> [bool; 2] {
    let look = &scene.look;
    let shadow = look.shadow.is_some_and(|shadow| shadow.has_moments() && shadow.splits == 1);
    let triangles = scene.layout.triangles > 0;
    [triangles && shadow, triangles && look.samples_a_pixel() == 1 && !scene.needs.blend]
}

impl Renderer {
    /// Attaches a compute rasterizer to a scene; `make` creates it from the scene's mesh. It draws the passes that it
    /// supports from now on. Nothing is created for a scene without such passes.
    ///
    /// # Errors
    /// Those of `make` and of [`Rasteriser::make_ready`], and `Fault` of OpenGL; OpenGL then still draws the scene.
    pub fn draw_beside(
        &mut self,
        buffers: &mut SceneBuffers,
        make: impl FnOnce(Mesh) -> Result<Box<dyn Rasteriser>>,
    ) -> Result<()> {
        let [shadow, visibility] = allowed(&buffers.scene);
        if !shadow && !visibility {
            return Ok(());
        }
        let size = buffers.scene.look.shadow.map_or(0, |shadow| u64::from(shadow.size));
        let shadow = match buffers.options().blur_of_buffer().filter(|_| shadow) {
            Some(source) => {
                let buffer = self.gl.buffer(4 * size * size, gl::STREAM_COPY, None)?;
                Some(Depths { buffer, blur: self.program(source)? })
            }
            None => None,
        };
        let visibility = match visibility {
            true => Some(Keys { buffer: RefCell::default(), unpack: self.program(buffers.options().unpack())? }),
            false => None,
        };
        let draws = Cell::new([shadow.is_some(), visibility.is_some()]);
        let mut rasteriser = make(mesh::of(buffers, self.gl.limits.anisotropy)?)?;
        rasteriser.make_ready(shadow.is_some(), visibility.is_some())?;
        buffers.beside = Some(Beside { rasteriser: RefCell::new(rasteriser), shadow, visibility, draws });
        Ok(())
    }
}

impl SceneBuffers {
    /// The compute rasterizer, and whether it draws the shadow map and the visibility. None where OpenGL draws both, as
    /// in rebased scenes: the rasterizer has registered the shared positions only.
    pub(super) fn drawn_beside(&self) -> Option<(&Beside, [bool; 2])> {
        let beside = self.beside.as_ref().filter(|_| self.apart.is_none())?;
        let draws = beside.draws.get();
        draws.contains(&true).then_some((beside, draws))
    }

    /// The compute rasterizer if it draws the depth of the shadow map.
    pub(super) fn shadow_beside(&self) -> Option<&Beside> {
        self.drawn_beside().filter(|(_, draws)| draws[0]).map(|(beside, _)| beside)
    }
}

impl Beside {
    /// Draws the requested outputs of this frame into the buffers.
    pub(super) fn draw(
        &self,
        gl: &Rc<Gl>,
        (buffers, shot): (&SceneBuffers, &Shot),
        [shadow, visibility]: [bool; 2],
        ran: &mut Ran,
    ) -> Result<()> {
        let (scene, origin) = (&buffers.scene, buffers.origin);
        let side = scene.look.shadow.map_or(1, |shadow| shadow.size);
        let map = || Window::new(&map_clip(scene, shot, origin), side, side);
        let map = if shadow { Some(map()?) } else { None };
        let frame = Window::new(&camera_clip(scene, shot, origin), shot.width, shot.height)?;
        let depth = self.shadow.as_ref().zip(map.as_ref()).map(|(depths, map)| (map, of(&depths.buffer)));
        let keys = self.visibility.as_ref().filter(|_| visibility);
        let replaced = keys.map(|keys| keys.make_room(gl, KEY * frame.pixels() as u64)).transpose()?.flatten();
        if let Some(replaced) = replaced {
            self.rasteriser.borrow_mut().forget(replaced.name());
        }
        let into = keys.and_then(|keys| keys.buffer.borrow().as_ref().map(of));
        self.rasteriser.borrow_mut().draw(depth, into.map(|into| (&frame, into)))?;
        ran.passes.push(if depth.is_some() { "raster" } else { "ids" });
        ran.paths.shadow = depth.map(|_| Path::Cuda);
        ran.paths.visibility = into.map(|_| Path::Cuda);
        Ok(())
    }

    /// Disables the compute rasterizer after an error; OpenGL draws the scene from now on.
    pub(super) fn give_up(&self, error: &Error) {
        tracing::warn!(%error, "OpenGL draws from now on: the rasteriser beside it failed");
        self.draws.set([false; 2]);
    }

    /// Input buffer and program of the first blur pass.
    pub(super) fn blur(&self) -> Option<(&Buffer, &Program)> {
        self.shadow.as_ref().map(|depths| (&depths.buffer, depths.blur.as_ref()))
    }

    /// Converts the keys to the ids that the camera sees, including the ground.
    pub(super) fn unpack(&self, gl: &Gl, target: &Target, ran: &mut Ran) -> Result<()> {
        let missing = || during("unpack")("no keys were drawn");
        let keys = self.visibility.as_ref().ok_or_else(missing)?;
        keys.unpack.bind(None);
        keys.buffer.borrow().as_ref().ok_or_else(missing)?.bind_storage(0);
        target.ids.bind_image(0);
        target.touched.ids.everywhere();
        gl.dispatch(target.form.width.div_ceil(TILE), target.form.height.div_ceil(TILE));
        ran.passes.push("unpack");
        gl.check("unpack")
    }

    /// Buffers that it holds, by name and bytes.
    pub(super) fn allocated(&self) -> impl Iterator<Item = (&'static str, u64)> {
        let keys = self.visibility.as_ref().and_then(|keys| keys.buffer.borrow().as_ref().map(|buffer| buffer.bytes));
        let depths = self.shadow.as_ref().map(|depths| depths.buffer.bytes);
        [("shadow depths", depths), ("keys", keys)].into_iter().filter_map(|(name, bytes)| Some((name, bytes?)))
    }
}

impl Keys {
    /// Grows the buffer to at least `bytes` bytes and returns the buffer that was replaced, if any.
    fn make_room(&self, gl: &Rc<Gl>, bytes: u64) -> Result<Option<Buffer>> {
        let mut buffer = self.buffer.borrow_mut();
        if buffer.as_ref().is_some_and(|buffer| buffer.bytes >= bytes) {
            return Ok(None);
        }
        Ok(buffer.replace(gl.buffer(bytes, gl::STREAM_COPY, None)?))
    }
}

fn of(buffer: &Buffer) -> GlBuffer {
    GlBuffer { name: buffer.name(), bytes: buffer.bytes }
}
