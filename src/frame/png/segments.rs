//! Splits filtered pixels into literals and runs of zeros. Filtered flat areas are zeros, and other matches are too
//! rare in rendered frames to pay for the search.
//!
//! Runs do not cross the border of a tile, so that the tiles of a strip can be split independently of each other.

/// Literals, followed by a run of zeros.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Segment {
    pub(super) literals: usize,
    /// 0 only in the last segment of a tile.
    pub(super) zeros: usize,
}

/// Number of bytes that are split independently of the others: what a block of the kernel processes in shared memory.
pub(super) const TILE_BYTES: usize = 8192;

/// Number of words whose zeros are found at once.
const BLOCK_WORDS: usize = 64;

/// Splits `bytes` into segments, which replace the content of `segments`. A run is a maximal sequence of zeros within a
/// tile that contains an aligned word of eight zeros. So which zeros of a word are in a run depends only on this word
/// and its two neighbors, and a parallel implementation finds the same runs.
#[inline(always)]
pub(super) fn split(bytes: &[u8], segments: &mut Vec<Segment>) {
    segments.clear();
    for tile in bytes.chunks(TILE_BYTES) {
        split_tile(tile, segments);
    }
}

/// Appends the segments of a tile.
#[inline(always)]
fn split_tile(bytes: &[u8], segments: &mut Vec<Segment>) {
    let mut splitter = Splitter { bytes, literals_begin: 0, zeros_begin: None };
    let (words, _) = bytes.as_chunks::<8>();
    let mut is_previous_zero = 0;
    for (block, words) in words.chunks(BLOCK_WORDS).enumerate() {
        let zeros = zero_words(words);
        // One bit for each zero word after a nonzero word, and for each nonzero word after a zero word.
        let mut changes = zeros ^ (zeros << 1 | is_previous_zero);
        if words.len() < BLOCK_WORDS {
            changes &= (1 << words.len()) - 1;
        }
        is_previous_zero = zeros >> (BLOCK_WORDS - 1);
        while changes != 0 {
            splitter.change(BLOCK_WORDS * block + changes.trailing_zeros() as usize, segments);
            changes &= changes - 1;
        }
    }
    splitter.finish(segments);
}

/// One bit for each of at most 64 words: whether it is zero.
#[inline(always)]
fn zero_words(words: &[[u8; 8]]) -> u64 {
    // Eight bits at a time, in a loop of constant length, which compiles to vector compares.
    let (groups, rest) = words.as_chunks::<8>();
    let mut bits = 0;
    for (index, word) in rest.iter().enumerate() {
        bits |= u64::from(u64::from_le_bytes(*word) == 0) << (words.len() - rest.len() + index);
    }
    for (group_index, group) in groups.iter().enumerate() {
        let mut group_bits = 0_u64;
        for (index, word) in group.iter().enumerate() {
            group_bits |= u64::from(u64::from_le_bytes(*word) == 0) << index;
        }
        bits |= group_bits << (8 * group_index);
    }
    bits
}

/// The state between two segments.
struct Splitter<'a> {
    bytes: &'a [u8],
    literals_begin: usize,
    /// The first byte of the current run, if there is one.
    zeros_begin: Option<usize>,
}

impl Splitter<'_> {
    /// Begins a run with the zeros before this zero word, or ends the current run in this nonzero word.
    #[inline(always)]
    fn change(&mut self, word: usize, segments: &mut Vec<Segment>) {
        let word_at =
            |index: usize| self.bytes.as_chunks::<8>().0.get(index).map_or(0, |word| u64::from_le_bytes(*word));
        match self.zeros_begin.take() {
            None => {
                let zeros_before = if word == 0 { 0 } else { word_at(word - 1).leading_zeros() / 8 };
                self.zeros_begin = Some(8 * word - zeros_before as usize);
            }
            Some(begin) => self.end_run(begin, 8 * word + (word_at(word).trailing_zeros() / 8) as usize, segments),
        }
    }

    #[inline(always)]
    fn end_run(&mut self, begin: usize, end: usize, segments: &mut Vec<Segment>) {
        segments.push(Segment { literals: begin - self.literals_begin, zeros: end - begin });
        self.literals_begin = end;
    }

    fn finish(mut self, segments: &mut Vec<Segment>) {
        if let Some(begin) = self.zeros_begin {
            let (words, tail) = self.bytes.as_chunks::<8>();
            self.end_run(begin, 8 * words.len() + tail.iter().take_while(|byte| **byte == 0).count(), segments);
        }
        if self.literals_begin < self.bytes.len() {
            segments.push(Segment { literals: self.bytes.len() - self.literals_begin, zeros: 0 });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The segments of a tile by their definition, byte by byte.
    fn split_by_bytes(bytes: &[u8]) -> Vec<Segment> {
        let (mut segments, mut literals, mut begin) = (Vec::new(), 0, 0);
        for run in bytes.chunk_by(|a, b| (*a == 0) == (*b == 0)) {
            let end = begin + run.len();
            if run[0] == 0 && (begin..end).any(|index| index % 8 == 0 && index + 8 <= end) {
                segments.push(Segment { literals, zeros: run.len() });
                literals = 0;
            } else {
                literals += run.len();
            }
            begin = end;
        }
        segments.extend((literals > 0).then_some(Segment { literals, zeros: 0 }));
        segments
    }

    #[test]
    fn segments_are_maximal_runs_with_an_aligned_word() {
        let mut random = fastrand::Rng::with_seed(2);
        let mut segments = vec![Segment { literals: 1, zeros: 1 }];
        for length in (0..200).chain([1000, 5000, 8191, 8192, 8193, 8200, 30_000]) {
            for zeros_in_16 in [0, 8, 14, 15, 16] {
                let repeats = random.usize(1..=20);
                let mut byte = || if random.u8(0..16) < zeros_in_16 { 0 } else { random.u8(..) };
                let bytes: Vec<u8> =
                    (0..length).flat_map(|_| std::iter::repeat_n(byte(), repeats)).take(length).collect();
                split(&bytes, &mut segments);
                let expected: Vec<Segment> = bytes.chunks(8192).flat_map(split_by_bytes).collect();
                assert_eq!(segments, expected, "{bytes:?}");
            }
        }
    }
}
