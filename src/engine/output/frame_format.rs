//! The formats of frames on the wire.

use modalcast_model::error::{Result, invalid};

/// Wire format of pixels. Multi-byte values are little-endian; the top row comes first.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FrameFormat {
    Png,
    /// Without alpha.
    Jpeg(JpegQuality),
    /// RGB8 sRGB: [`Self::Rgba`] without alpha.
    Rgb,
    /// RGBA8 sRGB.
    Rgba,
    /// One f32 per pixel: depth.
    F32,
    /// One u32 per pixel: domain indices.
    U32,
    /// Three f32 per pixel: normals.
    F32x3,
}

/// Quality of a JPEG: 1 (smallest file) to 100 (smallest error).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct JpegQuality(u8);

impl JpegQuality {
    /// The quality of a request that names none.
    const DEFAULT: Self = Self(90);

    /// Parses a quality; 0 selects the default.
    ///
    /// # Errors
    /// `Invalid` above 100.
    pub fn parse(field: &str, quality: u32) -> Result<Self> {
        match u8::try_from(quality) {
            Ok(0) => Ok(Self::DEFAULT),
            Ok(quality @ 1..=100) => Ok(Self(quality)),
            _ => Err(invalid(field, "1 to 100, or 0 for 90", quality)),
        }
    }

    pub const fn get(self) -> u8 {
        self.0
    }
}
