//! Peak read bandwidth of the memory, by the best of several kernels on all cores.

use std::hint::black_box;
use std::time::Instant;

use rayon::prelude::*;

use modalcast_compute::cpu::read_bandwidth;

/// Bytes of the buffer. 512 MiB exceed the caches of a socket.
const READ_BYTES: usize = if cfg!(test) { 1 << 22 } else { 1 << 29 };
/// Number of reads of the buffer by each kernel. The fastest one counts.
const REPETITIONS: usize = 5;
/// Numbers of streams that a task of [`sum_streams`] reads at once. A deformer reads one stream per mode, which keeps more
/// cache lines in flight than a single stream.
const STREAMS: [usize; 4] = [1, 4, 8, 16];
/// Numbers of tasks per thread. One task per thread reads one contiguous part; more tasks balance the load.
const TASKS_PER_THREAD: [usize; 3] = [1, 4, 32];

/// The highest read bandwidth in GB/s (10^9 bytes per second) of all kernels: `read_bandwidth`, and sums of every number
/// of [`STREAMS`] and of [`TASKS_PER_THREAD`].
pub(crate) fn best_read_gbs() -> f64 {
    let words: Vec<u64> = (0..READ_BYTES as u64 / 8).into_par_iter().collect();
    let threads = rayon::current_num_threads();
    let kernels = STREAMS.into_iter().flat_map(|streams| TASKS_PER_THREAD.map(|tasks| (streams, tasks * threads)));
    let measured = kernels.map(|(streams, tasks)| measure_gbs(&words, streams, tasks)).fold(0.0, f64::max);
    measured.max(read_bandwidth(READ_BYTES, REPETITIONS))
}

/// The highest bandwidth of [`REPETITIONS`] reads of all words by `tasks` tasks, GB/s.
fn measure_gbs(words: &[u64], streams: usize, tasks: usize) -> f64 {
    let measure = |_| {
        let start = Instant::now();
        black_box(sum_in_tasks(words, streams, tasks));
        size_of_val(words) as f64 / start.elapsed().as_secs_f64() / 1e9
    };
    (0..REPETITIONS).map(measure).fold(0.0, f64::max)
}

fn sum_in_tasks(words: &[u64], streams: usize, tasks: usize) -> u64 {
    let task_length = words.len().div_ceil(tasks).max(1);
    words.par_chunks(task_length).map(|words| sum_streams(words, streams)).reduce(|| 0, u64::wrapping_add)
}

/// Words that a stream reads before the next stream continues: two cache lines of 64 bytes.
const BLOCK_WORDS: usize = 16;

/// Sums words by `streams` streams, which start at equal distances and take turns. The sum forces a read of every word.
fn sum_streams(words: &[u64], streams: usize) -> u64 {
    let stream_length = words.len() / streams / BLOCK_WORDS * BLOCK_WORDS;
    let (streamed, rest) = words.split_at(stream_length * streams);
    // Independent sums, so that no addition waits for the one before it.
    let mut sums = [0_u64; BLOCK_WORDS];
    let mut add = |block: &[u64]| {
        sums.iter_mut().zip(block).for_each(|(sum, word)| *sum = sum.wrapping_add(*word));
    };
    for offset in (0..stream_length).step_by(BLOCK_WORDS) {
        for stream in 0..streams {
            add(&streamed[stream * stream_length + offset..][..BLOCK_WORDS]);
        }
    }
    rest.chunks(BLOCK_WORDS).for_each(add);
    sums.iter().fold(0, |total, sum| total.wrapping_add(*sum))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_kernel_reads_every_word_once() {
        let words: Vec<u64> = (1..=10_007).collect();
        for streams in STREAMS {
            for tasks in [1, 3, 64] {
                assert_eq!(sum_in_tasks(&words, streams, tasks), 10_007 * 10_008 / 2, "{streams} {tasks}");
            }
        }
    }

    #[test]
    fn best_bandwidth_is_positive_and_finite() {
        let gbs = best_read_gbs();
        assert!(gbs.is_finite() && gbs > 0.0, "expected a positive bandwidth, got {gbs}");
    }
}
