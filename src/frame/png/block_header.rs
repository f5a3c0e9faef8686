//! The header of a deflate block with its own Huffman code (RFC 1951, section 3.2.7).

use super::bit_writer::{BitWriter, Bits};
use super::huffman::HuffmanCode;
use super::symbols::SYMBOLS;

/// The code lengths of a block are written as run-length symbols (0 to 15: one length, 16 to 18: repetitions), which
/// have a Huffman code of their own. The lengths of that code come first, in this order of symbols.
const LENGTH_ORDER: [usize; 19] = [16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15];
/// Maximum length of the codes of run-length symbols.
const MAX_LENGTH_BITS: usize = 7;
/// Two distances have a code, of one bit each.
const DISTANCE_LENGTHS: [u8; 2] = [1, 1];
/// Repeats the previous length 3 to 6 times.
const REPEAT_PREVIOUS: usize = 16;
/// Repeats length 0, 3 to 10 times.
const REPEAT_ZERO: usize = 17;
/// Repeats length 0, 11 to 138 times.
const REPEAT_ZERO_LONG: usize = 18;

/// The header of a block with codes of its own.
pub(super) struct BlockHeader {
    /// The fields before the code lengths, in order.
    fields: Vec<Bits>,
    /// The code lengths: for each run-length symbol, its code followed by its extra bits.
    lengths: Vec<Bits>,
}

impl BlockHeader {
    pub(super) fn new(literal_lengths: &[u8; SYMBOLS], is_last: bool) -> Self {
        // The end of the block has a code, so at least 257 symbols remain.
        let symbol_count = literal_lengths.iter().rposition(|length| *length > 0).map_or(0, |last| last + 1);
        let all_lengths = [&literal_lengths[..symbol_count], &DISTANCE_LENGTHS[..]].concat();
        let symbols = run_length_encode(&all_lengths);
        let mut frequencies = [0; LENGTH_ORDER.len()];
        symbols.iter().for_each(|(symbol, _)| frequencies[*symbol] += 1);
        let code = HuffmanCode::of_frequencies(&frequencies, MAX_LENGTH_BITS);
        let ordered_lengths = LENGTH_ORDER.map(|symbol| code.lengths[symbol]);
        let length_count = ordered_lengths.iter().rposition(|length| *length > 0).map_or(4, |last| last.max(3) + 1);
        let field = |value: usize, count| Bits { value: value as u64, count };
        let mut fields = vec![
            field(usize::from(is_last), 1),
            // Block type 2: a block with codes of its own.
            field(2, 2),
            field(symbol_count - 257, 5),
            field(DISTANCE_LENGTHS.len() - 1, 5),
            field(length_count - 4, 4),
        ];
        fields.extend(ordered_lengths[..length_count].iter().map(|length| field(usize::from(*length), 3)));
        let lengths = symbols.iter().map(|(symbol, extra)| code.codes[*symbol].then(*extra)).collect();
        Self { fields, lengths }
    }

    pub(super) fn bit_count(&self) -> usize {
        self.fields.iter().chain(&self.lengths).map(|bits| bits.count as usize).sum()
    }

    pub(super) fn write(&self, writer: &mut BitWriter<'_>) {
        self.fields.iter().chain(&self.lengths).for_each(|bits| writer.write(*bits));
    }
}

/// The run-length symbols of a sequence of code lengths, with their extra bits.
fn run_length_encode(lengths: &[u8]) -> Vec<(usize, Bits)> {
    let mut symbols = Vec::with_capacity(lengths.len());
    let repeat = |symbol, times: usize, min: usize, count| (symbol, Bits { value: (times - min) as u64, count });
    for run in lengths.chunk_by(|a, b| a == b) {
        let single = (usize::from(run[0]), Bits::default());
        let mut rest = run.len();
        if run[0] != 0 {
            symbols.push(single);
            rest -= 1;
        }
        while rest >= 3 {
            let symbol = match (run[0], rest) {
                (0, 11..) => repeat(REPEAT_ZERO_LONG, rest.min(138), 11, 7),
                (0, _) => repeat(REPEAT_ZERO, rest, 3, 3),
                _ => repeat(REPEAT_PREVIOUS, rest.min(6), 3, 2),
            };
            symbols.push(symbol);
            rest -= match (run[0], rest) {
                (0, _) => rest.min(138),
                _ => rest.min(6),
            };
        }
        symbols.extend(std::iter::repeat_n(single, rest));
    }
    symbols
}
