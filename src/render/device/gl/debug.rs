//! Forwards the driver's debug messages to the log: target `opengl`, level by OpenGL's severity. Drivers report little
//! outside debug contexts, which can be slower; a debug context is created only if the log level asks for it.

use std::collections::HashMap;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Mutex, PoisonError};

use glow::HasContext as _;
use tracing::{Level, dispatcher};

/// Maximum number of distinct messages that are counted separately. Further messages share one counter.
const MAX_COUNTED_MESSAGES: usize = 256;

/// Source, type and id of a message.
type MessageKey = [u32; 3];

/// Whether the log accepts the messages of a debug context: target `opengl` at `debug` or below
/// (`RUST_LOG=opengl=debug`).
pub(crate) fn is_enabled() -> bool {
    tracing::enabled!(target: "opengl", Level::DEBUG)
}

/// Sends the driver's messages to the log of this thread; the driver may call back on any thread. The callback lives as
/// long as `gl`, which removes it from the context when dropped.
pub(super) fn install_debug_callback(gl: &mut glow::Context) {
    if !gl.supports_debug() {
        return;
    }
    let (log, message_counts) = (dispatcher::get_default(Clone::clone), MessageCounts::default());
    // A panic must not unwind into the driver. The callback shares only counters and the log, which remain usable.
    let forward = move |source, kind, id, severity, text: &str| {
        catch_unwind(AssertUnwindSafe(|| {
            if let Some(count) = message_counts.record([source, kind, id]) {
                dispatcher::with_default(&log, || log_message((source, kind, id), severity, count, text));
            }
        }))
        .ok();
    };
    // SAFETY: the callback owns all its data, may be called on any thread and does not unwind.
    unsafe {
        gl.enable(glow::DEBUG_OUTPUT);
        // With asynchronous output, the driver does not stop at each message.
        gl.disable(glow::DEBUG_OUTPUT_SYNCHRONOUS);
        gl.debug_message_callback(forward);
    }
}

/// Number of occurrences of each message.
#[derive(Debug, Default)]
struct MessageCounts(Mutex<HashMap<MessageKey, u64>>);

impl MessageCounts {
    /// Counts a message. Returns the count if the message is to be logged: at 1, 2, 4, 8 and so on. Messages that the
    /// driver repeats in each frame thus do not flood the log.
    fn record(&self, key: MessageKey) -> Option<u64> {
        let mut counts = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let key = if counts.len() < MAX_COUNTED_MESSAGES || counts.contains_key(&key) { key } else { [0; 3] };
        let count = counts.entry(key).or_default();
        *count += 1;
        count.is_power_of_two().then_some(*count)
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

    /// A log in memory.
    #[derive(Clone, Default)]
    struct Lines(Arc<Mutex<Vec<u8>>>);

    impl Write for Lines {
        fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
            self.0.lock().expect("an unpoisoned lock").extend_from_slice(bytes);
            Ok(bytes.len())
        }

        fn flush(&mut self) -> std::io::Result<()> {
            Ok(())
        }
    }

    /// With a single subscriber in the process, `tracing` caches whether a callsite is enabled. The thread that reaches
    /// the callsite first decides, so another test without a log would disable it. With two subscribers, `tracing` asks
    /// each thread. The callsite is registered before the second subscriber is created.
    fn register_second_subscriber() {
        static SECOND_SUBSCRIBER: OnceLock<Dispatch> = OnceLock::new();
        is_enabled();
        SECOND_SUBSCRIBER.get_or_init(|| Dispatch::new(tracing_subscriber::registry()));
    }

    /// Returns the log after this many invalid OpenGL calls. `filter`: log levels, as in `RUST_LOG`.
    fn log_of(filter: &str, invalid_calls: usize) -> String {
        register_second_subscriber();
        let lines = Lines::default();
        let writer = lines.clone();
        let log = tracing_subscriber::fmt()
            .with_env_filter(tracing_subscriber::EnvFilter::new(filter))
            .with_ansi(false)
            .with_writer(move || writer.clone())
            .finish();
        tracing::subscriber::with_default(log, || {
            let (gl, _) = device::open(DevicePreference::Any).expect("EGL");
            for _ in 0..invalid_calls {
                // SAFETY: the flag does not exist, and OpenGL rejects it.
                unsafe { gl.functions().expect("a current context").enable(0xFFFF) }
                assert!(gl.check("test").is_err(), "expected the logged error also from `check`");
            }
            // SAFETY: waits for the commands, so that a driver with delayed messages has sent them.
            unsafe { gl.functions().expect("a current context").finish() }
        });
        String::from_utf8(lines.0.lock().expect("an unpoisoned lock").clone()).expect("text")
    }

    #[test]
    fn opengl_errors_are_logged_with_source_and_type() {
        let log = log_of("opengl=debug", 1);
        let line = log.lines().find(|line| line.contains("ERROR")).unwrap_or_else(|| panic!("no error in: {log}"));
        for part in ["opengl: ", "source=\"api\"", "kind=\"error\"", " id=", "times=1"] {
            assert!(line.contains(part), "expected {part} in {line}");
        }
        assert_eq!(
            log_of("opengl=debug", 0).matches("ERROR").count(),
            0,
            "control: expected no message without an error"
        );
        assert_eq!(log_of("opengl=info", 1), "", "control: expected an empty log above level debug");
    }

    #[test]
    fn threads_without_a_log_do_not_disable_callsites_of_others() {
        register_second_subscriber();
        let log = tracing_subscriber::fmt().with_max_level(Level::TRACE).with_writer(std::io::sink).finish();
        // A callsite that no thread has reached yet.
        let is_callsite_enabled = || tracing::enabled!(target: "opengl", Level::WARN);
        tracing::subscriber::with_default(log, || {
            let is_enabled_without_log = std::thread::spawn(is_callsite_enabled).join().expect("no panic");
            assert!(!is_enabled_without_log && is_callsite_enabled());
        });
    }

    #[test]
    fn repeated_messages_are_logged_at_powers_of_two() {
        let log = log_of("opengl=debug", 100);
        assert_eq!(log.matches("ERROR").count(), 7, "expected messages at 1, 2, 4, ..., 64: {log}");
    }

    #[test]
    fn number_of_counted_messages_is_bounded() {
        let message_counts = MessageCounts::default();
        let logged = (0..10_000).filter(|id| message_counts.record([1, 2, *id]).is_some()).count();
        assert!(message_counts.0.lock().expect("an unpoisoned lock").len() <= MAX_COUNTED_MESSAGES + 1);
        // Each of the 256 counted messages is logged once. The shared counter of the other 9744 messages is logged at
        // the fourteen powers of two from 1 to 8192.
        assert_eq!(logged, MAX_COUNTED_MESSAGES + 14);
    }

    #[test]
    fn sources_and_types_have_the_names_of_the_specification() {
        assert_eq!(name_of_source(glow::DEBUG_SOURCE_SHADER_COMPILER), "shader compiler");
        assert_eq!((name_of_type(glow::DEBUG_TYPE_PERFORMANCE), name_of_type(0)), ("performance", "other"));
    }

    #[test]
    fn panics_of_the_log_do_not_reach_the_driver() {
        register_second_subscriber();
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
            let functions = gl.functions().expect("a current context");
            functions.enable(0xFFFF);
            functions.finish();
        }
        assert!(gl.check("test").is_err(), "expected the logged error also from `check`");
        gl.check("test").expect("no error of later commands");
        assert!(panics.load(std::sync::atomic::Ordering::Relaxed) > 0, "expected a panic of the log");
    }
}
