//! Minimum coded units: the samples of their blocks, from pixels.
//!
//! The samples of pixels are integers: a decoder rounds its samples too, and so returns most of them without an error if
//! the quantization is fine. Chroma of half the resolution is the sum over four pixels; the quantization factors contain
//! the division by four.

use super::lanes::Lanes;
use pulp::f32x8;

/// Pixels of a row of a block, and their bytes.
const BLOCK_SIDE: usize = 8;
const BLOCK_ROW_BYTES: usize = 4 * BLOCK_SIDE;

/// The components of a picture.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Component {
    Luma,
    Cb,
    Cr,
}

/// The resolution of chroma.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Subsampling {
    /// As that of luma (4:4:4). An MCU has one block per component.
    Full,
    /// Half that of luma in both directions (4:2:0). An MCU has four blocks of luma, and one of each chroma component.
    Half,
}

/// Rows of RGBA8 pixels, without padding.
#[derive(Debug, Clone, Copy)]
pub(super) struct Window<'a> {
    pub(super) pixels: &'a [u8],
    pub(super) size: [usize; 2],
}

/// Room for a copy of the pixels of the largest MCU.
pub(super) type McuCopy = [u8; 4 * 16 * 16];

/// The samples of the blocks of an MCU. Only the first three are used with chroma of the full resolution.
pub(super) type McuBlocks = [[f32x8; 8]; 6];

/// The pixels of an MCU.
#[derive(Clone, Copy)]
pub(super) struct McuPixels<'a> {
    /// The first byte is that of the first pixel of the MCU.
    bytes: &'a [u8],
    /// Distance of rows in bytes.
    pitch: usize,
}

impl Subsampling {
    /// Pixels of the side of an MCU.
    pub(super) const fn mcu_side(self) -> usize {
        match self {
            Self::Full => BLOCK_SIDE,
            Self::Half => 2 * BLOCK_SIDE,
        }
    }

    /// The components of the blocks of an MCU, in their order.
    pub(super) const fn components(self) -> &'static [Component] {
        use Component::{Cb, Cr, Luma};
        match self {
            Self::Full => &[Luma, Cb, Cr],
            Self::Half => &[Luma, Luma, Luma, Luma, Cb, Cr],
        }
    }

    /// Number of pixels whose sum is a sample of chroma.
    pub(super) const fn summed_pixels(self) -> usize {
        match self {
            Self::Full => 1,
            Self::Half => 4,
        }
    }
}

impl Window<'_> {
    /// The pixels of the MCU at a position. An MCU that reaches beyond the picture is copied to `copy`, and repeats the
    /// last column and row.
    #[inline(always)]
    pub(super) fn mcu<'a>(&'a self, [x, y]: [usize; 2], side: usize, copy: &'a mut McuCopy) -> McuPixels<'a> {
        let pitch = 4 * self.size[0];
        if x + side <= self.size[0] && y + side <= self.size[1] {
            return McuPixels { bytes: self.pixels.get(pitch * y + 4 * x..).unwrap_or_default(), pitch };
        }
        self.copy_mcu([x, y], side, copy);
        McuPixels { bytes: copy, pitch: 4 * side }
    }

    #[cold]
    fn copy_mcu(&self, [x, y]: [usize; 2], side: usize, copy: &mut McuCopy) {
        let pixels = self.pixels.as_chunks::<4>().0;
        for (index, target) in copy.as_chunks_mut::<4>().0.iter_mut().take(side * side).enumerate() {
            let column = (x + index % side).min(self.size[0] - 1);
            let row = (y + index / side).min(self.size[1] - 1);
            *target = pixels.get(self.size[0] * row + column).copied().unwrap_or_default();
        }
    }
}

impl McuPixels<'_> {
    /// Samples of the components of eight pixels.
    #[inline(always)]
    fn samples<L: Lanes>(&self, lanes: L, [x, y]: [usize; 2]) -> [f32x8; 3] {
        lanes.samples(self.row([x, y]).unwrap_or(&[0; BLOCK_ROW_BYTES]))
    }

    /// Eight pixels.
    #[inline(always)]
    fn row(&self, [x, y]: [usize; 2]) -> Option<&[u8; BLOCK_ROW_BYTES]> {
        self.bytes.get(self.pitch * y + 4 * x..).and_then(<[u8]>::first_chunk)
    }

    /// Whether the pixels of a square are equal.
    #[inline(always)]
    pub(super) fn are_equal(&self, side: usize) -> bool {
        let Some(first) = self.bytes.first_chunk::<4>() else { return true };
        let first = u64::from(u32::from_ne_bytes(*first)) * 0x1_0000_0001;
        let mut differences = [0; 4];
        for y in 0..side {
            for x in (0..side).step_by(BLOCK_SIDE) {
                let pairs: [u64; 4] = self.row([x, y]).map_or([0; 4], |row| pulp::cast(*row));
                for (difference, pair) in differences.iter_mut().zip(pairs) {
                    *difference |= pair ^ first;
                }
            }
        }
        differences == [0; 4]
    }
}

/// Computes the samples of the blocks of an MCU, one per component, with chroma of the full resolution.
#[inline(always)]
pub(super) fn sample_full<L: Lanes>(lanes: L, pixels: &McuPixels<'_>, blocks: &mut McuBlocks) {
    for y in 0..BLOCK_SIDE {
        let samples = pixels.samples(lanes, [0, y]);
        for (block, samples) in blocks.iter_mut().zip(samples) {
            block[y] = samples;
        }
    }
}

/// The samples of the components of an MCU whose pixels are equal: those that the other functions would return.
#[inline(always)]
pub(super) fn constant_samples<L: Lanes>(lanes: L, pixels: &McuPixels<'_>, subsampling: Subsampling) -> [f32; 3] {
    let samples: [[f32; 8]; 3] = pulp::cast(pixels.samples(lanes, [0, 0]));
    let summed_pixels = subsampling.summed_pixels() as f32;
    [samples[0][0], summed_pixels * samples[1][0], summed_pixels * samples[2][0]]
}

/// As [`sample_full`] with chroma of half the resolution: four blocks of luma, then one of each chroma component.
#[inline(always)]
pub(super) fn sample_half<L: Lanes>(lanes: L, pixels: &McuPixels<'_>, blocks: &mut McuBlocks) {
    let zeros = lanes.splat_f32s(0.0);
    for chroma_row in 0..BLOCK_SIDE {
        // Sums of two rows: Cb and Cr of the left half of the MCU, and of the right half.
        let mut row_sums = [[zeros; 2]; 2];
        for (half, sums) in row_sums.iter_mut().enumerate() {
            let upper = pixels.samples(lanes, [BLOCK_SIDE * half, 2 * chroma_row]);
            let lower = pixels.samples(lanes, [BLOCK_SIDE * half, 2 * chroma_row + 1]);
            let luma = &mut blocks[2 * (chroma_row / 4) + half];
            luma[2 * (chroma_row % 4)] = upper[0];
            luma[2 * (chroma_row % 4) + 1] = lower[0];
            *sums = [lanes.add_f32s(upper[1], lower[1]), lanes.add_f32s(upper[2], lower[2])];
        }
        blocks[4][chroma_row] = lanes.pair_sums(row_sums[0][0], row_sums[1][0]);
        blocks[5][chroma_row] = lanes.pair_sums(row_sums[0][1], row_sums[1][1]);
    }
}
