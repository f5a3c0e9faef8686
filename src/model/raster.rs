//! The trait of the compute rasterizer, the alternative to OpenGL's rasterizer for some passes. The renderer calls it;
//! `gpu` implements it in CUDA.
//!
//! Images have one sample per pixel and rows from top to bottom. `reference::raster` defines which samples a triangle
//! covers, their depths, and which samples of cut-outs survive the alpha test. Implementations may differ from it in
//! the last bits of filtered images.

use crate::error::Result;
use crate::scene::{DrawRange, Viewport};

/// A buffer of the OpenGL context that is current on the calling thread.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct GlBuffer {
    pub name: u32,
    pub bytes: u64,
}

/// The geometry to draw.
#[derive(Debug, Clone)]
pub struct RasterGeometry {
    /// Three f32 per vertex, rewritten by every step.
    pub positions: GlBuffer,
    /// Vertex indices. The id of a triangle is its index in this list.
    pub triangles: Vec<[u32; 3]>,
    /// Consecutive ranges that together cover all triangles.
    pub groups: Vec<DrawRange>,
    /// Alpha-tested triangles; `None` if the mesh has none.
    pub cut_outs: Option<CutOuts>,
}

/// The alpha-tested triangles: a sample survives only where alpha reaches a cutoff.
#[derive(Debug, Clone, PartialEq)]
pub struct CutOuts {
    /// Index of the first alpha-tested triangle. All triangles from it on are alpha-tested.
    pub first: u32,
    /// Per alpha-tested triangle, the texture coordinates of its corners.
    pub uvs: Vec<[[f32; 2]; 3]>,
    /// Per alpha-tested triangle, its index in `materials`.
    pub material_indices: Vec<u32>,
    pub materials: Vec<AlphaMaterial>,
    pub images: Vec<AlphaImage>,
    /// Maximum anisotropy: the largest number of samples along the major axis of a pixel's footprint, at least 1.
    pub anisotropy: f32,
}

/// Alpha-test parameters of a material. A sample survives if `alpha` times the image's alpha is at least `cutoff`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AlphaMaterial {
    pub alpha: f32,
    pub cutoff: f32,
    /// Index in [`CutOuts::images`].
    pub image: Option<u32>,
}

/// The alpha channel of an image with wrap mode "repeat". Texels have 8 bits for 0 to 1; rows are in the order of
/// increasing v.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AlphaImage {
    pub width: u32,
    pub height: u32,
    /// The mipmap chain, from the full image down to one texel.
    pub levels: Vec<Vec<u8>>,
}

/// A window and the buffer that receives its samples.
pub type DrawTarget<'a> = (&'a Viewport, GlBuffer);

/// Draws one mesh. Buffer accesses are ordered with OpenGL commands before and after each call without blocking the
/// host. The implementation may keep the position buffer and the target buffers registered. The caller must therefore
/// delete the position buffer only after it drops the rasterizer, and a target only after
/// `release_target`.
pub trait Rasterizer: std::fmt::Debug {
    /// Draws depths, ids, or both. One call for both is cheaper, because the switch from OpenGL to CUDA and back takes
    /// longer than either pass.
    ///
    /// Depths are one f32 per sample from 0 to 1, and 1 where no triangle is; triangles are drawn two-sided. Ids are
    /// one u64 per sample: the bits of the nearest depth in the upper half and the triangle in the lower half, and all
    /// ones where no triangle is. Each group says which of its faces are drawn.
    ///
    /// # Errors
    /// `Fault` if the device fails, or if a buffer is unknown or smaller than its window.
    fn draw(&mut self, depth: Option<DrawTarget<'_>>, ids: Option<DrawTarget<'_>>) -> Result<()>;

    /// Compiles the kernels for depth, id, or both passes ahead of the first frame.
    ///
    /// # Errors
    /// `Unavailable` if there is no compiler; `Fault` if compilation fails.
    fn precompile(&mut self, depth: bool, ids: bool) -> Result<()>;

    /// Releases a target buffer. Call it before OpenGL deletes the buffer, because OpenGL may reuse the name.
    fn release_target(&mut self, _name: u32) {}
}
