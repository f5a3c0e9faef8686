//! Thin layer over OpenGL: typed objects that delete themselves (`gl/object.rs`), and the commands that the passes
//! need. No other module calls OpenGL.
//!
//! Each object keeps its context alive. Each command makes the context current, so that several renderers can share a
//! thread. Callers that issue many commands hold a guard of [`Gl::make_current`]: the commands then do not switch.
//!
//! Commands that return nothing report their errors as OpenGL does: the next [`Gl::check`] returns the first error. A
//! command is not issued if its arguments are invalid or its context cannot be made current.
//!
//! Object names stay private. Other APIs get a [`GlBuffer`](modalcast_model::raster::GlBuffer), which keeps the buffer
//! alive.

mod barrier;
mod clear;
mod clip_control;
mod debug;
mod external_memory;
mod fence;
mod fullscreen;
mod indirect;
mod limits;
mod object;
mod picture_buffer;
mod program;
mod staging;
mod timer;

use std::cell::{Cell, RefCell};
use std::mem::ManuallyDrop;
use std::ops::Deref;
use std::rc::Rc;

use glow::HasContext as _;

pub(crate) use self::barrier::MemoryBarriers;
pub(crate) use self::clear::{ClearOp, VisibilityDirtyRegions};
pub(crate) use self::debug::is_enabled as is_debug_enabled;
pub(crate) use self::fence::Fence;
pub(crate) use self::limits::Limits;
pub(crate) use self::object::{Buffer, Framebuffer, Program, Texture, TextureDesc, VertexArray};
#[cfg(test)]
pub(crate) use self::picture_buffer::testing::UnsharedMemory;
pub(crate) use self::picture_buffer::{PictureBuffer, check_sharing};
pub(crate) use self::program::PendingProgram;
pub(crate) use self::staging::{ReadbackView, StagingBuffer};
pub(crate) use self::timer::{PassTimer, SpanTimer};
use super::egl::{Context, CurrentContext};
use crate::pieces::PieceRange;
use modalcast_model::error::{Error, Result, fault, fault_in};

/// OpenGL constants that other modules use.
pub(crate) use glow::{
    CLAMP_TO_EDGE, COMPUTE_SHADER, DEPTH_COMPONENT32F, DYNAMIC_DRAW, FRAGMENT_SHADER, LINEAR, LINEAR_MIPMAP_LINEAR,
    LINEAR_MIPMAP_NEAREST, NEAREST, R32F, R32UI, REPEAT, RG16F, RG32F, RG32UI, RGB32F, RGB32UI, RGBA8, RGBA16F,
    RGBA32F, SRGB8_ALPHA8, STATIC_DRAW, STREAM_COPY, STREAM_READ, TEXTURE_2D, TEXTURE_2D_ARRAY, TEXTURE_2D_MULTISAMPLE,
    TEXTURE_MAG_FILTER, TEXTURE_MIN_FILTER, TEXTURE_WRAP_S, TEXTURE_WRAP_T, VERTEX_SHADER,
};

type GetResetStatus = unsafe extern "system" fn() -> u32;

/// An OpenGL context and its functions.
pub(crate) struct Gl {
    /// Dropped by `drop`, or leaked.
    functions: ManuallyDrop<glow::Context>,
    context: Context,
    pub(crate) limits: Limits,
    /// glGetGraphicsResetStatus; `None` if the context does not have it.
    reset_status: Option<GetResetStatus>,
    /// Why a command was not issued: the first reason since the last check.
    skipped_error: RefCell<Option<String>>,
    /// Whether a leak of objects is already logged.
    is_leak_logged: Cell<bool>,
    /// Pool of timer queries that are not in use.
    free_queries: RefCell<Vec<glow::Query>>,
    /// Pool of timestamp queries that are not in use. OpenGL fixes the kind of a query when it is first used.
    free_timestamps: RefCell<Vec<glow::Query>>,
    /// Buffers of dropped staging buffers from which a thread still copies. They are freed afterwards.
    retired_buffers: RefCell<Vec<staging::RetiredBuffer>>,
}

/// Keeps a context current on this thread, so that commands can be issued without a switch. Dropping the guard restores
/// the previous context. If a panic unwinds, the guard also discards the errors of the interrupted commands, so that
/// the next check does not report them for other commands.
#[derive(Debug)]
#[must_use = "the previous context becomes current again when the guard is dropped"]
pub(crate) struct CurrentGl {
    gl: Rc<Gl>,
    _context: CurrentContext,
}

/// Threads of the driver that compile programs. A scene has about ten programs.
const MAX_COMPILER_THREADS: u32 = 8;

/// The functions of a context that is current on this thread while this value exists.
struct Functions<'a> {
    functions: &'a glow::Context,
    _context: CurrentContext,
}

impl Deref for Functions<'_> {
    type Target = glow::Context;

    fn deref(&self) -> &glow::Context {
        self.functions
    }
}

impl Drop for CurrentGl {
    fn drop(&mut self) {
        if std::thread::panicking() {
            self.gl.discard_errors();
        }
    }
}

impl Drop for Gl {
    fn drop(&mut self) {
        // Dropping the functions removes their debug callback from the current context, so this context must be
        // current. If it is not, functions and callback leak, because the driver may still call the callback.
        match self.context.make_current() {
            // SAFETY: dropped once, here, and not used afterwards.
            Ok(_current) => unsafe { ManuallyDrop::drop(&mut self.functions) },
            Err(error) => self.log_leak(&error),
        }
    }
}

impl std::fmt::Debug for Gl {
    fn fmt(&self, out: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        out.debug_struct("Gl").field("limits", &self.limits).finish_non_exhaustive()
    }
}

/// A vertex attribute, tightly packed in a buffer.
pub(crate) struct VertexAttribute<'a> {
    pub(crate) location: u32,
    pub(crate) buffer: &'a Buffer,
    /// Number of 32-bit components.
    pub(crate) components: i32,
    /// Whether the components are u32 instead of f32.
    pub(crate) integer: bool,
}

/// A copy between two buffers; offsets are in bytes.
#[derive(Debug, Clone, Copy)]
pub(crate) struct BufferCopy<'a> {
    pub(crate) source: &'a Buffer,
    pub(crate) source_offset: u64,
    pub(crate) target: &'a Buffer,
    pub(crate) target_offset: u64,
    pub(crate) bytes: u64,
}

impl<'a> BufferCopy<'a> {
    /// Copies the first `bytes` bytes to the start of the target.
    pub(crate) const fn first(bytes: u64, source: &'a Buffer, target: &'a Buffer) -> Self {
        Self { source, source_offset: 0, target, target_offset: 0, bytes }
    }
}

/// An image of a framebuffer: a texture or a layer of an array texture.
#[derive(Debug, Clone, Copy)]
struct Attachment<'a> {
    image: &'a Texture,
    layer: Option<u32>,
}

/// The fixed-function state of a pass.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct PipelineState {
    pub(crate) depth_write: bool,
    /// Only triangles whose corners appear counterclockwise are drawn.
    pub(crate) cull_back_faces: bool,
    /// Colors are blended over the existing colors. Alpha accumulates the transmittance: the fraction of the background
    /// that remains visible.
    pub(crate) blend: bool,
}

impl Gl {
    pub(crate) fn new(context: Context) -> Result<Rc<Self>> {
        let current = context.make_current()?;
        let load_address = |name: &std::ffi::CStr| name.to_str().map_or(std::ptr::null(), |name| context.address(name));
        // SAFETY: the context is current on this thread, and EGL returned the addresses for this context.
        let mut functions = unsafe { glow::Context::from_loader_function_cstr(load_address) };
        let limits = Limits::of(&functions);
        clip_control::set_depth_range_from_zero(&functions, &context)?;
        program::set_compiler_threads(&context, MAX_COMPILER_THREADS);
        if context.is_debug {
            debug::install_debug_callback(&mut functions);
        }
        let reset_status = limits::has_reset_status(&functions).then(|| context.address("glGetGraphicsResetStatus"));
        // SAFETY: the function has this signature in OpenGL 4.5 and GL_KHR_robustness, one of which the context has.
        let reset_status = reset_status
            .filter(|address| !address.is_null())
            .map(|address| unsafe { std::mem::transmute::<*const std::ffi::c_void, GetResetStatus>(address) });
        drop(current);
        Ok(Rc::new(Self {
            reset_status,
            functions: ManuallyDrop::new(functions),
            context,
            limits,
            skipped_error: RefCell::default(),
            is_leak_logged: Cell::default(),
            free_queries: RefCell::default(),
            free_timestamps: RefCell::default(),
            retired_buffers: RefCell::default(),
        }))
    }

    /// Makes the context current on this thread while the returned guard exists.
    ///
    /// # Errors
    /// `Fault` when EGL cannot make the context current. No command can be issued then.
    pub(crate) fn make_current(self: &Rc<Self>) -> Result<CurrentGl> {
        Ok(CurrentGl { gl: Rc::clone(self), _context: self.context.make_current()? })
    }

    /// Makes the context current and leaves it current.
    ///
    /// # Errors
    /// `Fault` when EGL cannot make the context current.
    pub(crate) fn stay_current(&self) -> Result<()> {
        self.context.make_current().map(CurrentContext::keep)
    }

    /// The OpenGL functions, with the context current.
    fn functions(&self) -> Result<Functions<'_>> {
        let context = self.context.make_current()?;
        Ok(Functions { functions: &self.functions, _context: context })
    }

    /// Like [`Self::functions`], for commands that return nothing. If the context cannot be made current, the next
    /// check returns the error.
    fn functions_or_skip(&self) -> Option<Functions<'_>> {
        self.functions().map_err(|error| self.record_skipped(error.to_string())).ok()
    }

    /// Records the error of a command that is not issued; the next check returns the first of these errors.
    fn record_skipped(&self, reason: String) {
        self.skipped_error.borrow_mut().get_or_insert(reason);
    }

    /// Deletes an object. If the context cannot be made current, the object leaks until the context is destroyed.
    fn delete(&self, delete: impl FnOnce(&glow::Context)) {
        match self.functions() {
            Ok(gl) => delete(&gl),
            Err(error) => self.log_leak(&error),
        }
    }

    /// Logs the first leak of an object.
    fn log_leak(&self, error: &Error) {
        if !self.is_leak_logged.replace(true) {
            tracing::warn!(%error, "OpenGL objects are not deleted before their context");
        }
    }

    /// Checks that no command has failed since the last check.
    ///
    /// # Errors
    /// `Fault` of `stage` with the first error of a command that was not issued, or with an error of OpenGL;
    /// `RendererLost` when the context is lost.
    pub(crate) fn check(&self, stage: &'static str) -> Result<()> {
        if let Some(reason) = self.skipped_error.take() {
            return Err(fault(stage, reason));
        }
        let gl = self.functions().map_err(fault_in(stage))?;
        // SAFETY: a query without side effects on memory; the context is current.
        match unsafe { gl.get_error() } {
            glow::NO_ERROR => Ok(()),
            glow::OUT_OF_MEMORY => Err(fault(stage, "OpenGL is out of memory")),
            glow::CONTEXT_LOST => Err(self.renderer_lost_error(stage).unwrap_or_else(|| {
                let reason = "OpenGL reports a lost context".into();
                Error::RendererLost { stage, reason }
            })),
            error => Err(fault(stage, format!("OpenGL error 0x{error:04X}"))),
        }
    }

    /// `RendererLost` with the reason if the context is lost: the device was reset, and all objects are gone.
    fn renderer_lost_error(&self, stage: &'static str) -> Option<Error> {
        let (status, _current) = (self.reset_status?, self.functions().ok()?);
        // SAFETY: the address is that of glGetGraphicsResetStatus of the current context; a query without side effects.
        let reason = match unsafe { status() } {
            glow::NO_ERROR => return None,
            glow::GUILTY_CONTEXT_RESET => "a command of this OpenGL context reset the device",
            glow::INNOCENT_CONTEXT_RESET => "a command of another OpenGL context reset the device",
            _ => "OpenGL reports a reset of the device",
        };
        Some(Error::RendererLost { stage, reason: reason.into() })
    }

    /// Discards the errors since the last check.
    fn discard_errors(&self) {
        self.skipped_error.take();
        let Ok(gl) = self.functions() else { return };
        // A driver may record several errors, for example one per thread. The loop is bounded, because a lost context
        // reports errors forever.
        for _ in 0..16 {
            // SAFETY: a query without side effects on memory; the context is current.
            if unsafe { gl.get_error() } == glow::NO_ERROR {
                return;
            }
        }
    }

    /// Creates a buffer of `bytes` bytes; if `bytes` is less than 4, of 4 bytes, because OpenGL has no empty buffers.
    /// Its content is `data`, or undefined without data.
    ///
    /// # Errors
    /// `Fault` when the data has another length, the buffer exceeds 2 GiB, or OpenGL fails.
    pub(crate) fn buffer(self: &Rc<Self>, bytes: u64, usage: u32, data: Option<&[u8]>) -> Result<Buffer> {
        let to_fault = fault_in("buffer");
        let size = i32::try_from(bytes.max(4))
            .map_err(|_| to_fault(format!("expected at most 2 GiB in a buffer, got {bytes} bytes")))?;
        if let Some(data) = data
            && data.len() as u64 != bytes
        {
            return Err(to_fault(format!("expected {bytes} bytes of data, got {}", data.len())));
        }
        let gl = self.functions()?;
        // SAFETY: a new name, which the buffer owns.
        let name = unsafe { gl.create_buffer() }.map_err(fault_in("buffer"))?;
        let buffer = Buffer::new(self, name, size as u64);
        // SAFETY: OpenGL copies the data within the call, or there is no data and the content is undefined.
        unsafe {
            gl.bind_buffer(glow::COPY_WRITE_BUFFER, Some(name));
            match data {
                Some(data) if data.len() >= 4 => gl.buffer_data_u8_slice(glow::COPY_WRITE_BUFFER, data, usage),
                _ => gl.buffer_data_size(glow::COPY_WRITE_BUFFER, size, usage),
            }
        }
        if let Some(data) = data.filter(|data| data.len() < 4) {
            buffer.write(data);
        }
        self.check("buffer").map(|()| buffer)
    }

    /// Creates a texture with undefined content.
    pub(crate) fn texture(self: &Rc<Self>, desc: TextureDesc) -> Result<Texture> {
        let gl = self.functions()?;
        let [width, height, depth, levels] = [desc.width, desc.height, desc.depth, desc.levels].map(|side| side as i32);
        // SAFETY: a new name, which the texture owns.
        let name = unsafe { gl.create_texture() }.map_err(fault_in("texture"))?;
        let texture = Texture::new(self, name, desc, None);
        // SAFETY: allocates storage for a new texture; OpenGL reports sizes above the limits as errors.
        unsafe {
            gl.bind_texture(desc.target, Some(name));
            match desc.target {
                glow::TEXTURE_2D_ARRAY => gl.tex_storage_3d(desc.target, levels, desc.format, width, height, depth),
                glow::TEXTURE_2D_MULTISAMPLE => {
                    // Here, `depth` is the number of samples.
                    gl.tex_storage_2d_multisample(desc.target, depth, desc.format, width, height, true);
                }
                _ => gl.tex_storage_2d(desc.target, levels, desc.format, width, height),
            }
        }
        self.check("texture").map(|()| texture)
    }

    /// Creates a buffer texture over a complete buffer. The texture keeps the buffer alive.
    pub(crate) fn buffer_texture(self: &Rc<Self>, buffer: &Buffer, format: u32) -> Result<Texture> {
        let gl = self.functions()?;
        let target = glow::TEXTURE_BUFFER;
        let desc = TextureDesc { target, format, width: 0, height: 1, depth: 1, levels: 1 };
        // SAFETY: a new name, which the texture owns.
        let name = unsafe { gl.create_texture() }.map_err(fault_in("texture"))?;
        let texture = Texture::new(self, name, desc, Some(buffer));
        // SAFETY: a new texture over a buffer of this context.
        unsafe {
            gl.bind_texture(target, Some(name));
            gl.tex_buffer(target, format, Some(buffer.name()));
        }
        self.check("texture").map(|()| texture)
    }

    /// Creates a framebuffer with a depth attachment and an optional color attachment. Each is a complete texture.
    pub(crate) fn framebuffer(self: &Rc<Self>, color: Option<&Texture>, depth: &Texture) -> Result<Framebuffer> {
        let depth = Attachment { image: depth, layer: None };
        self.create_framebuffer(color.map(|image| Attachment { image, layer: None }), Some(depth))
    }

    /// Creates a framebuffer with a color attachment and no depth attachment.
    pub(crate) fn color_framebuffer(self: &Rc<Self>, color: &Texture) -> Result<Framebuffer> {
        self.create_framebuffer(Some(Attachment { image: color, layer: None }), None)
    }

    /// Creates a framebuffer whose only attachment is one layer of an array of depth images.
    pub(crate) fn depth_layer_framebuffer(self: &Rc<Self>, image: &Texture, layer: u32) -> Result<Framebuffer> {
        self.create_framebuffer(None, Some(Attachment { image, layer: Some(layer) }))
    }

    /// Creates a framebuffer whose only attachment is one layer of an array of color images.
    pub(crate) fn color_layer_framebuffer(self: &Rc<Self>, image: &Texture, layer: u32) -> Result<Framebuffer> {
        self.create_framebuffer(Some(Attachment { image, layer: Some(layer) }), None)
    }

    fn create_framebuffer(
        self: &Rc<Self>,
        color: Option<Attachment<'_>>,
        depth: Option<Attachment<'_>>,
    ) -> Result<Framebuffer> {
        let gl = self.functions()?;
        // SAFETY: a new name, which the framebuffer owns.
        let name = unsafe { gl.create_framebuffer() }.map_err(fault_in("framebuffer"))?;
        let images = [color, depth].into_iter().flatten().map(|attachment| attachment.image);
        let framebuffer = Framebuffer::new(self, name, images);
        let target = glow::FRAMEBUFFER;
        // SAFETY: attaches textures of this context, which the framebuffer keeps alive.
        let status = unsafe {
            gl.bind_framebuffer(target, Some(name));
            for (attachment_point, attachment) in [(glow::COLOR_ATTACHMENT0, color), (glow::DEPTH_ATTACHMENT, depth)] {
                let Some(Attachment { image, layer }) = attachment else { continue };
                match layer {
                    Some(layer) => {
                        gl.framebuffer_texture_layer(target, attachment_point, Some(image.name()), 0, layer as i32)
                    }
                    None => gl.framebuffer_texture(target, attachment_point, Some(image.name()), 0),
                }
            }
            gl.draw_buffers(&[if color.is_some() { glow::COLOR_ATTACHMENT0 } else { glow::NONE }]);
            gl.check_framebuffer_status(target)
        };
        match status {
            glow::FRAMEBUFFER_COMPLETE => self.check("framebuffer").map(|()| framebuffer),
            status => Err(fault("framebuffer", format!("expected a complete framebuffer, got status 0x{status:04X}"))),
        }
    }

    /// Creates a vertex array of an index buffer and attributes. The vertex array keeps the buffers alive.
    pub(crate) fn vertex_array(
        self: &Rc<Self>,
        index_buffer: Option<&Buffer>,
        attributes: &[VertexAttribute<'_>],
    ) -> Result<VertexArray> {
        let gl = self.functions()?;
        // SAFETY: a new name, which the vertex array owns.
        let name = unsafe { gl.create_vertex_array() }.map_err(fault_in("vertex array"))?;
        let array =
            VertexArray::new(self, name, attributes.iter().map(|attribute| attribute.buffer).chain(index_buffer));
        // SAFETY: tightly packed attributes of 32-bit components in buffers of this context.
        unsafe {
            gl.bind_vertex_array(Some(name));
            for attribute in attributes {
                gl.bind_buffer(glow::ARRAY_BUFFER, Some(attribute.buffer.name()));
                gl.enable_vertex_attrib_array(attribute.location);
                if attribute.integer {
                    gl.vertex_attrib_pointer_i32(attribute.location, attribute.components, glow::UNSIGNED_INT, 0, 0);
                } else {
                    gl.vertex_attrib_pointer_f32(attribute.location, attribute.components, glow::FLOAT, false, 0, 0);
                }
            }
            gl.bind_buffer(glow::ELEMENT_ARRAY_BUFFER, index_buffer.map(Buffer::name));
            gl.bind_vertex_array(None);
        }
        self.check("vertex array").map(|()| array)
    }

    /// Sample positions within the pixels of a framebuffer, 0 to 1 from the lower left.
    pub(crate) fn sample_positions(&self, framebuffer: &Framebuffer, samples: u32) -> Result<Vec<[f32; 2]>> {
        type GetMultisample = unsafe extern "system" fn(u32, u32, *mut f32);
        let gl = self.functions()?;
        let address = self.context.address("glGetMultisamplefv");
        if address.is_null() {
            return Err(fault("samples", "expected the function glGetMultisamplefv, got none"));
        }
        // SAFETY: the address is that of glGetMultisamplefv, which has this signature and writes two floats.
        unsafe {
            let get_multisample = std::mem::transmute::<*const std::ffi::c_void, GetMultisample>(address);
            gl.bind_framebuffer(glow::FRAMEBUFFER, Some(framebuffer.name));
            let mut positions = vec![[0.5; 2]; samples as usize];
            for (index, position) in (0..).zip(&mut positions) {
                get_multisample(glow::SAMPLE_POSITION, index, position.as_mut_ptr());
            }
            self.check("samples").map(|()| positions)
        }
    }

    /// Sets the fixed-function state of the next draws.
    pub(crate) fn set_pipeline_state(&self, state: PipelineState) {
        let Some(gl) = self.functions_or_skip() else { return };
        let set_flag = |flag: u32, is_enabled: bool| {
            // SAFETY: flags that every 4.3 core context accepts.
            unsafe { if is_enabled { gl.enable(flag) } else { gl.disable(flag) } }
        };
        set_flag(glow::DEPTH_TEST, true);
        set_flag(glow::CULL_FACE, state.cull_back_faces);
        set_flag(glow::BLEND, state.blend);
        // SAFETY: sets state; no memory is accessed.
        unsafe {
            // Nearer surfaces have a larger depth. At equal depths, the surface that is drawn last wins.
            gl.depth_func(glow::GEQUAL);
            gl.depth_mask(state.depth_write);
            let one_minus_alpha = glow::ONE_MINUS_SRC_ALPHA;
            gl.blend_func_separate(glow::SRC_ALPHA, one_minus_alpha, glow::ZERO, one_minus_alpha);
        }
    }

    /// Draws triangles of the index buffer of `array`. A triangle has three u32 indices.
    pub(crate) fn draw_indexed(&self, array: &VertexArray, triangles: PieceRange) {
        let Some(gl) = self.functions_or_skip() else { return };
        // SAFETY: the indices come from validated meshes, or are 0, and stay below the number of elements of each
        // attribute.
        unsafe {
            gl.bind_vertex_array(Some(array.name));
            let (count, first_byte) = (3 * triangles.count() as i32, 12 * triangles.first as i32);
            gl.draw_elements(glow::TRIANGLES, count, glow::UNSIGNED_INT, first_byte);
            gl.bind_vertex_array(None);
        }
    }

    /// Draws vertices that the vertex shader computes from their index.
    pub(crate) fn draw_procedural(&self, array: &VertexArray, vertices: u32) {
        let Some(gl) = self.functions_or_skip() else { return };
        // SAFETY: no attribute is read.
        unsafe {
            gl.bind_vertex_array(Some(array.name));
            gl.draw_arrays(glow::TRIANGLES, 0, vertices as i32);
            gl.bind_vertex_array(None);
        }
    }

    /// Runs the bound compute program. Its writes are visible to later accesses only after a [`Self::barrier`] of their
    /// kind.
    pub(crate) fn dispatch(&self, workgroups_x: u32, workgroups_y: u32) {
        let Some(gl) = self.functions_or_skip() else { return };
        // SAFETY: the shaders check their own bounds.
        unsafe { gl.dispatch_compute(workgroups_x, workgroups_y, 1) }
    }

    /// Like [`Self::dispatch`]. The first three words of `workgroup_counts` are the numbers of workgroups in x, y and
    /// z.
    pub(crate) fn dispatch_indirect(&self, workgroup_counts: &Buffer) {
        let Some(gl) = self.functions_or_skip() else { return };
        // SAFETY: the buffer holds more than three words; the shaders check their own bounds.
        unsafe {
            gl.bind_buffer(glow::DISPATCH_INDIRECT_BUFFER, Some(workgroup_counts.name()));
            gl.dispatch_compute_indirect(0);
        }
    }

    /// Copies bytes between two buffers.
    pub(crate) fn copy(&self, copy: BufferCopy<'_>) {
        let BufferCopy { source, source_offset, target, target_offset, bytes } = copy;
        let range_ends = [source_offset.checked_add(bytes), target_offset.checked_add(bytes)];
        if range_ends.into_iter().zip([source, target]).any(|(end, buffer)| end.is_none_or(|end| end > buffer.bytes)) {
            return self.record_skipped(format!("expected a copy inside of both buffers, got {copy:?}"));
        }
        let Some(gl) = self.functions_or_skip() else { return };
        let (read_binding, write_binding) = (glow::COPY_READ_BUFFER, glow::COPY_WRITE_BUFFER);
        // SAFETY: the ranges are inside the buffers, whose sizes fit into an i32.
        unsafe {
            gl.bind_buffer(read_binding, Some(source.name()));
            gl.bind_buffer(write_binding, Some(target.name()));
            gl.copy_buffer_sub_data(
                read_binding,
                write_binding,
                source_offset as i32,
                target_offset as i32,
                bytes as i32,
            );
        }
    }
}

#[cfg(test)]
impl Gl {
    /// Makes the context current on another thread, so that no command can be issued on this one.
    pub(crate) fn occupy(&self) -> super::egl::testing::OccupiedContext {
        self.context.occupy()
    }
}

/// `Invalid`, because a size exceeds a limit of the device.
pub(crate) fn too_large(field: &str, limit: u64, got: u64) -> Error {
    modalcast_model::error::invalid(field, format!("at most {limit} on this device"), got)
}

#[cfg(test)]
mod tests;
