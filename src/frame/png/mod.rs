//! A PNG encoder for rendered frames. It encodes strips of rows independently of each other, so that several threads
//! can work on one picture. The file depends only on the pixels, not on the number of threads. The kernels in
//! `kernels/png.cu` write the same file.
//!
//! A strip is filtered with Sub (`filter`), split into literals and runs of zeros (`segments`), and written as one
//! deflate block with a Huffman code of its own (`deflate`, `symbols`, `block_header`, `huffman`). Each pixel, word and
//! symbol depends on its neighbors and on the code of the strip only, so the kernels compute them in parallel.
//!
//! # Format
//! The strips are parts of one zlib stream. A strip ends on a byte boundary, with an empty stored block, and does not
//! refer to other strips. Each strip is an IDAT chunk, which costs 12 bytes: the thread that encodes the strip also
//! computes the checksum of the chunk, and checksums need not be combined. The Adler-32 checksum of the stream is
//! combined from those of the strips and follows in a last IDAT chunk.
//!
//! A strip that does not compress is stored. The filtered pixels have one byte per row and one per channel of a pixel.
//! A file is larger by at most 76 bytes, plus 12 bytes per strip, plus 5 bytes per started 65,535 bytes of a strip.

mod adler;
mod bit_writer;
mod block_header;
mod chunks;
mod deflate;
mod dispatch;
mod filter;
mod huffman;
mod segments;
mod symbols;

use filter::Channels;
use modalcast_model::error::{Result, fault};
use segments::Segment;

/// Size of the filtered rows of a strip, unless one row is larger. Smaller strips spend more time and bytes on their
/// Huffman codes. Larger ones do not fit in the second-level cache, and keep fewer threads busy.
const STRIP_BYTES: usize = 128 << 10;
/// Deflate with a window of 32 KiB, fastest compression level.
const ZLIB_HEADER: [u8; 2] = [0x78, 0x01];
/// Maximum size of the filtered rows of a strip, so that the content of a chunk has less than 2^31 bytes.
const MAX_STRIP_BYTES: usize = 1 << 30;

/// The size of a picture and its division into strips.
#[derive(Debug, Clone, Copy)]
pub struct PngLayout {
    width: u32,
    height: u32,
    channels: Channels,
    /// Rows of each strip but the last one, which may have fewer.
    strip_rows: usize,
}

/// An encoded strip.
#[derive(Debug)]
pub struct EncodedStrip {
    /// An IDAT chunk.
    chunk: Vec<u8>,
    /// The checksum of the filtered rows, and their size.
    adler: u32,
    filtered_bytes: usize,
}

/// Memory that the encoding of a strip needs, to be reused for the next one.
#[derive(Debug, Default)]
pub struct StripBuffers {
    filtered: Vec<u8>,
    segments: Vec<Segment>,
}

impl PngLayout {
    /// The layout of a file without an alpha channel.
    ///
    /// # Errors
    /// `Fault` when a side is 0 or the picture is too large for PNG.
    pub fn opaque(width: u32, height: u32) -> Result<Self> {
        Self::new(width, height, Channels::Rgb)
    }

    /// The layout of the same picture with an alpha channel.
    ///
    /// # Errors
    /// `Fault` when the picture is too large for PNG.
    pub fn translucent(&self) -> Result<Self> {
        Self::new(self.width, self.height, Channels::Rgba)
    }

    fn new(width: u32, height: u32, channels: Channels) -> Result<Self> {
        let row_bytes = (width as usize).saturating_mul(channels.count()).saturating_add(1);
        if width == 0 || height == 0 || height > i32::MAX as u32 || row_bytes > MAX_STRIP_BYTES {
            let limits = format!("rows of 1 pixel to {MAX_STRIP_BYTES} bytes, and 1 to {} rows", i32::MAX);
            return Err(fault("encode", format!("expected {limits}, got {width}x{height} pixels")));
        }
        Ok(Self { width, height, channels, strip_rows: (STRIP_BYTES / row_bytes).max(1) })
    }

    /// Number of strips, at least 1.
    pub const fn strip_count(&self) -> usize {
        (self.height as usize).div_ceil(self.strip_rows)
    }

    /// Encodes the strip `index` of a picture, whose RGBA8 pixels are `rgba`, top row first. Returns `None` if a pixel
    /// is not opaque and the file has no alpha channel.
    ///
    /// # Errors
    /// `Fault` when the picture has no such strip.
    pub fn encode_strip(&self, rgba: &[u8], index: usize, buffers: &mut StripBuffers) -> Result<Option<EncodedStrip>> {
        let row_bytes = 4 * self.width as usize;
        let first_row = self.strip_rows * index;
        let rows = self.strip_rows.min((self.height as usize).saturating_sub(first_row));
        let pixels = rgba.get(row_bytes * first_row..).and_then(|rest| rest.get(..row_bytes * rows));
        let Some(pixels) = pixels.filter(|pixels| !pixels.is_empty()) else {
            let (size, bytes) = (format!("{}x{} pixels", self.width, self.height), rgba.len());
            return Err(fault("encode", format!("expected strip {index} of {size}, got {bytes} bytes of pixels")));
        };
        let StripBuffers { filtered, segments } = buffers;
        filtered.resize(rows * (1 + self.channels.count() * self.width as usize), 0);
        if !filter::filter_rows(pixels, self.width as usize, self.channels, filtered) {
            return Ok(None);
        }
        let mut chunk = chunks::OpenChunk::idat();
        if index == 0 {
            chunk.bytes().extend_from_slice(&ZLIB_HEADER);
        }
        deflate::compress(filtered, index + 1 == self.strip_count(), segments, chunk.bytes());
        let adler = simd_adler32::adler32(&filtered.as_slice());
        Ok(Some(EncodedStrip { chunk: chunk.close(), adler, filtered_bytes: filtered.len() }))
    }

    /// The file that contains these strips, which are all strips of the picture in order.
    pub fn assemble(&self, strips: &[EncodedStrip]) -> Vec<u8> {
        let add = |sum, strip: &EncodedStrip| adler::combine(sum, strip.adler, strip.filtered_bytes);
        let head = chunks::head(self.width, self.height, self.channels);
        let tail = chunks::tail(strips.iter().fold(adler::EMPTY, add));
        let strip_bytes: usize = strips.iter().map(|strip| strip.chunk.len()).sum();
        let mut file = Vec::with_capacity(head.len() + strip_bytes + tail.len());
        file.extend_from_slice(&head);
        strips.iter().for_each(|strip| file.extend_from_slice(&strip.chunk));
        file.extend_from_slice(&tail);
        file
    }
}

/// Encodes RGBA8 pixels, top row first, on the calling thread.
///
/// # Errors
/// `Fault` when a side is 0, or the picture is too large or has too few pixels.
pub(super) fn encode(width: u32, height: u32, rgba: &[u8]) -> Result<Vec<u8>> {
    let mut buffers = StripBuffers::default();
    let mut encode_as = |layout: PngLayout| -> Result<Option<Vec<u8>>> {
        let strips = (0..layout.strip_count()).map(|index| layout.encode_strip(rgba, index, &mut buffers));
        let strips: Option<Vec<EncodedStrip>> = strips.collect::<Result<_>>()?;
        Ok(strips.map(|strips| layout.assemble(&strips)))
    };
    let layout = PngLayout::opaque(width, height)?;
    match encode_as(layout)? {
        Some(file) => Ok(file),
        None => encode_as(layout.translucent()?)?.ok_or_else(|| fault("encode", "expected a file with alpha")),
    }
}

#[cfg(test)]
mod tests;
