//! A compute rasterizer that draws selected passes instead of OpenGL, and its output buffers.
//!
//! The compute rasterizer writes into OpenGL buffers: depth for the blur, and visibility keys that a compute pass
//! converts to ids. All later passes are the same. A scene whose look does not ask for a compute rasterizer has none of
//! these resources.

use std::cell::{Cell, Ref, RefCell};
use std::rc::Rc;

use super::programs::ProgramCompiler;
use crate::device::gl::{self, Buffer, Gl, Program};
use crate::shaders::ShaderOptions;
use modalcast_model::error::{Error, Result};
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
    /// Keeps handles to the buffers that it has registered.
    rasterizer: RefCell<Box<dyn Rasterizer>>,
    outputs: RasterOutputs,
    enabled: Cell<RasterPasses>,
}

/// Output buffers of a compute rasterizer, and the programs that read them; none for passes that it does not draw.
#[derive(Debug)]
pub(crate) struct RasterOutputs {
    shadow: Option<ShadowDepths>,
    visibility: Option<VisibilityKeys>,
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

impl RasterPasses {
    pub(crate) const NONE: Self = Self { shadow: false, visibility: false };

    /// The passes of a scene that a compute rasterizer may draw. The shadow map must have moments and only one cascade.
    /// Frames must have one sample per pixel and no blended triangles, which are tested against depth.
    pub(crate) fn supported(scene: &Scene) -> Self {
        let look = &scene.look;
        let shadow = look.shadow.is_some_and(|shadow| shadow.has_moments() && shadow.splits == 1);
        let triangles = scene.layout.triangles > 0;
        Self {
            shadow: triangles && shadow,
            visibility: triangles && look.samples_per_pixel() == 1 && !scene.features.blend,
        }
    }

    /// Whether any pass is selected.
    pub(crate) const fn any(self) -> bool {
        self.shadow || self.visibility
    }

    /// Whether all these passes are among the others.
    pub(crate) const fn is_subset_of(self, others: Self) -> bool {
        (others.shadow || !self.shadow) && (others.visibility || !self.visibility)
    }
}

impl RasterOutputs {
    /// Creates the outputs of the passes. `options` are those of the scene.
    pub(crate) fn new(
        gl: &Rc<Gl>,
        passes: RasterPasses,
        options: &ShaderOptions,
        compile: &mut ProgramCompiler<'_>,
    ) -> Result<Self> {
        let size = options.features.shadow.map_or(0, |shadow| u64::from(shadow.size));
        let shadow = match options.blur_from_buffer().filter(|_| passes.shadow) {
            Some(source) => {
                let buffer = gl.buffer(4 * size * size, gl::STREAM_COPY, None)?;
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

    /// The passes that have an output.
    pub(crate) const fn passes(&self) -> RasterPasses {
        RasterPasses { shadow: self.shadow.is_some(), visibility: self.visibility.is_some() }
    }
}

impl ComputeRasterizer {
    /// A rasterizer that draws all passes that have an output.
    pub(crate) fn new(rasterizer: Box<dyn Rasterizer>, outputs: RasterOutputs) -> Self {
        let enabled = Cell::new(outputs.passes());
        Self { rasterizer: RefCell::new(rasterizer), outputs, enabled }
    }

    /// The passes that it draws now.
    pub(crate) fn enabled(&self) -> RasterPasses {
        self.enabled.get()
    }

    /// Selects the passes that it draws from now on.
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
    /// Those of the rasterizer; `Fault` when OpenGL has no memory for the keys.
    pub(crate) fn draw(&self, gl: &Rc<Gl>, map: Option<&Viewport>, frame: Option<&Viewport>) -> Result<()> {
        let depths = self.outputs.shadow.as_ref().zip(map).map(|(depths, map)| (map, depths.buffer.shared()));
        let keys = match self.outputs.visibility.as_ref().zip(frame) {
            Some((keys, frame)) => Some((frame, keys.reserve(gl, KEY_BYTES * frame.pixel_count() as u64)?)),
            None => None,
        };
        let depths = depths.as_ref().map(|(map, buffer)| (*map, buffer));
        self.rasterizer.borrow_mut().draw(depths, keys.as_ref().map(|(frame, buffer)| (*frame, buffer)))
    }

    /// Input buffer and program of the first blur pass; none unless it draws the shadow map.
    pub(crate) fn blur_input(&self) -> Option<(&Buffer, &Program)> {
        self.outputs.shadow.as_ref().map(|depths| (&depths.buffer, depths.blur.as_ref()))
    }

    /// Keys of the last frame and the program that converts them; none unless it has drawn visibility.
    pub(crate) fn unpack_input(&self) -> Option<(Ref<'_, Buffer>, &Program)> {
        let keys = self.outputs.visibility.as_ref()?;
        let buffer = Ref::filter_map(keys.buffer.borrow(), Option::as_ref).ok()?;
        Some((buffer, keys.unpack.as_ref()))
    }

    /// Buffers that it holds, by name and bytes.
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
    /// A handle to the buffer, which grows to at least `bytes` bytes.
    fn reserve(&self, gl: &Rc<Gl>, bytes: u64) -> Result<GlBuffer> {
        let mut buffer = self.buffer.borrow_mut();
        match buffer.take().filter(|buffer| buffer.bytes >= bytes) {
            Some(large) => Ok(buffer.insert(large).shared()),
            None => Ok(buffer.insert(gl.buffer(bytes, gl::STREAM_COPY, None)?).shared()),
        }
    }
}
