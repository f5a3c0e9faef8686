//! What draws triangles into samples beside OpenGL, as a trait: the renderer asks, `gpu` answers.
//!
//! One sample a pixel, rows from the top. Which samples a triangle covers and how deep it is there is defined by
//! `reference::raster`; so is what is left of a cut-out, but for the last bits of how an image is filtered.

use crate::error::Result;
use crate::scene::{Group, Window};

/// An OpenGL buffer of the context that is current on the thread.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct GlBuffer {
    pub name: u32,
    pub bytes: u64,
}

/// What is drawn.
#[derive(Debug, Clone)]
pub struct Mesh {
    /// 3 f32 a vertex, written anew for every step.
    pub positions: GlBuffer,
    /// Vertices; a triangle's id is its place here.
    pub triangles: Vec<[u32; 3]>,
    /// One after the other, all triangles.
    pub groups: Vec<Group>,
    /// None where no triangle has holes.
    pub cut_outs: Option<CutOuts>,
}

/// The triangles that are left where alpha is large enough alone.
#[derive(Debug, Clone, PartialEq)]
pub struct CutOuts {
    /// The first of them; all behind it are too.
    pub first: u32,
    /// Of each from the first on: texture coordinates of its corners.
    pub uvs: Vec<[[f32; 2]; 3]>,
    /// Of each from the first on: its place among the surfaces.
    pub surfaces: Vec<u32>,
    pub table: Vec<Surface>,
    pub images: Vec<AlphaImage>,
    /// The most samples along the longer side of a pixel's footprint, 1 or more.
    pub anisotropy: f32,
}

/// How a surface is cut out: where its own alpha times that of its image is `least` or more, it is there.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Surface {
    pub alpha: f32,
    pub least: f32,
    /// Place among the images.
    pub image: Option<u32>,
}

/// The alpha of an image that repeats: texels of 8 bits for 0 to 1, row by row as texture coordinates grow.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AlphaImage {
    pub width: u32,
    pub height: u32,
    /// The image, then each halving down to one texel.
    pub levels: Vec<Vec<u8>>,
}

/// A window and the buffer that its samples go to.
pub type Order<'a> = (&'a Window, GlBuffer);

/// Draws one mesh. Buffers are ordered with OpenGL's commands before and after a call without a wait of the host. It may
/// keep hold of the positions and of what it drew into: OpenGL deletes the first after it, the others after
/// [`forget`](Rasteriser::forget).
pub trait Rasteriser: std::fmt::Debug {
    /// Draws depth, ids, or both in one turn, because changing over from OpenGL and back takes longer than either.
    ///
    /// Depth of every sample: f32 from 0 to 1, 1 where nothing is; all triangles are drawn from both sides. Ids, what every
    /// sample sees: u64, the bits of its depth, then in the lower half the triangle; all ones where nothing is; triangles
    /// are drawn from the sides that their groups say.
    ///
    /// # Errors
    /// `Fault` when the device fails, or a buffer is unknown or smaller than its window.
    fn draw(&mut self, depth: Option<Order<'_>>, ids: Option<Order<'_>>) -> Result<()>;

    /// Compiles what passes of depth, of ids, or of both need, so that no frame waits for that.
    ///
    /// # Errors
    /// `Unavailable` when there is no compiler; `Fault` when compiling fails.
    fn make_ready(&mut self, depth: bool, ids: bool) -> Result<()>;

    /// Lets go of a buffer that was drawn into, before OpenGL deletes it: its name may be given to another.
    fn forget(&mut self, _name: u32) {}
}
