//! Forwards the driver's debug messages to the log: target `opengl`, level by OpenGL's severity. Drivers report little
//! outside debug contexts, which can be slower; a debug context is created only if the log level asks for it.

use std::collections::HashMap;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Mutex, PoisonError};

use glow::HasContext as _;
use tracing::{Level, dispatcher};

/// Distinct messages that are counted separately; further ones share one counter.
const KINDS: usize = 256;

/// Source, type and id of a message.
type Key = [u32; 3];

/// Whether the log accepts the messages of a debug context: target `opengl` at `debug` or below
/// (`RUST_LOG=opengl=debug`).
pub(crate) fn is_enabled() -> bool {
    tracing::enabled!(target: "opengl", Level::DEBUG)
}

/// Sends the driver's messages to the log of this thread, on whatever thread the driver calls back. The callback lives
/// as long as `gl`, which removes it from the context when dropped.
pub(super) fn install_debug_callback(gl: &mut glow::Context) {
    if !gl.supports_debug() {
        return;
    }
    let (log, heard) = (dispatcher::get_default(Clone::clone), MessageCounts::default());
    // A panic must not unwind into the driver. The state behind it is a counter and the log, which both stay usable.
    let forward = move |source, kind, id, severity, text: &str| {
        catch_unwind(AssertUnwindSafe(|| {
            if let Some(times) = heard.record([source, kind, id]) {
                dispatcher::with_default(&log, || log_message((source, kind, id), severity, times, text));
            }
        }))
        .ok();
    };
    // SAFETY: the callback owns all its data, may be called on any thread and does not unwind.
    unsafe {
        gl.enable(glow::DEBUG_OUTPUT);
        // Asynchronous output: the driver need not stop for its messages.
        gl.disable(glow::DEBUG_OUTPUT_SYNCHRONOUS);
        gl.debug_message_callback(forward);
    }
}

/// Number of occurrences of each message.
#[derive(Debug, Default)]
struct MessageCounts(Mutex<HashMap<Key, u64>>);

impl MessageCounts {
    /// Counts a message. Returns the count when it is to be logged, at 1, 2, 4, 8 and so on, so that a driver that
    /// repeats a message in each frame does not flood the log.
    fn record(&self, key: Key) -> Option<u64> {
        let mut counts = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let key = if counts.len() < KINDS || counts.contains_key(&key) { key } else { [0; 3] };
        let times = counts.entry(key).or_default();
        *times += 1;
        times.is_power_of_two().then_some(*times)
    }
}

fn log_message((source, kind, id): (u32, u32, u32), severity: u32, times: u64, text: &str) {
    let (source, kind, text) = (name_of_source(source), name_of_type(kind), text.trim_end());
    match severity {
        glow::DEBUG_SEVERITY_HIGH => tracing::error!(target: "opengl", source, kind, id, times, "{text}"),
        glow::DEBUG_SEVERITY_MEDIUM => tracing::warn!(target: "opengl", source, kind, id, times, "{text}"),
        glow::DEBUG_SEVERITY_LOW => tracing::debug!(target: "opengl", source, kind, id, times, "{text}"),
        _ => tracing::trace!(target: "opengl", source, kind, id, times, "{text}"),
    }
}

const fn name_of_source(source: u32) -> &'static str {
    match source {
        glow::DEBUG_SOURCE_API => "api",
        glow::DEBUG_SOURCE_WINDOW_SYSTEM => "window system",
        glow::DEBUG_SOURCE_SHADER_COMPILER => "shader compiler",
        glow::DEBUG_SOURCE_THIRD_PARTY => "third party",
        glow::DEBUG_SOURCE_APPLICATION => "application",
        _ => "other",
    }
}

const fn name_of_type(kind: u32) -> &'static str {
    match kind {
        glow::DEBUG_TYPE_ERROR => "error",
        glow::DEBUG_TYPE_DEPRECATED_BEHAVIOR => "deprecated behavior",
        glow::DEBUG_TYPE_UNDEFINED_BEHAVIOR => "undefined behavior",
        glow::DEBUG_TYPE_PORTABILITY => "portability",
        glow::DEBUG_TYPE_PERFORMANCE => "performance",
        glow::DEBUG_TYPE_MARKER => "marker",
        _ => "other",
    }
}

#[cfg(test)]
mod tests {
    use std::io::Write;
    use std::sync::{Arc, OnceLock};

    use tracing::Dispatch;

    use super::*;
    use crate::{DevicePreference, device};

    #[derive(Clone, Default)]
    struct Lines(Arc<Mutex<Vec<u8>>>);

    impl Write for Lines {
        fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
            self.0.lock().expect("whole").extend_from_slice(bytes);
            Ok(bytes.len())
        }

        fn flush(&mut self) -> std::io::Result<()> {
            Ok(())
        }
    }

    /// With a single subscriber in the process, `tracing` caches whether a callsite is enabled, as decided by the
    /// thread that reaches it first: another test without a log would disable the callsite. With two subscribers,
    /// `tracing` asks each thread. The callsite is registered before the second subscriber is created.
    fn keep_a_second_log() {
        static SECOND: OnceLock<Dispatch> = OnceLock::new();
        is_enabled();
        SECOND.get_or_init(|| Dispatch::new(tracing_subscriber::registry()));
    }

    /// The log after a context was misused this many times.
    fn log_of(filter: &str, wrong: usize) -> String {
        keep_a_second_log();
        let lines = Lines::default();
        let writer = lines.clone();
        let log = tracing_subscriber::fmt()
            .with_env_filter(tracing_subscriber::EnvFilter::new(filter))
            .with_ansi(false)
            .with_writer(move || writer.clone())
            .finish();
        tracing::subscriber::with_default(log, || {
            let (gl, _) = device::open(DevicePreference::Any).expect("EGL");
            for _ in 0..wrong {
                // SAFETY: the flag does not exist, and OpenGL rejects it.
                unsafe { gl.functions().expect("current").enable(0xFFFF) }
                assert!(gl.check("test").is_err(), "the error is seen without the log too");
            }
            // SAFETY: waits for the commands, so that a driver with delayed messages has sent them.
            unsafe { gl.functions().expect("current").finish() }
        });
        String::from_utf8(lines.0.lock().expect("whole").clone()).expect("text")
    }

    #[test]
    fn an_error_of_opengl_is_in_the_log_with_its_source_and_type_where_somebody_listens() {
        let log = log_of("opengl=debug", 1);
        let line = log.lines().find(|line| line.contains("ERROR")).unwrap_or_else(|| panic!("no error in: {log}"));
        for part in ["opengl: ", "source=\"api\"", "kind=\"error\"", " id=", "times=1"] {
            assert!(line.contains(part), "{part} in {line}");
        }
        assert_eq!(log_of("opengl=debug", 0).matches("ERROR").count(), 0, "control: nothing wrong, nothing said");
        assert_eq!(log_of("opengl=info", 1), "", "control: nobody listens");
    }

    #[test]
    fn a_thread_without_a_log_does_not_decide_that_no_thread_has_one() {
        keep_a_second_log();
        let log = tracing_subscriber::fmt().with_max_level(Level::TRACE).with_writer(std::io::sink).finish();
        // A callsite that no thread has reached yet.
        let asks = || tracing::enabled!(target: "opengl", Level::WARN);
        tracing::subscriber::with_default(log, || {
            let other = std::thread::spawn(asks).join().expect("asks");
            assert!(!other && asks());
        });
    }

    #[test]
    fn what_a_driver_repeats_is_told_less_and_less() {
        let log = log_of("opengl=debug", 100);
        let told = log.matches("ERROR").count();
        assert_eq!(told, 7, "at 1, 2, 4 .. 64: {log}");
    }

    #[test]
    fn no_number_of_different_messages_fills_the_memory() {
        let heard = MessageCounts::default();
        let told = (0..10_000).filter(|id| heard.record([1, 2, *id]).is_some()).count();
        assert!(heard.0.lock().expect("whole").len() <= KINDS + 1);
        assert!(told < KINDS + 20, "{told}");
    }

    #[test]
    fn severities_sources_and_types_have_the_names_of_the_specification() {
        assert_eq!(name_of_source(glow::DEBUG_SOURCE_SHADER_COMPILER), "shader compiler");
        assert_eq!((name_of_type(glow::DEBUG_TYPE_PERFORMANCE), name_of_type(0)), ("performance", "other"));
    }

    #[test]
    fn panics_of_the_log_do_not_reach_the_driver() {
        keep_a_second_log();
        let panics = std::sync::Arc::new(std::sync::atomic::AtomicUsize::new(0));
        let counter = Arc::clone(&panics);
        let writer = move || -> std::io::Sink {
            counter.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
            panic!("injected")
        };
        let log = tracing_subscriber::fmt().with_max_level(Level::DEBUG).with_writer(writer).finish();
        let dispatch = Dispatch::new(log);
        let gl = dispatcher::with_default(&dispatch, || device::open(DevicePreference::Any).expect("EGL").0);
        // SAFETY: the flag does not exist, and OpenGL rejects it; `finish` waits for the driver's messages.
        unsafe {
            let functions = gl.functions().expect("current");
            functions.enable(0xFFFF);
            functions.finish();
        }
        assert!(gl.check("test").is_err(), "the error is seen without the log too");
        gl.check("test").expect("commands go on");
        assert!(panics.load(std::sync::atomic::Ordering::Relaxed) > 0, "the log was reached");
    }
}
