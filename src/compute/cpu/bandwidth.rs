//! Memory read bandwidth of all cores: the upper limit of a deformer that reads every entry of U once.

use std::hint::black_box;
use std::time::Instant;

use pulp::NullaryFnOnce;
use rayon::prelude::*;

use super::simd::run_vectorized;

/// Reads a buffer of `bytes` bytes `runs` times with all rayon threads. Returns the highest bandwidth in GB/s (10^9
/// bytes per second). For a buffer that fits into the last-level cache, this is the bandwidth of the cache. To compare
/// the result with a deformer, choose the size of its U.
pub fn read_bandwidth(bytes: usize, runs: usize) -> f64 {
    // Write to the buffer before the reads: until a page is written, the system backs it by one shared page of zeros.
    let mut words = vec![0_u64; bytes.div_ceil(8).max(1)];
    words.par_chunks_mut(TASK_WORDS).enumerate().for_each(|(task, words)| words.fill(task as u64));
    let bytes = 8.0 * words.len() as f64;
    let measure = |_| {
        let start = Instant::now();
        let sum_of = |words| run_vectorized(SumWords(words));
        black_box(words.par_chunks(TASK_WORDS).map(sum_of).reduce(|| 0, u64::wrapping_add));
        bytes / start.elapsed().as_secs_f64() / 1e9
    };
    (0..runs.max(1)).map(measure).fold(0.0, f64::max)
}

/// Number of words of 8 bytes that one task reads: 1 MiB.
const TASK_WORDS: usize = 1 << 17;
/// Number of independent sums. With a single sum, each addition would wait for the one before it, which is slower than
/// memory.
const LANES: usize = 32;

/// Sums words. The sum forces a read of every word.
struct SumWords<'a>(&'a [u64]);

impl NullaryFnOnce for SumWords<'_> {
    type Output = u64;

    #[inline(always)]
    fn call(self) -> u64 {
        let mut sums = [0_u64; LANES];
        let mut blocks = self.0.chunks_exact(LANES);
        for block in blocks.by_ref() {
            (0..LANES).for_each(|lane| sums[lane] = sums[lane].wrapping_add(block[lane]));
        }
        sums.iter().chain(blocks.remainder()).fold(0, |sum, word| sum.wrapping_add(*word))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_word_is_read_and_the_bandwidth_is_positive() {
        let words: Vec<u64> = (0..1001).collect();
        assert_eq!(run_vectorized(SumWords(&words)), 1000 * 1001 / 2);
        let bandwidth = read_bandwidth(3 << 20, 2);
        assert!(bandwidth.is_finite() && bandwidth > 0.0, "expected a positive bandwidth, got {bandwidth}");
    }
}
