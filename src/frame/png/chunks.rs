//! The chunks of a PNG file (PNG specification, third edition, section 5).

use super::filter::Channels;

const SIGNATURE: [u8; 8] = *b"\x89PNG\r\n\x1a\n";
/// Bytes before the content of a chunk: its length and its type.
const PREFIX_BYTES: usize = 8;

/// A chunk whose content is being written.
pub(super) struct OpenChunk(Vec<u8>);

impl OpenChunk {
    /// A chunk of pixels.
    pub(super) fn idat() -> Self {
        Self::new(b"IDAT")
    }

    fn new(chunk_type: &[u8; 4]) -> Self {
        Self([&[0; 4], &chunk_type[..]].concat())
    }

    /// The bytes of the chunk, to which the content is appended.
    pub(super) const fn bytes(&mut self) -> &mut Vec<u8> {
        &mut self.0
    }

    fn with(mut self, content: &[u8]) -> Self {
        self.0.extend_from_slice(content);
        self
    }

    /// The chunk with its length and its checksum. A content has less than 2^31 bytes.
    pub(super) fn close(self) -> Vec<u8> {
        let Self(mut bytes) = self;
        let length = (bytes.len() - PREFIX_BYTES) as u32;
        bytes[..4].copy_from_slice(&length.to_be_bytes());
        let checksum = crc32fast::hash(&bytes[4..]);
        bytes.extend_from_slice(&checksum.to_be_bytes());
        bytes
    }
}

/// The bytes of a file before its pixels: 8 bits per channel, not interlaced, sRGB with perceptual intent.
pub(super) fn head(width: u32, height: u32, channels: Channels) -> Vec<u8> {
    let header = OpenChunk::new(b"IHDR").with(&width.to_be_bytes()).with(&height.to_be_bytes()).with(&[
        8,
        channels.color_type(),
        0,
        0,
        0,
    ]);
    [&SIGNATURE, &header.close()[..], &OpenChunk::new(b"sRGB").with(&[0]).close()].concat()
}

/// The bytes of a file after its compressed pixels: the checksum of the zlib stream, in a chunk of its own, and the
/// end.
pub(super) fn tail(adler: u32) -> Vec<u8> {
    [OpenChunk::idat().with(&adler.to_be_bytes()).close(), OpenChunk::new(b"IEND").close()].concat()
}
