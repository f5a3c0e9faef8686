//! Buffers, textures, programs, framebuffers and vertex arrays: each owns its name and frees it.

use std::rc::Rc;

use glow::HasContext as _;

use super::Gl;
use modalcast_model::error::{Result, during};

/// A buffer object of fixed size.
#[derive(Debug)]
pub(crate) struct Buffer {
    pub(super) gl: Rc<Gl>,
    pub(super) name: glow::Buffer,
    pub(crate) bytes: u64,
}

/// What a texture is made for.
#[derive(Debug, Clone, Copy)]
pub(crate) struct TextureKind {
    pub(crate) target: u32,
    pub(crate) format: u32,
    pub(crate) width: u32,
    pub(crate) height: u32,
    /// Layers of an array, samples of a multisampled image, else 1.
    pub(crate) depth: u32,
    pub(crate) levels: u32,
}

/// A texture object of fixed storage.
#[derive(Debug)]
pub(crate) struct Texture {
    pub(super) gl: Rc<Gl>,
    pub(super) name: glow::Texture,
    pub(crate) kind: TextureKind,
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
    /// The name that other APIs register.
    pub(crate) fn name(&self) -> u32 {
        self.name.0.get()
    }

    /// Overwrites the first bytes.
    pub(crate) fn write(&self, data: &[u8]) {
        let gl = self.gl.on();
        // SAFETY: OpenGL refuses more bytes than the buffer has.
        unsafe {
            gl.bind_buffer(glow::COPY_WRITE_BUFFER, Some(self.name));
            gl.buffer_sub_data_u8_slice(glow::COPY_WRITE_BUFFER, 0, data);
        }
    }

    /// Copies the first bytes out. Waits for whatever still writes them.
    pub(crate) fn read(&self, bytes: usize) -> Result<Vec<u8>> {
        let gl = self.gl.on();
        let bytes = bytes.min(self.bytes as usize);
        // SAFETY: the mapped range is inside the buffer, only read, and unmapped before anybody else may use it.
        unsafe {
            gl.bind_buffer(glow::COPY_READ_BUFFER, Some(self.name));
            let mapped = gl.map_buffer_range(glow::COPY_READ_BUFFER, 0, bytes as i32, glow::MAP_READ_BIT);
            if mapped.is_null() {
                return Err(during("read")("the pixels cannot be mapped"));
            }
            let copied = std::slice::from_raw_parts(mapped, bytes).to_vec();
            gl.unmap_buffer(glow::COPY_READ_BUFFER);
            Ok(copied)
        }
    }

    pub(crate) fn bind_storage(&self, binding: u32) {
        // SAFETY: binding points below the eight that every context has.
        unsafe { self.gl.on().bind_buffer_base(glow::SHADER_STORAGE_BUFFER, binding, Some(self.name)) }
    }

    /// Binds `bytes` bytes from `offset` on, a multiple of 256.
    pub(crate) fn bind_uniform(&self, binding: u32, offset: usize, bytes: usize) {
        let (offset, bytes) = (offset as i32, bytes as i32);
        // SAFETY: as for storage; OpenGL refuses ranges outside the buffer.
        unsafe { self.gl.on().bind_buffer_range(glow::UNIFORM_BUFFER, binding, Some(self.name), offset, bytes) }
    }
}

impl Texture {
    /// Fills one layer of one level with RGBA8 pixels, first row first.
    pub(crate) fn fill(&self, level: u32, layer: u32, size: [u32; 2], rgba: &[u8]) -> Result<()> {
        let [width, height] = size.map(|side| side as i32);
        if rgba.len() != 4 * width as usize * height as usize {
            return Err(during("texture")(format!("{} bytes for {width} x {height} pixels", rgba.len())));
        }
        let gl = self.gl.on();
        let pixels = glow::PixelUnpackData::Slice(Some(rgba));
        let (level, layer) = (level as i32, layer as i32);
        // SAFETY: the pixels fill the box (checked above), which OpenGL checks against the storage.
        unsafe {
            gl.bind_texture(self.kind.target, Some(self.name));
            gl.pixel_store_i32(glow::UNPACK_ALIGNMENT, 1);
            let (format, ty) = (glow::RGBA, glow::UNSIGNED_BYTE);
            gl.tex_sub_image_3d(self.kind.target, level, 0, 0, layer, width, height, 1, format, ty, pixels);
        }
        self.gl.check("texture")
    }

    /// How it is sampled: OpenGL's parameters and values.
    pub(crate) fn sampling(&self, parameters: &[(u32, u32)], anisotropy: f32) {
        let gl = self.gl.on();
        // SAFETY: plain parameters of a texture of this context.
        unsafe {
            gl.bind_texture(self.kind.target, Some(self.name));
            for (parameter, value) in parameters {
                gl.tex_parameter_i32(self.kind.target, *parameter, *value as i32);
            }
            if anisotropy > 1.0 {
                gl.tex_parameter_f32(self.kind.target, glow::TEXTURE_MAX_ANISOTROPY_EXT, anisotropy);
            }
        }
    }

    pub(crate) fn bind(&self, unit: u32) {
        let gl = self.gl.on();
        // SAFETY: units below the 96 that every context has over all stages.
        unsafe {
            gl.active_texture(glow::TEXTURE0 + unit);
            gl.bind_texture(self.kind.target, Some(self.name));
        }
    }

    /// Binds it as an image that a compute shader writes.
    pub(crate) fn bind_image(&self, unit: u32) {
        self.bind_image_for(unit, glow::WRITE_ONLY);
    }

    /// The same for a shader that also reads what was there.
    pub(crate) fn bind_image_both_ways(&self, unit: u32) {
        self.bind_image_for(unit, glow::READ_WRITE);
    }

    fn bind_image_for(&self, unit: u32, access: u32) {
        // SAFETY: level 0 of a texture whose format the shader names.
        unsafe {
            let gl = self.gl.on();
            let layered = self.kind.target == glow::TEXTURE_2D_ARRAY;
            gl.bind_image_texture(unit, Some(self.name), 0, layered, 0, access, self.kind.format);
        }
    }
}

impl Program {
    /// Uses it; a number, as the first triangle, goes to location 0 of those programs that have one.
    pub(crate) fn bind(&self, number: Option<u32>) {
        let gl = self.gl.on();
        // SAFETY: a linked program; location 0 is declared by the shaders that are given a number.
        unsafe {
            gl.use_program(Some(self.name));
            if let Some(number) = number {
                gl.uniform_1_i32(Some(&glow::NativeUniformLocation(0)), number as i32);
            }
        }
    }
}

impl Program {
    /// Gives the program in use, which is this one, where its triangles begin: location 0.
    pub(crate) fn first(&self, number: u32) {
        // SAFETY: location 0 is declared by the shaders that are given a number.
        unsafe { self.gl.on().uniform_1_i32(Some(&glow::NativeUniformLocation(0)), number as i32) }
    }

    /// Says which turn it takes: location 1 of those programs that take several, while it is in use.
    pub(crate) fn turn(&self, turn: i32) {
        // SAFETY: a linked program, in use; location 1 is declared by the shaders that are given a turn.
        unsafe { self.gl.on().uniform_1_i32(Some(&glow::NativeUniformLocation(1)), turn) }
    }
}

macro_rules! freed_by {
    ($($object:ty => $delete:ident),*) => {$(
        impl Drop for $object {
            fn drop(&mut self) {
                // SAFETY: the name is ours alone and is not used after this.
                unsafe { self.gl.on().$delete(self.name) }
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
