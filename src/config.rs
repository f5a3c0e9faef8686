//! The server's configuration: paths and the limits that depend on the deployment, in one value that is validated once
//! and immutable afterwards. Limits that no deployment needs to change are constants beside the code that enforces
//! them. The name or
//! documentation of a field gives its unit: bytes, pixels or a count.

use std::net::{Ipv4Addr, SocketAddr};
use std::path::PathBuf;
use std::time::Duration;

use modalcast_model::error::{Result, invalid};

/// The deformation backend.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, clap::ValueEnum)]
pub enum BackendChoice {
    /// CUDA if a device can be opened, else the CPU.
    #[default]
    Auto,
    Cpu,
    Cuda,
    /// The f64 reference implementation; slow.
    Reference,
}

/// The OpenGL renderer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, clap::ValueEnum)]
pub enum RendererChoice {
    /// The CUDA device in use, else any GPU, else Mesa's software rasterizer.
    #[default]
    Auto,
    /// Mesa's software rasterizer.
    Software,
    /// No renderer; vertices only.
    Off,
}

/// The server's configuration.
#[derive(Debug, Clone, PartialEq)]
pub struct Config {
    /// The address to listen on. The default is loopback; port 0 selects a free port.
    pub listen: SocketAddr,
    /// The folder of scenes that clients may open; `None` allows the built-in scenes only.
    pub scenes: Option<PathBuf>,
    /// The folder for uploads, the list of open scenes and their last steps. Only one server at a time can use it.
    pub state: PathBuf,
    pub backend: BackendChoice,
    /// The CUDA device ordinal.
    pub cuda_device: usize,
    pub renderer: RendererChoice,
    /// Whether a renderer that runs on the CPU may draw frames.
    pub allow_software: bool,
    /// The largest message that the server accepts, in bytes.
    pub message_bytes: usize,
    /// The largest chunk of data in one reply message, in bytes. The message also contains a head.
    pub chunk_bytes: usize,
    /// The largest image side in pixels.
    pub frame_side: u32,
    /// Limit on open scenes.
    pub open_scenes: usize,
    /// Default and largest acknowledgment window of a step stream, in steps.
    pub window: u32,
    pub max_window: u32,
    /// Limits on one upload: total size in bytes and number of files.
    pub upload_bytes: u64,
    pub upload_files: u32,
    /// Default and largest deadline of a single request.
    pub deadline: Duration,
    pub max_deadline: Duration,
    /// Limits per scene: frame and vertex streams, and single requests that wait for a step.
    pub max_subscribers: usize,
    pub max_pending_requests: usize,
    /// How long a lossless subscriber may block the writer, and how long an upload may stall, before the server ends
    /// it.
    pub stall_timeout: Duration,
    /// Time for streams to end when the server shuts down.
    pub drain_timeout: Duration,
    /// Limit on open connections, and time within which a new connection must send its first byte.
    pub connections: usize,
    pub first_byte_timeout: Duration,
    /// Interval of HTTP/2 keepalive pings, and time within which the peer must answer one.
    pub keepalive_interval: Duration,
    pub keepalive_timeout: Duration,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            listen: SocketAddr::from((Ipv4Addr::LOCALHOST, 50051)),
            scenes: None,
            state: default_state(),
            backend: BackendChoice::Auto,
            cuda_device: 0,
            renderer: RendererChoice::Auto,
            allow_software: true,
            message_bytes: 16 << 20,
            chunk_bytes: 1 << 20,
            frame_side: 8192,
            open_scenes: 16,
            window: 8,
            max_window: 256,
            upload_bytes: 4 << 30,
            upload_files: 4096,
            deadline: Duration::from_secs(30),
            max_deadline: Duration::from_secs(600),
            max_subscribers: 32,
            max_pending_requests: 64,
            stall_timeout: Duration::from_secs(30),
            drain_timeout: Duration::from_secs(10),
            connections: 1024,
            first_byte_timeout: Duration::from_secs(5),
            keepalive_interval: Duration::from_secs(10),
            keepalive_timeout: Duration::from_secs(5),
        }
    }
}

/// The default state folder: `$XDG_STATE_HOME/modalcast`, else `~/.local/state/modalcast`, else `modalcast-state` in
/// the working directory.
fn default_state() -> PathBuf {
    let folder = |name: &str| std::env::var_os(name).filter(|path| !path.is_empty()).map(PathBuf::from);
    let base = folder("XDG_STATE_HOME").or_else(|| Some(folder("HOME")?.join(".local/state")));
    base.map_or_else(|| PathBuf::from("modalcast-state"), |base| base.join("modalcast"))
}

impl Config {
    /// Returns the configuration if every limit is in its range.
    ///
    /// # Errors
    /// `Invalid` naming the limit and its range.
    pub fn validated(self) -> Result<ValidatedConfig> {
        let number = |field: &str, given: u64, least: u64, most: u64| match (least..=most).contains(&given) {
            true => Ok(()),
            false => Err(invalid(format!("config.{field}"), format!("{least} to {most}"), given)),
        };
        let ms = |time: Duration| u64::try_from(time.as_millis()).unwrap_or(u64::MAX);
        const HOUR: u64 = 3_600_000;
        number("message_bytes", self.message_bytes as u64, 64 << 10, 1 << 30)?;
        number("chunk_bytes", self.chunk_bytes as u64, 1 << 10, 1 << 20)?;
        number("frame_side", self.frame_side.into(), 1, 16384)?;
        number("open_scenes", self.open_scenes as u64, 1, 4096)?;
        number("largest_window", self.max_window.into(), 1, 65536)?;
        number("window", self.window.into(), 1, self.max_window.into())?;
        number("upload_bytes", self.upload_bytes, 1, 1 << 40)?;
        number("upload_files", self.upload_files.into(), 1, 1 << 20)?;
        number("subscribers", self.max_subscribers as u64, 1, 4096)?;
        number("waiting", self.max_pending_requests as u64, 1, 65536)?;
        number("connections", self.connections as u64, 1, 65536)?;
        number("longest_deadline (ms)", ms(self.max_deadline), 1, HOUR)?;
        number("deadline (ms)", ms(self.deadline), 1, ms(self.max_deadline))?;
        number("stall (ms)", ms(self.stall_timeout), 1, HOUR)?;
        number("drain (ms)", ms(self.drain_timeout), 1, HOUR)?;
        number("first_byte (ms)", ms(self.first_byte_timeout), 1, HOUR)?;
        number("keepalive (ms)", ms(self.keepalive_interval), 100, HOUR)?;
        number("keepalive_timeout (ms)", ms(self.keepalive_timeout), 100, HOUR)?;
        if self.state.as_os_str().is_empty() {
            return Err(invalid("config.state", "a folder", "nothing"));
        }
        Ok(ValidatedConfig(self))
    }
}

/// A configuration whose limits are in their ranges. Only [`Config::validated`] creates one.
#[derive(Debug, Clone, PartialEq)]
pub struct ValidatedConfig(Config);

impl std::ops::Deref for ValidatedConfig {
    type Target = Config;

    fn deref(&self) -> &Config {
        &self.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_defaults_pass_and_listen_on_loopback_only() {
        let config = Config::default().validated().expect("the defaults fit");
        assert!(config.listen.ip().is_loopback());
    }

    #[test]
    fn a_limit_out_of_range_is_refused_by_name() {
        let bad: [(&str, Config); 5] = [
            ("config.chunk_bytes", Config { chunk_bytes: 2 << 20, ..Config::default() }),
            ("config.window", Config { window: 300, ..Config::default() }),
            ("config.frame_side", Config { frame_side: 0, ..Config::default() }),
            ("config.stall (ms)", Config { stall_timeout: Duration::ZERO, ..Config::default() }),
            ("config.state", Config { state: PathBuf::new(), ..Config::default() }),
        ];
        for (field, config) in bad {
            let refusal = config.validated().expect_err(field).to_string();
            assert!(refusal.starts_with(field), "{refusal}");
        }
    }
}
