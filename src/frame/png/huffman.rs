//! Length-limited Huffman codes.

use super::bit_writer::Bits;

/// A canonical Huffman code of `N` symbols (RFC 1951, section 3.2.2).
#[derive(Debug, Clone)]
pub(super) struct HuffmanCode<const N: usize> {
    /// Length of each symbol's code in bits; 0 for a symbol without a code.
    pub(super) lengths: [u8; N],
    /// The code of each symbol, in the order in which its bits are written.
    pub(super) codes: [Bits; N],
}

impl<const N: usize> HuffmanCode<N> {
    /// The code of symbols with these frequencies, with codes of at most `max_length` bits. The code is complete: at
    /// least two symbols have a code. The sum of the frequencies must be below 2^32, and N at most 2^`max_length`.
    pub(super) fn of_frequencies(frequencies: &[u32; N], max_length: usize) -> Self {
        let lengths = code_lengths(frequencies, max_length);
        Self { codes: canonical_codes(&lengths), lengths }
    }
}

/// Lengths of the codes, limited to `max_length` as by zlib and miniz: symbols with longer codes get that length, and
/// symbols with shorter codes are moved down until the code is a prefix code again.
fn code_lengths<const N: usize>(frequencies: &[u32; N], max_length: usize) -> [u8; N] {
    // The symbol is in the low bits, so equal frequencies have an order that depends only on the symbols.
    let mut used: Vec<u64> = (0..).zip(frequencies).filter(|(_, frequency)| **frequency > 0).map(pack).collect();
    for (symbol, _) in (0..).zip(frequencies).filter(|(_, frequency)| **frequency == 0) {
        if used.len() >= 2 {
            break;
        }
        used.push(pack((symbol, &0)));
    }
    used.sort_unstable();
    let mut counts = length_counts(&used, max_length);
    complete_code(&mut counts);
    let mut lengths = [0; N];
    // The rarest symbols have the longest codes.
    let mut symbols = used.iter();
    for (length, count) in counts.iter().enumerate().rev() {
        for packed in symbols.by_ref().take(*count) {
            lengths[(packed & SYMBOL_MASK) as usize] = length as u8;
        }
    }
    lengths
}

const SYMBOL_BITS: u32 = 16;
const SYMBOL_MASK: u64 = (1 << SYMBOL_BITS) - 1;

fn pack((symbol, frequency): (u64, &u32)) -> u64 {
    u64::from(*frequency) << SYMBOL_BITS | symbol
}

/// Number of Huffman codes of each length, for at least two symbols in ascending order of frequency. Longer codes count
/// as `max_length`.
fn length_counts(used: &[u64], max_length: usize) -> Vec<usize> {
    // The leaves come first, then the inner nodes in the order of their creation, which is ascending too. So the two
    // rarest nodes are always at the front of one of two queues.
    let leaf_count = used.len();
    let node_count = 2 * leaf_count - 1;
    let mut weights: Vec<u64> = used.iter().map(|packed| packed >> SYMBOL_BITS).collect();
    let mut parents = vec![0; node_count];
    let (mut next_leaf, mut next_inner) = (0, leaf_count);
    for node in leaf_count..node_count {
        let mut weight = 0;
        for _ in 0..2 {
            let takes_leaf =
                next_leaf < leaf_count && (next_inner >= node || weights[next_leaf] <= weights[next_inner]);
            let queue = if takes_leaf { &mut next_leaf } else { &mut next_inner };
            weight += weights[*queue];
            parents[*queue] = node;
            *queue += 1;
        }
        weights.push(weight);
    }
    let mut depths = vec![0; node_count];
    let mut counts = vec![0; max_length + 1];
    for node in (0..node_count - 1).rev() {
        depths[node] = depths[parents[node]] + 1;
        if node < leaf_count {
            counts[max_length.min(depths[node])] += 1;
        }
    }
    counts
}

/// Lengthens codes until the sum of 2^-length is 1 (Kraft's equality).
fn complete_code(counts: &mut [usize]) {
    let max_length = counts.len() - 1;
    let used: usize = counts.iter().enumerate().map(|(length, count)| count << (max_length - length)).sum();
    for _ in 1_usize << max_length..used {
        // One code of the longest length and a shorter code are replaced by two codes that are one bit longer than the
        // shorter one.
        let Some(shorter) = (1..max_length).rev().find(|length| counts[*length] > 0) else { return };
        counts[max_length] -= 1;
        counts[shorter] -= 1;
        counts[shorter + 1] += 2;
    }
}

/// Numbers the codes of each length in the order of their symbols.
fn canonical_codes<const N: usize>(lengths: &[u8; N]) -> [Bits; N] {
    let mut next_codes = [0_u64; 17];
    for length in lengths.iter().filter(|length| **length > 0) {
        next_codes[usize::from(*length) + 1] += 1;
    }
    // Turns the number of codes of length - 1 into the first code of that length.
    for length in 1..next_codes.len() {
        next_codes[length] = (next_codes[length - 1] + next_codes[length]) << 1;
    }
    let mut codes = [Bits::default(); N];
    for (code, length) in codes.iter_mut().zip(lengths).filter(|(_, length)| **length > 0) {
        let next_code = &mut next_codes[usize::from(*length)];
        // Deflate writes the highest bit of a code first.
        *code = Bits { value: next_code.reverse_bits() >> (64 - length), count: u32::from(*length) };
        *next_code += 1;
    }
    codes
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frequencies<const N: usize>(frequency: impl Fn(u32) -> u32) -> [u32; N] {
        std::array::from_fn(|symbol| frequency(symbol as u32))
    }

    fn kraft_sum<const N: usize>(lengths: &[u8; N]) -> f64 {
        lengths.iter().filter(|length| **length > 0).map(|length| 0.5_f64.powi(i32::from(*length))).sum()
    }

    #[test]
    fn codes_of_powers_of_two_have_their_logarithms_as_lengths() {
        let code = HuffmanCode::of_frequencies(&[1, 8, 1, 4, 0, 2], 15);
        assert_eq!(code.lengths, [4, 1, 4, 2, 0, 3]);
        // The highest bit comes first: 1110, 0, 1111, 10 and 110 in the order of reading.
        assert_eq!(code.codes.map(|bits| bits.value), [0b0111, 0, 0b1111, 0b01, 0, 0b011]);
    }

    #[test]
    fn lengths_are_limited_and_the_code_is_complete() {
        let mut fibonacci = [1_u32; 40];
        (2..40).for_each(|index| fibonacci[index] = fibonacci[index - 1] + fibonacci[index - 2]);
        for max_length in [6, 7, 12, 15] {
            let lengths = code_lengths(&fibonacci, max_length);
            assert_eq!(usize::from(lengths[0]), max_length, "expected a code that has to be limited");
            assert_eq!(kraft_sum(&lengths), 1.0, "{max_length}: {lengths:?}");
            assert!(lengths.is_sorted_by(|a, b| a >= b), "{lengths:?}");
        }
        let mut random = fastrand::Rng::with_seed(1);
        for _ in 0..200 {
            let shift = random.u32(0..32);
            let sparse: [u32; 286] = std::array::from_fn(|_| (random.u32(..) >> shift) / 512 * random.u32(0..2));
            let lengths = code_lengths(&sparse, 12);
            assert_eq!(kraft_sum(&lengths), 1.0);
            let used = sparse.iter().filter(|frequency| **frequency > 0).count().max(2);
            assert_eq!(lengths.iter().filter(|length| **length > 0).count(), used);
        }
    }

    #[test]
    fn at_least_two_symbols_have_a_code() {
        for used in 0..3 {
            let lengths = code_lengths(&frequencies::<19>(|symbol| u32::from(symbol == 5 && used == 1)), 7);
            assert_eq!(lengths.iter().map(|length| usize::from(*length)).sum::<usize>(), 2);
        }
    }
}
