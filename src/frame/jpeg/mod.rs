//! A baseline JPEG encoder for rendered frames. It encodes strips of rows independently of each other, so that several
//! threads can work on one picture. The file depends only on the pixels, not on the number of threads or on the
//! instruction set.
//!
//! A strip is divided into minimum coded units (MCU). The samples of an MCU (`mcu`) are transformed (`dct`), quantized
//! (`quantization`), and written with the Huffman codes of Annex K of ITU-T T.81 (`entropy`, `codes`, `bit_writer`).
//! `lanes` has the vector operations: AVX2 where the machine has it, else portable ones with the same results.
//!
//! # Format
//! JFIF with three components. The strips are the restart intervals of one scan: each begins with a reset DC prediction
//! and ends on a byte boundary, and a restart marker of 2 bytes precedes each strip but the first one. A decoder
//! reconstructs the same pixels as without restart markers.

mod bit_writer;
mod codes;
mod dct;
mod entropy;
mod header;
mod lanes;
mod mcu;
mod quantization;
mod zigzag;

use bit_writer::BitWriter;
use entropy::{DcPredictions, MAX_BLOCK_BYTES};
use lanes::Lanes;
use mcu::{McuBlocks, McuCopy, McuPixels, Subsampling, Window};
use modalcast_model::error::{Result, fault};
use quantization::{QuantizationFactors, QuantizationTables};

/// Pixels of a strip, unless one row of MCU has more. Smaller strips cost more bytes, and larger ones keep fewer threads
/// busy: a picture of 1920x1080 has 68 strips.
const STRIP_PIXELS: usize = 32 << 10;
/// Maximum side of a picture, and maximum number of MCU in a restart interval. The format stores them in 16 bits.
const MAX_SIDE: usize = u16::MAX as usize;
const MAX_STRIP_MCUS: usize = u16::MAX as usize;
/// The lowest quality whose chroma has the full resolution.
const FULL_CHROMA_QUALITY: u8 = 90;

/// The size of a picture, its quality and its division into strips.
#[derive(Debug, Clone)]
pub struct JpegLayout {
    width: usize,
    height: usize,
    subsampling: Subsampling,
    tables: QuantizationTables,
    factors: QuantizationFactors,
    /// Rows of MCU of each strip but the last one, which may have fewer.
    strip_mcu_rows: usize,
}

/// Memory that the encoding of a strip needs, to be reused for the next one.
#[derive(Debug, Default)]
pub struct JpegBuffers {
    bytes: Vec<u8>,
}

impl JpegLayout {
    /// The layout of a picture. `quality` is 1 to 100.
    ///
    /// # Errors
    /// `Fault` when a side is 0 or above 65,535.
    pub fn new(width: u32, height: u32, quality: u8) -> Result<Self> {
        Self::with_strip_pixels(width, height, quality, STRIP_PIXELS)
    }

    fn with_strip_pixels(width: u32, height: u32, quality: u8, strip_pixels: usize) -> Result<Self> {
        let [width, height] = [width as usize, height as usize];
        if !(1..=MAX_SIDE).contains(&width) || !(1..=MAX_SIDE).contains(&height) {
            return Err(fault(
                "encode",
                format!("expected sides of 1 to {MAX_SIDE} pixels, got {width}x{height} pixels"),
            ));
        }
        let subsampling = if quality < FULL_CHROMA_QUALITY { Subsampling::Half } else { Subsampling::Full };
        let tables = QuantizationTables::of_quality(quality);
        let factors = QuantizationFactors::new(&tables, subsampling);
        let side = subsampling.mcu_side();
        let row_mcus = width.div_ceil(side);
        let strip_mcu_rows = (strip_pixels / (side * width)).min(MAX_STRIP_MCUS / row_mcus).max(1);
        Ok(Self { width, height, subsampling, tables, factors, strip_mcu_rows })
    }

    /// Number of strips, at least 1.
    pub const fn strip_count(&self) -> usize {
        self.height.div_ceil(self.strip_mcu_rows * self.subsampling.mcu_side())
    }

    /// Encodes the strip `index` of a picture, whose RGBA8 pixels are `rgba`, top row first. Alpha is ignored.
    ///
    /// # Errors
    /// `Fault` when the picture has no such strip.
    pub fn encode_strip(&self, rgba: &[u8], index: usize, buffers: &mut JpegBuffers) -> Result<Vec<u8>> {
        let strip_rows = self.strip_mcu_rows * self.subsampling.mcu_side();
        let first_row = strip_rows * index;
        let rows = strip_rows.min(self.height.saturating_sub(first_row));
        let row_bytes = 4 * self.width;
        let pixels = rgba.get(row_bytes * first_row..).and_then(|rest| rest.get(..row_bytes * rows));
        let Some(pixels) = pixels.filter(|pixels| !pixels.is_empty()) else {
            let (size, bytes) = (format!("{}x{} pixels", self.width, self.height), rgba.len());
            return Err(fault("encode", format!("expected strip {index} of {size}, got {bytes} bytes of pixels")));
        };
        let strip = Strip { layout: self, pixels, rows, bytes: &mut buffers.bytes };
        #[cfg(target_arch = "x86_64")]
        if let Some(simd) = pulp::x86::V3::try_new() {
            return Ok(simd.vectorize(EncodeStrip { simd, strip }));
        }
        Ok(strip.encode(pulp::Scalar256b))
    }

    /// The file that contains these strips, which are all strips of the picture in order.
    pub fn assemble(&self, strips: &[Vec<u8>]) -> Vec<u8> {
        let restart_interval = (strips.len() > 1).then(|| {
            let row_mcus = self.width.div_ceil(self.subsampling.mcu_side());
            row_mcus * self.strip_mcu_rows
        });
        let head = header::head([self.width, self.height], self.subsampling, &self.tables, restart_interval);
        let strip_bytes: usize = strips.iter().map(|strip| strip.len() + 2).sum();
        let mut file = Vec::with_capacity(head.len() + strip_bytes);
        file.extend_from_slice(&head);
        for (index, strip) in strips.iter().enumerate() {
            if index > 0 {
                file.extend_from_slice(&header::restart_marker(index - 1));
            }
            file.extend_from_slice(strip);
        }
        file.extend_from_slice(&header::END_OF_IMAGE);
        file
    }
}

/// Rows of pixels to encode.
struct Strip<'a> {
    layout: &'a JpegLayout,
    pixels: &'a [u8],
    rows: usize,
    bytes: &'a mut Vec<u8>,
}

impl Strip<'_> {
    #[inline(always)]
    fn encode<L: Lanes>(self, lanes: L) -> Vec<u8> {
        let Self { layout, pixels, rows, bytes } = self;
        let side = layout.subsampling.mcu_side();
        let window = Window { pixels, size: [layout.width, rows] };
        let (predictions, writer) = (DcPredictions::default(), BitWriter::new(bytes));
        let blocks = [[lanes.splat_f32s(0.0); 8]; 6];
        let mut encoder = McuEncoder { lanes, layout, predictions, writer, blocks };
        let mut copy = [0; size_of::<McuCopy>()];
        for y in (0..rows).step_by(side) {
            for x in (0..layout.width).step_by(side) {
                encoder.encode(&window.mcu([x, y], side, &mut copy));
            }
        }
        encoder.writer.finish().to_vec()
    }
}

/// The state between two MCU of a strip.
struct McuEncoder<'a, L> {
    lanes: L,
    layout: &'a JpegLayout,
    predictions: DcPredictions,
    writer: BitWriter<'a>,
    /// Memory for the samples of an MCU.
    blocks: McuBlocks,
}

impl<L: Lanes> McuEncoder<'_, L> {
    #[inline(always)]
    fn encode(&mut self, pixels: &McuPixels<'_>) {
        let subsampling = self.layout.subsampling;
        let components = subsampling.components();
        self.writer.reserve(MAX_BLOCK_BYTES * components.len());
        if pixels.are_equal(subsampling.mcu_side()) {
            let samples = mcu::constant_samples(self.lanes, pixels, subsampling);
            for component in components {
                let factors = self.layout.factors.of(*component);
                let dc = quantization::quantize_constant(samples[*component as usize], factors);
                entropy::write_constant_block(dc, *component, &mut self.predictions, &mut self.writer);
            }
            return;
        }
        match subsampling {
            Subsampling::Full => mcu::sample_full(self.lanes, pixels, &mut self.blocks),
            Subsampling::Half => mcu::sample_half(self.lanes, pixels, &mut self.blocks),
        }
        for (component, samples) in components.iter().zip(&self.blocks) {
            let spectrum = dct::forward(self.lanes, *samples);
            let block = quantization::quantize(self.lanes, spectrum, self.layout.factors.of(*component));
            entropy::write_block(&block, *component, &mut self.predictions, &mut self.writer);
        }
    }
}

/// [`Strip::encode`] with the instructions of x86-64-v3.
#[cfg(target_arch = "x86_64")]
struct EncodeStrip<'a> {
    simd: pulp::x86::V3,
    strip: Strip<'a>,
}

#[cfg(target_arch = "x86_64")]
impl pulp::NullaryFnOnce for EncodeStrip<'_> {
    type Output = Vec<u8>;

    #[inline(always)]
    fn call(self) -> Vec<u8> {
        self.strip.encode(self.simd)
    }
}

/// Encodes RGBA8 pixels, top row first, on the calling thread.
///
/// # Errors
/// `Fault` when a side is 0 or above 65,535, or the picture has too few pixels.
pub(super) fn encode(width: u32, height: u32, rgba: &[u8], quality: u8) -> Result<Vec<u8>> {
    let layout = JpegLayout::new(width, height, quality)?;
    let mut buffers = JpegBuffers::default();
    let strips = (0..layout.strip_count()).map(|index| layout.encode_strip(rgba, index, &mut buffers));
    Ok(layout.assemble(&strips.collect::<Result<Vec<_>>>()?))
}

#[cfg(test)]
mod tests;
