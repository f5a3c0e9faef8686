//! Parameters and results of the renderer, without references to a device.

use std::fmt;

use crate::pass::{FrameTimes, Pass};
use modalcast_model::scene::{
    Antialiasing, BoundingBox, Camera, LookPreset, MeshEdges, OrientedBounds, ShadowSettings,
};
use modalcast_model::shared_memory::SharedPositions;

/// Selects the EGL device.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DevicePreference {
    /// The EGL device that corresponds to this CUDA device ordinal.
    Cuda(i32),
    /// Any hardware device, or Mesa's software rasterizer if there is none.
    Any,
    /// Mesa's software rasterizer.
    Software,
}

/// Description of the OpenGL device and driver.
#[derive(Debug, Clone, serde::Serialize)]
pub struct RendererInfo {
    /// The GL_RENDERER string.
    pub renderer: String,
    /// The GL_VERSION string.
    pub version: String,
    /// Whether OpenGL runs on the CPU.
    pub software: bool,
    /// Ordinal of the corresponding CUDA device, from EGL_CUDA_DEVICE_NV.
    pub cuda_device: Option<i32>,
    /// Maximum width and height of a frame, in pixels.
    pub max_side: u32,
    pub pixel_readback: PixelReadback,
}

/// How the pixels of a frame leave the device.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum PixelReadback {
    /// OpenGL draws into memory that it shares with CUDA, whose copy engine moves the pixels to the host.
    CopyEngine,
    /// OpenGL copies the pixels to a pixel buffer. The text is the reason why no memory is shared.
    PixelBuffer(String),
}

impl fmt::Display for PixelReadback {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::CopyEngine => formatter.write_str("by CUDA's copy engine from memory shared with OpenGL"),
            Self::PixelBuffer(reason) => write!(formatter, "by OpenGL: {reason}"),
        }
    }
}

/// Parameters of one frame. The geometry is the current content of the scene's buffers.
#[derive(Debug, Clone, Copy)]
pub struct FrameParams {
    pub camera: Camera,
    pub width: u32,
    pub height: u32,
    /// Bounds of all deformed vertices, in scene units. Geometry outside the bounds may be missing in the frame. Bounds
    /// that are not finite are ignored.
    pub bounds: BoundingBox,
    /// Bounds of the same vertices in light space, whose z axis points to the sun. The shadow map is fitted to these
    /// bounds, or without them to the corners of `bounds`.
    pub light_bounds: Option<OrientedBounds>,
    /// Lines along the edges of the faces. AOVs and picks ignore them.
    pub edges: Option<MeshEdges>,
    /// Samples per pixel, 1 or 4. `None`: as the look, or the rule without a preset, chooses for the size of the frame.
    /// AOVs and picks ignore it.
    pub samples: Option<u32>,
}

/// A frame whose positions are in shared memory.
#[derive(Debug, Clone)]
pub struct SharedFrame {
    pub params: FrameParams,
    pub positions: SharedPositions,
}

/// RGBA8 sRGB pixels of a frame, top row first.
#[derive(Debug, Clone, PartialEq)]
pub struct FrameImage<P = Vec<u8>> {
    pub width: u32,
    pub height: u32,
    pub rgba: P,
    pub times: FrameTimes,
    pub info: FrameInfo,
}

/// How a frame was drawn, and remarks on its content.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct FrameInfo {
    /// The rasterizer that drew the shadow map and the visibility.
    pub raster_backends: RasterBackends,
    /// Whether the compute rasterizer drew into shared memory, not into mapped buffers.
    pub shares_samples: bool,
    /// The parts of the look that a preset can choose. `None` for outputs other than color.
    pub look: Option<FrameLook>,
    /// How far the lowest vertex lies below the ground, in meters. 0 if the scene has no ground, or if the distance is
    /// at most 1e-5 of the diagonal of the scene's rest bounds, which is an upper bound of the error of the vertices.
    /// Vertices outside of [`FrameParams::bounds`] are ignored.
    pub below_ground: f64,
    /// Whether the camera frames the present state, because no domain is in the view that frames the scene at rest.
    /// Only for pictures without a camera of their own.
    pub is_reframed: bool,
}

/// The parts of a look that a preset can choose, as the renderer chose them for a frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrameLook {
    /// The preset that the scene names. `None`: the kind of renderer decided, or the settings were final.
    pub preset: Option<LookPreset>,
    pub antialias: Antialiasing,
    /// Samples per pixel that were drawn: those of the look, or 1 if the device does not support them for the frame.
    pub samples: u32,
    pub shadow: Option<ShadowSettings>,
}

impl fmt::Display for FrameLook {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { preset, antialias, samples, shadow } = self;
        write!(formatter, "{}, antialiasing {}", preset.map_or("no preset", LookPreset::name), antialias.name())?;
        write!(formatter, ", {samples} per pixel, ")?;
        match shadow {
            Some(shadow) => write!(formatter, "{} shadow map {} x {}", shadow.method.name(), shadow.size, shadow.size),
            None => formatter.write_str("no shadow map"),
        }
    }
}

/// Statistics of a frame: the passes that ran and how many triangles they processed.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct FrameStats {
    /// Passes in execution order. When several frames of one step share a shadow map, only the first frame has "shadow"
    /// and "blur"; see [`crate::SceneBuffers::set_step`].
    pub passes: Vec<Pass>,
    /// The rasterizer that drew the shadow map and the visibility.
    pub raster_backends: RasterBackends,
    /// Whether the compute rasterizer drew into shared memory, not into mapped buffers.
    pub shares_samples: bool,
    /// Number of draw calls of the occluder, visibility and blended passes.
    pub draw_calls: usize,
    /// Samples per pixel.
    pub samples: u32,
    /// Statistics of the fragment lists; present with exact transparency.
    pub oit: Option<OitStats>,
    /// Culling statistics; present when triangles are culled.
    pub culled: Option<FrameCullStats>,
}

/// A rasterizer that can draw a pass.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum RasterBackend {
    OpenGl,
    Cuda,
}

/// The rasterizer of each pass; none if the frame has no such pass.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, serde::Serialize)]
pub struct RasterBackends {
    pub shadow: Option<RasterBackend>,
    pub visibility: Option<RasterBackend>,
}

impl RasterBackend {
    /// Name in results and on the wire.
    pub const fn name(self) -> &'static str {
        match self {
            Self::OpenGl => "opengl",
            Self::Cuda => "cuda",
        }
    }
}

/// Statistics of the blended fragments of a frame with exact transparency.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, serde::Serialize)]
pub struct OitStats {
    /// Blended fragments that are neither fully transparent nor behind opaque surfaces.
    pub fragments: u64,
    /// Fragments that fit the budget (`look.fragments`) and are drawn. The farthest fragments of a pixel are dropped
    /// first.
    pub stored: u64,
    /// Largest number of fragments in a pixel.
    pub max_per_pixel: u32,
    /// Maximum number of fragments that each pixel stored; none if all fragments fit the budget.
    pub per_pixel_limit: Option<u32>,
}

impl OitStats {
    /// Fragments that are not drawn.
    pub const fn dropped(&self) -> u64 {
        self.fragments - self.stored
    }
}

/// Numbers of triangles by culling result, for one view. The numbers for the shadow map are sums over all cascades, and
/// 0 in frames that reuse a shadow map.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, serde::Serialize)]
pub struct CullStats {
    /// Triangles that the rasterizer processes.
    pub visible: u32,
    /// Triangles outside the view volume, or outside the box of the shadow map.
    pub outside_view: u32,
    /// Back faces of single-sided materials.
    pub back_facing: u32,
    /// Triangles that cover no sample or have no area.
    pub no_sample: u32,
    /// Triangles behind those that were visible in the last frame.
    pub occluded: u32,
}

/// Culling results of a frame.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, serde::Serialize)]
pub struct FrameCullStats {
    pub camera: CullStats,
    /// Shadow casters.
    pub shadow: CullStats,
}

impl CullStats {
    /// Triangles that the rasterizer does not process.
    pub const fn culled(&self) -> u32 {
        self.outside_view + self.back_facing + self.no_sample + self.occluded
    }
}

/// The object that is visible in a sample of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum VisibilityId {
    /// Neither triangle nor ground, that is, the sky.
    Background,
    /// The ground, which is behind all triangles: the shading adds it to samples without a triangle.
    Ground,
    /// Index of a triangle in the renderer's draw order. [`crate::SceneBuffers::source_triangle`] maps it to its
    /// domain.
    Triangle(usize),
}

impl VisibilityId {
    /// Twin of `shaders/shared/visibility_ids.glsl`.
    pub(crate) const fn from_id(id: u32) -> Self {
        match id {
            0 => Self::Background,
            id => Self::Triangle(id as usize - 1),
        }
    }
}

/// Implementation of the blur of a variance shadow map. All methods give the same map up to rounding.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum BlurMethod {
    /// `Tiles` on hardware, `Rows` on software rasterizers.
    #[default]
    Auto,
    /// One compute pass: by strips with sums in registers if `look.shadow.blur` is at most 8 texels, else by tiles in
    /// shared memory.
    Tiles,
    /// Two compute passes without shared memory, first along x, then along y.
    Rows,
    /// Two fragment passes, as in the thesis; a baseline for the benchmark report.
    Fragments,
}

impl BlurMethod {
    /// Replaces `Auto` by the method for the device.
    pub(crate) fn resolve(self, is_software: bool) -> Self {
        match self {
            Self::Auto if is_software => Self::Rows,
            Self::Auto => Self::Tiles,
            method => method,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn triangle_ids_follow_the_background() {
        assert_eq!(
            [0, 1, 2].map(VisibilityId::from_id),
            [VisibilityId::Background, VisibilityId::Triangle(0), VisibilityId::Triangle(1)]
        );
    }
}
