//! Huffman coding of quantized blocks: the difference of the DC coefficient, then runs of zeros that end in a nonzero
//! AC coefficient. A bit mask of the nonzero coefficients gives the runs without a loop over the zeros.

use super::bit_writer::BitWriter;
use super::codes::{CHROMA_CODES, CodeWord, ComponentCodes, LUMA_CODES};
use super::lanes::{Block, POSITIONS};
use super::mcu::Component;

/// Most bytes of a block: 22 bits of the DC difference and 26 of each AC coefficient, with a zero after each byte.
pub(super) const MAX_BLOCK_BYTES: usize = 2 * (22_usize + 63 * 26).div_ceil(8);
/// Symbols of AC codes.
const END_OF_BLOCK: usize = 0;
const SIXTEEN_ZEROS: usize = 0xf0;

/// The last DC coefficient of each component.
#[derive(Debug, Default)]
pub(super) struct DcPredictions([i32; 3]);

/// Writes a block of zeros, except for the DC coefficient.
#[inline(always)]
pub(super) fn write_constant_block(
    dc: i16,
    component: Component,
    predictions: &mut DcPredictions,
    writer: &mut BitWriter<'_>,
) {
    let codes = codes_of(component);
    write_dc(dc, codes, &mut predictions.0[component as usize], writer);
    write(codes.ac[END_OF_BLOCK], 0, writer);
}

/// Writes a block.
#[inline(always)]
pub(super) fn write_block(
    block: &Block,
    component: Component,
    predictions: &mut DcPredictions,
    writer: &mut BitWriter<'_>,
) {
    let codes = codes_of(component);
    write_dc(block.values[0], codes, &mut predictions.0[component as usize], writer);
    // Without the bit of the DC coefficient.
    let mut nonzeros = block.nonzeros & !1;
    let mut previous = 0;
    while nonzeros != 0 {
        let index = nonzeros.trailing_zeros();
        nonzeros &= nonzeros.wrapping_sub(1);
        let mut run = index.wrapping_sub(previous).wrapping_sub(1);
        previous = index;
        while run >= 16 {
            write(codes.ac[SIXTEEN_ZEROS], 0, writer);
            run = run.wrapping_sub(16);
        }
        let position = POSITIONS[index as usize & 63];
        let (value, size) = value_bits(i32::from(block.values[usize::from(position) & 63]));
        write(codes.ac[(run << 4 | size) as usize & 255], value, writer);
    }
    if previous < 63 {
        write(codes.ac[END_OF_BLOCK], 0, writer);
    }
}

#[inline(always)]
const fn codes_of(component: Component) -> &'static ComponentCodes {
    match component {
        Component::Luma => &LUMA_CODES,
        Component::Cb | Component::Cr => &CHROMA_CODES,
    }
}

/// Writes the difference of a DC coefficient to the last one, and replaces the last one.
#[inline(always)]
fn write_dc(dc: i16, codes: &ComponentCodes, prediction: &mut i32, writer: &mut BitWriter<'_>) {
    let dc = i32::from(dc);
    let (difference, size) = value_bits(dc.wrapping_sub(*prediction));
    *prediction = dc;
    write(codes.dc[size as usize & 15], difference, writer);
}

/// The bits of a value and their number: those of a negative value are the complement of its absolute value.
#[inline(always)]
const fn value_bits(value: i32) -> (u32, u32) {
    let sign = value >> 31;
    let size = i32::BITS.wrapping_sub(value.unsigned_abs().leading_zeros());
    (value.wrapping_add(sign) as u32 & 1_u32.wrapping_shl(size).wrapping_sub(1), size)
}

#[inline(always)]
fn write(word: CodeWord, value: u32, writer: &mut BitWriter<'_>) {
    writer.write(word.bits | value, word.count);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_have_the_bits_of_the_format() {
        let expected = [(0, 0, 0), (1, 1, 1), (-1, 0, 1), (2, 2, 2), (-2, 1, 2), (-3, 0, 2), (-1023, 0, 10)];
        for (value, bits, size) in expected {
            assert_eq!(value_bits(value), (bits, size), "{value}");
        }
        assert_eq!(value_bits(2047), (2047, 11));
    }
}
