//! Buffers, textures, programs, framebuffers and vertex arrays. Each owns its OpenGL name (the integer that identifies
//! the object) and deletes the object when dropped. An object that refers to other objects shares their ownership, so
//! that they are deleted later.

use std::os::fd::OwnedFd;
use std::rc::Rc;

use glow::HasContext as _;

use super::Gl;
use super::external_memory::MemoryObject;
use modalcast_model::error::{Result, fault, fault_in};
use modalcast_model::raster::{GlBuffer, GlBufferOwner};

/// A buffer object of fixed size.
#[derive(Debug)]
pub(crate) struct Buffer {
    object: Rc<BufferObject>,
    pub(crate) bytes: u64,
}

/// The name of a buffer. The buffer is deleted once no [`Buffer`], no other object and no other API refers to it.
#[derive(Debug)]
pub(super) struct BufferObject {
    pub(super) gl: Rc<Gl>,
    name: glow::Buffer,
    /// The imported memory of the buffer. Fields are dropped after `drop` has deleted the buffer.
    memory: Option<MemoryObject>,
}

/// Storage parameters of a texture.
#[derive(Debug, Clone, Copy)]
pub(crate) struct TextureDesc {
    pub(crate) target: u32,
    pub(crate) format: u32,
    pub(crate) width: u32,
    pub(crate) height: u32,
    /// Number of layers of an array or of samples of a multisampled image, else 1.
    pub(crate) depth: u32,
    /// Number of mipmap levels.
    pub(crate) levels: u32,
}

/// A texture object: immutable storage, or a view of a buffer.
#[derive(Debug)]
pub(crate) struct Texture {
    object: Rc<TextureObject>,
    pub(crate) desc: TextureDesc,
}

/// The name of a texture. The texture is deleted once no [`Texture`] and no framebuffer refers to it.
#[derive(Debug)]
struct TextureObject {
    gl: Rc<Gl>,
    name: glow::Texture,
    /// The buffer of a buffer texture.
    _buffer: Option<Rc<BufferObject>>,
}

/// A linked shader program.
#[derive(Debug)]
pub(crate) struct Program {
    pub(super) gl: Rc<Gl>,
    pub(super) name: glow::Program,
}

/// A framebuffer object. It keeps its attachments alive.
#[derive(Debug)]
pub(crate) struct Framebuffer {
    gl: Rc<Gl>,
    pub(super) name: glow::Framebuffer,
    _attachments: Vec<Rc<TextureObject>>,
}

/// A vertex array object. It keeps its buffers alive.
#[derive(Debug)]
pub(crate) struct VertexArray {
    gl: Rc<Gl>,
    pub(super) name: glow::VertexArray,
    _buffers: Vec<Rc<BufferObject>>,
}

/// A buffer range that is mapped for reading; unmapped when dropped.
struct ReadMapping<'a> {
    gl: super::Functions<'a>,
    name: glow::Buffer,
    pointer: *const u8,
    bytes: usize,
}

impl<'a> ReadMapping<'a> {
    /// Maps the first `bytes` bytes of a buffer; `bytes` must be at least 1. Waits for pending writes.
    fn new(buffer: &'a Buffer, bytes: usize) -> Result<Self> {
        let (gl, name) = (buffer.object.gl.functions()?, buffer.name());
        // SAFETY: OpenGL rejects a range that is not inside the buffer or that is already mapped.
        let pointer = unsafe {
            gl.bind_buffer(glow::COPY_READ_BUFFER, Some(name));
            gl.map_buffer_range(glow::COPY_READ_BUFFER, 0, bytes as i32, glow::MAP_READ_BIT)
        };
        if pointer.is_null() {
            return Err(fault("read", "the buffer cannot be mapped"));
        }
        Ok(Self { gl, name, pointer, bytes })
    }

    /// The mapped bytes.
    fn bytes(&self) -> &[u8] {
        // SAFETY: the range is mapped while this value exists. No command that writes the range is issued meanwhile,
        // because the only caller copies the bytes at once.
        unsafe { std::slice::from_raw_parts(self.pointer, self.bytes) }
    }
}

impl Drop for ReadMapping<'_> {
    fn drop(&mut self) {
        // SAFETY: the buffer is mapped, and the bytes are not used afterwards.
        unsafe {
            self.gl.bind_buffer(glow::COPY_READ_BUFFER, Some(self.name));
            self.gl.unmap_buffer(glow::COPY_READ_BUFFER);
        }
    }
}

impl Buffer {
    /// Takes ownership of a name whose storage has `bytes` bytes.
    pub(super) fn new(gl: &Rc<Gl>, name: glow::Buffer, bytes: u64) -> Self {
        Self { object: Rc::new(BufferObject { gl: Rc::clone(gl), name, memory: None }), bytes }
    }

    /// Creates a buffer of `bytes` bytes at the start of another API's memory of `allocated_bytes` bytes. The memory
    /// lives at least as long as the buffer. OpenGL does not order its commands with those of the other API.
    ///
    /// # Errors
    /// `Fault` when the context cannot import memory, refuses this memory, or the memory is smaller than the buffer.
    pub(crate) fn import(gl: &Rc<Gl>, descriptor: OwnedFd, allocated_bytes: u64, bytes: u64) -> Result<Self> {
        let memory = MemoryObject::import(gl, descriptor, allocated_bytes)?;
        // SAFETY: a new name, which the buffer owns.
        let name = unsafe { gl.functions()?.create_buffer() }.map_err(fault_in("import"))?;
        let object = BufferObject { gl: Rc::clone(gl), name, memory: Some(memory) };
        if let Some(memory) = &object.memory {
            memory.create_storage(name, bytes)?;
        }
        Ok(Self { object: Rc::new(object), bytes })
    }

    pub(super) fn name(&self) -> glow::Buffer {
        self.object.name
    }

    pub(super) const fn object(&self) -> &Rc<BufferObject> {
        &self.object
    }

    /// Another owner of the same buffer object.
    pub(crate) fn alias(&self) -> Self {
        Self { object: Rc::clone(&self.object), bytes: self.bytes }
    }

    /// A handle that other APIs need to register the buffer. It keeps the buffer alive.
    pub(crate) fn shared(&self) -> GlBuffer {
        let owner = Rc::clone(&self.object);
        GlBuffer { name: self.object.name.0.get(), bytes: self.bytes, owner }
    }

    /// Overwrites the first `data.len()` bytes.
    pub(crate) fn write(&self, data: &[u8]) {
        self.write_at(0, data);
    }

    /// Overwrites `data.len()` bytes from `offset` on.
    pub(crate) fn write_at(&self, offset: u64, data: &[u8]) {
        let gl = &self.object.gl;
        if offset.checked_add(data.len() as u64).is_none_or(|end| end > self.bytes) {
            let reason = format!("expected a write within {} bytes, got {} at byte {offset}", self.bytes, data.len());
            return gl.record_skipped(reason);
        }
        let Some(gl) = gl.functions_or_skip() else { return };
        // SAFETY: the data fits into the buffer.
        unsafe {
            gl.bind_buffer(glow::COPY_WRITE_BUFFER, Some(self.object.name));
            gl.buffer_sub_data_u8_slice(glow::COPY_WRITE_BUFFER, offset as i32, data);
        }
    }

    /// Copies the first `bytes` bytes to the host. Waits for pending writes.
    ///
    /// # Errors
    /// `Fault` when the buffer is smaller than `bytes` or cannot be mapped.
    pub(crate) fn read(&self, bytes: usize) -> Result<Vec<u8>> {
        if bytes as u64 > self.bytes {
            return Err(fault("read", format!("expected at most {} bytes, got {bytes}", self.bytes)));
        }
        if bytes == 0 {
            return Ok(Vec::new());
        }
        Ok(ReadMapping::new(self, bytes)?.bytes().to_vec())
    }

    /// Binds the buffer as a storage buffer of shaders.
    pub(crate) fn bind_storage(&self, binding: u32) {
        let Some(gl) = self.object.gl.functions_or_skip() else { return };
        // SAFETY: binding points below the eight that every context has.
        unsafe { gl.bind_buffer_base(glow::SHADER_STORAGE_BUFFER, binding, Some(self.object.name)) }
    }

    /// Binds a range of bytes as a storage buffer of shaders. `offset` is a multiple of 256, the largest alignment that
    /// a context may demand.
    pub(crate) fn bind_storage_range(&self, binding: u32, offset: u64, bytes: u64) {
        let gl = &self.object.gl;
        if offset.checked_add(bytes).is_none_or(|end| end > self.bytes) {
            let reason = format!("expected a range within {} bytes, got {bytes} bytes at {offset}", self.bytes);
            return gl.record_skipped(reason);
        }
        let Some(gl) = gl.functions_or_skip() else { return };
        // SAFETY: binding points below the eight that every context has; the range is inside the buffer.
        unsafe {
            let (name, offset, bytes) = (Some(self.object.name), offset as i32, bytes as i32);
            gl.bind_buffer_range(glow::SHADER_STORAGE_BUFFER, binding, name, offset, bytes);
        }
    }

    /// Binds the first `bytes` bytes as a uniform block.
    pub(crate) fn bind_uniform(&self, binding: u32, bytes: usize) {
        let gl = &self.object.gl;
        if bytes as u64 > self.bytes {
            return gl.record_skipped(format!("expected at most {} bytes of uniforms, got {bytes}", self.bytes));
        }
        let Some(gl) = gl.functions_or_skip() else { return };
        // SAFETY: binding points below the 36 that every context has; the range is inside the buffer.
        unsafe { gl.bind_buffer_range(glow::UNIFORM_BUFFER, binding, Some(self.object.name), 0, bytes as i32) }
    }
}

impl GlBufferOwner for BufferObject {
    fn make_current(&self) -> Result<Box<dyn std::any::Any>> {
        Ok(Box::new(self.gl.make_current()?))
    }
}

impl Framebuffer {
    /// Takes ownership of a name, and keeps the textures alive that will be attached.
    pub(super) fn new<'a>(
        gl: &Rc<Gl>,
        name: glow::Framebuffer,
        attachments: impl Iterator<Item = &'a Texture>,
    ) -> Self {
        Self { gl: Rc::clone(gl), name, _attachments: attachments.map(|image| Rc::clone(&image.object)).collect() }
    }
}

impl VertexArray {
    /// Takes ownership of a name, and keeps the buffers alive that will be attached.
    pub(super) fn new<'a>(gl: &Rc<Gl>, name: glow::VertexArray, buffers: impl Iterator<Item = &'a Buffer>) -> Self {
        Self { gl: Rc::clone(gl), name, _buffers: buffers.map(|buffer| Rc::clone(&buffer.object)).collect() }
    }
}

impl Texture {
    /// Takes ownership of a name, and keeps the buffer of a buffer texture alive.
    pub(super) fn new(gl: &Rc<Gl>, name: glow::Texture, desc: TextureDesc, buffer: Option<&Buffer>) -> Self {
        let _buffer = buffer.map(|buffer| Rc::clone(&buffer.object));
        Self { object: Rc::new(TextureObject { gl: Rc::clone(gl), name, _buffer }), desc }
    }

    pub(super) fn name(&self) -> glow::Texture {
        self.object.name
    }

    fn gl(&self) -> &Rc<Gl> {
        &self.object.gl
    }

    /// Uploads the RGBA8 pixels of one layer of one mipmap level, row by row. Row 0 has the texture coordinate v = 0.
    pub(crate) fn upload_pixels(&self, level: u32, layer: u32, size: [u32; 2], rgba: &[u8]) -> Result<()> {
        let [width, height] = size.map(|side| side as i32);
        if rgba.len() != 4 * width as usize * height as usize {
            return Err(fault(
                "texture",
                format!("expected {width} x {height} pixels of 4 bytes, got {} bytes", rgba.len()),
            ));
        }
        let gl = self.gl().functions()?;
        let pixels = glow::PixelUnpackData::Slice(Some(rgba));
        let (level, layer) = (level as i32, layer as i32);
        // SAFETY: the pixels fill the box (checked above), which OpenGL checks against the storage.
        unsafe {
            gl.bind_texture(self.desc.target, Some(self.name()));
            gl.pixel_store_i32(glow::UNPACK_ALIGNMENT, 1);
            let (format, data_type) = (glow::RGBA, glow::UNSIGNED_BYTE);
            gl.tex_sub_image_3d(self.desc.target, level, 0, 0, layer, width, height, 1, format, data_type, pixels);
        }
        self.gl().check("texture")
    }

    /// Sets sampler parameters, which are pairs of OpenGL parameter and value, and the maximum anisotropy.
    pub(crate) fn set_sampling(&self, parameters: &[(u32, u32)], anisotropy: f32) {
        let Some(gl) = self.gl().functions_or_skip() else { return };
        // SAFETY: plain parameters of a texture of this context.
        unsafe {
            gl.bind_texture(self.desc.target, Some(self.name()));
            for (parameter, value) in parameters {
                gl.tex_parameter_i32(self.desc.target, *parameter, *value as i32);
            }
            if anisotropy > 1.0 {
                gl.tex_parameter_f32(self.desc.target, glow::TEXTURE_MAX_ANISOTROPY_EXT, anisotropy);
            }
        }
    }

    /// Binds the texture to a texture unit.
    pub(crate) fn bind(&self, unit: u32) {
        let Some(gl) = self.gl().functions_or_skip() else { return };
        // SAFETY: units below the 96 that every context has over all stages.
        unsafe {
            gl.active_texture(glow::TEXTURE0 + unit);
            gl.bind_texture(self.desc.target, Some(self.name()));
        }
    }

    /// Binds the texture as an image that a compute shader writes.
    pub(crate) fn bind_image(&self, unit: u32) {
        self.bind_image_for(unit, glow::WRITE_ONLY);
    }

    /// Binds the texture as an image that a compute shader reads and writes.
    pub(crate) fn bind_image_read_write(&self, unit: u32) {
        self.bind_image_for(unit, glow::READ_WRITE);
    }

    fn bind_image_for(&self, unit: u32, access: u32) {
        let Some(gl) = self.gl().functions_or_skip() else { return };
        // SAFETY: level 0 of a texture whose format the shader declares.
        unsafe {
            let is_layered = self.desc.target == glow::TEXTURE_2D_ARRAY;
            gl.bind_image_texture(unit, Some(self.name()), 0, is_layered, 0, access, self.desc.format);
        }
    }

    /// Binds one layer as an image that a compute shader writes.
    pub(crate) fn bind_image_layer(&self, unit: u32, layer: u32) {
        let Some(gl) = self.gl().functions_or_skip() else { return };
        // SAFETY: level 0 of a texture whose format the shader declares.
        unsafe {
            let format = self.desc.format;
            gl.bind_image_texture(unit, Some(self.name()), 0, false, layer as i32, glow::WRITE_ONLY, format);
        }
    }
}

impl Program {
    /// Makes the program current. `uniform`: value of the integer uniform at location 0, for example the first
    /// triangle; none for programs without such a uniform.
    pub(crate) fn bind(&self, uniform: Option<u32>) {
        let Some(gl) = self.gl.functions_or_skip() else { return };
        // SAFETY: a linked program.
        unsafe { gl.use_program(Some(self.name)) }
        if let Some(value) = uniform {
            self.set_uniform(0, value as i32);
        }
    }

    /// Sets the first triangle of the next draw (location 0). This must be the bound program.
    pub(crate) fn set_first_triangle(&self, first_triangle: u32) {
        self.set_uniform(0, first_triangle as i32);
    }

    /// Sets the phase of a program with several phases (location 1). This must be the bound program.
    pub(crate) fn set_phase(&self, phase: i32) {
        self.set_uniform(1, phase);
    }

    /// Sets the layer (location 1) that this program writes. This must be the bound program.
    pub(crate) fn set_layer(&self, layer: u32) {
        self.set_uniform(1, layer as i32);
    }

    /// Sets the first row of the band of an image that the next dispatch processes (location 2). This must be the bound
    /// program.
    pub(crate) fn set_first_row(&self, first_row: u32) {
        self.set_uniform(2, first_row as i32);
    }

    /// Sets the first tile of the tile list that the next dispatch processes (location 2). This must be the bound program.
    pub(crate) fn set_first_tile(&self, first_tile: u32) {
        self.set_uniform(2, first_tile as i32);
    }

    fn set_uniform(&self, location: u32, value: i32) {
        let Some(gl) = self.gl.functions_or_skip() else { return };
        // SAFETY: OpenGL reports an error unless a bound program declares an integer at the location.
        unsafe { gl.uniform_1_i32(Some(&glow::NativeUniformLocation(location)), value) }
    }
}

/// Implements `Drop`, which deletes the OpenGL name.
macro_rules! delete_on_drop {
    ($($object:ty => $delete:ident),*) => {$(
        impl Drop for $object {
            fn drop(&mut self) {
                // SAFETY: this value owns the name, which is not used afterwards.
                self.gl.delete(|gl| unsafe { gl.$delete(self.name) });
            }
        }
    )*};
}

delete_on_drop!(
    BufferObject => delete_buffer,
    TextureObject => delete_texture,
    Program => delete_program,
    Framebuffer => delete_framebuffer,
    VertexArray => delete_vertex_array
);
