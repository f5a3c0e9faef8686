//! Telemetry: stage names, stage times in milliseconds, and logging.

use std::collections::HashMap;
use std::fmt;
use std::io::IsTerminal as _;
use std::sync::{Mutex, PoisonError};
use std::time::Instant;

use tracing::callsite::Identifier;
use tracing::{Event, Subscriber};
use tracing_subscriber::fmt::format::{Writer, format};
use tracing_subscriber::fmt::{FmtContext, FormatEvent, FormatFields};
use tracing_subscriber::registry::LookupSpan;

/// A stage of processing a step. Its name is the same in logs, replies and reports.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Stage {
    /// Validation of the step's message.
    Parse,
    /// Wait in the step queue.
    Queue,
    /// Computation of the vertices. In CUDA, from the begin of the step on the device to its end, without the wait for
    /// that begin; with the time in which the GPU draws frames of OpenGL in flight before the step is complete.
    Deform,
    /// Upload of vertices to OpenGL.
    Upload,
    /// Time before the GPU begins a frame: mostly the change from CUDA to OpenGL. `RenderStage::Switch` of the renderer
    /// defines it.
    Switch,
    /// Shadow map.
    Shadow,
    /// All other passes of a frame.
    Draw,
    /// Readback of pixels by OpenGL and their copy on the host. A copy by CUDA's copy engine is not included.
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
            Self::Switch => "switch",
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
/// also logs the debug messages of the OpenGL driver. Frequent records are limited to one per second.
///
/// Has no effect if a logger is already installed.
pub fn init_logging() {
    let filter = tracing_subscriber::EnvFilter::try_from_default_env()
        .unwrap_or_else(|_| tracing_subscriber::EnvFilter::new("info"));
    let has_colors = std::io::stderr().is_terminal();
    let subscriber = tracing_subscriber::fmt()
        .with_ansi(has_colors)
        .event_format(LimitedFormat { inner: format(), classes: Mutex::default() })
        .with_env_filter(filter)
        .with_writer(std::io::stderr);
    // Fails only if a logger is already installed. That logger remains.
    subscriber.try_init().ok();
}

/// Writes at most [`LOG_BURST`] records of a class at once, and then one per second. A class contains the records of
/// one place in the source. Clients cause many of the records, and must not be able to fill the disk with them.
struct LimitedFormat<F> {
    inner: F,
    classes: Mutex<HashMap<Identifier, LogBudget>>,
}

/// Number of records of a class that are written at once.
const LOG_BURST: f64 = 20.0;

/// The records of a class.
struct LogBudget {
    /// Number of records that may be written now.
    allowance: f64,
    last_record: Instant,
    /// Records that were not written since the last written one.
    suppressed: u64,
}

impl LogBudget {
    fn new(now: Instant) -> Self {
        Self { allowance: LOG_BURST, last_record: now, suppressed: 0 }
    }

    /// Counts a record. If it may be written, returns the number of records that were suppressed before it.
    fn record(&mut self, now: Instant) -> Option<u64> {
        let seconds = now.saturating_duration_since(self.last_record).as_secs_f64();
        self.last_record = now;
        self.allowance = LOG_BURST.min(self.allowance + seconds);
        if self.allowance < 1.0 {
            self.suppressed += 1;
            return None;
        }
        self.allowance -= 1.0;
        Some(std::mem::take(&mut self.suppressed))
    }
}

impl<S, N, F> FormatEvent<S, N> for LimitedFormat<F>
where
    S: Subscriber + for<'a> LookupSpan<'a>,
    N: for<'a> FormatFields<'a> + 'static,
    F: FormatEvent<S, N>,
{
    fn format_event(&self, ctx: &FmtContext<'_, S, N>, mut writer: Writer<'_>, event: &Event<'_>) -> fmt::Result {
        let now = Instant::now();
        let suppressed = {
            // A poisoned lock is valid, because no update can panic.
            let mut classes = self.classes.lock().unwrap_or_else(PoisonError::into_inner);
            let class = classes.entry(event.metadata().callsite()).or_insert_with(|| LogBudget::new(now));
            class.record(now)
        };
        let Some(suppressed) = suppressed else { return Ok(()) };
        if suppressed > 0 {
            writeln!(writer, "{suppressed} records like the next one were not written")?;
        }
        self.inner.format_event(ctx, writer, event)
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn records_above_the_rate_are_counted_instead_of_written() {
        let start = Instant::now();
        let mut budget = LogBudget::new(start);
        let written = (0..100).filter(|_| budget.record(start).is_some()).count();
        assert_eq!(written, LOG_BURST as usize);
        assert_eq!(budget.record(start + Duration::from_secs(1)), Some(80));
        assert_eq!(budget.record(start + Duration::from_secs(1)), None);
        assert_eq!(budget.record(start + Duration::from_secs(1000)), Some(1));
    }

    /// Collects the log.
    #[derive(Clone, Default)]
    struct Log(std::sync::Arc<Mutex<Vec<u8>>>);

    impl std::io::Write for Log {
        fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
            self.0.lock().expect("expected no panic").extend_from_slice(bytes);
            Ok(bytes.len())
        }

        fn flush(&mut self) -> std::io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn classes_of_records_are_limited_separately() {
        let log = Log::default();
        let writer = log.clone();
        let subscriber = tracing_subscriber::fmt()
            .event_format(LimitedFormat { inner: format(), classes: Mutex::default() })
            .with_writer(move || writer.clone())
            .finish();
        tracing::subscriber::with_default(subscriber, || {
            (0..1000).for_each(|number| tracing::warn!(number, "frequent"));
            tracing::warn!("rare");
        });
        let bytes = log.0.lock().expect("expected no panic").clone();
        let text = String::from_utf8(bytes).expect("expected text");
        assert_eq!(text.lines().filter(|line| line.contains("frequent")).count(), LOG_BURST as usize);
        assert_eq!(text.lines().filter(|line| line.contains("rare")).count(), 1);
    }
}
