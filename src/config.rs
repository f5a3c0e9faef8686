//! Every limit and path of the server in one value, checked once and immutable afterwards. Sizes are bytes, pixels or
//! counts as the field says.

use std::net::{Ipv4Addr, SocketAddr};
use std::path::PathBuf;
use std::time::Duration;

use modalcast_model::error::{Result, invalid};

/// Which deformer to use.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, clap::ValueEnum)]
pub enum BackendChoice {
    /// CUDA when a device opens, else the CPU.
    #[default]
    Auto,
    Cpu,
    Cuda,
    /// The definition in f64; slow.
    Reference,
}

/// Which OpenGL renderer to use.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, clap::ValueEnum)]
pub enum RendererChoice {
    /// The CUDA device in use, else any hardware, else Mesa's software rasteriser.
    #[default]
    Auto,
    /// Mesa's software rasteriser.
    Software,
    /// None: vertices only.
    Off,
}

/// The server's settings.
#[derive(Debug, Clone, PartialEq)]
pub struct Config {
    /// Where the server listens. Loopback unless somebody says otherwise; port 0 is any free port.
    pub listen: SocketAddr,
    /// The folder of scenes that clients may open; `None`: the built-in ones only.
    pub scenes: Option<PathBuf>,
    /// Where uploads, the list of open scenes and their last steps are kept. One server at a time uses it.
    pub state: PathBuf,
    pub backend: BackendChoice,
    /// CUDA's ordinal of the device.
    pub cuda_device: usize,
    pub renderer: RendererChoice,
    /// Whether frames may be drawn by a renderer that runs on the CPU.
    pub allow_software: bool,
    /// The largest message that the server reads.
    pub message_bytes: usize,
    /// The largest piece of a reply; its message is a few hundred bytes longer.
    pub chunk_bytes: usize,
    /// The largest image side in pixels.
    pub frame_side: u32,
    /// How many scenes may be open.
    pub open_scenes: usize,
    /// The acknowledgement window of a step stream that names none, and the largest.
    pub window: u32,
    pub largest_window: u32,
    /// The largest upload of one scene, and its number of files.
    pub upload_bytes: u64,
    pub upload_files: u32,
    /// How long a request waits that names no deadline, and the longest that any waits.
    pub deadline: Duration,
    pub longest_deadline: Duration,
    /// Frame and vertex streams per scene, and single requests waiting on one scene.
    pub subscribers: usize,
    pub waiting: usize,
    /// How long a lossless subscriber may hold back a writer before it is cut off.
    pub stall: Duration,
    /// How long streams may take to end when the server stops.
    pub drain: Duration,
    /// Connections at a time, and how long a new one may stay silent.
    pub connections: usize,
    pub first_byte: Duration,
    /// How often a peer is asked whether it lives, and how long it may take to answer.
    pub keepalive: Duration,
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
            largest_window: 256,
            upload_bytes: 4 << 30,
            upload_files: 4096,
            deadline: Duration::from_secs(30),
            longest_deadline: Duration::from_secs(600),
            subscribers: 32,
            waiting: 64,
            stall: Duration::from_secs(30),
            drain: Duration::from_secs(10),
            connections: 1024,
            first_byte: Duration::from_secs(5),
            keepalive: Duration::from_secs(10),
            keepalive_timeout: Duration::from_secs(5),
        }
    }
}

/// The user's state folder after the XDG convention, else a folder beside the caller.
fn default_state() -> PathBuf {
    let folder = |name: &str| std::env::var_os(name).filter(|path| !path.is_empty()).map(PathBuf::from);
    let base = folder("XDG_STATE_HOME").or_else(|| Some(folder("HOME")?.join(".local/state")));
    base.map_or_else(|| PathBuf::from("modalcast-state"), |base| base.join("modalcast"))
}

impl Config {
    /// The settings themselves if every limit makes sense.
    ///
    /// # Errors
    /// `Invalid` naming the limit and its range.
    pub fn checked(self) -> Result<Self> {
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
        number("largest_window", self.largest_window.into(), 1, 65536)?;
        number("window", self.window.into(), 1, self.largest_window.into())?;
        number("upload_bytes", self.upload_bytes, 1, 1 << 40)?;
        number("upload_files", self.upload_files.into(), 1, 1 << 20)?;
        number("subscribers", self.subscribers as u64, 1, 4096)?;
        number("waiting", self.waiting as u64, 1, 65536)?;
        number("connections", self.connections as u64, 1, 65536)?;
        number("longest_deadline (ms)", ms(self.longest_deadline), 1, HOUR)?;
        number("deadline (ms)", ms(self.deadline), 1, ms(self.longest_deadline))?;
        number("stall (ms)", ms(self.stall), 1, HOUR)?;
        number("drain (ms)", ms(self.drain), 1, HOUR)?;
        number("first_byte (ms)", ms(self.first_byte), 1, HOUR)?;
        number("keepalive (ms)", ms(self.keepalive), 100, HOUR)?;
        number("keepalive_timeout (ms)", ms(self.keepalive_timeout), 100, HOUR)?;
        if self.state.as_os_str().is_empty() {
            return Err(invalid("config.state", "a folder", "nothing"));
        }
        Ok(self)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_defaults_pass_and_listen_on_loopback_only() {
        let config = Config::default().checked().expect("the defaults fit");
        assert!(config.listen.ip().is_loopback());
    }

    #[test]
    fn a_limit_out_of_range_is_refused_by_name() {
        let bad: [(&str, Config); 5] = [
            ("config.chunk_bytes", Config { chunk_bytes: 2 << 20, ..Config::default() }),
            ("config.window", Config { window: 300, ..Config::default() }),
            ("config.frame_side", Config { frame_side: 0, ..Config::default() }),
            ("config.stall (ms)", Config { stall: Duration::ZERO, ..Config::default() }),
            ("config.state", Config { state: PathBuf::new(), ..Config::default() }),
        ];
        for (field, config) in bad {
            let refusal = config.checked().expect_err(field).to_string();
            assert!(refusal.starts_with(field), "{refusal}");
        }
    }
}
