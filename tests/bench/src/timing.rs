//! Times of steps with warm or cold caches, their median and quartiles, and timing by the wall clock.

use std::time::Instant;

use rayon::prelude::*;
use serde::Serialize;

use modalcast_model::error::Result;

/// State of the caches when a step begins.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum CacheState {
    /// The previous step's data.
    Warm,
    /// No data of the step: a buffer larger than the last-level cache was written before. On a GPU, it was read, so that
    /// the step does not pay for writing back dirty lines.
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

/// Minimum of repetitions for a median.
pub const MIN_REPETITIONS: usize = 20;
/// Time limit in seconds, after which no repetition beyond [`MIN_REPETITIONS`] starts.
const TIME_BUDGET_S: f64 = 5.0;
/// Minimum size of the sweep in bytes, also for machines that do not report their caches.
const SWEEP: usize = 64 << 20;

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

    /// Times `step`, called with 0, 1, 2, ..., by the wall clock: one untimed run, then [`MIN_REPETITIONS`] to `replays` runs.
    ///
    /// # Errors
    /// Errors of `step`.
    pub fn by_wall_clock(
        cache: CacheState,
        replays: usize,
        mut step: impl FnMut(usize) -> Result<()>,
    ) -> Result<Option<Self>> {
        let mut sweep = (cache == CacheState::Cold).then(CacheFlush::new);
        step(0)?;
        let (start, mut times) = (Instant::now(), Vec::new());
        for replay in 0..replays.max(MIN_REPETITIONS) {
            if replay >= MIN_REPETITIONS && start.elapsed().as_secs_f64() > TIME_BUDGET_S {
                break;
            }
            if let Some(sweep) = &mut sweep {
                sweep.run();
            }
            let begin = Instant::now();
            step(1 + replay)?;
            times.push(begin.elapsed().as_secs_f64() * 1e6);
        }
        Ok(Self::of(times))
    }
}

/// Quantile of numbers in any order, which are reordered: the median for a `share` of 0.5, the first quartile for 0.25.
/// Interpolates linearly between neighbors; `None` without numbers.
pub fn quantile(numbers: &mut [f64], share: f64) -> Option<f64> {
    let place = share * numbers.len().checked_sub(1)? as f64;
    let (_, below, rest) = numbers.select_nth_unstable_by(place.floor() as usize, f64::total_cmp);
    let above = rest.iter().copied().min_by(f64::total_cmp).unwrap_or(*below);
    // Without a fraction the next number has no weight; it may be infinite.
    Some(if place.fract() == 0.0 { *below } else { *below + (above - *below) * place.fract() })
}

/// A buffer larger than the caches.
struct CacheFlush(Vec<u64>);

impl CacheFlush {
    fn new() -> Self {
        // Every socket has its own last-level cache; twice its size, but at least [`SWEEP`], is enough in practice.
        Self(vec![1; (2 * largest_cache()).max(SWEEP) / 8])
    }

    /// Writes the whole buffer from all cores.
    fn run(&mut self) {
        let each = self.0.len().div_ceil(4 * rayon::current_num_threads()).max(1);
        self.0.par_chunks_mut(each).for_each(|part| part.iter_mut().for_each(|word| *word = word.wrapping_add(1)));
    }
}

/// Bytes of the last-level cache according to Linux; 0 on other systems.
fn largest_cache() -> usize {
    let size = |index: usize| {
        let path = format!("/sys/devices/system/cpu/cpu0/cache/index{index}/size");
        let text = std::fs::read_to_string(path).ok()?;
        let text = text.trim();
        let (number, unit) = text.split_at(text.find(|letter: char| !letter.is_ascii_digit()).unwrap_or(text.len()));
        let unit = match unit {
            "K" => 1 << 10,
            "M" => 1 << 20,
            _ => 1,
        };
        Some(number.parse::<usize>().ok()? * unit)
    };
    (0..8).filter_map(size).max().unwrap_or(0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn median_and_quartiles_of_five_numbers_are_exact() {
        let timing = Timing::of(vec![5.0, 1.0, 4.0, 2.0, 3.0]).expect("five");
        assert_eq!((timing.q1_us, timing.median_us, timing.q3_us, timing.replays), (2.0, 3.0, 4.0, 5));
        assert_eq!(Timing::of(vec![1.0, 2.0]).map(|timing| timing.median_us), Some(1.5));
        assert_eq!(Timing::of(vec![]), None);
        let even = Timing::of(vec![4.0, 1.0, 2.0, 3.0]).expect("four");
        assert_eq!(even, Timing { median_us: 2.5, q1_us: 1.75, q3_us: 3.25, replays: 4 });
        let one = Timing::of(vec![7.0]).expect("one");
        assert_eq!((one.q1_us, one.median_us, one.q3_us), (7.0, 7.0, 7.0));
    }

    #[test]
    fn quantile_ignores_an_infinite_neighbor_without_weight() {
        assert_eq!(quantile(&mut [f64::INFINITY, 2.0, 1.0], 0.5), Some(2.0));
    }

    #[test]
    fn times_at_least_20_runs_after_one_warm_up() {
        for (cache, replays, want) in [(CacheState::Warm, 3, 20), (CacheState::Warm, 31, 31), (CacheState::Cold, 1, 20)]
        {
            let mut runs = Vec::new();
            let timing = Timing::by_wall_clock(cache, replays, |run| {
                runs.push(run);
                Ok(())
            });
            assert_eq!(timing.expect("timed").map(|timing| timing.replays), Some(want));
            assert_eq!(runs, (0..=want).collect::<Vec<_>>());
        }
    }

    #[test]
    fn failing_step_ends_timing() {
        let fault = modalcast_model::error::invalid("x", "y", "z");
        assert_eq!(Timing::by_wall_clock(CacheState::Warm, 20, |_| Err(fault.clone())), Err(fault));
    }
}
