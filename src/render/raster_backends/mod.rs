//! Selects the rasterizer of each pass: OpenGL, or a compute rasterizer that gets the same mesh.
//!
//! The compute rasterizer writes into OpenGL buffers: depth for the blur, and visibility keys that a compute pass
//! converts to ids. All later passes are the same. A scene whose look does not ask for a compute rasterizer has none of
//! these resources.

mod autotune;
mod mesh;

use std::cell::{Cell, RefCell};
use std::rc::Rc;

use super::Renderer;
use super::frame_uniforms::{clip_from_positions, shadow_clip_from_positions};
use super::scene_buffers::SceneBuffers;
use super::shaders::TILE;
use super::target::RenderTarget;
use crate::device::gl::{self, Buffer, Gl, Program};
use crate::types::{FrameParams, FrameStats, RasterBackend};
use modalcast_model::error::{Error, Result, fault_in};
use modalcast_model::raster::{GlBuffer, RasterGeometry, Rasterizer};
use modalcast_model::scene::{Scene, Viewport};

/// A compute rasterizer and its output buffers.
#[derive(Debug)]
pub(crate) struct ComputeRasterizer {
    /// Keeps handles to the buffers that it has registered.
    rasterizer: RefCell<Box<dyn Rasterizer>>,
    shadow: Option<ShadowDepths>,
    visibility: Option<VisibilityKeys>,
    /// Whether it draws the shadow map and the visibility.
    enabled: Cell<[bool; 2]>,
}

/// Depth output of the shadow map.
#[derive(Debug)]
struct ShadowDepths {
    buffer: Buffer,
    /// The first pass of the blur, reading `buffer`.
    blur: Rc<Program>,
}

/// Visibility output.
#[derive(Debug)]
struct VisibilityKeys {
    /// Sized for the largest frame so far.
    buffer: RefCell<Option<Buffer>>,
    unpack: Rc<Program>,
}

/// Bytes of a key.
const KEY_BYTES: u64 = 8;

/// Whether a compute rasterizer may draw the shadow map and the visibility. The shadow map must have moments and only
/// one cascade. Frames must have one sample per pixel and no blended triangles, which are tested against depth.
fn supported_passes(scene: &Scene) -> [bool; 2] {
    let look = &scene.look;
    let shadow = look.shadow.is_some_and(|shadow| shadow.has_moments() && shadow.splits == 1);
    let triangles = scene.layout.triangles > 0;
    [triangles && shadow, triangles && look.samples_per_pixel() == 1 && !scene.needs.blend]
}

impl Renderer {
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
        let [shadow, visibility] = supported_passes(&buffers.scene);
        if !shadow && !visibility {
            return Ok(());
        }
        let size = buffers.scene.look.shadow.map_or(0, |shadow| u64::from(shadow.size));
        let shadow = match buffers.options().blur_from_buffer().filter(|_| shadow) {
            Some(source) => {
                let buffer = self.gl.buffer(4 * size * size, gl::STREAM_COPY, None)?;
                Some(ShadowDepths { buffer, blur: self.program(source)? })
            }
            None => None,
        };
        let visibility = match visibility {
            true => {
                Some(VisibilityKeys { buffer: RefCell::default(), unpack: self.program(buffers.options().unpack())? })
            }
            false => None,
        };
        let enabled = Cell::new([shadow.is_some(), visibility.is_some()]);
        let mut rasterizer = make(mesh::of(buffers, self.gl.limits.anisotropy)?)?;
        rasterizer.precompile(shadow.is_some(), visibility.is_some())?;
        buffers.compute_rasterizer =
            Some(ComputeRasterizer { rasterizer: RefCell::new(rasterizer), shadow, visibility, enabled });
        Ok(())
    }
}

impl SceneBuffers {
    /// The compute rasterizer, and whether it draws the shadow map and the visibility. None where OpenGL draws both, as
    /// in rebased scenes: the rasterizer has registered the shared positions only.
    pub(crate) fn active_rasterizer(&self) -> Option<(&ComputeRasterizer, [bool; 2])> {
        let compute_rasterizer = self.compute_rasterizer.as_ref().filter(|_| self.rebased.is_none())?;
        let enabled = compute_rasterizer.enabled.get();
        enabled.contains(&true).then_some((compute_rasterizer, enabled))
    }

    /// The compute rasterizer if it draws the depth of the shadow map.
    pub(crate) fn shadow_rasterizer(&self) -> Option<&ComputeRasterizer> {
        self.active_rasterizer().filter(|(_, enabled)| enabled[0]).map(|(compute_rasterizer, _)| compute_rasterizer)
    }
}

impl ComputeRasterizer {
    /// Draws the requested outputs of this frame into the buffers.
    pub(crate) fn draw(
        &self,
        gl: &Rc<Gl>,
        (buffers, shot): (&SceneBuffers, &FrameParams),
        [shadow, visibility]: [bool; 2],
        stats: &mut FrameStats,
    ) -> Result<()> {
        let (scene, origin) = (&buffers.scene, buffers.origin);
        let side = scene.look.shadow.map_or(1, |shadow| shadow.size);
        let map = || Viewport::new(&shadow_clip_from_positions(scene, shot, origin), side, side);
        let map = if shadow { Some(map()?) } else { None };
        let frame = Viewport::new(&clip_from_positions(scene, shot, origin), shot.width, shot.height)?;
        let depth = self.shadow.as_ref().zip(map.as_ref()).map(|(depths, map)| (map, depths.buffer.shared()));
        let keys = self.visibility.as_ref().filter(|_| visibility);
        let bytes = KEY_BYTES * frame.pixel_count() as u64;
        let into = keys.map(|keys| keys.reserve(gl, bytes)).transpose()?;
        let depth_target = depth.as_ref().map(|(map, buffer)| (*map, buffer));
        self.rasterizer.borrow_mut().draw(depth_target, into.as_ref().map(|into| (&frame, into)))?;
        stats.passes.push(if depth.is_some() { "raster shadow" } else { "raster visibility" });
        stats.raster_backends.shadow = depth.map(|_| RasterBackend::Cuda);
        stats.raster_backends.visibility = into.map(|_| RasterBackend::Cuda);
        Ok(())
    }

    /// Disables the compute rasterizer after an error; OpenGL draws the scene from now on.
    pub(crate) fn disable(&self, error: &Error) {
        tracing::warn!(%error, "OpenGL draws from now on: the rasterizer beside it failed");
        self.enabled.set([false; 2]);
    }

    /// Input buffer and program of the first blur pass.
    pub(crate) fn blur_input(&self) -> Option<(&Buffer, &Program)> {
        self.shadow.as_ref().map(|depths| (&depths.buffer, depths.blur.as_ref()))
    }

    /// Converts the keys to the ids that the camera sees, including the ground.
    pub(crate) fn unpack(&self, gl: &Gl, target: &RenderTarget, stats: &mut FrameStats) -> Result<()> {
        let missing = || fault_in("unpack")("no keys were drawn");
        let keys = self.visibility.as_ref().ok_or_else(missing)?;
        keys.unpack.bind(None);
        keys.buffer.borrow().as_ref().ok_or_else(missing)?.bind_storage(0);
        target.ids.bind_image(0);
        target.dirty.ids.mark_all();
        gl.dispatch(target.desc.width.div_ceil(TILE), target.desc.height.div_ceil(TILE));
        stats.passes.push("unpack");
        gl.check("unpack")
    }

    /// Buffers that it holds, by name and bytes.
    pub(crate) fn allocations(&self) -> impl Iterator<Item = (&'static str, u64)> {
        let keys = self.visibility.as_ref().and_then(|keys| keys.buffer.borrow().as_ref().map(|buffer| buffer.bytes));
        let depths = self.shadow.as_ref().map(|depths| depths.buffer.bytes);
        [("raster shadow depths", depths), ("raster visibility keys", keys)]
            .into_iter()
            .filter_map(|(name, bytes)| Some((name, bytes?)))
    }
}

impl VisibilityKeys {
    /// A handle to the buffer, which grows to at least `bytes` bytes.
    fn reserve(&self, gl: &Rc<Gl>, bytes: u64) -> Result<GlBuffer> {
        let mut buffer = self.buffer.borrow_mut();
        match buffer.take().filter(|buffer| buffer.bytes >= bytes) {
            Some(large) => Ok(buffer.insert(large).shared()),
            None => Ok(buffer.insert(gl.buffer(bytes, gl::STREAM_COPY, None)?).shared()),
        }
    }
}
