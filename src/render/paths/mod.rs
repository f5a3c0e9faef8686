//! Who turns triangles into samples, pass by pass: OpenGL, or a rasteriser beside it that is given the same mesh.
//!
//! The rasteriser writes into buffers of OpenGL: depth for the blur, and keys that a compute pass makes ids of. All that
//! follows is the same. A scene whose look does not ask for it has none of this.

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

/// Who drew a pass.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Path {
    OpenGl,
    Cuda,
}

/// Who drew the passes of a frame; none where a frame has no such pass.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, serde::Serialize)]
pub struct Paths {
    pub shadow: Option<Path>,
    pub visibility: Option<Path>,
}

/// A rasteriser beside OpenGL, and what it writes into.
#[derive(Debug)]
pub(super) struct Beside {
    // Before the buffers that it has registered.
    rasteriser: RefCell<Box<dyn Rasteriser>>,
    shadow: Option<Depths>,
    visibility: Option<Keys>,
    /// Which of both it is to draw.
    draws: Cell<[bool; 2]>,
}

/// Depth of the shadow map.
#[derive(Debug)]
struct Depths {
    buffer: Buffer,
    /// The first pass of the blur, reading that.
    blur: Rc<Program>,
}

/// What the camera sees.
#[derive(Debug)]
struct Keys {
    /// As large as the largest frame so far.
    buffer: RefCell<Option<Buffer>>,
    unpack: Rc<Program>,
}

/// Bytes of a key.
const KEY: u64 = 8;

impl Path {
    /// Its name in looks and on the wire.
    pub const fn name(self) -> &'static str {
        match self {
            Self::OpenGl => "opengl",
            Self::Cuda => "cuda",
        }
    }
}

/// Which of shadow map and visibility may be drawn beside OpenGL. A map whose depth is looked up itself, or that is split,
/// may not; nor may a frame of several samples a pixel, or one whose blended triangles are tested against depth.
fn allowed(scene: &Scene) -> [bool; 2] {
    let look = &scene.look;
    let shadow = look.shadow.is_some_and(|shadow| shadow.has_moments() && shadow.splits == 1);
    let triangles = scene.layout.triangles > 0;
    [triangles && shadow, triangles && look.samples_a_pixel() == 1 && !scene.needs.blend]
}

impl Renderer {
    /// Gives a scene a rasteriser beside OpenGL, which `make` makes of its mesh; it draws what it may from now on. Not made
    /// where it may draw nothing.
    ///
    /// # Errors
    /// Those of `make` and of [`Rasteriser::make_ready`], and `Fault` of OpenGL; the scene is then drawn by OpenGL as before.
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
    /// The rasteriser, and which of shadow map and visibility it draws: it knows the shared positions alone. None where OpenGL
    /// draws both.
    pub(super) fn drawn_beside(&self) -> Option<(&Beside, [bool; 2])> {
        let beside = self.beside.as_ref().filter(|_| self.apart.is_none())?;
        let draws = beside.draws.get();
        draws.contains(&true).then_some((beside, draws))
    }

    /// The rasteriser that draws the shadow map's depth; none where OpenGL does.
    pub(super) fn shadow_beside(&self) -> Option<&Beside> {
        self.drawn_beside().filter(|(_, draws)| draws[0]).map(|(beside, _)| beside)
    }
}

impl Beside {
    /// Draws into the buffers what of both is wanted of this frame.
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

    /// Leaves the scene to OpenGL from now on.
    pub(super) fn give_up(&self, error: &Error) {
        tracing::warn!(%error, "OpenGL draws from now on: the rasteriser beside it failed");
        self.draws.set([false; 2]);
    }

    /// What the first pass of the blur is to read, and by which program.
    pub(super) fn blur(&self) -> Option<(&Buffer, &Program)> {
        self.shadow.as_ref().map(|depths| (&depths.buffer, depths.blur.as_ref()))
    }

    /// Keys to the ids of what the camera sees, the ground too.
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
    /// Makes a buffer of so many bytes, unless there is one at least as large; the one that it replaces.
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
