//! Thin layer over OpenGL: typed objects that free themselves (`gl/object.rs`), and the few commands that the passes
//! need. No other module calls OpenGL.
//!
//! Each object keeps its context alive and makes it current before each use and before it is freed, so that several
//! renderers can share a thread. Object names stay private except for [`Buffer::name`], which CUDA registers.

mod clear;
mod culling;
mod debug;
mod fence;
mod indirect;
mod layers;
mod limits;
mod object;
mod staging;
mod timer;

use std::cell::RefCell;
use std::rc::Rc;

use glow::HasContext as _;

pub(crate) use self::clear::{ClearOp, VisibilityDirty};
pub(crate) use self::debug::is_enabled as is_debug_enabled;
pub(crate) use self::fence::Fence;
pub(crate) use self::limits::Limits;
pub(crate) use self::object::{Buffer, Framebuffer, Program, Texture, TextureDesc, VertexArray};
pub(crate) use self::staging::{ReadbackView, StagingBuffer};
pub(crate) use self::timer::PassTimer;
use super::egl::Context;
use modalcast_model::error::{Error, Result, fault_in};

/// OpenGL constants that other modules use.
pub(crate) use glow::{
    CLAMP_TO_EDGE, COMPUTE_SHADER, DEPTH_COMPONENT32F, DYNAMIC_DRAW, FRAGMENT_SHADER, LINEAR, LINEAR_MIPMAP_LINEAR,
    LINEAR_MIPMAP_NEAREST, NEAREST, R32F, R32UI, REPEAT, RG16F, RG32F, RGB32F, RGB32UI, RGBA8, RGBA16F, RGBA32F,
    SRGB8_ALPHA8, STATIC_DRAW, STREAM_COPY, STREAM_READ, TEXTURE_2D, TEXTURE_2D_ARRAY, TEXTURE_2D_MULTISAMPLE,
    TEXTURE_MAG_FILTER, TEXTURE_MIN_FILTER, TEXTURE_WRAP_S, TEXTURE_WRAP_T, VERTEX_SHADER,
};

/// An OpenGL context and its functions.
pub(crate) struct Gl {
    // Declared before the context, so that it is dropped while the context exists.
    glow: glow::Context,
    context: Context,
    pub(crate) limits: Limits,
    /// Pool of timer queries that are not in use.
    free_queries: RefCell<Vec<glow::Query>>,
    /// Buffers that will be freed once their readers are done.
    retired: RefCell<Vec<staging::RetiredBuffer>>,
}

impl Drop for Gl {
    fn drop(&mut self) {
        // Dropping `glow` removes the debug callback from the current context, which must be this one.
        self.context.make_current().ok();
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
        context.make_current()?;
        let address = |name: &std::ffi::CStr| name.to_str().map_or(std::ptr::null(), |name| context.address(name));
        // SAFETY: the context is current on this thread, and EGL returned the addresses for this context.
        let mut glow = unsafe { glow::Context::from_loader_function_cstr(address) };
        let limits = Limits::of(&glow);
        if context.is_debug {
            debug::install_debug_callback(&mut glow);
        }
        Ok(Rc::new(Self { glow, context, limits, free_queries: RefCell::default(), retired: RefCell::default() }))
    }

    /// The OpenGL functions; makes the context current first.
    fn current(&self) -> &glow::Context {
        // If the context cannot be made current, `check` reports the errors at the end of the pass.
        self.context.make_current().ok();
        &self.glow
    }

    /// Fails if OpenGL reported an error since the last check.
    pub(crate) fn check(&self, stage: &'static str) -> Result<()> {
        // SAFETY: a query without side effects on memory; the context is current.
        match unsafe { self.current().get_error() } {
            glow::NO_ERROR => Ok(()),
            glow::OUT_OF_MEMORY => Err(fault_in(stage)("OpenGL is out of memory")),
            error => Err(fault_in(stage)(format!("OpenGL error 0x{error:04X}"))),
        }
    }

    /// Creates a buffer of `bytes`, at least 4 because OpenGL has no empty buffers. It is filled from `data` if that
    /// has exactly `bytes` bytes.
    pub(crate) fn buffer(self: &Rc<Self>, bytes: u64, usage: u32, data: Option<&[u8]>) -> Result<Buffer> {
        let size = i32::try_from(bytes.max(4))
            .map_err(|_| fault_in("buffer")(format!("{bytes} bytes is over the 2 GiB that one buffer may have")))?;
        let gl = self.current();
        // SAFETY: the size is that of the data, or there is no data and the content stays undefined until the first
        // write.
        let name = unsafe {
            let name = gl.create_buffer().map_err(fault_in("buffer"))?;
            gl.bind_buffer(glow::COPY_WRITE_BUFFER, Some(name));
            match data {
                Some(data) if data.len() as u64 == bytes && bytes >= 4 => {
                    gl.buffer_data_u8_slice(glow::COPY_WRITE_BUFFER, data, usage);
                }
                _ => gl.buffer_data_size(glow::COPY_WRITE_BUFFER, size, usage),
            }
            name
        };
        let buffer = Buffer { gl: Rc::clone(self), name, bytes: bytes.max(4) };
        self.check("buffer").map(|()| buffer)
    }

    pub(crate) fn texture(self: &Rc<Self>, desc: TextureDesc) -> Result<Texture> {
        let gl = self.current();
        let [width, height, depth, levels] = [desc.width, desc.height, desc.depth, desc.levels].map(|side| side as i32);
        // SAFETY: allocates storage for a new texture; OpenGL reports sizes above the limits as errors.
        let name = unsafe {
            let name = gl.create_texture().map_err(fault_in("texture"))?;
            gl.bind_texture(desc.target, Some(name));
            match desc.target {
                glow::TEXTURE_2D_ARRAY => gl.tex_storage_3d(desc.target, levels, desc.format, width, height, depth),
                glow::TEXTURE_2D_MULTISAMPLE => {
                    gl.tex_storage_2d_multisample(desc.target, depth, desc.format, width, height, true);
                }
                _ => gl.tex_storage_2d(desc.target, levels, desc.format, width, height),
            }
            name
        };
        let texture = Texture { gl: Rc::clone(self), name, desc };
        self.check("texture").map(|()| texture)
    }

    /// Creates a buffer texture over a whole buffer. The buffer must outlive it.
    pub(crate) fn buffer_texture(self: &Rc<Self>, buffer: &Buffer, format: u32) -> Result<Texture> {
        let gl = self.current();
        let target = glow::TEXTURE_BUFFER;
        // SAFETY: a new texture over a buffer of this context.
        let name = unsafe {
            let name = gl.create_texture().map_err(fault_in("texture"))?;
            gl.bind_texture(target, Some(name));
            gl.tex_buffer(target, format, Some(buffer.name));
            name
        };
        let desc = TextureDesc { target, format, width: 0, height: 1, depth: 1, levels: 1 };
        let texture = Texture { gl: Rc::clone(self), name, desc };
        self.check("texture").map(|()| texture)
    }

    /// Compiles and links a program from pairs of stage and source.
    pub(crate) fn program(self: &Rc<Self>, label: &str, stages: &[(u32, &str)]) -> Result<Program> {
        let gl = self.current();
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

    pub(crate) fn framebuffer(self: &Rc<Self>, color: Option<&Texture>, depth: &Texture) -> Result<Framebuffer> {
        self.attach_framebuffer(color, Some(depth))
    }

    fn attach_framebuffer(self: &Rc<Self>, color: Option<&Texture>, depth: Option<&Texture>) -> Result<Framebuffer> {
        let gl = self.current();
        // SAFETY: attaches textures of this context; completeness is checked right after.
        unsafe {
            let name = gl.create_framebuffer().map_err(fault_in("framebuffer"))?;
            let framebuffer = Framebuffer { gl: Rc::clone(self), name };
            gl.bind_framebuffer(glow::FRAMEBUFFER, Some(name));
            if let Some(color) = color {
                gl.framebuffer_texture(glow::FRAMEBUFFER, glow::COLOR_ATTACHMENT0, Some(color.name), 0);
            }
            if let Some(depth) = depth {
                gl.framebuffer_texture(glow::FRAMEBUFFER, glow::DEPTH_ATTACHMENT, Some(depth.name), 0);
            }
            gl.draw_buffers(&[if color.is_some() { glow::COLOR_ATTACHMENT0 } else { glow::NONE }]);
            match gl.check_framebuffer_status(glow::FRAMEBUFFER) {
                glow::FRAMEBUFFER_COMPLETE => self.check("framebuffer").map(|()| framebuffer),
                status => Err(fault_in("framebuffer")(format!("incomplete, 0x{status:04X}"))),
            }
        }
    }

    pub(crate) fn vertex_array(
        self: &Rc<Self>,
        index: Option<&Buffer>,
        from: &[VertexAttribute<'_>],
    ) -> Result<VertexArray> {
        let gl = self.current();
        // SAFETY: tightly packed attributes of 32-bit components in buffers of this context.
        unsafe {
            let name = gl.create_vertex_array().map_err(fault_in("vertex array"))?;
            let array = VertexArray { gl: Rc::clone(self), name };
            gl.bind_vertex_array(Some(name));
            for attribute in from {
                gl.bind_buffer(glow::ARRAY_BUFFER, Some(attribute.buffer.name));
                gl.enable_vertex_attrib_array(attribute.location);
                if attribute.integer {
                    gl.vertex_attrib_pointer_i32(attribute.location, attribute.components, glow::UNSIGNED_INT, 0, 0);
                } else {
                    gl.vertex_attrib_pointer_f32(attribute.location, attribute.components, glow::FLOAT, false, 0, 0);
                }
            }
            gl.bind_buffer(glow::ELEMENT_ARRAY_BUFFER, index.map(|index| index.name));
            gl.bind_vertex_array(None);
            self.check("vertex array").map(|()| array)
        }
    }

    /// Sample positions within the pixels of a framebuffer, 0 to 1 from the lower left.
    pub(crate) fn sample_positions(&self, of: &Framebuffer, samples: u32) -> Result<Vec<[f32; 2]>> {
        type GetMultisample = unsafe extern "system" fn(u32, u32, *mut f32);
        let gl = self.current();
        let address = self.context.address("glGetMultisamplefv");
        if address.is_null() {
            return Err(fault_in("samples")("glGetMultisamplefv is not there"));
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
        let gl = self.current();
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
        let gl = self.current();
        // SAFETY: the indices come from validated meshes and stay below the number of elements of each attribute.
        unsafe {
            gl.bind_vertex_array(Some(array.name));
            gl.draw_elements(glow::TRIANGLES, 3 * triangles as i32, glow::UNSIGNED_INT, 12 * first as i32);
            gl.bind_vertex_array(None);
        }
    }

    /// Draws vertices that the vertex shader derives from their index.
    pub(crate) fn draw_procedural(&self, array: &VertexArray, vertices: u32) {
        let gl = self.current();
        // SAFETY: no attribute is read.
        unsafe {
            gl.bind_vertex_array(Some(array.name));
            gl.draw_arrays(glow::TRIANGLES, 0, vertices as i32);
            gl.bind_vertex_array(None);
        }
    }

    /// Runs the bound compute program, followed by a barrier that makes its writes visible to later commands.
    pub(crate) fn dispatch(&self, groups_x: u32, groups_y: u32) {
        let gl = self.current();
        // SAFETY: the shaders check their own bounds.
        unsafe {
            gl.dispatch_compute(groups_x, groups_y, 1);
            gl.memory_barrier(glow::ALL_BARRIER_BITS);
        }
    }

    /// Like [`Self::dispatch`]; the first three words of a buffer give the number of workgroups.
    pub(crate) fn dispatch_indirect(&self, groups: &Buffer) {
        let gl = self.current();
        // SAFETY: the buffer holds more than three words; the shaders check their own bounds.
        unsafe {
            gl.bind_buffer(glow::DISPATCH_INDIRECT_BUFFER, Some(groups.name));
            gl.dispatch_compute_indirect(0);
            gl.memory_barrier(glow::ALL_BARRIER_BITS);
        }
    }

    pub(crate) fn copy(&self, from: &Buffer, to: &Buffer, bytes: u64) {
        self.copy_to_offset(from, (to, 0), bytes);
    }

    /// Copies the first `bytes` bytes to byte offset `place` of the other buffer.
    pub(crate) fn copy_to_offset(&self, from: &Buffer, (to, place): (&Buffer, u64), bytes: u64) {
        let gl = self.current();
        let (read, write) = (glow::COPY_READ_BUFFER, glow::COPY_WRITE_BUFFER);
        // SAFETY: OpenGL rejects ranges outside either buffer.
        unsafe {
            gl.bind_buffer(read, Some(from.name));
            gl.bind_buffer(write, Some(to.name));
            gl.copy_buffer_sub_data(read, write, 0, place as i32, bytes as i32);
        }
    }
}

/// Error for a size above a device limit, which the caller can act on.
pub(crate) fn too_large(what: &str, limit: u64, given: u64) -> Error {
    modalcast_model::error::invalid(what, format!("at most {limit} on this device"), given)
}
