//! Times of steps with warm or cold caches, their median and quartiles, and timing by the wall clock.

use std::time::Instant;

use rayon::prelude::*;
use serde::Serialize;

use modalcast_model::error::Result;

/// State of the caches when a step begins.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum CacheState {
    /// The caches hold data of the previous step.
    Warm,
    /// The caches hold no data of the step, because a buffer larger than the last-level cache was written before. On a
    /// GPU, the buffer was read instead, so that the step does not write back dirty lines.
    Cold,
}

impl CacheState {
    /// The name in tables.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Warm => "warm",
            Self::Cold => "cold",
        }
    }
}

/// Median and quartiles of a step's run time, microseconds.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Timing {
    pub median_us: f64,
    pub q1_us: f64,
    pub q3_us: f64,
    pub replays: usize,
}

/// Minimum number of repetitions for a median. Unit tests do not look at times, so a few repetitions are enough there.
pub const MIN_REPETITIONS: usize = if cfg!(test) { 3 } else { 20 };
/// Time limit in seconds, after which no repetition beyond [`MIN_REPETITIONS`] starts.
const TIME_BUDGET_S: f64 = 0.5;
/// Minimum size of the buffer that evicts the caches, for machines that do not report their cache sizes.
const MIN_FLUSH_BYTES: usize = 64 << 20;

impl Timing {
    /// Median and quartiles of times in microseconds, in any order; `None` when there are none.
    pub fn of(mut times: Vec<f64>) -> Option<Self> {
        Some(Self {
            median_us: quantile(&mut times, 0.5)?,
            q1_us: quantile(&mut times, 0.25)?,
            q3_us: quantile(&mut times, 0.75)?,
            replays: times.len(),
        })
    }

    /// Times `step`, called with 0, 1, 2, ..., by the wall clock: one untimed run, then [`MIN_REPETITIONS`] to
    /// `replays` runs.
    ///
    /// # Errors
    /// Errors of `step`.
    pub fn by_wall_clock(
        cache: CacheState,
        replays: usize,
        mut step: impl FnMut(usize) -> Result<()>,
    ) -> Result<Option<Self>> {
        let mut cache_flush = (cache == CacheState::Cold).then(CacheFlush::new);
        step(0)?;
        let (start, mut times) = (Instant::now(), Vec::new());
        for replay in 0..replays.max(MIN_REPETITIONS) {
            if replay >= MIN_REPETITIONS && start.elapsed().as_secs_f64() > TIME_BUDGET_S {
                break;
            }
            if let Some(cache_flush) = &mut cache_flush {
                cache_flush.evict();
            }
            let step_start = Instant::now();
            step(1 + replay)?;
            times.push(step_start.elapsed().as_secs_f64() * 1e6);
        }
        Ok(Self::of(times))
    }
}

/// Quantile of numbers, which are reordered: the median for a `fraction` of 0.5, the first quartile for 0.25.
/// Interpolates linearly between neighbors; `None` without numbers.
pub fn quantile(numbers: &mut [f64], fraction: f64) -> Option<f64> {
    let position = fraction * numbers.len().checked_sub(1)? as f64;
    let (_, lower, upper_numbers) = numbers.select_nth_unstable_by(position.floor() as usize, f64::total_cmp);
    let upper = upper_numbers.iter().copied().min_by(f64::total_cmp).unwrap_or(*lower);
    // At a whole position, the upper neighbor has no weight. It may be infinite, and 0 times infinity is NaN.
    Some(if position.fract() == 0.0 { *lower } else { *lower + (upper - *lower) * position.fract() })
}

/// A buffer of 64-bit words that is larger than the caches.
struct CacheFlush(Vec<u64>);

impl CacheFlush {
    fn new() -> Self {
        // Twice the last-level cache of one socket, because another socket may have a cache of its own.
        let bytes = (2 * last_level_cache_bytes()).max(MIN_FLUSH_BYTES);
        Self(vec![1; bytes / size_of::<u64>()])
    }

    /// Evicts other data from the caches by writing the whole buffer from all cores.
    fn evict(&mut self) {
        // Four chunks per thread balance the load.
        let chunk_length = self.0.len().div_ceil(4 * rayon::current_num_threads()).max(1);
        self.0
            .par_chunks_mut(chunk_length)
            .for_each(|chunk| chunk.iter_mut().for_each(|word| *word = word.wrapping_add(1)));
    }
}

/// Bytes of the last-level cache according to Linux; 0 on other systems.
fn last_level_cache_bytes() -> usize {
    let cache_bytes = |index: usize| {
        let path = format!("/sys/devices/system/cpu/cpu0/cache/index{index}/size");
        let text = std::fs::read_to_string(path).ok()?;
        let text = text.trim();
        let (number, suffix) = text.split_at(text.find(|letter: char| !letter.is_ascii_digit()).unwrap_or(text.len()));
        let factor = match suffix {
            "K" => 1 << 10,
            "M" => 1 << 20,
            _ => 1,
        };
        Some(number.parse::<usize>().ok()? * factor)
    };
    // Linux lists fewer than eight caches per core. The last-level cache is the largest.
    (0..8).filter_map(cache_bytes).max().unwrap_or(0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn median_and_quartiles_are_exact() {
        let timing = Timing::of(vec![5.0, 1.0, 4.0, 2.0, 3.0]).expect("expected a timing");
        assert_eq!((timing.q1_us, timing.median_us, timing.q3_us, timing.replays), (2.0, 3.0, 4.0, 5));
        assert_eq!(Timing::of(vec![1.0, 2.0]).map(|timing| timing.median_us), Some(1.5));
        assert_eq!(Timing::of(vec![]), None);
        let of_four = Timing::of(vec![4.0, 1.0, 2.0, 3.0]).expect("expected a timing");
        assert_eq!(of_four, Timing { median_us: 2.5, q1_us: 1.75, q3_us: 3.25, replays: 4 });
        let of_one = Timing::of(vec![7.0]).expect("expected a timing");
        assert_eq!((of_one.q1_us, of_one.median_us, of_one.q3_us), (7.0, 7.0, 7.0));
    }

    #[test]
    fn quantile_ignores_an_infinite_neighbor_without_weight() {
        assert_eq!(quantile(&mut [f64::INFINITY, 2.0, 1.0], 0.5), Some(2.0));
    }

    #[test]
    fn wall_clock_runs_one_warm_up_then_at_least_the_minimum() {
        for (cache, replays, expected) in
            [(CacheState::Warm, 2, MIN_REPETITIONS), (CacheState::Warm, 31, 31), (CacheState::Cold, 1, MIN_REPETITIONS)]
        {
            let mut repetitions = Vec::new();
            let timing = Timing::by_wall_clock(cache, replays, |repetition| {
                repetitions.push(repetition);
                Ok(())
            });
            assert_eq!(timing.expect("expected a timing").map(|timing| timing.replays), Some(expected));
            assert_eq!(repetitions, (0..=expected).collect::<Vec<_>>());
        }
    }

    #[test]
    fn failing_step_ends_timing() {
        let error = modalcast_model::error::invalid("x", "y", "z");
        assert_eq!(Timing::by_wall_clock(CacheState::Warm, 20, |_| Err(error.clone())), Err(error));
    }
}
