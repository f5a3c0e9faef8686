//! `modalcast serve`: runs the server until it receives SIGTERM or Ctrl-C.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use tokio::signal::unix::{Signal, SignalKind, signal};

use super::tls_options::TlsOptions;
use super::{Completion, Outcome, print_line};
use crate::config::{
    Authentication, BackendChoice, Config, EncodeChoice, ListenAddress, PublicUrl, RendererChoice, SocketPermissions,
    ValidatedConfig, default_local_sockets,
};
use crate::engine::{Engine, EngineInfo};
use crate::service::{self, Listener};
use modalcast_model::error::{Result, fault_in};
use modalcast_model::load::{LoadOptions, SceneRepository};

/// Serves scenes over gRPC until SIGTERM or Ctrl-C, then ends open streams and exits.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  modalcast serve                                   built-in scenes, for clients on this machine
  modalcast serve --scenes ~/scenes                 also the scenes of a folder
  modalcast serve --listen 0.0.0.0:50051 --tls-self-signed
                                                    also for clients on other machines, encrypted, with the token
  modalcast serve --listen unix:/run/user/1000/modalcast.sock
  modalcast serve --backend cpu --renderer software without a GPU")]
pub(super) struct Args {
    /// Addresses to listen on: IP:PORT, where port 0 selects a free port, or unix:PATH for a socket that only this user
    /// can connect to. The option can be repeated. Each address is printed as 'listening on URL'.
    #[arg(long, env = "MODALCAST_LISTEN", value_delimiter = ',', default_values_t = Config::default().listen)]
    listen: Vec<ListenAddress>,
    /// Path of a further Unix socket at which programs of this user ask for shared memory, in which they send steps and
    /// receive vertices, frames and views. A server with credentials always has such a socket for each TCP port.
    #[arg(long, env = "MODALCAST_SHARED_MEMORY", value_name = "PATH")]
    shared_memory: Option<PathBuf>,
    /// TOML file that names further users of the server, with their roles and credentials. It is read again when it changes.
    /// Without it, only this user is admitted: over the Unix socket that the server opens beside each TCP port, and elsewhere
    /// with the token in the file 'token' of the state folder.
    #[arg(long, env = "MODALCAST_PRINCIPALS", value_name = "FILE")]
    principals: Option<PathBuf>,
    /// Permission bits in octal of the Unix sockets of --listen, for example 660. Who can write to a socket can connect to it,
    /// and is then identified by the file of --principals.
    #[arg(long, value_name = "MODE", default_value = "600", value_parser = parse_socket_mode)]
    socket_mode: u32,
    /// Group of the Unix sockets of --listen: a name or a number.
    #[arg(long, value_name = "GROUP", value_parser = parse_group)]
    socket_group: Option<u32>,
    /// Do not identify users by their account: programs of this user need the token, too. For accounts that several people
    /// share.
    #[arg(long)]
    tokens_only: bool,
    /// Admit everybody who can connect, with all rights. Only for addresses of this machine: every program on it can then
    /// stop, change and delete everything.
    #[arg(long, conflicts_with_all = ["principals", "tokens_only"])]
    no_auth: bool,
    #[command(flatten)]
    tls: TlsOptions,
    /// Allow addresses that other machines can connect to without encryption: everybody on the way can read tokens and data.
    #[arg(long)]
    insecure: bool,
    /// URL at which browsers reach this server behind a proxy, such as https://lab.example/render. Its host and origin are
    /// accepted, and the printed links begin with it.
    #[arg(long, env = "MODALCAST_PUBLIC_URL", value_name = "URL")]
    public_url: Option<PublicUrl>,
    /// Address of health, readiness and metrics over HTTP, without credentials: IP:PORT or unix:PATH. Default: off.
    #[arg(long, env = "MODALCAST_ADMIN", value_name = "ADDRESS")]
    admin: Option<ListenAddress>,
    /// Do not serve browsers: neither the viewer nor the WebSocket.
    #[arg(long)]
    no_viewer: bool,
    /// Folder of scenes that clients may open. Files outside it are never read.
    #[arg(long, env = "MODALCAST_SCENES")]
    scenes: Option<PathBuf>,
    /// For all scenes, also uploads: treat missing material libraries, materials and images, images of unsupported formats,
    /// and values out of range, not finite or not understood, as errors instead of remarks.
    #[arg(long)]
    strict: bool,
    /// Folder for uploads, the list of open scenes and their last steps. Default: the user's XDG state folder.
    #[arg(long, env = "MODALCAST_STATE")]
    state: Option<PathBuf>,
    /// Deformation backend.
    #[arg(long, value_enum, default_value_t)]
    backend: BackendChoice,
    /// CUDA device ordinal.
    #[arg(long, default_value_t = 0)]
    cuda_device: usize,
    /// OpenGL renderer.
    #[arg(long, value_enum, default_value_t)]
    renderer: RendererChoice,
    /// Device that encodes PNG frames of streams. CUDA encodes only if it shares pictures with OpenGL.
    #[arg(long, env = "MODALCAST_ENCODE", value_enum, default_value_t)]
    encode: EncodeChoice,
    /// Do not draw frames with a software renderer.
    #[arg(long)]
    hardware_only: bool,
    /// Largest accepted message, in bytes.
    #[arg(long, default_value_t = Config::default().message_bytes)]
    message_bytes: usize,
    /// Limit on the messages that all clients are sending, in bytes. A single client leaves a quarter for others. At the
    /// limit, the client that holds the most loses its incomplete messages. Default: 128 MiB, and at least twice the largest
    /// message.
    #[arg(long)]
    receive_bytes: Option<usize>,
    /// Longest time without progress of an incomplete message, in milliseconds.
    #[arg(long, default_value_t = default_ms(Config::default().message_timeout))]
    message_timeout_ms: u64,
    /// Limit on the unsent replies of one connection, in bytes.
    #[arg(long, default_value_t = Config::default().connection_reply_bytes)]
    connection_reply_bytes: usize,
    /// Limit on the unsent replies of all connections, in bytes.
    #[arg(long, default_value_t = Config::default().reply_bytes)]
    reply_bytes: usize,
    /// Time in milliseconds after which a client that reads nothing is disconnected, if other replies wait.
    #[arg(long, default_value_t = default_ms(Config::default().reply_timeout))]
    reply_timeout_ms: u64,
    /// Largest side of a frame, in pixels.
    #[arg(long, default_value_t = Config::default().frame_side)]
    frame_side: u32,
    /// Limit on the pixels that one connection requests at a time: in single frames until they are sent, and in its
    /// open frame streams. Default: 8192 x 8192, and at least the largest frame.
    #[arg(long)]
    connection_pixels: Option<u32>,
    /// Limit on open connections. Above it, each new one ends the one with the least progress of the principal and the client
    /// that hold the most.
    #[arg(long, default_value_t = Config::default().connections)]
    connections: usize,
    /// Limit on the host memory of all scenes, in bytes. Default: half of the memory of the machine or its control group.
    #[arg(long, value_name = "BYTES")]
    scenes_host_bytes: Option<u64>,
    /// Limit on the host memory of one scene, in bytes. Default: half of that of all scenes.
    #[arg(long, value_name = "BYTES")]
    scene_host_bytes: Option<u64>,
    /// Limit on the GPU memory of all scenes, in bytes. Default: half of the memory. Without a GPU, scenes have only host
    /// memory.
    #[arg(long, value_name = "BYTES")]
    scenes_device_bytes: Option<u64>,
    /// Limit on the GPU memory of one scene, in bytes. Default: half of that of all scenes.
    #[arg(long, value_name = "BYTES")]
    scene_device_bytes: Option<u64>,
    /// Limit on the render targets of all frames that are drawn, in bytes. Default: a quarter of the memory of the GPU or,
    /// without one, of the host.
    #[arg(long, value_name = "BYTES")]
    render_target_bytes: Option<u64>,
    /// Limit on open scenes.
    #[arg(long, default_value_t = Config::default().open_scenes)]
    open_scenes: usize,
    /// Default window of a step stream: how many steps may be unacknowledged.
    #[arg(long, default_value_t = Config::default().window)]
    window: u32,
    /// Stall budget of a scene, in milliseconds: how long lossless readers may make the writer wait. It is refilled by a
    /// tenth of the elapsed time. Readers that exceed it are disconnected (REASON_SLOW_READER), the slowest one first. A
    /// writer may ask for another budget (modalcast-sim --stall-budget).
    #[arg(long, default_value_t = default_ms(Config::default().stall_budget))]
    stall_budget_ms: u64,
    /// Largest upload of one scene, in bytes.
    #[arg(long, default_value_t = Config::default().upload_bytes)]
    upload_bytes: u64,
    /// Limit on all uploads on disk, in bytes. A single principal leaves a quarter for others.
    #[arg(long, default_value_t = Config::default().stored_bytes)]
    stored_bytes: u64,
    /// Deadline of a request that sets none, in milliseconds.
    #[arg(long, default_value_t = 30_000, value_parser = clap::value_parser!(u64).range(1..=600_000))]
    deadline_ms: u64,
    /// Time in milliseconds after which a device that does not answer is lost, and the server ends with exit code 7.
    #[arg(long, default_value_t = default_ms(Config::default().device_work_limit), value_parser = clap::value_parser!(u64).range(100..=3_600_000))]
    device_work_limit_ms: u64,
}

fn default_ms(duration: Duration) -> u64 {
    duration.as_millis() as u64
}

impl Args {
    const fn authentication(&self) -> Authentication {
        match (self.no_auth, self.tokens_only) {
            (true, _) => Authentication::Off,
            (false, true) => Authentication::Tokens,
            (false, false) => Authentication::UsersAndTokens,
        }
    }

    fn config(&self) -> Result<ValidatedConfig> {
        let defaults = Config::default();
        Config {
            listen: self.listen.clone(),
            shared_memory: self.shared_memory.clone(),
            // Without authentication, clients need no other address than that of TCP.
            local_sockets: (!self.no_auth).then(default_local_sockets),
            socket_permissions: SocketPermissions { mode: self.socket_mode, group: self.socket_group },
            authentication: self.authentication(),
            principals: self.principals.clone(),
            tls: self.tls.settings(),
            insecure: self.insecure,
            public_url: self.public_url.clone(),
            admin: self.admin.clone(),
            viewer: !self.no_viewer,
            scenes: self.scenes.clone(),
            load_options: LoadOptions { is_strict: self.strict, ..LoadOptions::default() },
            state: self.state.clone().unwrap_or(defaults.state),
            backend: self.backend,
            cuda_device: self.cuda_device,
            renderer: self.renderer,
            encode: self.encode,
            allow_software: !self.hardware_only,
            message_bytes: self.message_bytes,
            receive_bytes: self.receive_bytes.unwrap_or_else(|| defaults.receive_bytes.max(2 * self.message_bytes)),
            message_timeout: Duration::from_millis(self.message_timeout_ms),
            connection_reply_bytes: self.connection_reply_bytes,
            reply_bytes: self.reply_bytes,
            reply_timeout: Duration::from_millis(self.reply_timeout_ms),
            frame_side: self.frame_side,
            connection_pixels: self
                .connection_pixels
                .unwrap_or_else(|| defaults.connection_pixels.max(self.frame_side.saturating_pow(2))),
            connections: self.connections,
            scenes_host_bytes: self.scenes_host_bytes,
            scene_host_bytes: self.scene_host_bytes,
            scenes_device_bytes: self.scenes_device_bytes,
            scene_device_bytes: self.scene_device_bytes,
            render_target_bytes: self.render_target_bytes,
            open_scenes: self.open_scenes,
            window: self.window,
            // The default window must not exceed the largest window that a client may request.
            max_window: defaults.max_window.max(self.window),
            stall_budget: Duration::from_millis(self.stall_budget_ms),
            upload_bytes: self.upload_bytes,
            stored_bytes: self.stored_bytes,
            deadline: Duration::from_millis(self.deadline_ms),
            device_work_limit: Duration::from_millis(self.device_work_limit_ms),
            ..Config::default()
        }
        .validated()
    }
}

pub(super) fn run(args: &Args) -> Outcome {
    let config = args.config()?;
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build().map_err(fault_in("serve"))?;
    let result = runtime.block_on(serve(config));
    // A scene that is being read or a frame that is being drawn must not delay the exit. The state is on disk.
    runtime.shutdown_background();
    result.map(|()| Completion::Success)
}

async fn serve(config: ValidatedConfig) -> Result<()> {
    let mut signals = TerminationSignals::install()?;
    let (engine, listener) = tokio::select! {
        started = start(config) => started?,
        () = signals.received() => return Ok(()),
    };
    announce(&engine, &listener)?;
    service::serve(engine, listener, async move { signals.received().await }).await
}

/// Binds the addresses and opens the devices.
pub(super) async fn start(config: ValidatedConfig) -> Result<(Engine, Listener)> {
    let repository = SceneRepository::new(config.scenes.as_deref())?.with_options(config.load_options);
    // Bind before scenes are loaded, so that a second server on the same address fails immediately.
    let listener = service::bind(&config).await?;
    let engine = Engine::start(config, Arc::new(repository)).await?;
    Ok((engine, listener))
}

fn parse_socket_mode(text: &str) -> Result<u32, String> {
    let mode = u32::from_str_radix(text, 8).ok().filter(|mode| *mode <= 0o777);
    mode.ok_or_else(|| "expected octal permission bits up to 777".into())
}

/// The id of a group, by its number or its name in `/etc/group`.
fn parse_group(text: &str) -> Result<u32, String> {
    let by_name = || {
        let groups = std::fs::read_to_string("/etc/group").ok()?;
        let id_of = |line: &str| line.strip_prefix(text)?.strip_prefix(':')?.split(':').nth(1)?.parse().ok();
        groups.lines().find_map(id_of)
    };
    text.parse().ok().or_else(by_name).ok_or_else(|| "expected a number, or the name of a group in /etc/group".into())
}

/// Logs the devices and prints the addresses.
///
/// # Errors
/// As for [`print_addresses`].
pub(super) fn announce(engine: &Engine, listener: &Listener) -> Result<()> {
    log_devices(engine.info());
    log_authentication(engine.config());
    print_addresses(listener)
}

/// Logs how clients are admitted.
fn log_authentication(config: &Config) {
    let token_file = config.token_file();
    match config.authentication {
        Authentication::Off => tracing::warn!("no authentication: everybody who can connect may do everything"),
        Authentication::Tokens => tracing::info!("clients need a token, as in {}", token_file.display()),
        Authentication::UsersAndTokens => {
            tracing::info!("clients of other users and machines need a token, as in {}", token_file.display());
        }
    }
}

/// Prints the addresses, links to the viewer, and the certificate if it is self-signed. Warns about plain addresses that
/// other machines can connect to.
///
/// # Errors
/// `Fault` when the system has no random numbers.
pub(super) fn print_addresses(listener: &Listener) -> Result<()> {
    for address in listener.remote_addresses().filter(|_| !listener.is_encrypted()) {
        tracing::warn!("{address} accepts clients on other machines, and encrypts nothing");
    }
    for url in listener.urls() {
        print_line(format!("listening on {url}"));
    }
    if let Some((file, fingerprint)) = listener.self_signed_certificate() {
        print_line(format!("certificate {}, SHA-256 {fingerprint}", file.display()));
    }
    if let Some(url) = listener.admin_url() {
        print_line(format!("health and metrics at {url}"));
    }
    for url in listener.viewer_urls() {
        print_line(format!("viewer at {}", listener.viewer_link(&url)?));
    }
    for url in listener.remote_viewer_urls() {
        print_line(format!("viewer from another machine at {}", listener.viewer_link(&url)?));
    }
    for command in tunnel_commands(listener) {
        print_line(format!("viewer from another machine: run '{command}' there, then open this URL"));
    }
    Ok(())
}

/// The commands that make the viewer available on another machine through SSH. There are none unless the user has
/// logged in through SSH, or the server accepts clients of other machines without encryption.
fn tunnel_commands(listener: &Listener) -> Vec<String> {
    if !listener.remote_viewer_urls().is_empty() {
        return Vec::new();
    }
    let ssh_address = std::env::var("SSH_CONNECTION").ok().and_then(|text| server_of_ssh_connection(&text));
    if ssh_address.is_none() && listener.remote_addresses().next().is_none() {
        return Vec::new();
    }
    let host = ssh_address.or_else(service::host_name).unwrap_or_else(|| "HOST".into());
    let command = |address: SocketAddr| format!("ssh -N -L {}:{address} {host}", address.port());
    listener.viewer_addresses().map(command).collect()
}

/// The server's address in `SSH_CONNECTION`, which has the client's address and port and then the server's.
fn server_of_ssh_connection(text: &str) -> Option<String> {
    text.split(' ').nth(2).filter(|address| !address.is_empty()).map(str::to_owned)
}

/// Logs the backend and the renderer. Warns about a software renderer.
fn log_devices(info: &EngineInfo) {
    tracing::info!("deforming on {} ({})", info.backend.name(), info.device);
    match &info.renderer {
        Ok(renderer) if renderer.software => tracing::warn!("drawing on the CPU: {}", renderer.renderer),
        Ok(renderer) => tracing::info!("drawing on {}; pixels leave {}", renderer.renderer, renderer.pixel_readback),
        Err(error) => tracing::warn!("no frames can be drawn: {error}"),
    }
}

/// Ctrl-C and SIGTERM. Signals that arrive after the installation and before a call of [`Self::received`] are not lost.
pub(super) struct TerminationSignals {
    interrupt: Signal,
    terminate: Signal,
}

impl TerminationSignals {
    pub(super) fn install() -> Result<Self> {
        let install = |kind| signal(kind).map_err(fault_in("signal handlers"));
        Ok(Self { interrupt: install(SignalKind::interrupt())?, terminate: install(SignalKind::terminate())? })
    }

    /// Waits for one of the signals.
    pub(super) async fn received(&mut self) {
        tokio::select! {
            _ = self.interrupt.recv() => {}
            _ = self.terminate.recv() => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn socket_mode_is_octal_and_groups_have_names_or_numbers() {
        assert_eq!(parse_socket_mode("660"), Ok(0o660));
        for text in ["", "8", "1777", "-1", "rw"] {
            assert!(parse_socket_mode(text).is_err(), "{text}");
        }
        assert_eq!((parse_group("root"), parse_group("65534")), (Ok(0), Ok(65534)));
        for text in ["", "no such group", "-1", "root:x"] {
            assert!(parse_group(text).is_err(), "{text}");
        }
    }

    #[test]
    fn tunnel_leads_to_the_address_of_the_ssh_connection() {
        let server = server_of_ssh_connection("192.0.2.1 50000 192.0.2.7 22");
        assert_eq!(server.as_deref(), Some("192.0.2.7"));
        assert_eq!(server_of_ssh_connection("192.0.2.1 50000"), None);
    }
}
