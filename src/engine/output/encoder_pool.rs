//! The threads that encode pictures. A job consists of parts that run in parallel, such as the strips of a PNG.
//!
//! The threads serve jobs in the order of their start. A job queues one work item per thread that it can use, and a
//! work item takes parts until none is left. So a single picture uses all idle threads, which shortens its latency.
//! While several pictures wait, each thread first helps to finish the oldest one and then starts on the next one. No
//! thread is idle while a part waits, so parallel parts do not reduce the throughput. The threads belong to no other
//! pool, so encoding does not delay the copies and loops of the device thread, beyond sharing the cores with them.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Instant;

use rayon::{ThreadPool, ThreadPoolBuilder};
use tokio::sync::oneshot;

use crate::engine::lock::lock;
use crate::telemetry::ms_since;
use modalcast_model::error::{Result, fault_in};

/// A pool of threads. Clones share it. Its queue is unbounded, so callers bound the number of jobs.
#[derive(Debug, Clone)]
pub(super) struct EncoderPool {
    pool: Arc<ThreadPool>,
}

/// A job: its parts, and a function that combines their results.
struct Job<T, R, P, F> {
    part_count: usize,
    /// Computes the result of a part.
    part: P,
    /// The next part that is not started yet.
    next_part: AtomicUsize,
    state: Mutex<JobState<T, R, F>>,
}

struct JobState<T, R, F> {
    /// When the first part was started.
    begin: Option<Instant>,
    /// Results with the indices of their parts, in the order of completion.
    results: Vec<(usize, T)>,
    /// The function that combines the results, and the channel for the combination. `None` once all results are there.
    completion: Option<(F, oneshot::Sender<(R, f64)>)>,
}

impl EncoderPool {
    /// Starts the threads.
    ///
    /// # Errors
    /// `Fault` when the threads cannot be started.
    pub(super) fn new(threads: usize) -> Result<Self> {
        // A panic drops the job, so its caller gets an error.
        let pool = ThreadPoolBuilder::new()
            .num_threads(threads)
            .thread_name(|index| format!("encode {index}"))
            .panic_handler(|_| tracing::error!("the encoding of a picture panicked"));
        Ok(Self { pool: Arc::new(pool.build().map_err(fault_in("threads that encode pictures"))?) })
    }

    /// Runs `part` for each of `part_count` parts (at least one), then `finish` with their results in the order of the
    /// parts. The second argument of `part` is a buffer that successive parts on one thread share. Returns the result
    /// of `finish`, and the milliseconds since the first part was started. If the caller is dropped, parts that have
    /// not started are omitted.
    ///
    /// # Errors
    /// `Fault` when a part or `finish` panics.
    pub(super) async fn run<T, R, B>(
        &self,
        part_count: usize,
        part: impl Fn(usize, &mut B) -> T + Send + Sync + 'static,
        finish: impl FnOnce(Vec<T>) -> R + Send + 'static,
    ) -> Result<(R, f64)>
    where
        T: Send + 'static,
        R: Send + 'static,
        B: Default + 'static,
    {
        let (sender, receiver) = oneshot::channel();
        let state =
            JobState { begin: None, results: Vec::with_capacity(part_count), completion: Some((finish, sender)) };
        let job = Arc::new(Job { part_count, part, next_part: AtomicUsize::new(0), state: Mutex::new(state) });
        for _ in 0..part_count.min(self.pool.current_num_threads()) {
            let job = Arc::clone(&job);
            self.pool.spawn_fifo(move || job.work::<B>());
        }
        // The job ends with its last work item. Then the channel closes, also if a result is missing.
        drop(job);
        receiver.await.map_err(fault_in("encode"))
    }
}

impl<T, R, P, F: FnOnce(Vec<T>) -> R> Job<T, R, P, F> {
    /// Runs parts until none is left or the caller has dropped the job.
    fn work<B: Default>(&self)
    where
        P: Fn(usize, &mut B) -> T,
    {
        let mut buffers = B::default();
        while let Some(index) = self.start_part() {
            let result = (self.part)(index, &mut buffers);
            self.complete_part(index, result);
        }
    }

    fn start_part(&self) -> Option<usize> {
        let index = self.next_part.fetch_add(1, Ordering::Relaxed);
        let mut state = lock(&self.state);
        let is_awaited = state.completion.as_ref().is_some_and(|(_, sender)| !sender.is_closed());
        state.begin.get_or_insert_with(Instant::now);
        (index < self.part_count && is_awaited).then_some(index)
    }

    /// Stores a result. The last one completes the job.
    fn complete_part(&self, index: usize, result: T) {
        let mut state = lock(&self.state);
        state.results.push((index, result));
        if state.results.len() < self.part_count {
            return;
        }
        let (mut results, begin) = (std::mem::take(&mut state.results), state.begin.unwrap_or_else(Instant::now));
        let Some((finish, sender)) = state.completion.take() else { return };
        drop(state);
        results.sort_unstable_by_key(|(index, _)| *index);
        let combination = finish(results.into_iter().map(|(_, result)| result).collect());
        // Fails only if the caller no longer waits.
        sender.send((combination, ms_since(begin))).ok();
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::AtomicBool;
    use std::sync::mpsc;

    use super::*;

    #[tokio::test]
    async fn results_have_the_order_of_the_parts() {
        let pool = EncoderPool::new(3).expect("expected threads");
        for part_count in [1, 2, 3, 50] {
            let squares = pool.run(part_count, |index, (): &mut ()| index * index, |squares| squares).await;
            let expected: Vec<usize> = (0..part_count).map(|index| index * index).collect();
            assert_eq!(squares.expect("expected results").0, expected);
        }
    }

    /// Two parts that wait for each other finish only if each runs on its own thread.
    #[tokio::test]
    async fn parts_of_one_job_run_in_parallel() {
        let pool = EncoderPool::new(2).expect("expected threads");
        let barrier = std::sync::Barrier::new(2);
        let part = move |_: usize, (): &mut ()| barrier.wait().is_leader();
        let (leaders, _) = pool.run(2, part, |leaders| leaders).await.expect("expected results");
        assert_eq!(leaders.iter().filter(|is_leader| **is_leader).count(), 1);
    }

    #[tokio::test]
    async fn oldest_job_is_finished_first() {
        let pool = EncoderPool::new(1).expect("expected a thread");
        let (order_sender, order) = mpsc::sync_channel(8);
        let (release, wait) = mpsc::sync_channel::<()>(1);
        let wait = Mutex::new(wait);
        let blocker = pool.run(1, move |_, (): &mut ()| lock(&wait).recv().is_ok(), |_| ());
        let job = |number: usize| {
            let order_sender = order_sender.clone();
            pool.run(3, move |part, (): &mut ()| order_sender.send((number, part)).is_ok(), |_| ())
        };
        // Joined futures are polled, and so queued, in this order. The last one releases the thread.
        let release = async { release.send(()).expect("expected a waiting part") };
        let (blocked, first, second, ()) = tokio::join!(blocker, job(1), job(2), release);
        assert!(blocked.is_ok() && first.is_ok() && second.is_ok());
        assert_eq!(order.try_iter().collect::<Vec<_>>(), [(1, 0), (1, 1), (1, 2), (2, 0), (2, 1), (2, 2)]);
    }

    #[tokio::test]
    async fn panic_is_an_error_and_the_threads_remain() {
        let pool = EncoderPool::new(2).expect("expected threads");
        let part = |index: usize, (): &mut ()| assert_ne!(index, 1, "a panic for this test");
        pool.run(3, part, |_| ()).await.expect_err("expected a fault");
        pool.run(1, |_, (): &mut ()| (), |_| panic!("a panic for this test"))
            .await
            .map(|((), _)| ())
            .expect_err("fault");
        assert_eq!(pool.run(2, |index, (): &mut ()| index, |all| all).await.expect("expected results").0, [0, 1]);
    }

    #[tokio::test]
    async fn parts_of_a_dropped_caller_are_omitted() {
        let pool = EncoderPool::new(1).expect("expected a thread");
        let (release, wait) = mpsc::sync_channel::<()>(1);
        let wait = Mutex::new(wait);
        let has_run_later_part = Arc::new(AtomicBool::new(false));
        let flag = Arc::clone(&has_run_later_part);
        let part = move |index: usize, (): &mut ()| match index {
            0 => lock(&wait).recv().is_ok(),
            _ => flag.swap(true, Ordering::Relaxed),
        };
        let dropped = pool.run(2, part, |_| ());
        tokio::time::timeout(std::time::Duration::from_millis(20), dropped).await.expect_err("expected a blocked part");
        // Fails if the caller was dropped before the thread has started the part.
        release.send(()).ok();
        // The only thread serves this job after the dropped one.
        pool.run(1, |_, (): &mut ()| (), |_| ()).await.expect("expected a result");
        assert!(!has_run_later_part.load(Ordering::Relaxed));
    }
}
