//! The server's configuration: paths and the limits that depend on the deployment. It is validated once and immutable
//! afterwards. Limits that no deployment needs to change are constants in the code that enforces them.

use std::net::{Ipv4Addr, SocketAddr};
use std::path::PathBuf;
use std::time::Duration;

use bytes::Bytes;
use modalcast_model::error::{Result, invalid};
use modalcast_model::load::LoadOptions;

/// The largest stall budget of a writer.
pub const MAX_STALL_BUDGET: Duration = Duration::from_secs(86_400);

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

/// The device of the OpenGL renderer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, clap::ValueEnum)]
pub enum RendererChoice {
    /// The GPU of the CUDA backend if CUDA is in use, else any GPU, else Mesa's software rasterizer.
    #[default]
    Auto,
    /// Mesa's software rasterizer.
    Software,
    /// No renderer; vertices only.
    Off,
}

/// The device that encodes streamed color frames as PNG. The files are equal.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, clap::ValueEnum)]
pub enum EncodeChoice {
    /// The threads of the server.
    #[default]
    Cpu,
    /// CUDA. It requires that CUDA and OpenGL share pictures, and frames without translucent pixels; the CPU encodes all
    /// others.
    Cuda,
    /// The faster one, which is measured when a scene is loaded: a frame of 1920x1080 is encoded by CUDA, and by one thread
    /// of the CPU, whose time is divided by the number of threads.
    Fastest,
}

/// An address that the server listens on: `HOST:PORT` or `unix:PATH`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ListenAddress {
    /// Port 0 selects a free port.
    Tcp(SocketAddr),
    /// The path of a Unix socket, which only the user of the server can connect to.
    Unix(PathBuf),
}

impl ListenAddress {
    /// Whether other machines can connect to the address.
    pub fn is_remote(&self) -> bool {
        matches!(self, Self::Tcp(address) if !address.ip().is_loopback())
    }
}

impl std::str::FromStr for ListenAddress {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text.strip_prefix("unix:") {
            Some("") => Err("expected a path after 'unix:'".into()),
            Some(path) => Ok(Self::Unix(path.into())),
            None => text.parse().map(Self::Tcp).map_err(|error| format!("expected IP:PORT or unix:PATH: {error}")),
        }
    }
}

impl std::fmt::Display for ListenAddress {
    fn fmt(&self, out: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Tcp(address) => address.fmt(out),
            Self::Unix(path) => write!(out, "unix:{}", path.display()),
        }
    }
}

/// The certificate of the server's TCP sockets.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ServerCertificate {
    /// PEM files, which are read again when they change.
    Files { certificate: PathBuf, key: PathBuf },
    /// A certificate that the server makes and keeps in the state folder, with the names and addresses of this machine and
    /// these further names.
    SelfSigned { names: Vec<String> },
}

/// Encryption of the TCP sockets.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TlsSettings {
    pub certificate: ServerCertificate,
    /// A PEM file with the authorities of client certificates, whose names identify principals. `None`: clients have no
    /// certificates.
    pub client_ca: Option<PathBuf>,
}

/// The URL at which browsers reach the server behind a proxy: `http` or `https`, a host, and the path of a folder.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PublicUrl {
    scheme: &'static str,
    authority: String,
    /// Empty, or begins with `/` and does not end with it.
    path: String,
}

impl PublicUrl {
    /// `http` or `https`.
    pub const fn scheme(&self) -> &str {
        self.scheme
    }

    /// The host and, unless it is that of the scheme, the port.
    pub fn authority(&self) -> &str {
        &self.authority
    }

    /// Empty, or a path that begins with `/` and does not end with it.
    pub fn path(&self) -> &str {
        &self.path
    }
}

impl std::str::FromStr for PublicUrl {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let expected = || format!("expected http://HOST/PATH or https://HOST/PATH, got '{text}'");
        let (scheme, default_port, rest) = match text.split_once("://").ok_or_else(expected)? {
            ("http", rest) => ("http", ":80", rest),
            ("https", rest) => ("https", ":443", rest),
            _ => return Err(expected()),
        };
        let (authority, path) = rest.split_at(rest.find('/').unwrap_or(rest.len()));
        let authority = authority.strip_suffix(default_port).unwrap_or(authority).to_ascii_lowercase();
        let is_host = |letter: char| letter.is_ascii_alphanumeric() || "-.:[]".contains(letter);
        let is_path = |letter: char| letter.is_ascii_alphanumeric() || "/-._~".contains(letter);
        let begins_with_host = authority.starts_with(|letter: char| letter.is_ascii_alphanumeric() || letter == '[');
        if !begins_with_host || !authority.chars().all(is_host) || !path.chars().all(is_path) {
            return Err(expected());
        }
        Ok(Self { scheme, authority, path: path.trim_end_matches('/').to_owned() })
    }
}

impl std::fmt::Display for PublicUrl {
    fn fmt(&self, out: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(out, "{}://{}{}", self.scheme, self.authority, self.path)
    }
}

/// How the server finds the principals of calls.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Authentication {
    /// By the user of a Unix socket's client, by a client certificate, or by a token.
    #[default]
    UsersAndTokens,
    /// By a client certificate or a token, for machines on which several people share one account.
    Tokens,
    /// Every client is the owner.
    Off,
}

/// Permissions of a Unix socket.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SocketPermissions {
    /// Permission bits. Who can write to the socket can connect to it.
    pub mode: u32,
    /// The id of the socket's group. `None`: the group of the server's user.
    pub group: Option<u32>,
}

impl Default for SocketPermissions {
    /// Only the user of the server can connect.
    fn default() -> Self {
        Self { mode: 0o600, group: None }
    }
}

/// A recording that the viewer's page plays.
#[derive(Debug, Clone, PartialEq)]
pub struct ViewerRecording {
    /// An MCAP file.
    pub file: Bytes,
    /// Real seconds per second of the recording, until the user selects another speed. Positive.
    pub slow: f64,
}

/// The server's configuration. The name or the documentation of a field gives its unit.
#[derive(Debug, Clone, PartialEq)]
pub struct Config {
    /// The addresses to listen on, at least one. The default is loopback.
    pub listen: Vec<ListenAddress>,
    /// The path of a further Unix socket for clients of the same user on this machine, which can send steps and receive
    /// vertices, frames and views in shared memory. The others are in the folder `local_sockets`.
    pub shared_memory: Option<PathBuf>,
    /// The folder of two Unix sockets for each TCP port that the server listens on: `PORT.sock` for calls, and
    /// `PORT.memory.sock` for shared memory. `None`: no sockets.
    pub local_sockets: Option<PathBuf>,
    /// Who may connect to the Unix sockets in `listen`.
    pub socket_permissions: SocketPermissions,
    pub authentication: Authentication,
    /// The file that names the principals besides the owner; see `modalcast::identity`.
    pub principals: Option<PathBuf>,
    /// Encryption of the TCP sockets. `None`: nothing is encrypted.
    pub tls: Option<TlsSettings>,
    /// Whether addresses that other machines can connect to are allowed without encryption.
    pub insecure: bool,
    /// The URL at which browsers reach the server behind a proxy, besides the addresses of the server.
    pub public_url: Option<PublicUrl>,
    /// The address of health, readiness and metrics, which need no credential. `None`: there are none.
    pub admin: Option<ListenAddress>,
    /// Whether browsers are served: the viewer and the WebSocket.
    pub viewer: bool,
    /// The recording that the viewer's page plays in place of the server's scenes.
    pub viewer_recording: Option<ViewerRecording>,
    /// The folder of scenes that clients may open. `None` allows only the built-in scenes.
    pub scenes: Option<PathBuf>,
    /// How scenes are read; see `SceneRepository::with_options`.
    pub load_options: LoadOptions,
    /// The folder for uploads, the list of open scenes and their last steps. Only one server at a time can use it.
    pub state: PathBuf,
    pub backend: BackendChoice,
    /// The CUDA device ordinal.
    pub cuda_device: usize,
    pub renderer: RendererChoice,
    pub encode: EncodeChoice,
    /// Whether a renderer that runs on the CPU may draw frames.
    pub allow_software: bool,
    /// The largest message that the server accepts, in bytes.
    pub message_bytes: usize,
    /// Limit in bytes on the messages that clients are sending, which they share; see `modalcast::admission`. An incomplete
    /// message counts with its whole length. At least twice the largest message, so that one does not take the share of all.
    pub receive_bytes: usize,
    /// Longest time without progress of an incomplete message. Progress below 32 KiB/s extends it only in part.
    pub message_timeout: Duration,
    /// Limit in bytes on the produced replies that are not sent yet, of one connection; `reply_bytes` limits those of
    /// all connections. Above a limit, senders wait. While the total is exhausted, a connection that holds more than an
    /// equal share and takes nothing for 0.4 s is closed.
    pub connection_reply_bytes: usize,
    /// See `connection_reply_bytes`: the limit of all connections.
    pub reply_bytes: usize,
    /// A call ends if its client takes less than one message (at most 1 MiB) within this time while another reply waits
    /// for the same limit. After the same time again, its connection is closed.
    pub reply_timeout: Duration,
    /// The largest chunk of data in one reply message, in bytes. The message also contains a head.
    pub chunk_bytes: usize,
    /// The largest image side in pixels.
    pub frame_side: u32,
    /// Limit on the pixels of one connection in single frames that are not sent completely, and in its frame streams,
    /// which count separately. A further single frame waits, and a further stream is rejected.
    pub connection_pixels: u32,
    /// Limits in bytes on the host memory of all scenes together, and of one scene. `None`: half of the memory of the
    /// machine or its control group, and half of that.
    pub scenes_host_bytes: Option<u64>,
    pub scene_host_bytes: Option<u64>,
    /// As for the host, on the memory of the GPU. Without one, the device memory of a scene counts as host memory.
    pub scenes_device_bytes: Option<u64>,
    pub scene_device_bytes: Option<u64>,
    /// Limit in bytes on the render targets of all frames that are drawn. `None`: a quarter of the memory of the GPU or,
    /// without one, of the host.
    pub render_target_bytes: Option<u64>,
    /// Limit on open scenes, which clients share; see `modalcast::admission`.
    pub open_scenes: usize,
    /// Default window of a step stream: the maximum number of steps without acknowledgment.
    pub window: u32,
    /// Largest window that a client may request.
    pub max_window: u32,
    /// HTTP/2 flow-control window of a stream, in bytes: what a client may send before the server has read it. It
    /// limits a stream to one window per round trip: with 2 MiB and a round trip of 50 ms, to 42 MB/s.
    pub stream_window: u32,
    /// Limit on the total size of one upload, in bytes.
    pub upload_bytes: u64,
    /// Limit in bytes on all uploads, which principals share. Uploads in progress count with their declared size, and open
    /// scenes with the size of their files.
    pub stored_bytes: u64,
    /// Limit on the number of files of one upload.
    pub upload_files: u32,
    /// Deadline of a single request that sets none.
    pub deadline: Duration,
    /// Limit on the time that one piece of work may occupy the device thread. The device is then lost.
    pub device_work_limit: Duration,
    /// Largest deadline of a single request.
    pub max_deadline: Duration,
    /// Limit on the frame, vertex and state streams of one scene, which clients share; see `modalcast::admission`.
    pub max_subscribers: usize,
    /// Limit on the single requests that wait for a step of one scene, which clients share.
    pub max_pending_requests: usize,
    /// How long the lossless readers of a scene may make its writer wait: a budget that is refilled by a tenth of the
    /// elapsed time. Readers that exceed it are disconnected. A writer may ask for another budget.
    pub stall_budget: Duration,
    /// How long an upload may make the server wait: a budget that is refilled by the received bytes.
    pub upload_stall_budget: Duration,
    /// Time for streams to end when the server shuts down.
    pub drain_timeout: Duration,
    /// Limit on open connections, which clients share; see `modalcast::admission`.
    pub connections: usize,
    /// Time within which a new connection must complete its TLS handshake, and then the same time again, within which it
    /// must send the preface of HTTP/2, which is 24 bytes, or the head of a request in HTTP/1.1.
    pub handshake_timeout: Duration,
    /// Time within which a connection must send its first request, from the preface of HTTP/2 or the handshake of a
    /// WebSocket on.
    pub first_request_timeout: Duration,
    /// Time before the answer to a wrong token, which bounds how many tokens one connection can try. A right token is never
    /// delayed, so wrong ones do not lock out other clients.
    pub wrong_token_delay: Duration,
    /// Interval of keepalive pings of HTTP/2 and WebSockets.
    pub keepalive_interval: Duration,
    /// Time within which the client must answer a keepalive ping.
    pub keepalive_timeout: Duration,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            listen: vec![ListenAddress::Tcp((Ipv4Addr::LOCALHOST, 50051).into())],
            shared_memory: None,
            local_sockets: None,
            socket_permissions: SocketPermissions::default(),
            authentication: Authentication::default(),
            principals: None,
            tls: None,
            insecure: false,
            public_url: None,
            admin: None,
            viewer: true,
            viewer_recording: None,
            scenes: None,
            load_options: LoadOptions::default(),
            state: default_state(),
            backend: BackendChoice::Auto,
            cuda_device: 0,
            renderer: RendererChoice::Auto,
            encode: EncodeChoice::Cpu,
            allow_software: true,
            message_bytes: 16 << 20,
            receive_bytes: 128 << 20,
            message_timeout: Duration::from_secs(10),
            connection_reply_bytes: 64 << 20,
            reply_bytes: 256 << 20,
            reply_timeout: Duration::from_secs(10),
            chunk_bytes: 1 << 20,
            frame_side: 8192,
            connection_pixels: 8192 * 8192,
            scenes_host_bytes: None,
            scene_host_bytes: None,
            scenes_device_bytes: None,
            scene_device_bytes: None,
            render_target_bytes: None,
            open_scenes: 16,
            window: 8,
            max_window: 256,
            stream_window: 2 << 20,
            upload_bytes: 4 << 30,
            stored_bytes: 64 << 30,
            upload_files: 4096,
            deadline: Duration::from_secs(30),
            device_work_limit: Duration::from_secs(120),
            max_deadline: Duration::from_secs(600),
            max_subscribers: 32,
            max_pending_requests: 64,
            stall_budget: Duration::from_secs(2),
            upload_stall_budget: Duration::from_secs(30),
            drain_timeout: Duration::from_secs(8),
            connections: 1024,
            handshake_timeout: Duration::from_secs(5),
            first_request_timeout: Duration::from_secs(30),
            wrong_token_delay: Duration::from_millis(500),
            keepalive_interval: Duration::from_secs(10),
            keepalive_timeout: Duration::from_secs(5),
        }
    }
}

/// The folder of the sockets by which programs of this user find its servers: `$XDG_RUNTIME_DIR/modalcast`, else `run`
/// in the default state folder. Clients use the same rule.
pub fn default_local_sockets() -> PathBuf {
    match std::env::var_os("XDG_RUNTIME_DIR").filter(|path| !path.is_empty()) {
        Some(runtime) => PathBuf::from(runtime).join("modalcast"),
        None => default_state().join("run"),
    }
}

/// The default state folder: `$XDG_STATE_HOME/modalcast`, else `~/.local/state/modalcast`, else `modalcast-state` in
/// the working directory.
fn default_state() -> PathBuf {
    let folder = |name: &str| std::env::var_os(name).filter(|path| !path.is_empty()).map(PathBuf::from);
    let state_home = folder("XDG_STATE_HOME").or_else(|| Some(folder("HOME")?.join(".local/state")));
    state_home.map_or_else(|| PathBuf::from("modalcast-state"), |state_home| state_home.join("modalcast"))
}

impl Config {
    /// The file of the server's own token.
    pub fn token_file(&self) -> PathBuf {
        self.state.join("token")
    }

    /// Checks that tokens and data leave this machine only encrypted, or by name.
    fn check_remote_addresses(&self) -> Result<()> {
        if let Some(address) = self.listen.iter().find(|address| address.is_remote()) {
            if self.authentication == Authentication::Off {
                return Err(invalid("config.listen", "a loopback address without authentication", address));
            }
            if self.tls.is_none() && !self.insecure {
                let expected = "a loopback address, TLS (--tls-self-signed or --tls-certificate), or --insecure to send \
                                tokens and data without encryption";
                return Err(invalid("config.listen", expected, address));
            }
        }
        if let Some(address) = self.admin.iter().find(|address| address.is_remote() && !self.insecure) {
            let expected = "a loopback address, or --insecure to let other machines read metrics without a credential";
            return Err(invalid("config.admin", expected, address));
        }
        Ok(())
    }

    /// Returns the configuration if every limit is in its range.
    ///
    /// # Errors
    /// `Invalid` with the field and its range.
    pub fn validated(self) -> Result<ValidatedConfig> {
        let check_range = |field: &str, given: u64, min: u64, max: u64| match (min..=max).contains(&given) {
            true => Ok(()),
            false => Err(invalid(format!("config.{field}"), format!("{min} to {max}"), given)),
        };
        let ms = |duration: Duration| u64::try_from(duration.as_millis()).unwrap_or(u64::MAX);
        const HOUR_MS: u64 = 3_600_000;
        check_range("message_bytes", self.message_bytes as u64, 64 << 10, 1 << 30)?;
        let max_budget = u64::from(u32::MAX);
        check_range("receive_bytes", self.receive_bytes as u64, 2 * self.message_bytes as u64, max_budget)?;
        // The largest reply has 3 MiB. Two fit, so that one unread reply does not block all others.
        let reply_bytes = self.connection_reply_bytes as u64;
        check_range("connection_reply_bytes", reply_bytes, 6 << 20, max_budget)?;
        check_range("reply_bytes", self.reply_bytes as u64, reply_bytes, max_budget)?;
        check_range("message_timeout (ms)", ms(self.message_timeout), 1, HOUR_MS)?;
        check_range("reply_timeout (ms)", ms(self.reply_timeout), 4, HOUR_MS)?;
        check_range("chunk_bytes", self.chunk_bytes as u64, 1 << 10, 1 << 20)?;
        check_range("frame_side", self.frame_side.into(), 1, 16384)?;
        let frame_pixels = u64::from(self.frame_side).pow(2);
        check_range("connection_pixels", self.connection_pixels.into(), frame_pixels, max_budget)?;
        let memory_limits = [
            ("scenes_host_bytes", self.scenes_host_bytes),
            ("scene_host_bytes", self.scene_host_bytes),
            ("scenes_device_bytes", self.scenes_device_bytes),
            ("scene_device_bytes", self.scene_device_bytes),
            ("render_target_bytes", self.render_target_bytes),
        ];
        for (field, bytes) in memory_limits {
            bytes.map_or(Ok(()), |bytes| check_range(field, bytes, 1, 1 << 50))?;
        }
        check_range("open_scenes", self.open_scenes as u64, 1, 4096)?;
        check_range("max_window", self.max_window.into(), 1, 65536)?;
        check_range("window", self.window.into(), 1, self.max_window.into())?;
        check_range("stream_window", self.stream_window.into(), 64 << 10, 4 << 20)?;
        check_range("upload_bytes", self.upload_bytes, 1, 1 << 40)?;
        check_range("stored_bytes", self.stored_bytes, 1, 1 << 50)?;
        check_range("upload_files", self.upload_files.into(), 1, 1 << 20)?;
        check_range("max_subscribers", self.max_subscribers as u64, 1, 4096)?;
        check_range("max_pending_requests", self.max_pending_requests as u64, 1, 65536)?;
        check_range("connections", self.connections as u64, 1, 65536)?;
        check_range("max_deadline (ms)", ms(self.max_deadline), 1, HOUR_MS)?;
        check_range("deadline (ms)", ms(self.deadline), 1, ms(self.max_deadline))?;
        check_range("stall_budget (ms)", ms(self.stall_budget), 1, MAX_STALL_BUDGET.as_millis() as u64)?;
        check_range("upload_stall_budget (ms)", ms(self.upload_stall_budget), 1, HOUR_MS)?;
        check_range("drain_timeout (ms)", ms(self.drain_timeout), 1, HOUR_MS)?;
        check_range("handshake_timeout (ms)", ms(self.handshake_timeout), 1, HOUR_MS)?;
        check_range("first_request_timeout (ms)", ms(self.first_request_timeout), 1, HOUR_MS)?;
        check_range("wrong_token_delay (ms)", ms(self.wrong_token_delay), 1, HOUR_MS)?;
        check_range("keepalive_interval (ms)", ms(self.keepalive_interval), 100, HOUR_MS)?;
        check_range("keepalive_timeout (ms)", ms(self.keepalive_timeout), 100, HOUR_MS)?;
        if self.listen.is_empty() {
            return Err(invalid("config.listen", "at least one address", "none"));
        }
        self.check_remote_addresses()?;
        if self.state.as_os_str().is_empty() {
            return Err(invalid("config.state", "the path of a folder", "an empty path"));
        }
        Ok(ValidatedConfig(self))
    }
}

/// A configuration whose limits are in their ranges, created by [`Config::validated`].
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
    fn default_configuration_is_valid_and_listens_on_loopback() {
        let config = Config::default().validated().expect("expected valid defaults");
        assert!(matches!(config.listen[..], [ListenAddress::Tcp(address)] if address.ip().is_loopback()));
    }

    #[test]
    fn value_out_of_range_is_rejected_with_its_field() {
        let invalid_configs: [(&str, Config); 8] = [
            ("config.listen", Config { listen: Vec::new(), ..Config::default() }),
            ("config.receive_bytes", Config { receive_bytes: 1 << 20, ..Config::default() }),
            ("config.receive_bytes", Config { message_bytes: 128 << 20, ..Config::default() }),
            ("config.chunk_bytes", Config { chunk_bytes: 2 << 20, ..Config::default() }),
            ("config.window", Config { window: 300, ..Config::default() }),
            ("config.frame_side", Config { frame_side: 0, ..Config::default() }),
            ("config.stall_budget (ms)", Config { stall_budget: Duration::ZERO, ..Config::default() }),
            ("config.state", Config { state: PathBuf::new(), ..Config::default() }),
        ];
        for (field, config) in invalid_configs {
            let error = config.validated().expect_err(field).to_string();
            assert!(error.starts_with(field), "expected {field}, got {error}");
        }
    }

    /// Tokens and data leave this machine only encrypted, or by name.
    #[test]
    fn remote_addresses_need_credentials_and_tls_or_insecure() {
        let remote = |text: &str| vec![text.parse::<ListenAddress>().expect(text)];
        let certificate = || ServerCertificate::SelfSigned { names: Vec::new() };
        let tls = || Some(TlsSettings { certificate: certificate(), client_ca: None });
        for address in ["0.0.0.0:1", "[::]:1", "192.0.2.1:1"] {
            let config = || Config { listen: remote(address), ..Config::default() };
            let error = config().validated().expect_err(address).to_string();
            assert!(error.contains("--tls-self-signed") && error.contains("--insecure"), "{error}");
            assert!(Config { tls: tls(), ..config() }.validated().is_ok());
            assert!(Config { insecure: true, ..config() }.validated().is_ok());
            let open = Config { tls: tls(), insecure: true, authentication: Authentication::Off, ..config() };
            assert!(open.validated().is_err(), "expected no server without authentication at {address}");
            let admin = || Config { tls: tls(), admin: remote(address).pop(), ..Config::default() };
            assert!(admin().validated().is_err(), "expected no metrics at {address}");
            assert!(Config { insecure: true, ..admin() }.validated().is_ok());
        }
    }

    #[test]
    fn public_url_has_a_scheme_a_host_and_a_path() {
        for (text, shown) in [
            ("https://lab.example", "https://lab.example"),
            ("https://Lab.example:443/", "https://lab.example"),
            ("http://lab.example:80/a/b/", "http://lab.example/a/b"),
            ("https://lab.example:80", "https://lab.example:80"),
            ("https://[2001:db8::1]:8443/a", "https://[2001:db8::1]:8443/a"),
        ] {
            assert_eq!(text.parse::<PublicUrl>().map(|url| url.to_string()).as_deref(), Ok(shown));
        }
        for text in [
            "",
            "lab.example",
            "ftp://lab.example",
            "https://",
            "https:///a",
            "https://a@b",
            "https://a/?b",
            "https://a;b",
        ] {
            assert!(text.parse::<PublicUrl>().is_err(), "{text}");
        }
    }

    #[test]
    fn listen_address_is_a_socket_address_or_a_path() {
        for text in ["127.0.0.1:50051", "[::1]:0", "unix:/run/modalcast.sock"] {
            let address: ListenAddress = text.parse().expect(text);
            assert_eq!(address.to_string(), text);
        }
        assert_eq!("unix:a b".parse(), Ok(ListenAddress::Unix("a b".into())));
        for text in ["unix:", "", "127.0.0.1", "/run/modalcast.sock"] {
            assert!(text.parse::<ListenAddress>().is_err(), "{text}");
        }
    }
}
