//! Limits and features of an OpenGL context.

use glow::HasContext as _;
use modalcast_model::scene::RendererKind;

/// GL_SUBPIXEL_BITS, which glow does not define.
const SUBPIXEL_BITS: u32 = 0x0D50;

/// Maximum anisotropy of texture lookups on hardware.
const HARDWARE_ANISOTROPY: f32 = 8.0;

/// Limits and features of an OpenGL context.
#[derive(Debug, Clone, Default)]
pub(crate) struct Limits {
    /// GL_RENDERER.
    pub(crate) renderer: String,
    /// GL_VERSION.
    pub(crate) version: String,
    /// Whether the context draws on the CPU.
    pub(crate) software: bool,
    /// Maximum side of textures and viewports, in pixels.
    pub(crate) max_side: u32,
    /// Maximum number of samples per pixel that color, depth and integer images all support: the minimum of three
    /// limits.
    pub(crate) max_samples: u32,
    /// Maximum number of textures that one compute shader can read.
    pub(crate) max_compute_textures: u32,
    /// Maximum number of layers of an array texture.
    pub(crate) max_layers: u32,
    /// Maximum number of texels of a buffer texture.
    pub(crate) max_texels: u64,
    /// Maximum size of a buffer that shaders can write, in bytes.
    pub(crate) max_storage_bytes: u64,
    /// Whether fragment shaders can read their coverage after the depth test.
    pub(crate) post_depth_coverage: bool,
    /// Whether threads of the driver compile programs (`GL_KHR_parallel_shader_compile`).
    pub(crate) parallel_compile: bool,
    /// Whether buffers can stay mapped while the device writes them (OpenGL 4.4).
    pub(crate) persistent_mapping: bool,
    /// Whether buffers can be in memory of another API (`GL_EXT_memory_object_fd`).
    pub(crate) memory_object_fd: bool,
    /// Number of fractional bits of a vertex position in pixels; OpenGL guarantees 4.
    pub(crate) subpixel_bits: u32,
    /// Maximum anisotropy of texture lookups: [`HARDWARE_ANISOTROPY`], or 1 if the context does not support it or is a
    /// software rasterizer.
    pub(crate) anisotropy: f32,
}

impl Limits {
    /// The kind of renderer, on which the choice of a look's parts depends.
    pub(crate) const fn renderer_kind(&self) -> RendererKind {
        if self.software { RendererKind::Software } else { RendererKind::Hardware }
    }

    pub(super) fn of(gl: &glow::Context) -> Self {
        // SAFETY: queries that every 4.3 core context answers.
        unsafe {
            let parameter = |name: u32| gl.get_parameter_i32(name).max(0) as u32;
            let renderer = gl.get_parameter_string(glow::RENDERER);
            let software = ["llvmpipe", "softpipe", "swrast", "SWR"].iter().any(|name| renderer.contains(name));
            let has_anisotropy = gl.supported_extensions().contains("GL_EXT_texture_filter_anisotropic");
            let mut max_viewport_size = [0; 2];
            gl.get_parameter_i32_slice(glow::MAX_VIEWPORT_DIMS, &mut max_viewport_size);
            let max_viewport_side = max_viewport_size[0].min(max_viewport_size[1]).max(0) as u32;
            Self {
                renderer,
                version: gl.get_parameter_string(glow::VERSION),
                software,
                max_side: parameter(glow::MAX_TEXTURE_SIZE).min(max_viewport_side),
                max_samples: [
                    glow::MAX_COLOR_TEXTURE_SAMPLES,
                    glow::MAX_DEPTH_TEXTURE_SAMPLES,
                    glow::MAX_INTEGER_SAMPLES,
                ]
                .map(parameter)
                .into_iter()
                .fold(u32::MAX, u32::min),
                max_compute_textures: parameter(glow::MAX_COMPUTE_TEXTURE_IMAGE_UNITS),
                max_layers: parameter(glow::MAX_ARRAY_TEXTURE_LAYERS),
                max_texels: u64::from(parameter(glow::MAX_TEXTURE_BUFFER_SIZE)),
                max_storage_bytes: u64::from(parameter(glow::MAX_SHADER_STORAGE_BLOCK_SIZE)),
                parallel_compile: ["GL_KHR_parallel_shader_compile", "GL_ARB_parallel_shader_compile"]
                    .iter()
                    .any(|name| gl.supported_extensions().contains(*name)),
                persistent_mapping: has_persistent_mapping(gl),
                memory_object_fd: gl.supported_extensions().contains("GL_EXT_memory_object_fd"),
                subpixel_bits: parameter(SUBPIXEL_BITS),
                post_depth_coverage: gl.supported_extensions().contains("GL_ARB_post_depth_coverage"),
                anisotropy: if has_anisotropy && !software { HARDWARE_ANISOTROPY } else { 1.0 },
            }
        }
    }
}

impl Limits {
    /// Step of the rasterizer's subpixel grid, in pixels.
    pub(crate) fn subpixel_step(&self) -> f32 {
        0.5_f32.powi(self.subpixel_bits.min(16) as i32)
    }
}

/// Whether the context has glGetGraphicsResetStatus.
pub(super) fn has_reset_status(gl: &glow::Context) -> bool {
    let version = gl.version();
    (version.major, version.minor) >= (4, 5) || gl.supported_extensions().contains("GL_KHR_robustness")
}

fn has_persistent_mapping(gl: &glow::Context) -> bool {
    let version = gl.version();
    (version.major, version.minor) >= (4, 4) || gl.supported_extensions().contains("GL_ARB_buffer_storage")
}
