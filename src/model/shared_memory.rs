//! Traits of device memory that OpenGL and another API share for as long as it exists. The module `gpu` of
//! `modalcast-compute` allocates it in CUDA. The renderer draws pictures into such memory, and CUDA copies them to the
//! host. A deformer writes vertices into such memory, and OpenGL copies them to the vertex buffers of the scene. A compute
//! rasterizer reads these vertices and writes its samples into such memory, which OpenGL reads.
//!
//! Each API holds its own reference to the memory, so neither can free it while the other uses it. Nothing orders the
//! accesses of the two APIs on the device. The host does: it waits for the end of the accesses of one API before it
//! submits those of the other one.

use std::any::Any;
use std::fmt::Debug;
use std::ops::Range;
use std::os::fd::OwnedFd;
use std::rc::Rc;
use std::sync::Arc;

use crate::error::Result;

/// Allocates pictures in memory that OpenGL can import.
pub trait PictureMemory: Debug {
    /// Allocates a picture of `bytes` bytes.
    ///
    /// # Errors
    /// `Fault` if the device has not enough memory or cannot export it.
    fn create_picture(&self, bytes: usize) -> Result<NewPicture>;
}

/// A picture that OpenGL has not imported yet.
#[derive(Debug)]
pub struct NewPicture {
    /// Names the memory. An import takes ownership of it.
    pub descriptor: OwnedFd,
    /// Size of the allocation, which an import must state: the bytes of the picture, rounded up by the device.
    pub allocated_bytes: u64,
    pub picture: Box<dyn SharedPicture>,
}

/// A picture in device memory, and the pinned host memory into which it is copied. At most one copy is in flight.
/// Dropping the picture waits for the copy.
pub trait SharedPicture: Debug {
    /// Starts to copy the picture to the host, without waiting. OpenGL has completed all commands that write the picture,
    /// and writes it again only after [`Self::is_copied`] or [`Self::finish_copy`].
    ///
    /// # Errors
    /// `Fault` if a copy is in flight, a reader has the pixels of the last copy, the picture has fewer bytes, or the
    /// device fails.
    fn start_copy(&mut self, request: CopyRequest) -> Result<()>;

    /// Whether no copy is in flight. Also true if the device has failed; [`Self::finish_copy`] then returns the error.
    fn is_copied(&self) -> bool;

    /// Waits for the copy. Any thread may read the returned pixels.
    ///
    /// # Errors
    /// `Fault` if no copy was started, or if the device fails.
    fn finish_copy(&mut self) -> Result<CopiedPixels>;

    /// Fills the picture with a word and waits, to test that OpenGL sees the word.
    ///
    /// # Errors
    /// `Fault` if the device fails.
    fn fill(&mut self, word: u32) -> Result<()>;
}

/// What a copy moves to the host.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CopyRequest {
    /// Bytes of the pixels and of the content behind them.
    pub bytes: usize,
    /// The PNG file of the pixels. `None`: pixels only.
    pub png: Option<PngRequest>,
}

/// The PNG file of a picture: RGBA8 sRGB pixels without gaps between the rows, top row first.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PngRequest {
    /// Width and height in pixels.
    pub size: [u32; 2],
    /// Whether the pixels are copied, too. The content behind them always is.
    pub copies_pixels: bool,
}

/// The result of a copy.
#[derive(Debug, Clone)]
pub struct CopiedPixels {
    /// Without pixels if `png` is there and the request did not ask for pixels.
    pub pixels: Arc<dyn HostPixels>,
    /// The PNG file. `None` if none was requested, or if the picture has no file: it is not opaque, too many files are in
    /// use, or the implementation has no encoder. The pixels are then there.
    pub png: Option<CopiedPng>,
}

/// A PNG file that the device has encoded.
#[derive(Debug, Clone)]
pub struct CopiedPng {
    pub file: Arc<dyn HostPixels>,
    /// Whether the pixels were copied, too.
    pub has_pixels: bool,
    /// Milliseconds that the device encoded.
    pub ms: f64,
}

/// Pixels or a file in pinned host memory. While a reference exists, no copy overwrites them.
pub trait HostPixels: Debug + Send + Sync {
    /// The bytes of the last copy.
    fn bytes(&self) -> &[u8];
}

/// Imports vertices of a scene, and copies them to the vertex buffers of the scene.
pub trait VertexImporter: Debug {
    /// Imports memory with the vertices of one step.
    ///
    /// # Errors
    /// `Fault` if the ranges do not have the sizes of the scene's buffers, or OpenGL cannot import the memory.
    fn import(&self, vertices: ExportedVertices) -> Result<Box<dyn ImportedVertices>>;
}

/// Memory with vertices that OpenGL has not imported yet.
#[derive(Debug)]
pub struct ExportedVertices {
    /// Names the memory. An import takes ownership of it.
    pub descriptor: OwnedFd,
    /// Size of the allocation, which an import must state.
    pub allocated_bytes: u64,
    /// Byte ranges of positions, normals and, if the scene has them, tangents. Each begins at a multiple of 256.
    pub ranges: Vec<Range<u64>>,
}

/// Imported memory with the vertices of one step.
pub trait ImportedVertices: Debug {
    /// Copies the vertices to the buffers of the scene with OpenGL commands, without waiting. Frames that were
    /// submitted earlier show the old vertices, later ones the new vertices. The caller has waited for the writer of
    /// the memory.
    ///
    /// # Errors
    /// `Fault` if OpenGL reports an error.
    fn copy_to_scene(&self) -> Result<()>;

    /// Whether the last copy is complete, so that the memory can be written. Also true if the wait fails;
    /// [`Self::wait_for_copy`] then returns the error.
    fn is_copied(&self) -> bool;

    /// Waits for the last copy.
    ///
    /// # Errors
    /// `Fault` if the device does not finish.
    fn wait_for_copy(&self) -> Result<()>;
}

/// A range of shared memory, as a handle of the API that allocated it. The memory exists at least as long as the handle.
pub trait SharedRange: Debug {
    /// The handle itself, so that its API can get back its own type.
    fn as_any(&self) -> &dyn Any;
}

/// The positions of one step in shared memory: three f32 per vertex.
#[derive(Debug, Clone)]
pub struct SharedPositions {
    pub range: Rc<dyn SharedRange>,
    /// Number of the step, which no other step of the deformer has.
    pub step: u64,
}
