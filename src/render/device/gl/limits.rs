//! Limits and features of an OpenGL context.

use glow::HasContext as _;

/// GL_SUBPIXEL_BITS, which glow does not define.
const SUBPIXEL_BITS: u32 = 0x0D50;

/// Limits and features of an OpenGL context.
#[derive(Debug, Clone, Default)]
pub(crate) struct Limits {
    pub(crate) renderer: String,
    pub(crate) version: String,
    pub(crate) software: bool,
    pub(crate) max_side: u32,
    /// Samples per pixel that color, depth and integer images all support.
    pub(crate) max_samples: u32,
    /// Textures that one compute shader can read.
    pub(crate) max_compute_textures: u32,
    pub(crate) max_layers: u32,
    /// Texels of the largest buffer texture.
    pub(crate) max_texels: u64,
    /// Bytes of the largest buffer that shaders can write.
    pub(crate) max_storage_bytes: u64,
    /// Whether fragments can read their coverage after the depth test.
    pub(crate) post_depth_coverage: bool,
    /// Whether buffers can stay mapped while the device writes them (OpenGL 4.4).
    pub(crate) persistent_mapping: bool,
    /// Bits of a vertex position below the pixel, at least 4.
    pub(crate) subpixel_bits: u32,
    /// Largest anisotropy; 1 if it is not supported or runs on the CPU.
    pub(crate) anisotropy: f32,
}

impl Limits {
    pub(super) fn of(gl: &glow::Context) -> Self {
        // SAFETY: queries that every 4.3 core context answers.
        unsafe {
            let number = |name: u32| gl.get_parameter_i32(name).max(0) as u32;
            let renderer = gl.get_parameter_string(glow::RENDERER);
            let software = ["llvmpipe", "softpipe", "swrast", "SWR"].iter().any(|name| renderer.contains(name));
            let anisotropic = gl.supported_extensions().contains("GL_EXT_texture_filter_anisotropic");
            let mut viewport = [0; 2];
            gl.get_parameter_i32_slice(glow::MAX_VIEWPORT_DIMS, &mut viewport);
            let viewport = viewport[0].min(viewport[1]).max(0) as u32;
            Self {
                renderer,
                version: gl.get_parameter_string(glow::VERSION),
                software,
                max_side: number(glow::MAX_TEXTURE_SIZE).min(viewport),
                max_samples: [
                    glow::MAX_COLOR_TEXTURE_SAMPLES,
                    glow::MAX_DEPTH_TEXTURE_SAMPLES,
                    glow::MAX_INTEGER_SAMPLES,
                ]
                .map(number)
                .into_iter()
                .fold(u32::MAX, u32::min),
                max_compute_textures: number(glow::MAX_COMPUTE_TEXTURE_IMAGE_UNITS),
                max_layers: number(glow::MAX_ARRAY_TEXTURE_LAYERS),
                max_texels: u64::from(number(glow::MAX_TEXTURE_BUFFER_SIZE)),
                max_storage_bytes: u64::from(number(glow::MAX_SHADER_STORAGE_BLOCK_SIZE)),
                persistent_mapping: is_persistent(gl),
                subpixel_bits: number(SUBPIXEL_BITS),
                post_depth_coverage: gl.supported_extensions().contains("GL_ARB_post_depth_coverage"),
                anisotropy: if anisotropic && !software { 8.0 } else { 1.0 },
            }
        }
    }
}

impl Limits {
    /// Largest step of the rasterizer's subpixel grid, in pixels.
    pub(crate) fn subpixel_step(&self) -> f32 {
        0.5_f32.powi(self.subpixel_bits.min(16) as i32)
    }
}

/// Whether the context has glGetGraphicsResetStatus.
pub(super) fn has_reset_status(gl: &glow::Context) -> bool {
    let version = gl.version();
    (version.major, version.minor) >= (4, 5) || gl.supported_extensions().contains("GL_KHR_robustness")
}

fn is_persistent(gl: &glow::Context) -> bool {
    let version = gl.version();
    (version.major, version.minor) >= (4, 4) || gl.supported_extensions().contains("GL_ARB_buffer_storage")
}
