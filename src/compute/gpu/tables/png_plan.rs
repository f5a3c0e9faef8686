//! Strips and tiles of a picture that `png` encodes, and the memory that its encoding needs.

use modalcast_model::error::{Result, invalid};

/// Bytes of the filtered rows of a strip, unless one row is larger. Twin: STRIP_BYTES in `src/frame/png/mod.rs`.
const STRIP_BYTES: u64 = 128 << 10;
/// Bytes of a tile. Twin: TILE_BYTES in `kernels/png.cuh`.
pub(crate) const TILE_BYTES: u64 = 8192;
/// Largest content of a stored block, and the bytes before it.
const MAX_STORED_BYTES: u64 = 65_535;
const STORED_HEADER_BYTES: u64 = 5;
/// Bytes of a PNG chunk in addition to its content.
const CHUNK_BYTES: u64 = 12;
/// Bytes of a file outside the chunks of its strips: signature, IHDR, sRGB, the header of the zlib stream, its checksum
/// in a chunk of its own, and IEND.
const FRAME_BYTES: u64 = 76;
/// The checksum of a chunk supports contents below 2^24 bytes. A row of this width has at most 2^22 + 1 bytes.
const MAX_WIDTH: u32 = 1 << 20;
/// The kernels address the bytes of a file with 32 bits.
const MAX_FILE_BYTES: u64 = 1 << 30;

/// The channels of a PNG.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum PngChannels {
    /// Without alpha.
    Rgb,
    Rgba,
}

/// The division of a picture into strips and tiles, and the bound of its file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct PngPlan {
    pub width: u32,
    pub height: u32,
    /// Bytes of a filtered row.
    pub row_bytes: u32,
    /// Rows of each strip but the last one, which may have fewer.
    pub strip_rows: u32,
    pub strip_count: u32,
    /// Tiles of a full strip.
    pub tiles_per_strip: u32,
    /// Words of the file that each block of `png_filter` clears.
    pub words_per_tile: u32,
    /// Upper bound of the file's size. Pictures of noise almost reach it.
    pub max_file_bytes: u64,
}

impl PngChannels {
    const fn count(self) -> u64 {
        match self {
            Self::Rgb => 3,
            Self::Rgba => 4,
        }
    }
}

impl PngPlan {
    /// The plan of a picture of `width` x `height` pixels.
    ///
    /// # Errors
    /// `Invalid` when a side is 0 or the picture is too large.
    pub(crate) fn new(width: u32, height: u32, channels: PngChannels) -> Result<Self> {
        let reject = || {
            let expected = format!("1 to {MAX_WIDTH} columns, 1 row or more, and a file of at most 2^30 bytes");
            invalid("picture", expected, format!("{width}x{height} pixels"))
        };
        if width == 0 || height == 0 || width > MAX_WIDTH {
            return Err(reject());
        }
        let row_bytes = 1 + channels.count() * u64::from(width);
        let strip_rows = (STRIP_BYTES / row_bytes).clamp(1, u64::from(height));
        let strip_count = u64::from(height).div_ceil(strip_rows);
        let strip_bytes = strip_rows * row_bytes;
        let stored_block_bytes = STORED_HEADER_BYTES * strip_bytes.div_ceil(MAX_STORED_BYTES);
        let max_file_bytes =
            FRAME_BYTES + row_bytes * u64::from(height) + strip_count * (CHUNK_BYTES + stored_block_bytes);
        if max_file_bytes > MAX_FILE_BYTES {
            return Err(reject());
        }
        let tiles_per_strip = strip_bytes.div_ceil(TILE_BYTES);
        let words_per_tile = max_file_bytes.div_ceil(4).div_ceil(strip_count * tiles_per_strip);
        // Every number is at most that of the file's bytes, so 32 bits hold it.
        Ok(Self {
            width,
            height,
            row_bytes: row_bytes as u32,
            strip_rows: strip_rows as u32,
            strip_count: strip_count as u32,
            tiles_per_strip: tiles_per_strip as u32,
            words_per_tile: words_per_tile as u32,
            max_file_bytes,
        })
    }

    /// Number of tiles of all strips. The last strip counts as a full one.
    pub(crate) const fn tile_count(&self) -> u32 {
        self.strip_count * self.tiles_per_strip
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn strips_and_tiles_cover_every_row() {
        let sizes = [(1, 1), (1, 70_000), (65_535, 2), (1920, 1080), (8192, 3), (7, 18_725), (MAX_WIDTH, 3)];
        for (width, height) in sizes {
            for channels in [PngChannels::Rgb, PngChannels::Rgba] {
                let plan = PngPlan::new(width, height, channels).expect("a plan");
                let strip_bytes = u64::from(plan.strip_rows) * u64::from(plan.row_bytes);
                assert!(strip_bytes <= STRIP_BYTES || plan.strip_rows == 1, "{plan:?}");
                assert!(strip_bytes <= u64::from(plan.tiles_per_strip) * TILE_BYTES, "{plan:?}");
                assert!(strip_bytes > u64::from(plan.tiles_per_strip - 1) * TILE_BYTES, "{plan:?}");
                assert!(u64::from(plan.strip_count) * u64::from(plan.strip_rows) >= u64::from(height), "{plan:?}");
                assert!((plan.strip_count - 1) * plan.strip_rows < height, "{plan:?}");
                let cleared_bytes = 4 * u64::from(plan.words_per_tile) * u64::from(plan.tile_count());
                assert!(cleared_bytes >= plan.max_file_bytes, "{plan:?}");
            }
        }
        let plan = PngPlan::new(1920, 1080, PngChannels::Rgb).expect("a plan");
        assert_eq!((plan.strip_rows, plan.strip_count, plan.tiles_per_strip), (22, 50, 16));
    }

    #[test]
    fn empty_and_huge_pictures_are_rejected() {
        for (width, height) in [(0, 1), (1, 0), (MAX_WIDTH + 1, 1), (20_000, 20_000), (u32::MAX, u32::MAX)] {
            let error = PngPlan::new(width, height, PngChannels::Rgb).expect_err("an error").to_string();
            assert!(error.contains(&format!("{width}x{height}")), "{error}");
        }
    }
}
