//! The formats of frames on the wire.

/// Wire format of pixels. Multi-byte values are little-endian; the top row comes first.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FrameFormat {
    Png,
    /// RGBA8 sRGB.
    Rgba,
    /// One f32 per pixel: depth.
    F32,
    /// One u32 per pixel: domain indices.
    U32,
    /// Three f32 per pixel: normals.
    F32x3,
}
