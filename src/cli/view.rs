//! `modalcast view`: runs a server with one scene, or with a recording, and opens its viewer in the browser.

use std::fs::OpenOptions;
use std::io::Write as _;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::os::unix::fs::OpenOptionsExt as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use tokio::sync::oneshot;

use super::computed_modes::{self, Computed};
use super::demo::{ForceFiles, SceneLocation, program_path};
use super::loading_options::LoadingOptions;
use super::modeling_options::ModelingOptions;
use super::physics::PhysicsProcess;
use super::serve::{TerminationSignals, announce, print_addresses, start};
use super::tls_options::TlsOptions;
use super::{Completion, Outcome, print_line, recording};
use crate::admission::Client;
use crate::config::{
    BackendChoice, Config, ListenAddress, RendererChoice, ValidatedConfig, ViewerRecording, default_local_sockets,
};
use crate::identity::Principal;
use crate::service::{self, Listener};
use modalcast_model::error::{Result, fault, fault_in, invalid};
use modalcast_model::load::{self, LoadOptions};

/// The program that opens a URL in the user's browser (xdg-utils).
const URL_OPENER: &str = "xdg-open";

/// The physics process, in the folder of this program.
const PHYSICS_PROGRAM: &str = "modalcast-sim";

/// Shows a model or a recording in the browser. Runs a server for it until Ctrl-C.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  modalcast view tree
  modalcast view path/to/simpleBridge --no-sim
  modalcast view part.stl --unit mm --up y
  modalcast view part.stl --modes 20 --material steel --clamp 'z < 0.01'
  modalcast view part.msh --unit mm                 a volume mesh, whose modes are computed
  modalcast view fork.npz --slow 500                pulled, and seen in slower motion than by default
  modalcast view tree.mcap                          plays a recording
  modalcast view model.glb --listen 0.0.0.0:50051 --tls-self-signed   also for browsers on other machines")]
pub(super) struct Args {
    /// A built-in name, a folder with scene.toml, a .glb, .gltf, .obj, .ply, .stl, .npz or
    /// .structure.json file, a folder with one model, a volume mesh (.msh, .vtk, .vtu or .veg), whose modes are
    /// computed, or a recording: an .mcap file, which the browser plays.
    model: String,
    /// Address to listen on: IP:PORT, where port 0 selects a free port.
    #[arg(long, default_value_t = SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 0))]
    listen: SocketAddr,
    #[command(flatten)]
    tls: TlsOptions,
    /// Allow an address that other machines can connect to without encryption: everybody on the way can read tokens and
    /// data.
    #[arg(long)]
    insecure: bool,
    /// Print the URL and do not open a browser.
    #[arg(long)]
    no_open: bool,
    /// Move the scene with the physics process `modalcast-sim --forces`, so that viewers can pull on the scene. A
    /// scene with neither eigenvalues nor cubic forces stays at rest. Default: on if the program is in the folder of
    /// this one.
    #[arg(long, overrides_with = "no_sim")]
    sim: bool,
    /// Slow motion: the physics process simulates 1/FACTOR of the real time, because a body of metal vibrates too fast to
    /// be seen. Default: the lowest frequency of the scene decides, and 1 up to 5 Hz. For a recording: the speed at which
    /// it is played first is 1/FACTOR; default 1.
    #[arg(long, value_name = "FACTOR", value_parser = parse_factor)]
    slow: Option<f64>,
    /// Show the scene at rest, until another process drives it.
    #[arg(long)]
    no_sim: bool,
    /// Deformation backend.
    #[arg(long, value_enum, default_value_t)]
    backend: BackendChoice,
    /// OpenGL renderer.
    #[arg(long, value_enum, default_value_t)]
    renderer: RendererChoice,
    #[command(flatten)]
    loading: LoadingOptions,
    /// Any of these options computes the modes of the model, whose own modes are not used. The result is kept in the
    /// user's cache folder.
    #[command(flatten)]
    modeling: ModelingOptions,
}

impl Args {
    /// Whether modes are computed: options of the computation are given, or the model is a volume mesh, which nothing else
    /// opens.
    fn computes_modes(&self) -> bool {
        self.modeling.is_requested() || load::is_volume_mesh(&self.model)
    }

    /// The model to show: the given one or, if its modes are computed, a file with them.
    async fn model(&self) -> Result<Computed> {
        match self.computes_modes() {
            true => computed_modes::compute(&self.model, &self.loading, &self.modeling).await,
            false => Ok(Computed::File(self.model.clone().into())),
        }
    }

    /// The options with which the server opens its scenes.
    fn load_options(&self) -> LoadOptions {
        let options = self.loading.load_options();
        match self.computes_modes() {
            // The file with computed modes is in meters, and Z is up.
            true => LoadOptions { unit: None, up: None, ..options },
            false => options,
        }
    }

    fn config(&self, location: &SceneLocation, state: &Path) -> Result<ValidatedConfig> {
        Config {
            listen: vec![ListenAddress::Tcp(self.listen)],
            local_sockets: Some(default_local_sockets()),
            tls: self.tls.settings(),
            insecure: self.insecure,
            scenes: location.repository.clone(),
            load_options: self.load_options(),
            state: state.to_owned(),
            backend: self.backend,
            renderer: self.renderer,
            ..Config::default()
        }
        .validated()
    }

    /// The configuration of a server whose page plays the recording. It opens no scene and needs no GPU.
    fn playback_config(&self, state: &Path) -> Result<ValidatedConfig> {
        Config {
            listen: vec![ListenAddress::Tcp(self.listen)],
            local_sockets: Some(default_local_sockets()),
            tls: self.tls.settings(),
            insecure: self.insecure,
            viewer_recording: Some(ViewerRecording {
                file: recording::read(&self.model)?,
                slow: self.slow.unwrap_or(1.0),
            }),
            state: state.to_owned(),
            backend: BackendChoice::Cpu,
            renderer: RendererChoice::Off,
            ..Config::default()
        }
        .validated()
    }

    /// Prints the link, and opens it in the browser unless the user works on another machine.
    fn show(&self, link: &str, state: &Path) {
        print_line(format!("open {link}"));
        if !self.no_open
            && std::env::var_os("SSH_CONNECTION").is_none()
            && let Err(error) = open_browser(link, state)
        {
            tracing::info!(%error, "no browser was opened");
        }
    }

    /// The physics program, if the scene is to be moved.
    ///
    /// # Errors
    /// `Unavailable` when `--sim` is given and the program does not exist.
    fn physics_program(&self) -> Result<Option<PathBuf>> {
        match program_path(PHYSICS_PROGRAM) {
            _ if self.no_sim => Ok(None),
            Ok(path) => Ok(Some(path)),
            Err(error) if self.sim => Err(error),
            Err(_) => Ok(None),
        }
    }
}

pub(super) fn run(args: &Args) -> Outcome {
    // The server's state. The folder is removed when this value is dropped.
    let state = tempfile::tempdir().map_err(fault_in("view"))?;
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build().map_err(fault_in("view"))?;
    let result = match recording::is_recording(&args.model) {
        true if args.modeling.is_requested() => Err(invalid("options of modes", "a surface", "a recording")),
        true if args.loading != LoadingOptions::default() => {
            Err(invalid("--unit, --up, --lighting, --strict", "a model", "a recording"))
        }
        true => runtime.block_on(play(args, args.playback_config(state.path())?)),
        false => runtime.block_on(view_model(args, state.path())),
    };
    // A frame that is being drawn must not delay the exit.
    runtime.shutdown_background();
    result
}

async fn view_model(args: &Args, state: &Path) -> Outcome {
    let physics_program = args.physics_program()?;
    let model = match args.model().await? {
        Computed::File(path) => path,
        Computed::Ended(completion) => return Ok(completion),
    };
    let location = SceneLocation::find(&model.to_string_lossy())?;
    let config = args.config(&location, state)?;
    view(args, &location, config, physics_program).await
}

async fn view(
    args: &Args,
    location: &SceneLocation,
    config: ValidatedConfig,
    physics_program: Option<PathBuf>,
) -> Outcome {
    let mut signals = TerminationSignals::install()?;
    let open = async {
        let (engine, listener) = start(config).await?;
        let scene = engine.open(&location.source, "", &Principal::owner(), Client::Server).await?;
        Ok((engine, listener, scene.name.clone(), location.force_files(&scene.scene)))
    };
    let (engine, listener, scene, force_files) = tokio::select! {
        opened = open => opened?,
        () = signals.received() => return Ok(Completion::Success),
    };
    announce(&engine, &listener)?;
    // The sockets are already open, so the browser and the physics process wait until the server answers.
    args.show(&scene_link(&viewer_link(&listener)?, &scene), &engine.config().state);
    let start = |path: PathBuf| start_physics(&path, args.slow, &force_files, &listener, &scene);
    let physics = physics_program.map(start).transpose()?;
    let (stop_sender, stopped) = oneshot::channel();
    let physics = physics.map(|physics| tokio::spawn(physics.supervise(engine.clone(), scene, stopped)));
    let shutdown = async move {
        signals.received().await;
        stop_sender.send(()).ok(); // Fails without a physics process.
    };
    let result = service::serve(engine, listener, shutdown).await;
    if let Some(physics) = physics {
        physics.await.map_err(fault_in("view"))?;
    }
    result.map(|()| Completion::Success)
}

/// Serves the page that plays the recording of the configuration.
async fn play(args: &Args, config: ValidatedConfig) -> Outcome {
    let mut signals = TerminationSignals::install()?;
    let (engine, listener) = start(config).await?;
    print_addresses(&listener)?;
    args.show(&viewer_link(&listener)?, &engine.config().state);
    service::serve(engine, listener, async move { signals.received().await }).await?;
    Ok(Completion::Success)
}

/// A link to a scene.
fn scene_link(link: &str, scene: &str) -> String {
    // Names of scenes have only letters that are valid in a URL.
    let separator = if link.contains('#') { '&' } else { '#' };
    format!("{link}{separator}scene={scene}")
}

/// A link to the viewer.
fn viewer_link(listener: &Listener) -> Result<String> {
    let url = listener.viewer_urls().into_iter().next();
    listener.viewer_link(&url.ok_or_else(|| fault("view", "expected a URL of the viewer"))?)
}

fn start_physics(
    program: &Path,
    slow: Option<f64>,
    force_files: &ForceFiles,
    listener: &Listener,
    scene: &str,
) -> Result<PhysicsProcess> {
    let server = listener.program_url().ok_or_else(|| fault("view", "expected an address"))?.to_owned();
    let slow = slow.map_or_else(|| "auto".to_owned(), |factor| factor.to_string());
    let mut flags = vec!["--server".to_owned(), server, "--scene".into(), scene.into(), "--slow".into(), slow];
    flags.extend(["--wait", "30", "--seconds", "0", "--realtime", "--forces", "--delivery", "latest"].map(Into::into));
    flags.extend(force_files.flags());
    PhysicsProcess::start(program, &flags)
}

fn parse_factor(text: &str) -> std::result::Result<f64, String> {
    let factor = text.parse().ok().filter(|factor: &f64| *factor > 0.0 && *factor <= 1e6);
    factor.ok_or_else(|| "expected a positive number up to 1000000".into())
}

/// Opens a link in the browser. Other users can read the arguments of a process, so the browser gets a file of this user
/// that leads to the link. Some browsers may not read it; the link is printed, too.
fn open_browser(link: &str, state: &Path) -> std::io::Result<()> {
    let path = state.join("viewer.html");
    std::fs::remove_file(&path).ok(); // Of an earlier start.
    let mut file = OpenOptions::new().write(true).create_new(true).mode(0o600).open(&path)?;
    // A link has only letters that are valid in a URL, and no quotation marks.
    write!(file, "<!doctype html><title>modalcast</title><script>location.replace(\"{link}\")</script>")?;
    let mut opener =
        Command::new(URL_OPENER).arg(path).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null()).spawn()?;
    // Waits for the end of the program, so that it does not remain as a zombie.
    std::thread::spawn(move || opener.wait());
    Ok(())
}
