//! The trait of the compute rasterizer, the alternative to OpenGL's rasterizer for some passes. The renderer calls it;
//! the module `gpu` of `modalcast-compute` implements it in CUDA.
//!
//! Images have one sample per pixel and rows from top to bottom. The module `reference::raster` of `modalcast-compute`
//! defines the samples of a triangle, their depths, and the result of the alpha test. Implementations may differ from
//! it in the last bits of filtered images.

use std::any::Any;
use std::ops::Range;
use std::os::fd::OwnedFd;
use std::rc::Rc;

use crate::error::{Result, fault};
use crate::scene::{DrawRange, Viewport};
use crate::shared_memory::{SharedRange, VertexImporter};

/// The owner of an OpenGL buffer. The buffer is deleted once its owner is dropped.
pub trait GlBufferOwner: std::fmt::Debug {
    /// Makes the buffer's context current on the calling thread until the returned guard is dropped. Registering and
    /// mapping a buffer need its context.
    ///
    /// # Errors
    /// `Fault` if the context cannot be made current.
    fn make_current(&self) -> Result<Box<dyn Any>>;
}

/// A handle to an OpenGL buffer. The buffer exists at least as long as the handle, so code that registers a buffer with
/// CUDA keeps a handle until it unregisters the buffer.
#[derive(Debug, Clone)]
pub struct GlBuffer {
    /// OpenGL name of the buffer in its context.
    pub name: u32,
    /// Size of the buffer.
    pub bytes: u64,
    pub owner: Rc<dyn GlBufferOwner>,
}

/// The OpenGL buffers that receive deformed vertices, so that no upload is needed. A corner is a vertex with a normal
/// and texture coordinates.
#[derive(Debug, Clone)]
pub struct GlVertexBuffers {
    /// 3 f32 per vertex.
    pub positions: GlBuffer,
    /// 3 f32 per corner.
    pub normals: GlBuffer,
    /// 4 f32 per corner; only if the scene has normal maps.
    pub tangents: Option<GlBuffer>,
    /// Present if the renderer can import memory of the deformer. OpenGL then copies the vertices from this memory to
    /// the buffers, and the deformer does not write the buffers.
    pub importer: Option<Rc<dyn VertexImporter>>,
}

impl PartialEq for GlBuffer {
    fn eq(&self, other: &Self) -> bool {
        // Compares addresses only: the vtables of one type may differ.
        let is_same_owner = std::ptr::addr_eq(Rc::as_ptr(&self.owner), Rc::as_ptr(&other.owner));
        is_same_owner && (self.name, self.bytes) == (other.name, other.bytes)
    }
}

/// The geometry to draw.
#[derive(Debug, Clone)]
pub struct RasterGeometry {
    /// Three f32 per vertex, rewritten by every step.
    pub positions: GlBuffer,
    /// Vertex indices. The id of a triangle is its index in this list.
    pub triangles: Vec<[u32; 3]>,
    /// The draw groups: consecutive ranges that together cover all triangles.
    pub groups: Vec<DrawRange>,
    /// Alpha-tested triangles; `None` if the mesh has none.
    pub cut_outs: Option<CutOuts>,
}

/// The alpha-tested triangles.
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

/// The alpha channel of an image with wrap mode "repeat". A texel is one byte; 255 is opaque. Rows are in the order of
/// increasing v.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AlphaImage {
    pub width: u32,
    pub height: u32,
    /// The mipmap chain, from the full image down to one texel.
    pub levels: Vec<Vec<u8>>,
}

/// A viewport and the buffer that receives its samples.
pub type DrawTarget<'a> = (&'a Viewport, &'a GlBuffer);

/// A viewport and the shared memory that receives its samples.
pub type SharedDrawTarget<'a> = (&'a Viewport, &'a dyn SharedRange);

/// Samples in memory that OpenGL has not imported yet.
#[derive(Debug)]
pub struct NewTarget {
    /// Names the memory. An import takes ownership of it.
    pub descriptor: OwnedFd,
    /// Size of the allocation, which an import must state: the bytes of the samples, rounded up by the device.
    pub allocated_bytes: u64,
    pub range: Rc<dyn SharedRange>,
}

/// The passes of one step that [`Rasterizer::draw_shared`] draws.
#[derive(Debug, Clone, Copy)]
pub struct SharedDraw<'a> {
    /// Three f32 per vertex.
    pub positions: &'a dyn SharedRange,
    pub depth: Option<SharedDrawTarget<'a>>,
    pub ids: Option<SharedDrawTarget<'a>>,
}

/// The range of [`Rasterizer::draw`] that contains all triangles.
pub const ALL_TRIANGLES: Range<u32> = 0..u32::MAX;

/// Draws one mesh. [`Self::draw`] orders its buffer accesses with OpenGL commands before and after each call without
/// blocking the host. Between calls, the implementation may keep the handles of the position buffer and the target
/// buffers, and leave these buffers registered with CUDA.
pub trait Rasterizer: std::fmt::Debug {
    /// Draws depths, ids, or both. One call for both is cheaper, because the switch from OpenGL to CUDA and back takes
    /// longer than either pass.
    ///
    /// Draws the triangles of `range` only, which are indices in [`RasterGeometry::triangles`]. A range that begins at 0
    /// clears all samples first. A later range adds its triangles to the samples.
    ///
    /// Depths are one f32 per sample: 1 at the near plane, 0 at the far plane and without a triangle. The depth pass
    /// draws both faces of every triangle.
    ///
    /// Ids are one u64 per sample. The upper half contains the inverted bits of the nearest depth, the lower half the
    /// index of the triangle. A sample without a triangle has all bits set. The cull mode of the triangle's group
    /// ([`RasterGeometry::groups`]) decides whether the id pass draws its back face.
    ///
    /// # Errors
    /// `Fault` if the device fails, or if a buffer is unknown or smaller than its viewport.
    fn draw(&mut self, depth: Option<DrawTarget<'_>>, ids: Option<DrawTarget<'_>>, range: Range<u32>) -> Result<()>;

    /// Compiles the kernels for depth, id, or both passes ahead of the first frame.
    ///
    /// # Errors
    /// `Unavailable` if there is no compiler; `Fault` if compilation fails.
    fn precompile(&mut self, depth: bool, ids: bool) -> Result<()>;

    /// Allocates memory for samples of [`Self::draw_shared`], which OpenGL can import.
    ///
    /// # Errors
    /// `Fault` if the implementation has no such memory, or the device has not enough of it.
    fn create_target(&mut self, _bytes: u64) -> Result<NewTarget> {
        Err(fault("raster", "expected a rasterizer that shares memory with OpenGL"))
    }

    /// Draws as [`Self::draw`], but from and into shared memory, and waits for the end of all draws. Returns the
    /// milliseconds that the device took. Nothing orders the draws with OpenGL commands: the caller has waited for the
    /// commands that read the targets. Several draws need one change of the device between OpenGL and the rasterizer.
    ///
    /// # Errors
    /// `Fault` if the device fails, or if a range is not of this rasterizer's device or too small.
    fn draw_shared(&mut self, _draws: &[SharedDraw<'_>]) -> Result<f64> {
        Err(fault("raster", "expected a rasterizer that shares memory with OpenGL"))
    }
}
