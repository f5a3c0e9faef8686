//! A server in its own process with one open scene, and a client of it.

use std::cell::OnceCell;
use std::ffi::OsString;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::time::Duration;

use modalcast_client::{Client, SceneInfo, ServerInfo, TOKEN_FILE_VARIABLE};
use serde::Serialize;
use serde_json::Value;
use tempfile::TempDir;
use tokio::runtime::Runtime;

use super::grid;
use super::motion::Motion;
use super::processes::{Process, Program, arguments};
use super::{QUICK_DIVISOR, SCENE, StreamReportOptions, peers, skeletons};
use crate::workloads::Size;
use modalcast::config::Config;
use modalcast_model::backend_settings::LookTable;
use modalcast_model::error::{Error, Result, fault_in};
use modalcast_model::load::{self, OpenedScene};
use modalcast_model::scene::{FrameAntialiasing, RenderSettings, RendererKind};

/// Longest time in which a failed server exits after its connections have ended.
const SERVER_END: Duration = Duration::from_secs(1);

/// The scene of a case.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum SceneSource {
    /// The built-in tree.
    Tree,
    /// A scene in the folder `--scenes`.
    Repository(&'static str),
    /// A generated plant with the counts of a row of table 4.5 of the thesis, counted from 0.
    Skeleton(usize),
    /// A generated grid ([`grid`]), which is not drawn.
    Grid,
}

/// The backend of a server.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum ServerBackend {
    /// The one that the server selects on this machine.
    Default,
    Cpu,
}

impl SceneSource {
    pub(super) const ALMOND: Self = Self::Repository("plants/almond");
    pub(super) const BEAN: Self = Self::Repository("plants/bean");
    pub(super) const BRIDGE: Self = Self::Repository("vega/simpleBridge");

    /// The name that clients open.
    pub(super) const fn name(self) -> &'static str {
        match self {
            Self::Tree => "tree",
            Self::Repository(path) => path,
            Self::Skeleton(index) => skeletons::FILES[index],
            Self::Grid => grid::NAME,
        }
    }
}

/// The look of a scene, from its settings.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SceneLook {
    /// The table `look` of the scene with all defaults.
    pub look: Value,
    /// Samples per pixel.
    pub samples: u32,
    /// Side of the shadow map in texels; `None` without shadows.
    pub shadow_map: Option<u32>,
}

impl SceneLook {
    /// The look with which a server draws frames of `pixels` pixels.
    fn of(source: &str, renderer: RendererKind, pixels: u64) -> Result<Self> {
        let OpenedScene { scene, backends } = load::open(source)?;
        let antialiasing = scene.look.frame_antialiasing(renderer, scene.layout.triangles, pixels, None);
        let FrameAntialiasing { method: antialias, samples } = antialiasing;
        let settings = RenderSettings { antialias, samples, ..scene.look.with_shadow_map_for(renderer) };
        Ok(Self {
            look: serde_json::to_value(LookTable { settings, raster: backends.raster }).map_err(fault_in("report"))?,
            samples,
            shadow_map: settings.shadow.map(|shadow| shadow.size),
        })
    }

    /// The choices that determine the cost of a frame, in one line.
    pub fn line(&self) -> String {
        let text = |pointer: &str| match self.look.pointer(pointer) {
            Some(Value::String(text)) => text.clone(),
            Some(other) => other.to_string(),
            None => "none".into(),
        };
        let shadow = self.shadow_map.map_or("no shadows".into(), |size| {
            format!("{} shadow map of {size}x{size} fitted to {}", text("/shadow/method"), text("/shadow/fit"))
        });
        format!("{}, antialias {}, raster {}", shadow, text("/antialias"), text("/raster"))
    }
}

/// A running server with one open scene.
pub(super) struct Session {
    pub(super) source: SceneSource,
    pub(super) backend: ServerBackend,
    pub(super) runtime: Runtime,
    pub(super) client: Client,
    pub(super) server_info: ServerInfo,
    pub(super) scene_info: SceneInfo,
    /// `None` for a scene that is not drawn.
    pub(super) look: Option<SceneLook>,
    pub(super) address: SocketAddr,
    /// The folder of the scene, for the option `--files` of `modalcast-sim`.
    files: PathBuf,
    /// Steps per second of the physics process, if the server does not slow it down.
    pub(super) physics_per_second: OnceCell<f64>,
    /// Steps to send without computing them.
    motion: OnceCell<Motion>,
    server: Process,
    /// The server's state, recorded motion, and generated scenes.
    work: TempDir,
}

impl Session {
    /// Starts a server and opens the scene.
    ///
    /// # Errors
    /// `Fault` when the server fails; errors of loading the scene.
    pub(super) fn open(source: SceneSource, backend: ServerBackend, options: &StreamReportOptions) -> Result<Self> {
        let work = create_work_folder()?;
        // The path of a scene that is drawn.
        let (repository, drawn_scene) = match source {
            SceneSource::Tree => (options.scenes.clone(), Some(PathBuf::from(source.name()))),
            SceneSource::Repository(path) => {
                let folder = options.scenes.clone().unwrap_or_default();
                let path = folder.join(path);
                (Some(folder), Some(path))
            }
            SceneSource::Skeleton(index) => {
                skeletons::write(work.path(), index, options.size)?;
                (Some(work.path().to_owned()), Some(work.path().join(source.name())))
            }
            SceneSource::Grid => {
                grid::write(work.path(), grid::side(options.size))?;
                (Some(work.path().to_owned()), None)
            }
        };
        let mut server = start_server(work.path(), repository.as_deref(), drawn_scene.is_some(), backend)?;
        let url = server.wait_for("listening on ")?;
        let address = url.trim_start_matches("http://").parse().map_err(fault_in("report"))?;
        let runtime = peers::start_runtime()?;
        let opened = runtime.block_on(async {
            let client = Client::connect(&url).await?;
            let (server_info, scene_info) =
                (client.server_info().await?, client.open_scene(source.name(), SCENE).await?);
            modalcast_client::Result::Ok((client, server_info, scene_info))
        });
        let (client, server_info, scene_info) =
            opened.map_err(|error: modalcast_client::Error| server.failure(&error.to_string()))?;
        let renderer = if server_info.is_software_renderer { RendererKind::Software } else { RendererKind::Hardware };
        // The look of the largest pictures.
        let divisor = if options.size == Size::Quick { QUICK_DIVISOR } else { 1 };
        let pixels = u64::from(1920 / divisor) * u64::from(1080 / divisor);
        let look = drawn_scene.map(|path| SceneLook::of(&path.to_string_lossy(), renderer, pixels)).transpose()?;
        Ok(Self {
            source,
            backend,
            runtime,
            client,
            server_info,
            scene_info,
            look,
            address,
            files: repository.unwrap_or_default().join(source.name()),
            physics_per_second: OnceCell::new(),
            motion: OnceCell::new(),
            server,
            work,
        })
    }

    /// The path or built-in name of the scene in this process.
    pub(super) fn path(&self) -> String {
        match self.source {
            SceneSource::Tree => self.source.name().to_owned(),
            SceneSource::Repository(_) | SceneSource::Skeleton(_) | SceneSource::Grid => {
                self.files.to_string_lossy().into_owned()
            }
        }
    }

    /// The folder with the recording of [`Self::motion`].
    pub(super) fn recording(&self) -> PathBuf {
        self.work.path().join("record")
    }

    /// The URL of the server.
    pub(super) fn url(&self) -> String {
        format!("http://{}", self.address)
    }

    /// The URL of the server's Unix socket.
    pub(super) fn unix_url(&self) -> String {
        format!("unix:{}", unix_socket(self.work.path()).display())
    }

    /// The server's socket for shared memory.
    pub(super) fn shared_memory(&self) -> PathBuf {
        shared_memory_socket(self.work.path())
    }

    /// Ends the session after an error of a case. If the server has ended, the error also contains its standard error.
    pub(super) fn explain(mut self, error: Error) -> Error {
        if self.server.ends_within(SERVER_END) { self.server.failure(&error.to_string()) } else { error }
    }

    /// Starts `modalcast-sim` with further options.
    ///
    /// # Errors
    /// Those of [`Process::start`].
    pub(super) fn start_physics(&self, steps: u64, further_options: &[OsString]) -> Result<Process> {
        let (url, steps) = (self.url(), steps.to_string());
        let mut list = arguments([&"--server", &url, &"--scene", &SCENE, &"--steps", &steps, &"--json"]);
        list.extend(arguments([&"--files", &self.files]));
        list.extend_from_slice(further_options);
        Process::start(Program::Physics, &list)
    }

    /// Steps to send from memory: recorded ones of `modalcast-sim`, or generated ones for the grid.
    ///
    /// # Errors
    /// `Fault` when the recording fails.
    pub(super) fn motion(&self, steps: u64) -> Result<&Motion> {
        if let Some(motion) = self.motion.get() {
            return Ok(motion);
        }
        let description = self.runtime.block_on(self.client.describe(SCENE, &[])).map_err(fault_in("report"))?;
        let motion = match self.source {
            SceneSource::Grid => Motion::oscillation(&description, steps),
            SceneSource::Tree | SceneSource::Repository(_) | SceneSource::Skeleton(_) => {
                let folder = self.recording();
                self.start_physics(steps, &arguments([&"--record", &folder]))?.finish::<Value>()?;
                Motion::read(&folder, &description)?
            }
        };
        Ok(self.motion.get_or_init(|| motion))
    }
}

/// A folder in memory if the machine has one, because the server writes its state there.
fn create_work_folder() -> Result<TempDir> {
    let memory = Path::new("/dev/shm");
    let in_memory = memory.is_dir().then(|| tempfile::tempdir_in(memory)).and_then(std::io::Result::ok);
    in_memory.map_or_else(tempfile::tempdir, Ok).map_err(fault_in("report"))
}

fn unix_socket(work: &Path) -> PathBuf {
    work.join("server.sock")
}

fn shared_memory_socket(work: &Path) -> PathBuf {
    work.join("memory.sock")
}

fn start_server(work: &Path, repository: Option<&Path>, draws: bool, backend: ServerBackend) -> Result<Process> {
    let state = work.join("state");
    let unix_address = format!("unix:{}", unix_socket(work).display());
    let mut list = arguments([&"serve", &"--listen", &"127.0.0.1:0", &"--listen", &unix_address, &"--state", &state]);
    match std::env::var_os(TOKEN_FILE_VARIABLE) {
        Some(token_file) => copy_token(Path::new(&token_file), &state)?,
        // With authentication, clients without a token would use the Unix socket in place of TCP.
        None => list.extend(arguments([&"--no-auth"])),
    }
    list.extend(arguments([&"--shared-memory", &shared_memory_socket(work)]));
    if let Some(repository) = repository {
        list.extend(arguments([&"--scenes", &repository]));
    }
    if backend == ServerBackend::Cpu {
        list.extend(arguments([&"--backend", &"cpu"]));
    }
    if !draws {
        list.extend(arguments([&"--renderer", &"off"]));
    }
    Process::start(Program::Server, &list)
}

/// Lets the server accept the token that the clients of the report read from a file.
fn copy_token(token_file: &Path, state: &Path) -> Result<()> {
    let own_file = Config { state: state.to_owned(), ..Config::default() }.token_file();
    std::fs::create_dir_all(state).map_err(fault_in("report"))?;
    std::fs::copy(token_file, own_file).map_err(fault_in("report"))?;
    Ok(())
}
