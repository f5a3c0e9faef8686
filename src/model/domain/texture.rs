//! Decoded images: RGBA8, top row first.

use std::io::Cursor;
use std::sync::Arc;

use image::{ImageDecoder as _, ImageFormat, ImageReader};

use super::jpeg_memory::coefficient_bytes;
use crate::error::{Result, invalid};
use crate::escaping::escape_controls;
use crate::memory::MemoryReservation;

/// The largest width or height of a texture in pixels.
pub(super) const MAX_TEXTURE_SIDE: u32 = 8192;

/// An image of `width` x `height` RGBA8 pixels, top row first.
#[derive(Debug, Clone, PartialEq)]
pub struct Texture {
    pub name: String,
    width: u32,
    height: u32,
    rgba: Vec<u8>,
}

/// Largest memory in bytes of a WebP decoder. A lossy image has a luma and two chroma planes, whose sides are multiples of 16,
/// and RGB and alpha planes while they are combined; a lossless one has an RGBA image. The file is copied, and its tables of
/// symbols have several entries per byte.
const fn webp_bytes(file_bytes: u64, width: u32, height: u32) -> u64 {
    const BYTES_PER_PIXEL: u64 = 10;
    const BYTES_PER_FILE_BYTE: u64 = 16;
    let pixels = (width as u64).next_multiple_of(16) * (height as u64).next_multiple_of(16);
    BYTES_PER_PIXEL * pixels + BYTES_PER_FILE_BYTE * file_bytes
}

impl Texture {
    /// A texture from its pixels.
    ///
    /// # Errors
    /// `Invalid` if a side is 0 or above 8192, or the number of bytes is not 4 x width x height.
    pub fn new(name: impl Into<String>, width: u32, height: u32, rgba: Vec<u8>) -> Result<Self> {
        let name = escape_controls(&name.into()).into_owned();
        if width == 0 || height == 0 || width > MAX_TEXTURE_SIDE || height > MAX_TEXTURE_SIDE {
            let field = format!("texture '{name}': size");
            return Err(invalid(
                field,
                format!("1 to {MAX_TEXTURE_SIDE} pixels per side"),
                format!("{width} x {height}"),
            ));
        }
        if rgba.len() != 4 * width as usize * height as usize {
            return Err(invalid(format!("texture '{name}': bytes"), format!("4 x {width} x {height}"), rgba.len()));
        }
        Ok(Self { name, width, height, rgba })
    }

    /// Number of bytes at the start of a file that [`Self::is_supported`] needs.
    pub const SIGNATURE_BYTES: usize = 16;

    /// Whether a file that starts with these bytes is a PNG, JPEG or WebP image.
    pub fn is_supported(start: &[u8]) -> bool {
        matches!(image::guess_format(start), Ok(ImageFormat::Png | ImageFormat::Jpeg | ImageFormat::WebP))
    }

    /// Decodes PNG, JPEG or WebP bytes. Reserves the memory of the pixels in `memory` as soon as the header is read.
    ///
    /// # Errors
    /// `Invalid` if the bytes are no PNG, JPEG or WebP image, or a side exceeds 8192 pixels. `OutOfMemory`.
    pub fn decode(name: impl Into<String>, bytes: &[u8], memory: &Arc<MemoryReservation>) -> Result<Self> {
        let name = escape_controls(&name.into()).into_owned();
        let decode_error =
            |error: &dyn std::fmt::Display| invalid(format!("texture '{name}'"), "a PNG, JPEG or WebP image", error);
        let mut reader = ImageReader::new(Cursor::new(bytes));
        let mut limits = image::Limits::default();
        limits.max_image_width = Some(MAX_TEXTURE_SIDE);
        limits.max_image_height = Some(MAX_TEXTURE_SIDE);
        reader.limits(limits);
        let reader = reader.with_guessed_format().map_err(|error| decode_error(&error))?;
        let format = reader.format();
        let decoder = reader.into_decoder().map_err(|error| decode_error(&error))?;
        let (width, height) = decoder.dimensions();
        let object = format!("texture '{name}' of {width} x {height} pixels");
        // The decoded image in the format of the file is freed after its conversion to RGBA8.
        let file_bytes = bytes.len() as u64;
        let of_decoder = match format {
            // The decoder copies the file, and keeps the coefficients of some images.
            Some(ImageFormat::Jpeg) => file_bytes + coefficient_bytes(bytes, width, height),
            Some(ImageFormat::WebP) => webp_bytes(file_bytes, width, height),
            _ => 0,
        };
        let _decoded = memory.reserve_temporary(&object, decoder.total_bytes().saturating_add(of_decoder))?;
        memory.reserve(&object, 4 * u64::from(width) * u64::from(height))?;
        let image = image::DynamicImage::from_decoder(decoder).map_err(|error| decode_error(&error))?.into_rgba8();
        Self::new(name, width, height, image.into_raw())
    }

    /// Width in pixels.
    pub const fn width(&self) -> u32 {
        self.width
    }

    /// Height in pixels.
    pub const fn height(&self) -> u32 {
        self.height
    }

    /// The pixels, four bytes each, top row first.
    pub fn rgba(&self) -> &[u8] {
        &self.rgba
    }

    /// Whether any pixel is not opaque.
    pub fn has_alpha(&self) -> bool {
        self.rgba.chunks_exact(4).any(|pixel| pixel[3] < 255)
    }
}
