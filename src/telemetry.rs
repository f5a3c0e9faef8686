//! Telemetry: stage names, stage times in milliseconds, and logging.

use std::io::IsTerminal as _;

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
pub fn ms_since(start: std::time::Instant) -> f64 {
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
