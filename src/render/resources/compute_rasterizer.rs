//! A compute rasterizer that draws selected passes instead of OpenGL, and its output buffers.
//!
//! The compute rasterizer writes depth for the blur, and visibility keys, which a compute pass converts to ids. A key
//! is the triangle and the depth of a pixel. It writes into shared memory ([`SharedTargets`]), or into OpenGL buffers
//! that it maps. Both count against the budget of render targets. All later passes are the same as with OpenGL. A scene
//! has these resources only if its backend settings select a compute rasterizer.

use std::cell::{Cell, RefCell};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::rc::Rc;
use std::sync::Arc;
use std::time::Duration;

use super::programs::ProgramCompiler;
use super::shared_targets::{
    DEPTH_BYTES, KEY_BYTES, RasterViews, SharedDrawTime, SharedTargets, StepViews, reserve_output,
};
use crate::device::gl::{self, Buffer, Gl, Program};
use crate::pieces::PieceRange;
use crate::shaders::ShaderOptions;
use modalcast_model::error::{Error, Result, fault};
use modalcast_model::memory::{MemoryBudget, MemoryReservation};
use modalcast_model::raster::{GlBuffer, Rasterizer};
use modalcast_model::scene::Scene;

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
    /// `None` after an error; the rasterizer then maps OpenGL's buffers.
    shared: RefCell<Option<SharedTargets>>,
    /// Limit on the memory of the output.
    budget: Arc<MemoryBudget>,
}

/// Output buffers of a compute rasterizer that maps them, and the programs that read the output. An output is absent if
/// the compute rasterizer does not support its pass.
#[derive(Debug)]
pub(crate) struct RasterOutputs {
    shadow: Option<ShadowDepths>,
    visibility: Option<VisibilityKeys>,
}

/// Depth of the shadow map.
#[derive(Debug)]
struct ShadowDepths {
    buffer: OutputBuffer,
    /// The program of the first blur pass, which reads the depth from a buffer.
    blur: Rc<Program>,
}

/// Visibility keys of a frame.
#[derive(Debug)]
struct VisibilityKeys {
    buffer: OutputBuffer,
    /// The program that converts keys to ids.
    unpack: Rc<Program>,
}

/// A buffer that the rasterizer maps. Sized for the largest frame so far; none before the first one.
#[derive(Debug, Default)]
struct OutputBuffer(RefCell<Option<CountedBuffer>>);

#[derive(Debug)]
struct CountedBuffer {
    buffer: Buffer,
    _memory: Arc<MemoryReservation>,
}

impl RasterPasses {
    pub(crate) const NONE: Self = Self { shadow: false, visibility: false };
    pub(crate) const SHADOW: Self = Self { shadow: true, visibility: false };
    pub(crate) const ALL: Self = Self { shadow: true, visibility: true };

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

    /// The passes of both.
    pub(crate) const fn intersection(self, other: Self) -> Self {
        Self { shadow: self.shadow && other.shadow, visibility: self.visibility && other.visibility }
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
    /// The outputs of the passes. Their buffers are allocated when they are drawn. `options` are the shader options of
    /// the scene.
    pub(crate) fn new(
        passes: RasterPasses,
        options: &ShaderOptions,
        compile: &mut ProgramCompiler<'_>,
    ) -> Result<Self> {
        let shadow = match options.blur_from_buffer().filter(|_| passes.shadow) {
            Some(source) => Some(ShadowDepths { buffer: OutputBuffer::default(), blur: compile(source)? }),
            None => None,
        };
        let visibility = match passes.visibility {
            true => Some(VisibilityKeys { buffer: OutputBuffer::default(), unpack: compile(options.unpack())? }),
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
    pub(crate) fn new(rasterizer: Box<dyn Rasterizer>, outputs: RasterOutputs, budget: &Arc<MemoryBudget>) -> Self {
        let enabled = Cell::new(outputs.passes());
        let shared = RefCell::new(Some(SharedTargets::new(budget)));
        Self { rasterizer: RefCell::new(rasterizer), outputs, enabled, shared, budget: Arc::clone(budget) }
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

    /// Draws triangles of a range into the depth of the shadow map, the visibility of the frame, or both, in mapped
    /// buffers. The range that begins with the first triangle clears them before.
    ///
    /// # Errors
    /// Errors of the rasterizer; `OutOfMemory`; `Fault` if the rasterizer panics or OpenGL has no memory for the
    /// output.
    pub(crate) fn draw(&self, gl: &Rc<Gl>, views: &RasterViews, range: PieceRange) -> Result<()> {
        let depths = match self.outputs.shadow.as_ref().zip(views.shadow.as_ref()) {
            Some((depths, viewport)) => {
                Some((viewport, depths.buffer.reserve(gl, &self.budget, DEPTH_BYTES * viewport.pixel_count() as u64)?))
            }
            None => None,
        };
        let keys = match self.outputs.visibility.as_ref().zip(views.frame.as_ref()) {
            Some((keys, viewport)) => {
                Some((viewport, keys.buffer.reserve(gl, &self.budget, KEY_BYTES * viewport.pixel_count() as u64)?))
            }
            None => None,
        };
        // `Rasterizer::draw` borrows the handles.
        let depths = depths.as_ref().map(|(viewport, buffer)| (*viewport, buffer));
        let keys = keys.as_ref().map(|(viewport, buffer)| (*viewport, buffer));
        let [first, end] = [range.first, range.end].map(|triangle| u32::try_from(triangle).unwrap_or(u32::MAX));
        self.run(|rasterizer| rasterizer.draw(depths, keys, first..end))
    }

    /// Draws into shared memory, and makes the first step the input of the next frame ([`SharedTargets::draw`]). After an
    /// error, the rasterizer maps OpenGL's buffers instead, in this and all later frames.
    ///
    /// # Errors
    /// `DeviceLost`.
    pub(crate) fn draw_shared(&self, gl: &Rc<Gl>, steps: Vec<StepViews>, limit: Duration) -> Result<()> {
        let mut shared = self.shared.borrow_mut();
        let Some(targets) = shared.as_mut() else { return Ok(()) };
        match self.run(|rasterizer| targets.draw(gl, rasterizer, steps, limit)) {
            Ok(()) => Ok(()),
            Err(lost) if lost.is_loss() => Err(lost),
            Err(error) => {
                tracing::warn!(%error, "the compute rasterizer maps OpenGL's buffers from now on");
                *shared = None;
                Ok(())
            }
        }
    }

    /// The time of the views in shared memory if they are the input of the present frame. Otherwise they must be drawn
    /// into mapped buffers.
    pub(crate) fn shared_time(&self, gl: &Rc<Gl>, views: &RasterViews) -> Result<Option<SharedDrawTime>> {
        self.shared.borrow_mut().as_mut().map_or(Ok(None), |targets| targets.time_of(gl, views))
    }

    /// Frees shared memory that no frame has used for the time `unused`.
    pub(crate) fn free_unused(&self, unused: Duration) {
        if let Some(targets) = self.shared.borrow_mut().as_mut() {
            targets.free_unused(unused);
        }
    }

    /// Ends the use of shared memory by the present frame, after all its commands.
    pub(crate) fn release_shared(&self, gl: &Rc<Gl>) -> Result<()> {
        self.shared.borrow_mut().as_mut().map_or(Ok(()), |targets| targets.release(gl))
    }

    /// Runs the rasterizer. A panic becomes an error, so that the caller disables the rasterizer and draws this frame
    /// in another way.
    fn run<T>(&self, work: impl FnOnce(&mut dyn Rasterizer) -> Result<T>) -> Result<T> {
        catch_unwind(AssertUnwindSafe(|| work(self.rasterizer.borrow_mut().as_mut())))
            .unwrap_or_else(|_| Err(fault("rasterize", "the compute rasterizer panicked")))
    }

    /// Depths of the present frame and the program of the first blur pass; none without shadow output.
    pub(crate) fn blur_input(&self) -> Option<(Buffer, &Program)> {
        let depths = self.outputs.shadow.as_ref()?;
        let shared = self.shared.borrow().as_ref().and_then(|targets| targets.depths().map(Buffer::alias));
        Some((shared.or_else(|| depths.buffer.alias())?, depths.blur.as_ref()))
    }

    /// Keys of the present frame and the program that converts them; none before the first visibility pass.
    pub(crate) fn unpack_input(&self) -> Option<(Buffer, &Program)> {
        let keys = self.outputs.visibility.as_ref()?;
        let shared = self.shared.borrow().as_ref().and_then(|targets| targets.keys().map(Buffer::alias));
        Some((shared.or_else(|| keys.buffer.alias())?, keys.unpack.as_ref()))
    }

    /// Name and bytes of each kind of buffers.
    pub(crate) fn allocations(&self) -> impl Iterator<Item = (&'static str, u64)> {
        let RasterOutputs { shadow, visibility } = &self.outputs;
        let mapped = [shadow.as_ref().map(|depths| &depths.buffer), visibility.as_ref().map(|keys| &keys.buffer)].map(
            |buffer| {
                let buffer = buffer.and_then(|buffer| buffer.0.borrow().as_ref().map(|counted| counted.buffer.bytes));
                buffer.unwrap_or_default()
            },
        );
        let shared = self.shared.borrow().as_ref().map_or([0, 0], SharedTargets::bytes);
        let bytes = [0, 1].map(|index| mapped[index] + shared[index]);
        ["raster shadow depths", "raster visibility keys"].into_iter().zip(bytes).filter(|(_, bytes)| *bytes > 0)
    }
}

impl OutputBuffer {
    /// Returns a handle to the buffer. Reallocates the buffer if it is smaller than `bytes`.
    fn reserve(&self, gl: &Rc<Gl>, budget: &Arc<MemoryBudget>, bytes: u64) -> Result<GlBuffer> {
        let mut slot = self.0.borrow_mut();
        let counted = match slot.take().filter(|counted| counted.buffer.bytes >= bytes) {
            Some(reusable_buffer) => reusable_buffer,
            None => {
                let memory = reserve_output(budget, bytes)?;
                CountedBuffer { buffer: gl.buffer(bytes, gl::STREAM_COPY, None)?, _memory: memory }
            }
        };
        Ok(slot.insert(counted).buffer.shared())
    }

    /// Another owner of the buffer; none before the first frame.
    fn alias(&self) -> Option<Buffer> {
        self.0.borrow().as_ref().map(|counted| counted.buffer.alias())
    }
}
