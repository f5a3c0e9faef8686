//! Thin layer over OpenGL: typed objects that free themselves (`gl/object.rs`), and the few commands that the passes
//! need. No other module calls OpenGL.
//!
//! Each object keeps its context alive. Each command makes the context current, so that several renderers can share a
//! thread. Callers that issue many commands hold a guard of [`Gl::make_current`]: the commands then do not switch.
//!
//! Commands that return nothing report their errors as OpenGL does: the next [`Gl::check`] returns the first of them. A
//! command whose arguments are wrong, or whose context cannot be made current, is not issued.
//!
//! Object names stay private. Other APIs get a [`GlBuffer`](modalcast_model::raster::GlBuffer), which keeps the buffer
//! alive.

mod barrier;
mod clear;
mod debug;
mod fence;
mod indirect;
mod layers;
mod limits;
mod object;
mod staging;
mod timer;

use std::cell::{Cell, RefCell};
use std::mem::ManuallyDrop;
use std::ops::Deref;
use std::rc::Rc;

use glow::HasContext as _;

pub(crate) use self::barrier::MemoryBarriers;
pub(crate) use self::clear::{ClearOp, VisibilityDirty};
pub(crate) use self::debug::is_enabled as is_debug_enabled;
pub(crate) use self::fence::Fence;
pub(crate) use self::limits::Limits;
pub(crate) use self::object::{Buffer, Framebuffer, Program, Texture, TextureDesc, VertexArray};
pub(crate) use self::staging::{ReadbackView, StagingBuffer};
pub(crate) use self::timer::PassTimer;
use super::egl::{Context, CurrentContext};
use modalcast_model::error::{Error, Result, fault_in};

/// OpenGL constants that other modules use.
pub(crate) use glow::{
    CLAMP_TO_EDGE, COMPUTE_SHADER, DEPTH_COMPONENT32F, DYNAMIC_DRAW, FRAGMENT_SHADER, LINEAR, LINEAR_MIPMAP_LINEAR,
    LINEAR_MIPMAP_NEAREST, NEAREST, R32F, R32UI, REPEAT, RG16F, RG32F, RGB32F, RGB32UI, RGBA8, RGBA16F, RGBA32F,
    SRGB8_ALPHA8, STATIC_DRAW, STREAM_COPY, STREAM_READ, TEXTURE_2D, TEXTURE_2D_ARRAY, TEXTURE_2D_MULTISAMPLE,
    TEXTURE_MAG_FILTER, TEXTURE_MIN_FILTER, TEXTURE_WRAP_S, TEXTURE_WRAP_T, VERTEX_SHADER,
};

type GetResetStatus = unsafe extern "system" fn() -> u32;

/// An OpenGL context and its functions.
pub(crate) struct Gl {
    /// Taken by `drop`.
    functions: ManuallyDrop<glow::Context>,
    context: Context,
    pub(crate) limits: Limits,
    /// glGetGraphicsResetStatus, where the context has it.
    reset_status: Option<GetResetStatus>,
    /// The first error of a command that was not issued, until the next check.
    skipped: RefCell<Option<String>>,
    /// Whether the log names the objects that could not be deleted.
    is_leak_logged: Cell<bool>,
    /// Pool of timer queries that are not in use.
    free_queries: RefCell<Vec<glow::Query>>,
    /// Buffers that will be freed once their readers are done.
    retired: RefCell<Vec<staging::RetiredBuffer>>,
}

/// Keeps a context current on this thread, so that commands can be issued without a switch. Dropping the guard restores
/// the context that was current before. If a panic unwinds, the guard also discards the errors of the interrupted
/// commands, so that the next check does not report them for other commands.
#[derive(Debug)]
#[must_use = "the previous context becomes current again when the guard is dropped"]
pub(crate) struct CurrentGl {
    gl: Rc<Gl>,
    _context: CurrentContext,
}

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
        // The functions remove their debug callback from the current context, which must be this one. Otherwise they
        // leak, and with them the callback, which the driver may still call.
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

/// A vertex attribute: location, buffer, number of 32-bit components, and whether it is an integer.
pub(crate) struct VertexAttribute<'a> {
    pub(crate) location: u32,
    pub(crate) buffer: &'a Buffer,
    pub(crate) components: i32,
    pub(crate) integer: bool,
}

/// A copy between two buffers; offsets are in bytes.
#[derive(Debug, Clone, Copy)]
pub(crate) struct BufferCopy<'a> {
    pub(crate) from: &'a Buffer,
    pub(crate) from_offset: u64,
    pub(crate) to: &'a Buffer,
    pub(crate) to_offset: u64,
    pub(crate) bytes: u64,
}

impl<'a> BufferCopy<'a> {
    /// A copy of the first `bytes` bytes to the start of the other buffer.
    pub(crate) const fn first(bytes: u64, from: &'a Buffer, to: &'a Buffer) -> Self {
        Self { from, from_offset: 0, to, to_offset: 0, bytes }
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
    /// Depth outside near and far is clamped instead of clipped.
    pub(crate) depth_clamp: bool,
    /// Depth is offset away from the camera, so that surfaces in the same plane stay visible.
    pub(crate) polygon_offset: bool,
    pub(crate) cull: bool,
    /// Colors are blended over the existing ones; alpha becomes the transmittance: the share of the background that
    /// remains visible.
    pub(crate) blend: bool,
}

impl Gl {
    pub(crate) fn new(context: Context) -> Result<Rc<Self>> {
        let current = context.make_current()?;
        let address = |name: &std::ffi::CStr| name.to_str().map_or(std::ptr::null(), |name| context.address(name));
        // SAFETY: the context is current on this thread, and EGL returned the addresses for this context.
        let mut functions = unsafe { glow::Context::from_loader_function_cstr(address) };
        let limits = Limits::of(&functions);
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
            skipped: RefCell::default(),
            is_leak_logged: Cell::default(),
            free_queries: RefCell::default(),
            retired: RefCell::default(),
        }))
    }

    /// Makes the context current on this thread while the returned guard exists.
    ///
    /// # Errors
    /// `Fault` when EGL refuses; no command can be issued then.
    pub(crate) fn make_current(self: &Rc<Self>) -> Result<CurrentGl> {
        Ok(CurrentGl { gl: Rc::clone(self), _context: self.context.make_current()? })
    }

    /// Makes the context current and leaves it current.
    ///
    /// # Errors
    /// `Fault` when EGL refuses.
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
        self.functions().map_err(|error| self.skip(error.to_string())).ok()
    }

    /// Records the error of a command that is not issued; the next check returns the first one.
    fn skip(&self, reason: String) {
        self.skipped.borrow_mut().get_or_insert(reason);
    }

    /// Deletes an object. If the context cannot be made current, the object leaks until the context is destroyed.
    fn delete(&self, delete: impl FnOnce(&glow::Context)) {
        match self.functions() {
            Ok(gl) => delete(&gl),
            Err(error) => self.log_leak(&error),
        }
    }

    fn log_leak(&self, error: &Error) {
        if !self.is_leak_logged.replace(true) {
            tracing::warn!(%error, "OpenGL objects are not deleted before their context");
        }
    }

    /// Fails if a command failed since the last check.
    ///
    /// # Errors
    /// `Fault` of `stage` with the first error of a command that was not issued, or with an error of OpenGL;
    /// `DeviceLost` when the context is lost.
    pub(crate) fn check(&self, stage: &'static str) -> Result<()> {
        if let Some(reason) = self.skipped.take() {
            return Err(fault_in(stage)(reason));
        }
        let gl = self.functions().map_err(fault_in(stage))?;
        // SAFETY: a query without side effects on memory; the context is current.
        match unsafe { gl.get_error() } {
            glow::NO_ERROR => Ok(()),
            glow::OUT_OF_MEMORY => Err(fault_in(stage)("OpenGL is out of memory")),
            glow::CONTEXT_LOST => Err(self.loss(stage).unwrap_or_else(|| {
                let reason = "OpenGL reports a lost context".into();
                Error::DeviceLost { stage, reason }
            })),
            error => Err(fault_in(stage)(format!("OpenGL error 0x{error:04X}"))),
        }
    }

    /// `DeviceLost` with the reason if the context is lost: the device was reset, and all objects are gone.
    fn loss(&self, stage: &'static str) -> Option<Error> {
        let (status, _current) = (self.reset_status?, self.functions().ok()?);
        // SAFETY: the address is that of glGetGraphicsResetStatus of the current context; a query without side effects.
        let reason = match unsafe { status() } {
            glow::NO_ERROR => return None,
            glow::GUILTY_CONTEXT_RESET => "a command of this OpenGL context reset the device",
            glow::INNOCENT_CONTEXT_RESET => "a command of another OpenGL context reset the device",
            _ => "OpenGL reports a reset of the device",
        };
        Some(Error::DeviceLost { stage, reason: reason.into() })
    }

    /// Forgets the errors since the last check.
    fn discard_errors(&self) {
        self.skipped.take();
        let Ok(gl) = self.functions() else { return };
        // OpenGL may have one error per unit of the driver. A lost context never stops reporting errors.
        for _ in 0..16 {
            // SAFETY: a query without side effects on memory; the context is current.
            if unsafe { gl.get_error() } == glow::NO_ERROR {
                return;
            }
        }
    }

    /// Creates a buffer of `bytes` bytes, at least 4 because OpenGL has no empty buffers. Its content is `data`, or
    /// undefined without data.
    ///
    /// # Errors
    /// `Fault` when the data has another length, the buffer is over 2 GiB, or OpenGL refuses.
    pub(crate) fn buffer(self: &Rc<Self>, bytes: u64, usage: u32, data: Option<&[u8]>) -> Result<Buffer> {
        let fail = fault_in("buffer");
        let size = i32::try_from(bytes.max(4))
            .map_err(|_| fail(format!("{bytes} bytes is over the 2 GiB that one buffer may have")))?;
        if let Some(data) = data
            && data.len() as u64 != bytes
        {
            return Err(fail(format!("expected {bytes} bytes of data, got {}", data.len())));
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
                    gl.tex_storage_2d_multisample(desc.target, depth, desc.format, width, height, true);
                }
                _ => gl.tex_storage_2d(desc.target, levels, desc.format, width, height),
            }
        }
        self.check("texture").map(|()| texture)
    }

    /// Creates a buffer texture over a whole buffer, which it keeps alive.
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

    /// Compiles and links a program from pairs of stage and source.
    pub(crate) fn program(self: &Rc<Self>, label: &str, stages: &[(u32, &str)]) -> Result<Program> {
        let gl = self.functions()?;
        let fail = |log: String| fault_in("shader")(format!("{label}: {log}"));
        // SAFETY: new objects; the shaders are flagged for deletion and live until the program is deleted.
        unsafe {
            let name = gl.create_program().map_err(fault_in("shader"))?;
            let program = Program { gl: Rc::clone(self), name };
            for (stage, source) in stages {
                let shader = gl.create_shader(*stage).map_err(fault_in("shader"))?;
                gl.shader_source(shader, source);
                gl.compile_shader(shader);
                gl.attach_shader(name, shader);
                gl.delete_shader(shader);
                if !gl.get_shader_compile_status(shader) {
                    return Err(fail(gl.get_shader_info_log(shader)));
                }
            }
            gl.link_program(name);
            if gl.get_program_link_status(name) { Ok(program) } else { Err(fail(gl.get_program_info_log(name))) }
        }
    }

    /// Creates a framebuffer over whole images.
    pub(crate) fn framebuffer(self: &Rc<Self>, color: Option<&Texture>, depth: &Texture) -> Result<Framebuffer> {
        let depth = Attachment { image: depth, layer: None };
        self.attach_framebuffer(color.map(|image| Attachment { image, layer: None }), Some(depth))
    }

    /// Creates a framebuffer with a color attachment and no depth.
    pub(crate) fn color_framebuffer(self: &Rc<Self>, color: &Texture) -> Result<Framebuffer> {
        self.attach_framebuffer(Some(Attachment { image: color, layer: None }), None)
    }

    /// Creates a framebuffer of one layer of an array texture: of its depth, or of its only color attachment.
    pub(crate) fn layer_framebuffer(
        self: &Rc<Self>,
        image: &Texture,
        is_depth: bool,
        layer: u32,
    ) -> Result<Framebuffer> {
        let attachment = Attachment { image, layer: Some(layer) };
        if is_depth {
            self.attach_framebuffer(None, Some(attachment))
        } else {
            self.attach_framebuffer(Some(attachment), None)
        }
    }

    fn attach_framebuffer(
        self: &Rc<Self>,
        color: Option<Attachment<'_>>,
        depth: Option<Attachment<'_>>,
    ) -> Result<Framebuffer> {
        let gl = self.functions()?;
        // SAFETY: a new name, which the framebuffer owns.
        let name = unsafe { gl.create_framebuffer() }.map_err(fault_in("framebuffer"))?;
        let attached = [color, depth].into_iter().flatten().map(|attachment| attachment.image);
        let framebuffer = Framebuffer::new(self, name, attached);
        let target = glow::FRAMEBUFFER;
        // SAFETY: attaches textures of this context, which the framebuffer keeps alive.
        let status = unsafe {
            gl.bind_framebuffer(target, Some(name));
            for (point, attachment) in [(glow::COLOR_ATTACHMENT0, color), (glow::DEPTH_ATTACHMENT, depth)] {
                let Some(Attachment { image, layer }) = attachment else { continue };
                match layer {
                    Some(layer) => gl.framebuffer_texture_layer(target, point, Some(image.name()), 0, layer as i32),
                    None => gl.framebuffer_texture(target, point, Some(image.name()), 0),
                }
            }
            gl.draw_buffers(&[if color.is_some() { glow::COLOR_ATTACHMENT0 } else { glow::NONE }]);
            gl.check_framebuffer_status(target)
        };
        match status {
            glow::FRAMEBUFFER_COMPLETE => self.check("framebuffer").map(|()| framebuffer),
            status => Err(fault_in("framebuffer")(format!("incomplete, 0x{status:04X}"))),
        }
    }

    /// Creates a vertex array over an index buffer and attributes, which it keeps alive.
    pub(crate) fn vertex_array(
        self: &Rc<Self>,
        index: Option<&Buffer>,
        from: &[VertexAttribute<'_>],
    ) -> Result<VertexArray> {
        let gl = self.functions()?;
        // SAFETY: a new name, which the vertex array owns.
        let name = unsafe { gl.create_vertex_array() }.map_err(fault_in("vertex array"))?;
        let array = VertexArray::new(self, name, from.iter().map(|attribute| attribute.buffer).chain(index));
        // SAFETY: tightly packed attributes of 32-bit components in buffers of this context.
        unsafe {
            gl.bind_vertex_array(Some(name));
            for attribute in from {
                gl.bind_buffer(glow::ARRAY_BUFFER, Some(attribute.buffer.name()));
                gl.enable_vertex_attrib_array(attribute.location);
                if attribute.integer {
                    gl.vertex_attrib_pointer_i32(attribute.location, attribute.components, glow::UNSIGNED_INT, 0, 0);
                } else {
                    gl.vertex_attrib_pointer_f32(attribute.location, attribute.components, glow::FLOAT, false, 0, 0);
                }
            }
            gl.bind_buffer(glow::ELEMENT_ARRAY_BUFFER, index.map(Buffer::name));
            gl.bind_vertex_array(None);
        }
        self.check("vertex array").map(|()| array)
    }

    /// Sample positions within the pixels of a framebuffer, 0 to 1 from the lower left.
    pub(crate) fn sample_positions(&self, of: &Framebuffer, samples: u32) -> Result<Vec<[f32; 2]>> {
        type GetMultisample = unsafe extern "system" fn(u32, u32, *mut f32);
        let gl = self.functions()?;
        let address = self.context.address("glGetMultisamplefv");
        if address.is_null() {
            return Err(fault_in("samples")("glGetMultisamplefv is missing"));
        }
        // SAFETY: the address is that of glGetMultisamplefv, which has this signature and writes two floats.
        unsafe {
            let ask = std::mem::transmute::<*const std::ffi::c_void, GetMultisample>(address);
            gl.bind_framebuffer(glow::FRAMEBUFFER, Some(of.name));
            let mut places = vec![[0.5; 2]; samples as usize];
            for (index, place) in (0..).zip(&mut places) {
                ask(glow::SAMPLE_POSITION, index, place.as_mut_ptr());
            }
            self.check("samples").map(|()| places)
        }
    }

    pub(crate) fn set_pipeline_state(&self, fixed: PipelineState) {
        let Some(gl) = self.functions_or_skip() else { return };
        let flip = |flag: u32, on: bool| {
            // SAFETY: flags that every 4.3 core context accepts.
            unsafe { if on { gl.enable(flag) } else { gl.disable(flag) } }
        };
        flip(glow::DEPTH_TEST, true);
        flip(glow::DEPTH_CLAMP, fixed.depth_clamp);
        flip(glow::POLYGON_OFFSET_FILL, fixed.polygon_offset);
        flip(glow::CULL_FACE, fixed.cull);
        flip(glow::BLEND, fixed.blend);
        // SAFETY: sets state; no memory is accessed.
        unsafe {
            gl.depth_func(glow::LEQUAL);
            gl.polygon_offset(1.0, 8.0);
            gl.depth_mask(fixed.depth_write);
            let left = glow::ONE_MINUS_SRC_ALPHA;
            gl.blend_func_separate(glow::SRC_ALPHA, left, glow::ZERO, left);
        }
    }

    /// Draws `triangles` triangles of an array's index buffer from triangle `first` on.
    pub(crate) fn draw_indexed(&self, array: &VertexArray, first: usize, triangles: usize) {
        let Some(gl) = self.functions_or_skip() else { return };
        // SAFETY: the indices come from validated meshes and stay below the number of elements of each attribute.
        unsafe {
            gl.bind_vertex_array(Some(array.name));
            gl.draw_elements(glow::TRIANGLES, 3 * triangles as i32, glow::UNSIGNED_INT, 12 * first as i32);
            gl.bind_vertex_array(None);
        }
    }

    /// Draws vertices that the vertex shader derives from their index.
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
    pub(crate) fn dispatch(&self, groups_x: u32, groups_y: u32) {
        let Some(gl) = self.functions_or_skip() else { return };
        // SAFETY: the shaders check their own bounds.
        unsafe { gl.dispatch_compute(groups_x, groups_y, 1) }
    }

    /// Like [`Self::dispatch`]; the first three words of a buffer give the number of workgroups.
    pub(crate) fn dispatch_indirect(&self, groups: &Buffer) {
        let Some(gl) = self.functions_or_skip() else { return };
        // SAFETY: the buffer holds more than three words; the shaders check their own bounds.
        unsafe {
            gl.bind_buffer(glow::DISPATCH_INDIRECT_BUFFER, Some(groups.name()));
            gl.dispatch_compute_indirect(0);
        }
    }

    /// Copies bytes between two buffers.
    pub(crate) fn copy(&self, copy: BufferCopy<'_>) {
        let BufferCopy { from, from_offset, to, to_offset, bytes } = copy;
        let ends = [from_offset.checked_add(bytes), to_offset.checked_add(bytes)];
        if ends.into_iter().zip([from, to]).any(|(end, buffer)| end.is_none_or(|end| end > buffer.bytes)) {
            return self.skip(format!("a copy beyond the end of a buffer: {copy:?}"));
        }
        let Some(gl) = self.functions_or_skip() else { return };
        let (read, write) = (glow::COPY_READ_BUFFER, glow::COPY_WRITE_BUFFER);
        // SAFETY: the ranges are inside the buffers, whose sizes fit into an i32.
        unsafe {
            gl.bind_buffer(read, Some(from.name()));
            gl.bind_buffer(write, Some(to.name()));
            gl.copy_buffer_sub_data(read, write, from_offset as i32, to_offset as i32, bytes as i32);
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

/// Error for a size above a device limit, which the caller can act on.
pub(crate) fn too_large(what: &str, limit: u64, given: u64) -> Error {
    modalcast_model::error::invalid(what, format!("at most {limit} on this device"), given)
}

#[cfg(test)]
mod tests;
