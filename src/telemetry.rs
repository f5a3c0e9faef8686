//! Telemetry: stage names, stage times in milliseconds, and logging.

use std::io::IsTerminal as _;
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

/// A stage of processing a step. Its name is the same in logs, replies and reports.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Stage {
    /// Validation of the step's message.
    Parse,
    /// Wait in the step queue.
    Queue,
    Deform,
    /// Upload of vertices to OpenGL.
    Upload,
    /// Shadow map.
    Shadow,
    /// All other passes of a frame.
    Draw,
    /// Readback of pixels.
    Read,
    /// PNG encoding, or packing of vertices.
    Encode,
    /// Readback of vertices.
    Copy,
}

impl Stage {
    /// Name of the stage in logs, replies and reports.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Parse => "parse",
            Self::Queue => "queue",
            Self::Deform => "deform",
            Self::Upload => "upload",
            Self::Shadow => "shadow",
            Self::Draw => "draw",
            Self::Read => "read",
            Self::Encode => "encode",
            Self::Copy => "copy",
        }
    }
}

/// Milliseconds per stage, in the order of execution.
pub type StageTimes = Vec<(Stage, f64)>;

/// Milliseconds since `start`.
pub fn ms_since(start: Instant) -> f64 {
    start.elapsed().as_secs_f64() * 1e3
}

/// Writes the log to standard error. `RUST_LOG` sets the filter. The default is `info`. `RUST_LOG=info,opengl=debug`
/// also logs the debug messages of the OpenGL driver.
///
/// Has no effect if a logger is already installed.
pub fn init_logging() {
    let filter = tracing_subscriber::EnvFilter::try_from_default_env()
        .unwrap_or_else(|_| tracing_subscriber::EnvFilter::new("info"));
    let has_colors = std::io::stderr().is_terminal();
    let subscriber =
        tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr).with_ansi(has_colors);
    // Fails only if a logger is already installed. That logger remains.
    subscriber.try_init().ok();
}

/// Limits a kind of log record to one per second.
#[derive(Debug, Default)]
pub struct LogLimiter(Mutex<LogPeriod>);

#[derive(Debug, Default)]
struct LogPeriod {
    /// When the last record was written.
    start: Option<Instant>,
    /// Events since then.
    count: u64,
}

impl LogLimiter {
    /// Counts an event. Returns the number of events since the last record if a record is due.
    pub fn record(&self) -> Option<u64> {
        // A poisoned lock is valid, because no update can panic.
        let mut period = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        period.count += 1;
        let is_due = period.start.is_none_or(|start| start.elapsed() >= Duration::from_secs(1));
        is_due.then(|| {
            period.start = Some(Instant::now());
            std::mem::take(&mut period.count)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn limiter_counts_the_events_without_a_record() {
        let limiter = LogLimiter::default();
        assert_eq!(limiter.record(), Some(1));
        assert_eq!((limiter.record(), limiter.record()), (None, None));
        limiter.0.lock().expect("expected no panic").start = None;
        assert_eq!(limiter.record(), Some(3));
    }
}
