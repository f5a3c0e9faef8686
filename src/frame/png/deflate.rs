//! Deflate (RFC 1951) of one strip: one block with its own Huffman code, or stored blocks where that is smaller.

use pulp::NullaryFnOnce;

use super::bit_writer::{BitWriter, Bits, SLACK_BYTES};
use super::block_header::BlockHeader;
use super::dispatch::run_vectorized;
use super::huffman::HuffmanCode;
use super::segments::{self, Segment};
use super::symbols::{END_OF_BLOCK, Histogram, OTHER_SYMBOLS, SYMBOLS, SymbolSink, for_each_symbol, length_symbol};

/// Codes of literals have at most this length, so that four of them fit in one store.
const MAX_CODE_BITS: usize = 12;
/// The code of distance 1, the first of two distances whose codes have one bit.
const MATCH_DISTANCE: Bits = Bits { value: 0, count: 1 };
/// Largest content of a stored block.
const MAX_STORED_BYTES: usize = 65_535;
/// Type and length fields of a stored block.
const STORED_HEADER_BYTES: usize = 5;
/// The length fields of an empty stored block, which ends every strip but the last one, so that it ends at a byte
/// boundary. Before them come the block's type, three bits that are 0, and zeros up to the next byte.
const EMPTY_STORED_BLOCK: [u8; 4] = [0, 0, 0xff, 0xff];

/// Appends the deflate blocks of a strip to `output`. They end on a byte boundary and do not refer to other strips.
/// They have at most 5 bytes more than `bytes` per started 65,535 bytes. The content of `segments` is replaced.
pub(super) fn compress(bytes: &[u8], is_last: bool, segments: &mut Vec<Segment>, output: &mut Vec<u8>) {
    let histogram = run_vectorized(SplitAndCount { bytes, segments });
    let code = HuffmanCode::of_frequencies(&histogram.frequencies(), MAX_CODE_BITS);
    let header = BlockHeader::new(&code.lengths, is_last);
    let (end_bits, end_bytes) = if is_last { (0, 0) } else { (3, EMPTY_STORED_BLOCK.len()) };
    let bit_count = header.bit_count() + histogram.bit_count(&code.lengths, MATCH_DISTANCE.count) + end_bits;
    let block_bytes = bit_count.div_ceil(8);
    if block_bytes + end_bytes >= bytes.len() + STORED_HEADER_BYTES * bytes.len().div_ceil(MAX_STORED_BYTES) {
        return store(bytes, is_last, output);
    }
    let begin = output.len();
    output.resize(begin + block_bytes + SLACK_BYTES, 0);
    let mut writer = BitWriter::new(&mut output[begin..]);
    header.write(&mut writer);
    let mut writer = run_vectorized(WriteSymbols { codes: &SymbolCodes::new(&code), bytes, segments, writer });
    writer.write(code.codes[END_OF_BLOCK]);
    writer.write(Bits { value: 0, count: end_bits as u32 });
    writer.align_to_byte();
    output.truncate(begin + block_bytes);
    output.extend_from_slice(&EMPTY_STORED_BLOCK[..end_bytes]);
}

/// Appends stored blocks.
fn store(bytes: &[u8], is_last: bool, output: &mut Vec<u8>) {
    let mut blocks = bytes.chunks(MAX_STORED_BYTES).peekable();
    while let Some(block) = blocks.next() {
        let length = block.len() as u16;
        output.push(u8::from(is_last && blocks.peek().is_none()));
        output.extend_from_slice(&length.to_le_bytes());
        output.extend_from_slice(&(!length).to_le_bytes());
        output.extend_from_slice(block);
    }
}

/// Splits bytes into segments and counts their symbols.
struct SplitAndCount<'a> {
    bytes: &'a [u8],
    segments: &'a mut Vec<Segment>,
}

impl NullaryFnOnce for SplitAndCount<'_> {
    type Output = Histogram;

    #[inline(always)]
    fn call(self) -> Histogram {
        segments::split(self.bytes, self.segments);
        for_each_symbol(self.bytes, self.segments, Histogram::new())
    }
}

/// Writes the symbols of segments.
struct WriteSymbols<'a, 'b> {
    codes: &'a SymbolCodes,
    bytes: &'a [u8],
    segments: &'a [Segment],
    writer: BitWriter<'b>,
}

impl<'b> NullaryFnOnce for WriteSymbols<'_, 'b> {
    type Output = BitWriter<'b>;

    #[inline(always)]
    fn call(self) -> BitWriter<'b> {
        let Self { codes, bytes, segments, writer } = self;
        for_each_symbol(bytes, segments, SymbolWriter { codes, writer }).writer
    }
}

/// The codes of a block in compact form, to fit in the first-level cache.
struct SymbolCodes {
    /// Per literal: the value of the code in the low half, its number of bits in the high half.
    literals: [u32; 256],
    others: [Bits; OTHER_SYMBOLS],
}

impl SymbolCodes {
    fn new(code: &HuffmanCode<SYMBOLS>) -> Self {
        Self {
            literals: std::array::from_fn(|byte| code.codes[byte].value as u32 | code.codes[byte].count << 16),
            others: std::array::from_fn(|index| code.codes[END_OF_BLOCK + index]),
        }
    }
}

struct SymbolWriter<'a, 'b> {
    codes: &'a SymbolCodes,
    writer: BitWriter<'b>,
}

impl SymbolSink for SymbolWriter<'_, '_> {
    #[inline(always)]
    fn add_literals(&mut self, literals: [u8; 4], count: usize) {
        let mut bits = [Bits::default(); 4];
        for (index, (bits, literal)) in bits.iter_mut().zip(literals).enumerate() {
            let code = if index < count { self.codes.literals[usize::from(literal)] } else { 0 };
            *bits = Bits { value: u64::from(code & 0xffff), count: code >> 16 };
        }
        let [a, b, c, d] = bits;
        self.writer.write(a.then(b).then(c.then(d)));
    }

    #[inline(always)]
    fn add_match(&mut self, length: usize) {
        let (symbol, extra) = length_symbol(length);
        self.writer.write(self.codes.others[symbol].then(extra).then(MATCH_DISTANCE));
    }
}
