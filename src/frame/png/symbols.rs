//! The symbols of a deflate block: literals, and matches that repeat a zero.

use super::bit_writer::Bits;
use super::segments::Segment;

/// Number of symbols for literals, the end of the block, and lengths of matches.
pub(super) const SYMBOLS: usize = 286;
/// The symbol of the end of a block; the symbols after it are lengths of matches.
pub(super) const END_OF_BLOCK: usize = 256;
/// Number of symbols that are not literals.
pub(super) const OTHER_SYMBOLS: usize = SYMBOLS - END_OF_BLOCK;

const MAX_MATCH: usize = 258;
const MIN_MATCH: usize = 3;

/// Receives the symbols of a block in order.
pub(super) trait SymbolSink {
    /// The first `count` of four literals.
    fn add_literals(&mut self, literals: [u8; 4], count: usize);
    /// A match of `length` bytes at distance 1, which repeats the last literal.
    fn add_match(&mut self, length: usize);
}

/// Passes the symbols of segments to `sink`. Takes and returns the sink by value, so that it stays in registers.
/// Literals come in groups of four; the last group of a segment may be partial. A loop over its one to three literals
/// would end in a branch that the CPU cannot predict.
#[inline(always)]
pub(super) fn for_each_symbol<S: SymbolSink>(bytes: &[u8], segments: &[Segment], mut sink: S) -> S {
    let mut rest = bytes;
    for segment in segments {
        let (literals, after) = rest.split_at_checked(segment.literals).unwrap_or_default();
        let (groups, last) = literals.as_chunks::<4>();
        for group in groups {
            sink.add_literals(*group, 4);
        }
        let mut last_group = [0; 4];
        match rest.get(literals.len() - last.len()..).and_then(|rest| rest.first_chunk()) {
            Some(group) => last_group = *group,
            None => last_group[..last.len()].copy_from_slice(last),
        }
        sink.add_literals(last_group, last.len());
        if segment.zeros > 0 {
            add_zeros(segment.zeros, &mut sink);
        }
        rest = after.get(segment.zeros..).unwrap_or_default();
    }
    sink
}

#[inline(always)]
fn add_zeros(zeros: usize, sink: &mut impl SymbolSink) {
    sink.add_literals([0; 4], 1);
    let mut rest = zeros.wrapping_sub(1);
    while rest >= MIN_MATCH {
        let length = rest.min(MAX_MATCH);
        sink.add_match(length);
        rest = rest.wrapping_sub(length);
    }
    sink.add_literals([0; 4], rest);
}

/// The symbol of a match, as an index from [`END_OF_BLOCK`] on, and its extra bits (RFC 1951, section 3.2.5).
#[inline(always)]
pub(super) const fn length_symbol(length: usize) -> (usize, Bits) {
    if length == MAX_MATCH {
        return (OTHER_SYMBOLS - 1, Bits { value: 0, count: 0 });
    }
    let offset = length - MIN_MATCH;
    // From offset 8 on, groups of four symbols have the same number of extra bits.
    let extra_bits = if offset < 8 { 0 } else { offset.ilog2() - 2 };
    let extra = Bits { value: (offset & ((1 << extra_bits) - 1)) as u64, count: extra_bits };
    (1 + 4 * extra_bits as usize + (offset >> extra_bits), extra)
}

/// Frequencies of symbols.
pub(super) struct Histogram {
    /// Four histograms, because a counter that is incremented twice in a row has to wait for its last store.
    literals: [[u32; 256]; 4],
    others: [u32; OTHER_SYMBOLS],
    /// Number of matches, and the sum of their extra bits.
    matches: usize,
    extra_bits: usize,
}

impl Histogram {
    /// Contains only one end of the block.
    #[inline(always)]
    pub(super) fn new() -> Self {
        let mut others = [0; OTHER_SYMBOLS];
        others[0] = 1;
        Self { literals: [[0; 256]; 4], others, matches: 0, extra_bits: 0 }
    }

    pub(super) fn frequencies(&self) -> [u32; SYMBOLS] {
        std::array::from_fn(|symbol| match symbol.checked_sub(END_OF_BLOCK) {
            None => self.literals.iter().map(|counts| counts[symbol]).sum(),
            Some(other) => self.others[other],
        })
    }

    /// Number of bits of the block's content, with codes of these lengths and `distance_bits` for each distance.
    pub(super) fn bit_count(&self, lengths: &[u8; SYMBOLS], distance_bits: u32) -> usize {
        let frequencies = self.frequencies();
        let symbol_bits: usize =
            frequencies.iter().zip(lengths).map(|(count, length)| *count as usize * usize::from(*length)).sum();
        symbol_bits + self.extra_bits + self.matches * distance_bits as usize
    }
}

impl SymbolSink for Histogram {
    #[inline(always)]
    fn add_literals(&mut self, literals: [u8; 4], count: usize) {
        for (index, (counts, literal)) in self.literals.iter_mut().zip(literals).enumerate() {
            let frequency = &mut counts[usize::from(literal)];
            *frequency = frequency.wrapping_add(u32::from(index < count));
        }
    }

    #[inline(always)]
    fn add_match(&mut self, length: usize) {
        let (symbol, extra) = length_symbol(length);
        self.others[symbol] += 1;
        self.matches += 1;
        self.extra_bits += extra.count as usize;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn length_symbols_are_those_of_the_standard() {
        // First lengths and extra bits of the symbols 257 to 285, from the table of RFC 1951.
        let firsts = [
            3, 4, 5, 6, 7, 8, 9, 10, 11, 13, 15, 17, 19, 23, 27, 31, 35, 43, 51, 59, 67, 83, 99, 115, 131, 163, 195,
            227, 258,
        ];
        let extra_bits = [0, 0, 0, 0, 0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3, 4, 4, 4, 4, 5, 5, 5, 5, 0];
        for length in MIN_MATCH..=MAX_MATCH {
            let index = firsts.iter().rposition(|first| *first <= length).expect("expected a symbol");
            let (symbol, extra) = length_symbol(length);
            let expected = (257 + index, length - firsts[index], extra_bits[index]);
            assert_eq!((END_OF_BLOCK + symbol, extra.value as usize, extra.count), expected, "{length}");
        }
    }
}
