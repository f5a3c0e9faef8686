//! Buffers, textures, programs, framebuffers and vertex arrays. Each owns its OpenGL name and deletes it when dropped.

use std::rc::Rc;

use glow::HasContext as _;

use super::Gl;
use modalcast_model::error::{Result, fault_in};

/// A buffer object of fixed size.
#[derive(Debug)]
pub(crate) struct Buffer {
    pub(super) gl: Rc<Gl>,
    pub(super) name: glow::Buffer,
    pub(crate) bytes: u64,
}

/// Storage parameters of a texture.
#[derive(Debug, Clone, Copy)]
pub(crate) struct TextureDesc {
    pub(crate) target: u32,
    pub(crate) format: u32,
    pub(crate) width: u32,
    pub(crate) height: u32,
    /// Layers of an array, samples of a multisampled image, else 1.
    pub(crate) depth: u32,
    pub(crate) levels: u32,
}

/// A texture object with immutable storage.
#[derive(Debug)]
pub(crate) struct Texture {
    pub(super) gl: Rc<Gl>,
    pub(super) name: glow::Texture,
    pub(crate) desc: TextureDesc,
}

#[derive(Debug)]
pub(crate) struct Program {
    pub(super) gl: Rc<Gl>,
    pub(super) name: glow::Program,
}

#[derive(Debug)]
pub(crate) struct Framebuffer {
    pub(super) gl: Rc<Gl>,
    pub(super) name: glow::Framebuffer,
}

#[derive(Debug)]
pub(crate) struct VertexArray {
    pub(super) gl: Rc<Gl>,
    pub(super) name: glow::VertexArray,
}

impl Buffer {
    /// The name with which other APIs register the buffer.
    pub(crate) fn name(&self) -> u32 {
        self.name.0.get()
    }

    /// Overwrites the first `data.len()` bytes.
    pub(crate) fn write(&self, data: &[u8]) {
        let gl = self.gl.current();
        // SAFETY: OpenGL rejects data that is larger than the buffer.
        unsafe {
            gl.bind_buffer(glow::COPY_WRITE_BUFFER, Some(self.name));
            gl.buffer_sub_data_u8_slice(glow::COPY_WRITE_BUFFER, 0, data);
        }
    }

    /// Copies the first bytes to the host. Waits for pending writes.
    pub(crate) fn read(&self, bytes: usize) -> Result<Vec<u8>> {
        let gl = self.gl.current();
        let bytes = bytes.min(self.bytes as usize);
        // SAFETY: the mapped range is inside the buffer, is only read, and is unmapped before any other use.
        unsafe {
            gl.bind_buffer(glow::COPY_READ_BUFFER, Some(self.name));
            let mapped = gl.map_buffer_range(glow::COPY_READ_BUFFER, 0, bytes as i32, glow::MAP_READ_BIT);
            if mapped.is_null() {
                return Err(fault_in("read")("the pixels cannot be mapped"));
            }
            let copied = std::slice::from_raw_parts(mapped, bytes).to_vec();
            gl.unmap_buffer(glow::COPY_READ_BUFFER);
            Ok(copied)
        }
    }

    pub(crate) fn bind_storage(&self, binding: u32) {
        // SAFETY: binding points below the eight that every context has.
        unsafe { self.gl.current().bind_buffer_base(glow::SHADER_STORAGE_BUFFER, binding, Some(self.name)) }
    }

    /// Binds `bytes` bytes from `offset`, a multiple of 256.
    pub(crate) fn bind_uniform(&self, binding: u32, offset: usize, bytes: usize) {
        let (offset, bytes) = (offset as i32, bytes as i32);
        // SAFETY: binding points below the 36 that every context has; OpenGL rejects ranges outside the buffer.
        unsafe { self.gl.current().bind_buffer_range(glow::UNIFORM_BUFFER, binding, Some(self.name), offset, bytes) }
    }
}

impl Texture {
    /// Uploads RGBA8 pixels to one layer of one mipmap level, first row first.
    pub(crate) fn fill(&self, level: u32, layer: u32, size: [u32; 2], rgba: &[u8]) -> Result<()> {
        let [width, height] = size.map(|side| side as i32);
        if rgba.len() != 4 * width as usize * height as usize {
            return Err(fault_in("texture")(format!("{} bytes for {width} x {height} pixels", rgba.len())));
        }
        let gl = self.gl.current();
        let pixels = glow::PixelUnpackData::Slice(Some(rgba));
        let (level, layer) = (level as i32, layer as i32);
        // SAFETY: the pixels fill the box (checked above), which OpenGL checks against the storage.
        unsafe {
            gl.bind_texture(self.desc.target, Some(self.name));
            gl.pixel_store_i32(glow::UNPACK_ALIGNMENT, 1);
            let (format, ty) = (glow::RGBA, glow::UNSIGNED_BYTE);
            gl.tex_sub_image_3d(self.desc.target, level, 0, 0, layer, width, height, 1, format, ty, pixels);
        }
        self.gl.check("texture")
    }

    /// Sets sampler parameters: pairs of OpenGL parameter and value.
    pub(crate) fn set_sampling(&self, parameters: &[(u32, u32)], anisotropy: f32) {
        let gl = self.gl.current();
        // SAFETY: plain parameters of a texture of this context.
        unsafe {
            gl.bind_texture(self.desc.target, Some(self.name));
            for (parameter, value) in parameters {
                gl.tex_parameter_i32(self.desc.target, *parameter, *value as i32);
            }
            if anisotropy > 1.0 {
                gl.tex_parameter_f32(self.desc.target, glow::TEXTURE_MAX_ANISOTROPY_EXT, anisotropy);
            }
        }
    }

    pub(crate) fn bind(&self, unit: u32) {
        let gl = self.gl.current();
        // SAFETY: units below the 96 that every context has over all stages.
        unsafe {
            gl.active_texture(glow::TEXTURE0 + unit);
            gl.bind_texture(self.desc.target, Some(self.name));
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
        // SAFETY: level 0 of a texture whose format the shader declares.
        unsafe {
            let gl = self.gl.current();
            let layered = self.desc.target == glow::TEXTURE_2D_ARRAY;
            gl.bind_image_texture(unit, Some(self.name), 0, layered, 0, access, self.desc.format);
        }
    }
}

impl Program {
    /// Makes the program current. `number`, for example the first triangle, goes to location 0 of programs that declare
    /// one.
    pub(crate) fn bind(&self, number: Option<u32>) {
        let gl = self.gl.current();
        // SAFETY: a linked program; shaders that get a number declare location 0.
        unsafe {
            gl.use_program(Some(self.name));
            if let Some(number) = number {
                gl.uniform_1_i32(Some(&glow::NativeUniformLocation(0)), number as i32);
            }
        }
    }
}

impl Program {
    /// Sets the first triangle of the next draw (location 0). This must be the bound program.
    pub(crate) fn set_first_triangle(&self, number: u32) {
        // SAFETY: shaders that get a number declare location 0.
        unsafe { self.gl.current().uniform_1_i32(Some(&glow::NativeUniformLocation(0)), number as i32) }
    }

    /// Sets the phase of a program with several phases (location 1). This must be the bound program.
    pub(crate) fn set_phase(&self, phase: i32) {
        // SAFETY: a linked, bound program; shaders with several phases declare location 1.
        unsafe { self.gl.current().uniform_1_i32(Some(&glow::NativeUniformLocation(1)), phase) }
    }
}

macro_rules! freed_by {
    ($($object:ty => $delete:ident),*) => {$(
        impl Drop for $object {
            fn drop(&mut self) {
                // SAFETY: this value owns the name, which is not used afterwards.
                unsafe { self.gl.current().$delete(self.name) }
            }
        }
    )*};
}

freed_by!(
    Buffer => delete_buffer,
    Texture => delete_texture,
    Program => delete_program,
    Framebuffer => delete_framebuffer,
    VertexArray => delete_vertex_array
);
