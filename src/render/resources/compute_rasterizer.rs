//! A compute rasterizer that draws selected passes instead of OpenGL, and its output buffers.
//!
//! The compute rasterizer writes into OpenGL buffers: depth for the blur, and visibility keys, which a compute pass
//! converts to ids. A key is the triangle and the depth of a pixel. All later passes are the same as with OpenGL. A
//! scene has these resources only if its backend settings select a compute rasterizer.

use std::cell::{Cell, Ref, RefCell};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::rc::Rc;

use super::programs::ProgramCompiler;
use crate::device::gl::{self, Buffer, Gl, Program};
use crate::shaders::ShaderOptions;
use modalcast_model::error::{Error, Result, fault};
use modalcast_model::raster::{GlBuffer, Rasterizer};
use modalcast_model::scene::{Scene, Viewport};

/// The passes that a compute rasterizer draws.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct RasterPasses {
    pub(crate) shadow: bool,
    pub(crate) visibility: bool,
}

/// A compute rasterizer and its output buffers.
#[derive(Debug)]
pub(crate) struct ComputeRasterizer {
    /// Owns handles to the buffers that it has registered.
    rasterizer: RefCell<Box<dyn Rasterizer>>,
    outputs: RasterOutputs,
    enabled: Cell<RasterPasses>,
}

/// Output buffers of a compute rasterizer, and the programs that read them. An output is absent if the compute
/// rasterizer does not support its pass.
#[derive(Debug)]
pub(crate) struct RasterOutputs {
    shadow: Option<ShadowDepths>,
    visibility: Option<VisibilityKeys>,
}

/// Depth of the shadow map.
#[derive(Debug)]
struct ShadowDepths {
    buffer: Buffer,
    /// The program of the first blur pass, which reads `buffer`.
    blur: Rc<Program>,
}

/// Visibility keys of a frame.
#[derive(Debug)]
struct VisibilityKeys {
    /// Sized for the largest frame so far; none before the first frame.
    buffer: RefCell<Option<Buffer>>,
    /// The program that converts keys to ids.
    unpack: Rc<Program>,
}

/// Bytes of a key: a word of the triangle's index, and a word of the inverted bits of the depth.
const KEY_BYTES: u64 = 8;

impl RasterPasses {
    pub(crate) const NONE: Self = Self { shadow: false, visibility: false };

    /// The passes of a scene that a compute rasterizer may draw. The shadow pass needs moments and only one cascade.
    /// The visibility pass needs one sample per pixel and no blended triangles, because no depth image is written.
    pub(crate) fn supported(scene: &Scene) -> Self {
        let look = &scene.look;
        let is_shadow_supported = look.shadow.is_some_and(|shadow| shadow.has_moments() && shadow.cascades == 1);
        let has_triangles = scene.layout.triangles > 0;
        Self {
            shadow: has_triangles && is_shadow_supported,
            visibility: has_triangles && look.samples_per_pixel() == 1 && !scene.features.blend,
        }
    }

    /// Whether any pass is selected.
    pub(crate) const fn has_any(self) -> bool {
        self.shadow || self.visibility
    }

    /// Whether `other` contains all these passes.
    pub(crate) const fn is_subset_of(self, other: Self) -> bool {
        (other.shadow || !self.shadow) && (other.visibility || !self.visibility)
    }
}

impl RasterOutputs {
    /// Creates the outputs of the passes. `options` are the shader options of the scene.
    pub(crate) fn new(
        gl: &Rc<Gl>,
        passes: RasterPasses,
        options: &ShaderOptions,
        compile: &mut ProgramCompiler<'_>,
    ) -> Result<Self> {
        let map_size = options.features.shadow.map_or(0, |shadow| u64::from(shadow.size));
        let shadow = match options.blur_from_buffer().filter(|_| passes.shadow) {
            Some(source) => {
                let buffer = gl.buffer(4 * map_size * map_size, gl::STREAM_COPY, None)?;
                Some(ShadowDepths { buffer, blur: compile(source)? })
            }
            None => None,
        };
        let visibility = match passes.visibility {
            true => Some(VisibilityKeys { buffer: RefCell::default(), unpack: compile(options.unpack())? }),
            false => None,
        };
        Ok(Self { shadow, visibility })
    }

    /// Passes that have an output.
    pub(crate) const fn passes(&self) -> RasterPasses {
        RasterPasses { shadow: self.shadow.is_some(), visibility: self.visibility.is_some() }
    }
}

impl ComputeRasterizer {
    /// Enables all passes that have an output.
    pub(crate) fn new(rasterizer: Box<dyn Rasterizer>, outputs: RasterOutputs) -> Self {
        let enabled = Cell::new(outputs.passes());
        Self { rasterizer: RefCell::new(rasterizer), outputs, enabled }
    }

    /// Passes that the compute rasterizer draws at present.
    pub(crate) fn enabled(&self) -> RasterPasses {
        self.enabled.get()
    }

    /// Selects the passes that the compute rasterizer draws; OpenGL draws the others.
    pub(crate) fn enable(&self, passes: RasterPasses) {
        self.enabled.set(passes);
    }

    /// Disables the compute rasterizer after an error; OpenGL draws the scene from now on.
    pub(crate) fn disable(&self, error: &Error) {
        tracing::warn!(%error, "the compute rasterizer failed; OpenGL draws from now on");
        self.enabled.set(RasterPasses::NONE);
    }

    /// Draws the depth of the shadow map, the visibility of the frame, or both.
    ///
    /// # Errors
    /// Errors of the rasterizer; `Fault` if the rasterizer panics or OpenGL has no memory for the keys.
    pub(crate) fn draw(
        &self,
        gl: &Rc<Gl>,
        shadow_viewport: Option<&Viewport>,
        frame_viewport: Option<&Viewport>,
    ) -> Result<()> {
        let depths = self
            .outputs
            .shadow
            .as_ref()
            .zip(shadow_viewport)
            .map(|(depths, shadow_viewport)| (shadow_viewport, depths.buffer.shared()));
        let keys = match self.outputs.visibility.as_ref().zip(frame_viewport) {
            Some((keys, frame_viewport)) => {
                Some((frame_viewport, keys.reserve(gl, KEY_BYTES * frame_viewport.pixel_count() as u64)?))
            }
            None => None,
        };
        // `Rasterizer::draw` borrows the handles.
        let depths = depths.as_ref().map(|(shadow_viewport, buffer)| (*shadow_viewport, buffer));
        let keys = keys.as_ref().map(|(frame_viewport, buffer)| (*frame_viewport, buffer));
        // A panic is converted to an error, so that the caller disables the rasterizer and draws this frame with
        // OpenGL.
        catch_unwind(AssertUnwindSafe(|| self.rasterizer.borrow_mut().draw(depths, keys)))
            .unwrap_or_else(|_| Err(fault("rasterize", "the compute rasterizer panicked")))
    }

    /// Input buffer and program of the first blur pass; none without shadow output.
    pub(crate) fn blur_input(&self) -> Option<(&Buffer, &Program)> {
        self.outputs.shadow.as_ref().map(|depths| (&depths.buffer, depths.blur.as_ref()))
    }

    /// Keys of the last frame and the program that converts them; none before the first visibility pass.
    pub(crate) fn unpack_input(&self) -> Option<(Ref<'_, Buffer>, &Program)> {
        let keys = self.outputs.visibility.as_ref()?;
        let buffer = Ref::filter_map(keys.buffer.borrow(), Option::as_ref).ok()?;
        Some((buffer, keys.unpack.as_ref()))
    }

    /// Name and bytes of each buffer.
    pub(crate) fn allocations(&self) -> impl Iterator<Item = (&'static str, u64)> {
        let keys =
            self.outputs.visibility.as_ref().and_then(|keys| keys.buffer.borrow().as_ref().map(|buffer| buffer.bytes));
        let depths = self.outputs.shadow.as_ref().map(|depths| depths.buffer.bytes);
        [("raster shadow depths", depths), ("raster visibility keys", keys)]
            .into_iter()
            .filter_map(|(name, bytes)| Some((name, bytes?)))
    }
}

impl VisibilityKeys {
    /// Returns a handle to the buffer. Reallocates the buffer if it is smaller than `bytes`.
    fn reserve(&self, gl: &Rc<Gl>, bytes: u64) -> Result<GlBuffer> {
        let mut buffer = self.buffer.borrow_mut();
        match buffer.take().filter(|buffer| buffer.bytes >= bytes) {
            Some(reusable_buffer) => Ok(buffer.insert(reusable_buffer).shared()),
            None => Ok(buffer.insert(gl.buffer(bytes, gl::STREAM_COPY, None)?).shared()),
        }
    }
}
