//! Read bandwidth of the memory by all cores: the upper limit of a deformer that reads every entry of U once.

use std::hint::black_box;
use std::time::Instant;

use pulp::NullaryFnOnce;
use rayon::prelude::*;

use super::simd::run_vectorized;

/// The best of `runs` reads of `bytes` bytes by all rayon threads, in GB/s (10^9 bytes). A buffer that fits the
/// last-level cache measures the cache, so compare with a U of the same size.
pub fn read_bandwidth(bytes: usize, runs: usize) -> f64 {
    // Written once, because untouched pages all map to one page of zeros.
    let mut words = vec![0_u64; bytes.div_ceil(8).max(1)];
    words.par_chunks_mut(PART).enumerate().for_each(|(part, words)| words.fill(part as u64));
    let bytes = 8.0 * words.len() as f64;
    let rate = |_| {
        let begin = Instant::now();
        black_box(words.par_chunks(PART).map(|part| run_vectorized(Read(part))).reduce(|| 0, u64::wrapping_add));
        bytes / begin.elapsed().as_secs_f64() / 1e9
    };
    (0..runs.max(1)).map(rate).fold(0.0, f64::max)
}

/// Words that one task reads: 1 MiB.
const PART: usize = 1 << 17;
/// Independent sums, so that loads do not wait for additions.
const LANES: usize = 32;

struct Read<'a>(&'a [u64]);

impl NullaryFnOnce for Read<'_> {
    type Output = u64;

    #[inline(always)]
    fn call(self) -> u64 {
        let mut sums = [0_u64; LANES];
        let mut lines = self.0.chunks_exact(LANES);
        for line in lines.by_ref() {
            (0..LANES).for_each(|lane| sums[lane] = sums[lane].wrapping_add(line[lane]));
        }
        sums.iter().chain(lines.remainder()).fold(0, |sum, word| sum.wrapping_add(*word))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_word_is_read_and_a_rate_comes_out() {
        let words: Vec<u64> = (0..1001).collect();
        assert_eq!(run_vectorized(Read(&words)), 1000 * 1001 / 2);
        let rate = read_bandwidth(3 << 20, 2);
        assert!(rate.is_finite() && rate > 0.0);
    }
}
