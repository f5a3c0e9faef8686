//! Markers and the segments before the scan (ITU-T T.81, Annex B, and JFIF 1.02).

use super::codes::{CHROMA_AC, CHROMA_DC, CodeTable, LUMA_AC, LUMA_DC};
use super::mcu::Subsampling;
use super::quantization::QuantizationTables;
use super::zigzag::ZIGZAG;

const START_OF_IMAGE: u8 = 0xd8;
const APP0: u8 = 0xe0;
const QUANTIZATION_TABLES: u8 = 0xdb;
const BASELINE_FRAME: u8 = 0xc0;
const HUFFMAN_TABLES: u8 = 0xc4;
const RESTART_INTERVAL: u8 = 0xdd;
const START_OF_SCAN: u8 = 0xda;
/// The first of eight restart markers, which alternate.
const FIRST_RESTART: u8 = 0xd0;

pub(super) const END_OF_IMAGE: [u8; 2] = [0xff, 0xd9];

/// The marker after the restart interval `index`.
pub(super) const fn restart_marker(index: usize) -> [u8; 2] {
    [0xff, FIRST_RESTART + (index % 8) as u8]
}

/// The file up to the entropy-coded segments. `size` and `restart_interval` (in MCU) fit in 16 bits.
pub(super) fn head(
    size: [usize; 2],
    subsampling: Subsampling,
    tables: &QuantizationTables,
    restart_interval: Option<usize>,
) -> Vec<u8> {
    let mut file = vec![0xff, START_OF_IMAGE];
    // Version 1.02, square pixels, no thumbnail.
    push_segment(&mut file, APP0, b"JFIF\0\x01\x02\0\0\x01\0\x01\0\0");
    for (table, steps) in [(0, &tables.luma), (1, &tables.chroma)] {
        let zigzag = ZIGZAG.iter().map(|index| steps[usize::from(*index)]);
        push_segment(&mut file, QUANTIZATION_TABLES, &std::iter::once(table).chain(zigzag).collect::<Vec<u8>>());
    }
    let [[width_high, width_low], [height_high, height_low]] = size.map(|side| (side as u16).to_be_bytes());
    let luma_factors = match subsampling {
        Subsampling::Full => 0x11,
        Subsampling::Half => 0x22,
    };
    // 8 bits per sample. Each component: its id, sampling factors and quantization table.
    let mut frame = vec![8, height_high, height_low, width_high, width_low, 3];
    frame.extend_from_slice(&[1, luma_factors, 0, 2, 0x11, 1, 3, 0x11, 1]);
    push_segment(&mut file, BASELINE_FRAME, &frame);
    // The class of AC codes is 1, in the high bits.
    for (table, codes) in [(0x00, LUMA_DC), (0x10, LUMA_AC), (0x01, CHROMA_DC), (0x11, CHROMA_AC)] {
        let CodeTable { counts, symbols } = codes;
        push_segment(&mut file, HUFFMAN_TABLES, &[&[table], &counts[..], symbols].concat());
    }
    if let Some(interval) = restart_interval {
        push_segment(&mut file, RESTART_INTERVAL, &(interval as u16).to_be_bytes());
    }
    // Each component: its id and Huffman tables. Then all coefficients of a sequential scan.
    push_segment(&mut file, START_OF_SCAN, &[3, 1, 0x00, 2, 0x11, 3, 0x11, 0, 63, 0]);
    file
}

/// Appends a marker, the length of its content and the content.
fn push_segment(file: &mut Vec<u8>, marker: u8, content: &[u8]) {
    file.extend_from_slice(&[0xff, marker]);
    file.extend_from_slice(&(content.len() as u16 + 2).to_be_bytes());
    file.extend_from_slice(content);
}
